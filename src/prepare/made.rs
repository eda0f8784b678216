//! The program's own files in a capture's folder: a scene may be made among the photographs.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use super::record;
use super::{Error, Step};
use crate::scene::HOLE;

/// Folders of pictures that are no photographs, where these lie in the capture's own folder.
const BESIDE: [&str; 9] =
    ["masks", "test_masks", "test_images", "depth", "disparity", "reference", HOLE, "relight", "prepare"];
/// Files that say that a folder is the program's own.
const MADE: [&str; 4] = [record::RECORD, "remove.json", "run.json", "export.json"];

/// Whether a picture below a folder of photographs is none of them: of a folder of masks or the like, or of one that the program
/// has made there.
pub(super) fn is_beside(folder: &Path, picture: &Path) -> bool {
    let below = picture.strip_prefix(folder).unwrap_or(picture);
    let is_named = |name: &OsStr| BESIDE.iter().any(|beside| name == *beside);
    let first = below.components().next().filter(|_| below.components().count() > 1);
    let within = picture.ancestors().skip(1).take_while(|path| *path != folder);
    first.is_some_and(|first| is_named(first.as_os_str()))
        || within.into_iter().any(|path| MADE.iter().any(|name| path.join(name).is_file()))
}

/// The files that the step poses has written into a folder and that are as it left them.
pub(super) struct Made(BTreeSet<PathBuf>);

impl Made {
    /// The files of a folder; none where the program has made no scene.
    ///
    /// # Errors
    /// A record or a file that cannot be read.
    pub fn of(folder: &Path) -> Result<Self, Error> {
        if !folder.join(record::RECORD).is_file() {
            return Ok(Self(BTreeSet::new()));
        }
        let own = record::Folder::open(folder)?;
        let files = own.record().steps.get(Step::Poses.name()).map(|step| step.files.keys());
        let mut made = BTreeSet::new();
        for path in files.into_iter().flatten() {
            if !own.is_users(path)? {
                made.insert(folder.join(path));
            }
        }
        Ok(Self(made))
    }

    /// Whether a file is one of them.
    pub fn has(&self, file: &Path) -> bool {
        self.0.contains(file)
    }
}

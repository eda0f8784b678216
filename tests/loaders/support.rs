//! A small scene of the program's own making.

use std::fs;
use std::path::Path;

use gscream_vk::scene::{self, Scene, synthetic};
use tempfile::TempDir;

/// Width and height of its photographs.
pub const SIZE: [u32; 2] = [48, 32];
/// Its train views.
pub const VIEWS: u32 = 4;

/// `scene/`: a synthetic scene with everything it has.
pub fn scene() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let [width, height] = SIZE;
    let options = synthetic::Options { seed: 1, width, height, train_views: VIEWS, test_views: 2, points: 200 };
    synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
    folder
}

/// A copy of a folder with all that is in it.
pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a writable folder");
    for entry in fs::read_dir(from).expect("a folder").flatten() {
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(path, target).expect("a writable folder");
        }
    }
}

/// The scene as training reads it.
pub fn load(folder: &Path) -> Result<Scene, scene::Error> {
    scene::load(folder, &scene::Config::default())
}

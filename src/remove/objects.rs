//! The files that keep what is marked: `NAME.png`, a mask as `prepare --mask` takes it, and `NAME.json`, the marks it was made
//! of and the hash of the mask they made. A mask that has another hash was changed by hand, and counts as it is.

use std::io::{self, Cursor};
use std::path::{Path, PathBuf};

use image::{GrayImage, ImageFormat};
use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::prepare::click::Mark;
use crate::prepare::masks;
use crate::scene;

/// The contents of `NAME.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    /// See [`Mark`].
    marks: Vec<Mark>,
    /// blake3 of `NAME.png`.
    mask: String,
}

fn paths(folder: &Path, name: &str) -> [PathBuf; 2] {
    ["png", "json"].map(|extension| folder.join(format!("{name}.{extension}")))
}

/// The mask of a view and the marks it was made of; no marks where it was made by hand.
///
/// # Errors
/// A mask that cannot be read, or is not of the photograph's size.
pub fn read(folder: &Path, name: &str, size: [u32; 2]) -> Result<Option<(Vec<Mark>, GrayImage)>, scene::Error> {
    let [mask_path, marks_path] = paths(folder, name);
    if !mask_path.is_file() {
        return Ok(None);
    }
    let found = scene::dimensions(&mask_path)?;
    if found != size {
        return Err(scene::Error::MaskSize { path: mask_path, size: found, picture: size });
    }
    let mask = scene::mask(&mask_path, 1)?;
    let hash = std::fs::read(&mask_path).map(|bytes| blake3::hash(&bytes).to_hex().to_string()).unwrap_or_default();
    let kept = std::fs::read(&marks_path).ok().and_then(|text| serde_json::from_slice::<Kept>(&text).ok());
    let marks = kept.filter(|kept| kept.mask == hash && kept.marks.iter().all(Mark::is_sound)).map(|kept| kept.marks);
    Ok(Some((marks.unwrap_or_default(), mask)))
}

/// Writes the mask of a view, brought to the photograph's size, and its marks; takes them away where there are none.
///
/// # Errors
/// Files that cannot be written.
pub fn write(folder: &Path, name: &str, size: [u32; 2], marks: &[Mark], mask: Option<&GrayImage>) -> io::Result<()> {
    let [mask_path, marks_path] = paths(folder, name);
    let Some(mask) = mask else {
        for path in [marks_path, mask_path] {
            match std::fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        return Ok(());
    };
    let own = [mask.width(), mask.height()];
    let large = if own == size { mask.clone() } else { masks::threshold(&masks::parts(mask, own), own, size, 0.5) };
    let mut bytes = Cursor::new(vec![]);
    large.write_to(&mut bytes, ImageFormat::Png).map_err(io::Error::other)?;
    let bytes = bytes.into_inner();
    let kept = Kept { marks: marks.to_vec(), mask: blake3::hash(&bytes).to_hex().to_string() };
    if let Some(parent) = mask_path.parent() {
        std::fs::create_dir_all(parent)?;
    }
    // A mask without its marks is one that was made by hand, which is the lesser loss.
    for (path, bytes) in [(mask_path, bytes), (marks_path, serde_json::to_vec_pretty(&kept).map_err(io::Error::other)?)]
    {
        atomic::write(&path, &bytes)?;
    }
    Ok(())
}

/// The masks of these photographs that the folder has and that show something.
///
/// # Errors
/// As [`read`].
pub fn all<'a>(
    folder: &Path,
    photographs: impl Iterator<Item = (&'a String, &'a PathBuf)>,
) -> Result<Vec<(String, PathBuf)>, scene::Error> {
    let mut found = vec![];
    for (name, photograph) in photographs {
        let [path, _] = paths(folder, name);
        if !path.is_file() {
            continue;
        }
        if let Some((_, mask)) = read(folder, name, scene::dimensions(photograph)?)?
            && mask.as_raw().iter().any(|v| *v != 0)
        {
            found.push((name.clone(), path));
        }
    }
    Ok(found)
}

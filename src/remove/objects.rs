//! The files that keep what is marked: `NAME.png`, a mask as `prepare --mask` takes it, and `NAME.json`, the marks it was made
//! of and the hash of the mask they made. A mask that has another hash was changed by hand, and counts as it is.
//!
//! They lie in a folder for each object: `objects/` is the first one's, `objects-2/` that of the next. `objects.json` beside them
//! lists the objects; it is not there for one that has never had another beside it.

use std::io::{self, Cursor};
use std::path::{Path, PathBuf};

use image::{GrayImage, ImageFormat};
use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::prepare::click::Mark;
use crate::prepare::{Evidence, Object, masks};
use crate::scene;

/// An object of the list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Tells it from the others for as long as it is there, and says which folder is its own.
    pub number: usize,
    /// What it is called.
    pub name: String,
    /// Whether it is to be removed, where it is not the only one.
    pub remove: bool,
}

impl Entry {
    /// One that has no name of its own yet.
    pub fn new(number: usize) -> Self {
        Self { number, name: format!("Object {number}"), remove: true }
    }

    /// The folder of its files, where that of the first object is this one.
    pub fn folder(&self, first: &Path) -> PathBuf {
        let own = first.file_name().map(|name| name.to_string_lossy());
        match (self.number, own) {
            (2.., Some(own)) => first.with_file_name(format!("{own}-{}", self.number)),
            _ => first.to_owned(),
        }
    }
}

/// The objects of the folder of the first one: that alone where there is no list.
///
/// # Errors
/// A list that cannot be read, or that is none.
pub fn list(first: &Path) -> Result<Vec<Entry>, scene::Error> {
    let path = first.with_extension("json");
    let text = match std::fs::read(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(vec![Entry::new(1)]),
        Err(error) => return Err(scene::Error::File { path, what: error.to_string() }),
    };
    let is_sound = |list: &Vec<Entry>| {
        let alone = |entry: &Entry| list.iter().filter(|other| other.number == entry.number).count() == 1;
        let named = |entry: &Entry| Object::checked_name(&entry.name) == Some(entry.name.as_str());
        !list.is_empty() && list.iter().all(|entry| entry.number > 0 && named(entry) && alone(entry))
    };
    let read = serde_json::from_slice::<Vec<Entry>>(&text).ok().filter(is_sound);
    let what = "it is no list of objects; mend it, or remove it to go on with the first object alone";
    read.ok_or_else(|| scene::Error::File { path, what: what.into() })
}

/// Keeps the list; that of one object as it begins is none.
///
/// # Errors
/// A file that cannot be written.
pub fn keep(first: &Path, list: &[Entry]) -> io::Result<()> {
    let path = first.with_extension("json");
    if *list == [Entry::new(1)] { gone(&path) } else { atomic::write_json(path, &list) }
}

/// Removes a file unless it is not there.
fn gone(path: &Path) -> io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The objects of the list that are to be removed, as `prepare` takes them.
///
/// # Errors
/// As [`list`] and [`read`].
pub fn wanted<'a>(
    first: &Path,
    photographs: impl Iterator<Item = (&'a String, &'a PathBuf)> + Clone,
) -> Result<Vec<Object>, scene::Error> {
    let list = list(first)?;
    let ticked = list.iter().filter(|entry| entry.remove || list.len() == 1);
    let objects = ticked.map(|entry| {
        // A name may have a dot in it, where an extension would begin.
        let masks = all(&entry.folder(first), photographs.clone())?.into_iter();
        let evidence = masks.map(|(name, path)| (format!("{name}.png"), Evidence::Cut(path))).collect();
        Ok(Object { name: entry.name.clone(), evidence, delivered: entry.number == 1 })
    });
    objects.collect()
}

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
        return gone(&marks_path).and_then(|()| gone(&mask_path));
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

/// The files that keep what is marked of an object, with what is in them: those of these photographs.
///
/// # Errors
/// A file that cannot be read.
pub fn files<'a>(folder: &Path, names: impl Iterator<Item = &'a String>) -> io::Result<Vec<(PathBuf, Vec<u8>)>> {
    let there = names.flat_map(|name| paths(folder, name)).filter(|path| path.is_file());
    there.map(|path| std::fs::read(&path).map(|bytes| (path, bytes))).collect()
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

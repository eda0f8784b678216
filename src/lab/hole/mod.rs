//! The judge of holes: what a removal is worth where the truth is known, for `bench --hole`.
//!
//! A composed scene ([`crate::compose`], or a built-in room with `synth --bare`) has photographs with an object, its exact
//! masks, and photographs without it. The judge copies photographs and model alone, has [`prepare`](crate::prepare) carry
//! one mask, trains, and compares the model with the photographs without the object inside the true masks.
//!
//! - `truth`: which pixels of the hole are seen by other photographs, by the truth's own geometry.
//! - `given`: the masks that the preparation gets.
//! - `judge`: figures of a trained model, and the picture to look at.
//! - `record`: every run's figures in one file, which is gone on with, and the table.

pub(crate) mod given;
pub(crate) mod judge;
pub(crate) mod record;
pub(crate) mod truth;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::atomic;
use crate::evaluate;
use crate::gpu::{self, Gpu};
use crate::model;
use crate::prepare::{self, Evidence, Object, Request, Step, Watch};
use crate::scene::{self, doctor};
use crate::signal::Signal;
use truth::Truth;

/// Why a composed scene cannot be judged. Each message is one sentence.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Error {
    /// A folder that is no composed scene.
    #[error("{}: no composed scene to judge by, for {what}", path.display())]
    Set {
        /// The folder.
        path: PathBuf,
        /// What is missing.
        what: &'static str,
    },
    /// Runs that do not belong together.
    #[error("{}: {what}; choose another --out", path.display())]
    Record {
        /// The record.
        path: PathBuf,
        /// Why it is not gone on with.
        what: String,
    },
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A file of the judge's own that cannot be understood.
    #[error("{}: {what}; remove it, and it is made again", path.display())]
    Kept {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The scene.
    #[error(transparent)]
    Scene(#[from] scene::Error),
    /// The preparation.
    #[error(transparent)]
    Prepare(#[from] prepare::Error),
    /// The model.
    #[error(transparent)]
    Model(#[from] model::files::Error),
    /// Pictures that cannot be compared.
    #[error(transparent)]
    Evaluate(#[from] evaluate::Error),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
}

impl Error {
    fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    /// The signal that ended the work, if one did.
    pub(crate) fn signal(&self) -> Option<Signal> {
        match self {
            Self::Prepare(error) => error.signal(),
            _ => None,
        }
    }
}

fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::io(path, source))?;
    serde_json::from_slice(&bytes).map_err(|e| Error::Kept { path: path.to_owned(), what: e.to_string() })
}

/// Writes a file that appears complete or not at all.
fn write_json(path: &Path, value: &impl Serialize) -> Result<(), Error> {
    atomic::write_json(path, value).map_err(|source| Error::io(path, source))
}

/// The scene as the preparation has left it, within a composed scene's folder of results.
pub(crate) const SCENE: &str = "scene";
/// What is known of it.
const PREPARED: &str = "prepared.json";

/// A preparation of a composed scene that has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Prepared {
    /// Views whose true masks were given.
    pub given: Vec<String>,
    /// Seconds by step.
    pub seconds: BTreeMap<String, f64>,
    /// Mean and least intersection over union of the carried masks with the true ones, over the views that show more than a
    /// sliver of the object.
    pub iou: [f64; 2],
    /// The view of the least.
    pub worst: String,
}

/// Prepares a composed scene in `folder` from its photographs, model and so many of its masks: one, or two where cameras
/// stand all around, unless told. One that has ended is left as it is.
///
/// # Errors
/// See [`Error`].
pub(crate) fn prepared(
    gpu: &Gpu,
    set: &Path,
    folder: &Path,
    truth: &Truth,
    masks: Option<usize>,
    watch: &mut dyn Watch,
) -> Result<Prepared, Error> {
    let kept = folder.join(PREPARED);
    if kept.is_file() {
        let prepared: Prepared = read_json(&kept)?;
        return match masks.filter(|masks| *masks != prepared.given.len()) {
            Some(_) => Err(Error::Record { path: kept, what: format!("it is of {} masks", prepared.given.len()) }),
            None => Ok(prepared),
        };
    }
    let given = given::choose(set, truth, masks)?;
    let out = folder.join(SCENE);
    for part in ["images", "sparse"] {
        copy(&set.join(part), &out.join(part))?;
    }
    let files = scene::pictures(&set.join("masks"))?;
    let evidence = given.iter().map(|name| (name.clone(), Evidence::Mask(files[name].clone()))).collect();
    let objects = vec![Object { evidence, ..Object::default() }];
    let request = Request { objects, ..Request::new(&out, &out) };
    let mut timed = Timed { watch, step: None, seconds: BTreeMap::new() };
    prepare::prepare(gpu, &request, &mut timed)?;
    let seconds = timed.seconds;
    let (iou, worst) = overlap(&files, &out, &given, truth)?;
    let prepared = Prepared { given, seconds, iou, worst };
    write_json(&kept, &prepared)?;
    Ok(prepared)
}

/// A preparation whose steps are timed for whoever watches it.
struct Timed<'a> {
    watch: &'a mut dyn Watch,
    step: Option<(Step, Instant)>,
    seconds: BTreeMap<String, f64>,
}

impl Watch for Timed<'_> {
    fn begin(&mut self, step: Step, units: u64) {
        self.step = Some((step, Instant::now()));
        self.watch.begin(step, units);
    }
    fn at(&mut self, unit: u64) {
        self.watch.at(unit);
    }
    fn end(&mut self) {
        if let Some((step, began)) = self.step.take() {
            *self.seconds.entry(step.name().to_owned()).or_default() += began.elapsed().as_secs_f64();
        }
        self.watch.end();
    }
    fn say(&mut self, line: &str) {
        self.watch.say(line);
    }
    fn interrupted(&mut self) -> Option<Signal> {
        self.watch.interrupted()
    }
}

/// Copies a folder; files of the same length that are there already stay.
fn copy(from: &Path, to: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(to).map_err(|source| Error::io(to, source))?;
    for entry in std::fs::read_dir(from).map_err(|source| Error::io(from, source))? {
        let entry = entry.map_err(|source| Error::io(from, source))?;
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            copy(&path, &target)?;
            continue;
        }
        let length = |path: &Path| std::fs::metadata(path).ok().map(|found| found.len());
        if length(&target) != length(&path) {
            std::fs::copy(&path, &target).map_err(|source| Error::io(&target, source))?;
        }
    }
    Ok(())
}

/// A view of which something hides all of the object but less than this share of its largest mask says nothing of a mask.
const SLIVER: f64 = 0.05;

/// Mean and least overlap of the carried masks with the true ones, and the view of the least.
fn overlap(
    files: &BTreeMap<String, PathBuf>,
    out: &Path,
    given: &[String],
    truth: &Truth,
) -> Result<([f64; 2], String), Error> {
    let carried = scene::pictures(&out.join("masks"))?;
    let mut found: Vec<(usize, f64, &String)> = vec![];
    for (name, path) in files.iter().filter(|(name, _)| !truth.wrong.contains(name)) {
        let Some(other) = carried.get(name) else { continue };
        let (own, other) = (scene::mask(path, 1)?, scene::mask(other, 1)?);
        let pixels = own.as_raw().iter().filter(|v| **v != 0).count();
        found.push((pixels, doctor::iou(&own, &other), name));
    }
    let largest = found.iter().map(|(pixels, ..)| *pixels).max().unwrap_or(0) as f64;
    found.retain(|(pixels, _, name)| *pixels as f64 > SLIVER * largest && !given.contains(name));
    let mean = found.iter().map(|(_, iou, _)| iou).sum::<f64>() / found.len().max(1) as f64;
    let worst = found.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    Ok(worst.map_or(([1.0; 2], String::new()), |(_, least, name)| ([mean, *least], (*name).clone())))
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, Luma};

    use super::*;

    #[test]
    fn slivers_given_masks_and_wrong_cameras_do_not_count() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let [set, out] = ["set", "out"].map(|name| folder.path().join(name));
        // A true mask of so many columns beside a carried one.
        let write = |name: &str, columns: [u32; 2]| {
            for (root, columns) in [&set, &out].into_iter().zip(columns) {
                let mask = GrayImage::from_fn(40, 10, |x, _| Luma([255 * u8::from(x < columns)]));
                let mut png = std::io::Cursor::new(vec![]);
                mask.write_to(&mut png, image::ImageFormat::Png).expect("a picture");
                atomic::write_below(&root.join("masks").join(format!("{name}.png")), png.get_ref()).expect("writable");
            }
        };
        for (name, columns) in [
            ("a", [40, 40]),
            ("b", [20, 40]),
            ("c", [30, 30]),
            ("given", [40, 0]),
            ("hidden", [0, 1]),
            ("wrong", [40, 0]),
        ] {
            write(name, columns);
        }
        let truth = Truth { wrong: vec!["wrong".into()], seen_share: 1.0, depth: String::new() };
        let files = scene::pictures(&set.join("masks")).expect("masks");
        let (iou, worst) = overlap(&files, &out, &["given".to_owned()], &truth).expect("they can be read");
        assert_eq!((iou, worst.as_str()), ([2.5 / 3.0, 0.5], "b"));
    }
}

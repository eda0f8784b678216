//! Where a splat is looked at from: a COLMAP model, the `cameras.json` that 3DGS writes beside its splat, or the `export.json`
//! that [`export`](crate::export) does.
//!
//! Each entry of `cameras.json` has `img_name`, `width`, `height`, `fx`, `fy`, the camera's `position` in the world, and
//! `rotation`, row by row, which takes directions of the camera to those of the world.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::Error;
use crate::scene::{self, Camera, colmap};

/// Longer side of the pictures, pixels: larger cameras are reduced.
pub const SIDE: u32 = 800;

/// The files of cameras that are looked for beside a splat.
const BESIDE: [&str; 2] = ["cameras.json", "export.json"];

/// A camera with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// The photograph's name without extension.
    pub name: String,
    /// The camera, a pinhole.
    pub camera: Camera,
}

#[derive(Deserialize)]
struct Entry {
    img_name: String,
    width: u32,
    height: u32,
    position: [f64; 3],
    rotation: [[f64; 3]; 3],
    fx: f64,
    fy: f64,
}

/// The file of cameras that a splat comes with: one of these beside it, or two folders above it, where 3DGS puts `cameras.json`.
pub fn beside(splat: &Path) -> Option<PathBuf> {
    let folder = splat.parent()?;
    let above = folder.parent().and_then(Path::parent);
    let places = [Some(folder), above].into_iter().flatten();
    places.flat_map(|folder| BESIDE.map(|name| folder.join(name))).find(|path| path.is_file())
}

/// The cameras of a file or of a folder with a COLMAP model, by name.
///
/// # Errors
/// Files that cannot be read, or cameras without sense.
pub fn read(path: &Path) -> Result<Vec<Posed>, Error> {
    let mut all = if path.is_dir() { of_colmap(path)? } else { of_json(path)? };
    let refuse = |what: String| Error::File { path: path.to_owned(), what };
    all.sort_by(|a, b| a.name.cmp(&b.name));
    let mut names = BTreeSet::new();
    for Posed { name, camera } in &all {
        if name.is_empty() || name.split('/').any(|part| part.is_empty() || part == ".." || part == ".") {
            return Err(refuse(format!("it has a camera called {name:?}, which no file can be called")));
        }
        if !names.insert(name) {
            return Err(refuse(format!("it has two cameras called {name}")));
        }
        sensible(camera).map_err(|what| refuse(format!("camera {name}: {what}")))?;
    }
    if all.len() < 3 {
        return Err(refuse(format!("it has {} cameras; three are the least that can agree on anything", all.len())));
    }
    Ok(all)
}

fn sensible(camera: &Camera) -> Result<(), String> {
    let [w, h] = camera.size;
    if w == 0 || h == 0 || w > 65_536 || h > 65_536 {
        return Err(format!("its picture is {w}x{h}"));
    }
    if !camera.focal.iter().all(|f| f.is_finite() && *f > 0.0) {
        return Err(format!("its focal lengths are {:?}", camera.focal));
    }
    if !camera.principal.iter().all(|p| p.abs() < 1e6) {
        return Err(format!("its principal point is {:?}", camera.principal));
    }
    if !camera.translation.iter().all(|t| t.is_finite() && t.abs() < 1e12) {
        return Err("it stands nowhere".into());
    }
    for (i, a) in camera.rotation.iter().enumerate() {
        for (j, b) in camera.rotation.iter().enumerate() {
            let dot: f64 = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
            // Files round to six digits or more; a NaN is near nothing.
            let near = (dot - f64::from(u8::from(i == j))).abs() < 1e-2;
            if !near {
                return Err("its rotation is none".into());
            }
        }
    }
    Ok(())
}

/// The camera for a picture whose longer side is at most [`SIDE`].
fn reduced(camera: Camera) -> Camera {
    let longest = camera.size[0].max(camera.size[1]);
    if longest <= SIDE {
        return camera;
    }
    let part = f64::from(SIDE) / f64::from(longest);
    camera.scaled(camera.size.map(|side| ((f64::from(side) * part).round() as u32).max(1)))
}

/// What a file's numbers are a camera of.
fn posed(name: &str, rotation: [[f64; 3]; 3], center: [f64; 3], camera: Camera) -> Posed {
    let rotation = rotation.map(|row| row.map(|v| v as f32));
    let translation = Camera::translation_to(&rotation, center);
    let camera = Camera { rotation, translation, distortion: [0.0; 4], ..camera };
    Posed { name: scene::stem(name).to_owned(), camera: reduced(camera) }
}

fn of_colmap(path: &Path) -> Result<Vec<Posed>, Error> {
    let (lenses, images) = colmap::lenses(path)?;
    let each = images.iter().map(|image| {
        let lens = &lenses[&image.camera];
        let camera = Camera { principal: lens.principal.map(|v| v as f32), ..pinhole(lens.size, lens.focal) };
        posed(&image.name, image.rotation, image.center(), camera)
    });
    Ok(each.collect())
}

/// A camera as [`export`](crate::export) writes it.
#[derive(Deserialize)]
struct Exported {
    name: String,
    center: [f64; 3],
    /// Right, down and ahead.
    rotation: [[f64; 3]; 3],
    /// Across the longer side, degrees.
    fov: f64,
    size: [u32; 2],
    /// In parts of the size.
    principal: Option<[f32; 2]>,
}

impl Exported {
    /// Pictures as large as may be: those that it was trained on were small.
    fn posed(&self) -> Posed {
        let longest = self.size[0].max(self.size[1]).max(1);
        let size = self.size.map(|side| (u64::from(side) * u64::from(SIDE) / u64::from(longest)) as u32);
        let focal = 0.5 * f64::from(SIDE) / (0.5 * self.fov.to_radians()).tan();
        let part = self.principal.unwrap_or([0.5; 2]);
        let principal = std::array::from_fn(|c| part[c] * size[c] as f32);
        posed(&self.name, self.rotation, self.center, Camera { principal, ..pinhole(size, [focal; 2]) })
    }
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Listed {
    Theirs(Vec<Entry>),
    Ours { cameras: Vec<Exported> },
}

/// A camera whose axis goes through the middle of its picture.
pub(super) fn pinhole(size: [u32; 2], focal: [f64; 2]) -> Camera {
    Camera {
        rotation: [[0.0; 3]; 3],
        translation: [0.0; 3],
        focal: focal.map(|v| v as f32),
        principal: size.map(|side| side as f32 / 2.0),
        distortion: [0.0; 4],
        size,
    }
}

fn of_json(path: &Path) -> Result<Vec<Posed>, Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
    let refuse = |what: String| Error::File { path: path.to_owned(), what };
    let listed: Listed = serde_json::from_slice(&bytes)
        .map_err(|error| refuse(format!("neither a cameras.json of 3DGS nor an export.json of export ({error})")))?;
    let theirs = |entry: &Entry| {
        let to_world = entry.rotation;
        let to_camera = std::array::from_fn(|i| std::array::from_fn(|j| to_world[j][i]));
        posed(&entry.img_name, to_camera, entry.position, pinhole([entry.width, entry.height], [entry.fx, entry.fy]))
    };
    Ok(match listed {
        Listed::Theirs(entries) => entries.iter().map(theirs).collect(),
        Listed::Ours { cameras } => cameras.iter().map(Exported::posed).collect(),
    })
}

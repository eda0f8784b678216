//! Truth on any capture: a made object in a real scene, and the scene as it was.
//!
//! A removal can be measured where photographs without the object exist. Here they do: the
//! capture's own. [`compose`] stands a made object on the surface that a pixel of one photograph shows, draws it into every
//! photograph, and writes a scene in the plain layout (see [`scene`]) whose test views are the photographs as they were.
//!
//! - `object`: shapes, textures and light, in heights of the object.
//! - `stand`: the surface at a pixel and the plane through it.
//! - `draw`: what a photograph shows of the object, and its shadow, by the depth of [`multiview::depths`].
//!
//! Everything is a function of the capture, the request and the device.

mod draw;
mod object;
mod stand;

use std::path::{Path, PathBuf};

use glam::DVec3;
use image::GrayImage;
use rayon::prelude::*;

pub use draw::{Drawn, Placed, darkened, draw};
pub use object::{Hit, Kind, Light, Object};
pub use stand::{Stand, find};

use crate::gpu::{self, Gpu};
use crate::multiview::{self, DepthGrid};
use crate::scene::{self, Camera, Scene, colmap, stem, up};
use crate::statistics::{median, quantile};

/// Longer side of the pictures that depth is measured in, pixels.
const SIDE: u32 = 512;
/// Files of a model that are copied: stems and extensions.
const MODEL: ([&str; 5], [&str; 3]) = (["cameras", "images", "points3D", "rigs", "frames"], ["bin", "txt", "ply"]);
/// The file of the object and its place.
pub const RECORD: &str = "compose.json";
/// Folder of the shadows: how bright the surface still is, of 255.
pub const SHADOWS: &str = "shadows";

/// Why nothing was composed. Each message is one sentence.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The folder to write has something in it.
    #[error("{}: it is there already; name a new folder", path.display())]
    Exists {
        /// The folder.
        path: PathBuf,
    },
    /// No photograph has this name.
    #[error("{option} {name}: no photograph of {} has this name{hint}", scene.display())]
    NoView {
        /// The option that named it.
        option: &'static str,
        /// The name.
        name: String,
        /// The scene's folder.
        scene: PathBuf,
        /// The nearest name.
        hint: String,
    },
    /// A pixel beyond the picture.
    #[error("--stand {view}={x},{y}: the photograph is {width}x{height}; name a pixel within it")]
    Outside {
        /// The view.
        view: String,
        /// The pixel's column.
        x: f64,
        /// The pixel's row.
        y: f64,
        /// The photograph's size or name.
        width: u32,
        /// The photograph's size or name.
        height: u32,
    },
    /// No view agrees with another on the depth there.
    #[error(
        "--stand {view}={x},{y}: no surface is known there, because no photographs agree on its depth and the model has no \
         points; name a pixel with some texture that several photographs show"
    )]
    NoSurface {
        /// The view.
        view: String,
        /// The pixel's column.
        x: f64,
        /// The pixel's row.
        y: f64,
    },
    /// A view that has to show the object does not.
    #[error("{view}: the object would not be seen in it; {what}")]
    Unseen {
        /// The view.
        view: String,
        /// The remedy.
        what: &'static str,
    },
    /// Too few photographs for the request.
    #[error("--test-every {every}: of {count} photographs none is left to train on; hold out fewer")]
    NoneLeft {
        /// As requested.
        every: u32,
        /// How many there are.
        count: usize,
    },
    /// The work was to end.
    #[error("stopped")]
    Stopped,
    /// The capture cannot be read.
    #[error(transparent)]
    Scene(#[from] scene::Error),
    /// The device failed.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
}

/// A composition that is asked for.
#[derive(Clone, Debug)]
pub struct Request {
    /// Folder of the capture: photographs and a COLMAP model.
    pub into: PathBuf,
    /// Folder to write; new or empty.
    pub out: PathBuf,
    /// The photograph that the object is placed in.
    pub view: String,
    /// Where its foot stands in that photograph, pixels of the file.
    pub pixel: [f64; 2],
    /// Height of the object as a share of that photograph's height.
    pub size: f64,
    /// The kind of object.
    pub kind: Kind,
    /// Seed of shape, texture, turn and light.
    pub seed: u64,
    /// Whether it casts a shadow.
    pub shadow: bool,
    /// The train view whose photograph, as it was, becomes the reference.
    pub reference: Option<String>,
    /// The first of every so many photographs is a test view alone; 0: each photograph is trained on with the object and
    /// tested without it.
    pub test_every: u32,
}

/// A composed scene.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Photographs to train on.
    pub train: usize,
    /// Photographs without the object.
    pub test: usize,
    /// Photographs that show the object, of all.
    pub seen: usize,
    /// Mean share of these that it covers, 0 to 1.
    pub covered: f64,
    /// Share of all pixels whose depth photographs agree on, 0 to 1; elsewhere it is taken from around.
    pub agreed: f64,
    /// Photographs that show a surface where it stands, and photographs that look past that place.
    pub standing: [usize; 2],
    /// Where it stands.
    pub stand: Stand,
    /// Seconds for depth, and for drawing and writing.
    pub seconds: [f64; 2],
}

/// Composes a scene: reads the capture, measures its depth, draws the object into every photograph and writes the folder,
/// which appears whole or not at all. `go_on` is asked between photographs.
///
/// # Errors
/// See [`Error`].
pub fn compose(gpu: &Gpu, request: &Request, go_on: &(dyn Fn() -> bool + Sync)) -> Result<Outcome, Error> {
    let out = &request.out;
    if out.is_file() || out.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(Error::Exists { path: out.clone() });
    }
    let files = scene::train_files(&request.into)?;
    let longest = scene::longest_side(&request.into).unwrap_or(SIDE);
    let config = scene::Config {
        downscale: longest.div_ceil(SIDE).max(1),
        test_every: 0,
        masks: false,
        prior_folder: scene::NONE.into(),
        ..scene::Config::default()
    };
    let scene = scene::load(&request.into, &config)?;
    let at = named(request, &scene, &request.view, "--stand")?;
    let reference =
        request.reference.as_ref().map(|name| named(request, &scene, name, "--truth-reference")).transpose()?;
    let camera = full_size(&scene.train[at].camera, &files[&scene.train[at].name])?;
    let ([x, y], [width, height]) = (request.pixel, camera.size);
    let view = || scene.train[at].name.clone();
    if !(x >= 0.0 && y >= 0.0 && x < f64::from(width) && y < f64::from(height)) {
        return Err(Error::Outside { view: view(), x, y, width, height });
    }
    let held_out = held_out(&scene, request.test_every, &[Some(at), reference]);
    if held_out.iter().all(|out| *out) {
        return Err(Error::NoneLeft { every: request.test_every, count: scene.train.len() });
    }
    let began = std::time::Instant::now();
    let grids = multiview::depths(gpu, &scene)?;
    let measured = began.elapsed().as_secs_f64();
    let cameras: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
    let stand = find(&camera, [x, y], request.size, at, &grids, up::estimate(&cameras), request.seed)
        .ok_or_else(|| Error::NoSurface { view: view(), x, y })?;
    // The golden angle: seeds that follow one another turn the object differently.
    let placed = Placed::new(Object::new(request.kind, request.seed), stand, 2.399_963 * (request.seed % 1000) as f64);
    let gains = gains(&grids, at, &stand);

    let folder = Folder::new(out)?;
    let one = |i: usize| -> Result<f64, Error> {
        if !go_on() {
            return Err(Error::Stopped);
        }
        let name = &scene.train[i].name;
        let file = &files[name];
        let photograph = scene::photograph(file, 1)?;
        let camera = full_size(&scene.train[i].camera, file)?;
        let drawn = draw(&placed, &camera, &grids[i], &photograph, gains[i], request.shadow);
        let object = drawn.mask.as_raw().iter().filter(|v| **v != 0).count();
        let changed = drawn.picture != photograph;
        if i == at && object == 0 {
            let what = "something stands before it there, or it is out of the picture: name another pixel";
            return Err(Error::Unseen { view: name.clone(), what });
        }
        if reference == Some(i) {
            if object == 0 {
                let what = "name a photograph that shows it as --truth-reference";
                return Err(Error::Unseen { view: name.clone(), what });
            }
            folder.picture("reference", name, &photograph)?;
        }
        if !held_out[i] {
            if changed {
                folder.picture("images", name, &drawn.picture)?;
            } else {
                folder.copy("images", name, file)?;
            }
            folder.mask("masks", name, &drawn.mask)?;
            if let Some(shadow) = &drawn.shadow {
                folder.mask(SHADOWS, name, shadow)?;
            }
        }
        if held_out[i] || request.test_every == 0 {
            folder.copy("test_images", name, file)?;
            folder.mask("test_masks", name, &drawn.mask)?;
        }
        Ok(object as f64 / drawn.mask.as_raw().len() as f64)
    };
    // In order, so that the first error does not depend on timing.
    let shares: Vec<Result<f64, Error>> = (0..scene.train.len()).into_par_iter().map(one).collect();
    let shares: Vec<f64> = shares.into_iter().collect::<Result<_, _>>()?;
    let (model, _) = colmap::folder(&request.into)?;
    for (stem, extension) in MODEL.0.iter().flat_map(|stem| MODEL.1.iter().map(move |e| (stem, e))) {
        let path = model.join(stem).with_extension(extension);
        if path.is_file() {
            folder.copy("sparse/0", stem, &path)?;
        }
    }
    folder.text(RECORD, &record(request, &placed))?;
    folder.keep()?;
    let seen = shares.iter().filter(|share| **share > 0.0).count();
    let known = grids.iter().flat_map(|grid| &grid.confirmed).filter(|known| **known).count();
    let tests = held_out.iter().filter(|out| **out).count();
    Ok(Outcome {
        train: shares.len() - tests,
        test: if request.test_every == 0 { shares.len() } else { tests },
        seen,
        covered: shares.iter().sum::<f64>() / seen.max(1) as f64,
        agreed: known as f64 / grids.iter().map(|grid| grid.confirmed.len()).sum::<usize>().max(1) as f64,
        standing: standing(&grids, stand.foot),
        stand,
        seconds: [measured, began.elapsed().as_secs_f64() - measured],
    })
}

/// The number of the view of a name.
fn named(request: &Request, scene: &Scene, name: &str, option: &'static str) -> Result<usize, Error> {
    let known = |view: &scene::View| view.name == stem(name);
    scene.train.iter().position(known).ok_or_else(|| {
        let names = scene.train.iter().map(|view| view.name.as_str());
        let near = names.max_by(|a, b| strsim::jaro(a, name).total_cmp(&strsim::jaro(b, name)));
        let hint = near.map_or_else(String::new, |near| format!(" (did you mean {near}?)"));
        Error::NoView { option, name: name.to_owned(), scene: request.into.clone(), hint }
    })
}

/// The camera of a photograph as it is in its file.
fn full_size(camera: &Camera, file: &Path) -> Result<Camera, Error> {
    Ok(camera.scaled(scene::dimensions(file)?))
}

/// Which views are test views alone: the first of every so many, those that have to be trained on left out.
fn held_out(scene: &Scene, every: u32, kept: &[Option<usize>]) -> Vec<bool> {
    let mut position = 0;
    let one = |i: usize| {
        if every == 0 || kept.contains(&Some(i)) {
            return false;
        }
        position += 1;
        (position - 1) % every == 0
    };
    (0..scene.train.len()).map(one).collect()
}

/// Brightness of each photograph by what it shows of the place around the object, that of the view `at` by how bright its
/// bright parts are.
fn gains(grids: &[DepthGrid], at: usize, stand: &Stand) -> Vec<f64> {
    let luminance = |color: [u8; 3]| -> f64 {
        let [r, g, b] = color.map(|v| f64::from(v) / 255.0);
        0.299 * r + 0.587 * g + 0.114 * b
    };
    let own = &grids[at];
    let bright = quantile(own.colors.iter().map(|color| luminance(*color)), 0.75).unwrap_or(0.6);
    let gain = (bright / 0.6).clamp(0.5, 1.2);
    let near = |site: &usize| {
        own.confirmed[*site] && own.point(*site).is_some_and(|p| (p - stand.foot).length() < 2.0 * stand.height)
    };
    let around: Vec<(DVec3, f64)> = (0..own.depth.len())
        .filter(near)
        .filter_map(|site| Some((own.point(site)?, luminance(own.colors[site]))))
        .collect();
    let ratio = |grid: &DepthGrid| {
        let one = |(point, before): &(DVec3, f64)| {
            let [x, y, z] = grid.camera.to_camera(point.to_array());
            let [column, row] = grid.place([x / z, y / z]).map(|p| p.floor() as i64);
            let site = grid.site(column, row).filter(|site| z > 0.0 && grid.confirmed[*site])?;
            ((grid.depth[site] / z - 1.0).abs() < 0.02 && *before > 0.02).then(|| luminance(grid.colors[site]) / before)
        };
        let ratios: Vec<f64> = around.iter().filter_map(one).collect();
        median(ratios.iter().copied()).filter(|_| ratios.len() >= 20).map_or(1.0, |ratio| ratio.clamp(0.6, 1.6))
    };
    grids.iter().map(|grid| gain * ratio(grid)).collect()
}

/// A view shows a surface at a place if a depth there is within this share, and looks past it if all are farther by more
/// than that.
const AT: f64 = 0.04;
const PAST: f64 = 0.08;

/// How many views show a surface at a place, and how many look past it. Where poses fit together hardly any does.
fn standing(grids: &[DepthGrid], place: DVec3) -> [usize; 2] {
    let mut count = [0; 2];
    for grid in grids {
        let [x, y, z] = grid.camera.to_camera(place.to_array());
        let [column, row] = grid.place([x / z, y / z]).map(|p| p.floor() as i64);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)));
        let sites = around.filter_map(|(dx, dy)| grid.site(column + dx, row + dy)).filter(|site| grid.confirmed[*site]);
        let depths: Vec<f64> = sites.map(|site| grid.depth[site] / z - 1.0).collect();
        if z <= 0.0 || depths.len() < 3 {
            continue;
        }
        count[0] += usize::from(depths.iter().any(|d| d.abs() <= AT));
        count[1] += usize::from(depths.iter().all(|d| *d > PAST));
    }
    count
}

fn record(request: &Request, placed: &Placed) -> String {
    let Stand { foot, up, height, roughness, steep } = placed.stand;
    let light = placed.world(placed.object.light.direction) - foot;
    let record = serde_json::json!({
        "object": request.kind,
        "seed": request.seed,
        "view": request.view,
        "pixel": request.pixel,
        "size": request.size,
        "foot": foot.to_array(),
        "up": up.to_array(),
        "height": height,
        "roughness": roughness,
        "steep": steep,
        "light": light.normalize().to_array(),
        "shadow": request.shadow.then_some(1.0 - placed.object.light.share),
    });
    format!("{record:#}\n")
}

/// A folder that appears whole or not at all.
struct Folder {
    work: tempfile::TempDir,
    out: PathBuf,
}

impl Folder {
    fn new(out: &Path) -> Result<Self, Error> {
        let parent = out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let io = |source| Error::Io { path: parent.to_path_buf(), source };
        std::fs::create_dir_all(parent).map_err(io)?;
        let work = tempfile::Builder::new().prefix(".compose.").tempdir_in(parent).map_err(io)?;
        Ok(Self { work, out: out.to_path_buf() })
    }

    /// The path of a file whose folders are there.
    fn path(&self, folder: &str, name: &str, extension: &str) -> Result<PathBuf, Error> {
        let path = self.work.path().join(folder).join(format!("{name}.{extension}"));
        let within = path.parent().unwrap_or(&path);
        std::fs::create_dir_all(within).map_err(|source| Error::Io { path: within.to_path_buf(), source })?;
        Ok(path)
    }

    fn picture(&self, folder: &str, name: &str, picture: &image::RgbImage) -> Result<(), Error> {
        let path = self.path(folder, name, "png")?;
        picture.save(&path).map_err(|e| Error::Io { path, source: std::io::Error::other(e) })
    }

    fn mask(&self, folder: &str, name: &str, mask: &GrayImage) -> Result<(), Error> {
        let path = self.path(folder, name, "png")?;
        mask.save(&path).map_err(|e| Error::Io { path, source: std::io::Error::other(e) })
    }

    /// A file as it is, under its own extension.
    fn copy(&self, folder: &str, name: &str, file: &Path) -> Result<(), Error> {
        let extension = file.extension().unwrap_or_default().to_string_lossy();
        let path = self.path(folder, name, &extension)?;
        // Written anew: a read-only original would make a read-only copy.
        let bytes = std::fs::read(file).map_err(|source| Error::Io { path: file.to_path_buf(), source })?;
        std::fs::write(&path, bytes).map_err(|source| Error::Io { path, source })
    }

    fn text(&self, name: &str, text: &str) -> Result<(), Error> {
        let path = self.work.path().join(name);
        std::fs::write(&path, text).map_err(|source| Error::Io { path, source })
    }

    /// Gives the folder its name.
    fn keep(self) -> Result<(), Error> {
        let io = |source| Error::Io { path: self.out.clone(), source };
        #[cfg(unix)]
        {
            // A temporary folder is its owner's alone; this one is as any other.
            use std::os::unix::fs::PermissionsExt as _;
            let parent = std::fs::metadata(self.work.path().join("images")).map_err(io)?.permissions();
            std::fs::set_permissions(self.work.path(), std::fs::Permissions::from_mode(parent.mode())).map_err(io)?;
        }
        if self.out.is_dir() {
            std::fs::remove_dir(&self.out).map_err(io)?;
        }
        std::fs::rename(self.work.path(), &self.out).map_err(io)
    }
}

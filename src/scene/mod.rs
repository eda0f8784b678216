//! What was captured: cameras, photographs, masks, depth priors, points.
//!
//! [`load`] finds out how a folder is laid out, reads its COLMAP model and its pictures, checks that they belong
//! together and brings everything to the training resolution. [`synthetic`] writes a scene of its own making in the plain
//! layout, which is
//!
//! ```text
//! SCENE/images/NAME.jpg|png                 photographs with the object
//! SCENE/masks/NAME.png                      not 0 = object; same size as the photograph
//! SCENE/depth/ or disparity/NAME.npy|exr|png   monocular priors, known up to scale and shift
//! SCENE/reference/NAME.png                  the one inpainted photograph, under the name of its view
//! SCENE/reference/NAME.npy|exr              its prior; NAME_depth.* or NAME_disparity.* says which kind it is
//! SCENE/test_images/, SCENE/test_masks/     views without the object, and where the object stood
//! SCENE/sparse/0/                           COLMAP model with poses of all of these
//! ```
//!
//! All but `images/` and `sparse/` may be missing; [`Scene::notes`] says what follows. SPIn-NeRF's own layout and
//! GScream's processed copy of it are recognised as well.

mod camera;
pub mod colmap;
mod layout;
pub mod path;
mod priors;
pub(crate) mod resample;
pub mod synthetic;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use image::{DynamicImage, GrayImage, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use camera::{Camera, distort, undistort};
pub(crate) use layout::stem;
pub(crate) use priors::rank_correlation;

/// How a scene is read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Train at 1 / `downscale` of the pictures' size, each side rounded to the nearest pixel. At least 1.
    pub downscale: u32,
    /// Masks are 0 on the object instead of off it.
    pub invert_masks: bool,
    /// Enlarge the train masks by a disc of this radius, in pixels at the training size. Test masks stay as they are.
    pub dilate_masks: u32,
    /// Where the layout has no test views, hold out the first of every `test_every` views; 0 holds out none. Held-out
    /// views show the object, so they judge the scene around it.
    pub test_every: u32,
    /// Use the train masks; `false` trains on every pixel, the object included. Without masks there is no reference either.
    pub masks: bool,
    /// Use the depth priors.
    pub priors: bool,
    /// Use the inpainted reference view.
    pub reference: bool,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            downscale: 1,
            invert_masks: false,
            dilate_masks: 0,
            test_every: 0,
            masks: true,
            priors: true,
            reference: true,
        }
    }
}

/// What the values of a prior mean, up to an unknown positive scale and a shift.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PriorKind {
    /// Grows with the distance z from the camera plane.
    Depth,
    /// Grows with 1 / z.
    Disparity,
}

impl PriorKind {
    fn folder(self) -> &'static str {
        match self {
            PriorKind::Depth => "depth",
            PriorKind::Disparity => "disparity",
        }
    }

    fn suffix(self) -> &'static str {
        match self {
            PriorKind::Depth => "_depth",
            PriorKind::Disparity => "_disparity",
        }
    }

    fn other(self) -> PriorKind {
        match self {
            PriorKind::Depth => PriorKind::Disparity,
            PriorKind::Disparity => PriorKind::Depth,
        }
    }
}

/// A monocular depth map, known up to scale and shift. Views of one scene may differ in kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Prior {
    /// Depth or disparity.
    pub kind: PriorKind,
    /// [row-major pixel], height x width of its view, finite.
    pub values: Vec<f32>,
}

/// A photograph at the training resolution and what is known about it.
#[derive(Clone, Debug)]
pub struct View {
    /// File name without extension, with its folders below the picture folder, if any.
    pub name: String,
    /// The camera of `image`, at the size of `image`.
    pub camera: Camera,
    /// Stored values, 8 bits per channel.
    pub image: RgbImage,
    /// 255 on the object, 0 elsewhere, as large as `image`. Empty masks are allowed: the object is out of view.
    pub mask: Option<GrayImage>,
    /// Prior of `image`; never there for test views.
    pub prior: Option<Prior>,
}

/// The train view whose hole was inpainted.
#[derive(Clone, Debug)]
pub struct Reference {
    /// Index into [`Scene::train`]; that view has a mask that is not empty.
    pub view: usize,
    /// The inpainted picture, as large as the view's own.
    pub image: RgbImage,
    /// Prior of the inpainted picture. Its kind may differ from that of the views' priors.
    pub prior: Option<Prior>,
}

/// A point of the sparse model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// World coordinates, finite.
    pub position: [f32; 3],
    /// 8-bit RGB.
    pub color: [u8; 3],
}

/// A scene, ready for training.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Views to train on, sorted by name; at least one.
    pub train: Vec<View>,
    /// Views to evaluate on, sorted by name.
    pub test: Vec<View>,
    /// The inpainted view.
    pub reference: Option<Reference>,
    /// Points of the sparse model; at least one.
    pub points: Vec<Point>,
    /// 1.1 x the largest distance of a train camera from the mean train camera, world units; 1 if that is zero.
    pub radius: f32,
    /// One line each: the layout found, scales worked out, what is absent and what follows.
    pub notes: Vec<String>,
}

/// Why a scene cannot be read. Each message is one sentence that names the file, what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// A setting or option that cannot be.
    #[error("{0}")]
    Setting(String),
    /// A file or folder that contradicts itself or the others.
    #[error("{}: {what}", path.display())]
    File { path: PathBuf, what: String },
    /// A line of a text file.
    #[error("{}:{line}: {what}", path.display())]
    Text { path: PathBuf, line: usize, what: String },
    /// A binary file that ends too early.
    #[error(
        "{}: the file ends at byte {length}, within {record} (the value at byte {offset} is cut off); copy or export the model again",
        path.display()
    )]
    Truncated { path: PathBuf, length: u64, offset: u64, record: String },
    /// A camera model that is not projected with.
    #[error("{}: camera {id} uses {model}; {}", path.display(), colmap::unsupported_hint())]
    CameraModel { path: PathBuf, id: u32, model: String },
    /// No sparse model.
    #[error("{}: no COLMAP model; sparse/0/ (or sparse/) must hold cameras and images, both .bin or both .txt", scene.display())]
    NoModel { scene: PathBuf },
    /// A model without points.
    #[error(
        "{}: the model has no points, and the Gaussians are built around them; export points3D.bin, .txt or .ply",
        folder.display()
    )]
    NoPoints { folder: PathBuf },
    /// No photographs.
    #[error("{}: no pictures; put the photographs (.jpg or .png) into images/", scene.display())]
    NoImages { scene: PathBuf },
    /// Pictures and model do not belong together.
    #[error(
        "{}: none of the {pictures} pictures is in the model (pictures like {picture}, model images like {image}); the names must agree up to the extension",
        scene.display()
    )]
    NoOverlap { scene: PathBuf, pictures: usize, picture: String, image: String },
    /// A picture that cannot be decoded.
    #[error("{}: not a readable picture: {source}", path.display())]
    Picture { path: PathBuf, source: image::ImageError },
    /// A picture whose proportions are not its camera's.
    #[error(
        "{}: the picture is {}x{} but its camera is {}x{}, and no one scale explains both sides; was it cropped or rotated?",
        path.display(), size[0], size[1], camera[0], camera[1]
    )]
    ImageSize { path: PathBuf, size: [u32; 2], camera: [u32; 2] },
    /// A mask of another size than its picture.
    #[error(
        "{}: the mask is {}x{} but its picture is {}x{}; masks must have the size of their pictures",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    MaskSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// An inpainted picture of another size than its view's photograph.
    #[error(
        "{}: the inpainted picture is {}x{} but its view is {}x{}; both must have the same size",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    ReferenceSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// An inpainted picture for no train view.
    #[error("{}: no train view has this name; name the inpainted picture after the view it replaces", path.display())]
    ReferenceWithoutView { path: PathBuf },
    /// A reference view whose mask is missing although other views have one.
    #[error("{}: the inpainted view has no mask; add the mask of {name}, or remove the picture", path.display())]
    ReferenceWithoutMask { path: PathBuf, name: String },
    /// A reference view whose mask is empty.
    #[error("{}: the mask of the reference view is empty, so nothing was inpainted there; is it inverted?", path.display())]
    EmptyReferenceMask { path: PathBuf },
    /// A prior of other proportions than its picture.
    #[error(
        "{}: the prior is {}x{} but its picture is {}x{}; their proportions must agree within 1 %",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    PriorSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// NaN or infinity in a prior.
    #[error("{}: the value at row {row}, column {column} is {value}; a prior must be finite everywhere", path.display())]
    NotFinite { path: PathBuf, value: f32, row: usize, column: usize },
}

/// At most this many pictures are decoded at once: decoding holds a full-size picture, mask and prior per thread.
const DECODERS: usize = 8;

/// Reads the scene in `dir` at the resolution that `config` asks for.
///
/// # Errors
/// [`Error`]: anything unreadable, and whatever contradicts itself. What is merely absent is not an error: see
/// [`Scene::notes`].
pub fn load(dir: &Path, config: &Config) -> Result<Scene, Error> {
    if config.downscale == 0 {
        return Err(Error::Setting("downscale is 0; 1 keeps the pictures' size, 2 halves it".into()));
    }
    if !dir.is_dir() {
        return Err(Error::File { path: dir.to_path_buf(), what: "there is no such folder".into() });
    }
    let mut layout = layout::find(dir)?;
    let model = colmap::read(dir)?;
    let mut notes = vec![layout.found.clone()];
    notes.append(&mut layout.notes);

    let no_masks = layout.train.iter().all(|e| e.mask.is_none());
    let mut reference = layout.reference.take();
    if let (Some(files), true) = (&reference, no_masks) {
        let file = layout::relative(dir, &files.image);
        notes.push(format!("{file} is not used: without masks there is no hole to fill"));
        reference = None;
    }
    if reference.is_some() && !(config.masks && config.reference) {
        reference = None;
        notes.push("the reference view is ignored, as configured".into());
    }
    if let Some(files) = &reference {
        let entry = layout.train.iter().find(|e| e.name == files.name).expect("the layout's reference is a train view");
        if entry.mask.is_none() {
            return Err(Error::ReferenceWithoutMask { path: files.image.clone(), name: files.name.clone() });
        }
    }
    if !config.masks && !no_masks {
        layout.train.iter_mut().for_each(|e| e.mask = None);
        notes.push("the train masks are ignored, as configured: every pixel is trained on, the object included".into());
    }
    let no_priors = layout.train.iter().all(|e| e.prior.is_none());
    if !config.priors {
        let any = !no_priors || reference.as_ref().is_some_and(|r| r.prior.is_some());
        layout.train.iter_mut().for_each(|e| e.prior = None);
        reference.iter_mut().for_each(|r| r.prior = None);
        if any {
            notes.push("the depth priors are ignored, as configured: the depth losses are off".into());
        }
    }

    let poses = Poses::new(&model);
    if !layout.train.iter().chain(&layout.test).any(|e| poses.find(&e.name).is_some()) {
        return Err(Error::NoOverlap {
            scene: dir.to_path_buf(),
            pictures: layout.train.len() + layout.test.len(),
            picture: layout.train.first().or(layout.test.first()).map_or_else(String::new, |e| e.name.clone()),
            image: model.images.first().map_or_else(|| "none at all".into(), |i| i.name.clone()),
        });
    }
    let mut posed = |entries: Vec<layout::Entry>, what: &str| {
        let all = entries.len();
        let (kept, lost): (Vec<_>, Vec<_>) = entries.into_iter().partition(|e| poses.find(&e.name).is_some());
        if let Some(first) = lost.first() {
            let count = lost.len();
            notes.push(format!(
                "{count} of {all} {what} pictures are not in the model and are left out (first: {})",
                first.name
            ));
        }
        kept
    };
    let mut train = posed(layout.train, "train");
    let mut test = posed(layout.test, "test");
    if let Some(files) = &reference
        && !train.iter().any(|e| e.name == files.name)
    {
        let what = "the model has no pose for the view of this inpainted picture".into();
        return Err(Error::File { path: files.image.clone(), what });
    }
    let held_out = test.is_empty() && config.test_every > 0;
    if held_out {
        let kept = reference.as_ref().map(|r| r.name.clone());
        let mut position = 0;
        (test, train) = train.into_iter().partition(|e| {
            // The reference view always trains, and does not count.
            let is_reference = Some(&e.name) == kept.as_ref();
            position += u32::from(!is_reference);
            !is_reference && (position - 1).is_multiple_of(config.test_every)
        });
        let object = if no_masks { "" } else { "; they show the object" };
        notes.push(format!("{} of {} views are held out for testing{object}", test.len(), test.len() + train.len()));
    }
    if train.is_empty() {
        let what = "no view is left to train on; check images/ against the model, and test_every".into();
        return Err(Error::File { path: dir.to_path_buf(), what });
    }
    let unused = model.images.len().saturating_sub(train.len() + test.len());
    if unused > 0 {
        notes.push(format!("{unused} of {} images of the model have no picture here", model.images.len()));
    }

    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(std::thread::available_parallelism().map_or(1, usize::from).min(DECODERS))
        .build()
        .map_err(|e| Error::Setting(format!("threads for decoding cannot be started: {e}")))?;
    let read = |entries: &[layout::Entry], reader: &Reader| -> Result<Vec<Loaded>, Error> {
        // In order, so that the first error reported does not depend on timing.
        let results: Vec<Result<Loaded, Error>> =
            pool.install(|| entries.par_iter().map(|e| reader.view(e, &poses)).collect());
        results.into_iter().collect()
    };
    let reader = Reader { config, dilate: config.dilate_masks, tall_mask: None };
    let loaded_train = read(&train, &reader)?;
    let reader = Reader { config, dilate: 0, tall_mask: layout.tall_test_mask };
    let loaded_test = read(&test, &reader)?;

    notes.extend(scale_note(loaded_train.iter().chain(&loaded_test)));
    let stretched = loaded_test.iter().filter(|l| l.stretched_mask).count();
    if stretched > 0 {
        notes.push(format!(
            "{stretched} test masks are not as tall as their pictures and are resampled, as SPIn-NeRF's data needs it"
        ));
    }
    let flat = loaded_train
        .iter()
        .filter(|l| l.view.prior.as_ref().is_some_and(|p| p.values.iter().all(|v| *v == p.values[0])));
    if let Some(first) = flat.clone().next() {
        notes.push(format!(
            "{} priors hold one value only, so no depth can be fitted to them (first: {})",
            flat.count(),
            first.view.name
        ));
    }
    let picture_sizes: Vec<[u32; 2]> = loaded_train.iter().map(|l| l.picture).collect();
    let train_files = train;
    let mut train: Vec<View> = loaded_train.into_iter().map(|l| l.view).collect();
    train.shrink_to_fit();
    let test: Vec<View> = loaded_test.into_iter().map(|l| l.view).collect();

    let reference = match reference {
        None => None,
        Some(files) => {
            let at = train.iter().position(|v| v.name == files.name).expect("the reference view is never held out");
            let (loaded, note) =
                read_reference(dir, &files, &train[at], &train_files[at], at, picture_sizes[at], layout.kind)?;
            notes.extend(note);
            Some(loaded)
        }
    };
    summarise(&train, &test, reference.as_ref(), model.points.len(), config, &mut notes);
    let radius = radius(&train);
    if radius.is_none() {
        notes.push("all train cameras stand at one place: the scene radius is taken as 1".into());
    }
    Ok(Scene { train, test, reference, points: model.points, radius: radius.unwrap_or(1.0), notes })
}

/// 1.1 x the largest distance of a camera from the mean camera; `None` if they all coincide.
fn radius(train: &[View]) -> Option<f32> {
    let centers: Vec<[f64; 3]> = train.iter().map(|v| v.camera.center()).collect();
    let mean: [f64; 3] = std::array::from_fn(|i| centers.iter().map(|c| c[i]).sum::<f64>() / centers.len() as f64);
    let distance = |c: &[f64; 3]| (0..3).map(|i| (c[i] - mean[i]).powi(2)).sum::<f64>().sqrt();
    let largest = 1.1 * centers.iter().map(distance).fold(0.0, f64::max);
    (largest > 1e-6).then_some(largest as f32)
}

/// The closing notes: how much there is, what is absent and what follows.
fn summarise(
    train: &[View],
    test: &[View],
    reference: Option<&Reference>,
    points: usize,
    config: &Config,
    notes: &mut Vec<String>,
) {
    let sizes: BTreeSet<[u32; 2]> = train.iter().map(|v| v.camera.size).collect();
    let size = match sizes.first() {
        Some([w, h]) if sizes.len() == 1 => format!("{w}x{h}"),
        _ => format!("{} different sizes", sizes.len()),
    };
    let count = |kind| train.iter().filter(|v| v.prior.as_ref().is_some_and(|p| p.kind == kind)).count();
    let having = [
        (train.iter().filter(|v| v.mask.is_some()).count(), "masks"),
        (count(PriorKind::Depth), "depth priors"),
        (count(PriorKind::Disparity), "disparity priors"),
    ];
    let having: String = having.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!(", {n} {what}")).collect();
    let inpainted = reference.map_or_else(String::new, |r| {
        let prior = r.prior.as_ref().map_or("no", |p| p.kind.folder());
        format!("reference view {} with {prior} prior; ", train[r.view].name)
    });
    notes.push(format!(
        "{} train views at {size}{having}; {inpainted}{} test views; {points} points",
        train.len(),
        test.len()
    ));
    let masks: Vec<&GrayImage> = train.iter().filter_map(|v| v.mask.as_ref()).collect();
    if masks.is_empty() {
        if config.masks {
            notes.push("no masks: every pixel is trained on, as in plain Scaffold-GS".into());
        }
    } else {
        if masks.len() < train.len() {
            let without = train.len() - masks.len();
            notes.push(format!("{without} of {} train views have no mask and are trained on everywhere", train.len()));
        }
        let (object, all) = masks.iter().fold((0, 0), |(object, all), m| {
            (object + m.as_raw().iter().filter(|v| **v != 0).count(), all + m.as_raw().len())
        });
        if 2 * object > all {
            let percent = 100 * object / all;
            notes.push(format!(
                "the masks cover {percent} % of the pictures; if they are 0 on the object, set invert_masks"
            ));
        }
        if reference.is_none() {
            notes.push("masks but no reference view: the hole is left unsupervised".into());
        }
    }
    let priors = train.iter().filter(|v| v.prior.is_some()).count();
    let reference_prior = reference.is_some_and(|r| r.prior.is_some());
    if config.priors && priors == 0 && !reference_prior {
        notes.push("no depth priors: the depth losses are off".into());
    } else if config.priors && (priors < train.len() || reference.is_some() && !reference_prior) {
        let without = train.len() - priors;
        let hole = if reference.is_some() && !reference_prior { ", nor has the inpainted picture" } else { "" };
        notes.push(format!("{without} of {} train views have no depth prior{hole}: no depth loss there", train.len()));
    }
    if test.is_empty() {
        notes.push("no test views: there is nothing to evaluate on (test_every holds some out)".into());
    }
}

/// What was worked out where pictures are not as large as the model's cameras.
fn scale_note<'a>(views: impl Iterator<Item = &'a Loaded>) -> Option<String> {
    let sizes: BTreeSet<_> = views.map(|l| (l.picture, l.calibrated)).filter(|(p, c)| p != c).collect();
    let (picture, calibrated) = sizes.first()?;
    let scale = f64::from(picture[0]) / f64::from(calibrated[0]);
    let ([w, h], [cw, ch]) = (picture, calibrated);
    let others = if sizes.len() > 1 { format!("; {} more sizes likewise", sizes.len() - 1) } else { String::new() };
    Some(format!(
        "pictures are {w}x{h} but the model's camera is {cw}x{ch}: the camera is scaled by {scale:.6}{others}"
    ))
}

/// Poses of the model by picture name.
struct Poses<'a> {
    model: &'a colmap::Model,
    by_name: BTreeMap<&'a str, usize>,
    /// By the last part of the path, where that is unambiguous.
    by_file: BTreeMap<&'a str, Option<usize>>,
}

impl<'a> Poses<'a> {
    fn new(model: &'a colmap::Model) -> Self {
        let (mut by_name, mut by_file) = (BTreeMap::new(), BTreeMap::new());
        for (i, image) in model.images.iter().enumerate() {
            let stem = layout::stem(&image.name);
            by_name.insert(stem, i);
            by_file.entry(file_part(stem)).and_modify(|at| *at = None).or_insert(Some(i));
        }
        Poses { model, by_name, by_file }
    }

    fn find(&self, name: &str) -> Option<(&'a colmap::Image, &'a colmap::Intrinsics)> {
        let at = self.by_name.get(name).copied().or_else(|| *self.by_file.get(file_part(name))?)?;
        let image = &self.model.images[at];
        Some((image, &self.model.cameras[&image.camera]))
    }
}

fn file_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// A view and what became known while reading it.
struct Loaded {
    view: View,
    /// Sizes of the model's camera and of the picture's file.
    calibrated: [u32; 2],
    picture: [u32; 2],
    stretched_mask: bool,
}

struct Reader<'a> {
    config: &'a Config,
    dilate: u32,
    tall_mask: Option<([u32; 2], [u32; 2])>,
}

impl Reader<'_> {
    fn view(&self, entry: &layout::Entry, poses: &Poses) -> Result<Loaded, Error> {
        let (pose, intrinsics) = poses.find(&entry.name).expect("views without a pose were left out");
        let image = decode(&entry.image)?.into_rgb8();
        let picture = [image.width(), image.height()];
        if !same_proportions(picture, intrinsics.size) {
            return Err(Error::ImageSize { path: entry.image.clone(), size: picture, camera: intrinsics.size });
        }
        let size = picture.map(|n| reduced(n, self.config.downscale));
        let image = if size == picture { image } else { resample::photograph(&image, size) };
        let mut stretched_mask = false;
        let mask = match &entry.mask {
            None => None,
            Some(path) => {
                let mut mask = object_mask(path, self.config.invert_masks)?;
                let found = [mask.width(), mask.height()];
                if found != picture {
                    if self.tall_mask != Some((found, picture)) {
                        return Err(Error::MaskSize { path: path.clone(), size: found, picture });
                    }
                    mask = resample::nearest(&mask, picture);
                    stretched_mask = true;
                }
                let mask = if size == picture { mask } else { resample::mask(&mask, size) };
                Some(resample::dilate(&mask, self.dilate))
            }
        };
        let prior = match &entry.prior {
            None => None,
            Some((path, kind)) => Some(priors::read(path, *kind, picture, size)?),
        };
        let ratio: [f64; 2] = std::array::from_fn(|i| f64::from(size[i]) / f64::from(intrinsics.size[i]));
        // The centre is kept, not the translation: rounding the rotation must not move a camera far from the origin.
        let rotation = pose.rotation.map(|row| row.map(|v| v as f32));
        let center = std::array::from_fn(|i| -(0..3).map(|k| pose.rotation[k][i] * pose.translation[k]).sum::<f64>());
        let camera = Camera {
            rotation,
            translation: Camera::translation_to(&rotation, center),
            focal: std::array::from_fn(|i| (intrinsics.focal[i] * ratio[i]) as f32),
            principal: std::array::from_fn(|i| (intrinsics.principal[i] * ratio[i]) as f32),
            distortion: intrinsics.distortion.map(|v| v as f32),
            size,
        };
        let view = View { name: entry.name.clone(), camera, image, mask, prior };
        Ok(Loaded { view, calibrated: intrinsics.size, picture, stretched_mask })
    }
}

/// A side divided by `by`, rounded to the nearest pixel and never 0.
pub(crate) fn reduced(side: u32, by: u32) -> u32 {
    ((u64::from(side) + u64::from(by) / 2) / u64::from(by)).max(1) as u32
}

/// Whether one scale takes `calibrated` to `picture` with each side rounded up or down to whole pixels.
fn same_proportions(picture: [u32; 2], calibrated: [u32; 2]) -> bool {
    let range = |i: usize| {
        let [p, c] = [picture[i], calibrated[i]].map(f64::from);
        if p == c { (1.0, 1.0) } else { ((p - 1.0) / c, (p + 1.0) / c) }
    };
    let (x, y) = (range(0), range(1));
    x.0.max(y.0) <= x.1.min(y.1)
}

/// Decodes a picture by its content, whatever its extension says.
pub(crate) fn decode(path: &Path) -> Result<DynamicImage, Error> {
    let io = |source| Error::Io { path: path.to_path_buf(), source };
    let reader = image::ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)?;
    reader.decode().map_err(|source| Error::Picture { path: path.to_path_buf(), source })
}

/// A mask as 0 and 255. Object is whatever is not 0 in some colour channel; JPEG, which does not keep zeros, from 128 on.
fn object_mask(path: &Path, invert: bool) -> Result<GrayImage, Error> {
    let image = decode(path)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let lossy = extension.eq_ignore_ascii_case("jpg") || extension.eq_ignore_ascii_case("jpeg");
    let (w, h) = (image.width(), image.height());
    // 16 bits, so that no small value is rounded to 0.
    let threshold = if lossy { 128 * 257 } else { 1 };
    let raw = image
        .into_rgb16()
        .pixels()
        .map(|p| if p.0.iter().any(|v| *v >= threshold) != invert { 255 } else { 0 })
        .collect();
    Ok(GrayImage::from_raw(w, h, raw).expect("one value per pixel"))
}

/// The pictures in a folder and in the folders below it, by their path below `folder` without extension.
pub(crate) fn pictures(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Error> {
    if !folder.is_dir() {
        return Err(Error::File { path: folder.to_path_buf(), what: "there is no such folder".into() });
    }
    layout::index(folder, &layout::PICTURES)
}

/// A picture at 1 / `downscale` of its size, reduced as [`load`] reduces photographs.
pub(crate) fn photograph(path: &Path, downscale: u32) -> Result<RgbImage, Error> {
    let image = decode(path)?.into_rgb8();
    let size = [image.width(), image.height()].map(|n| reduced(n, downscale));
    Ok(if downscale == 1 { image } else { resample::photograph(&image, size) })
}

/// A mask at 1 / `downscale` of its size, reduced as [`load`] reduces masks: 255 inside, 0 elsewhere.
pub(crate) fn mask(path: &Path, downscale: u32) -> Result<GrayImage, Error> {
    let mask = object_mask(path, false)?;
    let size = [mask.width(), mask.height()].map(|n| reduced(n, downscale));
    Ok(if downscale == 1 { mask } else { resample::mask(&mask, size) })
}

/// Below this rank correlation, two priors of one view are taken to be unrelated.
const RELATED: f64 = 0.5;

/// Reads the inpainted picture of train view `at` and its prior, and says how the prior's kind was found where that is not
/// obvious.
///
/// A prior of unsaid kind is compared with the view's own outside the mask, where both show the same scene: rising
/// together means the same kind, rising against each other the other kind (rank correlation, so that the curve of 1 / z
/// does not matter).
fn read_reference(
    dir: &Path,
    files: &layout::ReferenceFiles,
    view: &View,
    entry: &layout::Entry,
    at: usize,
    picture: [u32; 2],
    kind: Option<PriorKind>,
) -> Result<(Reference, Option<String>), Error> {
    let image = decode(&files.image)?.into_rgb8();
    let found = [image.width(), image.height()];
    if found != picture {
        return Err(Error::ReferenceSize { path: files.image.clone(), size: found, picture });
    }
    let mask = view.mask.as_ref().expect("a reference view without a mask was refused");
    if mask.as_raw().iter().all(|v| *v == 0) {
        let path = entry.mask.clone().unwrap_or_else(|| files.image.clone());
        return Err(Error::EmptyReferenceMask { path });
    }
    let size = view.camera.size;
    let image = if found == size { image } else { resample::photograph(&image, size) };
    let mut note = None;
    let prior = match &files.prior {
        None => None,
        Some(layout::ReferencePrior { path, kind: Some(kind) }) => Some(priors::read(path, *kind, picture, size)?),
        Some(layout::ReferencePrior { path, kind: None }) => {
            let assumed = kind.unwrap_or(PriorKind::Depth);
            let mut prior = priors::read(path, assumed, picture, size)?;
            let outside = |i: usize| mask.as_raw()[i] == 0;
            let own = view.prior.as_ref();
            let correlation = own.and_then(|own| priors::rank_correlation(&prior.values, &own.values, outside));
            let file = layout::relative(dir, path);
            match (own, correlation) {
                (Some(own), Some(r)) if r.abs() >= RELATED => {
                    prior.kind = if r > 0.0 { own.kind } else { own.kind.other() };
                    if prior.kind != own.kind {
                        note = Some(format!(
                            "{file} is read as {}: outside the mask it runs against the view's {} (rank correlation {r:.2})",
                            prior.kind.folder(),
                            own.kind.folder()
                        ));
                    }
                }
                (_, r) => {
                    let why = r.map_or_else(
                        || "there is no prior of that view to compare with".to_string(),
                        |r| format!("it hardly resembles the view's own prior, rank correlation {r:.2}"),
                    );
                    let name = &files.name;
                    note = Some(format!(
                        "{file} is taken as {} ({why}); name it {name}_depth or {name}_disparity to say so",
                        assumed.folder()
                    ));
                }
            }
            Some(prior)
        }
    };
    Ok((Reference { view: at, image, prior }, note))
}

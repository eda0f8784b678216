//! What was captured: cameras, photographs, masks, depth priors, points.
//!
//! [`load`] finds out how a folder is laid out, reads its COLMAP model and its pictures, checks that they belong
//! together and brings everything to the training resolution. [`synthetic`] and [`room360`] write scenes of their own making
//! in the plain layout, which is
//!
//! ```text
//! SCENE/images/NAME.jpg|png                 photographs with the object
//! SCENE/masks/NAME.png                      not 0 = object; same size as the photograph
//! SCENE/depth/ or disparity/NAME.npy|exr|png   monocular priors, known up to scale and shift
//! SCENE/reference/NAME.png                  the one inpainted photograph, under the name of its view
//! SCENE/reference/NAME.npy|exr              its prior; NAME_depth.* or NAME_disparity.* says which kind it is
//! SCENE/test_images/, SCENE/test_masks/     views without the object, and where the object stood
//! SCENE/test_depth/NAME.npy|exr|png         true depth z of these, not positive where it is unknown
//! SCENE/relight/NAME.png                    what the object's shadow leaves of the light, of 255, see `prepare`
//! SCENE/hole/NAME.png                       the holes of the other views filled, alpha 255 in the hole, see `prepare`
//! SCENE/sparse/0/                           COLMAP model with poses of all of these
//! ```
//!
//! All but `images/` and `sparse/` may be missing; [`Scene::notes`] says what follows. SPIn-NeRF's own layout and
//! GScream's processed copy of it are recognised as well.

mod bounds;
mod camera;
pub mod colmap;
mod condition;
mod config;
pub mod doctor;
mod error;
mod exposure;
mod hole;
mod layout;
pub mod map;
mod note;
pub(crate) mod npy;
pub mod path;
mod picture;
mod priors;
mod relight;
pub(crate) mod resample;
pub mod room360;
pub mod sheet;
mod strays;
pub mod synthetic;
pub mod up;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use image::{GrayImage, RgbImage};
use rayon::prelude::*;

pub use camera::{Camera, distort, undistort};
pub(crate) use condition::{bare, on_object, samples, seed_views};
pub use condition::{condition, footprint, normalize, typical};
pub use config::{Config, NONE, STEREO_PRIOR};
pub use error::Error;
pub(crate) use exposure::even_out;
pub use hole::{BEHIND, DOUBTFUL, GUESSED, HOLE, Hole, MADE_WITH};
pub(crate) use layout::{PICTURES, stem};
pub use note::{Note, Notes};
pub use picture::{decode, dimensions, is_turned, jpeg, object_mask};
pub(crate) use priors::rank_correlation;
pub use priors::read as read_prior;
pub use priors::{Prior, PriorKind, in_own_range, own_range};
pub(crate) use relight::reduced as relit;
pub use relight::{RELIGHT, lighten};

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
    /// Blend of the two loss weights of a pixel, as large as `mask`: 255 takes the weight inside the mask, 0 that outside.
    /// [`condition`] makes it from the mask: it falls off around the object, and is lower where other views see a
    /// reference's hole. `None` stands for the mask itself.
    pub weight: Option<GrayImage>,
    /// Prior of `image`; never there for test views.
    pub prior: Option<Prior>,
    /// True depth z of `image`, where it is known: `[row-major pixel]`, 0 where it is not. Of test views alone: nothing is
    /// trained on it.
    pub depth: Option<Vec<f32>>,
}

/// A train view whose hole was inpainted, or a view that never had one ([`Config::truth_reference`]).
#[derive(Clone, Debug)]
pub struct Reference {
    /// Index into [`Scene::train`]; that view has a mask that is not empty.
    pub view: usize,
    /// The inpainted picture, as large as the view's own.
    pub image: RgbImage,
    /// Prior of the inpainted picture. Its kind may differ from that of the views' priors.
    pub prior: Option<Prior>,
    /// Whether nothing was inpainted: the photograph shows the place without the object ([`Config::truth_reference`]).
    pub truth: bool,
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
    /// The inpainted views, sorted by [`Reference::view`]: one in most scenes, none where there is no hole to fill.
    pub references: Vec<Reference>,
    /// The other train views whose holes are filled, sorted by [`Hole::view`].
    pub holes: Vec<Hole>,
    /// Points of the sparse model; at least one.
    pub points: Vec<Point>,
    /// Points that the photographs add to these, see [`multiview`](crate::multiview): anchors start there, too, and nothing
    /// else looks at them.
    pub dense: Vec<Point>,
    /// 1.1 x the largest distance of a train camera from the mean train camera, world units, where cameras much farther out
    /// than nine in ten do not count; 1 if that is zero.
    pub radius: f32,
    /// Lengths of the model's per world unit of this scene: 1 as read, see [`condition`].
    pub unit: f64,
    /// `[train view]` red, green and blue of its photograph over the usual ones, divided out by [`condition`]; empty where
    /// the photographs were left as they are.
    pub gains: Vec<[f64; 3]>,
    /// Whether the object's shadow was taken out of photographs.
    pub relit: bool,
    /// One line each: the layout found, scales worked out, what is absent and what follows.
    pub notes: Notes,
}

/// One picture of so many may be lost without being a problem.
const FEW_LOST: usize = 20;

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
    let mut model = colmap::read(dir)?;
    let mut points = std::mem::take(&mut model.points);
    let tracks = std::mem::take(&mut model.tracks);
    let mut notes = Notes::from_iter([layout.found.clone()]);
    notes.append(&mut layout.notes);

    let shadowed = layout.train.iter().filter(|e| e.relight.is_some()).count();
    let relit = shadowed > 0 && config.relight;
    if relit {
        notes.push(format!("the object's shadow is taken out of {shadowed} photographs ({RELIGHT}/)"));
    } else if shadowed > 0 {
        layout.train.iter_mut().for_each(|e| e.relight = None);
        notes.push(format!("{RELIGHT}/ is ignored, as configured: the object's shadow stays"));
    }
    let no_masks = layout.train.iter().all(|e| e.mask.is_none());
    let clean_views = !layout.test.is_empty();
    let no_priors_wanted = config.prior_folder == NONE;
    if !config.prior_folder.is_empty() && !no_priors_wanted {
        take_priors(dir, config, &mut layout, &mut notes)?;
    }
    if !config.reference_file.is_empty() && config.reference_file != NONE {
        take_reference(dir, config, &mut layout, &mut notes)?;
    }
    let mut truth = None;
    if !config.truth_reference.is_empty() {
        truth = Some(take_truth(dir, config, &mut layout, &mut notes)?);
    } else if !config.truth_prior.is_empty() {
        let what = "scene.truth_prior is set without scene.truth_reference; name the test view that it belongs to";
        return Err(Error::Setting(what.into()));
    }
    // Only the reference needs the prior of a picture without the object.
    layout.test.iter_mut().for_each(|e| e.prior = None);
    let mut references = std::mem::take(&mut layout.references);
    if let (Some(files), true) = (references.first(), no_masks) {
        let file = layout::relative(dir, &files.image);
        notes.push(format!("{file} is not used: without masks there is no hole to fill"));
        references.clear();
    }
    if !config.has_reference() && !references.is_empty() {
        references.clear();
        notes.push("the reference view is ignored, as configured");
    }
    for files in &references {
        let entry = layout.train.iter().find(|e| e.name == files.name).expect("the layout's reference is a train view");
        if entry.mask.is_none() {
            return Err(Error::ReferenceWithoutMask { path: files.image.clone(), name: files.name.clone() });
        }
    }
    if let (true, Some(name)) = (references.is_empty(), &truth) {
        layout.train.retain(|e| e.name != *name);
        notes.push(format!("{name} is neither trained on nor tested, so that the figures are of the same views"));
    }
    if !config.masks && !no_masks {
        layout.train.iter_mut().for_each(|e| e.mask = None);
        notes.push("the train masks are ignored, as configured: every pixel is trained on, the object included");
    }
    let no_priors = layout.train.iter().all(|e| e.prior.is_none());
    if no_priors_wanted {
        let any = !no_priors || references.iter().any(|r| r.prior.is_some());
        layout.train.iter_mut().for_each(|e| e.prior = None);
        references.iter_mut().for_each(|r| r.prior = None);
        if any {
            notes.push("the depth priors are ignored, as configured: the depth losses are off");
        }
    }

    leave_out(config, [&mut layout.train, &mut layout.test], &references, &mut notes)?;
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
            let text = format!(
                "{count} of {all} {what} pictures are not in the model and are left out (first: {})",
                first.name
            );
            // Structure from motion places nearly all of a good capture.
            notes.push(if count > all / FEW_LOST { Note::Lost(text) } else { Note::Plain(text) });
        }
        kept
    };
    let mut train = posed(layout.train, "train");
    let mut test = posed(layout.test, "test");
    let strays = strays::leave(&model, &poses, [&mut train, &mut test], (&mut points, &tracks), &mut notes);
    if let Some(files) = references.iter().find(|files| !train.iter().any(|e| e.name == files.name)) {
        let what =
            "the model has no pose for the view of this inpainted picture, or none that is near the others'".into();
        return Err(Error::File { path: files.image.clone(), what });
    }
    if !clean_views && config.test_every > 0 {
        let mut position = 0;
        (test, train) = train.into_iter().partition(|e| {
            // A reference view always trains, and does not count.
            let is_reference = references.iter().any(|r| r.name == e.name);
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
    let unused = model.images.len().saturating_sub(train.len() + test.len() + strays + config.leave_out.len());
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
    let tall_of = |e: &layout::Entry| layout.tall_test_mask.filter(|_| truth.as_ref() == Some(&e.name));
    let reader = Reader { config, dilate: config.dilate_masks, tall_mask: &tall_of };
    let loaded_train = read(&train, &reader)?;
    let reader = Reader { config, dilate: 0, tall_mask: &|_| layout.tall_test_mask };
    let loaded_test = read(&test, &reader)?;

    notes.extend(scale_note(loaded_train.iter().chain(&loaded_test)));
    let stretched = loaded_train.iter().chain(&loaded_test).filter(|l| l.stretched_mask).count();
    if stretched > 0 {
        notes.push(format!(
            "{stretched} test masks are not as tall as their pictures and are resampled, as SPIn-NeRF's data needs it"
        ));
    }
    let flat = loaded_train.iter().filter(|l| l.view.prior.as_ref().is_some_and(Prior::is_flat));
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

    let mut read_references = vec![];
    for files in references {
        let at = train.iter().position(|v| v.name == files.name).expect("a reference view is never held out");
        let (loaded, note) =
            read_reference(dir, &files, &train[at], &train_files[at], at, picture_sizes[at], layout.kind)?;
        notes.extend(note);
        let truth = truth.as_ref() == Some(&files.name);
        read_references.push(Reference { truth, ..loaded });
    }
    let mut references = read_references;
    references.sort_by_key(|r| r.view);
    let filled: Vec<Option<PathBuf>> = train_files.iter().map(|entry| entry.hole.clone()).collect();
    let holes = hole::read_all(dir, config, (&mut train, &filled), &references, &mut notes)?;
    summarise(&train, &test, &references, points.len(), config, &mut notes);
    let radius = radius(&train);
    if radius.is_none() {
        notes.push("all train cameras stand at one place: the scene radius is taken as 1");
    }
    Ok(Scene {
        train,
        test,
        references,
        holes,
        points,
        dense: vec![],
        radius: radius.unwrap_or(1.0),
        unit: 1.0,
        gains: vec![],
        relit,
        notes,
    })
}

impl View {
    /// Blend of the loss weights inside and outside the mask: [`View::weight`] where there is one, else the mask.
    pub fn blend(&self) -> Option<&GrayImage> {
        self.weight.as_ref().or(self.mask.as_ref())
    }
}

impl Scene {
    /// The inpainted picture of this train view, if it has one.
    pub fn reference_of(&self, view: usize) -> Option<&Reference> {
        self.references.iter().find(|r| r.view == view)
    }

    /// The picture of this train view with its hole filled, if it has one and is no reference.
    pub fn hole_of(&self, view: usize) -> Option<&Hole> {
        self.holes.iter().find(|hole| hole.view == view)
    }

    /// The points that anchors start at.
    pub fn starts(&self) -> Vec<Point> {
        self.points.iter().chain(&self.dense).copied().collect()
    }

    /// Counts all lengths in the model's units again, those of the files, and returns how many of them one was.
    pub fn restore_unit(&mut self) -> f64 {
        let unit = self.unit;
        if unit != 1.0 {
            self.rescale(1.0 / unit);
            self.unit = 1.0;
        }
        unit
    }

    /// Counts all lengths in units of `unit` of those they are counted in now.
    fn rescale(&mut self, unit: f64) {
        for view in self.train.iter_mut().chain(&mut self.test) {
            view.camera.translation = view.camera.translation.map(|t| t / unit);
            view.depth.iter_mut().flatten().for_each(|z| *z = (f64::from(*z) / unit) as f32);
        }
        for z in self.holes.iter_mut().filter_map(|hole| hole.depth.as_mut()).flatten() {
            *z = (f64::from(*z) / unit) as f32;
        }
        for point in self.points.iter_mut().chain(&mut self.dense) {
            point.position = point.position.map(|x| (f64::from(x) / unit) as f32);
        }
        self.radius = (f64::from(self.radius) / unit) as f32;
        self.unit *= unit;
    }
}

/// Replaces the priors of all views by those of [`Config::prior_folder`]: views without one there have none.
fn take_priors(dir: &Path, config: &Config, layout: &mut layout::Layout, notes: &mut Notes) -> Result<(), Error> {
    let folder = dir.join(&config.prior_folder);
    let files = depth_maps(&folder)?;
    let name = folder.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let kind = if name.contains(PriorKind::Disparity.folder()) { PriorKind::Disparity } else { PriorKind::Depth };
    for entry in layout.train.iter_mut().chain(&mut layout.test) {
        entry.prior = files.get(&entry.name).map(|path| (path.clone(), kind));
    }
    let taken = layout.train.iter().filter(|e| e.prior.is_some()).count();
    if taken == 0 {
        let what = "no prior has the name of a train view; name them after the photographs".into();
        return Err(Error::File { path: folder, what });
    }
    layout.kind = Some(kind);
    notes.push(format!("{taken} priors are those of {}, read as {}", folder.display(), kind.folder()));
    for reference in &mut layout.references {
        let own = files.get(&format!("reference/{}", reference.name)).cloned();
        match (own, &reference.prior) {
            (Some(path), _) => reference.prior = Some(layout::ReferencePrior { path, kind: Some(kind) }),
            (None, Some(_)) => notes.push("the inpainted picture keeps its delivered prior: there is no other"),
            (None, None) => {}
        }
    }
    Ok(())
}

/// Makes [`Config::reference_file`] the inpainted picture. The delivered one's prior stays where both are of one view.
fn take_reference(dir: &Path, config: &Config, layout: &mut layout::Layout, notes: &mut Notes) -> Result<(), Error> {
    if !config.truth_reference.is_empty() {
        let what = "scene.reference_file and scene.truth_reference are both set; name one of the two";
        return Err(Error::Setting(what.into()));
    }
    let image = dir.join(&config.reference_file);
    let file = image.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let stem = layout::stem(&file);
    let mut delivered = std::mem::take(&mut layout.references);
    let named = layout.train.iter().find(|e| file_part(&e.name) == stem).map(|e| e.name.clone());
    let Some(name) = named.or_else(|| delivered.first().map(|d| d.name.clone())) else {
        return Err(Error::ReferenceWithoutView { path: image });
    };
    notes.push(format!("the reference is {}, taken for view {name}", image.display()));
    delivered.retain(|d| d.name == name);
    let prior = delivered.pop().and_then(|d| d.prior);
    if prior.is_some() {
        notes.push("its prior is the delivered picture's");
    }
    layout.references = vec![layout::ReferenceFiles { name, image, prior }];
    Ok(())
}

/// Moves the test view that [`Config::truth_reference`] names to the train views and makes it the reference: its
/// photograph is what a perfect inpainting would be. The view of the delivered reference stays, as a masked train view.
/// Returns the view's name.
fn take_truth(dir: &Path, config: &Config, layout: &mut layout::Layout, notes: &mut Notes) -> Result<String, Error> {
    let wanted = layout::stem(&config.truth_reference);
    let Some(at) = layout.test.iter().position(|e| e.name == wanted) else {
        return Err(Error::NoTruth {
            scene: dir.to_path_buf(),
            name: config.truth_reference.clone(),
            names: layout.test.iter().map(|e| e.name.clone()).collect(),
        });
    };
    let mut entry = layout.test.remove(at);
    if entry.mask.is_none() {
        return Err(Error::TruthWithoutMask { path: entry.image });
    }
    if let Some(twin) = layout.train.iter().find(|e| e.name == entry.name) {
        let what = format!("{} has the same name, and both would be trained on; rename one", twin.image.display());
        return Err(Error::File { path: entry.image, what });
    }
    let prior = match config.truth_prior.as_str() {
        "" => {
            let exact = entry.depth.clone().map(|path| (path, PriorKind::Depth));
            entry.prior.clone().or(exact).map(|(path, kind)| layout::ReferencePrior { path, kind: Some(kind) })
        }
        NONE | STEREO_PRIOR => None,
        file => {
            let path = dir.join(file);
            let kind = layout::said_kind(&path);
            Some(layout::ReferencePrior { path, kind })
        }
    };
    // The prior is the reference's: two of them for one picture say no more than one.
    (entry.prior, entry.depth) = (None, None);
    let name = entry.name.clone();
    notes.push(format!("test view {name} is trained on as the reference: its photograph shows the truth"));
    let truth = layout::ReferenceFiles { name: name.clone(), image: entry.image.clone(), prior };
    for delivered in std::mem::replace(&mut layout.references, vec![truth]) {
        let file = layout::relative(dir, &delivered.image);
        notes.push(format!("{file} is set aside; its view trains as any other with a mask"));
    }
    layout.train.push(entry);
    layout.train.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(name)
}

/// Takes out the views of [`Config::leave_out`].
fn leave_out(
    config: &Config,
    mut views: [&mut Vec<layout::Entry>; 2],
    references: &[layout::ReferenceFiles],
    notes: &mut Notes,
) -> Result<(), Error> {
    for name in &config.leave_out {
        let what = if references.iter().any(|files| files.name == *name) {
            "the view of the inpainted picture, which has to stay; take the picture out of reference/ first"
        } else if !views.iter().any(|views| views.iter().any(|entry| entry.name == *name)) {
            "no view of this scene; views are named after their photographs, without extension"
        } else {
            continue;
        };
        return Err(Error::Setting(format!("scene.leave_out names {name}: {what}")));
    }
    let before: usize = views.iter().map(|views| views.len()).sum();
    views.iter_mut().for_each(|views| views.retain(|entry| !config.leave_out.contains(&entry.name)));
    let after: usize = views.iter().map(|views| views.len()).sum();
    if after < before {
        notes.push(format!("{} of {before} views are left out, as configured (scene.leave_out)", before - after));
    }
    Ok(())
}

/// 1.1 x the largest distance of a camera from the mean camera, but for the farthest of few; `None` if they all coincide.
fn radius(train: &[View]) -> Option<f32> {
    let centers: Vec<[f64; 3]> = train.iter().map(|v| v.camera.center()).collect();
    let largest = 1.1 * bounds::radius(&centers);
    (largest > 1e-6).then_some(largest as f32)
}

/// The closing notes: how much there is, what is absent and what follows.
fn summarise(
    train: &[View],
    test: &[View],
    references: &[Reference],
    points: usize,
    config: &Config,
    notes: &mut Notes,
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
    let inpainted = |r: &Reference| {
        let prior = r.prior.as_ref().map_or("no", |p| p.kind.folder());
        format!("reference view {} with {prior} prior; ", train[r.view].name)
    };
    let inpainted: String = references.iter().map(inpainted).collect();
    notes.push(format!(
        "{} train views at {size}{having}; {inpainted}{} test views; {points} points",
        train.len(),
        test.len()
    ));
    let masks: Vec<&GrayImage> = train.iter().filter_map(|v| v.mask.as_ref()).collect();
    if masks.is_empty() {
        if config.masks {
            notes.push("no masks: every pixel is trained on, as in plain Scaffold-GS");
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
        if references.is_empty() {
            notes.push("masks but no reference view: the hole is left unsupervised");
        }
    }
    let priors = train.iter().filter(|v| v.prior.is_some()).count();
    let reference_prior = references.iter().any(|r| r.prior.is_some());
    let wanted = config.prior_folder != NONE;
    if wanted && priors == 0 && !reference_prior {
        notes.push("no depth priors: the depth losses are off");
    } else if wanted && (priors < train.len() || !references.is_empty() && !reference_prior) {
        let without = train.len() - priors;
        let hole = if !references.is_empty() && !reference_prior { ", nor has the inpainted picture" } else { "" };
        notes.push(format!("{without} of {} train views have no depth prior{hole}: no depth loss there", train.len()));
    }
    if test.is_empty() {
        notes.push("no test views: there is nothing to evaluate on (test_every holds some out)");
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

    /// The place of the photograph in the model's list.
    fn place(&self, name: &str) -> Option<usize> {
        // The file's name alone will do where one side has no folders; in another folder it is another photograph.
        let bare = |at: usize| !name.contains('/') || !self.model.images[at].name.contains('/');
        let by_file = || self.by_file.get(file_part(name)).copied().flatten().filter(|at| bare(*at));
        self.by_name.get(name).copied().or_else(by_file)
    }

    fn find(&self, name: &str) -> Option<(&'a colmap::Image, &'a colmap::Intrinsics)> {
        let image = &self.model.images[self.place(name)?];
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

/// Sizes of an entry's mask and picture that may differ as stated.
type TallMask<'a> = &'a (dyn Fn(&layout::Entry) -> Option<([u32; 2], [u32; 2])> + Sync);

struct Reader<'a> {
    config: &'a Config,
    dilate: u32,
    tall_mask: TallMask<'a>,
}

impl Reader<'_> {
    fn view(&self, entry: &layout::Entry, poses: &Poses) -> Result<Loaded, Error> {
        let (pose, intrinsics) = poses.find(&entry.name).expect("views without a pose were left out");
        let picture = dimensions(&entry.image)?;
        if !same_proportions(picture, intrinsics.size) {
            return Err(Error::ImageSize { path: entry.image.clone(), size: picture, camera: intrinsics.size });
        }
        let size = reduced(picture, self.config.downscale);
        let image = decode(&entry.image)?.into_rgb8();
        let image = relight::reduced(entry.relight.as_deref(), &image, size)?;
        let mut stretched_mask = false;
        let mask = match &entry.mask {
            None => None,
            Some(path) => {
                let found = dimensions(path)?;
                if found != picture && (self.tall_mask)(entry) != Some((found, picture)) {
                    return Err(Error::MaskSize { path: path.clone(), size: found, picture });
                }
                let mut mask = object_mask(path, self.config.invert_masks)?;
                if found != picture {
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
        let center = pose.center();
        let camera = Camera {
            rotation,
            translation: Camera::translation_to(&rotation, center),
            focal: std::array::from_fn(|i| (intrinsics.focal[i] * ratio[i]) as f32),
            principal: std::array::from_fn(|i| (intrinsics.principal[i] * ratio[i]) as f32),
            distortion: intrinsics.distortion.map(|v| v as f32),
            size,
        };
        let depth = entry.depth.as_ref().map(|path| depth_map(path, picture, size)).transpose()?;
        let view = View { name: entry.name.clone(), camera, image, mask, weight: None, prior, depth };
        Ok(Loaded { view, calibrated: intrinsics.size, picture, stretched_mask })
    }
}

/// A size with each side divided by `by`, rounded to the nearest pixel and never 0.
pub(crate) fn reduced(size: [u32; 2], by: u32) -> [u32; 2] {
    size.map(|side| ((u64::from(side) + u64::from(by) / 2) / u64::from(by)).max(1) as u32)
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

/// The pictures in a folder and in the folders below it, by their path below `folder` without extension.
pub(crate) fn pictures(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Error> {
    if !folder.is_dir() {
        return Err(Error::File { path: folder.to_path_buf(), what: "there is no such folder".into() });
    }
    let mut passed_over = Notes::default();
    let found = layout::index(folder, &PICTURES, &mut passed_over)?;
    passed_over.iter().for_each(|line| log::warn!("{line}"));
    Ok(found)
}

/// The photographs of a scene's train views, by name.
pub(crate) fn train_files(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Error> {
    Ok(layout::find(folder)?.train.into_iter().map(|entry| (entry.name, entry.image)).collect())
}

/// Longer side of the first picture of a scene, pixels; `None` where there is none that can be read.
pub(crate) fn longest_side(folder: &Path) -> Option<u32> {
    let layout = layout::find(folder).ok()?;
    let (width, height) = image::image_dimensions(&layout.train.first()?.image).ok()?;
    Some(width.max(height))
}

/// The depth maps in a folder and in the folders below it, by their path below `folder` without extension.
pub(crate) fn depth_maps(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Error> {
    if !folder.is_dir() {
        return Err(Error::File { path: folder.to_path_buf(), what: "there is no such folder".into() });
    }
    layout::index(folder, &priors::EXTENSIONS, &mut Notes::default())
}

/// A picture at 1 / `downscale` of its size, reduced as [`load`] reduces photographs.
pub(crate) fn photograph(path: &Path, downscale: u32) -> Result<RgbImage, Error> {
    let image = decode(path)?.into_rgb8();
    let size = reduced(image.dimensions().into(), downscale);
    Ok(if downscale == 1 { image } else { resample::photograph(&image, size) })
}

/// A picture whose longer side is at most `side` pixels, reduced as [`load`] reduces photographs.
pub(crate) fn photograph_within(path: &Path, side: u32) -> Result<RgbImage, Error> {
    let image = decode(path)?.into_rgb8();
    let longer = f64::from(image.width().max(image.height()));
    let size = [image.width(), image.height()];
    let scale = (f64::from(side) / longer).min(1.0);
    Ok(resample::photograph(&image, size.map(|n| ((f64::from(n) * scale).round() as u32).max(1))))
}

/// A mask at 1 / `downscale` of its size, reduced as [`load`] reduces masks: 255 inside, 0 elsewhere.
pub(crate) fn mask(path: &Path, downscale: u32) -> Result<GrayImage, Error> {
    let mask = object_mask(path, false)?;
    let size = reduced(mask.dimensions().into(), downscale);
    Ok(if downscale == 1 { mask } else { resample::mask(&mask, size) })
}

/// A true depth map for a picture of `picture`'s size, at `size`: of the nearest of its pixels, since between two surfaces
/// there is none. 0 where it is unknown (not finite, or not positive).
///
/// # Errors
/// An unreadable file, other proportions than the picture's.
pub(crate) fn depth_map(path: &Path, picture: [u32; 2], size: [u32; 2]) -> Result<Vec<f32>, Error> {
    let mut values = priors::nearest(path, picture, size)?;
    values.iter_mut().filter(|z| !(z.is_finite() && **z > 0.0)).for_each(|z| *z = 0.0);
    Ok(values)
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
    let found = dimensions(&files.image)?;
    if found != picture {
        return Err(Error::ReferenceSize { path: files.image.clone(), size: found, picture });
    }
    let image = decode(&files.image)?.into_rgb8();
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
            let own = view.prior.as_ref();
            let correlation = own.and_then(|own| {
                let both = |i: usize| mask.as_raw()[i] == 0 && prior.values[i].is_finite() && own.values[i].is_finite();
                priors::rank_correlation(&prior.values, &own.values, both)
            });
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
    Ok((Reference { view: at, image, prior, truth: false }, note))
}

//! Photographs and their cameras: an existing COLMAP model (whose fisheyes [`super::lens`] resamples), nerfstudio's `transforms.json`, or photographs alone through
//! the `colmap` program.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs::File;
use std::io::Read as _;
use std::path::{Component, Path, PathBuf};
use std::process::{Command, ExitStatus};

use glam::{DMat3, DQuat, DVec3, dvec3};
use image::GrayImage;
use rand::RngExt;
use rand_pcg::Pcg64;
use serde::Deserialize;

use super::lens::{self, Pinhole};
use super::made::{Made, is_beside};
use super::program;
use super::record::{self, Batch, Inputs};
use super::{Error, Watch};
use crate::scene::{self, Camera, colmap, undistort};
use crate::statistics::median;

/// Where a scene keeps its photographs and its model.
pub const IMAGES: &str = "images";
pub(super) const MODEL: &str = "sparse/0";
/// COLMAP's numbers of its camera models.
const PINHOLE: u32 = 1;
const OPENCV: u32 = 4;
/// Kept as they are where a capture has them.
const TEST: [&str; 2] = ["test_images", "test_masks"];

/// What was given.
#[derive(Debug)]
pub struct Capture {
    folder: PathBuf,
    source: Source,
    /// Photographs by name: the path below their folder, without extension.
    pub photographs: BTreeMap<String, PathBuf>,
    /// Masks that came with the photographs, and whether they are 0 on the object.
    pub masks: BTreeMap<String, (PathBuf, bool)>,
    depths: BTreeMap<String, PathBuf>,
    /// What brings photographs of other lenses into a pinhole's picture of the same size.
    pinholes: BTreeMap<String, Pinhole>,
    /// Photographs whose path can be no name in a scene, and the names that they get.
    renamed: Vec<Renamed>,
}

/// A photograph and the name that it gets.
type Renamed = (PathBuf, String);

#[derive(Debug)]
enum Source {
    /// Files of a COLMAP model.
    Colmap(Vec<PathBuf>),
    Transforms {
        file: PathBuf,
        transforms: Box<Transforms>,
        /// Name of each frame's photograph.
        names: Vec<String>,
    },
    /// The folder of the photographs.
    Photographs(PathBuf),
}

/// nerfstudio's `transforms.json`, as far as it is read.
#[derive(Debug, Deserialize)]
struct Transforms {
    #[serde(flatten)]
    lens: Lens,
    camera_model: Option<String>,
    frames: Vec<Frame>,
    ply_file_path: Option<String>,
}

#[derive(Debug, Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    #[serde(flatten)]
    lens: Lens,
}

/// Intrinsics; those of a frame win over those of all.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct Lens {
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    camera_angle_x: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// A camera of OPENCV's model and a pose, as COLMAP writes them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Shot {
    /// The id of the photograph that a sparse model's tracks know, where there is one.
    pub id: Option<u32>,
    pub name: String,
    pub size: [u32; 2],
    /// fx fy cx cy k1 k2 p1 p2.
    pub parameters: [f64; 8],
    /// World to camera.
    pub rotation: DQuat,
    pub translation: DVec3,
}

/// Finds out what a folder of photographs comes with.
///
/// # Errors
/// No photographs; a `transforms.json` that cannot be read or names files that are not there.
pub fn find(folder: &Path) -> Result<Capture, Error> {
    if !folder.is_dir() {
        return Err(Error::File { path: folder.to_owned(), what: "there is no such folder".into() });
    }
    let transforms = folder.join("transforms.json");
    let made = Made::of(folder)?;
    let model = model_files(folder).filter(|files| !files.iter().any(|file| made.has(file)));
    if model.is_none() && transforms.is_file() {
        return from_transforms(folder, &transforms);
    }
    let mut found = None;
    for name in ["images", "images_2", "images_4", "images_8"] {
        let images = folder.join(name);
        let photographs = existing(&images)?;
        if photographs.values().any(|path| !made.has(path)) {
            found = Some((images, photographs));
            break;
        }
    }
    let (images, photographs) = match found {
        Some(found) => found,
        None => {
            let mut flat = scene::pictures(folder)?;
            flat.retain(|_, path| !made.has(path) && !is_beside(folder, path));
            (folder.to_owned(), flat)
        }
    };
    if photographs.is_empty() {
        return Err(scene::Error::NoImages { scene: folder.to_owned() }.into());
    }
    let masks = existing(&folder.join("masks"))?;
    let masks = masks.into_iter().map(|(name, path)| (name, (path, false))).collect();
    let pinholes = if model.is_some() { pinholes(folder, &photographs)? } else { BTreeMap::new() };
    let source = model.map_or(Source::Photographs(images), Source::Colmap);
    Ok(Capture {
        folder: folder.to_owned(),
        source,
        photographs,
        masks,
        depths: BTreeMap::new(),
        pinholes,
        renamed: vec![],
    })
}

/// The pinholes of the photographs whose lenses training does not project with.
fn pinholes(folder: &Path, photographs: &BTreeMap<String, PathBuf>) -> Result<BTreeMap<String, Pinhole>, Error> {
    let (lenses, images) = colmap::lenses(folder)?;
    let tests = existing(&folder.join(TEST[0]))?;
    let mut pinholes = BTreeMap::new();
    for image in images {
        let (name, lens) = (scene::stem(&image.name), lenses[&image.camera]);
        let photograph = photographs.get(name).or_else(|| tests.get(name));
        let Some(photograph) = photograph.filter(|_| lens.projected().is_none()) else { continue };
        let size = super::picture_size(photograph)?;
        let pinhole = Pinhole::of(lens::scaled(&lens, size)).ok_or_else(|| Error::File {
            path: photograph.clone(),
            what: format!(
                "no pinhole shows a part of this photograph alone: camera {} ({}) folds over; look at its parameters",
                image.camera, lens.model
            ),
        })?;
        pinholes.insert(name.to_owned(), pinhole);
    }
    Ok(pinholes)
}

fn existing(folder: &Path) -> Result<BTreeMap<String, PathBuf>, Error> {
    if folder.is_dir() { Ok(scene::pictures(folder)?) } else { Ok(BTreeMap::new()) }
}

/// The files of the model under `folder`, if there is one.
fn model_files(folder: &Path) -> Option<Vec<PathBuf>> {
    let (model, _) = colmap::folder(folder).ok()?;
    let stems = ["cameras", "images", "points3D"];
    let files = stems.iter().flat_map(|stem| ["bin", "txt", "ply"].map(|e| model.join(stem).with_extension(e)));
    Some(files.filter(|path| path.is_file()).collect())
}

/// A sentence on the parts of a capture, the largest first, of which the first alone is used.
fn left_out(parts: &[(PathBuf, usize)]) -> Option<String> {
    let ((largest, most), others) = parts.split_first().filter(|(_, others)| !others.is_empty())?;
    let name = |folder: &Path| format!("sparse/{}", folder.file_name().unwrap_or_default().to_string_lossy());
    let counts: Vec<String> = others.iter().map(|(folder, n)| format!("{} ({n})", name(folder))).collect();
    Some(format!(
        "COLMAP has made {} models that it could not join: {} is used, with {most} photographs, and not {}",
        parts.len(),
        name(largest),
        counts.join(", ")
    ))
}

impl Capture {
    /// Where the cameras come from, in words.
    pub fn origin(&self) -> String {
        match &self.source {
            Source::Colmap(_) => "the COLMAP model that came with the photographs".into(),
            Source::Transforms { file, .. } => format!("{}", file.display()),
            Source::Photographs(_) => "the program colmap, from the photographs alone".into(),
        }
    }

    /// A photograph's mask as the scene has it: resampled like the photograph, where that is.
    pub fn mask(&self, name: &str, mask: GrayImage) -> GrayImage {
        self.pinholes.get(name).map_or_else(|| mask.clone(), |pinhole| pinhole.mask(&mask))
    }

    /// Whether the scene has a photograph as another lens would have taken it.
    pub fn is_resampled(&self, name: &str) -> bool {
        self.pinholes.contains_key(name)
    }

    /// Whether the scene is to be made in the capture's own folder.
    fn in_place(&self, out: &Path) -> bool {
        let canonical = |path: &Path| path.canonicalize().ok();
        canonical(&self.folder).is_some_and(|own| canonical(out) == Some(own))
    }

    /// The hash of all that [`Capture::collect`] reads.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn inputs(&self) -> Result<String, Error> {
        let mut inputs = Inputs::default();
        let mut add = |name: &str, path: &Path| -> Result<(), Error> {
            inputs = std::mem::take(&mut inputs).with(name).with(record::hash(path)?);
            Ok(())
        };
        self.photographs.iter().chain(&self.depths).try_for_each(|(name, path)| add(name, path))?;
        match &self.source {
            Source::Colmap(files) => files.iter().try_for_each(|path| add("model", path))?,
            Source::Transforms { file, transforms, .. } => {
                add("transforms", file)?;
                if let Some(points) = &transforms.ply_file_path {
                    add("points", &self.folder.join(points))?;
                }
            }
            Source::Photographs(_) => {}
        }
        for folder in TEST {
            existing(&self.folder.join(folder))?.iter().try_for_each(|(name, path)| add(name, path))?;
        }
        Ok(inputs.finish())
    }

    /// The photographs and the model in the plain layout, for a scene in `out`.
    ///
    /// # Errors
    /// Unreadable files; poses that cannot be found.
    pub fn collect(&self, out: &Path, watch: &mut dyn Watch) -> Result<Batch, Error> {
        let mut batch = Batch::default();
        let in_place = self.in_place(out);
        if matches!(self.source, Source::Colmap(_)) {
            batch.notes.extend(left_out(&colmap::parts(&self.folder)));
        }
        if !self.pinholes.is_empty() {
            if in_place {
                let what = "the photographs are of lenses that are resampled, and the originals stay: make the scene in \
                            another folder, with --out";
                return Err(Error::File { path: out.to_owned(), what: what.into() });
            }
            if matches!(self.source, Source::Colmap(_)) {
                self.collect_resampled(&mut batch, watch)?;
                return Ok(batch);
            }
        }
        if !in_place || matches!(self.source, Source::Photographs(_) | Source::Transforms { .. }) {
            for (name, path) in &self.photographs {
                watch.go_on()?;
                if let Some(pinhole) = self.pinholes.get(name) {
                    let picture = pinhole.photograph(&scene::photograph(path, 1)?);
                    let from = format!("{}, resampled from {} to a pinhole", path.display(), pinhole.lens.model);
                    batch.rgb_aside(format!("{IMAGES}/{name}.png"), &picture, from)?;
                    continue;
                }
                let target = format!("{IMAGES}/{name}.{}", picture_extension(path));
                if out.join(&target).canonicalize().ok() != path.canonicalize().ok() || !out.join(&target).exists() {
                    batch.copy(target, path, "the photographs");
                }
            }
        }
        // A depth map is of its photograph's pixels.
        for (name, path) in self.depths.iter().filter(|(name, _)| !self.pinholes.contains_key(*name)) {
            let extension = path.extension().map_or_else(|| "png".into(), |e| e.to_string_lossy().to_lowercase());
            batch.copy(format!("depth/{name}.{extension}"), path, "transforms.json: depth_file_path");
        }
        if !in_place {
            for folder in TEST {
                for path in existing(&self.folder.join(folder))?.values() {
                    let below = path.strip_prefix(&self.folder).ok().and_then(record::key);
                    batch.copy(below.expect("the files of a folder lie below it"), path, "the photographs");
                }
            }
        }
        match &self.source {
            Source::Colmap(files) => {
                for path in files.iter().filter(|_| !in_place) {
                    let name = path.file_name().unwrap_or_default().to_string_lossy();
                    batch.copy(format!("{MODEL}/{name}"), path, self.origin());
                }
            }
            Source::Transforms { file, transforms, names } => {
                self.collect_transforms(file, transforms, names, &mut batch)?;
                if let Some((path, name)) = self.renamed.first() {
                    let count = self.renamed.len();
                    batch.notes.push(format!(
                        "{count} photographs lie elsewhere or have a name that a scene cannot list, and are copied under \
                         another (first: {} as {name})",
                        path.display()
                    ));
                }
                let lost = self.depths.keys().filter(|name| self.pinholes.contains_key(*name)).count();
                if let Some(pinhole) = self.pinholes.values().next() {
                    let (count, model) = (self.pinholes.len(), pinhole.lens.model);
                    batch.notes.push(format!("{count} photographs were resampled from {model} to pinholes"));
                }
                if lost > 0 {
                    batch.notes.push(format!("{lost} depth maps of resampled photographs were left out"));
                }
            }
            Source::Photographs(folder) => self.collect_colmap(folder, &mut batch, watch)?,
        }
        Ok(batch)
    }

    /// The photographs of a COLMAP model with lenses of which some are resampled: all of them, and a camera for each.
    fn collect_resampled(&self, batch: &mut Batch, watch: &mut dyn Watch) -> Result<(), Error> {
        let (lenses, images) = colmap::lenses(&self.folder)?;
        let [tests, test_masks] = TEST.map(|name| existing(&self.folder.join(name)));
        let (tests, test_masks) = (tests?, test_masks?);
        let mut shots = vec![];
        let mut models: Vec<&str> = vec![];
        for image in &images {
            watch.go_on()?;
            let (name, lens) = (scene::stem(&image.name), lenses[&image.camera]);
            let own = self.photographs.get(name).map(|path| (IMAGES, path));
            let Some((folder, path)) = own.or_else(|| Some((TEST[0], tests.get(name)?))) else { continue };
            let size = super::picture_size(path)?;
            let lens = lens::scaled(&lens, size);
            let axes = DMat3::from_cols_array_2d(&image.rotation).transpose();
            let mut shot = Shot {
                id: Some(image.id),
                name: name.to_owned(),
                size,
                parameters: [0.0; 8],
                rotation: DQuat::from_mat3(&axes).normalize(),
                translation: DVec3::from_array(image.translation),
            };
            let focal = match self.pinholes.get(name) {
                Some(pinhole) => {
                    let picture = pinhole.photograph(&scene::photograph(path, 1)?);
                    let from = format!("{}, resampled from {} to a pinhole", path.display(), lens.model);
                    batch.rgb_aside(format!("{folder}/{name}.png"), &picture, from)?;
                    models.push(lens.model);
                    pinhole.focal
                }
                None => {
                    batch.copy(format!("{folder}/{name}.{}", picture_extension(path)), path, "the photographs");
                    shot.parameters[4..].copy_from_slice(&lens.coefficients[..4]);
                    lens.focal
                }
            };
            shot.parameters[..2].copy_from_slice(&focal);
            shot.parameters[2..4].copy_from_slice(&lens.principal);
            shots.push(shot);
        }
        let origin = format!("{}, its lenses resampled", self.origin());
        for (name, bytes) in model_files_of(&shots) {
            batch.bytes(format!("{MODEL}/{name}"), bytes, origin.clone());
        }
        if let Source::Colmap(files) = &self.source {
            for path in files.iter().filter(|path| path.file_stem().is_some_and(|stem| stem == "points3D")) {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                batch.copy(format!("{MODEL}/{name}"), path, self.origin());
            }
        }
        let count = models.len();
        models.sort_unstable();
        models.dedup();
        batch.notes.push(format!("{count} photographs were resampled from {} to pinholes", models.join(", ")));
        for (name, path) in &test_masks {
            let mask = self.mask(name, scene::mask(path, 1)?);
            batch.gray(format!("{}/{name}.png", TEST[1]), &mask, format!("{}", path.display()));
        }
        Ok(())
    }

    fn collect_transforms(
        &self,
        file: &Path,
        transforms: &Transforms,
        names: &[String],
        batch: &mut Batch,
    ) -> Result<(), Error> {
        let mut shots = vec![];
        for (i, (frame, name)) in transforms.frames.iter().zip(names).enumerate() {
            let refuse =
                |what: String| Error::File { path: file.to_owned(), what: format!("frame {i} ({name}): {what}") };
            let picture = &self.photographs[name];
            let size = super::picture_size(picture)?;
            let fisheye = transforms.camera_model.as_deref() == Some("OPENCV_FISHEYE");
            let lens = taken_with(frame.lens, transforms.lens, fisheye, size).map_err(refuse)?;
            shots.push(shot(frame, name, &lens, self.pinholes.get(name)).map_err(refuse)?);
        }
        for (name, bytes) in model_files_of(&shots) {
            batch.bytes(format!("{MODEL}/{name}"), bytes, self.origin());
        }
        match &transforms.ply_file_path {
            Some(points) => {
                batch.copy(format!("{MODEL}/points3D.ply"), &self.folder.join(points), "transforms.json: ply_file_path")
            }
            None => {
                let text = random_points(&shots);
                batch.bytes(
                    format!("{MODEL}/points3D.txt"),
                    text.into_bytes(),
                    "drawn at random in front of the cameras",
                );
                batch.notes.push(
                    "transforms.json names no ply_file_path: the fit starts from random points in front of the cameras"
                        .into(),
                );
            }
        }
        Ok(())
    }

    /// Structure from motion by the `colmap` program, step by step and without a display.
    fn collect_colmap(&self, images: &Path, batch: &mut Batch, watch: &mut dyn Watch) -> Result<(), Error> {
        let work = tempfile::tempdir().map_err(|source| Error::Io { path: std::env::temp_dir(), source })?;
        let words = work.path().join("words.txt");
        if ask_colmap(&["help".into()], &words, watch)?.is_none() {
            return Err(Error::NoPoses { folder: self.folder.clone() });
        }
        let (database, models) = (work.path().join("database.db"), work.path().join("sparse"));
        std::fs::create_dir_all(&models).map_err(|source| Error::Io { path: models.clone(), source })?;
        let mut sizes = vec![];
        for path in self.photographs.values() {
            sizes.push(super::picture_size(path)?);
        }
        sizes.sort_unstable();
        sizes.dedup();
        if sizes.len() > 1 {
            batch.notes.push(format!(
                "the photographs have {} different sizes: each photograph gets a camera of its own",
                sizes.len()
            ));
        }
        let single = if sizes.len() == 1 { "1" } else { "0" };
        // Newer versions have renamed the options: what a version has is in its help.
        let without_gpu = |command: &str, names: [&'static str; 2], watch: &mut dyn Watch| -> Result<Vec<_>, Error> {
            ask_colmap(&[command.into(), "--help".into()], &words, watch)?;
            let text = program::said(&words)?;
            let known = names.into_iter().find(|name| text.contains(&name[2..]));
            Ok(known.into_iter().flat_map(|name| [OsString::from(name), "0".into()]).collect())
        };
        let run = |command: &str, arguments: &[OsString], watch: &mut dyn Watch| -> Result<(), Error> {
            let arguments = [&[command.into()], arguments].concat();
            if ask_colmap(&arguments, &words, watch)?.is_some_and(|status| status.success()) {
                return Ok(());
            }
            Err(Error::Colmap { command: command.to_owned(), what: program::last_said(&words)? })
        };
        let option = |name: &str, value: &std::ffi::OsStr| [OsString::from(name), value.to_owned()];
        let (database, models) = (option("--database_path", database.as_ref()), models);
        let pictures = option("--image_path", images.as_ref());
        // Below the photographs may lie masks and what the program has made.
        let list = work.path().join("photographs.txt");
        let names: Vec<String> = self
            .photographs
            .values()
            .filter_map(|path| Some(path.strip_prefix(images).ok()?.to_string_lossy().into_owned() + "\n"))
            .collect();
        std::fs::write(&list, names.concat()).map_err(|source| Error::Io { path: list.clone(), source })?;
        let listed = option("--image_list_path", list.as_ref());
        let camera = [
            option("--ImageReader.single_camera", single.as_ref()),
            option("--ImageReader.camera_model", "SIMPLE_RADIAL".as_ref()),
        ];
        watch.say("poses: features of the photographs (colmap feature_extractor)");
        let on_cpu =
            without_gpu("feature_extractor", ["--FeatureExtraction.use_gpu", "--SiftExtraction.use_gpu"], watch)?;
        run("feature_extractor", &[&database, &pictures, &listed, camera.as_flattened(), &on_cpu].concat(), watch)?;
        // All pairs, as long as there are not too many of them; then those of neighbouring names.
        let matcher = if self.photographs.len() <= 200 { "exhaustive_matcher" } else { "sequential_matcher" };
        watch.say(&format!("poses: matches between the photographs (colmap {matcher})"));
        let on_cpu = without_gpu(matcher, ["--FeatureMatching.use_gpu", "--SiftMatching.use_gpu"], watch)?;
        run(matcher, &[&database[..], &on_cpu].concat(), watch)?;
        watch.say("poses: cameras and points (colmap mapper)");
        let output = option("--output_path", models.as_ref());
        run("mapper", &[&database[..], &pictures, &output].concat(), watch)?;
        // The mapper may leave several models that it could not join.
        let found = std::fs::read_dir(&models).into_iter().flatten().flatten().filter_map(|entry| {
            // images.bin begins with how many there are.
            let count = std::fs::read(entry.path().join("images.bin")).ok()?.first_chunk().copied()?;
            Some((u64::from_le_bytes(count) as usize, entry.path()))
        });
        let Some((count, best)) = found.max() else {
            let what = "colmap found no cameras: the photographs need texture, sharpness and much overlap".into();
            return Err(Error::File { path: self.folder.clone(), what });
        };
        if count < self.photographs.len() {
            batch.notes.push(format!("colmap placed {count} of {} photographs", self.photographs.len()));
        }
        for name in ["cameras.bin", "images.bin", "points3D.bin"] {
            let path = best.join(name);
            let bytes = std::fs::read(&path).map_err(|source| Error::Io { path, source })?;
            batch.bytes(format!("{MODEL}/{name}"), bytes, self.origin());
        }
        Ok(())
    }
}

/// The extension under which a scene lists a photograph: its own in lower case, or that of its contents.
fn picture_extension(path: &Path) -> String {
    let own = path.extension().map_or_else(String::new, |e| e.to_string_lossy().to_lowercase());
    if scene::PICTURES.contains(&own.as_str()) {
        return own;
    }
    let guessed = image::ImageReader::open(path).and_then(image::ImageReader::with_guessed_format);
    let jpeg = guessed.is_ok_and(|reader| reader.format() == Some(image::ImageFormat::Jpeg));
    if jpeg { "jpg".into() } else { "png".into() }
}

/// Runs the program `colmap`: see [`program::ask`].
fn ask_colmap(arguments: &[OsString], words: &Path, watch: &mut dyn Watch) -> Result<Option<ExitStatus>, Error> {
    let mut command = Command::new("colmap");
    program::ask(command.args(arguments).env("QT_QPA_PLATFORM", "offscreen"), words, watch)
}

fn from_transforms(folder: &Path, file: &Path) -> Result<Capture, Error> {
    let refuse = |what: String| Error::File { path: file.to_owned(), what };
    let text = std::fs::read(file).map_err(|source| Error::Io { path: file.to_owned(), source })?;
    let transforms: Transforms =
        serde_json::from_slice(&text).map_err(|error| refuse(format!("not nerfstudio's transforms.json: {error}")))?;
    let fisheye = match transforms.camera_model.as_deref() {
        Some("OPENCV_FISHEYE") => true,
        None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => false,
        Some(model) => {
            let what = "undistort the photographs to OPENCV, OPENCV_FISHEYE or PINHOLE first";
            return Err(refuse(format!("camera_model is {model}; {what}")));
        }
    };
    if transforms.frames.is_empty() {
        return Err(refuse("there are no frames".into()));
    }
    let mut capture = Capture {
        folder: folder.to_owned(),
        source: Source::Photographs(folder.to_owned()),
        photographs: BTreeMap::new(),
        masks: BTreeMap::new(),
        depths: BTreeMap::new(),
        pinholes: BTreeMap::new(),
        renamed: vec![],
    };
    let below = |path: &str| {
        let plain = path.trim_start_matches("./");
        let given = folder.join(plain);
        // Some writers leave the extension out.
        let candidates = ["png", "jpg", "jpeg", "PNG", "JPG"].map(|e| {
            let mut name = given.clone().into_os_string();
            name.push(format!(".{e}"));
            PathBuf::from(name)
        });
        std::iter::once(given.clone()).chain(candidates).find(|path| path.is_file()).ok_or_else(|| {
            refuse(format!("{} is not there; paths are read below {}", given.display(), folder.display()))
        })
    };
    let pictures: Vec<PathBuf> =
        transforms.frames.iter().map(|frame| below(&frame.file_path)).collect::<Result<_, _>>()?;
    let (names, renamed) = names_of(folder, &pictures).map_err(refuse)?;
    for (i, ((frame, name), picture)) in transforms.frames.iter().zip(&names).zip(pictures).enumerate() {
        if let Some(path) = &frame.mask_path {
            // nerfstudio trains on what is not black: black is what is to be left out.
            capture.masks.insert(name.clone(), (below(path)?, true));
        }
        if let Some(path) = &frame.depth_file_path {
            capture.depths.insert(name.clone(), below(path)?);
        }
        let wrong = |what: &str| refuse(format!("frame {i} ({name}): {what}"));
        let lens = taken_with(frame.lens, transforms.lens, fisheye, super::picture_size(&picture)?);
        let lens = lens.map_err(|what| wrong(&what))?;
        if lens.projected().is_none() {
            let pinhole =
                Pinhole::of(lens).ok_or_else(|| wrong("its lens folds over: no pinhole shows a part of it alone"))?;
            capture.pinholes.insert(name.clone(), pinhole);
        }
        capture.photographs.insert(name.clone(), picture);
    }
    if let Some(points) = &transforms.ply_file_path {
        let path = folder.join(points);
        let mut first = [0; 4];
        let is_ply = path.is_file() && File::open(&path).and_then(|mut file| file.read_exact(&mut first)).is_ok();
        if !is_ply || &first[..3] != b"ply" {
            return Err(refuse(format!(
                "ply_file_path is {points:?}, which is no PLY file; leave it out or correct it"
            )));
        }
    }
    capture.renamed = renamed;
    capture.source = Source::Transforms { file: file.to_owned(), transforms: Box::new(transforms), names };
    Ok(capture)
}

/// The name of each picture in the scene, one for each, and which of them have another than their path below the folder,
/// with what they are called there.
///
/// A picture that lies elsewhere, or whose path a scene does not list, is called by the parts of its path that can be
/// names; what is called so already gets a number behind it.
fn names_of(folder: &Path, pictures: &[PathBuf]) -> Result<(Vec<String>, Vec<Renamed>), String> {
    let own = |picture: &PathBuf| -> Option<String> {
        let relative = record::key(picture.strip_prefix(folder).ok()?)?;
        let name = scene::stem(relative.strip_prefix("images/").unwrap_or(&relative));
        name.split('/').all(|part| safe_part(part) == part).then(|| name.to_owned())
    };
    let mut names: Vec<Option<String>> = pictures.iter().map(own).collect();
    let mut taken = BTreeSet::new();
    if let Some(twice) = names.iter().flatten().find(|name| !taken.insert(String::from(*name))) {
        return Err(format!("two frames show {twice}"));
    }
    let mut renamed = vec![];
    let mut shown = BTreeSet::new();
    if let Some(twice) = pictures.iter().find(|picture| !shown.insert(*picture)) {
        return Err(format!("two frames show {}", twice.display()));
    }
    for (name, picture) in names.iter_mut().zip(pictures).filter(|(name, _)| name.is_none()) {
        let path = picture.strip_prefix(folder).unwrap_or(picture);
        let parts = path.components().filter_map(|part| match part {
            Component::Normal(part) => Some(safe_part(&part.to_string_lossy())),
            _ => None,
        });
        let parts: Vec<String> = parts.filter(|part| !part.is_empty()).collect();
        let joined = parts.join("/");
        let wanted = Some(scene::stem(&joined)).filter(|stem| !stem.is_empty()).unwrap_or("frame").to_owned();
        let mut safe = wanted.clone();
        for number in 2.. {
            if !taken.contains(&safe) {
                break;
            }
            safe = format!("{wanted}_{number}");
        }
        taken.insert(safe.clone());
        renamed.push((picture.clone(), safe.clone()));
        *name = Some(safe);
    }
    Ok((names.into_iter().map(|name| name.expect("every picture has got a name")).collect(), renamed))
}

/// A folder's or file's name as a scene lists it and as a line of the model can hold it: neither hidden, nor with control
/// characters or blanks at its ends.
fn safe_part(part: &str) -> String {
    let plain: String = part.chars().map(|c| if c.is_control() { '_' } else { c }).collect();
    plain.trim().trim_start_matches('.').trim_start().to_owned()
}

/// The lens of a frame's photograph of this size: OPENCV's, its fisheye's, or with a third radial term FULL_OPENCV's.
fn taken_with(own: Lens, all: Lens, fisheye: bool, size: [u32; 2]) -> Result<colmap::Lens, String> {
    let (w, h) = (f64::from(size[0]), f64::from(size[1]));
    let given = [own.w.or(all.w).unwrap_or(w), own.h.or(all.h).unwrap_or(h)];
    let angle = own.camera_angle_x.or(all.camera_angle_x).map(|angle| given[0] / (2.0 * (angle / 2.0).tan()));
    let fx = own.fl_x.or(own.fl_y).or(all.fl_x).or(all.fl_y).or(angle).ok_or("no fl_x and no camera_angle_x")?;
    let fy = own.fl_y.or(own.fl_x).or(all.fl_y).unwrap_or(fx);
    let of = |pick: fn(&Lens) -> Option<f64>| pick(&own).or_else(|| pick(&all));
    let or_0 = |pick: fn(&Lens) -> Option<f64>| of(pick).unwrap_or(0.0);
    // Intrinsics may be those of larger photographs.
    let scale = [w / given[0], h / given[1]];
    let [k1, k2, k3, k4] = [or_0(|l| l.k1), or_0(|l| l.k2), or_0(|l| l.k3), or_0(|l| l.k4)];
    let [p1, p2] = [or_0(|l| l.p1), or_0(|l| l.p2)];
    let (model, used) = match fisheye {
        true => ("OPENCV_FISHEYE", [k1, k2, k3, k4, 0.0]),
        false if k3 != 0.0 => ("FULL_OPENCV", [k1, k2, p1, p2, k3]),
        false => ("OPENCV", [k1, k2, p1, p2, 0.0]),
    };
    let mut coefficients = [0.0; 12];
    coefficients[..5].copy_from_slice(&used);
    let principal = [of(|l| l.cx).unwrap_or(given[0] / 2.0), of(|l| l.cy).unwrap_or(given[1] / 2.0)];
    Ok(colmap::Lens {
        model,
        focal: [fx * scale[0], fy * scale[1]],
        principal: [principal[0] * scale[0], principal[1] * scale[1]],
        coefficients,
        size,
    })
}

/// A frame's camera, with the pinhole that its photograph is resampled to: nerfstudio's poses are camera to world with
/// OpenGL's axes (y up, z backward).
fn shot(frame: &Frame, name: &str, lens: &colmap::Lens, pinhole: Option<&Pinhole>) -> Result<Shot, String> {
    let [cx, cy] = lens.principal;
    let parameters = match pinhole {
        Some(Pinhole { focal: [fx, fy], .. }) => [*fx, *fy, cx, cy, 0.0, 0.0, 0.0, 0.0],
        None => {
            let ([fx, fy], [k1, k2, p1, p2, ..]) = (lens.focal, lens.coefficients);
            [fx, fy, cx, cy, k1, k2, p1, p2]
        }
    };
    let rows: Vec<&Vec<f64>> = frame.transform_matrix.iter().take(3).collect();
    if rows.len() < 3 || rows.iter().any(|row| row.len() != 4 || row.iter().any(|v| !v.is_finite())) {
        return Err("transform_matrix is not 4 x 4 numbers".into());
    }
    let column = |k: usize| dvec3(rows[0][k], rows[1][k], rows[2][k]);
    let axes = DMat3::from_cols(column(0), -column(1), -column(2));
    if (axes.determinant() - 1.0).abs() > 1e-3 {
        return Err("transform_matrix does not hold a rotation".into());
    }
    let rotation = DQuat::from_mat3(&axes).normalize().inverse();
    let translation = -(rotation * column(3));
    Ok(Shot { id: None, name: name.to_owned(), size: lens.size, parameters, rotation, translation })
}

/// `cameras.bin` and `images.bin` with these names and cameras.
pub(crate) fn model_of<'a>(cameras: impl Iterator<Item = (&'a str, &'a Camera)>) -> [(&'static str, Vec<u8>); 2] {
    let shots: Vec<Shot> = cameras
        .map(|(name, camera)| {
            let axes = camera.rotation.map(|row| DVec3::from_array(row.map(f64::from)));
            let of = |[a, b]: [f32; 2]| [f64::from(a), f64::from(b)];
            let ([fx, fy], [cx, cy]) = (of(camera.focal), of(camera.principal));
            let [k1, k2, p1, p2] = camera.distortion.map(f64::from);
            Shot {
                id: None,
                name: name.to_owned(),
                size: camera.size,
                parameters: [fx, fy, cx, cy, k1, k2, p1, p2],
                rotation: DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2]).transpose()).normalize(),
                translation: DVec3::from_array(camera.translation),
            }
        })
        .collect();
    model_files_of(&shots)
}

/// `cameras.bin` and `images.bin`, a camera for each photograph: unlike lines of text they hold any name.
pub(super) fn model_files_of(shots: &[Shot]) -> [(&'static str, Vec<u8>); 2] {
    let count = (shots.len() as u64).to_le_bytes().to_vec();
    let (mut cameras, mut images) = (count.clone(), count);
    for (id, shot) in (1u32..).zip(shots) {
        let Shot { id: known, name, size, parameters, rotation: q, translation: t } = shot;
        let straight = parameters[4..].iter().all(|v| *v == 0.0);
        let (model, used) = if straight { (PINHOLE, 4) } else { (OPENCV, 8) };
        [id, model].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
        size.iter().for_each(|v| cameras.extend(u64::from(*v).to_le_bytes()));
        parameters[..used].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
        images.extend(known.unwrap_or(id).to_le_bytes());
        [q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().for_each(|v| images.extend(v.to_le_bytes()));
        images.extend(id.to_le_bytes());
        images.extend(name.bytes());
        // The end of the name, and no observations.
        images.extend([0; 9]);
    }
    [("cameras.bin", cameras), ("images.bin", images)]
}

/// How many points are drawn where a capture has none.
const RANDOM_POINTS: u32 = 20_000;

/// `points3D.txt` with points on the rays of random pixels, their disparities uniform about that of what the cameras look
/// at: the point nearest to all optical axes.
fn random_points(shots: &[Shot]) -> String {
    let center = |shot: &Shot| -(shot.rotation.inverse() * shot.translation);
    let axis = |shot: &Shot| shot.rotation.inverse() * DVec3::Z;
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for shot in shots {
        let d = axis(shot);
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * center(shot);
    }
    let mean = shots.iter().map(center).sum::<DVec3>() / shots.len() as f64;
    let spread = shots.iter().map(|shot| (center(shot) - mean).length()).fold(0.0, f64::max);
    let focus = normal.inverse() * right;
    let depth = median(shots.iter().map(|shot| (focus - center(shot)).dot(axis(shot)))).unwrap_or(0.0);
    // Cameras that look past each other have no such point: what they see is then a few times as far as they stand apart.
    let depth = if depth.is_finite() && depth > 0.1 * spread { depth } else { 4.0 * spread.max(1e-3) };
    let mut rng = Pcg64::new(0, 11);
    let mut text = String::new();
    for id in 1..=RANDOM_POINTS {
        let shot = &shots[rng.random_range(0..shots.len())];
        let [fx, fy, cx, cy, lens @ ..] = shot.parameters;
        let pixel: [f64; 2] = std::array::from_fn(|i| rng.random_range(0.0..f64::from(shot.size[i])));
        let Some([x, y]) = undistort([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy], lens) else { continue };
        let z = depth / rng.random_range(0.25..2.5);
        let p = shot.rotation.inverse() * (dvec3(x * z, y * z, z) - shot.translation);
        writeln!(text, "{id} {} {} {} 128 128 128 0", p.x, p.y, p.z).expect("a string takes everything");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(json: &str) -> Frame {
        serde_json::from_str(json).unwrap()
    }

    /// Of photographs of 40 x 30 pixels that need no resampling.
    fn plain(frame: &Frame, all: Lens) -> Result<Shot, String> {
        shot(frame, "a", &taken_with(frame.lens, all, false, [40, 30])?, None)
    }

    /// A camera at (1, 2, 3) with OpenGL's axes along the world's looks along -z: what stands before it at (1, 2, 0) is at
    /// depth 3 in the middle, and what is above it in the world is above it in the picture, at a smaller row.
    #[test]
    fn axes_are_turned() {
        let frame = frame(
            r#"{"file_path": "a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]], "fl_x": 50}"#,
        );
        let shot = plain(&frame, Lens::default()).unwrap();
        let seen = |p: DVec3| shot.rotation * p + shot.translation;
        assert!((seen(dvec3(1.0, 2.0, 0.0)) - dvec3(0.0, 0.0, 3.0)).length() < 1e-12);
        assert!((seen(dvec3(1.5, 2.0, 0.0)) - dvec3(0.5, 0.0, 3.0)).length() < 1e-12);
        assert!((seen(dvec3(1.0, 2.5, 0.0)) - dvec3(0.0, -0.5, 3.0)).length() < 1e-12);
        assert_eq!(shot.parameters, [50.0, 50.0, 20.0, 15.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn intrinsics_are_scaled_and_a_frames_own_win() {
        let all: Lens = serde_json::from_str(r#"{"w": 80, "h": 60, "fl_x": 100, "cx": 44, "k1": 0.1}"#).unwrap();
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
        let own = frame(&format!(r#"{{"file_path": "a", "transform_matrix": {pose}, "k1": 0.2}}"#));
        let shot_of = |frame: &Frame| plain(frame, all);
        assert_eq!(shot_of(&own).unwrap().parameters, [50.0, 50.0, 22.0, 15.0, 0.2, 0.0, 0.0, 0.0]);
        let angle: Lens = serde_json::from_str(r#"{"camera_angle_x": 1.5707963267948966}"#).unwrap();
        assert!((plain(&own, angle).unwrap().parameters[0] - 20.0).abs() < 1e-12);
        for (json, what) in [
            (r#"{"file_path": "a", "transform_matrix": [[1,0,0],[0,1,0],[0,0,1]]}"#, "4 x 4"),
            (r#"{"file_path": "a", "transform_matrix": [[2,0,0,0],[0,1,0,0],[0,0,1,0]]}"#, "rotation"),
        ] {
            assert!(shot_of(&frame(json)).unwrap_err().contains(what), "{json}");
        }
        assert!(plain(&own, Lens::default()).unwrap_err().contains("fl_x"));
    }

    /// What the model calls k3 is another term in each.
    #[test]
    fn lenses_are_told_apart() {
        let all: Lens = serde_json::from_str(r#"{"fl_x": 20, "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}"#).unwrap();
        let of = |fisheye| taken_with(Lens::default(), all, fisheye, [40, 30]).unwrap();
        assert_eq!((of(true).model, &of(true).coefficients[..5]), ("OPENCV_FISHEYE", &[0.1, 0.2, 0.3, 0.4, 0.0][..]));
        assert_eq!((of(false).model, &of(false).coefficients[..5]), ("FULL_OPENCV", &[0.1, 0.2, 0.0, 0.0, 0.3][..]));
        assert!(of(true).projected().is_none() && of(false).projected().is_none());
        let straight = taken_with(Lens { k3: None, ..all }, Lens::default(), false, [40, 30]).unwrap();
        assert!(straight.projected().is_some());
    }

    #[test]
    fn random_points_stand_before_the_cameras() {
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
        let frame = frame(&format!(r#"{{"file_path": "a", "transform_matrix": {pose}, "fl_x": 40}}"#));
        let shot = plain(&frame, Lens::default()).unwrap();
        let text = random_points(std::slice::from_ref(&shot));
        assert_eq!(text.lines().count(), RANDOM_POINTS as usize);
        for line in text.lines() {
            let v: Vec<f64> = line.split(' ').skip(1).take(3).map(|word| word.parse().unwrap()).collect();
            let p = shot.rotation * dvec3(v[0], v[1], v[2]) + shot.translation;
            assert!(p.z > 0.0 && (p.x / p.z).abs() < 0.5 + 1e-9 && (p.y / p.z).abs() < 0.375 + 1e-9, "{line}");
        }
    }
}

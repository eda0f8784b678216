//! COLMAP's sparse models, binary and text: cameras, poses and points.
//!
//! The format is the one documented in COLMAP's manual ("Output Format"). The 2D observations are skipped.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

use ply_rs_bw::ply::{PropertyType, ScalarType};

use super::{Error, Point};

/// A camera of the model, as written: the size is that of the photographs COLMAP saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// fx, fy in pixels.
    pub focal: [f64; 2],
    /// cx, cy in pixels; the centre of the first pixel is at 0.5.
    pub principal: [f64; 2],
    /// k1, k2, p1, p2.
    pub distortion: [f64; 4],
    /// Width, height in pixels.
    pub size: [u32; 2],
}

/// A camera of any model of COLMAP's, as written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// The model's name.
    pub model: &'static str,
    /// fx, fy in pixels.
    pub focal: [f64; 2],
    /// cx, cy in pixels; the centre of the first pixel is at 0.5.
    pub principal: [f64; 2],
    /// What else the model has, in COLMAP's order, and zeros.
    pub coefficients: [f64; 12],
    /// Width, height in pixels.
    pub size: [u32; 2],
}

/// Lenses by COLMAP's camera id.
pub type Lenses = BTreeMap<u32, Lens>;

/// A registered photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// The id that tracks name it by.
    pub id: u32,
    /// The file name as the model has it, extension and folders included.
    pub name: String,
    /// World to camera rotation, row-major.
    pub rotation: [[f64; 3]; 3],
    /// World to camera translation.
    pub translation: [f64; 3],
    /// Key into [`Model::cameras`].
    pub camera: u32,
}

impl Image {
    /// The camera's position in the world.
    pub fn center(&self) -> [f64; 3] {
        std::array::from_fn(|i| -(0..3).map(|k| self.rotation[k][i] * self.translation[k]).sum::<f64>())
    }
}

/// The photographs that each point was found in.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tracks {
    /// `[point]` one past its last photograph in `images`.
    ends: Vec<usize>,
    images: Vec<u32>,
}

impl Tracks {
    /// Adds the next point's, by the ids of its photographs.
    pub fn push(&mut self, images: impl IntoIterator<Item = u32>) {
        self.images.extend(images);
        self.ends.push(self.images.len());
    }

    /// The ids of the photographs of a point, one of them several times where it was found there several times.
    pub fn of(&self, point: usize) -> &[u32] {
        let first = point.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.images[first..self.ends[point]]
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// True where no point has a photograph: another program's model, say, or points from a PLY file.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }
}

/// A sparse model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// Cameras by COLMAP's camera id.
    pub cameras: BTreeMap<u32, Intrinsics>,
    /// Registered photographs in the file's order.
    pub images: Vec<Image>,
    /// Sparse points in the file's order.
    pub points: Vec<Point>,
    /// Where each of them was found.
    pub tracks: Tracks,
}

/// Points and their tracks.
type Points = (Vec<Point>, Tracks);

const SUPPORTED: &str = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV";

/// COLMAP's camera models by id: name and number of parameters.
const MODELS: [(&str, usize); 12] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

/// How many of [`MODELS`] this crate projects with; the rest are refused by name.
const PROJECTED: usize = 5;

/// Finite in float32 too, in which the device has it.
fn is_finite(v: f64) -> bool {
    (v as f32).is_finite()
}

/// How many of [`MODELS`] [`Lens`] has room for.
const READ: usize = 11;

impl Lens {
    /// From the parameters of one of the first [`READ`] models.
    fn new(model: usize, p: &[f64], size: [u32; 2]) -> Self {
        let (focal, rest) = match model {
            0 | 2 | 3 | 8 | 9 => ([p[0], p[0]], &p[1..]),
            _ => ([p[0], p[1]], &p[2..]),
        };
        let mut coefficients = [0.0; 12];
        coefficients[..rest.len() - 2].copy_from_slice(&rest[2..]);
        Self { model: MODELS[model].0, focal, principal: [rest[0], rest[1]], coefficients, size }
    }

    /// One clause on what makes the camera unusable, if anything does.
    fn fault(&self) -> Option<String> {
        let finite = self.focal.iter().chain(&self.principal).chain(&self.coefficients).all(|v| is_finite(*v));
        if !finite {
            Some("a parameter is not a finite number".into())
        } else if self.focal.iter().any(|f| *f <= 0.0 || !(*f as f32).is_normal()) {
            Some(format!("the focal length is {} x {} pixels, it must be positive", self.focal[0], self.focal[1]))
        } else if self.size.contains(&0) {
            Some(format!("the size is {} x {} pixels", self.size[0], self.size[1]))
        } else {
            None
        }
    }

    /// The camera, if it is of a model that this crate projects with.
    pub fn projected(&self) -> Option<Intrinsics> {
        let Self { focal, principal, size, .. } = *self;
        let [k1, k2, p1, p2, ..] = self.coefficients;
        let known = MODELS[..PROJECTED].iter().any(|model| model.0 == self.model);
        known.then_some(Intrinsics { focal, principal, distortion: [k1, k2, p1, p2], size })
    }
}

/// The rotation matrix of a quaternion (w, x, y, z) of any length; `None` if it has no direction.
fn rotation(q: [f64; 4]) -> Option<[[f64; 3]; 3]> {
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !norm.is_finite() || norm < 1e-12 {
        return None;
    }
    let [w, x, y, z] = q.map(|v| v / norm);
    Some([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ])
}

/// Finds and reads the model under `scene`: of `sparse/0`, `sparse/1` and so on the largest, else `sparse`. Cameras and images
/// are binary where `cameras.bin` is, else text; points come from `points3D.bin`, `.txt` or `.ply`, the first that holds any.
///
/// # Errors
/// No model, an unreadable or truncated file, an unsupported camera model, unusable numbers, no points.
pub fn read(scene: &Path) -> Result<Model, Error> {
    let (folder, cameras, images) = cameras_and_images(scene, PROJECTED)?;
    let cameras = cameras.into_iter().filter_map(|(id, lens)| Some((id, lens.projected()?))).collect();
    let mut model = Model { cameras, images, ..Model::default() };
    for (name, read) in [
        ("points3D.bin", binary_points as fn(&Path) -> Result<Points, Error>),
        ("points3D.txt", text_points),
        ("points3D.ply", ply_points),
    ] {
        let path = folder.join(name);
        if path.is_file() {
            (model.points, model.tracks) = read(&path)?;
            if !model.points.is_empty() {
                return Ok(model);
            }
        }
    }
    Err(Error::NoPoints { folder })
}

/// The cameras and photographs of the model under `scene`, whatever lenses it has.
///
/// # Errors
/// As [`read`], points apart; a camera model that not even its name is known of.
pub fn lenses(scene: &Path) -> Result<(Lenses, Vec<Image>), Error> {
    cameras_and_images(scene, READ).map(|(_, cameras, images)| (cameras, images))
}

/// The extension of a model's cameras and images, if `folder` has one.
fn extension(folder: &Path) -> Option<&'static str> {
    let has = |extension: &str| {
        ["cameras", "images"].iter().all(|stem| folder.join(stem).with_extension(extension).is_file())
    };
    ["bin", "txt"].into_iter().find(|e| has(e))
}

/// The models that a mapper has made of the parts of a capture that it could not join, `sparse/0`, `sparse/1` and so on, and
/// how many photographs each has: the largest first, of equals the first. Of one alone the photographs are not counted.
pub(crate) fn parts(scene: &Path) -> Vec<(PathBuf, usize)> {
    let numbered =
        |entry: fs::DirEntry| entry.file_name().to_str()?.parse::<u32>().ok().map(|number| (number, entry.path()));
    let mut folders: Vec<_> =
        fs::read_dir(scene.join("sparse")).into_iter().flatten().flatten().filter_map(numbered).collect();
    folders.sort();
    let mut parts: Vec<(PathBuf, usize)> =
        folders.into_iter().filter(|(_, folder)| extension(folder).is_some()).map(|(_, folder)| (folder, 0)).collect();
    if parts.len() > 1 {
        for (folder, count) in &mut parts {
            *count = photographs(folder).unwrap_or(0);
        }
        parts.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    }
    parts
}

/// How many photographs the model in `folder` has. A binary file begins with it: its tracks are not read for that.
///
/// # Errors
/// A file that cannot be read.
fn photographs(folder: &Path) -> Result<usize, Error> {
    let binary = folder.join("images.bin");
    if binary.is_file() {
        return Ok(Binary::open(&binary)?.u64(&|| "the count".into())? as usize);
    }
    Ok(text_images(&folder.join("images.txt"))?.len())
}

/// The model's folder under `scene`, which may be `scene` itself, and the extension of its cameras and images. Of several parts
/// it is the largest.
///
/// # Errors
/// No model.
pub(crate) fn folder(scene: &Path) -> Result<(PathBuf, &'static str), Error> {
    let folders = parts(scene).into_iter().map(|(folder, _)| folder).chain([scene.join("sparse"), scene.to_owned()]);
    let found = folders.into_iter().find_map(|folder| extension(&folder).map(|extension| (folder, extension)));
    found.ok_or_else(|| Error::NoModel { scene: scene.to_path_buf() })
}

/// The model's folder, its cameras, which must be of the first `models`, and its photographs.
fn cameras_and_images(scene: &Path, models: usize) -> Result<(PathBuf, Lenses, Vec<Image>), Error> {
    let (folder, extension) = folder(scene)?;
    let (cameras, images) =
        (folder.join("cameras").with_extension(extension), folder.join("images").with_extension(extension));
    let (lenses, photographs) = if extension == "bin" {
        (binary_cameras(&cameras, models)?, binary_images(&images)?)
    } else {
        (text_cameras(&cameras, models)?, text_images(&images)?)
    };
    for image in &photographs {
        if !lenses.contains_key(&image.camera) {
            let what = format!("image {} uses camera {}, which {} lacks", image.name, image.camera, cameras.display());
            return Err(Error::File { path: images, what });
        }
    }
    Ok((folder, lenses, photographs))
}

// ---------------------------------------------------------------- binary

/// A little-endian reader that knows where it is, so that a truncated file can be reported by byte and record.
struct Binary<'a> {
    path: &'a Path,
    input: BufReader<File>,
    offset: u64,
}

impl<'a> Binary<'a> {
    fn open(path: &'a Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|source| Error::Io { path: path.to_path_buf(), source })?;
        Ok(Binary { path, input: BufReader::with_capacity(1 << 16, file), offset: 0 })
    }

    /// `record` says what was being read, for the message if the file ends first.
    fn bytes<const N: usize>(&mut self, record: &dyn Fn() -> String) -> Result<[u8; N], Error> {
        let mut buffer = [0; N];
        self.input.read_exact(&mut buffer).map_err(|e| self.failed(e, record))?;
        self.offset += N as u64;
        Ok(buffer)
    }

    fn failed(&self, source: io::Error, record: &dyn Fn() -> String) -> Error {
        let path = self.path.to_path_buf();
        if source.kind() != io::ErrorKind::UnexpectedEof {
            return Error::Io { path, source };
        }
        let length = std::fs::metadata(self.path).map_or(self.offset, |m| m.len());
        Error::Truncated { path, length, offset: self.offset, record: record() }
    }

    fn u32(&mut self, record: &dyn Fn() -> String) -> Result<u32, Error> {
        self.bytes(record).map(u32::from_le_bytes)
    }

    fn u64(&mut self, record: &dyn Fn() -> String) -> Result<u64, Error> {
        self.bytes(record).map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, record: &dyn Fn() -> String) -> Result<[f64; N], Error> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = f64::from_le_bytes(self.bytes(record)?);
        }
        Ok(out)
    }

    fn skip(&mut self, count: u64, each: u64, record: &dyn Fn() -> String) -> Result<(), Error> {
        let wanted = count.saturating_mul(each);
        let copied =
            io::copy(&mut self.input.by_ref().take(wanted), &mut io::sink()).map_err(|e| self.failed(e, record))?;
        self.offset += copied;
        if copied < wanted {
            return Err(self.failed(io::ErrorKind::UnexpectedEof.into(), record));
        }
        Ok(())
    }

    fn invalid(&self, what: String) -> Error {
        Error::File { path: self.path.to_path_buf(), what }
    }

    /// Bytes after the last record mean that the counts are not those of this file.
    fn finish(mut self) -> Result<(), Error> {
        let rest = io::copy(&mut self.input, &mut io::sink())
            .map_err(|source| Error::Io { path: self.path.to_path_buf(), source })?;
        if rest > 0 {
            let at = self.offset;
            return Err(
                self.invalid(format!("{rest} bytes follow the last record (at byte {at}); export the model again"))
            );
        }
        Ok(())
    }
}

fn checked_size(width: u64, height: u64) -> Option<[u32; 2]> {
    Some([u32::try_from(width).ok()?, u32::try_from(height).ok()?])
}

fn binary_cameras(path: &Path, models: usize) -> Result<Lenses, Error> {
    let mut file = Binary::open(path)?;
    let count = file.u64(&|| "the number of cameras".into())?;
    let mut cameras = BTreeMap::new();
    for i in 0..count {
        let record = || format!("camera {} of {count}", i + 1);
        let id = file.u32(&record)?;
        let model = file.u32(&record)?;
        let (width, height) = (file.u64(&record)?, file.u64(&record)?);
        if model as usize >= models {
            let name = MODELS.get(model as usize).map_or_else(|| format!("model number {model}"), |m| m.0.to_string());
            return Err(Error::CameraModel { path: path.to_path_buf(), id, model: name, hint: unsupported_hint() });
        }
        let mut parameters = [0.0; 12];
        let used = MODELS[model as usize].1;
        for p in &mut parameters[..used] {
            [*p] = file.f64s(&record)?;
        }
        let size = checked_size(width, height)
            .ok_or_else(|| file.invalid(format!("camera {id} is {width} x {height} pixels large")))?;
        let camera = Lens::new(model as usize, &parameters[..used], size);
        if let Some(fault) = camera.fault() {
            return Err(file.invalid(format!("camera {id}: {fault}")));
        }
        if cameras.insert(id, camera).is_some() {
            return Err(file.invalid(format!("camera {id} is there twice")));
        }
    }
    file.finish()?;
    Ok(cameras)
}

fn binary_images(path: &Path) -> Result<Vec<Image>, Error> {
    let mut file = Binary::open(path)?;
    let count = file.u64(&|| "the number of images".into())?;
    let mut images = Vec::new();
    for i in 0..count {
        let record = || format!("image {} of {count}", i + 1);
        let id = file.u32(&record)?;
        let quaternion = file.f64s(&record)?;
        let translation: [f64; 3] = file.f64s(&record)?;
        let camera = file.u32(&record)?;
        let mut name = Vec::new();
        loop {
            match file.bytes(&record)? {
                [0] => break,
                [byte] => name.push(byte),
            }
        }
        let name = String::from_utf8(name).map_err(|_| file.invalid(format!("the name of image {id} is not UTF-8")))?;
        let named = || format!("{} ({name})", record());
        let observations = file.u64(&named)?;
        file.skip(observations, 24, &named)?;
        let image = pose(id, name.clone(), quaternion, translation, camera);
        images.push(
            image.ok_or_else(|| file.invalid(format!("the pose of image {name} is not a rotation and a shift")))?,
        );
    }
    file.finish()?;
    Ok(images)
}

fn pose(id: u32, name: String, quaternion: [f64; 4], translation: [f64; 3], camera: u32) -> Option<Image> {
    let finite = translation.iter().all(|v| is_finite(*v));
    rotation(quaternion).filter(|_| finite).map(|rotation| Image { id, name, rotation, translation, camera })
}

fn binary_points(path: &Path) -> Result<Points, Error> {
    let mut file = Binary::open(path)?;
    let count = file.u64(&|| "the number of points".into())?;
    let (mut points, mut tracks) = Points::default();
    let mut track = vec![];
    for i in 0..count {
        let record = || format!("point {} of {count}", i + 1);
        let id = file.u64(&record)?;
        let position: [f64; 3] = file.f64s(&record)?;
        let color = file.bytes(&record)?;
        let _reprojection_error: [f64; 1] = file.f64s(&record)?;
        track.clear();
        for _ in 0..file.u64(&record)? {
            track.push(file.u32(&record)?);
            let _place_in_the_photograph = file.u32(&record)?;
        }
        tracks.push(track.iter().copied());
        points.push(
            point(position, color).ok_or_else(|| file.invalid(format!("point {id} is not at a finite position")))?,
        );
    }
    file.finish()?;
    Ok((points, tracks))
}

fn point(position: [f64; 3], color: [u8; 3]) -> Option<Point> {
    let position = position.map(|v| v as f32);
    position.iter().all(|v| v.is_finite()).then_some(Point { position, color })
}

// ---------------------------------------------------------------- text

/// The lines of a text file that are neither blank nor comments, with their numbers from 1; `keep_blank` keeps blank ones.
fn lines(text: &str, keep_blank: bool) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line.trim()))
        .filter(move |(_, line)| !line.starts_with('#') && (keep_blank || !line.is_empty()))
}

fn read_text(path: &Path) -> Result<String, Error> {
    std::fs::read_to_string(path).map_err(|source| Error::Io { path: path.to_path_buf(), source })
}

/// The fields of one line, with errors that name the field.
struct Fields<'a> {
    path: &'a Path,
    line: usize,
    rest: &'a str,
}

impl<'a> Fields<'a> {
    fn next<T: std::str::FromStr>(&mut self, name: &str) -> Result<T, Error> {
        let (word, rest) = self.rest.split_once(char::is_whitespace).unwrap_or((self.rest, ""));
        self.rest = rest.trim_start();
        if word.is_empty() {
            return Err(self.invalid(format!("the line ends before {name}")));
        }
        word.parse().map_err(|_| self.invalid(format!("{name} cannot be '{word}'")))
    }

    fn array<const N: usize>(&mut self, names: [&str; N]) -> Result<[f64; N], Error> {
        let mut out = [0.0; N];
        for (v, name) in out.iter_mut().zip(names) {
            *v = self.next(name)?;
        }
        Ok(out)
    }

    fn invalid(&self, what: String) -> Error {
        Error::Text { path: self.path.to_path_buf(), line: self.line, what }
    }
}

fn text_cameras(path: &Path, models: usize) -> Result<Lenses, Error> {
    let text = read_text(path)?;
    let mut cameras = BTreeMap::new();
    for (line, rest) in lines(&text, false) {
        let mut fields = Fields { path, line, rest };
        let id: u32 = fields.next("the camera id")?;
        let name: String = fields.next("the camera model")?;
        let size = [fields.next("the width")?, fields.next("the height")?];
        let Some(model) = MODELS[..models].iter().position(|m| m.0 == name) else {
            return Err(Error::CameraModel { path: path.to_path_buf(), id, model: name, hint: unsupported_hint() });
        };
        let mut parameters = [0.0; 12];
        let used = MODELS[model].1;
        for (i, p) in parameters[..used].iter_mut().enumerate() {
            *p = fields.next(&format!("parameter {} of {used}", i + 1))?;
        }
        if !fields.rest.is_empty() {
            return Err(fields.invalid(format!("{name} has {used} parameters, '{}' is left over", fields.rest)));
        }
        let camera = Lens::new(model, &parameters[..used], size);
        if let Some(fault) = camera.fault() {
            return Err(fields.invalid(format!("camera {id}: {fault}")));
        }
        if cameras.insert(id, camera).is_some() {
            return Err(fields.invalid(format!("camera {id} is there twice")));
        }
    }
    Ok(cameras)
}

fn text_images(path: &Path) -> Result<Vec<Image>, Error> {
    let text = read_text(path)?;
    let mut images = Vec::new();
    let mut all = lines(&text, true);
    while let Some((line, rest)) = all.next() {
        if rest.is_empty() {
            continue;
        }
        let mut fields = Fields { path, line, rest };
        let id = fields.next("the image id")?;
        let quaternion = fields.array(["QW", "QX", "QY", "QZ"])?;
        let translation = fields.array(["TX", "TY", "TZ"])?;
        let camera = fields.next("the camera id")?;
        let name = fields.rest.to_string();
        if name.is_empty() {
            return Err(fields.invalid("the line ends before the image name".into()));
        }
        let image = pose(id, name, quaternion, translation, camera);
        images.push(image.ok_or_else(|| fields.invalid("the pose is not a rotation and a shift".into()))?);
        // The second line of an image lists its 2D points, three numbers each; it may be empty but not left out.
        if let Some((line, observations)) = all.next()
            && observations.split_whitespace().count() % 3 != 0
        {
            let what = "this should be the 2D points of the image above, three numbers each, or an empty line".into();
            return Err(Error::Text { path: path.to_path_buf(), line, what });
        }
    }
    Ok(images)
}

fn text_points(path: &Path) -> Result<Points, Error> {
    let text = read_text(path)?;
    let (mut points, mut tracks) = Points::default();
    for (line, rest) in lines(&text, false) {
        let mut fields = Fields { path, line, rest };
        let _id: u64 = fields.next("the point id")?;
        let position = fields.array(["X", "Y", "Z"])?;
        let color = [fields.next("R")?, fields.next("G")?, fields.next("B")?];
        let point = point(position, color);
        points.push(point.ok_or_else(|| fields.invalid("the point is not at a finite position".into()))?);
        // Behind the error pairs of a photograph and a place in it. Other programs leave out what they do not have.
        let track = fields.rest.split_whitespace().skip(1).step_by(2);
        tracks.push(track.map_while(|id| id.parse().ok()));
    }
    Ok((points, tracks))
}

// ---------------------------------------------------------------- ply

/// A vertex of a point cloud: position, and colour where the file has one.
#[derive(Default)]
struct Vertex {
    position: [Option<f64>; 3],
    color: [u8; 3],
}

impl Vertex {
    fn coordinate(&mut self, name: &str, value: f64) -> ply_rs_bw::ply::PropertyAccessResult {
        let Some(axis) = ["x", "y", "z"].iter().position(|n| *n == name) else {
            return ply_rs_bw::ply::PropertyAccessResult::Ignored;
        };
        self.position[axis] = Some(value);
        ply_rs_bw::ply::PropertyAccessResult::Set
    }
}

impl ply_rs_bw::ply::PropertyAccess for Vertex {
    fn new() -> Self {
        // Grey where the file has no colours.
        Vertex { position: [None; 3], color: [128; 3] }
    }

    fn set_float(&mut self, name: &str, value: f32) -> ply_rs_bw::ply::PropertyAccessResult {
        self.coordinate(name, f64::from(value))
    }

    fn set_double(&mut self, name: &str, value: f64) -> ply_rs_bw::ply::PropertyAccessResult {
        self.coordinate(name, value)
    }

    fn set_uchar(&mut self, name: &str, value: u8) -> ply_rs_bw::ply::PropertyAccessResult {
        let Some(channel) = ["red", "green", "blue"].iter().position(|n| *n == name) else {
            return ply_rs_bw::ply::PropertyAccessResult::Ignored;
        };
        self.color[channel] = value;
        ply_rs_bw::ply::PropertyAccessResult::Set
    }
}

fn ply_points(path: &Path) -> Result<Points, Error> {
    let invalid = |what: String| Error::File { path: path.to_path_buf(), what };
    // The parser's messages go on with the line's text and cause.
    let unreadable = |e: ply_rs_bw::parser::ParseError| {
        let text = e.to_string();
        invalid(format!("not a readable PLY file: {}", text.lines().next().unwrap_or("no reason given")))
    };
    let file = File::open(path).map_err(|source| Error::Io { path: path.to_path_buf(), source })?;
    let mut reader = ply_rs_bw::parser::Reader::new(BufReader::new(file));
    let parser = ply_rs_bw::parser::Parser::<Vertex>::new();
    let header = parser.read_header(&mut reader).map_err(unreadable)?;
    let Some((first, element)) = header.elements.first() else {
        return Err(invalid("the PLY file lists no vertices".into()));
    };
    if first != "vertex" {
        return Err(invalid(format!("the PLY file begins with '{first}', it must begin with its vertices")));
    }
    let numbers = [ScalarType::Float, ScalarType::Double].map(PropertyType::Scalar);
    let is_number = |name| element.properties.get(name).is_some_and(|p| numbers.contains(&p.data_type));
    // Before anything is read: a row that is shorter than a point would let a small file become a large cloud.
    if !["x", "y", "z"].into_iter().all(is_number) {
        return Err(invalid("the vertices lack x, y or z as float or double".into()));
    }
    let vertices = parser.read_payload_for_element(&mut reader, element, &header).map_err(unreadable)?;
    let points: Result<_, Error> = vertices
        .into_iter()
        .enumerate()
        .map(|(i, v)| match v.position {
            [Some(x), Some(y), Some(z)] => {
                point([x, y, z], v.color).ok_or_else(|| invalid(format!("vertex {i} is not at a finite position")))
            }
            _ => Err(invalid("the vertices lack x, y or z as float or double".into())),
        })
        .collect();
    Ok((points?, Tracks::default()))
}

/// What to do about a camera model that is not projected with.
fn unsupported_hint() -> String {
    format!("{SUPPORTED} are supported; `gscream-vk prepare` resamples the photographs of other lenses")
}

//! A scene of our own making, by an analytic ray caster in float64: what the pictures show is known exactly.
//!
//! A room of textured walls, a bench and a cabinet before the back wall, and the object to remove: a sphere on a stand,
//! standing before brickwork and the bench's edge. Lighting is diffuse and without cast shadows, so that the object
//! changes no pixel outside its mask. The lens has COLMAP's SIMPLE_RADIAL distortion and an off-centre principal point.

use std::f64::consts::TAU;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3, dvec3};
use image::{GrayImage, Luma, Rgb, RgbImage};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::{Error, npy, undistort};

/// What to make. The same options give the same files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Seed of textures, cameras, points and noise.
    pub seed: u64,
    /// Width of the pictures in pixels, at least 16.
    pub width: u32,
    /// Height of the pictures in pixels, at least 16.
    pub height: u32,
    /// Views with the object, at least 1; the middle one is the reference view.
    pub train_views: u32,
    /// Views without the object.
    pub test_views: u32,
    /// Points of the sparse model, at least 1.
    pub points: u32,
}

impl Default for Options {
    fn default() -> Self {
        Options { seed: 0, width: 160, height: 120, train_views: 24, test_views: 6, points: 4000 }
    }
}

/// The lens: SIMPLE_RADIAL k1.
const RADIAL: f64 = 0.03;
/// Each pixel averages this many rays per side.
const SAMPLES: u32 = 4;
/// Position noise of the sparse points, relative to their distance.
const POINT_NOISE: f64 = 0.001;
/// Noise of the priors, relative to the mean depth of their view: per pixel, and in slow waves across the picture.
const PRIOR_NOISE: f64 = 0.005;

/// Random streams, so that e.g. more points do not change the cameras.
const TEXTURES: u64 = 1;
const CAMERAS: u64 = 2;
const POINTS: u64 = 3;
const PRIORS: u64 = 4;

/// Writes the scene into `dir` in the plain layout (see [`super`]): `images/` with the object, exact `masks/`, `depth/`
/// (each view's exact depth under a random affine map, with noise), `reference/` (the exact picture without the object, and
/// its depth), `test_images/` without the object, `test_masks/` where it would be, `test_depth/` with their exact depth, and
/// `sparse/0/`.
///
/// # Errors
/// Options out of range, a folder that is not empty, a file that cannot be written.
pub fn write(dir: &Path, options: &Options) -> Result<(), Error> {
    let Options { seed, width, height, train_views, points, .. } = *options;
    checked([width, height], train_views, points)?;
    let (train, test) = Shot::all(options);
    let room = Room::new(seed);
    let cloud = room.points(&train, points, &mut Pcg64::new(seed.into(), POINTS.into()));
    write_room(dir, seed, &room, [&train, &test], &[], &cloud)
}

/// Adds to a scene that [`write()`] has written with the same options what its train views would show without the object:
/// photographs, masks and depth as test views of the same names.
///
/// # Errors
/// A file that cannot be written.
pub fn write_bare(dir: &Path, options: &Options) -> Result<(), Error> {
    write_tests(dir, &Room::new(options.seed), &Shot::all(options).0, &[])
}

/// Refuses what no room can be drawn with.
pub(super) fn checked([width, height]: [u32; 2], train_views: u32, points: u32) -> Result<(), Error> {
    if !(16..=16384).contains(&width) || !(16..=16384).contains(&height) {
        return Err(Error::Setting(format!(
            "synthetic pictures cannot be {width}x{height}; both sides must be 16 to 16384"
        )));
    }
    if train_views == 0 || points == 0 {
        return Err(Error::Setting("a synthetic scene needs at least one train view and one point".into()));
    }
    Ok(())
}

/// Writes a room seen by train and test views. `exposures` multiply the train views' colours; none leave them.
pub(super) fn write_room(
    dir: &Path,
    seed: u64,
    room: &Room,
    [train, test]: [&[Shot]; 2],
    exposures: &[f64],
    cloud: &[(DVec3, Rgb<u8>)],
) -> Result<(), Error> {
    if dir.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(Error::File { path: dir.to_path_buf(), what: "the folder is not empty; name a new one".into() });
    }
    make(dir, &["images", "masks", "depth", "reference", "sparse/0"])?;
    let reference = train.len() / 2;
    (0..train.len()).into_par_iter().try_for_each(|i| {
        let shot = &train[i];
        let name = format!("{}.png", shot.name);
        save(dir.join("images").join(&name), |path| exposed(room.photograph(shot, true), exposures.get(i)).save(path))?;
        save(dir.join("masks").join(&name), |path| room.mask(shot).save(path))?;
        let mut rng = Pcg64::new(seed.into(), (PRIORS + 2 * i as u64).into());
        save_prior(&dir.join("depth").join(format!("{}.npy", shot.name)), &room.depth(shot, true), shot, &mut rng)?;
        if i == reference {
            save(dir.join("reference").join(&name), |path| {
                exposed(room.photograph(shot, false), exposures.get(i)).save(path)
            })?;
            let mut rng = Pcg64::new(seed.into(), (PRIORS + 2 * i as u64 + 1).into());
            let path = dir.join("reference").join(format!("{}_depth.npy", shot.name));
            save_prior(&path, &room.depth(shot, false), shot, &mut rng)?;
        }
        Ok(())
    })?;
    write_tests(dir, room, test, &[])?;
    write_model(&dir.join("sparse/0"), train, test, cloud)
}

/// Writes what views show without the object: photographs, masks of where it would be, exact depth. `exposures` multiply the
/// colours; none leave them.
pub(super) fn write_tests(dir: &Path, room: &Room, shots: &[Shot], exposures: &[f64]) -> Result<(), Error> {
    if shots.is_empty() {
        return Ok(());
    }
    make(dir, &["test_images", "test_masks", "test_depth"])?;
    shots.par_iter().enumerate().try_for_each(|(i, shot)| {
        let name = format!("{}.png", shot.name);
        let picture = exposed(room.photograph(shot, false), exposures.get(i));
        save(dir.join("test_images").join(&name), |path| picture.save(path))?;
        save(dir.join("test_masks").join(&name), |path| room.mask(shot).save(path))?;
        let depth: Vec<f32> = room.depth(shot, false).into_iter().map(|z| z as f32).collect();
        write_npy(&dir.join("test_depth").join(format!("{}.npy", shot.name)), &depth, shot)
    })
}

fn make(dir: &Path, folders: &[&str]) -> Result<(), Error> {
    folders.iter().try_for_each(|folder| {
        let path = dir.join(folder);
        std::fs::create_dir_all(&path).map_err(|source| Error::Io { path, source })
    })
}

fn exposed(mut picture: RgbImage, exposure: Option<&f64>) -> RgbImage {
    if let Some(by) = exposure {
        picture.pixels_mut().for_each(|pixel| pixel.0 = pixel.0.map(|v| (f64::from(v) * by).round().min(255.0) as u8));
    }
    picture
}

fn save(path: std::path::PathBuf, write: impl FnOnce(&Path) -> image::ImageResult<()>) -> Result<(), Error> {
    write(&path).map_err(|e| {
        let source = match e {
            image::ImageError::IoError(source) => source,
            other => std::io::Error::other(other),
        };
        Error::Io { path, source }
    })
}

/// Writes depth under an affine map with positive scale and with noise, as a monocular network would know it.
fn save_prior(path: &Path, depth: &[f64], shot: &Shot, rng: &mut Pcg64) -> Result<(), Error> {
    let [w, h] = shot.size.map(|n| n as usize);
    let scale = rng.random_range(-1.2f64..0.2).exp();
    let shift = rng.random_range(-0.5..0.5);
    let noise = PRIOR_NOISE * depth.iter().sum::<f64>() / depth.len() as f64;
    let waves: [[f64; 3]; 3] =
        std::array::from_fn(|_| [rng.random_range(-1.5..1.5), rng.random_range(-1.5..1.5), rng.random_range(0.0..TAU)]);
    let value = |pixel: usize| {
        let (x, y) = (pixel % w, pixel / w);
        let white: f64 = StandardNormal.sample(rng);
        let (u, v) = (x as f64 / w as f64, y as f64 / h as f64);
        let slow: f64 = waves.iter().map(|[a, b, phase]| (TAU * (a * u + b * v) + phase).sin()).sum();
        (scale * (depth[pixel] + noise * (white + slow)) + shift) as f32
    };
    let values: Vec<f32> = (0..w * h).map(value).collect();
    write_npy(path, &values, shot)
}

fn write_npy(path: &Path, values: &[f32], shot: &Shot) -> Result<(), Error> {
    let bytes = npy::encode(values, shot.size);
    std::fs::write(path, bytes).map_err(|source| Error::Io { path: path.to_path_buf(), source })
}

// ---------------------------------------------------------------- cameras

/// A camera position and lens. Conventions are [`super::Camera`]'s, in float64.
pub(super) struct Shot {
    pub name: String,
    /// World to camera.
    rotation: DQuat,
    pub eye: DVec3,
    focal: f64,
    principal: [f64; 2],
    pub size: [u32; 2],
}

impl Shot {
    /// Train views fill an arc before the object; test views stand between them, at other heights.
    fn all(options: &Options) -> (Vec<Shot>, Vec<Shot>) {
        let mut rng = Pcg64::new(options.seed.into(), CAMERAS.into());
        let mut arc = |count: u32, name: &str, offset: f64| -> Vec<Shot> {
            (0..count)
                .map(|i| {
                    let along = (f64::from(i) + 0.5 + rng.random_range(-0.2..0.2)) / f64::from(count);
                    // The golden ratio spreads heights evenly, whatever the number of views.
                    let height = (f64::from(i) * 0.618_033_988_749_895 + offset).fract();
                    let angle = (along - 0.5) * 70f64.to_radians();
                    let target = dvec3(0.1, 0.9, 0.6);
                    let eye = target + dvec3(2.9 * angle.sin(), -2.9 * angle.cos(), 0.4 + 0.9 * height);
                    let mut jitter = |size: f64| rng.random_range(-size..size);
                    let target = target + dvec3(jitter(0.1), jitter(0.1), jitter(0.08));
                    let roll = jitter(0.04);
                    Shot::look(format!("{name}_{i:03}"), eye, target, roll, [options.width, options.height])
                })
                .collect()
        };
        (arc(options.train_views, "train", 0.0), arc(options.test_views, "test", 0.3))
    }

    pub fn look(name: String, eye: DVec3, target: DVec3, roll: f64, size: [u32; 2]) -> Shot {
        let forward = (target - eye).normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let upright = DMat3::from_cols(right, forward.cross(right), forward).transpose();
        let rotation = DQuat::from_rotation_z(roll) * DQuat::from_mat3(&upright);
        let [w, h] = size.map(f64::from);
        // The longer side sees 55 degrees.
        Shot { name, rotation, eye, focal: 0.96 * w.max(h), principal: [0.52 * w, 0.47 * h], size }
    }

    /// The ray through a pixel position, scaled so that its parameter is the depth z.
    pub fn ray(&self, x: f64, y: f64) -> DVec3 {
        let normalised = [(x - self.principal[0]) / self.focal, (y - self.principal[1]) / self.focal];
        let [u, v] = undistort(normalised, [RADIAL, 0.0, 0.0, 0.0])
            .expect("a radial distortion that only grows outwards has an inverse everywhere");
        self.rotation.inverse() * dvec3(u, v, 1.0)
    }
}

// ---------------------------------------------------------------- the room

#[derive(Clone, Copy)]
pub(super) enum Shape {
    /// Seen from inside.
    Walls {
        low: DVec3,
        high: DVec3,
    },
    /// Seen from outside.
    Block {
        low: DVec3,
        high: DVec3,
    },
    Sphere {
        center: DVec3,
        radius: f64,
    },
    /// An upright or level rod without ends.
    Rod {
        from: DVec3,
        to: DVec3,
        radius: f64,
    },
}

impl Shape {
    /// Ray parameter and outward normal of the first hit in front of the eye.
    pub fn hit(&self, eye: DVec3, ray: DVec3) -> Option<(f64, DVec3)> {
        match *self {
            Shape::Sphere { center, radius } => {
                let to = eye - center;
                let (a, b, c) = (ray.length_squared(), to.dot(ray), to.length_squared() - radius * radius);
                let t = (-b - (b * b - a * c).sqrt()) / a;
                // NaN (no hit) fails the comparison as well.
                (t > 0.0).then(|| (t, (to + ray * t) / radius))
            }
            Shape::Rod { from, to, radius } => {
                let (axis, out) = (to - from, eye - from);
                let (length, along, offset) = (axis.length_squared(), axis.dot(ray), axis.dot(out));
                let a = length * ray.length_squared() - along * along;
                let b = length * out.dot(ray) - offset * along;
                let c = length * (out.length_squared() - radius * radius) - offset * offset;
                let t = (-b - (b * b - a * c).sqrt()) / a;
                let s = (offset + t * along) / length;
                (t > 0.0 && (0.0..=1.0).contains(&s)).then(|| (t, (out + ray * t - axis * s) / radius))
            }
            Shape::Walls { low, high } | Shape::Block { low, high } => {
                // A ray along an axis divides by zero: the infinities compare as they should.
                let (a, b) = ((low - eye) / ray, (high - eye) / ray);
                let (near, far) = (a.min(b), a.max(b));
                let inside = matches!(self, Shape::Walls { .. });
                let t = if inside { far.min_element() } else { near.max_element() };
                if t <= 0.0 || (!inside && t > far.min_element()) {
                    return None;
                }
                let side = if inside { far } else { near };
                let axis = (0..3).find(|i| side[*i] == t)?;
                let mut normal = DVec3::ZERO;
                normal[axis] = -ray[axis].signum();
                Some((t, normal))
            }
        }
    }
}

/// Structure with soft edges drawn over a material's waves.
#[derive(Clone, Copy)]
pub(super) enum Pattern {
    Plain,
    /// Rows of this width and height, every other row shifted by half.
    Bricks(f64, f64),
    /// A grid of this pitch.
    Tiles(f64),
    /// Boards of this width.
    Boards(f64),
}

/// One plane wave of a solid texture.
pub(super) struct Wave {
    direction: DVec3,
    phase: f64,
    pub amplitude: DVec3,
}

pub(super) struct Material {
    pub base: DVec3,
    pub waves: Vec<Wave>,
    pub pattern: Pattern,
}

/// Periodic soft line: 1 on multiples of `pitch`, falling off within about `width`.
fn line(at: f64, pitch: f64, width: f64) -> f64 {
    let distance = (at / pitch - (at / pitch).round()) * pitch;
    (-(distance / width).powi(2)).exp()
}

impl Material {
    /// Waves of many directions and of wavelengths from 1.2 down to 0.12: several pixels even in small pictures.
    pub fn new(base: [f64; 3], pattern: Pattern, rng: &mut Pcg64) -> Material {
        let waves = (0..14)
            .map(|i| {
                let wavelength = 1.2 * 0.1f64.powf(f64::from(i) / 13.0);
                let normal = |rng: &mut Pcg64| -> f64 { StandardNormal.sample(rng) };
                let direction = dvec3(normal(rng), normal(rng), normal(rng)).normalize() * (TAU / wavelength);
                let tint = DVec3::ONE + 0.3 * dvec3(normal(rng), normal(rng), normal(rng));
                Wave { direction, phase: rng.random_range(0.0..TAU), amplitude: 0.06 * wavelength.powf(0.25) * tint }
            })
            .collect();
        Material { base: DVec3::from(base), waves, pattern }
    }

    /// Colour at a point of a surface with this normal, in [0, 1].
    fn color(&self, at: DVec3, normal: DVec3) -> DVec3 {
        // Surface coordinates: heights stay vertical on walls.
        let (u, v) = if normal.z.abs() > 0.5 {
            (at.x, at.y)
        } else if normal.y.abs() > 0.5 {
            (at.x, at.z)
        } else {
            (at.y, at.z)
        };
        // How close a seam is, and which brick, tile or board this is.
        let (seam, cell) = match self.pattern {
            Pattern::Plain => (0.0, [0.0; 2]),
            Pattern::Bricks(width, height) => {
                let row = (v / height).floor();
                let along = u + if row.rem_euclid(2.0) == 0.0 { 0.0 } else { 0.5 * width };
                (line(v, height, 0.018).max(line(along, width, 0.018)), [(along / width).floor(), row])
            }
            Pattern::Tiles(pitch) => {
                (line(u, pitch, 0.015).max(line(v, pitch, 0.015)), [(u / pitch).floor(), (v / pitch).floor()])
            }
            Pattern::Boards(width) => (line(u, width, 0.02), [(u / width).floor(), 0.0]),
        };
        let waves: DVec3 = self.waves.iter().map(|w| w.amplitude * (w.direction.dot(at) + w.phase).sin()).sum();
        let light = 0.72 + 0.28 * normal.dot(dvec3(-0.45, -0.6, 0.66));
        let surface = self.base * (waves + 0.86 + 0.28 * shade(cell));
        (surface.lerp(DVec3::splat(0.85) - 0.7 * self.base, 0.75 * seam) * light).clamp(DVec3::ZERO, DVec3::ONE)
    }
}

/// A number in [0, 1) for a cell, without order.
fn shade([a, b]: [f64; 2]) -> f64 {
    let mut bits =
        (a as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (b as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    bits = (bits ^ (bits >> 31)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// Shapes with their materials; the object's come last.
pub(super) struct Room {
    pub shapes: Vec<(Shape, Material)>,
    /// Index of the first shape of the object.
    pub object: usize,
}

/// The first surface along a ray.
pub(super) struct Hit {
    pub depth: f64,
    pub normal: DVec3,
    pub position: DVec3,
    /// Index into [`Room::shapes`].
    pub shape: usize,
}

impl Room {
    fn new(seed: u64) -> Room {
        let mut rng = Pcg64::new(seed.into(), TEXTURES.into());
        let block = |low: [f64; 3], high: [f64; 3]| Shape::Block { low: low.into(), high: high.into() };
        let walls = Shape::Walls { low: dvec3(-3.0, -3.5, 0.0), high: dvec3(3.0, 3.0, 3.0) };
        let mut material = |base, pattern| Material::new(base, pattern, &mut rng);
        let shapes = vec![
            (walls, material([0.68, 0.40, 0.32], Pattern::Bricks(0.5, 0.22))),
            (block([-3.0, -3.5, -0.1], [3.0, 3.0, 1e-6]), material([0.55, 0.58, 0.60], Pattern::Tiles(0.45))),
            (block([-1.8, 1.6, 0.0], [0.35, 3.0, 0.6]), material([0.66, 0.52, 0.32], Pattern::Boards(0.3))),
            (block([1.2, 2.3, 0.0], [1.9, 3.0, 1.5]), material([0.30, 0.46, 0.40], Pattern::Boards(0.23))),
            (block([-0.01, 0.59, 0.0], [0.31, 0.91, 0.57]), material([0.85, 0.82, 0.76], Pattern::Plain)),
            (
                Shape::Sphere { center: dvec3(0.15, 0.75, 0.83), radius: 0.28 },
                material([0.25, 0.35, 0.75], Pattern::Plain),
            ),
        ];
        Room { shapes, object: 4 }
    }

    pub fn cast(&self, eye: DVec3, ray: DVec3, with_object: bool) -> Hit {
        let count = if with_object { self.shapes.len() } else { self.object };
        let (index, (depth, normal)) = self.shapes[..count]
            .iter()
            .enumerate()
            .filter_map(|(i, (shape, _))| Some((i, shape.hit(eye, ray)?)))
            .min_by(|a, b| a.1.0.total_cmp(&b.1.0))
            .expect("a ray from inside the room ends at a wall");
        Hit { depth, normal, position: eye + ray * depth, shape: index }
    }

    pub fn color(&self, hit: &Hit) -> DVec3 {
        self.shapes[hit.shape].1.color(hit.position, hit.normal)
    }

    /// The first surfaces along the rays of a pixel.
    fn hits(&self, shot: &Shot, x: u32, y: u32, with_object: bool) -> impl Iterator<Item = Hit> {
        (0..SAMPLES * SAMPLES).map(move |s| {
            let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(SAMPLES);
            let ray = shot.ray(f64::from(x) + offset(s % SAMPLES), f64::from(y) + offset(s / SAMPLES));
            self.cast(shot.eye, ray, with_object)
        })
    }

    /// The anti-aliased picture.
    pub fn photograph(&self, shot: &Shot, with_object: bool) -> RgbImage {
        RgbImage::from_fn(shot.size[0], shot.size[1], |x, y| {
            let sum: DVec3 = self.hits(shot, x, y, with_object).map(|hit| self.color(&hit)).sum();
            to_rgb8(sum / f64::from(SAMPLES * SAMPLES))
        })
    }

    /// The pixels of which some ray meets the object.
    pub fn mask(&self, shot: &Shot) -> GrayImage {
        GrayImage::from_fn(shot.size[0], shot.size[1], |x, y| {
            let object = self.hits(shot, x, y, true).any(|hit| hit.shape >= self.object);
            Luma([if object { 255 } else { 0 }])
        })
    }

    /// Exact depth z at the pixel centres, row-major.
    pub fn depth(&self, shot: &Shot, with_object: bool) -> Vec<f64> {
        let [w, h] = shot.size;
        let pixels = (0..h).flat_map(|y| (0..w).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5)));
        pixels.map(|(x, y)| self.cast(shot.eye, shot.ray(x, y), with_object).depth).collect()
    }

    /// What structure from motion would find: surface points seen by the train views, the object's among them, with noise.
    fn points(&self, views: &[Shot], count: u32, rng: &mut Pcg64) -> Vec<(DVec3, Rgb<u8>)> {
        (0..count)
            .map(|_| {
                let shot = &views[rng.random_range(0..views.len())];
                let [x, y] = shot.size.map(|n| rng.random_range(0.0..f64::from(n)));
                let hit = self.cast(shot.eye, shot.ray(x, y), true);
                let mut noise =
                    || -> f64 { POINT_NOISE * hit.depth * Distribution::<f64>::sample(&StandardNormal, rng) };
                (hit.position + dvec3(noise(), noise(), noise()), to_rgb8(self.color(&hit)))
            })
            .collect()
    }
}

pub(super) fn to_rgb8(color: DVec3) -> Rgb<u8> {
    Rgb(color.to_array().map(|v| (255.0 * v).round() as u8))
}

// ---------------------------------------------------------------- COLMAP model

/// Writes a binary model: one SIMPLE_RADIAL camera, poses without observations, points without tracks.
fn write_model(folder: &Path, train: &[Shot], test: &[Shot], cloud: &[(DVec3, Rgb<u8>)]) -> Result<(), Error> {
    let lens = &train[0];
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend(1u32.to_le_bytes());
    cameras.extend(2u32.to_le_bytes());
    lens.size.iter().for_each(|n| cameras.extend(u64::from(*n).to_le_bytes()));
    [lens.focal, lens.principal[0], lens.principal[1], RADIAL].iter().for_each(|v| cameras.extend(v.to_le_bytes()));

    let mut images = ((train.len() + test.len()) as u64).to_le_bytes().to_vec();
    for (i, shot) in train.iter().chain(test).enumerate() {
        images.extend((i as u32 + 1).to_le_bytes());
        let q = shot.rotation;
        let t = -(q * shot.eye);
        [q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().for_each(|v| images.extend(v.to_le_bytes()));
        images.extend(1u32.to_le_bytes());
        images.extend(format!("{}.png\0", shot.name).as_bytes());
        images.extend(0u64.to_le_bytes());
    }

    let mut points = (cloud.len() as u64).to_le_bytes().to_vec();
    for (i, (position, color)) in cloud.iter().enumerate() {
        points.extend((i as u64 + 1).to_le_bytes());
        position.to_array().iter().for_each(|v| points.extend(v.to_le_bytes()));
        points.extend(color.0);
        points.extend(1f64.to_le_bytes());
        points.extend(0u64.to_le_bytes());
    }
    for (name, bytes) in [("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", points)] {
        let path = folder.join(name);
        std::fs::write(&path, bytes).map_err(|source| Error::Io { path, source })?;
    }
    Ok(())
}

/// Whether nothing, the object included, stands between a camera's centre and a place: for tests.
#[cfg(test)]
pub(crate) fn reaches(seed: u64, center: DVec3, place: DVec3) -> bool {
    Room::new(seed).cast(center, place - center, true).depth > 1.0 - 1e-3
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load};

    fn options() -> Options {
        Options { seed: 7, width: 121, height: 160, train_views: 5, test_views: 2, points: 600 }
    }

    /// Rays, the COLMAP files, the loader and `Camera::project` agree: a surface point seen at a pixel projects back to it.
    #[test]
    fn what_is_seen_at_a_pixel_projects_to_it() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        write(dir.path(), &options()).expect("written");
        let scene = load(dir.path(), &Config::default()).expect("loaded");
        let (room, (train, test)) = (Room::new(7), Shot::all(&options()));
        let mut seen = 0;
        for (shot, view) in train.iter().chain(&test).zip(scene.train.iter().chain(&scene.test)) {
            assert_eq!(shot.name, view.name);
            for (x, y) in
                (0..=8).flat_map(|i| (0..=8).map(move |j| (121.0 * f64::from(i) / 8.0, 160.0 * f64::from(j) / 8.0)))
            {
                let hit = room.cast(shot.eye, shot.ray(x, y), true);
                let position = hit.position.to_array();
                let pixel = view.camera.project(position).expect("in front of the camera");
                // Float32 camera parameters are off by 6e-8 of about 200 pixels and a few world units, a dozen times over.
                assert!((pixel[0] - x).abs() < 5e-4 && (pixel[1] - y).abs() < 5e-4, "{pixel:?} not {x}, {y}");
                assert!((view.camera.to_camera(position)[2] - hit.depth).abs() < 1e-5);
                seen += 1;
            }
            let normalised = view.camera.unproject([3.5, 150.5]).expect("invertible");
            let ray = shot.rotation * shot.ray(3.5, 150.5);
            assert!((normalised[0] - ray.x).abs() < 1e-6 && (normalised[1] - ray.y).abs() < 1e-6);
        }
        assert_eq!(seen, 7 * 81);
    }

    #[test]
    fn the_object_changes_no_pixel_outside_its_mask() {
        let room = Room::new(7);
        let (train, _) = Shot::all(&options());
        for shot in &train {
            let (with, without, mask) = (room.photograph(shot, true), room.photograph(shot, false), room.mask(shot));
            let (mut object, mut changed) = (0, 0);
            for ((a, b), m) in with.pixels().zip(without.pixels()).zip(mask.pixels()) {
                assert!(m.0[0] == 255 || a == b, "a pixel outside the mask shows the object");
                object += usize::from(m.0[0] == 255);
                changed += usize::from(a != b);
            }
            let all = with.pixels().len();
            assert!(object > all / 50 && object < all / 4, "the object covers {object} of {all} pixels");
            assert!(changed > object * 9 / 10, "{changed} of {object} object pixels differ");
        }
    }

    /// Fitting a prior to the exact depth leaves its noise: at least the white part, at most that and three full waves.
    #[test]
    fn priors_are_the_exact_depth_under_an_affine_map() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        write(dir.path(), &options()).expect("written");
        let scene = load(dir.path(), &Config::default()).expect("loaded");
        let (room, (train, _)) = (Room::new(7), Shot::all(&options()));
        let reference = scene.references.first().expect("there is a reference");
        let inpainted = reference.prior.as_ref().expect("it has a prior");
        let own =
            train.iter().zip(&scene.train).map(|(s, v)| (s, v.prior.as_ref().expect("priors were written"), true));
        let mut scales = Vec::new();
        for (shot, prior, with_object) in own.chain([(&train[reference.view], inpainted, false)]) {
            let depth = room.depth(shot, with_object);
            let n = depth.len() as f64;
            let mean = depth.iter().sum::<f64>() / n;
            let prior_mean = prior.values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
            let pairs = || depth.iter().zip(&prior.values).map(|(z, p)| (z - mean, f64::from(*p) - prior_mean));
            let scale = pairs().map(|(z, p)| z * p).sum::<f64>() / pairs().map(|(z, _)| z * z).sum::<f64>();
            let residual = (pairs().map(|(z, p)| (p - scale * z).powi(2)).sum::<f64>() / n).sqrt();
            let noise = scale * PRIOR_NOISE * mean;
            assert!(residual > 0.95 * noise && residual < 10f64.sqrt() * noise, "{residual} against {noise}");
            assert!(scale > 0.28 && scale < 1.25, "{scale}");
            scales.push(scale);
        }
        scales.sort_by(f64::total_cmp);
        assert!(scales.windows(2).all(|s| s[1] - s[0] > 1e-4), "each view has its own scale: {scales:?}");
    }

    /// Every point lies on a surface that some train view sees. Its noise moves depth by 5 sigma at most, times the slope of
    /// the surface, which is below 4 but for the most grazing views.
    #[test]
    fn points_lie_on_visible_surfaces() {
        let (room, (train, _)) = (Room::new(7), Shot::all(&options()));
        let cloud = room.points(&train, 600, &mut Pcg64::new(7, POINTS.into()));
        let near = |position: DVec3| {
            train.iter().any(|shot| {
                let p = shot.rotation * (position - shot.eye);
                if p.z <= 0.0 {
                    return false;
                }
                let ray = shot.rotation.inverse() * (p / p.z);
                (room.cast(shot.eye, ray, true).depth / p.z - 1.0).abs() < 5.0 * 4.0 * POINT_NOISE
            })
        };
        let found = cloud.iter().filter(|(position, _)| near(*position)).count();
        assert!(found > 594, "{found} of 600");
        let on_object = cloud.iter().filter(|(p, _)| (*p - dvec3(0.15, 0.75, 0.83)).length() < 0.29).count();
        assert!(on_object > 5, "{on_object} points on the object");
    }
}

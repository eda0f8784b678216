//! A splat's own pictures as the photographs of a capture: a folder that `prepare` takes as it takes any.

use std::fmt::Write as _;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use glam::DVec3;
use image::{ImageFormat, RgbImage};

use super::Error;
use super::cameras::Posed;
use super::frame::{self, Place};
use super::read::{Splat, of_degree};
use crate::export;
use crate::gpu::Gpu;
use crate::math::harmonics::{ZEROTH, coefficients, harmonics};
use crate::model::gaussians::{Cloud, Static, sigmoid};
use crate::model::stored::Stored;
use crate::prepare::poses;
use crate::render::Config;
use crate::render::view::{Rendered, Renderer};
use crate::scene::{self, Camera, colmap, up};
use crate::statistics::median;

/// Below this a Gaussian touches no pixel.
const FAINT: f64 = 1.0 / 255.0;
/// Standard deviations to which a Gaussian is looked for in a view.
const REACH: f64 = 3.0;
/// A Gaussian of this opacity stands for matter.
const MATTER: f64 = 0.5;
/// Points of the sparse model at most.
const POINTS: usize = 20_000;
/// Gaussians nearer than this part of the median depth are not drawn: training's own near plane, in its own unit.
const NEAR: f64 = 0.2 / 3.0;
/// Most of the pictures that may show nothing, as a part of all pixels.
const EMPTY: f64 = 0.5;
/// Name of the file with the hash of what the pictures were made of.
const MADE_OF: &str = "made_of.txt";

/// The Gaussians of a splat that some camera may see, in the file's order.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Their numbers in the file.
    pub numbers: Vec<u32>,
    /// They themselves.
    pub cloud: Cloud,
}

/// Whether any part of a ball may lie in a camera's picture.
fn meets(camera: &Camera, position: [f32; 3], radius: f64, near: f64) -> bool {
    let p = camera.to_camera(position.map(f64::from));
    if p[2] + radius <= near {
        return false;
    }
    (0..2).all(|axis| {
        let [focal, middle] = [camera.focal[axis], camera.principal[axis]].map(f64::from);
        let low = -middle / focal;
        let high = (f64::from(camera.size[axis]) - middle) / focal;
        // Distances from the planes through the picture's edges, positive outside.
        (low * p[2] - p[axis]) / low.hypot(1.0) <= radius && (p[axis] - high * p[2]) / high.hypot(1.0) <= radius
    })
}

impl Seen {
    /// Those that may be seen by any of the cameras, nearer ones than `near` apart.
    pub fn by(splat: &Splat, cameras: &[Camera], near: f64) -> Self {
        let cloud = &splat.cloud;
        let seen = |i: usize| {
            let widest = cloud.log_scale[i].into_iter().fold(f32::NEG_INFINITY, f32::max);
            let radius = REACH * f64::from(widest).exp();
            splat.drawn[i]
                && sigmoid(cloud.logit[i]) >= FAINT
                && cameras.iter().any(|camera| meets(camera, cloud.position[i], radius, near))
        };
        let flags: Vec<bool> = (0..splat.len()).map(seen).collect();
        let numbers = (0u32..).zip(&flags).filter(|(_, seen)| **seen).map(|(i, _)| i).collect();
        let mut cloud = cloud.clone();
        cloud.retain(&flags);
        Self { numbers, cloud }
    }

    /// The same with colours that no direction changes.
    #[must_use]
    pub fn plain(&self) -> Self {
        Self { numbers: self.numbers.clone(), cloud: of_degree(&self.cloud, 0) }
    }
}

/// The median depth at which the cameras see matter.
///
/// # Errors
/// Cameras that see none.
pub fn depth(splat: &Splat, cameras: &[Camera]) -> Result<f64, Error> {
    let opaque = matter(splat);
    let some = || opaque.iter().step_by(opaque.len().div_ceil(POINTS).max(1));
    let mut depths = vec![];
    for camera in cameras.iter().step_by(cameras.len().div_ceil(64).max(1)) {
        depths.extend(some().filter(|p| camera.within(**p).is_some()).map(|p| camera.to_camera(*p)[2]));
    }
    median(depths).ok_or_else(apart)
}

/// Takes the cameras of a COLMAP model to the frame of a splat that was moved, scaled or turned against it. Returns where it stands.
pub fn align(splat: &Splat, folder: &Path, posed: &mut [Posed]) -> Place {
    // A file of cameras has no points, and a model may be without: then its frame is taken for the splat's.
    let Ok(model) = colmap::read(folder) else { return Place::Own };
    let colored = |point: &scene::Point| {
        (DVec3::from_array(point.position.map(f64::from)), point.color.map(|v| f32::from(v) / 255.0))
    };
    let points: Vec<frame::Colored> = model.points.iter().map(colored).collect();
    // Its program knew the photographs that are there, which may be fewer than the model has.
    let photographs = scene::pictures(&folder.join("images")).unwrap_or_default();
    let there = |image: &&colmap::Image| photographs.contains_key(scene::stem(&image.name));
    let center = |image: &colmap::Image| DVec3::from_array(image.center());
    let cameras = [model.images.iter().filter(there).map(center).collect(), model.images.iter().map(center).collect()];
    let cloud = &splat.cloud;
    let opaque = opaque(splat).map(|i| (DVec3::from_array(cloud.position[i].map(f64::from)), base(cloud, i)));
    let place = frame::find(&points, &cameras, &opaque.collect::<Vec<_>>());
    let Place::Elsewhere(frame) = place else { return place };
    for Posed { camera, .. } in posed {
        let center = frame.apply(DVec3::from_array(camera.center()));
        *camera = up::turn_camera(camera, frame.turn);
        camera.translation = Camera::translation_to(&camera.rotation, center.to_array());
    }
    place
}

/// Numbers of opaque Gaussians.
pub(super) fn opaque(splat: &Splat) -> impl Iterator<Item = usize> {
    (0..splat.len()).filter(|i| splat.drawn[*i] && sigmoid(splat.cloud.logit[*i]) >= MATTER)
}

/// Centres of opaque Gaussians.
fn matter(splat: &Splat) -> Vec<[f64; 3]> {
    opaque(splat).map(|i| splat.cloud.position[i].map(f64::from)).collect()
}

/// A Gaussian's colour from all sides, 0 to 1 in gamut.
fn base(cloud: &Cloud, i: usize) -> [f32; 3] {
    cloud.harmonics_of(i)[0].map(|v| (0.5 + ZEROTH * f64::from(v)) as f32)
}

fn apart() -> Error {
    Error::Request(
        "the cameras do not see the splat: it stands in another place, or in other axes or units, than they do (some \
         programs move and scale what they train); give the cameras of the splat's own frame with --cameras"
            .into(),
    )
}

/// How the pictures are drawn.
pub fn config(depth: f64) -> Config {
    Config { near: NEAR * depth, ..Config::default() }
}

/// The Gaussians with the colour that they show to a camera, from all sides.
fn toward(cloud: &Cloud, camera: &Camera) -> Cloud {
    let eye = camera.center();
    let each = coefficients(cloud.degree);
    let color = |i: usize| {
        let away: [f64; 3] = std::array::from_fn(|c| f64::from(cloud.position[i][c]) - eye[c]);
        let length = away.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
        let basis = harmonics(away.map(|v| v / length));
        let own = cloud.harmonics_of(i);
        std::array::from_fn(|c| ((0..each).map(|k| basis[k] * f64::from(own[k][c])).sum::<f64>() / ZEROTH) as f32)
    };
    Cloud { degree: 0, harmonics: (0..cloud.len()).map(color).collect(), ..cloud.clone() }
}

/// Draws some of a splat's Gaussians for one camera after the other.
pub struct Artist<'a> {
    gpu: &'a Gpu,
    cloud: &'a Cloud,
    config: Config,
    /// All of them, where one array of the device holds their harmonics.
    whole: Option<Renderer>,
}

impl<'a> Artist<'a> {
    /// Of these Gaussians.
    ///
    /// # Errors
    /// When the device has no room for them.
    pub fn new(gpu: &'a Gpu, cloud: &'a Cloud, config: &Config) -> Result<Self, Error> {
        fits(gpu, cloud.len())?;
        let whole = if cloud.len() <= Static::most(gpu, cloud.degree) as usize {
            Some(Renderer::of(gpu, &Stored::Gaussians(cloud.clone()), config)?)
        } else {
            None
        };
        Ok(Self { gpu, cloud, config: config.clone(), whole })
    }

    /// The picture for a camera.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    pub fn draw(&mut self, camera: &Camera) -> Result<Rendered, Error> {
        if let Some(whole) = &mut self.whole {
            return Ok(whole.render(camera)?);
        }
        let model = Stored::Gaussians(toward(self.cloud, camera));
        Ok(Renderer::of(self.gpu, &model, &self.config)?.render(camera)?)
    }
}

/// Refuses more Gaussians than the device holds in one array, colours from all sides.
///
/// # Errors
/// [`Error::Request`].
pub fn fits(gpu: &Gpu, count: usize) -> Result<(), Error> {
    let most = Static::most(gpu, 0);
    if count <= most as usize {
        return Ok(());
    }
    Err(Error::Request(format!(
        "the cameras see {count} Gaussians, and {} holds {most} in one array at most: give fewer cameras, near the object, \
         with --cameras",
        gpu.info().name
    )))
}

/// Whether the pictures in `folder` were made of this.
pub fn are_of(folder: &Path, made_of: &str) -> bool {
    std::fs::read_to_string(folder.join(MADE_OF)).is_ok_and(|text| text == made_of)
}

/// The pictures of a splat in `folder`, with their cameras and some of its Gaussians' centres as points; nothing is drawn
/// where they are there already. `said` hears how many are done.
///
/// # Errors
/// Cameras that see little of the splat; a device without room; files that cannot be written.
pub fn write(
    gpu: &Gpu,
    splat: &Splat,
    posed: &[Posed],
    folder: &Path,
    made_of: &str,
    said: &mut dyn FnMut(u64) -> Result<(), Error>,
) -> Result<(), Error> {
    let mark = folder.join(MADE_OF);
    if are_of(folder, made_of) {
        return Ok(());
    }
    // Only a folder that this made is made again.
    let empty = || std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
    if folder.exists() && !mark.is_file() && !empty() {
        let what = "pictures of the splat would come here, and other files are there already: choose another --out";
        return Err(Error::File { path: folder.to_owned(), what: what.into() });
    }
    match std::fs::remove_dir_all(folder) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            return Err(Error::Io { path: folder.to_owned(), source });
        }
        _ => {}
    }
    let cameras: Vec<Camera> = posed.iter().map(|posed| posed.camera).collect();
    let config = config(depth(splat, &cameras)?);
    let seen = Seen::by(splat, &cameras, config.near);
    let mut artist = Artist::new(gpu, &seen.cloud, &config)?;
    let (mut empty, mut pixels) = (0.0, 0.0);
    for (i, Posed { name, camera }) in posed.iter().enumerate() {
        let drawn = artist.draw(camera)?;
        empty += drawn.transmittance.iter().map(|left| f64::from(*left)).sum::<f64>();
        pixels += drawn.transmittance.len() as f64;
        put(folder.join("images").join(format!("{name}.png")), &png(&drawn.to_rgb8()))?;
        said(i as u64 + 1)?;
    }
    if empty > EMPTY * pixels {
        return Err(apart());
    }
    for (name, bytes) in poses::model_of(posed.iter().map(|posed| (posed.name.as_str(), &posed.camera))) {
        put(folder.join("sparse/0").join(name), &bytes)?;
    }
    put(folder.join("sparse/0/points3D.txt"), points(&seen.cloud).as_bytes())?;
    put(mark, made_of.as_bytes())
}

fn put(path: PathBuf, bytes: &[u8]) -> Result<(), Error> {
    Ok(export::write(&[(path, bytes)])?)
}

fn png(picture: &RgbImage) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![]);
    picture.write_to(&mut bytes, ImageFormat::Png).expect("memory takes a picture");
    bytes.into_inner()
}

/// Centres of opaque Gaussians, as COLMAP writes points.
fn points(cloud: &Cloud) -> String {
    let opaque: Vec<usize> = (0..cloud.len()).filter(|i| sigmoid(cloud.logit[*i]) >= MATTER).collect();
    let mut text = String::new();
    for (id, i) in (1u32..).zip(opaque.iter().step_by(opaque.len().div_ceil(POINTS).max(1))) {
        let [x, y, z] = cloud.position[*i];
        let [r, g, b] = base(cloud, *i).map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
        writeln!(text, "{id} {x} {y} {z} {r} {g} {b} 0").expect("a string takes everything");
    }
    text
}

//! What is taken out of a splat and what is put in its place: the Gaussians that the masks vote out, and those that the
//! holes of all views begin with.

use std::path::Path;

use image::RgbImage;
use image::imageops::{FilterType, resize};
use rayon::prelude::*;

use super::Error;
use super::views::{Artist, Seen};
use crate::gpu::Gpu;
use crate::model::gaussians::Cloud;
use crate::model::{self, init};
use crate::prepare::fit::Fit;
use crate::prepare::masks::{self, Votes};
use crate::prepare::splats::Splats;
use crate::render::view::Rendered;
use crate::scene::{self, Camera, Point, PriorKind, Scene, resample};
use crate::statistics::median;

/// A Gaussian with more than this share inside the masks is the object's.
const OBJECT: f32 = 0.5;
/// A pixel of the hole needs filling where the rest of the splat differs from the reference by this in a channel,
const DIFFERS: f32 = 0.06;
/// or lets this much through.
const OPEN: f32 = 0.1;
/// Light that is let through where other views' holes begin: elsewhere the splat has already what was seen behind the object.
const WIDE_OPEN: f32 = 0.3;
/// Matter that covers so much of a pixel, and is nearer than this part of the hole's depth, stands before it.
const BEFORE: f32 = 0.5;
const NEARER: f64 = 0.95;
/// A Gaussian of the fill is at most so many times as wide as most of them are: one that has no neighbours is alone.
const WIDEST: f64 = 1.5;
/// Pixels by which the hole is enlarged.
const MARGIN: u32 = 1;
/// Opacity that a Gaussian of the fill begins with.
const OPACITY: f64 = 0.7;

/// Which of the seen Gaussians are the object, by the votes of all masks.
///
/// # Errors
/// When the device has no room, or is lost; a view without a mask.
pub fn object(
    gpu: &Gpu,
    scene: &Scene,
    fit: &Fit,
    turn: &mut dyn FnMut() -> Result<(), Error>,
) -> Result<Vec<bool>, Error> {
    let mut splats = Splats::new(gpu, &fit.model, &fit.settings.render)?;
    let mut votes = Votes::new(&splats);
    for view in &scene.train {
        let Some(mask) = &view.mask else { continue };
        votes.add(&mut splats, &view.camera, &masks::parts(mask, view.camera.size))?;
        turn()?;
    }
    let colors = masks::colors(&mut splats, &scene.train)?;
    let shares = votes.count(fit.positions(), &colors);
    Ok(shares.object.iter().map(|share| *share > OBJECT).collect())
}

/// A view's hole, filled.
struct Shown<'a> {
    camera: &'a Camera,
    image: &'a RgbImage,
    /// \[pixel\] along the axis, scene units.
    depth: &'a [f32],
    /// \[pixel\] of the hole.
    inside: &'a [bool],
    /// Whether what is there already stays whatever it looks like: what others than the reference guess is no better.
    open: bool,
}

impl Shown<'_> {
    /// Adds a point at each pixel of the hole where `drawn`, the rest of the splat, is not what the picture shows.
    fn begin(&self, drawn: &Rendered, points: &mut Vec<Point>) {
        let camera = self.camera;
        for i in (0..self.depth.len()).filter(|i| self.inside[*i]) {
            let (x, y) = (i as u32 % camera.size[0], i as u32 / camera.size[0]);
            let color = self.image.get_pixel(x, y).0;
            let off = |c: usize| (f32::from(color[c]) / 255.0 - drawn.rgb[i][c]).abs();
            let z = f64::from(self.depth[i]);
            // What stands before the hole's surface and stays is none of the hole, whatever the mask says.
            let covered = 1.0 - drawn.transmittance[i];
            if covered > BEFORE && f64::from(drawn.depth[i] / covered) < NEARER * z {
                continue;
            }
            let is_open = drawn.transmittance[i] >= if self.open { WIDE_OPEN } else { OPEN };
            let differs = !self.open && (0..3).any(|c| off(c) >= DIFFERS);
            if !(is_open || differs) || !z.is_finite() || z <= 0.0 {
                continue;
            }
            let Some(position) = camera.lift(camera.pixel_center(i), z) else { continue };
            points.push(Point { position: position.map(|v| v as f32), color });
        }
    }
}

/// A Gaussian for each pixel of the reference's hole where the rest of the splat is not what the reference shows, at the
/// reference's depth; and then of every other view's filled hole, where the splat is open and no earlier one has shown anything. They are
/// discs along the surface, as wide as their neighbours are apart.
///
/// # Errors
/// A scene without a reference, or without its depth; when the device has no room, or is lost.
pub fn begin(gpu: &Gpu, scene: &Scene, root: &Path, rest: &Cloud, fit: &Fit) -> Result<Cloud, Error> {
    let missing = |what: &str| {
        Error::Request(format!("{}: there is no {what} to fill the hole with; run the step reference", root.display()))
    };
    let reference = scene.references.first().ok_or_else(|| missing("reference picture"))?;
    let prior = reference.prior.as_ref().ok_or_else(|| missing("depth of the reference picture"))?;
    let view = &scene.train[reference.view];
    let mask = view.mask.as_ref().ok_or_else(|| missing("mask of the reference view"))?;
    let mut artist = Artist::new(gpu, rest, &fit.settings.render)?;
    let mut points = vec![];
    let [w, h] = view.camera.size;
    let image = match reference.image.dimensions() == (w, h) {
        true => &reference.image,
        false => &resize(&reference.image, w, h, FilterType::Triangle),
    };
    let inside: Vec<bool> = resample::dilate(mask, MARGIN).as_raw().iter().map(|inside| *inside != 0).collect();
    let depth: Vec<f32> = match prior.kind {
        PriorKind::Disparity => prior.values.iter().map(|disparity| 1.0 / disparity).collect(),
        _ => prior.values.clone(),
    };
    let shown = Shown { camera: &view.camera, image, depth: &depth, inside: &inside, open: false };
    shown.begin(&artist.draw(&view.camera)?, &mut points);
    for hole in &scene.holes {
        let (camera, Some(depth)) = (&scene.train[hole.view].camera, &hole.depth) else { continue };
        let inside = scene::bare(hole, depth, camera, points.par_iter().map(|point| point.position));
        if inside.contains(&true) {
            let shown = Shown { camera, image: &hole.image, depth, inside: &inside, open: true };
            shown.begin(&artist.draw(camera)?, &mut points);
        }
    }
    if points.is_empty() {
        return Ok(Cloud::default());
    }
    let config = model::Config { degree: 0, opacity: OPACITY, ..model::Config::default() };
    let mut cloud = init::gaussians(&points, &config, u32::MAX).map_err(|error| Error::Request(error.to_string()))?;
    let usual = median(cloud.log_scale.iter().map(|scale| scale[0])).expect("there are points");
    let most = (usual + WIDEST.ln()) as f32;
    cloud.log_scale.iter_mut().flatten().for_each(|width| *width = width.min(most));
    Ok(cloud)
}

/// The scene in a folder with the longer side of its pictures at most about `side` pixels.
///
/// # Errors
/// As [`scene::load`].
pub fn load(root: &Path, side: u32) -> Result<Scene, Error> {
    let longest = scene::longest_side(root).unwrap_or(side);
    let downscale = ((f64::from(longest) / f64::from(side)).round() as u32).max(1);
    Ok(scene::load(root, &scene::Config { downscale, ..scene::Config::default() })?)
}

/// Flags by number in the file, of those of the seen Gaussians that are the object.
pub fn in_file(seen: &Seen, object: &[bool], count: usize) -> Vec<bool> {
    let mut flags = vec![false; count];
    seen.numbers.iter().zip(object).for_each(|(number, object)| flags[*number as usize] = *object);
    flags
}

/// The runs of true flags, as first and one past the last.
pub fn ranges(flags: &[bool]) -> Vec<[usize; 2]> {
    let mut ranges: Vec<[usize; 2]> = vec![];
    for i in (0..flags.len()).filter(|i| flags[*i]) {
        match ranges.last_mut() {
            Some([_, end]) if *end == i => *end += 1,
            _ => ranges.push([i, i + 1]),
        }
    }
    ranges
}

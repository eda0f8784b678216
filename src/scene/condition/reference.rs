//! The inpainted pictures: how deep their holes are, and how far they are believed.

use image::{GrayImage, Luma};
use rayon::prelude::*;

use super::sparse::{Sample, fit, samples};
use crate::scene::{Camera, Point, Prior, PriorKind, Reference, Scene};
use crate::statistics::deviation;

/// Of each reference, the depth z of its hole \[pixel\], NaN outside it: its prior brought to the scene's depth by the points
/// outside the mask. `None` without a prior, or without enough points.
pub(super) fn hole_depths(scene: &Scene) -> Vec<Option<Vec<f32>>> {
    scene.references.iter().map(|reference| hole_depth(scene, reference)).collect()
}

impl Scene {
    /// `[slope, shift]` of the line that brings a reference's prior to the depth z of the scene (or 1 / z, if it is a
    /// disparity): `z = slope prior + shift`, robustly through the points around its hole. `None` without a prior, without
    /// enough points, or if the prior runs against them.
    pub fn depth_line(&self, reference: &Reference) -> Option<[f64; 2]> {
        depth_line(reference.prior.as_ref()?, &around(self, reference))
    }
}

/// The points around a reference's hole, as its view sees them.
fn around(scene: &Scene, reference: &Reference) -> Vec<Sample> {
    let view = &scene.train[reference.view];
    samples(&view.camera, &scene.points, view.mask.as_ref())
}

fn depth_line(prior: &Prior, around: &[Sample]) -> Option<[f64; 2]> {
    fit(prior, around).filter(|line| line[0] > 0.0)
}

fn hole_depth(scene: &Scene, reference: &Reference) -> Option<Vec<f32>> {
    let prior = reference.prior.as_ref()?;
    let view = &scene.train[reference.view];
    let mask = view.mask.as_ref()?;
    let around = around(scene, reference);
    let [slope, shift] = depth_line(prior, &around)?;
    let (near, far) = around.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(s.depth), b.max(s.depth)));
    let depth = |(m, p): (&u8, &f32)| {
        let value = slope * f64::from(*p) + shift;
        let z = if prior.kind == PriorKind::Disparity { 1.0 / value } else { value };
        // Beyond what the points span the line tells nothing.
        if *m != 0 && z > 0.5 * near && z < 2.0 * far { z as f32 } else { f32::NAN }
    };
    Some(mask.as_raw().iter().zip(&prior.values).map(depth).collect())
}

/// Nearest samples that a pixel's depth is guessed from.
const NEIGHBORS: usize = 150;
/// Colours this far apart (8-bit, root mean square over channels) are taken to be of different surfaces.
const COLOR: f64 = 15.0;
/// Rounds in which samples far from the plane lose their weight: the nearest may be of another surface.
const ROUNDS: usize = 3;

/// Priors for the reference pictures that have none, from the points.
pub(super) fn guess_priors(scene: &mut Scene) {
    for at in 0..scene.references.len() {
        if scene.references[at].prior.is_some() {
            continue;
        }
        let Some(values) = guess(scene, &scene.references[at]) else { continue };
        let name = &scene.train[scene.references[at].view].name;
        scene.notes.push(format!("reference {name}: it has no prior; its depth is guessed from the points around it"));
        scene.references[at].prior = Some(Prior { kind: PriorKind::Depth, values });
    }
}

/// Depth at each pixel of a reference picture. `None` with too few points.
fn guess(scene: &Scene, reference: &Reference) -> Option<Vec<f32>> {
    let camera = &scene.train[reference.view].camera;
    // Points in the hole as well: those on the object have been left out, the others were seen past it.
    let surroundings = Surroundings::new(camera, &reference.image, &scene.points, None)?;
    let pixels = camera.size[0] as usize * camera.size[1] as usize;
    Some((0..pixels).into_par_iter().map(|pixel| surroundings.depth(pixel) as f32).collect())
}

/// The points that a view sees, from which the depth of its other pixels is guessed.
pub(super) struct Surroundings {
    samples: Vec<Sample>,
    /// Of each sample.
    colors: Vec<[f64; 3]>,
    picture: image::RgbImage,
    neighbors: usize,
}

impl Surroundings {
    /// Of a view with such a picture; with `outside`, of its points outside that mask. `None` with too few points.
    pub(super) fn new(
        camera: &Camera,
        picture: &image::RgbImage,
        points: &[Point],
        outside: Option<&GrayImage>,
    ) -> Option<Surroundings> {
        let samples = samples(camera, points, outside);
        let neighbors = NEIGHBORS.min(samples.len() / 4);
        if neighbors < FEWEST_NEIGHBORS {
            return None;
        }
        // Noise of single pixels tells no surfaces apart.
        let picture = image::imageops::blur(picture, 1.0 + camera.size[0] as f32 / 250.0);
        let mut surroundings = Surroundings { samples, colors: vec![], picture, neighbors };
        surroundings.colors = surroundings.samples.iter().map(|s| surroundings.color(s.pixel)).collect();
        Some(surroundings)
    }

    fn color(&self, pixel: usize) -> [f64; 3] {
        std::array::from_fn(|c| f64::from(self.picture.as_raw()[3 * pixel + c]))
    }

    fn place(&self, pixel: usize) -> [f64; 2] {
        let w = self.picture.width() as usize;
        [(pixel % w) as f64, (pixel / w) as f64]
    }

    /// Depth z at a pixel: a plane of inverse depth through the nearest points, weighted by their distance, by how alike the
    /// colours are and by how near the plane they are. It is smooth where the picture is, and breaks where colours break,
    /// like a surface's border.
    pub(super) fn depth(&self, pixel: usize) -> f64 {
        let (here, tint) = (self.place(pixel), self.color(pixel));
        let mut near: Vec<(f64, usize)> = self
            .samples
            .iter()
            .enumerate()
            .map(|(i, s)| {
                let there = self.place(s.pixel);
                ((there[0] - here[0]).powi(2) + (there[1] - here[1]).powi(2), i)
            })
            .collect();
        near.select_nth_unstable_by(self.neighbors - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(self.neighbors);
        // One order, whatever the selection left: sums round alike everywhere.
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let reach = near.iter().fold(1.0_f64, |m, (d, _)| m.max(*d));
        let mut weighted: Vec<Weighted> = near
            .iter()
            .map(|(d, i)| {
                let apart: f64 = (0..3).map(|c| (tint[c] - self.colors[*i][c]).powi(2)).sum::<f64>() / 3.0;
                let weight = (-0.5 * apart / COLOR.powi(2)).exp().max(1e-4) / (d + 0.05 * reach);
                let there = self.place(self.samples[*i].pixel);
                (weight, [there[0] - here[0], there[1] - here[1]], 1.0 / self.samples[*i].depth)
            })
            .collect();
        1.0 / robust_plane(&mut weighted, reach)
    }
}

/// Fewest samples that a plane is laid through.
const FEWEST_NEIGHBORS: usize = 12;

/// A weight, a place, and the value there.
type Weighted = (f64, [f64; 2], f64);

/// The value at the origin of a plane through weighted values, within their range. Values far from the plane lose weight
/// (Cauchy's function at two standard deviations, as the median of the residuals tells them).
fn robust_plane(weighted: &mut [Weighted], reach: f64) -> f64 {
    let (low, high) = weighted.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(s.2), b.max(s.2)));
    for _ in 0..ROUNDS {
        let [value, x, y] = plane(weighted, reach);
        let residual = |s: &Weighted| (s.2 - value - x * s.1[0] - y * s.1[1]).abs();
        let deviation = deviation(weighted.iter().map(residual)).unwrap_or(0.0);
        if deviation == 0.0 {
            break;
        }
        for s in weighted.iter_mut() {
            s.0 /= 1.0 + (residual(s) / (2.0 * deviation)).powi(2);
        }
    }
    plane(weighted, reach)[0].clamp(low, high)
}

/// Value at the origin and slopes of a plane through weighted values; the slopes are held small by a ridge of a tenth of
/// the spread's weight.
fn plane(weighted: &[Weighted], reach: f64) -> [f64; 3] {
    let total: f64 = weighted.iter().map(|(w, ..)| w).sum();
    let mean = |value: &dyn Fn(&Weighted) -> f64| weighted.iter().map(|s| s.0 * value(s)).sum::<f64>() / total;
    let (mx, my, mv) = (mean(&|s| s.1[0]), mean(&|s| s.1[1]), mean(&|s| s.2));
    let ridge = 0.1 * reach;
    let xx = mean(&|s| (s.1[0] - mx).powi(2)) + ridge;
    let yy = mean(&|s| (s.1[1] - my).powi(2)) + ridge;
    let xy = mean(&|s| (s.1[0] - mx) * (s.1[1] - my));
    let xv = mean(&|s| (s.1[0] - mx) * (s.2 - mv));
    let yv = mean(&|s| (s.1[1] - my) * (s.2 - mv));
    let determinant = xx * yy - xy * xy;
    let slope = [(xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant];
    [mv - slope[0] * mx - slope[1] * my, slope[0], slope[1]]
}

/// Takes the inpainted pictures in their holes and the photographs outside, mixed as the weight falls off: networks that
/// inpaint repaint the surroundings as well, and those were photographed.
pub(super) fn composite(scene: &mut Scene) {
    for reference in &mut scene.references {
        let view = &scene.train[reference.view];
        let Some(weight) = view.blend() else { continue };
        let pixels = reference.image.pixels_mut().zip(view.image.pixels()).zip(weight.as_raw());
        for ((painted, photographed), m) in pixels {
            let share = f64::from(*m) / 255.0;
            for (p, q) in painted.0.iter_mut().zip(photographed.0) {
                *p = (share * f64::from(*p) + (1.0 - share) * f64::from(q)).round() as u8;
            }
        }
    }
}

/// So many views that see a part of the hole past the object outrank the painted picture there, fewer in proportion.
const OUTRANKING_VIEWS: usize = 5;

/// Lowers the weight of a reference's view where other views see past the object: with n of [`OUTRANKING_VIEWS`] in
/// proportion, so that what was photographed outranks what was painted. Inside the mask it stays above 0.
pub(super) fn outrank(scene: &mut Scene, depths: &[Option<Vec<f32>>]) {
    let lowered: Vec<_> = scene
        .references
        .iter()
        .zip(depths)
        .filter_map(|(reference, depth)| Some((reference.view, outranked(scene, reference, depth.as_ref()?)?)))
        .collect();
    for (view, (weight, share)) in lowered {
        scene.train[view].weight = Some(weight);
        if share > 0.0 {
            scene.notes.push(format!(
                "{:.0} % of the hole of reference {} is seen past the object by {OUTRANKING_VIEWS} views or more, which \
                 outrank the painted picture there (scene.whole_reference)",
                100.0 * share,
                scene.train[view].name
            ));
        }
    }
}

/// The lowered weight, and the share of the hole that enough views see.
fn outranked(scene: &Scene, reference: &Reference, depth: &[f32]) -> Option<(GrayImage, f64)> {
    let view = &scene.train[reference.view];
    let weight = view.blend()?;
    // What another reference shows of the hole was painted too.
    let others: Vec<_> =
        scene.train.iter().enumerate().filter(|(i, _)| *i != reference.view).map(|(_, view)| view).collect();
    let views = |pixel: usize| -> usize {
        let z = depth[pixel];
        let camera = &view.camera;
        let place = || camera.lift(camera.pixel_center(pixel), f64::from(z));
        let Some(position) = z.is_finite().then(place).flatten() else { return 0 };
        let sees = |other: &&&crate::scene::View| {
            other.camera.pixel_of(position).is_some_and(|p| other.blend().is_none_or(|w| w.as_raw()[p] == 0))
        };
        others.iter().filter(sees).count()
    };
    let counted: Vec<usize> = (0..depth.len()).into_par_iter().map(views).collect();
    let lowered = |m: u8, n: usize| {
        let left = 1.0 - (n as f64 / OUTRANKING_VIEWS as f64).min(1.0);
        if m == 0 { 0 } else { (f64::from(m) * left).round().max(1.0) as u8 }
    };
    let hole = weight.as_raw().iter().filter(|w| **w == 255).count();
    let seen = weight.as_raw().iter().zip(&counted).filter(|(w, n)| **w == 255 && **n >= OUTRANKING_VIEWS).count();
    let mut new = GrayImage::new(weight.width(), weight.height());
    for ((to, m), n) in new.pixels_mut().zip(weight.as_raw()).zip(&counted) {
        *to = Luma([lowered(*m, *n)]);
    }
    Some((new, seen as f64 / hole.max(1) as f64))
}

//! Models that are folded: photographs from two sides of an object that looks alike from both, laid onto one side.
//!
//! Structure from motion takes what looks alike for one. Photographs of a can with the same label on two sides then stand on one half
//! circle, and what is around the can is another thing behind the same label. The object is going to be removed, so that what is
//! around it is asked: photographs that have points of the object in common, and none of its surroundings, are parts of their own. The
//! surface that the object stands on is drawn as it is seen from above, once by each part, and a part whose drawing is the other's when
//! it is turned about the object, and at no other turn, is turned.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DQuat, DVec2, DVec3};
use image::GrayImage;
use rayon::prelude::*;

use super::poses::{Shot, model_files_of};
use super::shadow::plane::{self, Support};
use crate::scene::colmap::{Image, Intrinsics, Model};
use crate::scene::map::{Spot, Standing};
use crate::scene::{Scene, View, resample, up};
use crate::statistics::median;

/// Longer side of the photographs that drawings are made of, pixels.
pub const PICTURES: u32 = 640;
/// Points of the surroundings that two photographs of one part have in common, at least.
const LINKS: u32 = 5;
/// Photographs of a part, at least.
const LEAST: usize = 5;
/// Share of a point's photographs that have it in their masks from which on it is the object's.
const OBJECTS: f64 = 0.5;
/// Points so near the object's middle, as a multiple of its size, are taken for the object's, whatever masks that end early say.
const NEAR: f64 = 1.3;
/// How far from the object its surface is looked for and drawn, as a multiple of the object's size.
const REACH: f64 = 5.0;
/// Side of a drawing, pixels.
const SIDE: usize = 320;
/// Pixels to each side of one whose mean is taken from it: light is not compared, joints and specks are.
const AROUND: usize = 10;
/// Largest difference from that mean that counts, as a part of white.
const MOST: f32 = 0.05;
/// Turns are tried at every so many degrees, and shifts at every second pixel of a drawing of half the size, up to so many.
const TURN: f64 = 2.0;
const FARTHEST: i32 = 6;
/// Share of a drawing that both must know.
const KNOWN: f64 = 0.05;
/// Correlation of two drawings that are one; that of all turns farther than [`BESIDE`] degrees, and that of the part as it is, as shares
/// of it, at most. The can's two sides have 0.75, 0.33 and 0.1 of that.
const ONE: f64 = 0.5;
const RIVAL: f64 = 0.6;
const BESIDE: f64 = 10.0;
/// Masks are enlarged by this part of the picture's longer side where drawings are made: what is carried ends early.
const MARGIN: f64 = 0.01;

/// Photographs of a model by what they have in common beside the object.
#[derive(Debug, PartialEq)]
pub struct Parts {
    /// `[photograph of the model]` its part, the largest is 0; nothing where it is of none.
    pub of: Vec<Option<usize>>,
    /// How many photographs each has.
    pub counts: Vec<usize>,
    /// `[point of the model]` see [`told`].
    told: Vec<Told>,
}

/// The photographs of a point, each once, and whether it is the object's.
type Told = (Vec<usize>, bool);

/// A part, turned about the object.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    /// Which it is.
    pub part: usize,
    /// Degrees about the normal of the surface that the object stands on.
    pub degrees: f64,
    /// Correlation of its drawing with that of the largest part: as it is turned, at the best turn that is another, and as it was.
    pub alike: [f64; 3],
    /// World points of the scene: rotated, and then moved.
    rotation: DQuat,
    translation: DVec3,
}

impl Turn {
    /// Where a world point of the part is.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The pose, world to camera, of a photograph of the part.
    fn pose(&self, rotation: DQuat, translation: DVec3) -> (DQuat, DVec3) {
        let turned = (rotation * self.rotation.inverse()).normalize();
        (turned, translation - turned * self.translation)
    }
}

/// `[point of the model]` its photographs, each once, and whether it is the object's, by the masks of a scene's train views or by where
/// it is.
fn told(model: &Model, scene: &Scene) -> Vec<Told> {
    let number: BTreeMap<u32, usize> = model.images.iter().enumerate().map(|(at, image)| (image.id, at)).collect();
    let views: BTreeMap<&str, usize> = scene.train.iter().enumerate().map(|(at, v)| (v.name.as_str(), at)).collect();
    let view: Vec<Option<usize>> =
        model.images.iter().map(|image| views.get(crate::scene::stem(&image.name)).copied()).collect();
    let place = |point: usize| model.points[point].position.map(|v| f64::from(v) / scene.unit);
    let one = |point: usize| {
        let mut images: Vec<usize> = model.tracks.of(point).iter().filter_map(|id| number.get(id).copied()).collect();
        images.sort_unstable();
        images.dedup();
        let place = place(point);
        let seen = images.iter().filter_map(|image| {
            let view = &scene.train[view[*image]?];
            let pixel = view.camera.pixel_of(place)?;
            Some(view.mask.as_ref()?.as_raw()[pixel] != 0)
        });
        let (inside, all) = seen.fold((0.0, 0.0), |(a, b), inside| (a + f64::from(u8::from(inside)), b + 1.0));
        (images, inside > OBJECTS * all)
    };
    let mut told: Vec<Told> = (0..model.points.len().min(model.tracks.len())).into_par_iter().map(one).collect();
    let object: Vec<DVec3> = (0..told.len()).filter(|point| told[*point].1).map(|point| place(point).into()).collect();
    if let Some((middle, size)) = plane::extent(&object) {
        let near = |point: usize| DVec3::from(place(point)).distance(middle) < NEAR * size;
        told.iter_mut().enumerate().for_each(|(point, (_, objects))| *objects |= near(point));
    }
    told
}

/// The parts of a model, by a scene of its photographs with masks; nothing where it is one.
pub fn parts(model: &Model, scene: &Scene) -> Option<Parts> {
    let n = model.images.len();
    let mut links = vec![0u32; n * n];
    let told = told(model, scene);
    for (images, _) in told.iter().filter(|(_, objects)| !objects) {
        let pairs = images.iter().flat_map(|a| images.iter().map(move |b| (*a, *b)));
        pairs.for_each(|(a, b)| links[a * n + b] += u32::from(a != b));
    }
    let mut of: Vec<Option<usize>> = vec![None; n];
    let mut all: Vec<Vec<usize>> = vec![];
    for first in 0..n {
        if of[first].is_some() {
            continue;
        }
        let (mut part, mut at) = (vec![first], 0);
        of[first] = Some(all.len());
        while let Some(image) = part.get(at).copied() {
            for next in (0..n).filter(|next| links[image * n + next] >= LINKS) {
                if of[next].is_none() {
                    of[next] = Some(all.len());
                    part.push(next);
                }
            }
            at += 1;
        }
        all.push(part);
    }
    all.retain(|part| part.len() >= LEAST);
    log::debug!("unfold: parts of {:?} photographs", all.iter().map(Vec::len).collect::<Vec<_>>());
    all.sort_by_key(|part| std::cmp::Reverse(part.len()));
    if all.len() < 2 {
        return None;
    }
    of.fill(None);
    all.iter().enumerate().for_each(|(number, part)| part.iter().for_each(|image| of[*image] = Some(number)));
    // What has little in common with anything goes with what it has most in common with, if that is clear.
    let whole = of.clone();
    for image in (0..n).filter(|image| whole[*image].is_none()) {
        let shared = |number: usize| -> u32 {
            (0..n).filter(|other| whole[*other] == Some(number)).map(|other| links[image * n + other]).sum()
        };
        let mut shared: Vec<(u32, usize)> = (0..all.len()).map(|number| (shared(number), number)).collect();
        shared.sort_by(|a, b| b.cmp(a));
        of[image] = Some(shared[0].1).filter(|_| shared[0].0 > 2 * shared[1].0);
    }
    let counts = (0..all.len()).map(|number| of.iter().filter(|own| **own == Some(number)).count()).collect();
    Some(Parts { of, counts, told })
}

/// Where the photographs of a scene's folder stand: those of its train and test views, by the parts of the model, and those that were left
/// out. And how many each part has, where the model is in parts that were not turned about the object yet.
pub fn standing(folder: &Path, scene: &Scene) -> (Vec<Spot>, Option<Vec<usize>>) {
    let model = crate::scene::colmap::read(folder).ok();
    let parts = model.as_ref().filter(|model| !model.tracks.is_empty()).and_then(|model| parts(model, scene));
    let named = |parts: &Parts| -> BTreeMap<String, usize> {
        let images = model.iter().flat_map(|model| &model.images).zip(&parts.of);
        images.filter_map(|(image, part)| Some((crate::scene::stem(&image.name).to_owned(), (*part)?))).collect()
    };
    let part: BTreeMap<String, usize> = parts.as_ref().map_or_else(BTreeMap::new, named);
    let spot = |view: &View| Spot {
        name: view.name.clone(),
        center: view.camera.center(),
        ahead: view.camera.rotation[2].map(f64::from),
        standing: Standing::Part(part.get(&view.name).copied().unwrap_or(0)),
    };
    let mut spots: Vec<Spot> = scene.train.iter().chain(&scene.test).map(spot).collect();
    let there: BTreeSet<String> = spots.iter().map(|spot| spot.name.clone()).collect();
    let left =
        model.iter().flat_map(|model| &model.images).filter(|image| !there.contains(crate::scene::stem(&image.name)));
    spots.extend(left.map(|image| Spot {
        name: crate::scene::stem(&image.name).to_owned(),
        center: image.center().map(|v| v / scene.unit),
        ahead: image.rotation[2],
        standing: Standing::Out,
    }));
    let is_turned = super::record::ended(folder).values().any(|step| step.figures.contains_key(super::TURNED));
    (spots, parts.map(|parts| parts.counts).filter(|_| !is_turned))
}

/// A surface seen from above; NaN where nobody sees it.
struct Drawing {
    side: usize,
    values: Vec<f32>,
}

impl Drawing {
    /// The surface around the object's foot as these train views show it, beside the object.
    fn new(scene: &Scene, views: &[usize], masks: &[GrayImage], support: &Support, pixel: f64) -> Self {
        let half = 0.5 * SIDE as f64;
        let one = |i: usize| {
            let at = [(i % SIDE) as f64 + 0.5 - half, (i / SIDE) as f64 + 0.5 - half].map(|v| v * pixel);
            let point = support.world(DVec3::new(at[0], at[1], 0.0)).to_array();
            let shown = views.iter().filter_map(|k| {
                let view = &scene.train[*k];
                let place = view.camera.within(point)?;
                let under = view.camera.pixel_of(point)?;
                (masks[*k].as_raw()[under] == 0).then_some(())?;
                let grey = |i: usize| {
                    let of = 3 * i;
                    [view.image.as_raw()[of..of + 3].iter().map(|v| f64::from(*v)).sum::<f64>() / 765.0]
                };
                Some(resample::bilinear(view.camera.size, place, grey)[0])
            });
            median(shown).map_or(f32::NAN, |v| v as f32)
        };
        Self { side: SIDE, values: (0..SIDE * SIDE).into_par_iter().map(one).collect() }.without_light()
    }

    /// The mean of what is known so near each pixel, to each side.
    fn means(&self, reach: usize) -> Vec<f32> {
        let n = self.side;
        let mean = |i: usize| {
            let near = |at: usize| at.saturating_sub(reach)..(at + reach + 1).min(n);
            let (mut sum, mut count) = (0.0, 0.0);
            for y in near(i / n) {
                for value in self.values[y * n..][near(i % n)].iter().filter(|v| !v.is_nan()) {
                    (sum, count) = (sum + value, count + 1.0);
                }
            }
            sum / count
        };
        (0..n * n).into_par_iter().map(mean).collect()
    }

    /// The drawing without its light: the difference of each pixel from the mean around it.
    fn without_light(self) -> Self {
        let around = self.means(AROUND);
        let values = self.values.iter().zip(around).map(|(v, around)| (v - around).clamp(-MOST, MOST)).collect();
        let sharp = Self { values, ..self };
        let smooth = sharp.means(1);
        let values = sharp.values.iter().zip(smooth).map(|(v, smooth)| if v.is_nan() { *v } else { smooth }).collect();
        Self { values, ..sharp }
    }

    /// At half the size.
    fn halved(&self) -> Self {
        let side = self.side / 2;
        let value = |i: usize| {
            let [x, y] = [i % side, i / side].map(|v| 2 * v);
            [0, 1].iter().flat_map(|dy| [0, 1].map(|dx| self.values[(y + dy) * self.side + x + dx])).sum::<f32>() / 4.0
        };
        Self { side, values: (0..side * side).map(value).collect() }
    }

    /// Between four pixels; NaN where one of them is not known, and outside.
    fn at(&self, at: DVec2) -> f32 {
        let (x, y) = (at.x - 0.5, at.y - 0.5);
        if !(x >= 0.0 && y >= 0.0 && x < (self.side - 1) as f64 && y < (self.side - 1) as f64) {
            return f32::NAN;
        }
        let (a, b, first) = (x.fract() as f32, y.fract() as f32, y as usize * self.side + x as usize);
        let row = |i: usize| self.values[i] + (self.values[i + 1] - self.values[i]) * a;
        row(first) + (row(first + self.side) - row(first)) * b
    }

    /// Correlation with another one that is turned by so many degrees about its middle, and then moved by so many pixels; -1 where they
    /// have too little in common.
    fn alike(&self, other: &Self, degrees: f64, shift: DVec2) -> f64 {
        let middle = DVec2::splat(0.5 * self.side as f64);
        let back = DVec2::from_angle(-degrees.to_radians());
        let (mut n, mut sums, mut squares) = (0.0, [0.0f64; 2], [0.0f64; 3]);
        for (i, own) in self.values.iter().enumerate().filter(|(_, own)| !own.is_nan()) {
            let from = DVec2::new((i % self.side) as f64 + 0.5, (i / self.side) as f64 + 0.5);
            let there = other.at(back.rotate(from - middle - shift) + middle);
            if there.is_nan() {
                continue;
            }
            let (a, b) = (f64::from(*own), f64::from(there));
            n += 1.0;
            sums = [sums[0] + a, sums[1] + b];
            squares = [squares[0] + a * a, squares[1] + b * b, squares[2] + a * b];
        }
        if n < KNOWN * self.values.len() as f64 {
            return -1.0;
        }
        let [a, b] = sums.map(|sum| sum / n);
        let spread = ((squares[0] / n - a * a) * (squares[1] / n - b * b)).max(0.0).sqrt();
        (squares[2] / n - a * b) / spread.max(1e-9)
    }
}

/// The turn at which another drawing is this one, the shift after it, and the three correlations of [`Turn::alike`]; nothing where it is
/// at no turn, at several, or as it is.
fn turn(own: &Drawing, other: &Drawing) -> Option<(f64, DVec2, [f64; 3])> {
    let (small, small_other) = (own.halved(), other.halved());
    let turns: Vec<f64> = (0..(360.0 / TURN) as u32).map(|k| TURN * f64::from(k)).collect();
    let shifts = || (-FARTHEST..=FARTHEST).step_by(2).map(f64::from);
    let best_at = |degrees: f64| {
        let all = shifts().flat_map(|y| shifts().map(move |x| DVec2::new(x, y)));
        let scored = all.map(|shift| (small.alike(&small_other, degrees, shift), shift));
        scored.fold((-1.0, DVec2::ZERO), |best, next| if next.0 > best.0 { next } else { best })
    };
    let scored: Vec<(f64, DVec2)> = turns.par_iter().map(|degrees| best_at(*degrees)).collect();
    let first = (0..turns.len()).max_by(|a, b| scored[*a].0.total_cmp(&scored[*b].0).then(b.cmp(a)))?;
    let best = scored[first].0;
    let apart = |k: usize| {
        let apart = (turns[k] - turns[first]).abs();
        apart.min(360.0 - apart)
    };
    let rival = (0..turns.len()).filter(|k| apart(*k) > BESIDE).map(|k| scored[k].0).fold(-1.0, f64::max);
    let was = small.alike(&small_other, 0.0, DVec2::ZERO);
    log::debug!("unfold: alike {best:.2} at {} degrees, {rival:.2} at others, {was:.2} as it is", turns[first]);
    if best < ONE || rival > RIVAL * best || was > RIVAL * best {
        return None;
    }
    let (mut at, mut degrees) = (2.0 * scored[first].1, turns[first]);
    for step in [1.0, 0.5, 0.25, 0.125] {
        let steps = || (-2..=2).map(|k| step * f64::from(k));
        let tries: Vec<(f64, DVec2)> = steps()
            .flat_map(|turn| steps().flat_map(move |x| steps().map(move |y| (turn, DVec2::new(x, y)))))
            .map(|(turn, shift)| (degrees + turn, at + shift))
            .collect();
        let scored = tries.into_par_iter().map(|(degrees, shift)| (own.alike(other, degrees, shift), degrees, shift));
        let scored: Vec<(f64, f64, DVec2)> = scored.collect();
        (_, degrees, at) = scored.into_iter().reduce(|best, next| if next.0 > best.0 { next } else { best })?;
    }
    Some((degrees, at, [best, rival, was]))
}

/// The parts that have to be turned about the object to stand where the largest one stands; the scene has masks.
pub fn turns(model: &Model, scene: &Scene, parts: &Parts, seed: u64) -> Vec<Turn> {
    let points = |objects: bool| -> Vec<DVec3> {
        let some =
            parts.told.iter().zip(&model.points).filter(|((images, own), _)| *own == objects && images.len() > 1);
        some.map(|(_, point)| DVec3::from(point.position.map(f64::from)) / scene.unit).collect()
    };
    let object = points(true);
    let Some((middle, size)) = plane::extent(&object) else { return vec![] };
    let around: Vec<DVec3> = points(false).into_iter().filter(|p| p.distance(middle) < REACH * size).collect();
    let cameras: Vec<_> = scene.train.iter().map(|view| view.camera).collect();
    let Some(support) = plane::find(&around, &object, up::estimate(&cameras), seed) else { return vec![] };
    let of: BTreeMap<&str, usize> = (model.images.iter().zip(&parts.of))
        .filter_map(|(image, part)| Some((crate::scene::stem(&image.name), (*part)?)))
        .collect();
    let masks: Vec<GrayImage> = (scene.train.par_iter())
        .map(|view| {
            let [w, h] = view.camera.size;
            let mask = view.mask.clone().unwrap_or_else(|| GrayImage::new(w, h));
            resample::dilate(&mask, (MARGIN * f64::from(w.max(h))).ceil() as u32)
        })
        .collect();
    let pixel = 2.0 * REACH * size / SIDE as f64;
    let drawing = |part: usize| {
        let views: Vec<usize> =
            (0..scene.train.len()).filter(|k| of.get(scene.train[*k].name.as_str()) == Some(&part)).collect();
        Drawing::new(scene, &views, &masks, &support, pixel)
    };
    let first = drawing(0);
    let turned = |part: usize| {
        let (degrees, shift, alike) = turn(&first, &drawing(part))?;
        let rotation = DQuat::from_axis_angle(support.up, degrees.to_radians());
        let shift = (support.along[0] * shift.x + support.along[1] * shift.y) * pixel;
        let translation = support.foot - rotation * support.foot + shift;
        Some(Turn { part, degrees, alike, rotation, translation })
    };
    (1..parts.counts.len()).filter_map(turned).collect()
}

/// The files of the model once its parts are turned, without photographs that are of no part; the turns have `unit` of its units as one.
pub fn files(model: &Model, parts: &Parts, turns: &[Turn], unit: f64) -> Vec<(&'static str, Vec<u8>)> {
    let shot = |(image, part): (&Image, &Option<usize>)| {
        let own = DQuat::from_mat3(&DMat3::from_cols_array_2d(&image.rotation).transpose()).normalize();
        let at = DVec3::from_array(image.translation);
        let part = (*part)?;
        let turn = turns.iter().find(|turn| turn.part == part);
        let (rotation, translation) = turn.map_or((own, at / unit), |turn| turn.pose(own, at / unit));
        let Intrinsics { focal: [fx, fy], principal: [cx, cy], distortion: [k1, k2, p1, p2], size } =
            model.cameras[&image.camera];
        Some(Shot {
            id: Some(image.id),
            name: image.name.clone(),
            size,
            parameters: [fx, fy, cx, cy, k1, k2, p1, p2],
            rotation,
            translation: translation * unit,
        })
    };
    let shots: Vec<Shot> = model.images.iter().zip(&parts.of).filter_map(shot).collect();
    let points = ("points3D.bin", points(model, parts, turns, unit));
    model_files_of(&shots).into_iter().chain([points]).collect()
}

/// `points3D.bin` with the points of each part where it stands: what two have in common is a point of each.
fn points(model: &Model, parts: &Parts, turns: &[Turn], unit: f64) -> Vec<u8> {
    let number: BTreeMap<u32, Option<usize>> =
        model.images.iter().zip(&parts.of).map(|(image, part)| (image.id, *part)).collect();
    let (mut count, mut bytes) = (0u64, vec![]);
    for (at, point) in model.points.iter().enumerate() {
        let images = model.tracks.of(at);
        for part in 0..parts.counts.len() {
            let own: Vec<u32> =
                images.iter().copied().filter(|id| number.get(id).copied().flatten() == Some(part)).collect();
            if own.len() < 2 {
                continue;
            }
            let place = DVec3::from(point.position.map(f64::from));
            let turn = turns.iter().find(|turn| turn.part == part);
            let place = turn.map_or(place, |turn| turn.point(place / unit) * unit);
            count += 1;
            bytes.extend(count.to_le_bytes());
            place.to_array().iter().for_each(|v| bytes.extend(v.to_le_bytes()));
            bytes.extend(point.color);
            // Its error is not known any more, nor which feature of its photographs it is.
            bytes.extend(1f64.to_le_bytes());
            bytes.extend((own.len() as u64).to_le_bytes());
            own.iter().for_each(|id| bytes.extend(id.to_le_bytes().into_iter().chain([0; 4])));
        }
    }
    [count.to_le_bytes().to_vec(), bytes].concat()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::dvec3;
    use image::{Luma, Rgb, RgbImage};

    use super::*;
    use crate::scene::colmap::Tracks;
    use crate::scene::{self, Camera, Point, synthetic};

    /// Photographs around the object.
    const VIEWS: usize = 24;
    /// World units per unit of the scene.
    const UNIT: f64 = 2.0;

    /// A floor at z = 0 of boards askew, no two as wide.
    fn floor(at: DVec2, plain: bool) -> f64 {
        let at = DVec2::from_angle(0.4).rotate(at);
        let near = |v: f64, joints: &[f64]| joints.iter().any(|joint| (v - joint).abs() < 0.03);
        let joint = near(at.x, &[-1.9, -0.8, 0.45, 1.4]) || near(at.y, &[-1.3, 0.6, 1.9]);
        if !plain && joint { 0.35 } else { 0.7 }
    }

    /// A camera on a circle around the object, which stands in the middle, 1 high.
    fn camera(k: usize) -> (DQuat, DVec3) {
        let angle = std::f64::consts::TAU * k as f64 / VIEWS as f64;
        let eye = dvec3(3.0 * angle.cos(), 3.0 * angle.sin(), 2.2);
        let forward = (dvec3(0.0, 0.0, 0.3) - eye).normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let axes = DMat3::from_cols(right, forward.cross(right), forward);
        let rotation = DQuat::from_mat3(&axes).inverse();
        (rotation, -(rotation * eye))
    }

    /// Photographs all around a pillar on a floor, the model that matching makes of them where the second half was taken for the first,
    /// and the true poses, in the model's units.
    fn folded(by: f64, plain: bool) -> (Model, Scene, Vec<(DQuat, DVec3)>) {
        let size = [192u32, 144];
        let (focal, middle) = (165.0, [96.0, 72.0]);
        let turn = DQuat::from_rotation_z(-by.to_radians());
        let half = |k: usize| usize::from(k >= VIEWS / 2);
        let truth: Vec<(DQuat, DVec3)> = (0..VIEWS).map(camera).collect();
        // A world point X of the second half is taken for turn * X.
        let as_taken = |k: usize| {
            let (rotation, translation) = truth[k];
            if half(k) == 0 { (rotation, translation) } else { (rotation * turn.inverse(), translation) }
        };
        let pillar = |point: DVec3| point.truncate().length() < 0.3 && (0.0..1.0).contains(&point.z);
        let mut views = vec![];
        for (k, (rotation, translation)) in truth.iter().copied().enumerate() {
            let eye = -(rotation.inverse() * translation);
            let shown = |x: u32, y: u32| {
                let ray =
                    dvec3((f64::from(x) + 0.5 - middle[0]) / focal, (f64::from(y) + 0.5 - middle[1]) / focal, 1.0);
                let way = rotation.inverse() * ray;
                let meets = (0..400).any(|step| pillar(eye + way * (1.5 + 0.01 * f64::from(step))));
                (meets, floor((eye - way * (eye.z / way.z)).truncate(), plain))
            };
            let grey = |x, y| {
                let (object, floor) = shown(x, y);
                let v = ((if object { 0.2 } else { floor }) * 255.0) as u8;
                Rgb([v, v, v])
            };
            let mask = GrayImage::from_fn(size[0], size[1], |x, y| Luma([if shown(x, y).0 { 255 } else { 0 }]));
            let (rotation, translation) = as_taken(k);
            let camera = Camera {
                rotation: DMat3::from_quat(rotation).transpose().to_cols_array_2d().map(|row| row.map(|v| v as f32)),
                translation: (translation / UNIT).to_array(),
                focal: [focal as f32; 2],
                principal: middle.map(|v| v as f32),
                distortion: [0.0; 4],
                size,
            };
            views.push((camera, RgbImage::from_fn(size[0], size[1], grey), mask));
        }
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options {
            width: 32,
            height: 24,
            train_views: VIEWS as u32,
            test_views: 0,
            points: 50,
            ..Default::default()
        };
        synthetic::write(&dir, &options).expect("a scene");
        let mut scene = scene::load(&dir, &scene::Config::default()).expect("it loads");
        scene.unit = UNIT;
        for (view, (camera, image, mask)) in scene.train.iter_mut().zip(views) {
            (view.camera, view.image, view.mask) = (camera, image, Some(mask));
        }
        // Points of the pillar are found by all that see its side, on both halves as one; those of the floor by neighbours.
        let (mut points, mut tracks) = (vec![], Tracks::default());
        let mut add = |at: DVec3, images: Vec<usize>| {
            points.push(Point { position: at.to_array().map(|v| v as f32), color: [90; 3] });
            tracks.push(images.into_iter().map(|k| k as u32 + 1));
        };
        for step in 0..200 {
            let angle = 0.31 * f64::from(step);
            let at = dvec3(0.3 * angle.cos(), 0.3 * angle.sin(), f64::from(step) / 200.0);
            let sees = |k: &usize| {
                let (rotation, translation) = as_taken(*k);
                (-(rotation.inverse() * translation)).truncate().dot(at.truncate()) > 0.4
            };
            add(at, (0..VIEWS).filter(sees).collect());
        }
        for k in 0..VIEWS - 1 {
            let pair = [k, k + 1];
            for step in 0..24 {
                let angle = 0.9 * f64::from(step) + k as f64;
                let true_place = dvec3(angle.cos(), angle.sin(), 0.0) * (0.5 + 0.04 * f64::from(step));
                let place = if half(k) == 0 { true_place } else { turn * true_place };
                if half(k) == half(k + 1) {
                    add(place, pair.to_vec());
                }
            }
        }
        let images = (0..VIEWS).map(|k| {
            let (rotation, translation) = as_taken(k);
            Image {
                id: k as u32 + 1,
                name: format!("{}.png", scene.train[k].name),
                rotation: DMat3::from_quat(rotation).transpose().to_cols_array_2d(),
                translation: translation.to_array(),
                camera: 1,
            }
        });
        let lens = Intrinsics { focal: [focal; 2], principal: middle, distortion: [0.0; 4], size };
        let model = Model { cameras: BTreeMap::from([(1, lens)]), images: images.collect(), points, tracks };
        (model, scene, truth)
    }

    /// Half of the photographs stand where the other half does: they are turned back to within half a degree, with their points, and a
    /// model that is read again has them so.
    #[test]
    fn a_folded_model_is_unfolded() {
        for by in [180.0, 90.0] {
            let (model, scene, truth) = folded(by, false);
            let parts = parts(&model, &scene).expect("two parts");
            assert_eq!(parts.counts, [VIEWS / 2; 2]);
            let turns = turns(&model, &scene, &parts, 0);
            assert_eq!(turns.len(), 1, "by {by}");
            assert!((turns[0].degrees - by).abs() < 0.5, "{turns:?}");
            let folder = tempfile::tempdir().expect("a folder");
            for (name, bytes) in files(&model, &parts, &turns, UNIT) {
                let path = folder.path().join("sparse/0").join(name);
                std::fs::create_dir_all(path.parent().expect("a folder")).expect("it is made");
                std::fs::write(path, bytes).expect("it is written");
            }
            let read = scene::colmap::read(folder.path()).expect("a model");
            assert_eq!((read.images.len(), read.images[3].name.as_str()), (VIEWS, model.images[3].name.as_str()));
            // About the pillar's axis, which is known to within a hundredth.
            for (image, (rotation, translation)) in read.images.iter().zip(&truth) {
                let eye = -(rotation.inverse() * *translation);
                assert!(
                    DVec3::from(image.center()).distance(eye) < 0.06,
                    "{}: {:?}, {eye}",
                    image.name,
                    image.center()
                );
            }
            // The pillar's points are one for each half that sees them.
            assert!(read.points.len() > model.points.len() && read.tracks.len() == read.points.len());
            // Turned, it is not folded: its parts have nothing in common still, and stand where they belong.
            let mut again = scene.clone();
            for (view, image) in again.train.iter_mut().zip(&read.images) {
                view.camera.rotation = image.rotation.map(|row| row.map(|v| v as f32));
                view.camera.translation = image.translation.map(|v| v / UNIT);
            }
            let parts = super::parts(&read, &again).expect("two parts");
            assert!(super::turns(&read, &again, &parts, 0).is_empty());
        }
    }

    /// On a floor that looks alike at every turn nothing is proved, and nothing is turned.
    #[test]
    fn what_is_not_proved_stays() {
        let (model, scene, _) = folded(180.0, true);
        let parts = parts(&model, &scene).expect("two parts");
        assert!(turns(&model, &scene, &parts, 0).is_empty());
    }

    /// A model whose photographs share the floor is one, whatever they have in common of the object.
    #[test]
    fn a_whole_model_has_no_parts() {
        let (mut model, scene, _) = folded(0.0, false);
        for k in [VIEWS / 2 - 1, VIEWS - 1] {
            for step in 0..LINKS {
                let position = [0.0, 1.2 + 0.05 * step as f32, 0.0];
                model.points.push(Point { position, color: [90; 3] });
                model.tracks.push([k, (k + 1) % VIEWS].map(|k| k as u32 + 1));
            }
        }
        assert_eq!(parts(&model, &scene), None);
    }
}

//! Cameras for a splat that comes with none.
//!
//! Gaussians lie densest where most was photographed, and that looks right from about where the photographs were taken. There the splat
//! covers the picture, nothing stands right before the camera, and drawings are fine: Gaussians are as large as the pixels were that
//! they were trained on, so that from elsewhere they are drawn large. Directions from all around are judged by small drawings of
//! the splat, coloured by its Gaussians' sizes.

use glam::{DMat3, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::Error;
use super::cameras::{Posed, SIDE, pinhole};
use super::read::{Splat, of_degree};
use super::views::{Artist, config, opaque};
use crate::gpu::Gpu;
use crate::math::harmonics::ZEROTH;
use crate::model::gaussians::Cloud;
use crate::scene::Camera;
use crate::statistics::{median, middle, quantile};

/// Gaussians whose neighbours are counted, at most.
const LOOKED_AT: usize = 50_000;
/// Neighbours whose distance says how dense Gaussians lie.
const NEIGHBOURS: usize = 16;
/// Share of Gaussians, the densest, that what was photographed is among.
const DENSEST: f64 = 0.2;
/// Distances of the cameras, in median distances of these from their middle.
const AWAY: [f64; 2] = [3.6, 2.4];
/// Places that the cameras look at, as shares of the way from that middle to the middle of the surroundings: a photographer before a
/// scene looks past its nearest part.
const PAST: [f64; 3] = [0.0, 0.5, 1.0];
/// Surroundings reach so many of these median distances.
const SURROUNDINGS: f64 = 12.0;
/// Field of view across, radians.
const ACROSS: f64 = 1.05;
/// Directions that are looked from at first, all around.
const AROUND: usize = 120;
/// Size of the drawings by which they are judged, pixels.
const SMALL: [u32; 2] = [64, 48];
/// Part of the distance nearer than which something stands in the way.
const IN_THE_WAY: f64 = 0.3;
/// Costs of a picture that is not covered, and of one with something in the way all over, in natural logarithms of the size drawn.
const UNCOVERED: f64 = 3.0;
const HIDDEN: f64 = 3.0;
/// Cost by which a direction may be worse than the best; directions by whose cost a distance is judged, the best ones; and cost by which a
/// later distance has to be better.
const WORSE: f64 = 0.35;
const BEST: usize = 10;
const BETTER: f64 = 0.25;
/// Angles between neighbouring views, radians: what photographs have, at least and at most.
const APART: [f64; 2] = [0.06, 0.2];
/// A plane holds this share of what is near, at least, to say what is level; its normal is this far from the way to the cameras, radians.
const LEVEL: f64 = 0.1;
const HEAD_ON: f64 = 0.5;

/// The densest part of a splat, and from where it is looked at.
#[derive(Clone)]
struct Subject {
    middle: DVec3,
    /// The middle of the surroundings.
    around: DVec3,
    /// The place between these that is looked at.
    aim: DVec3,
    /// Median distance of the densest from there.
    radius: f64,
    /// From there to the cameras.
    distance: f64,
    up: DVec3,
}

/// Directions as evenly spread as golden angles are.
fn around(count: usize) -> impl Iterator<Item = DVec3> {
    let golden = std::f64::consts::PI * (1.0 + 5f64.sqrt());
    (0..count).map(move |i| {
        let height = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        DVec3::new(cos * (1.0 - height * height).sqrt(), height, sin * (1.0 - height * height).sqrt())
    })
}

impl Subject {
    /// Where Gaussians lie densest.
    fn of(centers: &[DVec3]) -> Option<Self> {
        let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&centers.iter().map(DVec3::to_array).collect::<Vec<_>>());
        let count = std::num::NonZero::new(NEIGHBOURS).expect("some");
        let loose = |at: &DVec3| {
            let near = tree.nearest_n::<SquaredEuclidean>(&at.to_array(), count);
            near.last().map_or(f64::INFINITY, |last| last.distance)
        };
        let loose: Vec<f64> = centers.par_iter().map(loose).collect();
        let most = quantile(loose.iter().copied(), DENSEST)?;
        let mut dense: Vec<DVec3> =
            centers.iter().zip(&loose).filter(|(_, loose)| **loose <= most).map(|(at, _)| *at).collect();
        // Of all, and then of the nearer half.
        let first = middle(&dense)?;
        let far = median(dense.iter().map(|p| p.distance(first)))?;
        dense.retain(|p| p.distance(first) <= far);
        let center = middle(&dense)?;
        let near: Vec<DVec3> = centers.iter().copied().filter(|p| p.distance(center) <= SURROUNDINGS * far).collect();
        let around = middle(&near)?;
        let subject =
            Self { middle: center, around, aim: center, radius: far, distance: AWAY[0] * far, up: DVec3::NEG_Y };
        (far > 0.0 && far.is_finite()).then_some(subject)
    }

    /// The camera in some direction, for pictures of a size.
    fn camera(&self, direction: DVec3, size: [u32; 2]) -> Camera {
        let center = self.middle + self.distance * direction;
        let ahead = (self.aim - center).normalize();
        let sideways = ahead.cross(self.up);
        let right = if sideways.length() > 1e-3 { sideways.normalize() } else { ahead.any_orthonormal_vector() };
        let axes = DMat3::from_cols(right, ahead.cross(right), ahead);
        let rotation = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.as_vec3().to_array());
        let focal = 0.5 * f64::from(size[0]) / (0.5 * ACROSS).tan();
        let translation = Camera::translation_to(&rotation, center.to_array());
        Camera { rotation, translation, ..pinhole(size, [focal; 2]) }
    }

    /// The camera in some direction as a view with a name.
    fn posed(&self, number: usize, direction: DVec3) -> Posed {
        Posed { name: format!("view_{number:03}"), camera: self.camera(direction, [SIDE, SIDE * 3 / 4]) }
    }

    /// Turns the cameras upright: what is level is the plane that most of what is near lies on, and `from` is above it.
    fn stand(&mut self, centers: &[DVec3], from: DVec3) {
        let near: Vec<DVec3> = centers.iter().copied().filter(|p| p.distance(self.middle) <= self.distance).collect();
        if near.len() < 100 {
            return;
        }
        let thick = 0.01 * self.distance;
        let step = near.len().div_ceil(2000);
        let plane = |i: usize| {
            // Three that lie anywhere, as golden ratios choose.
            let [a, b, c] = [0.618_034, 0.754_878, 0.569_840]
                .map(|by: f64| near[((by * (i + 1) as f64).fract() * near.len() as f64) as usize]);
            let normal = (b - a).cross(c - a).try_normalize()?;
            let on = near.iter().step_by(step).filter(|p| (**p - a).dot(normal).abs() <= thick).count();
            Some((on, normal))
        };
        let best = (0..2000usize).into_par_iter().filter_map(plane).max_by_key(|(on, _)| *on);
        let Some((on, normal)) = best else { return };
        let normal = if normal.dot(from) < 0.0 { -normal } else { normal };
        if (on * step) as f64 >= LEVEL * near.len() as f64 && normal.angle_between(from) >= HEAD_ON {
            self.up = normal;
        }
    }
}

/// The splat's Gaussians in grey by their sizes, and what black and white stand for, natural logarithms.
fn by_size(cloud: &Cloud) -> Option<(Cloud, [f64; 2])> {
    let size = |scale: &[f32; 3]| {
        let mut scale = scale.map(f64::from);
        scale.sort_by(f64::total_cmp);
        0.5 * (scale[1] + scale[2])
    };
    let sizes: Vec<f64> = cloud.log_scale.iter().map(size).collect();
    let [low, high] = [0.001, 0.999].map(|part| quantile(sizes.iter().copied(), part));
    let (low, high) = (low?, high?.max(low? + 1e-3));
    let mut grey = of_degree(cloud, 0);
    let value = |size: &f64| (((size - low) / (high - low)).clamp(0.0, 1.0) - 0.5) / ZEROTH;
    grey.harmonics = sizes.iter().map(|size| [value(size) as f32; 3]).collect();
    Some((grey, [low, high]))
}

/// A direction, and before it what it costs to be looked from.
type Judged = (f64, DVec3);

/// At most `count` cameras that look at what a splat is of, from where it looks right; `said` hears how many drawings were judged.
///
/// # Errors
/// A splat of too little; when the device has no room, or is lost.
pub fn cameras(
    gpu: &Gpu,
    splat: &Splat,
    count: usize,
    said: &mut dyn FnMut(u64) -> Result<(), Error>,
) -> Result<Vec<Posed>, Error> {
    let nothing = || {
        let what = "too few of the splat's Gaussians are opaque to choose views of them: name cameras with --cameras";
        Error::Request(what.to_owned())
    };
    let all: Vec<usize> = opaque(splat).collect();
    let center = |i: &usize| DVec3::from_array(splat.cloud.position[*i].map(f64::from));
    let centers: Vec<DVec3> = all.iter().step_by(all.len().div_ceil(LOOKED_AT).max(1)).map(center).collect();
    let subject = Subject::of(&centers).ok_or_else(nothing)?;
    let mut drawn = splat.cloud.clone();
    drawn.retain(&splat.drawn);
    let (grey, [low, high]) = by_size(&drawn).ok_or_else(nothing)?;
    let mut artist = Artist::new(gpu, &grey, &config(subject.distance))?;
    let mut judged = 0;
    let mut judge = |direction: DVec3, subject: &Subject| -> Result<f64, Error> {
        let camera = subject.camera(direction, SMALL);
        let picture = artist.draw(&camera)?;
        judged += 1;
        said(judged)?;
        let (mut covered, mut size, mut hidden) = (0.0, 0.0, 0.0);
        for (i, left) in picture.transmittance.iter().enumerate() {
            let part = 1.0 - f64::from(*left);
            let depth = f64::from(picture.depth[i]) / part.max(1e-6);
            covered += part;
            size += f64::from(picture.rgb[i][0]) * (high - low) + part * (low - depth.max(1e-12).ln());
            hidden += if depth < IN_THE_WAY * subject.distance { part } else { 0.0 };
        }
        let pixels = picture.transmittance.len() as f64;
        let (size, covered, hidden) = (size / covered.max(1e-6), covered / pixels, hidden / pixels);
        Ok(size + UNCOVERED * (1.0 - covered) + HIDDEN * hidden)
    };
    let mut found: Option<(f64, Subject, Vec<Judged>)> = None;
    for (away, past) in AWAY.into_iter().flat_map(|away| PAST.map(|past| (away, past))) {
        let from = Subject {
            distance: away * subject.radius,
            aim: subject.middle.lerp(subject.around, past),
            ..subject.clone()
        };
        let mut judged =
            around(AROUND).map(|to| Ok((judge(to, &from)?, to))).collect::<Result<Vec<Judged>, Error>>()?;
        judged.sort_by(|a, b| a.0.total_cmp(&b.0));
        let cost = judged.iter().take(BEST).map(|(cost, _)| cost).sum::<f64>() / BEST as f64;
        if found.as_ref().is_none_or(|(best, ..)| cost < best - BETTER) {
            found = Some((cost, from, judged));
        }
    }
    let (_, mut subject, coarse) = found.expect("there are distances");
    let best = coarse[0].0;
    let good: Vec<DVec3> = coarse.into_iter().filter(|(cost, _)| *cost <= best + WORSE).map(|(_, to)| to).collect();
    subject.stand(&centers, good.iter().sum::<DVec3>().normalize_or_zero());
    // As far apart as many of them fill what is good, twice over.
    let area = 4.0 * std::f64::consts::PI * good.len() as f64 / AROUND as f64;
    let apart = (area / count as f64).sqrt().clamp(APART[0], APART[1]);
    let reach = (4.0 * std::f64::consts::PI / AROUND as f64).sqrt();
    let finer = (8.0 * std::f64::consts::PI / (apart * apart)) as usize;
    let mut fine = vec![];
    for direction in around(finer).filter(|to| good.iter().any(|good| good.angle_between(*to) <= 0.7 * reach)) {
        fine.push((judge(direction, &subject)?, direction));
    }
    fine.sort_by(|a, b| a.0.total_cmp(&b.0));
    let chosen = connected(&fine, count, apart);
    if chosen.len() < 3 {
        let what = "the splat looks right from too few places to choose views of it: name cameras with --cameras";
        return Err(Error::Request(what.to_owned()));
    }
    Ok(chosen.into_iter().enumerate().map(|(i, to)| subject.posed(i, to)).collect())
}

/// Directions of least cost (`judged`, by cost) that hang together: each is near another, and none too near. In their order around the first.
fn connected(judged: &[Judged], count: usize, apart: f64) -> Vec<DVec3> {
    let Some((best, first)) = judged.first().copied() else { return vec![] };
    let mut taken = vec![first];
    while taken.len() < count {
        let next = judged.iter().filter(|(cost, _)| *cost <= best + WORSE).find(|(_, to)| {
            let near = taken.iter().map(|other| other.angle_between(*to)).fold(f64::INFINITY, f64::min);
            (0.8 * apart..=2.5 * apart).contains(&near)
        });
        let Some((_, next)) = next else { break };
        taken.push(*next);
    }
    // Neighbours follow one another.
    let mut order = vec![taken.swap_remove(0)];
    while !taken.is_empty() {
        let last = order[order.len() - 1];
        let nearest = (0..taken.len()).min_by(|a, b| {
            let far = |i: usize| taken[i].angle_between(last);
            far(*a).total_cmp(&far(*b))
        });
        order.push(taken.swap_remove(nearest.expect("some are left")));
    }
    order
}

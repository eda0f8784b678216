//! A few clicks become a mask: colours, places in space, distances along the picture and what other views say, in one
//! minimum cut.
//!
//! Geodesic graph cuts (Price et al. 2010) over the colour models of [`super::graph_cut`]. A pixel is the nearer to a click
//! the less the picture changes on the way to it. With a depth map, places join in: mixtures of Gaussians over the points
//! that pixels show tell what stands on a ground from the ground, and what lies metres behind from both, however alike
//! their colours are; and a jump in depth is a border.
//!
//! A cut at a small size finds the object, a second one around it draws its border. A further click changes the mask around
//! it, the farther it is from the outline the farther, and leaves the rest as it is; so does the first one in a view to which
//! other views' masks were carried.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use image::{GrayImage, RgbImage};
use serde::{Deserialize, Serialize};

use super::depth::DepthMap;
use super::graph_cut::{self, COMPONENTS, Grid, Mixture, SHIFTS, SMOOTHNESS, UNIT};
use super::masks;
use crate::scene::resample;
use crate::statistics::median;

/// A user's mark in a photograph. Positions are parts of its width and height, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Mark {
    /// The object is here.
    Object {
        /// Where.
        at: [f64; 2],
    },
    /// The object is not here.
    Background {
        /// Where.
        at: [f64; 2],
    },
    /// The object is in here, and fills it: x0, y0, x1, y1.
    Box {
        /// Where.
        bounds: [f64; 4],
    },
}

impl Mark {
    /// Whether it lies within the photograph; a box must have an inside.
    pub fn is_sound(&self) -> bool {
        let within = |v: &f64| (0.0..=1.0).contains(v);
        match self {
            Self::Object { at } | Self::Background { at } => at.iter().all(within),
            Self::Box { bounds } => {
                bounds.iter().all(within) && bounds[2] - bounds[0] >= SMALLEST && bounds[3] - bounds[1] >= SMALLEST
            }
        }
    }
}

/// Least side of a box, of the photograph's.
const SMALLEST: f64 = 0.004;

/// Knowledge of a photograph besides its colours.
#[derive(Clone, Copy, Default)]
pub struct Cues<'a> {
    /// The fit's depth.
    pub depth: Option<&'a DepthMap>,
    /// The votes of other views' masks: the object's part of each pixel, 0 to 1, and width and height.
    pub carried: Option<(&'a [f32], [u32; 2])>,
}

/// Radius of what a click touches, of the picture's longer side.
const TOUCH: f64 = 0.006;
/// Colours that differ by less, of 255, are touched by the same click.
const ALIKE: f64 = 24.0;
/// Rounds of models and cuts, of the first cut and the second.
const ROUNDS: [u32; 2] = [4, 2];
/// The longer sides of their pictures, pixels.
const SIDES: [u32; 2] = [192, 288];
/// Pixels that a mixture is made of at most.
const SAMPLES: usize = 3000;
/// The most that colours and that places may say of a pixel, in nats.
const MOST: [f64; 2] = [8.0, 8.0];
/// The weight of being nearer to a click than to anything else, in nats.
const NEAR: f64 = 4.0;
/// Nearer than this to a click, from -1 to 1, is the object to begin with.
const NEARER: f64 = 0.33;
/// A place so far from where the background is, squared and in its deviations, is as likely to be the object as not.
const OFF: f64 = 9.0;
/// Depths of the fit are right within this part.
const ROUGH: f64 = 0.01;
/// Neighbours whose depths differ by this part are parted.
const JUMP: f64 = 0.04;
/// The window of the second cut is larger than what the first one found by this part on every side.
const AROUND: f64 = 0.35;
/// The first so many marks are taken together.
const TOGETHER: usize = 3;
/// With a depth, a click nearer to the outline than this part of the root of the mask's area is about the outline.
const AFAR: f64 = 0.1;
/// A click changes what lies within so many times its distance from the outline.
const REACH: f64 = 6.0;
/// The weight of being nearer to it than to what says otherwise, in nats.
const AGAIN: f64 = 8.0;
/// Nearer than this is certain.
const SURE: f64 = 0.6;
/// The weight of leaving the rest as it is, in nats.
const STAYS: f64 = 16.0;
/// Votes of other views beyond this are the object.
const VOTED: f32 = masks::OBJECT;

/// A part of the picture: x, y, width and height in its pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Window([u32; 4]);

impl Window {
    fn whole(picture: &RgbImage) -> Self {
        Self([0, 0, picture.width(), picture.height()])
    }

    /// Around x0, y0, x1, y1, wider by a part of its sides.
    fn around(bounds: [f64; 4], part: f64, [w, h]: [u32; 2]) -> Self {
        let [x0, y0, x1, y1] = bounds;
        let margin = [(x1 - x0) * part + 8.0, (y1 - y0) * part + 8.0];
        let low = [x0 - margin[0], y0 - margin[1]].map(|v| v.max(0.0) as u32);
        let far = [(x1 + margin[0]).ceil() as u32, (y1 + margin[1]).ceil() as u32];
        Self([low[0], low[1], far[0].min(w) - low[0], far[1].min(h) - low[1]])
    }

    fn size(self) -> [u32; 2] {
        [self.0[2], self.0[3]]
    }
}

/// The object that the marks mean, as large as the picture: one mark after the other. Without a mark what other views say.
pub fn mask(picture: &RgbImage, marks: &[Mark], cues: &Cues<'_>) -> GrayImage {
    let before = voted(picture, cues);
    (1..=marks.len()).fold(before, |before, count| next(picture, &marks[..count], &before, cues))
}

/// The mask that other views' votes make of a picture.
fn voted(picture: &RgbImage, cues: &Cues<'_>) -> GrayImage {
    let to = [picture.width(), picture.height()];
    cues.carried.map_or_else(|| GrayImage::new(to[0], to[1]), |(parts, from)| masks::threshold(parts, from, to, VOTED))
}

/// [`mask`] for one more mark, the last of these, than made the mask `before`. A click on a mask changes what is around it, a
/// box begins anew.
pub fn next(picture: &RgbImage, marks: &[Mark], before: &GrayImage, cues: &Cues<'_>) -> GrayImage {
    let there = before.as_raw().iter().any(|v| *v != 0);
    match marks.last() {
        // One click seldom finds it at once: the first ones are better taken together, unless all but the rim is there.
        Some(last)
            if cues.carried.is_none() && marks.len() <= TOGETHER && (cues.depth.is_none() || is_afar(before, last)) =>
        {
            found(picture, marks, cues)
        }
        Some(Mark::Object { .. } | Mark::Background { .. }) if there => {
            edited(picture, marks, before, cues.depth).unwrap_or_else(|| before.clone())
        }
        _ => found(picture, marks, cues),
    }
}

/// Whether a click is too far from a mask's outline to be about the outline alone.
fn is_afar(before: &GrayImage, click: &Mark) -> bool {
    let (at, adds) = match click {
        Mark::Object { at } => (*at, true),
        Mark::Background { at } => (*at, false),
        Mark::Box { .. } => return true,
    };
    let [x, y] = [at[0] * f64::from(before.width()), at[1] * f64::from(before.height())];
    let on = || before.enumerate_pixels().filter(|pixel| (pixel.2.0[0] != 0) == adds);
    let nearest = on().map(|(u, v, _)| f64::hypot(f64::from(u) + 0.5 - x, f64::from(v) + 0.5 - y));
    let area = before.as_raw().iter().filter(|v| **v != 0).count() as f64;
    nearest.fold(f64::INFINITY, f64::min) > AFAR * area.sqrt()
}

/// The object that the marks mean, from the beginning.
fn found(picture: &RgbImage, marks: &[Mark], cues: &Cues<'_>) -> GrayImage {
    let full = [picture.width(), picture.height()];
    let empty = GrayImage::new(full[0], full[1]);
    if !marks.iter().any(|mark| !matches!(mark, Mark::Background { .. })) {
        return empty;
    }
    let mut bounds: Option<[f64; 4]> = None;
    let scaled = |v: [f64; 4]| {
        [0, 1, 0, 1].map(|axis| f64::from(full[axis])).iter().zip(v).map(|(s, v)| s * v).collect::<Vec<_>>()
    };
    let mut take = |v: &[f64]| {
        let old = bounds.unwrap_or([v[0], v[1], v[2], v[3]]);
        bounds = Some([old[0].min(v[0]), old[1].min(v[1]), old[2].max(v[2]), old[3].max(v[3])]);
    };
    let boxed = marks.iter().any(|mark| matches!(mark, Mark::Box { .. }));
    for mark in marks {
        match mark {
            Mark::Box { bounds } => take(&scaled(*bounds)),
            Mark::Object { at: [x, y] } if boxed => take(&scaled([*x, *y, *x, *y])),
            _ => {}
        }
    }
    let first = match bounds {
        Some(bounds) => Window::around(bounds, 0.5, full),
        None => Window::whole(picture),
    };
    let Some(found) = cut(picture, first, marks, cues, None) else { return empty };
    let Some(bounds) = bounds_of(&found) else { return empty };
    let second = Window::around(bounds, AROUND, full);
    let side = |window: Window| window.0[2].max(window.0[3]);
    if f64::from(side(second)) > 0.7 * f64::from(side(first)) {
        return found;
    }
    cut(picture, second, marks, cues, Some(&found)).unwrap_or(found)
}

/// x0, y0 and one past x1, y1 of what is not 0.
fn bounds_of(mask: &GrayImage) -> Option<[f64; 4]> {
    let on = || mask.enumerate_pixels().filter(|(_, _, v)| v.0[0] != 0);
    let (x0, x1) = (on().map(|(x, _, _)| x).min()?, on().map(|(x, _, _)| x).max()?);
    let (y0, y1) = (on().map(|(_, y, _)| y).min()?, on().map(|(_, y, _)| y).max()?);
    Some([x0, y0, x1 + 1, y1 + 1].map(f64::from))
}

/// The evidence of a cut, pixel by pixel of its small picture.
struct Pixels {
    size: [usize; 2],
    colors: Vec<[f64; 3]>,
    /// Where in space, in units of the depth's roughness; and the logarithm of the depth.
    places: Vec<Option<([f64; 3], f64)>>,
    /// Clicks.
    touched: Vec<Option<bool>>,
    /// Outside all boxes, where there are any.
    outside: Vec<bool>,
}

impl Pixels {
    fn of(picture: &RgbImage, window: Window, side: u32, marks: &[Mark], cues: &Cues<'_>) -> Self {
        let [x0, y0, w, h] = window.0;
        let to = graph_cut::within(window.size(), side);
        let small = resample::photograph(&image::imageops::crop_imm(picture, x0, y0, w, h).to_image(), to);
        let full = [picture.width(), picture.height()].map(f64::from);
        // Centres of the small picture's pixels, as parts of the whole picture.
        let at = |i: usize| -> [f64; 2] {
            let (x, y) = ((i % to[0] as usize) as f64 + 0.5, (i / to[0] as usize) as f64 + 0.5);
            [
                (f64::from(x0) + x * f64::from(w) / f64::from(to[0])) / full[0],
                (f64::from(y0) + y * f64::from(h) / f64::from(to[1])) / full[1],
            ]
        };
        let count = (to[0] * to[1]) as usize;
        let boxes: Vec<[f64; 4]> =
            marks.iter().filter_map(|m| if let Mark::Box { bounds } = m { Some(*bounds) } else { None }).collect();
        let outside = (0..count)
            .map(|i| {
                let [x, y] = at(i);
                let within = |b: &[f64; 4]| x >= b[0] && x <= b[2] && y >= b[1] && y <= b[3];
                !boxes.is_empty() && !boxes.iter().any(within)
            })
            .collect();
        let mut touched = vec![None; count];
        // At least the pixel that a click falls into, in a circle of the whole picture's proportions.
        let pixel = f64::from(w) / f64::from(to[0]);
        let radius = (TOUCH * full[0].max(full[1])).max(1.2 * pixel);
        for mark in marks {
            let (at_click, object) = match mark {
                Mark::Object { at } => (at, true),
                Mark::Background { at } => (at, false),
                Mark::Box { .. } => continue,
            };
            let far = |i: usize| {
                let d = at(i);
                f64::hypot((d[0] - at_click[0]) * full[0], (d[1] - at_click[1]) * full[1])
            };
            // Of the pixels around the nearest one those that look like it: a click may lie at a rim.
            let color = |i: usize| small.as_raw()[3 * i..3 * i + 3].iter().map(|v| f64::from(*v));
            let Some(nearest) = (0..count).min_by(|a, b| far(*a).total_cmp(&far(*b))) else { continue };
            // In the window of the second cut there may be nothing of it.
            if far(nearest) > radius {
                continue;
            }
            for (i, touched) in touched.iter_mut().enumerate().filter(|(i, _)| far(*i) <= radius) {
                let differs: f64 = color(i).zip(color(nearest)).map(|(a, b)| (a - b).powi(2)).sum();
                if differs <= ALIKE * ALIKE {
                    *touched = Some(object);
                }
            }
        }
        let places = (0..count)
            .map(|i| {
                let map = cues.depth?;
                let pixel: [f64; 2] = std::array::from_fn(|k| at(i)[k] * f64::from(map.camera.size[k]));
                let depth = f64::from(map.at(pixel));
                let [x, y] = map.camera.unproject(pixel).filter(|_| depth > 0.0)?;
                Some(([x * depth, y * depth, depth], depth.ln()))
            })
            .collect::<Vec<_>>();
        let mut pixels = Self {
            size: to.map(|n| n as usize),
            colors: small.pixels().map(|p| p.0.map(f64::from)).collect(),
            places,
            touched,
            outside,
        };
        pixels.scale_places();
        pixels
    }

    /// Brings places into units of the depth's roughness where the object is.
    fn scale_places(&mut self) {
        let on = |i: usize| self.touched[i] == Some(true);
        let near = |of: &dyn Fn(usize) -> bool| {
            median((0..self.places.len()).filter(|i| of(*i)).filter_map(|i| Some(self.places[i]?.0[2])))
        };
        let Some(depth) = near(&on).or_else(|| near(&|i| !self.outside[i])) else { return };
        let unit = depth * ROUGH;
        self.places.iter_mut().flatten().for_each(|(place, _)| *place = place.map(|v| v / unit));
    }

    /// How far neighbours are apart: by colour, and by depth.
    fn apart(&self, i: usize, j: usize) -> (f64, f64) {
        let color = (0..3).map(|c| (self.colors[i][c] - self.colors[j][c]).powi(2)).sum::<f64>();
        let jump = match (&self.places[i], &self.places[j]) {
            (Some((_, a)), Some((_, b))) => ((a - b) / JUMP).abs().min(1.0),
            _ => 0.0,
        };
        (color, jump)
    }

    /// The pairs of neighbours: a pixel, the direction, the other pixel, the length.
    fn pairs(&self) -> impl Iterator<Item = (usize, usize, usize, f64)> {
        let [w, h] = self.size;
        (0..w * h).flat_map(move |i| {
            SHIFTS.into_iter().enumerate().skip(4).filter_map(move |(d, [dx, dy])| {
                let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
                let inside = x >= 0 && x < w as isize && y < h as isize;
                inside.then(|| (i, d, y as usize * w + x as usize, f64::hypot(dx as f64, dy as f64)))
            })
        })
    }

    /// Distances from some pixels, along which every change of the picture counts.
    fn distances(&self, from: impl Iterator<Item = usize>) -> Vec<f32> {
        let [w, h] = self.size;
        let mut distance = vec![f32::INFINITY; w * h];
        // Distances are not negative: their bits are ordered as they are.
        let mut queue = BinaryHeap::new();
        for i in from {
            distance[i] = 0.0;
            queue.push((Reverse(0u32), i));
        }
        while let Some((Reverse(bits), i)) = queue.pop() {
            if f32::from_bits(bits) > distance[i] {
                continue;
            }
            for [dx, dy] in SHIFTS {
                let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
                if x < 0 || y < 0 || x >= w as isize || y >= h as isize {
                    continue;
                }
                let j = y as usize * w + x as usize;
                let (color, jump) = self.apart(i, j);
                let step = (0.5 + color.sqrt() / 8.0 + 8.0 * jump) * f64::hypot(dx as f64, dy as f64);
                let far = distance[i] + step as f32;
                if far < distance[j] {
                    distance[j] = far;
                    queue.push((Reverse(far.to_bits()), j));
                }
            }
        }
        distance
    }

    fn is_border(&self, i: usize) -> bool {
        let [w, h] = self.size;
        let (x, y) = (i % w, i / w);
        x == 0 || y == 0 || x + 1 == w || y + 1 == h
    }
}

/// Some of these at most, evenly spread.
fn some<T: Copy>(all: &[T]) -> Vec<T> {
    all.iter().step_by(all.len().div_ceil(SAMPLES).max(1)).copied().collect()
}

/// The models of the two sides: by how many nats a value speaks for the object.
struct Sides(Mixture, Mixture);

impl Sides {
    fn of(inside: &[[f64; 3]], outside: &[[f64; 3]]) -> Option<Self> {
        let model = |values: &[[f64; 3]], side: usize| {
            (values.len() > 8).then(|| Mixture::of(&some(values), COMPONENTS[side], side as u64 + 1))
        };
        Some(Self(model(inside, 0)?, model(outside, 1)?))
    }

    fn speaks(&self, value: [f64; 3], most: f64) -> f64 {
        (self.1.cost(value) - self.0.cost(value)).clamp(-most, most)
    }
}

/// The cheapest labelling, models and cuts in turn from `object` on; `beside` speaks for the object as well, in nats, and
/// colours are learnt where `learns` says so. Nothing where one side runs out of pixels.
fn solve(
    pixels: &Pixels,
    mut object: Vec<bool>,
    rounds: u32,
    beside: impl Fn(usize) -> f64,
    learns: impl Fn(usize) -> bool,
) -> Option<Vec<bool>> {
    let count = object.len();
    let mean = {
        let (sum, pairs) =
            pixels.pairs().fold((0.0, 0u64), |(sum, n), (i, _, j, _)| (sum + pixels.apart(i, j).0, n + 1));
        sum / pairs.max(1) as f64
    };
    let beta = if mean > 0.0 { 0.5 / mean } else { 0.0 };
    let edges: Vec<(usize, usize, i32)> = pixels
        .pairs()
        .map(|(i, d, j, length)| {
            let (color, jump) = pixels.apart(i, j);
            let cost = SMOOTHNESS[0] * (-beta * color - 2.0 * jump).exp() / length;
            (i, d, (UNIT * cost) as i32)
        })
        .collect();
    for round in 0..rounds {
        let of = |side: bool| -> Vec<usize> { (0..count).filter(|i| object[*i] == side).collect() };
        let behind: Vec<[f64; 3]> = of(false).iter().filter_map(|i| Some(pixels.places[*i]?.0)).collect();
        let behind = (behind.len() > 8).then(|| Mixture::of(&some(&behind), COMPONENTS[1], 3));
        // By how much a pixel's place speaks for the object: how far it is from where the background goes on.
        let off = |i: usize| match (&behind, pixels.places[i]) {
            (Some(behind), Some((place, _))) => (0.5 * (behind.distance(place) - OFF)).clamp(-MOST[1], MOST[1]),
            _ => 0.0,
        };
        let off: Vec<f64> = (0..count).map(off).collect();
        let colors = |pixels_of: &[usize]| -> Vec<[f64; 3]> { pixels_of.iter().map(|i| pixels.colors[*i]).collect() };
        // Colours are not learnt from what lies where the background is.
        let inside = of(true);
        let local = |all: Vec<usize>| -> Vec<usize> { all.into_iter().filter(|i| learns(*i)).collect() };
        let (inside, outside) = (local(inside), local(of(false)));
        let sound: Vec<usize> = inside.iter().copied().filter(|i| off[*i] >= 0.0).collect();
        let inside = if 4 * sound.len() > inside.len() { sound } else { inside };
        let by_color = Sides::of(&colors(&inside), &colors(&outside))?;
        let mut grid = Grid::new(pixels.size, &SHIFTS);
        for &(i, d, cost) in &edges {
            grid.set_edge(i, d, cost);
        }
        let sure = (UNIT * 1e4) as i64;
        for (i, off) in off.iter().enumerate() {
            match pixels.touched[i] {
                Some(true) => grid.set_terminals(i, sure, 0),
                Some(false) => grid.set_terminals(i, 0, sure),
                None if pixels.outside[i] => grid.set_terminals(i, 0, sure),
                None => {
                    let sum = by_color.speaks(pixels.colors[i], MOST[0]) + off + beside(i);
                    grid.set_terminals(i, (UNIT * sum.max(0.0)) as i64, (UNIT * (-sum).max(0.0)) as i64);
                }
            }
        }
        let labels = grid.cut();
        let same = labels == object;
        object = labels;
        if same && round > 0 {
            break;
        }
    }
    Some(object)
}

/// The object in a window, as a mask of the whole picture; nothing where one side runs out of pixels.
fn cut(
    picture: &RgbImage,
    window: Window,
    marks: &[Mark],
    cues: &Cues<'_>,
    found: Option<&GrayImage>,
) -> Option<GrayImage> {
    let pass = usize::from(found.is_some());
    let pixels = Pixels::of(picture, window, SIDES[pass], marks, cues);
    let [w, h] = pixels.size;
    let count = w * h;
    let [x0, y0, wide, high] = window.0;
    let small = [w as u32, h as u32];
    let before: Option<Vec<bool>> = found.map(|found| {
        let part = image::imageops::crop_imm(found, x0, y0, wide, high).to_image();
        resample::nearest(&part, small).as_raw().iter().map(|v| *v != 0).collect()
    });
    let was = |i: usize| before.as_ref().is_some_and(|before| before[i]);
    let boxed = pixels.outside.iter().any(|outside| *outside);
    let clicked = pixels.touched.contains(&Some(true));
    // Nearer to the object's clicks, or to what is not the object: from -1 to 1.
    let near: Option<Vec<f64>> = clicked.then(|| {
        let objects = (0..count).filter(|i| pixels.touched[*i] == Some(true));
        let objects = pixels.distances(objects);
        let others = (0..count)
            .filter(|i| pixels.touched[*i] == Some(false) || pixels.outside[*i] || pixels.is_border(*i) && !was(*i));
        let others = pixels.distances(others);
        let side = |(a, b): (&f32, &f32)| if b.is_infinite() { 1.0 } else { f64::from((b - a) / (a + b).max(1e-6)) };
        objects.iter().zip(&others).map(side).collect()
    });
    let object: Vec<bool> = (0..count)
        .map(|i| match (&before, pixels.touched[i]) {
            (_, Some(side)) => side,
            (Some(before), None) => before[i],
            _ if boxed => !pixels.outside[i],
            _ => near.as_ref().is_some_and(|near| near[i] > NEARER),
        })
        .collect();
    let beside = |i: usize| near.as_ref().map_or(0.0, |near| NEAR * near[i]);
    let object = solve(&pixels, object, ROUNDS[pass], beside, |_| true)?;
    whole(picture, window, small, joined(object, &pixels, boxed))
}

/// Labels of a window as a mask of the whole picture; nothing where there is no object.
fn whole(picture: &RgbImage, window: Window, small: [u32; 2], labels: Vec<bool>) -> Option<GrayImage> {
    if labels.iter().all(|on| !on) {
        return None;
    }
    let [x0, y0, wide, high] = window.0;
    let raw = labels.into_iter().map(|on| if on { 255 } else { 0 }).collect();
    let mask = GrayImage::from_raw(small[0], small[1], raw)?;
    let mask = masks::threshold(&masks::parts(&mask, small), small, [wide, high], 0.5);
    let mut whole = GrayImage::new(picture.width(), picture.height());
    image::imageops::replace(&mut whole, &mask, i64::from(x0), i64::from(y0));
    Some(whole)
}

/// A mask as one more click changes it, around the click: the farther it is from the outline, the farther.
fn edited(picture: &RgbImage, marks: &[Mark], before: &GrayImage, depth: Option<&DepthMap>) -> Option<GrayImage> {
    let full = [picture.width(), picture.height()];
    let (at, adds) = match marks.last()? {
        Mark::Object { at } => (*at, true),
        Mark::Background { at } => (*at, false),
        Mark::Box { .. } => return None,
    };
    let click: [u32; 2] = std::array::from_fn(|k| ((at[k] * f64::from(full[k])) as u32).min(full[k] - 1));
    if (before.get_pixel(click[0], click[1]).0[0] != 0) == adds {
        return Some(before.clone());
    }
    let [x, y] = click.map(f64::from);
    let bounds = bounds_of(before)?;
    let bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x + 1.0), bounds[3].max(y + 1.0)];
    let window = Window::around(bounds, AROUND, full);
    let pixels = Pixels::of(picture, window, SIDES[1], marks, &Cues { depth, carried: None });
    let [w, h] = pixels.size;
    let [x0, y0, wide, high] = window.0;
    let small = [w as u32, h as u32];
    let part = image::imageops::crop_imm(before, x0, y0, wide, high).to_image();
    let was: Vec<bool> = resample::nearest(&part, small).as_raw().iter().map(|v| *v != 0).collect();
    let scale = w as f64 / f64::from(wide);
    let own = [(x - f64::from(x0)) * scale, (y - f64::from(y0)) * scale];
    let far = |i: usize| f64::hypot((i % w) as f64 + 0.5 - own[0], (i / w) as f64 + 0.5 - own[1]);
    let rim = (0..w * h).filter(|i| was[*i] == adds).map(far).fold(f64::INFINITY, f64::min);
    let reach = if rim.is_finite() { REACH * rim + 3.0 } else { f64::INFINITY };
    let nearest = (0..w * h).min_by(|a, b| far(*a).total_cmp(&far(*b)))?;
    let mine = pixels.distances(std::iter::once(nearest));
    let others = pixels.distances((0..w * h).filter(|i| {
        pixels.touched[*i] == Some(!adds) || adds && (pixels.outside[*i] || pixels.is_border(*i) && !was[*i])
    }));
    // Nearer to this click than to what says otherwise, for the object: from -1 to 1.
    let near = |i: usize| {
        let (a, b) = (mine[i], others[i]);
        let side = if b.is_infinite() { 1.0 } else { f64::from((b - a) / (a + b).max(1e-6)) };
        if adds { side } else { -side }
    };
    let object: Vec<bool> = (0..w * h)
        .map(|i| match pixels.touched[i] {
            Some(side) => side,
            None if far(i) <= reach && (near(i) > NEARER) == adds && near(i).abs() > NEARER => adds,
            None => was[i],
        })
        .collect();
    let beside = |i: usize| {
        let stays = if was[i] { 1.0 } else { -1.0 };
        match near(i) {
            _ if far(i) > reach => STAYS * stays,
            // What hangs together with the click follows it, whatever it looks like.
            near if near.abs() > SURE && (near > 0.0) == adds => STAYS * near.signum(),
            near => AGAIN * near + stays,
        }
    };
    let labels = solve(&pixels, object, ROUNDS[1], beside, |i| far(i) <= reach)?;
    whole(picture, window, small, labels)
}

/// Pieces of an object that are smaller than this part of the largest are none of it, unless a click says so.
const SPECK: f64 = 0.05;

/// The pieces that a click has touched; in a box without one all but specks.
fn joined(object: Vec<bool>, pixels: &Pixels, boxed: bool) -> Vec<bool> {
    let [w, h] = pixels.size;
    let mut piece = vec![0usize; w * h];
    // Pixels, and those clicked.
    let mut sizes = vec![[0usize; 2]];
    for start in 0..w * h {
        if !object[start] || piece[start] != 0 {
            continue;
        }
        let number = sizes.len();
        sizes.push([0; 2]);
        let mut open = vec![start];
        piece[start] = number;
        while let Some(i) = open.pop() {
            sizes[number][0] += 1;
            sizes[number][1] += usize::from(pixels.touched[i] == Some(true));
            for [dx, dy] in SHIFTS {
                let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
                if x < 0 || y < 0 || x >= w as isize || y >= h as isize {
                    continue;
                }
                let j = y as usize * w + x as usize;
                if object[j] && piece[j] == 0 {
                    piece[j] = number;
                    open.push(j);
                }
            }
        }
    }
    let largest = sizes.iter().map(|size| size[0]).max().unwrap_or(0) as f64;
    let clicked = sizes.iter().any(|size| size[1] > 0);
    let stays = |[all, clicks]: [usize; 2]| clicks > 0 || boxed && !clicked && all as f64 >= SPECK * largest;
    (0..w * h).map(|i| object[i] && stays(sizes[piece[i]])).collect()
}

#[cfg(test)]
mod tests;

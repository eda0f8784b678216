//! A few clicks become a mask: colours, places in space, distances along the picture and what other views say, in one
//! minimum cut.
//!
//! Geodesic graph cuts (Price et al. 2010) over the colour models of [`super::graph_cut`]. A pixel is the nearer to a
//! click the less the picture changes on the way to it. With a depth map, places join in: mixtures of Gaussians over
//! the points that pixels show tell what stands on a ground from the ground, and what lies metres behind from both,
//! however alike their colours are; and a jump in depth is a border.
//!
//! A cut at a small size finds the object, a second one around it draws its border. A further click changes the mask
//! around it, the farther it is from the outline the farther, and leaves the rest as it is; so does the first one in a
//! view to which other views' masks were carried. What it may not change is in [`next`]. Who wants a larger or smaller
//! part than a click takes by itself goes along the segments of several scales about it (`tree`).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use image::{GrayImage, RgbImage};

use super::depth::DepthMap;
use super::graph_cut::{self, COMPONENTS, Mixture, SMOOTHNESS, UNIT, some};
use super::masks;
use super::min_cut::{Grid, SHIFTS};
use super::planes;
use crate::scene::resample;
use crate::statistics::{median, quantile};

mod boxed;
mod mark;
mod tree;

pub use boxed::from_box;
pub use mark::{MOST_POINTS, Mark};
use tree::Tree;

/// The longer side of the pictures that are marked, pixels.
const MARKED: u32 = 1024;

/// The size at which a photograph of this size is marked: as it is, or with the longer side at 1,024 pixels.
pub fn working(size: [u32; 2]) -> [u32; 2] {
    graph_cut::within(size, MARKED)
}

/// Knowledge of a photograph besides its colours.
#[derive(Clone, Copy, Default)]
pub struct Cues<'a> {
    /// The fit's depth, known everywhere and nowhere sharp.
    pub depth: Option<&'a DepthMap>,
    /// Depth as it is measured between photographs, which counts for what is drawn around something.
    pub measured: Option<&'a DepthMap>,
    /// The votes of other views' masks: the object's part of each pixel, 0 to 1, and width and height.
    pub carried: Option<(&'a [f32], [u32; 2])>,
    /// Whether where a pixel lies within an outline says nothing: leaves are anywhere in it.
    pub anywhere: bool,
}

impl Cues<'_> {
    /// Whether depth changes across a mask's outline: not that of something flat on a wall, or of a fit that does not know it.
    fn knows(&self, picture: &RgbImage, mask: &GrayImage) -> bool {
        let window = Window::whole(picture);
        let pixels = Pixels::of(picture, window, SIDES[0], &[], self);
        pixels.jump(&labels(mask, window, pixels.size.map(|n| n as u32))) >= FLAT
    }
}

/// Rounds of models and cuts, of the first cut and the second.
const ROUNDS: [u32; 2] = [4, 2];
/// The longer sides of their pictures, pixels.
const SIDES: [u32; 2] = [192, 288];
/// The most that colours and that places may say of a pixel, in nats.
const MOST: [f64; 2] = [8.0, 8.0];
/// The most that being off where the background goes on may say of a pixel within an outline: the foot of a thing is where the ground
/// goes on.
const OUTLINED: f64 = 1.0;
/// The weight of being elsewhere than what an outline is about, in nats: of what is farther behind the part of what the outline's middle
/// shows that is this near, or before it, than these parts of the outline's width, none of it and all.
const AWAY: f64 = 6.0;
const NEARER_PART: f64 = 0.35;
const AS_DEEP: [f64; 2] = [0.5, 0.75];
/// The weight of lying on a plane that goes on outside a box, and of being as deep as what is in it but off all of these, in nats. Such a
/// plane has at least this share of what is known around the box, within the first part of its depth, and what is within the second is
/// on it.
const ON_GROUND: f64 = 4.0;
const RAISED: f64 = 2.0;
const GROUND_SHARE: f64 = 0.02;
const GROUND_THICKNESS: [f64; 2] = [0.007, 0.015];
/// Planes say nothing where less than this part of a box's middle is off them: a picture on a wall.
const LEAST_OFF: f64 = 0.2;
/// The weight of being nearer to a click than to anything else, in nats.
const NEAR: f64 = 4.0;
/// The weight of being within the segment that a click means, in nats.
const SHAPE: f64 = 12.0;
/// The weight of being parted from what is outside a box, in nats.
const ENCLOSED: f64 = 2.0;
/// Cost of a way per pixel along which nothing changes: to clicks, which mean what is near, and out of boxes.
const ALONG: [f64; 2] = [0.5, 0.05];
/// Nearer than this to a click, from -1 to 1, is the object to begin with.
const NEARER: f64 = 0.33;
/// A place so far from where the background is, squared and in its deviations, is as likely to be the object as not.
const OFF: f64 = 9.0;
/// Depth bleeds by so many pixels over what is beside something near, and over its own border by so many.
const BLEEDS: [u32; 2] = [6, 3];
/// Depth that changes by less than this part of a jump across an object's outline does not know the object.
const FLAT: f64 = 0.2;
/// The border of a changed mask is drawn anew within so many pixels of where it was found.
const RIM: usize = 3;
/// Changes are looked at over so many pixels: the fit's depth is not sharp.
const BESIDE: usize = 6;
/// Depths of the fit are right within this part.
const ROUGH: f64 = 0.01;
/// Neighbours whose depths differ by this part are parted.
const JUMP: f64 = 0.04;
/// The window of the second cut is larger than what the first one found by this part on every side.
const AROUND: f64 = 0.35;
/// The first so many marks are taken together.
const TOGETHER: usize = 3;
/// A click nearer to the outline than this part of the root of the mask's area is about the outline.
const AFAR: f64 = 0.1;
/// Such a click changes at most this part of the mask where all marks are taken together.
const BESIDE_PART: f64 = 0.25;
/// A click changes what lies within so many times its distance from the outline.
const REACH: f64 = 6.0;
/// The weight of being nearer to it than to what says otherwise, in nats.
const AGAIN: f64 = 8.0;
/// The weight of what other views' masks say of a pixel, in nats.
const VOTES: f64 = 6.0;
/// Nearer than this is certain.
const SURE: f64 = 0.6;
/// The weight of leaving the rest as it is, in nats.
const STAYS: f64 = 16.0;
/// A further click adds nothing, and takes nothing away, beyond so many times the reach of the piece that it is on.
const NEARBY: [f64; 2] = [1.0, 2.0];
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

/// The object that the marks mean, as large as the picture: one mark after the other. Without a mark what other views
/// say.
pub fn mask(picture: &RgbImage, marks: &[Mark], cues: &Cues<'_>) -> GrayImage {
    let before = voted(picture, cues);
    (1..=marks.len()).fold(before, |before, count| next(picture, &marks[..count], &before, cues))
}

/// The mask that other views' votes make of a picture.
fn voted(picture: &RgbImage, cues: &Cues<'_>) -> GrayImage {
    let to = [picture.width(), picture.height()];
    cues.carried.map_or_else(|| GrayImage::new(to[0], to[1]), |(parts, from)| masks::threshold(parts, from, to, VOTED))
}

/// [`mask`] for one more mark, the last of these, on the mask `before` that the others made.
///
/// What a click or a brush touches is in the mask, or out of it. A click for the object only adds, and a click beside
/// it only takes away: the piece that hangs together with the click, and what else is near. A box or a lasso begins
/// anew, unless there was one before: then it adds.
pub fn next(picture: &RgbImage, marks: &[Mark], before: &GrayImage, cues: &Cues<'_>) -> GrayImage {
    let Some((last, earlier)) = marks.split_last() else { return before.clone() };
    let there = before.as_raw().iter().any(|v| *v != 0);
    let mut mask = match last.click() {
        Some((_, false)) if !there => before.clone(),
        Some((at, adds)) => {
            let piece = |mut new: GrayImage| {
                last.hold(&mut new, picture, marks);
                changed(before, &new, at, adds)
            };
            let own = piece(if there { further(picture, marks, before, cues) } else { found(picture, marks, cues) });
            let steps = if let Mark::Object { scale, .. } = last { *scale } else { 0 };
            match (steps != 0).then(|| resized(picture, &clicks(marks), before, &own, steps)).flatten() {
                Some(resized) => piece(resized),
                None => own,
            }
        }
        None if last.bounds().is_none() => before.clone(),
        None if earlier.iter().any(|mark| mark.bounds().is_some()) => {
            let beside = earlier.iter().filter(|mark| mark.bounds().is_none());
            let own: Vec<Mark> = beside.chain(std::iter::once(last)).cloned().collect();
            let mut sum = before.clone();
            sum.iter_mut().zip(found(picture, &own, cues).as_raw()).for_each(|(sum, new)| *sum |= new);
            sum
        }
        None => found(picture, marks, cues),
    };
    marks.iter().for_each(|mark| mark.hold(&mut mask, picture, marks));
    mask
}

/// What the last of these marks, a click, makes of a mask, where it may change all of it.
fn further(picture: &RgbImage, marks: &[Mark], before: &GrayImage, cues: &Cues<'_>) -> GrayImage {
    let Some((at, adds)) = marks.last().and_then(Mark::click) else { return before.clone() };
    let cues = &Cues { depth: cues.depth.filter(|_| cues.knows(picture, before)), ..*cues };
    let together = cues.carried.is_none() && marks.len() <= TOGETHER;
    let afar = together && is_afar(before, at, adds);
    let anew = (together && (afar || cues.depth.is_none())).then(|| found(picture, marks, cues));
    let changes = |new: &GrayImage| {
        let both = before.as_raw().iter().zip(changed(before, new, at, adds).into_raw());
        both.filter(|(was, is)| **was != *is).count() as f64
    };
    let area = before.as_raw().iter().filter(|v| **v != 0).count() as f64;
    // What is of the background's colour at the outline floods that.
    let anew = anew.filter(|new| afar || changes(new) <= BESIDE_PART * area);
    // An empty one has run out of pixels: the click says nothing of the rest.
    let agrees = |mask: &GrayImage| holds(mask, at) == adds && bounds_of(mask).is_some();
    anew.filter(agrees)
        .or_else(|| edited(picture, &clicks(marks), before, cues.depth))
        .unwrap_or_else(|| before.clone())
}

/// The marks besides boxes and lassos: what is within those is in the mask already.
fn clicks(marks: &[Mark]) -> Vec<Mark> {
    marks.iter().filter(|mark| mark.bounds().is_none()).cloned().collect()
}

/// A mask `before` the last of these clicks, with a segment about that in the place of what the click takes by itself,
/// which gives the mask `own`: the one most like it, or one so many steps larger.
fn resized(picture: &RgbImage, clicks: &[Mark], before: &GrayImage, own: &GrayImage, steps: i32) -> Option<GrayImage> {
    let full = [picture.width(), picture.height()];
    let (at, _) = clicks.last()?.click()?;
    let first = Window::whole(picture);
    let pixels = Pixels::of(picture, first, SIDES[0], clicks, &Cues::default());
    let small = pixels.size.map(|n| n as u32);
    let [was, is] = [before, own].map(|mask| labels(mask, first, small));
    let pixel = |k: usize| ((at[k] * pixels.size[k] as f64) as usize).min(pixels.size[k] - 1);
    let taken = Tree::of(&pixels).about(&pixels, pixel(1) * pixels.size[0] + pixel(0), steps, |i| is[i] && !was[i])?;
    let object = (0..taken.len()).map(|i| taken[i] || was[i]).collect();
    let stays = |object: bool| if object { STAYS } else { -STAYS };
    let segment = |i: usize| if taken[i] { SHAPE } else { stays(was[i]) };
    let coarse = whole(picture, first, small, solve(&pixels, object, ROUNDS[0], segment, |_| true)?)?;
    // The border is drawn anew.
    let second = Window::around(bounds_of(&coarse)?, AROUND, full);
    let pixels = Pixels::of(picture, second, SIDES[1], clicks, &Cues::default());
    let small = pixels.size.map(|n| n as u32);
    let found = labels(&coarse, second, small);
    let is_rim = |i: usize| pixels.around(i).any(|j| found[j] != found[i]);
    let rim = |i: usize| if is_rim(i) { 0.0 } else { stays(found[i]) };
    let fine =
        solve(&pixels, found.clone(), ROUNDS[1], rim, |_| true).and_then(|fine| whole(picture, second, small, fine));
    Some(fine.unwrap_or(coarse))
}

/// Whether a mask has the pixel at a place.
fn holds(mask: &GrayImage, at: [f64; 2]) -> bool {
    let pixel = |k: usize, side: u32| ((at[k] * f64::from(side)) as u32).min(side - 1);
    mask.get_pixel(pixel(0, mask.width()), pixel(1, mask.height())).0[0] != 0
}

/// A mask with what is new of the kind that a click adds or takes away: the piece that it is on, and what else is
/// [`NEARBY`].
fn changed(before: &GrayImage, new: &GrayImage, at: [f64; 2], adds: bool) -> GrayImage {
    let (w, h) = before.dimensions();
    let click: [u32; 2] = std::array::from_fn(|k| ((at[k] * f64::from([w, h][k])) as u32).min([w, h][k] - 1));
    let changes = |x: u32, y: u32| {
        let [was, is] = [before, new].map(|mask| mask.get_pixel(x, y).0[0] != 0);
        was != is && is == adds
    };
    let far = |x: u32, y: u32| f64::hypot(f64::from(x) - f64::from(click[0]), f64::from(y) - f64::from(click[1]));
    let mut seen = vec![false; (w * h) as usize];
    let (mut open, mut reach) = (vec![click], 0.0f64);
    while let Some([x, y]) = open.pop() {
        let at = (y * w + x) as usize;
        if seen[at] || !changes(x, y) {
            continue;
        }
        seen[at] = true;
        reach = reach.max(far(x, y));
        for v in y.saturating_sub(1)..(y + 2).min(h) {
            open.extend((x.saturating_sub(1)..(x + 2).min(w)).map(|u| [u, v]));
        }
    }
    let there = seen[(click[1] * w + click[0]) as usize];
    let within = NEARBY[usize::from(!adds)] * reach;
    let taken = |x: u32, y: u32| there && changes(x, y) && far(x, y) <= within;
    GrayImage::from_fn(w, h, |x, y| *if taken(x, y) { new } else { before }.get_pixel(x, y))
}

/// Whether a click is too far from a mask's outline to be about the outline alone.
fn is_afar(before: &GrayImage, at: [f64; 2], adds: bool) -> bool {
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
    let speaks = |mark: &Mark| !matches!(mark, Mark::Background { .. } | Mark::Brush { object: false, .. });
    if !marks.iter().any(speaks) {
        return empty;
    }
    let outlined = marks.iter().any(|mark| mark.bounds().is_some());
    let of = |mark: &Mark| match mark {
        Mark::Object { at: [x, y], .. } if outlined => Some([*x, *y, *x, *y]),
        _ => mark.bounds(),
    };
    let joined = |a: [f64; 4], b: [f64; 4]| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])];
    let bounds = marks.iter().filter_map(of).reduce(joined);
    let bounds = bounds.map(|bounds| std::array::from_fn(|k| bounds[k] * f64::from(full[k % 2])));
    let first = bounds.map_or_else(|| Window::whole(picture), |bounds| Window::around(bounds, 0.5, full));
    let boxed = marks.iter().all(|mark| mark.bounds().is_none() || matches!(mark, Mark::Box { .. }));
    let fit = cues.depth.filter(|_| outlined && boxed && cues.measured.is_some());
    let cues = &Cues { depth: cues.measured.filter(|_| outlined).or(cues.depth), ..*cues };
    let alone = Cues { depth: None, ..*cues };
    let by_places = |cues| {
        let found = cut(picture, first, marks, cues, None);
        found.as_ref().is_none_or(|mask| cues.knows(picture, mask)).then_some((found, cues))
    };
    let first_found = Some(cues).filter(|cues| cues.depth.is_some()).and_then(by_places);
    let first_found = first_found.unwrap_or_else(|| (cut(picture, first, marks, &alone, None), &alone));
    // What was measured is wrong where cameras are, and then leaves a box that was drawn around an object half empty.
    let fills = |found: &Option<GrayImage>| {
        let parts =
            found.as_ref().zip(bounds).and_then(|(mask, bounds)| Some((boxed::filled(mask, bounds)?, bounds, mask)));
        parts.is_some_and(|(part, [x0, y0, x1, y1], mask)| {
            let on = mask.as_raw().iter().filter(|v| **v != 0).count() as f64;
            part >= boxed::FILLED && on <= boxed::WHOLE * (x1 - x0) * (y1 - y0)
        })
    };
    let fit = fit.filter(|_| !fills(&first_found.0)).map(DepthMap::far);
    let by_fit = fit.as_ref().map(|depth| Cues { depth: Some(depth), ..*cues });
    let by_fit = by_fit.as_ref().and_then(by_places).filter(|found| fills(&found.0));
    let (found, cues) = by_fit.unwrap_or(first_found);
    let Some(found) = found else { return empty };
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
    /// By how much where it lies within boxes and lassos speaks for the object, in nats.
    amid: Vec<f64>,
    /// By how much where it lies off planes that go on outside a box speaks for the object, in nats; below zero on one.
    raised: Vec<f64>,
    /// By how much other views' masks speak for the object, in nats.
    carried: Vec<f64>,
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
        let outlines: Vec<&Mark> = marks.iter().filter(|mark| mark.bounds().is_some()).collect();
        let outside = (0..count).map(|i| !outlines.is_empty() && !outlines.iter().any(|m| m.encloses(at(i)))).collect();
        let mut amid = vec![0.0f64; count];
        for (n, mark) in outlines.iter().enumerate().filter(|_| !cues.anywhere) {
            let grid = GrayImage::from_fn(to[0], to[1], |x, y| {
                image::Luma([if mark.encloses(at((y * to[0] + x) as usize)) { 0 } else { 255 }])
            });
            let inside = grid.as_raw().iter().filter(|v| **v == 0).count() as f64;
            let far = resample::distances(&grid, to[0].max(to[1]));
            for (i, amid) in amid.iter_mut().enumerate() {
                let speaks = mark.amid(at(i), f64::from(far[i]) / inside.max(1.0).sqrt());
                *amid = if n == 0 { speaks } else { amid.max(speaks) };
            }
        }
        let mut touched = vec![None; count];
        for mark in marks {
            let object = matches!(mark, Mark::Object { .. } | Mark::Brush { object: true, .. });
            // In the window of the second cut there may be nothing of it.
            for [x, y] in mark.certain(picture, marks) {
                if (x0..x0 + w).contains(&x) && (y0..y0 + h).contains(&y) {
                    let pixel = |v: u32, from: u32, to: u32| (u64::from(v) * u64::from(to) / u64::from(from)) as usize;
                    touched[pixel(y - y0, h, to[1]) * to[0] as usize + pixel(x - x0, w, to[0])] = Some(object);
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
        let voted = |i: usize| {
            let Some((parts, from)) = cues.carried else { return 0.0 };
            let place = std::array::from_fn(|k| at(i)[k] * f64::from(from[k]));
            let [part] = resample::bilinear(from, place, |pixel| [f64::from(parts[pixel])]);
            VOTES * (2.0 * part - 1.0)
        };
        let mut pixels = Self {
            carried: (0..count).map(voted).collect(),
            size: to.map(|n| n as usize),
            colors: small.pixels().map(|p| p.0.map(f64::from)).collect(),
            places,
            touched,
            outside,
            amid,
            raised: vec![0.0; count],
        };
        let away = pixels.part_places();
        if let Some(away) = away.filter(|_| outlines.iter().all(|mark| matches!(mark, Mark::Box { .. }))) {
            pixels.raised = pixels.raised(&away);
        }
        pixels.scale_places();
        pixels
    }

    /// Places that are [`AWAY`] speak against the object: it is about as deep as it is wide.
    /// Returns how far each is from the middle of its depth, in its widths; infinite where that is not known.
    fn part_places(&mut self) -> Option<Vec<f64>> {
        let inside = |i: &usize| !self.outside[*i] && self.outside.contains(&true);
        let all = || (0..self.places.len()).filter(inside).filter_map(|i| Some((i, self.places[i]?.0)));
        let middle = quantile(all().filter(|(i, _)| self.amid[*i] >= 0.0).map(|(_, place)| place[2]), NEARER_PART)?;
        let side = |k: usize| {
            let slopes = all().map(|(_, place)| place[k] / place[2]);
            slopes.clone().fold(f64::NEG_INFINITY, f64::max) - slopes.fold(f64::INFINITY, f64::min)
        };
        let wide = side(0).max(side(1)) * middle;
        let off = |place: &Option<([f64; 3], f64)>| place.map_or(f64::INFINITY, |(p, _)| (p[2] - middle).abs() / wide);
        let away: Vec<f64> = self.places.iter().map(off).collect();
        for (amid, off) in self.amid.iter_mut().zip(&away).filter(|(_, off)| off.is_finite()) {
            *amid -= AWAY * ((off - AS_DEEP[0]) / (AS_DEEP[1] - AS_DEEP[0])).clamp(0.0, 1.0);
        }
        Some(away)
    }

    /// The weight of planes that go on outside the boxes, for the object, in nats: it stands on them, and is what is off all of them in
    /// its depth, from whose middle pixels are so far `away`.
    fn raised(&self, away: &[f64]) -> Vec<f64> {
        let count = self.places.len();
        let place = |i: usize| self.places[i].filter(|_| away[i] <= AS_DEEP[1]).map(|(place, _)| place);
        let rays: Vec<Option<[f64; 2]>> = (0..count).map(|i| place(i).map(|[x, y, z]| [x / z, y / z])).collect();
        let disparity: Vec<f32> = (0..count).map(|i| place(i).map_or(f32::NAN, |[.., z]| z.recip() as f32)).collect();
        let inside: Vec<bool> = self.outside.iter().map(|outside| !outside).collect();
        // Depth bleeds over a box that is drawn tightly.
        let beyond = resample::distances(&self.picture(|i| inside[i]), BLEEDS[1] + 1);
        let mut on_plane = vec![false; count];
        for plane in planes::within(&disparity, &rays, &inside, [GROUND_SHARE, GROUND_THICKNESS[0]], 0) {
            let off = |i: usize| Some((place(i)?[2] * planes::on(&plane, rays[i]?) - 1.0).abs());
            let mut left: Vec<bool> =
                (0..count).map(|i| off(i).is_some_and(|off| off <= GROUND_THICKNESS[1])).collect();
            for first in (0..count).filter(|i| beyond[*i] > BLEEDS[1]) {
                if left[first] {
                    planes::connected(first, &mut left, self.size).into_iter().for_each(|i| on_plane[i] = true);
                }
            }
        }
        let core = || (0..count).filter(|i| inside[*i] && self.amid[*i] >= 0.0 && place(*i).is_some());
        let off = core().filter(|i| !on_plane[*i]).count() as f64;
        if !on_plane.contains(&true) || off < LEAST_OFF * core().count() as f64 {
            return vec![0.0; count];
        }
        let near = |i: usize| (1.0 - away[i] / AS_DEEP[0]).max(0.0);
        (0..count).map(|i| if on_plane[i] { -ON_GROUND } else { RAISED * near(i) }).collect()
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

    /// How much the depth changes across an object's outline, 0 to 1.
    fn jump(&self, object: &[bool]) -> f64 {
        let [w, h] = self.size;
        let [mut sum, mut count] = [0.0; 2];
        for i in 0..w * h {
            for (j, inside) in [(i + BESIDE, i % w + BESIDE < w), (i + BESIDE * w, i / w + BESIDE < h)] {
                if inside
                    && object[i] != object[j]
                    && let (Some((_, a)), Some((_, b))) = (self.places[i], self.places[j])
                {
                    (sum, count) = (sum + ((a - b) / JUMP).abs().min(1.0), count + 1.0);
                }
            }
        }
        if count > 0.0 { sum / count } else { 0.0 }
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

    /// How much more the picture changes on the way out of the boxes than on the way from most of what is in them, -1 to 1; nothing
    /// where it does not change.
    fn enclosed(&self) -> Option<Vec<f64>> {
        self.pairs().any(|(i, _, j, _)| !self.outside[i] && self.apart(i, j).0 > 0.0).then_some(())?;
        let ways = self.distances((0..self.outside.len()).filter(|i| self.outside[*i]), ALONG[1]);
        let middle =
            median(ways.iter().zip(&self.outside).filter(|(_, outside)| !**outside).map(|(way, _)| f64::from(*way)))?;
        Some(ways.iter().map(|way| (f64::from(*way) - middle) / (f64::from(*way) + middle)).collect())
    }

    /// Distances from some pixels, along which every change of the picture counts, and `along` each pixel.
    fn distances(&self, from: impl Iterator<Item = usize>, along: f64) -> Vec<f32> {
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
                let step = (along + color.sqrt() / 8.0 + 8.0 * jump) * f64::hypot(dx as f64, dy as f64);
                let far = distance[i] + step as f32;
                if far < distance[j] {
                    distance[j] = far;
                    queue.push((Reverse(far.to_bits()), j));
                }
            }
        }
        distance
    }

    /// A mask of the small picture: the pixels of which something is true.
    fn picture(&self, of: impl Fn(usize) -> bool) -> GrayImage {
        let [w, h] = self.size.map(|n| n as u32);
        GrayImage::from_fn(w, h, |x, y| image::Luma([if of((y * w + x) as usize) { 255 } else { 0 }]))
    }

    /// The pixels within [`RIM`] of one.
    fn around(&self, i: usize) -> impl Iterator<Item = usize> {
        let [w, h] = self.size;
        let range = |at: usize, side: usize| at.saturating_sub(RIM)..(at + RIM + 1).min(side);
        range(i / w, h).flat_map(move |y| range(i % w, w).map(move |x| y * w + x))
    }

    fn is_border(&self, i: usize) -> bool {
        let [w, h] = self.size;
        let (x, y) = (i % w, i / w);
        x == 0 || y == 0 || x + 1 == w || y + 1 == h
    }
}

/// Where the background is, by places of it; nothing where there are next to none.
fn behind(places: &[[f64; 3]]) -> Option<Mixture> {
    (places.len() > 8).then(|| Mixture::of(&some(places), COMPONENTS[1], 3))
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
        let most = if pixels.outside.contains(&true) { OUTLINED } else { MOST[1] };
        let behind = behind(&of(false).iter().filter_map(|i| Some(pixels.places[*i]?.0)).collect::<Vec<_>>());
        // By how much a pixel's place speaks for the object: how far it is from where the background goes on.
        let off = |i: usize| match (&behind, pixels.places[i], pixels.raised[i]) {
            (Some(behind), Some((place, _)), raised) if raised >= 0.0 => {
                (0.5 * (behind.distance(place) - OFF)).clamp(-most, most) + raised
            }
            (_, _, raised) => raised,
        };
        let mut off: Vec<f64> = (0..count).map(off).collect();
        if pixels.outside.contains(&true) {
            // Depth is not sharp at the border of what is near, whose colours tell where it ends.
            let beyond = |side: bool, reach: u32| {
                let there = |i: usize| pixels.places[i].is_some() && (off[i] > 0.0) == side;
                resample::distances(&pixels.picture(there), reach).into_iter().map(move |far| far > reach)
            };
            let sure: Vec<bool> = beyond(false, BLEEDS[0]).zip(beyond(true, BLEEDS[1])).map(|(a, b)| a || b).collect();
            off.iter_mut().zip(sure).filter(|(_, sure)| !sure).for_each(|(off, _)| *off = 0.0);
        }
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

/// The object in a window, as a mask of the whole picture; nothing where one side runs out of pixels. A second cut
/// begins with what the first one found.
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
    let small = [w as u32, h as u32];
    let before: Option<Vec<bool>> = found.map(|found| labels(found, window, small));
    let was = |i: usize| before.as_ref().is_some_and(|before| before[i]);
    let boxed = pixels.outside.iter().any(|outside| *outside);
    let marked = pixels.touched.contains(&Some(true));
    // Places in space know more of what is in a box than segments do.
    let flat = pixels.places.iter().all(Option::is_none);
    let within = (boxed && flat && pass == 0).then(|| Tree::of(&pixels).within(|i| !pixels.outside[i])).flatten();
    let enclosed = if boxed && flat { pixels.enclosed() } else { None };
    // Nearer to the object's clicks, or to what is not the object: from -1 to 1.
    let near: Option<Vec<f64>> = marked.then(|| {
        let objects = (0..count).filter(|i| pixels.touched[*i] == Some(true));
        let objects = pixels.distances(objects, ALONG[0]);
        let others = (0..count)
            .filter(|i| pixels.touched[*i] == Some(false) || pixels.outside[*i] || pixels.is_border(*i) && !was(*i));
        let others = pixels.distances(others, ALONG[0]);
        let side = |(a, b): (&f32, &f32)| if b.is_infinite() { 1.0 } else { f64::from((b - a) / (a + b).max(1e-6)) };
        objects.iter().zip(&others).map(side).collect()
    });
    let object: Vec<bool> = (0..count)
        .map(|i| match (&before, &within, &enclosed) {
            _ if pixels.touched[i].is_some() => pixels.touched[i] == Some(true),
            (Some(before), ..) => before[i],
            (None, Some(within), _) => within[i],
            (None, None, Some(enclosed)) => enclosed[i] > 0.0,
            _ if boxed => {
                let [amid, raised] = [&pixels.amid, &pixels.raised].map(|of| of[i] + pixels.carried[i]);
                !pixels.outside[i] && amid >= 0.0 && raised >= 0.0
            }
            _ => near.as_ref().is_some_and(|near| near[i] > NEARER),
        })
        .collect();
    let says = |of: &Option<Vec<f64>>, i: usize| of.as_ref().map_or(0.0, |of| of[i]);
    let beside = |i: usize| NEAR * says(&near, i) + ENCLOSED * says(&enclosed, i) + pixels.amid[i] + pixels.carried[i];
    let object = solve(&pixels, object, ROUNDS[pass], beside, |_| true)?;
    whole(picture, window, small, joined(object, &pixels, boxed))
}

/// The labels that a mask gives the pixels of a window at another size.
fn labels(mask: &GrayImage, window: Window, to: [u32; 2]) -> Vec<bool> {
    let [x0, y0, w, h] = window.0;
    let part = image::imageops::crop_imm(mask, x0, y0, w, h).to_image();
    resample::nearest(&part, to).as_raw().iter().map(|v| *v != 0).collect()
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
    let (at, adds) = marks.last()?.click()?;
    let click: [u32; 2] = std::array::from_fn(|k| ((at[k] * f64::from(full[k])) as u32).min(full[k] - 1));
    if (before.get_pixel(click[0], click[1]).0[0] != 0) == adds {
        return Some(before.clone());
    }
    let [x, y] = click.map(f64::from);
    let bounds = bounds_of(before)?;
    let bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x + 1.0), bounds[3].max(y + 1.0)];
    let window = Window::around(bounds, AROUND, full);
    let pixels = Pixels::of(picture, window, SIDES[1], marks, &Cues { depth, ..Cues::default() });
    let [w, h] = pixels.size;
    let [x0, y0, wide, _] = window.0;
    let small = [w as u32, h as u32];
    let was = labels(before, window, small);
    let scale = w as f64 / f64::from(wide);
    let own = [(x - f64::from(x0)) * scale, (y - f64::from(y0)) * scale];
    let far = |i: usize| f64::hypot((i % w) as f64 + 0.5 - own[0], (i / w) as f64 + 0.5 - own[1]);
    let rim = (0..w * h).filter(|i| was[*i] == adds).map(far).fold(f64::INFINITY, f64::min);
    let reach = if rim.is_finite() { REACH * rim + 3.0 } else { f64::INFINITY };
    let nearest = (0..w * h).min_by(|a, b| far(*a).total_cmp(&far(*b)))?;
    let mine = pixels.distances(std::iter::once(nearest), ALONG[0]);
    let others = pixels.distances(
        (0..w * h).filter(|i| {
            pixels.touched[*i] == Some(!adds) || adds && (pixels.outside[*i] || pixels.is_border(*i) && !was[*i])
        }),
        ALONG[0],
    );
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

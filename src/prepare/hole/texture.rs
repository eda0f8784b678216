//! Filling a hole in a texture with large pieces of what is around it.
//!
//! Thin lines that cross the hole are filled first, along themselves; what lies between them is filled after it. Textures that people
//! build repeat: tiles, boards, bricks. The shifts by which a texture is like itself are few, and a hole
//! that is filled by shifted copies of its surroundings goes on as they do, lines included (He and Sun 2012). The shifts are
//! found by comparing the surroundings with themselves; which one each pixel takes is chosen by alpha expansion, so that
//! seams run where both copies are alike (Pritch et al. 2009); and the gradients of the copies, not their colours, are put
//! together (Pérez et al. 2003), so that light that falls off goes on falling off.
//!
//! Everything is a function of the picture.

use image::GrayImage;
use rayon::prelude::*;

use super::gradient::{self, Equation};
use super::holed::Texture;
use super::lines::{self, Grey, Line, Piece};
use super::material::{ENOUGH, MATERIAL, of_another};
use super::regions::{self, Edge, Regions};
use super::similar::{DIFFERENT, RADIUS, Shift, most_alike};
use crate::prepare::planes;
use crate::scene::resample;
use crate::statistics::quantile;

/// Longer side of the picture that lines are looked for in, pixels.
const LINES: usize = 384;
/// How far from there a line may lie at full size, in pixels of that picture, and half the width that is filled along it, as a
/// multiple of the distance at which it is not the line, or of a cell of the picture that shifts are chosen on.
const ASIDE: f64 = 1.5;
const WIDE: f64 = 1.5;
/// Longer side of the picture that shifts are chosen on, pixels.
const SIDE: usize = 128;
/// Smallest part of a hole, pixels of that picture, that borders go through.
const LEAST_PART: usize = 16;
/// Shifts that are tried in the hole because they repeat.
const SHIFTS: usize = 48;
/// More of them, that fit all around the hole, as judged by so many pixels of it and of its rim.
const WHOLE: usize = 12;
/// Contrast, summed over the channels, that this share of a plain hole's rim does not exceed.
const PLAIN: f64 = 0.1;
const MOSTLY: f64 = 0.98;
const SAMPLES: usize = 128;
/// Shortest shift, as a part of the longer side: every texture is like itself next to itself.
const SHORTEST: f64 = 0.06;
/// Sum of the differences of the channels from which on a copy shows something else than what is known there.
const ANOTHER: f32 = 0.3;
/// Largest difference of the surroundings of one thing in two lights: of the mean of the channels, and of the channels without it.
const SHADED: f32 = 0.25;
const HUE: f32 = 0.12;
/// Difference of the channels without their mean by which a copy takes less of the hue of its place than its gradients ask for.
const TINT: f32 = 0.03;
/// Cost of a copy at the hole's border for each unit, summed over the channels, by which the colours of its surroundings differ
/// from those that go on into the hole; it falls by a factor e every `FADES` of the hole's half width.
const UNLIKE: f64 = 6.0;
const FADES: f64 = 0.6;
/// How many times the contrast of a hole's rim may be copied into it, contrast that may always be, and half the width of what
/// belongs to a line on the rim, pixels.
const BUSIER: f32 = 1.5;
const STILL: f32 = 0.05;
const LINE: f64 = 2.5;
/// Half the width of the squares over which surroundings are averaged, pixels.
const SURROUNDINGS: usize = 8;
/// Share of a rim that has no more than its usual contrast, and difference of colours up to which what does not hang together with a rim
/// looks like what does.
const USUAL: f64 = 0.9;
const LOOKS_LIKE: f32 = 0.12;
/// Cost of a pixel whose copy is no source.
const NO_SOURCE: f64 = 1e4;
/// Cost per channel sum of the difference of two copies along a seam.
const SEAM: f64 = 10.0;
/// Cost of a seam where both copies are the same: copies are large.
const LEAST_SEAM: f64 = 0.05;

impl Texture {
    fn apart(&self, a: usize, b: usize) -> f32 {
        apart(self.rgb[a], self.rgb[b])
    }

    /// The shifts under which patches around the hole are most often most like others, most frequent first.
    fn shifts(&self, materials: &Materials) -> Vec<Shift> {
        let [w, h] = self.size;
        let longest = w.max(h) as f64;
        let shortest = (SHORTEST * longest).ceil() as isize;
        // Around the hole, as far as it is wide.
        let holes: Vec<usize> = (0..w * h).filter(|i| self.hole[*i]).collect();
        let bounds = |f: &dyn Fn(usize) -> usize| {
            let (low, high) = holes.iter().fold((usize::MAX, 0), |(a, b), i| (a.min(f(*i)), b.max(f(*i))));
            (low, high)
        };
        let ((x0, x1), (y0, y1)) = (bounds(&|i| i % w), bounds(&|i| i / w));
        let reach = ((x1 - x0).max(y1 - y0) / 2).max(4 * RADIUS);
        let (x0, y0) = (x0.saturating_sub(reach), y0.saturating_sub(reach));
        let (x1, y1) = ((x1 + reach + 1).min(w), (y1 + reach + 1).min(h));
        // Shifts by which some of the hole is filled at all, and of each only one direction: the other compares the same.
        let [rx, ry] = [w as isize, h as isize].map(|n| n - 1);
        let all: Vec<Shift> = (-ry..=ry)
            .flat_map(|dy| (-rx..=rx).map(move |dx| [dx, dy]))
            .filter(|[dx, dy]| dx * dx + dy * dy >= shortest * shortest && (*dy > 0 || *dy == 0 && *dx > 0))
            .filter(|shift| {
                let mut some = holes.iter().step_by(holes.len().div_ceil(64));
                some.any(|i| [*shift, shift.map(|v| -v)].iter().any(|shift| self.copy(materials, *i, *shift).is_some()))
            })
            .collect();
        let best = most_alike(self.picture(), &all, x0..x1, y0..y1);
        let mut votes = std::collections::BTreeMap::<Shift, f64>::new();
        let patches = (y0..y1).flat_map(|y| (x0..x1).map(move |x| y * w + x));
        for (patch, (error, number)) in patches.zip(best.error.iter().zip(&best.shift)) {
            if error.is_infinite() {
                continue;
            }
            // Neighbouring shifts are one: votes are smoothed by a small disc below. Patches with structure say more than blank
            // ones, whose best shift is a matter of noise.
            let [dx, dy] = all[*number as usize];
            let contrast = self.contrast(patch);
            let vote = f64::from((-8.0 * error).exp()) * f64::from(0.05 + contrast);
            for (ox, oy, weight) in [(0, 0, 1.0), (1, 0, 0.5), (-1, 0, 0.5), (0, 1, 0.5), (0, -1, 0.5)] {
                *votes.entry([dx + ox, dy + oy]).or_default() += weight * vote;
                *votes.entry([-dx + ox, -dy + oy]).or_default() += weight * vote;
            }
        }
        let mut ranked: Vec<(f64, Shift)> = votes.into_iter().map(|(shift, votes)| (votes, shift)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut shifts: Vec<Shift> = vec![];
        let apart = |a: &Shift, b: &Shift| (a[0] - b[0]).abs().max((a[1] - b[1]).abs()) > 1;
        let useful = |shift: &Shift| holes.iter().any(|i| self.copy(materials, *i, *shift).is_some());
        for (_, shift) in ranked {
            if shifts.len() == SHIFTS {
                break;
            }
            if shifts.iter().all(|other| apart(other, &shift)) && useful(&shift) {
                shifts.push(shift);
            }
        }
        let whole = self.whole(&holes, &all, materials);
        shifts.extend(whole);
        self.reach_all(&holes, &all, &mut shifts, materials);
        shifts
    }

    /// The shifts that fill nearly all of a hole in something plain, and under which what is around it is most like what it is
    /// covered with.
    fn whole(&self, holes: &[usize], all: &[Shift], materials: &Materials) -> Vec<Shift> {
        let every = |count: usize| count.div_ceil(SAMPLES).max(1);
        let beside = |i: &usize| {
            let mut near = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [dx, dy]));
            near.any(|shift| self.shifted(*i, shift).is_some_and(|near| self.hole[near]))
        };
        let rim: Vec<usize> = (0..self.hole.len()).filter(|i| self.source[*i] && beside(i)).collect();
        // Where lines run into the hole, what leaves them out is no way to fill it.
        if quantile(rim.iter().map(|i| self.contrast(*i)), MOSTLY).is_none_or(|busy| busy > PLAIN) {
            return vec![];
        }
        let rim: Vec<usize> = rim.iter().copied().step_by(every(rim.len())).collect();
        let holes: Vec<usize> = holes.iter().copied().step_by(every(holes.len())).collect();
        let score = |shift: Shift| {
            let apart =
                |i: &usize| self.source(*i, shift).map_or(DIFFERENT, |from| self.apart(*i, from).min(DIFFERENT));
            let bare = holes.iter().filter(|i| self.copy(materials, **i, shift).is_none()).count();
            rim.iter().map(apart).sum::<f32>() / rim.len().max(1) as f32 + bare as f32 / holes.len().max(1) as f32
        };
        let mut scored: Vec<(f32, Shift)> = (all.par_iter())
            .flat_map_iter(|shift| [*shift, shift.map(|v| -v)].map(|shift| (score(shift), shift)))
            .collect();
        scored.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut best: Vec<Shift> = vec![];
        let apart = |a: &Shift, b: &Shift| (a[0] - b[0]).abs().max((a[1] - b[1]).abs()) > 2;
        for (_, shift) in scored.into_iter().take_while(|(score, _)| *score < DIFFERENT) {
            if best.len() == WHOLE {
                break;
            }
            if best.iter().all(|other| apart(other, &shift)) {
                best.push(shift);
            }
        }
        best
    }

    /// Adds shifts until every pixel of the hole has a source, as far as there are any.
    fn reach_all(&self, holes: &[usize], all: &[Shift], shifts: &mut Vec<Shift>, materials: &Materials) {
        let mut left: Vec<usize> =
            holes.iter().copied().filter(|i| shifts.iter().all(|s| self.copy(materials, *i, *s).is_none())).collect();
        while !left.is_empty() {
            let count = |shift: Shift| left.iter().filter(|i| self.copy(materials, **i, shift).is_some()).count();
            let every = all.len().div_ceil(2000).max(1);
            let both = all.iter().step_by(every).flat_map(|shift| [*shift, shift.map(|v| -v)]);
            let best = both.map(|shift| (count(shift), shift)).max_by_key(|(n, s)| (*n, std::cmp::Reverse(*s)));
            let Some((_, shift)) = best.filter(|(n, _)| *n > 0) else { break };
            shifts.push(shift);
            left.retain(|i| self.copy(materials, *i, shift).is_none());
        }
    }

    /// Largest difference of a pixel to its four neighbours, sum over the channels.
    fn contrast(&self, pixel: usize) -> f32 {
        let near = [[1, 0], [-1, 0], [0, 1], [0, -1]].into_iter().filter_map(|shift| self.source(pixel, shift));
        near.map(|there| self.apart(pixel, there)).fold(0.0, f32::max)
    }

    /// `[pixel]` number of the shift of each pixel; `shifts.len()` outside the hole, and where nothing can be copied.
    fn labels(&self, shifts: &[Shift], materials: &Materials) -> Vec<usize> {
        let none = shifts.len();
        // The hole's box and what touches it.
        let [w, h] = self.size;
        let holes = || (0..w * h).filter(|i| self.hole[*i]);
        let range = |f: &dyn Fn(usize) -> usize, end: usize| {
            let (low, high) = holes().fold((end, 0), |(low, high), i| (low.min(f(i)), high.max(f(i))));
            (low.saturating_sub(1), (high + 2).min(end))
        };
        let ((x0, x1), (y0, y1)) = (range(&|i| i % w, w), range(&|i| i / w, h));
        let size = [x1 - x0, y1 - y0];
        let pixel = |node: usize| (y0 + node / size[0]) * w + x0 + node % size[0];
        let n = size[0] * size[1];
        let unlike = self.unlike(&materials.around);
        let cost = |label: usize, i: usize| match (self.hole[i], label == none) {
            (false, own) => {
                if own {
                    0.0
                } else {
                    NO_SOURCE
                }
            }
            (true, true) => 2.0 * NO_SOURCE,
            (true, false) => self.copy(materials, i, shifts[label]).map_or(NO_SOURCE, |from| unlike(i, from)),
        };
        let costs: Vec<Vec<f64>> =
            (0..=none).into_par_iter().map(|label| (0..n).map(|node| cost(label, pixel(node))).collect()).collect();
        // Not a number where there is nothing to copy.
        let color = |label: usize, i: usize| {
            let from = if label == none { self.source[i].then_some(i) } else { self.source(i, shifts[label]) };
            from.map_or([f32::NAN; 3], |from| self.rgb[from])
        };
        let colors: Vec<Vec<[f32; 3]>> =
            (0..=none).into_par_iter().map(|label| (0..n).map(|node| color(label, pixel(node))).collect()).collect();
        let at = |node: usize, [a, b]: [usize; 2]| {
            let apart = apart(colors[a][node], colors[b][node]);
            // Known pixels have one colour; that a copy would have there is compared on the other side.
            SEAM * f64::from(if apart.is_nan() { DIFFERENT / 2.0 } else { apart })
        };
        let mut labels = vec![none; w * h];
        planes::cheapest(&costs, &planes::Border { between: |_| LEAST_SEAM, at }, size)
            .into_iter()
            .enumerate()
            .for_each(|(node, label)| labels[pixel(node)] = label);
        labels
    }
}

/// Sum of the differences of the channels.
fn apart(one: [f32; 3], other: [f32; 3]) -> f32 {
    (0..3).map(|c| (one[c] - other[c]).abs()).sum()
}

/// Materials of a picture: they say which pixels may be copied into which part of the hole.
struct Materials {
    /// The number of its part for each `[pixel]` of the hole.
    part: Vec<usize>,
    /// Whether a pixel may be copied into a part: `[part][pixel]`.
    allowed: Vec<Vec<bool>>,
    /// Regions of one material, where few borders run into the hole.
    regions: Vec<Option<Regions>>,
    /// The mean of what is known around each `[pixel]`; NaN where nothing is.
    around: Vec<[f32; 3]>,
}

impl Texture {
    /// The mean of what is known around a pixel; NaN where nothing is.
    fn mean_around(&self, pixel: usize) -> [f32; 3] {
        self.mean_within(pixel, SURROUNDINGS)
    }

    /// The contrast up to which something may be copied into a part of the hole with this rim: what stands out more than all that is
    /// beside it, but for the lines that have been filled, does not begin just where the object hides it.
    fn plain(&self, rim: &[usize], lines: &[Line]) -> f32 {
        let on_line =
            |i: usize| lines.iter().any(|line| line.place(lines::middle_of(i, self.size[0]))[1].abs() <= LINE);
        let busiest = rim.iter().filter(|i| !on_line(**i)).map(|i| self.contrast(*i)).reduce(f32::max);
        busiest.map_or(f32::INFINITY, |busiest| (BUSIER * busiest).max(STILL))
    }

    /// `[pixel]` what hangs together with a rim, by steps that are usual on it.
    fn reached(&self, rim: &[usize]) -> Vec<bool> {
        let usual = quantile(rim.iter().map(|i| self.contrast(*i)), USUAL).unwrap_or(f64::INFINITY) as f32;
        let step = (BUSIER * usual).max(STILL);
        let mut left = self.source.clone();
        for first in rim {
            planes::connected_if(*first, &mut left, self.size, |a, b| self.apart(a, b) <= step);
        }
        self.source.iter().zip(left).map(|(source, left)| *source && !left).collect()
    }

    /// Finds what may be copied into each part of the hole: nothing of a material that is nowhere beside it, where there is enough of
    /// those that are, and nothing of a thing apart, as a picture on a bare wall. What a surface is covered with elsewhere does not begin just
    /// where the object hides it. `lines` are those across the hole that have been filled.
    fn materials(&self, lines: &[Line]) -> Materials {
        let around: Vec<[f32; 3]> = (0..self.hole.len()).into_par_iter().map(|i| self.mean_around(i)).collect();
        let looks = regions::looks(self);
        let known: Vec<usize> = (0..self.source.len()).filter(|i| self.source[*i]).collect();
        let (mut of, mut all, mut regions) = (vec![0; self.hole.len()], vec![], vec![]);
        let mut left = self.hole.clone();
        for first in (0..left.len()).filter(|i| self.hole[*i]) {
            let part = planes::connected(first, &mut left, self.size);
            if part.is_empty() {
                continue;
            }
            let mut rim: Vec<usize> = part.iter().flat_map(|i| planes::neighbours(*i, self.size)).collect();
            rim.retain(|i| self.source[*i]);
            rim.sort_unstable();
            rim.dedup();
            let plain = self.plain(&rim, lines);
            let reached = self.reached(&rim);
            let some: Vec<usize> = known.iter().copied().filter(|i| reached[*i]).collect();
            let some: Vec<usize> = some.iter().copied().step_by(some.len().div_ceil(4 * SAMPLES).max(1)).collect();
            let is_apart =
                |i: usize| !reached[i] && some.iter().all(|on| of_another(looks[i], looks[*on]) > LOOKS_LIKE);
            let like = |i: &usize| {
                let alike = || rim.iter().any(|rim| of_another(around[*i], around[*rim]) <= MATERIAL);
                self.contrast(*i) <= plain && alike() && !is_apart(*i)
            };
            let like: Vec<usize> = known.par_iter().copied().filter(like).collect();
            let enough = like.len() as f64 >= ENOUGH * part.len() as f64;
            let mut allowed = vec![!enough; self.source.len()];
            like.into_iter().for_each(|i| allowed[i] = true);
            regions.push(Regions::around(self, &part, &looks).filter(|regions| regions.hold(self, &part, &allowed)));
            part.into_iter().for_each(|i| of[i] = all.len());
            all.push(allowed);
        }
        Materials { part: of, allowed: all, regions, around }
    }

    /// The pixel that a pixel of the hole is copied from at a shift, if it may be.
    fn copy(&self, materials: &Materials, pixel: usize, shift: Shift) -> Option<usize> {
        let part = materials.part[pixel];
        let may = |from: &usize| {
            let regions = materials.regions[part].as_ref();
            materials.allowed[part][*from] && regions.is_none_or(|regions| regions.may(pixel, *from))
        };
        self.source(pixel, shift).filter(may)
    }

    /// What it costs a pixel of the hole to be copied from another: the colours around that one are compared with those that
    /// go on into the hole from its border.
    fn unlike(&self, around: &[[f32; 3]]) -> impl Fn(usize, usize) -> f64 {
        let [w, h] = self.size;
        let mut expected = vec![[0f32; 3]; w * h];
        for c in 0..3 {
            let mut channel: Vec<f32> =
                (0..w * h).map(|i| if self.hole[i] { f32::NAN } else { around[i][c] }).collect();
            planes::membrane(&mut channel, self.size, |i| self.hole[i]);
            expected.iter_mut().zip(channel).for_each(|(to, v)| to[c] = v);
        }
        let raw = self.source.iter().map(|source| if *source { 255 } else { 0 }).collect();
        let known = GrayImage::from_raw(w as u32, h as u32, raw).expect("a value per pixel");
        let inwards = resample::distances(&known, w.max(h) as u32);
        let deepest = (0..w * h).filter(|i| self.hole[*i]).map(|i| inwards[i]).max().unwrap_or(1);
        let fades = FADES * f64::from(deepest);
        let weights: Vec<f64> = inwards.iter().map(|depth| UNLIKE * (-f64::from(*depth) / fades).exp()).collect();
        move |pixel, from| {
            let apart = of_another(around[from], expected[pixel]);
            if apart.is_finite() { weights[pixel] * f64::from(apart) } else { 0.0 }
        }
    }
}

/// Fills the hole, as far as there is anything to copy. Returns whether there was.
pub fn fill(texture: &mut Texture) -> bool {
    if !texture.hole.iter().any(|hole| *hole) || !texture.source.iter().any(|source| *source) {
        return false;
    }
    let by = texture.size[0].max(texture.size[1]).div_ceil(SIDE).max(1);
    let lines: Vec<Line> = go_on(texture, by).iter().map(|line| line.scaled(1.0 / by as f64)).collect();
    let small = texture.reduced(by);
    let materials = small.materials(&lines);
    let coarse = small.shifts(&materials);
    if coarse.is_empty() {
        return false;
    }
    let labels = small.labels(&coarse, &materials);
    let shifts = refined(texture, &small, &labels, &coarse, by);
    let copied = copies(texture, &shifts, &labels, small.size[0], by);
    let [w, h] = texture.size;
    paste(texture, &copied);
    // Pixels at the end of what a copy has to give, and what another would copy there is not what is around them.
    let between: Vec<bool> = (0..w * h)
        .map(|i| {
            texture.hole[i] && copied[i].is_none() && shifts.iter().any(|shift| texture.source(i, *shift).is_some())
        })
        .collect();
    for c in 0..3 {
        let value = |i: usize| if texture.source[i] || copied[i].is_some() { texture.rgb[i][c] } else { f32::NAN };
        let mut channel: Vec<f32> = (0..w * h).map(value).collect();
        planes::membrane(&mut channel, texture.size, |i| between[i]);
        (0..w * h).filter(|i| between[*i]).for_each(|i| texture.rgb[i][c] = channel[i]);
    }
    for (i, hole) in texture.hole.iter_mut().enumerate() {
        *hole &= copied[i].is_none() && !(between[i] && texture.rgb[i][0].is_finite());
    }
    true
}

/// Fills the lines that cross the hole, each along itself, so wide that a cell of so many pixels is within it. Returns them.
fn go_on(texture: &mut Texture, cell: usize) -> Vec<Line> {
    let by = texture.size[0].max(texture.size[1]).div_ceil(LINES).max(1);
    let small = texture.reduced(by);
    let found = lines::lines(small.picture(), &small.hole);
    if found.is_empty() {
        return found;
    }
    let grey = Grey::new(texture.picture());
    let at_full_size = |line: Line| {
        let line = lines::refined(&grey, &line.scaled(by as f64), ASIDE * by as f64);
        let half = WIDE * line.beside.max(cell as f64);
        (line, half, lines::pieces(&grey, &line, half))
    };
    let found: Vec<(Line, f64, [Piece; 2])> = found.into_iter().map(at_full_size).collect();
    along(texture, &found);
    found.into_iter().map(|(line, ..)| line).collect()
}

/// The parts of a reduced picture's hole, with the regions around them.
fn parts(small: &Texture) -> Vec<(Vec<usize>, Regions)> {
    let mut left = small.hole.clone();
    let parts = (0..left.len()).map(|first| planes::connected(first, &mut left, small.size));
    let large = parts.filter(|part| part.len() >= LEAST_PART);
    let looks = regions::looks(small);
    large.filter_map(|part| Regions::around(small, &part, &looks).map(|regions| (part, regions))).collect()
}

/// Straight borders of regions that go into the hole, from where they do to where they come out of it, or would.
pub fn ends(texture: &Texture) -> Vec<Line> {
    let by = texture.size[0].max(texture.size[1]).div_ceil(SIDE).max(1);
    let small = texture.reduced(by);
    parts(&small).iter().flat_map(|(part, regions)| regions.ends(&small, part, texture, by as f64)).collect()
}

/// Fills the straight borders of regions that cross the hole, each along itself, so many pixels to each side.
pub fn borders(texture: &mut Texture, half: f64) {
    let by = texture.size[0].max(texture.size[1]).div_ceil(SIDE).max(1);
    let small = texture.reduced(by);
    let edges: Vec<Edge> = parts(&small).iter().flat_map(|(part, regions)| regions.edges(&small, part)).collect();
    let full = |edge: &Edge| {
        let line = edge.refined(texture, by as f64);
        (line, half, edge.pieces(&line, by as f64))
    };
    let found: Vec<(Line, f64, [Piece; 2])> = edges.iter().map(full).collect();
    along(texture, &found);
}

/// Fills what is so near to lines along them.
fn along(texture: &mut Texture, found: &[(Line, f64, [Piece; 2])]) {
    let copy = |i: usize| {
        let on = found.iter().filter_map(|(line, half, pieces)| {
            let [from_first, aside] = line.place(lines::middle_of(i, texture.size[0]));
            let inside = [from_first, line.length() - from_first];
            let is_on = aside.abs() <= *half && inside.iter().all(|inside| *inside >= -1.0);
            is_on.then_some((aside.abs(), inside, pieces, line.short))
        });
        let (_, inside, pieces, short) = on.min_by(|a, b| a.0.total_cmp(&b.0))?;
        // From the nearer end, but where much more is known of the other.
        let near = usize::from(inside[0] > inside[1]);
        let near = if 2.0 * pieces[near].length < pieces[1 - near].length { 1 - near } else { near };
        [near, 1 - near].into_iter().filter(|end| !short[*end]).find_map(|end| {
            let mut shifts = (0..3).map(|again| pieces[end].shift(inside[end], again));
            shifts.find_map(|shift| texture.source(i, shift))
        })
    };
    let copied: Vec<Option<usize>> = (0..texture.hole.len()).map(|i| texture.hole[i].then(|| copy(i))?).collect();
    paste(texture, &copied);
    for i in (0..copied.len()).filter(|i| copied[*i].is_some()) {
        (texture.hole[i], texture.source[i]) = (false, true);
    }
}

/// Copies pixels and joins them with each other and with what is around them.
pub fn paste(texture: &mut Texture, copied: &[Option<usize>]) {
    for (i, from) in copied.iter().enumerate() {
        if let Some(from) = from {
            texture.rgb[i] = texture.rgb[*from];
        }
    }
    join(texture, copied);
}

/// The pixel that each pixel copies, by the labels of the reduced picture. A shift at full size may end some pixels before the one
/// it is from: there the pieces beside it go on.
fn copies(texture: &Texture, shifts: &[Shift], labels: &[usize], columns: usize, by: usize) -> Vec<Option<usize>> {
    let w = texture.size[0];
    let source = |i: usize, label: usize| texture.source(i, *shifts.get(label)?);
    let holes: Vec<usize> = (0..texture.hole.len()).filter(|i| texture.hole[*i]).collect();
    let mut own: Vec<Option<usize>> = vec![None; texture.hole.len()];
    for &i in &holes {
        own[i] = Some(labels[(i / w / by) * columns + i % w / by]).filter(|label| source(i, *label).is_some());
    }
    let mut left: Vec<usize> = holes.into_iter().filter(|i| own[*i].is_none()).collect();
    for _ in 0..2 * by {
        let goes_on = |i: usize| {
            let mut beside = planes::neighbours(i, texture.size).filter_map(|j| own[j]);
            beside.find(|label| source(i, *label).is_some())
        };
        let more: Vec<(usize, Option<usize>)> = left.iter().map(|i| (*i, goes_on(*i))).collect();
        more.into_iter().for_each(|(i, label)| own[i] = label);
        left.retain(|i| own[*i].is_none());
    }
    own.into_iter().enumerate().map(|(i, label)| source(i, label?)).collect()
}

/// The shifts of the reduced picture at full size: of each the nearest at which what is around its pixels is most like what it
/// copies. That touching most of what is known comes first, and what it fills is known to the next, so that a line goes on from
/// piece to piece.
fn refined(texture: &Texture, small: &Texture, labels: &[usize], coarse: &[Shift], by: usize) -> Vec<Shift> {
    let mut shifts: Vec<Shift> = coarse.iter().map(|shift| shift.map(|v| v * by as isize)).collect();
    if by == 1 {
        return shifts;
    }
    let (mut known, mut filled) = (small.source.clone(), texture.clone());
    let mut left: Vec<usize> = (0..coarse.len()).filter(|label| labels.contains(label)).collect();
    while !left.is_empty() {
        let beside = |label: usize| beside(small, labels, label, &known);
        let all = left.iter().enumerate().map(|(at, label)| (at, beside(*label)));
        let Some((at, cells)) = all.max_by_key(|(at, cells)| (cells.len(), std::cmp::Reverse(*at))) else { break };
        let label = left.remove(at);
        // The whole surroundings, where it touches nothing known.
        let cells = if cells.is_empty() { (0..known.len()).filter(|cell| known[*cell]).collect() } else { cells };
        shifts[label] = refine(&filled, small.size[0], &cells, shifts[label], by);
        for cell in (0..labels.len()).filter(|cell| labels[*cell] == label) {
            known[cell] = true;
            let [x0, y0] = [cell % small.size[0] * by, cell / small.size[0] * by];
            for (x, y) in (y0..(y0 + by).min(texture.size[1])).flat_map(|y| (x0..x0 + by).map(move |x| (x, y))) {
                let i = y * texture.size[0] + x;
                if let Some(from) = texture.source(i, shifts[label]).filter(|_| x < texture.size[0] && texture.hole[i])
                {
                    filled.rgb[i] = texture.rgb[from];
                }
            }
        }
    }
    shifts
}

/// The known cells of the reduced picture around those of a label.
fn beside(small: &Texture, labels: &[usize], label: usize, known: &[bool]) -> Vec<usize> {
    const REACH: isize = 3;
    let mut beside: Vec<usize> = vec![];
    for at in (0..labels.len()).filter(|at| labels[*at] == label) {
        for (dx, dy) in (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (dx, dy))) {
            beside.extend(small.shifted(at, [dx, dy]).filter(|near| known[*near]));
        }
    }
    beside.sort_unstable();
    beside.dedup();
    beside
}

/// The shift near another, at full size, under which these cells of the reduced picture are most like what they would be copied
/// from.
fn refine(texture: &Texture, columns: usize, cells: &[usize], large: Shift, by: usize) -> Shift {
    let every = cells.len().div_ceil(1500).max(1);
    let pixels: Vec<usize> = (cells.iter().step_by(every))
        .map(|at| {
            (at / columns * by + by / 2).min(texture.size[1] - 1) * texture.size[0]
                + (at % columns * by + by / 2).min(texture.size[0] - 1)
        })
        .collect();
    let by = by as isize;
    let near = (-by..=by).flat_map(|dy| (-by..=by).map(move |dx| [large[0] + dx, large[1] + dy]));
    let error = |shift: Shift| {
        let both = pixels.iter().filter_map(|i| Some(texture.apart(*i, texture.source(*i, shift)?).min(DIFFERENT)));
        let (sum, count) = both.fold((0.0, 0usize), |(sum, n), error| (sum + f64::from(error), n + 1));
        let off = (shift[0] - large[0]).abs() + (shift[1] - large[1]).abs();
        if 4 * count < pixels.len() { f64::INFINITY } else { sum / count as f64 + 1e-6 * off as f64 }
    };
    let found = near.map(|shift| (error(shift), shift)).min_by(|a, b| a.0.total_cmp(&b.0));
    found.filter(|(error, _)| error.is_finite()).map_or(large, |(_, shift)| shift)
}

impl Texture {
    /// Whether two pixels that may be copied show one thing, be it in two lights: their surroundings have one hue, and what is left of
    /// their difference, with or without that of their surroundings, is small.
    fn is_one(&self, one: usize, other: usize) -> bool {
        let means = [one, other].map(|at| self.mean_around(at));
        let off: [f32; 3] = std::array::from_fn(|c| means[0][c] - means[1][c]);
        let light = off.iter().sum::<f32>() / 3.0;
        let hue: f32 = off.iter().map(|off| (off - light).abs()).sum();
        let left = || (0..3).map(|c| (self.rgb[one][c] - self.rgb[other][c] - off[c]).abs()).sum::<f32>();
        light.abs() <= SHADED && hue <= HUE && (self.apart(one, other) <= ANOTHER || left() <= ANOTHER)
    }
}

/// Gives the copied pixels the light with which their gradients are those of the copies, and that goes on from what is known.
fn join(texture: &mut Texture, copied: &[Option<usize>]) {
    let original = &texture.rgb;
    let less = |a: usize, b: usize| -> [f32; 3] { std::array::from_fn(|c| original[a][c] - original[b][c]) };
    let equation = |i: usize| {
        let mut equation = Equation::new(i);
        for shift in [[1, 0], [-1, 0], [0, 1], [0, -1]] {
            // Only what is known and what is being filled has a colour.
            let neighbour = texture.shifted(i, shift).filter(|j| copied[*j].is_some() || texture.source[*j]);
            let Some(j) = neighbour else { continue };
            // A copy goes on in another light, or there is something else, and it ends: beside the hole and at a seam.
            let goes_on = |from: Option<usize>, shift: Shift, there: usize| {
                from.and_then(|at| texture.source(at, shift)).is_none_or(|on| texture.is_one(on, there))
            };
            let back = shift.map(|v| -v);
            let [here, there] = [i, j].map(|pixel| copied[pixel].unwrap_or(pixel));
            if !goes_on(copied[i], shift, there) || !goes_on(copied[j], back, here) {
                continue;
            }
            // That of the copy; of two copies the mean of both.
            let own = copied[i].and_then(|at| Some(less(at, texture.source(at, shift)?)));
            let other = copied[j].and_then(|at| Some(less(texture.source(at, back)?, at)));
            let gradient = match (own, other) {
                (Some(own), Some(other)) => std::array::from_fn(|c| 0.5 * (own[c] + other[c])),
                (Some(one), None) | (None, Some(one)) => one,
                (None, None) => less(here, there),
            };
            equation.add(j, gradient);
        }
        equation
    };
    let inside: Vec<usize> = (0..copied.len()).filter(|i| copied[*i].is_some()).collect();
    let equations: Vec<Equation> = inside.into_par_iter().map(equation).collect();
    let copies = texture.rgb.clone();
    gradient::solve(&mut texture.rgb, texture.size[0], &equations);
    // A place has its own light. Of another hue it is hardly: a rim that is mixed with what stands beside it would tint all that is
    // copied.
    for i in (0..copied.len()).filter(|i| copied[*i].is_some()) {
        let off: [f32; 3] = std::array::from_fn(|c| texture.rgb[i][c] - copies[i][c]);
        let brighter = off.iter().sum::<f32>() / 3.0;
        let hue: f32 = off.iter().map(|off| (off - brighter).abs()).sum();
        let kept = 1.0 - (TINT / hue).min(1.0);
        texture.rgb[i] =
            std::array::from_fn(|c| (copies[i][c] + brighter + kept * (off[c] - brighter)).clamp(0.0, 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(
        size: [usize; 2],
        hole: impl Fn(usize, usize) -> bool,
        color: impl Fn(usize, usize) -> [f32; 3],
    ) -> (Texture, Vec<[f32; 3]>) {
        let places = || (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
        let truth: Vec<[f32; 3]> = places().map(|(x, y)| color(x, y)).collect();
        let hole: Vec<bool> = places().map(|(x, y)| hole(x, y)).collect();
        let rgb = truth.iter().zip(&hole).map(|(c, h)| if *h { [0.0; 3] } else { *c }).collect();
        let source = hole.iter().map(|h| !h).collect();
        (Texture { size, rgb, hole, source }, truth)
    }

    /// Pixels of what was a hole that have another colour than the truth, and all of them.
    fn wrong(filled: &Texture, before: &[bool], truth: &[[f32; 3]]) -> [usize; 2] {
        let inside = || (0..truth.len()).filter(|i| before[*i]);
        let is_wrong = |i: &usize| (0..3).any(|c| (filled.rgb[*i][c] - truth[*i][c]).abs() > 0.06);
        [inside().filter(is_wrong).count(), inside().count()]
    }

    /// Tiles of 23 x 17 pixels with joints of two, light falling off to one side: joints cross the hole where they would.
    #[test]
    fn tiles_go_on_and_so_does_the_light() {
        for size in [[150, 120], [300, 240]] {
            let [w, h] = size;
            let scale = w / 150;
            let tile = [23 * scale, 17 * scale];
            let hole = |x: usize, y: usize| (w / 3..2 * w / 3).contains(&x) && (h / 3..2 * h / 3).contains(&y);
            let color = |x: usize, y: usize| {
                let joint = x % tile[0] < 2 * scale || y % tile[1] < 2 * scale;
                let light = 1.0 - 0.4 * x as f32 / w as f32;
                [if joint { 0.3 } else { 0.8 } * light, if joint { 0.3 } else { 0.7 } * light, 0.5 * light]
            };
            let (mut tiles, truth) = texture(size, hole, color);
            let before = tiles.hole.clone();
            assert!(fill(&mut tiles) && !tiles.hole.contains(&true));
            let [wrong, all] = wrong(&tiles, &before, &truth);
            assert!(wrong * 50 < all, "{wrong} of {all} at {size:?}");
        }
    }

    /// A hole in the middle of a plain tile, on a floor of which a part alone is known: no joint comes into it.
    #[test]
    fn plain_stays_plain() {
        let hole = |x: usize, y: usize| (70..100).contains(&x) && (55..75).contains(&y);
        let joint = |x: usize, y: usize| x % 60 < 2 || y % 48 < 2;
        let (mut floor, truth) =
            texture([160, 130], hole, |x, y| if joint(x, y) { [0.35; 3] } else { [0.75, 0.73, 0.7] });
        // Of the neighbouring tiles one side alone is known.
        floor
            .source
            .iter_mut()
            .enumerate()
            .filter(|(i, _)| i % 160 > 135 || i % 160 < 25)
            .for_each(|(_, s)| *s = false);
        let before = floor.hole.clone();
        assert!(fill(&mut floor));
        for i in (0..truth.len()).filter(|i| before[*i]) {
            assert!((0..3).all(|c| (floor.rgb[i][c] - truth[i][c]).abs() < 0.03), "{i}: {:?}", floor.rgb[i]);
        }
    }

    /// A picture on a wall, in a colour near that of a cupboard beside the hole, does not come under itself.
    #[test]
    fn a_picture_on_the_wall_is_not_copied() {
        let hole = |x: usize, y: usize| (40..120).contains(&x) && (70..110).contains(&y);
        let is_picture = |x: usize, y: usize| (60..100).contains(&x) && (20..50).contains(&y);
        let color = |x: usize, y: usize| match (is_picture(x, y), x >= 120 && y >= 80) {
            (true, _) => [0.66, 0.6, 0.36],
            (false, true) => [0.6, 0.5, 0.4],
            (false, false) => [0.76, 0.75, 0.72],
        };
        let (wall, _) = texture([160, 130], hole, color);
        let allowed = &wall.materials(&[]).allowed[0];
        assert!(allowed[20 * 160 + 20] && !allowed[35 * 160 + 80]);
    }

    /// The joint that runs into a hole in the middle of tiles goes through it, though a plain part would fit nearly all of the rim.
    #[test]
    fn a_joint_is_not_left_out() {
        let hole = |x: usize, y: usize| (55..85).contains(&x) && (40..64).contains(&y);
        let joint = |x: usize, y: usize| x % 70 < 2 || y % 90 < 2;
        let color = |x: usize, y: usize| if joint(x, y) { [0.35; 3] } else { [0.75, 0.73, 0.7] };
        let (mut floor, truth) = texture([160, 130], hole, color);
        let before = floor.hole.clone();
        assert!(fill(&mut floor));
        let [wrong, all] = wrong(&floor, &before, &truth);
        assert!(wrong * 20 < all, "{wrong} of {all}");
    }

    /// The joint that comes out of a hole shortly before a wall goes through it, and nothing of the wall comes into it.
    #[test]
    fn a_joint_goes_on_to_the_wall() {
        let hole = |x: usize, y: usize| (110..190).contains(&x) && (90..190).contains(&y);
        let color = |x: usize, y: usize| match (y < 70, x.abs_diff(150) < 2 || y.abs_diff(225) < 2) {
            (true, _) => [0.3, 0.3, 0.32],
            (_, true) => [0.5; 3],
            _ => [0.75, 0.73, 0.7],
        };
        let (mut floor, truth) = texture([300, 260], hole, color);
        let before = floor.hole.clone();
        assert!(fill(&mut floor));
        let [wrong, all] = wrong(&floor, &before, &truth);
        assert!(wrong * 100 < all, "{wrong} of {all}");
    }

    /// A straight border between two plain colours runs straight through the hole, and no colour is there that is not around.
    #[test]
    fn a_straight_border_stays_straight() {
        let hole = |x: usize, y: usize| (50..80).contains(&x) && (35..70).contains(&y);
        let upper = |x: usize, y: usize| 2 * y < 40 + x;
        let color = |x: usize, y: usize| if upper(x, y) { [0.2, 0.3, 0.6] } else { [0.7, 0.6, 0.4] };
        let (mut two, truth) = texture([130, 100], hole, color);
        let before = two.hole.clone();
        assert!(fill(&mut two));
        for i in (0..truth.len()).filter(|i| before[*i]) {
            let (x, y) = ((i % 130) as f64, (i / 130) as f64);
            let off = (2.0 * y - 40.0 - x).abs() / 5f64.sqrt();
            let apart = (0..3).map(|c| (two.rgb[i][c] - truth[i][c]).abs()).fold(0.0, f32::max);
            assert!(off < 2.5 || apart < 0.08, "({x}, {y}): {apart}");
        }
    }

    /// Leaves and stone whose border bends meet in a hole: what is there is leaves or stone, and no mixture of both.
    #[test]
    fn two_materials_do_not_run_into_each_other() {
        let noise = |x: usize, y: usize| ((x * 7919 + y * 104_729) * 2_654_435_761 % 1000) as f32 / 1000.0;
        let hole = |x: usize, y: usize| (60..115).contains(&x) && (30..95).contains(&y);
        let leaves = |x: usize, y: usize| (x as f64) < 85.0 + 14.0 * (y as f64 / 9.0).sin();
        let color = |x: usize, y: usize| {
            if leaves(x, y) { [0.1, 0.15 + 0.15 * noise(x, y), 0.1] } else { [0.65 + 0.04 * noise(x, y), 0.65, 0.7] }
        };
        let (mut two, _) = texture([180, 130], hole, color);
        let before = two.hole.clone();
        assert!(fill(&mut two));
        let mixed = |i: &usize| (0.2..0.55).contains(&two.rgb[*i][0]);
        let inside = || (0..before.len()).filter(|i| before[*i]);
        let count = inside().filter(mixed).count();
        assert!(count * 25 < inside().count(), "{count} of {}", inside().count());
    }

    /// Speckled stone, in the shade on one side of the hole and in the sun on the other: copies of both meet without a step.
    #[test]
    fn of_one_stone_in_two_lights_there_is_no_step() {
        let size = [200, 120];
        let hole = |x: usize, _: usize| (60..140).contains(&x);
        let speck = |x: usize, y: usize| (x * 7919 + y * 104_729 + x * y * 31) % 97;
        let color = |x: usize, y: usize| {
            let light = if x < 100 { 0.0 } else { 0.16 };
            [0.56, 0.53, 0.47].map(|c| c + light + 0.0004 * speck(x, y) as f32)
        };
        let (mut stone, _) = texture(size, hole, color);
        assert!(fill(&mut stone) && !stone.hole.contains(&true));
        let mean = |x: usize, y: usize| -> f32 {
            (0..4).flat_map(|v| (0..4).map(move |u| (y + v) * size[0] + x + u)).map(|i| stone.rgb[i][1]).sum::<f32>()
                / 16.0
        };
        for y in (0..116).step_by(4) {
            let steps = (62..130).map(|x| (mean(x + 4, y) - mean(x, y)).abs());
            let largest = steps.fold(0.0, f32::max);
            assert!(largest < 0.08, "{largest} in row {y}");
        }
    }

    /// A leaf as bright as the stone beside it is no stone: what is around it is not.
    #[test]
    fn what_has_the_colour_of_stone_among_leaves_is_none() {
        let stone = |x: usize, y: usize| x >= 40 || (x, y) == (20, 20);
        let (two, _) =
            texture([80, 40], |_, _| false, |x, y| if stone(x, y) { [0.6, 0.62, 0.65] } else { [0.1, 0.3, 0.1] });
        let at = |x: usize, y: usize| y * 80 + x;
        assert!(two.is_one(at(60, 20), at(70, 10)) && two.is_one(at(20, 15), at(12, 20)));
        assert!(!two.is_one(at(20, 20), at(60, 20)));
    }

    /// Stone whose rim on one side is a little mixed with the green of what stood before it: copies of it are as grey as it is.
    #[test]
    fn a_tinted_rim_tints_nothing() {
        let hole = |x: usize, y: usize| (50..80).contains(&x) && (40..70).contains(&y);
        let speck = |x: usize, y: usize| 0.0004 * ((x * 7919 + y * 104_729 + x * y * 31) % 97) as f32;
        let rim = |x: usize, y: usize| (47..50).contains(&x) && (38..72).contains(&y);
        let color = |x: usize, y: usize| {
            let [r, g, b] = if rim(x, y) { [0.545, 0.55, 0.535] } else { [0.56, 0.54, 0.55] };
            [r + speck(x, y), g + speck(x, y), b + speck(x, y)]
        };
        let (mut stone, _) = texture([140, 110], hole, color);
        let before = stone.hole.clone();
        assert!(fill(&mut stone));
        let green = |i: &usize| stone.rgb[*i][1] - stone.rgb[*i][0];
        let inside = (0..before.len()).filter(|i| before[*i]);
        let greenest = inside.map(|i| green(&i)).fold(f32::MIN, f32::max);
        assert!(greenest < -0.015, "{greenest}");
    }

    /// Joints of three pixels in tiles of 150, which the picture that pieces are chosen in hardly shows, with a hole where two cross:
    /// both go through, and none begins.
    #[test]
    fn thin_joints_cross_a_large_hole() {
        let size = [720, 640];
        let hole = |x: usize, y: usize| (x as f64 - 370.0).powi(2) + (y as f64 - 320.0).powi(2) < 8100.0;
        let speck = |x: usize, y: usize| ((x * 7919 + y * 104_729) * 2_654_435_761 % 1000) as f32 / 1000.0;
        let joint = |x: usize, y: usize| {
            // Turned by some 30 degrees.
            let (u, v) = (0.866 * x as f64 + 0.5 * y as f64, 0.866 * y as f64 - 0.5 * x as f64 + 1000.0);
            [(u - 480.0).rem_euclid(150.0), (v - 1092.0).rem_euclid(150.0)].iter().any(|off| *off < 3.0)
        };
        let color = |x: usize, y: usize| {
            let light = 1.0 - 0.2 * y as f32 / 640.0;
            [0.75, 0.71, 0.66].map(|c| light * (if joint(x, y) { c - 0.3 } else { c }) + 0.01 * speck(x, y))
        };
        let (mut floor, truth) = texture(size, hole, color);
        let before = floor.hole.clone();
        assert!(fill(&mut floor));
        let wrong = |i: &usize| (0..3).any(|c| (floor.rgb[*i][c] - truth[*i][c]).abs() > 0.12);
        let inside = || (0..truth.len()).filter(|i| before[*i]);
        let joints = inside().filter(|i| joint(i % size[0], i / size[0])).count();
        let count = inside().filter(wrong).count();
        assert!(joints > 400 && 6 * count < joints, "{count} wrong, {joints} of joints");
    }

    /// Two pieces, of which the left one's copies end two pixels before it does: there the right one goes on.
    #[test]
    fn pieces_touch() {
        let (texture, _) = texture([60, 20], |x, _| (20..40).contains(&x), |_, _| [0.5; 3]);
        let labels: Vec<usize> = (0..30 * 10).map(|cell| if cell % 30 < 15 { 0 } else { 1 }).collect();
        let copied = copies(&texture, &[[-8, 0], [12, 0]], &labels, 30, 2);
        for (i, from) in copied.iter().enumerate() {
            let by = match i % 60 {
                20..28 => Some(-8),
                28..40 => Some(12),
                _ => None,
            };
            assert_eq!(*from, by.map(|by| i.wrapping_add_signed(by)), "{i}");
        }
    }

    #[test]
    fn without_anything_to_copy_nothing_is_filled() {
        let (mut none, _) = texture([20, 20], |_, _| true, |_, _| [0.5; 3]);
        assert!(!fill(&mut none));
        let (mut whole, _) = texture([20, 20], |_, _| false, |_, _| [0.5; 3]);
        assert!(!fill(&mut whole));
    }
}

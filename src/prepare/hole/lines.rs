//! Thin lines that cross a hole: the joint of tiles, the gap of boards, a cable.
//!
//! A line that ends at a hole, and goes on behind it in the same direction and as strong, goes through it. It is filled along
//! itself, from both ends (structure propagation, Sun et al. 2005): a picture so small that large pieces can be chosen in it
//! shows hardly anything of a line.
//!
//! Lines are found as sums over straight ways, in all directions (a Radon transform of what lies just outside the hole). Of all
//! ways through leaves or stone hardly one is as strong all along both of its ends.

use std::ops::Range;

use glam::DVec2;
use rayon::prelude::*;

use super::similar::Picture;
use crate::prepare::planes;
use crate::scene::resample;
use crate::statistics::quantile;

/// Distances, in pixels, at which what is beside a line is compared with it.
const BESIDE: [usize; 2] = [2, 4];
/// Length of each end that is looked at, as a part of what is hidden between them, and at least, pixels.
const END: f64 = 0.35;
const LEAST_END: f64 = 12.0;
/// An end may be this part of that long where the other is so much longer: what the line is on ends there.
const SHORT: f64 = 0.5;
/// Shortest end of all, pixels: a joint that comes out of the hole right before a wall.
const SHORTEST: usize = 3;
/// Shortest way through the hole that counts, pixels.
const LEAST_GAP: usize = 4;
/// How many times as strong a line is as what this share of the surroundings does not exceed, and its least strength, summed over
/// the channels.
const STRONGER: f64 = 4.0;
const USUAL: f64 = 0.8;
const LEAST: f64 = 0.04;
/// Share of an end that is known, and share of that which shows the line, with this part of its strength at least.
const KNOWN: f64 = 0.5;
const WHOLE: f64 = 0.8;
const PART: f64 = 0.4;
/// The weaker end's strength, as a part of the stronger one's.
const ALIKE: f64 = 0.5;
/// Sine of the least angle at which lines that meet are two.
const CROSSING: f64 = 0.35;
/// Directions that are tried, for each pixel of half of a circle around the hole.
const DIRECTIONS: f64 = 0.6;
/// Lines at most.
const MOST: usize = 16;
/// Strength, as a part of the greatest, from which on it counts for where the middle of a line is.
const MIDDLE: f64 = 0.5;
/// Difference from what is usual along a line from which on something else crosses it, as a part of its strength.
const CROSSED: f64 = 0.5;
/// Shortest piece of a line that is copied, pixels.
const LEAST_PIECE: usize = 3;

/// A line across a hole. Lengths are in pixels.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// Where it goes into the hole and where it comes out.
    pub ends: [DVec2; 2],
    /// Distance from its middle at which it is no more.
    pub beside: f64,
    /// Length of each end that was looked at.
    pub known: f64,
    /// Which end, if any, may be on something else beyond that: nothing is copied from it.
    pub short: [bool; 2],
    /// How much it differs from what is beside it, summed over the channels.
    pub strength: f64,
}

impl Line {
    /// The direction from where it goes in to where it comes out.
    pub fn along(&self) -> DVec2 {
        (self.ends[1] - self.ends[0]).normalize()
    }

    /// From where it goes in to where it comes out.
    pub fn length(&self) -> f64 {
        self.ends[0].distance(self.ends[1])
    }

    /// How far a place is along the line, from where it goes in, and how far to its side.
    pub fn place(&self, at: DVec2) -> [f64; 2] {
        let (off, along) = (at - self.ends[0], self.along());
        [off.dot(along), along.perp_dot(off)]
    }

    /// Scales the line with its picture, which becomes so many times as large.
    pub fn scaled(&self, by: f64) -> Self {
        Self { ends: self.ends.map(|end| end * by), beside: self.beside * by, known: self.known * by, ..*self }
    }

    /// How sure it is.
    fn evidence(&self) -> f64 {
        self.strength * self.known
    }

    /// Whether another is the same line, found at a place nearby.
    fn is(&self, other: &Self) -> bool {
        let [a, b] = other.ends.map(|end| self.place(end));
        let near = a[1].abs().min(b[1].abs()) < 2.0 * BESIDE[1] as f64;
        let overlap = a[0].min(b[0]) < self.length() && a[0].max(b[0]) > 0.0;
        near && overlap && self.along().perp_dot(other.along()).abs() < CROSSING
    }
}

/// Sums of the channels of a picture.
pub struct Grey {
    size: [usize; 2],
    /// `[pixel]`; NaN where it is not known.
    values: Vec<f64>,
}

impl Grey {
    pub fn new(Picture { rgb, known, size }: Picture<'_>) -> Self {
        let grey =
            |(rgb, known): (&[f32; 3], &bool)| if *known { f64::from(rgb.iter().sum::<f32>()) } else { f64::NAN };
        Self { size, values: rgb.iter().zip(known).map(grey).collect() }
    }

    /// Between the middles of four pixels; NaN where one of them is not known.
    fn at(&self, place: DVec2) -> f64 {
        let [w, h] = self.size;
        let inside = place.cmpge(DVec2::splat(0.5)).all() && place.cmplt(DVec2::new(w as f64, h as f64) - 0.5).all();
        let grey = || resample::bilinear(self.size.map(|n| n as u32), place.to_array(), |i| [self.values[i]])[0];
        if inside { grey() } else { f64::NAN }
    }

    /// How much brighter it is at a place than on both sides.
    fn ridge(&self, place: DVec2, across: DVec2, beside: f64) -> f64 {
        ridge(self.at(place), [beside, -beside].map(|off| self.at(place + across * off)))
    }
}

/// The lesser of the differences to both sides; nothing where they are of two signs, NaN where one is not known.
fn ridge(here: f64, sides: [f64; 2]) -> f64 {
    match sides.map(|side| here - side) {
        [a, b] if a.is_nan() || b.is_nan() => f64::NAN,
        [a, b] if a * b > 0.0 => a.signum() * a.abs().min(b.abs()),
        _ => 0.0,
    }
}

/// The surroundings of a hole, turned so that lines of one direction are rows.
struct Turned {
    middle: DVec2,
    /// The direction of the rows.
    along: DVec2,
    /// Columns and rows to each side of the middle.
    half: [usize; 2],
    grey: Vec<f64>,
    hidden: Vec<bool>,
}

impl Turned {
    fn new(grey: &Grey, hole: &[bool], middle: DVec2, along: DVec2, half: [usize; 2]) -> Self {
        let [w, h] = grey.size;
        let [columns, rows] = half.map(|n| n as i64);
        let all = (-rows..=rows).flat_map(|row| (-columns..=columns).map(move |column| [column as f64, row as f64]));
        let place = |[column, row]: [f64; 2]| middle + along * column + along.perp() * row;
        let hidden = |at: DVec2| {
            let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < w as f64 && at.y < h as f64;
            inside && hole[at.y as usize * w + at.x as usize]
        };
        let (grey, hidden) = all.map(place).map(|at| (grey.at(at), hidden(at))).unzip();
        Self { middle, along, half, grey, hidden }
    }

    /// The lines in this direction that are so strong, with what is beside them at a distance.
    fn lines(&self, beside: usize, least: f64) -> Vec<Line> {
        let w = 2 * self.half[0] + 1;
        let strength = |row: usize| -> Vec<f64> {
            let at = |i: usize| ridge(self.grey[i], [self.grey[i - beside * w], self.grey[i + beside * w]]);
            (row * w..(row + 1) * w).map(at).collect()
        };
        let rows: Vec<Vec<f64>> = (beside..2 * self.half[1] + 1 - beside).map(strength).collect();
        let mut found = vec![];
        for (row, near) in (beside + 1..).zip(rows.windows(3)) {
            let hidden: Vec<usize> = (0..w).filter(|i| self.hidden[row * w + i]).collect();
            if hidden.last().is_none_or(|last| last - hidden[0] < LEAST_GAP) {
                continue;
            }
            // A line is not quite straight.
            let stronger = |a: f64, b: f64| if b.is_nan() || a.abs() >= b.abs() { a } else { b };
            let nearly: Vec<f64> = (0..w).map(|i| near.iter().map(|row| row[i]).fold(f64::NAN, stronger)).collect();
            let [nearly, here] = [Row::new(&nearly), Row::new(&near[1])];
            let parts: Vec<&[usize]> = hidden.chunk_by(|a, b| (b - a) as f64 <= LEAST_END).collect();
            let spans = (0..parts.len()).flat_map(|from| (from..parts.len()).map(move |to| [from, to]));
            for [from, to] in spans {
                let [first, last] = [parts[from][0], parts[to][parts[to].len() - 1]];
                let Some((known, strength)) = line(&nearly, &here, [first, last], least) else { continue };
                let off = self.along.perp() * (row as f64 - self.half[1] as f64);
                let place = |column: usize| self.middle + off + self.along * (column as f64 - self.half[0] as f64);
                let ends = [place(first - 1), place(last + 1)];
                let short = known.map(|n| n < known[0].max(known[1]));
                let known = known[0].min(known[1]) as f64;
                found.push(Line { ends, known, short, beside: beside as f64, strength });
            }
        }
        found
    }
}

/// Strengths along a row.
struct Row<'a> {
    values: &'a [f64],
    /// Sum and number of those known before each.
    sums: Vec<(f64, u32)>,
}

impl<'a> Row<'a> {
    fn new(values: &'a [f64]) -> Self {
        let mut sums = vec![(0.0, 0)];
        let mut last = (0.0, 0);
        for value in values {
            if value.is_finite() {
                last = (last.0 + value, last.1 + 1);
            }
            sums.push(last);
        }
        Self { values, sums }
    }

    /// The mean of some columns, of which enough are known.
    fn mean(&self, columns: &Range<usize>) -> Option<f64> {
        let (from, to) = (self.sums[columns.start], self.sums.get(columns.end)?);
        let n = f64::from(to.1 - from.1);
        (n >= KNOWN * columns.len() as f64).then_some((to.0 - from.0) / n)
    }

    /// Whether most of what is known of some columns shows a line of this strength.
    fn shows(&self, columns: &Range<usize>, strength: f64) -> bool {
        let known = || self.values[columns.clone()].iter().filter(|v| v.is_finite());
        let shows = known().filter(|v| **v * strength.signum() >= PART * strength.abs()).count();
        shows as f64 >= WHOLE * known().count() as f64
    }
}

/// The lengths of both ends of a line that is hidden between two columns, and its strength, if it is one of at least this. It lies
/// here or, where it is not straight, in the rows beside.
fn line(nearly: &Row<'_>, here: &Row<'_>, [first, last]: [usize; 2], least: f64) -> Option<([usize; 2], f64)> {
    if last - first < LEAST_GAP {
        return None;
    }
    let known = (END * (last - first) as f64).max(LEAST_END).ceil() as usize;
    let short = (SHORT * known as f64).ceil() as usize;
    // The less there is at one end, the more at the other.
    let [some, few] = [short, SHORTEST].map(|n| [n, 2 * known - n]);
    let ends = [[known; 2], some, [some[1], some[0]], few, [few[1], few[0]]];
    ends.into_iter().find_map(|ends| with_ends(nearly, here, [first, last], ends, least))
}

/// Looks for a line by ends of these lengths.
fn with_ends(
    nearly: &Row<'_>,
    here: &Row<'_>,
    [first, last]: [usize; 2],
    known: [usize; 2],
    least: f64,
) -> Option<([usize; 2], f64)> {
    let (before, behind) = (first.checked_sub(known[0])?..first, last + 1..last + 1 + known[1]);
    let strength = here.mean(&before)?.abs().min(here.mean(&behind)?.abs());
    if strength < least {
        return None;
    }
    let (a, b) = (nearly.mean(&before)?, nearly.mean(&behind)?);
    let weaker = if a.abs() < b.abs() { a } else { b };
    let is_one = a * b > 0.0 && weaker.abs() >= ALIKE * a.abs().max(b.abs());
    // What is known in between shows it, too.
    let all = [(before, a), (behind, b), (first..last + 1, weaker)];
    (is_one && all.iter().all(|(columns, strength)| nearly.shows(columns, *strength))).then_some((known, strength))
}

/// The lines that cross a picture's hole, surest first.
pub fn lines(picture: Picture<'_>, hole: &[bool]) -> Vec<Line> {
    let (grey, size @ [w, h]) = (Grey::new(picture), picture.size);
    // What is too thin for a gap is left out, and parts that are near each other are one.
    let thick = resample::opened([w as u32, h as u32], |i| hole[i], LEAST_GAP as u32 / 2);
    let near = resample::dilate(&thick, LEAST_END as u32 / 2);
    let mut near: Vec<bool> = near.as_raw().iter().map(|v| *v != 0).collect();
    let mut found: Vec<Line> = vec![];
    for first in 0..w * h {
        let part = planes::connected(first, &mut near, size);
        let places = part.iter().filter(|i| hole[**i]).map(|i| middle_of(*i, w));
        let (low, high) = places.fold((DVec2::MAX, DVec2::MIN), |(low, high), at| (low.min(at), high.max(at)));
        if low.x <= high.x {
            found.extend(across(&grey, hole, [low, high]));
        }
    }
    found.sort_by(|a, b| b.evidence().total_cmp(&a.evidence()));
    let mut kept: Vec<Line> = vec![];
    for line in found {
        if kept.len() < MOST && !kept.iter().any(|other| other.is(&line)) {
            kept.push(line);
        }
    }
    kept
}

/// The middle of a pixel of a picture so wide.
pub fn middle_of(pixel: usize, w: usize) -> DVec2 {
    DVec2::new((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5)
}

/// The lines across a part of the hole between two corners, one of them often several times.
fn across(grey: &Grey, hole: &[bool], [low, high]: [DVec2; 2]) -> Vec<Line> {
    let (middle, reach) = (0.5 * (low + high), 0.5 * low.distance(high) + 1.0);
    let around = |at: &DVec2| at.distance(middle) <= 2.0 * reach + LEAST_END;
    let usual = |beside: usize| {
        const ACROSS: [DVec2; 4] = [DVec2::X, DVec2::Y, DVec2::new(0.6, 0.8), DVec2::new(0.8, -0.6)];
        let places = (0..hole.len()).step_by(3).map(|i| middle_of(i, grey.size[0])).filter(around);
        let ridges = places.flat_map(|at| ACROSS.map(|across| grey.ridge(at, across, beside as f64).abs()));
        quantile(ridges.filter(|v| v.is_finite()), USUAL).unwrap_or(f64::INFINITY)
    };
    let least = BESIDE.map(|beside| (STRONGER * usual(beside)).max(LEAST));
    // The line may be hidden by other parts, too.
    let columns = ((2.0 + (4.0 - 2.0 * SHORT) * END) * reach + (2.0 - SHORT) * LEAST_END).ceil() as usize + 2;
    let rows = reach.ceil() as usize + BESIDE[1] + 2;
    let directions = (DIRECTIONS * std::f64::consts::PI * reach).ceil() as usize;
    let in_direction = |k: usize| {
        let along = DVec2::from_angle(std::f64::consts::PI * k as f64 / directions as f64);
        let turned = Turned::new(grey, hole, middle, along, [columns, rows]);
        BESIDE.into_iter().zip(least).flat_map(|(beside, least)| turned.lines(beside, least)).collect::<Vec<Line>>()
    };
    (0..directions).into_par_iter().flat_map_iter(in_direction).collect()
}

/// Moves a line, found in a reduced picture, to where it is in this one: each end to the middle of what differs there from what is
/// beside it, so many pixels to the side at most. A line is wide, and differs most all over its width.
pub fn refined(grey: &Grey, line: &Line, most: f64) -> Line {
    let middle = |line: &Line, end: usize| {
        let (end, away) = (line.ends[end], if end == 0 { -line.along() } else { line.along() });
        let strength = |aside: f64| {
            let places = (0..line.known.ceil() as usize).map(|i| end + away.perp() * aside + away * (i as f64 + 0.5));
            let known = places.map(|at| grey.ridge(at, away.perp(), line.beside)).filter(|v| v.is_finite());
            known.sum::<f64>().abs()
        };
        let steps = (2.0 * most).ceil() as i64;
        let all: Vec<(f64, f64)> =
            (-steps..=steps).map(|k| 0.5 * k as f64).map(|aside| (strength(aside), aside)).collect();
        let strongest = all.iter().map(|(strength, _)| *strength).fold(0.0, f64::max);
        let weigh = |(sum, all): (f64, f64), (strength, aside): &(f64, f64)| {
            let weight = (strength - MIDDLE * strongest).max(0.0);
            (sum + weight * aside, all + weight)
        };
        let (sum, all) = all.iter().fold((0.0, 0.0), weigh);
        end + away.perp() * if all > 0.0 { sum / all } else { 0.0 } + away * 0.5 * line.known
    };
    // Once more from there: of a line that was far to the side a part was beyond what is looked at.
    (0..2).fold(*line, |line, _| {
        let [a, b] = [0, 1].map(|end| middle(&line, end));
        let back = (b - a).normalize() * 0.5 * line.known;
        Line { ends: [a + back, b - back], ..line }
    })
}

/// The piece of a line's end that is copied into the hole.
#[derive(Clone, Copy, Debug)]
pub struct Piece {
    /// From the hole along the line.
    away: DVec2,
    /// Distance from the hole to where the piece begins, pixels.
    from: f64,
    /// Length of the piece, pixels.
    pub length: f64,
}

impl Piece {
    /// The piece from the hole on in this direction, as long as this or a little shorter.
    pub fn new(away: DVec2, length: f64) -> Self {
        Self::between(away, 0..length.max(1.0) as usize)
    }

    /// The piece in this direction between two distances, shortened to where whole pixels leave the line least.
    fn between(away: DVec2, best: Range<usize>) -> Self {
        let from = best.start as f64;
        let leaves = |length: usize| away.perp_dot((away * (from + length as f64)).round()).abs();
        let lengths = best.len().div_ceil(2)..=best.len();
        let length = lengths.min_by(|a, b| leaves(*a).total_cmp(&leaves(*b))).unwrap_or(best.len());
        Self { away, from, length: length as f64 }
    }

    /// The way to what is copied to a place so far in the hole: over as many lengths of the piece as lead out of it, and `again`
    /// more.
    pub fn shift(&self, inside: f64, again: usize) -> [isize; 2] {
        let times = (inside / self.length).ceil().max(1.0) + again as f64;
        (self.away * (self.from + times * self.length)).round().to_array().map(|v| v as isize)
    }
}

/// The longest pieces of both ends of a line that nothing crosses, as wide as `half` to each side.
pub fn pieces(grey: &Grey, line: &Line, half: f64) -> [Piece; 2] {
    let n = (2.0 * line.known).max(line.length()).ceil() as usize;
    let side = half.ceil() as i64;
    [0, 1].map(|end| {
        let away = if end == 0 { -line.along() } else { line.along() };
        let across = |i: usize| -> Vec<f64> {
            let at = line.ends[end] + away * (i as f64 + 0.5);
            (-side..=side).map(|off| grey.at(at + away.perp() * off as f64)).collect()
        };
        let all: Vec<Vec<f64>> = (0..n).map(across).collect();
        let usual = |off: usize| {
            let known = all.iter().map(|across| across[off]).filter(|v| v.is_finite());
            quantile(known, 0.5).unwrap_or(f64::NAN)
        };
        let usual: Vec<f64> = (0..all[0].len()).map(usual).collect();
        let plain = |across: &Vec<f64>| {
            let crossed = across.iter().zip(&usual).any(|(v, usual)| (v - usual).abs() > CROSSED * line.strength);
            !crossed && across[side as usize].is_finite()
        };
        let plain: Vec<bool> = all.iter().map(plain).collect();
        let near = longest(&plain[..n.min(line.known.ceil() as usize)]);
        // Where something crosses it near the hole, what is farther away.
        let best = if 2.0 * near.len() as f64 >= line.known { near } else { longest(&plain) };
        let best = if best.len() < LEAST_PIECE { 0..n } else { best };
        Piece::between(away, best)
    })
}

/// The longest range that is so all along, of equals the first.
fn longest(so: &[bool]) -> Range<usize> {
    let (mut best, mut start) = (0..0, 0);
    for part in so.chunk_by(|a, b| a == b) {
        if part[0] && part.len() > best.len() {
            best = start..start + part.len();
        }
        start += part.len();
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [120, 100];

    fn noise(i: usize) -> f32 {
        (i.wrapping_mul(2_654_435_761) >> 7) as f32 % 1000.0 / 1000.0
    }

    /// The lines across a round hole in the middle of a picture.
    fn found(color: impl Fn(f64, f64) -> f32) -> Vec<Line> {
        let [w, h] = SIZE;
        let place = |i: usize| (i % w, i / w);
        let hole: Vec<bool> = (0..w * h)
            .map(|i| (place(i).0 as f64 - 60.0).powi(2) + (place(i).1 as f64 - 50.0).powi(2) < 400.0)
            .collect();
        let known: Vec<bool> = hole.iter().map(|hole| !hole).collect();
        let rgb: Vec<[f32; 3]> = (0..w * h)
            .map(|i| [color(place(i).0 as f64 + 0.5, place(i).1 as f64 + 0.5) + 0.01 * noise(i); 3])
            .collect();
        lines(Picture { rgb: &rgb, known: &known, size: SIZE }, &hole)
    }

    /// A dark line two pixels wide at every tenth of a half circle is found, where it is, and once.
    #[test]
    fn a_line_of_any_direction_is_found() {
        for k in 0..10 {
            let along = DVec2::from_angle(0.1 + 0.314 * f64::from(k));
            let through = DVec2::new(60.0, 50.0) + along.perp() * 6.0;
            let off = |x: f64, y: f64| along.perp_dot(DVec2::new(x, y) - through);
            let found = found(|x, y| 0.7 - 0.3 * (1.5 - off(x, y).abs()).clamp(0.0, 1.0) as f32);
            assert_eq!(found.len(), 1, "{k}: {found:?}");
            for end in found[0].ends {
                assert!(off(end.x, end.y).abs() <= 1.5, "{k}: {end} is {} off", off(end.x, end.y));
            }
        }
    }

    /// Neither a border of two colours, a line that ends in the hole, nor one that goes on elsewhere is one.
    #[test]
    fn what_does_not_cross_is_no_line() {
        let dark = |off: f64| if off.abs() <= 1.0 { 0.4 } else { 0.7 };
        assert_eq!(found(|x, _| if x < 57.0 { 0.4 } else { 0.7 }).len(), 0);
        assert_eq!(found(|x, y| if y < 50.0 { dark(x - 57.0) } else { 0.7 }).len(), 0);
        assert_eq!(found(|x, y| dark(x - if y < 50.0 { 48.0 } else { 70.0 })).len(), 0);
        assert_eq!(found(|x, _| dark(x - 57.0)).len(), 1);
    }

    /// One that ends at a wall soon beyond the hole is, where the other end is so much longer.
    #[test]
    fn a_line_may_end_at_a_wall() {
        let floor = |x: f64| if (x - 57.0).abs() <= 1.0 { 0.4 } else { 0.7 };
        let short = |wall: f64| found(|x, y| if y < wall { 0.2 } else { floor(x) });
        for wall in [20.0, 27.0] {
            let lines = short(wall);
            assert_eq!(lines.len(), 1, "{lines:?}");
            let [a, b] = lines[0].ends.map(|end| end.y);
            assert_eq!(lines[0].short, [a < b, b < a]);
        }
        // Nothing of it comes out.
        assert_eq!(short(31.0).len(), 0);
    }

    /// Leaves of all sizes, at many seeds: hardly any way through them is a line.
    #[test]
    fn leaves_have_none() {
        let mut lines = 0;
        for seed in 0..20 {
            let leaf =
                |x: f64, y: f64, size: f64| noise((x / size) as usize * 7919 + (y / size) as usize * 104_729 + seed);
            lines += found(|x, y| 0.2 + 0.2 * (leaf(x, y, 1.0) + leaf(x, y, 3.0) + leaf(x, y, 7.0))).len();
        }
        assert!(lines <= 1, "{lines}");
    }

    /// A line eight pixels wide, found up to three pixels beside its middle, is brought there: it is as dark all over its width.
    #[test]
    fn a_wide_line_is_where_its_middle_is() {
        let [w, h] = SIZE;
        for k in 0..7 {
            let along = DVec2::from_angle(0.2 + 0.4 * f64::from(k));
            let through = DVec2::new(60.0, 50.0);
            let off = |at: DVec2| along.perp_dot(at - through);
            let color =
                |i: usize| 0.7 - 0.3 * (4.5 - off(middle_of(i, w)).abs()).clamp(0.0, 1.0) as f32 + 0.01 * noise(i);
            let rgb: Vec<[f32; 3]> = (0..w * h).map(|i| [color(i); 3]).collect();
            let known: Vec<bool> = (0..w * h).map(|i| middle_of(i, w).distance(through) > 16.0).collect();
            let grey = Grey::new(Picture { rgb: &rgb, known: &known, size: SIZE });
            for aside in [-3.0, -1.0, 0.0, 2.0, 3.0] {
                let ends = [-1.0, 1.0].map(|end| through + along * 17.0 * end + along.perp() * aside * end);
                let line = Line { ends, beside: 9.0, known: 14.0, short: [false; 2], strength: 0.9 };
                for end in refined(&grey, &line, 4.5).ends {
                    assert!(off(end).abs() <= 0.5, "{k}, {aside}: {end} is {} off", off(end));
                }
            }
        }
    }

    /// Two that cross are two.
    #[test]
    fn crossing_lines_are_two() {
        let dark = |off: f64| off.abs() <= 1.0;
        let found = found(|x, y| if dark(x - 57.0) || dark(0.6 * (x - 60.0) + 0.8 * (y - 52.0)) { 0.4 } else { 0.7 });
        assert_eq!(found.len(), 2, "{found:?}");
    }
}

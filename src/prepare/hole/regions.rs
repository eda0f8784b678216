//! Regions of one material around a hole, and in it.
//!
//! Where one material ends at another around a hole, the border goes on into it the shortest way, and a straight one that comes out on
//! the other side is copied along itself. One that does not come out goes straight on, as far as there is anything to its sides. What repeats, as tiles of two colours do, has many borders, and is left to the shifts
//! by which it is like itself.

use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;

use super::holed::Texture;
use super::lines::{Line, Piece, middle_of};
use super::material::{ENOUGH, MATERIAL, materials, nearest, of_another};
use crate::prepare::planes;

/// Pixels to each side whose mean says what a pixel is of.
const REACH: usize = 2;
/// Cost of a pixel at most, by its distance from the region's colour in [`MATERIAL`], and of a border per pixel of its length.
const MOST: f64 = 4.0;
const BORDER: f64 = 3.0;
/// Most regions.
const REGIONS: usize = 16;
/// Fewest pixels that are known around a hole.
const FEWEST: usize = 50;
/// Least margin around a hole, pixels.
const MARGIN: usize = 8;
/// Parts of a hole's rim, each of one region, at most: of two borders across it; and longest part that is none, pixels.
const ARCS: usize = 4;
const SHORT: usize = 2;
/// Pixels to each side of a border where what is of either region may be copied: the border itself is.
const BAND: isize = 2;
/// Pixels from a border to each side at which colours must be apart, by this part of how far the regions are, for it to be one.
const NEAR: isize = 2;
const STEP: f32 = 0.5;
/// Length of a border's ends that is looked at, as a part of its way through the hole, and at least, pixels.
const END: f64 = 0.35;
const LEAST_END: f64 = 8.0;
/// Pixels that a border may be beside a line, share of both its ends along which it is there, and shortest way through the hole.
const STRAIGHT: f64 = 1.0;
const WHOLE: f64 = 0.75;
const LEAST_GAP: f64 = 3.0;
/// How far ends of different borders are apart at least, pixels, and how far a quarter of an end may be beside its line.
const APART: f64 = 8.0;
const BENT: f64 = 0.35;
/// How often a line is refined.
const AGAIN: usize = 3;
/// Places of a border between which lines are tried.
const PLACES: usize = 80;
/// Pixels from a border at which the regions are to its sides.
const BESIDE: f64 = 2.0;
/// How far from there a border is looked for at full size, in pixels of the reduced picture, and difference of what is to its sides, as
/// a part of that of the regions, from which on it is seen.
const ASIDE: f64 = 3.0;
const SEEN: f64 = 0.4;

/// Regions around a part of a hole.
pub struct Regions {
    /// Mean colour of each.
    means: Vec<[f32; 3]>,
    /// `[pixel]` the number of its region; in the hole, too.
    of: Vec<u8>,
    /// `[pixel]` set of the regions near it.
    near: Vec<u16>,
}

/// A straight border between two regions that goes through a hole.
pub struct Edge {
    /// Where it goes in and comes out.
    line: Line,
    /// Colours to its sides.
    between: [[f32; 3]; 2],
    /// Length of each end on which the regions are to its sides.
    lengths: [f64; 2],
}

/// The pixels of a picture so near to one, to each side.
fn within(texture: &Texture, i: usize, reach: isize) -> impl Iterator<Item = usize> {
    let shifts = (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| [dx, dy]));
    shifts.filter_map(move |shift| texture.shifted(i, shift))
}

/// The pixel of a picture at a place, where it may be copied.
fn source(texture: &Texture, at: DVec2) -> Option<usize> {
    let [w, h] = texture.size;
    let inside = at.cmpge(DVec2::ZERO).all() && at.x < w as f64 && at.y < h as f64;
    inside.then(|| at.y as usize * w + at.x as usize).filter(|i| texture.source[*i])
}

/// The way out of the hole along a line's end.
fn away(line: &Line, end: usize) -> DVec2 {
    if end == 0 { -line.along() } else { line.along() }
}

/// Makes one of regions that go over into each other: of one material in a light that falls off.
fn gradual(texture: &Texture, means: &[[f32; 3]], of: &mut [u8]) {
    // `[pair]` sums of the colours just beside their border, and number.
    let mut beside = BTreeMap::<[u8; 2], ([[f32; 3]; 2], f32)>::new();
    for i in (0..of.len()).filter(|i| texture.source[*i]) {
        for [dx, dy] in [[1, 0], [0, 1]] {
            let at = |steps: isize| texture.shifted(i, [dx * steps, dy * steps]).filter(|j| texture.source[*j]);
            let (Some(before), Some(next), Some(after)) = (at(-NEAR), at(1), at(1 + NEAR)) else { continue };
            if of[i] == of[next] {
                continue;
            }
            let mut pair = [(of[i], before), (of[next], after)];
            pair.sort_unstable();
            let (sums, count) = beside.entry(pair.map(|(region, _)| region)).or_default();
            for (sum, (_, j)) in sums.iter_mut().zip(pair) {
                let color = texture.mean_within(j, REACH);
                (0..3).for_each(|c| sum[c] += color[c]);
            }
            *count += 1.0;
        }
    }
    for ([a, b], (sums, count)) in beside {
        let [one, other] = sums.map(|sum| sum.map(|v| v / count));
        if of_another(one, other) < STEP * of_another(means[usize::from(a)], means[usize::from(b)]) {
            let [a, b] = [a, b].map(|k| of.iter().position(|label| *label == k).map_or(k, |i| of[i]));
            of.iter_mut().filter(|label| **label == b).for_each(|label| *label = a);
        }
    }
}

/// `[pixel]` the mean colour that says what each is of.
pub fn looks(texture: &Texture) -> Vec<[f32; 3]> {
    (0..texture.hole.len()).into_par_iter().map(|i| texture.mean_within(i, REACH)).collect()
}

impl Regions {
    /// The regions around a part of a hole, by its [`looks`]; nothing where there is one alone.
    pub fn around(texture: &Texture, part: &[usize], looks: &[[f32; 3]]) -> Option<Self> {
        let [w, h] = texture.size;
        let bounds = |of: &dyn Fn(usize) -> usize, end: usize| {
            let (low, high) = part.iter().fold((end, 0), |(low, high), i| (low.min(of(*i)), high.max(of(*i) + 1)));
            let margin = (high - low).max(MARGIN);
            low.saturating_sub(margin)..(high + margin).min(end)
        };
        let (columns, rows) = (bounds(&|i| i % w, w), bounds(&|i| i / w, h));
        let size = [columns.len(), rows.len()];
        let pixels: Vec<usize> = rows.flat_map(|y| columns.clone().map(move |x| y * w + x)).collect();
        let all: Vec<Option<[f32; 3]>> = (0..w * h).map(|i| texture.source[i].then_some(looks[i])).collect();
        let colors: Vec<Option<[f32; 3]>> = pixels.iter().map(|i| all[*i]).collect();
        let known: Vec<[f32; 3]> = colors.iter().flatten().copied().collect();
        let mut means = if known.len() < FEWEST { vec![] } else { materials(&known) };
        means.truncate(REGIONS);
        if means.len() < 2 {
            return None;
        }
        let cost = |mean: &[f32; 3], color: &Option<[f32; 3]>| {
            color.map_or(0.0, |color| f64::from(of_another(color, *mean) / MATERIAL).min(MOST))
        };
        let costs: Vec<Vec<f64>> =
            means.par_iter().map(|mean| colors.iter().map(|color| cost(mean, color)).collect()).collect();
        let found = planes::cheapest(&costs, &planes::Border { between: |_| BORDER, at: |_, _| 0.0 }, size);
        // Beyond by its own colour.
        let mut of: Vec<u8> =
            all.par_iter().map(|color| color.and_then(|color| nearest(color, &means)).unwrap_or(0) as u8).collect();
        pixels.iter().zip(found).for_each(|(i, label)| of[*i] = label as u8);
        gradual(texture, &means, &mut of);
        let near = |i: usize| {
            let told = within(texture, i, BAND).filter(|j| texture.hole[*j] || texture.source[*j]);
            told.fold(0, |set: u16, j| set | 1 << of[j])
        };
        let near = (0..w * h).into_par_iter().map(near).collect();
        Some(Self { means, of, near })
    }

    /// Whether a pixel of the hole may be copied from another.
    pub fn may(&self, pixel: usize, from: usize) -> bool {
        self.near[pixel] & (1 << self.of[from]) != 0
    }

    /// Whether borders run into a part of the hole, few of them, and enough of what may be copied is of each region in it.
    pub fn hold(&self, texture: &Texture, part: &[usize], allowed: &[bool]) -> bool {
        let mut rim = vec![false; self.of.len()];
        let beside = part.iter().flat_map(|i| within(texture, *i, 1));
        beside.filter(|i| texture.source[*i]).for_each(|i| rim[i] = true);
        let mut arcs = 0;
        for first in 0..rim.len() {
            let mut arc: Vec<usize> = Some(first).filter(|i| std::mem::take(&mut rim[*i])).into_iter().collect();
            let mut at = 0;
            while at < arc.len() {
                let next = within(texture, arc[at], 2).filter(|j| self.of[*j] == self.of[first]);
                arc.extend(next.filter(|j| std::mem::take(&mut rim[*j])));
                at += 1;
            }
            arcs += usize::from(arc.len() > SHORT);
        }
        let mut counts = vec![[0.0; 2]; self.means.len()];
        part.iter().for_each(|i| counts[usize::from(self.of[*i])][0] += 1.0);
        let sources = (0..allowed.len()).filter(|i| allowed[*i] && texture.source[*i]);
        sources.for_each(|i| counts[usize::from(self.of[i])][1] += 1.0);
        arcs <= ARCS && counts.iter().all(|[wanted, there]| *there >= ENOUGH * wanted)
    }

    /// `[pair]` where two regions meet beside the hole.
    fn borders(&self, texture: &Texture) -> BTreeMap<[u8; 2], Vec<DVec2>> {
        let w = texture.size[0];
        let mut places = BTreeMap::<[u8; 2], Vec<DVec2>>::new();
        for i in (0..self.of.len()).filter(|i| texture.source[*i]) {
            for j in [[1, 0], [0, 1]].into_iter().filter_map(|shift| texture.shifted(i, shift)) {
                let pair = [self.of[i].min(self.of[j]), self.of[i].max(self.of[j])];
                if texture.source[j] && pair[0] < pair[1] {
                    places.entry(pair).or_default().push(0.5 * (middle_of(i, w) + middle_of(j, w)));
                }
            }
        }
        places
    }

    /// The straight borders that go into a part of the hole and come out of it.
    pub fn edges(&self, texture: &Texture, part: &[usize]) -> Vec<Edge> {
        let one = |(pair, places): ([u8; 2], Vec<DVec2>)| {
            let ways =
                Ways::new(texture, part, &places).all().into_iter().filter(|way| way.ends.iter().all(|end| *end));
            let best = ways.reduce(|best, next| if next.fit() > best.fit() { next } else { best })?;
            let lengths = [0, 1].map(|end| self.length(texture, &best.line, end, pair));
            Some(Edge { line: best.line, between: pair.map(|k| self.means[usize::from(k)]), lengths })
        };
        self.borders(texture).into_iter().filter_map(one).collect()
    }

    /// Straight borders that go into a part of the hole, come out of it or not, as they are in a picture so many times as large: from
    /// where they go in to where they would come out.
    pub fn ends(&self, texture: &Texture, part: &[usize], large: &Texture, by: f64) -> Vec<Line> {
        let mut found: Vec<Line> = vec![];
        for (pair, places) in self.borders(texture) {
            let between = pair.map(|k| self.means[usize::from(k)]);
            let of = |way: Way| [0, 1].map(|end| way.ends[end].then(|| (way.fits[end], way.from(end))));
            let mut all: Vec<(f64, Line)> =
                Ways::new(texture, part, &places).all().into_iter().flat_map(of).flatten().collect();
            all.sort_by(|a, b| b.0.total_cmp(&a.0));
            for (_, line) in all {
                let known = |other: &Line| other.ends[0].distance(line.ends[0] * by) < APART * by;
                if !found.iter().any(known) {
                    found.extend(Edge { line, between, lengths: [0.0; 2] }.going_in(large, by));
                }
            }
        }
        found
    }

    /// How far a border's end has the two regions to its sides.
    fn length(&self, texture: &Texture, line: &Line, end: usize, pair: [u8; 2]) -> f64 {
        let away = away(line, end);
        let are = |i: &usize| {
            let at = line.ends[end] + away * (*i as f64 + 0.5);
            let [one, other] = [BESIDE, -BESIDE].map(|off| source(texture, at + away.perp() * off).map(|i| self.of[i]));
            let pair = pair.map(Some);
            [one, other] == pair || [other, one] == pair
        };
        // What is at the rim of the hole may be mixed.
        let from = (0..=BESIDE as usize).find(are).unwrap_or(0);
        from as f64 + (from..line.length() as usize).take_while(are).count() as f64
    }
}

/// Places of a border around a part of a hole.
struct Ways {
    /// Middles of the part's pixels.
    part: Vec<DVec2>,
    /// Places near it.
    near: Vec<DVec2>,
}

/// A straight way through a hole.
struct Way {
    line: Line,
    /// Whether the border is there along each end.
    ends: [bool; 2],
    /// How much of the border is how near to each end.
    fits: [f64; 2],
}

impl Way {
    fn fit(&self) -> f64 {
        self.fits[0] + self.fits[1]
    }

    /// The line, going into the hole at this end.
    fn from(&self, end: usize) -> Line {
        Line { ends: [self.line.ends[end], self.line.ends[1 - end]], ..self.line }
    }
}

impl Ways {
    fn new(texture: &Texture, part: &[usize], places: &[DVec2]) -> Self {
        let part: Vec<DVec2> = part.iter().map(|i| middle_of(*i, texture.size[0])).collect();
        let (low, high) = part.iter().fold((DVec2::MAX, DVec2::MIN), |(low, high), at| (low.min(*at), high.max(*at)));
        let reach = DVec2::splat((high - low).max_element().max(LEAST_END));
        let is_near = |at: &&DVec2| at.cmpge(low - reach).all() && at.cmple(high + reach).all();
        Self { near: places.iter().filter(is_near).copied().collect(), part }
    }

    /// The ways between two places, along one of whose ends the border is.
    fn all(&self) -> Vec<Way> {
        let some: Vec<DVec2> = self.near.iter().copied().step_by(self.near.len().div_ceil(PLACES).max(1)).collect();
        let pairs = (0..some.len()).into_par_iter().flat_map_iter(|a| (0..a).map(move |b| [b, a]));
        pairs.filter_map(|pair| self.through(pair.map(|k| some[k]))).collect()
    }

    fn through(&self, ends: [DVec2; 2]) -> Option<Way> {
        if ends[0].distance(ends[1]) < 0.5 * LEAST_END {
            return None;
        }
        let line = Line { ends, beside: 1.0, known: 0.0, short: [false; 2], strength: 0.0 };
        let inside = self.part.iter().map(|at| line.place(*at)).filter(|[_, aside]| aside.abs() <= 0.75);
        let (from, to) = inside.fold((f64::MAX, f64::MIN), |(from, to), [at, _]| (from.min(at), to.max(at)));
        (to - from >= LEAST_GAP).then_some(())?;
        let (from, to) = (from - 1.0, to + 1.0);
        let known = (END * (to - from)).max(LEAST_END);
        let mut on = [0, 1].map(|_| vec![false; known as usize]);
        let mut fits = [0.0; 2];
        for [along, aside] in self.near.iter().map(|at| line.place(*at)) {
            let (end, off) = if 2.0 * along < from + to { (0, from - along) } else { (1, along - to) };
            if (0.0..known).contains(&off) && aside.abs() <= 2.0 * STRAIGHT {
                fits[end] += 1.0 - (aside / (2.0 * STRAIGHT)).powi(2);
                let place = on[end].get_mut(off as usize).filter(|_| aside.abs() <= STRAIGHT);
                place.into_iter().for_each(|place| *place = true);
            }
        }
        let ends = on.map(|on| on.iter().filter(|on| **on).count() as f64 >= WHOLE * on.len() as f64);
        let line = Line { ends: [from, to].map(|at| line.ends[0] + line.along() * at), known, ..line };
        ends.contains(&true).then_some(Way { line, ends, fits })
    }
}

impl Edge {
    /// How far to the side the border is seen along a way of this length from a place on: where the colours to both sides differ most, at
    /// most so far; nothing where they do not.
    fn step(&self, texture: &Texture, at: DVec2, away: DVec2, length: f64, most: i64) -> Option<f64> {
        let [one, other] = self.between.map(|color| color.map(f64::from));
        let off: [f64; 3] = std::array::from_fn(|c| one[c] - other[c]);
        let square: f64 = off.iter().map(|v| v * v).sum();
        // One on this side of the border, 0 on the other.
        let value = |at: DVec2| -> Option<f64> {
            let i = source(texture, at)?;
            Some((0..3).map(|c| (f64::from(texture.rgb[i][c]) - other[c]) * off[c]).sum::<f64>() / square)
        };
        let across = |aside: i64| -> Option<f64> {
            let places = (0..length as usize).map(|i| at + away.perp() * aside as f64 + away * (i as f64 + 0.5));
            let known: Vec<f64> = places.filter_map(value).collect();
            (2 * known.len() > length as usize).then(|| known.iter().sum::<f64>() / known.len() as f64)
        };
        let profile: Vec<(i64, f64)> = (-most..=most).filter_map(|aside| Some((aside, across(aside)?))).collect();
        // The step of least squares.
        let split = |k: usize| {
            let mean = |part: &[(i64, f64)]| part.iter().map(|(_, v)| v).sum::<f64>() / part.len() as f64;
            let apart = (mean(&profile[..k]) - mean(&profile[k..])).abs();
            let weight = (k as f64 * (profile.len() - k) as f64).sqrt();
            (apart * weight, apart, 0.5 * (profile[k - 1].0 + profile[k].0) as f64)
        };
        let best = (1..profile.len()).map(split).max_by(|a, b| a.0.total_cmp(&b.0));
        best.filter(|(_, apart, _)| *apart >= SEEN).map(|(.., aside)| aside)
    }

    /// The line in a picture so many times as large, through where both its ends are seen.
    pub fn refined(&self, texture: &Texture, by: f64) -> Line {
        let most = (ASIDE * by).ceil() as i64;
        let middle = |line: &Line, end: usize| {
            let (at, away) = (line.ends[end], away(line, end));
            let aside = self.step(texture, at, away, line.known, most).unwrap_or(0.0);
            at + away.perp() * aside + away * 0.5 * line.known
        };
        // Again from there: of a line that was far to the side a part was beyond what is looked at.
        (0..AGAIN).fold(self.line.scaled(by), |line, _| {
            let [a, b] = [0, 1].map(|end| middle(&line, end));
            let back = (b - a).normalize() * 0.5 * line.known;
            Line { ends: [a + back, b - back], ..line }
        })
    }

    /// The line in a picture so many times as large, as its first end goes in: through where both halves of that are seen; nothing where it
    /// is not straight all along.
    fn going_in(&self, texture: &Texture, by: f64) -> Option<Line> {
        let most = (ASIDE * by).ceil() as i64;
        let mut line = self.line.scaled(by);
        let half = 0.5 * line.known;
        for _ in 0..AGAIN {
            let away = -line.along();
            let seen = |from: f64| -> Option<DVec2> {
                let at = line.ends[0] + away * from;
                let aside = self.step(texture, at, away, half, most)?;
                Some(at + away * 0.5 * half + away.perp() * aside)
            };
            let (near, far) = (seen(0.0)?, seen(half)?);
            let along = (near - far).normalize();
            let start = near + along * 0.5 * half;
            line = Line { ends: [start, start + along * line.length()], ..line };
        }
        let away = -line.along();
        let straight = |quarter: usize| {
            let at = line.ends[0] + away * 0.5 * half * quarter as f64;
            self.step(texture, at, away, 0.5 * half, most).is_some_and(|aside| aside.abs() <= BENT * by)
        };
        (0..4).all(straight).then_some(line)
    }

    /// The pieces that are copied along the line in a picture so many times as large.
    pub fn pieces(&self, line: &Line, by: f64) -> [Piece; 2] {
        [0, 1].map(|end| Piece::new(away(line, end), self.lengths[end] * by))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(x: usize, y: usize) -> f32 {
        ((x * 7919 + y * 104_729) * 2_654_435_761 % 1000) as f32 / 1000.0
    }

    /// A picture with a round hole in its middle.
    fn holed(size: [usize; 2], radius: f64, color: impl Fn(usize, usize) -> [f32; 3]) -> Texture {
        let [w, h] = size;
        let places = || (0..h).flat_map(|y| (0..w).map(move |x| (x, y)));
        let inside = |(x, y): (usize, usize)| {
            DVec2::new(x as f64, y as f64).distance(0.5 * DVec2::new(w as f64, h as f64)) < radius
        };
        let hole: Vec<bool> = places().map(inside).collect();
        Texture {
            size,
            rgb: places().map(|(x, y)| color(x, y)).collect(),
            source: hole.iter().map(|h| !h).collect(),
            hole,
        }
    }

    fn part(texture: &Texture) -> Vec<usize> {
        (0..texture.hole.len()).filter(|i| texture.hole[*i]).collect()
    }

    /// Leaves end at stone in an oblique line, which goes through the hole: it is found where it is, to half a pixel at four times the
    /// size, and nothing is copied across it.
    #[test]
    fn a_border_goes_through() {
        let line = |x: f64| 46.0 + 0.37 * (x - 60.0);
        let color = |by: f64| {
            move |x: usize, y: usize| {
                let stone = (y as f64 + 0.5) / by > line((x as f64 + 0.5) / by);
                let n = noise(x, y);
                if stone { [0.55 + 0.05 * n, 0.6, 0.7] } else { [0.15 + 0.1 * n, 0.3 + 0.1 * n, 0.15] }
            }
        };
        let small = holed([120, 90], 18.0, color(1.0));
        let hole = part(&small);
        let regions = Regions::around(&small, &hole, &looks(&small)).expect("two");
        assert!(regions.hold(&small, &hole, &small.source));
        let edges = regions.edges(&small, &hole);
        assert_eq!(edges.len(), 1);
        let large = holed([480, 360], 72.0, color(4.0));
        let found = edges[0].refined(&large, 4.0);
        for end in found.ends {
            assert!((end.y - 4.0 * line(end.x / 4.0)).abs() < 0.75, "{end}");
        }
        let (above, below) = (30 * 120 + 60, 60 * 120 + 60);
        assert!(regions.may(35 * 120 + 60, above) && !regions.may(35 * 120 + 60, below));
        assert!(regions.may(46 * 120 + 60, above) && regions.may(46 * 120 + 60, below));
    }

    /// A border that goes in on the left alone goes straight on.
    #[test]
    fn a_border_that_ends_goes_on() {
        let line = |x: f64| 44.0 - 0.4 * (x - 60.0);
        let color = |by: f64| {
            move |x: usize, y: usize| {
                let (x, y) = ((x as f64 + 0.5) / by, (y as f64 + 0.5) / by);
                let n = noise(x as usize, y as usize);
                if y > line(x) && x < 66.0 {
                    [0.55 + 0.05 * n, 0.6, 0.7]
                } else {
                    [0.15 + 0.1 * n, 0.3 + 0.1 * n, 0.15]
                }
            }
        };
        let small = holed([120, 90], 18.0, color(1.0));
        let hole = part(&small);
        let regions = Regions::around(&small, &hole, &looks(&small)).expect("two");
        let found = regions.ends(&small, &hole, &holed([480, 360], 72.0, color(4.0)), 4.0);
        let edge = found.iter().find(|line| line.ends[0].x < 200.0).expect("the edge");
        // Each half of what is seen of it is found to a pixel; what is farther away is off by as much more as it is farther from them.
        let off = edge.ends.map(|end| (end.y - 4.0 * line(end.x / 4.0)).abs());
        let most = 1.0 + 2.0 * (edge.length() + 0.25 * edge.known) / (0.5 * edge.known);
        assert!(off[0] < 2.0 && off[1] < most, "{off:?}, {most}");
        assert!(edge.ends[1].x > 280.0, "{:?}", edge.ends);
    }

    /// Tiles of two colours have many borders, and one that bends in the hole is no line.
    #[test]
    fn tiles_and_bends_are_left_alone() {
        let tiles = holed([120, 90], 18.0, |x, y| if (x / 12 + y / 12) % 2 == 0 { [0.2; 3] } else { [0.8; 3] });
        let hole = part(&tiles);
        assert!(Regions::around(&tiles, &hole, &looks(&tiles)).is_none_or(|regions| !regions.hold(
            &tiles,
            &hole,
            &tiles.source
        )));
        let bent = holed([120, 90], 18.0, |x, y| if y > 45 && x > 60 { [0.2, 0.4, 0.2] } else { [0.6, 0.6, 0.7] });
        let hole = part(&bent);
        assert!(Regions::around(&bent, &hole, &looks(&bent)).expect("two").edges(&bent, &hole).is_empty());
    }
}

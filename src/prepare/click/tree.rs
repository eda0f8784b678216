//! A picture as a tree of segments: what belongs together is joined first, so that the segments about a pixel are its
//! colour, the part, the thing, and what the thing stands among.
//!
//! Small segments of one colour (Felzenszwalb and Huttenlocher 2004) are joined pair by pair, the most alike first
//! (Uijlings et al. 2013): alike in colours, without an edge between them, the one about the other, small, and filling
//! the space they take up. What the picture's border cuts off is the surroundings of what lies within; the two are
//! joined last.

use std::collections::{BTreeMap, BinaryHeap};

use super::Pixels;
use crate::segments::segments;

/// Bins of a histogram of one channel.
const BINS: usize = 8;
/// The threshold of the first segments, in levels times pixels: larger ones bear more contrast within.
const COARSENESS: f32 = 60.0;
/// Pixels of a first segment at least.
const LEAST: usize = 12;
/// An edge of so many levels is certainly one.
const EDGE: f64 = 40.0;
/// What joining a segment that the picture's border cuts off to one that lies within counts against it.
const CUT_OFF: f64 = 1.0;
/// Segments about a pixel differ in area by this factor at least.
const STEP: f64 = 1.1;
/// The part of a first segment that lies within an outline if it is of what the outline is about.
const WITHIN: f64 = 0.8;
/// Such segments are at least this part of what is within.
const SOME: f64 = 0.15;

/// A segment.
#[derive(Clone)]
struct Segment {
    /// The segment that it is a part of.
    parent: Option<usize>,
    /// Pixels.
    area: usize,
    /// Length of its outline within the picture.
    outline: f64,
    /// Pixels at the picture's border.
    border: usize,
    colors: Vec<f32>,
    bounds: [usize; 4],
}

/// The tree: the first segments, then joined ones.
pub(super) struct Tree {
    segments: Vec<Segment>,
    /// The first segment of each pixel.
    leaf: Vec<usize>,
}

/// Pairs by their likeness.
#[derive(PartialEq)]
struct Pair(f64, usize, usize);
impl Eq for Pair {}
impl PartialOrd for Pair {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Pair {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then_with(|| (other.1, other.2).cmp(&(self.1, self.2)))
    }
}

impl Tree {
    /// The tree of these pixels, by their colours.
    pub fn of(pixels: &Pixels) -> Self {
        let [w, h] = pixels.size;
        let count = w * h;
        let mut pairs: Vec<(f64, usize, usize, f64)> =
            pixels.pairs().map(|(i, _, j, length)| (pixels.apart(i, j).0.sqrt(), i, j, length)).collect();
        pairs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let edges: Vec<_> = pairs.iter().map(|(weight, i, j, _)| (*weight as f32, *i, *j)).collect();
        let (leaf, first) = segments(count, &edges, COARSENESS, LEAST);
        let mut segments = vec![
            Segment {
                parent: None,
                area: 0,
                outline: 0.0,
                border: 0,
                colors: vec![0.0; 3 * BINS],
                bounds: [w, h, 0, 0]
            };
            first
        ];
        for i in 0..count {
            let (x, y) = (i % w, i / w);
            let segment = &mut segments[leaf[i]];
            segment.area += 1;
            segment.border += usize::from(pixels.is_border(i));
            let [x0, y0, x1, y1] = segment.bounds;
            segment.bounds = [x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1)];
            for c in 0..3 {
                segment.colors[c * BINS + (pixels.colors[i][c] as usize * BINS / 256).min(BINS - 1)] += 1.0;
            }
        }
        // Of neighbours: the length of what is between them, and the strengths of the edges along it.
        let mut between: Vec<BTreeMap<usize, [f64; 2]>> = vec![BTreeMap::new(); segments.len()];
        for &(weight, i, j, length) in &pairs {
            let (a, b) = (leaf[i], leaf[j]);
            if a == b {
                continue;
            }
            let part = [1.0 / length, (weight / EDGE).min(1.0) / length];
            for (a, b) in [(a, b), (b, a)] {
                let sum = between[a].entry(b).or_default();
                (0..2).for_each(|k| sum[k] += part[k]);
                segments[a].outline += part[0];
            }
        }
        let mut tree = Self { segments, leaf };
        let mut queue = BinaryHeap::new();
        for (a, near) in between.iter().enumerate() {
            for (&b, &edge) in near.range(a + 1..) {
                queue.push(Pair(tree.likeness(a, b, edge, count), a, b));
            }
        }
        while let Some(Pair(_, a, b)) = queue.pop() {
            if tree.segments[a].parent.is_some() || tree.segments[b].parent.is_some() {
                continue;
            }
            let new = tree.segments.len();
            let shared = between[a][&b][0];
            let (one, other) = (&tree.segments[a], &tree.segments[b]);
            let joined = Segment {
                parent: None,
                area: one.area + other.area,
                outline: one.outline + other.outline - 2.0 * shared,
                border: one.border + other.border,
                colors: one.colors.iter().zip(&other.colors).map(|(a, b)| a + b).collect(),
                bounds: {
                    let ([a0, b0, a1, b1], [c0, d0, c1, d1]) = (one.bounds, other.bounds);
                    [a0.min(c0), b0.min(d0), a1.max(c1), b1.max(d1)]
                },
            };
            tree.segments.push(joined);
            (tree.segments[a].parent, tree.segments[b].parent) = (Some(new), Some(new));
            let mut near = std::mem::take(&mut between[a]);
            for (c, edge) in std::mem::take(&mut between[b]) {
                let sum = near.entry(c).or_default();
                (0..2).for_each(|k| sum[k] += edge[k]);
            }
            near.retain(|c, _| *c != a && *c != b);
            for (&c, &edge) in &near {
                between[c].remove(&a);
                between[c].remove(&b);
                between[c].insert(new, edge);
                queue.push(Pair(tree.likeness(c, new, edge, count), c, new));
            }
            between.push(near);
        }
        tree
    }

    /// How alike two neighbours are.
    fn likeness(&self, a: usize, b: usize, edge: [f64; 2], count: usize) -> f64 {
        let (one, other) = (&self.segments[a], &self.segments[b]);
        let part = |s: &Segment, k: usize| f64::from(s.colors[k]) / (3.0 * s.area as f64);
        let colors: f64 = (0..3 * BINS).map(|k| part(one, k).min(part(other, k))).sum();
        let all = (one.area + other.area) as f64;
        let [x0, y0, x1, y1] = {
            let ([a0, b0, a1, b1], [c0, d0, c1, d1]) = (one.bounds, other.bounds);
            [a0.min(c0), b0.min(d0), a1.max(c1), b1.max(d1)]
        };
        let space = ((x1 - x0) * (y1 - y0)) as f64;
        let enclosed = edge[0] / one.outline.min(other.outline).max(1.0);
        let cut_off = (one.border > 0) != (other.border > 0);
        colors
            + (1.0 - all / count as f64)
            + (1.0 - (space - all) / count as f64)
            + (1.0 - edge[1] / edge[0])
            + enclosed
            - if cut_off { CUT_OFF } else { 0.0 }
    }

    /// The segments about a pixel, the smallest first.
    fn chain(&self, pixel: usize) -> impl Iterator<Item = usize> {
        std::iter::successors(Some(self.leaf[pixel]), |s| self.segments[*s].parent)
    }

    /// The segments about a pixel between which there is a step in size, the smallest first.
    fn levels(&self, pixel: usize) -> Vec<usize> {
        let area = |s: usize| self.segments[s].area as f64;
        let grows = |s: &usize| self.segments[*s].parent.is_some_and(|parent| area(parent) >= STEP * area(*s));
        self.chain(pixel).filter(grows).collect()
    }

    /// Of the segments about a click on the object that hold no click beside it, the one most like what the click takes by
    /// itself, `own`, or one so many steps larger. Nothing where both kinds of clicks lie in one segment of the smallest.
    pub fn about(&self, pixels: &Pixels, click: usize, steps: i32, own: impl Fn(usize) -> bool) -> Option<Vec<bool>> {
        let mut barred = vec![false; self.segments.len()];
        let others = (0..self.leaf.len()).filter(|i| pixels.touched[*i] == Some(false));
        others.flat_map(|i| self.chain(i)).for_each(|segment| barred[segment] = true);
        let levels: Vec<usize> = self.levels(click).into_iter().filter(|s| !barred[*s]).collect();
        let all = (0..self.leaf.len()).filter(|i| own(*i)).count();
        let likeness = |s: &usize| {
            let both = self.pixels(*s).iter().enumerate().filter(|(i, on)| **on && own(*i)).count();
            both as f64 / (all + self.segments[*s].area - both) as f64
        };
        let likenesses: Vec<f64> = levels.iter().map(likeness).collect();
        let most = (0..levels.len()).max_by(|a, b| likenesses[*a].total_cmp(&likenesses[*b]))?;
        let taken = (most as i64 + i64::from(steps)).clamp(0, levels.len() as i64 - 1);
        Some(self.pixels(levels[taken as usize]))
    }

    /// The first segments of which hardly anything lies beyond an outline; nothing where those are next to nothing.
    pub fn within(&self, inside: impl Fn(usize) -> bool) -> Option<Vec<bool>> {
        let mut counts = vec![[0usize; 2]; self.segments.len()];
        (0..self.leaf.len()).for_each(|i| counts[self.leaf[i]][usize::from(inside(i))] += 1);
        let own: Vec<bool> = self
            .leaf
            .iter()
            .enumerate()
            .map(|(i, leaf)| {
                inside(i) && counts[*leaf][1] as f64 >= WITHIN * (counts[*leaf][0] + counts[*leaf][1]) as f64
            })
            .collect();
        let (taken, all) = (own.iter().filter(|v| **v).count(), counts.iter().map(|c| c[1]).sum::<usize>());
        (taken as f64 >= SOME * all as f64).then_some(own)
    }

    /// The pixels of a segment.
    fn pixels(&self, segment: usize) -> Vec<bool> {
        let mut taken = vec![false; self.segments.len()];
        taken[segment] = true;
        for s in (0..segment).rev() {
            taken[s] = self.segments[s].parent.is_some_and(|parent| taken[parent]);
        }
        self.leaf.iter().map(|leaf| taken[*leaf]).collect()
    }
}

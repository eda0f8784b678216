//! Filling a hole from what is around it: PatchMatch (Barnes et al. 2009) in the multi-scale loop of Wexler et al. 2007.
//!
//! Every patch that touches the hole looks for the most similar patch that lies wholly outside; the patches found then
//! vote on the hole's colours, and so on, from a small picture to the full size. A guide, such as disparity, takes part in
//! the comparison: patches are then taken from the same side of its edges. Every random number comes from one seed and
//! pixels are visited in a fixed order, so that the same picture is filled the same way.

use rand::RngExt;
use rand_pcg::Pcg64;
use rayon::prelude::*;

/// Patches are 2 `RADIUS` + 1 pixels wide.
const RADIUS: usize = 3;
/// Rounds of search and vote per scale.
const ROUNDS: u32 = 5;
/// By how much less a patch counts for each pixel that it lies farther in the hole (Wexler et al.).
const INWARDS: f32 = 1.2;
/// Blur of the last vote: the best patches alone, as the mean of many is smooth where the surroundings are not.
const SHARP: f32 = 0.1;
/// Fillings that are tried; the one whose patches are most like others is taken.
const TRIES: u64 = 3;
/// A side of the smallest picture that is worked on, pixels.
const SMALLEST: usize = 24;

/// A picture with a hole.
#[derive(Clone, Debug)]
pub struct Canvas {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// `[pixel]` RGB, 0 to 1; of the hole's anything.
    pub rgb: Vec<[f32; 3]>,
    /// `[pixel]` compared along with the colours, known everywhere; 0 to 1, or all 0 for no guide.
    pub guide: Vec<f32>,
    /// `[pixel]` the surface it is of: patches are taken from the same one.
    pub surface: Vec<u8>,
    /// `[pixel]` whether it is to be filled.
    pub hole: Vec<bool>,
    /// `[pixel]` whether its colour may be copied. What is in the hole never is.
    pub source: Vec<bool>,
}

impl Canvas {
    fn at(&self, x: usize, y: usize) -> usize {
        y * self.size[0] + x
    }

    /// Half the size; a pixel is hole if more than half of what it covers is.
    fn half(&self) -> Self {
        let size = self.size.map(|n| n.div_ceil(2));
        let n = size[0] * size[1];
        let mut out = Self {
            size,
            rgb: Vec::with_capacity(n),
            guide: Vec::with_capacity(n),
            surface: Vec::with_capacity(n),
            hole: Vec::with_capacity(n),
            source: Vec::with_capacity(n),
        };
        for y in 0..size[1] {
            for x in 0..size[0] {
                let children: Vec<usize> = (2 * y..(2 * y + 2).min(self.size[1]))
                    .flat_map(|v| (2 * x..(2 * x + 2).min(self.size[0])).map(move |u| (u, v)))
                    .map(|(u, v)| self.at(u, v))
                    .collect();
                let known: Vec<usize> = children.iter().copied().filter(|i| !self.hole[*i]).collect();
                let hole = 2 * known.len() < children.len();
                let of = if hole { &children } else { &known };
                let count = of.len() as f32;
                out.rgb.push(std::array::from_fn(|c| of.iter().map(|i| self.rgb[*i][c]).sum::<f32>() / count));
                out.guide.push(children.iter().map(|i| self.guide[*i]).sum::<f32>() / children.len() as f32);
                out.surface.push(self.surface[children[0]]);
                out.hole.push(hole);
                out.source.push(!hole && known.iter().all(|i| self.source[*i]));
            }
        }
        out
    }

    /// Steps of eight neighbours from what is known, up to 40.
    fn steps_inwards(&self) -> Vec<u32> {
        let [w, h] = self.size;
        let mut steps: Vec<u32> = self.hole.iter().map(|hole| if *hole { 40 } else { 0 }).collect();
        // Forwards, then backwards: exact for this metric.
        for i in (0..w * h).chain((0..w * h).rev()) {
            let (x, y) = (i % w, i / w);
            let rows = y.saturating_sub(1)..(y + 2).min(h);
            let least = rows.flat_map(|v| (x.saturating_sub(1)..(x + 2).min(w)).map(move |u| v * w + u));
            let least = least.map(|j| steps[j] + 1).min().unwrap_or(40);
            steps[i] = steps[i].min(least);
        }
        steps
    }

    /// Fills the hole from its border inwards with means of what is known: something to begin with.
    fn peel(&mut self) {
        let [w, h] = self.size;
        let mut left: Vec<usize> = (0..w * h).filter(|i| self.hole[*i]).collect();
        let mut known: Vec<bool> = self.hole.iter().map(|hole| !hole).collect();
        while !left.is_empty() {
            let mut ring = vec![];
            for &i in &left {
                let (x, y) = (i % w, i / w);
                let around = (y.saturating_sub(1)..(y + 2).min(h))
                    .flat_map(|v| (x.saturating_sub(1)..(x + 2).min(w)).map(move |u| v * w + u));
                let around: Vec<usize> = around.filter(|j| known[*j]).collect();
                if !around.is_empty() {
                    let mean = |c: usize| around.iter().map(|j| self.rgb[*j][c]).sum::<f32>() / around.len() as f32;
                    ring.push((i, std::array::from_fn(mean)));
                }
            }
            if ring.is_empty() {
                // A picture that is all hole.
                return;
            }
            for (i, color) in ring {
                self.rgb[i] = color;
                known[i] = true;
            }
            left.retain(|i| !known[*i]);
        }
    }
}

/// The search on one scale: for each target patch (by its middle) the middle of the most similar source patch.
struct Search<'a> {
    canvas: &'a Canvas,
    targets: &'a [usize],
    is_source: &'a [bool],
}

/// Weight of the guide beside the three colours.
const GUIDE: f32 = 6.0;
/// What a pixel of another surface counts: about as much as the largest difference between two things in the sun.
const OTHER: f32 = 0.5;

impl Search<'_> {
    /// Sum of squared differences of two patches over the pixels that both have, given up beyond `limit`.
    fn distance(&self, target: usize, source: usize, limit: f32) -> f32 {
        let [w, h] = self.canvas.size;
        let (tx, ty, sx, sy) = (target % w, target / w, source % w, source / w);
        let (mut sum, mut count) = (0.0f32, 0u32);
        for dy in 0..=2 * RADIUS {
            let (Some(y), v) = ((ty + dy).checked_sub(RADIUS), sy + dy - RADIUS) else { continue };
            if y >= h {
                continue;
            }
            for dx in 0..=2 * RADIUS {
                let (Some(x), u) = ((tx + dx).checked_sub(RADIUS), sx + dx - RADIUS) else { continue };
                if x >= w {
                    continue;
                }
                let (t, s) = (y * w + x, v * w + u);
                let (a, b) = (self.canvas.rgb[t], self.canvas.rgb[s]);
                // What is known counts more than what is itself filled.
                let weight = if self.canvas.hole[t] { 1.0 } else { 2.0 };
                let guide = self.canvas.guide[t] - self.canvas.guide[s];
                let color: f32 = (0..3).map(|c| (a[c] - b[c]) * (a[c] - b[c])).sum();
                let other = if self.canvas.surface[t] == self.canvas.surface[s] { 0.0 } else { OTHER };
                sum += weight * (color + GUIDE * guide * guide + other);
                count += 1;
            }
            if sum > limit * (4 * RADIUS * RADIUS) as f32 {
                return f32::INFINITY;
            }
        }
        sum / count as f32
    }

    /// Takes a candidate (column, row) for the target where it is better.
    fn consider(&self, target: usize, best: &mut (usize, f32), [x, y]: [isize; 2]) {
        let [w, h] = self.canvas.size;
        if x < 0 || y < 0 || x >= w as isize || y >= h as isize {
            return;
        }
        let source = y as usize * w + x as usize;
        if self.is_source[source] && source != best.0 {
            let distance = self.distance(target, source, best.1);
            if distance < best.1 {
                *best = (source, distance);
            }
        }
    }

    /// Improves the matches: from the neighbours' and by guesses ever closer around the best. `of` is the number of the
    /// target at each pixel.
    fn improve(&self, matches: &mut [(usize, f32)], of: &[usize], round: u32, rng: &mut Pcg64) {
        let [w, h] = self.canvas.size;
        let forward = round.is_multiple_of(2);
        let back = if forward { -1isize } else { 1 };
        for step in 0..self.targets.len() {
            let n = if forward { step } else { self.targets.len() - 1 - step };
            let target = self.targets[n];
            let position = [(target % w) as isize, (target / w) as isize];
            let mut best = matches[n];
            for shift in [[back, 0], [0, back]] {
                let [u, v] = [position[0] + shift[0], position[1] + shift[1]];
                if u < 0 || v < 0 || u >= w as isize || v >= h as isize {
                    continue;
                }
                let neighbour = of[v as usize * w + u as usize];
                if neighbour != usize::MAX {
                    let found = matches[neighbour].0;
                    let [x, y] = [(found % w) as isize, (found / w) as isize];
                    self.consider(target, &mut best, [x - shift[0], y - shift[1]]);
                }
            }
            let mut reach = w.max(h) as isize;
            while reach >= 1 {
                let [x, y] = [(best.0 % w) as isize, (best.0 / w) as isize];
                let mut near = || rng.random_range(-(reach as i64)..=reach as i64) as isize;
                let guess = [x + near(), y + near()];
                self.consider(target, &mut best, guess);
                reach /= 2;
            }
            matches[n] = best;
        }
    }
}

/// The pixels of the patch around `middle` that lie in the picture, with their shift.
fn patch(size: [usize; 2], middle: usize) -> impl Iterator<Item = (usize, [isize; 2])> {
    let [w, h] = size.map(|n| n as isize);
    let (x, y) = (middle as isize % w, middle as isize / w);
    let reach = RADIUS as isize;
    (-reach..=reach)
        .flat_map(move |dy| (-reach..=reach).map(move |dx| (x + dx, y + dy, [dx, dy])))
        .filter(move |(u, v, _)| *u >= 0 && *v >= 0 && *u < w && *v < h)
        .map(move |(u, v, shift)| ((v * w + u) as usize, shift))
}

/// Rounds of search and vote on one scale. `guess` holds for each pixel the source pixel it was made from on the scale
/// before; the last vote is `sharp` on the largest scale. Returns the same of this scale, and how much the patches differ from what they were made from; nothing where no
/// patch can be copied from.
fn refine(canvas: &mut Canvas, guess: Option<&[usize]>, sharp: bool, rng: &mut Pcg64) -> Option<(Vec<usize>, f32)> {
    let size @ [w, h] = canvas.size;
    let whole = |i: usize| {
        let (x, y) = (i % w, i / w);
        let inside = x >= RADIUS && y >= RADIUS && x + RADIUS < w && y + RADIUS < h;
        inside && patch(size, i).all(|(j, _)| canvas.source[j])
    };
    let is_source: Vec<bool> = (0..w * h).map(whole).collect();
    let sources: Vec<usize> = (0..w * h).filter(|i| is_source[*i]).collect();
    if sources.is_empty() {
        return None;
    }
    let targets: Vec<usize> = (0..w * h).filter(|i| patch(size, *i).any(|(j, _)| canvas.hole[j])).collect();
    let mut of = vec![usize::MAX; w * h];
    targets.iter().enumerate().for_each(|(n, target)| of[*target] = n);
    let mut matches: Vec<(usize, f32)> = targets
        .iter()
        .map(|target| {
            let guessed = guess.map(|guess| guess[*target]).filter(|i| *i != usize::MAX && is_source[*i]);
            (guessed.unwrap_or_else(|| sources[rng.random_range(0..sources.len())]), f32::INFINITY)
        })
        .collect();
    let inwards = canvas.steps_inwards();
    // On a small picture, where what goes where is decided, a round costs next to nothing.
    let rounds = if targets.len() < 2000 { 4 * ROUNDS } else { ROUNDS };
    for round in 0..rounds {
        let search = Search { canvas, targets: &targets, is_source: &is_source };
        // The colours have changed since the last round, and the distances with them.
        for (target, found) in targets.iter().zip(&mut matches) {
            found.1 = search.distance(*target, found.0, f32::INFINITY);
        }
        search.improve(&mut matches, &of, 2 * round, rng);
        search.improve(&mut matches, &of, 2 * round + 1, rng);
        vote(canvas, &targets, &matches, &inwards, if sharp && round + 1 == rounds { SHARP } else { 1.0 });
    }
    let mut map = vec![usize::MAX; w * h];
    for (target, found) in targets.iter().zip(&matches) {
        map[*target] = found.0;
    }
    let off = matches.iter().map(|(_, distance)| distance).sum::<f32>() / matches.len() as f32;
    Some((map, off))
}

/// Every pixel of the hole becomes the mean of what the patches over it say, the similar ones first and those at the
/// hole's border, which see what is known. `inwards` counts the steps from there; the less `blur`, the less others count
/// beside the most similar patch.
fn vote(canvas: &mut Canvas, targets: &[usize], matches: &[(usize, f32)], inwards: &[u32], blur: f32) {
    let size = canvas.size;
    let mut distances: Vec<f32> = matches.iter().map(|(_, distance)| *distance).collect();
    distances.sort_unstable_by(f32::total_cmp);
    let typical = blur * distances[distances.len() * 3 / 4].max(1e-6);
    let mut sums = vec![[0f32; 4]; canvas.rgb.len()];
    for (target, (source, distance)) in targets.iter().zip(matches) {
        let weight = (-distance / (2.0 * typical)).exp() * INWARDS.powi(-(inwards[*target] as i32));
        for (pixel, [dx, dy]) in patch(size, *target) {
            if canvas.hole[pixel] {
                // The whole patch around a source is in the picture.
                let from = (*source as isize + dy * size[0] as isize + dx) as usize;
                let color = canvas.rgb[from];
                (0..3).for_each(|c| sums[pixel][c] += weight * color[c]);
                sums[pixel][3] += weight;
            }
        }
    }
    for (pixel, sum) in sums.iter().enumerate().filter(|(_, sum)| sum[3] > 0.0) {
        canvas.rgb[pixel] = std::array::from_fn(|c| sum[c] / sum[3]);
    }
}

/// Fills the hole. Where nothing can be copied from, it holds the means of what is around it.
pub fn fill(canvas: &mut Canvas, seed: u64) {
    if !canvas.hole.iter().any(|hole| *hole) {
        return;
    }
    let mut scales = vec![canvas.clone()];
    while let Some(last) = scales.last() {
        let smaller = last.half();
        if smaller.size.into_iter().min().unwrap_or(0) < SMALLEST || !smaller.hole.iter().any(|hole| *hole) {
            break;
        }
        scales.push(smaller);
    }
    scales.reverse();
    let tries: Vec<(Vec<[f32; 3]>, f32)> = (0..TRIES)
        .into_par_iter()
        .map(|attempt| ascend(scales.clone(), &mut Pcg64::new(seed.into(), (21 + attempt).into())))
        .collect();
    let best = tries.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
    for (i, color) in best.into_iter().flat_map(|(rgb, _)| rgb).enumerate() {
        if canvas.hole[i] {
            canvas.rgb[i] = color;
        }
    }
}

/// For each pixel the middle of its source patch, and how much the patches differ on the whole.
type Matches = (Vec<usize>, f32);

/// From the smallest scale, the first, to the largest; its colours, and how much its patches differ from their sources.
fn ascend(scales: Vec<Canvas>, rng: &mut Pcg64) -> (Vec<[f32; 3]>, f32) {
    let mut coarser: Option<(Canvas, Option<Matches>)> = None;
    let largest = scales.len();
    for (n, mut scale) in (1..).zip(scales) {
        let [w, h] = scale.size;
        let mut guess = None;
        match &coarser {
            Some((small, found)) => {
                let below = |x: usize, y: usize| (y / 2) * small.size[0] + x / 2;
                for i in (0..w * h).filter(|i| scale.hole[*i]) {
                    scale.rgb[i] = small.rgb[below(i % w, i / w)];
                }
                guess = found.as_ref().map(|(map, _)| {
                    let up = |i: usize| {
                        let (x, y) = (i % w, i / w);
                        let from = map[below(x, y)];
                        if from == usize::MAX {
                            return usize::MAX;
                        }
                        let [u, v] = [2 * (from % small.size[0]) + x % 2, 2 * (from / small.size[0]) + y % 2];
                        if u < w && v < h { v * w + u } else { usize::MAX }
                    };
                    (0..w * h).map(up).collect::<Vec<_>>()
                });
            }
            None => scale.peel(),
        }
        let found = refine(&mut scale, guess.as_deref(), n == largest, rng);
        coarser = Some((scale, found));
    }
    coarser.map_or((vec![], 0.0), |(scale, found)| (scale.rgb, found.map_or(f32::INFINITY, |(_, off)| off)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn canvas(
        size: [usize; 2],
        color: impl Fn(usize, usize) -> [f32; 3],
        hole: impl Fn(usize, usize) -> bool,
    ) -> Canvas {
        let [w, h] = size;
        let hole: Vec<bool> = (0..w * h).map(|i| hole(i % w, i / w)).collect();
        Canvas {
            size,
            rgb: (0..w * h).map(|i| if hole[i] { [9.0; 3] } else { color(i % w, i / w) }).collect(),
            guide: vec![0.0; w * h],
            surface: vec![0; w * h],
            source: hole.iter().map(|hole| !hole).collect(),
            hole,
        }
    }

    /// Stripes of period 8 are continued: the patches around the hole fix their phase.
    #[test]
    fn stripes_go_on() {
        let stripes = |x: usize, _| [if x % 8 < 4 { 0.9 } else { 0.1 }; 3];
        let hole = |x: usize, y: usize| (40..60).contains(&x) && (20..44).contains(&y);
        let mut filled = canvas([96, 64], stripes, hole);
        fill(&mut filled, 3);
        let errors =
            (0..96 * 64).filter(|i| hole(i % 96, i / 96)).map(|i| (filled.rgb[i][0] - stripes(i % 96, 0)[0]).abs());
        let mean = errors.sum::<f32>() / (20.0 * 24.0);
        // A hole filled with the mean would be 0.4 off.
        assert!(mean < 0.02, "{mean}");
        let mut again = canvas([96, 64], stripes, hole);
        fill(&mut again, 3);
        assert_eq!(filled.rgb, again.rgb, "the same seed fills the same way");
    }

    #[test]
    fn one_colour_stays() {
        let mut filled = canvas([50, 40], |_, _| [0.25, 0.5, 0.75], |x, y| x > 30 && y > 20);
        fill(&mut filled, 0);
        assert!(filled.rgb.iter().all(|c| c.iter().zip([0.25, 0.5, 0.75]).all(|(a, b)| (a - b).abs() < 1e-5)));
    }

    /// Left of the guide's edge everything is dark, right of it bright; the hole lies across.
    #[test]
    fn the_guide_says_where_the_edge_is() {
        let bright = |x: usize, _: usize| [if x < 45 { 0.1 } else { 0.9 }; 3];
        let hole = |x: usize, y: usize| (30..60).contains(&x) && (16..48).contains(&y);
        let mut filled = canvas([96, 64], bright, hole);
        filled.guide = (0..96 * 64).map(|i| if i % 96 < 45 { 0.0 } else { 1.0 }).collect();
        fill(&mut filled, 1);
        // The pixel columns at the edge may be blurred by the vote.
        let wrong = (0..96 * 64).filter(|i| hole(i % 96, i / 96) && !(43..47).contains(&(i % 96)));
        let wrong = wrong.filter(|i| (filled.rgb[*i][0] - bright(i % 96, 0)[0]).abs() > 0.2).count();
        assert_eq!(wrong, 0);
    }

    #[test]
    fn nothing_to_copy_from_is_no_fault() {
        let mut all = canvas([30, 30], |_, _| [0.5; 3], |_, _| true);
        fill(&mut all, 0);
        // A frame too narrow for a patch: its mean goes inwards.
        let mut frame = canvas([30, 30], |_, _| [0.5; 3], |x, y| (1..29).contains(&x) && (1..29).contains(&y));
        fill(&mut frame, 0);
        assert!(frame.rgb.iter().all(|c| (c[0] - 0.5).abs() < 1e-5));
    }
}

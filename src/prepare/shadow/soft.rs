//! The soft shadow around the object's foot, which no light from one side explains.
//!
//! On the surface from above the light falls off smoothly, and a soft shadow is a smooth dip in it around the foot. Lines of
//! the surface, such as joints, are closed by morphological closing of its brightness, which leaves the dip as it is; a
//! polynomial of the brightness around is the light without the object; their difference is what the shadow takes, cell by
//! cell. The surface keeps its texture when that is given back.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};

use image::GrayImage;
use rayon::prelude::*;

use super::Ground;
use super::detect::{Shadow, closed, low};
use super::mixture::{Color, channels, color};
use crate::prepare::planes::neighbours;
use crate::scene::resample;
use crate::statistics::median;

/// Gaps of this share of the object's height are closed in its foot.
const GAPS: f64 = 0.12;
/// The shadow reaches at most so many times the object's size, the larger one of its foot's width and [`TALL`] of its height; one
/// that does not end there is looked for as far as the second of them.
const REACH: [f64; 2] = [1.0, 1.5];
const TALL: f64 = 0.6;
/// The light is fitted on what lies so many times as far away.
const AROUND: f64 = 2.0;
/// Half the width of a line of the surface, at most, as a part of the object's size.
const LINE: f64 = 0.08;
/// Deviation of the mean that smoothes what is left of noise, as the same part.
const SMOOTH: f64 = 0.015;
/// Radius of the median that takes single cells of noise away, cells.
const NOISE: isize = 2;
/// Differences of channels that one surface has at most from its own median: its hue.
const HUE: f64 = 0.1;
/// Logarithm of the brightness by which the shadow's middle is darker than the light, at least; its border; and where it ends.
const DARK: f64 = -0.06;
const BORDER: f64 = -0.035;
const END: f64 = -0.008;
/// Away from the foot it gets darker again by this much at most.
const REBOUND: f64 = 0.04;
/// Largest deviation of the surface from smooth light (median of absolute values) for a shadow to be told on it.
const ROUGH: f64 = 0.05;
/// The least part that is seen of what is around the foot, half as far as the shadow reaches.
const SEEN: f64 = 0.4;
/// The dark part covers at least this part of the square of the object's size, and all of the shadow at most so much.
const LEAST: f64 = 0.03;
const MOST: f64 = 2.5;
/// The dark part is at least this part of the shadow.
const CORE: f64 = 0.15;
/// A shadow ends: of what is known where the farthest one would end at most this part is dark.
const OPEN: f64 = 0.2;
/// Least cells there, as a part of the square of the object's size.
const LEAST_RING: f64 = 0.1;
/// From its border the shadow fades within this part of the object's size.
const FADE: f64 = 0.3;
/// Where it takes more than this, a logarithm, too little is left to give back, and within this part of the object's size beside
/// the foot, where it mirrors the object.
const MUCH: f64 = 0.3;
const CONTACT: f64 = 0.1;
/// Most of the differences of channels that it takes for each of the brightness.
const TINT: f64 = 0.4;
/// A surface leaves at least so much of the light in its shadow.
const LEFT: f64 = 0.2;

/// A shadow that is longer than what was looked at.
const OPEN_ENDED: &str = "what is darker around its foot does not end";

/// Looks for it; a clause that says why there is none otherwise.
///
/// # Errors
/// There is none.
pub fn find(ground: &Ground<'_>) -> Result<Shadow, String> {
    let found = within(ground, REACH[0]);
    if found.as_ref().is_err_and(|why| why == OPEN_ENDED) { within(ground, REACH[1]) } else { found }
}

/// [`find`] within so many times the object's size.
fn within(ground: &Ground<'_>, times: f64) -> Result<Shadow, String> {
    let no = |why: &str| why.to_owned();
    let side = ground.side;
    let foot = closed(&low(ground), side, GAPS * ground.height + 2.0);
    let width = width(&foot, side).ok_or_else(|| no("nothing of it is near the surface"))?;
    let size = width.max(TALL * ground.height);
    let reach = (times * size).ceil() as u32;
    let far = (AROUND * f64::from(reach)).ceil() as u32;
    let away = distances(&foot, side, far);
    let colors: Vec<Color> = ground.log.iter().map(|log| color(*log)).collect();
    let shown: Vec<bool> = (0..foot.len()).map(|i| ground.log[i][0].is_finite()).collect();
    let Surface { same, other } = Surface::of(&colors, &shown, &away, [reach, (LINE * size).round() as u32], side)
        .ok_or_else(|| no("too little of the surface around it is seen"))?;
    let fitted: Vec<usize> = (0..foot.len()).filter(|i| same[*i] && !foot[*i] && away[*i] <= far).collect();
    let light = Light::fit(&fitted, side, |i| colors[i][0]).ok_or_else(|| no("too little of the surface is seen"))?;
    log::debug!("shadow: soft: a foot {width:.0} cells wide, size {size:.0}, rough by {:.3}", light.rough);
    if light.rough > ROUGH {
        return Err(no("the surface is too rough to tell its light"));
    }
    let near = |i: &usize| away[*i] > 0 && 2 * away[*i] <= reach;
    let around =
        (0..foot.len()).filter(near).fold([0.0, 0.0], |[own, all], i| [own + f64::from(u8::from(same[i])), all + 1.0]);
    log::debug!("shadow: soft: {:.2} of what is around the foot is seen", around[0] / around[1]);
    if around[0] < SEEN * around[1] {
        return Err(no("too little of the surface around it is seen"));
    }
    let off = differences(&foot, &same, side, size, &|i| colors[i][0] - light.at(i));
    let middle = median(fitted.iter().map(|i| off[*i])).unwrap_or(0.0);
    let off: Vec<f64> = off.into_iter().map(|v| v - middle).collect();
    // From the foot outwards, through what is darker; what nobody sees is passed.
    let feet = (0..foot.len()).filter(|i| foot[*i]);
    let mut region =
        reached(feet.map(|i| (i, f64::NEG_INFINITY)), side, |i| !foot[i] && away[i] <= reach && off[i] < BORDER, &off);
    region.iter_mut().zip(&foot).for_each(|(region, foot)| *region &= !foot);
    let count = |wanted: &dyn Fn(usize) -> bool| (0..foot.len()).filter(|i| wanted(*i)).count() as f64;
    let area = count(&|i| region[i] && same[i]);
    let is_core = |i: usize| region[i] && same[i] && off[i] < DARK;
    let core = count(&is_core);
    let ring = |i: usize| same[i] && away[i] <= reach && f64::from(away[i]) > 0.9 * f64::from(reach);
    let (all, at_end) = (count(&ring), count(&|i| ring(i) && region[i]));
    log::debug!("shadow: soft: {area} cells, {core} of them dark, {at_end} of {all} at the end of what is looked at");
    if core < LEAST * size * size || core < CORE * area {
        return Err(no("what is around its foot is not darker than the surface"));
    }
    if area > MOST * size * size || all < LEAST_RING * size * size || at_end > OPEN * all {
        return Err(no(OPEN_ENDED));
    }
    let mut amounts = faded(&off, &region, &foot, side, (FADE * size).ceil() as u32);
    // What nobody sees is passed, and nothing is given back there: behind the end of a desk stands a wall.
    let rim = (LINE * size).round() as u32;
    let seen = distances(&same, side, rim);
    let is_it = |i: usize| !other[i] && seen[i] <= rim;
    amounts.iter_mut().enumerate().filter(|(i, _)| !is_it(*i)).for_each(|(_, amount)| *amount = 0.0);
    let most = amounts.iter().copied().fold(0.0, f64::max);
    if (-most).exp() < LEFT {
        return Err(no("what is darker around its foot is no shadow by its ratio"));
    }
    let tint = tint(&colors, &amounts, [&is_core, &|i| ring(i) && amounts[i] == 0.0]);
    let ratio = channels([most, most * tint[0], most * tint[1]]).map(|taken| (-taken).exp());
    let expected = colors.iter().zip(&amounts).map(|(color, amount)| (color[0] + amount) as f32).collect();
    let lit = (0..foot.len()).map(|i| same[i] && amounts[i] == 0.0 && away[i] <= far).collect();
    let band = (CONTACT * size).round() as u32;
    let contact = (0..foot.len()).map(|i| amounts[i] > MUCH || away[i] <= band).collect();
    let amount = amounts.into_iter().map(|v| (v / most) as f32).collect();
    Ok(Shadow { ratio, amount, region, lit, expected, alike: 1.0, contact })
}

/// The larger side of the box around a mask, cells; nothing of an empty one.
fn width(mask: &[bool], side: usize) -> Option<f64> {
    let range = |of: &dyn Fn(usize) -> usize| {
        let places = (0..mask.len()).filter(|i| mask[*i]).map(of);
        let ends = places.fold(None, |ends: Option<(usize, usize)>, at| {
            Some(ends.map_or((at, at), |(low, high)| (low.min(at), high.max(at))))
        });
        ends.map(|(low, high)| (high + 1 - low) as f64)
    };
    Some(range(&|i| i % side)?.max(range(&|i| i / side)?))
}

/// Distance of each cell from those of a mask, rounded up; `reach + 1` where none is as near as `reach`.
fn distances(mask: &[bool], side: usize, reach: u32) -> Vec<u32> {
    let bytes = mask.iter().map(|on| if *on { 255 } else { 0 }).collect();
    let picture = GrayImage::from_raw(side as u32, side as u32, bytes).expect("a value per cell");
    resample::distances(&picture, reach)
}

/// The surface that the object stands on, by its hue.
struct Surface {
    /// `[cell]` those of the hue that most around the foot have. Beside those of another hue, and beside what nobody sees,
    /// colours are mixed: none there.
    same: Vec<bool>,
    /// `[cell]` those of another hue.
    other: Vec<bool>,
}

impl Surface {
    /// The surface around a foot, from which cells are so far `away`; what is farther than `reach` does not say what its hue is.
    /// Colours are mixed within `rim`.
    fn of(colors: &[Color], shown: &[bool], away: &[u32], [reach, rim]: [u32; 2], side: usize) -> Option<Self> {
        let near: Vec<usize> = (0..shown.len()).filter(|i| shown[*i] && away[*i] > 0 && away[*i] <= reach).collect();
        if near.len() < 200 {
            return None;
        }
        let cell = |[_, u, v]: Color| [u, v].map(|hue| (hue / (0.5 * HUE)).round() as i64);
        let mut counts: BTreeMap<[i64; 2], u32> = BTreeMap::new();
        for i in &near {
            *counts.entry(cell(colors[*i])).or_default() += 1;
        }
        let around = |[a, b]: [i64; 2]| -> u32 {
            let cells = (-1..=1).flat_map(|da| (-1..=1).map(move |db| [a + da, b + db]));
            cells.filter_map(|cell| counts.get(&cell)).sum()
        };
        let mode = counts.keys().copied().max_by_key(|cell| around(*cell))?;
        let mut hue = mode.map(|hue| hue as f64 * 0.5 * HUE);
        let is = |[_, u, v]: Color, hue: [f64; 2]| (u - hue[0]).abs() <= HUE && (v - hue[1]).abs() <= HUE;
        for _ in 0..4 {
            let own: Vec<Color> = near.iter().map(|i| colors[*i]).filter(|color| is(*color, hue)).collect();
            hue = [median(own.iter().map(|c| c[1]))?, median(own.iter().map(|c| c[2]))?];
        }
        let alike: Vec<bool> = (0..shown.len()).map(|i| shown[i] && is(colors[i], hue)).collect();
        // Single cells of another hue are noise.
        let not: Vec<bool> = (0..shown.len()).map(|i| shown[i] && !alike[i]).collect();
        let other = resample::opened([side as u32; 2], |i| not[i], 2);
        let other: Vec<bool> = other.as_raw().iter().map(|other| *other != 0).collect();
        let unknown: Vec<bool> = (0..shown.len()).map(|i| other[i] || (!shown[i] && away[i] > reach / 2)).collect();
        let beside = distances(&unknown, side, rim);
        let same = (0..shown.len()).map(|i| alike[i] && beside[i] > rim).collect();
        Some(Self { same, other })
    }
}

/// Smooth light on the surface: a polynomial of second degree of the brightness' logarithm.
struct Light {
    side: usize,
    coefficients: [f64; 6],
    /// Median of the absolute residuals.
    rough: f64,
}

impl Light {
    fn basis(side: usize, i: usize) -> [f64; 6] {
        let [x, y] = [i % side, i / side].map(|at| at as f64 / side as f64 - 0.5);
        [1.0, x, y, x * x, x * y, y * y]
    }

    /// Least squares in which what is far off loses its weight, what is darker sooner (Cauchy, squared for those): shadows
    /// and lines of the surface are dark. Nothing of too few cells.
    fn fit(of: &[usize], side: usize, value: impl Fn(usize) -> f64) -> Option<Self> {
        let of: Vec<usize> = of.iter().copied().step_by(of.len().div_ceil(6000).max(1)).collect();
        if of.len() < 200 {
            return None;
        }
        let mut weights = vec![1.0; of.len()];
        let mut light = Self { side, coefficients: [0.0; 6], rough: 0.0 };
        for _ in 0..20 {
            let (mut m, mut r) = ([[0.0; 6]; 6], [0.0; 6]);
            for (i, weight) in of.iter().zip(&weights) {
                let b = Self::basis(side, *i);
                for j in 0..6 {
                    (0..6).for_each(|k| m[j][k] += weight * b[j] * b[k]);
                    r[j] += weight * b[j] * value(*i);
                }
            }
            light.coefficients = solve(m, r)?;
            let residuals: Vec<f64> = of.iter().map(|i| value(*i) - light.at(*i)).collect();
            light.rough = median(residuals.iter().map(|r| r.abs()))?;
            let scale = (1.5 * light.rough).max(0.01);
            weights = residuals
                .iter()
                .map(|r| {
                    let whole = 1.0 / (1.0 + (r / if *r < 0.0 { scale } else { 2.0 * scale }).powi(2));
                    if *r < 0.0 { whole * whole } else { whole }
                })
                .collect();
        }
        Some(light)
    }

    fn at(&self, i: usize) -> f64 {
        Self::basis(self.side, i).iter().zip(self.coefficients).map(|(b, k)| b * k).sum()
    }
}

/// Gauss's elimination with pivots; `None` of a singular matrix.
fn solve(mut m: [[f64; 6]; 6], mut r: [f64; 6]) -> Option<[f64; 6]> {
    for column in 0..6 {
        let pivot = (column..6).max_by(|a, b| m[*a][column].abs().total_cmp(&m[*b][column].abs()))?;
        if m[pivot][column].abs() < 1e-12 {
            return None;
        }
        m.swap(column, pivot);
        r.swap(column, pivot);
        for row in column + 1..6 {
            let factor = m[row][column] / m[column][column];
            (column..6).for_each(|k| m[row][k] -= factor * m[column][k]);
            r[row] -= factor * r[column];
        }
    }
    for column in (0..6).rev() {
        let known: f64 = (column + 1..6).map(|k| m[column][k] * r[k]).sum();
        r[column] = (r[column] - known) / m[column][column];
    }
    Some(r)
}

/// `[cell]` how much brighter the surface is than its light, without noise and lines. Where it is not seen, as the nearest
/// cell of it.
fn differences(foot: &[bool], same: &[bool], side: usize, size: f64, of: &(dyn Fn(usize) -> f64 + Sync)) -> Vec<f64> {
    let known = |i: usize| same[i] && !foot[i];
    let mut values: Vec<f64> = (0..foot.len()).map(|i| if known(i) { of(i) } else { f64::NAN }).collect();
    values = over(&values, side, NOISE, |near| median(near.iter().copied()).unwrap_or(f64::NAN));
    fill(&mut values, side);
    // A line is closed; what is as dark at the foot is not, for the foot is darker.
    let largest = |near: &[f64]| near.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let smallest = |near: &[f64]| near.iter().copied().fold(f64::INFINITY, f64::min);
    let line = ((LINE * size).round() as isize).max(3);
    let footed: Vec<f64> = values.iter().zip(foot).map(|(v, foot)| if *foot { -9.0 } else { *v }).collect();
    let mut closed = over(&over(&footed, side, line, largest), side, line, smallest);
    closed.iter_mut().zip(foot).filter(|(_, foot)| **foot).for_each(|(v, _)| *v = f64::NAN);
    fill(&mut closed, side);
    blurred(closed, side, SMOOTH * size)
}

/// `[cell]` what is made of the known values within a radius.
fn over(values: &[f64], side: usize, radius: isize, made: impl Fn(&[f64]) -> f64 + Sync) -> Vec<f64> {
    let disc: Vec<[isize; 2]> = (-radius..=radius)
        .flat_map(|dy| (-radius..=radius).map(move |dx| [dx, dy]))
        .filter(|[dx, dy]| dx * dx + dy * dy <= radius * radius)
        .collect();
    let row = |y: usize| -> Vec<f64> {
        let mut near = vec![];
        let one = |x: usize| {
            if values[y * side + x].is_nan() {
                return f64::NAN;
            }
            near.clear();
            for [dx, dy] in &disc {
                let (u, v) = (x as isize + dx, y as isize + dy);
                if u >= 0 && v >= 0 && u < side as isize && v < side as isize {
                    let value = values[v as usize * side + u as usize];
                    if !value.is_nan() {
                        near.push(value);
                    }
                }
            }
            made(&near)
        };
        (0..side).map(one).collect()
    };
    (0..side).into_par_iter().flat_map_iter(row).collect()
}

/// Gives cells without a value that of the nearest one, along the grid.
fn fill(values: &mut [f64], side: usize) {
    let mut queue: VecDeque<usize> = (0..values.len()).filter(|i| !values[*i].is_nan()).collect();
    while let Some(i) = queue.pop_front() {
        for next in neighbours(i, [side; 2]) {
            if values[next].is_nan() {
                values[next] = values[i];
                queue.push_back(next);
            }
        }
    }
}

/// Cells that hang together with the first ones through those that `passes` says, on ways that do not get darker again once
/// they got brighter: another dip is another thing's. The first ones come with the brightest that led there.
fn reached(
    first: impl Iterator<Item = (usize, f64)>,
    side: usize,
    passes: impl Fn(usize) -> bool,
    off: &[f64],
) -> Vec<bool> {
    // The darkest ways first, so that each cell is reached by the way whose brightest place is the darkest.
    let rank = |brightest: f64| Reverse((1e6 * brightest.max(-1e3)) as i64);
    let mut queue: BinaryHeap<(Reverse<i64>, usize)> = first.map(|(i, brightest)| (rank(brightest), i)).collect();
    let mut out = vec![false; side * side];
    queue.iter().for_each(|(_, i)| out[*i] = true);
    while let Some((Reverse(brightest), i)) = queue.pop() {
        let brightest = brightest as f64 / 1e6;
        for next in neighbours(i, [side; 2]) {
            if !out[next] && passes(next) && off[next] > brightest - REBOUND {
                out[next] = true;
                queue.push((rank(brightest.max(off[next])), next));
            }
        }
    }
    out
}

/// Three means over squares along both axes: nearly Gaussian, of this deviation.
fn blurred(mut values: Vec<f64>, side: usize, deviation: f64) -> Vec<f64> {
    let radius = ((0.5 * ((4.0 * deviation * deviation + 1.0).sqrt() - 1.0)).round() as usize).max(1);
    for _ in 0..3 {
        for (step, across) in [(1, side), (side, 1)] {
            let line = |start: usize| {
                let at = |n: usize| values[start + n * step];
                let mean = move |n: usize| {
                    let near = n.saturating_sub(radius)..(n + radius + 1).min(side);
                    let count = near.len() as f64;
                    near.map(at).sum::<f64>() / count
                };
                (0..side).map(mean).collect::<Vec<f64>>()
            };
            let lines: Vec<Vec<f64>> = (0..side).map(|n| line(n * across)).collect();
            for (n, line) in lines.into_iter().enumerate() {
                line.into_iter().enumerate().for_each(|(k, v)| values[n * across + k * step] = v);
            }
        }
    }
    values
}

/// The shadow takes, logarithms, all that is darker within its region and around it as far as it hangs together, less and
/// less from the region's border on.
fn faded(off: &[f64], region: &[bool], foot: &[bool], side: usize, fade: u32) -> Vec<f64> {
    let inside: Vec<bool> = region.iter().zip(foot).map(|(region, foot)| *region || *foot).collect();
    let away = distances(&inside, side, fade);
    let first = (0..off.len()).filter(|i| region[*i]).map(|i| (i, off[i]));
    let own = reached(first, side, |i| away[i] <= fade && off[i] < END, off);
    let one = |i: usize| {
        let part = 1.0 - f64::from(away[i]) / f64::from(fade + 1);
        if own[i] && off[i] < 0.0 { -off[i] * part } else { 0.0 }
    };
    (0..off.len()).map(one).collect()
}

/// By how much the shadow takes more of one channel than of another, for each that it takes of the brightness: light from
/// the sky is bluer than the lamp's.
fn tint(colors: &[Color], taken: &[f64], [core, lit]: [&dyn Fn(usize) -> bool; 2]) -> [f64; 2] {
    let middle = |of: &dyn Fn(usize) -> bool, value: &dyn Fn(usize) -> f64| {
        median((0..colors.len()).filter(|i| of(*i)).map(value))
    };
    let of = |part: usize| {
        let [dark, light] = [core, lit].map(|of| middle(of, &|i| colors[i][part]));
        let tint = (light? - dark?) / middle(core, &|i| taken[i])?;
        Some(tint.clamp(-TINT, TINT))
    };
    [1, 2].map(|part| of(part).unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 120;

    /// A surface of this light, and a post of radius 12 and height 30 in its middle.
    fn look(value: impl Fn(f64, f64) -> [f64; 3]) -> Result<Shadow, String> {
        let log: Vec<[f32; 3]> = (0..SIDE * SIDE)
            .map(|i| {
                let (x, y) = ((i % SIDE) as f64, (i / SIDE) as f64);
                if is_foot(i) { [f32::NAN; 3] } else { value(x, y).map(|v| (255.0 * v).ln() as f32) }
            })
            .collect();
        let turns = (0..60).map(|k| std::f64::consts::TAU * f64::from(k) / 60.0);
        let object: Vec<[f64; 3]> = turns
            .flat_map(|a| (0..16).map(move |z| [60.5 + 11.5 * a.cos(), 60.5 + 11.5 * a.sin(), 2.0 * f64::from(z)]))
            .collect();
        find(&Ground { side: SIDE, log: &log, object: &object, height: 30.0 })
    }

    fn is_foot(i: usize) -> bool {
        ((i % SIDE) as f64 - 60.0).hypot((i / SIDE) as f64 - 60.0) < 12.0
    }

    /// Whether a place is a joint between tiles, 2 cells wide.
    fn joint(x: f64, y: f64) -> bool {
        x.rem_euclid(30.0) < 2.0 || y.rem_euclid(30.0) < 2.0
    }

    /// Most of what it takes of the light where this is so.
    fn most(shadow: &Shadow, of: &dyn Fn(f64, f64) -> bool) -> f32 {
        let cells = (0..SIDE * SIDE).filter(|i| of((i % SIDE) as f64, (i / SIDE) as f64));
        cells.map(|i| shadow.amount[i]).fold(0.0, f32::max)
    }

    /// A soft shadow to the left of the foot takes this share of the light.
    fn shade(x: f64, y: f64) -> f64 {
        0.35 * (-((x - 46.0) / 9.0).powi(2) - ((y - 60.0) / 9.0).powi(2)).exp()
    }

    /// A soft shadow beside the foot, on a plain floor and on tiles with joints: the light is given back where much of it is left, and
    /// joints stay.
    #[test]
    fn a_soft_shadow_is_given_back() {
        for tiled in [false, true] {
            let floor = |x: f64, y: f64| {
                let tone = if tiled && joint(x, y) { 0.6 } else { 1.0 };
                [0.8, 0.75, 0.7].map(|v| v * tone * (1.0 - 0.001 * x))
            };
            let shadow = look(|x, y| floor(x, y).map(|v| v * (1.0 - shade(x, y)))).expect("a shadow");
            let mut worst = (0.0, 0.0, 0.0);
            for i in (0..SIDE * SIDE).filter(|i| !is_foot(*i) && !shadow.contact[*i]) {
                let (x, y) = ((i % SIDE) as f64, (i / SIDE) as f64);
                let left = shadow.ratio[1].powf(f64::from(shadow.amount[i]));
                let off: f64 = (1.0 - shade(x, y)) / left - 1.0;
                if off.abs() > worst.0 {
                    worst = (off.abs(), x, y);
                }
            }
            // Closing takes the largest value within 2 cells, of a slope of at most 0.033 a cell, and the mean as much again.
            assert!(worst.0 < 0.08, "tiled: {tiled}: off by {worst:.2?}");
        }
    }

    /// Dark joints run away from the foot, and a shadow of something else touches it: neither is the foot's.
    #[test]
    fn patterns_and_other_shadows_stay() {
        let tone = |dark: bool| if dark { [0.4, 0.37, 0.35] } else { [0.8, 0.75, 0.7] };
        for (what, floor) in [
            ("joints", (|x, y| joint(x, y)) as fn(f64, f64) -> bool),
            ("one line", |x, _| (59.0..61.0).contains(&x)),
            ("another shadow", |x, y| x < 52.0 && (y - 60.0).abs() < 25.0),
            ("a carpet", |_, y| y > 60.0),
        ] {
            assert!(look(|x, y| tone(floor(x, y))).is_err(), "{what}");
        }
    }

    /// A shadow beside another object's, between which it is lighter, and a wall of another hue in which it ends: both stay.
    #[test]
    fn a_shadow_ends_at_the_next_one_and_at_a_wall() {
        let next = |x: f64, y: f64| 0.3 * (-((x - 22.0) / 6.0).powi(2) - ((y - 60.0) / 8.0).powi(2)).exp();
        let wall = |y: f64| y > 76.0;
        let shadow = look(|x, y| {
            let tone = if wall(y) { [0.6, 0.7, 0.8] } else { [0.8, 0.75, 0.7] };
            tone.map(|v| v * (1.0 - shade(x, y)) * (1.0 - next(x, y)))
        });
        let shadow = shadow.expect("a shadow");
        let most = |of: &dyn Fn(f64, f64) -> bool| most(&shadow, of);
        assert!(most(&|x, y| (x - 46.0).hypot(y - 60.0) < 3.0) > 0.8);
        assert_eq!(most(&|_, y| y > 79.0), 0.0, "the wall");
        // What it takes there is at most the lighter place between both and as much as it may get darker again.
        assert!(most(&|x, y| (x - 22.0).hypot(y - 60.0) < 3.0) < 0.1, "the other's");
    }

    /// A desk ends behind the object, and beyond its end nothing of its plane is seen: there no light is given back.
    #[test]
    fn no_light_is_given_back_where_nothing_is_seen() {
        let desk = |x: f64, y: f64| if y < 66.0 { 0.8 * (1.0 - shade(x, y)) } else { f64::NAN };
        let shadow = look(|x, y| [desk(x, y); 3]).expect("a shadow");
        let most = |of: &dyn Fn(f64, f64) -> bool| most(&shadow, of);
        assert!(most(&|x, y| (x - 46.0).hypot(y - 60.0) < 3.0) > 0.8);
        assert_eq!(most(&|_, y| y > 69.0), 0.0, "beyond the end");
    }

    /// An even floor, light that falls off, and a stain of another colour have none.
    #[test]
    fn none_is_invented() {
        assert!(look(|_, _| [0.8, 0.75, 0.7]).is_err());
        assert!(look(|x, _| [0.8, 0.75, 0.7].map(|v| v * (1.0 - 0.002 * x))).is_err());
        let stain = |x: f64, y: f64| (x - 45.0).hypot(y - 60.0) < 8.0;
        assert!(look(|x, y| if stain(x, y) { [0.7, 0.5, 0.2] } else { [0.8, 0.75, 0.7] }).is_err());
    }
}

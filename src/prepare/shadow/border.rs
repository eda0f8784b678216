//! A shadow's border: how dark the shadow is, and how it sets in, by what lies on both sides.
//!
//! The surface goes on below a border of a shadow, whatever its colours are. Across each of its places colours are compared
//! with those outside; the medians over many places are the drop of full shadow and the profile of the border, which is the
//! wider the farther the light has come past the object.

use super::Ground;
use super::mixture::{Color, Mixture, brightened};
use crate::scene::resample::squared_distances;
use crate::statistics::median;

/// Distance of each cell from the border of a mask, in cells: positive inside, negative outside, no farther than `reach`.
fn depths(mask: &[bool], side: usize, reach: u32) -> Vec<f64> {
    let of = |wanted: bool| {
        let bytes = mask.iter().map(|m| if *m == wanted { 255 } else { 0 }).collect();
        let picture = image::GrayImage::from_raw(side as u32, side as u32, bytes).expect("a value per cell");
        let squares = squared_distances(&picture, reach).into_iter();
        squares.map(|square| (square as f64).sqrt().min(f64::from(reach))).collect::<Vec<f64>>()
    };
    let (inside, outside) = (of(false), of(true));
    let raw: Vec<f64> = (0..mask.len()).map(|i| if mask[i] { inside[i] - 0.5 } else { 0.5 - outside[i] }).collect();
    // The stairs of the cells are no part of the border.
    let smooth = |values: &[f64], step: usize, at: &dyn Fn(usize) -> usize| -> Vec<f64> {
        let one = |i: usize| {
            let n = at(i);
            let mut sum = 2.0 * values[i];
            sum += if n > 0 { values[i - step] } else { values[i] };
            sum += if n + 1 < side { values[i + step] } else { values[i] };
            0.25 * sum
        };
        (0..values.len()).map(one).collect()
    };
    let mut values = raw;
    for _ in 0..3 {
        values = smooth(&values, 1, &|i| i % side);
        values = smooth(&values, side, &|i| i / side);
    }
    values
}

/// Cells across a border that are looked at on each side: least, and this share of the object's height.
const ACROSS: (usize, f64) = (6, 0.22);
/// Fewest places along a border that tell its profile, and most parts that it is told by, near the object and far from it.
const TELLING: usize = 40;
const PARTS: usize = 3;

/// What lies across a border at one of its places: brightness and differences of channels from `-across` outside to
/// `across` inside, less those outside; not a number where nothing is known or the shadow is thinner.
struct Crossing {
    along: f64,
    drops: Vec<Option<Color>>,
}

/// How the shadow sets in across its border, from outside to inside, for a distance along the light.
struct Profile {
    along: f64,
    amounts: Vec<f64>,
}

/// A shadow's border: places, how far along the light each lies, and which way is in.
struct Borders<'a> {
    side: usize,
    seen: &'a [bool],
    colors: &'a [Color],
    region: &'a [bool],
    depth: &'a [f64],
    along: &'a [f64],
    across: usize,
}

impl Borders<'_> {
    fn at(&self, x: f64, y: f64) -> Option<usize> {
        let (x, y) = (x.floor(), y.floor());
        let inside = x >= 0.0 && y >= 0.0 && x < self.side as f64 && y < self.side as f64;
        inside.then(|| y as usize * self.side + x as usize)
    }

    fn crossings(&self) -> Vec<Crossing> {
        let side = self.side;
        let is_border = |i: &usize| {
            let (x, y) = (i % side, i / side);
            let inner = x > 0 && y > 0 && x + 1 < side && y + 1 < side;
            inner && self.region[*i] && [i - 1, i + 1, i - side, i + side].iter().any(|j| !self.region[*j])
        };
        (0..side * side).filter(is_border).filter_map(|i| self.crossing(i)).collect()
    }

    fn crossing(&self, i: usize) -> Option<Crossing> {
        let side = self.side;
        let slope = [self.depth[i + 1] - self.depth[i - 1], self.depth[i + side] - self.depth[i - side]];
        let steep = slope[0].hypot(slope[1]);
        if steep < 0.5 {
            return None;
        }
        let inwards = slope.map(|v| v / steep);
        let middle = [(i % side) as f64 + 0.5, (i / side) as f64 + 0.5];
        let reach = self.across as isize;
        let color = |k: isize| {
            // From the border itself, which lies `depth` outwards of this cell's middle.
            let far = k as f64 - self.depth[i];
            let at = self.at(middle[0] + inwards[0] * far, middle[1] + inwards[1] * far)?;
            let same_border = (self.depth[at] - k as f64).abs() <= 1.5;
            (self.seen[at] && same_border).then(|| self.colors[at])
        };
        let all: Vec<Option<Color>> = (-reach..=reach).map(color).collect();
        let outside: Vec<Color> = all[..self.across / 2 + 1].iter().flatten().copied().collect();
        if outside.len() < self.across / 3 + 1 {
            return None;
        }
        let mean: Color = std::array::from_fn(|c| outside.iter().map(|v| v[c]).sum::<f64>() / outside.len() as f64);
        let drops = all.into_iter().map(|v| v.map(|v| std::array::from_fn(|c| mean[c] - v[c]))).collect();
        Some(Crossing { along: self.along[i], drops })
    }
}

/// The drop of full shadow and the profiles of its border near the object and far from it, by what lies on both sides of it:
/// the surface goes on below a shadow's border, whatever its colours. Nothing where too little of the border is seen.
fn across(borders: &Borders<'_>) -> Option<(Color, Vec<Profile>)> {
    let mut crossings = borders.crossings();
    let deep = |crossing: &Crossing| -> Option<Color> {
        let inside: Vec<Color> =
            crossing.drops[borders.across + borders.across / 2..].iter().flatten().copied().collect();
        (inside.len() > borders.across / 3)
            .then(|| std::array::from_fn(|c| inside.iter().map(|v| v[c]).sum::<f64>() / inside.len() as f64))
    };
    let deeps: Vec<Color> = crossings.iter().filter_map(deep).collect();
    if deeps.len() < TELLING {
        return None;
    }
    let drop: Color = std::array::from_fn(|c| median(deeps.iter().map(|d| d[c])).expect("there are crossings"));
    crossings.sort_by(|a, b| a.along.total_cmp(&b.along));
    let parts = (crossings.len() / TELLING).clamp(1, PARTS);
    let profiles = crossings.chunks(crossings.len().div_ceil(parts)).map(|part| {
        let along = part.iter().map(|c| c.along).sum::<f64>() / part.len() as f64;
        let length = 2 * borders.across + 1;
        let mut amounts: Vec<f64> = (0..length)
            .map(|k| {
                let values = || part.iter().filter_map(|c| c.drops[k]).map(|d| d[0]);
                let known = values().count() >= 8;
                median(values()).filter(|_| known).map_or(f64::NAN, |median| median / drop[0])
            })
            .collect();
        // It sets in and does not let up again.
        let mut so_far: f64 = 0.0;
        for (k, amount) in amounts.iter_mut().enumerate() {
            let known = if amount.is_finite() { *amount } else { f64::from(u8::from(k > borders.across)) };
            so_far = if k <= borders.across / 2 { 0.0 } else { so_far.max(known.clamp(0.0, 1.0)) };
            *amount = if k >= borders.across + borders.across * 3 / 4 { 1.0 } else { so_far };
        }
        Profile { along, amounts }
    });
    Some((drop, profiles.collect()))
}

/// The amount of a shadow at a distance inside its border and one along the light.
fn amount_at(profiles: &[Profile], reach: usize, depth: f64, along: f64) -> f64 {
    let of = |profile: &Profile| {
        let at = (depth + reach as f64).clamp(0.0, 2.0 * reach as f64);
        let (low, part) = (at as usize, at.fract());
        let next = (low + 1).min(2 * reach);
        profile.amounts[low] * (1.0 - part) + profile.amounts[next] * part
    };
    let after = profiles.partition_point(|profile| profile.along < along);
    match (after.checked_sub(1).and_then(|i| profiles.get(i)), profiles.get(after)) {
        (Some(a), Some(b)) => {
            let part = (along - a.along) / (b.along - a.along).max(1e-9);
            of(a) * (1.0 - part) + of(b) * part
        }
        (Some(only), None) | (None, Some(only)) => of(only),
        (None, None) => 0.0,
    }
}

/// How much of the full shadow each cell has, the drop of full shadow, and the brightness that each cell would have in
/// light. Nothing where too little of the border is seen.
pub(super) fn amounts(
    ground: &Ground<'_>,
    (seen, colors): (&[bool], &[Color]),
    mixture: &Mixture,
    region: &[bool],
    shift: [f64; 2],
) -> Option<Amounts> {
    let side = ground.side;
    let far = shift[0].hypot(shift[1]).max(1e-6);
    let reach = ((ACROSS.1 * ground.height) as usize).max(ACROSS.0);
    let depth = depths(region, side, reach as u32 + 2);
    let middle = 0.5 * side as f64;
    let along = |i: usize| {
        let at = [(i % side) as f64 + 0.5 - middle, (i / side) as f64 + 0.5 - middle];
        (at[0] * shift[0] + at[1] * shift[1]) / far
    };
    let along: Vec<f64> = (0..side * side).map(along).collect();
    let borders = Borders { side, seen, colors, region, depth: &depth, along: &along, across: reach };
    let (drop, profiles) = across(&borders)?;
    let amount: Vec<f64> = (0..side * side).map(|i| amount_at(&profiles, reach, depth[i], along[i])).collect();
    for profile in &profiles {
        log::debug!("shadow: at {:.0}: {:.2?}", profile.along, profile.amounts);
    }
    log::debug!("shadow: drop {drop:?}");
    let lit = |i: usize| {
        let lit = mixture.expected(brightened(colors[i], drop.map(|d| d * amount[i])));
        lit.filter(|_| seen[i]).map_or(f32::NAN, |lit| lit.mean[0] as f32)
    };
    let expected = (0..side * side).map(lit).collect();
    Some(Amounts { drop, expected, amount: amount.into_iter().map(|a| a as f32).collect() })
}

/// What the border says of a shadow.
pub(super) struct Amounts {
    /// Logarithms of what full shadow takes.
    pub drop: Color,
    /// `[cell]` how much of it there is, 0 to 1.
    pub amount: Vec<f32>,
    /// `[cell]` the brightness of the cell's material in light, a logarithm.
    pub expected: Vec<f32>,
}

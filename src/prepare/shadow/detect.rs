//! Whether the object casts a shadow on a rectified surface: a place that is darker by one ratio of all channels, where a
//! light from one side would put the object's shadow.
//!
//! A hypothesis is a direction of the light. The object's places, moved along it onto the surface, say which cells are in
//! shadow; the colours of all others say what the surface looks like in light ([`Mixture`]). The likelihood of all cells,
//! those in shadow made brighter by the ratio, is compared with that of the same colours without a shadow. Of the best
//! direction a minimum cut draws the border by the colours alone, and what it finds has to be what the object would cast:
//! dark tiles, rugs and lines of contact are not.

use rayon::prelude::*;

use super::Ground;
use super::border::{Amounts, amounts};
use super::mixture::{Color, Mixture, brightened, channels, color};
use crate::prepare::min_cut::Grid;
use crate::prepare::planes::neighbours;

/// Directions of the light around the object, and how far a place one high is moved.
const AROUND: usize = 24;
const SHIFTS: [f64; 8] = [0.3, 0.5, 0.7, 0.9, 1.15, 1.45, 1.8, 2.3];
/// Cells on each side, about, that directions are compared by.
const COARSE: usize = 54;
/// Logarithms of ratios that are tried.
const RATIOS: [f64; 10] = [0.08, 0.14, 0.2, 0.28, 0.36, 0.45, 0.55, 0.7, 0.9, 1.2];
/// A shadow is compared with what lies around it within so many heights of the object.
const AROUND_IT: f64 = 0.8;
/// A shadow's cells have to be so much likelier in it, logarithms of likelihoods.
const TOLL: f64 = 1.0;
/// Directions whose shadows are looked at closely, and how far apart these are: sine of an angle, ratio of lengths.
const CLOSELY: usize = 8;
const APART: (f64, f64) = (0.4, 1.4);
/// The object's foot is what of it is lower than this share of its height, and its shadow begins within this share of it.
const LOW: f64 = 0.2;
const NEAR: f64 = 0.1;
/// Fewest cells of a shadow, coarse ones, and those of it that lie at the foot.
const FEWEST: usize = 10;
/// Gain of the shadow's cells in the logarithm of their likelihood, on the mean, at least.
const GAIN: f64 = 1.0;
/// A shadow leaves so much of the brightness: below is a hole or a material, above nothing that anybody sees.
const LEFT: std::ops::Range<f64> = 0.2..0.95;
/// Channels' logarithms may differ by so much, and by so much of the ratio's: skylight is bluer than the sun's.
const TINT: [f64; 2] = [0.05, 0.3];
/// What the cut finds and what the object would cast have at least this share of both in common.
const ALIKE: f64 = 0.6;
/// Cost of a border of the cut per cell, and the most that a cell says; logarithms of likelihoods.
const BORDER: f64 = 1.6;
const MOST: f64 = 3.0;
/// Costs are whole numbers of this fraction.
const UNIT: f64 = 256.0;
const NEIGHBOURS: [[isize; 2]; 8] = [[-1, -1], [0, -1], [1, -1], [-1, 0], [1, 0], [-1, 1], [0, 1], [1, 1]];

/// A shadow on it.
#[derive(Clone, Debug)]
pub struct Shadow {
    /// What is left of the channels' stored values in full shadow.
    pub ratio: [f64; 3],
    /// `[cell]` how much of the full shadow there is, 0 to 1.
    pub amount: Vec<f32>,
    /// `[cell]` the cut's.
    pub region: Vec<bool>,
    /// `[cell]` where there is certainly none, and the surface is near enough to compare.
    pub lit: Vec<bool>,
    /// `[cell]` the brightness that the cell's material has in light, a logarithm.
    pub expected: Vec<f32>,
    /// What the region and what the object would cast have in common, of both.
    pub alike: f64,
    /// `[cell]` of a soft shadow, where too little of the light is left to be given back: it is filled as the place under the
    /// object is. Empty of another one.
    pub contact: Vec<bool>,
}

/// What was found.
#[derive(Clone, Debug)]
pub enum Verdict {
    /// A shadow.
    Found(Box<Shadow>),
    /// None, and why, as a clause.
    Nothing(String),
}

/// A mask of cells.
type Cells = Vec<bool>;

/// Cells within a distance of those of a mask.
pub fn grown(mask: &[bool], side: usize, radius: f64) -> Cells {
    let reach = radius.ceil() as isize;
    let mut out = mask.to_vec();
    let border = |i: usize| {
        let (x, y) = (i % side, i / side);
        x == 0
            || y == 0
            || x + 1 == side
            || y + 1 == side
            || !mask[i - 1]
            || !mask[i + 1]
            || !mask[i - side]
            || !mask[i + side]
    };
    for i in (0..mask.len()).filter(|i| mask[*i] && border(*i)) {
        let (x, y) = ((i % side) as isize, (i / side) as isize);
        for (dx, dy) in (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy))) {
            let (u, v) = (x + dx, y + dy);
            let inside = u >= 0 && v >= 0 && u < side as isize && v < side as isize;
            if inside && ((dx * dx + dy * dy) as f64) <= radius * radius {
                out[v as usize * side + u as usize] = true;
            }
        }
    }
    out
}

fn shrunk(mask: &[bool], side: usize, radius: f64) -> Cells {
    let outside: Cells = mask.iter().map(|m| !m).collect();
    grown(&outside, side, radius).into_iter().map(|m| !m).collect()
}

/// A mask with gaps up to a radius closed.
pub fn closed(mask: &[bool], side: usize, radius: f64) -> Cells {
    shrunk(&grown(mask, side, radius), side, radius)
}

/// The cells below the object's lowest places: its foot.
pub fn low(ground: &Ground<'_>) -> Cells {
    let side = ground.side;
    let mut cells = vec![false; side * side];
    for [x, y, _] in ground.object.iter().filter(|[_, _, height]| *height < LOW * ground.height) {
        if *x >= 0.0 && *y >= 0.0 && *x < side as f64 && *y < side as f64 {
            cells[*y as usize * side + *x as usize] = true;
        }
    }
    cells
}

/// Where the object's shadow falls: its places moved along the light, gaps between them closed.
fn cast(ground: &Ground<'_>, [a, b]: [f64; 2], side: usize, close: f64) -> Cells {
    let scale = 1.0 / (ground.side / side) as f64;
    let mut cells = vec![false; side * side];
    for [x, y, height] in ground.object {
        let height = height.max(0.0);
        let [u, v] = [x + a * height, y + b * height].map(|p| (p * scale).floor());
        if u >= 0.0 && v >= 0.0 && u < side as f64 && v < side as f64 {
            cells[v as usize * side + u as usize] = true;
        }
    }
    closed(&cells, side, close)
}

/// A direction and how well it explains the colours.
#[derive(Clone, Copy, Debug)]
struct Hypothesis {
    shift: [f64; 2],
    /// Logarithm of what is left.
    ratio: f64,
    score: f64,
}

/// The surface at the size that directions are compared at.
struct Coarse {
    factor: usize,
    side: usize,
    colors: Vec<Option<Color>>,
}

impl Coarse {
    fn of(ground: &Ground<'_>) -> Self {
        let factor = (ground.side / COARSE).max(1);
        let side = ground.side / factor;
        let one = |i: usize| {
            let (x, y) = (factor * (i % side), factor * (i / side));
            let (mut sum, mut count) = ([0f32; 3], 0);
            for (u, v) in (0..factor).flat_map(|v| (0..factor).map(move |u| (u, v))) {
                let log = ground.log[(y + v) * ground.side + x + u];
                if log[0].is_finite() {
                    (0..3).for_each(|c| sum[c] += log[c]);
                    count += 1;
                }
            }
            (2 * count >= factor * factor).then(|| color(sum.map(|s| s / count as f32)))
        };
        let colors: Vec<Option<Color>> = (0..side * side).map(one).collect();
        Self { factor, side, colors }
    }

    fn try_out(&self, ground: &Ground<'_>, shift: [f64; 2]) -> Option<Hypothesis> {
        let shadow = cast(ground, shift, self.side, 1.5);
        let rim = grown(&shadow, self.side, 1.0);
        let of = |wanted: &dyn Fn(usize) -> bool| -> Vec<Color> {
            (0..self.colors.len()).filter(|i| wanted(*i)).filter_map(|i| self.colors[i]).collect()
        };
        let around = grown(&shadow, self.side, AROUND_IT * ground.height / self.factor as f64 + 2.0);
        let (inside, outside) = (of(&|i| shadow[i]), of(&|i| around[i] && !rim[i]));
        if inside.len() < FEWEST {
            return None;
        }
        let mixture = Mixture::fit(&outside, 6)?;
        let shifted = |ratio: f64| inside.iter().map(|[y, u, v]| mixture.ln([y + ratio, *u, *v])).sum::<f64>();
        let ratios = RATIOS.iter().map(|r| (*r, shifted(*r)));
        let ratio = ratios.max_by(|a, b| a.1.total_cmp(&b.1)).expect("ratios").0;
        let says = |[y, u, v]: &Color| (mixture.ln([y + ratio, *u, *v]) - mixture.ln([*y, *u, *v])).clamp(-MOST, MOST);
        let score = inside.iter().map(|c| says(c) - TOLL).sum();
        Some(Hypothesis { shift, ratio, score })
    }

    /// The best directions that differ: of a coarse fan, each made better by finer ones around it.
    fn best(&self, ground: &Ground<'_>) -> Vec<Hypothesis> {
        let polar = |turn: f64, far: f64| {
            let angle = turn * std::f64::consts::TAU / AROUND as f64;
            [far * angle.cos(), far * angle.sin()]
        };
        let scored = |tried: Vec<[f64; 2]>| -> Vec<Hypothesis> {
            let all: Vec<Option<Hypothesis>> = tried.par_iter().map(|shift| self.try_out(ground, *shift)).collect();
            all.into_iter().flatten().filter(|found| found.score > 0.0).collect()
        };
        let mut fan = scored((0..AROUND).flat_map(|i| SHIFTS.map(|far| polar(i as f64, far))).collect());
        fan.sort_by(|a, b| b.score.total_cmp(&a.score));
        let mut chosen: Vec<Hypothesis> = vec![];
        for next in fan {
            if chosen.len() < CLOSELY && chosen.iter().all(|other| differ(other.shift, next.shift)) {
                chosen.push(next);
            }
        }
        for found in &mut chosen {
            for fine in [0.5, 0.25] {
                let [a, b] = found.shift;
                let (turn, far) = (b.atan2(a) * AROUND as f64 / std::f64::consts::TAU, a.hypot(b));
                let around = [-fine, 0.0, fine];
                let tried = around.iter().flat_map(|dt| around.map(|df| polar(turn + dt, far * (0.3 * df).exp())));
                for next in scored(tried.collect()) {
                    if next.score > found.score {
                        *found = next;
                    }
                }
            }
        }
        chosen
    }
}

/// Whether two directions are apart.
fn differ([a, b]: [f64; 2], [c, d]: [f64; 2]) -> bool {
    let (first, second) = (a.hypot(b), c.hypot(d));
    let sine = (a * d - b * c) / (first * second);
    let opposite = a * c + b * d < 0.0;
    opposite || sine.abs() > APART.0 || (first / second).ln().abs() > APART.1.ln()
}

/// Looks for the shadow: of all directions that may be, the one whose shadow is most like what is found.
pub fn find(ground: &Ground<'_>) -> Verdict {
    let tried = Coarse::of(ground).best(ground);
    if tried.is_empty() {
        return Verdict::Nothing("no light from one side explains the colours around it".into());
    }
    let looked: Vec<Verdict> = tried.par_iter().map(|best| closely(ground, best)).collect();
    let mut found: Option<Box<Shadow>> = None;
    let mut why = String::new();
    for verdict in looked {
        match verdict {
            Verdict::Found(next) if found.as_ref().is_none_or(|best| next.alike > best.alike) => found = Some(next),
            Verdict::Found(_) => {}
            Verdict::Nothing(reason) if why.is_empty() => why = reason,
            Verdict::Nothing(_) => {}
        }
    }
    found.map_or(Verdict::Nothing(why), Verdict::Found)
}

/// Whether there is a shadow by a light from one direction.
fn closely(ground: &Ground<'_>, best: &Hypothesis) -> Verdict {
    let nothing = |why: &str| Verdict::Nothing(why.to_owned());
    let side = ground.side;
    let cast = cast(ground, best.shift, side, 0.12 * ground.height + 2.0);
    let seen: Cells = ground.log.iter().map(|log| log[0].is_finite()).collect();
    let colors: Vec<Color> = ground.log.iter().map(|log| color(*log)).collect();
    let rim = grown(&cast, side, 0.2 * ground.height);
    let near = grown(&cast, side, AROUND_IT * ground.height + 6.0);
    let training: Vec<Color> =
        (0..seen.len()).filter(|i| seen[*i] && near[*i] && !rim[*i]).map(|i| colors[i]).collect();
    let every = training.len().div_ceil(6000).max(1);
    let training: Vec<Color> = training.into_iter().step_by(every).collect();
    let Some(mixture) = Mixture::fit(&training, 20) else {
        return nothing("too little of the surface around it is seen");
    };
    let core = shrunk(&cast, side, 2.0);
    let core: Vec<(Color, f64)> = (0..seen.len()).filter(|i| seen[*i] && core[*i]).map(|i| (colors[i], 1.0)).collect();
    let drop = refined(&mixture, &core, [best.ratio, 0.0, 0.0]);
    let region = cut(side, &seen, &colors, &mixture, drop);
    // What hangs together with the cast shadow, wherever it reaches.
    let region = attached(&region, &cast, side);
    let (mut both, mut either, mut gained, mut count) = (0usize, 0usize, 0.0, 0usize);
    for i in (0..seen.len()).filter(|i| seen[*i]) {
        both += usize::from(region[i] && cast[i]);
        either += usize::from(region[i] || cast[i]);
        if region[i] {
            gained += mixture.ln(brightened(colors[i], drop)) - mixture.ln(colors[i]);
            count += 1;
        }
    }
    let foot = grown(&low(ground), side, NEAR * ground.height + 3.0);
    if (0..seen.len()).filter(|i| seen[*i] && region[*i] && foot[*i]).count() < FEWEST {
        return nothing("what is darker around it does not reach its foot");
    }
    let alike = both as f64 / either.max(1) as f64;
    let gain = gained / count.max(1) as f64;
    log::debug!("shadow: {best:?} alike {alike:.2}, gain {gain:.2}, {count} cells, {drop:?}");
    if alike < ALIKE {
        return nothing("what is darker around it is not what it would cast");
    }
    if gain < GAIN {
        return nothing("what it would cast is hardly darker than its surroundings");
    }
    let band = grown(&region, side, 0.25 * ground.height + 2.0);
    let Some(Amounts { drop, amount, expected }) = amounts(ground, (&seen, &colors), &mixture, &region, best.shift)
    else {
        return nothing("too little of the border of what is darker around it is seen");
    };
    let ratio = channels(drop).map(|d| (-d).exp());
    let grey = (-drop[0]).exp();
    let tint = ratio.iter().map(|r| (r / grey).ln().abs()).fold(0.0, f64::max);
    if !LEFT.contains(&grey) {
        return nothing("what is darker around it is no shadow by its ratio");
    }
    if tint > TINT[0] + TINT[1] * drop[0] {
        return nothing("what is darker around it has another colour");
    }
    let lit: Cells = (0..seen.len()).map(|i| seen[i] && near[i] && !rim[i] && !band[i]).collect();
    Verdict::Found(Box::new(Shadow { ratio, amount, region, lit, expected, alike, contact: vec![] }))
}

/// The drop that makes colours with so much shadow on them likeliest, by expectation and maximisation.
fn refined(mixture: &Mixture, colors: &[(Color, f64)], mut drop: Color) -> Color {
    for _ in 0..20 {
        let (mut sum, mut weights) = ([0.0; 3], [0.0; 3]);
        for (color, amount) in colors {
            let Some(expected) = mixture.expected(brightened(*color, drop.map(|d| d * amount))) else { continue };
            for i in 0..3 {
                sum[i] += amount * (expected.mean[i] - color[i]) / expected.variance[i];
                weights[i] += amount * amount / expected.variance[i];
            }
        }
        if weights[0] > 0.0 {
            drop = std::array::from_fn(|i| sum[i] / weights[i]);
        }
    }
    drop
}

/// Cells in shadow: the cheapest border between those that are likelier in it and those that are not.
fn cut(side: usize, seen: &[bool], colors: &[Color], mixture: &Mixture, drop: Color) -> Cells {
    let mut grid = Grid::new([side; 2], &NEIGHBOURS);
    let says: Vec<f64> = (0..seen.len())
        .into_par_iter()
        .map(|i| {
            if !seen[i] {
                return 0.0;
            }
            (mixture.ln(brightened(colors[i], drop)) - mixture.ln(colors[i])).clamp(-MOST, MOST)
        })
        .collect();
    for (i, says) in says.iter().enumerate() {
        grid.set_terminals(i, (UNIT * says.max(0.0)) as i64, (UNIT * (-says).max(0.0)) as i64);
        for (d, [dx, dy]) in NEIGHBOURS.into_iter().enumerate().skip(4) {
            let cost = if dx != 0 && dy != 0 { BORDER * 0.35 } else { BORDER * 0.5 };
            grid.set_edge(i, d, (UNIT * cost) as i32);
        }
    }
    grid.cut()
}

/// The pieces of a mask that share a good part with another.
fn attached(mask: &[bool], other: &[bool], side: usize) -> Cells {
    let mut out = vec![false; mask.len()];
    let mut done = vec![false; mask.len()];
    for start in 0..mask.len() {
        if !mask[start] || done[start] {
            continue;
        }
        done[start] = true;
        let (mut piece, mut at) = (vec![start], 0);
        while let Some(&i) = piece.get(at) {
            at += 1;
            for j in neighbours(i, [side; 2]) {
                if mask[j] && !done[j] {
                    done[j] = true;
                    piece.push(j);
                }
            }
        }
        let shared = piece.iter().filter(|i| other[**i]).count();
        // A few cells are noise.
        if shared >= 12 {
            piece.into_iter().for_each(|i| out[i] = true);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use rand::RngExt as _;
    use rand_pcg::Pcg64;

    use super::*;

    const SIDE: usize = 200;
    const HEIGHT: f64 = 36.0;
    /// What is left in shadow.
    const UMBRA: f64 = 0.55;

    /// A floor of tiles in two tones with noise, a box in its middle, and what multiplies the light by the place, cells from
    /// the middle.
    fn ground(light: impl Fn(f64, f64) -> f64) -> (Vec<[f32; 3]>, Vec<[f64; 3]>) {
        let mut rng = Pcg64::new(7, 7);
        let log = (0..SIDE * SIDE)
            .map(|i| {
                let (x, y) = ((i % SIDE) as f64 + 0.5, (i / SIDE) as f64 + 0.5);
                let (dx, dy) = (x - 100.0, y - 100.0);
                if dx.abs() < 12.0 && dy.abs() < 12.0 {
                    return [f32::NAN; 3];
                }
                let tile = (i % SIDE / 25 + i / SIDE / 25).is_multiple_of(2);
                let tone = if tile { [120.0, 110.0, 100.0] } else { [105.0, 100.0, 98.0] };
                let noise = rng.random_range(-0.04..0.04);
                tone.map(|v: f64| (v.ln() + light(dx, dy).ln() + noise) as f32)
            })
            .collect();
        let step = |n: usize| 100.0 + 24.0 * (n as f64 / 11.0 - 0.5);
        let object = (0..12)
            .flat_map(|i| (0..12).flat_map(move |j| (0..19).map(move |k| (i, j, k))))
            .filter(|(i, j, k)| *k == 18 || [0, 11].contains(i) || [0, 11].contains(j))
            .map(|(i, j, k)| [step(i), step(j), 2.0 * k as f64])
            .collect();
        (log, object)
    }

    fn look(light: impl Fn(f64, f64) -> f64) -> Verdict {
        let (log, object) = ground(light);
        find(&Ground { side: SIDE, log: &log, object: &object, height: HEIGHT })
    }

    /// The share of the light that is hidden by a box whose shadow falls along (0.8, 0.5) per height: the hull of the box's
    /// foot and its top moved, with a border `soft` cells wide.
    fn cast(x: f64, y: f64, soft: f64) -> f64 {
        let (a, b) = (0.8 * HEIGHT, 0.5 * HEIGHT);
        // The deepest of the squares of half 12 that are moved along.
        let inside = (0..=40)
            .map(|t| f64::from(t) / 40.0)
            .map(|t| (12.0 - (x - t * a).abs()).min(12.0 - (y - t * b).abs()))
            .fold(f64::NEG_INFINITY, f64::max);
        (0.5 + inside / soft).clamp(0.0, 1.0)
    }

    #[test]
    fn a_cast_shadow_is_found_with_its_ratio_and_its_border() {
        let light = |x: f64, y: f64| 1.0 - (1.0 - UMBRA) * cast(x, y, 5.0);
        let Verdict::Found(shadow) = look(light) else { panic!("a shadow") };
        // Noise of 0.023 over windows of four cells and some 200 places, two tones 0.13 apart that the median meets on both
        // sides: under 0.02 each.
        assert!(shadow.ratio.iter().all(|r| (r / UMBRA).ln().abs() < 0.04), "{:?}", shadow.ratio);
        assert!(shadow.alike > 0.7, "{}", shadow.alike);
        let (mut before, mut after, mut count) = (0.0, 0.0, 0.0);
        for i in 0..SIDE * SIDE {
            let (x, y) = ((i % SIDE) as f64 - 99.5, (i / SIDE) as f64 - 99.5);
            if (x.abs() < 12.0 && y.abs() < 12.0) || cast(x, y, 5.0) == 0.0 {
                continue;
            }
            let left = shadow.ratio[1].powf(f64::from(shadow.amount[i]));
            before += 110.0 * (1.0 - light(x, y));
            after += 110.0 * (light(x, y) / left - 1.0);
            count += 1.0;
        }
        let (before, after): (f64, f64) = (before / count, after / count);
        assert!(before > 30.0 && after.abs() <= 4.0, "{before} and {after} levels");
        let far = (0..SIDE * SIDE).filter(|i| cast((i % SIDE) as f64 - 99.5, (i / SIDE) as f64 - 99.5, 40.0) == 0.0);
        assert!(far.map(|i| shadow.amount[i]).fold(0.0, f32::max) == 0.0, "nothing far from it");
    }

    #[test]
    fn no_shadow_is_made_of_what_is_none() {
        let nothing = |what: &str, light: &dyn Fn(f64, f64) -> f64| {
            if let Verdict::Found(shadow) = look(light) {
                panic!("{what}: ratio {:?}, alike {:.2}", shadow.ratio, shadow.alike);
            }
        };
        nothing("an even floor", &|_, _| 1.0);
        // A slope of the light across the floor, as of a window.
        nothing("a slope", &|x, y| 1.0 - 0.002 * (x + y));
        nothing("a dark tile beside it", &|x, y| {
            if (12.0..62.0).contains(&x) && (-40.0..10.0).contains(&y) { 0.5 } else { 1.0 }
        });
        nothing("a dark tile under it", &|x, y| if x.abs() < 30.0 && y.abs() < 30.0 { 0.5 } else { 1.0 });
        nothing("a dark rug", &|x, _| if x > -20.0 { 0.6 } else { 1.0 });
        nothing("a line of contact", &|x, y| if x.abs() < 15.0 && y.abs() < 15.0 { 0.5 } else { 1.0 });
        // Another object's.
        nothing("a shadow elsewhere", &|x, y| 1.0 - (1.0 - UMBRA) * cast(x + 60.0, y - 55.0, 5.0));
    }

    /// What is as dark as a shadow where it would lie, but brown, is a stain.
    #[test]
    fn a_stain_has_another_colour() {
        let (mut log, object) = ground(|_, _| 1.0);
        for (i, log) in log.iter_mut().enumerate() {
            let amount = cast((i % SIDE) as f64 - 99.5, (i / SIDE) as f64 - 99.5, 5.0) as f32;
            log[1] -= 0.3 * amount;
            log[2] -= 0.9 * amount;
        }
        let verdict = find(&Ground { side: SIDE, log: &log, object: &object, height: HEIGHT });
        assert!(matches!(verdict, Verdict::Nothing(_)), "a stain");
    }
}

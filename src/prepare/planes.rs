//! What the surfaces around a hole are, and where in it one ends and the next begins.
//!
//! Inverse depth is linear over the picture of a plane. The planes around the hole are found by RANSAC (Fischler and
//! Bolles 1981) on the inverse depths there, the largest first; what lies on none of them is the rest. Every pixel, of the
//! hole too, then takes one of these surfaces by alpha expansion (Boykov et al. 2001): a known depth must fit, a surface
//! must not stand before the object nor where other views look through it, and borders are short. Along the
//! object's outline they are dear, as the object hides by chance what ends there. In the hole each surface is continued, with what it was off at its border spread inwards.

use glam::DVec2;
use rand::RngExt;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::min_cut::Grid;

/// Planes that are looked for.
const PLANES: usize = 6;
/// Least part of the known pixels that makes a plane.
const LEAST: f64 = 0.05;
/// An inverse depth lies on a plane if it differs by at most this part.
pub const THICKNESS: f64 = 0.02;
/// Triples of pixels that are tried for each plane.
const TRIES: usize = 500;
/// Known pixels that take part in the search.
const SAMPLES: usize = 6000;
/// Longer side of the grid that surfaces are chosen on, pixels.
const SIDE: usize = 320;
/// What a pixel off its surface costs at most, in thicknesses.
pub const OFF: f64 = 4.0;
/// What a pixel without a surface of its own costs: a plane that fits is preferred.
pub const REST: f64 = 1.5;
/// Cost of no surface in the hole, where nothing fits better or worse; and where no photograph tells anything of it: what is off
/// all planes around a hole, as most of what is rough is, would go on all over it.
const UNKNOWN_REST: [f64; 2] = [0.4, 2.0];
/// What a pixel costs where its surface is impossible.
pub const IMPOSSIBLE: f64 = 40.0;
/// What a border costs per pixel of its length.
const BORDER: f64 = 6.0;
/// How many times more it costs along the object's outline: a surface that ends just there would be a coincidence.
const COINCIDENCE: f64 = 4.0;
/// The part of that that a border costs where a straight one of what looks different goes on, and how far before it begins, pixels.
const GOES_ON: f64 = 0.25;
const BEFORE: f64 = 3.0;
/// Where photographs tell surfaces apart, the part of that that a border costs along which two planes meet; it costs all of it where they
/// are apart by this part of the inverse depth.
const MEETING: f64 = 0.25;
const GAP: f64 = 2.0 * THICKNESS;
/// Costs are whole numbers of this fraction.
const UNIT: f64 = 64.0;
/// Largest cost of a pair of nodes, in these fractions.
const MOST: f64 = 1e8;

/// The surroundings of a hole.
pub struct Hole<'a, F> {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// `[pixel]` inverse depth; anything that is not finite and positive is not known.
    pub disparity: &'a [f32],
    /// `[pixel]` x/z and y/z of the ray.
    pub rays: &'a [Option<[f64; 2]>],
    /// `[pixel]` whether it is to be filled; its inverse depth is not looked at.
    pub unknown: &'a [bool],
    /// `[pixel]` what each plane costs there, and at last to be off all of them, where more is known of that than the inverse
    /// depth. Empty where nothing is.
    pub costs: &'a [Option<Vec<f64>>],
    /// `[pixel]` whether it lies along the object's outline.
    pub outline: &'a [bool],
    /// Whether photographs tell what is in the hole.
    pub told: bool,
    /// Straight borders of what looks different that go into the hole, pixels: from where they do to where they come out of it, or would.
    pub borders: &'a [[DVec2; 2]],
    /// What speaks against a surface of this inverse depth at the pixel (its number): from 0, nothing, to 1, it cannot be.
    pub against: F,
}

/// The surface of every pixel.
pub struct Surfaces {
    /// `[pixel]` number of its surface, the last for what is on no plane.
    pub label: Vec<u8>,
    /// `[pixel]` inverse depth, the known ones as they were; NaN where nothing is known of the surface.
    pub disparity: Vec<f32>,
    /// The planes that were found: inverse depth by x/z, y/z and 1.
    pub planes: Vec<Plane>,
}

/// Inverse depth by x/z, y/z and 1.
pub type Plane = [f64; 3];

/// Inverse depth of a plane along a ray (x/z, y/z).
pub fn on(plane: &Plane, [x, y]: [f64; 2]) -> f64 {
    plane[0] * x + plane[1] * y + plane[2]
}

/// The plane of least squares, relative to the inverse depth.
fn fitted(points: &[([f64; 2], f64)]) -> Option<Plane> {
    let (mut normal, mut right) = (glam::DMat3::ZERO, glam::DVec3::ZERO);
    for ([x, y], d) in points {
        let row = glam::DVec3::new(*x, *y, 1.0) / *d;
        normal += glam::DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        right += row;
    }
    let solved = normal.inverse() * right;
    solved.is_finite().then(|| solved.to_array())
}

/// The largest planes among pixels (ray, inverse depth), the largest first, of at least this part of these, within this part of the
/// inverse depth.
fn planes(mut points: Vec<([f64; 2], f64)>, least: f64, thickness: f64, rng: &mut Pcg64) -> Vec<Plane> {
    let least = (least * points.len() as f64).ceil().max(12.0) as usize;
    let mut found = vec![];
    let fits = |plane: &Plane, (ray, d): &([f64; 2], f64)| (on(plane, *ray) - d).abs() <= thickness * d;
    while found.len() < PLANES && points.len() >= least {
        let mut best: (usize, Plane) = (0, [0.0; 3]);
        for _ in 0..TRIES {
            let three: [([f64; 2], f64); 3] = std::array::from_fn(|_| points[rng.random_range(0..points.len())]);
            let Some(plane) = fitted(&three) else { continue };
            let count = points.iter().filter(|point| fits(&plane, point)).count();
            if count > best.0 {
                best = (count, plane);
            }
        }
        let mut plane = best.1;
        for _ in 0..3 {
            let inliers: Vec<_> = points.iter().filter(|point| fits(&plane, point)).copied().collect();
            plane = fitted(&inliers).unwrap_or(plane);
        }
        let before = points.len();
        points.retain(|point| !fits(&plane, point));
        if before - points.len() < least {
            break;
        }
        found.push(plane);
    }
    found
}

/// The largest planes around a hole, the largest first, by what [`Hole`] says of its pixels. The same seed finds the same.
pub fn around(disparity: &[f32], rays: &[Option<[f64; 2]>], unknown: &[bool], seed: u64) -> Vec<Plane> {
    within(disparity, rays, unknown, [LEAST, THICKNESS], seed)
}

/// The largest planes of at least this share of the known pixels, within this part of the inverse depth, the largest first.
pub fn within(
    disparity: &[f32],
    rays: &[Option<[f64; 2]>],
    unknown: &[bool],
    [share, thickness]: [f64; 2],
    seed: u64,
) -> Vec<Plane> {
    let known = |i: usize| !unknown[i] && disparity[i] > 0.0 && disparity[i].is_finite();
    let all: Vec<usize> = (0..rays.len()).filter(|i| known(*i) && rays[*i].is_some()).collect();
    let every = all.len().div_ceil(SAMPLES).max(1);
    let points = all.iter().step_by(every).filter_map(|i| Some((rays[*i]?, f64::from(disparity[*i]))));
    planes(points.collect(), share, thickness, &mut Pcg64::new(seed.into(), 41))
}

/// Continues these planes, and what is beside them, in a hole.
pub fn surfaces<F: Fn(usize, f64) -> f64 + Sync>(hole: &Hole<'_, F>, planes: Vec<Plane>) -> Surfaces {
    let label = labels(hole, &planes);
    let disparity = continued(hole, &planes, &label);
    Surfaces { label, disparity, planes }
}

/// The surface of each pixel.
fn labels<F: Fn(usize, f64) -> f64 + Sync>(hole: &Hole<'_, F>, planes: &[Plane]) -> Vec<u8> {
    let [w, h] = hole.size;
    let stride = w.max(h).div_ceil(SIDE).max(1);
    let size @ [gw, gh] = [w.div_ceil(stride), h.div_ceil(stride)];
    let middle = |node: usize| {
        let [x, y] = [(node % gw) * stride + stride / 2, (node / gw) * stride + stride / 2];
        y.min(h - 1) * w + x.min(w - 1)
    };
    let rest = planes.len();
    let of = |node: usize| -> Vec<f64> {
        let i = middle(node);
        let Some(ray) = hole.rays[i] else { return vec![0.0; rest + 1] };
        if let Some(Some(costs)) = hole.costs.get(i) {
            return costs.clone();
        }
        let surfaces = planes.iter().map(|plane| on(plane, ray));
        if hole.unknown[i] {
            let against: Vec<f64> = surfaces.clone().map(|surface| (hole.against)(i, surface)).collect();
            // What speaks against all planes alike speaks against what is between them, too.
            let likely = against.iter().copied().filter(|against| *against < 0.5).reduce(f64::min);
            let of = |(surface, against): (f64, f64)| IMPOSSIBLE * if surface <= 0.0 { 1.0 } else { against };
            let of_rest = UNKNOWN_REST[usize::from(!hole.told)] + IMPOSSIBLE * likely.unwrap_or(0.0);
            return surfaces.zip(against).map(of).chain([of_rest]).collect();
        }
        let d = f64::from(hole.disparity[i]);
        let is_known = d > 0.0 && d.is_finite();
        let off = |surface: f64| if is_known { ((surface - d).abs() / (THICKNESS * d)).min(OFF) } else { 0.0 };
        surfaces.map(off).chain([REST]).collect()
    };
    let nodes = gw * gh;
    let outline: Vec<bool> = (0..nodes).map(|node| hole.outline[middle(node)]).collect();
    let scale = stride as f64;
    // A node stands for stride^2 pixels, an edge of the grid for a border of stride pixels.
    let of_nodes: Vec<Vec<f64>> = (0..nodes).into_par_iter().map(of).collect();
    let costs: Vec<Vec<f64>> =
        (0..=rest).map(|label| of_nodes.iter().map(|costs| scale * costs[label]).collect()).collect();
    let place = |node: usize| DVec2::new((middle(node) % w) as f64, (middle(node) / w) as f64) + 0.5;
    let goes_on = |p: usize, q: usize| {
        hole.borders.iter().any(|[from, to]| {
            let way = (to - from).normalize();
            let [[s, u], [t, v]] = [p, q].map(|node| [way.dot(place(node) - from), way.perp_dot(place(node) - from)]);
            u * v <= 0.0 && s.min(t) >= -BEFORE && s.max(t) <= from.distance(*to) + BEFORE
        })
    };
    let between = |[p, q]: [usize; 2]| {
        let times = match outline[p] || outline[q] {
            _ if goes_on(p, q) => GOES_ON,
            true => COINCIDENCE,
            false => 1.0,
        };
        BORDER * times * if hole.told { MEETING } else { 1.0 }
    };
    // Two planes meet in one line, and a border elsewhere is one of a surface that ends.
    let at = |node: usize, [a, b]: [usize; 2]| -> f64 {
        if !hole.told || a == b {
            return 0.0;
        }
        let inverse = |label: usize| Some(on(planes.get(label)?, hole.rays[middle(node)]?)).filter(|d| *d > 0.0);
        let gap = inverse(a).zip(inverse(b)).map_or(1.0, |(a, b)| ((a - b).abs() / (GAP * a.max(b))).min(1.0));
        0.5 * (1.0 - MEETING) * BORDER * gap * if outline[node] { COINCIDENCE } else { 1.0 }
    };
    let current = cheapest(&costs, &Border { between, at }, size);
    (0..w * h).map(|i| current[(i / w / stride) * gw + (i % w) / stride] as u8).collect()
}

/// Cost of a border between two labels for each unit of its length.
pub struct Border<B, A> {
    /// Between two nodes, whichever their labels.
    pub between: B,
    /// More at each of the two nodes, by the two labels in either order.
    pub at: A,
}

/// The labels of least cost on a grid, by alpha expansion: `costs` `[label][node]`.
pub fn cheapest<B, A>(costs: &[Vec<f64>], border: &Border<B, A>, size: [usize; 2]) -> Vec<usize>
where
    B: Fn([usize; 2]) -> f64,
    A: Fn(usize, [usize; 2]) -> f64,
{
    let labels = costs.len();
    let units: Vec<Vec<i64>> = costs.iter().map(|of| of.iter().map(|cost| (UNIT * cost) as i64).collect()).collect();
    let least = |node: usize| (0..labels).min_by_key(|label| units[*label][node]).unwrap_or(0);
    let mut current: Vec<usize> = (0..size[0] * size[1]).map(least).collect();
    // Until no label has been taken anywhere since it was tried last.
    let mut unchanged = 0;
    for alpha in (0..labels).cycle().take(ROUNDS * labels) {
        unchanged = if expand(&mut current, alpha, &units, border, size) { 0 } else { unchanged + 1 };
        if unchanged == labels {
            break;
        }
    }
    current
}

/// How often each label is tried at most.
const ROUNDS: usize = 3;

/// Sixteen neighbours: with eight, the staircases between two points within half a right angle are as short as the line.
const SHIFTS: [[isize; 2]; 16] = [
    [-1, -2],
    [1, -2],
    [-2, -1],
    [-1, -1],
    [0, -1],
    [1, -1],
    [2, -1],
    [-1, 0],
    [1, 0],
    [-2, 1],
    [-1, 1],
    [0, 1],
    [1, 1],
    [2, 1],
    [-1, 2],
    [1, 2],
];

/// What an edge of the grid adds to the length of a border across it: half the angle to its neighbours in direction, over
/// the edge's length (Boykov and Kolmogorov 2003).
fn length(dx: isize, dy: isize) -> f64 {
    let knight = 0.5f64.atan();
    let quarter = std::f64::consts::FRAC_PI_4;
    let angle = match dx.abs() + dy.abs() {
        1 => knight,
        2 => quarter - knight,
        _ => quarter / 2.0,
    };
    0.5 * angle / f64::hypot(dx as f64, dy as f64)
}

/// Every pixel keeps its label or takes `alpha`, as is cheapest: one minimum cut (Kolmogorov and Zabih 2004). Returns whether any
/// takes it.
fn expand<B, A>(
    current: &mut [usize],
    alpha: usize,
    units: &[Vec<i64>],
    Border { between, at }: &Border<B, A>,
    size @ [w, h]: [usize; 2],
) -> bool
where
    B: Fn([usize; 2]) -> f64,
    A: Fn(usize, [usize; 2]) -> f64,
{
    let mut grid = Grid::new(size, &SHIFTS);
    let scales = SHIFTS.map(|[dx, dy]| UNIT * length(dx, dy));
    // Of keeping, minus of taking alpha.
    let mut gain: Vec<i64> = (0..current.len()).map(|i| units[current[i]][i] - units[alpha][i]).collect();
    let own: Vec<f64> = current.iter().enumerate().map(|(i, label)| at(i, [*label, alpha])).collect();
    for p in 0..current.len() {
        for (d, [dx, dy]) in SHIFTS.into_iter().enumerate().skip(8) {
            let (x, y) = ((p % w) as isize + dx, (p / w) as isize + dy);
            if x < 0 || x >= w as isize || y >= h as isize {
                continue;
            }
            let q = y as usize * w + x as usize;
            let price = |cost: f64| (scales[d] * cost).min(MOST) as i64;
            let (keep, take_p, take_q) = if current[p] == current[q] {
                // On either side the border is between the same two labels.
                let take = if current[p] == alpha { 0 } else { price(between([p, q]) + (own[p] + own[q])) };
                (0, take, take)
            } else {
                let differ = |labels @ [a, b]: [usize; 2]| {
                    if a == b { 0 } else { price(between([p, q]) + (at(p, labels) + at(q, labels))) }
                };
                (differ([current[p], current[q]]), differ([alpha, current[q]]), differ([current[p], alpha]))
            };
            gain[p] += keep - take_p;
            gain[q] += take_p;
            // A border that is no metric is made one: what would be negative is 0.
            grid.set_arc(q, SHIFTS.len() - 1 - d, (take_q + take_p - keep).max(0) as i32);
        }
    }
    for (i, gain) in gain.into_iter().enumerate() {
        grid.set_terminals(i, gain, 0);
    }
    let mut taken = false;
    for (label, takes) in current.iter_mut().zip(grid.cut()) {
        if takes && *label != alpha {
            *label = alpha;
            taken = true;
        }
    }
    taken
}

/// Each surface's inverse depth in the hole: its plane, and on it a membrane over what known pixels are off from it.
fn continued<F>(hole: &Hole<'_, F>, planes: &[Plane], label: &[u8]) -> Vec<f32> {
    let mut out = hole.disparity.to_vec();
    for surface in 0..=planes.len() {
        let of = |i: usize| match (planes.get(surface), hole.rays[i]) {
            (Some(plane), Some(ray)) => on(plane, ray) as f32,
            _ => 0.0,
        };
        let mut off: Vec<f32> = (0..label.len())
            .map(|i| {
                let own = label[i] as usize == surface && !hole.unknown[i] && hole.disparity[i] > 0.0;
                let off = hole.disparity[i] - of(i);
                // What is short or thin has the surface of its surroundings without lying on it.
                let on_it = surface == planes.len() || off.abs() <= THICKNESS as f32 * hole.disparity[i];
                if own && on_it { off } else { f32::NAN }
            })
            .collect();
        let wanted = |i: usize| label[i] as usize == surface && hole.unknown[i];
        membrane(&mut off, hole.size, wanted);
        for i in (0..label.len()).filter(|i| wanted(*i)) {
            // A surface that touches the hole nowhere is its plane alone.
            let value = of(i) + if off[i].is_finite() || planes.get(surface).is_none() { off[i] } else { 0.0 };
            out[i] = if value > 0.0 { value } else { f32::NAN };
        }
    }
    out
}

/// The pixels to the left and right of one, above and below it.
pub fn neighbours(i: usize, [w, h]: [usize; 2]) -> impl Iterator<Item = usize> {
    let (x, y) = (i % w, i / w);
    [(x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1), (y > 0).then(|| i - w), (y + 1 < h).then(|| i + w)]
        .into_iter()
        .flatten()
}

/// The pixels that hang together with one, by their sides, of those that are left; they are left no more.
pub fn connected(first: usize, left: &mut [bool], size: [usize; 2]) -> Vec<usize> {
    connected_if(first, left, size, |_, _| true)
}

/// The pixels that hang together with one through neighbours that are joined, of those that are left; they are left no more.
pub fn connected_if(
    first: usize,
    left: &mut [bool],
    size: [usize; 2],
    joined: impl Fn(usize, usize) -> bool,
) -> Vec<usize> {
    let mut part: Vec<usize> = Some(first).filter(|i| std::mem::take(&mut left[*i])).into_iter().collect();
    let mut at = 0;
    while at < part.len() {
        let own = part[at];
        part.extend(neighbours(own, size).filter(|i| joined(own, *i) && std::mem::take(&mut left[*i])));
        at += 1;
    }
    part
}

/// Fills what is not a number with a membrane over what is: values spread inwards, then settle to the mean of their
/// neighbours. Only pixels for which `wanted` says so are filled.
pub fn membrane(values: &mut [f32], size: [usize; 2], wanted: impl Fn(usize) -> bool) {
    let [w, h] = size;
    let missing: Vec<usize> = (0..w * h).filter(|i| !values[*i].is_finite() && wanted(*i)).collect();
    let neighbours = |i: usize| neighbours(i, size);
    let mut left = missing.clone();
    while !left.is_empty() {
        let mut ring = vec![];
        for &i in &left {
            let known: Vec<f32> = neighbours(i).map(|j| values[j]).filter(|v| v.is_finite()).collect();
            if !known.is_empty() {
                ring.push((i, known.iter().sum::<f32>() / known.len() as f32));
            }
        }
        if ring.is_empty() {
            return;
        }
        for (i, value) in ring {
            values[i] = value;
        }
        left.retain(|i| !values[*i].is_finite());
    }
    for _ in 0..300 {
        for &i in &missing {
            let (sum, count) = neighbours(i)
                .map(|j| values[j])
                .filter(|v| v.is_finite())
                .fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0));
            if count > 0.0 {
                values[i] = sum / count;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [120, 90];

    fn rays() -> Vec<Option<[f64; 2]>> {
        (0..SIZE[0] * SIZE[1])
            .map(|i| Some([(i % SIZE[0]) as f64 / 100.0 - 0.6, (i / SIZE[0]) as f64 / 100.0 - 0.45]))
            .collect()
    }

    /// The pixels of the hole at its border.
    fn outline(unknown: &[bool]) -> Vec<bool> {
        let at = |x: usize, y: usize| unknown[y.min(SIZE[1] - 1) * SIZE[0] + x.min(SIZE[0] - 1)];
        (0..unknown.len())
            .map(|i| {
                let (x, y) = (i % SIZE[0], i / SIZE[0]);
                let around = [at(x + 1, y), at(x.saturating_sub(1), y), at(x, y + 1), at(x, y.saturating_sub(1))];
                unknown[i] && around.contains(&false)
            })
            .collect()
    }

    /// Finds the surfaces in a hole against which nothing speaks.
    fn continued_in(seen: &[f32], unknown: &[bool]) -> Surfaces {
        let (rays, outline) = (rays(), outline(unknown));
        let hole = Hole {
            size: SIZE,
            disparity: seen,
            rays: &rays,
            unknown,
            costs: &[],
            outline: &outline,
            told: false,
            borders: &[],
            against: |_, _| 0.0,
        };
        surfaces(&hole, around(seen, &rays, unknown, 5))
    }

    /// A floor, and a table top above it that ends in the hole along a line: both go on as planes, and the border is the
    /// straight line between where it enters the hole and where it leaves it.
    #[test]
    fn two_planes_meet_in_the_hole_along_a_straight_line() {
        let rays = rays();
        let table = |i: usize| (i % SIZE[0]) < 20 + (i / SIZE[0]) / 2;
        let truth: Vec<f32> = rays
            .iter()
            .enumerate()
            .map(|(i, ray)| {
                let [_, y] = ray.unwrap();
                (if table(i) { 0.40 + 0.5 * y } else { 0.28 + 0.35 * y }) as f32
            })
            .collect();
        let unknown: Vec<bool> =
            (0..truth.len()).map(|i| (30..80).contains(&(i % SIZE[0])) && (20..70).contains(&(i / SIZE[0]))).collect();
        let seen: Vec<f32> = truth.iter().zip(&unknown).map(|(d, u)| if *u { f32::NAN } else { *d }).collect();
        let found = continued_in(&seen, &unknown);
        assert_eq!(found.planes.len(), 2, "planes");
        let wrong = (0..truth.len()).filter(|i| unknown[*i] && (found.disparity[*i] / truth[*i] - 1.0).abs() > 0.01);
        let border = |i: usize| {
            let at = 20.0 + (i / SIZE[0]) as f64 / 2.0;
            ((i % SIZE[0]) as f64 - at).abs() < 4.0
        };
        let wrong: Vec<usize> = wrong.filter(|i| !border(*i)).collect();
        assert!(wrong.is_empty(), "{} pixels off the border are wrong", wrong.len());
        assert!(found.disparity.iter().all(|d| d.is_finite()));
    }

    /// A hole that is mostly in what is rough, as most of a garden is: the plane beside it goes on in it.
    #[test]
    fn what_is_rough_does_not_go_on() {
        let rays = rays();
        let rough = |i: usize| (i.wrapping_mul(2_654_435_761) >> 9) as f32 % 1000.0 / 1000.0;
        let seen: Vec<f32> = (0..rays.len())
            .map(|i| match (i % SIZE[0], i / SIZE[0]) {
                (40..80, 30..60) => f32::NAN,
                (0..40, _) => 0.4 + 0.3 * rays[i].unwrap()[1] as f32,
                _ => 0.15 + 0.4 * rough(i),
            })
            .collect();
        let unknown: Vec<bool> = seen.iter().map(|d| d.is_nan()).collect();
        let found = continued_in(&seen, &unknown);
        let on_it = (0..seen.len()).filter(|i| unknown[*i] && found.label[*i] == 0).count();
        assert!(on_it > 1000, "{on_it} of 1200 pixels");
    }

    /// Where other views look through the table top, the floor goes on: the hole is all floor but for its left edge.
    #[test]
    fn a_surface_ends_where_other_views_look_through_it() {
        let rays = rays();
        let truth: Vec<f32> = (0..rays.len()).map(|i| if i % SIZE[0] < 60 { 0.5f32 } else { 0.25 }).collect();
        let unknown: Vec<bool> =
            (0..truth.len()).map(|i| (40..80).contains(&(i % SIZE[0])) && (20..70).contains(&(i / SIZE[0]))).collect();
        let against = |i: usize, d: f64| if d > 0.4 && i % SIZE[0] >= 45 { 1.0 } else { 0.0 };
        let outline = outline(&unknown);
        let hole = Hole {
            size: SIZE,
            disparity: &truth,
            rays: &rays,
            unknown: &unknown,
            costs: &[],
            outline: &outline,
            told: false,
            borders: &[],
            against,
        };
        let found = surfaces(&hole, around(hole.disparity, hole.rays, hole.unknown, 5));
        for i in (0..truth.len()).filter(|i| unknown[*i] && (40..50).contains(&(i / SIZE[0]))) {
            let expected = if i % SIZE[0] < 45 { 0.5 } else { 0.25 };
            let near = (44..47).contains(&(i % SIZE[0]));
            assert!(near || (found.disparity[i] - expected).abs() < 0.01, "{} {}", i % SIZE[0], found.disparity[i]);
        }
    }

    /// A table top that enters the hole from the left, between a floor above and below: it ends within the hole and not
    /// along its outline, neither at once nor at the far side.
    #[test]
    fn no_surface_ends_along_the_outline() {
        let rays = rays();
        let table = |i: usize| i % SIZE[0] < 60 && (35..55).contains(&(i / SIZE[0]));
        let truth: Vec<f32> = (0..rays.len()).map(|i| if table(i) { 0.5 } else { 0.25 }).collect();
        let unknown: Vec<bool> =
            (0..truth.len()).map(|i| (40..80).contains(&(i % SIZE[0])) && (20..70).contains(&(i / SIZE[0]))).collect();
        let outline = outline(&unknown);
        let hole = Hole {
            size: SIZE,
            disparity: &truth,
            rays: &rays,
            unknown: &unknown,
            costs: &[],
            outline: &outline,
            told: false,
            borders: &[],
            against: |_, _| 0.0,
        };
        let found = surfaces(&hole, around(hole.disparity, hole.rays, hole.unknown, 5));
        let ends = (40..80).find(|x| (found.disparity[45 * SIZE[0] + x] - 0.25).abs() < 0.01);
        assert!(ends.is_some_and(|x| (42..70).contains(&x)), "{ends:?}");
    }

    #[test]
    fn nothing_known_is_no_fault() {
        let rays = rays();
        let nothing = vec![f32::NAN; rays.len()];
        let unknown = vec![true; rays.len()];
        let outline = outline(&unknown);
        let hole = Hole {
            size: SIZE,
            disparity: &nothing,
            rays: &rays,
            unknown: &unknown,
            costs: &[],
            outline: &outline,
            told: false,
            borders: &[],
            against: |_, _| 0.0,
        };
        let found = surfaces(&hole, around(hole.disparity, hole.rays, hole.unknown, 0));
        assert!(found.planes.is_empty());
        assert!(found.disparity.iter().all(|d| d.is_nan()));
    }

    /// A linear ramp with a gap is linear again: a membrane over it has no curvature.
    #[test]
    fn a_membrane_continues_a_slope() {
        let ramp = |i: usize| (i % 12) as f32 + 1.0;
        let mut values: Vec<f32> = (0..12 * 9).map(ramp).collect();
        for y in 2..7 {
            for x in 4..8 {
                values[y * 12 + x] = f32::NAN;
            }
        }
        membrane(&mut values, [12, 9], |_| true);
        assert!(values.iter().enumerate().all(|(i, v)| (v - ramp(i)).abs() < 1e-3));
        let mut nothing = vec![f32::NAN; 4];
        membrane(&mut nothing, [2, 2], |_| true);
        assert!(nothing.iter().all(|v| v.is_nan()));
    }
}

//! How well the pictures agree on a plane.

use super::{CANDIDATES, Grid, STRIDE, Sites};
use crate::gpu::kernels::multiview::score;
use crate::gpu::{Buffer, Check, Recorder, Reference};

/// Views that a picture is compared with.
pub(super) const VIEWS: usize = 4;
/// Elements of the relation to these.
pub(super) const RELATION: usize = 14;

// As in the kernel.
const HALF_WINDOW: i32 = 2;
const SPACING: i32 = 2;
const COLOR: f64 = 1.0 / 12.0;
const DISTANCE: f64 = 0.05;
const NOISE: f64 = 4.0;
const MARGIN: f64 = 1.0;
/// Score of what no other view sees.
pub(super) const WORST: f32 = 2.0;

/// Four grey values of an element.
fn corners(word: u32) -> [f64; 4] {
    word.to_le_bytes().map(f64::from)
}

/// Where a pixel of an inverse depth is seen by view `k`, before the division.
fn place(relation: &[[f32; 4]], k: usize, [x, y]: [f64; 2], inverse: f64) -> [f64; 3] {
    let of = |e: usize| f64::from(relation[e][k]);
    std::array::from_fn(|row| of(4 * row) * x + of(4 * row + 1) * y + of(4 * row + 2) + of(4 * row + 3) * inverse)
}

impl Reference for score::Kernel {
    fn reference(host: score::Host<'_>, push: score::Push, (): ()) {
        let sites = Sites { columns: push.sites[0], rows: push.sites[1] };
        let n = sites.of_color();
        let [w, h] = push.size.map(|n| n as i32);
        let views: [&[u32]; VIEWS] = [host.first, host.second, host.third, host.fourth];
        let grey = |x: i32, y: i32| corners(host.picture[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize])[0];
        for (k, (i, column, row)) in (0..CANDIDATES).flat_map(|k| sites.colored(push.color).map(move |site| (k, site)))
        {
            let [x, y] = [column, row].map(|c| (c * push.stride + push.stride / 2) as i32);
            let center = grey(x, y);
            let [w0, wx, wy] = host.candidate[(k * n + i) as usize].map(f64::from);
            let one = |view: usize| -> f64 {
                let size: [f64; 2] = std::array::from_fn(|axis| f64::from(host.relation[12 + axis][view]));
                let at = |dx: f64, dy: f64| {
                    let pixel = [f64::from(x) + 0.5 + dx, f64::from(y) + 0.5 + dy];
                    place(host.relation, view, pixel, w0 + wx * dx + wy * dy)
                };
                let q = at(0.0, 0.0);
                let p = [q[0] / q[2], q[1] / q[2]];
                let seen = q[2] > 0.0 && (0..2).all(|a| p[a] > MARGIN && p[a] < size[a] - MARGIN);
                if !seen {
                    return f64::from(WORST);
                }
                // All but the division is linear in the pixel.
                let slope = |q1: [f64; 3]| -> [f64; 2] {
                    std::array::from_fn(|a| ((q1[a] - q[a]) - p[a] * (q1[2] - q[2])) / q[2])
                };
                let (along_x, along_y) = (slope(at(1.0, 0.0)), slope(at(0.0, 1.0)));
                let [mut sum, mut a1, mut a2, mut b1, mut b2, mut ab] = [0.0; 6];
                for (i, j) in
                    (-HALF_WINDOW..=HALF_WINDOW).flat_map(|j| (-HALF_WINDOW..=HALF_WINDOW).map(move |i| (i, j)))
                {
                    let [i, j] = [i * SPACING, j * SPACING];
                    let (dx, dy) = (f64::from(i), f64::from(j));
                    let a = grey(x + i, y + j) - center;
                    let weight = 1.0 / ((1.0 + (a * COLOR).powi(2)) * (1.0 + DISTANCE * (dx * dx + dy * dy)));
                    let at: [f64; 2] = std::array::from_fn(|axis| {
                        let place = p[axis] - 0.5 + along_x[axis] * dx + along_y[axis] * dy;
                        place.clamp(0.0, (size[axis] - 1.01).max(0.0))
                    });
                    let element = at[1].floor() as usize * size[0] as usize + at[0].floor() as usize;
                    let [fx, fy] = at.map(f64::fract);
                    let four = corners(views[view][element]);
                    let upper = four[0] + (four[1] - four[0]) * fx;
                    let lower = four[2] + (four[3] - four[2]) * fx;
                    let b = upper + (lower - upper) * fy - center;
                    sum += weight;
                    a1 += weight * a;
                    a2 += weight * a * a;
                    b1 += weight * b;
                    b2 += weight * b * b;
                    ab += weight * a * b;
                }
                let [a1, a2, b1, b2, ab] = [a1, a2, b1, b2, ab].map(|s| s / sum);
                let (va, vb) = ((a2 - a1 * a1).max(0.0) + NOISE, (b2 - b1 * b1).max(0.0) + NOISE);
                1.0 - (ab - a1 * b1) / (va * vb).sqrt()
            };
            let mut costs: [f64; VIEWS] = std::array::from_fn(one);
            costs.sort_by(f64::total_cmp);
            let score = if push.views == 1 { costs[0] } else { 0.5 * (costs[0] + costs[1]) };
            host.score[(k * n + i) as usize] = score as f32;
        }
    }

    fn check(_binding: &'static str) -> Check {
        // A place among 512 pixels is off by some ten roundings, 3e-4 px, and a grey value by that times the difference of
        // neighbouring pixels, at most 255: by 0.08 or, as a share of the least deviation that counts, 2, by 4 %. Errors of
        // 25 samples do not point one way, and steps of 255 have large deviations: 2e-3 of the worst score, 2. Which pixels
        // a view sees is a decision at the border.
        Check { relative: 0.0, absolute: 1e-3, band: 2e-3 }
    }
}

/// A view's picture and those that it is compared with.
#[derive(Clone, Copy)]
pub(super) struct Pictures<'a> {
    /// Its own elements.
    pub own: &'a Buffer<u32>,
    /// The others'; its own where there are fewer.
    pub others: [&'a Buffer<u32>; VIEWS],
    /// How these see it, `[RELATION]`.
    pub relation: &'a Buffer<[f32; 4]>,
    /// How many there are.
    pub views: u32,
}

/// Records the scores of the planes tried at the sites of one colour.
pub(super) fn record(
    rec: &mut Recorder<'_>,
    of: Pictures<'_>,
    candidate: &Buffer<[f32; 3]>,
    score: &Buffer<f32>,
    grid: &Grid,
    color: u32,
) {
    let [first, second, third, fourth] = of.others;
    let buffers =
        score::Buffers { picture: of.own, first, second, third, fourth, relation: of.relation, candidate, score };
    let Sites { columns, rows } = grid.sites;
    let push = score::Push { size: grid.size, sites: [columns, rows], color, stride: STRIDE, views: of.views };
    rec.run(score::Kernel, buffers, push, grid.sites.of_color() * CANDIDATES);
}

#[cfg(test)]
mod tests {
    use super::super::picture::elements;
    use super::*;
    use crate::gpu::testing;
    use rand::{RngExt, SeedableRng};

    /// Waves seen from five places, on planes near and far from the true one, some of which leave the pictures.
    #[test]
    fn the_kernel_matches_its_twin() {
        let gpu = testing::gpu();
        let mut rng = rand_pcg::Pcg32::seed_from_u64(5);
        let [w, h] = [61_u32, 46];
        let picture = |shift: f64| -> Vec<u32> {
            let grey = |x: u32, y: u32| {
                let (x, y) = (f64::from(x) + shift, f64::from(y));
                (127.0 + 60.0 * (0.4 * x + 0.1 * y).sin() + 50.0 * (0.3 * y - 0.15 * x).cos()) as u8
            };
            let grey: Vec<u8> = (0..h).flat_map(|y| (0..w).map(move |x| grey(x, y))).collect();
            elements(&grey, [w, h])
        };
        let sites = Sites { columns: w / STRIDE, rows: h / STRIDE };
        for views in [1, 3, 4] {
            // A view beside the first sees the pixel (x, y) of inverse depth w at (x + b w, y).
            let mut relation = vec![[0.0; 4]; RELATION];
            let seen = |k: usize| if k < views as usize { 1.0 } else { 0.0 };
            let each = |value: fn(f32) -> f32| std::array::from_fn(|k| seen(k) * value(k as f32));
            for (e, value) in [(0, 1.0), (5, 1.0), (10, 1.0), (12, w as f32), (13, h as f32)] {
                relation[e] = std::array::from_fn(|k| seen(k) * value);
            }
            relation[3] = each(|k| 8.0 * (k - 1.2));
            relation[8] = each(|k| 1e-4 * k);
            for color in [0, 1] {
                let n = (sites.of_color() * CANDIDATES) as usize;
                let candidate = (0..n)
                    .map(|_| [rng.random_range(0.1..2.0), rng.random_range(-0.02..0.02), rng.random_range(-0.02..0.02)])
                    .collect();
                let case = score::Arrays {
                    picture: picture(0.0),
                    first: picture(3.0),
                    second: picture(-2.0),
                    third: picture(-9.0),
                    fourth: picture(-17.0),
                    relation: relation.clone(),
                    candidate,
                    score: vec![testing::UNWRITTEN; n],
                };
                let push =
                    score::Push { size: [w, h], sites: [sites.columns, sites.rows], color, stride: STRIDE, views };
                testing::assert_twin(score::Kernel, &gpu, case, push, sites.of_color() * CANDIDATES);
            }
        }
    }
}

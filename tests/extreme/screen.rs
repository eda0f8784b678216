//! Binning and blending: stacks, thresholds, crowded tiles, needles across wide pictures, each on every tiling that the
//! device can run, against a dense float64 blending of the same float32 Gaussians.
//!
//! # Bounds
//! With u = 2^-24, at a sample with `q = a^2 / N + dy^2 / V`, `a = dx - k dy`: a is off by 2 u (|dx| + 2 |k dy|), so the
//! exponent by `sqrt(q / N)` times that and 4 u q; Vulkan's exponential by 3 + 2 |q / 2| units in the last place (2 u
//! each); alpha by the sum e, relative. A colour in \[0, 1\] changes by at most T_i times an error of alpha_i, since what
//! lies behind is in \[0, 1\] too, and the n roundings of the transmittance and of the sum add 4 n u. A sample within its error
//! of 1/255 may be blended or not (1/255 of T_i), and a pixel within its error of the last transmittance may stop one
//! Gaussian earlier or later (all of T that is left, less than 1e-4 / (1 - alpha)).
//!
//! Backward, dL/dalpha_i = T_i v_i - (S - A_i) / (1 - alpha_i): the two terms are good to the relative error of T, which is
//! the sum of the e_j alpha_j / (1 - alpha_j) before i and 2 i u, and the running difference to the same and 4 n u of
//! |S| and all |w_j v_j|.

use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::primitives::Count;
use gscream_vk::primitives::limit::Limits;
use gscream_vk::render::bin::Bin;
use gscream_vk::render::project::Projected;
use gscream_vk::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use gscream_vk::render::slots::Slots;
use gscream_vk::render::tiling::Tiling;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::Case;
use crate::project::U;

pub const CASES: &[Case] = &[
    Case {
        stage: "bin, rasterize",
        case: "needles of axis ratio 1e4 and more across a picture 8191 wide",
        guarantee: "colours within a bound proportional to the distance along the needle, 3e-6 of the exponent per px, not to its square",
        run: needles,
    },
    Case {
        stage: "bin, rasterize",
        case: "100,000 Gaussians on one pixel, of opacity 1 - 1e-7 and of 0.0045",
        guarantee: "colour, depth, transmittance and gradients within 4 n 2^-24 and the exponentials' errors for the n <= 2345 that are blended; gradients of exactly 0 behind them",
        run: stack,
    },
    Case {
        stage: "bin, rasterize",
        case: "opacity just below, at and just above 1/255",
        guarantee: "drawn exactly from the float32 nearest to 1/255 on, where exp(0) is exactly 1; otherwise decided within 3 units in the last place",
        run: edge,
    },
    Case {
        stage: "bin, rasterize",
        case: "samples on the edge of a support and of a tile",
        guarantee: "the same picture to the bit whatever the tiles: culling decides no pixel",
        run: rims,
    },
    Case {
        stage: "bin, rasterize",
        case: "a million pairs in one tile",
        guarantee: "the list is a stable sort by depth; picture and gradients within the bounds",
        run: crowded,
    },
    Case {
        stage: "bin",
        case: "equal depths by the thousand",
        guarantee: "every tile's list is in the order of depth, then of the slot's number",
        run: equal_depths,
    },
    Case {
        stage: "bin, rasterize",
        case: "means to 2^60 px away and deviations to 2^60 px",
        guarantee: "no tile outside the picture; colours and gradients finite and within the bounds",
        run: enormous,
    },
    Case {
        stage: "bin, rasterize",
        case: "zero Gaussians, one, and none that exists",
        guarantee: "the background to the bit, or the one Gaussian within the bounds; gradients of what is absent exactly 0",
        run: few,
    },
    Case {
        stage: "bin, rasterize",
        case: "pictures of 1 x 1, 17 x 3, 8191 x 3 and 3 x 8191",
        guarantee: "every pixel written and within the bounds, the same whatever the tiles",
        run: shapes,
    },
];

/// Gaussians in screen space.
#[derive(Clone, Default)]
pub struct Splats {
    pub mean: Vec<[f32; 2]>,
    /// Factored.
    pub covariance: Vec<[f32; 3]>,
    pub depth: Vec<f32>,
    pub opacity: Vec<f32>,
    pub color: Vec<[f32; 3]>,
}

impl Splats {
    fn push(&mut self, mean: [f32; 2], covariance: [f32; 3], depth: f32, opacity: f32, color: [f32; 3]) {
        self.mean.push(mean);
        self.covariance.push(covariance);
        self.depth.push(depth);
        self.opacity.push(opacity);
        self.color.push(color);
    }

    fn order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.depth.len()).filter(|&s| self.depth[s] > 0.0).collect();
        order.sort_by(|&a, &b| self.depth[a].total_cmp(&self.depth[b]));
        order
    }
}

pub const BACKGROUND: [f32; 3] = [0.1, 0.7, 0.4];

/// Upstream gradient of a pixel: of colour, depth and transmittance, each at most 1 but for the depth's, which is in
/// units of the depth.
fn upstream(pixel: usize, farthest: f32) -> ([f32; 3], f32, f32) {
    let mut rng = Pcg64Mcg::seed_from_u64(pixel as u64);
    let mut one = || rng.random_range(-1f32..1.0);
    ([one(), one(), one()], one() / farthest, one())
}

/// What came back from the device.
struct Drawn {
    rgb: Vec<[f32; 3]>,
    depth: Vec<f32>,
    transmittance: Vec<f32>,
    grad_mean: Vec<[f32; 2]>,
    grad_covariance: Vec<[f32; 3]>,
    grad_opacity: Vec<f32>,
    grad_color: Vec<[f32; 3]>,
    grad_depth: Vec<f32>,
    /// Slots of every tile's list.
    lists: Vec<Vec<u32>>,
}

pub fn tilings(gpu: &Gpu) -> &'static [Tiling] {
    if gpu.info().subgroup_size == 8 { &[Tiling::Wide, Tiling::Narrow] } else { &[Tiling::Wide] }
}

fn draw(gpu: &Gpu, tiling: Tiling, size: [u32; 2], splats: &Splats, pairs: u32) -> Drawn {
    let fine = "the device runs the case";
    let n = splats.mean.len() as u32;
    let pixels = (size[0] * size[1]) as usize;
    let farthest = splats.depth.iter().fold(1f32, |m, v| m.max(*v));
    // Buffers hold at least one element.
    let mut padded = splats.clone();
    if n == 0 {
        padded.push([testing::UNWRITTEN; 2], [testing::UNWRITTEN; 3], 1.0, 1.0, [testing::UNWRITTEN; 3]);
    }
    let mean = gpu.upload("mean", &padded.mean).expect(fine);
    let covariance = gpu.upload("covariance", &padded.covariance).expect(fine);
    let depth = gpu.upload("depth", &padded.depth).expect(fine);
    let opacity = gpu.upload("opacity", &padded.opacity).expect(fine);
    let color = gpu.upload("color", &padded.color).expect(fine);
    let limits = Limits::new(gpu).expect(fine);
    let count = gpu.upload("count", &[n]).expect(fine);
    let existing = Slots::all(gpu, n).expect(fine);
    let bin = Bin::new(gpu, tiling, n.max(1), pairs, size).expect(fine);
    let mut picture = Picture::new(gpu, size, pixels, Outputs::Transmittance).expect(fine);
    picture.rgb = gpu.upload("rgb", &vec![[testing::UNWRITTEN; 3]; pixels]).expect(fine);
    let backward = Backward::new(gpu, tiling, n.max(1) as usize, pairs as usize, Outputs::Transmittance).expect(fine);
    let up: Vec<_> = (0..pixels).map(|p| upstream(p, farthest)).collect();
    let grad_rgb = gpu.upload("grad_rgb", &up.iter().map(|u| u.0).collect::<Vec<_>>()).expect(fine);
    let grad_z = gpu.upload("grad_depth_map", &up.iter().map(|u| u.1).collect::<Vec<_>>()).expect(fine);
    let grad_t = gpu.upload("grad_transmittance", &up.iter().map(|u| u.2).collect::<Vec<_>>()).expect(fine);
    let mut rec = gpu.recorder().expect(fine);
    let projected = Projected {
        slots: Count::Device(&count),
        existing: &existing,
        mean: &mean,
        covariance: &covariance,
        depth: &depth,
        opacity: &opacity,
        color: &color,
    };
    let binned = bin.record(&mut rec, projected, size, &limits);
    rasterize::forward(&mut rec, tiling, projected, binned, BACKGROUND, &picture);
    let gradient = PictureGradient { rgb: &grad_rgb, depth: Some(&grad_z), transmittance: Some(&grad_t) };
    // What touches no tile is not written: no gradient.
    rec.zero(&backward.grad_mean);
    rec.zero(&backward.grad_covariance);
    rec.zero(&backward.grad_opacity);
    rec.zero(&backward.grad_color);
    backward.grad_depth.iter().for_each(|grad_depth| rec.zero(grad_depth));
    backward.record(&mut rec, tiling, projected, binned, &picture, gradient);
    rec.submit().expect(fine).wait().expect(fine);
    let counters = gpu.read(limits.counters()).expect(fine);
    assert_eq!(gpu.read(limits.overflow()).expect(fine), [0], "room for {pairs} pairs, counted {counters:?}");
    let (z, t) = picture.depth.as_ref().zip(picture.transmittance.as_ref()).expect("asked for");
    let grid = tiling.grid(size);
    let (sorted, pair_slot) = (gpu.read(binned.sorted).expect(fine), gpu.read(binned.pair_slot).expect(fine));
    let lists = gpu.read(binned.ranges).expect(fine)[..(grid[0] * grid[1]) as usize]
        .iter()
        .map(|&[a, b]| sorted[a as usize..b as usize].iter().map(|&p| pair_slot[p as usize]).collect())
        .collect();
    let keep = n as usize;
    Drawn {
        rgb: gpu.read(&picture.rgb).expect(fine),
        depth: gpu.read(z).expect(fine),
        transmittance: gpu.read(t).expect(fine),
        grad_mean: gpu.read(&backward.grad_mean).expect(fine)[..keep].to_vec(),
        grad_covariance: gpu.read(&backward.grad_covariance).expect(fine)[..keep].to_vec(),
        grad_opacity: gpu.read(&backward.grad_opacity).expect(fine)[..keep].to_vec(),
        grad_color: gpu.read(&backward.grad_color).expect(fine)[..keep].to_vec(),
        grad_depth: gpu.read(backward.grad_depth.as_ref().expect("asked for")).expect(fine)[..keep].to_vec(),
        lists,
    }
}

/// Value and bound, summed over pixels.
#[derive(Clone, Copy, Default)]
struct Sum {
    value: f64,
    bound: f64,
}

impl Sum {
    fn add(&mut self, value: f64, bound: f64) {
        self.value += value;
        // The sum over pixels: at most 256 in a tile, fewer than 64 tiles of a row of them, in any order.
        self.bound += bound + 320.0 * U * value.abs();
    }
}

/// A Gaussian's gradients: mean 2, covariance 3, opacity, color 3, depth.
type Gradients = [Sum; 10];

pub struct Exact {
    /// Per pixel: rgb 3, depth in units of the farthest, transmittance.
    values: Vec<[f64; 5]>,
    bounds: Vec<f64>,
    /// Per slot; `None` where a threshold falls within its error.
    gradients: Vec<Option<Gradients>>,
    blended: usize,
}

struct Sample {
    slot: usize,
    before: f64,
    error_before: f64,
    alpha: f64,
    raw: f64,
    exponential: f64,
    error: f64,
    across: f64,
    dy: f64,
}

pub fn exact(size: [u32; 2], splats: &Splats) -> Exact {
    let order = splats.order();
    let farthest = splats.depth.iter().fold(1f32, |m, v| m.max(*v));
    let mut gradients: Vec<Option<Gradients>> = vec![Some(Gradients::default()); splats.mean.len()];
    let (mut values, mut bounds, mut blended) = (vec![], vec![], 0);
    for pixel in 0..(size[0] * size[1]) as usize {
        let centre = [pixel as u32 % size[0], pixel as u32 / size[0]].map(|v| f64::from(v) + 0.5);
        let (mut t, mut error_t, mut slack, mut unsure) = (1f64, 0f64, 0f64, false);
        let mut samples: Vec<Sample> = vec![];
        let mut touched = vec![];
        for &slot in &order {
            let [narrow, slope, variance] = splats.covariance[slot].map(f64::from);
            let (dx, dy) = (centre[0] - f64::from(splats.mean[slot][0]), centre[1] - f64::from(splats.mean[slot][1]));
            let across = dx - slope * dy;
            let q = across * across / narrow + dy * dy / variance;
            let opacity = f64::from(splats.opacity[slot]);
            let moved = 2.0 * U * (dx.abs() + 2.0 * (slope * dy).abs());
            // Not even with all errors.
            let least = (across.abs() - moved).max(0.0).powi(2) / narrow + dy * dy / variance;
            if !(opacity > 0.0 && least < 2.0 * (255.0 * opacity).ln() + 0.1) {
                continue;
            }
            let exponential = (-0.5 * q).exp();
            let raw = opacity * exponential;
            let error =
                (q / narrow).sqrt() * moved + 0.5 * moved * moved / narrow + U * (4.0 * q + 2.0 * (3.0 + q) + 2.0);
            // The error is of the exponent: of alpha, its exponential less one.
            let error = error.exp_m1();
            if (raw * 255.0 - 1.0).abs() <= error.max(raw * 255.0 * error) {
                // A mean on the pixel has an exponent of 0 without rounding; whatever is not, may be drawn or not.
                slack += t / 255.0;
                unsure = true;
                touched.push(slot);
            }
            if raw < 1.0 / 255.0 {
                continue;
            }
            let alpha = raw.min(0.99);
            // Float32's 0.99 is within u of 0.99.
            let error = if raw > 0.99 * (1.0 + error) { U } else { error };
            let after = t * (1.0 - alpha);
            touched.push(slot);
            if (after * 1e4 - 1.0).abs() <= error_t + error * alpha / (1.0 - alpha) + 2.0 * U {
                slack += t;
                unsure = true;
            }
            if after < 1e-4 {
                break;
            }
            slack += t * (alpha * error).min(1.0);
            samples.push(Sample { slot, before: t, error_before: error_t, alpha, raw, exponential, error, across, dy });
            error_t += error * alpha / (1.0 - alpha) + 2.0 * U;
            t = after;
        }
        blended = blended.max(samples.len());
        let mut sum = [0.0; 5];
        for s in &samples {
            let w = s.alpha * s.before;
            for (c, sum) in sum.iter_mut().take(3).enumerate() {
                *sum += w * f64::from(splats.color[s.slot][c]);
            }
            sum[3] += w * f64::from(splats.depth[s.slot]) / f64::from(farthest);
        }
        for (c, sum) in sum.iter_mut().take(3).enumerate() {
            *sum += t * f64::from(BACKGROUND[c]);
        }
        sum[4] = t;
        let roundings = 4.0 * U * (samples.len() as f64 + 4.0);
        values.push(sum);
        bounds.push(slack + roundings);
        if unsure {
            touched.into_iter().for_each(|s| gradients[s] = None);
            continue;
        }
        let (g_rgb, g_z, g_t) = upstream(pixel, farthest);
        let value = |slot: usize| -> f64 {
            let rgb: f64 = (0..3).map(|c| f64::from(splats.color[slot][c]) * f64::from(g_rgb[c])).sum();
            rgb + f64::from(splats.depth[slot]) * f64::from(g_z)
        };
        let background: f64 = (0..3).map(|c| f64::from(BACKGROUND[c]) * f64::from(g_rgb[c])).sum();
        let mut remaining: f64 = samples.iter().map(|s| s.alpha * s.before * value(s.slot)).sum();
        remaining += t * (background + f64::from(g_t));
        // |S| and all |w v|: 1 at most for each upstream component.
        let size_of_sums = 5.0;
        let difference = (slack + roundings) * size_of_sums;
        for s in &samples {
            let (w, v) = (s.alpha * s.before, value(s.slot));
            remaining -= w * v;
            let Some(g) = &mut gradients[s.slot] else { continue };
            let e_w = w * (s.error_before + s.error + 4.0 * U);
            for c in 0..3 {
                g[6 + c].add(w * f64::from(g_rgb[c]), e_w);
            }
            g[9].add(w * f64::from(g_z), e_w / f64::from(farthest));
            if s.raw > 0.99 * (1.0 + s.error) {
                continue;
            }
            let alpha = s.before * v - remaining / (1.0 - s.alpha);
            let e_alpha = s.before * (s.error_before + 8.0 * U) * 4.0
                + difference / (1.0 - s.alpha)
                + remaining.abs() / (1.0 - s.alpha).powi(2) * (s.alpha * s.error + U);
            g[5].add(alpha * s.exponential, (e_alpha + alpha.abs() * s.error) * s.exponential);
            let [narrow, slope, variance] = splats.covariance[s.slot].map(f64::from);
            let (power, e_power) = (alpha * s.raw, (e_alpha + alpha.abs() * (s.error + 2.0 * U)) * s.raw);
            let (a, y) = (s.across, s.dy);
            // Of dx - k dy, as in the exponent.
            let e_a = 4.0 * U * (a.abs() + 2.0 * (slope * y).abs());
            let along = power * a / narrow;
            let e_along = (e_power * a.abs() + power.abs() * e_a) / narrow + 4.0 * U * along.abs();
            g[0].add(along, e_along);
            let down = power * y / variance;
            g[1].add(
                down - slope * along,
                e_power * y.abs() / variance + 4.0 * U * down.abs() + slope.abs() * (e_along + 4.0 * U * along.abs()),
            );
            g[2].add(
                0.5 * along * a / narrow,
                0.5 * (e_along * a.abs() + along.abs() * e_a) / narrow + 4.0 * U * (along * a / narrow).abs(),
            );
            g[3].add(along * y, e_along * y.abs() + 4.0 * U * (along * y).abs());
            g[4].add(
                0.5 * down * y / variance,
                0.5 * e_power * (y / variance).powi(2) + 8.0 * U * (down * y / variance).abs(),
            );
        }
    }
    Exact { values, bounds, gradients, blended }
}

/// Compares a picture with the exact one.
pub fn assert_pixels(
    rgb: &[[f32; 3]],
    depth: &[f32],
    transmittance: &[f32],
    want: &Exact,
    splats: &Splats,
    what: &str,
) {
    let farthest = f64::from(splats.depth.iter().fold(1f32, |m, v| m.max(*v)));
    for (p, (value, bound)) in want.values.iter().zip(&want.bounds).enumerate() {
        let [r, g, b] = rgb[p].map(f64::from);
        let found = [r, g, b, f64::from(depth[p]) / farthest, transmittance[p].into()];
        for (found, value) in found.iter().zip(value) {
            let error = (found - value).abs();
            assert!(error <= *bound, "{what}: pixel {p}: {found} instead of {value}, beyond {bound:e}");
        }
    }
}

/// Compares a drawing with the exact one; returns the share of Gaussians whose gradients were compared.
fn assert_close(got: &Drawn, want: &Exact, splats: &Splats, what: &str) -> f64 {
    assert_pixels(&got.rgb, &got.depth, &got.transmittance, want, splats, what);
    let mut compared = 0;
    for (s, gradients) in want.gradients.iter().enumerate() {
        let (m, c, k) = (got.grad_mean[s], got.grad_covariance[s], got.grad_color[s]);
        let found = [m[0], m[1], c[0], c[1], c[2], got.grad_opacity[s], k[0], k[1], k[2], got.grad_depth[s]];
        assert!(found.iter().all(|v| v.is_finite()), "{what}: gradients of {s}: {found:?}");
        let Some(gradients) = gradients else { continue };
        compared += 1;
        for (i, (found, sum)) in found.iter().zip(gradients).enumerate() {
            let error = (f64::from(*found) - sum.value).abs();
            // Below the smallest normal number float32 may be flushed to 0.
            let bound = sum.bound + 1e-37;
            assert!(
                error <= bound,
                "{what}: gradient {i} of {s}: {found:e} instead of {:e}, beyond {bound:e}",
                sum.value
            );
        }
    }
    compared as f64 / want.gradients.len().max(1) as f64
}

/// A support that ends too early would show as a tile's edge.
fn assert_same(pictures: &[Drawn], what: &str) {
    for pair in pictures.windows(2) {
        for (p, (a, b)) in pair[0].rgb.iter().zip(&pair[1].rgb).enumerate() {
            assert!(a == b, "{what}: pixel {p} is {a:?} with wide and {b:?} with narrow tiles");
        }
    }
}

fn color(rng: &mut Pcg64Mcg) -> [f32; 3] {
    std::array::from_fn(|_| rng.random_range(0.0..1.0))
}

/// An ellipse by its deviations along an angle and across it, low-pass included, factored without cancellation.
fn ellipse(along: f64, across: f64, angle: f64) -> [f32; 3] {
    let (s, c) = angle.sin_cos();
    let (a, b) = (along * along + 0.3, across * across + 0.3);
    let variance = s * s * a + c * c * b;
    [a * b / variance, s * c * (a - b) / variance, variance].map(|v| v as f32)
}

fn needles(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let size = [8191, 6];
    let mut splats = Splats::default();
    for i in 0..60 {
        // Slopes at which a needle crosses the picture's few rows somewhere far from its mean.
        let angle: f64 = [2e-4, -7e-4, 3e-3, 0.02, 0.3, -1.2][i % 6] * rng.random_range(0.5..1.5);
        let along = 10f64.powf(rng.random_range(3.7..7.0));
        let mean = [rng.random_range(0.0f32..8191.0), rng.random_range(-2.0f32..8.0)];
        // Half of them lie with their means far outside, on a line through the picture.
        let back = if i % 2 == 0 { 0.0 } else { rng.random_range(0.2..1.0) * along };
        let mean = [f64::from(mean[0]) - back * angle.cos(), f64::from(mean[1]) - back * angle.sin()].map(|v| v as f32);
        splats.push(
            mean,
            ellipse(along, 0.01, angle),
            rng.random_range(1.0..9.0),
            rng.random_range(0.2..0.9),
            color(&mut rng),
        );
    }
    let want = exact(size, &splats);
    let visible = want.values.iter().filter(|v| v[4] < 0.9).count();
    assert!(visible > 10_000, "{visible} pixels show a needle: the case tests too little");
    // What the quadratic form of a rounded conic would be off by: 2^-24 r^2 / 0.3, 13 at the far end.
    let worst = want.bounds.iter().fold(0.0f64, |m, b| m.max(*b));
    let usual = want.bounds.iter().sum::<f64>() / want.bounds.len() as f64;
    assert!(usual < 0.02, "the bounds say nothing: {usual} on average, {worst} at most");
    let mut pictures = vec![];
    for &tiling in tilings(gpu) {
        let got = draw(gpu, tiling, size, &splats, 60 * 1024);
        let share = assert_close(&got, &want, &splats, &format!("{tiling:?}"));
        assert!(share > 0.2, "{tiling:?}: gradients of {share} compared, bounds {worst:e} at most");
        pictures.push(got);
    }
    assert_same(&pictures, "needles");
}

fn stack(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    for opacity in [1.0 - 1e-7, 0.0045, 0.5] {
        let mut splats = Splats::default();
        for _ in 0..100_000 {
            let mean = if opacity == 0.5 { [rng.random_range(-1.5..2.5), 0.3] } else { [0.5, 0.5] };
            splats.push(mean, ellipse(1.0, 0.5, 0.3), rng.random_range(1.0..9.0), opacity, color(&mut rng));
        }
        let want = exact([1, 1], &splats);
        let blended = want.blended;
        assert!((2..=2345).contains(&blended), "{blended} blended");
        for &tiling in tilings(gpu) {
            let got = draw(gpu, tiling, [1, 1], &splats, 100_000);
            let share = assert_close(&got, &want, &splats, &format!("opacity {opacity}, {tiling:?}"));
            assert!(share > 0.9, "opacity {opacity}: gradients of {share} compared");
            let behind = splats.order()[blended + 1..].iter().all(|&s| got.grad_color[s] == [0.0; 3]);
            assert!(behind, "opacity {opacity}, {tiling:?}: a gradient behind the last that is seen");
        }
    }
}

fn edge(gpu: &Gpu) {
    let at = 1.0f32 / 255.0;
    let steps = [-40, -8, -1, 0, 1, 8, 40];
    for &tiling in tilings(gpu) {
        for step in steps {
            let opacity = f32::from_bits((at.to_bits() as i32 + step) as u32);
            let mut splats = Splats::default();
            splats.push([8.5, 3.5], ellipse(2.0, 1.0, 0.4), 2.0, opacity, [1.0, 0.5, 0.25]);
            // Decided at other distances: alpha there is less, so that only the mean's own pixel can be drawn.
            let got = draw(gpu, tiling, [17, 7], &splats, 64);
            let drawn: Vec<usize> = (0..17 * 7).filter(|&p| got.transmittance[p] != 1.0).collect();
            let what = format!("{tiling:?}, {step} units in the last place from 1/255");
            if step >= 8 {
                assert_eq!(drawn, [3 * 17 + 8], "{what}");
                assert!(got.grad_opacity[0] != 0.0 && got.grad_mean[0] == [0.0; 2], "{what}");
            } else if step <= -8 {
                assert!(drawn.is_empty() && got.grad_opacity[0] == 0.0, "{what}: {drawn:?}");
            } else {
                // exp(0) may be 3 units off; where it is 1, the decision is exact.
                let one = draw(gpu, tiling, [17, 7], &Splats { opacity: vec![0.5], ..splats.clone() }, 64);
                if one.transmittance[3 * 17 + 8] == 0.5 {
                    assert_eq!(drawn.len(), usize::from(step >= 0), "{what}");
                }
            }
            assert!(got.rgb.iter().flatten().chain(&got.depth).all(|v| v.is_finite()), "{what}");
        }
    }
}

fn rims(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let (mut tall, mut broad) = (Splats::default(), Splats::default());
    for i in 0..250 {
        let (narrow, opacity, dx) = loop {
            let (narrow, opacity) = (rng.random_range(0.3f32..20.0), rng.random_range(0.004f32..0.99));
            let dx = (f64::from(narrow) * 2.0 * (255.0 * f64::from(opacity)).ln()).sqrt();
            if (0.6..7.9).contains(&dx) {
                break (narrow, opacity, dx as f32);
            }
        };
        // A few roundings inside, at and outside the distance at which alpha is 1/255, from the last sample of the
        // narrow tile before; the wide tile holds both that sample and the mean.
        let far = 7.5 + dx * (1.0 + f32::EPSILON * (i % 9 - 6) as f32);
        let along = 8.0 * i as f32 + 3.5;
        let color = color(&mut rng);
        tall.push([far, along], [narrow, 0.0, 0.3], 2.0, opacity, color);
        broad.push([along, far], [0.3, 0.0, narrow], 2.0, opacity, color);
    }
    for (size, splats) in [([16, 2000], tall), ([2000, 16], broad)] {
        let pictures: Vec<Drawn> = tilings(gpu).iter().map(|&t| draw(gpu, t, size, &splats, 4096)).collect();
        let rim = |i: usize| if size[0] == 16 { (8 * i + 3) * 16 + 7 } else { 7 * 2000 + 8 * i + 3 };
        let drawn = (0..250).filter(|&i| pictures[0].transmittance[rim(i)] != 1.0).count();
        assert!((50..200).contains(&drawn), "{drawn} of 250 rims are drawn: the case tests too little");
        assert_same(&pictures, &format!("{size:?}"));
    }
}

fn crowded(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut splats = Splats::default();
    for _ in 0..1_000_000 {
        let mean = [rng.random_range(1.0..7.0), rng.random_range(1.0..7.0)];
        let covariance = [rng.random_range(0.3..4.0), rng.random_range(-1.0..1.0), rng.random_range(0.3..4.0)];
        // Few enough different depths that many are equal.
        let depth = 1.0 + rng.random_range(0..300_000u32) as f32 * 1e-5;
        splats.push(mean, covariance, depth, rng.random_range(0.004..0.03), [0.9, 0.5, 0.1]);
    }
    let size = [3, 3];
    let want = exact(size, &splats);
    assert!(want.blended > 300, "{} blended: the case tests too little", want.blended);
    let order: Vec<u32> = splats.order().into_iter().map(|s| s as u32).collect();
    for &tiling in tilings(gpu) {
        let got = draw(gpu, tiling, size, &splats, 1_000_000);
        assert_eq!(got.lists.len(), 1);
        let drawn: std::collections::HashSet<u32> = got.lists[0].iter().copied().collect();
        assert!(drawn.len() > 900_000 && drawn.len() == got.lists[0].len());
        let listed: Vec<u32> = order.iter().copied().filter(|s| drawn.contains(s)).collect();
        assert!(got.lists[0] == listed, "{tiling:?}: the list is not in the order of depth and slot");
        assert_close(&got, &want, &splats, &format!("{tiling:?}"));
    }
}

fn equal_depths(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    let size = [90, 60];
    let mut splats = Splats::default();
    for i in 0..20_000 {
        let mean = [rng.random_range(0.0..90.0), rng.random_range(0.0..60.0)];
        let depth = [2.0, 2.0f32.next_up(), 5.0][i * 7919 % 3];
        splats.push(mean, ellipse(2.0, 1.0, 0.5), depth, 0.01, color(&mut rng));
    }
    for &tiling in tilings(gpu) {
        let got = draw(gpu, tiling, size, &splats, 20_000 * 12);
        let mut longest = 0;
        for list in &got.lists {
            let keys: Vec<(u32, u32)> = list.iter().map(|&s| (splats.depth[s as usize].to_bits(), s)).collect();
            assert!(keys.is_sorted(), "{tiling:?}: {keys:?}");
            longest = longest.max(keys.len());
        }
        assert!(longest > 500, "{longest} in a tile: the case tests too little");
    }
}

fn enormous(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let size = [45, 27];
    let most = (1u64 << 60) as f64;
    let mut splats = Splats::default();
    for i in 0..400 {
        let reach = if i % 2 == 0 { 60.0 } else { 12.0 };
        let mut far = || f64::powf(2.0, rng.random_range(0.0..reach)) * [1.0, -1.0][rng.random_range(0..2)];
        let mean = [far(), far()].map(|v| v as f32);
        let (along, across) = (far().abs(), far().abs());
        let angle = rng.random_range(0.0..3.2);
        let [narrow, slope, variance] = ellipse(along.max(across), across.min(along), angle);
        splats.push(
            mean,
            [narrow, slope, variance],
            rng.random_range(1.0..9.0),
            rng.random_range(0.02..0.4),
            color(&mut rng),
        );
    }
    // The corners of what the projection lets through, and tiles' edges far away. With the steepest slope dx - k dy is 2^65
    // at some pixels of the mean's own tile: its square overflows.
    splats.push([20.5, 13.5], [0.3, 2.1e18, 0.3], 2.0, 0.4, color(&mut rng));
    for covariance in [
        [0.3, most as f32, 0.3],
        [0.3, 0.0, 2f32.powi(120)],
        [2f32.powi(120), 0.0, 0.3],
        [2f32.powi(120), 1.0, 2f32.powi(119)],
    ] {
        for mean in [[most, most], [-most, most], [most, 5.0], [5.0, -most], [1e6, 1e6], [20.5, 13.5]] {
            splats.push(mean.map(|v| v as f32), covariance, rng.random_range(1.0..9.0), 0.05, color(&mut rng));
        }
    }
    let want = exact(size, &splats);
    let mut pictures = vec![];
    for &tiling in tilings(gpu) {
        let got = draw(gpu, tiling, size, &splats, 425 * 24);
        let drawn: std::collections::HashSet<u32> = got.lists.iter().flatten().copied().collect();
        assert!(drawn.len() > 40, "{} drawn: the case tests too little", drawn.len());
        assert_close(&got, &want, &splats, &format!("{tiling:?}"));
        pictures.push(got);
    }
    assert_same(&pictures, "enormous");
}

fn few(gpu: &Gpu) {
    for &tiling in tilings(gpu) {
        for size in [[1, 1], [17, 3], [40, 33]] {
            let background = vec![BACKGROUND; (size[0] * size[1]) as usize];
            let mut splats = Splats::default();
            let got = draw(gpu, tiling, size, &splats, 64);
            assert_eq!(
                (&got.rgb, got.transmittance.iter().all(|t| *t == 1.0)),
                (&background, true),
                "nothing, {size:?}"
            );
            // Absent: no depth. Behind every threshold: no opacity. Outside: no tile.
            splats.push([0.0; 2], [0.0; 3], 0.0, 0.9, [1.0; 3]);
            splats.push([0.5, 0.5], [1.0, 0.0, 1.0], 1.0, 0.0, [1.0; 3]);
            splats.push([0.5, 0.5], [1.0, 0.0, 1.0], 1.0, 1e-30, [1.0; 3]);
            splats.push([-500.0, 0.5], [1.0, 0.0, 1.0], 1.0, 0.9, [1.0; 3]);
            let got = draw(gpu, tiling, size, &splats, 64);
            assert_eq!(got.rgb, background, "none that exists, {size:?}");
            let gradients = got.grad_mean.as_flattened().iter().chain(got.grad_covariance.as_flattened());
            let gradients =
                gradients.chain(&got.grad_opacity).chain(got.grad_color.as_flattened()).chain(&got.grad_depth);
            assert!(gradients.into_iter().all(|g| *g == 0.0), "a gradient of what is absent");
            let mut splats = Splats::default();
            splats.push([0.7, 0.6], ellipse(3.0, 1.0, 0.4), 2.0, 0.8, [0.9, 0.1, 0.4]);
            let got = draw(gpu, tiling, size, &splats, 64);
            assert_eq!(assert_close(&got, &exact(size, &splats), &splats, &format!("one, {size:?}, {tiling:?}")), 1.0);
        }
    }
}

fn shapes(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    for size in [[1, 1], [17, 3], [8191, 3], [3, 8191]] {
        let mut splats = Splats::default();
        for _ in 0..60 {
            let mean = [0, 1].map(|i| rng.random_range(-3.0..size[i] as f32 + 3.0));
            let covariance =
                ellipse(rng.random_range(0.1..300.0), rng.random_range(0.1..9.0), rng.random_range(0.0..3.2));
            splats.push(mean, covariance, rng.random_range(1.0..9.0), rng.random_range(0.05..1.0), color(&mut rng));
        }
        let want = exact(size, &splats);
        let mut pictures = vec![];
        for &tiling in tilings(gpu) {
            let got = draw(gpu, tiling, size, &splats, 60 * 4096);
            assert_close(&got, &want, &splats, &format!("{size:?}, {tiling:?}"));
            pictures.push(got);
        }
        assert_same(&pictures, &format!("{size:?}"));
    }
}

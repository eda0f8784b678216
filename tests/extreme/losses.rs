//! The losses where a mask, a prior, a render or the fit between them degenerates.

use gscream_vk::gpu::{Check, Difference, Gpu, Recorder, testing::UNWRITTEN};
use gscream_vk::losses::align::{Align, Prior, Quantity};
use gscream_vk::losses::depth_gradient::DepthGradient;
use gscream_vk::losses::depth_l1::{DepthL1, Weight};
use gscream_vk::losses::photometric::Photometric;
use gscream_vk::math::align::{Fit, alignable, alignable_slope, sums};
use gscream_vk::math::ssim;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::Case;

/// One float32 rounding.
const U: f64 = 1.0 / (1 << 24) as f64;
/// Roundings behind a sum over pixels: 2 for a distance, 22 in its workgroup, 21 over the workgroups, and 5 to spare.
const SUM: f64 = 50.0;
const SIZE: [u32; 2] = [53, 37];

pub const CASES: &[Case] = &[
    Case {
        stage: "losses: photometric",
        case: "identical pictures; 1x1, 17x3, 53x37",
        guarantee: "loss and gradient exactly 0",
        run: identical_pictures,
    },
    Case {
        stage: "losses: photometric",
        case: "pictures of one brightness each, black and white included; 1x1, 17x3",
        guarantee: "loss within 1e-5, gradient within 2e-4 of its largest element (14 roundings of 1 / C2) of float64",
        run: constant_pictures,
    },
    Case {
        stage: "losses: photometric",
        case: "mask empty, full, one pixel",
        guarantee: "weights are per pixel of the picture, nothing divides by a count: float64's loss and gradient; no weight, exactly 0",
        run: photometric_masks,
    },
    Case {
        stage: "losses: depth",
        case: "no valid pixel, one valid pixel, a 1x1 picture",
        guarantee: "no fit: w = q = 0, gradient exactly 0, loss that of the prior alone",
        run: depth_masks,
    },
    Case {
        stage: "losses: depth",
        case: "rendered depth constant: 0, 3.3, 1e-30, 1e30",
        guarantee: "no fit: w = q = 0, gradient exactly 0, loss that of the prior alone",
        run: constant_depth,
    },
    Case {
        stage: "losses: depth",
        case: "deviation of the rendered depth 2^-22 and 2^-20 of its mean, at scales 1e-25 to 1e25",
        guarantee: "singular below 2^-21 (8 roundings of the mean) and only there, whatever the scale",
        run: singular_at_any_scale,
    },
    Case {
        stage: "losses: depth",
        case: "prior constant",
        guarantee: "w within 50 u of prior / deviation from 0, gradient within rounding of its own terms from 0",
        run: constant_prior,
    },
    Case {
        stage: "losses: depth",
        case: "prior anti-correlated with the rendered depth or disparity",
        guarantee: "the paper's absolute value of w, q of the signed fit: float64's loss and gradient, which turns the depth round, to rounding",
        run: anti_correlated,
    },
    Case {
        stage: "losses: depth",
        case: "prior of range 1e-30 and 1e30",
        guarantee: "finite, w, loss and gradient to the same relative bound as at range 1 (gradients below 2^-126 vanish)",
        run: prior_ranges,
    },
    Case {
        stage: "losses: depth",
        case: "rendered depth of range 1e-30 to 1e30",
        guarantee: "finite, w, loss and gradient to the same relative bound as at range 1: distances are squared in units of their mean",
        run: rendered_ranges,
    },
    Case {
        stage: "losses: depth",
        case: "rendered depth 10 to 1e6 deviations from 0",
        guarantee: "w within 50 u (1 + (50 u k)^2) (1 + 1 / r) of itself, k = mean / deviation, r the correlation; gradient to its terms' rounding",
        run: far_from_zero,
    },
    Case {
        stage: "losses: depth",
        case: "disparity prior, rendered depth 0, 1e-30 and just about the near plane",
        guarantee: "disparity continued by its tangent: finite, float64's fit and gradient to rounding",
        run: disparity_near_zero,
    },
    Case {
        stage: "losses",
        case: "a rendered colour, depth or prior that is not a number or infinite, at a pixel of weight 0 too",
        guarantee: "the loss is not finite: nothing hides it",
        run: not_a_number,
    },
];

fn finish(rec: Recorder<'_>) {
    let submission = rec.submit().expect("submit");
    for difference in &submission.differences {
        assert!(difference.ok(), "{difference}");
    }
    submission.wait().expect("wait");
}

fn double(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

// ---------------------------------------------------------------- colour

const SSIM: f32 = 0.2;

struct Pictures {
    size: [u32; 2],
    rendered: Vec<[f32; 3]>,
    target: Vec<[f32; 3]>,
    weight: Option<Vec<f32>>,
}

impl Pictures {
    fn random(size: [u32; 2]) -> Self {
        let mut rng = Pcg32::seed_from_u64(21);
        let mut noise =
            || (0..size[0] * size[1]).map(|_| std::array::from_fn(|_| rng.random())).collect::<Vec<[f32; 3]>>();
        Self { size, rendered: noise(), target: noise(), weight: None }
    }

    /// Loss and gradient, every pass beside its float64 twin if `checked`.
    fn run(&self, gpu: &Gpu, checked: bool) -> (f64, Vec<f32>) {
        let stage = Photometric::new(gpu, self.size, SSIM, true).expect("buffers");
        let [rendered, target] =
            [&self.rendered, &self.target].map(|picture| gpu.upload("picture", picture).expect("upload"));
        let weight = self.weight.as_ref().map(|weight| gpu.upload("weight", weight).expect("upload"));
        let loss = gpu.upload("loss", &[UNWRITTEN]).expect("upload");
        let mut rec = if checked { gpu.checked() } else { gpu.recorder() }.expect("recorder");
        let grad = stage.forward_backward(&mut rec, &rendered, &target, weight.as_ref(), &loss, 0);
        finish(rec);
        (gpu.read(&loss).expect("read")[0].into(), gpu.read(grad).expect("read").into_flattened())
    }

    /// One channel's share of the loss, from the definition of SSIM.
    fn channel(&self, rendered: &[f64], c: usize) -> f64 {
        let target: Vec<f64> = self.target.iter().map(|t| t[c].into()).collect();
        let [width, height] = self.size.map(|v| v as usize);
        let map = ssim::map(rendered, &target, width, height);
        let share = f64::from(SSIM);
        let terms = (0..map.len()).map(|p| {
            let weight = self.weight.as_ref().map_or(1.0, |w| f64::from(w[p]));
            weight * ((1.0 - share) * (rendered[p] - target[p]).abs() + share * (1.0 - map[p]))
        });
        terms.sum::<f64>() / (3 * map.len()) as f64
    }

    /// Compares with float64: the loss, and its central differences (step 1e-6: error 1e-9 of the loss's curvature).
    fn compare(&self, gpu: &Gpu, name: &str) {
        let (loss, grad) = self.run(gpu, true);
        let of = |c: usize| -> Vec<f64> { self.rendered.iter().map(|r| r[c].into()).collect() };
        let want: f64 = (0..3).map(|c| self.channel(&of(c), c)).sum();
        assert!((loss - want).abs() <= 1e-5 * want, "{name}: loss {loss}, {want}");
        let mut differences = vec![0.0; grad.len()];
        for c in 0..3 {
            let mut rendered = of(c);
            for p in 0..rendered.len() {
                let h = 1e-6;
                let here = rendered[p];
                let mut at = |v: f64| {
                    rendered[p] = v;
                    self.channel(&rendered, c)
                };
                differences[3 * p + c] = (at(here + h) - at(here - h)) / (2.0 * h);
                rendered[p] = here;
            }
        }
        let check = Check { relative: 1e-4, absolute: 2e-4, band: 0.0 };
        let difference = Difference::of(name, "grad_rendered", &double(&grad), &differences, check);
        assert!(difference.ok(), "{difference}");
    }
}

fn identical_pictures(gpu: &Gpu) {
    for size in [[1, 1], [17, 3], SIZE] {
        let random = Pictures::random(size);
        let black = vec![[0.0; 3]; random.target.len()];
        for picture in [random.target.clone(), black] {
            let pictures = Pictures { rendered: picture.clone(), target: picture, ..Pictures::random(size) };
            let (loss, grad) = pictures.run(gpu, true);
            assert_eq!(loss, 0.0, "{size:?}");
            assert!(grad.iter().all(|&g| g == 0.0), "{size:?}");
        }
    }
}

fn constant_pictures(gpu: &Gpu) {
    for size in [[1, 1], [17, 3]] {
        let n = (size[0] * size[1]) as usize;
        for (a, b) in [(0.9, 0.2), (0.0, 1.0), (1.0, 0.0), (0.5, 0.5 + 1.0 / 255.0), (1.0 / 255.0, 0.0)] {
            let pictures = Pictures { size, rendered: vec![[a; 3]; n], target: vec![[b; 3]; n], weight: None };
            pictures.compare(gpu, &format!("{a} against {b}, {size:?}"));
        }
        Pictures::random(size).compare(gpu, &format!("noise, {size:?}"));
    }
}

fn photometric_masks(gpu: &Gpu) {
    let size = [17, 3];
    let n = 51;
    for (name, weight) in [("full", vec![20.0; n]), ("one pixel", (0..n).map(|p| f32::from(p == 25)).collect())] {
        Pictures { weight: Some(weight), ..Pictures::random(size) }.compare(gpu, name);
    }
    let (loss, grad) = Pictures { weight: Some(vec![0.0; n]), ..Pictures::random(size) }.run(gpu, true);
    assert_eq!(loss, 0.0);
    assert!(grad.iter().all(|&g| g == 0.0), "a gradient without a weight");
}

// ---------------------------------------------------------------- depth

#[derive(Clone)]
struct Maps {
    size: [u32; 2],
    rendered: Vec<f32>,
    prior: Vec<f32>,
    valid: Vec<f32>,
    weight: Vec<f32>,
    quantity: Quantity,
}

/// What the device says.
struct Got {
    fit: Vec<f32>,
    terms: [f64; 2],
    grad: Vec<f32>,
}

/// What float64 says, and the size of the terms that make up each element of the gradient.
struct Want {
    fit: Fit,
    terms: [f64; 2],
    grad: Vec<f64>,
    terms_of_grad: Vec<f64>,
    /// Mean of x over its deviation, correlation of x and prior.
    condition: f64,
    correlation: f64,
    /// Signs that rounding decides.
    kinks: u32,
}

impl Maps {
    /// Depths between `low` and `high`, `prior = slope x + 0.05 + noise` of a tenth of the slope.
    fn new([low, high]: [f32; 2], slope: f64, quantity: Quantity, seed: u64) -> Self {
        let mut rng = Pcg32::seed_from_u64(seed);
        let pixels = SIZE[0] * SIZE[1];
        let rendered: Vec<f32> = (0..pixels).map(|_| low + (high - low) * rng.random::<f32>()).collect();
        let x: Vec<f64> = rendered.iter().map(|&d| alignable(d.into(), near(quantity))).collect();
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let spread = x.iter().fold(0.0f64, |m, x| m.max((x - mean).abs()));
        let prior = x.iter().map(|x| {
            let noise = (0.1 + 0.1 * rng.random::<f64>()) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            (slope * (x - mean) / spread + 0.3 + noise * slope.abs()) as f32
        });
        let prior = prior.collect();
        let inside = |p: u32| (15..30).contains(&(p % SIZE[0])) && (9..20).contains(&(p / SIZE[0]));
        let of = |a: f32, b: f32| (0..pixels).map(|p| if inside(p) { a } else { b }).collect::<Vec<f32>>();
        Self { size: SIZE, rendered, prior, valid: of(0.0, 1.0), weight: of(100.0, 1.0), quantity }
    }

    fn pixels(&self) -> usize {
        self.rendered.len()
    }

    fn scaled(mut self, rendered: f64, prior: f64) -> Self {
        let by = |values: &mut [f32], factor: f64| {
            for v in values {
                *v = (f64::from(*v) * factor) as f32;
            }
        };
        by(&mut self.rendered, rendered);
        by(&mut self.prior, prior);
        self
    }

    fn run(&self, gpu: &Gpu, checked: bool) -> Got {
        let upload = |name, data: &[f32]| gpu.upload(name, data).expect("upload");
        let (rendered, prior) = (upload("rendered", &self.rendered), upload("prior", &self.prior));
        let (valid, weight) = (upload("valid", &self.valid), upload("weight", &self.weight));
        let terms = upload("terms", &[UNWRITTEN; 2]);
        let align = Align::new(gpu, self.size).expect("buffers");
        let l1 = DepthL1::new(gpu, self.size).expect("buffers");
        let gradient = DepthGradient::new(gpu, self.size, 4, true).expect("buffers");
        let prior = Prior { values: &prior, quantity: self.quantity, valid: Some(&valid) };
        let mut rec = if checked { gpu.checked() } else { gpu.recorder() }.expect("recorder");
        let fit = align.forward(&mut rec, &rendered, prior);
        let (difference, grad_aligned) =
            l1.forward_backward(&mut rec, &rendered, prior, fit, Weight::Each(&weight), &terms, 0);
        gradient.forward_backward(&mut rec, difference, grad_aligned, Some(&valid), 0.5, &terms, 1);
        let grad = align.backward(&mut rec, grad_aligned, &rendered, prior, fit);
        finish(rec);
        let terms = gpu.read(&terms).expect("read");
        Got {
            fit: gpu.read(fit).expect("read"),
            terms: [terms[0].into(), terms[1].into()],
            grad: gpu.read(grad).expect("read"),
        }
    }

    /// The first of many such maps in which no difference is within rounding of its kink, where the sign would be nobody's
    /// to decide.
    fn calm(make: impl Fn(u64) -> Self) -> Self {
        (0..200).map(make).find(|maps| maps.exact().kinks == 0).expect("maps without a kink")
    }

    fn exact(&self) -> Want {
        let n = self.pixels();
        let [rendered, prior, valid, weight] =
            [&self.rendered, &self.prior, &self.valid, &self.weight].map(|v| double(v));
        let near = near(self.quantity);
        let x: Vec<f64> = rendered.iter().map(|&d| alignable(d, near)).collect();
        let s = sums(&x, &prior, &valid);
        let fit = Fit::of(s);
        let d: Vec<f64> = x.iter().zip(&prior).map(|(&x, &p)| fit.difference(x, p)).collect();
        let largest = d.iter().fold(0.0f64, |m, d| m.max(d.abs()));
        let mut kinks = 0;
        let mut sign = |v: f64| {
            kinks += u32::from(v.abs() <= 64.0 * U * largest);
            if v == 0.0 { 0.0 } else { v.signum() }
        };
        let mut terms = [0.0; 2];
        let mut g = vec![0.0; n];
        for i in 0..n {
            terms[0] += weight[i] * d[i].abs() / n as f64;
            g[i] = weight[i] / n as f64 * sign(d[i]);
        }
        let [width, height] = self.size.map(|v| v as usize);
        for step in [1, 2, 4, 8] {
            let at = |x: usize, y: usize| y * width + x;
            let grid = || (0..height).step_by(step).flat_map(|y| (0..width).step_by(step).map(move |x| (x, y)));
            let count: f64 = grid().map(|(x, y)| valid[at(x, y)]).sum();
            if count == 0.0 {
                continue;
            }
            for (x, y) in grid() {
                for (there, j) in [(x + step < width, at(x + step, y)), (y + step < height, at(x, y + step))] {
                    let i = at(x, y);
                    if there && valid[i] * valid[j] > 0.0 {
                        terms[1] += 0.5 / count * (d[i] - d[j]).abs();
                        let s = 0.5 / count * sign(d[i] - d[j]);
                        g[i] += s;
                        g[j] -= s;
                    }
                }
            }
        }
        let about = |i: usize| (x[i] - fit.mean) * fit.unit;
        let of_fit = [g.iter().sum(), (0..n).map(|i| g[i] * about(i)).sum()];
        let absolute: f64 = g.iter().map(|g| g.abs()).sum();
        let absolute_about: f64 = (0..n).map(|i| (g[i] * about(i)).abs()).sum();
        let (mut grad, mut terms_of_grad) = (vec![], vec![]);
        for i in 0..n {
            let slope = alignable_slope(rendered[i], near);
            grad.push(fit.gradient(g[i], of_fit, x[i], prior[i], valid[i]) * slope);
            // A positive w leaves the mean out; a negative one brings it in twice.
            let turned = if fit.slope < 0.0 { 2.0 * (fit.mean * fit.unit).abs() * absolute } else { 0.0 };
            let by = (absolute_about + turned) * fit.inverse_spread * fit.unit;
            let distances = (prior[i] - fit.mean_prior).abs() + 2.0 * fit.scale * (x[i] - fit.mean).abs();
            let through = valid[i] * (by * distances + fit.scale * absolute * fit.inverse_count);
            terms_of_grad.push((fit.scale * g[i].abs() + through) * slope.abs());
        }
        let deviation = (s[5] / s[0]).sqrt() / fit.unit;
        let prior_square: f64 = (0..n).map(|i| valid[i] * (prior[i] - fit.mean_prior).powi(2)).sum();
        let correlation = s[6] / (s[5] * prior_square).sqrt();
        Want { fit, terms, grad, terms_of_grad, condition: fit.mean.abs() / deviation, correlation, kinks }
    }

    /// Compares with float64 within what the conditions allow.
    fn compare(&self, gpu: &Gpu, name: &str) -> Want {
        let (got, want) = (self.run(gpu, false), self.exact());
        let Want { fit, condition, correlation, .. } = &want;
        // A disparity is right to 3 roundings (Vulkan's division), which the deviation magnifies.
        let of_x = if self.quantity == Quantity::Depth { 0.0 } else { 3.0 * U * condition };
        let relative = (SUM * U * (1.0 + (SUM * U * condition).powi(2)) + of_x) * (1.0 + 1.0 / correlation.abs());
        let w = f64::from(got.fit[4]);
        assert!(
            (w - fit.slope).abs() <= relative * fit.slope.abs(),
            "{name}: w {w:e}, {:e} +- {relative:e}",
            fit.slope
        );
        assert_eq!(got.fit[0], got.fit[4].abs(), "{name}");
        // A loss is a mean of differences, each right to a few roundings of what cancels in it.
        let scale = fit.scale * fit.mean.abs() / condition * (1.0 + 1.0 / correlation.abs()) + fit.level.abs();
        for (got, want) in got.terms.iter().zip(want.terms) {
            assert!(got.is_finite() && (got - want).abs() <= relative * (want + 4.0 * scale), "{name}: {got}, {want}");
        }
        for (i, (&got, &exact)) in got.grad.iter().zip(&want.grad).enumerate() {
            let bound = 4.0 * relative * want.terms_of_grad[i] + f64::from(f32::MIN_POSITIVE);
            assert!((f64::from(got) - exact).abs() <= bound, "{name} [{i}]: {got:e}, {exact:e} +- {bound:e}");
        }
        // Not only within a bound: the gradient is there and points the same way.
        let difference = Difference::of(name, "grad", &double(&got.grad), &want.grad, Check::default());
        let enough = want.grad.iter().any(|g| g.abs() > 1e-30);
        assert!(!enough || difference.cosine > 1.0 - 1e-6 - relative, "{difference}");
        want
    }

    /// No fit: nothing of the rendered depth is left in the loss, and there is no gradient.
    fn singular(&self, gpu: &Gpu, name: &str) {
        let got = self.run(gpu, false);
        assert_eq!([got.fit[0], got.fit[1], got.fit[4], got.fit[5]], [0.0; 4], "{name}: {:?}", got.fit);
        assert!(got.grad.iter().all(|&g| g == 0.0), "{name}");
        let alone: f64 = (0..self.pixels()).map(|i| f64::from(self.weight[i] * self.prior[i].abs())).sum();
        let alone = alone / self.pixels() as f64;
        assert!((got.terms[0] - alone).abs() <= SUM * U * alone, "{name}: {}, {alone}", got.terms[0]);
        assert!(got.terms[1].is_finite(), "{name}");
    }
}

fn near(quantity: Quantity) -> f64 {
    match quantity {
        Quantity::Depth => 0.0,
        Quantity::Disparity { near } => near.into(),
    }
}

const DISPARITY: Quantity = Quantity::Disparity { near: 0.2 };

fn depth_masks(gpu: &Gpu) {
    for quantity in [Quantity::Depth, DISPARITY] {
        let maps = Maps::calm(|seed| {
            let maps = Maps::new([0.5, 6.0], 0.2, quantity, seed);
            Maps { valid: vec![1.0; maps.pixels()], ..maps }
        });
        let n = maps.pixels();
        Maps { valid: vec![0.0; n], ..maps.clone() }.singular(gpu, "no valid pixel");
        Maps { valid: (0..n).map(|i| f32::from(i == 900)).collect(), ..maps.clone() }.singular(gpu, "one valid pixel");
        let one =
            Maps { size: [1, 1], rendered: vec![2.0], prior: vec![0.4], valid: vec![1.0], weight: vec![1.0], quantity };
        one.singular(gpu, "1 x 1");
        maps.compare(gpu, "all valid");
    }
}

fn constant_depth(gpu: &Gpu) {
    for quantity in [Quantity::Depth, DISPARITY] {
        let maps = Maps::new([0.5, 6.0], 0.2, quantity, 2);
        for depth in [0.0, 3.3, 1e-30, 1e30] {
            let maps = Maps { rendered: vec![depth; maps.pixels()], ..maps.clone() };
            maps.singular(gpu, &format!("{quantity:?} {depth:e}"));
        }
    }
}

fn singular_at_any_scale(gpu: &Gpu) {
    // Half of the valid pixels one rounding step above the other half: float32's finest shapes.
    let maps = Maps::new([1.0, 1.1], 0.2, Quantity::Depth, 3);
    for scale in [1e-25, 1e-20, 1.0, 1e20, 1e25] {
        for (deviation, singular) in [(-22, true), (-20, false)] {
            let half = 2.0f64.powi(deviation) as f32;
            let rendered = (0..maps.pixels()).map(|i| if i % 2 == 0 { 1.0 } else { 1.0 + 2.0 * half });
            let maps = Maps { rendered: rendered.collect(), ..maps.clone() }.scaled(scale, 1.0);
            let name = format!("deviation 2^{deviation} at {scale:e}");
            let got = maps.run(gpu, false);
            assert_eq!(got.fit[5] == 0.0, singular, "{name}: {:?}", got.fit);
            assert!(got.fit.iter().chain(&got.grad).all(|v| v.is_finite()), "{name}");
            if singular {
                maps.singular(gpu, &name);
            }
        }
    }
}

fn constant_prior(gpu: &Gpu) {
    for (value, scale) in [(0.7, 1.0), (1e-30, 1.0), (1e30, 1.0), (0.7, 1e-20), (0.7, 1e20)] {
        let maps = Maps::new([0.5, 6.0], 0.2, Quantity::Depth, 4).scaled(scale, 1.0);
        let maps = Maps { prior: vec![value; maps.pixels()], ..maps };
        let got = maps.run(gpu, false);
        let value = f64::from(value);
        let x = double(&maps.rendered);
        let s = sums(&x, &double(&maps.prior), &double(&maps.valid));
        let unit = gscream_vk::math::align::unit(s[0], s[1]);
        let deviation = (s[5] / s[0]).sqrt() / unit;
        let rounding = SUM * U * value;
        assert!(f64::from(got.fit[0]) <= rounding / deviation, "{value:e}, {scale:e}: {:?}", got.fit);
        assert!((f64::from(got.fit[1]) - value).abs() <= 4.0 * rounding, "{:?}", got.fit);
        // Every difference is rounding; the gradient is w, or distances of the prior from its mean, times signs.
        let weights: f64 = maps.weight.iter().map(|&w| f64::from(w)).sum::<f64>() / maps.pixels() as f64 + 4.0;
        assert!(got.terms[0] <= 4.0 * rounding * weights && got.terms[1] <= 16.0 * rounding, "{:?}", got.terms);
        let largest = got.grad.iter().fold(0.0f64, |m, g| m.max(f64::from(*g).abs()));
        assert!(largest <= 8.0 * rounding / deviation * weights, "{value:e}, {scale:e}: gradient {largest:e}");
    }
}

fn anti_correlated(gpu: &Gpu) {
    for quantity in [Quantity::Depth, DISPARITY] {
        let maps = Maps::calm(|seed| Maps::new([0.5, 6.0], -0.2, quantity, seed));
        let want = maps.compare(gpu, &format!("{quantity:?}"));
        assert!(want.fit.slope < 0.0 && want.fit.scale > 0.0);
        // A step down the gradient brings the slope of the fit towards, not away from, the right sign: the loss with the
        // depth turned round is lower.
        let step = 1e-2 / want.grad.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        let rendered = maps.rendered.iter().zip(&want.grad).map(|(&d, g)| (f64::from(d) - step * g) as f32);
        let moved = Maps { rendered: rendered.collect(), ..maps }.run(gpu, false);
        assert!(moved.terms.iter().sum::<f64>() < want.terms.iter().sum::<f64>(), "{quantity:?}: the loss rises");
    }
}

fn prior_ranges(gpu: &Gpu) {
    for quantity in [Quantity::Depth, DISPARITY] {
        for range in [1e-30, 1.0, 1e30] {
            let maps = Maps::calm(|seed| Maps::new([0.5, 6.0], 0.2, quantity, seed).scaled(1.0, range));
            maps.compare(gpu, &format!("{quantity:?}, prior {range:e}"));
        }
    }
}

fn rendered_ranges(gpu: &Gpu) {
    for range in [1e-30, 1e-20, 1e-12, 1e12, 1e20, 1e30] {
        for slope in [0.2, -0.2] {
            let maps = Maps::calm(|seed| Maps::new([0.5, 6.0], slope, Quantity::Depth, seed).scaled(range, 1.0));
            let want = maps.compare(gpu, &format!("rendered {range:e}, slope {slope}"));
            assert!(want.fit.inverse_spread > 0.0 && want.grad.iter().any(|&g| g != 0.0));
        }
    }
}

fn far_from_zero(gpu: &Gpu) {
    for condition in [10.0, 1e3, 1e5, 1e6] {
        let mean = 3.0f32;
        let half = (3f64.sqrt() * f64::from(mean) / condition) as f32;
        let maps = Maps::calm(|seed| Maps::new([mean - half, mean + half], 0.2, Quantity::Depth, seed));
        let want = maps.compare(gpu, &format!("{condition:e} deviations"));
        assert!((0.5..2.0).contains(&(want.condition / condition)), "{}", want.condition);
    }
}

fn disparity_near_zero(gpu: &Gpu) {
    for (name, range) in [("about 0", [0.0, 1e-6]), ("below 1e-30", [0.0, 1e-30]), ("about near", [0.15, 0.25])] {
        let maps = Maps::calm(|seed| {
            let mut maps = Maps::new([0.5, 6.0], 0.2, DISPARITY, seed);
            let mut rng = Pcg32::seed_from_u64(seed + 1000);
            for d in maps.rendered.iter_mut().step_by(3) {
                *d = range[0] + (range[1] - range[0]) * rng.random::<f32>();
            }
            maps.rendered[7] = 0.0;
            maps
        });
        let want = maps.compare(gpu, name);
        assert!(want.fit.inverse_spread > 0.0);
    }
}

fn not_a_number(gpu: &Gpu) {
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for weight in [1.0, 0.0] {
            let mut pictures = Pictures { weight: Some(vec![1.0; 51]), ..Pictures::random([17, 3]) };
            pictures.rendered[20][1] = poison;
            pictures.weight.as_mut().expect("weights")[20] = weight;
            let (loss, _) = pictures.run(gpu, false);
            assert!(!loss.is_finite(), "colour {poison}, weight {weight}: {loss}");
            let good = Maps::new([0.5, 6.0], 0.2, Quantity::Depth, 12);
            for of_prior in [false, true] {
                let mut maps = good.clone();
                maps.valid[100] = weight;
                maps.weight[100] = weight;
                (if of_prior { &mut maps.prior } else { &mut maps.rendered })[100] = poison;
                let got = maps.run(gpu, false);
                let loss: f64 = got.terms.iter().sum();
                assert!(!loss.is_finite(), "prior {of_prior}, {poison}, weight {weight}: {:?}", got.terms);
            }
        }
    }
}

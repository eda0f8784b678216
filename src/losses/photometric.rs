//! L1 and SSIM between the render and the photograph, weighted per pixel (3D Gaussian splatting's loss with GScream's
//! weights): `1 / (3 W H) sum_p weight(p) sum_c [(1 - l) |C - I| + l (1 - SSIM)]`.
//!
//! SSIM's window is separable: moments along rows, then columns; the derivatives by the moments walk back the same way.

use super::Term;
use crate::cost::{Formula, if_so, work};
use crate::gpu::kernels::losses::{
    photometric_adjoint as adjoint, photometric_columns as columns, photometric_gradient as gradient,
    photometric_rows as rows,
};
use crate::gpu::{Buffer, Check, Error, Form, Gpu, Recorder, Reference};
use crate::math::ssim;

use super::sum;

/// As reports and plans know it.
pub const TERM: Term =
    Term { name: "photometric", stage: "photometric", planned: |_| true, left_out: &[], costs: COSTS };

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[
    Formula {
        pass: "losses/photometric_rows",
        variants: &["outside", "wide", "outside_wide"],
        derivation: "per pixel rgb twice 24, moments 48 B, with weights 4; per channel difference and terms 8, window 11 x 4, \
                     variances 10 operations",
        work: |c, d| work((72.0 + 4.0 * if_so(d.is("outside"))) * c.pixels, 3.0 * 62.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/photometric_columns",
        variants: &["weighted"],
        derivation: "per pixel moments 48, their gradient 36 B, with weights 4; per channel terms 8, window 11 x 4, SSIM and its \
                     derivatives 48 operations",
        work: |c, d| work((84.0 + 4.0 * if_so(d.is("weighted"))) * c.pixels, 3.0 * 100.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/photometric_adjoint",
        variants: &[],
        derivation: "per pixel 36 B read and 36 written; per channel a window of 11 x 3 operations",
        work: |c, _| work(72.0 * c.pixels, 3.0 * 33.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/photometric_gradient",
        variants: &["weighted", "weighted_outside", "l1", "l1_weighted"],
        derivation: "per pixel rgb, target and gradient 36 B, 18 operations for L1; with SSIM 36 B and per channel a window of 11 x 3 \
                     and 5 operations more; with weights 4 B",
        work: |c, d| {
            let ssim = if_so(!d.is("l1"));
            let bytes = 36.0 + 36.0 * ssim + 4.0 * if_so(d.is("weighted"));
            work(bytes * c.pixels, (18.0 + 3.0 * 38.0 * ssim) * c.pixels, 0.0)
        },
    },
];

/// Pixels that a thread makes along the blur's direction; RUN in the kernels.
const RUN: usize = 8;
/// Pixels of a thread in the form for GPUs of `photometric_rows`.
const WIDE_RUN: u32 = 4;

impl Reference for rows::Kernel {
    /// With a weight both pictures agree where it is 0.
    fn reference(host: rows::Host<'_>, push: rows::Push, (): ()) {
        let [width, height] = push.size.map(|v| v as usize);
        for y in 0..height {
            for x in 0..width {
                for c in 0..3 {
                    let a = |x: usize| f64::from(host.rendered[y * width + x][c]);
                    let b = |x: usize| match host.weight {
                        Some(weight) if weight[y * width + x] == 0.0 => a(x),
                        _ => f64::from(host.target[y * width + x][c]),
                    };
                    let blur = |value: &dyn Fn(usize) -> f64| ssim::blur(x, width, value);
                    let e = |x| a(x) - b(x);
                    let (ma, mb, me) = (blur(&a), blur(&b), blur(&e));
                    let sum = blur(&|x| a(x) * a(x) + b(x) * b(x)) - ma * ma - mb * mb;
                    let variance = blur(&|x| e(x) * e(x)) - me * me;
                    let moments = [ma, me, sum.max(0.0), variance.max(0.0)];
                    host.moments[(y * width + x) * 3 + c] = moments.map(|v| v as f32);
                }
            }
        }
    }
    /// At most 18 roundings of 6e-8 each of terms no larger than the squared contrast of the run's surroundings.
    fn check(_binding: &'static str) -> Check {
        Check { relative: 1e-5, absolute: 2e-6, band: 0.0 }
    }
    fn cancels(_binding: &'static str) -> bool {
        true // variances of flat surroundings
    }
}

impl Reference for columns::Kernel {
    fn reference(host: columns::Host<'_>, push: columns::Push, (): ()) {
        let [width, height] = push.size.map(|v| v as usize);
        let line = 3 * width;
        let mut losses = vec![0.0; column_groups(push.size)[0]];
        for y in 0..height {
            for x in 0..line {
                let at = |y: usize, i: usize| f64::from(host.moments[y * line + x][i]);
                let blur = |value: &dyn Fn(usize) -> f64| ssim::blur(y, height, value);
                let b = |y| at(y, 0) - at(y, 1);
                let (ma, mb, me) = (blur(&|y| at(y, 0)), blur(&b), blur(&|y| at(y, 1)));
                // Law of total variance.
                let sum = blur(&|y| at(y, 2) + at(y, 0) * at(y, 0) + b(y) * b(y)) - ma * ma - mb * mb;
                let variance = blur(&|y| at(y, 3) + at(y, 1) * at(y, 1)) - me * me;
                let (value, by) = ssim::derivatives([ma, me, sum.max(0.0), variance.max(0.0)]);
                let scale = f64::from(push.factor) * host.weight.map_or(1.0, |w| f64::from(w[(y * line + x) / 3]));
                host.grad_moments[y * line + x] = by.map(|d| (-scale * d) as f32);
                losses[(y / RUN * line + x) / 64] += scale * value;
            }
        }
        for (partial, loss) in host.partial.iter_mut().zip(losses) {
            *partial = loss as f32;
        }
    }
    fn check(binding: &'static str) -> Check {
        match binding {
            // 1 - SSIM is rounded at 6e-8 of one; the tensor's largest partial sum has terms of that size.
            "partial" => Check { relative: 1e-5, absolute: 1e-5, band: 0.0 },
            // Variance and covariance have an error of 12 roundings of the window's squared distance from the run's middle
            // value, against C2 = 9e-4 in the denominator: at most 12 * 6e-8 / 9e-4 = 8e-4 beside the strongest edge,
            // far less where the contrast is the window's own. The derivatives are quotients of these, their sums cancel.
            _ => Check { relative: 1e-4, absolute: 1e-4, band: 0.0 },
        }
    }
}

impl Reference for adjoint::Kernel {
    fn reference(host: adjoint::Host<'_>, push: adjoint::Push, (): ()) {
        let [width, height] = push.size.map(|v| v as usize);
        for (i, out) in host.grad_rows.iter_mut().enumerate().take(3 * width * height) {
            let (row, x, c) = (i / (3 * width) * width, i / 3 % width, i % 3);
            *out = std::array::from_fn(|k| {
                ssim::blur(x, width, |x: usize| f64::from(host.grad_moments[(row + x) * 3 + c][k])) as f32
            });
        }
    }

    fn check(_binding: &'static str) -> Check {
        // 11 roundings of terms that may cancel.
        Check { relative: 1e-5, absolute: 2e-6, band: 0.0 }
    }
}

impl Reference for gradient::Kernel {
    /// `Outside`: no gradient where the weight is 0.
    fn reference(host: gradient::Host<'_>, push: gradient::Push, (): ()) {
        let [width, height] = push.size.map(|v| v as usize);
        let mut losses = vec![0.0; column_groups(push.size)[1]];
        for y in 0..height {
            for x in 0..width {
                let pixel = y * width + x;
                let scale = f64::from(push.factor) * host.weight.map_or(1.0, |w| f64::from(w[pixel]));
                for (c, grad) in host.grad_rendered[pixel].iter_mut().enumerate() {
                    let (a, b) = (f64::from(host.rendered[pixel][c]), f64::from(host.target[pixel][c]));
                    let s: [f64; 3] = host.grad_rows.map_or([0.0; 3], |rows| {
                        let row = |k: usize| move |y: usize| f64::from(rows[(y * width + x) * 3 + c][k]);
                        std::array::from_fn(|k| ssim::blur(y, height, row(k)))
                    });
                    losses[(y / RUN * width + x) / 64] += scale * (a - b).abs();
                    let sign = if a == b { 0.0 } else { (a - b).signum() };
                    if host.kernel == gradient::Kernel::Outside && scale == 0.0 {
                        *grad = 0.0;
                        continue;
                    }
                    let value = s[0] + 2.0 * ((a - 0.5) * s[1] + (a - b) * s[2]) + scale * sign;
                    *grad = value as f32;
                }
            }
        }
        for (partial, loss) in host.partial[push.first as usize..].iter_mut().zip(losses) {
            *partial = loss as f32;
        }
    }
    fn check(binding: &'static str) -> Check {
        match binding {
            "partial" => Check::default(),
            // 14 roundings of 6e-8 of the blurred terms, which are up to 1 / C2 of SSIM's share and cancel where a flat
            // picture meets another: at most 14 * 6e-8 * 0.2 / 0.8 / C2 = 2e-4 of L1's part of the gradient.
            _ => Check { relative: 1e-5, absolute: 1e-4, band: 0.0 },
        }
    }
}

/// Runs along rows.
fn row_runs([width, height]: [u32; 2]) -> u32 {
    width.div_ceil(RUN as u32) * height
}

/// Runs along rows in the form for GPUs.
fn wide_runs([width, height]: [u32; 2]) -> u32 {
    width.div_ceil(WIDE_RUN) * height
}

/// Runs along columns.
fn column_runs([width, height]: [u32; 2]) -> u32 {
    width * height.div_ceil(RUN as u32)
}

/// Workgroups that walk along columns, of `photometric_columns` and of `photometric_gradient`: each has one sum of its
/// part of the loss.
fn column_groups(size: [u32; 2]) -> [usize; 2] {
    [3 * column_runs(size), column_runs(size)].map(|threads| threads.div_ceil(64) as usize)
}

/// The photometric loss and its gradient by the rendered picture.
#[derive(Debug)]
pub struct Photometric {
    size: [u32; 2],
    ssim_weight: f32,
    across: bool,
    ssim: Option<Ssim>,
    grad_rendered: Buffer<[f32; 3]>,
    partial: Buffer<f32>,
}

#[derive(Debug)]
struct Ssim {
    moments: Buffer<[f32; 4]>,
    grad_moments: Buffer<[f32; 3]>,
    grad_rows: Buffer<[f32; 3]>,
}

impl Photometric {
    /// For pictures of `size` = width, height. `ssim_weight` is the share of 1 - SSIM, the rest is L1; at 0 there is
    /// nothing for SSIM.
    ///
    /// Pixels of weight 0 have no term of their own, but windows of others reach them. With `across` the windows compare
    /// both pictures there (GScream's release weights the finished map of SSIM). Without, the pictures count as equal there,
    /// and the pixel has no gradient.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2], ssim_weight: f32, across: bool) -> Result<Self, Error> {
        let pixels = size[0] as usize * size[1] as usize;
        let ssim = || -> Result<Ssim, Error> {
            Ok(Ssim {
                moments: gpu.buffer("ssim_moments", 3 * pixels)?,
                grad_moments: gpu.buffer("grad_ssim_moments", 3 * pixels)?,
                grad_rows: gpu.buffer("grad_ssim_rows", 3 * pixels)?,
            })
        };
        Ok(Self {
            size,
            ssim_weight,
            across,
            ssim: if ssim_weight > 0.0 { Some(ssim()?) } else { None },
            grad_rendered: gpu.buffer("grad_rgb", pixels)?,
            partial: gpu.buffer("photometric_partial", column_groups(size).iter().sum())?,
        })
    }

    /// Records the loss of `rendered` against `target` (both \[pixel\] rgb, with a `weight` per pixel if there is one)
    /// into `losses[slot]` and returns its gradient by `rendered` \[pixel\].
    ///
    /// Without a difference the gradient of L1 is zero.
    pub fn forward_backward(
        &self,
        rec: &mut Recorder<'_>,
        rendered: &Buffer<[f32; 3]>,
        target: &Buffer<[f32; 3]>,
        weight: Option<&Buffer<f32>>,
        losses: &Buffer<f32>,
        slot: u32,
    ) -> &Buffer<[f32; 3]> {
        let Self { size, ssim, grad_rendered, partial, .. } = self;
        let size = *size;
        let per_value = 1.0 / (3.0 * f64::from(size[0]) * f64::from(size[1]));
        let share = f64::from(self.ssim_weight);
        let (of_ssim, of_l1) = ((share * per_value) as f32, ((1.0 - share) * per_value) as f32);
        let down = column_runs(size);
        let [first, last] = column_groups(size).map(|n| n as u32);
        let first = if ssim.is_some() { first } else { 0 };
        let outside = weight.filter(|_| !self.across);
        let mut kernel = gradient::Kernel::Plain;
        if let Some(Ssim { moments, grad_moments, grad_rows }) = ssim {
            let (of_rows, runs) = match rec.gpu().form() {
                Form::Cpu => (rows::Kernel::Plain, row_runs(size)),
                Form::Gpu => (rows::Kernel::Run4, wide_runs(size)),
            };
            let buffers = rows::Buffers { rendered, target, moments, weight: outside };
            rec.run(of_rows, buffers, rows::Push { size }, runs);
            let buffers = columns::Buffers { moments, grad_moments, partial, weight };
            rec.run(columns::Kernel, buffers, columns::Push { size, factor: of_ssim }, 3 * down);
            let buffers = adjoint::Buffers { grad_moments, grad_rows };
            rec.run(adjoint::Kernel, buffers, adjoint::Push { size }, 3 * row_runs(size));
            if outside.is_some() {
                kernel = gradient::Kernel::Outside;
            }
        }
        let grad_rows = ssim.as_ref().map(|ssim| &ssim.grad_rows);
        let buffers = gradient::Buffers { grad_rows, rendered, target, grad_rendered, partial, weight };
        rec.run(kernel, buffers, gradient::Push { size, factor: of_l1, first }, down);
        sum::record(rec, partial, first + last, 1, losses, slot);
        grad_rendered
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use rand::{RngExt, SeedableRng};

    const SIZES: [[u32; 2]; 6] = [[1, 1], [1, 17], [17, 1], [63, 2], [53, 37], [252, 142]];

    /// Pairs of pictures: unlike noise, noise close to its target, one brightness, the same picture twice, hard edges.
    fn pictures(size: [u32; 2]) -> Vec<[Vec<[f32; 3]>; 2]> {
        let mut rng = rand_pcg::Pcg32::seed_from_u64(u64::from(size[0] * 1000 + size[1]));
        let pixels = (size[0] * size[1]) as usize;
        let mut noise = || -> Vec<[f32; 3]> { (0..pixels).map(|_| std::array::from_fn(|_| rng.random())).collect() };
        let (a, b, c) = (noise(), noise(), noise());
        let near: Vec<[f32; 3]> =
            a.iter().zip(&b).map(|(a, b)| std::array::from_fn(|i| a[i] + 0.02 * (b[i] - 0.5))).collect();
        let edges = (0..size[0] * size[1])
            .map(|p| std::array::from_fn(|i| ((p % size[0] / 9 + p / size[0] / (7 + i as u32)) % 2) as f32))
            .collect();
        let bright = vec![[0.9, 1.0, 0.8]; pixels];
        vec![
            [a.clone(), b],
            [a.clone(), near],
            [bright.clone(), vec![[0.9, 0.98, 0.2]; pixels]],
            [bright, c.clone()],
            [a.clone(), a],
            [edges, c],
        ]
    }

    fn weights(size: [u32; 2]) -> Vec<f32> {
        (0..size[0] * size[1]).map(|p| [1.0, 20.0, 0.0][(p / 5 % 3) as usize]).collect()
    }

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        for size in SIZES {
            let n = 3 * (size[0] * size[1]) as usize;
            let first = column_groups(size)[0] as u32;
            for [rendered, target] in pictures(size) {
                let [plain, weighted] = [None, Some(weights(size))];
                let mut case = rows::Arrays {
                    rendered: rendered.clone(),
                    target: target.clone(),
                    moments: vec![[UNWRITTEN; 4]; n + 2],
                    weight: None,
                };
                let push = rows::Push { size };
                let moments = testing::run_once(rows::Kernel::Plain, &gpu, &case, push, row_runs(size)).moments;
                for weight in [plain.clone(), weighted.clone()] {
                    case.weight = weight;
                    testing::assert_twin(rows::Kernel::Plain, &gpu, case.clone(), push, row_runs(size));
                    testing::assert_twin(rows::Kernel::Run4, &gpu, case.clone(), push, wide_runs(size));
                }
                let partial = vec![UNWRITTEN; column_groups(size).iter().sum()];
                let grad_moments = vec![[UNWRITTEN; 3]; n];
                let mut case = columns::Arrays { moments, grad_moments, partial: partial.clone(), weight: None };
                let push = columns::Push { size, factor: 0.3 };
                let down = column_runs(size);
                let grad_moments = testing::run_once(columns::Kernel, &gpu, &case, push, 3 * down).grad_moments;
                for weight in [plain.clone(), weighted.clone()] {
                    case.weight = weight;
                    testing::assert_twin(columns::Kernel, &gpu, case.clone(), push, 3 * down);
                }
                let case = adjoint::Arrays { grad_moments, grad_rows: vec![[UNWRITTEN; 3]; n] };
                let (push, across) = (adjoint::Push { size }, 3 * row_runs(size));
                testing::assert_twin(adjoint::Kernel, &gpu, case.clone(), push, across);
                let grad_rows = testing::run_once(adjoint::Kernel, &gpu, &case, push, across).grad_rows;
                let (plain_kernel, outside) = (gradient::Kernel::Plain, gradient::Kernel::Outside);
                for (kernel, grad_rows, weight) in [
                    (plain_kernel, Some(&grad_rows), &plain),
                    (plain_kernel, Some(&grad_rows), &weighted),
                    (outside, Some(&grad_rows), &weighted),
                    (plain_kernel, None, &plain),
                    (plain_kernel, None, &weighted),
                ] {
                    let case = gradient::Arrays {
                        grad_rows: grad_rows.cloned(),
                        rendered: rendered.clone(),
                        target: target.clone(),
                        grad_rendered: vec![[UNWRITTEN; 3]; n / 3],
                        partial: partial.clone(),
                        weight: weight.clone(),
                    };
                    let push = gradient::Push { size, factor: 0.7, first };
                    testing::assert_twin(kernel, &gpu, case, push, down);
                }
            }
        }
    }

    /// The loss from its definition.
    fn loss(rendered: &[[f64; 3]], target: &[[f64; 3]], weight: &[f32], size: [usize; 2]) -> f64 {
        let plane = |v: &[[f64; 3]], c: usize| -> Vec<f64> { v.iter().map(|v| v[c]).collect() };
        let mut sum = 0.0;
        for c in 0..3 {
            let (a, b) = (plane(rendered, c), plane(target, c));
            let ssim = ssim::map(&a, &b, size[0], size[1]);
            sum += (0..a.len())
                .map(|p| f64::from(weight[p]) * (0.8 * (a[p] - b[p]).abs() + 0.2 * (1.0 - ssim[p])))
                .sum::<f64>();
        }
        sum / (3 * weight.len()) as f64
    }

    fn run(
        gpu: &Gpu,
        size: [u32; 2],
        rendered: &[[f32; 3]],
        target: &[[f32; 3]],
        weight: Option<&[f32]>,
    ) -> (f32, Vec<f32>) {
        run_with(gpu, size, rendered, target, weight, true)
    }

    fn run_with(
        gpu: &Gpu,
        size: [u32; 2],
        rendered: &[[f32; 3]],
        target: &[[f32; 3]],
        weight: Option<&[f32]>,
        across: bool,
    ) -> (f32, Vec<f32>) {
        let stage = Photometric::new(gpu, size, 0.2, across).expect("buffers");
        let rendered = gpu.upload("rgb", rendered).expect("upload");
        let target = gpu.upload("target", target).expect("upload");
        let weight = weight.map(|w| gpu.upload("weight", w).expect("upload"));
        let losses = gpu.upload("losses", &[UNWRITTEN; 3]).expect("upload");
        let mut rec = gpu.checked().expect("recorder");
        let grad = stage.forward_backward(&mut rec, &rendered, &target, weight.as_ref(), &losses, 1);
        let submission = rec.submit().expect("submit");
        for difference in &submission.differences {
            assert!(difference.ok(), "{difference}");
        }
        submission.wait().expect("wait");
        let terms = gpu.read(&losses).expect("read");
        assert!(terms[0].is_nan() && terms[2].is_nan(), "other slots are not touched");
        (terms[1], gpu.read(grad).expect("read").into_flattened())
    }

    /// Where nothing weighs, what is behind the object must not be drawn to the object: not by its own pixels, and not by
    /// the windows of those beside them. In GScream's form the windows do it.
    #[test]
    fn windows_do_not_reach_into_the_mask() {
        let gpu = testing::gpu();
        let size = [19, 14];
        let inside = |p: usize| (6..13).contains(&(p % 19)) && (4..10).contains(&(p / 19));
        let weight: Vec<f32> = (0..19 * 14).map(|p| if inside(p) { 0.0 } else { 1.0 }).collect();
        let [rendered, target] = pictures(size)[0].clone();
        let (value, grad) = run_with(&gpu, size, &rendered, &target, Some(&weight), false);
        let reaches_in = |grad: &[f32]| grad.iter().enumerate().any(|(i, g)| inside(i / 3) && *g != 0.0);
        assert!(!reaches_in(&grad));
        assert!(reaches_in(&run_with(&gpu, size, &rendered, &target, Some(&weight), true).1));
        // Outside it is the slope of the loss against a photograph that shows inside what is drawn there.
        let double = |v: &[[f32; 3]]| -> Vec<[f64; 3]> { v.iter().map(|v| v.map(f64::from)).collect() };
        let (mut a, mut b) = (double(&rendered), double(&target));
        (0..a.len()).filter(|p| inside(*p)).for_each(|p| b[p] = a[p]);
        let sizes = size.map(|v| v as usize);
        let want = loss(&a, &b, &weight, sizes);
        assert!((f64::from(value) - want).abs() < 3e-6 * want, "{value} instead of {want}");
        let scale = grad.iter().fold(0.0_f32, |m, g| m.max(g.abs()));
        for p in (0..a.len()).filter(|p| !inside(*p)).step_by(5) {
            let (old, step) = (a[p][1], 1e-5);
            if (old - b[p][1]).abs() < 2.0 * step {
                continue;
            }
            let mut at = |v: f64| {
                a[p][1] = v;
                loss(&a, &b, &weight, sizes)
            };
            let slope = (at(old + step) - at(old - step)) / (2.0 * step);
            at(old);
            // The central difference is good to step^2 times the third derivative, some 1 / C2^2 of SSIM's share.
            assert!((f64::from(grad[3 * p + 1]) - slope).abs() < 2e-3 * f64::from(scale), "{p}: {slope}");
        }
    }

    #[test]
    fn gradient_is_the_slope_of_the_definition() {
        let gpu = testing::gpu();
        let size = [19, 14];
        let weight = weights(size);
        for [rendered, target] in &pictures(size)[..2] {
            let (value, grad) = run(&gpu, size, rendered, target, Some(&weight));
            let double = |v: &[[f32; 3]]| -> Vec<[f64; 3]> { v.iter().map(|v| v.map(f64::from)).collect() };
            let (mut a, b) = (double(rendered), double(target));
            let sizes = size.map(|v| v as usize);
            let want = loss(&a, &b, &weight, sizes);
            assert!((f64::from(value) - want).abs() < 3e-6 * want, "{value} instead of {want}");
            let scale = grad.iter().fold(0.0_f32, |m, g| m.max(g.abs()));
            for p in (0..a.len()).step_by(7) {
                for c in 0..3 {
                    let (old, step) = (a[p][c], 1e-5);
                    if (old - b[p][c]).abs() < 2.0 * step {
                        continue;
                    }
                    a[p][c] = old + step;
                    let above = loss(&a, &b, &weight, sizes);
                    a[p][c] = old - step;
                    let below = loss(&a, &b, &weight, sizes);
                    a[p][c] = old;
                    let (slope, got) = ((above - below) / (2.0 * step), grad[3 * p + c]);
                    // The third derivative of SSIM is of order C2^-1.5 of the weight: 1e-5^2 / 6 * 4e4 = 6e-7 of it.
                    assert!(
                        (slope - f64::from(got)).abs() < 2e-5 * f64::from(scale),
                        "[{p}][{c}] {got}, slope {slope}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_same_picture_has_no_loss_and_hardly_a_gradient() {
        let gpu = testing::gpu();
        let size = [53, 37];
        let values = 3.0 * 53.0 * 37.0;
        for pictures in pictures(size) {
            for picture in pictures {
                let (value, grad) = run(&gpu, size, &picture, &picture, None);
                assert!(value.abs() < 1e-6, "{value}");
                // Terms of 2 / C2 cancel: at most 32 roundings of 0.2 * 2 / 9e-4 / (3 W H).
                let limit = 32.0 * 6e-8 * 0.2 * 2.0 / 9e-4 / values;
                assert!(
                    grad.iter().all(|g| g.abs() < limit),
                    "{:?} above {limit}",
                    grad.iter().fold(0.0_f32, |m, g| m.max(g.abs()))
                );
            }
        }
    }

    #[test]
    fn no_weight_no_gradient() {
        let gpu = testing::gpu();
        let size = [53, 37];
        for [a, b] in pictures(size) {
            let (value, grad) = run(&gpu, size, &a, &b, Some(&vec![0.0; a.len()]));
            assert!(value == 0.0 && grad.iter().all(|&g| g == 0.0));
        }
    }

    #[test]
    fn a_weight_of_one_is_no_weight() {
        let gpu = testing::gpu();
        let size = [53, 37];
        for [a, b] in pictures(size) {
            assert_eq!(run(&gpu, size, &a, &b, Some(&vec![1.0; a.len()])), run(&gpu, size, &a, &b, None));
        }
    }
}

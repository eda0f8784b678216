//! Online depth alignment (GScream, equation 4): the rendered depth is fitted to the view's prior by least squares over
//! the valid pixels, and gradients flow through the fit.
//!
//! The sums are taken in trees and in two passes, means first and moments about them: with one pass of plain moments the
//! determinant would lose `mean^2 / variance` of its digits.

use crate::cost::{Formula, if_so, work};
use crate::gpu::kernels::losses::{align_backward, align_fit, align_gradient, align_means, align_moments};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::align::{Fit, alignable, alignable_slope, unit};

use super::sum;

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[
    Formula {
        pass: "losses/align_means",
        variants: &["masked"],
        derivation: "per pixel depth and prior 8 B, with a mask 4; 6 operations",
        work: |c, d| work((8.0 + 4.0 * if_so(d.is("masked"))) * c.pixels, 6.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/align_moments",
        variants: &["masked"],
        derivation: "per pixel depth and prior 8 B, with a mask 4; 13 operations",
        work: |c, d| work((8.0 + 4.0 * if_so(d.is("masked"))) * c.pixels, 13.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/align_fit",
        variants: &[],
        derivation: "7 sums read, 11 values written: 72 B; 45 operations",
        work: |_, _| work(72.0, 45.0, 0.0),
    },
    Formula {
        pass: "losses/align_backward",
        variants: &[],
        derivation: "per pixel gradient and depth 8 B; 6 operations",
        work: |c, _| work(8.0 * c.pixels, 6.0 * c.pixels, 0.0),
    },
    Formula {
        pass: "losses/align_gradient",
        variants: &["masked"],
        derivation: "per pixel gradient, depth, prior and result 16 B, with a mask 4; 15 operations",
        work: |c, d| work((16.0 + 4.0 * if_so(d.is("masked"))) * c.pixels, 15.0 * c.pixels, 0.0),
    },
];

/// Pixels of a workgroup that sums over pixels: RUN in the kernels times 64.
const GROUP_PIXELS: usize = 8 * 64;

/// Workgroups that sum over so many pixels.
pub(super) fn groups(pixels: u32) -> u32 {
    pixels.div_ceil(GROUP_PIXELS as u32)
}

/// Threads of these workgroups.
pub(super) fn threads(pixels: u32) -> u32 {
    64 * groups(pixels)
}

/// One row of partial sums per term.
pub(super) fn partial_sums<const N: usize>(pixels: u32, partial: &mut [f32], term: impl Fn(usize) -> [f64; N]) {
    let groups = groups(pixels) as usize;
    for group in 0..groups {
        let mut sums = [0.0; N];
        for pixel in group * GROUP_PIXELS..((group + 1) * GROUP_PIXELS).min(pixels as usize) {
            for (sum, term) in sums.iter_mut().zip(term(pixel)) {
                *sum += term;
            }
        }
        for (row, sum) in sums.into_iter().enumerate() {
            partial[row * groups + group] = sum as f32;
        }
    }
}

/// What a prior means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Quantity {
    /// A scaled and shifted depth.
    Depth,
    /// A scaled and shifted disparity. The rendered depth's disparity is fitted to it: `1 / depth`, below `near` (scene
    /// units) its tangent.
    Disparity {
        /// Where the tangent begins.
        near: f32,
    },
}

impl Quantity {
    /// `near` as the kernels have it.
    pub(super) fn near(self) -> f32 {
        match self {
            Self::Depth => 0.0,
            Self::Disparity { near } => near,
        }
    }
}

/// 1 where the fit looks.
fn looks(valid: Option<&[f32]>, pixel: usize) -> f64 {
    valid.map_or(1.0, |valid| f64::from(valid[pixel]))
}

impl Reference for align_means::Kernel {
    fn reference(host: align_means::Host<'_>, push: align_means::Push, (): ()) {
        partial_sums(push.pixels, host.partial, |i| {
            let v = looks(host.valid, i);
            [v, v * alignable(host.rendered[i].into(), push.near.into()), v * f64::from(host.prior[i])]
        });
    }
    /// The sums of terms of one sign pass through 8 + 14 additions; distances from the mean cancel, and are small against
    /// the largest sum of the tensor where the means are right.
    fn check(_binding: &'static str) -> Check {
        Check { relative: 3e-6, absolute: 3e-6, band: 0.0 }
    }
}

impl Reference for align_moments::Kernel {
    fn reference(host: align_moments::Host<'_>, push: align_moments::Push, (): ()) {
        // The means of the device's sums, in float32 as there: the distances' sums are these means' rounding.
        let sums = host.sums;
        let inverse = if sums[0] > 0.0 { 1.0 / sums[0] } else { 0.0 };
        let mean = [f64::from(sums[1] * inverse), f64::from(sums[2] * inverse)];
        let unit = unit(sums[0].into(), sums[1].into());
        partial_sums(push.pixels, host.partial, |i| {
            let v = looks(host.valid, i);
            let dx = (alignable(host.rendered[i].into(), push.near.into()) - mean[0]) * unit;
            let dp = f64::from(host.prior[i]) - mean[1];
            [v * dx, v * dp, v * dx * dx, v * dx * dp]
        });
    }
    /// Distances carry the rounding of the mean and of the disparity: 3 * 6e-8 of the value each, up to ten times their
    /// own size where the values spread over a tenth of their mean; the products are as inexact as the distances.
    fn check(_binding: &'static str) -> Check {
        Check { relative: 1e-5, absolute: 1e-5, band: 0.0 }
    }
    fn cancels(_binding: &'static str) -> bool {
        true // sums of distances from the mean
    }
}

impl Reference for align_fit::Kernel {
    fn reference(host: align_fit::Host<'_>, (): (), (): ()) {
        let sums = std::array::from_fn(|i| f64::from(host.sums[i]));
        host.fit.copy_from_slice(&Fit::of(sums).to_array().map(|v| v as f32));
    }
    fn check(_binding: &'static str) -> Check {
        // q = mean prior - w mean: a few roundings of the larger of the two.
        Check { relative: 1e-6, absolute: 5e-7, band: 0.0 }
    }
}

fn read_fit(fit: &[f32]) -> Fit {
    Fit::from_array(std::array::from_fn(|i| f64::from(fit[i])))
}

impl Reference for align_backward::Kernel {
    fn reference(host: align_backward::Host<'_>, push: align_backward::Push, (): ()) {
        let fit = read_fit(host.fit);
        partial_sums(push.pixels, host.partial, |i| {
            let g = f64::from(host.grad_aligned[i]);
            [g, g * (alignable(host.rendered[i].into(), push.near.into()) - fit.mean - fit.mean_rest) * fit.unit]
        });
    }
    fn check(_binding: &'static str) -> Check {
        // 22 roundings of 512 terms of either sign; the largest partial sum is about sqrt(512) of them.
        Check { relative: 1e-5, absolute: 22.0 * 6e-8 * 23.0, band: 0.0 }
    }
}

impl Reference for align_gradient::Kernel {
    fn reference(host: align_gradient::Host<'_>, push: align_gradient::Push, (): ()) {
        let fit = read_fit(host.fit);
        let sums = [f64::from(host.sums[0]), f64::from(host.sums[1])];
        for (i, out) in host.grad_depth.iter_mut().enumerate().take(push.pixels as usize) {
            let (depth, near) = (f64::from(host.rendered[i]), f64::from(push.near));
            let (grad, prior, v) = (host.grad_aligned[i].into(), host.prior[i].into(), looks(host.valid, i));
            let grad = fit.gradient(grad, sums, alignable(depth, near), prior, v);
            *out = (grad * alignable_slope(depth, near)) as f32;
        }
    }
    /// Four terms of a few roundings each, which may cancel.
    fn check(_binding: &'static str) -> Check {
        Check { relative: 1e-5, absolute: 2e-6, band: 0.0 }
    }
}

/// A view's prior and the pixels the fit looks at.
#[derive(Clone, Copy)]
pub struct Prior<'a> {
    /// The prior \[pixel\].
    pub values: &'a Buffer<f32>,
    /// What it means.
    pub quantity: Quantity,
    /// 1 where the fit looks, 0 elsewhere \[pixel\]; all pixels without it.
    pub valid: Option<&'a Buffer<f32>>,
}

/// A fit that is given, `aligned = scale x + shift`, as [`Align::forward`] has them. It has no gradient: what the gradient
/// through the fit is multiplied by is zero.
pub fn fixed([scale, shift]: [f64; 2]) -> [f32; 11] {
    let (scale, shift) = (scale as f32, shift as f32);
    [scale, shift, 0.0, shift, scale, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
}

/// The fit and its gradient.
#[derive(Debug)]
pub struct Align {
    pixels: u32,
    partial: Buffer<f32>,
    sums: Buffer<f32>,
    grad_sums: Buffer<f32>,
    fit: Buffer<f32>,
    grad_depth: Buffer<f32>,
}

impl Align {
    /// For maps of `size` = width, height.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Self, Error> {
        let pixels = size[0] * size[1];
        Ok(Self {
            pixels,
            partial: gpu.buffer("align_partial", 4 * groups(pixels) as usize)?,
            sums: gpu.buffer("align_sums", 7)?,
            grad_sums: gpu.buffer("grad_align_sums", 2)?,
            fit: gpu.buffer("fit", 11)?,
            grad_depth: gpu.buffer("grad_depth", pixels as usize)?,
        })
    }

    /// Records the fit of `rendered` \[pixel\] to the prior and returns it: |w|, q, mean x, aligned less prior at the means,
    /// w, `1 / sum dx^2`, mean prior, 1 / n, units per x, what the means lack. All but the first two are of use to [`Align::backward`] only.
    pub fn forward(&self, rec: &mut Recorder<'_>, rendered: &Buffer<f32>, prior: Prior<'_>) -> &Buffer<f32> {
        let Self { pixels, partial, sums, fit, .. } = self;
        let (pixels, near) = (*pixels, prior.quantity.near());
        let (threads, groups) = (threads(pixels), groups(pixels));
        let Prior { values: prior, valid, .. } = prior;
        let buffers = align_means::Buffers { rendered, prior, partial, valid };
        rec.run(align_means::Kernel, buffers, align_means::Push { pixels, near }, threads);
        sum::record(rec, partial, groups, 3, sums, 0);
        let buffers = align_moments::Buffers { rendered, prior, sums, partial, valid };
        rec.run(align_moments::Kernel, buffers, align_moments::Push { pixels, near }, threads);
        sum::record(rec, partial, groups, 4, sums, 3);
        rec.run(align_fit::Kernel, align_fit::Buffers { sums, fit }, (), 1u32);
        fit
    }

    /// Records the gradient by `rendered` \[pixel\] from that by the aligned values, directly and through the fit: the one
    /// that [`Align::forward`] returned, or a [`fixed`] one.
    pub fn backward(
        &self,
        rec: &mut Recorder<'_>,
        grad_aligned: &Buffer<f32>,
        rendered: &Buffer<f32>,
        prior: Prior<'_>,
        fit: &Buffer<f32>,
    ) -> &Buffer<f32> {
        let Self { pixels, partial, grad_sums, grad_depth, .. } = self;
        let (pixels, near) = (*pixels, prior.quantity.near());
        let buffers = align_backward::Buffers { grad_aligned, rendered, fit, partial };
        rec.run(align_backward::Kernel, buffers, align_backward::Push { pixels, near }, threads(pixels));
        sum::record(rec, partial, groups(pixels), 2, grad_sums, 0);
        let Prior { values: prior, valid, .. } = prior;
        let buffers =
            align_gradient::Buffers { grad_aligned, rendered, prior, fit, sums: grad_sums, grad_depth, valid };
        rec.run(align_gradient::Kernel, buffers, align_gradient::Push { pixels, near }, pixels);
        grad_depth
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use rand::{RngExt, SeedableRng};

    /// Sizes about the workgroups' borders, arrays longer than the picture.
    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = rand_pcg::Pcg32::seed_from_u64(6);
        for pixels in [0_u32, 1, 63, 64, 65, 511, 512, 513, 1000, 35784] {
            for near in [0.0, 0.2] {
                let n = pixels as usize + 3;
                let mut noise = |low: f32, high: f32| -> Vec<f32> {
                    (0..n).map(|_| low + (high - low) * rng.random::<f32>()).collect()
                };
                let (rendered, prior, grad_aligned) = (noise(0.0, 6.0), noise(0.2, 0.9), noise(-1.0, 1.0));
                let valid: Vec<f32> = noise(0.0, 1.0).into_iter().map(f32::round).collect();
                let partial = vec![UNWRITTEN; 4 * groups(pixels) as usize + 1];
                let threads = threads(pixels);
                let valids = [None, Some(valid)];
                for valid in &valids {
                    let case = align_means::Arrays {
                        rendered: rendered.clone(),
                        prior: prior.clone(),
                        partial: partial.clone(),
                        valid: valid.clone(),
                    };
                    let push = align_means::Push { pixels, near };
                    testing::assert_twin(align_means::Kernel, &gpu, case, push, threads);
                }
                for (n, valid) in [0.0, 1.0, pixels as f32].into_iter().flat_map(|n| valids.iter().map(move |v| (n, v)))
                {
                    let case = align_moments::Arrays {
                        rendered: rendered.clone(),
                        prior: prior.clone(),
                        sums: vec![n, 2.5 * n, 0.5 * n],
                        partial: partial.clone(),
                        valid: valid.clone(),
                    };
                    let push = align_moments::Push { pixels, near };
                    testing::assert_twin(align_moments::Kernel, &gpu, case, push, threads);
                }
                for slope in [0.1_f32, -0.1, 0.0] {
                    let fit =
                        vec![slope.abs(), 0.3, 2.9, 0.5, slope, 1.0 / n as f32, 0.6, 1.0 / n as f32, 0.25, 1e-3, -2e-3];
                    let case = align_backward::Arrays {
                        grad_aligned: grad_aligned.clone(),
                        rendered: rendered.clone(),
                        fit: fit.clone(),
                        partial: partial.clone(),
                    };
                    let push = align_backward::Push { pixels, near };
                    testing::assert_twin(align_backward::Kernel, &gpu, case, push, threads);
                    for valid in &valids {
                        let case = align_gradient::Arrays {
                            grad_aligned: grad_aligned.clone(),
                            rendered: rendered.clone(),
                            prior: prior.clone(),
                            fit: fit.clone(),
                            sums: vec![0.4, -1.7],
                            grad_depth: vec![UNWRITTEN; n],
                            valid: valid.clone(),
                        };
                        let push = align_gradient::Push { pixels, near };
                        testing::assert_twin(align_gradient::Kernel, &gpu, case, push, pixels);
                    }
                }
            }
        }
    }

    #[test]
    fn singular_fits_are_seen() {
        let gpu = testing::gpu();
        let regular = vec![100.0, 250.0, 50.0, 1e-4, -1e-4, 80.0, -8.0];
        let cases = [
            regular.clone(),
            vec![0.0; 7],
            vec![1.0, 2.5, 0.5, 0.0, 0.0, 0.0, 0.0],
            // A spread of one rounding per pixel.
            vec![100.0, 250.0, 50.0, 0.0, 0.0, 100.0 * (2.5_f32 * 6e-8).powi(2), 1e-9],
            vec![100.0, 0.0, 50.0, 0.0, 0.0, 1e-40, 0.0],
            vec![100.0, f32::NAN, 50.0, f32::NAN, 0.0, f32::NAN, f32::NAN],
        ];
        for (i, sums) in cases.into_iter().enumerate() {
            let case = align_fit::Arrays { sums, fit: vec![UNWRITTEN; 11] };
            testing::assert_twin(align_fit::Kernel, &gpu, case.clone(), (), 1u32);
            let fit = testing::run_once(align_fit::Kernel, &gpu, &case, (), 1u32).fit;
            assert_eq!(fit[0] == 0.0 && fit[1] == 0.0 && fit[5] == 0.0, i > 0, "{i}: {fit:?}");
        }
    }
}

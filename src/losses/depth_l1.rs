//! Weighted L1 between the aligned rendered depth and the prior (GScream, equation 5): `1 / (W H) sum weight |d|` with
//! d = aligned - prior.

use super::Term;
use crate::cost::{Formula, if_so, work};
use crate::gpu::kernels::losses::depth_l1;
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::align::{Fit, alignable};

use super::align::{Prior, groups, partial_sums, threads};
use super::sum;

/// As reports and plans know it.
pub const TERM: Term = Term {
    name: "depth_l1",
    stage: "depth",
    planned: |plan| plan.depth,
    left_out: &["depth map, its gradient, alignment and depth losses"],
    costs: COSTS,
};

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[Formula {
    pass: "losses/depth_l1",
    variants: &["weighted"],
    derivation: "per pixel depth, prior, difference and gradient 16 B, with weights 4; 10 operations",
    work: |c, d| work((16.0 + 4.0 * if_so(d.is("weighted"))) * c.pixels, 10.0 * c.pixels, 0.0),
}];

impl Reference for depth_l1::Kernel {
    fn reference(host: depth_l1::Host<'_>, push: depth_l1::Push, (): ()) {
        let depth_l1::Push { pixels, near, factor } = push;
        let fit = Fit::from_array(std::array::from_fn(|i| f64::from(host.fit[i])));
        let d = |i: usize| fit.difference(alignable(host.rendered[i].into(), near.into()), host.prior[i].into());
        let scale = |i: usize| f64::from(factor) * host.weight.map_or(1.0, |w| f64::from(w[i]));
        for i in 0..pixels as usize {
            let d = d(i);
            host.difference[i] = d as f32;
            host.grad_aligned[i] = if d == 0.0 { 0.0 } else { (scale(i) * d.signum()) as f32 };
        }
        partial_sums(pixels, host.partial, |i| [scale(i) * d(i).abs()]);
    }
    fn check(binding: &'static str) -> Check {
        match binding {
            // A sign may flip where the difference is within its rounding, 1e-6 of the depths, of zero.
            "grad_aligned" => Check { relative: 1e-6, absolute: 0.0, band: 1e-5 },
            // Six roundings of 6e-8 of the aligned value and the prior, which cancel to a hundredth of them in a good fit.
            _ => Check { relative: 1e-6, absolute: 4e-5, band: 0.0 },
        }
    }
}

/// Weights of the pixels.
#[derive(Clone, Copy)]
pub enum Weight<'a> {
    /// Of all pixels.
    All(f32),
    /// Of each \[pixel\].
    Each(&'a Buffer<f32>),
}

/// The depth L1 loss and its gradient by the aligned values.
#[derive(Debug)]
pub struct DepthL1 {
    pixels: u32,
    difference: Buffer<f32>,
    grad_aligned: Buffer<f32>,
    partial: Buffer<f32>,
}

impl DepthL1 {
    /// For maps of `size` = width, height.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Self, Error> {
        let pixels = size[0] * size[1];
        Ok(Self {
            pixels,
            difference: gpu.buffer("depth_difference", pixels as usize)?,
            grad_aligned: gpu.buffer("grad_aligned", pixels as usize)?,
            partial: gpu.buffer("depth_l1_partial", groups(pixels) as usize)?,
        })
    }

    /// Records the loss of `rendered` \[pixel\] under `fit` into `losses[slot]` and returns aligned - prior and the
    /// loss's gradient by the aligned values, both \[pixel\]. Where they agree the gradient is zero.
    #[expect(
        clippy::too_many_arguments,
        reason = "a loss takes what it compares, its weights and where its value goes"
    )]
    pub fn forward_backward(
        &self,
        rec: &mut Recorder<'_>,
        rendered: &Buffer<f32>,
        prior: Prior<'_>,
        fit: &Buffer<f32>,
        weight: Weight<'_>,
        losses: &Buffer<f32>,
        slot: u32,
    ) -> (&Buffer<f32>, &Buffer<f32>) {
        let Self { pixels, difference, grad_aligned, partial } = self;
        let (pixels, near, values) = (*pixels, prior.quantity.near(), prior.values);
        let (all, weight) = match weight {
            Weight::All(weight) => (weight, None),
            Weight::Each(weight) => (1.0, Some(weight)),
        };
        let buffers = depth_l1::Buffers { rendered, prior: values, fit, difference, grad_aligned, partial, weight };
        let push = depth_l1::Push { pixels, near, factor: all / pixels as f32 };
        rec.run(depth_l1::Kernel, buffers, push, threads(pixels));
        sum::record(rec, partial, groups(pixels), 1, losses, slot);
        (difference, grad_aligned)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use rand::{RngExt, SeedableRng};

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = rand_pcg::Pcg32::seed_from_u64(7);
        for pixels in [0_u32, 1, 63, 64, 65, 511, 512, 513, 1000, 35784] {
            for near in [0.0, 0.2] {
                let n = pixels as usize + 3;
                let mut noise = || -> Vec<f32> { (0..n).map(|_| rng.random()).collect() };
                let unwritten = vec![UNWRITTEN; n];
                let mut case = depth_l1::Arrays {
                    rendered: noise(),
                    prior: noise(),
                    fit: vec![0.3, 0.2, 0.5, 0.4, -0.3, 0.1, 0.2, 0.1, 0.5, 1e-3, -2e-3],
                    difference: unwritten.clone(),
                    grad_aligned: unwritten.clone(),
                    partial: vec![UNWRITTEN; groups(pixels) as usize + 1],
                    weight: None,
                };
                let push = depth_l1::Push { pixels, near, factor: 0.7 };
                testing::assert_twin(depth_l1::Kernel, &gpu, case.clone(), push, threads(pixels));
                case.weight = Some(noise());
                testing::assert_twin(depth_l1::Kernel, &gpu, case, push, threads(pixels));
            }
        }
    }

    #[test]
    fn agreement_has_no_gradient() {
        let gpu = testing::gpu();
        let case = depth_l1::Arrays {
            rendered: vec![2.0, 3.0],
            prior: vec![1.0, 1.5],
            fit: vec![0.5, 0.0, 2.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0],
            difference: vec![UNWRITTEN; 2],
            grad_aligned: vec![UNWRITTEN; 2],
            partial: vec![UNWRITTEN],
            weight: None,
        };
        let got = testing::run_once(
            depth_l1::Kernel,
            &gpu,
            &case,
            depth_l1::Push { pixels: 2, near: 0.0, factor: 1.0 },
            threads(2),
        );
        assert_eq!((got.difference, got.grad_aligned, got.partial), (vec![0.0; 2], vec![0.0; 2], vec![0.0]));
    }
}

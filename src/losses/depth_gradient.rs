//! Multi-scale total variation of the depth difference (GScream, equation 6): the sum over scales s of
//! `1 / sum(mask) sum |grad(mask d)|` over every 2^s-th pixel of every 2^s-th line, d = aligned - prior. A scale without
//! a valid pixel counts nothing.

use super::Term;
use crate::cost::{Formula, if_so, work};
use crate::gpu::kernels::losses::{depth_gradient, depth_gradient_counts};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};

use super::align::{groups, partial_sums, threads};
use super::sum;

/// As reports and plans know it.
pub const TERM: Term = Term {
    name: "depth_gradient",
    stage: "depth gradient",
    planned: |plan| plan.depth && plan.gradient_scales > 0,
    left_out: &["depth gradient", "depth map, its gradient, alignment and depth losses"],
    costs: COSTS,
};

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[
    Formula {
        pass: "losses/depth_gradient",
        variants: &["masked"],
        derivation: "per pixel difference 4 and gradient read and written 8 B, with a mask 4; 4 operations, and 26 per scale that \
                     has the pixel (four neighbours of 4, loss 8, sum 2): 1, 1/4, 1/16, ... of all",
        work: |c, d| {
            let scales: f64 = (0..c.gradient_scales as i32).map(|s| 0.25f64.powi(s)).sum();
            work((12.0 + 4.0 * if_so(d.is("masked"))) * c.pixels, (4.0 + 26.0 * scales) * c.pixels, 0.0)
        },
    },
    Formula {
        pass: "losses/depth_gradient_counts",
        variants: &[],
        derivation: "per pixel its mask 4 B; per scale a comparison, a selection and an addition",
        work: |c, _| work(4.0 * c.pixels, 3.0 * c.gradient_scales * c.pixels, 0.0),
    },
];

/// The kernels' largest number of scales.
pub const MAX_SCALES: u32 = 8;

/// Whether scale `s` has this pixel.
fn has(s: u32, pixel: usize, width: usize) -> bool {
    (pixel % width).is_multiple_of(1 << s) && (pixel / width).is_multiple_of(1 << s)
}

impl Reference for depth_gradient_counts::Kernel {
    fn reference(host: depth_gradient_counts::Host<'_>, push: depth_gradient_counts::Push, (): ()) {
        let [width, height] = push.size;
        let groups = groups(width * height) as usize;
        for s in 0..push.scales.min(MAX_SCALES) {
            partial_sums(width * height, &mut host.partial[s as usize * groups..], |i| {
                [if has(s, i, width as usize) { f64::from(host.valid[i]) } else { 0.0 }]
            });
        }
    }
    fn check(_binding: &'static str) -> Check {
        // Counts are exact; a mask of other values is summed in 22 additions.
        Check { relative: 2e-6, absolute: 0.0, band: 0.0 }
    }
}

/// Pixels of scale s along a side.
fn along(side: u32, s: u32) -> u32 {
    side.div_ceil(1 << s)
}

impl Reference for depth_gradient::Kernel {
    fn reference(host: depth_gradient::Host<'_>, push: depth_gradient::Push, (): ()) {
        let [width, height] = push.size.map(|v| v as usize);
        let mut grad = vec![0.0; width * height];
        let mut loss = vec![0.0; width * height];
        let mask = |i: usize| host.valid.map_or(1.0, |valid| f64::from(valid[i]));
        let all = |s: u32| f64::from(along(push.size[0], s)) * f64::from(along(push.size[1], s));
        // In float32 as on the device: the sign of a difference is then the same.
        let value = |i: usize| f64::from(mask(i) as f32 * host.difference[i]);
        for s in 0..push.scales {
            let (step, count) = (1 << s, host.counts.map_or_else(|| all(s), |counts| f64::from(counts[s as usize])));
            if count == 0.0 {
                break;
            }
            let scale = f64::from(push.factor) / count;
            for (i, loss) in loss.iter_mut().enumerate().filter(|(i, _)| has(s, *i, width)) {
                let neighbours = [(i % width + step < width, i + step), (i / width + step < height, i + step * width)];
                for (_, j) in neighbours.into_iter().filter(|n| n.0) {
                    let (weight, d) = (scale * mask(i) * mask(j), value(j) - value(i));
                    *loss += weight * d.abs();
                    if d != 0.0 {
                        grad[i] -= weight * d.signum() * mask(i);
                        grad[j] += weight * d.signum() * mask(j);
                    }
                }
            }
        }
        for (out, grad) in host.grad_aligned.iter_mut().zip(grad) {
            *out = (f64::from(*out) + grad) as f32;
        }
        partial_sums(push.size[0] * push.size[1], host.partial, |i| [loss[i]]);
    }
    fn check(binding: &'static str) -> Check {
        match binding {
            // Up to 4 terms a scale, and one addition.
            "grad_aligned" => Check { relative: 2e-6, absolute: 1e-6, band: 0.0 },
            _ => Check { relative: 1e-5, absolute: 1e-6, band: 0.0 },
        }
    }
    fn cancels(binding: &'static str) -> bool {
        binding == "grad_aligned" // steps up and down beside each other
    }
}

/// The depth gradient loss and its gradient by the aligned values.
#[derive(Debug)]
pub struct DepthGradient {
    size: [u32; 2],
    scales: u32,
    partial: Buffer<f32>,
    counts: Option<Counts>,
}

/// Only for losses that look at a part of the picture.
#[derive(Debug)]
struct Counts {
    partial: Buffer<f32>,
    counts: Buffer<f32>,
}

impl DepthGradient {
    /// For maps of `size` = width, height and so many scales, 1 to 8; `masked` if it will be given valid pixels.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    ///
    /// # Panics
    /// With another number of scales.
    pub fn new(gpu: &Gpu, size: [u32; 2], scales: u32, masked: bool) -> Result<Self, Error> {
        assert!((1..=MAX_SCALES).contains(&scales), "the depth gradient has 1 to {MAX_SCALES} scales, not {scales}");
        let groups = groups(size[0] * size[1]) as usize;
        let counts = || -> Result<Counts, Error> {
            Ok(Counts {
                partial: gpu.buffer("depth_gradient_count_partial", scales as usize * groups)?,
                counts: gpu.buffer("depth_gradient_counts", scales as usize)?,
            })
        };
        Ok(Self {
            size,
            scales,
            partial: gpu.buffer("depth_gradient_partial", groups)?,
            counts: if masked { Some(counts()?) } else { None },
        })
    }

    /// Records `factor` times the loss of `difference` \[pixel\] over the valid pixels (all without `valid`) into
    /// `losses[slot]`, and adds its gradient to `grad_aligned` \[pixel\].
    ///
    /// # Panics
    /// When given `valid` without having been made for it.
    #[expect(
        clippy::too_many_arguments,
        reason = "a loss takes what it compares, its weights and where its value goes"
    )]
    pub fn forward_backward(
        &self,
        rec: &mut Recorder<'_>,
        difference: &Buffer<f32>,
        grad_aligned: &Buffer<f32>,
        valid: Option<&Buffer<f32>>,
        factor: f32,
        losses: &Buffer<f32>,
        slot: u32,
    ) {
        let Self { size, scales, partial, counts } = self;
        let (size, scales) = (*size, *scales);
        let pixels = size[0] * size[1];
        let counts = valid.map(|valid| {
            let Counts { partial, counts } = counts.as_ref().expect("a masked depth gradient is made with counts");
            let buffers = depth_gradient_counts::Buffers { valid, partial };
            let push = depth_gradient_counts::Push { size, scales };
            rec.run(depth_gradient_counts::Kernel, buffers, push, threads(pixels));
            sum::record(rec, partial, groups(pixels), scales, counts, 0);
            counts
        });
        let buffers = depth_gradient::Buffers { difference, grad_aligned, partial, valid, counts };
        rec.run(depth_gradient::Kernel, buffers, depth_gradient::Push { size, factor, scales }, threads(pixels));
        sum::record(rec, partial, groups(pixels), 1, losses, slot);
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
        let mut rng = rand_pcg::Pcg32::seed_from_u64(8);
        for size in [[1, 1], [2, 2], [1, 17], [63, 2], [5, 300], [300, 5], [53, 37], [252, 142]] {
            for scales in [1, 4, 8] {
                let pixels = size[0] * size[1];
                let n = pixels as usize + 3;
                let mut noise = || -> Vec<f32> { (0..n).map(|_| rng.random()).collect() };
                let partial = vec![UNWRITTEN; groups(pixels) as usize + 1];
                // Of eight values, so that neighbours agree now and then.
                let difference: Vec<f32> = noise().iter().map(|v| (8.0 * v).floor() / 8.0).collect();
                let case = depth_gradient::Arrays {
                    difference: difference.clone(),
                    grad_aligned: noise(),
                    partial: partial.clone(),
                    valid: None,
                    counts: None,
                };
                let push = depth_gradient::Push { size, factor: 0.5, scales };
                testing::assert_twin(depth_gradient::Kernel, &gpu, case.clone(), push, threads(pixels));
                let random: Vec<f32> = noise().iter().map(|v| v.round()).collect();
                for valid in [random, vec![0.0; n], noise()] {
                    let case = depth_gradient_counts::Arrays {
                        valid: valid.clone(),
                        partial: vec![UNWRITTEN; scales as usize * groups(pixels) as usize + 1],
                    };
                    let push = depth_gradient_counts::Push { size, scales };
                    testing::assert_twin(depth_gradient_counts::Kernel, &gpu, case, push, threads(pixels));
                    let [width, height] = size;
                    let counts = (0..scales).map(|s| {
                        let on = (0..(width * height) as usize).filter(|&i| has(s, i, width as usize));
                        on.map(|i| valid[i]).sum()
                    });
                    let counts = counts.collect();
                    let case = depth_gradient::Arrays {
                        difference: difference.clone(),
                        grad_aligned: noise(),
                        partial: partial.clone(),
                        valid: Some(valid),
                        counts: Some(counts),
                    };
                    let push = depth_gradient::Push { size, factor: 0.5, scales };
                    testing::assert_twin(depth_gradient::Kernel, &gpu, case, push, threads(pixels));
                }
            }
        }
    }
}

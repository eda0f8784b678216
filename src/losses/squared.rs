//! Squared difference between the render and the photograph: `weight / (3 W H) sum |rgb - target|^2`.

use super::Term;
use super::align::{groups, partial_sums, threads};
use super::sum;
use crate::cost::{Formula, work};
use crate::gpu::kernels::losses::squared;
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};

/// As reports and plans know it.
pub const TERM: Term = Term { name: "squared", stage: "squared", planned: |_| true, left_out: &[], costs: COSTS };

const COSTS: &[Formula] = &[Formula {
    pass: "losses/squared",
    variants: &[],
    derivation: "per pixel render, photograph 24 B, gradient read and written 24 B; 14 operations",
    work: |c, _| work(48.0 * c.pixels, 14.0 * c.pixels, 0.0),
}];

const WEIGHT: f32 = 0.1;

impl Reference for squared::Kernel {
    fn reference(host: squared::Host<'_>, squared::Push { pixels, factor }: squared::Push, (): ()) {
        let d = |i: usize, c: usize| f64::from(host.rgb[i][c]) - f64::from(host.target[i][c]);
        for i in 0..pixels as usize {
            for c in 0..3 {
                host.grad_rgb[i][c] = (f64::from(host.grad_rgb[i][c]) + 2.0 * f64::from(factor) * d(i, c)) as f32;
            }
        }
        partial_sums(pixels, host.partial, |i| [(0..3).map(|c| f64::from(factor) * d(i, c) * d(i, c)).sum()]);
    }
    fn check(_binding: &'static str) -> Check {
        // A rounding of each colour, one of the difference, one of the product and one of the sum.
        Check { relative: 1e-6, absolute: 1e-6, band: 0.0 }
    }
}

/// The loss and its gradient.
#[derive(Debug)]
pub struct Squared {
    pixels: u32,
    partial: Buffer<f32>,
}

impl Squared {
    /// For pictures of `size` = width, height.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Self, Error> {
        let pixels = size[0] * size[1];
        Ok(Self { pixels, partial: gpu.buffer("squared_partial", groups(pixels) as usize)? })
    }

    /// Records the loss into `losses[slot]` and adds its gradient to `grad_rgb`.
    pub fn forward_backward(
        &self,
        rec: &mut Recorder<'_>,
        [rgb, target, grad_rgb]: [&Buffer<[f32; 3]>; 3],
        losses: &Buffer<f32>,
        slot: u32,
    ) {
        let Self { pixels, partial } = self;
        let push = squared::Push { pixels: *pixels, factor: WEIGHT / (3 * pixels) as f32 };
        rec.run(squared::Kernel, squared::Buffers { rgb, target, grad_rgb, partial }, push, threads(*pixels));
        sum::record(rec, partial, groups(*pixels), 1, losses, slot);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    /// The extreme case: nothing overflows, and what is equal has no gradient.
    #[test]
    fn black_white_and_equal() {
        let gpu = testing::gpu();
        let loss = Squared::new(&gpu, [64, 9]).expect("buffers");
        let upload = |name, value: f32| gpu.upload(name, &vec![[value; 3]; 576]).expect("upload");
        let (white, black, grad) = (upload("rgb", 1.0), upload("target", 0.0), upload("grad_rgb", 0.0));
        let terms = gpu.buffer::<f32>("losses", 4).expect("buffer");
        let mut rec = gpu.checked().expect("recorder");
        loss.forward_backward(&mut rec, [&white, &black, &grad], &terms, 0);
        loss.forward_backward(&mut rec, [&black, &black, &grad], &terms, 1);
        let submission = rec.submit().expect("submit");
        submission.differences.iter().for_each(|difference| assert!(difference.ok(), "{difference}"));
        submission.wait().expect("wait");
        let terms = gpu.read(&terms).expect("read");
        assert!((terms[0] - WEIGHT).abs() < 1e-6 && terms[1] == 0.0, "{terms:?}");
    }
}

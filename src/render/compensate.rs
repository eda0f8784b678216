//! Antialiasing: a Gaussian that is smaller than a pixel is drawn as wide as one, and so much fainter.
//!
//! Pictures are drawn through a low-pass: every Gaussian has `DILATION` px^2 more variance than it has. In 3D Gaussian
//! Splatting it keeps its opacity, so that one far below a pixel gives more light the farther away it is seen from, or the
//! smaller the picture. Here it keeps its light (Mip-Splatting, Yu et al. 2024, equation 9, without the smoothing in
//! space, which a file's Gaussians have in them):
//!
//! `drawn = opacity sqrt(det S / det C)`, `C = S + DILATION I`,
//!
//! for the covariance `S` on the picture. `glsl/include/compensation.glsl` has it in the factors of `C` that the projection
//! writes.

use super::project::listed;
use super::slots::Slots;
use crate::gpu::kernels::render::{compensate, compensate_backward};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::camera::DILATION;

/// The kernel's: the most opaque Gaussian that keeps less is not drawn.
const LEAST_KEPT: f64 = 1.0 / (255.0 * 255.0);

/// Share of its light that a Gaussian keeps, squared, from the factors of its covariance.
fn kept_squared([narrow, slope, variance]: [f64; 3]) -> f64 {
    let least = f64::from(DILATION as f32);
    if !(narrow >= least && variance >= least) {
        return LEAST_KEPT;
    }
    let (n, v) = (DILATION / narrow, DILATION / variance);
    ((1.0 - v) * (1.0 - n) - n * slope * slope).max(LEAST_KEPT)
}

impl Reference for compensate::Kernel {
    fn reference(host: compensate::Host<'_>, (): (), (): ()) {
        for s in listed(host.count, host.list) {
            let kept = kept_squared(host.covariance[s].map(f64::from)).sqrt();
            host.drawn[s] = (f64::from(host.opacity[s]) * kept) as f32;
        }
    }

    /// Six roundings of the square, halved and divided by the least root, 1/255.
    fn check(_: &'static str) -> Check {
        Check { relative: 0.0, absolute: 6.0 * 6e-8 * 0.5 * 255.0, band: 0.0 }
    }
}

impl Reference for compensate_backward::Kernel {
    fn reference(host: compensate_backward::Host<'_>, (): (), (): ()) {
        for s in listed(host.count, host.list) {
            let of = host.covariance[s].map(f64::from);
            let [narrow, slope, variance] = of;
            let (n, v, kept) = (DILATION / narrow, DILATION / variance, kept_squared(of).sqrt());
            let upstream = f64::from(host.grad_opacity[s]);
            let of_square = 0.5 * upstream * f64::from(host.opacity[s]) / kept;
            let by = [n / narrow * ((1.0 - v) + slope * slope), -2.0 * n * slope, v / variance * (1.0 - n)];
            for (grad, by) in host.grad_covariance[s].iter_mut().zip(by) {
                *grad = (f64::from(*grad) + of_square * by) as f32;
            }
            host.grad_opacity[s] = (upstream * kept) as f32;
        }
    }

    /// The root is off by 5e-5 at its least, 1/255, and is divided by there: 1.2 % of what is largest then.
    fn check(binding: &'static str) -> Check {
        match binding {
            "grad_opacity" => Check { relative: 0.0, absolute: 5e-5, band: 0.0 },
            _ => Check { relative: 0.012, absolute: 1e-5, band: 0.0 },
        }
    }
}

/// The opacities that are drawn.
#[derive(Debug)]
pub struct Compensate {
    /// \[slot\], of Gaussians that exist.
    pub drawn: Buffer<f32>,
}

impl Compensate {
    /// A buffer for so many slots.
    ///
    /// # Errors
    /// When the device has no memory for it.
    pub fn new(gpu: &Gpu, slots: u32) -> Result<Self, Error> {
        Ok(Self { drawn: gpu.buffer("drawn_opacity", slots as usize)? })
    }

    /// Records what is drawn of the opacity of the Gaussians that exist, behind their projection.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        existing: &Slots,
        covariance: &Buffer<[f32; 3]>,
        opacity: &Buffer<f32>,
    ) {
        let (count, list, drawn) = (&existing.count, &existing.list, &self.drawn);
        let buffers = compensate::Buffers { count, list, covariance, opacity, drawn };
        rec.run(compensate::Kernel, buffers, (), &existing.groups);
    }
}

/// Records the gradients of [`Compensate::record`], of the Gaussians that touch a tile: turns those of the opacity that is
/// drawn into those of the opacity, and adds to those of the covariance's factors.
pub fn backward(
    rec: &mut Recorder<'_>,
    drawn: &Slots,
    (covariance, opacity): (&Buffer<[f32; 3]>, &Buffer<f32>),
    (grad_covariance, grad_opacity): (&Buffer<[f32; 3]>, &Buffer<f32>),
) {
    let (count, list) = (&drawn.count, &drawn.list);
    let buffers = compensate_backward::Buffers { count, list, covariance, opacity, grad_opacity, grad_covariance };
    rec.run(compensate_backward::Kernel, buffers, (), &drawn.groups);
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};

    /// Factors of `S + D I` for two rows u0, u1 with `S = U U^T`, and `det S / det C` by its definition.
    fn factors(u0: [f64; 3], u1: [f64; 3]) -> ([f64; 3], f64) {
        let dot = |a: [f64; 3], b: [f64; 3]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        let cross = [u0[1] * u1[2] - u0[2] * u1[1], u0[2] * u1[0] - u0[0] * u1[2], u0[0] * u1[1] - u0[1] * u1[0]];
        let det = dot(cross, cross);
        let (xy, yy) = (dot(u0, u1), dot(u1, u1) + DILATION);
        let whole = det + DILATION * (dot(u0, u0) + dot(u1, u1)) + DILATION * DILATION;
        ([whole / yy, xy / yy, yy], det / whole)
    }

    fn rows(rng: &mut Pcg64) -> [[f64; 3]; 2] {
        let size = rng.random_range(-4.0f64..5.0).exp();
        [(); 2].map(|()| std::array::from_fn(|_| size * rng.random_range(-1.0..1.0)))
    }

    fn case(rng: &mut Pcg64, n: usize) -> compensate::Arrays {
        let listed: Vec<u32> = (0..n as u32).filter(|i| i % 7 != 3).collect();
        compensate::Arrays {
            count: vec![listed.len() as u32],
            list: listed.into_iter().chain([0; 3]).collect(),
            covariance: (0..n).map(|i| if i % 11 == 5 { [0.0; 3] } else { rows_to(rng).map(|v| v as f32) }).collect(),
            opacity: (0..n).map(|_| rng.random_range(0.0..1.0)).collect(),
            drawn: vec![UNWRITTEN; n],
        }
    }

    fn rows_to(rng: &mut Pcg64) -> [f64; 3] {
        let [u0, u1] = rows(rng);
        factors(u0, u1).0
    }

    #[test]
    fn the_factors_say_what_is_kept() {
        let mut rng = Pcg64::seed_from_u64(4);
        let mut least = 1.0f64;
        for _ in 0..2000 {
            let [u0, u1] = rows(&mut rng);
            let (factors, want) = factors(u0, u1);
            assert!((kept_squared(factors) - want.max(LEAST_KEPT)).abs() < 1e-9, "{u0:?} {u1:?}");
            least = least.min(want);
        }
        assert!(least < LEAST_KEPT, "some are far below a pixel");
        // A disc with the low-pass's own variance keeps a half along either axis, squared.
        assert!((kept_squared([0.6, 0.0, 0.6]) - 0.25).abs() < 1e-12);
    }

    #[test]
    fn both_ways_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(5);
        for n in [1, 63, 64, 65, 1000, 5001] {
            let forward = case(&mut rng, n);
            testing::assert_twin(compensate::Kernel, &gpu, forward.clone(), (), n);
            let seen: Vec<u32> = (0..n as u32).filter(|i| i % 7 != 3 && i % 11 != 5).collect();
            let mut random = || rng.random_range(-1.0f32..1.0);
            let backward = compensate_backward::Arrays {
                count: vec![seen.len() as u32],
                list: seen.into_iter().chain([0; 3]).collect(),
                covariance: forward.covariance,
                opacity: forward.opacity,
                grad_opacity: (0..n).map(|_| random()).collect(),
                grad_covariance: (0..n).map(|_| std::array::from_fn(|_| random())).collect(),
            };
            testing::assert_twin(compensate_backward::Kernel, &gpu, backward, (), n);
        }
    }

    /// The twin's gradients against central differences of what is drawn, as the definition has it in float64.
    #[test]
    fn gradients_are_the_derivatives() {
        let mut rng = Pcg64::seed_from_u64(6);
        let mut compared = 0;
        for _ in 0..300 {
            let of = rows_to(&mut rng);
            if kept_squared(of) < 0.01 {
                continue;
            }
            let (opacity, upstream) = (rng.random_range(0.1f32..1.0), rng.random_range(-1.0f32..1.0));
            let of32 = of.map(|v| v as f32);
            let got = testing::run_twin(
                compensate_backward::Kernel,
                (),
                compensate_backward::Arrays {
                    count: vec![1],
                    list: vec![0],
                    covariance: vec![of32],
                    opacity: vec![opacity],
                    grad_opacity: vec![upstream],
                    grad_covariance: vec![[0.25; 3]],
                },
                (),
            );
            let of = of32.map(f64::from);
            let drawn = |at: [f64; 3]| f64::from(opacity) * kept_squared(at).sqrt();
            assert!((f64::from(got.grad_opacity[0]) - f64::from(upstream) * kept_squared(of).sqrt()).abs() < 1e-6);
            for k in 0..3 {
                let h = 1e-5 * of[k].abs().max(1e-2);
                let at = |step: f64| drawn(std::array::from_fn(|j| of[j] + if j == k { step } else { 0.0 }));
                let want = 0.25 + f64::from(upstream) * (at(h) - at(-h)) / (2.0 * h);
                let got = f64::from(got.grad_covariance[0][k]);
                assert!((got - want).abs() < 1e-4 * want.abs().max(1.0), "{of:?} {k}: {got} for {want}");
            }
            compared += 1;
        }
        assert!(compared > 100, "{compared}");
    }
}

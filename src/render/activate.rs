//! From what is learnt of static Gaussians to what is drawn, and back.

use super::decode::GaussianGradients;
use super::project::listed;
use super::slots::Slots;
use crate::gpu::kernels::render::{activate, activate_backward};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::camera::{from_center, split};
use crate::math::harmonics::{coefficients, harmonics};
use crate::model::gaussians::{NORM_EPSILON, Static};
use crate::model::parameter::Parameter;

/// The kernel's: e^88 is the last power of e below the largest float32.
const LARGEST_EXPONENT: f64 = 88.0;
fn wide<const C: usize>(v: [f32; C]) -> [f64; C] {
    v.map(f64::from)
}

fn narrow<const C: usize>(v: [f64; C]) -> [f32; C] {
    v.map(|v| v as f32)
}

/// Unit direction of a vector; without a length there is none.
fn direction(v: [f64; 3]) -> [f64; 3] {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 { v.map(|x| x / length) } else { [0.0; 3] }
}

impl Reference for activate::Kernel {
    fn reference(host: activate::Host<'_>, push: activate::Push, (): ()) {
        let each = push.coefficients as usize;
        for i in 0..push.count as usize {
            let seen = from_center(host.position[i], [push.center, push.center_low]);
            host.seen[i] = seen;
            host.scale[i] = narrow(wide(host.log_scale[i]).map(|v| v.min(LARGEST_EXPONENT).exp()));
            let q = wide(host.quaternion[i]);
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
            host.rotation[i] = narrow(q.map(|v| v / norm));
            host.opacity[i] = (1.0 / (1.0 + (-f64::from(host.logit[i])).exp())) as f32;
            let h = harmonics(direction(wide(seen)));
            let of = &host.harmonics[i * each..(i + 1) * each];
            host.color[i] = std::array::from_fn(|c| {
                let term = |k: usize| f64::from(of[k][c]) * h[k] * if k > 0 { f64::from(push.higher) } else { 1.0 };
                (0.5 + (0..each).map(term).sum::<f64>()).max(0.0) as f32
            });
        }
    }

    /// Vulkan's `exp` may be `3 + 2 |x|` units in the last place off: 27 at e^-12. A color is a sum of at most 17 terms
    /// whose sizes are within a few times the largest result; in degree 3 a harmonic cancels some three digits' worth.
    fn check(_: &'static str) -> Check {
        Check { relative: 27.0 * 6e-8, absolute: 60.0 * 6e-8, band: 0.0 }
    }
}

impl Reference for activate_backward::Kernel {
    fn reference(host: activate_backward::Host<'_>, push: activate_backward::Push, (): ()) {
        let each = push.coefficients as usize;
        let of = f64::from;
        for i in listed(host.count, host.list) {
            host.grad_position[i] = host.grad_seen[i];
            let (scale, grad_scale) = (wide(host.scale[i]), host.grad_scale[i].map(of));
            host.grad_log_scale[i] = std::array::from_fn(|k| (grad_scale[k] * scale[k]) as f32);
            let (q, g) = (wide(host.quaternion[i]), host.grad_rotation[i].map(of));
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
            let along: f64 = (0..4).map(|k| q[k] / norm * g[k]).sum();
            host.grad_quaternion[i] = std::array::from_fn(|k| ((g[k] - q[k] / norm * along) / norm) as f32);
            let o = f64::from(host.opacity[i]);
            host.grad_logit[i] = (of(host.grad_opacity[i]) * o * (1.0 - o)) as f32;
            let h = harmonics(direction(wide(host.seen[i])));
            for (k, to) in host.grad_harmonics[i * each..(i + 1) * each].iter_mut().enumerate() {
                let cut = |c: usize| host.color[i][c] <= 0.0;
                let h = h[k] * if k > 0 { f64::from(push.higher) } else { 1.0 };
                *to = std::array::from_fn(|c| if cut(c) { 0.0 } else { (h * of(host.grad_color[i][c])) as f32 });
            }
        }
    }

    /// Ten roundings; `g - q (q . g)` and a harmonic's polynomial cancel: relative to the largest.
    fn check(_: &'static str) -> Check {
        Check { relative: 1e-6, absolute: 2e-6, band: 0.0 }
    }
}

/// The forward stage: one element per Gaussian.
#[derive(Debug)]
pub struct Activate {
    /// Seen from the camera's centre, world axes.
    pub seen: Buffer<[f32; 3]>,
    /// Standard deviations, world.
    pub scale: Buffer<[f32; 3]>,
    /// Unit quaternions w x y z.
    pub rotation: Buffer<[f32; 4]>,
    /// 0 to 1.
    pub opacity: Buffer<f32>,
    /// As displayed, 0 or more.
    pub color: Buffer<[f32; 3]>,
}

impl Activate {
    /// Buffers for so many Gaussians.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, count: u32) -> Result<Self, Error> {
        let n = count as usize;
        Ok(Self {
            seen: gpu.buffer("seen", n)?,
            scale: gpu.buffer("scale", n)?,
            rotation: gpu.buffer("rotation", n)?,
            opacity: gpu.buffer("opacity", n)?,
            color: gpu.buffer("color", n)?,
        })
    }

    /// Records the Gaussians for a camera centre (world).
    pub fn record(&self, rec: &mut Recorder<'_>, of: &Static, center: [f64; 3]) {
        let [center, center_low] = split(center);
        let buffers = activate::Buffers {
            position: &of.position.value.view(),
            log_scale: &of.log_scale.value.view(),
            quaternion: &of.quaternion.value.view(),
            logit: &of.logit.value,
            harmonics: &of.harmonics.value.view(),
            seen: &self.seen,
            scale: &self.scale,
            rotation: &self.rotation,
            opacity: &self.opacity,
            color: &self.color,
        };
        let coefficients = coefficients(of.degree) as u32;
        let push = activate::Push { center, center_low, count: of.count, coefficients, higher: of.higher };
        rec.run(activate::Kernel, buffers, push, of.count);
    }
}

/// The gradient's buffer of a parameter.
fn gradient(parameter: &Parameter) -> &Buffer<f32> {
    parameter.gradient.as_ref().expect("made before the way back is recorded")
}

/// Records the gradients of what is learnt, after [`Activate::record`] of the same Gaussians: of those that are drawn, for
/// the others are left alone.
///
/// # Panics
/// When a parameter has no buffer for its gradient.
pub fn backward(rec: &mut Recorder<'_>, of: &Static, forward: &Activate, drawn: &Slots, grad: GaussianGradients<'_>) {
    let buffers = activate_backward::Buffers {
        count: &drawn.count,
        list: &drawn.list,
        seen: &forward.seen,
        scale: &forward.scale,
        quaternion: &of.quaternion.value.view(),
        opacity: &forward.opacity,
        color: &forward.color,
        grad_seen: grad.position,
        grad_scale: grad.scale,
        grad_rotation: grad.rotation,
        grad_opacity: grad.opacity,
        grad_color: grad.color,
        grad_position: &gradient(&of.position).view(),
        grad_log_scale: &gradient(&of.log_scale).view(),
        grad_quaternion: &gradient(&of.quaternion).view(),
        grad_logit: gradient(&of.logit),
        grad_harmonics: &gradient(&of.harmonics).view(),
    };
    let coefficients = coefficients(of.degree) as u32;
    let push = activate_backward::Push { coefficients, higher: of.higher };
    rec.run(activate_backward::Kernel, buffers, push, &drawn.groups);
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};

    const CENTER: [f64; 3] = [0.4, -1.2, 2.5];
    const HIGHER: f32 = 0.75;

    fn case(rng: &mut Pcg64, n: usize, degree: u32) -> activate::Arrays {
        let each = coefficients(degree);
        let mut vec3 = |low: f32, high: f32| -> [f32; 3] { std::array::from_fn(|_| rng.random_range(low..high)) };
        let mut arrays = activate::Arrays {
            position: (0..n).map(|_| vec3(-3.0, 3.0)).collect(),
            log_scale: (0..n).map(|_| vec3(-12.0, 1.0)).collect(),
            harmonics: (0..n * each).map(|_| vec3(-0.9, 0.9)).collect(),
            seen: vec![[UNWRITTEN; 3]; n],
            scale: vec![[UNWRITTEN; 3]; n],
            rotation: vec![[UNWRITTEN; 4]; n],
            opacity: vec![UNWRITTEN; n],
            color: vec![[UNWRITTEN; 3]; n],
            ..Default::default()
        };
        arrays.quaternion = (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-2.0..2.0))).collect();
        arrays.logit = (0..n).map(|_| rng.random_range(-9.0..9.0)).collect();
        arrays
    }

    fn push(n: usize, degree: u32) -> activate::Push {
        let [center, center_low] = split(CENTER);
        let coefficients = coefficients(degree) as u32;
        activate::Push { center, center_low, count: n as u32, coefficients, higher: HIGHER }
    }

    fn backward_case(rng: &mut Pcg64, forward: &activate::Arrays, degree: u32) -> activate_backward::Arrays {
        let n = forward.position.len();
        let mut random = || rng.random_range(-1.0f32..1.0);
        activate_backward::Arrays {
            count: vec![(0..n).filter(|i| i % 5 != 0).count() as u32],
            list: (0..n as u32).filter(|i| i % 5 != 0).chain([0; 3]).collect(),
            seen: forward.seen.clone(),
            scale: forward.scale.clone(),
            quaternion: forward.quaternion.clone(),
            opacity: forward.opacity.clone(),
            color: forward.color.clone(),
            grad_seen: (0..n).map(|_| std::array::from_fn(|_| random())).collect(),
            grad_scale: (0..n).map(|_| std::array::from_fn(|_| random())).collect(),
            grad_rotation: (0..n).map(|_| std::array::from_fn(|_| random())).collect(),
            grad_opacity: (0..n).map(|_| random()).collect(),
            grad_color: (0..n).map(|_| std::array::from_fn(|_| random())).collect(),
            grad_position: vec![[UNWRITTEN; 3]; n],
            grad_log_scale: vec![[UNWRITTEN; 3]; n],
            grad_quaternion: vec![[UNWRITTEN; 4]; n],
            grad_logit: vec![UNWRITTEN; n],
            grad_harmonics: vec![[UNWRITTEN; 3]; n * coefficients(degree)],
        }
    }

    fn forward(case: &activate::Arrays, n: usize, degree: u32) -> activate::Arrays {
        testing::run_twin(activate::Kernel, (), case.clone(), push(n, degree))
    }

    #[test]
    fn both_ways_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(1);
        for (n, degree) in [(1, 0), (63, 1), (65, 2), (1000, 3), (1001, 0)] {
            let case = case(&mut rng, n, degree);
            testing::assert_twin(activate::Kernel, &gpu, case.clone(), push(n, degree), n);
            let forward = forward(&case, n, degree);
            // Not a number where nothing was drawn must not matter.
            let mut backward = backward_case(&mut rng, &forward, degree);
            for i in (0..n).filter(|i| i % 5 == 0) {
                backward.grad_scale[i] = [f32::NAN; 3];
                backward.grad_color[i] = [f32::NAN; 3];
            }
            let coefficients = coefficients(degree) as u32;
            let push = activate_backward::Push { coefficients, higher: HIGHER };
            testing::assert_twin(activate_backward::Kernel, &gpu, backward, push, n);
        }
    }

    /// Every gradient of the twin against central differences of the forward twin, which is in float64 but for its
    /// inputs and outputs: steps of 2^-7 leave 2e-5 of rounding and 1e-4 of curvature.
    #[test]
    fn gradients_are_the_activations_derivatives() {
        let mut rng = Pcg64::seed_from_u64(2);
        let (n, degree) = (20, 3);
        let start = case(&mut rng, n, degree);
        let start =
            activate::Arrays { log_scale: start.log_scale.iter().map(|v| v.map(|v| v / 8.0)).collect(), ..start };
        let there = forward(&start, n, degree);
        let mut grad = backward_case(&mut rng, &there, degree);
        (grad.count, grad.list) = (vec![n as u32], (0..n as u32).collect());
        grad.grad_seen = vec![[0.0; 3]; n];
        let push = activate_backward::Push { coefficients: 16, higher: HIGHER };
        let got = testing::run_twin(activate_backward::Kernel, (), grad.clone(), push);
        let value = |at: &activate::Arrays, i: usize| -> f64 {
            let out = forward(at, n, degree);
            let dot =
                |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
            dot(&out.scale[i], &grad.grad_scale[i])
                + dot(&out.rotation[i], &grad.grad_rotation[i])
                + dot(&out.color[i], &grad.grad_color[i])
                + f64::from(out.opacity[i]) * f64::from(grad.grad_opacity[i])
        };
        let h = 1.0 / 128.0;
        let check = |name: &str, i: usize, got: f32, change: &dyn Fn(&mut activate::Arrays, f32)| {
            let at = |step: f32| {
                let mut moved = start.clone();
                change(&mut moved, step);
                value(&moved, i)
            };
            let slope = (at(h) - at(-h)) / f64::from(2.0 * h);
            assert!((slope - f64::from(got)).abs() < 5e-4, "{name} of {i}: {got} instead of {slope}");
        };
        for i in 0..n {
            for c in 0..3 {
                check("log_scale", i, got.grad_log_scale[i][c], &|a, s| a.log_scale[i][c] += s);
                // A color within a step of its lower end has a kink.
                if there.color[i][c] > 0.02 {
                    for k in 0..16 {
                        check("harmonics", i, got.grad_harmonics[16 * i + k][c], &|a, s| {
                            a.harmonics[16 * i + k][c] += s
                        });
                    }
                }
            }
            if start.quaternion[i].iter().map(|v| v * v).sum::<f32>() > 0.5 {
                for c in 0..4 {
                    check("quaternion", i, got.grad_quaternion[i][c], &|a, s| a.quaternion[i][c] += s);
                }
            }
            check("logit", i, got.grad_logit[i], &|a, s| a.logit[i] += s);
        }
    }
}

//! Adam over flat float arrays.
//!
//! The second moment `v` is kept as its square root `r`: `r' = hypot(sqrt(beta2) r, sqrt(1 - beta2) |g|)`, where the
//! hypotenuse is formed from the ratio of its sides. Float32 flushes `(1 - beta2) g^2` below |g| = 3e-18, which is 0.3 %
//! of epsilon, and overflows above 5e20, whereupon the parameter would never move again. In this form an update differs
//! from the float64 one by float32 roundings (relative 1e-6) for every gradient from 1e-36 to 1e37; below, epsilon drowns
//! what is lost (an update of at most `rate * 1e-20`), above, sums may overflow.

use crate::gpu::kernels::optimizer::adam;
use crate::gpu::{Buffer, Check, Recorder, Reference};
use crate::math;

/// Adam's constants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Decay of the first moment per step.
    pub beta1: f64,
    /// Decay of the second moment per step.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, epsilon: 1e-15 }
    }
}

impl Config {
    /// What the kernel multiplies with in step `step` (counted from 1), for elements `offset .. offset + n`.
    pub fn push(&self, step: u32, rates: impl Into<Rates>, offset: u32, n: u32) -> adam::Push {
        let Rates { rate, parts } = rates.into();
        assert!(step > 0, "Adam counts steps from 1");
        let power = |beta: f64| 1.0 - beta.powf(f64::from(step));
        adam::Push {
            offset,
            n,
            rate: rate.map(|rate| rate as f32),
            parts,
            epsilon: self.epsilon as f32,
            complement1: (1.0 - self.beta1) as f32,
            root_decay: (1.0 - self.beta2.sqrt()) as f32,
            root_complement: (1.0 - self.beta2).sqrt() as f32,
            correction: (1.0 / power(self.beta1)) as f32,
            root_correction: (1.0 / power(self.beta2)).sqrt() as f32,
        }
    }
}

/// Learning rates of up to three parts of a tensor, one behind the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Of each part.
    pub rate: [f64; 3],
    /// The first elements of the second part and of the third.
    pub parts: [u32; 2],
}

impl From<f64> for Rates {
    /// One for the whole tensor.
    fn from(rate: f64) -> Self {
        Self { rate: [rate; 3], parts: [u32::MAX; 2] }
    }
}

/// Vectors per thread, threads of a group: the kernel's.
const VECTORS: u32 = 4;
const GROUP: u32 = 64;

/// Threads for the vectors that the range touches.
fn threads(offset: u32, n: u32) -> u32 {
    let vectors = (offset + n).div_ceil(4) - offset / 4;
    if n == 0 { 0 } else { vectors.div_ceil(GROUP * VECTORS) * GROUP }
}

impl Reference for adam::Kernel {
    fn reference(host: adam::Host<'_>, push: adam::Push, (): ()) {
        if host.overflow[0] != 0 {
            return;
        }
        let factors = |rate: f32| math::adam::Factors {
            rate: rate.into(),
            epsilon: push.epsilon.into(),
            complement1: push.complement1.into(),
            root_decay: push.root_decay.into(),
            root_complement: push.root_complement.into(),
            correction: push.correction.into(),
            root_correction: push.root_correction.into(),
        };
        let [value, first, root] = [host.value, host.first, host.root].map(|v| v.as_flattened_mut());
        for i in push.offset as usize..(push.offset + push.n) as usize {
            let gradient = host.gradient.as_flattened()[i];
            let old = math::adam::State { value: value[i].into(), first: first[i].into(), root: root[i].into() };
            let part = push.parts.iter().filter(|&&first| i >= first as usize).count();
            let new = math::adam::step(old, gradient.into(), &factors(push.rate[part]));
            (value[i], first[i], root[i]) = (new.value as f32, new.first as f32, new.root as f32);
        }
    }

    /// Four roundings in the moments, ten in the update (division and square root of Vulkan: 2.5 units each). The
    /// first moment and the value may cancel: relative to what went in, hence the share of the largest.
    fn check(_: &'static str) -> Check {
        Check { relative: 2e-6, absolute: 2e-7, band: 0.0 }
    }
}

/// One parameter tensor with its gradient and moments, all of one length.
#[derive(Clone, Copy, Debug)]
pub struct Tensors<'a> {
    /// The parameters.
    pub value: &'a Buffer<f32>,
    /// dL/dvalue.
    pub gradient: &'a Buffer<f32>,
    /// First moment, zero before the first step.
    pub first: &'a Buffer<f32>,
    /// Square root of the second moment, zero before the first step.
    pub root: &'a Buffer<f32>,
}

/// Records step `step` (counted from 1) on elements `offset .. offset + n`; the device skips it where `overflow` is set.
///
/// # Panics
/// When the range is outside the tensors.
pub fn record(
    rec: &mut Recorder<'_>,
    config: &Config,
    tensors: Tensors<'_>,
    overflow: &Buffer<u32>,
    (offset, n): (u32, u32),
    (step, rates): (u32, impl Into<Rates>),
) {
    let Tensors { value, gradient, first, root } = tensors;
    let end = offset as usize + n as usize;
    for tensor in [value, gradient, first, root] {
        assert!(end <= tensor.len(), "elements {offset} .. {end} of {tensor:?}");
    }
    let [value, gradient, first, root] = [value, gradient, first, root].map(Buffer::view::<[f32; 4]>);
    let buffers = adam::Buffers { overflow, gradient: &gradient, value: &value, first: &first, root: &root };
    rec.run(adam::Kernel, buffers, config.push(step, rates, offset, n), threads(offset, n));
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::{Options, testing};

    /// `n` elements in whole vectors.
    fn case(n: usize, seed: u64) -> adam::Arrays {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut values = |low: f32, high: f32| {
            (0..n.div_ceil(4)).map(|_| std::array::from_fn(|_| rng.random_range(low..high))).collect()
        };
        adam::Arrays {
            overflow: vec![0],
            value: values(-2.0, 2.0),
            first: values(-1.0, 1.0),
            root: values(0.0, 1.0),
            gradient: values(-3.0, 3.0),
        }
    }

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1023, 1024, 1025, 10_007] {
            for (step, offset, count) in [(1, 0, n), (7, n / 3, n / 2), (30_000, n / 2, n - n / 2), (2, n / 4, 0)] {
                let push = Config::default().push(step, 0.0075, offset, count);
                testing::assert_twin(adam::Kernel, &gpu, case(n as usize, 5), push, threads(offset, count));
            }
            // Parts that begin anywhere within a vector, an empty one among them.
            for parts in [[n / 3, n / 2], [n / 3 + 1, n / 3 + 1], [n / 3 + 2, n / 3 + 3], [0, n]] {
                let rates = Rates { rate: [0.1, 0.01, 0.001], parts };
                let push = Config::default().push(3, rates, 0, n);
                testing::assert_twin(adam::Kernel, &gpu, case(n as usize, 6), push, threads(0, n));
            }
        }
    }

    #[test]
    fn a_set_flag_skips_the_step() {
        let gpu = testing::gpu();
        let mut before = case(100, 9);
        before.overflow[0] = 3;
        let push = Config::default().push(1, 0.1, 0, 100);
        let after = testing::run_once(adam::Kernel, &gpu, &before, push, threads(0, 100));
        assert_eq!((after.value, after.first, after.root), (before.value, before.first, before.root));
    }

    /// Every magnitude that float32 holds, from rest and after a large gradient; the bound is the module's.
    #[test]
    fn extreme_gradients_stay_finite_and_right() {
        let gpu = testing::gpu();
        let magnitudes: [f32; 14] =
            [0.0, 1e-38, 1e-36, 1e-30, 1e-23, 1e-21, 1e-18, 1e-15, 1e-9, 1.0, 1e9, 1e19, 1e30, 1e37];
        let n = 2 * magnitudes.len();
        let gradient: Vec<f32> = magnitudes.iter().flat_map(|&m| [m, -m]).collect();
        let zeros = vec![[0.0; 4]; n / 4];
        let mut arrays = adam::Arrays {
            overflow: vec![0],
            gradient: bytemuck::cast_vec(gradient.clone()),
            value: zeros.clone(),
            first: zeros.clone(),
            root: zeros,
        };
        let mut exact = vec![math::adam::State::default(); n];
        for step in 1..=20 {
            let push = Config::default().push(step, 1.0, 0, n as u32);
            arrays = testing::run_once(adam::Kernel, &gpu, &arrays, push, threads(0, push.n));
            let (b1, b2): (f64, f64) = (0.9, 0.999);
            let factors = math::adam::Factors {
                rate: 1.0,
                epsilon: 1e-15,
                complement1: 1.0 - b1,
                root_decay: 1.0 - b2.sqrt(),
                root_complement: (1.0 - b2).sqrt(),
                correction: 1.0 / (1.0 - b1.powi(step as i32)),
                root_correction: (1.0 / (1.0 - b2.powi(step as i32))).sqrt(),
            };
            for (i, state) in exact.iter_mut().enumerate() {
                *state = math::adam::step(*state, gradient[i].into(), &factors);
                let (got, want) = (f64::from(arrays.value.as_flattened()[i]), state.value);
                // At most `step` updates of at most 1e-20 where the moments leave float32, 1e-6 of each elsewhere.
                let bound = 1e-6 * want.abs() + f64::from(step) * 1e-20;
                assert!((got - want).abs() <= bound, "gradient {:e}, step {step}: {got:e}, {want:e}", gradient[i]);
            }
        }
    }

    /// Also prints the bandwidth: seven floats move per element.
    #[test]
    fn large_arrays_in_parts_of_their_own_rate() {
        let gpu = testing::gpu_with(Options { timestamps: true, ..Options::default() });
        let n = 3_400_000;
        let mut arrays = case(n, 1);
        let buffers = [&arrays.value, &arrays.gradient, &arrays.first, &arrays.root]
            .map(|a| gpu.upload("adam", a.as_flattened()).expect("memory for the test"));
        let [value, gradient, first, root] = &buffers;
        let overflow = gpu.upload("overflow", &[0u32]).expect("memory for the test");
        let tensors = Tensors { value, gradient, first, root };
        let split = 1_234_567;
        let mut rec = gpu.recorder().expect("a recorder");
        let parts = [((0, split), 0.1), ((split, n as u32 - split), 0.01)];
        for (range, rate) in parts {
            record(&mut rec, &Config::default(), tensors, &overflow, range, (3, rate));
        }
        let timings = rec.submit().and_then(crate::gpu::Submission::wait).expect("the device runs it");
        let milliseconds: f64 = timings.iter().map(|t| t.duration * 1e-6).sum();
        println!("adam: {n} elements in {milliseconds:.2} ms, {:.2} GB/s", n as f64 * 28e-6 / milliseconds);
        for ((offset, n), rate) in parts {
            let push = Config::default().push(3, rate, offset, n);
            let adam::Arrays { overflow, gradient, value, first, root } = &mut arrays;
            adam::Kernel::reference(adam::Host { overflow, gradient, value, first, root }, push, ());
        }
        for (buffer, want) in [(value, &arrays.value), (first, &arrays.first), (root, &arrays.root)] {
            let widen = |v: &[f32]| v.iter().copied().map(f64::from).collect::<Vec<_>>();
            let (got, want) = (widen(&gpu.read(buffer).expect("readable")), widen(want.as_flattened()));
            let check = adam::Kernel::check("value");
            let difference = crate::gpu::Difference::of("adam", buffer.name(), &got, &want, check);
            assert!(difference.ok(), "{difference}");
        }
    }
}

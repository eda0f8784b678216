//! Adam at the ends of float32, after a million steps, and over 20,000 of them against float64.

use gscream_vk::gpu::{Buffer, Gpu};
use gscream_vk::math::adam::{Factors, State, step};
use gscream_vk::optimizer::adam::{self, Config, Tensors};
use gscream_vk::optimizer::schedule::Rate;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::Case;

/// One float32 rounding.
const U: f64 = 1.0 / (1 << 24) as f64;

pub const CASES: &[Case] = &[
    Case {
        stage: "optimizer: adam",
        case: "gradients of 0, +-1e-30, +-1e30, the one after the other",
        guarantee: "finite; 0 after 0 moves nothing; every update within 1e-5 of float64's, of the rate",
        run: extreme_gradients,
    },
    Case {
        stage: "optimizer: adam",
        case: "step 1, 1e6 and 2^32 - 1 from rest and from moments of 1",
        guarantee: "corrections are powers in float64: 1 / (1 - beta^t) within rounding, 1 at the end; update within 2e-6 of float64's",
        run: many_steps,
    },
    Case {
        stage: "optimizer: adam",
        case: "decays of 0, 0.9 and up to 1 - 1e-9, 3,000 steps of a steady gradient",
        guarantee: "the first moment stays within 4 u of the gradient: the decay is one constant, 1 - beta; first update within 2e-6 of float64's",
        run: slow_decays,
    },
    Case {
        stage: "optimizer: adam",
        case: "20,000 steps of gradients over 12 decades, some pausing for thousands of steps",
        guarantee: "first moment within 4 u / (1 - beta1) of the largest gradient lately seen, root of the second within 11 u min(t, 2 / (1 - beta2)) of itself, plus 11 u per step without gradient: no drift beyond it",
        run: no_drift,
    },
    Case {
        stage: "optimizer: schedule",
        case: "steps 0, 1, last, after it and 2^32 - 1; rates 1e-37 to 1e30; no steps",
        guarantee: "both ends exact, between them within the ends, never 0 / 0",
        run: ends_of_the_schedule,
    },
];

struct Device {
    tensors: [Buffer<f32>; 4],
    overflow: Buffer<u32>,
    n: usize,
}

impl Device {
    fn new(gpu: &Gpu, states: &[State]) -> Self {
        let upload = |of: &dyn Fn(&State) -> f64| {
            let mut data: Vec<f32> = states.iter().map(|s| of(s) as f32).collect();
            data.resize(data.len().next_multiple_of(4), 0.0);
            gpu.upload("adam", &data).expect("upload")
        };
        let tensors = [upload(&|s| s.value), upload(&|_| 0.0), upload(&|s| s.first), upload(&|s| s.root)];
        Self { tensors, overflow: gpu.upload("overflow", &[0]).expect("upload"), n: states.len() }
    }

    fn step(&self, gpu: &Gpu, config: &Config, gradient: &[f32], step: u32, rate: f64) {
        let [value, grad, first, root] = &self.tensors;
        gpu.write(grad, gradient).expect("write");
        let tensors = Tensors { value, gradient: grad, first, root };
        let mut rec = gpu.recorder().expect("recorder");
        adam::record(&mut rec, config, tensors, &self.overflow, (0, self.n as u32), (step, rate));
        rec.submit().and_then(|s| s.wait()).expect("the device runs it");
    }

    fn read(&self, gpu: &Gpu) -> Vec<State> {
        let [value, _, first, root] = [0, 1, 2, 3].map(|i| gpu.read(&self.tensors[i]).expect("read"));
        (0..self.n).map(|i| State { value: value[i].into(), first: first[i].into(), root: root[i].into() }).collect()
    }
}

/// Adam's constants in float64, as the paper has them.
fn factors(config: &Config, step: u32, rate: f64) -> Factors {
    let power = |beta: f64| -(f64::from(step) * beta.ln()).exp_m1();
    Factors {
        rate,
        epsilon: config.epsilon,
        complement1: 1.0 - config.beta1,
        root_decay: 1.0 - config.beta2.sqrt(),
        root_complement: (1.0 - config.beta2).sqrt(),
        correction: 1.0 / power(config.beta1),
        root_correction: (1.0 / power(config.beta2)).sqrt(),
    }
}

fn extreme_gradients(gpu: &Gpu) {
    let sizes = [0.0, 1e-30, -1e-30, 1.0, -1.0, 1e30, -1e30];
    let digit = |i: usize, place: u32| sizes[i / 7usize.pow(place) % 7];
    let sequences: Vec<[f64; 3]> = (0..343).map(|i| [digit(i, 0), digit(i, 1), digit(i, 2)]).collect();
    let mut exact = vec![State { value: 0.5, ..State::default() }; sequences.len()];
    let device = Device::new(gpu, &exact);
    let config = Config::default();
    for t in 1..=60 {
        // Each of the three for a while.
        let gradient: Vec<f32> = sequences.iter().map(|s| s[(t as usize - 1) / 20] as f32).collect();
        device.step(gpu, &config, &gradient, t, 1e-3);
        for (state, &g) in exact.iter_mut().zip(&gradient) {
            *state = step(*state, g.into(), &factors(&config, t, 1e-3));
        }
        for (i, (got, want)) in device.read(gpu).iter().zip(&exact).enumerate() {
            let name = format!("{:?}, step {t}", sequences[i]);
            assert!([got.value, got.first, got.root].iter().all(|v| v.is_finite()), "{name}: {got:?}");
            // Every update so far, at most 7 rates (1e30 after rest), has added its rounding and that of the value.
            let bound = f64::from(t) * (1e-5 * 1e-3 + U * want.value.abs());
            assert!((got.value - want.value).abs() <= bound, "{name}: {got:?}, {want:?}");
            if sequences[i][..=(t as usize - 1) / 20].iter().all(|&g| g == 0.0) {
                assert_eq!((got.value, got.first, got.root), (0.5, 0.0, 0.0), "{name}");
            }
        }
    }
}

fn many_steps(gpu: &Gpu) {
    let config = Config::default();
    for t in [1, 2, 1000, 1_000_000, u32::MAX] {
        let push = config.push(t, 1.0, 0, 4);
        let exact = factors(&config, t, 1.0);
        assert!((f64::from(push.correction) - exact.correction).abs() <= U * exact.correction, "{t}");
        assert!((f64::from(push.root_correction) - exact.root_correction).abs() <= U * exact.root_correction, "{t}");
        assert!(t < 1_000_000 || (push.correction == 1.0 && push.root_correction == 1.0));
        let rest = State::default();
        let moving = State { value: 0.0, first: 1.0, root: 1.0 };
        for (start, gradient) in [(rest, 1e-3), (rest, -1e20), (moving, 0.0), (moving, -1.0), (moving, 1e-30)] {
            let device = Device::new(gpu, &[start; 5]);
            device.step(gpu, &config, &[gradient; 5], t, 0.01);
            let want = step(start, gradient.into(), &factors(&config, t, 0.01));
            for got in device.read(gpu) {
                assert!((got.value - want.value).abs() <= 2e-6 * want.value.abs(), "{t}: {got:?}, {want:?}");
            }
        }
    }
}

/// At its fixed point a moment loses (1 - beta) of itself, gets as much again, and is rounded twice: what the first rounding
/// did, the second undoes but for a tie, which goes to even and then stays. One unit in the last place, 2 u.
fn slow_decays(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    let gradient: Vec<f32> = (0..256).map(|_| rng.random_range(0.01..1.0)).collect();
    for beta in [0.0, 0.9, 0.999, 0.9999, 0.99999, 1.0 - 1e-9] {
        let config = Config { beta1: beta, beta2: beta, ..Config::default() };
        let steady: Vec<State> =
            gradient.iter().map(|&g| State { value: 0.0, first: g.into(), root: g.into() }).collect();
        let device = Device::new(gpu, &steady);
        let [value, grad, first, root] = &device.tensors;
        gpu.write(grad, &gradient).expect("write");
        let tensors = Tensors { value, gradient: grad, first, root };
        for batch in 0..30 {
            let mut rec = gpu.recorder().expect("recorder");
            for t in 1..=100 {
                adam::record(&mut rec, &config, tensors, &device.overflow, (0, 256), (100 * batch + t, 1e-3));
            }
            rec.submit().and_then(|s| s.wait()).expect("the device runs it");
        }
        for (got, &g) in device.read(gpu).iter().zip(&gradient) {
            let g = f64::from(g);
            assert!((got.first - g).abs() <= 4.0 * U * g, "{beta}: {got:?}, {g}");
        }
        // The first step from rest.
        let device = Device::new(gpu, &vec![State::default(); 256]);
        device.step(gpu, &config, &gradient, 1, 1e-3);
        for (got, &g) in device.read(gpu).iter().zip(&gradient) {
            let want = step(State::default(), g.into(), &factors(&config, 1, 1e-3));
            assert!((got.value - want.value).abs() <= 2e-6 * want.value.abs(), "{beta}: {got:?}, {want:?}");
        }
    }
}

/// The first moment: three roundings a step, of numbers that are no larger than the largest gradient it remembers, and
/// one of the constant, each forgotten at 1 - beta1 a step: 4 u / (1 - beta1) of that gradient. What it remembers decays
/// likewise.
///
/// The root: a step rounds the decay (1 and 1 for the difference; its constant 1), the new part (1 and 1 for its
/// constant), their hypotenuse (3 for the division, 1 the square, 1 the sum, half of these under the root; 3 for the root,
/// 1 the product): at most 11 u of the result, forgotten at (1 - beta2) / 2 a step as long as gradients of the same size
/// come, but never forgotten while none do: then what is left of it decays with its error.
fn no_drift(gpu: &Gpu) {
    let steps = 20_000;
    let n = 64;
    let config = Config::default();
    let mut rng = Pcg64Mcg::seed_from_u64(20);
    let mut exact = vec![State::default(); n];
    let device = Device::new(gpu, &exact);
    let [value, grad, first, root] = &device.tensors;
    let tensors = Tensors { value, gradient: grad, first, root };
    let mut remembered = vec![0.0f64; n];
    let mut bound = vec![0.0f64; n];
    let mut total = vec![0.0f64; n];
    let mut worst = [0.0f64; 2];
    const BATCH: u32 = 100;
    for batch in 0..steps / BATCH {
        // A submission of as many steps as gradients were uploaded.
        let rows: Vec<Vec<f32>> = (0..BATCH)
            .map(|k| {
                let t = batch * BATCH + k;
                (0..n)
                    .map(|i| {
                        let size = 10f32.powi(i as i32 % 12 - 9);
                        // Two in three pause, for 300 and for 3,000 steps at a time.
                        let pause = [0, 300, 3000][i % 3];
                        if pause > 0 && t / pause % 2 == 1 { 0.0 } else { size * rng.random_range(-1.0f32..1.5) }
                    })
                    .collect()
            })
            .collect();
        let uploaded: Vec<Buffer<f32>> = rows.iter().map(|row| gpu.upload("gradients", row).expect("upload")).collect();
        let mut rec = gpu.recorder().expect("recorder");
        for (k, row) in uploaded.iter().enumerate() {
            let t = batch * BATCH + k as u32 + 1;
            rec.copy(row, grad, n);
            adam::record(&mut rec, &config, tensors, &device.overflow, (0, n as u32), (t, 1e-3));
        }
        rec.submit().and_then(|s| s.wait()).expect("the device runs it");
        for (k, row) in rows.iter().enumerate() {
            let factors = factors(&config, batch * BATCH + k as u32 + 1, 1e-3);
            for (i, &g) in row.iter().enumerate() {
                let old = exact[i];
                exact[i] = step(old, g.into(), &factors);
                let g = f64::from(g).abs();
                remembered[i] = config.beta1 * remembered[i] + (1.0 - config.beta1) * g;
                // Errors of the squares: the old part keeps its own, the new one has none yet.
                let kept = config.beta2 * (old.root / exact[i].root.max(1e-300)).powi(2);
                bound[i] = bound[i] * kept + 11.0 * U;
                // The first moment's, of magnitudes.
                total[i] =
                    config.beta1 * total[i] + 4.0 * U * (config.beta1 * remembered[i] + (1.0 - config.beta1) * g);
            }
        }
        for (i, got) in device.read(gpu).iter().enumerate() {
            let errors = [(got.root - exact[i].root).abs() / exact[i].root, (got.first - exact[i].first).abs()];
            let t = (batch + 1) * BATCH;
            // Below 2^-126 a moment is flushed: epsilon is larger by 20 decades.
            let flush = 1e-36;
            assert!(errors[0] <= bound[i] + flush / exact[i].root, "{i}, step {t}: {errors:?} of {:e}", bound[i]);
            assert!(errors[1] <= total[i] + flush, "{i}, step {t}: {errors:?}, {:e}", total[i]);
            worst = [worst[0].max(errors[0] / bound[i]), worst[1].max(errors[1] / (total[i] + flush))];
        }
    }
    println!("moments of 20,000 steps: {:.3} and {:.3} of their bounds", worst[0], worst[1]);
    for (i, got) in device.read(gpu).iter().enumerate() {
        // An update is right to the moments' relative errors, and at most some rates; the value to its own rounding.
        let bound = f64::from(steps) * (1e-3 * 4e-6 + 2.0 * U * (1.0 + exact[i].value.abs()));
        assert!((got.value - exact[i].value).abs() <= bound, "{i}: {got:?}, {:?}", exact[i]);
    }
}

fn ends_of_the_schedule(_: &Gpu) {
    for initial in [1e-37, 1e-3, 1e30] {
        for last in [1e-37, 1e-5, 1e30] {
            let rate = Rate::falling(initial, last);
            for steps in [0, 1, 30_000, u32::MAX] {
                assert_eq!(rate.at(steps, steps), last);
                assert_eq!(rate.at(u32::MAX, steps), last);
                if steps > 0 {
                    assert_eq!(rate.at(0, steps), initial);
                }
                for step in [1, steps / 2, steps.saturating_sub(1)] {
                    let between = rate.at(step, steps);
                    let slack = 1.0 + 1e-12;
                    assert!(
                        between >= initial.min(last) / slack && between <= initial.max(last) * slack,
                        "{between:e}"
                    );
                    assert!((between as f32).is_finite());
                }
            }
        }
    }
    assert_eq!(Rate::constant(0.0).at(0, 0), 0.0);
}

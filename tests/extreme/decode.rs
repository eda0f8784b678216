//! The decoder where it saturates: huge features and weights, quaternions without a direction or beyond float32's squares.
//!
//! # Bounds
//! With u = 2^-24, a sum of n products is off by n u of the sum B of the magnitudes of its terms, and passes on the errors
//! of its inputs times the magnitudes of the weights. The activations have slopes of at most 1 (tanh) and 1/4 (sigmoid), so that
//! saturation forgets the error instead of amplifying it; each adds Vulkan's exponential, (3 + 2 |x|) units in the last place, of
//! an e^-|x| that is at most 1/(e x), and a few roundings: 16 u.

use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::math::decoder::{FEATURE, HIDDEN, INPUT, Layout, decode, input};
use gscream_vk::render::decode::{AnchorGradients, Anchors, Decode, DecodeBackward, GaussianGradients};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::Case;
use crate::project::U;

pub const CASES: &[Case] = &[
    Case {
        stage: "decode",
        case: "features of +-1e4, weights of 1e4 and 1e15",
        guarantee: "opacity, colour and scale within the rounding of the sums, the rotation a unit vector; gradients finite",
        run: saturated,
    },
    Case {
        stage: "decode",
        case: "quaternions of length 0, 1e-30, 1e-13, 1e15, 1e25 and 1e37",
        guarantee: "divided by their length, or by 1e-12 where that is larger, to 8 roundings; gradients finite",
        run: quaternions,
    },
];

const K: usize = 10;

struct Outcome {
    opacity: Vec<f32>,
    color: Vec<[f32; 3]>,
    scale: Vec<[f32; 3]>,
    rotation: Vec<[f32; 4]>,
}

/// Forward and backward; checks that everything is finite.
fn run(gpu: &Gpu, feature: &[f32], weights: &[f32], what: &str) -> Outcome {
    let fine = "the device runs the case";
    let n = feature.len() / FEATURE;
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let position: Vec<[f32; 3]> = (0..n).map(|a| POSITION.map(|p| p + a as f32 * 0.125)).collect();
    let position = gpu.upload("position", &position).expect(fine);
    let feature = gpu.upload("feature", feature).expect(fine);
    let offset = gpu.upload("offset", &vec![[0.5f32, -0.25, 0.125]; n * K]).expect(fine);
    let log_scaling = gpu.upload("log_scaling", &vec![-2f32; n * 6]).expect(fine);
    let weights = gpu.upload("weights", weights).expect(fine);
    let visible = gpu.upload("visible", &(0..n as u32).collect::<Vec<_>>()).expect(fine);
    let count = gpu.upload("visible_count", &[n as u32]).expect(fine);
    let anchors = Anchors {
        position: &position,
        feature: &feature,
        offset: &offset,
        log_scaling: &log_scaling,
        weights: &weights,
        visible: &visible,
    };
    let slots = n * K;
    let mut three =
        || -> Vec<[f32; 3]> { (0..slots).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect() };
    let (g0, g1, g2) = (three(), three(), three());
    let g0 = gpu.upload("grad_position", &g0).expect(fine);
    let g1 = gpu.upload("grad_color", &g1).expect(fine);
    let g2 = gpu.upload("grad_scale", &g2).expect(fine);
    let g3 = gpu.upload("grad_opacity", &vec![0.5f32; slots]).expect(fine);
    let g4 = gpu.upload("grad_rotation", &vec![[0.5f32, -0.25, 0.75, 1.0]; slots]).expect(fine);
    let forward = Decode::of(gpu, n as u32, K as u32, Decode::ALL).expect(fine);
    let drawn = forward.decoded();
    let grad = GaussianGradients { drawn, position: &g0, opacity: &g3, color: &g1, scale: &g2, rotation: &g4 };
    let unwritten = |name, len: usize| gpu.upload(name, &vec![testing::UNWRITTEN; len]).expect(fine);
    let to_offset = gpu.upload("grad_offset", &vec![[testing::UNWRITTEN; 3]; slots]).expect(fine);
    let to_feature = unwritten("grad_feature", n * FEATURE);
    let to_scaling = unwritten("grad_log_scaling", n * 6);
    let to_weights = unwritten("grad_weights", weights.len());
    let to =
        AnchorGradients { feature: &to_feature, offset: &to_offset, log_scaling: &to_scaling, weights: &to_weights };
    let backward = DecodeBackward::new(gpu, &forward).expect(fine);
    let mut rec = gpu.recorder().expect(fine);
    forward.record(&mut rec, anchors, &count, [0.0; 3]);
    backward.record(&mut rec, &forward, anchors, grad, to);
    rec.submit().expect(fine).wait().expect(fine);
    for (name, values) in [
        ("feature", gpu.read(&to_feature).expect(fine)),
        ("log_scaling", gpu.read(&to_scaling).expect(fine)),
        ("weights", gpu.read(&to_weights).expect(fine)),
        ("offset", gpu.read(&to_offset).expect(fine).into_flattened()),
    ] {
        assert!(values.iter().all(|v| v.is_finite()), "{what}: gradient of {name}");
    }
    Outcome {
        opacity: gpu.read(&forward.opacity).expect(fine),
        color: gpu.read(&forward.color).expect(fine),
        scale: gpu.read(&forward.scale).expect(fine),
        rotation: gpu.read(&forward.rotation).expect(fine),
    }
}

const POSITION: [f32; 3] = [0.5, -0.25, 3.0];

fn saturated(gpu: &Gpu) {
    let layout = Layout { offsets: K };
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for (features, sizes) in [(1e4f32, 0.2f32), (1e4, 1e4), (1e4, 1e15), (1e-30, 1e15), (1.0, 3.0)] {
        let what = format!("features of {features:e}, weights of {sizes:e}");
        let n = 40;
        let feature: Vec<f32> = (0..n * FEATURE).map(|_| features * rng.random_range(-1.0..1.0)).collect();
        let weights: Vec<f32> = (0..layout.weights()).map(|_| sizes * rng.random_range(-1.0..1.0)).collect();
        let got = run(gpu, &feature, &weights, &what);
        let exact: Vec<f64> = weights.iter().map(|&w| w.into()).collect();
        let magnitudes: Vec<f64> = exact.iter().map(|w| w.abs()).collect();
        for a in 0..n {
            let seen = POSITION.map(|p| f64::from(p + a as f32 * 0.125));
            let x = input(std::array::from_fn(|i| feature[FEATURE * a + i].into()), seen);
            let want = decode(layout, &exact, &x, seen, &[[0.5, -0.25, 0.125]; K], [-2.0; 6]);
            // Magnitudes of the sums: of a hidden unit, then of an output through all of them.
            let size = x.map(f64::abs);
            let hidden = |head: usize, unit: usize| -> f64 {
                (0..INPUT).map(|i| magnitudes[layout.first(head, unit, i)] * size[i]).sum::<f64>()
                    + magnitudes[layout.first(head, unit, INPUT)]
            };
            let all: [[f64; HIDDEN]; 3] = std::array::from_fn(|head| std::array::from_fn(|unit| hidden(head, unit)));
            let error = |head: usize, output: usize| -> f64 {
                let through: f64 =
                    (0..HIDDEN).map(|j| magnitudes[layout.second(head, output, j)] * all[head][j]).sum::<f64>();
                (41.0 + 34.0) * U * (through + magnitudes[layout.second(head, output, HIDDEN)])
            };
            for (k, want) in want.iter().enumerate() {
                let s = k * n + a;
                let opacity = f64::from(got.opacity[s]);
                let limit = error(0, k) + 16.0 * U;
                assert!((opacity - want.opacity).abs() <= limit, "{what}: opacity {opacity} not {}", want.opacity);
                assert!(opacity.abs() <= 1.0);
                for i in 0..3 {
                    let (c, limit) = (f64::from(got.color[s][i]), 0.25 * error(1, 3 * k + i) + 16.0 * U);
                    assert!((c - want.color[i]).abs() <= limit, "{what}: color {c} not {}", want.color[i]);
                    let (v, limit) = (f64::from(got.scale[s][i]), 0.25 * error(2, 7 * k + i) + 32.0 * U);
                    assert!((v - want.scale[i]).abs() <= limit * 0.14, "{what}: scale {v} not {}", want.scale[i]);
                }
                let length = got.rotation[s].iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
                assert!((length - 1.0).abs() <= 16.0 * U, "{what}: a rotation of length {length}");
            }
        }
    }
}

fn quaternions(gpu: &Gpu) {
    let layout = Layout { offsets: K };
    let lengths = [0.0f32, 1e-30, 1e-13, 1e-12, 1.0, 1e15, 1e18, 1e25, 1e37];
    let direction = [0.5f32, -0.1, 0.7, 0.3];
    for length in lengths {
        let mut weights = vec![0f32; layout.weights()];
        let raw = direction.map(|d| d * length);
        for k in 0..K {
            for (i, raw) in raw.iter().enumerate() {
                weights[layout.second(2, 7 * k + 3 + i, HIDDEN)] = *raw;
            }
        }
        let what = format!("length {length:e}");
        let got = run(gpu, &[0.5; 3 * FEATURE], &weights, &what);
        let norm = raw.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt().max(1e-12);
        for q in &got.rotation {
            for i in 0..4 {
                let want = f64::from(raw[i]) / norm;
                assert!((f64::from(q[i]) - want).abs() <= 8.0 * U, "{what}: {q:?}, not {want} in {i}");
            }
        }
    }
}

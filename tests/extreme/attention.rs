//! Attention between saturated, single, equal and absent tokens.

use gscream_vk::gpu::{Gpu, testing::UNWRITTEN};
use gscream_vk::math::attention::*;
use gscream_vk::model::attention::{Attention, Pair};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::Case;

#[path = "../../src/math/attention/exact.rs"]
mod exact;

/// One float32 rounding.
const U: f64 = 1.0 / (1 << 24) as f64;

pub const CASES: &[Case] = &[
    Case {
        stage: "attention",
        case: "logits of 19,600, 0 and -9,800",
        guarantee: "shares are exactly 0 and 1: attended features to 1e-5 of float64's; gradient of the similarity 0 to rounding",
        run: saturated,
    },
    Case {
        stage: "attention",
        case: "logits of +-1e4, some as close as chance has it",
        guarantee: "finite; attended features within (exp(2 e) - 1) of the values' spread under the shares, e = 50 u times the magnitudes that make up a logit; the shares of a token sum to 1",
        run: enormous,
    },
    Case {
        stage: "attention",
        case: "one token against 2,000, and 2,000 against one",
        guarantee: "float64's features and gradients to 2e-5 + 2 n u (running sums over n tokens); the one's share is exactly 1",
        run: one_against_many,
    },
    Case {
        stage: "attention",
        case: "identical tokens, 300 against 200, and features of 0",
        guarantee: "every share 1 / n: float64's features and gradients to 2e-5 + 2 n u, the gradient of the similarity 0 to rounding",
        run: identical,
    },
    Case {
        stage: "attention",
        case: "no token on one side or on both, counts beyond the capacity",
        guarantee: "nothing is written but a zero gradient of the weights; counts are clamped to the capacity",
        run: none,
    },
    Case {
        stage: "attention",
        case: "a feature that is not a number, infinite or 3e38, a weight that is not a number or infinite",
        guarantee: "a poisoned token reaches the other side's tokens and weights, never its own side's; nothing outside the tokens is written",
        run: not_a_number,
    },
];

struct Inputs {
    n: [usize; 2],
    features: [Vec<f32>; 2],
    upstream: [Vec<f32>; 2],
    weights: Vec<f32>,
}

struct Got {
    updated: [Vec<f32>; 2],
    grad_features: [Vec<f32>; 2],
    grad_weights: Vec<f32>,
}

struct Want {
    updated: [Vec<f64>; 2],
    grad_features: [Vec<f64>; 2],
    grad_weights: Vec<f64>,
}

fn double(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

impl Inputs {
    fn new(n: [usize; 2], seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let weights = Attention::initial_weights(&mut rng);
        let mut values = |n: usize| (0..n * FEATURE).map(|_| rng.random_range(-1.7f32..1.7)).collect::<Vec<f32>>();
        Self { n, features: n.map(&mut values), upstream: n.map(&mut values), weights }
    }

    /// Queries and keys of both sides times this.
    fn sharper(mut self, factor: f32) -> Self {
        self.weights[..2 * INNER * FEATURE].iter_mut().for_each(|w| *w *= factor);
        self
    }

    /// With `counts` instead of the tokens there are. Every output starts as not written.
    fn run(&self, gpu: &Gpu, capacity: usize, counts: [u32; 2]) -> Got {
        let attention = Attention::new(gpu, capacity as u32).expect("buffers");
        let pad = |values: &Vec<f32>| {
            let mut values = values.clone();
            values.resize(capacity * FEATURE, UNWRITTEN);
            gpu.upload("padded", &values).expect("upload")
        };
        let (features, upstream) = (self.features.each_ref().map(pad), self.upstream.each_ref().map(pad));
        let weights = gpu.upload("weights", &self.weights).expect("upload");
        let grad_weights = gpu.upload("grad_weights", &vec![UNWRITTEN; WEIGHTS]).expect("upload");
        let tokens = gpu.upload("tokens", &counts).expect("upload");
        let pair = |of: &'static str| match of {
            "features" => Pair { inside: &features[0], around: &features[1] },
            _ => Pair { inside: &upstream[0], around: &upstream[1] },
        };
        let mut rec = gpu.recorder().expect("recorder");
        let updated = attention.updated();
        rec.fill(updated.inside, UNWRITTEN.to_bits());
        rec.fill(updated.around, UNWRITTEN.to_bits());
        attention.forward(&mut rec, &tokens, pair("features"), &weights);
        let grads = attention.backward(&mut rec, &tokens, pair("features"), &weights, pair("upstream"), &grad_weights);
        rec.submit().and_then(|s| s.wait()).expect("the device runs it");
        let read = |pair: Pair<'_>| [pair.inside, pair.around].map(|b| gpu.read(b).expect("read"));
        Got { updated: read(updated), grad_features: read(grads), grad_weights: gpu.read(&grad_weights).expect("read") }
    }

    fn exact(&self) -> Want {
        let features = self.features.each_ref().map(|f| double(f));
        let upstream = self.upstream.each_ref().map(|f| double(f));
        let weights = double(&self.weights);
        let forward = exact::forward([&features[0], &features[1]], &weights);
        let (grad_features, grad_weights) =
            exact::backward([&features[0], &features[1]], &weights, &forward, [&upstream[0], &upstream[1]]);
        Want { updated: forward.updated, grad_features, grad_weights }
    }

    /// Everything within `relative` of the tensor's largest element, and pointing the same way.
    fn compare(&self, gpu: &Gpu, name: &str, relative: f64) -> (Got, Want) {
        let capacity = self.n[0].max(self.n[1]) + 1;
        let (got, want) = (self.run(gpu, capacity, self.n.map(|n| n as u32)), self.exact());
        let close = |what: &str, got: &[f32], want: &[f64]| {
            let scale = want.iter().fold(0.0f64, |m, w| m.max(w.abs()));
            for (i, (&g, w)) in got.iter().zip(want).enumerate() {
                assert!((f64::from(g) - w).abs() <= relative * scale, "{name}: {what}[{i}] {g:e}, {w:e} of {scale:e}");
            }
        };
        for side in 0..2 {
            close("updated", &got.updated[side], &want.updated[side]);
            close("grad_feature", &got.grad_features[side], &want.grad_features[side]);
            let beyond = &got.updated[side][self.n[side] * FEATURE..];
            assert!(beyond.iter().all(|v| v.to_bits() == UNWRITTEN.to_bits()), "{name}: written beyond the tokens");
        }
        close("grad_weights", &got.grad_weights, &want.grad_weights);
        (got, want)
    }

    /// Queries or keys, values, of one side, and the sums of magnitudes behind the former.
    fn projected(&self, side: usize) -> [Vec<f64>; 3] {
        let (features, weights) = (double(&self.features[side]), double(&self.weights));
        let matrix = |at: usize| &weights[at..][..INNER * FEATURE];
        let absolute = |v: &[f64]| v.iter().map(|v| v.abs()).collect::<Vec<f64>>();
        [
            linear(&features, matrix(SIDES[side].to_qk), FEATURE),
            linear(&features, matrix(SIDES[side].to_v), FEATURE),
            linear(&absolute(&features), &absolute(matrix(SIDES[side].to_qk)), FEATURE),
        ]
    }
}

fn largest_logit(inputs: &Inputs) -> f64 {
    let [q, k] = [0, 1].map(|side| inputs.projected(side)[0].clone());
    (0..inputs.n[0] * inputs.n[1])
        .map(|at| dot(head(&q, at / inputs.n[1], 0), head(&k, at % inputs.n[1], 0)).abs() / 8.0)
        .fold(0.0, f64::max)
}

/// Queries and keys of a head are the features twice over, times 28.28: logits are 200 times the features' products.
/// Every token is like one of the other side (19,600), half opposite to two (-9,800), and like nobody else (0).
fn saturated(gpu: &Gpu) {
    let mut inputs = Inputs::new([32, 32], 1);
    for (side, offsets) in SIDES.iter().enumerate() {
        let matrix = &mut inputs.weights[offsets.to_qk..][..INNER * FEATURE];
        for (row, weights) in matrix.chunks_mut(FEATURE).enumerate() {
            weights.fill(0.0);
            weights[row % FEATURE] = 28.284_271;
        }
        for (token, feature) in inputs.features[side].chunks_mut(FEATURE).enumerate() {
            feature.fill(0.0);
            feature[token] = 7.0;
            feature[(token + 1) % FEATURE] = -7.0;
        }
    }
    assert!((1.9e4..2e4).contains(&largest_logit(&inputs)), "{}", largest_logit(&inputs));
    let (got, want) = inputs.compare(gpu, "saturated", 1e-5);
    // The similarity's gradient is nothing where shares are 0 and 1.
    let to_qk = |g: &[f64]| g[..2 * INNER * FEATURE].iter().fold(0.0f64, |m, g| m.max(g.abs()));
    let (got, want) = (to_qk(&double(&got.grad_weights)), to_qk(&want.grad_weights));
    assert!(want == 0.0 && got < 1e-4, "gradient of the similarity {got:e}, {want:e}");
}

/// A logit is a sum of 64 products of projections, each a sum of 32 products: 16 + 3 and 8 + 3 roundings on a term's way
/// (8 + 8 and 8 + 4 in the form for GPUs), twice the latter, 41 altogether at most and 9 to spare, of the sum of magnitudes A: e = 50 u A / 8. Shares are then within
/// exp(2 e) of their own, and an attended value moves by at most (exp(2 e) - 1) sum p |v - mean|.
fn enormous(gpu: &Gpu) {
    for n in [[64, 64], [1, 200], [33, 12]] {
        let inputs = Inputs::new(n, 7).sharper(120.0);
        assert!(largest_logit(&inputs) > 1e4);
        let got = inputs.run(gpu, 200, n.map(|n| n as u32));
        let want = inputs.exact();
        for (got, want) in got.grad_features.iter().zip(&want.grad_features) {
            assert!(got[..want.len()].iter().all(|g| g.is_finite()), "a gradient");
        }
        assert!(got.grad_weights.iter().all(|g| g.is_finite()), "a gradient of the weights");
        let sides = [0, 1].map(|side| inputs.projected(side));
        let weights = double(&inputs.weights);
        let mut worst = 0.0f64;
        for side in 0..2 {
            let ([q, _, qa], [k, v, ka]) = (&sides[side], &sides[1 - side]);
            let out = &weights[SIDES[side].to_out..][..INNER * FEATURE];
            for i in 0..n[side] {
                let mut moved = vec![0.0; INNER];
                for h in 0..HEADS {
                    let logits: Vec<f64> = (0..n[1 - side]).map(|j| dot(head(q, i, h), head(k, j, h)) / 8.0).collect();
                    let magnitude =
                        (0..n[1 - side]).map(|j| dot(head(qa, i, h), head(ka, j, h)) / 8.0).fold(0.0, f64::max);
                    let (top, inverse) = softmax_row(&logits);
                    let shares: Vec<f64> = logits.iter().map(|s| (s - top).exp() * inverse).collect();
                    let e = (2.0 * 50.0 * U * magnitude).exp_m1() + 1e-5;
                    for d in 0..INNER / HEADS {
                        let mean: f64 = (0..shares.len()).map(|j| shares[j] * head(v, j, h)[d]).sum();
                        let spread: f64 = (0..shares.len()).map(|j| shares[j] * (head(v, j, h)[d] - mean).abs()).sum();
                        moved[h * (INNER / HEADS) + d] = e * spread + 1e-5 * (mean.abs() + spread);
                    }
                }
                for f in 0..FEATURE {
                    let bound: f64 = (0..INNER).map(|c| out[f * INNER + c].abs() * moved[c]).sum::<f64>() + 1e-6;
                    let (g, w) = (f64::from(got.updated[side][i * FEATURE + f]), want.updated[side][i * FEATURE + f]);
                    assert!((g - w).abs() <= bound, "{n:?}, side {side}, token {i}: {g}, {w} +- {bound}");
                    worst = worst.max((g - w).abs() / bound);
                }
            }
        }
        // Values of one all over: what is attended is then the sum of the shares.
        let mut ones =
            Inputs { weights: inputs.weights.clone(), features: inputs.features.clone(), ..Inputs::new(n, 7) };
        for side in 0..2 {
            let Inputs { weights, features, .. } = &mut ones;
            weights[SIDES[side].to_v..][..INNER * FEATURE].fill(0.0);
            for row in weights[SIDES[side].to_v..][..INNER * FEATURE].chunks_mut(FEATURE) {
                row[0] = 1.0;
            }
            features[side].chunks_mut(FEATURE).for_each(|f| f[0] = 1.0);
            let out = &mut weights[SIDES[side].to_out..][..INNER * FEATURE + FEATURE];
            out.fill(0.0);
            out[..INNER].fill(1.0 / INNER as f32);
        }
        let got = ones.run(gpu, 200, n.map(|n| n as u32));
        for (updated, n) in got.updated.iter().zip(n) {
            for token in updated[..n * FEATURE].chunks(FEATURE) {
                assert!((token[0] - 1.0).abs() < 1e-5, "shares sum to {}", token[0]);
            }
        }
        println!("{n:?} tokens: {worst:.2} of the bound");
    }
}

fn one_against_many(gpu: &Gpu) {
    for n in [[1, 2000], [2000, 1], [1, 1]] {
        let inputs = Inputs::new(n, 3);
        let (got, _) = inputs.compare(gpu, &format!("{n:?}"), 2e-5 + 2.0 * 2000.0 * U);
        // The many attend to the one alone: all of them get the same.
        let many = if n[0] > 1 { 0 } else { 1 };
        let rows: Vec<&[f32]> = got.updated[many][..n[many] * FEATURE].chunks(FEATURE).collect();
        assert!(rows.iter().all(|row| row == &rows[0]), "{n:?}: a share of one is not one");
    }
}

fn identical(gpu: &Gpu) {
    let mut inputs = Inputs::new([300, 200], 4);
    for features in &mut inputs.features {
        let first = features[..FEATURE].to_vec();
        features.chunks_mut(FEATURE).for_each(|f| f.copy_from_slice(&first));
    }
    let (got, want) = inputs.compare(gpu, "identical", 2e-5 + 2.0 * 300.0 * U);
    let of = |g: &[f64], at: std::ops::Range<usize>| g[at].iter().fold(0.0f64, |m, g| m.max(g.abs()));
    let (qk, rest) = (0..2 * INNER * FEATURE, 2 * INNER * FEATURE..WEIGHTS);
    assert!(of(&want.grad_weights, qk.clone()) < 1e-9 * of(&want.grad_weights, rest.clone()));
    let grad = double(&got.grad_weights);
    assert!(of(&grad, qk) < 1e-5 * of(&grad, rest));
    let mut empty = Inputs::new([300, 200], 5);
    empty.features.iter_mut().for_each(|f| f.fill(0.0));
    let (got, _) = empty.compare(gpu, "features of zero", 2e-5);
    let bias = &empty.weights[SIDES[0].to_out + INNER * FEATURE..][..FEATURE];
    assert!(got.updated[0][..300 * FEATURE].chunks(FEATURE).all(|f| f == bias), "nothing but the bias");
}

fn none(gpu: &Gpu) {
    let inputs = Inputs::new([20, 20], 6);
    for counts in [[0, 0], [0, 20], [20, 0], [0, u32::MAX]] {
        let got = inputs.run(gpu, 20, counts);
        assert!(got.updated.iter().flatten().all(|v| v.to_bits() == UNWRITTEN.to_bits()), "{counts:?}");
        assert!(got.grad_weights.iter().all(|&g| g == 0.0), "{counts:?}");
    }
    let (clamped, all) = (inputs.run(gpu, 20, [u32::MAX; 2]), inputs.run(gpu, 20, [20; 2]));
    assert!(clamped.updated == all.updated && clamped.grad_weights == all.grad_weights);
}

fn not_a_number(gpu: &Gpu) {
    let n = [30, 20];
    let counts = n.map(|n| n as u32);
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38] {
        for side in 0..2 {
            let good = Inputs::new(n, 8).run(gpu, 33, counts);
            let mut inputs = Inputs::new(n, 8);
            inputs.features[side][5 * FEATURE + 3] = poison;
            let got = inputs.run(gpu, 33, counts);
            for (token, (a, b)) in
                got.updated[side].chunks(FEATURE).zip(good.updated[side].chunks(FEATURE)).enumerate().take(n[side])
            {
                let same = a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits());
                assert!(same || token == 5, "{poison}: token {token} of the poisoned side");
            }
            for updated in got.updated.iter().zip(n).map(|(updated, n)| &updated[n * FEATURE..]) {
                assert!(updated.iter().all(|v| v.to_bits() == UNWRITTEN.to_bits()), "written beyond the tokens");
            }
            if poison == 3e38 {
                continue; // a number: it may well have no share in anything
            }
            // Not hidden: what attends to it says so.
            assert!(got.updated[1 - side][..n[1 - side] * FEATURE].iter().any(|v| !v.is_finite()), "{poison}: hidden");
            assert!(got.grad_weights.iter().any(|v| !v.is_finite()), "{poison}: hidden from the weights");
        }
        for (name, _, at) in TENSORS.into_iter().filter(|_| poison != 3e38) {
            let mut inputs = Inputs::new(n, 8);
            inputs.weights[at + 7] = poison;
            let got = inputs.run(gpu, 33, counts);
            let used = || got.updated.iter().zip(n).flat_map(|(updated, n)| &updated[..n * FEATURE]);
            assert!(used().any(|v| !v.is_finite()), "{name} = {poison} is hidden");
        }
    }
}

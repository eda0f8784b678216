//! Golden cases of kind `attention`.

use gscream_vk::gpu::{Check, Difference, Gpu, testing};
use gscream_vk::math::attention::*;
use gscream_vk::model::attention::{Attention, Pair};

use super::skip::{Lack, skip};
use super::support::{Case, cases};

#[path = "../../src/math/attention/exact.rs"]
mod exact;

/// How far float32 may be, for logits of up to `logit`. With u = 2^-24, the unit roundoff:
///
/// - Features pass four layers of up to 512 terms: some 30 roundings of the tensor's largest element, 4e-6 with their
///   cancellations.
/// - A logit is a sum of 64 products whose partial sums grow as the root of their number to the logit L. A rounding of a
///   partial sum s has a standard deviation of at most u |s| / sqrt(3); over 64 of them, that is
///   u L sqrt(sum of k / 64) / sqrt(3) = 3.3 u L. Queries and keys, sums of 32 terms, add less: theirs are averaged over
///   64 components.
/// - `exp(s - top)` is taken of a number of up to 2 L, whose difference, and whose product with log2(e), round: u 2 L each
///   at most, relative to the result.
/// - So a logit is off by about 4 u L. A share p moves by p (1 - p), a quarter at most, times the difference of two such
///   errors: 1.4 u L. The largest of some ten thousand is four standard deviations off: 6 u L of the largest element.
fn check(logit: f64) -> Check {
    const UNIT: f64 = 1.0 / (1 << 24) as f64;
    Check { relative: 1e-5, absolute: 4e-6 + 6.0 * UNIT * logit, band: 0.0 }
}

/// What goes in: features and upstream gradients inside and around, and the flat weights.
struct Inputs {
    features: [Vec<f32>; 2],
    upstream: [Vec<f32>; 2],
    weights: Vec<f32>,
}

/// What comes out: attended features, gradients of the features and of the weights.
struct Outputs {
    updated: [Vec<f32>; 2],
    grads: [Vec<f32>; 2],
    weights: Vec<f32>,
}

impl Inputs {
    /// A case's, with all weights so many times as large.
    fn of(case: &Case, gain: f32) -> Self {
        let weights: Vec<f32> = TENSORS.iter().flat_map(|(name, ..)| case.f32(name)).map(|w| gain * w).collect();
        assert_eq!(weights.len(), WEIGHTS, "{}: weights", case.name);
        Self {
            features: ["inside", "around"].map(|name| case.f32(name)),
            upstream: ["upstream.inside_out", "upstream.around_out"].map(|name| case.f32(name)),
            weights,
        }
    }

    fn double(&self) -> ([Vec<f64>; 2], [Vec<f64>; 2], Vec<f64>) {
        let double = |values: &Vec<f32>| values.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
        (self.features.each_ref().map(double), self.upstream.each_ref().map(double), double(&self.weights))
    }

    /// The largest logit's magnitude.
    fn largest_logit(&self) -> f64 {
        let (features, _, weights) = self.double();
        let qk: [Vec<f64>; 2] =
            [0, 1].map(|s| linear(&features[s], &weights[SIDES[s].to_qk..][..INNER * FEATURE], FEATURE));
        let n = qk.each_ref().map(|qk| qk.len() / INNER);
        let logit = |h, i, j| dot(head(&qk[0], i, h), head(&qk[1], j, h)).abs() / 8.0;
        let of_head = |h| (0..n[0]).flat_map(move |i| (0..n[1]).map(move |j| (h, i, j)));
        (0..HEADS).flat_map(of_head).map(|(h, i, j)| logit(h, i, j)).fold(0.0, f64::max)
    }

    fn run(&self, gpu: &Gpu) -> Outputs {
        let n = self.features.each_ref().map(|f| f.len() / FEATURE);
        let capacity = n[0].max(n[1]);
        let upload = |values: &[f32]| {
            let mut values = values.to_vec();
            values.resize(capacity * FEATURE, testing::UNWRITTEN);
            gpu.upload("features", &values).expect("memory for the case")
        };
        let [inside, around] = self.features.each_ref().map(|f| upload(f));
        let [up_inside, up_around] = self.upstream.each_ref().map(|f| upload(f));
        let weights = gpu.upload("weights", &self.weights).expect("memory for the case");
        let grad_weights = gpu.upload("grad_weights", &vec![testing::UNWRITTEN; WEIGHTS]).expect("memory for the case");
        let tokens = gpu.upload("tokens", &n.map(|n| n as u32)).expect("memory for the case");
        let attention = Attention::new(gpu, capacity as u32).expect("memory for the case");
        let features = Pair { inside: &inside, around: &around };
        let upstream = Pair { inside: &up_inside, around: &up_around };
        let mut rec = gpu.recorder().expect("a recorder");
        let updated = attention.forward(&mut rec, &tokens, features, &weights);
        let grads = attention.backward(&mut rec, &tokens, features, &weights, upstream, &grad_weights);
        rec.submit().and_then(|s| s.wait()).expect("the device runs it");
        let read = |buffer, n| gpu.read_range(buffer, n * FEATURE).expect("readable");
        Outputs {
            updated: [read(updated.inside, n[0]), read(updated.around, n[1])],
            grads: [read(grads.inside, n[0]), read(grads.around, n[1])],
            weights: gpu.read(&grad_weights).expect("readable"),
        }
    }
}

#[test]
fn attention() {
    testing::gpu_in_both_forms().for_each(|gpu| attention_in_one_form(&gpu));
}

fn attention_in_one_form(gpu: &Gpu) {
    for case in cases("attention") {
        let inputs = Inputs::of(&case, 1.0);
        let logit = inputs.largest_logit();
        println!("{}: logits of up to {logit:.1}", case.name);
        let check = check(logit);
        let got = inputs.run(gpu);
        case.compare("inside_out", &got.updated[0], check);
        case.compare("around_out", &got.updated[1], check);
        case.compare("grad.inside", &got.grads[0], check);
        case.compare("grad.around", &got.grads[1], check);
        for (name, [rows, columns], at) in TENSORS {
            let want = case.f64(&format!("grad.{name}"));
            // With one token on a side its shares are constant: a zero gradient is compared with what it is made of.
            let scale = want.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let got = &got.weights[at..at + rows * columns];
            if scale < 1e-9 {
                assert!(got.iter().all(|g| g.abs() < 1e-5), "{}: grad.{name} is not zero", case.name);
            } else {
                case.compare(&format!("grad.{name}"), got, check);
            }
        }
    }
}

/// The inputs of the first case with all weights 5 and 20 times as large, so that the logits are 25 and 400 times as
/// large. The reference in float64 is the one that the test above holds to the oracle.
#[test]
fn attention_of_very_large_logits() {
    testing::gpu_in_both_forms().for_each(|gpu| very_large_logits_in_one_form(&gpu));
}

fn very_large_logits_in_one_form(gpu: &Gpu) {
    let Some(case) = cases("attention").into_iter().find(|case| case.name == "attention") else {
        skip(Lack::GoldenCase, "the folder of GSCREAM_GOLDEN has no case `attention`");
        return;
    };
    for gain in [1.0, 5.0, 20.0] {
        let inputs = Inputs::of(&case, gain);
        let (features, upstream, weights) = inputs.double();
        let features = features.each_ref().map(Vec::as_slice);
        let forward = exact::forward(features, &weights);
        let (grads, grad_weights) =
            exact::backward(features, &weights, &forward, upstream.each_ref().map(Vec::as_slice));
        let got = inputs.run(gpu);
        let logit = inputs.largest_logit();
        let compare = |what: &str, got: &[f32], want: &[f64]| {
            let got: Vec<f64> = got.iter().map(|&v| f64::from(v)).collect();
            let difference = Difference::of(&format!("logits of up to {logit:.0}"), what, &got, want, check(logit));
            println!("{difference}");
            assert!(difference.ok(), "{difference}");
        };
        for side in 0..2 {
            compare("updated", &got.updated[side], &forward.updated[side]);
            compare("grad", &got.grads[side], &grads[side]);
            if gain == 1.0 {
                let name = ["inside_out", "around_out"][side];
                let oracle = case.f64(name);
                let worst = oracle.iter().zip(&forward.updated[side]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(worst < 1e-12, "{name}: the reference is {worst:e} from the oracle");
            }
        }
        for (name, [rows, columns], at) in TENSORS {
            let range = at..at + rows * columns;
            compare(&format!("grad.{name}"), &got.weights[range.clone()], &grad_weights[range]);
        }
    }
}

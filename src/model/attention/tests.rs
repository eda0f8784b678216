use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use super::twins::head_of;
use super::*;
use crate::gpu::Check;
use crate::gpu::{Options, Submission, Timings, testing};
use crate::math::attention::{dot, exact, linear};

struct Run {
    updated: [Vec<f32>; 2],
    grad_features: [Vec<f32>; 2],
    grad_weights: Vec<f32>,
}

struct Inputs {
    n: [usize; 2],
    features: [Vec<f32>; 2],
    upstream: [Vec<f32>; 2],
    weights: Vec<f32>,
}

fn inputs(n: [usize; 2], seed: u64) -> Inputs {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let weights = Attention::initial_weights(&mut rng);
    let mut values = |n: usize| (0..n * FEATURE).map(|_| rng.random_range(-1.7f32..1.7)).collect::<Vec<f32>>();
    Inputs { n, features: n.map(&mut values), upstream: n.map(&mut values), weights }
}

/// Every buffer starts as not-a-number. `checked`: every pass beside its twin.
fn run(gpu: &Gpu, inputs: &Inputs, capacity: usize, sharing: Sharing, checked: bool) -> Run {
    let attention = Attention::of(gpu, capacity as u32, sharing).expect("memory for the test");
    let pad = |values: &Vec<f32>| {
        let mut values = values.clone();
        values.resize(capacity * FEATURE, testing::UNWRITTEN);
        gpu.upload("padded", &values).expect("memory for the test")
    };
    let (features, upstream) = (inputs.features.each_ref().map(pad), inputs.upstream.each_ref().map(pad));
    let weights = gpu.upload("weights", &inputs.weights).expect("memory for the test");
    let grad_weights = gpu.buffer::<f32>("grad_weights", WEIGHTS).expect("memory for the test");
    let tokens = gpu.upload("tokens", &inputs.n.map(|n| n as u32)).expect("memory for the test");
    let mut rec = if checked { gpu.checked() } else { gpu.recorder() }.expect("a recorder");
    let nan = testing::UNWRITTEN.to_bits();
    for side in &attention.sides {
        for buffer in [&side.qk, &side.value, &side.mixed, &side.grad_mixed, &side.grad_qk, &side.grad_value] {
            rec.fill(buffer, nan);
        }
        rec.fill(&side.softmax, nan);
        rec.fill(&side.rows, nan);
        rec.fill(&side.updated, nan);
        rec.fill(&side.grad_feature, nan);
    }
    attention.partials.iter().flatten().for_each(|partial| rec.fill(partial, nan));
    if let Some(Pairs { inside_share, around_share, grad_s, .. }) = &attention.pairs {
        [inside_share, around_share, grad_s].into_iter().for_each(|matrix| rec.fill(matrix, nan));
    }
    rec.fill(&grad_weights, nan);
    let pair = |of: &'static str| match of {
        "features" => Pair { inside: &features[0], around: &features[1] },
        _ => Pair { inside: &upstream[0], around: &upstream[1] },
    };
    let updated = attention.forward(&mut rec, &tokens, pair("features"), &weights);
    let grads = attention.backward(&mut rec, &tokens, pair("features"), &weights, pair("upstream"), &grad_weights);
    let submission = rec.submit().expect("the device runs it");
    for difference in &submission.differences {
        assert!(difference.ok(), "{:?} tokens: {difference}", inputs.n);
    }
    assert_eq!(submission.differences.is_empty(), !checked);
    submission.wait().expect("the device runs it");
    let read = |pair: Pair<'_>| [pair.inside, pair.around].map(|b| gpu.read(b).expect("readable"));
    Run { updated: read(updated), grad_features: read(grads), grad_weights: gpu.read(&grad_weights).expect("readable") }
}

fn widen_all(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

/// Compares with the dense float64 attention; beyond the counts nothing may be written.
fn compare(inputs: &Inputs, got: &Run, check: Check) {
    let (features, upstream) =
        (inputs.features.each_ref().map(|f| widen_all(f)), inputs.upstream.each_ref().map(|f| widen_all(f)));
    let weights = widen_all(&inputs.weights);
    let forward = exact::forward([&features[0], &features[1]], &weights);
    let (grad_features, grad_weights) =
        exact::backward([&features[0], &features[1]], &weights, &forward, [&upstream[0], &upstream[1]]);
    let skipped = inputs.n.contains(&0);
    let name = format!("{:?} tokens", inputs.n);
    let matches = |tensor: &str, got: &[f32], want: &[f64]| {
        let len = if skipped && tensor != "grad_weights" { 0 } else { want.len() };
        let (written, rest) = got.split_at(len);
        assert!(rest.iter().all(|v| v.is_nan()), "{name}: {tensor} is written beyond its tokens");
        let difference = crate::gpu::Difference::of(&name, tensor, &widen_all(written), &want[..len], check);
        assert!(difference.ok(), "{difference}");
        // What is off by a share e of its norm has a cosine of at least 1 - e^2 / 2.
        let norm = want.iter().map(|w| w * w).sum::<f64>().sqrt();
        let spread = difference.scale * (len as f64).sqrt() / norm;
        let off = check.relative + check.absolute * spread;
        assert!(len == 0 || difference.cosine > 1.0 - (off * off / 2.0).max(1e-6), "{difference}");
    };
    for (got, want) in got.updated.iter().zip(&forward.updated) {
        matches("updated", got, want);
    }
    for (got, want) in got.grad_features.iter().zip(&grad_features) {
        matches("grad_feature", got, want);
    }
    matches("grad_weights", &got.grad_weights, &grad_weights);
}

/// Rounding of features through four layers of up to 512 terms each, relative to the largest element.
const WHOLE: Check = Check { relative: 2e-5, absolute: 1e-5, band: 0.0 };

/// Not at one token a side, where the gradient of the similarity is rounding alone: that is compared as a whole.
#[test]
fn every_pass_matches_its_twin() {
    let gpu = testing::gpu();
    for (i, n) in [[0, 0], [0, 12], [11, 0], [11, 1], [1, 2], [63, 65], [64, 64], [65, 63]].into_iter().enumerate() {
        let inputs = inputs(n, i as u64);
        for &sharing in Sharing::all(&gpu) {
            let got = run(&gpu, &inputs, 67, sharing, true);
            compare(&inputs, &got, WHOLE);
        }
    }
}

#[test]
fn matches_the_dense_attention() {
    let gpu = testing::gpu();
    for n in [[1, 1], [1, 200], [200, 1], [200, 200], [257, 300], [77, 211]] {
        let inputs = inputs(n, 11);
        for &sharing in Sharing::all(&gpu) {
            compare(&inputs, &run(&gpu, &inputs, 301, sharing, false), WHOLE);
        }
    }
}

#[test]
fn skip_flag() {
    let gpu = testing::gpu();
    for (tokens, overflow, want) in [
        ([5, 7], 0, [0, 5, 7]),
        ([5, 7], 2, [1, 0, 0]),
        ([0, 0], 0, [1, 0, 0]),
        ([3, 0], 0, [1, 3, 0]),
        ([0, 3], 1, [1, 0, 0]),
    ] {
        let case = attention_skip::Arrays { tokens: tokens.to_vec(), overflow: vec![overflow], skip: vec![9; 3] };
        testing::assert_twin(attention_skip::Kernel, &gpu, case.clone(), (), 1u32);
        assert_eq!(testing::run_once(attention_skip::Kernel, &gpu, &case, (), 1u32).skip, want);
    }
}

#[test]
fn many_tokens_keep_no_pairs() {
    for gpu in testing::gpu_in_both_forms() {
        let best = [256, 512, 513, 2000].map(|n| Sharing::best(&gpu, n));
        if gpu.lanes() {
            assert_eq!(best, [Sharing::Pairs, Sharing::Pairs, Sharing::Lanes, Sharing::Lanes]);
        } else {
            assert_eq!(best, [Sharing::Blocks; 4]);
        }
    }
}

#[test]
fn twice_the_same_bytes() {
    let gpu = testing::gpu();
    let inputs = inputs([130, 97], 5);
    let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    for &sharing in Sharing::all(&gpu) {
        let [a, b] = [0, 1].map(|_| run(&gpu, &inputs, 200, sharing, false));
        assert_eq!(bits(&a.grad_weights), bits(&b.grad_weights));
        for side in 0..2 {
            assert_eq!(bits(&a.updated[side]), bits(&b.updated[side]));
            assert_eq!(bits(&a.grad_features[side]), bits(&b.grad_features[side]));
        }
    }
}

/// Identical tokens: every share is 1 / n, no gradient reaches the similarity.
#[test]
fn identical_tokens() {
    let gpu = testing::gpu();
    let mut inputs = inputs([40, 24], 6);
    for f in &mut inputs.features {
        let first = f[..FEATURE].to_vec();
        f.chunks_mut(FEATURE).for_each(|row| row.copy_from_slice(&first));
    }
    for &sharing in Sharing::all(&gpu) {
        compare(&inputs, &run(&gpu, &inputs, 40, sharing, false), WHOLE);
    }
}

/// Logits of +-1e4: 120 times larger queries and keys. Float32 logits are then off by up to 16 roundings of
/// terms of 1e4, 2e-3, and so are shares where two logits happen to be close; most shares are exactly 0 or 1.
#[test]
fn enormous_logits() {
    let gpu = testing::gpu();
    for n in [[64, 64], [1, 200], [33, 12]] {
        let mut inputs = inputs(n, 7);
        inputs.weights[..2 * INNER * FEATURE].iter_mut().for_each(|w| *w *= 120.0);
        let features = inputs.features.each_ref().map(|f| widen_all(f));
        let weights = widen_all(&inputs.weights);
        let qk = [0, 1].map(|s| linear(&features[s], &weights[SIDES[s].to_qk..][..INNER * FEATURE], FEATURE));
        let largest = (0..n[0] * n[1])
            .map(|k| dot(head_of(&qk[0], k / n[1], 0), head_of(&qk[1], k % n[1], 0)).abs() / 8.0)
            .fold(0.0, f64::max);
        assert!(largest > 1e4, "largest logit {largest}");
        for &sharing in Sharing::all(&gpu) {
            let got = run(&gpu, &inputs, 200, sharing, false);
            compare(&inputs, &got, Check { relative: 5e-3, absolute: 5e-3, band: 0.0 });
        }
    }
}

/// Prints milliseconds per pass.
#[test]
fn large_numbers_of_tokens() {
    let gpu = testing::gpu_with(Options { timestamps: true, ..Options::default() });
    for n in [256, 1000] {
        let inputs = inputs([n, n], 8);
        let upload = |v: &Vec<f32>| gpu.upload("input", v).expect("memory for the test");
        let [inside, around] = inputs.features.each_ref().map(upload);
        let [up_inside, up_around] = inputs.upstream.each_ref().map(upload);
        let weights = upload(&inputs.weights);
        let grad_weights = gpu.buffer::<f32>("grad_weights", WEIGHTS).expect("memory for the test");
        let tokens = gpu.upload("tokens", &[n as u32; 2]).expect("memory for the test");
        let attention = Attention::new(&gpu, n as u32).expect("memory for the test");
        let mut timings = Timings::default();
        for repeat in 0..3 {
            let mut rec = gpu.recorder().expect("a recorder");
            let features = Pair { inside: &inside, around: &around };
            attention.forward(&mut rec, &tokens, features, &weights);
            let upstream = Pair { inside: &up_inside, around: &up_around };
            attention.backward(&mut rec, &tokens, features, &weights, upstream, &grad_weights);
            let times = rec.submit().and_then(Submission::wait).expect("the device runs it");
            if repeat > 0 {
                timings.add(&times);
            }
        }
        println!("{n} tokens a side\n{}", timings.table());
        let finite = gpu.read(&grad_weights).expect("readable").iter().all(|g| g.is_finite());
        assert!(finite, "a gradient of {n} tokens is not finite");
    }
}

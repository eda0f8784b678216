//! Golden cases of kind `attention`.

use gscream_vk::gpu::{Check, Gpu, testing};
use gscream_vk::math::attention::{FEATURE, TENSORS, WEIGHTS};
use gscream_vk::model::attention::{Attention, Pair};

use super::support::cases;

/// Features pass four layers of up to 512 terms: some 30 float32 roundings of the tensor's largest element. The
/// saturated case has logits of some hundreds, whose rounding (16 terms of 1e3 at 6e-8) moves shares by up to 1e-4.
fn check(name: &str) -> Check {
    let absolute = if name.starts_with("attention_saturated") { 1e-4 } else { 4e-6 };
    Check { relative: 1e-5, absolute, band: 0.0 }
}

#[test]
fn attention() {
    testing::gpu_in_both_forms().for_each(|gpu| attention_in_one_form(&gpu));
}

fn attention_in_one_form(gpu: &Gpu) {
    for case in cases("attention") {
        let check = check(&case.name);
        let n = ["inside", "around"].map(|side| case.shape(side)[0]);
        let capacity = n[0].max(n[1]);
        let upload = |name: &str| {
            let mut values = case.f32(name);
            values.resize(capacity * FEATURE, testing::UNWRITTEN);
            gpu.upload("features", &values).expect("memory for the case")
        };
        let (inside, around) = (upload("inside"), upload("around"));
        let (up_inside, up_around) = (upload("upstream.inside_out"), upload("upstream.around_out"));
        let flat: Vec<f32> = TENSORS.iter().flat_map(|(name, ..)| case.f32(name)).collect();
        assert_eq!(flat.len(), WEIGHTS, "{}: weights", case.name);
        let weights = gpu.upload("weights", &flat).expect("memory for the case");
        let grad_weights = gpu.upload("grad_weights", &vec![testing::UNWRITTEN; WEIGHTS]).expect("memory for the case");
        let tokens = gpu.upload("tokens", &n.map(|n| n as u32)).expect("memory for the case");
        let attention = Attention::new(gpu, capacity as u32).expect("memory for the case");
        let features = Pair { inside: &inside, around: &around };
        let upstream = Pair { inside: &up_inside, around: &up_around };
        let mut rec = gpu.recorder().expect("a recorder");
        let updated = attention.forward(&mut rec, &tokens, features, &weights);
        let grads = attention.backward(&mut rec, &tokens, features, &weights, upstream, &grad_weights);
        rec.submit().and_then(|s| s.wait()).expect("the device runs it");
        let outputs = [
            ("inside_out", updated.inside, n[0]),
            ("around_out", updated.around, n[1]),
            ("grad.inside", grads.inside, n[0]),
            ("grad.around", grads.around, n[1]),
        ];
        for (name, buffer, n) in outputs {
            case.compare(name, &gpu.read_range(buffer, n * FEATURE).expect("readable"), check);
        }
        let grad_weights = gpu.read(&grad_weights).expect("readable");
        for (name, [rows, columns], at) in TENSORS {
            let want = case.f64(&format!("grad.{name}"));
            // With one token on a side its shares are constant: a zero gradient is compared with what it is made of.
            let scale = want.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let got = &grad_weights[at..at + rows * columns];
            if scale < 1e-9 {
                assert!(got.iter().all(|g| g.abs() < 1e-5), "{}: grad.{name} is not zero", case.name);
            } else {
                case.compare(&format!("grad.{name}"), got, check);
            }
        }
    }
}

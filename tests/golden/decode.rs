//! Golden cases of kind `decode`.

use gscream_vk::gpu::{Buffer, Check, Gpu, testing};
use gscream_vk::render::decode::{AnchorGradients, Anchors, Decode, DecodeBackward, GaussianGradients};

use crate::support::cases;

/// Rows of \[n, k\] by k first, as slots are numbered.
fn by_slot<T: Copy>(rows: &[T], [n, k]: [usize; 2]) -> Vec<T> {
    let width = rows.len() / (n * k);
    (0..k)
        .flat_map(|k_| (0..n).flat_map(move |v| (0..width).map(move |c| (v * k + k_) * width + c)))
        .map(|i| rows[i])
        .collect()
}

#[test]
fn decode() {
    testing::gpu_in_both_forms().for_each(|gpu| decode_in_one_form(&gpu));
}

fn decode_in_one_form(gpu: &Gpu) {
    let fine = "the device runs a small case";
    for case in cases("decode") {
        let shape = case.shape("offset");
        let (n, k) = (shape[0], shape[1]);
        let weights: Vec<String> = ["opacity", "color", "cov"]
            .iter()
            .flat_map(|head| ["0.weight", "0.bias", "2.weight", "2.bias"].map(|w| format!("mlp_{head}.{w}")))
            .collect();
        let flat: Vec<f32> = weights.iter().flat_map(|name| case.f32(name)).collect();
        let upload = |name: &'static str, tensor: &str| gpu.upload(name, &case.f32(tensor)).expect(fine);
        let upload3 = |name: &'static str, tensor: &str| gpu.upload(name, &case.vectors::<3>(tensor)).expect(fine);
        let of_slots3 = |name: &'static str, tensor: &str| {
            gpu.upload(name, &by_slot(&case.vectors::<3>(tensor), [n, k])).expect(fine)
        };
        let (position, offset) = (upload3("anchor", "anchor"), upload3("offset", "offset"));
        let (feature, log_scaling) = (upload("feature", "feature"), upload("log_scaling", "log_scaling"));
        let flat = gpu.upload("weights", &flat).expect(fine);
        let visible = gpu.upload("visible", &(0..n as u32).collect::<Vec<_>>()).expect(fine);
        let count = gpu.upload("visible_count", &[n as u32]).expect(fine);
        let center = case.vectors::<3>("camera_center")[0].map(f64::from);
        let grad = (
            of_slots3("upstream position", "upstream.position"),
            gpu.upload("upstream opacity", &by_slot(&case.f32("upstream.opacity"), [n, k])).expect(fine),
            of_slots3("upstream color", "upstream.color"),
            of_slots3("upstream scale", "upstream.scale"),
            gpu.upload("upstream rotation", &by_slot(&case.vectors::<4>("upstream.rotation"), [n, k])).expect(fine),
        );
        let empty = |name, len: usize| gpu.upload(name, &vec![testing::UNWRITTEN; len]).expect(fine);
        let (to_feature, to_scaling) = (empty("grad_feature", n * 32), empty("grad_log_scaling", n * 6));
        let to_weights = empty("grad_weights", flat.len());
        let to_offset = gpu.upload("grad_offset", &vec![[testing::UNWRITTEN; 3]; n * k]).expect(fine);
        let forward = Decode::of(gpu, n as u32, k as u32, Decode::ALL).expect(fine);
        let backward = DecodeBackward::new(gpu, &forward).expect(fine);
        let anchors = Anchors {
            position: &position,
            feature: &feature,
            offset: &offset,
            log_scaling: &log_scaling,
            weights: &flat,
            visible: &visible,
        };
        let upstream = GaussianGradients {
            drawn: forward.decoded(),
            position: &grad.0,
            opacity: &grad.1,
            color: &grad.2,
            scale: &grad.3,
            rotation: &grad.4,
        };
        let to = AnchorGradients {
            feature: &to_feature,
            offset: &to_offset,
            log_scaling: &to_scaling,
            weights: &to_weights,
        };
        let mut rec = gpu.recorder().expect(fine);
        forward.record(&mut rec, anchors, &count, center);
        backward.record(&mut rec, &forward, anchors, upstream, to);
        rec.submit().expect(fine).wait().expect(fine);

        // A chain of sums of 40, 33 and up to 72 products and one over the anchors, half a rounding (6e-8) each,
        // relative to the terms, which stay within a few times the largest element.
        let bound = (40 + 33 + 72 + n.min(128)) as f64 * 6e-8;
        let check = Check { relative: bound, absolute: bound, band: 0.0 };
        let read3 = |b: &Buffer<[f32; 3]>| gpu.read(b).expect(fine).into_flattened();
        let read = |b: &Buffer<f32>| gpu.read(b).expect(fine);
        // The decoder's positions are seen from the camera.
        let seen: Vec<f64> =
            case.f64("position").chunks_exact(3).flat_map(|p| [0, 1, 2].map(|i| p[i] - center[i])).collect();
        let rotation = gpu.read(&forward.rotation).expect(fine).into_flattened();
        for (name, got, want) in [
            ("position", read3(&forward.position), seen),
            ("opacity", read(&forward.opacity), case.f64("opacity")),
            ("color", read3(&forward.color), case.f64("color")),
            ("scale", read3(&forward.scale), case.f64("scale")),
            ("rotation", rotation, case.f64("rotation")),
        ] {
            case.compare_with(name, &got, &by_slot(&want, [n, k]), check);
        }
        case.compare("grad.feature", &read(&to_feature), check);
        case.compare("grad.offset", &read3(&to_offset), check);
        case.compare("grad.log_scaling", &read(&to_scaling), check);
        let got = read(&to_weights);
        let mut at = 0;
        for name in &weights {
            let len = case.f64(name).len();
            case.compare(&format!("grad.{name}"), &got[at..at + len], check);
            at += len;
        }
        assert_eq!(at, got.len());
    }
}

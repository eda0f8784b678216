//! Golden cases of kind `adam`.

use gscream_vk::gpu::{Check, testing};
use gscream_vk::optimizer::adam::{self, Config, Tensors};
use gscream_vk::optimizer::schedule::learning_rate;

use super::support::cases;

/// Steps in float32 on the device against the oracle's float64. Each step rounds the value once and the update (at
/// most rate * 3.2, since |m| / sqrt(v) is bounded) by about 1e-6 of itself; five steps of 0.0075 stay within 2e-7.
#[test]
fn adam() {
    let gpu = testing::gpu();
    for case in cases("adam") {
        let mut values = case.f32("value");
        let n = values.len();
        let upload = |name, data: &[f32]| gpu.upload(name, data).expect("memory for the case");
        let zeros = vec![0.0; n];
        let (value, first, root) = (upload("value", &values), upload("first", &zeros), upload("root", &zeros));
        let overflow = gpu.upload("overflow", &[0u32]).expect("memory for the case");
        for step in 1.. {
            let name = format!("gradient.{step}");
            if !case.has(&name) {
                assert!(step > 1, "{}: no step", case.name);
                break;
            }
            let gradient = upload("gradient", &case.f32(&name));
            let tensors = Tensors { value: &value, gradient: &gradient, first: &first, root: &root };
            let mut rec = gpu.recorder().expect("a recorder");
            adam::record(&mut rec, &Config::default(), tensors, &overflow, (0, n as u32), (step, 0.0075));
            rec.submit().and_then(|s| s.wait()).expect("the device runs it");
            let read = |buffer| gpu.read(buffer).expect("readable");
            values = read(&value);
            case.compare(&format!("value.{step}"), &values, Check { relative: 3e-7, absolute: 1e-7, band: 0.0 });
            // Gradients range over eleven decades: moments are compared relative to themselves (terms of a first
            // moment may cancel, but 64 random ones do not by more than a factor of 100).
            let moment = Check { relative: 2e-5, absolute: 0.0, band: 0.0 };
            case.compare(&format!("first.{step}"), &read(&first), moment);
            let second: Vec<f32> = read(&root).iter().map(|r| r * r).collect();
            case.compare(&format!("second.{step}"), &second, moment);
        }
    }
}

#[test]
fn learning_rates() {
    for case in cases("adam") {
        let want = case.f64("learning_rate");
        let got = [0, 1, 1500, 15_000, 30_000, 40_000].map(|step| learning_rate(step, 0.01, 0.0001, 30_000));
        assert_eq!(got.len(), want.len());
        for (got, want) in got.iter().zip(&want) {
            assert!((got - want).abs() <= 1e-14 * want, "{got:e}, {want:e}");
        }
    }
}

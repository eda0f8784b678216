//! Golden cases of kind `depth`.

use gscream_vk::gpu::{Check, testing};
use gscream_vk::losses::align::{Align, Prior, Quantity};
use gscream_vk::losses::depth_gradient::DepthGradient;
use gscream_vk::losses::depth_l1::{DepthL1, Weight};

use crate::support::{Case, cases};

/// Values whose sign the kernels may take the other way: differences, and differences of neighbours at the four scales,
/// that are within float32 rounding of zero (eight roundings of the largest aligned value or prior).
fn at_the_kink(case: &Case, [width, height]: [usize; 2]) -> usize {
    let (scale, shift) = (case.f64("scale")[0], case.f64("shift")[0]);
    let aligned: Vec<f64> = case.f64("rendered").iter().map(|x| scale * x + shift).collect();
    let prior = case.f64("prior");
    let largest = aligned.iter().chain(&prior).fold(0.0_f64, |m, v| m.max(v.abs()));
    let near_zero = |v: f64| v.abs() < 8.0 * 2.0_f64.powi(-24) * largest;
    let d: Vec<f64> = aligned.iter().zip(&prior).map(|(a, p)| a - p).collect();
    let mut count = d.iter().filter(|d| near_zero(**d)).count();
    for step in [1, 2, 4, 8] {
        for y in (0..height).step_by(step) {
            for x in (0..width).step_by(step) {
                let here = y * width + x;
                count += usize::from(x + step < width && near_zero(d[here + step] - d[here]));
                count += usize::from(y + step < height && near_zero(d[here + step * width] - d[here]));
            }
        }
    }
    count
}

#[test]
fn depth() {
    let gpu = testing::gpu();
    for case in cases("depth") {
        let shape = case.shape("rendered");
        let (size, pixels) = ([shape[1] as u32, shape[0] as u32], shape[0] * shape[1]);
        let upload = |tensor: &'static str| gpu.upload(tensor, &case.f32(tensor)).expect("upload");
        let (rendered, prior) = (upload("rendered"), upload("prior"));
        let (outside, weight) = (upload("outside"), upload("weight"));
        let align = Align::new(&gpu, size).expect("buffers");
        let l1 = DepthL1::new(&gpu, size).expect("buffers");
        let gradient = DepthGradient::new(&gpu, size, 4, false).expect("buffers");
        let losses = gpu.buffer("losses", 2).expect("buffer");
        let prior = Prior { values: &prior, quantity: Quantity::Depth, valid: Some(&outside) };
        let mut rec = gpu.recorder().expect("recorder");
        let fit = align.forward(&mut rec, &rendered, prior);
        let (difference, grad_aligned) =
            l1.forward_backward(&mut rec, &rendered, prior, fit, Weight::Each(&weight), &losses, 0);
        gradient.forward_backward(&mut rec, difference, grad_aligned, None, 0.5, &losses, 1);
        let grad = align.backward(&mut rec, grad_aligned, &rendered, prior, fit);
        rec.submit().and_then(|s| s.wait()).expect("the step runs");

        let fit = gpu.read(fit).expect("read");
        // Sums in trees about the means: some 40 roundings of 6e-8.
        let check = Check { relative: 3e-6, absolute: 0.0, band: 0.0 };
        case.compare("scale", &fit[..1], check);
        // q = mean prior - w mean rendered may cancel: relative to these.
        let larger = f64::from(fit[6].abs().max((fit[4] * fit[2]).abs()));
        let cancelled = (larger / case.f64("shift")[0].abs()).max(1.0);
        case.compare("shift", &fit[1..2], Check { relative: 3e-6 * cancelled, ..check });
        let losses = gpu.read(&losses).expect("read");
        // |aligned - prior| cancels to a fiftieth of the depths.
        let check = Check { relative: 2e-5, absolute: 0.0, band: 0.0 };
        case.compare("depth_l1", &losses[..1], check);
        case.compare("depth_gradient_half", &losses[1..], check);
        case.compare("loss", &[losses[0] + losses[1]], check);

        let kinks = at_the_kink(&case, size.map(|v| v as usize));
        println!("{}: {kinks} of {pixels} pixels within rounding of a kink", case.name);
        // A sign taken the other way changes two pixels, and every valid pixel a little through the fit.
        let band = 2.0 * kinks as f64 / pixels as f64;
        case.compare(
            "grad.rendered",
            &gpu.read(grad).expect("read"),
            Check { relative: 1e-5, absolute: 5e-6 + band, band },
        );
    }
}

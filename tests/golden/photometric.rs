//! Golden cases of kind `photometric`.

use gscream_vk::gpu::Check;
use gscream_vk::gpu::testing;
use gscream_vk::losses::photometric::Photometric;

use crate::support::cases;

#[test]
fn photometric() {
    let gpu = testing::gpu();
    for case in cases("photometric") {
        let shape = case.shape("rendered");
        let size = [shape[1] as u32, shape[0] as u32];
        let stage = Photometric::new(&gpu, size, 0.2, true).expect("buffers");
        let rendered = gpu.upload("rgb", &case.vectors::<3>("rendered")).expect("upload");
        let target = gpu.upload("target", &case.vectors::<3>("target")).expect("upload");
        let weight = gpu.upload("weight", &case.f32("weight")).expect("upload");
        let losses = gpu.buffer("losses", 1).expect("buffer");
        let mut rec = gpu.recorder().expect("recorder");
        let grad = stage.forward_backward(&mut rec, &rendered, &target, Some(&weight), &losses, 0);
        rec.submit().and_then(|s| s.wait()).expect("the step runs");
        // Sums of 3 W H positive terms in trees: under 40 roundings of 6e-8.
        case.compare("loss", &gpu.read(&losses).expect("read"), Check { relative: 3e-6, absolute: 0.0, band: 0.0 });
        let grad: Vec<f32> = gpu.read(grad).expect("read").into_flattened();
        // Variances are sums of some 30 roundings against sigma^2 + C2 in the denominators.
        case.compare("grad.rendered", &grad, Check { relative: 1e-5, absolute: 5e-6, band: 0.0 });
    }
}

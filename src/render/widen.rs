//! Gaussians as wide as the pixels they were trained with, for pictures that are larger.
//!
//! In training every Gaussian is drawn with [`DILATION`] px^2 more variance (EWA splatting's low-pass), and a render is
//! compared with pixels that are means over their squares. A Gaussian may therefore be as thin as it likes: where the
//! pictures are small, many are needles. A larger picture adds as many px^2 of its own, smaller, pixels: needles and holes
//! would show. What is missing is added to the Gaussians themselves (as Mip-Splatting does in training, Yu et al. 2024): in
//! px^2 of the training's pictures, drawn `k` times larger,
//!
//! `DILATION - 1/24 - DILATION / k^2`.
//!
//! The last is what the larger picture adds. Reduced to the training's size, the picture should be the one that was trained;
//! the mean over a pixel's square blurs by a variance of 1/12. With all of that taken off holes begin to show, with none it is too
//! soft: of 0, 1/24 and 1/12 the second came closest to the anchors' own pictures on all of three scenes
//! (`src/export/README.md`).

use super::project::{Gaussians, listed};
use super::slots::Slots;
use crate::gpu::kernels::render::widen;
use crate::gpu::{Check, Recorder, Reference};
use crate::math::camera::DILATION;
use crate::scene::Camera;

/// Half the variance of a pixel's square, px^2.
const SQUARE: f64 = 1.0 / 24.0;

/// Variance to add for pictures `larger` times as large as the training's, in px^2 of those; 0 where they are hardly larger.
pub fn variance(larger: f64) -> f64 {
    (DILATION - SQUARE - DILATION / (larger * larger)).max(0.0)
}

impl Reference for widen::Kernel {
    fn reference(host: widen::Host<'_>, push: widen::Push, (): ()) {
        for s in listed(host.count, host.list) {
            let z: f64 = (0..3).map(|i| f64::from(push.ahead[i]) * f64::from(host.position[s][i])).sum();
            let added = f64::from(push.added) * z * z;
            for scale in &mut host.scale[s] {
                *scale = (f64::from(*scale) * f64::from(*scale) + added).sqrt() as f32;
            }
        }
    }

    fn check(_binding: &'static str) -> Check {
        // z is off by 3 roundings of its largest term, half of that twice over in the root; and four operations.
        Check { relative: 1e-6, absolute: 1e-6, band: 0.0 }
    }
}

/// Records the widening of all Gaussians that exist, for a picture `larger` times as large as the training's; nothing
/// where that needs none.
pub fn record(rec: &mut Recorder<'_>, existing: &Slots, of: Gaussians<'_>, camera: &Camera, larger: f64) {
    let variance = variance(larger);
    if variance == 0.0 {
        return;
    }
    let focal = f64::from(camera.focal[0]) * f64::from(camera.focal[1]);
    let added = (variance * larger * larger / focal) as f32;
    let Gaussians { position, scale, .. } = of;
    let buffers = widen::Buffers { count: &existing.count, list: &existing.list, position, scale };
    rec.run(widen::Kernel, buffers, widen::Push { ahead: camera.rotation[2], added }, &existing.groups);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Buffer, testing};

    #[test]
    fn pictures_as_large_as_the_trainings_need_nothing() {
        assert_eq!((variance(1.0), variance(0.5)), (0.0, 0.0));
        // Nothing of the picture's own is left at any size.
        assert!((variance(1e6) - (0.3 - SQUARE)).abs() < 1e-9);
    }

    /// Needles, what is wide already, and what is behind the camera: as the twin has it, and as wide as in training.
    #[test]
    fn a_needle_is_as_wide_as_it_was_trained() {
        let gpu = testing::gpu();
        let (focal, larger) = (200.0, 4.0);
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [focal; 2],
            principal: [200.0, 160.0],
            distortion: [0.0; 4],
            size: [400, 320],
        };
        let depths: [f32; 70] = std::array::from_fn(|i| i as f32 - 3.0);
        let position: Vec<[f32; 3]> = depths.iter().map(|z| [0.2 * z, -0.1, *z]).collect();
        let position: Buffer<[f32; 3]> = gpu.upload("position", &position).expect("upload");
        let scale = gpu.upload("scale", &[[1e-9, 0.0, 5.0]; 70]).expect("upload");
        let rotation = gpu.upload("rotation", &[[1.0, 0.0, 0.0, 0.0]; 70]).expect("upload");
        let all = Slots::all(&gpu, 70).expect("buffers");
        let of = Gaussians { position: &position, scale: &scale, rotation: &rotation };
        let mut rec = gpu.checked().expect("recorder");
        record(&mut rec, &all, of, &camera, 1.0);
        record(&mut rec, &all, of, &camera, larger);
        let submission = rec.submit().expect("submit");
        assert_eq!(submission.differences.len(), 1, "a picture of the training's size takes no pass");
        for difference in &submission.differences {
            assert!(difference.ok(), "{difference}");
        }
        submission.wait().expect("wait");
        for (z, scale) in depths.iter().zip(gpu.read(&scale).expect("read")) {
            // In pixels of the training; the larger picture adds its own low-pass.
            let pixels = f64::from(focal) / larger / f64::from(z.abs().max(1e-3));
            let seen = (f64::from(scale[0]) * pixels).powi(2) + DILATION / (larger * larger) + SQUARE;
            assert!(*z == 0.0 || (seen - DILATION).abs() < 1e-5, "{z}: {seen}");
            assert!(scale[2] >= 5.0 && f64::from(scale[2]) < 5.2);
        }
    }
}

//! Which anchors are decoded: those whose own ellipsoid touches the view.
//!
//! The rule is Scaffold-GS's: the ellipsoid has the anchor's first three scales (those of the offsets) and no rotation;
//! its centre is beyond the near plane, and three standard deviations of the longer axis of its projection reach the
//! picture. It says nothing about the anchor's Gaussians: offsets are not bounded, so that a Gaussian that would show
//! can belong to an anchor that is culled. Such a Gaussian is not drawn, as published.

use super::project::{camera_push, lens};
use crate::gpu::kernels::render::cull;
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::camera::{Camera, Lens, entries, from_center, project, split, three_sigma};

/// Push constants of `cull` for so many anchors.
pub fn push(camera: &Camera, near: f32, anchors: u32) -> cull::Push {
    let [center, center_low] = split(camera.center());
    camera_push!(
        cull::Push, camera, near, center: center, center_low: center_low, size: camera.size, anchors: anchors
    )
}

impl Reference for cull::Kernel {
    fn reference(host: cull::Host<'_>, push: cull::Push, (): ()) {
        let lens: Lens = lens!(push);
        for anchor in 0..push.anchors as usize {
            let seen = from_center(host.position[anchor], [push.center, push.center_low]);
            let p = lens.to_camera_f32(seen);
            let touches = lens.in_front(p) && {
                let scale = std::array::from_fn(|i| f64::from(host.log_scaling[6 * anchor + i]).exp());
                let splat = project(&lens, seen.map(f64::from), scale, [1.0, 0.0, 0.0, 0.0], lens.bounds(p));
                let radius = three_sigma(entries(splat.covariance));
                (0..2).all(|i| {
                    let beyond = splat.mean[i] + radius < 0.0 || splat.mean[i] - radius > f64::from(push.size[i]);
                    !beyond
                })
            };
            host.flags[anchor] = u32::from(touches);
        }
    }

    /// An ellipse that ends within float32 rounding (some 1e-5 of its extent) of the picture's edge may fall on either
    /// side; with extents and positions spread over pictures, that is one anchor in ten thousand at most.
    fn check(_: &'static str) -> Check {
        Check { band: 1e-4, ..Check::default() }
    }
}

/// The stage: a flag for each of `capacity` anchors.
#[derive(Debug)]
pub struct Cull {
    /// 1 for an anchor to decode, otherwise 0; \[N\].
    pub flags: Buffer<u32>,
}

impl Cull {
    /// Flags for `capacity` anchors.
    ///
    /// # Errors
    /// When the device has no memory for them.
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        Ok(Self { flags: gpu.buffer("flags", capacity as usize)? })
    }

    /// Records the flags of the first `anchors` anchors: positions (world, \[N\]), log-scales (\[N*6\]).
    ///
    /// # Panics
    /// For more anchors than the capacity.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        position: &Buffer<[f32; 3]>,
        log_scaling: &Buffer<f32>,
        anchors: u32,
        camera: &Camera,
        near: f32,
    ) -> &Buffer<u32> {
        assert!(anchors as usize <= self.flags.len(), "cull: {anchors} anchors, room for {}", self.flags.len());
        let buffers = cull::Buffers { position, log_scaling, flags: &self.flags };
        rec.run(cull::Kernel, buffers, push(camera, near, anchors), anchors);
        &self.flags
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::super::project::NEAR;
    use super::*;
    use crate::gpu::testing;

    fn camera(distortion: [f32; 4]) -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [100.0, 100.0],
            principal: [50.0, 40.0],
            distortion,
            size: [100, 80],
        }
    }

    /// An anchor at a position, with one standard deviation along all axes.
    fn case(anchors: &[([f32; 3], f32)]) -> cull::Arrays {
        cull::Arrays {
            position: anchors.iter().map(|a| a.0).collect(),
            log_scaling: anchors.iter().flat_map(|a| [a.1.ln(), a.1.ln(), a.1.ln(), 9.0, 9.0, 9.0]).collect(),
            flags: vec![7; anchors.len()],
        }
    }

    #[test]
    fn ellipsoids_that_reach_the_picture_are_kept() {
        let gpu = testing::gpu();
        let camera = camera([0.0; 4]);
        // At depth 2 a standard deviation of 0.1 is 5 px across the ray; the slope of the ray (0.65 at most in x, 0.52
        // in y: the picture and 30 %) stretches it to 5.96 and 5.64 px. Three of them with the low-pass, 17.96 and
        // 16.99 px, reach the edge from 1.359 and 1.140.
        let anchors = [
            ([0.0, 0.0, 2.0], 0.1),
            ([1.35, 0.0, 2.0], 0.1),
            ([1.37, 0.0, 2.0], 0.1),
            ([-1.35, 0.0, 2.0], 0.1),
            ([-1.37, 0.0, 2.0], 0.1),
            ([0.0, 1.13, 2.0], 0.1),
            ([0.0, 1.15, 2.0], 0.1),
            ([0.0, 0.0, NEAR], 0.1),
            ([0.0, 0.0, -2.0], 5.0),
            ([50.0, 0.0, 2.0], 1e30),
            ([f32::NAN, 0.0, 2.0], 0.1),
        ];
        let got = testing::run_once(cull::Kernel, &gpu, &case(&anchors), push(&camera, NEAR, 11), 11u32);
        assert_eq!(got.flags, [1, 1, 0, 1, 0, 1, 0, 0, 0, 1, 0]);
        let mut want = case(&anchors);
        let host = cull::Host { position: &want.position, log_scaling: &want.log_scaling, flags: &mut want.flags };
        cull::Kernel::reference(host, push(&camera, NEAR, 11), ());
        assert_eq!(got.flags, want.flags);
    }

    #[test]
    fn kernel_matches_its_twin() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(1);
        for distortion in [[0.0; 4], [0.03, -0.01, 0.002, -0.001], [-0.2, 0.0, 0.0, 0.0]] {
            for n in [0usize, 1, 63, 64, 65, 1000, 20_000] {
                let mut draw = |low: f32, high: f32| low + (high - low) * rng.random::<f32>();
                let arrays = cull::Arrays {
                    position: (0..n + 2).map(|_| [draw(-4.0, 4.0), draw(-4.0, 4.0), draw(-2.0, 6.0)]).collect(),
                    log_scaling: (0..6 * (n + 2)).map(|_| draw(-7.0, 0.0)).collect(),
                    flags: vec![7; n + 2],
                };
                let push = push(&camera(distortion), NEAR, n as u32);
                let got = testing::run_once(cull::Kernel, &gpu, &arrays, push, n + 70);
                assert_eq!(got.flags[n..], [7, 7], "anchors beyond the number are left alone");
                let kept = got.flags[..n].iter().filter(|&&f| f == 1).count();
                assert!(n < 1000 || (n / 50..n / 2).contains(&kept), "{kept} of {n} kept: the case tests too little");
                testing::assert_twin(cull::Kernel, &gpu, arrays, push, n + 70);
            }
        }
    }
}

//! Gaussians onto the picture: EWA splatting through a distorting lens, and its gradients.
//!
//! Gaussians that exist are projected, the others' slots are not written. One is absent (depth 0, everything else 0) where
//! it is not beyond the near plane, where its centre lies beyond the radius at which the lens polynomial folds back
//! ([`Camera::max_radius2`]), or where the result is not a number or beyond [`MAX_DEVIATION`](crate::math::camera::MAX_DEVIATION).
//!
//! Positions are seen from the camera's centre, covariances are factored: see [`crate::math::camera`].

use super::slots::Slots;
use crate::gpu::kernels::render::{project, project_backward};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::camera::{Camera, Lens, Splat};
use crate::math::camera::{project as project_one, project_backward as project_one_backward};
use crate::primitives::Count;

/// Camera z of the near plane, scene units (the release's value).
pub const NEAR: f32 = 0.2;

/// Gaussians in screen space, per slot.
#[derive(Clone, Copy)]
pub struct Projected<'a> {
    /// How many slots there are.
    pub slots: Count<'a>,
    /// Those whose Gaussian exists; the others hold nothing.
    pub existing: &'a Slots,
    /// `[slot]` px.
    pub mean: &'a Buffer<[f32; 2]>,
    /// `[slot]` factored: variance of x given y in px^2, slope of x on y, variance of y in px^2.
    pub covariance: &'a Buffer<[f32; 3]>,
    /// `[slot]` camera z, 0 where there is no Gaussian.
    pub depth: &'a Buffer<f32>,
    /// `[slot]`
    pub opacity: &'a Buffer<f32>,
    /// `[slot]` linear rgb.
    pub color: &'a Buffer<[f32; 3]>,
}

/// A kernel's push constants from a [`Camera`], a near plane and further fields; the kernels spell the camera alike.
macro_rules! camera_push {
    ($push:path, $camera:expr, $near:expr $(, $field:ident : $value:expr)*) => {{
        use $push as CameraPush;
        let camera: &$crate::math::camera::Camera = $camera;
        let ([fx, fy], [cx, cy]) = (camera.focal, camera.principal);
        CameraPush {
            rotation0: camera.rotation[0],
            rotation1: camera.rotation[1],
            rotation2: camera.rotation[2],
            lens: [fx, fy, cx, cy],
            distortion: camera.distortion,
            limits: camera.limits(),
            near: $near,
            max_radius2: camera.max_radius2(),
            $($field: $value,)*
        }
    }};
}

/// The [`Lens`] of such push constants.
macro_rules! lens {
    ($push:expr) => {{
        let push = $push;
        let [fx, fy, cx, cy] = push.lens.map(f64::from);
        $crate::math::camera::Lens {
            rotation: [push.rotation0, push.rotation1, push.rotation2].map(|row| row.map(f64::from)),
            focal: [fx, fy],
            principal: [cx, cy],
            distortion: push.distortion.map(f64::from),
            limits: push.limits.map(f64::from),
            near: push.near,
            max_radius2: push.max_radius2,
        }
    }};
}
pub(crate) use {camera_push, lens};

/// Push constants of `project` for a camera and a near plane.
pub fn push(camera: &Camera, near: f32) -> project::Push {
    camera_push!(project::Push, camera, near)
}

/// Push constants of `project_backward`.
pub fn push_backward(camera: &Camera, near: f32) -> project_backward::Push {
    camera_push!(project_backward::Push, camera, near)
}

/// Float32 roundings of a chain of eight operations, times `|p| / z`, which cancellation in z = (R p)_z costs: 32 covers
/// points six units from the camera at the near plane. Each power of 1/z adds that once more.
const PER_POWER_OF_DEPTH: f64 = 8.0 * 6e-8 * 32.0;

/// The projection rounds each entry relative to `|t| |Q| |s|` before its terms cancel: relative to the largest.
fn check(powers: f64) -> Check {
    Check { relative: powers * PER_POWER_OF_DEPTH, absolute: powers * PER_POWER_OF_DEPTH / 8.0, band: 0.0 }
}

/// The slots of a list.
pub(super) fn listed(count: &[u32], list: &[u32]) -> impl Iterator<Item = usize> {
    list[..count[0] as usize].iter().map(|&slot| slot as usize)
}

impl Reference for project::Kernel {
    fn reference(host: project::Host<'_>, push: project::Push, (): ()) {
        let lens: Lens = lens!(push);
        for s in listed(host.count, host.list) {
            let position = host.position[s];
            let p = lens.to_camera_f32(position);
            let mut splat = Splat { covariance: [0.0; 3], ..Splat::default() };
            if lens.in_front(p) {
                let [scale, at] = [host.scale[s], position].map(|v| v.map(f64::from));
                splat = project_one(&lens, at, scale, host.rotation[s].map(f64::from), lens.bounds(p));
            }
            if !splat.representable() {
                splat = Splat::default();
            }
            host.mean[s] = splat.mean.map(|v| v as f32);
            host.covariance[s] = splat.covariance.map(|v| v as f32);
            host.depth[s] = splat.depth as f32;
        }
    }

    fn check(binding: &'static str) -> Check {
        check(if binding == "covariance" { 2.0 } else { 1.0 })
    }
}

impl Reference for project_backward::Kernel {
    fn reference(host: project_backward::Host<'_>, push: project_backward::Push, (): ()) {
        let lens: Lens = lens!(push);
        for s in listed(host.count, host.list) {
            let bounds = lens.bounds(lens.to_camera_f32(host.position[s]));
            let [position, scale, covariance] =
                [host.position[s], host.scale[s], host.grad_covariance[s]].map(|v| v.map(f64::from));
            let depth = host.grad_depth.map_or(0.0, |depth| f64::from(depth[s]));
            let upstream = Splat { mean: host.grad_mean[s].map(f64::from), covariance, depth };
            let rotation = host.rotation[s].map(f64::from);
            let grad = project_one_backward(&lens, position, scale, rotation, bounds, upstream);
            host.grad_position[s] = grad.position.map(|v| v as f32);
            host.grad_scale[s] = grad.scale.map(|v| v as f32);
            host.grad_rotation[s] = grad.rotation.map(|v| v as f32);
        }
    }

    fn check(binding: &'static str) -> Check {
        check(if binding == "grad_position" { 4.0 } else { 3.0 })
    }
}

/// What [`Project::record`] reads: one element per slot.
#[derive(Clone, Copy)]
pub struct Gaussians<'a> {
    /// Seen from the camera's centre, world axes.
    pub position: &'a Buffer<[f32; 3]>,
    /// Standard deviations, world.
    pub scale: &'a Buffer<[f32; 3]>,
    /// Unit quaternions w x y z.
    pub rotation: &'a Buffer<[f32; 4]>,
}

/// What [`ProjectBackward::record`] reads besides: one element per slot.
#[derive(Clone, Copy)]
pub struct SplatGradients<'a> {
    /// Per px.
    pub mean: &'a Buffer<[f32; 2]>,
    /// Of the factors of the covariance: variance of x given y, slope, variance of y.
    pub covariance: &'a Buffer<[f32; 3]>,
    /// Per scene unit; without losses that look at depth there is none.
    pub depth: Option<&'a Buffer<f32>>,
}

/// The forward stage: its outputs, of Gaussians that exist.
#[derive(Debug)]
pub struct Project {
    /// px, \[slot\].
    pub mean: Buffer<[f32; 2]>,
    /// Factored: variance of x given y in px^2, slope of x on y, variance of y in px^2, \[slot\].
    pub covariance: Buffer<[f32; 3]>,
    /// Camera z; 0 where nothing is seen of the Gaussian, \[slot\].
    pub depth: Buffer<f32>,
}

/// The backward stage: its outputs for as many slots, of Gaussians that touch a tile.
#[derive(Debug)]
pub struct ProjectBackward {
    /// \[slot\].
    pub grad_position: Buffer<[f32; 3]>,
    /// \[slot\].
    pub grad_scale: Buffer<[f32; 3]>,
    /// Of the quaternion as given, \[slot\].
    pub grad_rotation: Buffer<[f32; 4]>,
}

impl Project {
    /// Buffers for `anchors` visible anchors of `offsets` slots each.
    ///
    /// # Errors
    /// When the device has no memory for them.
    pub fn new(gpu: &Gpu, anchors: u32, offsets: u32) -> Result<Self, Error> {
        let slots = anchors as usize * offsets as usize;
        Ok(Self {
            mean: gpu.buffer("mean", slots)?,
            covariance: gpu.buffer("covariance", slots)?,
            depth: gpu.buffer("depth", slots)?,
        })
    }

    /// Records the projection of the Gaussians that exist.
    pub fn record(&self, rec: &mut Recorder<'_>, existing: &Slots, of: Gaussians<'_>, camera: &Camera, near: f32) {
        let buffers = project::Buffers {
            count: &existing.count,
            list: &existing.list,
            position: of.position,
            scale: of.scale,
            rotation: of.rotation,
            mean: &self.mean,
            covariance: &self.covariance,
            depth: &self.depth,
        };
        rec.run(project::Kernel, buffers, push(camera, near), &existing.groups);
    }
}

impl ProjectBackward {
    /// Buffers for the gradients of so many slots.
    ///
    /// # Errors
    /// When the device has no memory for them.
    pub fn new(gpu: &Gpu, slots: usize) -> Result<Self, Error> {
        Ok(Self {
            grad_position: gpu.buffer("grad_position", slots)?,
            grad_scale: gpu.buffer("grad_scale", slots)?,
            grad_rotation: gpu.buffer("grad_rotation", slots)?,
        })
    }

    /// Records the gradients of the Gaussians that touch a tile, after [`Project::record`] with the same Gaussians and
    /// camera.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        drawn: &Slots,
        of: Gaussians<'_>,
        grad: SplatGradients<'_>,
        camera: &Camera,
        near: f32,
    ) {
        let buffers = project_backward::Buffers {
            count: &drawn.count,
            list: &drawn.list,
            position: of.position,
            scale: of.scale,
            rotation: of.rotation,
            grad_mean: grad.mean,
            grad_covariance: grad.covariance,
            grad_position: &self.grad_position,
            grad_scale: &self.grad_scale,
            grad_rotation: &self.grad_rotation,
            grad_depth: grad.depth,
        };
        rec.run(project_backward::Kernel, buffers, push_backward(camera, near), &drawn.groups);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::gpu::testing;

    fn uniform(rng: &mut Pcg64, low: f32, high: f32) -> f32 {
        low + (high - low) * rng.random::<f32>()
    }

    fn camera(distortion: [f32; 4]) -> Camera {
        let (s, c) = 0.4f32.sin_cos();
        Camera {
            rotation: [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]],
            translation: [0.3, -0.2, 3.0],
            focal: [90.0, 92.0],
            principal: [48.5, 31.0],
            distortion,
            size: [96, 64],
        }
    }

    /// Gaussians around the view, some behind the camera, some beyond the limits; every seventh does not exist.
    fn case(rng: &mut Pcg64, slots: usize, spare: usize) -> project::Arrays {
        let n = slots + spare;
        let listed: Vec<u32> = (0..slots as u32).filter(|i| i % 7 != 3).collect();
        // World coordinates around the origin, as the camera sees them.
        let center = camera([0.0; 4]).center();
        let seen = |p: [f32; 3]| std::array::from_fn(|i| (f64::from(p[i]) - center[i]) as f32);
        let vec3 =
            |rng: &mut Pcg64, low: f32, high: f32| -> [f32; 3] { std::array::from_fn(|_| uniform(rng, low, high)) };
        let quaternion = |rng: &mut Pcg64| {
            let q: [f32; 4] = std::array::from_fn(|_| uniform(rng, -1.0, 1.0));
            let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-3);
            q.map(|v| v / norm)
        };
        project::Arrays {
            count: vec![listed.len() as u32],
            list: listed.iter().copied().chain([0; 3]).collect(),
            position: (0..n).map(|_| seen(vec3(rng, -3.0, 3.0))).collect(),
            scale: (0..n).map(|_| vec3(rng, -12.0, 1.5).map(f32::exp)).collect(),
            rotation: (0..n).map(|_| quaternion(rng)).collect(),
            mean: vec![[testing::UNWRITTEN; 2]; n],
            covariance: vec![[testing::UNWRITTEN; 3]; n],
            depth: vec![testing::UNWRITTEN; n],
        }
    }

    /// Of those that are seen.
    fn backward_case(rng: &mut Pcg64, forward: &project::Arrays) -> project_backward::Arrays {
        let n = forward.position.len();
        let seen: Vec<u32> = (0..n as u32).filter(|&s| forward.depth[s as usize] > 0.0).collect();
        project_backward::Arrays {
            count: vec![seen.len() as u32],
            list: seen.into_iter().chain([0; 3]).collect(),
            position: forward.position.clone(),
            scale: forward.scale.clone(),
            rotation: forward.rotation.clone(),
            grad_mean: (0..n).map(|_| std::array::from_fn(|_| uniform(rng, -1.0, 1.0))).collect(),
            grad_covariance: (0..n).map(|_| std::array::from_fn(|_| uniform(rng, -1.0, 1.0))).collect(),
            grad_depth: Some((0..n).map(|_| uniform(rng, -1.0, 1.0)).collect()),
            grad_position: vec![[testing::UNWRITTEN; 3]; n],
            grad_scale: vec![[testing::UNWRITTEN; 3]; n],
            grad_rotation: vec![[testing::UNWRITTEN; 4]; n],
        }
    }

    const LENSES: [[f32; 4]; 3] = [[0.0; 4], [0.03, -0.01, 0.002, -0.001], [-0.2, 0.0, 0.0, 0.0]];

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(1);
        for distortion in LENSES {
            let camera = camera(distortion);
            for slots in [0, 1, 63, 64, 65, 1000, 5001] {
                let case = case(&mut rng, slots, 3);
                testing::assert_twin(project::Kernel, &gpu, case.clone(), push(&camera, NEAR), slots + 2);
                let forward = testing::run_once(project::Kernel, &gpu, &case, push(&camera, NEAR), slots);
                let alone = |s: usize| s >= slots || s % 7 == 3;
                assert!((0..slots + 3).all(|s| !alone(s) || forward.depth[s].is_nan()), "others are left alone");
                if slots == 1000 {
                    let present = forward.depth[..slots].iter().filter(|&&d| d > 0.0).count();
                    assert!((100..900).contains(&present), "{present} of {slots} present: the case tests too little");
                }
                let case = backward_case(&mut rng, &forward);
                let color = project_backward::Arrays { grad_depth: None, ..case.clone() };
                for case in [case, color] {
                    testing::assert_twin(project_backward::Kernel, &gpu, case, push_backward(&camera, NEAR), slots + 2);
                }
            }
        }
    }

    /// Each Gaussian by its own size: a needle of a thousandth of a pixel beside one of thousands of pixels.
    #[test]
    fn small_gaussians_are_as_exact_as_large_ones() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(6);
        let camera = camera(LENSES[1]);
        let case = case(&mut rng, 4000, 0);
        let got = testing::run_once(project::Kernel, &gpu, &case, push(&camera, NEAR), 4000u32);
        let upstream = backward_case(&mut rng, &got);
        let back = testing::run_once(project_backward::Kernel, &gpu, &upstream, push_backward(&camera, NEAR), 4000u32);
        let want = testing::run_twin(project::Kernel, (), case, push(&camera, NEAR));
        let want_back = testing::run_twin(project_backward::Kernel, (), upstream.clone(), push_backward(&camera, NEAR));
        // Relative to the terms before they cancel: |t|^2 s^2 with t = J R and the Gaussian's longest s. The camera's
        // focal lengths are at most 92, the rays' slopes lengthen a row of J by less than 1.6.
        let slots: Vec<(f64, f64, f64)> = (0..4000)
            .map(|s| {
                let longest = upstream.scale[s].into_iter().fold(0.0f32, f32::max);
                let z = f64::from(got.depth[s]);
                (if z > 0.0 { 92.0 * 1.6 / z } else { 0.0 }, longest.into(), z)
            })
            .collect();
        let assert_close = |name: &str, got: &[f32], want: &[f32], width: usize, powers: f64, sizes: Vec<f64>| {
            let rows = got.chunks_exact(width).zip(want.chunks_exact(width)).enumerate();
            for (s, (got, want)) in rows.filter(|(s, _)| slots[*s].2 > 0.0) {
                for (g, w) in got.iter().zip(want) {
                    let error = (f64::from(*g) - f64::from(*w)).abs();
                    let limit = powers * PER_POWER_OF_DEPTH / 8.0 * sizes[s];
                    assert!(error <= limit, "{name} of slot {s}: {got:?}, not {want:?} within {limit:e}");
                }
            }
        };
        // A row of the upstream gradient has two entries of at most 1, and both rows meet: 4 |t|^2 s^2.
        let sizes = |f: fn((f64, f64, f64)) -> f64| slots.iter().map(|&s| f(s)).collect();
        let size = sizes(|(t, s, _)| t * t * s * s + 0.3);
        assert_close("covariance", got.covariance.as_flattened(), want.covariance.as_flattened(), 3, 2.0, size);
        let size = sizes(|(t, s, _)| 4.0 * t * t * s);
        assert_close("grad_scale", back.grad_scale.as_flattened(), want_back.grad_scale.as_flattened(), 3, 3.0, size);
        let size = sizes(|(t, s, _)| 4.0 * t * t * s * s);
        let (a, b) = (back.grad_rotation.as_flattened(), want_back.grad_rotation.as_flattened());
        assert_close("grad_rotation", a, b, 4, 3.0, size);
        let size = sizes(|(t, s, z)| if z > 0.0 { 4.0 * t * t * s * s / z + 2.0 * t + 1.0 } else { 0.0 });
        let (a, b) = (back.grad_position.as_flattened(), want_back.grad_position.as_flattened());
        assert_close("grad_position", a, b, 3, 4.0, size);
    }

    /// Nothing that is not finite comes out: zero depth, overflow, not-a-number, points behind the camera.
    #[test]
    fn what_cannot_be_projected_is_absent() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(3);
        let mut case = case(&mut rng, 7, 0);
        (case.count, case.list) = (vec![7], (0..7).collect());
        let mut camera = camera([0.0; 4]);
        camera.rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        camera.translation = [0.0; 3];
        case.scale = vec![[0.1; 3]; 7];
        case.position = vec![
            [0.0, 0.0, 0.0],
            [0.0, 0.0, -1.0],
            [0.0, 0.0, NEAR],
            [f32::NAN, 0.0, 1.0],
            [f32::INFINITY, 0.0, 1.0],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, 2.0],
        ];
        case.scale[5] = [1e30, 0.1, 0.1];
        let got = testing::run_once(project::Kernel, &gpu, &case, push(&camera, NEAR), 7u32);
        assert_eq!(got.depth, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0]);
        assert_eq!(got.mean[..6], [[0.0; 2]; 6]);
        assert_eq!(got.covariance[..6], [[0.0; 3]; 6]);
        testing::assert_twin(project::Kernel, &gpu, case, push(&camera, NEAR), 7u32);
    }

    #[test]
    fn folded_points_are_absent() {
        // 1 - 3 * 0.2 r^2 = 0.
        let camera = camera([-0.2, 0.0, 0.0, 0.0]);
        assert!((f64::from(camera.max_radius2()) - 1.0 / 0.6).abs() < 1e-6);
        // 1 + 3 k1 u + 5 k2 u^2 with roots 1 and 4: k2 = 1 / 20, k1 = -5 / 12.
        let two = self::camera([-5.0 / 12.0, 0.05, 0.0, 0.0]);
        assert!((two.max_radius2() - 1.0).abs() < 1e-5);
        for endless in [[0.0; 4], [0.03, 0.0, 0.0, 0.0], [0.1, 0.1, 0.0, 0.0], [-0.1, 0.1, 0.0, 0.0]] {
            assert!(self::camera(endless).max_radius2() > 1e6);
        }
        assert!(self::camera([0.1, -0.1, 0.0, 0.0]).max_radius2() < 3.0);
        let lens = Lens::new(&camera, NEAR);
        assert!(lens.in_front([1.29, 0.0, 1.0]) && !lens.in_front([1.3, 0.0, 1.0]));
    }

    /// The gradient against central differences of the float64 projection, every input, clamped and free.
    #[test]
    fn gradients_are_the_projections_derivatives() {
        let mut rng = Pcg64::seed_from_u64(4);
        let mut clamped = 0;
        for distortion in LENSES {
            let lens = Lens::new(&camera(distortion), NEAR);
            let case = case(&mut rng, 200, 0);
            for s in 0..200 {
                let p = lens.to_camera_f32(case.position[s]);
                if !lens.in_front(p) {
                    continue;
                }
                let bounds = lens.bounds(p);
                clamped += usize::from(bounds.iter().any(Option::is_some));
                let random: [f64; 6] = std::array::from_fn(|_| uniform(&mut rng, -1.0, 1.0).into());
                let [m0, m1, c0, c1, c2, depth] = random;
                let upstream = Splat { mean: [m0, m1], covariance: [c0, c1, c2], depth };
                let mut x = [0.0; 10];
                x[..3].copy_from_slice(&case.position[s].map(f64::from));
                // Scales of order one: differences of a needle's narrow axes drown in its long one's rounding.
                x[3..6].copy_from_slice(&case.scale[s].map(|v| f64::from(v).max(0.05)));
                x[6..].copy_from_slice(&case.rotation[s].map(f64::from));
                let split = |x: [f64; 10]| ([x[0], x[1], x[2]], [x[3], x[4], x[5]], [x[6], x[7], x[8], x[9]]);
                let value = |x: [f64; 10]| {
                    let (position, scale, rotation) = split(x);
                    let s = project_one(&lens, position, scale, rotation, bounds);
                    let outputs = [s.mean[0], s.mean[1], s.covariance[0], s.covariance[1], s.covariance[2], s.depth];
                    outputs.iter().zip(random).map(|(a, b)| a * b).sum::<f64>()
                };
                let (position, scale, rotation) = split(x);
                let g = project_one_backward(&lens, position, scale, rotation, bounds, upstream);
                let got: Vec<f64> = g.position.into_iter().chain(g.scale).chain(g.rotation).collect();
                let size = got.iter().fold(0.0f64, |m, v| m.max(v.abs()));
                for i in 0..10 {
                    // Fourth order, step 1e-4: truncation (h/z)^4 < 1e-13 of the largest derivative, rounding
                    // 1e-16 / 1e-4 of the loss.
                    let at = |h: f64| {
                        let mut y = x;
                        y[i] += h;
                        value(y)
                    };
                    let h = 1e-4;
                    let want = (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h);
                    let limit = 1e-7 * size + 1e-11 * value(x).abs();
                    assert!((got[i] - want).abs() <= limit, "slot {s} input {i}: {} instead of {want}", got[i]);
                }
            }
        }
        assert!(clamped > 20, "{clamped} clamped: the case tests too little");
    }

    /// The stages with the count on the device give what the kernels give.
    #[test]
    fn stages_run_on_a_count_on_the_device() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(5);
        let slots = 770;
        let camera = camera(LENSES[1]);
        let arrays = case(&mut rng, slots, 0);
        let want = testing::run_once(project::Kernel, &gpu, &arrays, push(&camera, NEAR), slots);
        let upstream = backward_case(&mut rng, &want);
        let push = push_backward(&camera, NEAR);
        let want_backward = testing::run_once(project_backward::Kernel, &gpu, &upstream, push, slots);

        let fine = "the device runs a test";
        let forward = Project::new(&gpu, 86, 10).expect(fine);
        let backward = ProjectBackward::new(&gpu, forward.depth.len()).expect(fine);
        let list = |count: &[u32], list: &[u32]| {
            let slots = Slots::new(&gpu, ["list", "list_count", "list_groups"], 860).expect(fine);
            gpu.write(&slots.count, count).expect(fine);
            gpu.write(&slots.list, list).expect(fine);
            slots
        };
        let (existing, drawn) = (list(&arrays.count, &arrays.list), list(&upstream.count, &upstream.list));
        let position = gpu.upload("position", &arrays.position).expect(fine);
        let scale = gpu.upload("scale", &arrays.scale).expect(fine);
        let rotation = gpu.upload("rotation", &arrays.rotation).expect(fine);
        let mean = gpu.upload("grad_mean", &upstream.grad_mean).expect(fine);
        let covariance = gpu.upload("grad_covariance", &upstream.grad_covariance).expect(fine);
        let depth = upstream.grad_depth.as_ref().map(|depth| gpu.upload("grad_depth", depth).expect(fine));
        let of = Gaussians { position: &position, scale: &scale, rotation: &rotation };
        let grad = SplatGradients { mean: &mean, covariance: &covariance, depth: depth.as_ref() };
        let mut rec = gpu.recorder().expect(fine);
        existing.dispatch(&mut rec);
        drawn.dispatch(&mut rec);
        forward.record(&mut rec, &existing, of, &camera, NEAR);
        backward.record(&mut rec, &drawn, of, grad, &camera, NEAR);
        rec.submit().expect(fine).wait().expect(fine);
        for s in arrays.list[..arrays.count[0] as usize].iter().map(|&s| s as usize) {
            assert_eq!(gpu.read(&forward.mean).expect(fine)[s], want.mean[s]);
            assert_eq!(gpu.read(&forward.covariance).expect(fine)[s], want.covariance[s]);
            assert_eq!(gpu.read(&forward.depth).expect(fine)[s], want.depth[s]);
        }
        for s in upstream.list[..upstream.count[0] as usize].iter().map(|&s| s as usize) {
            assert_eq!(gpu.read(&backward.grad_position).expect(fine)[s], want_backward.grad_position[s]);
            assert_eq!(gpu.read(&backward.grad_scale).expect(fine)[s], want_backward.grad_scale[s]);
            assert_eq!(gpu.read(&backward.grad_rotation).expect(fine)[s], want_backward.grad_rotation[s]);
        }
    }
}

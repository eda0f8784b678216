//! Projection: needles, discs, sizes, planes and folds, each against the float64 path.
//!
//! # Bounds
//! With u = 2^-24 and rays within 60 degrees of the axis (|p| <= 2 z): `R p` is good to 3 u |p|, x/z to 24 u, a row t of
//! `J R` to 40 u |t|, `m = t Q` to 64 u |t|. So a projected axis `u_k = s_k m_k` is off by 64 u S at most, S being the
//! longest axis in pixels, `|t| s_max`, and a product of two of them by twice that and a few roundings. With S2 the second
//! longest axis, V, k, N the factors of the covariance and det = N V:
//! - V: 256 u S / sqrt(V) of V: how far the end of the longest axis moves, in units of the ellipse.
//! - k: 256 u S^2 / sqrt(det) of sqrt(N / V).
//! - N: 512 u (S S2 / sqrt(det) + S / sqrt(V)) of N: `u0 x u1` has components `s_j s_k n_i`, n good to 130 u |t|^2.
//!
//! None of these has the ratio of the axes of the covariance in it: for a needle S S2 / sqrt(det) is of order one,
//! where the determinant of a rounded covariance is off by u S^2 / 0.3. Second orders are left out: the bounds are
//! claimed where they are below 0.1.
//! Gradients, for upstream a / N, b sqrt(V / N), c / V (a, b, c of order one): with K = 1 + S / sqrt(V) +
//! S S2 / sqrt(det) + 0.3 S / (V sqrt(N)) and M = S^2 / sqrt(det) + S / sqrt(N) + S / sqrt(V), products of at most eight
//! factors good to 64 u and the Jacobian's: 1024 u K for log-scales, 1024 u K M for the quaternion, and for the position
//! in units of depth 1024 u K (M + |gradient through the mean|).

use gscream_vk::gpu::kernels::render::{project, project_backward};
use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::math::camera::{
    Camera, GaussianGradient, Lens, Splat, project as exact, project_backward as exact_backward,
};
use gscream_vk::render::project as stage;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::Case;

/// Unit roundoff of float32.
pub const U: f64 = 1.0 / (1u64 << 24) as f64;
const NEAR: f32 = 0.2;

pub const CASES: &[Case] = &[
    Case {
        stage: "project",
        case: "needles and discs with axis ratios of 1e8, up to 1e6 px long",
        guarantee: "factors of the covariance and gradients within 2^-14 times condition numbers that are linear in the length in px, without the axes' ratio in them",
        run: needles_and_discs,
    },
    Case {
        stage: "project",
        case: "standard deviations from 1e-12 to 1e6, each axis by itself",
        guarantee: "finite, variances at least 0.3 px^2; within the same bounds where they are below 0.1",
        run: sizes,
    },
    Case {
        stage: "project",
        case: "camera inside a Gaussian, means at the near plane and behind it",
        guarantee: "present exactly where float32 z > near, then within the bounds; otherwise absent with gradients of exactly 0",
        run: near_plane,
    },
    Case {
        stage: "project",
        case: "means far outside the frustum, up to 1e38 from the axis",
        guarantee: "within 2^60 px and finite, or absent with gradients of exactly 0; never not-a-number",
        run: far_outside,
    },
    Case {
        stage: "project",
        case: "means at the fold of the distortion polynomial",
        guarantee: "present up to the fold, within the bounds; absent beyond it with gradients of exactly 0",
        run: fold,
    },
    Case {
        stage: "project",
        case: "quaternion of length zero",
        guarantee: "the bits of the identity rotation, its own gradient exactly 0",
        run: zero_quaternion,
    },
    Case {
        stage: "project",
        case: "scene and near plane scaled by 2^-13, 2^13, 1e-4 and 1e4",
        guarantee: "powers of two: the same bits on the picture; others within the bounds",
        run: scaled,
    },
];

/// A Gaussian seen from the camera's centre.
#[derive(Clone, Copy)]
struct Gaussian {
    position: [f32; 3],
    scale: [f32; 3],
    rotation: [f32; 4],
}

fn camera(distortion: [f32; 4]) -> Camera {
    Camera {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation: [0.0; 3],
        focal: [900.0, 910.0],
        principal: [500.5, 320.25],
        distortion,
        size: [1000, 640],
    }
}

fn turned(distortion: [f32; 4]) -> Camera {
    let (s, c) = 0.4f32.sin_cos();
    Camera { rotation: [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], ..camera(distortion) }
}

fn quaternion(rng: &mut Pcg64Mcg) -> [f32; 4] {
    let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| (v / norm) as f32)
}

/// A point of the picture at a depth, seen from the centre of a camera (before its rotation).
fn in_view(rng: &mut Pcg64Mcg, camera: &Camera, z: f32) -> [f32; 3] {
    let p = [rng.random_range(-0.5..0.5) * z, rng.random_range(-0.35..0.35) * z, z];
    std::array::from_fn(|i| (0..3).map(|k| camera.rotation[k][i] * p[k]).sum())
}

struct Outcome {
    mean: Vec<[f32; 2]>,
    covariance: Vec<[f32; 3]>,
    depth: Vec<f32>,
    position: Vec<[f32; 3]>,
    scale: Vec<[f32; 3]>,
    rotation: Vec<[f32; 4]>,
    upstream: Vec<Splat>,
}

impl Outcome {
    fn absent(&self, s: usize) -> bool {
        self.depth[s] == 0.0
    }

    fn assert_absent(&self, s: usize, what: &str) {
        let zero = self.mean[s] == [0.0; 2] && self.covariance[s] == [0.0; 3] && self.depth[s] == 0.0;
        let flat = self.position[s] == [0.0; 3] && self.scale[s] == [0.0; 3] && self.rotation[s] == [0.0; 4];
        assert!(zero && flat, "{what}: {:?} {:?} {:?}", self.mean[s], self.covariance[s], self.scale[s]);
    }

    fn assert_finite(&self, s: usize, what: &str) {
        let all = self.mean[s].iter().chain(&self.covariance[s]).chain([&self.depth[s]]);
        let all = all.chain(&self.position[s]).chain(&self.scale[s]).chain(&self.rotation[s]);
        assert!(all.into_iter().all(|v| v.is_finite()), "{what}: {:?} {:?}", self.covariance[s], self.scale[s]);
    }
}

/// Forward and backward on the device, with an upstream gradient in units of each Gaussian's own size.
fn run(gpu: &Gpu, camera: &Camera, near: f32, gaussians: &[Gaussian]) -> Outcome {
    let n = gaussians.len();
    let arrays = project::Arrays {
        count: vec![n as u32],
        list: (0..n as u32).collect(),
        position: gaussians.iter().map(|g| g.position).collect(),
        scale: gaussians.iter().map(|g| g.scale).collect(),
        rotation: gaussians.iter().map(|g| g.rotation).collect(),
        mean: vec![[testing::UNWRITTEN; 2]; n],
        covariance: vec![[testing::UNWRITTEN; 3]; n],
        depth: vec![testing::UNWRITTEN; n],
    };
    let forward = testing::run_once(project::Kernel, gpu, &arrays, stage::push(camera, near), n);
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let upstream: Vec<Splat> = (0..n)
        .map(|s| {
            let [narrow, _, variance] = forward.covariance[s].map(|v| f64::from(v.max(0.3)));
            let mut one = || rng.random_range(-1.0f64..1.0);
            let covariance = [one() / narrow, one() * (variance / narrow).sqrt(), one() / variance];
            let depth = f64::from(forward.depth[s]).max(1e-30);
            let (mean, depth) = ([one() / 900.0, one() / 900.0], one() / depth);
            let round = |v: f64| f64::from(v as f32);
            Splat { mean: mean.map(round), covariance: covariance.map(round), depth: round(depth) }
        })
        .collect();
    let seen: Vec<u32> = (0..n as u32).filter(|&s| forward.depth[s as usize] > 0.0).collect();
    // Of those that are not seen nothing is written: the gradient is 0.
    let case = project_backward::Arrays {
        count: vec![seen.len() as u32],
        list: seen,
        position: arrays.position,
        scale: arrays.scale,
        rotation: arrays.rotation,
        grad_mean: upstream.iter().map(|g| g.mean.map(|v| v as f32)).collect(),
        grad_covariance: upstream.iter().map(|g| g.covariance.map(|v| v as f32)).collect(),
        grad_depth: Some(upstream.iter().map(|g| g.depth as f32).collect()),
        grad_position: vec![[0.0; 3]; n],
        grad_scale: vec![[0.0; 3]; n],
        grad_rotation: vec![[0.0; 4]; n],
    };
    let push = stage::push_backward(camera, near);
    let back = testing::run_once(project_backward::Kernel, gpu, &case, push, n);
    Outcome {
        mean: forward.mean,
        covariance: forward.covariance,
        depth: forward.depth,
        position: back.grad_position,
        scale: back.grad_scale,
        rotation: back.grad_rotation,
        upstream,
    }
}

fn wide<const C: usize>(v: [f32; C]) -> [f64; C] {
    v.map(f64::from)
}

fn norm<const C: usize>(v: [f64; C]) -> f64 {
    v.iter().map(|v| v * v).sum::<f64>().sqrt()
}

fn distance<const C: usize>(a: [f32; C], b: [f64; C]) -> f64 {
    norm(std::array::from_fn::<f64, C, _>(|i| f64::from(a[i]) - b[i]))
}

/// Checks a present Gaussian against the float64 path; returns whether the bounds said anything.
fn assert_close(camera: &Camera, near: f32, g: &Gaussian, got: &Outcome, s: usize, what: &str) -> bool {
    let lens = Lens::new(camera, near);
    let bounds = lens.bounds(lens.to_camera_f32(g.position));
    let (position, scale, rotation) = (wide(g.position), wide(g.scale), wide(g.rotation));
    let want = exact(&lens, position, scale, rotation, bounds);
    let [n, k, v] = want.covariance;
    assert!(got.covariance[s][0] >= 0.3 && got.covariance[s][2] >= 0.3, "{what}: {:?}", got.covariance[s]);
    // |t| is at most f / z times the ray's length, and once more for the lens's own slope.
    let z = want.depth;
    let ray = norm(lens.to_camera(position)) / z;
    let at = [0, 1].map(|i| bounds[i].unwrap_or(lens.to_camera(position)[i] / z));
    let [a, b, d] = lens.distort_jacobian(at);
    let t = 910.0 / z * ray * norm([a, b, d]).max(1.0);
    let mut sorted = scale;
    sorted.sort_by(|a, b| b.total_cmp(a));
    let (long, second, root) = (t * sorted[0], t * sorted[1], (n * v).sqrt());
    let (e_v, e_k) = (256.0 * U * (long / v.sqrt() + 1.0), 256.0 * U * (long * long / root + 1.0));
    let e_n = 512.0 * U * (long * second / root + long / v.sqrt() + 1.0);
    // The mean: f (1 + slope) x/z, and the sum with the principal point.
    let e_mean = 910.0 * 40.0 * U * ray * norm([a, b, d]).max(1.0) + 2.0 * U * norm(want.mean);
    assert!(distance(got.mean[s], want.mean) <= e_mean, "{what}: mean {:?}, not {:?}", got.mean[s], want.mean);
    assert!((f64::from(got.depth[s]) - z).abs() <= 4.0 * U * norm(position), "{what}: depth");
    let [gn, gk, gv] = wide(got.covariance[s]);
    let errors = [(gn - n).abs() / n / e_n, (gk - k).abs() * (v / n).sqrt() / e_k, (gv - v).abs() / v / e_v];
    let claimed = e_n.max(e_k).max(e_v) < 0.1;
    assert!(
        !claimed || errors.iter().all(|e| *e <= 1.0),
        "{what}: factors {:?}, not {:?}: {errors:?} of the bounds",
        got.covariance[s],
        want.covariance
    );
    let want: GaussianGradient = exact_backward(&lens, position, scale, rotation, bounds, got.upstream[s]);
    let condition = 1.0 + long / v.sqrt() + long * second / root + 0.3 * long / (v * n.sqrt());
    let moved = long * long / root + long / n.sqrt() + long / v.sqrt() + 1.0;
    let bound = 1024.0 * U * condition;
    if bound < 0.1 {
        for (i, size) in scale.into_iter().enumerate() {
            let error = (f64::from(got.scale[s][i]) - want.scale[i]).abs() * size;
            assert!(error <= bound, "{what}: grad_scale {:?}, not {:?}: {error:e}", got.scale[s], want.scale);
        }
        let error = distance(got.rotation[s], want.rotation);
        assert!(error <= bound * moved, "{what}: grad_rotation {:?}, not {:?}", got.rotation[s], want.rotation);
        let error = distance(got.position[s], want.position) * z;
        let limit = bound * (moved + 4.0) * ray * ray * norm([a, b, d]).max(1.0);
        assert!(error <= limit, "{what}: grad_position {:?}, not {:?}: {error:e}", got.position[s], want.position);
    }
    claimed
}

fn needles_and_discs(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for camera in [camera([0.0; 4]), turned([0.03, -0.01, 0.002, -0.001])] {
        let gaussians: Vec<Gaussian> = (0..2000)
            .map(|i| {
                let z = rng.random_range(0.5f32..6.0);
                // From a hundredth of a pixel to a million pixels.
                let long = z / 900.0 * 10f32.powf(rng.random_range(-2.0..6.0));
                let scale = if i % 2 == 0 { [long, long * 1e-8, long * 1e-8] } else { [long, long, long * 1e-8] };
                Gaussian { position: in_view(&mut rng, &camera, z), scale, rotation: quaternion(&mut rng) }
            })
            .collect();
        let got = run(gpu, &camera, NEAR, &gaussians);
        let mut claimed = [0; 2];
        for (s, g) in gaussians.iter().enumerate() {
            let what = format!("Gaussian {s} of {:?}", g.scale);
            got.assert_finite(s, &what);
            assert!(!got.absent(s), "{what} is absent");
            claimed[s % 2] += usize::from(assert_close(&camera, NEAR, g, &got, s, &what));
        }
        // For all but those of more than some thousand pixels, whose slope a rotation by 2^-24 moves visibly.
        assert!(claimed[0] > 500 && claimed[1] > 500, "the bounds say nothing: {claimed:?}");
    }
}

fn sizes(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let camera = turned([0.03, -0.01, 0.002, -0.001]);
    let gaussians: Vec<Gaussian> = (0..3000)
        .map(|_| {
            let z = rng.random_range(0.21f32..9.0);
            let scale = std::array::from_fn(|_| 10f32.powf(rng.random_range(-12.0..6.0)));
            Gaussian { position: in_view(&mut rng, &camera, z), scale, rotation: quaternion(&mut rng) }
        })
        .chain([1e-12, 1e6].map(|s| Gaussian {
            position: in_view(&mut Pcg64Mcg::seed_from_u64(9), &camera, 0.2001),
            scale: [s; 3],
            rotation: [1.0, 0.0, 0.0, 0.0],
        }))
        .collect();
    let got = run(gpu, &camera, NEAR, &gaussians);
    let mut claimed = 0;
    for (s, g) in gaussians.iter().enumerate() {
        let what = format!("Gaussian {s} of {:?}", g.scale);
        got.assert_finite(s, &what);
        assert!(!got.absent(s), "{what} is absent");
        claimed += usize::from(assert_close(&camera, NEAR, g, &got, s, &what));
    }
    assert!(claimed > 500, "the bounds say nothing: {claimed}");
}

fn near_plane(gpu: &Gpu) {
    let camera = camera([0.03, 0.0, 0.0, 0.0]);
    let beside = |z: f32| Gaussian {
        position: [0.05 * z.abs(), -0.02 * z.abs(), z],
        scale: [0.01, 0.02, 0.005],
        rotation: [1.0, 0.0, 0.0, 0.0],
    };
    let around = |z: f32| Gaussian { scale: [50.0, 3.0, 7.0], ..beside(z) };
    let present = [NEAR.next_up(), 0.2001, 0.3];
    let absent = [NEAR, NEAR.next_down(), 1e-30, 0.0, -0.0, -NEAR, -1.0, -1e6];
    for of in [&beside as &dyn Fn(f32) -> Gaussian, &around] {
        let gaussians: Vec<Gaussian> = present.iter().chain(&absent).map(|&z| of(z)).collect();
        let got = run(gpu, &camera, NEAR, &gaussians);
        for (s, g) in gaussians.iter().enumerate() {
            let what = format!("z = {:e}", g.position[2]);
            got.assert_finite(s, &what);
            if s < present.len() {
                assert!(!got.absent(s), "{what} is absent");
                assert!(assert_close(&camera, NEAR, g, &got, s, &what), "{what}: the bounds say nothing");
            } else {
                got.assert_absent(s, &what);
            }
        }
    }
}

fn far_outside(gpu: &Gpu) {
    for (distortion, most) in [([0.0; 4], 1e18), ([0.03, 0.0, 0.0, 0.0], 1e5), ([0.05, 0.02, 0.001, 0.001], 1e3)] {
        let camera = camera(distortion);
        let gaussians: Vec<Gaussian> = (0..=76)
            .flat_map(|i| [1.0, -1.0].map(|sign| sign * 10f32.powf(0.5 * i as f32)))
            .flat_map(|x| [[x, 0.3, 1.0], [0.1, x, 1.0], [x, -x, 1.0]])
            .map(|position| Gaussian { position, scale: [0.1, 0.2, 1e-3], rotation: [1.0, 0.0, 0.0, 0.0] })
            .collect();
        let got = run(gpu, &camera, NEAR, &gaussians);
        let (mut there, mut gone) = (0, 0);
        for (s, g) in gaussians.iter().enumerate() {
            let what = format!("{:?} through {distortion:?}", g.position);
            got.assert_finite(s, &what);
            if got.absent(s) {
                gone += 1;
                got.assert_absent(s, &what);
                let far = g.position.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                assert!(far > most as f32 * 1e-4, "{what} is absent");
            } else {
                there += 1;
                assert!(got.mean[s].iter().all(|m| m.abs() <= (1u64 << 60) as f32), "{what}: {:?}", got.mean[s]);
                let lens = Lens::new(&camera, NEAR);
                let ray = wide(g.position);
                let want = exact(&lens, ray, wide(g.scale), wide(g.rotation), lens.bounds(g.position));
                // r^5 of the polynomial: five factors good to 30 u.
                assert!(distance(got.mean[s], want.mean) <= 200.0 * U * (norm(want.mean) + 1e3), "{what}: mean");
            }
        }
        assert!(there > 30 && gone > 30, "{there} present, {gone} absent: the case tests too little");
    }
}

fn fold(gpu: &Gpu) {
    // 1 - 0.6 r^2 = 0; and the nearer of the roots 1 and 4 of a polynomial with two.
    for (distortion, fold) in [([-0.2, 0.0, 0.0, 0.0], 1.0 / 0.6), ([-5.0 / 12.0, 0.05, 0.0, 0.0], 1.0)] {
        // Focal lengths for which the fold is within the picture, so that the Jacobian is taken at the point itself.
        let camera = Camera { focal: [300.0, 300.0], ..camera(distortion) };
        let radius = f64::sqrt(fold);
        let factors = [0.9, 0.999, 1.0 - 1e-5, 1.0 - 1e-6, 1.0 + 1e-6, 1.0 + 1e-5, 1.1, 3.0];
        let gaussians: Vec<Gaussian> = factors
            .iter()
            .flat_map(|f| {
                [0.0f64, 0.7, 2.5].map(|angle| Gaussian {
                    position: [angle.cos() * radius * f * 2.0, angle.sin() * radius * f * 2.0, 2.0].map(|v| v as f32),
                    scale: [0.01, 0.02, 0.005],
                    rotation: [0.8, 0.6, 0.0, 0.0],
                })
            })
            .collect();
        let got = run(gpu, &camera, NEAR, &gaussians);
        for (s, g) in gaussians.iter().enumerate() {
            let factor = factors[s / 3];
            let what = format!("{:?} at {factor} of the fold's radius", g.position);
            got.assert_finite(s, &what);
            if factor < 1.0 {
                assert!(!got.absent(s), "{what} is absent");
                assert!(assert_close(&camera, NEAR, g, &got, s, &what), "{what}: the bounds say nothing");
            } else {
                got.assert_absent(s, &what);
            }
        }
    }
}

fn zero_quaternion(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let camera = turned([0.03, 0.0, 0.0, 0.0]);
    let identity: Vec<Gaussian> = (0..100)
        .map(|_| Gaussian {
            position: in_view(&mut rng, &camera, 2.0),
            scale: std::array::from_fn(|_| rng.random_range(1e-3..0.1)),
            rotation: [1.0, 0.0, 0.0, 0.0],
        })
        .collect();
    let zero: Vec<Gaussian> = identity.iter().map(|g| Gaussian { rotation: [0.0; 4], ..*g }).collect();
    let (a, b) = (run(gpu, &camera, NEAR, &identity), run(gpu, &camera, NEAR, &zero));
    assert_eq!((a.mean, a.covariance, a.depth), (b.mean, b.covariance, b.depth));
    assert_eq!((a.position, a.scale), (b.position, b.scale));
    assert!(b.rotation.iter().flatten().all(|v| *v == 0.0), "a gradient of a quaternion that has no direction");
}

fn scaled(gpu: &Gpu) {
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    let camera = turned([0.03, -0.01, 0.002, -0.001]);
    let gaussians: Vec<Gaussian> = (0..500)
        .map(|_| {
            let z = rng.random_range(0.3f32..6.0);
            let scale = std::array::from_fn(|_| 10f32.powf(rng.random_range(-5.0..0.0)));
            Gaussian { position: in_view(&mut rng, &camera, z), scale, rotation: quaternion(&mut rng) }
        })
        .collect();
    let unit = run(gpu, &camera, NEAR, &gaussians);
    for factor in [1.0 / 8192.0, 8192.0, 1e-4, 1e4] {
        let larger: Vec<Gaussian> = gaussians
            .iter()
            .map(|g| Gaussian { position: g.position.map(|v| v * factor), scale: g.scale.map(|v| v * factor), ..*g })
            .collect();
        let got = run(gpu, &camera, NEAR * factor, &larger);
        if factor == 8192.0 || factor == 1.0 / 8192.0 {
            assert_eq!((&got.mean, &got.covariance), (&unit.mean, &unit.covariance), "times {factor}");
        }
        for (s, g) in larger.iter().enumerate() {
            assert!(!got.absent(s));
            assert_close(&camera, NEAR * factor, g, &got, s, &format!("Gaussian {s} times {factor}"));
        }
    }
}

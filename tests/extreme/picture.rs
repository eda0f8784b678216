//! From anchors to a picture and back: scenes far from the origin, tiny and huge ones, nothing to see, odd pictures.

use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::model::anchors::Decoded;
use gscream_vk::model::files;
use gscream_vk::primitives::limit::{Counter, Limits};
use gscream_vk::render::decode::{self, AnchorGradients, DecodeBackward, GaussianGradients};
use gscream_vk::render::forward::{Capacity, Forward};
use gscream_vk::render::method::{DepthKey, Method};
use gscream_vk::render::project::{ProjectBackward, SplatGradients};
use gscream_vk::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use gscream_vk::render::tiling::Tiling;
use gscream_vk::scene::Camera;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::Case;
use crate::project::U;
use crate::screen::{self, BACKGROUND, Splats};

pub const CASES: &[Case] = &[
    Case {
        stage: "cull to decode_backward",
        case: "camera and anchors moved by (1e6, -1e6, 1e6), on a grid of 1/16",
        guarantee: "picture, depth and all gradients to the bit those of the scene at the origin",
        run: moved,
    },
    Case {
        stage: "cull to decode_backward",
        case: "the same with a camera between the numbers of float32 at 1e6, which are 1/16 apart",
        guarantee: "means within 2^-9 px of where they are at the origin",
        run: between,
    },
    Case {
        stage: "cull to decode_backward",
        case: "scene and near plane scaled by 1e-4 and 1e4",
        guarantee: "the same Gaussians visible, means within 2^-10 px, covariances within 2^-11; gradients finite",
        run: scaled,
    },
    Case {
        stage: "cull to decode_backward",
        case: "no anchors, none in view, one",
        guarantee: "the background to the bit and gradients of exactly 0; the one within the bounds of blending",
        run: few,
    },
    Case {
        stage: "cull to decode_backward",
        case: "pictures of 1 x 1, 17 x 3 and 8191 x 2",
        guarantee: "every pixel written and within the bounds of blending; gradients finite",
        run: shapes,
    },
    Case {
        stage: "cull to decode_backward",
        case: "log-scales of +-40, 88, 100 and 1e30, of offsets and of Gaussians",
        guarantee: "Gaussians beyond 2^60 px absent; picture within the bounds of blending (with depth keys of 31 bits: the usual 28 order depths up to 2^32 times the near plane); gradients finite, but for an offset's beyond float32's range, which is infinite and never not-a-number",
        run: log_scales,
    },
];

const NEAR: f32 = 0.2;
const K: usize = 10;

/// A model before the decoder: anchors, and the decoders' weights.
#[derive(Clone)]
struct Model {
    anchors: files::Anchors,
    weights: Vec<f32>,
}

fn camera(size: [u32; 2]) -> Camera {
    let (s, c) = 0.3f32.sin_cos();
    let rotation = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]];
    Camera {
        rotation,
        translation: Camera::translation_to(&rotation, [0.25, -0.125, -3.0]),
        focal: [90.0, 92.0],
        principal: size.map(|n| n as f32 / 2.0),
        distortion: [0.03, -0.01, 0.002, -0.001],
        size,
    }
}

/// Anchors on a grid of 1/16 around the origin; positions are not multiplied by a decoder's weight for the distance.
fn model(seed: u64, anchors: usize, extent: f32) -> Model {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut weights: Vec<f32> =
        files::weight_shapes(K, false).iter().flat_map(|(_, shape)| vec![0.0; shape.iter().product()]).collect();
    weights.iter_mut().for_each(|w| *w = rng.random_range(-0.3..0.3));
    // The distance is the last input of each head's first layer.
    let mut from = 0;
    for outputs in [K, 3 * K, 7 * K] {
        (0..32).for_each(|unit| weights[from + 36 * unit + 35] = 0.0);
        from += 32 * 36 + 32 + 33 * outputs;
    }
    assert_eq!(from, weights.len());
    Model {
        anchors: files::Anchors::new(
            K,
            (0..anchors)
                .map(|_| std::array::from_fn(|_| (rng.random_range(-extent..extent) * 16.0).round() / 16.0))
                .collect(),
            (0..anchors).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect(),
            (0..anchors * K * 3).map(|_| rng.random_range(-1.0..1.0)).collect(),
            (0..anchors).map(|_| std::array::from_fn(|_| rng.random_range(-3.5..-2.0))).collect(),
        ),
        weights,
    }
}

/// Everything that comes back.
struct Whole {
    visible: u32,
    splats: Splats,
    rgb: Vec<[f32; 3]>,
    depth: Vec<f32>,
    transmittance: Vec<f32>,
    gradients: [Vec<f32>; 4],
}

impl Whole {
    fn assert_finite(&self, what: &str) {
        let all = self.rgb.as_flattened().iter().chain(&self.depth).chain(&self.transmittance);
        assert!(all.clone().all(|v| v.is_finite()), "{what}: the picture");
        for (i, gradient) in self.gradients.iter().enumerate() {
            assert!(gradient.iter().all(|v| v.is_finite()), "{what}: gradient {i}");
        }
    }
}

fn run(gpu: &Gpu, tiling: Tiling, model: &Model, camera: &Camera, near: f32) -> Whole {
    run_with(gpu, Method::from(tiling), model, camera, near)
}

fn run_with(gpu: &Gpu, method: Method, model: &Model, camera: &Camera, near: f32) -> Whole {
    let fine = "the device runs the case";
    let n = model.anchors.position.len() as u32;
    let size = camera.size;
    let pixels = (size[0] * size[1]) as usize;
    let capacity = Capacity { anchors: n.max(1), visible: n.max(1), pairs: 1 << 18 };
    let decoded = Decoded::upload(gpu, &model.anchors, &model.weights, 0).expect(fine);
    let (anchors, weights) = (&decoded.anchors, &decoded.weights.value);
    let limits = Limits::new(gpu).expect(fine);
    // Depths are sorted by their distance from the near plane.
    let method = Method { depth_key: DepthKey::new(near, method.depth_key.bits), ..method };
    let forward = Forward::new(gpu, capacity, &decoded, method, size, true).expect(fine);
    let mut picture = Picture::new(gpu, size, pixels, Outputs::Transmittance).expect(fine);
    picture.rgb = gpu.upload("rgb", &vec![[testing::UNWRITTEN; 3]; pixels]).expect(fine);
    let slots = capacity.visible as usize * K;
    let backward = Backward::new(gpu, method, slots, 1 << 18, Outputs::Transmittance).expect(fine);
    let project_backward = ProjectBackward::new(gpu, slots).expect(fine);
    let decode_backward = DecodeBackward::new(gpu, forward.decode()).expect(fine);
    let zeros = |name, len: usize| gpu.upload(name, &vec![0f32; len]).expect(fine);
    let grad_feature = zeros("grad_feature", anchors.feature().value.len());
    let grad_offset = zeros("grad_offset", anchors.offset().value.len());
    let grad_scaling = zeros("grad_log_scaling", anchors.log_scaling().value.len());
    let grad_weights = zeros("grad_weights", weights.len());
    let mut rng = Pcg64Mcg::seed_from_u64(77);
    let mut random = || (0..pixels).map(|_| rng.random_range(-1f32..1.0)).collect::<Vec<f32>>();
    let (r, z) = (random(), random());
    let grad_rgb: Vec<[f32; 3]> = r.iter().map(|&r| [r, -r, 0.5]).collect();
    let grad_rgb = gpu.upload("grad_rgb", &grad_rgb).expect(fine);
    let grad_z = gpu.upload("grad_depth_map", &z).expect(fine);

    let mut rec = gpu.recorder().expect(fine);
    forward.visible().record(&mut rec, anchors, camera, near, &limits);
    let offset = anchors.offset().value.view();
    let of = decode::Anchors {
        position: &anchors.position,
        feature: &anchors.feature().value,
        offset: &offset,
        log_scaling: &anchors.log_scaling().value,
        weights,
        visible: &forward.visible().list,
    };
    forward.decode().record(&mut rec, of, &forward.visible().count, camera.center());
    // What does not exist is not written: absent.
    rec.zero(&forward.project.mean);
    rec.zero(&forward.project.covariance);
    rec.zero(&forward.project.depth);
    forward.project.record(&mut rec, &forward.decode().existing, forward.gaussians(), camera, near);
    let binned = forward.bin.record(&mut rec, forward.projected(), size, &limits);
    rasterize::forward(&mut rec, method, forward.projected(), binned, BACKGROUND, &picture);
    let gradient = PictureGradient { rgb: &grad_rgb, depth: Some(&grad_z), transmittance: None };
    backward.record(&mut rec, method, forward.projected(), binned, &picture, gradient);
    let splats = SplatGradients {
        mean: &backward.grad_mean,
        covariance: &backward.grad_covariance,
        depth: backward.grad_depth.as_ref(),
    };
    project_backward.record(&mut rec, binned.drawn, forward.gaussians(), splats, camera, near);
    let gaussians = GaussianGradients {
        drawn: binned.tiles,
        position: &project_backward.grad_position,
        opacity: &backward.grad_opacity,
        color: &backward.grad_color,
        scale: &project_backward.grad_scale,
        rotation: &project_backward.grad_rotation,
    };
    let to_offset = grad_offset.view();
    let to = AnchorGradients {
        feature: &grad_feature,
        offset: &to_offset,
        log_scaling: &grad_scaling,
        weights: &grad_weights,
    };
    decode_backward.record(&mut rec, forward.decode(), of, gaussians, to);
    rec.submit().expect(fine).wait().expect(fine);
    let counters = gpu.read(limits.counters()).expect(fine);
    assert_eq!(gpu.read(limits.overflow()).expect(fine), [0], "{counters:?}");
    let visible = counters[Counter::Visible as usize];
    let slots = visible as usize * K;
    let (depth, transmittance) = picture.depth.as_ref().zip(picture.transmittance.as_ref()).expect("asked for");
    let read = |b| gpu.read(b).expect(fine);
    Whole {
        visible,
        splats: Splats {
            mean: gpu.read_range(&forward.project.mean, slots).expect(fine),
            covariance: gpu.read_range(&forward.project.covariance, slots).expect(fine),
            depth: gpu.read_range(&forward.project.depth, slots).expect(fine),
            opacity: gpu.read_range(&forward.decode().opacity, slots).expect(fine),
            color: gpu.read_range(&forward.decode().color, slots).expect(fine),
        },
        rgb: gpu.read(&picture.rgb).expect(fine),
        depth: read(depth),
        transmittance: read(transmittance),
        gradients: [read(&grad_feature), read(&grad_offset), read(&grad_scaling), read(&grad_weights)],
    }
}

/// The picture against the float64 blending of the projected Gaussians.
fn assert_blended(got: &Whole, size: [u32; 2], what: &str) {
    got.assert_finite(what);
    let want = screen::exact(size, &got.splats);
    screen::assert_pixels(&got.rgb, &got.depth, &got.transmittance, &want, &got.splats, what);
}

fn moved(gpu: &Gpu) {
    let size = [96, 64];
    let at_origin = model(1, 400, 1.5);
    let mut away = at_origin.clone();
    let by = [1e6f32, -1e6, 1e6];
    for p in &mut away.anchors.position {
        *p = std::array::from_fn(|i| p[i] + by[i]);
    }
    let here = camera(size);
    let center = here.center();
    let there = Camera {
        translation: Camera::translation_to(&here.rotation, std::array::from_fn(|i| center[i] + f64::from(by[i]))),
        ..here
    };
    for &tiling in screen::tilings(gpu) {
        let (a, b) = (run(gpu, tiling, &at_origin, &here, NEAR), run(gpu, tiling, &away, &there, NEAR));
        assert!(a.transmittance.iter().filter(|t| **t < 0.5).count() > 500, "the case tests too little");
        assert_eq!(a.visible, b.visible);
        assert!(a.splats.mean == b.splats.mean, "means");
        assert!(a.splats.covariance == b.splats.covariance, "covariances");
        assert!((a.rgb, a.depth, a.transmittance) == (b.rgb, b.depth, b.transmittance), "pictures");
        assert!(a.gradients == b.gradients, "gradients");
    }
}

/// A camera that stands between the numbers float32 has so far out: half a grid step to the side would be many pixels.
fn between(gpu: &Gpu) {
    let size = [96, 64];
    let at_origin = model(1, 400, 1.5);
    let mut away = at_origin.clone();
    let by = [1e6f32, -1e6, 1e6];
    for p in &mut away.anchors.position {
        *p = std::array::from_fn(|i| p[i] + by[i]);
    }
    let camera = camera(size);
    let at = |center: [f64; 3]| Camera { translation: Camera::translation_to(&camera.rotation, center), ..camera };
    let center = [0.2617, -0.1239, -3.0311];
    let (here, there) = (at(center), at(std::array::from_fn(|i| center[i] + f64::from(by[i]))));
    for &tiling in screen::tilings(gpu) {
        let (a, b) = (run(gpu, tiling, &at_origin, &here, NEAR), run(gpu, tiling, &away, &there, NEAR));
        assert_eq!(a.visible, b.visible);
        let mut present = 0;
        for s in 0..a.splats.mean.len() {
            if a.splats.depth[s] == 0.0 {
                continue;
            }
            present += 1;
            // Positions are good to 3 u |p - c| each, and to float64's 2^-53 1e6; x / z, the lens and the sum with the
            // principal point to 40 u of 92 px and of the mean, for rays of |p - c| < 2 z.
            let (ma, mb) = (a.splats.mean[s].map(f64::from), b.splats.mean[s].map(f64::from));
            let shift = (ma[0] - mb[0]).hypot(ma[1] - mb[1]);
            let limit = 2.0 * 92.0 * 2.0 * 6.0 * U + 4.0 * U * (ma[0].abs() + ma[1].abs()) + 92.0 * 2.0 * 80.0 * U;
            assert!(shift <= limit, "slot {s} is {shift:e} px away, beyond {limit:e}");
        }
        assert!(present > 500, "{present} present: the case tests too little");
        assert_blended(&b, size, &format!("{tiling:?}"));
    }
}

fn scaled(gpu: &Gpu) {
    let size = [96, 64];
    let unit = model(2, 400, 1.5);
    let here = camera(size);
    for factor in [1e-4f32, 1e4] {
        let mut other = unit.clone();
        for (p, l) in other.anchors.position.iter_mut().zip(&mut other.anchors.log_scaling) {
            *p = p.map(|v| v * factor);
            *l = l.map(|v| v + factor.ln());
        }
        let there = Camera { translation: here.translation.map(|t| t * f64::from(factor)), ..here };
        for &tiling in screen::tilings(gpu) {
            let (a, b) = (run(gpu, tiling, &unit, &here, NEAR), run(gpu, tiling, &other, &there, NEAR * factor));
            assert_eq!(a.visible, b.visible);
            a.assert_finite("times 1");
            b.assert_finite(&format!("times {factor}"));
            // Log-scales up to 13: rounded to 2^-21, and the exponential 3 + 2 * 13 units in the last place off, so that
            // scales agree to 2^-18 and positions, of offsets below 0.2, to that of their offset and some roundings:
            // 92 px / 2 times 2^-20 and 40 u each. No axis here is longer than five times another.
            let close = 5.0 * 4.0 * (8.0 * U + 60.0 * U) + 512.0 * U * 6.0;
            for s in 0..a.splats.mean.len() {
                let ([ma, mb], [ca, cb]) = (
                    [a.splats.mean[s], b.splats.mean[s]].map(|v| v.map(f64::from)),
                    [a.splats.covariance[s], b.splats.covariance[s]].map(|v| v.map(f64::from)),
                );
                let shift = (ma[0] - mb[0]).hypot(ma[1] - mb[1]);
                assert!(shift <= 46.0 * 0.2 * 68.0 * U + 92.0 * 160.0 * U, "times {factor}, slot {s}: {shift:e} px");
                if a.splats.depth[s] == 0.0 {
                    assert_eq!(b.splats.depth[s], 0.0);
                    continue;
                }
                let errors = [
                    (ca[0] - cb[0]).abs() / ca[0],
                    (ca[1] - cb[1]).abs() * (ca[2] / ca[0]).sqrt(),
                    (ca[2] - cb[2]).abs() / ca[2],
                ];
                assert!(errors.iter().all(|e| *e <= close), "times {factor}, slot {s}: {errors:?} beyond {close:e}");
            }
            let [.., wa] = &a.gradients;
            assert!(wa.iter().any(|g| *g != 0.0));
            assert_blended(&b, size, &format!("times {factor}"));
        }
    }
}

fn few(gpu: &Gpu) {
    for &tiling in screen::tilings(gpu) {
        let size = [40, 33];
        let mut behind = model(3, 50, 1.5);
        behind.anchors.position.iter_mut().for_each(|p| p[2] -= 50.0);
        for (what, model) in [("no anchors", model(3, 0, 1.0)), ("none in view", behind)] {
            let got = run(gpu, tiling, &model, &camera(size), NEAR);
            assert_eq!(got.visible, 0, "{what}");
            assert!(got.rgb.iter().all(|c| *c == BACKGROUND), "{what}");
            assert!(got.transmittance.iter().all(|t| *t == 1.0) && got.depth.iter().all(|d| *d == 0.0), "{what}");
            assert!(got.gradients.iter().flatten().all(|g| *g == 0.0), "{what}: a gradient");
        }
        let mut one = model(4, 1, 0.1);
        one.anchors.position[0] = [0.0; 3];
        let got = run(gpu, tiling, &one, &camera(size), NEAR);
        assert_eq!(got.visible, 1);
        assert!(got.transmittance.iter().any(|t| *t < 0.9), "one: the case tests too little");
        assert!(got.gradients.iter().all(|g| g.iter().any(|g| *g != 0.0)), "one: a gradient that is zero");
        assert_blended(&got, size, "one");
    }
}

fn shapes(gpu: &Gpu) {
    for &tiling in screen::tilings(gpu) {
        for (size, focal) in [([1, 1], 3.0), ([17, 3], 10.0), ([8191, 2], 6000.0)] {
            let lens = Camera { focal: [focal; 2], ..camera(size) };
            let got = run(gpu, tiling, &model(5, 60, 0.4), &lens, NEAR);
            let what = format!("{size:?}, {tiling:?}");
            assert!(got.visible > 5 && got.transmittance.iter().any(|t| *t < 0.9), "{what}: the case tests too little");
            assert_blended(&got, size, &what);
        }
    }
}

fn log_scales(gpu: &Gpu) {
    let size = [40, 33];
    for &tiling in screen::tilings(gpu) {
        let mut extreme = model(6, 300, 1.0);
        for (i, l) in extreme.anchors.log_scaling.iter_mut().enumerate() {
            let value = [40.0, -40.0, 88.0, 100.0, -100.0, 1e30, -1e30, -3.0][i % 8];
            // Of the offsets, of the Gaussians, of one axis of each, of all.
            let axes: &[usize] = [&[0, 1, 2][..], &[3, 4, 5], &[1, 3], &[0, 1, 2, 3, 4, 5]][i / 8 % 4];
            axes.iter().for_each(|&a| l[a] = value);
            if i / 32 % 2 == 0 {
                extreme.anchors.offset[3 * K * i..][..3 * K].fill(0.0);
            }
        }
        // Keys of 28 bits order depths up to 2^32 times the near plane.
        let method = Method { depth_key: DepthKey::new(NEAR, 31), ..tiling.into() };
        let got = run_with(gpu, method, &extreme, &camera(size), NEAR);
        let present = got.splats.depth.iter().filter(|d| **d > 0.0).count();
        assert!((200..2000).contains(&present), "{present} of {} present", got.splats.depth.len());
        let what = format!("{tiling:?}");
        // dL/doffset is e^l of the position's gradient: beyond 3e38 for an anchor of log-scale 88 that is seen.
        let (mut rest, mut overflowed) = (got, 0);
        for (i, g) in rest.gradients[1].iter_mut().enumerate().filter(|(_, g)| !g.is_finite()) {
            let l = extreme.anchors.log_scaling[i / (3 * K)][i % 3];
            assert!(g.is_infinite() && l >= 88.0, "{what}: gradient {g} of an offset of log-scale {l}");
            *g = 0.0;
            overflowed += 1;
        }
        assert!(overflowed > 0, "{what}: the case tests too little");
        assert_blended(&rest, size, &what);
    }
}

//! Golden cases of kind `step`: gradients of the whole step by name, then ten steps' losses. A case with `settings` is
//! trained from photographs, with culling, attention, growing and pruning; others have all arrays given, and none of these.

use gscream_vk::config::{Settings, without_removed};
use gscream_vk::gpu::{Check, Gpu, testing};
use gscream_vk::losses::{self, DepthView, NO_PRIOR, Quantity, Weights};
use gscream_vk::model::files;
use gscream_vk::model::stored::Stored;
use gscream_vk::primitives::limit::Counter;
use gscream_vk::scene::{Camera, PriorKind};
use gscream_vk::train::begin::Beginning;
use gscream_vk::train::photographs::{Photograph, PriorMap};
use gscream_vk::train::plan::{DepthLosses, Plan, Steps};
use gscream_vk::train::step::{Rates, Step};

use super::support::{Case, cases};

fn camera(case: &Case, view: usize) -> Camera {
    let at = |name: &str| case.f32(&format!("view{view}.camera.{name}"));
    let [rotation, intrinsics] = [at("R"), at("intrinsics")];
    Camera {
        rotation: std::array::from_fn(|i| std::array::from_fn(|j| rotation[3 * i + j])),
        translation: std::array::from_fn(|i| f64::from(at("t")[i])),
        focal: [intrinsics[0], intrinsics[1]],
        principal: [intrinsics[2], intrinsics[3]],
        distortion: std::array::from_fn(|i| intrinsics[4 + i]),
        size: case.size(&format!("view{view}.camera.size")),
    }
}

fn anchors(case: &Case) -> files::Anchors {
    files::Anchors::new(
        case.shape("offset")[1],
        case.vectors("anchor"),
        case.vectors("feature"),
        case.f32("offset"),
        case.vectors("log_scaling"),
    )
}

fn model(case: &Case, attention: bool, voxel: f64) -> Beginning {
    Beginning { model: Stored::Anchors(anchors(case), weights(case, attention)), voxel, rows: 0 }
}

fn weights(case: &Case, attention: bool) -> files::Weights {
    let shapes = files::weight_shapes(case.shape("offset")[1], attention).into_iter();
    let tensors = shapes.map(|(name, shape)| (name.clone(), files::Tensor { shape, data: case.f32(&name) })).collect();
    files::Weights { tensors }
}

/// Picture, depth, loss terms and all gradients of the step that was just taken.
fn compare(gpu: &Gpu, case: &Case, step: &Step, number: usize, size: [u32; 2]) {
    let picture = step.picture(size);
    // The blend of up to some hundred Gaussians whose parameters passed two networks: 1e-5 of the range.
    let check = Check { relative: 1e-4, absolute: 2e-5, band: 2e-3 };
    let rgb = gpu.read(&picture.rgb).unwrap();
    case.compare(&format!("step{number}.rgb"), rgb.as_flattened(), check);
    let z = gpu.read(picture.depth.as_ref().unwrap()).unwrap();
    case.compare(&format!("step{number}.z"), &z, check);
    let terms = gpu.read(step.terms(size)).unwrap();
    case.compare(&format!("step{number}.terms"), &terms, Check { relative: 1e-4, ..check });
    // The fit to an arbitrary prior, L1's kinks and the thresholds of alpha make single elements jump; the
    // parameters of the second step differ already by what Adam's first step makes of a gradient's sign.
    let gradients = step.gradients().unwrap();
    let prefix = format!("step{number}.grad.");
    for name in case.names().iter().filter_map(|name| name.strip_prefix(&prefix)) {
        let check = Check { relative: 1e-3, absolute: 1e-4, band: 1e-2 };
        case.compare(&format!("{prefix}{name}"), &gradients[name], check);
    }
}

#[test]
fn step() {
    testing::gpu_in_both_forms().for_each(|gpu| step_in_one_form(&gpu));
}

#[test]
fn step_from_photographs() {
    testing::gpu_in_both_forms().for_each(|gpu| {
        let all = cases("step");
        all.iter().filter(|case| case.has("settings")).for_each(|case| whole(&gpu, case));
    });
}

/// As a run takes its steps.
fn whole(gpu: &Gpu, case: &Case) {
    let settings: Settings = toml::from_str(&without_removed(&case.text("settings"))).unwrap();
    settings.validate().unwrap();
    let cameras = [camera(case, 0), camera(case, 1)];
    let size = cameras[0].size;
    assert_eq!(size, cameras[1].size);
    let photographs = [0, 1].map(|v| {
        let at = |name: &str| format!("view{v}.{name}");
        let mask: Vec<bool> = case.f32(&at("mask")).into_iter().map(|m| m != 0.0).collect();
        let byte = |m: bool| if m { 255 } else { 0 };
        let picture = case.vectors::<3>(&at("picture"));
        let words: Vec<u32> =
            picture.iter().zip(&mask).map(|(rgb, &m)| losses::pack(rgb.map(|c| c as u8), byte(m))).collect();
        let image = image::GrayImage::from_raw(size[0], size[1], mask.iter().map(|&m| byte(m)).collect()).unwrap();
        let prior = case.f32(&at("prior"));
        assert!(prior.iter().all(|&p| p > NO_PRIOR));
        Photograph {
            name: at("picture"),
            camera: cameras[v],
            reduction: 1,
            reference: v == 0,
            picture: gpu.upload("picture", &words).unwrap(),
            prior: Some(PriorMap {
                kind: PriorKind::Depth,
                values: gpu.upload("prior", &prior).unwrap(),
                gaps: false,
                fit: None,
            }),
            mask_box: gscream_vk::train::photographs::mask_box(&image),
        }
    });
    let rounds = &settings.densify;
    let both = DepthLosses { l1: true, gradient: true };
    let plan = Plan {
        masks: true,
        depth: true,
        depth_gradient: true,
        reference_depth: both,
        other_depth: both,
        attention: true,
        growth: true,
        rounds: Some(Steps { first: rounds.from, last: rounds.until }),
        counted: Some(Steps { first: rounds.statistics_from, last: rounds.until }),
        cull: true,
        references: vec![0],
        sizes: vec![size],
        ..Plan::default()
    };
    let voxel = case.f64("voxel")[0];
    let mut step = Step::new(gpu, plan, &settings, &model(case, true, voxel)).unwrap();
    let mut losses = vec![];
    for number in 1..=case.shape("losses")[0] {
        let photograph = &photographs[(number - 1) % 2];
        step.prepare(number as u32).unwrap();
        let rates = Rates::at(&settings, 1.0, number as u32);
        let mut rec = gpu.recorder().unwrap();
        step.record(&mut rec, photograph, number as u32, rates);
        rec.submit().unwrap().wait().unwrap();
        assert_eq!(gpu.read(step.limits.overflow()).unwrap(), [0], "the first guess of the capacity is too small");
        let visible = gpu.read(step.limits.counters()).unwrap()[Counter::Visible as usize];
        assert_eq!(f64::from(visible), case.f64(&format!("step{number}.visible"))[0], "anchors in view, step {number}");
        losses.push(gpu.read(step.terms(size)).unwrap().iter().sum::<f32>());
        if case.has(&format!("step{number}.rgb")) {
            compare(gpu, case, &step, number, size);
        }
        if step.changes_anchors(number as u32) {
            let before = step.anchors().count;
            step.change_anchors(number as u32).unwrap();
            let (now, _) = step.model().unwrap();
            let [grown, gone] = case.f64(&format!("round{number}.counts"))[..] else { panic!("grown and gone") };
            assert_eq!(f64::from(step.anchors().count), f64::from(before) + grown - gone, "{grown} grown, {gone} gone");
            // Where they stand is decided, not computed; features and scales are what Adam's steps have made of them.
            let exact = Check { relative: 1e-6, absolute: 1e-6, band: 0.0 };
            case.compare(&format!("round{number}.anchor"), now.position.as_flattened(), exact);
            let trained = Check { relative: 1e-4, absolute: 1e-4, band: 1e-2 };
            case.compare(&format!("round{number}.feature"), now.feature.as_flattened(), trained);
            case.compare(&format!("round{number}.log_scaling"), now.log_scaling.as_flattened(), trained);
        }
    }
    // As below.
    case.compare("losses", &losses, Check { relative: 1e-4, absolute: 0.0, band: 0.0 });
}

fn step_in_one_form(gpu: &Gpu) {
    let mut all = cases("step");
    all.retain(|case| !case.has("settings"));
    // All anchors are in view: that each is looked at changes nothing.
    for (case, cull) in all.iter().flat_map(|case| [(case, false), (case, true)]) {
        let n = case.shape("anchor")[0];
        let cameras = [camera(case, 0), camera(case, 1)];
        let mut settings = Settings::default();
        settings.train.iterations = 30_000;
        settings.render.cull = cull;
        settings.losses.ssim_across_masks = true;
        let plan = Plan {
            masks: true,
            depth: true,
            depth_gradient: true,
            cull,
            references: vec![0],
            sizes: vec![cameras[0].size],
            ..Plan::default()
        };
        let size = cameras[0].size;
        assert_eq!(size, cameras[1].size);
        let step = Step::new(gpu, plan, &settings, &model(case, false, 0.1)).unwrap();
        let priors = [0, 1].map(|v| gpu.upload("prior", &case.f32(&format!("view{v}.prior"))).unwrap());
        let count = case.shape("losses")[0];
        let mut losses = vec![];
        for number in 1..=count {
            let view = (number - 1) % 2;
            let reference = view == 0;
            let mask = case.f32(&format!("view{view}.mask"));
            let frame = step.losses(size).frame();
            let map = |outside: f32, inside: f32| -> Vec<f32> {
                mask.iter().map(|&m| if m == 0.0 { outside } else { inside }).collect()
            };
            gpu.write(frame.target(), &case.vectors::<3>(&format!("view{view}.target"))).unwrap();
            gpu.write(frame.weight().unwrap(), &map(1.0, if reference { 20.0 } else { 0.0 })).unwrap();
            gpu.write(frame.valid().unwrap(), &map(1.0, 0.0)).unwrap();
            let depth_weight = if reference { map(1.0, 100.0) } else { map(0.1, 0.0) };
            gpu.write(frame.depth_weight().unwrap(), &depth_weight).unwrap();
            let depth = DepthView {
                fit: None,
                prior: &priors[view],
                quantity: Quantity::Depth,
                weights: Weights { outside: 0.0, inside: 0.0 },
                gradient: if reference { 0.5 } else { 0.05 },
                gradient_inside: reference,
                gaps: false,
            };
            let rates = Rates::at(&settings, 1.0, number as u32);
            let mut rec = gpu.recorder().unwrap();
            step.record_prepared(&mut rec, &cameras[view], Some(depth), number as u32, rates);
            rec.submit().unwrap().wait().unwrap();
            if gpu.read(step.limits.overflow()).unwrap() != [0] {
                panic!("the first guess of the capacity is too small for {n} anchors");
            }
            let visible = gpu.read(step.limits.counters()).unwrap()[Counter::Visible as usize];
            assert_eq!(visible as usize, n, "anchors in view");
            losses.push(gpu.read(step.terms(size)).unwrap().iter().sum::<f32>());
            if number <= 2 {
                compare(gpu, case, &step, number, size);
            }
        }
        // Adam divides by the gradient's own size: where a gradient is near zero its sign is rounding, and parameters
        // drift apart by up to the learning rate per step; over ten steps that moves the loss by less than 0.01 %.
        case.compare("losses", &losses, Check { relative: 1e-4, absolute: 0.0, band: 0.0 });
    }
}

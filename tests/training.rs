//! Whole runs: the same bytes again, room that is made, agreement with the reference path, a falling loss, real captures.

use std::path::PathBuf;

use crate::common;
use crate::common::Watch;
use crate::common::skip::{Lack, skip};
use gscream_vk::config::Settings;
use gscream_vk::gpu::form::without_form;
use gscream_vk::gpu::{Descriptors, Form, Gpu, Options, testing};
use gscream_vk::model::files;
use gscream_vk::model::stored::Stored;
use gscream_vk::render::forward::Capacity;
use gscream_vk::render::view::Renderer;
use gscream_vk::scene::{self, Scene, synthetic};
use gscream_vk::signal::Signal;
use gscream_vk::train::begin::Beginning;
use gscream_vk::train::config::Coarse;
use gscream_vk::train::run::{Observer, Progress, Run, Summary};
use gscream_vk::train::{checkpoint, forecast};

/// What a run ends with.
struct Trained {
    watch: Watch,
    summary: Summary,
    model: (files::Anchors, files::Weights),
    /// The run folder's log and model, by name.
    files: Vec<(String, Vec<u8>)>,
}

impl Trained {
    /// Every loss of every step, bit by bit, and the counts behind it.
    fn figures(&self) -> Vec<(u32, String, Vec<u32>, [u32; 4])> {
        let figures = |p: &gscream_vk::train::run::Progress| {
            let losses = p.losses.iter().map(|(_, loss)| loss.to_bits()).collect();
            (p.step, p.view.clone(), losses, [p.anchors, p.visible, p.gaussians, p.pairs])
        };
        self.watch.steps.iter().map(figures).collect()
    }

    /// Panics where the two differ in any bit.
    fn assert_same(&self, other: &Self, what: &str) {
        for (a, b) in self.figures().into_iter().zip(other.figures()) {
            assert_eq!(a, b, "{what}");
        }
        assert_eq!(self.watch.steps.len(), other.watch.steps.len(), "{what}");
        assert_eq!(self.watch.lines, other.watch.lines, "{what}");
        assert!(self.model == other.model, "{what}: the models differ");
        assert!(self.files == other.files, "{what}: the models' files differ");
    }
}

fn train(gpu: &Gpu, scene: &Scene, settings: &Settings, capacity: Option<Capacity>) -> Trained {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut run = Run::new(gpu, scene, settings).expect("the device has room");
    if let Some(capacity) = capacity {
        run.resize(Capacity { anchors: run.step().learnt.capacity(), ..capacity }).expect("the device has room");
    }
    let mut watch = Watch::default();
    let summary = run.train(folder.path(), &mut watch).expect("a run");
    let read = |name: &str| {
        (name.to_owned(), std::fs::read(folder.path().join("model").join(name)).expect("the run wrote it"))
    };
    let files = [files::POINT_CLOUD, files::WEIGHTS].map(read).to_vec();
    Trained { watch, summary, model: run.step().model().expect("readable"), files }
}

/// Growth, pruning, statistics and attention all happen within these steps.
fn scene_without_tests() -> Scene {
    let mut scene = common::tiny();
    scene.test.clear();
    scene
}

#[test]
#[ignore = "long; .ci/run has it"]
fn the_same_seed_gives_the_same_bytes() {
    testing::gpu_in_both_forms().for_each(|gpu| the_same_seed_gives_the_same_bytes_in_one_form(&gpu));
}

fn the_same_seed_gives_the_same_bytes_in_one_form(gpu: &Gpu) {
    let scene = scene_without_tests();
    let mut settings = common::settings(13);
    settings.train.view_order = gscream_vk::train::config::ViewOrder::Shuffled;
    let first = train(gpu, &scene, &settings, None);
    assert!(first.watch.lines.len() == 5, "five changes of the anchors: {:?}", first.watch.lines);
    assert!(first.watch.lines.iter().any(|line| !line.contains(": 0 new")), "{:?}", first.watch.lines);
    let initial = first.watch.steps[0].anchors;
    assert_ne!(first.summary.anchors, initial, "anchors came and went");
    first.assert_same(&train(gpu, &scene, &settings, None), "once more");
    settings.train.seed = 1;
    let other = train(gpu, &scene, &settings, None);
    assert!(other.model != first.model && other.figures() != first.figures(), "another seed");
}

#[test]
fn pushed_or_as_sets_the_buffers_are_the_same() {
    if !testing::gpu().info().push_descriptors {
        skip(Lack::PushDescriptors, "this device has sets alone");
        return;
    }
    let (scene, settings) = (scene_without_tests(), common::settings(13));
    let of = |descriptors| {
        let gpu = testing::gpu_with(Options { descriptors, ..Options::default() });
        train(&gpu, &scene, &settings, None)
    };
    of(Descriptors::Sets).assert_same(&of(Descriptors::Push), "sets in the place of pushing");
}

/// GPUs hand out memory with what was in it; lavapipe's is zero.
#[test]
fn nothing_is_read_that_nobody_wrote() {
    let (scene, settings) = (scene_without_tests(), common::settings(13));
    for form in Form::ALL {
        let of = |poison| {
            let gpu = testing::gpu_with(Options { form: Some(form), poison, ..Options::default() });
            let buffer = gpu.buffer::<u32>("probe", 5).expect("room");
            let new = gpu.read(&buffer).expect("readable");
            assert_eq!(new == [0x7fa5_a5a5; 5], poison, "{new:x?}");
            train(&gpu, &scene, &settings, None)
        };
        of(true).assert_same(&of(false), "on poisoned memory");
    }
}

#[test]
#[ignore = "long; .ci/run has it"]
fn steps_that_overflow_are_taken_again() {
    testing::gpu_in_both_forms().for_each(|gpu| steps_that_overflow_are_taken_again_in_one_form(&gpu));
}

fn steps_that_overflow_are_taken_again_in_one_form(gpu: &Gpu) {
    let scene = scene_without_tests();
    for write_back in [false, true] {
        let mut settings = common::settings(13);
        settings.model.attention.write_back = write_back;
        let ample = train(gpu, &scene, &settings, Some(Capacity { anchors: 0, visible: 4096, pairs: 1 << 18 }));
        assert_eq!(ample.summary.repeated, 0, "there was room");
        let pairs = ample.watch.steps.iter().map(|p| p.pairs).max().expect("steps");
        // Anchors grow behind the fourth step, and the room for visible ones with them.
        let visible = ample.watch.steps[..4].iter().map(|p| p.visible).max().expect("steps");
        for (what, capacity) in [
            ("no room at all", Capacity { anchors: 0, visible: 1, pairs: 1 }),
            ("too few anchors", Capacity { anchors: 0, visible: visible - 1, pairs: 1 << 18 }),
            // Falls short in a late step, with attention and statistics under way.
            ("too few pairs", Capacity { anchors: 0, visible: 4096, pairs: pairs - 1 }),
        ] {
            let tight = train(gpu, &scene, &settings, Some(capacity));
            assert!(tight.summary.repeated > 0, "{what}: it fitted");
            tight.assert_same(&ample, &format!("{what}, write_back {write_back}"));
        }
    }
}

/// Steps on reduced pictures are, to the byte, those of a scene read at that size; behind them nothing of it is left.
#[test]
fn smaller_pictures_come_first() {
    let gpu = testing::gpu();
    let folder = common::folder();
    let scene = |downscale| {
        let mut scene = common::load(&folder, &scene::Config { downscale, ..Default::default() });
        scene.test.clear();
        scene
    };
    let (full, half) = (scene(1), scene(2));
    let mut settings = common::settings(13);
    settings.scene.check_priors = false; // the points fall on other pixels of a prior of another size
    settings.model.attention.patch = 12;
    let small = train(&gpu, &half, &settings, None);
    settings.model.attention.patch = 24;
    settings.train.coarse = Coarse { until: 13 };
    train(&gpu, &full, &settings, None).assert_same(&small, "a scene at half its size");

    // The change comes between two steps that would otherwise be in flight together.
    settings.train.coarse.until = 7;
    let mixed = train(&gpu, &full, &settings, None);
    let (mixed_figures, small_figures) = (mixed.figures(), small.figures());
    assert_eq!(mixed_figures[..7], small_figures[..7], "before the change");
    for (mixed, small) in std::iter::zip(&mixed_figures, &small_figures).skip(7) {
        assert_ne!(mixed.2, small.2, "step {} sees other pictures", mixed.0);
    }
    train(&gpu, &full, &settings, None).assert_same(&mixed, "once more");

    let after_two_steps = |until| {
        let settings = Settings {
            train: gscream_vk::train::Config { coarse: Coarse { until }, ..settings.train.clone() },
            ..settings.clone()
        };
        let mut run = Run::new(&gpu, &full, &settings).expect("the device has room");
        let at_first = (gpu.memory().0, run.step().plan.sizes.clone());
        run.run_one(1).expect("a step");
        run.run_one(2).expect("a step");
        (at_first, (gpu.memory().0, run.step().plan.sizes.clone()))
    };
    let (at_once, coarse) = (after_two_steps(0), after_two_steps(1));
    assert_eq!(coarse.0.1, [[24, 18]]);
    assert!(coarse.0.0 < at_once.0.0, "smaller pictures take less memory");
    assert_eq!(coarse.1, at_once.1, "bytes and sizes behind the change");
}

#[test]
fn every_pass_agrees_with_its_reference() {
    testing::gpu_in_both_forms().for_each(|gpu| every_pass_agrees_with_its_reference_in_one_form(&gpu));
}

fn every_pass_agrees_with_its_reference_in_one_form(gpu: &Gpu) {
    let scene = common::tiny();
    let settings = common::settings(20);
    let mut run = Run::new(gpu, &scene, &settings).expect("the device has room");
    let mut failed = vec![];
    for step in 1..=6 {
        // 1: nothing optional; 4: the reference view; 5: another view, both with statistics and attention.
        if ![1, 4, 5].contains(&step) {
            run.run_one(step).expect("a step");
            continue;
        }
        let mut rec = gpu.checked().expect("a recorder");
        run.record(&mut rec, step).expect("the device has room");
        let submission = rec.submit().expect("the device runs it");
        let differences = submission.differences.clone();
        submission.wait().expect("the device runs it");
        let compared = |pass: &str| differences.iter().any(|d| without_form(&d.pass).starts_with(pass));
        assert!(differences.len() > 50, "{} tensors", differences.len());
        for pass in ["render/cull", "render/decode", "render/rasterize", "losses/depth_gradient", "optimizer/adam"] {
            assert!(compared(pass), "step {step}: {pass} was not compared");
        }
        for pass in ["model/attention_forward", "model/attention_weight_backward", "densify/statistics"] {
            assert_eq!(compared(pass), step >= 4, "step {step}: {pass}");
        }
        failed.extend(differences.iter().filter(|d| !d.ok()).map(|d| format!("step {step}: {d}")));
    }
    assert!(failed.is_empty(), "beyond their bounds:\n{}", failed.join("\n"));
}

/// The mean over a round of views: every view has losses of its own size.
fn mean_loss(watch: &Watch, steps: std::ops::Range<usize>) -> f64 {
    watch.steps[steps.clone()].iter().map(|p| f64::from(p.loss)).sum::<f64>() / steps.len() as f64
}

#[test]
fn training_learns_and_what_it_saves_draws_the_same_picture() {
    testing::gpu_in_both_forms()
        .for_each(|gpu| training_learns_and_what_it_saves_draws_the_same_picture_in_one_form(&gpu));
}

fn training_learns_and_what_it_saves_draws_the_same_picture_in_one_form(gpu: &Gpu) {
    let scene = common::tiny();
    let settings = common::settings(60);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut run = Run::new(gpu, &scene, &settings).expect("the device has room");
    let psnr = |run: &mut Run<'_>| {
        let report = run.evaluate(|_, _| ()).expect("an evaluation").expect("there are test views");
        report.mean.expect("means").metrics.full.psnr
    };
    let untrained = psnr(&mut run);
    let mut watch = Watch::default();
    let summary = run.train(folder.path(), &mut watch).expect("a run");
    let (before, after) = (mean_loss(&watch, 0..6), mean_loss(&watch, 54..60));
    assert!(after < 0.5 * before, "the loss went from {before} to {after}");
    let trained = psnr(&mut run);
    assert!(trained > untrained + 3.0, "PSNR of the test views went from {untrained} to {trained} dB");
    let reported = summary.report.and_then(|r| r.mean).expect("figures at the end").metrics.full.psnr;
    assert_eq!(reported, trained, "the summary is of the model at the end");

    let log = std::fs::read_to_string(folder.path().join("log.jsonl")).expect("a log");
    let lines: Vec<serde_json::Value> =
        log.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect();
    assert_eq!(lines.iter().map(|l| l["step"].as_u64()).collect::<Vec<_>>(), [10, 20, 30, 40, 50, 60].map(Some));
    let means: f64 = lines.iter().map(|l| l["mean_loss"].as_f64().expect("a number")).sum::<f64>() / 6.0;
    let all = mean_loss(&watch, 0..60);
    assert!((means - all).abs() < 1e-9 * all, "the lines cover every step once: {means}, {all}");
    // The reader of JSON rounds to a neighbour at times.
    let logged = lines[5]["psnr"].as_f64().expect("a number");
    assert!((logged - trained).abs() < 1e-12 * trained, "{logged} in the log, {trained}");

    let memory = run.step().stored().expect("readable");
    let file = Stored::load(&folder.path().join("model")).expect("a model that was just written");
    assert!(memory == file, "what was saved is what was trained");
    let pictures = |model: &Stored| {
        let mut renderer = Renderer::of(gpu, model, &settings.render).expect("the device has room");
        let views = scene.test.iter().chain(&scene.train);
        views.map(|view| renderer.render(&view.camera).expect("a picture")).collect::<Vec<_>>()
    };
    let (saved, kept) = (pictures(&file), pictures(&memory));
    for (saved, kept) in saved.iter().zip(&kept) {
        let bits = |rgb: &[[f32; 3]]| rgb.as_flattened().iter().map(|v| v.to_bits()).collect::<Vec<u32>>();
        assert_eq!(bits(&saved.rgb), bits(&kept.rgb));
        assert!(saved == kept);
        assert!(saved.rgb.as_flattened().iter().any(|&v| v > 0.1), "the picture is not black");
    }
}

/// Inside the mask the reference counts, by its weight, and no other view does.
#[test]
fn what_is_inside_the_mask_counts_on_the_reference_alone() {
    let gpu = testing::gpu();
    let scene = scene_without_tests();
    let [reference] = scene.references.as_slice() else { panic!("one reference") };
    assert_eq!(reference.view, 3, "it is seen in step 4");
    let losses = |scene: &Scene| -> Vec<u32> {
        let settings = common::settings(6);
        train(&gpu, scene, &settings, None).watch.steps.iter().map(|p| p.loss.to_bits()).collect()
    };
    let inverted = |picture: &mut image::RgbImage, mask: &image::GrayImage| {
        let inside = picture.pixels_mut().zip(mask.pixels()).filter(|(_, m)| m.0[0] != 0);
        inside.for_each(|(p, _)| p.0 = p.0.map(|v| 255 - v));
    };
    let mut others = scene.clone();
    for (i, view) in others.train.iter_mut().enumerate().filter(|(i, _)| *i != 3) {
        let mask = view.mask.as_ref().unwrap_or_else(|| panic!("view {i} has a mask"));
        assert!(mask.pixels().any(|m| m.0[0] != 0), "view {i} shows the object");
        inverted(&mut view.image, mask);
    }
    assert_eq!(losses(&others), losses(&scene), "other views are compared inside their masks");
    let mut painted = scene.clone();
    inverted(&mut painted.references[0].image, scene.train[3].mask.as_ref().expect("a mask"));
    let (weighed, weighed_painted) = (losses(&scene), losses(&painted));
    assert_eq!(weighed[..3], weighed_painted[..3]);
    assert_ne!(weighed[3], weighed_painted[3], "the reference is not compared inside its hole");
}

/// The weights of the depth losses, one by one: what is twice as large, to the bit, and what stays.
#[test]
fn depth_weighs_on_each_view_what_its_settings_say() {
    type Change = fn(&mut gscream_vk::losses::config::Depth);
    let gpu = testing::gpu();
    let scene = scene_without_tests();
    let reference = scene.references[0].view;
    assert_eq!(reference, 3, "it is seen in step 4");
    let losses = |scene: &Scene, change: Change| -> Vec<[f32; 2]> {
        let mut settings = common::settings(4);
        // Powers of two make doubling exact.
        let depth = &mut settings.losses.depth;
        (depth.other_weight, depth.gradient.weight) = (0.125, 0.5);
        change(depth);
        let named = |p: &gscream_vk::train::run::Progress, wanted: &str| {
            p.losses.iter().find(|(name, _)| *name == wanted).expect("a depth loss").1
        };
        let steps = train(&gpu, scene, &settings, None).watch.steps;
        steps.iter().map(|p| ["depth_l1", "depth_gradient"].map(|name| named(p, name))).collect()
    };
    let plain = losses(&scene, |_| {});
    assert!(plain.iter().flatten().all(|loss| *loss > 0.0), "{plain:?}");
    // The first step, on another view, has the same model in all runs; so has the fourth where no other view's weight
    // was changed.
    let [first, fourth] = [plain[0], plain[3]];
    let twice = losses(&scene, |d| d.other_weight *= 2.0);
    assert_eq!(twice[0], first.map(|loss| 2.0 * loss), "the other views' losses");
    let twice = losses(&scene, |d| d.gradient.weight *= 2.0);
    assert_eq!(twice[0], [first[0], 2.0 * first[1]], "the other views' gradient");
    let mut alone = scene.clone();
    alone.train.iter_mut().for_each(|view| view.prior = None);
    let [once, twice] = [|_: &mut _| {}, |d: &mut gscream_vk::losses::config::Depth| d.gradient.weight *= 2.0]
        .map(|change| losses(&alone, change)[3]);
    assert_eq!(twice, [once[0], 2.0 * once[1]], "the reference's gradient");

    // A prior whose values inside the mask have changed places has the same range.
    let shuffled = |prior: &mut Option<scene::Prior>, mask: &image::GrayImage| {
        let values = &mut prior.as_mut().expect("a prior").values;
        let inside: Vec<usize> = (0..values.len()).filter(|&i| mask.as_raw()[i] != 0).collect();
        let mut kept: Vec<f32> = inside.iter().map(|&i| values[i]).collect();
        kept.rotate_left(inside.len() / 2);
        inside.into_iter().zip(kept).for_each(|(i, value)| values[i] = value);
    };
    let mut others = scene.clone();
    for (_, view) in others.train.iter_mut().enumerate().filter(|(i, _)| *i != reference) {
        shuffled(&mut view.prior, view.mask.as_ref().expect("a mask"));
    }
    assert!(others.train[0].prior != scene.train[0].prior);
    assert_eq!(losses(&others, |_| {}), plain, "other views' depth is compared inside their masks");
    let mut hole = scene.clone();
    shuffled(&mut hole.references[0].prior, scene.train[reference].mask.as_ref().expect("a mask"));
    let changed = losses(&hole, |_| {});
    assert_eq!(changed[..3], plain[..3]);
    assert!(changed[3][0] != fourth[0] && changed[3][1] != fourth[1], "the reference's hole has no depth: {changed:?}");
}

/// PSNR of the test views, whole and masked, of a short run on the tiny scene with its lengths and its priors in other
/// units.
fn figures_in_units(
    gpu: &Gpu,
    folder: &tempfile::TempDir,
    config: &scene::Config,
    lengths: f64,
    priors: f64,
    grows: bool,
) -> [f64; 2] {
    let mut scene = common::load(folder, &scene::Config::default());
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        view.camera.translation = view.camera.translation.map(|t| t * lengths);
    }
    for point in &mut scene.points {
        point.position = point.position.map(|x| (f64::from(x) * lengths) as f32);
    }
    scene.radius = (f64::from(scene.radius) * lengths) as f32;
    let of_views = scene.train.iter_mut().filter_map(|v| v.prior.as_mut());
    for prior in of_views.chain(scene.references.iter_mut().filter_map(|r| r.prior.as_mut())) {
        prior.values.iter_mut().for_each(|p| *p = (f64::from(*p) * priors) as f32);
    }
    scene::condition(&mut scene, config);
    let mut settings = common::settings(48);
    settings.model.voxel_factor = 2.0;
    settings.densify.enabled = grows;
    let report = train(gpu, &scene, &settings, None).summary.report.expect("there are test views");
    let metrics = report.mean.expect("means").metrics;
    [metrics.full.psnr, metrics.mask.expect("test masks").psnr]
}

/// Millimetres or miles, of the scene or of its depth priors: the same pictures.
#[test]
fn the_units_of_the_scene_and_of_its_priors_change_nothing() {
    let gpu = testing::gpu();
    let folder = common::folder();
    let config = scene::Config::default();
    let figures = |lengths, priors| figures_in_units(&gpu, &folder, &config, lengths, priors, true);
    let [full, masked] = figures(1.0, 1.0);
    // Powers of two round nothing: not a bit may differ.
    for (lengths, priors) in
        [(1.0 / 128.0, 1.0), (1024.0, 1.0), (1.0, 2f64.powi(-20)), (1.0, 2f64.powi(20)), (64.0, 64.0)]
    {
        assert_eq!(figures(lengths, priors), [full, masked], "lengths x {lengths}, priors x {priors}");
    }
    // Others round the input. Where anchors grow a rounding makes as much of a difference as another seed, for a slot at its
    // threshold grows or does not: without growing, roundings stay roundings.
    let figures = |lengths, priors| figures_in_units(&gpu, &folder, &config, lengths, priors, false);
    let [full, _] = figures(1.0, 1.0);
    for (lengths, priors) in [(1e-2, 1.0), (1e3, 1.0), (1.0, 1e-6), (1.0, 1e3), (1.0, 1e6)] {
        let [f, _] = figures(lengths, priors);
        assert!((f - full).abs() < 0.1, "lengths x {lengths:e}, priors x {priors:e}: {f} dB instead of {full} dB");
    }
    // Where lengths are taken as they are, the same test fails.
    let fixed = scene::Config { unit: 1.0, ..config.clone() };
    let [f, _] = figures_in_units(&gpu, &folder, &fixed, 1e3, 1.0, false);
    assert!((f - full).abs() > 1.0, "{f} dB in fixed units, {full} dB");
}

/// A real capture, or nothing and a line that says so.
fn capture(name: &str, config: &scene::Config) -> Option<Scene> {
    let data = std::env::var_os("GSCREAM_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = data.join(name);
    if !folder.is_dir() {
        skip(Lack::Captures, &format!("no {} (GSCREAM_DATA names the folder of the captures)", folder.display()));
        return None;
    }
    Some(scene::load(&folder, config).expect("a readable capture"))
}

/// Three steps, with statistics and what else the capture has a use for.
fn three_steps(scene: &Scene, voxel_factor: f64) -> gscream_vk::train::plan::Plan {
    let gpu = testing::gpu();
    let mut settings = common::settings(3);
    settings.model.voxel_factor = voxel_factor;
    settings.model.attention.start = 1;
    settings.model.attention.patch = 64;
    (settings.densify.statistics_from, settings.densify.from, settings.densify.every) = (1, 2, 1);
    settings.densify.max_log_scaling = f64::INFINITY;
    let mut scene = scene.clone();
    scene.test.clear();
    let trained = train(&gpu, &scene, &settings, None);
    assert_eq!(trained.watch.steps.len(), 3);
    for progress in &trained.watch.steps {
        assert!(progress.loss.is_finite() && progress.loss > 0.0, "{progress:?}");
        assert!(progress.visible > 100 && progress.gaussians > 100, "{progress:?}");
    }
    gscream_vk::train::plan::Plan::new(&scene, &settings)
}

#[test]
fn three_steps_of_a_capture_with_masks() {
    let config = scene::Config { downscale: 8, ..Default::default() };
    let Some(scene) = capture("spin-1", &config) else { return };
    let plan = three_steps(&scene, 12.0);
    assert!(plan.masks && plan.depth && plan.depth_gradient && plan.attention && plan.growth, "{plan:?}");
    assert!(!plan.references.is_empty(), "{plan:?}");
}

#[test]
fn three_steps_of_photographs_alone() {
    let config = scene::Config { downscale: 4, ..Default::default() };
    let Some(scene) = capture("fern", &config) else { return };
    let plan = three_steps(&scene, 12.0);
    assert!(!plan.masks && !plan.depth && !plan.depth_gradient && !plan.attention && plan.growth, "{plan:?}");
    assert!(plan.references.is_empty(), "{plan:?}");
}

/// Corrects the schedule behind these steps, or behind what is in flight then, and notes where.
struct Corrects(Vec<[u32; 2]>, Vec<[u32; 2]>);

impl Observer for Corrects {
    fn corrects(&mut self, last: &Progress) -> bool {
        self.0.first().is_some_and(|[step, _]| *step <= last.step)
    }
    fn correction(&mut self, last: &Progress, _settings: &Settings) -> Option<u32> {
        let [step, iterations] = self.0.remove(0);
        assert!((step..step + 2).contains(&last.step), "a step in flight at most");
        Some(iterations)
    }
    fn corrected(&mut self, corrections: &[[u32; 2]]) {
        self.1 = corrections.to_vec();
    }
}

/// A schedule that was corrected while the run went on is repeated by the settings written down, and resumed.
#[test]
fn corrections_are_repeated_to_the_byte() {
    let (gpu, scene) = (testing::gpu(), scene_without_tests());
    let mut settings = common::settings(14);
    settings.train.coarse = Coarse { until: 6 };
    settings.train.checkpoint_interval = 7;
    let files = |folder: &std::path::Path| {
        [files::POINT_CLOUD, files::WEIGHTS]
            .map(|name| std::fs::read(folder.join("model").join(name)).expect("a model"))
    };
    let live = tempfile::tempdir().expect("a folder");
    let mut watch = Corrects(vec![[2, 20], [6, 16], [9, 12]], vec![]);
    let summary = Run::new(&gpu, &scene, &settings).expect("room").train(live.path(), &mut watch).expect("a run");
    let corrections = watch.1;
    let iterations: Vec<u32> = corrections.iter().map(|[_, iterations]| *iterations).collect();
    assert_eq!((summary.steps, iterations), (12, vec![20, 16, 12]));

    let mut written = settings.clone();
    written.train.corrections = corrections;
    let read = Settings::resolve(&[]).map(|_| toml::from_str::<Settings>(&written.to_toml()).expect("settings"));
    assert_eq!(read.expect("defaults"), written);
    let repeated = tempfile::tempdir().expect("a folder");
    let summary =
        Run::new(&gpu, &scene, &written).expect("room").train(repeated.path(), &mut Watch::default()).expect("a run");
    assert_eq!(summary.steps, 12);
    assert!(files(live.path()) == files(repeated.path()));

    // Behind the last step but one the last is in flight already.
    for stop in [2, 5, 9, 10] {
        let folder = tempfile::tempdir().expect("a folder");
        let mut watch = StopsBehind(stop);
        Run::new(&gpu, &scene, &written).expect("room").train(folder.path(), &mut watch).expect_err("stopped");
        let owner = checkpoint::Owner::new(&scene, &written);
        let (_, state) = checkpoint::latest(folder.path(), &owner).found.expect("a checkpoint");
        let summary = Run::resume(&gpu, &scene, &written, state)
            .expect("room")
            .train(folder.path(), &mut Watch::default())
            .expect("a run");
        assert_eq!(summary.steps, 12, "{stop}");
        assert!(files(live.path()) == files(folder.path()), "stopped behind step {stop}");
    }
    // The same without corrections is another run.
    let plain = tempfile::tempdir().expect("a folder");
    settings.train.iterations = 12;
    Run::new(&gpu, &scene, &settings).expect("room").train(plain.path(), &mut Watch::default()).expect("a run");
    assert!(files(live.path()) != files(plain.path()));
}

/// Ends a run behind a step.
struct StopsBehind(u32);

impl Observer for StopsBehind {
    fn step(&mut self, progress: &Progress) {
        self.0 = if progress.step >= self.0 { 0 } else { self.0 };
    }
    fn interrupted(&mut self) -> Option<Signal> {
        (self.0 == 0).then_some(Signal::Interrupt)
    }
}

/// Where a binding holds little, anchors grow to what fits and training goes on; a cloud that is too dense to begin with
/// starts on a coarser grid.
#[test]
fn a_device_that_binds_little_trains_to_the_end() {
    let open = |bytes| testing::fresh_gpu(Options { max_binding_bytes: Some(bytes), ..Options::default() });
    let folder = tempfile::tempdir().expect("a folder");
    let dir = folder.path().join("scene");
    let options = synthetic::Options { seed: 1, width: 48, height: 36, train_views: 6, test_views: 2, points: 8_000 };
    synthetic::write(&dir, &options).expect("a scene");
    let scene = scene::load(&dir, &scene::Config::default()).expect("a scene");
    let mut settings = common::settings(12);
    settings.densify.gradient_threshold = 1e-9;
    let initial = Beginning::of(&scene, &settings).expect("points").count();

    // A first guess has room for 2^17 pairs of three floats, less than for these anchors.
    assert!(480 * u64::from(initial) * 4 / 5 > 12 << 17, "{initial}");
    // Room for a few more anchors than there are: 480 bytes of gradients of the outputs each.
    let gpu = open(480 * (u64::from(initial) + 300));
    let fitting = forecast::fitting(&gpu, &scene, &settings, None).expect("a forecast");
    assert!(fitting.verdict.fits() && fitting.reduced.is_none(), "{:?}", fitting.reduced);
    let trained = train(&gpu, &scene, &settings, None);
    assert_eq!(trained.summary.steps, 12);
    assert!(trained.summary.anchors <= initial + 300);
    assert!(trained.watch.lines.iter().any(|line| line.contains("had no room")), "{:?}", trained.watch.lines);

    let gpu = open(480 * u64::from(initial) * 4 / 5);
    let fitting = forecast::fitting(&gpu, &scene, &settings, None).expect("a forecast");
    let reduced = fitting.reduced.expect("it does not fit as it is");
    assert!(reduced.contains("times coarser (model.voxel_factor="), "{reduced}");
    let trained = train(&gpu, &scene, &fitting.settings, None);
    assert_eq!(trained.summary.steps, 12);
    assert!(trained.summary.anchors <= initial * 4 / 5);

    // Little memory: growing stops earlier, or begins on a coarser grid.
    let gpu = testing::gpu();
    let needs = |anchors| {
        let question = forecast::Question { anchors, ..Default::default() };
        let verdict = forecast::forecast(&gpu, &scene, &settings, question).expect("a forecast");
        verdict.forecast.expect("it fits").needs()
    };
    let (still, grown) = (needs(Some(initial)), needs(None));
    assert!(still < grown, "{still} {grown}");
    let between = u64::midpoint(still, grown);
    let fitting = forecast::fitting(&gpu, &scene, &settings, Some(between)).expect("a forecast");
    let reduced = fitting.reduced.expect("it does not fit as it is");
    assert!(reduced.starts_with("growing stops earlier, at "), "{reduced}");
    assert!(fitting.verdict.forecast.expect("it fits").needs() <= between);
}

//! The plan against what is made: every combination of what a scene may lack, rehearsed; memory as predicted and as used.

use crate::common;
use std::collections::{BTreeMap, BTreeSet};

use gscream_vk::config::{Settings, Source};
use gscream_vk::gpu::form::without_form;
use gscream_vk::gpu::{Entry, Gpu, Options, Schedule, testing};
use gscream_vk::losses::{depth_gradient, depth_l1};
use gscream_vk::scene::Scene;
use gscream_vk::stage;
use gscream_vk::train::begin::Beginning;
use gscream_vk::train::forecast::{self, Forecast, Question, Survey};
use gscream_vk::train::plan::Plan;
use gscream_vk::train::run::Run;

/// Which of the optional parts are asked for.
#[derive(Clone, Copy, Debug)]
struct Wanted {
    masks: bool,
    priors: bool,
    reference: bool,
    attention: bool,
    growth: bool,
    tests: bool,
}

impl Wanted {
    const EVERYTHING: Self =
        Self { masks: true, priors: true, reference: true, attention: true, growth: true, tests: true };
    const NOTHING: Self =
        Self { masks: false, priors: false, reference: false, attention: false, growth: false, tests: false };

    /// All 64.
    fn all() -> impl Iterator<Item = Self> {
        (0..64).map(|bits: u32| {
            let [masks, priors, reference, attention, growth, tests] = std::array::from_fn(|i| bits >> i & 1 == 1);
            Self { masks, priors, reference, attention, growth, tests }
        })
    }

    fn settings(self) -> Settings {
        let mut settings = common::settings(15);
        let Self { masks, priors, reference, attention, growth, .. } = self;
        settings.scene = common::reads(masks, priors, reference);
        settings.model.attention.enabled = attention;
        settings.densify.enabled = growth;
        settings
    }

    fn scene(self, folder: &tempfile::TempDir) -> Scene {
        let mut scene = common::load(folder, &self.settings().scene);
        if !self.tests {
            scene.test.clear();
        }
        scene
    }
}

fn rehearsed(gpu: &Gpu, scene: &Scene, settings: &Settings) -> Forecast {
    let initial = Beginning::of(scene, settings).expect("points");
    let anchors = initial.count();
    // Numbers like those of the scene: which stages there are does not depend on them.
    let survey = Survey { anchors, visible: anchors, pairs: 4000 };
    forecast::rehearse(gpu, scene, settings, &initial, survey, anchors + anchors / 4, None).expect("a rehearsal")
}

/// Where the kernels and the buffers of optional stages show: the start of their names, and whose they are.
const DEPTH: &str = depth_l1::TERM.stage;
const DEPTH_GRADIENT: &str = depth_gradient::TERM.stage;
const MARKS: [(&str, &str); 13] = [
    ("losses/align", DEPTH),
    ("losses/depth_l1", DEPTH),
    ("losses/depth_gradient", DEPTH_GRADIENT),
    ("model/attention", stage::ATTENTION),
    ("densify/statistics", stage::STATISTICS),
    ("densify/grow", stage::GROWTH),
    ("densify/prune", stage::GROWTH),
    ("prior", DEPTH),
    ("depth_map", DEPTH),
    ("pair_depth", DEPTH),
    ("attention_", stage::ATTENTION),
    ("accumulated_gradient", stage::STATISTICS),
    ("candidate_flags", stage::GROWTH),
];

#[test]
fn every_combination_has_what_it_needs_and_nothing_else() {
    let gpu = testing::fresh_gpu(Options::default());
    let folder = common::folder();
    let mut ever: BTreeSet<&str> = BTreeSet::new();
    for wanted in Wanted::all() {
        let (scene, settings) = (wanted.scene(&folder), wanted.settings());
        let plan = Plan::new(&scene, &settings);
        let forecast = rehearsed(&gpu, &scene, &settings);
        let reference = wanted.reference && wanted.masks;
        assert_eq!(plan.references, Vec::from_iter(reference.then_some(3)), "{wanted:?}");
        let present = |name: &str| match name {
            stage::ATTENTION => wanted.attention && wanted.masks,
            DEPTH | DEPTH_GRADIENT => wanted.priors,
            stage::STATISTICS | stage::GROWTH => wanted.growth,
            stage::EVALUATION => wanted.tests,
            _ => true,
        };
        for name in stage::ALL {
            let used = forecast.used.get(name).is_some_and(|u| !u.passes.is_empty() || !u.buffers.is_empty());
            assert_eq!(used, present(name), "{wanted:?}: {name}: {:?}", forecast.used.get(name));
            assert_eq!(plan.steps(name, &settings).is_some(), present(name), "{wanted:?}: {name}");
            assert_eq!(plan.why(name).is_none(), present(name), "{wanted:?}: {name} needs a reason to be left out");
        }
        assert_eq!(forecast.used.len(), stage::ALL.iter().filter(|name| present(name)).count(), "{wanted:?}");

        let passes: BTreeSet<&str> = forecast.used.values().flat_map(|u| u.passes.iter().copied()).collect();
        let buffers: BTreeSet<&str> = forecast.used.values().flat_map(|u| u.buffers.keys().copied()).collect();
        for (mark, owner) in MARKS {
            let names = || passes.iter().chain(&buffers).chain(&forecast.pipelines);
            let found = names().find(|name| without_form(name).starts_with(mark));
            // Test views are drawn with their depth.
            let drawn = mark == "depth_map" && wanted.tests;
            assert_eq!(found.is_some(), present(owner) || drawn, "{wanted:?}: {mark}*: {found:?}");
        }
        for name in &passes {
            let masked = name.ends_with("_masked") || name.ends_with("_weighted") || name.ends_with("_masked_depth");
            assert!(wanted.masks || !(name.starts_with("losses/") && masked), "{wanted:?}: {name} needs a mask");
        }
        if !wanted.tests {
            let forms = ["render/rasterize", "render/cpu/rasterize", "render/project_backward"];
            for name in passes.iter().filter(|n| forms.iter().any(|f| n.starts_with(f))) {
                assert!(wanted.priors || name.ends_with("_color"), "{wanted:?}: {name} draws depth");
            }
        }
        for name in ["weight", "valid", "depth_weight"] {
            let present = wanted.masks && (name == "weight" || wanted.priors);
            assert_eq!(buffers.contains(name), present, "{wanted:?}: {name}");
        }
        let computed: BTreeSet<&str> = passes.iter().copied().filter(|name| name.contains('/')).collect();
        let compiled: BTreeSet<&str> = forecast.pipelines.iter().copied().collect();
        assert_eq!(computed, compiled, "{wanted:?}");
        ever.extend(&compiled);
    }
    for name in ["losses/frame_masked_depth", "render/project_backward_color", "densify/prune", "model/attention_blend"]
    {
        assert!(ever.iter().any(|n| n.starts_with(name)), "{name} is in no combination: {ever:?}");
    }
}

/// Name, number and bytes of what is alive.
fn alive(gpu: &Gpu) -> BTreeMap<&'static str, (usize, u64)> {
    gpu.buffers().into_iter().map(|(name, number, bytes)| (name, (number, bytes))).collect()
}

fn record(run: &mut Run<'_>, gpu: &Gpu, step: u32) -> Schedule {
    let mut rec = gpu.recorder().expect("a recorder");
    run.record(&mut rec, step).expect("the device has room");
    rec.schedule().clone()
}

/// What is rehearsed is what a device gets: the same passes, barriers and buffers, for all combinations.
#[test]
fn a_rehearsal_makes_what_a_device_makes() {
    let gpu = testing::fresh_gpu(Options::default());
    let folder = common::folder();
    for wanted in Wanted::all() {
        let (scene, settings) = (wanted.scene(&folder), wanted.settings());
        let dry = gpu.rehearsal();
        let mut real = Run::new(&gpu, &scene, &settings).expect("the device has room");
        let mut counted = Run::new(&dry, &scene, &settings).expect("a rehearsal");
        // The first; the reference view with statistics and attention; a step behind the last round.
        for step in [1, 4, 5, 13] {
            assert_eq!(record(&mut real, &gpu, step), record(&mut counted, &dry, step), "{wanted:?}, step {step}");
            assert_eq!(alive(&gpu), alive(&dry), "{wanted:?}, step {step}");
        }
    }
    assert_eq!(alive(&gpu), BTreeMap::new());
}

#[test]
fn stages_end_with_their_time() {
    let gpu = testing::fresh_gpu(Options::default());
    let (scene, settings) = (common::tiny(), Wanted::EVERYTHING.settings());
    let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
    let plan = run.step().plan.clone();
    let (counted, rounds) = (plan.counted.expect("growth"), plan.rounds.expect("growth"));
    assert_eq!(((counted.first, counted.last), (rounds.first, rounds.last)), ((2, 12), (4, 12)));
    let mut has = |step: u32| {
        record(&mut run, &gpu, step);
        let stages = gpu.stages();
        [stage::STATISTICS, stage::ATTENTION].map(|name| stages.contains_key(name))
    };
    assert_eq!(
        [1, 2, 3, 12, 13].map(&mut has),
        [[false, false], [true, false], [true, true], [true, true], [false, true]]
    );
    // The last round is the last that comes before the end, however long growth may go on.
    let mut short = settings.clone();
    short.train.iterations = 9;
    assert_eq!(Plan::new(&scene, &short).counted.map(|c| c.last), Some(8));
    short.train.iterations = 8;
    assert_eq!(Plan::new(&scene, &short).counted.map(|c| c.last), Some(6), "nobody trains what the last step leaves");
    short.train.iterations = 4;
    assert!(!Plan::new(&scene, &short).growth);
}

fn kernels(schedule: &Schedule) -> BTreeSet<&'static str> {
    let name = |entry: &Entry| match entry {
        Entry::Pass { name, .. } => Some(*name),
        Entry::Barrier { .. } => None,
    };
    schedule.entries.iter().filter_map(name).collect()
}

/// Only what a view's losses look at is drawn, compared and kept.
#[test]
fn depth_is_for_views_that_have_losses_of_it() {
    let gpu = testing::fresh_gpu(Options::default());
    let scene = common::tiny();
    let mut settings = Wanted::EVERYTHING.settings();
    settings.losses.depth.other_weight = 0.0;
    let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
    assert!(run.step().plan.left_out.iter().any(|l| l.what == "depth of views other than the reference"));
    assert_eq!(alive(&gpu)["prior"].0, 1, "the reference view's alone");
    let (other, reference) = (kernels(&record(&mut run, &gpu, 1)), kernels(&record(&mut run, &gpu, 4)));
    assert!(other.iter().all(|name| !name.contains("depth") || *name == "render/bin_depth_keys"), "{other:?}");
    assert!(reference.iter().any(|name| name.starts_with("losses/depth_l1")), "{reference:?}");
    for (kernels, color) in [(&other, true), (&reference, false)] {
        assert_eq!(kernels.contains("render/project_backward_color"), color, "{kernels:?}");
    }
    // And the other way round.
    settings.losses.depth = Default::default();
    settings.losses.depth.gradient.weight = 0.0;
    let mut scene = scene;
    scene.references[0].prior = None;
    let plan = Plan::new(&scene, &settings);
    assert!(plan.depth && !plan.reference_depth.any() && plan.other_depth.any());
    settings.losses.depth.other_weight = 0.0;
    assert!(!Plan::new(&scene, &settings).depth);
}

/// A learning rate of zero leaves the gradient out, and changes nothing about the others.
#[test]
fn gradients_of_what_is_not_trained_are_not_computed() {
    let gpu = testing::fresh_gpu(Options::default());
    let scene = common::tiny();
    let mut settings = common::settings(1);
    settings.model.attention.enabled = false;
    let gradients = |settings: &Settings| {
        let mut run = Run::new(&gpu, &scene, settings).expect("the device has room");
        let mut rec = gpu.recorder().expect("a recorder");
        run.record(&mut rec, 1).expect("the device has room");
        let kernels = kernels(rec.schedule());
        rec.submit().expect("the device runs it").wait().expect("the device runs it");
        (run.step().gradients().expect("readable"), kernels, alive(&gpu))
    };
    let (all, ..) = gradients(&settings);
    let zero = [0.0; 2];
    for bits in 0..16u32 {
        let [feature, offset, log_scaling, decoders] = std::array::from_fn(|i| bits >> i & 1 == 1);
        let mut settings = settings.clone();
        let rates = &mut settings.optimizer.learning_rate;
        let fix = |rate: &mut [f64; 2], trained: bool| {
            if !trained {
                *rate = zero;
            }
        };
        fix(&mut rates.feature, feature);
        fix(&mut rates.offset, offset);
        fix(&mut rates.log_scaling, log_scaling);
        [&mut rates.mlp_opacity, &mut rates.mlp_color, &mut rates.mlp_cov].into_iter().for_each(|r| fix(r, decoders));
        let (some, kernels, buffers) = gradients(&settings);
        for (name, trained) in [("feature", feature), ("offset", offset), ("log_scaling", log_scaling)] {
            assert_eq!(some.get(name), all.get(name).filter(|_| trained), "{bits:04b}: {name}");
            assert_eq!(buffers.contains_key(format!("grad_{name}").as_str()), trained, "{bits:04b}: {name}");
        }
        let weights = || all.iter().filter(|(name, _)| name.contains("mlp"));
        assert!(weights().count() > 0);
        for (name, gradient) in weights() {
            assert_eq!(some.get(name), Some(gradient).filter(|_| decoders), "{bits:04b}: {name}");
        }
        assert_eq!(buffers.contains_key("grad_weights"), decoders, "{bits:04b}");
        for (kernel, needed) in [
            ("render/decode_backward_feature", feature),
            ("render/decode_backward_hidden", feature || decoders),
            ("render/decode_backward_first", decoders),
            ("render/decode_backward_second", decoders),
            ("render/decode_backward_weights", decoders),
            ("render/decode_backward", offset && log_scaling),
            ("render/decode_backward_fixed_offset", !offset && log_scaling),
            ("render/decode_backward_fixed_scaling", offset && !log_scaling),
            ("render/decode_backward_fixed", !offset && !log_scaling),
            ("optimizer/adam", bits != 0),
        ] {
            let found = kernels.contains(kernel) || kernels.contains(kernel.replacen('/', "/cpu/", 1).as_str());
            assert_eq!(found, needed, "{bits:04b}: {kernel}");
        }
    }
}

#[test]
fn without_ssim_nothing_is_made_for_it() {
    let gpu = testing::fresh_gpu(Options::default());
    for wanted in [Wanted::NOTHING, Wanted::EVERYTHING] {
        let scene = wanted.scene(&common::folder());
        let mut settings = wanted.settings();
        settings.losses.ssim_weight = 0.0;
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        assert!(run.step().plan.left_out.iter().any(|l| l.what == "SSIM"));
        let kernels = kernels(&record(&mut run, &gpu, 1));
        let photometric: Vec<_> = kernels.iter().filter(|name| name.starts_with("losses/photometric")).collect();
        let suffix = if wanted.masks { "_weighted" } else { "" };
        assert_eq!(photometric, [&format!("losses/photometric_gradient_l1{suffix}")]);
        assert!(alive(&gpu).keys().all(|name| !name.contains("ssim")), "{:?}", alive(&gpu));
    }
}

/// Kernels are compiled at their first use: a run compiles those of its plan and no other.
#[test]
fn a_run_compiles_the_kernels_of_its_plan() {
    let folder = common::folder();
    let mut compiled = vec![];
    for wanted in [Wanted::NOTHING, Wanted::EVERYTHING] {
        let gpu = testing::fresh_gpu(Options::default());
        let (scene, settings) = (wanted.scene(&folder), wanted.settings());
        let forecast = rehearsed(&gpu, &scene, &settings);
        let planned: BTreeSet<&str> = forecast.pipelines.into_iter().collect();
        assert!(gpu.pipelines().is_empty(), "a rehearsal compiles nothing: {:?}", gpu.pipelines());
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        run.resize(forecast.capacity).expect("the device has room");
        assert!(gpu.pipelines().is_empty(), "nothing is compiled before it is used: {:?}", gpu.pipelines());
        let out = tempfile::tempdir().expect("a temporary folder");
        run.train(out.path(), &mut common::Watch::default()).expect("a run");
        let made: BTreeSet<&str> = gpu.pipelines().into_iter().collect();
        // Whether anchors are pruned, and whether a grid needs keys of several words, the numbers decide.
        let by_numbers = ["densify/prune_gather", "densify/grow_words", "primitives/sort_scatter_index"];
        let differ: Vec<_> = made.symmetric_difference(&planned).filter(|name| !by_numbers.contains(name)).collect();
        assert!(differ.is_empty(), "{wanted:?}: {differ:?}");
        compiled.push(made);
    }
    let [nothing, everything] = compiled.try_into().expect("two");
    for part in ["align", "depth_l1", "depth_gradient", "attention", "densify", "masked", "weighted"] {
        let has = |names: &BTreeSet<&str>| names.iter().any(|name| name.contains(part));
        assert_eq!((has(&nothing), has(&everything)), (false, true), "{part}: {nothing:?}");
    }
    assert!(nothing.len() + 30 < everything.len(), "{} and {}", nothing.len(), everything.len());
}

/// The bytes that a run takes are those that were foretold for its anchors.
#[test]
fn memory_is_as_predicted() {
    let gpu = testing::fresh_gpu(Options::default());
    let folder = common::folder();
    for wanted in [Wanted::NOTHING, Wanted { growth: true, ..Wanted::NOTHING }, Wanted::EVERYTHING] {
        let (scene, settings) = (wanted.scene(&folder), wanted.settings());
        let verdict = forecast::forecast(&gpu, &scene, &settings, Question::default()).expect("a forecast");
        let capacity = verdict.forecast.expect("it fits").capacity;
        let own = testing::fresh_gpu(Options::default());
        let mut run = Run::new(&own, &scene, &settings).expect("the device has room");
        run.resize(capacity).expect("the device has room");
        let start = own.memory().0;
        let out = tempfile::tempdir().expect("a temporary folder");
        let summary = run.train(out.path(), &mut common::Watch::default()).expect("a run");
        assert_eq!(summary.repeated, 0, "{wanted:?}: there was room for what was surveyed");
        let question = Question { anchors: Some(summary.anchors), ..Question::default() };
        let verdict = forecast::forecast(&gpu, &scene, &settings, question).expect("a forecast");
        let foretold = verdict.forecast.expect("it fits");
        // The host's mailboxes are not of a stage.
        let apart = |a: u64, b: u64| a.abs_diff(b);
        assert!(apart(foretold.start, start) <= 16 << 10, "{wanted:?}: {} foretold, {start} used", foretold.start);
        let used = summary.peak_device_bytes;
        assert!(apart(foretold.peak, used) * 10 <= used, "{wanted:?}: {} foretold, {used} used", foretold.peak);
    }
}

#[test]
fn what_does_not_fit_is_said_with_what_would() {
    let gpu = testing::fresh_gpu(Options::default());
    let folder = common::folder();
    let (scene, settings) = (Wanted::EVERYTHING.scene(&folder), Wanted::EVERYTHING.settings());
    let ask = |scene: &Scene, settings: &Settings, available: u64| {
        let question = Question { available: Some(available), ..Question::default() };
        forecast::forecast(&gpu, scene, settings, question).expect("a forecast")
    };
    let ample = ask(&scene, &settings, u64::MAX);
    assert!(ample.fits() && ample.starts() && ample.describe().is_none() && ample.remedies.is_empty());
    let needs = ample.forecast.as_ref().expect("a forecast").needs();
    assert!(ask(&scene, &settings, needs).fits());
    let tight = ask(&scene, &settings, needs - (1 << 20));
    assert!(!tight.fits());
    let says = tight.describe().expect("it does not fit");
    assert!(!tight.remedies.is_empty() && tight.remedies.iter().all(|r| says.contains(&r.change)), "{says}");
    for remedy in &tight.remedies {
        assert!(remedy.needs <= tight.available, "{remedy:?}");
        let mut changed = settings.clone();
        if let Some(downscale) = remedy.change.strip_prefix("--downscale ") {
            changed.scene.downscale = downscale.parse().expect("a number");
        } else {
            let set = remedy.change.strip_prefix("--set ").expect("a setting");
            let resolved = Settings::resolve(&[Source::Set(set.into())]).expect("a setting that exists");
            let key = set.split('=').next().expect("a key");
            match key {
                "model.voxel_factor" => changed.model.voxel_factor = resolved.model.voxel_factor,
                "densify.max_anchors" => changed.densify.max_anchors = resolved.densify.max_anchors,
                "model.attention.tokens" => changed.model.attention.tokens = resolved.model.attention.tokens,
                other => panic!("{other}: what does it change?"),
            }
        }
        let scene = common::load(&folder, &changed.scene);
        assert!(ask(&scene, &changed, tight.available).fits(), "{remedy:?} was to fit");
    }
    let hopeless = ask(&scene, &settings, 1);
    assert!(!hopeless.starts() && hopeless.remedies.is_empty());
    assert!(hopeless.describe().is_some_and(|text| text.contains("no smaller picture")));
}

/// The last steps that a number holds are no early ones.
#[test]
fn rounds_from_the_last_steps_on_never_come() {
    let scene = common::tiny();
    let mut settings = common::settings(15);
    assert!(Plan::new(&scene, &settings).growth);
    for (from, every) in [(u32::MAX, 100), (u32::MAX - 3, 7), (u32::MAX, 1)] {
        let densify = &mut settings.densify;
        (densify.from, densify.until, densify.every) = (from, u32::MAX, every);
        settings.validate().expect("settings that make sense");
        let plan = Plan::new(&scene, &settings);
        assert!(!plan.growth && plan.rounds.is_none(), "from {from}, every {every}: {:?}", plan.rounds);
    }
}

/// Points so far apart that each has a cell of the coarsest grid to itself: growth is expected everywhere, and there are
/// fewer Gaussians to grow from than the formula asks for.
#[test]
fn points_far_apart_are_rehearsed() {
    let gpu = testing::gpu();
    let scene = common::tiny();
    let mut settings = common::settings(14);
    settings.model.voxel = 1e-3;
    let verdict = forecast::forecast(&gpu, &scene, &settings, Question::default()).expect("a forecast");
    let forecast = verdict.forecast.expect("it fits a binding");
    assert!(forecast.anchors > forecast.survey.anchors, "{} anchors", forecast.anchors);
}

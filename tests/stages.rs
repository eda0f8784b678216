//! What a scene lacks has no pass and no buffer; barriers are neither too few nor of influence.

use crate::common;
use gscream_vk::config::Settings;
use gscream_vk::gpu::form::without_form;
use gscream_vk::gpu::{Entry, Gpu, Options, testing};
use gscream_vk::render::rasterize::Outputs;
use gscream_vk::train::plan::Plan;
use gscream_vk::train::run::Run;

/// Which of the optional stages are asked for.
#[derive(Clone, Copy, Debug)]
struct Wanted {
    masks: bool,
    priors: bool,
    reference: bool,
    attention: bool,
    growth: bool,
}

impl Wanted {
    /// All combinations that the scene's reading allows: without masks there is no reference.
    fn all() -> impl Iterator<Item = Self> {
        (0..32)
            .map(|bits: u32| {
                let [masks, priors, reference, attention, growth] = std::array::from_fn(|i| bits >> i & 1 == 1);
                Self { masks, priors, reference, attention, growth }
            })
            .filter(|wanted| wanted.masks || !wanted.reference)
    }

    fn settings(self) -> Settings {
        // Four steps: the fourth is the reference view, with statistics and attention.
        let mut settings = common::settings(5);
        let Self { masks, priors, reference, attention, growth } = self;
        settings.scene = common::reads(masks, priors, reference);
        settings.model.attention.enabled = attention;
        settings.densify.enabled = growth;
        settings
    }
}

/// Passes and buffers of each stage: a start of their names, and when they may be there.
fn stages(plan: &Plan) -> Vec<(&'static str, bool)> {
    vec![
        ("losses/align", plan.depth),
        ("losses/depth_l1", plan.depth),
        ("losses/depth_gradient", plan.depth_gradient),
        ("model/attention", plan.attention),
        ("densify/", plan.growth),
    ]
}

type Present = fn(&Plan) -> bool;

/// Buffers that belong to stages, by name.
const BUFFERS: [(&str, Present); 24] = [
    ("prior", |p| p.depth),
    ("depth_map", |p| p.depth),
    ("grad_depth", |p| p.depth),
    ("pair_depth", |p| p.depth),
    ("fit", |p| p.depth),
    ("align_partial", |p| p.depth),
    ("align_sums", |p| p.depth),
    ("grad_align_sums", |p| p.depth),
    ("depth_difference", |p| p.depth),
    ("grad_aligned", |p| p.depth),
    ("depth_l1_partial", |p| p.depth),
    ("depth_gradient_partial", |p| p.depth_gradient),
    ("depth_gradient_counts", |p| p.depth_gradient && p.masks),
    ("weight", |p| p.masks),
    ("valid", |p| p.masks && p.depth),
    ("depth_weight", |p| p.masks && p.depth),
    ("attention_weights", |p| p.attention),
    ("grad_attention_weights", |p| p.attention),
    ("blended", |p| p.attention),
    ("attention_skip", |p| p.attention),
    ("accumulated_gradient", |p| p.growth),
    ("seen", |p| p.growth),
    ("opacity_sum", |p| p.growth),
    ("visits", |p| p.growth),
];

#[test]
fn what_is_absent_has_no_pass_and_no_buffer() {
    testing::gpu_in_both_forms().for_each(|gpu| what_is_absent_has_no_pass_and_no_buffer_in_one_form(&gpu));
}

fn what_is_absent_has_no_pass_and_no_buffer_in_one_form(gpu: &Gpu) {
    let folder = common::folder();
    let mut names = std::collections::BTreeSet::new();
    for wanted in Wanted::all() {
        let settings = wanted.settings();
        let mut scene = common::load(&folder, &settings.scene);
        scene.test.clear();
        let before: Vec<_> = gpu.buffers();
        assert!(before.is_empty(), "{wanted:?}: buffers of the run before are left: {before:?}");
        let mut run = Run::new(gpu, &scene, &settings).expect("the device has room");

        let plan = run.step().plan.clone();
        let left_out = |what: &str| plan.left_out.iter().any(|left| left.what == what);
        assert_eq!((plan.masks, plan.depth, plan.depth_gradient), (wanted.masks, wanted.priors, wanted.priors));
        assert_eq!(plan.attention, wanted.attention && wanted.masks, "{wanted:?}");
        assert_eq!(
            (plan.growth, plan.references.clone()),
            (wanted.growth, Vec::from_iter(wanted.reference.then_some(3))),
            "{wanted:?}"
        );
        assert_eq!(left_out("pixel weights"), !plan.masks, "{wanted:?}");
        assert_eq!(left_out("reference view"), !wanted.reference, "{wanted:?}");
        assert_eq!(left_out("depth map, its gradient, alignment and depth losses"), !plan.depth, "{wanted:?}");
        assert_eq!(left_out("cross-attention"), !plan.attention, "{wanted:?}");
        assert_eq!(left_out("statistics, growing and pruning"), !plan.growth, "{wanted:?}");
        assert!(left_out("evaluation") && left_out("gradient of anchor positions"), "{wanted:?}");

        let mut rec = gpu.recorder().expect("a recorder");
        run.record(&mut rec, 4).expect("the device has room");
        let passes: Vec<&str> = rec
            .schedule()
            .entries
            .iter()
            .filter_map(|entry| match entry {
                Entry::Pass { name, .. } => Some(*name),
                Entry::Barrier { .. } => None,
            })
            .collect();
        drop(rec);
        let has = |start: &str| passes.iter().any(|name| without_form(name).starts_with(start));
        for (start, present) in stages(&plan) {
            assert_eq!(has(start), present, "{wanted:?}: passes {start}*");
        }
        for name in &passes {
            let masked = name.starts_with("losses/") && (name.ends_with("_masked") || name.ends_with("_weighted"));
            assert!(plan.masks || !(masked || name.ends_with("_masked_depth")), "{wanted:?}: {name} needs a mask");
            let forms = ["render/rasterize", "render/cpu/rasterize", "render/project_backward"];
            let forms = forms.iter().any(|start| name.starts_with(start));
            let depth = !name.ends_with("_color");
            assert!(!forms || depth == plan.depth, "{wanted:?}: {name} where the picture has depth: {}", plan.depth);
        }
        assert_eq!(has("render/project_backward_color"), !plan.depth, "{wanted:?}");
        assert_eq!(plan.outputs() == Outputs::Color, !plan.depth);
        names.extend(passes);

        let buffers: Vec<&str> = gpu.buffers().into_iter().map(|(name, ..)| name).collect();
        for (name, present) in BUFFERS {
            assert_eq!(buffers.contains(&name), present(&plan), "{wanted:?}: buffer {name} of {buffers:?}");
        }

        let out = tempfile::tempdir().expect("a temporary folder");
        let mut watch = common::Watch::default();
        let summary = run.train(out.path(), &mut watch).unwrap_or_else(|error| panic!("{wanted:?}: {error}"));
        assert_eq!((summary.steps, watch.steps.len()), (5, 5));
        let changed = watch.lines.iter().any(|line| line.contains("pruned"));
        assert_eq!(changed, wanted.growth, "{wanted:?}: {:?}", watch.lines);
        for progress in &watch.steps {
            assert!(progress.loss.is_finite() && progress.loss > 0.0, "{wanted:?}: {progress:?}");
        }
        let (anchors, weights) = run.step().model().expect("readable");
        let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
        assert!(finite(anchors.feature.as_flattened()) && finite(&anchors.offset), "{wanted:?}");
        assert!(finite(anchors.log_scaling.as_flattened()), "{wanted:?}");
        assert!(weights.tensors.values().all(|tensor| finite(&tensor.data)), "{wanted:?}");
    }
    // The combinations together show every form, so that none of the absences above was a misspelt name.
    for name in
        ["losses/frame_masked", "losses/frame_masked_depth", "render/project_backward_color", "densify/statistics"]
    {
        assert!(names.contains(name), "{name} is in no schedule: {names:?}");
    }
}

/// Only recorded, never run: what the layer reports, it reports while recording.
#[test]
fn validation_notices_lost_barriers() {
    let (scene, settings) = (common::tiny(), common::settings(20));
    let hazards = |omit_barriers| {
        let gpu = testing::fresh_gpu(Options { omit_barriers, ..Options::default() });
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        gpu.take_messages();
        let mut rec = gpu.recorder().expect("a recorder");
        run.record(&mut rec, 4).expect("the device has room");
        let barriers = rec.schedule().barriers();
        drop(rec);
        (gpu.take_messages(), barriers)
    };
    let (with, barriers) = hazards(false);
    assert!(with.is_empty() && barriers > 20, "{barriers} barriers, {with:?}");
    let (without, listed) = hazards(true);
    assert_eq!(listed, barriers, "the schedule is the same");
    assert!(!without.is_empty(), "{barriers} barriers were left out and nobody noticed");
    for kind in ["SYNC-HAZARD-READ-AFTER-WRITE", "SYNC-HAZARD-WRITE-AFTER-"] {
        assert!(without.iter().any(|message| message.contains(kind)), "no {kind} in {without:#?}");
    }
}

#[test]
fn a_barrier_after_every_pass_changes_nothing() {
    let (scene, settings) = (common::tiny(), common::settings(6));
    let train = |serialize| {
        let gpu = testing::gpu_with(Options { serialize, ..Options::default() });
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        let mut rec = gpu.recorder().expect("a recorder");
        run.record(&mut rec, 4).expect("the device has room");
        let (passes, barriers) = (rec.schedule().passes(), rec.schedule().barriers());
        drop(rec);
        assert_eq!(barriers == passes - 1, serialize, "{passes} passes, {barriers} barriers");
        let out = tempfile::tempdir().expect("a temporary folder");
        let mut watch = common::Watch::default();
        run.train(out.path(), &mut watch).expect("a run");
        let losses: Vec<u32> = watch.steps.iter().map(|progress| progress.loss.to_bits()).collect();
        (losses, run.step().model().expect("readable"))
    };
    let (normal, serialized) = (train(false), train(true));
    assert_eq!(normal.0, serialized.0, "losses");
    assert!(normal.1 == serialized.1, "models");
}

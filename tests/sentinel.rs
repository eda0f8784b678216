//! Values that stop being finite are noticed, named, and kept out of the last checkpoint.

use crate::common;
use std::path::Path;

use gscream_vk::config::Settings;
use gscream_vk::gpu::form::without_form;
use gscream_vk::gpu::{Buffer, Gpu, NotFinite, testing};
use gscream_vk::model::files;
use gscream_vk::scene::Scene;
use gscream_vk::train::checkpoint::{self, Owner, State};
use gscream_vk::train::run::{Error, Observer, Progress, Run, Silent};

fn scene() -> Scene {
    let mut scene = common::tiny();
    scene.test.clear();
    scene
}

/// How a run ended early: the error, the step, what was found, and the checkpoint.
struct Ended {
    message: String,
    step: u32,
    found: Option<NotFinite>,
    kept: State,
}

fn ended(error: Error, folder: &Path, scene: &Scene, settings: &Settings) -> Ended {
    let message = error.to_string();
    let Error::Stopped { source, kept: Some(kept), .. } = error else { panic!("{message}") };
    let Error::NotFinite { step, found, .. } = *source else { panic!("{message}") };
    let path = checkpoint::path(folder, kept);
    let state = checkpoint::read(&path, &Owner::new(scene, settings)).unwrap_or_else(|refusal| panic!("{refusal}"));
    assert_eq!(state.history.last.step, kept);
    assert_eq!(state.model.not_finite(), None);
    Ended { message, step, found, kept: state }
}

#[test]
fn a_healthy_step_has_no_such_value() {
    testing::gpu_in_both_forms().for_each(|gpu| a_healthy_step_has_no_such_value_in_one_form(&gpu));
}

fn a_healthy_step_has_no_such_value_in_one_form(gpu: &Gpu) {
    let (scene, settings) = (common::tiny(), common::settings(20));
    let mut run = Run::new(gpu, &scene, &settings).expect("the device has room");
    for step in 1..=6 {
        if [1, 4, 5].contains(&step) {
            let mut rec = gpu.inspected().expect("a recorder");
            run.record(&mut rec, step).expect("the device has room");
            assert_eq!(rec.not_finite(), None, "step {step}");
            rec.submit().and_then(gscream_vk::gpu::Submission::wait).expect("the device runs it");
        } else {
            run.run_one(step).expect("a step");
        }
    }
}

/// Trains until something is not finite.
fn breaks(gpu: &Gpu, scene: &Scene, settings: &Settings, what: &str) -> (Ended, common::Watch) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut run = Run::new(gpu, scene, settings).expect("the device has room");
    let mut watch = common::Watch::default();
    let Err(error) = run.train(folder.path(), &mut watch) else { panic!("{what}: it went well") };
    let ended = ended(error, folder.path(), scene, settings);
    assert!(!folder.path().join("model").exists(), "{what}: no broken model is saved");

    // The checkpoint is that of the run: from it the same step ends in the same way.
    let mut again = Run::resume(gpu, scene, settings, ended.kept.clone()).expect("the device has room");
    let Err(error) = again.train(folder.path(), &mut Silent) else { panic!("{what}: resumed, it went well") };
    let resumed = self::ended(error, folder.path(), scene, settings);
    assert_eq!(place(&resumed), place(&ended), "{what}");
    assert_eq!(resumed.kept.model, ended.kept.model, "{what}");
    (ended, watch)
}

/// Where it was found: a NaN is not even equal to itself.
fn place(ended: &Ended) -> (u32, Option<(&'static str, &'static str, usize)>) {
    (ended.step, ended.found.as_ref().map(|found| (found.pass, found.tensor, found.index)))
}

const REPEATING: &str = "repeating the steps since the last good state";

/// Rates that grow over the steps until nothing can be computed with them, and some of which that is so at once.
#[test]
fn an_absurd_learning_rate_is_caught_in_the_step_it_breaks() {
    let gpu = testing::gpu();
    let scene = scene();
    type Change = fn(&mut Settings);
    let cases: [(&str, Change, &str, &[&str]); 3] = [
        // Sums of products overflow, forward.
        ("mlp_cov", |s| s.optimizer.learning_rate.mlp_cov = [1e-3, 1e38], "render/decode", &["rotation", "scale"]),
        ("feature", |s| s.optimizer.learning_rate.feature = [1e38, 1e38], "model/attention_project", &["qk", "value"]),
        // The first step itself: beyond float32 the rate is infinite.
        ("offset", |s| s.optimizer.learning_rate.offset = [1e39, 1e39], "optimizer/adam", &["value"]),
    ];
    for (name, change, pass, tensors) in cases {
        let mut settings = common::settings(60);
        settings.densify.max_log_scaling = f64::INFINITY;
        settings.train.checkpoint_interval = 10;
        change(&mut settings);
        let mut found = vec![];
        // At every step, now and then, and seldom.
        for interval in [1, 7, 50] {
            settings.train.sentinel_interval = interval;
            let what = format!("{name}, every {interval}");
            let (ended, watch) = breaks(&gpu, &scene, &settings, &what);
            let repeated = watch.lines.iter().any(|line| line.contains(REPEATING));
            // What Adam wrote is noticed in a later step, when it is in the model.
            assert_eq!(repeated, pass == "optimizer/adam", "{what}: {:?}", watch.lines);
            assert_eq!(ended.kept.history.last.step, ended.step - 1, "{what}");
            let place = place(&ended);
            let first = ended.found.unwrap_or_else(|| panic!("{what}: nothing found"));
            // Of a kernel's forms the device's.
            assert!(without_form(first.pass).starts_with(pass), "{what}: {first:?}");
            assert!(tensors.contains(&first.tensor), "{what}: {first:?}");
            let words = [
                format!("step {} (view ", ended.step),
                format!("pass {} wrote {} into `{}`", first.pass, first.value, first.tensor),
                format!("the last good state, behind step {}, is ", ended.step - 1),
            ];
            assert!(words.iter().all(|word| ended.message.contains(word)), "{what}: {}", ended.message);
            found.push((place, ended.kept.model));
        }
        assert!(found.iter().all(|one| *one == found[0]), "{name}: the interval does not change what is found");
    }
}

/// Puts a value into a tensor behind a step, as a faulty memory would.
struct Poison<'g> {
    gpu: &'g Gpu,
    tensor: Buffer<f32>,
    behind: u32,
    value: f32,
}

impl Observer for Poison<'_> {
    fn step(&mut self, progress: &Progress) {
        if progress.step == self.behind {
            let mut values = self.gpu.read(&self.tensor).expect("readable");
            values[..64].fill(self.value);
            self.gpu.write(&self.tensor, &values).expect("writable");
        }
    }
}

#[test]
fn what_breaks_without_a_cause_is_not_kept_and_can_be_gone_on_from() {
    let gpu = testing::gpu();
    let scene = scene();
    let mut settings = common::settings(40);
    settings.train.sentinel_interval = 4;
    // Growing would put other buffers in place of those that are poisoned.
    settings.densify.enabled = false;
    let model = |folder: &Path| files::load(&folder.join("model")).expect("a model");
    let whole = tempfile::tempdir().expect("a temporary folder");
    settings.train.checkpoint_interval = 0;
    Run::new(&gpu, &scene, &settings).and_then(|mut run| run.train(whole.path(), &mut Silent)).expect("a run");
    let whole = model(whole.path());

    type Pick = fn(&Run<'_>) -> Buffer<f32>;
    let cases: [(&str, Pick, f32); 4] = [
        ("a feature", |run| run.step().anchors().feature().value.view(), f32::NAN),
        ("an offset", |run| run.step().anchors().offset().value.view(), f32::NEG_INFINITY),
        ("a first moment", |run| run.step().anchors().log_scaling().first.view(), f32::INFINITY),
        ("a decoder's weight", |run| run.step().learnt.weights().expect("decoders").value.view(), f32::INFINITY),
    ];
    for (name, pick, value) in cases {
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut poison = Poison { gpu: &gpu, tensor: pick(&run), behind: 17, value };
        let error = run.train(folder.path(), &mut poison).expect_err(name);
        let ended = ended(error, folder.path(), &scene, &settings);
        assert_eq!(ended.found, None, "{name}");
        assert!(ended.message.contains("did not when the steps were repeated"), "{name}: {}", ended.message);
        assert!(ended.message.contains("gscream-vk train --resume"), "{name}: {}", ended.message);
        // Noticed within the interval, at the latest.
        assert!((18..=20).contains(&ended.step), "{name}: noticed in step {}", ended.step);
        let mut again = Run::resume(&gpu, &scene, &settings, ended.kept).expect("the device has room");
        again.train(folder.path(), &mut Silent).expect("a run");
        assert!(model(folder.path()) == whole, "{name}: gone on with, it is another model");
    }
}

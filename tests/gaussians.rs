//! Runs of plain Gaussians (`model.form = "gaussians"`): they learn, are the same again, go on from checkpoints, agree with
//! the reference path, and are written as they are.

use std::path::Path;

use crate::common;
use crate::common::Watch;
use gscream_vk::config::{Settings, Source};
use gscream_vk::export::{self, Observer as Export, Options as ExportOptions};
use gscream_vk::formats::ply;
use gscream_vk::gpu::form::without_form;
use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::model::config::Form;
use gscream_vk::model::files::{POINT_CLOUD, WEIGHTS};
use gscream_vk::model::stored::Stored;
use gscream_vk::render::forward::Capacity;
use gscream_vk::scene::Scene;
use gscream_vk::signal::Signal;
use gscream_vk::train::plan::Plan;
use gscream_vk::train::run::{Observer, Progress, Run};
use gscream_vk::train::{checkpoint, forecast};

/// Rounds behind every second step from the fourth to the twelfth.
fn settings(iterations: u32) -> Settings {
    let mut settings = common::settings(iterations);
    settings.model.attention.enabled = false;
    settings.model.form = Form::Gaussians;
    settings.model.degree = 2;
    settings.densify.max_gaussians = 330;
    settings.validate().expect("settings that make sense");
    settings
}

/// The model's file and the log's losses.
fn train(gpu: &Gpu, scene: &Scene, settings: &Settings, pairs: u32) -> (Vec<u8>, Watch) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut run = Run::new(gpu, scene, settings).expect("the device has room");
    let rows = run.step().learnt.capacity();
    assert_eq!(rows, 330, "the room is there from the first step on");
    run.resize(Capacity { anchors: rows, visible: rows, pairs }).expect("the device has room");
    let mut watch = Watch::default();
    run.train(folder.path(), &mut watch).expect("a run");
    let model = folder.path().join("model");
    assert!(!model.join(WEIGHTS).exists(), "there are no networks");
    let bytes = std::fs::read(model.join(POINT_CLOUD)).expect("the run wrote it");
    // What is on disk is what is on the device, in the lengths of the scene's files.
    let mut on_device = run.step().stored().expect("readable");
    on_device.rescale(scene.unit);
    assert!(Stored::load(&model).expect("our own file") == on_device);
    (bytes, watch)
}

#[test]
fn a_run_learns_and_is_the_same_again() {
    let (gpu, scene) = (testing::gpu(), common::tiny());
    let mut settings = settings(90);
    settings.optimizer.learning_rate.position = [0.0016, 0.000016];
    let (model, watch) = train(&gpu, &scene, &settings, 1 << 16);
    let mean = |steps: &[Progress]| steps.iter().map(|p| f64::from(p.loss)).sum::<f64>() / steps.len() as f64;
    let (first, last) = (mean(&watch.steps[..6]), mean(&watch.steps[84..]));
    assert!(last < 0.7 * first, "{first} to {last}");
    let rounds = watch.lines.iter().filter(|line| line.contains("faded Gaussians are halves of others"));
    // Of five rounds two change something, and the others say nothing.
    assert_eq!(rounds.count(), 2, "{:?}", watch.lines);
    assert_eq!(watch.steps[89].anchors, 330, "as many as there may be");
    assert!(watch.steps.iter().all(|p| p.visible == p.anchors && p.gaussians > 0));
    // Again, and with room for too few pairs at first.
    for pairs in [1 << 16, 64] {
        let (again, others) = train(&gpu, &scene, &settings, pairs);
        assert!(again == model, "{pairs} pairs");
        assert_eq!(others.steps.last().map(|p| p.loss), watch.steps.last().map(|p| p.loss));
    }
    settings.train.seed = 1;
    assert!(train(&gpu, &scene, &settings, 1 << 16).0 != model, "another seed, other Gaussians");
}

/// Ends the run behind a step.
struct Until(u32, u32);

impl Observer for Until {
    fn step(&mut self, progress: &Progress) {
        self.1 = progress.step;
    }
    fn interrupted(&mut self) -> Option<Signal> {
        (self.1 >= self.0).then_some(Signal::Interrupt)
    }
}

#[test]
fn a_run_goes_on_to_the_same_bytes() {
    let (gpu, scene, settings) = (testing::gpu(), common::tiny(), settings(20));
    let (whole, _) = train(&gpu, &scene, &settings, 1 << 16);
    // Before a round, right behind one, and behind the last.
    for step in [3, 8, 15] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        run.train(folder.path(), &mut Until(step, 0)).expect_err("it was interrupted");
        drop(run);
        let owner = checkpoint::Owner::new(&scene, &settings);
        let (path, state) = checkpoint::latest(folder.path(), &owner).found.expect("a checkpoint");
        assert!(state.history.last.step >= step && state.history.last.step < 20);
        let mut run = Run::resume(&gpu, &scene, &settings, state).expect("room");
        run.train(folder.path(), &mut Watch::default()).expect("a run");
        let bytes = std::fs::read(folder.path().join("model").join(POINT_CLOUD)).expect("the run wrote it");
        assert!(bytes == whole, "behind step {step}");
        // A tensor that is gone is noticed.
        let text = std::fs::read(&path).expect("a checkpoint");
        std::fs::write(&path, &text[..text.len() - 5]).expect("writable");
        assert!(checkpoint::read(&path, &owner).is_err());
    }
}

#[test]
fn every_pass_agrees_with_its_reference() {
    testing::gpu_in_both_forms().for_each(|gpu| {
        let (scene, mut settings) = (common::tiny(), settings(20));
        // The gradient of a nearly round one's rotation is what roundings leave of terms that cancel: none stays round.
        settings.optimizer.learning_rate.log_scale = [0.1, 0.1];
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        for step in 1..=10 {
            // Of the second round over the views; 10 is the reference view.
            if ![9, 10].contains(&step) {
                run.run_one(step).expect("a step");
                continue;
            }
            let mut rec = gpu.checked().expect("a recorder");
            run.record(&mut rec, step).expect("the device has room");
            let submission = rec.submit().expect("the device runs it");
            let differences = submission.differences.clone();
            submission.wait().expect("the device runs it");
            let compared = |pass: &str| differences.iter().any(|d| without_form(&d.pass).starts_with(pass));
            for pass in ["render/activate", "render/activate_backward", "losses/depth_l1", "optimizer/adam"] {
                assert!(compared(pass), "step {step}: {pass} was not compared");
            }
            for pass in ["render/cull", "render/decode", "densify/statistics"] {
                assert!(!compared(pass), "step {step}: {pass} has nothing to do");
            }
            let failed: Vec<String> = differences.iter().filter(|d| !d.ok()).map(ToString::to_string).collect();
            assert!(failed.is_empty(), "step {step}, beyond their bounds:\n{}", failed.join("\n"));
        }
    });
}

/// The rehearsal knows the room of the whole run, which stays what it is from the first step on.
#[test]
fn a_run_is_forecast() {
    let (gpu, scene, settings) = (testing::gpu(), common::tiny(), settings(20));
    let verdict = forecast::forecast(&gpu, &scene, &settings, forecast::Question::default()).expect("a forecast");
    let forecast = verdict.forecast.expect("it fits");
    assert_eq!((forecast.form, forecast.anchors), (Form::Gaussians, 330));
    assert!(forecast.pipelines.contains(&"render/activate"), "{:?}", forecast.pipelines);
    assert!(forecast.pipelines.iter().all(|name| !name.starts_with("render/decode")), "{:?}", forecast.pipelines);
    let plan = Plan::new(&scene, &settings);
    assert!(plan.steps("cull", &settings).is_none() && plan.why("cull").is_some());
    assert!(plan.steps("statistics", &settings).is_none() && plan.why("statistics").is_some());
    assert!(plan.steps("grow and prune", &settings).is_some());
}

struct Quiet;

impl Export for Quiet {
    fn begin(&mut self, _: &str, _: u64) {}
    fn turn(&mut self, _: &str) {}
}

/// In the scene's axes and for pictures of the training's size, what is exported is the model's own file.
#[test]
fn an_export_is_the_model() {
    let (gpu, scene, settings) = (testing::gpu(), common::tiny(), settings(20));
    let (bytes, _) = train(&gpu, &scene, &settings, 1 << 16);
    let cloud = ply::decode(&bytes).expect("our own file");
    assert_eq!((cloud.len(), cloud.degree), (330, 2));
    let model = Stored::Gaussians(cloud);
    let options = ExportOptions { upright: false, screen: 1, ..ExportOptions::default() };
    let made = |options| export::make(&gpu, &model, &scene, &settings, &options, &mut Quiet).expect("an export");
    assert!(ply::encode(&made(options).cloud) == bytes);
    // Upright it is another file of the same pictures, but for roundings.
    let upright = made(ExportOptions { upright: true, screen: 1, ..options });
    let (loss, _) = upright.yardstick.of_cloud(&gpu, &upright.cloud, 1, &settings.render).expect("pictures");
    let psnr = loss.anchors.expect("test views").metrics.full.psnr;
    assert!(psnr > 50.0, "{psnr}");
}

#[test]
fn what_plain_gaussians_cannot_do_is_one_sentence() {
    let set = |keys: &[&str]| {
        let keys: Vec<Source> = keys.iter().map(|key| Source::Set((*key).to_owned())).collect();
        Settings::resolve(&keys).map(|settings| settings.model.form).map_err(|error| error.to_string())
    };
    assert_eq!(set(&["model.form=gaussians"]), Ok(Form::Gaussians));
    let error = set(&["model.form=gaussians", "model.attention.enabled=true"]).expect_err("no features");
    assert!(error.contains("model.attention.enabled") && !error.contains('\n'), "{error}");
    assert!(set(&["model.form=splats"]).is_err() && set(&["model.degree=4"]).is_err());
}

/// A file of other programs, or one that is cut off, is a sentence with the file's name.
#[test]
fn a_model_that_cannot_be_read_is_one_sentence() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let refused = |bytes: &[u8]| {
        std::fs::write(folder.path().join(POINT_CLOUD), bytes).expect("writable");
        let error = Stored::load(Path::new(folder.path())).expect_err("no model").to_string();
        assert!(error.contains(POINT_CLOUD) && !error.contains('\n'), "{error}");
        error
    };
    let cloud = export::Cloud {
        position: vec![[0.0; 3]; 2],
        log_scale: vec![[0.0; 3], [0.0, f32::NAN, 0.0]],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        logit: vec![0.0; 2],
        degree: 0,
        harmonics: vec![[0.0; 3]; 2],
        antialiased: false,
    };
    let bytes = ply::encode(&cloud);
    assert!(refused(&bytes).contains("vertex 1"));
    refused(&bytes[..bytes.len() - 3]);
    refused(&ply::encode(&export::Cloud::default()));
}

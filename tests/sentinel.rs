//! Values that stop being finite are noticed, named, and kept out of the last checkpoint.

#[allow(dead_code)]
mod common;

use std::path::Path;

use gscream_vk::config::Settings;
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
    let gpu = testing::gpu();
    let (scene, settings) = (common::tiny(), common::settings(20));
    let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
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

#[test]
fn an_absurd_learning_rate_is_caught_in_the_step_it_breaks() {
    let gpu = testing::gpu();
    let scene = scene();
    type Change = fn(&mut Settings);
    let cases: [(&str, Change); 5] = [
        ("log_scaling", |s| s.optimizer.learning_rate.log_scaling = [1e-3, 1e6]),
        ("feature", |s| s.optimizer.learning_rate.feature = [1e-3, 1e38]),
        ("offset", |s| s.optimizer.learning_rate.offset = [1e-3, 1e38]),
        ("mlp_cov", |s| s.optimizer.learning_rate.mlp_cov = [1e-3, 1e38]),
        ("all at once", |s| s.optimizer.learning_rate.feature = [1e38, 1e38]),
    ];
    for (name, change) in cases {
        for interval in [1, 7, 50] {
            let mut settings = common::settings(60);
            settings.train.sentinel_interval = interval;
            settings.train.checkpoint_interval = 10;
            settings.densify.max_log_scaling = f64::INFINITY;
            change(&mut settings);
            let folder = tempfile::tempdir().expect("a temporary folder");
            let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
            let mut watch = common::Watch::default();
            match run.train(folder.path(), &mut watch) {
                Ok(_) => println!("{name} {interval}: went well"),
                Err(error) => {
                    let ended = ended(error, folder.path(), &scene, &settings);
                    println!("{name} {interval}: {} {:?} kept {}", ended.message, ended.found, ended.kept.history.last.step);
                    println!("  {:?}", watch.lines.last());
                }
            }
        }
    }
}

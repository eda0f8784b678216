//! Twenty thousand steps of a small scene.

use std::path::PathBuf;

use gscream_vk::config::Settings;
use gscream_vk::gpu::{Gpu, Options};
use gscream_vk::scene::{self, Scene, synthetic};
use gscream_vk::train::run::{Observer, Progress, Run};

use super::{Case, common};

const STEPS: u32 = 20_000;

pub const CASES: &[Case] = &[Case {
    stage: "train",
    case: "20,000 steps of a small scene",
    guarantee: "explore",
    run: long_run,
}];

fn small() -> Scene {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = synthetic::Options { seed: 2, width: 16, height: 16, train_views: 4, test_views: 1, points: 40 };
    let path: PathBuf = folder.path().join("scene");
    synthetic::write(&path, &options).expect("a writable folder");
    let mut scene = scene::load(&path, &scene::Config::default()).expect("a scene that was just written");
    scene.test.clear();
    scene
}

fn settings() -> Settings {
    let mut settings = common::settings(STEPS);
    settings.train.log_interval = 1000;
    settings.train.save_interval = 0;
    settings.model.voxel_factor = 2.5;
    settings.model.offsets = 4;
    let densify = &mut settings.densify;
    (densify.statistics_from, densify.from, densify.until, densify.every) = (500, 1000, 10_000, 500);
    densify.max_anchors = 48;
    (densify.min_slot_visits, densify.min_anchor_visits) = (40, 80);
    settings.model.attention.start = 19_800;

    settings
}

#[derive(Default)]
struct Watch {
    steps: Vec<Progress>,
}

impl Observer for Watch {
    fn step(&mut self, progress: &Progress) {
        if progress.step % 2000 == 0 {
            println!("{progress:?}");
        }
        self.steps.push(progress.clone());
    }
    fn say(&mut self, line: &str) {
        println!("{line}");
    }
}

fn long_run(_: &Gpu) {
    let scene = small();
    let settings = settings();
    let device = std::env::var("GSCREAM_DEVICE").ok();
    // Without the validation layer, under which every pass of this ran in other tests.
    let gpu = Gpu::open(&Options { device, ..Options::default() }).expect("a device");
    let mut run = Run::new(&gpu, &scene, &settings).expect("room");
    println!("{} anchors", run.step().anchors.count);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut watch = Watch::default();
    let started = std::time::Instant::now();
    let summary = run.train(folder.path(), &mut watch).expect("a run");
    println!("{:?} {summary:?}", started.elapsed());
    println!("{}", std::fs::read_to_string(folder.path().join("log.jsonl")).expect("log"));
}

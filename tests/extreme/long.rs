//! Twenty thousand steps of a small scene.

use std::path::PathBuf;

use gscream_vk::config::Settings;
use gscream_vk::gpu::{Gpu, Options};
use gscream_vk::model::files;
use gscream_vk::scene::{self, Scene, synthetic};
use gscream_vk::train::run::{Observer, Progress, Run};

use super::common::skip::{Lack, skip};
use super::{Case, common};

const STEPS: u32 = 20_000;
const MOST_ANCHORS: u32 = 48;

pub const CASES: &[Case] = &[Case {
    stage: "train",
    case: "20,000 steps of a small scene with masks, priors, reference, growing and pruning until step 10,000",
    guarantee: "every loss finite and the last thousand's mean below the first's; never more anchors than allowed; no parameter's largest magnitude, of scales their length, doubles over the last half; device memory the same and the process's within 3 % over the last half",
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
    settings.train.log_interval = 100;
    settings.train.eval_interval = STEPS / 4;
    settings.model.voxel_factor = 2.5;
    settings.model.offsets = 4;
    settings.model.attention.enabled = false; // 98,000 weights in every step: half of the time
    let densify = &mut settings.densify;
    densify.max_anchors = MOST_ANCHORS;
    (densify.statistics_from, densify.from, densify.until, densify.every) = (500, 1000, STEPS / 2, 500);
    (densify.min_slot_visits, densify.min_anchor_visits) = (40, 80);
    settings
}

/// Largest magnitudes of feature, offset, scale and weights. Scales as lengths: where a prior asks for a surface, Gaussians
/// become flat, and the logarithm of their thinnest axis goes on falling; the low-pass keeps them drawn.
fn largest(model: &(files::Anchors, files::Weights)) -> [f32; 4] {
    let of =
        |values: &mut dyn Iterator<Item = f32>| values.fold(0.0f32, |m, v| if v.is_nan() { v } else { m.max(v.abs()) });
    let (anchors, weights) = model;
    [
        of(&mut anchors.feature.as_flattened().iter().copied()),
        of(&mut anchors.offset.iter().copied()),
        of(&mut anchors.log_scaling.as_flattened().iter().map(|s| s.exp())),
        of(&mut weights.tensors.values().flat_map(|t| t.data.iter().copied())),
    ]
}

#[derive(Default)]
struct Watch {
    folder: PathBuf,
    /// Sums of the losses of the first and the last thousand steps.
    loss: [f64; 2],
    anchors: u32,
    changes: usize,
    /// What was saved at half time.
    half: Option<[f32; 4]>,
}

impl Observer for Watch {
    fn step(&mut self, progress: &Progress) {
        assert!(progress.loss.is_finite(), "{progress:?}");
        match progress.step {
            ..=1000 => self.loss[0] += f64::from(progress.loss),
            s if s > STEPS - 1000 => self.loss[1] += f64::from(progress.loss),
            _ => {}
        }
        self.anchors = self.anchors.max(progress.anchors);
        if progress.step == STEPS / 2 + 1 {
            self.half = Some(largest(&files::load(&self.folder.join("model")).expect("it was saved")));
        }
    }
    fn say(&mut self, _: &str) {
        self.changes += 1;
    }
}

/// Set for the process that does nothing else.
const ALONE: &str = "GSCREAM_EXTREME_ALONE";

/// In a process of its own, whose memory is nobody else's.
fn long_run(_: &Gpu) {
    if std::env::var_os(ALONE).is_some() {
        return alone();
    }
    let name = format!("{}: {}", CASES[0].stage, CASES[0].case);
    let output = std::process::Command::new(std::env::current_exe().expect("this program"))
        .args(["--exact", &name, "--test-threads=1", "--include-ignored"])
        .env(ALONE, "1")
        .output()
        .expect("it starts again");
    let [out, err] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    println!("{out}");
    assert!(output.status.success() && out.contains("1 passed"), "{out}{err}");
}

fn alone() {
    let scene = small();
    let settings = settings();
    let device = std::env::var("GSCREAM_DEVICE").ok();
    // Without the validation layer, under which every pass of this runs in other tests.
    let gpu = Gpu::open(&Options { device, ..Options::default() }).expect("a device");
    let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
    let initial = run.step().anchors().count;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut watch = Watch { folder: folder.path().to_owned(), ..Watch::default() };
    let summary = run.train(folder.path(), &mut watch).expect("a run");
    assert_eq!(summary.steps, STEPS);
    assert!(
        watch.changes > 15 && watch.anchors > initial,
        "it grew: {} changes, {} anchors",
        watch.changes,
        watch.anchors
    );
    assert!(watch.anchors <= MOST_ANCHORS, "{} anchors", watch.anchors);
    assert!(watch.loss[1] < 0.5 * watch.loss[0], "losses {:?}", watch.loss);
    let (half, end) = (watch.half.expect("half time"), largest(&run.step().model().expect("read")));
    println!("trained for {:.0} s, losses {:?}, largest {half:?}, {end:?}", summary.seconds, watch.loss);
    for (half, end) in half.iter().zip(end) {
        assert!(end.is_finite() && end < 2.0 * half, "largest magnitudes {half}, {end}");
    }
    for parameter in run.step().parameters() {
        for tensor in parameter.tensors() {
            assert!(gpu.read(tensor).expect("read").iter().all(|v| v.is_finite()), "{}", tensor.name());
        }
    }
    // A line of the log every 100 steps: of the last half, without the first of them, which lets statistics go.
    let log = std::fs::read_to_string(folder.path().join("log.jsonl")).expect("a log");
    let lines: Vec<serde_json::Value> = log.lines().map(|l| serde_json::from_str(l).expect("a line")).collect();
    let last = &lines[lines.len() / 2 + 1..];
    let bytes = |key: &str| -> Vec<f64> { last.iter().filter_map(|line| line[key].as_f64()).collect() };
    let device = bytes("device_bytes");
    assert!(device.len() == last.len() && device.iter().all(|&b| b == device[0]), "device bytes {device:?}");
    let host = bytes("host_bytes");
    if host.is_empty() {
        skip(Lack::ProcessMemory, "this system does not tell a process's memory");
    } else if let (Some(first), Some(most)) = (host.first(), host.iter().copied().reduce(f64::max)) {
        println!("resident memory {first} to {most} bytes");
        assert!(most < 1.03 * first, "resident memory went from {first} to {most}");
    }
}

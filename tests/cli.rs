//! The program as its user meets it: help, results, one clear line for every mistake, exit codes.

use std::fs;
use std::path::Path;

use crate::common::skip::{Lack, skip};
use assert_cmd::Command;
use assert_cmd::cargo::cargo_bin_cmd;
use clap::CommandFactory as _;
use gscream_vk::cli::Arguments;
use gscream_vk::cli::folders::Record;
use gscream_vk::config::Settings;
use gscream_vk::model;
use gscream_vk::scene::synthetic;
use image::{Rgb, RgbImage};
use tempfile::TempDir;

/// The program, run inside `folder` at a fixed width and with a cache of its own, but for what the driver compiles.
fn program(folder: &Path) -> Command {
    let mut command = cargo_bin_cmd!("gscream-vk");
    command
        .current_dir(folder)
        .env("COLUMNS", "100")
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .env("MESA_SHADER_CACHE_DIR", env!("CARGO_TARGET_TMPDIR"))
        .env_remove("RUST_LOG");
    command
}

struct Outcome {
    code: i32,
    stdout: String,
    stderr: String,
}

fn run(folder: &Path, arguments: &str) -> Outcome {
    let output = program(folder).args(arguments.split_whitespace()).output().expect("the program starts");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    Outcome {
        code: output.status.code().expect("the program ends by itself"),
        stdout: text(output.stdout),
        stderr: text(output.stderr),
    }
}

fn succeeds(folder: &Path, arguments: &str) -> Outcome {
    let outcome = run(folder, arguments);
    assert_eq!(outcome.code, 0, "{arguments}: {}", outcome.stderr);
    outcome
}

/// What was typed and what came back: a snapshot that reads like a terminal. Lines of stderr start with `! `.
#[derive(Default)]
struct Transcript(String);

impl Transcript {
    fn run(&mut self, folder: &Path, arguments: &str) -> Outcome {
        let outcome = run(folder, arguments);
        let errors = outcome.stderr.lines().map(|line| format!("! {line}").trim_end().to_owned() + "\n");
        let code = if outcome.code == 0 { String::new() } else { format!("exit code {}\n", outcome.code) };
        self.0 += &format!("$ gscream-vk {arguments}\n{}{}{code}\n", outcome.stdout, errors.collect::<String>());
        outcome
    }

    /// A command that must fail, with this exit code and without a word on stdout.
    fn fails(&mut self, folder: &Path, code: i32, arguments: &str) {
        let outcome = self.run(folder, arguments);
        assert_eq!((outcome.code, outcome.stdout.as_str()), (code, ""), "{arguments}: {}", outcome.stderr);
    }

    fn succeeds(&mut self, folder: &Path, arguments: &str) {
        let outcome = self.run(folder, arguments);
        assert_eq!(outcome.code, 0, "{arguments}: {}", outcome.stderr);
    }
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// A folder with a small scene in `scene/`: 3 train views, 2 test views of 32 x 24.
fn with_scene() -> TempDir {
    let folder = folder();
    let options = synthetic::Options { seed: 3, width: 32, height: 24, train_views: 3, test_views: 2, points: 50 };
    synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
    folder
}

#[test]
fn help_of_every_command() {
    let folder = folder();
    insta::assert_snapshot!("help", succeeds(folder.path(), "--help").stdout);
    let program = Arguments::command();
    for command in program.get_subcommands() {
        let name = command.get_name();
        insta::assert_snapshot!(format!("help_{name}"), succeeds(folder.path(), &format!("{name} --help")).stdout);
        assert!(command.get_after_help().is_some(), "{name} has no example");
    }
    assert_eq!(succeeds(folder.path(), "--version").stdout, format!("gscream-vk {}\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn arguments_that_do_not_parse() {
    let (folder, mut transcript) = (folder(), Transcript::default());
    for arguments in [
        "evaluate",
        "synth",
        "synth scene --width 4",
        "synth scene --train-views 0",
        "synth scene --into photos",
        "synth scene --into photos --stand IMG_0012",
        "synth scene --into photos --stand IMG_0012=1,2 --width 64",
        "eval renders --masks masks",
        "eval renders --truth photographs --downscale 0",
        "render",
        "render run --views side",
    ] {
        transcript.fails(folder.path(), 2, arguments);
    }
    insta::assert_snapshot!("arguments", transcript.0);
    assert!(!folder.path().join("scene").exists(), "nothing was written");
}

#[test]
fn devices_are_listed_as_text_and_as_json() {
    let folder = folder();
    let json = succeeds(folder.path(), "devices --json").stdout;
    let devices: Vec<serde_json::Value> = serde_json::from_str(&json).expect("JSON");
    let text = succeeds(folder.path(), "devices").stdout;
    assert_eq!(text.lines().count(), 4 * devices.len(), "{text}");
    for (device, lines) in devices.iter().zip(text.lines().collect::<Vec<_>>().chunks(4)) {
        let name = device["name"].as_str().expect("a name");
        assert_eq!(lines[0], format!("{}  {name}", device["index"]));
        assert!(lines[1].contains(device["api"].as_str().expect("a version")), "{text}");
        let usable = device["lacks"].as_array().expect("a list").is_empty();
        assert_eq!(lines[3].trim().starts_with("usable"), usable, "{text}");
    }
}

#[test]
fn synth_writes_a_scene_and_never_over_another() {
    let (folder, mut transcript) = (folder(), Transcript::default());
    let arguments = "synth scene --width 32 --height 24 --train-views 3 --test-views 2 --points 50 --seed 3";
    transcript.succeeds(folder.path(), arguments);
    let photograph = |folder: &TempDir| fs::read(folder.path().join("scene/images/train_001.png")).expect("written");
    assert!(photograph(&folder) == photograph(&with_scene()), "the same options give the same files");
    transcript.fails(folder.path(), 1, arguments);
    insta::assert_snapshot!("synth", transcript.0);
}

#[test]
fn eval_of_folders() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    let truth = folder.join("scene/test_images");
    transcript
        .succeeds(folder, "eval scene/test_images --truth scene/test_images --masks scene/test_masks --json same.json");
    insta::assert_snapshot!("eval_json", fs::read_to_string(folder.join("same.json")).expect("the report"));
    // Grey 100 off by 51 is a fifth of the range: 13.98 dB.
    let renders = folder.join("renders");
    fs::create_dir(&renders).expect("a writable folder");
    RgbImage::from_pixel(16, 12, Rgb([151; 3])).save(renders.join("test_001.png")).expect("writable");
    RgbImage::from_pixel(16, 12, Rgb([100; 3])).save(renders.join("stray.png")).expect("writable");
    RgbImage::from_pixel(32, 24, Rgb([100; 3])).save(truth.join("test_001.png")).expect("writable");
    transcript.fails(folder, 1, "eval renders --truth scene/test_images");
    transcript.succeeds(folder, "eval renders --truth scene/test_images --downscale 2");
    assert!(renders.join("metrics.json").is_file());
    insta::assert_snapshot!("eval", transcript.0);
}

#[test]
fn eval_of_a_run() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    let run = folder.join("run");
    fs::create_dir(&run).expect("a writable folder");
    fs::write(run.join("settings.toml"), Settings::default().to_toml()).expect("writable");
    Record::new("none", "scene").write(&run).expect("writable");
    transcript.fails(folder, 1, "eval run");
    let test = run.join("test");
    fs::create_dir(&test).expect("a writable folder");
    fs::copy(folder.join("scene/test_images/test_000.png"), test.join("test_000.png")).expect("writable");
    transcript.fails(folder, 1, "eval run");
    fs::copy(folder.join("scene/test_images/test_001.png"), test.join("test_001.png")).expect("writable");
    transcript.succeeds(folder, "eval run");
    assert!(run.join("metrics.json").is_file());
    insta::assert_snapshot!("eval_run", transcript.0);
}

#[test]
fn eval_of_what_cannot_be_compared() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    transcript.fails(folder, 1, "eval nowhere");
    transcript.fails(folder, 1, "eval nowhere --truth scene/test_images");
    transcript.fails(folder, 1, "eval scene/sparse --truth scene/test_images");
    transcript.fails(folder, 1, "eval scene/images --truth scene/test_images");
    transcript.fails(folder, 1, "eval scene/test_images");
    let broken = folder.join("scene/test_images/test_000.png");
    let whole = fs::read(&broken).expect("a photograph");
    fs::write(&broken, &whole[..whole.len() / 2]).expect("writable");
    transcript.fails(folder, 1, "eval scene/test_images --truth scene/test_images");
    insta::assert_snapshot!("eval_errors", transcript.0);
}

/// A random model of two anchors for the small scene, in a folder of its own.
fn with_model(folder: &Path) {
    let anchors = model::files::Anchors::new(
        10,
        vec![[0.0, 1.0, 0.5], [0.3, 1.2, 0.7]],
        vec![[0.1; model::files::FEATURES]; 2],
        vec![0.05; 2 * 10 * 3],
        vec![[-2.0; 6]; 2],
    );
    let weights = model::init::weights(1, 10, false, 0.0);
    model::files::save(&folder.join("model"), &anchors, &weights).expect("a writable folder");
}

#[test]
fn render_writes_colour_depth_and_transmittance() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    with_model(folder);
    // Left by a killed one.
    let left = folder.join("model/renders/test/.test_001.exr.a1B2c3");
    fs::create_dir_all(left.parent().expect("a folder")).expect("writable");
    fs::write(&left, "half").expect("writable");
    transcript.succeeds(folder, "render model --scene scene --validate");
    assert!(!left.exists(), "what a killed render was writing is swept");
    transcript.succeeds(folder, "render model --scene scene --views train --downscale 2 --out train");
    transcript.succeeds(folder, "render model --scene scene --views spiral --frames 11 --out film");
    insta::assert_snapshot!("render", transcript.0);
    assert!(folder.join("cache/gscream-vk/pipelines-default.bin").is_file(), "compiled kernels are kept");
    let expected = [
        ("model/renders/test", ["test_000", "test_001"].as_slice(), (32, 24)),
        ("train", &["train_000", "train_001", "train_002"], (16, 12)),
        ("film", &["frame_00", "frame_10"], (32, 24)),
    ];
    for (out, names, size) in expected {
        for name in names {
            let picture = image::open(folder.join(out).join(format!("{name}.png"))).expect("a picture");
            assert_eq!((picture.width(), picture.height()), size);
            let file = folder.join(out).join(format!("{name}.exr"));
            let layers = exr::prelude::read_all_flat_layers_from_file(file).expect("an OpenEXR file");
            let layer = &layers.layer_data[0];
            let channels: Vec<String> = layer.channel_data.list.iter().map(|c| c.name.to_string()).collect();
            assert_eq!((layer.size.0, layer.size.1), (size.0 as usize, size.1 as usize));
            assert_eq!(channels, ["T", "Z"]);
            let transmittance: Vec<f32> = layer.channel_data.list[0].sample_data.values_as_f32().collect();
            assert!(transmittance.iter().all(|t| (0.0..=1.0).contains(t)), "a transmittance is a share of light");
            assert!(transmittance.iter().any(|t| *t < 0.99), "{name} shows nothing of the model");
        }
    }
    assert_eq!(fs::read_dir(folder.join("film")).expect("a folder").count(), 22);
}

/// What a machine has is cut away: the list behind the name.
#[test]
fn render_of_what_is_not_there() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    with_model(folder);
    transcript.fails(folder, 1, "render nowhere");
    transcript.fails(folder, 1, "render scene");
    transcript.fails(folder, 1, "render model");
    transcript.fails(folder, 1, "render model --scene nowhere");
    transcript.fails(folder, 2, "render model --scene scene --set render.nearr=1");
    transcript.fails(folder, 2, "render model --scene scene --set render.near=-1");
    transcript.fails(folder, 2, "render model --scene scene --set model.voxels");
    transcript.fails(folder, 2, "render model --scene scene --config nowhere.toml");
    transcript.fails(folder, 1, "render model --scene scene --device abacus");
    fs::remove_dir_all(folder.join("scene/test_images")).expect("writable");
    transcript.fails(folder, 1, "render model --scene scene");
    let cameras = folder.join("scene/sparse/0/images.bin");
    let whole = fs::read(&cameras).expect("a model");
    fs::write(&cameras, &whole[..whole.len() / 2]).expect("writable");
    transcript.fails(folder, 1, "render model --scene scene");
    let weights = folder.join("model/weights.safetensors");
    let whole = fs::read(&weights).expect("weights");
    fs::write(&weights, &whole[..whole.len() / 2]).expect("writable");
    transcript.fails(folder, 1, "render model --scene scene");
    fs::remove_file(weights).expect("writable");
    transcript.fails(folder, 1, "render model --scene scene");
    let listed = |line: &str| line.split_once(" lists them").map(|(start, _)| format!("{start} lists them (...)"));
    let text: Vec<String> = transcript.0.lines().map(|line| listed(line).unwrap_or_else(|| line.to_owned())).collect();
    insta::assert_snapshot!("render_errors", text.join("\n"));
}

/// All files below a folder, sorted, with `/` between names.
fn files_below(folder: &Path) -> Vec<String> {
    let mut names = vec![];
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).expect("a folder") {
            let path = entry.expect("readable").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("below it");
                names.push(name.to_string_lossy().replace(std::path::MAIN_SEPARATOR, "/"));
            }
        }
    }
    names.sort();
    names
}

const FEW_STEPS: &str = "--preset gscream --iterations 4 --set model.voxel=0 --set model.attention.enabled=true --set model.attention.start=2 --set model.attention.patch=16 \
                         --set model.attention.tokens=32 --set model.attention.min_tokens=1 --set train.log_interval=2";

#[test]
fn train_writes_a_run_and_never_over_another() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    let arguments = format!("train scene --out run --validate {FEW_STEPS}");
    let outcome = succeeds(folder, &arguments);
    let expected = [
        "index.html",
        "index/drawn/train_000.jpg",
        "index/drawn/train_001.jpg",
        "index/drawn/train_002.jpg",
        "index/photograph/train_000.jpg",
        "index/photograph/train_001.jpg",
        "index/photograph/train_002.jpg",
        "index/test/test_000.jpg",
        "index/test/test_001.jpg",
        "log.jsonl",
        "metrics.json",
        "model/point_cloud.ply",
        "model/weights.safetensors",
        "run.json",
        "seen/test_000.png",
        "seen/test_001.png",
        "settings.toml",
        "test/test_000.png",
        "test/test_001.png",
    ];
    assert_eq!(files_below(&folder.join("run")), expected);
    let last = outcome.stdout.lines().last().expect("lines");
    assert_eq!(last, "wrote model, log.jsonl, settings.toml, run.json, test, metrics.json, seen, index.html in run");
    assert_eq!(fs::read_to_string(folder.join("run/log.jsonl")).expect("a log").lines().count(), 2);
    let page = fs::read_to_string(folder.join("run/index.html")).expect("a page");
    let sources: Vec<&str> = page.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    assert_eq!(sources.len(), 10, "two test views and three train views, drawn and photographed");
    for source in sources {
        image::open(folder.join("run").join(source)).unwrap_or_else(|error| panic!("{source}: {error}"));
    }
    let without_namespace = page.replace("http://www.w3.org/2000/svg", "");
    assert!(page.contains("Complete: 4 steps") && !without_namespace.contains("http"), "{page}");
    for command in ["gscream-vk export run", "gscream-vk view run", "gscream-vk render --views spiral run"] {
        assert!(outcome.stderr.contains(command), "no {command} in {}", outcome.stderr);
    }
    let model = |run: &str| fs::read(folder.join(run).join("model/point_cloud.ply")).expect("a model");
    let before = model("run");
    transcript.fails(folder, 1, "train scene --out run --preset gscream --iterations 1");
    assert!(model("run") == before, "the refused run left the first alone");

    succeeds(folder, "render run --out drawn");
    assert_eq!(files_below(&folder.join("drawn")).len(), 4, "two pictures, two layers of depth");
    let drawn = image::open(folder.join("drawn/test_000.png")).expect("a picture").to_rgb8();
    let tested = image::open(folder.join("run/test/test_000.png")).expect("a picture").to_rgb8();
    // A model in a file is in the lengths of the scene's files, rounded to float32 once more: a level may flip.
    let same = drawn.as_raw().iter().zip(tested.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 1);
    assert!(drawn.dimensions() == tested.dimensions() && same, "`render` draws what `train` compared");

    succeeds(folder, "train scene --out again --profile --config run/settings.toml");
    assert!(model("again") == before, "the settings that were written repeat the run");
    let trace = fs::read_to_string(folder.join("again/trace.json")).expect("a trace");
    let trace: serde_json::Value = serde_json::from_str(&trace).expect("JSON");
    assert!(trace["traceEvents"].as_array().expect("a list").len() > 50, "the last step's passes");
    succeeds(folder, "train scene --out run --overwrite --iterations 1 --set model.voxel=0");
    assert!(model("run") != before, "--overwrite replaces it");
    insta::assert_snapshot!("train_again", transcript.0);
}

/// On a CPU the defaults would take a day: the preset follows the device and the pictures' size, and what is set wins.
#[test]
#[ignore = "long; .ci/run has it"]
fn train_without_a_preset_says_which_it_takes() {
    let folder = with_scene();
    let folder = folder.path();
    let json = succeeds(folder, "devices --json").stdout;
    let devices: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    let usable = devices.as_array().expect("a list").iter().find(|d| d["lacks"].as_array().is_some_and(Vec::is_empty));
    let cpu = usable.expect("a usable device")["kind"] == "cpu";
    let (preset, voxel_pixels) = if cpu { ("gaussians", 3.3) } else { ("gscream", 0.0) };
    let outcome = succeeds(folder, "train scene --out run --iterations 2");
    assert!(outcome.stderr.contains(&format!("preset: {preset}, for ")), "{}", outcome.stderr);
    let settings = fs::read_to_string(folder.join("run/settings.toml")).expect("settings");
    let settings: Settings = toml::from_str(&settings).expect("settings");
    assert_eq!((settings.train.iterations, settings.scene.downscale), (2, 1), "pictures of 32 x 24 stay as they are");
    assert_eq!(settings.model.voxel_pixels, voxel_pixels);
    // A named preset or a file is all there is.
    for given in ["--preset gscream", "--config run/settings.toml"] {
        let outcome = succeeds(folder, &format!("train scene --out run --overwrite --iterations 1 {given}"));
        assert!(!outcome.stderr.contains("preset:"), "{}", outcome.stderr);
    }
}

/// What a shell and `man` need is made from the same definitions as the help.
#[test]
fn completions_and_manual_pages_know_every_command() {
    let folder = folder();
    let commands: Vec<String> = Arguments::command().get_subcommands().map(|c| c.get_name().to_owned()).collect();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = succeeds(folder.path(), &format!("completions {shell}")).stdout;
        for command in &commands {
            assert!(script.contains(command.as_str()), "no {command} for {shell}");
        }
        assert!(script.contains("checkpoint") || script.contains("resume"), "no flags for {shell}");
    }
    assert_eq!(run(folder.path(), "completions ksh").code, 2);
    succeeds(folder.path(), "man pages/man1");
    let pages = files_below(&folder.path().join("pages/man1"));
    assert_eq!(pages.len(), commands.len() + 1, "{pages:?}");
    for command in &commands {
        let page = folder.path().join(format!("pages/man1/gscream-vk-{command}.1"));
        assert!(fs::read_to_string(page).expect("a page").contains(".SH SYNOPSIS"));
    }
    fs::write(folder.path().join("file"), "").expect("writable");
    assert_eq!(run(folder.path(), "man file").code, 1);
}

/// The ten most likely mistakes: each is one sentence that names the file, what is wrong and what to do.
#[test]
fn the_ten_most_likely_mistakes() {
    let mut transcript = Transcript::default();
    let fresh = || {
        let folder = folder();
        let options = synthetic::Options { seed: 3, width: 96, height: 72, train_views: 6, test_views: 2, points: 400 };
        synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
        folder
    };
    let at = |folder: &TempDir, name: &str| folder.path().join(name);

    transcript.0 += "# the wrong folder\n";
    let folder = fresh();
    transcript.fails(folder.path(), 1, "train scene/images");
    transcript.fails(folder.path(), 1, "train scen");
    transcript.fails(folder.path(), 1, "export scene");

    transcript.0 += "# photographs without COLMAP\n";
    let folder = fresh();
    fs::remove_dir_all(at(&folder, "scene/sparse")).expect("writable");
    transcript.fails(folder.path(), 1, "train scene");

    transcript.0 += "# masks inverted\n";
    let folder = fresh();
    for mask in fs::read_dir(at(&folder, "scene/masks")).expect("a folder") {
        let path = mask.expect("readable").path();
        let mut mask = image::open(&path).expect("a mask").to_luma8();
        mask.pixels_mut().for_each(|p| p.0[0] = 255 - p.0[0]);
        mask.save(&path).expect("writable");
    }
    let outcome = run(folder.path(), "doctor scene");
    assert_eq!(outcome.code, 1);
    let problem = outcome.stdout.lines().find(|line| line.starts_with("problem  masks")).expect("a problem of masks");
    transcript.0 += &format!("$ gscream-vk doctor scene\n{problem}\n\n");
    let outcome = succeeds(folder.path(), "train scene --preset gscream --iterations 1 --set model.voxel=0 --out run");
    let again = outcome.stderr.lines().find(|line| line.starts_with("warning: the masks cover "));
    assert!(again.is_some(), "a warning is said again at the end: {}", outcome.stderr);

    transcript.0 += "# no driver\n";
    let folder = fresh();
    let output = program(folder.path())
        .env("VK_DRIVER_FILES", "/nonexistent")
        .env("VK_ICD_FILENAMES", "/nonexistent")
        .args(["train", "scene"])
        .output()
        .expect("the program starts");
    assert_eq!(output.status.code(), Some(1));
    transcript.0 += &format!("$ gscream-vk train scene\n{}\n", String::from_utf8_lossy(&output.stderr));

    transcript.0 += "# an old driver\n";
    let old = gscream_vk::gpu::Error::Missing { device: "Old Card".into(), feature: "Vulkan 1.3".into() };
    transcript.0 += &format!("error: {old}\n\n");

    transcript.0 += "# another run in the folder\n";
    let folder = fresh();
    fs::create_dir(at(&folder, "run")).expect("writable");
    Record::new("none", "scene").write(&at(&folder, "run")).expect("writable");
    let outcome = run(folder.path(), "train scene --preset demo --out run");
    assert_eq!(outcome.code, 1);
    let last = outcome.stderr.lines().last().expect("a line");
    transcript.0 += &format!("$ gscream-vk train scene --preset demo --out run\n! {last}\nexit code 1\n\n");

    transcript.0 += "# a preset misspelt\n";
    transcript.fails(folder.path(), 2, "train scene --preset lavapip");

    transcript.0 += "# disparity in the folder of depth\n";
    let folder = fresh();
    for map in fs::read_dir(at(&folder, "scene/depth")).expect("a folder") {
        let path = map.expect("readable").path();
        let prior: ndarray::Array2<f32> = ndarray_npy::read_npy(&path).expect("a prior");
        ndarray_npy::write_npy(&path, &prior.mapv(|z| 1.0 / z)).expect("writable");
    }
    let outcome = run(folder.path(), "doctor scene");
    let problems: Vec<&str> = outcome.stdout.lines().filter(|line| line.starts_with("problem  depth")).collect();
    transcript.0 += &format!("$ gscream-vk doctor scene\n{}\n\n", problems.join("\n"));
    let depth = at(&folder, "scene/depth");
    fs::rename(&depth, at(&folder, "scene/depths")).expect("writable");
    let outcome = run(folder.path(), "doctor scene");
    let unread: Vec<&str> = outcome.stdout.lines().filter(|line| line.contains("is not read")).collect();
    transcript.0 += &format!("$ gscream-vk doctor scene\n{}\n\n", unread.join("\n"));
    fs::rename(at(&folder, "scene/depths"), &depth).expect("writable");
    fs::create_dir(at(&folder, "scene/disparity")).expect("writable");
    transcript.fails(folder.path(), 1, "train scene");

    transcript.0 += "# photographs renamed\n";
    let folder = fresh();
    for (i, name) in files_below(&at(&folder, "scene/images")).into_iter().enumerate() {
        let images = at(&folder, "scene/images");
        fs::rename(images.join(name), images.join(format!("DSC_{i:04}.png"))).expect("writable");
    }
    fs::remove_dir_all(at(&folder, "scene/test_images")).expect("writable");
    fs::remove_dir_all(at(&folder, "scene/reference")).expect("writable");
    transcript.fails(folder.path(), 1, "train scene");

    insta::assert_snapshot!("mistakes", transcript.0);
}

/// The tenth mistake, which not every driver survives: files of at most 64 blocks, so that the system refuses a write as a
/// full disk does.
#[cfg(unix)]
#[test]
#[ignore = "long; .ci/run has it"]
fn without_room_on_the_disk_it_is_said_which_file_and_how_to_go_on() {
    use std::os::unix::process::ExitStatusExt as _;
    let folder = with_scene();
    let mut limited = std::process::Command::new("sh");
    limited.args(["-c", "trap '' XFSZ; ulimit -f 64; exec \"$0\" $1"]).arg(env!("CARGO_BIN_EXE_gscream-vk"));
    limited.arg(format!("train scene --out run --set train.checkpoint_interval=2 {FEW_STEPS}"));
    limited.current_dir(folder.path()).env("XDG_CACHE_HOME", folder.path().join("cache"));
    let output = limited.output().expect("a shell");
    if output.status.signal() == Some(signal_hook::consts::SIGBUS) {
        skip(Lack::MemoryWithoutFiles, "to this driver a limit of files is one of device memory, and ends the program");
        return;
    }
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&output.stderr);
    let last = stderr.lines().last().expect("a line");
    for part in [
        "error: run/checkpoints/step-00000002.safetensors: the checkpoint cannot be written: File too large",
        "make room",
    ] {
        assert!(last.contains(part), "no {part:?} in {stderr}");
    }
}

#[test]
fn train_of_what_makes_no_sense_writes_nothing() {
    let (folder, mut transcript) = (with_scene(), Transcript::default());
    let folder = folder.path();
    let mut refused = |code, arguments: &str| {
        for command in ["train", "plan", "verify"] {
            let out = if command == "train" { " --out run" } else { "" };
            let arguments = format!("{command} {arguments}{out}");
            if command == "train" {
                transcript.fails(folder, code, &arguments);
                let errors = transcript.0.lines().rev().take_while(|line| !line.starts_with('$'));
                assert_eq!(errors.filter(|line| line.starts_with("! error")).count(), 1, "{arguments}");
            } else {
                let outcome = run(folder, &arguments);
                assert_eq!((outcome.code, outcome.stdout.as_str()), (code, ""), "{arguments}: {}", outcome.stderr);
            }
            assert!(!folder.join("run").exists(), "{arguments} left something behind");
        }
    };
    refused(2, "scene --set train.iteration=5");
    refused(2, "scene --set train.iterations=many");
    refused(2, "scene --set densify.until=3");
    refused(1, "nowhere");
    let points = folder.join("scene/sparse/0/points3D.bin");
    let whole = fs::read(&points).expect("a model");
    fs::write(&points, &whole[..whole.len() / 2]).expect("writable");
    refused(1, "scene");
    fs::write(&points, &whole).expect("writable");
    let mask = folder.join("scene/masks/train_001.png");
    image::GrayImage::new(31, 24).save(&mask).expect("writable");
    refused(1, "scene");
    fs::write(&mask, "no picture").expect("writable");
    refused(1, "scene");
    insta::assert_snapshot!("train_errors", transcript.0);
}

#[test]
#[ignore = "long; .ci/run has it"]
fn plan_and_verify_of_a_scene() {
    let folder = with_scene();
    let folder = folder.path();
    let few = FEW_STEPS;
    let plan = succeeds(folder, &format!("plan scene --step 2 --validate {few}")).stdout;
    for part in ["step 2 (view ", "\nleft out\n", "\nbuffers\n", "    barrier: ", "model/attention_blend_gather  <"] {
        assert!(plan.contains(part), "no {part:?} in {plan}");
    }
    let json = succeeds(folder, &format!("plan scene --step 2 --measure 2 --json --validate {few}")).stdout;
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["memory"]["fits"], true, "{json:#}");
    assert_eq!(json["stages"].as_array().map(Vec::len), Some(gscream_vk::stage::ALL.len()));
    let measured = &json["measured"];
    assert!(measured["ms"].as_f64().is_some_and(|ms| ms > 0.0), "{measured:#}");
    assert_eq!(measured["passes"], json["step"]["passes"], "the step as rehearsed and as run");
    let tight = succeeds(folder, &format!("plan scene --memory 1 {few}")).stdout;
    assert!(tight.contains("does not fit") && tight.contains("1 MiB are free"), "{tight}");
    let verify = succeeds(folder, &format!("verify scene --warm-up 2 --validate {few}")).stdout;
    assert!(verify.starts_with("step 3, view "), "{verify}");
    let last = verify.lines().last().expect("lines");
    assert!(last.ends_with(" tensors compared, 0 beyond their bound"), "{last}");
    assert!(verify.contains("model/attention_blend_gather "), "{verify}");
    // A step before the attention's, although the warm-up went past it.
    let early = succeeds(folder, &format!("verify scene --warm-up 3 --step 1 {few}")).stdout;
    assert!(early.starts_with("step 1, view ") && !early.contains("model/attention"), "{early}");
}

/// A clean test view as the reference, and what its run is judged by, now and later.
#[test]
#[ignore = "long; .ci/run has it"]
fn a_run_with_the_truth_as_reference_is_judged_and_judged_again() {
    let folder = with_scene();
    let folder = folder.path();
    succeeds(folder, &format!("train scene --out run --truth-reference test_000 --validate {FEW_STEPS}"));
    let read = |name: &str| -> serde_json::Value {
        serde_json::from_str(&fs::read_to_string(folder.join(name)).expect("written")).expect("JSON")
    };
    let trained = read("run/metrics.json");
    assert_eq!(trained["views"].as_array().map(Vec::len), Some(1), "the other test view");
    assert_eq!(trained["views"][0]["name"], "test_001");
    for key in ["outside", "rim", "full_seen", "geometry", "seen_share"] {
        assert!(!trained["mean"][key].is_null(), "{key}: {trained:#}");
    }
    assert!(trained["mean"].get("lpips").is_none() && trained["mean"].get("fid").is_none(), "absent without weights");
    let outcome = succeeds(folder, "eval run --json again.json --validate");
    assert_eq!(read("again.json"), trained, "the same device draws the same pictures");
    for part in ["outside mask", "mask's rim", "seen pixels", "depth inside the mask: off by", "protocol plain: "] {
        assert!(outcome.stdout.contains(part), "no {part:?} in {}", outcome.stdout);
    }
    // Stored pictures know what was seen, but neither depth nor the train views.
    succeeds(folder, "eval run --pictures --json stored.json");
    let stored = read("stored.json");
    // Drawn before the model was written, whose scales are rounded once more in the units of the scene's files.
    let psnr = |report: &serde_json::Value| report["mean"]["outside_seen"]["psnr"].as_f64().expect("a number");
    assert!((psnr(&stored) - psnr(&trained)).abs() < 1e-3, "{} {}", psnr(&stored), psnr(&trained));
    assert!(stored["mean"].get("geometry").is_none() && stored.get("residues").is_none());
    // Depth maps in another unit, in a folder of the user's.
    fs::create_dir(folder.join("millimetres")).expect("writable");
    let path = folder.join("scene/test_depth/test_001.npy");
    let depth: ndarray::Array2<f32> = ndarray_npy::read_npy(path).expect("a depth map");
    ndarray_npy::write_npy(folder.join("millimetres/test_001.npy"), &(&depth * 1000.0)).expect("writable");
    let figures = |unit: &str| {
        succeeds(folder, &format!("eval run --depth-truth {unit} --json {unit}.json"));
        read(&format!("{unit}.json"))
    };
    let millimetres = figures("millimetres");
    // The same truth in the scene's unit as the maps outside the masks say it is.
    let factor = millimetres["depth_factor"].as_f64().expect("another unit");
    assert!((0.2e-3..5e-3).contains(&factor), "{factor} scene units in a millimetre");
    fs::create_dir(folder.join("units")).expect("writable");
    ndarray_npy::write_npy(folder.join("units/test_001.npy"), &(depth * (1000.0 * factor) as f32)).expect("writable");
    let units = figures("units");
    assert!(units["depth_factor"].is_null(), "{units:#}");
    for figure in ["relative_error", "completeness"] {
        let value = |report: &serde_json::Value| report["mean"]["geometry"][figure].as_f64().expect("a figure");
        // Float32 depths times a factor: roundings of 6e-8 each.
        let (units, millimetres) = (value(&units), value(&millimetres));
        assert!((units - millimetres).abs() <= 1e-5 * units.abs(), "{figure}: {units}, of millimetres {millimetres}");
    }

    for (code, arguments, part) in [
        (1, "train scene --out other --truth-reference nobody", "but scene has no such test view (2 of them: test_000"),
        (2, "train scene --out other --truth-prior none", "--truth-reference <NAME>"),
        (1, "eval run --depth-truth nowhere", "nowhere: there is no such folder"),
        (1, "eval run --depth-truth scene/masks", "no depth map has the name of a test view (like test_001)"),
        (1, "eval run --lpips-weights scene/images/train_000.png", "not a safetensors file"),
        (1, "eval run --fid-weights gone.safetensors", "gone.safetensors: "),
        (2, "eval run --protocol spin", "invalid value 'spin' for '--protocol <NAME>'"),
    ] {
        let outcome = run(folder, arguments);
        assert_eq!(outcome.code, code, "{arguments}: {}", outcome.stderr);
        assert!(outcome.stderr.contains(part), "{arguments}: {}", outcome.stderr);
    }
}

#[test]
#[ignore = "long; .ci/run has it"]
fn ablate_compares_over_seeds_and_scenes() {
    let folder = with_scene();
    let folder = folder.path();
    let options = synthetic::Options { seed: 4, width: 32, height: 24, train_views: 3, test_views: 1, points: 50 };
    synthetic::write(&folder.join("other"), &options).expect("a writable folder");
    let few = FEW_STEPS.replace("--iterations 4", "--iterations 2");
    let command = "ablate scene other --out runs --seeds 2 --only neither,priors-same --priors same=depth --validate";
    let outcome = succeeds(folder, &format!("{command} {few}"));
    for run in ["scene/neither/seed-0", "scene/priors-same/seed-1", "other/neither/seed-1"] {
        assert!(folder.join("runs").join(run).join("metrics.json").is_file(), "{run}");
    }
    for part in
        ["| variant | PSNR | masked PSNR | SSIM |", "| priors-same - neither | ", "(p ", "| SPIn-NeRF | 20.18 |"]
    {
        assert!(outcome.stdout.contains(part), "no {part:?} in {}", outcome.stdout);
    }
    let read = |name: &str| -> serde_json::Value {
        serde_json::from_str(&fs::read_to_string(folder.join("runs").join(name)).expect("written")).expect("JSON")
    };
    assert_eq!(read("ablation.json").as_array().map(Vec::len), Some(8), "two variants, scenes and seeds");
    let comparison = read("comparison.json");
    assert_eq!(comparison["seeds"], serde_json::json!([0, 1]));
    let psnr = &comparison["variants"][0]["figures"]["psnr"];
    assert!(psnr["mean"].is_f64() && psnr["deviation"].is_f64(), "{comparison:#}");
    assert!(comparison["differences"][0]["figures"]["psnr"]["p"].is_f64());

    // Stopped before its last run, and asked again: only that is trained, and all comes to the same.
    let runs = folder.join("runs");
    let mut kept = read("ablation.json");
    kept.as_array_mut().expect("rows").pop();
    fs::write(runs.join("ablation.json"), kept.to_string()).expect("a writable folder");
    fs::remove_dir_all(runs.join("other/priors-same/seed-1")).expect("the last run");
    let again = succeeds(folder, &format!("{command} {few} --resume"));
    assert_eq!(again.stderr.lines().filter(|line| line.starts_with("== ")).count(), 1, "{}", again.stderr);
    assert!(again.stderr.contains("== other, priors-same, seed 1 8 of 8"), "{}", again.stderr);
    // Numbers read from JSON may differ in their last bit.
    for figure in ["psnr", "masked_ssim", "seconds"] {
        let mean = |comparison: &serde_json::Value| comparison["variants"][0]["figures"][figure]["mean"].as_f64();
        let (was, is) = (mean(&comparison).expect("a number"), mean(&read("comparison.json")).expect("a number"));
        assert!((is / was - 1.0).abs() < 1e-12, "{figure}: taken as it is: {was}, {is}");
    }
    // A part of the variants asked for again: the others' runs stay known.
    let part = command.replace("neither,priors-same", "neither");
    succeeds(folder, &format!("{part} {few} --resume"));
    assert_eq!(read("ablation.json").as_array().map(Vec::len), Some(8), "no run is forgotten");
    // Without --resume nothing is replaced, neither a run nor the table.
    let bytes = || {
        let of = |name| fs::read(runs.join(name)).expect("written");
        ["ablation.json", "comparison.json", "scene/neither/seed-0/log.jsonl", "scene/neither/seed-0/run.json"].map(of)
    };
    let before = bytes();
    let held = run(folder, &format!("{part} {few}"));
    let says = "error: runs/scene/neither/seed-0: holds a run already: choose another --out, go on with the ablation by \
                --resume, or replace its runs by --overwrite\n";
    assert_eq!((held.code, held.stderr.as_str()), (1, says));
    assert!(bytes() == before, "nothing is touched");
    // Replaced on demand, and the runs of the other variant stay known.
    succeeds(folder, &format!("{part} {few} --overwrite"));
    assert!(bytes()[2] != before[2], "its log has other times");
    assert_eq!(read("ablation.json").as_array().map(Vec::len), Some(8), "no run is forgotten");
    let other = run(folder, &format!("{command} {few} --resume --set losses.ssim_weight=0.1"));
    assert!(other.code == 1 && other.stderr.contains("other settings"), "{}", other.stderr);

    let one = succeeds(folder, &format!("ablate scene --out one --only neither {few}"));
    assert!(folder.join("one/neither/run.json").is_file() && !one.stdout.contains('±'), "{}", one.stdout);
    let last = run(folder, "ablate scene --out last --seed 9223372036854775807 --seeds 2");
    let says = "error: --seeds 2: the last seed after train.seed = 9223372036854775807 would be above";
    assert!(last.code == 1 && last.stderr.starts_with(says), "{}", last.stderr);
    let refused = run(folder, "ablate scene --only all");
    assert_eq!(refused.code, 1, "{}", refused.stderr);
}

/// As in `gscream-vk completions bash | head -1`.
#[cfg(unix)]
#[test]
fn a_reader_that_goes_is_no_error() {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    let mut program = std::process::Command::new(assert_cmd::cargo::cargo_bin!("gscream-vk"));
    let output = program.args(["completions", "bash"]).stdout(writer).output().expect("the program ends");
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
    assert!(!output.status.success(), "the reader was gone before anything was written");
}

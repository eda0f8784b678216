//! `gscream-vk remove`: by files alone, and on its page in a browser.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::common::skip::{Lack, skip};
use assert_cmd::cargo::cargo_bin;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use gscream_vk::scene::synthetic;
use serde_json::Value;
use tempfile::TempDir;

const VIEWER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/viewer");
/// A training of seconds.
const SHORT: &str = "--preset demo --iterations 30 --fit-steps 150 --export-steps 10 --set train.eval_interval=0";

/// Photographs with their cameras in `photos/`, and their true masks in `truth/`.
fn photographs() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = synthetic::Options { width: 160, height: 120, train_views: 10, test_views: 0, points: 1500, seed: 2 };
    synthetic::write(&folder.path().join("all"), &options).expect("a writable folder");
    fs::create_dir(folder.path().join("photos")).expect("writable");
    for (from, to) in [("all/images", "photos/images"), ("all/sparse", "photos/sparse"), ("all/masks", "truth")] {
        fs::rename(folder.path().join(from), folder.path().join(to)).expect("a scene");
    }
    folder
}

fn program(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(cargo_bin!("gscream-vk"));
    command.args(arguments.split_whitespace()).current_dir(folder);
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR")).env_remove("RUST_LOG");
    command
}

fn names(folder: &Path) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> =
        fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("a file").path()).collect();
    all.sort();
    all
}

/// One command from photographs and a mask to files; the same again does nothing; another seed trains again.
#[test]
fn one_command_removes_an_object_and_is_not_repeated() {
    let folder = photographs();
    let folder = folder.path();
    let mask = names(&folder.join("truth"))[4].clone();
    let name = mask.file_stem().expect("a name").to_string_lossy().into_owned();
    let command = format!("remove photos --mask {name}={} --yes {SHORT}", mask.display());
    let run = |command: &str| {
        let output = program(folder, command).output().expect("the program starts");
        let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        assert!(output.status.success(), "{err}");
        (out, err)
    };
    // A photograph without a camera, which everybody who reads the scene has something to say about.
    let copied = fs::copy(&names(&folder.join("photos/images"))[0], folder.join("photos/images/strayed.png"));
    copied.expect("writable");
    let (said, notes) = run(&command);
    assert!(said.contains("photos-removed: the object is gone"), "{said}");
    assert_eq!(notes.lines().filter(|line| line.contains("strayed")).count(), 1, "{notes}");
    let out = folder.join("photos-removed");
    for file in ["scene.ply", "scene.spz", "scene.glb", "export.json", "run/run.json", "scene/prepare.json"] {
        assert!(out.join(file).is_file(), "{file}");
    }
    let made = fs::metadata(out.join("scene.ply")).and_then(|file| file.modified()).expect("a file");
    let (_, said) = run(&command);
    assert!(said.contains("train: nothing has changed") && said.contains("export: nothing has changed"), "{said}");
    assert_eq!(fs::metadata(out.join("scene.ply")).and_then(|file| file.modified()).expect("a file"), made);
    let (_, said) = run(&format!("{command} --seed 5"));
    assert!(said.contains("trained again"), "{said}");
    // What ended before the earlier run was replaced is not taken for done, nor gone on with under the earlier settings.
    let [log, settings] = ["log.jsonl", "settings.toml"].map(|name| out.join("run").join(name));
    fs::remove_file(&log).and_then(|()| fs::create_dir(&log)).expect("writable");
    let output = program(folder, &format!("{command} --seed 7")).output().expect("it starts");
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot be removed"), "{output:?}");
    fs::remove_dir(&log).expect("writable");
    let (_, said) = run(&format!("{command} --seed 7"));
    let trained = fs::read_to_string(settings).expect("settings");
    assert!(said.contains("trained again") && trained.contains("seed = 7"), "{said}");
    fs::remove_dir_all(out.join("run/model")).expect("a model");
    let (_, said) = run(&format!("{command} --seed 7"));
    assert!(said.contains("the model of the run is gone; trained again"), "{said}");
    // A file of the user's under an export's name stays.
    fs::write(out.join("scene.glb"), "mine").expect("writable");
    let output = program(folder, &format!("{command} --seed 7")).output().expect("it starts");
    assert!(String::from_utf8_lossy(&output.stderr).contains("is not as an export left it"), "{output:?}");
    assert_eq!(fs::read(out.join("scene.glb")).expect("a file"), b"mine");
    fs::remove_file(out.join("scene.glb")).expect("writable");
    // With a limit the plan is said first; the least is named where it is too little; a moment is enough for what is left.
    let within = |minutes: &str| {
        let settings = "--preset demo --fit-steps 150 --export-steps 10 --set train.eval_interval=0 --seed 6";
        format!("remove photos --mask {name}={} --yes {settings} --minutes {minutes}", mask.display())
    };
    let output = program(folder, &within("0.01")).output().expect("it starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("error: --minutes 0.01: about "), "{said}");
    assert!(said.contains("min are the least") && !said.contains("plan:"), "{said}");
    // A machine that is busy refuses what it does otherwise, and names the least: it is given twice that.
    let mut minutes = 0.8;
    let said = loop {
        let output = program(folder, &within(&minutes.to_string())).output().expect("it starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        if output.status.success() {
            break said;
        }
        let refusal = said.lines().find_map(|line| line.strip_prefix(&format!("error: --minutes {minutes}: ")));
        let words = refusal.unwrap_or_else(|| panic!("{said}")).split_whitespace();
        let least: f64 = words.filter_map(|word| word.parse().ok()).next().expect("the least is named");
        assert!(least > minutes && least < 10.0, "{said}");
        minutes = 2.0 * least;
    };
    let at = |what: &str| said.find(what).unwrap_or_else(|| panic!("no {what}: {said}"));
    assert!(at(&format!("plan: of {minutes} min")) < at("masks: nothing has changed"), "{said}");
    assert!(at("min have gone, and ") < at("are kept for the files"), "{said}");
    // What it made can be looked at, with a photograph.
    let (said, notes) = run("view photos-removed --html page.html");
    assert!(said.contains("page.html") && !notes.contains("without a photograph"), "{notes}");
    // Without an object there is nothing to do.
    let output = program(folder, &format!("remove photos --out other --yes {SHORT}")).output().expect("it starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("what is to be removed?"), "{said}");
}

fn chromium() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let all = ["chromium", "chromium-browser", "google-chrome"];
    let found = std::env::split_paths(&path).flat_map(|folder| all.map(|name| folder.join(name))).find(|p| p.is_file());
    if found.is_none() {
        skip(Lack::Browser, "no Chromium: install Debian's package `chromium`");
    }
    found
}

/// Where the object is in the middle photograph, which the page shows first: its middle and two places beside it.
fn clicks(folder: &Path) -> Vec<String> {
    let all = names(&folder.join("truth"));
    let mask = image::open(&all[all.len() / 2]).expect("a mask").to_luma8();
    let on: Vec<[f64; 2]> = mask
        .enumerate_pixels()
        .filter(|(_, _, v)| v.0[0] != 0)
        .map(|(x, y, _)| {
            [(f64::from(x) + 0.5) / f64::from(mask.width()), (f64::from(y) + 0.5) / f64::from(mask.height())]
        })
        .collect();
    let mean: [f64; 2] = std::array::from_fn(|k| on.iter().map(|p| p[k]).sum::<f64>() / on.len() as f64);
    // A ball on a post, of other colours: something of each.
    let [high, low] = [on.iter().map(|p| p[1]).fold(1.0, f64::min), on.iter().map(|p| p[1]).fold(0.0, f64::max)];
    let down = |part: f64| [mean[0], high + part * (low - high)];
    [down(0.3), down(0.9), down(0.7)].map(|[x, y]| format!("{x:.4},{y:.4}")).to_vec()
}

/// What a script of `tests/viewer` says that visits the page of photographs in this folder, with what is made in `out`; nothing
/// where there is no browser.
fn visited(folder: &Path, script: &str, arguments: &[String]) -> Option<Value> {
    let there = Path::new(VIEWER).join("node_modules/puppeteer-core").is_dir();
    if !there {
        skip(Lack::Node, "puppeteer-core is not installed: run `npm ci --ignore-scripts` in tests/viewer");
        return None;
    }
    let chromium = chromium()?;
    let mut server = program(folder, &format!("remove photos --out out --no-open --port 0 {SHORT}"))
        .stdout(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut line = String::new();
    // Kept open: a program whose output nobody takes any more ends.
    let mut said = BufReader::new(server.stdout.take().expect("piped"));
    said.read_line(&mut line).expect("its first line");
    let url = line.split_whitespace().next().expect("an address").to_owned();
    let pictures = std::env::var_os("GSCREAM_KEEP").map_or_else(|| folder.to_owned(), PathBuf::from);
    let output = Command::new("node")
        .arg(script)
        .args([chromium.to_string_lossy().into_owned(), url, pictures.to_string_lossy().into_owned()])
        .args(arguments)
        .current_dir(VIEWER)
        .output()
        .expect("node starts");
    server.kill().expect("it serves until it is stopped");
    server.wait().expect("it is gone");
    drop(said);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
}

#[test]
fn an_object_is_removed_on_the_page() {
    let folder = photographs();
    let folder = folder.path();
    let Some(found) = visited(folder, "remove.mjs", &clicks(folder)) else { return };
    println!("{}, {}", found["shares"], found["files"]);
    let truth = |name: &Value| {
        let name = name.as_str().expect("a name");
        let mask = image::open(folder.join(format!("truth/{name}.png"))).expect("a mask").to_luma8();
        mask.as_raw().iter().filter(|v| **v != 0).count() as f64 / mask.as_raw().len() as f64
    };
    for (view, share) in [("marked", 0), ("other", 1)] {
        let (share, truth) = (found["shares"][share].as_f64().expect("a share"), truth(&found[view]));
        assert!(share > 0.6 * truth && share < 1.6 * truth, "{view}: {share} of {truth}");
    }
    let files: Vec<(String, u64)> = serde_json::from_value(found["files"].clone()).expect("names and sizes");
    assert_eq!(files.len(), 3);
    for (name, bytes) in files {
        let own = name.strip_prefix("photos-").expect("the photographs' folder");
        assert_eq!(fs::metadata(folder.join("out").join(own)).expect(own).len(), bytes);
    }
    // What was compared is the trained model, from where the photographs were taken.
    let rendered = program(folder, "render out/run --views train --out drawn").output().expect("the program starts");
    assert!(rendered.status.success(), "{}", String::from_utf8_lossy(&rendered.stderr));
    let compared: Vec<(String, String)> =
        serde_json::from_value(found["compared"].clone()).expect("names and pictures");
    assert!(compared.len() == 2 && compared[0].0 != compared[1].0);
    for (name, jpeg) in &compared {
        let shown =
            image::load_from_memory(&BASE64_STANDARD.decode(jpeg).expect("base64")).expect("a picture").to_rgb8();
        let drawn = image::open(folder.join(format!("drawn/{name}.png"))).expect("a picture").to_rgb8();
        assert_eq!(shown.dimensions(), drawn.dimensions());
        let off: f64 = shown.as_raw().iter().zip(drawn.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        assert!(off / (shown.as_raw().len() as f64) < 4.0, "{name}: {off}");
    }
    // What was clicked is there for the form without a browser.
    assert_eq!(names(&folder.join("out/objects")).len(), 2);
}

/// Of the built-in scene's ball and of its stand, where they are in a photograph.
fn parts(folder: &Path, view: &str) -> [Vec<bool>; 2] {
    let open = |path: String| image::open(folder.join(path)).expect("a picture");
    let [mask, picture] = [format!("truth/{view}.png"), format!("photos/images/{view}.png")].map(open);
    let parts = crate::photographs::parts(&mask.to_luma8(), &picture.to_rgb8());
    parts.map(|part| part.as_raw().iter().map(|v| *v != 0).collect())
}

/// The ball is marked in one photograph and its stand in another, each as an object: the stand goes, and then both.
#[test]
fn objects_are_removed_one_by_one_on_the_page() {
    let folder = photographs();
    let folder = folder.path();
    let views: Vec<String> = names(&folder.join("truth"))
        .iter()
        .map(|path| path.file_stem().expect("a name").to_string_lossy().into_owned())
        .collect();
    // The box around a part, of the photograph's sides.
    let around = |view: &str, part: usize| {
        let on = &parts(folder, view)[part];
        let all = || (0..on.len()).filter(|i| on[*i]).map(|i| [i % 160, i / 160]);
        let least = |axis: usize| all().map(|at| at[axis]).min().expect("a part of the object");
        let most = |axis: usize| all().map(|at| at[axis] + 1).max().expect("a part of the object");
        let sides = [(least(0), 160.0), (least(1), 120.0), (most(0), 160.0), (most(1), 120.0)];
        sides.map(|(at, side)| format!("{:.4}", at as f64 / side)).join(",")
    };
    let [ball, stand] = [&views[3], &views[6]];
    let arguments = ["out/scene/masks".to_owned(), ball.clone(), around(ball, 0), stand.clone(), around(stand, 1)];
    let scene = folder.join(&arguments[0]);
    let arguments = [&[scene.to_string_lossy().into_owned()], &arguments[1..]].concat();
    let Some(found) = visited(folder, "objects.mjs", &arguments) else { return };
    let pictures = std::env::var_os("GSCREAM_KEEP").map_or_else(|| folder.to_owned(), PathBuf::from);
    // Which parts of ball and stand the masks of a removal have, over all views.
    let has = |masks: &Path| -> [f64; 2] {
        let sums = views.iter().fold([[0.0; 2]; 2], |sums: [[f64; 2]; 2], view| {
            let mask = image::open(masks.join(format!("{view}.png"))).expect("a mask").to_luma8();
            let parts = parts(folder, view);
            std::array::from_fn(|part| {
                let on = parts[part].iter().zip(mask.pixels()).filter(|(on, _)| **on);
                let [all, had] =
                    on.fold([0.0, 0.0], |[all, had], (_, v)| [all + 1.0, had + f64::from(u8::from(v.0[0] != 0))]);
                [sums[part][0] + all, sums[part][1] + had]
            })
        });
        sums.map(|[all, had]| had / all)
    };
    let [one, both] = [has(&pictures.join("masks")), has(&scene)];
    println!("the first removal has {one:.2?} of ball and stand, the second {both:.2?}; {found}");
    assert!(one[0] < 0.3 && one[1] > 0.75 && both.iter().all(|part| *part > 0.8), "{one:?} {both:?}");
    // Each was in its own colour in all photographs before.
    for (view, shares) in found.as_object().expect("views") {
        for (part, share) in parts(folder, view).iter().zip(shares.as_array().expect("objects")) {
            let truth = part.iter().filter(|on| **on).count() as f64 / part.len() as f64;
            let share = share.as_f64().unwrap_or(0.0);
            assert!(share > 0.5 * truth && share < 1.7 * truth, "{view}: {share} of {truth}");
        }
    }
    let list: Value =
        serde_json::from_slice(&fs::read(folder.join("out/objects.json")).expect("a list")).expect("JSON");
    assert_eq!(list[1], serde_json::json!({ "number": 2, "name": "stand", "remove": true }));
    assert_eq!((names(&folder.join("out/objects")).len(), names(&folder.join("out/objects-2")).len()), (2, 2));
    // The form without a browser takes both as well.
    let output = program(folder, &format!("remove photos --out out --yes {SHORT}")).output().expect("it starts");
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(out.contains("out: Object 1 and stand are gone"), "{out}");
    assert!(err.contains("masks: nothing has changed") && err.contains("train: nothing has changed"), "{err}");
}

//! `bench` as its user meets it: a step pass by pass, a record, and a comparison with an older one.

use crate::common;
use std::fs;
use std::path::Path;
use std::process::Output;

use assert_cmd::cargo::cargo_bin_cmd;
use gscream_vk::gpu::form::without_form;
use serde_json::Value;

const FEW: &str = "--set model.voxel=0 --set model.attention.enabled=true --set model.attention.start=2 --set model.attention.patch=24 \
                   --set model.attention.tokens=32 --set model.attention.min_tokens=1 --set densify.statistics_from=1 \
                   --set densify.from=2 --set densify.every=2 --set densify.until=9 --iterations 20";

fn bench(folder: &Path, arguments: &str) -> Output {
    let mut command = cargo_bin_cmd!("gscream-vk");
    command
        .current_dir(folder)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .env("MESA_SHADER_CACHE_DIR", env!("CARGO_TARGET_TMPDIR"))
        .env_remove("RUST_LOG");
    command.arg("bench").args(arguments.split_whitespace()).output().expect("the program starts")
}

fn succeeds(folder: &Path, arguments: &str) -> String {
    let output = bench(folder, &format!("{arguments} {FEW}"));
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

fn fails(folder: &Path, arguments: &str) -> String {
    let output = bench(folder, &format!("{arguments} {FEW}"));
    assert!(!output.status.success() && output.stdout.is_empty(), "{arguments} went well");
    let stderr = String::from_utf8(output.stderr).expect("UTF-8");
    stderr.lines().find(|line| line.starts_with("error: ")).expect("an error in one line").to_owned()
}

fn json(path: &Path) -> Value {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).expect("JSON")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// Plain Gaussians, the first steps of which see smaller pictures than the measured one.
#[test]
fn a_step_of_plain_gaussians_is_measured() {
    let scene = common::folder();
    let folder = scene.path();
    let few = "--preset gaussians --set train.coarse.until=3 --iterations 20";
    let output =
        bench(folder, &format!("scene {few} --warm-up 5 --views 2 --repetitions 1 --predict published --out it"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let record = json(&folder.join("it/bench.json"));
    let passes = record["step"]["passes"].as_array().expect("passes");
    for pass in passes {
        assert!(pass["work"].is_object(), "{} has no formula in src/lab/bench/cost.rs", pass["pass"]);
    }
    let has = |name: &str| passes.iter().any(|pass| pass["pass"] == name);
    for name in ["render/activate", "render/activate_backward", "optimizer/adam", "primitives/sort_scatter"] {
        assert!(has(name), "{name} is missing");
    }
    let count = |name: &str| number(&record["step"]["counts"][name]);
    assert_eq!((count("pixels"), count("offsets"), count("harmonics")), (48.0 * 36.0, 1.0, 4.0));
    assert!(count("gaussians") <= count("anchors") && count("drawn") <= count("gaussians") && count("drawn") > 0.0);
    let predicted = record["predictions"].as_array().expect("predictions");
    assert_eq!(predicted.len(), 5);
}

#[test]
#[ignore = "long; .ci/run has it"]
fn a_step_is_measured_and_compared() {
    let scene = common::folder();
    let folder = scene.path();
    let measured = "scene --warm-up 5 --views 2 --repetitions 3 --validate";
    let stdout = succeeds(folder, &format!("{measured} --out first"));
    let record = json(&folder.join("first/bench.json"));

    let ceilings = record["ceilings"].as_object().expect("ceilings");
    assert_eq!(ceilings.len(), 8);
    assert!(ceilings.values().all(|c| number(&c["median"]) >= 0.0 && c["repetitions"] == 3));

    // With everything on there is no pass without a formula, and nothing of a step is missing.
    let step = &record["step"];
    assert_eq!((number(&step["step"]), step["views"].as_array().map(Vec::len)), (6.0, Some(2)));
    let passes = step["passes"].as_array().expect("passes");
    for pass in passes {
        let name = pass["pass"].as_str().expect("a name");
        assert!(pass["work"].is_object(), "{name} has no formula in src/lab/bench/cost.rs");
        let (floor, ratio) = (number(&pass["floor"]), number(&pass["ratio"]));
        let ms = number(&pass["milliseconds"]["median"]);
        assert!(floor > 0.0 && (ratio - ms / floor).abs() < 1e-9 * ratio, "{pass}");
        // A pass of one view in two is half a dispatch.
        assert!(number(&pass["dispatches"]) >= 0.5 && stdout.contains(name), "{name}");
    }
    let has =
        |name: &str| passes.iter().any(|pass| pass["pass"].as_str().is_some_and(|p| without_form(p).starts_with(name)));
    for name in [
        "fill",
        "render/cull",
        "render/decode",
        "render/rasterize_backward",
        "primitives/sort_scatter",
        "model/attention_blend_gather",
        "losses/photometric_gradient_weighted",
        "losses/depth_gradient",
        "primitives/finite",
        "densify/statistics",
        "optimizer/adam",
    ] {
        assert!(has(name), "{name} is missing");
    }
    let medians: Vec<f64> = passes.iter().map(|pass| -number(&pass["milliseconds"]["median"])).collect();
    assert!(medians.is_sorted(), "the longest first");
    let floors: f64 = passes.iter().map(|pass| number(&pass["floor"])).sum();
    let total = number(&step["total_floor"]) - number(&step["between_floor"]);
    assert!((floors - total).abs() < 1e-9 * total, "{floors} {total}");
    for part in ["recording", "submission", "waiting"] {
        assert!(number(&step["host"][part]["median"]) > 0.0, "{part}");
    }

    // What there was: the numbers are those of one another.
    let count = |name: &str| number(&step["counts"][name]);
    assert_eq!((count("pixels"), count("offsets")), (48.0 * 36.0, 10.0));
    assert!(count("visible") <= count("anchors") && count("drawn") <= count("gaussians"));
    assert!(count("gaussians") <= count("visible") * 10.0 && count("pairs") >= count("drawn"));
    assert!(count("drawn") > 0.0 && count("evaluated") <= count("pairs") && count("evaluated") > 0.0);
    assert!(
        count("samples") <= count("evaluated") * count("tile_side").powi(2) && count("blended") <= count("samples")
    );
    assert!(count("tokens") > 1.0, "the measured step has attention");
    assert!(count("anchors") != 300.0, "anchors have grown or been pruned in the warm-up");

    for name in ["passes.svg", "passes.csv"] {
        assert!(folder.join("first").join(name).exists(), "{name}");
    }

    // The table says the same.
    let mut reader = csv::Reader::from_path(folder.join("first/passes.csv")).expect("a table");
    let rows: Vec<csv::StringRecord> = reader.records().map(|row| row.expect("a row")).collect();
    assert_eq!(rows.len(), passes.len() + 2);
    for (row, pass) in rows.iter().zip(passes) {
        let (cell, ms) = (row[2].parse::<f64>().expect("a number"), number(&pass["milliseconds"]["median"]));
        assert!(row[0] == *pass["pass"].as_str().expect("a name") && (cell - ms).abs() <= 1e-12 * ms);
    }

    let stdout = succeeds(folder, &format!("{measured} --against first/bench.json"));
    let compared = stdout.split("against the older record").nth(1).expect("a comparison");
    assert!(compared.contains("rasterize_backward") && compared.contains("\ntotal "), "{compared}");

    // On paper for the GPUs that are published: the same passes, and all of them.
    let stdout =
        succeeds(folder, "scene --warm-up 5 --views 2 --repetitions 1 --form gpu --predict published --out paper");
    let record = json(&folder.join("paper/bench.json"));
    let predictions = record["predictions"].as_array().expect("predictions");
    assert_eq!(predictions.len(), 5);
    for prediction in predictions {
        assert_eq!(prediction["unknown"], Value::Array(vec![]), "{prediction}");
        let passes = prediction["passes"].as_array().expect("passes");
        assert_eq!(Some(passes.len()), record["step"]["passes"].as_array().map(Vec::len));
        let sum: f64 = passes.iter().map(|pass| number(&pass[1])).sum();
        let step = number(&prediction["step"][0]);
        assert!(number(&prediction["step"][1]) > step);
        assert!((sum + number(&prediction["barriers"]) - step).abs() < 1e-9 * step);
        assert!((number(&prediction["minutes"][0]) - step * 20.0 / 60e3).abs() < 1e-9 * step);
        assert!(stdout.contains(prediction["peak"]["name"].as_str().expect("a name")), "{stdout}");
    }
    let error = fails(folder, &format!("{measured} --predict scene/none.toml"));
    assert!(error.starts_with("error: scene/none.toml: cannot be read: "), "{error}");

    let error = fails(folder, &format!("{measured} --out first"));
    assert_eq!(error, "error: first: holds a record already: choose another --out, or --overwrite");
    let error = fails(folder, &format!("{measured} --against first/bench.json --set render.near=0.1"));
    assert!(
        error.starts_with(
            "error: first/bench.json: was measured with render.near = 0.2, this run is with render.near = 0.1"
        ),
        "{error}"
    );
    let error = fails(folder, "scene --against scene/sparse/0/cameras.txt");
    assert!(error.starts_with("error: scene/sparse/0/cameras.txt: "), "{error}");
}

/// Runs the program in `folder`; whether it went well, what it printed, and what it said of an error.
fn program(folder: &Path, arguments: &str) -> (bool, String, String) {
    let mut command = cargo_bin_cmd!("gscream-vk");
    command.current_dir(folder).env("XDG_CACHE_HOME", folder.join("cache")).env_remove("RUST_LOG");
    let output = command.args(arguments.split_whitespace()).output().expect("the program starts");
    let [stdout, stderr] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).expect("UTF-8"));
    (output.status.success(), stdout, stderr)
}

/// A room whose truth is known is prepared once, trained under two seeds and judged; what is there is not made again.
#[test]
#[ignore = "long; .ci/run has it"]
fn holes_are_judged_and_gone_on_with() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    let made = program(folder, "synth room --width 96 --height 72 --train-views 8 --test-views 0 --points 400 --bare");
    assert!(made.0, "{}", made.2);
    let judge = "bench --hole room --preset lavapipe --downscale 1 --iterations 40 --out judged";
    let first = program(folder, judge);
    assert!(first.0, "{}", first.2);
    let runs = |count: usize| {
        let record = json(&folder.join("judged/hole.json"));
        let runs = record["runs"].as_array().expect("runs").clone();
        assert_eq!(runs.len(), count);
        runs
    };
    let one = runs(1);
    assert_eq!((&one[0]["scene"], &one[0]["seed"], &one[0]["steps"]), (&"room".into(), &0.into(), &40.into()));
    for figure in ["masked_psnr", "seen_psnr", "unseen_psnr", "rim_psnr", "outside_psnr", "residue", "iou", "iou_worst"]
    {
        assert!(number(&one[0]["figures"][figure]).is_finite(), "{figure}: {}", one[0]);
    }
    let picture = folder.join("judged/room/seed-0.png");
    let before = fs::metadata(&picture).expect("a picture").modified().expect("a time");
    // Another seed takes the same preparation and leaves the first run alone.
    let prepared =
        fs::metadata(folder.join("judged/room/prepared.json")).expect("a record").modified().expect("a time");
    let second = program(folder, &format!("{judge} --seeds 2"));
    assert!(second.0, "{}", second.2);
    let two = runs(2);
    assert_eq!((&two[0], &two[1]["seed"]), (&one[0], &1.into()));
    assert_eq!(fs::metadata(&picture).expect("a picture").modified().expect("a time"), before);
    let again = fs::metadata(folder.join("judged/room/prepared.json")).expect("a record").modified().expect("a time");
    assert_eq!(again, prepared);
    assert!(second.1.contains("| room | 2 | 8 |"), "{}", second.1);
    let third = program(folder, &format!("{judge} --seeds 2"));
    assert_eq!((third.0, third.1), (true, second.1));
    // Runs of other settings do not belong into one table.
    let other = program(folder, &judge.replace("40", "41"));
    assert!(
        !other.0 && other.2.contains("holds a run of room with other settings; choose another --out"),
        "{}",
        other.2
    );
}

#[test]
fn what_is_no_composed_scene_is_told_in_a_sentence() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    let made = program(folder, "synth room --width 32 --height 24 --train-views 3 --test-views 0 --points 50");
    assert!(made.0, "{}", made.2);
    let refused = |arguments: &str| {
        let (well, stdout, stderr) = program(folder, arguments);
        assert!(!well && stdout.is_empty(), "{arguments}");
        stderr.lines().last().expect("a line").to_owned()
    };
    assert_eq!(refused("bench --hole nowhere"), "error: --hole nowhere: there is no such folder");
    assert_eq!(
        refused("bench --hole room"),
        "error: room: no composed scene to judge by, for it has no photographs without the object (test_images/)"
    );
    assert!(!folder.join("runs").exists(), "nothing is left of it");
}

//! `report` as its user meets it: every file is there, and all of them say the same.

use crate::common;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Output;

use assert_cmd::cargo::cargo_bin_cmd;
use gscream_vk::config::{Settings, Source};
use serde_json::Value;

const FEW: &str = "--set model.voxel=0 --set model.attention.enabled=true --set model.attention.start=2 --set model.attention.patch=24 \
                   --set model.attention.tokens=32 --set model.attention.min_tokens=1";

fn report(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = cargo_bin_cmd!("gscream-vk");
    command
        .current_dir(folder)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .env("MESA_SHADER_CACHE_DIR", env!("CARGO_TARGET_TMPDIR"))
        .env_remove("RUST_LOG");
    command.arg("report").args(FEW.split_whitespace()).args(arguments).output().expect("the program starts")
}

fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = report(folder, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

fn fails(folder: &Path, arguments: &[&str]) -> String {
    let output = report(folder, arguments);
    assert!(!output.status.success() && output.stdout.is_empty(), "{arguments:?} went well");
    let stderr = String::from_utf8(output.stderr).expect("UTF-8");
    stderr.lines().find(|line| line.starts_with("error: ")).expect("an error in one line").to_owned()
}

fn read(folder: &Path, name: &str) -> String {
    fs::read_to_string(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// Rows of a CSV table as maps.
fn table(folder: &Path, name: &str) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(folder.join(name)).expect("a table");
    let header: Vec<String> = reader.headers().expect("a header").iter().map(str::to_owned).collect();
    let row = |record: Result<csv::StringRecord, csv::Error>| {
        header.iter().cloned().zip(record.expect("a row").iter().map(str::to_owned)).collect()
    };
    reader.records().map(row).collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The reader of JSON rounds to a neighbour at times.
fn same(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-12 * a.abs()
}

/// The exact values behind the numbers of the page.
fn values(page: &str) -> Vec<f64> {
    let after = page.split("<data value=\"").skip(1);
    after.map(|rest| rest.split('"').next().expect("a value").parse().expect("a number")).collect()
}

fn strings(list: &Value, key: &str) -> Vec<String> {
    let names = list.as_array().expect("a list").iter();
    names.map(|item| item[key].as_str().expect("a name").to_owned()).collect()
}

/// The defaults have no attention, and the choices that have it are measured all the same.
#[test]
#[ignore = "long; .ci/run has it"]
fn what_the_settings_leave_out_is_measured() {
    let scene = common::folder();
    let arguments = [
        &["scene", "--out", "report", "--kernels-only", "--warm-up", "1", "--views", "1", "--repetitions", "1"][..],
        &["--only", "attention", "--set", "model.attention.enabled=false", "--set", "model.attention.start=7"],
    ]
    .concat();
    succeeds(scene.path(), &arguments);
    let json: Value = serde_json::from_str(&read(&scene.path().join("report"), "report.json")).expect("JSON");
    assert_eq!(strings(&json["kernels"]["variants"], "name"), ["as set", "attention"]);
    // The step that is measured is one in which it has begun.
    let stages = |variant: usize| strings(&json["kernels"]["variants"][variant]["stages"], "stage");
    let measured: Vec<bool> = (0..2).map(|variant| stages(variant).iter().any(|stage| stage == "attention")).collect();
    assert_eq!(measured, [false, true], "{:?}", stages(1));
}

#[test]
#[ignore = "long; .ci/run has it"]
fn all_files_say_the_same() {
    let scene = common::folder();
    let folder = scene.path();
    let arguments = [
        &["scene", "--out", "report", "--iterations", "8", "--warm-up", "3", "--views", "2", "--repetitions", "3"][..],
        &["--samples", "3", "--seeds", "2", "--validate", "--only", "no depth", "--only", "no culling"],
        &["--variant", "faint attention:model.attention.blend*=0.5", "--variant", "scene.downscale=2"],
    ]
    .concat();
    let stdout = succeeds(folder, &arguments);
    let out = folder.join("report");
    let mut files: Vec<String> = fs::read_dir(&out)
        .expect("a folder")
        .map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned())
        .collect();
    files.sort();
    let expected = [
        "kernels.csv",
        "report.html",
        "report.json",
        "settings.toml",
        "stages.svg",
        "step.svg",
        "tensors.csv",
        "training.csv",
        "training.svg",
    ];
    assert_eq!(files, expected);
    let json: Value = serde_json::from_str(&read(&out, "report.json")).expect("JSON");
    let page = read(&out, "report.html");
    let shown = values(&page);
    let on_page = |value: f64| shown.iter().any(|v| same(*v, value));

    // What produced it.
    let settings = Settings::resolve(&[Source::File(out.join("settings.toml"))]).expect("settings");
    assert_eq!(serde_json::to_value(&settings).expect("JSON"), json["settings"]);
    assert!(page.contains(json["device"]["driver"].as_str().expect("a driver")));
    assert!(json["command"].as_str().expect("a command").contains("report --set model.voxel=0"));

    // One step.
    let kernels = &json["kernels"];
    let names = strings(&kernels["variants"], "name");
    assert_eq!(names, ["as set", "no culling", "no depth", "faint attention"]);
    assert_eq!(strings(&kernels["omitted"], "variant"), ["scene.downscale=2"], "another size has other pixels");
    assert_eq!(kernels["views"].as_array().expect("a list").len(), 2);
    let rows = table(&out, "kernels.csv");
    let row = |name: &str, stage: &str| {
        let found = rows.iter().find(|row| row["variant"] == name && row["stage"] == stage);
        found.unwrap_or_else(|| panic!("no row for {stage} of {name}"))
    };
    let parsed = |row: &BTreeMap<String, String>, key: &str| row[key].parse::<f64>().expect("a number");
    let mut stages = 0;
    for variant in kernels["variants"].as_array().expect("a list") {
        let name = variant["name"].as_str().expect("a name");
        for (stage, time, error) in
            [("picture", "picture_milliseconds", "picture_error"), ("step", "step_milliseconds", "gradient_error")]
        {
            let (milliseconds, error) = (&variant[time], number(&variant[error]["relative"]));
            let row = row(name, stage);
            for (key, column) in [("median", "ms_median"), ("lower", "ms_lower_quartile"), ("max", "ms_max")] {
                assert!(same(number(&milliseconds[key]), parsed(row, column)), "{name} {stage} {key}");
            }
            assert!(same(error, parsed(row, "error_relative")), "{name} {stage}");
            assert!(on_page(number(&milliseconds["median"])) && on_page(error), "{name} {stage} is not on the page");
            assert_eq!(milliseconds["repetitions"], 3);
            let ordered = ["min", "lower", "median", "upper", "max"].map(|key| number(&milliseconds[key]));
            assert!(ordered[0] > 0.0 && ordered.is_sorted(), "{name} {stage}: {ordered:?}");
        }
        for stage in variant["stages"].as_array().expect("a list") {
            stages += 1;
            let of_json = stage["stage"].as_str().expect("a stage").replace('-', " ");
            let of_json = if of_json == "bin" { "bin and sort".to_owned() } else { of_json };
            let of_json = if of_json == "statistics" { "growth statistics".to_owned() } else { of_json };
            let row = row(name, &of_json);
            assert!(same(number(&stage["milliseconds"]["median"]), parsed(row, "ms_median")), "{name} {of_json}");
            match stage["error"]["relative"].as_f64() {
                Some(error) => assert!(same(error, parsed(row, "error_relative")), "{name} {of_json}"),
                None => assert_eq!(row["error_relative"], "", "{name} {of_json}"),
            }
        }
    }
    assert_eq!(rows.len(), stages + 2 * names.len(), "nothing else is in the table");
    assert!(stages >= 11 * names.len(), "{stages} stages");

    // The reference path and the kernels differ by rounding; another loss is another gradient; attention is seen.
    let error = |name: &str, which: &str| {
        let variants = kernels["variants"].as_array().expect("a list");
        let variant = variants.iter().find(|v| v["name"] == name).expect("measured");
        number(&variant[which]["relative"])
    };
    let exact = error("as set", "gradient_error");
    assert!(exact > 0.0 && exact < 0.02, "{exact}");
    assert!(error("as set", "picture_error") < 1e-3);
    assert!(error("no depth", "gradient_error") > 10.0 * exact);
    assert!(error("faint attention", "picture_error") > error("as set", "picture_error"));
    for tensor in table(&out, "tensors.csv").iter().filter(|row| row["variant"] == "as set") {
        assert!(tensor["error_relative"].is_empty() || parsed(tensor, "error_relative") < 0.05, "{tensor:?}");
    }

    // Training.
    let training = &json["training"];
    let runs = strings(&training["variants"], "name");
    assert_eq!(runs, ["as set", "no depth", "faint attention", "scene.downscale=2"]);
    let rows = table(&out, "training.csv");
    assert_eq!(rows.len(), runs.len() * 2 * 3);
    let mut rows = rows.iter();
    for variant in training["variants"].as_array().expect("a list") {
        for (seed, run) in variant["runs"].as_array().expect("a list").iter().enumerate() {
            let samples = run["samples"].as_array().expect("a list");
            for (sample, step) in samples.iter().zip([2, 4, 8]) {
                let row = rows.next().expect("a row");
                assert_eq!((row["seed"].parse(), number(&sample["step"])), (Ok(seed), f64::from(step)));
                for key in ["seconds", "psnr", "masked_psnr", "loss", "ssim", "anchors"] {
                    assert!(same(number(&sample[key]), parsed(row, key)), "{key}: {sample}, {row:?}");
                }
            }
            let seconds: Vec<f64> = samples.iter().map(|sample| number(&sample["seconds"])).collect();
            assert!(seconds.is_sorted() && seconds[0] > 0.0, "{seconds:?}");
        }
        let end = variant["points"].as_array().and_then(|points| points.last()).expect("points");
        for key in ["seconds", "psnr", "masked_psnr", "loss", "ssim"] {
            assert!(on_page(number(&end["mean"][key])), "{key} of {} is not on the page", variant["name"]);
        }
    }

    // The page stands alone, with the plots that are also files.
    for name in ["step.svg", "stages.svg", "training.svg"] {
        let svg = read(&out, name);
        assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>") && !svg.contains("NaN"), "{name}");
        assert!(page.contains(&svg), "{name} is in the page");
        let legend = if name == "training.svg" { &runs } else { &names };
        assert!(legend.iter().all(|choice| svg.contains(&format!("\n{choice}\n"))), "{name}: {svg}");
    }
    let foreign = page.replace("http://www.w3.org/2000/svg", "");
    for text in ["<script", "http:", "https:", "<link", "<img", "@import", "url("] {
        assert!(!foreign.contains(text), "{text} is on the page");
    }
    assert!(stdout.lines().last().expect("lines").starts_with("wrote report.json, report.html, "), "{stdout}");

    let error = fails(folder, &["scene", "--out", "report", "--kernels-only"]);
    assert_eq!(error, "error: report: holds a report already: choose another --out, or --overwrite");
}

#[test]
#[ignore = "long; .ci/run has it"]
fn one_half_alone_and_mistakes() {
    let scene = common::folder();
    let folder = scene.path();
    let few = ["scene", "--warm-up", "1", "--views", "1", "--repetitions", "1", "--samples", "1", "--iterations", "3"];
    let with = |more: &[&'static str]| [&few[..], more].concat();
    succeeds(folder, &with(&["--out", "kernels", "--kernels-only", "--only", "no culling", "--step", "1"]));
    let json: Value = serde_json::from_str(&read(&folder.join("kernels"), "report.json")).expect("JSON");
    assert!(json.get("training").is_none() && json["kernels"]["step"] == 1, "{json}");
    assert!(!folder.join("kernels/training.csv").exists() && !folder.join("kernels/training.svg").exists());

    succeeds(folder, &with(&["--out", "training", "--training-only", "--only", "no depth"]));
    let json: Value = serde_json::from_str(&read(&folder.join("training"), "report.json")).expect("JSON");
    assert!(json.get("kernels").is_none() && json["training"]["iterations"] == 3, "{json}");
    assert!(!folder.join("training/kernels.csv").exists());

    let error = fails(folder, &with(&["--out", "none", "--only", "no depht"]));
    assert!(error.starts_with("error: --only no depht: no choice has this name; there are "), "{error}");
    let error = fails(folder, &with(&["--out", "none", "--variant", "mine:model.voxl=1"]));
    assert!(error.starts_with("error: --set model.voxl=1: unknown setting `model.voxl`"), "{error}");
    fs::remove_dir_all(folder.join("scene/test_images")).expect("writable");
    let error = fails(folder, &with(&["--out", "none"]));
    assert!(error.starts_with("error: the scene has no test views to compare on"), "{error}");
    assert!(!folder.join("none").exists(), "a report that cannot be made leaves nothing behind");
}

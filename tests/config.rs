//! Settings: presets, layers, and the errors a user meets.

use std::collections::BTreeSet;
use std::path::Path;

use clap::Parser;
use gscream_vk::config::{Error, PRESETS, Settings, SettingsArgs, Source};
use gscream_vk::train::config::ViewOrder;

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    settings: SettingsArgs,
}

fn resolve(arguments: &[&str]) -> Result<Settings, Error> {
    let command = Command::try_parse_from(std::iter::once(&"gscream-vk").chain(arguments)).expect("arguments parse");
    command.settings.resolve()
}

fn refusal(arguments: &[&str]) -> String {
    resolve(arguments).expect_err("these settings are refused").to_string()
}

fn write(text: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("mine.toml");
    std::fs::write(&path, text).expect("a writable temporary folder");
    let path = path.to_str().expect("a UTF-8 path").to_owned();
    (folder, path)
}

fn leaves(table: &toml::Table, prefix: &str, keys: &mut BTreeSet<String>) {
    for (key, value) in table {
        match value {
            toml::Value::Table(inner) => leaves(inner, &format!("{prefix}{key}."), keys),
            _ => assert!(keys.insert(format!("{prefix}{key}"))),
        }
    }
}

fn keys(text: &str) -> BTreeSet<String> {
    let mut keys = BTreeSet::new();
    leaves(&text.parse().expect("TOML"), "", &mut keys);
    keys
}

#[test]
fn the_annotated_file_is_the_defaults_and_names_every_key() {
    assert_eq!(resolve(&["--preset", "gscream"]).unwrap(), Settings::default());
    assert_eq!(resolve(&[]).unwrap(), Settings::default());
    let annotated = PRESETS.iter().find(|(name, _)| *name == "gscream").unwrap().1;
    assert_eq!(keys(annotated), keys(&Settings::default().to_toml()));
}

#[test]
fn every_file_in_configs_is_a_preset_and_resolves() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let files: BTreeSet<String> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file()) // the workflow is a folder
        .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
        .collect();
    assert_eq!(files, PRESETS.iter().map(|(name, _)| (*name).to_owned()).collect());
    for (name, _) in PRESETS {
        let settings = resolve(&["--preset", name]).unwrap();
        assert_eq!(settings.validate(), Ok(()), "{name}");
        let steps = settings.train.iterations;
        assert!(settings.densify.until <= steps && settings.model.attention.start < steps, "{name}");
        assert!(steps.is_multiple_of(settings.train.log_interval), "{name} ends on a log line");
    }
}

#[test]
fn resolved_settings_written_out_read_back_equal() {
    for (name, _) in PRESETS {
        let settings = resolve(&["--preset", name, "--set", "losses.depth.other_weight=0.1234567890123"]).unwrap();
        let (_folder, path) = write(&settings.to_toml());
        assert_eq!(resolve(&["--config", &path]).unwrap(), settings);
    }
}

#[test]
fn later_layers_win() {
    let (_folder, path) = write("[train]\niterations = 7\nseed = 1\n[model]\nvoxel = 0.5\n");
    let settings = resolve(&["--preset", "lavapipe", "--config", &path]).unwrap();
    assert_eq!((settings.train.iterations, settings.train.seed, settings.model.voxel), (7, 1, 0.5));
    assert_eq!(settings.scene.downscale, 4, "untouched keys keep the preset's value");

    let arguments = ["--config", &path, "--set", "train.iterations=8", "--set", "train.iterations = 9"];
    assert_eq!(resolve(&arguments).unwrap().train.iterations, 9);
    let mut flags = arguments.to_vec();
    flags.extend(["--iterations", "10", "--seed", "11", "--downscale", "3"]);
    let settings = resolve(&flags).unwrap();
    assert_eq!((settings.train.iterations, settings.train.seed, settings.scene.downscale), (10, 11, 3));
}

#[test]
fn set_takes_toml_values_and_bare_words() {
    let settings = resolve(&[
        "--set",
        "train.view_order=sequential",
        "--set",
        "scene.truth_reference=\"test_001\"",
        "--set",
        "losses.depth.enabled=false",
        "--set",
        "optimizer.learning_rate.offset=[1, 0.5]",
        "--set",
        "model.voxel=1",
        "--set",
        "model.attention={ tokens = 64, patch = 32 }",
    ])
    .unwrap();
    assert_eq!(settings.train.view_order, ViewOrder::Sequential);
    assert_eq!(settings.scene.truth_reference, "test_001");
    assert!(!settings.losses.depth.enabled);
    assert_eq!(settings.optimizer.learning_rate.offset, [1.0, 0.5]);
    assert_eq!(settings.model.voxel, 1.0);
    assert_eq!((settings.model.attention.tokens, settings.model.attention.patch), (64, 32));
    assert_eq!(settings.model.attention.start, 15_000, "a table given to --set replaces only what it names");
}

#[test]
fn an_unknown_key_is_named_with_file_line_and_the_nearest_key() {
    let (_folder, path) = write("[train]\niterations = 5\n\n[losses]\nsim_weight = 0.1\n");
    assert_eq!(
        refusal(&["--config", &path]),
        format!("{path}:5: unknown setting `losses.sim_weight`; did you mean `losses.ssim_weight`?")
    );
    let (_folder, path) = write("losses.ssim_weight = 0.1\n[losses.depth]\nenabled = true\nother_wieght = 1\n");
    assert_eq!(
        refusal(&["--config", &path]),
        format!("{path}:4: unknown setting `losses.depth.other_wieght`; did you mean `losses.depth.other_weight`?")
    );
}

#[test]
fn a_key_of_another_section_and_a_foreign_key_get_their_hints() {
    assert_eq!(
        refusal(&["--set", "train.voxel=3"]),
        "--set train.voxel=3: unknown setting `train.voxel`; did you mean `model.voxel`?"
    );
    assert_eq!(
        refusal(&["--set", "iterations=3"]),
        "--set iterations=3: unknown setting `iterations`; did you mean `train.iterations`?"
    );
    assert_eq!(
        refusal(&["--set", "render.antialiasing=true"]),
        "--set render.antialiasing=true: unknown setting `render.antialiasing`; `render` has near, cull, alpha_threshold, \
         transmittance_threshold"
    );
    let message = refusal(&["--set", "quux=1"]);
    assert!(message.contains("unknown setting `quux`; the sections are train, scene, model"), "{message}");
}

#[test]
fn a_wrong_type_is_named_with_file_line_and_key() {
    let (_folder, path) = write("[train]\nseed = 1\niterations = \"many\"\n");
    assert_eq!(
        refusal(&["--config", &path]),
        format!("{path}:3: `train.iterations`: invalid type: string \"many\", expected u32")
    );
    let message = refusal(&["--set", "losses.depth.enabled=ture"]);
    assert_eq!(
        message,
        "--set losses.depth.enabled=ture: `losses.depth.enabled`: invalid type: string \"ture\", expected a boolean"
    );
    let message = refusal(&["--set", "train.view_order=random"]);
    assert!(message.contains("`train.view_order`: unknown variant `random`, expected `shuffled`"), "{message}");
    let message = refusal(&["--set", "train=3"]);
    assert!(message.ends_with("`train`: invalid type: integer `3`, expected a table"), "{message}");
    let message = refusal(&["--set", "optimizer.learning_rate.offset=[0.9]"]);
    assert!(message.contains("`optimizer.learning_rate.offset`: invalid length 1"), "{message}");
    assert!(refusal(&["--set", "train.iterations=-1"]).contains("`train.iterations`"));
}

#[test]
fn broken_toml_missing_files_and_malformed_arguments_are_refused() {
    let (_folder, path) = write("[train]\niterations = 5\niterations = 6\n");
    let message = refusal(&["--config", &path]);
    assert!(message.starts_with(&format!("{path}:3: not valid TOML: duplicate key")), "{message}");
    assert!(refusal(&["--config", "no/such/file.toml"]).starts_with("no/such/file.toml: cannot read the settings: "));
    for text in ["train.iterations", "=3", "a b=3", "train..seed=1", "[train]\nseed=1"] {
        assert!(refusal(&["--set", text]).contains("write it as KEY=VALUE"), "{text}");
    }
    let unknown = Settings::resolve(&[Source::Preset("papre".into())]).unwrap_err().to_string();
    assert_eq!(unknown, "there is no preset `papre`; choose one of gscream, paper, lavapipe, gaussians, demo");
    assert!(Command::try_parse_from(["gscream-vk", "--preset", "papre"]).is_err());
    assert!(Command::try_parse_from(["gscream-vk", "--iterations", "0"]).is_err());
    assert!(Command::try_parse_from(["gscream-vk", "--seed", "-1"]).is_err());
}

#[test]
fn values_that_make_no_sense_are_refused_with_the_layer_that_set_them() {
    let (_folder, path) = write("[train]\nlog_interval = 0\n");
    assert_eq!(refusal(&["--config", &path]), format!("{path}:2: `train.log_interval` is 0, but must be at least 1"));
    let (_folder, path) = write("[densify]\nfrom = 20000\n");
    assert_eq!(
        refusal(&["--config", &path]),
        format!(
            "{path}:2: `densify.until` is 15000, but must not be before densify.from (20000); densify.enabled = false \
             switches it off"
        )
    );
    let refused = [
        "train.iterations=0",
        "train.log_interval=0",
        "optimizer.learning_rate.position=[nan, 1]",
        "scene.downscale=0",
        "model.voxel=inf",
        "model.offsets=0",
        "model.attention.patch=0",
        "model.attention.tokens=11",
        "model.attention.blend=1.5",
        "render.near=0",
        "losses.ssim_weight=1.1",
        "losses.depth.other_weight=-1",
        "losses.depth.gradient.weight=nan",
        "losses.depth.gradient.scales=0",
        "optimizer.epsilon=0",
        "optimizer.learning_rate.offset=[0.1, 0]",
        "optimizer.learning_rate.feature=[-1, -1]",
        "densify.every=0",
        "densify.statistics_from=1501",
        "densify.gradient_threshold=0",
        "densify.coarsest_cell=0",
        "scene.unit=-2",
        "train.reference_share=0.95",
        "model.voxel_pixels=inf",
        "densify.min_opacity=2",
        "densify.max_log_scaling=nan",
        "densify.max_log_scaling=-inf",
    ];
    for set in refused {
        let message = refusal(&["--set", set]);
        let key = set.split('=').next().unwrap();
        assert!(message.starts_with(&format!("--set {set}: `{key}` is ")), "{message}");
    }
    assert!(resolve(&["--set", "optimizer.learning_rate.offset=[0, 0]"]).is_ok());
    assert!(resolve(&["--set", "model.voxel=-1"]).is_ok());
    assert!(resolve(&["--set", "densify.max_log_scaling=inf"]).is_ok());
}

#[test]
fn a_shorter_run_keeps_the_places_of_its_schedule() {
    for preset in ["gscream", "paper", "lavapipe", "gaussians", "demo"] {
        let settings = Settings::resolve(&[Source::Preset(preset.into())]).unwrap();
        for iterations in [30, 600, 3_000, 100_000] {
            let new = settings.rescheduled(iterations);
            new.validate().unwrap_or_else(|e| panic!("{preset}, {iterations} steps: {e:?}"));
            let (old, densify) = (&settings.densify, &new.densify);
            let place = |step: u32, of: u32| f64::from(step) / f64::from(of);
            let close = |new: u32, was: u32| {
                (place(new, iterations) - place(was, settings.train.iterations)).abs() <= 0.5 / f64::from(iterations)
            };
            assert!(close(densify.from, old.from) && close(densify.until, old.until), "{preset}, {iterations}");
            assert!(close(new.model.attention.start, settings.model.attention.start), "{preset}, {iterations}");
            assert!((25..=old.every.max(25)).contains(&densify.every) || densify.every == old.every, "{preset}");
            assert_eq!(new.train.eval_interval, 0);
        }
    }
    let lavapipe = Settings::resolve(&[Source::Preset("lavapipe".into())]).unwrap().rescheduled(600);
    let densify = &lavapipe.densify;
    assert_eq!((densify.from, densify.until, densify.every, densify.statistics_from), (20, 200, 25, 7));
    assert_eq!((densify.min_slot_visits, densify.min_anchor_visits), (10, 20));
    // 2 of 15 of the steps, 7.5^0.4 = 2.239 times the rate.
    let whole = Settings::resolve(&[Source::Preset("lavapipe".into())]).unwrap().optimizer.learning_rate.offset[0];
    assert!((lavapipe.optimizer.learning_rate.offset[0] / whole - 2.239).abs() < 1e-3);
}

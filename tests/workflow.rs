//! The Snakemake workflow under configs/workflow: three scenes, one training killed on the way, rerun to the same bytes.
//! They need `snakemake` on the PATH; the first is ignored, as it takes minutes.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use crate::common;
use crate::common::skip::{Lack, skip};
use assert_cmd::cargo::cargo_bin;
use gscream_vk::scene::synthetic;

const SCENES: [&str; 3] = ["one", "two", "three"];

/// Three captures, the third of photographs and a mask alone, and the list of them. `program` is what the workflow runs.
fn place(folder: &Path, program: &Path) {
    for (seed, name) in (1..).zip(SCENES) {
        let options = synthetic::Options { seed, width: 64, height: 48, train_views: 8, test_views: 2, points: 600 };
        synthetic::write(&folder.join("captures").join(name), &options).expect("a writable folder");
    }
    let captures = folder.join("captures");
    fs::rename(captures.join("three/masks/train_004.png"), captures.join("three.png")).expect("a mask");
    for more in ["masks", "depth", "reference"] {
        fs::remove_dir_all(captures.join("three").join(more)).expect("a folder");
    }
    let mut settings = common::settings(60);
    settings.train.checkpoint_interval = 5;
    fs::write(folder.join("settings.toml"), settings.to_toml()).expect("a writable folder");
    let list = format!(
        "program: {}\nout: out\ntrain: --config settings.toml\nexport: --steps 20 --views 4\nprepare: --fit-steps 60 --fit-side 64\nscenes:\n  \
         one: {{scene: captures/one}}\n  two: {{scene: captures/two}}\n  three: {{photographs: captures/three, mask: train_004=captures/three.png}}\n",
        program.display()
    );
    fs::write(folder.join("scenes.yaml"), list).expect("a writable folder");
}

fn snakemake(folder: &Path) -> Output {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/workflow");
    Command::new("snakemake")
        .args(["--cores", "2", "--configfile", "scenes.yaml", "--profile"])
        .arg(configs.join("local"))
        .arg("--snakefile")
        .arg(configs.join("Snakefile"))
        .current_dir(folder)
        .env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"))
        .stdin(Stdio::null())
        .output()
        .expect("snakemake starts")
}

fn installed() -> bool {
    let there = Command::new("snakemake").arg("--version").output().is_ok();
    if !there {
        skip(Lack::Snakemake, "snakemake is not installed: pip install snakemake");
    }
    there
}

/// Names are folders, and what is written in a list of scenes is no command of the shell.
#[test]
fn names_and_folders_are_words_of_the_shell() {
    if !installed() {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    // In place of the program: it keeps its arguments, and makes what the next step reads.
    let program = folder.join("my program");
    let script = "#!/bin/bash\nprintf '<%s>' \"$@\" >>said; echo >>said\n\
         if [ \"$1\" = eval ]; then echo '{\"mean\": {}}' >\"$4\"; fi\n\
         if [ \"$1\" = export ]; then for f in ply spz glb; do touch \"$4/scene.$f\"; done; \
         echo '{\"files\": []}' >\"$4/export.json\"; fi\n";
    fs::write(&program, script).expect("writable");
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("a file of ours");
    let out = "my results; touch pwned $(touch pwned)";
    let list = serde_json::json!({
        "program": program, "out": out, "train": "--set 'a b=1'",
        "scenes": { "it's a `touch pwned`": { "photographs": "photos $(touch pwned)", "mask": "a=b c.png" } },
    });
    // JSON is YAML.
    fs::write(folder.join("scenes.yaml"), list.to_string()).expect("writable");
    let output = snakemake(folder);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(!folder.join("pwned").exists() && !folder.join("my").exists(), "nothing was a command");
    let name = "it's a `touch pwned`";
    let said = fs::read_to_string(folder.join("said")).expect("what was asked for");
    assert_eq!(
        said,
        format!(
            "<prepare><photos $(touch pwned)><--out><{out}/scenes/{name}><--mask><a=b c.png>\n\
             <train><{out}/scenes/{name}><--out><{out}/runs/{name}><--resume-or-start><--set><a b=1>\n"
        ) + &if said.find("<eval>") < said.find("<export>") {
            format!(
                "<eval><{out}/runs/{name}><--json><{out}/eval/{name}.json>\n\
                 <export><{out}/runs/{name}><--out><{out}/export/{name}>\n"
            )
        } else {
            format!(
                "<export><{out}/runs/{name}><--out><{out}/export/{name}>\n\
                 <eval><{out}/runs/{name}><--json><{out}/eval/{name}.json>\n"
            )
        }
    );

    for name in ["..", ".", "", "a/b", "a\\b", "a\nb"] {
        let list = serde_json::json!({ "program": program, "scenes": { name: { "scene": "a" } } });
        fs::write(folder.join("scenes.yaml"), list.to_string()).expect("writable");
        let output = snakemake(folder);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && stderr.contains("a name is that of a folder"), "{name:?}: {stderr}");
    }
}

/// The bytes of all that was made but records of commands and times.
fn made(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.join("out")];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(folder).expect("below it").to_string_lossy().into_owned();
            let timed = ["run.json", "log.jsonl", "export.json", "prepare.json", "index.html"]
                .iter()
                .any(|end| name.ends_with(end));
            if !timed && !name.starts_with("out/log/") {
                files.insert(name, fs::read(&path).expect("readable"));
            }
        }
    }
    files
}

#[test]
#[ignore = "long; .ci/run has it"]
fn three_scenes_one_killed_and_run_again() {
    if !installed() {
        return;
    }
    let program = cargo_bin!("gscream-vk");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    let text = |output: &Output| String::from_utf8_lossy(&output.stderr).into_owned();

    place(&whole, program);
    let output = snakemake(&whole);
    assert!(output.status.success(), "{}", text(&output));

    // A program that trains the second scene until it has a checkpoint and is then killed, once.
    fs::create_dir_all(&killed).expect("a writable folder");
    let wrapper = killed.join("gscream-vk");
    let script = format!(
        "#!/bin/bash\ncase \"$*\" in train*captures/two*) if [ ! -e killed ]; then touch killed\n{0} \"$@\" & child=$!\n\
         until compgen -G 'out/runs/two/checkpoints/step-*' >/dev/null; do sleep 0.01; done\nkill -9 $child; wait $child; exit 1; fi;; esac\n\
         exec {0} \"$@\"\n",
        program.display()
    );
    fs::write(&wrapper, script).expect("a writable folder");
    fs::set_permissions(&wrapper, fs::Permissions::from_mode(0o755)).expect("a file of ours");
    place(&killed, &wrapper);
    let output = snakemake(&killed);
    assert!(!output.status.success(), "one job was killed: {}", text(&output));
    let done = |name: &str| killed.join("out/done").join(name).exists();
    assert!(done("one.trained") && done("three.trained") && !done("two.trained"), "{}", text(&output));
    assert!(killed.join("out/runs/two/run.json").exists(), "what it goes on from was not deleted");
    assert!(!killed.join("out/table.csv").exists());
    let output = snakemake(&killed);
    assert!(output.status.success(), "{}", text(&output));
    let log = fs::read_to_string(killed.join("out/log/train/two.txt")).expect("a log");
    assert!(log.contains("resuming: behind step"), "{log}");

    let (want, got) = (made(&whole), made(&killed));
    assert!(want.keys().eq(got.keys()), "{:?}\n{:?}", want.keys(), got.keys());
    for (name, bytes) in &want {
        assert!(got[name] == *bytes, "{name} differs");
    }
    for file in ["scene.ply", "scene.spz", "scene.glb"] {
        assert!(want.contains_key(&format!("out/export/three/{file}")));
    }
    println!("{}", String::from_utf8_lossy(&want["out/table.md"]));
    // A third time there is nothing to do.
    let output = snakemake(&killed);
    assert!(output.status.success() && text(&output).contains("Nothing to be done"), "{}", text(&output));
}

//! A run is the same again and never lost: killed at any moment, stopped by a signal, out of disk, damaged checkpoints.

#[allow(dead_code)]
mod common;

use std::fs;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use assert_cmd::cargo::cargo_bin;
use gscream_vk::config::Settings;
use gscream_vk::train::checkpoint;
use gscream_vk::train::config::ViewOrder;
use rand::{RngExt, SeedableRng};
use tempfile::TempDir;

/// Growth, pruning, statistics and attention in the first steps; a checkpoint every third.
fn settings() -> Settings {
    let mut settings = common::settings(36);
    let train = &mut settings.train;
    train.view_order = ViewOrder::Shuffled;
    (train.log_interval, train.eval_interval, train.save_interval, train.checkpoint_interval) = (5, 12, 9, 3);
    settings
}

/// A folder with a scene and the settings of its runs.
struct Place {
    folder: TempDir,
}

impl Place {
    fn new(settings: &Settings) -> Self {
        let folder = common::folder();
        fs::write(folder.path().join("settings.toml"), settings.to_toml()).expect("a writable folder");
        Self { folder }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// The program within the folder, pipelines cached there.
    fn program(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(cargo_bin!("gscream-vk"));
        command.args(arguments).current_dir(self.path()).env("XDG_CACHE_HOME", self.path().join("cache"));
        command.env_remove("RUST_LOG").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn train(&self, out: &str, more: &[&str]) -> Command {
        self.program(&[&["train", "scene", "--config", "settings.toml", "--out", out], more].concat())
    }

    fn resume(&self, run: &str) -> Command {
        self.program(&["train", "--resume", run])
    }

    fn checkpoints(&self, run: &str) -> Vec<u32> {
        checkpoint::list(&self.path().join(run)).into_iter().map(|(step, _)| step).collect()
    }

    /// What a finished run has left: every file's bytes by its path; times, memory of the process and the command line
    /// left out.
    fn result(&self, run: &str) -> Vec<(String, Vec<u8>)> {
        let run = self.path().join(run);
        let mut files = vec![];
        let mut folders = vec![run.clone()];
        while let Some(next) = folders.pop() {
            for entry in fs::read_dir(next).expect("a folder") {
                let path = entry.expect("readable").path();
                if path.is_dir() {
                    folders.push(path);
                    continue;
                }
                let mut bytes = fs::read(&path).expect("readable");
                let name = path.strip_prefix(&run).expect("below it").to_string_lossy().into_owned();
                if name == "run.json" {
                    continue;
                }
                if name == "log.jsonl" {
                    let text = String::from_utf8(bytes).expect("text");
                    bytes = text.lines().map(without_times).collect::<String>().into_bytes();
                }
                files.push((name, bytes));
            }
        }
        files.sort();
        files
    }
}

/// A line of the log but for seconds, speed and the process's own memory.
fn without_times(line: &str) -> String {
    let serde_json::Value::Object(mut fields) = serde_json::from_str(line).expect("a line of JSON") else {
        panic!("{line} is no object")
    };
    for time in ["seconds", "steps_per_second", "host_bytes"] {
        assert!(fields.remove(time).is_some(), "{line} has no {time}");
    }
    // Numbers as they were written.
    let mut text = line.to_owned();
    for time in ["seconds", "steps_per_second", "host_bytes"] {
        let start = text.find(&format!("\"{time}\":")).expect("it was there");
        let end = text[start..].find([',', '}']).expect("an object ends") + start;
        text.replace_range(start..end, "");
    }
    text + "\n"
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn output(mut command: Command) -> Output {
    command.output().expect("the program starts")
}

fn succeeds(command: Command) -> Output {
    let output = output(command);
    assert!(output.status.success(), "{}", text(&output.stderr));
    output
}

/// Fails with this code and exactly one error, which it returns.
fn fails(command: Command, code: i32) -> String {
    let output = output(command);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    assert_eq!(stderr.matches("error:").count(), 1, "{stderr}");
    assert!(!stderr.contains("panicked"), "{stderr}");
    stderr
}

fn assert_same(got: &[(String, Vec<u8>)], want: &[(String, Vec<u8>)], what: &str) {
    let names = |files: &[(String, Vec<u8>)]| files.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(got), names(want), "{what}");
    for ((name, got), (_, want)) in got.iter().zip(want) {
        let readable = |bytes: &[u8]| if name.ends_with("jsonl") { text(bytes) } else { format!("{} bytes", bytes.len()) };
        assert!(got == want, "{what}: {name} differs:\n{}\n{}", readable(got), readable(want));
    }
}

/// Waits until the condition holds or the program has ended; false in the second case.
fn wait_until(child: &mut Child, mut holds: impl FnMut() -> bool) -> bool {
    loop {
        if holds() {
            return true;
        }
        if child.try_wait().expect("a child").is_some() {
            return holds();
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn killed_at_any_moment_it_comes_to_the_same_end() {
    let place = Place::new(&settings());
    let started = Instant::now();
    succeeds(place.train("whole", &[]));
    let cold = started.elapsed();
    let started = Instant::now();
    succeeds(place.train("again", &[]));
    let whole = started.elapsed();
    println!("cold {cold:?} warm {whole:?}");
    let want = place.result("whole");
    assert_same(&place.result("again"), &want, "once more");
}

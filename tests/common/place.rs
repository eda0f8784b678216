//! The program in a folder with the tiny scene: what it leaves behind, and how it ends.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use assert_cmd::cargo::cargo_bin;
use gscream_vk::config::Settings;
use gscream_vk::train::checkpoint;
use tempfile::TempDir;

use super::skip::{Lack, skip};

/// Files' contents by their path within a run folder, sorted.
pub type Files = Vec<(String, Vec<u8>)>;

/// A folder with a scene and the settings of its runs.
pub struct Place {
    folder: TempDir,
}

impl Place {
    pub fn new(settings: &Settings) -> Self {
        let folder = super::folder();
        fs::write(folder.path().join("settings.toml"), settings.to_toml()).expect("a writable folder");
        Self { folder }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// The program within the folder. Pipelines are compiled once for all tests.
    pub fn program(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(cargo_bin!("gscream-vk"));
        command.args(arguments).current_dir(self.path()).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
        command.env_remove("RUST_LOG").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    pub fn train(&self, out: &str, more: &[&str]) -> Command {
        self.program(&[&["train", "scene", "--config", "settings.toml", "--out", out], more].concat())
    }

    pub fn resume(&self, run: &str) -> Command {
        self.program(&["train", "--resume", run])
    }

    pub fn checkpoints(&self, run: &str) -> Vec<u32> {
        checkpoint::list(&self.path().join(run)).into_iter().map(|(step, _)| step).collect()
    }

    /// What a finished run has left: every file's bytes by its path; times, memory of the process and the command line
    /// left out.
    pub fn result(&self, run: &str) -> Files {
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
                if name == "run.json" || name == "index.html" {
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
pub fn without_times(line: &str) -> String {
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

/// `tests/common/NAME.rs`, compiled to a library that a program is started with.
pub fn library(name: &str) -> Option<PathBuf> {
    let library = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("lib{name}.so"));
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/common/{name}.rs"));
    let mut rustc = Command::new(std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    rustc.args(["--edition", "2024", "--crate-type", "cdylib", "-C", "panic=abort", "-O", "-o"]);
    let Ok(done) = rustc.arg(&library).arg(source).stdin(Stdio::null()).output() else {
        skip(Lack::Compiler, &format!("no rustc: {name} cannot be compiled"));
        return None;
    };
    assert!(done.status.success(), "{}", text(&done.stderr));
    Some(library)
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

pub fn output(mut command: Command) -> Output {
    command.output().expect("the program starts")
}

pub fn succeeds(command: Command) -> Output {
    let output = output(command);
    assert!(output.status.success(), "{}", text(&output.stderr));
    output
}

/// Fails with this code and exactly one error, which it returns.
pub fn fails(command: Command, code: i32) -> String {
    failed(output(command), code)
}

pub fn failed(output: Output, code: i32) -> String {
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    assert_eq!(stderr.matches("error:").count(), 1, "{stderr}");
    assert!(!stderr.contains("panicked"), "{stderr}");
    stderr
}

pub fn assert_same(got: &[(String, Vec<u8>)], want: &[(String, Vec<u8>)], what: &str) {
    let names = |files: &[(String, Vec<u8>)]| files.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(got), names(want), "{what}");
    for ((name, got), (_, want)) in got.iter().zip(want) {
        let lines = || {
            let (got, want) = (text(got), text(want));
            let differ = got.lines().zip(want.lines()).find(|(a, b)| a != b);
            differ.map_or_else(String::new, |(a, b)| format!(":\n{a}\n{b}"))
        };
        let detail = if name.ends_with("jsonl") { lines() } else { String::new() };
        assert!(got == want, "{what}: {name} differs ({} and {} bytes){detail}", got.len(), want.len());
    }
}

/// Waits until the condition holds or the program has ended; false in the second case.
pub fn wait_until(child: &mut Child, mut holds: impl FnMut() -> bool) -> bool {
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

pub fn send(child: &Child, signal: &str) {
    let status = Command::new("kill").args(["-s", signal, &child.id().to_string()]).status();
    assert!(status.expect("kill starts").success());
}

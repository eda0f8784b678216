//! Signals and readers that go away, at the level of the process: every command ends soon, says how with its exit code, and
//! loses nothing.
#![cfg(unix)]

use crate::common;
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use assert_cmd::cargo::cargo_bin;
use gscream_vk::cli::folders::Record;
use gscream_vk::scene::synthetic;
use gscream_vk::train::checkpoint;
use tempfile::TempDir;

/// Test views: judging them takes longer than a signal needs.
const TESTS: u32 = 12;
/// How soon a program has ended that was asked to. It is a few milliseconds; the machine may be busy.
const SOON: Duration = Duration::from_secs(20);

/// A folder with a scene of many views and the settings of a few steps.
fn place() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options =
        synthetic::Options { seed: 1, width: 48, height: 36, train_views: 60, test_views: TESTS, points: 300 };
    synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
    let mut settings = common::settings(8);
    settings.train.checkpoint_interval = 4;
    fs::write(folder.path().join("settings.toml"), settings.to_toml()).expect("a writable folder");
    folder
}

/// The program within a folder, with signals as a terminal's programs have them, whatever the tests run under. Pipelines are
/// compiled once for all tests.
fn program(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new("env");
    command.args(["--default-signal=HUP,INT,TERM"]).arg(cargo_bin!("gscream-vk"));
    command.args(arguments.split_whitespace()).current_dir(folder);
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR")).env_remove("RUST_LOG");
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

const TRAIN: &str = "train scene --config settings.toml --out";

fn succeeds(folder: &Path, arguments: &str) {
    let output = program(folder, arguments).stderr(Stdio::piped()).output().expect("the program starts");
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
}

fn wait_for(child: &mut Child, what: &str, mut holds: impl FnMut() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(child.try_wait().expect("a child").is_none(), "ended before {what}");
        assert!(began.elapsed() < Duration::from_secs(120), "no {what} in two minutes");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn send(child: &Child, signal: &str) {
    let status = Command::new("kill").args(["-s", signal, &child.id().to_string()]).status();
    assert!(status.expect("kill starts").success());
}

/// How the program ends, which it does soon.
fn end(child: &mut Child) -> ExitStatus {
    let began = Instant::now();
    loop {
        if let Some(status) = child.try_wait().expect("a child") {
            return status;
        }
        if began.elapsed() > SOON {
            child.kill().expect("it runs");
            child.wait().expect("a child");
            panic!("the program has not ended {SOON:?} after the signal");
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn is_complete(run: &Path) -> bool {
    Record::read(run).expect("a record").complete.is_some()
}

/// What a run has come to: its model, figures and pictures, by their paths.
fn result(run: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut paths = vec![run.join("metrics.json")];
    for part in ["model", "test", "seen"] {
        paths.extend(fs::read_dir(run.join(part)).expect(part).map(|entry| entry.expect("readable").path()));
    }
    paths.sort();
    let file =
        |path: &PathBuf| (path.strip_prefix(run).expect("below it").to_owned(), fs::read(path).expect("readable"));
    paths.iter().map(file).collect()
}

/// Figures and pictures of a trained model take minutes where there are many views: a signal ends them, too, and the run
/// is gone on with to the same bytes.
#[test]
fn a_signal_after_the_last_step_ends_the_run() {
    let folder = place();
    let folder = folder.path();
    succeeds(folder, &format!("{TRAIN} whole"));
    let last = format!("test_{:03}.png", TESTS - 1);
    for (run, signal, code, picture) in [("first", "INT", 130, "test_000.png"), ("last", "TERM", 143, last.as_str())] {
        let mut child = program(folder, &format!("{TRAIN} {run}")).spawn().expect("the program starts");
        let run = folder.join(run);
        wait_for(&mut child, picture, || run.join("test").join(picture).is_file());
        send(&child, signal);
        assert_eq!(end(&mut child).code(), Some(code), "{picture}");
        assert!(!is_complete(&run), "{picture}");
        assert!(run.join("index.html").is_file(), "a page says how far it came");
        succeeds(folder, &format!("train --resume {}", run.display()));
        assert!(is_complete(&run) && result(&run) == result(&folder.join("whole")), "{picture}: not the same bytes");
    }
}

#[test]
fn a_signal_ends_an_ablation_and_not_one_of_its_runs_alone() {
    let folder = place();
    let folder = folder.path();
    let arguments = "ablate scene --config settings.toml --out runs --only neither,depth";
    let mut child = program(folder, arguments).spawn().expect("the program starts");
    let runs = folder.join("runs");
    let last = runs.join(format!("neither/test/test_{:03}.png", TESTS - 1));
    wait_for(&mut child, "the first run's last picture", || last.is_file());
    send(&child, "TERM");
    assert_eq!(end(&mut child).code(), Some(143));
    assert!(!runs.join("depth").exists(), "the second run has begun");
    succeeds(folder, &format!("{arguments} --resume"));
    assert!(is_complete(&runs.join("neither")) && is_complete(&runs.join("depth")));
}

/// The program waits for a reader of its notes and cannot look at the first signal.
#[test]
fn a_second_signal_ends_the_program_at_once() {
    let folder = place();
    let folder = folder.path();
    for (signal, code) in [("INT", 130), ("TERM", 143)] {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        let mut stuffing = writer.try_clone().expect("a second end");
        let mut command = program(folder, &format!("{TRAIN} {signal}"));
        let mut child = command.stderr(writer).spawn().expect("the program starts");
        drop(command);
        let mut lines = BufReader::new(reader).lines();
        assert!(lines.any(|line| line.expect("text").starts_with("anchors: ")), "training begins");
        let full = std::thread::spawn(move || {
            // More than any pipe holds.
            while stuffing.write_all(&[b'\n'; 1 << 16]).is_ok() {}
        });
        // The pipe is full by now. Whatever the program has to say next, how it ends included, it waits there.
        std::thread::sleep(Duration::from_millis(500));
        send(&child, signal);
        std::thread::sleep(Duration::from_secs(2));
        assert!(child.try_wait().expect("a child").is_none(), "the first is noted");
        send(&child, signal);
        assert_eq!(end(&mut child).code(), Some(code));
        drop(lines);
        full.join().expect("it ends with its reader");
    }
}

/// A terminal that closes is no reason to lose steps; under `nohup` it is no reason to end.
#[test]
fn a_hangup_ends_a_training_with_a_checkpoint_or_not_at_all() {
    let folder = place();
    let folder = folder.path();
    let checkpoint = |run: &str| !checkpoint::list(&folder.join(run)).is_empty();
    let mut child = program(folder, &format!("{TRAIN} run")).spawn().expect("the program starts");
    wait_for(&mut child, "a checkpoint", || checkpoint("run"));
    send(&child, "HUP");
    send(&child, "HUP");
    assert_eq!(end(&mut child).code(), Some(129));
    assert!(checkpoint("run") && !is_complete(&folder.join("run")));
    succeeds(folder, "train --resume run");

    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' HUP; exec \"$0\" $1"]).arg(cargo_bin!("gscream-vk")).arg(format!("{TRAIN} nohup"));
    shell.current_dir(folder).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    let mut child = shell.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("a shell");
    wait_for(&mut child, "a checkpoint", || checkpoint("nohup"));
    send(&child, "HUP");
    assert!(child.wait().expect("a child").success(), "under nohup it goes on");
    assert!(result(&folder.join("nohup")) == result(&folder.join("run")), "not the same bytes");
}

/// As in `train ... 2>&1 | head`, and in a terminal that was closed.
#[test]
fn a_training_goes_on_when_nobody_reads_its_notes() {
    let folder = place();
    let folder = folder.path();
    let mut child = program(folder, &format!("{TRAIN} closed")).stderr(Stdio::piped()).spawn().expect("it starts");
    drop(child.stderr.take());
    assert_eq!(child.wait().expect("a child").code(), Some(0));

    let (reader, writer) = std::io::pipe().expect("a pipe");
    let mut command = program(folder, &format!("{TRAIN} head"));
    command.stdout(writer.try_clone().expect("a second end")).stderr(writer);
    let mut child = command.spawn().expect("the program starts");
    drop(command);
    let mut line = String::new();
    BufReader::new(reader).read_line(&mut line).expect("a line");
    // The results that come last find no reader.
    let status = child.wait().expect("a child");
    assert_eq!(status.signal(), Some(signal_hook::consts::SIGPIPE), "{status}");
    assert!(is_complete(&folder.join("head")));
    assert!(result(&folder.join("head")) == result(&folder.join("closed")), "not the same bytes");
}

/// A program called `colmap` that says what it was asked, and sleeps, in a process of its own, when asked for features.
fn sleeper(folder: &Path) -> PathBuf {
    let bin = folder.join("bin");
    fs::create_dir(&bin).expect("a writable folder");
    let script = "#!/bin/sh\ncase \"$1 $2\" in\n'feature_extractor --database_path') sleep 300 & echo $! >>\"$PIDS\"; echo $$ >>\"$PIDS\"; wait ;;\nesac\n";
    let program = bin.join("colmap");
    fs::write(&program, script).expect("a writable folder");
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("our own file");
    bin
}

fn lives(pid: &str) -> bool {
    // A zombie that nobody has waited for yet does not.
    let status = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    !status.is_empty() && !status.contains(") Z ")
}

#[test]
fn a_signal_ends_colmap_and_what_it_started() {
    let folder = place();
    let folder = folder.path();
    let bin = sleeper(folder);
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap_or_default());
    for (signal, code) in [("TERM", 143), ("INT", 130), ("HUP", 129)] {
        let (pids, temporary) = (folder.join(format!("pids-{signal}")), folder.join(format!("tmp-{signal}")));
        fs::create_dir(&temporary).expect("a writable folder");
        let mut command = program(folder, &format!("prepare scene/images --out {signal} --only poses"));
        command.env("PATH", &path).env("PIDS", &pids).env("TMPDIR", &temporary);
        let mut child = command.spawn().expect("the program starts");
        let started = || fs::read_to_string(&pids).unwrap_or_default().lines().map(str::to_owned).collect::<Vec<_>>();
        wait_for(&mut child, "colmap", || started().len() == 2);
        assert!(started().iter().all(|pid| lives(pid)));
        send(&child, signal);
        assert_eq!(end(&mut child).code(), Some(code));
        let began = Instant::now();
        while started().iter().any(|pid| lives(pid)) {
            assert!(began.elapsed() < SOON, "{signal}: what colmap started runs on");
            std::thread::sleep(Duration::from_millis(5));
        }
        let left: Vec<_> = fs::read_dir(&temporary).expect("a folder").flatten().map(|entry| entry.path()).collect();
        assert!(left.is_empty(), "{left:?}");
    }
}

/// The steps behind the fit, too, which is not made again.
#[test]
fn a_signal_ends_a_preparation_between_its_steps() {
    let folder = place();
    let folder = folder.path();
    let photographs = folder.join("photos");
    fs::create_dir(&photographs).expect("a writable folder");
    for part in ["images", "sparse"] {
        fs::rename(folder.join("scene").join(part), photographs.join(part)).expect("a writable folder");
    }
    let arguments = "prepare photos --out out --mask train_000=scene/masks/train_000.png --fit-steps 40 --fit-side 48";
    let mut child = program(folder, arguments).stderr(Stdio::piped()).spawn().expect("the program starts");
    let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
    assert!(lines.any(|line| line.expect("text").starts_with("fit: ")), "the fit ends");
    send(&child, "TERM");
    let rest: Vec<String> = lines.map(|line| line.expect("text")).collect();
    assert_eq!(end(&mut child).code(), Some(143), "{rest:?}");
    assert!(rest.last().is_some_and(|line| line.starts_with("error: stopped by SIGTERM; ")), "{rest:?}");
    let again = program(folder, arguments).stderr(Stdio::piped()).output().expect("the program starts");
    let again_says = String::from_utf8_lossy(&again.stderr);
    assert!(again.status.success() && again_says.contains("fit: nothing has changed"), "{again_says}");
}

/// They write whole files at the end, and need not be asked to stop.
#[test]
fn a_signal_ends_an_export_and_pictures_at_once() {
    let folder = place();
    let folder = folder.path();
    succeeds(folder, &format!("{TRAIN} run"));
    let mut child = program(folder, "render run --views spiral --frames 100000").spawn().expect("it starts");
    let first = folder.join("run/renders/spiral/frame_00000.png");
    wait_for(&mut child, "the first picture", || first.is_file());
    send(&child, "TERM");
    assert_eq!(end(&mut child).signal(), Some(signal_hook::consts::SIGTERM));

    let mut child = program(folder, "export run --steps 1000000").spawn().expect("it starts");
    std::thread::sleep(Duration::from_secs(2));
    send(&child, "INT");
    assert_eq!(end(&mut child).signal(), Some(signal_hook::consts::SIGINT));
    assert!(!folder.join("run/export").exists());
}

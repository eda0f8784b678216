//! Whole commands that are killed at any moment, and disks that fail at any write: one sentence, nothing lost, and the same
//! bytes in the end. `GSCREAM_MOMENTS` says at how many moments each.
#![cfg(target_os = "linux")]

use std::fs;
use std::os::unix::process::ExitStatusExt as _;
use std::path::PathBuf;
use std::process::{Command, Output};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use crate::common;
use crate::common::place::{Files, Place, assert_same, library, output, succeeds, text};
use crate::common::skip::{Lack, is_allowed};
use gscream_vk::folder::LOCK;
use rand::{RngExt as _, SeedableRng as _};

/// A command whose second start does what the first has left.
#[derive(Clone, Copy)]
struct Work {
    arguments: &'static [&'static str],
    /// The folder that it makes.
    out: &'static str,
    /// Files with times in them.
    timed: &'static [&'static str],
}

const TRAIN: Work = Work {
    arguments: &["train", "scene", "--config", "settings.toml", "--out", "run", "--resume-or-start"],
    out: "run",
    timed: &[],
};
const PREPARE: Work = Work {
    arguments: &[
        "prepare",
        "photos",
        "--out",
        "prepared",
        "--mask",
        "train_003=scene/masks/train_003.png",
        "--fit-steps",
        "20",
        "--fit-side",
        "48",
    ],
    out: "prepared",
    timed: &["prepare.json"],
};
const EXPORT: Work = Work {
    arguments: &["export", "model", "--scene", "scene", "--views", "2", "--steps", "3", "--out", "files"],
    out: "files",
    timed: &["export.json"],
};

/// Moments of a command that are tried where nobody says how many.
const MOMENTS: u32 = 6;

fn moments() -> u32 {
    std::env::var("GSCREAM_MOMENTS").map_or(MOMENTS, |text| text.parse().expect("GSCREAM_MOMENTS is a number"))
}

/// The scene, its photographs alone, a model, and settings under which a run has three checkpoints.
fn place() -> Place {
    let mut settings = common::settings(12);
    (settings.train.checkpoint_interval, settings.train.eval_interval) = (4, 5);
    settings.train.log_interval = 3;
    let place = Place::new(&settings);
    for part in ["images", "sparse/0"] {
        let (from, to) = (place.path().join("scene").join(part), place.path().join("photos").join(part));
        fs::create_dir_all(&to).expect("writable");
        for file in fs::read_dir(from).expect("a folder").flatten() {
            fs::copy(file.path(), to.join(file.file_name())).expect("writable");
        }
    }
    succeeds(place.train("made", &[]));
    fs::rename(place.path().join("made/model"), place.path().join("model")).expect("writable");
    place
}

impl Work {
    fn command(&self, place: &Place) -> Command {
        place.program(self.arguments)
    }

    fn made(&self, place: &Place) -> Files {
        let mut files = place.result(self.out);
        files.retain(|(name, _)| !self.timed.contains(&name.as_str()));
        files
    }

    fn clear(&self, place: &Place) {
        let folder = place.path().join(self.out);
        if folder.exists() {
            fs::remove_dir_all(folder).expect("writable");
        }
    }

    /// What it comes to, and how long it takes with all pipelines compiled.
    fn whole(&self, place: &Place) -> (Files, Duration) {
        succeeds(self.command(place));
        let first = self.made(place);
        self.clear(place);
        let began = Instant::now();
        succeeds(self.command(place));
        let duration = began.elapsed();
        assert_same(&self.made(place), &first, "twice the same");
        self.clear(place);
        (first, duration)
    }

    /// One start that is killed after `delay`; true if it was still at work.
    fn killed_after(&self, place: &Place, delay: Duration) -> bool {
        let mut child = self.command(place).spawn().expect("the program starts");
        std::thread::sleep(delay);
        child.kill().expect("a child");
        let output = child.wait_with_output().expect("a child");
        let killed = output.status.signal().is_some();
        assert!(killed || output.status.success(), "{}", text(&output.stderr));
        killed
    }

    fn killed_at_any_moment(&self) {
        let place = place();
        let (whole, duration) = self.whole(&place);
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(27);
        let moments = moments();
        for moment in 0..moments {
            let mut delay = duration.mul_f64((f64::from(moment) + rng.random::<f64>()) / f64::from(moments));
            // A start that has less to do than the measured one, or a machine that has become faster, ends first: earlier, then.
            while !self.killed_after(&place, delay) {
                assert_same(&self.made(&place), &whole, &format!("ended before {delay:?}"));
                self.clear(&place);
                delay /= 2;
            }
            // One after the other, three kills at most before it may end.
            if moment % 3 == 2 || moment + 1 == moments {
                succeeds(self.command(&place));
                assert_same(&self.made(&place), &whole, &format!("killed after {delay:?}"));
                self.clear(&place);
            }
        }
        println!("{}: {moments} starts killed", self.arguments[0]);
    }

    fn on_a_disk_that_fails(&self) {
        let Some(library) = LIBRARY.as_deref() else { return };
        let place = place();
        let (whole, _) = self.whole(&place);
        let mut tried = 0;
        for disk in [FULL, READ_ONLY, ONE_ERROR] {
            let count = place.path().join("count");
            let start = |from: usize| {
                let mut command = self.command(&place);
                command.env("LD_PRELOAD", library).env("FAULT_BELOW", place.path().join(self.out));
                command.env("FAULT_FROM", from.to_string()).env("FAULT_ERRNO", disk.errno.to_string());
                command.env("FAULT_COUNT", &count);
                if disk.once {
                    command.env("FAULT_ONCE", "1");
                }
                output(command)
            };
            let untouched = start(0);
            assert!(untouched.status.success(), "{}", text(&untouched.stderr));
            assert_same(&self.made(&place), &whole, "a disk that does not fail");
            let changes = fs::metadata(&count).expect("changes were counted").len() as usize;
            assert!(changes > 20, "{changes} changes");
            for moment in 0..moments() as usize {
                let from = 1 + moment * (changes - 1) / (moments() as usize - 1).max(1);
                let what = format!("{}: change {from} of {changes}, {}", self.arguments[0], disk.says);
                self.clear(&place);
                assert_one_sentence(&start(from), disk, &what);
                let left = place.path().join(self.out);
                for (name, bytes) in &whole {
                    let found = fs::read(left.join(name)).unwrap_or_default();
                    // Files that grow line by line, or that a run writes again as it goes on, are others before its end.
                    let again = ["log.jsonl", "metrics.json"].contains(&name.as_str()) || name.starts_with("model/");
                    assert!(found.is_empty() || found == *bytes || again, "{what}: {name} is half written");
                }
                succeeds(self.command(&place));
                assert_same(&self.made(&place), &whole, &what);
                tried += 1;
            }
            self.clear(&place);
            fs::remove_file(&count).expect("it was made");
        }
        println!("{}: {tried} failures", self.arguments[0]);
    }
}

/// How a disk fails.
#[derive(Clone, Copy)]
struct Disk {
    errno: i32,
    /// It works again after one failure.
    once: bool,
    /// What the system says.
    says: &'static str,
}

const FULL: Disk = Disk { errno: 28, once: false, says: "No space left on device" };
const READ_ONLY: Disk = Disk { errno: 30, once: false, says: "Read-only file system" };
const ONE_ERROR: Disk = Disk { errno: 5, once: true, says: "Input/output error" };

/// The program says in one sentence which file the disk refused, or has lost nothing by the failure.
fn assert_one_sentence(output: &Output, disk: Disk, what: &str) {
    let stderr = text(&output.stderr);
    assert!(!stderr.contains("panicked"), "{what}: {stderr}");
    if output.status.success() {
        return;
    }
    assert_eq!(output.status.code(), Some(1), "{what}: {stderr}");
    assert_eq!(stderr.matches("error: ").count(), 1, "{what}: {stderr}");
    assert!(stderr.contains(disk.says), "{what}: {stderr}");
    let advice = stderr.contains("; make room on that disk first");
    assert_eq!(advice, disk.errno == FULL.errno, "{what}: {stderr}");
}

static LIBRARY: LazyLock<Option<PathBuf>> = LazyLock::new(|| library("failing_disk"));

#[test]
fn a_training_killed_at_any_moment() {
    TRAIN.killed_at_any_moment();
}

#[test]
fn an_export_killed_at_any_moment() {
    EXPORT.killed_at_any_moment();
}

#[test]
#[ignore = "long; .ci/run has it"]
fn a_preparation_killed_at_any_moment() {
    PREPARE.killed_at_any_moment();
}

#[test]
#[ignore = "long; .ci/run has it"]
fn a_training_on_a_disk_that_fails() {
    TRAIN.on_a_disk_that_fails();
}

#[test]
fn an_export_on_a_disk_that_fails() {
    EXPORT.on_a_disk_that_fails();
}

#[test]
#[ignore = "long; .ci/run has it"]
fn a_preparation_on_a_disk_that_fails() {
    PREPARE.on_a_disk_that_fails();
}

/// An earlier export stays whole where the next one fails: every file is the old one or the new one.
#[test]
fn a_failing_export_leaves_the_earlier_files() {
    let Some(library) = LIBRARY.as_deref() else { return };
    let place = place();
    succeeds(place.program(&["export", "model", "--scene", "scene", "--views", "0", "--steps", "0", "--out", "files"]));
    let old = EXPORT.made(&place);
    succeeds(EXPORT.command(&place));
    let new = EXPORT.made(&place);
    assert!(old.iter().zip(&new).all(|(old, new)| old.0 == new.0 && old.1 != new.1), "two different exports");
    for from in [1, 2, 3, 6, 9, 12, 16, 20, 24] {
        for (name, bytes) in &old {
            fs::write(place.path().join("files").join(name), bytes).expect("writable");
        }
        let mut command = EXPORT.command(&place);
        command.env("LD_PRELOAD", library).env("FAULT_BELOW", place.path().join("files"));
        command.env("FAULT_FROM", from.to_string()).env("FAULT_ERRNO", FULL.errno.to_string());
        assert_one_sentence(&output(command), FULL, &format!("change {from}"));
        let found = EXPORT.made(&place);
        assert_eq!(found.len(), old.len(), "change {from}: nothing else is left in the folder");
        for ((found, old), new) in found.iter().zip(&old).zip(&new) {
            assert!(found == old || found == new, "change {from}: {} is half written", found.0);
        }
    }
}

/// A program that was killed holds nothing.
#[test]
fn the_lock_of_a_killed_program_is_nobodys() {
    let place = place();
    let mut child = TRAIN.command(&place).spawn().expect("the program starts");
    let lock = place.path().join(TRAIN.out).join(LOCK);
    while !lock.exists() && child.try_wait().expect("a child").is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().expect("a child");
    child.wait_with_output().expect("a child");
    assert!(lock.exists(), "killed while it was at work");
    succeeds(TRAIN.command(&place));
    assert!(!lock.exists());
}

#[test]
fn a_skip_is_a_failure_on_ci_unless_it_is_listed() {
    assert!(is_allowed(Lack::Captures, "", "") && is_allowed(Lack::Captures, "false", "node"));
    assert!(!is_allowed(Lack::Captures, "true", "") && !is_allowed(Lack::Captures, "true", "node,radv-table"));
    assert!(is_allowed(Lack::Captures, "true", "node,captures") && is_allowed(Lack::RadvTable, "true", "radv-table"));
    assert!(!is_allowed(Lack::RadvTable, "true", "radv"));
}

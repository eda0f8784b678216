//! A run is the same again and never lost: killed at any moment, stopped by a signal, out of disk, damaged checkpoints.

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::common;
use crate::common::place::{Files, Place, assert_same, failed, fails, output, send, succeeds, text, wait_until};
use crate::common::skip::{Lack, skip};
use assert_cmd::cargo::cargo_bin;
use gscream_vk::config::Settings;
use gscream_vk::train::checkpoint;
use gscream_vk::train::config::ViewOrder;
use rand::{RngExt, SeedableRng};

/// Growth, pruning, statistics and attention in the first steps; a checkpoint every third.
fn settings() -> Settings {
    let mut settings = common::settings(36);
    let train = &mut settings.train;
    train.view_order = ViewOrder::Shuffled;
    (train.log_interval, train.eval_interval, train.checkpoint_interval) = (5, 12, 3);
    settings
}

/// What every run comes to: one that nothing happened to, and how long it took with all pipelines compiled.
static WHOLE: LazyLock<(Files, Duration)> = LazyLock::new(|| {
    let place = Place::new(&settings());
    succeeds(place.train("first", &[]));
    let started = Instant::now();
    succeeds(place.train("whole", &[]));
    let duration = started.elapsed();
    let whole = place.result("whole");
    assert_same(&place.result("first"), &whole, "twice the same");
    let log = whole.iter().find(|(name, _)| name == "log.jsonl").map(|(_, bytes)| text(bytes)).expect("a log");
    assert_eq!(log.lines().count(), 8, "{log}");
    assert!(whole.iter().all(|(name, _)| !name.starts_with("checkpoints")), "a complete run keeps no checkpoints");
    (whole, duration)
});

fn assert_whole(place: &Place, run: &str, what: &str) {
    assert_same(&place.result(run), &WHOLE.0, what);
}

/// Starts a run and signals it once it has written a checkpoint of at least that step.
fn stopped(place: &Place, run: &str, step: u32, signal: &str) -> Output {
    let mut child = place.train(run, &[]).spawn().expect("the program starts");
    let there = wait_until(&mut child, || place.checkpoints(run).first().is_some_and(|newest| *newest >= step));
    assert!(there, "{}", text(&child.wait_with_output().expect("a child").stderr));
    send(&child, signal);
    child.wait_with_output().expect("a child")
}

/// A run that was stopped with two checkpoints.
fn half(place: &Place, run: &str) {
    let output = stopped(place, run, 6, "INT");
    assert_eq!(output.status.code(), Some(130), "{}", text(&output.stderr));
    assert_eq!(place.checkpoints(run).len(), 2);
}

#[test]
fn killed_at_a_few_moments_it_comes_to_the_same_end() {
    kill_at(4);
}

#[test]
#[ignore = "long; .ci/run has it"]
fn killed_at_any_moment_it_comes_to_the_same_end() {
    kill_at(20);
}

/// Kills runs once in each of so many equal parts of a whole one, and goes on with them.
fn kill_at(moments: u32) {
    let whole = WHOLE.1;
    let place = Place::new(&settings());
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(20);
    let (mut runs, mut resumed) = (0, 0);
    let mut run = String::new();
    for moment in 0..moments {
        // One in each part of a whole run, from its first instant to its last; where the program was quicker than
        // that, a little earlier in a new run.
        let mut delay = whole.mul_f64((f64::from(moment) + rng.random::<f64>()) / f64::from(moments));
        for attempt in 0.. {
            assert!(attempt < 20, "no run lasts {delay:?}");
            let mut child = if run.is_empty() {
                runs += 1;
                run = format!("run{runs}");
                place.train(&run, &[])
            } else if place.path().join(&run).join("run.json").exists() {
                resumed += 1;
                place.resume(&run)
            } else {
                // Killed before it had begun.
                fails(place.resume(&run), 1);
                place.train(&run, &[])
            }
            .spawn()
            .expect("the program starts");
            std::thread::sleep(delay);
            child.kill().expect("a child");
            let output = child.wait_with_output().expect("a child");
            if output.status.signal() == Some(9) {
                // A run is killed a few times before it may end.
                if moment % 3 == 2 && place.path().join(&run).join("run.json").exists() {
                    succeeds(place.resume(&run));
                    assert_whole(&place, &run, &format!("killed last after {delay:?}"));
                    run.clear();
                }
                break;
            }
            assert!(output.status.success(), "{}", text(&output.stderr));
            assert_whole(&place, &run, "ended before it could be killed");
            run.clear();
            delay = delay.mul_f64(0.8);
        }
    }
    if !run.is_empty() {
        succeeds(place.resume(&run));
        assert_whole(&place, &run, "at last");
    }
    println!("{moments} kills of {runs} runs, {resumed} of them resumed before");
}

/// The same command line starts a run, goes on with it, and leaves it alone once it is complete.
#[test]
fn resume_or_start_does_what_is_missing() {
    let place = Place::new(&settings());
    let again = |more: &[&str]| place.train("run", &[&["--resume-or-start"], more].concat());
    let mut child = again(&[]).spawn().expect("the program starts");
    assert!(wait_until(&mut child, || place.checkpoints("run").first().is_some_and(|newest| *newest >= 6)));
    child.kill().expect("a child");
    child.wait_with_output().expect("a child");
    // Other settings, and another scene: nothing is touched.
    let before = place.checkpoints("run");
    let stderr = fails(again(&["--seed", "7"]), 1);
    let says = "error: run: holds a run with other settings, train.seed was 0 and is 7: choose another --out, or --overwrite it";
    assert!(stderr.contains(says), "{stderr}");
    copy(&place.path().join("scene"), &place.path().join("other"));
    let arguments = ["train", "other", "--config", "settings.toml", "--out", "run", "--resume-or-start"];
    let stderr = fails(place.program(&arguments), 1);
    assert!(
        stderr.contains("run: holds a run of another scene, ") && stderr.contains("/other was asked for"),
        "{stderr}"
    );
    assert_eq!(place.checkpoints("run"), before);
    let output = succeeds(again(&[]));
    assert!(text(&output.stderr).contains("resuming: behind step"), "{}", text(&output.stderr));
    assert_whole(&place, "run", "resumed by the same command line");
    let output = succeeds(again(&[]));
    assert_eq!(text(&output.stdout), "run: the run is complete (36 steps): nothing to do\n");
    assert_whole(&place, "run", "left alone");
    fails(again(&["--overwrite"]), 2);
}

/// Two programs that write into one run folder would mix their settings and models.
#[test]
fn of_two_programs_in_a_run_folder_the_second_says_so() {
    let place = Place::new(&settings());
    let mut child = place.train("run", &[]).spawn().expect("the program starts");
    let model = place.path().join("run/model/weights.safetensors");
    assert!(wait_until(&mut child, || model.is_file() && !place.checkpoints("run").is_empty()));
    // It stands still meanwhile, and is there.
    send(&child, "STOP");
    let says = "run: another gscream-vk is at work in this folder: wait until it has ended, or name another folder";
    for second in [
        place.train("run", &["--seed", "7"]),
        place.train("run", &["--overwrite"]),
        place.train("run", &["--resume-or-start"]),
        place.resume("run"),
        place.program(&["export", "run"]),
    ] {
        let stderr = fails(second, 1);
        assert!(stderr.ends_with(&format!("error: {says}\n")), "{stderr}");
    }
    send(&child, "CONT");
    let output = child.wait_with_output().expect("a child");
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_whole(&place, "run", "others tried");
}

/// `--overwrite` that ends while it takes the old run away leaves no run that says complete without its model.
#[test]
fn a_run_half_taken_away_is_not_complete() {
    let place = Place::new(&settings());
    succeeds(place.train("run", &[]));
    // What cannot be removed ends it where a kill would.
    let log = place.path().join("run/log.jsonl");
    fs::remove_file(&log).expect("a log");
    fs::create_dir_all(log.join("mine")).expect("writable");
    let stderr = fails(place.train("run", &["--overwrite"]), 1);
    assert!(stderr.contains("error: run/log.jsonl: cannot be removed"), "{stderr}");
    assert!(!place.path().join("run/model/point_cloud.ply").exists(), "the model went before");
    fs::remove_dir_all(&log).expect("writable");
    let output = succeeds(place.train("run", &["--resume-or-start"]));
    assert!(text(&output.stderr).contains("no checkpoint yet, the run starts again"), "{}", text(&output.stderr));
    assert_whole(&place, "run", "half taken away");
}

/// GETs a path, or sends whatever bytes; what came back.
fn ask(address: &str, request: &[u8]) -> Vec<u8> {
    let mut answer = vec![];
    let Ok(mut stream) = TcpStream::connect(address) else { return answer };
    let _ = stream.set_read_timeout(Some(Duration::from_secs(60)));
    let _ = stream.write_all(request);
    let _ = stream.read_to_end(&mut answer);
    answer
}

/// Visitors see pictures, send nonsense, go away in the middle, and change no byte.
#[test]
fn visitors_change_no_byte() {
    let place = Place::new(&settings());
    let mut child = place.train("run", &["--view=127.0.0.1:0"]).spawn().expect("the program starts");
    let mut stderr = BufReader::new(child.stderr.take().expect("it is piped"));
    let mut said = String::new();
    let address = loop {
        let mut line = String::new();
        assert!(stderr.read_line(&mut line).expect("text") > 0, "{said}");
        said += &line;
        if let Some(url) = line.trim_end().strip_prefix("view: http://") {
            break url.trim_end_matches('/').to_owned();
        }
    };
    let (address, secret) = address.split_once('/').expect("an address and the secret");
    let (address, secret) = (address.to_owned(), secret.to_owned());
    // Two programs cannot serve at one place; the second says so and leaves nothing.
    let other = fails(place.train("other", &[&format!("--view={address}")]), 1);
    assert!(
        other.contains(&format!("error: {address}: another program serves there; --view=127.0.0.1:0 takes a free one"))
    );
    assert!(!place.path().join("other").exists());
    let get = |path: &str| format!("GET /{secret}{path} HTTP/1.1\r\nHost: {address}\r\n\r\n").into_bytes();
    let page = text(&ask(&address, &get("/")));
    assert!(
        page.starts_with("HTTP/1.1 200") && !page.contains("src=\"http") && !page.contains("href=\"http"),
        "{page}"
    );
    let picture = |x: f64| get(&format!("/picture.jpg?c={x},0,0&r=1,0,0,0,1,0,0,0,1&f=1,1&s=48,36"));
    let pictures = AtomicUsize::new(0);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for visitor in 0..4 {
            let (address, get, picture, pictures, over) = (&address, &get, &picture, &pictures, &over);
            scope.spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    if visitor == 3 {
                        ask(address, &get("/picture.jpg?c=NaN,0,0&r=1,0,0,0,1,0,0,0,1&f=1,1&s=99999,36"));
                        ask(address, &get("/state.json"));
                        ask(address, &[0xff; 3000]);
                        // Gone before the answer.
                        if let Ok(mut stream) = TcpStream::connect(address) {
                            let _ = stream.write_all(&picture(0.1));
                        }
                    }
                    let answer = ask(address, &picture(0.1 * f64::from(visitor)));
                    if answer.starts_with(b"HTTP/1.1 200") && answer.windows(2).any(|w| w == [0xff, 0xd8]) {
                        pictures.fetch_add(1, Ordering::Relaxed);
                    }
                    std::thread::sleep(Duration::from_millis(5));
                }
            });
        }
        stderr.read_to_string(&mut said).expect("text");
        assert!(child.wait().expect("a child").success(), "{said}");
        over.store(true, Ordering::Relaxed);
    });
    println!("{} pictures", pictures.load(Ordering::Relaxed));
    assert!(pictures.load(Ordering::Relaxed) > 0, "{said}");
    assert_whole(&place, "run", "visited");
}

/// Killed between the record that says so and the removal of its checkpoints, a run is complete.
#[test]
fn a_complete_run_is_rid_of_checkpoints_left_behind() {
    let place = Place::new(&settings());
    half(&place, "run");
    let (checkpoints, aside) = (place.path().join("run/checkpoints"), place.path().join("aside"));
    std::fs::rename(&checkpoints, &aside).expect("a folder to set aside");
    std::fs::create_dir(&checkpoints).expect("a folder");
    for file in std::fs::read_dir(&aside).expect("a folder") {
        let file = file.expect("a file");
        std::fs::copy(file.path(), checkpoints.join(file.file_name())).expect("a copy");
    }
    succeeds(place.resume("run"));
    assert_whole(&place, "run", "complete");
    std::fs::rename(&aside, &checkpoints).expect("put back");
    assert_eq!(place.checkpoints("run").len(), 2);
    succeeds(place.resume("run"));
    assert_whole(&place, "run", "complete, with checkpoints put back");
}

#[test]
fn a_barrier_after_every_pass_changes_no_byte() {
    let place = Place::new(&settings());
    succeeds(place.train("serial", &["--serialize"]));
    assert_whole(&place, "serial", "--serialize");
}

#[test]
fn signals_end_a_run_with_a_checkpoint() {
    let place = Place::new(&settings());
    for (run, signal, name, code) in [("int", "INT", "SIGINT", 130), ("term", "TERM", "SIGTERM", 143)] {
        let output = stopped(&place, run, 3, signal);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        let newest = place.checkpoints(run)[0];
        let line = format!("error: stopped by {name}; `gscream-vk train --resume {run}` goes on behind step {newest}");
        assert_eq!(stderr.lines().last(), Some(line.as_str()));
        assert!(!stderr.contains("panicked"), "{stderr}");
        succeeds(place.resume(run));
        assert_whole(&place, run, signal);
    }
}

#[test]
fn a_complete_run_is_left_alone() {
    let place = Place::new(&settings());
    succeeds(place.train("run", &[]));
    let times = || {
        let files = place.result("run").into_iter().map(|(name, _)| name).chain(["run.json".to_owned()]);
        let time = |name: String| fs::metadata(place.path().join("run").join(&name)).and_then(|m| m.modified());
        files.map(|name| time(name).expect("a file")).collect::<Vec<_>>()
    };
    let before = times();
    let output = succeeds(place.resume("run"));
    assert_eq!(text(&output.stdout), "run: the run is complete (36 steps): nothing to do\n");
    assert_eq!(times(), before);
    fails(place.resume("scene"), 1);
    fails(place.program(&["train", "--resume", "run", "--seed", "2"]), 2);

    // What the new run does not write goes all the same.
    let stale = ["test/stale.png", "trace.json", "checkpoints/step-00000004.safetensors", ".log.jsonl.a1B2c3"];
    fs::create_dir(place.path().join("run/checkpoints")).expect("writable");
    for name in stale {
        fs::write(place.path().join("run").join(name), "old").expect("writable");
    }
    fs::write(place.path().join("run/notes.txt"), "mine").expect("writable");
    succeeds(place.train("run", &["--overwrite"]));
    fs::remove_file(place.path().join("run/notes.txt")).expect("what is not the program's stays");
    assert_whole(&place, "run", "--overwrite");
}

/// Copies a run folder.
fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).expect("writable");
    for entry in fs::read_dir(from).expect("a folder") {
        let path = entry.expect("readable").path();
        let target = to.join(path.file_name().expect("a name"));
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(&path, &target).expect("writable");
        }
    }
}

#[test]
#[ignore = "long; .ci/run has it"]
fn checkpoints_that_are_not_the_runs_own_are_refused() {
    let place = Place::new(&settings());
    half(&place, "half");
    let [newest, before] = <[u32; 2]>::try_from(place.checkpoints("half")).expect("two");
    let run = place.path().join("half");
    let (newest, before) = (checkpoint::path(&run, newest), checkpoint::path(&run, before));
    let bytes = fs::read(&newest).expect("a checkpoint");
    let name = |path: &PathBuf| path.file_name().expect("a name").to_string_lossy().into_owned();

    let flipped = |at: usize| {
        let mut bytes = bytes.clone();
        bytes[at] ^= 1;
        bytes
    };
    let edited = |from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).expect("it is in the header");
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    let damaged = "is damaged: its contents do not have the hash written into it";
    for (case, contents, reason) in [
        ("half of it", bytes[..bytes.len() / 2].to_vec(), "is cut off or damaged: no whole safetensors file"),
        ("nothing", vec![], "is cut off or damaged: no whole safetensors file"),
        ("a byte less", bytes[..bytes.len() - 1].to_vec(), "is cut off or damaged: no whole safetensors file"),
        ("a bit of a tensor", flipped(bytes.len() - 9), damaged),
        ("another step", edited("{\\\"step\\\":", "{\\\"ztep\\\":"), damaged),
        (
            "another format",
            edited("checkpoint 1", "checkpoint 9"),
            "is of another format: gscream-vk checkpoint 9, where",
        ),
    ] {
        fs::write(&newest, contents).expect("writable");
        let folder = place.path().join("case");
        copy(&run, &folder);
        let output = succeeds(place.resume("case"));
        let stderr = text(&output.stderr);
        assert!(stderr.contains(&format!("refused: case/checkpoints/{}: {reason}", name(&newest))), "{case}: {stderr}");
        assert!(stderr.contains(&format!("(case/checkpoints/{})", name(&before))), "{case}: {stderr}");
        assert_whole(&place, "case", case);
        fs::remove_dir_all(folder).expect("writable");
    }

    // The one of a run with other settings, and the one before it of this.
    let mut other = settings();
    other.train.seed = 7;
    fs::write(place.path().join("settings.toml"), other.to_toml()).expect("writable");
    half(&place, "other");
    fs::write(place.path().join("settings.toml"), settings().to_toml()).expect("writable");
    let foreign = place.path().join("other");
    fs::copy(checkpoint::path(&foreign, place.checkpoints("other")[0]), &newest).expect("writable");
    copy(&run, &place.path().join("case"));
    let stderr = text(&succeeds(place.resume("case")).stderr);
    let reason = "is of a run with other settings: train.seed was 7 and is 0";
    assert!(stderr.contains(reason), "{stderr}");
    assert_whole(&place, "case", reason);

    // Nothing but those: the run is not begun again without a word.
    fs::copy(&newest, &before).expect("writable");
    let stderr = fails(place.resume("half"), 1);
    assert!(stderr.contains("error: half: no checkpoint to go on from; `train --overwrite` starts again"), "{stderr}");
    assert_eq!(stderr.matches(reason).count(), 2, "{stderr}");
    assert_eq!(place.checkpoints("half").len(), 2, "they are left alone");
}

#[test]
fn another_scene_is_refused_and_a_moved_one_is_not() {
    let place = Place::new(&settings());
    half(&place, "run");
    let photograph = place.path().join("scene/images/train_002.png");
    let aside = place.path().join("aside.png");
    let before = place.checkpoints("run");
    fs::rename(&photograph, &aside).expect("writable");
    let stderr = fails(place.resume("run"), 1);
    assert!(stderr.contains("is of another scene: the train view train_002 is not there"), "{stderr}");
    image::RgbImage::new(48, 36).save(&photograph).expect("writable");
    let stderr = fails(place.resume("run"), 1);
    assert!(stderr.contains("is of another scene: the train view train_002 is another"), "{stderr}");
    fs::write(&photograph, "no picture").expect("writable");
    fails(place.resume("run"), 1);
    assert_eq!(place.checkpoints("run"), before);
    fs::rename(&aside, &photograph).expect("writable");
    fs::rename(place.path().join("scene"), place.path().join("moved")).expect("writable");
    let stderr = fails(place.resume("run"), 1);
    assert!(stderr.contains("there is no such folder"), "{stderr}");
    succeeds(place.program(&["train", "moved", "--resume", "run"]));
    assert_whole(&place, "run", "a moved scene");
}

#[test]
fn without_room_for_a_checkpoint_the_last_one_stays() {
    let place = Place::new(&settings());
    half(&place, "run");
    let before = place.checkpoints("run");
    let bytes = |step: u32| fs::read(checkpoint::path(&place.path().join("run"), step)).expect("a checkpoint");
    let kept = before.iter().map(|step| bytes(*step)).collect::<Vec<_>>();
    // Files of at most 64 blocks: the log fits, a checkpoint does not. The system then fails the write like a full disk
    // does, unless its signal is left to kill the program.
    let mut limited = Command::new("sh");
    limited.args(["-c", "trap '' XFSZ; ulimit -f 64; exec \"$0\" train --resume run"]).arg(cargo_bin!("gscream-vk"));
    limited.current_dir(place.path()).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    let output = output(limited);
    // Mesa's newer software drivers keep device memory in files without a name: what lies beyond the limit is not there.
    if output.status.signal() == Some(signal_hook::consts::SIGBUS) {
        skip(Lack::MemoryWithoutFiles, "to this driver a limit of files is one of device memory, and ends the program");
        return;
    }
    let stderr = failed(output, 1);
    assert!(stderr.contains("the checkpoint cannot be written: File too large"), "{stderr}");
    assert!(stderr.contains(&format!("`gscream-vk train --resume run` goes on behind step {}", before[0])), "{stderr}");
    assert_eq!(place.checkpoints("run"), before);
    assert!(before.iter().map(|step| bytes(*step)).eq(kept), "the checkpoints are as they were");
    succeeds(place.resume("run"));
    assert_whole(&place, "run", "room was made");
}

#[test]
fn folders_that_cannot_be_written_are_one_clear_error() {
    let place = Place::new(&settings());
    fs::write(place.path().join("file"), "").expect("writable");
    let stderr = fails(place.train("file/run", &[]), 1);
    assert!(stderr.contains("error: file/run: cannot be made"), "{stderr}");
    // A file where the checkpoints would go.
    fs::create_dir(place.path().join("run")).expect("writable");
    fs::write(place.path().join("run/checkpoints"), "").expect("writable");
    let stderr = fails(place.train("run", &[]), 1);
    assert!(stderr.contains("step-00000003.safetensors: the checkpoint cannot be written"), "{stderr}");
    assert!(stderr.contains("there is no checkpoint to go on from"), "{stderr}");
    fs::remove_file(place.path().join("run/checkpoints")).expect("writable");
    let output = succeeds(place.resume("run"));
    assert!(text(&output.stderr).contains("resuming: no checkpoint yet, the run starts again"));
    assert_whole(&place, "run", "the folder was made writable");

    // The pictures' folder, which is written last: everything before it is kept.
    fs::create_dir(place.path().join("late")).expect("writable");
    fs::write(place.path().join("late/test"), "").expect("writable");
    let stderr = fails(place.train("late", &[]), 1);
    assert!(stderr.contains("the picture cannot be written"), "{stderr}");
    assert_eq!(place.checkpoints("late")[0], 36);
    fs::remove_file(place.path().join("late/test")).expect("writable");
    let output = succeeds(place.resume("late"));
    assert!(text(&output.stderr).contains("resuming: behind step 36"));
    assert_whole(&place, "late", "only the last evaluation was missing");
}

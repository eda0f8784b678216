//! Devices as they are met: threads that share one, drivers that lack something, drivers on top of something else.

use std::path::{Path, PathBuf};

use crate::common::skip::{Lack, skip};
use assert_cmd::Command;
use gscream_vk::gpu::kernels::primitives::limit;
use gscream_vk::gpu::{Descriptors, Gpu, Options, testing};
use gscream_vk::primitives::dispatch::Count;
use gscream_vk::primitives::scan::Scan;
use predicates::prelude::PredicateBooleanExt as _;
use predicates::str::contains;

/// Chromium's software device, which has no push descriptors, and subgroups of 4.
const SWIFTSHADER: &str = "/usr/lib/chromium/libvk_swiftshader.so";
/// Mesa's.
const LAVAPIPE: &str = "/usr/share/vulkan/icd.d/lvp_icd.x86_64.json";
const RADV: &str = "/usr/share/vulkan/icd.d/radeon_icd.x86_64.json";

/// The sum of `terms` and the sum before the last of them.
fn scanned(gpu: &Gpu, scan: &Scan, terms: &[u32]) -> [u32; 2] {
    let input = gpu.upload("terms", terms).expect("room");
    let prefix = gpu.buffer("prefix", terms.len()).expect("room");
    let total = gpu.buffer("total", 1).expect("room");
    let mut rec = gpu.recorder().expect("a recorder");
    scan.record(&mut rec, &input, &prefix, &total, Count::Host(terms.len() as u32));
    rec.submit().expect("the device takes it").wait().expect("the device runs it");
    [gpu.read(&total).expect("readable")[0], gpu.read(&prefix).expect("readable")[terms.len() - 1]]
}

/// The layer reports what two threads do to one object at a time.
#[test]
fn threads_share_a_device() {
    let gpu = testing::gpu();
    std::thread::scope(|scope| {
        for thread in 0..4u32 {
            let gpu: Gpu = gpu.clone();
            scope.spawn(move || {
                let scan = Scan::new(&gpu, 5000).expect("room");
                for round in 0..25 {
                    let terms: Vec<u32> = (0..5000).map(|i| i * (thread + 1) + round).collect();
                    let sum: u32 = terms.iter().sum();
                    assert_eq!(scanned(&gpu, &scan, &terms), [sum, sum - terms[4999]], "thread {thread}");
                    if round % 10 == 9 {
                        gpu.wait_idle().expect("the device is there");
                    }
                }
            });
        }
    });
}

/// More than one pool holds, twice, so that pools are used again.
#[test]
fn any_number_of_sets_is_bound() {
    let gpu = testing::gpu_with(Options { descriptors: Descriptors::Sets, ..Options::default() });
    const PASSES: usize = 1100;
    let wanted: Vec<_> = (0..PASSES as u32).map(|i| gpu.upload("wanted", &[i]).expect("room")).collect();
    let count: Vec<_> = (0..PASSES).map(|_| gpu.buffer::<u32>("count", 1).expect("room")).collect();
    let overflow = gpu.upload("overflow", &[0]).expect("room");
    let counters = gpu.upload("counters", &[0]).expect("room");
    for capacity in [2000, 500] {
        let mut rec = gpu.recorder().expect("a recorder");
        for (wanted, count) in wanted.iter().zip(&count) {
            let buffers = limit::Buffers { wanted, count, overflow: &overflow, counters: &counters };
            // Once more with the same: one set for both.
            for _ in 0..2 {
                rec.run(limit::Kernel, buffers, limit::Push { capacity, bit: 0, counter: 0 }, 1u32);
            }
        }
        rec.submit().expect("the device takes it").wait().expect("the device runs it");
        for (i, count) in count.iter().enumerate() {
            let fits = i as u32 <= capacity;
            assert_eq!(gpu.read(count).expect("readable"), [if fits { i as u32 } else { 0 }], "{i} of {capacity}");
        }
        assert_eq!(gpu.read(&overflow).expect("readable"), [u32::from(capacity < PASSES as u32)]);
    }
}

/// The program with no driver but the one of this description.
fn with_driver(icd: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("gscream-vk").expect("the program");
    command.args(arguments).env("VK_ICD_FILENAMES", icd).env("VK_DRIVER_FILES", icd).env_remove("GSCREAM_DEVICE");
    command
}

/// Writes a driver's description.
fn describe(folder: &Path, library: &str, portability: bool) -> PathBuf {
    let icd = serde_json::json!({
        "file_format_version": "1.0.1",
        "ICD": { "library_path": library, "api_version": "1.3.0", "is_portability_driver": portability },
    });
    let path = folder.join("icd.json");
    std::fs::write(&path, icd.to_string()).expect("a writable folder");
    path
}

/// MoltenVK is such a driver: the loader hides those from programs that do not ask.
#[test]
fn drivers_on_top_of_something_else_are_listed() {
    let Ok(lavapipe) = std::fs::read(LAVAPIPE) else {
        skip(Lack::Lavapipe, &format!("no {LAVAPIPE} (Debian: mesa-vulkan-drivers)"));
        return;
    };
    let lavapipe: serde_json::Value = serde_json::from_slice(&lavapipe).expect("JSON");
    let library = lavapipe["ICD"]["library_path"].as_str().expect("a path");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let icd = describe(folder.path(), library, true);
    with_driver(&icd, &["devices"]).assert().success().stdout(contains("llvmpipe").and(contains("usable")));
}

/// Mesa's null device is a GPU by its kind: it comes before lavapipe, a CPU, whichever driver the loader asks first.
#[test]
fn gpus_are_listed_before_cpus() {
    for (driver, lack) in [(LAVAPIPE, Lack::Lavapipe), (RADV, Lack::Radv)] {
        if !Path::new(driver).is_file() {
            skip(lack, &format!("no {driver} (Debian: mesa-vulkan-drivers)"));
            return;
        }
    }
    for drivers in [[LAVAPIPE, RADV], [RADV, LAVAPIPE]] {
        let drivers = std::env::join_paths(drivers).expect("paths without a colon");
        let mut command = with_driver(Path::new(&drivers), &["devices", "--json"]);
        let output = command.env("RADV_FORCE_FAMILY", "gfx1100").output().expect("the program starts");
        let devices: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let names: Vec<&str> = devices.as_array().expect("a list").iter().filter_map(|d| d["name"].as_str()).collect();
        assert!(names.len() == 2 && names[1].contains("llvmpipe"), "{drivers:?}: {names:?}");
    }
}

#[test]
#[ignore = "long; .ci/run has it"]
fn a_device_without_push_descriptors_has_sets() {
    if !Path::new(SWIFTSHADER).is_file() {
        skip(Lack::SwiftShader, &format!("no {SWIFTSHADER} (Debian: chromium)"));
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let icd = describe(folder.path(), SWIFTSHADER, false);
    let listed = with_driver(&icd, &["devices"]).assert().success();
    listed.stdout(contains("subgroups of 4").and(contains("usable; no push descriptors: descriptor sets")));
    let train = |how: &str| {
        let out = folder.path().join(how);
        let mut command = with_driver(&icd, &["train", "synthetic", "--preset", "demo", "--downscale", "4"]);
        command.args(["--iterations", "3", "--descriptors", how, "--out"]).arg(&out).assert()
    };
    train("push").code(1).stderr(contains("it lacks push descriptors, which --descriptors sets does without"));
    for how in ["auto", "sets"] {
        train(how).success();
    }
}

//! What AMD's compiler makes of the kernels, on Mesa's null device: it needs no GPU and runs nothing.

use std::path::Path;

use crate::common::skip::{Lack, skip};
use assert_cmd::Command;

/// Mesa whose figures the snapshots are.
const DRIVER: &str = "radv Mesa 22.3.6";
const ICD: &str = "/usr/share/vulkan/icd.d/radeon_icd.x86_64.json";

fn on_null_device(family: &str, arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("gscream-vk").expect("the program");
    command.args(arguments).env("RADV_FORCE_FAMILY", family).env("VK_ICD_FILENAMES", ICD).env("VK_DRIVER_FILES", ICD);
    command
}

/// True where Mesa's RADV is installed; otherwise says that it is not.
fn installed() -> bool {
    let there = Path::new(ICD).is_file();
    if !there {
        skip(Lack::Radv, &format!("no {ICD} (Debian: mesa-vulkan-drivers)"));
    }
    there
}

/// Fewest subgroups that a SIMD unit of gfx1100 holds of every kernel: so many hide what a load takes.
const WAVES: u64 = 8;

/// Kernels that spill registers on some device, or of which gfx1100 holds fewer, and why.
const EXCEPTIONS: &[(&str, &str)] = &[];

/// Nothing spills, and enough subgroups run beside one another.
fn assert_room(family: &str, subgroup: &str, kernels: &[serde_json::Value]) {
    let excepted = |k: &serde_json::Value| EXCEPTIONS.iter().any(|(name, _)| k["kernel"] == *name);
    for k in kernels.iter().filter(|k| !excepted(k)) {
        let place = format!("{} on {family} with subgroups of {subgroup}", k["kernel"]);
        assert_eq!(k["spilled"], 0, "{place} spills");
        let occupancy = k["occupancy"].as_u64().expect("a number");
        assert!(family != "gfx1100" || occupancy >= WAVES, "{place}: {occupancy} subgroups for a SIMD unit");
    }
}

/// Registers, spills and occupancy hold what they held. A change that makes one worse shows here; one that makes it better
/// is taken over by `INSTA_UPDATE=always`.
#[test]
fn registers_and_spills_are_those_of_the_table() {
    if !installed() {
        return;
    }
    // `own`: as a training runs there, subgroups of 64 but where a kernel asks for the least.
    for (family, subgroup) in [("gfx1100", "own"), ("gfx1100", "32"), ("navi21", "own"), ("vega10", "own")] {
        let attention = "model.attention.enabled=true";
        let mut arguments = vec!["kernels", "synthetic", "--preset", "demo", "--set", attention, "--json"];
        if subgroup != "own" {
            arguments.extend(["--subgroup", subgroup]);
        }
        let output = on_null_device(family, &arguments).output().expect("it runs");
        assert!(output.status.success(), "{family}: {}", String::from_utf8_lossy(&output.stderr));
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let kernels = found["kernels"].as_array().expect("kernels");
        assert!(kernels.len() > 60, "{family}: {} kernels", kernels.len());
        assert!(kernels.iter().all(|k| k["registers"].as_u64().is_some_and(|n| n > 0)), "{family}");
        let driver = found["driver"].as_str().expect("a driver");
        if driver != DRIVER {
            skip(Lack::RadvTable, &format!("the table for {family} is of {DRIVER}, and here is {driver}"));
            continue;
        }
        assert_room(family, subgroup, kernels);
        let mut table = String::from("kernel [constants]: registers, spilled, shared bytes, occupancy\n");
        for k in kernels {
            let constants: Vec<String> =
                k["constants"].as_array().expect("words").iter().map(ToString::to_string).collect();
            table += &format!(
                "{} [{}]: {}, {}, {}, {}\n",
                k["kernel"].as_str().expect("a name"),
                constants.join(" "),
                k["registers"],
                k["spilled"],
                k["shared_bytes"],
                k["occupancy"]
            );
        }
        insta::assert_snapshot!(format!("kernels_{family}_{subgroup}"), table);
    }
}

/// As the command's help has it. The built-in scene's settings ask for stereo, which no null device could run.
#[test]
fn kernels_are_compiled_without_memory() {
    if !installed() {
        return;
    }
    let output = on_null_device("gfx1100", &["kernels", "--subgroup", "32"]).output().expect("it runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// A device without memory is refused in a sentence by what would run on it.
#[test]
fn nothing_runs_on_a_device_without_memory() {
    if !installed() {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("run");
    let out = out.to_str().expect("a plain name");
    let output =
        on_null_device("gfx1100", &["train", "synthetic", "--preset", "demo", "--out", out]).output().expect("it runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let last = said.lines().last().expect("an error");
    assert!(last.contains("needs about") && last.contains("0 MiB are free"), "{last}");
}

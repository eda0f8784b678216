//! `gscream-vk kernels`.

use std::collections::BTreeMap;

use serde::Serialize;

use super::preset;
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::config::SettingsArgs;
use crate::gpu::{Compiled, Options};
use crate::train::forecast::{self, Question};
use crate::work::{Loaded, SYNTHETIC};

/// Show what the driver's compiler makes of every kernel: time, registers, spills, shared memory, occupancy
///
/// A training is rehearsed, so that every kernel it would run is compiled; nothing runs. Drivers name their figures
/// differently: the table has those that several share, --json all of them. lavapipe gives the time alone.
///
/// No GPU is needed for AMD's: RADV_FORCE_FAMILY=gfx1100 (or navi21, vega10, polaris10) with VK_DRIVER_FILES naming Mesa's
/// radeon_icd makes a device that compiles and runs nothing.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk kernels
  gscream-vk kernels garden --preset paper --json | jq '.kernels[] | select(.spilled > 0) | .kernel'
  RADV_FORCE_FAMILY=gfx1100 VK_DRIVER_FILES=/usr/share/vulkan/icd.d/radeon_icd.x86_64.json gscream-vk kernels --subgroup 32")]
pub(super) struct Args {
    /// Folder of the scene whose training is rehearsed, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE", default_value = SYNTHETIC)]
    scene: std::path::PathBuf,
    #[command(flatten)]
    settings: SettingsArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    device: DeviceArgs,
}

/// All that was found.
#[derive(Serialize)]
struct Kernels<'a> {
    device: &'a str,
    driver: &'a str,
    subgroup_size: u32,
    kernels: Vec<Compiled>,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let given = SceneArgs { scene: args.scene.clone(), settings: args.settings.clone() };
    let Loaded { scene, settings, .. } = preset::load(&given, &args.device)?;
    // From the cache a kernel would have no compile time, and some drivers no figures.
    let options = Options { statistics: true, cache: None, ..args.device.options() };
    with_gpu(&options, |gpu| {
        // No stereo: it would run on the device, and its points change no kernel. What does not fit into the device's
        // memory is rehearsed all the same.
        let question = Question { available: Some(u64::MAX), ..Question::default() };
        forecast::forecast(gpu, &scene, &settings, question)?;
        let info = gpu.info();
        let found = Kernels {
            device: &info.name,
            driver: &info.driver,
            subgroup_size: info.subgroup_size,
            kernels: gpu.compiled(),
        };
        if args.json {
            println!("{}", serde_json::to_string_pretty(&found)?);
        } else {
            print!("{}", table(&found));
        }
        Ok(())
    })
}

/// A line per kernel and set of constants, the longest names' width wide.
fn table(found: &Kernels<'_>) -> String {
    let mut text = format!("{} ({}), subgroups of {}\n", found.device, found.driver, found.subgroup_size);
    let mut variants: BTreeMap<&str, usize> = BTreeMap::new();
    found.kernels.iter().for_each(|k| *variants.entry(k.kernel).or_default() += 1);
    let name = |k: &Compiled| {
        let constants: Vec<String> = k.constants.iter().map(u32::to_string).collect();
        if variants[k.kernel] > 1 { format!("{} [{}]", k.kernel, constants.join(" ")) } else { k.kernel.to_owned() }
    };
    let names: Vec<String> = found.kernels.iter().map(name).collect();
    let width = names.iter().map(String::len).max().unwrap_or(0).max("kernel".len());
    let cell = |value: Option<u64>| value.map_or_else(|| "-".to_owned(), |v| v.to_string());
    text += &format!(
        "{:width$}  {:>9}  {:>9}  {:>7}  {:>8}  {:>9}\n",
        "kernel", "ms", "registers", "spilled", "shared B", "occupancy"
    );
    for (k, name) in found.kernels.iter().zip(&names) {
        text += &format!(
            "{name:width$}  {:>9.1}  {:>9}  {:>7}  {:>8}  {:>9}\n",
            k.milliseconds,
            cell(k.registers),
            cell(k.spilled),
            cell(k.shared_bytes),
            cell(k.occupancy)
        );
    }
    text
}

//! Which preset a training gets that names none.

use std::path::Path;

use super::shared::{DeviceArgs, SceneArgs};
use crate::config::Settings;
use crate::gpu::{self, DeviceInfo};
use crate::scene;
use crate::work::{Loaded, SYNTHETIC};

/// Longer side of the pictures that a CPU trains on in minutes, pixels: a quarter of SPIn-NeRF's 1008.
const SIDE: f64 = 252.0;

/// A preset that was chosen.
#[derive(Debug, PartialEq, Eq)]
struct Choice {
    preset: &'static str,
    /// In place of the preset's own.
    downscale: Option<u32>,
}

/// A GPU takes the defaults. A CPU takes `demo` for the built-in scene and `gaussians` for others, reduced to about
/// [`SIDE`]; `longest` is the longer side of the scene's pictures, where it is known.
fn choose(device: &DeviceInfo, scene: &Path, longest: Option<u32>) -> Choice {
    match device.kind {
        "cpu" if scene == Path::new(SYNTHETIC) => Choice { preset: "demo", downscale: None },
        "cpu" => {
            let downscale = longest.map(|side| (f64::from(side) / SIDE).round().max(1.0) as u32);
            Choice { preset: "gaussians", downscale }
        }
        _ => Choice { preset: "gscream", downscale: None },
    }
}

/// The scene and the settings of a training: those that the arguments ask for, over a preset for the device and the size
/// of the pictures where neither --preset nor --config is given. Which one is said on stderr.
///
/// # Errors
/// As [`SceneArgs::load`]; without a usable device.
pub(super) fn load(given: &SceneArgs, device: &DeviceArgs) -> anyhow::Result<Loaded> {
    let Some((chosen, choice, device)) = choice(given, device)? else { return given.load() };
    let loaded = chosen.load()?;
    eprintln!("{}", describe(&choice, &device, &loaded.settings));
    Ok(loaded)
}

/// The arguments with the preset that [`load`] takes.
///
/// # Errors
/// Settings that make no sense; without a usable device.
pub(super) fn chosen(given: &SceneArgs, device: &DeviceArgs) -> anyhow::Result<SceneArgs> {
    Ok(choice(given, device)?.map_or_else(|| given.clone(), |(chosen, ..)| chosen))
}

/// Nothing where the arguments name a preset, or there is no scene.
fn choice(given: &SceneArgs, device: &DeviceArgs) -> anyhow::Result<Option<(SceneArgs, Choice, DeviceInfo)>> {
    let named = given.settings.preset.is_some() || given.settings.config.is_some();
    let synthetic = given.scene == Path::new(SYNTHETIC);
    if named || !(synthetic || given.scene.is_dir()) {
        return Ok(None);
    }
    // A mistake in the settings is one of theirs, and not of a preset that nobody asked for.
    given.settings.resolve()?;
    let device = gpu::device::chosen(device.device.as_deref())?;
    let choice = choose(&device, &given.scene, scene::longest_side(&given.scene));
    let mut chosen = given.clone();
    chosen.settings.preset = Some(choice.preset.to_owned());
    let own = choice.downscale.map(|n| format!("scene.downscale={n}"));
    chosen.settings.set.splice(0..0, own);
    Ok(Some((chosen, choice, device)))
}

fn describe(choice: &Choice, device: &DeviceInfo, settings: &Settings) -> String {
    let Settings { train, scene, .. } = settings;
    let size = match scene.downscale {
        1 => "the pictures' own size".to_owned(),
        n => format!("1/{n} of the pictures' size"),
    };
    let run = format!("{} steps at {size}", train.iterations);
    match choice.preset {
        "gscream" => {
            format!("preset: gscream, the defaults, for {} is no CPU: {run}; --preset names another", device.name)
        }
        preset => format!(
            "preset: {preset}, for {} is a CPU: {run}; --preset gscream has the defaults, made for a GPU",
            device.name
        ),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    fn device(kind: &'static str) -> DeviceInfo {
        DeviceInfo {
            index: 0,
            name: "Device".into(),
            kind,
            driver: String::new(),
            api: "1.3.0".into(),
            subgroup_size: 8,
            push_descriptors: true,
            max_binding_bytes: 1 << 30,
            heap_bytes: 1 << 33,
            shared_bytes: 1 << 15,
            max_groups: 65535,
            timestamp_period: 1.0,
            lacks: vec![],
        }
    }

    #[test]
    fn the_preset_follows_the_device_and_the_size() {
        let of = |kind, scene: &str, longest| {
            let Choice { preset, downscale } = choose(&device(kind), Path::new(scene), longest);
            (preset, downscale)
        };
        assert_eq!(of("cpu", SYNTHETIC, None), ("demo", None));
        assert_eq!(of("cpu", "garden", Some(1008)), ("gaussians", Some(4)));
        assert_eq!(of("cpu", "garden", Some(4032)), ("gaussians", Some(16)));
        assert_eq!(of("cpu", "garden", Some(32)), ("gaussians", Some(1)));
        assert_eq!(of("cpu", "garden", None), ("gaussians", None), "the preset's own");
        assert_eq!(of("discrete", SYNTHETIC, None), ("gscream", None));
        assert_eq!(of("integrated", "garden", Some(4032)), ("gscream", None));
    }

    #[derive(Debug, clap::Parser)]
    struct Probe {
        #[command(flatten)]
        scene: SceneArgs,
    }

    #[test]
    fn what_is_set_wins_over_the_choice() {
        let mut args =
            Probe::try_parse_from(["probe", "s", "--set", "scene.downscale=2", "--seed", "3"]).expect("parses");
        args.scene.settings.preset = Some("lavapipe".into());
        args.scene.settings.set.splice(0..0, Some("scene.downscale=7".to_owned()));
        let settings = args.scene.settings.resolve().expect("settings that make sense");
        assert_eq!((settings.scene.downscale, settings.train.iterations, settings.train.seed), (2, 4500, 3));
        let choice = Choice { preset: "gaussians", downscale: Some(7) };
        assert_eq!(
            describe(&choice, &device("cpu"), &settings),
            "preset: gaussians, for Device is a CPU: 4500 steps at 1/2 of the pictures' size; --preset gscream has the \
             defaults, made for a GPU"
        );
    }
}

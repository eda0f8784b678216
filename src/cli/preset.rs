//! Which preset a training gets that names none.

use std::path::Path;

use super::shared::{DeviceArgs, SceneArgs};
use crate::config::Settings;
use crate::gpu::{self, DeviceInfo};
use crate::work::{Loaded, SYNTHETIC};

/// A GPU takes the defaults. A CPU takes `demo` for the built-in scene and `gaussians` for others.
fn choose(device: &DeviceInfo, scene: &Path) -> &'static str {
    match device.kind {
        "cpu" if scene == Path::new(SYNTHETIC) => "demo",
        "cpu" => "gaussians",
        _ => "gscream",
    }
}

/// The scene and the settings of a training: those that the arguments ask for, over a preset for the device and the size
/// of the pictures where neither --preset nor --config is given. Which one is said on stderr.
///
/// # Errors
/// As [`SceneArgs::load`]; without a usable device.
pub(super) fn load(given: &SceneArgs, device: &DeviceArgs) -> anyhow::Result<Loaded> {
    let Some((chosen, preset, device)) = choice(given, device)? else { return given.load() };
    let loaded = chosen.load()?;
    eprintln!("{}", describe(preset, &device, &loaded.settings));
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
fn choice(given: &SceneArgs, device: &DeviceArgs) -> anyhow::Result<Option<(SceneArgs, &'static str, DeviceInfo)>> {
    let named = given.settings.preset.is_some() || given.settings.config.is_some();
    let synthetic = given.scene == Path::new(SYNTHETIC);
    if named || !(synthetic || given.scene.is_dir()) {
        return Ok(None);
    }
    // A mistake in the settings is one of theirs, and not of a preset that nobody asked for.
    given.settings.resolve()?;
    let device = gpu::device::chosen(device.device.as_deref())?;
    let preset = choose(&device, &given.scene);
    let mut chosen = given.clone();
    chosen.settings.preset = Some(preset.to_owned());
    Ok(Some((chosen, preset, device)))
}

fn describe(preset: &str, device: &DeviceInfo, settings: &Settings) -> String {
    let Settings { train, scene, .. } = settings;
    let size = match scene.downscale {
        1 => "the pictures' own size".to_owned(),
        n => format!("1/{n} of the pictures' size"),
    };
    let size = match train.coarse.until {
        0 => size,
        until => format!("{size}, the first {until} at half of that"),
    };
    let run = format!("{} steps at {size}", train.iterations);
    match preset {
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
            narrow_subgroup_size: 8,
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
    fn the_preset_follows_the_device() {
        let of = |kind, scene: &str| choose(&device(kind), Path::new(scene));
        assert_eq!(of("cpu", SYNTHETIC), "demo");
        assert_eq!(of("cpu", "garden"), "gaussians");
        assert_eq!(of("discrete", SYNTHETIC), "gscream");
        assert_eq!(of("integrated", "garden"), "gscream");
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
        args.scene.settings.fitted = vec!["scene.downscale=7".into()];
        let settings = args.scene.settings.resolve().expect("settings that make sense");
        assert_eq!((settings.scene.downscale, settings.train.iterations, settings.train.seed), (2, 4500, 3));
        assert_eq!(
            describe("gaussians", &device("cpu"), &settings),
            "preset: gaussians, for Device is a CPU: 4500 steps at 1/2 of the pictures' size; --preset gscream has the \
             defaults, made for a GPU"
        );
    }
}

//! Arguments that several commands take: a device, a scene with its settings.

use std::path::{Path, PathBuf};

use anyhow::bail;

use crate::config::{Settings, SettingsArgs};
use crate::gpu::{Descriptors, Form, Gpu, Options};
use crate::model::config;
use crate::scene::{self, Scene};
use crate::work::{Loaded, SYNTHETIC, load_scene};

/// Longer side of the pictures that a CPU trains on in minutes, pixels: a quarter of SPIn-NeRF's 1008.
const SIDE: f64 = 252.0;
/// Part of the steps of plain Gaussians that see pictures of half the size (`src/train/README.md`, "Larger pictures last").
const COARSE: f64 = 0.8;

/// Which device to compute on, and how closely to watch it.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Device")]
pub struct DeviceArgs {
    /// Index or part of the name from `gscream-vk devices` [default: the first usable one]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Run under the Khronos validation layer, synchronisation included; any message of it is an error
    #[arg(long)]
    pub validate: bool,
    /// Put a barrier after every pass instead of only where a hazard demands one
    #[arg(long)]
    pub serialize: bool,
    /// Find the pass in which a device is lost: as --serialize, and every pass notes that it ended
    #[arg(long)]
    pub trace_faults: bool,
    /// Kernels for a GPU or for a CPU driver, for comparisons [default: the device's own kind]
    #[arg(long, value_name = "FORM", hide_possible_values = true)]
    pub form: Option<Form>,
    /// Threads of a subgroup, of all kernels [default: the driver's choice, in some the least that the device has]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    subgroup: Option<u32>,
    /// How passes bind buffers: push, or sets, which every device has [default: auto, push where the device can]
    #[arg(long, value_name = "HOW", default_value = "auto", hide_default_value = true, hide_possible_values = true)]
    pub descriptors: Descriptors,
}

impl DeviceArgs {
    /// How to open the device. Compiled kernels are kept in the user's cache folder.
    pub fn options(&self) -> Options {
        Options {
            device: self.device.clone(),
            validate: self.validate,
            serialize: self.serialize,
            trace_faults: self.trace_faults,
            descriptors: self.descriptors,
            cache: self.cache(),
            form: self.form,
            subgroup_size: self.subgroup,
            ..Options::default()
        }
    }

    /// Opens the device, does the work and reports whatever the validation layer said meanwhile.
    ///
    /// # Errors
    /// Without a usable device; the work's own error; messages of the validation layer.
    pub fn with_gpu<T>(&self, work: impl FnOnce(&Gpu) -> anyhow::Result<T>) -> anyhow::Result<T> {
        with_gpu(&self.options(), work)
    }

    /// A driver ignores what another one stored, so that a name that is not unique costs time at most.
    fn cache(&self) -> Option<PathBuf> {
        let of = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let folder = of("XDG_CACHE_HOME").or_else(|| Some(of("HOME")?.join(".cache")))?;
        let device = self.device.as_deref().unwrap_or("default").to_lowercase();
        let device: String = device.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        Some(folder.join("gscream-vk").join(format!("pipelines-{device}.bin")))
    }
}

/// [`DeviceArgs::with_gpu`] with options of one's own.
///
/// # Errors
/// As [`DeviceArgs::with_gpu`].
pub fn with_gpu<T>(options: &Options, work: impl FnOnce(&Gpu) -> anyhow::Result<T>) -> anyhow::Result<T> {
    let gpu = Gpu::open(options)?;
    let result = work(&gpu);
    let messages = gpu.take_messages();
    if messages.is_empty() {
        return result;
    }
    // What failed is likely to follow from what the layer saw, so both are said.
    let failed = result.err().map_or_else(String::new, |error| format!("\nand then: {error:#}"));
    bail!("the validation layer reported {} messages:\n{}{failed}", messages.len(), messages.join("\n"))
}

/// A scene and the settings to read it with.
#[derive(Debug, Clone, clap::Args)]
pub struct SceneArgs {
    /// Folder of the scene, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// Preset, file and single settings.
    #[command(flatten)]
    pub settings: SettingsArgs,
}

impl SceneArgs {
    /// The scene, read with the resolved settings; what there is to know about it goes to stderr.
    ///
    /// # Errors
    /// Settings that make no sense; a scene that cannot be read.
    pub fn load(&self) -> anyhow::Result<Loaded> {
        Loaded::read(&self.scene, self.resolve()?)
    }

    /// The settings for this scene: a preset for CPUs reduces its pictures to the size that such a device has time for.
    ///
    /// # Errors
    /// Settings that make no sense.
    pub fn resolve(&self) -> anyhow::Result<Settings> {
        let asked = self.settings.resolve()?;
        let preset = self.settings.preset.as_deref();
        let fitted = fitted(preset, asked.train.iterations, || scene::longest_side(&self.scene));
        Ok(SettingsArgs { fitted, ..self.settings.clone() }.resolve()?)
    }

    /// The scene as a run's record names it.
    pub fn name(&self) -> String {
        if self.scene == Path::new(SYNTHETIC) {
            return SYNTHETIC.to_owned();
        }
        // Only a folder that was removed since it was read has no absolute path.
        let absolute = std::path::absolute(&self.scene).unwrap_or_else(|_| self.scene.clone());
        absolute.to_string_lossy().into_owned()
    }
}

/// Settings of a preset for CPUs that depend on the pictures' longer side, `longest` pixels, and the number of steps: anchors see
/// pictures reduced to about [`SIDE`], plain Gaussians to twice that, after [`COARSE`] of the steps on half of it. None where
/// the preset's own settings hold; no picture is looked at then.
fn fitted(preset: Option<&str>, iterations: u32, longest: impl FnOnce() -> Option<u32>) -> Vec<String> {
    let last = match preset {
        Some("lavapipe") => SIDE,
        Some("gaussians") => 2.0 * SIDE,
        _ => return vec![],
    };
    let Some(longest) = longest().map(f64::from) else { return vec![] };
    let downscale = (longest / last).round().max(1.0);
    // Nor are pictures halved that are small as they are.
    let coarse = last > SIDE && longest / downscale >= 1.5 * SIDE;
    let until = coarse.then(|| format!("train.coarse.until={}", (COARSE * f64::from(iterations)) as u32));
    std::iter::once(format!("scene.downscale={downscale}")).chain(until).collect()
}

/// A step that is measured, and how often.
#[derive(Debug, Clone, Copy, clap::Args)]
pub struct MeasureArgs {
    /// Steps trained before the measured one
    #[arg(long, value_name = "N", default_value_t = 50)]
    pub warm_up: u32,
    /// Number that the measured step counts as [default: the first with attention, or the one after the warm-up]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub step: Option<u32>,
    /// Views on which the step is measured, the reference view first
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub views: u32,
    /// Timed rounds over all there is to measure
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u32).range(1..))]
    pub repetitions: u32,
}

/// Refuses plain Gaussians for a command that knows anchors alone.
///
/// # Errors
/// One sentence.
pub fn only_anchors(settings: &Settings, command: &str) -> anyhow::Result<()> {
    if settings.model.form == config::Form::Gaussians {
        bail!(
            "{command} measures models of anchors alone: set model.form=anchors, or take a preset of anchors such as lavapipe"
        );
    }
    Ok(())
}

/// As [`load_scene`], in the lengths of the scene's files, which are those of a model on disk; what the settings say in
/// training units is brought to them.
///
/// # Errors
/// As [`load_scene`].
pub fn load_scene_of_model(scene: &Path, settings: &mut Settings) -> anyhow::Result<Scene> {
    let mut scene = load_scene(scene, settings)?;
    settings.render.near *= scene.restore_unit();
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::cli::{exit_code, message};

    #[derive(Debug, clap::Parser)]
    struct Probe {
        #[command(flatten)]
        scene: SceneArgs,
        #[command(flatten)]
        device: DeviceArgs,
    }

    fn probe(arguments: &[&str]) -> Probe {
        Probe::try_parse_from([&["probe"], arguments].concat()).expect("these arguments parse")
    }

    #[test]
    fn the_built_in_scene_is_read_like_any_other() {
        let arguments = probe(&["synthetic", "--preset", "demo", "--seed", "5", "--downscale", "4"]);
        let Loaded { scene, settings, .. } = arguments.scene.load().expect("it needs no files");
        assert_eq!((scene.train.len(), scene.train[0].camera.size), (24, [40, 30]));
        assert_eq!((settings.train.seed, settings.train.iterations), (5, 800));
        let other = probe(&["synthetic", "--seed", "6", "--downscale", "4"]).scene.load().expect("likewise");
        assert!(scene.train[0].image != other.scene.train[0].image, "the seed is that of the scene");
        assert_eq!(arguments.scene.name(), SYNTHETIC);
        let folder = probe(&["a/scene"]).scene.name();
        assert!(Path::new(&folder).is_absolute() && Path::new(&folder).ends_with("a/scene"), "{folder}");
    }

    #[test]
    fn mistakes_are_one_line() {
        let says = |arguments: &[&str]| {
            let error = probe(arguments).scene.load().expect_err("a mistake");
            (message(&error), exit_code(&error))
        };
        let (run, usage) = (1.into(), 2.into());
        assert_eq!(says(&["nowhere"]), ("error: nowhere: there is no such folder".into(), run));
        assert_eq!(
            says(&["synthetic", "--set", "model.voxl=1"]),
            ("error: --set model.voxl=1: unknown setting `model.voxl`; did you mean `model.voxel`?".into(), usage)
        );
        let error = Probe::try_parse_from(["probe", "synthetic", "--preset", "lavapip"]).expect_err("no such preset");
        assert_eq!(error.exit_code(), 2);
        assert!(error.to_string().contains("a similar value exists: 'lavapipe'"), "{error}");
        let error =
            probe(&["synthetic", "--device", "abacus"]).device.with_gpu(|_| Ok(())).expect_err("no such device");
        assert!(message(&error).starts_with("error: no device matches \"abacus\": `gscream-vk devices` lists them"));
    }

    #[test]
    fn presets_for_a_cpu_reduce_by_the_pictures_size() {
        let of = |preset: &'static str, longest: Option<u32>| fitted(Some(preset), 1000, || longest).join(" ");
        for (longest, by) in [(1008, 4), (4032, 16), (256, 1), (32, 1)] {
            assert_eq!(of("lavapipe", Some(longest)), format!("scene.downscale={by}"), "{longest}");
        }
        for (longest, by) in [(1008, 2), (4032, 8), (800, 2), (512, 1), (378, 1)] {
            let want = format!("scene.downscale={by} train.coarse.until=800");
            assert_eq!(of("gaussians", Some(longest)), want, "{longest}");
        }
        // Small pictures are not halved.
        assert_eq!([of("gaussians", Some(377)), of("gaussians", Some(32))], ["scene.downscale=1"; 2]);
        assert_eq!([of("gaussians", None), of("lavapipe", None), of("paper", Some(1008))], [""; 3]);
        assert!(fitted(None, 1000, || unreachable!("no preset, no picture")).is_empty());
    }

    #[test]
    fn the_cache_is_named_after_the_device() {
        let name = |arguments: &[&str]| {
            let cache = probe(arguments).device.options().cache.expect("a home folder");
            assert!(cache.parent().is_some_and(|folder| folder.ends_with("gscream-vk")));
            cache.file_name().expect("a file").to_string_lossy().into_owned()
        };
        assert_eq!(name(&["scene"]), "pipelines-default.bin");
        assert_eq!(name(&["scene", "--device", "NVIDIA ../H100"]), "pipelines-nvidia----h100.bin");
    }
}

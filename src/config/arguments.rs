use std::path::PathBuf;

use super::{Error, PRESETS, Settings, Source};

/// The arguments from which every command resolves its settings.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Settings")]
pub struct SettingsArgs {
    /// Start from a preset instead of the defaults
    ///
    /// gscream: the defaults, every setting written out. paper: 30,000 steps at full size, voxel 0.005 (SPIn-NeRF
    /// scenes). lavapipe: pictures of about 252 pixels and 4,500 steps, for a CPU. gaussians: the same with plain Gaussians in
    /// place of anchors. demo: the synthetic scene in minutes.
    #[arg(long, value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(PRESETS.map(|(name, _)| name)))]
    pub preset: Option<String>,
    /// TOML file whose settings replace those of the preset
    ///
    /// Keys are those of configs/gscream.toml, all of them optional. The settings.toml of an earlier run repeats it.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Replace one setting; may be given many times
    ///
    /// KEY is dotted and VALUE is TOML; quotes around a word may be left out. Examples:
    /// --set model.voxel=0.01 --set losses.depth.enabled=false --set train.view_order=sequential
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Training steps [same as --set train.iterations=N]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub iterations: Option<u32>,
    /// Seed of every random choice [same as --set train.seed=N]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..))]
    pub seed: Option<i64>,
    /// Reduce images to 1/N of their size [same as --set scene.downscale=N]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub downscale: Option<u32>,
    /// Train on this test view as the reference, and test on the others [same as --set scene.truth_reference=NAME]
    ///
    /// A test view shows the place without the object, so that its photograph is what a perfect inpainting of it would
    /// be: figures inside the mask then judge the method and not the inpainting. Its hole is its test mask; a delivered
    /// reference is set aside. The built-in scene needs none of this: its reference is exact.
    #[arg(long, value_name = "NAME")]
    pub truth_reference: Option<String>,
    /// Depth prior of that view, `stereo` or `none` [default: the one under its name, if the scene has one]
    ///
    /// `stereo` measures it over the other test views, which see the same place: what a monocular prior of that
    /// photograph would say.
    #[arg(long, value_name = "FILE", requires = "truth_reference")]
    pub truth_prior: Option<PathBuf>,
    /// Settings in place of the preset's own, below a file and single settings
    #[arg(skip)]
    pub fitted: Vec<String>,
}

impl SettingsArgs {
    /// The layers, in the order in which they win: preset, file, `--set`, explicit flags.
    pub fn sources(&self) -> Vec<Source> {
        let flag = |flag, key, value: Option<i64>| {
            value.map(|value| Source::Flag { flag, key, value: toml::Value::Integer(value) })
        };
        let text = |flag, key, value: Option<String>| {
            value.map(|value| Source::Flag { flag, key, value: toml::Value::String(value) })
        };
        // A run is evaluated from elsewhere, and the settings file knows the scene's folder only.
        let place = |path: &PathBuf| {
            let word = path.as_os_str() == "none" || path.as_os_str() == "stereo";
            let path = if word { path.clone() } else { std::path::absolute(path).unwrap_or_else(|_| path.clone()) };
            path.to_string_lossy().into_owned()
        };
        let preset = self.preset.iter().cloned().map(Source::Preset);
        let fitted = self.fitted.iter().cloned().map(Source::Set);
        let file = self.config.iter().cloned().map(Source::File);
        let set = self.set.iter().cloned().map(Source::Set);
        let flags = [
            flag("--iterations", "train.iterations", self.iterations.map(i64::from)),
            flag("--seed", "train.seed", self.seed),
            flag("--downscale", "scene.downscale", self.downscale.map(i64::from)),
            text("--truth-reference", "scene.truth_reference", self.truth_reference.clone()),
            text("--truth-prior", "scene.truth_prior", self.truth_prior.as_ref().map(place)),
        ];
        preset.chain(fitted).chain(file).chain(set).chain(flags.into_iter().flatten()).collect()
    }

    /// The settings these arguments ask for.
    ///
    /// # Errors
    /// As [`Settings::resolve`].
    pub fn resolve(&self) -> Result<Settings, Error> {
        Settings::resolve(&self.sources())
    }
}

//! Settings: as written in TOML, and resolved.
//!
//! [`Settings`] nests the `Config` of every stage; a stage owns the meaning, the default and the limits of its own.
//! Values come in layers, later ones winning: defaults, `--preset`, `--config`, `--set` in their order, explicit flags.
//! Every layer is checked by itself, so that an unknown key or a wrong type is reported with its own file and line; a
//! value that makes no sense is reported with the layer that set it.

mod arguments;
mod error;
mod invalid;
mod layer;
mod removed;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::optimizer::Group;

pub use arguments::SettingsArgs;
pub use error::{Error, Origin};
pub use invalid::{Invalid, ensure};
use layer::Layers;
pub use removed::without_removed;

/// The presets shipped with the program: name and TOML text (`configs/NAME.toml`).
pub const PRESETS: [(&str, &str); 5] = [
    ("gscream", include_str!("../../configs/gscream.toml")),
    ("paper", include_str!("../../configs/paper.toml")),
    ("lavapipe", include_str!("../../configs/lavapipe.toml")),
    ("gaussians", include_str!("../../configs/gaussians.toml")),
    ("demo", include_str!("../../configs/demo.toml")),
];

/// A preset that says only what it changes of another.
pub const CHANGES: (&str, &str) = ("gaussians", "lavapipe");

/// Every setting of a run, resolved. The defaults are the paper's; `configs/gscream.toml` lists them with comments.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Settings {
    /// The loop.
    pub train: crate::train::Config,
    /// Reading the capture.
    pub scene: crate::scene::Config,
    /// What is learnt.
    pub model: crate::model::Config,
    /// How it is drawn.
    pub render: crate::render::Config,
    /// What it is compared with.
    pub losses: crate::losses::Config,
    /// How it changes.
    pub optimizer: crate::optimizer::Config,
    /// Where anchors come and go.
    pub densify: crate::densify::Config,
}

/// One layer of settings; see [`Settings::resolve`].
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// A preset by name, one of [`PRESETS`].
    Preset(String),
    /// A TOML file.
    File(PathBuf),
    /// `key=value` with a dotted key, as given to `--set`. The value is TOML; what is not TOML is a string.
    Set(String),
    /// An explicit flag such as `--iterations`, which sets one key.
    Flag {
        /// The flag as the user typed it.
        flag: &'static str,
        /// Dotted key that it sets.
        key: &'static str,
        /// Its value.
        value: toml::Value,
    },
}

impl Settings {
    /// Lays the sources over the defaults, later ones winning, and checks the result.
    ///
    /// # Errors
    /// An unreadable file, an unknown preset, broken TOML, an unknown key, a value of a wrong type (each with file,
    /// line and key), or a value that makes no sense (with the layer that set it).
    pub fn resolve(sources: &[Source]) -> Result<Self, Error> {
        let mut layers = Layers::default();
        for source in sources {
            layers.push(source)?;
        }
        let settings = layers.settings()?;
        settings.validate().map_err(|invalid| layers.blame(invalid))?;
        Ok(settings)
    }

    /// Refuses values that no run could use; keys are dotted from the root.
    pub fn validate(&self) -> Result<(), Invalid> {
        self.scene.validate().map_err(|invalid| invalid.inside("scene"))?;
        self.train.validate().map_err(|invalid| invalid.inside("train"))?;
        self.model.validate().map_err(|invalid| invalid.inside("model"))?;
        self.render.validate().map_err(|invalid| invalid.inside("render"))?;
        self.losses.validate().map_err(|invalid| invalid.inside("losses"))?;
        self.optimizer.validate().map_err(|invalid| invalid.inside("optimizer"))?;
        self.densify.validate().map_err(|invalid| invalid.inside("densify"))?;
        let frozen = self.model.frozen;
        ensure(
            frozen == 0 || !self.densify.enabled,
            "model.frozen",
            frozen,
            "keeps Gaussians as they are, which growth splits; set densify.enabled=false",
        )
        .map_err(|invalid| invalid.against("densify.enabled"))
    }

    /// These settings with what is given in pixels turned into world units of this scene: the initial grid and the
    /// cap of the scales. What is said in world units stays.
    pub fn fitted(&self, scene: &crate::scene::Scene) -> Self {
        let mut fitted = self.clone();
        let (model, densify) = (&mut fitted.model, &mut fitted.densify);
        let asked = model.voxel_pixels > 0.0 || densify.max_pixels > 0.0;
        let Some(pixel) = asked.then(|| crate::scene::footprint(scene)).flatten() else { return fitted };
        if model.voxel <= 0.0 && model.voxel_pixels > 0.0 {
            model.voxel = model.voxel_pixels * model.voxel_factor * pixel;
        }
        if densify.max_pixels > 0.0 {
            densify.max_log_scaling = (densify.max_pixels * pixel).ln();
        }
        fitted
    }

    /// These settings for a run of so many steps: what starts and ends at a step keeps its place in the run. Rounds of
    /// growing come as often as before or more, but not below `SHORTEST_ROUND` steps, so that each has something to go
    /// by. Fewer steps take larger learning rates. Nothing is evaluated or saved on the way.
    pub fn rescheduled(&self, iterations: u32) -> Self {
        let mut new = self.clone();
        let share = f64::from(iterations) / f64::from(self.train.iterations);
        let at = |step: u32| (f64::from(step) * share).round() as u32;
        new.train.iterations = iterations;
        new.train.coarse.until = at(self.train.coarse.until);
        new.train.eval_interval = 0;
        for group in Group::ALL {
            for rate in new.optimizer.learning_rate.of_mut(group) {
                *rate *= share.powf(-RATE_EXPONENT);
            }
        }
        new.model.attention.start = at(self.model.attention.start);
        let (old, densify) = (&self.densify, &mut new.densify);
        densify.every = at(old.every).clamp(SHORTEST_ROUND.min(old.every), old.every.max(SHORTEST_ROUND));
        let visits = f64::from(densify.every) / f64::from(old.every);
        densify.min_slot_visits = (f64::from(old.min_slot_visits) * visits) as u32;
        densify.min_anchor_visits = (f64::from(old.min_anchor_visits) * visits) as u32;
        densify.from = at(old.from);
        densify.until = at(old.until).max(densify.from);
        densify.statistics_from = at(old.statistics_from);
        new
    }

    /// These settings with the rest of the schedule behind step `done` fitted to `iterations` steps in all: what starts and
    /// ends later keeps its place in the rest of the run, and learning rates go on from where they are to the same end.
    /// Nothing changes for the steps up to `done`.
    pub fn corrected(&self, done: u32, iterations: u32) -> Self {
        let mut new = self.clone();
        let old = self.train.iterations;
        let [left, rest] = [old, iterations].map(|n| f64::from(n.saturating_sub(done)));
        let stretch = rest / left.max(1.0);
        let at = |step: u32| {
            if step <= done { step } else { done + (f64::from(step - done) * stretch).round() as u32 }
        };
        new.train.iterations = iterations;
        new.train.coarse.until = at(self.train.coarse.until);
        if old > done {
            // The rate is log-linear in the step: the line through today's rate and the last one, continued to step 0.
            let [before, after] = [old, iterations.max(done + 1)].map(|n| f64::from(done) / f64::from(n));
            for group in Group::ALL {
                let rate = new.optimizer.learning_rate.of_mut(group);
                let [initial, last] = *rate;
                if initial > 0.0 && last > 0.0 && initial != last {
                    let now = initial.ln() * (1.0 - before) + last.ln() * before;
                    rate[0] = ((now - last.ln() * after) / (1.0 - after)).exp();
                }
            }
        }
        new.model.attention.start = at(self.model.attention.start);
        let densify = &mut new.densify;
        densify.statistics_from = at(self.densify.statistics_from);
        densify.from = at(self.densify.from);
        densify.until = at(self.densify.until).max(densify.from);
        new
    }

    /// The settings as TOML, every key written out; [`Settings::resolve`] reads it back to the same value.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("settings are tables of plain values")
    }
}

/// Fewest steps between two rounds of growing in a run that [`Settings::rescheduled`] has shortened.
const SHORTEST_ROUND: u32 = 25;

/// Learning rates go with the number of steps to minus this power. On spin-1 without masks 600 steps gain 0.4, 0.7 and 0.9
/// dB with 2, 3 and 5 times the paper's rates, which are for 30,000.
const RATE_EXPONENT: f64 = 0.4;

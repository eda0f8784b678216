use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// Adam's decay of the first and of the second moment.
pub const BETAS: [f64; 2] = [0.9, 0.999];

/// Adam (Kingma & Ba 2015) and the learning rate of every parameter group.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Share of the harmonics' rate that the coefficients beyond the first have (3DGS: 0.05).
    pub higher_harmonics: f64,
    /// Learning rates by group.
    pub learning_rate: LearningRates,
}

/// Declares the groups: a variant of [`Group`], the setting of its rates, and their default.
macro_rules! groups {
    ($($(#[$doc:meta])+ $group:ident: $setting:ident = $rates:expr;)+) => {
        /// Parameters that share a learning rate.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
        #[serde(rename_all = "snake_case")]
        pub enum Group { $($(#[$doc])+ $group),+ }

        impl Group {
            /// Every group, in the order of the settings.
            pub const ALL: [Self; [$(Self::$group),+].len()] = [$(Self::$group),+];

            /// The key of its rates in the settings.
            pub fn name(self) -> &'static str {
                match self { $(Self::$group => stringify!($setting)),+ }
            }
        }

        /// `[initial, final]` learning rate of each parameter group, log-linear in between; equal ends mean a constant rate
        /// and `[0, 0]` a group that is not trained.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default, expecting = "a table")]
        pub struct LearningRates { $($(#[$doc])+ pub $setting: [f64; 2]),+ }

        impl Default for LearningRates {
            fn default() -> Self {
                Self { $($setting: $rates),+ }
            }
        }

        impl LearningRates {
            /// The rates of a group.
            pub fn of(&self, group: Group) -> [f64; 2] {
                match group { $(Group::$group => self.$setting),+ }
            }

            /// The rates of a group, to be changed.
            pub fn of_mut(&mut self, group: Group) -> &mut [f64; 2] {
                match group { $(Group::$group => &mut self.$setting),+ }
            }
        }
    };
}

groups! {
    /// Offsets of the Gaussians from their anchor, multiplied by the scene radius (1.1 times the largest distance of a
    /// camera from the mean camera).
    Offset: offset = [0.01, 0.0001];
    /// Anchor features.
    Feature: feature = [0.0075, 0.0075];
    /// The six log-scales of an anchor.
    LogScaling: log_scaling = [0.007, 0.007];
    /// Opacity decoder.
    MlpOpacity: mlp_opacity = [0.002, 0.00002];
    /// Covariance decoder.
    MlpCov: mlp_cov = [0.004, 0.004];
    /// Colour decoder.
    MlpColor: mlp_color = [0.008, 0.00005];
    /// Projections of the cross-attention.
    Attention: attention = [0.002, 0.00002];
    /// Positions of plain Gaussians, multiplied by the scene radius (3DGS).
    Position: position = [0.00016, 0.0000016];
    /// Log-scales of plain Gaussians (3DGS).
    LogScale: log_scale = [0.005, 0.005];
    /// Rotations of plain Gaussians, as quaternions (3DGS).
    Quaternion: quaternion = [0.001, 0.001];
    /// Opacities of plain Gaussians, as logits (3DGS: 0.05; gsplat: half of it).
    Opacity: opacity = [0.05, 0.05];
    /// Colours of plain Gaussians: the first coefficient of their harmonics (3DGS).
    Harmonics: harmonics = [0.0025, 0.0025];
}

impl Group {
    /// Whether its rates are given for a scene of radius 1, and multiplied by the scene's.
    pub fn goes_with_radius(self) -> bool {
        matches!(self, Self::Offset | Self::Position)
    }

    /// Whether its parameters are those of plain Gaussians.
    pub fn is_plain(self) -> bool {
        matches!(self, Self::Position | Self::LogScale | Self::Quaternion | Self::Opacity | Self::Harmonics)
    }
}

impl Default for Config {
    fn default() -> Self {
        Self { epsilon: 1e-15, higher_harmonics: 0.05, learning_rate: LearningRates::default() }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        // In float32 as the device has it: below, epsilon is zero there, and 0 / 0 what a gradient of zero makes.
        ensure(
            (1e-37..=1e30).contains(&self.epsilon),
            "epsilon",
            self.epsilon,
            "must be between 1e-37 and 1e30, as float32 holds it",
        )?;
        let higher = self.higher_harmonics;
        ensure((1e-6..=1.0).contains(&higher), "higher_harmonics", higher, "must be between 0.000001 and 1")?;
        for group in Group::ALL {
            let rate = self.learning_rate.of(group);
            // An infinite rate times an update of zero is not a number.
            let positive = rate.iter().all(|end| (1e-37..=1e30).contains(end));
            ensure(
                positive || rate == [0.0, 0.0],
                &format!("learning_rate.{}", group.name()),
                format_args!("{rate:?}"),
                "must be [initial, final], both positive (1e-37 to 1e30; the decay between them is log-linear) or both 0",
            )?;
        }
        Ok(())
    }
}

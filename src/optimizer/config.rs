use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// Adam (Kingma & Ba 2015) and the learning rate of every parameter group.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Decay of the first and of the second moment.
    pub betas: [f64; 2],
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Leave what an anchor has learnt alone in steps that have no gradient for it, with its moments. In GScream (false) the
    /// moments decay between the visits of the few views that see it.
    pub lazy: bool,
    /// Steps from a group's initial to its final learning rate; 0 means `train.iterations`.
    pub schedule_length: u32,
    /// Learning rates by group.
    pub learning_rate: LearningRates,
}

/// `[initial, final]` learning rate of each parameter group, log-linear in between; equal ends mean a constant rate and
/// `[0, 0]` a group that is not trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct LearningRates {
    /// Offsets of the Gaussians from their anchor, multiplied by the scene radius (1.1 times the largest distance of a
    /// camera from the mean camera).
    pub offset: [f64; 2],
    /// Anchor features.
    pub feature: [f64; 2],
    /// The six log-scales of an anchor.
    pub log_scaling: [f64; 2],
    /// Opacity decoder.
    pub mlp_opacity: [f64; 2],
    /// Covariance decoder.
    pub mlp_cov: [f64; 2],
    /// Colour decoder.
    pub mlp_color: [f64; 2],
    /// Projections of the cross-attention.
    pub attention: [f64; 2],
}

impl Default for Config {
    fn default() -> Self {
        Self {
            betas: [0.9, 0.999],
            epsilon: 1e-15,
            lazy: false,
            schedule_length: 0,
            learning_rate: LearningRates::default(),
        }
    }
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            offset: [0.01, 0.0001],
            feature: [0.0075, 0.0075],
            log_scaling: [0.007, 0.007],
            mlp_opacity: [0.002, 0.00002],
            mlp_cov: [0.004, 0.004],
            mlp_color: [0.008, 0.00005],
            attention: [0.002, 0.00002],
        }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(
            self.betas.iter().all(|beta| (0.0..1.0).contains(beta)),
            "betas",
            format_args!("{:?}", self.betas),
            "must be two numbers, at least 0 and below 1",
        )?;
        // In float32 as the device has it: below, epsilon is zero there, and 0 / 0 what a gradient of zero makes.
        ensure(
            (1e-37..=1e30).contains(&self.epsilon),
            "epsilon",
            self.epsilon,
            "must be between 1e-37 and 1e30, as float32 holds it",
        )?;
        let rates = &self.learning_rate;
        let groups = [
            ("learning_rate.offset", rates.offset),
            ("learning_rate.feature", rates.feature),
            ("learning_rate.log_scaling", rates.log_scaling),
            ("learning_rate.mlp_opacity", rates.mlp_opacity),
            ("learning_rate.mlp_cov", rates.mlp_cov),
            ("learning_rate.mlp_color", rates.mlp_color),
            ("learning_rate.attention", rates.attention),
        ];
        for (key, rate) in groups {
            // An infinite rate times an update of zero is not a number.
            let positive = rate.iter().all(|end| (1e-37..=1e30).contains(end));
            ensure(
                positive || rate == [0.0, 0.0],
                key,
                format_args!("{rate:?}"),
                "must be [initial, final], both positive (1e-37 to 1e30; the decay between them is log-linear) or both 0",
            )?;
        }
        Ok(())
    }
}

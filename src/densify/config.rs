use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// Grid levels at which anchors grow, coarse to fine (Scaffold-GS). Level i keeps a candidate with probability
/// 1 - 0.5^(i + 1).
pub const LEVELS: u32 = 3;

/// Growing and pruning of anchors (Scaffold-GS, section 3.3).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Whether anchors grow and are pruned at all.
    pub enabled: bool,
    /// First step after which anchors may change (GScream: 1,500).
    pub from: u32,
    /// Last step after which anchors may change (GScream: 15,000).
    pub until: u32,
    /// Steps between two rounds (GScream: 100).
    pub every: u32,
    /// First step whose gradients and opacities are counted (GScream: 500).
    pub statistics_from: u32,
    /// Mean screen-space gradient (in normalised device coordinates) from which a Gaussian asks for a new anchor at
    /// the coarsest level; doubled at each finer level.
    pub gradient_threshold: f64,
    /// Cell of the coarsest of the [`LEVELS`], in voxels; each finer level divides it by 4 (16, 4, 1).
    pub coarsest_cell: f64,
    /// Count a step for a Gaussian only where it has a gradient: what only few views train is judged by these views
    /// (GScream: false).
    pub count_touched: bool,
    /// A Gaussian grows only if it was drawn in more than this many steps since the last round.
    pub min_slot_visits: u32,
    /// An anchor is pruned only if it was seen in more than this many steps.
    pub min_anchor_visits: u32,
    /// Mean opacity below which a seen anchor is pruned.
    pub min_opacity: f64,
    /// Cap of the Gaussians' log-scales (the last three of an anchor's six; natural logarithm of scene units) after
    /// pruning. It suits scenes a few units wide; infinity leaves the scales alone.
    pub max_log_scaling: f64,
    /// The same cap in pixels of the training pictures, at the median depth of the points; above 0 it takes the place of
    /// `max_log_scaling`.
    pub max_pixels: f64,
    /// Most anchors; growing stops there. 0 means no limit but memory.
    pub max_anchors: u32,
    /// Most plain Gaussians: the model has memory for so many from the first step on, and more points than that are
    /// thinned. In every round large ones are split, and those that fade below `min_opacity` become halves of others.
    pub max_gaussians: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            enabled: true,
            from: 1_500,
            until: 15_000,
            every: 100,
            statistics_from: 500,
            gradient_threshold: 0.0002,
            coarsest_cell: 16.0,
            count_touched: true,
            min_slot_visits: 40,
            min_anchor_visits: 80,
            min_opacity: 0.005,
            max_log_scaling: 0.05,
            max_pixels: 0.0,
            max_anchors: 0,
            max_gaussians: 500_000,
        }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(self.every > 0, "every", self.every, "must be at least 1")?;
        ensure(
            self.until >= self.from,
            "until",
            self.until,
            format_args!("must not be before densify.from ({}); densify.enabled = false switches it off", self.from),
        )
        .map_err(|invalid| invalid.against("from"))?;
        ensure(
            self.statistics_from <= self.from,
            "statistics_from",
            self.statistics_from,
            format_args!("must not be after densify.from ({})", self.from),
        )
        .map_err(|invalid| invalid.against("from"))?;
        ensure(
            self.gradient_threshold > 0.0 && self.gradient_threshold <= 1e30,
            "gradient_threshold",
            self.gradient_threshold,
            "must be positive, at most 1e30",
        )?;
        let cell = self.coarsest_cell;
        ensure(cell > 0.0 && cell <= 1e9, "coarsest_cell", cell, "must be positive, at most 1e9")?;
        let pixels = self.max_pixels;
        ensure((0.0..=1e6).contains(&pixels), "max_pixels", pixels, "must be a number of pixels, or 0 for none")?;
        ensure(self.max_gaussians > 0, "max_gaussians", self.max_gaussians, "must be at least 1")?;
        ensure((0.0..=1.0).contains(&self.min_opacity), "min_opacity", self.min_opacity, "must be between 0 and 1")?;
        ensure(
            self.max_log_scaling > f64::NEG_INFINITY,
            "max_log_scaling",
            self.max_log_scaling,
            "must be a number, or inf for no cap",
        )
    }
}

use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// Colour weight of the reference view's pixels inside the mask (GScream's release). Outside the mask every view weighs 1;
/// inside the mask other views weigh 0.
pub const REFERENCE_COLOR_INSIDE: f64 = 20.0;

/// L1 weight of the reference view's depth outside the mask (GScream's release).
pub const REFERENCE_DEPTH: f64 = 1.0;

/// L1 weight of the reference view's depth inside the mask (GScream's release adds 99).
pub const REFERENCE_DEPTH_INSIDE: f64 = 100.0;

/// Weights of the losses (GScream, equations 3 to 7). A weight of zero removes its term from the step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Share of 1 - SSIM in the colour loss; the rest is L1 (3DGS: 0.2).
    pub ssim_weight: f64,
    /// Let SSIM's windows beside the mask compare what other views show inside it, the object, as GScream's release does
    /// by weighting the finished map; otherwise nothing inside their masks has a gradient.
    pub ssim_across_masks: bool,
    /// The losses against depth priors.
    pub depth: Depth,
}

/// L1 between the aligned rendered depth and the prior, and the total variation of their difference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Depth {
    /// Whether depth priors are used at all.
    pub enabled: bool,
    /// L1 weight outside the mask on the other views, and the share of the gradient's weight that they have there.
    pub other_weight: f64,
    /// The multi-scale gradient of the depth difference.
    pub gradient: DepthGradient,
}

/// Total variation of the depth difference over pixels 1, 2, 4, ... apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct DepthGradient {
    /// Weight on the reference view, all pixels; other views have [`Depth::other_weight`] of it.
    pub weight: f64,
    /// Number of scales: scale s takes every 2^s-th pixel.
    pub scales: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self { ssim_weight: 0.2, ssim_across_masks: false, depth: Depth::default() }
    }
}

impl Default for Depth {
    fn default() -> Self {
        Self { enabled: true, other_weight: 0.1, gradient: DepthGradient::default() }
    }
}

impl Default for DepthGradient {
    fn default() -> Self {
        Self { weight: 0.5, scales: 4 }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure((0.0..=1.0).contains(&self.ssim_weight), "ssim_weight", self.ssim_weight, "must be between 0 and 1")?;
        let weights =
            [("depth.other_weight", self.depth.other_weight), ("depth.gradient.weight", self.depth.gradient.weight)];
        for (key, weight) in weights {
            // Beyond, a loss leaves float32.
            ensure((0.0..=1e30).contains(&weight), key, weight, "must be zero or a positive number, at most 1e30")?;
        }
        let scales = self.depth.gradient.scales;
        ensure((1..=8).contains(&scales), "depth.gradient.scales", scales, "must be between 1 and 8")
    }
}

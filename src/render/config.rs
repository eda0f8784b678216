use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// Samples below this alpha are skipped, unless the settings say otherwise.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;

/// A pixel is finished before its transmittance falls below this, unless the settings say otherwise.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;

/// What shines through where nothing covers a pixel: black (GScream).
pub const BACKGROUND: [f32; 3] = [0.0; 3];

/// How anchors become a picture. The low-pass (0.3 px^2) and the largest alpha (0.99) define the picture and are not
/// settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Gaussians at camera depth `near` or less are not drawn, in scene units (3DGS: 0.2).
    pub near: f64,
    /// Decode only the anchors whose own ellipsoid touches the view (Scaffold-GS). A Gaussian whose anchor is out of view
    /// is then not drawn; without culling every anchor is decoded in every step.
    pub cull: bool,
    /// A Gaussian does not touch a pixel where its alpha is below this (3DGS: 1/255).
    pub alpha_threshold: f64,
    /// A pixel is finished before the Gaussian that would bring its transmittance below this (3DGS: 1e-4); 0 never
    /// finishes early.
    pub transmittance_threshold: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self { near: 0.2, cull: true, alpha_threshold: ALPHA_MIN, transmittance_threshold: TRANSMITTANCE_MIN }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure((1e-30..=1e30).contains(&self.near), "near", self.near, "must be between 1e-30 and 1e30")?;
        ensure(
            (1e-6..=0.5).contains(&self.alpha_threshold),
            "alpha_threshold",
            self.alpha_threshold,
            "must be between 0.000001 and 0.5",
        )?;
        ensure(
            (0.0..=0.5).contains(&self.transmittance_threshold),
            "transmittance_threshold",
            self.transmittance_threshold,
            "must be between 0 and 0.5",
        )
    }
}

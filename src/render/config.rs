use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// How anchors become a picture. The low-pass (0.3 px^2), the alpha cut-offs and the stopping transmittance define the
/// picture and are not settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Gaussians at camera depth `near` or less are not drawn, in scene units (3DGS: 0.2).
    pub near: f64,
    /// Decode only the anchors whose own ellipsoid touches the view (Scaffold-GS). A Gaussian whose anchor is out of view
    /// is then not drawn; without culling every anchor is decoded in every step.
    pub cull: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self { near: 0.2, cull: true }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(self.near.is_finite() && self.near > 0.0, "near", self.near, "must be positive")
    }
}

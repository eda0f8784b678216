//! What was captured: cameras, photographs, masks, depth priors, points.

use serde::{Deserialize, Serialize};

/// How the capture is read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Images are reduced to 1/downscale of their size.
    pub downscale: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self { downscale: 1 }
    }
}

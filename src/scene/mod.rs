//! What was captured: cameras, photographs, masks, depth priors, points.

use serde::{Deserialize, Serialize};

/// How the capture is read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Train at 1 / `downscale` of the pictures' size. At least 1.
    pub downscale: u32,
    /// Masks are 0 on the object instead of off it.
    pub invert_masks: bool,
    /// Enlarge the train masks by a disc of this radius, in pixels at the training size.
    pub dilate_masks: u32,
    /// Where the layout has no test views, hold out the first of every `test_every` views; 0 holds out none.
    pub test_every: u32,
    /// Use the train masks.
    pub masks: bool,
    /// Use the depth priors.
    pub priors: bool,
    /// Use the inpainted reference view.
    pub reference: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            downscale: 1,
            invert_masks: false,
            dilate_masks: 0,
            test_every: 0,
            masks: true,
            priors: true,
            reference: true,
        }
    }
}

//! Static Gaussians brought closer to the anchors' own pictures: Adam on the loss of training (L1 and SSIM).

use image::RgbImage;

use super::Error;
use super::draw::{Drawer, Rates};
use crate::optimizer::schedule::Rate;
use crate::scene::Camera;
use crate::train::config::ViewOrder;
use crate::train::order::Order;
use crate::train::photographs::pack;

/// How the refinement goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Config {
    /// Steps, one view each.
    pub steps: u32,
    /// Seed of the views' order.
    pub seed: u64,
    /// Extent of the cameras, scene units: positions move in proportion.
    pub radius: f64,
}

/// Learning rates of positions (per unit of the radius), log-scales, quaternions, logits and coefficients, at the first
/// and the last step. They are those that 3D Gaussian Splatting begins with (its logits', halved as gsplat does), as the
/// Gaussians are new to their loss; a tenth at the end, where a few hundred steps must come to rest.
const RATES: [[f64; 2]; 5] = [[1.6e-4, 1.6e-5], [5e-3, 5e-4], [1e-3, 1e-4], [2.5e-2, 2.5e-3], [2.5e-3, 2.5e-4]];

fn rates(config: &Config, step: u32) -> Rates {
    let mut rates = RATES.map(|[initial, last]| Rate { initial, last }.at(step, config.steps));
    rates[0] *= config.radius;
    rates
}

/// Does the steps, each on one of the views (a camera and the anchors' picture from it); calls `progress` with the step
/// and the loss before it.
///
/// # Errors
/// When the device has no room, or is lost; those of `progress`.
pub fn run(
    drawer: &mut Drawer,
    views: &[(Camera, RgbImage)],
    config: &Config,
    mut progress: impl FnMut(u32, f32) -> Result<(), Error>,
) -> Result<(), Error> {
    if views.is_empty() {
        return Ok(());
    }
    let mut order = Order::new(views.len(), None, config.seed, ViewOrder::Shuffled);
    for step in 1..=config.steps {
        let (camera, picture) = &views[order.view(step)];
        let loss = drawer.step(camera, &pack(picture, None), step, rates(config, step))?;
        progress(step, loss)?;
    }
    Ok(())
}

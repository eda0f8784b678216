//! The plain Gaussians that a training begins with.

use std::path::Path;

use crate::config::Settings;
use crate::model::gaussians::Cloud;
use crate::model::init;
use crate::scene::Scene;
use crate::splat::read::{self, of_degree};

/// Those of the file that the settings name, in the scene's unit, with the harmonics that the settings ask for; otherwise
/// Gaussians at the scene's points.
///
/// # Errors
/// No points; a file that is no splat, or that holds fewer Gaussians than are to stay as they are.
pub fn gaussians(scene: &Scene, settings: &Settings) -> Result<Cloud, init::Error> {
    let model = &settings.model;
    if model.from.is_empty() {
        return init::gaussians(&scene.starts(), model, settings.densify.max_gaussians);
    }
    let splat = read::read(Path::new(&model.from)).map_err(|error| init::Error::From(error.to_string()))?;
    // A Gaussian that is not drawn cannot be learnt either, but those behind it keep their number.
    let mut cloud = of_degree(&splat.cloud, model.degree);
    if model.frozen as usize > cloud.len() {
        return Err(init::Error::From(format!(
            "{}: of its {} Gaussians {} cannot stay as they are; set model.frozen to fewer",
            model.from,
            cloud.len(),
            model.frozen
        )));
    }
    cloud.rescale(1.0 / scene.unit);
    Ok(cloud)
}

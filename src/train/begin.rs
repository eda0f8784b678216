//! What a training begins with.

use std::path::Path;

use super::plan::rounds;
use crate::config::Settings;
use crate::model::config::Form;
use crate::model::gaussians::Cloud;
use crate::model::init::{self, Initial};
use crate::model::stored::Stored;
use crate::scene::Scene;
use crate::splat::read::{self, of_degree};

/// The model before the first step.
#[derive(Clone, Debug)]
pub struct Beginning {
    /// The model; the networks with projections of an attention, whether there is one or not.
    pub model: Stored,
    /// Side of the anchors' grid, scene units.
    pub voxel: f64,
    /// Rows to have room for, where there are more than those of the model.
    pub rows: u32,
}

impl Beginning {
    /// Beginning of a run under these settings.
    ///
    /// # Errors
    /// Points that make no model; a file of Gaussians that cannot be begun with.
    pub fn of(scene: &Scene, settings: &Settings) -> Result<Self, init::Error> {
        let Settings { model, train, .. } = &settings.fitted(scene);
        if model.form == Form::Gaussians {
            // Room is made once, for all that may come.
            let rows = if rounds(settings).is_some() { settings.densify.max_gaussians } else { 0 };
            return Ok(Self { model: Stored::Gaussians(gaussians(scene, settings)?), voxel: 0.0, rows });
        }
        let Initial { anchors, voxel } = init::from_points(&scene.starts(), model, train.seed)?;
        let weights = init::weights(train.seed, anchors.offsets_per_anchor, true, model.opacity);
        Ok(Self { model: Stored::Anchors(anchors, weights), voxel, rows: 0 })
    }

    /// Anchors or plain Gaussians.
    pub fn count(&self) -> u32 {
        self.model.positions().len() as u32
    }
}

/// Plain Gaussians of the file that the settings name, in the scene's unit, with the harmonics that the settings ask for; otherwise
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

//! A short plain fit to the photographs, object and all: what the votes, the depths and the reference look at.

use std::path::Path;

use super::record::Batch;
use super::{Error, Request, Watch};
use crate::config::Settings;
use crate::gpu::Gpu;
use crate::model::config::Form;
use crate::model::files::POINT_CLOUD;
use crate::model::stored::Stored;
use crate::scene::Scene;
use crate::signal::Signal;
use crate::train::run::{Observer, Progress, Run};

/// The fit's folder within a prepared scene.
pub const FOLDER: &str = "prepare/fit";

/// A fit.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The plain Gaussians that were fitted, or those of a splat that the photographs are pictures of.
    pub model: Stored,
    /// What it was made with.
    pub settings: Settings,
}

/// The settings of the fit: those of the preset `gaussians`, its schedule shortened. Its Gaussians begin where the photographs have
/// been measured, and have the same colour from everywhere.
pub fn settings(request: &Request) -> Settings {
    let steps = request.fit_steps.max(1);
    let mut settings = Settings::default();
    let part = |share: f64| ((f64::from(steps) * share).round() as u32).max(1);
    let train = &mut settings.train;
    train.iterations = steps;
    train.seed = request.seed;
    train.log_interval = part(0.1);
    (train.eval_interval, train.checkpoint_interval) = (0, 0);
    settings.model.form = Form::Gaussians;
    settings.model.degree = 0;
    settings.model.attention.enabled = false;
    settings.losses.depth.enabled = false;
    let densify = &mut settings.densify;
    (densify.from, densify.until) = (part(0.15), part(0.6));
    densify.every = part(0.04);
    densify.statistics_from = part(0.05);
    (densify.min_slot_visits, densify.min_anchor_visits) = (part(0.015), part(0.03));
    densify.max_log_scaling = f64::INFINITY;
    settings
}

struct Bar<'w>(&'w mut dyn Watch);

impl Observer for Bar<'_> {
    fn step(&mut self, progress: &Progress) {
        self.0.at(u64::from(progress.step));
    }
    fn interrupted(&mut self) -> Option<Signal> {
        self.0.interrupted()
    }
}

/// Fits the photographs and keeps the model as files of the scene.
///
/// # Errors
/// Whatever training meets.
pub fn make(gpu: &Gpu, scene: &Scene, settings: Settings, watch: &mut dyn Watch) -> Result<(Batch, Fit), Error> {
    let work = tempfile::tempdir().map_err(|source| Error::Io { path: std::env::temp_dir(), source })?;
    let mut run = Run::new(gpu, scene, &settings)?;
    let summary = run.train(work.path(), &mut Bar(watch)).map_err(|error| match error.signal() {
        Some(signal) => Error::Interrupted { signal },
        None => error.cause().into(),
    })?;
    drop(run);
    let mut batch = Batch::default();
    let model = work.path().join("model");
    let path = model.join(POINT_CLOUD);
    let bytes = std::fs::read(&path).map_err(|source| Error::Io { path, source })?;
    batch.bytes(format!("{FOLDER}/{POINT_CLOUD}"), bytes, "a short fit to the photographs");
    batch.figures.insert("anchors".into(), f64::from(summary.anchors));
    let mut model = Stored::load(&model)?;
    model.rescale(1.0 / scene.unit);
    Ok((batch, Fit { model, settings }))
}

/// A fit that is there already: the splat whose pictures the photographs are.
#[derive(Clone, Debug)]
pub struct Ready {
    /// The fit.
    pub fit: Fit,
    /// A hash of what it was made of.
    pub made_of: String,
}

impl Fit {
    /// The fit in a scene's folder, whose files count in the model's units, in units of `unit` of these.
    ///
    /// # Errors
    /// Files that cannot be read.
    pub fn read(root: &Path, settings: Settings, unit: f64) -> Result<Self, Error> {
        let mut model = Stored::load(&root.join(FOLDER))?;
        model.rescale(1.0 / unit);
        Ok(Self { model, settings })
    }

    /// The positions of the anchors or of the plain Gaussians, scene units.
    pub fn positions(&self) -> &[[f32; 3]] {
        match &self.model {
            Stored::Anchors(anchors, _) => &anchors.position,
            Stored::Gaussians(cloud) => &cloud.position,
        }
    }
}

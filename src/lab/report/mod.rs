//! Error against run time: what each choice of settings buys and costs on a device.
//!
//! [`kernels`] measures one training step by stage and as a whole: GPU time from timestamp queries beside the distance
//! from the float64 reference path under the settings as they are. [`training`] measures whole runs: figures on held-out
//! views against seconds and steps. [`variants`] lists the choices,
//! [`pareto`](crate::lab::pareto) says which of them are superfluous.
//! [`figures`] says what is drawn, [`plots`](crate::lab::plots) draws it, [`page`] lays it out, [`tables`] writes the same numbers as JSON
//! and CSV.
//!
#![doc = include_str!("README.md")]

pub mod figures;
pub mod kernels;
pub mod page;
pub mod stages;
pub mod tables;
pub mod training;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::gpu::{self, DeviceInfo};
use crate::lab::variants;
use crate::train::run;

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// A training run.
    #[error(transparent)]
    Run(#[from] run::Error),
    /// No clock on the device.
    #[error(
        "{device} has no timestamp queries, so that its stages cannot be timed: measure whole runs with --training-only"
    )]
    NoTimestamps {
        /// Its name.
        device: String,
    },
    /// A scene that cannot be judged.
    #[error(
        "the scene has no test views to compare on: set scene.test_every to hold some out, or measure with --kernels-only"
    )]
    NoTestViews,
    /// A temporary folder for a run.
    #[error("no temporary folder for a training run can be made: {0}")]
    Temporary(std::io::Error),
    /// A plot.
    #[error("the plot cannot be drawn: {0}")]
    Plot(String),
    /// A file of the report.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
}

/// Everything that was measured, and what produced it.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: String,
    /// The command line.
    pub command: String,
    /// The scene.
    pub scene: SceneFacts,
    /// The device and its driver.
    pub device: DeviceInfo,
    /// Every setting, which each choice changes in what it names.
    pub settings: crate::config::Settings,
    /// One step, by stage.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kernels: Option<kernels::Kernels>,
    /// Whole runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub training: Option<training::Training>,
}

/// What a scene is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneFacts {
    /// Its folder's name, or `synthetic`.
    pub name: String,
    /// Training views.
    pub train_views: usize,
    /// Held-out views.
    pub test_views: usize,
    /// Width and height of the largest training picture, pixels.
    pub size: [u32; 2],
    /// Points of the sparse model.
    pub points: usize,
    /// Views with a mask.
    pub masks: usize,
    /// Views with a depth prior.
    pub priors: usize,
    /// Inpainted views.
    pub references: usize,
}

impl SceneFacts {
    /// The facts of a scene of this name.
    pub fn new(name: &str, scene: &crate::scene::Scene) -> Self {
        let sizes = scene.train.iter().map(|view| view.camera.size);
        Self {
            name: name.to_owned(),
            train_views: scene.train.len(),
            test_views: scene.test.len(),
            size: sizes.fold([0, 0], |a, b| [a[0].max(b[0]), a[1].max(b[1])]),
            points: scene.points.len(),
            masks: scene.train.iter().filter(|view| view.mask.is_some()).count(),
            priors: scene.train.iter().filter(|view| view.prior.is_some()).count(),
            references: scene.references.len(),
        }
    }
}

/// A choice that was left out, and why.
#[derive(Clone, Debug, Serialize)]
pub struct Omitted {
    /// Its name.
    pub variant: String,
    /// Why.
    pub why: String,
}

/// The choices that differ from the first on this scene, and those that do not.
pub fn distinct(
    scene: &crate::scene::Scene,
    variants: Vec<variants::Variant>,
) -> (Vec<variants::Variant>, Vec<Omitted>) {
    let effective = |variant: &variants::Variant| {
        let mut settings = variant.settings.clone();
        let plan = crate::train::plan::Plan::new(scene, &settings);
        // What has no stage has no settings either.
        let defaults = crate::config::Settings::default();
        if !plan.attention {
            settings.model.attention = defaults.model.attention;
            settings.model.attention.enabled = false;
        }
        if !plan.depth {
            settings.losses.depth = defaults.losses.depth;
            settings.losses.depth.enabled = false;
        }
        settings
    };
    let (mut kept, mut omitted): (Vec<variants::Variant>, Vec<Omitted>) = (vec![], vec![]);
    for variant in variants {
        let same = kept.iter().find(|other| effective(other) == effective(&variant));
        match same {
            Some(other) => {
                let why = format!("on this scene the same as \"{}\"", other.name);
                omitted.push(Omitted { variant: variant.name, why });
            }
            None => kept.push(variant),
        }
    }
    (kept, omitted)
}

//! The folder of a run: what lies where.
//!
//! ```text
//! RUN/run.json        version, device, scene and command line: see `Record`
//! RUN/settings.toml   every setting of the run, resolved; --config reads it
//! RUN/model/          point_cloud.ply, and of anchors weights.safetensors
//! RUN/log.jsonl       losses, counts and speed, a JSON object per line
//! RUN/test/NAME.png   the test views as rendered at the end
//! RUN/seen/NAME.png   white where some train view photographed what they show
//! RUN/metrics.json    their figures
//! RUN/index.html      a page of all this; its pictures are in index/
//! RUN/checkpoints/    until the run is complete: what it goes on from
//! ```

use std::path::{Path, PathBuf};

use crate::atomic;
use anyhow::{Context as _, bail};
use serde::{Deserialize, Serialize};

use crate::config::{Error as SettingsError, Settings, Source};
use crate::model::config::Form;
use crate::model::files::POINT_CLOUD;

/// The record's file within a run folder.
pub const RECORD: &str = "run.json";
/// The run's folder within what `remove` makes.
pub const RUN: &str = "run";
/// The resolved settings within a run folder.
pub const SETTINGS: &str = "settings.toml";
/// The model's folder within a run folder.
pub const MODEL: &str = "model";
/// The rendered test views within a run folder.
pub const TEST: &str = "test";
/// Which of their pixels some train view photographed, within a run folder.
pub const SEEN: &str = "seen";

/// Who made a run and of what.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Version of the program.
    pub version: String,
    /// Name of the device.
    pub device: String,
    /// Absolute path of the scene, or `synthetic` for the built-in one.
    pub scene: String,
    /// The command line.
    pub command: String,
    /// Steps taken, once the run is complete.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub complete: Option<u32>,
    /// What the settings were that were made to fit the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asked: Option<Asked>,
    /// Hash of what the run was begun with, where a command has to know it again ([`crate::prepare::record::Inputs`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inputs: Option<String>,
}

/// The settings that are reduced where the device has no room for them, as they were asked for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Asked {
    voxel: f64,
    voxel_factor: f64,
    max_anchors: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    max_gaussians: Option<u32>,
}

impl Asked {
    /// Those of these settings.
    pub fn of(settings: &Settings) -> Self {
        let Settings { model, densify, .. } = settings;
        let max_gaussians = (model.form == Form::Gaussians).then_some(densify.max_gaussians);
        Self { voxel: model.voxel, voxel_factor: model.voxel_factor, max_anchors: densify.max_anchors, max_gaussians }
    }

    /// Undoes the reduction.
    pub fn restore(&self, settings: &mut Settings) {
        (settings.model.voxel, settings.model.voxel_factor) = (self.voxel, self.voxel_factor);
        settings.densify.max_anchors = self.max_anchors;
        if let Some(most) = self.max_gaussians {
            settings.densify.max_gaussians = most;
        }
    }
}

impl Record {
    /// The record of this program's run on `scene` ([`super::shared::SceneArgs::name`]) by the device of that name.
    pub fn new(device: &str, scene: &str) -> Self {
        let command: Vec<String> = std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            device: device.to_owned(),
            scene: scene.to_owned(),
            command: command.join(" "),
            complete: None,
            asked: None,
            inputs: None,
        }
    }

    /// Writes `run.json` into the run folder; the file appears complete or not at all.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn write(&self, run: &Path) -> anyhow::Result<()> {
        let path = run.join(RECORD);
        atomic::write_json(&path, self).with_context(|| format!("{}: cannot be written", path.display()))
    }

    /// Reads the run folder's `run.json`.
    ///
    /// # Errors
    /// A file that is missing, or is no such record.
    pub fn read(run: &Path) -> anyhow::Result<Self> {
        let path = run.join(RECORD);
        let text = std::fs::read(&path).with_context(|| format!("{}: cannot be read", path.display()))?;
        serde_json::from_slice(&text).with_context(|| format!("{}: not the record of a run", path.display()))
    }
}

/// Where a model came from.
#[derive(Debug)]
pub enum Origin {
    /// A run folder.
    Run {
        /// The folder.
        folder: PathBuf,
        /// Its record.
        record: Record,
    },
    /// A folder that holds a model and nothing about it.
    Model {
        /// The folder.
        folder: PathBuf,
    },
}

impl Origin {
    /// Tells a run folder from a model's own.
    ///
    /// # Errors
    /// A folder that is neither.
    pub fn find(folder: &Path) -> anyhow::Result<Self> {
        if !folder.is_dir() {
            bail!("{}: there is no such folder", folder.display());
        }
        let owned = folder.to_owned();
        if folder.join(RECORD).is_file() {
            return Ok(Self::Run { folder: owned, record: Record::read(folder)? });
        }
        if folder.join(POINT_CLOUD).is_file() {
            return Ok(Self::Model { folder: owned });
        }
        bail!(
            "{}: neither a run folder (it has no {RECORD}) nor a model folder (it has no {POINT_CLOUD}); name what \
             gscream-vk train wrote, runs/SCENE if not told otherwise",
            folder.display()
        )
    }

    /// Where the model's files are.
    pub fn model(&self) -> PathBuf {
        match self {
            Self::Run { folder, .. } => folder.join(MODEL),
            Self::Model { folder } => folder.clone(),
        }
    }

    /// The settings it was made with, or the defaults where that is not known, under what `changes` ask for.
    ///
    /// # Errors
    /// As [`Settings::resolve`].
    pub fn settings(&self, changes: Vec<Source>) -> Result<Settings, SettingsError> {
        let own = match self {
            Self::Run { folder, .. } => Some(Source::File(folder.join(SETTINGS))),
            Self::Model { .. } => None,
        };
        Settings::resolve(&own.into_iter().chain(changes).collect::<Vec<_>>())
    }

    /// The scene it was trained on, if that is known.
    pub fn scene(&self) -> Option<&str> {
        match self {
            Self::Run { record, .. } => Some(&record.scene),
            Self::Model { .. } => None,
        }
    }
}
/// The folder's own name: where it lies is nobody's business who reads the page.
pub(super) fn last_part(name: &str) -> &str {
    name.rsplit(['/', '\\']).find(|part| !part.is_empty()).unwrap_or(name)
}

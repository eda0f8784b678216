//! What a job begins with: a scene that was read, and one that is ready to train.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use super::said::is_new;
use crate::config::Settings;
use crate::gpu::Gpu;
use crate::multiview;
use crate::scene::{self, Scene, synthetic};

/// The word that stands for the built-in scene where a folder is expected.
pub const SYNTHETIC: &str = "synthetic";

/// Views that are never gone below.
const FEWEST_VIEWS: usize = 3;

/// Reads a scene, conditions it and prints what is new of its notes to stderr. Its lengths are in [`Scene::unit`]s. `synthetic` writes
/// the built-in scene of seed `train.seed` into a temporary folder and reads it like any other.
///
/// # Errors
/// A scene that cannot be read, a temporary folder that cannot be written.
pub fn load_scene(path: &Path, settings: &Settings) -> anyhow::Result<Scene> {
    let mut scene = if path == Path::new(SYNTHETIC) {
        let folder = tempfile::tempdir().context("no temporary folder for the synthetic scene can be made")?;
        let options = synthetic::Options { seed: settings.train.seed, ..Default::default() };
        let scene = folder.path().join(SYNTHETIC);
        synthetic::write(&scene, &options)?;
        scene::load(&scene, &settings.scene)?
    } else {
        scene::load(path, &settings.scene)?
    };
    scene::condition(&mut scene, &settings.scene);
    for note in scene.notes.iter().filter(|note| is_new(path, note)) {
        eprintln!("scene: {note}");
    }
    Ok(scene)
}

/// By how much stereo reduces photographs: as training does to begin with, where they are many. From larger ones come more points,
/// and what ends sharp begins with these.
fn reduction(scene: &Scene, settings: &Settings) -> u32 {
    let pixels: usize = scene.train.iter().map(|view| view.image.as_raw().len() / 3).sum();
    if pixels <= MOST_PIXELS { 1 } else { settings.train.coarse.reduction(1) }
}

/// Pixels of all photographs that stereo looks at as they are: some twenty seconds on two cores.
const MOST_PIXELS: usize = 12_000_000;

/// A scene that was read, and the settings that it was read with. Stereo has not run: what needs no points of it needs
/// no more than this.
#[derive(Debug)]
pub struct Loaded {
    path: PathBuf,
    /// The scene.
    pub scene: Scene,
    /// The settings.
    pub settings: Settings,
}

/// A scene with all points that a training begins with, and its settings.
#[derive(Debug)]
pub struct Ready {
    /// The scene.
    pub scene: Scene,
    /// The settings; they name the views that stereo left out.
    pub settings: Settings,
}

impl Loaded {
    /// Reads the scene at `path`.
    ///
    /// # Errors
    /// As [`load_scene`].
    pub fn read(path: &Path, settings: Settings) -> anyhow::Result<Self> {
        Ok(Self { path: path.to_owned(), scene: load_scene(path, &settings)?, settings })
    }

    /// Reads the scene again unless it was read without exactly these views.
    ///
    /// # Errors
    /// As [`load_scene`].
    pub fn leave_out(&mut self, views: Vec<String>) -> anyhow::Result<()> {
        if views != self.settings.scene.leave_out {
            self.settings.scene.leave_out = views;
            self.scene = load_scene(&self.path, &self.settings)?;
        }
        Ok(())
    }

    /// Adds the points that the photographs add to the model's, where the settings ask for them: whatever makes or
    /// looks at the model before the first step needs them. Views that contradict the others are noted in the settings,
    /// and the scene is read again without them.
    ///
    /// # Errors
    /// When the device has no room or is lost; as [`load_scene`].
    pub fn ready(mut self, gpu: &Gpu) -> anyhow::Result<Ready> {
        while self.settings.scene.dense {
            let Self { scene, settings, .. } = &mut self;
            let found = multiview::look(gpu, scene, reduction(scene, settings))?;
            let views = scene.train.len() + scene.test.len();
            if found.wrong.is_empty() || views - found.wrong.len() < FEWEST_VIEWS {
                eprintln!("scene: {}", found.note);
                scene.dense = found.points;
                scene.notes.push(found.note);
                break;
            }
            eprintln!(
                "scene: the photographs of {} of {views} views agree with the others' next to nowhere, so that the model has \
                 their cameras in a wrong place, and they are left out (scene.leave_out): {}",
                found.wrong.len(),
                found.wrong.join(", ")
            );
            let all = settings.scene.leave_out.iter().cloned().chain(found.wrong).collect();
            self.leave_out(all)?;
        }
        Ok(self.as_read())
    }

    /// The same without stereo, for a run that goes on: its checkpoint has the points.
    pub fn as_read(self) -> Ready {
        Ready { scene: self.scene, settings: self.settings }
    }
}

//! What a job begins with: a scene that was read, and one that is ready to train.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use super::said::is_new;
use crate::config::Settings;
use crate::gpu::Gpu;
use crate::multiview;
use crate::scene::{self, Prior, PriorKind, STEREO_PRIOR, Scene, synthetic};

/// The word that stands for the built-in scene where a folder is expected.
pub const SYNTHETIC: &str = "synthetic";

/// Views that are never gone below, and that measure the depth of one without the object.
const FEWEST_VIEWS: usize = 3;

/// Reads a scene, conditions it and prints what is new of its notes to stderr. Its lengths are in [`Scene::unit`]s. `synthetic` writes
/// the built-in scene of seed `train.seed` into a temporary folder and reads it like any other.
///
/// # Errors
/// A scene that cannot be read, a temporary folder that cannot be written.
pub fn load_scene(path: &Path, settings: &Settings) -> anyhow::Result<Scene> {
    load_with(path, settings, None)
}

/// As [`load_scene`], with the measured depth of the reference that shows the truth.
fn load_with(path: &Path, settings: &Settings, measured: Option<&Prior>) -> anyhow::Result<Scene> {
    let mut scene = if path == Path::new(SYNTHETIC) {
        let folder = tempfile::tempdir().context("no temporary folder for the synthetic scene can be made")?;
        let options = synthetic::Options { seed: settings.train.seed, ..Default::default() };
        let scene = folder.path().join(SYNTHETIC);
        synthetic::write(&scene, &options)?;
        scene::load(&scene, &settings.scene)?
    } else {
        scene::load(path, &settings.scene)?
    };
    if let (Some(prior), Some(reference)) = (measured, scene.references.first_mut()) {
        reference.prior = Some(prior.clone());
    }
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
    /// Measured depth of the reference that shows the truth.
    measured: Option<Prior>,
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
        Ok(Self { path: path.to_owned(), measured: None, scene: load_scene(path, &settings)?, settings })
    }

    /// Reads the scene again unless it was read without exactly these views.
    ///
    /// # Errors
    /// As [`load_scene`].
    pub fn leave_out(&mut self, views: Vec<String>) -> anyhow::Result<()> {
        if views != self.settings.scene.leave_out {
            self.settings.scene.leave_out = views;
            self.scene = load_with(&self.path, &self.settings, self.measured.as_ref())?;
        }
        Ok(())
    }

    /// Measures the depth of a reference that shows the truth over the other test views, which show the same place, where the settings
    /// ask for that, and reads the scene again with it. Nothing else of the test views reaches training.
    ///
    /// # Errors
    /// When the device has no room or is lost; as [`load_scene`].
    fn measure(&mut self, gpu: &Gpu) -> anyhow::Result<()> {
        let asked = self.settings.scene.truth_prior == STEREO_PRIOR && self.measured.is_none();
        let Some(reference) = self.scene.references.first().filter(|_| asked) else { return Ok(()) };
        let Scene { train, test, points, .. } = &self.scene;
        let view = &train[reference.view];
        let name = &view.name;
        if test.len() < FEWEST_VIEWS {
            eprintln!(
                "scene: reference {name}: its depth is not measured, for there are fewer than {FEWEST_VIEWS} other test views"
            );
            return Ok(());
        }
        let values = multiview::depth_of(gpu, view, test, points)?;
        eprintln!(
            "scene: reference {name}: its depth is measured by stereo over the other test views, in place of any guess"
        );
        self.measured = Some(Prior { kind: PriorKind::Depth, values });
        self.scene = load_with(&self.path, &self.settings, self.measured.as_ref())?;
        Ok(())
    }

    /// Adds the points that the photographs add to the model's, where the settings ask for them: whatever makes or
    /// looks at the model before the first step needs them. Views that contradict the others are noted in the settings,
    /// and the scene is read again without them.
    ///
    /// # Errors
    /// When the device has no room or is lost; as [`load_scene`].
    pub fn ready(mut self, gpu: &Gpu) -> anyhow::Result<Ready> {
        self.measure(gpu)?;
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
                "scene: the photographs of {} of {views} views contradict most others, or agree with them next to nowhere, so that \
                 the model has their cameras in a wrong place, and they are left out (scene.leave_out): {}",
                found.wrong.len(),
                found.wrong.join(", ")
            );
            let all = settings.scene.leave_out.iter().cloned().chain(found.wrong).collect();
            self.leave_out(all)?;
        }
        if self.settings.scene.seed_hole {
            let said = self.scene.notes.len();
            scene::seed_views(&mut self.scene);
            self.scene.notes[said..].iter().for_each(|note| eprintln!("scene: {note}"));
        }
        self.to_go_on(gpu)
    }

    /// Makes ready a run that goes on: it needs no points of stereo, for its checkpoint has them.
    ///
    /// # Errors
    /// As [`Self::ready`].
    pub fn to_go_on(mut self, gpu: &Gpu) -> anyhow::Result<Ready> {
        self.measure(gpu)?;
        Ok(Ready { scene: self.scene, settings: self.settings })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    /// The built-in scene's test views have exact depth. A measured one has as many steps as its pixels' colours tell apart: within a
    /// hundredth for the most part, and nine tenths of the hole are seen by enough others.
    #[test]
    fn the_depth_of_a_view_without_the_object_is_measured_over_the_others() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let read = scene::load(&dir, &scene::Config::default()).expect("it loads");
        let (name, exact) = (read.test[2].name.clone(), read.test[2].depth.clone().expect("exact depth"));
        let mut settings = Settings::default();
        settings.scene.truth_reference = name;
        settings.scene.truth_prior = STEREO_PRIOR.into();
        settings.scene.dense = false;
        let loaded = Loaded::read(&dir, settings).expect("it loads");
        assert!(loaded.scene.references[0].prior.is_some(), "a guess, until it is measured");
        let Ready { scene, .. } = loaded.to_go_on(&testing::gpu()).expect("it is measured");
        let reference = &scene.references[0];
        let prior = reference.prior.as_ref().expect("a prior");
        let mask = scene.train[reference.view].mask.as_ref().expect("a mask");
        let hole: Vec<usize> = (0..exact.len()).filter(|i| mask.as_raw()[*i] != 0).collect();
        let error = |i: &usize| (f64::from(prior.values[*i]) * scene.unit / f64::from(exact[*i]) - 1.0).abs();
        let mut errors: Vec<f64> = hole.iter().map(error).filter(|error| error.is_finite()).collect();
        assert!(errors.len() * 10 > hole.len() * 9, "{} of {}", errors.len(), hole.len());
        errors.sort_by(f64::total_cmp);
        let [middle, most] = [errors.len() / 2, errors.len() * 9 / 10].map(|at| errors[at]);
        eprintln!("measured depth of the hole: half within {middle:.4}, nine tenths within {most:.4}");
        assert!(middle < 0.01, "{middle}");
    }
}

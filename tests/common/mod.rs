//! A tiny scene and settings under which everything happens within a few steps.

use gscream_vk::config::Settings;
use gscream_vk::scene::{self, Scene, synthetic};
use gscream_vk::train::config::ViewOrder;
use gscream_vk::train::run::{Observer, Progress};
use tempfile::TempDir;

pub mod place;
pub mod skip;

/// The scene's folder: six train views of 48 x 36, the fourth the reference view, two test views.
pub fn folder() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = synthetic::Options { seed: 1, width: 48, height: 36, train_views: 6, test_views: 2, points: 300 };
    synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
    folder
}

/// Reads the scene of [`folder`].
pub fn load(folder: &TempDir, config: &scene::Config) -> Scene {
    scene::load(&folder.path().join("scene"), config).expect("a scene that was just written")
}

/// How a scene is read with these parts of it.
pub fn reads(masks: bool, priors: bool, reference: bool) -> scene::Config {
    let [prior_folder, reference_file] =
        [priors, reference].map(|wanted| if wanted { "" } else { scene::NONE }.to_owned());
    scene::Config { masks, prior_folder, reference_file, ..Default::default() }
}

/// The tiny scene with everything it has.
pub fn tiny() -> Scene {
    load(&folder(), &scene::Config::default())
}

/// Views in order (the reference view is step 4), statistics from step 2, attention from step 3, growth and pruning
/// behind steps 4, 6, 8, 10 and 12.
pub fn settings(iterations: u32) -> Settings {
    let mut settings = Settings::default();
    // Rounds of all views alike: which view a step sees is known.
    settings.train.reference_share = 0.0;
    settings.train.iterations = iterations;
    settings.train.view_order = ViewOrder::Sequential;
    settings.train.log_interval = 10;
    settings.train.eval_interval = 0;
    settings.model.voxel = 0.0;
    let attention = &mut settings.model.attention;
    attention.enabled = true;
    (attention.start, attention.patch, attention.tokens, attention.min_tokens) = (3, 24, 64, 2);
    let densify = &mut settings.densify;
    (densify.statistics_from, densify.from, densify.until, densify.every) = (2, 4, 12, 2);
    (densify.min_slot_visits, densify.min_anchor_visits) = (0, 1);
    settings.validate().expect("settings that make sense");
    settings
}

/// Keeps what a run says.
#[derive(Default)]
pub struct Watch {
    /// Every step.
    pub steps: Vec<Progress>,
    /// Every line.
    pub lines: Vec<String>,
}

impl Observer for Watch {
    fn step(&mut self, progress: &Progress) {
        self.steps.push(progress.clone());
    }
    fn say(&mut self, line: &str) {
        self.lines.push(line.to_owned());
    }
}

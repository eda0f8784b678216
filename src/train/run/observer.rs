//! Who watches a run, and what it is told.

use crate::config::Settings;
use crate::evaluate::Report;
use crate::gpu::{self, Timing, Timings};
use crate::render::view::Rendered;
use crate::scene::Camera;
use crate::signal::Signal;
use serde::Serialize;

/// What the host learns of a step, once it has ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Progress {
    /// Step, counted from 1.
    pub step: u32,
    /// Seconds since training began.
    pub seconds: f64,
    /// The view's name.
    pub view: String,
    /// Sum of the losses.
    pub loss: f32,
    /// Each loss by its name.
    pub losses: Vec<(&'static str, f32)>,
    /// Anchors.
    pub anchors: u32,
    /// Anchors in view.
    pub visible: u32,
    /// Gaussians that touched a tile.
    pub gaussians: u32,
    /// (Gaussian, tile) pairs.
    pub pairs: u32,
}

/// What a run leaves behind.
#[derive(Debug, Serialize)]
pub struct Summary {
    /// Steps taken.
    pub steps: u32,
    /// Seconds of training, evaluations left out.
    pub seconds: f64,
    /// Steps repeated because buffers had to grow.
    pub repeated: u32,
    /// Anchors at the end.
    pub anchors: u32,
    /// Means over the last steps (at most one round of views).
    pub gaussians: f64,
    /// Likewise.
    pub pairs: f64,
    /// Most bytes of device memory in buffers at any time.
    pub peak_device_bytes: u64,
    /// Figures on the test views, if there are any.
    #[serde(skip)]
    pub report: Option<Report>,
    /// Milliseconds per pass, when timestamps were asked for.
    #[serde(skip)]
    pub timings: Timings,
    /// The passes of the last step, likewise.
    #[serde(skip)]
    pub last: Vec<Timing>,
}

/// Watches a run: progress bars, tests.
pub trait Observer {
    /// A step has ended.
    fn step(&mut self, _progress: &Progress) {}
    /// Something worth a line.
    fn say(&mut self, _line: &str) {}
    /// A test view as rendered after the last step.
    fn rendered(&mut self, _view: &str, _picture: &Rendered) {}
    /// Whether to end behind the steps in flight, with a checkpoint; asked before every step, and between the views of an
    /// evaluation.
    fn interrupted(&mut self) -> Option<Signal> {
        None
    }
    /// Whether somebody wants to see the model now; asked before every step.
    fn visited(&mut self) -> bool {
        false
    }
    /// Lets somebody look, where [`Observer::visited`] said so, once nothing is in flight: `draw` renders the model as it is
    /// now ([`Step::glance`](crate::train::step::Step::glance)). The clock stands still, and training goes on as if nobody had looked.
    fn look(&mut self, _draw: &mut dyn FnMut(&Camera) -> Result<Option<Rendered>, gpu::Error>) {}
    /// Whether the schedule is to be corrected before the next step; asked before every step.
    fn corrects(&mut self, _last: &Progress) -> bool {
        false
    }
    /// The last step as it is to be, where [`Observer::corrects`] said so, once nothing is in flight; nothing leaves it.
    fn correction(&mut self, _last: &Progress, _settings: &Settings) -> Option<u32> {
        None
    }
    /// All corrections so far ([`Config::corrections`](crate::train::Config::corrections)), each time there is another.
    fn corrected(&mut self, _corrections: &[[u32; 2]]) {}
    /// Steps to evaluate at besides those of the settings.
    fn samples(&self) -> Vec<u32> {
        vec![]
    }
    /// A test view (by its index) as rendered in any evaluation; the clock stands still.
    fn compared(&mut self, _view: usize, _picture: &Rendered) {}
    /// An evaluation behind `progress` has ended; its seconds are those of training alone.
    fn evaluated(&mut self, _progress: &Progress, _report: &Report) {}
}

/// Watches nothing.
pub struct Silent;

impl Observer for Silent {}

/// Ends a run after so many steps.
pub(super) struct StepsLeft(pub(super) u32);

impl Observer for StepsLeft {
    fn step(&mut self, _progress: &Progress) {
        self.0 -= 1;
    }
    fn interrupted(&mut self) -> Option<Signal> {
        (self.0 == 0).then_some(Signal::Interrupt)
    }
}

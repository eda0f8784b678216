//! The training loop: views in order, one submission per step, everything the host wants to know a step late.

use std::collections::VecDeque;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::Serialize;

use super::order::Order;
use super::photographs::{self, Photograph};
use super::plan::Plan;
use super::step::{Rates, Step};
use crate::config::Settings;
use crate::evaluate::{self, Report, ViewMetrics};
use crate::gpu::{self, Buffer, Gpu, Submission, Timing, Timings};
use crate::losses::Term;
use crate::model::{files, init};
use crate::primitives::limit::{COUNTERS, Counter};
use crate::render::view::{Capacity, Rendered, Renderer};
use crate::scene::Scene;

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// The points.
    #[error(transparent)]
    Init(#[from] init::Error),
    /// The model's files.
    #[error(transparent)]
    Files(#[from] files::Error),
    /// The figures.
    #[error(transparent)]
    Evaluate(#[from] evaluate::Error),
    /// A file of the run folder.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A number stopped being one.
    #[error(
        "the loss of step {step} (view {view}) is {loss}: the model before it is not saved; lower the learning rates or look at that view's prior and mask"
    )]
    NotFinite {
        /// The step.
        step: u32,
        /// The view's name.
        view: String,
        /// The loss.
        loss: f32,
    },
}

/// What the host learns of a step, once it has ended.
#[derive(Clone, Debug, Default, Serialize)]
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

/// A line of `log.jsonl`.
#[derive(Serialize)]
struct Line<'a> {
    #[serde(flatten)]
    progress: &'a Progress,
    /// Mean over the steps since the last line.
    mean_loss: f64,
    steps_per_second: f64,
    /// Of the last evaluation on the test views.
    psnr: Option<f64>,
    masked_psnr: Option<f64>,
    /// Bytes of device memory in buffers now.
    device_bytes: u64,
    /// Resident bytes of the process, where the system tells.
    host_bytes: Option<u64>,
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
}

/// Watches nothing.
pub struct Silent;
impl Observer for Silent {}

/// Buffers in host memory that the device fills at the end of a step.
struct Mailbox {
    losses: Buffer<f32>,
    counters: Buffer<u32>,
    overflow: Buffer<u32>,
}

struct InFlight<'g> {
    step: u32,
    view: usize,
    mailbox: usize,
    submission: Submission<'g>,
}

/// Steps given to the device before the first is waited for.
const DEPTH: usize = 2;

/// A training run.
pub struct Run<'a> {
    gpu: &'a Gpu,
    scene: &'a Scene,
    settings: &'a Settings,
    photographs: Vec<Photograph>,
    step: Step,
    order: Order,
    mailboxes: Vec<Mailbox>,
}

impl<'a> Run<'a> {
    /// Anchors from the scene's points, fresh networks, pictures and stages on the device.
    ///
    /// # Errors
    /// When the points make no anchor or the device has no room.
    pub fn new(gpu: &'a Gpu, scene: &'a Scene, settings: &'a Settings) -> Result<Self, Error> {
        let plan = Plan::new(scene, settings);
        let points: Vec<[f32; 3]> = scene.points.iter().map(|p| p.position).collect();
        let offsets = settings.model.offsets as usize;
        let derived = || init::median_nearest_distance(&points).map_or(0.0, |d| d * settings.model.voxel_factor);
        let voxel = if settings.model.voxel > 0.0 { settings.model.voxel } else { derived() };
        let initial = init::anchors(&points, voxel, offsets)?;
        let weights = init::weights(settings.train.seed, offsets, plan.attention);
        let photographs = photographs::upload(gpu, scene, plan.depth, settings.train.coarse.reduction(1))?;
        let step = Step::new(gpu, plan, settings, &initial.anchors, &weights, initial.voxel)?;
        let mailboxes = (0..DEPTH)
            .map(|_| {
                Ok(Mailbox {
                    losses: gpu.readback("losses_mail", Term::ALL.len())?,
                    counters: gpu.readback("counters_mail", COUNTERS)?,
                    overflow: gpu.readback("overflow_mail", 1)?,
                })
            })
            .collect::<Result<_, gpu::Error>>()?;
        let order = Order::new(scene.train.len(), settings.train.seed, settings.train.view_order);
        Ok(Self { gpu, scene, settings, photographs, step, order, mailboxes })
    }

    /// The step: its plan, model and stages.
    pub fn step(&self) -> &Step {
        &self.step
    }

    /// Gives the stages room for so much, instead of the first guess; what does not fit is made room for as ever. Nothing
    /// of the run may be in flight.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn resize(&mut self, capacity: Capacity) -> Result<(), Error> {
        Ok(self.step.resize(capacity)?)
    }

    /// Records one step into any recorder: for `plan` and `verify`. Returns the view's name.
    ///
    /// # Errors
    /// When the device has no room for the stages that begin with this step.
    pub fn record(&mut self, rec: &mut gpu::Recorder<'_>, step: u32) -> Result<String, Error> {
        let view = self.order.view(step);
        self.prepare(step)?;
        self.record_view(rec, step, view);
        Ok(self.photographs[view].name.clone())
    }

    /// Runs one step and waits; repeats it with larger buffers until it fits.
    ///
    /// # Errors
    /// When the device has no room or is lost.
    pub fn run_one(&mut self, step: u32) -> Result<(), Error> {
        loop {
            let mut rec = self.gpu.recorder()?;
            self.record(&mut rec, step)?;
            rec.submit()?.wait()?;
            if self.gpu.read(self.step.limits.overflow())?[0] == 0 {
                return Ok(());
            }
            let counters = self.gpu.read(self.step.limits.counters())?;
            self.grow(&counters)?;
        }
    }

    /// Makes what begins with this step and lets go of what is over: stages, and pictures of another size. Nothing may be
    /// in flight where the pictures change.
    fn prepare(&mut self, step: u32) -> Result<(), Error> {
        let reduction = self.settings.train.coarse.reduction(step);
        if self.photographs.first().is_some_and(|p| p.reduction != reduction) {
            self.photographs.clear();
            self.step.resize_pictures(Plan::reduced_sizes(self.scene, reduction))?;
            self.photographs = photographs::upload(self.gpu, self.scene, self.step.plan.depth, reduction)?;
        }
        Ok(self.step.prepare(step)?)
    }

    fn record_view(&self, rec: &mut gpu::Recorder<'_>, step: u32, view: usize) {
        let rates = Rates::at(self.settings, f64::from(self.scene.radius), step);
        self.step.record(rec, &self.photographs[view], step, rates);
    }

    fn submit(&mut self, step: u32, mailbox: usize) -> Result<InFlight<'a>, Error> {
        let view = self.order.view(step);
        self.prepare(step)?;
        let mut rec = self.gpu.recorder()?;
        self.record_view(&mut rec, step, view);
        let mail = &self.mailboxes[mailbox];
        let values = self.step.terms(self.photographs[view].camera.size);
        rec.copy(values, &mail.losses, Term::ALL.len());
        rec.copy(self.step.limits.counters(), &mail.counters, COUNTERS);
        rec.copy(self.step.limits.overflow(), &mail.overflow, 1);
        Ok(InFlight { step, view, mailbox, submission: rec.submit()? })
    }

    /// Trains to the last step, writing log and model into `folder`.
    ///
    /// # Errors
    /// See [`Error`]. What was written before stays.
    pub fn train(&mut self, folder: &Path, watch: &mut dyn Observer) -> Result<Summary, Error> {
        let iterations = self.settings.train.iterations;
        let coarse = self.settings.train.coarse;
        let log_path = folder.join("log.jsonl");
        let io = |path: &Path| {
            let path = path.to_owned();
            move |source| Error::Io { path, source }
        };
        let mut log = std::io::BufWriter::new(std::fs::File::create(&log_path).map_err(io(&log_path))?);
        let started = Instant::now();
        let mut paused = 0.0;
        let mut timings = Timings::default();
        let mut last_timings = vec![];
        let mut in_flight: VecDeque<InFlight<'a>> = VecDeque::new();
        let mut next = 1;
        let mut done = 0;
        let mut repeated = 0;
        let mut report = None;
        let mut since_line = (0u32, 0f64, Instant::now());
        let mut recent: VecDeque<(u32, u32)> = VecDeque::new();
        let every =
            |interval: u32| move |step: u32| step == iterations || (interval > 0 && step.is_multiple_of(interval));
        let (evaluates, saves) = (every(self.settings.train.eval_interval), every(self.settings.train.save_interval));
        while done < iterations {
            // What follows a change of the anchors or of the pictures' size, an evaluation or a save waits until it is made.
            let resizes = |step: u32| coarse.reduction(step) != coarse.reduction(step + 1);
            let pause_behind =
                |step: u32| self.step.changes_anchors(step) || resizes(step) || evaluates(step) || saves(step);
            let blocked = next > done + 1 && pause_behind(next - 1);
            if next <= iterations && in_flight.len() < DEPTH && !blocked {
                let mailbox = (next as usize) % DEPTH;
                in_flight.push_back(self.submit(next, mailbox)?);
                next += 1;
                continue;
            }
            let InFlight { step, view, mailbox, submission } =
                in_flight.pop_front().expect("a step is in flight until the last is done");
            let ended = submission.wait()?;
            let mail = &self.mailboxes[mailbox];
            let counters = self.gpu.read(&mail.counters)?;
            if self.gpu.read(&mail.overflow)?[0] != 0 {
                // The device has skipped this step and those behind it: grow, and take them again.
                repeated += 1 + in_flight.len() as u32;
                for later in in_flight.drain(..) {
                    later.submission.wait()?;
                }
                self.grow(&counters)?;
                next = step;
                continue;
            }
            timings.add(&ended);
            if !ended.is_empty() {
                last_timings = ended;
            }
            let values = self.gpu.read(&mail.losses)?;
            let progress = Progress {
                step,
                seconds: started.elapsed().as_secs_f64() - paused,
                view: self.photographs[view].name.clone(),
                loss: values.iter().sum(),
                losses: Term::ALL.iter().map(|t| t.name()).zip(values.iter().copied()).collect(),
                anchors: self.step.anchors.count,
                visible: counters[Counter::Visible as usize],
                gaussians: counters[Counter::Drawn as usize],
                pairs: counters[Counter::Pairs as usize],
            };
            if !progress.loss.is_finite() {
                let view = progress.view;
                return Err(Error::NotFinite { step, view, loss: progress.loss });
            }
            recent.push_back((progress.gaussians, progress.pairs));
            if recent.len() > self.photographs.len() {
                recent.pop_front();
            }
            done = step;
            watch.step(&progress);
            since_line.0 += 1;
            since_line.1 += f64::from(progress.loss);
            if self.step.changes_anchors(done) {
                let change = self.step.change_anchors(done)?;
                watch.say(&change);
            }
            let pause = Instant::now();
            if saves(done) {
                self.save(folder)?;
            }
            if evaluates(done) {
                let last = done == iterations;
                report = self
                    .evaluate(|view, picture| {
                        if last {
                            watch.rendered(view, picture)
                        }
                    })?
                    .or(report);
                if let Some(mean) = report.as_ref().and_then(|r| r.mean.as_ref()) {
                    let mean = &mean.metrics;
                    let masked = mean.mask.as_ref().map_or(String::new(), |m| format!(", masked {:.2} dB", m.psnr));
                    watch.say(&format!("step {done}: PSNR {:.2} dB{masked} on the test views", mean.full.psnr));
                }
            }
            paused += pause.elapsed().as_secs_f64();
            if done.is_multiple_of(self.settings.train.log_interval) || done == iterations {
                let (steps, loss, since) = since_line;
                let figures = report.as_ref().and_then(|r| r.mean.as_ref()).map(|m| &m.metrics);
                let line = Line {
                    progress: &progress,
                    mean_loss: loss / f64::from(steps),
                    steps_per_second: f64::from(steps) / (since.elapsed().as_secs_f64()),
                    psnr: figures.map(|m| m.full.psnr),
                    masked_psnr: figures.and_then(|m| m.mask.as_ref()).map(|m| m.psnr),
                    device_bytes: self.gpu.memory().0,
                    host_bytes: host_bytes(),
                };
                let text = serde_json::to_string(&line).expect("plain numbers and strings");
                writeln!(log, "{text}").and_then(|()| log.flush()).map_err(io(&log_path))?;
                since_line = (0, 0.0, Instant::now());
            }
        }
        let seconds = started.elapsed().as_secs_f64() - paused;
        let mean = |f: &dyn Fn(&(u32, u32)) -> u32| {
            recent.iter().map(|r| f64::from(f(r))).sum::<f64>() / recent.len().max(1) as f64
        };
        Ok(Summary {
            steps: iterations,
            seconds,
            repeated,
            anchors: self.step.anchors.count,
            gaussians: mean(&|r| r.0),
            pairs: mean(&|r| r.1),
            peak_device_bytes: self.gpu.memory().1,
            report,
            timings,
            last: last_timings,
        })
    }

    /// Writes the model as it is now into `folder/model`, in place of the one before.
    ///
    /// # Errors
    /// When it cannot be read back or written.
    pub fn save(&self, folder: &Path) -> Result<(), Error> {
        let (anchors, weights) = self.step.model()?;
        Ok(files::save(&folder.join("model"), &anchors, &weights)?)
    }

    fn grow(&mut self, counters: &[u32]) -> Result<(), Error> {
        let capacity = self.step.capacity().fit(std::array::from_fn(|i| counters[i]));
        self.step.resize(capacity)?;
        let mut rec = self.gpu.recorder()?;
        self.step.limits.lower(&mut rec);
        rec.submit()?.wait()?;
        Ok(())
    }

    /// Renders every test view with the model as it is now, shows it to `look`, and compares.
    ///
    /// # Errors
    /// When the device has no room for a second copy of the model.
    pub fn evaluate(&self, mut look: impl FnMut(&str, &Rendered)) -> Result<Option<Report>, Error> {
        if self.scene.test.is_empty() {
            return Ok(None);
        }
        let (anchors, weights) = self.step.model()?;
        let background = self.settings.train.background.map(|c| c as f32);
        let mut renderer = Renderer::new(self.gpu, &anchors, &weights, &self.settings.render, background)?;
        let mut views = vec![];
        for view in &self.scene.test {
            let rendered = renderer.render(&view.camera)?;
            let metrics = evaluate::compare(&rendered.to_rgb8(), &view.image, view.mask.as_ref())?;
            views.push(ViewMetrics { name: view.name.clone(), metrics });
            look(&view.name, &rendered);
        }
        Ok(Some(Report::new(views)))
    }
}

/// Resident memory of this process (Linux).
fn host_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|l| l.starts_with("VmRSS:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
}

//! The training loop: views in order, one submission per step, everything the host wants to know a step late.

mod error;
mod observer;
mod vain;

use crate::atomic;
use crate::config::Settings;
use crate::evaluate::{self, Report, ViewMetrics};
use crate::gpu::{self, Buffer, Gpu, NotFinite, Submission, Timing, Timings};
use crate::losses::{Term, photometric};
use crate::primitives::finite::NOT_FINITE;
use crate::primitives::limit::{COUNTERS, Counter};
use crate::render::forward::Capacity;
use crate::render::view::Rendered;
use crate::scene::{Scene, View};
use crate::train::begin::Beginning;
use crate::train::checkpoint::{self, History, LastFigures, Model, Owner, State};
use crate::train::order::Order;
use crate::train::photographs::{self, Photograph};
use crate::train::plan::Plan;
use crate::train::step::{Rates, Step};
pub use error::Error;
use image::RgbImage;
use observer::StepsLeft;
pub use observer::{Observer, Progress, Silent, Summary};
use rayon::prelude::*;
use serde::Serialize;
use std::cell::OnceCell;
use std::collections::VecDeque;
use std::fs::File;
use std::io::Write as _;
use std::path::Path;
use std::time::Instant;
use vain::Vain;

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

/// Why [`Run::advance`] returned early.
enum Halt {
    /// Values are not finite behind, or at, a step; the last state known to be good, if one is.
    Broken { step: u32, good: Option<Box<State>> },
    /// The model on the device is that behind the last step of the history.
    Good(Error),
    /// It is not, or cannot be read any more.
    Lost(Error),
}

impl<E: Into<Error>> From<E> for Halt {
    fn from(error: E) -> Self {
        Self::Lost(error.into())
    }
}

/// What belongs to one call of [`Run::train`] alone.
struct Session<'f> {
    folder: &'f Path,
    log: Option<File>,
    /// Seconds trained before.
    before: f64,
    started: Instant,
    /// Seconds since then that are not training.
    paused: f64,
    /// Steps since the last line of the log, and when that was.
    rate: (u32, Instant),
    /// Nothing is written, and the state before every step is kept until the step has turned out well.
    careful: bool,
    vain: Vain,
    timings: Timings,
    last_timings: Vec<Timing>,
}

impl<'f> Session<'f> {
    /// Opens the folder's log with what is known of it.
    fn new(folder: &'f Path, history: &History) -> Result<Self, Error> {
        let path = folder.join(LOG);
        let open = || {
            atomic::write(&path, &history.log)?;
            File::options().append(true).open(&path)
        };
        let log = open().map_err(|source| Error::Io { path: path.clone(), source })?;
        Ok(Self { log: Some(log), careful: false, ..Self::careful(folder, history) })
    }

    /// Writes nothing.
    fn careful(folder: &'f Path, history: &History) -> Self {
        let now = Instant::now();
        Self {
            folder,
            log: None,
            before: history.last.seconds,
            started: now,
            paused: 0.0,
            rate: (0, now),
            careful: true,
            vain: Vain::default(),
            timings: Timings::default(),
            last_timings: vec![],
        }
    }

    fn seconds(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64() - self.paused
    }

    fn write_line(&mut self, text: &str) -> Result<(), Error> {
        let failed = |source| Error::Io { path: self.folder.join(LOG), source };
        self.log.as_mut().map_or(Ok(()), |log| log.write_all(text.as_bytes())).map_err(failed)
    }
}

/// The log's file within a run folder: a JSON object per line.
pub const LOG: &str = "log.jsonl";

/// Steps given to the device before the first is waited for.
const DEPTH: usize = 2;

/// A step of a run that has not begun.
fn fresh(gpu: &Gpu, scene: &Scene, settings: &Settings) -> Result<Step, Error> {
    let settings = &settings.fitted(scene);
    let plan = Plan::new(scene, settings);
    Ok(Step::new(gpu, plan, settings, &Beginning::of(scene, settings)?)?)
}

/// The settings for the step behind `done`.
fn corrected(asked: &Settings, corrections: &[[u32; 2]], done: u32) -> Settings {
    let due = corrections.iter().filter(|[step, _]| *step <= done);
    due.fold(asked.clone(), |settings, [step, iterations]| settings.corrected(*step, *iterations))
}

/// A training run.
pub struct Run<'a> {
    gpu: &'a Gpu,
    scene: &'a Scene,
    /// As the run began with them.
    asked: &'a Settings,
    /// As they are for the next step, all corrections up to there in them.
    settings: Settings,
    /// Those made or to be made, in order.
    corrections: Vec<[u32; 2]>,
    /// How many of them are in `settings`.
    corrected: usize,
    photographs: Vec<Photograph>,
    step: Step,
    order: Order,
    mailboxes: Vec<Mailbox>,
    /// What [`Run::train`] goes on from.
    history: History,
    owner: OnceCell<Owner>,
    /// [`Observer::samples`].
    samples: Vec<u32>,
}

impl<'a> Run<'a> {
    /// Anchors from the scene's points, fresh networks, pictures and stages on the device.
    ///
    /// # Errors
    /// When the points make no anchor or the device has no room.
    pub fn new(gpu: &'a Gpu, scene: &'a Scene, settings: &'a Settings) -> Result<Self, Error> {
        Self::with(gpu, scene, settings, fresh(gpu, scene, settings)?, History::default())
    }

    /// The run that a checkpoint was written by, from there on.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn resume(gpu: &'a Gpu, scene: &'a Scene, settings: &'a Settings, state: State) -> Result<Self, Error> {
        let now = corrected(settings, &settings.train.corrections, state.history.last.step);
        let step = state.model.restore(gpu, Plan::new(scene, &now), &now.fitted(scene))?;
        Self::with(gpu, scene, settings, step, state.history)
    }

    fn with(
        gpu: &'a Gpu,
        scene: &'a Scene,
        settings: &'a Settings,
        step: Step,
        history: History,
    ) -> Result<Self, Error> {
        let photographs = photographs::upload(gpu, scene, &step.plan, settings.train.coarse.reduction(1))?;
        // As many recordings as will ever be open at once, so that the log's bytes do not say when a run was resumed.
        drop((0..=DEPTH).map(|_| gpu.recorder()).collect::<Result<Vec<_>, _>>()?);
        let mailboxes = (0..DEPTH)
            .map(|_| {
                Ok(Mailbox {
                    losses: gpu.readback("losses_mail", Term::ALL.len())?,
                    counters: gpu.readback("counters_mail", COUNTERS)?,
                    overflow: gpu.readback("overflow_mail", 1)?,
                })
            })
            .collect::<Result<_, gpu::Error>>()?;
        let order = Order::of(scene, &settings.train);
        let corrections = settings.train.corrections.clone();
        Ok(Self {
            gpu,
            scene,
            asked: settings,
            settings: corrected(settings, &corrections, history.last.step),
            corrected: corrections.iter().filter(|[step, _]| *step <= history.last.step).count(),
            corrections,
            photographs,
            step,
            order,
            mailboxes,
            history,
            owner: OnceCell::new(),
            samples: vec![],
        })
    }

    /// The step: its plan, model and stages.
    pub fn step(&self) -> &Step {
        &self.step
    }

    /// The last step that has ended.
    pub fn done(&self) -> u32 {
        self.history.last.step
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
        let (gpu, limits) = (self.gpu, self.step.limits.share());
        limits.until_all_fits(gpu, |counted| -> Result<(), Error> {
            self.make_room(counted)?;
            let mut rec = gpu.recorder()?;
            self.record(&mut rec, step)?;
            rec.submit()?.wait()?;
            Ok(())
        })?;
        if gpu.read(limits.overflow())?[0] >> NOT_FINITE != 0 {
            self.lower()?;
            let view = self.photographs[self.order.view(step)].name.clone();
            return Err(Error::NotFinite { step, view, found: None });
        }
        Ok(())
    }

    /// Grows and prunes where the settings have a round behind this step. Nothing may be in flight.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<(), Error> {
        if self.step.changes_anchors(step) {
            self.step.change_anchors(step)?;
        }
        Ok(())
    }

    /// Makes what begins with this step and lets go of what is over: stages, and pictures of another size. Nothing may be
    /// in flight where the pictures change.
    fn prepare(&mut self, step: u32) -> Result<(), Error> {
        let reduction = self.settings.train.coarse.reduction(step);
        if self.photographs.first().is_some_and(|p| p.reduction != reduction) {
            self.photographs.clear();
            self.step.resize_pictures(Plan::reduced_sizes(self.scene, reduction))?;
            self.photographs = photographs::upload(self.gpu, self.scene, &self.step.plan, reduction)?;
        }
        Ok(self.step.prepare(step)?)
    }

    fn record_view(&self, rec: &mut gpu::Recorder<'_>, step: u32, view: usize) {
        let rates = Rates::at(&self.settings, f64::from(self.scene.radius), step);
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

    /// Trains to the last step, writing log, model and checkpoints into `folder`.
    ///
    /// # Errors
    /// See [`Error`]. Once under way it is [`Error::Stopped`], with a checkpoint of the last step that ended well where the
    /// folder has room for it; what was written before stays.
    pub fn train(&mut self, folder: &Path, watch: &mut dyn Observer) -> Result<Summary, Error> {
        self.samples = watch.samples();
        let mut session = Session::new(folder, &self.history)?;
        let mut history = std::mem::take(&mut self.history);
        let result = self.advance(&mut session, &mut history, watch);
        let stopped = |source, kept| Error::Stopped { source: Box::new(source), kept, folder: folder.to_owned() };
        let report = match result {
            Ok(report) => report,
            Err(halt) => {
                let (error, state) = match halt {
                    Halt::Lost(error) => (error, None),
                    Halt::Good(error) => {
                        // What is not finite yet unnoticed is not to be gone on from.
                        let model = Model::of(self.gpu, &self.step).ok().filter(|model| model.not_finite().is_none());
                        (error, model.map(|model| State { history: history.clone(), model }))
                    }
                    Halt::Broken { step, good } => self.explain(folder, step, good.map(|state| *state), watch),
                };
                let kept = state.and_then(|state| match checkpoint::write(folder, self.owner(), &state) {
                    Ok(_) => Some(state.history.last.step),
                    // The first error is the one to act on, and likely the cause of this one.
                    Err(second) => {
                        log::info!("{second}");
                        None
                    }
                });
                let newest = || checkpoint::list(folder).first().map(|(step, _)| *step);
                return Err(stopped(error, kept.or_else(newest)));
            }
        };
        let recent = &history.recent;
        let mean = |f: &dyn Fn(&(u32, u32)) -> u32| {
            recent.iter().map(|r| f64::from(f(r))).sum::<f64>() / recent.len().max(1) as f64
        };
        Ok(Summary {
            steps: history.last.step,
            seconds: history.last.seconds,
            repeated: history.repeated,
            anchors: self.step.learnt.count(),
            gaussians: mean(&|r| r.0),
            pairs: mean(&|r| r.1),
            peak_device_bytes: self.gpu.memory().1,
            report,
            timings: session.timings,
            last: session.last_timings,
        })
    }

    /// Steps until the last has ended. `history` is that of the model on the device whenever this returns anything but
    /// [`Halt::Lost`].
    fn advance(
        &mut self,
        session: &mut Session<'_>,
        history: &mut History,
        watch: &mut dyn Observer,
    ) -> Result<Option<Report>, Halt> {
        let mut in_flight: VecDeque<InFlight<'a>> = VecDeque::new();
        let mut next = history.last.step + 1;
        let mut report = None;
        // What ends the run, once nothing is in flight any more.
        let mut halt: Option<Error> = None;
        // The state behind the last step, where that is kept.
        let mut good: Option<Box<State>> = None;
        if history.last.step > 0 && !history.told {
            match self.tell(session, history, watch) {
                Ok(told) => report = told,
                Err(error) => halt = Some(error),
            }
        }
        if session.careful {
            good = Some(Box::new(State { history: history.clone(), model: Model::of(self.gpu, &self.step)? }));
        }
        while history.last.step < self.settings.train.iterations && !(halt.is_some() && in_flight.is_empty()) {
            if halt.is_none() {
                halt = watch.interrupted().map(|signal| Error::Interrupted { signal });
            }
            let visited = halt.is_none() && !session.careful && watch.visited();
            if visited && in_flight.is_empty() {
                let pause = Instant::now();
                watch.look(&mut |camera| self.step.glance(camera));
                session.paused += pause.elapsed().as_secs_f64();
                continue;
            }
            // A correction of the schedule comes between two steps.
            let due = self.next_correction().is_some_and(|[step, _]| step < next);
            let corrects = due || halt.is_none() && !session.careful && watch.corrects(&history.last);
            if corrects && in_flight.is_empty() {
                self.correct(&history.last, due, watch);
                continue;
            }
            // What follows a change of the anchors or of the pictures' size, an evaluation, a save or a checkpoint waits until it is made.
            let behind = next > history.last.step + 1;
            let blocked =
                halt.is_some() || visited || corrects || behind && (session.careful || self.pauses_behind(next - 1));
            if next <= self.settings.train.iterations && in_flight.len() < DEPTH && !blocked {
                match self.submit(next, next as usize % DEPTH) {
                    Ok(submitted) => in_flight.push_back(submitted),
                    Err(error) => halt = Some(error),
                }
                next += 1;
                continue;
            }
            let Some(InFlight { step, view, mailbox, submission }) = in_flight.pop_front() else { continue };
            let ended = submission.wait()?;
            let mail = &self.mailboxes[mailbox];
            let counters = self.gpu.read(&mail.counters)?;
            let flag = self.gpu.read(&mail.overflow)?[0];
            let values = self.gpu.read(&mail.losses)?;
            if flag >> NOT_FINITE != 0 || flag == 0 && !values.iter().sum::<f32>().is_finite() {
                // The device has skipped this step, if it saw it, and those behind it.
                for later in in_flight.drain(..) {
                    later.submission.wait()?;
                }
                self.lower()?;
                if good.is_none() {
                    let model = Model::of(self.gpu, &self.step)?;
                    let whole = flag != 0 && model.not_finite().is_none();
                    good = whole.then(|| Box::new(State { history: history.clone(), model }));
                }
                return Err(Halt::Broken { step, good });
            }
            if flag != 0 {
                // The device has skipped this step and those behind it: grow, and take them again.
                history.repeated += 1 + in_flight.len() as u32;
                for later in in_flight.drain(..) {
                    later.submission.wait()?;
                }
                if let Err(error) = self.grow(&counters) {
                    halt = Some(error);
                }
                next = step;
                continue;
            }
            session.timings.add(&ended);
            if !ended.is_empty() {
                session.last_timings = ended;
            }
            let progress = Progress {
                step,
                seconds: session.seconds(),
                view: self.photographs[view].name.clone(),
                loss: values.iter().sum(),
                losses: Term::ALL.iter().map(|t| t.name).zip(values.iter().copied()).collect(),
                anchors: self.step.learnt.count(),
                visible: counters[Counter::Visible as usize],
                gaussians: counters[Counter::Drawn as usize],
                pairs: counters[Counter::Pairs as usize],
            };
            watch.step(&progress);
            history.recent.push((progress.gaussians, progress.pairs));
            let surplus = history.recent.len().saturating_sub(self.photographs.len());
            history.recent.drain(..surplus);
            history.since_line.0 += 1;
            history.since_line.1 += f64::from(progress.loss);
            history.last = progress;
            history.told = false;
            session.rate.0 += 1;
            if halt.is_none() && !session.careful {
                let photometric = values[photometric::TERM.slot() as usize];
                halt =
                    session.vain.step(self.scene, &self.settings, counters[Counter::Drawn as usize], photometric).err();
            }
            if self.step.changes_anchors(step) {
                let text = self.step.change_anchors(step)?;
                if !text.is_empty() {
                    watch.say(&text);
                }
            }
            let mut state = None;
            if session.careful || self.checkpoints(step) || self.saves(step) {
                let pause = Instant::now();
                let model = Model::of(self.gpu, &self.step)?;
                if model.not_finite().is_some() {
                    return Err(Halt::Broken { step, good });
                }
                state = Some(Box::new(State { history: history.clone(), model }));
                session.paused += pause.elapsed().as_secs_f64();
            }
            if let Some(state) = state.as_ref().filter(|_| halt.is_none() && !session.careful && self.checkpoints(step))
            {
                let pause = Instant::now();
                if let Err(error) = checkpoint::write(session.folder, self.owner(), state) {
                    halt = Some(error.into());
                    continue;
                }
                session.paused += pause.elapsed().as_secs_f64();
            }
            match self.tell(session, history, watch) {
                Ok(told) => report = told.or(report),
                Err(error) => halt = halt.or(Some(error)),
            }
            good =
                state.filter(|_| session.careful).map(|state| Box::new(State { history: history.clone(), ..*state }));
        }
        match halt {
            // It came too late to matter.
            Some(Error::Interrupted { .. }) if history.last.step == self.settings.train.iterations && history.told => {
                Ok(report)
            }
            Some(error) => Err(Halt::Good(error)),
            None => Ok(report),
        }
    }

    /// The first correction that is not in the settings yet.
    fn next_correction(&self) -> Option<[u32; 2]> {
        self.corrections.get(self.corrected).copied()
    }

    /// Corrects the schedule behind the last step, as it is written down or as `watch` asks for. Nothing may be in flight.
    fn correct(&mut self, last: &Progress, due: bool, watch: &mut dyn Observer) {
        if !due {
            let Some(iterations) = watch.correction(last, &self.settings) else { return };
            // What was to be corrected later was fitted to another time.
            self.corrections.truncate(self.corrected);
            self.corrections.push([last.step, iterations.max(last.step + 1)]);
            watch.corrected(&self.corrections);
        }
        let [step, iterations] = self.corrections[self.corrected];
        self.corrected += 1;
        self.settings = self.settings.corrected(step, iterations);
        self.step.reschedule(self.settings.fitted(self.scene), &Plan::new(self.scene, &self.settings));
    }

    /// Makes what is written of the last step: the model's files, the evaluation, the line of the log.
    fn tell(
        &mut self,
        session: &mut Session<'_>,
        history: &mut History,
        watch: &mut dyn Observer,
    ) -> Result<Option<Report>, Error> {
        let step = history.last.step;
        let last = step == self.settings.train.iterations;
        let pause = Instant::now();
        if self.saves(step) && !session.careful {
            self.save(session.folder)?;
        }
        let mut report = None;
        if self.evaluates(step) {
            let mut index = 0;
            report = self.evaluate_while(|view, picture| {
                watch.compared(index, picture);
                index += 1;
                if last {
                    watch.rendered(view, picture)
                }
                // The step is told again when the run goes on.
                watch.interrupted().map_or(Ok(()), |signal| Err(Error::Interrupted { signal }))
            })?;
            if let Some(report) = &report {
                watch.evaluated(&history.last, report);
            }
            if let Some(mean) = report.as_ref().and_then(|r| r.mean.as_ref()) {
                let mean = &mean.metrics;
                let masked = mean.mask.as_ref().map_or(String::new(), |m| format!(", masked {:.2} dB", m.psnr));
                watch.say(&format!("step {step}: PSNR {:.2} dB{masked} on the test views", mean.full.psnr));
                history.figures =
                    Some(LastFigures { psnr: mean.full.psnr, masked_psnr: mean.mask.as_ref().map(|m| m.psnr) });
            }
        }
        session.paused += pause.elapsed().as_secs_f64();
        if step.is_multiple_of(self.settings.train.log_interval) || last {
            let (steps, loss) = history.since_line;
            let line = Line {
                progress: &history.last,
                mean_loss: loss / f64::from(steps),
                steps_per_second: f64::from(session.rate.0) / session.rate.1.elapsed().as_secs_f64(),
                psnr: history.figures.map(|f| f.psnr),
                masked_psnr: history.figures.and_then(|f| f.masked_psnr),
                device_bytes: self.gpu.memory().0,
                host_bytes: host_bytes(),
            };
            let text = serde_json::to_string(&line).expect("plain numbers and strings") + "\n";
            session.write_line(&text)?;
            history.log.push_str(&text);
            history.since_line = (0, 0.0);
            session.rate = (0, Instant::now());
        }
        history.told = true;
        Ok(report)
    }

    /// Finds the first pass whose values are not finite and the state before it. `good` is the state before step `step`,
    /// at which they were noticed, where that is still whole; otherwise they have been in the model for some steps, which
    /// are repeated one by one.
    fn explain(
        &mut self,
        folder: &Path,
        step: u32,
        good: Option<State>,
        watch: &mut dyn Observer,
    ) -> (Error, Option<State>) {
        let mut noticed = (step, good);
        if noticed.1.is_none() {
            watch.say(&format!(
                "step {step}: values are not finite; repeating the steps since the last good state to find the first"
            ));
            match self.repeat(folder, step) {
                Ok(found) => noticed = found,
                Err(error) => return (error, None),
            }
        }
        let (step, good) = noticed;
        let view = self.photographs[self.order.view(step)].name.clone();
        // A state behind the step is of a repetition in which nothing was wrong.
        let before = good.as_ref().filter(|good| good.history.last.step < step);
        let found = before.and_then(|before| match self.first_not_finite(before, step) {
            Ok(found) => found,
            Err(error) => {
                log::warn!("repeating step {step}: {error}");
                None
            }
        });
        (Error::NotFinite { step, view, found }, good)
    }

    /// Repeats the steps from the last good checkpoint, or from the first step, to `noticed`, that one included. Returns
    /// the first whose results are not finite and the state before it; `noticed` and the state behind it if all are.
    fn repeat(&mut self, folder: &Path, noticed: u32) -> Result<(u32, Option<State>), Error> {
        // The stages' memory goes before a second model is made.
        self.step.resize(Capacity { anchors: 1, visible: 1, pairs: 1 })?;
        let candidates = checkpoint::list(folder).into_iter().filter(|(step, _)| *step < noticed);
        let base = candidates.filter_map(|(_, path)| checkpoint::read(&path, self.owner()).ok()).next();
        let done = base.as_ref().map_or(0, |state| state.history.last.step);
        self.settings = corrected(self.asked, &self.corrections, done);
        self.corrected = self.corrections.iter().filter(|[step, _]| *step <= done).count();
        let settings = &self.settings.fitted(self.scene);
        let mut history = History::default();
        match base {
            Some(state) => {
                self.step = state.model.restore(self.gpu, Plan::new(self.scene, &self.settings), settings)?;
                history = state.history;
            }
            None => self.step = fresh(self.gpu, self.scene, settings)?,
        }
        let mut session = Session::careful(folder, &history);
        let mut steps = StepsLeft(noticed - history.last.step);
        match self.advance(&mut session, &mut history, &mut steps) {
            Err(Halt::Broken { step, good }) => Ok((step, good.map(|state| *state))),
            Err(Halt::Good(error)) if !matches!(error, Error::Interrupted { .. }) => Err(error),
            Err(Halt::Lost(error)) => Err(error),
            Ok(_) | Err(Halt::Good(_)) => {
                Ok((noticed, Some(State { history, model: Model::of(self.gpu, &self.step)? })))
            }
        }
    }

    /// Repeats a step pass by pass from the state before it.
    fn first_not_finite(&mut self, before: &State, step: u32) -> Result<Option<NotFinite>, Error> {
        self.step.resize(Capacity { anchors: 1, visible: 1, pairs: 1 })?;
        let settings = self.settings.fitted(self.scene);
        self.step = before.model.restore(self.gpu, self.step.plan.clone(), &settings)?;
        let (gpu, limits) = (self.gpu, self.step.limits.share());
        limits.until_all_fits(gpu, |counted| {
            self.make_room(counted)?;
            let mut rec = gpu.inspected()?;
            self.record(&mut rec, step)?;
            let found = rec.not_finite().cloned();
            rec.submit()?.wait()?;
            Ok(found)
        })
    }

    fn every(&self, interval: u32, step: u32) -> bool {
        step == self.settings.train.iterations || (interval > 0 && step.is_multiple_of(interval))
    }

    fn evaluates(&self, step: u32) -> bool {
        self.saves(step) || self.samples.contains(&step)
    }

    fn saves(&self, step: u32) -> bool {
        self.every(self.settings.train.eval_interval, step)
    }

    fn checkpoints(&self, step: u32) -> bool {
        let interval = self.settings.train.checkpoint_interval;
        interval > 0 && self.every(interval, step)
    }

    fn pauses_behind(&self, step: u32) -> bool {
        let coarse = self.settings.train.coarse;
        let resizes = coarse.reduction(step) != coarse.reduction(step + 1);
        self.step.changes_anchors(step) || resizes || self.evaluates(step) || self.checkpoints(step)
    }

    /// Whose the checkpoints of this run are.
    pub fn owner(&self) -> &Owner {
        self.owner.get_or_init(|| Owner::new(self.scene, self.asked))
    }

    /// Writes the model as it is now into `folder/model`, in place of the one before.
    ///
    /// # Errors
    /// When it cannot be read back or written.
    pub fn save(&self, folder: &Path) -> Result<(), Error> {
        let mut model = self.step.stored()?;
        model.rescale(self.scene.unit);
        Ok(model.save(&folder.join("model"))?)
    }

    fn grow(&mut self, counters: &[u32]) -> Result<(), Error> {
        self.make_room(Some(std::array::from_fn(|i| counters[i])))?;
        self.lower()
    }

    /// Room for what was counted in an attempt that did not fit.
    fn make_room(&mut self, counted: Option<[u32; COUNTERS]>) -> Result<(), Error> {
        let Some(counted) = counted else { return Ok(()) };
        Ok(self.step.resize(self.step.capacity().fit(counted).within(self.gpu, counted))?)
    }

    fn lower(&self) -> Result<(), Error> {
        let mut rec = self.gpu.recorder()?;
        self.step.limits.lower(&mut rec);
        rec.submit()?.wait()?;
        Ok(())
    }

    /// Renders every test view with the model as it is now, shows it to `look`, and compares. Nothing of the run may be in
    /// flight.
    ///
    /// # Errors
    /// When the device has no room, or a picture cannot be compared.
    pub fn evaluate(&mut self, mut look: impl FnMut(&str, &Rendered)) -> Result<Option<Report>, Error> {
        self.evaluate_while(|view, picture| {
            look(view, picture);
            Ok(())
        })
    }

    /// [`Run::evaluate`], until `look` has an error.
    fn evaluate_while(
        &mut self,
        mut look: impl FnMut(&str, &Rendered) -> Result<(), Error>,
    ) -> Result<Option<Report>, Error> {
        let views = &self.scene.test;
        if views.is_empty() {
            return Ok(None);
        }
        let mut pictures = vec![];
        self.step.draw(views.iter().map(|v| &v.camera), |i, rendered| {
            pictures.push(rendered.to_rgb8());
            look(&views[i].name, &rendered)
        })?;
        let compare = |(view, picture): (&View, &RgbImage)| {
            let metrics = evaluate::compare(picture, &view.image, view.mask.as_ref())?;
            Ok(ViewMetrics { name: view.name.clone(), metrics })
        };
        let figures = views.par_iter().zip(&pictures).map(compare).collect::<Result<Vec<_>, evaluate::Error>>()?;
        Ok(Some(Report::new(figures)))
    }
}

/// Resident memory of this process (Linux).
fn host_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|l| l.starts_with("VmRSS:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
}

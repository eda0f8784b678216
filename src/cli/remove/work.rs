//! From photographs and their object to files for viewers: what prepare, doctor, train and export do, one after the other.
//! A part whose inputs have not changed since it ended is not done again; one that was cut off is gone on with.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, bail};
use serde::{Deserialize, Serialize};

use super::Args;
use super::time::Time;
use crate::atomic;
use crate::cli::folders::{self, MODEL, Record as RunRecord};
use crate::cli::prepare::Bars;
use crate::cli::shared::SceneArgs;
use crate::cli::train::{self, Manner, Stop, Trained};
use crate::cli::{doctor as findings, export, minutes, preset};
use crate::config::SettingsArgs;
use crate::evaluate::Judge;
use crate::export::{Observer, Options};
use crate::gpu::Gpu;
use crate::model::files::{POINT_CLOUD, WEIGHTS};
use crate::prepare::fit::Ready;
use crate::prepare::record::{self, Inputs};
use crate::prepare::shadow::Answer;
use crate::prepare::{self, Object, Request, Step, Watch};
use crate::scene::doctor::Report;
use crate::signal::Signal;
use crate::splat::read::Splat;
use crate::splat::views::Seen;
use crate::train::checkpoint::{self, Fingerprint};
use crate::view::live::Board;
use crate::work;

/// The folders of a removal.
pub struct Places {
    /// The folder of all.
    pub root: PathBuf,
    /// The scene as `prepare` makes it.
    pub scene: PathBuf,
    /// The run.
    pub run: PathBuf,
    /// The masks that were clicked of the first object; those of others lie beside it.
    pub objects: PathBuf,
}

impl Places {
    /// Below this folder.
    pub fn new(root: PathBuf) -> Self {
        let [scene, run, objects] = ["scene", folders::RUN, "objects"].map(|name| root.join(name));
        Self { root, scene, run, objects }
    }

    /// The files for viewers, by name.
    pub fn files(&self) -> Vec<(String, PathBuf)> {
        let figures = |name: &String| name.as_str() != export::FIGURES;
        export::files().filter(figures).map(|name| (name.clone(), self.root.join(name))).collect()
    }
}

/// A splat, what is seen of it, and what it is as a fit.
pub struct Source {
    /// The file's Gaussians.
    pub(super) splat: Splat,
    /// The Gaussians that the cameras see.
    pub(super) seen: Seen,
    /// For `prepare`.
    pub ready: Arc<Ready>,
    /// The folder of its pictures.
    pub views: PathBuf,
}

/// A removal and where it goes.
pub struct Job<'a> {
    /// As the user asked for it.
    pub args: &'a Args,
    /// The folder of the photographs, or of the splat's pictures.
    pub photographs: PathBuf,
    /// The splat, where there is one in place of photographs.
    pub splat: Option<Source>,
    /// Where to.
    pub places: Places,
    /// How long it may take.
    pub time: Time,
}

/// Hears how far the work is, and may end it.
pub trait Audience {
    /// A part begins, of so many units.
    fn begin(&self, _part: &str, _units: u64) {}
    /// The units of the part that are done.
    fn at(&self, _units: u64) {}
    /// Training can be looked at.
    fn board(&self, _board: &Arc<Board>) {}
    /// The doctor's report.
    fn examined(&self, _report: &Report) {}
    /// The wish to end.
    fn stop(&self) -> Stop {
        Stop::default()
    }
    /// Whether somebody looks at the training.
    fn looks(&self) -> bool {
        false
    }
}

/// Hears nothing.
pub struct Nobody;
impl Audience for Nobody {}

/// The contents of `remove.json`: hashes of what was made of what.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct Record {
    version: String,
    /// The hash of what the files for viewers were made of.
    export: String,
}

const RECORD: &str = "remove.json";

impl Record {
    /// An unreadable one says nothing: all is made again.
    pub(super) fn read(root: &Path) -> Self {
        let text = std::fs::read(root.join(RECORD)).unwrap_or_default();
        serde_json::from_slice(&text).unwrap_or_default()
    }

    fn write(&mut self, root: &Path) -> anyhow::Result<()> {
        env!("CARGO_PKG_VERSION").clone_into(&mut self.version);
        let path = root.join(RECORD);
        atomic::write_json(&path, self).with_context(|| format!("{}: cannot be written", path.display()))
    }
}

/// Bars on the terminal, an audience, and a clock.
struct Watched<'a, B> {
    bars: B,
    audience: &'a dyn Audience,
    job: &'a Job<'a>,
    stop: Stop,
    done: u64,
}

impl<'a, B: Default> Watched<'a, B> {
    fn new(audience: &'a dyn Audience, job: &'a Job<'_>) -> Self {
        Self { bars: B::default(), audience, job, stop: audience.stop(), done: 0 }
    }
}

impl Watch for Watched<'_, Bars> {
    fn begin(&mut self, step: Step, units: u64) {
        self.audience.begin(step.name(), units);
        self.job.time.begin(step.name());
        self.bars.begin(step, units);
    }
    fn at(&mut self, unit: u64) {
        self.audience.at(unit);
        self.bars.at(unit);
    }
    fn end(&mut self) {
        self.job.time.end();
        self.bars.end();
    }
    fn go_on(&mut self) -> Result<(), prepare::Error> {
        match (self.interrupted(), self.job.time.in_vain()) {
            (Some(signal), _) => Err(prepare::Error::Interrupted { signal }),
            (None, Some(why)) => Err(prepare::Error::Request(why)),
            (None, None) => Ok(()),
        }
    }
    fn say(&mut self, line: &str) {
        // What a step found out is not said again by those that read the scene.
        let note = line.split_once(": ").map_or(line, |(_, note)| note);
        work::is_new(&self.job.places.scene, note);
        self.bars.say(line);
    }
    fn interrupted(&mut self) -> Option<Signal> {
        train::ends(&self.stop)
    }
}

impl Observer for Watched<'_, export::Bars> {
    fn begin(&mut self, part: &str, turns: u64) {
        self.done = 0;
        self.audience.begin("export", turns);
        self.bars.begin(part, turns);
    }
    fn turn(&mut self, note: &str) {
        self.done += 1;
        self.audience.at(self.done);
        self.bars.turn(note);
    }
    fn end(&mut self) {
        self.bars.end();
    }
    fn interrupted(&mut self) -> Option<Signal> {
        train::ends(&self.stop)
    }
}

impl Job<'_> {
    /// The request to `prepare`.
    pub fn request(&self, objects: Vec<Object>) -> Request {
        let Args { reference, repaint, poses, shadow, fit_steps, .. } = self.args;
        // A splat's own Gaussians keep their shadow: only the hole changes.
        let shadow = if self.splat.is_some() { Answer::Keep } else { shadow.answer() };
        Request {
            objects,
            ready: self.splat.as_ref().map(|splat| splat.ready.clone()),
            reference: reference.clone(),
            repaint: repaint.wish(),
            again: poses.again(),
            shadow,
            fit_steps: *fit_steps,
            ..Request::new(&self.photographs, &self.places.scene)
        }
    }

    /// The photographs and the short fit to them: where the work begins.
    ///
    /// # Errors
    /// As [`prepare::fitted`].
    pub fn fitted(&self, gpu: &Gpu, audience: &dyn Audience) -> Result<prepare::Fitted, prepare::Error> {
        prepare::fitted(gpu, &self.request(vec![Object::default()]), &mut Watched::<Bars>::new(audience, self))
    }

    /// Everything, in the time since `began`. With `despite` also where doctor finds problems.
    ///
    /// # Errors
    /// Errors of the parts; problems that doctor finds; an end that somebody wished.
    pub fn work(
        &self,
        gpu: &Gpu,
        objects: Vec<Object>,
        despite: bool,
        audience: &dyn Audience,
        began: Instant,
    ) -> anyhow::Result<()> {
        let Places { root, scene, run, .. } = &self.places;
        self.time.start(began, scene)?;
        prepare::prepare(gpu, &self.request(objects), &mut Watched::<Bars>::new(audience, self))?;
        let (report, _) = findings::examined(scene, None)?;
        eprint!("{}", findings::new_text(&report, scene));
        audience.examined(&report);
        match report.problems() {
            0 => {}
            problems if despite => eprintln!("doctor: going on in spite of {problems} problems"),
            problems => bail!(
                "{}: doctor has {problems} {} (see above); mend what it names, or go on in spite of it with --yes",
                scene.display(),
                if problems == 1 { "problem" } else { "problems" }
            ),
        }
        if let Some(source) = &self.splat {
            return self.splice(gpu, source, audience);
        }
        let mut record = Record::read(root);
        self.train(gpu, audience, &self.args.settings)?;
        let mut inputs = Inputs::default().with(self.args.export_steps.to_le_bytes());
        // Plain Gaussians have no decoders.
        for name in [POINT_CLOUD, WEIGHTS].into_iter().filter(|name| run.join(MODEL).join(name).is_file()) {
            inputs = inputs.with(record::hash(&run.join(MODEL).join(name))?);
        }
        let inputs = inputs.finish();
        if record.export == inputs && export::is_whole(root) {
            eprintln!("export: nothing has changed");
            return Ok(());
        }
        let args = export::Args::of_run(run, root, self.args.export_steps, Options::default().views);
        export::export(&args, root, &mut Watched::<export::Bars>::new(audience, self), |work| work(gpu))?;
        record.export = inputs;
        record.write(root)
    }

    /// Trains, unless the run that is there was made of the same; one that was begun with it is gone on with.
    pub(super) fn train(&self, gpu: &Gpu, audience: &dyn Audience, settings: &SettingsArgs) -> anyhow::Result<()> {
        let Args { device, minutes, .. } = self.args;
        let Places { scene: folder, run, .. } = &self.places;
        let began = self.time.began();
        let given = SceneArgs { scene: folder.clone(), settings: settings.clone() };
        let name = given.name();
        let lock = train::held(run, false)?;
        let mut loaded = preset::load(&given, device)?;
        let fingerprint = serde_json::to_string(&Fingerprint::of(&loaded.scene)).context("names and hashes")?;
        let time = minutes.unwrap_or(0.0).to_le_bytes();
        let inputs = Inputs::default().with(fingerprint).with(loaded.settings.to_toml()).with(time).finish();
        let there = RunRecord::read(run).ok();
        let made = there.as_ref().is_some_and(|there| there.inputs.as_ref() == Some(&inputs));
        let is_lost = |there: &RunRecord| there.complete.is_some() && !run.join(MODEL).join(POINT_CLOUD).is_file();
        let lost = made && there.as_ref().is_some_and(is_lost);
        let same = made && !lost;
        if let Some(there) = &there {
            match there.complete {
                Some(steps) if same => {
                    eprintln!("train: nothing has changed ({steps} steps)");
                    return Ok(());
                }
                _ if lost => eprintln!("train: the model of the run is gone; trained again"),
                _ if !same => {
                    eprintln!("train: the masks, the photographs or the settings have changed; trained again")
                }
                _ => {}
            }
        }
        if same {
            train::go_on_without(run, &mut loaded)?;
        }
        let work::Ready { scene, settings } = if same && !checkpoint::list(run).is_empty() {
            loaded.to_go_on(gpu)?
        } else {
            audience.begin("points", 0);
            loaded.ready(gpu)?
        };
        let (settings, clock) = match minutes {
            Some(time) if !same => {
                let (settings, clock) = minutes::fitted(gpu, &scene, &settings, *time, began, self.time.files())?;
                (settings, Some(clock))
            }
            _ => (settings, None),
        };
        let iterations = settings.train.iterations;
        let board = audience.looks().then(|| Board::new("training", &scene, iterations));
        board.iter().for_each(|board| audience.board(board));
        audience.begin("train", iterations.into());
        let manner =
            Manner { began: Some(began), board, go_on: same, clock, stop: audience.stop(), inputs: Some(inputs) };
        let Trained { summary, report, .. } =
            train::train(gpu, &scene, &settings, &name, run, &manner, &Judge::default())?;
        if let Some(report) = report {
            println!("{}", report.table());
        }
        println!("{}", train::describe(&summary, settings.model.form));
        drop(lock);
        Ok(())
    }
}

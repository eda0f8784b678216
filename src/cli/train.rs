//! `gscream-vk train`.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::atomic;
use anyhow::{Context as _, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};

use super::folders::{Asked, MODEL, RECORD, Record, SEEN, SETTINGS, TEST};
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use super::{index, instruments, minutes, next, pictures, preset, signals};
use crate::config::{Settings, SettingsArgs, Source};
use crate::evaluate::{Judge, Report};
use crate::folder::{self, Lock};
use crate::gpu::{self, Gpu, Options, Timing};
use crate::model::config::Form;
use crate::model::files::{POINT_CLOUD, WEIGHTS};
use crate::render::view::Rendered;
use crate::scene::doctor::{self, Severity};
use crate::scene::{Camera, Scene};
use crate::signal::Signal;
use crate::splat;
use crate::train::checkpoint::{self, Owner, Search};
use crate::train::forecast::{self, Fitting, Question};
use crate::train::run::{LOG, Observer, Progress, Run, Summary};
use crate::view::live::{Board, Host};
use crate::view::server::{self, Secret};
use crate::work::{Loaded, Ready};

/// Train a scene without its object
///
/// Writes a run folder: the model (point_cloud.ply, weights.safetensors), log.jsonl, settings.toml, run.json, the test
/// views as rendered at the end, their figures (metrics.json), and a page of it all (index.html). `synthetic` is the
/// built-in scene.
///
/// Without --preset and --config a preset is chosen for the device and the size of the pictures: demo (the built-in
/// scene) or gaussians on a CPU, the defaults (gscream) on a GPU.
///
/// A run that ended early (Ctrl-C, SIGTERM, an error, a power failure) is gone on with by `--resume RUN`, to the same
/// bytes as if nothing had happened. Until a run is complete its folder holds checkpoints: two at most, one every
/// train.checkpoint_interval steps. With `--resume-or-start` the same command line starts it, goes on with it and leaves
/// it alone once it is complete.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk train synthetic
  gscream-vk train garden --out runs/garden
  gscream-vk train garden --preset paper --set losses.depth.enabled=false --iterations 7000
  gscream-vk train garden --from scene.ply --out runs/more
  gscream-vk train --resume runs/garden
  gscream-vk train garden --out runs/garden --resume-or-start")]
pub(super) struct Args {
    /// Folder of the scene, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE", required_unless_present = "resume")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    settings: SettingsArgs,
    /// Go on from the plain Gaussians of this splat (PLY, SPZ, SOG, .splat or GLB), of whatever program, instead of the scene's points
    ///
    /// It must stand in the scene's own place, axes and units. [same as --set model.from=FILE with model.form=gaussians and
    /// the file's model.degree]
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Run folder; must not hold a run already [default: runs/SCENE]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace a run that is already in the folder
    #[arg(long)]
    overwrite: bool,
    /// Go on with the run in this folder, from its last good checkpoint, under its own settings
    ///
    /// Its scene is read from where it was; SCENE says where it is now, if it was moved. Without a checkpoint yet, the
    /// run starts again. A complete run stays as it is.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["SettingsArgs", "out", "overwrite"])]
    resume: Option<PathBuf>,
    /// Go on with a run that is in the folder, leave a complete one alone, start one where there is none
    ///
    /// For scripts and clusters: the same command line again after a failure comes to the same end. The scene and the
    /// settings must be those that the run began with.
    #[arg(long, conflicts_with_all = ["resume", "overwrite"])]
    resume_or_start: bool,
    /// Show the training in the browser while it runs, at this address [default: 127.0.0.1:8643]
    ///
    /// Pictures are rendered where the page looks, in a few per cent of the time while somebody looks; the trained model
    /// is the same. From another machine: ssh -L 8643:localhost:8643 HOST. Other addresses than the loopback let other
    /// machines in; port 0 is any free one.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, require_equals = true, value_parser = address,
        default_missing_value = "127.0.0.1:8643")]
    view: Option<SocketAddr>,
    /// Train for about so many minutes: the schedule is fitted to as many steps as this device takes in that time
    ///
    /// It is corrected while the training runs, as steps take longer or other programs take the machine. The settings
    /// written down have the corrections and repeat the run to the byte. Learning rates follow the number of steps, and
    /// nothing is evaluated before the end.
    #[arg(long, value_name = "N", conflicts_with_all = ["iterations", "resume", "resume_or_start"], value_parser = positive)]
    minutes: Option<f64>,
    /// Measure every pass: prints milliseconds per pass and writes trace.json (for chrome://tracing or Perfetto)
    #[arg(long)]
    profile: bool,
    #[command(flatten)]
    device: DeviceArgs,
}

/// A positive number of minutes.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|m| (1e-3..1e6).contains(m)).ok_or_else(|| "give a positive number of minutes".into())
}

/// An address and a port, or one of them.
fn address(text: &str) -> Result<SocketAddr, String> {
    let with_port = || text.parse().ok();
    let alone = || Some(SocketAddr::new(text.parse().ok()?, PORT));
    let port = || Some(SocketAddr::new(Ipv4Addr::LOCALHOST.into(), text.parse().ok()?));
    with_port()
        .or_else(alone)
        .or_else(port)
        .ok_or_else(|| "give ADDRESS:PORT, such as 127.0.0.1:8643, or a port".into())
}

/// Where a training is shown unless told otherwise.
const PORT: u16 = 8643;

/// Serves a page about the training; the trainer's side of it is made of what is returned.
fn show(address: SocketAddr, name: &str, scene: &Scene, settings: &Settings) -> anyhow::Result<Arc<Board>> {
    let listener = super::view::bind(address, "--view=127.0.0.1:0")?;
    let title = Path::new(name).file_name().map_or_else(|| name.into(), |name| name.to_string_lossy().into_owned());
    let board = Board::new(title, scene, settings.train.iterations);
    let secret = Secret::random();
    eprintln!("view: {}", secret.url(listener.local_addr().unwrap_or(address)));
    let site = board.clone();
    std::thread::spawn(move || server::serve(&listener, &site, &secret));
    Ok(board)
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let began = Instant::now();
    let mut settings = args.settings.clone();
    if let Some(path) = &args.from {
        settings.set.splice(0..0, begun_from(path)?);
    }
    let given = |scene: &PathBuf| SceneArgs { scene: scene.clone(), settings: settings.clone() };
    let given = args.scene.as_ref().map(given);
    let (loaded, name, folder, begun, _lock) = if let Some(folder) = &args.resume {
        let read = || {
            Record::read(folder)
                .with_context(|| format!("{}: holds no run to go on with: start one with --out", folder.display()))
        };
        read()?;
        let lock = held(folder, true)?;
        let record = read()?;
        if is_complete(folder, &record, lock.is_some())? {
            return Ok(());
        }
        let settings = Settings::resolve(&[Source::File(folder.join(SETTINGS))])?;
        let path = args.scene.clone().unwrap_or_else(|| PathBuf::from(&record.scene));
        let name = given.map_or(record.scene, |given| given.name());
        (Loaded::read(&path, settings)?, name, folder.clone(), true, lock)
    } else {
        let given = given.expect("clap asks for a scene where there is nothing to resume");
        let name = given.name();
        let folder = args.out.clone().unwrap_or_else(|| default_folder(&name));
        let lock = held(&folder, args.resume_or_start)?;
        let mut loaded = preset::load(&given, &args.device)?;
        let begun = args.resume_or_start && is_begun(&folder, &name, &loaded.settings)?;
        if begun {
            if is_complete(&folder, &Record::read(&folder)?, lock.is_some())? {
                return Ok(());
            }
            go_on_without(&folder, &mut loaded)?;
        } else if folder.join(RECORD).exists() && !args.overwrite {
            bail!(
                "{}: holds a run already: choose another --out, go on with it by --resume, or replace it by --overwrite",
                folder.display()
            );
        }
        (loaded, name, folder, begun, lock)
    };
    let looked = doctor::look(&loaded.scene);
    eprintln!("doctor: {}", looked.verdict());
    let options = Options { timestamps: args.profile, ..args.device.options() };
    with_gpu(&options, |gpu| {
        // A checkpoint has the anchors.
        let goes_on = begun && !checkpoint::list(&folder).is_empty();
        let Ready { scene, settings } = if goes_on { loaded.to_go_on(gpu)? } else { loaded.ready(gpu)? };
        let (settings, clock) = match args.minutes {
            Some(time) => {
                let (settings, clock) =
                    minutes::fitted(gpu, &scene, &settings, time, began, minutes::Reserve::default())?;
                (settings, Some(clock))
            }
            None => (settings, None),
        };
        let board = args.view.map(|address| show(address, &name, &scene, &settings)).transpose()?;
        let manner = Manner { began: Some(began), board, go_on: begun, clock, ..Manner::default() };
        eprintln!("device: {} ({})", gpu.info().name, gpu.info().driver);
        let Trained { summary, report, mut written } =
            train(gpu, &scene, &settings, &name, &folder, &manner, &Judge::default())?;
        if let Some(report) = report {
            println!("{}", report.table());
        }
        if args.profile {
            write_trace(gpu, &summary, &folder.join(TRACE))?;
            written.push(TRACE);
            println!("{}", summary.timings.table());
        }
        println!("{}", describe(&summary, settings.model.form));
        println!("wrote {} in {}", written.join(", "), folder.display());
        warn(&looked);
        let page = (next::typed(&folder.join(index::INDEX).to_string_lossy()), "is the run as a page, for a browser");
        let steps: Vec<_> = index::steps(&folder).into_iter().chain([page]).collect();
        next::say(&steps);
        Ok(())
    })
}

/// The settings of a training that goes on from a splat.
fn begun_from(path: &Path) -> anyhow::Result<Vec<String>> {
    let splat = splat::read::read(path)?;
    let absolute = std::path::absolute(path).with_context(|| path.display().to_string())?;
    let name = toml::Value::String(absolute.to_string_lossy().into_owned());
    // Room to grow by a half.
    let most = splat.len() + splat.len() / 2;
    Ok(vec![
        "model.form=gaussians".to_owned(),
        format!("model.degree={}", splat.cloud.degree),
        format!("model.from={name}"),
        format!("densify.max_gaussians={most}"),
        "scene.dense=false".to_owned(),
    ])
}

/// Says again what is wrong with the scene, now that the lines of the start have scrolled away.
fn warn(looked: &doctor::Report) {
    for finding in looked.findings.iter().filter(|finding| finding.severity == Severity::Problem) {
        eprintln!("warning: {}", finding.text());
    }
}

/// Takes the lock of a run folder. `None` where it cannot be had and nothing is to be done: complete runs are left alone, and
/// the folder holds one.
pub(super) fn held(folder: &Path, leave_complete: bool) -> Result<Option<Lock>, folder::Error> {
    match Lock::take(folder) {
        Err(_) if leave_complete && Record::read(folder).is_ok_and(|record| record.complete.is_some()) => Ok(None),
        taken => taken.map(Some),
    }
}

/// Whether the run is complete, which is then said.
fn is_complete(folder: &Path, record: &Record, locked: bool) -> anyhow::Result<bool> {
    let Some(steps) = record.complete else { return Ok(false) };
    // It may have been killed after it was complete and before its last lines.
    if locked {
        sweep(folder);
        checkpoint::clear(folder)?;
    }
    println!("{}: the run is complete ({steps} steps): nothing to do", folder.display());
    Ok(true)
}

/// Whether the folder holds a run; one of another scene or under other settings is refused.
pub(super) fn is_begun(folder: &Path, name: &str, settings: &Settings) -> anyhow::Result<bool> {
    let begun = folder.join(RECORD).exists();
    if begun {
        same_run(folder, &Record::read(folder)?, name, settings)?;
    }
    Ok(begun)
}

/// Refuses to go on with a run of another scene or under other settings than those asked for.
fn same_run(folder: &Path, record: &Record, name: &str, settings: &Settings) -> anyhow::Result<()> {
    let or = "choose another --out, or --overwrite it";
    if record.scene != name {
        bail!("{}: holds a run of another scene, {}, where {name} was asked for: {or}", folder.display(), record.scene);
    }
    let mut theirs = Settings::resolve(&[Source::File(folder.join(SETTINGS))])?;
    if let Some(asked) = &record.asked {
        asked.restore(&mut theirs);
    }
    if let Some(difference) = checkpoint::setting_difference(&theirs.to_toml(), &settings.to_toml()) {
        bail!("{}: holds a run with other settings, {difference}: {or}", folder.display());
    }
    Ok(())
}

/// Reads the scene again without the views that the run in `folder` left out when it began.
pub(super) fn go_on_without(folder: &Path, loaded: &mut Loaded) -> anyhow::Result<()> {
    loaded.leave_out(Settings::resolve(&[Source::File(folder.join(SETTINGS))])?.scene.leave_out)
}

/// `runs/` and the last part of the scene's name.
pub(super) fn default_folder(scene: &str) -> PathBuf {
    let stem = Path::new(scene).file_name().unwrap_or(std::ffi::OsStr::new(scene));
    Path::new("runs").join(stem)
}

/// How a run is trained, which changes nothing of what it comes to.
#[derive(Default)]
pub(super) struct Manner {
    /// When all began: how long the first step was in coming is said when it is known.
    pub began: Option<Instant>,
    /// Where visitors see it.
    pub board: Option<Arc<Board>>,
    /// Goes on with a run that is in the folder and not complete, instead of replacing it.
    pub go_on: bool,
    /// Ends when the time is over.
    pub clock: Option<minutes::Clock>,
    /// Ends as by Ctrl-C once this is set.
    pub stop: Stop,
    /// Hash of all that a new run is made of, as its record keeps it.
    pub inputs: Option<String>,
}

/// A wish to end, of others than the terminal.
pub(super) type Stop = Arc<AtomicBool>;

/// The signal that ends the work, if there is one or a wish to end.
pub(super) fn ends(stop: &Stop) -> Option<Signal> {
    signals::caught().or_else(|| stop.load(Ordering::Relaxed).then_some(Signal::Interrupt))
}

/// What a finished run is.
pub(super) struct Trained {
    /// Speed and size.
    pub summary: Summary,
    /// Figures on the test views, if there are any.
    pub report: Option<Report>,
    /// Names of what was written into the folder.
    pub written: Vec<&'static str>,
}

/// Trains into `folder`, of which the caller holds the lock, in place of any run that is there unless it is gone on with,
/// and evaluates, with a progress bar on stderr. Signals end it from here on; what it has come to is kept.
pub(super) fn train(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    name: &str,
    folder: &Path,
    manner: &Manner,
    judge: &Judge,
) -> anyhow::Result<Trained> {
    signals::listen()?;
    if manner.go_on && Record::read(folder)?.complete.is_none() {
        // Those that it began with: they may have been made to fit the device.
        let settings = &Settings::resolve(&[Source::File(folder.join(SETTINGS))])?;
        return resume(gpu, scene, settings, name, folder, manner, judge);
    }
    let asked = settings;
    let Fitting { settings, verdict, reduced } = forecast::fitting(gpu, scene, asked, None)?;
    if let Some(line) = &reduced {
        eprintln!("memory: {line}");
    }
    let settings = &settings;
    let run = start(gpu, scene, settings, &verdict)?;
    clear(folder)?;
    let path = folder.join(SETTINGS);
    atomic::write(&path, settings.to_toml()).with_context(|| format!("{}: cannot be written", path.display()))?;
    let (asked, inputs) = (reduced.map(|_| Asked::of(asked)), manner.inputs.clone());
    let record = Record { asked, inputs, ..Record::new(&gpu.info().name, name) };
    record.write(folder)?;
    for left in &run.step().plan.left_out {
        eprintln!("left out: {} ({})", left.what, left.why);
    }
    let trained = finish(run, settings, folder, manner)?;
    judged(gpu, scene, settings, (folder, record), judge, trained)
}

/// A run from its first step, with room for what it is expected to take; refused where the device has not that much.
fn start<'a>(
    gpu: &'a Gpu,
    scene: &'a Scene,
    settings: &'a Settings,
    verdict: &forecast::Verdict,
) -> anyhow::Result<Run<'a>> {
    if let Some(why) = verdict.describe() {
        ensure!(verdict.starts(), "{}: {why}", gpu.info().name);
        eprintln!("memory: {why}");
    }
    let mut run = Run::new(gpu, scene, settings)?;
    if let Ok(forecast) = &verdict.forecast {
        run.resize(forecast.capacity)?;
        let mib = forecast.peak.div_ceil(1 << 20);
        let rows = settings.model.form.rows();
        eprintln!("memory: about {mib} MiB of device memory at most, with {} {rows} at the end", forecast.anchors);
    }
    Ok(run)
}

/// Goes on with the run in `folder`.
fn resume(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    name: &str,
    folder: &Path,
    manner: &Manner,
    judge: &Judge,
) -> anyhow::Result<Trained> {
    sweep(folder);
    let mut record = Record::read(folder)?;
    let owner = Owner::new(scene, settings);
    let Search { found, refused } = checkpoint::latest(folder, &owner);
    let reasons: Vec<String> = refused.iter().map(|refusal| format!("refused: {refusal}")).collect();
    let run = match found {
        None if !reasons.is_empty() => bail!(
            "{}: no checkpoint to go on from; `train --overwrite` starts again\n{}",
            folder.display(),
            reasons.join("\n")
        ),
        None => {
            eprintln!("resuming: no checkpoint yet, the run starts again");
            start(gpu, scene, settings, &forecast::forecast(gpu, scene, settings, Question::default())?)?
        }
        Some((path, state)) => {
            reasons.iter().for_each(|reason| eprintln!("{reason}"));
            eprintln!("resuming: behind step {} ({})", state.history.last.step, path.display());
            if record.device != gpu.info().name {
                eprintln!("resuming: the run began on {}; another device may give other bytes", record.device);
            }
            Run::resume(gpu, scene, settings, state)?
        }
    };
    if record.scene != name {
        name.clone_into(&mut record.scene);
        record.write(folder)?;
    }
    let trained = finish(run, settings, folder, manner)?;
    judged(gpu, scene, settings, (folder, record), judge, trained)
}

/// Trains to the end and evaluates.
fn finish(mut run: Run<'_>, settings: &Settings, folder: &Path, manner: &Manner) -> anyhow::Result<Trained> {
    eprintln!("{}: {}", settings.model.form.rows(), run.step().learnt.count());
    let bar = bar(settings.train.iterations, run.done());
    let host = manner.board.as_ref().map(Host::new);
    let clock = manner.clock.clone().map(|clock| (clock, folder.join(SETTINGS), settings.clone()));
    let rows = settings.model.form.rows();
    let (pictures, stop) = (folder.join(TEST), manner.stop.clone());
    let mut watch = Watch { bar, rows, pictures, failed: None, began: manner.began, host, clock, stop };
    let result = run.train(folder, &mut watch);
    watch.bar.finish_and_clear();
    let mut summary = result.inspect_err(|_| index::of_stopped(folder))?;
    if let Some(error) = watch.failed {
        index::of_stopped(folder);
        return Err(error.into());
    }
    let mut written = vec![MODEL, LOG, SETTINGS, RECORD];
    let report = summary.report.take();
    if let Some(report) = &report {
        report.write_json(&folder.join(METRICS))?;
        written.extend([TEST, METRICS]);
    }
    Ok(Trained { summary, report, written })
}

/// The trained model could not be judged.
#[derive(Debug, thiserror::Error)]
#[error("{source}; {how}")]
struct Unjudged {
    source: anyhow::Error,
    how: String,
}

/// Judges the model of a run that has ended by all that there is to judge it by, in place of the run's own figures, makes
/// its page, and marks the run as complete.
fn judged(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    (folder, record): (&Path, Record),
    judge: &Judge,
    mut trained: Trained,
) -> anyhow::Result<Trained> {
    let mut shown = vec![];
    if trained.report.is_some() {
        // A run without a checkpoint could only begin again: it is judged to the end.
        let kept = !checkpoint::list(folder).is_empty();
        let how = || format!("`gscream-vk train --resume {}` judges the trained model", folder.display());
        let go_on = || if kept { Ok(signals::check(how)?) } else { Ok(()) };
        let measured = instruments::measure(gpu, &folder.join(MODEL), scene, settings, judge, &go_on);
        let measured = measured.map_err(|source| {
            index::of_stopped(folder);
            let says = source.is::<signals::Stopped>();
            if kept && !says { Unjudged { source, how: how() }.into() } else { source }
        })?;
        measured.write_seen(scene, &folder.join(SEEN))?;
        measured.report.write_json(&folder.join(METRICS))?;
        trained.report = Some(measured.report);
        trained.written.push(SEEN);
        shown = measured.shown;
    }
    let record = Record { complete: Some(trained.summary.steps), ..record };
    index::write(folder, &record, scene, &shown)?;
    trained.written.push(index::INDEX);
    record.write(folder)?;
    checkpoint::clear(folder)?;
    Ok(trained)
}

/// Removes what an earlier run left in the folder. The run is no longer complete before the first file goes, and until its
/// record goes it can be gone on with, from the start, under its own settings.
fn clear(folder: &Path) -> anyhow::Result<()> {
    if let Ok(record @ Record { complete: Some(_), .. }) = Record::read(folder) {
        Record { complete: None, ..record }.write(folder)?;
    }
    sweep(folder);
    checkpoint::clear(folder)?;
    if !folder.join(RECORD).exists() {
        return Ok(());
    }
    let gone = |path: PathBuf, result: std::io::Result<()>| match result {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("{}: cannot be removed", path.display()))
        }
        _ => Ok(()),
    };
    for pictures in [TEST, SEEN, index::PICTURES].map(|name| folder.join(name)) {
        gone(pictures.clone(), std::fs::remove_dir_all(&pictures))?;
    }
    let model = folder.join(MODEL);
    let files = [model.join(POINT_CLOUD), model.join(WEIGHTS)];
    let of_run = [LOG, METRICS, TRACE, index::INDEX, RECORD, SETTINGS];
    for path in files.into_iter().chain(of_run.map(|name| folder.join(name))) {
        gone(path.clone(), std::fs::remove_file(&path))?;
    }
    Ok(())
}

/// Removes what a killed run had not written to the end.
fn sweep(folder: &Path) {
    folder::sweep(folder, |name| [LOG, METRICS, index::INDEX, SETTINGS, RECORD].contains(&name));
    folder::sweep(&folder.join(checkpoint::FOLDER), |name| name.starts_with("step-"));
    folder::sweep(&folder.join(MODEL), |name| [POINT_CLOUD, WEIGHTS].contains(&name));
    // Names of views may have folders in them.
    for pictures in [TEST, SEEN] {
        folder::sweep_below(&folder.join(pictures), &|name| name.ends_with(".png"));
    }
    folder::sweep_below(&folder.join(index::PICTURES), &|name| name.ends_with(".jpg"));
}

const METRICS: &str = "metrics.json";
const TRACE: &str = "trace.json";

/// A line on how long it took and what it came to.
pub(super) fn describe(summary: &Summary, form: Form) -> String {
    let rows = form.rows();
    let Summary { steps, seconds, repeated, anchors, gaussians, pairs, peak_device_bytes, .. } = summary;
    let repeated = if *repeated > 0 { format!(" ({repeated} repeated as buffers grew)") } else { String::new() };
    format!(
        "{steps} steps{repeated} in {seconds:.1} s: {:.2} steps/s; {anchors} {rows}, {gaussians:.0} Gaussians drawn and \
         {pairs:.0} pairs sorted per view; {:.0} MiB of device memory at most",
        f64::from(*steps) / seconds,
        *peak_device_bytes as f64 / f64::from(1 << 20)
    )
}

/// The last step's passes in Chrome's trace format.
fn write_trace(gpu: &Gpu, summary: &Summary, path: &Path) -> anyhow::Result<()> {
    let start = summary.last.first().map_or(0.0, |t| t.start);
    let event = |t: &Timing| {
        serde_json::json!({
            "name": t.name, "cat": "pass", "ph": "X", "pid": 1, "tid": 1,
            "ts": (t.start - start) / 1e3, "dur": t.duration / 1e3,
        })
    };
    let events: Vec<_> = summary.last.iter().map(event).collect();
    let trace = serde_json::json!({
        "traceEvents": events, "displayTimeUnit": "ms", "otherData": { "device": gpu.info().name },
    });
    let text = serde_json::to_string(&trace)?;
    std::fs::write(path, text).with_context(|| format!("{}: cannot be written", path.display()))
}

fn bar(steps: u32, done: u32) -> ProgressBar {
    let template = "{bar:30} {pos}/{len}  {per_sec}  {msg}  {eta} left";
    let style = ProgressStyle::with_template(template).expect("a valid template");
    ProgressBar::new(steps.into()).with_style(style).with_position(done.into())
}

/// Shows progress and keeps the test views.
struct Watch {
    bar: ProgressBar,
    /// The word for the elements of the model.
    rows: &'static str,
    pictures: PathBuf,
    failed: Option<pictures::Error>,
    /// Until the first step has ended.
    began: Option<Instant>,
    host: Option<Host>,
    /// With the file of the settings, and these as the run began with them.
    clock: Option<(minutes::Clock, PathBuf, Settings)>,
    stop: Stop,
}

impl Observer for Watch {
    fn step(&mut self, progress: &Progress) {
        if let Some(began) = self.began.take() {
            self.say(&format!("first step done {:.2} s after the start", began.elapsed().as_secs_f64()));
        }
        if let Some(host) = &self.host {
            host.step(progress);
        }
        self.bar.set_position(progress.step.into());
        self.bar.set_message(format!("loss {:.4}  {} {}", progress.loss, progress.anchors, self.rows));
    }

    fn corrects(&mut self, last: &Progress) -> bool {
        self.clock.as_mut().is_some_and(|(clock, ..)| clock.is_due(clock.now(), last))
    }

    fn correction(&mut self, last: &Progress, settings: &Settings) -> Option<u32> {
        let (clock, ..) = self.clock.as_mut()?;
        let iterations = clock.correction(clock.now(), last, settings)?;
        self.bar.set_length(iterations.into());
        Some(iterations)
    }

    fn corrected(&mut self, corrections: &[[u32; 2]]) {
        let Some((_, path, settings)) = &mut self.clock else { return };
        settings.train.corrections = corrections.to_vec();
        if let Err(error) = atomic::write(&*path, settings.to_toml()) {
            let line = format!("warning: {}: cannot be written: {error}", path.display());
            self.say(&line);
        }
    }

    fn visited(&mut self) -> bool {
        self.host.as_ref().is_some_and(Host::visited)
    }

    fn look(&mut self, draw: &mut dyn FnMut(&Camera) -> Result<Option<Rendered>, gpu::Error>) {
        if let Some(host) = &mut self.host {
            host.look(draw);
        }
    }

    fn evaluated(&mut self, progress: &Progress, report: &Report) {
        if let Some(host) = &self.host {
            host.evaluated(progress, report);
        }
    }

    fn say(&mut self, line: &str) {
        self.bar.suspend(|| eprintln!("{line}"));
    }

    fn rendered(&mut self, view: &str, picture: &Rendered) {
        let path = pictures::path(&self.pictures, view, "png");
        if let Err(error) = pictures::write_png(&path, picture.size, &picture.rgb) {
            self.failed.get_or_insert(error);
        }
    }

    fn interrupted(&mut self) -> Option<Signal> {
        ends(&self.stop)
    }
}

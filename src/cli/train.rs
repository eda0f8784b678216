//! `gscream-vk train`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};

use super::folders::{MODEL, RECORD, Record, SETTINGS, TEST};
use super::pictures;
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::config::Settings;
use crate::evaluate::Report;
use crate::gpu::{Gpu, Options, Timing};
use crate::render::view::Rendered;
use crate::scene::Scene;
use crate::train::forecast::{self, Question};
use crate::train::run::{Observer, Progress, Run, Summary};

/// Train a scene without its object
///
/// Writes a run folder: the model (point_cloud.ply, weights.safetensors), log.jsonl, settings.toml, run.json, the test
/// views as rendered at the end and their figures (metrics.json). `synthetic` is the built-in scene.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk train synthetic --preset demo
  gscream-vk train garden --preset lavapipe --out runs/garden
  gscream-vk train garden --preset paper --set losses.depth.enabled=false --iterations 7000")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Run folder; must not hold a run already [default: runs/SCENE]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace a run that is already in the folder
    #[arg(long)]
    overwrite: bool,
    /// Measure every pass: prints milliseconds per pass and writes trace.json (for chrome://tracing or Perfetto)
    #[arg(long)]
    profile: bool,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let (scene, settings) = args.scene.load()?;
    let name = args.scene.name();
    let folder = args.out.clone().unwrap_or_else(|| default_folder(&name));
    if folder.join(RECORD).exists() && !args.overwrite {
        bail!("{}: holds a run already: choose another --out, or --overwrite", folder.display());
    }
    let options = Options { timestamps: args.profile, ..args.device.options() };
    with_gpu(&options, |gpu| {
        eprintln!("device: {} ({})", gpu.info().name, gpu.info().driver);
        let Trained { summary, report, mut written } = train(gpu, &scene, &settings, &name, &folder)?;
        if let Some(report) = report {
            println!("{}", report.table());
        }
        if args.profile {
            write_trace(gpu, &summary, &folder.join(TRACE))?;
            written.push(TRACE);
            println!("{}", summary.timings.table());
        }
        println!("{}", describe(&summary));
        println!("wrote {} in {}", written.join(", "), folder.display());
        Ok(())
    })
}

/// `runs/` and the last part of the scene's name.
pub(super) fn default_folder(scene: &str) -> PathBuf {
    let stem = Path::new(scene).file_name().unwrap_or(std::ffi::OsStr::new(scene));
    Path::new("runs").join(stem)
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

/// Trains into `folder` and evaluates, with a progress bar on stderr.
pub(super) fn train(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    name: &str,
    folder: &Path,
) -> anyhow::Result<Trained> {
    let verdict = forecast::forecast(gpu, scene, settings, Question::default())?;
    if let Some(why) = verdict.describe() {
        ensure!(verdict.starts(), "{}: {why}", gpu.info().name);
        eprintln!("memory: {why}");
    }
    std::fs::create_dir_all(folder).with_context(|| format!("{}: cannot be made", folder.display()))?;
    let mut run = Run::new(gpu, scene, settings)?;
    if let Ok(forecast) = &verdict.forecast {
        run.resize(forecast.capacity)?;
        let mib = forecast.peak.div_ceil(1 << 20);
        eprintln!("memory: about {mib} MiB of device memory at most, with {} anchors at the end", forecast.anchors);
    }
    let path = folder.join(SETTINGS);
    std::fs::write(&path, settings.to_toml()).with_context(|| format!("{}: cannot be written", path.display()))?;
    Record::new(&gpu.info().name, name).write(folder)?;
    for left in &run.step().plan.left_out {
        eprintln!("left out: {} ({})", left.what, left.why);
    }
    eprintln!("anchors: {}", run.step().anchors.count);
    let mut watch = Watch { bar: bar(settings.train.iterations), pictures: folder.join(TEST), failed: None };
    let mut summary = run.train(folder, &mut watch)?;
    watch.bar.finish_and_clear();
    if let Some(error) = watch.failed {
        return Err(error.into());
    }
    let mut written = vec![MODEL, "log.jsonl", SETTINGS, RECORD];
    let report = summary.report.take();
    if let Some(report) = &report {
        report.write_json(&folder.join(METRICS))?;
        written.extend([TEST, METRICS]);
    }
    Ok(Trained { summary, report, written })
}

const METRICS: &str = "metrics.json";
const TRACE: &str = "trace.json";

fn describe(summary: &Summary) -> String {
    let Summary { steps, seconds, repeated, anchors, gaussians, pairs, peak_device_bytes, .. } = summary;
    let repeated = if *repeated > 0 { format!(" ({repeated} repeated as buffers grew)") } else { String::new() };
    format!(
        "{steps} steps{repeated} in {seconds:.1} s: {:.2} steps/s; {anchors} anchors, {gaussians:.0} Gaussians drawn and \
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

fn bar(steps: u32) -> ProgressBar {
    let template = "{bar:30} {pos}/{len}  {per_sec}  {msg}  {eta} left";
    let style = ProgressStyle::with_template(template).expect("a valid template");
    ProgressBar::new(steps.into()).with_style(style)
}

/// Shows progress and keeps the test views.
struct Watch {
    bar: ProgressBar,
    pictures: PathBuf,
    failed: Option<pictures::Error>,
}

impl Observer for Watch {
    fn step(&mut self, progress: &Progress) {
        self.bar.set_position(progress.step.into());
        self.bar.set_message(format!("loss {:.4}  {} anchors", progress.loss, progress.anchors));
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
}

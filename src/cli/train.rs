//! `gscream-vk train`.

use std::path::PathBuf;

use anyhow::{Context as _, bail};
use indicatif::{ProgressBar, ProgressStyle};

use super::folders::{MODEL, RECORD, Record, SETTINGS, TEST};
use super::pictures;
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::gpu::{Gpu, Options, Timing};
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
    let folder = args.out.clone().unwrap_or_else(|| {
        let stem = PathBuf::from(&name);
        PathBuf::from("runs").join(stem.file_name().unwrap_or(stem.as_os_str()))
    });
    if folder.join(RECORD).exists() && !args.overwrite {
        bail!("{}: holds a run already: choose another --out, or --overwrite", folder.display());
    }
    let options = Options { timestamps: args.profile, ..args.device.options() };
    with_gpu(&options, |gpu| {
        std::fs::create_dir_all(&folder).with_context(|| format!("{}: cannot be made", folder.display()))?;
        let path = folder.join(SETTINGS);
        std::fs::write(&path, settings.to_toml()).with_context(|| format!("{}: cannot be written", path.display()))?;
        Record::new(&gpu.info().name, &name).write(&folder)?;
        eprintln!("device: {} ({})", gpu.info().name, gpu.info().driver);
        let mut run = Run::new(gpu, &scene, &settings)?;
        for left in &run.step().plan.left_out {
            eprintln!("left out: {} ({})", left.what, left.why);
        }
        eprintln!("anchors: {}", run.step().anchors.count);
        let mut bar = Bar::new(settings.train.iterations);
        let summary = run.train(&folder, &mut bar)?;
        bar.0.finish_and_clear();
        let mut written = vec![MODEL.to_owned(), "log.jsonl".into(), SETTINGS.into(), RECORD.into()];
        let mut failed = None;
        let mut keep = |view: &str, picture: &crate::render::view::Rendered| {
            let path = pictures::path(&folder.join(TEST), view, "png");
            if let Err(error) = pictures::write_png(&path, picture.size, &picture.rgb) {
                failed.get_or_insert(error);
            }
        };
        if let Some(report) = run.evaluate(Some(&mut keep))? {
            if let Some(error) = failed {
                return Err(error.into());
            }
            let path = folder.join("metrics.json");
            report.write_json(&path)?;
            written.extend([TEST.to_owned(), "metrics.json".into()]);
            println!("{}", report.table());
        }
        if args.profile {
            write_trace(gpu, &summary, &folder.join("trace.json"))?;
            written.push("trace.json".into());
            println!("{}", summary.timings.table());
        }
        println!("{}", describe(&summary));
        println!("wrote {} in {}", written.join(", "), folder.display());
        Ok(())
    })
}

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
fn write_trace(gpu: &Gpu, summary: &Summary, path: &std::path::Path) -> anyhow::Result<()> {
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

struct Bar(ProgressBar);

impl Bar {
    fn new(steps: u32) -> Self {
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len}  {per_sec}  {msg}  {eta} left")
            .expect("a valid template");
        Self(ProgressBar::new(steps.into()).with_style(style))
    }
}

impl Observer for Bar {
    fn step(&mut self, progress: &Progress) {
        self.0.set_position(progress.step.into());
        self.0.set_message(format!("loss {:.4}  {} anchors", progress.loss, progress.anchors));
    }
    fn say(&mut self, line: &str) {
        self.0.suspend(|| eprintln!("{line}"));
    }
}

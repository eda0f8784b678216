//! `gscream-vk plan`.

use std::collections::BTreeMap;

use anyhow::Context as _;
use serde::Serialize;
use serde_json::{Value, json};

use super::next;
use super::preset;
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::config::Settings;
use crate::gpu::{self, Entry, Gpu, Options, Schedule, Timings};
use crate::scene::Scene;
use crate::stage;
use crate::train::forecast::{self, Question, Verdict};
use crate::train::order::Order;
use crate::train::plan::{Plan, Steps};
use crate::train::run::Run;
use crate::work::Ready;

/// Show what a scene's training consists of, and the memory it will take
///
/// Nothing is trained: views of the untrained model are counted on the device, and the run is rehearsed without it. Every
/// stage is listed with its steps, passes and bytes, or with the reason why it is left out. Of one step every pass follows:
/// a line `name  <read  >written  <>both` is a pass with its bindings; an indented line is a barrier and the hazards that
/// demand it.
///
/// Without --preset and --config the preset is chosen as `train` chooses it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk plan synthetic --preset demo
  gscream-vk plan garden --preset lavapipe --step 2000
  gscream-vk plan garden --preset paper --memory 8192
  gscream-vk plan garden --preset lavapipe --step 1500 --measure 20
  gscream-vk plan garden --preset paper --json | jq .memory.peak_bytes")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Step to show: later ones may have attention, and growth statistics
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    step: u32,
    /// Anchors at the end of training, for the memory [default: an estimate from the points]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    anchors: Option<u32>,
    /// Plan for a device with so much free memory instead of this one's
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..))]
    memory: Option<u64>,
    /// Run N steps of the untrained model from --step on, and print their passes, bytes and milliseconds
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    measure: Option<u32>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let loaded = preset::load(&args.scene, &args.device)?;
    let options = Options { timestamps: args.measure.is_some(), ..args.device.options() };
    with_gpu(&options, |gpu| {
        let Ready { scene, settings } = loaded.ready(gpu)?;
        let question =
            Question { anchors: args.anchors, available: args.memory.map(|mib| mib << 20), also: Some(args.step) };
        let verdict = forecast::forecast(gpu, &scene, &settings, question)?;
        let plan = Plan::new(&scene, &settings);
        let view = Order::of(&scene, &settings.train).view(args.step);
        let shown = Shown {
            device: &gpu.info().name,
            scene: args.scene.name(),
            step: args.step,
            view: &scene.train[view].name,
            stages: stages(&plan, &settings, &verdict),
            schedule: schedule(gpu, &scene, &settings, &verdict, args.step)?,
            plan: &plan,
            verdict: &verdict,
            measured: args.measure.map(|n| measure(gpu, &scene, &settings, &verdict, args.step, n)).transpose()?,
        };
        if args.json {
            println!("{}", serde_json::to_string_pretty(&shown.json()).context("the plan as JSON")?);
        } else {
            print!("{}", shown.text());
        }
        next::say(&[(next::command(&["train"], &args.scene.scene), "trains it; give it the same settings")]);
        Ok(())
    })
}

/// The passes of a step of the whole run, rehearsed.
fn schedule(gpu: &Gpu, scene: &Scene, settings: &Settings, verdict: &Verdict, step: u32) -> anyhow::Result<Schedule> {
    let gpu = gpu.rehearsal();
    let mut run = Run::new(&gpu, scene, settings)?;
    // Long lists are scanned in more passes than short ones.
    if let Ok(forecast) = &verdict.forecast {
        run.resize(forecast.capacity)?;
    }
    let mut rec = gpu.recorder()?;
    run.record(&mut rec, step)?;
    Ok(rec.schedule().clone())
}

/// A stage of the run.
#[derive(Serialize)]
struct Stage {
    name: &'static str,
    /// Absent for one that is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    steps: Option<Steps>,
    /// Why it is left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<String>,
    passes: Vec<&'static str>,
    /// The most bytes of its buffers at any time.
    bytes: u64,
    buffers: Vec<Buffer>,
}

#[derive(Serialize)]
struct Buffer {
    name: &'static str,
    number: usize,
    bytes: u64,
}

fn stages(plan: &Plan, settings: &Settings, verdict: &Verdict) -> Vec<Stage> {
    let used = |name| verdict.forecast.as_ref().ok().and_then(|f| f.used.get(name)).cloned().unwrap_or_default();
    let of = |&name: &&'static str| {
        let used = used(name);
        let buffers = used.buffers.iter().map(|(&name, &(number, bytes))| Buffer { name, number, bytes });
        let mut buffers: Vec<_> = buffers.collect();
        buffers.sort_by(|a, b| b.bytes.cmp(&a.bytes).then(a.name.cmp(b.name)));
        Stage {
            name,
            steps: plan.steps(name, settings),
            why: plan.why(name).filter(|_| plan.steps(name, settings).is_none()).map(str::to_owned),
            passes: used.passes.iter().copied().collect(),
            bytes: buffers.iter().map(|b| b.bytes).sum(),
            buffers,
        }
    };
    stage::ALL.iter().map(of).collect()
}

/// Steps as they ran.
#[derive(Serialize)]
struct Measured {
    steps: u32,
    /// Of the first one.
    passes: usize,
    barriers: usize,
    /// Buffers alive.
    bytes: u64,
    /// Sum of the passes' timestamps: mean over the steps, and their standard deviation.
    ms: f64,
    ms_deviation: f64,
    /// Mean of each pass.
    by_pass: BTreeMap<&'static str, f64>,
}

fn measure(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    verdict: &Verdict,
    from: u32,
    steps: u32,
) -> anyhow::Result<Measured> {
    if gpu.info().timestamp_period == 0.0 {
        anyhow::bail!("{} has no timestamps: --measure has nothing to read", gpu.info().name);
    }
    let mut run = Run::new(gpu, scene, settings)?;
    if let Ok(forecast) = &verdict.forecast {
        run.resize(forecast.capacity)?;
    }
    // Kernels are compiled and memory is touched before anything is timed.
    run.run_one(from)?;
    let mut timings = Timings::default();
    let mut sums = vec![];
    let mut counts = None;
    for step in from..from.saturating_add(steps) {
        let times = loop {
            let mut rec = gpu.recorder()?;
            run.record(&mut rec, step)?;
            let submission = rec.submit()?;
            let count = (submission.schedule.passes(), submission.schedule.barriers());
            let times = submission.wait()?;
            if gpu.read(run.step().limits.overflow())?[0] == 0 {
                counts.get_or_insert(count);
                break times;
            }
            // Too little room: the step is taken with more, and measured then.
            run.run_one(step)?;
        };
        sums.push(times.iter().map(|t| t.duration).sum::<f64>() / 1e6);
        timings.add(&times);
    }
    let n = sums.len() as f64;
    let (passes, barriers) = counts.unwrap_or_default();
    let ms = sums.iter().sum::<f64>() / n;
    let variance = sums.iter().map(|s| (s - ms).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    Ok(Measured {
        steps,
        passes,
        barriers,
        bytes: gpu.memory().0,
        ms,
        ms_deviation: variance.sqrt(),
        by_pass: timings.per_submission().into_iter().map(|(name, _, ms)| (name, ms)).collect(),
    })
}

struct Shown<'a> {
    device: &'a str,
    scene: String,
    step: u32,
    view: &'a str,
    plan: &'a Plan,
    stages: Vec<Stage>,
    schedule: Schedule,
    verdict: &'a Verdict,
    measured: Option<Measured>,
}

impl Shown<'_> {
    fn json(&self) -> Value {
        let entry = |entry: &Entry| match entry {
            Entry::Pass { name, stage, accesses } => {
                let of = |with: fn(gpu::Access) -> bool| -> Vec<&str> {
                    accesses.iter().filter(|(_, access)| with(*access)).map(|(buffer, _)| *buffer).collect()
                };
                json!({ "pass": name, "stage": stage, "reads": of(gpu::Access::reads), "writes": of(gpu::Access::writes) })
            }
            Entry::Barrier { reasons } => json!({ "barrier": reasons }),
        };
        let Verdict { available, forecast, remedies } = self.verdict;
        let memory = match forecast {
            Ok(f) => json!({
                "available_bytes": available,
                "needs_bytes": f.needs(),
                "fits": self.verdict.fits(),
                "start_bytes": f.start,
                "peak_bytes": f.peak,
                "anchors": { "start": f.survey.anchors, "end": f.anchors },
                "survey": f.survey,
                "capacity": { "visible": f.capacity.visible, "pairs": f.capacity.pairs },
                "moments": f.moments,
                "would_fit": remedies,
            }),
            Err(buffer) => json!({
                "available_bytes": available, "fits": false, "error": buffer, "would_fit": remedies,
            }),
        };
        json!({
            "device": self.device,
            "scene": self.scene,
            "stages": self.stages,
            "left_out": self.plan.left_out,
            "pipelines": forecast.as_ref().map(|f| f.pipelines.clone()).unwrap_or_default(),
            "step": {
                "number": self.step,
                "view": self.view,
                "passes": self.schedule.passes(),
                "barriers": self.schedule.barriers(),
                "schedule": self.schedule.entries.iter().map(entry).collect::<Vec<_>>(),
            },
            "memory": memory,
            "measured": self.measured,
        })
    }

    fn text(&self) -> String {
        let mut text = String::new();
        let mut line = |line: String| {
            text.push_str(line.trim_end());
            text.push('\n');
        };
        line(format!("{:<20} {:>15} {:>7} {:>9} {:>13}", "stage", "steps", "kernels", "buffers", "bytes"));
        for s in &self.stages {
            line(match (&s.steps, &s.why) {
                (Some(Steps { first, last }), _) => {
                    let buffers: usize = s.buffers.iter().map(|b| b.number).sum();
                    let steps = format!("{first} to {last}");
                    format!("{:<20} {steps:>15} {:>7} {buffers:>9} {:>13}", s.name, s.passes.len(), s.bytes)
                }
                (None, why) => format!("{:<20} left out: {}", s.name, why.as_deref().unwrap_or("not asked for")),
            });
        }
        line("\nleft out".into());
        for left in &self.plan.left_out {
            line(format!("  {:<55} {}", left.what, left.why));
        }
        let schedule = &self.schedule;
        let (passes, barriers) = (schedule.passes(), schedule.barriers());
        line(format!("\nstep {} (view {}): {passes} passes, {barriers} barriers", self.step, self.view));
        line(schedule.to_string());
        line("buffers".into());
        let buffers = self.stages.iter().flat_map(|s| s.buffers.iter().map(|b| (s.name, b)));
        for (stage, Buffer { name, number, bytes }) in buffers {
            line(format!("  {stage:<20} {name:<28} {number:>4} x {bytes:>12} bytes in all"));
        }
        line("\nmemory".into());
        match &self.verdict.forecast {
            Ok(f) => {
                let survey = f.survey;
                line(format!(
                    "  {} {} at first, {} assumed at the end; in a view at most {} of them and {} (Gaussian, tile) pairs",
                    survey.anchors,
                    f.form.rows(),
                    f.anchors,
                    survey.visible,
                    survey.pairs
                ));
                for m in &f.moments {
                    line(format!("  step {:<8} {:<26} {:>12} bytes, peak {:>12}", m.step, m.what, m.bytes, m.peak));
                }
                line(format!(
                    "  {:<40} {:>12} bytes, {} with the allocator's blocks, {} available: {}",
                    "in all",
                    f.peak,
                    f.needs(),
                    self.verdict.available,
                    if self.verdict.fits() { "fits" } else { "does not fit" }
                ));
            }
            Err(buffer) => line(format!("  does not fit: {buffer}")),
        }
        if let Some(why) = self.verdict.describe() {
            line(format!("  {why}"));
        }
        if let Some(m) = &self.measured {
            line(format!(
                "\nmeasured over {} steps: {} passes, {} barriers, {} bytes, {:.2} ms per step (deviation {:.2})",
                m.steps, m.passes, m.barriers, m.bytes, m.ms, m.ms_deviation
            ));
            let mut passes: Vec<_> = m.by_pass.iter().collect();
            passes.sort_by(|a, b| b.1.total_cmp(a.1));
            for (name, ms) in passes {
                line(format!("  {name:<40} {ms:>10.3} ms"));
            }
        }
        text
    }
}

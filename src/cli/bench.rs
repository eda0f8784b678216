//! `gscream-vk bench`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use super::report::{command_line, last_part};
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::bench::compare::{self, Subject};
use crate::bench::{self, Device, Record, ceilings, tables, text};
use crate::gpu::{Gpu, Options};
use crate::report::SceneFacts;
use crate::report::tables::write;
use crate::train::plan::Plan;

/// Measure every pass of a step against the time it would take at the device's own ceilings
///
/// The device's copy bandwidth, multiply-adds, exponentials, dispatches and barriers are measured first. The scene is
/// then trained for the warm-up, with growing and pruning as set, and one step is timed by timestamp queries, pass by
/// pass, beside what it has to do by the numbers read back from it: bytes, operations, exponentials. A ratio of 1 is the
/// floor; below it the arrays stay in a cache.
///
/// With --out writes bench.json and passes.csv.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk bench synthetic --preset demo
  gscream-vk bench garden --preset lavapipe --warm-up 200 --repetitions 15 --out before
  gscream-vk bench garden --preset lavapipe --warm-up 200 --repetitions 15 --against before/bench.json")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Folder for bench.json and the tables; must not hold a record already
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace a record that is already in the folder
    #[arg(long)]
    overwrite: bool,
    /// An earlier bench.json of the same device, scene and settings to compare with
    #[arg(long, value_name = "FILE")]
    against: Option<PathBuf>,
    /// Steps trained before the measured one
    #[arg(long, value_name = "N", default_value_t = 50)]
    warm_up: u32,
    /// Number that the measured step counts as [default: the first with attention, or the one after the warm-up]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    step: Option<u32>,
    /// Views on which the step is measured, the reference view first
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Timed rounds
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u32).range(1..))]
    repetitions: u32,
    #[command(flatten)]
    device: DeviceArgs,
}

const JSON: &str = "bench.json";

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(out) = &args.out
        && out.join(JSON).exists()
        && !args.overwrite
    {
        bail!("{}: holds a record already: choose another --out, or --overwrite", out.display());
    }
    let old = args.against.as_deref().map(|path| Ok::<_, compare::Error>((path, compare::read(path)?))).transpose()?;
    let (scene, settings) = args.scene.load()?;
    let facts = SceneFacts::new(last_part(&args.scene.name()), &scene);
    let json = serde_json::to_value(&settings).context("the settings as JSON")?;
    let plan = Plan::new(&scene, &settings);
    let step = args.step.unwrap_or_else(|| bench::usual_step(&plan, &settings, args.warm_up));
    let mut say = |line: &str| eprintln!("{line}");
    let options = Options { timestamps: true, ..args.device.options() };
    let (record, notes) = with_gpu(&options, |gpu| {
        bench::ensure_timestamps(gpu)?;
        let device = Device::from(gpu.info());
        let subject =
            Subject { device: &device, scene: Some(&facts), settings: &json, warm_up: args.warm_up, step: Some(step) };
        let notes = old
            .as_ref()
            .map(|(path, old)| compare::ensure_comparable(path, old, subject))
            .transpose()?
            .unwrap_or_default();
        let ceilings = measure_ceilings(gpu, args.repetitions as usize, &mut say)?;
        let options = bench::Options {
            warm_up: args.warm_up,
            step: Some(step),
            views: args.views as usize,
            repetitions: args.repetitions as usize,
        };
        let figures = bench::scene(gpu, &scene, &settings, &ceilings, options, &mut say)?;
        let record = Record {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            command: command_line(),
            device,
            settings: json.clone(),
            scene: Some(facts.clone()),
            warm_up: args.warm_up,
            ceilings,
            step: Some(figures),
        };
        Ok((record, notes))
    })?;
    print!("{}", text::record(&record));
    if let Some((_, old)) = &old {
        print!("\n{}", compare::compare(old, &record, notes));
    }
    if let Some(out) = &args.out {
        let written = write_files(&record, out)?;
        println!("\nwrote {} in {}", written.join(", "), out.display());
    }
    Ok(())
}

fn measure_ceilings(
    gpu: &Gpu,
    repetitions: usize,
    say: &mut dyn FnMut(&str),
) -> anyhow::Result<ceilings::Ceilings> {
    say("bench: ceilings of the device");
    ceilings::measure(gpu, repetitions).map_err(|e| crate::report::Error::Gpu(e).into())
}

fn write_files(record: &Record, out: &Path) -> anyhow::Result<Vec<&'static str>> {
    std::fs::create_dir_all(out).with_context(|| format!("{}: cannot be made", out.display()))?;
    let mut files: Vec<(&'static str, Vec<u8>)> = vec![];
    if let Some(step) = &record.step {
        files.push(("passes.csv", tables::passes(step)));
    }
    // Last: its presence says that the record is complete.
    files.push((JSON, record.to_json().into_bytes()));
    for (name, contents) in &files {
        write(&out.join(name), contents)?;
    }
    let mut names: Vec<&'static str> = files.into_iter().map(|(name, _)| name).collect();
    names.reverse();
    Ok(names)
}

//! `gscream-vk bench`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use super::folders::last_part;
use super::hole::{self, HoleArgs};
use super::next;
use super::next::command_line;
use super::shared::{DeviceArgs, MeasureArgs, SceneArgs, only_anchors, with_gpu};
use crate::config::SettingsArgs;
use crate::gpu::Options;
use crate::lab::bench::ceilings::Prober;
use crate::lab::bench::compare::{self, Subject};
use crate::lab::bench::{self, Device, Record, Trained, figures, loads, predict, tables, text};
use crate::lab::plots;
use crate::lab::report::SceneFacts;
use crate::lab::report::tables::write;
use crate::train::plan::Plan;
use crate::work::{Loaded, Ready};

/// Measure every pass of a step against the time it would take at the device's own ceilings
///
/// The scene is trained for the warm-up, with growing and pruning as set, and one step is timed by timestamp queries,
/// pass by pass, beside what it has to do by the numbers read back from it: bytes, operations, exponentials. In the same
/// rounds the device's copy bandwidth, multiply-adds, exponentials, dispatches and barriers are measured. A ratio of 1 is
/// the floor.
///
/// With --loads generated scenes of 1e3 to 1e6 anchors, 160 x 90 to 3840 x 2160 pixels and up to 3e7 pairs are measured
/// instead, and how every pass grows with them. With --tune the choices of tile and group shapes are run in turn, on
/// the scene or on a generated load, and the best printed as a table for the source.
///
/// With --predict what the step has to do is set against the published peaks of GPUs that are not at hand: the time of
/// every pass, of the step and of train.iterations steps like it, on paper. --form gpu measures the kernels that a GPU
/// would run.
///
/// With --hole what is measured is not time: composed scenes, whose truth is known, are prepared from one mask, trained and
/// judged.
///
/// With --out writes bench.json, the tables as CSV and the plots as SVG.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk bench synthetic --preset demo
  gscream-vk bench garden --preset lavapipe --warm-up 200 --repetitions 15 --out before
  gscream-vk bench garden --preset lavapipe --warm-up 200 --repetitions 15 --against before/bench.json
  gscream-vk bench --loads --seconds 600 --preset lavapipe --out loads
  gscream-vk bench --tune --preset lavapipe
  gscream-vk bench garden --preset paper --form gpu --warm-up 20 --repetitions 1 --predict published
  gscream-vk bench --hole set/* --seeds 3 --iterations 800 --out before")]
pub(super) struct Args {
    /// Folder of the scene, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE", required_unless_present_any = ["loads", "tune", "hole"])]
    scene: Option<PathBuf>,
    #[command(flatten)]
    settings: SettingsArgs,
    /// Measure generated scenes of growing size
    #[arg(long, conflicts_with_all = ["scene", "tune"])]
    loads: bool,
    /// Seconds that they may take; what does not fit is named
    #[arg(long, value_name = "S", default_value_t = 120.0, requires = "loads", value_parser = seconds)]
    seconds: f64,
    /// Run the choices of tile and group shapes
    #[arg(long)]
    tune: bool,
    /// TOML file with the peaks of GPUs to predict the step for, or the word `published` for the list that comes along
    #[arg(long, value_name = "PEAKS", conflicts_with_all = ["loads", "tune"])]
    predict: Option<PathBuf>,
    /// Folder for bench.json and the tables; must not hold a record already
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace a record that is already in the folder
    #[arg(long)]
    overwrite: bool,
    /// An earlier bench.json of the same device, scene and settings to compare with
    #[arg(long, value_name = "FILE")]
    against: Option<PathBuf>,
    #[command(flatten)]
    measure: MeasureArgs,
    #[command(flatten)]
    hole: HoleArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

const JSON: &str = "bench.json";

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    if !args.hole.hole.is_empty() {
        return hole::run(&args.hole, &args.settings, &args.device, args.out.as_deref());
    }
    if let Some(out) = &args.out
        && out.join(JSON).exists()
        && !args.overwrite
    {
        bail!("{}: holds a record already: choose another --out, or --overwrite", out.display());
    }
    let old = args.against.as_deref().map(|path| Ok::<_, compare::Error>((path, compare::read(path)?))).transpose()?;
    let peaks = args.predict.as_deref().map(predict::read).transpose()?.unwrap_or_default();
    let settings = args.settings.resolve()?;
    only_anchors(&settings, "bench")?;
    let loaded = args
        .scene
        .clone()
        .map(|scene| {
            let args = SceneArgs { scene, settings: args.settings.clone() };
            let loaded = Loaded::read(&args.scene, settings.clone())?;
            let facts = SceneFacts::new(last_part(&args.name()), &loaded.scene);
            Ok::<_, anyhow::Error>((loaded, facts))
        })
        .transpose()?;
    let (loaded, facts) = loaded.map_or((None, None), |(loaded, facts)| (Some(loaded), Some(facts)));
    let json = serde_json::to_value(&settings).context("the settings as JSON")?;
    let MeasureArgs { warm_up, step, views, repetitions } = args.measure;
    let (views, repetitions) = (views as usize, repetitions as usize);
    let number = |Loaded { scene, .. }: &Loaded| {
        step.unwrap_or_else(|| bench::usual_step(&Plan::new(scene, &settings), &settings, warm_up))
    };
    let step = loaded.as_ref().map(number);
    let mut say = |line: &str| eprintln!("{line}");
    let options = Options { timestamps: true, ..args.device.options() };
    let (record, notes) = with_gpu(&options, |gpu| {
        bench::ensure_timestamps(gpu)?;
        let device = Device::from(gpu.info());
        let subject = Subject { device: &device, scene: facts.as_ref(), settings: &json, warm_up, step };
        let notes = old
            .as_ref()
            .map(|(path, old)| compare::ensure_comparable(path, old, subject))
            .transpose()?
            .unwrap_or_default();
        let (scene, settings) = match loaded {
            Some(loaded) => loaded.ready(gpu).map(|Ready { scene, settings }| (Some(scene), settings))?,
            None => (None, settings),
        };
        say("bench: ceilings of the device");
        let mut prober = Prober::new(gpu)?;
        if scene.is_none() {
            (0..repetitions).try_for_each(|_| prober.round())?;
        }
        let trained = scene
            .as_ref()
            .zip(step)
            .map(|(scene, step)| Trained::new(gpu, scene, &settings, warm_up, (step, views), &mut say))
            .transpose()?;
        let figures = match &trained {
            Some(trained) => Some(trained.measure(gpu, &settings, &mut prober, repetitions, &mut say)?),
            None => None,
        };
        let ceilings = prober.ceilings();
        // The loads need the room.
        drop(prober);
        let loads = match args.loads {
            true => Some(loads::measure(gpu, &settings, &ceilings, (repetitions, args.seconds), &mut say)?),
            false => None,
        };
        let tune = match args.tune {
            true => Some(bench::tune(gpu, trained.as_ref(), &settings, repetitions, &mut say)?),
            false => None,
        };
        let steps = settings.train.iterations;
        let predictions = figures
            .as_ref()
            .map_or_else(Vec::new, |step| peaks.iter().map(|peak| predict::predict(step, steps, peak)).collect());
        let record = Record {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            command: command_line(),
            device,
            settings: json.clone(),
            scene: facts.clone(),
            warm_up,
            ceilings,
            step: figures,
            loads,
            tune,
            predictions,
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
        let record = next::typed(&out.join(JSON).to_string_lossy());
        next::say(&[(format!("--against {record}"), "compares a later bench of the same scene with this one")]);
    } else {
        next::say(&[("--out DIR".to_owned(), "keeps the record, and --against compares a later one with it")]);
    }
    Ok(())
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "not a number of seconds".to_owned())?;
    if seconds.is_finite() && seconds >= 0.0 { Ok(seconds) } else { Err("must be 0 or more".to_owned()) }
}

fn write_files(record: &Record, out: &Path) -> anyhow::Result<Vec<&'static str>> {
    std::fs::create_dir_all(out).with_context(|| format!("{}: cannot be made", out.display()))?;
    let mut files: Vec<(&'static str, Vec<u8>)> = vec![];
    if let Some(step) = &record.step {
        files.push(("passes.csv", tables::passes(step)));
        files.push(("passes.svg", plots::draw(&figures::passes(step))?.into_bytes()));
    }
    if let Some(loads) = record.loads.as_ref().filter(|loads| !loads.runs.is_empty()) {
        files.push(("loads.csv", tables::loads(loads)));
        files.push(("exponents.csv", tables::exponents(loads)));
        files.push(("loads.svg", plots::draw(&figures::loads(loads))?.into_bytes()));
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

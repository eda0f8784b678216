//! `gscream-vk bench`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use super::folders::last_part;
use super::hole::{self, HoleArgs};
use super::next;
use super::next::command_line;
use super::shared::{DeviceArgs, MeasureArgs, SceneArgs, with_gpu};
use crate::config::SettingsArgs;
use crate::gpu::Options;
use crate::lab::bench::ceilings::Prober;
use crate::lab::bench::compare::{self, Subject};
use crate::lab::bench::{self, Device, Record, Trained, figures, predict, tables, text};
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
  gscream-vk bench garden --preset paper --form gpu --warm-up 20 --repetitions 1 --predict published
  gscream-vk bench --hole set/* --seeds 3 --iterations 800 --out before")]
pub(super) struct Args {
    /// Folder of the scene, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE", required_unless_present = "hole")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    settings: SettingsArgs,
    /// TOML file with the peaks of GPUs to predict the step for, or the word `published` for the list that comes along
    #[arg(long, value_name = "PEAKS")]
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
    let Some(scene) = args.scene.clone() else { bail!("SCENE: name the scene to measure a step of") };
    let args_of_scene = SceneArgs { scene, settings: args.settings.clone() };
    let settings = args_of_scene.resolve()?;
    let loaded = Loaded::read(&args_of_scene.scene, settings.clone())?;
    let facts = SceneFacts::new(last_part(&args_of_scene.name()), &loaded.scene);
    let json = serde_json::to_value(&settings).context("the settings as JSON")?;
    let MeasureArgs { warm_up, step, views, repetitions } = args.measure;
    let (views, repetitions) = (views as usize, repetitions as usize);
    let number = || bench::usual_step(&Plan::new(&loaded.scene, &settings), &settings, warm_up);
    let step = step.unwrap_or_else(number);
    let mut say = |line: &str| eprintln!("{line}");
    let options = Options { timestamps: true, ..args.device.options() };
    let (record, notes) = with_gpu(&options, |gpu| {
        bench::ensure_timestamps(gpu)?;
        let device = Device::from(gpu.info());
        let subject = Subject { device: &device, scene: &facts, settings: &json, warm_up, step };
        let notes = old
            .as_ref()
            .map(|(path, old)| compare::ensure_comparable(path, old, subject))
            .transpose()?
            .unwrap_or_default();
        let Ready { scene, settings } = loaded.ready(gpu)?;
        say("bench: ceilings of the device");
        let mut prober = Prober::new(gpu)?;
        let trained = Trained::new(gpu, &scene, &settings, warm_up, (step, views), &mut say)?;
        let figures = trained.measure(gpu, &settings, &mut prober, repetitions, &mut say)?;
        let ceilings = prober.ceilings();
        let steps = settings.train.iterations;
        let predictions = peaks.iter().map(|peak| predict::predict(&figures, steps, peak)).collect();
        let record = Record {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            command: command_line(),
            device,
            settings: json.clone(),
            scene: facts,
            warm_up,
            ceilings,
            step: figures,
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

fn write_files(record: &Record, out: &Path) -> anyhow::Result<Vec<&'static str>> {
    std::fs::create_dir_all(out).with_context(|| format!("{}: cannot be made", out.display()))?;
    let files: Vec<(&'static str, Vec<u8>)> = vec![
        ("passes.csv", tables::passes(&record.step)),
        ("passes.svg", plots::draw(&figures::passes(&record.step))?.into_bytes()),
        // Last: its presence says that the record is complete.
        (JSON, record.to_json().into_bytes()),
    ];
    for (name, contents) in &files {
        write(&out.join(name), contents)?;
    }
    let mut names: Vec<&'static str> = files.into_iter().map(|(name, _)| name).collect();
    names.reverse();
    Ok(names)
}

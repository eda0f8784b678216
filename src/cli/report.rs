//! `gscream-vk report`.

use std::path::PathBuf;

use anyhow::{Context as _, bail};

use super::folders::last_part;
use super::next;
use super::next::command_line;
use super::shared::{DeviceArgs, MeasureArgs, SceneArgs, only_anchors, with_gpu};
use super::train::default_folder;
use crate::config::Settings;
use crate::gpu::{Gpu, Options};
use crate::lab::plots;
use crate::lab::report::page::{self, Drawings};
use crate::lab::report::training::Spacing;
use crate::lab::report::{Report, SceneFacts, figures, kernels, tables, training};
use crate::lab::variants::{self, Variant};
use crate::scene::Scene;
use crate::work::{Loaded, Ready};

/// Measure error against run time, of a step's stages and of whole training runs, for a table of choices
///
/// One training step: every stage of every choice, its GPU time from timestamp queries beside its distance from the
/// float64 reference path under the settings as given. Training: PSNR, masked PSNR and loss on held-out views against
/// seconds and steps, taken while the clock stands still. Choices that are neither more accurate nor faster than another
/// are marked as superfluous.
///
/// Writes report.html (self-contained), report.json and CSV tables with the same numbers, the plots as SVG, and
/// settings.toml.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk report synthetic --preset demo
  gscream-vk report garden --preset lavapipe --kernels-only --views 4 --repetitions 15
  gscream-vk report garden --preset lavapipe --training-only --seeds 3 --only 'as set' --only 'no depth'
  gscream-vk report synthetic --preset demo --variant 'weak attention:model.attention.blend*=0.1'")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Folder for the report; must not hold one already [default: runs/SCENE-report]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace a report that is already in the folder
    #[arg(long)]
    overwrite: bool,
    /// Measure one step, train nothing
    #[arg(long, conflicts_with = "training_only")]
    kernels_only: bool,
    /// Train, measure no single step
    #[arg(long)]
    training_only: bool,
    /// Measure only the choice of this name, beside the settings as they are; may be given many times
    #[arg(long, value_name = "NAME")]
    only: Vec<String>,
    /// Measure one more choice; may be given many times
    ///
    /// KEY=VALUE as for --set, or KEY*=FACTOR to multiply what the settings say; the name may be left out.
    #[arg(long, value_name = "NAME:KEY=VALUE,...")]
    variant: Vec<String>,
    #[command(flatten)]
    measure: MeasureArgs,
    /// Times at which figures are taken in a training run
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    samples: u32,
    /// How these lie in the run
    #[arg(long, value_name = "HOW", default_value = "log")]
    spacing: Spacing,
    /// Training runs per choice, with seeds train.seed, train.seed + 1, ...
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    seeds: u32,
    #[command(flatten)]
    device: DeviceArgs,
}

const PAGE: &str = "report.html";
const JSON: &str = "report.json";

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let loaded = args.scene.load()?;
    let settings = &loaded.settings;
    only_anchors(settings, "report")?;
    let name = args.scene.name();
    let out = args.out.clone().unwrap_or_else(|| {
        let mut folder = default_folder(&name).into_os_string();
        folder.push("-report");
        folder.into()
    });
    if out.join(JSON).exists() && !args.overwrite {
        bail!("{}: holds a report already: choose another --out, or --overwrite", out.display());
    }
    let steps = choices(args, settings, variants::KERNELS)?;
    let runs = choices(args, settings, variants::TRAINING)?;
    for wanted in &args.only {
        if !steps.iter().chain(&runs).any(|v| v.name == *wanted) {
            let mut names: Vec<&str> =
                variants::KERNELS.iter().chain(variants::TRAINING).map(|(name, _)| *name).collect();
            names.sort_unstable();
            names.dedup();
            bail!("--only {wanted}: no choice has this name; there are {}", names.join(", "));
        }
    }
    if !args.kernels_only && loaded.scene.test.is_empty() {
        return Err(crate::lab::report::Error::NoTestViews.into());
    }
    std::fs::create_dir_all(&out).with_context(|| format!("{}: cannot be made", out.display()))?;

    let Ready { scene, settings } = with_gpu(&args.device.options(), |gpu| loaded.ready(gpu))?;
    let mut device = None;
    let mut say = |line: &str| eprintln!("{line}");
    let kernels = if args.training_only {
        None
    } else {
        let options = Options { timestamps: true, ..args.device.options() };
        Some(with_gpu(&options, |gpu| {
            device = Some(gpu.info().clone());
            let options = kernels::Options {
                warm_up: args.measure.warm_up,
                step: args.measure.step,
                views: args.measure.views as usize,
                repetitions: args.measure.repetitions as usize,
            };
            Ok(kernels::measure(gpu, &scene, steps, options, &mut say)?)
        })?)
    };
    let training = if args.kernels_only {
        None
    } else {
        // Without timestamps, as `train` runs.
        Some(with_gpu(&args.device.options(), |gpu| {
            device = Some(gpu.info().clone());
            let options = training::Options { samples: args.samples, spacing: args.spacing, seeds: args.seeds };
            let read = |settings: &Settings| read(gpu, args, settings);
            training::measure(gpu, &scene, runs, options, read, &mut say)
        })?)
    };
    let device = device.expect("one of the two was measured");
    let report = Report {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        command: command_line(),
        scene: SceneFacts::new(last_part(&name), &scene),
        device,
        settings,
        kernels,
        training,
    };
    let written = write(&report, &out)?;
    print!("{}", summary(&report));
    println!("wrote {} in {}", written.join(", "), out.display());
    next::say(&[(next::typed(&out.join(PAGE).to_string_lossy()), "open it in a browser")]);
    Ok(())
}

/// The choices of a table and of the command line, resolved; the settings as they are come first.
fn choices(args: &Args, settings: &Settings, table: &[variants::Choice]) -> anyhow::Result<Vec<Variant>> {
    let own: Vec<(String, Vec<String>)> = args.variant.iter().map(|text| variants::parse(text)).collect();
    let wanted = |name: &str| args.only.is_empty() || args.only.iter().any(|only| only == name);
    let of_table = table
        .iter()
        .enumerate()
        .filter(|(i, (name, _))| *i == 0 || wanted(name))
        .map(|(_, (name, changes))| (*name, changes.iter().map(|change| (*change).to_owned()).collect()));
    let own = own.iter().map(|(name, changes)| (name.as_str(), changes.clone()));
    Ok(variants::resolve(&args.scene.settings.sources(), settings, of_table.chain(own))?)
}

/// Reads the scene again, at another size for instance.
fn read(gpu: &Gpu, args: &Args, settings: &Settings) -> anyhow::Result<Scene> {
    Ok(Loaded::read(&args.scene.scene, settings.clone())?.ready(gpu)?.scene)
}

fn write(report: &Report, out: &std::path::Path) -> anyhow::Result<Vec<&'static str>> {
    let mut drawings = Drawings::default();
    let mut files: Vec<(&'static str, Vec<u8>)> = vec![];
    if let Some(kernels) = &report.kernels {
        drawings.whole = plots::draw(&figures::whole(kernels))?;
        drawings.stages = plots::draw(&figures::by_stage(kernels))?;
        files.push(("step.svg", drawings.whole.clone().into_bytes()));
        files.push(("stages.svg", drawings.stages.clone().into_bytes()));
        files.push(("kernels.csv", tables::kernels(kernels)));
        files.push(("tensors.csv", tables::tensors(kernels)));
    }
    if let Some(training) = &report.training {
        drawings.training = plots::draw(&figures::training(training))?;
        files.push(("training.svg", drawings.training.clone().into_bytes()));
        files.push(("training.csv", tables::training(training)));
    }
    files.push((super::folders::SETTINGS, report.settings.to_toml().into_bytes()));
    files.push((PAGE, page::page(report, &drawings).into_bytes()));
    // Last: its presence says that the report is complete.
    files.push((JSON, tables::json(report).into_bytes()));
    for (name, contents) in &files {
        tables::write(&out.join(name), contents)?;
    }
    let mut names: Vec<&'static str> = files.into_iter().map(|(name, _)| name).collect();
    names.reverse();
    Ok(names)
}

/// The essence for the terminal.
fn summary(report: &Report) -> String {
    let mut lines = vec![];
    if let Some(kernels) = &report.kernels {
        lines.push(format!(
            "{:<28} {:>10} {:>10} {:>14} {:>14}",
            "one step", "picture ms", "step ms", "picture error", "gradient error"
        ));
        for v in &kernels.variants {
            lines.push(format!(
                "{:<28} {:>10.3} {:>10.3} {:>14.1e} {:>14.1e}{}",
                v.name,
                v.picture_milliseconds.median,
                v.step_milliseconds.median,
                v.picture_error.relative,
                v.gradient_error.relative,
                superfluous(v.dominated_by.as_ref())
            ));
        }
    }
    if let Some(training) = &report.training {
        lines.push(format!("{:<28} {:>10} {:>10} {:>14} {:>14}", "training", "seconds", "PSNR", "masked PSNR", "loss"));
        for v in &training.variants {
            let Some(end) = v.points.last().map(|p| &p.mean) else { continue };
            let masked = end.masked_psnr.map_or("-".to_owned(), |psnr| format!("{psnr:.2}"));
            lines.push(format!(
                "{:<28} {:>10.1} {:>10.2} {masked:>14} {:>14.4}{}",
                v.name,
                end.seconds,
                end.psnr,
                end.loss,
                superfluous(v.dominated_by.as_ref())
            ));
        }
        if !training.differences.is_empty() {
            lines.push(format!("{:<28} {:>16} {:>16} {:>18}", "over the seeds", "PSNR", "masked PSNR", "SSIM"));
            for end in &training.ends {
                let of = |name, digits| end.figures.get(name).map_or("-".to_owned(), |m| m.text(digits));
                lines.push(format!(
                    "{:<28} {:>16} {:>16} {:>18}",
                    end.variant,
                    of("psnr", 2),
                    of("masked_psnr", 2),
                    of("ssim", 4)
                ));
            }
            for d in &training.differences {
                let of = |name| {
                    let tested = d.figures.get(name);
                    tested.map_or("-".to_owned(), |t| {
                        format!("{:+.2} ± {:.2} dB (p {:.3})", t.difference, t.standard_error, t.p)
                    })
                };
                lines.push(format!("{} less {}: PSNR {}, masked {}", d.to, d.from, of("psnr"), of("masked_psnr")));
            }
        }
    }
    lines.join("\n") + "\n"
}

fn superfluous(by: Option<&String>) -> String {
    by.map_or(String::new(), |by| format!("  superfluous: {by}"))
}

//! `gscream-vk verify`.

use anyhow::bail;
use indicatif::{ProgressBar, ProgressStyle};

use super::next;
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::train::run::Run;
use crate::work::Ready;

/// Run every pass of a scene's step on the device and on the CPU reference path, and compare
///
/// Each pass and its float64 twin get the same inputs, those that the device made so far; a line per tensor says the
/// largest error, the tensor's scale, cosine and norm ratio. Exit code 1 if any is beyond its bound.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk verify synthetic --preset demo
  gscream-vk verify garden --preset lavapipe --warm-up 50 --step 2001")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Steps trained before the one compared
    #[arg(long, value_name = "N", default_value_t = 20)]
    warm_up: u32,
    /// Number that the compared step counts as [default: the one after the warm-up]; attention and growth statistics
    /// belong to later steps
    #[arg(long, value_name = "N")]
    step: Option<u32>,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let loaded = args.scene.load()?;
    with_gpu(&args.device.options(), |gpu| {
        let Ready { scene, settings } = loaded.ready(gpu)?;
        let mut run = Run::new(gpu, &scene, &settings)?;
        let style = ProgressStyle::with_template("warm-up {wide_bar} {pos}/{len} steps, {eta} left")?;
        let bar = ProgressBar::new(args.warm_up.into()).with_style(style);
        for step in 1..=args.warm_up {
            run.run_one(step)?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        let step = args.step.unwrap_or(args.warm_up + 1).max(1);
        let mut rec = gpu.checked()?;
        let view = run.record(&mut rec, step)?;
        let submission = rec.submit()?;
        let differences = submission.differences.clone();
        submission.wait()?;
        println!("step {step}, view {view}");
        for difference in &differences {
            println!("{difference}");
        }
        let beyond = differences.iter().filter(|d| !d.ok()).count();
        println!("{} tensors compared, {beyond} beyond their bound", differences.len());
        if beyond > 0 {
            bail!("{beyond} tensors differ from the reference path by more than their bound");
        }
        next::say(&[(next::command(&["train"], &args.scene.scene), "trains the scene")]);
        Ok(())
    })
}

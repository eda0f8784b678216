//! `gscream-vk plan`.

use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use crate::train::run::Run;

/// Show what a scene's step consists of: passes, barriers with their reasons, buffers, and what was left out and why
///
/// Nothing is trained: the step is recorded and printed. A line `name  <read  >written  <>both` is a pass with its
/// bindings; an indented line is a barrier and the hazards that demand it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk plan synthetic --preset demo
  gscream-vk plan garden --preset lavapipe --step 2000")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Step to show: later ones may have attention, and growth statistics
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    step: u32,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let (scene, settings) = args.scene.load()?;
    with_gpu(&args.device.options(), |gpu| {
        let mut run = Run::new(gpu, &scene, &settings)?;
        let mut rec = gpu.recorder()?;
        let view = run.record(&mut rec, args.step)?;
        let schedule = rec.schedule();
        println!("step {} (view {view}): {} passes, {} barriers", args.step, schedule.passes(), schedule.barriers());
        print!("{schedule}");
        println!("\nleft out");
        for left in &run.step().plan.left_out {
            println!("  {:<55} {}", left.what, left.why);
        }
        println!("\nbuffers");
        let buffers = gpu.buffers();
        for (name, number, bytes) in &buffers {
            println!("  {name:<28} {number:>4} x {bytes:>12} bytes in all");
        }
        let total: u64 = buffers.iter().map(|b| b.2).sum();
        println!("  {:<28} {:>6} {total:>12} bytes", "sum", "");
        Ok(())
    })
}

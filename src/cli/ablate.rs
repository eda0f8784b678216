//! `gscream-vk ablate`.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, bail};
use serde::Serialize;

use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use super::train::{Trained, default_folder, train};
use crate::config::Settings;
use crate::evaluate::Metrics;

/// Train a scene with neither depth nor attention, with depth, and with both, and compare (the ablation of the paper)
///
/// One run after the other with the same seed, each in a folder of its own; prints a table of the figures on the test
/// views and writes it as ablation.json. `write-back` is the release's attention, which changes the features in place,
/// beside the paper's, through which gradients flow.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk ablate synthetic --preset demo
  gscream-vk ablate garden --preset lavapipe --iterations 1000 --out runs/ablation")]
pub(super) struct Args {
    #[command(flatten)]
    scene: SceneArgs,
    /// Folder for the runs [default: runs/SCENE-ablation]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceArgs,
}

/// Names of the variants and what each has: depth, attention, attention written back.
const VARIANTS: [(&str, bool, bool, bool); 4] = [
    ("neither", false, false, false),
    ("depth", true, false, false),
    ("depth-attention", true, true, false),
    ("depth-write-back", true, true, true),
];

#[derive(Serialize)]
struct Row {
    variant: &'static str,
    seconds: f64,
    steps_per_second: f64,
    anchors: u32,
    metrics: Metrics,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let (scene, settings) = args.scene.load()?;
    if scene.test.is_empty() {
        bail!("the scene has no test views to compare on: set scene.test_every to hold some out");
    }
    let name = args.scene.name();
    let out = args.out.clone().unwrap_or_else(|| {
        let mut folder = default_folder(&name).into_os_string();
        folder.push("-ablation");
        folder.into()
    });
    let rows = with_gpu(&args.device.options(), |gpu| {
        let mut rows = vec![];
        for (variant, depth, attention, write_back) in VARIANTS {
            eprintln!("== {variant}");
            let mut settings: Settings = settings.clone();
            settings.losses.depth.enabled &= depth;
            settings.model.attention.enabled &= attention;
            settings.model.attention.write_back = write_back;
            let Trained { summary, report, .. } = train(gpu, &scene, &settings, &name, &out.join(variant), None)?;
            let mean = report.and_then(|r| r.mean).expect("there are test views");
            rows.push(Row {
                variant,
                seconds: summary.seconds,
                steps_per_second: f64::from(summary.steps) / summary.seconds,
                anchors: summary.anchors,
                metrics: mean.metrics,
            });
        }
        Ok(rows)
    })?;
    let path = out.join("ablation.json");
    let text = serde_json::to_string_pretty(&rows)? + "\n";
    std::fs::write(&path, text).with_context(|| format!("{}: cannot be written", path.display()))?;
    print!("{}", table(&rows));
    println!("wrote {} runs and ablation.json in {}", rows.len(), out.display());
    Ok(())
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| variant | PSNR | masked PSNR | SSIM | masked SSIM | FLIP | masked FLIP | anchors | steps/s | seconds |\n\
         | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
    );
    for row in rows {
        let full = &row.metrics.full;
        let masked = |value: &dyn Fn(&crate::evaluate::Figures) -> f64, digits: usize| {
            row.metrics.mask.as_ref().map_or("-".to_owned(), |m| format!("{:.digits$}", value(m)))
        };
        let line = format!(
            "| {} | {:.2} | {} | {:.4} | {} | {:.4} | {} | {} | {:.2} | {:.0} |",
            row.variant,
            full.psnr,
            masked(&|m| m.psnr, 2),
            full.ssim,
            masked(&|m| m.ssim, 4),
            full.flip,
            masked(&|m| m.flip, 4),
            row.anchors,
            row.steps_per_second,
            row.seconds
        );
        writeln!(text, "{line}").expect("a string takes everything");
    }
    text
}

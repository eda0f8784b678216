use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail};
use image::{GrayImage, RgbImage};

use super::folders::{self, Origin};
use super::shared;
use crate::evaluate::{self, Report, ViewMetrics};
use crate::scene;

/// Measure rendered views against photographs: PSNR, SSIM and FLIP
///
/// Figures are given on the full picture and, where a mask is there, inside the mask and inside its bounding box. The
/// table goes to stdout, the same figures to a JSON file.
///
/// With --truth, RENDERS is any folder of pictures, compared with those of the same name up to the extension. Without,
/// it is a run folder: its test views are compared with those of its scene, read with the run's own settings.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk eval runs/garden
  gscream-vk eval renders --truth scene/test_images --masks scene/test_masks
  gscream-vk eval renders --truth scene/test_images --downscale 4 --json renders.json")]
pub(super) struct Args {
    /// Folder of rendered pictures, or a run folder
    renders: PathBuf,
    /// Folder of photographs
    #[arg(long, value_name = "DIR")]
    truth: Option<PathBuf>,
    /// Folder of masks, not 0 = inside; as large as the photographs
    #[arg(long, value_name = "DIR", requires = "truth")]
    masks: Option<PathBuf>,
    /// Reduce photographs and masks to 1/N of their size, as training does
    #[arg(long, value_name = "N", requires = "truth", value_parser = clap::value_parser!(u32).range(1..))]
    downscale: Option<u32>,
    /// Where to write the figures [default: metrics.json in RENDERS]
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let views = match &args.truth {
        Some(truth) => of_folders(&args.renders, truth, args.masks.as_deref(), args.downscale.unwrap_or(1))?,
        None => of_run(&args.renders)?,
    };
    let report = Report::new(views);
    let json = args.json.clone().unwrap_or_else(|| args.renders.join("metrics.json"));
    report.write_json(&json)?;
    print!("{}", report.table());
    eprintln!("wrote {}", json.display());
    Ok(())
}

fn of_run(run: &Path) -> anyhow::Result<Vec<ViewMetrics>> {
    if run.is_dir() && !run.join(folders::RECORD).is_file() {
        bail!("{}: not a run folder; for a folder of pictures, name the photographs with --truth", run.display());
    }
    let origin = Origin::find(run)?;
    let settings = origin.settings(vec![])?;
    let scene = origin.scene().context("a run folder names its scene")?;
    let scene = shared::load_scene(Path::new(scene), &settings)?;
    if scene.test.is_empty() {
        bail!("{}: its scene has no test views to compare with", run.display());
    }
    let renders = run.join(folders::TEST);
    let found = pictures(&renders)?;
    let compare = |view: &scene::View| {
        let path = found
            .get(&view.name)
            .ok_or_else(|| anyhow!("{}: test view {} is missing", renders.display(), view.name))?;
        metrics(&view.name, path, &view.image, view.mask.as_ref())
    };
    scene.test.iter().map(compare).collect()
}

fn of_folders(renders: &Path, truth: &Path, masks: Option<&Path>, downscale: u32) -> anyhow::Result<Vec<ViewMetrics>> {
    let (found, photographs) = (pictures(renders)?, pictures(truth)?);
    let masks = masks.map(pictures).transpose()?;
    let first = |files: &BTreeMap<String, PathBuf>| files.keys().next().cloned().unwrap_or_default();
    let pairs: Vec<_> = found.iter().filter_map(|(name, path)| Some((name, path, photographs.get(name)?))).collect();
    if pairs.is_empty() {
        bail!(
            "{}: no picture has the name of one in {} (pictures like {}, photographs like {})",
            renders.display(),
            truth.display(),
            first(&found),
            first(&photographs)
        );
    }
    let note = |lost: usize, all: usize, text: &str| {
        if lost > 0 {
            eprintln!("note: {lost} of {all} {text}");
        }
    };
    note(found.len() - pairs.len(), found.len(), "pictures have no photograph of their name and are left out");
    note(photographs.len() - pairs.len(), photographs.len(), "photographs have no picture of their name");
    if let Some(masks) = &masks {
        let without = pairs.iter().filter(|(name, ..)| !masks.contains_key(*name)).count();
        note(without, pairs.len(), "pictures have no mask; the masked figures are those of the others");
    }
    let compare = |(name, render, photograph): (&String, &PathBuf, &PathBuf)| {
        let photograph = scene::photograph(photograph, downscale)?;
        let mask = masks.as_ref().and_then(|masks| masks.get(name));
        let mask = mask.map(|path| scene::mask(path, downscale)).transpose()?;
        metrics(name, render, &photograph, mask.as_ref())
    };
    pairs.into_iter().map(compare).collect()
}

fn metrics(name: &str, render: &Path, truth: &RgbImage, mask: Option<&GrayImage>) -> anyhow::Result<ViewMetrics> {
    let image = scene::photograph(render, 1)?;
    let metrics = evaluate::compare(&image, truth, mask).map_err(|error| {
        let reduced = image.dimensions() < truth.dimensions();
        let hint = if reduced { "; --downscale N reduces photographs and masks" } else { "" };
        anyhow!("{}: {error}{hint}", render.display())
    })?;
    Ok(ViewMetrics { name: name.to_owned(), metrics })
}

/// The pictures below a folder by their path without extension.
fn pictures(folder: &Path) -> anyhow::Result<BTreeMap<String, PathBuf>> {
    let found = scene::pictures(folder)?;
    if found.is_empty() {
        bail!("{}: no pictures (.png or .jpg) in this folder", folder.display());
    }
    Ok(found)
}

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail};
use image::{GrayImage, RgbImage};

use super::folders::{self, Origin};
use super::shared::DeviceArgs;
use super::{instruments, next};
use crate::evaluate::fid::Inception;
use crate::evaluate::lpips::Lpips;
use crate::evaluate::{Judge, Judging, Metrics, Protocol, Report};
use crate::scene::{self, Scene};
use crate::work;

/// Measure rendered views against photographs: PSNR, SSIM and FLIP, and LPIPS and FID with your weights
///
/// Figures are given on the full picture and, where a mask is there, inside the mask, inside its bounding box, outside
/// the mask and within 3 pixels of its edge. The table goes to stdout, the same figures to a JSON file.
///
/// With --truth, RENDERS is any folder of pictures, compared with those of the same name up to the extension. Without,
/// it is a run folder: its test views are compared with those of its scene, read with the run's own settings. They are
/// drawn again from the run's model, which tells more than their pictures do: figures of the pixels alone that some
/// train view photographed, the depth inside the mask where the true one is known, and how much of the object is left.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk eval runs/garden
  gscream-vk eval runs/garden --protocol spinnerf --lpips-weights vgg.safetensors --fid-weights inception.safetensors
  gscream-vk eval renders --truth scene/test_images --masks scene/test_masks --seen runs/garden/seen
  gscream-vk eval renders --truth scene/test_images --downscale 4 --json renders.json

Weights, converted by one line of Python each (torch and safetensors): torchvision's vgg16 or alexnet with LPIPS's own
(version 0.1: vgg.pth, alex.pth), and pytorch-fid's Inception.
  python -c \"import torch, safetensors.torch as s; s.save_file({k: v.float().contiguous() for f in ['vgg16-397923af.pth',
    'vgg.pth'] for k, v in torch.load(f).items() if k[0] in 'fl'}, 'vgg.safetensors')\"
  python -c \"import torch, safetensors.torch as s; s.save_file({k: v.float().contiguous() for f in
    ['alexnet-owt-7be5be79.pth', 'alex.pth'] for k, v in torch.load(f).items() if k[0] in 'fl'}, 'alex.safetensors')\"
  python -c \"import torch, safetensors.torch as s; s.save_file({k: v.float().contiguous() for k, v in
    torch.load('pt_inception-2015-12-05-6726825d.pth').items() if k[0] in 'CM'}, 'inception.safetensors')\"")]
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
    /// Folder of pictures that are not 0 where some train view photographed what the view shows, as a run has them
    #[arg(long, value_name = "DIR", requires = "truth")]
    seen: Option<PathBuf>,
    /// Folder of true depth maps of the run's test views (.npy, .exr, .png; not positive: unknown), in any unit
    #[arg(long, value_name = "DIR", conflicts_with_all = ["truth", "pictures"])]
    depth_truth: Option<PathBuf>,
    /// Judge the run's stored pictures instead of drawing them again: needs no device, and tells less
    #[arg(long, conflicts_with = "truth")]
    pictures: bool,
    #[command(flatten)]
    judge: JudgeArgs,
    /// Where to write the figures [default: metrics.json in RENDERS]
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceArgs,
}

/// What judges pictures.
#[derive(Debug, Clone, Default, clap::Args)]
pub(super) struct JudgeArgs {
    /// How masks, boxes and averages are taken
    #[arg(long, value_name = "NAME", value_enum, default_value_t)]
    protocol: Protocol,
    /// Weights for LPIPS, VGG-16's or AlexNet's (.safetensors, see below); may be given twice
    #[arg(long, value_name = "FILE")]
    lpips_weights: Vec<PathBuf>,
    /// Weights for FID, pytorch-fid's Inception (.safetensors, see below)
    #[arg(long, value_name = "FILE")]
    fid_weights: Option<PathBuf>,
}

impl JudgeArgs {
    /// Reads the weights.
    ///
    /// # Errors
    /// Weights that cannot be read; two of one network.
    pub(super) fn judge(&self) -> anyhow::Result<Judge> {
        let lpips = self.lpips_weights.iter().map(|path| Lpips::read(path)).collect::<Result<Vec<_>, _>>()?;
        if let [first, second, ..] = lpips.as_slice()
            && (first.net() == second.net() || lpips.len() > 2)
        {
            bail!("--lpips-weights: two files hold weights of {}; name one of each network", first.net().name());
        }
        let inception = self.fid_weights.as_deref().map(Inception::read).transpose()?;
        Ok(Judge { protocol: self.protocol, lpips, inception })
    }
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let judge = args.judge.judge()?;
    let report = match &args.truth {
        Some(truth) => of_folders(args, &judge, truth)?,
        None => of_run(args, &judge)?,
    };
    let json = args.json.clone().unwrap_or_else(|| args.renders.join("metrics.json"));
    report.write_json(&json)?;
    print!("{}", report.table());
    if let Some(protocol) = &report.protocol {
        println!("protocol {protocol}");
    }
    eprintln!("wrote {}", json.display());
    next::say(&[match &args.truth {
        None => (next::command(&["export"], &args.renders), "writes the scene for viewers"),
        Some(_) if args.masks.is_none() => ("--masks DIR".to_owned(), "adds the figures inside the masks"),
        Some(_) => ("--lpips-weights FILE".to_owned(), "adds LPIPS; gscream-vk eval --help has all figures"),
    }]);
    Ok(())
}

fn of_run(args: &Args, judge: &Judge) -> anyhow::Result<Report> {
    let run = &args.renders;
    if run.is_dir() && !run.join(folders::RECORD).is_file() {
        bail!("{}: not a run folder; for a folder of pictures, name the photographs with --truth", run.display());
    }
    let origin = Origin::find(run)?;
    let settings = origin.settings(vec![])?;
    let scene = origin.scene().context("a run folder names its scene")?;
    let mut scene = work::load_scene(Path::new(scene), &settings)?;
    if scene.test.is_empty() {
        bail!("{}: its scene has no test views to compare with", run.display());
    }
    say_departure(judge, scene.test[0].camera.size);
    if let Some(folder) = &args.depth_truth {
        take_depths(&mut scene, folder)?;
    }
    if !args.pictures && origin.model().join(crate::model::files::POINT_CLOUD).is_file() {
        return args.device.with_gpu(|gpu| {
            let measured = instruments::measure(gpu, &origin.model(), &scene, &settings, judge, &|| Ok(()))?;
            measured.write_seen(&scene, &run.join(folders::SEEN))?;
            Ok(measured.report)
        });
    }
    if args.depth_truth.is_some() {
        bail!("{}: has no model to take depth from", run.display());
    }
    let (renders, maps) = (run.join(folders::TEST), run.join(folders::SEEN));
    let found = pictures(&renders)?;
    let mut judging = judge.start();
    for view in &scene.test {
        let path = found
            .get(&view.name)
            .ok_or_else(|| anyhow!("{}: test view {} is missing", renders.display(), view.name))?;
        let map = super::pictures::path(&maps, &view.name, "png");
        let map = map.is_file().then(|| scene::mask(&map, 1)).transpose()?;
        let (render, metrics) = add(&mut judging, &view.name, path, &view.image, view.mask.as_ref(), map.as_ref())?;
        metrics.fitted = instruments::fitted(&scene, view, &render)?;
    }
    Ok(judging.report())
}

/// Gives the test views the true depth maps of a folder, in place of the scene's own.
fn take_depths(scene: &mut Scene, folder: &Path) -> anyhow::Result<()> {
    let maps = scene::depth_maps(folder)?;
    let mut taken = 0;
    for view in &mut scene.test {
        let size = view.camera.size;
        let map = maps.get(&view.name).map(|path| scene::depth_map(path, size, size)).transpose()?;
        view.depth = map.map(|map| map.iter().map(|z| (f64::from(*z) / scene.unit) as f32).collect());
        taken += usize::from(view.depth.is_some());
    }
    if taken == 0 {
        bail!("{}: no depth map has the name of a test view (like {})", folder.display(), scene.test[0].name);
    }
    if taken < scene.test.len() {
        eprintln!("note: {} of {} test views have no true depth map", scene.test.len() - taken, scene.test.len());
    }
    Ok(())
}

/// Says where figures are not what a protocol's published ones are.
fn say_departure(judge: &Judge, size: [u32; 2]) {
    if let Some(text) = judge.protocol.departs(size) {
        eprintln!("note: {text}");
    }
}

fn of_folders(args: &Args, judge: &Judge, truth: &Path) -> anyhow::Result<Report> {
    let (renders, downscale) = (&args.renders, args.downscale.unwrap_or(1));
    let (found, photographs) = (pictures(renders)?, pictures(truth)?);
    let masks = args.masks.as_deref().map(pictures).transpose()?;
    let maps = args.seen.as_deref().map(pictures).transpose()?;
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
    if let Some(maps) = &maps {
        let without = pairs.iter().filter(|(name, ..)| !maps.contains_key(*name)).count();
        note(without, pairs.len(), "pictures have no map of seen pixels; those figures are of the others");
    }
    let mut judging = judge.start();
    for (i, (name, render, photograph)) in pairs.into_iter().enumerate() {
        let photograph = scene::photograph(photograph, downscale)?;
        if i == 0 {
            say_departure(judge, [photograph.width(), photograph.height()]);
        }
        let mask = masks.as_ref().and_then(|masks| masks.get(name));
        let mask = mask.map(|path| scene::mask(path, downscale)).transpose()?;
        let map = maps.as_ref().and_then(|maps| maps.get(name)).map(|path| scene::mask(path, 1)).transpose()?;
        add(&mut judging, name, render, &photograph, mask.as_ref(), map.as_ref())?;
    }
    Ok(judging.report())
}

fn add<'a>(
    judging: &'a mut Judging<'_>,
    name: &str,
    render: &Path,
    truth: &RgbImage,
    mask: Option<&GrayImage>,
    seen: Option<&GrayImage>,
) -> anyhow::Result<(RgbImage, &'a mut Metrics)> {
    let image = scene::photograph(render, 1)?;
    let metrics = judging.add(name, &image, truth, mask, seen).map_err(|error| {
        let reduced = image.dimensions() < truth.dimensions();
        let hint = if reduced { "; --downscale N reduces photographs and masks" } else { "" };
        anyhow!("{}: {error}{hint}", render.display())
    })?;
    Ok((image, metrics))
}

/// The pictures below a folder by their path without extension.
fn pictures(folder: &Path) -> anyhow::Result<BTreeMap<String, PathBuf>> {
    let found = scene::pictures(folder)?;
    if found.is_empty() {
        bail!("{}: no pictures (.png or .jpg) in this folder", folder.display());
    }
    Ok(found)
}

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use indicatif::{ProgressBar, ProgressStyle};

use super::folders::Origin;
use super::shared::DeviceArgs;
use super::{next, pictures};
use crate::atomic::shortened;
use crate::config::Source;
use crate::folder::{self, Lock};
use crate::model::stored::Stored;
use crate::render::view::Renderer;
use crate::scene::{Camera, Scene, View, path};
use crate::work;

/// Render views of a trained model: colour as PNG, depth and transmittance as OpenEXR
///
/// Every view becomes NAME.png (8-bit RGB) and NAME.exr with two float32 channels: Z is the depth, the sum of z alpha T
/// along the pixel's ray in scene units, not divided by the coverage; T is the transmittance left behind the last
/// Gaussian. Z / (1 - T) is the mean depth of what was hit.
///
/// Cameras come from the scene. A run folder names its scene and settings; a folder with a model alone (point_cloud.ply
/// and weights.safetensors) needs --scene, and has the default settings but for --config and --set.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk render runs/garden
  gscream-vk render runs/garden --views spiral --frames 240 --out film
  gscream-vk render runs/garden/model --scene garden --views train --downscale 4")]
pub(super) struct Args {
    /// Run folder, or a model's own folder
    #[arg(value_name = "RUN")]
    model: PathBuf,
    /// Scene to take the cameras from, or the word `synthetic` [default: the run's own]
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Cameras to render from
    #[arg(long, value_enum, default_value_t = Views::Test)]
    views: Views,
    /// Pictures of the spiral path
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    /// Folder for the pictures [default: renders/VIEWS in RUN]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Render at 1/N of the photographs' size [default: as trained]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    downscale: Option<u32>,
    /// TOML file whose settings replace those of the run
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Replace one setting; may be given many times
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    device: DeviceArgs,
}

/// Endings of a view's files: colour; depth and transmittance.
const PICTURE: &str = "png";
const MAPS: &str = "exr";

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Views {
    /// The test views
    Test,
    /// The train views
    Train,
    /// A smooth closed path among the train cameras, looking at what they look at, without lens distortion
    Spiral,
}

impl Views {
    fn name(self) -> &'static str {
        match self {
            Views::Test => "test",
            Views::Train => "train",
            Views::Spiral => "spiral",
        }
    }

    fn cameras(self, scene: &Scene, frames: u32) -> Vec<(String, Camera)> {
        let named = |views: &[View]| views.iter().map(|view| (view.name.clone(), view.camera)).collect();
        match self {
            Views::Test => named(&scene.test),
            Views::Train => named(&scene.train),
            Views::Spiral => {
                let train: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
                let digits = frames.saturating_sub(1).to_string().len();
                let frames = path::spiral(&train, &scene.points, frames);
                frames.into_iter().enumerate().map(|(i, camera)| (format!("frame_{i:0digits$}"), camera)).collect()
            }
        }
    }
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let origin = Origin::find(&args.model)?;
    let downscale = args.downscale.map(|n| Source::Flag {
        flag: "--downscale",
        key: "scene.downscale",
        value: toml::Value::Integer(n.into()),
    });
    let file = args.config.iter().cloned().map(Source::File);
    let changes = file.chain(args.set.iter().cloned().map(Source::Set)).chain(downscale).collect();
    let settings = origin.settings(changes)?;
    let trained = origin.settings(vec![])?.scene.downscale;
    let larger = f64::from(trained) / f64::from(settings.scene.downscale);
    let mut model = Stored::load(&origin.model())?;
    let own = origin.scene().map(Path::new);
    let scene = args.scene.as_deref().or(own).with_context(|| {
        format!("{}: a model alone does not know its cameras; name the scene with --scene", args.model.display())
    })?;
    let loaded = work::load_scene(scene, &settings)?;
    // A model on disk has the lengths of the scene's own files.
    model.rescale(1.0 / loaded.unit);
    let cameras = args.views.cameras(&loaded, args.frames);
    if cameras.is_empty() {
        bail!("{}: the scene has no {} views; --views names others", scene.display(), args.views.name());
    }
    let out = args.out.clone().unwrap_or_else(|| args.model.join("renders").join(args.views.name()));
    let _lock = Lock::take(&out)?;
    for (name, _) in &cameras {
        for path in [PICTURE, MAPS].map(|extension| pictures::path(&out, name, extension)) {
            if let (Some(folder), Some(own)) = (path.parent(), path.file_name()) {
                let own = shortened(own);
                folder::sweep(folder, |name| own == name);
            }
        }
    }
    args.device.with_gpu(|gpu| {
        let mut renderer = Renderer::of(gpu, &model, &settings.render)?.larger(larger);
        let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} views, {eta} left")?;
        let bar = ProgressBar::new(cameras.len() as u64).with_style(style);
        for (name, camera) in &cameras {
            let mut view = renderer.render(camera)?;
            view.depth.iter_mut().for_each(|z| *z = (f64::from(*z) * loaded.unit) as f32);
            pictures::write_png(&pictures::path(&out, name, PICTURE), view.size, &view.rgb)?;
            pictures::write_exr(&pictures::path(&out, name, MAPS), view.size, &view.depth, &view.transmittance)?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok(())
    })?;
    println!("{}: {} {} views as .png and .exr", out.display(), cameras.len(), args.views.name());
    let run = matches!(origin, Origin::Run { .. });
    next::say(&match args.views {
        Views::Test if run => [(next::command(&["eval"], &args.model), "measures the model on the test views")],
        Views::Spiral => {
            let digits = cameras.len().saturating_sub(1).to_string().len();
            let frames = out.join(format!("frame_%0{digits}d.png"));
            let frames = next::typed(&frames.to_string_lossy());
            [(format!("ffmpeg -i {frames} -pix_fmt yuv420p film.mp4"), "makes a film of the pictures")]
        }
        _ => [(next::command(&["export"], &args.model), "writes the scene for viewers")],
    });
    Ok(())
}

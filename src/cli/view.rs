//! `gscream-vk view`.

use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, anyhow, bail};

use super::export::{Cameras, EXPORT, FIGURES, PROVENANCE, Pose, STEM};
use super::folders::Origin;
use super::next;
use super::shared;
use crate::export;
use crate::scene::{self, Camera};
use crate::view::server::{self, Secret};
use crate::view::{self, Page, Start};

/// Show an exported scene in the browser
///
/// Serves a page on the loopback address until it is stopped; nothing is fetched from elsewhere. The view starts at a
/// training camera, by default the one that stands most upright, and a slider draws its photograph over the scene. What is guessed
/// can be tinted where the export has its provenance, as those of remove have.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk view runs/garden
  gscream-vk view runs/garden --camera IMG_0012 --port 9000
  gscream-vk view runs/garden --html garden.html")]
pub(super) struct Args {
    /// Run folder that was exported, an export's own folder, or what remove made
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Training view to start at [default: the most upright one]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// Write one page that needs nothing else, and serve nothing
    #[arg(long, value_name = "FILE", conflicts_with_all = ["port", "host"])]
    html: Option<PathBuf>,
    /// Port to serve on; 0 is any free one
    #[arg(long, value_name = "N", default_value_t = 8642)]
    port: u16,
    /// Address to serve on; others than the loopback let other machines in
    #[arg(long, value_name = "ADDRESS", default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    host: IpAddr,
    /// Leave out the photograph
    #[arg(long)]
    no_photograph: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let page = page(args)?;
    if let Some(file) = &args.html {
        let html = page.single().with_context(|| format!("{}: cannot be made", file.display()))?;
        export::write(&[(file.clone(), html.as_bytes())])?;
        println!("{}: {:.1} MB, needs nothing else", file.display(), html.len() as f64 / 1e6);
        next::say(&[(next::typed(&file.to_string_lossy()), "open it in a browser, or send it")]);
        return Ok(());
    }
    let address = SocketAddr::new(args.host, args.port);
    let listener = bind(address, "--port 0")?;
    let secret = Secret::random();
    println!("{} (Ctrl-C ends it)", secret.url(listener.local_addr().unwrap_or(address)));
    server::serve(&listener, &Arc::new(page.resources()), &secret)
        .with_context(|| format!("{address}: cannot be served on"))
}

/// Binds the address; `other` is what asks for a free port.
pub(super) fn bind(address: SocketAddr, other: &str) -> anyhow::Result<TcpListener> {
    server::bind(address).map_err(|error| match error.kind() {
        std::io::ErrorKind::AddrInUse => anyhow!("{address}: another program serves there; {other} takes a free one"),
        _ => anyhow!("{address}: cannot be served on: {error}"),
    })
}

/// The page of an exported run, or of what `remove` has made, as without options.
pub(super) fn page_of(run: &Path) -> anyhow::Result<Page> {
    page(&Args {
        run: run.to_owned(),
        camera: None,
        html: None,
        port: 0,
        host: IpAddr::V4(Ipv4Addr::LOCALHOST),
        no_photograph: false,
    })
}

fn page(args: &Args) -> anyhow::Result<Page> {
    let run = &args.run;
    if run.is_file() {
        bail!(
            "{}: this is a file, and the page needs the cameras beside it: give the folder of a run, of an export or of \
             what `remove` has made",
            run.display()
        );
    }
    if !run.is_dir() {
        bail!("{}: there is no such folder", run.display());
    }
    let folder = if run.join(FIGURES).is_file() { run.clone() } else { run.join(EXPORT) };
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read(&path).with_context(|| {
            format!("{}: cannot be read; `gscream-vk export {}` writes it", path.display(), run.display())
        })
    };
    let ply = read(&format!("{STEM}.ply"))?;
    let figures = folder.join(FIGURES);
    let cameras: Cameras = serde_json::from_slice(&read(FIGURES)?)
        .with_context(|| format!("{}: not the figures of an export", figures.display()))?;
    let pose = match &args.camera {
        Some(name) => cameras.cameras.iter().find(|pose| pose.name == *name).ok_or_else(|| {
            let first = cameras.cameras.first().map_or("none", |pose| &pose.name);
            anyhow!("--camera {name}: no training view has this name; they are called like {first}")
        })?,
        None => most_upright(&cameras.cameras).with_context(|| format!("{}: names no camera", figures.display()))?,
    };
    // What `remove` makes has its run in a folder of its own.
    let origin = Origin::find(run).or_else(|_| Origin::find(&run.join(super::folders::RUN))).ok();
    let photograph = origin.filter(|_| !args.no_photograph).and_then(|origin| {
        let jpeg = photograph(&origin, pose);
        if let Err(error) = &jpeg {
            eprintln!("note: without a photograph: {error:#}");
        }
        jpeg.ok()
    });
    let guessed = cameras.provenance.as_ref().and_then(|_| {
        let guessed = guessed(&folder.join(PROVENANCE));
        if let Err(error) = &guessed {
            eprintln!("note: without a tint of what is guessed: {error:#}");
        }
        guessed.ok()
    });
    let name = std::path::absolute(run).unwrap_or_else(|_| run.clone());
    Ok(Page {
        title: name.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned()),
        ply,
        start: start(pose, &cameras),
        background: cameras.background,
        photograph,
        guessed,
    })
}

/// `[gaussian]` how much of it is guessed, 0 to 255.
fn guessed(path: &Path) -> anyhow::Result<Vec<u8>> {
    let map = scene::npy::read(path)?;
    if map.size[0] != 2 {
        bail!("{}: not as an export left it; `gscream-vk export --provenance` writes it", path.display());
    }
    let shares = map.values.as_chunks::<2>().0.iter();
    Ok(shares
        .map(|[known, guessed]| (255.0 * guessed / (known + guessed).max(f32::MIN_POSITIVE)).round() as u8)
        .collect())
}

/// The camera that is rolled least out of the horizon.
fn most_upright(cameras: &[Pose]) -> Option<&Pose> {
    cameras.iter().min_by(|a, b| a.roll.total_cmp(&b.roll))
}

/// The camera looks along its axis at the point nearest to what all cameras look at.
fn start(pose: &Pose, cameras: &Cameras) -> Start {
    let ahead = pose.rotation[2].map(f64::from);
    let along: f64 = (0..3).map(|i| (cameras.focus[i] - pose.center[i]) * ahead[i]).sum();
    let distance = if along > 0.0 { along } else { 1.0 };
    let target = std::array::from_fn(|i| pose.center[i] + distance * ahead[i]);
    Start { center: pose.center, target, fov: pose.fov, size: pose.size }
}

/// What the photograph shows from the viewer's camera.
fn photograph(origin: &Origin, pose: &Pose) -> anyhow::Result<Vec<u8>> {
    let mut settings = origin.settings(vec![])?;
    let scene = origin.scene().context("a model alone does not know its photographs")?;
    let scene = shared::load_scene_of_model(Path::new(scene), &mut settings)?;
    let view = scene.train.iter().find(|view| view.name == pose.name);
    let view = view.with_context(|| format!("{}: the scene has no such view any more", pose.name))?;
    // Its lens, in the axes of the export.
    let rotation = pose.rotation;
    let camera = Camera { rotation, translation: Camera::translation_to(&rotation, pose.center), ..view.camera };
    let picture = view::resampled(&view.image, &camera, &view::upright(&camera));
    Ok(scene::jpeg(&picture, 92)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::up;

    /// Of cameras that are rolled to either side, as `export` writes them.
    #[test]
    fn the_view_starts_at_the_most_upright_camera() {
        let rolled = |degrees: f32| {
            let (s, c) = degrees.to_radians().sin_cos();
            let camera = Camera {
                rotation: [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]],
                translation: [0.0; 3],
                focal: [50.0; 2],
                principal: [20.0, 15.0],
                distortion: [0.0; 4],
                size: [40, 30],
            };
            assert!((up::roll(&camera).to_degrees() - f64::from(degrees.abs())).abs() < 1e-3);
            Pose::new(&degrees.to_string(), &camera)
        };
        let chosen = |degrees: &[f32]| {
            let poses: Vec<Pose> = degrees.iter().map(|degrees| rolled(*degrees)).collect();
            most_upright(&poses).map(|pose| pose.name.clone())
        };
        assert_eq!(chosen(&[20.0, -3.0, 7.0, -40.0]).as_deref(), Some("-3"));
        assert_eq!(chosen(&[-9.0, 4.0]).as_deref(), Some("4"));
        assert_eq!(chosen(&[]), None);
    }
}

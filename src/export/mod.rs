#![doc = include_str!("README.md")]

pub mod bake;
pub mod draw;
pub mod low_pass;
pub mod measure;
pub mod poses;
pub mod provenance;
pub mod refine;

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use crate::atomic::AtomicWriteFile;
use glam::DMat3;

use crate::config::Settings;
use crate::gpu::Gpu;
use crate::math::harmonics::coefficients;
use crate::model::gaussians::Static;
pub use crate::model::gaussians::{Cloud, logit, sigmoid};
use crate::model::stored::Stored;
use crate::render::config::BACKGROUND;
use crate::render::view::Renderer;
use crate::scene::{Camera, Scene, up};
use crate::signal::Signal;

/// Why an export, or one of its files, cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The device.
    #[error(transparent)]
    Gpu(#[from] crate::gpu::Error),
    /// A file that the system refuses.
    #[error("{}: cannot be written: {source}; nothing of it is left behind", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: io::Error,
    },
    /// A file that is not what its name says.
    #[error("{0}")]
    Format(String),
    /// A scene that cannot be read any more.
    #[error(transparent)]
    Scene(#[from] crate::scene::Error),
    /// A model of which nothing is seen.
    #[error("none of the model's {gaussians} Gaussians is seen from any of {poses} poses: there is nothing to export")]
    Nothing {
        /// Gaussians of the model.
        gaussians: usize,
        /// Poses they were looked at from.
        poses: usize,
    },
    /// Somebody asked for an end.
    #[error("stopped by {signal}; nothing was written")]
    Interrupted {
        /// How.
        signal: Signal,
    },
    /// Pictures that cannot be compared.
    #[error(transparent)]
    Evaluate(#[from] crate::evaluate::Error),
}

/// Writes files that appear complete or not at all: all are on the disk before the first replaces its predecessor.
///
/// # Errors
/// [`Error::Write`].
pub fn write(files: &[(PathBuf, &[u8])]) -> Result<(), Error> {
    let failed = |path: &Path, source| Error::Write { path: path.to_owned(), source };
    let mut whole = vec![];
    for (path, bytes) in files {
        let write = || {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)?;
            }
            let mut file = AtomicWriteFile::open(path)?;
            file.write_all(bytes)?;
            file.sync_all()?;
            Ok(file)
        };
        whole.push(write().map_err(|source| failed(path, source))?);
    }
    for (file, (path, _)) in whole.into_iter().zip(files) {
        file.commit().map_err(|source| failed(path, source))?;
    }
    Ok(())
}

/// What an export is made of besides the model.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Turn the scene so that up is -y in the cloud.
    pub upright: bool,
    /// Highest degree of the harmonics, 0 to 3.
    pub degree: u32,
    /// Poses between training cameras to look from.
    pub views: u32,
    /// Steps of the refinement.
    pub steps: u32,
    /// Longer side of the picture that the scene will be looked at in, pixels: see [`low_pass`].
    pub screen: u32,
    /// Seed of the poses and of their order.
    pub seed: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self { upright: true, degree: 0, views: 48, steps: 1000, screen: 1920, seed: 0 }
    }
}

/// Training cameras looked from at most: a capture of hundreds is seen as well from every second or third.
const TRAIN_VIEWS: usize = 120;
/// Poses to measure at where the scene has no test views.
const HELD_OUT: u32 = 12;
/// Pixels' worth of alpha x transmittance over all poses that a Gaussian must give to be kept.
const SEEN: f32 = 0.05;

/// Is told how far the work is.
pub trait Observer {
    /// A part of the work begins, of so many turns.
    fn begin(&mut self, part: &str, turns: u64);
    /// A turn is done; `note` says something of it, or nothing.
    fn turn(&mut self, note: &str);
    /// The last part has ended.
    fn end(&mut self) {}
    /// Whether to end; asked behind the turns of the longer parts.
    fn interrupted(&mut self) -> Option<Signal> {
        None
    }
}

/// Goes on unless it is time to end.
fn go_on(observer: &mut dyn Observer) -> Result<(), Error> {
    observer.interrupted().map_or(Ok(()), |signal| Err(Error::Interrupted { signal }))
}

/// A finished export, before it is written.
pub struct Export {
    /// The Gaussians, up -y.
    pub cloud: Cloud,
    /// From the scene's axes into the cloud's.
    pub turn: DMat3,
    /// Where losses are measured.
    pub yardstick: measure::Yardstick,
    /// What was measured on the way, in order: the anchors, the baked and the refined Gaussians.
    pub losses: Vec<(String, measure::Loss)>,
    /// Poses looked from: training cameras, poses between them.
    pub poses: [usize; 2],
    /// Gaussians of the model, and those that were baked.
    pub gaussians: [usize; 2],
    /// How many times larger than the training's pictures the scene will be looked at.
    pub larger: f64,
}

/// How many times larger than the training's pictures the scene will be looked at.
fn larger(options: &Options, train: &[Camera]) -> f64 {
    let longest = train.iter().flat_map(|camera| camera.size).max().unwrap_or(1);
    (f64::from(options.screen) / f64::from(longest)).max(1.0)
}

/// Bakes anchors, refines and prunes; plain Gaussians stay as they are, in the cloud's axes. Those thinner than the pixels of
/// the training are widened for larger pictures, see [`low_pass`].
///
/// # Errors
/// When the device has no room, or is lost; a model of which nothing is seen.
pub fn make(
    gpu: &Gpu,
    model: &Stored,
    scene: &Scene,
    settings: &Settings,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Export, Error> {
    let train: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
    let turn = if options.upright { up::upright(&train) } else { DMat3::IDENTITY };
    let turned = |camera: &Camera| up::turn_camera(camera, turn);
    let (larger, held_out) = (larger(options, &train), poses::virtual_views(&train, HELD_OUT, !options.seed));
    let tests = if scene.test.is_empty() { held_out.len() } else { scene.test.len() };
    let rows = model.form().rows();
    observer.begin(&format!("drawing the {rows} to compare with"), tests as u64);
    let mut renderer = Renderer::of(gpu, model, &settings.render)?;
    let yardstick = measure::Yardstick::new(&mut renderer, scene, &held_out, turned, || observer.turn(""))?;
    drop(renderer);
    let mut losses = vec![(rows.to_owned(), yardstick.of_anchors()?)];
    let widened: Vec<Camera> = train.iter().map(turned).collect();
    let model = match model {
        Stored::Anchors(anchors, weights) => (anchors, weights),
        Stored::Gaussians(cloud) => {
            let (mut cloud, gaussians) = (cloud.clone(), [cloud.len(); 2]);
            if options.upright {
                cloud.turn(turn);
            }
            low_pass::widen(&mut cloud, &widened, larger);
            return Ok(Export { cloud, turn, yardstick, losses, poses: [0, 0], gaussians, larger });
        }
    };

    let looked = poses::spread(&train, TRAIN_VIEWS);
    let between = poses::every_other_wide(poses::virtual_views(&train, options.views, options.seed));
    let cameras: Vec<Camera> = looked.iter().chain(&between).copied().collect();
    observer.begin("baking", cameras.len() as u64);
    let mut baker = bake::Baker::new(gpu, model, &settings.render)?;
    let mut views = vec![];
    for camera in &cameras {
        views.push((turned(camera), baker.look(camera)?));
        observer.turn("");
        go_on(observer)?;
    }
    let mut cloud = baker.cloud(SEEN, cameras.len())?;
    let gaussians = [baker.gaussians(), cloud.len()];
    drop(baker);
    cloud.turn(turn);
    let each = coefficients(options.degree);
    cloud.harmonics =
        cloud.harmonics.iter().flat_map(|h| std::iter::once(*h).chain(vec![[0.0; 3]; each - 1])).collect();
    cloud.degree = options.degree;

    let mut drawer = draw::Drawer::new(gpu, Static::upload(gpu, &cloud)?, &settings.render, BACKGROUND)?;
    losses.push(("baked".to_owned(), yardstick.of_drawer(&mut drawer)?));
    observer.begin("refining", options.steps.into());
    let config = refine::Config { steps: options.steps, seed: options.seed, radius: scene.radius.into() };
    refine::run(&mut drawer, &views, &config, |_, loss| {
        observer.turn(&format!("loss {loss:.4}"));
        go_on(observer)
    })?;
    losses.push(("refined".to_owned(), yardstick.of_drawer(&mut drawer)?));

    observer.begin("pruning", views.len() as u64);
    let mut shares = vec![0f32; cloud.len()];
    for (camera, _) in &views {
        shares.iter_mut().zip(drawer.contributions(camera)?).for_each(|(sum, share)| *sum += share);
        observer.turn("");
    }
    cloud = drawer.gaussians.read(gpu)?;
    cloud.retain(&shares.iter().map(|share| *share > SEEN).collect::<Vec<_>>());
    low_pass::widen(&mut cloud, &widened, larger);
    observer.end();
    Ok(Export { cloud, turn, yardstick, losses, poses: [looked.len(), between.len()], gaussians, larger })
}

#[cfg(test)]
pub(crate) mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_pcg::Pcg64;

    use super::*;

    /// Random Gaussians of a scene some units across.
    pub(crate) fn cloud(n: usize, degree: u32) -> Cloud {
        let mut rng = Pcg64::seed_from_u64(n as u64 + u64::from(degree));
        let mut vec3 = |low: f32, high: f32| -> [f32; 3] { std::array::from_fn(|_| rng.random_range(low..high)) };
        let mut cloud = Cloud {
            position: (0..n).map(|_| vec3(-6.0, 6.0)).collect(),
            log_scale: (0..n).map(|_| vec3(-9.0, 1.0)).collect(),
            harmonics: (0..n * coefficients(degree)).map(|_| vec3(-0.9, 0.9)).collect(),
            degree,
            ..Cloud::default()
        };
        for _ in 0..n {
            let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-6);
            cloud.rotation.push(q.map(|v| (v / norm) as f32));
            cloud.logit.push(rng.random_range(-5.0..8.0));
        }
        cloud
    }

    #[test]
    fn retaining_keeps_what_belongs_together() {
        let mut kept = cloud(10, 1);
        let all = kept.clone();
        kept.retain(&(0..10).map(|i| i % 3 == 1).collect::<Vec<_>>());
        assert_eq!(kept.position, [all.position[1], all.position[4], all.position[7]]);
        assert_eq!(kept.harmonics_of(2), all.harmonics_of(7));
        assert_eq!((kept.len(), kept.logit.len(), kept.rotation.len(), kept.log_scale.len()), (3, 3, 3, 3));
    }
}

//! `gscream-vk export`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, bail};
use clap::ValueEnum as _;
use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

use super::folders::Origin;
use super::next;
use super::shared::{self, DeviceArgs};
use crate::config::Source;
use crate::export::provenance::{self, OffPath};
use crate::export::{self, Cloud, Export, Observer, Options, low_pass, measure};
use crate::folder::{self, Lock};
use crate::formats::{gltf, ply, sog, splat, spz};
use crate::gpu::Gpu;
use crate::model::stored::Stored;
use crate::prepare::record;
use crate::render::widen;
use crate::scene::{self, Camera, Scene, path, up};

/// The export's folder within a run folder.
pub(super) const EXPORT: &str = "export";
/// The figures' file within an export's folder.
pub(super) const FIGURES: &str = "export.json";
/// The file of which Gaussians are known and which guessed, within an export's folder.
pub(super) const PROVENANCE: &str = "provenance.npy";
/// Stem of the exported files.
pub(super) const STEM: &str = "scene";

/// Write a trained model as static Gaussians, for viewers: PLY, SPZ, glTF and SOG
///
/// An anchor's Gaussians depend on the direction and the distance they are seen from; a file holds one value each. They
/// are read off from the training cameras and from cameras between them, refined against the anchors' own pictures, and
/// pruned. What that costs is measured on views that took no part, printed, and written to export.json.
///
/// scene.ply is the file of 3D Gaussian Splatting (62 floats), scene.spz Niantic's SPZ (--spz-version), scene.glb glTF with
/// KHR_gaussian_splatting, scene.sog PlayCanvas' SOG of version 2, scene.splat rows of 32 bytes. Up is +y in glTF and -y in
/// the others.
///
/// A model of plain Gaussians (model.form) is neither baked nor refined: it is written as it is.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk export runs/garden
  gscream-vk export runs/garden --formats spz --out garden
  gscream-vk export runs/garden/model --scene garden --up keep --degree 3")]
pub(super) struct Args {
    /// Run folder, or a model's own folder
    #[arg(value_name = "RUN")]
    model: PathBuf,
    /// Folder for the files [default: export in RUN]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Files to write
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ply,spz,glb")]
    formats: Vec<Format>,
    /// Write scene.sog as well
    #[arg(long)]
    sog: bool,
    /// Write provenance.npy as well: which Gaussians photographs show, and which are guessed
    ///
    /// A row for each Gaussian of scene.ply, in its order: float32, its shares in the pixels of the training views that are
    /// known and in those that prepare has guessed. `view` tints by it.
    #[arg(long)]
    provenance: bool,
    /// Version of scene.spz: 3, or 2 for older readers, with coarser rotations
    #[arg(long, value_name = "2|3", default_value = "3", value_parser = spz_version)]
    spz_version: spz::Version,
    /// Which way is up
    #[arg(long, value_enum, default_value_t = Up::Auto)]
    up: Up,
    /// Highest degree of the colours' spherical harmonics
    #[arg(long, value_name = "N", default_value_t = Options::default().degree, value_parser = clap::value_parser!(u32).range(0..=3))]
    degree: u32,
    /// Cameras between training cameras to look from
    #[arg(long, value_name = "N", default_value_t = Options::default().views, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    views: u32,
    /// Steps of the refinement
    #[arg(long, value_name = "N", default_value_t = Options::default().steps)]
    steps: u32,
    /// Longer side of the picture that the scene will be looked at in, pixels
    ///
    /// Gaussians that are thinner than the pixels of the training are widened, or larger pictures would show needles and
    /// holes. 1 leaves them as they are.
    #[arg(long, value_name = "PIXELS", default_value_t = Options::default().screen, value_parser = clap::value_parser!(u32).range(1..))]
    screen: u32,
    /// Scene to take the cameras from, or the word `synthetic` [default: the run's own]
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// TOML file whose settings replace those of the run
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Replace one setting; may be given many times
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    device: DeviceArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// 3D Gaussian Splatting's own
    Ply,
    /// Niantic's, about a tenth of the size
    Spz,
    /// Binary glTF
    Glb,
    /// PlayCanvas' own, a zip of pictures
    Sog,
    /// antimatter15's, 32 bytes a Gaussian, of degree 0
    Splat,
}

fn spz_version(text: &str) -> Result<spz::Version, String> {
    match text {
        "2" => Ok(spz::Version::Two),
        "3" => Ok(spz::Version::Three),
        _ => Err("versions 2 and 3 are written".to_owned()),
    }
}

impl Format {
    /// The formats that are written unless others are asked for.
    const USUAL: [Self; 3] = [Self::Ply, Self::Spz, Self::Glb];

    fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Spz => "spz",
            Self::Glb => "glb",
            Self::Sog => "sog",
            Self::Splat => "splat",
        }
    }

    fn file(self) -> String {
        format!("{STEM}.{}", self.extension())
    }

    fn encode(self, cloud: &Cloud, version: spz::Version) -> Result<Vec<u8>, export::Error> {
        match self {
            Self::Ply => Ok(ply::encode(cloud)),
            Self::Spz => spz::encode(cloud, version),
            Self::Glb => gltf::encode(cloud),
            Self::Sog => sog::encode(cloud),
            Self::Splat => Ok(splat::encode(cloud)),
        }
        .map_err(export::Error::Format)
    }

    fn decode(self, bytes: &[u8]) -> Result<Cloud, export::Error> {
        match self {
            Self::Ply => ply::decode(bytes),
            Self::Spz => spz::decode(bytes),
            Self::Glb => gltf::decode(bytes),
            Self::Sog => sog::decode(bytes),
            Self::Splat => splat::decode(bytes),
        }
        .map_err(export::Error::Format)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Up {
    /// Estimated from the cameras
    Auto,
    /// The scene's axes as they are, taken for y down
    Keep,
}

/// A camera in the cloud's axes, in which up is -y.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Pose {
    /// The training view's name.
    pub name: String,
    /// Its centre.
    pub center: [f64; 3],
    /// Right, down and ahead, world to camera.
    pub rotation: [[f32; 3]; 3],
    /// Field of view across the longer side, degrees.
    pub fov: f64,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Where the axis goes through the picture, in parts of its width and height; the middle if left out.
    #[serde(default)]
    pub principal: Option<[f32; 2]>,
    /// How far it is rolled out of the horizon, in degrees.
    pub roll: f64,
}

impl Pose {
    pub(super) fn new(name: &str, camera: &Camera) -> Self {
        let longer = usize::from(camera.size[1] >= camera.size[0]);
        let half = 0.5 * f64::from(camera.size[longer]) / f64::from(camera.focal[longer]);
        Self {
            name: name.to_owned(),
            center: camera.center(),
            rotation: camera.rotation,
            fov: 2.0 * half.atan().to_degrees(),
            size: camera.size,
            principal: Some(std::array::from_fn(|c| camera.principal[c] / camera.size[c] as f32)),
            roll: up::roll(camera).to_degrees(),
        }
    }
}

/// The background that [`BACKGROUND`](crate::render::config::BACKGROUND) is, for pages.
const BLACK: [f64; 3] = [0.0; 3];

/// What `view` reads of export.json.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Cameras {
    /// Background, 0 to 1.
    pub background: [f64; 3],
    /// What the training cameras look at.
    pub focus: [f64; 3],
    /// The training cameras.
    pub cameras: Vec<Pose>,
    /// Figures of [`PROVENANCE`], where that was written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

impl Cameras {
    /// Those of a scene's train views, in the scene's axes.
    pub(super) fn of(scene: &Scene) -> Self {
        let cameras: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
        let focus = path::focus(&cameras, &[]).unwrap_or_default();
        let cameras = scene.train.iter().map(|view| Pose::new(&view.name, &view.camera)).collect();
        Self { background: BLACK, focus, cameras, provenance: None }
    }
}

#[derive(Serialize)]
struct File {
    name: String,
    bytes: usize,
    /// BLAKE3 of its bytes, as hexadecimal digits.
    hash: String,
    #[serde(flatten)]
    loss: measure::Loss,
}

#[derive(Serialize)]
struct Figures {
    version: &'static str,
    command: String,
    device: String,
    note: &'static str,
    measured_on: String,
    train_views: usize,
    virtual_views: usize,
    steps: u32,
    degree: u32,
    /// Longer side of the picture it is to be looked at in, and how many times larger that is than the training's.
    screen: u32,
    larger: f64,
    up: &'static str,
    /// Rows: a world point p of the scene is `rotation p` in the PLY.
    rotation: [[f64; 3]; 3],
    gaussians_of_the_model: usize,
    gaussians_baked: usize,
    gaussians: usize,
    seconds: f64,
    loss: serde_json::Map<String, serde_json::Value>,
    files: Vec<File>,
    /// Files that were there before, as they were left: of other formats, or replaced by this export.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    before: Vec<Listed>,
    #[serde(flatten)]
    cameras: Cameras,
}

/// Figures of how much of the Gaussians photographs show.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Provenance {
    /// Gaussians that are guessed more than known.
    guessed: usize,
    /// Gaussians that fewer than two training views show.
    unsupported: usize,
    off_path: Vec<OffPath>,
}

const NOTE: &str = "loss: means over the views of measured_on, which took no part in baking and refinement; anchors: \
                    against the anchor model's own pictures, photographs: against the photographs; cameras: right, \
                    down and ahead in the axes of the PLY";

/// A bar for each part of the work.
#[derive(Default)]
pub(super) struct Bars(Option<ProgressBar>);

impl Observer for Bars {
    fn begin(&mut self, part: &str, turns: u64) {
        self.end();
        let style = ProgressStyle::with_template("{prefix} {wide_bar} {pos}/{len}, {eta} left {msg}");
        let bar = ProgressBar::new(turns).with_prefix(part.to_owned());
        self.0 = Some(style.map_or(bar.clone(), |style| bar.with_style(style)));
    }

    fn turn(&mut self, note: &str) {
        if let Some(bar) = &self.0 {
            bar.inc(1);
            bar.set_message(note.to_owned());
        }
    }

    fn end(&mut self) {
        if let Some(bar) = self.0.take() {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Bars {
    /// Work that failed has not ended its bar.
    fn drop(&mut self) {
        self.end();
    }
}

impl Args {
    /// The formats that are asked for.
    fn formats(&self) -> Vec<Format> {
        let mut formats = self.formats.clone();
        if self.sog && !formats.contains(&Format::Sog) {
            formats.push(Format::Sog);
        }
        formats
    }

    /// The export of a run into a folder: all formats, with so many steps and cameras between the training's.
    pub fn of_run(run: &Path, out: &Path, steps: u32, views: u32) -> Self {
        let Options { degree, screen, .. } = Options::default();
        Self {
            model: run.to_owned(),
            out: Some(out.to_owned()),
            formats: Format::USUAL.to_vec(),
            sog: false,
            provenance: true,
            spz_version: spz::Version::default(),
            up: Up::Auto,
            degree,
            views,
            steps,
            screen,
            scene: None,
            config: None,
            set: vec![],
            device: DeviceArgs::default(),
        }
    }
}

/// Names of the files that an export writes unless other formats are asked for.
pub(super) fn files() -> impl Iterator<Item = String> {
    Format::USUAL.iter().map(|format| format.file()).chain([FIGURES.to_owned()])
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let folder = args.out.clone().unwrap_or_else(|| args.model.join(EXPORT));
    if args.formats.is_empty() {
        bail!("--formats: names no format");
    }
    // The files go into the run's own folder, or into one that is theirs.
    let _lock = match Origin::find(&args.model)? {
        Origin::Run { folder, .. } if args.out.is_none() => Lock::take(&folder)?,
        _ => Lock::take(&folder)?,
    };
    export(args, &folder, &mut Bars::default(), |work| args.device.with_gpu(work))?;
    // `view` reads the PLY.
    if args.formats.contains(&Format::Ply) {
        let shown = if args.out.is_some() { &folder } else { &args.model };
        next::say(&[(next::command(&["view"], shown), "shows it in the browser; --html FILE makes a page to send")]);
    } else {
        next::say(&[(next::typed(&folder.to_string_lossy()), "has the files; any viewer of their formats opens them")]);
    }
    Ok(())
}

/// A file as export.json lists it.
#[derive(Serialize, Deserialize)]
struct Listed {
    name: String,
    bytes: u64,
    hash: Option<String>,
}

/// Whether the usual files of an export are in a folder, each as its export left it.
pub(super) fn is_whole(folder: &Path) -> bool {
    let [files, _] = listed(folder);
    Format::USUAL.iter().all(|format| files.iter().any(|own| own.name == format.file() && own.is_there(folder)))
}

/// The files of the last export and those before them.
fn listed(folder: &Path) -> [Vec<Listed>; 2] {
    #[derive(Deserialize)]
    struct Files {
        files: Vec<Listed>,
        #[serde(default)]
        before: Vec<Listed>,
    }
    let text = std::fs::read(folder.join(FIGURES)).unwrap_or_default();
    serde_json::from_slice(&text).map_or_else(|_| [vec![], vec![]], |Files { files, before }| [files, before])
}

impl Listed {
    /// Whether the file is in the folder as it was left.
    fn is_there(&self, folder: &Path) -> bool {
        let path = folder.join(&self.name);
        let size = std::fs::metadata(&path).map(|file| file.len());
        let same = |hash: &String| record::hash(&path).is_ok_and(|found| found == *hash);
        size.is_ok_and(|size| size == self.bytes) && self.hash.as_ref().is_none_or(same)
    }
}

/// The files that exports have left in a folder, as they are there. Refuses to write over others.
fn keep_others(folder: &Path, args: &Args) -> anyhow::Result<Vec<Listed>> {
    let own: Vec<Listed> = listed(folder).into_iter().flatten().filter(|own| own.is_there(folder)).collect();
    let beside = args.provenance.then(|| PROVENANCE.to_owned());
    let mut names = args.formats().into_iter().map(Format::file).chain(beside);
    if let Some(name) = names.find(|name| folder.join(name).exists() && !own.iter().any(|own| own.name == *name)) {
        bail!(
            "{}: is not as an export left it, and would be written over: move it away, or choose another --out",
            folder.join(name).display()
        );
    }
    Ok(own)
}

/// Writes the files into a folder of which the caller holds the lock. `on_gpu` opens the device, or has it.
pub(super) fn export(
    args: &Args,
    folder: &Path,
    observer: &mut dyn Observer,
    on_gpu: impl FnOnce(Box<dyn FnOnce(&Gpu) -> anyhow::Result<()> + '_>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let origin = Origin::find(&args.model)?;
    let file = args.config.iter().cloned().map(Source::File);
    let mut settings = origin.settings(file.chain(args.set.iter().cloned().map(Source::Set)).collect())?;
    let model = Stored::load(&origin.model())?;
    let given = [args.degree, args.views, args.steps];
    let usual = Options::default();
    if matches!(model, Stored::Gaussians(_)) && given != [usual.degree, usual.views, usual.steps] {
        bail!(
            "{}: its model is of plain Gaussians, which are written as they are: leave out --degree, --views and --steps, \
             which belong to baking anchors",
            args.model.display()
        );
    }
    let own = origin.scene().map(Path::new);
    let scene_folder = args.scene.as_deref().or(own).with_context(|| {
        format!("{}: a model alone does not know its cameras; name the scene with --scene", args.model.display())
    })?;
    let scene = shared::load_scene_of_model(scene_folder, &mut settings)?;
    let before = keep_others(folder, args)?;
    let root = scene_folder.is_dir().then_some(scene_folder);
    folder::sweep(folder, |name| {
        [FIGURES, PROVENANCE].contains(&name) || Format::value_variants().iter().any(|own| own.file() == name)
    });
    on_gpu(Box::new(|gpu| {
        let began = Instant::now();
        let options = Options {
            upright: args.up == Up::Auto,
            degree: args.degree,
            views: args.views,
            steps: args.steps,
            screen: args.screen,
            seed: settings.train.seed,
        };
        let mut made = export::make(gpu, &model, &scene, &settings, &options, observer)?;
        // All files are made before the first is written.
        let (mut written, mut drawn) = (vec![], u32::MAX);
        for format in &args.formats() {
            let bytes = format.encode(&made.cloud, args.spz_version)?;
            let read_back = format.decode(&bytes)?;
            let times = low_pass::measured(made.larger);
            let (loss, fits) = made.yardstick.of_cloud(gpu, &read_back, times, &settings.render)?;
            drawn = drawn.min(fits);
            let name = format.file();
            made.losses.push((format!("{name}, {}", size(bytes.len())), loss));
            let hash = blake3::hash(&bytes).to_hex().to_string();
            written.push((File { name, bytes: bytes.len(), hash, loss }, bytes));
        }
        let (files, mut contents): (Vec<File>, Vec<Vec<u8>>) = written.into_iter().unzip();
        let told = args.provenance.then(|| provenance_of(gpu, &made, (&scene, root), &settings.render, observer));
        let mut figures = figures(args, gpu.info().name.clone(), &scene, &made, (files, before), began);
        if let Some((told, file, bytes)) = told.transpose()? {
            figures.cameras.provenance = Some(told);
            figures.files.push(file);
            contents.push(bytes);
        }
        let text = serde_json::to_string_pretty(&figures)? + "\n";
        let named =
            figures.files.iter().zip(&contents).map(|(file, bytes)| (folder.join(&file.name), bytes.as_slice()));
        // What lists the files is there before them: whenever it ends, they are known for those of an export.
        let named: Vec<_> = std::iter::once((folder.join(FIGURES), text.as_bytes())).chain(named).collect();
        export::write(&named)?;
        report(&made, &figures, &args.formats(), drawn);
        let names: Vec<&str> = figures.files.iter().map(|file| file.name.as_str()).collect();
        println!("wrote {}, {FIGURES} in {}", names.join(", "), folder.display());
        Ok(())
    }))
}

/// Provenance of an export: the figures, and the file with its bytes. `root` is the scene's folder.
fn provenance_of(
    gpu: &Gpu,
    made: &Export,
    (scene, root): (&Scene, Option<&Path>),
    render: &crate::render::Config,
    observer: &mut dyn Observer,
) -> anyhow::Result<(Provenance, File, Vec<u8>)> {
    let turned = |camera: &Camera| up::turn_camera(camera, made.turn);
    let told = provenance::Provenance::of(gpu, &made.cloud, (scene, root), turned, render, observer)?;
    observer.end();
    let cameras: Vec<Camera> = scene.train.iter().map(|view| turned(&view.camera)).collect();
    let off_path = told.off_path(gpu, &made.cloud, &cameras, render)?;
    let [guessed, unsupported] = told.counts();
    let bytes = scene::npy::encode(told.shares.as_flattened(), [2, u32::try_from(told.shares.len())?]);
    let hash = blake3::hash(&bytes).to_hex().to_string();
    let file = File { name: PROVENANCE.to_owned(), bytes: bytes.len(), hash, loss: measure::Loss::default() };
    Ok((Provenance { guessed, unsupported, off_path }, file, bytes))
}

fn figures(
    args: &Args,
    device: String,
    scene: &Scene,
    made: &Export,
    (files, before): (Vec<File>, Vec<Listed>),
    began: Instant,
) -> Figures {
    let command: Vec<String> = std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
    let stages = made.losses.iter().take(made.losses.len() - files.len());
    let loss = stages.filter_map(|(name, loss)| Some((name.clone(), serde_json::to_value(loss).ok()?)));
    let cameras: Vec<Camera> = scene.train.iter().map(|view| up::turn_camera(&view.camera, made.turn)).collect();
    // The points are of other axes and only say how far parallel views look, for which the origin does.
    let focus = path::focus(&cameras, &[]).unwrap_or_default();
    let cameras = scene.train.iter().zip(&cameras).map(|(view, camera)| Pose::new(&view.name, camera));
    Figures {
        version: env!("CARGO_PKG_VERSION"),
        command: command.join(" "),
        device,
        note: NOTE,
        measured_on: made.yardstick.what.clone(),
        train_views: made.poses[0],
        virtual_views: made.poses[1],
        steps: args.steps,
        degree: args.degree,
        screen: args.screen,
        larger: made.larger,
        up: if args.up == Up::Auto { "auto" } else { "keep" },
        rotation: made.turn.transpose().to_cols_array_2d(),
        gaussians_of_the_model: made.gaussians[0],
        gaussians_baked: made.gaussians[1],
        gaussians: made.cloud.len(),
        seconds: began.elapsed().as_secs_f64(),
        loss: loss.collect(),
        files,
        before,
        cameras: Cameras { background: BLACK, focus, cameras: cameras.collect(), provenance: None },
    }
}

fn size(bytes: usize) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

fn report(made: &Export, figures: &Figures, formats: &[Format], drawn: u32) {
    println!("{}", measure::table(&made.losses));
    if made.poses == [0, 0] {
        println!("measured on {}; {} Gaussians; {:.0} s", figures.measured_on, figures.gaussians, figures.seconds);
    } else {
        println!(
            "measured on {}; {} Gaussians, of {} baked from {} training and {} virtual cameras; {:.0} s",
            figures.measured_on,
            figures.gaussians,
            figures.gaussians_baked,
            figures.train_views,
            figures.virtual_views,
            figures.seconds
        );
    }
    if widen::variance(made.larger) > 0.0 {
        println!(
            "widened for pictures of {} pixels, {:.1} times the training's size; the files were drawn {drawn} times as large",
            figures.screen, made.larger,
        );
    }
    if let Some(told) = &figures.cameras.provenance {
        println!(
            "{} of {} Gaussians are guessed, {} are shown by fewer than two photographs",
            told.guessed, figures.gaussians, told.unsupported
        );
        for OffPath { degrees, guessed, unsupported } in &told.off_path {
            println!(
                "{degrees:.0} degrees off the cameras' path {:.1} % of the picture are guessed, {:.2} % shown by fewer than two photographs",
                100.0 * guessed,
                100.0 * unsupported
            );
        }
    }
    let cut = spz::beyond_range(&made.cloud);
    if formats.contains(&Format::Spz) && cut > 0 {
        println!("SPZ holds scales between 4.5e-5 and 380 units: {cut} of {} were cut off", 3 * made.cloud.len());
    }
}

#![doc = include_str!("README.md")]

pub mod carry;
pub mod click;
pub mod depth;
pub mod fit;
pub mod graph_cut;
pub mod hole;
pub mod lens;
mod made;
pub mod masks;
mod min_cut;
mod misplaced;
pub mod network;
mod object;
pub mod outline;
pub mod planes;
pub mod poses;
mod program;
pub mod record;
pub mod shadow;
pub mod splats;
pub mod unfold;
pub mod video;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::GrayImage;

use crate::gpu::{self, Gpu};
use crate::multiview::{DepthGrid, Matched};
use crate::scene::{self, PriorKind, Scene};
use crate::sentence::one_line;
use crate::signal::Signal;
use crate::train::checkpoint::Fingerprint;

use fit::Fit;
use hole::repaint::{self, Asked};
use network::Inpainting;
pub use object::{Evidence, Object};
use object::{Wanted, no_such_view};
use poses::Capture;
use record::{Batch, Folder, Inputs};
use splats::Splats;

/// Why a capture cannot become a scene. Each message is one sentence that says what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A file or folder that contradicts itself or the others.
    #[error("{}: {}", path.display(), one_line(what))]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        what: String,
    },
    /// What was asked for cannot be.
    #[error("{0}")]
    Request(String),
    /// The scene's folder.
    #[error(transparent)]
    Folder(#[from] crate::folder::Error),
    /// Photographs, model, masks.
    #[error(transparent)]
    Scene(#[from] scene::Error),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// The fit.
    #[error("the fit to the photographs: {0}")]
    Fit(#[from] crate::train::run::Error),
    /// The fit's files.
    #[error(transparent)]
    Model(#[from] crate::model::files::Error),
    /// Somebody asked for an end.
    #[error("stopped by {signal}; the same command goes on with the step that was under way")]
    Interrupted {
        /// How.
        signal: Signal,
    },
    /// Photographs alone, and no COLMAP.
    #[error(
        "{}: no sparse/ with a COLMAP model, no transforms.json, and the program colmap is not installed to find the cameras \
         with; install it (Debian: apt install colmap), or bring a model",
        folder.display()
    )]
    NoPoses {
        /// The photographs.
        folder: PathBuf,
    },
    /// A video, and no ffmpeg.
    #[error(
        "{}: is no folder, and the program ffmpeg is not installed to take photographs out of a video with; install it (Debian: \
         apt install ffmpeg), or give a folder of photographs",
        video.display()
    )]
    NoFrames {
        /// The video.
        video: PathBuf,
    },
    /// The `colmap` program gave up.
    #[error("colmap {command} failed: {what}")]
    Colmap {
        /// Its command.
        command: String,
        /// The last line it wrote.
        what: String,
    },
}

impl Error {
    /// The signal that ended the preparation, if one did.
    pub fn signal(&self) -> Option<Signal> {
        match self {
            Self::Interrupted { signal } => Some(*signal),
            Self::Fit(error) => error.signal(),
            _ => None,
        }
    }
}

/// The steps, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Step {
    /// Photographs and cameras in the plain layout.
    Poses,
    /// A short plain fit, which the others look at.
    Fit,
    /// The object in every view.
    Masks,
    /// The object's shadow.
    Shadow,
    /// Depth priors.
    Depth,
    /// The reference view without the object.
    Reference,
    /// What was repainted by hand in it, and in all other views.
    Repaint,
}

impl Step {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Poses, Self::Fit, Self::Masks, Self::Shadow, Self::Depth, Self::Reference, Self::Repaint];

    /// Its name in the record and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Poses => "poses",
            Self::Fit => "fit",
            Self::Masks => "masks",
            Self::Shadow => "shadow",
            Self::Depth => "depth",
            Self::Reference => "reference",
            Self::Repaint => "repaint",
        }
    }
}

/// What to make of which photographs.
#[derive(Clone, Debug)]
pub struct Request {
    /// Folder of the photographs.
    pub photographs: PathBuf,
    /// Folder of the scene.
    pub out: PathBuf,
    /// What is to be removed.
    pub objects: Vec<Object>,
    /// Name of the reference view; otherwise the one whose hole is seen best by others.
    pub reference: Option<String>,
    /// What is to be repainted by hand, besides what was before; where nothing else is named, that is done alone.
    pub repaint: repaint::Wish,
    /// The steps to run, whose inputs must be there; all if empty.
    pub only: Vec<Step>,
    /// The fit, where there is one: the step is left out, and nothing is written for it.
    pub ready: Option<Arc<fit::Ready>>,
    /// Steps of the fit.
    pub fit_steps: u32,
    /// The longer side of the pictures that the fit is made with, pixels.
    pub fit_side: u32,
    /// Whether depth priors are made of the fit, NaN where nothing is known; a scene that has its own keeps those alone.
    pub depth: bool,
    /// Whether the model's cameras are judged by what is around the object once there are masks: parts of a model that the object has
    /// folded are turned to where they belong. Otherwise they stay as they are given.
    pub again: bool,
    /// What to do about the object's shadow.
    pub shadow: shadow::Answer,
    /// A network that fills what nobody saw, instead of pieces of what is around it: an ONNX file, see [`network`].
    pub inpaint_model: Option<PathBuf>,
    /// A network whose maps become the depth priors, instead of the fit's own depth: likewise.
    pub depth_model: Option<PathBuf>,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Request {
    /// A request for everything with the default sizes.
    pub fn new(photographs: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self {
            photographs: photographs.into(),
            out: out.into(),
            objects: vec![Object::default()],
            reference: None,
            repaint: repaint::Wish::default(),
            only: vec![],
            ready: None,
            fit_steps: 200,
            fit_side: 256,
            depth: true,
            again: true,
            shadow: shadow::Answer::Remove,
            inpaint_model: None,
            depth_model: None,
            seed: 0,
        }
    }

    fn wants(&self, step: Step) -> bool {
        if self.only.is_empty() { step != Step::Depth || self.depth } else { self.only.contains(&step) }
    }
}

/// Watches a preparation: progress bars.
pub trait Watch {
    /// A step begins, of so many units.
    fn begin(&mut self, _step: Step, _units: u64) {}
    /// So many units of it are done.
    fn at(&mut self, _unit: u64) {}
    /// A step has ended.
    fn end(&mut self) {}
    /// Something worth a line.
    fn say(&mut self, _line: &str) {}
    /// Whether to end; asked before every step and between its units, and while another program is waited for.
    fn interrupted(&mut self) -> Option<Signal> {
        None
    }
    /// Goes on unless it is time to end.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    fn go_on(&mut self) -> Result<(), Error> {
        self.interrupted().map_or(Ok(()), |signal| Err(Error::Interrupted { signal }))
    }
    /// So many units of the step are done: [`Watch::at`] and [`Watch::go_on`].
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    fn turn(&mut self, unit: u64) -> Result<(), Error> {
        self.at(unit);
        self.go_on()
    }
}

/// Watches nothing.
pub struct Silent;
impl Watch for Silent {}

/// Width and height of a picture file.
pub(crate) fn picture_size(path: &Path) -> Result<[u32; 2], Error> {
    Ok(scene::dimensions(path)?)
}

/// Makes a scene of photographs.
///
/// # Errors
/// See [`Error`]. What steps before have written stays.
pub fn prepare(gpu: &Gpu, request: &Request, watch: &mut dyn Watch) -> Result<(), Error> {
    steps(gpu, request, watch).map(drop)
}

/// A scene before anything in it is masked.
pub struct Fitted {
    /// The photographs at the size of the fit.
    pub scene: Scene,
    /// The fit to them.
    pub fit: Fit,
    /// `[view]` depth as it is measured between them.
    pub grids: Vec<DepthGrid>,
}

/// The first two steps of [`prepare`] alone, whatever the request wants, with what they leave in the scene's folder.
///
/// # Errors
/// As [`prepare`].
pub fn fitted(gpu: &Gpu, request: &Request, watch: &mut dyn Watch) -> Result<Fitted, Error> {
    let objects = vec![Object::default()];
    let request = Request { only: vec![Step::Poses, Step::Fit], objects, ..request.clone() };
    let (scene, fit, matched) = steps(gpu, &request, watch)?.expect("a request for the fit makes one");
    let matched = matched.map_or_else(|| Matched::new(gpu, &scene), Ok)?;
    Ok(Fitted { grids: matched.depths(&scene), scene, fit })
}

/// The steps that are wanted; nothing comes back where those are the poses alone.
fn steps(gpu: &Gpu, request: &Request, watch: &mut dyn Watch) -> Result<Option<(Scene, Fit, Option<Matched>)>, Error> {
    let mut capture = poses::find(&request.photographs)?;
    capture.photographs.iter().try_for_each(|(name, path)| has_room(name, path))?;
    // In a scene that is made in its own capture's folder the masks may be the program's; `corrected` tells them apart.
    let own = request.out.join("masks").canonicalize();
    capture.masks.retain(|_, (path, _)| {
        !path.canonicalize().is_ok_and(|path| own.as_ref().is_ok_and(|own| path.starts_with(own)))
    });
    // Mistakes in what the user named are found before anything is written.
    let networks = Networks::open(request)?;
    let named = || request.objects.iter().flat_map(|object| &object.evidence);
    let marked = |name: &str| named().any(|(named, _)| scene::stem(named) == name);
    for (name, path) in capture.photographs.iter().filter(|(name, _)| marked(name)) {
        if scene::is_turned(path)? {
            let [w, h] = picture_size(path)?;
            watch.say(&format!(
                "{name}: its EXIF data turns it where it is shown; cameras, masks, boxes and clicks are of its pixels as they are \
                 stored, {w}x{h}"
            ));
        }
    }
    let mut wanted = Wanted::given(&capture, &request.objects)?;
    let asked = Asked::read(&request.repaint, &capture)?;
    let _lock = crate::folder::Lock::take(&request.out)?;
    let mut folder = Folder::open(&request.out)?;
    folder.sweep();
    wanted.correct(&folder, &capture)?;
    let mut request = request.clone();
    let bare = wanted.objects.is_empty() && request.only.is_empty();
    if bare && asked.is_some() && folder.made(Step::Reference).next().is_some() {
        request.only = vec![Step::Repaint];
    } else if bare {
        return Err(Error::Request(
            "what is to be removed? name one view and its mask, --mask NAME=FILE.png, a box around the object, --box \
             NAME=x0,y0,x1,y1, or a pixel of it, --click NAME=x,y"
                .into(),
        ));
    }
    let request = &request;
    let depth = request.depth;
    let mut preparation =
        Preparation { gpu, request, folder: &mut folder, watch, depth, networks, matched: None, unit: 1.0 };
    if request.wants(Step::Poses) {
        preparation.poses(&capture)?;
    }
    preparation.depth = request.depth && !preparation.has_priors()?;
    if request.only.iter().all(|step| *step == Step::Poses) && !request.only.is_empty() {
        return Ok(None);
    }
    let mut scene = preparation.small()?;
    if scene.train.len() < 3 {
        return Err(Error::Request(format!(
            "{}: {} photographs with a camera are too few; three are the least that can agree on anything",
            request.photographs.display(),
            scene.train.len()
        )));
    }
    if let Some(name) = request.reference.as_ref().filter(|name| !scene.train.iter().any(|v| v.name == **name)) {
        return Err(no_such_view(name, "--reference", scene.train.iter().map(|v| v.name.as_str())));
    }
    if request.only == [Step::Repaint] && preparation.knows_behind() {
        preparation.repaint(&scene, asked)?;
        return Ok(None);
    }
    let mut fit = preparation.fit(&scene)?;
    let mut splats = Splats::new(gpu, &fit.model, &fit.settings.render)?;
    if request.wants(Step::Masks) {
        preparation.masks(&scene, &fit, &mut splats, &wanted)?;
        if request.wants(Step::Poses) && preparation.unfold(&scene)? {
            preparation.matched = None;
            scene = preparation.small()?;
            fit = preparation.fit(&scene)?;
            splats = Splats::new(gpu, &fit.model, &fit.settings.render)?;
            preparation.masks(&scene, &fit, &mut splats, &wanted)?;
        }
    }
    if request.wants(Step::Shadow) {
        let masks = preparation.masks_on_disk(&scene)?;
        preparation.shadow(&scene, &masks)?;
    }
    if request.wants(Step::Depth) {
        let masks = preparation.masks_on_disk(&scene)?;
        preparation.depth(&scene, &mut splats, &masks)?;
    } else if request.only.is_empty() && !request.depth {
        preparation.no_depth()?;
    }
    let repaints = request.wants(Step::Repaint);
    if request.wants(Step::Reference) || repaints && !preparation.knows_behind() {
        let masks = preparation.masks_on_disk(&scene)?;
        preparation.reference(&scene, &masks)?;
    }
    if request.wants(Step::Reference) || repaints {
        preparation.repaint(&scene, asked)?;
    }
    let matched = preparation.matched.take();
    Ok(Some((scene, fit, matched)))
}

/// Refuses a photograph whose name leaves no room for that of its files, of which its prior as the reference has the longest.
fn has_room(name: &str, path: &Path) -> Result<(), Error> {
    let most = crate::atomic::LONGEST_NAME - "_disparity.npy".len();
    let own = name.rsplit('/').next().unwrap_or(name).len();
    if own <= most {
        return Ok(());
    }
    let what = format!(
        "its name has {own} bytes without extension, and what is named after it leaves room for at most {most}; rename it"
    );
    Err(Error::File { path: path.to_owned(), what })
}

/// A preparation under way.
struct Preparation<'a> {
    gpu: &'a Gpu,
    request: &'a Request,
    folder: &'a mut Folder,
    watch: &'a mut dyn Watch,
    /// Whether priors are written.
    depth: bool,
    networks: Networks,
    /// The matched photographs, once they were asked for.
    matched: Option<Matched>,
    /// Lengths are counted in so many of the model's units.
    unit: f64,
}

/// The networks that the user named, and the hashes of their files.
struct Networks {
    inpainting: Option<(Inpainting, String)>,
    depth: Option<(network::Depth, String)>,
}

impl Networks {
    fn open(request: &Request) -> Result<Self, Error> {
        let Request { inpaint_model, depth_model, .. } = request;
        Ok(Self {
            inpainting: inpaint_model
                .as_ref()
                .map(|path| Ok::<_, Error>((Inpainting::open(path)?, record::hash(path)?)))
                .transpose()?,
            depth: depth_model
                .as_ref()
                .map(|path| Ok::<_, Error>((network::Depth::open(path)?, record::hash(path)?)))
                .transpose()?,
        })
    }

    /// What of them counts as input of a step.
    fn inputs(&self, inputs: Inputs, inpainting: bool) -> Inputs {
        let inputs = self.depth.iter().fold(inputs, |inputs, (_, hash)| inputs.with("depth").with(hash));
        let inpainting = self.inpainting.iter().filter(|_| inpainting);
        inpainting.fold(inputs, |inputs, (_, hash)| inputs.with("inpainting").with(hash))
    }
}

impl Preparation<'_> {
    /// Whether a step has nothing to do, which is said.
    fn skips(&mut self, step: Step, inputs: &str) -> Result<bool, Error> {
        self.watch.go_on()?;
        let fresh = self.folder.is_fresh(step.name(), inputs);
        if fresh {
            self.watch.say(&format!("{}: nothing has changed", step.name()));
        }
        Ok(fresh)
    }

    fn write(&mut self, step: Step, inputs: String, batch: Batch) -> Result<(), Error> {
        for note in &batch.notes {
            self.watch.say(&format!("{}: {note}", step.name()));
        }
        let kept = self.folder.write(step.name(), inputs, batch)?;
        if let Some(first) = kept.first() {
            let many = if kept.len() > 1 { format!(" and {} more", kept.len() - 1) } else { String::new() };
            self.watch.say(&format!("{}: {first}{many} not written: the user's own file is there", step.name()));
        }
        Ok(())
    }

    fn poses(&mut self, capture: &Capture) -> Result<(), Error> {
        let mut inputs = capture.inputs()?;
        if !self.request.again {
            inputs.push_str(" as given");
        }
        if self.skips(Step::Poses, &inputs)? {
            return Ok(());
        }
        self.watch.begin(Step::Poses, 1);
        let batch = capture.collect(&self.request.out, self.watch)?;
        self.write(Step::Poses, inputs, batch)?;
        self.watch.end();
        Ok(())
    }

    /// Whether parts of the model, which the object has folded, were turned to where they belong.
    fn unfold(&mut self, scene: &Scene) -> Result<bool, Error> {
        let root = self.folder.root().to_owned();
        let made = || self.folder.made(Step::Poses);
        let done = self.folder.record().steps.get(Step::Poses.name()).is_some_and(|s| s.figures.contains_key(TURNED));
        if !self.request.again || done || self.request.ready.is_some() {
            return Ok(false);
        }
        let model = scene::colmap::read(&root)?;
        if model.tracks.is_empty() {
            return Ok(false);
        }
        let masks = self.masks_on_disk(scene)?;
        let Some(parts) = unfold::parts(&model, &masked(scene, &masks)) else { return Ok(false) };
        let fine = masked(&self.load(unfold::PICTURES, false)?, &masks);
        let turns = unfold::turns(&model, &fine, &parts, self.request.seed);
        let turned: usize = turns.iter().map(|turn| parts.counts[turn.part]).sum();
        let Some(first) = turns.first() else { return Ok(false) };
        if !made().any(|(path, _)| path.starts_with(poses::MODEL)) {
            self.watch.say(&format!(
                "poses: the model is folded, {turned} of its photographs stand on the wrong side of the object; its files are yours and \
                 stay: make the scene in another folder, with --out"
            ));
            return Ok(false);
        }
        let mut batch = Batch::default();
        let kept: Vec<(String, String)> = (made().filter(|(path, _)| !path.starts_with(poses::MODEL)))
            .map(|(path, file)| (path.clone(), file.from.clone()))
            .collect();
        kept.into_iter().for_each(|(path, from)| batch.copy(path.clone(), &root.join(path), from));
        for (name, bytes) in unfold::files(&model, &parts, &turns, fine.unit) {
            batch.bytes(
                format!("{}/{name}", poses::MODEL),
                bytes,
                "the model that was given, its parts turned about the object",
            );
        }
        let turned_by: Vec<String> =
            turns.iter().map(|turn| format!("{} by {:.1} degrees", parts.counts[turn.part], turn.degrees)).collect();
        let [alike, rival, was] = first.alike;
        batch.notes.push(format!(
            "the model is folded: {turned} photographs share nothing with {} others but the object, which looks alike from both sides; they \
             are turned about it ({}), for so what it stands on is one (correlation {alike:.2}; at any other turn {rival:.2} at most, and \
             {was:.2} before; --poses given leaves them)",
            parts.counts[0],
            turned_by.join(", ")
        ));
        let lost: Vec<&str> = (model.images.iter().zip(&parts.of))
            .filter(|(_, part)| part.is_none())
            .map(|(image, _)| scene::stem(&image.name))
            .collect();
        if !lost.is_empty() {
            batch.notes.push(format!("{}: left out, for nothing tells to which side they belong", abridged(&lost)));
        }
        batch.figures.insert(TURNED.into(), turned as f64);
        let inputs = self.folder.record().steps[Step::Poses.name()].inputs.clone();
        self.write(Step::Poses, inputs, batch)?;
        Ok(true)
    }

    /// The scene at the size of the fit, without anything but photographs, cameras and points.
    fn small(&mut self) -> Result<Scene, Error> {
        let mut scene = self.load(self.request.fit_side, false)?;
        // A splat and the cameras that it is seen from have one unit.
        let typical = scene::typical(&scene).filter(|_| self.request.ready.is_none());
        if let Some(length) = typical.filter(|length| !USUAL.contains(length)) {
            self.unit = length / SCALED;
            scene::normalize(&mut scene, self.unit);
        }
        Ok(scene)
    }

    /// The photographs with their cameras, the longer side of the largest at most about `side` pixels, without the object's
    /// shadow where it has been found and that is wanted.
    fn load(&self, side: u32, relight: bool) -> Result<Scene, Error> {
        let images = self.folder.root().join(poses::IMAGES);
        let mut longest = 1;
        for path in scene::pictures(&images)?.values() {
            longest = longest.max(picture_size(path)?.into_iter().max().unwrap_or(1));
        }
        let downscale = ((f64::from(longest) / f64::from(side)).round() as u32).max(1);
        let config = scene::Config {
            downscale,
            masks: false,
            prior_folder: scene::NONE.into(),
            relight,
            ..scene::Config::default()
        };
        let mut scene = scene::load(self.folder.root(), &config)?;
        scene.test.clear();
        scene::normalize(&mut scene, self.unit);
        Ok(scene)
    }

    fn fit(&mut self, scene: &Scene) -> Result<Fit, Error> {
        if let Some(ready) = &self.request.ready {
            return Ok(ready.fit.clone());
        }
        let settings = fit::settings(self.request);
        let fingerprint = serde_json::to_string(&Fingerprint::of(scene)).expect("names and hashes");
        let inputs = Inputs::default().with(fingerprint).with(settings.to_toml()).finish();
        if self.skips(Step::Fit, &inputs)? {
            return Fit::read(self.folder.root(), settings, scene.unit);
        }
        if !self.request.wants(Step::Fit) && self.folder.record().steps.contains_key(Step::Fit.name()) {
            self.watch.say("fit: the photographs or the settings have changed since; the fit is made again");
        }
        self.watch.begin(Step::Fit, u64::from(settings.train.iterations));
        let mut dense = scene.clone();
        dense.dense = self.matched(scene)?.points(scene);
        let (batch, fit) = fit::make(self.gpu, &dense, settings, self.watch)?;
        self.write(Step::Fit, inputs, batch)?;
        self.watch.end();
        Ok(fit)
    }

    /// What of the fit counts as input of a step behind it.
    fn fit_hash(&self) -> String {
        if let Some(ready) = &self.request.ready {
            return ready.made_of.clone();
        }
        self.folder.made(Step::Fit).map(|(_, file)| file.hash.as_str()).collect::<Vec<_>>().join(" ")
    }

    /// Matches the photographs, once.
    fn matched(&mut self, scene: &Scene) -> Result<&Matched, Error> {
        let matched = match self.matched.take() {
            Some(matched) => matched,
            None => Matched::new(self.gpu, scene)?,
        };
        Ok(self.matched.insert(matched))
    }

    /// The masks that the scene has now, by view, as large as the photographs; an error unless all are there.
    fn masks_on_disk(&self, scene: &Scene) -> Result<Vec<GrayImage>, Error> {
        let folder = self.folder.root().join("masks");
        let files = if folder.is_dir() { scene::pictures(&folder)? } else { BTreeMap::new() };
        let read = |view: &scene::View| {
            let path = files.get(&view.name).ok_or_else(|| Error::File {
                path: folder.clone(),
                what: format!("there is no mask of {}; run the step masks first", view.name),
            })?;
            Ok(scene::mask(path, 1)?)
        };
        scene.train.iter().map(read).collect()
    }

    fn inputs_behind_masks(&self, masks: &[GrayImage]) -> Inputs {
        masks.iter().fold(Inputs::default().with(self.fit_hash()), |inputs, mask| inputs.with(mask.as_raw()))
    }

    /// Whether the scene has depth priors that are not of the step depth: the user's, or those that came with the cameras.
    fn has_priors(&self) -> Result<bool, Error> {
        let root = self.folder.root();
        let record = self.folder.record();
        let made = record.steps.get(Step::Depth.name()).map(|step| &step.files);
        for name in PRIORS {
            let folder = root.join(name);
            if !folder.is_dir() {
                continue;
            }
            for path in scene::depth_maps(&folder)?.values() {
                let below = path.strip_prefix(root).ok().and_then(record::key);
                // A step that was cut short has written some of its files, and its record does not have them yet.
                let is_ours = |below: String| {
                    made.is_some_and(|made| made.contains_key(&below)) || record.pending.contains_key(&below)
                };
                if !below.is_some_and(is_ours) {
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// What the priors that were made are.
    fn kind(&self) -> PriorKind {
        let disparity = self.folder.made(Step::Depth).any(|(path, _)| path.starts_with("disparity/"));
        if disparity { PriorKind::Disparity } else { PriorKind::Depth }
    }

    /// Takes away the priors that were made before.
    fn no_depth(&mut self) -> Result<(), Error> {
        if self.folder.record().steps.get(Step::Depth.name()).is_some_and(|step| !step.files.is_empty()) {
            self.write(Step::Depth, String::new(), Batch::default())?;
        }
        Ok(())
    }

    fn shadow(&mut self, scene: &Scene, masks: &[GrayImage]) -> Result<(), Error> {
        let answer = self.request.shadow;
        let inputs = self.inputs_behind_masks(masks).with(shadow::METHOD).with(answer.name());
        let inputs = inputs.with(self.request.seed.to_le_bytes()).finish();
        if self.skips(Step::Shadow, &inputs)? {
            return Ok(());
        }
        let mut batch = Batch::default();
        if answer == shadow::Answer::Keep {
            batch.notes.push("the object's shadow is not looked for (--shadow keep)".into());
            return self.write(Step::Shadow, inputs, batch);
        }
        let fine = self.load(shadow::SIDE, false)?;
        self.watch.begin(Step::Shadow, scene.train.len() as u64 + 1);
        let grids = self.matched(scene)?.depths(&masked(scene, masks));
        let task = shadow::Task { scene, grids: &grids, fine: &fine, masks, seed: self.request.seed };
        batch = shadow::make(&task, self.watch)?;
        self.write(Step::Shadow, inputs, batch)?;
        self.watch.end();
        Ok(())
    }

    fn depth(&mut self, scene: &Scene, splats: &mut Splats, masks: &[GrayImage]) -> Result<(), Error> {
        if !self.depth {
            self.watch.say("depth: the scene has priors of its own, none are made");
            return Ok(());
        }
        let inputs = self.networks.inputs(self.inputs_behind_masks(masks), false).finish();
        if self.skips(Step::Depth, &inputs)? {
            return Ok(());
        }
        self.watch.begin(Step::Depth, 2 * scene.train.len() as u64);
        let batch = match &self.networks.depth {
            Some((network, _)) => {
                let files = scene::pictures(&self.folder.root().join(poses::IMAGES))?;
                depth::by_network(scene, network, &files, self.watch)?
            }
            None => depth::make(scene, splats, masks, self.watch)?,
        };
        self.write(Step::Depth, inputs, batch)?;
        self.watch.end();
        Ok(())
    }

    fn reference(&mut self, scene: &Scene, masks: &[GrayImage]) -> Result<(), Error> {
        let named = self.request.reference.clone().unwrap_or_default();
        let inputs = self
            .inputs_behind_masks(masks)
            .with(hole::METHOD)
            .with(hole::BEHIND)
            .with(named)
            .with([u8::from(self.depth)]);
        let inputs = self.folder.made(Step::Shadow).fold(inputs, |inputs, (_, file)| inputs.with(&file.hash));
        let mut inputs = self.networks.inputs(inputs, true).with(self.request.shadow.name());
        let mut given = BTreeMap::new();
        for (at, view) in scene.train.iter().enumerate() {
            let path = hole::reference_path(&view.name);
            if self.folder.is_users(&path)? {
                let hash = record::hash(&self.folder.root().join(&path))?;
                inputs = inputs.with(&hash);
                given.insert(at, hash);
            }
        }
        let inputs = inputs.finish();
        if self.skips(Step::Reference, &inputs)? {
            return Ok(());
        }
        let mut fine = self.load(hole::SIDE, true)?;
        scene::even_out(&mut fine);
        self.watch.begin(Step::Reference, 2 * scene.train.len() as u64 + 2);
        self.matched(scene)?;
        let task = hole::Task {
            matched: self.matched.as_ref().expect("it was asked for"),
            scene,
            fine: &fine,
            root: self.folder.root(),
            masks,
            given: &given,
            shade: self.request.shadow == shadow::Answer::Remove,
            named: self.request.reference.as_deref(),
            depth: self.depth,
            inpainting: self.networks.inpainting.as_ref().map(|(network, _)| network),
            depth_network: self.networks.depth.as_ref().map(|(network, _)| (network, self.kind())),
            seed: self.request.seed,
        };
        let batch = hole::make(&task, self.watch)?;
        self.write(Step::Reference, inputs, batch)?;
        self.watch.end();
        Ok(())
    }

    /// Whether the depth of what is behind the object was kept.
    fn knows_behind(&self) -> bool {
        self.folder.made(Step::Reference).any(|(path, _)| path.starts_with(hole::BEHIND))
    }

    fn repaint(&mut self, scene: &Scene, asked: Asked) -> Result<(), Error> {
        let (repaints, before) = asked.after(self.folder)?;
        let seed = self.request.seed;
        let inputs = repaint::inputs(self.folder, &repaints, seed);
        let is_new = repaints.is_empty() && !self.folder.record().steps.contains_key(Step::Repaint.name());
        if is_new || !repaint::is_undone(self.folder)? && self.skips(Step::Repaint, &inputs)? {
            return Ok(());
        }
        self.watch.begin(Step::Repaint, scene.train.len() as u64);
        let mut even = scene.clone();
        scene::even_out(&mut even);
        let task = repaint::Task { scene, gains: &even.gains, folder: self.folder, seed };
        let batch = task.make(&repaints, before, self.watch)?;
        self.write(Step::Repaint, inputs, batch)?;
        self.folder.repaint(repaints.into_iter().map(|(recorded, _)| recorded).collect())?;
        self.watch.end();
        Ok(())
    }
}

/// The fit is made in the model's own units where a third of the median depth ([`scene::typical`]) is so many of them, and elsewhere
/// in units of which it is [`SCALED`]. Fits of sparse points differ with it: those of can-half, at 5.0, found nothing at 1.
const USUAL: std::ops::Range<f64> = 0.125..16.0;
/// See [`USUAL`].
const SCALED: f64 = 4.0;

/// Figure of the step poses: photographs whose cameras were turned.
const TURNED: &str = "turned";

/// A scene whose views have these masks.
fn masked(scene: &Scene, masks: &[GrayImage]) -> Scene {
    let mut masked = scene.clone();
    for (view, mask) in masked.train.iter_mut().zip(masks) {
        view.mask = Some(crate::scene::resample::mask(mask, view.camera.size));
    }
    masked
}

/// Folders of depth priors.
const PRIORS: [&str; 2] = ["depth", "disparity"];

/// The first names of a list.
fn abridged(names: &[&str]) -> String {
    match names {
        [] => "nothing".into(),
        [.., _] if names.len() <= 3 => names.join(", "),
        _ => format!("{} and {} more", names[..2].join(", "), names.len() - 2),
    }
}

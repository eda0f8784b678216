//! Checkpoints: everything that a run goes on from, one file each.
//!
//! `RUN/checkpoints/step-NNNNNNNN.safetensors` holds the anchors, the networks, Adam's moments, the growth statistics,
//! the log so far and, in its metadata, the step, the running figures of the log, the capacities of the stages, the
//! settings and hashes of every part of the scene. Neither a random generator nor a view order is in it: both are
//! functions of the seed and the step (see [`super::order`]), and so is every random number drawn on the device.
//!
//! A checkpoint is of the state right behind a step, anchors grown and pruned, before what is written of that step: the
//! model's files, the evaluation and the line of the log are made again from it ([`History::told`] says when they are not
//! to be).
//!
//! Files are written under another name in the same folder, flushed to the disk and renamed, and carry a blake3 hash over
//! their metadata and tensors, so that one is either whole or refused.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use crate::atomic;
use image::GrayImage;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::attend::Attend;
use super::begin::Beginning;
use super::plan::Plan;
use super::run::Progress;
use super::step::Step;
use crate::config::{Settings, without_removed};
use crate::densify::Statistics;
use crate::folder;
use crate::gpu::{self, Buffer, Gpu};
use crate::losses::Term;
use crate::math::attention::WEIGHTS as ATTENTION;
use crate::math::decoder::Layout;
use crate::math::harmonics::coefficients;
use crate::model::arrays::ARRAYS;
use crate::model::files;
use crate::model::gaussians::{self, Cloud};
use crate::model::parameter::{Names, PROJECTIONS, WEIGHTS};
use crate::model::stored::Stored;
use crate::render::forward::Capacity;
use crate::scene::{Camera, Prior, Scene};

/// The checkpoints' folder within a run folder.
pub const FOLDER: &str = "checkpoints";

/// Checkpoints that stay when a new one is written, that one included.
pub const KEPT: usize = 2;

const FORMAT: &str = "gscream-vk checkpoint 1";

// ---------------------------------------------------------------- what is kept

/// The values of an array.
#[derive(Clone, Debug, PartialEq)]
enum Values {
    Float(Vec<f32>),
    Count(Vec<u32>),
}

/// The learnt state on the host: every array that a later step depends on, by the name of its buffer.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// What the stages have room for.
    pub capacity: Capacity,
    /// Side of the anchors' grid, scene units.
    pub voxel: f64,
    /// Gaussians per anchor; 0: the model's rows are plain Gaussians.
    pub offsets: u32,
    /// Anchors or plain Gaussians.
    pub anchors: u32,
    /// As [`Cloud::antialiased`].
    pub antialiased: bool,
    arrays: BTreeMap<String, Values>,
}

/// A value that is not finite.
#[derive(Clone, Debug, PartialEq)]
pub struct Culprit {
    /// The array.
    pub tensor: String,
    /// The element.
    pub index: usize,
    /// Its value.
    pub value: f32,
}

/// A step's arrays of float32 with the length that is in use.
fn floats(step: &Step) -> Vec<(Buffer<f32>, usize)> {
    let Step { learnt, statistics, .. } = step;
    let n = learnt.count() as usize;
    let mut all: Vec<_> = learnt.anchors().iter().map(|anchors| (anchors.position.view(), 3 * n)).collect();
    let rows = learnt.rows().into_iter().map(|parameter| (parameter, n));
    for (parameter, rows) in rows.chain(step.networks().map(|parameter| (parameter, 1))) {
        all.extend(parameter.tensors().map(|tensor| (tensor.view(), rows * parameter.width as usize)));
    }
    if let Some(statistics) = statistics {
        all.push((statistics.gradient.view(), n * learnt.offsets() as usize));
        all.push((statistics.opacity_sum.view(), n));
    }
    all
}

/// A step's arrays of counts, likewise.
fn counts(step: &Step) -> Vec<(Buffer<u32>, usize)> {
    let n = step.learnt.count() as usize;
    let of = |statistics: &Statistics| {
        [(statistics.seen.view(), n * step.learnt.offsets() as usize), (statistics.visits.view(), n)]
    };
    step.statistics.iter().flat_map(of).collect()
}

/// The number that stands for Gaussians per anchor where there are none.
const PLAIN: u32 = 0;

/// Projections of an attention whose time has not come.
const WAITING: &str = "attention_initial";

impl Model {
    /// Reads back a step's model, with nothing in flight.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn of(gpu: &Gpu, step: &Step) -> Result<Self, gpu::Error> {
        let mut arrays = BTreeMap::new();
        for (buffer, len) in floats(step) {
            arrays.insert(buffer.name().to_owned(), Values::Float(gpu.read_range(&buffer, len)?));
        }
        for (buffer, len) in counts(step) {
            arrays.insert(buffer.name().to_owned(), Values::Count(gpu.read_range(&buffer, len)?));
        }
        if let Some(initial) = &step.attention_weights {
            arrays.insert(WAITING.to_owned(), Values::Float(initial.clone()));
        }
        let offsets = step.learnt.anchors().map_or(PLAIN, |anchors| anchors.offsets);
        let (capacity, anchors) = (step.capacity(), step.learnt.count());
        Ok(Self { capacity, voxel: step.voxel, offsets, anchors, antialiased: step.learnt.antialiased(), arrays })
    }

    fn float(&self, name: &str) -> &[f32] {
        match self.arrays.get(name) {
            Some(Values::Float(values)) => values,
            _ => &[],
        }
    }

    /// The first value that is not finite, parameters before moments.
    pub fn not_finite(&self) -> Option<Culprit> {
        let moments = |name: &str| name.ends_with("_first") || name.ends_with("_root");
        let mut names: Vec<&String> = self.arrays.keys().collect();
        names.sort_by_key(|name| moments(name));
        names.into_iter().find_map(|name| {
            let values = self.float(name);
            let index = values.iter().position(|value| !value.is_finite())?;
            Some(Culprit { tensor: name.clone(), index, value: values[index] })
        })
    }

    /// The plain Gaussians, with what is learnt of their harmonics as it is.
    fn cloud(&self) -> Cloud {
        let triples = |name: &str| self.float(name).as_chunks().0.to_vec();
        Cloud {
            position: triples("position"),
            log_scale: triples("log_scale"),
            rotation: self.float("quaternion").as_chunks().0.to_vec(),
            logit: self.float("logit").to_vec(),
            degree: self.degree().unwrap_or(0),
            harmonics: triples("harmonics"),
            antialiased: self.antialiased,
        }
    }

    /// Degree of the plain Gaussians' harmonics; `None` for a length that belongs to none.
    fn degree(&self) -> Option<u32> {
        let floats = self.float("harmonics").len();
        (0..=3).find(|degree| floats == 3 * coefficients(*degree) * self.anchors as usize)
    }

    /// The anchors and their networks.
    fn anchors(&self) -> Stored {
        let mut anchors = files::Anchors { offsets_per_anchor: self.offsets as usize, ..files::Anchors::default() };
        anchors.position = self.float("position").as_chunks().0.to_vec();
        for array in &ARRAYS {
            (array.set)(&mut anchors, self.float(array.names.value).to_vec());
        }
        let attention = [WAITING, PROJECTIONS.value].map(|name| self.float(name)).concat();
        let attention = Some(attention.as_slice()).filter(|weights| !weights.is_empty());
        let weights = files::Weights::from_device(self.offsets as usize, self.float(WEIGHTS.value), attention);
        Stored::Anchors(anchors, weights)
    }

    /// The step that this was read from, stages included.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn restore(&self, gpu: &Gpu, plan: Plan, settings: &Settings) -> Result<Step, gpu::Error> {
        let model = if self.offsets == PLAIN { Stored::Gaussians(self.cloud()) } else { self.anchors() };
        let from = Beginning { model, voxel: self.voxel, rows: self.capacity.anchors };
        let mut step = Step::new(gpu, plan, settings, &from)?;
        step.resize(self.capacity)?;
        if self.arrays.contains_key(PROJECTIONS.value) {
            let (config, seed) = (&settings.model.attention, settings.train.seed);
            let initial = self.float(PROJECTIONS.value);
            step.attend = Some(Attend::new(gpu, config, seed, step.learnt.capacity(), initial)?);
            step.attention_weights = None;
        }
        if self.arrays.contains_key("visits") {
            step.statistics =
                Some(Statistics::new(gpu, step.learnt.capacity(), self.offsets, settings.densify.count_touched)?);
        }
        for (buffer, _) in floats(&step) {
            gpu.write(&buffer, self.float(buffer.name()))?;
        }
        for (buffer, _) in counts(&step) {
            if let Some(Values::Count(values)) = self.arrays.get(buffer.name()) {
                gpu.write(&buffer, values)?;
            }
        }
        Ok(step)
    }

    /// What is wrong with the lengths, if anything is: [`Model::restore`] relies on them.
    fn check(&self) -> Result<(), String> {
        let (n, k) = (self.anchors as usize, self.offsets as usize);
        let mut wanted = vec![];
        let mut parameter = |names: Names, len: usize| wanted.extend(names.kept().map(|name| (name, len)));
        if self.offsets == PLAIN {
            let each = self.degree().map_or(1, coefficients);
            for (names, width) in gaussians::NAMES.into_iter().zip([3, 3, 4, 1, 3 * each]) {
                parameter(names, n * width);
            }
        } else {
            for array in &ARRAYS {
                parameter(array.names, n * (array.width)(self.offsets) as usize);
            }
            parameter(WEIGHTS, Layout { offsets: k }.weights());
            wanted.push(("position", 3 * n));
        }
        let mut parameter = |names: Names, len: usize| wanted.extend(names.kept().map(|name| (name, len)));
        if self.arrays.contains_key(PROJECTIONS.value) {
            parameter(PROJECTIONS, ATTENTION);
        }
        if self.arrays.contains_key(WAITING) {
            wanted.push((WAITING, ATTENTION));
        }
        if self.arrays.contains_key("visits") {
            wanted.extend([("accumulated_gradient", n * k), ("opacity_sum", n)]);
        }
        for (name, len) in wanted {
            if self.float(name).len() != len {
                return Err(format!("its tensor `{name}` has {} values instead of {len}", self.float(name).len()));
            }
        }
        for (name, len) in [("seen", n * k), ("visits", n)] {
            match self.arrays.get(name) {
                Some(Values::Count(values)) if values.len() != len => {
                    return Err(format!("its tensor `{name}` has {} values instead of {len}", values.len()));
                }
                None if self.arrays.contains_key("opacity_sum") => return Err(format!("it has no tensor `{name}`")),
                _ => {}
            }
        }
        match self.not_finite() {
            Some(Culprit { tensor, index, value }) => Err(format!("value {index} of its tensor `{tensor}` is {value}")),
            None => Ok(()),
        }
    }
}

/// PSNR of the last evaluation on the test views, dB.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LastFigures {
    /// Of whole pictures.
    pub psnr: f64,
    /// Inside the masks, if there are any.
    pub masked_psnr: Option<f64>,
}

/// What a run remembers besides the model: what its log and summary go on from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct History {
    /// The last step that has ended, and what it was like; step 0 before the first.
    pub last: Progress,
    /// Whether files, evaluation and log of that step are made already.
    pub told: bool,
    /// Steps since the last line of the log, and the sum of their losses.
    pub since_line: (u32, f64),
    /// Gaussians and pairs of the last steps, at most one round of views.
    pub recent: Vec<(u32, u32)>,
    /// Steps repeated because buffers had to grow.
    pub repeated: u32,
    /// The last evaluation.
    pub figures: Option<LastFigures>,
    /// The log, line by line.
    pub log: String,
}

/// [`History`] and the model's sizes in the metadata. Floats by their bits: a decimal reader may round to a neighbour.
#[derive(Serialize, Deserialize)]
struct Metadata {
    step: u32,
    seconds: u64,
    view: String,
    losses: Vec<u32>,
    counters: [u32; 4],
    told: bool,
    since_line: (u32, u64),
    recent: Vec<(u32, u32)>,
    repeated: u32,
    figures: Option<(u64, Option<u64>)>,
    capacity: [u32; 3],
    voxel: u64,
    offsets: u32,
    anchors: u32,
    #[serde(default)]
    antialiased: bool,
}

impl Metadata {
    fn of(history: &History, model: &Model) -> Self {
        let History { last, told, since_line, recent, repeated, figures, log: _ } = history;
        Self {
            step: last.step,
            seconds: last.seconds.to_bits(),
            view: last.view.clone(),
            losses: last.losses.iter().map(|(_, loss)| loss.to_bits()).collect(),
            counters: [last.anchors, last.visible, last.gaussians, last.pairs],
            told: *told,
            since_line: (since_line.0, since_line.1.to_bits()),
            recent: recent.clone(),
            repeated: *repeated,
            figures: figures.map(|f| (f.psnr.to_bits(), f.masked_psnr.map(f64::to_bits))),
            capacity: [model.capacity.anchors, model.capacity.visible, model.capacity.pairs],
            voxel: model.voxel.to_bits(),
            offsets: model.offsets,
            anchors: model.anchors,
            antialiased: model.antialiased,
        }
    }

    fn history(&self, log: String) -> History {
        let losses: Vec<f32> = self.losses.iter().copied().map(f32::from_bits).collect();
        let [anchors, visible, gaussians, pairs] = self.counters;
        History {
            last: Progress {
                step: self.step,
                seconds: f64::from_bits(self.seconds),
                view: self.view.clone(),
                loss: losses.iter().sum(),
                losses: Term::ALL.iter().map(|term| term.name).zip(losses).collect(),
                anchors,
                visible,
                gaussians,
                pairs,
            },
            told: self.told,
            since_line: (self.since_line.0, f64::from_bits(self.since_line.1)),
            recent: self.recent.clone(),
            repeated: self.repeated,
            figures: self.figures.map(|(psnr, masked)| LastFigures {
                psnr: f64::from_bits(psnr),
                masked_psnr: masked.map(f64::from_bits),
            }),
            log,
        }
    }
}

/// A run at a step.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// What it remembers.
    pub history: History,
    /// What it has learnt.
    pub model: Model,
}

// ---------------------------------------------------------------- whose it is

/// A scene as training sees it: the hash of each part, by name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fingerprint(Vec<(String, String)>);

impl Fingerprint {
    /// Of a scene that was read.
    pub fn of(scene: &Scene) -> Self {
        let hex = |hasher: blake3::Hasher| hasher.finalize().to_hex().to_string();
        let mut parts = vec![];
        let sets = [("train view", &scene.train), ("test view", &scene.test)];
        // The photographs come first: the masks of other views depend on each of them.
        for (set, view) in sets.iter().flat_map(|(set, views)| views.iter().map(move |view| (set, view))) {
            let hash = blake3::hash(view.image.as_raw());
            parts.push((format!("{set} {}", view.name), hash.to_hex().to_string()));
        }
        for (set, views) in sets {
            for view in views {
                let mut hasher = blake3::Hasher::new();
                hash_camera(&mut hasher, &view.camera);
                hash_mask(&mut hasher, view.blend());
                hash_prior(&mut hasher, view.prior.as_ref());
                parts.push((format!("mask, prior or pose of {set} {}", view.name), hex(hasher)));
            }
        }
        for reference in &scene.references {
            let mut hasher = blake3::Hasher::new();
            hasher.update(reference.image.as_raw());
            hash_prior(&mut hasher, reference.prior.as_ref());
            parts.push((format!("reference picture of {}", scene.train[reference.view].name), hex(hasher)));
        }
        for hole in &scene.holes {
            let mut hasher = blake3::Hasher::new();
            hasher.update(hole.image.as_raw());
            if hole.filled != hole.covered {
                hasher.update(hole.filled.as_raw());
            }
            parts.push((format!("filled hole of {}", scene.train[hole.view].name), hex(hasher)));
        }
        let mut hasher = blake3::Hasher::new();
        hasher.update(&scene.radius.to_le_bytes());
        for point in &scene.points {
            hasher.update(bytemuck::cast_slice(&point.position));
        }
        parts.push(("point cloud".to_owned(), hex(hasher)));
        Self(parts)
    }

    /// The first part in which `self`, a checkpoint's, differs from the scene at hand.
    fn difference(&self, scene: &Self) -> Option<String> {
        let find = |parts: &Self, name: &str| parts.0.iter().find(|(n, _)| n == name).map(|(_, hash)| hash.clone());
        // What came or went comes first: the unit is found from all views, so that it changes the others' poses as well.
        let gone = self.0.iter().find(|(name, _)| find(scene, name).is_none());
        let added = || scene.0.iter().find(|(name, _)| find(self, name).is_none());
        let changed = || self.0.iter().find(|(name, hash)| find(scene, name).is_some_and(|other| other != *hash));
        gone.map(|(name, _)| format!("the {name} is not there"))
            .or_else(|| added().map(|(name, _)| format!("the {name} is new")))
            .or_else(|| changed().map(|(name, _)| format!("the {name} is another")))
    }
}

fn hash_camera(hasher: &mut blake3::Hasher, camera: &Camera) {
    let Camera { rotation, translation, focal, principal, distortion, size } = camera;
    hasher.update(bytemuck::cast_slice(rotation));
    hasher.update(bytemuck::cast_slice(translation));
    for floats in [focal.as_slice(), principal, distortion] {
        hasher.update(bytemuck::cast_slice(floats));
    }
    hasher.update(bytemuck::cast_slice(size));
}

fn hash_mask(hasher: &mut blake3::Hasher, mask: Option<&GrayImage>) {
    hasher.update(&[u8::from(mask.is_some())]);
    hasher.update(mask.map_or(&[], |mask| mask.as_raw()));
}

fn hash_prior(hasher: &mut blake3::Hasher, prior: Option<&Prior>) {
    hasher.update(&[prior.map_or(0, |prior| 1 + prior.kind as u8)]);
    hasher.update(prior.map_or(&[], |prior| bytemuck::cast_slice(&prior.values)));
}

/// What a checkpoint must belong to.
#[derive(Clone, Debug)]
pub struct Owner {
    scene: Fingerprint,
    settings: String,
}

impl Owner {
    /// Of runs on this scene under these settings.
    pub fn new(scene: &Scene, settings: &Settings) -> Self {
        Self { scene: Fingerprint::of(scene), settings: settings.to_toml() }
    }
}

/// The first setting in which two TOML texts differ, dotted, with both values.
pub(crate) fn setting_difference(theirs: &str, ours: &str) -> Option<String> {
    fn leaves(table: &toml::Table, prefix: &str, all: &mut BTreeMap<String, String>) {
        for (key, value) in table {
            match value {
                toml::Value::Table(inner) => leaves(inner, &format!("{prefix}{key}."), all),
                _ => drop(all.insert(format!("{prefix}{key}"), value.to_string())),
            }
        }
    }
    let parse = |text: &str| {
        let mut all = BTreeMap::new();
        leaves(&text.parse().unwrap_or_default(), "", &mut all);
        all
    };
    let (theirs, ours) = (parse(theirs), parse(ours));
    // Those are made while a run begins and goes on.
    let made = ["scene.leave_out", "train.corrections"];
    let fixed = theirs.keys().chain(ours.keys()).filter(|key| !made.contains(&key.as_str()));
    let key = fixed.into_iter().find(|key| theirs.get(*key) != ours.get(*key))?;
    let value = |of: &BTreeMap<String, String>, key| of.get(key).cloned().unwrap_or_else(|| "not set".to_owned());
    Some(format!("{key} was {} and is {}", value(&theirs, key), value(&ours, key)))
}

// ---------------------------------------------------------------- on disk

/// A checkpoint that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: the checkpoint cannot be written: {source}", path.display())]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// What the system said.
    pub source: std::io::Error,
}

/// A file that is no checkpoint to go on from, and why.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct Refusal {
    /// The file.
    pub path: PathBuf,
    /// One sentence.
    pub reason: String,
}

/// The file of a step's checkpoint in a run folder.
pub fn path(run: &Path, step: u32) -> PathBuf {
    run.join(FOLDER).join(format!("step-{step:08}.safetensors"))
}

/// The checkpoints of a run folder with their steps, the newest first. A folder without any has none.
pub fn list(run: &Path) -> Vec<(u32, PathBuf)> {
    let entries = std::fs::read_dir(run.join(FOLDER)).into_iter().flatten().flatten();
    let step =
        |path: &Path| path.file_name()?.to_str()?.strip_prefix("step-")?.strip_suffix(".safetensors")?.parse().ok();
    let mut all: Vec<(u32, PathBuf)> = entries.filter_map(|e| Some((step(&e.path())?, e.path()))).collect();
    all.sort_unstable_by(|a, b| b.cmp(a));
    all
}

/// blake3 over the metadata (but for the hash itself) and the tensors, each with its name, type and shape.
fn digest<'a>(
    metadata: &BTreeMap<String, String>,
    tensors: impl Iterator<Item = (&'a str, Dtype, &'a [usize], &'a [u8])>,
) -> String {
    let mut hasher = blake3::Hasher::new();
    let mut update = |bytes: &[u8]| {
        hasher.update(&(bytes.len() as u64).to_le_bytes());
        hasher.update(bytes);
    };
    for (key, value) in metadata.iter().filter(|(key, _)| *key != "digest") {
        update(key.as_bytes());
        update(value.as_bytes());
    }
    for (name, dtype, shape, data) in tensors {
        update(format!("{name} {dtype:?} {shape:?}").as_bytes());
        update(data);
    }
    hasher.finalize().to_hex().to_string()
}

const LOG: &str = "log";

/// Writes the checkpoint of a run folder's `owner`, and removes older ones but for the last. The file appears complete
/// or not at all; without room for it, the others stay.
///
/// # Errors
/// A folder that cannot be written.
pub fn write(run: &Path, owner: &Owner, state: &State) -> Result<PathBuf, WriteError> {
    let step = state.history.last.step;
    let path = path(run, step);
    let failed = |source| WriteError { path: path.clone(), source };
    let mut tensors: BTreeMap<&str, (Dtype, Vec<usize>, &[u8])> = BTreeMap::new();
    for (name, values) in &state.model.arrays {
        let (dtype, len, bytes) = match values {
            Values::Float(values) => (Dtype::F32, values.len(), bytemuck::cast_slice(values)),
            Values::Count(values) => (Dtype::U32, values.len(), bytemuck::cast_slice(values)),
        };
        tensors.insert(name, (dtype, vec![len], bytes));
    }
    let log = state.history.log.as_bytes();
    tensors.insert(LOG, (Dtype::U8, vec![log.len()], log));
    let json = |value: serde_json::Result<String>| value.expect("plain numbers and strings");
    let mut metadata: BTreeMap<String, String> = [
        ("format", FORMAT.to_owned()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("scene", json(serde_json::to_string(&owner.scene))),
        ("settings", owner.settings.clone()),
        ("state", json(serde_json::to_string(&Metadata::of(&state.history, &state.model)))),
    ]
    .into_iter()
    .map(|(key, value)| (key.to_owned(), value))
    .collect();
    let parts = tensors.iter().map(|(name, (dtype, shape, bytes))| (*name, *dtype, shape.as_slice(), *bytes));
    metadata.insert("digest".to_owned(), digest(&metadata, parts));

    let attempt = || -> std::io::Result<()> {
        let views = tensors
            .into_iter()
            .map(|(name, (dtype, shape, bytes))| Ok((name, TensorView::new(dtype, shape, bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(std::io::Error::other)?;
        let metadata: HashMap<String, String> = metadata.into_iter().collect();
        let bytes = safetensors::serialize(views, Some(metadata)).map_err(std::io::Error::other)?;
        atomic::write_below(&path, &bytes)
    };
    attempt().map_err(failed)?;
    // Newer ones are none of this run's: they were refused when it went on, or it would have gone on from them.
    for (_, old) in list(run).into_iter().filter(|(s, _)| *s <= step).skip(KEPT) {
        if let Err(error) = std::fs::remove_file(&old) {
            log::warn!("{}: cannot be removed: {error}", old.display());
        }
    }
    Ok(path)
}

/// Reads a checkpoint of a run of `owner`'s.
///
/// # Errors
/// A file that is cut off, damaged, of another format, scene or settings.
pub fn read(path: &Path, owner: &Owner) -> Result<State, Refusal> {
    let refuse = |reason: String| Refusal { path: path.to_owned(), reason };
    let bytes = std::fs::read(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let damaged = |_| refuse("is cut off or damaged: no whole safetensors file".to_owned());
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(damaged)?;
    let metadata: BTreeMap<String, String> = header.metadata().clone().unwrap_or_default().into_iter().collect();
    let entry = |key: &str| metadata.get(key).map_or("", String::as_str);
    if entry("format") != FORMAT {
        let found = if entry("format").is_empty() { "none at all" } else { entry("format") };
        return Err(refuse(format!("is of another format: {found}, where this program reads `{FORMAT}`")));
    }
    let mut named: Vec<(&str, TensorView<'_>)> = tensors.iter().collect();
    named.sort_unstable_by_key(|(name, _)| *name);
    let parts = named.iter().map(|(name, view)| (*name, view.dtype(), view.shape(), view.data()));
    if digest(&metadata, parts) != entry("digest") {
        return Err(refuse("is damaged: its contents do not have the hash written into it".to_owned()));
    }
    let scene: Fingerprint =
        serde_json::from_str(entry("scene")).map_err(|error| refuse(format!("has no hashes of its scene: {error}")))?;
    if let Some(difference) = scene.difference(&owner.scene) {
        return Err(refuse(format!("is of another scene: {difference}")));
    }
    if let Some(difference) = setting_difference(&without_removed(entry("settings")), &owner.settings) {
        return Err(refuse(format!("is of a run with other settings: {difference}")));
    }
    if entry("version") != env!("CARGO_PKG_VERSION") {
        let (version, own) = (entry("version"), env!("CARGO_PKG_VERSION"));
        log::warn!("{}: written by version {version}; version {own} may not give the same bytes", path.display());
    }
    let stored: Metadata =
        serde_json::from_str(entry("state")).map_err(|error| refuse(format!("has no state to go on from: {error}")))?;
    let mut log = String::new();
    let mut arrays = BTreeMap::new();
    for (name, view) in named {
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => Values::Float(bytemuck::pod_collect_to_vec(data)),
            Dtype::U32 => Values::Count(bytemuck::pod_collect_to_vec(data)),
            _ if name == LOG => {
                log =
                    String::from_utf8(data.to_vec()).map_err(|_| refuse("holds a log that is not text".to_owned()))?;
                continue;
            }
            other => return Err(refuse(format!("its tensor `{name}` is {other:?}"))),
        };
        arrays.insert(name.to_owned(), values);
    }
    let [anchors, visible, pairs] = stored.capacity;
    let model = Model {
        capacity: Capacity { anchors, visible, pairs },
        voxel: f64::from_bits(stored.voxel),
        offsets: stored.offsets,
        anchors: stored.anchors,
        antialiased: stored.antialiased,
        arrays,
    };
    model.check().map_err(refuse)?;
    Ok(State { history: stored.history(log), model })
}

/// What a run folder has to go on from.
#[derive(Debug, Default)]
pub struct Search {
    /// The newest usable checkpoint.
    pub found: Option<(PathBuf, State)>,
    /// The newer ones, and why they are not; all there are where none is usable.
    pub refused: Vec<Refusal>,
}

/// Looks for the newest checkpoint of a run folder that `owner` can go on from.
pub fn latest(run: &Path, owner: &Owner) -> Search {
    let mut search = Search::default();
    for (_, path) in list(run) {
        match read(&path, owner) {
            Ok(state) => {
                search.found = Some((path, state));
                break;
            }
            Err(refusal) => search.refused.push(refusal),
        }
    }
    search
}

/// Removes the checkpoints of a run folder, and the folder if nothing else is in it.
///
/// # Errors
/// A folder that cannot be written.
pub fn clear(run: &Path) -> Result<(), WriteError> {
    for (_, path) in list(run) {
        std::fs::remove_file(&path).map_err(|source| WriteError { path: path.clone(), source })?;
    }
    folder::sweep(&run.join(FOLDER), |name| name.starts_with("step-"));
    // Fails where somebody else's files are: they stay.
    let _ = std::fs::remove_dir(run.join(FOLDER));
    Ok(())
}

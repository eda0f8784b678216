//! What a run will take, before it takes it.
//!
//! Two things are looked up, the rest is rehearsed. A *survey* decodes, projects and counts training views of the
//! untrained model on the device, without drawing them: visible anchors and (Gaussian, tile) pairs. The *rehearsal* then runs
//! the stages' own code from the first step to the last on a device that only keeps the books ([`Gpu::rehearsal`]), so
//! that what it finds is what that code allocates. How many anchors grow is not known before; [`expected_anchors`] says
//! what is assumed.

use std::collections::{BTreeMap, BTreeSet};

use image::{GrayImage, RgbImage};
use serde::Serialize;

use super::begin::Beginning;
use super::photographs;
use super::plan::Plan;
use super::step::{Rates, Step};
use crate::config::Settings;
use crate::densify::config::LEVELS;
use crate::gpu::{self, Gpu, Used};
use crate::model::config::Form;
use crate::model::gaussians::Static;
use crate::model::init;
use crate::model::stored::Stored;
use crate::primitives::limit::{Counter, Limits};
use crate::render::Method;
use crate::render::forward::{Capacity, Forward};
use crate::render::view::Finished;
use crate::representation;
use crate::scene::{Camera, Hole, Notes, Prior, Reference, Scene, View};
use crate::stage;

/// Why there is no forecast.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// The points.
    #[error(transparent)]
    Init(#[from] init::Error),
}

/// The most there is of each in any of the views surveyed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Survey {
    /// Anchors of the untrained model.
    pub anchors: u32,
    /// Of them in view.
    pub visible: u32,
    /// (Gaussian, tile) pairs.
    pub pairs: u32,
}

impl Survey {
    /// Room for that and for what training adds: an eighth of the anchors in view, and six tenths of the pairs, which swell
    /// before the Gaussians find their sizes (by 35, 52 and 54 % within the first 100 steps of fern, SPIn-NeRF's scene 1 and
    /// the built-in scene).
    pub fn capacity(&self) -> Capacity {
        let Self { anchors, visible, pairs } = *self;
        let visible = visible.saturating_add(visible / 8).saturating_add(16).min(anchors.max(1));
        Capacity { anchors, visible, pairs: pairs.saturating_add(pairs / 5 * 3).max(1 << 17) }
    }
}

/// Most cameras that a survey looks through: it comes before the first step, and what they miss the margin of
/// [`Survey::capacity`] covers.
const SURVEYED: usize = 12;

/// Counts what the untrained model shows to these cameras, or where there are many to every n-th.
///
/// # Errors
/// When the device has no room for a forward pass.
pub fn survey<'c>(
    gpu: &Gpu,
    initial: &Beginning,
    settings: &Settings,
    cameras: impl IntoIterator<Item = &'c Camera>,
) -> Result<Survey, gpu::Error> {
    let cameras: Vec<&Camera> = cameras.into_iter().collect();
    let model = Finished::upload(gpu, &initial.model)?;
    let count = model.count();
    let size = cameras.iter().fold([1, 1], |a, c| [a[0].max(c.size[0]), a[1].max(c.size[1])]);
    let method = Method::new(gpu, &settings.render);
    let limits = Limits::new(gpu)?;
    let near = settings.render.near as f32;
    // Pairs are counted whether they fit or not.
    let mut capacity = Capacity { pairs: 1, ..Capacity::guess(count.max(1)) };
    let mut forward = Forward::new(gpu, capacity, model.model(), method, size, settings.render.cull)?;
    let mut most = Survey { anchors: count, visible: 0, pairs: 0 };
    let every = cameras.len().div_ceil(SURVEYED).max(1);
    for camera in cameras.into_iter().step_by(every) {
        loop {
            let mut rec = gpu.recorder()?;
            limits.lower(&mut rec);
            forward.record(&mut rec, model.model(), camera, near, &limits);
            rec.submit()?.wait()?;
            let counters = gpu.read(limits.counters())?;
            let [visible, pairs] = [Counter::Visible, Counter::Pairs].map(|c| counters[c as usize]);
            if visible <= model.in_view(capacity) {
                most = Survey { visible: most.visible.max(visible), pairs: most.pairs.max(pairs), ..most };
                break;
            }
            drop(forward);
            capacity.visible = visible.saturating_add(visible / 2).min(count.max(1));
            forward = Forward::new(gpu, capacity, model.model(), method, size, settings.render.cull)?;
        }
    }
    Ok(most)
}

/// The anchors there will be at the end of training, an estimate.
///
/// New anchors fill up the surfaces around the first ones: a cell of the coarsest growth grid that a surface passes through
/// has `(cells of the finest grid along its side)^2` places for them, of which a thirtieth is filled in the long run, half of
/// that within the first eight rounds: `N + M c^2 / 30 * r / (r + 8)` for N anchors in M such cells after r rounds. The two
/// numbers come from three scenes (the built-in one, fern and SPIn-NeRF's scene 1 at a quarter of its size), whose growth
/// the formula meets within 16 % of all anchors; other scenes may differ by more. Before dense starts it was a fifth:
/// surfaces that begin full have less to fill. `densify.max_anchors` and the device's
/// largest binding limit it. Plain Gaussians grow by the same share in each round, up to `densify.max_gaussians`.
pub fn expected_anchors(gpu: &Gpu, plan: &Plan, settings: &Settings, initial: &Beginning) -> u32 {
    let count = initial.count();
    let Some(rounds) = plan.rounds else { return count };
    let config = &settings.densify;
    let number = (rounds.last - rounds.first) / config.every + 1;
    let Stored::Anchors(anchors, _) = &initial.model else {
        let grown = f64::from(count) * (1.0 + crate::densify::split::GROWTH).powi(number.min(10_000) as i32);
        let most = config.max_gaussians.min(Static::most(gpu, settings.model.degree));
        return grown.min(most.max(count).into()) as u32;
    };
    let side = initial.voxel * config.coarsest_cell;
    let cells: BTreeSet<[i64; 3]> =
        anchors.position.iter().map(|p| p.map(|x| (f64::from(x) / side).round_ties_even() as i64)).collect();
    let rounds = f64::from(number);
    let per_cell = 16f64.powi(LEVELS as i32 - 1) / 30.0;
    let grown = cells.len() as f64 * per_cell * rounds / (rounds + 8.0);
    (f64::from(count) + grown).min(f64::from(most_anchors(gpu, settings, count))) as u32
}

/// The most anchors that growing makes.
fn most_anchors(gpu: &Gpu, settings: &Settings, count: u32) -> u32 {
    let most = representation::most_anchors(gpu, settings.model.offsets);
    let most = if settings.densify.max_anchors == 0 { most } else { most.min(settings.densify.max_anchors) };
    most.max(count)
}

/// Device memory at a point of the run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moment {
    /// What happens there.
    pub what: String,
    /// Behind, or at, this step.
    pub step: u32,
    /// Anchors.
    pub anchors: u32,
    /// Bytes of buffers.
    pub bytes: u64,
    /// The most bytes there were so far.
    pub peak: u64,
}

/// A run as rehearsed.
#[derive(Clone, Debug)]
pub struct Forecast {
    /// What there is to stand on.
    pub survey: Survey,
    /// Room to start with.
    pub capacity: Capacity,
    /// The form of the model.
    pub form: Form,
    /// Anchors or plain Gaussians at the end, as assumed.
    pub anchors: u32,
    /// Bytes with the first step's stages.
    pub start: u64,
    /// The most bytes of buffers at any time.
    pub peak: u64,
    /// Where memory rises.
    pub moments: Vec<Moment>,
    /// What each stage uses in the course of the run.
    pub used: BTreeMap<&'static str, Used>,
    /// The kernels that are compiled.
    pub pipelines: Vec<&'static str>,
}

impl Forecast {
    /// Bytes that the device has to have free: buffers, and the allocator's blocks around them.
    pub fn needs(&self) -> u64 {
        self.peak + gpu::device::SPARE_BYTES
    }
}

/// One view of each kind: whether it is the reference view, has a mask, and has a prior; and one of each size.
fn kinds(scene: &Scene) -> Vec<usize> {
    let mut seen = BTreeSet::new();
    let kind = |i: usize, view: &View| {
        let reference = scene.reference_of(i);
        let prior = reference.map_or(view.prior.is_some(), |r| r.prior.is_some());
        let masked = view.mask.as_ref().is_some_and(|m| m.as_raw().iter().any(|&v| v != 0));
        (reference.is_some(), masked, prior, view.camera.size)
    };
    scene.train.iter().enumerate().filter(|(i, view)| seen.insert(kind(*i, view))).map(|(i, _)| i).collect()
}

/// Rehearses a run that starts with this model and ends with so many anchors. `also` is a step to record for all kinds of
/// views besides those at which something begins.
///
/// # Errors
/// [`gpu::Error::TooLarge`] when one buffer is beyond what the device binds.
pub fn rehearse(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    initial: &Beginning,
    survey: Survey,
    anchors: u32,
    also: Option<u32>,
) -> Result<Forecast, Error> {
    let gpu = gpu.rehearsal();
    let plan = Plan::new(scene, settings);
    let coarse = settings.train.coarse;
    let mut photographs = photographs::upload(&gpu, scene, &plan, coarse.reduction(1))?;
    let mut step = Step::new(&gpu, plan.clone(), settings, initial)?;
    let capacity = survey.capacity();
    step.resize(capacity)?;
    let start = gpu.memory().0;
    let mut moments = vec![];
    let mut note = |what: &str, at: u32, anchors: u32| {
        let (bytes, peak) = gpu.memory();
        moments.push(Moment { what: what.to_owned(), step: at, anchors, bytes, peak });
    };
    note("the first step", 1, step.learnt.count());

    let iterations = plan.iterations;
    let counted = plan.counted;
    let attention = plan.steps(stage::ATTENTION, settings).map(|s| s.first);
    let after = plan.rounds.map(|r| r.last + 1);
    let evaluations = plan.steps(stage::EVALUATION, settings).map(|s| s.first);
    let mut at: BTreeSet<u32> = [1, iterations].into_iter().chain(also).collect();
    at.extend(counted.map(|c| c.first).into_iter().chain(attention).chain(after).chain(evaluations));
    let every = settings.densify.every as usize;
    let mut rounds: Vec<u32> = plan.rounds.map_or(vec![], |r| (r.first..=r.last).step_by(every).collect());
    if counted.is_none() {
        // All rounds are alike, and the room of the last is there from the first step on.
        rounds.drain(..rounds.len().saturating_sub(1));
    }
    at.extend(&rounds);
    at.extend((coarse.until > 0).then_some(coarse.until + 1));
    at.retain(|&s| s <= iterations || Some(s) == also);
    let kinds = kinds(scene);
    let grown = f64::from(anchors.saturating_sub(survey.anchors));
    let share = |r: usize| r as f64 / (r as f64 + 8.0);
    for number in at {
        let reduction = coarse.reduction(number);
        if photographs.first().is_some_and(|p| p.reduction != reduction) {
            photographs.clear();
            step.resize_pictures(Plan::reduced_sizes(scene, reduction))?;
            photographs = photographs::upload(&gpu, scene, &plan, reduction)?;
            note("pictures of the full size", number, step.learnt.count());
        }
        step.prepare(number)?;
        let kept = !rounds.contains(&number) || Some(number) == also;
        if kept {
            for &view in &kinds {
                let mut rec = gpu.recorder()?;
                let rates = Rates::at(settings, f64::from(scene.radius), number);
                step.record(&mut rec, &photographs[view], number, rates);
                rec.submit()?.wait()?;
            }
        }
        if Some(number) == counted.map(|c| c.first) {
            note("statistics begin", number, step.learnt.count());
        }
        if Some(number) == attention {
            note("attention begins", number, step.learnt.count());
        }
        if counted.is_none() {
            if rounds.last() == Some(&number) && number <= iterations {
                step.learnt.swell(anchors);
                step.resize(step.capacity())?;
                note("the last round of growing", number, step.learnt.count());
            }
        } else if step.changes_anchors(number) && number <= iterations {
            let round = rounds.partition_point(|&r| r <= number);
            let target = f64::from(survey.anchors) + grown * share(round) / share(rounds.len());
            let more = (target as u32).saturating_sub(step.learnt.count()).div_ceil(LEVELS);
            let room = most_anchors(&gpu, settings, survey.anchors);
            // A level has a candidate for every Gaussian at most, and no more free cells than candidates.
            let candidates = more.saturating_mul(4).min(step.learnt.count().saturating_mul(settings.model.offsets));
            let free = more.min(candidates);
            let kept = (step.learnt.count() + free * LEVELS).min(room.max(step.learnt.count()));
            for (buffer, word) in [("candidate_count", candidates), ("free_count", free), ("kept_count", kept)] {
                gpu.answer(buffer, word);
            }
            step.change_anchors(number)?;
            if number == rounds[rounds.len() - 1] {
                note("the last round of growing", number, step.learnt.count());
            }
        }
        if Some(number) == after && counted.is_some() {
            note("statistics have ended", number, step.learnt.count());
        }
        if Some(number) == evaluations || (plan.evaluation && number == iterations) {
            let mut sizes = BTreeSet::new();
            let cameras = scene.test.iter().map(|v| &v.camera).filter(|c| sizes.insert(c.size));
            step.draw(cameras, |_, _| Ok::<_, gpu::Error>(()))?;
            note("test views", number, step.learnt.count());
        }
    }
    step.stored()?;
    note("the model is saved", iterations, step.learnt.count());
    let (used, pipelines, peak) = (gpu.used(), gpu.pipelines(), gpu.memory().1);
    let anchors = step.learnt.count();
    Ok(Forecast { survey, capacity, form: settings.model.form, anchors, start, peak, moments, used, pipelines })
}

/// A change of settings under which a run would fit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Remedy {
    /// As typed.
    pub change: String,
    /// Bytes that it needs then.
    pub needs: u64,
}

/// A run's memory against a device's.
#[derive(Clone, Debug)]
pub struct Verdict {
    /// Bytes there are.
    pub available: u64,
    /// The run, or the one buffer that the device cannot bind.
    pub forecast: Result<Forecast, String>,
    /// What would fit; empty for a run that does.
    pub remedies: Vec<Remedy>,
}

impl Verdict {
    /// True if the whole run fits, growth included.
    pub fn fits(&self) -> bool {
        self.forecast.as_ref().is_ok_and(|f| f.needs() <= self.available)
    }

    /// True if training can begin.
    pub fn starts(&self) -> bool {
        self.forecast.as_ref().is_ok_and(|f| f.start + gpu::device::SPARE_BYTES <= self.available)
    }

    /// One sentence for a run that does not fit.
    pub fn describe(&self) -> Option<String> {
        if self.fits() {
            return None;
        }
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let remedies: Vec<_> = self.remedies.iter().map(|r| format!("{} ({} MiB)", r.change, mib(r.needs))).collect();
        let remedies = match remedies.as_slice() {
            [] => "no smaller picture and no coarser grid was found that does".to_owned(),
            all => format!("what fits: {}", all.join(", or ")),
        };
        Some(match &self.forecast {
            Ok(f) => format!(
                "this run needs about {} MiB of device memory ({} MiB at its start, the rest with {} {} at its end), \
                 and {} MiB are free; {remedies}",
                mib(f.needs()),
                mib(f.start + gpu::device::SPARE_BYTES),
                f.anchors,
                f.form.rows(),
                mib(self.available)
            ),
            Err(buffer) => format!("{buffer}; {remedies}"),
        })
    }
}

/// The scene at another size of its pictures, which are blank: for rehearsals.
fn resized(scene: &Scene, from: u32, to: u32) -> Scene {
    let scaled = |size: [u32; 2]| size.map(|n| (u64::from(n) * u64::from(from)).div_ceil(to.into()).max(1) as u32);
    let blank = |prior: &Prior, [w, h]: [u32; 2]| Prior { kind: prior.kind, values: vec![0.0; (w * h) as usize] };
    let view = |view: &View| {
        let size @ [w, h] = scaled(view.camera.size);
        let masked = view.mask.as_ref().is_some_and(|m| m.as_raw().iter().any(|&v| v != 0));
        let fill = image::Luma([if masked { 255 } else { 0 }]);
        View {
            name: view.name.clone(),
            camera: view.camera.scaled(size),
            image: RgbImage::new(w, h),
            mask: view.mask.as_ref().map(|_| GrayImage::from_pixel(w, h, fill)),
            weight: None,
            prior: view.prior.as_ref().map(|p| blank(p, size)),
            depth: None,
        }
    };
    let references = scene.references.iter().map(|r| {
        let size @ [w, h] = scaled([r.image.width(), r.image.height()]);
        let prior = r.prior.as_ref().map(|p| blank(p, size));
        Reference { view: r.view, image: RgbImage::new(w, h), prior, truth: r.truth }
    });
    let holes = scene.holes.iter().map(|hole| {
        let [w, h] = scaled([hole.image.width(), hole.image.height()]);
        let blank = GrayImage::new(w, h);
        Hole { view: hole.view, image: RgbImage::new(w, h), covered: blank.clone(), filled: blank, depth: None }
    });
    Scene {
        train: scene.train.iter().map(view).collect(),
        test: scene.test.iter().map(view).collect(),
        references: references.collect(),
        holes: holes.collect(),
        points: scene.points.clone(),
        dense: scene.dense.clone(),
        gains: scene.gains.clone(),
        relit: scene.relit,
        radius: scene.radius,
        unit: scene.unit,
        notes: Notes::default(),
    }
}

/// What is asked of [`forecast`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Question {
    /// Anchors at the end, instead of [`expected_anchors`].
    pub anchors: Option<u32>,
    /// Bytes of device memory to plan for, instead of those free now.
    pub available: Option<u64>,
    /// A step to record besides those at which something begins.
    pub also: Option<u32>,
}

/// At most so many views are surveyed for each change of settings that might fit.
const VIEWS: usize = 8;

/// Surveys and rehearses a run, and looks for what would fit if it does not.
///
/// # Errors
/// Points that make no anchor; a device that is lost.
pub fn forecast(gpu: &Gpu, scene: &Scene, settings: &Settings, question: Question) -> Result<Verdict, Error> {
    let available = question.available.unwrap_or_else(|| gpu.available_bytes());
    let settings = &settings.fitted(scene);
    let start = Start::of(gpu, scene, settings, Beginning::of(scene, settings)?, 1)?;
    let anchors = question.anchors.unwrap_or_else(|| start.expected(gpu, scene, settings));
    let forecast = start.rehearse(gpu, scene, settings, anchors, question.also)?;
    let mut verdict = Verdict { available, forecast, remedies: vec![] };
    if !verdict.fits() {
        verdict.remedies = remedies(gpu, scene, settings, question, available)?;
    }
    Ok(verdict)
}

/// What a run starts from, looked up once for several rehearsals.
struct Start {
    initial: Beginning,
    counts: Survey,
}

impl Start {
    /// Start with a [`survey`] of every so many views; where the device has no room for that either, or no memory at all, as
    /// if all rows were in view.
    fn of(gpu: &Gpu, scene: &Scene, settings: &Settings, initial: Beginning, every: usize) -> Result<Self, Error> {
        let mut counts = match survey(gpu, &initial, settings, scene.train.iter().step_by(every).map(|v| &v.camera)) {
            Err(gpu::Error::TooLarge { .. } | gpu::Error::OutOfMemory { .. } | gpu::Error::Missing { .. }) => {
                let (anchors, each) = (initial.count(), initial.model.weights().map_or(1, |_| settings.model.offsets));
                Survey { anchors, visible: anchors, pairs: anchors.saturating_mul(each) }
            }
            other => other?,
        };
        if every > 1 {
            // Not all views were looked at.
            counts.visible = counts.visible.saturating_add(counts.visible / 10).min(counts.anchors);
            counts.pairs = counts.pairs.saturating_add(counts.pairs / 5);
        }
        Ok(Self { initial, counts })
    }

    fn expected(&self, gpu: &Gpu, scene: &Scene, settings: &Settings) -> u32 {
        expected_anchors(gpu, &Plan::new(scene, settings), settings, &self.initial)
    }

    /// The run with so many anchors at its end, or the one buffer that the device cannot bind.
    fn rehearse(
        &self,
        gpu: &Gpu,
        scene: &Scene,
        settings: &Settings,
        anchors: u32,
        also: Option<u32>,
    ) -> Result<Result<Forecast, String>, Error> {
        match rehearse(gpu, scene, settings, &self.initial, self.counts, anchors, also) {
            Ok(forecast) => Ok(Ok(forecast)),
            Err(Error::Gpu(error @ gpu::Error::TooLarge { .. })) => Ok(Err(error.to_string())),
            Err(error) => Err(error),
        }
    }
}

/// Settings under which a run fits the device.
#[derive(Clone, Debug)]
pub struct Fitting {
    /// Those asked for, or with fewer anchors.
    pub settings: Settings,
    /// What they come to; where nothing fits, that of the settings asked for.
    pub verdict: Verdict,
    /// One sentence on what was reduced.
    pub reduced: Option<String>,
}

/// By how much the initial grid is made coarser, one after the other, until the first anchors fit.
const COARSER: [f64; 10] = [1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0];

/// The setting of the initial grid, and its value and the settings where the grid is coarser.
fn coarser(settings: &Settings, factor: f64) -> (&'static str, f64, Settings) {
    let mut settings = settings.clone();
    let model = &mut settings.model;
    let (key, grid) = if model.voxel > 0.0 {
        ("model.voxel", &mut model.voxel)
    } else {
        ("model.voxel_factor", &mut model.voxel_factor)
    };
    *grid *= factor;
    (key, *grid, settings)
}

/// Shares of the expected growth that are tried, the most first.
const GROWTH_SHARES: [f64; 6] = [1.0, 0.75, 0.5, 0.25, 0.1, 0.0];

/// The settings, with no more anchors than the device has room for over the whole run: less growth first, then a coarser
/// grid. `available` is what there is to plan for, instead of the bytes free now.
///
/// # Errors
/// As [`forecast`].
pub fn fitting(gpu: &Gpu, scene: &Scene, asked: &Settings, available: Option<u64>) -> Result<Fitting, Error> {
    let available = available.unwrap_or_else(|| gpu.available_bytes());
    let fewer = if asked.model.form == Form::Gaussians { fewer_gaussians } else { fewer_anchors };
    if let Some(fitting) = fewer(gpu, scene, asked, available)? {
        return Ok(fitting);
    }
    let verdict = forecast(gpu, scene, asked, Question { available: Some(available), ..Question::default() })?;
    Ok(Fitting { settings: asked.clone(), verdict, reduced: None })
}

/// The settings of anchors under which they fit, if any do: less growth first, then a coarser grid.
fn fewer_anchors(gpu: &Gpu, scene: &Scene, asked: &Settings, available: u64) -> Result<Option<Fitting>, Error> {
    let most = representation::most_anchors(gpu, asked.model.offsets);
    for factor in COARSER {
        let (key, grid, mut settings) = coarser(asked, factor);
        let fitted = settings.fitted(scene);
        let initial = Beginning::of(scene, &fitted)?;
        let count = initial.count();
        if count > most {
            continue;
        }
        let start = Start::of(gpu, scene, &fitted, initial, 1)?;
        let expected = start.expected(gpu, scene, &fitted);
        for share in GROWTH_SHARES {
            let anchors = count + (f64::from(expected.saturating_sub(count)) * share) as u32;
            if share < 1.0 {
                settings.densify.max_anchors = anchors;
            }
            let forecast = start.rehearse(gpu, scene, &settings.fitted(scene), anchors, None)?;
            let verdict = Verdict { available, forecast, remedies: vec![] };
            if verdict.fits() {
                let what = if factor > 1.0 {
                    Some(format!("the first anchors stand on a grid {factor} times coarser ({key}={grid})"))
                } else {
                    (share < 1.0).then(|| "growing stops earlier".to_owned())
                };
                let reduced = what.map(|what| {
                    format!("{what}, at {anchors} anchors at most (densify.max_anchors), which is what the device has room for")
                });
                return Ok(Some(Fitting { settings, verdict, reduced }));
            }
            if expected <= count {
                break;
            }
        }
    }
    Ok(None)
}

/// The settings of plain Gaussians under which they fit, if any do: fewer of them.
fn fewer_gaussians(gpu: &Gpu, scene: &Scene, asked: &Settings, available: u64) -> Result<Option<Fitting>, Error> {
    let most = asked.densify.max_gaussians.min(Static::most(gpu, asked.model.degree));
    for share in GAUSSIANS {
        let mut settings = asked.clone();
        settings.densify.max_gaussians = (f64::from(most) * share).ceil() as u32;
        let verdict = forecast(gpu, scene, &settings, Question { available: Some(available), ..Question::default() })?;
        if verdict.fits() {
            let fewer = settings.densify.max_gaussians;
            let reduced = (fewer < asked.densify.max_gaussians).then(|| {
                format!(
                    "there are {fewer} Gaussians at most (densify.max_gaussians), which is what the device has room for"
                )
            });
            return Ok(Some(Fitting { settings, verdict, reduced }));
        }
    }
    Ok(None)
}

/// Shares of the Gaussians asked for that are tried, the most first.
const GAUSSIANS: [f64; 6] = [1.0, 0.75, 0.5, 0.25, 0.1, 0.03];

fn remedies(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    question: Question,
    available: u64,
) -> Result<Vec<Remedy>, Error> {
    let every = scene.train.len().div_ceil(VIEWS);
    // Bytes that a run of these settings needs, if they are as many as there are or fewer.
    let needs = |scene: &Scene, settings: &Settings| -> Result<Option<u64>, Error> {
        let start = Start::of(gpu, scene, settings, Beginning::of(scene, settings)?, every)?;
        let anchors = question.anchors.unwrap_or_else(|| start.expected(gpu, scene, settings));
        let forecast = start.rehearse(gpu, scene, settings, anchors, None)?;
        Ok(forecast.ok().map(|forecast| forecast.needs()).filter(|&bytes| bytes <= available))
    };
    let with = |change: String, make: &dyn Fn(&mut Settings)| {
        let mut changed = settings.clone();
        make(&mut changed);
        (change, changed)
    };
    let scale = settings.scene.downscale;
    let smaller = |to| with(format!("--downscale {to}"), &|changed| changed.scene.downscale = to);
    let mut ways = vec![[scale + 1, scale * 2, scale * 3, scale * 4, scale * 8].map(smaller).to_vec()];
    if settings.model.form == Form::Gaussians {
        let fewer = |share: f64| {
            let most = (f64::from(settings.densify.max_gaussians) * share).ceil() as u32;
            with(format!("--set densify.max_gaussians={most}"), &|changed| changed.densify.max_gaussians = most)
        };
        ways.push(GAUSSIANS.into_iter().skip(1).map(fewer).collect());
    } else {
        let coarser = |factor| {
            let (key, grid, changed) = coarser(settings, factor);
            (format!("--set {key}={grid}"), changed)
        };
        ways.push(COARSER[1..8].iter().copied().map(coarser).collect());
    }
    let plan = Plan::new(scene, settings);
    if plan.growth && !plan.plain && question.anchors.is_none() {
        let first = Beginning::of(scene, settings)?;
        let count = first.count();
        let growth = u64::from(expected_anchors(gpu, &plan, settings, &first) - count);
        let fewer = |eighths| {
            let most = count + (growth * eighths / 8) as u32;
            with(format!("--set densify.max_anchors={most}"), &|changed| changed.densify.max_anchors = most)
        };
        // In eighths of the growth, the most first.
        ways.push((0..8).rev().map(fewer).collect());
    }
    if plan.attention {
        let attention = &settings.model.attention;
        let halves = std::iter::successors(Some(attention.tokens / 2), |tokens| Some(tokens / 2));
        let fewer = |tokens| {
            with(format!("--set model.attention.tokens={tokens}"), &|changed| {
                changed.model.attention.tokens = tokens;
            })
        };
        ways.push(halves.take_while(|tokens| *tokens > attention.min_tokens).map(fewer).collect());
    }
    let mut found = vec![];
    for way in ways {
        for (change, changed) in way {
            let to = changed.scene.downscale;
            let needs = if to == scale { needs(scene, &changed) } else { needs(&resized(scene, scale, to), &changed) };
            if let Some(needs) = needs? {
                found.push(Remedy { change, needs });
                break;
            }
        }
    }
    Ok(found)
}

//! One training step by stage: GPU time beside the distance from the float64 reference path.
//!
//! All choices start from the same model, trained for some steps under the settings as they are. Each runs the same step
//! on the same views, in rounds in which every choice has its turn, so that whatever else the machine does falls on all of
//! them. Errors are those of what the stages leave behind, against the reference path ([`Gpu::reference`]: the twins,
//! float64 within a pass) *under the settings as they are*: a choice that computes something else shows that as its error.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::rc::Rc;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::stages::{self, GRADIENTS, OUTPUTS, Rows, Stage, WANTED};
use super::{Error, Omitted};
use crate::gpu::{self, Buffer, Difference, Gpu, Recorder, Schedule, Submission, Timing};
use crate::lab::pace::Pace;
use crate::lab::pareto::{self, Choice};
use crate::lab::statistics::Spread;
use crate::lab::variants::Variant;
use crate::model::init;
use crate::model::stored::Stored;
use crate::scene::{Reference, Scene};
use crate::train::begin::Beginning;
use crate::train::photographs::{self, Photograph};
use crate::train::plan::Plan;
use crate::train::run::Run;
use crate::train::step::{Rates, Step};

/// How much is measured.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Steps trained before.
    pub warm_up: u32,
    /// The number that the measured step counts as; nothing: the first one in which all choices that have
    /// attention have begun with it, or the one behind the warm-up.
    pub step: Option<u32>,
    /// Views, the reference view among them if there is one.
    pub views: usize,
    /// Timed rounds.
    pub repetitions: usize,
}

/// A distance from the reference path, relative to it; the worst of several tensors.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Distance {
    /// Euclidean norm of the difference by that of the reference, over all views together.
    pub relative: f64,
    /// Largest difference by the largest magnitude of the reference.
    pub largest: f64,
    /// The tensor with the largest `relative`.
    pub tensor: &'static str,
}

/// A stage of a choice.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigures {
    /// The stage.
    pub stage: Stage,
    /// Milliseconds per step in its passes.
    pub milliseconds: Spread,
    /// These in terms of those of the first choice, round by round; absent where that has no such stage.
    pub time_ratio: Option<Spread>,
    /// What the stage leaves behind against the reference path, whatever came before it included. Of `bin` that of the
    /// picture, which is what another order changes; absent where nothing is compared.
    pub error: Option<Distance>,
    /// Its own passes against their twins on the same inputs, float tensors.
    pub kernel_error: Option<OwnError>,
    /// A choice that makes this one superfluous in this stage.
    pub dominated_by: Option<String>,
}

/// The largest error of a stage's own passes against their twins.
#[derive(Clone, Debug, Serialize)]
pub struct OwnError {
    /// As [`Distance::relative`].
    pub relative: f64,
    /// The pass.
    pub pass: String,
    /// Its tensor.
    pub tensor: String,
    /// Integers that differ.
    pub integers: usize,
}

/// A choice.
#[derive(Clone, Debug, Serialize)]
pub struct VariantFigures {
    /// Its name.
    pub name: String,
    /// What it sets.
    pub changes: Vec<String>,
    /// Milliseconds from the first pass to the end of the picture.
    pub picture_milliseconds: Spread,
    /// The picture (rgb) against that of the reference path.
    pub picture_error: Distance,
    /// Milliseconds of the whole step.
    pub step_milliseconds: Spread,
    /// These in terms of those of the first choice, round by round.
    pub time_ratio: Spread,
    /// The worst of the model's gradients against those of the reference path.
    pub gradient_error: Distance,
    /// A choice that makes this one superfluous: picture, gradients and time of the step together.
    pub dominated_by: Option<String>,
    /// By stage, those it has.
    pub stages: Vec<StageFigures>,
    /// Every compared tensor.
    pub tensors: Vec<TensorError>,
}

/// One tensor against the reference path.
#[derive(Clone, Debug, Serialize)]
pub struct TensorError {
    /// Where it is made.
    pub stage: Stage,
    /// Its name.
    pub tensor: &'static str,
    /// As [`Distance::relative`]; absent where the reference is zero.
    pub relative: Option<f64>,
    /// As [`Distance::largest`].
    pub largest: Option<f64>,
}

/// The measurements of one step.
#[derive(Clone, Debug, Serialize)]
pub struct Kernels {
    /// Steps trained before.
    pub warm_up: u32,
    /// The number that the measured step counts as.
    pub step: u32,
    /// The views' names.
    pub views: Vec<String>,
    /// Timed rounds.
    pub repetitions: usize,
    /// Anchors of the model.
    pub anchors: u32,
    /// What was measured; the first is the settings as they are.
    pub variants: Vec<VariantFigures>,
    /// What was not.
    pub omitted: Vec<Omitted>,
}

/// Measures the step of every choice; the first is the one whose settings are the reference's.
///
/// # Errors
/// When the device has no room for the stages of all choices, or no timestamps.
pub fn measure(
    gpu: &Gpu,
    scene: &Scene,
    variants: Vec<Variant>,
    options: Options,
    say: &mut dyn FnMut(&str),
) -> Result<Kernels, Error> {
    if gpu.info().timestamp_period <= 0.0 {
        return Err(Error::NoTimestamps { device: gpu.info().name.clone() });
    }
    let reads_otherwise = |v: &Variant| v.settings.scene != variants[0].settings.scene;
    let other: Vec<String> = variants.iter().filter(|v| reads_otherwise(v)).map(|v| v.name.clone()).collect();
    let variants: Vec<Variant> = variants.into_iter().filter(|v| !other.contains(&v.name)).collect();
    let (variants, mut omitted) = super::distinct(scene, variants);
    let why = "it reads the scene in another way, so that nothing can be compared pixel by pixel";
    omitted.extend(other.into_iter().map(|variant| Omitted { variant, why: why.to_owned() }));

    let base = &variants[0].settings;
    say(&format!("kernels: {} steps of warm-up", options.warm_up));
    let warm = Warm::train(gpu, scene, base, options.warm_up)?;
    let has_attention = |variant: &&Variant| Plan::new(scene, &variant.settings).attention;
    let attention = variants.iter().filter(has_attention).map(|variant| variant.settings.model.attention.start).max();
    let step = options.step.unwrap_or(attention.unwrap_or(0).max(options.warm_up + 1)).max(1);
    let subset = choose_views(scene, options.views);
    let mut photographs: BTreeMap<bool, Rc<Vec<Photograph>>> = BTreeMap::new();
    let mut benches = vec![];
    for variant in &variants {
        let plan = Plan::new(scene, &variant.settings);
        let photographs = match photographs.entry(plan.depth) {
            Entry::Occupied(there) => there.get().clone(),
            Entry::Vacant(free) => free.insert(Rc::new(photographs::upload(gpu, &subset, &plan, 1)?)).clone(),
        };
        benches.push(Bench::new(gpu, scene, variant, plan, photographs, &warm, step)?);
    }

    say("kernels: the reference path");
    let views = subset.train.len();
    let reference: Vec<Capture> =
        (0..views).map(|view| benches[0].capture(gpu, view, true)).collect::<Result<_, gpu::Error>>()?;
    let mut errors = vec![];
    let mut own = vec![];
    for (bench, variant) in benches.iter_mut().zip(&variants) {
        say(&format!("kernels: errors of \"{}\"", variant.name));
        let mut tensors = Tensors::default();
        for (view, reference) in reference.iter().enumerate() {
            tensors.add(reference, &bench.capture(gpu, view, false)?, &warm.values);
        }
        errors.push(tensors);
        own.push(bench.differences(gpu, 0)?);
    }

    let mut times: Vec<Times> = vec![Times::default(); variants.len()];
    // The first round warms up.
    let pace = Pace::new(1 + options.repetitions);
    for round in 0..=options.repetitions {
        say(&format!("kernels: round {}", pace.next(round)));
        for turn in 0..variants.len() {
            let which = (turn + round) % variants.len();
            let passes: Vec<Vec<Timing>> =
                (0..views).map(|view| benches[which].time(gpu, view)).collect::<Result<_, gpu::Error>>()?;
            if round > 0 {
                times[which].add(&passes);
            }
        }
    }

    let first = &times[0];
    let mut figures: Vec<VariantFigures> = variants
        .into_iter()
        .zip(times.iter().zip(errors.iter().zip(&own)))
        .map(|(variant, (times, (errors, own)))| VariantFigures {
            name: variant.name,
            changes: variant.changes,
            picture_milliseconds: Spread::of(&times.picture),
            picture_error: errors.worst(|_, name| name == "rgb").unwrap_or(EXACT),
            step_milliseconds: Spread::of(&times.step),
            time_ratio: pareto::ratio(&times.step, &first.step),
            gradient_error: errors.worst(|_, name| GRADIENTS.contains(&name)).unwrap_or(EXACT),
            dominated_by: None,
            stages: of_stages(times, first, errors, own),
            tensors: errors.list(),
        })
        .collect();
    mark_dominated(&mut figures, &times);
    Ok(Kernels {
        warm_up: options.warm_up,
        step,
        views: subset.train.iter().map(|view| view.name.clone()).collect(),
        repetitions: options.repetitions,
        anchors: warm.from.count(),
        variants: figures,
        omitted,
    })
}

/// No difference at all: what was not even compared is not drawn from.
const EXACT: Distance = Distance { relative: 0.0, largest: 0.0, tensor: "" };

fn of_stages(times: &Times, first: &Times, errors: &Tensors, own: &BTreeMap<Stage, OwnError>) -> Vec<StageFigures> {
    let figures = |stage: Stage| {
        let own_times = times.stages.get(&stage)?;
        let time_ratio = first.stages.get(&stage).map(|first| pareto::ratio(own_times, first));
        let error = match stage {
            Stage::Bin => errors.worst(|_, name| name == "rgb"),
            _ => errors.worst(|of, _| of == stage),
        };
        Some(StageFigures {
            stage,
            milliseconds: Spread::of(own_times),
            time_ratio,
            error,
            kernel_error: own.get(&stage).cloned(),
            dominated_by: None,
        })
    };
    Stage::ALL.into_iter().filter_map(figures).collect()
}

fn mark_dominated(figures: &mut [VariantFigures], times: &[Times]) {
    let names: Vec<String> = figures.iter().map(|f| f.name.clone()).collect();
    let whole = |(f, times): (&VariantFigures, &Times)| Choice {
        times: times.step.clone(),
        errors: vec![f.picture_error.relative, f.gradient_error.relative],
    };
    let by = pareto::dominated(&figures.iter().zip(times).map(whole).collect::<Vec<_>>());
    for (figure, by) in figures.iter_mut().zip(by) {
        figure.dominated_by = by.map(|by| names[by].clone());
    }
    for stage in Stage::ALL {
        let mut judged: Vec<(usize, &mut StageFigures)> = figures
            .iter_mut()
            .enumerate()
            .filter_map(|(i, f)| Some((i, f.stages.iter_mut().find(|s| s.stage == stage && s.error.is_some())?)))
            .collect();
        let choice = |(i, s): &(usize, &mut StageFigures)| Choice {
            times: times[*i].stages[&stage].clone(),
            errors: s.error.iter().map(|error| error.relative).collect(),
        };
        let by = pareto::dominated(&judged.iter().map(choice).collect::<Vec<_>>());
        let of: Vec<usize> = judged.iter().map(|(i, _)| *i).collect();
        for ((_, figure), by) in judged.iter_mut().zip(by) {
            figure.dominated_by = by.map(|by| names[of[by]].clone());
        }
    }
}

/// The reference view first, then others evenly over the rest.
pub(crate) fn choose_views(scene: &Scene, views: usize) -> Scene {
    let first = scene.references.first().map(|r| r.view);
    let others: Vec<usize> = (0..scene.train.len()).filter(|i| Some(*i) != first).collect();
    let wanted = views.max(1).min(scene.train.len()) - usize::from(first.is_some());
    let spread = (0..wanted).map(|i| others[i * others.len() / wanted]);
    let chosen: Vec<usize> = first.into_iter().chain(spread).collect();
    Scene {
        train: chosen.iter().map(|i| scene.train[*i].clone()).collect(),
        test: vec![],
        holes: vec![],
        references: scene.references.iter().take(1).map(|r| Reference { view: 0, ..r.clone() }).collect(),
        ..scene.clone()
    }
}

/// The model that all choices start from.
pub(crate) struct Warm {
    pub(crate) from: Beginning,
    /// Value and moments of what is learnt, without the attention, which may not have begun.
    pub(crate) tensors: Vec<[Vec<f32>; 3]>,
    /// Values by their buffers' names.
    pub(crate) values: BTreeMap<&'static str, Vec<f32>>,
    pub(crate) capacity: crate::render::forward::Capacity,
}

impl Warm {
    pub(crate) fn train(
        gpu: &Gpu,
        scene: &Scene,
        settings: &crate::config::Settings,
        steps: u32,
    ) -> Result<Self, Error> {
        let mut run = Run::new(gpu, scene, settings)?;
        for step in 1..=steps {
            run.run_one(step)?;
            run.change_anchors(step)?;
        }
        let step = run.step();
        let mut model = step.stored()?;
        if let Stored::Anchors(_, weights) = &mut model
            && !weights.has_attention()
        {
            // A choice may have it where the settings leave it out.
            let fresh =
                init::weights(settings.train.seed, settings.model.offsets as usize, true, settings.model.opacity);
            fresh.tensors.into_iter().for_each(|(name, tensor)| _ = weights.tensors.entry(name).or_insert(tensor));
        }
        // The grid's side matters to growing alone, which is not measured.
        let from = Beginning { model, voxel: 1.0, rows: 0 };
        let mut tensors = vec![];
        let mut values = BTreeMap::new();
        for parameter in step.learnt.rows().into_iter().chain(step.learnt.weights()) {
            let [value, first, root] = parameter.tensors().map(|tensor| gpu.read(tensor));
            let value = value?;
            values.insert(parameter.value.name(), value.clone());
            tensors.push([value, first?, root?]);
        }
        Ok(Self { from, tensors, values, capacity: step.capacity() })
    }
}

/// One choice on the device.
pub(crate) struct Bench {
    pub(crate) step: Step,
    pub(crate) number: u32,
    rates: Rates,
    photographs: Rc<Vec<Photograph>>,
    /// Value and moments to go back to before every step.
    initial: Vec<[Buffer<f32>; 3]>,
}

impl Bench {
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &Scene,
        variant: &Variant,
        mut plan: Plan,
        photographs: Rc<Vec<Photograph>>,
        warm: &Warm,
        number: u32,
    ) -> Result<Self, Error> {
        let settings = &variant.settings;
        // Those of the photographs, whatever the run's first steps have.
        plan.sizes = photographs.iter().map(|photograph| photograph.camera.size).collect();
        plan.sizes.sort_unstable();
        plan.sizes.dedup();
        let mut step = Step::new(gpu, plan, settings, &warm.from)?;
        step.resize(warm.capacity)?;
        step.prepare(number)?;
        let mut initial = vec![];
        for (i, parameter) in step.parameters().into_iter().enumerate() {
            let mut copies = vec![];
            for (j, tensor) in parameter.tensors().into_iter().enumerate() {
                if let Some(warm) = warm.tensors.get(i) {
                    let both = tensor.len().min(warm[j].len());
                    gpu.write(tensor, &warm[j][..both])?;
                }
                copies.push(gpu.upload("initial", &gpu.read(tensor)?)?);
            }
            initial.push(copies.try_into().map_err(|_| "three tensors").expect("a value and two moments"));
        }
        let rates = Rates::at(settings, f64::from(scene.radius), number);
        Ok(Self { step, number, rates, photographs, initial })
    }

    fn restore(&self, gpu: &Gpu) -> Result<(), gpu::Error> {
        let mut rec = gpu.recorder()?;
        for (parameter, initial) in self.step.parameters().into_iter().zip(&self.initial) {
            for (from, to) in initial.iter().zip(parameter.tensors()) {
                rec.copy(from, to, from.len());
            }
        }
        rec.submit()?.wait()?;
        Ok(())
    }

    /// Runs the step until it fits.
    fn run<'g, T>(
        &mut self,
        gpu: &'g Gpu,
        view: usize,
        recorder: impl Fn(&'g Gpu) -> Result<Recorder<'g>, gpu::Error>,
        take: impl Fn(Submission<'g>, [Instant; 3]) -> Result<T, gpu::Error>,
    ) -> Result<T, gpu::Error> {
        self.step.limits.share().until_all_fits(gpu, |counted| {
            if let Some(counted) = counted {
                self.step.resize(self.step.capacity().fit(counted))?;
            }
            self.restore(gpu)?;
            let begun = Instant::now();
            let mut rec = recorder(gpu)?;
            self.step.record(&mut rec, &self.photographs[view], self.number, self.rates);
            let recorded = Instant::now();
            let submission = rec.submit()?;
            take(submission, [begun, recorded, Instant::now()])
        })
    }

    /// The passes' times.
    fn time(&mut self, gpu: &Gpu, view: usize) -> Result<Vec<Timing>, gpu::Error> {
        Ok(self.clock(gpu, view)?.passes)
    }

    /// The passes' times, what was recorded, and the host's own times.
    pub(crate) fn clock(&mut self, gpu: &Gpu, view: usize) -> Result<Clocked, gpu::Error> {
        self.run(gpu, view, Gpu::recorder, |mut submission, [begun, recorded, submitted]| {
            let schedule = std::mem::take(&mut submission.schedule);
            let passes = submission.wait()?;
            let host = [recorded - begun, submitted - recorded, submitted.elapsed()];
            Ok(Clocked { passes, schedule, host })
        })
    }

    /// The views' names.
    pub(crate) fn views(&self) -> Vec<String> {
        self.photographs.iter().map(|photograph| photograph.name.clone()).collect()
    }

    /// Width and height of a view's picture.
    pub(crate) fn size(&self, view: usize) -> [u32; 2] {
        self.photographs[view].camera.size
    }

    /// The words that the step leaves in the buffers of these names.
    pub(crate) fn trace(
        &mut self,
        gpu: &Gpu,
        view: usize,
        wanted: &'static [&'static str],
    ) -> Result<BTreeMap<&'static str, Vec<u32>>, gpu::Error> {
        self.run(gpu, view, |gpu| Gpu::traced(gpu, wanted), take_trace)
    }

    /// What the step leaves in the buffers that are compared, by the kernels or by their twins.
    fn capture(&mut self, gpu: &Gpu, view: usize, twins: bool) -> Result<Capture, gpu::Error> {
        let recorder = |gpu| if twins { Gpu::reference(gpu, &WANTED) } else { Gpu::traced(gpu, &WANTED) };
        let words = self.run(gpu, view, recorder, take_trace)?;
        Ok(Capture { words, offsets: self.step.anchors().offsets as usize })
    }

    /// The worst of every stage's own passes against their twins on the same inputs.
    fn differences(&mut self, gpu: &Gpu, view: usize) -> Result<BTreeMap<Stage, OwnError>, gpu::Error> {
        let differences = self.run(gpu, view, Gpu::checked, |mut submission, _| {
            let differences = std::mem::take(&mut submission.differences);
            submission.wait()?;
            Ok(differences)
        })?;
        let mut worst = BTreeMap::new();
        let of_passes = stages::of_passes(differences.iter().map(|d| d.pass.as_str()));
        for (stage, Difference { pass, tensor, relative, discrete, exceeded, .. }) in
            of_passes.into_iter().zip(differences)
        {
            let own = worst.entry(stage).or_insert_with(|| OwnError {
                relative: 0.0,
                pass: pass.clone(),
                tensor: tensor.clone(),
                integers: 0,
            });
            if discrete {
                own.integers += exceeded;
            } else if relative > own.relative {
                *own = OwnError { relative, pass, tensor, integers: own.integers };
            }
        }
        Ok(worst)
    }
}

/// A step as its clocks saw it.
pub(crate) struct Clocked {
    /// The passes' times.
    pub(crate) passes: Vec<Timing>,
    /// Passes and barriers as recorded.
    pub(crate) schedule: Schedule,
    /// How long the host recorded, submitted and waited.
    pub(crate) host: [Duration; 3],
}

fn take_trace(mut submission: Submission<'_>, _: [Instant; 3]) -> Result<BTreeMap<&'static str, Vec<u32>>, gpu::Error> {
    let words = std::mem::take(&mut submission.trace);
    submission.wait()?;
    Ok(words)
}

/// The words of the compared buffers behind one step.
struct Capture {
    words: BTreeMap<&'static str, Vec<u32>>,
    offsets: usize,
}

impl Capture {
    fn floats(&self, name: &str) -> Option<impl Fn(usize) -> f64> {
        let words = self.words.get(name)?;
        Some(|i: usize| f64::from(f32::from_bits(words[i])))
    }

    fn words(&self, name: &str) -> &[u32] {
        self.words.get(name).map_or(&[], Vec::as_slice)
    }

    /// The anchors in view, ascending.
    fn visible(&self) -> &[u32] {
        let count = self.words("visible_count").first().map_or(0, |count| *count as usize);
        let visible = self.words("visible");
        &visible[..count.min(visible.len())]
    }

    /// Slots of Gaussians that touch a tile here and there.
    fn common_slots(&self, other: &Self) -> Vec<(usize, usize)> {
        let theirs: HashMap<u32, usize> = other.visible().iter().enumerate().map(|(v, anchor)| (*anchor, v)).collect();
        let drawn = |capture: &Self, slot: usize| capture.words("tiles").get(slot).is_some_and(|tiles| *tiles > 0);
        let mut slots = vec![];
        for (v, anchor) in self.visible().iter().enumerate() {
            let Some(w) = theirs.get(anchor) else { continue };
            let pairs = (0..self.offsets).map(|k| (k * self.visible().len() + v, k * other.visible().len() + w));
            slots.extend(pairs.filter(|(own, other_slot)| drawn(self, *own) && drawn(other, *other_slot)));
        }
        slots
    }
}

/// Sums over views, by tensor.
#[derive(Default)]
struct Tensors {
    sums: BTreeMap<(Stage, &'static str), Sums>,
}

#[derive(Clone, Copy, Default)]
struct Sums {
    square: f64,
    reference_square: f64,
    largest: f64,
    reference_largest: f64,
}

impl Sums {
    fn add(&mut self, got: f64, want: f64) {
        // Two infinities or two NaNs alike are no difference.
        let difference = if got == want || (got.is_nan() && want.is_nan()) { 0.0 } else { (got - want).abs() };
        let difference = if difference.is_nan() { f64::INFINITY } else { difference };
        self.square += difference * difference;
        self.largest = self.largest.max(difference);
        if want.is_finite() {
            self.reference_square += want * want;
            self.reference_largest = self.reference_largest.max(want.abs());
        }
    }

    /// Nothing where the reference is zero everywhere.
    fn distance(&self, tensor: &'static str) -> Option<Distance> {
        (self.reference_square > 0.0).then(|| Distance {
            relative: (self.square / self.reference_square).sqrt(),
            largest: self.largest / self.reference_largest,
            tensor,
        })
    }
}

impl Tensors {
    /// Adds a view. A tensor that the choice does not have counts as zero where it is a gradient, and is left out otherwise.
    fn add(&mut self, reference: &Capture, got: &Capture, before: &BTreeMap<&'static str, Vec<f32>>) {
        let slots = reference.common_slots(got);
        for (stage, name, rows) in OUTPUTS {
            let Some(want) = reference.floats(name) else { continue };
            let found = got.floats(name);
            if found.is_none() && !GRADIENTS.contains(&name) {
                continue;
            }
            let value = |i: usize| found.as_ref().map_or(0.0, |found| found(i));
            let sums = self.sums.entry((stage, name)).or_default();
            match rows {
                Rows::Slots(components) => {
                    for (own, other) in &slots {
                        for c in 0..components {
                            sums.add(value(other * components + c), want(own * components + c));
                        }
                    }
                }
                Rows::Plain => {
                    for i in 0..reference.words(name).len() {
                        sums.add(value(i), want(i));
                    }
                }
                Rows::Learnt => {
                    for (i, before) in before.get(name).into_iter().flatten().enumerate() {
                        let before = f64::from(*before);
                        sums.add(value(i) - before, want(i) - before);
                    }
                }
            }
        }
        // Of the set of visible anchors its indicator.
        let (ours, theirs) = (reference.visible(), got.visible());
        let sums = self.sums.entry((Stage::Cull, "visible")).or_default();
        let missing = |a: &[u32], b: &[u32]| a.iter().filter(|anchor| b.binary_search(anchor).is_err()).count();
        let different = missing(ours, theirs) + missing(theirs, ours);
        sums.square += different as f64;
        sums.reference_square += ours.len() as f64;
        sums.largest = sums.largest.max(f64::from(u8::from(different > 0)));
        sums.reference_largest = 1.0;
    }

    fn worst(&self, wanted: impl Fn(Stage, &str) -> bool) -> Option<Distance> {
        let matching = self.sums.iter().filter(|((stage, name), _)| wanted(*stage, name));
        matching.filter_map(|((_, name), sums)| sums.distance(name)).max_by(|a, b| a.relative.total_cmp(&b.relative))
    }

    fn list(&self) -> Vec<TensorError> {
        let row = |((stage, tensor), sums): (&(Stage, &'static str), &Sums)| {
            let distance = sums.distance(tensor);
            TensorError {
                stage: *stage,
                tensor,
                relative: distance.as_ref().map(|d| d.relative),
                largest: distance.as_ref().map(|d| d.largest),
            }
        };
        self.sums.iter().map(row).collect()
    }
}

/// Milliseconds of each round, means over the views.
#[derive(Clone, Default)]
struct Times {
    stages: BTreeMap<Stage, Vec<f64>>,
    picture: Vec<f64>,
    step: Vec<f64>,
}

impl Times {
    fn add(&mut self, views: &[Vec<Timing>]) {
        let scale = 1e-6 / views.len() as f64;
        let mut stages: BTreeMap<Stage, f64> = BTreeMap::new();
        let (mut picture, mut step) = (0.0, 0.0);
        for passes in views {
            let of_passes = stages::of_passes(passes.iter().map(|pass| pass.name));
            let start = passes.first().map_or(0.0, |pass| pass.start);
            let end = |pass: &Timing| pass.start + pass.duration - start;
            for (pass, stage) in passes.iter().zip(&of_passes) {
                *stages.entry(*stage).or_default() += pass.duration * scale;
            }
            let forward = passes.iter().zip(&of_passes).filter(|(_, stage)| stage.is_forward());
            picture += forward.map(|(pass, _)| end(pass)).fold(0.0, f64::max) * scale;
            step += passes.iter().map(end).fold(0.0, f64::max) * scale;
        }
        for (stage, milliseconds) in stages {
            self.stages.entry(stage).or_default().push(milliseconds);
        }
        self.picture.push(picture);
        self.step.push(step);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn capture(words: &[(&'static str, &[u32])], offsets: usize) -> Capture {
        Capture { words: words.iter().map(|(name, words)| (*name, words.to_vec())).collect(), offsets }
    }

    /// Anchors 3 and 7 against 7 and 9, two slots each: slots of anchor 7 are compared, where both touch a tile.
    #[test]
    fn slots_are_matched_by_anchor() {
        let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<u32>>();
        let (own, other) = (bits(&[1.0, 3.0, 2.0, 4.0]), bits(&[3.5, 9.0, 5.0, 6.0]));
        let a = capture(
            &[("visible", &[3, 7, 0]), ("visible_count", &[2]), ("tiles", &[1, 1, 1, 0]), ("opacity", &own)],
            2,
        );
        let b = capture(
            &[("visible", &[7, 9, 0]), ("visible_count", &[2]), ("tiles", &[2, 2, 2, 2]), ("opacity", &other)],
            2,
        );
        assert_eq!(a.common_slots(&b), [(1, 0)]);
        let mut tensors = Tensors::default();
        tensors.add(&a, &b, &BTreeMap::new());
        let opacity = tensors.worst(|_, name| name == "opacity").expect("compared");
        assert!((opacity.relative - 0.5 / 3.0).abs() < 1e-12 && (opacity.largest - 0.5 / 3.0).abs() < 1e-12);
        let visible = tensors.worst(|stage, _| stage == Stage::Cull).expect("compared");
        assert!((visible.relative - 1.0).abs() < 1e-12, "two of two differ: {visible:?}");
    }

    #[test]
    fn gradients_that_are_missing_are_zero() {
        let one = [1f32.to_bits(), 2f32.to_bits()];
        let have = capture(&[("grad_weights", &one), ("depth_map", &one), ("weights", &one)], 1);
        let lack = capture(&[], 1);
        let mut tensors = Tensors::default();
        tensors.add(&have, &lack, &BTreeMap::new());
        let relative = |name: &str| tensors.worst(|_, n| n == name).map(|d| d.relative);
        assert_eq!((relative("grad_weights"), relative("depth_map")), (Some(1.0), None));
        let mut tensors = Tensors::default();
        let changed = capture(&[("weights", &[1f32.to_bits(), 2.5f32.to_bits()])], 1);
        tensors.add(&have, &changed, &BTreeMap::from([("weights", vec![1.0, 1.0])]));
        let update = tensors.worst(|_, n| n == "weights").expect("compared");
        assert!((update.relative - 0.5).abs() < 1e-12, "of the change, not of the value: {update:?}");
        let nan = capture(&[("weights", &[f32::NAN.to_bits(), 2f32.to_bits()])], 1);
        let mut tensors = Tensors::default();
        tensors.add(&have, &nan, &BTreeMap::from([("weights", vec![0.0, 0.0])]));
        assert_eq!(tensors.worst(|_, n| n == "weights").map(|d| d.relative), Some(f64::INFINITY));
    }

    #[test]
    fn times_are_sums_of_stages_and_spans_of_wholes() {
        let pass = |name, start, duration| Timing { name, start, duration };
        let passes = vec![
            pass("render/cull", 1e6, 1e6),
            pass("render/decode", 3e6, 2e6),
            pass("render/rasterize", 6e6, 1e6),
            pass("losses/sum", 8e6, 1e6),
        ];
        let mut times = Times::default();
        times.add(&[passes.clone(), passes]);
        assert_eq!((times.picture[0], times.step[0]), (6.0, 8.0));
        assert_eq!(times.stages[&Stage::Decode], [2.0]);
    }
}

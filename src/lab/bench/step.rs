//! One training step, pass by pass: time, what there was to do, and the time that this takes at the device's ceilings.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::ceilings::{Ceilings, Rates, STAGE, span};
use super::cost::{self, Dispatch, Work};
use super::counts::{self, Counts, Known};
use crate::config::Settings;
use crate::gpu::{Entry, Gpu, Schedule, Timing};
use crate::lab::report::Error;
use crate::lab::report::kernels::{Bench, Clocked};
use crate::lab::statistics::Spread;
use crate::model::gaussians::NAMES;
use crate::render::Method;

/// What holds a pass back at least.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Bound {
    /// Its bytes.
    Memory,
    /// Its operations.
    Operations,
    /// Its exponentials.
    Exponentials,
    /// That it is dispatched at all.
    Dispatch,
}

impl Bound {
    /// As the table says it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Operations => "operations",
            Self::Exponentials => "exp",
            Self::Dispatch => "dispatch",
        }
    }
}

/// Milliseconds that work takes at these rates, in so many dispatches, and what holds it back.
pub fn floor(work: &Work, dispatches: f64, rates: &Rates) -> (f64, Bound) {
    // 1e9 per second are 1e6 per millisecond.
    let times = [
        (1e-6 * work.bytes / rates.bandwidth, Bound::Memory),
        (1e-6 * work.operations / rates.operations, Bound::Operations),
        (1e-6 * work.exponentials / rates.exponentials, Bound::Exponentials),
    ];
    let (most, bound) = times.into_iter().fold((0.0, Bound::Dispatch), |a, b| if b.0 > a.0 { b } else { a });
    let dispatching = dispatches * rates.dispatch;
    (most + dispatching, if dispatching > most { Bound::Dispatch } else { bound })
}

/// All dispatches of a kernel in a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PassFigures {
    /// `folder/stem`, or `fill`, `copy`.
    pub pass: String,
    /// Dispatches per step.
    pub dispatches: f64,
    /// Milliseconds per step.
    pub milliseconds: Spread,
    /// What there was to do; absent for a pass without a formula.
    pub work: Option<Work>,
    /// Milliseconds that this takes at the ceilings.
    pub floor: Option<f64>,
    /// What holds it back.
    pub bound: Option<Bound>,
    /// The median time in terms of the floor.
    pub ratio: Option<f64>,
    /// The shortest time in terms of the floor: what is left of the ratio on a machine that does nothing else.
    pub best_ratio: Option<f64>,
}

/// The host's part, milliseconds per step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HostFigures {
    /// Recording the passes.
    pub recording: Spread,
    /// Giving them to the device.
    pub submission: Spread,
    /// Waiting for the device, with nothing else to do meanwhile.
    pub waiting: Spread,
}

/// A step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepFigures {
    /// The number that it counts as.
    pub step: u32,
    /// The views' names.
    pub views: Vec<String>,
    /// Rounds.
    pub repetitions: usize,
    /// What there was.
    pub counts: Counts,
    /// By kernel, the longest first.
    pub passes: Vec<PassFigures>,
    /// Barriers per step.
    pub barriers: f64,
    /// What lies between the passes: milliseconds from the first's start to the last's end, less those of the passes.
    pub between: Spread,
    /// Milliseconds that the barriers take at the ceilings.
    pub between_floor: f64,
    /// Milliseconds from the first pass's start to the last one's end.
    pub total: Spread,
    /// Sum of all floors.
    pub total_floor: f64,
    /// Bytes of device memory in buffers meanwhile.
    pub device_bytes: u64,
    /// The host's part.
    pub host: HostFigures,
}

/// What a step has to do by kernel, with its dispatches, and its barriers.
pub(super) fn work_of(
    gpu: &Gpu,
    schedule: &Schedule,
    counts: &Counts,
) -> (BTreeMap<&'static str, (f64, Option<Work>)>, f64) {
    let sizes: BTreeMap<&str, f64> =
        gpu.buffers().into_iter().map(|(name, number, bytes)| (name, bytes as f64 / number as f64)).collect();
    let bytes = |name: &str| sizes.get(name).copied().unwrap_or(f64::NAN);
    let (mut passes, mut barriers) = (BTreeMap::<_, (f64, Option<Work>)>::new(), 0.0);
    for entry in &schedule.entries {
        match entry {
            Entry::Barrier { .. } => barriers += 1.0,
            Entry::Pass { name, accesses, .. } => {
                let work = cost::of(counts, &Dispatch { name, accesses, bytes: &bytes });
                let (dispatches, sum) = passes.entry(*name).or_insert((0.0, Some(Work::default())));
                *dispatches += 1.0;
                match (sum.as_mut(), work) {
                    (Some(sum), Some(work)) => *sum += work,
                    _ => *sum = None,
                }
            }
        }
    }
    (passes, barriers)
}

/// Everything of one round of a step, means over the views.
struct Round {
    passes: BTreeMap<&'static str, f64>,
    total: f64,
    between: f64,
    host: [f64; 3],
}

impl Round {
    fn of(views: &[Clocked]) -> Self {
        let scale = 1.0 / views.len() as f64;
        let mut round = Self { passes: BTreeMap::new(), total: 0.0, between: 0.0, host: [0.0; 3] };
        for view in views {
            let busy: f64 = view.passes.iter().map(|pass| pass.duration).sum();
            for Timing { name, duration, .. } in &view.passes {
                *round.passes.entry(name).or_default() += duration * 1e-6 * scale;
            }
            let span = span(&view.passes);
            round.total += span * 1e-6 * scale;
            // Passes that run at the same time take less together than one behind the other.
            round.between += (span - busy).max(0.0) * 1e-6 * scale;
            for (sum, time) in round.host.iter_mut().zip(&view.host) {
                *sum += time.as_secs_f64() * 1e3 * scale;
            }
        }
        round
    }
}

/// The numbers of one view's step, and what was recorded.
fn trace(gpu: &Gpu, bench: &mut Bench, settings: &Settings, view: usize) -> Result<(Counts, Schedule), Error> {
    let schedule = bench.clock(gpu, view)?.schedule;
    let words = bench.trace(gpu, view, &counts::WANTED)?;
    let learnt = &bench.step.learnt;
    let harmonics = learnt.rows().into_iter().find(|row| row.names.value == NAMES[4].value);
    let known = Known {
        anchors: learnt.count(),
        harmonics: harmonics.map_or(0, |row| row.width / 3),
        offsets: learnt.offsets(),
        size: bench.size(view),
        gradient_scales: settings.losses.depth.gradient.scales,
    };
    Ok((counts::count(&words, &schedule, Method::new(gpu, &settings.render), known), schedule))
}

/// Measures the step on its views in rounds; the one before the first counted one warms up. `ceilings` has a round of its
/// own before each, and returns what it knows by then.
///
/// # Errors
/// When the device has no room, or is lost.
pub(crate) fn measure(
    gpu: &Gpu,
    bench: &mut Bench,
    settings: &Settings,
    ceilings: &mut dyn FnMut() -> Result<Ceilings, Error>,
    repetitions: usize,
) -> Result<StepFigures, Error> {
    let names = bench.views();
    let views = names.len();
    let traced: Vec<(Counts, Schedule)> =
        (0..views).map(|view| trace(gpu, bench, settings, view)).collect::<Result<_, _>>()?;
    let mut rounds = vec![];
    let mut known = None;
    for round in 0..=repetitions.max(1) {
        if round > 0 {
            known = Some(ceilings()?);
        }
        let clocked: Vec<Clocked> = (0..views).map(|view| bench.clock(gpu, view)).collect::<Result<_, _>>()?;
        if round > 0 {
            rounds.push(Round::of(&clocked));
        }
    }
    let ceilings = &known.expect("there is at least one round");
    let mut works: BTreeMap<&'static str, (f64, Option<Work>)> = BTreeMap::new();
    let (scale, mut barriers) = (1.0 / views as f64, 0.0);
    for (counts, schedule) in &traced {
        let (passes, own_barriers) = work_of(gpu, schedule, counts);
        barriers += own_barriers * scale;
        for (name, (dispatches, work)) in passes {
            let (all, sum) = works.entry(name).or_insert((0.0, Some(Work::default())));
            *all += dispatches * scale;
            match (sum.as_mut(), work) {
                (Some(sum), Some(Work { bytes, operations, exponentials })) => {
                    *sum += Work {
                        bytes: bytes * scale,
                        operations: operations * scale,
                        exponentials: exponentials * scale,
                    };
                }
                _ => *sum = None,
            }
        }
    }
    let spread = |of: &dyn Fn(&Round) -> f64| Spread::of(&rounds.iter().map(of).collect::<Vec<_>>());
    let mut passes: Vec<PassFigures> = works
        .into_iter()
        .map(|(name, (dispatches, work))| {
            let milliseconds = spread(&|round| round.passes.get(name).copied().unwrap_or(0.0));
            let floor = work.map(|work| floor(&work, dispatches, &ceilings.rates()));
            PassFigures {
                pass: name.to_owned(),
                dispatches,
                milliseconds,
                work,
                floor: floor.map(|f| f.0),
                bound: floor.map(|f| f.1),
                ratio: floor.map(|f| milliseconds.median / f.0),
                best_ratio: floor.map(|f| milliseconds.min / f.0),
            }
        })
        .collect();
    passes.sort_by(|a, b| b.milliseconds.median.total_cmp(&a.milliseconds.median).then(a.pass.cmp(&b.pass)));
    let between_floor = barriers * ceilings.waiting();
    let total_floor = passes.iter().filter_map(|pass| pass.floor).sum::<f64>() + between_floor;
    Ok(StepFigures {
        step: bench.number,
        views: names,
        repetitions: repetitions.max(1),
        counts: Counts::mean(traced.into_iter().map(|(counts, _)| counts).collect()),
        passes,
        barriers,
        between: spread(&|round| round.between),
        between_floor,
        total: spread(&|round| round.total),
        total_floor,
        device_bytes: gpu.stages().iter().filter(|(name, _)| **name != STAGE).map(|(_, (_, bytes))| bytes).sum(),
        host: HostFigures {
            recording: spread(&|round| round.host[0]),
            submission: spread(&|round| round.host[1]),
            waiting: spread(&|round| round.host[2]),
        },
    })
}

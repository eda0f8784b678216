//! What the device gives at most: the ceilings under which every pass is judged.
//!
//! Each is a kernel that does one thing only, timed by timestamp queries in rounds in which every one has its turn, and
//! what is measured beside them too. Work grows until one run takes `LONG_ENOUGH`, so that neither a fast nor a slow
//! device is measured by its clock's ticks. Whatever else the machine does only takes away: floors are of the best round.

use serde::{Deserialize, Serialize};

use crate::gpu::kernels::lab::bench::{ceilings_copy, ceilings_empty, ceilings_exp, ceilings_fma};
use crate::gpu::{Buffer, Check, Error, Gpu, Reference, Timing};
use crate::lab::statistics::Spread;

/// Milliseconds that one timed run takes at least, where the work can be made longer.
const LONG_ENOUGH: f64 = 4.0;
/// Bytes copied one way, unless the device binds less: more than the caches of a GPU hold.
const COPIED: u64 = 64 << 20;
/// Bytes copied one way that stay in a cache, as most arrays of a step do.
const CACHED: u64 = 4 << 20;
/// Threads of the arithmetic kernels.
const THREADS: u32 = 1 << 16;
/// Multiply-adds of a thread and round.
const FMAS: u32 = 64 * 8;
/// Exponentials of a thread and round.
const EXPS: u32 = 16 * 4;
/// Dispatches in a row.
const DISPATCHES: usize = 128;

/// The rates that floors are taken at.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    /// 1e9 bytes per second.
    pub bandwidth: f64,
    /// 1e9 operations per second.
    pub operations: f64,
    /// 1e9 exponentials per second.
    pub exponentials: f64,
    /// Milliseconds of a dispatch.
    pub dispatch: f64,
}

impl Reference for ceilings_copy::Kernel {
    fn reference(host: ceilings_copy::Host<'_>, push: ceilings_copy::Push, (): ()) {
        let floats = if host.kernel == ceilings_copy::Kernel::Vec4 { 4 * push.n } else { push.n } as usize;
        host.to[..floats].copy_from_slice(&host.from[..floats]);
    }
    fn check(_: &'static str) -> Check {
        Check { relative: 0.0, absolute: 0.0, band: 0.0 }
    }
}

impl Reference for ceilings_fma::Kernel {
    // With a <= 1/2 a chain's roundings sum to at most two of them: eight chains, well within the default check.
    fn reference(host: ceilings_fma::Host<'_>, push: ceilings_fma::Push, (): ()) {
        let (a, b) = (f64::from(push.a), f64::from(push.b));
        for (start, sum) in host.start.iter().zip(host.sums).take(push.n as usize) {
            let chain = |c: u32| (0..push.rounds * 64).fold(f64::from(*start) + f64::from(c), |x, _| x * a + b);
            *sum = (0..8).map(chain).sum::<f64>() as f32;
        }
    }
}

impl Reference for ceilings_exp::Kernel {
    // exp(-x) contracts towards its fixed point 0.567 at that rate: the driver's error in one exponential (Vulkan allows
    // 3 + 2 |x| units in the last place) counts at most 2.4 times, 1e-6 of a chain and of their sum.
    fn reference(host: ceilings_exp::Host<'_>, push: ceilings_exp::Push, (): ()) {
        for (start, sum) in host.start.iter().zip(host.sums).take(push.n as usize) {
            let chain =
                |c: u32| (0..push.rounds * 16).fold(f64::from(*start) + 0.125 * f64::from(c), |x, _| (-x).exp());
            *sum = (0..4).map(chain).sum::<f64>() as f32;
        }
    }
}

impl Reference for ceilings_empty::Kernel {
    fn reference(host: ceilings_empty::Host<'_>, push: ceilings_empty::Push, (): ()) {
        host.word[0] = host.word[0].wrapping_add(push.add);
    }
}

/// What was measured. Bytes are those read and those written.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ceilings {
    /// Copy of floats, 1e9 bytes per second.
    pub copy_f32: Spread,
    /// Copy of vectors of four, likewise.
    pub copy_vec4: Spread,
    /// Likewise, of so few that they stay in a cache, less the dispatch.
    pub copy_cached: Spread,
    /// Fused multiply-adds, 1e9 per second.
    pub fma: Spread,
    /// Exponentials, likewise.
    pub exp: Spread,
    /// An empty dispatch between its timestamps, microseconds.
    pub dispatch: Spread,
    /// From one empty dispatch to the next without a barrier in between, microseconds.
    pub spacing: Spread,
    /// What a pipeline barrier in between adds to that, microseconds.
    pub barrier: Spread,
}

impl Ceilings {
    /// What floors are taken at: the best of every round, and of the copies, as what a pass finds in a cache is a floor too.
    pub fn rates(&self) -> Rates {
        Rates {
            bandwidth: self.copy_f32.max.max(self.copy_vec4.max).max(self.copy_cached.max),
            operations: self.fma.max,
            exponentials: self.exp.max,
            dispatch: self.dispatch.min * 1e-3,
        }
    }

    /// Milliseconds of a barrier. Its rounds are differences, whose smallest is the noise's: the lower quartile.
    pub fn waiting(&self) -> f64 {
        self.barrier.lower * 1e-3
    }

    /// Every ceiling: what it is, its unit, its value.
    pub fn rows(&self) -> [(&'static str, &'static str, Spread); 8] {
        [
            ("copy of floats", "GB/s", self.copy_f32),
            ("copy of vec4s", "GB/s", self.copy_vec4),
            ("copy of vec4s in a cache", "GB/s", self.copy_cached),
            ("fused multiply-adds", "G/s", self.fma),
            ("exponentials", "G/s", self.exp),
            ("empty dispatch", "us", self.dispatch),
            ("dispatch to dispatch", "us", self.spacing),
            ("barrier, beyond that", "us", self.barrier),
        ]
    }
}

struct Probe<'g> {
    gpu: &'g Gpu,
    from: Buffer<f32>,
    to: Buffer<f32>,
    start: Buffer<f32>,
    sums: Buffer<f32>,
    words: Vec<Buffer<u32>>,
}

/// Nanoseconds from the first pass's start to the last one's end.
pub(super) fn span(passes: &[Timing]) -> f64 {
    let start = passes.first().map_or(0.0, |pass| pass.start);
    passes.iter().map(|pass| pass.start + pass.duration - start).fold(0.0, f64::max)
}

impl<'g> Probe<'g> {
    fn new(gpu: &'g Gpu) -> Result<Self, Error> {
        // A quarter of what is free, so that the copies leave room for what is measured beside them.
        let most = gpu.info().max_binding_bytes.min(gpu.available_bytes() / 4).min(COPIED);
        let len = (most / 16 * 4).max(4) as usize;
        let start: Vec<f32> = (0..THREADS).map(|i| i as f32 / THREADS as f32).collect();
        let probe = Self {
            gpu,
            from: gpu.buffer("copied", len)?,
            to: gpu.buffer("copy", len)?,
            start: gpu.upload("start", &start)?,
            sums: gpu.buffer("sums", start.len())?,
            words: (0..DISPATCHES).map(|_| gpu.upload("word", &[0])).collect::<Result<_, _>>()?,
        };
        // Pages that were never written may all be the same one.
        let mut rec = gpu.recorder()?;
        rec.fill(&probe.from, 1f32.to_bits());
        rec.fill(&probe.to, 0);
        rec.submit()?.wait()?;
        Ok(probe)
    }

    /// Nanoseconds of a copy of so many floats.
    fn copy(&self, vectors: bool, len: usize) -> Result<f64, Error> {
        let mut rec = self.gpu.recorder()?;
        let (kernel, n) = match vectors {
            true => (ceilings_copy::Kernel::Vec4, len as u32 / 4),
            false => (ceilings_copy::Kernel::Plain, len as u32),
        };
        let buffers = ceilings_copy::Buffers { from: &self.from, to: &self.to };
        rec.run(kernel, buffers, ceilings_copy::Push { n }, n.div_ceil(4));
        Ok(span(&rec.submit()?.wait()?))
    }

    fn fma(&self, rounds: u32) -> Result<f64, Error> {
        let mut rec = self.gpu.recorder()?;
        let buffers = ceilings_fma::Buffers { start: &self.start, sums: &self.sums };
        rec.run(ceilings_fma::Kernel, buffers, ceilings_fma::Push { n: THREADS, rounds, a: 0.5, b: 0.25 }, THREADS);
        Ok(span(&rec.submit()?.wait()?))
    }

    fn exp(&self, rounds: u32) -> Result<f64, Error> {
        let mut rec = self.gpu.recorder()?;
        let buffers = ceilings_exp::Buffers { start: &self.start, sums: &self.sums };
        rec.run(ceilings_exp::Kernel, buffers, ceilings_exp::Push { n: THREADS, rounds }, THREADS);
        Ok(span(&rec.submit()?.wait()?))
    }

    /// Empty dispatches in a row, each on a word of its own or, with barriers in between, all on the same.
    fn empty(&self, barriers: bool) -> Result<Vec<Timing>, Error> {
        let mut rec = self.gpu.recorder()?;
        for word in &self.words {
            let word = if barriers { &self.words[0] } else { word };
            rec.run(ceilings_empty::Kernel, ceilings_empty::Buffers { word }, ceilings_empty::Push { add: 0 }, 1u32);
        }
        rec.submit()?.wait()
    }
}

/// Rounds with which a run takes long enough.
fn calibrate(mut run: impl FnMut(u32) -> Result<f64, Error>) -> Result<u32, Error> {
    let mut rounds = 1;
    // The first run compiles and warms up.
    run(rounds)?;
    while run(rounds)? < LONG_ENOUGH * 1e6 && rounds < 1 << 20 {
        rounds *= 2;
    }
    Ok(rounds)
}

/// The stage that the ceilings' own arrays belong to.
pub const STAGE: &str = "ceilings";

/// Measures ceilings, a round at a time.
pub struct Prober<'g> {
    probe: Probe<'g>,
    fmas: u32,
    exps: u32,
    /// Floats copied in one go.
    few: usize,
    rounds: [Vec<f64>; 8],
}

impl<'g> Prober<'g> {
    /// On a device that has timestamps: finds out how much work takes long enough.
    ///
    /// # Errors
    /// When the device has no room for the arrays.
    pub fn new(gpu: &'g Gpu) -> Result<Self, Error> {
        let probe = gpu.stage(STAGE, || Probe::new(gpu))?;
        let fmas = calibrate(|rounds| probe.fma(rounds))?;
        let exps = calibrate(|rounds| probe.exp(rounds))?;
        let few = probe.from.len().min((CACHED / 4) as usize);
        probe.copy(false, probe.from.len())?;
        probe.copy(true, probe.from.len())?;
        probe.copy(true, few)?;
        probe.empty(false)?;
        probe.empty(true)?;
        Ok(Self { probe, fmas, exps, few, rounds: Default::default() })
    }

    /// One round.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn round(&mut self) -> Result<(), Error> {
        let Self { probe, fmas, exps, few, .. } = self;
        let bytes = |floats: usize| 8.0 * floats as f64;
        let per_thread = |rounds: u32, each: u32| f64::from(THREADS) * f64::from(rounds) * f64::from(each);
        let empty = probe.empty(false)?;
        let behind_barriers = probe.empty(true)?;
        let spacing = |passes: &[Timing]| {
            let starts: Vec<f64> = passes.windows(2).map(|pair| (pair[1].start - pair[0].start) * 1e-3).collect();
            Spread::of(&starts).median
        };
        let durations: Vec<f64> = empty.iter().map(|pass| pass.duration * 1e-3).collect();
        let dispatch = Spread::of(&durations).median;
        let all_of_it = probe.from.len();
        let cached = probe.copy(true, *few)?;
        let values = [
            bytes(all_of_it) / probe.copy(false, all_of_it)?,
            bytes(all_of_it) / probe.copy(true, all_of_it)?,
            // A dispatch that was slow just then must not take all of it.
            bytes(*few) / (cached - dispatch * 1e3).max(0.5 * cached),
            per_thread(*fmas, FMAS) / probe.fma(*fmas)?,
            per_thread(*exps, EXPS) / probe.exp(*exps)?,
            dispatch,
            spacing(&empty),
            (spacing(&behind_barriers) - spacing(&empty)).max(0.0),
        ];
        for (list, value) in self.rounds.iter_mut().zip(values) {
            list.push(value);
        }
        Ok(())
    }

    /// What the rounds so far say.
    ///
    /// # Panics
    /// Without a round.
    pub fn ceilings(&self) -> Ceilings {
        let [copy_f32, copy_vec4, copy_cached, fma, exp, dispatch, spacing, barrier] =
            self.rounds.each_ref().map(|values| Spread::of(values));
        Ceilings { copy_f32, copy_vec4, copy_cached, fma, exp, dispatch, spacing, barrier }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};
    use crate::skip::{Lack, skip};

    fn ramp(n: usize) -> Vec<f32> {
        (0..n).map(|i| 0.1 + 0.8 * i as f32 / n.max(1) as f32).collect()
    }

    #[test]
    fn kernels_against_their_twins() {
        let gpu = testing::gpu();
        for n in [0usize, 1, 63, 64, 65, 255, 256, 257, 1000] {
            // Something behind the end, which must stay.
            let to = vec![testing::UNWRITTEN; n + 5];
            let push = ceilings_copy::Push { n: n as u32 };
            for (kernel, floats) in [(ceilings_copy::Kernel::Plain, n + 5), (ceilings_copy::Kernel::Vec4, 4 * (n + 5))]
            {
                let case = ceilings_copy::Arrays { from: ramp(floats), to: vec![testing::UNWRITTEN; floats] };
                testing::assert_twin(kernel, &gpu, case, push, n.div_ceil(4));
            }
            for rounds in [0, 1, 3] {
                let case = ceilings_fma::Arrays { start: ramp(n + 5), sums: to.clone() };
                let push = ceilings_fma::Push { n: n as u32, rounds, a: 0.4375, b: 0.3 };
                testing::assert_twin(ceilings_fma::Kernel, &gpu, case, push, n);
                let case = ceilings_exp::Arrays { start: ramp(n + 5), sums: to.clone() };
                testing::assert_twin(ceilings_exp::Kernel, &gpu, case, ceilings_exp::Push { n: n as u32, rounds }, n);
            }
        }
        for add in [0, 3] {
            let case = ceilings_empty::Arrays { word: vec![4] };
            testing::assert_twin(ceilings_empty::Kernel, &gpu, case, ceilings_empty::Push { add }, 1u32);
        }
    }

    #[test]
    fn ceilings_are_numbers() {
        let gpu = testing::fresh_gpu(Options { timestamps: true, ..Options::default() });
        if gpu.info().timestamp_period <= 0.0 {
            skip(Lack::Timestamps, &format!("{} has no timestamps", gpu.info().name));
            return;
        }
        let mut prober = Prober::new(&gpu).expect("the device has room");
        (0..2).for_each(|_| prober.round().expect("the device is there"));
        let ceilings = prober.ceilings();
        for (name, unit, spread) in ceilings.rows() {
            assert!(spread.median.is_finite() && spread.repetitions == 2, "{name}: {spread:?} {unit}");
            assert!(spread.min > 0.0 || name.starts_with("barrier"), "{name}: {spread:?} {unit}");
        }
        assert!(ceilings.rates().bandwidth >= ceilings.copy_f32.max);
        assert_eq!(gpu.stages()[STAGE].0, 4 + DISPATCHES);
    }
}

//! Recording passes: barriers, labels, timestamps and markers come from one function.

mod mode;
mod submission;

use std::collections::BTreeMap;

use ash::vk;

use super::commands::{Command, Commands, Dispatch, Work, Workgroups};
use super::context::{Context, MAX_PASSES};
use super::device::{Gpu, lock};
use super::error::{Error, Named};
use super::hazards::{self, Entry, Hazards, Id, Schedule};
use super::kernel::{Access, Interface, Reference, Twin, with_twin};
use super::memory::{Buffer, Slot};
use super::witness::Case;
use mode::Mode;
use submission::Target;

pub use mode::NotFinite;
pub use submission::Submission;

/// A kernel with what one dispatch gives it, without its types.
#[derive(Clone, Copy)]
pub(super) struct Call<'c> {
    pub kernel: &'static Interface,
    /// Specialisation constants.
    pub constants: &'c [u8],
    /// Push constants.
    pub push: &'c [u8],
    /// The buffers, by binding.
    pub slots: &'c [Slot],
}

/// How many threads a pass has. Dispatch takes threads, never groups.
#[derive(Clone, Copy)]
pub enum Threads<'a> {
    /// So many in a line; kernels number them with `thread_index()`.
    Line(u64),
    /// A grid.
    Grid([u32; 3]),
    /// As many as a count on the device says.
    Counted(&'a Groups),
}

impl From<u32> for Threads<'_> {
    fn from(n: u32) -> Self {
        Threads::Line(n.into())
    }
}
impl From<usize> for Threads<'_> {
    fn from(n: usize) -> Self {
        Threads::Line(n as u64)
    }
}
impl From<[u32; 2]> for Threads<'_> {
    fn from([x, y]: [u32; 2]) -> Self {
        Threads::Grid([x, y, 1])
    }
}
impl From<[u32; 3]> for Threads<'_> {
    fn from(grid: [u32; 3]) -> Self {
        Threads::Grid(grid)
    }
}
impl<'a> From<&'a Groups> for Threads<'a> {
    fn from(groups: &'a Groups) -> Self {
        Threads::Counted(groups)
    }
}

/// Workgroup counts on the device (x, y, z, and the count they come from), written by `primitives/dispatch`.
#[derive(Debug)]
pub struct Groups {
    /// x, y, z of the dispatch, then the clamped count; of each of several dispatches of one count.
    pub buffer: Buffer<u32>,
    /// Which of them.
    pub at: u32,
    /// Threads of the workgroups they are meant for.
    pub group: u32,
}

/// Records passes. The first error is kept and returned by [`Recorder::submit`], so that a step reads as plain lines.
pub struct Recorder<'g> {
    gpu: &'g Gpu,
    /// The place that the passes go to, until they are submitted.
    target: Option<Target>,
    hazards: Hazards,
    schedule: Schedule,
    noted: Vec<Command>,
    passes: Vec<&'static str>,
    stage: &'static str,
    error: Option<Error>,
    mode: Mode,
    /// Passes that wait to be put in order: see [`Recorder::overlapped`].
    held: Option<Vec<Held>>,
}

/// A pass that was recorded and has no place yet.
struct Held {
    name: &'static str,
    stage: &'static str,
    accesses: Vec<(Id, &'static str, Access)>,
    work: Option<Work>,
}

impl Gpu {
    /// A new recording.
    ///
    /// # Errors
    /// When the device has no memory for a command buffer.
    pub fn recorder(&self) -> Result<Recorder<'_>, Error> {
        self.recorder_in(Mode::Together)
    }

    fn recorder_in(&self, mode: Mode) -> Result<Recorder<'_>, Error> {
        let mut recorder = Recorder {
            gpu: self,
            target: Some(self.target()?),
            stage: self.ledger().stage(),
            hazards: Hazards::default(),
            schedule: Schedule::default(),
            noted: vec![],
            passes: vec![],
            error: None,
            mode,
            held: None,
        };
        recorder.begin();
        Ok(recorder)
    }

    fn target(&self) -> Result<Target, Error> {
        match self.rehearsing() {
            Some(rehearsal) => {
                rehearsal.began();
                Ok(Target::Books(rehearsal.clone()))
            }
            None => Ok(Target::Device(self.begun_context()?)),
        }
    }

    /// A context in recording, which counts as used from now on.
    fn begun_context(&self) -> Result<Context, Error> {
        let inner = self.inner();
        let context = lock(&inner.contexts).pop();
        let mut context = context.map_or_else(|| Context::new(self), Ok)?;
        // From here on the device may come to use whatever is recorded: dropped buffers wait.
        inner.began();
        // SAFETY: not in flight: it is new, or it came from the list of those that were waited for.
        if let Err(error) = unsafe { context.begin(&inner.device) } {
            lock(&inner.contexts).push(context);
            inner.ended();
            return Err(error);
        }
        Ok(context)
    }
}

impl<'g> Recorder<'g> {
    /// The device it records for.
    pub fn gpu(&self) -> &'g Gpu {
        self.gpu
    }

    /// What is recorded from now on belongs to this stage.
    pub fn stage(&mut self, stage: &'static str) {
        self.stage = stage;
    }

    /// Records what `record` records, each pass as early as what it reads and writes allows: passes that need not wait for
    /// one another come between the same two barriers, whoever recorded them first. Any two that touch the same buffer, one of
    /// them to write it, keep their order, so that the result is the same. Recordings that run pass by pass keep the order of
    /// all.
    pub fn overlapped<T>(&mut self, record: impl FnOnce(&mut Self) -> T) -> T {
        let pass_by_pass = !matches!(self.mode, Mode::Together) || self.gpu.options().one_by_one();
        if pass_by_pass || self.held.is_some() {
            return record(self);
        }
        self.held = Some(vec![]);
        let result = record(self);
        let held = self.held.take().unwrap_or_default();
        let made = self.gpu.inner().compile_all(held.iter().filter_map(|pass| match &pass.work {
            Some(Work::Dispatch(dispatch)) => Some(&dispatch.pipeline),
            _ => None,
        }));
        if made.is_err() {
            self.keep(made);
            return result;
        }
        let waves = hazards::waves(held.iter().map(|pass| pass.accesses.as_slice()));
        let mut ordered: Vec<(u32, Held)> = waves.into_iter().zip(held).collect();
        ordered.sort_by_key(|(wave, _)| *wave);
        for (_, Held { name, stage, accesses, work }) in ordered {
            self.place(name, stage, &accesses, work.as_ref());
        }
        result
    }

    /// Runs kernel `K` with default constants on so many threads.
    pub fn run<'t, K: Reference>(
        &mut self,
        kernel: K,
        buffers: K::Buffers<'_>,
        push: K::Push,
        threads: impl Into<Threads<'t>>,
    ) {
        self.run_with(kernel, K::Constants::default(), buffers, push, threads);
    }

    /// Runs kernel `K` with these specialisation constants.
    pub fn run_with<'t, K: Reference>(
        &mut self,
        kernel: K,
        constants: K::Constants,
        buffers: K::Buffers<'_>,
        push: K::Push,
        threads: impl Into<Threads<'t>>,
    ) {
        if self.error.is_some() {
            return;
        }
        let (slots, threads) = (K::slots(&buffers), threads.into());
        let variant = kernel.variant(&slots);
        let call = Call {
            kernel: variant,
            constants: &variant.own_constants(bytemuck::bytes_of(&constants)),
            push: &bytemuck::bytes_of(&push)[..variant.push_bytes as usize],
            slots: &variant.collect(slots),
        };
        let result = with_twin(kernel, variant, push, constants, |twin| self.try_run(call, twin, threads));
        self.keep(result);
    }

    fn keep(&mut self, result: Result<(), Error>) {
        if let Err(error) = result {
            self.error.get_or_insert(error);
        }
    }

    fn try_run(&mut self, call: Call<'_>, twin: Twin<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let Call { kernel: Interface { name, bindings, .. }, slots, .. } = call;
        for (i, a) in slots.iter().enumerate() {
            for (j, b) in slots.iter().enumerate().skip(i + 1) {
                let written = bindings[i].access.writes() || bindings[j].access.writes();
                assert!(a.raw != b.raw || !written, "{name}: {} is bound twice, once for writing", a.name);
            }
        }
        self.run_by_mode(call, twin, threads)
    }

    fn words(&self, slot: Slot) -> Result<Vec<u32>, Error> {
        self.gpu.read_words(slot, slot.bytes)
    }

    fn download(&self, slots: &[Slot]) -> Result<Vec<Vec<u32>>, Error> {
        slots.iter().map(|slot| self.words(*slot)).collect()
    }

    /// Keeps a dispatch where the device was opened for it.
    fn witness(&mut self, call: Call<'_>, twin: Twin<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let Call { kernel, constants, push, slots } = call;
        if self.gpu.rehearsing().is_some() || !self.gpu.wants_case(kernel, constants) {
            return Ok(());
        }
        self.flush()?;
        let workgroups = match threads {
            Threads::Counted(counted) => {
                let (all, at) = (self.gpu.read(&counted.buffer)?, 4 * counted.at as usize);
                [all[at], all[at + 1], all[at + 2]]
            }
            _ => self.workgroups(kernel, threads),
        };
        if !workgroups.contains(&0) {
            let (size, before) = (self.gpu.inner().subgroup_size(kernel), self.download(slots)?);
            let case = Case::new(kernel, (constants, push), workgroups, size, before, twin);
            lock(&self.gpu.inner().cases).push(case);
        }
        Ok(())
    }

    /// Workgroups of a dispatch; one where a count on the device says how many.
    fn workgroups(&self, kernel: &Interface, threads: Threads<'_>) -> [u32; 3] {
        let group = kernel.group;
        match threads {
            Threads::Line(n) => {
                let groups = n.div_ceil(group[0].into());
                let limit = u64::from(self.gpu.info().max_groups.min(65535));
                if groups <= limit { [groups as u32, 1, 1] } else { [limit as u32, groups.div_ceil(limit) as u32, 1] }
            }
            Threads::Grid(grid) => std::array::from_fn(|i| grid[i].div_ceil(group[i])),
            Threads::Counted(counted) => {
                assert_eq!(group, [counted.group, 1, 1], "{}: counted for groups of {}", kernel.name, counted.group);
                [1, 1, 1]
            }
        }
    }

    pub(super) fn dispatch(&mut self, call: Call<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let Call { kernel, constants, push, slots } = call;
        let Interface { name, bindings, .. } = *kernel;
        let groups = self.workgroups(kernel, threads);
        if groups.contains(&0) {
            return Ok(());
        }
        let mut accesses: Vec<(Id, &'static str, Access)> =
            slots.iter().zip(bindings).map(|(s, b)| (s.id(), s.name, b.access)).collect();
        if let Threads::Counted(counted) = threads {
            accesses.push((counted.buffer.slot().id(), counted.buffer.name(), Access::Read));
        }
        let inner = self.gpu.inner();
        if let Some(Target::Books(rehearsal)) = &self.target {
            rehearsal.pipeline(name);
            if self.gpu.options().statistics {
                let pipeline = inner.pipeline(kernel, constants)?;
                inner.compile(&pipeline)?;
            }
            self.pass(name, &accesses, None);
            return Ok(());
        }
        let pipeline = inner.pipeline(kernel, constants)?;
        // Passes that are held are compiled together, on several threads.
        if self.held.is_none() {
            inner.compile(&pipeline)?;
        }
        let set = match (&inner.push_descriptor, &mut self.target) {
            (None, Some(Target::Device(context))) => {
                let set = context.sets.get(&inner.device, pipeline.set, bindings, slots);
                set.named("making a descriptor set")?
            }
            _ => vk::DescriptorSet::null(),
        };
        let workgroups = match threads {
            Threads::Counted(counted) => Workgroups::At(counted.buffer.slot().raw, 16 * u64::from(counted.at)),
            _ => Workgroups::Known(groups),
        };
        let (slots, push) = (slots.to_vec(), push.to_vec());
        let dispatch = Dispatch { pipeline, bindings, slots, set, push, workgroups };
        self.pass(name, &accesses, Some(Work::Dispatch(dispatch)));
        Ok(())
    }

    /// Sets every word of a buffer.
    pub fn fill<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, word: u32) {
        self.fill_slot(buffer.slot(), word);
    }

    pub(super) fn fill_slot(&mut self, slot: Slot, word: u32) {
        let work = Work::Fill { to: slot.raw, at: 0, bytes: vk::WHOLE_SIZE, word };
        self.pass("fill", &[(slot.id(), slot.name, Access::Write)], Some(work));
    }

    /// Sets a buffer to zero.
    pub fn zero<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>) {
        self.fill(buffer, 0);
    }

    /// Sets `len` elements from `at` on to zero.
    pub fn zero_range<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, at: usize, len: usize) {
        self.fill_range(buffer, at, len, 0);
    }

    /// Sets every word of `len` elements from `at` on.
    pub fn fill_range<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, at: usize, len: usize, word: u32) {
        assert!(at + len <= buffer.len(), "fill {len} from {at} of {buffer:?}");
        if len == 0 {
            return;
        }
        let slot = buffer.slot();
        let [at, bytes] = [at, len].map(|n| (n * size_of::<T>()) as u64);
        let work = Work::Fill { to: slot.raw, at, bytes, word };
        self.pass("fill", &[(slot.id(), slot.name, Access::Write)], Some(work));
    }

    /// Copies the first `len` elements.
    pub fn copy<T: bytemuck::Pod>(&mut self, from: &Buffer<T>, to: &Buffer<T>, len: usize) {
        assert!(len <= from.len() && len <= to.len(), "copy of {len} from {from:?} to {to:?}");
        self.copy_bytes(from.slot(), to.slot(), (len * size_of::<T>()) as u64);
    }

    /// Copies `len` elements starting at `from_at` to `to_at`.
    pub fn copy_range<T: bytemuck::Pod>(
        &mut self,
        from: &Buffer<T>,
        from_at: usize,
        to: &Buffer<T>,
        to_at: usize,
        len: usize,
    ) {
        assert!(from_at + len <= from.len() && to_at + len <= to.len(), "copy of {len} from {from:?} to {to:?}");
        let size = size_of::<T>() as u64;
        self.copy_region(from.slot(), from_at as u64 * size, to.slot(), to_at as u64 * size, len as u64 * size);
    }

    pub(super) fn copy_bytes(&mut self, from: Slot, to: Slot, bytes: u64) {
        self.copy_region(from, 0, to, 0, bytes);
    }

    fn copy_region(&mut self, from: Slot, from_at: u64, to: Slot, to_at: u64, bytes: u64) {
        if bytes == 0 {
            return;
        }
        let accesses = [(from.id(), from.name, Access::Read), (to.id(), to.name, Access::Write)];
        let region = vk::BufferCopy { src_offset: from_at, dst_offset: to_at, size: bytes };
        self.pass("copy", &accesses, Some(Work::Copy { from: from.raw, to: to.raw, region }));
    }

    /// Gives a pass its place: the next one, or one that is found later. A pass of a rehearsal has no work.
    fn pass(&mut self, name: &'static str, accesses: &[(Id, &'static str, Access)], work: Option<Work>) {
        if self.error.is_some() {
            return;
        }
        let stage = self.stage;
        match &mut self.held {
            Some(held) => held.push(Held { name, stage, accesses: accesses.to_vec(), work }),
            None => self.place(name, stage, accesses, work.as_ref()),
        }
    }

    /// Everything around a pass: the barrier it needs, its label, marker and timestamps.
    fn place(
        &mut self,
        name: &'static str,
        stage: &'static str,
        accesses: &[(Id, &'static str, Access)],
        work: Option<&Work>,
    ) {
        let inner = self.gpu.inner();
        let reasons = self.hazards.enter(name, accesses, inner.options.one_by_one());
        let waits = !reasons.is_empty();
        if waits {
            self.schedule.entries.push(Entry::Barrier { reasons });
        }
        let listed = accesses.iter().map(|(_, buffer, access)| (*buffer, *access)).collect();
        self.schedule.entries.push(Entry::Pass { name, stage, accesses: listed });
        let context = match self.target.as_ref().expect("there until it is submitted") {
            Target::Device(context) => context,
            Target::Books(rehearsal) => return rehearsal.pass(stage, name),
        };
        let mut commands = Commands { inner, raw: context.commands, noted: &mut self.noted };
        if waits && !inner.options.omit_barriers {
            commands.barrier();
        }
        let index = self.passes.len() as u32;
        let tracked = index < MAX_PASSES;
        let timed = tracked && inner.options.timestamps && inner.info.timestamp_period > 0.0;
        commands.begin_label(name);
        if timed {
            commands.timestamp(context.queries, 2 * index);
        }
        commands.work(work.expect("a pass of a rehearsal ended above"));
        if timed {
            commands.timestamp(context.queries, 2 * index + 1);
        }
        if let Some((markers, _)) = context.markers.as_ref().filter(|_| tracked) {
            commands.marker(*markers, index);
        }
        commands.end_label();
        self.passes.push(name);
    }

    /// Resets timestamps and markers, and records the barrier behind what earlier submissions wrote.
    fn begin(&mut self) {
        let inner = self.gpu.inner();
        let Some(Target::Device(context)) = &self.target else { return };
        self.noted.clear();
        let mut commands = Commands { inner, raw: context.commands, noted: &mut self.noted };
        if inner.options.timestamps {
            commands.reset(context.queries, 2 * MAX_PASSES);
        }
        if let Some((markers, _)) = &context.markers {
            commands.clear_markers(*markers);
        }
        // What earlier submissions wrote, and the markers' reset, come before everything here.
        commands.barrier();
        self.hazards = Hazards::default();
        self.passes.clear();
    }

    /// Ends the recording and gives it to the device.
    ///
    /// # Errors
    /// The first error met while recording, or the device's refusal.
    pub fn submit(mut self) -> Result<Submission<'g>, Error> {
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        let mut submission = self.hand_over();
        submission.schedule = std::mem::take(&mut self.schedule);
        match std::mem::take(&mut self.mode) {
            Mode::Checked(differences) => submission.differences = differences,
            Mode::Traced(trace) => submission.trace = trace.found,
            Mode::Together | Mode::Inspected(_) => {}
        }
        submission.start()?;
        Ok(submission)
    }

    /// Takes out the passes that were recorded since the last submission.
    fn hand_over(&mut self) -> Submission<'g> {
        Submission {
            gpu: self.gpu,
            target: self.target.take(),
            submitted: false,
            passes: std::mem::take(&mut self.passes),
            schedule: Schedule::default(),
            commands: std::mem::take(&mut self.noted),
            differences: vec![],
            trace: BTreeMap::new(),
        }
    }

    /// What was recorded so far, without running it.
    pub fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    /// Runs what was recorded so far, to its end, and goes on behind it. Buffers that were dropped meanwhile are free then.
    ///
    /// # Errors
    /// As [`Recorder::submit`] and [`Submission::wait`].
    pub fn flush(&mut self) -> Result<(), Error> {
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        let mut submission = self.hand_over();
        submission.start()?;
        submission.wait()?;
        self.target = Some(self.gpu.target()?);
        self.begin();
        Ok(())
    }

    /// Flushes if a buffer of so many bytes beside what was dropped would take more memory than there ever was.
    ///
    /// # Errors
    /// As [`Recorder::flush`].
    pub fn make_room(&mut self, bytes: u64) -> Result<(), Error> {
        let (now, peak) = self.gpu.memory();
        if now + bytes > peak { self.flush() } else { Ok(()) }
    }

    /// A copy of a buffer as it is at this point, on the host: once this was run [`Gpu::read`] gives it and submits nothing.
    ///
    /// # Errors
    /// As [`Gpu::readback`].
    pub fn read_back<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>) -> Result<Buffer<T>, Error> {
        let host = self.gpu.readback(buffer.name(), buffer.len())?;
        self.copy(buffer, &host, buffer.len());
        Ok(host)
    }
}

impl Drop for Recorder<'_> {
    fn drop(&mut self) {
        match self.target.take() {
            Some(Target::Device(context)) => {
                // SAFETY: recording, never submitted; ending it makes it reusable.
                let _ = unsafe { self.gpu.inner().device.end_command_buffer(context.commands) };
                lock(&self.gpu.inner().contexts).push(context);
                self.gpu.inner().ended();
            }
            Some(Target::Books(rehearsal)) => rehearsal.ended(),
            None => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::testing;

    /// Fills and copies among a few buffers, drawn at random: overlapped they come to what they come to one by one.
    #[test]
    fn overlapped_passes_come_to_the_same_behind_fewer_barriers() {
        let gpu = testing::gpu();
        let mut saved = 0;
        for seed in 0..40 {
            let run = |overlapped: bool| {
                let buffers: [Buffer<u32>; 6] =
                    std::array::from_fn(|i| gpu.upload("words", &[i as u32; 5]).expect("room"));
                let passes = |rec: &mut Recorder<'_>| {
                    let mut rng = Pcg64Mcg::seed_from_u64(seed);
                    for word in 100..130 {
                        let [from, to] = [0, 1].map(|_| rng.random_range(0..buffers.len()));
                        if from == to {
                            rec.zero_range(&buffers[to], 1, 2);
                            rec.fill(&buffers[(to + 1) % 6], word);
                        } else {
                            rec.copy_range(&buffers[from], 1, &buffers[to], 0, 4);
                        }
                    }
                };
                let mut rec = gpu.recorder().expect("a recorder");
                if overlapped {
                    rec.overlapped(passes)
                } else {
                    passes(&mut rec)
                }
                let (count, barriers) = (rec.schedule().passes(), rec.schedule().barriers());
                rec.submit().and_then(Submission::wait).expect("the device runs it");
                (buffers.map(|buffer| gpu.read(&buffer).expect("readable")), count, barriers)
            };
            let (want, count, barriers) = run(false);
            let (got, overlapped_count, overlapped) = run(true);
            assert_eq!((got, overlapped_count), (want, count), "seed {seed}");
            assert!(overlapped <= barriers, "seed {seed}: {overlapped} barriers instead of {barriers}");
            saved += barriers - overlapped;
        }
        assert!(saved > 40, "{saved} barriers fewer");
    }
}

//! Recording passes: barriers, labels, timestamps and markers come from one function.

use std::collections::BTreeMap;
use std::sync::Arc;

use ash::vk;

use super::check::Difference;
use super::commands::{Command, Commands, Dispatch, Work, Workgroups};
use super::context::{Context, MAX_PASSES};
use super::device::{Gpu, lock};
use super::error::{Error, Named};
use super::hazards::{self, Entry, Hazards, Id, Schedule};
use super::kernel::{Access, Interface, Reference, Scalar, Twin, with_twin};
use super::ledger::Rehearsal;
use super::memory::{Buffer, Slot};
use super::timings::Timing;
use super::witness::Case;

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
    context: Option<Context>,
    hazards: Hazards,
    schedule: Schedule,
    noted: Vec<Command>,
    passes: Vec<&'static str>,
    stage: &'static str,
    /// In a rehearsal, in place of a context.
    rehearsal: Option<Arc<Rehearsal>>,
    error: Option<Error>,
    differences: Option<Vec<Difference>>,
    inspection: Option<Option<NotFinite>>,
    trace: Option<Trace>,
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

/// The first value that is not finite, of an inspected recording.
#[derive(Clone, Debug, PartialEq)]
pub struct NotFinite {
    /// The pass that wrote it.
    pub pass: &'static str,
    /// The pass's name for the array.
    pub tensor: &'static str,
    /// Its float in the array.
    pub index: usize,
    /// NaN or an infinity.
    pub value: f32,
}

/// What a traced recording keeps.
struct Trace {
    wanted: &'static [&'static str],
    found: BTreeMap<&'static str, Vec<u32>>,
    twins: bool,
}

/// Work given to the device.
#[must_use = "wait() frees what the submission holds"]
pub struct Submission<'g> {
    gpu: &'g Gpu,
    context: Option<Context>,
    /// The queue has taken it.
    submitted: bool,
    rehearsal: Option<Arc<Rehearsal>>,
    passes: Vec<&'static str>,
    /// What was recorded.
    pub schedule: Schedule,
    /// What the device was given for it, in this order. A submission begins with a barrier and ends with one to the host.
    pub commands: Vec<Command>,
    /// GPU against twin, of a checked recording.
    pub differences: Vec<Difference>,
    /// The wanted buffers of a traced recording by name, as the last pass that wrote them left them.
    pub trace: BTreeMap<&'static str, Vec<u32>>,
}

impl Gpu {
    /// A new recording.
    ///
    /// # Errors
    /// When the device has no memory for a command buffer.
    pub fn recorder(&self) -> Result<Recorder<'_>, Error> {
        let rehearsal = self.rehearsing().cloned();
        // From here on the device may come to use whatever is recorded: dropped buffers wait.
        let context = match &rehearsal {
            Some(rehearsal) => {
                rehearsal.began();
                None
            }
            None => {
                let context = lock(&self.inner().contexts).pop();
                let context = context.map_or_else(|| Context::new(self), Ok)?;
                self.inner().began();
                Some(context)
            }
        };
        let mut recorder = Recorder {
            gpu: self,
            context,
            stage: self.ledger().stage(),
            rehearsal,
            hazards: Hazards::default(),
            schedule: Schedule::default(),
            noted: vec![],
            passes: vec![],
            error: None,
            differences: None,
            inspection: None,
            trace: None,
            held: None,
        };
        recorder.begin()?;
        Ok(recorder)
    }

    /// A recording in which every pass runs at once, and its CPU twin on the same inputs beside it.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    ///
    /// # Panics
    /// In a rehearsal, which has no numbers to compare.
    pub fn checked(&self) -> Result<Recorder<'_>, Error> {
        assert!(self.rehearsing().is_none(), "a rehearsal has no numbers to compare");
        let mut recorder = self.recorder()?;
        recorder.differences = Some(vec![]);
        Ok(recorder)
    }

    /// A recording in which every pass runs at once, and what it wrote is searched for values that are not finite. With
    /// the first one found the device's work ends: [`Recorder::not_finite`] names it.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn inspected(&self) -> Result<Recorder<'_>, Error> {
        let mut recorder = self.recorder()?;
        recorder.inspection = Some(None);
        Ok(recorder)
    }

    /// A recording in which every pass runs at once, and which keeps the words of the buffers of these names. Elements
    /// that no pass writes are zero: a kernel that only writes such a buffer finds it zeroed the first time.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn traced(&self, wanted: &'static [&'static str]) -> Result<Recorder<'_>, Error> {
        let mut recorder = self.recorder()?;
        recorder.trace = Some(Trace { wanted, found: BTreeMap::new(), twins: false });
        Ok(recorder)
    }

    /// As [`Gpu::traced`], but the CPU twins run in the kernels' place: the reference path, float64 within a pass and
    /// float32 in the buffers between passes. Fills and copies remain the device's.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn reference(&self, wanted: &'static [&'static str]) -> Result<Recorder<'_>, Error> {
        let mut recorder = self.recorder()?;
        recorder.trace = Some(Trace { wanted, found: BTreeMap::new(), twins: true });
        Ok(recorder)
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
        let pass_by_pass = self.differences.is_some()
            || self.trace.is_some()
            || self.inspection.is_some()
            || self.gpu.options().one_by_one();
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
        match self.inspection {
            None => {}
            Some(None) => return self.inspect(call, threads),
            // Nothing behind it is worth running.
            Some(Some(_)) => return Ok(()),
        }
        if self.differences.is_none() && self.trace.is_none() {
            self.witness(call, twin, threads)?;
            return self.dispatch(call, threads);
        }
        self.flush()?;
        let wanted = |trace: &Trace, i: usize| bindings[i].access.writes() && trace.wanted.contains(&slots[i].name);
        if let Some(trace) = &self.trace {
            let fresh = |i: &usize| {
                let only_written = bindings[*i].access == Access::Write;
                only_written && wanted(trace, *i) && !trace.found.contains_key(slots[*i].name)
            };
            let fresh: Vec<usize> = (0..slots.len()).filter(fresh).collect();
            fresh.into_iter().for_each(|i| self.fill_slot(slots[i], 0));
            self.flush()?;
        }
        let twins = self.trace.as_ref().is_some_and(|trace| trace.twins);
        let mut words = if twins || self.differences.is_some() { self.download(slots)? } else { vec![] };
        if twins {
            (twin.reference)(&mut words);
            for ((slot, words), binding) in slots.iter().zip(&words).zip(bindings.iter()) {
                if binding.access.writes() {
                    self.gpu.write_words(*slot, words)?;
                }
            }
        } else {
            self.dispatch(call, threads)?;
            self.flush()?;
        }
        if let Some(differences) = &mut self.differences {
            (twin.reference)(&mut words);
            for ((binding, slot), want) in bindings.iter().zip(slots).zip(&words) {
                if binding.access.writes() {
                    let got = self.gpu.read_words(*slot, slot.bytes)?;
                    differences.push(Difference::of_words(name, twin, binding, &got, want));
                }
            }
        }
        if let Some(trace) = &mut self.trace {
            let written: Vec<&Slot> = (0..slots.len()).filter(|i| wanted(trace, *i)).map(|i| &slots[i]).collect();
            for slot in written {
                trace.found.insert(slot.name, self.gpu.read_words(*slot, slot.bytes)?);
            }
        }
        Ok(())
    }

    /// The first value that is not finite that a pass of this inspected recording wrote.
    pub fn not_finite(&self) -> Option<&NotFinite> {
        self.inspection.as_ref()?.as_ref()
    }

    /// Runs one pass and searches what it wrote. Arrays that it only writes hold a pattern meanwhile, so that what it left
    /// alone is told from what it wrote; in the others that is what has changed.
    fn inspect(&mut self, call: Call<'_>, threads: Threads<'_>) -> Result<(), Error> {
        const PATTERN: u32 = 0x7fa5_a5a5; // a NaN that no arithmetic makes
        let Call { kernel: Interface { name, bindings, .. }, slots, .. } = call;
        let written: Vec<(usize, &'static str, Access)> = (0..slots.len())
            .filter(|&i| bindings[i].access.writes() && bindings[i].scalar == Scalar::F32)
            .map(|i| (i, bindings[i].name, bindings[i].access))
            .collect();
        self.flush()?;
        let before = written.iter().map(|(i, ..)| self.words(slots[*i])).collect::<Result<Vec<_>, _>>()?;
        for ((i, ..), before) in written.iter().zip(&before).filter(|((.., access), _)| *access == Access::Write) {
            self.gpu.write_words(slots[*i], &vec![PATTERN; before.len()])?;
        }
        self.dispatch(call, threads)?;
        self.flush()?;
        for ((i, tensor, access), before) in written.into_iter().zip(before) {
            let mut after = self.words(slots[i])?;
            let left_alone = |after: u32, before: u32| after == if access == Access::Write { PATTERN } else { before };
            let broken =
                |(after, before): (&u32, &u32)| !f32::from_bits(*after).is_finite() && !left_alone(*after, *before);
            if let Some(index) = after.iter().zip(&before).position(broken) {
                let value = f32::from_bits(after[index]);
                let found = NotFinite { pass: name, tensor, index, value };
                self.inspection.as_mut().expect("an inspected recording").get_or_insert(found);
            }
            if access == Access::Write {
                after.iter_mut().zip(before).filter(|(a, _)| **a == PATTERN).for_each(|(a, before)| *a = before);
                self.gpu.write_words(slots[i], &after)?;
            }
        }
        Ok(())
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
        if self.rehearsal.is_some() || !self.gpu.wants_case(kernel, constants) {
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
            let (size, before) = (self.gpu.info().subgroup_size, self.download(slots)?);
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
        if let Some(rehearsal) = &self.rehearsal {
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
        let set = match (&inner.push_descriptor, &mut self.context) {
            (None, Some(context)) => {
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
        if let Some(rehearsal) = &self.rehearsal {
            rehearsal.pass(stage, name);
            return;
        }
        let context = self.context.as_ref().expect("a recorder has its context until it is submitted");
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

    fn begin(&mut self) -> Result<(), Error> {
        if self.rehearsal.is_some() {
            return Ok(());
        }
        let inner = self.gpu.inner();
        let context = self.context.as_mut().expect("begin comes before submit");
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the context is not in flight: it came from the free list or was waited for.
        unsafe {
            context.sets.recycle(&inner.device).named("recycling descriptor sets")?;
            inner.device.begin_command_buffer(context.commands, &info).named("beginning a command buffer")?;
        }
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
        Ok(())
    }

    /// Ends the recording and gives it to the device.
    ///
    /// # Errors
    /// The first error met while recording, or the device's refusal.
    pub fn submit(mut self) -> Result<Submission<'g>, Error> {
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        let mut submission = Submission {
            gpu: self.gpu,
            context: self.context.take(),
            submitted: false,
            rehearsal: self.rehearsal.take(),
            passes: std::mem::take(&mut self.passes),
            schedule: std::mem::take(&mut self.schedule),
            commands: std::mem::take(&mut self.noted),
            differences: self.differences.take().unwrap_or_default(),
            trace: self.trace.take().map(|trace| trace.found).unwrap_or_default(),
        };
        submission.start()?;
        Ok(submission)
    }

    /// What was recorded so far, without running it.
    pub fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    fn flush(&mut self) -> Result<(), Error> {
        let context = self.context.take().expect("flush comes before submit");
        let passes = std::mem::take(&mut self.passes);
        let mut submission = Submission {
            gpu: self.gpu,
            context: Some(context),
            submitted: false,
            rehearsal: None,
            passes,
            schedule: Schedule::default(),
            commands: std::mem::take(&mut self.noted),
            differences: vec![],
            trace: BTreeMap::new(),
        };
        submission.start()?;
        submission.wait()?;
        let context = lock(&self.gpu.inner().contexts).pop();
        self.context = Some(context.map_or_else(|| Context::new(self.gpu), Ok)?);
        self.gpu.inner().began();
        self.begin()
    }
}

impl Drop for Recorder<'_> {
    fn drop(&mut self) {
        if let Some(rehearsal) = self.rehearsal.take() {
            rehearsal.ended();
        }
        if let Some(context) = self.context.take() {
            // SAFETY: recording, never submitted; ending it makes it reusable.
            let _ = unsafe { self.gpu.inner().device.end_command_buffer(context.commands) };
            lock(&self.gpu.inner().contexts).push(context);
            self.gpu.inner().ended();
        }
    }
}

impl Submission<'_> {
    fn start(&mut self) -> Result<(), Error> {
        if self.rehearsal.is_some() {
            return Ok(());
        }
        let inner = self.gpu.inner();
        let context = self.context.as_ref().expect("a submission holds its context until it is waited for");
        Commands { inner, raw: context.commands, noted: &mut self.commands }.barrier_to_host();
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(context.commands)];
        let submit = [vk::SubmitInfo2::default().command_buffer_infos(&commands)];
        // SAFETY: the command buffer is in recording, its fence is new or was reset when it was last waited for, and the guard of
        // the queue is held.
        let result = unsafe {
            inner.device.end_command_buffer(context.commands).named("ending a command buffer")?;
            inner.device.queue_submit2(*lock(&inner.queue), &submit, context.fence)
        };
        self.submitted = result.is_ok();
        self.lost(result)
    }

    fn lost(&self, result: ash::prelude::VkResult<()>) -> Result<(), Error> {
        match result {
            Ok(()) => Ok(()),
            Err(vk::Result::ERROR_DEVICE_LOST) => {
                let context = self.context.as_ref().expect("held until waited for");
                let markers = context.markers.as_ref().and_then(|(_, allocation)| allocation.mapped_slice());
                Err(Error::DeviceLost { place: place_of_fault(&self.passes, markers) })
            }
            Err(result) => Err(Error::Vulkan { what: "submitting work", result }),
        }
    }

    /// Waits for the end and returns the time of every pass (empty unless the device was opened with timestamps).
    ///
    /// # Errors
    /// [`Error::DeviceLost`] with the pass, where faults are traced.
    pub fn wait(mut self) -> Result<Vec<Timing>, Error> {
        if self.rehearsal.is_some() {
            return Ok(vec![]);
        }
        let inner = self.gpu.inner().clone();
        let context = self.context.as_ref().expect("waited for once");
        // SAFETY: the fence was given to the queue in `start`.
        let result = unsafe { inner.device.wait_for_fences(&[context.fence], true, u64::MAX) };
        self.lost(result)?;
        let mut timings = vec![];
        if inner.options.timestamps && inner.info.timestamp_period > 0.0 {
            let timed = self.passes.len().min(MAX_PASSES as usize);
            let mut ticks = vec![0u64; 2 * timed];
            if timed > 0 {
                // SAFETY: the queries were reset and written by the finished command buffer.
                unsafe {
                    let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
                    inner
                        .device
                        .get_query_pool_results(context.queries, 0, &mut ticks, flags)
                        .named("reading timestamps")?;
                }
            }
            let period = f64::from(inner.info.timestamp_period);
            timings.extend(self.passes.iter().zip(ticks.chunks_exact(2)).map(|(name, t)| Timing {
                name,
                start: t[0] as f64 * period,
                duration: t[1].saturating_sub(t[0]) as f64 * period,
            }));
        }
        let context = self.context.take().expect("waited for once");
        // SAFETY: the fence is signalled and nobody else waits for it.
        unsafe { inner.device.reset_fences(&[context.fence]) }.named("resetting a fence")?;
        lock(&inner.contexts).push(context);
        inner.ended();
        Ok(timings)
    }

    /// True when the device has finished it.
    pub fn is_done(&self) -> bool {
        let inner = self.gpu.inner();
        // SAFETY: a live fence.
        self.context.as_ref().is_none_or(|c| unsafe { inner.device.get_fence_status(c.fence) }.unwrap_or(true))
    }
}

/// Whether a wait for a fence came to its end: nothing runs after it, or the device is lost and nothing runs any more. After
/// any other failure the work may be in flight still.
fn is_over(waited: ash::prelude::VkResult<()>) -> bool {
    matches!(waited, Ok(()) | Err(vk::Result::ERROR_DEVICE_LOST))
}

impl Drop for Submission<'_> {
    fn drop(&mut self) {
        if let Some(rehearsal) = self.rehearsal.take() {
            rehearsal.ended();
        }
        if let Some(context) = self.context.take() {
            let inner = self.gpu.inner();
            // What never reached the queue signals no fence: waiting for it would not end.
            if self.submitted {
                // SAFETY: the fence was given to the queue in `start`.
                let waited = unsafe { inner.device.wait_for_fences(&[context.fence], true, u64::MAX) };
                if !is_over(waited) {
                    // It may run still: neither the context nor any buffer may be used again or freed, as long as this
                    // process has the device.
                    std::mem::forget(context);
                    return;
                }
                // SAFETY: nothing runs that would signal the fence, and nobody else waits for it.
                if unsafe { inner.device.reset_fences(&[context.fence]) }.is_err() {
                    // SAFETY: nothing in flight uses the context. With its fence up it is of no use for another submission.
                    unsafe { context.destroy(inner) };
                    inner.ended();
                    return;
                }
            }
            lock(&inner.contexts).push(context);
            inner.ended();
        }
    }
}

/// Where a device was lost, as a part of a sentence: in the first pass without its marker. Without markers, what would tell.
fn place_of_fault(passes: &[&str], markers: Option<&[u8]>) -> String {
    let Some(markers) = markers else {
        let [first, last] = [passes.first(), passes.last()].map(|pass| pass.copied().unwrap_or("none"));
        return format!(
            "in one of {} passes from {first} to {last}; the same command with --trace-faults says in which, and takes longer",
            passes.len()
        );
    };
    let ended = bytemuck::pod_collect_to_vec::<u8, u32>(markers).iter().take_while(|&&marker| marker == 1).count();
    passes.get(ended).map_or_else(|| "behind the last pass that is traced".to_owned(), |pass| format!("in pass {pass}"))
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::{Options, testing};

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

    #[test]
    fn a_wait_that_failed_is_no_end_unless_the_device_is_lost() {
        assert!(is_over(Ok(())) && is_over(Err(vk::Result::ERROR_DEVICE_LOST)));
        for result in
            [vk::Result::ERROR_OUT_OF_HOST_MEMORY, vk::Result::ERROR_OUT_OF_DEVICE_MEMORY, vk::Result::TIMEOUT]
        {
            assert!(!is_over(Err(result)), "{result}");
        }
    }

    /// Its fence was never given to the queue: waiting for it would not end.
    #[test]
    fn what_the_queue_refused_is_not_waited_for() {
        let gpu = testing::gpu();
        for _ in 0..3 {
            let mut recorder = gpu.recorder().expect("a recorder");
            let context = recorder.context.take().expect("a device that runs");
            // SAFETY: in recording, never submitted.
            unsafe { gpu.inner().device.end_command_buffer(context.commands) }.expect("nothing was recorded");
            drop(Submission {
                gpu: &gpu,
                context: Some(context),
                submitted: false,
                rehearsal: None,
                passes: vec![],
                schedule: Schedule::default(),
                commands: vec![],
                differences: vec![],
                trace: BTreeMap::new(),
            });
        }
        let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("the device goes on");
        assert_eq!(gpu.read(&buffer).expect("readable"), [1, 2, 3]);
    }

    #[test]
    fn a_lost_device_is_said_to_be_lost_in_a_pass() {
        let lost = |options: Options| {
            let gpu = testing::gpu_with(options);
            let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("room");
            let mut rec = gpu.recorder().expect("a recorder");
            rec.fill(&buffer, 7);
            rec.zero(&buffer);
            let mut submission = rec.submit().expect("the device takes it");
            gpu.wait_idle().expect("the device runs it");
            submission.passes.push("primitives/scan");
            let said = submission.lost(Err(vk::Result::ERROR_DEVICE_LOST)).expect_err("lost").to_string();
            submission.wait().expect("it is not");
            said
        };
        let plain = lost(Options::default());
        assert!(
            plain.contains("in one of 3 passes from fill to primitives/scan; ") && plain.contains("--trace-faults")
        );
        let traced = Options { trace_faults: true, ..Options::default() };
        assert_eq!(lost(traced), "the device was lost in pass primitives/scan");
    }
}

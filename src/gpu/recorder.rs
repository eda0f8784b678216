//! Recording passes: barriers, labels, timestamps and crash markers come from one function.

use std::collections::BTreeMap;
use std::sync::Arc;

use ash::vk;
use gpu_allocator::vulkan::Allocation;

use super::check::Difference;
use super::descriptors::{Sets, with_writes};
use super::device::{Device, Gpu, Inner, lock};
use super::error::{Error, Named};
use super::hazards::{self, Entry, Hazards, Id, Schedule};
use super::kernel::{Access, Interface, Reference, Scalar, Twin, with_twin};
use super::ledger::{NO_STAGE, Rehearsal};
use super::memory::{Buffer, Slot};
use super::timings::Timing;

/// Passes of one recording that can carry a timestamp and a crash marker; later ones run without.
const MAX_PASSES: u32 = 1024;

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

/// A command buffer with its pool, descriptor sets, queries and markers, used again and again. Each has a pool of its own,
/// so that threads may record at the same time.
pub(super) struct Context {
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    sets: Sets,
    queries: vk::QueryPool,
    fence: vk::Fence,
    markers: (vk::Buffer, Allocation),
}

impl Context {
    fn new(gpu: &Gpu) -> Result<Self, Error> {
        // Without its Arc of the device: the device owns its contexts.
        let markers = gpu.stage(NO_STAGE, || gpu.readback::<u32>("markers", MAX_PASSES as usize))?.into_parts();
        let mut context = Self {
            pool: vk::CommandPool::null(),
            commands: vk::CommandBuffer::null(),
            sets: Sets::default(),
            queries: vk::QueryPool::null(),
            fence: vk::Fence::null(),
            markers,
        };
        match context.fill(&gpu.inner().device) {
            Ok(()) => Ok(context),
            Err(error) => {
                // SAFETY: nothing has used it.
                unsafe { context.destroy(gpu.inner()) };
                Err(error)
            }
        }
    }

    fn fill(&mut self, device: &Device) -> Result<(), Error> {
        let pool = vk::CommandPoolCreateInfo::default()
            .queue_family_index(device.family)
            .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
        let queries =
            vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(2 * MAX_PASSES);
        // SAFETY: live device; destroyed in `destroy`.
        unsafe {
            self.pool = device.create_command_pool(&pool, None).named("creating a command pool")?;
            let allocate = vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
            self.commands = device.allocate_command_buffers(&allocate).named("allocating a command buffer")?[0];
            self.queries = device.create_query_pool(&queries, None).named("creating a query pool")?;
            self.fence = device.create_fence(&vk::FenceCreateInfo::default(), None).named("creating a fence")?;
        }
        Ok(())
    }

    /// # Safety
    /// Nothing in flight uses it.
    pub(super) unsafe fn destroy(self, inner: &Inner) {
        // SAFETY: by the caller's promise. The command buffer goes with its pool; what was never made is null.
        unsafe {
            inner.device.destroy_command_pool(self.pool, None);
            self.sets.destroy(&inner.device);
            inner.device.destroy_query_pool(self.queries, None);
            inner.device.destroy_fence(self.fence, None);
            inner.discard(self.markers.0, self.markers.1);
        }
    }
}

/// Records passes. The first error is kept and returned by [`Recorder::submit`], so that a step reads as plain lines.
pub struct Recorder<'g> {
    gpu: &'g Gpu,
    context: Option<Context>,
    hazards: Hazards,
    schedule: Schedule,
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
    record: Box<dyn FnOnce(vk::CommandBuffer)>,
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

const SHADER: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::COMPUTE_SHADER;
const COPY: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::ALL_TRANSFER;
const INDIRECT: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::DRAW_INDIRECT;

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
            || self.gpu.options().serialize;
        if pass_by_pass || self.held.is_some() {
            return record(self);
        }
        self.held = Some(vec![]);
        let result = record(self);
        let held = self.held.take().unwrap_or_default();
        let waves = hazards::waves(held.iter().map(|pass| pass.accesses.as_slice()));
        let mut ordered: Vec<(u32, Held)> = waves.into_iter().zip(held).collect();
        ordered.sort_by_key(|(wave, _)| *wave);
        for (_, Held { name, stage, accesses, record }) in ordered {
            self.place(name, stage, &accesses, record);
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
        _kernel: K,
        constants: K::Constants,
        buffers: K::Buffers<'_>,
        push: K::Push,
        threads: impl Into<Threads<'t>>,
    ) {
        if self.error.is_some() {
            return;
        }
        let (slots, threads) = (K::slots(&buffers), threads.into());
        let call = Call {
            kernel: K::INTERFACE,
            constants: bytemuck::bytes_of(&constants),
            push: bytemuck::bytes_of(&push),
            slots: &slots,
        };
        let result = with_twin::<K, _>(push, constants, |twin| self.try_run(call, twin, threads));
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

    pub(super) fn dispatch(&mut self, call: Call<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let Call { kernel, constants, push, slots } = call;
        let Interface { name, group, bindings, .. } = *kernel;
        let groups = match threads {
            Threads::Line(n) => {
                let groups = n.div_ceil(group[0].into());
                let limit = u64::from(self.gpu.info().max_groups.min(65535));
                if groups <= limit { [groups as u32, 1, 1] } else { [limit as u32, groups.div_ceil(limit) as u32, 1] }
            }
            Threads::Grid(grid) => std::array::from_fn(|i| grid[i].div_ceil(group[i])),
            Threads::Counted(counted) => {
                assert_eq!(group, [counted.group, 1, 1], "{}: counted for groups of {}", name, counted.group);
                [1, 1, 1]
            }
        };
        if groups.contains(&0) {
            return Ok(());
        }
        let mut accesses: Vec<(Id, &'static str, Access)> =
            slots.iter().zip(bindings).map(|(s, b)| (s.id(), s.name, b.access)).collect();
        if let Threads::Counted(counted) = threads {
            accesses.push((counted.buffer.slot().id(), counted.buffer.name(), Access::Read));
        }
        if let Some(rehearsal) = &self.rehearsal {
            rehearsal.pipeline(name);
            if self.gpu.options().statistics {
                self.gpu.inner().pipeline(kernel, constants)?;
            }
            self.pass(name, &accesses, |_| {});
            return Ok(());
        }
        let pipeline = self.gpu.inner().pipeline(kernel, constants)?;
        let inner = self.gpu.inner().clone();
        let set = match (&inner.push_descriptor, &mut self.context) {
            (None, Some(context)) => {
                let set = context.sets.get(&inner.device, pipeline.set, bindings, slots);
                set.named("making a descriptor set")?
            }
            _ => vk::DescriptorSet::null(),
        };
        let counted = match threads {
            Threads::Counted(counted) => Some((counted.buffer.slot().raw, 16 * u64::from(counted.at))),
            _ => None,
        };
        let (slots, push) = (slots.to_vec(), push.to_vec());
        self.pass(name, &accesses, move |commands| {
            let device = &inner.device;
            // SAFETY: live handles; the layout comes from the kernel's own reflection.
            unsafe {
                device.cmd_bind_pipeline(commands, vk::PipelineBindPoint::COMPUTE, pipeline.raw);
                let bind_point = vk::PipelineBindPoint::COMPUTE;
                match &inner.push_descriptor {
                    Some(extension) => with_writes(bindings, &slots, set, |writes| {
                        extension.cmd_push_descriptor_set(commands, bind_point, pipeline.layout, 0, writes);
                    }),
                    None => device.cmd_bind_descriptor_sets(commands, bind_point, pipeline.layout, 0, &[set], &[]),
                }
                if !push.is_empty() {
                    device.cmd_push_constants(commands, pipeline.layout, vk::ShaderStageFlags::COMPUTE, 0, &push);
                }
                match counted {
                    Some((counts, at)) => device.cmd_dispatch_indirect(commands, counts, at),
                    None => device.cmd_dispatch(commands, groups[0], groups[1], groups[2]),
                }
            }
        });
        Ok(())
    }

    /// Sets every word of a buffer.
    pub fn fill<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, word: u32) {
        self.fill_slot(buffer.slot(), word);
    }

    fn fill_slot(&mut self, slot: Slot, word: u32) {
        let inner = self.gpu.inner().clone();
        self.pass("fill", &[(slot.id(), slot.name, Access::Write)], move |commands| {
            // SAFETY: a live buffer with transfer usage.
            unsafe { inner.device.cmd_fill_buffer(commands, slot.raw, 0, vk::WHOLE_SIZE, word) }
        });
    }

    /// Sets a buffer to zero.
    pub fn zero<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>) {
        self.fill(buffer, 0);
    }

    /// Sets `len` elements from `at` on to zero.
    pub fn zero_range<T: bytemuck::Pod>(&mut self, buffer: &Buffer<T>, at: usize, len: usize) {
        assert!(at + len <= buffer.len(), "zero {len} from {at} of {buffer:?}");
        if len == 0 {
            return;
        }
        let slot = buffer.slot();
        let inner = self.gpu.inner().clone();
        let [at, bytes] = [at, len].map(|n| (n * size_of::<T>()) as u64);
        self.pass("fill", &[(slot.id(), slot.name, Access::Write)], move |commands| {
            // SAFETY: a live buffer with transfer usage, the range within it.
            unsafe { inner.device.cmd_fill_buffer(commands, slot.raw, at, bytes, 0) }
        });
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
        let inner = self.gpu.inner().clone();
        let accesses = [(from.id(), from.name, Access::Read), (to.id(), to.name, Access::Write)];
        self.pass("copy", &accesses, move |commands| {
            let region = [vk::BufferCopy { src_offset: from_at, dst_offset: to_at, size: bytes }];
            // SAFETY: live buffers with transfer usage, regions within both.
            unsafe { inner.device.cmd_copy_buffer(commands, from.raw, to.raw, &region) }
        });
    }

    /// Gives a pass its place: the next one, or one that is found later.
    fn pass(
        &mut self,
        name: &'static str,
        accesses: &[(Id, &'static str, Access)],
        record: impl FnOnce(vk::CommandBuffer) + 'static,
    ) {
        let stage = self.stage;
        match &mut self.held {
            Some(held) => held.push(Held { name, stage, accesses: accesses.to_vec(), record: Box::new(record) }),
            None => self.place(name, stage, accesses, record),
        }
    }

    /// Everything around a pass: the barrier it needs, its label, crash marker and timestamps.
    fn place(
        &mut self,
        name: &'static str,
        stage: &'static str,
        accesses: &[(Id, &'static str, Access)],
        record: impl FnOnce(vk::CommandBuffer),
    ) {
        let inner = self.gpu.inner();
        let reasons = self.hazards.enter(name, accesses, inner.options.serialize);
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
        let commands = context.commands;
        if waits && !inner.options.omit_barriers {
            barrier(inner, commands);
        }
        let index = self.passes.len() as u32;
        let tracked = index < MAX_PASSES;
        let timed = tracked && inner.options.timestamps && inner.info.timestamp_period > 0.0;
        let label = |text: &'static str| std::ffi::CString::new(text).unwrap_or_default();
        // SAFETY: a command buffer in recording; markers are written each at an offset of its own.
        unsafe {
            if let Some(debug) = &inner.debug {
                let label = label(name);
                let info = vk::DebugUtilsLabelEXT::default().label_name(&label);
                debug.cmd_begin_debug_utils_label(commands, &info);
            }
            if tracked {
                let at = 4 * u64::from(index);
                inner.device.cmd_fill_buffer(commands, context.markers.0, at, 4, 1);
            }
            let all = vk::PipelineStageFlags2::ALL_COMMANDS;
            if timed {
                inner.device.cmd_write_timestamp2(commands, all, context.queries, 2 * index);
            }
            record(commands);
            if timed {
                inner.device.cmd_write_timestamp2(commands, all, context.queries, 2 * index + 1);
            }
            if let Some(debug) = &inner.debug {
                debug.cmd_end_debug_utils_label(commands);
            }
        }
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
            if inner.options.timestamps {
                inner.device.cmd_reset_query_pool(context.commands, context.queries, 0, 2 * MAX_PASSES);
            }
            inner.device.cmd_fill_buffer(context.commands, context.markers.0, 0, vk::WHOLE_SIZE, 0);
        }
        // What earlier submissions wrote, and the markers' reset, come before everything here.
        barrier(inner, context.commands);
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

fn barrier(inner: &Inner, commands: vk::CommandBuffer) {
    let stages = SHADER | COPY | INDIRECT;
    let writes = vk::AccessFlags2::SHADER_STORAGE_WRITE | vk::AccessFlags2::TRANSFER_WRITE;
    let reads = vk::AccessFlags2::SHADER_STORAGE_READ
        | vk::AccessFlags2::TRANSFER_READ
        | vk::AccessFlags2::INDIRECT_COMMAND_READ;
    let memory = [vk::MemoryBarrier2::default()
        .src_stage_mask(stages)
        .src_access_mask(writes)
        .dst_stage_mask(stages)
        .dst_access_mask(reads | writes)];
    // SAFETY: a command buffer in recording, synchronization2 is enabled.
    unsafe {
        inner.device.cmd_pipeline_barrier2(commands, &vk::DependencyInfo::default().memory_barriers(&memory));
    }
}

impl Submission<'_> {
    fn start(&mut self) -> Result<(), Error> {
        if self.rehearsal.is_some() {
            return Ok(());
        }
        let inner = self.gpu.inner();
        let context = self.context.as_ref().expect("a submission holds its context until it is waited for");
        let host = [vk::MemoryBarrier2::default()
            .src_stage_mask(SHADER | COPY)
            .src_access_mask(vk::AccessFlags2::SHADER_STORAGE_WRITE | vk::AccessFlags2::TRANSFER_WRITE)
            .dst_stage_mask(vk::PipelineStageFlags2::HOST)
            .dst_access_mask(vk::AccessFlags2::HOST_READ)];
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(context.commands)];
        let submit = [vk::SubmitInfo2::default().command_buffer_infos(&commands)];
        // SAFETY: the command buffer is in recording and its fence unsignalled.
        let result = unsafe {
            inner.device.cmd_pipeline_barrier2(context.commands, &vk::DependencyInfo::default().memory_barriers(&host));
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
                let reached = context.markers.1.mapped_slice().map_or(0, |bytes| {
                    bytemuck::pod_collect_to_vec::<u8, u32>(bytes).iter().take_while(|&&m| m == 1).count()
                });
                let pass = reached.checked_sub(1).and_then(|i| self.passes.get(i)).copied().unwrap_or("none");
                Err(Error::DeviceLost { pass: pass.into() })
            }
            Err(result) => Err(Error::Vulkan { what: "submitting work", result }),
        }
    }

    /// Waits for the end and returns the time of every pass (empty unless the device was opened with timestamps).
    ///
    /// # Errors
    /// [`Error::DeviceLost`] with the last pass reached.
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

impl Drop for Submission<'_> {
    fn drop(&mut self) {
        if let Some(rehearsal) = self.rehearsal.take() {
            rehearsal.ended();
        }
        if let Some(context) = self.context.take() {
            let inner = self.gpu.inner();
            // What never reached the queue signals no fence: waiting for it would not end.
            if self.submitted {
                // SAFETY: given to the queue in `start`; a failure here means the device is lost and nothing runs any more.
                unsafe {
                    let _ = inner.device.wait_for_fences(&[context.fence], true, u64::MAX);
                    let _ = inner.device.reset_fences(&[context.fence]);
                }
            }
            lock(&inner.contexts).push(context);
            inner.ended();
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
                differences: vec![],
                trace: BTreeMap::new(),
            });
        }
        let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("the device goes on");
        assert_eq!(gpu.read(&buffer).expect("readable"), [1, 2, 3]);
    }
}

//! Commands on their way to the device: every `vkCmd*` is recorded here, and noted if the device has to do something for it.

use std::sync::Arc;

use ash::vk;

use super::descriptors::with_writes;
use super::device::{Inner, Pipeline};
use super::kernel::{Binding, Slot};

/// What a command has the device do. Bound state, labels and ends of a command buffer are not noted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Waits and makes memory visible.
    Barrier,
    /// Runs a kernel.
    Dispatch,
    /// Sets words.
    Fill,
    /// Copies from buffer to buffer.
    Copy,
    /// Writes the time.
    Timestamp,
    /// Resets the queries that take timestamps.
    Reset,
    /// Notes that a pass ended: with [`Options::trace_faults`](super::Options::trace_faults) alone.
    Marker,
}

/// How many workgroups a dispatch has.
#[derive(Clone, Copy)]
pub(super) enum Workgroups {
    Known([u32; 3]),
    /// Three words at an offset of a buffer.
    At(vk::Buffer, u64),
}

/// A kernel with all that it is given.
pub(super) struct Dispatch {
    pub pipeline: Arc<Pipeline>,
    pub bindings: &'static [Binding],
    pub slots: Vec<Slot>,
    /// Null where buffers are pushed.
    pub set: vk::DescriptorSet,
    pub push: Vec<u8>,
    pub workgroups: Workgroups,
}

/// What a pass has the device do.
pub(super) enum Work {
    Dispatch(Dispatch),
    /// So many bytes from an offset on, all with this word.
    Fill {
        to: vk::Buffer,
        at: u64,
        bytes: u64,
        word: u32,
    },
    Copy {
        from: vk::Buffer,
        to: vk::Buffer,
        region: vk::BufferCopy,
    },
}

/// A command buffer in recording, and what was noted of it.
pub(super) struct Commands<'c> {
    pub inner: &'c Inner,
    pub raw: vk::CommandBuffer,
    pub noted: &'c mut Vec<Command>,
}

impl Commands<'_> {
    /// Everything before comes before everything behind: what shaders and copies wrote is what they read.
    pub fn barrier(&mut self) {
        const SHADER: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::COMPUTE_SHADER;
        const COPY: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::ALL_TRANSFER;
        const INDIRECT: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::DRAW_INDIRECT;
        let stages = SHADER | COPY | INDIRECT;
        let writes = vk::AccessFlags2::SHADER_STORAGE_WRITE | vk::AccessFlags2::TRANSFER_WRITE;
        let reads = vk::AccessFlags2::SHADER_STORAGE_READ
            | vk::AccessFlags2::TRANSFER_READ
            | vk::AccessFlags2::INDIRECT_COMMAND_READ;
        self.wait(
            vk::MemoryBarrier2::default()
                .src_stage_mask(stages)
                .src_access_mask(writes)
                .dst_stage_mask(stages)
                .dst_access_mask(reads | writes),
        );
    }

    /// The host may read what was written.
    pub fn barrier_to_host(&mut self) {
        self.wait(
            vk::MemoryBarrier2::default()
                .src_stage_mask(vk::PipelineStageFlags2::COMPUTE_SHADER | vk::PipelineStageFlags2::ALL_TRANSFER)
                .src_access_mask(vk::AccessFlags2::SHADER_STORAGE_WRITE | vk::AccessFlags2::TRANSFER_WRITE)
                .dst_stage_mask(vk::PipelineStageFlags2::HOST)
                .dst_access_mask(vk::AccessFlags2::HOST_READ),
        );
    }

    fn wait(&mut self, memory: vk::MemoryBarrier2<'_>) {
        self.noted.push(Command::Barrier);
        let info = vk::DependencyInfo::default().memory_barriers(std::slice::from_ref(&memory));
        // SAFETY: a command buffer in recording, synchronization2 is enabled.
        unsafe { self.inner.device.cmd_pipeline_barrier2(self.raw, &info) };
    }

    /// A pass's own commands.
    pub fn work(&mut self, work: &Work) {
        let device = &self.inner.device;
        match work {
            Work::Dispatch(dispatch) => self.dispatch(dispatch),
            Work::Fill { to, at, bytes, word } => {
                self.noted.push(Command::Fill);
                // SAFETY: a live buffer, made with transfer usage as all are; the range was asserted to lie within it when the pass
                // was recorded, and is of whole words.
                unsafe { device.cmd_fill_buffer(self.raw, *to, *at, *bytes, *word) };
            }
            Work::Copy { from, to, region } => {
                self.noted.push(Command::Copy);
                // SAFETY: live buffers, made with transfer usage as all are; the region was asserted to lie within both when the
                // pass was recorded.
                unsafe { device.cmd_copy_buffer(self.raw, *from, *to, &[*region]) };
            }
        }
    }

    fn dispatch(&mut self, dispatch: &Dispatch) {
        let Dispatch { pipeline, bindings, slots, set, push, workgroups } = dispatch;
        let (device, commands, layout) = (&self.inner.device, self.raw, pipeline.layout);
        self.noted.push(Command::Dispatch);
        // SAFETY: a command buffer in recording and live handles: the pipeline and what it binds are kept until the submission is
        // over. Bindings and push constants are those of the kernel's own reflection. Kernels keep their bounds by the counts
        // that they are given, which saturate: robust access is not asked for.
        unsafe {
            let point = vk::PipelineBindPoint::COMPUTE;
            device.cmd_bind_pipeline(commands, point, pipeline.raw());
            match &self.inner.push_descriptor {
                Some(extension) => with_writes(bindings, slots, *set, |writes| {
                    extension.cmd_push_descriptor_set(commands, point, layout, 0, writes);
                }),
                None => device.cmd_bind_descriptor_sets(commands, point, layout, 0, &[*set], &[]),
            }
            if !push.is_empty() {
                device.cmd_push_constants(commands, layout, vk::ShaderStageFlags::COMPUTE, 0, push);
            }
            match *workgroups {
                Workgroups::At(counts, at) => device.cmd_dispatch_indirect(commands, counts, at),
                Workgroups::Known([x, y, z]) => device.cmd_dispatch(commands, x, y, z),
            }
        }
    }

    /// Notes in `markers` that everything so far ended.
    pub fn marker(&mut self, markers: vk::Buffer, index: u32) {
        self.barrier();
        self.noted.push(Command::Marker);
        // SAFETY: a live buffer with room for the index.
        unsafe { self.inner.device.cmd_fill_buffer(self.raw, markers, 4 * u64::from(index), 4, 1) };
    }

    /// Sets all markers to zero.
    pub fn clear_markers(&mut self, markers: vk::Buffer) {
        self.noted.push(Command::Marker);
        // SAFETY: a live buffer with transfer usage.
        unsafe { self.inner.device.cmd_fill_buffer(self.raw, markers, 0, vk::WHOLE_SIZE, 0) };
    }

    /// The time at which everything so far ended.
    pub fn timestamp(&mut self, queries: vk::QueryPool, index: u32) {
        self.noted.push(Command::Timestamp);
        let all = vk::PipelineStageFlags2::ALL_COMMANDS;
        // SAFETY: the pool has room for the index, and was reset in this recording.
        unsafe { self.inner.device.cmd_write_timestamp2(self.raw, all, queries, index) };
    }

    /// Makes timestamps writable again.
    pub fn reset(&mut self, queries: vk::QueryPool, count: u32) {
        self.noted.push(Command::Reset);
        // SAFETY: the pool has so many, and nothing in flight uses them.
        unsafe { self.inner.device.cmd_reset_query_pool(self.raw, queries, 0, count) };
    }

    /// What comes until [`Commands::end_label`] bears this name for tools that watch.
    pub fn begin_label(&self, name: &str) {
        if let Some(debug) = &self.inner.debug {
            let name = std::ffi::CString::new(name).unwrap_or_default();
            let info = vk::DebugUtilsLabelEXT::default().label_name(&name);
            // SAFETY: a command buffer in recording.
            unsafe { debug.cmd_begin_debug_utils_label(self.raw, &info) };
        }
    }

    pub fn end_label(&self) {
        if let Some(debug) = &self.inner.debug {
            // SAFETY: behind the beginning of one.
            unsafe { debug.cmd_end_debug_utils_label(self.raw) };
        }
    }
}

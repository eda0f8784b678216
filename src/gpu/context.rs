//! What a recording is made in, used again and again.

use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::Allocation;

use super::descriptors::Sets;
use super::device::{Device, Gpu, Inner};
use super::error::{Error, Named};
use super::ledger::NO_STAGE;

/// Passes of one recording that can carry a timestamp and a marker; later ones run without.
pub(super) const MAX_PASSES: u32 = 1024;

/// A command buffer with its pool, descriptor sets, queries and markers. Each has a pool of its own,
/// so that threads may record at the same time.
pub(super) struct Context {
    pool: vk::CommandPool,
    pub commands: vk::CommandBuffer,
    pub sets: Sets,
    pub queries: vk::QueryPool,
    pub fence: vk::Fence,
    /// A word for each pass that ended, where faults are traced.
    pub markers: Option<(vk::Buffer, Allocation)>,
}

impl Context {
    pub fn new(gpu: &Gpu) -> Result<Self, Error> {
        // Without its Arc of the device: the device owns its contexts.
        let markers = || gpu.stage(NO_STAGE, || gpu.readback::<u32>("markers", MAX_PASSES as usize));
        let markers = gpu.options().trace_faults.then(markers).transpose()?.map(|markers| markers.into_parts());
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

    /// Makes it ready to be recorded in.
    ///
    /// # Safety
    /// Nothing in flight uses it.
    ///
    /// # Errors
    /// When the device refuses; it can be tried again.
    pub(super) unsafe fn begin(&mut self, device: &Device) -> Result<(), Error> {
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: by the caller's promise.
        unsafe {
            self.sets.recycle(device).named("recycling descriptor sets")?;
            device.begin_command_buffer(self.commands, &info).named("beginning a command buffer")
        }
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
            if let Some((markers, allocation)) = self.markers {
                inner.discard(markers, allocation, MemoryLocation::GpuToCpu);
            }
        }
    }
}

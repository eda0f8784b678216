//! How a pass finds its buffers: pushed into the command buffer, or as descriptor sets where a device cannot push.

use std::collections::HashMap;

use ash::vk;

use super::kernel::Binding;
use super::kernels::MOST_BUFFERS;
use super::memory::Slot;

/// How to bind the buffers of a pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Descriptors {
    /// Pushed where the device can, sets otherwise.
    #[default]
    Auto,
    /// Pushed (VK_KHR_push_descriptor).
    Push,
    /// Sets, which every device has.
    Sets,
}

/// Sets of one pool. A training step takes about 140.
const SETS: u32 = 256;
/// Buffers of one pool's sets; a pass binds about six.
const BUFFERS: u32 = 8 * SETS;

type Key = (vk::DescriptorSetLayout, Vec<(vk::Buffer, u64)>);

/// The sets of one recording. Passes that bind the same share one.
#[derive(Default)]
pub(super) struct Sets {
    /// One, unless a recording was longer than a pool.
    pools: Vec<vk::DescriptorPool>,
    /// Sets and buffers taken from the pool in use, and its number.
    taken: [u32; 2],
    current: usize,
    made: HashMap<Key, vk::DescriptorSet>,
}

impl Sets {
    /// The set that binds these buffers.
    ///
    /// # Errors
    /// When the device has no memory for another pool.
    pub(super) fn get(
        &mut self,
        device: &ash::Device,
        layout: vk::DescriptorSetLayout,
        bindings: &[Binding],
        slots: &[Slot],
    ) -> Result<vk::DescriptorSet, vk::Result> {
        let key = (layout, slots.iter().map(|slot| (slot.raw, slot.bytes)).collect());
        if let Some(&set) = self.made.get(&key) {
            return Ok(set);
        }
        let buffers = slots.len() as u32;
        if self.taken[0] == SETS || self.taken[1] + buffers > BUFFERS {
            self.current += 1;
            self.taken = [0; 2];
        }
        if self.current == self.pools.len() {
            self.pools.push(pool(device)?);
        }
        let layouts = [layout];
        let allocate =
            vk::DescriptorSetAllocateInfo::default().descriptor_pool(self.pools[self.current]).set_layouts(&layouts);
        // SAFETY: live handles. The pool belongs to this recording alone, and the counts in `taken` say that it has room for a set
        // and its buffers.
        let set = unsafe { device.allocate_descriptor_sets(&allocate) }?[0];
        self.taken = [self.taken[0] + 1, self.taken[1] + buffers];
        with_writes(bindings, slots, set, |writes| {
            // SAFETY: a fresh set, which no command uses yet; a buffer that is dropped before the recording has ended waits in the trash.
            unsafe { device.update_descriptor_sets(writes, &[]) }
        });
        self.made.insert(key, set);
        Ok(set)
    }

    /// Forgets all sets and keeps their memory.
    ///
    /// # Safety
    /// Nothing in flight uses them.
    ///
    /// # Errors
    /// When the device refuses.
    pub(super) unsafe fn recycle(&mut self, device: &ash::Device) -> Result<(), vk::Result> {
        self.made.clear();
        self.current = 0;
        self.taken = [0; 2];
        // SAFETY: by the caller's promise.
        self.pools
            .iter()
            .try_for_each(|&pool| unsafe { device.reset_descriptor_pool(pool, vk::DescriptorPoolResetFlags::empty()) })
    }

    /// # Safety
    /// Nothing in flight uses them.
    pub(super) unsafe fn destroy(self, device: &ash::Device) {
        for pool in self.pools {
            // SAFETY: by the caller's promise.
            unsafe { device.destroy_descriptor_pool(pool, None) };
        }
    }
}

fn pool(device: &ash::Device) -> Result<vk::DescriptorPool, vk::Result> {
    const { assert!(MOST_BUFFERS <= BUFFERS) };
    let sizes = [vk::DescriptorPoolSize::default().ty(vk::DescriptorType::STORAGE_BUFFER).descriptor_count(BUFFERS)];
    let create = vk::DescriptorPoolCreateInfo::default().max_sets(SETS).pool_sizes(&sizes);
    // SAFETY: a live device; the owner destroys the pool.
    unsafe { device.create_descriptor_pool(&create, None) }
}

/// Describes the buffers of a pass to `act`, for this set or, with a null set, for pushing.
pub(super) fn with_writes<T>(
    bindings: &[Binding],
    slots: &[Slot],
    set: vk::DescriptorSet,
    act: impl FnOnce(&[vk::WriteDescriptorSet<'_>]) -> T,
) -> T {
    let infos: Vec<_> =
        slots.iter().map(|s| [vk::DescriptorBufferInfo::default().buffer(s.raw).range(s.bytes)]).collect();
    let writes: Vec<_> = infos
        .iter()
        .zip(bindings)
        .map(|(info, b)| {
            vk::WriteDescriptorSet::default()
                .dst_set(set)
                .dst_binding(b.number)
                .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                .buffer_info(info)
        })
        .collect();
    act(&writes)
}

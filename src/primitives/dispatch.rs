//! Indirect dispatch: from a count on the device to workgroups.

use crate::gpu::kernels::primitives::dispatch;
use crate::gpu::{Buffer, Error, Gpu, Groups, Recorder, Reference, Threads};

impl Reference for dispatch::Kernel {
    fn reference(host: dispatch::Host<'_>, push: dispatch::Push, (): ()) {
        let n = host.count[0].min(push.capacity);
        let groups = (n.div_ceil(push.tile) * push.factor).div_ceil(push.group);
        host.groups.copy_from_slice(&[groups.min(push.limit), groups.div_ceil(push.limit), 1, n]);
    }
}

/// Workgroup counts for kernels of `group` threads, one per item of a count on the device.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn groups(gpu: &Gpu, name: &'static str, group: u32) -> Result<Groups, Error> {
    Ok(Groups { buffer: gpu.buffer(name, 4)?, group })
}

/// Sets `groups` for `factor` threads per item, at most `capacity` items.
pub fn record(rec: &mut Recorder<'_>, count: &Buffer<u32>, groups: &Groups, capacity: u32, factor: u32) {
    record_tiles(rec, count, groups, capacity, 1, factor);
}

/// Sets `groups` for `factor` threads per tile of `tile` items begun, at most `capacity` items.
pub fn record_tiles(
    rec: &mut Recorder<'_>,
    count: &Buffer<u32>,
    groups: &Groups,
    capacity: u32,
    tile: u32,
    factor: u32,
) {
    let limit = rec.gpu().info().max_groups.min(65535);
    let push = dispatch::Push { capacity, tile, factor, group: groups.group, limit };
    rec.run(dispatch::Kernel, dispatch::Buffers { count, groups: &groups.buffer }, push, 1u32);
}

/// How many items a primitive works on.
#[derive(Clone, Copy, Debug)]
pub enum Count<'a> {
    /// The host knows.
    Host(u32),
    /// The first element, known to the device alone; clamped to the primitive's capacity.
    Device(&'a Buffer<u32>),
}

/// Dispatch of one workgroup per block of items.
#[derive(Debug)]
pub(super) struct Blocks {
    host: Buffer<u32>,
    groups: Groups,
    capacity: u32,
    items: u32,
}

impl Blocks {
    /// Workgroups of `group` threads for blocks of `items`.
    pub(super) fn new(gpu: &Gpu, capacity: u32, group: u32, items: u32) -> Result<Self, Error> {
        Ok(Self { host: gpu.buffer("count", 1)?, groups: groups(gpu, "groups", group)?, capacity, items })
    }

    /// Where kernels read the count (unclamped), and the dispatch.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity.
    pub(super) fn record<'a>(&'a self, rec: &mut Recorder<'_>, count: Count<'a>) -> (&'a Buffer<u32>, Threads<'a>) {
        match count {
            Count::Host(n) => {
                assert!(n <= self.capacity, "{n} items where there is room for {}", self.capacity);
                rec.fill(&self.host, n);
                (&self.host, Threads::Line(u64::from(n.div_ceil(self.items)) * u64::from(self.groups.group)))
            }
            Count::Device(count) => {
                let limit = rec.gpu().info().max_groups.min(65535);
                let push = dispatch::Push { capacity: self.capacity, tile: 1, factor: 1, group: self.items, limit };
                rec.run(dispatch::Kernel, dispatch::Buffers { count, groups: &self.groups.buffer }, push, 1u32);
                (count, Threads::Counted(&self.groups))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for count in [0, 1, 63, 64, 65, 4096, 5_000_000, u32::MAX] {
            for (group, tile) in [(1, 1), (64, 1), (256, 1), (64, 16)] {
                let case = dispatch::Arrays { count: vec![count], groups: vec![u32::MAX; 4] };
                let push = dispatch::Push { capacity: 10_000_000, tile, factor: 3, group, limit: 65535 };
                testing::assert_twin(dispatch::Kernel, &gpu, case, push, 1u32);
            }
        }
    }
}

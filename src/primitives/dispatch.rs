//! Indirect dispatch: from a count on the device to workgroups.

use crate::gpu::kernels::primitives::dispatch;
use crate::gpu::{Buffer, Error, Gpu, Groups, Recorder, Reference, Threads};

/// Most dispatches of one count: the kernel's.
const SHAPES: usize = 8;

fn shapes(push: &dispatch::Push) -> [[u32; 3]; SHAPES] {
    let dispatch::Push { shape0, shape1, shape2, shape3, shape4, shape5, shape6, shape7, .. } = *push;
    [shape0, shape1, shape2, shape3, shape4, shape5, shape6, shape7]
}

impl Reference for dispatch::Kernel {
    fn reference(host: dispatch::Host<'_>, push: dispatch::Push, (): ()) {
        let n = host.count[0].min(push.capacity) + push.added;
        let shapes = shapes(&push).into_iter().take(push.number as usize);
        for (of, [tile, factor, group]) in host.groups.chunks_exact_mut(4).zip(shapes) {
            let groups = (n.div_ceil(tile) * factor).div_ceil(group);
            of.copy_from_slice(&[groups.min(push.limit), groups.div_ceil(push.limit), 1, n]);
        }
    }
}

/// Workgroup counts for kernels of `group` threads, one per item of a count on the device.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn groups(gpu: &Gpu, name: &'static str, group: u32) -> Result<Groups, Error> {
    let [groups] = several(gpu, name, [group])?;
    Ok(groups)
}

/// Workgroup counts of several kinds of kernels, of so many threads each, for the items of one count on the device.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn several<const N: usize>(gpu: &Gpu, name: &'static str, group: [u32; N]) -> Result<[Groups; N], Error> {
    const { assert!(N <= SHAPES) };
    let buffer: Buffer<u32> = gpu.buffer(name, 4 * N)?;
    let mut at = 0..;
    Ok(group.map(|group| Groups { buffer: buffer.view(), at: at.next().unwrap_or_default(), group }))
}

/// Threads for items: `factor` for each tile of `tile` items begun.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Shape {
    /// Items of a tile.
    pub tile: u32,
    /// Threads of a tile.
    pub factor: u32,
}

impl Shape {
    /// A thread for each item.
    pub const EACH: Self = Self { tile: 1, factor: 1 };
}

/// Sets `groups` for `factor` threads per item, at most `capacity` items.
pub fn record(rec: &mut Recorder<'_>, count: &Buffer<u32>, groups: &Groups, capacity: u32, factor: u32) {
    record_several(rec, count, capacity, [(groups, Shape { tile: 1, factor })]);
}

/// Sets all dispatches of one count, made together by [`several`] and in that order, at most `capacity` items.
pub fn record_several<const N: usize>(
    rec: &mut Recorder<'_>,
    count: &Buffer<u32>,
    capacity: u32,
    of: [(&Groups, Shape); N],
) {
    record_more(rec, count, (capacity, 0), of);
}

/// As [`record_several`], for `added` more items than there are.
pub fn record_more<const N: usize>(
    rec: &mut Recorder<'_>,
    count: &Buffer<u32>,
    (capacity, added): (u32, u32),
    of: [(&Groups, Shape); N],
) {
    let mut shapes = [[1, 0, 1]; SHAPES];
    for (i, (groups, Shape { tile, factor })) in of.into_iter().enumerate() {
        assert_eq!(groups.at as usize, i, "dispatches in the order in which they were made");
        shapes[i] = [tile, factor, groups.group];
    }
    run(rec, count, &of[0].0.buffer, (capacity, added), N as u32, shapes);
}

fn run(
    rec: &mut Recorder<'_>,
    count: &Buffer<u32>,
    groups: &Buffer<u32>,
    (capacity, added): (u32, u32),
    number: u32,
    shapes: [[u32; 3]; SHAPES],
) {
    let limit = rec.gpu().info().max_groups.min(65535);
    let [shape0, shape1, shape2, shape3, shape4, shape5, shape6, shape7] = shapes;
    let push = dispatch::Push {
        capacity,
        added,
        limit,
        number,
        shape0,
        shape1,
        shape2,
        shape3,
        shape4,
        shape5,
        shape6,
        shape7,
    };
    rec.run(dispatch::Kernel, dispatch::Buffers { count, groups }, push, 1u32);
}

/// How many items a primitive works on.
#[derive(Clone, Copy, Debug)]
pub enum Count<'a> {
    /// The host knows.
    Host(u32),
    /// The first element, known to the device alone; clamped to the primitive's capacity.
    Device(&'a Buffer<u32>),
    /// As `Device`, where a workgroup for each of the primitive's blocks is already set.
    Counted(&'a Buffer<u32>, &'a Groups),
}

/// Dispatch of one workgroup per block of items.
#[derive(Debug)]
pub(super) struct Blocks {
    /// In place of a count, where the host knows it: no limit.
    host: Buffer<u32>,
    groups: Groups,
    capacity: u32,
    items: u32,
}

impl Blocks {
    /// Workgroups of `group` threads for blocks of `items`.
    pub(super) fn new(gpu: &Gpu, capacity: u32, group: u32, items: u32) -> Result<Self, Error> {
        Ok(Self { host: gpu.constant("count", &[u32::MAX])?, groups: groups(gpu, "groups", group)?, capacity, items })
    }

    /// Where kernels read the count, what they clamp it to, and the dispatch.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity.
    pub(super) fn record<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        count: Count<'a>,
    ) -> (&'a Buffer<u32>, u32, Threads<'a>) {
        match count {
            Count::Host(n) => {
                assert!(n <= self.capacity, "{n} items where there is room for {}", self.capacity);
                let groups = u64::from(n.div_ceil(self.items));
                (&self.host, n, Threads::Line(groups * u64::from(self.groups.group)))
            }
            Count::Device(count) => {
                let mut shapes = [[1, 0, 1]; SHAPES];
                shapes[0] = [1, 1, self.items];
                run(rec, count, &self.groups.buffer, (self.capacity, 0), 1, shapes);
                (count, self.capacity, Threads::Counted(&self.groups))
            }
            Count::Counted(count, groups) => (count, self.capacity, Threads::Counted(groups)),
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
        for (count, added) in
            [0, 1, 63, 64, 65, 4096, 5_000_000, u32::MAX].into_iter().zip([0, 640, 0, 1].into_iter().cycle())
        {
            for number in [1, 3, 8] {
                let case = dispatch::Arrays { count: vec![count], groups: vec![u32::MAX; 4 * number as usize + 2] };
                let push = dispatch::Push {
                    capacity: 10_000_000,
                    added,
                    limit: 65535,
                    number,
                    shape0: [1, 3, 64],
                    shape1: [1, 3, 1],
                    shape2: [1, 3, 256],
                    shape3: [16, 3, 64],
                    shape4: [64, 24, 64],
                    shape5: [1, 1, 1024],
                    shape6: [7, 10, 8],
                    shape7: [1, 1, 64],
                };
                testing::assert_twin(dispatch::Kernel, &gpu, case, push, 1u32);
            }
        }
    }
}

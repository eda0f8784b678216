//! Lists of Gaussian slots on the device.

use crate::gpu::{Buffer, Error, Gpu, Groups, Recorder};
use crate::primitives::dispatch;

/// Slots in ascending order, and the dispatch of a thread for each. Slot `s = k V + v` is Gaussian k of visible anchor v,
/// of V: so those of the same k, which share the decoders' weights, lie one behind the other.
///
/// What a pass computes for a list's Gaussians it writes to their slots and nowhere else: an array over slots holds
/// something where its list says so, and whoever reads it goes by that list or a shorter one.
#[derive(Debug)]
pub struct Slots {
    /// `[count]` the slots.
    pub list: Buffer<u32>,
    /// `[1]` how many.
    pub count: Buffer<u32>,
    /// A thread for each, and maybe some more.
    pub groups: Groups,
}

impl Slots {
    /// Room for `capacity` slots, under these names: of the list, of its count, of the dispatch.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, [list, count, groups]: [&'static str; 3], capacity: u32) -> Result<Self, Error> {
        Ok(Self {
            list: gpu.buffer(list, capacity as usize)?,
            count: gpu.buffer(count, 1)?,
            groups: dispatch::groups(gpu, groups, 64)?,
        })
    }

    /// The first `n` slots, all of them: for Gaussians that no decoder made.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn all(gpu: &Gpu, n: u32) -> Result<Self, Error> {
        let new = Self::new(gpu, ["all", "all_count", "all_groups"], n)?;
        let list: Vec<u32> = (0..n).collect();
        let [list, count] =
            [("all_written", &list[..]), ("all_count_written", &[n])].map(|(name, of)| gpu.constant(name, of));
        let mut rec = gpu.recorder()?;
        rec.copy(&list?, &new.list, n as usize);
        rec.copy(&count?, &new.count, 1);
        new.dispatch(&mut rec);
        rec.submit()?.wait()?;
        Ok(new)
    }

    /// Sets the dispatch, once the list is there.
    pub fn dispatch(&self, rec: &mut Recorder<'_>) {
        dispatch::record(rec, &self.count, &self.groups, self.list.len() as u32, 1);
    }
}

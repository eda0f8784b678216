//! The list of anchors to decode.

use super::cull::Cull;
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::Anchors;
use crate::primitives::Count;
use crate::primitives::compact::Compact;
use crate::primitives::limit::{Counter, Limits};
use crate::scene::Camera;

/// Visible anchors in ascending order.
pub struct Visible {
    cull: Option<Cull>,
    all: Option<Buffer<u32>>,
    compact: Compact,
    capacity: u32,
    wanted: Buffer<u32>,
    /// `[V]` anchor ids.
    pub list: Buffer<u32>,
    /// `[1]`
    pub count: Buffer<u32>,
}

impl Visible {
    /// For `anchors` anchors of which at most `capacity` are visible at once; without culling all
    /// are.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, anchors: u32, capacity: u32, cull: bool) -> Result<Self, Error> {
        Ok(Self {
            cull: if cull { Some(Cull::new(gpu, anchors)?) } else { None },
            all: if cull { None } else { Some(gpu.upload("flags", &vec![1; anchors as usize])?) },
            compact: Compact::new(gpu, anchors)?,
            capacity,
            wanted: gpu.buffer("visible_wanted", 1)?,
            // Room for all: a list that is too long is counted before it is refused.
            list: gpu.buffer("visible", anchors as usize)?,
            count: gpu.buffer("visible_count", 1)?,
        })
    }

    /// Lists the anchors whose ellipsoid touches the view. More than there is room for raise the overflow flag and
    /// leave the list empty.
    pub fn record(&self, rec: &mut Recorder<'_>, anchors: &Anchors, camera: &Camera, near: f32, limits: &Limits) {
        let log_scaling = &anchors.log_scaling().value;
        let flags = match (&self.cull, &self.all) {
            (Some(cull), _) => cull.record(rec, &anchors.position, log_scaling, anchors.count, camera, near),
            (None, Some(all)) => all,
            (None, None) => unreachable!("made with one of the two"),
        };
        self.compact.record(rec, flags, &self.list, &self.wanted, Count::Host(anchors.count));
        limits.record(rec, &self.wanted, &self.count, self.capacity, Counter::Visible);
    }
}

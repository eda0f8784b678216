//! The forward stages, from anchors to the tiles' lists.

use super::activate::Activate;
use super::bin::{Bin, Binned};
use super::decode::{self, Decode};
use super::method::Method;
use super::project::Projected;
use super::project::{Gaussians, Project};
use super::slots::Slots;
use super::visible::Visible;
use super::widen;
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::Anchors;
use crate::model::gaussians::Static;
use crate::primitives::Count;
use crate::primitives::limit::{COUNTERS, Counter, Limits};
use crate::scene::Camera;
use crate::stage;

/// How much the forward stages have room for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Capacity {
    /// Anchors.
    pub anchors: u32,
    /// Anchors in one view.
    pub visible: u32,
    /// (Gaussian, tile) pairs in one view.
    pub pairs: u32,
}

impl Capacity {
    /// A first guess for so many anchors; overflow corrects it.
    pub fn guess(anchors: u32) -> Self {
        Self { anchors, visible: (anchors / 4).clamp(1024, anchors.max(1024)), pairs: 1 << 17 }
    }

    /// Room for what was counted, and half as much again.
    pub fn fit(self, counters: [u32; COUNTERS]) -> Self {
        let fit = |have: u32, wanted: u32| if wanted > have { wanted.saturating_add(wanted / 2) } else { have };
        Self {
            anchors: self.anchors,
            visible: fit(self.visible, counters[Counter::Visible as usize]),
            pairs: fit(self.pairs, counters[Counter::Pairs as usize]),
        }
    }

    /// The same with no more spare room than the device binds: what `counters` counted stays whatever the device's limit.
    pub fn within(self, gpu: &Gpu, counters: [u32; COUNTERS]) -> Self {
        let [visible, pairs] = [Counter::Visible, Counter::Pairs].map(|counter| counters[counter as usize]);
        Self {
            anchors: self.anchors,
            visible: self.visible.min(self.anchors.max(visible).max(1)),
            pairs: self.pairs.min(most_pairs(gpu).max(pairs).max(1)),
        }
    }
}

/// As many anchors of `offsets` Gaussians as the device trains: each of their arrays fits one binding, and so does each
/// array that a view needs which shows all of them.
pub fn most_anchors(gpu: &Gpu, offsets: u32) -> u32 {
    let in_view = gpu.info().max_binding_bytes.min(u32::MAX.into()) / decode::widest(offsets);
    Anchors::most(gpu, offsets).min(in_view as u32)
}

/// As many (Gaussian, tile) pairs as the device trains: the widest array over them holds three floats each.
fn most_pairs(gpu: &Gpu) -> u32 {
    (gpu.info().max_binding_bytes / 12).min(u32::MAX.into()) as u32
}

/// The stages between what is learnt and the Gaussians of a view.
#[expect(clippy::large_enum_variant, reason = "a step has one")]
pub enum Front {
    /// Stages of anchors.
    Anchors {
        /// The anchors in view.
        visible: Visible,
        /// Neural Gaussians.
        decode: Decode,
    },
    /// Stages of plain Gaussians.
    Gaussians {
        /// All of them, as they are drawn.
        activate: Activate,
        /// All of them.
        all: Slots,
        /// How many.
        count: u32,
    },
}

/// The forward stages, from the model to a picture.
pub struct Forward {
    /// The stages that the forms of the model have of their own.
    pub front: Front,
    /// Gaussians on the picture.
    pub project: Project,
    /// Tiles' lists.
    pub bin: Bin,
    /// How many times larger the pictures are than those of the training: see [`widen`].
    pub larger: f64,
    method: Method,
}

impl Forward {
    /// Stages for anchors of `offsets` Gaussians and pictures of at most `size`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(
        gpu: &Gpu,
        capacity: Capacity,
        offsets: u32,
        method: Method,
        size: [u32; 2],
        cull: bool,
    ) -> Result<Self, Error> {
        Ok(Self {
            front: Front::Anchors {
                visible: gpu.stage(stage::CULL, || Visible::new(gpu, capacity.anchors, capacity.visible, cull))?,
                decode: gpu.stage(stage::DECODE, || Decode::new(gpu, capacity.visible, offsets))?,
            },
            project: gpu.stage(stage::PROJECT, || Project::new(gpu, capacity.visible, offsets))?,
            bin: gpu.stage(stage::BIN, || {
                Bin::new(gpu, method, capacity.visible.saturating_mul(offsets), capacity.pairs, size)
            })?,
            larger: 1.0,
            method,
        })
    }

    /// Stages for this model and pictures of at most `size`; for plain Gaussians, as many as there are now.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn of(
        gpu: &Gpu,
        capacity: Capacity,
        model: Model<'_>,
        method: Method,
        size: [u32; 2],
        cull: bool,
    ) -> Result<Self, Error> {
        let count = match model {
            Model::Anchors { anchors, .. } => return Self::new(gpu, capacity, anchors.offsets, method, size, cull),
            Model::Gaussians(gaussians) => gaussians.count,
        };
        let front = || {
            Ok::<_, Error>(Front::Gaussians {
                activate: Activate::new(gpu, count)?,
                all: Slots::all(gpu, count)?,
                count,
            })
        };
        Ok(Self {
            front: gpu.stage(stage::DECODE, front)?,
            project: gpu.stage(stage::PROJECT, || Project::new(gpu, count, 1))?,
            bin: gpu.stage(stage::BIN, || Bin::new(gpu, method, count, capacity.pairs, size))?,
            larger: 1.0,
            method,
        })
    }

    /// The anchors in view.
    ///
    /// # Panics
    /// For stages of plain Gaussians.
    pub fn visible(&self) -> &Visible {
        match &self.front {
            Front::Anchors { visible, .. } => visible,
            Front::Gaussians { .. } => panic!("plain Gaussians are not culled"),
        }
    }

    /// The anchors' Gaussians.
    ///
    /// # Panics
    /// For stages of plain Gaussians.
    pub fn decode(&self) -> &Decode {
        match &self.front {
            Front::Anchors { decode, .. } => decode,
            Front::Gaussians { .. } => panic!("plain Gaussians are not decoded"),
        }
    }

    /// The Gaussians that there are, by slot.
    pub fn existing(&self) -> &Slots {
        match &self.front {
            Front::Anchors { decode, .. } => &decode.existing,
            Front::Gaussians { all, .. } => all,
        }
    }

    /// What the pictures are computed with.
    pub fn method(&self) -> Method {
        self.method
    }

    /// The Gaussians as the projection reads them.
    pub fn gaussians(&self) -> Gaussians<'_> {
        match &self.front {
            Front::Anchors { decode: Decode { position, scale, rotation, .. }, .. } => {
                Gaussians { position, scale, rotation }
            }
            Front::Gaussians { activate, .. } => activate.gaussians(),
        }
    }

    /// The projected Gaussians as the rasteriser reads them.
    pub fn projected(&self) -> Projected<'_> {
        let (slots, opacity, color) = match &self.front {
            Front::Anchors { decode, .. } => (decode.slots(), &decode.opacity, &decode.color),
            Front::Gaussians { activate, count, .. } => (Count::Host(*count), &activate.opacity, &activate.color),
        };
        Projected {
            slots,
            existing: self.existing(),
            mean: &self.project.mean,
            covariance: &self.project.covariance,
            depth: &self.project.depth,
            opacity,
            color,
        }
    }

    /// Records everything before the picture: which anchors are in view, their Gaussians or the plain ones, and the tiles'
    /// lists.
    ///
    /// # Panics
    /// For a model of another form than the stages'.
    pub fn record<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        model: Model<'_>,
        camera: &Camera,
        near: f32,
        limits: &Limits,
    ) -> Binned<'s> {
        match (&self.front, model) {
            (Front::Anchors { visible, decode }, Model::Anchors { anchors, weights }) => {
                visible.record(rec, anchors, camera, near, limits);
                let offset = anchors.offset().value.view();
                let model = decode::Anchors {
                    position: &anchors.position,
                    feature: &anchors.feature().value,
                    offset: &offset,
                    log_scaling: &anchors.log_scaling().value,
                    weights,
                    visible: &visible.list,
                };
                decode.record(rec, model, &visible.count, camera.center());
            }
            (Front::Gaussians { activate, all, .. }, Model::Gaussians(gaussians)) => {
                activate.record(rec, gaussians, camera.center());
                limits.note(rec, &all.count, Counter::Visible);
            }
            _ => panic!("the stages are of another form than the model"),
        }
        widen::record(rec, self.existing(), self.gaussians(), camera, self.larger);
        self.project.record(rec, self.existing(), self.gaussians(), camera, near);
        self.bin.record(rec, self.projected(), camera.size, limits)
    }
}

/// A model on the device.
#[derive(Clone, Copy)]
pub enum Model<'a> {
    /// Anchors and their decoders.
    Anchors {
        /// The anchors.
        anchors: &'a Anchors,
        /// The decoders, flat.
        weights: &'a Buffer<f32>,
    },
    /// Plain Gaussians.
    Gaussians(&'a Static),
}

//! Representations of the model on the device: what is learnt, how it becomes the Gaussians of a view, both ways, and how it
//! grows. Each has a file here; behind [`upload`] nothing asks which one it is.

mod anchors;
mod gaussians;

pub use anchors::most as most_anchors;

use crate::densify::{Config, Round, Statistics};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::{Anchors, Decoded};
use crate::model::gaussians::Static;
use crate::model::parameter::Parameter;
use crate::model::stored::Stored;
use crate::primitives::Count;
use crate::primitives::limit::{COUNTERS, Counter, Limits};
use crate::render::activate::Activate;
use crate::render::decode::{Decode, DecodeBackward, GaussianGradients};
use crate::render::project::Gaussians;
use crate::render::slots::Slots;
use crate::render::visible::Visible;
use crate::scene::Camera;

/// A model on the device, whatever it is made of, as the stages, the optimiser and the files see it.
pub trait Representation: Send + Sync {
    /// Rows in use: anchors, or plain Gaussians.
    fn count(&self) -> u32;

    /// Rows there is room for.
    fn capacity(&self) -> u32;

    /// Gaussians of a row.
    fn offsets(&self) -> u32;

    /// Whether a Gaussian that is smaller than a pixel is drawn fainter: see [`crate::render::compensate`].
    fn antialiased(&self) -> bool {
        false
    }

    /// The parameters with a value for each row.
    fn rows(&self) -> Vec<&Parameter>;

    /// The decoders, flat, of a model that has them: one row.
    fn weights(&self) -> Option<&Parameter> {
        None
    }

    /// All parameters, rows before networks, to be changed.
    fn parameters_mut(&mut self) -> Vec<&mut Parameter>;

    /// The anchors, of a model that has them.
    fn anchors(&self) -> Option<&Anchors> {
        None
    }

    /// The model as it is now, with these projections of an attention.
    ///
    /// # Errors
    /// Errors of the copies.
    fn stored(&self, gpu: &Gpu, attention: Option<&[f32]>) -> Result<Stored, Error>;

    /// Rows of one view that its stages have room for.
    fn in_view(&self, capacity: Capacity) -> u32;

    /// The stages between what is learnt and the Gaussians of a view.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    fn front(&self, gpu: &Gpu, capacity: Capacity, cull: bool) -> Result<Front, Error>;

    /// Records which rows are in view.
    ///
    /// # Panics
    /// Like all that follow, for the front of another representation.
    fn cull(&self, _: &mut Recorder<'_>, _: &Front, _: &Camera, _near: f32, _: &Limits) {}

    /// Records the Gaussians of the rows in view; of these features, where they are not those that are learnt.
    fn decode(
        &self,
        rec: &mut Recorder<'_>,
        front: &Front,
        feature: Option<&Buffer<f32>>,
        camera: &Camera,
        limits: &Limits,
    );

    /// Scratch for the way back, if it needs any: to features, to networks.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    fn scratch(&self, _: &Gpu, _: &Front, _wanted: [bool; 2]) -> Result<Option<DecodeBackward>, Error> {
        Ok(None)
    }

    /// Records the gradients of what is learnt, behind [`Representation::decode`] of the same features. Rows of Gaussians that
    /// are not drawn are left alone.
    fn backward(
        &self,
        rec: &mut Recorder<'_>,
        stages: (&Front, Option<&DecodeBackward>),
        feature: Option<&Buffer<f32>>,
        drawn: &Slots,
        gradients: GaussianGradients<'_>,
    );

    /// A round of growth, by what the steps since the last one have counted; says what changed, if anything has.
    ///
    /// # Errors
    /// When the device has no room.
    fn grow(
        &mut self,
        gpu: &Gpu,
        config: &Config,
        round: Round,
        counted: Option<&mut Statistics>,
    ) -> Result<String, Error>;

    /// Counts so many rows as in use, as far as the room for those of all rounds is there from the first step on: for
    /// rehearsals.
    fn swell(&mut self, _rows: u32) {}
}

/// A model on the device with room for at least so many rows, moments zero. Harmonics beyond the first are learnt at `higher`
/// times the rate of the first.
///
/// # Errors
/// When the device has no room for it.
pub fn upload(gpu: &Gpu, model: &Stored, rows: u32, higher: f32) -> Result<Box<dyn Representation>, Error> {
    Ok(match model {
        Stored::Anchors(anchors, weights) => Box::new(Decoded::upload(gpu, anchors, &weights.decoders(), rows)?),
        Stored::Gaussians(cloud) => Box::new(Static::with_room(gpu, cloud, rows, higher)?),
    })
}

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

impl Front {
    /// The anchors in view, and their Gaussians.
    ///
    /// # Panics
    /// For stages of plain Gaussians.
    pub fn of_anchors(&self) -> (&Visible, &Decode) {
        let Self::Anchors { visible, decode } = self else { panic!("plain Gaussians are neither culled nor decoded") };
        (visible, decode)
    }

    /// Plain Gaussians as they are drawn, and all of their slots.
    ///
    /// # Panics
    /// For stages of anchors.
    pub fn of_gaussians(&self) -> (&Activate, &Slots) {
        let Self::Gaussians { activate, all, .. } = self else { panic!("anchors' Gaussians are decoded") };
        (activate, all)
    }

    /// The Gaussians: how many slots, those that exist, as the projection reads them, opacity and colour.
    pub(crate) fn drawn(&self) -> (Count<'_>, &Slots, Gaussians<'_>, &Buffer<f32>, &Buffer<[f32; 3]>) {
        match self {
            Self::Anchors { decode, .. } => {
                let Decode { existing, position, scale, rotation, opacity, color, .. } = decode;
                (decode.slots(), existing, Gaussians { position, scale, rotation }, opacity, color)
            }
            Self::Gaussians { activate: Activate { seen: position, scale, rotation, opacity, color }, all, count } => {
                (Count::Host(*count), all, Gaussians { position, scale, rotation }, opacity, color)
            }
        }
    }
}

/// As many (Gaussian, tile) pairs as the device trains: the widest array over them holds three floats each.
fn most_pairs(gpu: &Gpu) -> u32 {
    (gpu.info().max_binding_bytes / 12).min(u32::MAX.into()) as u32
}

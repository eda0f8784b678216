//! The model on the device, in one of its forms.

use super::anchors::Anchors;
use super::gaussians::Static;
use super::parameter::Parameter;

/// Everything that is learnt but the attention, with Adam's moments.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "a step has one")]
pub enum Learnt {
    /// Anchors, and the decoders that make Gaussians of them.
    Anchors {
        /// The anchors.
        anchors: Anchors,
        /// The decoders, flat.
        weights: Parameter,
    },
    /// The Gaussians themselves.
    Gaussians(Static),
}

impl Learnt {
    /// Anchors or plain Gaussians in use: the rows of [`Learnt::rows`].
    pub fn count(&self) -> u32 {
        match self {
            Self::Anchors { anchors, .. } => anchors.count,
            Self::Gaussians(gaussians) => gaussians.count,
        }
    }

    /// Rows there is room for.
    pub fn capacity(&self) -> u32 {
        match self {
            Self::Anchors { anchors, .. } => anchors.capacity,
            Self::Gaussians(gaussians) => gaussians.capacity,
        }
    }

    /// Gaussians of a row.
    pub fn offsets(&self) -> u32 {
        match self {
            Self::Anchors { anchors, .. } => anchors.offsets,
            Self::Gaussians(_) => 1,
        }
    }

    /// The parameters with a row for each anchor or plain Gaussian.
    pub fn rows(&self) -> Vec<&Parameter> {
        match self {
            Self::Anchors { anchors, .. } => anchors.parameters().iter().collect(),
            Self::Gaussians(gaussians) => gaussians.parameters().to_vec(),
        }
    }

    /// The decoders, flat, of a model that has them: one row.
    pub fn weights(&self) -> Option<&Parameter> {
        match self {
            Self::Anchors { weights, .. } => Some(weights),
            Self::Gaussians(_) => None,
        }
    }

    /// All parameters, rows before networks, to be changed.
    pub fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        match self {
            Self::Anchors { anchors, weights } => anchors.parameters_mut().iter_mut().chain([weights]).collect(),
            Self::Gaussians(gaussians) => gaussians.parameters_mut().into_iter().collect(),
        }
    }
}

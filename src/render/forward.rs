//! The forward stages, from what is learnt to the tiles' lists.

use super::bin::{Bin, Binned};
use super::decode::Decode;
use super::method::Method;
use super::project::{Gaussians, Project, Projected};
use super::slots::Slots;
use super::visible::Visible;
use super::widen;
use crate::gpu::{Error, Gpu, Recorder};
use crate::primitives::limit::Limits;
pub use crate::representation::{Capacity, Front, Representation};
use crate::scene::Camera;
use crate::stage;

/// The forward stages, from the model to a picture.
pub struct Forward {
    /// The stages that a representation has of its own.
    pub front: Front,
    /// Gaussians on the picture.
    pub project: Project,
    /// Tiles' lists.
    pub bin: Bin,
    /// Slots of Gaussians that there is room for.
    pub slots: u32,
    /// How many times larger the pictures are than those of the training: see [`widen`].
    pub larger: f64,
    method: Method,
}

impl Forward {
    /// Stages for this model and pictures of at most `size`; for plain Gaussians, as many as there are now.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(
        gpu: &Gpu,
        capacity: Capacity,
        model: &dyn Representation,
        method: Method,
        size: [u32; 2],
        cull: bool,
    ) -> Result<Self, Error> {
        let (rows, offsets) = (model.in_view(capacity), model.offsets());
        let slots = rows.saturating_mul(offsets);
        Ok(Self {
            front: model.front(gpu, capacity, cull)?,
            project: gpu.stage(stage::PROJECT, || Project::new(gpu, rows, offsets))?,
            bin: gpu.stage(stage::BIN, || Bin::new(gpu, method, slots, capacity.pairs, size))?,
            slots,
            larger: 1.0,
            method,
        })
    }

    /// The anchors in view.
    ///
    /// # Panics
    /// For stages of plain Gaussians.
    pub fn visible(&self) -> &Visible {
        self.front.of_anchors().0
    }

    /// The anchors' Gaussians.
    ///
    /// # Panics
    /// For stages of plain Gaussians.
    pub fn decode(&self) -> &Decode {
        self.front.of_anchors().1
    }

    /// The Gaussians that there are, by slot.
    pub fn existing(&self) -> &Slots {
        self.front.drawn().1
    }

    /// What the pictures are computed with.
    pub fn method(&self) -> Method {
        self.method
    }

    /// The Gaussians as the projection reads them.
    pub fn gaussians(&self) -> Gaussians<'_> {
        self.front.drawn().2
    }

    /// The projected Gaussians as the rasteriser reads them.
    pub fn projected(&self) -> Projected<'_> {
        let (slots, existing, _, opacity, color) = self.front.drawn();
        let Project { mean, covariance, depth } = &self.project;
        Projected { slots, existing, mean, covariance, depth, opacity, color }
    }

    /// Records everything before the picture: which rows are in view, their Gaussians, and the tiles' lists.
    ///
    /// # Panics
    /// For a model of another representation than the stages'.
    pub fn record<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        model: &dyn Representation,
        camera: &Camera,
        near: f32,
        limits: &Limits,
    ) -> Binned<'s> {
        model.cull(rec, &self.front, camera, near, limits);
        model.decode(rec, &self.front, None, camera, limits);
        widen::record(rec, self.existing(), self.gaussians(), camera, self.larger);
        self.project.record(rec, self.existing(), self.gaussians(), camera, near);
        self.bin.record(rec, self.projected(), camera.size, limits)
    }
}

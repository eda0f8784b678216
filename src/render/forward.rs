//! The forward stages, from what is learnt to the tiles' lists.

use super::bin::{Bin, Binned};
use super::compensate::{self, Compensate};
use super::decode::Decode;
use super::method::Method;
use super::project::{Gaussians, Project, Projected};
use super::slots::Slots;
use super::visible::Visible;
use super::widen;
use crate::gpu::{Buffer, Error, Gpu, Recorder};
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
    /// The opacities that are drawn, where the model was trained for antialiasing.
    pub compensate: Option<Compensate>,
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
            compensate: model
                .antialiased()
                .then(|| gpu.stage(stage::PROJECT, || Compensate::new(gpu, slots)))
                .transpose()?,
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
        let opacity = self.compensate.as_ref().map_or(opacity, |compensate| &compensate.drawn);
        Projected { slots, existing, mean, covariance, depth, opacity, color }
    }

    /// Records the Gaussians that exist onto the picture.
    pub fn project(&self, rec: &mut Recorder<'_>, camera: &Camera, near: f32) {
        let (_, existing, gaussians, opacity, _) = self.front.drawn();
        self.project.record(rec, existing, gaussians, camera, near);
        if let Some(compensate) = &self.compensate {
            compensate.record(rec, existing, &self.project.covariance, opacity);
        }
    }

    /// Records what makes gradients of the opacity that is drawn, in their place, those of the opacity; those of the
    /// covariance's factors get their share.
    pub fn uncompensate(
        &self,
        rec: &mut Recorder<'_>,
        drawn: &Slots,
        grad_covariance: &Buffer<[f32; 3]>,
        grad_opacity: &Buffer<f32>,
    ) {
        if self.compensate.is_some() {
            let of = (&self.project.covariance, self.front.drawn().3);
            compensate::backward(rec, drawn, of, (grad_covariance, grad_opacity));
        }
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
        if self.compensate.is_none() {
            widen::record(rec, self.existing(), self.gaussians(), camera, self.larger);
        }
        self.project(rec, camera, near);
        self.bin.record(rec, self.projected(), camera.size, limits)
    }
}

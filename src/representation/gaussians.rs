//! Plain Gaussians as a representation of the model: each is a row, drawn in every view.

use super::{Capacity, Front, Representation};
use crate::densify::{Config, Round, Statistics, split};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::gaussians::Static;
use crate::model::parameter::Parameter;
use crate::model::stored::Stored;
use crate::primitives::limit::{Counter, Limits};
use crate::render::activate::{self, Activate};
use crate::render::decode::{DecodeBackward, GaussianGradients};
use crate::render::slots::Slots;
use crate::scene::Camera;
use crate::stage;

impl Representation for Static {
    fn count(&self) -> u32 {
        self.count
    }

    fn capacity(&self) -> u32 {
        self.capacity
    }

    fn offsets(&self) -> u32 {
        1
    }

    fn antialiased(&self) -> bool {
        self.antialiased
    }

    fn rows(&self) -> Vec<&Parameter> {
        self.parameters().to_vec()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters_mut().into()
    }

    fn stored(&self, gpu: &Gpu, _: Option<&[f32]>) -> Result<Stored, Error> {
        Ok(Stored::Gaussians(self.read(gpu)?))
    }

    fn in_view(&self, _: Capacity) -> u32 {
        self.count
    }

    fn front(&self, gpu: &Gpu, _: Capacity, _cull: bool) -> Result<Front, Error> {
        gpu.stage(stage::DECODE, || {
            let (activate, all) = (Activate::new(gpu, self.count)?, Slots::all(gpu, self.count)?);
            Ok(Front::Gaussians { activate, all, count: self.count })
        })
    }

    fn decode(&self, rec: &mut Recorder<'_>, front: &Front, _: Option<&Buffer<f32>>, camera: &Camera, limits: &Limits) {
        let (activate, all) = front.of_gaussians();
        activate.record(rec, self, camera.center());
        limits.note(rec, &all.count, Counter::Visible);
    }

    fn backward(
        &self,
        rec: &mut Recorder<'_>,
        (front, _): (&Front, Option<&DecodeBackward>),
        _: Option<&Buffer<f32>>,
        drawn: &Slots,
        gradients: GaussianGradients<'_>,
    ) {
        activate::backward(rec, self, front.of_gaussians().0, drawn, gradients);
    }

    fn grow(&mut self, gpu: &Gpu, config: &Config, round: Round, _: Option<&mut Statistics>) -> Result<String, Error> {
        let before = self.count;
        let moved = split::run(gpu, self, config, round)?;
        let (step, now, new) = (round.step, self.count, self.count - before);
        let text =
            || format!("step {step}: {moved} faded Gaussians are halves of others, {new} new: {before} -> {now}");
        Ok(if moved == 0 && new == 0 { String::new() } else { text() })
    }

    fn swell(&mut self, rows: u32) {
        self.count = rows.clamp(self.count, self.capacity);
    }
}

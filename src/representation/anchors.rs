//! Anchors as a representation of the model: those in view are decoded into Gaussians.

use super::{Capacity, Front, Representation};
use crate::densify::{Config, Round, Statistics, grow, prune};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::{Anchors, Decoded};
use crate::model::files::Weights;
use crate::model::parameter::Parameter;
use crate::model::stored::Stored;
use crate::primitives::limit::Limits;
use crate::render::decode::{self, Decode, DecodeBackward, GaussianGradients, WantedGradients};
use crate::render::slots::Slots;
use crate::render::visible::Visible;
use crate::scene::Camera;
use crate::stage;

/// As many anchors of `offsets` Gaussians as the device trains: each of their arrays fits one binding, and so does each
/// array that a view needs which shows all of them.
pub fn most(gpu: &Gpu, offsets: u32) -> u32 {
    let in_view = gpu.info().max_binding_bytes.min(u32::MAX.into()) / decode::widest(offsets);
    Anchors::most(gpu, offsets).min(in_view as u32)
}

impl Decoded {
    /// Anchors as the decoder reads them.
    fn read_by<'a>(
        &'a self,
        visible: &'a Visible,
        feature: Option<&'a Buffer<f32>>,
        offset: &'a Buffer<[f32; 3]>,
    ) -> decode::Anchors<'a> {
        let Self { anchors, weights } = self;
        decode::Anchors {
            position: &anchors.position,
            feature: feature.unwrap_or(&anchors.feature().value),
            offset,
            log_scaling: &anchors.log_scaling().value,
            weights: &weights.value,
            visible: &visible.list,
        }
    }
}

impl Representation for Decoded {
    fn count(&self) -> u32 {
        self.anchors.count
    }

    fn capacity(&self) -> u32 {
        self.anchors.capacity
    }

    fn offsets(&self) -> u32 {
        self.anchors.offsets
    }

    fn rows(&self) -> Vec<&Parameter> {
        self.anchors.parameters().iter().collect()
    }

    fn weights(&self) -> Option<&Parameter> {
        Some(&self.weights)
    }

    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.anchors.parameters_mut().iter_mut().chain([&mut self.weights]).collect()
    }

    fn anchors(&self) -> Option<&Anchors> {
        Some(&self.anchors)
    }

    fn stored(&self, gpu: &Gpu, attention: Option<&[f32]>) -> Result<Stored, Error> {
        let flat = self.weights.read(gpu, 1)?;
        let weights = Weights::from_device(self.anchors.offsets as usize, &flat, attention);
        Ok(Stored::Anchors(self.anchors.read(gpu)?, weights))
    }

    fn in_view(&self, capacity: Capacity) -> u32 {
        capacity.visible
    }

    fn front(&self, gpu: &Gpu, capacity: Capacity, cull: bool) -> Result<Front, Error> {
        let Capacity { anchors, visible: rows, .. } = capacity;
        Ok(Front::Anchors {
            visible: gpu.stage(stage::CULL, || Visible::new(gpu, anchors, rows, cull))?,
            decode: gpu.stage(stage::DECODE, || Decode::new(gpu, rows, self.anchors.offsets))?,
        })
    }

    fn cull(&self, rec: &mut Recorder<'_>, front: &Front, camera: &Camera, near: f32, limits: &Limits) {
        front.of_anchors().0.record(rec, &self.anchors, camera, near, limits);
    }

    fn decode(
        &self,
        rec: &mut Recorder<'_>,
        front: &Front,
        feature: Option<&Buffer<f32>>,
        camera: &Camera,
        _: &Limits,
    ) {
        let ((visible, decode), offset) = (front.of_anchors(), self.anchors.offset().value.view());
        decode.record(rec, self.read_by(visible, feature, &offset), &visible.count, camera.center());
    }

    fn scratch(
        &self,
        gpu: &Gpu,
        front: &Front,
        [feature, weights]: [bool; 2],
    ) -> Result<Option<DecodeBackward>, Error> {
        let decode = front.of_anchors().1;
        gpu.stage(stage::DECODE_BACKWARD, || DecodeBackward::of(gpu, decode, feature, weights)).map(Some)
    }

    fn backward(
        &self,
        rec: &mut Recorder<'_>,
        (front, scratch): (&Front, Option<&DecodeBackward>),
        feature: Option<&Buffer<f32>>,
        _: &Slots,
        gradients: GaussianGradients<'_>,
    ) {
        let ((visible, decode), parameter) = (front.of_anchors(), self.anchors.offset());
        let (offset, grad_offset) = (parameter.value.view(), parameter.gradient.as_ref().map(Buffer::view));
        let to = WantedGradients {
            feature: self.anchors.feature().gradient.as_ref(),
            offset: grad_offset.as_ref(),
            log_scaling: self.anchors.log_scaling().gradient.as_ref(),
            weights: self.weights.gradient.as_ref(),
        };
        let scratch = scratch.expect("made with the front");
        scratch.record(rec, decode, self.read_by(visible, feature, &offset), gradients, to);
    }

    fn grow(
        &mut self,
        gpu: &Gpu,
        config: &Config,
        round: Round,
        counted: Option<&mut Statistics>,
    ) -> Result<String, Error> {
        let (Self { anchors, .. }, Some(statistics)) = (self, counted) else { return Ok(String::new()) };
        let most = most(gpu, anchors.offsets);
        let max_anchors = if config.max_anchors == 0 { most } else { config.max_anchors.min(most) };
        let config = &Config { max_anchors, ..config.clone() };
        let before = anchors.count;
        let grown = grow::run(gpu, anchors, statistics, config, round)?;
        let pruned = prune::run(gpu, anchors, statistics, config)?;
        let step = round.step;
        let mut text =
            format!("step {step}: {} new anchors, {pruned} pruned: {before} -> {}", grown.added, anchors.count);
        if grown.refused > 0 {
            text.push_str(&format!(
                "; {} more had no room (densify.max_anchors, or the device's memory)",
                grown.refused
            ));
        }
        if grown.beyond > 0 {
            text.push_str(&format!(
                "; {} Gaussians lie more than {:.0e} cells from the origin, where none grows: move the scene or raise model.voxel",
                grown.beyond,
                grow::CELL_LIMIT
            ));
        }
        Ok(text)
    }
}

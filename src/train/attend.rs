//! Cross-attention within a step: choose tokens in a patch around the mask, blend their features, and back.

use super::order::{Stream, random};
use super::photographs::Photograph;
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::math::attention::WEIGHTS;
use crate::model::anchors::Anchors;
use crate::model::attention::blend::{Blend, Inputs};
use crate::model::attention::select::{Chosen, Draw, KEY_BITS, Select, View, patch_position};
use crate::model::config::Attention as Config;
use crate::model::parameter::{PROJECTIONS, Parameter};
use crate::optimizer::Group;
use crate::primitives::Count;
use crate::primitives::sort::{Pairs, Sort};
use crate::render::visible::Visible;

/// The stage, from the step at which attention starts.
pub struct Attend {
    config: Config,
    seed: u64,
    room: Option<Room>,
    blend: Blend,
    /// Projections, flat, with their gradient.
    pub weights: Parameter,
}

/// What depends on the number of anchors.
struct Room {
    select: Select,
    sort: Sort,
    blended: Buffer<f32>,
}

impl Room {
    fn new(gpu: &Gpu, config: &Config, anchors: u32) -> Result<Self, Error> {
        Ok(Self {
            select: Select::new(gpu, anchors as usize, config.tokens, config.min_tokens)?,
            sort: Sort::new(gpu, anchors)?,
            blended: gpu.buffer("blended", anchors as usize * 32)?,
        })
    }
}

/// The anchors chosen in a step.
#[derive(Clone, Copy)]
pub struct Attended<'a> {
    chosen: Chosen<'a>,
    reference: bool,
    /// The features to decode.
    pub feature: &'a Buffer<f32>,
}

impl<'a> Attended<'a> {
    /// `[2]` how many there are inside and around; both 0 where the step has no attention, and no gradient of it.
    pub fn tokens(&self) -> &'a Buffer<u32> {
        self.chosen.tokens
    }
}

impl Attend {
    /// The stage for so many anchors with these initial projections.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, config: &Config, seed: u64, anchors: u32, weights: &[f32]) -> Result<Self, Error> {
        let mut weights = Parameter::upload(gpu, PROJECTIONS, WEIGHTS as u32, 1, weights)?.in_group(Group::Attention);
        weights.make_gradient(gpu)?;
        Ok(Self {
            seed,
            room: Some(Room::new(gpu, config, anchors)?),
            blend: Blend::new(gpu, config.tokens, config.blend as f32)?,
            weights,
            config: config.clone(),
        })
    }

    /// Gives back what depends on the number of anchors, until [`Attend::furnish`].
    pub fn release(&mut self) {
        self.room = None;
    }

    /// Makes it again, for so many anchors.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn furnish(&mut self, gpu: &Gpu, anchors: u32) -> Result<(), Error> {
        self.release();
        self.room = Some(Room::new(gpu, &self.config, anchors)?);
        Ok(())
    }

    /// dL/d projections.
    pub fn grad_weights(&self) -> &Buffer<f32> {
        self.weights.gradient.as_ref().expect("made with the projections")
    }

    fn room(&self) -> &Room {
        self.room.as_ref().expect("released only while no step is recorded")
    }

    /// Chooses tokens and blends their features; nothing where the view has no mask.
    pub fn forward<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        anchors: &Anchors,
        visible: &Visible,
        photograph: &Photograph,
        near: f32,
        step: u32,
    ) -> Option<Attended<'a>> {
        let [x0, y0, x1, y1] = photograph.mask_box?;
        let camera = &photograph.camera;
        let view = View {
            rotation: camera.rotation,
            center: camera.center(),
            lens: [camera.focal[0], camera.focal[1], camera.principal[0], camera.principal[1]],
            distortion: camera.distortion,
            near,
            max_radius2: camera.max_radius2(),
            size: camera.size,
        };
        let mut rng = random(self.seed, Stream::Patch, step);
        let side = (self.config.patch / photograph.reduction).max(1);
        let patch = patch_position(&mut rng, ([x0, y0], [x1, y1]), side, camera.size);
        let draw = Draw { patch, seed: folded(self.seed), step };
        let Room { select, sort, blended } = self.room();
        let listed = (&visible.list, &visible.count, anchors.count);
        let candidates = select.candidates(rec, listed, &anchors.position, &photograph.picture, &view, draw);
        let pairs = Pairs { keys: candidates.keys, values: candidates.anchors };
        let sorted = sort.record(rec, pairs, Count::Device(&visible.count), KEY_BITS);
        let chosen = select.take(rec, sorted.values);
        let inputs = Inputs { chosen, weights: &self.weights.value };
        let feature = &anchors.feature().value;
        let attended = Attended { chosen, reference: photograph.reference, feature: blended };
        if self.config.write_back {
            let which = (anchors.count as usize, attended.reference);
            self.blend.mix_to_write_back(rec, inputs, feature, blended, which);
        } else {
            self.blend.mix(rec, inputs, feature, blended, anchors.count as usize);
        }
        Some(attended)
    }

    /// Writes the blended features into the anchors where the settings say so, unless the step overflowed. Returns the
    /// flag that makes the optimiser leave the projections alone: the step overflowed, or had no tokens.
    pub fn write_back(
        &self,
        rec: &mut Recorder<'_>,
        attended: Attended<'_>,
        anchors: &Anchors,
        overflow: &Buffer<u32>,
    ) -> &Buffer<u32> {
        let skip = self.blend.attention().skip(rec, attended.chosen.tokens, overflow);
        if self.config.write_back {
            self.blend.write_back(rec, attended.chosen, skip, &anchors.feature().value, attended.reference);
        }
        skip
    }

    /// From the gradient of the decoded features to that of the features and of the projections.
    pub fn backward(&self, rec: &mut Recorder<'_>, attended: Attended<'_>, anchors: &Anchors) {
        let Some(grad_feature) = &anchors.feature().gradient else { return };
        let inputs = Inputs { chosen: attended.chosen, weights: &self.weights.value };
        if self.config.write_back {
            self.blend.weights_backward(rec, inputs, grad_feature, self.grad_weights());
        } else {
            self.blend.backward(rec, inputs, grad_feature, self.grad_weights());
        }
    }
}

/// A seed's 64 bits in 32, each of which counts.
fn folded(seed: u64) -> u32 {
    (seed ^ seed >> 32) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bit_of_a_seed_counts() {
        for bit in 0..64 {
            assert_ne!(folded(7), folded(7 ^ 1 << bit), "bit {bit}");
        }
    }
}

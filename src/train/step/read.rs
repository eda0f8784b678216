//! Drawing and reading the model between steps.

use super::Step;
use crate::gpu::Error;
use crate::model::files;
use crate::model::parameter::Parameter;
use crate::model::stored::Stored;
use crate::render::forward::Capacity;
use crate::render::rasterize::Picture;
use crate::render::view::{Painter, Rendered};
use crate::scene::Camera;
use crate::stage;

impl Step {
    /// Draws the model as it is now from these cameras, one after the other, and hands each picture to `look`. The step's
    /// own stages make room meanwhile, so that nothing of the step may be in flight.
    ///
    /// # Errors
    /// When the device has no room, or is lost; `look`'s own.
    pub fn draw<'c, E: From<Error>>(
        &mut self,
        cameras: impl IntoIterator<Item = &'c Camera>,
        mut look: impl FnMut(usize, Rendered) -> Result<(), E>,
    ) -> Result<(), E> {
        self.release();
        let gpu = self.gpu.clone();
        gpu.stage(stage::EVALUATION, || {
            let mut painter = Painter::new(&gpu, &self.config.render, self.capacity)?;
            let draw = |(i, camera)| look(i, painter.render(&*self.learnt, camera)?);
            cameras.into_iter().enumerate().try_for_each(draw)
        })?;
        Ok(self.furnish()?)
    }

    /// One picture of the model as it is now, in memory of its own that is freed behind it: the step stays as it is, whether
    /// that is to be had or not. None for a camera that sees several times as much as those of training. Nothing of the step
    /// may be in flight.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn glance(&self, camera: &Camera) -> Result<Option<Rendered>, Error> {
        self.gpu.stage(stage::EVALUATION, || {
            let capacity = Capacity { anchors: self.learnt.capacity(), ..self.capacity };
            let longest = |size: &[u32; 2]| f64::from(size[0].max(size[1]));
            let trained = self.plan.sizes.iter().map(longest).fold(1.0, f64::max);
            let painter = Painter::new(&self.gpu, &self.config.render, capacity)?;
            let mut painter = painter.larger(longest(&camera.size) / trained);
            painter.render_within(&*self.learnt, camera, capacity.pairs.max(1 << 20).saturating_mul(4))
        })
    }

    /// The gradients of the last recorded step by PyTorch's names, of what is trained: for tests.
    ///
    /// # Errors
    /// Errors of the copies.
    pub fn gradients(&self) -> Result<std::collections::BTreeMap<String, Vec<f32>>, Error> {
        let mut all = std::collections::BTreeMap::new();
        let read = |parameter: &Parameter, rows: u32| {
            let len = (rows * parameter.width) as usize;
            parameter.gradient.as_ref().map(|gradient| self.gpu.read_range(gradient, len)).transpose()
        };
        for parameter in self.learnt.rows() {
            let gradient = read(parameter, self.learnt.count())?;
            all.extend(gradient.map(|gradient| (parameter.names.value.to_owned(), gradient)));
        }
        let weights = self.learnt.weights().map(|weights| read(weights, 1)).transpose()?;
        let Some(flat) = weights.flatten() else { return Ok(all) };
        let attention = self.attend.as_ref().map_or(Ok(None), |attend| read(&attend.weights, 1))?;
        let weights = files::Weights::from_device(self.learnt.offsets() as usize, &flat, attention.as_deref());
        all.extend(weights.tensors.into_iter().map(|(name, tensor)| (name, tensor.data)));
        Ok(all)
    }

    /// The rendered colour, and depth where the plan has it, of the last step.
    pub fn picture(&self, size: [u32; 2]) -> &Picture {
        &self.canvas(size).picture
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// Errors of the copies.
    pub fn stored(&self) -> Result<Stored, Error> {
        let attention = self.attend.as_ref().map(|attend| attend.weights.read(&self.gpu, 1)).transpose()?;
        self.learnt.stored(&self.gpu, attention.as_deref().or(self.attention_weights.as_deref()))
    }

    /// The anchors and networks as they are now.
    ///
    /// # Errors
    /// Errors of the copies.
    ///
    /// # Panics
    /// For a step of plain Gaussians.
    pub fn model(&self) -> Result<(files::Anchors, files::Weights), Error> {
        let Stored::Anchors(anchors, weights) = self.stored()? else { panic!("plain Gaussians have no anchors") };
        Ok((anchors, weights))
    }
}

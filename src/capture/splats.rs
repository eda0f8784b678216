//! The Gaussians of a fit, one by one: who has a share in which pixels, and pictures with other colours.
//!
//! A Gaussian is named by its anchor and its number within it, `anchor K + k`: decoded Gaussians differ from view to view,
//! their names do not.

use crate::gpu::{Buffer, Error, Gpu};
use crate::model::anchors::Anchors;
use crate::model::files;
use crate::primitives::limit::Limits;
use crate::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient, Projected};
use crate::render::view::{Capacity, Forward, Model, Rendered};
use crate::render::{Config, Method};
use crate::scene::Camera;

/// The stages of one picture size.
struct Stages {
    forward: Forward,
    backward: Backward,
    picture: Picture,
    gradient: Buffer<[f32; 3]>,
    color: Buffer<[f32; 3]>,
    opacity: Buffer<f32>,
}

/// Draws and questions a model Gaussian by Gaussian.
pub struct Splats {
    gpu: Gpu,
    anchors: Anchors,
    weights: Buffer<f32>,
    method: Method,
    near: f32,
    cull: bool,
    limits: Limits,
    capacity: Capacity,
    stages: Option<Stages>,
}

impl Splats {
    /// Of this model.
    ///
    /// # Errors
    /// When the device has no room for it.
    pub fn new(gpu: &Gpu, anchors: &files::Anchors, weights: &files::Weights, config: &Config) -> Result<Self, Error> {
        let weights = gpu.upload("weights", &weights.decoders())?;
        let anchors = Anchors::upload(gpu, anchors, 0)?;
        Ok(Self {
            gpu: gpu.clone(),
            method: Method::new(gpu, config)?,
            near: config.near as f32,
            cull: config.cull,
            limits: Limits::new(gpu)?,
            capacity: Capacity::guess(anchors.count),
            anchors,
            weights,
            stages: None,
        })
    }

    /// How many names there are.
    pub fn len(&self) -> usize {
        self.anchors.count as usize * self.anchors.offsets as usize
    }

    /// How many names an anchor has.
    pub fn offsets(&self) -> usize {
        self.anchors.offsets as usize
    }

    /// Whether there is no Gaussian at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Stages whose forward part was recorded and run for a camera, with the names of the Gaussians by slot.
    fn decode(&mut self, camera: &Camera) -> Result<(Stages, Vec<(u32, u32)>), Error> {
        loop {
            let stages = match self.stages.take() {
                Some(stages) if stages.picture.size == camera.size => stages,
                old => {
                    drop(old);
                    self.make(camera.size)?
                }
            };
            let mut rec = self.gpu.recorder()?;
            let model = Model { anchors: &self.anchors, weights: &self.weights };
            stages.forward.record(&mut rec, model, camera, self.near, &self.limits);
            rec.submit()?.wait()?;
            if self.gpu.read(self.limits.overflow())?[0] == 0 {
                let visible = self.gpu.read(&stages.forward.visible.count)?[0];
                let list = self.gpu.read_range(&stages.forward.visible.list, visible as usize)?;
                let existing = &stages.forward.decode.existing;
                let count = self.gpu.read(&existing.count)?[0] as usize;
                let offsets = self.anchors.offsets;
                let named = |slot: u32| (slot, list[(slot % visible) as usize] * offsets + slot / visible);
                let names = self.gpu.read_range(&existing.list, count)?.into_iter().map(named).collect();
                return Ok((stages, names));
            }
            drop(stages);
            let counters = self.gpu.read(self.limits.counters())?;
            self.capacity = self.capacity.fit(std::array::from_fn(|i| counters[i]));
            let mut rec = self.gpu.recorder()?;
            self.limits.lower(&mut rec);
            rec.submit()?.wait()?;
        }
    }

    fn make(&self, size: [u32; 2]) -> Result<Stages, Error> {
        let (gpu, capacity, offsets) = (&self.gpu, self.capacity, self.anchors.offsets);
        let pixels = size[0] as usize * size[1] as usize;
        let slots = (capacity.visible * offsets) as usize;
        Ok(Stages {
            forward: Forward::new(gpu, capacity, offsets, self.method, size, self.cull)?,
            backward: Backward::new(gpu, self.method, slots, capacity.pairs as usize, Outputs::Color)?,
            picture: Picture::new(gpu, size, pixels, Outputs::Transmittance)?,
            gradient: gpu.buffer("grad_rgb", pixels)?,
            color: gpu.buffer("color", slots)?,
            opacity: gpu.buffer("opacity", slots)?,
        })
    }

    /// The colours that the Gaussians near this camera's view have in it, by name; hidden ones, too.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn colors(&mut self, camera: &Camera) -> Result<Vec<(u32, [f32; 3])>, Error> {
        let (stages, names) = self.decode(camera)?;
        let colors = self.gpu.read(&stages.forward.decode.color)?;
        self.stages = Some(stages);
        Ok(names.into_iter().map(|(slot, name)| (name, colors[slot as usize])).collect())
    }

    /// For every Gaussian that this camera draws, its name and the sum over the pixels of its share in the pixel
    /// (alpha x transmittance) times the pixel's weights.
    ///
    /// The rasteriser's backward pass says it: the colour of a pixel is linear in the Gaussians' colours, with those
    /// shares as factors, so that the gradient of a weighted sum of the pixels' colours is just that.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    ///
    /// # Panics
    /// Unless there is a weight per pixel.
    pub fn shares(&mut self, camera: &Camera, weights: &[[f32; 3]]) -> Result<Vec<(u32, [f32; 3])>, Error> {
        assert_eq!(weights.len(), camera.size[0] as usize * camera.size[1] as usize, "a weight per pixel");
        let (stages, names) = self.decode(camera)?;
        let Stages { forward, backward, picture, gradient, .. } = &stages;
        self.gpu.write(gradient, weights)?;
        let picture = picture.color();
        let mut rec = self.gpu.recorder()?;
        let model = Model { anchors: &self.anchors, weights: &self.weights };
        let binned = forward.record(&mut rec, model, camera, self.near, &self.limits);
        rasterize::forward(&mut rec, self.method, forward.projected(), binned, [0.0; 3], &picture);
        let gradient = PictureGradient { rgb: gradient, depth: None, transmittance: None };
        backward.record(&mut rec, self.method, forward.projected(), binned, &picture, gradient);
        let drawn = binned.drawn;
        rec.submit()?.wait()?;
        let count = self.gpu.read(&drawn.count)?[0] as usize;
        let drawn = self.gpu.read_range(&drawn.list, count)?;
        let sums = self.gpu.read(&backward.grad_color)?;
        let mut of_slot = vec![u32::MAX; sums.len()];
        names.iter().for_each(|(slot, name)| of_slot[*slot as usize] = *name);
        self.stages = Some(stages);
        Ok(drawn.into_iter().map(|slot| (of_slot[slot as usize], sums[slot as usize])).collect())
    }

    /// Draws the view with other colours: `look` takes a Gaussian's name and its own colour and returns the one to draw it
    /// with, or nothing to leave it out. Nothing stands behind the Gaussians: black.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn paint(
        &mut self,
        camera: &Camera,
        look: impl Fn(u32, [f32; 3]) -> Option<[f32; 3]>,
    ) -> Result<Rendered, Error> {
        let (stages, names) = self.decode(camera)?;
        let Stages { forward, picture, color, opacity, .. } = &stages;
        let mut colors = self.gpu.read(&forward.decode.color)?;
        let mut opacities = self.gpu.read(&forward.decode.opacity)?;
        for (slot, name) in names {
            let slot = slot as usize;
            match look(name, colors[slot]) {
                Some(drawn) => colors[slot] = drawn,
                // Below the threshold of what touches a pixel.
                None => opacities[slot] = 0.0,
            }
        }
        let slots = color.len().min(colors.len());
        self.gpu.write(color, &colors[..slots])?;
        self.gpu.write(opacity, &opacities[..slots])?;
        let mut rec = self.gpu.recorder()?;
        let model = Model { anchors: &self.anchors, weights: &self.weights };
        // Binned with the opacities that they have: the lists of those left out are walked in vain.
        let binned = forward.record(&mut rec, model, camera, self.near, &self.limits);
        let gaussians = Projected { color, opacity, ..forward.projected() };
        rasterize::forward(&mut rec, self.method, gaussians, binned, [0.0; 3], picture);
        rec.submit()?.wait()?;
        let (depth, transmittance) =
            picture.depth.as_ref().zip(picture.transmittance.as_ref()).expect("the picture was made with depth");
        let rendered = Rendered {
            size: camera.size,
            rgb: self.gpu.read(&picture.rgb)?,
            depth: self.gpu.read(depth)?,
            transmittance: self.gpu.read(transmittance)?,
        };
        self.stages = Some(stages);
        Ok(rendered)
    }
}

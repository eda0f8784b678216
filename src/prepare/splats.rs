//! The Gaussians of a fit, one by one: who has a share in which pixels, and pictures with other colours.
//!
//! A Gaussian is named by its anchor and its number within it, `anchor K + k`: decoded Gaussians differ from view to view,
//! their names do not. A plain Gaussian is named by its own number.

use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::stored::Stored;
use crate::render::bin::Binned;
use crate::render::forward::{Capacity, Front};
use crate::render::project::Projected;
use crate::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use crate::render::session::{Room, Stages};
use crate::render::view::{Finished, Rendered};
use crate::render::{Config, Session};
use crate::scene::Camera;

/// What is drawn and asked beside the forward stages.
struct Canvas {
    backward: Backward,
    picture: Picture,
    gradient: Buffer<[f32; 3]>,
    color: Buffer<[f32; 3]>,
    opacity: Buffer<f32>,
}

impl Canvas {
    fn new(gpu: &Gpu, room: Room) -> Result<Self, Error> {
        Ok(Self {
            backward: Backward::new(gpu, room.method, room.slots, room.pairs, Outputs::Color)?,
            picture: Picture::new(gpu, room.size, room.pixels(), Outputs::Transmittance)?,
            gradient: gpu.buffer("grad_rgb", room.pixels())?,
            color: gpu.buffer("color", room.slots)?,
            opacity: gpu.buffer("opacity", room.slots)?,
        })
    }
}

/// A Gaussian in a view.
pub struct Share {
    /// Its name.
    pub name: u32,
    /// Sum over the pixels of its share in each (alpha x transmittance) times the pixel's weights.
    pub sums: [f32; 3],
    /// Sum over the pixels of its shares if nothing stood before it and the picture had no border: `2 pi opacity sqrt(det)`.
    pub alone: f32,
}

/// Draws and questions a model Gaussian by Gaussian.
pub struct Splats {
    gpu: Gpu,
    model: Finished,
    session: Session<Canvas>,
}

impl Splats {
    /// Of this model.
    ///
    /// # Errors
    /// When the device has no room for it.
    pub fn new(gpu: &Gpu, model: &Stored, config: &Config) -> Result<Self, Error> {
        let model = Finished::upload(gpu, model)?;
        let session = Session::new(gpu, config, Capacity::guess(model.count()), Canvas::new)?;
        Ok(Self { gpu: gpu.clone(), model, session })
    }

    /// How many names there are.
    pub fn len(&self) -> usize {
        self.model.count() as usize * self.offsets()
    }

    /// How many names an anchor has; a plain Gaussian has one.
    pub fn offsets(&self) -> usize {
        self.model.offsets() as usize
    }

    /// Whether there is no Gaussian at all.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Runs the forward stages and `work` for a camera.
    fn run(
        &mut self,
        camera: &Camera,
        work: impl Fn(&mut Recorder<'_>, &Stages<Canvas>, Binned<'_>),
    ) -> Result<&Stages<Canvas>, Error> {
        self.session.run(self.model.model(), camera, work)
    }

    /// Runs the forward stages for a camera; returns the slots of the Gaussians that exist, with their names.
    fn decode(&mut self, camera: &Camera) -> Result<Vec<(u32, u32)>, Error> {
        let (gpu, offsets) = (self.gpu.clone(), self.model.offsets());
        let forward = &self.run(camera, |_, _, _| {})?.forward;
        if let Front::Gaussians { count, .. } = forward.front {
            return Ok((0..count).map(|name| (name, name)).collect());
        }
        let visible = gpu.read(&forward.visible().count)?[0];
        let list = gpu.read_range(&forward.visible().list, visible as usize)?;
        let existing = &forward.decode().existing;
        let count = gpu.read(&existing.count)?[0] as usize;
        let named = |slot: u32| (slot, list[(slot % visible) as usize] * offsets + slot / visible);
        Ok(gpu.read_range(&existing.list, count)?.into_iter().map(named).collect())
    }

    /// The colours that the Gaussians near this camera's view have in it, by name; hidden ones, too.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn colors(&mut self, camera: &Camera) -> Result<Vec<(u32, [f32; 3])>, Error> {
        let names = self.decode(camera)?;
        let colors = self.gpu.read(self.session.stages().forward.projected().color)?;
        Ok(names.into_iter().map(|(slot, name)| (name, colors[slot as usize])).collect())
    }

    /// For every Gaussian that this camera draws, the sum over the pixels of its share in the pixel (alpha x transmittance)
    /// times the pixel's weights.
    ///
    /// The rasteriser's backward pass says it: the colour of a pixel is linear in the Gaussians' colours, with those
    /// shares as factors, so that the gradient of a weighted sum of the pixels' colours is just that.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    ///
    /// # Panics
    /// Unless there is a weight per pixel.
    pub fn shares(&mut self, camera: &Camera, weights: &[[f32; 3]]) -> Result<Vec<Share>, Error> {
        assert_eq!(weights.len(), camera.size[0] as usize * camera.size[1] as usize, "a weight per pixel");
        let names = self.decode(camera)?;
        let gpu = self.gpu.clone();
        gpu.write(&self.session.stages().own.gradient, weights)?;
        let stages = self.run(camera, |rec, stages, binned| {
            let Stages { room, forward, own: Canvas { backward, picture, gradient, .. } } = stages;
            let picture = picture.color();
            rasterize::forward(rec, room.method, forward.projected(), binned, [0.0; 3], &picture);
            let gradient = PictureGradient { rgb: gradient, depth: None, transmittance: None };
            backward.record(rec, room.method, forward.projected(), binned, &picture, gradient);
        })?;
        let drawn = stages.forward.bin.drawn();
        let count = gpu.read(&drawn.count)?[0] as usize;
        let drawn = gpu.read_range(&drawn.list, count)?;
        let sums = gpu.read(&stages.own.backward.grad_color)?;
        let projected = stages.forward.projected();
        let (covariance, opacity) = (gpu.read(projected.covariance)?, gpu.read(projected.opacity)?);
        let mut of_slot = vec![u32::MAX; sums.len()];
        names.iter().for_each(|(slot, name)| of_slot[*slot as usize] = *name);
        let share = |slot: u32| {
            let slot = slot as usize;
            let [across, _, down] = covariance[slot];
            let alone = opacity[slot] * std::f32::consts::TAU * (across * down).sqrt();
            Share { name: of_slot[slot], sums: sums[slot], alone }
        };
        Ok(drawn.into_iter().map(share).collect())
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
        let names = self.decode(camera)?;
        let gpu = self.gpu.clone();
        let Stages { forward, own: Canvas { color, opacity, .. }, .. } = self.session.stages();
        let mut colors = gpu.read(forward.projected().color)?;
        let mut opacities = gpu.read(forward.projected().opacity)?;
        for (slot, name) in names {
            let slot = slot as usize;
            match look(name, colors[slot]) {
                Some(drawn) => colors[slot] = drawn,
                // Below the threshold of what touches a pixel.
                None => opacities[slot] = 0.0,
            }
        }
        let slots = color.len().min(colors.len());
        gpu.write(color, &colors[..slots])?;
        gpu.write(opacity, &opacities[..slots])?;
        // Binned with the opacities that they have: the lists of those left out are walked in vain.
        let stages = self.run(camera, |rec, stages, binned| {
            let Stages { room, forward, own: Canvas { picture, color, opacity, .. } } = stages;
            let gaussians = Projected { color, opacity, ..forward.projected() };
            rasterize::forward(rec, room.method, gaussians, binned, [0.0; 3], picture);
        })?;
        Rendered::read(&gpu, &stages.own.picture)
    }
}

//! One picture from a finished model, for files and figures.

use super::config::BACKGROUND;
use super::forward::{Capacity, Representation};
use super::rasterize::{self, Outputs, Picture};
use super::session::{Room, Session, Stages};
use crate::gpu::{Error, Gpu};
use crate::model::stored::Stored;
use crate::representation;
use crate::scene::Camera;

/// A finished picture on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendered {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// `[pixel]` as stored, 0 to 1 in gamut.
    pub rgb: Vec<[f32; 3]>,
    /// `[pixel]` sum of z alpha T, scene units.
    pub depth: Vec<f32>,
    /// `[pixel]` what is left of the background.
    pub transmittance: Vec<f32>,
}

impl Rendered {
    /// Reads a picture with depth and transmittance.
    ///
    /// # Errors
    /// When the device is lost.
    ///
    /// # Panics
    /// For a picture that was made without them.
    pub fn read(gpu: &Gpu, picture: &Picture) -> Result<Self, Error> {
        let (depth, transmittance) =
            picture.depth.as_ref().zip(picture.transmittance.as_ref()).expect("the picture was made with depth");
        Ok(Self {
            size: picture.size,
            rgb: gpu.read(&picture.rgb)?,
            depth: gpu.read(depth)?,
            transmittance: gpu.read(transmittance)?,
        })
    }

    /// The colours in 8 bits, clamped and rounded to the nearest.
    pub fn to_rgb8(&self) -> image::RgbImage {
        to_rgb8(self.size, &self.rgb)
    }
}

/// Row-major \[pixel\] RGB in \[0, 1\] as 8-bit RGB: clamped, rounded to the nearest, NaN black.
///
/// # Panics
/// Unless there is one colour per pixel of `size` (width, height).
pub fn to_rgb8([width, height]: [u32; 2], rgb: &[[f32; 3]]) -> image::RgbImage {
    let bytes = rgb.as_flattened().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    image::RgbImage::from_raw(width, height, bytes)
        .filter(|image| image.as_raw().len() == 3 * rgb.len())
        .expect("one colour per pixel")
}

/// Draws views of a model.
pub struct Painter {
    session: Session<Picture>,
}

impl Painter {
    /// With room for so much at first.
    ///
    /// # Errors
    /// As [`Session::new`].
    pub fn new(gpu: &Gpu, config: &super::Config, capacity: Capacity) -> Result<Self, Error> {
        let picture = |gpu: &Gpu, room: Room| Picture::new(gpu, room.size, room.pixels(), Outputs::Transmittance);
        Ok(Self { session: Session::new(gpu, config, capacity, picture)? })
    }

    /// For pictures `larger` times as large as those of the training.
    #[must_use]
    pub fn larger(self, larger: f64) -> Self {
        Self { session: self.session.larger(larger) }
    }

    /// Renders one view; buffers grow as it needs.
    ///
    /// # Errors
    /// As [`Session::run`].
    ///
    /// # Panics
    /// As [`Session::run`].
    pub fn render(&mut self, model: &dyn Representation, camera: &Camera) -> Result<Rendered, Error> {
        Ok(self.render_within(model, camera, u32::MAX)?.expect("no view has more pairs than can be counted"))
    }

    /// Renders one view unless it takes more than `most` (Gaussian, tile) pairs.
    ///
    /// # Errors
    /// As [`Session::run`].
    ///
    /// # Panics
    /// As [`Session::run`].
    pub fn render_within(
        &mut self,
        model: &dyn Representation,
        camera: &Camera,
        most: u32,
    ) -> Result<Option<Rendered>, Error> {
        let gpu = self.session.gpu().clone();
        let drawn = self.session.run_within(model, camera, most, |rec, stages, binned| {
            let Stages { room, forward, own: picture } = stages;
            rasterize::forward(rec, room.method, forward.projected(), binned, BACKGROUND, picture);
        })?;
        drawn.map(|stages| Rendered::read(&gpu, &stages.own)).transpose()
    }
}

/// Renders views of a finished model.
pub struct Renderer {
    painter: Painter,
    model: Finished,
}

/// A finished model on the device.
pub struct Finished(Box<dyn Representation>);

impl Finished {
    /// This model on the device.
    ///
    /// # Errors
    /// When the device has no room for it.
    pub fn upload(gpu: &Gpu, model: &Stored) -> Result<Self, Error> {
        Ok(Self(representation::upload(gpu, model, 0, 1.0)?))
    }

    /// The model as the forward stages read it.
    pub fn model(&self) -> &dyn Representation {
        &*self.0
    }
}

impl std::ops::Deref for Finished {
    type Target = dyn Representation;

    fn deref(&self) -> &Self::Target {
        &*self.0
    }
}

impl Renderer {
    /// A renderer of this model.
    ///
    /// # Errors
    /// When the device has no room for it.
    pub fn of(gpu: &Gpu, model: &Stored, config: &super::Config) -> Result<Self, Error> {
        let model = Finished::upload(gpu, model)?;
        let painter = Painter::new(gpu, config, Capacity::guess(model.count()))?;
        Ok(Self { painter, model })
    }

    /// For pictures so many times larger than those of the training.
    #[must_use]
    pub fn larger(self, larger: f64) -> Self {
        Self { painter: self.painter.larger(larger), ..self }
    }

    /// Renders one view; buffers grow as it needs.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    pub fn render(&mut self, camera: &Camera) -> Result<Rendered, Error> {
        self.painter.render(self.model.model(), camera)
    }
}

//! One picture from a finished model, for files and figures.

use super::bin::{Bin, Binned};
use super::decode::{self, Decode};
use super::method::Method;
use super::project::{Gaussians, Project};
use super::rasterize::{self, Outputs, Picture, Projected};
use super::visible::Visible;
use super::widen;
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::Anchors;
use crate::model::files;
use crate::primitives::limit::{COUNTERS, Counter, Limits};
use crate::scene::Camera;
use crate::stage;

/// How much the forward stages have room for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Capacity {
    /// Anchors.
    pub anchors: u32,
    /// Anchors in one view.
    pub visible: u32,
    /// (Gaussian, tile) pairs in one view.
    pub pairs: u32,
}

impl Capacity {
    /// A first guess for so many anchors; overflow corrects it.
    pub fn guess(anchors: u32) -> Self {
        Self { anchors, visible: (anchors / 4).clamp(1024, anchors.max(1024)), pairs: 1 << 17 }
    }

    /// Room for what was counted, and half as much again.
    pub fn fit(self, counters: [u32; COUNTERS]) -> Self {
        let fit = |have: u32, wanted: u32| if wanted > have { wanted.saturating_add(wanted / 2) } else { have };
        Self {
            anchors: self.anchors,
            visible: fit(self.visible, counters[Counter::Visible as usize]),
            pairs: fit(self.pairs, counters[Counter::Pairs as usize]),
        }
    }

    /// The same with no more spare room than the device binds: what `counters` counted stays whatever the device's limit.
    pub fn within(self, gpu: &Gpu, counters: [u32; COUNTERS]) -> Self {
        let [visible, pairs] = [Counter::Visible, Counter::Pairs].map(|counter| counters[counter as usize]);
        Self {
            anchors: self.anchors,
            visible: self.visible.min(self.anchors.max(visible).max(1)),
            pairs: self.pairs.min(most_pairs(gpu).max(pairs).max(1)),
        }
    }
}

/// As many anchors of `offsets` Gaussians as the device trains: each of their arrays fits one binding, and so does each
/// array that a view needs which shows all of them.
pub fn most_anchors(gpu: &Gpu, offsets: u32) -> u32 {
    let in_view = gpu.info().max_binding_bytes.min(u32::MAX.into()) / decode::widest(offsets);
    Anchors::most(gpu, offsets).min(in_view as u32)
}

/// As many (Gaussian, tile) pairs as the device trains: the widest array over them holds three floats each.
fn most_pairs(gpu: &Gpu) -> u32 {
    (gpu.info().max_binding_bytes / 12).min(u32::MAX.into()) as u32
}

/// The forward stages, from anchors to a picture.
pub struct Forward {
    /// What is in view.
    pub visible: Visible,
    /// Neural Gaussians.
    pub decode: Decode,
    /// Gaussians on the picture.
    pub project: Project,
    /// Tiles' lists.
    pub bin: Bin,
    /// How many times larger the pictures are than those of the training: see [`widen`].
    pub larger: f64,
    method: Method,
}

impl Forward {
    /// Stages for pictures of at most `size`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(
        gpu: &Gpu,
        capacity: Capacity,
        offsets: u32,
        method: Method,
        size: [u32; 2],
        cull: bool,
    ) -> Result<Self, Error> {
        Ok(Self {
            visible: gpu.stage(stage::CULL, || Visible::new(gpu, capacity.anchors, capacity.visible, cull))?,
            decode: gpu.stage(stage::DECODE, || Decode::new(gpu, capacity.visible, offsets))?,
            project: gpu.stage(stage::PROJECT, || Project::new(gpu, capacity.visible, offsets))?,
            bin: gpu.stage(stage::BIN, || {
                Bin::new(gpu, method, capacity.visible.saturating_mul(offsets), capacity.pairs, size)
            })?,
            larger: 1.0,
            method,
        })
    }

    /// What the pictures are computed with.
    pub fn method(&self) -> Method {
        self.method
    }

    /// The decoded Gaussians as the projection reads them.
    pub fn gaussians(&self) -> Gaussians<'_> {
        let Decode { position, scale, rotation, .. } = &self.decode;
        Gaussians { position, scale, rotation }
    }

    /// The projected Gaussians as the rasteriser reads them.
    pub fn projected(&self) -> Projected<'_> {
        Projected {
            slots: self.decode.slots(),
            existing: &self.decode.existing,
            mean: &self.project.mean,
            covariance: &self.project.covariance,
            depth: &self.project.depth,
            opacity: &self.decode.opacity,
            color: &self.decode.color,
        }
    }

    /// Records everything before the picture: which anchors are in view, their Gaussians, and the tiles' lists.
    pub fn record<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        model: Model<'_>,
        camera: &Camera,
        near: f32,
        limits: &Limits,
    ) -> Binned<'s> {
        let Model { anchors, weights } = model;
        self.visible.record(rec, anchors, camera, near, limits);
        let offset = anchors.offset().value.view();
        let model = decode::Anchors {
            position: &anchors.position,
            feature: &anchors.feature().value,
            offset: &offset,
            log_scaling: &anchors.log_scaling().value,
            weights,
            visible: &self.visible.list,
        };
        self.decode.record(rec, model, &self.visible.count, camera.center());
        widen::record(rec, &self.decode.existing, self.gaussians(), camera, self.larger);
        self.project.record(rec, &self.decode.existing, self.gaussians(), camera, near);
        self.bin.record(rec, self.projected(), camera.size, limits)
    }
}

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

/// A model on the device.
#[derive(Clone, Copy)]
pub struct Model<'a> {
    /// The anchors.
    pub anchors: &'a Anchors,
    /// The decoders, flat.
    pub weights: &'a Buffer<f32>,
}

/// The stages that draw views of a model.
pub struct Painter {
    gpu: Gpu,
    method: Method,
    near: f32,
    cull: bool,
    background: [f32; 3],
    limits: Limits,
    capacity: Capacity,
    larger: f64,
    stages: Option<(Forward, Picture)>,
}

impl Painter {
    /// With room for so much at first.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, config: &super::Config, background: [f32; 3], capacity: Capacity) -> Result<Self, Error> {
        Ok(Self {
            gpu: gpu.clone(),
            method: Method::new(gpu, config)?,
            near: config.near as f32,
            cull: config.cull,
            background,
            limits: Limits::new(gpu)?,
            capacity,
            larger: 1.0,
            stages: None,
        })
    }

    /// For pictures so many times larger than those of the training.
    #[must_use]
    pub fn larger(self, larger: f64) -> Self {
        Self { larger, ..self }
    }

    /// Renders one view; buffers grow as it needs.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    ///
    /// # Panics
    /// For more anchors than the capacity's.
    pub fn render(&mut self, model: Model<'_>, camera: &Camera) -> Result<Rendered, Error> {
        Ok(self.render_within(model, camera, u32::MAX)?.expect("no view has more pairs than can be counted"))
    }

    /// Renders one view unless it takes more than `most` (Gaussian, tile) pairs.
    ///
    /// # Errors
    /// As [`Painter::render`].
    ///
    /// # Panics
    /// As [`Painter::render`].
    pub fn render_within(&mut self, model: Model<'_>, camera: &Camera, most: u32) -> Result<Option<Rendered>, Error> {
        loop {
            let (forward, picture) = match self.stages.take() {
                Some((forward, picture)) if picture.size == camera.size => (forward, picture),
                // Those of another size go before these are made.
                old => {
                    drop(old);
                    let pixels = camera.size[0] as usize * camera.size[1] as usize;
                    let offsets = model.anchors.offsets;
                    let forward = Forward::new(&self.gpu, self.capacity, offsets, self.method, camera.size, self.cull)?;
                    (
                        Forward { larger: self.larger, ..forward },
                        Picture::new(&self.gpu, camera.size, pixels, Outputs::Transmittance)?,
                    )
                }
            };
            let mut rec = self.gpu.recorder()?;
            self.record(&mut rec, model, &forward, &picture, camera);
            rec.submit()?.wait()?;
            if self.gpu.read(self.limits.overflow())?[0] == 0 {
                let (depth, transmittance) = picture
                    .depth
                    .as_ref()
                    .zip(picture.transmittance.as_ref())
                    .expect("the picture was made with depth");
                let rendered = Rendered {
                    size: camera.size,
                    rgb: self.gpu.read(&picture.rgb)?,
                    depth: self.gpu.read(depth)?,
                    transmittance: self.gpu.read(transmittance)?,
                };
                self.stages = Some((forward, picture));
                return Ok(Some(rendered));
            }
            let counters = self.gpu.read(self.limits.counters())?;
            if counters[Counter::Pairs as usize] > most {
                return Ok(None);
            }
            self.capacity = self.capacity.fit(std::array::from_fn(|i| counters[i]));
            let mut rec = self.gpu.recorder()?;
            self.limits.lower(&mut rec);
            rec.submit()?.wait()?;
        }
    }

    fn record(&self, rec: &mut Recorder<'_>, model: Model<'_>, forward: &Forward, picture: &Picture, camera: &Camera) {
        let binned = forward.record(rec, model, camera, self.near, &self.limits);
        rasterize::forward(rec, forward.method, forward.projected(), binned, self.background, picture);
    }
}

/// Renders views of a finished model.
pub struct Renderer {
    painter: Painter,
    anchors: Anchors,
    weights: Buffer<f32>,
}

impl Renderer {
    /// A renderer of this model.
    ///
    /// # Errors
    /// When the device has no room for it.
    pub fn new(
        gpu: &Gpu,
        anchors: &files::Anchors,
        weights: &files::Weights,
        config: &super::Config,
        background: [f32; 3],
    ) -> Result<Self, Error> {
        let weights = gpu.upload("weights", &weights.decoders())?;
        let anchors = Anchors::upload(gpu, anchors, 0)?;
        let painter = Painter::new(gpu, config, background, Capacity::guess(anchors.count))?;
        Ok(Self { painter, anchors, weights })
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
        self.painter.render(Model { anchors: &self.anchors, weights: &self.weights }, camera)
    }
}

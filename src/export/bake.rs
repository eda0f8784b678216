//! From anchors to static Gaussians: one value each of what depends on the direction and the distance.
//!
//! The anchors are decoded and drawn on the device at every pose. A Gaussian's opacity is the mean over all poses in which
//! it is drawn, or would be if it existed (there it counts as 0); scale (as logarithm), rotation (with one sign) and colour are means
//! weighted with what it gave to the pictures: its sum of alpha x transmittance over the pixels, which is the colour's
//! gradient under a picture gradient of 1. Gaussians that gave nothing are left out.

use super::{Cloud, Error, logit};
use crate::gpu::{Buffer, Gpu};
use crate::math::harmonics::ZEROTH;
use crate::model::anchors::Decoded;
use crate::model::files;
use crate::render::config::BACKGROUND;
use crate::render::forward::Capacity;
use crate::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use crate::render::session::{Room, Stages};
use crate::render::view::to_rgb8;
use crate::render::{Config, Session};
use crate::scene::Camera;

/// Gaussians whose samples all stay below what a viewer skips are not seen.
const FAINT: f64 = 1.0 / 255.0;

/// What is summed of a Gaussian over the poses.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Poses in which its anchor was decoded and it is drawn, or lies in the picture and is not.
    looked: u32,
    opacity: f32,
    /// Pixels' worth of alpha x transmittance.
    share: f32,
    log_scale: [f32; 3],
    rotation: [f32; 4],
    color: [f32; 3],
}

impl Sums {
    fn add(&mut self, share: f32, scale: [f32; 3], rotation: [f32; 4], color: [f32; 3]) {
        let along: f32 = self.rotation.iter().zip(rotation).map(|(a, b)| a * b).sum();
        let signed = if along < 0.0 { -share } else { share };
        self.share += share;
        for i in 0..3 {
            // A scale that underflowed to 0 is as small as float32 goes.
            self.log_scale[i] += share * scale[i].max(f32::MIN_POSITIVE).ln();
            self.color[i] += share * color[i];
        }
        self.rotation.iter_mut().zip(rotation).for_each(|(sum, v)| *sum += signed * v);
    }
}

/// Reads anchors off from one pose after the other.
pub struct Baker {
    gpu: Gpu,
    near: f64,
    session: Session<Shares>,
    model: Decoded,
    /// \[gaussian\] world.
    position: Vec<[f64; 3]>,
    sums: Vec<Sums>,
}

/// A pose's picture, and what each Gaussian gave to it.
struct Shares {
    picture: Picture,
    backward: Backward,
    ones: Buffer<[f32; 3]>,
}

impl Shares {
    fn new(gpu: &Gpu, room: Room) -> Result<Self, crate::gpu::Error> {
        Ok(Self {
            picture: Picture::new(gpu, room.size, room.pixels(), Outputs::Color)?,
            backward: Backward::new(gpu, room.method, room.slots, room.pairs, Outputs::Color)?,
            ones: gpu.upload("ones", &vec![[1.0; 3]; room.pixels()])?,
        })
    }
}

impl Baker {
    /// Of this model.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, model: (&files::Anchors, &files::Weights), config: &Config) -> Result<Self, Error> {
        let (anchors, weights) = model;
        let each = anchors.offsets_per_anchor;
        let position = (0..anchors.position.len() * each).map(|i| {
            let (at, spread) = (anchors.position[i / each], anchors.log_scaling[i / each]);
            let offset = &anchors.offset[3 * i..3 * i + 3];
            std::array::from_fn(|c| f64::from(at[c]) + f64::from(offset[c]) * f64::from(spread[c]).exp())
        });
        let position: Vec<[f64; 3]> = position.collect();
        let capacity = Capacity::guess(anchors.position.len() as u32);
        Ok(Self {
            gpu: gpu.clone(),
            near: config.near,
            session: Session::new(gpu, config, capacity, Shares::new)?,
            model: Decoded::upload(gpu, anchors, &weights.decoders(), 0)?,
            sums: vec![Sums::default(); position.len()],
            position,
        })
    }

    /// Gaussians of the model, whether they exist or not.
    pub fn gaussians(&self) -> usize {
        self.position.len()
    }

    /// Draws the anchors from a camera and takes down what its Gaussians are from there; returns the picture.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    pub fn look(&mut self, camera: &Camera) -> Result<image::RgbImage, Error> {
        let stages = self.session.run(&self.model, camera, |rec, stages, binned| {
            let Stages { room, forward, own: Shares { picture, backward, ones } } = stages;
            rasterize::forward(rec, room.method, forward.projected(), binned, BACKGROUND, picture);
            let gradient = PictureGradient { rgb: ones, depth: None, transmittance: None };
            backward.record(rec, room.method, forward.projected(), binned, picture, gradient);
        })?;
        let picture = to_rgb8(camera.size, &self.gpu.read(&stages.own.picture.rgb)?);
        self.take_down(camera)?;
        Ok(picture)
    }

    fn take_down(&mut self, camera: &Camera) -> Result<(), Error> {
        let Stages { forward, own: Shares { backward, .. }, .. } = self.session.stages();
        let gpu = &self.gpu;
        let visible_count = gpu.read(&forward.visible().count)?[0] as usize;
        let offsets = self.model.anchors.offsets as usize;
        let slots = visible_count * offsets;
        let visible = gpu.read_range(&forward.visible().list, visible_count)?;
        let opacity = gpu.read_range(&forward.decode().opacity, slots)?;
        let color = gpu.read_range(&forward.decode().color, slots)?;
        let scale = gpu.read_range(&forward.decode().scale, slots)?;
        let rotation = gpu.read_range(&forward.decode().rotation, slots)?;
        let tiles = gpu.read_range(forward.bin.tiles(), slots)?;
        let shares = gpu.read_range(&backward.grad_color, slots)?;
        let near = self.near;
        let within = |position: [f64; 3]| camera.to_camera(position)[2] > near && camera.within(position).is_some();
        for slot in 0..slots {
            let (k, v) = (slot / visible_count, slot % visible_count);
            let gaussian = visible[v] as usize * offsets + k;
            let drawn = tiles[slot] > 0;
            // What is not drawn has a say only where it could have been: its opacity elsewhere is nobody's business.
            if drawn || within(self.position[gaussian]) {
                let sums = &mut self.sums[gaussian];
                sums.looked += 1;
                sums.opacity += opacity[slot].max(0.0);
                if drawn && shares[slot][0] > 0.0 {
                    sums.add(shares[slot][0], scale[slot], rotation[slot], color[slot]);
                }
            }
        }
        Ok(())
    }

    /// The Gaussians that gave at least `share` pixels' worth to all pictures together.
    ///
    /// # Errors
    /// [`Error::Nothing`] where there are none.
    pub fn cloud(&self, share: f32, poses: usize) -> Result<Cloud, Error> {
        let mut cloud = Cloud::default();
        for (sums, position) in self.sums.iter().zip(&self.position) {
            let opacity = f64::from(sums.opacity) / f64::from(sums.looked.max(1));
            let norm = sums.rotation.iter().map(|v| v * v).sum::<f32>().sqrt();
            if sums.share <= share || opacity < FAINT || norm <= 0.0 {
                continue;
            }
            cloud.position.push(position.map(|v| v as f32));
            cloud.log_scale.push(sums.log_scale.map(|v| v / sums.share));
            cloud.rotation.push(sums.rotation.map(|v| v / norm));
            cloud.logit.push(logit(opacity));
            cloud.harmonics.push(sums.color.map(|v| ((f64::from(v / sums.share) - 0.5) / ZEROTH) as f32));
        }
        if cloud.is_empty() {
            return Err(Error::Nothing { gaussians: self.gaussians(), poses });
        }
        Ok(cloud)
    }
}

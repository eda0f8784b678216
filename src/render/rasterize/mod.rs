//! Rasterisation: tiles of Gaussians blended front to back, and back again.
//!
//! alpha = min(0.99, opacity exp(-1/2 d^T C^-1 d)), with `d^T C^-1 d = (dx - k dy)^2 / N + dy^2 / V` from the factored
//! covariance; a sample with alpha below a threshold (1/255) is skipped; a pixel is finished before the Gaussian that
//! would bring its transmittance below another (1e-4; 3D Gaussian Splatting, section 4). Depth is the sum of z alpha T, not
//! divided by coverage. The support of a Gaussian is exactly where alpha reaches the threshold, so the picture does not
//! depend on the tiles.
//!
//! Narrow tiles (CPU drivers) list the pairs of which a pixel took something: a third of all on photographs. Their backward
//! pass looks at no other, and the gather skips what has no mark.
//!
//! The exponential is the driver's: on lavapipe every polynomial tried, down to one of 7e-5 relative error in seven
//! operations, took longer and was less exact, and GPUs have an instruction for it.

mod backward;
mod forward;
mod gather;
#[cfg(test)]
mod tests;

use crate::gpu::{Buffer, Error, Gpu};
pub use backward::{Backward, PictureGradient};
pub use forward::forward;

/// Largest alpha of a sample.
pub const ALPHA_MAX: f64 = 0.99;

/// One sample of a Gaussian at a pixel: what forward and backward twins share. The decisions are float32 operations.
struct Sample {
    /// dx - k dy.
    across: f64,
    dy: f64,
    exponential: f64,
    raw: f64,
    alpha: f64,
    visible: bool,
}

fn sample(pixel: [f32; 2], mean: [f32; 2], conic: [f32; 3], opacity: f32, alpha_min: f32) -> Sample {
    let (dx, dy) = (pixel[0] - mean[0], pixel[1] - mean[1]);
    let across = dx - conic[1] * dy;
    let power = -0.5 * (conic[0] * across * across + conic[2] * dy * dy);
    let visible = (opacity * power.exp()).min(0.99) >= alpha_min;
    let [inverse_narrow, slope, inverse_variance] = conic.map(f64::from);
    let (dx, dy) = (f64::from(pixel[0]) - f64::from(mean[0]), f64::from(pixel[1]) - f64::from(mean[1]));
    let across = dx - slope * dy;
    let exponential = (-0.5 * (inverse_narrow * across * across + inverse_variance * dy * dy)).exp();
    let raw = f64::from(opacity) * exponential;
    Sample { across, dy, exponential, raw, alpha: raw.min(ALPHA_MAX), visible }
}

/// The Gaussians in screen space and their lists, as a twin sees them.
struct Splats<'a> {
    ranges: &'a [[u32; 2]],
    sorted: &'a [u32],
    pair_slot: &'a [u32],
    mean: &'a [[f32; 2]],
    conic: &'a [[f32; 3]],
    opacity: &'a [f32],
    color: &'a [[f32; 3]],
    alpha_min: f32,
    transmittance_min: f32,
}

impl Splats<'_> {
    /// Calls `blend(place in the list, slot, sample, transmittance before, weight)` for everything blended at a pixel; returns
    /// the transmittance that is left, and the place from which on nothing is.
    fn walk(
        &self,
        pixel: [u32; 2],
        tile: u32,
        tiles_x: u32,
        mut blend: impl FnMut(usize, usize, &Sample, f64, f64),
    ) -> (f64, usize) {
        let [first, end] = self.ranges[(pixel[1] / tile * tiles_x + pixel[0] / tile) as usize];
        let centre = pixel.map(|v| v as f32 + 0.5);
        let mut transmittance = 1.0;
        // The decision to stop is made on the float32 product, as in the kernel.
        let mut rounded = 1f32;
        for at in first as usize..end as usize {
            let slot = self.pair_slot[self.sorted[at] as usize] as usize;
            let s = sample(centre, self.mean[slot], self.conic[slot], self.opacity[slot], self.alpha_min);
            if !s.visible {
                continue;
            }
            let after = rounded * (1.0 - s.alpha as f32);
            if after < self.transmittance_min {
                return (transmittance, at);
            }
            blend(at, slot, &s, transmittance, s.alpha * transmittance);
            transmittance *= 1.0 - s.alpha;
            rounded = after;
        }
        (transmittance, end as usize)
    }
}

/// What a loss or a file needs of the picture.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outputs {
    /// Colour alone.
    Color,
    /// Colour and depth.
    Depth,
    /// Colour, depth and transmittance.
    Transmittance,
}

/// A picture's buffers.
pub struct Picture {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// `[pixel]` linear rgb.
    pub rgb: Buffer<[f32; 3]>,
    /// Sum of z alpha T, if asked for.
    pub depth: Option<Buffer<f32>>,
    /// What is left of the background, if asked for.
    pub transmittance: Option<Buffer<f32>>,
}

impl Picture {
    /// Buffers for pictures of up to `pixels` pixels.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2], pixels: usize, outputs: Outputs) -> Result<Self, Error> {
        let (depth, transmittance) = (outputs != Outputs::Color, outputs == Outputs::Transmittance);
        Ok(Self {
            size,
            rgb: gpu.buffer("rgb", pixels)?,
            depth: depth.then(|| gpu.buffer("depth_map", pixels)).transpose()?,
            transmittance: transmittance.then(|| gpu.buffer("transmittance", pixels)).transpose()?,
        })
    }
}

impl Picture {
    /// The same picture without its depth.
    pub fn color(&self) -> Self {
        Self { size: self.size, rgb: self.rgb.view(), depth: None, transmittance: None }
    }
}

//! The step's photograph and what its mask says, from 8 bits per channel to the arrays that the losses read.

use crate::cost::{Formula, if_so, work};
use crate::gpu::kernels::losses::frame;
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[Formula {
    pass: "losses/frame",
    variants: &["masked", "masked_depth"],
    derivation: "per pixel picture 4, target 12 B, 9 operations; with masks a weight 4 B and 3, with depth the prior and three more 16 B and 9",
    work: |c, d| {
        let (masked, depth) = (if_so(d.is("masked")), if_so(d.is("depth")));
        work((16.0 + 4.0 * masked + 16.0 * depth) * c.pixels, (9.0 + 3.0 * masked + 9.0 * depth) * c.pixels, 0.0)
    },
}];

/// A word of a resident picture. `mask` is 0 outside and up to 255 inside, see [`Weights`].
pub fn pack([r, g, b]: [u8; 3], mask: u8) -> u32 {
    u32::from_le_bytes([r, g, b, mask])
}

/// At or below this a prior has no value at a pixel. Priors count in their own range, so that theirs are about 0 to 1.
pub const NO_PRIOR: f32 = -1e4;

/// A weight outside the mask and one inside; in proportion where the mask is between 0 and 255.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Of pixels outside the mask.
    pub outside: f32,
    /// Of pixels inside the mask.
    pub inside: f32,
}

/// The weight where the mask is `share` of 255.
fn mix(outside: f32, inside: f32, share: f64) -> f32 {
    (f64::from(outside) * (1.0 - share) + f64::from(inside) * share) as f32
}

impl Reference for frame::Kernel {
    fn reference(host: frame::Host<'_>, push: frame::Push, (): ()) {
        let pixels = push.pixels as usize;
        for (out, word) in host.target.iter_mut().zip(host.picture).take(pixels) {
            let [r, g, b, _] = word.to_le_bytes();
            *out = [r, g, b].map(|v| (f64::from(v) / 255.0) as f32);
        }
        let choose = |out: Option<&mut [f32]>, value: &dyn Fn(usize, f64) -> f32| {
            for (pixel, (out, word)) in out.into_iter().flatten().zip(host.picture).enumerate().take(pixels) {
                *out = value(pixel, f64::from(word >> 24) / 255.0);
            }
        };
        let has = |pixel: usize| host.prior.is_some_and(|prior| prior[pixel] > NO_PRIOR);
        choose(host.weight, &|_, share| mix(push.outside, push.inside, share));
        choose(host.given, &|pixel, _| if has(pixel) { 1.0 } else { 0.0 });
        choose(host.valid, &|pixel, share| if has(pixel) && share == 0.0 { 1.0 } else { 0.0 });
        choose(host.depth_weight, &|pixel, share| {
            if has(pixel) { mix(push.depth_outside, push.depth_inside, share) } else { 0.0 }
        });
    }
    /// A division, two products and two sums of positive terms.
    fn check(_binding: &'static str) -> Check {
        Check { relative: 5e-7, absolute: 0.0, band: 0.0 }
    }
}

/// The arrays of the current view. Those that the plan has no use for do not exist.
#[derive(Debug)]
pub struct Frame {
    size: [u32; 2],
    target: Buffer<[f32; 3]>,
    masked: Option<Masked>,
}

#[derive(Debug)]
struct Masked {
    weight: Buffer<f32>,
    depth: Option<MaskedDepth>,
}

#[derive(Debug)]
struct MaskedDepth {
    valid: Buffer<f32>,
    given: Buffer<f32>,
    weight: Buffer<f32>,
}

impl Frame {
    /// For pictures of `size` = width, height; weights exist with `masks`, those of the depth with `depth` as well.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2], masks: bool, depth: bool) -> Result<Self, Error> {
        let pixels = size[0] as usize * size[1] as usize;
        let masked_depth = || -> Result<MaskedDepth, Error> {
            Ok(MaskedDepth {
                valid: gpu.buffer("valid", pixels)?,
                given: gpu.buffer("given", pixels)?,
                weight: gpu.buffer("depth_weight", pixels)?,
            })
        };
        let masked = || -> Result<Masked, Error> {
            Ok(Masked {
                weight: gpu.buffer("weight", pixels)?,
                depth: if depth { Some(masked_depth()?) } else { None },
            })
        };
        Ok(Self { size, target: gpu.buffer("target", pixels)?, masked: if masks { Some(masked()?) } else { None } })
    }

    /// Records the expansion of `picture` \[pixel\], see [`pack`]. The depth's arrays are written with `depth` only: the
    /// weights of its L1 loss and the prior \[pixel\].
    pub fn forward(
        &self,
        rec: &mut Recorder<'_>,
        picture: &Buffer<u32>,
        weights: Weights,
        depth: Option<(Weights, &Buffer<f32>)>,
    ) {
        let Self { size: [width, height], target, masked } = self;
        let pixels = width * height;
        let Weights { outside, inside } = weights;
        let mut push = frame::Push { pixels, outside, inside, ..frame::Push::default() };
        let weight = masked.as_ref().map(|masked| &masked.weight);
        let mut buffers =
            frame::Buffers { picture, target, weight, valid: None, depth_weight: None, prior: None, given: None };
        let arrays = masked.as_ref().and_then(|masked| masked.depth.as_ref());
        if let (Some(arrays), Some((depth, prior))) = (arrays, depth) {
            let (depth_outside, depth_inside) = (depth.outside, depth.inside);
            push = frame::Push { depth_outside, depth_inside, ..push };
            let MaskedDepth { valid, given, weight } = arrays;
            let (valid, given, depth_weight, prior) = (Some(valid), Some(given), Some(weight), Some(prior));
            buffers = frame::Buffers { valid, given, depth_weight, prior, ..buffers };
        }
        rec.run(frame::Kernel, buffers, push, pixels);
    }

    /// The photograph \[pixel\], rgb in 0 to 1.
    pub fn target(&self) -> &Buffer<[f32; 3]> {
        &self.target
    }

    /// Photometric weight \[pixel\], with masks.
    pub fn weight(&self) -> Option<&Buffer<f32>> {
        self.masked.as_ref().map(|m| &m.weight)
    }

    /// 1 where there is a prior, 0 elsewhere \[pixel\], with masks and depth.
    pub fn given(&self) -> Option<&Buffer<f32>> {
        self.masked.as_ref()?.depth.as_ref().map(|d| &d.given)
    }

    /// 1 outside the mask where there is a prior, 0 elsewhere \[pixel\], with masks and depth.
    pub fn valid(&self) -> Option<&Buffer<f32>> {
        self.masked.as_ref()?.depth.as_ref().map(|d| &d.valid)
    }

    /// Weight of the depth L1 loss \[pixel\], with masks and depth.
    pub fn depth_weight(&self) -> Option<&Buffer<f32>> {
        self.masked.as_ref()?.depth.as_ref().map(|d| &d.weight)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use rand::{RngExt, SeedableRng};

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = rand_pcg::Pcg32::seed_from_u64(5);
        for pixels in [0, 1, 17, 63, 64, 65, 53 * 37, 252 * 142] {
            // One pixel more than the picture has: left alone.
            let n = pixels as usize + 1;
            let picture: Vec<u32> = (0..n)
                .map(|_| pack(std::array::from_fn(|_| rng.random()), [0, 255, 0, 7, 200][rng.random_range(0..5)]))
                .collect();
            let target = vec![[UNWRITTEN; 3]; n];
            let unwritten = vec![UNWRITTEN; n];
            let push = frame::Push { pixels, outside: 1.0, inside: 20.0, depth_outside: 0.1, depth_inside: 99.0 };
            let mut case = frame::Arrays { picture, target, ..frame::Arrays::default() };
            testing::assert_twin(frame::Kernel, &gpu, case.clone(), push, pixels);
            case.weight = Some(unwritten.clone());
            testing::assert_twin(frame::Kernel, &gpu, case.clone(), push, pixels);
            let prior = (0..n).map(|_| if rng.random::<f32>() < 0.2 { NO_PRIOR } else { rng.random() }).collect();
            (case.valid, case.given, case.depth_weight) =
                (Some(unwritten.clone()), Some(unwritten.clone()), Some(unwritten));
            case.prior = Some(prior);
            testing::assert_twin(frame::Kernel, &gpu, case, push, pixels);
        }
    }

    #[test]
    fn every_byte_comes_back() {
        let gpu = testing::gpu();
        let bytes: Vec<u8> = (0..=255).collect();
        let picture = bytes.iter().map(|&v| pack([v, 255 - v, v ^ 0x55], 255 * (v % 2))).collect();
        let case = frame::Arrays { picture, target: vec![[UNWRITTEN; 3]; 256], ..frame::Arrays::default() };
        let got = testing::run_once(
            frame::Kernel,
            &gpu,
            &case,
            frame::Push { pixels: 256, ..frame::Push::default() },
            256u32,
        )
        .target;
        for (v, got) in bytes.iter().zip(got) {
            assert_eq!(got.map(|c| (c * 255.0).round() as u8), [*v, 255 - v, v ^ 0x55]);
        }
        assert_eq!(pack([0, 0, 255], 255), 0xFFFF_0000);
    }
}

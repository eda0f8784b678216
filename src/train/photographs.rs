//! The training pictures on the device: 8 bits per channel, the blend of the loss weights in the fourth byte.
//!
//! Reduced pictures are made as `scene.downscale` makes them: area averages of picture and prior, "any object pixel"
//! for the mask, the camera scaled by the exact ratio of each side.

use std::borrow::Cow;

use image::{GrayImage, RgbImage};

use super::plan::Plan;
use crate::gpu::{Buffer, Error, Gpu};
use crate::losses;
use crate::scene::{self, Camera, PriorKind, Scene, reduced, resample};
use crate::stage;

/// One training view on the device.
pub struct Photograph {
    /// The view's name.
    pub name: String,
    /// Its camera, at the size of the picture.
    pub camera: Camera,
    /// How many times smaller the picture is than the training size.
    pub reduction: u32,
    /// True for a reference view: its picture is the inpainted one.
    pub reference: bool,
    /// `[pixel]` red | green << 8 | blue << 16 | mask << 24.
    pub picture: Buffer<u32>,
    /// Where the view has a prior.
    pub prior: Option<PriorMap>,
    /// Bounding box of the mask, (x0, y0) and one past (x1, y1), where there is one.
    pub mask_box: Option<[u32; 4]>,
}

/// A prior on the device.
pub struct PriorMap {
    /// Depth or disparity.
    pub kind: PriorKind,
    /// `[pixel]` in its own range, [`losses::NO_PRIOR`] where there is none.
    pub values: Buffer<f32>,
    /// Whether there is none somewhere.
    pub gaps: bool,
    /// What brings the rendered depth to these values, where that is known: see [`losses::DepthView::fit`].
    pub fit: Option<Buffer<f32>>,
}

/// One word per pixel.
pub fn pack(picture: &RgbImage, mask: Option<&GrayImage>) -> Vec<u32> {
    let masked = |i: usize| mask.map_or(0, |m| m.as_raw()[i]);
    picture.pixels().enumerate().map(|(i, p)| losses::pack(p.0, masked(i))).collect()
}

/// Bounding box of what is not zero.
pub fn mask_box(mask: &GrayImage) -> Option<[u32; 4]> {
    mask.enumerate_pixels().filter(|(_, _, p)| p.0[0] != 0).fold(None, |found, (x, y, _)| {
        let [x0, y0, x1, y1] = found.unwrap_or([x, y, x, y]);
        Some([x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1)])
    })
}

/// The part of a mask that is not trained on: what was filled is, as the photograph is.
fn left<'m>(mask: &'m GrayImage, filled: Option<&GrayImage>) -> Cow<'m, GrayImage> {
    let Some(filled) = filled else { return Cow::Borrowed(mask) };
    let mut left = mask.clone();
    left.iter_mut().zip(filled.as_raw()).filter(|(_, f)| **f != 0).for_each(|(m, _)| *m = 0);
    Cow::Owned(left)
}

/// A mask at another size, not smaller than it was.
fn smaller_mask(mask: &GrayImage, size: [u32; 2]) -> Cow<'_, GrayImage> {
    if mask.dimensions() == (size[0], size[1]) {
        Cow::Borrowed(mask)
    } else {
        Cow::Owned(resample::largest(mask, size))
    }
}

/// Uploads all training views, reduced by this factor (1: as they are). Priors stay behind that no loss looks at.
///
/// # Errors
/// When the device has no room.
pub fn upload(gpu: &Gpu, scene: &Scene, plan: &Plan, reduction: u32) -> Result<Vec<Photograph>, Error> {
    let mut all = vec![];
    for (i, view) in scene.train.iter().enumerate() {
        let reference = scene.reference_of(i);
        let hole = scene.hole_of(i);
        let picture = reference.map(|r| &r.image).or(hole.map(|hole| &hole.image)).unwrap_or(&view.image);
        let prior = match reference {
            Some(r) => r.prior.as_ref(),
            None => view.prior.as_ref(),
        };
        let full = view.camera.size;
        let size = reduced(full, reduction);
        let smaller = size != full;
        let picture = if smaller { Cow::Owned(resample::photograph(picture, size)) } else { Cow::Borrowed(picture) };
        let bounds = view.blend().and_then(|mask| mask_box(&smaller_mask(mask, size)));
        let mask = view.blend().map(|mask| smaller_mask(&left(mask, hole.map(|hole| &hole.filled)), size).into_owned());
        let mask = mask.as_ref();
        let prior = match prior.filter(|_| plan.depth_losses(reference.is_some()).any()) {
            Some(prior) => {
                let reduced = smaller.then(|| resample::map(&prior.values, full, size));
                let stored = reduced.as_ref().unwrap_or(&prior.values);
                let mut values = scene::in_own_range(stored);
                let line = reference.filter(|_| plan.align_to_points).and_then(|r| scene.depth_line(r));
                let fit = line.map(|line| losses::align::fixed(inverse(line, scene::own_range(stored))));
                let fit = fit.map(|fit| gpu.stage(stage::PICTURES, || gpu.upload("fit", &fit))).transpose()?;
                let gaps = values.iter().any(|v| v.is_nan());
                values.iter_mut().filter(|v| v.is_nan()).for_each(|v| *v = losses::NO_PRIOR);
                let values = gpu.stage(stage::PICTURES, || gpu.upload("prior", &values))?;
                Some(PriorMap { kind: prior.kind, values, gaps, fit })
            }
            None => None,
        };
        let words = pack(&picture, mask);
        all.push(Photograph {
            name: view.name.clone(),
            camera: view.camera.scaled(size),
            reduction,
            reference: reference.is_some(),
            picture: gpu.stage(stage::PICTURES, || gpu.upload("picture", &words))?,
            prior,
            mask_box: bounds,
        });
    }
    Ok(all)
}

/// `[scale, shift]` that take a depth (or disparity) `x = slope p + x0` of a prior's value p to that value in its own range,
/// `(p - low) / width`.
fn inverse([slope, x0]: [f64; 2], [low, width]: [f64; 2]) -> [f64; 2] {
    [1.0 / (slope * width), -(x0 / slope + low) / width]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_depth_comes_to_its_priors_value_in_the_priors_range() {
        let (line, range) = ([2.5, -0.5], [0.25, 8.0]);
        let [scale, shift] = inverse(line, range);
        for p in [0.0, 0.25, 3.0] {
            let depth = line[0] * p + line[1];
            assert!((scale * depth + shift - (p - range[0]) / range[1]).abs() < 1e-12);
        }
    }

    /// A pixel of a reduced picture that shows some of the object is not trained on, though another part of it was filled.
    #[test]
    fn a_reduced_hole_shows_nothing_of_the_object() {
        let mask = GrayImage::from_fn(8, 4, |x, _| image::Luma([if x < 5 { 255 } else { 0 }]));
        let filled = GrayImage::from_fn(8, 4, |x, _| image::Luma([if x < 3 { 255 } else { 0 }]));
        let of = |filled| smaller_mask(&left(&mask, filled), [4, 2]).into_owned().into_raw();
        assert_eq!(of(Some(&filled)), [0, 255, 255, 0, 0, 255, 255, 0]);
        assert_eq!(of(Some(&mask)), [0; 8]);
        assert_eq!(of(None), [255, 255, 255, 0, 255, 255, 255, 0]);
        assert_eq!(*smaller_mask(&mask, [8, 4]), mask);
    }

    #[test]
    fn packing_and_boxes() {
        let picture = RgbImage::from_pixel(3, 2, image::Rgb([1, 2, 255]));
        let mut mask = GrayImage::new(3, 2);
        assert_eq!(mask_box(&mask), None);
        assert_eq!(pack(&picture, None), [0x00ff_0201; 6]);
        mask.put_pixel(2, 1, image::Luma([255]));
        assert_eq!(pack(&picture, Some(&mask))[5], 0xffff_0201);
        assert_eq!(mask_box(&mask), Some([2, 1, 3, 2]));
        mask.put_pixel(0, 1, image::Luma([255]));
        assert_eq!(mask_box(&mask), Some([0, 1, 3, 2]));
    }
}

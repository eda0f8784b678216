//! What is left of the object's shadow where it was taken out of the photographs.
//!
//! A shadow is divided by one ratio ([`shadow`](crate::prepare::shadow)). Along its border, where light comes back over a
//! pixel or two, a seam is left, and between shadow and object, where the map begins too late, a dark wedge. Both are of
//! the hole: else they are copied into it. Of a soft shadow it is where too little of the light is left.

use std::path::Path;

use image::{GrayImage, Luma, RgbImage};
use rayon::prelude::*;

use crate::prepare::Error;
use crate::prepare::shadow::relight;
use crate::scene::{self, View, resample};

/// Half the width of the seam, as a part of the picture's longer side.
const SEAM: f64 = 0.008;
/// Half the width of a wedge between shadow and object at most, as the same part.
const WEDGE: f64 = 0.025;
/// A map that takes less of the light than this has no shadow.
const LEAST: f64 = 0.08;

/// Adds the residue to the masks of views, whose pictures are without the shadow, from their maps in the scene's folder.
///
/// # Errors
/// A map that cannot be read.
pub fn add(root: &Path, views: &[View], masks: &mut [GrayImage]) -> Result<(), Error> {
    views.par_iter().zip(masks).try_for_each(|(View { name, image, .. }, mask)| {
        // A soft shadow has no seam.
        let contact = root.join(relight::contact_path(name));
        if contact.is_file() {
            let contact = resample::mask(&scene::mask(&contact, 1)?, [mask.width(), mask.height()]);
            mask.iter_mut().zip(contact.as_raw()).for_each(|(mask, more)| *mask = (*mask).max(*more));
            return Ok(());
        }
        let path = root.join(relight::path(name));
        if !path.is_file() {
            return Ok(());
        }
        let map = resample::photograph(&scene::photograph(&path, 1)?, [mask.width(), mask.height()]);
        if let Some(residue) = of(&map, image, mask) {
            mask.iter_mut().zip(residue.as_raw()).for_each(|(mask, more)| *mask = (*mask).max(*more));
        }
        Ok(())
    })
}

/// Whether a pixel of a picture (logarithms of its channels) has the hue of one of a shadow's pixels within `reach` of it: of the
/// same surface. What stands before the shadow ends it, too, and there is no seam.
fn is_its(log: &[[f32; 3]], shadow: &GrayImage, i: usize, reach: u32) -> bool {
    let width = shadow.width();
    let [rows, columns] = [i as u32 / width, i as u32 % width].map(|at| at.saturating_sub(reach)..=at + reach);
    let mut near = rows.flat_map(|v| columns.clone().map(move |u| (u, v)));
    near.any(|(u, v)| {
        let is_shadow = shadow.get_pixel_checked(u, v).is_some_and(|on| on.0[0] != 0);
        is_shadow && relight::has_hue(log[(v * width + u) as usize], log[i])
    })
}

/// The residue beside a mask, by the map of what is left of the light, of 255; nothing without a shadow. `picture` is without
/// the shadow.
fn of(map: &RgbImage, picture: &RgbImage, mask: &GrayImage) -> Option<GrayImage> {
    let (w, h) = map.dimensions();
    let radius = |part: f64| super::radius(mask, part);
    let drawn = |on: &dyn Fn(usize) -> bool| {
        GrayImage::from_fn(w, h, |x, y| Luma([if on((y * w + x) as usize) { 255 } else { 0 }]))
    };
    let not = |image: &GrayImage| drawn(&|i| image.as_raw()[i] == 0);
    let closed = |image: &GrayImage| {
        let large = resample::dilate(image, radius(WEDGE));
        not(&resample::dilate(&not(&large), radius(WEDGE)))
    };
    let taken: Vec<f64> =
        map.pixels().map(|left| 1.0 - left.0.iter().map(|v| f64::from(*v)).sum::<f64>() / 765.0).collect();
    let most = taken.iter().copied().fold(0.0, f64::max);
    if most < LEAST {
        return None;
    }
    let shadow = drawn(&|i| taken[i] > 0.5 * most);
    let [inside, outside] = [&shadow, &not(&shadow)].map(|side| resample::dilate(side, radius(SEAM)));
    let [object, both] = [mask, &drawn(&|i| mask.as_raw()[i].max(shadow.as_raw()[i]) != 0)].map(closed);
    let log: Vec<[f32; 3]> = picture.pixels().map(|pixel| relight::log(pixel.0)).collect();
    Some(drawn(&|i| {
        let at = |image: &GrayImage| image.as_raw()[i] != 0;
        let its = |reach: f64| at(&shadow) || is_its(&log, &shadow, i, radius(reach));
        let seam = at(&inside) && at(&outside) && its(SEAM);
        seam || at(&both) && !at(&object) && !at(&shadow) && its(2.0 * WEDGE)
    }))
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    /// A shadow of 40 pixels beside an object, which begins four pixels beside it: border and gap are of the hole, the middle
    /// of the shadow and what is far from it are not. A map that takes nothing adds nothing.
    #[test]
    fn border_and_gap_are_added() {
        let object = |x: u32, y: u32| (40..60).contains(&x) && (40..60).contains(&y);
        let shadow = |x: u32, y: u32| (64..104).contains(&x) && (40..60).contains(&y);
        let map = RgbImage::from_fn(200, 100, |x, y| Rgb([if shadow(x, y) { 130 } else { 255 }; 3]));
        let mask = GrayImage::from_fn(200, 100, |x, y| Luma([if object(x, y) { 255 } else { 0 }]));
        // A red post stands before the shadow's end.
        let post = |x: u32| x >= 104;
        let picture = RgbImage::from_fn(200, 100, |x, _| Rgb(if post(x) { [160, 60, 60] } else { [110, 108, 100] }));
        let residue = of(&map, &picture, &mask).expect("there is a shadow");
        let on = |x: u32, y: u32| residue.get_pixel(x, y).0[0] != 0;
        assert!((60..64).all(|x| on(x, 50)), "the gap");
        assert!(on(103, 50) && on(80, 39) && on(80, 40) && on(80, 59), "the border");
        assert!(!on(104, 50), "the post");
        assert!(!on(80, 50) && !on(120, 50) && !on(30, 50) && !on(50, 50), "the rest");
        assert!(of(&RgbImage::from_pixel(200, 100, Rgb([250; 3])), &picture, &mask).is_none());
    }
}

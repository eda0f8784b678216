//! Carried masks that end where the object ends.
//!
//! A mask that the fit's Gaussians carry is as coarse as the fit: it misses the object's foot here and spreads into the air
//! there. In a band along its border the photograph's own colours decide ([`graph_cut`]). What both agree on stays, what the
//! cut finds beyond the mask is added, and what the mask has far from anything that the cut found goes. What it has near it
//! stays: a mask that is a little too wide loses nothing, one that is too narrow leaves a ghost.

use image::{GrayImage, Luma, RgbImage};

use super::graph_cut::{self, Known};
use super::masks;
use crate::scene::resample;

/// Name of the way in which masks are carried: those that were carried in another way are carried anew.
pub const METHOD: &str = "given masks, drawn ones cut by places in space and planes around a box as well, as far as other views confirm them, by the fit's where what was measured leaves a box half empty, and again by the votes of other views until they stay, without what stands behind in all, and those of other views vote on what shows \
     in them and hangs together, of what is beyond their borders little, of what rises from its plane without asking what lies on it, and of what is on its plane and below it nothing, however small a table is, without what the given masks rule out, moved to where its colours are, refined by the photographs, and \
     without parts that others show beside it, views that stand apart from all others, and the lesser part of a torn model, having no vote";
/// Half the width of the band, as a part of the longer side of the object's box.
const BAND: f64 = 0.10;
/// How far beyond the cut the carried mask may reach, as a part of the same.
const KEPT: f64 = 0.06;
/// A pixel whose carried part of the object is above this, and that is not in the band, is the object.
const SURE: f32 = 0.6;
/// Part of the mask that the cut must find again: else colours do not tell the object from what is around it.
const FOUND: f64 = 0.6;
/// How many times as large as the mask the cut may be.
const GROWN: f64 = 1.6;
/// Smoothness of the cut.
const SMOOTHNESS: f64 = 20.0;

/// The longer side of the pictures that outlines are refined in, pixels.
pub const SIDE: u32 = 768;
/// Views without a given mask that vote beside those with one; of more, every so many.
pub const VOTERS: usize = 24;
/// Pieces of a carried mask that are smaller than this share of its largest piece are taken away.
const SPECK: f64 = 0.02;

/// The mask of the carried parts of a picture (`from` = width, height), refined where its colours tell the object from its
/// surroundings; as large as the picture.
pub fn of(picture: &RgbImage, parts: &[f32], from: [u32; 2]) -> GrayImage {
    let size = [picture.width(), picture.height()];
    let mask = masks::without_specks(&masks::threshold(parts, from, size, masks::OBJECT), SPECK);
    refined(picture, parts, from, &mask).unwrap_or(mask)
}

/// The mask of the carried parts (`from` = width, height) refined by the picture, as large as the picture. `None` where the
/// object is not in the picture, or its colours are those of its surroundings.
fn refined(picture: &RgbImage, parts: &[f32], from: [u32; 2], mask: &GrayImage) -> Option<GrayImage> {
    let full = [picture.width(), picture.height()];
    let on = || mask.enumerate_pixels().filter(|(_, _, v)| v.0[0] != 0);
    let [x0, y0] = [on().map(|(x, _, _)| x).min()?, on().map(|(_, y, _)| y).min()?];
    let [x1, y1] = [on().map(|(x, _, _)| x).max()? + 1, on().map(|(_, y, _)| y).max()? + 1];
    let longer = f64::from((x1 - x0).max(y1 - y0));
    // Beyond the band as much again, to learn the background's colours from.
    let margin = (3.0 * BAND * longer).ceil() as u32 + 2;
    let low = [x0.saturating_sub(margin), y0.saturating_sub(margin)];
    let far = [(x1 + margin).min(full[0]), (y1 + margin).min(full[1])];
    let crop = [far[0] - low[0], far[1] - low[1]];
    let size = graph_cut::reduced(crop);
    let scale = f64::from(size[0]) / f64::from(crop[0]);
    let cut_out = |image: &GrayImage| {
        let part = image::imageops::crop_imm(image, low[0], low[1], crop[0], crop[1]).to_image();
        masks::threshold(&masks::parts(&part, size), size, size, 0.5)
    };
    let small =
        resample::photograph(&image::imageops::crop_imm(picture, low[0], low[1], crop[0], crop[1]).to_image(), size);
    let sure = cut_out(&masks::threshold(parts, from, full, SURE));
    let carried = cut_out(mask);
    let band = ((BAND * longer * scale).round() as u32).max(2);
    let near = resample::dilate(&carried, band);
    let mut outside = carried.clone();
    outside.iter_mut().for_each(|v| *v = 255 - *v);
    let rim = resample::dilate(&outside, band);
    let known: Vec<Known> = (0..near.as_raw().len())
        .map(|i| match (near.as_raw()[i] != 0, rim.as_raw()[i] != 0, sure.as_raw()[i] != 0, carried.as_raw()[i] != 0) {
            (false, ..) => Known::Background,
            (true, false, true, _) => Known::Object,
            (true, _, _, true) => Known::Maybe,
            (true, _, _, false) => Known::MaybeBackground,
        })
        .collect();
    let cut = graph_cut::segment(&small, &known, SMOOTHNESS)?;
    let (both, of_cut) = cut.iter().zip(carried.as_raw()).fold((0, 0), |(both, all), (cut, carried)| {
        (both + usize::from(*cut && *carried != 0), all + usize::from(*cut))
    });
    let of_carried = carried.as_raw().iter().filter(|v| **v != 0).count().max(1);
    if (both as f64) < FOUND * of_carried as f64 || of_cut as f64 > GROWN * of_carried as f64 {
        return None;
    }
    let raw: Vec<u8> = cut.iter().map(|v| if *v { 255 } else { 0 }).collect();
    let cut = masks::without_specks(&GrayImage::from_raw(size[0], size[1], raw)?, 0.05);
    let reach = resample::dilate(&cut, ((KEPT * longer * scale).round() as u32).max(1));
    let joined = GrayImage::from_fn(size[0], size[1], |x, y| {
        let at = |image: &GrayImage| image.get_pixel(x, y).0[0] != 0;
        Luma([if at(&cut) || at(&carried) && at(&reach) { 255 } else { 0 }])
    });
    let large = masks::threshold(&masks::parts(&joined, size), size, crop, 0.5);
    let mut out = GrayImage::new(full[0], full[1]);
    image::imageops::replace(&mut out, &large, i64::from(low[0]), i64::from(low[1]));
    Some(out)
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    /// A red can of 40 x 80 on a grey floor. The carried mask ends eight pixels above its foot and spreads into the air beside
    /// it: refined it has the foot and no more than a margin of the air.
    #[test]
    fn the_foot_comes_and_the_air_goes() {
        let can = |x: u32, y: u32| (100..140).contains(&x) && (60..140).contains(&y);
        let grain = |x: u32, y: u32| ((x * 7 + y * 13) % 9) as u8;
        let picture = RgbImage::from_fn(240, 200, |x, y| {
            Rgb(if can(x, y) { [170 + grain(x, y), 40, 50] } else { [180 + grain(x, y), 175, 165] })
        });
        let wrong = |x: u32, y: u32| can(x, y) && y < 132 || (140..165).contains(&x) && (60..80).contains(&y);
        let mask = GrayImage::from_fn(240, 200, |x, y| Luma([if wrong(x, y) { 255 } else { 0 }]));
        // Of the air the fit is not sure.
        let part = |x: u32, y: u32| if can(x, y) { 1.0 } else { 0.45 };
        let parts: Vec<f32> =
            mask.enumerate_pixels().map(|(x, y, v)| if v.0[0] != 0 { part(x, y) } else { 0.0 }).collect();
        let found = refined(&picture, &parts, [240, 200], &mask).expect("the can is told from the floor");
        let on = |x: u32, y: u32| found.get_pixel(x, y).0[0] != 0;
        for y in 62..138 {
            assert!((102..138).all(|x| on(x, y)), "row {y}");
        }
        assert!((60..80).all(|y| !(150..165).any(|x| on(x, y))), "the air stays");
        assert!((145..200).all(|y| !(0..240).any(|x| on(x, y))), "the floor stays");
    }

    /// An object of its surroundings' colours is left as it was carried.
    #[test]
    fn where_colours_tell_nothing_nothing_changes() {
        let picture = RgbImage::from_pixel(100, 80, Rgb([90, 90, 90]));
        let mask = GrayImage::from_fn(100, 80, |x, y| {
            Luma([if (30..60).contains(&x) && (20..60).contains(&y) { 255 } else { 0 }])
        });
        let parts = masks::parts(&mask, [100, 80]);
        if let Some(found) = refined(&picture, &parts, [100, 80], &mask) {
            assert_eq!(found, mask);
        }
        assert!(refined(&picture, &parts, [100, 80], &GrayImage::new(100, 80)).is_none());
    }
}

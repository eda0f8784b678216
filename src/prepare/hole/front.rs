//! What stands before the object stays.
//!
//! Masks are enlarged, since they end a little inside the object. Where something stands before the object the mask ends at
//! that thing's border, and enlarged it would eat into it. Such a thing is told by its depth, or, where it is too plain to have
//! one, by its colour: it looks like what is beside it farther out, and like nothing of the object near it.

use glam::DVec3;
use image::{GrayImage, RgbImage};
use rayon::prelude::*;

use super::surface::{self, APART};
use crate::multiview::DepthGrid;
use crate::scene::{Camera, View};
use crate::statistics::median;

/// The object's depth beside a site is that of the mask's sites within this part of the view's longer side, and so many sites.
const REACH: f64 = 0.04;
const LEAST_REACH: i64 = 6;
/// Fewest sites of the object that tell its depth.
const FEWEST: usize = 3;
/// What masks cover in more than this share of the views with it in the picture may be a part of the object.
const COVERED: f64 = 0.3;

/// Difference of colours, 8-bit levels in the mean of the channels, up to which a pixel goes on with what is beside it.
const GOES_ON: u32 = 8;
/// Such a difference up to which it looks like the object.
const OBJECTS: u32 = 24;

/// `[view][site]` what the photographs confirm to stand before the object, beside the masks of its views.
fn before(grids: &[DepthGrid], views: &[View], masks: &[GrayImage]) -> Vec<Vec<bool>> {
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let inside = surface::inside(grids, &cameras, masks);
    let is_objects = |point: DVec3| {
        let (framed, covered) = surface::framing(grids.iter().zip(&inside), point);
        covered as f64 > COVERED * framed as f64
    };
    let of = |(grid, inside): (&DepthGrid, &Vec<bool>)| -> Vec<bool> {
        let reach = ((REACH * f64::from(grid.columns.max(grid.rows))).ceil() as i64).max(LEAST_REACH);
        let object = |site: usize| {
            let sites = grid.around(site, reach).filter(|at| inside[*at] && grid.confirmed[*at]);
            let depths: Vec<f64> = sites.map(|at| grid.depth[at]).collect();
            (depths.len() >= FEWEST).then(|| median(depths)).flatten()
        };
        let one = |site: usize| {
            let z = grid.depth[site];
            let known = !inside[site] && grid.confirmed[site];
            known
                && object(site).is_some_and(|object| z < (1.0 - APART) * object)
                && grid.point(site).is_some_and(|point| !is_objects(point))
        };
        (0..grid.depth.len()).into_par_iter().map(one).collect()
    };
    grids.iter().zip(&inside).map(of).collect()
}

/// Whether a pixel beside a mask is of something else than the object by its colour: within `reach` pixels it is like the nearest
/// pixel beside the enlarged mask, and unlike all of the mask. Next to the mask colours are mixed with the object's.
fn unlike_object(picture: &RgbImage, mask: &GrayImage, enlarged: &GrayImage, i: usize, reach: i64) -> bool {
    let width = i64::from(mask.width());
    let (x, y) = (i as i64 % width, i as i64 / width);
    let apart = |u: u32, v: u32| {
        let [one, other] = [(x as u32, y as u32), (u, v)].map(|(x, y)| picture.get_pixel(x, y).0);
        one.iter().zip(other).map(|(a, b)| u32::from(a.abs_diff(b))).sum::<u32>()
    };
    let mut beside: Option<(i64, u32)> = None;
    for (dx, dy) in (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy))) {
        let (u, v) = ((x + dx).max(0) as u32, (y + dy).max(0) as u32);
        let Some(inside) = mask.get_pixel_checked(u, v) else { continue };
        if inside.0[0] != 0 {
            if 6 * (dx * dx + dy * dy) <= (reach / 2) * (reach / 2) || apart(u, v) <= 3 * OBJECTS {
                return false;
            }
        } else if enlarged.get_pixel(u, v).0[0] == 0 && beside.is_none_or(|(near, _)| dx * dx + dy * dy < near) {
            beside = Some((dx * dx + dy * dy, apart(u, v)));
        }
    }
    beside.is_some_and(|(_, apart)| apart <= 3 * GOES_ON)
}

/// Masks, as large as the pictures of these views, enlarged by a part of their longer side, without what stands before the object.
pub fn enlarged(grids: &[DepthGrid], views: &[View], masks: &[GrayImage], part: f64) -> Vec<GrayImage> {
    let before = before(grids, views, masks);
    let one = |(view, large): (usize, GrayImage)| {
        let (mask, View { camera, image, .. }, grid) = (&masks[view], &views[view], &grids[view]);
        let reach = i64::from(2 * super::radius(mask, part) + 2);
        let stands = |i: usize| {
            let ray = camera.unproject(camera.pixel_center(i))?;
            let [column, row] = grid.place(ray).map(f64::floor);
            Some(before[view][grid.site(column as i64, row as i64)?])
        };
        let mut out = large.clone();
        for (i, value) in out.iter_mut().enumerate().filter(|(i, v)| **v != 0 && mask.as_raw()[*i] == 0) {
            if stands(i) == Some(true) || unlike_object(image, mask, &large, i, reach) {
                *value = 0;
            }
        }
        out
    };
    super::enlarged(masks, part).into_par_iter().enumerate().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::super::surface::tests::{SIZE, views};
    use super::*;
    use crate::scene::resample;

    /// Views by these cameras that show nothing.
    fn black(cameras: &[Camera]) -> Vec<View> {
        let view = |camera: &Camera| View {
            name: String::new(),
            camera: *camera,
            image: RgbImage::new(SIZE[0], SIZE[1]),
            mask: None,
            weight: None,
            prior: None,
            depth: None,
        };
        cameras.iter().map(view).collect()
    }

    /// A post before the square, on its left: the enlarged mask ends at the post, and goes on where the wall is.
    #[test]
    fn a_post_before_the_object_stays() {
        let (mut grids, cameras, mut masks) = views(0.3);
        // At z = 1.5, left of x = -0.1 there.
        for (view, grid) in grids.iter_mut().enumerate() {
            for i in 0..grid.depth.len() {
                let camera = &cameras[view];
                let [x, ..] = camera.lift(camera.pixel_center(i), 1.5).expect("a ray");
                if x < -0.1 {
                    grid.depth[i] = 1.5;
                    masks[view].as_mut()[i] = 0;
                }
            }
        }
        let plain: Vec<GrayImage> = masks.iter().map(|mask| resample::dilate(mask, 3)).collect();
        let kept = enlarged(&grids, &black(&cameras), &masks, 3.0 / 48.0);
        let (mut post, mut wall) = (0, 0);
        for (view, kept) in kept.iter().enumerate() {
            for i in (0..(SIZE[0] * SIZE[1]) as usize).filter(|i| plain[view].as_raw()[*i] != 0) {
                let (on_post, inside) = (grids[view].depth[i] < 1.9, masks[view].as_raw()[i] != 0);
                assert_eq!(kept.as_raw()[i] == 0, on_post && !inside, "view {view}, pixel {i}");
                post += usize::from(on_post);
                wall += usize::from(!on_post && !inside);
            }
        }
        assert!(post > 50 && wall > 200, "{post} of the post, {wall} of the wall");
    }

    /// A corner of the object that its mask misses, and that the other masks cover, is no other thing.
    #[test]
    fn a_part_of_the_object_goes_with_it() {
        let (mut grids, cameras, mut masks) = views(0.4);
        for i in 0..grids[2].depth.len() {
            let x = i as u32 % SIZE[0];
            if masks[2].as_raw()[i] != 0 && x < 20 {
                // It stands out, and the middle view's mask ends before it.
                grids[2].depth[i] = 1.8;
                masks[2].as_mut()[i] = 0;
            }
        }
        let plain: Vec<GrayImage> = masks.iter().map(|mask| resample::dilate(mask, 3)).collect();
        let kept = enlarged(&grids, &black(&cameras), &masks, 3.0 / 48.0);
        assert_eq!(kept[2], plain[2]);
    }

    /// A plain red ball before a blue object: its pixels stay but for those that are mixed, a blue seam that the mask has missed
    /// goes, and so do grainy surroundings.
    #[test]
    fn what_looks_like_something_else_stays() {
        let picture = RgbImage::from_fn(60, 20, |x, y| {
            image::Rgb(match x {
                0..20 => [200 + (x / 4) as u8, 40, 50],
                20..42 => [30, 40, 180],
                _ => [110 + ((x * 7 + y * 13) % 5 * 16) as u8; 3],
            })
        });
        let mask = GrayImage::from_fn(60, 20, |x, _| image::Luma([if (20..40).contains(&x) { 255 } else { 0 }]));
        let enlarged = resample::dilate(&mask, 3);
        let stays = |x: usize| unlike_object(&picture, &mask, &enlarged, 10 * 60 + x, 8);
        assert!((17..19).all(stays) && !stays(19), "the ball, but for what is next to the object");
        assert!(!stays(40) && !stays(41), "the seam");
    }
}

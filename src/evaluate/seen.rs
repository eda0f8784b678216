use std::collections::VecDeque;

use image::{GrayImage, Luma};
use rayon::prelude::*;

use crate::scene::Camera;

/// Coverage below which a pixel shows no surface: more than half of it is background.
const SURFACE: f32 = 0.5;

/// By how much farther than what a train view shows a point may lie and still be what it shows, relative to its depth. A
/// trained surface is thin fog rather than a sheet, and its depth in two views differs by a few per cent.
const BEHIND: f64 = 0.05;
/// The same where depth was measured between photographs or is known: within this share two of them are of one surface.
const BEHIND_MEASURED: f64 = 0.02;

/// The first surface of a view: of a rendered one its depth divided by its coverage.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    size: [usize; 2],
    /// `[row-major pixel]` depth z, scene units; NaN where less than half of the pixel is covered, or nothing is known.
    depth: Vec<f32>,
    /// `[row-major pixel]` the largest depth around a pixel: the edge of a surface is a pixel wide. NaN where it shows none.
    around: Vec<f32>,
    /// A point farther by more than this share is hidden.
    behind: f64,
}

impl Surface {
    /// Of the rendered depth (sum of z alpha T, scene units) and transmittance of a view of `size` (width, height).
    ///
    /// # Panics
    /// Unless there is one depth and one transmittance per pixel.
    pub fn new(size: [u32; 2], depth: &[f32], transmittance: &[f32]) -> Self {
        let size = size.map(|n| n as usize);
        assert!(depth.len() == size[0] * size[1] && depth.len() == transmittance.len(), "one value of each per pixel");
        let normalised = |(z, t): (&f32, &f32)| {
            let coverage = 1.0 - t;
            if coverage >= SURFACE { z / coverage } else { f32::NAN }
        };
        Self::of(size, depth.iter().zip(transmittance).map(normalised).collect(), BEHIND)
    }

    /// Of the depth of a photograph of `size` (width, height) that was measured or is known, `[row-major pixel]` z in scene
    /// units; not positive or not finite where nothing is known.
    ///
    /// # Panics
    /// Unless there is one depth per pixel.
    pub fn measured(size: [u32; 2], depth: &[f32]) -> Self {
        let size = size.map(|n| n as usize);
        assert!(depth.len() == size[0] * size[1], "one depth per pixel");
        let known = |z: &f32| if z.is_finite() && *z > 0.0 { *z } else { f32::NAN };
        Self::of(size, depth.iter().map(known).collect(), BEHIND_MEASURED)
    }

    /// Every point of every view is asked for, so that what is around each pixel is looked for once.
    fn of(size: [usize; 2], depth: Vec<f32>, behind: f64) -> Self {
        let [w, h] = size;
        let largest = |at: usize| -> f32 {
            let (x, y) = (at % w, at / w);
            if depth[at].is_nan() {
                return f32::NAN;
            }
            let rows = y.saturating_sub(1)..(y + 2).min(h);
            let near = rows.flat_map(|y| (x.saturating_sub(1)..(x + 2).min(w)).map(move |x| y * w + x));
            // `max` leaves NaN out.
            near.map(|i| depth[i]).fold(f32::NEG_INFINITY, f32::max)
        };
        let around = (0..w * h).into_par_iter().map(largest).collect();
        Self { size, depth, around, behind }
    }

    /// `[row-major pixel]` depth z, scene units; NaN where there is no surface.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// The same with every pixel that shows no surface given the depth of the nearest one that does (in steps between
    /// neighbours); NaN everywhere if none does.
    fn filled(&self) -> Vec<f32> {
        let [w, h] = self.size;
        let mut depth = self.depth.clone();
        let mut queue: VecDeque<usize> = (0..w * h).filter(|i| !depth[*i].is_nan()).collect();
        while let Some(at) = queue.pop_front() {
            let (x, y) = (at % w, at / w);
            let neighbours = [
                (x > 0).then(|| at - 1),
                (x + 1 < w).then(|| at + 1),
                (y > 0).then(|| at - w),
                (y + 1 < h).then(|| at + w),
            ];
            for next in neighbours.into_iter().flatten() {
                if depth[next].is_nan() {
                    depth[next] = depth[at];
                    queue.push_back(next);
                }
            }
        }
        depth
    }
}

/// A view as the trained model shows it.
#[derive(Clone, Copy, Debug)]
pub struct Shown<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// Not 0 on the object; as large as the view.
    pub mask: Option<&'a GrayImage>,
    /// Its surface, likewise.
    pub surface: &'a Surface,
}

impl Shown<'_> {
    /// Where a world point appears in this view, pixels: in the picture and not behind what the model shows there.
    pub(super) fn sees(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let [px, py] = self.camera.within(point)?;
        let [x, y, z] = self.camera.to_camera(point);
        let surface = self.surface.around[py as usize * self.surface.size[0] + px as usize];
        // Nothing is behind what is not there: NaN.
        if z > f64::from(surface) * (1.0 + self.surface.behind) {
            return None;
        }
        if self.camera.distortion != [0.0; 4] {
            // Beyond a lens's fold, rays from outside the picture come back into it.
            let ray = self.camera.unproject([px, py])?;
            let close = |a: f64, b: f64| (a - b).abs() <= 1e-6 * (1.0 + b.abs());
            if !(close(ray[0], x / z) && close(ray[1], y / z)) {
                return None;
            }
        }
        Some([px, py])
    }

    /// Whether this view's photograph shows a world point, past its mask.
    fn photographed(&self, point: [f64; 3]) -> bool {
        let masked = |[x, y]: [f64; 2]| self.mask.is_some_and(|mask| mask.get_pixel(x as u32, y as u32).0[0] != 0);
        self.sees(point).is_some_and(|at| !masked(at))
    }

    /// The world point at every pixel; `None` where the model shows nothing at all, or the lens has no ray.
    pub(super) fn points(&self) -> Vec<Option<[f64; 3]>> {
        let point = |(pixel, z): (usize, &f32)| {
            let place = || self.camera.lift(self.camera.pixel_center(pixel), f64::from(*z));
            z.is_finite().then(place).flatten()
        };
        self.surface.filled().par_iter().enumerate().map(point).collect()
    }
}

/// Which pixels of a view show what at least one train view photographed past its mask: 255 there, 0 elsewhere. What a
/// pixel shows is the trained model's surface, or the nearest one beside it where the model shows none.
///
/// A point is photographed by a train view where it falls into its picture, outside its mask, and not behind the surface
/// that the model shows there.
pub fn seen_map(view: Shown<'_>, train: &[Shown<'_>]) -> GrayImage {
    let seen = |point: &Option<[f64; 3]>| match point {
        Some(point) => train.iter().any(|view| view.photographed(*point)),
        // Without any surface nothing is excused.
        None => true,
    };
    let values: Vec<bool> = view.points().par_iter().map(seen).collect();
    let [width, height] = view.camera.size;
    GrayImage::from_fn(width, height, |x, y| Luma([255 * u8::from(values[y as usize * width as usize + x as usize])]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Looks along +z from (x, 0, 0); 20 x 10 pixels, focal length 10.
    fn camera(x: f64) -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [-x, 0.0, 0.0],
            focal: [10.0; 2],
            principal: [10.0, 5.0],
            distortion: [0.0; 4],
            size: [20, 10],
        }
    }

    fn flat(depth: f32) -> Surface {
        Surface::new([20, 10], &[depth; 200], &[0.0; 200])
    }

    fn columns(map: &GrayImage) -> Vec<u32> {
        (0..20).filter(|x| map.get_pixel(*x, 5).0[0] == 255).collect()
    }

    #[test]
    fn the_surface_is_the_depth_divided_by_the_coverage() {
        let surface = Surface::new([3, 1], &[4.0, 2.0, 1.0], &[0.0, 0.5, 0.75]);
        assert_eq!(surface.depth()[..2], [4.0, 4.0]);
        assert!(surface.depth()[2].is_nan(), "a quarter covered");
        assert_eq!(surface.filled(), [4.0, 4.0, 4.0]);
        assert!(surface.around[1] == 4.0 && surface.around[2].is_nan());
        assert!(Surface::new([2, 1], &[0.0; 2], &[1.0; 2]).filled().iter().all(|z| z.is_nan()));
    }

    /// A wall at depth 10, where a pixel is as wide as a unit: a camera moved by 5 sees the wall moved by 5 pixels.
    #[test]
    fn what_lies_outside_every_picture_is_unseen() {
        let (wall, here, right) = (flat(10.0), camera(0.0), camera(5.0));
        let view = Shown { camera: &here, mask: None, surface: &wall };
        let other = Shown { camera: &right, mask: None, surface: &wall };
        assert_eq!(columns(&seen_map(view, &[other])), (5..20).collect::<Vec<_>>());
        assert_eq!(columns(&seen_map(view, &[])), [0; 0]);
        assert_eq!(columns(&seen_map(view, &[other, view])), (0..20).collect::<Vec<_>>());
    }

    #[test]
    fn what_lies_behind_every_mask_or_surface_is_unseen() {
        let (wall, here) = (flat(10.0), camera(0.0));
        let view = Shown { camera: &here, mask: None, surface: &wall };
        let mask = GrayImage::from_fn(20, 10, |x, _| Luma([u8::from((4..8).contains(&x))]));
        let masked = Shown { mask: Some(&mask), ..view };
        assert_eq!(columns(&seen_map(view, &[masked])), [(0..4).collect::<Vec<_>>(), (8..20).collect()].concat());
        // A post at depth 5 in columns 10 to 12: its middle hides the wall, its borders are within a pixel of the wall.
        let depth: Vec<f32> = (0..200).map(|i| if (10..=12).contains(&(i % 20)) { 5.0 } else { 10.0 }).collect();
        let post = Surface::new([20, 10], &depth, &[0.0; 200]);
        let hiding = Shown { surface: &post, ..view };
        assert_eq!(columns(&seen_map(view, &[hiding])), [(0..11).collect::<Vec<_>>(), (12..20).collect()].concat());
        // A surface within the tolerance hides nothing, and that of a measured one is narrower.
        let near = flat(9.6);
        assert_eq!(columns(&seen_map(view, &[Shown { surface: &near, ..view }])).len(), 20);
        let measured = Surface::measured([20, 10], &[9.6; 200]);
        assert_eq!(columns(&seen_map(view, &[Shown { surface: &measured, ..view }])), [0; 0]);
        let unknown = Surface::measured([20, 10], &[0.0; 200]);
        assert_eq!(columns(&seen_map(view, &[Shown { surface: &unknown, ..view }])).len(), 20);
        // A view in which the model shows nothing hides nothing; a pixel without a surface takes its neighbour's.
        let empty = Surface::new([20, 10], &[0.0; 200], &[1.0; 200]);
        assert_eq!(columns(&seen_map(view, &[Shown { surface: &empty, ..view }])).len(), 20);
        let thin = Surface::new(
            [20, 10],
            &[10.0; 200],
            &(0..200).map(|i| f32::from(u8::from(i % 20 > 2))).collect::<Vec<_>>(),
        );
        let right = camera(5.0);
        let other = Shown { camera: &right, mask: None, surface: &wall };
        assert_eq!(columns(&seen_map(Shown { surface: &thin, ..view }, &[other])), (5..20).collect::<Vec<_>>());
    }

    #[test]
    fn a_view_behind_the_wall_sees_nothing_of_it() {
        let (wall, here) = (flat(10.0), camera(0.0));
        let behind = Camera { translation: [0.0, 0.0, -20.0], ..camera(0.0) };
        let view = Shown { camera: &here, mask: None, surface: &wall };
        assert_eq!(columns(&seen_map(view, &[Shown { camera: &behind, ..view }])), [0; 0]);
    }
}

//! Pixels that show none of the object, by what the views that were masked by hand see.
//!
//! A measured point that such a view shows beside its mask is none of the object (the visual hull, Laurentini 1994). Nor is a point behind the object that lies on what it stands on: a mask that is carried to the
//! far side would take the floor there for the side of the object that nobody has seen. What something else hides may be its.

use glam::DVec3;
use image::GrayImage;
use rayon::prelude::*;

use super::support::Support;
use super::surface::{APART, Sight};
use crate::multiview::DepthGrid;
use crate::prepare::planes;
use crate::scene::{Camera, resample};

/// Margin of a mask within which a point may be the object's, as a part of its longer side: depth bleeds over its border.
const MARGIN: f64 = 0.02;
/// A site and those around it.
const SITES: usize = 9;
/// Seed of the search for planes.
const SEED: u64 = 5;

/// A view that was masked by hand.
struct Masked {
    sight: Sight,
    supports: Vec<Support>,
}

impl Masked {
    /// Looks at a view with this camera and mask, of the same proportions.
    fn new(grid: &DepthGrid, camera: &Camera, mask: &GrayImage) -> Self {
        let mask = resample::mask(mask, camera.size);
        let longer = f64::from(camera.size[0].max(camera.size[1]));
        let sight = Sight::new(grid.clone(), camera, &resample::dilate(&mask, (MARGIN * longer).ceil() as u32));
        let near = sight.surroundings();
        let rays: Vec<Option<[f64; 2]>> = (0..near.len()).map(|site| near[site].then(|| sight.ray(site))).collect();
        let disparity: Vec<f32> = sight.depth.iter().map(|z| (1.0 / z) as f32).collect();
        let planes = planes::around(&disparity, &rays, &sight.hole, SEED);
        let supports = sight.supports(&planes);
        Self { sight, supports }
    }

    /// Whether a world point is none of the object.
    fn rules_out(&self, point: DVec3) -> bool {
        let Some((site, z)) = self.sight.see(point) else { return false };
        let hidden = z > (1.0 + APART) * self.sight.grid.depth[site];
        if !self.sight.grid.confirmed[site] || hidden != self.sight.hole[site] {
            return false;
        }
        let seen = DVec3::from(self.sight.grid.camera.to_camera(point.to_array()));
        !hidden || self.supports.iter().any(|support| support.has(seen))
    }
}

/// `[view][pixel]` whether what a view shows there is none of the object, by the masks (of the photographs' proportions) of
/// those views that have one. Where nobody has confirmed the depth nothing is known.
pub fn beside(grids: &[DepthGrid], cameras: &[Camera], masks: &[Option<&GrayImage>]) -> Vec<Vec<bool>> {
    let masked: Vec<Masked> = (0..grids.len())
        .into_par_iter()
        .filter(|view| grids[*view].trusted)
        .filter_map(|view| Some(Masked::new(&grids[view], &cameras[view], masks[view]?)))
        .collect();
    let of = |(grid, camera): (&DepthGrid, &Camera)| -> Vec<bool> {
        let one = |site: usize| {
            let point = grid.point(site).filter(|_| grid.trusted && grid.confirmed[site]);
            point.is_some_and(|point| masked.iter().any(|masked| masked.rules_out(point)))
        };
        let sites: Vec<bool> = (0..grid.depth.len()).map(one).collect();
        // A single depth may be wrong.
        let most = |site: usize| 2 * grid.around(site, 1).filter(|near| sites[*near]).count() > SITES;
        let at = |pixel: usize| {
            let [x, y] = grid.place(camera.unproject(camera.pixel_center(pixel))?);
            grid.site(x.floor() as i64, y.floor() as i64)
        };
        let pixels = 0..(camera.size[0] * camera.size[1]) as usize;
        pixels.map(|pixel| at(pixel).is_some_and(|site| sites[site] && most(site))).collect()
    };
    grids.par_iter().zip(cameras).map(of).collect()
}

#[cfg(test)]
mod tests {
    use image::Luma;

    use super::*;

    const SIZE: [u32; 2] = [96, 72];

    /// One of eight cameras around a box of one unit that stands on the floor, y downwards; the height of what each pixel shows,
    /// nothing for what is not the box, and the depths.
    fn view(turn: usize) -> (Camera, Vec<Option<f64>>, DepthGrid) {
        let (sin, cos) = (std::f64::consts::TAU * turn as f64 / 8.0).sin_cos();
        let eye = DVec3::new(4.0 * sin, -2.0, -4.0 * cos);
        let ahead = (DVec3::new(0.0, -0.4, 0.0) - eye).normalize();
        let across = DVec3::Y.cross(ahead).normalize();
        let rows = [across, ahead.cross(across), ahead];
        let camera = Camera {
            rotation: rows.map(|row| row.to_array().map(|v| v as f32)),
            translation: rows.map(|row| -row.dot(eye)),
            focal: [80.0; 2],
            principal: [48.0, 36.0],
            distortion: [0.0; 4],
            size: SIZE,
        };
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let shown = |pixel: usize| {
            let way = DVec3::from(camera.lift(camera.pixel_center(pixel), 1.0).expect("a ray")) - eye;
            let [low, high] =
                [DVec3::new(-0.5, -1.0, -0.5), DVec3::new(0.5, 0.0, 0.5)].map(|corner| (corner - eye) / way);
            let (enter, leave) = (low.min(high).max_element(), low.max(high).min_element());
            let floor = -eye.y / way.y;
            if enter < leave {
                (enter, Some(-(eye + way * enter).y))
            } else {
                (if floor > 0.0 { floor } else { 50.0 }, None)
            }
        };
        let (depth, box_heights): (Vec<f64>, Vec<Option<f64>>) = (0..pixels).map(shown).unzip();
        let (confirmed, colors) = (vec![true; pixels], vec![[0; 3]; pixels]);
        let grid =
            DepthGrid { camera, stride: 1, columns: SIZE[0], rows: SIZE[1], depth, confirmed, colors, trusted: true };
        (camera, box_heights, grid)
    }

    /// The plane through the box's back, of which nothing is seen but where it crosses the floor, is none that the box leans on.
    #[test]
    fn what_crosses_the_floor_holds_nothing_up() {
        let (camera, heights, grid) = view(0);
        let is_box = |x: u32, y: u32| heights[(y * SIZE[0] + x) as usize].is_some();
        let mask = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([if is_box(x, y) { 255 } else { 0 }]));
        let sight = Sight::new(grid, &camera, &mask);
        // Of the world's points x with normal . x = offset.
        let plane = |normal: DVec3, offset: f64| {
            let turned = camera.rotation.map(|row| DVec3::from(row.map(f64::from)).dot(normal));
            let distance = offset - normal.dot(DVec3::from(camera.center()));
            turned.map(|v| v / distance)
        };
        let (floor, back) = (plane(DVec3::Y, 0.0), plane(DVec3::Z, 0.5));
        let alone = |plane| sight.supports(&[plane]).len();
        assert_eq!((alone(floor), sight.supports(&[floor, back]).len()), (1, 1));
        let under = camera.to_camera([0.0, 0.0, 0.0]);
        let supports = sight.supports(&[floor, back]);
        let found = supports[0].under([under[0] / under[2], under[1] / under[2]]);
        assert!(found.is_some_and(|z| (z / under[2] - 1.0).abs() < 1e-6), "{found:?}");
    }

    /// From one mask: in all views the floor is none of the object, on its far side too, and all of the object stays but the
    /// last of its foot.
    #[test]
    fn the_floor_behind_the_object_is_none_of_it() {
        let views: Vec<_> = (0..8).map(view).collect();
        let is_box = |pixel: usize| views[0].1[pixel].is_some();
        let mask = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([u8::from(is_box((y * SIZE[0] + x) as usize))]));
        let mut masks = vec![None; 8];
        masks[0] = Some(&mask);
        let grids: Vec<DepthGrid> = views.iter().map(|(.., grid)| grid.clone()).collect();
        let cameras: Vec<Camera> = views.iter().map(|(camera, ..)| *camera).collect();
        let found = beside(&grids, &cameras, &masks);
        let (mut floor, mut kept) = (0, 0);
        for ((_, heights, grid), found) in views.iter().zip(&found).skip(1) {
            // The floor that the box hides from the first view.
            let near = |pixel: usize| {
                grid.point(pixel).is_some_and(|point| point.x.abs() < 0.4 && (0.6..1.5).contains(&point.z))
            };
            for (pixel, height) in heights.iter().enumerate() {
                match height {
                    Some(height) => assert!(*height < 0.1 || !found[pixel], "{height}"),
                    None if near(pixel) => (floor, kept) = (floor + 1, kept + usize::from(!found[pixel])),
                    None => {}
                }
            }
        }
        assert!(floor > 500 && kept * 20 < floor, "{kept} of {floor}");
        // What hides half of the object from the masked view is not to hide that it is one.
        let mut hiding = grids.clone();
        let before = |pixel: usize| pixel as u32 % SIZE[0] > SIZE[0] / 2;
        hiding[0].depth.iter_mut().enumerate().filter(|(pixel, _)| before(*pixel)).for_each(|(_, z)| *z = 1.0);
        let half = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
            let pixel = (y * SIZE[0] + x) as usize;
            Luma([u8::from(is_box(pixel) && !before(pixel))])
        });
        masks[0] = Some(&half);
        let found = beside(&hiding, &cameras, &masks);
        let high = |of: usize, pixel: usize| views[of].1[pixel].is_some_and(|height| height > 0.15);
        for of in 1..8 {
            let lost: Vec<f64> = (0..found[of].len())
                .filter(|pixel| high(of, *pixel) && found[of][*pixel])
                .filter_map(|pixel| views[of].1[pixel])
                .collect();
            assert!(lost.is_empty(), "{of}: {lost:?}");
        }
        // A view that is not trusted says nothing of others, and nobody of it.
        let mut grids = grids;
        grids[0].trusted = false;
        assert!(!beside(&grids, &cameras, &masks).iter().flatten().any(|beside| *beside));
    }
}

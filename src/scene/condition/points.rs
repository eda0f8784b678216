//! The points that anchors start from: none on the object, some in the hole.

use std::collections::BTreeSet;

use rayon::prelude::*;

use crate::scene::{Camera, Hole, Point, Scene, View};

/// A point that falls into the mask in more than this share of the views that have it in the picture stands on the object.
const OBJECT_SHARE: f64 = 0.9;
/// Fewest views that must have a point in the picture for it to be judged.
const FEWEST_VIEWS: usize = 2;

/// Whether a point falls into the mask in nearly all views that have it in the picture.
pub(crate) fn on_object(views: &[View]) -> impl Fn(&Point) -> bool + Sync {
    let views: Vec<_> = views.iter().filter_map(|v| Some((&v.camera, v.mask.as_ref()?))).collect();
    move |point| {
        let position = point.position.map(f64::from);
        let (mut seen, mut inside) = (0, 0);
        for (camera, mask) in &views {
            if let Some(pixel) = camera.pixel_of(position) {
                seen += 1;
                inside += usize::from(mask.as_raw()[pixel] != 0);
            }
        }
        seen >= FEWEST_VIEWS && inside as f64 > OBJECT_SHARE * seen as f64
    }
}

/// Leaves out the points that stand on the object: anchors there would have to fade against views that cannot see them fade.
pub(super) fn drop_object(scene: &mut Scene) {
    if scene.train.iter().all(|v| v.mask.is_none()) {
        return;
    }
    let on_object = on_object(&scene.train);
    let dropped: Vec<bool> = scene.points.par_iter().map(on_object).collect();
    let count = dropped.iter().filter(|d| **d).count();
    if count == 0 {
        return;
    }
    let all = scene.points.len();
    if 10 * count > 9 * all {
        scene.notes.push(format!(
            "{count} of {all} points fall into the masks, so that none is left out; are the masks inverted?"
        ));
        return;
    }
    let mut at = dropped.iter();
    scene.points.retain(|_| !at.next().is_some_and(|d| *d));
    scene.notes.push(format!("{count} of {all} points stand on the object and are left out (scene.seed_hole)"));
}

/// Adds a point for every pixel of the references' holes, at their depths (\[pixel\], NaN outside the hole). What an earlier
/// reference has given points to gets none from a later one.
pub(super) fn seed_holes(scene: &mut Scene, depths: &[Option<Vec<f32>>]) {
    let before = scene.points.len();
    let mut seeded: Vec<(&Camera, &[f32])> = vec![];
    for (reference, depth) in scene.references.iter().zip(depths) {
        let Some(depth) = depth else { continue };
        let camera = &scene.train[reference.view].camera;
        for (pixel, z) in depth.iter().enumerate().filter(|(_, z)| z.is_finite()) {
            let Some(position) = camera.lift(camera.pixel_center(pixel), f64::from(*z)) else { continue };
            if seeded.iter().any(|(other, depth)| other.pixel_of(position).is_some_and(|p| depth[p].is_finite())) {
                continue;
            }
            let [w, _] = camera.size;
            let color = reference.image.get_pixel(pixel as u32 % w, pixel as u32 / w).0;
            scene.points.push(Point { position: position.map(|v| v as f32), color });
        }
        seeded.push((camera, depth));
    }
    let added = scene.points.len() - before;
    if added > 0 {
        scene.notes.push(format!(
            "{added} points are added in the hole, at the depth of the reference's prior (scene.seed_hole)"
        ));
    }
}

/// How far behind a depth edge is filled at most, as a share of the picture's width.
const EDGE_REACH: f64 = 0.05;
/// Depths this much apart, as a ratio, are the two sides of an edge.
const EDGE_RATIO: f64 = 1.02;

/// Adds points behind the depth edges of the references' holes (`depths` as in [`seed_holes`]). From beside the reference's
/// place something appears there that neither the reference nor, past the object, any photograph has seen: what is nearest
/// beyond the edge goes on behind it, its colours mirrored at the edge, as far as the other train cameras can see.
pub(super) fn seed_behind_edges(scene: &mut Scene, depths: &[Option<Vec<f32>>]) {
    let before = scene.points.len();
    for (reference, depth) in scene.references.iter().zip(depths) {
        let Some(depth) = depth else { continue };
        let camera = &scene.train[reference.view].camera;
        let [w, h] = camera.size.map(|n| n as i32);
        let reach = (EDGE_REACH * f64::from(w)).round() as i32;
        let mut disc: Vec<[i32; 2]> = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| [x, y])).collect();
        let length = |[x, y]: [i32; 2]| x * x + y * y;
        disc.retain(|step| (1..=reach * reach).contains(&length(*step)));
        disc.sort_by_key(|step| length(*step));
        let at = |x: i32, y: i32| {
            let inside = (0..w).contains(&x) && (0..h).contains(&y);
            inside.then(|| (y * w + x) as usize).filter(|&pixel| depth[pixel].is_finite())
        };
        // The point behind this pixel that some camera sees beside it.
        let behind = |pixel: usize| {
            let (x, y, near) = (pixel as i32 % w, pixel as i32 / w, f64::from(depth[pixel]));
            let beyond = |pixel: usize| f64::from(depth[pixel]) > EDGE_RATIO * near;
            let (step, edge) = disc.iter().find_map(|step| {
                let edge = at(x + step[0], y + step[1]).filter(|&pixel| beyond(pixel))?;
                Some((*step, edge))
            })?;
            let ray = camera.unproject(camera.pixel_center(pixel))?;
            let (front, back) = (camera.along(ray, near), camera.along(ray, f64::from(depth[edge])));
            let uncovered = scene.train.iter().any(|view| {
                let (Some(a), Some(b)) = (view.camera.project(front), view.camera.project(back)) else { return false };
                let scale = f64::from(w) / f64::from(view.camera.size[0]);
                (a[0] - b[0]).hypot(a[1] - b[1]) * scale >= f64::from(length(step)).sqrt()
            });
            let mirrored = at(x + 2 * step[0], y + 2 * step[1]).filter(|&pixel| beyond(pixel)).unwrap_or(edge) as i32;
            let color = reference.image.get_pixel((mirrored % w) as u32, (mirrored / w) as u32).0;
            uncovered.then(|| Point { position: back.map(|v| v as f32), color })
        };
        let hole: Vec<usize> = (0..depth.len()).filter(|&pixel| depth[pixel].is_finite()).collect();
        let points: Vec<Point> = hole.into_par_iter().filter_map(behind).collect();
        scene.points.extend(points);
    }
    let added = scene.points.len() - before;
    if added > 0 {
        scene.notes.push(format!(
            "{added} points are added behind depth edges in the hole, where nothing is seen (scene.seed_hole)"
        ));
    }
}

/// Side of the squares of a hole that have points or get some, pixels, and pixels between those that they get.
const SQUARE: usize = 4;
const EVERY: usize = 2;
/// Relative difference in depth up to which a point is of what a hole shows.
const ON_IT: f64 = 0.04;

/// \[pixel\] whether a filled hole shows a surface that none of `points` (world coordinates) is on: no pixel around it, in squares of
/// [`SQUARE`] pixels, has one within 4 % of its depth.
pub(crate) fn bare(
    hole: &Hole,
    depth: &[f32],
    camera: &Camera,
    points: impl ParallelIterator<Item = [f32; 3]>,
) -> Vec<bool> {
    let w = camera.size[0] as usize;
    let square = |pixel: usize| (pixel / w / SQUARE) * w.div_ceil(SQUARE) + pixel % w / SQUARE;
    let has = |position: [f32; 3]| {
        let position = position.map(f64::from);
        let pixel = camera.pixel_of(position)?;
        let apart = camera.to_camera(position)[2] / f64::from(depth[pixel]) - 1.0;
        (apart.abs() <= ON_IT).then(|| square(pixel))
    };
    let seeded: BTreeSet<usize> = points.filter_map(has).collect();
    let wanted =
        |pixel: usize| hole.filled.as_raw()[pixel] != 0 && depth[pixel].is_finite() && !seeded.contains(&square(pixel));
    (0..depth.len()).map(wanted).collect()
}

/// Adds points to the filled holes of views that are no references, at the depth that `prepare` has found there, to all squares of a hole
/// that none of the scene's points is on. Where nothing is to begin with nothing is learnt: the background's black would stay.
pub fn seed_views(scene: &mut Scene) {
    let mut points = scene.starts();
    let before = points.len();
    for hole in &scene.holes {
        let Some(depth) = &hole.depth else { continue };
        let camera = &scene.train[hole.view].camera;
        let w = camera.size[0] as usize;
        let bare = bare(hole, depth, camera, points.par_iter().map(|point| point.position));
        let even = |pixel: &usize| (pixel / w).is_multiple_of(EVERY) && (pixel % w).is_multiple_of(EVERY);
        let more = (0..depth.len()).filter(|pixel| bare[*pixel] && even(pixel)).filter_map(|pixel| {
            let position = camera.lift(camera.pixel_center(pixel), f64::from(depth[pixel]))?;
            let color = hole.image.get_pixel((pixel % w) as u32, (pixel / w) as u32).0;
            Some(Point { position: position.map(|v| v as f32), color })
        });
        let more: Vec<Point> = more.collect();
        points.extend(more);
    }
    let added = points.split_off(before);
    if !added.is_empty() {
        scene.notes.push(format!(
            "{} points are added in the holes of views other than the reference, where there were none (scene.seed_hole)",
            added.len()
        ));
        scene.dense.extend(added);
    }
}

#[cfg(test)]
mod tests {
    use image::GrayImage;

    use super::super::reference;
    use super::*;
    use crate::scene::{Config, load, synthetic};

    /// The object is a sphere of radius 0.2 or so on a stand; the room is exact, so what stands where is known.
    #[test]
    fn the_object_has_no_points_and_the_hole_has_some() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let read = load(&dir, &Config::default()).expect("it loads");
        let mut scene = read.clone();
        drop_object(&mut scene);
        let dropped = read.points.len() - scene.points.len();
        assert!((100..1000).contains(&dropped), "{dropped}");
        let left = scene.points.len();
        let depths = reference::hole_depths(&scene);
        assert!(depths[0].is_some(), "the reference has a prior");
        seed_holes(&mut scene, &depths);
        let mask = scene.train[scene.references[0].view].mask.as_ref().expect("one");
        let hole = mask.as_raw().iter().filter(|m| **m != 0).count();
        assert_eq!(scene.points.len() - left, hole);
        // A second reference of the same hole gives no second points.
        let mut twice = scene.clone();
        twice.points.truncate(left);
        twice.references.push(twice.references[0].clone());
        seed_holes(&mut twice, &[depths[0].clone(), depths[0].clone()]);
        assert_eq!(twice.points.len() - left, hole);
        // They lie where the room is: each is near a point that structure from motion would have found there, had the
        // object been away. The room is a box from -2 to 2; nothing floats in front of the bench at y = 0.
        let inside = scene.points[left..].iter().filter(|p| p.position.iter().all(|x| x.abs() < 6.0)).count();
        assert_eq!(inside, hole);
        // Without masks, or with masks on everything, points stay.
        let mut bare = read.clone();
        bare.train.iter_mut().for_each(|v| v.mask = None);
        drop_object(&mut bare);
        assert_eq!(bare.points.len(), read.points.len());
        let mut full = read.clone();
        full.train.iter_mut().for_each(|v| v.mask.as_mut().expect("one").fill(255));
        drop_object(&mut full);
        assert_eq!(full.points.len(), read.points.len());
        assert!(full.notes.last().expect("a note").contains("inverted"));
    }

    /// Two views show one wall in their holes. It has points to begin with in every square of either hole, as dense as they are there and
    /// no denser where both see it, and none where nothing is filled.
    #[test]
    fn every_hole_has_something_to_begin_with() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let mut scene = load(&dir, &Config::default()).expect("it loads");
        scene.points.clear();
        for view in [0, 1] {
            let View { camera, image, .. } = &scene.train[view];
            let [w, h] = camera.size;
            let filled = GrayImage::from_fn(w, h, |x, y| {
                image::Luma([if (20..60).contains(&x) && (16..48).contains(&y) { 255 } else { 0 }])
            });
            // The wall is what is 4 before the first camera.
            let first = &scene.train[0].camera;
            let depth = |pixel: usize| {
                let ray = camera.unproject(camera.pixel_center(pixel)).expect("no distortion");
                let [near, far] = [1.0, 2.0].map(|z| first.to_camera(camera.along(ray, z))[2]);
                (1.0 + (4.0 - near) / (far - near)) as f32
            };
            let depth = (0..(w * h) as usize).map(depth).collect();
            scene.holes.push(Hole { view, image: image.clone(), covered: filled.clone(), filled, depth: Some(depth) });
        }
        let both = scene.clone();
        seed_views(&mut scene);
        assert_eq!(scene.notes.len(), both.notes.len() + 1);
        for (at, Hole { view, depth, .. }) in scene.holes.iter().enumerate() {
            let camera = &scene.train[*view].camera;
            let w = camera.size[0] as usize;
            let depth = depth.as_ref().expect("one");
            let pixels = scene.dense.iter().filter_map(|point| camera.pixel_of(point.position.map(f64::from)));
            let squares: BTreeSet<[usize; 2]> = pixels.map(|i| [i % w / SQUARE, i / w / SQUARE]).collect();
            for (x, y) in (5..15).flat_map(|x| (4..12).map(move |y| (x, y))) {
                assert!(squares.contains(&[x, y]), "hole {at}, square {x}, {y}");
            }
            assert!(depth.iter().all(|z| z.is_finite()));
        }
        let first = (40 / EVERY) * (32 / EVERY);
        assert!((first..2 * first).contains(&scene.dense.len()), "{}", scene.dense.len());
        let again = scene.dense.len();
        seed_views(&mut scene);
        assert_eq!(scene.dense.len(), again);
        let mut untold = both;
        untold.holes.iter_mut().for_each(|hole| hole.depth = None);
        seed_views(&mut untold);
        assert!(untold.dense.is_empty());
    }

    /// A step in depth: the far side goes on behind the near one, no further than another camera looks behind it.
    #[test]
    fn the_far_side_of_an_edge_goes_on_behind_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let mut scene = load(&dir, &Config::default()).expect("it loads");
        let reference = &mut scene.references[0];
        let [w, h] = scene.train[reference.view].camera.size;
        // Columns 70 to 79 are near, 80 to 89 are far, of one colour each.
        let hole = |x: u32, y: u32| (70..90).contains(&x) && (50..60).contains(&y);
        let (near, far) = (2.0f32, 3.0f32);
        let depth: Vec<f32> = (0..h)
            .flat_map(|y| (0..w).map(move |x| (x, y)))
            .map(|(x, y)| {
                if !hole(x, y) {
                    f32::NAN
                } else if x < 80 {
                    near
                } else {
                    far
                }
            })
            .collect();
        for (x, y, pixel) in reference.image.enumerate_pixels_mut() {
            pixel.0 = if x < 80 { [200, 0, 0] } else { [0, 0, (y % 200) as u8] };
        }
        let camera = scene.train[reference.view].camera;
        let before = scene.points.len();
        seed_behind_edges(&mut scene, &[Some(depth.clone())]);
        let added = &scene.points[before..];
        // A camera moves the two sides apart by much more than the reach of 8 pixels.
        assert_eq!(added.len(), 8 * 10);
        for point in added {
            let position = point.position.map(f64::from);
            let pixel = camera.pixel_of(position).expect("in the picture");
            assert!((72..80).contains(&(pixel % w as usize)) && (camera.to_camera(position)[2] - 3.0).abs() < 1e-4);
            assert_eq!(point.color, [0, 0, (pixel / w as usize % 200) as u8], "of the far side, in the same row");
        }
        // From the reference's place alone nothing is uncovered, nor by a step that no camera tells.
        let mut alone = scene.clone();
        alone.train.iter_mut().for_each(|v| v.camera = camera);
        let left = alone.points.len();
        seed_behind_edges(&mut alone, &[Some(depth.clone())]);
        assert_eq!(alone.points.len(), left);
        let flat: Vec<f32> = depth.iter().map(|z| if *z == far { 1.01 * near } else { *z }).collect();
        seed_behind_edges(&mut scene, &[Some(flat)]);
        assert_eq!(scene.points.len(), left);
    }
}

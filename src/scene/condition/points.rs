//! The points that anchors start from: none on the object, some in the hole.

use rayon::prelude::*;

use crate::scene::{Camera, Point, Scene};

/// Fewest views that must have a point in the picture for it to be judged.
const FEWEST_VIEWS: usize = 2;

/// The pixel that a world point falls into, row-major.
pub(super) fn pixel_of(camera: &Camera, position: [f64; 3]) -> Option<usize> {
    let [u, v] = camera.project(position)?;
    let [w, h] = camera.size;
    let inside = u >= 0.0 && v >= 0.0 && u < f64::from(w) && v < f64::from(h);
    inside.then(|| v as usize * w as usize + u as usize)
}

/// Where the world is that a pixel's centre shows at this depth z; `None` where the lens has no inverse.
pub(super) fn lift(camera: &Camera, pixel: usize, depth: f64) -> Option<[f64; 3]> {
    let w = camera.size[0] as usize;
    let [x, y] = camera.unproject([(pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5])?;
    let center = camera.center();
    let ray = [x * depth, y * depth, depth];
    Some(std::array::from_fn(|i| center[i] + (0..3).map(|k| f64::from(camera.rotation[k][i]) * ray[k]).sum::<f64>()))
}

/// Leaves out the points that fall into the mask in more than this share of the views that have them in the picture: they
/// stand on the object, and anchors there would have to fade against views that cannot see them fade. With 1 all stay.
pub(super) fn drop_object(scene: &mut Scene, share: f64) {
    if share >= 1.0 || scene.train.iter().all(|v| v.mask.is_none()) {
        return;
    }
    let views: Vec<_> = scene.train.iter().filter_map(|v| Some((&v.camera, v.mask.as_ref()?))).collect();
    let on_object = |point: &Point| {
        let position = point.position.map(f64::from);
        let (mut seen, mut inside) = (0, 0);
        for (camera, mask) in &views {
            if let Some(pixel) = pixel_of(camera, position) {
                seen += 1;
                inside += usize::from(mask.as_raw()[pixel] != 0);
            }
        }
        seen >= FEWEST_VIEWS && inside as f64 > share * seen as f64
    };
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
    scene
        .notes
        .push(format!("{count} of {all} points stand on the object and are left out (scene.object_point_share)"));
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
            let Some(position) = lift(camera, pixel, f64::from(*z)) else { continue };
            if seeded.iter().any(|(other, depth)| pixel_of(other, position).is_some_and(|p| depth[p].is_finite())) {
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

#[cfg(test)]
mod tests {
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
        drop_object(&mut scene, 1.0);
        assert_eq!(scene.points.len(), read.points.len());
        drop_object(&mut scene, 0.9);
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
        drop_object(&mut bare, 0.9);
        assert_eq!(bare.points.len(), read.points.len());
        let mut full = read.clone();
        full.train.iter_mut().for_each(|v| v.mask.as_mut().expect("one").fill(255));
        drop_object(&mut full, 0.9);
        assert_eq!(full.points.len(), read.points.len());
        assert!(full.notes.last().expect("a note").contains("inverted"));
    }

    #[test]
    fn lifting_is_the_inverse_of_projecting() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options { width: 64, height: 48, ..Default::default() }).expect("a scene");
        let scene = load(&dir, &Config::default()).expect("it loads");
        let camera = &scene.train[3].camera;
        for pixel in [0, 77, 64 * 48 - 1] {
            let at = lift(camera, pixel, 2.5).expect("the lens has an inverse");
            assert_eq!(pixel_of(camera, at), Some(pixel));
            assert!((camera.to_camera(at)[2] - 2.5).abs() < 1e-6);
        }
    }
}

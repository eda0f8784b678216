//! The length that counts as one.
//!
//! Structure from motion leaves the unit open. Whatever is meant in scene units (the near plane, caps, the decoders'
//! distance input, the rate of offsets) would mean something else in each capture. So positions are divided by a length
//! of the scene: a third of the median depth at which the train views see the points, which is close to the scale of the
//! scenes that the published values were chosen on.

use crate::scene::{Camera, Scene};
use crate::statistics::median;

/// Depths are counted in thirds of their median.
const MEDIAN_DEPTH: f64 = 3.0;
/// Views and points that the median is taken over.
const VIEWS: usize = 64;
const POINTS: usize = 20_000;
/// Steps per octave of the unit's ratio to the spread of the cameras. Camera centres are kept in float64 and scale
/// exactly, points are float32 and do not: on this grid the unit follows the cameras to float64, whatever the scale.
const GRID: f64 = 32.0;

/// Divides all lengths of the scene by `unit`, or for 0 by the one found from it, and remembers it.
pub fn normalize(scene: &mut Scene, unit: f64) {
    let unit = if unit > 0.0 { unit } else { typical(scene).unwrap_or(1.0) };
    if unit == 1.0 {
        return;
    }
    scene.rescale(unit);
    scene.notes.push(format!("lengths are counted in units of {unit:.4} of the model's (scene.unit)"));
}

/// World length that a pixel of the train views covers at the median depth of the points, on the same grid as the unit;
/// `None` where no view sees a point.
pub fn footprint(scene: &Scene) -> Option<f64> {
    let depth = MEDIAN_DEPTH * typical(scene)?;
    let pixels = scene.train.iter().map(|v| 1.0 / f64::from(v.camera.focal[0].max(v.camera.focal[1])));
    Some(depth * median(pixels)?)
}

/// The length that counts as one unless another is asked for: a third of the median depth of the points; `None` where no view
/// sees a point.
pub fn typical(scene: &Scene) -> Option<f64> {
    let cameras: Vec<&Camera> = scene.train.iter().map(|v| &v.camera).collect();
    let every = |n: usize, most: usize| n.div_ceil(most).max(1);
    let points = scene.points.iter().step_by(every(scene.points.len(), POINTS));
    let mut depths = vec![];
    for camera in cameras.iter().step_by(every(cameras.len(), VIEWS)) {
        let depth = |position: [f32; 3]| {
            let position = position.map(f64::from);
            camera.within(position).map(|_| camera.to_camera(position)[2])
        };
        depths.extend(points.clone().filter_map(|p| depth(p.position)));
    }
    let depth = median(depths)? / MEDIAN_DEPTH;
    let spread = spread(&cameras);
    let octaves = |ratio: f64| (ratio.log2() * GRID).round() / GRID;
    let found = if spread > 0.0 { spread * octaves(depth / spread).exp2() } else { depth };
    (found.is_finite() && found > 0.0).then_some(found)
}

/// Root mean square distance of the cameras from their mean.
fn spread(cameras: &[&Camera]) -> f64 {
    let n = cameras.len() as f64;
    let centers: Vec<[f64; 3]> = cameras.iter().map(|c| c.center()).collect();
    let mean: [f64; 3] = std::array::from_fn(|i| centers.iter().map(|c| c[i]).sum::<f64>() / n);
    let square: f64 = centers.iter().map(|c| (0..3).map(|i| (c[i] - mean[i]).powi(2)).sum::<f64>()).sum();
    (square / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load, synthetic};

    /// The scene in another unit: as a user would get it who scaled the COLMAP model.
    fn scaled(scene: &Scene, factor: f64) -> Scene {
        let mut scene = scene.clone();
        for view in scene.train.iter_mut().chain(&mut scene.test) {
            view.camera.translation = view.camera.translation.map(|t| t * factor);
        }
        for point in &mut scene.points {
            point.position = point.position.map(|x| (f64::from(x) * factor) as f32);
        }
        scene.radius = (f64::from(scene.radius) * factor) as f32;
        scene
    }

    #[test]
    fn the_users_unit_changes_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options { width: 32, height: 24, points: 500, ..Default::default() };
        synthetic::write(&dir, &options).expect("a scene");
        let read = load(&dir, &Config::default()).expect("it loads");
        let mut plain = read.clone();
        normalize(&mut plain, 0.0);
        assert!((0.3..3.0).contains(&plain.unit), "{}", plain.unit);
        for factor in [1e-6, 1e-2, 0.3, 7.0, 1e3, 1e6] {
            let mut scene = scaled(&read, factor);
            normalize(&mut scene, 0.0);
            assert!((scene.unit / plain.unit / factor - 1.0).abs() < 1e-12, "{} {}", scene.unit, plain.unit);
            for (a, b) in scene.train.iter().zip(&plain.train) {
                // The float64 translation differs by its last places.
                let near = |a: f64, b: f64| (a - b).abs() <= 1e-12 * b.abs().max(1.0);
                assert!((0..3).all(|i| near(a.camera.translation[i], b.camera.translation[i])));
            }
            for (a, b) in scene.points.iter().zip(&plain.points) {
                // Scaled, stored and scaled back: three float32 roundings.
                assert!((0..3).all(|i| (a.position[i] - b.position[i]).abs() <= 2e-7 * b.position[i].abs()));
            }
        }
        // A unit that is asked for is taken, and undone by its inverse.
        let mut asked = read.clone();
        normalize(&mut asked, 1.0);
        assert_eq!((asked.unit, asked.points[0]), (1.0, read.points[0]));
        let mut twice = read.clone();
        normalize(&mut twice, 2.0);
        assert_eq!(twice.points[3].position.map(|x| 2.0 * x), read.points[3].position);
        assert_eq!(twice.radius * 2.0, read.radius);
    }
}

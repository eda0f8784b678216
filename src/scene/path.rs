//! A camera path through the captured region, for looking around in a scene.

use glam::{DMat3, DVec3};

use super::{Camera, Point};
use crate::statistics::median;

/// A smooth closed path of `frames` pinhole cameras, all looking at the point that the train cameras look at
/// ([`focus`]).
///
/// Cameras that stand before the scene: an ellipse about their mean position, as wide and high as the cameras spread
/// (standard deviations along the picture's axes), swinging in and out twice. Cameras that stand around the scene: a
/// circle about the focus at their mean distance and height.
///
/// Size and focal length are those of the train camera nearest to the mean; the principal point is in the middle and the
/// lens does not distort. Empty without train cameras.
pub fn spiral(train: &[Camera], points: &[Point], frames: u32) -> Vec<Camera> {
    let Some(average) = Average::of(train) else { return vec![] };
    let focus = average.focus(train, points);
    let lens = train
        .iter()
        .min_by(|a, b| {
            let distance = |c: &Camera| center(c).distance_squared(average.center);
            distance(a).total_cmp(&distance(b))
        })
        .expect("an average has cameras");
    let angles = (0..frames).map(|i| std::f64::consts::TAU * f64::from(i) / f64::from(frames));
    let offsets = train.iter().map(|c| center(c) - focus);
    let distance = offsets.clone().map(DVec3::length).sum::<f64>() / train.len() as f64;
    // Around the scene, view directions cancel, or the cameras surround the point they look at.
    let around = average.direction.length() < 0.5 || average.center.distance(focus) < 0.5 * distance;
    if around {
        let axis = average.up;
        let height = offsets.clone().map(|o| o.dot(axis)).sum::<f64>() / train.len() as f64;
        let radius = offsets.clone().map(|o| o.reject_from_normalized(axis).length()).sum::<f64>() / train.len() as f64;
        let first = center(&train[0]) - focus;
        let right = first.reject_from_normalized(axis).try_normalize().unwrap_or_else(|| axis.any_orthonormal_vector());
        let front = axis.cross(right);
        angles
            .map(|a| {
                let eye = focus + axis * height + radius * (right * a.cos() + front * a.sin());
                look(eye, focus, axis, lens)
            })
            .collect()
    } else {
        let forward = (focus - average.center).normalize_or(DVec3::Z);
        let axes = upright(forward, average.up);
        let spread = |axis: DVec3| {
            let square: f64 = train.iter().map(|c| (center(c) - average.center).dot(axis).powi(2)).sum();
            (square / train.len() as f64).sqrt()
        };
        let [right, down, ahead] = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis * spread(axis));
        angles
            .map(|a| {
                let eye = average.center + right * a.cos() + down * a.sin() + ahead * (2.0 * a).sin();
                look(eye, focus, average.up, lens)
            })
            .collect()
    }
}

/// The point nearest to all view axes in the least-squares sense. Where the axes are so close to parallel that they
/// hardly meet, or meet behind the cameras, it is the point on the mean view axis at the median depth of the scene's
/// points, as seen from the mean camera.
pub fn focus(train: &[Camera], points: &[Point]) -> Option<[f64; 3]> {
    Some(Average::of(train)?.focus(train, points).to_array())
}

/// Below this mean squared sine of the angle between view axes (2 degrees), where they meet is not known.
const PARALLEL: f64 = 0.001;

struct Average {
    center: DVec3,
    /// Mean of the unit view directions: its length tells how much they agree.
    direction: DVec3,
    /// Unit vector against the pictures' y axes.
    up: DVec3,
}

impl Average {
    fn of(train: &[Camera]) -> Option<Self> {
        if train.is_empty() {
            return None;
        }
        let mean = |value: fn(&Camera) -> DVec3| train.iter().map(value).sum::<DVec3>() / train.len() as f64;
        let direction = mean(direction);
        let ahead = direction.normalize_or(DVec3::Z);
        Some(Self {
            center: mean(center),
            direction,
            up: mean(up).try_normalize().unwrap_or_else(|| ahead.any_orthonormal_vector()),
        })
    }

    fn focus(&self, train: &[Camera], points: &[Point]) -> DVec3 {
        // The sum of squared distances to the axes c + t d is least where sum (I - d d^T) (p - c) = 0.
        let mut matrix = DMat3::ZERO;
        let mut right = DVec3::ZERO;
        for camera in train {
            let d = direction(camera);
            let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            matrix += across;
            right += across * center(camera);
        }
        // Two of the eigenvalues are near 1 for axes that agree, so that the determinant is the third one.
        let determinant = (matrix * (1.0 / train.len() as f64)).determinant();
        if determinant > PARALLEL {
            let met = matrix.inverse() * right;
            let ahead = train.iter().filter(|c| direction(c).dot(met - center(c)) > 0.0).count();
            if 2 * ahead > train.len() {
                return met;
            }
        }
        let ahead = self.direction.normalize_or(DVec3::Z);
        let depths = points
            .iter()
            .map(|p| (DVec3::from_array(p.position.map(f64::from)) - self.center).dot(ahead))
            .filter(|depth| *depth > 0.0);
        let depth = median(depths).unwrap_or(1.0);
        self.center + ahead * depth
    }
}

fn center(camera: &Camera) -> DVec3 {
    DVec3::from_array(camera.center())
}

fn direction(camera: &Camera) -> DVec3 {
    DVec3::from_array(camera.rotation[2].map(f64::from)).normalize_or(DVec3::Z)
}

fn up(camera: &Camera) -> DVec3 {
    -DVec3::from_array(camera.rotation[1].map(f64::from))
}

/// Camera axes (right, down, ahead) as columns, with `up` as near to the picture's upward direction as can be.
fn upright(ahead: DVec3, up: DVec3) -> DMat3 {
    // Looking along `up`, any roll will do.
    let right = ahead.cross(up).try_normalize().unwrap_or_else(|| ahead.any_orthonormal_vector());
    DMat3::from_cols(right, ahead.cross(right), ahead)
}

fn look(eye: DVec3, focus: DVec3, up: DVec3, lens: &Camera) -> Camera {
    let axes = upright((focus - eye).normalize_or(DVec3::Z), up);
    let row = |axis: DVec3| axis.to_array().map(|v| v as f32);
    let rotation = [row(axes.x_axis), row(axes.y_axis), row(axes.z_axis)];
    Camera {
        rotation,
        translation: Camera::translation_to(&rotation, eye.to_array()),
        focal: lens.focal,
        principal: lens.size.map(|side| side as f32 / 2.0),
        distortion: [0.0; 4],
        size: lens.size,
    }
}

#[cfg(test)]
mod tests {
    use glam::dvec3;

    use super::*;

    const UP: DVec3 = DVec3::Z;

    fn lens() -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [90.0, 91.0],
            principal: [50.0, 30.0],
            distortion: [0.1, 0.0, 0.0, 0.0],
            size: [97, 61],
        }
    }

    fn cameras(eyes: impl IntoIterator<Item = DVec3>, focus: DVec3) -> Vec<Camera> {
        let lens = lens();
        eyes.into_iter().map(|eye| Camera { distortion: lens.distortion, ..look(eye, focus, UP, &lens) }).collect()
    }

    /// Float32 poses: 1e-6 relative of coordinates of a few units, over angles of a tenth of a radian and more.
    const CLOSE: f64 = 1e-4;

    /// Every frame sees the focus in the middle of a picture that stands upright, and the path has no jump.
    fn check(path: &[Camera], focus: DVec3) {
        for camera in path {
            let [x, y] = camera.project(focus.to_array()).expect("the focus is ahead");
            assert!((x - 48.5).abs() < 0.01 && (y - 30.5).abs() < 0.01, "{x} {y}");
            let above = camera.project((focus + UP * 0.01).to_array()).expect("ahead");
            assert!(above[1] < y && (above[0] - x).abs() < 0.01, "the picture stands upright");
            assert_eq!((camera.distortion, camera.size, camera.focal), ([0.0; 4], [97, 61], [90.0, 91.0]));
            let r = DMat3::from_cols_array_2d(&camera.rotation.map(|row| row.map(f64::from)));
            assert!((r.determinant() - 1.0).abs() < 1e-5, "a rotation");
        }
        let steps: Vec<f64> =
            (0..path.len()).map(|i| center(&path[i]).distance(center(&path[(i + 1) % path.len()]))).collect();
        let length: f64 = steps.iter().sum();
        assert!(
            steps.iter().all(|step| *step < 4.0 * length / path.len() as f64),
            "closed and without jumps: {steps:?}"
        );
    }

    #[test]
    fn before_a_scene_the_path_stays_among_the_cameras() {
        let focus = dvec3(0.3, 4.0, 1.0);
        let eyes: Vec<DVec3> = (0..5)
            .flat_map(|i| (0..3).map(move |j| dvec3(f64::from(i) * 0.4, 0.1 * f64::from(j), f64::from(j) * 0.3)))
            .collect();
        let train = cameras(eyes.clone(), focus);
        let found = super::focus(&train, &[]).expect("there are cameras");
        assert!(DVec3::from_array(found).distance(focus) < CLOSE, "{found:?}");
        let path = spiral(&train, &[], 60);
        assert_eq!(path.len(), 60);
        check(&path, focus);
        for camera in &path {
            let [x, _, z] = center(camera).to_array();
            assert!((0.0..=1.6).contains(&x) && (0.0..=0.6).contains(&z), "{x} {z}");
        }
        let width = path.iter().map(|c| center(c).x).fold(f64::NEG_INFINITY, f64::max) - 0.8;
        // Five equidistant columns: their standard deviation is sqrt(2) spacings.
        assert!((width - 0.4 * 2f64.sqrt()).abs() < 0.05, "{width}");
    }

    #[test]
    fn around_a_scene_the_path_is_a_circle_about_it() {
        let focus = dvec3(1.0, -2.0, 0.5);
        let eyes = (0..12).map(|i| {
            let a = f64::from(i) * std::f64::consts::TAU / 12.0;
            focus + dvec3(3.0 * a.cos(), 3.0 * a.sin(), 1.0)
        });
        let train = cameras(eyes, focus);
        let path = spiral(&train, &[], 40);
        check(&path, focus);
        for camera in &path {
            assert!((center(camera).distance(focus) - 10f64.sqrt()).abs() < CLOSE);
        }
    }

    #[test]
    fn parallel_axes_focus_at_the_median_depth_of_the_points() {
        let lens = lens();
        let train: Vec<Camera> = (0..4)
            .map(|i| {
                let eye = dvec3(f64::from(i), 0.0, 0.0);
                look(eye, eye + DVec3::Y, UP, &lens)
            })
            .collect();
        let points: Vec<Point> =
            [-3.0, 2.0, 5.0, 1000.0].map(|y| Point { position: [0.0, y, 0.0], color: [0; 3] }).to_vec();
        let found = DVec3::from_array(super::focus(&train, &points).expect("there are cameras"));
        assert!(found.distance(dvec3(1.5, 5.0, 0.0)) < CLOSE, "{found}");
        check(&spiral(&train, &points, 30), found);
    }

    #[test]
    fn one_camera_or_none() {
        assert!(spiral(&[], &[], 10).is_empty());
        let train = cameras([dvec3(0.0, 0.0, 1.0)], dvec3(0.0, 2.0, 1.0));
        let path = spiral(&train, &[], 3);
        assert!(path.iter().all(|c| center(c).distance(dvec3(0.0, 0.0, 1.0)) < CLOSE), "nothing to spread over");
    }
}

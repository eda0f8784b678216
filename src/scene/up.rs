//! Which way is up, from the cameras alone.
//!
//! Nobody holds a camera level to the degree, but on average its y axis points down and its x axis lies in the horizon.
//! Up is the mean of the cameras' upward axes, freed of what the x axes say is horizontal: with M the mean of x x^T,
//! `(M + 0.001 I)^-1 up`. The x axes' spread outweighs a tilt common to all cameras (everybody looks down at a table) as
//! soon as their directions differ by a few degrees; with less they say nothing and the mean remains.

use glam::{DMat3, DVec3};

use super::Camera;

/// Weight of the mean against the x axes' spread: the squared sine of two degrees.
const RIDGE: f64 = 0.001;

fn axis(camera: &Camera, i: usize) -> DVec3 {
    DVec3::from_array(camera.rotation[i].map(f64::from)).normalize_or_zero()
}

/// The upward unit vector; without cameras that agree on one it is the first camera's, or the world's -y.
pub fn estimate(cameras: &[Camera]) -> DVec3 {
    let n = cameras.len().max(1) as f64;
    let first = cameras.first().map_or(DVec3::NEG_Y, |camera| -axis(camera, 1));
    let mean = cameras.iter().map(|camera| -axis(camera, 1)).sum::<DVec3>() / n;
    if mean.length() < 0.1 {
        return first;
    }
    let outer = |x: DVec3| DMat3::from_cols(x * x.x, x * x.y, x * x.z);
    let spread = cameras.iter().fold(DMat3::ZERO, |sum, camera| sum + outer(axis(camera, 0))) * (1.0 / n);
    ((spread + DMat3::from_diagonal(DVec3::splat(RIDGE))).inverse() * mean).try_normalize().unwrap_or(first)
}

/// The rotation into axes in which up is -y and the cameras look along +z on average.
pub fn upright(cameras: &[Camera]) -> DMat3 {
    let down = -estimate(cameras);
    let level = |ahead: DVec3| ahead.reject_from_normalized(down);
    let mean = level(cameras.iter().map(|camera| axis(camera, 2)).sum::<DVec3>() / cameras.len().max(1) as f64);
    // Around a scene the views cancel: then the first camera's.
    let ahead =
        if mean.length() > 0.1 { mean } else { cameras.first().map_or(DVec3::Z, |camera| level(axis(camera, 2))) };
    let ahead = if ahead.length() > 0.01 { ahead.normalize() } else { down.any_orthonormal_vector() };
    DMat3::from_cols(down.cross(ahead), down, ahead).transpose()
}

/// The same camera in axes turned by a rotation matrix.
pub fn turn_camera(camera: &Camera, by: DMat3) -> Camera {
    let turned = |row: [f32; 3]| (by * DVec3::from_array(row.map(f64::from))).to_array().map(|v| v as f32);
    let rotation = camera.rotation.map(turned);
    let center = by * DVec3::from_array(camera.center());
    Camera { rotation, translation: Camera::translation_to(&rotation, center.to_array()), ..*camera }
}

/// Angle by which the camera is rolled out of the horizon of axes in which up is -y, in radians.
pub fn roll(camera: &Camera) -> f64 {
    let (x, y) = (axis(camera, 0), axis(camera, 1));
    x.y.atan2(y.y).abs()
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, dvec3};

    use super::*;

    /// Looks from `eye` at `at`, upright against `up`, then rolled.
    fn camera(eye: DVec3, at: DVec3, up: DVec3, roll: f64) -> Camera {
        let ahead = (at - eye).normalize();
        let right = ahead.cross(up).normalize();
        let turn = DQuat::from_axis_angle(ahead, roll);
        let row = |v: DVec3| (turn * v).to_array().map(|v| v as f32);
        let rotation = [row(right), row(ahead.cross(right)), row(ahead)];
        Camera {
            rotation,
            translation: Camera::translation_to(&rotation, eye.to_array()),
            focal: [100.0; 2],
            principal: [50.0; 2],
            distortion: [0.0; 4],
            size: [100; 2],
        }
    }

    const UP: DVec3 = DVec3::new(0.36, 0.48, 0.8);

    #[test]
    fn a_common_tilt_is_told_from_up() {
        let across = UP.any_orthonormal_vector();
        let other = UP.cross(across);
        // Everybody looks down at 40 degrees over a sector of 60, rolled by a degree or two.
        let cameras: Vec<Camera> = (-10..=10)
            .map(|i| {
                let a = f64::from(i) * 0.05;
                let eye = 3.0 * (across * a.cos() + other * a.sin()) + 2.5 * UP;
                camera(eye, DVec3::ZERO, UP, 0.03 * (f64::from(i) * 2.3).sin())
            })
            .collect();
        // Rolls of 0.02 on average over 21 views in which the x axes spread by 17 degrees: a degree.
        assert!(estimate(&cameras).angle_between(UP) < 0.02, "{}", estimate(&cameras));
        let turn = upright(&cameras);
        assert!((turn.determinant() - 1.0).abs() < 1e-12 && (turn * UP).angle_between(DVec3::NEG_Y) < 0.02);
        for camera in &cameras {
            let turned = turn_camera(camera, turn);
            assert!(axis(&turned, 2).z > 0.0, "the cameras look along +z");
            assert!(roll(&turned) < 0.06, "{}", roll(&turned));
            let p = dvec3(0.3, -0.2, 0.5);
            let (before, after) = (camera.to_camera(p.to_array()), turned.to_camera((turn * p).to_array()));
            // Float32 rotations.
            assert!((DVec3::from_array(before) - DVec3::from_array(after)).length() < 1e-5);
        }
    }

    #[test]
    fn parallel_cameras_have_their_own_up_and_none_has_a_default() {
        let cameras: Vec<Camera> = (0..5)
            .map(|i| camera(dvec3(f64::from(i), 0.0, 0.0), dvec3(f64::from(i), 9.0, 0.0), DVec3::Z, 0.0))
            .collect();
        assert!(estimate(&cameras).angle_between(DVec3::Z) < 1e-6);
        assert_eq!(estimate(&[]), DVec3::NEG_Y);
        assert!((upright(&[]) - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-12));
    }

    #[test]
    fn a_ring_of_cameras_agrees_on_its_axis() {
        let cameras: Vec<Camera> = (0..12)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / 12.0;
                camera(dvec3(3.0 * a.cos(), 3.0 * a.sin(), 2.0), DVec3::ZERO, DVec3::Z, 0.0)
            })
            .collect();
        assert!(estimate(&cameras).angle_between(DVec3::Z) < 1e-5);
        let turn = upright(&cameras);
        assert!((turn.determinant() - 1.0).abs() < 1e-6);
    }
}

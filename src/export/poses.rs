//! Where the model is looked at from: the training cameras and cameras between them.
//!
//! What an anchor's Gaussians look like depends on the direction and the distance they are seen from, so attributes taken
//! at training poses alone are those of no other pose. Between two training cameras whose views agree to 60 degrees
//! everything is interpolated: the centre on the straight line, the axes on the great circle, the lens of the first.
//!
//! Whoever turns the scene in a viewer looks past the edges of the photographs, and so do the test views of some captures.
//! What no pose sees is in no file, a hole where the anchors show something. So every other of these cameras has a wider
//! angle ([`every_other_wide`]).

use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;

use crate::scene::Camera;

/// Two cameras whose view axes differ by more than 60 degrees have little between them that either looks at.
const AGREE: f64 = 0.5;

fn axes(camera: &Camera) -> DQuat {
    let rows = camera.rotation.map(|row| DVec3::from_array(row.map(f64::from)));
    DQuat::from_mat3(&DMat3::from_cols(rows[0], rows[1], rows[2])).normalize()
}

/// The camera a share `t` of the way from `a` to `b`, with the lens and the picture of `a`.
pub fn between(a: &Camera, b: &Camera, t: f64) -> Camera {
    let axes = DMat3::from_quat(axes(a).slerp(axes(b), t));
    let row = |v: DVec3| v.to_array().map(|v| v as f32);
    let rotation = [row(axes.x_axis), row(axes.y_axis), row(axes.z_axis)];
    let [from, to] = [a, b].map(|camera| DVec3::from_array(camera.center()));
    Camera { rotation, translation: Camera::translation_to(&rotation, from.lerp(to, t).to_array()), ..*a }
}

/// `count` cameras between pairs of `cameras`, drawn at random: every camera begins as many pairs as any other, give or
/// take one. One camera alone is all there is.
pub fn virtual_views(cameras: &[Camera], count: u32, seed: u64) -> Vec<Camera> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let (n, count) = (cameras.len(), count as usize);
    let ahead = |camera: &Camera| DVec3::from_array(camera.rotation[2].map(f64::from));
    (0..if n == 0 { 0 } else { count })
        .map(|i| {
            let first = &cameras[if count < n { i * n / count } else { i % n }];
            let others: Vec<&Camera> = cameras.iter().filter(|c| ahead(c).dot(ahead(first)) > AGREE).collect();
            let second = others.get(rng.random_range(0..others.len().max(1))).copied().unwrap_or(first);
            between(first, second, rng.random_range(0.1..0.9))
        })
        .collect()
}

/// By how much the focal length of a wide camera is shorter.
const WIDER: f32 = 1.5;

/// Every other camera with a wider angle, on as many pixels. Without distortion, which beyond the photographs' edge is
/// nobody's.
pub fn every_other_wide(mut cameras: Vec<Camera>) -> Vec<Camera> {
    for camera in cameras.iter_mut().skip(1).step_by(2) {
        *camera = Camera { focal: camera.focal.map(|f| f / WIDER), distortion: [0.0; 4], ..*camera };
    }
    cameras
}

/// At most `most` of them, evenly spread.
pub fn spread<T: Clone>(all: &[T], most: usize) -> Vec<T> {
    let n = all.len().min(most);
    (0..n).map(|i| all[i * all.len() / n].clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(eye: DVec3, angle: f64) -> Camera {
        let (s, c) = angle.sin_cos();
        let rotation = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]].map(|row: [f64; 3]| row.map(|v| v as f32));
        Camera {
            rotation,
            translation: Camera::translation_to(&rotation, eye.to_array()),
            focal: [90.0; 2],
            principal: [30.0, 20.0],
            distortion: [0.02, 0.0, 0.0, 0.0],
            size: [60, 40],
        }
    }

    #[test]
    fn between_is_half_way_in_place_and_angle() {
        let (a, b) = (camera(DVec3::new(1.0, 2.0, 3.0), -0.4), camera(DVec3::new(3.0, 2.0, 1.0), 0.6));
        let half = between(&a, &b, 0.5);
        assert!((DVec3::from_array(half.center()) - DVec3::new(2.0, 2.0, 2.0)).length() < 1e-6);
        assert!(
            half.rotation
                .as_flattened()
                .iter()
                .zip(camera(DVec3::ZERO, 0.1).rotation.as_flattened())
                .all(|(a, b)| (a - b).abs() < 1e-6)
        );
        for (t, end) in [(0.0, &a), (1.0, &b)] {
            let at = between(&a, &b, t);
            assert!((DVec3::from_array(at.center()) - DVec3::from_array(end.center())).length() < 1e-6);
        }
        assert_eq!((half.size, half.distortion), (a.size, a.distortion));
    }

    #[test]
    fn views_are_between_cameras_that_agree() {
        let cameras: Vec<Camera> = (0..8).map(|i| camera(DVec3::X * f64::from(i), f64::from(i) * 0.5)).collect();
        let views = virtual_views(&cameras, 30, 7);
        assert_eq!(views.len(), 30);
        for view in &views {
            // Between neighbours in angle a camera stands where it looks: 2 units per radian.
            let angle = f64::from(-view.rotation[2][0]).atan2(f64::from(view.rotation[2][2]));
            let x = view.center()[0];
            let turns = (x / 2.0 - angle) / std::f64::consts::TAU;
            assert!((turns - turns.round()).abs() < 1e-5, "{x} {angle}");
        }
        assert_eq!(views, virtual_views(&cameras, 30, 7));
        assert!(virtual_views(&[], 5, 1).is_empty());
        let alone = virtual_views(&cameras[..1], 2, 1);
        assert!((DVec3::from_array(alone[1].center()) - DVec3::from_array(cameras[0].center())).length() < 1e-6);
    }

    #[test]
    fn wide_cameras_see_what_lies_beyond_the_edge() {
        let all = every_other_wide(vec![camera(DVec3::ZERO, 0.0); 3]);
        assert_eq!((all[0], all[2]), (camera(DVec3::ZERO, 0.0), all[0]));
        // A direction on the right edge of the picture of 60 px, at 30 px from the centre, is at 20.
        assert_eq!((all[1].focal, all[1].principal, all[1].size), ([60.0; 2], all[0].principal, all[0].size));
        assert_eq!(all[1].distortion, [0.0; 4]);
    }

    #[test]
    fn spreading_keeps_the_first_and_the_number() {
        assert_eq!(spread(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9], 4), [0, 2, 5, 7]);
        assert_eq!(spread(&[1, 2], 9), [1, 2]);
        assert!(spread::<u8>(&[], 3).is_empty());
    }
}

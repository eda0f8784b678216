//! Gaussians as wide as the pixels they were trained with.
//!
//! As [`crate::render::widen`], once and for all: a file's Gaussians are the same at every distance.

use super::Cloud;
use crate::render::widen::variance;
use crate::scene::Camera;

/// Widens all Gaussians for pictures `larger` times as large as those of the `cameras`, which are in the cloud's axes. A
/// pixel's size at a Gaussian is the mean over the cameras whose picture it lies in, of its square. Those trained for
/// antialiasing stay: they are as wide as they are to be.
pub fn widen(cloud: &mut Cloud, cameras: &[Camera], larger: f64) {
    let variance = variance(larger.min(LARGEST));
    if variance == 0.0 || cloud.antialiased {
        return;
    }
    for (position, log_scale) in cloud.position.iter().zip(&mut cloud.log_scale) {
        let added = variance * pixel_area(cameras, position.map(f64::from));
        for scale in log_scale {
            *scale = (0.5 * ((2.0 * f64::from(*scale)).exp() + added).ln()) as f32;
        }
    }
}

/// Mean area of a pixel at a point, scene units squared; of the cameras before which it lies where it is in no picture, and
/// 0 where it lies before none.
fn pixel_area(cameras: &[Camera], point: [f64; 3]) -> f64 {
    let (mut seen, mut before) = ([0.0, 0.0], [0.0, 0.0]);
    for camera in cameras {
        let z = camera.to_camera(point)[2];
        if z <= 0.0 {
            continue;
        }
        let area = z * z / (f64::from(camera.focal[0]) * f64::from(camera.focal[1]));
        let [w, h] = camera.size.map(f64::from);
        before = [before[0] + area, before[1] + 1.0];
        if camera.project(point).is_some_and(|[x, y]| x >= 0.0 && y >= 0.0 && x <= w && y <= h) {
            seen = [seen[0] + area, seen[1] + 1.0];
        }
    }
    match (seen, before) {
        ([sum, count], _) | ([_, _], [sum, count]) if count > 0.0 => sum / count,
        _ => 0.0,
    }
}

/// Pictures that are larger still are not told apart: the viewer's own low-pass is next to nothing there, and the file is
/// right where it is measured.
const LARGEST: f64 = 4.0;

/// How many times larger a picture is drawn to be measured, for one that will be looked at `larger` times as large.
pub fn measured(larger: f64) -> u32 {
    larger.min(LARGEST).round().max(1.0) as u32
}

/// Means over squares of `times` by `times` pixels of a picture that is `size` (width, height) pixels large.
pub fn reduced(rgb: &[[f32; 3]], size: [u32; 2], times: u32) -> Vec<[f32; 3]> {
    let [width, times] = [size[0] as usize, times as usize];
    let [w, h] = size.map(|n| n as usize / times);
    let mean = |i: usize| {
        let (x, y) = (i % w * times, i / w * times);
        let square = (y..y + times).flat_map(|v| (x..x + times).map(move |u| rgb[v * width + u]));
        let sum = square.fold([0.0; 3], |sum: [f32; 3], p| std::array::from_fn(|c| sum[c] + p[c]));
        sum.map(|v| v / (times * times) as f32)
    };
    (0..w * h).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::camera::DILATION;

    fn camera() -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [50.0, 50.0],
            principal: [50.0, 40.0],
            distortion: [0.0; 4],
            size: [100, 80],
        }
    }

    #[test]
    fn pictures_as_large_as_the_trainings_need_nothing() {
        let before = crate::export::tests::cloud(20, 0);
        let mut after = before.clone();
        widen(&mut after, &[camera()], 1.0);
        assert_eq!(before, after);
    }

    /// What a viewer draws `k` times as large, its own low-pass included, is as wide as what was trained
    /// with but for a part of a pixel's square, in pixels of the training.
    #[test]
    fn a_needle_is_as_wide_as_it_was_trained() {
        let k = 4.0;
        let mut cloud = crate::export::tests::cloud(1, 0);
        cloud.position[0] = [0.3, -0.2, 10.0];
        cloud.log_scale[0] = [-30.0, -30.0, 0.0];
        widen(&mut cloud, &[camera()], k);
        // A pixel is a fifth of a unit wide there.
        let in_pixels = (2.0 * f64::from(cloud.log_scale[0][0])).exp() * 25.0;
        let seen = in_pixels + DILATION / (k * k);
        assert!((seen - DILATION).abs() < 0.05, "{seen}");
        assert!((f64::from(cloud.log_scale[0][2])).abs() < 0.01, "what is wide already hardly changes");
    }

    #[test]
    fn a_pixels_size_is_the_mean_of_those_who_see_it() {
        let near = Camera { translation: [0.0, 0.0, -5.0], ..camera() };
        let aside = Camera { translation: [1000.0, 0.0, 0.0], ..camera() };
        let point = [0.0, 0.0, 10.0];
        assert!((pixel_area(&[camera(), near, aside], point) - (0.04 + 0.01) / 2.0).abs() < 1e-9);
        assert!((pixel_area(&[aside], point) - 0.04).abs() < 1e-9, "before it, but in no picture");
        assert_eq!(pixel_area(&[camera()], [0.0, 0.0, -1.0]), 0.0);
    }

    #[test]
    fn a_larger_picture_is_reduced_to_its_means() {
        let ramp: Vec<[f32; 3]> = (0..6 * 4).map(|i| [(i % 6) as f32, (i / 6) as f32, 1.0]).collect();
        let small = reduced(&ramp, [6, 4], 2);
        assert_eq!((small.len(), small[0], small[5]), (6, [0.5, 0.5, 1.0], [4.5, 2.5, 1.0]));
    }
}

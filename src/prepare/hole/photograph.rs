//! A photograph, and the colour at a place between its pixels.

use glam::DVec3;
use image::{GrayImage, RgbImage};

use crate::scene::Camera;

/// A photograph that colours are taken from.
pub struct Photograph<'a> {
    /// The camera, at the picture's size.
    pub camera: Camera,
    /// The colours that it shows.
    pub picture: &'a RgbImage,
    /// The object with a margin, as large as the picture.
    pub hole: GrayImage,
}

/// Cubic, 0 to 1, along the border of the picture bilinear; nothing within half a pixel of it and outside.
pub fn sample(at: impl Fn(usize, usize) -> [f32; 3], size: [u32; 2], position: [f64; 2]) -> Option<[f32; 3]> {
    let inside = (0..2).all(|a| position[a] >= 0.5 && position[a] <= f64::from(size[a]) - 0.5);
    let [w, h] = size.map(i64::from);
    let color = |x: i64, y: i64| (inside && x >= 0 && y >= 0 && x < w && y < h).then(|| at(x as usize, y as usize));
    between(color, position)
}

/// Weights of four pixels in a row around a place so far behind the second one's middle (Catmull and Rom 1974).
fn weights(t: f64) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    let four = [t2 - 0.5 * (t + t3), 1.0 - 2.5 * t2 + 1.5 * t3, 0.5 * t + 2.0 * t2 - 1.5 * t3, 0.5 * (t3 - t2)];
    four.map(|v| v as f32)
}

/// Cubic between the pixels around a place, which keeps the grain of stone that linear weights smooth away; nothing where one of the
/// sixteen has no colour.
fn cubic(at: &impl Fn(i64, i64) -> Option<[f32; 3]>, [x, y]: [f64; 2]) -> Option<[f32; 3]> {
    let (left, top) = ((x - 0.5).floor(), (y - 0.5).floor());
    let (across, down) = (weights(x - 0.5 - left), weights(y - 0.5 - top));
    let mut sum = [0f32; 3];
    for (row, down) in (top as i64 - 1..).zip(down) {
        for (column, across) in (left as i64 - 1..).zip(across) {
            let color = at(column, row)?;
            (0..3).for_each(|c| sum[c] += across * down * color[c]);
        }
    }
    Some(sum.map(|v| v.clamp(0.0, 1.0)))
}

/// Cubic between the pixels around a place, bilinear between those that have a colour where some have none; nothing where the nearest
/// has none.
pub fn between(at: impl Fn(i64, i64) -> Option<[f32; 3]>, [x, y]: [f64; 2]) -> Option<[f32; 3]> {
    at(x.floor() as i64, y.floor() as i64)?;
    if let Some(color) = cubic(&at, [x, y]) {
        return Some(color);
    }
    let (mut sum, mut total) = ([0f32; 3], 0f32);
    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
        let (u, v) = ((x - 0.5).floor() + dx, (y - 0.5).floor() + dy);
        let Some(color) = at(u as i64, v as i64) else { continue };
        let weight = ((1.0 - (x - 0.5 - u).abs()) * (1.0 - (y - 0.5 - v).abs())) as f32;
        (0..3).for_each(|c| sum[c] += weight * color[c]);
        total += weight;
    }
    (total > 0.0).then(|| sum.map(|v| v / total))
}

impl Photograph<'_> {
    /// The colour, 0 to 1, where it shows a point; nothing outside the picture, and where the object is.
    pub fn color(&self, point: DVec3) -> Option<[f32; 3]> {
        let pixel = self.camera.project(point.to_array())?;
        if !(pixel[0] >= 0.5 && pixel[1] >= 0.5) {
            return None;
        }
        let covered = self.hole.get_pixel_checked(pixel[0] as u32, pixel[1] as u32)?.0[0] != 0;
        let at = |x: usize, y: usize| self.picture.get_pixel(x as u32, y as u32).0.map(|v| f32::from(v) / 255.0);
        if covered { None } else { sample(at, self.camera.size, pixel) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Next to a pixel without a colour the others' count alone, and nothing of it is mixed in.
    #[test]
    fn what_has_no_colour_is_not_mixed_in() {
        let at = |x: i64, _: i64| (x < 3).then_some([0.25, 0.5, 0.75]);
        for x in [1.5, 2.5, 2.999] {
            assert_eq!(between(at, [x, 4.2]), Some([0.25, 0.5, 0.75]));
        }
        assert_eq!(between(at, [3.001, 4.2]), None);
        let ramp = |x: i64, y: i64| Some([x as f32 / 16.0, y as f32 / 16.0, 0.0]);
        let found = between(ramp, [2.0, 3.75]).expect("a colour").map(|v| 16.0 * v);
        assert!((found[0] - 1.5).abs() < 1e-5 && (found[1] - 3.25).abs() < 1e-5, "{found:?}");
    }

    /// Cubic weights leave 0.58 of the variance of single pixels, in the mean over all places, linear ones 0.44.
    #[test]
    fn grain_is_kept() {
        let grain = |x: i64, y: i64| 0.5 + 0.2 * ((x * 7919 + y * 104_729).rem_euclid(97) as f32 / 97.0 - 0.5);
        let places = || (0..4000).map(|i| [8.0 + f64::from(i) * 0.37, 9.0 + f64::from(i % 61) * 0.73]);
        let variance = |values: Vec<f32>| {
            let mean = values.iter().sum::<f32>() / values.len() as f32;
            values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / values.len() as f32
        };
        let whole = variance(places().map(|[x, y]| grain(x as i64, y as i64)).collect());
        let cubic = |at| between(|x, y| Some([grain(x, y); 3]), at).expect("a colour")[0];
        let left = variance(places().map(cubic).collect());
        assert!(left > 0.52 * whole && left < whole, "{left} of {whole}");
    }
}

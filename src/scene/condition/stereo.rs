//! Depth of a reference that shows the truth, by a plane sweep over the other views without the object.
//!
//! A test view that is trained on as the reference ([`Config::truth_reference`](crate::scene::Config::truth_reference)) has
//! no monocular prior, as a reference of the user's has. The other test views show the same place, so that depth can be
//! measured: fronto-parallel planes of evenly spaced inverse depth, and for each pixel the one at which the pictures agree
//! (Collins 1996), over a window in which pixels of other colours count less, so that depth breaks where surfaces do (Yoon
//! and Kweon 2006). Nothing else of the test views reaches training.

use image::RgbImage;
use rayon::prelude::*;

use super::sparse::samples;
use crate::scene::{Camera, Prior, PriorKind, Scene};

/// Planes of the sweep.
const PLANES: usize = 128;
/// Colours further apart than this (8-bit, mean over channels) count as this far: something else is in the way.
const FARTHEST_COLOR: f32 = 64.0;
/// Half the side of the window over which the differences to one view are averaged, pixels.
const HALF_WINDOW: usize = 1;
/// Half the side of the window over which a plane's costs are averaged, pixels.
const SUPPORT: usize = 5;
/// A pixel of that window weighs 1/e at this colour difference (8-bit, mean over channels) ...
const SUPPORT_COLOR: f32 = 10.0;
/// ... and at this distance, pixels.
const SUPPORT_DISTANCE: f32 = 5.0;
/// Fewest other views that a plane must be seen by.
const FEWEST_VIEWS: usize = 3;

/// Gives the reference a prior of measured depth, in place of any it has. NaN where fewer than three test views see the
/// pixel.
pub(super) fn measure_prior(scene: &mut Scene) {
    let Some(reference) = scene.references.first() else { return };
    let view = &scene.train[reference.view];
    let seen = samples(&view.camera, &scene.points, None);
    if seen.is_empty() || scene.test.len() < FEWEST_VIEWS {
        scene.notes.push(format!(
            "reference {}: its depth is not measured, for there are fewer than {FEWEST_VIEWS} other test views",
            view.name
        ));
        return;
    }
    let (near, far) = seen.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(s.depth), b.max(s.depth)));
    let others: Vec<(&Camera, &RgbImage)> = scene.test.iter().map(|v| (&v.camera, &v.image)).collect();
    let values = sweep(&view.camera, &reference.image, &others, [0.9 * near, 1.1 * far]);
    let name = view.name.clone();
    scene.references[0].prior = Some(Prior { kind: PriorKind::Depth, values });
    scene.notes.push(format!("reference {name}: its depth is measured by stereo over the other test views"));
}

/// Depth z at which each pixel of a picture agrees best with the others, `[row-major pixel]`.
fn sweep(camera: &Camera, picture: &RgbImage, others: &[(&Camera, &RgbImage)], [near, far]: [f64; 2]) -> Vec<f32> {
    let [w, h] = camera.size.map(|n| n as usize);
    let inverse = |plane: usize| {
        let t = plane as f64 / (PLANES - 1) as f64;
        (1.0 - t) / near + t / far
    };
    // Of the views that see a plane, those that agree best: an occluder stands in the way of the others.
    let kept = (others.len() * 2).div_ceil(3).max(FEWEST_VIEWS);
    let cost = |plane: usize| -> Vec<f32> {
        let z = 1.0 / inverse(plane);
        let at = |pixel: usize| camera.lift(camera.pixel_center(pixel), z);
        let places: Vec<Option<[f64; 3]>> = (0..w * h).map(at).collect();
        let mut costs: Vec<Vec<f32>> = vec![];
        for (other, image) in others {
            let difference = |pixel: usize| {
                let there = places[pixel].and_then(|p| other.project(p)).and_then(|p| bilinear(image, p));
                there.map_or(f32::NAN, |there| {
                    let here = picture.as_raw()[3 * pixel..3 * pixel + 3].iter();
                    let apart: f32 = here.zip(there).map(|(a, b)| (f32::from(*a) - b).abs()).sum::<f32>() / 3.0;
                    apart.min(FARTHEST_COLOR)
                })
            };
            let raw: Vec<f32> = (0..w * h).map(difference).collect();
            costs.push(window_mean(&raw, w, h));
        }
        let mut here = vec![];
        (0..w * h)
            .map(|pixel| {
                here.clear();
                here.extend(costs.iter().map(|c| c[pixel]).filter(|c| c.is_finite()));
                if here.len() < FEWEST_VIEWS {
                    return f32::NAN;
                }
                here.sort_unstable_by(f32::total_cmp);
                let best = &here[..kept.min(here.len())];
                best.iter().sum::<f32>() / best.len() as f32
            })
            .collect()
    };
    let volume: Vec<Vec<f32>> = (0..PLANES).into_par_iter().map(cost).collect();
    let depth = |pixel: usize| {
        let costs = supported(&volume, picture, pixel);
        let at = |plane: usize| f64::from(costs[plane]);
        let best = (0..PLANES).filter(|p| at(*p).is_finite()).min_by(|a, b| at(*a).total_cmp(&at(*b)));
        let Some(best) = best else { return f32::NAN };
        // The vertex of the parabola through the best plane and its neighbours.
        let between = (best > 0 && best + 1 < PLANES)
            .then(|| {
                let [a, b, c] = [at(best - 1), at(best), at(best + 1)];
                (0.5 * (a - c) / (a - 2.0 * b + c)).clamp(-0.5, 0.5)
            })
            .filter(|d| d.is_finite())
            .unwrap_or(0.0);
        let step = inverse(1) - inverse(0);
        (1.0 / (inverse(best) + between * step)) as f32
    };
    (0..w * h).into_par_iter().map(depth).collect()
}

/// The costs of all planes at a pixel, averaged over what is near it and of its colour; NaN where its own is.
fn supported(volume: &[Vec<f32>], picture: &RgbImage, pixel: usize) -> Vec<f32> {
    let [w, h] = [picture.width() as usize, picture.height() as usize];
    let (x, y) = (pixel % w, pixel / w);
    let color = |pixel: usize| &picture.as_raw()[3 * pixel..3 * pixel + 3];
    let mut support = vec![];
    for v in y.saturating_sub(SUPPORT)..(y + SUPPORT + 1).min(h) {
        for u in x.saturating_sub(SUPPORT)..(x + SUPPORT + 1).min(w) {
            let apart = color(pixel).iter().zip(color(v * w + u)).map(|(a, b)| f32::from(a.abs_diff(*b))).sum::<f32>();
            let distance = (x.abs_diff(u) as f32).hypot(y.abs_diff(v) as f32);
            support.push((v * w + u, (-apart / 3.0 / SUPPORT_COLOR - distance / SUPPORT_DISTANCE).exp()));
        }
    }
    let mean = |costs: &Vec<f32>| {
        if costs[pixel].is_nan() {
            return f32::NAN;
        }
        let finite = support.iter().filter(|(at, _)| costs[*at].is_finite());
        let [sum, weight] = finite.fold([0.0; 2], |[s, n], (at, w)| [s + w * costs[*at], n + w]);
        sum / weight
    };
    volume.iter().map(mean).collect()
}

/// The picture at a place in pixels, between the four pixels around it; `None` outside their centres.
fn bilinear(image: &RgbImage, [u, v]: [f64; 2]) -> Option<[f32; 3]> {
    let (x, y) = (u - 0.5, v - 0.5);
    let (w, h) = (image.width() as usize, image.height() as usize);
    if !(x >= 0.0 && y >= 0.0 && x < (w - 1) as f64 && y < (h - 1) as f64) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (a, b) = ((x - left as f64) as f32, (y - top as f64) as f32);
    let at = |x: usize, y: usize, c: usize| f32::from(image.as_raw()[3 * (y * w + x) + c]);
    Some(std::array::from_fn(|c| {
        let upper = (1.0 - a) * at(left, top, c) + a * at(left + 1, top, c);
        let lower = (1.0 - a) * at(left, top + 1, c) + a * at(left + 1, top + 1, c);
        (1.0 - b) * upper + b * lower
    }))
}

/// Mean over the window around each pixel of what is a number; NaN where the pixel is not.
fn window_mean(values: &[f32], w: usize, h: usize) -> Vec<f32> {
    // Rows, then columns; sums and counts beside each other.
    let along = |input: &[[f32; 2]], length: usize, stride: usize, pixel: usize| {
        let place = pixel / stride % length;
        let first = place.saturating_sub(HALF_WINDOW);
        let last = (place + HALF_WINDOW).min(length - 1);
        (first..=last).fold([0.0; 2], |[s, n], k| {
            let [a, b] = input[pixel - place * stride + k * stride];
            [s + a, n + b]
        })
    };
    let counted: Vec<[f32; 2]> = values.iter().map(|v| if v.is_finite() { [*v, 1.0] } else { [0.0; 2] }).collect();
    let rows: Vec<[f32; 2]> = (0..w * h).map(|pixel| along(&counted, w, 1, pixel)).collect();
    let mean = |pixel: usize| {
        let [sum, count] = along(&rows, h, w, pixel);
        if values[pixel].is_finite() { sum / count } else { f32::NAN }
    };
    (0..w * h).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load, synthetic};

    /// The built-in scene's test views have exact depth.
    #[test]
    fn the_sweep_finds_the_depth_of_the_built_in_scene() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let read = load(&dir, &Config::default()).expect("it loads");
        let (name, exact) = (read.test[2].name.clone(), read.test[2].depth.clone().expect("exact depth"));
        let config = Config { truth_reference: name, truth_prior: "stereo".into(), ..Config::default() };
        let mut scene = load(&dir, &config).expect("it loads");
        assert!(scene.references[0].prior.is_none());
        measure_prior(&mut scene);
        let prior = scene.references[0].prior.as_ref().expect("a prior");
        let view = &scene.train[scene.references[0].view];
        let mask = view.mask.as_ref().expect("a mask");
        let hole = || mask.as_raw().iter().enumerate().filter(|(_, m)| **m != 0).map(|(i, _)| i);
        let mut errors: Vec<f32> =
            hole().filter(|i| prior.values[*i].is_finite()).map(|i| (prior.values[i] / exact[i] - 1.0).abs()).collect();
        assert!(errors.len() * 10 > hole().count() * 9, "{} of {}", errors.len(), hole().count());
        errors.sort_by(f32::total_cmp);
        // A plane's distance to the next one is 1/128 of the range of inverse depths, which is about one inverse depth: the
        // median stays within a plane or two.
        assert!(errors[errors.len() / 2] < 0.02, "{}", errors[errors.len() / 2]);
    }

    #[test]
    fn windows_leave_out_what_is_not_a_number() {
        let mut values = vec![1.0; 30];
        values[7] = f32::NAN;
        values[8] = 4.0;
        let mean = window_mean(&values, 6, 5);
        assert!(mean[7].is_nan());
        // Columns and rows 0 and 1: four values, of which one is none.
        assert_eq!(mean[0], 1.0);
        assert_eq!(mean[2], (4.0 + 4.0) / 5.0);
        assert_eq!(mean[29], 1.0);
    }
}

//! Which photographs are brighter or darker than the others, by what they show of the same points.
//!
//! The means of photographs say nothing: they look at different things. Two cameras that stand near each other and look the
//! same way show the same points, and where most of the points differ by the same ratio, it is that of the exposures: what
//! is hidden in one of them differs by anything. The exposure of each photograph follows from those around it that agree.

use rayon::prelude::*;

use super::luminance;
use crate::scene::{Camera, Scene, View};

/// Points that are looked at, at most.
const POINTS: usize = 20_000;
/// Cameras that each is compared with.
const NEIGHBOURS: usize = 6;
/// Points that two photographs have to share to be compared.
const LEAST_SHARED: usize = 30;
/// Luminance within which a sensor follows the light, levels of 255.
const LINEAR: std::ops::Range<f64> = 16.0..240.0;
/// Cosine between the directions of two cameras that are compared, at least: 45 degrees.
const SAME_WAY: f64 = 0.7;
/// Logarithms of ratios this far apart are the same.
const SAME_RATIO: f64 = 0.06;
/// Part of the shared points that have to have the same ratio.
const LEAST_AGREEING: f64 = 0.4;
/// Photographs around one that have to make the same of it.
const LEAST_WITNESSES: usize = 2;
/// Rounds in which every photograph takes the median of what those around it make of it.
const ROUNDS: usize = 100;

/// `[point]` the logarithm of the mean luminance around it; NaN where the view does not show it.
fn samples(view: &View, points: &[[f64; 3]]) -> Vec<f64> {
    let [w, h] = view.camera.size.map(|n| n as usize);
    let raw = view.image.as_raw();
    let at = |x: usize, y: usize| {
        let i = 3 * (y * w + x);
        luminance([raw[i], raw[i + 1], raw[i + 2]])
    };
    let sample = |point: &[f64; 3]| {
        let [u, v] = view.camera.project(*point)?;
        if !(u >= 1.0 && v >= 1.0 && u < w as f64 - 1.0 && v < h as f64 - 1.0) {
            return None;
        }
        let (x, y) = (u as usize, v as usize);
        if view.mask.as_ref().is_some_and(|mask| mask.as_raw()[y * w + x] != 0) {
            return None;
        }
        let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y)));
        let mean = around.map(|(x, y)| at(x, y)).sum::<f64>() / 9.0;
        LINEAR.contains(&mean).then(|| mean.ln())
    };
    points.iter().map(|point| sample(point).unwrap_or(f64::NAN)).collect()
}

/// The cameras nearest to each that look the same way.
fn neighbours(cameras: &[&Camera]) -> Vec<Vec<usize>> {
    let centers: Vec<[f64; 3]> = cameras.iter().map(|camera| camera.center()).collect();
    let of = |i: usize| {
        let axis = |k: usize| cameras[k].rotation[2].map(f64::from);
        let cosine = |k: usize| (0..3).map(|c| axis(i)[c] * axis(k)[c]).sum::<f64>();
        let distance = |k: usize| (0..3).map(|c| (centers[i][c] - centers[k][c]).powi(2)).sum::<f64>();
        let mut others: Vec<usize> = (0..cameras.len()).filter(|k| *k != i && cosine(*k) >= SAME_WAY).collect();
        others.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
        others.truncate(NEIGHBOURS);
        others
    };
    (0..cameras.len()).into_par_iter().map(of).collect()
}

/// The brightness of every train photograph over that of most, by the points; nothing where too few are shared.
pub(super) fn exposures(scene: &Scene) -> Vec<Option<f64>> {
    let every = scene.points.len().div_ceil(POINTS).max(1);
    let points: Vec<[f64; 3]> = scene.points.iter().step_by(every).map(|p| p.position.map(f64::from)).collect();
    let samples: Vec<Vec<f64>> = scene.train.par_iter().map(|view| samples(view, &points)).collect();
    let cameras: Vec<&Camera> = scene.train.iter().map(|view| &view.camera).collect();
    let near = neighbours(&cameras);
    let ratio = |i: usize, k: usize| {
        let both = samples[i].iter().zip(&samples[k]).map(|(a, b)| a - b).filter(|d| d.is_finite());
        let mut both: Vec<f64> = both.collect();
        if both.len() < LEAST_SHARED { None } else { most_common(&mut both) }
    };
    // Both ways: whoever is compared with a camera is what that one is compared with, too.
    let pairs = near.iter().enumerate().flat_map(|(i, near)| near.iter().map(move |k| (i.min(*k), i.max(*k))));
    let pairs: std::collections::BTreeSet<(usize, usize)> = pairs.collect();
    let ratios: Vec<(usize, usize, f64)> =
        pairs.into_par_iter().filter_map(|(i, k)| Some((i, k, ratio(i, k)?))).collect();
    let mut edges: Vec<Vec<(usize, f64)>> = vec![vec![]; cameras.len()];
    for (i, k, ratio) in ratios {
        edges[i].push((k, ratio));
        edges[k].push((i, -ratio));
    }
    let mut logs = vec![0.0; cameras.len()];
    for _ in 0..ROUNDS {
        for (i, edges) in edges.iter().enumerate() {
            let mut told: Vec<f64> = edges.iter().map(|(k, ratio)| logs[*k] + ratio).collect();
            logs[i] = super::median(&mut told).unwrap_or(0.0);
        }
    }
    let agrees = |i: usize, (k, ratio): &(usize, f64)| (logs[*k] + ratio - logs[i]).abs() <= SAME_RATIO / 2.0;
    let known = |i: &usize| {
        let witnesses = edges[*i].iter().filter(|edge| agrees(*i, edge)).count();
        witnesses >= LEAST_WITNESSES && 2 * witnesses > edges[*i].len()
    };
    let mut all: Vec<f64> = (0..logs.len()).filter(known).map(|i| logs[i]).collect();
    let usual = super::median(&mut all).unwrap_or(0.0);
    (0..logs.len()).map(|i| known(&i).then(|| (logs[i] - usual).exp())).collect()
}

/// The middle of the narrow range that most of the values lie in, if it holds enough of them.
fn most_common(values: &mut [f64]) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let reach = |from: usize| from + values[from..].partition_point(|v| *v <= values[from] + SAME_RATIO);
    let (from, to) = (0..values.len()).map(|from| (from, reach(from))).max_by_key(|(from, to)| to - from)?;
    let enough = (to - from) as f64 >= LEAST_AGREEING * values.len() as f64;
    enough.then(|| values[(from + to - 1) / 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_common_ratio_is_found_among_others() {
        let clear = (0..60).map(|i| 0.3 + 0.0005 * f64::from(i));
        let mut mixed: Vec<f64> = clear.clone().chain((0..70).map(|i| -2.0 + 0.06 * f64::from(i))).collect();
        let found = most_common(&mut mixed).expect("nearly half agree");
        assert!((found - 0.315).abs() < 0.02, "{found}");
        let mut spread: Vec<f64> = (0..100).map(|i| 0.02 * f64::from(i)).collect();
        assert_eq!(most_common(&mut spread), None);
        assert_eq!(most_common(&mut []), None);
    }
}

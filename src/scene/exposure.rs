//! The photographs' exposure and white balance, by what they show of the same points.
//!
//! The means of photographs say nothing: they look at different things. Two cameras that stand near each other and look the
//! same way show the same points, and where most of the points differ by the same ratio, it is that of the exposures: what
//! is hidden in one of them differs by anything. The gains of all photographs follow from the ratios of neighbours by
//! robust least squares on their logarithms, as the gain compensation of panoramas does it (Brown and Lowe 2007). A camera's
//! response is close to a power of the light, so that a factor of the light is a factor of the stored values.
//!
//! [`even_out`] divides the gains out, so that training sees one exposure. The mean of their logarithms over the photographs is
//! held at 0: the model has no tint of its own.

use rayon::prelude::*;

use super::{Camera, Scene, View};
use crate::statistics::median;

/// Points that are looked at, at most.
const POINTS: usize = 20_000;
/// Cameras that each is compared with.
const NEIGHBOURS: usize = 6;
/// Points that two photographs have to share to be compared.
const LEAST_SHARED: usize = 30;
/// Values within which a sensor follows the light, levels of 255.
const LINEAR: std::ops::Range<f64> = 16.0..240.0;
/// Cosine between the directions of two cameras that are compared, at least: 45 degrees.
const SAME_WAY: f64 = 0.7;
/// Logarithms of ratios this far apart are the same.
const SAME_RATIO: f64 = 0.06;
/// Part of the shared points that have to have the same ratio: of ratios spread over a factor of two it would be a tenth.
const LEAST_AGREEING: f64 = 0.2;
/// Photographs around one that have to make the same of it.
const LEAST_WITNESSES: usize = 2;
/// Rounds of reweighted least squares; in each the ratios that do not fit count less.
const ROUNDS: usize = 12;
/// Part of the photographs whose exposure has to be known for it to be evened out.
const LEAST_KNOWN: f64 = 0.5;
/// Root mean square of the logarithms of the gains from which on it pays to even them out: the ratios themselves are this
/// exact where exposure was fixed.
const LEAST_SPREAD: f64 = 0.015;

/// A photograph's exposure over that of most.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exposure {
    /// Ratio of luminances.
    pub luminance: f64,
    /// Ratio of red, green and blue.
    pub channels: [f64; 3],
}

fn luminance(color: [f64; 3]) -> f64 {
    0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
}

/// Logarithms of luminance, red, green and blue; NaN where they are not known.
type Sample = [f64; 4];

/// `[point]` the means around it; not known where the view does not show it.
fn samples(view: &View, points: &[[f64; 3]]) -> Vec<Sample> {
    let [w, h] = view.camera.size.map(|n| n as usize);
    let raw = view.image.as_raw();
    let sample = |point: &[f64; 3]| {
        let [u, v] = view.camera.project(*point)?;
        if !(u >= 1.0 && v >= 1.0 && u < w as f64 - 1.0 && v < h as f64 - 1.0) {
            return None;
        }
        let (x, y) = (u as usize, v as usize);
        if view.mask.as_ref().is_some_and(|mask| mask.as_raw()[y * w + x] != 0) {
            return None;
        }
        let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| 3 * (y * w + x)));
        let mut mean = [0.0; 3];
        for i in around {
            (0..3).for_each(|c| mean[c] += f64::from(raw[i + c]) / 9.0);
        }
        let log = |value: f64| if LINEAR.contains(&value) { value.ln() } else { f64::NAN };
        Some([log(luminance(mean)), log(mean[0]), log(mean[1]), log(mean[2])])
    };
    points.iter().map(|point| sample(point).unwrap_or([f64::NAN; 4])).collect()
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

/// Two photographs and the logarithm of the ratio of the first to the second.
type Edge = (usize, usize, f64);

/// Logarithms of luminance and of the channels of one photograph over another's, where enough of the shared points agree on
/// the luminance. A channel that is too dark or too bright to be compared follows the luminance.
fn ratios(one: &[Sample], other: &[Sample]) -> Option<Sample> {
    let both = || one.iter().zip(other).filter(|(a, b)| (a[0] - b[0]).is_finite());
    let mut all: Vec<f64> = both().map(|(a, b)| a[0] - b[0]).collect();
    let [from, to] = if all.len() < LEAST_SHARED { None } else { most_common(&mut all) }?;
    let of = |channel: usize| {
        let agreeing = both().filter(|(a, b)| (from..=to).contains(&(a[0] - b[0])));
        let values: Vec<f64> = agreeing.map(|(a, b)| a[channel] - b[channel]).filter(|v| v.is_finite()).collect();
        median(values.iter().copied()).filter(|_| 2 * values.len() >= LEAST_SHARED)
    };
    let luminance = of(0)?;
    Some([luminance, of(1).unwrap_or(luminance), of(2).unwrap_or(luminance), of(3).unwrap_or(luminance)])
}

/// The exposure of every train photograph over that of most, by the points; nothing where too few are shared.
pub(super) fn exposures(scene: &Scene) -> Vec<Option<Exposure>> {
    let every = scene.points.len().div_ceil(POINTS).max(1);
    let points: Vec<[f64; 3]> = scene.points.iter().step_by(every).map(|p| p.position.map(f64::from)).collect();
    let samples: Vec<Vec<Sample>> = scene.train.par_iter().map(|view| samples(view, &points)).collect();
    let cameras: Vec<&Camera> = scene.train.iter().map(|view| &view.camera).collect();
    let near = neighbours(&cameras);
    // Both ways: whoever is compared with a camera is what that one is compared with, too.
    let pairs = near.iter().enumerate().flat_map(|(i, near)| near.iter().map(move |k| (i.min(*k), i.max(*k))));
    let pairs: std::collections::BTreeSet<(usize, usize)> = pairs.collect();
    let compare = |(i, k): (usize, usize)| Some((i, k, ratios(&samples[i], &samples[k])?));
    let found: Vec<(usize, usize, Sample)> = pairs.into_par_iter().filter_map(compare).collect();
    let solved: [Vec<f64>; 4] = std::array::from_fn(|c| {
        let edges: Vec<Edge> = found.iter().map(|(i, k, ratios)| (*i, *k, ratios[c])).collect();
        robust(cameras.len(), &edges)
    });
    let mut witnesses = vec![[0; 2]; cameras.len()];
    for (i, k, ratios) in &found {
        let agree = usize::from((solved[0][*i] - solved[0][*k] - ratios[0]).abs() <= SAME_RATIO / 2.0);
        for end in [*i, *k] {
            witnesses[end] = [witnesses[end][0] + 1, witnesses[end][1] + agree];
        }
    }
    let known = |i: &usize| witnesses[*i][1] >= LEAST_WITNESSES && 2 * witnesses[*i][1] > witnesses[*i][0];
    let usual: [f64; 4] =
        std::array::from_fn(|c| median((0..cameras.len()).filter(known).map(|i| solved[c][i])).unwrap_or(0.0));
    let of = |i: usize| {
        let [luminance, r, g, b] = std::array::from_fn(|c| (solved[c][i] - usual[c]).exp());
        known(&i).then_some(Exposure { luminance, channels: [r, g, b] })
    };
    (0..cameras.len()).map(of).collect()
}

/// The values whose differences are nearest to those of the edges: least squares whose weights are Cauchy's, of the width
/// [`SAME_RATIO`]. A photograph without edges is at 0.
fn robust(count: usize, edges: &[Edge]) -> Vec<f64> {
    let mut values = vec![0.0; count];
    let mut weights = vec![1.0; edges.len()];
    for _ in 0..ROUNDS {
        values = least_squares(&values, edges, &weights);
        for (weight, (i, k, ratio)) in weights.iter_mut().zip(edges) {
            *weight = 1.0 / (1.0 + ((values[*i] - values[*k] - ratio) / SAME_RATIO).powi(2));
        }
    }
    values
}

/// Conjugate gradients on the normal equations of `values[i] - values[k] = ratio`, with a weight too small to matter that
/// holds each connected part near 0.
fn least_squares(start: &[f64], edges: &[Edge], weights: &[f64]) -> Vec<f64> {
    const HOLD: f64 = 1e-6;
    const ITERATIONS: usize = 1000;
    const CONVERGED: f64 = 1e-14;
    let apply = |x: &[f64]| {
        let mut product: Vec<f64> = x.iter().map(|x| HOLD * x).collect();
        for ((i, k, _), weight) in edges.iter().zip(weights) {
            let flow = weight * (x[*i] - x[*k]);
            product[*i] += flow;
            product[*k] -= flow;
        }
        product
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut x = start.to_vec();
    let mut residual = apply(&x);
    residual.iter_mut().for_each(|r| *r = -*r);
    for ((i, k, ratio), weight) in edges.iter().zip(weights) {
        residual[*i] += weight * ratio;
        residual[*k] -= weight * ratio;
    }
    let mut direction = residual.clone();
    let mut size = dot(&residual, &residual);
    for _ in 0..ITERATIONS {
        if size <= CONVERGED {
            break;
        }
        let product = apply(&direction);
        let step = size / dot(&direction, &product);
        (0..x.len()).for_each(|i| {
            x[i] += step * direction[i];
            residual[i] -= step * product[i];
        });
        let next = dot(&residual, &residual);
        (0..x.len()).for_each(|i| direction[i] = residual[i] + next / size * direction[i]);
        size = next;
    }
    x
}

/// The ends of the narrow range that most of the values lie in, if it holds enough of them.
fn most_common(values: &mut [f64]) -> Option<[f64; 2]> {
    values.sort_unstable_by(f64::total_cmp);
    let reach = |from: usize| from + values[from..].partition_point(|v| *v <= values[from] + SAME_RATIO);
    let (from, to) = (0..values.len()).map(|from| (from, reach(from))).max_by_key(|(from, to)| to - from)?;
    let enough = (to - from) as f64 >= LEAST_AGREEING * values.len() as f64;
    enough.then(|| [values[from], values[to - 1]])
}

/// Divides the gains out of the train photographs and of the pictures that were filled in for them, where the photographs differ by
/// more than their ratios are exact. Test photographs stay as they are. The gains are in [`Scene::gains`] afterwards.
pub(crate) fn even_out(scene: &mut Scene) {
    let found = exposures(scene);
    let known: Vec<[f64; 3]> = found.iter().flatten().map(|exposure| exposure.channels.map(f64::ln)).collect();
    if known.is_empty() || (known.len() as f64) < LEAST_KNOWN * found.len() as f64 {
        return;
    }
    let mean: [f64; 3] = std::array::from_fn(|c| known.iter().map(|logs| logs[c]).sum::<f64>() / known.len() as f64);
    let off = |logs: &[f64; 3]| -> [f64; 3] { std::array::from_fn(|c| logs[c] - mean[c]) };
    let squares: f64 = known.iter().flat_map(off).map(|log| log * log).sum();
    if (squares / (3 * known.len()) as f64).sqrt() < LEAST_SPREAD {
        return;
    }
    let gain = |exposure: &Option<Exposure>| match exposure {
        Some(exposure) => off(&exposure.channels.map(f64::ln)).map(f64::exp),
        None => [1.0; 3],
    };
    let gains: Vec<[f64; 3]> = found.iter().map(gain).collect();
    let views = scene.train.iter_mut().map(|view| &mut view.image).zip(&gains);
    let painted = scene.references.iter_mut().map(|reference| (&mut reference.image, &gains[reference.view]));
    let filled = scene.holes.iter_mut().map(|hole| (&mut hole.image, &gains[hole.view]));
    for (image, gain) in views.chain(painted).chain(filled) {
        let table: [[u8; 256]; 3] = gain.map(|gain| std::array::from_fn(|value| (value as f64 / gain).round() as u8));
        image.pixels_mut().for_each(|pixel| pixel.0 = std::array::from_fn(|c| table[c][usize::from(pixel.0[c])]));
    }
    let bright = gains.iter().map(|gain| luminance(*gain) - 1.0);
    let (least, most) = (bright.clone().fold(f64::INFINITY, f64::min), bright.fold(f64::NEG_INFINITY, f64::max));
    scene.notes.push(format!(
        "the exposure of {} of {} photographs is evened out ({:+.0} to {:+.0} %; scene.even_exposures)",
        known.len(),
        found.len(),
        100.0 * least,
        100.0 * most
    ));
    scene.gains = gains;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, room360};

    #[test]
    fn the_most_common_ratio_is_found_among_others() {
        let clear = (0..60).map(|i| 0.3 + 0.0005 * f64::from(i));
        let mut mixed: Vec<f64> = clear.clone().chain((0..70).map(|i| -2.0 + 0.06 * f64::from(i))).collect();
        let [from, to] = most_common(&mut mixed).expect("nearly half agree");
        assert!(from >= 0.26 && to <= 0.34 && from <= 0.3 && to >= 0.3295, "{from} to {to}");
        let mut spread: Vec<f64> = (0..100).map(|i| 0.02 * f64::from(i)).collect();
        assert_eq!(most_common(&mut spread), None);
        assert_eq!(most_common(&mut []), None);
    }

    /// A ring of cameras, where an error between neighbours adds up on the way around, and some of its ratios are wrong.
    #[test]
    fn a_long_ring_is_solved_exactly_but_for_wrong_ratios() {
        let count = 300;
        let truth: Vec<f64> = (0..count).map(|i| 0.2 * (f64::from(i) / 300.0 * std::f64::consts::TAU).sin()).collect();
        let near = |i: usize| (1..=3).map(move |step| (i, (i + step) % 300));
        let mut edges: Vec<Edge> = (0..300).flat_map(near).map(|(i, k)| (i, k, truth[i] - truth[k])).collect();
        edges.iter_mut().step_by(40).for_each(|edge| edge.2 += 0.7);
        let found = robust(300, &edges);
        // 0.7 weighs 0.06^2 / 0.7^2 = 0.7 % against five or six right ones: up to 0.001, on top of how well rings converge.
        let worst = found.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst < 0.005, "{worst}");
    }

    /// A bare room whose exposure drifts by up to a fifth around the circle: the gains are those it was drawn with.
    #[test]
    fn the_drift_of_a_bare_room_is_found_and_divided_out() {
        let read = |exposure_drift: f64| {
            let folder = tempfile::tempdir().expect("a folder");
            let options =
                room360::Options { width: 160, height: 120, train_views: 36, exposure_drift, ..Default::default() };
            room360::write(folder.path(), &options).expect("a scene");
            crate::scene::load(folder.path(), &Config::default()).expect("a scene")
        };
        let (plain, mut drifted) = (read(0.0), read(0.2));
        let mean = |view: &View| view.image.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>();
        let truth: Vec<f64> = drifted.train.iter().zip(&plain.train).map(|(a, b)| (mean(a) / mean(b)).ln()).collect();
        let mut alike = plain.clone();
        even_out(&mut alike);
        assert!(alike.gains.is_empty() && alike.train.iter().zip(&plain.train).all(|(a, b)| a.image == b.image));
        even_out(&mut drifted);
        let usual = truth.iter().sum::<f64>() / truth.len() as f64;
        let off = drifted.gains.iter().zip(&truth).map(|(gain, log)| (luminance(*gain).ln() - (log - usual)).abs());
        let worst = off.fold(0.0, f64::max);
        // Stored values are rounded to 8 bits, which is up to half a level of a mean of 16, and a mean of nine of a point's
        // neighbourhood is exact to a third of that: 0.5 / 16 / 3. The truth is rounded over the whole picture.
        assert!(worst < 0.5 / 16.0 / 3.0, "{worst}");
    }
}

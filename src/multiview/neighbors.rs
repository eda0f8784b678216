//! The other views that a view is compared with.

use rayon::prelude::*;

use super::picture::Picture;
use crate::scene::Point;

/// Views whose depths must agree with a view's; the first [`super::score::VIEWS`] of them are matched with it.
const MOST: usize = 8;
/// Points that are looked at.
const POINTS: usize = 3000;
/// Fewest points that two views share.
const FEWEST: u32 = 8;
/// Degrees between two views of a point: the best, how fast smaller and larger ones are worth less, and the most.
const BEST: f64 = 8.0;
const SMALLER: f64 = 4.0;
const LARGER: f64 = 12.0;
const WIDEST: f64 = 45.0;

/// The neighbours of all views.
pub(super) struct Neighbors {
    /// \[view\] their numbers, the best first.
    pub of: Vec<Vec<usize>>,
    /// \[view\] how well each of them sees what the view sees: 1 from the best angle and the same distance.
    pub worth: Vec<Vec<f64>>,
}

/// The views among the first `most` that see most of a view's points from the best angles and distances.
pub(super) fn choose(pictures: &[Picture], most: usize, points: &[Point]) -> Neighbors {
    let every = points.len().div_ceil(POINTS).max(1);
    let positions: Vec<[f64; 3]> = points.iter().step_by(every).map(|p| p.position.map(f64::from)).collect();
    // Of each view the points that it sees: number, direction from the point, distance.
    let seen = |picture: &Picture| -> Vec<(usize, [f64; 3], f64)> {
        let of = |(k, p): (usize, &[f64; 3])| {
            picture.see(*p)?;
            let to: [f64; 3] = std::array::from_fn(|i| picture.center[i] - p[i]);
            let distance = to.iter().map(|v| v * v).sum::<f64>().sqrt();
            Some((k, to.map(|v| v / distance), distance))
        };
        positions.iter().enumerate().filter_map(of).collect()
    };
    let seen: Vec<_> = pictures.par_iter().map(seen).collect();
    let score = |a: &[(usize, [f64; 3], f64)], b: &[(usize, [f64; 3], f64)]| {
        let (mut sum, mut shared, mut at) = (0.0, 0u32, 0);
        for (k, to, distance) in a {
            while at < b.len() && b[at].0 < *k {
                at += 1;
            }
            let Some((_, other, far)) = b.get(at).filter(|other| other.0 == *k) else { continue };
            let cosine: f64 = (0..3).map(|i| to[i] * other[i]).sum();
            let angle = cosine.clamp(-1.0, 1.0).acos().to_degrees();
            if angle > WIDEST {
                continue;
            }
            shared += 1;
            let spread = if angle < BEST { SMALLER } else { LARGER };
            let nearer = (distance / far).min(far / distance);
            sum += nearer * (-0.5 * ((angle - BEST) / spread).powi(2)).exp();
        }
        if shared >= FEWEST { (sum, sum / f64::from(shared)) } else { (0.0, 0.0) }
    };
    let (of, worth) = (0..pictures.len())
        .into_par_iter()
        .map(|at| {
            let others = (0..most).filter(|other| *other != at);
            let scored = others.map(|other| (score(&seen[at], &seen[other]), other));
            let mut scored: Vec<((f64, f64), usize)> = scored.filter(|((sum, _), _)| *sum > 0.0).collect();
            scored.sort_by(|a, b| b.0.0.total_cmp(&a.0.0).then(a.1.cmp(&b.1)));
            scored.into_iter().take(MOST).map(|((_, worth), other)| (other, worth)).unzip()
        })
        .unzip();
    Neighbors { of, worth }
}

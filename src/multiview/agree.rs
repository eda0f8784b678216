//! Views whose photographs agree with the others' next to nowhere.
//!
//! Where a camera is, its photograph fits the others': of what has texture most is confirmed by other views. Structure from
//! motion can hold a camera in a wrong place by points that are consistent among themselves, a repeated pattern or a part of
//! the scene that two ends of a walk share. Nothing in the sparse model tells, but the photographs do.

use super::fuse::Surface;
use super::neighbors::Neighbors;
use super::picture::Picture;
use crate::statistics::quantile;

/// Grey levels between the darkest and the lightest pixel around a site that has texture.
const CONTRAST: u8 = 16;
/// Pixels around a site that are looked at for texture.
const REACH: i32 = 3;
/// Fewest sites with texture that say something about a view.
const FEWEST_SITES: usize = 100;
/// Fewest views that say what is usual.
const FEWEST_VIEWS: usize = 8;
/// A neighbour compares well from this worth on: the angle between the views is at most 28 degrees, or so much less as one
/// is nearer.
const COMPARABLE: f64 = 0.25;
/// Shares of confirmed sites below this part of the upper quartile are of wrong cameras. Of three captures whose cameras are
/// right the lowest is at 0.55 to 0.9 of it; of a capture of which half is wrong those are at 0.01 to 0.2.
const PART: f64 = 0.25;
/// An upper quartile below this says that matching fails on this capture: everything is blank, or all is wrong.
const WORKS: f64 = 0.2;

/// The share of a view's textured sites that other views confirm; `None` for views that cannot be judged: without texture,
/// or with fewer than two neighbours that see the same from a similar place.
pub(super) fn shares(pictures: &[Picture], neighbors: &Neighbors, surfaces: &[Surface]) -> Vec<Option<f64>> {
    let share = |at: usize| {
        if neighbors.worth[at].iter().filter(|worth| **worth >= COMPARABLE).count() < 2 {
            return None;
        }
        let picture = &pictures[at];
        let textured: Vec<usize> =
            (0..picture.sites.len()).filter(|site| picture.shown[*site] && has_texture(picture, *site)).collect();
        let confirmed = textured.iter().filter(|site| surfaces[at][**site].is_finite()).count();
        (textured.len() >= FEWEST_SITES).then(|| confirmed as f64 / textured.len() as f64)
    };
    (0..pictures.len()).map(share).collect()
}

fn has_texture(picture: &Picture, site: usize) -> bool {
    let [w, h] = picture.camera.size.map(|n| n as i32);
    let [x, y] = picture.pixel(site).map(|c| c as i32);
    let around = (y - REACH..=y + REACH).flat_map(|v| (x - REACH..=x + REACH).map(move |u| (u, v)));
    let values = around
        .filter(|(u, v)| (0..w).contains(u) && (0..h).contains(v))
        .map(|(u, v)| picture.grey[(v * w + u) as usize]);
    let (low, high) = values.fold((u8::MAX, 0), |(low, high), value| (low.min(value), high.max(value)));
    high.saturating_sub(low) >= CONTRAST
}

/// The views whose shares are those of wrong cameras.
pub(super) fn wrong(shares: &[Option<f64>]) -> Vec<bool> {
    let judged = shares.iter().flatten().copied();
    let usual = quantile(judged.clone(), 0.75).unwrap_or(0.0);
    let found: Vec<bool> = shares.iter().map(|share| share.is_some_and(|share| share < PART * usual)).collect();
    let count = found.iter().filter(|wrong| **wrong).count();
    // What most views contradict is not the rule.
    let sound = judged.count() >= FEWEST_VIEWS && usual >= WORKS && 2 * count <= shares.len();
    if sound { found } else { vec![false; shares.len()] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_are_wrong_where_most_agree() {
        let mut shares = vec![Some(0.6); 20];
        shares[3] = Some(0.05);
        shares[7] = None;
        shares[9] = Some(0.3);
        let found = |shares: &[Option<f64>]| -> Vec<usize> {
            wrong(shares).iter().enumerate().filter(|(_, wrong)| **wrong).map(|(at, _)| at).collect()
        };
        assert_eq!(found(&shares), [3]);
        assert_eq!(found(&shares[..7]), [0usize; 0], "of seven views none is usual");
        let halved: Vec<_> = (0..20).map(|i| Some(if i < 11 { 0.05 } else { 0.6 })).collect();
        assert_eq!(found(&halved), [0usize; 0], "more than a half");
        assert_eq!(found(&[Some(0.1); 20].map(|s| s)), [0usize; 0]);
        let blank: Vec<_> = (0..20).map(|i| Some(if i == 0 { 0.0 } else { 0.15 })).collect();
        assert_eq!(found(&blank), [0usize; 0], "matching fails here");
        assert_eq!(found(&[]), [0usize; 0]);
    }
}

//! Views whose photographs agree with the others' next to nowhere.
//!
//! Where a camera is, its photograph fits the others': of what has texture most is confirmed by other views. Structure from
//! motion can hold a camera in a wrong place by points that are consistent among themselves, a repeated pattern or a part of
//! the scene that two ends of a walk share. Nothing in the sparse model tells, but the photographs do.
//!
//! A few photographs taken side by side may be held in a wrong place together. They confirm each other, and nobody else confirms them.

use rayon::prelude::*;

use super::fuse::{SAME, Surface};
use super::neighbors::Neighbors;
use super::picture::Picture;
use crate::segments::parts;
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
/// Sites of a view whose depth is compared with that of each other view.
const COMPARED: usize = 300;
/// Two views hang together where they compare at so many sites and agree at half of these.
const FEWEST_COMPARED: u32 = 15;
/// Views that hang together are in a wrong place where they are at most this part of all, and, with those that hang together most, agree
/// at less than this part of the sites at which they agree or look past what the other has, and have so many of these for each view. Of
/// bonsai-exhaustive three views stand apart, which agree at 0.44; all others agree at 0.98.
const SMALL: f64 = 0.125;
const AGREE: f64 = 0.7;
const TOLD_FOR_EACH: u32 = 30;

/// The views whose cameras are wrong, by what `surfaces` others confirm of each.
pub(super) fn wrong(pictures: &[Picture], neighbors: &Neighbors, surfaces: &[Surface]) -> Vec<bool> {
    let mut found = below_usual(&shares(pictures, neighbors, surfaces));
    let right: Vec<usize> = (0..pictures.len()).filter(|at| !found[*at]).collect();
    let apart = apart(&compared(pictures, surfaces, &right));
    apart.into_iter().for_each(|at| found[right[at]] = true);
    found
}

/// Sites at which a view is compared with another, those of them at which they agree, and those where the other looks past what is there.
type Compared = [u32; 3];

/// `[one][other]` of some views: their confirmed depths compared, where one has a point in the other's picture.
fn compared(pictures: &[Picture], surfaces: &[Surface], of: &[usize]) -> Vec<Vec<Compared>> {
    let with = |one: usize| -> Vec<Compared> {
        let own = &pictures[one];
        let known: Vec<usize> = (0..own.sites.len()).filter(|site| surfaces[one][*site].is_finite()).collect();
        let some = known.iter().step_by(known.len().div_ceil(COMPARED).max(1));
        let points: Vec<[f64; 3]> = some.map(|site| own.lift(own.pixel(*site), surfaces[one][*site])).collect();
        let compare = |other: usize| {
            let depths = points.iter().filter_map(|point| {
                let (pixel, z) = pictures[other].see(*point)?;
                Some(surfaces[other][pictures[other].site(pixel)?] / z - 1.0)
            });
            depths.filter(|off| off.is_finite()).fold([0; 3], |[all, agree, past], off| {
                [all + 1, agree + u32::from(off.abs() <= SAME), past + u32::from(off > SAME)]
            })
        };
        of.iter().map(|other| if *other == one { [0; 3] } else { compare(*other) }).collect()
    };
    of.par_iter().map(|one| with(*one)).collect()
}

/// The views that hang together with a few others at most and contradict the many that hang together.
fn apart(compared: &[Vec<Compared>]) -> Vec<usize> {
    let n = compared.len();
    let both = |one: usize, other: usize| -> Compared {
        std::array::from_fn(|k| compared[one][other][k] + compared[other][one][k])
    };
    let is_link = |(one, other): &(usize, usize)| {
        let [all, agree, _] = both(*one, *other);
        all >= FEWEST_COMPARED && 2 * agree >= all
    };
    let pairs = (0..n).flat_map(|one| (0..one).map(move |other| (one, other)));
    let parts = parts(n, pairs.filter(is_link));
    let Some(main) = parts.iter().max_by_key(|part| part.len()).filter(|part| 2 * part.len() > n) else {
        return vec![];
    };
    let is_apart = |part: &&Vec<usize>| {
        let pairs = part.iter().flat_map(|one| main.iter().map(|other| both(*one, *other)));
        let [agree, past] = pairs.fold([0; 2], |[a, b], [_, agree, past]| [a + agree, b + past]);
        part.len() as f64 <= SMALL * n as f64
            && agree + past >= TOLD_FOR_EACH * part.len() as u32
            && f64::from(agree) < AGREE * f64::from(agree + past)
    };
    parts.iter().filter(is_apart).flatten().copied().collect()
}

/// The share of a view's textured sites that other views confirm; `None` for views that cannot be judged: without texture,
/// or with fewer than two neighbours that see the same from a similar place.
fn shares(pictures: &[Picture], neighbors: &Neighbors, surfaces: &[Surface]) -> Vec<Option<f64>> {
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
fn below_usual(shares: &[Option<f64>]) -> Vec<bool> {
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
    use super::super::tests::built_in;
    use super::super::{depth, fuse, neighbors};
    use super::*;
    use crate::gpu::testing;
    use crate::scene::{Camera, synthetic};

    /// Three cameras side by side are moved together, as a model holds a piece that hangs on the rest by wrong matches: they confirm each
    /// other, and nobody else confirms them.
    #[test]
    fn a_few_cameras_in_a_wrong_place_together_are_found() {
        let mut scene = built_in(&synthetic::Options { train_views: 28, test_views: 0, ..Default::default() });
        let found = |scene: &crate::scene::Scene| -> [Vec<bool>; 2] {
            let pictures: Vec<Picture> = scene.train.iter().map(|view| Picture::new(view, 1)).collect();
            let neighbors = neighbors::choose(&pictures, pictures.len(), &scene.points);
            let maps = depth::estimate(&testing::gpu(), &pictures, &neighbors.of, &scene.points).expect("a device");
            let surfaces = fuse::confirm(&pictures, &neighbors.of, &maps);
            [below_usual(&shares(&pictures, &neighbors, &surfaces)), wrong(&pictures, &neighbors, &surfaces)]
        };
        assert!(!found(&scene)[1].contains(&true));
        let [dx, dz] = [0.3, 1.5];
        for view in &mut scene.train[12..15] {
            let [x, y, z] = view.camera.center();
            view.camera.translation = Camera::translation_to(&view.camera.rotation, [x + dx, y, z + dz]);
        }
        // What they see is measured, too, where they have it.
        let mut moved = scene.points.clone();
        moved.iter_mut().for_each(|point| {
            (point.position[0], point.position[2]) = (point.position[0] + dx as f32, point.position[2] + dz as f32)
        });
        scene.points.extend(moved);
        let [alone, all] = found(&scene);
        assert!(!alone[12..15].contains(&true), "the case is too easy: {alone:?}");
        assert!((0..28).all(|at| all[at] == (12..15).contains(&at)), "{all:?}");
    }

    /// Twenty views that hang together, two that contradict them, and one that compares with nobody.
    #[test]
    fn what_is_hidden_by_others_is_not_apart() {
        let of = |told: [u32; 2]| {
            let pair = |one: usize, other: usize| match () {
                () if one == other => [0; 3],
                () if one.max(other) < 20 => [300, 250, 5],
                () if one.min(other) >= 20 && one.max(other) < 22 => [300, 280, 0],
                () if one.max(other) < 22 => [100, told[0], told[1]],
                () => [0; 3],
            };
            apart(&(0..23).map(|one| (0..23).map(|other| pair(one, other)).collect()).collect::<Vec<Vec<Compared>>>())
        };
        assert_eq!(of([1, 3]), [20, 21]);
        // A wall before all of it, and what agrees.
        assert_eq!(of([0, 0]), [0usize; 0]);
        assert_eq!(of([3, 1]), [0usize; 0]);
    }

    #[test]
    fn few_are_wrong_where_most_agree() {
        let mut shares = vec![Some(0.6); 20];
        shares[3] = Some(0.05);
        shares[7] = None;
        shares[9] = Some(0.3);
        let found = |shares: &[Option<f64>]| -> Vec<usize> {
            below_usual(shares).iter().enumerate().filter(|(_, wrong)| **wrong).map(|(at, _)| at).collect()
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

//! Views whose photographs contradict most others, or agree with them next to nowhere.
//!
//! Where a camera is, its photograph fits the others': of what has texture most is confirmed by other views. Structure from
//! motion can hold a camera in a wrong place by points that are consistent among themselves, a repeated pattern or a part of
//! the scene that two ends of a walk share. Nothing in the sparse model tells, but the photographs do.
//!
//! Photographs taken side by side may be held in a wrong place together. They confirm each other, and nobody else confirms them: a few of
//! them, or half of a model that is torn, whose halves a picture that repeats has put beside each other.

use rayon::prelude::*;

use super::fuse::{SAME, Surface};
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
/// Sites of a view whose depth is compared with that of each other view.
const COMPARED: usize = 300;
/// Parts of views hang together where they agree at this part of the sites at which they agree or look past what the other has. One is in
/// a wrong place where it does not hang together with the largest, and has so many of these sites for each of its views.
///
/// Three views of bonsai-exhaustive stand apart, which agree at 0.44; all others agree at 0.98. Another model of these photographs is torn:
/// its parts of 54 and 29 views agree at 0.46, and blocks of six views at 0.87 to 0.99 within each part, at any distance.
const AGREE: f64 = 0.7;
const TOLD_FOR_EACH: u64 = 30;

/// The views whose cameras are wrong, by what `surfaces` others confirm of each.
pub(super) fn wrong(pictures: &[Picture], neighbors: &Neighbors, surfaces: &[Surface]) -> Vec<bool> {
    let mut found = below_usual(&shares(pictures, neighbors, surfaces));
    let right: Vec<usize> = (0..pictures.len()).filter(|at| !found[*at]).collect();
    let apart = apart(&compared(pictures, surfaces, &right));
    apart.into_iter().for_each(|at| found[right[at]] = true);
    found
}

/// Sites of a view at which another agrees, and at which it looks past what is there.
type Compared = [u32; 2];

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
            depths
                .fold([0; 2], |[agree, past], off| [agree + u32::from(off.abs() <= SAME), past + u32::from(off > SAME)])
        };
        of.iter().map(|other| if *other == one { [0; 2] } else { compare(*other) }).collect()
    };
    of.par_iter().map(|one| with(*one)).collect()
}

/// The views that contradict the largest part of those that hang together, alone or with others.
fn apart(compared: &[Vec<Compared>]) -> Vec<usize> {
    let mut parts = Parts::new(compared);
    while let Some((one, other)) = parts.nearest() {
        parts.join(one, other);
    }
    let size = |part: &usize| parts.views[*part].len();
    let all = || (0..compared.len()).filter(|part| size(part) > 0);
    let Some(main) = all().max_by_key(|part| (size(part), std::cmp::Reverse(*part))) else { return vec![] };
    let mut found = vec![];
    for part in all().filter(|part| *part != main && size(&main) >= FEWEST_VIEWS) {
        let told = parts.told[part][main];
        log::debug!("agree: {} views beside {}: {told:?} of what they have of each other", size(&part), size(&main));
        if told.iter().sum::<u64>() >= TOLD_FOR_EACH * size(&part) as u64 && !hang_together(told) {
            found.extend(&parts.views[part]);
        }
    }
    found.sort_unstable();
    found
}

/// Whether parts hang together that agree at so many sites, and look past what the other has at so many.
fn hang_together([agree, past]: [u64; 2]) -> bool {
    agree as f64 >= AGREE * (agree + past) as f64
}

/// Parts of the views that hang together.
struct Parts {
    /// `[part]` its views; none where it has joined another.
    views: Vec<Vec<usize>>,
    /// `[one][other]` the sites at which two parts agree, and at which they look past what the other has.
    told: Vec<Vec<[u64; 2]>>,
}

impl Parts {
    /// Parts of one view each.
    fn new(compared: &[Vec<Compared>]) -> Self {
        let n = compared.len();
        let both = |one: usize, other: usize| {
            let [[agree, past], [agrees, passes]] = [compared[one][other], compared[other][one]];
            [agree + agrees, past + passes].map(u64::from)
        };
        let told = (0..n).map(|one| (0..n).map(|other| both(one, other)).collect());
        Self { views: (0..n).map(|view| vec![view]).collect(), told: told.collect() }
    }

    /// Two parts that hang together, those that agree at most sites: a few that agree by chance come last, when what their parts have of each
    /// other is known.
    fn nearest(&self) -> Option<(usize, usize)> {
        let there = |part: &usize| !self.views[*part].is_empty();
        let pairs =
            (0..self.views.len()).filter(there).flat_map(|one| (0..one).filter(there).map(move |other| (other, one)));
        let near =
            pairs.filter(|(one, other)| self.told[*one][*other][0] > 0 && hang_together(self.told[*one][*other]));
        near.max_by_key(|(one, other)| (self.told[*one][*other][0], std::cmp::Reverse((*one, *other))))
    }

    /// Makes one part of two.
    fn join(&mut self, one: usize, other: usize) {
        let joined = std::mem::take(&mut self.views[other]);
        self.views[one].extend(joined);
        for part in 0..self.views.len() {
            let sum = std::array::from_fn(|k| self.told[one][part][k] + self.told[other][part][k]);
            (self.told[one][part], self.told[part][one]) = (sum, sum);
        }
    }
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

    /// Three cameras side by side, or eleven, are moved together, as a model holds a piece that hangs on the rest by wrong matches: they
    /// confirm each other, and nobody else confirms them.
    #[test]
    fn cameras_in_a_wrong_place_together_are_found() {
        for moved in [12..15, 17..28] {
            these_are_found(moved);
        }
    }

    fn these_are_found(these: std::ops::Range<usize>) {
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
        for view in &mut scene.train[these.clone()] {
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
        assert!(!alone[these.clone()].contains(&true), "the case is too easy: {alone:?}");
        assert!((0..28).all(|at| all[at] == these.contains(&at)), "{all:?}");
    }

    /// The views apart of 23, by what two of them tell of each other.
    fn apart_of(pair: impl Fn(usize, usize) -> Compared) -> Vec<usize> {
        let told = |one: usize, other: usize| if one == other { [0; 2] } else { pair(one.min(other), one.max(other)) };
        apart(&(0..23).map(|one| (0..23).map(|other| told(one, other)).collect()).collect::<Vec<Vec<Compared>>>())
    }

    /// Twenty views that hang together, two that contradict them, and one that compares with nobody.
    #[test]
    fn what_is_hidden_by_others_is_not_apart() {
        let of = |told: Compared| {
            apart_of(|one, other| match () {
                () if other < 20 => [250, 5],
                () if one >= 20 && other < 22 => [280, 0],
                () if other < 22 => told,
                () => [0; 2],
            })
        };
        assert_eq!(of([1, 3]), [20, 21]);
        // A wall before all of it, and what agrees.
        assert_eq!(of([0, 0]), [0usize; 0]);
        assert_eq!(of([3, 1]), [0usize; 0]);
    }

    /// The smaller half of a torn model, of which single views agree with single ones of the other half.
    #[test]
    fn chance_holds_no_halves_together() {
        let of = |past: u32| {
            apart_of(|one, other| match other {
                15.. if one < 15 => {
                    if (one + other) % 4 == 0 {
                        [40, 10]
                    } else {
                        [10, past]
                    }
                }
                _ => [250, 5],
            })
        };
        assert_eq!(of(40), (15..23).collect::<Vec<usize>>());
        assert_eq!(of(2), [0usize; 0]);
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

//! Masks for all views from masks of a few: the Gaussians vote.
//!
//! In a view with a mask, a Gaussian's share in the pixels inside, over its share in all pixels, says how much of it is
//! the object. Rendered into another view in place of the colours and divided by what covers the pixel, these shares are
//! the object's part of each pixel; half is the border.

use image::{GrayImage, Luma};
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::splats::Splats;
use crate::gpu::Error;
use crate::scene::{Camera, resample};

/// A Gaussian with less than this (pixels) in the masked views was not seen there.
const SEEN: f32 = 1e-2;
/// Anchors seen in no masked view are taken to be what so many seen ones around them are.
const NEIGHBOURS: usize = 8;
/// A pixel less covered than this shows nothing that could be the object.
const COVERED: f32 = 0.1;

/// The votes of the masked views.
pub struct Votes {
    inside: Vec<f32>,
    all: Vec<f32>,
}

/// What the votes say of each Gaussian.
pub struct Shares {
    /// By name: how much of it is the object, 0 to 1.
    pub object: Vec<f32>,
    /// By name: whether a masked view has seen it, or another Gaussian of its anchor.
    pub seen: Vec<bool>,
}

/// A view as the votes see it.
pub struct Carried {
    /// `[pixel]` the object's part, 0 to 1.
    pub object: Vec<f32>,
    /// `[pixel]` the part of what covers it that the masked views have seen, 0 to 1.
    pub evidence: Vec<f32>,
}

impl Votes {
    /// None yet.
    pub fn new(splats: &Splats) -> Self {
        Self { inside: vec![0.0; splats.len()], all: vec![0.0; splats.len()] }
    }

    /// Adds a view's: `inside` is the mask's part of each pixel, 0 to 1.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn add(&mut self, splats: &mut Splats, camera: &Camera, inside: &[f32]) -> Result<(), Error> {
        let weights: Vec<[f32; 3]> = inside.iter().map(|part| [*part, 1.0, 0.0]).collect();
        for (name, [inside, all, _]) in splats.shares(camera, &weights)? {
            self.inside[name as usize] += inside;
            self.all[name as usize] += all;
        }
        Ok(())
    }

    /// Counts them. `positions` are the anchors': a Gaussian that no masked view has seen votes as its anchor does, and an
    /// anchor that none has seen as those around it.
    pub fn count(&self, positions: &[[f32; 3]]) -> Shares {
        let offsets = self.all.len() / positions.len().max(1);
        let of_anchors: Vec<[f32; 2]> = (0..positions.len())
            .map(|a| {
                let range = a * offsets..(a + 1) * offsets;
                [self.inside[range.clone()].iter().sum(), self.all[range].iter().sum()]
            })
            .collect();
        let seen: Vec<usize> = (0..positions.len()).filter(|a| of_anchors[*a][1] > SEEN).collect();
        let tree: ImmutableKdTree<f32, 3> =
            ImmutableKdTree::new_from_slice(&seen.iter().map(|a| positions[*a]).collect::<Vec<_>>());
        let around = |a: usize| -> f32 {
            let Some(count) = std::num::NonZero::new(NEIGHBOURS.min(seen.len())) else { return 0.0 };
            let near = tree.nearest_n::<SquaredEuclidean>(&positions[a], count);
            let votes = near.iter().map(|n| of_anchors[seen[n.item as usize]]);
            votes.map(|[inside, all]| inside / all).sum::<f32>() / count.get() as f32
        };
        let mut shares =
            Shares { object: Vec::with_capacity(self.all.len()), seen: Vec::with_capacity(self.all.len()) };
        for a in 0..positions.len() {
            let [inside, all] = of_anchors[a];
            let seen = all > SEEN;
            let anchor = if seen { inside / all } else { around(a) };
            for g in a * offsets..(a + 1) * offsets {
                let own = self.all[g] > SEEN;
                shares.object.push(if own { self.inside[g] / self.all[g] } else { anchor }.clamp(0.0, 1.0));
                shares.seen.push(seen);
            }
        }
        shares
    }
}

impl Shares {
    /// Rendered into a view.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn carry(&self, splats: &mut Splats, camera: &Camera) -> Result<Carried, Error> {
        let look = |name: u32, _| {
            let name = name as usize;
            Some([self.object[name], f32::from(self.seen[name]), 0.0])
        };
        let drawn = splats.paint(camera, look)?;
        let of = |channel: usize| {
            let covered = drawn.transmittance.iter().map(|left| 1.0 - left);
            let parts = drawn.rgb.iter().zip(covered);
            parts.map(|(rgb, covered)| if covered < COVERED { 0.0 } else { rgb[channel] / covered }).collect()
        };
        Ok(Carried { object: of(0), evidence: of(1) })
    }
}

impl Carried {
    /// Which part of the object's pixels the masked views have not seen; nothing where the object is out of view.
    pub fn thinness(&self) -> Option<f64> {
        let object = || self.object.iter().zip(&self.evidence).filter(|(object, _)| **object > 0.5);
        let unseen = object().filter(|(_, evidence)| **evidence < 0.5).count();
        let all = object().count();
        (all > 0).then(|| unseen as f64 / all as f64)
    }
}

/// The mask where more than half of a pixel is the object: `parts` (width, height `from`) brought to the size `to`.
pub fn threshold(parts: &[f32], from: [u32; 2], to: [u32; 2]) -> GrayImage {
    let large = resample::map(parts, from, to);
    GrayImage::from_fn(to[0], to[1], |x, y| Luma([if large[(y * to[0] + x) as usize] > 0.5 { 255 } else { 0 }]))
}

/// The mask's part of each pixel of a picture of the size `to`.
pub fn parts(mask: &GrayImage, to: [u32; 2]) -> Vec<f32> {
    let values: Vec<f32> = mask.as_raw().iter().map(|v| f32::from(*v != 0)).collect();
    resample::map(&values, [mask.width(), mask.height()], to)
}

/// Takes away specks: 8-connected pieces of less than `share` of the largest one.
pub fn without_specks(mask: &GrayImage, share: f64) -> GrayImage {
    let (w, h) = (mask.width() as usize, mask.height() as usize);
    let raw = mask.as_raw();
    let mut label = vec![0usize; w * h];
    let mut sizes = vec![0usize];
    for start in 0..w * h {
        if raw[start] == 0 || label[start] != 0 {
            continue;
        }
        let this = sizes.len();
        sizes.push(0);
        let mut stack = vec![start];
        label[start] = this;
        while let Some(at) = stack.pop() {
            sizes[this] += 1;
            let (x, y) = (at % w, at / w);
            for v in y.saturating_sub(1)..(y + 2).min(h) {
                for u in x.saturating_sub(1)..(x + 2).min(w) {
                    let next = v * w + u;
                    if raw[next] != 0 && label[next] == 0 {
                        label[next] = this;
                        stack.push(next);
                    }
                }
            }
        }
    }
    let least = (share * sizes.iter().copied().max().unwrap_or(0) as f64) as usize;
    let raw = label.iter().map(|l| if *l != 0 && sizes[*l] >= least { 255 } else { 0 }).collect();
    GrayImage::from_raw(mask.width(), mask.height(), raw).expect("a value per pixel")
}

/// Intersection over union of two masks of one size; 1 if both are empty.
pub fn iou(a: &GrayImage, b: &GrayImage) -> f64 {
    let (mut both, mut any) = (0u64, 0u64);
    for (a, b) in a.as_raw().iter().zip(b.as_raw()) {
        both += u64::from(*a != 0 && *b != 0);
        any += u64::from(*a != 0 || *b != 0);
    }
    if any == 0 { 1.0 } else { both as f64 / any as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> GrayImage {
        let (w, h) = (rows[0].len() as u32, rows.len() as u32);
        GrayImage::from_fn(w, h, |x, y| Luma([if rows[y as usize].as_bytes()[x as usize] == b'#' { 255 } else { 0 }]))
    }

    #[test]
    fn overlap() {
        let (a, b) = (mask(&["##.", "##."]), mask(&[".##", ".##"]));
        assert_eq!(iou(&a, &b), 2.0 / 6.0);
        assert_eq!((iou(&a, &a), iou(&a, &mask(&["...", "..."]))), (1.0, 0.0));
        assert_eq!(iou(&mask(&["..."]), &mask(&["..."])), 1.0);
    }

    #[test]
    fn specks_go_and_pieces_stay() {
        let found = without_specks(&mask(&["###...", "###..#", ".....#", "#....#"]), 0.3);
        // Six, three (half of six) and one, which is less than 0.3 of six.
        assert_eq!(found, mask(&["###...", "###..#", ".....#", "......"]));
        assert_eq!(without_specks(&mask(&["..."]), 0.5), mask(&["..."]));
    }

    #[test]
    fn sizes_change_by_area_and_back() {
        let large = mask(&["##..", "##..", "#...", "...."]);
        let small = parts(&large, [2, 2]);
        assert_eq!(small, [1.0, 0.0, 0.25, 0.0]);
        assert_eq!(threshold(&small, [2, 2], [2, 2]), mask(&["#.", ".."]));
    }

    /// Anchors in a row, two Gaussians each: the first wholly inside, the second half, the third was never seen.
    #[test]
    fn votes_are_counted_by_gaussian_anchor_and_neighbourhood() {
        let votes = Votes { inside: vec![2.0, 0.0, 1.0, 3.0, 0.0, 0.0], all: vec![2.0, 0.0, 4.0, 4.0, 0.0, 0.0] };
        let shares = votes.count(&[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        // The mean of the two seen anchors: (1 + 4 / 8) / 2.
        assert_eq!(shares.object, [1.0, 1.0, 0.25, 0.75, 0.75, 0.75]);
        assert_eq!(shares.seen, [true, true, true, true, false, false]);
        // Nobody was seen at all.
        let votes = Votes { inside: vec![0.0; 2], all: vec![0.0; 2] };
        assert_eq!(votes.count(&[[0.0; 3]]).object, [0.0; 2]);
    }
}

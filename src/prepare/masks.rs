//! Masks for all views from masks of a few: the Gaussians vote.
//!
//! In a view with a mask, a Gaussian's share in the pixels inside, over its share in all pixels, says how much of it is
//! the object. Rendered into another view in place of the colours and divided by what covers the pixel, these shares are
//! the object's part of each pixel.

use std::collections::HashMap;

use glam::DVec3;
use image::{GrayImage, Luma};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use super::shadow::plane::{self, Support};
use super::splats::{Share, Splats};
use crate::gpu::Error;
use crate::render::view::Rendered;
use crate::scene::{Camera, View, resample, up};
use crate::statistics::{median, quantile};

/// A Gaussian of whose footprint less than this part shows in a view has no vote there. A short fit's object lets a tenth and
/// more of what stands behind it through, all of it inside the mask.
const SHOWN: f32 = 0.25;
/// Anchors seen less than this (pixels) in the masked views count as unseen.
const SEEN: f32 = 1.0;
/// Votes (pixels) that a Gaussian's surroundings have beside its own.
const PRIOR: f32 = 1.0;
/// Anchors seen in no masked view are taken to be what so many seen ones are that are near them and look like them.
const NEIGHBOURS: usize = 8;
/// Colours that differ by this are as far apart as anchors [`REACH`] times their spacing away from each other.
const COLOR: f32 = 0.08;
/// See [`COLOR`].
const REACH: f32 = 6.0;
/// Views that are asked for the Gaussians' colours.
const COLORED: usize = 6;
/// Anchors hang together where they lie in neighbouring cells, whose sides are this part of the object's extent, or so many spacings where
/// that is more. One that no masked view has seen is the object if it hangs together with what they have seen of it.
const STEP: f32 = 0.125;
const STEP_SPACINGS: f32 = 4.0;
/// A piece that hangs together is the object where it has this part of all that the masked views have seen of it.
const ATTACHED: f32 = 0.05;
/// A piece is behind the object where it has less than this part of its votes, and begins farther away than the object ends by this part
/// of its extent; and the part of each that is nearer or farther.
const SMALL: f32 = 0.25;
const BEHIND: f64 = 0.25;
const NEAREST: f64 = 0.05;
/// Part of the object's extent from what masked views have seen of it: farther out, outside the pictures of them all, nothing is the object's,
/// and nearer what has rather its colours.
const BEYOND: f32 = 0.5;
/// Height above the plane that the object stands on, as a part of its radius: up to there, and below, nothing is the object that masked
/// views have not seen.
const UNDERFOOT: f64 = 0.05;
/// Part of what lies around its foot that must be on that plane: within so much of its radius, up to this part of the radius above and
/// below. A table may be hardly larger than what stands on it, and its cloth hangs beside it.
const FLAT: f64 = 0.6;
const AROUND: f64 = 0.75;
const LOW: f64 = 0.5;
/// Places that tell what the object stands on, at most: of it, and around it.
const PLACES: [usize; 2] = [500, 2000];

/// A pixel less covered than this shows nothing that could be the object.
const COVERED: f32 = 0.1;

/// A pixel of which more than this part is the object belongs to the carried mask. Below a half: along the object's rim
/// lie Gaussians that no masked view has seen, and a mask that is too narrow leaves a ghost where one that is too wide
/// leaves nothing.
pub const OBJECT: f32 = 0.35;

/// The votes of the masked views.
pub struct Votes {
    inside: Vec<f32>,
    all: Vec<f32>,
    /// The masked views' cameras.
    cameras: Vec<Camera>,
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
        Self { inside: vec![0.0; splats.len()], all: vec![0.0; splats.len()], cameras: vec![] }
    }

    /// Adds a view's: `inside` is the mask's part of each pixel, 0 to 1. What stands behind others there has no vote.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn add(&mut self, splats: &mut Splats, camera: &Camera, inside: &[f32]) -> Result<(), Error> {
        self.cameras.push(*camera);
        let weights: Vec<[f32; 3]> = inside.iter().map(|part| [*part, 1.0, 0.0]).collect();
        for Share { name, sums: [inside, all, _], alone } in splats.shares(camera, &weights)? {
            if all < SHOWN * alone {
                continue;
            }
            self.inside[name as usize] += inside;
            self.all[name as usize] += all;
        }
        Ok(())
    }

    /// Adds those of other views.
    pub fn join(&mut self, others: &Self) {
        self.inside.iter_mut().zip(&others.inside).for_each(|(sum, votes)| *sum += votes);
        self.all.iter_mut().zip(&others.all).for_each(|(sum, votes)| *sum += votes);
    }

    /// Takes the votes for these anchors away: they are none of the object.
    pub fn deny(&mut self, anchors: &[bool]) {
        let offsets = self.all.len() / anchors.len().max(1);
        let votes = self.inside.iter_mut().enumerate();
        votes.filter(|(g, _)| anchors[g / offsets]).for_each(|(_, inside)| *inside = 0.0);
    }

    /// Counts them. `positions` and `colors` are the anchors': a Gaussian that no masked view has seen votes as its anchor
    /// does, and an anchor that none has seen as those which are near it and look like it. What stands behind the object is
    /// as near to it as its own other side, but seldom of its colour; what stands elsewhere may be of its colour, but does not hang
    /// together with it. Beyond the pictures' borders there is little of it, and on the plane that it stands on nothing.
    pub fn count(&self, positions: &[[f32; 3]], colors: &[[f32; 3]]) -> Shares {
        let offsets = self.all.len() / positions.len().max(1);
        let of_anchors: Vec<[f32; 2]> = (0..positions.len())
            .map(|a| {
                let range = a * offsets..(a + 1) * offsets;
                [self.inside[range.clone()].iter().sum(), self.all[range].iter().sum()]
            })
            .collect();
        let seen: Vec<usize> = (0..positions.len()).filter(|a| of_anchors[*a][1] > SEEN).collect();
        let spacing = spacing(positions);
        let place = |a: usize| -> [f32; 6] {
            std::array::from_fn(|i| if i < 3 { positions[a][i] / (REACH * spacing) } else { colors[a][i - 3] / COLOR })
        };
        let is_seen = |a: usize| of_anchors[a][1] > SEEN;
        let part = |a: usize| of_anchors[a][0] / of_anchors[a][1];
        let inside = |a: usize| if is_seen(a) { of_anchors[a][0] } else { 0.0 };
        let (object, other): (Vec<usize>, Vec<usize>) = seen.iter().partition(|a| part(**a) > OBJECT);
        let at = |of: &[usize], values: &[[f32; 3]]| {
            ImmutableKdTree::<f32, 3>::new_from_slice(&of.iter().map(|a| values[*a]).collect::<Vec<_>>())
        };
        let distance = |tree: &ImmutableKdTree<f32, 3>, to: &[f32; 3], number: usize| {
            let number = std::num::NonZero::new(number.min(tree.size()));
            let near =
                number.and_then(|number| tree.nearest_n::<SquaredEuclidean>(to, number).last().map(|n| n.distance));
            near.map_or(f32::INFINITY, f32::sqrt)
        };
        let (places, looks) = (at(&object, positions), [at(&object, colors), at(&other, colors)]);
        let points = |of: &[usize]| -> Vec<DVec3> { of.iter().map(|a| point(positions[*a])).collect() };
        let ball = plane::ball(&points(&object));
        let extent = ball.map_or(0.0, |(_, radius)| 2.0 * radius as f32);
        // Where all was seen nobody asks.
        let asked = ball.filter(|_| seen.len() < positions.len());
        let support = asked.and_then(|ball| self.support(&points(&object), points(&other).into_iter(), ball));
        let underfoot = |a: usize| support.as_ref().is_some_and(|(s, height)| s.local(point(positions[a])).z < *height);
        // Of what rises from the plane that says nothing which lies on it.
        let risen: Vec<usize> = seen.iter().copied().filter(|a| !underfoot(*a)).collect();
        let tree =
            |of: &[usize]| ImmutableKdTree::<f32, 6>::new_from_slice(&of.iter().map(|a| place(*a)).collect::<Vec<_>>());
        let trees = [(tree(&seen), &seen), (tree(&risen), &risen)];
        let around = |a: usize| -> f32 {
            let (tree, of) = &trees[usize::from(!underfoot(a))];
            let Some(count) = std::num::NonZero::new(NEIGHBOURS.min(of.len())) else { return 0.0 };
            let near = tree.nearest_n::<SquaredEuclidean>(&place(a), count);
            near.iter().map(|n| part(of[n.item as usize])).sum::<f32>() / count.get() as f32
        };
        let prior = |a: usize| if is_seen(a) { part(a) } else { around(a) };
        let mut priors: Vec<f32> = (0..positions.len()).into_par_iter().map(prior).collect();
        let framed = |a: usize| self.cameras.iter().any(|c| c.within(positions[a].map(f64::from)).is_some());
        let possible = |a: usize| {
            let near = || distance(&places, &positions[a], 1) <= BEYOND * extent;
            let alike = || distance(&looks[0], &colors[a], NEIGHBOURS) <= distance(&looks[1], &colors[a], NEIGHBOURS);
            is_seen(a) || !underfoot(a) && (self.cameras.is_empty() || framed(a) || near() && alike())
        };
        let out: Vec<bool> = (0..positions.len()).into_par_iter().map(|a| priors[a] > 0.0 && !possible(a)).collect();
        priors.iter_mut().zip(out).filter(|(_, out)| *out).for_each(|(prior, _)| *prior = 0.0);
        for a in apart(positions, &priors, (STEP * extent).max(STEP_SPACINGS * spacing), inside) {
            if !is_seen(a) {
                priors[a] = 0.0;
            }
        }
        let mut shares =
            Shares { object: Vec::with_capacity(self.all.len()), seen: Vec::with_capacity(self.all.len()) };
        for (a, prior) in priors.into_iter().enumerate() {
            let seen = is_seen(a);
            for g in a * offsets..(a + 1) * offsets {
                let share = (self.inside[g] + PRIOR * prior) / (self.all[g] + PRIOR);
                shares.object.push(share.clamp(0.0, 1.0));
                shares.seen.push(seen);
            }
        }
        shares
    }

    /// `[anchor]` whether it is of what is seen through the object's gaps, or beside it where the masks are too wide: a small piece of what
    /// they cover that is apart from the rest, and behind it in all masked views that show it.
    pub fn behind(&self, positions: &[[f32; 3]]) -> Vec<bool> {
        let offsets = self.all.len() / positions.len().max(1);
        let of = |votes: &[f32], a: usize| votes[a * offsets..(a + 1) * offsets].iter().sum::<f32>();
        let covered: Vec<usize> = (0..positions.len())
            .filter(|a| {
                let all = of(&self.all, *a);
                all > SEEN && of(&self.inside, *a) > OBJECT * all
            })
            .collect();
        let votes = |piece: &[usize]| piece.iter().map(|a| of(&self.inside, *a)).sum::<f32>();
        let points = |piece: &[usize]| -> Vec<DVec3> { piece.iter().map(|a| point(positions[*a])).collect() };
        let apart = |side: f32| {
            let mut pieces = pieces(positions, &covered, side);
            pieces.sort_by(|a, b| votes(b).total_cmp(&votes(a)));
            let extent = pieces.first().and_then(|main| plane::ball(&points(main))).map(|(_, radius)| 2.0 * radius);
            (pieces, extent)
        };
        let mut found = vec![false; positions.len()];
        // What is behind makes the whole larger than the object is.
        let least = STEP_SPACINGS * spacing(positions);
        let Some(extent) = apart(least).1 else { return found };
        let (pieces, Some(extent)) = apart(least.max(STEP * extent as f32)) else { return found };
        let main = points(&pieces[0]);
        for piece in pieces[1..].iter().filter(|piece| votes(piece) < SMALL * votes(&pieces[0])) {
            let own = points(piece);
            let shown = |camera: &&Camera| own.iter().any(|p| camera.within(p.to_array()).is_some());
            let is_behind = |camera: &Camera| {
                let far = |of: &[DVec3], share: f64| {
                    quantile(of.iter().map(|p| p.distance(DVec3::from(camera.center()))), share)
                };
                far(&own, NEAREST) > far(&main, 1.0 - NEAREST).map(|far| far + BEHIND * extent)
            };
            let mut shown = self.cameras.iter().filter(shown).peekable();
            if shown.peek().is_some() && shown.all(is_behind) {
                piece.iter().for_each(|a| found[*a] = true);
            }
        }
        found
    }

    /// The plane that the object stands on, and the height over it up to which what was not seen is no part of the object; nothing for what
    /// lies flat. The object lies within a radius around its middle.
    fn support(
        &self,
        object: &[DVec3],
        other: impl Iterator<Item = DVec3>,
        (middle, radius): (DVec3, f64),
    ) -> Option<(Support, f64)> {
        let some = |of: &[DVec3], most: usize| -> Vec<DVec3> {
            of.iter().step_by(of.len().div_ceil(most).max(1)).copied().collect()
        };
        let near: Vec<DVec3> = other.filter(|p| p.distance(middle) <= 4.0 * radius).collect();
        let (around, object) = (some(&near, PLACES[1]), some(object, PLACES[0]));
        let support = plane::find(&around, &object, up::estimate(&self.cameras), 0)?;
        let height = UNDERFOOT * radius;
        // What is low around it, most of which is a plane's: a back or a cushion is none.
        let low = near.iter().map(|p| support.local(*p));
        let (mut on, mut all) = (0, 0);
        for local in low.filter(|p| p.z.abs() < LOW * radius && p.truncate().length() < AROUND * radius) {
            all += 1;
            on += i32::from(local.z.abs() < height);
        }
        (support.height > 4.0 * height && f64::from(on) > FLAT * f64::from(all)).then_some((support, height))
    }
}

fn point(at: [f32; 3]) -> DVec3 {
    DVec3::from(at.map(f64::from))
}

/// Pieces of these anchors that hang together: those in neighbouring cells of this side do.
fn pieces(positions: &[[f32; 3]], of: &[usize], side: f32) -> Vec<Vec<usize>> {
    let cell =
        |a: usize| -> [i64; 3] { std::array::from_fn(|k| (positions[a][k] / side).floor().clamp(-1e9, 1e9) as i64) };
    let mut cells: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    of.iter().for_each(|a| cells.entry(cell(*a)).or_default().push(*a));
    let mut found = vec![];
    for a in of {
        let mut piece = vec![];
        let mut open: Vec<[i64; 3]> = vec![cell(*a)];
        while let Some([x, y, z]) = open.pop() {
            let Some(own) = cells.remove(&[x, y, z]) else { continue };
            piece.extend(own);
            let around =
                (-1..=1).flat_map(|dz| (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| [x + dx, y + dy, z + dz])));
            open.extend(around.filter(|cell| cells.contains_key(cell)));
        }
        found.extend((!piece.is_empty()).then_some(piece));
    }
    found
}

/// Anchors of which more than [`OBJECT`] is the object, by `priors`, in pieces that do not hang together with what was seen of it:
/// `inside` are an anchor's votes for the object, none where it was not seen; those in neighbouring cells of this `side` hang together.
fn apart(positions: &[[f32; 3]], priors: &[f32], side: f32, inside: impl Fn(usize) -> f32) -> Vec<usize> {
    let object: Vec<usize> = (0..positions.len()).filter(|a| priors[*a] > OBJECT).collect();
    let votes = |of: &[usize]| of.iter().map(|a| inside(*a)).sum::<f32>();
    let all = votes(&object);
    let pieces = pieces(positions, &object, side).into_iter();
    pieces.filter(|piece| votes(piece) < ATTACHED * all).flatten().collect()
}

/// Median distance of some anchors to the next.
fn spacing(positions: &[[f32; 3]]) -> f32 {
    let Some(two) = std::num::NonZero::new(2).filter(|_| positions.len() > 1) else { return 1.0 };
    let tree: ImmutableKdTree<f32, 3> = ImmutableKdTree::new_from_slice(positions);
    let some = positions.iter().step_by(positions.len().div_ceil(1000));
    let distances = some.filter_map(|p| tree.nearest_n::<SquaredEuclidean>(p, two).last().map(|n| n.distance.sqrt()));
    median(distances).map_or(1.0, |median| median as f32).max(f32::MIN_POSITIVE)
}

/// The anchors' mean colours, from some views; grey where none has an anchor.
///
/// # Errors
/// When the device has no room, or is lost.
pub fn colors(splats: &mut Splats, views: &[View]) -> Result<Vec<[f32; 3]>, Error> {
    let offsets = splats.offsets();
    let mut sums = vec![[0f32; 4]; splats.len() / offsets];
    for view in views.iter().step_by(views.len().div_ceil(COLORED).max(1)) {
        for (name, color) in splats.colors(&view.camera)? {
            let sum = &mut sums[name as usize / offsets];
            (0..3).for_each(|c| sum[c] += color[c]);
            sum[3] += 1.0;
        }
    }
    Ok(sums.into_iter().map(|s| if s[3] > 0.0 { std::array::from_fn(|c| s[c] / s[3]) } else { [0.5; 3] }).collect())
}

/// `[pixel]` of a view the part of what covers it that is of these anchors.
///
/// # Errors
/// When the device has no room, or is lost.
pub fn part_of(splats: &mut Splats, camera: &Camera, anchors: &[bool]) -> Result<Vec<f32>, Error> {
    let offsets = splats.offsets();
    let drawn = splats.paint(camera, |name, _| Some([f32::from(anchors[name as usize / offsets]), 0.0, 0.0]))?;
    Ok(of_cover(&drawn, 0))
}

/// `[pixel]` a channel of what covers it.
fn of_cover(drawn: &Rendered, channel: usize) -> Vec<f32> {
    let covered = drawn.transmittance.iter().map(|left| 1.0 - left);
    let parts = drawn.rgb.iter().zip(covered);
    parts.map(|(rgb, covered)| if covered < COVERED { 0.0 } else { rgb[channel] / covered }).collect()
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
        Ok(Carried { object: of_cover(&drawn, 0), evidence: of_cover(&drawn, 1) })
    }
}

impl Carried {
    /// `[pixel]` the object's part, as far as the masked views know: a half where they do not.
    pub fn believed(&self) -> Vec<f32> {
        self.object.iter().zip(&self.evidence).map(|(object, evidence)| 0.5 + evidence * (object - 0.5)).collect()
    }

    /// Which part of the object's pixels the masked views have not seen; nothing where the object is out of view.
    pub fn thinness(&self) -> Option<f64> {
        let object = || self.object.iter().zip(&self.evidence).filter(|(object, _)| **object > 0.5);
        let unseen = object().filter(|(_, evidence)| **evidence < 0.5).count();
        let all = object().count();
        (all > 0).then(|| unseen as f64 / all as f64)
    }
}

/// The mask where more than the part `least` of a pixel is the object: `parts` (width, height `from`) brought to the size
/// `to`.
pub fn threshold(parts: &[f32], from: [u32; 2], to: [u32; 2], least: f32) -> GrayImage {
    let large = resample::map(parts, from, to);
    GrayImage::from_fn(to[0], to[1], |x, y| Luma([if large[(y * to[0] + x) as usize] > least { 255 } else { 0 }]))
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
    let least = share * sizes.iter().copied().max().unwrap_or(0) as f64;
    let raw = label.iter().map(|l| if *l != 0 && sizes[*l] as f64 >= least { 255 } else { 0 }).collect();
    GrayImage::from_raw(mask.width(), mask.height(), raw).expect("a value per pixel")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use crate::model::gaussians::Cloud;
    use crate::model::stored::Stored;
    use crate::render::Config;

    fn mask(rows: &[&str]) -> GrayImage {
        let (w, h) = (rows[0].len() as u32, rows.len() as u32);
        GrayImage::from_fn(w, h, |x, y| Luma([if rows[y as usize].as_bytes()[x as usize] == b'#' { 255 } else { 0 }]))
    }

    /// In the world's origin; at z = 2 it shows x and y from -1 to 1.
    fn camera() -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [64.0; 2],
            principal: [32.0; 2],
            distortion: [0.0; 4],
            size: [64; 2],
        }
    }

    #[test]
    fn specks_go_and_pieces_stay() {
        let found = without_specks(&mask(&["###...", "###..#", ".....#", "#....#"]), 0.3);
        // Six, three (half of six) and one, which is less than 0.3 of six.
        assert_eq!(found, mask(&["###...", "###..#", ".....#", ".....#"]));
        assert_eq!(without_specks(&mask(&["..."]), 0.5), mask(&["..."]));
    }

    #[test]
    fn sizes_change_by_area_and_back() {
        let large = mask(&["##..", "##..", "#...", "...."]);
        let small = parts(&large, [2, 2]);
        assert_eq!(small, [1.0, 0.0, 0.25, 0.0]);
        assert_eq!(threshold(&small, [2, 2], [2, 2], 0.5), mask(&["#.", ".."]));
    }

    /// An object that lets a tenth of what is behind it through, something small right behind it, and something beside it.
    #[test]
    fn what_shines_through_the_object_has_no_vote() {
        let cloud = Cloud {
            position: vec![[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [1.0, 0.0, 4.0]],
            log_scale: vec![[0.1f32.ln(); 3], [0.05f32.ln(); 3], [0.05f32.ln(); 3]],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            logit: vec![9f32.ln(); 3],
            harmonics: vec![[0.0; 3]; 3],
            ..Cloud::default()
        };
        let camera = camera();
        let mut splats = Splats::new(&testing::gpu(), &Stored::Gaussians(cloud), &Config::default()).expect("room");
        let inside = |i: u32| f32::from(u8::from((i % 64u32).abs_diff(32) < 8 && (i / 64).abs_diff(32) < 8));
        let mut votes = Votes::new(&splats);
        votes.add(&mut splats, &camera, &(0..64 * 64).map(inside).collect::<Vec<_>>()).expect("room");
        assert!(votes.all[0] > 10.0 && votes.inside[0] > 0.9 * votes.all[0], "{:?}", votes.inside);
        assert_eq!((votes.inside[1], votes.all[1]), (0.0, 0.0));
        assert!(votes.all[2] > 1.0 && votes.inside[2] == 0.0, "{:?}", votes.all);
    }

    /// Four anchors of two Gaussians each: inside, outside, and two that were not seen, as near to the one as to the other,
    /// but of their colours.
    #[test]
    fn votes_are_counted_by_gaussian_anchor_and_likeness() {
        let votes = Votes {
            inside: vec![20.0, 0.0, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0],
            all: vec![20.0, 0.0, 19.0, 1.0, 0.0, 0.2, 0.0, 0.0],
            cameras: vec![],
        };
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.5, 0.1, 0.0], [0.5, -0.1, 0.0]];
        let (red, grey) = ([0.8, 0.2, 0.1], [0.5; 3]);
        let shares = votes.count(&positions, &[red, grey, grey, red]);
        let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
        assert!(near(shares.object[0], 1.0) && near(shares.object[1], 1.0));
        // (0 + 0.05) / 20 and (1 + 0.05) / 2, with the anchor's 1 / 20 as a vote of one pixel.
        assert!(near(shares.object[2], 0.0025) && near(shares.object[3], 0.525));
        // With two seen anchors only, both are asked: half of each.
        assert!(near(shares.object[6], 0.525));
        assert_eq!(shares.seen, [true, true, true, true, false, false, false, false]);
        // Nobody was seen at all.
        let votes = Votes { inside: vec![0.0; 2], all: vec![0.0; 2], cameras: vec![] };
        assert_eq!(votes.count(&[[0.0; 3]], &[grey]).object, [0.0; 2]);
    }

    /// Among many seen anchors of two colours, one that was not seen follows those of its own colour.
    #[test]
    fn unseen_anchors_follow_their_like() {
        let n = 40;
        let positions: Vec<[f32; 3]> = (0..n).map(|i| [(i / 2) as f32 * 0.1, (i % 2) as f32 * 0.05, 0.0]).collect();
        let colors: Vec<[f32; 3]> = (0..n).map(|i| if i % 2 == 0 { [0.8, 0.2, 0.1] } else { [0.5; 3] }).collect();
        let mut votes = Votes { inside: vec![0.0; n], all: vec![10.0; n], cameras: vec![] };
        (0..n).step_by(2).for_each(|i| votes.inside[i] = 10.0);
        for unseen in [20, 21] {
            (votes.inside[unseen], votes.all[unseen]) = (0.0, 0.0);
        }
        let shares = votes.count(&positions, &colors);
        assert_eq!((shares.object[20], shares.object[21]), (1.0, 0.0));
    }

    /// A row of red things of which one end was seen inside a mask, a floor seen beside it, and red things far away, which are nearer in
    /// likeness to the object than to anything else: no view has seen them, and they are none of it. The row's other end is.
    #[test]
    fn what_looks_like_the_object_elsewhere_is_none_of_it() {
        let (red, grey) = ([0.8, 0.2, 0.1], [0.5; 3]);
        let row = (0..20).map(|i| ([i as f32 * 0.05, 0.0, 0.0], red, i < 10));
        let floor = (0..20).map(|i| ([i as f32 * 0.05, 0.1, 0.0], grey, true));
        let bench = (0..20).map(|i| ([i as f32 * 0.05, 0.0, 4.0], red, false));
        let all: Vec<_> = row.chain(floor).chain(bench).collect();
        let positions: Vec<[f32; 3]> = all.iter().map(|of| of.0).collect();
        let colors: Vec<[f32; 3]> = all.iter().map(|of| of.1).collect();
        let votes = |kind: bool| all.iter().map(|of| if of.2 && (kind || of.1 == red) { 10.0 } else { 0.0 }).collect();
        let shares = Votes { inside: votes(false), all: votes(true), cameras: vec![] }.count(&positions, &colors);
        assert!(shares.object[..20].iter().all(|share| *share > 0.9), "{:?}", shares.object);
        assert!(shares.object[20..].iter().all(|share| *share < 0.1), "{:?}", shares.object);
    }

    /// A row of red things that the picture's border cuts, and a grey floor of which the picture shows a part far from them: what of it lies
    /// beyond the border is nearer to the red things than to that part, and hangs together with them.
    #[test]
    fn beyond_the_border_there_is_little_of_the_object() {
        let (red, grey) = ([0.8, 0.2, 0.1], [0.5; 3]);
        let line = |from: i32, to: i32, y: f32| (from..to).map(move |i| [i as f32 * 0.05, y, 2.0]);
        let row = line(10, 40, 0.0).map(|at| (at, red));
        let floor = line(-19, -10, 0.1).chain(line(22, 80, 0.1)).map(|at| (at, grey));
        let all: Vec<_> = row.chain(floor).collect();
        let positions: Vec<[f32; 3]> = all.iter().map(|of| of.0).collect();
        let colors: Vec<[f32; 3]> = all.iter().map(|of| of.1).collect();
        let votes = |kind: bool| -> Vec<f32> {
            all.iter().map(|(at, color)| if at[0] < 0.99 && (kind || *color == red) { 10.0 } else { 0.0 }).collect()
        };
        let of =
            |cameras: Vec<Camera>| Votes { inside: votes(false), all: votes(true), cameras }.count(&positions, &colors);
        let floor = |shares: &Shares| (30..all.len()).filter(|a| shares.object[*a] > OBJECT).count();
        assert!(floor(&of(vec![])) > 30, "the case is too easy");
        let shares = of(vec![camera()]);
        assert_eq!(floor(&shares), 0);
        // Ten are seen, and the picture's border cuts what is as long again by a half.
        assert!(shares.object[..14].iter().all(|share| *share > 0.9), "{:?}", &shares.object[..30]);
    }

    /// Place and colour of an anchor, and whether the masked view has seen it.
    type Anchor = ([f32; 3], [f32; 3], bool);

    /// The colour of an object.
    const DARK: [f32; 3] = [0.2, 0.2, 0.25];

    /// A block of so many anchors along each axis.
    fn grid(n: [i32; 3], from: [f32; 3], color: [f32; 3], seen: bool) -> impl Iterator<Item = Anchor> {
        (0..n.iter().product()).map(move |i| {
            let at = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]];
            (std::array::from_fn(|k| from[k] + 0.05 * at[k] as f32), color, seen)
        })
    }

    /// `[anchor]` whether it is the object, by one view whose mask has all of [`DARK`] that it has seen.
    fn objects(all: &[Anchor]) -> Vec<bool> {
        let votes = |kind: bool| -> Vec<f32> {
            all.iter().map(|of| if of.2 && (kind || of.1 == DARK) { 10.0 } else { 0.0 }).collect()
        };
        let votes = Votes { inside: votes(false), all: votes(true), cameras: vec![camera()] };
        let [positions, colors] =
            [|of: &Anchor| of.0, |of: &Anchor| of.1].map(|of| all.iter().map(of).collect::<Vec<_>>());
        votes.count(&positions, &colors).object.into_iter().map(|share| share > OBJECT).collect()
    }

    /// A dark box on a grey floor, in its shadow behind it a piece of the floor as dark as the box that no masked view has seen: it is
    /// the floor. At half of the box's height it would be the object; below the floor nothing is.
    #[test]
    fn what_it_stands_on_is_none_of_the_object() {
        let grey = [0.6; 3];
        let behind = |height: f32| {
            let object = grid([8, 8, 4], [-0.2, 0.0, 2.0], DARK, true);
            let floor = grid([40, 1, 10], [-1.0, 0.4, 1.5], grey, true);
            let shadow = grid([8, 1, 6], [-0.2, 0.4 - height, 2.2], DARK, false);
            let all: Vec<_> = object.chain(floor).chain(shadow).collect();
            let found = objects(&all).into_iter().zip(&all).filter(|(object, _)| *object);
            found.fold([0; 2], |[seen, not], (_, of)| if of.2 { [seen + 1, not] } else { [seen, not + 1] })
        };
        assert_eq!([behind(0.0), behind(0.2), behind(-0.1)], [[256, 0], [256, 48], [256, 0]]);
    }

    /// A dark box on a table that is hardly larger, whose grey cloth hangs down on three sides. What no masked view has seen of the cloth, on
    /// the far side, is dark: it is none of the object, neither on the table nor below its edge.
    #[test]
    fn the_cloth_of_a_small_table_is_none_of_the_object() {
        let (dark, grey) = (DARK, [0.6; 3]);
        let object = grid([8, 8, 4], [-0.2, 0.0, 2.0], dark, true);
        let top = grid([16, 1, 6], [-0.4, 0.4, 1.9], grey, true);
        let front = grid([16, 3, 2], [-0.4, 0.45, 1.8], grey, true);
        let sides = [-0.5, 0.4].into_iter().flat_map(|x| grid([2, 3, 8], [x, 0.45, 1.9], grey, true));
        let unseen =
            grid([8, 1, 4], [-0.2, 0.4, 2.2], dark, false).chain(grid([8, 6, 1], [-0.2, 0.45, 2.35], dark, false));
        let all: Vec<_> = object.chain(top).chain(front).chain(sides).chain(unseen).collect();
        let object = objects(&all);
        let taken = (0..all.len()).filter(|a| object[*a] && !all[*a].2).count();
        assert_eq!(taken, 0, "of 80");
        assert!((0..256).all(|a| object[a]));
    }

    /// A dark box on a cloth. Its far side, which no masked view has seen, is of the cloth's colour, but rises from it: it is the object.
    #[test]
    fn what_rises_from_the_cloth_is_the_object() {
        let (dark, cloth) = (DARK, [0.3, 0.2, 0.3]);
        let object = grid([8, 8, 4], [-0.2, 0.0, 2.0], dark, true);
        let top = grid([40, 1, 10], [-1.0, 0.4, 1.6], cloth, true);
        let unseen =
            grid([8, 8, 1], [-0.2, 0.0, 2.2], cloth, false).chain(grid([8, 1, 1], [-0.2, 0.4, 2.2], cloth, false));
        let all: Vec<_> = object.chain(top).chain(unseen).collect();
        let object = objects(&all);
        let taken: Vec<usize> = (656..all.len()).filter(|a| object[*a]).collect();
        assert_eq!(taken, (656..720).collect::<Vec<_>>(), "its side, and not its foot");
    }

    /// A piece behind the object, seen through its gaps, is none of it. One beside it may be of it, and one that has as much of the mask.
    #[test]
    fn what_is_seen_through_gaps_is_behind() {
        let square = |x: f32, z: f32, side: usize| {
            let at = move |i: usize| [x + 0.05 * (i % side) as f32, 0.05 * (i / side) as f32 - 0.2, z];
            (0..side * side).map(at).collect::<Vec<_>>()
        };
        for (aside, deep, votes, is_behind) in
            [(0.0, 4.0, 1.0, true), (0.0, 2.2, 1.0, false), (1.0, 2.0, 1.0, false), (0.0, 4.0, 50.0, false)]
        {
            let (object, piece) = (square(0.0, 2.0, 8), square(aside, deep, 3));
            let places = [object.as_slice(), &piece].concat();
            let inside: Vec<f32> =
                (0..places.len()).map(|a| if a < object.len() { 9.0 } else { 9.0 * votes }).collect();
            let votes = Votes { all: inside.clone(), inside, cameras: vec![camera()] };
            let behind = votes.behind(&places);
            assert!(behind[..object.len()].iter().all(|behind| !behind), "{aside} {deep}");
            assert!(behind[object.len()..].iter().all(|behind| *behind == is_behind), "{aside} {deep}");
        }
    }
}

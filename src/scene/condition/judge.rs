//! Pixels around the masks held against the other views.
//!
//! A mask that is too tight, an antialiased edge and a reflection leave pixels of the object outside the mask. Other views
//! see the place behind such a pixel past the object, and show another colour there. A shadow that lies still is the same in
//! all views and cannot be found so.
//!
//! A pixel is suspect where its colour is far from what other views agree on. Of pixels that show the object a share p is
//! suspect, of others a share b, and of those at distance d from the masks s(d), a mixture: the share
//! `c(d) = (s(d) - b) / (p - b)` of them shows the object. The masks' own pixels tell p, and those further away b.

use image::{GrayImage, RgbImage};
use rayon::prelude::*;

use super::reference::Surroundings;
use crate::scene::{Camera, Scene, View, resample};
use crate::statistics::{deviation, median};

/// How far beyond a mask is looked, as a share of the picture's longer side.
const REACH: f64 = 0.025;
/// Fewest other views that tell of a pixel.
const FEWEST: usize = 4;
/// So many at most tell, the nearest first ...
const MOST: usize = 16;
/// ... of so many at most that are asked, evenly from near to far: neighbours in a film all have the object in one place.
const ASKED: usize = 64;
/// Standard deviations from the other views' median from which on a pixel is suspect, and surely something else.
const SUSPECT: f64 = 2.0;
const SURE: f64 = 4.0;
/// Least standard deviation, 8-bit levels: what compression makes of a smooth surface.
const LEAST: f64 = 3.0;
/// Fewest pixels that tell a share: to 0.07, a standard deviation.
const PIXELS: usize = 50;
/// An object that is less often suspect than its surroundings and this looks like them: nothing is told.
const APART: f64 = 0.1;
/// A share that is taken for none: beside right masks the built-in scene has up to 0.13 and spin-1 0.17, where depth guessed
/// from points is wrong near the object's edge.
const NONE: f64 = 0.2;
/// An inpainted picture that differs by less (8-bit, mean over channels) from the photograph still shows what that shows.
const REPAINTED: u32 = 8;

/// What is around the train masks.
pub(super) struct Rims {
    /// Share of the pixels at distance 1, 2, ... from the masks that show the object, up to the first distance where none does.
    pub shares: Vec<f64>,
    /// How much each pixel is to be left out, `[view][row-major pixel]`, 0 to 255: 0 in the mask itself and beyond the reach.
    /// On the view of an inpainted picture 0 where that is the photograph. Empty where nothing is told.
    pub values: Vec<Vec<u8>>,
}

/// Pixels of one view: how far from its mask (0 and less: inside), and how many standard deviations off.
struct Judged {
    pixel: u32,
    distance: i32,
    score: f32,
}

/// Holds what is around the train masks against the other views.
pub(super) fn rims(scene: &Scene) -> Rims {
    let masks: Vec<Option<&GrayImage>> =
        scene.train.iter().map(|v| v.mask.as_ref().filter(|mask| mask.as_raw().iter().any(|m| *m != 0))).collect();
    let wide: Vec<Option<GrayImage>> = (scene.train.par_iter().zip(&masks))
        .map(|(view, mask)| Some(resample::dilate((*mask)?, reach(view))))
        .collect();
    let judged = |at: usize| match masks[at] {
        Some(mask) if scene.references.iter().all(|r| r.view != at || !r.truth) => judge(scene, at, mask, &wide),
        _ => None,
    };
    let views: Vec<Option<Vec<Judged>>> = (0..scene.train.len()).into_par_iter().map(judged).collect();
    let shares = shares(views.iter().flatten(), scene.train.iter().map(reach).max().unwrap_or(0));
    let values = |(at, pixels): (usize, &Option<Vec<Judged>>)| {
        let truth = scene.references.iter().any(|r| r.view == at && r.truth);
        let Some(mask) = masks[at].filter(|_| !truth && (pixels.is_some() || !shares.is_empty())) else {
            return vec![];
        };
        let reach = reach(&scene.train[at]);
        let mut values = vec![0; mask.as_raw().len()];
        // Single pixels are told by chance, too: they count where masks, or this one, are too tight on the whole. Around the
        // built-in scene's right masks they cost 0.2 dB in the hole.
        let told = !shares.is_empty() || !self::shares(pixels.iter(), reach).is_empty();
        let around = |j: &&Judged| told && (1..=reach as i32).contains(&j.distance);
        for judged in pixels.iter().flatten().filter(around) {
            let own = ((f64::from(judged.score) - SUSPECT) / (SURE - SUSPECT)).clamp(0.0, 1.0);
            values[judged.pixel as usize] = (255.0 * own).round() as u8;
        }
        let mut values = connected(mask, values);
        // Where a half shows the object nothing is trained on, and in proportion where it is less.
        let distances = resample::distances(mask, shares.len() as u32);
        for (value, distance) in values.iter_mut().zip(distances).filter(|(_, d)| *d > 0) {
            let share = shares.get(distance as usize - 1).copied().unwrap_or(0.0);
            *value = (*value).max((255.0 * (2.0 * share).min(1.0)).round() as u8);
        }
        for reference in scene.references.iter().filter(|r| r.view == at) {
            let pixels = reference.image.pixels().zip(scene.train[at].image.pixels());
            let apart = pixels.map(|(p, q)| p.0.iter().zip(q.0).map(|(p, q)| u32::from(p.abs_diff(q))).sum::<u32>());
            values.iter_mut().zip(apart).filter(|(_, a)| *a < 3 * REPAINTED).for_each(|(value, _)| *value = 0);
        }
        values
    };
    let values = views.iter().enumerate().collect::<Vec<_>>().into_par_iter().map(values).collect();
    Rims { shares, values }
}

/// See the module: c(1), c(2), ... up to the first that is none.
fn shares<'a>(views: impl Iterator<Item = &'a Vec<Judged>>, reach: u32) -> Vec<f64> {
    // Pixels and suspect ones, inside, at each distance, and beyond.
    let (mut inside, mut beyond, mut at) = ([0; 2], [0; 2], vec![[0; 2]; reach as usize]);
    for judged in views.flatten() {
        let to = match judged.distance {
            ..=0 => &mut inside,
            d if d <= reach as i32 => &mut at[d as usize - 1],
            _ => &mut beyond,
        };
        to[0] += 1;
        to[1] += usize::from(f64::from(judged.score) > SUSPECT);
    }
    let share = |[all, suspect]: [usize; 2]| (all >= PIXELS).then(|| suspect as f64 / all as f64);
    let Some(rest) = share(beyond) else { return vec![] };
    // Where no view sees past the object's middle: as if it were suspect everywhere, which makes the shares small.
    let object = share(inside).unwrap_or(1.0);
    if object - rest < APART {
        return vec![];
    }
    let mixed = |counts: [usize; 2]| share(counts).map(|s| ((s - rest) / (object - rest)).clamp(0.0, 1.0));
    at.into_iter().map_while(|counts| mixed(counts).filter(|share| *share >= NONE)).collect()
}

fn reach(view: &View) -> u32 {
    let [w, h] = view.camera.size;
    (REACH * f64::from(w.max(h))).ceil() as u32
}

/// One view's pixels: in the mask as far from its edge as around it, and as wide a band beyond that tells what is usual.
/// `None` where the points around the mask tell no depth.
fn judge(scene: &Scene, at: usize, mask: &GrayImage, wide: &[Option<GrayImage>]) -> Option<Vec<Judged>> {
    let view = &scene.train[at];
    let reach = reach(view) as i32;
    let surroundings = Surroundings::new(&view.camera, &view.image, &scene.points, Some(mask))?;
    let others = nearest_views(scene, at, wide);
    // What only tells shares does so with a part of the pixels where there are many.
    let width = mask.width() as usize;
    let step = (reach as usize).div_ceil(8);
    let counted = |pixel: usize| (pixel % width).is_multiple_of(step) && (pixel / width).is_multiple_of(step);
    let mut outside = mask.clone();
    outside.iter_mut().for_each(|m| *m = if *m == 0 { 255 } else { 0 });
    let distances: Vec<(usize, i32)> = resample::distances(mask, 2 * reach as u32)
        .into_iter()
        .zip(resample::distances(&outside, reach as u32))
        .map(|(out, within)| if out > 0 { out as i32 } else { 1 - within as i32 })
        .enumerate()
        .filter(|(pixel, d)| (1..=reach).contains(d) || (-reach < *d && *d <= 2 * reach && counted(*pixel)))
        .collect();
    let depths = Depths::new(&surroundings, view.camera.size, distances.iter().map(|(pixel, _)| *pixel));
    let off = |&(pixel, distance): &(usize, i32)| {
        let place = view.camera.lift(view.camera.pixel_center(pixel), depths.at(pixel))?;
        let seen = consensus(&others, place)?;
        let color = &view.image.as_raw()[3 * pixel..3 * pixel + 3];
        let off: [[f64; 2]; 3] = std::array::from_fn(|c| [f64::from(color[c]) - seen[c][0], seen[c][1]]);
        Some((pixel, distance, off))
    };
    let off: Vec<(usize, i32, [[f64; 2]; 3])> = distances.par_iter().filter_map(off).collect();
    let usual: Vec<[[f64; 2]; 3]> = off.iter().filter(|(_, d, _)| *d > reach).map(|(.., off)| *off).collect();
    if usual.len() < FEWEST {
        return None;
    }
    let usual: [[f64; 2]; 3] = std::array::from_fn(|c| median_and_deviation(usual.iter().map(|off| off[c][0])));
    let score = |(pixel, distance, off): (usize, i32, [[f64; 2]; 3])| {
        let squares = off
            .iter()
            .zip(usual)
            .map(|([off, spread], [bias, noise])| ((off - bias) / spread.max(noise).max(LEAST)).powi(2));
        Judged { pixel: pixel as u32, distance, score: (squares.sum::<f64>() / 3.0).sqrt() as f32 }
    };
    Some(off.into_iter().map(score).collect())
}

/// Depths guessed for blocks of pixels, 128 in the picture's width: between them a surface hardly moves.
struct Depths {
    width: usize,
    block: usize,
    /// Of the blocks asked for.
    values: Vec<Option<f64>>,
}

impl Depths {
    fn new(surroundings: &Surroundings, [w, h]: [u32; 2], pixels: impl Iterator<Item = usize>) -> Depths {
        let (width, height) = (w as usize, h as usize);
        let block = width.div_ceil(128);
        let mut depths = Depths { width, block, values: vec![] };
        let columns = width.div_ceil(block);
        let mut asked = vec![false; columns * height.div_ceil(block)];
        pixels.for_each(|pixel| asked[depths.index(pixel)] = true);
        let depth = |(index, asked): (usize, bool)| {
            let middle = |i: usize, size: usize| (i * block + block / 2).min(size - 1);
            let pixel = middle(index / columns, height) * width + middle(index % columns, width);
            asked.then(|| surroundings.depth(pixel))
        };
        depths.values = asked.into_par_iter().enumerate().map(depth).collect();
        depths
    }

    fn index(&self, pixel: usize) -> usize {
        pixel / self.width / self.block * self.width.div_ceil(self.block) + pixel % self.width / self.block
    }

    fn at(&self, pixel: usize) -> f64 {
        self.values[self.index(pixel)].unwrap_or(f64::NAN)
    }
}

/// The other views with their pictures and masks with a margin, the nearest first. One without mask may show the object
/// anywhere; in one with an empty mask it is out of view.
fn nearest_views<'a>(
    scene: &'a Scene,
    at: usize,
    wide: &'a [Option<GrayImage>],
) -> Vec<(&'a Camera, &'a RgbImage, Option<&'a GrayImage>)> {
    let center = scene.train[at].camera.center();
    let apart = |camera: &Camera| -> f64 { camera.center().iter().zip(center).map(|(a, b)| (a - b).powi(2)).sum() };
    let mut others: Vec<(f64, usize)> = (0..scene.train.len())
        .filter(|other| *other != at && scene.train[*other].mask.is_some())
        .map(|other| (apart(&scene.train[other].camera), other))
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let step = others.len().div_ceil(ASKED).max(1);
    let view = |(_, other): &(f64, usize)| {
        let view = &scene.train[*other];
        (&view.camera, &view.image, wide[*other].as_ref())
    };
    others.iter().step_by(step).map(view).collect()
}

/// Per channel the median colour of a place in the views that see it past their masks, and the deviation.
fn consensus(others: &[(&Camera, &RgbImage, Option<&GrayImage>)], place: [f64; 3]) -> Option<[[f64; 2]; 3]> {
    let color = |(camera, image, mask): &(&Camera, &RgbImage, Option<&GrayImage>)| {
        let clear = mask.is_none_or(|mask| camera.pixel_of(place).is_some_and(|pixel| mask.as_raw()[pixel] == 0));
        camera.within(place).filter(|_| clear).map(|position| resample::color_at(image, position))
    };
    let colors: Vec<[f64; 3]> = others.iter().filter_map(color).take(MOST).collect();
    (colors.len() >= FEWEST).then(|| std::array::from_fn(|c| median_and_deviation(colors.iter().map(|color| color[c]))))
}

/// The median of at least one value, and the standard deviation that their median absolute deviation tells.
fn median_and_deviation(values: impl Iterator<Item = f64> + Clone) -> [f64; 2] {
    let median = median(values.clone()).expect("there are values");
    let deviation = deviation(values.map(|v| (v - median).abs())).expect("as many");
    [median, deviation]
}

/// What of the values above 0 hangs together with the mask, by sides or corners; the rest is another texture's.
fn connected(mask: &GrayImage, mut values: Vec<u8>) -> Vec<u8> {
    let [w, h] = [mask.width() as usize, mask.height() as usize];
    let mut reached: Vec<bool> = mask.as_raw().iter().map(|m| *m != 0).collect();
    let mut border: Vec<usize> = (0..w * h).filter(|pixel| reached[*pixel]).collect();
    while let Some(pixel) = border.pop() {
        let (x, y) = (pixel % w, pixel / w);
        for near_y in y.saturating_sub(1)..(y + 2).min(h) {
            for near_x in x.saturating_sub(1)..(x + 2).min(w) {
                let near = near_y * w + near_x;
                if !reached[near] && values[near] > 0 {
                    reached[near] = true;
                    border.push(near);
                }
            }
        }
    }
    values.iter_mut().zip(reached).filter(|(_, reached)| !reached).for_each(|(value, _)| *value = 0);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load, synthetic};

    /// The pixels that a mask loses when its edge moves inwards by so many.
    fn eroded(mask: &GrayImage, by: u32) -> GrayImage {
        let mut off = mask.clone();
        image::imageops::invert(&mut off);
        let mut off = resample::dilate(&off, by);
        image::imageops::invert(&mut off);
        off
    }

    /// The built-in scene, and the same with masks three pixels too tight.
    fn scenes(seed: u64) -> [Scene; 2] {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options { seed, ..Default::default() }).expect("a scene");
        let scene = load(&dir, &Config::default()).expect("it loads");
        let mut tight = scene.clone();
        for mask in tight.train.iter_mut().filter_map(|v| v.mask.as_mut()) {
            *mask = eroded(mask, 3);
        }
        super::super::points::drop_object(&mut tight);
        [scene, tight]
    }

    /// Of the pixels that are in one set of masks and not in the other, how many are left out (`[left out, all]`).
    fn left_out(found: &Rims, within: impl Fn(usize) -> GrayImage, without: impl Fn(usize) -> GrayImage) -> [usize; 2] {
        let mut counts = [0; 2];
        for (at, values) in found.values.iter().enumerate().filter(|(_, v)| !v.is_empty()) {
            let (within, without) = (within(at), without(at));
            for (pixel, value) in values.iter().enumerate() {
                if within.as_raw()[pixel] != 0 && without.as_raw()[pixel] == 0 {
                    counts[0] += usize::from(*value >= 128);
                    counts[1] += 1;
                }
            }
        }
        counts
    }

    #[test]
    fn what_a_tight_mask_leaves_of_the_object_is_found() {
        for seed in [0, 1, 2] {
            let [scene, mut tight] = scenes(seed);
            // Some views have no mask and show the object, and one is exposed otherwise, all over.
            (7..12).for_each(|at| tight.train[at].mask = None);
            tight.train[5].image.iter_mut().for_each(|v| *v = (f64::from(*v) * 0.8) as u8);
            let mask = |scene: &Scene, at: usize| scene.train[at].mask.clone().expect("a mask");
            let found = rims(&tight);
            assert_eq!(found.shares.len(), 3, "seed {seed}: {:?}", found.shares);
            let [left_out, all] = left_out(&found, |at| mask(&scene, at), |at| mask(&tight, at));
            assert!(all > 8000 && 20 * left_out > 19 * all, "seed {seed}: {left_out} of {all}");
        }
    }

    /// What is left of a shadow that was taken out around masks is none of the object.
    #[test]
    fn where_a_shadow_was_taken_out_nothing_is_judged() {
        let [_, tight] = scenes(0);
        for relit in [false, true] {
            let mut scene = Scene { relit, ..tight.clone() };
            super::super::condition(&mut scene, &Config::default());
            assert_eq!(scene.notes.iter().any(|note| note.contains("too tight")), !relit);
        }
    }

    #[test]
    fn right_masks_stay() {
        for seed in [0, 1, 2] {
            let [scene, _] = scenes(seed);
            let found = rims(&scene);
            assert!(found.shares.is_empty(), "seed {seed}: {:?}", found.shares);
            // A pixel at the edge may be mixed of both.
            let grown = |at: usize, by: u32| resample::dilate(scene.train[at].mask.as_ref().expect("a mask"), by);
            let [left_out, all] = left_out(&found, |at| grown(at, 4), |at| grown(at, 1));
            assert!(all > 8000 && 50 * left_out < all, "seed {seed}: {left_out} of {all}");
        }
    }

    /// The reference is the photograph around its hole: there is nothing to put in the place of what is left of the object.
    #[test]
    fn a_picture_that_is_the_photograph_around_its_hole_is_not_taken_there() {
        let [_, mut tight] = scenes(0);
        let at = tight.references[0].view;
        let repainted = rims(&tight).values[at].iter().filter(|v| **v > 0).count();
        assert!(repainted > 100, "{repainted}");
        let (photograph, mask) = (tight.train[at].image.clone(), tight.train[at].mask.clone().expect("a mask"));
        let pixels = tight.references[0].image.pixels_mut().zip(photograph.pixels()).zip(mask.as_raw());
        pixels.filter(|(_, m)| **m == 0).for_each(|((p, q), _)| *p = *q);
        assert!(rims(&tight).values[at].iter().all(|v| *v == 0));
        tight.references[0].truth = true;
        assert!(rims(&tight).values[at].is_empty());
    }

    #[test]
    fn a_scene_without_masks_or_points_tells_nothing() {
        let [scene, _] = scenes(0);
        let mut bare = scene.clone();
        bare.train.iter_mut().for_each(|v| v.mask = None);
        let found = rims(&bare);
        assert!(found.shares.is_empty() && found.values.iter().all(Vec::is_empty));
        let mut few = scene;
        few.points.truncate(5);
        let found = rims(&few);
        assert!(found.shares.is_empty() && found.values.iter().all(Vec::is_empty));
    }
}

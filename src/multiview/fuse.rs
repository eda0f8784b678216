//! From depths that views agree on to points.

use rayon::prelude::*;

use super::depth::Map;
use super::picture::Picture;
use crate::scene::Point;

/// Highest cost of a depth that counts: a correlation of 0.5.
const MOST_COST: f32 = 0.5;
/// A view agrees if its depth at the place, seen from the first view, is within so many pixels ...
const PIXELS: f64 = 1.0;
/// ... and within this share of the depth.
const SHARE: f64 = 0.02;
/// Views that must agree with a view, or all of fewer.
const AGREEING: usize = 2;
/// Depths within this share are of one surface, when a point is asked whether a view sees it.
pub(super) const SAME: f64 = 0.04;
/// A point nearer than what a view sees there by more than this share would hide it.
const BEFORE: f64 = 0.08;

/// Depth z of a view's sites that other views confirm, NaN elsewhere.
pub(super) type Surface = Vec<f64>;
/// Depth z of the sites of a view that are not confirmed, NaN elsewhere and where nothing around tells.
pub(super) type Filled = Vec<f64>;

/// Depth at a place in a picture, if it matches well there.
fn depth_at(picture: &Picture, map: &Map, pixel: [f64; 2]) -> Option<f64> {
    let site = picture.site(pixel).filter(|site| map.costs[*site] <= MOST_COST)?;
    let at = picture.pixel(site);
    let [w, wx, wy] = map.planes[site].map(f64::from);
    let inverse = w + wx * (pixel[0] - at[0]) + wy * (pixel[1] - at[1]);
    (inverse > 0.0).then(|| 1.0 / inverse)
}

/// What other views confirm of each view's depths: the mean over those that agree.
pub(super) fn confirm(pictures: &[Picture], neighbors: &[Vec<usize>], maps: &[Option<Map>]) -> Vec<Surface> {
    let confirmed = |at: usize| -> Surface {
        let picture = &pictures[at];
        let Some(map) = &maps[at] else { return vec![f64::NAN; picture.sites.len()] };
        let others: Vec<(&Picture, &Map)> =
            neighbors[at].iter().filter_map(|n| Some((&pictures[*n], maps[*n].as_ref()?))).collect();
        let needed = AGREEING.min(others.len()).max(1);
        let one = |site: usize| {
            let pixel = picture.pixel(site);
            let Some(depth) = depth_at(picture, map, pixel) else { return f64::NAN };
            let point = picture.lift(pixel, depth);
            let (mut sum, mut count) = (depth, 0);
            for (other, map) in &others {
                let Some((there, _)) = other.see(point) else { continue };
                let Some(far) = depth_at(other, map, there) else { continue };
                let Some((back, z)) = picture.see(other.lift(there, far)) else { continue };
                let apart = (back[0] - pixel[0]).hypot(back[1] - pixel[1]);
                if apart <= PIXELS && (z / depth - 1.0).abs() <= SHARE {
                    sum += z;
                    count += 1;
                }
            }
            if count >= needed { sum / (count + 1) as f64 } else { f64::NAN }
        };
        (0..picture.sites.len()).map(one).collect()
    };
    (0..pictures.len()).into_par_iter().map(confirmed).collect()
}

/// The points found so far, and where views see one already.
pub(super) struct Cloud<'a> {
    pictures: &'a [Picture],
    surfaces: &'a [Surface],
    /// `[view][site]`: a point of this depth is near.
    covered: Vec<Vec<bool>>,
    pub points: Vec<Point>,
}

impl<'a> Cloud<'a> {
    /// With what the sparse model's points cover.
    pub fn new(pictures: &'a [Picture], surfaces: &'a [Surface], sparse: &[Point]) -> Self {
        let covered = pictures.iter().map(|p| vec![false; p.sites.len()]).collect();
        let mut cloud = Self { pictures, surfaces, covered, points: vec![] };
        for point in sparse {
            cloud.cover(point.position.map(f64::from), false);
        }
        cloud
    }

    /// Marks the sites around a point in all views that see it. Where the depth is not known a point covers it only if it
    /// was put there because of that (`filled`).
    fn cover(&mut self, position: [f64; 3], filled: bool) {
        for ((picture, surface), covered) in self.pictures.iter().zip(self.surfaces).zip(&mut self.covered) {
            let Some((pixel, z)) = picture.see(position) else { continue };
            let Some(site) = picture.site(pixel) else { continue };
            let [x, y] = picture.sites.place(site);
            for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
                let Some(site) = picture.sites.at(x + dx, y + dy) else { continue };
                let known = surface[site];
                if if known.is_nan() { filled } else { (z / known - 1.0).abs() <= SAME } {
                    covered[site] = true;
                }
            }
        }
    }

    fn add(&mut self, view: usize, site: usize, depth: f64, filled: bool) {
        let picture = &self.pictures[view];
        let position = picture.lift(picture.pixel(site), depth);
        self.points.push(Point { position: position.map(|v| v as f32), color: picture.colors[site] });
        self.cover(position, filled);
    }

    /// Points at the confirmed depths that no earlier point covers.
    pub fn add_confirmed(&mut self) {
        for view in 0..self.pictures.len() {
            for site in 0..self.surfaces[view].len() {
                let depth = self.surfaces[view][site];
                if depth.is_finite() && self.pictures[view].shown[site] && !self.covered[view][site] {
                    self.add(view, site, depth, false);
                }
            }
        }
    }

    /// Points at depths taken from around, where no point is yet and none would hide what another view sees.
    pub fn add_filled(&mut self, filled: &[Filled]) {
        for (view, filled) in filled.iter().enumerate() {
            for (site, depth) in filled.iter().copied().enumerate() {
                if !depth.is_finite() || !self.pictures[view].shown[site] || self.covered[view][site] {
                    continue;
                }
                let position = self.pictures[view].lift(self.pictures[view].pixel(site), depth);
                let hides = self.pictures.iter().zip(self.surfaces).any(|(picture, surface)| {
                    let Some((pixel, z)) = picture.see(position) else { return false };
                    picture.site(pixel).is_some_and(|site| z < (1.0 - BEFORE) * surface[site])
                });
                if !hides {
                    self.add(view, site, depth, true);
                }
            }
        }
    }
}

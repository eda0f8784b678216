//! Bare surfaces lie on the planes around them.
//!
//! A bare floor matches everywhere, so that its measured depth is a guess, and what it continues is what happens to be beside
//! it. Around a hole the planes are known well, from joints and edges. Where the photographs look as much alike on a plane as
//! on the measured surface, the plane is taken: a surface must earn its being off the planes by what it looks like.

use glam::{DMat3, DVec2, DVec3};
use rand::RngExt;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::covered::{Cover, Covered, Points};
use super::surface::{SAME, Sight, Sights};
use super::window::Window;
use crate::prepare::planes::{self, Plane, neighbours};
use crate::scene::resample;
use crate::statistics::{median, quantile};

/// Views that a view is compared with at most.
const VIEWS: usize = 16;
/// Largest angle between their axes, radians.
const TURNED: f64 = 1.0;
/// Share of the views, those that differ least, that count: in the others something else may stand before it.
const ALIKE: f64 = 0.5;
/// Fewest views that tell something: of two the one that differs less is no witness.
const FEWEST: usize = 3;
/// Difference of colours, 8-bit levels in the mean of the channels, that costs as much as a border of one site.
pub const LEVELS: f64 = 2.0;
/// Most that a site costs, in these.
const MOST: f64 = 6.0;
/// Cost of a site beside the planes, in these.
const BESIDE: f64 = 2.0;
/// Cost of a plane where other views confirm a depth that does not lie on it.
const CONFIRMED: f64 = 1.5;
/// Cost of a plane for each [`SAME`] that it is off the measured depth, up to four times.
const NEAR: f64 = 0.05;
/// Cost of each plane above the one before it, which has more points.
pub const LATER: f64 = 0.3;
/// Largest relative difference between the measured depth and the plane's.
pub const FARTHEST: f64 = 0.25;
/// Sites by which the depths of two planes, `APART` of them, must be apart in other views for these to tell which it is.
const PARALLAX: f64 = 1.0;
const APART: f64 = 0.05;
/// Cost of a border per site of its length.
const BORDER: f64 = 0.5;

/// Points of each view that common planes are looked for among.
const POINTS: usize = 300;
/// Common planes that are looked for, and least part of the points that makes one.
const PLANES: usize = 6;
pub(super) const LEAST: f64 = 0.06;
/// Triples of points that are tried for each.
const TRIES: usize = 1500;
/// A point lies on a plane if it is off by at most this part of its camera's distance from the plane.
pub(super) const THICKNESS: f64 = 0.01;
/// Part of what is known around a hole that other views must confirm for the view's own planes to be looked for in that alone.
const SURE: f64 = 0.05;
/// Part of a view's own plane's points that lie within twice [`planes::THICKNESS`] of a common one for it to be the same.
const COMMON: f64 = 0.5;

/// A plane `normal . x = offset` of world points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Common {
    pub(super) normal: DVec3,
    pub(super) offset: f64,
}

/// The planes around a view's hole, what they are covered with, the sites that lie on one, and their depth there.
#[derive(Default)]
struct Flat {
    planes: Vec<Plane>,
    cover: Cover,
    sites: Vec<(usize, f64)>,
}

/// A point that a camera at `eye` sees.
#[derive(Clone, Copy)]
pub(super) struct Measured {
    pub(super) point: DVec3,
    pub(super) eye: DVec3,
}

impl Common {
    /// How far the plane is from the point along the camera's ray, as a part of the distance: nearer is positive.
    pub(super) fn off(&self, at: &Measured) -> f64 {
        (self.normal.dot(at.point) - self.offset) / (self.offset - self.normal.dot(at.eye))
    }

    /// Whether the point lies on the plane.
    pub(super) fn has(&self, at: &Measured) -> bool {
        self.off(at).abs() <= THICKNESS
    }

    fn through([a, b, c]: [DVec3; 3]) -> Option<Self> {
        let normal = (b - a).cross(c - a).try_normalize()?;
        Some(Self { normal, offset: normal.dot(a) })
    }

    /// The plane of least squares, relative to the distances.
    fn fitted(self, points: &[Measured]) -> Self {
        let origin = points[0].eye;
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for at in points {
            let from = at.point - origin;
            let row = from / (self.offset - self.normal.dot(at.eye));
            matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
            right += row / (self.offset - self.normal.dot(at.eye));
        }
        let p = matrix.inverse() * right;
        let length = p.length();
        if !p.is_finite() || length == 0.0 {
            return self;
        }
        let normal = p / length;
        Self { normal, offset: 1.0 / length + normal.dot(origin) }
    }

    /// Whether another plane is tilted against it by this sine at most, and off by this much at a point.
    pub(super) fn is(&self, other: &Self, at: DVec3, sine: f64, off: f64) -> bool {
        let away = |plane: &Self| plane.normal.dot(at) - plane.offset;
        self.normal.cross(other.normal).length() <= sine && (away(self).abs() - away(other).abs()).abs() <= off
    }

    /// A plane as a view sees it.
    pub(super) fn of(plane: &Plane, sight: &Sight) -> Self {
        let rotation = sight.grid.camera.rotation.map(|row| DVec3::from(row.map(f64::from)));
        let plane = DVec3::from(*plane);
        let turned = rotation[0] * plane.x + rotation[1] * plane.y + rotation[2] * plane.z;
        let (normal, distance) = (turned.normalize(), 1.0 / plane.length());
        Self { normal, offset: distance + normal.dot(sight.eye()) }
    }

    /// As a view sees it; nothing where its camera stands in it.
    pub(super) fn seen_by(&self, sight: &Sight) -> Option<Plane> {
        let camera = &sight.grid.camera;
        let distance = self.offset - self.normal.dot(DVec3::from(camera.center()));
        let turned = camera.rotation.map(|row| DVec3::from(row.map(f64::from)).dot(self.normal) / distance);
        turned.iter().all(|v| v.is_finite()).then_some(turned)
    }
}

/// The largest planes of so many of these points at least, the largest first.
pub(super) fn largest(mut points: Vec<Measured>, least: usize, rng: &mut Pcg64) -> Vec<Common> {
    let least = least.max(12);
    let mut found = vec![];
    while found.len() < PLANES && points.len() >= least {
        let tried: Vec<Common> = (0..TRIES)
            .filter_map(|_| {
                // Two of one view, so that the three are near each other more often.
                Common::through(std::array::from_fn(|_| points[rng.random_range(0..points.len())].point))
            })
            .collect();
        let count = |plane: &Common| points.iter().filter(|at| plane.has(at)).count();
        let Some((_, mut plane)) = (tried.par_iter().enumerate())
            .map(|(i, plane)| ((count(plane), std::cmp::Reverse(i)), *plane))
            .max_by_key(|(count, _)| *count)
        else {
            break;
        };
        for _ in 0..4 {
            let inliers: Vec<Measured> = points.iter().filter(|at| plane.has(at)).copied().collect();
            if inliers.len() >= 3 {
                plane = plane.fitted(&inliers);
            }
        }
        let on_it = points.iter().filter(|at| plane.has(at)).count();
        points.retain(|at| plane.off(at).abs() > 3.0 * THICKNESS);
        if on_it < least {
            break;
        }
        found.push(plane);
    }
    found
}

/// The largest planes of what is measured around the holes of all views.
fn common(around: &[Measured], seed: u64) -> Vec<Common> {
    let least = (LEAST * around.len() as f64).ceil() as usize;
    largest(around.to_vec(), least, &mut Pcg64::new(seed.into(), 43))
}

impl Sights {
    /// Points that all views together show around their holes, some of each.
    pub(super) fn measured_around(&self) -> Vec<Measured> {
        self.around_holes(true).into_iter().map(|(view, site)| self.measured(view, site)).collect()
    }

    /// Views and sites, some of each, whose depth is known around their holes, confirmed by others or not.
    pub(super) fn around_holes(&self, confirmed: bool) -> Vec<(usize, usize)> {
        let views = self.0.par_iter().enumerate().filter(|(_, sight)| sight.grid.trusted);
        views
            .flat_map_iter(|(view, sight)| {
                let near = sight.surroundings();
                let known = |site: &usize| {
                    near[*site]
                        && !sight.hole[*site]
                        && sight.depth[*site].is_finite()
                        && (sight.grid.confirmed[*site] || !confirmed)
                };
                let sites: Vec<usize> = (0..near.len()).filter(known).collect();
                let every = sites.len().div_ceil(POINTS).max(1);
                sites.into_iter().step_by(every).map(move |site| (view, site)).collect::<Vec<_>>()
            })
            .collect()
    }

    /// The point that a view measures at a site.
    pub(super) fn measured(&self, view: usize, site: usize) -> Measured {
        let sight = &self.0[view];
        Measured { point: sight.point(site, sight.depth[site]), eye: sight.eye() }
    }

    /// Brings what is bare around the holes of all views onto the planes there. The same seed finds the same.
    pub fn flatten(&mut self, seed: u64) {
        self.flatten_from(PARALLAX, seed);
    }

    /// Flattens views with at least this parallax; others get the surfaces of one material around the holes.
    fn flatten_from(&mut self, parallax: f64, seed: u64) {
        let (around, points) = (self.measured_around(), self.points());
        let mut common = common(&around, seed);
        let object = self.object();
        let top = self.top(&common, &around, &object);
        common.extend(top.iter().map(|top| top.plane));
        let of = |view: usize| self.flat(view, &common, &points, parallax, seed + view as u64);
        let flat: Vec<Flat> = (0..self.0.len()).into_par_iter().map(of).collect();
        let untold = flat.iter().any(|flat| flat.planes.is_empty());
        let covered = if untold { self.covered(seed) } else { vec![] };
        for (sight, Flat { planes, cover, sites }) in self.0.iter_mut().zip(flat) {
            if planes.is_empty() {
                sight.covered =
                    covered.iter().filter_map(|(plane, look)| Covered::seen_by(plane, *look, sight)).collect();
            }
            (sight.around, sight.cover) = (planes, cover);
            sites.into_iter().for_each(|(site, depth)| sight.depth[site] = depth);
        }
        self.stand(top, &object);
    }

    /// Planes around a view's hole, and the sites on them; nothing where the view's neighbours are too near to tell.
    fn flat(&self, of: usize, common: &[Common], points: &Points, parallax: f64, seed: u64) -> Flat {
        let own = &self.0[of];
        let near = own.surroundings();
        let Some(window) = Window::around(&own.grid, |site| near[site]) else { return Flat::default() };
        let sites = window.sites();
        let others = self.beside(of);
        if self.parallax(own, &others, &sites).is_none_or(|sites| sites < parallax) {
            return Flat::default();
        }
        let rays: Vec<Option<[f64; 2]>> = sites.iter().map(|site| Some(own.ray(*site))).collect();
        let disparity: Vec<f32> = sites.iter().map(|site| (1.0 / own.depth[*site]) as f32).collect();
        let hole: Vec<bool> = sites.iter().map(|site| own.hole[*site]).collect();
        // On what is bare lie planes of noise.
        let known = |cell: &usize| !hole[*cell] && disparity[*cell].is_finite();
        let sure = |cell: &usize| known(cell) && own.grid.confirmed[sites[*cell]];
        let [all, few] = [(0..sites.len()).filter(known).count(), (0..sites.len()).filter(sure).count()];
        let among: Vec<f32> = match few as f64 >= SURE * all as f64 {
            true => (0..sites.len()).map(|cell| if sure(&cell) { disparity[cell] } else { f32::NAN }).collect(),
            false => disparity,
        };
        let planes = own.planes_among(common, &sites, planes::around(&among, &rays, &hole, seed));
        if planes.is_empty() || !own.grid.trusted {
            return Flat { planes, ..Flat::default() };
        }
        let cover = points.cover(&planes.iter().map(|plane| Common::of(plane, own)).collect::<Vec<_>>());
        let depth_on = |plane: &Plane, site: usize| 1.0 / planes::on(plane, own.ray(site));
        // What the object stands on is before it, too.
        let supports = own.supports(&planes);
        let carries: Vec<bool> = planes.iter().map(|plane| supports.iter().any(|support| support.is(plane))).collect();
        let possible = |site: usize, z: f64, carries: bool| {
            let measured = own.depth[site];
            let apart = match measured.is_nan() {
                // It has the depth of something nearer than what is there.
                true => !carries && z < (1.0 - SAME) * own.grid.depth[site],
                // What nobody confirms often has the depth of something before it.
                false => (z / measured - 1.0).abs() > FARTHEST && (own.grid.confirmed[site] || z < measured),
            };
            z > 0.0 && !own.hole[site] && !apart
        };
        let unlike = |depth: &(dyn Fn(usize) -> f64 + Sync), carries: bool| -> Vec<f64> {
            let one = |site: &usize| Some(depth(*site)).filter(|z| possible(*site, *z, carries));
            let raw: Vec<f64> = (sites.par_iter())
                .map(|site| one(site).and_then(|z| self.unlike(own, &others, *site, z)).unwrap_or(f64::NAN))
                .collect();
            (0..raw.len()).into_par_iter().map(|cell| around(&raw, cell, window.size)).collect()
        };
        let measured = unlike(&|site| own.depth[site], false);
        let on_planes: Vec<Vec<f64>> = (planes.iter().zip(&carries))
            .map(|(plane, carries)| unlike(&|site| depth_on(plane, site), *carries))
            .collect();
        let cost = |levels: f64| if levels.is_nan() { MOST } else { (levels / LEVELS).min(MOST) };
        let cost = |label: usize, cell: usize| -> f64 {
            let site = sites[cell];
            let Some(plane) = planes.get(label) else {
                return if hole[cell] { 0.0 } else { BESIDE + cost(measured[cell]) };
            };
            let z = depth_on(plane, site);
            let apart = (z / own.depth[site] - 1.0).abs() / SAME;
            let off = match (apart.is_nan(), own.grid.confirmed[site] && apart > 1.0) {
                (true, _) => 0.0,
                (false, refuted) => NEAR * apart.min(4.0) + if refuted { CONFIRMED } else { 0.0 },
            };
            let refuted =
                || (apart.is_nan() || apart > 1.0) && self.looked_through(others.iter().copied(), own.point(site, z));
            match (hole[cell], possible(site, z, carries[label]) && !refuted()) {
                (true, _) => 0.0,
                (false, false) => 10.0 * MOST,
                (false, true) => {
                    let covered = cover.cost_at(label, &planes, own.ray(site), own.color(site));
                    cost(on_planes[label][cell]) + off + covered + LATER * label as f64
                }
            }
        };
        let costs: Vec<Vec<f64>> =
            (0..=planes.len()).map(|label| (0..sites.len()).map(|cell| cost(label, cell)).collect()).collect();
        let labels = planes::cheapest(&costs, &planes::Border { between: |_| BORDER, at: |_, _| 0.0 }, window.size);
        let on_plane = |cell: usize| {
            let site = sites[cell];
            let z = depth_on(planes.get(labels[cell])?, site);
            (!hole[cell] && possible(site, z, carries[labels[cell]])).then_some((site, z))
        };
        Flat { sites: (0..sites.len()).filter_map(on_plane).collect(), planes, cover }
    }

    /// By how many sites what a view shows moves in other views, a quarter of which shows more, where it is farther by `APART`:
    /// the median over the view's sites.
    fn parallax(&self, own: &Sight, others: &[usize], sites: &[usize]) -> Option<f64> {
        let of = |site: &usize| -> Option<f64> {
            let z = Some(own.depth[*site]).filter(|z| z.is_finite())?;
            let moves = |view: &usize| {
                let place = |z: f64| self.0[*view].seen(own.point(*site, z)).map(|(_, [x, y], _)| DVec2::new(x, y));
                Some(place(z)?.distance(place((1.0 + APART) * z)?))
            };
            quantile(others.iter().filter_map(moves), 0.75)
        };
        let every = sites.len().div_ceil(POINTS).max(1);
        let found = median(sites.iter().step_by(every).filter_map(of));
        log::debug!("flat: parallax {found:.2?}");
        found
    }

    /// The views that look nearly the same way as a view.
    fn beside(&self, of: usize) -> Vec<usize> {
        let axis = |view: usize| DVec3::from(self.0[view].grid.camera.rotation[2].map(f64::from));
        let angle = |view: usize| axis(view).dot(axis(of)).clamp(-1.0, 1.0).acos();
        let trusted = (0..self.0.len()).filter(|view| *view != of && self.0[*view].grid.trusted);
        let found: Vec<usize> = trusted.filter(|view| angle(*view) <= TURNED).collect();
        let every = found.len().div_ceil(VIEWS).max(1);
        found.into_iter().step_by(every).collect()
    }

    /// `[cell]` by how many levels the views differ that show what sites of a view's hole have at these depths, and the colour, 0 to 1,
    /// that they show; NaN where too few do.
    pub fn shown_in_hole(
        &self,
        of: usize,
        sites: &[usize],
        depth: impl Fn(usize) -> f64 + Sync,
    ) -> Vec<(f64, [f32; 3])> {
        let own = &self.0[of];
        let others = self.beside(of);
        let one = |cell: usize| -> Option<(f64, [f32; 3])> {
            let z = Some(depth(cell)).filter(|z| own.hole[sites[cell]] && *z > 0.0)?;
            let point = own.point(sites[cell], z);
            let colors: Vec<[f64; 3]> = others.iter().filter_map(|view| self.0[*view].color_of(point)).collect();
            let middle: [f64; 3] =
                std::array::from_fn(|c| quantile(colors.iter().map(|color| color[c]), 0.5).unwrap_or(0.0));
            let unlike = most_alike(
                colors.iter().map(|color| (0..3).map(|c| (color[c] - middle[c]).abs()).sum::<f64>() / 3.0).collect(),
            )?;
            Some((unlike, middle.map(|v| v as f32 / 255.0)))
        };
        (0..sites.len()).into_par_iter().map(|cell| one(cell).unwrap_or((f64::NAN, [f32::NAN; 3]))).collect()
    }

    /// By how many levels other views, those that show a site's point at this depth, differ from what the site shows.
    fn unlike(&self, own: &Sight, others: &[usize], site: usize, z: f64) -> Option<f64> {
        let point = own.point(site, z);
        let color = own.grid.colors[site];
        let apart: Vec<f64> = (others.iter())
            .filter_map(|view| {
                let shown = self.0[*view].color_of(point)?;
                Some((0..3).map(|c| (shown[c] - f64::from(color[c])).abs()).sum::<f64>() / 3.0)
            })
            .collect();
        most_alike(apart)
    }
}

impl Sight {
    /// The common planes as the view sees them, and those of its own that are not among them.
    fn planes_among(&self, common: &[Common], sites: &[usize], its_own: Vec<Plane>) -> Vec<Plane> {
        let mut planes: Vec<Plane> = common.iter().filter_map(|plane| plane.seen_by(self)).collect();
        for plane in its_own {
            let on = |plane: &Plane, site: usize, part: f64| {
                !self.hole[site] && (planes::on(plane, self.ray(site)) * self.depth[site] - 1.0).abs() <= part
            };
            let its: Vec<usize> = sites.iter().copied().filter(|site| on(&plane, *site, planes::THICKNESS)).collect();
            let again = |known: &Plane| {
                let also = its.iter().filter(|site| on(known, **site, 2.0 * planes::THICKNESS)).count();
                also as f64 > COMMON * its.len() as f64
            };
            if !planes.iter().any(again) {
                planes.push(plane);
            }
        }
        planes
    }

    /// The colour, 8-bit levels, that the photograph shows of a point; nothing where the object hides it, or what is known to
    /// stand before it.
    fn color_of(&self, point: DVec3) -> Option<[f64; 3]> {
        let (at, place, z) = self.seen(point)?;
        let hidden = self.grid.confirmed[at] && z > (1.0 + 2.0 * SAME) * self.grid.depth[at];
        let size = [self.grid.columns, self.grid.rows];
        let color = || resample::bilinear(size, place, |i| self.grid.colors[i].map(f64::from));
        (!self.hole[at] && !hidden).then(color)
    }
}

/// Mean of the differences that count; nothing where too few do.
fn most_alike(mut apart: Vec<f64>) -> Option<f64> {
    apart.sort_unstable_by(f64::total_cmp);
    let enough = apart.len() >= FEWEST;
    apart.truncate((ALIKE * apart.len() as f64).ceil() as usize);
    enough.then(|| apart.iter().sum::<f64>() / apart.len() as f64)
}

/// Mean of a cell's value and its neighbours', of those that have one; NaN where the cell has none.
pub fn around(values: &[f64], cell: usize, size: [usize; 2]) -> f64 {
    if values[cell].is_nan() {
        return f64::NAN;
    }
    let near = neighbours(cell, size).chain([cell]).map(|cell| values[cell]).filter(|v| v.is_finite());
    let (sum, count) = near.fold((0.0, 0.0), |(sum, n), v| (sum + v, n + 1.0));
    sum / count
}

#[cfg(test)]
mod tests {
    use super::super::surface::tests::{SIZE, views};
    use super::*;

    /// Five views of a wall at z = 4 with a patch at the left of it, in world x from -2 to -1, that is 3.6 deep by the measured
    /// depth; the colours of the wall's points, and of the patch's where they are at 3.6.
    fn patched(color: impl Fn(f64, f64) -> u8, confirmed: bool) -> (Sights, Vec<Vec<usize>>) {
        let (mut grids, cameras, masks) = views(0.2);
        let mut patches = vec![];
        for (grid, camera) in grids.iter_mut().zip(&cameras) {
            let pixels = 0..(SIZE[0] * SIZE[1]) as usize;
            let at = |pixel: usize, z: f64| camera.lift(camera.pixel_center(pixel), z).expect("a ray");
            let patch: Vec<usize> = pixels
                .clone()
                .filter(|i| (-2.0..-1.0).contains(&at(*i, 3.6)[0]) && at(*i, 3.6)[1].abs() < 0.7)
                .collect();
            for i in pixels {
                let z = if patch.contains(&i) { 3.6 } else { grid.depth[i] };
                let [x, y, _] = at(i, z);
                (grid.depth[i], grid.colors[i]) = (z, [color(x, y); 3]);
                grid.confirmed[i] &= confirmed || z != 3.6;
            }
            patches.push(patch);
        }
        (Sights::new(grids, &cameras, &masks, &masks), patches)
    }

    /// Where a wall is bare its depth is a guess, and it lies on the plane of what is known of it.
    #[test]
    fn what_is_bare_lies_on_its_plane() {
        let (mut sights, patches) = patched(|_, _| 90, false);
        sights.flatten_from(0.1, 1);
        for (sight, patch) in sights.0.iter().zip(&patches) {
            let near = sight.surroundings();
            let patch: Vec<usize> = patch.iter().copied().filter(|site| near[*site]).collect();
            assert!(patch.len() > 30, "{}", patch.len());
            let flat = patch.iter().filter(|site| (sight.depth[**site] / 4.0 - 1.0).abs() < 0.005).count();
            assert!(flat * 10 > patch.len() * 9, "{flat} of {}", patch.len());
        }
    }

    /// A patch before the wall makes a plane of its own if other views confirm it, and is a bare wall's noise otherwise.
    #[test]
    fn noise_makes_no_plane() {
        for confirmed in [false, true] {
            let (sights, _) = patched(|_, _| 90, confirmed);
            let planes = sights.flat(2, &[], &sights.points(), 0.1, 1).planes;
            assert!(planes.iter().any(|plane| (1.0 / plane[2] / 4.0 - 1.0).abs() < 0.01), "{planes:?}");
            assert_eq!(planes.len(), if confirmed { 2 } else { 1 }, "{planes:?}");
        }
    }

    /// A bare floor and a bare wall of one colour: each ends where they meet.
    #[test]
    fn a_floor_ends_at_its_wall() {
        let (mut grids, cameras, masks) = views(0.2);
        let floor = |[_, y]: [f64; 2]| if y > 0.2 { 0.8 / y } else { 4.0 };
        for grid in &mut grids {
            for site in (0..grid.depth.len()).filter(|site| grid.depth[*site] == 4.0).collect::<Vec<_>>() {
                grid.depth[site] = floor(grid.ray([site as u32 % SIZE[0], site as u32 / SIZE[0]]));
            }
        }
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        sights.flatten_from(0.1, 1);
        for sight in &sights.0 {
            let at = |ray: [f64; 2], inverse: f64| {
                sight.around.iter().position(|plane| (planes::on(plane, ray) / inverse - 1.0).abs() < 0.01)
            };
            let (below, above) = ([0.0, 0.3], [0.0, 0.1]);
            let [floor, wall] = [at(below, 0.3 / 0.8), at(above, 0.25)].map(|plane| plane.expect("a plane"));
            let has_ended = |plane, ray| sight.cover.has_ended(plane, &sight.around, ray);
            assert!(has_ended(floor, above) && has_ended(wall, below));
            assert!(!has_ended(floor, below) && !has_ended(wall, above));
        }
    }

    /// Views that are too near each other to tell two planes apart by their colours tell nothing.
    #[test]
    fn where_views_are_too_near_nothing_is_moved() {
        let (mut sights, patches) = patched(|_, _| 90, true);
        sights.flatten(1);
        for (sight, patch) in sights.0.iter().zip(&patches) {
            assert!(sight.around.is_empty() && patch.iter().all(|site| sight.depth[*site] == 3.6));
        }
    }

    /// A bare site that the object's depth has bled into lies behind the object, not on a plane that passes before it.
    #[test]
    fn what_bled_lies_behind_the_object() {
        let (mut sights, _) = patched(|_, _| 90, false);
        let bled: Vec<usize> =
            (2..28).flat_map(|row| (32..44).map(move |column| row * SIZE[0] as usize + column)).collect();
        for site in &bled {
            (sights.0[2].depth[*site], sights.0[2].grid.depth[*site]) = (f64::NAN, 2.0);
        }
        let before = Common { normal: DVec3::Z, offset: 1.0 };
        let flat = sights.flat(2, &[before], &sights.points(), 0.1, 1);
        let near = sights.0[2].surroundings();
        let bled: Vec<usize> = bled.into_iter().filter(|site| near[*site]).collect();
        let found: Vec<f64> = flat.sites.iter().filter(|(site, _)| bled.contains(site)).map(|(_, z)| *z).collect();
        assert!(found.len() * 10 > bled.len() * 9 && bled.len() > 100, "{} of {}", found.len(), bled.len());
        assert!(found.iter().all(|z| (z / 4.0 - 1.0).abs() < 0.005));
    }

    /// What the photographs show before the plane stays there.
    #[test]
    fn what_looks_alike_off_the_plane_stays() {
        let pattern = |x: f64, y: f64| (120.0 + 60.0 * (9.0 * x).sin() + 50.0 * (8.0 * y).cos()) as u8;
        for confirmed in [false, true] {
            let (mut sights, patches) = patched(pattern, confirmed);
            sights.flatten_from(0.1, 1);
            for (sight, patch) in sights.0.iter().zip(&patches) {
                let kept = patch.iter().filter(|site| (sight.depth[**site] / 3.6 - 1.0).abs() < 0.005).count();
                assert!(kept * 10 > patch.len() * 8, "{kept} of {}", patch.len());
            }
        }
    }

    /// A plane through points of several cameras, some of them off it, is that of most.
    #[test]
    fn the_common_plane_is_that_of_most_points() {
        let (sights, _) = patched(|_, _| 90, true);
        let plane = common(&sights.measured_around(), 1)[0];
        let normal = plane.normal * plane.normal.z.signum();
        assert!(normal.distance(DVec3::Z) < 1e-3, "{normal}");
        assert!((plane.offset.abs() - 4.0).abs() < 1e-3, "{}", plane.offset);
    }
}

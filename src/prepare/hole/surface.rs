//! What stands behind the object, as every view sees it: one surface.
//!
//! Each view knows the depth of what it shows beside the object ([`multiview::depths`](crate::multiview::depths)). What
//! other views show behind the object is carried over: the nearest depth that enough of them claim and that no more of
//! them look through. What nobody shows continues the surfaces around it ([`planes`]). A view that is solved counts for
//! all that follow, so that all views end with the same surface.

use glam::{DMat3, DVec2, DVec3};
use image::GrayImage;
use rayon::prelude::*;

use super::corner::Cut;
use super::covered::{Cover, Covered};
use super::flat;
use super::support::Support;
use super::votes::{Claim, ENOUGH, Votes};
use super::window::Window;
use crate::multiview::DepthGrid;
use crate::prepare::planes;
use crate::scene::Camera;

/// Relative difference up to which two depths are of one surface.
pub(super) const SAME: f64 = 0.03;
/// Relative difference from which on the nearer of two surfaces hides the farther one.
pub(super) const APART: f64 = 0.06;
/// Share of the views with a point in the picture whose masks must cover it for it to be the object's.
const HULL: f64 = 0.8;
/// Fewest views with a point in the picture that can tell whether it is the object's.
pub(super) const HULL_VIEWS: usize = 3;
/// Part that speaks against a surface behind what the object stands on: it is likely hidden, which is no proof.
const BELOW: f64 = 0.5;
/// Relative difference to a plane up to which a measured inverse depth is taken to lie on it.
const FLAT: f32 = 0.015;
/// Least width of a hole's surroundings, sites.
const LEAST_MARGIN: i64 = 16;
/// What its being on a plane must cost more than where it was carried to for a site to be off the plane of its surroundings.
const BETTER: f64 = 2.0;
/// What a depth costs where too few photographs show what is there.
const UNSHOWN: f64 = 1.0;
/// Cost of such a depth behind the one that others claim, which hides it.
const UNSHOWN_BEHIND: f64 = 2.0;
/// Part of the depth that a site was carried to before which no plane takes it: a bare surface is measured wrong, not so wrong.
const NEARER: f64 = 0.5;
/// Sites to each side among which the object's nearest depth counts.
const BARE: i64 = 3;
/// Sites of a hole that are filled from their neighbours where no more than these are unknown.
const FEW: usize = 12;

/// One view of the scene without the object.
#[derive(Clone)]
pub struct Sight {
    /// Depth of the photograph, the object included.
    pub grid: DepthGrid,
    /// `[site]` whether the object, or a margin around it, covers it.
    pub hole: Vec<bool>,
    /// `[site of the hole]` depth z of the object as others confirm it, 0 where they do not. On what is bare single depths are wrong, and
    /// within the object the nearest around counts.
    pub(super) object: Vec<f64>,
    /// `[site]` depth z of what is there without the object, scene units; NaN where it is not known.
    pub depth: Vec<f64>,
    /// `[site]` whether another photograph shows it past the object.
    pub measured: Vec<bool>,
    /// `[site]` number of the plane in [`Sight::planes`] that it lies on; their count for what lies on none.
    pub surface: Vec<u8>,
    /// Planes around the hole: inverse depth by x/z, y/z and 1.
    pub planes: Vec<planes::Plane>,
    /// `[site of the hole]` depth z of the plane that the object stands on where it does, NaN elsewhere: nothing behind that shows.
    pub(super) stands: Vec<f64>,
    /// A top that hardly shows around the object: it is there where `stands` is known, and ends there.
    pub(super) top: Option<Support>,
    /// Planes around the hole that were found before it is solved; none where the views are too near each
    /// other to tell.
    pub(super) around: Vec<planes::Plane>,
    /// Their materials, and where they end.
    pub(super) cover: Cover,
    /// Surfaces of one material around the holes, where the views are too near each other to tell planes apart by what they look like on
    /// them.
    pub(super) covered: Vec<Covered>,
    /// Straight borders between what looks different that go into the hole, places in sites: from where they do to where they come out of
    /// it, or would.
    pub borders: Vec<[DVec2; 2]>,
    /// Where surfaces end in the hole.
    pub cuts: Vec<Cut>,
    /// Whether every site has its depth.
    pub solved: bool,
    /// How many views were solved before it.
    rank: usize,
    /// From world coordinates to a place in sites times z, and z.
    forward: (DMat3, DVec3),
    /// From a place in sites, and 1, to the way to what is seen there at z = 1; and the camera's centre.
    backward: (DMat3, DVec3),
}

/// A camera's rotation.
fn rotation(camera: &Camera) -> DMat3 {
    DMat3::from_cols_array_2d(&camera.rotation.map(|row| row.map(f64::from))).transpose()
}

/// A surface as it goes on around one of its sites.
struct Patch {
    at: [i64; 2],
    inverse: f64,
    /// Change of the inverse depth per site, across and down.
    slopes: [f64; 2],
}

impl Patch {
    /// The inverse depth at a place whose sites have whole numbers.
    fn inverse_at(&self, [x, y]: [f64; 2]) -> f64 {
        self.inverse + self.slopes[0] * (x - self.at[0] as f64) + self.slopes[1] * (y - self.at[1] as f64)
    }

    /// Whether a site of this inverse depth is of the surface. One that is seen at a grazing angle goes on in equal steps.
    fn has(&self, site: [i64; 2], inverse: f64) -> bool {
        let goes_on = self.inverse_at(site.map(|v| v as f64));
        (inverse - self.inverse).abs().min((inverse - goes_on).abs()) <= 2.0 * SAME * self.inverse
    }
}

/// A quadratic B-spline: what a site counts at a distance, 0 from one and a half on.
fn spline(apart: f64) -> f64 {
    match apart.abs() {
        near if near <= 0.5 => 0.75 - near * near,
        far if far < 1.5 => 0.5 * (1.5 - far).powi(2),
        _ => 0.0,
    }
}

impl Sight {
    /// A view whose photograph has this camera and whose object, with its margin, has this mask, as large as the camera's
    /// picture.
    pub(super) fn new(grid: DepthGrid, camera: &Camera, mask: &GrayImage) -> Self {
        let hole: Vec<bool> = (0..grid.depth.len()).map(|site| covers(mask, camera, &grid, site)).collect();
        let depth = grid.depth.iter().zip(&hole).map(|(z, hole)| if *hole { f64::NAN } else { *z }).collect();
        let sites = hole.len();
        let object = |site: usize| {
            let confirmed = |at: &usize| grid.confirmed[*at];
            let within = grid.around(site, BARE).all(|at| hole[at]);
            let near = grid.around(site, if within { BARE } else { 0 }).filter(confirmed).map(|at| grid.depth[at]);
            if hole[site] && grid.confirmed[site] { near.fold(f64::INFINITY, f64::min) } else { 0.0 }
        };
        let object = (0..sites).map(object).collect();
        let [focal, principal] = [grid.camera.focal, grid.camera.principal]
            .map(|lengths| lengths.map(|length| f64::from(length) / f64::from(grid.stride)));
        let lens = DMat3::from_cols_array(&[focal[0], 0.0, 0.0, 0.0, focal[1], 0.0, principal[0], principal[1], 1.0]);
        let turn = rotation(&grid.camera);
        let shift = DVec3::from(grid.camera.translation);
        Self {
            forward: (lens * turn, lens * shift),
            backward: (turn.transpose() * lens.inverse(), DVec3::from(grid.camera.center())),
            grid,
            hole,
            object,
            depth,
            measured: vec![false; sites],
            surface: vec![0; sites],
            planes: vec![],
            stands: vec![f64::NAN; sites],
            top: None,
            around: vec![],
            cover: Cover::default(),
            covered: vec![],
            borders: vec![],
            cuts: vec![],
            solved: false,
            rank: 0,
        }
    }

    /// Where the camera stands.
    pub fn eye(&self) -> DVec3 {
        self.backward.1
    }

    /// Site and depth z of a world point that is in the picture.
    pub fn see(&self, point: DVec3) -> Option<(usize, f64)> {
        self.seen(point).map(|(site, _, z)| (site, z))
    }

    /// The same, with the place in sites.
    pub(super) fn seen(&self, point: DVec3) -> Option<(usize, [f64; 2], f64)> {
        let at = self.forward.0 * point + self.forward.1;
        if at.z <= 0.0 {
            return None;
        }
        let place @ [x, y] = [at.x / at.z, at.y / at.z];
        let inside = x >= 0.0 && y >= 0.0;
        self.grid.site(x as i64, y as i64).filter(|_| inside).map(|site| (site, place, at.z))
    }

    /// The place in sites of the points `eye` plus `way` over d, times z d, and z d, of which the first is for d = 0, and the second to
    /// be added for each unit of d.
    pub(super) fn homogeneous(&self, eye: DVec3, way: DVec3) -> (DVec3, DVec3) {
        (self.forward.0 * way, self.forward.0 * eye + self.forward.1)
    }

    /// Depth z at a place in sites, linear in its inverse between sites of one surface; NaN where nothing is known.
    pub fn depth_at(&self, place: [f64; 2]) -> f64 {
        self.depth_from(place.map(|v| v.floor() as i64), place)
    }

    /// Depth z at a place in sites, of surfaces that end in smooth lines: the surface is that of most of the nine sites around the
    /// place, the nearer ones counting more. [`Sight::depth_at`] has the nearest site's, so that an end is a staircase of sites.
    pub fn smooth_depth_at(&self, place: [f64; 2]) -> f64 {
        if let Some(beside) = self.beside_border(place) {
            return self.depth_from(beside.map(|v| v.floor() as i64), place);
        }
        let own = place.map(|v| v.floor() as i64);
        let Some(surface) = self.surface_from(own) else { return f64::NAN };
        let near: Vec<([i64; 2], f64, f64)> = (-1..=1)
            .flat_map(|dy| (-1..=1).map(move |dx| [own[0] + dx, own[1] + dy]))
            .map(|at| {
                (at, self.inverse(at), spline(place[0] - at[0] as f64 - 0.5) * spline(place[1] - at[1] as f64 - 0.5))
            })
            .filter(|(_, inverse, _)| inverse.is_finite())
            .collect();
        let share = |surface: &Patch| {
            near.iter().filter(|(at, inverse, _)| surface.has(*at, *inverse)).map(|(.., weight)| weight).sum::<f64>()
        };
        let half = 0.5 * near.iter().map(|(.., weight)| weight).sum::<f64>();
        if share(&surface) >= half {
            return self.depth_from(own, place);
        }
        // Of surfaces that have as much the first one.
        let all = near.iter().filter_map(|(at, ..)| Some((*at, share(&self.surface_from(*at)?))));
        let most = all.reduce(|best, next| if next.1 > best.1 + 1e-9 { next } else { best });
        self.depth_from(most.map_or(own, |(at, _)| at), place)
    }

    /// The inverse depth of a site; NaN where there is none, and where nothing is known.
    fn inverse(&self, [column, row]: [i64; 2]) -> f64 {
        self.grid.site(column, row).map_or(f64::NAN, |site| 1.0 / self.depth[site])
    }

    /// The surface of a site, as it goes on around it.
    fn surface_from(&self, at: [i64; 2]) -> Option<Patch> {
        let inverse = self.inverse(at);
        // Of two sides the flatter one: on the other another surface may begin.
        let slope = |before: [i64; 2], after: [i64; 2]| {
            let slope = match (inverse - self.inverse(before), self.inverse(after) - inverse) {
                (one, other) if other.is_nan() || one.abs() < other.abs() => one,
                (_, other) => other,
            };
            if slope.is_nan() { 0.0 } else { slope }
        };
        let slopes = [slope([at[0] - 1, at[1]], [at[0] + 1, at[1]]), slope([at[0], at[1] - 1], [at[0], at[1] + 1])];
        inverse.is_finite().then_some(Patch { at, inverse, slopes })
    }

    /// Depth z at a place in sites of the surface that a site near it is on.
    fn depth_from(&self, at: [i64; 2], place: [f64; 2]) -> f64 {
        let Some(surface) = self.surface_from(at) else { return f64::NAN };
        let [x, y] = place.map(|v| v - 0.5);
        let (mut sum, mut total) = (0.0, 0.0);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let site @ [u, v] = [x.floor() as i64 + dx, y.floor() as i64 + dy];
            let there = self.inverse(site);
            if surface.has(site, there) {
                let weight = (1.0 - (x - u as f64).abs()) * (1.0 - (y - v as f64).abs());
                sum += weight * there;
                total += weight;
            }
        }
        // Where a surface ends its sites beyond the place are missing.
        let known = sum + (1.0 - total) * surface.inverse_at([x, y]);
        1.0 / if known > 0.0 { known } else { surface.inverse }
    }

    /// The site at which a world point is seen without the object: what is there is at most this part of the depth before or
    /// behind it.
    pub fn agrees(&self, point: DVec3, part: f64) -> Option<usize> {
        let (site, place, z) = self.seen(point)?;
        ((self.depth_at(place) / z - 1.0).abs() <= part).then_some(site)
    }

    /// As [`Sight::agrees`], by surfaces that end in smooth lines.
    pub fn has(&self, point: DVec3, part: f64) -> bool {
        self.seen(point).is_some_and(|(_, place, z)| (self.smooth_depth_at(place) / z - 1.0).abs() <= part)
    }

    /// As [`Sight::agrees`], where the photograph shows it: beside the object.
    pub fn shows(&self, point: DVec3, part: f64) -> Option<usize> {
        self.agrees(point, part).filter(|site| !self.hole[*site])
    }

    /// The surface at a place in sites: that of most of the nine sites around it, the nearer ones counting more.
    pub fn surface_at(&self, place: [f64; 2]) -> u8 {
        let place = self.beside_border(place).unwrap_or(place);
        let own = place.map(|v| v.floor() as i64);
        let mut votes: Vec<(u8, f64)> = vec![];
        for at in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [own[0] + dx, own[1] + dy])) {
            let Some(site) = self.grid.site(at[0], at[1]) else { continue };
            let weight = spline(place[0] - at[0] as f64 - 0.5) * spline(place[1] - at[1] as f64 - 0.5);
            match votes.iter_mut().find(|(surface, _)| *surface == self.surface[site]) {
                Some((_, sum)) => *sum += weight,
                None => votes.push((self.surface[site], weight)),
            }
        }
        votes.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(surface, _)| surface)
    }

    /// The view's planes as another sees them: inverse depth by x/z, y/z and 1 of its camera.
    fn planes_for(&self, other: &Self) -> Vec<planes::Plane> {
        // A plane p is p . x = 1 in camera coordinates.
        let offset = |sight: &Self| DVec3::from(sight.grid.camera.translation);
        let turn = rotation(&self.grid.camera) * rotation(&other.grid.camera).transpose();
        let shift = offset(self) - turn * offset(other);
        let plane = |plane: &planes::Plane| {
            let plane = DVec3::from(*plane);
            (turn.transpose() * plane / (1.0 - plane.dot(shift))).to_array()
        };
        self.planes.iter().map(plane).collect()
    }

    /// Normalised coordinates of a site's centre.
    pub fn ray(&self, site: usize) -> [f64; 2] {
        self.grid.ray([site as u32 % self.grid.columns, site as u32 / self.grid.columns])
    }

    /// `[site]` whether it is in the hole's box, or within as much again on each side: the surfaces there go on in it.
    pub(super) fn surroundings(&self) -> Vec<bool> {
        let place = |site: usize| [site as u32 % self.grid.columns, site as u32 / self.grid.columns].map(i64::from);
        let holes = (0..self.hole.len()).filter(|site| self.hole[*site]).map(place);
        let (low, high) = holes.fold(([i64::MAX; 2], [i64::MIN; 2]), |(low, high), at| {
            (std::array::from_fn(|a| low[a].min(at[a])), std::array::from_fn(|a: usize| high[a].max(at[a])))
        });
        let margin: [i64; 2] = std::array::from_fn(|a| high[a].saturating_sub(low[a]).max(LEAST_MARGIN));
        let inside = |at: [i64; 2]| {
            (0..2).all(|a| at[a] >= low[a].saturating_sub(margin[a]) && at[a] <= high[a].saturating_add(margin[a]))
        };
        (0..self.hole.len()).map(|site| low[0] <= high[0] && inside(place(site))).collect()
    }

    /// Whether a plane is that of the top that hardly shows around the object.
    fn is_top(&self, plane: &planes::Plane) -> bool {
        self.top.as_ref().is_some_and(|top| top.is(plane))
    }

    /// The world point on a site's ray at a depth z.
    pub fn point(&self, site: usize, depth: f64) -> DVec3 {
        let [column, row] = [site as u32 % self.grid.columns, site as u32 / self.grid.columns].map(f64::from);
        self.backward.0 * DVec3::new(column + 0.5, row + 0.5, 1.0) * depth + self.backward.1
    }

    /// Whether a site is of the hole, or next to it.
    pub fn near_hole(&self, site: usize) -> bool {
        self.around(site).any(|near| self.hole[near])
    }

    /// The sites within one of this one, itself included.
    pub(super) fn around(&self, site: usize) -> impl Iterator<Item = usize> + '_ {
        self.grid.around(site, 1)
    }
}

/// Whether a mask as large as a camera's picture covers a site.
fn covers(mask: &GrayImage, camera: &Camera, grid: &DepthGrid, site: usize) -> bool {
    let at = [site as u32 % grid.columns, site as u32 / grid.columns];
    let point = camera.along(grid.ray(at), 1.0);
    let Some([x, y]) = camera.project(point) else { return false };
    x >= 0.0 && y >= 0.0 && mask.get_pixel_checked(x as u32, y as u32).is_some_and(|p| p.0[0] != 0)
}

/// `[view][site]` whether the masks, as large as the pictures of these cameras, cover it.
pub(super) fn inside(grids: &[DepthGrid], cameras: &[Camera], masks: &[GrayImage]) -> Vec<Vec<bool>> {
    let views = grids.par_iter().zip(cameras).zip(masks);
    views
        .map(|((grid, camera), mask)| (0..grid.depth.len()).map(|site| covers(mask, camera, grid, site)).collect())
        .collect()
}

/// How many trusted views have a point in the picture, and in how many of these it is inside.
pub(super) fn framing<'a>(views: impl Iterator<Item = (&'a DepthGrid, &'a Vec<bool>)>, point: DVec3) -> (usize, usize) {
    let trusted = views.filter(|(grid, _)| grid.trusted);
    let framing = trusted.filter_map(|(grid, inside)| Some(inside[grid.see(point)?.0]));
    framing.fold((0, 0), |(n, k), inside| (n + 1, k + usize::from(inside)))
}

/// All views of the scene without the object.
#[derive(Clone)]
pub struct Sights(pub Vec<Sight>);

impl Sights {
    /// Of views with these depths, cameras and masks. `wide` are the masks with as much around them as depth may bleed over the
    /// object's border: what lies within them in nearly all views is not taken for background.
    pub fn new(grids: Vec<DepthGrid>, cameras: &[Camera], masks: &[GrayImage], wide: &[GrayImage]) -> Self {
        let inside = inside(&grids, cameras, wide);
        let views = grids.into_par_iter().zip(cameras).zip(masks);
        let mut sights = Self(views.map(|((grid, camera), mask)| Sight::new(grid, camera, mask)).collect());
        let on_object = |point: DVec3| {
            let (framed, covered) = framing(sights.0.iter().map(|sight| &sight.grid).zip(&inside), point);
            framed >= HULL_VIEWS && covered as f64 >= HULL * framed as f64
        };
        let bled: Vec<Vec<usize>> = (sights.0.par_iter().zip(&inside))
            .map(|(sight, inside)| {
                let near = (0..sight.depth.len()).filter(|site| inside[*site] && sight.depth[*site].is_finite());
                near.filter(|site| on_object(sight.point(*site, sight.depth[*site]))).collect()
            })
            .collect();
        sights.forget(bled);
        sights.forget(sights.floating());
        sights
    }

    /// The depth of these `[view]` sites is not known.
    fn forget(&mut self, sites: Vec<Vec<usize>>) {
        for (sight, sites) in self.0.iter_mut().zip(sites) {
            sites.into_iter().for_each(|site| sight.depth[site] = f64::NAN);
        }
    }

    /// `[site]` of a view's hole what others claim to be there.
    fn claims(&self, of: usize) -> Vec<Vec<Claim>> {
        let own = &self.0[of];
        let found: Vec<Vec<(usize, Claim)>> = (0..self.0.len())
            .into_par_iter()
            .filter(|view| *view != of && self.0[*view].grid.trusted)
            .map(|view| {
                let sight = &self.0[view];
                let mut found = vec![];
                for site in 0..sight.depth.len() {
                    let depth = sight.depth[site];
                    if !depth.is_finite() {
                        continue;
                    }
                    let point = sight.point(site, depth);
                    let Some((there, z)) = own.see(point).filter(|(there, _)| own.hole[*there]) else { continue };
                    let class = match (sight.hole[site], sight.grid.confirmed[site]) {
                        (true, _) => 0,
                        (false, true) => 1,
                        (false, false) => 2,
                    };
                    let (photographed, surface) = (!sight.hole[site], sight.surface[site]);
                    found.push((there, Claim { depth: z, view, class, photographed, surface }));
                }
                found
            })
            .collect();
        let mut claims = vec![vec![]; own.hole.len()];
        found.into_iter().flatten().for_each(|(site, claim)| claims[site].push(claim));
        claims
    }

    /// `[site]` of a view's hole the depth that others show or have solved, and whether photographs show it; NaN elsewhere.
    pub fn carried(&self, of: usize) -> Vec<(f64, bool)> {
        let own = &self.0[of];
        let claims = self.claims(of);
        let planes: Vec<Vec<planes::Plane>> = self.0.iter().map(|sight| sight.planes_for(own)).collect();
        let camera = own.grid.camera;
        let bleeding = super::BLEEDING * f64::from(camera.size[0].max(camera.size[1])) / f64::from(camera.focal[0]);
        // A claim is of a point somewhere in the site: its plane tells the depth in the site's middle.
        let in_middle = |site: usize, claim: &Claim| {
            let plane = planes[claim.view].get(usize::from(claim.surface));
            let depth = plane.map_or(f64::NAN, |plane| 1.0 / planes::on(plane, own.ray(site)));
            if (depth / claim.depth - 1.0).abs() <= SAME { depth } else { claim.depth }
        };
        let one = |site: usize| {
            if !own.hole[site] {
                return (f64::NAN, false);
            }
            let mut near: Vec<Claim> = own.around(site).flat_map(|site| claims[site].iter().copied()).collect();
            // Of solved views the first tells: each later one would carry the surface a little nearer.
            let bled = |z: f64| own.top.as_ref().is_some_and(|top| top.bleeds(own.ray(site), z, bleeding));
            near.retain(|claim| !bled(claim.depth));
            let solved = near.iter().filter(|claim| !claim.photographed);
            let first = solved.map(|claim| self.0[claim.view].rank).min();
            near.retain(|claim| claim.photographed || Some(self.0[claim.view].rank) == first);
            near.sort_unstable_by(|a, b| a.depth.total_cmp(&b.depth));
            let object = own.object[site];
            let solved = first.is_some();
            let (mut last, mut votes, mut refuted) = (0, Votes::of(self.0.len()), f64::NAN);
            // Each cluster begins with the next claim.
            for first in 0..near.len() {
                while near.get(last).is_some_and(|claim| claim.depth <= (1.0 + SAME) * near[first].depth) {
                    votes.come(&near[last]);
                    last += 1;
                }
                let (cluster, weight) = (&near[first..last], votes.weight);
                votes.go(&near[first]);
                if weight < ENOUGH {
                    continue;
                }
                // What a view was solved by is smoother than what was measured.
                let smooth = cluster.iter().filter(|claim| solved && !claim.photographed);
                let mut smooth: Vec<f64> = smooth.map(|claim| in_middle(site, claim)).collect();
                smooth.sort_unstable_by(f64::total_cmp);
                let depth = match smooth.len() {
                    0 => cluster[cluster.len() / 2].depth,
                    n => smooth[n / 2],
                };
                // The next cluster often has the same middle.
                if depth == refuted || depth <= (1.0 - SAME) * object {
                    continue;
                }
                if depth > (1.0 + APART) * own.stands[site] {
                    return (own.stands[site], false);
                }
                if self.is_refuted(of, own.point(site, depth)) {
                    refuted = depth;
                    continue;
                }
                if self.barred(of, site, depth) {
                    break;
                }
                return (depth, cluster.iter().any(|claim| claim.photographed));
            }
            (f64::NAN, false)
        };
        (0..own.hole.len()).into_par_iter().map(one).collect()
    }

    /// `[cell]` what each plane costs there by what photographs show on it, and at last where the site was carried to; nothing
    /// beside the hole, and where no view tells.
    fn evidence(
        &self,
        of: usize,
        sites: &[usize],
        size: [usize; 2],
        disparity: &[f32],
        planes: &[planes::Plane],
    ) -> Vec<Option<Vec<f64>>> {
        let own = &self.0[of];
        let shown = |depth: &(dyn Fn(usize) -> f64 + Sync)| -> (Vec<f64>, Vec<[f32; 3]>) {
            let told = |cell: usize| if disparity[sites[cell]].is_finite() { depth(cell) } else { f64::NAN };
            let (raw, colors): (Vec<f64>, Vec<[f32; 3]>) = self.shown_in_hole(of, sites, told).into_iter().unzip();
            ((0..raw.len()).map(|cell| flat::around(&raw, cell, size)).collect(), colors)
        };
        let mut all: Vec<(Vec<f64>, Vec<[f32; 3]>)> =
            planes.iter().map(|plane| shown(&|cell| 1.0 / planes::on(plane, own.ray(sites[cell])))).collect();
        all.push(shown(&|cell| 1.0 / f64::from(disparity[sites[cell]])));
        let one = |cell: usize| -> Option<Vec<f64>> {
            let site = sites[cell];
            (own.hole[site] && disparity[site].is_finite()).then_some(())?;
            let levels = |label: usize| all[label].0[cell];
            let least = (0..all.len()).map(levels).filter(|v| v.is_finite()).fold(f64::INFINITY, f64::min);
            let impossible = |plane: &planes::Plane| {
                let z = 1.0 / planes::on(plane, own.ray(site));
                let before = z < NEARER / f64::from(disparity[site]);
                let beyond = own.is_top(plane) && own.stands[site].is_nan();
                before || beyond || z > (1.0 + APART) * own.stands[site] || self.is_refuted(of, own.point(site, z))
            };
            let cost = |label: usize| {
                if planes.get(label).is_some_and(impossible) {
                    return planes::IMPOSSIBLE;
                }
                let behind = |plane: &planes::Plane| {
                    f64::from(disparity[site]) > (1.0 + flat::FARTHEST) * planes::on(plane, own.ray(site))
                };
                let apart = match levels(label).is_finite() {
                    true => ((levels(label) - least) / flat::LEVELS).min(planes::OFF),
                    false if planes.get(label).is_some_and(behind) => UNSHOWN_BEHIND,
                    false => UNSHOWN,
                };
                let covered = match label == planes.len() {
                    true => planes::REST,
                    false => {
                        flat::LATER * label as f64 + own.cover.cost_at(label, planes, own.ray(site), all[label].1[cell])
                    }
                };
                apart + covered
            };
            Some((0..all.len()).map(cost).collect())
        };
        (0..sites.len()).into_par_iter().map(one).collect()
    }

    /// Continues the planes around a view's hole in it: what is unknown, and what is carried there and does not speak against
    /// them, gets their inverse depth. Returns `[site]` the number of its plane, and the planes.
    fn continued(
        &self,
        of: usize,
        unknown: &[bool],
        disparity: &mut [f32],
        seed: u64,
    ) -> (Vec<u8>, Vec<planes::Plane>) {
        let own = &self.0[of];
        let near = own.surroundings();
        let mut surface = vec![0; own.hole.len()];
        let window = Window::around(&own.grid, |site| near[site]).expect("a hole has surroundings");
        let sites = window.sites();
        let rays: Vec<Option<[f64; 2]>> = sites.iter().map(|site| Some(own.ray(*site))).collect();
        // Between what is known and the hole lies what the object's depth has bled into.
        let ring = |site: usize| !own.hole[site] && own.depth[site].is_nan();
        let edge = |site: usize| own.hole[site] && own.around(site).any(|s| !own.hole[s]);
        let outline: Vec<bool> = sites.iter().map(|site| ring(*site) || edge(*site)).collect();
        let open: Vec<bool> = sites.iter().map(|site| unknown[*site] || ring(*site)).collect();
        let known: Vec<f32> = sites.iter().map(|site| disparity[*site]).collect();
        let size = window.size;
        let planes = match (own.around.is_empty(), own.covered.is_empty()) {
            (false, _) => own.around.clone(),
            (true, false) => own.covered.iter().map(|covered| covered.plane).collect(),
            (true, true) => planes::around(&known, &rays, &open, seed),
        };
        let supports = own.supports(&planes);
        let top = planes.iter().position(|plane| own.is_top(plane));
        let barred = |plane: usize, site: usize| {
            let beyond = top == Some(plane) && own.hole[site] && own.stands[site].is_nan();
            beyond || own.cuts.iter().any(|cut| cut.bars(plane, own.middle(site)))
        };
        // What has ended hides nothing.
        let under = |site: &usize| {
            let ended = |k: usize| barred(k, *site);
            let there = supports.iter().filter(|at| !(0..planes.len()).any(|k| at.is(&planes[k]) && ended(k)));
            let depths = there.filter_map(|support| support.under(own.ray(*site)));
            depths.reduce(f64::min).filter(|_| own.hole[*site])
        };
        let under: Vec<Option<f64>> = sites.iter().map(under).collect();
        let corner = own.middle(sites[0]) - 0.5;
        let against = |cell: usize, d: f64| {
            let site = sites[cell];
            if d.is_nan() || d <= 0.0 || own.hole[site] && 1.0 / d < (1.0 - APART) * own.object[site] {
                return 1.0;
            }
            if 1.0 / d > (1.0 + APART) * own.stands[site] {
                return 1.0;
            }
            let is = planes.iter().position(|plane| planes::on(plane, own.ray(site)) == d);
            if is.is_some_and(|plane| barred(plane, site)) {
                return 1.0;
            }
            let hidden = under[cell].is_some_and(|z| 1.0 / d > (1.0 + SAME) * z)
                || is.is_some_and(|plane| own.cover.has_ended(plane, &planes, own.ray(site)));
            self.against(of, own.point(site, 1.0 / d)).max(if hidden { BELOW } else { 0.0 })
        };
        let told = !own.around.is_empty();
        let mut costs = match (told, own.covered.is_empty()) {
            (true, _) => self.evidence(of, &sites, size, disparity, &planes),
            (false, false) => own.material_costs(&sites, &known, &against),
            (false, true) => vec![],
        };
        // Within its ends a surface is there, but where others look through it.
        for (cell, costs) in costs.iter_mut().enumerate().filter(|(cell, _)| own.hole[sites[*cell]]) {
            let site = sites[cell];
            // What stands on it may stand before it.
            let before = 1.0 / f64::from(known[cell]) < (1.0 - APART) * own.stands[site];
            let on_top = || top.filter(|_| own.stands[site].is_finite() && !before);
            let its = own.cuts.iter().find_map(|cut| cut.has(own.middle(site))).or_else(on_top);
            let stands = |plane: &usize| against(cell, planes::on(&planes[*plane], own.ray(site))) < 1.0;
            if let Some(own) = its.filter(stands) {
                *costs = Some((0..=planes.len()).map(|k| if k == own { 0.0 } else { planes::IMPOSSIBLE }).collect());
            }
        }
        let borders: Vec<[DVec2; 2]> = own.borders.iter().map(|ends| ends.map(|end| end - corner)).collect();
        let hole = planes::Hole {
            told,
            borders: &borders,
            costs: &costs,
            size,
            disparity: &known,
            rays: &rays,
            unknown: &open,
            outline: &outline,
            against,
        };
        let found = planes::surfaces(&hole, planes.clone());
        surface.fill(found.planes.len() as u8);
        // What is thin, before or behind a plane, is on none, though its surroundings are.
        let better = |cell: usize| {
            let label = usize::from(found.label[cell]);
            let costs = costs.get(cell).and_then(Option::as_ref);
            told && costs.is_some_and(|costs| costs[label] > costs[costs.len() - 1] + BETTER)
        };
        for (cell, &site) in sites.iter().enumerate() {
            surface[site] = found.label[cell];
            // What was measured to lie on a plane lies on it: single depths are noisier than all of them.
            let plane = found.planes.get(usize::from(found.label[cell])).filter(|_| own.hole[site]);
            let flat = plane.map_or(f32::NAN, |plane| planes::on(plane, own.ray(site)) as f32);
            if unknown[site] {
                disparity[site] = found.disparity[cell];
            } else if (flat / disparity[site] - 1.0).abs() <= FLAT || told && flat > 0.0 && !better(cell) {
                disparity[site] = flat;
            }
        }
        (surface, found.planes)
    }

    /// Gives every site of a view's hole its depth. The same seed finds the same.
    pub fn solve(&mut self, of: usize, seed: u64) {
        let carried = self.carried(of);
        let own = &self.0[of];
        let size = [own.grid.columns as usize, own.grid.rows as usize];
        let unknown: Vec<bool> = (0..own.hole.len()).map(|site| own.hole[site] && carried[site].0.is_nan()).collect();
        let near = own.surroundings();
        let known = |site: usize| match (near[site], own.hole[site]) {
            (false, _) => f64::NAN,
            (true, false) => own.depth[site],
            (true, true) => carried[site].0,
        };
        let mut disparity: Vec<f32> = (0..own.hole.len()).map(|site| (1.0 / known(site)) as f32).collect();
        let (mut surface, mut found_planes) = (vec![0; own.hole.len()], vec![]);
        let rank = self.0.iter().filter(|sight| sight.solved).count();
        if rank == 0 || !own.around.is_empty() || unknown.iter().filter(|unknown| **unknown).count() > FEW {
            (surface, found_planes) = self.continued(of, &unknown, &mut disparity, seed);
            super::island::sink(&own.hole, size, &found_planes, |site| own.ray(site), &mut surface, &mut disparity);
        }
        planes::membrane(&mut disparity, size, |site| own.hole[site]);
        let own = &mut self.0[of];
        for site in (0..unknown.len()).filter(|site| own.hole[*site]) {
            own.depth[site] = 1.0 / f64::from(disparity[site]);
        }
        own.measured = carried.into_iter().map(|(_, photographed)| photographed).collect();
        (own.surface, own.planes) = (surface, found_planes);
        (own.solved, own.rank) = (true, rank);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use image::Luma;

    use super::*;

    pub const SIZE: [u32; 2] = [48, 32];

    /// Five cameras side by side look at a wall at z = 4 with a square of this half width at z = 2 before it: grids, cameras,
    /// masks.
    pub fn views(half: f64) -> (Vec<DepthGrid>, Vec<Camera>, Vec<GrayImage>) {
        let camera = |x: f64| Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [-x, 0.0, 0.0],
            focal: [40.0; 2],
            principal: [24.0, 16.0],
            distortion: [0.0; 4],
            size: SIZE,
        };
        let cameras: Vec<Camera> = [-0.6, -0.3, 0.0, 0.3, 0.6].map(camera).to_vec();
        let on_object = |camera: &Camera, i: usize| {
            let [x, y, _] = camera.lift(camera.pixel_center(i), 2.0).expect("a ray");
            x.abs() < half && y.abs() < half
        };
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let grid = |camera: &Camera| DepthGrid {
            camera: *camera,
            stride: 1,
            columns: SIZE[0],
            rows: SIZE[1],
            depth: (0..pixels).map(|i| if on_object(camera, i) { 2.0 } else { 4.0 }).collect(),
            confirmed: vec![true; pixels],
            colors: vec![[0; 3]; pixels],
            trusted: true,
        };
        let mask = |camera: &Camera| {
            let inside = |x, y| on_object(camera, (y * SIZE[0] + x) as usize);
            GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([if inside(x, y) { 255 } else { 0 }]))
        };
        (cameras.iter().map(grid).collect(), cameras.clone(), cameras.iter().map(mask).collect())
    }

    /// What the views on the left and on the right show behind the square is the wall, and the middle view's hole gets it; what
    /// is solved is known to the next view.
    #[test]
    fn the_wall_goes_on_behind_the_object() {
        let (grids, cameras, masks) = views(0.2);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        for of in [2, 0] {
            sights.solve(of, 1);
            let sight = &sights.0[of];
            let holes: Vec<usize> = (0..sight.hole.len()).filter(|site| sight.hole[*site]).collect();
            assert!(holes.len() > 40, "{}", holes.len());
            assert!(holes.iter().all(|site| (sight.depth[*site] / 4.0 - 1.0).abs() < 0.01));
            assert!(holes.iter().all(|site| sight.measured[*site]));
        }
    }

    /// Of a floor that is seen at a grazing angle, a fifth deeper from row to row, the depth between rows is the floor's.
    #[test]
    fn a_grazing_floor_is_one_surface() {
        let (mut grids, cameras, masks) = views(0.0);
        let floor = |row: f64| 1.0 / (0.01 * row);
        for (site, depth) in grids[0].depth.iter_mut().enumerate() {
            *depth = floor((site as u32 / SIZE[0]) as f64 + 0.5);
        }
        let sight = Sight::new(grids.swap_remove(0), &cameras[0], &masks[0]);
        for row in [2.0, 4.3, 5.99, 17.6] {
            let (found, true_depth) = (sight.depth_at([20.2, row]), floor(row));
            assert!((found / true_depth - 1.0).abs() < 1e-9, "row {row}: {found}, {true_depth}");
        }
    }

    /// A near surface ends before a far one in an oblique line: its end is no staircase of sites, and a pole as wide as a site stays.
    #[test]
    fn surfaces_end_in_smooth_lines() {
        let (mut grids, cameras, masks) = views(0.0);
        let line = |x: f64| 9.3 + 0.31 * x;
        for (site, depth) in grids[0].depth.iter_mut().enumerate() {
            let [x, y] = [site as u32 % SIZE[0], site as u32 / SIZE[0]];
            *depth = if f64::from(y) + 0.5 > line(f64::from(x) + 0.5) || x == 40 { 2.0 } else { 4.0 };
        }
        let sight = Sight::new(grids.swap_remove(0), &cameras[0], &masks[0]);
        let places = || (20..380).flat_map(|x| (20..300).map(move |y| [f64::from(x) / 10.0, f64::from(y) / 10.0]));
        let wrong = |depth: &dyn Fn([f64; 2]) -> f64| {
            let of = |place: &[f64; 2]| (depth(*place) - if place[1] > line(place[0]) { 2.0 } else { 4.0 }).abs() > 0.5;
            let off = places().filter(of).map(|[x, y]| (y - line(x)).abs());
            off.fold((0usize, 0f64), |(count, most), off| (count + 1, most.max(off)))
        };
        let (stairs, smooth) = (wrong(&|place| sight.depth_at(place)), wrong(&|place| sight.smooth_depth_at(place)));
        assert!(smooth.0 * 4 < stairs.0 * 3 && smooth.1 < 0.4, "{smooth:?}, {stairs:?}");
        assert!((sight.smooth_depth_at([40.5, 12.5]) / 2.0 - 1.0).abs() < 0.01);
    }

    /// Later views were solved a little nearer: what the first told stays, for whoever asks next.
    #[test]
    fn the_first_solved_view_tells() {
        let (grids, cameras, masks) = views(0.4);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        for of in [2, 0, 4] {
            sights.solve(of, 1);
        }
        for nearer in [0, 4] {
            sights.0[nearer].depth.iter_mut().for_each(|z| *z *= 0.98);
        }
        let carried = sights.carried(1);
        let told: Vec<f64> = carried.iter().map(|(z, _)| *z).filter(|z| z.is_finite()).collect();
        assert!(told.len() > 40, "{}", told.len());
        // At one side a later view alone has told.
        let first = told.iter().filter(|z| (*z / 4.0 - 1.0).abs() < 0.002).count();
        assert!(first * 5 > told.len() * 4, "{told:?}");
    }

    /// A plane as another, turned and moved camera sees it has the same points.
    #[test]
    fn a_plane_is_the_same_for_another_camera() {
        let (grids, cameras, masks) = views(0.2);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let (sin, cos) = 0.3f32.sin_cos();
        sights.0[1].grid.camera.rotation = [[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]];
        sights.0[0].planes = vec![[0.1, -0.05, 0.3]];
        let seen = sights.0[0].planes_for(&sights.0[1])[0];
        for site in [0, 100, 700, 1500] {
            let ray = sights.0[0].ray(site);
            let point = sights.0[0].point(site, 1.0 / planes::on(&[0.1, -0.05, 0.3], ray));
            let [x, y, z] = sights.0[1].grid.camera.to_camera(point.to_array());
            assert!((planes::on(&seen, [x / z, y / z]) * z - 1.0).abs() < 1e-5);
        }
    }

    /// A view whose camera is wrong claims nothing: what it alone would show stays unknown to the others.
    #[test]
    fn views_that_are_not_trusted_claim_nothing() {
        let (mut grids, cameras, masks) = views(0.2);
        grids.iter_mut().enumerate().filter(|(view, _)| *view != 2).for_each(|(_, grid)| grid.trusted = false);
        let sights = Sights::new(grids, &cameras, &masks, &masks);
        assert!(sights.carried(2).iter().all(|(depth, _)| depth.is_nan()));
    }

    /// Behind the square the wall is taken, not a plane that others look through, nor one far before what they show.
    #[test]
    fn no_plane_stands_before_what_others_show() {
        let (grids, cameras, masks) = views(0.2);
        let sights = Sights::new(grids, &cameras, &masks, &masks);
        let (sites, size) = ((0..sights.0[2].hole.len()).collect::<Vec<_>>(), SIZE.map(|n| n as usize));
        let carried: Vec<f32> = sights.carried(2).iter().map(|(z, _)| (1.0 / z) as f32).collect();
        let planes = [1.5, 3.2, 4.0].map(|z| [0.0, 0.0, 1.0 / z]);
        let costs: Vec<Vec<f64>> = sights.evidence(2, &sites, size, &carried, &planes).into_iter().flatten().collect();
        assert!(costs.len() > 40, "{}", costs.len());
        assert!(costs.iter().all(|cost| cost[0] == planes::IMPOSSIBLE && cost[2] < cost[3]), "{costs:?}");
        // In its middle no two views look past the square.
        let refuted = costs.iter().filter(|cost| cost[1] == planes::IMPOSSIBLE).count();
        assert!(refuted * 2 > costs.len(), "{refuted} of {}", costs.len());
    }
}

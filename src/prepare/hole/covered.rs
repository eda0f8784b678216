//! Surfaces as what they are covered with.
//!
//! A hedge is as high as the bench before it, and where the cameras stand close together one plane fits both. What a surface is
//! covered with tells them apart: planes are found among the points of one material, by all views, and a border in a hole is one
//! of materials, too.

use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::flat::{self, Common, Measured};
use super::material::{Look, MATERIAL, materials, nearest, of_another};
use super::surface::{SAME, Sight, Sights};
use crate::prepare::planes::{self, Plane};

/// Least part of the points around all holes that makes a surface.
const LEAST: f64 = 0.04;
/// Sites to each side among which is what a site is covered with.
const REACH: i64 = 2;
/// Cost of a site for each [`MATERIAL`] that its colour is from its surface's, and at most.
const COST: f64 = 2.0;
const MOST: f64 = 4.0;
/// Cost of a site beside the surfaces, of whatever colour.
const BESIDE: f64 = 3.0;
/// Most that a site costs on a plane that is not covered with its material, where others are.
const BARE: f64 = 2.0;
/// Part of a plane's points that is of any material by chance, and from which on it is covered with that.
const STRAY: f64 = 0.02;
const COVERS: f64 = 0.25;
/// Cost of a plane behind one that it ends at. It does if of at least so many of its points this part at most lies behind that, and this
/// part at least before it.
const BEHIND: f64 = 3.0;
const ENOUGH: usize = 40;
const BEYOND: f64 = 0.02;
const BEFORE: f64 = 0.3;

/// A plane covered with one material.
#[derive(Clone, Copy, Debug)]
pub struct Covered {
    /// Inverse depth by x/z, y/z and 1 of the view's camera.
    pub plane: Plane,
    /// Surroundings on it.
    pub look: Look,
}

impl Covered {
    /// A plane of this look as a view sees it; nothing where its camera stands in it.
    pub(super) fn seen_by(plane: &Common, look: Look, sight: &Sight) -> Option<Self> {
        plane.seen_by(sight).map(|plane| Self { plane, look })
    }
}

/// Points around the holes, and the numbers of their materials.
pub(super) struct Points {
    /// All that are known, and those that others confirm.
    all: [Vec<(Measured, Option<usize>)>; 2],
    materials: Vec<[f32; 3]>,
}

/// The materials that planes are covered with, and where they end.
#[derive(Clone, Default)]
pub(super) struct Cover {
    materials: Vec<[f32; 3]>,
    /// `[plane][material]` what a site of it costs there.
    costs: Vec<Vec<f64>>,
    /// `[plane]` those that it ends at: a floor at its walls.
    ends: Vec<Vec<usize>>,
}

impl Points {
    /// The materials of these planes, and their ends. A material costs on a plane the logarithm of how much less of that it covers than
    /// of others. Confirmed points are mostly where something ends, with what is beside it; all other points often have the depth of
    /// what is beside them. So a plane is covered with what both say.
    pub fn cover(&self, planes: &[Common]) -> Cover {
        let parts = self.all.each_ref().map(|points| self.parts(points, planes));
        let part = |plane: usize, k: usize| parts[0][plane][k].min(parts[1][plane][k]);
        let most = |k: usize| (0..planes.len()).map(|plane| part(plane, k)).fold(0.0, f64::max).min(COVERS);
        let cost = |plane: usize, k: usize| (most(k) / part(plane, k)).ln().clamp(0.0, BARE);
        let of = |plane: usize| (0..self.materials.len()).map(|k| cost(plane, k)).collect();
        Cover { costs: (0..planes.len()).map(of).collect(), ends: self.ends(planes), materials: self.materials.clone() }
    }

    /// The nearest plane that a point lies on.
    fn on(at: &Measured, planes: &[Common]) -> Option<usize> {
        let near = (0..planes.len()).filter(|k| planes[*k].has(at));
        near.min_by(|a, b| planes[*a].off(at).abs().total_cmp(&planes[*b].off(at).abs()))
    }

    /// `[plane]` the planes behind which none of it is seen.
    fn ends(&self, planes: &[Common]) -> Vec<Vec<usize>> {
        let mut on: Vec<Vec<&Measured>> = vec![vec![]; planes.len()];
        for (at, _) in &self.all[1] {
            if let Some(plane) = Self::on(at, planes) {
                on[plane].push(at);
            }
        }
        let ends = |its: &[&Measured], wall: &Common| {
            let part =
                |is: &dyn Fn(f64) -> bool| its.iter().filter(|at| is(wall.off(at))).count() as f64 / its.len() as f64;
            let apart = 3.0 * flat::THICKNESS;
            its.len() >= ENOUGH && part(&|off| off > apart) <= BEYOND && part(&|off| off < -apart) >= BEFORE
        };
        let of = |k: usize| (0..planes.len()).filter(|wall| *wall != k && ends(&on[k], &planes[*wall])).collect();
        (0..planes.len()).map(of).collect()
    }

    /// `[plane][material]` the part of a plane's points, of these, that are of a material.
    fn parts(&self, points: &[(Measured, Option<usize>)], planes: &[Common]) -> Vec<Vec<f64>> {
        let mut counts = vec![vec![1.0; self.materials.len()]; planes.len()];
        for (at, material) in points {
            if let (Some(plane), Some(material)) = (Self::on(at, planes), *material) {
                counts[plane][material] += 1.0;
            }
        }
        let part = |of: &Vec<f64>| of.iter().map(|count| STRAY + count / of.iter().sum::<f64>()).collect();
        counts.iter().map(part).collect()
    }
}

impl Cover {
    /// The cost of a colour on a plane; nothing off all planes, and where the colour is of no material.
    fn cost(&self, plane: usize, color: [f32; 3]) -> f64 {
        let material = nearest(color, &self.materials).filter(|k| of_another(color, self.materials[*k]) <= MATERIAL);
        material.and_then(|k| Some(self.costs.get(plane)?[k])).unwrap_or(0.0)
    }

    /// Whether a plane, of these, has ended where a ray (x/z, y/z) meets it.
    pub fn has_ended(&self, plane: usize, planes: &[Plane], ray: [f64; 2]) -> bool {
        let inverse = planes::on(&planes[plane], ray);
        let walls = self.ends.get(plane).into_iter().flatten();
        walls.filter_map(|wall| planes.get(*wall)).any(|wall| planes::on(wall, ray) > (1.0 + SAME) * inverse)
    }

    /// The cost of a site on a plane, of these, by its colour and where it is.
    pub fn cost_at(&self, plane: usize, planes: &[Plane], ray: [f64; 2], color: [f32; 3]) -> f64 {
        self.cost(plane, color) + if self.has_ended(plane, planes, ray) { BEHIND } else { 0.0 }
    }
}

impl Sight {
    /// The colour of a site, 0 to 1.
    pub(super) fn color(&self, site: usize) -> [f32; 3] {
        self.grid.colors[site].map(|v| f32::from(v) / 255.0)
    }

    /// Surroundings of a site without the object; NaN in the middle of it. Of the four squares with the site in a corner, those at least
    /// half of which is there, the one that varies least (Kuwahara 1976): the others may reach over a border.
    pub fn look_around(&self, site: usize) -> Look {
        let at = |dx: i64, dy: i64| {
            let [column, row] =
                [site % self.grid.columns as usize, site / self.grid.columns as usize].map(|v| v as i64);
            self.grid.site(column + dx, row + dy).filter(|at| !self.hole[*at])
        };
        let look = |[x, y]: [i64; 2]| {
            let near: Vec<[f32; 3]> = (0..=REACH)
                .flat_map(|u| (0..=REACH).filter_map(move |v| at(x * u, y * v)))
                .map(|at| self.color(at))
                .collect();
            let mean = |of: &dyn Fn(&[f32; 3]) -> f32| near.iter().map(of).sum::<f32>() / near.len() as f32;
            let light = |color: &[f32; 3]| color.iter().sum::<f32>() / 3.0;
            let middle = mean(&light);
            let grain = mean(&|c| (light(c) - middle).powi(2)).sqrt();
            (near.len(), [mean(&|c| c[0]), mean(&|c| c[1]), mean(&|c| c[2]), grain])
        };
        let looks = [[-1, -1], [1, -1], [-1, 1], [1, 1]].map(look);
        // Few sites vary little; where no square is half there, the fullest.
        let half = ((REACH + 1).pow(2) as usize).div_ceil(2);
        let least = looks.iter().map(|(count, _)| *count).fold(1, usize::max).min(half);
        let full = looks.into_iter().filter(|(count, _)| *count >= least).map(|(_, look)| look);
        full.min_by(|a, b| a[3].total_cmp(&b[3])).unwrap_or([f32::NAN; 4])
    }

    /// The material of the surface of this number, where that is known.
    pub fn material(&self, surface: usize) -> Option<Look> {
        self.covered.get(surface).filter(|_| surface < self.planes.len()).map(|covered| covered.look)
    }

    /// `[cell]` what each covered plane costs there, and at last to be on none, by depth and colour; nothing in the hole. `known` is the
    /// inverse depth of these sites, and `against` what speaks against one where that is not known.
    pub(super) fn material_costs(
        &self,
        sites: &[usize],
        known: &[f32],
        against: &(dyn Fn(usize, f64) -> f64 + Sync),
    ) -> Vec<Option<Vec<f64>>> {
        let one = |cell: usize| -> Option<Vec<f64>> {
            let site = Some(sites[cell]).filter(|site| !self.hole[*site])?;
            let (look, ray, d) = (self.look_around(site), self.ray(site), f64::from(known[cell]));
            let cost = |covered: &Covered| {
                let surface = planes::on(&covered.plane, ray);
                let off = match d > 0.0 && d.is_finite() {
                    true => ((surface - d).abs() / (planes::THICKNESS * d)).min(planes::OFF),
                    false => planes::IMPOSSIBLE * if surface > 0.0 { against(cell, surface) } else { 1.0 },
                };
                off + (COST * f64::from(of_another(look, covered.look) / MATERIAL)).min(MOST)
            };
            Some(self.covered.iter().map(cost).chain([BESIDE]).collect())
        };
        (0..sites.len()).into_par_iter().map(one).collect()
    }
}

impl Sights {
    /// The surfaces of one material around the holes, by what all views show: planes of the materials there, and these. The same seed
    /// finds the same.
    pub(super) fn covered(&self, seed: u64) -> Vec<(Common, Look)> {
        let look = |(view, site): (usize, usize)| self.0[view].look_around(site);
        let all: Vec<((usize, usize), Look)> = self.around_holes(true).into_iter().map(|at| (at, look(at))).collect();
        let looks = materials(&all.iter().map(|(_, look)| *look).collect::<Vec<_>>());
        let least = (LEAST * all.len() as f64).ceil() as usize;
        let mut rng = Pcg64::new(seed.into(), 44);
        let looks = &looks;
        let of = |k: usize| all.iter().filter(move |(_, look)| nearest(*look, looks) == Some(k)).map(|(at, _)| *at);
        let mut found = vec![];
        for (k, look) in looks.iter().enumerate() {
            let points = of(k).map(|(view, site)| self.measured(view, site)).collect();
            found.extend(flat::largest(points, least, &mut rng).into_iter().map(|plane| (plane, *look)));
        }
        log::debug!("covered: materials {looks:?} on {} surfaces", found.len());
        found
    }

    /// Points around the holes, and what their photographs show of them.
    pub(super) fn points(&self) -> Points {
        let point = |(view, site)| (self.measured(view, site), self.0[view].color(site));
        let all =
            [false, true].map(|confirmed| self.around_holes(confirmed).into_iter().map(point).collect::<Vec<_>>());
        let materials = materials(&all[0].iter().map(|(_, color)| *color).collect::<Vec<_>>());
        let all = all.map(|points| points.into_iter().map(|(at, color)| (at, nearest(color, &materials))).collect());
        Points { all, materials }
    }
}

#[cfg(test)]
mod tests {
    use super::super::surface::tests::{SIZE, views};
    use super::*;

    /// Beside a border a site is of its own side, and so is its grain: smooth beside what is rough.
    #[test]
    fn a_site_at_a_border_is_of_its_own_side() {
        let (mut grids, cameras, masks) = views(0.0);
        let width = SIZE[0] as usize;
        for (site, color) in grids[0].colors.iter_mut().enumerate() {
            let [x, y] = [site % width, site / width];
            *color = if x < 20 { [100; 3] } else { [if (x + y) % 2 == 0 { 60 } else { 220 }; 3] };
        }
        let sight = Sight::new(grids.swap_remove(0), &cameras[0], &masks[0]);
        let [smooth, rough] = [19, 22].map(|x| sight.look_around(10 * width + x));
        assert!((smooth[0] - 100.0 / 255.0).abs() < 1e-6 && smooth[3] < 1e-6, "{smooth:?}");
        assert!(rough[3] > 0.2, "{rough:?}");
        // At the corner of a hole, which leaves one site alone of one square.
        let mut sight = sight;
        (0..sight.hole.len()).for_each(|site| sight.hole[site] = site / width > 10 || site % width > 30);
        let corner = sight.look_around(10 * width + 30);
        assert!(corner[3] > 0.2, "{corner:?}");
    }

    /// A hedge above a bench is a hundredth farther away, so that one plane fits both: they are two surfaces by their colours, and each goes
    /// on in the hole up to where they meet on both sides.
    #[test]
    fn what_looks_different_is_two_surfaces() {
        let (mut grids, cameras, masks) = views(0.3);
        for grid in &mut grids {
            for site in 0..grid.depth.len() {
                let hedge = (site as u32 / SIZE[0]) < 17;
                grid.colors[site] = if hedge { [40, 90, 40] } else { [130, 150, 180] };
                if grid.depth[site] == 4.0 && hedge {
                    grid.depth[site] = 4.04;
                }
            }
        }
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        sights.flatten(1);
        assert!(sights.0.iter().all(|sight| sight.around.is_empty() && sight.covered.len() >= 2));
        sights
            .0
            .iter_mut()
            .enumerate()
            .filter(|(view, _)| *view != 2)
            .for_each(|(_, sight)| sight.grid.trusted = false);
        sights.solve(2, 1);
        let sight = &sights.0[2];
        let wrong = (0..sight.hole.len()).filter(|site| sight.hole[*site]).filter(|site| {
            let hedge = (*site as u32 / SIZE[0]) < 17;
            let color = sight.material(usize::from(sight.surface[*site]));
            color.is_none_or(|look| (look[1] > look[2]) != hedge)
        });
        let holes = sight.hole.iter().filter(|hole| **hole).count();
        let wrong = wrong.count();
        assert!(holes > 30 && wrong * 10 < holes, "{wrong} of {holes}");
    }
}

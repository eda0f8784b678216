//! Surfaces as what they are covered with.
//!
//! A hedge is as high as the bench before it, and where the cameras stand close together one plane fits both. What a surface is
//! covered with tells them apart: planes are found among the points of one material, by all views, and a border in a hole is one
//! of materials, too.

use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::flat::{self, Common};
use super::material::{MATERIAL, materials, nearest, of_another};
use super::surface::{Sight, Sights};
use crate::prepare::planes::{self, Plane};

/// Least part of the points around all holes that makes a surface.
const LEAST: f64 = 0.04;
/// Sites to each side whose mean says what a site is covered with.
const REACH: i64 = 2;
/// Cost of a site for each [`MATERIAL`] that its colour is from its surface's, and at most.
const COST: f64 = 2.0;
const MOST: f64 = 4.0;
/// Cost of a site beside the surfaces, of whatever colour.
const BESIDE: f64 = 3.0;

/// A plane covered with one material.
#[derive(Clone, Copy, Debug)]
pub struct Covered {
    /// Inverse depth by x/z, y/z and 1 of the view's camera.
    pub plane: Plane,
    /// The mean colour of surroundings on it, 0 to 1.
    pub color: [f32; 3],
}

impl Covered {
    /// A plane of this colour as a view sees it; nothing where its camera stands in it.
    pub(super) fn seen_by(plane: &Common, color: [f32; 3], sight: &Sight) -> Option<Self> {
        plane.seen_by(sight).map(|plane| Self { plane, color })
    }
}

impl Sight {
    /// The mean colour around a site, 0 to 1, without the object; NaN in the middle of it.
    pub fn color_around(&self, site: usize) -> [f32; 3] {
        let near: Vec<usize> = self.grid.around(site, REACH).filter(|at| !self.hole[*at]).collect();
        let sum = |c: usize| near.iter().map(|at| f32::from(self.grid.colors[*at][c])).sum::<f32>();
        std::array::from_fn(|c| sum(c) / (255.0 * near.len() as f32))
    }

    /// The material of the surface of this number, where that is known.
    pub fn material(&self, surface: usize) -> Option<[f32; 3]> {
        self.covered.get(surface).filter(|_| surface < self.planes.len()).map(|covered| covered.color)
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
            let (color, ray, d) = (self.color_around(site), self.ray(site), f64::from(known[cell]));
            let cost = |covered: &Covered| {
                let surface = planes::on(&covered.plane, ray);
                let off = match d > 0.0 && d.is_finite() {
                    true => ((surface - d).abs() / (planes::THICKNESS * d)).min(planes::OFF),
                    false => planes::IMPOSSIBLE * if surface > 0.0 { against(cell, surface) } else { 1.0 },
                };
                off + (COST * f64::from(of_another(color, covered.color) / MATERIAL)).min(MOST)
            };
            Some(self.covered.iter().map(cost).chain([BESIDE]).collect())
        };
        (0..sites.len()).into_par_iter().map(one).collect()
    }
}

impl Sights {
    /// The surfaces of one material around the holes, by what all views show: planes of the materials there, and their colours. The same
    /// seed finds the same.
    pub(super) fn covered(&self, seed: u64) -> Vec<(Common, [f32; 3])> {
        let color = |(view, site): (usize, usize)| self.0[view].color_around(site);
        let all: Vec<((usize, usize), [f32; 3])> = self.around_holes().into_iter().map(|at| (at, color(at))).collect();
        let colors = materials(&all.iter().map(|(_, color)| *color).collect::<Vec<_>>());
        let least = (LEAST * all.len() as f64).ceil() as usize;
        let mut rng = Pcg64::new(seed.into(), 44);
        let colors = &colors;
        let of = |k: usize| all.iter().filter(move |(_, color)| nearest(*color, colors) == Some(k)).map(|(at, _)| *at);
        let mut found = vec![];
        for (k, color) in colors.iter().enumerate() {
            let points = of(k).map(|(view, site)| self.measured(view, site)).collect();
            found.extend(flat::largest(points, least, &mut rng).into_iter().map(|plane| (plane, *color)));
        }
        log::debug!("covered: {} materials on {} surfaces", colors.len(), found.len());
        found
    }
}

#[cfg(test)]
mod tests {
    use super::super::surface::tests::{SIZE, views};
    use super::*;

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
            color.is_none_or(|color| (color[1] > color[2]) != hedge)
        });
        let holes = sight.hole.iter().filter(|hole| **hole).count();
        let wrong = wrong.count();
        assert!(holes > 30 && wrong * 10 < holes, "{wrong} of {holes}");
    }
}

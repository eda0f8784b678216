//! Where the rays of other views meet what a view has behind its object.

use glam::DVec3;
use rayon::prelude::*;

use super::surface::{APART, SAME, Sight};

/// Cells of a relief along a side of a site.
const CELLS: usize = 4;
/// Steps along a ray at most, as a multiple of the cells along both sides.
const LONGEST: usize = 4;

/// A view's surface behind its object, with ends between its sites.
pub struct Relief {
    /// Columns of cells.
    columns: usize,
    /// `[cell]` inverse depth; NaN beside the hole.
    inverse: Vec<f32>,
    /// World points in the hole, one for each of its sites.
    points: Vec<DVec3>,
}

impl Relief {
    /// The relief of a view that is solved.
    pub fn new(sight: &Sight) -> Self {
        let columns = sight.grid.columns as usize * CELLS;
        let inverse = |cell: usize| {
            let at = [cell % columns, cell / columns];
            let site = at[1] / CELLS * sight.grid.columns as usize + at[0] / CELLS;
            let place = at.map(|v| (v as f64 + 0.5) / CELLS as f64);
            if sight.hole[site] { (1.0 / sight.smooth_depth_at(place)) as f32 } else { f32::NAN }
        };
        let holes = (0..sight.hole.len()).filter(|site| sight.hole[*site] && sight.depth[*site].is_finite());
        Self {
            columns,
            inverse: (0..sight.hole.len() * CELLS * CELLS).into_par_iter().map(inverse).collect(),
            points: holes.map(|site| sight.point(site, sight.depth[site])).collect(),
        }
    }

    /// The least and the greatest inverse depth of it in a view; nothing where that has none of it before it.
    pub fn range(&self, of: &Sight) -> Option<[f64; 2]> {
        let seen = self.points.iter().filter_map(|point| of.see(*point));
        seen.fold(None, |range: Option<[f64; 2]>, (_, z)| {
            let [low, high] = range.unwrap_or([f64::INFINITY, 0.0]);
            Some([low.min(1.0 / z), high.max(1.0 / z)])
        })
    }

    /// The inverse depth, of those within a range, at which a ray of another view first meets it: the ray's points are `eye` plus `way`
    /// over the inverse depth. What lies behind an end of it, unseen from this view (`sight`), is not met.
    pub fn meets(&self, sight: &Sight, eye: DVec3, way: DVec3, [low, high]: [f64; 2]) -> Option<f64> {
        let (at_infinity, per_inverse) = sight.homogeneous(eye, way);
        // The place in cells, and the inverse depth in this view.
        let place = |d: f64| {
            let at = at_infinity + per_inverse * d;
            (at.z > 0.0).then(|| ([at.x / at.z, at.y / at.z].map(|v| v * CELLS as f64), d / at.z))
        };
        // A little more on both sides, for the surface to be between two steps.
        let (low, high) = (low * (1.0 - SAME), high * (1.0 + SAME));
        let [from, to] = [place(low)?.0, place(high)?.0];
        let rows = self.inverse.len() / self.columns;
        // A ray that nearly meets this view's centre has no end in its picture.
        let most = (LONGEST * (self.columns + rows)) as f64;
        let cells = (from[0] - to[0]).abs().max((from[1] - to[1]).abs()).ceil().clamp(2.0, most);
        // How much nearer than the surface the last point was, the surface's inverse depth there, and the point's.
        let mut before: Option<(f64, f64, f64)> = None;
        for step in 0..=cells as usize {
            let d = high + (low - high) * step as f64 / cells;
            let ([x, y], inverse) = place(d)?;
            let inside = x >= 0.0 && y >= 0.0 && (x as usize) < self.columns && (y as usize) < rows;
            let there = if inside { f64::from(self.inverse[y as usize * self.columns + x as usize]) } else { f64::NAN };
            if there.is_nan() {
                before = None;
                continue;
            }
            let nearer = inverse / there - 1.0;
            if let Some((last, there_before, d_before)) = before
                && last >= 0.0
                && nearer < 0.0
                && (there / there_before - 1.0).abs() <= SAME
            {
                return Some(d_before + (d - d_before) * last / (last - nearer));
            }
            before = Some((nearer, there, d));
        }
        None
    }

    /// Whether the view sees farther than a world point: nothing is there.
    pub fn sees_through(&self, sight: &Sight, point: DVec3) -> bool {
        let Some((site, [x, y], z)) = sight.seen(point) else { return false };
        let [x, y] = [x, y].map(|v| (v * CELLS as f64) as usize);
        let there =
            if sight.hole[site] { 1.0 / f64::from(self.inverse[y * self.columns + x]) } else { sight.depth[site] };
        there > z * (1.0 + APART)
    }
}

#[cfg(test)]
mod tests {
    use super::super::surface::{Sights, tests};
    use super::*;

    /// Behind the object the middle view has a board at z = 3, left of its middle, and the wall at z = 4. From 0.6 to the right a
    /// ray meets the board up to its end, and the wall where the board does not hide it from the middle view.
    #[test]
    fn a_surface_ends_where_it_ends_in_the_view_that_has_it() {
        let (grids, cameras, masks) = tests::views(0.6);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let sight = &mut sights.0[2];
        let columns = sight.grid.columns as usize;
        for site in (0..sight.hole.len()).filter(|site| sight.hole[*site]) {
            sight.depth[site] = if site % columns < columns / 2 { 3.0 } else { 4.0 };
        }
        let (sight, other) = (&sights.0[2], &sights.0[4]);
        let relief = Relief::new(sight);
        let range = relief.range(other).expect("it is seen");
        assert!((range[0] - 0.25).abs() < 1e-9 && (range[1] - 1.0 / 3.0).abs() < 1e-9, "{range:?}");
        let eye = other.eye();
        let to = |x: f64, z: f64| {
            let way = (DVec3::new(x, 0.02, z) - eye) / z;
            relief.meets(sight, eye, way, range).map(|d| (eye + way / d).to_array())
        };
        let near = |met: Option<[f64; 3]>, x: f64, z: f64| {
            met.is_some_and(|p| (p[0] - x).abs() < 0.02 && (p[2] - z).abs() < 0.02)
        };
        for x in [-0.6, -0.3, -0.04] {
            assert!(near(to(x, 3.0), x, 3.0), "{x}: {:?}", to(x, 3.0));
        }
        // Beside the board the wall, but where the board hides it from the middle view.
        for x in [0.1, 0.5] {
            assert!(near(to(x, 4.0), x, 4.0), "{x}: {:?}", to(x, 4.0));
        }
        assert_eq!(to(0.04, 3.0), None);
    }
}

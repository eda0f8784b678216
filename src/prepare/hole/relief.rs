//! Where the rays of other views meet what a view has behind its object.

use glam::DVec3;
use rayon::prelude::*;

use super::surface::{APART, SAME, Sight};

/// Cells of a relief along a side of a site.
const CELLS: usize = 4;
/// Steps along a ray at most, as a multiple of the cells along both sides.
const LONGEST: usize = 4;
/// Cells along a side of a tile.
const TILE: usize = 16;

/// A view's surface behind its object, with ends between its sites.
pub struct Relief {
    /// Columns of cells.
    columns: usize,
    /// `[cell]` inverse depth; NaN beside the hole.
    inverse: Vec<f32>,
    /// `[tile]` the least and the greatest inverse depth of its cells; infinity and its negative where none has one.
    tiles: Vec<[f32; 2]>,
    /// World points in the hole, one for each of its sites.
    points: Vec<DVec3>,
    /// The cells that have one: the first column and row, and the ends of both.
    all: [[usize; 2]; 2],
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
        let inverse: Vec<f32> = (0..sight.hole.len() * CELLS * CELLS).into_par_iter().map(inverse).collect();
        let across = columns.div_ceil(TILE);
        let mut tiles = vec![[f32::INFINITY, f32::NEG_INFINITY]; across * (inverse.len() / columns).div_ceil(TILE)];
        for (cell, inverse) in inverse.iter().enumerate() {
            let [least, greatest] = &mut tiles[cell / columns / TILE * across + cell % columns / TILE];
            (*least, *greatest) = (least.min(*inverse), greatest.max(*inverse));
        }
        let mut all = [[columns, inverse.len() / columns], [0; 2]];
        for cell in (0..inverse.len()).filter(|cell| !inverse[*cell].is_nan()) {
            let at = [cell % columns, cell / columns];
            let [least, end] = all;
            all = [std::array::from_fn(|a| least[a].min(at[a])), std::array::from_fn(|a| end[a].max(at[a] + 1))];
        }
        let points = holes.map(|site| sight.point(site, sight.depth[site])).collect();
        Self { columns, inverse, tiles, points, all }
    }

    /// The cells that have a depth: the first column and row, and the ends of both.
    pub fn all(&self) -> [[usize; 2]; 2] {
        self.all
    }

    /// The cells that hold places of its view in sites, those beside them too.
    pub fn around(&self, places: impl Iterator<Item = [f64; 2]>) -> [[usize; 2]; 2] {
        let sides = [self.columns, self.inverse.len() / self.columns];
        places.fold([sides, [0; 2]], |[least, end], place| {
            let cell = place.map(|v| v.max(0.0) * CELLS as f64);
            let near = |a: usize| (cell[a] as usize).saturating_sub(CELLS);
            let far = |a: usize| (cell[a] as usize + CELLS + 1).min(sides[a]);
            [std::array::from_fn(|a| least[a].min(near(a))), std::array::from_fn(|a| end[a].max(far(a)))]
        })
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
    /// over the inverse depth. What lies behind an end of it, unseen from this view (`sight`), is not met. Where it is met beside
    /// `within`, it may be told as nothing.
    pub fn meets(
        &self,
        sight: &Sight,
        eye: DVec3,
        way: DVec3,
        [low, high]: [f64; 2],
        within: [[usize; 2]; 2],
    ) -> Option<f64> {
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
        let d_at = |step: usize| high + (low - high) * step as f64 / cells;
        let at = |step: usize| {
            let d = d_at(step);
            let ([x, y], inverse) = place(d)?;
            let inside = x >= 0.0 && y >= 0.0 && (x as usize) < self.columns && (y as usize) < rows;
            Some((d, inverse, inside.then_some([x as usize, y as usize])))
        };
        // Steps go from `to` to `from`.
        let axes = || (0..2).filter(|axis| from[*axis] != to[*axis]);
        let grows = |axis: usize| from[axis] > to[axis];
        // The step, broken, at which a coordinate of the ray's place has a value; the first or the last one where it never has.
        let step_at = |axis: usize, value: usize| {
            let value = value as f64;
            if (value <= to[axis]) == grows(axis) {
                return 0.0;
            }
            if (value >= from[axis]) == grows(axis) {
                return cells;
            }
            let value = value / CELLS as f64;
            let d = (at_infinity[axis] - value * at_infinity.z) / (value * per_inverse.z - per_inverse[axis]);
            (high - d) / (high - low) * cells
        };
        // The first and the last step in a box, with a step more at both ends for rounding.
        let inside = |[least, end]: [[usize; 2]; 2]| {
            let side = |axis: usize, end_of: bool| step_at(axis, if end_of { end[axis] } else { least[axis] });
            let first = axes().map(|axis| side(axis, !grows(axis))).fold(0.0, f64::max) - 1.0;
            (first, axes().map(|axis| side(axis, grows(axis))).fold(cells, f64::min) + 1.0)
        };
        let ((enters, last), (first, end)) = (inside(within), inside(self.all));
        let last = last.min(end);
        if enters > last || first > last {
            return None;
        }
        let tile = |cell: [usize; 2]| cell.map(|v| v / TILE);
        // The last step in the tile of one; that itself where rounding lets nothing be said.
        let last_in_tile = |step: usize, own: [usize; 2]| {
            let ends = axes().map(|axis| step_at(axis, (own[axis] + usize::from(grows(axis))) * TILE));
            let end = ends.fold(cells, f64::min).max(step as f64) as usize;
            let is_in = |step: &usize| at(*step).is_some_and(|(.., cell)| cell.is_some_and(|cell| tile(cell) == own));
            [end, end.saturating_sub(1)].into_iter().find(|end| *end > step && is_in(end)).unwrap_or(step)
        };
        let surface = |cell: Option<[usize; 2]>| cell.map(|[x, y]| f64::from(self.inverse[y * self.columns + x]));
        // How much nearer than the surface the point of a step is, the surface's inverse depth there, and the point's.
        let nearer = |step: usize| {
            let (d, inverse, cell) = at(step)?;
            let there = surface(cell).filter(|there| !there.is_nan())?;
            Some((inverse / there - 1.0, there, d))
        };
        // The last step before, where it may be nearer than the surface.
        let mut before: Option<usize> = None;
        let mut step = first.max(0.0) as usize;
        while step <= last.min(cells) as usize {
            let (_, inverse, cell) = at(step)?;
            let Some(own) = cell.map(tile) else {
                (step, before) = (step + 1, None);
                continue;
            };
            // Within a tile whose surface is all before the ray, or all behind it, nothing is met.
            let [least, greatest] = self.tiles[own[1] * self.columns.div_ceil(TILE) + own[0]].map(f64::from);
            let end_is = |which: &dyn Fn(f64) -> bool| {
                let end = last_in_tile(step, own);
                at(end).is_some_and(|(_, inverse, _)| which(inverse)).then_some(end)
            };
            if inverse >= greatest
                && let Some(end) = end_is(&|inverse| inverse >= greatest)
            {
                (step, before) = (end + 1, Some(end));
                continue;
            }
            let here = nearer(step);
            if let Some((now, there, d)) = here.filter(|(now, ..)| *now < 0.0)
                && let Some((last, there_before, d_before)) = before.and_then(nearer)
                && last >= 0.0
                && (there / there_before - 1.0).abs() <= SAME
            {
                return Some(d_before + (d - d_before) * last / (last - now));
            }
            before = here.map(|_| step);
            if inverse < least
                && let Some(end) = end_is(&|inverse| inverse < least)
            {
                (step, before) = (end, None);
            }
            step += 1;
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

    /// Where a walk over every step of a ray meets a relief, with the cells that it looked at.
    fn walk(relief: &Relief, sight: &Sight, eye: DVec3, way: DVec3, [low, high]: [f64; 2]) -> Option<f64> {
        let (a, b) = sight.homogeneous(eye, way);
        let place = |d: f64| {
            let at = a + b * d;
            (at.z > 0.0).then(|| ([at.x / at.z * CELLS as f64, at.y / at.z * CELLS as f64], d / at.z))
        };
        let (low, high) = (low * (1.0 - SAME), high * (1.0 + SAME));
        let [from, to] = [place(low)?.0, place(high)?.0];
        let rows = relief.inverse.len() / relief.columns;
        let cells = (from[0] - to[0]).abs().max((from[1] - to[1]).abs()).ceil();
        let cells = cells.clamp(2.0, (LONGEST * (relief.columns + rows)) as f64);
        let mut before: Option<[f64; 3]> = None;
        for step in 0..=cells as usize {
            let d = high + (low - high) * step as f64 / cells;
            let ([x, y], inverse) = place(d)?;
            let is_in = x >= 0.0 && y >= 0.0 && (x as usize) < relief.columns && (y as usize) < rows;
            let there =
                if is_in { f64::from(relief.inverse[y as usize * relief.columns + x as usize]) } else { f64::NAN };
            let nearer = inverse / there - 1.0;
            match before {
                Some([last, same, d_before]) if last >= 0.0 && nearer < 0.0 && (there / same - 1.0).abs() <= SAME => {
                    return Some(d_before + (d - d_before) * last / (last - nearer));
                }
                _ => before = (!there.is_nan()).then_some([nearer, there, d]),
            }
        }
        None
    }

    /// Rays from all sides, along rows, backwards and past the picture, meet a relief of steps, slopes and gaps where a walk over
    /// every step does: nothing that is passed over is missed.
    #[test]
    fn tiles_that_are_passed_over_hold_nothing() {
        let (grids, cameras, masks) = tests::views(0.6);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let columns = sights.0[2].grid.columns as usize;
        let mut state = 7u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / (1u64 << 31) as f64
        };
        for site in 0..sights.0[2].hole.len() {
            let [x, y] = [site % columns, site / columns];
            sights.0[2].hole[site] = (x / 3 + y / 5) % 7 != 0;
            sights.0[2].depth[site] = [3.0, 4.0, 3.5 + 0.02 * x as f64][(x / 9 + y / 6) % 3];
        }
        let sight = &sights.0[2];
        let relief = Relief::new(sight);
        let mut met = 0;
        for ray in 0..20_000 {
            let eye = DVec3::new(4.0 * random() - 2.0, 3.0 * random() - 1.5, 4.0 * random() - 2.0);
            let to = DVec3::new(4.0 * random() - 2.0, 3.0 * random() - 1.5, 3.0 + random());
            // Some rays go through the middle of the picture, some keep to a row.
            let to = if ray % 5 == 0 { DVec3::new(to.x, eye.y, to.z) } else { to };
            let range = [0.1 + 0.2 * random(), 0.4 + 3.0 * random()];
            let found = relief.meets(sight, eye, to - eye, range, relief.all());
            assert_eq!(found, walk(&relief, sight, eye, to - eye, range), "{eye} to {to}, {range:?}");
            let Some(d) = found else { continue };
            met += 1;
            // In a box around the place it is met as well, in one away from it there may be nothing.
            let (_, place, _) = sight.seen(eye + (to - eye) / d).expect("it is in the picture");
            let boxed = relief.around(std::iter::once(place));
            assert_eq!(relief.meets(sight, eye, to - eye, range, boxed), found, "{eye} to {to}, {range:?}, {boxed:?}");
        }
        assert!(met > 4_000, "{met}");
    }

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
            relief.meets(sight, eye, way, range, relief.all()).map(|d| (eye + way / d).to_array())
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

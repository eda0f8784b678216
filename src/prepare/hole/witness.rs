//! What the views know of a point: whether something is there, whether they look through it, whether it is hidden.

use glam::DVec3;
use rayon::prelude::*;

use super::surface::{APART, HULL_VIEWS, SAME, Sight, Sights};

/// Part of what speaks against a surface that all other views have hidden behind something else; 1 is a proof.
const BURIED: f64 = 0.1;
/// Part of the views that can tell that must have something before a point for it to be within a thing.
const WITHIN_THING: f64 = 0.9;
/// Steps in which a way is followed, as a part of the depth, and steps in a thing from which on the way is barred.
const STEP: f64 = 0.03;
const BARRED: usize = 2;

/// How a view sees a point that some other view claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Witness {
    Agrees,
    Hidden,
    Through,
    Silent,
}

/// Whether so many views that look through a point, where so many have a surface, prove that nothing is there.
fn refuted(through: u32, agree: u32) -> bool {
    through >= 2 && through > 2 * agree
}

impl Sights {
    /// `[view]` sites whose depth nobody confirms and others look through: a bare background takes the depth of what is
    /// beside it.
    pub(super) fn floating(&self) -> Vec<Vec<usize>> {
        let of = |sight: &Sight| {
            let doubtful = |site: &usize| sight.depth[*site].is_finite() && !sight.grid.confirmed[*site];
            let point = |site: usize| sight.point(site, sight.depth[site]);
            let sites = (0..sight.depth.len()).filter(doubtful);
            sites.filter(|site| self.looked_through(0..self.0.len(), point(*site))).collect()
        };
        self.0.par_iter().map(of).collect()
    }

    /// Whether what is measured, and confirmed, beside the object is behind this point in at least two of these views, and
    /// in more than twice as many as have it there.
    pub(super) fn looked_through(&self, views: impl Iterator<Item = usize>, point: DVec3) -> bool {
        let (mut through, mut agree) = (0, 0);
        for sight in views.map(|view| &self.0[view]) {
            let Some((site, z)) = sight.see(point).filter(|(site, _)| !sight.hole[*site]) else { continue };
            let known = sight.grid.depth[site];
            through += u32::from(sight.grid.confirmed[site] && z < (1.0 - APART) * known);
            agree += u32::from(sight.grid.confirmed[site] && (z / known - 1.0).abs() <= SAME);
        }
        refuted(through, agree)
    }

    /// How a view, whose object is taken for glass, sees a point.
    fn witness(&self, view: usize, point: DVec3) -> Witness {
        let sight = &self.0[view];
        let Some((site, z)) = sight.see(point).filter(|_| sight.grid.trusted) else { return Witness::Silent };
        let hole = sight.hole[site];
        // The object hides what is behind it, and shows that nothing else is before it.
        let object = hole && !sight.solved;
        let known = if object { sight.object[site] } else { sight.depth[site] };
        if !known.is_finite() || known == 0.0 {
            Witness::Silent
        } else if z < (1.0 - APART) * known {
            // What is bare is measured anywhere, and proves nothing unless others confirm it.
            if hole || sight.grid.confirmed[site] { Witness::Through } else { Witness::Silent }
        } else if object {
            Witness::Silent
        } else if (z / known - 1.0).abs() <= SAME {
            Witness::Agrees
        } else if z > (1.0 + APART) * known {
            Witness::Hidden
        } else {
            Witness::Silent
        }
    }

    /// Whether the other views prove that nothing is at this point. They are asked until what is left of them cannot change it.
    pub(super) fn is_refuted(&self, of: usize, point: DVec3) -> bool {
        let (mut through, mut agree) = (0, 0);
        for view in (0..self.0.len()).filter(|view| *view != of) {
            let said = self.witness(view, point);
            through += u32::from(said == Witness::Through);
            agree += u32::from(said == Witness::Agrees);
            let left = (self.0.len() - 1 - view) as u32;
            if refuted(through, agree + left) || through + left <= 2 * agree {
                break;
            }
        }
        refuted(through, agree)
    }

    /// From 0, nothing speaks against a surface at this point, to 1, it cannot be there.
    pub(super) fn against(&self, of: usize, point: DVec3) -> f64 {
        let (mut through, mut agree, mut hidden, mut asked) = (0u32, 0u32, 0u32, 0u32);
        for view in (0..self.0.len()).filter(|view| *view != of) {
            let said = self.witness(view, point);
            asked += u32::from(said != Witness::Silent);
            through += u32::from(said == Witness::Through);
            agree += u32::from(said == Witness::Agrees);
            hidden += u32::from(said == Witness::Hidden);
        }
        if refuted(through, agree) {
            return 1.0;
        }
        BURIED * f64::from(hidden) / f64::from(asked.max(1))
    }

    /// Whether a point is within a thing: nearly all views that can tell have something before it, on several sides of it.
    fn within(&self, of: usize, point: DVec3) -> bool {
        let (mut hidden, mut asked) = (vec![], 0);
        for view in (0..self.0.len()).filter(|view| *view != of) {
            let said = self.witness(view, point);
            asked += usize::from(said != Witness::Silent);
            if said == Witness::Hidden {
                hidden.push(self.0[view].eye() - point);
            }
            // Though all that are left had something before it.
            let left = self.0.len() - 1 - view;
            if ((hidden.len() + left) as f64) < WITHIN_THING * (asked + left) as f64 {
                return false;
            }
        }
        let around = || hidden.iter().any(|side| side.dot(hidden[0]) < 0.0);
        hidden.len() >= HULL_VIEWS && hidden.len() as f64 >= WITHIN_THING * asked as f64 && around()
    }

    /// `[site of the hole]` of a view whether another's surface behind the object falls there, or beside it.
    pub fn told(&self, by: usize, of: usize) -> Vec<bool> {
        let (own, other) = (&self.0[of], &self.0[by]);
        let mut falls = vec![false; own.hole.len()];
        for site in (0..other.hole.len()).filter(|site| other.hole[*site] && other.depth[*site].is_finite()) {
            if let Some((there, _)) = own.see(other.point(site, other.depth[site])) {
                falls[there] = true;
            }
        }
        let holes = (0..own.hole.len()).filter(|site| own.hole[*site]);
        holes.map(|site| own.around(site).any(|near| falls[near])).collect()
    }

    /// Whether the way from the object to a depth z at a site goes through a thing: then something nearer is seen there.
    pub(super) fn barred(&self, of: usize, site: usize, depth: f64) -> bool {
        let own = &self.0[of];
        let (mut z, mut steps) = ((1.0 + APART) * own.grid.depth[site], 0);
        while own.grid.confirmed[site] && steps < BARRED && z < (1.0 - APART) * depth {
            steps = if self.within(of, own.point(site, z)) { steps + 1 } else { 0 };
            z *= 1.0 + STEP;
        }
        steps == BARRED
    }
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, Luma};

    use super::super::surface::tests::{SIZE, views};
    use crate::multiview::DepthGrid;
    use crate::scene::Camera;

    use super::*;

    /// A depth that nobody confirms, before a wall that others see, is not known; a confirmed one stays.
    #[test]
    fn what_others_look_through_is_not_there() {
        for confirmed in [false, true] {
            let (mut grids, cameras, masks) = views(0.2);
            let block: Vec<usize> =
                (4..9).flat_map(|row| (20..26).map(move |column| row * SIZE[0] as usize + column)).collect();
            for site in &block {
                (grids[2].depth[*site], grids[2].confirmed[*site]) = (3.0, confirmed);
            }
            let sights = Sights::new(grids, &cameras, &masks, &masks);
            assert!(block.iter().all(|site| sights.0[2].depth[*site].is_nan() != confirmed));
            let others = (0..5).filter(|view| *view != 2).map(|view| &sights.0[view]);
            assert!(others.flat_map(|sight| sight.depth.iter().zip(&sight.hole)).all(|(z, hole)| z.is_nan() == *hole));
        }
    }

    /// Depths behind the wall prove that it is not there where others confirm them, not where they are of a bare wall's noise.
    #[test]
    fn noise_looks_through_nothing() {
        for confirmed in [false, true] {
            let (mut grids, cameras, masks) = views(0.2);
            for grid in &mut grids[..3] {
                for site in (0..grid.depth.len()).filter(|site| grid.depth[*site] > 3.0).collect::<Vec<_>>() {
                    (grid.depth[site], grid.confirmed[site]) = (5.0, confirmed);
                }
            }
            let mut sights = Sights::new(grids, &cameras, &masks, &masks);
            // The fourth view has the wall, and the fifth says nothing.
            sights.0[4].grid.trusted = false;
            let wall = DVec3::new(0.9, 0.5, 4.0);
            assert_eq!(sights.is_refuted(3, wall), confirmed);
            assert_eq!(sights.against(3, wall) == 1.0, confirmed);
        }
    }

    /// Who stops asking early comes to what all views say, before, on and behind the wall, beside and behind the square.
    #[test]
    fn an_early_answer_is_the_whole_one() {
        let (mut grids, cameras, masks) = views(0.4);
        // Two views have the wall nearer than it is.
        for grid in &mut grids[..2] {
            grid.depth.iter_mut().filter(|z| **z > 3.0).for_each(|z| *z = 3.2);
        }
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let mut counts = [0; 2];
        for solved in [false, true] {
            for at in 0..9 * 9 * 30 {
                let [x, y, z] = [at % 9, at / 9 % 9, at / 81].map(f64::from);
                let point = DVec3::new(0.3 * (x - 4.0), 0.2 * (y - 4.0), 1.0 + 0.2 * z);
                let refuted = sights.is_refuted(2, point);
                assert_eq!(refuted, sights.against(2, point) == 1.0, "{point} {solved}");
                counts[usize::from(refuted)] += 1;
            }
            (0..5).for_each(|of| sights.solve(of, 1));
        }
        assert!(counts.iter().all(|count| *count > 200), "{counts:?}");
    }

    /// A ball that is seen from all around bars the way to what is behind it, not the way past it nor to its front.
    #[test]
    fn the_way_through_a_thing_is_barred() {
        let grid = |turn: usize| {
            let (sin, cos) = (std::f64::consts::TAU * turn as f64 / 8.0).sin_cos();
            let camera = Camera {
                rotation: [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]].map(|row| row.map(|v| v as f32)),
                translation: [0.0, 0.0, 4.0],
                focal: [40.0; 2],
                principal: [24.0, 16.0],
                distortion: [0.0; 4],
                size: SIZE,
            };
            let pixels = (SIZE[0] * SIZE[1]) as usize;
            let depth = |i: usize| {
                // Along (x, y, 1) z, a ball of radius 1 at z = 4.
                let [x, y, _] = camera.to_camera(camera.lift(camera.pixel_center(i), 1.0).expect("a ray"));
                let a = 1.0 + x * x + y * y;
                let root = 16.0 - 15.0 * a;
                if root > 0.0 { (4.0 - root.sqrt()) / a } else { 14.0 }
            };
            let (depth, confirmed) = ((0..pixels).map(depth).collect(), vec![true; pixels]);
            let colors = vec![[0; 3]; pixels];
            DepthGrid { camera, stride: 1, columns: SIZE[0], rows: SIZE[1], depth, confirmed, colors, trusted: true }
        };
        let mut grids: Vec<DepthGrid> = (0..8).map(grid).collect();
        let cameras: Vec<Camera> = grids.iter().map(|grid| grid.camera).collect();
        // In the first view the object hides the ball, and what is beside it.
        grids[0].depth.fill(2.5);
        let hole = |view: u8| GrayImage::from_pixel(SIZE[0], SIZE[1], Luma([if view == 0 { 255 } else { 0 }]));
        let masks: Vec<GrayImage> = (0..8).map(hole).collect();
        let sights = Sights::new(grids, &cameras, &masks, &masks);
        let site = |x: usize| 16 * SIZE[0] as usize + x;
        assert!(sights.barred(0, site(24), 14.0) && sights.barred(0, site(28), 14.0));
        assert!(!sights.barred(0, site(24), 3.0) && !sights.barred(0, site(42), 14.0));
    }

    /// On a bare square the views measure the wall's depth and more here and there: that proves nothing of what is behind it.
    #[test]
    fn what_is_bare_of_the_object_refutes_nothing() {
        let (mut grids, cameras, masks) = views(0.4);
        for (grid, mask) in grids.iter_mut().zip(&masks) {
            for (site, depth) in grid.depth.iter_mut().enumerate() {
                let [x, y] = [site as u32 % SIZE[0], site as u32 / SIZE[0]];
                let wrong = mask.as_raw()[site] != 0 && (x / 4) % 2 == 0 && (y / 4) % 2 == 0;
                *depth = if wrong { 4.6 } else { *depth };
            }
        }
        let sights = Sights::new(grids, &cameras, &masks, &masks);
        let middle = (SIZE[1] / 2 * SIZE[0] + SIZE[0] / 2) as usize;
        let deep: Vec<usize> = sights.0[2].around(middle).collect();
        assert!(deep.iter().all(|site| sights.0[2].hole[*site] && sights.0[2].object[*site] == 2.0));
        assert!(deep.iter().all(|site| sights.against(2, sights.0[2].point(*site, 4.0)) < 1.0));
    }
}

//! Where a surface ends along whose side a straight border goes on in the hole.
//!
//! People build with right angles: a bench whose back edge goes into the hole ends there as far along as its front does, which other
//! views show. A border that comes out of the hole again needs no end.

use glam::{DVec2, DVec3};

use super::surface::Sight;
use crate::prepare::planes;
use crate::statistics::quantile;

/// Sites from a border at which the surface to its side is known, how far before the hole, and how far in it.
const ASIDE: f64 = 1.5;
const BEFORE: [f64; 3] = [2.0, 4.0, 6.0];
const BEHIND: [f64; 2] = [1.0, 3.0];
/// Sites up to which another border begins where this one comes out, and the cosine from which on it is the same one.
const NEAR: f64 = 6.0;
const SAME_WAY: f64 = 0.9;
/// Parts of a surface's width that are its far side, and its side along the border.
const FAR: [f64; 2] = [0.85, 1.05];
const ALONG: [f64; 2] = [0.0, 0.3];
/// Quantiles of its sites that are its width, and its end.
const WIDE: f64 = 0.95;
const END: f64 = 0.98;
/// Shortest way into the hole, as a part of that through it, after which a surface ends.
const LEAST: f64 = 0.05;

/// The end of a surface in a hole.
#[derive(Clone, Debug, PartialEq)]
pub struct Cut {
    /// Number of the surface.
    surface: usize,
    /// Where it ends at the straight border along its side, and on its far side, sites.
    end: [DVec2; 2],
    /// Where the border would come out of the hole.
    out: DVec2,
}

impl Cut {
    /// Whether a surface is not at a place, being beyond this end of it.
    pub fn bars(&self, surface: usize, place: DVec2) -> bool {
        let [foot, corner] = self.end;
        let side = |at: DVec2| (corner - foot).perp_dot(at - foot);
        surface == self.surface && side(place) * side(self.out) > 0.0
    }
}

impl Sight {
    /// The straight borders that go into the hole of a view that is solved, and the ends of surfaces there. A border along which a surface
    /// lies that ends on its far side ends there, too, and one at right angles to it is added.
    pub fn cut_off(&self) -> (Vec<[DVec2; 2]>, Vec<Cut>) {
        let (mut borders, mut cuts) = (self.borders.clone(), vec![]);
        for k in 0..borders.len() {
            let [from, to] = borders[k];
            let way = (to - from).normalize();
            let is_one = |[a, b]: &[DVec2; 2]| a.distance(to) < NEAR && (b - a).normalize().dot(way) < -SAME_WAY;
            if self.borders.iter().any(is_one) {
                continue;
            }
            if let Some((surface, end @ [foot, corner])) =
                [ASIDE, -ASIDE].iter().find_map(|side| self.end([from, to], *side))
            {
                borders[k][1] = foot;
                borders.push([corner, foot]);
                cuts.push(Cut { surface, end, out: to });
            }
        }
        (borders, cuts)
    }

    /// The surface that lies to a side of a border, and where it ends at the border and on its far side.
    fn end(&self, [from, to]: [DVec2; 2], side: f64) -> Option<(usize, [DVec2; 2])> {
        let way = (to - from).normalize();
        let beside = from + way.perp() * side;
        let label = |at: DVec2| self.label(at);
        let own = label(beside - way * BEFORE[0])?;
        let goes_in = BEFORE.iter().map(|far| -far).chain(BEHIND).all(|far| label(beside + way * far) == Some(own));
        let plane = self.planes.get(usize::from(own)).filter(|_| goes_in)?;
        let point = |at: DVec2| {
            let ray = self.grid.ray_at(at.to_array());
            DVec3::new(ray[0], ray[1], 1.0) / planes::on(plane, ray)
        };
        let origin = point(from);
        let length = origin.distance(point(to));
        let along = (point(to) - origin) / length;
        let across = DVec3::from(*plane).cross(along).normalize();
        let across = across * across.dot(point(beside) - origin).signum();
        // How far along the border each of its sites is, and how far from it; and whether that is in the hole.
        let sites = (0..self.surface.len()).filter(|site| self.surface[*site] == own);
        let places: Vec<(bool, f64, f64)> = sites
            .map(|site| {
                let off = point(self.middle(site)) - origin;
                (self.hole[site], off.dot(along), off.dot(across))
            })
            .collect();
        let before = places.iter().filter(|(hole, far, aside)| !hole && (-length..0.0).contains(far) && *aside > 0.0);
        let wide = quantile(before.map(|(.., aside)| *aside), WIDE)?;
        let end = |[from, to]: [f64; 2]| {
            let within = places.iter().filter(|(.., aside)| (from * wide..to * wide).contains(aside));
            quantile(within.map(|(_, far, _)| *far), END)
        };
        let (far, near) = (end(FAR)?, end(ALONG)?);
        let foot = origin + along * far;
        let seen = |point: DVec3| DVec2::from(self.grid.place([point.x / point.z, point.y / point.z]));
        let ends = far > LEAST * length && far < near.min(length);
        ends.then(|| (usize::from(own), [seen(foot), seen(foot + across * wide)]))
    }

    /// Beside a straight border that goes on in the hole the place on the same side of it that is so far from it that its site is of what is
    /// there; nothing elsewhere, and where there is the same on both sides.
    pub(super) fn beside_border(&self, place: [f64; 2]) -> Option<[f64; 2]> {
        let at = DVec2::from(place);
        self.borders.iter().find_map(|[from, to]| {
            let (way, length) = ((to - from).normalize(), from.distance(*to));
            let (along, aside) = (way.dot(at - from), way.perp_dot(at - from));
            ((-1.0..=length).contains(&along) && aside.abs() < ASIDE).then_some(())?;
            let [own, other] = [ASIDE, -ASIDE].map(|off| at + way.perp() * (off.copysign(off * aside) - aside));
            (self.label(own)? != self.label(other)?).then_some(own.to_array())
        })
    }

    /// The middle of a site.
    pub(super) fn middle(&self, site: usize) -> DVec2 {
        let columns = self.grid.columns as usize;
        DVec2::new((site % columns) as f64, (site / columns) as f64) + 0.5
    }

    /// The surface of the site at a place.
    fn label(&self, at: DVec2) -> Option<u8> {
        self.grid.site(at.x.floor() as i64, at.y.floor() as i64).map(|site| self.surface[site])
    }
}

#[cfg(test)]
mod tests {
    use super::super::surface::Sights;
    use super::super::surface::tests::{SIZE, views};
    use super::*;

    /// A bench whose back edge goes into the hole from the left ends as far along as its front does; one that comes out on the right stays.
    #[test]
    fn a_bench_ends_at_a_right_angle() {
        let (grids, cameras, masks) = views(0.3);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let sight = &mut sights.0[2];
        sight.planes = vec![[0.0, 0.0, 0.25], [0.0, 0.0, 0.24]];
        for site in 0..sight.surface.len() {
            let [x, y] = [site as u32 % SIZE[0], site as u32 / SIZE[0]];
            // Near its back it was found to go on farther than its front.
            let bench = (10..24).contains(&y) && x < if y < 14 { 38 } else { 30 };
            (sight.surface[site], sight.hole[site]) = (u8::from(!bench), (20..40).contains(&x));
        }
        let edge = [DVec2::new(20.0, 10.0), DVec2::new(40.0, 10.0)];
        sight.borders = vec![edge];
        let (found, cuts) = sight.cut_off();
        assert_eq!(found.len(), 2, "{found:?}");
        let [foot, corner] = [found[0][1], found[1][0]];
        assert!(foot.distance(DVec2::new(30.0, 10.0)) < 1.0 && found[1][1] == foot, "{foot}");
        assert!(corner.distance(DVec2::new(30.0, 24.0)) < 2.0, "{corner}");
        let barred = |x: f64| cuts.iter().any(|cut| cut.bars(0, DVec2::new(x, 18.0)));
        assert!(
            cuts.len() == 1 && barred(34.0) && !barred(26.0) && !cuts[0].bars(1, DVec2::new(34.0, 18.0)),
            "{cuts:?}"
        );
        // It comes out again.
        sight.borders = vec![edge, [edge[1], edge[0]]];
        assert_eq!(sight.cut_off(), (sight.borders.clone(), vec![]));
    }
}

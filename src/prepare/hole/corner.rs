//! Where a surface ends along whose side a straight border goes on in the hole.
//!
//! People build with right angles: a bench whose back edge goes into the hole ends there as far along as its front does, which other
//! views show. A border that comes out of the hole again needs no end. Where the picture shows its front edge, that goes on up to the end, too,
//! and so does the face below it.

use glam::{DVec2, DVec3};

use super::covered::Covered;
use super::photograph::Photograph;
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
/// Sites to each side among which the front edge is looked for, and the part of a surface's width that the face below it is high at most.
const FRONT: f64 = 1.5;
const HIGH: f64 = 0.5;
/// Length before the hole along which the edge is looked for, as a part of that in it, and places along it.
const LENGTH: f64 = 1.0;
const PLACES: usize = 64;
/// Pixels to each side that differ at an edge, by how much, summed over the channels; and pixels by which both halves of it may be apart.
const BESIDE: usize = 2;
const STEP: f32 = 0.12;
const STRAIGHT: usize = 2;

/// The part of a surface that is in a hole and ends there.
#[derive(Clone, Debug, PartialEq)]
pub struct Cut {
    /// Number of the surface.
    surface: usize,
    /// Corners of the part, sites: where it goes into the hole, and ends, along its one side, and where it ends, and goes in, along its other.
    corners: [DVec2; 4],
    /// Which of its sides, each from a corner to the next, it is known not to go over.
    ends: [bool; 4],
}

impl Cut {
    /// Whether a place is on the same side of one of its sides as its middle.
    fn is_within(&self, side: usize, place: DVec2) -> bool {
        let [from, to] = [self.corners[side], self.corners[(side + 1) % 4]];
        let off = |at: DVec2| (to - from).perp_dot(at - from);
        off(place) * off(self.corners.iter().sum::<DVec2>() / 4.0) >= 0.0
    }

    /// Whether a surface is not at a place, being beyond an end of it.
    pub fn bars(&self, surface: usize, place: DVec2) -> bool {
        surface == self.surface && (0..4).any(|side| self.ends[side] && !self.is_within(side, place))
    }

    /// The surface that is there for certain, at a place within all sides of a part whose front is known.
    pub fn has(&self, place: DVec2) -> Option<usize> {
        (self.ends[2] && (0..4).all(|side| self.is_within(side, place))).then_some(self.surface)
    }
}

/// The straight borders that go into a hole, the ends of surfaces there, and the faces below these, numbered after all surfaces.
#[derive(Default)]
pub struct Ends {
    pub borders: Vec<[DVec2; 2]>,
    pub cuts: Vec<Cut>,
    pub faces: Vec<Covered>,
}

/// A surface with a straight side, in the camera's coordinates.
struct Slab {
    /// Number of the surface.
    surface: usize,
    /// A point on its side, and the ways along that, across the surface, and down from it, each of length 1.
    origin: DVec3,
    along: DVec3,
    across: DVec3,
    down: DVec3,
    /// How wide it is, where its far side goes into the hole, and where it ends.
    wide: f64,
    begin: f64,
    end: f64,
}

impl Slab {
    fn at(&self, along: f64, across: f64, down: f64) -> DVec3 {
        self.origin + self.along * along + self.across * across + self.down * down
    }
}

/// Where a line of colours, one for each pixel, differs most to both sides, if it is an edge there.
fn step(colors: &[Option<[f32; 3]>]) -> Option<usize> {
    let differ = |i: usize| -> Option<f32> {
        let (one, other) = (colors[i - BESIDE]?, (*colors.get(i + BESIDE)?)?);
        Some((0..3).map(|c| (one[c] - other[c]).abs()).sum())
    };
    let all = (BESIDE..colors.len()).filter_map(|i| Some((i, differ(i)?)));
    all.filter(|(_, by)| *by >= STEP).max_by(|a, b| a.1.total_cmp(&b.1)).map(|(i, _)| i)
}

impl Sight {
    /// The straight borders that go into the hole of a view that is solved, and the ends of surfaces there. A border along which a surface
    /// lies that ends on its far side ends there, too, and one at right angles to it is added; its front, where `own` picture shows that,
    /// and the face below.
    pub fn cut_off(&self, own: &Photograph<'_>) -> Ends {
        let mut found = Ends { borders: self.borders.clone(), ..Ends::default() };
        for k in 0..self.borders.len() {
            let [from, to] = self.borders[k];
            let way = (to - from).normalize();
            let is_one = |[a, b]: &[DVec2; 2]| a.distance(to) < NEAR && (b - a).normalize().dot(way) < -SAME_WAY;
            if self.borders.iter().any(is_one) {
                continue;
            }
            let Some(slab) = [ASIDE, -ASIDE].iter().find_map(|side| self.end([from, to], *side)) else { continue };
            let seen = |along: f64, across: f64, down: f64| self.place_of(slab.at(along, across, down));
            let front = self.front(&slab, own);
            let wide = front.unwrap_or(slab.wide);
            let top = [[0.0, 0.0], [slab.end, 0.0], [slab.end, wide], [slab.begin, wide]];
            let corners @ [_, foot, corner, begin] = top.map(|[along, across]| seen(along, across, 0.0));
            found.borders[k][1] = foot;
            found.borders.push([corner, foot]);
            found.cuts.push(Cut { surface: slab.surface, corners, ends: [false, true, front.is_some(), false] });
            let Some(wide) = front else { continue };
            found.borders.push([begin, corner]);
            if let Some((face, tall)) = self.face(&Slab { wide, ..slab }, own) {
                let [below, bottom] = [slab.begin, slab.end].map(|along| seen(along, wide, tall));
                found.borders.extend([[below, bottom], [corner, bottom]]);
                let surface = self.planes.len() + found.faces.len();
                let corners = [begin, corner, bottom, below];
                found.cuts.push(Cut { surface, corners, ends: [true, true, true, false] });
                found.faces.push(face);
            }
        }
        found
    }

    /// Where a point in the camera's coordinates is seen, sites.
    fn place_of(&self, point: DVec3) -> DVec2 {
        DVec2::from(self.grid.place([point.x / point.z, point.y / point.z]))
    }

    /// The surface that lies to a side of a border, and where it ends at the border and on its far side.
    fn end(&self, [from, to]: [DVec2; 2], side: f64) -> Option<Slab> {
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
        let down = DVec3::from(*plane).normalize();
        let across = down.cross(along).normalize();
        let across = across * across.dot(point(beside) - origin).signum();
        // How far along the border each site is, and how far from it; and whether that is in the hole.
        let places = |is: &dyn Fn(usize) -> bool| -> Vec<(bool, f64, f64)> {
            let place = |site: usize| {
                let off = point(self.middle(site)) - origin;
                (self.hole[site], off.dot(along), off.dot(across))
            };
            (0..self.surface.len()).filter(|site| is(*site)).map(place).collect()
        };
        let its = places(&|site| self.surface[site] == own);
        let before = its.iter().filter(|(hole, far, aside)| !hole && (-length..0.0).contains(far) && *aside > 0.0);
        let wide = quantile(before.map(|(.., aside)| *aside), WIDE)?;
        let end = |of: &[(bool, f64, f64)], [from, to]: [f64; 2], part: f64| {
            let within = of.iter().filter(|(.., aside)| (from * wide..to * wide).contains(aside));
            quantile(within.map(|(_, far, _)| *far), part)
        };
        let (far, near) = (end(&its, FAR, END)?, end(&its, ALONG, END)?);
        let begin = end(&places(&|site| self.hole[site]), FAR, 1.0 - END)?;
        let ends = far > LEAST * length && far < near.min(length);
        let slab = Slab { surface: usize::from(own), origin, along, across, down, wide, begin, end: far };
        let before_camera = [begin, far].iter().all(|along| slab.at(*along, wide, 0.0).z > 0.0);
        (ends && before_camera).then_some(slab)
    }

    /// How far points of a plane (p . x = 1) are from one of them along a way in it, one for each pixel of a picture between two places
    /// along it, sites from that point's.
    fn steps(&self, own: &Photograph<'_>, plane: DVec3, base: DVec3, way: DVec3, [from, to]: [f64; 2]) -> Vec<f64> {
        let middle = self.place_of(base);
        let ahead = self.place_of(base + way * 1e-3 * base.length());
        let (Some(way_seen), pixels) = ((ahead - middle).try_normalize(), self.grid.pixels(own.camera.size[0])) else {
            return vec![];
        };
        let step = |k: usize| {
            let [x, y] = self.grid.ray_at((middle + way_seen * (from + k as f64 / pixels)).to_array());
            let ray = DVec3::new(x, y, 1.0);
            (ray / plane.dot(ray) - base).dot(way)
        };
        (0..=((to - from).max(0.0) * pixels) as usize).map(step).collect()
    }

    /// The mean colours that a picture shows along lines, each from one of these places to the other; nothing where little of it is seen.
    fn lines(
        own: &Photograph<'_>,
        lines: &[f64],
        [from, to]: [f64; 2],
        place: impl Fn(f64, f64) -> DVec3,
    ) -> Vec<Option<[f32; 3]>> {
        let line = |aside: &f64| {
            let color = |k: usize| {
                let point = place(from + (to - from) * (k as f64 + 0.5) / PLACES as f64, *aside);
                let world = own.camera.along([point.x / point.z, point.y / point.z], point.z);
                own.color(DVec3::from(world)).filter(|_| point.z > 0.0)
            };
            let colors: Vec<[f32; 3]> = (0..PLACES).filter_map(color).collect();
            let mean = |c: usize| colors.iter().map(|color| color[c]).sum::<f32>() / colors.len() as f32;
            (2 * colors.len() >= PLACES).then(|| [0, 1, 2].map(mean))
        };
        lines.iter().map(line).collect()
    }

    /// The width of a surface up to its front edge as the picture shows that: one straight line parallel to its back.
    fn front(&self, slab: &Slab, own: &Photograph<'_>) -> Option<f64> {
        let plane = DVec3::from(*self.planes.get(slab.surface)?);
        let steps = self.steps(own, plane, slab.at(slab.begin, slab.wide, 0.0), slab.across, [-FRONT, FRONT]);
        let length = LENGTH * (slab.end - slab.begin);
        let [far, middle, near] = [length, 0.5 * length, 0.0].map(|before| slab.begin - before);
        let place = |along: f64, aside: f64| slab.at(along, slab.wide + aside, 0.0);
        let edge = |ends: [f64; 2]| step(&Self::lines(own, &steps, ends, place));
        let at = edge([far, near])?;
        let halves = [edge([far, middle])?, edge([middle, near])?];
        halves.iter().all(|half| half.abs_diff(at) <= STRAIGHT).then(|| slab.wide + steps[at])
    }

    /// The face below the front edge of a surface, at right angles to it, and how high it is, where the picture shows that.
    fn face(&self, slab: &Slab, own: &Photograph<'_>) -> Option<(Covered, f64)> {
        let base = slab.at(slab.begin, slab.wide, 0.0);
        // It faces the camera, which is at the origin.
        let off = slab.across.dot(base);
        (off < 0.0).then_some(())?;
        let high = self.place_of(base).distance(self.place_of(slab.at(slab.begin, slab.wide, HIGH * slab.wide)));
        let steps = self.steps(own, slab.across / off, base, slab.down, [0.0, high]);
        let ends = [slab.begin - 0.5 * LENGTH * (slab.end - slab.begin), slab.begin];
        let place = |along: f64, down: f64| slab.at(along, slab.wide, down);
        let colors = Self::lines(own, &steps, ends, place);
        let below = 2 * BESIDE;
        let tall = steps[below + step(colors.get(below..)?)?];
        let middle = self.place_of(place(0.5 * (ends[0] + ends[1]), 0.5 * tall));
        let look = self.look_around(self.grid.site(middle.x.floor() as i64, middle.y.floor() as i64)?);
        Some((Covered { plane: (slab.across / off).to_array(), look }, tall))
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
    use image::{GrayImage, Luma, Rgb, RgbImage};

    use super::super::surface::Sights;
    use super::super::surface::tests::{SIZE, views};
    use super::*;
    use crate::scene::Camera;

    /// A bench whose back edge goes into the hole from the left ends as far along as its front does; its front edge goes on up to there,
    /// and the face below it. One whose back edge comes out on the right stays, and no front is where the picture shows none.
    #[test]
    fn a_bench_ends_at_a_right_angle() {
        let (grids, cameras, masks) = views(0.3);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let sight = &mut sights.0[2];
        // One unit below the camera, from z = 10 to 10/3, up to x = 1.
        sight.planes = vec![[0.0, 1.0, 0.0], [0.0, 0.0, 0.09]];
        for site in 0..sight.surface.len() {
            let [x, y] = [site as u32 % SIZE[0], site as u32 / SIZE[0]];
            let end = 24.0 + f64::from(y) + 0.5 - 16.0;
            // Near its back it was found to go on farther than its front.
            let bench = (20..28).contains(&y) && (f64::from(x) < end || y < 22 && x < 38);
            (sight.surface[site], sight.hole[site]) = (u8::from(!bench), (20..40).contains(&x));
        }
        let edge = [DVec2::new(20.0, 20.0), DVec2::new(40.0, 20.0)];
        sight.borders = vec![edge];
        // Eight times as large as the sites.
        let camera = Camera { focal: [320.0; 2], principal: [192.0, 128.0], size: SIZE.map(|n| 8 * n), ..cameras[2] };
        let [w, h] = camera.size;
        let shown = |front: bool| {
            let color = |y: u32| match y {
                160..224 => [200, 210, 220],
                224..248 if front => [130, 140, 150],
                248.. => [80, 60, 50],
                _ => [200, 210, 220],
            };
            RgbImage::from_fn(w, h, |_, y| Rgb(color(y)))
        };
        let hole = GrayImage::from_fn(w, h, |x, _| Luma([if (160..320).contains(&x) { 255 } else { 0 }]));
        let found = |sight: &Sight, front: bool| {
            sight.cut_off(&Photograph { camera, picture: &shown(front), hole: hole.clone() })
        };
        let Ends { borders, cuts, faces } = found(sight, true);
        assert_eq!((borders.len(), cuts.len(), faces.len()), (5, 2, 1), "{borders:?}");
        let [foot, corner] = [borders[0][1], borders[1][0]];
        assert!(foot.distance(DVec2::new(28.0, 20.0)) < 1.0 && borders[1][1] == foot, "{foot}");
        assert!(corner.distance(DVec2::new(36.0, 28.0)) < 2.0 && (corner.y - 28.0).abs() < 0.2, "{corner}");
        let bottom = borders[4][1];
        assert!(borders[4][0] == corner && (bottom.y - 31.0).abs() < 0.3, "{bottom}");
        let barred = |surface: usize, x: f64, y: f64| cuts.iter().any(|cut| cut.bars(surface, DVec2::new(x, y)));
        assert!(
            barred(0, 36.0, 24.0) && !barred(0, 26.0, 24.0) && barred(0, 26.0, 29.0) && !barred(1, 36.0, 24.0),
            "{cuts:?}"
        );
        let has = |x: f64, y: f64| cuts.iter().find_map(|cut| cut.has(DVec2::new(x, y)));
        let expected = [Some(0), Some(2), None, None];
        assert_eq!([[26.0, 24.0], [26.0, 29.5], [26.0, 31.5], [39.0, 24.0]].map(|[x, y]| has(x, y)), expected);
        assert!(barred(2, 26.0, 24.0) && barred(2, 39.0, 29.5) && !barred(2, 26.0, 29.5));
        // The face is at z = 10/3.
        let inverse = planes::on(&faces[0].plane, sight.grid.ray_at([26.0, 29.5]));
        assert!((inverse - 0.3).abs() < 0.005, "{inverse}");
        // A picture of the same colour to where the ground begins, which is too far away, shows no front.
        let plain = found(sight, false);
        assert!(plain.cuts.len() == 1 && plain.faces.is_empty() && plain.cuts[0].has(DVec2::new(26.0, 24.0)).is_none());
        // It comes out again.
        sight.borders = vec![edge, [edge[1], edge[0]]];
        let out = found(sight, true);
        assert!(out.borders == sight.borders && out.cuts.is_empty());
    }
}

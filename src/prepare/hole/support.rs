//! What the object stands on, or leans on, goes on under it.
//!
//! A plane that the object rises from and touches is one: its points lie on one side of it, and some lie next to it. Where
//! the object's points come down to when they are dropped onto the plane, the plane is, and hides what is behind it.

use glam::{DVec2, DVec3};

use super::surface::Sight;
use crate::prepare::planes::{self, Plane};
use crate::statistics::{median, quantile};

/// Least part of what is known around a hole that lies on a plane, and on none before it, for the object to stand on that.
const SHOWN: f64 = 0.05;
/// Fewest points of the object that tell what it stands on.
const FEWEST: usize = 30;
/// Points higher than this part of the object's height are clear of the plane; lower ones touch it.
const CLEAR: f64 = 0.15;
/// Points within this part of the object's height of the plane are the plane's.
const ON_IT: f64 = 0.08;
/// Least part of the points that is clear of the plane, most that lies behind it, and least that touches it.
const RISES: f64 = 0.5;
const BEHIND: f64 = 0.1;
const TOUCHES: f64 = 0.02;
/// Points farther than this many times the median from the middle of all are strays of the matching.
const STRAY: f64 = 3.0;

/// A plane that an object stands on, in a camera's coordinates.
pub struct Support {
    plane: Plane,
    axes: [DVec3; 2],
    /// The object's height above it.
    tall: f64,
    /// Corners, along the axes, of the least convex polygon with all points of the object, counterclockwise.
    corners: Vec<DVec2>,
}

impl Support {
    /// Of a plane `a x/z + b y/z + c = 1/z` and points of the object, if it stands on that.
    pub fn new(plane: Plane, object: &[DVec3]) -> Option<Self> {
        if object.len() < FEWEST {
            return None;
        }
        let p = DVec3::from(plane);
        let (normal, distance) = (p.normalize(), 1.0 / p.length());
        // Towards the camera.
        let heights: Vec<f64> = object.iter().map(|point| distance - normal.dot(*point)).collect();
        let tall = quantile(heights.iter().copied(), 0.95).filter(|tall| *tall > 0.0)?;
        let part =
            |is: &dyn Fn(f64) -> bool| heights.iter().filter(|h| is(**h / tall)).count() as f64 / heights.len() as f64;
        let rests =
            part(&|h| h > CLEAR) >= RISES && part(&|h| h < -CLEAR) <= BEHIND && part(&|h| h.abs() < CLEAR) >= TOUCHES;
        if !rests {
            return None;
        }
        let (across, down) = normal.any_orthonormal_pair();
        let axes = [across, down];
        let clear = object.iter().zip(&heights).filter(|(_, h)| **h > CLEAR * tall);
        let dropped: Vec<DVec2> = clear.map(|(point, _)| DVec2::new(point.dot(across), point.dot(down))).collect();
        let middle = DVec2::new(median(dropped.iter().map(|p| p.x))?, median(dropped.iter().map(|p| p.y))?);
        let reach = STRAY * median(dropped.iter().map(|p| p.distance(middle)))?;
        let corners = hull(dropped.into_iter().filter(|p| p.distance(middle) <= reach).collect());
        (corners.len() >= 3).then_some(Self { plane, axes, tall, corners })
    }

    /// Whether a point in the camera's coordinates lies on it, by the object's height.
    pub fn has(&self, point: DVec3) -> bool {
        let p = DVec3::from(self.plane);
        (1.0 - p.dot(point)).abs() / p.length() <= ON_IT * self.tall
    }

    /// Whether this is its plane.
    pub fn is(&self, plane: &Plane) -> bool {
        self.plane == *plane
    }

    /// Depth z at which a ray (x/z, y/z) meets the plane under the object; nothing beside it.
    pub fn under(&self, ray: [f64; 2]) -> Option<f64> {
        let z = 1.0 / planes::on(&self.plane, ray);
        let point = DVec3::new(ray[0], ray[1], 1.0) * z;
        let at = DVec2::new(point.dot(self.axes[0]), point.dot(self.axes[1]));
        let n = self.corners.len();
        let inside = (0..n).all(|i| {
            let (from, to) = (self.corners[i], self.corners[(i + 1) % n]);
            (to - from).perp_dot(at - from) >= 0.0
        });
        (z > 0.0 && z.is_finite() && inside).then_some(z)
    }
}

/// The corners of the least convex polygon around points, counterclockwise (Andrew 1979).
fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let half = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut corners: Vec<DVec2> = vec![];
        for point in points {
            while let [.., a, b] = corners[..] {
                if (b - a).perp_dot(point - a) > 0.0 {
                    break;
                }
                corners.pop();
            }
            corners.push(point);
        }
        corners.pop();
        corners
    };
    let mut corners = half(&mut points.iter().copied());
    corners.extend(half(&mut points.iter().rev().copied()));
    corners
}

impl Sight {
    /// The planes, of these of the view, that the object stands on.
    pub(super) fn supports(&self, planes: &[Plane]) -> Vec<Support> {
        // The margin around the object shows what is behind it.
        let deep = |site: usize| self.around(site).all(|near| self.hole[near]);
        let sites = (0..self.hole.len()).filter(|site| self.grid.confirmed[*site] && deep(*site));
        let object: Vec<DVec3> = sites
            .map(|site| {
                let [x, y] = self.ray(site);
                DVec3::new(x, y, 1.0) * self.grid.depth[site]
            })
            .collect();
        let supports: Vec<Support> =
            self.shown(planes).iter().filter_map(|plane| Support::new(*plane, &object)).collect();
        log::debug!("surface: {} planes, the object stands on {}", planes.len(), supports.len());
        supports
    }

    /// The planes, of these of the view, that it shows around its hole: not only where they cross one before them.
    fn shown(&self, planes: &[Plane]) -> Vec<Plane> {
        let near = self.surroundings();
        let known = (0..near.len()).filter(|site| near[*site] && !self.hole[*site] && self.depth[*site].is_finite());
        let on = |site: usize, plane: &Plane| {
            (planes::on(plane, self.ray(site)) * self.depth[site] - 1.0).abs() <= planes::THICKNESS
        };
        let (mut counts, mut all) = (vec![0usize; planes.len()], 0usize);
        for site in known {
            all += 1;
            if let Some(first) = planes.iter().position(|plane| on(site, plane)) {
                counts[first] += 1;
            }
        }
        let enough = |count: usize| count as f64 >= SHOWN * all as f64;
        planes.iter().zip(counts).filter(|(_, count)| enough(*count)).map(|(plane, _)| *plane).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor a unit and a half below the camera, with y downwards: y = 1.5.
    const FLOOR: Plane = [0.0, 1.0 / 1.5, 0.0];

    /// The front and the top of a box of one unit on the floor, at `lift` above it.
    fn cube(lift: f64) -> Vec<DVec3> {
        let steps = || (0..=10).map(|i| f64::from(i) / 10.0);
        let grid = || steps().flat_map(|u| steps().map(move |v| (u, v)));
        let front = grid().map(|(u, v)| DVec3::new(u, 1.5 - lift - v, 4.0));
        front.chain(grid().map(|(u, v)| DVec3::new(u, 0.5 - lift, 4.0 + v))).collect()
    }

    #[test]
    fn the_floor_goes_on_under_the_object() {
        let support = Support::new(FLOOR, &cube(0.0)).expect("it stands on the floor");
        let ray = |x: f64, z: f64| [x / z, 1.5 / z];
        for (x, z, is_under) in
            [(0.5, 4.5, true), (0.05, 4.9, true), (0.5, 3.8, false), (1.2, 4.5, false), (0.5, 5.3, false)]
        {
            let z_under = support.under(ray(x, z));
            assert_eq!(z_under.is_some(), is_under, "{x} {z}");
            assert!(z_under.is_none_or(|found| (found - z).abs() < 1e-9));
        }
    }

    /// What hangs in the air does not stand on the floor, nor does what goes through it.
    #[test]
    fn what_does_not_touch_does_not_stand() {
        assert!(Support::new(FLOOR, &cube(0.5)).is_none());
        assert!(Support::new(FLOOR, &cube(-0.6)).is_none());
        assert!(Support::new(FLOOR, &cube(0.0)[..20]).is_none());
    }

    #[test]
    fn the_hull_of_points_goes_around_them() {
        let grid: Vec<DVec2> = (0..25).map(|i| DVec2::new(f64::from(i % 5), f64::from(i / 5))).collect();
        assert_eq!(hull(grid), [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]].map(DVec2::from));
        assert!(hull(vec![DVec2::ZERO; 4]).len() < 3);
    }
}

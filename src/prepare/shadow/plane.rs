//! The surface that the object stands on: a plane through what is seen around the object, which the object rests on.

use glam::DVec3;
use rand_pcg::Pcg64;

use crate::multiview::plane::{self, Plane};
use crate::statistics::{middle, quantile};

/// Planes drawn.
const DRAWS: usize = 4000;
/// On the plane: within this share of the object's size.
const ON: f64 = 0.03;
/// Share of the object's places that lie above the plane, at least; what lies below is an error of their depth.
const ABOVE: f64 = 0.9;
/// The object's lowest places, by this share of them, lie as near to the plane as the first share of its size. Up to the second one a
/// plane counts less and less: of what is round nobody sees the lowest places.
const LOWEST: f64 = 0.05;
const GAP: [f64; 2] = [0.2, 0.6];
/// Cosine between a plane's normal and the cameras' common up below which it counts half.
const STEEP: f64 = 0.7;

/// A plane and what stands on it.
#[derive(Clone, Copy, Debug)]
pub struct Support {
    /// Below the object's middle, on the plane, world coordinates.
    pub foot: DVec3,
    /// Unit, towards the object.
    pub up: DVec3,
    /// Two unit vectors along the plane, with `up` a right-handed system.
    pub along: [DVec3; 2],
    /// The object's height above the plane, world units.
    pub height: f64,
    /// The radius within which the object stands around `foot`, world units.
    pub radius: f64,
}

impl Support {
    /// A world point along the plane and above it, from the foot.
    pub fn local(&self, point: DVec3) -> DVec3 {
        let from = point - self.foot;
        DVec3::new(from.dot(self.along[0]), from.dot(self.along[1]), from.dot(self.up))
    }

    /// A world point from places along the plane and above it.
    pub fn world(&self, local: DVec3) -> DVec3 {
        self.foot + self.along[0] * local.x + self.along[1] * local.y + self.up * local.z
    }
}

/// The middle of places and the radius around it that nine in ten of them lie in; nothing without any.
pub fn ball(points: &[DVec3]) -> Option<(DVec3, f64)> {
    let middle = middle(points)?;
    Some((middle, quantile(points.iter().map(|p| (*p - middle).length()), 0.9)?))
}

/// The [`ball`] of an object; nothing where it has too few places.
pub fn extent(object: &[DVec3]) -> Option<(DVec3, f64)> {
    ball(object).filter(|(_, radius)| object.len() >= 20 && *radius > 0.0)
}

/// The plane that the object rests on: of `around`, places on what surrounds it, those near it count most. `up` is the
/// cameras'. The same seed finds the same.
pub fn find(around: &[DVec3], object: &[DVec3], up: DVec3, seed: u64) -> Option<Support> {
    let (middle, size) = extent(object)?;
    if around.len() < 30 {
        return None;
    }
    let on = ON * size;
    let weight = |p: &DVec3| 1.0 / (1.0 + (*p - middle).length_squared() / (size * size));
    let rests = |(through, normal): Plane| {
        let heights: Vec<f64> = object.iter().map(|p| (*p - through).dot(normal)).collect();
        let above = heights.iter().filter(|h| **h > -ON * size).count() as f64 / heights.len() as f64;
        let lowest = quantile(heights, LOWEST).map_or(f64::INFINITY, f64::abs) / size;
        if above >= ABOVE { ((GAP[1] - lowest) / (GAP[1] - GAP[0])).clamp(0.0, 1.0) } else { 0.0 }
    };
    let drawn = plane::drawn(around, DRAWS, &mut Pcg64::new(seed.into(), 61), |(through, normal)| {
        let normal = if (middle - through).dot(normal) < 0.0 { -normal } else { normal };
        let plane = (through, normal);
        let level = if normal.dot(up) >= STEEP { 1.0 } else { 0.5 };
        let count = || around.iter().filter(|p| plane::distance(plane, **p) <= on).map(weight).sum::<f64>();
        let rests = rests(plane);
        (rests > 0.0).then(|| (count() * level * rests, plane))
    })?;
    let (through, normal) = plane::refined(around, drawn, on, weight, |plane| rests(plane) > 0.0);
    let foot = middle - normal * (middle - through).dot(normal);
    let (x, y) = normal.any_orthonormal_pair();
    let support = Support { foot, up: normal, along: [x, y], height: 0.0, radius: 0.0 };
    let local: Vec<DVec3> = object.iter().map(|p| support.local(*p)).collect();
    let height = quantile(local.iter().map(|p| p.z), 0.97)?;
    let radius = quantile(local.iter().map(|p| p.truncate().length()), 0.95)?;
    (height > 0.0).then_some(Support { height, radius, ..support })
}

#[cfg(test)]
mod tests {
    use glam::dvec3;

    use rand::RngExt as _;

    use super::*;

    /// A ball on a floor, of which cameras from above see the upper three quarters, and fog around it: the floor is found.
    #[test]
    fn what_is_round_rests_on_what_is_below_it() {
        let mut rng = Pcg64::new(5, 5);
        let mut noise = move |by: f64| rng.random_range(-by..by);
        let mut object = vec![];
        while object.len() < 400 {
            let p = dvec3(noise(1.0), noise(1.0), noise(1.0));
            if (0.5..1.0).contains(&p.length()) && p.z > -0.5 * p.length() {
                object.push(p.normalize() * 0.5 + DVec3::Z * 0.5);
            }
        }
        let mut around = vec![];
        for _ in 0..600 {
            around.push(dvec3(noise(1.5), noise(1.5), noise(0.008)));
            around.push(dvec3(noise(1.5), noise(1.5), 0.4 + noise(0.4)));
        }
        let found = find(&around, &object, DVec3::Z, 0).expect("a plane");
        assert!(found.up.z > 0.9995 && found.foot.z.abs() < 0.004, "{found:?}");
    }

    /// A box on a table before a wall, and a floor below the table that has more places: the table is found.
    #[test]
    fn the_plane_is_the_one_that_the_object_rests_on() {
        let mut rng = Pcg64::new(4, 4);
        let mut noise = move |by: f64| rng.random_range(-by..by);
        let object: Vec<DVec3> =
            (0..400).map(|_| dvec3(noise(0.3), noise(0.3), 1.0 + 0.25 + noise(0.25) + noise(0.01))).collect();
        let mut around = vec![];
        for _ in 0..300 {
            around.push(dvec3(noise(1.0), noise(1.0), 1.0 + noise(0.008)));
            around.push(dvec3(noise(3.0), noise(3.0), noise(0.008)));
            around.push(dvec3(noise(3.0), noise(3.0), noise(0.008)));
            around.push(dvec3(noise(1.0), 1.2 + noise(0.008), 1.5 + noise(1.0)));
        }
        let found = find(&around, &object, DVec3::Z, 0).expect("a plane");
        assert!(found.up.z > 0.9995, "{}", found.up);
        // Noise of 0.008 over some hundred places; the object's middle is a median of 400 over 0.6: 0.02.
        assert!((found.foot.z - 1.0).abs() < 0.004 && found.foot.truncate().length() < 0.08, "{}", found.foot);
        assert!((found.height - 0.5).abs() < 0.03, "{}", found.height);
        assert!((found.world(found.local(object[0])) - object[0]).length() < 1e-12);
        assert!(find(&around[..10], &object, DVec3::Z, 0).is_none());
    }
}

//! A plane among points: drawn through three of them (Fischler and Bolles 1981), then fitted to those that are on it.

use glam::{DMat3, DVec3};
use rand::RngExt as _;
use rand_pcg::Pcg64;

/// A point of a plane and its unit normal.
pub type Plane = (DVec3, DVec3);

/// Fewest points that a plane is fitted to.
const FEWEST: usize = 12;

/// Distance of a point from a plane.
pub fn distance((through, normal): Plane, point: DVec3) -> f64 {
    (point - through).dot(normal).abs()
}

/// The best of `draws` planes through three of the points. `judge` says how good one is and turns its normal to a side;
/// nothing where it is none.
pub fn drawn(
    points: &[DVec3],
    draws: usize,
    rng: &mut Pcg64,
    judge: impl Fn(Plane) -> Option<(f64, Plane)>,
) -> Option<Plane> {
    let mut best: Option<(f64, Plane)> = None;
    for _ in 0..draws {
        let [a, b, c]: [DVec3; 3] = std::array::from_fn(|_| points[rng.random_range(0..points.len())]);
        let normal = (b - a).cross(c - a).try_normalize();
        let Some((score, plane)) = normal.and_then(|normal| judge((a, normal))) else { continue };
        if best.is_none_or(|(most, _)| score > most) {
            best = Some((score, plane));
        }
    }
    best.map(|(_, plane)| plane)
}

/// The plane fitted three times to the points within `on` of it, while there are enough and it `holds`.
pub fn refined(
    points: &[DVec3],
    mut plane: Plane,
    on: f64,
    weight: impl Fn(&DVec3) -> f64,
    holds: impl Fn(Plane) -> bool,
) -> Plane {
    for _ in 0..3 {
        let inliers: Vec<DVec3> = points.iter().copied().filter(|p| distance(plane, *p) <= on).collect();
        if inliers.len() < FEWEST {
            break;
        }
        let fitted = least_squares(&inliers, &weight, plane.1);
        if !holds(fitted) {
            break;
        }
        plane = fitted;
    }
    plane
}

/// The plane of least squares: its mean and its normal, on the side of `near`.
fn least_squares(points: &[DVec3], weight: impl Fn(&DVec3) -> f64, near: DVec3) -> Plane {
    let sum: f64 = points.iter().map(&weight).sum();
    let mean = points.iter().map(|p| *p * weight(p)).sum::<DVec3>() / sum;
    let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    let spread = points.iter().fold(DMat3::ZERO, |all, p| all + outer(*p - mean) * weight(p));
    let trace = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    // Inverse iteration finds the direction of least spread.
    let inverse = (spread + DMat3::from_diagonal(DVec3::splat(1e-9 * trace.max(f64::MIN_POSITIVE)))).inverse();
    let mut normal = near;
    for _ in 0..30 {
        normal = (inverse * normal).try_normalize().unwrap_or(normal);
    }
    (mean, if normal.dot(near) < 0.0 { -normal } else { normal })
}

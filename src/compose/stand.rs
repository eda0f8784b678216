//! Where an object stands: the surface at a pixel and the plane through it.

use glam::DVec3;
use rand_pcg::Pcg64;

use crate::multiview::{DepthGrid, plane};
use crate::scene::Camera;
use crate::statistics::median;

/// The surface at a pixel is looked for within these shares of the picture's longer side, the nearest first.
const AROUND: [f64; 3] = [0.015, 0.03, 0.05];
/// Fewest sites there whose depth is known.
const FEWEST: usize = 5;
/// Surface within so many heights of the object tells the plane.
const REACH: f64 = 0.8;
/// Sites that are looked at.
const MOST: usize = 6000;
/// Planes drawn.
const DRAWS: usize = 400;
/// On the plane: within this share of the object's height, or of the depth.
const ON: f64 = 0.03;
const ON_DEPTH: f64 = 0.004;
/// Cosine between a plane's normal and the cameras' common up below which an object stands by the latter.
const STEEP: f64 = 0.7;

/// A place to stand.
#[derive(Clone, Copy, Debug)]
pub struct Stand {
    /// On the surface, world coordinates.
    pub foot: DVec3,
    /// Unit.
    pub up: DVec3,
    /// Height of the object, world units.
    pub height: f64,
    /// How far the surface around lies from the plane, by the median, world units.
    pub roughness: f64,
    /// Whether the surface is so steep that the cameras' up was taken instead of its normal.
    pub steep: bool,
}

/// The surface point that a pixel of a view shows and the plane around it, for an object whose height is a `share` of the
/// picture's; `None` where no depth is known.
pub fn find(
    camera: &Camera,
    pixel: [f64; 2],
    share: f64,
    view: usize,
    grids: &[DepthGrid],
    common_up: DVec3,
    seed: u64,
) -> Option<Stand> {
    let grid = &grids[view];
    let ray = camera.unproject(pixel)?;
    let [column, row] = grid.place(ray).map(|p| p.floor() as i64);
    let longer = f64::from(grid.columns.max(grid.rows));
    let mut near: Vec<(i64, f64)> = vec![];
    for reach in AROUND.map(|share| (share * longer).ceil().max(2.0) as i64) {
        let around = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
        let sites = around.filter_map(|(dx, dy)| Some((dx * dx + dy * dy, grid.site(column + dx, row + dy)?)));
        near = sites.filter(|(_, site)| grid.confirmed[*site]).map(|(far, site)| (far, grid.depth[site])).collect();
        if near.len() >= FEWEST {
            break;
        }
    }
    if near.len() < FEWEST {
        return None;
    }
    near.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let z = median(near.iter().take(9).map(|(_, z)| *z))?;
    let seen = DVec3::from(camera.along(ray, z));
    let height = share * f64::from(camera.size[1]) * z / f64::from(camera.focal[1]);
    let eye = DVec3::from(camera.center());

    let all = grids.iter().flat_map(|grid| {
        (0..grid.depth.len()).filter(|site| grid.confirmed[*site]).filter_map(|site| grid.point(site))
    });
    let mut around: Vec<DVec3> = all.filter(|p| (*p - seen).length() <= REACH * height).collect();
    let every = around.len().div_ceil(MOST).max(1);
    around = around.into_iter().step_by(every).collect();
    let on = (ON * height).max(ON_DEPTH * z);
    let fitted = level_plane(&around, seen, on, common_up, seed);
    let toward = |normal: DVec3| if normal.dot(eye - seen) < 0.0 { -normal } else { normal };
    let (through, normal) = fitted.map_or((seen, toward(common_up)), |(p, n)| (p, toward(n)));
    let steep = normal.dot(common_up) < STEEP;
    let apart = around.iter().map(|p| (*p - through).dot(normal).abs()).filter(|d| *d <= 3.0 * on);
    let roughness = median(apart).unwrap_or(0.0);
    // The pixel's ray meets the plane more exactly than the depth at the pixel has it.
    let along = (seen - eye).normalize();
    let slope = along.dot(normal);
    let foot = if slope.abs() > 0.05 { eye + along * ((through - eye).dot(normal) / slope) } else { seen };
    let foot = if (foot - seen).length() <= height { foot } else { seen };
    Some(Stand { foot, up: if steep { common_up } else { normal }, height, roughness, steep })
}

/// The plane near a point that most points are on, those that lie level first: a point of it and its normal.
fn level_plane(points: &[DVec3], near: DVec3, on: f64, up: DVec3, seed: u64) -> Option<(DVec3, DVec3)> {
    if points.len() < 12 {
        return None;
    }
    let drawn = plane::drawn(points, DRAWS, &mut Pcg64::new(seed.into(), 17), |(through, normal)| {
        if plane::distance((through, normal), near) > 2.0 * on {
            return None;
        }
        let count = points.iter().filter(|p| plane::distance((through, normal), **p) <= on).count() as f64;
        let level = if normal.dot(up).abs() >= STEEP { 1.0 } else { 0.5 };
        Some((count * level, (through, normal)))
    })?;
    Some(plane::refined(points, drawn, on, |_| 1.0, |_| true))
}

#[cfg(test)]
mod tests {
    use rand::RngExt as _;

    use super::*;
    use glam::dvec3;

    /// A floor with noise and a wall behind it: near the floor's middle the floor is found, whichever has more points.
    #[test]
    fn the_plane_is_that_of_the_floor() {
        let mut rng = Pcg64::new(2, 2);
        let mut points = vec![];
        for _ in 0..400 {
            let mut noise = || rng.random_range(-0.004..0.004);
            let wobble = noise();
            let (a, b) = (250.0 * noise(), 250.0 * noise());
            points.push(dvec3(a, b, 0.1 * a + wobble));
            points.push(dvec3(a, 1.0 + wobble, 1.0 + b));
        }
        let (through, normal) = level_plane(&points, dvec3(0.0, 0.2, 0.0), 0.02, DVec3::Z, 3).expect("a plane");
        let truth = dvec3(-0.1, 0.0, 1.0).normalize();
        assert!(normal.dot(truth).abs() > 0.9999, "{normal}");
        assert!(through.dot(truth).abs() < 0.002, "{through}");
        assert!(level_plane(&points[..5], DVec3::ZERO, 0.02, DVec3::Z, 3).is_none());
    }
}

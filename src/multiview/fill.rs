//! Depth where no views agree: blank walls and floors, sky.
//!
//! A picture falls into segments of one colour (Felzenszwalb and Huttenlocher 2004). Inverse depth is linear in the pixel on
//! a plane: where the confirmed depths in and around a segment lie on one, the segment does. Elsewhere a site is as deep as
//! the farther of what is seen around it: what shows nothing at all is most often behind.

use rand::{RngExt as _, SeedableRng as _};
use rayon::prelude::*;

use super::Sites;
use super::fuse::{Filled, Surface};
use super::picture::Picture;

/// Colours (8-bit, root of the sum over channels) by which a segment of one site may differ from its neighbour; one of n
/// sites by an n-th of that more than it does within itself.
const SEGMENT: f32 = 150.0;
/// Fewest sites of a segment.
const FEWEST: usize = 30;
/// Sites around a segment that tell its plane, too.
const RING: i32 = 4;
/// A confirmed depth in the segment counts as so many around it.
const OWN: f64 = 4.0;
/// Planes drawn.
const DRAWS: usize = 100;
/// Inverse depths within this share of the plane's are on it.
const ON: f64 = 0.02;
/// Share of the depths that must be on the plane, and fewest of them.
const MOST_ON: f64 = 0.6;
const FEWEST_ON: usize = 12;
/// A plane is gone on with to this much of the lowest and the highest inverse depth on it.
const BEYOND: f64 = 1.5;
/// Directions in which a site looks for what is known; opposite ones beside each other.
const DIRECTIONS: [[i32; 2]; 8] = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]];

/// Depths of what is not confirmed, for each view.
pub(super) fn fill(pictures: &[Picture], surfaces: &[Surface]) -> Vec<Filled> {
    let both: Vec<_> = pictures.iter().zip(surfaces).collect();
    both.into_par_iter().enumerate().map(|(at, (picture, surface))| one(picture, surface, at as u64)).collect()
}

fn one(picture: &Picture, surface: &Surface, seed: u64) -> Filled {
    let sites = picture.sites;
    let mut filled = vec![f64::NAN; sites.len()];
    // The object tells nothing of what is around it.
    let surface: &Surface = &surface.iter().zip(&picture.shown).map(|(z, s)| if *s { *z } else { f64::NAN }).collect();
    if surface.iter().all(|z| z.is_nan()) {
        return filled;
    }
    let segment = segments(&picture.colors, sites);
    let mut members: Vec<Vec<usize>> = vec![vec![]; segment.iter().max().map_or(0, |m| m + 1)];
    segment.iter().enumerate().for_each(|(site, s)| members[*s].push(site));
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    for (number, members) in members.iter().enumerate() {
        if members.iter().all(|site| surface[*site].is_finite()) {
            continue;
        }
        let Some(plane) = plane(picture, surface, (&segment, number), members, &mut rng) else { continue };
        let told = |site: &usize| plane.own || between(picture, surface, *site, &plane);
        for site in members.iter().filter(|site| surface[**site].is_nan()).filter(|site| told(site)) {
            filled[*site] = plane.depth(picture.pixel(*site)).unwrap_or(f64::NAN);
        }
    }
    let shells: Vec<(usize, f64)> = (0..sites.len())
        .filter(|site| surface[*site].is_nan() && filled[*site].is_nan())
        .filter_map(|site| Some((site, shell(surface, &filled, sites, site)?)))
        .collect();
    shells.into_iter().for_each(|(site, depth)| filled[site] = depth);
    filled
}

/// The first site in a direction whose depth is known.
fn first(known: impl Fn(usize) -> bool, sites: Sites, site: usize, [dx, dy]: [i32; 2]) -> Option<usize> {
    let [x, y] = sites.place(site);
    (1..).map_while(|k| sites.at(x + k * dx, y + k * dy)).find(|at| known(*at))
}

/// Whether a site lies between two known ones on a plane, in opposite directions: a plane ends somewhere, and what is above
/// a floor's last row is not floor.
fn between(picture: &Picture, surface: &Surface, site: usize, plane: &Plane) -> bool {
    let on = |direction: [i32; 2]| {
        let at = first(|at| surface[at].is_finite(), picture.sites, site, direction);
        at.is_some_and(|at| (Plane::inverse(plane.line, picture.pixel(at)) * surface[at] - 1.0).abs() <= ON)
    };
    DIRECTIONS.chunks(2).any(|pair| on(pair[0]) && on(pair[1]))
}

/// Depth from the nearest known sites in all directions: the second farthest of them.
fn shell(surface: &Surface, filled: &[f64], sites: Sites, site: usize) -> Option<f64> {
    let depth = |at: usize| if surface[at].is_finite() { surface[at] } else { filled[at] };
    let nearest = |direction| first(|at| depth(at).is_finite(), sites, site, direction).map(depth);
    let mut depths: Vec<f64> = DIRECTIONS.into_iter().filter_map(nearest).collect();
    depths.sort_unstable_by(|a, b| b.total_cmp(a));
    depths.get(1).or(depths.first()).copied()
}

/// Inverse depth over the picture, `a x + b y + c`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    line: [f64; 3],
    /// Of the inverse depths on it.
    range: [f64; 2],
    /// Whether confirmed depths of the segment itself are on it.
    own: bool,
}

impl Plane {
    fn inverse(line: [f64; 3], [x, y]: [f64; 2]) -> f64 {
        line[0] * x + line[1] * y + line[2]
    }

    fn depth(&self, pixel: [f64; 2]) -> Option<f64> {
        let inverse = Self::inverse(self.line, pixel);
        (inverse >= self.range[0] / BEYOND && inverse <= self.range[1] * BEYOND).then(|| 1.0 / inverse)
    }
}

/// A confirmed depth that tells a plane.
#[derive(Clone, Copy)]
struct Told {
    pixel: [f64; 2],
    inverse: f64,
    weight: f64,
}

/// The plane of a segment, if the confirmed depths in and around it are on one.
fn plane(
    picture: &Picture,
    surface: &Surface,
    (segment, number): (&[usize], usize),
    members: &[usize],
    rng: &mut rand_pcg::Pcg64,
) -> Option<Plane> {
    let sites = picture.sites;
    let mut around = vec![];
    for site in members {
        let [x, y] = sites.place(*site);
        let reach = (-RING..=RING).flat_map(|dy| (-RING..=RING).map(move |dx| [dx, dy]));
        let near = reach.filter_map(|[dx, dy]| sites.at(x + dx, y + dy));
        around.extend(near.filter(|at| segment[*at] != number && surface[*at].is_finite()));
    }
    around.sort_unstable();
    around.dedup();
    let told =
        |weight: f64| move |site: &usize| Told { pixel: picture.pixel(*site), inverse: 1.0 / surface[*site], weight };
    let own = members.iter().filter(|site| surface[**site].is_finite());
    let told: Vec<Told> = own.map(told(OWN)).chain(around.iter().map(told(1.0))).collect();
    if told.len() < FEWEST_ON {
        return None;
    }
    let on = |line: [f64; 3]| move |t: &&Told| (Plane::inverse(line, t.pixel) / t.inverse - 1.0).abs() <= ON;
    let support = |line: [f64; 3]| told.iter().filter(on(line)).map(|t| t.weight).sum::<f64>();
    let mut best: Option<(f64, [f64; 3])> = None;
    for _ in 0..DRAWS {
        let three: [Told; 3] = std::array::from_fn(|_| told[rng.random_range(0..told.len())]);
        let Some(line) = solve(three.iter()) else { continue };
        let supported = support(line);
        if best.is_none_or(|(most, _)| supported > most) {
            best = Some((supported, line));
        }
    }
    let (_, line) = best?;
    let line = solve(told.iter().filter(on(line)))?;
    let inliers: Vec<&Told> = told.iter().filter(on(line)).collect();
    let all: f64 = told.iter().map(|t| t.weight).sum();
    if inliers.len() < FEWEST_ON || support(line) < MOST_ON * all {
        return None;
    }
    let range = inliers.iter().fold([f64::INFINITY, 0.0_f64], |[a, b], t| [a.min(t.inverse), b.max(t.inverse)]);
    let own = inliers.iter().filter(|t| t.weight == OWN).count() >= FEWEST_ON;
    Some(Plane { line, range, own })
}

/// Least squares of the relative errors; `None` where the places are on a line.
fn solve<'t>(told: impl Iterator<Item = &'t Told>) -> Option<[f64; 3]> {
    let told: Vec<&Told> = told.collect();
    let n = told.len() as f64;
    let mean: [f64; 2] = std::array::from_fn(|a| told.iter().map(|t| t.pixel[a]).sum::<f64>() / n);
    let (mut m, mut r) = (glam::DMat3::ZERO, glam::DVec3::ZERO);
    for t in told {
        // Centred, and in the weights of relative errors.
        let row = glam::dvec3(t.pixel[0] - mean[0], t.pixel[1] - mean[1], 1.0);
        let weight = t.weight / (t.inverse * t.inverse);
        m += glam::DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
        r += row * (t.inverse * weight);
    }
    // Against the product of the diagonal, so that no unit matters.
    let size = m.x_axis.x * m.y_axis.y * m.z_axis.z;
    if m.determinant().is_nan() || m.determinant() <= 1e-6 * size {
        return None;
    }
    let s = m.inverse() * r;
    Some([s.x, s.y, s.z - s.x * mean[0] - s.y * mean[1]])
}

/// The number of each site's segment.
fn segments(colors: &[[u8; 3]], sites: Sites) -> Vec<usize> {
    let apart = |a: usize, b: usize| {
        colors[a].iter().zip(colors[b]).map(|(a, b)| (f32::from(*a) - f32::from(b)).powi(2)).sum::<f32>().sqrt()
    };
    let mut edges: Vec<(f32, usize, usize)> = vec![];
    for site in 0..sites.len() {
        let [x, y] = sites.place(site);
        for [dx, dy] in [[1, 0], [0, 1], [1, 1], [1, -1]] {
            edges.extend(sites.at(x + dx, y + dy).map(|other| (apart(site, other), site, other)));
        }
    }
    edges.sort_by(|a, b| a.0.total_cmp(&b.0));
    crate::segments::segments(sites.len(), &edges, SEGMENT, FEWEST).0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Camera;

    /// A floor of one colour with a blank middle, and a sky of another with nothing known in it.
    #[test]
    fn a_blank_floor_is_its_plane_and_a_sky_is_as_far_as_the_horizon() {
        let sites = Sites { columns: 60, rows: 40 };
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [100.0; 2],
            principal: [60.0, 20.0],
            distortion: [0.0; 4],
            size: [120, 80],
        };
        let sky = |site: usize| site / 60 < 20;
        let picture = Picture {
            camera,
            center: [0.0; 3],
            sites,
            grey: vec![0; 120 * 80],
            colors: (0..sites.len()).map(|site| if sky(site) { [90, 120, 250] } else { [120, 80, 40] }).collect(),
            shown: vec![true; sites.len()],
        };
        // The floor is 1.5 below the camera: inverse depth (y - 20) / 150.
        let depth = |site: usize| 150.0 / (picture.pixel(site)[1] - 20.0);
        let blank = |site: usize| (15..45).contains(&(site % 60)) && (24..36).contains(&(site / 60));
        let known = |site: usize| if sky(site) || blank(site) { f64::NAN } else { depth(site) };
        let surface: Surface = (0..sites.len()).map(known).collect();
        let filled = one(&picture, &surface, 1);
        let horizon = depth(20 * 60);
        for (site, filled) in filled.iter().enumerate() {
            if sky(site) {
                // Straight and slantwise down is the floor, and no nearer than its first rows.
                assert!((filled / horizon - 1.0).abs() < 1e-9, "{site}: {}", filled);
            } else if blank(site) {
                assert!((filled / depth(site) - 1.0).abs() < 1e-9, "{site}: {}", filled);
            } else {
                assert!(filled.is_nan());
            }
        }
        // The object, which is not shown, tells nothing, and neither does a view of which nothing is known.
        let hidden = Picture { shown: vec![false; sites.len()], ..picture };
        assert!(one(&hidden, &surface, 1).iter().all(|z| z.is_nan()));
    }

    #[test]
    fn segments_end_where_colours_change() {
        let sites = Sites { columns: 30, rows: 20 };
        let colors: Vec<[u8; 3]> = (0..sites.len())
            .map(|site| {
                let noise = (site % 2) as u8;
                if site % 30 < 12 { [100 + noise, 100, 100] } else { [160, 100 + noise, 100] }
            })
            .collect();
        let segment = segments(&colors, sites);
        assert_eq!(segment.iter().max(), Some(&1));
        assert!((0..sites.len()).all(|site| segment[site] == usize::from(site % 30 >= 12)));
    }
}

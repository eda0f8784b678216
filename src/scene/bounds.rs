//! What lies beyond a capture: cameras that structure from motion has placed nowhere near the others, points without a
//! distance, and the radius of the rest.
//!
//! Every scale here is a median of distances, or a high quantile of them, so that a few strays change nothing (one of
//! the distances each time: a mean of two would have the stray in it where there are three cameras), and all limits are
//! ratios, so that the unit of the capture changes nothing. They are wide: what a person could have photographed stays.
//! Structure from motion fails by orders of magnitude, since a triangulation without parallax has no scale at all.

use super::Point;
use crate::statistics::quantile;

/// A camera is a stray from so many times as far from the others as these are from one another, or from the points,
/// whichever is more. A close-up of a detail amid photographs of the whole building is 10 to 50 times nearer.
const CAMERA_REACH: f64 = 100.0;
/// A point is a stray from so many times as far away as the cameras are apart, or as the points usually are, whichever is
/// more. Behind 2,000 times the distance between cameras a point has less than a pixel of parallax at a focal length of
/// 2,000 pixels; a mountain at 30 km behind a table photographed from 3 m is at 10,000.
const POINT_REACH: f64 = 20_000.0;
/// Other cameras that a camera is compared with at most, so that thousands cost no more than milliseconds each.
const COMPARED: usize = 512;

/// Where a capture is, and what does not belong to it.
pub(super) struct Bounds {
    /// `[camera]` whether it stands where no capture has any.
    pub stray: Vec<bool>,
    /// The camera amid the others.
    middle: [f64; 3],
    /// Distance from there beyond which points are strays; infinite where nothing gives a scale.
    reach: f64,
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// The median distance of every camera from the others.
fn apart(centers: &[[f64; 3]]) -> Vec<f64> {
    let every = centers.len().div_ceil(COMPARED).max(1);
    let from = |(at, center): (usize, &[f64; 3])| {
        let others = centers.iter().enumerate().step_by(every).filter(|(other, _)| *other != at);
        quantile(others.map(|(_, other)| distance(*center, *other)), 0.5).unwrap_or(0.0)
    };
    centers.iter().enumerate().map(from).collect()
}

impl Bounds {
    /// Of cameras at these centres and the points that they see.
    pub fn of(centers: &[[f64; 3]], points: &[Point]) -> Self {
        let apart = apart(centers);
        let middle =
            apart.iter().zip(centers).min_by(|a, b| a.0.total_cmp(b.0)).map_or([0.0; 3], |(_, center)| *center);
        let spread = quantile(apart.iter().copied(), 0.5).unwrap_or(0.0);
        let away = points.iter().map(|p| distance(p.position.map(f64::from), middle));
        let depth = quantile(away, 0.5).unwrap_or(0.0);
        let limit = CAMERA_REACH * spread.max(depth);
        let stray: Vec<bool> = apart.iter().map(|apart| limit > 0.0 && *apart > limit).collect();
        let kept = centers.iter().zip(&stray).filter(|(_, stray)| !**stray);
        let extent = kept.map(|(center, _)| distance(*center, middle)).fold(0.0, f64::max);
        let reach = POINT_REACH * extent.max(depth);
        Self { stray, middle, reach: if reach > 0.0 { reach } else { f64::INFINITY } }
    }

    /// Whether a point is so far away that nothing has measured its distance.
    pub fn is_beyond(&self, point: &Point) -> bool {
        distance(point.position.map(f64::from), self.middle) > self.reach
    }
}

/// The largest distance of a camera from the mean camera; 0 if they all coincide. A camera more than [`OUTLIER`] times as
/// far from the middle as nine in ten does not count: it may be no stray, and must not set the scale.
pub(super) fn radius(centers: &[[f64; 3]]) -> f64 {
    let apart = apart(centers);
    let Some((_, middle)) = apart.iter().zip(centers).min_by(|a, b| a.0.total_cmp(b.0)) else { return 0.0 };
    let from_middle = |center: &[f64; 3]| distance(*center, *middle);
    let usual = quantile(centers.iter().map(from_middle), 0.9).unwrap_or(0.0);
    let counts = |center: &&[f64; 3]| usual <= 0.0 || from_middle(center) <= OUTLIER * usual;
    let kept: Vec<[f64; 3]> = centers.iter().filter(counts).copied().collect();
    let mean: [f64; 3] = std::array::from_fn(|i| kept.iter().map(|c| c[i]).sum::<f64>() / kept.len() as f64);
    kept.iter().map(|center| distance(*center, mean)).fold(0.0, f64::max)
}

/// A camera farther from the middle than so many times the distance that nine in ten stay within does not count for the
/// radius. Of spin-1, fern, the built-in scene and a walk around a table the farthest is at 1.1 to 1.5 times.
const OUTLIER: f64 = 4.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn point(position: [f64; 3]) -> Point {
        Point { position: position.map(|x| x as f32), color: [0; 3] }
    }

    /// Cameras on a circle of radius 1, and points on one of radius 0.5.
    fn orbit(cameras: usize) -> (Vec<[f64; 3]>, Vec<Point>) {
        let on = |i: usize, n: usize, radius: f64| {
            let angle = std::f64::consts::TAU * i as f64 / n as f64;
            [radius * angle.cos(), 0.1 * (i % 3) as f64, radius * angle.sin()]
        };
        ((0..cameras).map(|i| on(i, cameras, 1.0)).collect(), (0..200).map(|i| point(on(i, 200, 0.5))).collect())
    }

    fn strays(centers: &[[f64; 3]], points: &[Point]) -> Vec<usize> {
        let bounds = Bounds::of(centers, points);
        (0..centers.len()).filter(|i| bounds.stray[*i]).collect()
    }

    #[test]
    fn strays_are_found_in_any_unit_at_any_place() {
        for unit in [1e-9, 1e-3, 1.0, 1e6] {
            for far in [1e3, 1e9, 1e12] {
                for shift in [0.0, 1e4] {
                    let (mut centers, mut points) = orbit(20);
                    centers[7] = [far, 0.0, far];
                    centers[13] = [far, 0.0, -far];
                    points[5] = point([1e9, 2.0, 3.0]);
                    let place = |p: [f64; 3]| p.map(|x| unit * (x + shift));
                    let centers: Vec<_> = centers.into_iter().map(place).collect();
                    let points: Vec<_> = points.iter().map(|p| point(place(p.position.map(f64::from)))).collect();
                    let bounds = Bounds::of(&centers, &points);
                    let found: Vec<usize> = (0..20).filter(|i| bounds.stray[*i]).collect();
                    assert_eq!(found, [7, 13], "unit {unit}, {far} away");
                    let beyond: Vec<usize> = (0..200).filter(|i| bounds.is_beyond(&points[*i])).collect();
                    assert_eq!(beyond, [5], "unit {unit}");
                }
            }
        }
    }

    /// Three photographs are enough to say which of them is wrong; two are not.
    #[test]
    fn of_three_cameras_one_may_be_a_stray() {
        let points = [point([0.0, 0.0, 3.0]), point([1.0, 0.0, 4.0])];
        assert_eq!(strays(&[[0.0; 3], [1e6, 0.0, 0.0], [0.5, 0.0, 0.0]], &points), [1]);
        assert_eq!(strays(&[[0.0; 3], [1e6, 0.0, 0.0]], &points), [0usize; 0]);
        assert_eq!(strays(&[[0.0; 3]], &points), [0usize; 0]);
        assert_eq!(strays(&[], &points), [0usize; 0]);
    }

    #[test]
    fn what_can_be_photographed_stays() {
        // A tripod for most of the time, 0.1 mm apart, then a walk of 30 m, with points 3 m away.
        let (_, points) = orbit(0);
        let points: Vec<Point> = points.iter().map(|p| point(p.position.map(|x| 6.0 * f64::from(x)))).collect();
        let tripod = (0..80).map(|i| [1e-4 * f64::from(i % 7), 0.0, 0.0]);
        let walk: Vec<[f64; 3]> = tripod.chain((0..20).map(|i| [1.5 * f64::from(i), 0.0, 0.0])).collect();
        assert_eq!(strays(&walk, &points), [0usize; 0]);
        // Close-ups of a hand's breadth amid photographs of the building from 30 m, the points on the detail.
        let near = (0..60).map(|i| [0.3 * f64::from(i % 6), 0.1 * f64::from(i / 6), 0.0]);
        let building: Vec<[f64; 3]> = near.chain((0..20).map(|i| [f64::from(i) - 10.0, 0.0, -30.0])).collect();
        let detail: Vec<Point> = (0..100).map(|i| point([0.02 * f64::from(i), 0.0, 0.5])).collect();
        assert_eq!(strays(&building, &detail), [0usize; 0]);
        // A table in front of mountains 10 km away, under a dome of 1 km.
        let (centers, mut points) = orbit(30);
        points.extend((0..50).map(|i| point([1e4, f64::from(i) * 10.0, 300.0])));
        points.extend((0..50).map(|i| point([f64::from(i), 1e3, 0.0])));
        let bounds = Bounds::of(&centers, &points);
        assert!(!points.iter().any(|p| bounds.is_beyond(p)));
        // A flight over a city: 100 m high, 2 km long, hills at 100 km.
        let flight: Vec<[f64; 3]> = (0..200).map(|i| [10.0 * f64::from(i), 100.0, 0.0]).collect();
        let mut ground: Vec<Point> = (0..500).map(|i| point([4.0 * f64::from(i), 0.0, 5.0])).collect();
        ground.push(point([0.0, 800.0, 1e5]));
        assert_eq!(strays(&flight, &ground), [0usize; 0]);
        assert!(!Bounds::of(&flight, &ground).is_beyond(&ground[500]));
        // All of it at one place: nothing has a scale.
        let one = vec![point([1.0; 3]); 5];
        assert_eq!(strays(&[[1.0; 3]; 4], &one), [0usize; 0]);
    }

    #[test]
    fn one_camera_does_not_set_the_radius() {
        let (centers, _) = orbit(40);
        let mean: [f64; 3] = std::array::from_fn(|i| centers.iter().map(|c| c[i]).sum::<f64>() / 40.0);
        let published = centers.iter().map(|c| distance(*c, mean)).fold(0.0, f64::max);
        assert_eq!(radius(&centers), published);
        for far in [12.0, 50.0, 1e9] {
            let mut with = centers.clone();
            with.push([0.0, far, 0.0]);
            assert_eq!(radius(&with), published, "{far}");
        }
        // Far, and no exception.
        let mut with = centers.clone();
        with.extend((0..10).map(|i| [20.0, 0.0, f64::from(i)]));
        assert!(radius(&with) > 10.0);
        assert_eq!(radius(&[[3.0; 3]; 5]), 0.0);
        assert_eq!(radius(&[]), 0.0);
        assert_eq!(radius(&[[0.0; 3], [0.0, 2.0, 0.0]]), 1.0);
    }
}

//! A splat that was moved and scaled against the COLMAP model that it was trained on.
//!
//! Some programs bring a capture to the origin and to unit size before they train, and leave the splat there: the mean of
//! the cameras becomes the origin, and the largest coordinate of a camera becomes 1. The model's points tell: in the right
//! frame they lie where the splat has matter. A frame that is nearly right, as where only some of the model's cameras were
//! used, is refined by iterated closest points (Besl and McKay 1992) without rotation, with a scale as in Umeyama (1991).

use crate::statistics::median;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// Points that are looked at, at most.
const POINTS: usize = 1000;
/// Median distance from a point to the nearest matter, over the points' spread, at which a frame is right.
const RIGHT: f64 = 0.03;
/// Another frame has to be better than that of the model by this factor.
const BETTER: f64 = 3.0;
/// Rounds of refinement.
const ROUNDS: usize = 30;
/// Share of the points, the nearest ones, that a round follows: others may be of what the splat does not have.
const FOLLOWED: f64 = 0.7;

/// Takes positions of the model to the splat: `scale * (p - origin)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// The model's position that is the splat's origin.
    pub origin: [f64; 3],
    /// Lengths of the splat's per length of the model's.
    pub scale: f64,
}

impl Frame {
    /// A position of the model in the splat.
    pub fn apply(&self, position: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|c| self.scale * (position[c] - self.origin[c]))
    }
}

fn mean(points: &[[f64; 3]]) -> [f64; 3] {
    std::array::from_fn(|c| points.iter().map(|p| p[c]).sum::<f64>() / points.len() as f64)
}

/// The splat's matter, to be searched.
struct Matter<'a> {
    centers: &'a [[f64; 3]],
    tree: ImmutableKdTree<f64, 3>,
}

impl Matter<'_> {
    /// The nearest centre to a position, and its distance.
    fn nearest(&self, position: [f64; 3]) -> (f64, [f64; 3]) {
        let found = self.tree.nearest_one::<SquaredEuclidean>(&position);
        (found.distance.sqrt(), self.centers[found.item as usize])
    }

    /// Median distance of the points from matter, over the median distance of the points from their middle.
    fn misses(&self, points: &[[f64; 3]], frame: &Frame) -> f64 {
        let moved: Vec<[f64; 3]> = points.iter().map(|p| frame.apply(*p)).collect();
        let median = |values: &dyn Fn(&[f64; 3]) -> f64| median(moved.iter().map(values)).unwrap_or(f64::NAN);
        let middle: [f64; 3] = std::array::from_fn(|c| median(&|p| p[c]));
        median(&|p| self.nearest(*p).0) / median(&|p| distance(*p, middle))
    }

    /// The frame moved and scaled so that the nearest of the points come to lie on matter.
    fn refined(&self, points: &[[f64; 3]], mut frame: Frame) -> Frame {
        for _ in 0..ROUNDS {
            let mut pairs: Vec<(f64, [f64; 3], [f64; 3])> = points
                .iter()
                .map(|p| {
                    let (far, nearest) = self.nearest(frame.apply(*p));
                    (far, *p, nearest)
                })
                .collect();
            pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
            pairs.truncate((FOLLOWED * pairs.len() as f64) as usize);
            let (from, to): (Vec<_>, Vec<_>) = pairs.into_iter().map(|(_, from, to)| (from, to)).unzip();
            let [middle, aim] = [mean(&from), mean(&to)];
            let along: f64 =
                from.iter().zip(&to).flat_map(|(p, q)| (0..3).map(move |c| (p[c] - middle[c]) * (q[c] - aim[c]))).sum();
            let own: f64 = from.iter().flat_map(|p| (0..3).map(move |c| (p[c] - middle[c]).powi(2))).sum();
            let scale = along / own;
            if !(scale.is_finite() && scale > 0.0) {
                break;
            }
            frame = Frame { origin: std::array::from_fn(|c| middle[c] - aim[c] / scale), scale };
        }
        frame
    }
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

/// Where a splat stands whose matter has these centres: `points` are positions of the model, `cameras` those of its cameras
/// that may have been trained on, in sets to choose from. `None` where it stands in the model's own frame, or in none that is
/// known.
pub fn find(points: &[[f64; 3]], cameras: &[Vec<[f64; 3]>], matter: &[[f64; 3]]) -> Option<Frame> {
    if points.len() < 100 || matter.len() < 100 {
        return None;
    }
    let points: Vec<[f64; 3]> = points.iter().step_by(points.len().div_ceil(POINTS)).copied().collect();
    let matter = Matter { centers: matter, tree: ImmutableKdTree::new_from_slice(matter) };
    let own = matter.misses(&points, &Frame { origin: [0.0; 3], scale: 1.0 });
    if own <= RIGHT {
        return None;
    }
    let coarse = cameras.iter().filter_map(|cameras| unit_size(cameras));
    let judged = coarse.flat_map(|frame| [frame, matter.refined(&points, frame)]);
    let judged = judged.map(|frame| (matter.misses(&points, &frame), frame));
    let (misses, frame) = judged.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (misses <= RIGHT && BETTER * misses <= own).then_some(frame)
}

/// The frame in which the cameras' mean is the origin and their largest coordinate 1.
fn unit_size(cameras: &[[f64; 3]]) -> Option<Frame> {
    let origin = mean(cameras);
    let largest = cameras.iter().flat_map(|p| (0..3).map(|c| (p[c] - origin[c]).abs())).fold(0.0, f64::max);
    (largest > 0.0).then_some(Frame { origin, scale: 1.0 / largest })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on two walls and a floor around the origin, as irregular as a lattice of golden ratios.
    fn surfaces(count: u32) -> Vec<[f64; 3]> {
        let of = |i: u32| {
            let [u, v] = [0.618_034 * f64::from(i), 0.754_878 * f64::from(i)].map(|x| 10.0 * (x.fract() - 0.5));
            [[u, v, 5.0], [-5.0, u, v], [u, 4.0, v]][i as usize % 3]
        };
        (0..count).map(of).collect()
    }

    #[test]
    fn a_splat_that_was_brought_to_unit_size_is_found() {
        let (points, all) = (surfaces(900), surfaces(9000));
        let cameras: Vec<[f64; 3]> = (0..40).map(|i| [0.2 * f64::from(i) - 3.0, -1.0, -2.0]).collect();
        assert_eq!(find(&points, std::slice::from_ref(&cameras), &all), None, "it stands where the model does");
        // Its program used every second camera alone.
        let used: Vec<[f64; 3]> = cameras.iter().step_by(2).copied().collect();
        let truth = unit_size(&used).expect("they stand apart");
        let matter: Vec<[f64; 3]> = all.iter().map(|p| truth.apply(*p)).collect();
        let found = find(&points, std::slice::from_ref(&cameras), &matter).expect("a frame");
        // The lattice is 0.1 wide on sides of 10, and many points average out: a hundredth of a side is five times that.
        let off = points.iter().map(|p| distance(found.apply(*p), truth.apply(*p)) / truth.scale).fold(0.0, f64::max);
        assert!(off < 0.1, "{off}");
        // It is known which.
        assert_eq!(find(&points, &[cameras.clone(), used], &matter), Some(truth));
        // Another place altogether is none of these.
        let elsewhere: Vec<[f64; 3]> = all.iter().map(|p| [p[1] + 40.0, p[2] * p[2], p[0]]).collect();
        assert_eq!(find(&points, &[cameras], &elsewhere), None);
    }
}

//! A splat that stands elsewhere than the COLMAP model that it was trained on: moved, scaled or turned.
//!
//! Some programs bring a capture to the origin and to unit size before they train, and leave the splat there: the mean of
//! the cameras becomes the origin, and the largest coordinate of a camera becomes 1. Others turn it upright, ours among them
//! (`export --up`). The model's points tell: in the right frame they lie where the splat has matter, and have its colours. Turns
//! are tried all around (the spirals of Alexa, "Super-Fibonacci Spirals", CVPR 2022); what is nearly right is turned, moved and scaled
//! by steps that become smaller (Hooke and Jeeves 1961). Closest points (Besl and McKay 1992) slide along walls too slowly, and stay four
//! degrees off where the splat is sparse.

use glam::{DMat3, DQuat, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

use crate::statistics::{median, middle};

/// Points that are looked at, at most,
const POINTS: usize = 1000;
/// and while turns are tried.
const FEW: usize = 150;
/// Turns that are tried: neighbours are 30 degrees apart.
const TURNS: usize = 600;
/// Of these, those from which a search begins.
const BEGUN: usize = 8;
/// Median distance from a point to the nearest matter, over the points' spread, at which a frame is right.
const RIGHT: f64 = 0.03;
/// The same at which the model's own frame is taken where no other is found.
const NEARLY: f64 = 0.1;
/// Another frame has to be better than that of the model by this factor.
const BETTER: f64 = 3.0;
/// Ratios of the splat's spread to the model's that are tried: either may have more that is far away.
const SPREADS: [f64; 4] = [0.6, 0.8, 1.0, 1.3];
/// Steps of a search, radians and parts of the points' spread: the first, and the least.
const STEPS: [f64; 2] = [0.14, 0.004];
/// Those of the last search.
const LAST_STEPS: [f64; 2] = [0.02, 0.0005];
/// A point farther from matter than this part of the spread is no farther: it may be of what the splat does not have.
const FAR: f64 = 0.2;

/// Positions with their colours, 0 to 1.
pub type Colored = (DVec3, [f32; 3]);

/// Takes positions of the model to the splat: `aim + scale * turn (p - origin)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// A position of the model
    pub origin: DVec3,
    /// and the same in the splat.
    pub aim: DVec3,
    /// The splat's axes by the model's.
    pub turn: DMat3,
    /// Lengths of the splat's per length of the model's.
    pub scale: f64,
}

impl Frame {
    /// That of the model.
    const OWN: Self = Self { origin: DVec3::ZERO, aim: DVec3::ZERO, turn: DMat3::IDENTITY, scale: 1.0 };

    /// A position of the model in the splat.
    pub fn apply(&self, position: DVec3) -> DVec3 {
        self.aim + self.scale * (self.turn * (position - self.origin))
    }
}

/// The middle of positions, and their median distance from it.
fn spread(points: &[DVec3]) -> (DVec3, f64) {
    let middle = middle(points).unwrap_or(DVec3::NAN);
    (middle, median(points.iter().map(|p| p.distance(middle))).unwrap_or(f64::NAN))
}

/// A frame for each of the rotations all around, which are alike everywhere.
fn turned(frame: impl Fn(DMat3) -> Frame) -> Vec<Frame> {
    const PSI: f64 = 1.533_751_168_755_204_3;
    let turn = |i: usize| {
        let s = i as f64 + 0.5;
        let [near, far] = [(s / TURNS as f64).sqrt(), (1.0 - s / TURNS as f64).sqrt()];
        let [a, b] = [std::f64::consts::SQRT_2, PSI].map(|by| std::f64::consts::TAU * s / by);
        DMat3::from_quat(DQuat::from_xyzw(near * a.sin(), near * a.cos(), far * b.sin(), far * b.cos()))
    };
    (0..TURNS).map(turn).map(frame).collect()
}

/// The splat's matter, to be searched.
struct Matter<'a> {
    centers: &'a [Colored],
    tree: ImmutableKdTree<f64, 3>,
}

impl Matter<'_> {
    /// The nearest centre to a position, and its distance.
    fn nearest(&self, position: DVec3) -> (f64, Colored) {
        let found = self.tree.nearest_one::<SquaredEuclidean>(&position.to_array());
        (found.distance.sqrt(), self.centers[found.item as usize])
    }

    /// Median distance of the points from matter, over their spread.
    fn misses(&self, points: &[Colored], frame: &Frame, spread: f64) -> f64 {
        let far = points.iter().map(|(p, _)| self.nearest(frame.apply(*p)).0);
        median(far).unwrap_or(f64::NAN) / (frame.scale * spread)
    }

    /// Mean difference of the points' colours from those of the matter that they lie on.
    fn discolors(&self, points: &[Colored], frame: &Frame) -> f64 {
        let differs = |(p, color): &Colored| {
            let (_, (_, own)) = self.nearest(frame.apply(*p));
            color.iter().zip(own).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>()
        };
        points.iter().map(differs).sum::<f64>() / points.len() as f64
    }

    /// Mean distance of the points from matter, over their spread.
    fn cost(&self, points: &[Colored], frame: &Frame, spread: f64) -> f64 {
        let far = points.iter().map(|(p, _)| (self.nearest(frame.apply(*p)).0 / (frame.scale * spread)).min(FAR));
        far.sum::<f64>() / points.len() as f64
    }

    /// The frame turned, moved and scaled by steps so that the points come to lie on matter.
    fn searched(&self, points: &[Colored], begun: Frame, spread: f64, [mut step, least]: [f64; 2]) -> Frame {
        let (mut best, mut frame) = (self.cost(points, &begun, spread), begun);
        while step > least {
            let before = best;
            for way in 0..7 {
                for step in [step, -step] {
                    let mut other = frame;
                    match way {
                        0..3 => other.turn = DMat3::from_axis_angle(DVec3::AXES[way], step) * frame.turn,
                        3..6 => other.aim += DVec3::AXES[way - 3] * (step * spread * frame.scale),
                        _ => other.scale *= step.exp(),
                    }
                    let cost = self.cost(points, &other, spread);
                    if cost < best {
                        (best, frame) = (cost, other);
                        break;
                    }
                }
            }
            if best >= before {
                step *= 0.5;
            }
        }
        frame
    }
}

/// Where a splat stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Place {
    /// In the frame of the model, or there is too little to tell.
    Own,
    /// In another.
    Elsewhere(Frame),
    /// Neither in the model's nor in any that was found.
    Unknown,
}

/// Where a splat stands that has this matter: `points` are those of the model, `cameras` the centres of its cameras
/// that may have been trained on, in sets to choose from.
pub fn find(points: &[Colored], cameras: &[Vec<DVec3>], matter: &[Colored]) -> Place {
    if points.len() < 100 || matter.len() < 100 {
        return Place::Own;
    }
    let some = |most: usize| points.iter().step_by(points.len().div_ceil(most)).copied().collect::<Vec<Colored>>();
    let (points, few) = (some(POINTS), some(FEW));
    let places = |of: &[Colored]| of.iter().map(|(p, _)| *p).collect::<Vec<DVec3>>();
    let tree = ImmutableKdTree::new_from_slice(&matter.iter().map(|(p, _)| p.to_array()).collect::<Vec<_>>());
    let matter = Matter { centers: matter, tree };
    let (middle, wide) = spread(&places(&points));
    let misses = |frame: &Frame| matter.misses(&points, frame, wide);
    let own = misses(&Frame::OWN);
    if own <= RIGHT {
        return Place::Own;
    }
    let right = |frame: &Frame| Some(misses(frame)).filter(|far| *far <= RIGHT.min(own / BETTER));
    let taken = |frame: Frame| Place::Elsewhere(matter.searched(&points, frame, wide, LAST_STEPS));
    // Turns are about the points' middle.
    let about = |frame: Frame| Frame { origin: middle, aim: frame.apply(middle), ..frame };
    let unit: Vec<Frame> = cameras.iter().filter_map(|cameras| unit_size(cameras)).map(about).collect();
    let known: Vec<Frame> =
        unit.iter().flat_map(|frame| [*frame, matter.searched(&points, *frame, wide, STEPS)]).collect();
    if let Some(frame) = best(&matter, &points, &known, right) {
        return taken(frame);
    }
    let (aim, its) = spread(&places(matter.centers));
    let by_spread = SPREADS.map(|part| Frame { origin: middle, aim, scale: part * its / wide, ..Frame::OWN });
    // Those whose place is known are turned about the splat's origin.
    let about_origin = unit.into_iter().chain([about(Frame::OWN)]);
    let tried = about_origin.map(|frame| turned(|turn| Frame { turn, aim: turn * frame.aim, ..frame }));
    let tried = tried.chain(by_spread.into_iter().map(|frame| turned(|turn| Frame { turn, ..frame })));
    // A corner of bare walls is like itself at any scale: the best of all is taken, not the first that will do.
    let search = |frames: Vec<Frame>| {
        let mut begun: Vec<(f64, Frame)> =
            frames.into_par_iter().map(|frame| (matter.cost(&few, &frame, wide), frame)).collect();
        begun.sort_by(|a, b| a.0.total_cmp(&b.0));
        begun.truncate(BEGUN);
        begun.into_par_iter().map(|(_, frame)| matter.searched(&few, frame, wide, STEPS)).collect::<Vec<Frame>>()
    };
    let searched: Vec<Frame> = tried.flat_map(search).collect();
    if let Some(frame) = best(&matter, &points, &searched, right) {
        return taken(frame);
    }
    if own <= NEARLY { Place::Own } else { Place::Unknown }
}

/// The frame in which the points lie on matter, and on such as has their colours: `right` says how far they miss it, if a frame may be
/// taken at all.
fn best(
    matter: &Matter<'_>,
    points: &[Colored],
    frames: &[Frame],
    right: impl Fn(&Frame) -> Option<f64>,
) -> Option<Frame> {
    let judged = frames.iter().filter_map(|frame| Some((right(frame)? * matter.discolors(points, frame), *frame)));
    judged.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, frame)| frame)
}

/// The frame in which the cameras' mean is the origin and their largest coordinate 1.
fn unit_size(cameras: &[DVec3]) -> Option<Frame> {
    if cameras.is_empty() {
        return None;
    }
    let origin = cameras.iter().sum::<DVec3>() / cameras.len() as f64;
    let largest = cameras.iter().map(|p| (*p - origin).abs().max_element()).fold(0.0, f64::max);
    (largest > 0.0).then_some(Frame { origin, scale: 1.0 / largest, ..Frame::OWN })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on two walls, a floor and two balls around the origin, as irregular as a lattice of golden ratios, in a colour each. (Walls alone
    /// are like themselves at any scale.)
    fn surfaces(count: u32) -> Vec<Colored> {
        let of = |i: u32| {
            let [u, v] = [0.618_034 * f64::from(i), 0.754_878 * f64::from(i)].map(|x| 10.0 * (x.fract() - 0.5));
            let ball = |middle: [f64; 3], radius: f64| {
                let (sin, cos) = u.sin_cos();
                let around = (1.0 - 0.04 * v * v).sqrt();
                (DVec3::from_array(middle) + radius * DVec3::new(around * cos, 0.2 * v, around * sin)).to_array()
            };
            let places =
                [[u, v, 5.0], [-5.0, u, v], [u, 4.0, v], ball([0.0, 1.0, 0.0], 1.5), ball([3.0, -2.0, -3.0], 0.8)];
            let which = i as usize % 5;
            let mut color = [0.2; 3];
            color[which % 3] = 0.8;
            (DVec3::from_array(places[which]), color)
        };
        (0..count).map(of).collect()
    }

    fn moved(all: &[Colored], frame: &Frame) -> Vec<Colored> {
        all.iter().map(|(p, color)| (frame.apply(*p), *color)).collect()
    }

    fn elsewhere(place: Place) -> Frame {
        match place {
            Place::Elsewhere(frame) => frame,
            other => panic!("{other:?}"),
        }
    }

    /// The farthest that a point is off, in lengths of the model's.
    fn off(points: &[Colored], found: &Frame, truth: &Frame) -> f64 {
        points.iter().map(|(p, _)| found.apply(*p).distance(truth.apply(*p)) / truth.scale).fold(0.0, f64::max)
    }

    #[test]
    fn a_splat_that_was_brought_to_unit_size_is_found() {
        let (points, all) = (surfaces(900), surfaces(9000));
        let cameras: Vec<DVec3> = (0..40).map(|i| DVec3::new(0.2 * f64::from(i) - 3.0, -1.0, -2.0)).collect();
        assert_eq!(find(&points, std::slice::from_ref(&cameras), &all), Place::Own, "it stands where the model does");
        // Its program used every second camera alone.
        let used: Vec<DVec3> = cameras.iter().step_by(2).copied().collect();
        let truth = unit_size(&used).expect("they stand apart");
        let matter = moved(&all, &truth);
        let found = elsewhere(find(&points, std::slice::from_ref(&cameras), &matter));
        // The lattice is 0.1 wide on sides of 10. Cameras are where pictures of the splat are drawn from: a fiftieth of a side is nothing.
        let far = off(&points, &found, &truth);
        assert!(far < 0.2, "{far}");
        // It is known which.
        let known = elsewhere(find(&points, &[cameras.clone(), used], &matter));
        assert!(off(&points, &known, &truth) < 0.05, "{}", off(&points, &known, &truth));
        // Another place altogether is none of these.
        let bent: Vec<Colored> =
            all.iter().map(|(p, color)| (DVec3::new(p.y + 40.0, p.z * p.z, p.x), *color)).collect();
        assert_eq!(find(&points, &[cameras], &bent), Place::Unknown);
    }

    /// Turned upright alone, as `export` does, and turned, moved and scaled, with haze that the model knows nothing of. Two walls and a
    /// floor are nearly alike at several turns: their colours tell.
    #[test]
    fn a_splat_that_was_turned_is_found() {
        let (points, all) = (surfaces(900), surfaces(9000));
        let cameras: Vec<DVec3> = (0..40).map(|i| DVec3::new(0.2 * f64::from(i) - 3.0, -1.0, -2.0)).collect();
        let turn = DMat3::from_euler(glam::EulerRot::XYZ, 2.0, -0.7, 1.1);
        let unit = unit_size(&cameras).expect("they stand apart");
        for truth in [
            Frame { turn, ..Frame::OWN },
            Frame { turn, ..unit },
            Frame { turn, aim: DVec3::new(3.0, -8.0, 1.0), scale: 2.3, ..Frame::OWN },
        ] {
            let mut matter = moved(&all, &truth);
            let haze = (0..900u32).map(|i| {
                let [u, v, w] = [0.819_173, 0.671_044, 0.549_700].map(|by| 20.0 * ((by * f64::from(i)).fract() - 0.5));
                (truth.apply(DVec3::new(u, v, w)), [0.5; 3])
            });
            matter.extend(haze);
            let found = elsewhere(find(&points, std::slice::from_ref(&cameras), &matter));
            let far = off(&points, &found, &truth);
            assert!(far < 0.2, "{far} {truth:?}");
        }
    }
}

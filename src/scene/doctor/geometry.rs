//! Do cameras and points have anything to do with each other? What a model of another capture, another unit or a broken
//! export fails, and no real capture: every point was seen by two cameras at least.

use rayon::prelude::*;

use super::{Report, Severity};
use crate::scene::{Camera, Scene};
use crate::statistics::{median, quantile};

/// Points that are looked at, at most.
const POINTS: usize = 20_000;
/// Least share of the points that two pictures have to show, or one in a capture of one picture. Real captures show all but
/// those of photographs that are not there.
const LEAST_SEEN: f64 = 0.2;
/// A picture with a smaller share of the points is worth a look: its camera may be registered wrongly.
const FEW_POINTS: f64 = 0.01;
/// Middle nine tenths of the points in a picture, as a share of its width or height: below this it shows no scene.
const LEAST_EXTENT: f64 = 0.02;
/// Distance of the cameras from one another and of the points from one another, over that between cameras and points. A
/// triangulation needs some hundredths.
const LEAST_SPREAD: f64 = 1e-4;
/// Focal lengths over the longer side of the picture: from a fisheye's crop to a telescope.
const FOCAL_LENGTHS: [f64; 2] = [0.05, 200.0];
/// Distance of the principal point from the picture's centre, over the longer side.
const FARTHEST_PRINCIPAL: f64 = 10.0;
/// Largest coefficient of a lens.
const LARGEST_DISTORTION: f64 = 1e3;

/// What one camera has of the points.
struct Shown {
    /// `[point]` whether it is in the picture.
    inside: Vec<bool>,
    in_front: usize,
    /// Of the middle nine tenths of those in the picture, over its width or height, whichever is more.
    extent: f64,
}

fn shown(camera: &Camera, points: &[[f64; 3]]) -> Shown {
    let size = camera.size.map(f64::from);
    let (mut in_front, mut at) = (0, [vec![], vec![]]);
    let mut look = |point: &[f64; 3]| {
        let Some(pixel) = camera.project(*point) else { return false };
        in_front += 1;
        let inside = (0..2).all(|i| pixel[i] >= 0.0 && pixel[i] < size[i]);
        if inside {
            (0..2).for_each(|i| at[i].push(pixel[i] / size[i]));
        }
        inside
    };
    let inside = points.iter().map(&mut look).collect();
    let extent = |values: &Vec<f64>| {
        let of = |share: f64| quantile(values.iter().copied(), share);
        of(0.95).zip(of(0.05)).map_or(0.0, |(high, low)| high - low)
    };
    let extent = at.iter().map(extent).fold(0.0, f64::max);
    Shown { inside, in_front, extent }
}

/// Median distance between each two of at most a hundred of these.
fn spread(places: &[[f64; 3]]) -> f64 {
    let places: Vec<&[f64; 3]> = places.iter().step_by(places.len().div_ceil(100).max(1)).collect();
    let pairs = places.iter().enumerate().flat_map(|(i, a)| places[..i].iter().map(move |b| distance(a, b)));
    median(pairs).unwrap_or(0.0)
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// What is wrong with a lens, if anything is.
fn lens_fault(camera: &Camera) -> Option<String> {
    let side = f64::from(camera.size[0].max(camera.size[1]));
    let [low, high] = FOCAL_LENGTHS;
    let focal = camera.focal.map(f64::from);
    let away =
        (0..2).map(|i| (f64::from(camera.principal[i]) - f64::from(camera.size[i]) / 2.0).abs()).fold(0.0, f64::max);
    let bent = camera.distortion.iter().map(|k| f64::from(k.abs())).fold(0.0, f64::max);
    let of_side = |pixels: f64| format!("{:.3e} times the picture's longer side", pixels / side);
    if let Some(focal) = focal.into_iter().find(|f| !(low * side..=high * side).contains(f)) {
        Some(format!("its focal length is {}", of_side(focal)))
    } else if away > FARTHEST_PRINCIPAL * side {
        Some(format!("its principal point lies {} off the centre", of_side(away)))
    } else {
        (bent > LARGEST_DISTORTION).then(|| format!("a coefficient of its lens is {bent:.3e}"))
    }
}

/// Looks the points through every train camera.
pub(super) fn look(scene: &Scene, report: &mut Report) {
    let every = scene.points.len().div_ceil(POINTS).max(1);
    let points: Vec<[f64; 3]> = scene.points.iter().step_by(every).map(|p| p.position.map(f64::from)).collect();
    let shown: Vec<Shown> = scene.train.par_iter().map(|view| shown(&view.camera, &points)).collect();
    let all = points.len().max(1) as f64;
    let share = |count: usize| count as f64 / all;
    let inside = |shown: &Shown| shown.inside.iter().filter(|inside| **inside).count();
    for (figures, shown) in report.views.iter_mut().zip(&shown) {
        figures.points_in_front = Some(share(shown.in_front));
        figures.points_in_picture = Some(share(inside(shown)));
    }
    let check = "poses";
    let faulty: Vec<(&str, String)> =
        scene.train.iter().filter_map(|view| Some((view.name.as_str(), lens_fault(&view.camera)?))).collect();
    if let Some((name, fault)) = faulty.first() {
        let message = format!("{fault} ({} of {} views): no camera has such a lens", faulty.len(), scene.train.len());
        report.add(Severity::Problem, check, Some(name), message);
    }
    let centers: Vec<[f64; 3]> = scene.train.iter().map(|view| view.camera.center()).collect();
    let between = centers.iter().take(100).flat_map(|c| points.iter().step_by(97).map(move |p| distance(c, p)));
    let depth = median(between).unwrap_or(0.0);
    if points.len() > 1 && spread(&points) <= LEAST_SPREAD * depth {
        let message = "all points stand at one place: the model is not of these photographs, or was exported wrongly";
        report.add(Severity::Problem, check, None, message);
    }
    if centers.len() > 1 && spread(&centers) <= LEAST_SPREAD * depth {
        let message =
            "all cameras stand at one place: nothing tells how far away things are; photograph from several places";
        report.add(Severity::Problem, check, None, message);
    }
    let needed = scene.train.len().min(2);
    let seen =
        (0..points.len()).filter(|i| shown.iter().filter(|shown| shown.inside[*i]).take(needed).count() == needed);
    let seen = share(seen.count());
    if seen < LEAST_SEEN {
        let front = shown.iter().map(|shown| share(shown.in_front)).sum::<f64>() / shown.len().max(1) as f64;
        let message = format!(
            "{:.1} % of the points are in the picture of {needed} cameras or more ({:.0} % lie before a camera, on the mean), where \
             nearly all should be: poses, lenses and points do not belong together",
            100.0 * seen,
            100.0 * front
        );
        report.add(Severity::Problem, check, None, message);
        return;
    }
    let extents = shown.iter().filter(|shown| inside(shown) > 0).map(|shown| shown.extent);
    if let Some(extent) = median(extents).filter(|extent| points.len() > 1 && *extent < LEAST_EXTENT) {
        let message = format!(
            "the points fill {:.2} % of a picture's side: cameras and points are not in the same unit, or not of one place",
            100.0 * extent
        );
        report.add(Severity::Problem, check, None, message);
    }
    let of = |i: usize| (scene.train[i].name.as_str(), share(inside(&shown[i])));
    let empty: Vec<&str> = (0..shown.len()).map(of).filter(|(_, share)| *share <= 0.0).map(|(name, _)| name).collect();
    if let Some(first) = empty.first() {
        let message = format!(
            "{} of {} photographs have no point in the picture (first: {first}): their cameras are registered wrongly",
            empty.len(),
            shown.len()
        );
        report.add(Severity::Problem, check, None, message);
    }
    let few = (0..shown.len()).map(of).filter(|(_, share)| *share > 0.0 && *share < FEW_POINTS);
    let few: Vec<(&str, f64)> = few.collect();
    if let Some((name, least)) = few.iter().min_by(|a, b| a.1.total_cmp(&b.1)) {
        let message = format!(
            "{} of {} photographs have less than {:.0} % of the points in the picture (fewest: {name}, {:.2} %): they show a place \
             of their own, or are registered wrongly",
            few.len(),
            shown.len(),
            100.0 * FEW_POINTS,
            100.0 * least
        );
        report.add(Severity::Note, check, None, message);
    }
}

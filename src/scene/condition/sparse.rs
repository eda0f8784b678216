//! Priors held against the points of the sparse model.
//!
//! A monocular map is known up to a scale and a shift, of the depth or of its inverse. The points tell both, roughly but
//! without bias, so that a map of another kind, of another picture or of nothing at all shows before training.

use rayon::prelude::*;

use crate::scene::priors::rank_correlation;
use crate::scene::{Camera, Notes, Point, Prior, PriorKind, RELATED, Reference, Scene, View};
use crate::statistics::{deviation, quantile};

/// Fewest points that tell whether a prior fits.
const FEWEST: usize = 24;
/// Farthest depth that a disparity is turned into, over the depth that 98 % of the points stay below: disparities of the
/// sky are zero or less.
const FARTHEST: f64 = 2.0;

/// A point seen by a view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    /// Row-major pixel.
    pub pixel: usize,
    /// Depth z of the point.
    pub depth: f64,
}

/// The points that a view sees: of those that fall into one block of pixels the one of median depth. The nearest would lie
/// before the surface: by 3 % of the depth on spin-1. Blocks are a 64th of the picture's width, at least 2 pixels wide. With
/// `outside`, only those outside the mask.
pub(crate) fn samples(camera: &Camera, points: &[Point], outside: Option<&image::GrayImage>) -> Vec<Sample> {
    let [w, h] = camera.size.map(|n| n as usize);
    let block = (w / 64).max(2);
    let columns = w.div_ceil(block);
    let mut blocks: Vec<Vec<Sample>> = vec![vec![]; columns * h.div_ceil(block)];
    for point in points {
        let position = point.position.map(f64::from);
        let Some(pixel) = camera.pixel_of(position) else { continue };
        if outside.is_none_or(|mask| mask.as_raw()[pixel] == 0) {
            let found = Sample { pixel, depth: camera.to_camera(position)[2] };
            blocks[pixel / w / block * columns + pixel % w / block].push(found);
        }
    }
    let median = |block: &mut Vec<Sample>| {
        let middle = block.len().checked_sub(1)? / 2;
        let order = |a: &Sample, b: &Sample| a.depth.total_cmp(&b.depth).then(a.pixel.cmp(&b.pixel));
        Some(*block.select_nth_unstable_by(middle, order).1)
    };
    blocks.iter_mut().filter_map(median).collect()
}

/// `y ~ slope x + shift` with small influence of outliers: least absolute deviations by reweighting, then Tukey's biweight
/// at 4.7 standard deviations, as the median absolute residual tells them (Huber and Ronchetti 2009, chapter 7). `None`
/// where all x are one.
pub(super) fn robust_line(x: &[f64], y: &[f64]) -> Option<[f64; 2]> {
    let line = |weight: &[f64]| -> Option<[f64; 2]> {
        let n: f64 = weight.iter().sum();
        let mean = |v: &[f64]| v.iter().zip(weight).map(|(v, w)| v * w).sum::<f64>() / n;
        let (mx, my) = (mean(x), mean(y));
        let (mut xx, mut xy) = (0.0, 0.0);
        for ((x, y), w) in x.iter().zip(y).zip(weight) {
            xx += w * (x - mx).powi(2);
            xy += w * (x - mx) * (y - my);
        }
        // Rounding alone leaves this much of the mean's square.
        (xx > 1e-20 * n * mx * mx && xx > 0.0).then(|| [xy / xx, my - xy / xx * mx])
    };
    let mut weight = vec![1.0; x.len()];
    let mut fit = line(&weight)?;
    for round in 0..40 {
        let residuals: Vec<f64> = x.iter().zip(y).map(|(x, y)| (y - fit[0] * x - fit[1]).abs()).collect();
        let scale = deviation(residuals.iter().copied())?;
        if scale == 0.0 {
            break;
        }
        for (w, r) in weight.iter_mut().zip(&residuals) {
            *w = if round < 25 {
                1.0 / r.max(0.05 * scale)
            } else {
                (1.0 - (r / (4.685 * scale)).powi(2)).max(0.0).powi(2)
            };
        }
        fit = line(&weight)?;
    }
    Some(fit)
}

/// What a prior's values are, in the scene's depth: `depth = slope p + shift`, or `1 / depth = ...` for disparity.
pub(super) fn fit(prior: &Prior, samples: &[Sample]) -> Option<[f64; 2]> {
    let (x, y): (Vec<f64>, Vec<f64>) = samples
        .iter()
        .map(|s| (f64::from(prior.values[s.pixel]), s))
        .filter(|(p, _)| p.is_finite())
        .map(|(p, s)| (p, if prior.kind == PriorKind::Disparity { 1.0 / s.depth } else { s.depth }))
        .unzip();
    if x.len() < FEWEST { None } else { robust_line(&x, &y) }
}

/// Whether a prior follows the points it should rise with; `None` where too few tell.
fn follows(prior: &Prior, samples: &[Sample]) -> Option<f64> {
    let samples: Vec<&Sample> = samples.iter().filter(|s| prior.values[s.pixel].is_finite()).collect();
    if samples.len() < FEWEST {
        return None;
    }
    let depth: Vec<f32> = samples.iter().map(|s| s.depth as f32).collect();
    let values: Vec<f32> = samples.iter().map(|s| prior.values[s.pixel]).collect();
    let sign = if prior.kind == PriorKind::Disparity { -1.0 } else { 1.0 };
    rank_correlation(&depth, &values, |_| true).map(|r| sign * r)
}

/// A disparity as the depth it means, far values brought to [`FARTHEST`]; where the prior is not a number it stays so.
fn to_depth(prior: &Prior, [slope, shift]: [f64; 2], samples: &[Sample]) -> Prior {
    let farthest = FARTHEST * quantile(samples.iter().map(|s| s.depth), 0.98).expect("a prior is fitted to samples");
    let depth = |p: f32| {
        let inverse = slope * f64::from(p) + shift;
        if p.is_finite() { (1.0 / inverse.max(1.0 / farthest)) as f32 } else { f32::NAN }
    };
    Prior { kind: PriorKind::Depth, values: prior.values.iter().map(|p| depth(*p)).collect() }
}

/// What becomes of a prior.
enum Verdict {
    /// It stays: it is depth, or nothing tells.
    Kept,
    /// Its rank correlation with the points is too low.
    Refused(f64),
    /// Disparity turned into depth.
    Converted(Prior),
}

fn judge(prior: &Prior, samples: &[Sample]) -> Verdict {
    match follows(prior, samples) {
        None => Verdict::Kept,
        Some(r) if r < RELATED => Verdict::Refused(r),
        Some(_) if prior.kind == PriorKind::Depth => Verdict::Kept,
        Some(_) => match fit(prior, samples) {
            Some(line) if line[0] > 0.0 => Verdict::Converted(to_depth(prior, line, samples)),
            _ => Verdict::Kept,
        },
    }
}

/// Takes away the priors that do not follow the points, and turns disparity into depth: the depth losses then compare
/// depth with depth, in which pixels that nothing covers yet are not infinitely far off.
pub(super) fn check_priors(scene: &mut Scene) {
    let points = std::mem::take(&mut scene.points);
    let judged = |view: &View, prior: Option<&Prior>| {
        prior.map(|prior| judge(prior, &samples(&view.camera, &points, view.mask.as_ref())))
    };
    let verdicts: Vec<Option<Verdict>> = scene.train.par_iter().map(|view| judged(view, view.prior.as_ref())).collect();
    let of_reference = |r: &Reference| judged(&scene.train[r.view], r.prior.as_ref());
    let of_references: Vec<Option<Verdict>> = scene.references.iter().map(of_reference).collect();
    scene.points = points;
    let mut converted = 0;
    let mut apply = |name: &str, what: &str, verdict: Verdict, prior: &mut Option<Prior>, notes: &mut Notes| {
        match verdict {
            Verdict::Kept => {}
            Verdict::Converted(depth) => {
                converted += 1;
                *prior = Some(depth);
            }
            Verdict::Refused(r) => {
                let kind = prior.as_ref().map_or("prior", |p| p.kind.folder());
                notes.push(format!(
                    "{what}{name}: its {kind} prior does not follow the points of the model (rank correlation {r:.2}) and \
                     is not used; is it of another kind or of another picture?"
                ));
                *prior = None;
            }
        }
    };
    for (view, verdict) in scene.train.iter_mut().zip(verdicts) {
        if let Some(verdict) = verdict {
            apply(&view.name, "", verdict, &mut view.prior, &mut scene.notes);
        }
    }
    for (reference, verdict) in scene.references.iter_mut().zip(of_references) {
        if let Some(verdict) = verdict {
            let name = &scene.train[reference.view].name;
            apply(name, "reference ", verdict, &mut reference.prior, &mut scene.notes);
        }
    }
    if converted > 0 {
        scene.notes.push(format!("{converted} disparity priors are turned into depth by the points of the model"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load, synthetic};

    /// A hedge: the points of a block lie at many depths, and a prior says where the middle is.
    #[test]
    fn samples_of_a_thick_surface_lie_in_its_middle() {
        use rand::{RngExt as _, SeedableRng as _};

        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [500.0; 2],
            principal: [320.0, 240.0],
            size: [640, 480],
            distortion: [0.0; 4],
        };
        let mut rng = rand_pcg::Pcg64::seed_from_u64(4);
        let point = |_| {
            let pixel = rng.random_range(0..640 * 480);
            let z = 10.0 * rng.random_range(0.95..1.05);
            let position = camera.lift(camera.pixel_center(pixel), z).expect("ahead").map(|v| v as f32);
            Point { position, color: [0; 3] }
        };
        let points: Vec<Point> = (0..60_000).map(point).collect();
        let samples = samples(&camera, &points, None);
        let mean = samples.iter().map(|s| s.depth).sum::<f64>() / samples.len() as f64;
        // Some twenty points of a block are 5 % of the depth's range apart. Of an even number the nearer of the two in the
        // middle is taken: half that is 2.5 % of a range of 1, for every second block.
        assert!((mean / 10.0 - 1.0).abs() < 2e-3, "{mean} instead of 10");
    }

    #[test]
    fn lines_withstand_outliers() {
        let x: Vec<f64> = (0..400).map(|i| f64::from(i) * 0.01).collect();
        let mut y: Vec<f64> =
            x.iter().enumerate().map(|(i, x)| 3.0 * x - 1.0 + 0.01 * ((i * 37 % 19) as f64 - 9.0)).collect();
        // A fifth of them, all to one side.
        y.iter_mut().step_by(5).for_each(|y| *y += 40.0);
        let [slope, shift] = robust_line(&x, &y).expect("x varies");
        // The noise of 0.05 over 320 values on [0, 4]: 0.0025 of the slope, twice over.
        assert!((slope - 3.0).abs() < 0.005 && (shift + 1.0).abs() < 0.01, "{slope} {shift}");
        assert_eq!(robust_line(&[2.0; 30], &[1.0; 30]), None);
        assert_eq!(robust_line(&[1.0, 2.0, 3.0], &[5.0, 5.0, 5.0]), Some([0.0, 5.0]));
    }

    #[test]
    fn priors_of_another_kind_are_named_and_not_used_and_disparity_becomes_depth() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
        let mut scene = load(&dir, &Config::default()).expect("it loads");
        let depth = scene.train[2].prior.clone().expect("a prior");
        // The fit turns this back into the scene's depth: the same up to scale and shift.
        let z: Vec<f32> = {
            let samples = samples(&scene.train[2].camera, &scene.points, scene.train[2].mask.as_ref());
            let [slope, shift] = fit(&depth, &samples).expect("points");
            depth.values.iter().map(|p| (slope * f64::from(*p) + shift) as f32).collect()
        };
        let disparity = |z: &f32| 250.0 / z + 11.0;
        scene.train[2].prior = Some(Prior { kind: PriorKind::Disparity, values: z.iter().map(disparity).collect() });
        // Upside down.
        let inverted = scene.train[3].prior.as_mut().expect("a prior");
        inverted.values.iter_mut().for_each(|v| *v = -*v);
        scene.train[4].prior.as_mut().expect("a prior").values.fill(7.0);
        let before = scene.notes.len();
        check_priors(&mut scene);
        assert!(scene.train[3].prior.is_none());
        let notes = scene.notes[before..].iter().map(|note| &**note).collect::<Vec<&str>>().join("\n");
        let name = &scene.train[3].name;
        assert!(notes.contains(&format!("{name}: its depth prior does not follow the points")), "{notes}");
        assert!(notes.contains("1 disparity priors are turned into depth"), "{notes}");
        assert!(scene.train[5].prior.is_some());
        let converted = scene.train[2].prior.as_ref().expect("a prior");
        assert_eq!(converted.kind, PriorKind::Depth);
        let mut errors: Vec<f64> = converted.values.iter().zip(&z).map(|(a, b)| f64::from((a - b) / b).abs()).collect();
        errors.sort_by(f64::total_cmp);
        // The prior's own noise of half a per cent, and as much of the points.
        assert!(errors[errors.len() / 2] < 0.01, "{}", errors[errors.len() / 2]);
    }
}

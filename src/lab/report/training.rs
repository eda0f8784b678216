//! Whole training runs: figures on held-out views against seconds and steps.
//!
//! Every choice trains with the same seeds on the same scene. Figures are taken at given steps with the clock stopped: a
//! step's seconds are those of training alone. All choices are compared with the same held-out photographs at the same
//! size, whatever size they train at.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{Error, Omitted};
use crate::config::Settings;
use crate::evaluate;
use crate::gpu::Gpu;
use crate::lab::pace::Pace;
use crate::lab::pareto;
use crate::lab::statistics::{Moments, Paired};
use crate::lab::variants::Variant;
use crate::render::view::Rendered;
use crate::scene::{Scene, View};
use crate::train::run::{Observer, Progress, Run};

/// How much is measured.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Figures taken in each run, the last one at its end.
    pub samples: u32,
    /// How their steps lie.
    pub spacing: Spacing,
    /// Runs of each choice, with seeds one after the other.
    pub seeds: u32,
}

/// How the sampled steps lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Spacing {
    /// Each a constant factor behind the one before.
    Log,
    /// At equal distances.
    Linear,
}

/// Figures of a model on the held-out views, means over views, and what it took.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Sample {
    /// Steps taken.
    pub step: u32,
    /// Seconds of training.
    pub seconds: f64,
    /// Colour loss: `(1 - w) L1 + w (1 - SSIM)` with the settings' `losses.ssim_weight` as w, on the whole picture.
    pub loss: f64,
    /// PSNR in dB.
    pub psnr: f64,
    /// PSNR inside the mask, where a held-out view has one.
    pub masked_psnr: Option<f64>,
    /// SSIM.
    pub ssim: f64,
    /// Anchors.
    pub anchors: u32,
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub struct SeedRun {
    /// `train.seed`.
    pub seed: u64,
    /// In the order of steps.
    pub samples: Vec<Sample>,
}

/// A point of a choice's curve: means over the seeds, and their extremes.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Point {
    /// Means.
    pub mean: Sample,
    /// Fewest and most seconds.
    pub seconds_range: [f64; 2],
    /// Smallest and largest PSNR.
    pub psnr_range: [f64; 2],
    /// Smallest and largest PSNR inside the mask.
    pub masked_psnr_range: Option<[f64; 2]>,
    /// Smallest and largest loss.
    pub loss_range: [f64; 2],
    /// On the Pareto front of PSNR against seconds over all choices.
    pub psnr_front: bool,
    /// On that of the PSNR inside the mask.
    pub masked_psnr_front: bool,
    /// On that of the loss.
    pub loss_front: bool,
}

/// A choice.
#[derive(Clone, Debug, Serialize)]
pub struct VariantRuns {
    /// Its name.
    pub name: String,
    /// What it sets.
    pub changes: Vec<String>,
    /// One per seed.
    pub runs: Vec<SeedRun>,
    /// Over the seeds, by sample.
    pub points: Vec<Point>,
    /// A choice whose end is in nothing worse, the time that it took included, and in something better, by more than the
    /// seeds differ. With one seed nothing is known of that, and none is named.
    pub dominated_by: Option<String>,
}

/// The measurements of training.
#[derive(Clone, Debug, Serialize)]
pub struct Training {
    /// Steps of a run.
    pub iterations: u32,
    /// Steps at which figures were taken.
    pub steps: Vec<u32>,
    /// Held-out views.
    pub test_views: usize,
    /// What was measured; the first is the settings as they are.
    pub variants: Vec<VariantRuns>,
    /// What was not.
    pub omitted: Vec<Omitted>,
    /// Each choice at its end, over the seeds.
    pub ends: Vec<End>,
    /// Every later choice less every earlier one at their ends, over the same seeds; empty for one seed.
    pub differences: Vec<Difference>,
}

/// A choice's last figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct End {
    /// The choice.
    pub variant: String,
    /// By name: mean and standard deviation.
    pub figures: BTreeMap<&'static str, Moments>,
}

/// How two choices differ at their ends.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// What is subtracted.
    pub from: String,
    /// From what.
    pub to: String,
    /// By name: by a paired t-test.
    pub figures: BTreeMap<&'static str, Paired>,
}

/// A figure of a sample, where it has it.
type Figure = fn(&Sample) -> Option<f64>;

/// Figures of an end, of one value per seed each.
const FIGURES: [(&str, Figure); 5] = [
    ("psnr", |s| Some(s.psnr)),
    ("masked_psnr", |s| s.masked_psnr),
    ("ssim", |s| Some(s.ssim)),
    ("loss", |s| Some(s.loss)),
    ("seconds", |s| Some(s.seconds)),
];

/// The last samples of a choice, seed by seed.
fn last(variant: &VariantRuns, figure: Figure) -> Option<Vec<f64>> {
    variant.runs.iter().map(|run| run.samples.last().and_then(figure)).collect()
}

/// Means and deviations of the choices' last figures.
fn ends(variants: &[VariantRuns]) -> Vec<End> {
    let end = |v: &VariantRuns| {
        let of = |(name, figure): &(&'static str, _)| Some((*name, Moments::of(&last(v, *figure)?)?));
        End { variant: v.name.clone(), figures: FIGURES.iter().filter_map(of).collect() }
    };
    variants.iter().map(end).collect()
}

/// Of every pair of choices.
fn differences(variants: &[VariantRuns]) -> Vec<Difference> {
    let difference = |from: &VariantRuns, to: &VariantRuns| {
        let of = |(name, figure): &(&'static str, _)| {
            let (a, b) = (last(from, *figure)?, last(to, *figure)?);
            Some((*name, Paired::of(&a, &b)?))
        };
        let figures = FIGURES.iter().filter_map(of).collect();
        Difference { from: from.name.clone(), to: to.name.clone(), figures }
    };
    let pairs = (0..variants.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    pairs.map(|(i, j)| difference(&variants[i], &variants[j])).filter(|d| !d.figures.is_empty()).collect()
}

/// Steps at which figures are taken: distinct, ascending, the last is `iterations`.
pub fn steps(iterations: u32, options: Options) -> Vec<u32> {
    let samples = options.samples.clamp(1, iterations);
    let share = |i: u32| match options.spacing {
        Spacing::Linear => f64::from(i) / f64::from(samples),
        // From a hundredth of the run, or its first step, on.
        Spacing::Log => {
            let first = (1.0 / f64::from(iterations)).max(0.01);
            first.powf(1.0 - f64::from(i) / f64::from(samples))
        }
    };
    let mut steps: Vec<u32> =
        (1..=samples).map(|i| ((share(i) * f64::from(iterations)).round() as u32).clamp(1, iterations)).collect();
    steps.dedup();
    steps
}

/// Trains every choice on `scene`, which was read with the first one's settings; `read` reads it with others.
///
/// # Errors
/// Without test views; what `read` and the runs meet.
pub fn measure<E: From<Error>>(
    gpu: &Gpu,
    scene: &Scene,
    variants: Vec<Variant>,
    options: Options,
    read: impl Fn(&Settings) -> Result<Scene, E>,
    say: &mut dyn FnMut(&str),
) -> Result<Training, E> {
    if scene.test.is_empty() {
        return Err(Error::NoTestViews.into());
    }
    let (variants, omitted) = super::distinct(scene, variants);
    let base = variants[0].settings.clone();
    let iterations = base.train.iterations;
    let steps = steps(iterations, options);
    let mut measured = vec![];
    let pace = Pace::new(variants.len() * options.seeds as usize);
    let mut done = 0;
    for Variant { name, changes, settings } in variants {
        let other = if settings.scene == base.scene { None } else { Some(read(&settings)?) };
        let other = other.map(|other| Scene { test: scene.test.clone(), ..other });
        let scene = other.as_ref().unwrap_or(scene);
        let mut settings = settings;
        settings.train.eval_interval = 0;
        compile(gpu, scene, &settings)?;
        let mut runs = vec![];
        for seed in (base.train.seed..).take(options.seeds as usize) {
            settings.train.seed = seed;
            let which = if options.seeds > 1 { format!("{name}, seed {seed}") } else { name.clone() };
            let steps = steps.iter().copied().filter(|step| *step <= settings.train.iterations).collect();
            say(format!("training: \"{which}\", {} steps {}", settings.train.iterations, pace.next(done)).trim_end());
            let samples = train(gpu, scene, &settings, steps, say)?;
            done += 1;
            runs.push(SeedRun { seed, samples });
        }
        measured.push(VariantRuns { name, changes, points: points(&runs), runs, dominated_by: None });
    }
    judge(&mut measured);
    let (ends, differences) = (ends(&measured), differences(&measured));
    Ok(Training { iterations, steps, test_views: scene.test.len(), variants: measured, omitted, ends, differences })
}

/// Compiles the kernels of a run before its clock starts: a few steps in which everything happens that ever does.
fn compile(gpu: &Gpu, scene: &Scene, settings: &Settings) -> Result<(), Error> {
    let mut settings = settings.clone();
    settings.train.iterations = settings.train.iterations.min(3);
    settings.model.attention.start = settings.model.attention.start.min(1);
    let densify = &mut settings.densify;
    if densify.enabled && densify.from < u32::MAX {
        (densify.statistics_from, densify.from, densify.every) = (1, 2, 1);
        densify.until = densify.until.max(2);
    }
    let scene = Scene { test: vec![], ..scene.clone() };
    let folder = tempfile::tempdir().map_err(Error::Temporary)?;
    Run::new(gpu, &scene, &settings)?.train(folder.path(), &mut crate::train::run::Silent)?;
    Ok(())
}

fn train(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    steps: Vec<u32>,
    say: &mut dyn FnMut(&str),
) -> Result<Vec<Sample>, Error> {
    let folder = tempfile::tempdir().map_err(Error::Temporary)?;
    let mut watch = Watch {
        views: &scene.test,
        ssim_weight: settings.losses.ssim_weight,
        steps,
        absolute: vec![],
        samples: vec![],
        say,
    };
    Run::new(gpu, scene, settings)?.train(folder.path(), &mut watch)?;
    Ok(watch.samples)
}

/// Takes figures at the sampled steps.
struct Watch<'a> {
    views: &'a [View],
    ssim_weight: f64,
    steps: Vec<u32>,
    /// Mean absolute difference of each view of the evaluation under way.
    absolute: Vec<f64>,
    samples: Vec<Sample>,
    say: &'a mut dyn FnMut(&str),
}

impl Observer for Watch<'_> {
    fn samples(&self) -> Vec<u32> {
        self.steps.clone()
    }

    fn compared(&mut self, view: usize, picture: &Rendered) {
        let (rendered, truth) = (picture.to_rgb8(), &self.views[view].image);
        let sum: u64 = rendered.as_raw().iter().zip(truth.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        self.absolute.push(sum as f64 / (255.0 * truth.as_raw().len() as f64));
    }

    fn evaluated(&mut self, progress: &Progress, report: &evaluate::Report) {
        let absolute = std::mem::take(&mut self.absolute);
        let Some(mean) = report.mean.as_ref().map(|mean| &mean.metrics) else { return };
        let l1 = absolute.iter().sum::<f64>() / absolute.len() as f64;
        let sample = Sample {
            step: progress.step,
            seconds: progress.seconds,
            loss: (1.0 - self.ssim_weight) * l1 + self.ssim_weight * (1.0 - mean.full.ssim),
            psnr: mean.full.psnr,
            masked_psnr: mean.mask.map(|mask| mask.psnr),
            ssim: mean.full.ssim,
            anchors: progress.anchors,
        };
        let masked = sample.masked_psnr.map_or(String::new(), |psnr| format!(", masked {psnr:.2} dB"));
        let Sample { step, seconds, loss, psnr, .. } = sample;
        (self.say)(&format!("  step {step}, {seconds:.1} s: PSNR {psnr:.2} dB{masked}, loss {loss:.4}"));
        self.samples.push(sample);
    }
}

/// Means and extremes over the seeds, sample by sample.
fn points(runs: &[SeedRun]) -> Vec<Point> {
    let samples = runs.iter().map(|run| run.samples.len()).min().unwrap_or(0);
    let point = |i: usize| {
        let all: Vec<Sample> = runs.iter().map(|run| run.samples[i]).collect();
        let mean = |value: &dyn Fn(&Sample) -> f64| all.iter().map(value).sum::<f64>() / all.len() as f64;
        let range = |value: &dyn Fn(&Sample) -> f64| {
            let extreme = |start: f64, pick: fn(f64, f64) -> f64| all.iter().map(value).fold(start, pick);
            [extreme(f64::INFINITY, f64::min), extreme(f64::NEG_INFINITY, f64::max)]
        };
        let masked = |sample: &Sample| sample.masked_psnr.unwrap_or(f64::NAN);
        let has_mask = all.iter().all(|sample| sample.masked_psnr.is_some());
        Point {
            mean: Sample {
                step: all[0].step,
                seconds: mean(&|s| s.seconds),
                loss: mean(&|s| s.loss),
                psnr: mean(&|s| s.psnr),
                masked_psnr: has_mask.then(|| mean(&masked)),
                ssim: mean(&|s| s.ssim),
                anchors: mean(&|s| f64::from(s.anchors)).round() as u32,
            },
            seconds_range: range(&|s| s.seconds),
            psnr_range: range(&|s| s.psnr),
            masked_psnr_range: has_mask.then(|| range(&masked)),
            loss_range: range(&|s| s.loss),
            psnr_front: false,
            masked_psnr_front: false,
            loss_front: false,
        }
    };
    (0..samples).map(point).collect()
}

/// Marks the fronts over all samples, and the choices whose end another one's makes superfluous.
fn judge(variants: &mut [VariantRuns]) {
    let front = |variants: &[VariantRuns], gain: &dyn Fn(&Sample) -> f64| {
        let points: Vec<(f64, f64)> =
            variants.iter().flat_map(|v| &v.points).map(|p| (p.mean.seconds, gain(&p.mean))).collect();
        pareto::front(&points)
    };
    let psnr = front(variants, &|s| s.psnr);
    let masked = front(variants, &|s| s.masked_psnr.unwrap_or(f64::NAN));
    let loss = front(variants, &|s| -s.loss);
    let marks = psnr.into_iter().zip(masked).zip(loss);
    for (point, ((psnr, masked), loss)) in variants.iter_mut().flat_map(|v| &mut v.points).zip(marks) {
        (point.psnr_front, point.masked_psnr_front, point.loss_front) = (psnr, masked, loss);
    }
    let ends: Vec<Option<Point>> =
        variants.iter().map(|v| v.points.last().filter(|_| v.runs.len() > 1).copied()).collect();
    let names: Vec<String> = variants.iter().map(|v| v.name.clone()).collect();
    let superfluous = |b: &Point| ends.iter().flatten().position(|a| beats(a, b));
    let judged: Vec<usize> = (0..ends.len()).filter(|i| ends[*i].is_some()).collect();
    let by: Vec<Option<usize>> = ends.iter().map(|end| end.as_ref().and_then(superfluous)).collect();
    for (variant, by) in variants.iter_mut().zip(by) {
        variant.dominated_by = by.map(|by| names[judged[by]].clone());
    }
}

/// Ranges that overlap count as equal.
fn beats(a: &Point, b: &Point) -> bool {
    let negated = |[low, high]: [f64; 2]| [-high, -low];
    let masked = |p: &Point| p.masked_psnr_range.unwrap_or([0.0, 0.0]);
    // As more is better: the ranges of a and of b.
    let figures = [
        (a.psnr_range, b.psnr_range),
        (masked(a), masked(b)),
        (negated(a.loss_range), negated(b.loss_range)),
        (negated(a.seconds_range), negated(b.seconds_range)),
    ];
    let worse = figures.iter().any(|([_, high], [low, _])| high < low);
    let better = figures.iter().any(|([low, _], [_, high])| low > high);
    !worse && better
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(samples: u32, spacing: Spacing) -> Options {
        Options { samples, spacing, seeds: 1 }
    }

    #[test]
    fn sampled_steps() {
        assert_eq!(steps(100, options(4, Spacing::Linear)), [25, 50, 75, 100]);
        assert_eq!(steps(800, options(4, Spacing::Log)), [25, 80, 253, 800]);
        for (iterations, samples) in [(1, 5), (3, 12), (50, 50), (30_000, 12)] {
            for spacing in [Spacing::Log, Spacing::Linear] {
                let steps = steps(iterations, options(samples, spacing));
                assert_eq!(steps.last(), Some(&iterations));
                assert!(steps.windows(2).all(|pair| pair[0] < pair[1]) && steps[0] > 0, "{steps:?}");
            }
        }
    }

    fn variant(name: &str, seconds: [f64; 2], psnr: &[f64]) -> VariantRuns {
        let sample = |(psnr, seconds): (&f64, f64)| Sample {
            step: 10,
            seconds,
            loss: 1.0 / psnr,
            psnr: *psnr,
            masked_psnr: None,
            ssim: 0.5,
            anchors: 7,
        };
        let runs: Vec<SeedRun> = (psnr.iter().zip(seconds))
            .zip(0..)
            .map(|(figures, seed)| SeedRun { seed, samples: vec![sample(figures)] })
            .collect();
        VariantRuns { name: name.into(), changes: vec![], points: points(&runs), runs, dominated_by: None }
    }

    #[test]
    fn ends_are_compared_seed_by_seed() {
        let variants = [variant("a", [1.0, 1.0], &[20.0, 30.0]), variant("b", [1.0, 2.0], &[21.0, 33.0])];
        let (ends, differences) = (ends(&variants), differences(&variants));
        assert_eq!(ends[1].figures["psnr"], Moments::of(&[21.0, 33.0]).expect("two seeds"));
        assert!(!ends[1].figures.contains_key("masked_psnr"), "there is no mask");
        assert_eq!((differences.len(), differences[0].from.as_str(), differences[0].to.as_str()), (1, "a", "b"));
        assert_eq!(differences[0].figures["psnr"], Paired::of(&[0.0, 0.0], &[1.0, 3.0]).expect("two seeds"));
        assert!(super::differences(&[variant("a", [1.0, 1.0], &[20.0]), variant("b", [1.0, 1.0], &[20.0])]).is_empty());
    }

    #[test]
    fn ends_are_judged_by_figures_and_time() {
        let mut variants = [
            variant("a", [10.0, 10.5], &[20.0, 21.0]),
            variant("slower", [11.0, 11.5], &[20.5, 21.5]),
            variant("worse", [10.2, 10.8], &[18.0, 19.0]),
            variant("alike", [10.2, 10.8], &[20.5, 21.5]),
            variant("better", [12.0, 12.5], &[22.0, 22.5]),
        ];
        judge(&mut variants);
        let by: Vec<Option<&str>> = variants.iter().map(|v| v.dominated_by.as_deref()).collect();
        assert_eq!(by, [None, Some("a"), Some("a"), None, None]);
        let front: Vec<bool> = variants.iter().map(|v| v.points[0].psnr_front).collect();
        assert_eq!(front, [true, false, false, true, true]);
        assert!(variants.iter().all(|v| !v.points[0].masked_psnr_front));
        assert_eq!((variants[0].points[0].mean.psnr, variants[0].points[0].psnr_range), (20.5, [20.0, 21.0]));
        let mut alone = [variant("a", [10.0, 0.0], &[20.0]), variant("b", [11.0, 0.0], &[19.0])];
        judge(&mut alone);
        assert!(alone.iter().all(|v| v.dominated_by.is_none()), "one seed says nothing");
    }
}

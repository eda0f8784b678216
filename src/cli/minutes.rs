//! A training that ends when the time is over.
//!
//! How many steps fit is not known before: a step takes longer as anchors grow, and as other programs take the machine. So
//! a few steps are timed for a first schedule, and the schedule is corrected while the training runs, every
//! [`CHECKS`]th of the time. The corrections are part of the settings ([`crate::train::Config::corrections`]), so that the
//! run can be repeated to the byte.

use std::time::Instant;

use anyhow::ensure;

use crate::config::Settings;
use crate::gpu::Gpu;
use crate::scene::Scene;
use crate::train::run::{Progress, Run};

/// Steps that are timed at each size of the pictures, behind as many that only make room and compile.
const TIMED: u32 = 5;
/// A step of the whole run takes so much longer than one of the first: Gaussians become more. Between 1.2 and 1.5 was seen
/// with the presets.
const GROWTH: f64 = 1.35;
/// Checks of the clock in the course of a run, and steps between two of them at least.
const CHECKS: f64 = 40.0;
const STEPS_BETWEEN: u32 = 10;
/// A correction by less than this part of the rest is not worth a line.
const SLIGHT: f64 = 0.02;
/// The rest is made longer or shorter by this factor at most at a time: one slow moment is not the machine's pace.
const AT_MOST: f64 = 2.0;
/// How a step's time goes with the number of anchors: its exponent. A part of a step goes with the pixels alone.
const BY_ANCHORS: f64 = 0.7;
/// Time of a view drawn for its figures at the end, in training steps: forward alone, and its comparison.
const DRAWN: f64 = 0.6;
/// Seconds for what is written at the end.
const WRITTEN: f64 = 1.0;

/// The work behind the training, which has to end within the same time.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Reserve {
    /// Time in training steps on pictures of the full size.
    pub steps: f64,
    /// Seconds besides.
    pub seconds: f64,
    /// Seconds that training has, however late it is: what was made before it is not in vain.
    pub training: f64,
}

/// The time that a training has, and where it is in it. All times are seconds since the program began.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    began: Instant,
    /// When all is to be over.
    end: f64,
    /// Time of a step on pictures of the full size over one on the first, smaller ones.
    full_over_coarse: f64,
    /// Views drawn after the last step.
    drawn: f64,
    /// Anchors at the first step.
    first_anchors: Option<u32>,
    /// When the last check was, and behind which step.
    checked: Option<(f64, u32)>,
}

impl Clock {
    fn new(began: Instant, end: f64, full_over_coarse: f64, drawn: usize) -> Self {
        Self { began, end, full_over_coarse, drawn: drawn as f64, first_anchors: None, checked: None }
    }

    /// Seconds since the program began.
    pub fn now(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    /// Whether it is time to look at the clock.
    pub fn is_due(&mut self, now: f64, last: &Progress) -> bool {
        let Some((checked, step)) = self.checked else {
            self.first_anchors = Some(last.anchors).filter(|_| last.step > 0);
            // The first step also makes what is made once.
            self.checked = (last.step > 0).then_some((now, last.step));
            return false;
        };
        last.step >= step + STEPS_BETWEEN && now - checked >= self.end / CHECKS
    }

    /// The last step that the time is enough for, where it is another than that of the settings.
    pub fn correction(&mut self, now: f64, last: &Progress, settings: &Settings) -> Option<u32> {
        let (checked, step) = self.checked.replace((now, last.step))?;
        let pace = (now - checked) / f64::from((last.step - step).max(1));
        let (done, iterations) = (last.step, settings.train.iterations);
        let rest = f64::from(iterations - done);
        let coarse = f64::from(settings.train.coarse.until.saturating_sub(done)) / rest.max(1.0);
        let (size, at_end) = if coarse > 0.0 {
            (coarse + (1.0 - coarse) * self.full_over_coarse, self.full_over_coarse)
        } else {
            (1.0, 1.0)
        };
        let (mean, most) = growth(self.first_anchors.unwrap_or(last.anchors), last, settings);
        let after = DRAWN * self.drawn * pace * at_end * most + WRITTEN;
        let fit = (self.end - after - now).max(0.0) / (pace * size * mean);
        let fit = fit.clamp(rest / AT_MOST, rest * AT_MOST).round().max(1.0);
        ((fit - rest).abs() > SLIGHT * rest).then_some(done + fit as u32)
    }
}

/// Rounds of growing behind the steps up to `step`.
fn rounds(settings: &Settings, step: u32) -> f64 {
    let config = &settings.densify;
    let last = step.min(config.until).min(settings.train.iterations - 1);
    let first = config.from.max(1).next_multiple_of(config.every);
    if config.enabled && last >= first { f64::from((last - first) / config.every + 1) } else { 0.0 }
}

/// What growing makes of a step's time: on the mean over the rest of the run, and at its end. Rounds grow as
/// [`crate::train::forecast::expected_anchors`] has it, by as much as they did so far.
fn growth(first: u32, last: &Progress, settings: &Settings) -> (f64, f64) {
    let (done, all) = (rounds(settings, last.step), rounds(settings, settings.train.iterations));
    if all <= 0.0 || done >= all {
        return (1.0, 1.0);
    }
    if done < 1.0 {
        return (GROWTH, GROWTH);
    }
    let share = |rounds: f64| rounds / (rounds + 8.0);
    let anchors = f64::from(last.anchors.max(1));
    let grown = (anchors - f64::from(first)).max(0.0);
    let end = anchors + grown * (share(all) / share(done) - 1.0);
    // Growing ends before the run does, and more comes of the first rounds.
    let mean = anchors + 0.75 * (end - anchors);
    ((mean / anchors).powf(BY_ANCHORS), (end / anchors).powf(BY_ANCHORS))
}

/// The settings for a training that ends about `minutes` after `began`, and the clock that corrects them: their schedule
/// fitted to as many steps as this device takes in that time. Where the settings have smaller pictures first, these keep
/// their share of the steps. `reserve` of the time is left.
///
/// # Errors
/// When the device has no room; when the time is over before training begins.
pub(super) fn fitted(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    minutes: f64,
    began: Instant,
    reserve: Reserve,
) -> anyhow::Result<(Settings, Clock)> {
    let coarse = f64::from(settings.train.coarse.until) / f64::from(settings.train.iterations);
    let mut probe = settings.clone();
    probe.train.coarse.until = if coarse > 0.0 { 2 * TIMED } else { 0 };
    let mut run = Run::new(gpu, scene, &probe)?;
    let mut timed = |first: u32| -> anyhow::Result<f64> {
        for step in first..first + TIMED {
            run.run_one(step)?;
        }
        let start = Instant::now();
        for step in first + TIMED..first + 2 * TIMED {
            run.run_one(step)?;
        }
        Ok(start.elapsed().as_secs_f64() / f64::from(TIMED))
    };
    let first = timed(1)?;
    let full = if coarse > 0.0 { timed(1 + 2 * TIMED)? } else { first };
    drop(run);
    let mean = step_time([first, full], coarse);
    // All views are drawn for what they show of the hole, and the test views once more for their figures.
    let drawn = if scene.test.is_empty() { 0 } else { scene.train.len() + 2 * scene.test.len() };
    let kept = reserve.steps * full * GROWTH + reserve.seconds;
    let after = DRAWN * drawn as f64 * full * GROWTH + WRITTEN + kept;
    let gone = began.elapsed().as_secs_f64();
    let (steps, over) = shared(60.0 * minutes - gone - after, reserve.training, mean);
    ensure!(
        steps >= FEWEST,
        "--minutes {minutes}: {:.1} min are the least here, of which {:.1} have gone before training: give more time, or \
         --downscale the pictures",
        least(gone + after + f64::from(FEWEST) * mean),
        gone / 60.0,
    );
    let files = if kept > 0.0 { format!(", and {:.1} are kept for the files", kept / 60.0) } else { String::new() };
    let fit = if over > 0.0 {
        format!(
            "fit into the {:.1} min that training has all the same, {:.1} beyond {minutes} min",
            reserve.training / 60.0,
            over / 60.0
        )
    } else {
        format!("fit into what is left of {minutes} min")
    };
    eprintln!(
        "minutes: {:.1} min have gone{files}: {steps} steps of about {:.0} ms {fit}; corrected while they run",
        gone / 60.0,
        1e3 * mean
    );
    Ok((settings.rescheduled(steps), Clock::new(began, 60.0 * minutes + over - kept, full / first, drawn)))
}

/// Steps that fit into the seconds that are `left`, or into those that training has all the same, and the seconds beyond.
fn shared(left: f64, training: f64, step: f64) -> (u32, f64) {
    let over = (training - left).max(0.0);
    (((left + over).max(0.0) / step) as u32, over)
}

/// Seconds as minutes that are enough for them, in tenths.
pub(super) fn least(seconds: f64) -> f64 {
    (seconds / 6.0).ceil() / 10.0
}

/// The time of a step over the whole run, from those measured before anchors grew: of small pictures, which have the share
/// `coarse` of the steps, and of full ones.
fn step_time([small, full]: [f64; 2], coarse: f64) -> f64 {
    GROWTH * (coarse * small + (1.0 - coarse) * full)
}

/// Fewest steps of a training worth the name.
const FEWEST: u32 = 30;

#[cfg(test)]
mod tests {
    use super::*;

    /// Trains by a clock of its own: `slow` makes a step of a time since the beginning take longer. Returns when all was
    /// over, and the settings at the end.
    fn trained(end: f64, first_steps: u32, cost: f64, slow: impl Fn(f64) -> f64) -> (f64, Settings) {
        let preset = crate::config::Source::Preset("lavapipe".into());
        let preset = Settings::resolve(&[preset]).expect("a preset");
        let mut settings = preset.rescheduled(first_steps);
        let mut clock = Clock::new(Instant::now(), end, 2.5, 30);
        let (mut now, mut step) = (8.0, 0);
        let mut anchors = 10_000.0;
        while step < settings.train.iterations {
            let last = Progress { step, anchors: anchors as u32, ..Progress::default() };
            if clock.is_due(now, &last)
                && let Some(iterations) = clock.correction(now, &last, &settings)
            {
                settings = settings.corrected(step, iterations);
            }
            step += 1;
            let size = if step <= settings.train.coarse.until { 1.0 } else { 2.5 };
            // As on a scene where anchors grow fivefold.
            now += cost * size * (anchors / 10_000.0f64).powf(0.8) * slow(now);
            if rounds(&settings, step) > rounds(&settings, step - 1) {
                let share = |r: f64| r / (r + 8.0);
                let all = share(rounds(&settings, settings.train.iterations));
                anchors = 10_000.0 * (1.0 + 4.0 * share(rounds(&settings, step)) / all);
            }
        }
        let full = cost * 2.5 * 5f64.powf(0.8) * slow(now);
        (now + 0.4 * 30.0 * full + 1.0, settings)
    }

    /// Training has its share where the parts before it took longer than all the time, and ends later by so much.
    #[test]
    fn what_is_late_is_not_in_vain() {
        assert_eq!(shared(100.0, 24.0, 0.5), (200, 0.0));
        assert_eq!(shared(4.0, 24.0, 0.5), (48, 20.0));
        assert_eq!(shared(-20.0, 24.0, 0.5), (48, 44.0));
        assert_eq!(shared(-20.0, 0.0, 0.5), (0, 20.0), "a training alone is refused");
    }

    /// Anchors grow, so that steps become slower, and of the growing the clock learns only later.
    #[test]
    fn steps_become_slower_than_the_first_ones() {
        for coarse in [0.0, 0.4, 1.0] {
            let measured = coarse * 0.05 + (1.0 - coarse) * 0.2;
            let expected = step_time([0.05, 0.2], coarse);
            assert!(expected > measured && expected < 2.0 * measured, "{expected} for {measured}");
        }
    }

    #[test]
    fn the_time_is_kept_whatever_the_machine_does() {
        type Slow = fn(f64) -> f64;
        let machines: [(&str, Slow); 5] = [
            ("alone", |_| 1.0),
            ("others beside it", |_| 2.5),
            ("others from the middle on", |now| if now > 150.0 { 2.5 } else { 1.0 }),
            ("others up to the middle", |now| if now < 150.0 { 2.5 } else { 1.0 }),
            ("now and then", |now| if ((now / 20.0) as u32).is_multiple_of(2) { 2.0 } else { 1.0 }),
        ];
        for (what, slow) in machines {
            for steps in [1_000, 3_000, 9_000] {
                let (over, settings) = trained(300.0, steps, 0.025, slow);
                assert!((over / 300.0 - 1.0).abs() < 0.1, "{what}, {steps} steps at first: {over:.0} s of 300");
                let densify = &settings.densify;
                assert!(densify.until < settings.train.iterations && densify.from < densify.until, "{what}");
            }
        }
    }
}

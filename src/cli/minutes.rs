//! As many steps as fit into a given time.

use std::time::{Duration, Instant};

use anyhow::ensure;

use crate::config::Settings;
use crate::gpu::Gpu;
use crate::scene::Scene;
use crate::train::run::Run;

/// Steps that are timed at each size of the pictures, behind as many that only make room and compile.
const TIMED: u32 = 5;
/// Part of the steps that smaller pictures take where the settings do not say.
const COARSE: f64 = 0.4;
/// A step of the whole run takes so much longer than one of the first: Gaussians become more. Between 1.2 and 1.5 was seen
/// with the presets.
const GROWTH: f64 = 1.35;

/// The settings for a training that ends about `minutes` after `began`: their schedule fitted to as many steps as this
/// device takes in that time, the first of them on smaller pictures. The steps are counted before training, so that a
/// seed and the settings written down still make the same bytes.
///
/// # Errors
/// When the device has no room; when the time is over before training begins.
pub(super) fn fitted(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    minutes: f64,
    began: Instant,
) -> anyhow::Result<Settings> {
    let mut settings = settings.clone();
    let iterations = settings.train.iterations;
    if settings.train.coarse.until == 0 {
        settings.train.coarse.until = (COARSE * f64::from(iterations)) as u32;
    }
    let coarse = settings.train.coarse.until.min(iterations);
    let mut probe = settings.clone();
    // Nothing that begins late is timed as if it ran from the start, and nothing is left out either: steps of both sizes
    // are those behind the end of the smaller pictures and before it.
    probe.train.coarse.until = TIMED * 2;
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
    let (small, full) = (timed(1)?, timed(1 + 2 * TIMED)?);
    drop(run);
    let share = f64::from(coarse) / f64::from(iterations);
    let mean = GROWTH * (share * small + (1.0 - share) * full);
    let left = Duration::from_secs_f64(60.0 * minutes).saturating_sub(began.elapsed()).as_secs_f64();
    let steps = (left / mean) as u32;
    ensure!(
        steps >= FEWEST,
        "--minutes {minutes}: {:.0} s are left when training begins and a step takes about {mean:.2} s, which is too few \
         steps: give more time, or --downscale the pictures",
        left
    );
    eprintln!(
        "minutes: {steps} steps of about {:.0} ms fit into what is left of {minutes} min (--iterations {steps}), the first \
         {:.0} % on smaller pictures",
        1e3 * mean,
        100.0 * share
    );
    Ok(settings.rescheduled(steps))
}

/// Fewest steps of a training worth the name.
const FEWEST: u32 = 30;

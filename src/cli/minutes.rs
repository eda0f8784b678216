//! As many steps as fit into a given time.

use std::time::{Duration, Instant};

use anyhow::ensure;

use crate::config::Settings;
use crate::gpu::Gpu;
use crate::scene::Scene;
use crate::train::run::Run;

/// Steps that are timed at each size of the pictures, behind as many that only make room and compile.
const TIMED: u32 = 5;
/// A step of the whole run takes so much longer than one of the first: Gaussians become more. Between 1.2 and 1.5 was seen
/// with the presets.
const GROWTH: f64 = 1.35;

/// The settings for a training that ends about `minutes` after `began`: their schedule fitted to as many steps as this
/// device takes in that time. The steps are counted before training, so that a seed and the settings written down still
/// make the same bytes. Where the settings have smaller pictures first, these keep their share of the steps.
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
    let mean = GROWTH * (coarse * first + (1.0 - coarse) * full);
    let left = Duration::from_secs_f64(60.0 * minutes).saturating_sub(began.elapsed()).as_secs_f64();
    let steps = (left / mean) as u32;
    ensure!(
        steps >= FEWEST,
        "--minutes {minutes}: {left:.0} s are left when training begins and a step takes about {mean:.2} s, which is too \
         few steps: give more time, or --downscale the pictures",
    );
    eprintln!(
        "minutes: {steps} steps of about {:.0} ms fit into what is left of {minutes} min (--iterations {steps})",
        1e3 * mean
    );
    Ok(settings.rescheduled(steps))
}

/// Fewest steps of a training worth the name.
const FEWEST: u32 = 30;

//! How far from the floor every pass is.
//!
//! [`ceilings`] measures what the device gives at most; [`cost`] says what every pass has to do, from the numbers that
//! [`counts`] reads back from a traced step; [`step`] times the step beside it. [`loads`] generates scenes of chosen sizes
//! and fits how every pass grows; [`tune`] runs the choices that exist as data. [`compare`] sets one record against
//! another, [`text`] and [`tables`] write them down.

pub mod ceilings;
pub mod compare;
pub mod cost;
pub mod counts;
pub mod step;
pub mod tables;
pub mod text;

use serde::{Deserialize, Serialize};

use crate::config::Settings;
use crate::gpu::{DeviceInfo, Gpu};
use crate::report::kernels::{Bench, Warm, choose_views};
use crate::report::variants::Variant;
use crate::report::{Error, SceneFacts};
use crate::scene::Scene;
use crate::train::photographs;
use crate::train::plan::Plan;

/// The device that was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Device {
    /// Name as the driver gives it.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `cpu` or `other`.
    pub kind: String,
    /// Driver name and version in its own words.
    pub driver: String,
    /// Threads of a subgroup.
    pub subgroup_size: u32,
    /// Bytes one storage binding holds.
    pub max_binding_bytes: u64,
}

impl From<&DeviceInfo> for Device {
    fn from(info: &DeviceInfo) -> Self {
        Self {
            name: info.name.clone(),
            kind: info.kind.to_owned(),
            driver: info.driver.clone(),
            subgroup_size: info.subgroup_size,
            max_binding_bytes: info.max_binding_bytes,
        }
    }
}

/// Everything that was measured, and what produced it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Version of the program.
    pub version: String,
    /// The command line.
    pub command: String,
    /// The device and its driver.
    pub device: Device,
    /// Every setting, as JSON: a value that is not finite is null.
    pub settings: serde_json::Value,
    /// The scene; absent for generated loads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<SceneFacts>,
    /// Steps trained before.
    pub warm_up: u32,
    /// What the device gives at most.
    pub ceilings: ceilings::Ceilings,
    /// A step on the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<step::StepFigures>,
}

impl Record {
    /// As JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain numbers and strings") + "\n"
    }
}

/// How much is measured of a scene.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Steps trained before.
    pub warm_up: u32,
    /// The number that the measured step counts as; nothing: [`usual_step`].
    pub step: Option<u32>,
    /// Views, the reference view among them if there is one.
    pub views: usize,
    /// Timed rounds.
    pub repetitions: usize,
}

/// The first step behind the warm-up that has attention, if the plan has it, and does not search everything for values
/// that are not finite, as most do not.
pub fn usual_step(plan: &Plan, settings: &Settings, warm_up: u32) -> u32 {
    let attention = if plan.attention { settings.model.attention.start } else { 0 };
    let step = attention.max(warm_up + 1).max(1);
    let interval = settings.train.sentinel_interval;
    step + u32::from(interval > 1 && step.is_multiple_of(interval))
}

/// Refuses a device that cannot be timed.
///
/// # Errors
/// [`Error::NoTimestamps`].
pub fn ensure_timestamps(gpu: &Gpu) -> Result<(), Error> {
    if gpu.info().timestamp_period > 0.0 {
        return Ok(());
    }
    Err(Error::NoTimestamps { device: gpu.info().name.clone() })
}

/// Trains the scene for the warm-up, with growing and pruning as set, and measures a step of what is there then.
///
/// # Errors
/// When the device has no room, or no timestamps.
pub fn scene(
    gpu: &Gpu,
    scene: &Scene,
    settings: &Settings,
    ceilings: &ceilings::Ceilings,
    options: Options,
    say: &mut dyn FnMut(&str),
) -> Result<step::StepFigures, Error> {
    ensure_timestamps(gpu)?;
    say(&format!("bench: {} steps of warm-up", options.warm_up));
    let warm = Warm::train(gpu, scene, settings, options.warm_up)?;
    let plan = Plan::new(scene, settings);
    let number = options.step.unwrap_or_else(|| usual_step(&plan, settings, options.warm_up));
    let subset = choose_views(scene, options.views);
    let photographs = std::rc::Rc::new(photographs::upload(gpu, &subset, &plan, 1)?);
    let variant = Variant { name: String::new(), changes: vec![], settings: settings.clone() };
    let mut bench = Bench::new(gpu, scene, &variant, plan, photographs, &warm, number)?;
    say(&format!("bench: step {number}, {} rounds", options.repetitions));
    step::measure(gpu, &mut bench, settings, ceilings, options.repetitions)
}

#[cfg(test)]
mod tests;

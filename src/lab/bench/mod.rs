//! How far from the floor every pass is.
//!
//! [`ceilings`] measures what the device gives at most; [`cost`] says what every pass has to do, from the numbers that
//! [`counts`] reads back from a traced step; [`step`] times the step beside it. [`predict`] says what the step would take
//! by a GPU's published peaks. [`compare`] sets one record against another, [`text`],
//! [`tables`] and [`figures`] write them down.
//!
#![doc = include_str!("README.md")]

pub mod ceilings;
pub mod compare;
pub mod cost;
pub mod counts;
pub mod figures;
pub mod predict;
pub mod step;
pub mod tables;
pub mod text;

use std::rc::Rc;

use serde::{Deserialize, Serialize};

use crate::config::Settings;
use crate::gpu::{DeviceInfo, Gpu};
use crate::lab::report::kernels::{Bench, Warm, choose_views};
use crate::lab::report::{Error, SceneFacts};
use crate::lab::variants::Variant;
use crate::scene::Scene;
use crate::train::photographs;
use crate::train::plan::Plan;

/// Digits behind the point so that three or four count.
fn digits(value: f64) -> String {
    match value.abs() {
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 10.0 => format!("{value:.1}"),
        v if v >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

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
    /// The scene.
    pub scene: SceneFacts,
    /// Steps trained before.
    pub warm_up: u32,
    /// What the device gives at most.
    pub ceilings: ceilings::Ceilings,
    /// A step on the scene.
    pub step: step::StepFigures,
    /// The step on devices that are not at hand.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub predictions: Vec<predict::Prediction>,
}

impl Record {
    /// As JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain numbers and strings") + "\n"
    }
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

/// A scene and the model behind the warm-up.
pub struct Trained<'a> {
    scene: &'a Scene,
    subset: Scene,
    warm: Warm,
    number: u32,
}

impl<'a> Trained<'a> {
    /// Trains the scene for so many steps, with growing and pruning as set. `number` is what the measured step counts as,
    /// on so many views.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn new(
        gpu: &Gpu,
        scene: &'a Scene,
        settings: &Settings,
        warm_up: u32,
        (number, views): (u32, usize),
        say: &mut dyn FnMut(&str),
    ) -> Result<Self, Error> {
        say(&format!("bench: {warm_up} steps of warm-up"));
        let warm = Warm::train(gpu, scene, settings, warm_up)?;
        Ok(Self { scene, subset: choose_views(scene, views), warm, number })
    }

    /// Measures the step in so many rounds, each with one of the device's ceilings.
    ///
    /// # Errors
    /// When the device has no room, or no timestamps.
    pub fn measure(
        &self,
        gpu: &Gpu,
        settings: &Settings,
        prober: &mut ceilings::Prober<'_>,
        repetitions: usize,
        say: &mut dyn FnMut(&str),
    ) -> Result<step::StepFigures, Error> {
        ensure_timestamps(gpu)?;
        let plan = Plan::new(self.scene, settings);
        let reduction = settings.train.coarse.reduction(self.number);
        let photographs = Rc::new(photographs::upload(gpu, &self.subset, &plan, reduction)?);
        let variant = Variant { name: String::new(), changes: vec![], settings: settings.clone() };
        let mut bench = Bench::new(gpu, self.scene, &variant, plan, photographs, &self.warm, self.number)?;
        say(&format!("bench: step {}, {repetitions} rounds", self.number));
        let mut ceilings = || {
            prober.round()?;
            Ok(prober.ceilings())
        };
        step::measure(gpu, &mut bench, settings, &mut ceilings, repetitions)
    }
}

#[cfg(test)]
mod tests;

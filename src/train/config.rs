use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// The training loop: how long, in which order, what is written when.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Training steps, one view each (GScream: 30,000).
    pub iterations: u32,
    /// Seed of every random choice: initial weights, view order, patches, growing.
    pub seed: u64,
    /// How the next view is drawn.
    pub view_order: ViewOrder,
    /// Share of the steps that see the reference view, evenly spread; 0 visits it as often as any other view (GScream).
    /// What only it shows is trained in its steps alone.
    pub reference_share: f64,
    /// Steps between two lines of the JSON log.
    pub log_interval: u32,
    /// Steps between two saves of the model, each in place of the one before and evaluated on the test views; 0 saves and
    /// evaluates only at the end.
    pub eval_interval: u32,
    /// Steps between two checkpoints, of which the last two are kept; 0 writes one only when a run ends early. A run
    /// that has ended well keeps none.
    pub checkpoint_interval: u32,
    /// Steps between two searches of all gradients, parameters and moments for values that are not finite. The losses and
    /// the networks' gradients are searched in every step. 0 searches nothing: a broken model trains on.
    pub sentinel_interval: u32,
    /// `[step, iterations]`: behind that step the rest of the schedule was fitted to so many steps in all. Written by
    /// `train --minutes` while it runs; with them the same settings repeat the run to the byte.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub corrections: Vec<[u32; 2]>,
    /// Smaller pictures first.
    pub coarse: Coarse,
}

/// Smaller pictures first: the first steps train on the training pictures at half their size, reduced as
/// `scene.downscale` reduces them. Which steps those are depends on the step alone, so that a resumed run goes on as it
/// would have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Coarse {
    /// Last step on reduced pictures; 0 trains on pictures of the full training size from the beginning.
    pub until: u32,
}

impl Coarse {
    /// By how much the pictures of `step` (counted from 1) are reduced: 1 is the full training size.
    pub fn reduction(&self, step: u32) -> u32 {
        if step <= self.until { 2 } else { 1 }
    }
}

/// How the next training view is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ViewOrder {
    /// Without replacement: every view once, in an order shuffled anew for each round (3DGS, Scaffold-GS, GScream).
    Shuffled,
    /// Sorted by name, again and again: for comparing two programs step by step.
    Sequential,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            iterations: 30_000,
            seed: 0,
            view_order: ViewOrder::Shuffled,
            reference_share: 0.18,
            log_interval: 100,
            eval_interval: 5_000,
            checkpoint_interval: 2_500,
            sentinel_interval: 50,
            corrections: vec![],
            coarse: Coarse::default(),
        }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(self.iterations > 0, "iterations", self.iterations, "must be at least 1")?;
        ensure(
            i64::try_from(self.seed).is_ok(),
            "seed",
            self.seed,
            "must be below 2^63, the largest integer a TOML file holds",
        )?;
        let share = self.reference_share;
        ensure((0.0..=0.9).contains(&share), "reference_share", share, "must be between 0 and 0.9")?;
        let ascending = self.corrections.windows(2).all(|two| two[0][0] < two[1][0]);
        ensure(
            ascending && self.corrections.iter().all(|[step, iterations]| step < iterations),
            "corrections",
            format_args!("{:?}", self.corrections),
            "must be pairs of a step and a later last step, in the order of the steps",
        )?;
        ensure(self.log_interval > 0, "log_interval", self.log_interval, "must be at least 1")
    }
}

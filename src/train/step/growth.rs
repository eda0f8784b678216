//! Growing and pruning behind a step.

use super::Step;
use crate::densify::Round;
use crate::gpu::Error;
use crate::stage;

impl Step {
    /// Whether the model's rows change behind this step.
    pub fn changes_anchors(&self, step: u32) -> bool {
        self.plan.rounds.is_some_and(|r| r.contain(step)) && step.is_multiple_of(self.config.densify.every)
    }

    /// Grows and prunes anchors, or moves and adds plain Gaussians, behind this step, with nothing in flight; says what
    /// changed, if anything has.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<String, Error> {
        if self.statistics.is_none() && self.plan.counted.is_some() {
            return Ok(String::new());
        }
        self.release();
        let Self { gpu, config, learnt, statistics, voxel, capacity, .. } = self;
        let round = Round { voxel: *voxel as f32, seed: config.train.seed, step };
        let text = gpu.stage(stage::GROWTH, || learnt.grow(gpu, &config.densify, round, statistics.as_mut()))?;
        // As large a share of the rows is in view as before.
        let [visible, old, new] = [capacity.visible, capacity.anchors, learnt.capacity()].map(u64::from);
        capacity.visible = (visible * new).div_ceil(old.max(1)).max(visible).min(new.max(1)) as u32;
        self.furnish()?;
        Ok(text)
    }
}

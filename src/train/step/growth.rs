//! Growing and pruning behind a step.

use super::Step;
use crate::densify::{self, split};
use crate::gpu::Error;
use crate::model::learnt::Learnt;
use crate::render::forward;
use crate::stage;

impl Step {
    /// Whether anchors are grown and pruned behind this step.
    pub fn changes_anchors(&self, step: u32) -> bool {
        self.plan.rounds.is_some_and(|r| r.contain(step)) && step.is_multiple_of(self.config.densify.every)
    }

    /// Grows and prunes anchors, or moves and adds plain Gaussians, behind this step, with nothing in flight; says what
    /// changed.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<String, Error> {
        if self.statistics.is_none() && matches!(self.learnt, Learnt::Anchors { .. }) {
            return Ok(String::new());
        }
        self.release();
        let gpu = self.gpu.clone();
        let text = gpu.stage(stage::GROWTH, || self.grow_and_prune(step))?;
        self.furnish()?;
        Ok(text)
    }

    fn grow_and_prune(&mut self, step: u32) -> Result<String, Error> {
        let anchors = match &mut self.learnt {
            Learnt::Anchors { anchors, .. } => anchors,
            Learnt::Gaussians(gaussians) => {
                let before = gaussians.count;
                let round = split::Round { seed: self.config.train.seed, step };
                let moved = split::run(&self.gpu, gaussians, &self.config.densify, round)?;
                let now = gaussians.count;
                return Ok(format!(
                    "step {step}: {moved} faded Gaussians are halves of others, {} new: {before} -> {now}",
                    now - before
                ));
            }
        };
        let Some(statistics) = &mut self.statistics else { return Ok(String::new()) };
        let most = forward::most_anchors(&self.gpu, anchors.offsets);
        let asked = self.config.densify.max_anchors;
        let max_anchors = if asked == 0 { most } else { asked.min(most) };
        let config = &densify::Config { max_anchors, ..self.config.densify.clone() };
        let round = densify::Round { voxel: self.voxel as f32, seed: self.config.train.seed, step };
        let before = anchors.count;
        let grown = densify::grow::run(&self.gpu, anchors, statistics, config, round)?;
        let pruned = densify::prune::run(&self.gpu, anchors, statistics, config)?;
        // As large a share of the anchors is in view as before.
        let [visible, old, new] = [self.capacity.visible, self.capacity.anchors, anchors.capacity].map(u64::from);
        self.capacity.visible = (visible * new).div_ceil(old.max(1)).max(visible).min(new.max(1)) as u32;
        let mut text =
            format!("step {step}: {} new anchors, {pruned} pruned: {before} -> {}", grown.added, anchors.count);
        if grown.refused > 0 {
            text.push_str(&format!(
                "; {} more had no room (densify.max_anchors, or the device's memory)",
                grown.refused
            ));
        }
        if grown.beyond > 0 {
            text.push_str(&format!(
                "; {} Gaussians lie more than {:.0e} cells from the origin, where none grows: move the scene or raise model.voxel",
                grown.beyond,
                densify::grow::CELL_LIMIT
            ));
        }
        Ok(text)
    }
}

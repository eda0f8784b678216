//! Growing and pruning behind a step.

use super::Step;
use crate::config::Settings;
use crate::densify::{self, Statistics, split};
use crate::gpu::{Error, Gpu};
use crate::model::anchors::Decoded;
use crate::model::gaussians::Static;
use crate::render::forward::{self, Representation};
use crate::stage;

/// A representation that a training changes the rows of.
pub trait Growing: Representation {
    /// A round behind this step, by what the steps since the last one have counted; says what changed. `voxel` is the side of
    /// the anchors' grid.
    ///
    /// # Errors
    /// When the device has no room.
    fn round(
        &mut self,
        gpu: &Gpu,
        settings: &Settings,
        counted: Option<&mut Statistics>,
        voxel: f64,
        step: u32,
    ) -> Result<String, Error>;

    /// Counts so many rows as in use, as far as the room for those of all rounds is there from the first step on: for
    /// rehearsals.
    fn swell(&mut self, _rows: u32) {}
}

impl Growing for Static {
    fn round(
        &mut self,
        gpu: &Gpu,
        settings: &Settings,
        _: Option<&mut Statistics>,
        _voxel: f64,
        step: u32,
    ) -> Result<String, Error> {
        let before = self.count;
        let moved = split::run(gpu, self, &settings.densify, split::Round { seed: settings.train.seed, step })?;
        let (now, new) = (self.count, self.count - before);
        Ok(format!("step {step}: {moved} faded Gaussians are halves of others, {new} new: {before} -> {now}"))
    }

    fn swell(&mut self, rows: u32) {
        self.count = rows.clamp(self.count, self.capacity);
    }
}

impl Growing for Decoded {
    fn round(
        &mut self,
        gpu: &Gpu,
        settings: &Settings,
        counted: Option<&mut Statistics>,
        voxel: f64,
        step: u32,
    ) -> Result<String, Error> {
        let (Self { anchors, .. }, Some(statistics)) = (self, counted) else { return Ok(String::new()) };
        let most = forward::most_anchors(gpu, anchors.offsets);
        let asked = settings.densify.max_anchors;
        let max_anchors = if asked == 0 { most } else { asked.min(most) };
        let config = &densify::Config { max_anchors, ..settings.densify.clone() };
        let round = densify::Round { voxel: voxel as f32, seed: settings.train.seed, step };
        let before = anchors.count;
        let grown = densify::grow::run(gpu, anchors, statistics, config, round)?;
        let pruned = densify::prune::run(gpu, anchors, statistics, config)?;
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

impl Step {
    /// Whether the model's rows change behind this step.
    pub fn changes_anchors(&self, step: u32) -> bool {
        self.plan.rounds.is_some_and(|r| r.contain(step)) && step.is_multiple_of(self.config.densify.every)
    }

    /// Grows and prunes anchors, or moves and adds plain Gaussians, behind this step, with nothing in flight; says what
    /// changed.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<String, Error> {
        if self.statistics.is_none() && self.learnt.anchors().is_some() {
            return Ok(String::new());
        }
        self.release();
        let Self { gpu, config, learnt, statistics, voxel, capacity, .. } = self;
        let text = gpu.stage(stage::GROWTH, || learnt.round(gpu, config, statistics.as_mut(), *voxel, step))?;
        // As large a share of the rows is in view as before.
        let [visible, old, new] = [capacity.visible, capacity.anchors, learnt.capacity()].map(u64::from);
        capacity.visible = (visible * new).div_ceil(old.max(1)).max(visible).min(new.max(1)) as u32;
        self.furnish()?;
        Ok(text)
    }
}

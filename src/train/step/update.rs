//! The end of a step: the search for values that are not finite, and the optimiser.

use std::ops::Range;

use super::{Rates, Step};
use crate::gpu::{Buffer, Recorder};
use crate::model::parameter::Parameter;
use crate::optimizer::Group;
use crate::optimizer::adam::{self, Tensors};
use crate::primitives::finite;
use crate::stage;
use crate::train::attend::Attended;

impl Step {
    /// Looks for values that are not finite in the first `count` of a tensor that every step looks at: the losses and the
    /// networks' gradients, into which every Gaussian's gradients are summed. Each comes where passes wait anyway.
    pub(super) fn sentinel(&self, rec: &mut Recorder<'_>, tensor: Option<&Buffer<f32>>, count: u32) {
        if self.config.train.sentinel_interval == 0 {
            return;
        }
        if let Some(tensor) = tensor {
            rec.stage(stage::SENTINEL);
            finite::record(rec, tensor, count, self.limits.overflow(), None);
        }
    }

    /// The rest of what every step looks at, the attention's gradients, and in every `sentinel_interval`-th step all
    /// gradients, parameters and moments.
    pub(super) fn watch(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32) {
        let interval = self.config.train.sentinel_interval;
        if interval == 0 {
            return;
        }
        rec.stage(stage::SENTINEL);
        let flag = self.limits.overflow();
        if let Some((attend, attended)) = self.attend.as_ref().zip(attended) {
            finite::record(rec, attend.grad_weights(), attend.weights.width, flag, Some(attended.tokens()));
        }
        if !step.is_multiple_of(interval) {
            return;
        }
        for parameter in self.learnt.rows() {
            for tensor in parameter.tensors().into_iter().chain(&parameter.gradient) {
                finite::record(rec, tensor, self.learnt.count() * parameter.width, flag, None);
            }
        }
        // The networks' gradients were looked at already.
        for parameter in self.networks() {
            for tensor in parameter.tensors() {
                finite::record(rec, tensor, parameter.width, flag, None);
            }
        }
    }

    pub(super) fn optimize(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32, rates: Rates) {
        let overflow = self.limits.overflow();
        // Before the optimiser, which goes on from the features that were decoded.
        let attention = self.attend.as_ref().zip(attended);
        let attention =
            attention.map(|(attend, attended)| (attend, attend.write_back(rec, attended, self.anchors(), overflow)));
        rec.stage(stage::OPTIMIZER);
        // What the release writes back it does not train any further.
        let config = &self.config.model.attention;
        let written_back = config.write_back && self.plan.attention && step >= config.start;
        let trained = |parameter: &&Parameter| !written_back || parameter.groups().all(|g| g != Group::Feature);
        let rows = self.config.model.frozen..self.learnt.count();
        for parameter in self.learnt.rows().into_iter().filter(trained) {
            self.update(rec, parameter, rows.clone(), overflow, (step, rates));
        }
        if let Some(weights) = self.learnt.weights() {
            self.update(rec, weights, 0..1, overflow, (step, rates));
        }
        if let Some((attend, skip)) = attention {
            let since = step + 1 - config.start.max(1);
            self.update(rec, &attend.weights, 0..1, skip, (since, rates));
        }
    }

    /// Records Adam's step `step` on these rows of a parameter, if it is trained; skipped on the device where `skip` is set.
    fn update(
        &self,
        rec: &mut Recorder<'_>,
        parameter: &Parameter,
        rows: Range<u32>,
        skip: &Buffer<u32>,
        (step, rates): (u32, Rates),
    ) {
        let Some((gradient, rates)) = parameter.gradient.as_ref().zip(rates.of_parts(parameter)) else { return };
        let range = (rows.start * parameter.width, rows.len() as u32 * parameter.width);
        let tensors = Tensors { value: &parameter.value, gradient, first: &parameter.first, root: &parameter.root };
        adam::record(rec, &self.adam, tensors, skip, range, (step, rates));
    }
}

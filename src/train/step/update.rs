//! The end of a step: the search for values that are not finite, and the optimiser.

use super::{Rates, Step};
use crate::gpu::{Buffer, Recorder};
use crate::math::decoder::Layout;
use crate::model::anchors::Parameter;
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
        let Self { anchors, weights, .. } = self;
        let gradients = &self.stages().gradients;
        let interval = self.config.train.sentinel_interval;
        if interval == 0 {
            return;
        }
        rec.stage(stage::SENTINEL);
        let flag = self.limits.overflow();
        let network = Layout { offsets: anchors.offsets as usize }.weights() as u32;
        let attention = self.attend.as_ref().zip(attended);
        if let Some((attend, attended)) = attention {
            finite::record(rec, &attend.grad_weights, attend.weights.width, flag, Some(attended.tokens()));
        }
        if !step.is_multiple_of(interval) {
            return;
        }
        let of_anchors = [&gradients.feature, &gradients.offset, &gradients.log_scaling];
        for (parameter, gradient) in anchors.parameters().into_iter().zip(of_anchors) {
            for tensor in parameter.tensors().into_iter().chain(gradient) {
                finite::record(rec, tensor, anchors.count * parameter.width, flag, None);
            }
        }
        for tensor in weights.tensors() {
            finite::record(rec, tensor, network, flag, None);
        }
        for tensor in self.attend.iter().flat_map(|attend| attend.weights.tensors()) {
            finite::record(rec, tensor, crate::math::attention::WEIGHTS as u32, flag, None);
        }
    }

    pub(super) fn optimize(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32, rates: Rates) {
        let Self { anchors, weights, .. } = self;
        let gradients = &self.stages().gradients;
        let overflow = self.limits.overflow();
        // Before the optimiser, which goes on from the features that were decoded.
        let attention = self.attend.as_ref().zip(attended);
        let attention =
            attention.map(|(attend, attended)| (attend, attend.write_back(rec, attended, anchors, overflow)));
        rec.stage(stage::OPTIMIZER);
        let mut update = |parameter: &Parameter, gradient: Option<&Buffer<f32>>, count: u32, rates: adam::Rates| {
            let Some(gradient) = gradient.filter(|_| rates.rate != [0.0; 3]) else { return };
            let tensors = Tensors { value: &parameter.value, gradient, first: &parameter.first, root: &parameter.root };
            // Networks have a gradient in every step.
            let adam = adam::Config { lazy: self.config.optimizer.lazy, ..self.adam };
            adam::record(rec, &adam, tensors, overflow, (0, count), (step, rates));
        };
        // What the release writes back it does not train any further.
        let config = &self.config.model.attention;
        let written_back = config.write_back && self.plan.attention && step >= config.start;
        let rate = if written_back { 0.0 } else { rates.feature };
        let of_anchors = [&gradients.feature, &gradients.offset, &gradients.log_scaling];
        for ((parameter, gradient), rate) in
            anchors.parameters().into_iter().zip(of_anchors).zip([rate, rates.offset, rates.log_scaling])
        {
            update(parameter, gradient.as_ref(), anchors.count * parameter.width, rate.into());
        }
        let layout = Layout { offsets: anchors.offsets as usize };
        let parts = [1, 2].map(|head| layout.head(head) as u32);
        let of_decoders = adam::Rates { rate: rates.decoders, parts };
        update(weights, gradients.weights.as_ref(), layout.weights() as u32, of_decoders);
        if let Some((attend, skip)) = attention {
            let weights = &attend.weights;
            let since = step + 1 - self.config.model.attention.start.max(1);
            let tensors = Tensors {
                value: &weights.value,
                gradient: &attend.grad_weights,
                first: &weights.first,
                root: &weights.root,
            };
            adam::record(rec, &self.adam, tensors, skip, (0, weights.width), (since, rates.attention));
        }
    }
}

//! How a view counts in a step: the weights of its losses.

use super::Step;
use crate::losses::config::{REFERENCE_COLOR_INSIDE, REFERENCE_DEPTH, REFERENCE_DEPTH_INSIDE};
use crate::losses::{DepthView, Quantity, View, Weights};
use crate::scene::PriorKind;
use crate::train::photographs::{Photograph, PriorMap};

impl Step {
    /// How a photograph counts in a step.
    pub(super) fn view<'p>(&self, photograph: &'p Photograph) -> View<'p> {
        let (reference, near) = (photograph.reference, self.near);
        let inside = |on_reference: f64| if reference { on_reference as f32 } else { 0.0 };
        let looked_at = self.plan.depth_losses(reference).any();
        let depth =
            photograph.prior.as_ref().filter(|_| looked_at).map(|PriorMap { kind, values: prior, gaps, fit }| {
                let depth = &self.config.losses.depth;
                let outside = if reference { REFERENCE_DEPTH } else { depth.other_weight };
                let factor = if reference { 1.0 } else { depth.other_weight };
                DepthView {
                    prior,
                    quantity: match kind {
                        PriorKind::Depth => Quantity::Depth,
                        PriorKind::Disparity => Quantity::Disparity { near },
                    },
                    weights: Weights { outside: outside as f32, inside: inside(REFERENCE_DEPTH_INSIDE) },
                    gradient: (depth.gradient.weight * factor) as f32,
                    gradient_inside: reference,
                    gaps: *gaps,
                    fit: fit.as_ref(),
                }
            });
        let weights = Weights { outside: 1.0, inside: inside(REFERENCE_COLOR_INSIDE) };
        View { picture: &photograph.picture, weights, depth }
    }
}

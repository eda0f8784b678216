//! How a view counts in a step: the weights of its losses.

use rand::RngExt;

use super::Step;
use crate::losses::config::Region;
use crate::losses::{DepthView, Quantity, Rectangle, View, Weights};
use crate::scene::PriorKind;
use crate::train::order::{Stream, random};
use crate::train::photographs::{Photograph, PriorMap};

/// 80 % of the mask's bounding box (x0, y0, one past x1, y1), placed at random in that box enlarged 1.5 times, clipped to
/// the picture (GScream's release).
fn random_rectangle(rng: &mut impl RngExt, bounds: [u32; 4], size: [u32; 2]) -> ([u32; 2], [u32; 2]) {
    let side = |rng: &mut dyn FnMut(f64, f64) -> f64, axis: usize| {
        let (low, high) = (f64::from(bounds[axis]), f64::from(bounds[axis + 2]));
        let (extent, middle) = (high - low, 0.5 * (low + high));
        let (first, last) = (middle - 0.75 * extent, middle + 0.75 * extent - 0.8 * extent);
        let at = rng(first, last);
        let clip = |v: f64| v.round().clamp(0.0, f64::from(size[axis])) as u32;
        (clip(at), clip(at + 0.8 * extent))
    };
    let mut uniform = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
    let ((x0, x1), (y0, y1)) = (side(&mut uniform, 0), side(&mut uniform, 1));
    ([x0, y0], [x1, y1])
}

impl Step {
    /// How a photograph counts in a step.
    pub(super) fn view<'p>(&self, photograph: &'p Photograph, step: u32) -> View<'p> {
        let config = &self.config.losses;
        let (reference, near) = (photograph.reference, self.near);
        let inside = |on_reference: f64| if reference { on_reference as f32 } else { 0.0 };
        let looked_at = self.plan.depth_losses(reference).any();
        let depth =
            photograph.prior.as_ref().filter(|_| looked_at).map(|PriorMap { kind, values: prior, gaps, fit }| {
                let depth = &config.depth;
                let gradient = &depth.gradient;
                let outside = if reference { depth.reference_weight } else { depth.other_weight };
                let boxed = reference && depth.reference_inside_region == Region::RandomRectangle;
                let added = if boxed { 0.0 } else { depth.reference_inside_weight };
                let rectangle = photograph.mask_box.filter(|_| boxed).map(|bounds| {
                    let mut rng = random(self.config.train.seed, Stream::Rectangle, step);
                    let (low, high) = random_rectangle(&mut rng, bounds, photograph.camera.size);
                    Rectangle { low, high, added: depth.reference_inside_weight as f32 }
                });
                let factor = if reference { gradient.reference_weight } else { gradient.other_weight };
                DepthView {
                    prior,
                    quantity: match kind {
                        PriorKind::Depth => Quantity::Depth,
                        PriorKind::Disparity => Quantity::Disparity { near },
                    },
                    weights: Weights { outside: outside as f32, inside: inside(depth.reference_weight + added) },
                    rectangle,
                    gradient: (gradient.weight * factor) as f32,
                    gradient_inside: reference,
                    gaps: *gaps,
                    fit: fit.as_ref(),
                }
            });
        let weights = Weights { outside: 1.0, inside: inside(config.reference_inside_weight) };
        View { picture: &photograph.picture, weights, depth }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_stay_in_the_picture() {
        for step in 0..200 {
            let mut rng = random(3, Stream::Rectangle, step);
            let ([x0, y0], [x1, y1]) = random_rectangle(&mut rng, [0, 10, 20, 30], [40, 32]);
            assert!(x0 < x1 && x1 <= 40 && y0 < y1 && y1 <= 32, "{x0} {y0} {x1} {y1}");
            // 80 % of 20 pixels, but for what is clipped and rounded away.
            assert!(x1 - x0 <= 17 && y1 - y0 <= 17);
        }
    }
}

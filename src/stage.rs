//! The stages of a run by name: passes and buffers say which one they belong to, and `plan` lists them.

use crate::losses::Term;

/// Training pictures and depth priors.
pub const PICTURES: &str = "pictures";
/// Anchors and decoders, or plain Gaussians, with the optimiser's moments.
pub const MODEL: &str = "model";
/// The list of visible anchors.
pub const CULL: &str = "cull";
/// Cross-attention, both ways.
pub const ATTENTION: &str = "attention";
/// The model to the Gaussians of a view: anchors decoded, or plain Gaussians activated.
pub const DECODE: &str = "decode";
/// Gaussians to the picture plane.
pub const PROJECT: &str = "project";
/// Tiles' lists.
pub const BIN: &str = "bin";
/// The picture.
pub const RASTERIZE: &str = "rasterize";
/// Back from the picture to the picture plane.
pub const RASTERIZE_BACKWARD: &str = "rasterize backward";
/// Back from the picture plane to the Gaussians.
pub const PROJECT_BACKWARD: &str = "project backward";
/// Back from the Gaussians to the model.
pub const DECODE_BACKWARD: &str = "decode backward";
/// What growing and pruning look at.
pub const STATISTICS: &str = "statistics";
/// Adam.
pub const OPTIMIZER: &str = "adam";
/// The search for values that are not finite.
pub const SENTINEL: &str = "sentinel";
/// Growing and pruning of anchors, or moving and adding of plain Gaussians.
pub const GROWTH: &str = "grow and prune";
/// Test views.
pub const EVALUATION: &str = "evaluation";
/// What the loop itself needs: uploads, counters, figures on their way to the host.
pub const RUN: &str = crate::gpu::ledger::NO_STAGE;

/// Before the losses.
const FORWARD: [&str; 8] = [PICTURES, MODEL, CULL, ATTENTION, DECODE, PROJECT, BIN, RASTERIZE];
/// After them.
const BACKWARD: [&str; 9] =
    [RASTERIZE_BACKWARD, PROJECT_BACKWARD, DECODE_BACKWARD, SENTINEL, STATISTICS, OPTIMIZER, GROWTH, EVALUATION, RUN];

/// All, in the order of a step; the losses' are those of [`Term::ALL`].
pub const ALL: [&str; FORWARD.len() + Term::ALL.len() + BACKWARD.len()] = {
    let mut all = [RUN; FORWARD.len() + Term::ALL.len() + BACKWARD.len()];
    let mut i = 0;
    while i < all.len() {
        all[i] = if i < FORWARD.len() {
            FORWARD[i]
        } else if i < FORWARD.len() + Term::ALL.len() {
            Term::ALL[i - FORWARD.len()].stage
        } else {
            BACKWARD[i - FORWARD.len() - Term::ALL.len()]
        };
        i += 1;
    }
    all
};

//! Passes by the stage of the step they belong to, and the tensors a stage is judged by.

use crate::gpu::form::without_form;
use serde::Serialize;

/// A stage of the step, in the order of the step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stage {
    /// Which anchors are in view.
    Cull,
    /// Choosing tokens and blending their features.
    Attention,
    /// Features to Gaussians.
    Decode,
    /// Gaussians to the picture plane.
    Project,
    /// Depth order, tiles, sorting.
    Bin,
    /// The picture.
    Rasterize,
    /// Losses and their gradients.
    Losses,
    /// Gradients of the projected Gaussians.
    RasterizeBackward,
    /// Gradients of the Gaussians.
    ProjectBackward,
    /// Gradients of anchors and decoders.
    DecodeBackward,
    /// Statistics for growing and pruning.
    Statistics,
    /// Gradients through the attention.
    AttentionBackward,
    /// Adam.
    Optimizer,
}

impl Stage {
    /// All, in their order.
    pub const ALL: [Self; 13] = [
        Self::Cull,
        Self::Attention,
        Self::Decode,
        Self::Project,
        Self::Bin,
        Self::Rasterize,
        Self::Losses,
        Self::RasterizeBackward,
        Self::ProjectBackward,
        Self::DecodeBackward,
        Self::Statistics,
        Self::AttentionBackward,
        Self::Optimizer,
    ];

    /// As people call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cull => "cull",
            Self::Attention => "attention",
            Self::Decode => "decode",
            Self::Project => "project",
            Self::Bin => "bin and sort",
            Self::Rasterize => "rasterize",
            Self::Losses => "losses",
            Self::RasterizeBackward => "rasterize backward",
            Self::ProjectBackward => "project backward",
            Self::DecodeBackward => "decode backward",
            Self::Statistics => "growth statistics",
            Self::AttentionBackward => "attention backward",
            Self::Optimizer => "optimizer",
        }
    }

    /// The stages that make the picture.
    pub fn is_forward(self) -> bool {
        self <= Self::Rasterize
    }
}

/// The stage of every pass of a step, by the passes' names in their order. Passes that know nothing of stages (sorts,
/// scans, fills, copies) belong to the one they follow; those at the very beginning to the first.
pub fn of_passes<'a>(passes: impl IntoIterator<Item = &'a str>) -> Vec<Stage> {
    let (mut stage, mut backward) = (Stage::Cull, false);
    let mut stages = vec![];
    for pass in passes {
        let pass = without_form(pass);
        let (folder, stem) = pass.split_once('/').unwrap_or(("", &pass));
        stage = match folder {
            "losses" => Stage::Losses,
            "densify" => Stage::Statistics,
            "optimizer" => Stage::Optimizer,
            "model" if backward => Stage::AttentionBackward,
            "model" => Stage::Attention,
            "render" if stem.starts_with("cull") => Stage::Cull,
            "render" if stem.starts_with("decode_backward") => Stage::DecodeBackward,
            "render" if stem.starts_with("decode") => Stage::Decode,
            "render" if stem.starts_with("project_backward") || stem == "compensate_backward" => Stage::ProjectBackward,
            "render" if stem.starts_with("project") || stem == "compensate" => Stage::Project,
            "render" if stem.starts_with("bin") => Stage::Bin,
            "render" if stem.starts_with("rasterize_backward") || stem.starts_with("rasterize_gather") => {
                Stage::RasterizeBackward
            }
            "render" if stem.starts_with("rasterize") => Stage::Rasterize,
            _ => stage,
        };
        backward |= stage == Stage::DecodeBackward;
        stages.push(stage);
    }
    stages
}

/// How a tensor's elements are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rows {
    /// So many components per Gaussian slot; only slots that touch a tile count.
    Slots(usize),
    /// As they are.
    Plain,
    /// A learnt array: what the step changes in it counts.
    Learnt,
}

/// The float tensors by which stages are judged: buffers' names.
pub const OUTPUTS: [(Stage, &str, Rows); 29] = [
    (Stage::Attention, "blended", Rows::Plain),
    (Stage::Decode, "position", Rows::Slots(3)),
    (Stage::Decode, "opacity", Rows::Slots(1)),
    (Stage::Decode, "color", Rows::Slots(3)),
    (Stage::Decode, "scale", Rows::Slots(3)),
    (Stage::Decode, "rotation", Rows::Slots(4)),
    (Stage::Project, "mean", Rows::Slots(2)),
    (Stage::Project, "covariance", Rows::Slots(3)),
    (Stage::Project, "depth", Rows::Slots(1)),
    (Stage::Rasterize, "rgb", Rows::Plain),
    (Stage::Rasterize, "depth_map", Rows::Plain),
    (Stage::Losses, "losses", Rows::Plain),
    (Stage::Losses, "grad_rgb", Rows::Plain),
    (Stage::RasterizeBackward, "grad_mean", Rows::Slots(2)),
    (Stage::RasterizeBackward, "grad_covariance", Rows::Slots(3)),
    (Stage::RasterizeBackward, "grad_opacity", Rows::Slots(1)),
    (Stage::RasterizeBackward, "grad_color", Rows::Slots(3)),
    // By the depth map's pixels first, a buffer of the same name; then by the Gaussians' depths, which is kept.
    (Stage::RasterizeBackward, "grad_depth", Rows::Slots(1)),
    (Stage::ProjectBackward, "grad_position", Rows::Slots(3)),
    (Stage::ProjectBackward, "grad_scale", Rows::Slots(3)),
    (Stage::ProjectBackward, "grad_rotation", Rows::Slots(4)),
    (Stage::DecodeBackward, "grad_offset", Rows::Plain),
    (Stage::DecodeBackward, "grad_log_scaling", Rows::Plain),
    (Stage::DecodeBackward, "grad_weights", Rows::Plain),
    (Stage::AttentionBackward, "grad_feature", Rows::Plain),
    (Stage::AttentionBackward, "grad_attention_weights", Rows::Plain),
    (Stage::Optimizer, "feature", Rows::Learnt),
    (Stage::Optimizer, "offset", Rows::Learnt),
    (Stage::Optimizer, "weights", Rows::Learnt),
];

/// The gradients of the model: everything that Adam reads.
pub const GRADIENTS: [&str; 5] =
    ["grad_feature", "grad_offset", "grad_log_scaling", "grad_weights", "grad_attention_weights"];

/// What a traced recording keeps for the comparison: the tensors above, and what says which slot is which.
pub const WANTED: [&str; 33] = {
    let mut names = [""; 33];
    let mut i = 0;
    while i < OUTPUTS.len() {
        names[i] = OUTPUTS[i].1;
        i += 1;
    }
    names[29] = "log_scaling";
    names[30] = "visible";
    names[31] = "visible_count";
    names[32] = "tiles";
    names
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_by_stage() {
        let passes = [
            ("fill", Stage::Cull),
            ("render/cull", Stage::Cull),
            ("primitives/compact", Stage::Cull),
            ("model/attention_select", Stage::Attention),
            ("primitives/sort_scatter", Stage::Attention),
            ("copy", Stage::Attention),
            ("render/decode_pack", Stage::Decode),
            ("render/project", Stage::Project),
            ("render/bin_count", Stage::Bin),
            ("primitives/sort_count", Stage::Bin),
            ("render/cpu/rasterize", Stage::Rasterize),
            ("losses/sum", Stage::Losses),
            ("render/cpu/rasterize_backward_depth", Stage::RasterizeBackward),
            ("render/rasterize_gather", Stage::RasterizeBackward),
            ("render/project_backward_color", Stage::ProjectBackward),
            ("render/decode_backward_weights", Stage::DecodeBackward),
            ("densify/statistics", Stage::Statistics),
            ("model/attention_blend_gather", Stage::AttentionBackward),
            ("optimizer/adam", Stage::Optimizer),
        ];
        let stages = of_passes(passes.iter().map(|p| p.0));
        for ((pass, want), got) in passes.iter().zip(stages) {
            assert_eq!(got, *want, "{pass}");
        }
    }

    #[test]
    fn names_are_distinct() {
        let mut names = WANTED.to_vec();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), WANTED.len());
        assert!(GRADIENTS.iter().all(|name| WANTED.contains(name)));
    }
}

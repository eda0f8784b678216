//! What a scene needs: every stage that is present, and for each that is left out the reason.

use super::photographs::reduced_size;
use crate::config::Settings;
use crate::losses;
use crate::render::rasterize::Outputs;
use crate::scene::Scene;

/// Something a scene does not need.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LeftOut {
    /// What has no pipeline, no buffer and no pass.
    pub what: &'static str,
    /// Why.
    pub why: String,
}

/// The stages of a run.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Plan {
    /// Pixels have weights: some view has a mask.
    pub masks: bool,
    /// Depth losses: some view has a prior.
    pub depth: bool,
    /// The multi-scale gradient of the depth difference.
    pub depth_gradient: bool,
    /// Cross-attention, from `model.attention.start` on.
    pub attention: bool,
    /// Growing and pruning of anchors.
    pub growth: bool,
    /// The reference view, an index into the training views.
    pub reference: Option<usize>,
    /// Distinct sizes of training pictures, at first those of the first step.
    pub sizes: Vec<[u32; 2]>,
    /// What is absent and why.
    pub left_out: Vec<LeftOut>,
}

impl Plan {
    /// The plan for a scene under these settings.
    pub fn new(scene: &Scene, settings: &Settings) -> Self {
        let mut left_out = vec![];
        let mut leave = |what, why: &str| left_out.push(LeftOut { what, why: why.to_owned() });
        let masks = scene.train.iter().any(|v| v.mask.is_some());
        if !masks {
            leave("pixel weights", "no view has a mask");
        }
        if scene.reference.is_none() {
            leave("reference view", "the scene has no inpainted picture");
        }
        let config = &settings.losses.depth;
        let priors = scene.train.iter().any(|v| v.prior.is_some())
            || scene.reference.as_ref().is_some_and(|r| r.prior.is_some());
        let weighted = config.reference_weight + config.reference_inside_weight + config.other_weight > 0.0;
        let gradient_weight =
            config.gradient.weight * (config.gradient.reference_weight + config.gradient.other_weight);
        let depth = priors && config.enabled && (weighted || gradient_weight > 0.0);
        if !priors {
            leave("depth map, its gradient, alignment and depth losses", "no view has a depth prior");
        } else if !depth {
            leave(
                "depth map, its gradient, alignment and depth losses",
                "losses.depth.enabled is false or all its weights are zero",
            );
        }
        let depth_gradient = depth && gradient_weight > 0.0;
        if depth && !depth_gradient {
            leave("depth gradient", "losses.depth.gradient.weight is zero");
        }
        let attention_config = &settings.model.attention;
        let attention = attention_config.enabled && masks && attention_config.start < settings.train.iterations;
        if !attention {
            let why = if !attention_config.enabled {
                "model.attention.enabled is false".to_owned()
            } else if !masks {
                "there is no mask to split anchors by".to_owned()
            } else {
                format!("it would start at step {}, after the last", attention_config.start)
            };
            leave("cross-attention", &why);
        }
        let growth = settings.densify.enabled && settings.densify.from < settings.train.iterations;
        if !growth {
            let why = if settings.densify.enabled {
                format!("it would start at step {}, after the last", settings.densify.from)
            } else {
                "densify.enabled is false".to_owned()
            };
            leave("statistics, growing and pruning", &why);
        }
        leave("gradient of anchor positions", "anchors do not move");
        leave("gradient of transmittance", "no loss looks at it");
        if scene.test.is_empty() {
            leave("evaluation", "there are no test views");
        }
        let sizes = Self::reduced_sizes(scene, settings.train.coarse.reduction(1));
        let reference = scene.reference.as_ref().map(|r| r.view);
        Self { masks, depth, depth_gradient, attention, growth, reference, sizes, left_out }
    }

    /// The distinct sizes of the training pictures reduced by this factor.
    pub fn reduced_sizes(scene: &Scene, reduction: u32) -> Vec<[u32; 2]> {
        let mut sizes: Vec<_> = scene.train.iter().map(|v| reduced_size(v.camera.size, reduction)).collect();
        sizes.sort_unstable();
        sizes.dedup();
        sizes
    }

    /// The losses of pictures of this size.
    pub fn losses(&self, size: [u32; 2], settings: &Settings) -> losses::Plan {
        let gradient_scales = if self.depth_gradient { settings.losses.depth.gradient.scales } else { 0 };
        let ssim_weight = settings.losses.ssim_weight as f32;
        losses::Plan { size, ssim_weight, masks: self.masks, depth: self.depth, gradient_scales }
    }

    /// What the rasteriser writes.
    pub fn outputs(&self) -> Outputs {
        if self.depth { Outputs::ColorDepth } else { Outputs::Color }
    }

    /// The larger of each side over all training pictures.
    pub fn largest(&self) -> [u32; 2] {
        self.sizes.iter().fold([1, 1], |a, b| [a[0].max(b[0]), a[1].max(b[1])])
    }
}

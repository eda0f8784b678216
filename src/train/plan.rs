//! What a scene needs: every stage that is present, from which step to which, and for each that is left out the reason.

use crate::config::Settings;
use crate::losses;
use crate::model::arrays::ARRAYS;
use crate::model::config::Form;
use crate::model::parameter::DECODERS;
use crate::optimizer::Group;
use crate::render::rasterize::Outputs;
use crate::scene::{Prior, Scene, reduced};
use crate::stage;

/// Something a scene does not need.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LeftOut {
    /// What has no pipeline, no buffer and no pass.
    pub what: &'static str,
    /// Why.
    pub why: String,
}

/// Steps, the first and the last, counted from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Steps {
    /// The first.
    pub first: u32,
    /// The last.
    pub last: u32,
}

impl Steps {
    /// Whether it is one of them.
    pub fn contain(self, step: u32) -> bool {
        (self.first..=self.last).contains(&step)
    }
}

/// Which losses look at the depth of a view that has a prior.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize)]
pub struct DepthLosses {
    /// The L1 loss.
    pub l1: bool,
    /// The multi-scale gradient of the difference.
    pub gradient: bool,
}

impl DepthLosses {
    /// Whether any does.
    pub fn any(self) -> bool {
        self.l1 || self.gradient
    }
}

/// The groups that need a gradient: only theirs are computed.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Trained(Vec<Group>);

impl Default for Trained {
    /// Every group.
    fn default() -> Self {
        Self(Group::ALL.to_vec())
    }
}

impl Trained {
    /// Whether any of these groups is trained.
    pub fn any(&self, groups: impl IntoIterator<Item = Group>) -> bool {
        groups.into_iter().any(|group| self.0.contains(&group))
    }
}

/// The stages of a run.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Plan {
    /// Pixels have weights: some view has a mask, or a prior that is not everywhere.
    pub masks: bool,
    /// Depth losses: some view has a prior that they look at.
    pub depth: bool,
    /// The multi-scale gradient of the depth difference.
    pub depth_gradient: bool,
    /// Losses that look at the reference view's depth.
    pub reference_depth: DepthLosses,
    /// A reference's prior has its depth from the points, instead of being fitted in each step.
    pub align_to_points: bool,
    /// Losses that look at the other views' depth.
    pub other_depth: DepthLosses,
    /// Cross-attention, from `model.attention.start` on.
    pub attention: bool,
    /// The model is of plain Gaussians.
    #[serde(skip)]
    pub plain: bool,
    /// Growing and pruning of anchors, or moving and adding of plain Gaussians.
    pub growth: bool,
    /// Likewise, with the steps behind which the first and the last round come.
    pub rounds: Option<Steps>,
    /// Steps that are counted for them.
    pub counted: Option<Steps>,
    /// Culling of anchors that are out of view.
    pub cull: bool,
    /// The search for values that are not finite.
    pub sentinel: bool,
    /// What is trained.
    pub trained: Trained,
    /// Figures on the test views.
    pub evaluation: bool,
    /// The reference views, indices into the training views.
    pub references: Vec<usize>,
    /// Distinct sizes of training pictures, at first those of the first step.
    pub sizes: Vec<[u32; 2]>,
    /// Steps.
    pub iterations: u32,
    /// What is absent and why.
    pub left_out: Vec<LeftOut>,
}

/// The losses that have a weight on the depth of a view.
fn depth_losses(config: &losses::config::Depth, reference: bool) -> DepthLosses {
    let share = if reference { 1.0 } else { config.other_weight };
    DepthLosses { l1: config.enabled && share > 0.0, gradient: config.enabled && config.gradient.weight * share > 0.0 }
}

/// The rounds of growing and pruning that come to pass; none behind the last step, whose anchors nobody would train.
pub(super) fn rounds(settings: &Settings) -> Option<Steps> {
    let config = &settings.densify;
    // No multiple fits behind the largest steps.
    let first = config.from.max(1).checked_next_multiple_of(config.every)?;
    let until = config.until.min(settings.train.iterations.saturating_sub(1));
    let last = until - until % config.every;
    (config.enabled && first <= last).then_some(Steps { first, last })
}

impl Plan {
    /// The plan for a scene under these settings.
    pub fn new(scene: &Scene, settings: &Settings) -> Self {
        let mut left_out = vec![];
        let mut leave = |what, why: &str| left_out.push(LeftOut { what, why: why.to_owned() });
        let iterations = settings.train.iterations;
        let masks = scene.train.iter().any(|v| v.mask.is_some());
        let reference_gaps = scene.references.iter().filter_map(|r| r.prior.as_ref());
        let gaps = scene.train.iter().filter_map(|v| v.prior.as_ref()).chain(reference_gaps).any(Prior::has_gaps);
        if !masks && !gaps {
            leave("pixel weights", "no view has a mask");
        }
        if scene.references.is_empty() {
            leave("reference view", "the scene has no inpainted picture");
        }
        let config = &settings.losses.depth;
        let references: Vec<usize> = scene.references.iter().map(|r| r.view).collect();
        let reference_prior = scene.references.iter().any(|r| r.prior.is_some());
        let other_priors = scene.train.iter().enumerate().any(|(i, v)| !references.contains(&i) && v.prior.is_some());
        let of = |prior, is_reference| {
            if prior { depth_losses(config, is_reference) } else { DepthLosses::default() }
        };
        let (reference_depth, other_depth) = (of(reference_prior, true), of(other_priors, false));
        let depth = reference_depth.any() || other_depth.any();
        if !reference_prior && !other_priors {
            leave("depth map, its gradient, alignment and depth losses", "no view has a depth prior");
        } else if !depth {
            leave(
                "depth map, its gradient, alignment and depth losses",
                "losses.depth.enabled is false or all its weights are zero",
            );
        } else if !other_depth.any() && scene.train.len() > 1 {
            let why = if other_priors { "their weights are zero" } else { "they have no prior" };
            leave("depth of views other than the reference", why);
        } else if !reference_depth.any() && !references.is_empty() {
            leave("depth of the reference view", "it has no prior");
        }
        let depth_gradient = reference_depth.gradient || other_depth.gradient;
        if depth && !depth_gradient {
            leave("depth gradient", "losses.depth.gradient.weight is zero");
        }
        if settings.losses.ssim_weight == 0.0 {
            leave("SSIM", "losses.ssim_weight is zero");
        }
        let attention_config = &settings.model.attention;
        let attention =
            attention_config.enabled && masks && attention_config.start <= iterations && attention_config.blend > 0.0;
        if !attention {
            let why = if !attention_config.enabled {
                "model.attention.enabled is false".to_owned()
            } else if !masks {
                "there is no mask to split anchors by".to_owned()
            } else if attention_config.blend > 0.0 {
                format!("it would start at step {}, after the last", attention_config.start)
            } else {
                "model.attention.blend is zero".to_owned()
            };
            leave("cross-attention", &why);
        }
        let plain = settings.model.form == Form::Gaussians;
        let rounds = rounds(settings);
        if rounds.is_none() {
            let why = if settings.densify.enabled {
                format!("no round comes between step {} and the last", settings.densify.from)
            } else {
                "densify.enabled is false".to_owned()
            };
            leave("statistics, growing and pruning", &why);
        }
        let counted = rounds.map(|r| Steps { first: settings.densify.statistics_from.max(1), last: r.last });
        let counted = counted.filter(|_| !plain);
        if plain && rounds.is_some() {
            leave("statistics", "plain Gaussians move by their opacity alone");
        }
        let cull = settings.render.cull && !plain;
        if plain {
            leave("culling", "model.form is \"gaussians\": each is projected by itself");
        } else if !cull {
            leave("culling", "render.cull is false");
        }
        let sentinel = settings.train.sentinel_interval > 0;
        if !sentinel {
            leave("sentinel", "train.sentinel_interval is 0");
        }
        let rates = &settings.optimizer.learning_rate;
        let trained = |group: &Group| match group {
            group if group.is_plain() != plain => false,
            // The way back to plain Gaussians writes all of their gradients.
            _ if plain => true,
            // Gradients pass through the features to the attention's projections.
            Group::Feature if attention => true,
            Group::Attention => attention,
            _ => rates.of(*group) != [0.0; 2],
        };
        let trained = Trained(Group::ALL.into_iter().filter(trained).collect());
        if !plain {
            for array in ARRAYS.iter().filter(|array| !trained.any([array.group])) {
                leave(array.gradient, &format!("optimizer.learning_rate.{} is zero", array.group.name()));
            }
            if !trained.any(DECODERS) {
                leave("gradient of decoders", "optimizer.learning_rate.mlp_* is zero");
            }
            leave("gradient of anchor positions", "anchors do not move");
        }
        leave("gradient of view directions and distances", "cameras do not move");
        leave("transmittance and its gradient", "no loss looks at it");
        let evaluation = !scene.test.is_empty();
        if !evaluation {
            leave("evaluation", "there are no test views");
        }
        let sizes = Self::reduced_sizes(scene, settings.train.coarse.reduction(1));
        Self {
            masks: masks || gaps && depth,
            depth,
            depth_gradient,
            reference_depth,
            align_to_points: settings.scene.check_priors,
            other_depth,
            attention,
            plain,
            growth: rounds.is_some(),
            rounds,
            counted,
            cull,
            sentinel,
            trained,
            evaluation,
            references,
            sizes,
            iterations,
            left_out,
        }
    }

    /// The distinct sizes of the training pictures reduced by this factor.
    pub fn reduced_sizes(scene: &Scene, reduction: u32) -> Vec<[u32; 2]> {
        let mut sizes: Vec<_> = scene.train.iter().map(|v| reduced(v.camera.size, reduction)).collect();
        sizes.sort_unstable();
        sizes.dedup();
        sizes
    }

    /// The losses of pictures of this size.
    pub fn losses(&self, size: [u32; 2], settings: &Settings) -> losses::Plan {
        let gradient_scales = if self.depth_gradient { settings.losses.depth.gradient.scales } else { 0 };
        let ssim_weight = settings.losses.ssim_weight as f32;
        let ssim_across_masks = settings.losses.ssim_across_masks;
        losses::Plan { size, ssim_weight, masks: self.masks, ssim_across_masks, depth: self.depth, gradient_scales }
    }

    /// The losses that look at the depth of the reference view, or of the others.
    pub fn depth_losses(&self, reference: bool) -> DepthLosses {
        if reference { self.reference_depth } else { self.other_depth }
    }

    /// What the rasteriser writes.
    pub fn outputs(&self) -> Outputs {
        if self.depth { Outputs::Depth } else { Outputs::Color }
    }

    /// The larger of each side over all training pictures.
    pub fn largest(&self) -> [u32; 2] {
        self.sizes.iter().fold([1, 1], |a, b| [a[0].max(b[0]), a[1].max(b[1])])
    }

    /// The steps that a stage of [`stage::ALL`] takes part in; `None` for one that is left out. What comes behind a step
    /// counts as that step's.
    pub fn steps(&self, name: &str, settings: &Settings) -> Option<Steps> {
        let all = Steps { first: 1, last: self.iterations };
        match name {
            stage::ATTENTION => self.attention.then_some(Steps { first: settings.model.attention.start.max(1), ..all }),
            stage::SENTINEL => self.sentinel.then_some(all),
            stage::CULL => (!self.plain).then_some(all),
            stage::STATISTICS => self.counted,
            stage::GROWTH => self.rounds,
            stage::EVALUATION => {
                let every = settings.train.eval_interval;
                let first = if every == 0 { self.iterations } else { every.min(self.iterations) };
                self.evaluation.then_some(Steps { first, ..all })
            }
            _ => {
                let losses = self.losses(self.largest(), settings);
                losses::Term::of_stage(name).is_none_or(|term| (term.planned)(&losses)).then_some(all)
            }
        }
    }

    /// Why a stage of [`stage::ALL`] is left out.
    pub fn why(&self, name: &str) -> Option<&str> {
        let listed = |what: &str| self.left_out.iter().find(|left| left.what == what).map(|left| left.why.as_str());
        match name {
            stage::ATTENTION => listed("cross-attention"),
            stage::CULL => listed("culling"),
            stage::STATISTICS | stage::GROWTH => {
                listed("statistics, growing and pruning").or_else(|| listed("statistics"))
            }
            stage::SENTINEL => listed("sentinel"),
            stage::EVALUATION => listed("evaluation"),
            _ => losses::Term::of_stage(name)?.left_out.iter().find_map(|what| listed(what)),
        }
    }
}

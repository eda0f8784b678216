//! One training step, as one straight line.

use rand::RngExt;

use crate::config::Settings;
use crate::densify::{self, Drawn, Statistics};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::losses::config::Region;
use crate::losses::{self, DepthView, Losses, Quantity, Rectangle, View, Weights};
use crate::math::decoder::Layout;
use crate::model::anchors::{Anchors, Parameter};
use crate::model::files;
use crate::optimizer::adam::{self, Tensors};
use crate::optimizer::schedule::Rate;
use crate::primitives::finite;
use crate::primitives::limit::Limits;

use crate::render::decode::{self, DecodeBackward, GaussianGradients, WantedGradients};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Picture, PictureGradient};
use crate::render::view::{Capacity, Forward, Model, Painter, Rendered};
use crate::render::{Config, Method};
use crate::scene::{Camera, PriorKind};
use crate::stage;

use super::attend::{Attend, Attended};
use super::order::{Stream, random};
use super::photographs::{Photograph, PriorMap};
use super::plan::{Plan, Trained};

/// Where the gradients of what is trained go, zeroed at the beginning of every step.
struct Gradients {
    feature: Option<Buffer<f32>>,
    offset: Option<Buffer<f32>>,
    log_scaling: Option<Buffer<f32>>,
    weights: Option<Buffer<f32>>,
}

impl Gradients {
    fn new(gpu: &Gpu, trained: Trained, anchors: &Anchors, weights: &Parameter) -> Result<Self, Error> {
        let of = |name, parameter: &Parameter| gpu.buffer(name, parameter.value.len());
        Ok(Self {
            feature: trained.feature.then(|| of("grad_feature", &anchors.feature)).transpose()?,
            offset: trained.offset.then(|| of("grad_offset", &anchors.offset)).transpose()?,
            log_scaling: trained.log_scaling.then(|| of("grad_log_scaling", &anchors.log_scaling)).transpose()?,
            weights: trained.decoders.then(|| of("grad_weights", weights)).transpose()?,
        })
    }
}

/// The stages between the anchors and the picture, both ways.
struct Stages {
    forward: Forward,
    rasterize: Backward,
    project: ProjectBackward,
    decode: DecodeBackward,
    gradients: Gradients,
}

impl Stages {
    fn new(
        gpu: &Gpu,
        plan: &Plan,
        capacity: Capacity,
        anchors: &Anchors,
        weights: &Parameter,
        config: &Config,
    ) -> Result<Self, Error> {
        let (offsets, trained) = (anchors.offsets, plan.trained);
        let method = Method::new(gpu, config)?;
        let forward = Forward::new(gpu, capacity, offsets, method, plan.largest(), config.cull)?;
        let slots = (capacity.visible * offsets) as usize;
        let pairs = capacity.pairs as usize;
        Ok(Self {
            rasterize: gpu
                .stage(stage::RASTERIZE_BACKWARD, || Backward::new(gpu, method, slots, pairs, plan.outputs()))?,
            project: gpu.stage(stage::PROJECT_BACKWARD, || ProjectBackward::new(gpu, &forward.project))?,
            decode: gpu.stage(stage::DECODE_BACKWARD, || {
                DecodeBackward::of(gpu, &forward.decode, trained.feature, trained.decoders)
            })?,
            gradients: gpu.stage(stage::DECODE_BACKWARD, || Gradients::new(gpu, trained, anchors, weights))?,
            forward,
        })
    }
}

/// What depends on the pictures' size.
struct Canvas {
    picture: Picture,
    losses: Losses,
}

impl Canvas {
    /// One for each size of the plan.
    fn all(gpu: &Gpu, plan: &Plan, settings: &Settings) -> Result<Vec<Self>, Error> {
        let canvas = |&size: &[u32; 2]| {
            let pixels = size[0] as usize * size[1] as usize;
            let picture = || Picture::new(gpu, size, pixels, plan.outputs());
            Ok(Self {
                picture: gpu.stage(stage::RASTERIZE, picture)?,
                losses: Losses::new(gpu, &plan.losses(size, settings))?,
            })
        };
        plan.sizes.iter().map(canvas).collect()
    }
}

/// Learning rates of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Anchor features.
    pub feature: f64,
    /// Offsets, the scene's radius included.
    pub offset: f64,
    /// Log-scales.
    pub log_scaling: f64,
    /// Opacity, colour and covariance decoder.
    pub decoders: [f64; 3],
    /// Attention's projections.
    pub attention: f64,
}

impl Rates {
    /// The rates of `step` (counted from 1) for a scene of this radius.
    pub fn at(settings: &Settings, radius: f64, step: u32) -> Self {
        let config = &settings.optimizer;
        let length = if config.schedule_length == 0 { settings.train.iterations } else { config.schedule_length };
        let at = |[initial, last]: [f64; 2]| Rate { initial, last }.at(step, length);
        let rates = &config.learning_rate;
        Self {
            feature: at(rates.feature),
            offset: at(rates.offset.map(|r| r * radius)),
            log_scaling: at(rates.log_scaling),
            decoders: [at(rates.mlp_opacity), at(rates.mlp_color), at(rates.mlp_cov)],
            attention: at(rates.attention),
        }
    }
}

/// The model on the device and the stages that change it.
pub struct Step {
    gpu: Gpu,
    /// The plan the stages were made for.
    pub plan: Plan,
    /// The anchors.
    pub anchors: Anchors,
    /// The decoders, flat.
    pub weights: Parameter,
    /// Overflow flag and counters.
    pub limits: Limits,
    capacity: Capacity,
    /// Nothing while anchors change or views are drawn for their figures: those take the room.
    stages: Option<Stages>,
    canvases: Vec<Canvas>,
    pub(super) statistics: Option<Statistics>,
    pub(super) voxel: f64,
    pub(super) attend: Option<Attend>,
    /// Initial projections of an attention whose time has not come.
    pub(super) attention_weights: Option<Vec<f32>>,
    config: Settings,
    adam: adam::Config,
    near: f32,
    background: [f32; 3],
}

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

/// Names of the decoders' arrays on the device.
const WEIGHTS: [&str; 3] = ["weights", "weights_first", "weights_root"];

impl Step {
    /// Uploads the model and makes the stages that the plan has. `voxel` is the side of the anchors' grid, scene units.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn new(
        gpu: &Gpu,
        plan: Plan,
        settings: &Settings,
        anchors: &files::Anchors,
        weights: &files::Weights,
        voxel: f64,
    ) -> Result<Self, Error> {
        let anchors = gpu.stage(stage::MODEL, || Anchors::upload(gpu, anchors, 0))?;
        let initial = weights;
        let flat = initial.decoders();
        let weights = gpu.stage(stage::MODEL, || Parameter::new(gpu, WEIGHTS, flat.len() as u32, 1))?;
        gpu.write(&weights.value, &flat)?;
        let mut rec = gpu.recorder()?;
        rec.zero(&weights.first);
        rec.zero(&weights.root);
        rec.submit()?.wait()?;
        let capacity = Capacity::guess(anchors.capacity);
        let stages = Stages::new(gpu, &plan, capacity, &anchors, &weights, &settings.render)?;
        let canvases = Canvas::all(gpu, &plan, settings)?;
        Ok(Self {
            limits: Limits::new(gpu)?,
            gpu: gpu.clone(),
            anchors,
            weights,
            capacity,
            stages: Some(stages),
            canvases,
            statistics: None,
            voxel,
            attend: None,
            attention_weights: plan.attention.then(|| initial.attention()),
            adam: adam::Config {
                beta1: settings.optimizer.betas[0],
                beta2: settings.optimizer.betas[1],
                epsilon: settings.optimizer.epsilon,
                lazy: false,
            },
            near: settings.render.near as f32,
            background: settings.train.background.map(|c| c as f32),
            config: settings.clone(),
            plan,
        })
    }

    /// Makes the stages anew for this capacity. Nothing of the step may be in flight.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn resize(&mut self, capacity: Capacity) -> Result<(), Error> {
        // The old stages' memory goes before the new ones' is taken.
        self.release();
        self.capacity = capacity;
        self.furnish()
    }

    /// Gives back all memory that holds nothing from one step to the next.
    fn release(&mut self) {
        self.stages = None;
        if let Some(attend) = &mut self.attend {
            attend.release();
        }
    }

    /// Takes it again, for the anchors there are now.
    fn furnish(&mut self) -> Result<(), Error> {
        let Self { gpu, plan, anchors, weights, config, .. } = self;
        self.capacity.anchors = anchors.capacity;
        self.stages = Some(Stages::new(gpu, plan, self.capacity, anchors, weights, &config.render)?);
        if let Some(attend) = &mut self.attend {
            gpu.stage(stage::ATTENTION, || attend.furnish(gpu, anchors.capacity))?;
        }
        Ok(())
    }

    fn stages(&self) -> &Stages {
        self.stages.as_ref().expect("the stages are away only within a call")
    }

    /// Draws the model as it is now from these cameras, one after the other, and hands each picture to `look`. The step's
    /// own stages make room meanwhile, so that nothing of the step may be in flight.
    ///
    /// # Errors
    /// When the device has no room, or is lost; `look`'s own.
    pub fn draw<'c, E: From<Error>>(
        &mut self,
        cameras: impl IntoIterator<Item = &'c Camera>,
        mut look: impl FnMut(usize, Rendered) -> Result<(), E>,
    ) -> Result<(), E> {
        self.release();
        let gpu = self.gpu.clone();
        gpu.stage(stage::EVALUATION, || {
            let mut painter = Painter::new(&gpu, &self.config.render, self.background, self.capacity)?;
            let model = Model { anchors: &self.anchors, weights: &self.weights.value };
            cameras.into_iter().enumerate().try_for_each(|(i, camera)| look(i, painter.render(model, camera)?))
        })?;
        Ok(self.furnish()?)
    }

    /// One picture of the model as it is now, in memory of its own that is freed behind it: the step stays as it is, whether
    /// that is to be had or not. None for a camera that sees several times as much as those of training. Nothing of the step
    /// may be in flight.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn glance(&self, camera: &Camera) -> Result<Option<Rendered>, Error> {
        self.gpu.stage(stage::EVALUATION, || {
            let capacity = Capacity { anchors: self.anchors.capacity, ..self.capacity };
            let longest = |size: &[u32; 2]| f64::from(size[0].max(size[1]));
            let trained = self.plan.sizes.iter().map(longest).fold(1.0, f64::max);
            let painter = Painter::new(&self.gpu, &self.config.render, self.background, capacity)?;
            let mut painter = painter.larger(longest(&camera.size) / trained);
            let model = Model { anchors: &self.anchors, weights: &self.weights.value };
            painter.render_within(model, camera, capacity.pairs.max(1 << 20).saturating_mul(4))
        })
    }

    /// Goes on with training pictures of other sizes. Nothing of the step may be in flight.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn resize_pictures(&mut self, sizes: Vec<[u32; 2]>) -> Result<(), Error> {
        self.canvases.clear();
        self.plan.sizes = sizes;
        self.resize(self.capacity)?;
        self.canvases = Canvas::all(&self.gpu, &self.plan, &self.config)?;
        Ok(())
    }

    /// What the stages have room for.
    pub fn capacity(&self) -> Capacity {
        self.capacity
    }

    /// The weighted loss terms of the last step by [`losses::Term`], for pictures of this size.
    pub fn terms(&self, size: [u32; 2]) -> &Buffer<f32> {
        self.canvas(size).losses.terms()
    }

    /// Whether anchors are grown and pruned behind this step.
    pub fn changes_anchors(&self, step: u32) -> bool {
        self.plan.rounds.is_some_and(|r| r.contain(step)) && step.is_multiple_of(self.config.densify.every)
    }

    /// Grows and prunes anchors behind this step, with nothing in flight; says what changed.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<String, Error> {
        if self.statistics.is_none() {
            return Ok(String::new());
        }
        self.release();
        let gpu = self.gpu.clone();
        let text = gpu.stage(stage::GROWTH, || self.grow_and_prune(step))?;
        self.furnish()?;
        Ok(text)
    }

    fn grow_and_prune(&mut self, step: u32) -> Result<String, Error> {
        let Some(statistics) = &mut self.statistics else { return Ok(String::new()) };
        let config = &self.config.densify;
        let round = densify::Round { voxel: self.voxel as f32, seed: self.config.train.seed, step };
        let before = self.anchors.count;
        let grown = densify::grow::run(&self.gpu, &mut self.anchors, statistics, config, round)?;
        let pruned = densify::prune::run(&self.gpu, &mut self.anchors, statistics, config)?;
        // As large a share of the anchors is in view as before.
        let [visible, old, new] = [self.capacity.visible, self.capacity.anchors, self.anchors.capacity].map(u64::from);
        self.capacity.visible = (visible * new).div_ceil(old.max(1)).max(visible) as u32;
        let mut text =
            format!("step {step}: {} new anchors, {pruned} pruned: {before} -> {}", grown.added, self.anchors.count);
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

    /// The losses for pictures of this size.
    pub fn losses(&self, size: [u32; 2]) -> &Losses {
        &self.canvas(size).losses
    }

    fn canvas(&self, size: [u32; 2]) -> &Canvas {
        self.canvases
            .iter()
            .find(|c| c.picture.size == size)
            .expect("the plan lists the sizes of all training pictures")
    }

    /// Records step `step` (counted from 1) on a photograph.
    pub fn record(&self, rec: &mut Recorder<'_>, photograph: &Photograph, step: u32, rates: Rates) {
        let view = self.view(photograph, step);
        let compared = (&photograph.camera, view.depth.is_some());
        rec.overlapped(|rec| {
            self.line(rec, compared, Some(photograph), step, rates, |rec, canvas| {
                let Canvas { picture, losses } = canvas;
                losses.forward_backward(rec, &view, &picture.rgb, picture.depth.as_ref())
            });
        });
    }

    /// Records a step against the arrays that the losses' frame holds already: for tests.
    pub fn record_prepared(
        &self,
        rec: &mut Recorder<'_>,
        camera: &Camera,
        depth: Option<DepthView<'_>>,
        step: u32,
        rates: Rates,
    ) {
        rec.overlapped(|rec| {
            self.line(rec, (camera, depth.is_some()), None, step, rates, |rec, canvas| {
                let Canvas { picture, losses } = canvas;
                losses.compare(rec, depth, &picture.rgb, picture.depth.as_ref())
            });
        });
    }

    /// How a photograph counts in a step.
    fn view<'p>(&self, photograph: &'p Photograph, step: u32) -> View<'p> {
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

    /// The straight line of one step.
    fn line<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        (camera, depth): (&Camera, bool),
        photograph: Option<&Photograph>,
        step: u32,
        rates: Rates,
        compare: impl FnOnce(&mut Recorder<'_>, &'s Canvas) -> losses::Gradients<'s>,
    ) {
        let Self { anchors, limits, near, .. } = self;
        let Stages { forward, rasterize: backward, project: project_backward, decode: decode_backward, gradients } =
            self.stages();
        let canvas = self.canvas(camera.size);
        // Depth is drawn for views alone whose depth is compared.
        let color_alone = canvas.picture.color();
        let picture = if depth { &canvas.picture } else { &color_alone };
        rec.stage(stage::DECODE_BACKWARD);
        for gradient in [&gradients.feature, &gradients.offset, &gradients.log_scaling].into_iter().flatten() {
            rec.zero(gradient);
        }
        rec.stage(stage::CULL);
        forward.visible.record(rec, anchors, camera, *near, limits);
        // A step may be recorded again after later ones: the stage is there then, but its time has not come.
        let attend = self.attend.as_ref().filter(|_| step >= self.config.model.attention.start);
        rec.stage(stage::ATTENTION);
        let (feature, attended) = match attend.zip(photograph) {
            Some((attend, photograph)) => attend.forward(rec, anchors, &forward.visible, photograph, *near, step),
            None => (&anchors.feature.value, None),
        };
        let offset = anchors.offset.value.view();
        let model = decode::Anchors {
            position: &anchors.position,
            feature,
            offset: &offset,
            log_scaling: &anchors.log_scaling.value,
            weights: &self.weights.value,
            visible: &forward.visible.list,
        };
        rec.stage(stage::DECODE);
        forward.decode.record(rec, model, &forward.visible.count, camera.center());
        rec.stage(stage::PROJECT);
        forward.project.record(rec, &forward.decode.existing, forward.gaussians(), camera, *near);
        rec.stage(stage::BIN);
        let binned = forward.bin.record(rec, forward.projected(), camera.size, limits);
        rec.stage(stage::RASTERIZE);
        rasterize::forward(rec, forward.method(), forward.projected(), binned, self.background, picture);

        let gradient = compare(rec, canvas);

        let gradient = PictureGradient { rgb: gradient.rgb, depth: gradient.depth, transmittance: None };
        rec.stage(stage::RASTERIZE_BACKWARD);
        backward.record(rec, forward.method(), forward.projected(), binned, picture, gradient);
        self.sentinel(rec, Some(canvas.losses.terms()), losses::Term::ALL.len() as u32);
        let splats = SplatGradients {
            mean: &backward.grad_mean,
            covariance: &backward.grad_covariance,
            depth: gradient.depth.and(backward.grad_depth.as_ref()),
        };
        rec.stage(stage::PROJECT_BACKWARD);
        project_backward.record(rec, binned.drawn, forward.gaussians(), splats, camera, *near);
        let gaussians = GaussianGradients {
            drawn: binned.tiles,
            position: &project_backward.grad_position,
            opacity: &backward.grad_opacity,
            color: &backward.grad_color,
            scale: &project_backward.grad_scale,
            rotation: &project_backward.grad_rotation,
        };
        let grad_offset = gradients.offset.as_ref().map(Buffer::view);
        let to = WantedGradients {
            feature: gradients.feature.as_ref(),
            offset: grad_offset.as_ref(),
            log_scaling: gradients.log_scaling.as_ref(),
            weights: gradients.weights.as_ref(),
        };
        rec.stage(stage::DECODE_BACKWARD);
        decode_backward.record(rec, &forward.decode, model, gaussians, to);
        let network = Layout { offsets: anchors.offsets as usize }.weights() as u32;
        self.sentinel(rec, gradients.weights.as_ref(), network);
        rec.stage(stage::ATTENTION);
        if let Some(((attend, attended), grad_feature)) = self.attend.as_ref().zip(attended).zip(to.feature) {
            attend.backward(rec, attended, grad_feature);
        }
        // Whatever changes the model or is gathered for it comes behind: it obeys the flag.
        self.watch(rec, attended, step);
        if let Some(statistics) = &self.statistics {
            let drawn = Drawn {
                visible_count: &forward.visible.count,
                overflow: limits.overflow(),
                visible: &forward.visible.list,
                grad_mean: &backward.grad_mean,
                tiles: forward.bin.tiles(),
                opacity: &forward.decode.opacity,
                size: camera.size,
            };
            rec.stage(stage::STATISTICS);
            statistics.record(rec, drawn);
        }
        self.optimize(rec, attended, step, rates);
    }

    /// Looks for values that are not finite in the first `count` of a tensor that every step looks at: the losses and the
    /// networks' gradients, into which every Gaussian's gradients are summed. Each comes where passes wait anyway.
    fn sentinel(&self, rec: &mut Recorder<'_>, tensor: Option<&Buffer<f32>>, count: u32) {
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
    fn watch(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32) {
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

    fn optimize(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32, rates: Rates) {
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

    /// Makes the stages that begin with this step and lets go of those whose time is over.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn prepare(&mut self, step: u32) -> Result<(), Error> {
        let config = &self.config.model.attention;
        if let Some(weights) = self.attention_weights.take_if(|_| step >= config.start) {
            let (seed, anchors) = (self.config.train.seed, self.anchors.capacity);
            let attend = || Attend::new(&self.gpu, config, seed, anchors, &weights);
            self.attend = Some(self.gpu.stage(stage::ATTENTION, attend)?);
        }
        let counting = self.plan.counted.is_some_and(|c| c.contain(step));
        if counting && self.statistics.is_none() {
            let (anchors, offsets) = (self.anchors.capacity, self.anchors.offsets);
            let touched = self.config.densify.count_touched;
            let statistics = || Statistics::new(&self.gpu, anchors, offsets, touched);
            self.statistics = Some(self.gpu.stage(stage::STATISTICS, statistics)?);
        } else if !counting {
            self.statistics = None;
        }
        Ok(())
    }

    /// Everything that is learnt, with its moments; the attention's projections from its first step on.
    pub fn parameters(&self) -> Vec<&Parameter> {
        let attention = self.attend.as_ref().map(|attend| &attend.weights);
        self.anchors.parameters().into_iter().chain([&self.weights]).chain(attention).collect()
    }

    /// The gradients of the last recorded step by PyTorch's names, of what is trained: for tests.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn gradients(&self) -> Result<std::collections::BTreeMap<String, Vec<f32>>, Error> {
        let mut all = std::collections::BTreeMap::new();
        let n = self.anchors.count as usize;
        let gradients = &self.stages().gradients;
        for (name, buffer, width) in [
            ("feature", gradients.feature.as_ref(), 32),
            ("offset", gradients.offset.as_ref(), 3 * self.anchors.offsets as usize),
            ("log_scaling", gradients.log_scaling.as_ref(), 6),
        ] {
            if let Some(buffer) = buffer {
                all.insert(name.to_owned(), self.gpu.read_range(buffer, n * width)?);
            }
        }
        let layout = Layout { offsets: self.anchors.offsets as usize };
        let Some(weights) = &gradients.weights else { return Ok(all) };
        let flat = self.gpu.read_range(weights, layout.weights())?;
        let attention = self
            .attend
            .as_ref()
            .map(|attend| self.gpu.read_range(&attend.grad_weights, crate::math::attention::WEIGHTS));
        let attention = attention.transpose()?;
        let weights = files::Weights::from_device(self.anchors.offsets as usize, &flat, attention.as_deref());
        all.extend(weights.tensors.into_iter().map(|(name, tensor)| (name, tensor.data)));
        Ok(all)
    }

    /// The rendered colour, and depth where the plan has it, of the last step.
    pub fn picture(&self, size: [u32; 2]) -> &Picture {
        &self.canvas(size).picture
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn model(&self) -> Result<(files::Anchors, files::Weights), Error> {
        let layout = Layout { offsets: self.anchors.offsets as usize };
        let flat = self.gpu.read_range(&self.weights.value, layout.weights())?;
        let attention = match (&self.attend, &self.attention_weights) {
            (Some(attend), _) => Some(self.gpu.read_range(&attend.weights.value, crate::math::attention::WEIGHTS)?),
            (None, initial) => initial.clone(),
        };
        let weights = files::Weights::from_device(layout.offsets, &flat, attention.as_deref());
        Ok((self.anchors.read(&self.gpu)?, weights))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// GScream's published rates, for a scene of radius 2.5.
    #[test]
    fn rates_of_all_groups() {
        let settings = Settings::default();
        let mut table = String::from("step");
        for name in ["feature", "offset", "log_scaling", "mlp_opacity", "mlp_color", "mlp_cov", "attention"] {
            table += &format!(" {name:>16}");
        }
        for step in [0, 1, 1500, 15_000, 30_000, 40_000] {
            let Rates { feature, offset, log_scaling, decoders: [opacity, color, cov], attention } =
                Rates::at(&settings, 2.5, step);
            table += &format!("\n{step}");
            for rate in [feature, offset, log_scaling, opacity, color, cov, attention] {
                table += &format!(" {rate:>16.10e}");
            }
        }
        insta::assert_snapshot!(table);
    }

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

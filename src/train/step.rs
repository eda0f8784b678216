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
use crate::primitives::limit::Limits;

use crate::render::decode::{self, AnchorGradients, DecodeBackward, GaussianGradients};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Picture, PictureGradient};
use crate::render::view::{Capacity, Forward};
use crate::render::{Config, Method};
use crate::scene::{Camera, PriorKind};

use super::attend::{Attend, Attended};
use super::order::{Stream, random};
use super::photographs::Photograph;
use super::plan::Plan;

/// Where the model's gradients go, zeroed at the beginning of every step.
struct Gradients {
    feature: Buffer<f32>,
    offset: Buffer<f32>,
    log_scaling: Buffer<f32>,
    weights: Buffer<f32>,
}

impl Gradients {
    fn new(gpu: &Gpu, anchors: &Anchors, weights: &Parameter) -> Result<Self, Error> {
        Ok(Self {
            feature: gpu.buffer("grad_feature", anchors.feature.value.len())?,
            offset: gpu.buffer("grad_offset", anchors.offset.value.len())?,
            log_scaling: gpu.buffer("grad_log_scaling", anchors.log_scaling.value.len())?,
            weights: gpu.buffer("grad_weights", weights.value.len())?,
        })
    }
}

/// The stages between the anchors and the picture, both ways.
struct Stages {
    forward: Forward,
    rasterize: Backward,
    project: ProjectBackward,
    decode: DecodeBackward,
}

impl Stages {
    fn new(gpu: &Gpu, plan: &Plan, capacity: Capacity, offsets: u32, config: &Config) -> Result<Self, Error> {
        let method = Method::new(gpu, config)?;
        let forward = Forward::new(gpu, capacity, offsets, method, plan.largest(), config.cull)?;
        let slots = (capacity.visible * offsets) as usize;
        Ok(Self {
            rasterize: Backward::new(gpu, slots, capacity.pairs as usize, plan.outputs())?,
            project: ProjectBackward::new(gpu, &forward.project)?,
            decode: DecodeBackward::new(gpu, &forward.decode)?,
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
            Ok(Self {
                picture: Picture::new(gpu, size, pixels, plan.outputs())?,
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
    gradients: Gradients,
    stages: Stages,
    canvases: Vec<Canvas>,
    statistics: Option<Statistics>,
    voxel: f64,
    attend: Option<Attend>,
    attention_weights: Option<Vec<f32>>,
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
        let anchors = Anchors::upload(gpu, anchors, 0)?;
        let initial = weights;
        let flat = initial.decoders();
        let weights = Parameter::new(gpu, WEIGHTS, flat.len() as u32, 1)?;
        gpu.write(&weights.value, &flat)?;
        let mut rec = gpu.recorder()?;
        rec.zero(&weights.first);
        rec.zero(&weights.root);
        rec.submit()?.wait()?;
        let capacity = Capacity::guess(anchors.capacity);
        let stages = Stages::new(gpu, &plan, capacity, anchors.offsets, &settings.render)?;
        let canvases = Canvas::all(gpu, &plan, settings)?;
        Ok(Self {
            gradients: Gradients::new(gpu, &anchors, &weights)?,
            limits: Limits::new(gpu)?,
            gpu: gpu.clone(),
            anchors,
            weights,
            capacity,
            stages,
            canvases,
            statistics: None,
            voxel,
            attend: None,
            attention_weights: plan.attention.then(|| initial.attention()),
            adam: adam::Config {
                beta1: settings.optimizer.betas[0],
                beta2: settings.optimizer.betas[1],
                epsilon: settings.optimizer.epsilon,
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
        let config = &self.config.render;
        let smallest = Capacity { anchors: 1, visible: 1, pairs: 1 };
        self.stages = Stages::new(&self.gpu, &self.plan, smallest, self.anchors.offsets, config)?;
        self.stages = Stages::new(&self.gpu, &self.plan, capacity, self.anchors.offsets, config)?;
        self.gradients = Gradients::new(&self.gpu, &self.anchors, &self.weights)?;
        if let Some(attend) = &mut self.attend {
            attend.resize(&self.gpu, self.anchors.capacity)?;
        }
        self.capacity = capacity;
        Ok(())
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
        let config = &self.config.densify;
        self.plan.growth && (config.from..=config.until).contains(&step) && step.is_multiple_of(config.every)
    }

    /// Grows and prunes anchors behind this step, with nothing in flight; says what changed.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn change_anchors(&mut self, step: u32) -> Result<String, Error> {
        let Some(statistics) = &mut self.statistics else { return Ok(String::new()) };
        let config = &self.config.densify;
        let round = densify::Round { voxel: self.voxel as f32, seed: self.config.train.seed, step };
        let before = self.anchors.count;
        let grown = densify::grow::run(&self.gpu, &mut self.anchors, statistics, config, round)?;
        let pruned = densify::prune::run(&self.gpu, &mut self.anchors, statistics, config)?;
        if self.anchors.capacity != self.capacity.anchors {
            self.resize(Capacity { anchors: self.anchors.capacity, ..self.capacity })?;
        }
        let mut text =
            format!("step {step}: {} new anchors, {pruned} pruned: {before} -> {}", grown.added, self.anchors.count);
        if grown.refused > 0 {
            text.push_str(&format!(
                "; {} more had no room (densify.max_anchors, or the device's memory)",
                grown.refused
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
        self.line(rec, &photograph.camera, Some(photograph), step, rates, |rec, canvas| {
            let Canvas { picture, losses } = canvas;
            losses.forward_backward(rec, &view, &picture.rgb, picture.depth.as_ref().map(|d| &d.0))
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
        self.line(rec, camera, None, step, rates, |rec, canvas| {
            let Canvas { picture, losses } = canvas;
            losses.compare(rec, depth, &picture.rgb, picture.depth.as_ref().map(|d| &d.0))
        });
    }

    /// How a photograph counts in a step.
    fn view<'p>(&self, photograph: &'p Photograph, step: u32) -> View<'p> {
        let config = &self.config.losses;
        let (reference, near) = (photograph.reference, self.near);
        let inside = |on_reference: f64| if reference { on_reference as f32 } else { 0.0 };
        let depth = photograph.prior.as_ref().map(|(kind, prior)| {
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
            }
        });
        let weights = Weights { outside: 1.0, inside: inside(config.reference_inside_weight) };
        View { picture: &photograph.picture, weights, depth }
    }

    /// The straight line of one step.
    fn line<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        camera: &Camera,
        photograph: Option<&Photograph>,
        step: u32,
        rates: Rates,
        compare: impl FnOnce(&mut Recorder<'_>, &'s Canvas) -> losses::Gradients<'s>,
    ) {
        let Self { anchors, gradients, limits, near, .. } = self;
        let Stages { forward, rasterize: backward, project: project_backward, decode: decode_backward } = &self.stages;
        let canvas = self.canvas(camera.size);
        let picture = &canvas.picture;
        for gradient in [&gradients.feature, &gradients.offset, &gradients.log_scaling] {
            rec.zero(gradient);
        }
        forward.visible.record(rec, anchors, camera, *near, limits);
        // A step may be recorded again after later ones: the stage is there then, but its time has not come.
        let attend = self.attend.as_ref().filter(|_| step >= self.config.model.attention.start);
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
        forward.decode.record(rec, model, &forward.visible.count, camera.center());
        forward.project.record(rec, &forward.visible.slots, forward.gaussians(), camera, *near);
        let binned = forward.bin.record(rec, forward.projected(), camera.size, limits);
        rasterize::forward(rec, forward.method(), forward.projected(), binned, self.background, picture);

        let gradient = compare(rec, canvas);

        let gradient = PictureGradient { rgb: gradient.rgb, depth: gradient.depth, transmittance: None };
        backward.record(rec, forward.method(), forward.projected(), binned, picture, gradient);
        let splats = SplatGradients {
            mean: &backward.grad_mean,
            covariance: &backward.grad_covariance,
            depth: gradient.depth.and(backward.grad_depth.as_ref()),
        };
        let slots = &forward.visible.slots;
        project_backward.record(rec, &forward.project, slots, forward.gaussians(), splats, camera, *near);
        let gaussians = GaussianGradients {
            position: &project_backward.grad_position,
            opacity: &backward.grad_opacity,
            color: &backward.grad_color,
            scale: &project_backward.grad_scale,
            rotation: &project_backward.grad_rotation,
        };
        let to = AnchorGradients {
            feature: &gradients.feature,
            offset: &gradients.offset.view(),
            log_scaling: &gradients.log_scaling,
            weights: &gradients.weights,
        };
        decode_backward.record(rec, &forward.decode, model, gaussians, to);
        if let Some(statistics) = &self.statistics {
            let drawn = Drawn {
                slots,
                overflow: limits.overflow(),
                visible: &forward.visible.list,
                grad_mean: &backward.grad_mean,
                tiles: forward.bin.tiles(),
                opacity: &forward.decode.opacity,
                size: camera.size,
            };
            statistics.record(rec, drawn);
        }
        if let Some((attend, attended)) = self.attend.as_ref().zip(attended) {
            attend.backward(rec, attended, &gradients.feature);
        }
        self.optimize(rec, attended, step, rates);
    }

    fn optimize(&self, rec: &mut Recorder<'_>, attended: Option<Attended<'_>>, step: u32, rates: Rates) {
        let Self { anchors, weights, gradients, .. } = self;
        let overflow = self.limits.overflow();
        // Before the optimiser, which goes on from the features that were decoded.
        let attention = self.attend.as_ref().zip(attended);
        let attention =
            attention.map(|(attend, attended)| (attend, attend.write_back(rec, attended, anchors, overflow)));
        let mut update = |parameter: &Parameter, gradient: &Buffer<f32>, range: (u32, u32), rate: f64| {
            if rate == 0.0 {
                return;
            }
            let tensors = Tensors { value: &parameter.value, gradient, first: &parameter.first, root: &parameter.root };
            adam::record(rec, &self.adam, tensors, overflow, range, (step, rate));
        };
        let all = |parameter: &Parameter| (0, anchors.count * parameter.width);
        update(&anchors.feature, &gradients.feature, all(&anchors.feature), rates.feature);
        update(&anchors.offset, &gradients.offset, all(&anchors.offset), rates.offset);
        update(&anchors.log_scaling, &gradients.log_scaling, all(&anchors.log_scaling), rates.log_scaling);
        let layout = Layout { offsets: anchors.offsets as usize };
        for (head, rate) in rates.decoders.into_iter().enumerate() {
            let first = layout.head(head);
            update(weights, &gradients.weights, (first as u32, (layout.head(head + 1) - first) as u32), rate);
        }
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
            let attend = Attend::new(&self.gpu, config, self.config.train.seed, self.anchors.capacity, &weights)?;
            self.attend = Some(attend);
        }
        let config = &self.config.densify;
        let counting = self.plan.growth && (config.statistics_from..=config.until).contains(&step);
        if counting && self.statistics.is_none() {
            self.statistics = Some(Statistics::new(&self.gpu, self.anchors.capacity, self.anchors.offsets)?);
        } else if !counting {
            self.statistics = None;
        }
        Ok(())
    }

    /// The gradients of the last recorded step by PyTorch's names: for tests.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn gradients(&self) -> Result<std::collections::BTreeMap<String, Vec<f32>>, Error> {
        let mut all = std::collections::BTreeMap::new();
        let n = self.anchors.count as usize;
        for (name, buffer, width) in [
            ("feature", &self.gradients.feature, 32),
            ("offset", &self.gradients.offset, 3 * self.anchors.offsets as usize),
            ("log_scaling", &self.gradients.log_scaling, 6),
        ] {
            all.insert(name.to_owned(), self.gpu.read_range(buffer, n * width)?);
        }
        let layout = Layout { offsets: self.anchors.offsets as usize };
        let flat = self.gpu.read_range(&self.gradients.weights, layout.weights())?;
        let weights = files::Weights::from_device(self.anchors.offsets as usize, &flat, None);
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

//! One training step, as one straight line: `Step::line`. Beside it: learning rates, how a view counts, what changes the
//! model behind a step, and what draws and reads it.

mod growth;
mod rates;
mod read;
mod update;
mod weights;

pub use rates::Rates;

use crate::config::Settings;
use crate::densify::{Drawn, Statistics};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::losses::{self, DepthView, Losses, View};
use crate::math::decoder::Layout;
use crate::model::anchors::Anchors;
use crate::model::files;
use crate::model::gaussians::{Cloud, Static};
use crate::model::learnt::Learnt;
use crate::model::parameter::{DECODERS, Parameter, Part, WEIGHTS};
use crate::optimizer::{BETAS, Group, adam};
use crate::primitives::limit::{Counter, Limits};
use crate::render::activate::{self, Activate, DrawnGradients};
use crate::render::config::BACKGROUND;
use crate::render::decode::{self, Decode, DecodeBackward, GaussianGradients, WantedGradients};
use crate::render::forward::{Capacity, Forward, Front, Model};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Picture, PictureGradient};
use crate::render::visible::Visible;
use crate::render::{Config, Method};
use crate::scene::Camera;
use crate::stage;

use super::attend::{Attend, Attended};
use super::photographs::Photograph;
use super::plan::Plan;

/// The stages between the model and the picture, both ways.
struct Stages {
    forward: Forward,
    rasterize: Backward,
    project: ProjectBackward,
    /// Stages of anchors.
    decode: Option<DecodeBackward>,
}

impl Stages {
    fn new(gpu: &Gpu, plan: &Plan, capacity: Capacity, model: Model<'_>, config: &Config) -> Result<Self, Error> {
        let [feature, decoders] = [&[Group::Feature][..], &DECODERS].map(|groups| plan.trained.any(groups.to_vec()));
        let method = Method::new(gpu, config);
        let forward = Forward::of(gpu, capacity, model, method, plan.largest(), config.cull)?;
        let slots = match model {
            Model::Anchors { anchors, .. } => (capacity.visible * anchors.offsets) as usize,
            Model::Gaussians(gaussians) => gaussians.count as usize,
        };
        let decode = match &forward.front {
            Front::Anchors { decode, .. } => Some(decode),
            Front::Gaussians { .. } => None,
        };
        let pairs = capacity.pairs as usize;
        Ok(Self {
            rasterize: gpu
                .stage(stage::RASTERIZE_BACKWARD, || Backward::new(gpu, method, slots, pairs, plan.outputs()))?,
            project: gpu.stage(stage::PROJECT_BACKWARD, || ProjectBackward::new(gpu, &forward.project))?,
            decode: decode
                .map(|decode| gpu.stage(stage::DECODE_BACKWARD, || DecodeBackward::of(gpu, decode, feature, decoders)))
                .transpose()?,
            forward,
        })
    }
}

/// The Gaussians that a step draws, with what its way back needs.
enum Drawable<'a> {
    Anchors {
        anchors: &'a Anchors,
        weights: &'a Parameter,
        visible: &'a Visible,
        decode: &'a Decode,
        feature: &'a Buffer<f32>,
        attended: Option<Attended<'a>>,
    },
    Gaussians {
        gaussians: &'a Static,
        activate: &'a Activate,
    },
}

/// Anchors as the decoder reads them.
fn anchors_of<'a>(
    anchors: &'a Anchors,
    weights: &'a Parameter,
    feature: &'a Buffer<f32>,
    offset: &'a Buffer<[f32; 3]>,
    visible: &'a Visible,
) -> decode::Anchors<'a> {
    decode::Anchors {
        position: &anchors.position,
        feature,
        offset,
        log_scaling: &anchors.log_scaling().value,
        weights: &weights.value,
        visible: &visible.list,
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

/// The model on the device and the stages that change it.
pub struct Step {
    gpu: Gpu,
    /// The plan the stages were made for.
    pub plan: Plan,
    /// The learnt arrays, but for the attention's.
    pub learnt: Learnt,
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
}

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
        let weights = gpu.stage(stage::MODEL, || Parameter::upload(gpu, WEIGHTS, flat.len() as u32, 1, &flat))?;
        let layout = Layout { offsets: anchors.offsets as usize };
        let parts = DECODERS.iter().enumerate();
        let weights = weights.in_parts(parts.map(|(head, &group)| Part { group, first: layout.head(head) as u32 }));
        let capacity = Capacity::guess(anchors.capacity);
        let attention_weights = plan.attention.then(|| initial.attention());
        let learnt = Learnt::Anchors { anchors, weights };
        Self::with(gpu, plan, settings, learnt, capacity, voxel, attention_weights)
    }

    /// Uploads plain Gaussians, with room for as many as the settings allow where the plan has growth, and makes the stages
    /// that the plan has.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn of_gaussians(gpu: &Gpu, plan: Plan, settings: &Settings, cloud: &Cloud) -> Result<Self, Error> {
        let room = if plan.growth { settings.densify.max_gaussians.min(Static::most(gpu, cloud.degree)) } else { 0 };
        let higher = settings.optimizer.higher_harmonics as f32;
        let gaussians = gpu.stage(stage::MODEL, || Static::with_room(gpu, cloud, room, higher))?;
        let capacity = Capacity { visible: gaussians.capacity, ..Capacity::guess(gaussians.capacity) };
        Self::with(gpu, plan, settings, Learnt::Gaussians(gaussians), capacity, 0.0, None)
    }

    fn with(
        gpu: &Gpu,
        plan: Plan,
        settings: &Settings,
        learnt: Learnt,
        capacity: Capacity,
        voxel: f64,
        attention_weights: Option<Vec<f32>>,
    ) -> Result<Self, Error> {
        let canvases = Canvas::all(gpu, &plan, settings)?;
        let mut step = Self {
            limits: Limits::new(gpu)?,
            gpu: gpu.clone(),
            learnt,
            capacity,
            stages: None,
            canvases,
            statistics: None,
            voxel,
            attend: None,
            attention_weights,
            adam: adam::Config { beta1: BETAS[0], beta2: BETAS[1], epsilon: settings.optimizer.epsilon },
            near: settings.render.near as f32,
            config: settings.clone(),
            plan,
        };
        step.furnish()?;
        Ok(step)
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
        for parameter in self.learnt.parameters_mut() {
            parameter.gradient = None;
        }
        if let Some(attend) = &mut self.attend {
            attend.release();
        }
    }

    /// Takes it again, for the model there is now.
    fn furnish(&mut self) -> Result<(), Error> {
        self.capacity.anchors = self.learnt.capacity();
        self.stages = Some(Stages::new(&self.gpu, &self.plan, self.capacity, self.model_view(), &self.config.render)?);
        let Self { gpu, plan, learnt, .. } = self;
        // The way back to plain Gaussians writes all of their gradients.
        let whole = matches!(learnt, Learnt::Gaussians(_));
        let rows = learnt.capacity();
        for parameter in learnt.parameters_mut() {
            if whole || plan.trained.any(parameter.groups()) {
                gpu.stage(stage::DECODE_BACKWARD, || parameter.make_gradient(gpu))?;
            }
        }
        if let Some(attend) = &mut self.attend {
            gpu.stage(stage::ATTENTION, || attend.furnish(gpu, rows))?;
        }
        Ok(())
    }

    /// Goes on under settings and a plan that differ in when things happen alone.
    pub fn reschedule(&mut self, settings: Settings, plan: &Plan) {
        self.config = settings;
        let Plan { rounds, counted, iterations, .. } = *plan;
        (self.plan.rounds, self.plan.counted, self.plan.iterations) = (rounds, counted, iterations);
    }

    /// The anchors.
    ///
    /// # Panics
    /// For a step of plain Gaussians.
    pub fn anchors(&self) -> &Anchors {
        match &self.learnt {
            Learnt::Anchors { anchors, .. } => anchors,
            Learnt::Gaussians(_) => panic!("plain Gaussians have no anchors"),
        }
    }

    /// The model as the forward stages read it.
    pub(super) fn model_view(&self) -> Model<'_> {
        match &self.learnt {
            Learnt::Anchors { anchors, weights } => Model::Anchors { anchors, weights: &weights.value },
            Learnt::Gaussians(gaussians) => Model::Gaussians(gaussians),
        }
    }

    fn stages(&self) -> &Stages {
        self.stages.as_ref().expect("the stages are away only within a call")
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
        let view = self.view(photograph);
        let compared = (&photograph.camera, view.depth);
        rec.overlapped(|rec| self.line(rec, compared, Some((photograph, &view)), step, rates));
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
        rec.overlapped(|rec| self.line(rec, (camera, depth), None, step, rates));
    }

    /// The straight line of one step. Without a photograph it has no attention, and the losses' frame holds its arrays already.
    fn line(
        &self,
        rec: &mut Recorder<'_>,
        (camera, depth): (&Camera, Option<DepthView<'_>>),
        photographed: Option<(&Photograph, &View<'_>)>,
        step: u32,
        rates: Rates,
    ) {
        let Self { learnt, limits, near, .. } = self;
        let Stages { forward, rasterize: backward, project: project_backward, decode: decode_backward } = self.stages();
        let canvas = self.canvas(camera.size);
        // Depth is drawn for views alone whose depth is compared.
        let color_alone = canvas.picture.color();
        let picture = if depth.is_some() { &canvas.picture } else { &color_alone };
        rec.stage(stage::DECODE_BACKWARD);
        let front = match (learnt, &forward.front) {
            (Learnt::Anchors { anchors, weights }, Front::Anchors { visible, decode }) => {
                // Rows of anchors that are not drawn are not written.
                for gradient in anchors.parameters().iter().filter_map(|parameter| parameter.gradient.as_ref()) {
                    rec.zero(gradient);
                }
                rec.stage(stage::CULL);
                visible.record(rec, anchors, camera, *near, limits);
                // A step may be recorded again after later ones: the stage is there then, but its time has not come.
                let attend = self.attend.as_ref().filter(|_| step >= self.config.model.attention.start);
                rec.stage(stage::ATTENTION);
                let (feature, attended) = match attend.zip(photographed) {
                    Some((attend, (photograph, _))) => attend.forward(rec, anchors, visible, photograph, *near, step),
                    None => (&anchors.feature().value, None),
                };
                let offset = anchors.offset().value.view();
                rec.stage(stage::DECODE);
                let model = anchors_of(anchors, weights, feature, &offset, visible);
                decode.record(rec, model, &visible.count, camera.center());
                Drawable::Anchors { anchors, weights, visible, decode, feature, attended }
            }
            (Learnt::Gaussians(gaussians), Front::Gaussians { activate, all, .. }) => {
                rec.stage(stage::DECODE);
                activate.record(rec, gaussians, camera.center());
                limits.note(rec, &all.count, Counter::Visible);
                Drawable::Gaussians { gaussians, activate }
            }
            _ => unreachable!("the stages were made for the model"),
        };
        rec.stage(stage::PROJECT);
        forward.project.record(rec, forward.existing(), forward.gaussians(), camera, *near);
        rec.stage(stage::BIN);
        let binned = forward.bin.record(rec, forward.projected(), camera.size, limits);
        rec.stage(stage::RASTERIZE);
        rasterize::forward(rec, forward.method(), forward.projected(), binned, BACKGROUND, picture);

        if let Some((_, view)) = photographed {
            canvas.losses.expand(rec, view);
        }
        let gradient = canvas.losses.compare(rec, depth, &canvas.picture.rgb, canvas.picture.depth.as_ref());
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
        rec.stage(stage::DECODE_BACKWARD);
        let attended = match front {
            Drawable::Anchors { anchors, weights, visible, decode, feature, attended } => {
                let gaussians = GaussianGradients {
                    drawn: binned.tiles,
                    position: &project_backward.grad_position,
                    opacity: &backward.grad_opacity,
                    color: &backward.grad_color,
                    scale: &project_backward.grad_scale,
                    rotation: &project_backward.grad_rotation,
                };
                let (offset, grad_offset) =
                    (anchors.offset().value.view(), anchors.offset().gradient.as_ref().map(Buffer::view));
                let to = WantedGradients {
                    feature: anchors.feature().gradient.as_ref(),
                    offset: grad_offset.as_ref(),
                    log_scaling: anchors.log_scaling().gradient.as_ref(),
                    weights: weights.gradient.as_ref(),
                };
                let model = anchors_of(anchors, weights, feature, &offset, visible);
                if let Some(decode_backward) = decode_backward {
                    decode_backward.record(rec, decode, model, gaussians, to);
                }
                self.sentinel(rec, to.weights, weights.width);
                rec.stage(stage::ATTENTION);
                if let Some(((attend, attended), grad_feature)) = self.attend.as_ref().zip(attended).zip(to.feature) {
                    attend.backward(rec, attended, grad_feature);
                }
                attended
            }
            Drawable::Gaussians { gaussians, activate } => {
                let gradients = DrawnGradients {
                    drawn: binned.drawn,
                    seen: &project_backward.grad_position,
                    scale: &project_backward.grad_scale,
                    rotation: &project_backward.grad_rotation,
                    opacity: &backward.grad_opacity,
                    color: &backward.grad_color,
                };
                activate::backward(rec, gaussians, activate, gradients);
                None
            }
        };
        // Whatever changes the model or is gathered for it comes behind: it obeys the flag.
        self.watch(rec, attended, step);
        if let Some(statistics) = &self.statistics {
            let drawn = Drawn {
                visible_count: &forward.visible().count,
                overflow: limits.overflow(),
                visible: &forward.visible().list,
                grad_mean: &backward.grad_mean,
                tiles: forward.bin.tiles(),
                opacity: &forward.decode().opacity,
                size: camera.size,
            };
            rec.stage(stage::STATISTICS);
            statistics.record(rec, drawn);
        }
        self.optimize(rec, attended, step, rates);
    }

    /// Makes the stages that begin with this step and lets go of those whose time is over.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn prepare(&mut self, step: u32) -> Result<(), Error> {
        let config = &self.config.model.attention;
        if let Some(weights) = self.attention_weights.take_if(|_| step >= config.start) {
            let (seed, anchors) = (self.config.train.seed, self.learnt.capacity());
            let attend = || Attend::new(&self.gpu, config, seed, anchors, &weights);
            self.attend = Some(self.gpu.stage(stage::ATTENTION, attend)?);
        }
        let counting = self.plan.counted.is_some_and(|c| c.contain(step));
        if counting && self.statistics.is_none() {
            let (anchors, offsets) = (self.learnt.capacity(), self.learnt.offsets());
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
        self.learnt.rows().into_iter().chain(self.networks()).collect()
    }

    /// The networks' parameters: a row each, every gradient written in every step.
    pub(super) fn networks(&self) -> impl Iterator<Item = &Parameter> {
        self.learnt.weights().into_iter().chain(self.attend.as_ref().map(|attend| &attend.weights))
    }
}

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
use crate::model::anchors::Anchors;
use crate::model::files::Weights;
use crate::model::parameter::{DECODERS, Parameter};
use crate::optimizer::{BETAS, Group, adam};
use crate::primitives::limit::Limits;
use crate::render::config::BACKGROUND;
use crate::render::decode::{DecodeBackward, GaussianGradients};
use crate::render::forward::{Capacity, Forward};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Picture, PictureGradient};
use crate::render::{Config, Method};
use crate::representation::{self, Representation};
use crate::scene::Camera;
use crate::stage;

use super::attend::Attend;
use super::begin::Beginning;
use super::photographs::Photograph;
use super::plan::Plan;

/// The stages between the model and the picture, both ways.
struct Stages {
    forward: Forward,
    rasterize: Backward,
    project: ProjectBackward,
    scratch: Option<DecodeBackward>,
}

impl Stages {
    fn new(
        gpu: &Gpu,
        plan: &Plan,
        capacity: Capacity,
        model: &dyn Representation,
        config: &Config,
    ) -> Result<Self, Error> {
        let wanted = [&[Group::Feature][..], &DECODERS].map(|groups| plan.trained.any(groups.to_vec()));
        let method = Method::new(gpu, config);
        let forward = Forward::new(gpu, capacity, model, method, plan.largest(), config.cull)?;
        let (slots, pairs) = (forward.slots as usize, capacity.pairs as usize);
        Ok(Self {
            rasterize: gpu
                .stage(stage::RASTERIZE_BACKWARD, || Backward::new(gpu, method, slots, pairs, plan.outputs()))?,
            project: gpu.stage(stage::PROJECT_BACKWARD, || ProjectBackward::new(gpu, slots))?,
            scratch: model.scratch(gpu, &forward.front, wanted)?,
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

/// The model on the device and the stages that change it.
pub struct Step {
    gpu: Gpu,
    /// The plan the stages were made for.
    pub plan: Plan,
    /// The learnt arrays, but for the attention's.
    pub learnt: Box<dyn Representation>,
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
    /// Uploads what a run begins with, and makes the stages that the plan has.
    ///
    /// # Errors
    /// When the device has no room.
    pub fn new(gpu: &Gpu, plan: Plan, settings: &Settings, from: &Beginning) -> Result<Self, Error> {
        let Beginning { model, voxel, rows } = from;
        let higher = settings.optimizer.higher_harmonics as f32;
        let learnt = gpu.stage(stage::MODEL, || representation::upload(gpu, model, *rows, higher))?;
        let mut step = Self {
            limits: Limits::new(gpu)?,
            gpu: gpu.clone(),
            capacity: Capacity::guess(learnt.capacity()),
            learnt,
            stages: None,
            canvases: Canvas::all(gpu, &plan, settings)?,
            statistics: None,
            voxel: *voxel,
            attend: None,
            attention_weights: model.weights().filter(|_| plan.attention).map(Weights::attention),
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
        self.stages = Some(Stages::new(&self.gpu, &self.plan, self.capacity, &*self.learnt, &self.config.render)?);
        let Self { gpu, plan, learnt, .. } = self;
        let rows = learnt.capacity();
        for parameter in learnt.parameters_mut() {
            if plan.trained.any(parameter.groups()) {
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
        self.learnt.anchors().expect("plain Gaussians have no anchors")
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
        let Stages { forward, rasterize: backward, project: project_backward, scratch } = self.stages();
        let front = &forward.front;
        let canvas = self.canvas(camera.size);
        // Depth is drawn for views alone whose depth is compared.
        let color_alone = canvas.picture.color();
        let picture = if depth.is_some() { &canvas.picture } else { &color_alone };
        rec.stage(stage::DECODE_BACKWARD);
        // Rows that are not drawn are not written.
        learnt.rows().into_iter().filter_map(|row| row.gradient.as_ref()).for_each(|gradient| rec.zero(gradient));
        rec.stage(stage::CULL);
        learnt.cull(rec, front, camera, *near, limits);
        rec.stage(stage::ATTENTION);
        // A step may be recorded again after later ones: the stage is there then, but its time has not come.
        let attend = self.attend.as_ref().filter(|_| step >= self.config.model.attention.start);
        let attended = attend.zip(photographed).and_then(|(attend, (photograph, _))| {
            attend.forward(rec, self.anchors(), forward.visible(), photograph, *near, step)
        });
        let feature = attended.map(|attended| attended.feature);
        rec.stage(stage::DECODE);
        learnt.decode(rec, front, feature, camera, limits);
        rec.stage(stage::PROJECT);
        forward.project(rec, camera, *near);
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
        forward.uncompensate(rec, binned.drawn, &backward.grad_covariance, &backward.grad_opacity);
        project_backward.record(rec, binned.drawn, forward.gaussians(), splats, camera, *near);
        rec.stage(stage::DECODE_BACKWARD);
        let gradients = GaussianGradients {
            drawn: binned.tiles,
            position: &project_backward.grad_position,
            opacity: &backward.grad_opacity,
            color: &backward.grad_color,
            scale: &project_backward.grad_scale,
            rotation: &project_backward.grad_rotation,
        };
        learnt.backward(rec, (front, scratch.as_ref()), feature, binned.drawn, gradients);
        if let Some(weights) = learnt.weights() {
            self.sentinel(rec, weights.gradient.as_ref(), weights.width);
        }
        rec.stage(stage::ATTENTION);
        if let Some((attend, attended)) = self.attend.as_ref().zip(attended) {
            attend.backward(rec, attended, self.anchors());
        }
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

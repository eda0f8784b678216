//! Static Gaussians drawn, compared and improved: the training step's own stages.

use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::losses::{self, Losses, View, Weights};
use crate::model::gaussians::Static;
use crate::optimizer::adam::{self, Tensors};
use crate::primitives::limit::{Counter, Limits};
use crate::render::bin::Binned;
use crate::render::decode::GaussianGradients;
use crate::render::forward::{Capacity, Forward, Representation as _};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use crate::render::{Config, Method};
use crate::scene::Camera;

/// Learning rates of a step, in the order of [`Static::parameters`].
pub type Rates = [f64; 5];

/// (Gaussian, tile) pairs there is room for at first; overflow corrects it.
const PAIRS: u32 = 1 << 17;

struct Stages {
    forward: Forward,
    rasterize: Backward,
    project: ProjectBackward,
}

/// What depends on the pictures' size.
struct Canvas {
    picture: Picture,
    losses: Losses,
    target: Buffer<u32>,
    ones: Buffer<[f32; 3]>,
}

impl Canvas {
    fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Self, Error> {
        let pixels = size[0] as usize * size[1] as usize;
        let plan = losses::Plan {
            size,
            ssim_weight: SSIM_WEIGHT,
            masks: false,
            ssim_across_masks: false,
            depth: false,
            gradient_scales: 0,
        };
        Ok(Self {
            picture: Picture::new(gpu, size, pixels, Outputs::Color)?,
            losses: Losses::new(gpu, &plan)?,
            target: gpu.buffer("picture", pixels)?,
            ones: gpu.upload("ones", &vec![[1.0; 3]; pixels])?,
        })
    }
}

/// Share of 1 - SSIM in the loss, as in training.
const SSIM_WEIGHT: f32 = 0.2;

/// Draws static Gaussians.
pub struct Drawer {
    gpu: Gpu,
    config: Config,
    background: [f32; 3],
    limits: Limits,
    pairs: u32,
    /// The Gaussians.
    pub gaussians: Static,
    stages: Option<Stages>,
    canvas: Option<Canvas>,
}

impl Drawer {
    /// Of these Gaussians. `background` is what shines through, linear rgb.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, gaussians: Static, config: &Config, background: [f32; 3]) -> Result<Self, Error> {
        Ok(Self {
            gpu: gpu.clone(),
            config: config.clone(),
            background,
            limits: Limits::new(gpu)?,
            pairs: PAIRS,
            gaussians,
            stages: None,
            canvas: None,
        })
    }

    /// The picture \[pixel\] from a camera.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    pub fn draw(&mut self, camera: &Camera) -> Result<Vec<[f32; 3]>, Error> {
        self.run(camera, |drawer, rec, stages, canvas| {
            drawer.forward(rec, stages, canvas, camera);
        })?;
        self.gpu.read(&self.canvas.as_ref().expect("made by the run").picture.rgb)
    }

    /// The sum of alpha x transmittance of every Gaussian over the pixels of a view: the colour's own gradient where the
    /// picture's is 1.
    ///
    /// # Errors
    /// As [`Drawer::draw`].
    pub fn contributions(&mut self, camera: &Camera) -> Result<Vec<f32>, Error> {
        self.run(camera, |drawer, rec, stages, canvas| {
            let binned = drawer.forward(rec, stages, canvas, camera);
            let gradient = PictureGradient { rgb: &canvas.ones, depth: None, transmittance: None };
            let Stages { forward, rasterize, .. } = stages;
            rasterize.record(rec, forward.method(), forward.projected(), binned, &canvas.picture, gradient);
        })?;
        let stages = self.stages.as_ref().expect("made by the run");
        let tiles = self.gpu.read(stages.forward.bin.tiles())?;
        let shares = self.gpu.read(&stages.rasterize.grad_color)?;
        Ok(tiles.iter().zip(shares).map(|(tiles, share)| if *tiles > 0 { share[0] } else { 0.0 }).collect())
    }

    /// One step of Adam (counted from 1) towards a picture \[pixel\] (see [`losses::pack`]); returns the loss before it.
    ///
    /// # Errors
    /// As [`Drawer::draw`].
    pub fn step(&mut self, camera: &Camera, target: &[u32], step: u32, rates: Rates) -> Result<f32, Error> {
        self.furnish(camera.size)?;
        self.gpu.write(&self.canvas.as_ref().expect("just made").target, target)?;
        self.run(camera, |drawer, rec, stages, canvas| {
            let binned = drawer.forward(rec, stages, canvas, camera);
            drawer.improve(rec, stages, canvas, binned, camera, (step, rates));
        })?;
        Ok(self.gpu.read(self.canvas.as_ref().expect("made by the run").losses.terms())?[0])
    }

    fn forward<'s>(
        &'s self,
        rec: &mut Recorder<'_>,
        Stages { forward, .. }: &'s Stages,
        canvas: &Canvas,
        camera: &Camera,
    ) -> Binned<'s> {
        let binned = forward.record(rec, &self.gaussians, camera, self.config.near as f32, &self.limits);
        rasterize::forward(rec, forward.method(), forward.projected(), binned, self.background, &canvas.picture);
        binned
    }

    fn improve(
        &self,
        rec: &mut Recorder<'_>,
        stages: &Stages,
        canvas: &Canvas,
        binned: Binned<'_>,
        camera: &Camera,
        (step, rates): (u32, Rates),
    ) {
        let Stages { forward, rasterize, project } = stages;
        let weights = Weights { outside: 1.0, inside: 1.0 };
        let view = View { picture: &canvas.target, weights, depth: None };
        let gradient = canvas.losses.forward_backward(rec, &view, &canvas.picture.rgb, None);
        let gradient = PictureGradient { rgb: gradient.rgb, depth: None, transmittance: None };
        rasterize.record(rec, forward.method(), forward.projected(), binned, &canvas.picture, gradient);
        let splats = SplatGradients { mean: &rasterize.grad_mean, covariance: &rasterize.grad_covariance, depth: None };
        project.record(rec, binned.drawn, forward.gaussians(), splats, camera, self.config.near as f32);
        let gradients = GaussianGradients {
            drawn: binned.tiles,
            position: &project.grad_position,
            opacity: &rasterize.grad_opacity,
            color: &rasterize.grad_color,
            scale: &project.grad_scale,
            rotation: &project.grad_rotation,
        };
        let gaussians = self.gaussians.parameters();
        gaussians.into_iter().filter_map(|row| row.gradient.as_ref()).for_each(|gradient| rec.zero(gradient));
        self.gaussians.backward(rec, (&forward.front, None), None, binned.drawn, gradients);
        let all = gaussians.into_iter().zip(rates).filter(|(_, rate)| *rate != 0.0);
        for (parameter, rate) in all {
            let Some(gradient) = &parameter.gradient else { continue };
            let tensors = Tensors { value: &parameter.value, gradient, first: &parameter.first, root: &parameter.root };
            let range = (0, self.gaussians.count * parameter.width);
            adam::record(rec, &adam::Config::default(), tensors, self.limits.overflow(), range, (step, rate));
        }
    }

    /// Makes what is missing for pictures of this size.
    fn furnish(&mut self, size: [u32; 2]) -> Result<(), Error> {
        let Self { gpu, config, pairs, gaussians, stages, canvas, .. } = self;
        if canvas.as_ref().is_none_or(|canvas| canvas.picture.size != size) {
            // Those of another size go before these are made: the tiles' lists are of that size as well.
            (*canvas, *stages) = (None, None);
            *canvas = Some(Canvas::new(gpu, size)?);
        }
        if stages.is_none() {
            for parameter in gaussians.parameters_mut() {
                parameter.make_gradient(gpu)?;
            }
            let capacity = Capacity { pairs: *pairs, ..Capacity::guess(gaussians.count) };
            let method = Method::new(gpu, config);
            let forward = Forward::new(gpu, capacity, gaussians, method, size, false)?;
            let (slots, pairs) = (forward.slots as usize, *pairs as usize);
            *stages = Some(Stages {
                rasterize: Backward::new(gpu, method, slots, pairs, Outputs::Color)?,
                project: ProjectBackward::new(gpu, &forward.project)?,
                forward,
            });
        }
        Ok(())
    }

    /// Records and runs `work`, again with more room where the pairs did not fit.
    fn run(&mut self, camera: &Camera, work: impl Fn(&Self, &mut Recorder<'_>, &Stages, &Canvas)) -> Result<(), Error> {
        let (gpu, limits) = (self.gpu.clone(), self.limits.share());
        limits.until_all_fits(&gpu, |counted| {
            if let Some(counted) = counted {
                let wanted = counted[Counter::Pairs as usize];
                self.pairs = wanted.saturating_add(wanted / 2);
                self.stages = None;
            }
            self.furnish(camera.size)?;
            let (stages, canvas) = self.stages.as_ref().zip(self.canvas.as_ref()).expect("just made");
            let mut rec = gpu.recorder()?;
            work(self, &mut rec, stages, canvas);
            rec.submit()?.wait().map(drop)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::cloud;
    use crate::export::{Cloud, logit};
    use crate::gpu::testing;
    use crate::math::harmonics::ZEROTH;
    use crate::render::view::to_rgb8;
    use crate::train::photographs::pack;

    /// Looks along z at Gaussians around the origin from ten units away.
    fn camera(size: [u32; 2]) -> Camera {
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0, 0.0, 10.0],
            focal: [60.0; 2],
            principal: size.map(|side| side as f32 / 2.0),
            distortion: [0.02, 0.0, 0.0, 0.0],
            size,
        }
    }

    fn drawer(gpu: &Gpu, cloud: &Cloud) -> Drawer {
        let gaussians = Static::upload(gpu, cloud).expect("room");
        Drawer::new(gpu, gaussians, &Config::default(), [0.0; 3]).expect("room")
    }

    /// White Gaussians before black: what a pixel shows is what they gave to it.
    #[test]
    fn contributions_are_what_the_picture_is_made_of() {
        let gpu = testing::gpu();
        let mut cloud = cloud(200, 0);
        cloud.harmonics.fill([(0.5 / ZEROTH) as f32; 3]);
        for size in [[64, 48], [50, 70]] {
            let mut drawer = drawer(&gpu, &cloud);
            let picture: f64 = drawer.draw(&camera(size)).expect("a picture").iter().map(|rgb| f64::from(rgb[0])).sum();
            let shares = drawer.contributions(&camera(size)).expect("contributions");
            let given: f64 = shares.iter().map(|share| f64::from(*share)).sum();
            assert!(picture > 100.0, "something is seen: {picture}");
            // Sums of some thousand float32 terms on either side.
            assert!((given - picture).abs() < 1e-4 * picture, "{given} of {picture}");
            // One behind the camera gives nothing.
            assert!(shares.iter().zip(&cloud.position).all(|(share, p)| p[2] > -9.8 || *share == 0.0));
        }
    }

    #[test]
    fn steps_lead_to_the_picture() {
        let gpu = testing::gpu();
        let (goal, camera) = (cloud(150, 1), camera([64, 48]));
        let picture = drawer(&gpu, &goal).draw(&camera).expect("a picture");
        let target = pack(&to_rgb8(camera.size, &picture), None);
        let mut start = goal.clone();
        start.position.iter_mut().for_each(|p| p[0] += 0.05);
        start.harmonics.iter_mut().for_each(|h| h[1] -= 0.2);
        start.logit.fill(logit(0.5));
        let mut drawer = drawer(&gpu, &start);
        let rates = [5e-3, 5e-3, 1e-3, 5e-2, 1e-2];
        let losses: Vec<f32> =
            (1..=60).map(|step| drawer.step(&camera, &target, step, rates).expect("a step")).collect();
        assert!(losses[59] < 0.4 * losses[0], "{} to {}", losses[0], losses[59]);
        // A rate of 0 leaves its parameter where it was.
        let before = drawer.gaussians.read(&gpu).expect("Gaussians");
        drawer.step(&camera, &target, 61, [0.0, 0.0, 0.0, 0.0, 1e-2]).expect("a step");
        let after = drawer.gaussians.read(&gpu).expect("Gaussians");
        assert!(before.position == after.position && before.logit == after.logit);
        assert!(before.harmonics != after.harmonics);
    }

    /// More pairs than there is room for at first.
    #[test]
    fn room_is_made_where_it_is_needed() {
        let gpu = testing::gpu();
        let mut cloud = cloud(3000, 0);
        cloud.log_scale.fill([1.0; 3]);
        let camera = camera([256, 192]);
        let mut drawer = drawer(&gpu, &cloud);
        let first = drawer.draw(&camera).expect("a picture");
        assert!(drawer.pairs > PAIRS, "the case has enough pairs");
        assert!(first == drawer.draw(&camera).expect("a picture") && first.iter().any(|rgb| rgb[0] > 0.1));
    }
}

//! Static Gaussians drawn, compared and improved: the training step's own stages.

use crate::gpu::{Error, Gpu};
use crate::losses::{self, Losses, View, Weights};
use crate::model::gaussians::Static;
use crate::optimizer::adam::{self, Tensors};
use crate::render::decode::GaussianGradients;
use crate::render::forward::{Capacity, Representation as _};
use crate::render::project::{ProjectBackward, SplatGradients};
use crate::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use crate::render::session::{Room, Stages};
use crate::render::{Config, Session};
use crate::scene::Camera;

/// Learning rates of a step, in the order of [`Static::parameters`].
pub type Rates = [f64; 5];

/// Picture, losses and way back beside the forward stages.
struct Canvas {
    picture: Picture,
    losses: Losses,
    rasterize: Backward,
    project: ProjectBackward,
}

impl Canvas {
    fn new(gpu: &Gpu, room: Room) -> Result<Self, Error> {
        let plan = losses::Plan {
            size: room.size,
            ssim_weight: SSIM_WEIGHT,
            masks: false,
            ssim_across_masks: false,
            depth: false,
            gradient_scales: 0,
        };
        Ok(Self {
            picture: Picture::new(gpu, room.size, room.pixels(), Outputs::Color)?,
            losses: Losses::new(gpu, &plan)?,
            rasterize: Backward::new(gpu, room.method, room.slots, room.pairs, Outputs::Color)?,
            project: ProjectBackward::new(gpu, room.slots)?,
        })
    }
}

/// Share of 1 - SSIM in the loss, as in training.
const SSIM_WEIGHT: f32 = 0.2;

/// Draws static Gaussians.
pub struct Drawer {
    near: f32,
    background: [f32; 3],
    session: Session<Canvas>,
    /// The Gaussians.
    pub gaussians: Static,
}

impl Drawer {
    /// Of these Gaussians. `background` is what shines through, linear rgb.
    ///
    /// # Errors
    /// As [`Session::new`].
    pub fn new(gpu: &Gpu, gaussians: Static, config: &Config, background: [f32; 3]) -> Result<Self, Error> {
        let session = Session::new(gpu, config, Capacity::guess(gaussians.count), Canvas::new)?;
        Ok(Self { near: config.near as f32, background, session, gaussians })
    }

    /// The picture \[pixel\] from a camera.
    ///
    /// # Errors
    /// When the device has no room for it, or is lost.
    pub fn draw(&mut self, camera: &Camera) -> Result<Vec<[f32; 3]>, Error> {
        let (gpu, background) = (self.session.gpu().clone(), self.background);
        let stages = self.session.run(&self.gaussians, camera, |rec, Stages { room, forward, own }, binned| {
            rasterize::forward(rec, room.method, forward.projected(), binned, background, &own.picture);
        })?;
        gpu.read(&stages.own.picture.rgb)
    }

    /// The sum of alpha x transmittance of every Gaussian over the pixels of a view.
    ///
    /// # Errors
    /// As [`Drawer::draw`].
    pub fn contributions(&mut self, camera: &Camera) -> Result<Vec<f32>, Error> {
        let [w, h] = camera.size.map(|n| n as usize);
        Ok(self.shares(camera, &vec![[1.0; 3]; w * h])?.into_iter().map(|share| share[0]).collect())
    }

    /// The sum of alpha x transmittance of every Gaussian over the pixels of a view, each times the pixel's weights: the colour's
    /// own gradient where these are the picture's.
    ///
    /// # Errors
    /// As [`Drawer::draw`].
    pub fn shares(&mut self, camera: &Camera, weights: &[[f32; 3]]) -> Result<Vec<[f32; 3]>, Error> {
        let (gpu, background) = (self.session.gpu().clone(), self.background);
        let weights = gpu.upload("grad_rgb", weights)?;
        let drawn = self.session.run(&self.gaussians, camera, |rec, Stages { room, forward, own }, binned| {
            rasterize::forward(rec, room.method, forward.projected(), binned, background, &own.picture);
            let gradient = PictureGradient { rgb: &weights, depth: None, transmittance: None };
            own.rasterize.record(rec, room.method, forward.projected(), binned, &own.picture, gradient);
        })?;
        let (tiles, shares) = (gpu.read(drawn.forward.bin.tiles())?, gpu.read(&drawn.own.rasterize.grad_color)?);
        Ok(tiles.iter().zip(shares).map(|(tiles, share)| if *tiles > 0 { share } else { [0.0; 3] }).collect())
    }

    /// One step of Adam (counted from 1) towards a picture \[pixel\] (see [`losses::pack`]); returns the loss before it.
    ///
    /// # Errors
    /// As [`Drawer::draw`].
    pub fn step(&mut self, camera: &Camera, target: &[u32], step: u32, rates: Rates) -> Result<f32, Error> {
        let (gpu, limits, near) = (self.session.gpu().clone(), self.session.limits().share(), self.near);
        for parameter in self.gaussians.parameters_mut().into_iter().filter(|row| row.gradient.is_none()) {
            parameter.make_gradient(&gpu)?;
        }
        let target = gpu.upload("picture", target)?;
        let (gaussians, background) = (&self.gaussians, self.background);
        let stages = self.session.run(gaussians, camera, |rec, stages, binned| {
            let Stages { room, forward, own: Canvas { picture, losses, rasterize, project, .. } } = stages;
            rasterize::forward(rec, room.method, forward.projected(), binned, background, picture);
            let weights = Weights { outside: 1.0, inside: 1.0 };
            let view = View { picture: &target, weights, depth: None };
            let gradient = losses.forward_backward(rec, &view, &picture.rgb, None);
            let gradient = PictureGradient { rgb: gradient.rgb, depth: None, transmittance: None };
            rasterize.record(rec, room.method, forward.projected(), binned, picture, gradient);
            let Backward { grad_mean: mean, grad_covariance: covariance, .. } = rasterize;
            forward.uncompensate(rec, binned.drawn, covariance, &rasterize.grad_opacity);
            let splats = SplatGradients { mean, covariance, depth: None };
            project.record(rec, binned.drawn, forward.gaussians(), splats, camera, near);
            let gradients = GaussianGradients {
                drawn: binned.tiles,
                position: &project.grad_position,
                opacity: &rasterize.grad_opacity,
                color: &rasterize.grad_color,
                scale: &project.grad_scale,
                rotation: &project.grad_rotation,
            };
            let trained = || {
                gaussians
                    .parameters()
                    .into_iter()
                    .zip(rates)
                    .filter_map(|(p, rate)| Some((p, p.gradient.as_ref()?, rate)))
            };
            trained().for_each(|(_, gradient, _)| rec.zero(gradient));
            gaussians.backward(rec, (&forward.front, None), None, binned.drawn, gradients);
            for (parameter, gradient, rate) in trained().filter(|(_, _, rate)| *rate != 0.0) {
                let tensors =
                    Tensors { value: &parameter.value, gradient, first: &parameter.first, root: &parameter.root };
                let range = (0, gaussians.count * parameter.width);
                adam::record(rec, &adam::Config::default(), tensors, limits.overflow(), range, (step, rate));
            }
        })?;
        Ok(gpu.read(stages.own.losses.terms())?[0])
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

    /// Gaussians of a tenth of a pixel, drawn four times as large: with antialiasing they give as much light, as a viewer of
    /// their file expects; without it they are as large as the low-pass in both, and give a sixteenth.
    #[test]
    fn small_gaussians_keep_their_light_with_antialiasing() {
        let gpu = testing::gpu();
        let mut cloud = cloud(400, 0);
        cloud.log_scale.fill([(0.1f32 * 10.0 / 60.0).ln(); 3]);
        cloud.logit.fill(logit(0.9));
        cloud.harmonics.fill([(0.5 / ZEROTH) as f32; 3]);
        let light = |antialiased: bool, times: u32| {
            let cloud = Cloud { antialiased, ..cloud.clone() };
            let mut camera = camera([64 * times, 48 * times]);
            camera.focal = camera.focal.map(|f| f * times as f32);
            let rgb = drawer(&gpu, &cloud).draw(&camera).expect("a picture");
            rgb.iter().map(|rgb| f64::from(rgb[0])).sum::<f64>() / f64::from(times * times)
        };
        // Some hide others, and the wider ones more of them; what is below 1/255 is cut off, more of it where all is faint.
        let (small, large) = (light(true, 1), light(true, 4));
        assert!((0.8..1.25).contains(&(small / large)), "{small} and {large}");
        let (small, large) = (light(false, 1), light(false, 4));
        assert!(small / large > 8.0, "{small} and {large}");
    }

    #[test]
    fn steps_lead_to_the_picture() {
        [false, true].into_iter().for_each(steps_lead_to_it);
    }

    fn steps_lead_to_it(antialiased: bool) {
        let gpu = testing::gpu();
        let (goal, camera) = (Cloud { antialiased, ..cloud(150, 1) }, camera([64, 48]));
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
        assert!(drawer.session.stages().room.pairs > 1 << 17, "the case has enough pairs");
        assert!(first == drawer.draw(&camera).expect("a picture") && first.iter().any(|rgb| rgb[0] > 0.1));
    }
}

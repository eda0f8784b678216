//! A training that comes to nothing: cameras and points that have nothing to do with each other train for hours and
//! deliver black pictures.
//!
//! Two signs, both of which a training that works shows never. It draws no Gaussian in its first [`BLANK_STEPS`] steps:
//! one of them in one picture would do. Or it neither learns nor knows anything: [`VAIN_STEPS`] steps after the start its
//! loss is no better than that of pictures filled with their own mean colour, and no better either than it was at first. A
//! mean colour is what a single large Gaussian shows, and the first few rounds over the views bring the loss far below it;
//! where much of the pictures is uncovered sky the loss may lie above it for long, but falls.

use super::Error;
use crate::config::Settings;
use crate::evaluate::ssim_map;
use crate::scene::{Scene, View};

/// Steps without a Gaussian after which a run stops.
const BLANK_STEPS: u32 = 100;
/// Steps after which the loss is held against that of constant pictures, and over how many the means are taken.
const VAIN_STEPS: u32 = 600;
const MEAN_OVER: u32 = 100;
/// Part of the first steps' loss that counts as having learnt nothing.
const SAME: f64 = 0.95;
/// Views that constant pictures are made of, at most.
const VIEWS: usize = 8;

/// Watches the steps of one session.
#[derive(Default)]
pub(super) struct Vain {
    steps: u32,
    drawn: bool,
    /// Sum of the losses of the first [`MEAN_OVER`] steps, and of the last before [`VAIN_STEPS`].
    first: f64,
    last: f64,
}

impl Vain {
    /// After a step that has ended well.
    ///
    /// # Errors
    /// [`Error::Nothing`].
    pub fn step(&mut self, scene: &Scene, settings: &Settings, gaussians: u32, loss: f32) -> Result<(), Error> {
        self.steps += 1;
        self.drawn |= gaussians > 0;
        let loss = f64::from(loss);
        if self.steps <= MEAN_OVER {
            self.first += loss;
        } else if (VAIN_STEPS - MEAN_OVER..VAIN_STEPS).contains(&(self.steps - 1)) {
            self.last += loss;
        }
        if self.steps == BLANK_STEPS && !self.drawn {
            let what = format!("no view shows a single Gaussian in {BLANK_STEPS} steps");
            return Err(Error::Nothing { what });
        }
        if self.steps == VAIN_STEPS && self.last > SAME * self.first {
            let (loss, constant) = (self.last / f64::from(MEAN_OVER), constant_loss(scene, settings));
            if loss > constant {
                let what = format!(
                    "after {VAIN_STEPS} steps the loss is {loss:.3}, where pictures of one colour have {constant:.3}, and does not \
                     fall"
                );
                return Err(Error::Nothing { what });
            }
        }
        Ok(())
    }
}

/// Mean photometric loss of pictures that are filled with the mean colour of their photographs, outside the masks.
fn constant_loss(scene: &Scene, settings: &Settings) -> f64 {
    let every = scene.train.len().div_ceil(VIEWS).max(1);
    let views: Vec<&View> = scene.train.iter().step_by(every).collect();
    let share = settings.losses.ssim_weight;
    let of = |view: &&View| {
        let counts = |pixel: usize| view.mask.as_ref().is_none_or(|mask| mask.as_raw()[pixel] == 0);
        let truth: Vec<f64> = view.image.as_raw().iter().map(|v| f64::from(*v) / 255.0).collect();
        let pixels = truth.len() / 3;
        let counted = (0..pixels).filter(|i| counts(*i)).count().max(1) as f64;
        let sum = |c: usize| (0..pixels).filter(|i| counts(*i)).map(|i| truth[3 * i + c]).sum::<f64>();
        let mean: [f64; 3] = std::array::from_fn(|c| sum(c) / counted);
        let flat: Vec<f64> = (0..truth.len()).map(|i| mean[i % 3]).collect();
        let [w, h] = view.camera.size.map(|n| n as usize);
        let ssim = ssim_map(&flat, &truth, w, h);
        let term = |i: usize| (1.0 - share) * (flat[i] - truth[i]).abs() + share * (1.0 - ssim[i]);
        (0..truth.len()).filter(|i| counts(i / 3)).map(term).sum::<f64>() / truth.len() as f64
    };
    views.iter().map(of).sum::<f64>() / views.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load, synthetic};

    fn scene() -> Scene {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options { width: 48, height: 36, train_views: 4, points: 50, ..Default::default() };
        synthetic::write(&dir, &options).expect("a scene");
        load(&dir, &Config::default()).expect("it loads")
    }

    /// The step at which a run with these losses and counts is stopped.
    fn stopped(scene: &Scene, step: impl Fn(u32) -> (u32, f64)) -> Option<u32> {
        let (mut vain, settings) = (Vain::default(), Settings::default());
        (1..=2_000).find(|n| {
            let (gaussians, loss) = step(*n);
            vain.step(scene, &settings, gaussians, loss as f32).is_err()
        })
    }

    #[test]
    fn nothing_is_noticed_and_anything_else_is_not() {
        let scene = scene();
        let constant = constant_loss(&scene, &Settings::default());
        assert!((0.05..0.6).contains(&constant), "{constant}");
        let black = 1.5 * constant;
        assert_eq!(stopped(&scene, |_| (0, black)), Some(BLANK_STEPS));
        assert_eq!(stopped(&scene, |n| (u32::from(n == 60), black)), Some(VAIN_STEPS), "drawn once, and still black");
        assert_eq!(stopped(&scene, |_| (9, 0.9 * constant)), None, "no better, but better than one colour");
        assert_eq!(stopped(&scene, |n| (9, black * (1.0 - 0.0002 * f64::from(n)))), None, "bad, and learning");
        assert_eq!(stopped(&scene, |n| (9, constant / (1.0 + f64::from(n)))), None);
    }

    /// The loss is the sum over pixels and channels outside the mask over all there are, as the device has it.
    #[test]
    fn a_constant_picture_has_no_loss_on_itself() {
        let mut scene = scene();
        for view in &mut scene.train {
            view.image.pixels_mut().for_each(|p| p.0 = [90, 120, 30]);
        }
        let loss = constant_loss(&scene, &Settings::default());
        assert!(loss.abs() < 1e-9, "{loss}");
    }
}

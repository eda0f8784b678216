//! Each Gaussian is known or guessed: photographs show it, or it was made up where the object stood.
//!
//! A Gaussian is moved, split and pruned as training goes on, so that where it came from says little of what it shows in the
//! end. What counts is which pixels it was trained on: its share (alpha x transmittance) in every pixel of every training view
//! is known or guessed as the pixel is. What hardly any view shows is neither: nothing speaks for it, and it hangs in the air
//! for whoever leaves the cameras' path ([`OffPath`]).

use std::path::Path;

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use super::draw::Drawer;
use super::{Cloud, Error, Observer, SEEN, TRAIN_VIEWS, go_on, poses};
use crate::gpu::Gpu;
use crate::math::harmonics::ZEROTH;
use crate::model::gaussians::Static;
use crate::render::Config;
use crate::render::forward::Capacity;
use crate::render::view::Painter;
use crate::scene::{self, Camera, GUESSED, Scene, path, resample};

/// Views that have to show a Gaussian for it to be supported: from one alone its depth is anyone's guess.
const SUPPORT: u32 = 2;
/// Angles off the path at which is looked, degrees, and cameras that are looked from.
const OFF: [f64; 2] = [10.0, 25.0];
const LOOKED: usize = 12;

/// Pixels that speak for each Gaussian.
#[derive(Debug, Clone, PartialEq)]
pub struct Provenance {
    /// `[gaussian]` its shares in known pixels and in guessed ones, summed over the training views.
    pub shares: Vec<[f32; 2]>,
    /// `[gaussian]` training views that show it.
    pub views: Vec<u32>,
}

/// Means over pictures from cameras off the path of the training's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OffPath {
    /// By how many degrees a camera went around what all look at.
    pub degrees: f64,
    /// Share of the picture that shows what is guessed.
    pub guessed: f64,
    /// Share of the picture that shows what fewer than two training views show.
    pub unsupported: f64,
}

/// `[pixel]` of a training view whether it is known, and whether it is guessed; neither where it is not trained on. `root` is the
/// scene's folder, which has the maps of `prepare`: without one all of a filled hole is guessed.
fn told(scene: &Scene, root: Option<&Path>, at: usize) -> Result<Vec<[f32; 3]>, scene::Error> {
    let view = &scene.train[at];
    let trained = scene.references.iter().any(|reference| reference.view == at && !reference.truth);
    let filled = scene.holes.iter().find(|hole| hole.view == at).map(|hole| &hole.filled);
    let shown = scene.references.iter().any(|reference| reference.view == at && reference.truth);
    let map = root.map(|root| root.join(GUESSED).join(format!("{}.png", view.name))).filter(|path| path.is_file());
    let map = map.map(|path| scene::decode(&path)).transpose()?;
    let map = map.map(|map| resample::nearest(&map.into_luma8(), view.camera.size));
    let holed = |i: usize| view.mask.as_ref().is_some_and(|mask| mask.as_raw()[i] != 0) && !shown;
    let pixel = |i: usize| {
        let guessed = map.as_ref().is_none_or(|map| map.as_raw()[i] != 0);
        let trained = trained || filled.is_some_and(|filled| filled.as_raw()[i] != 0);
        match (holed(i), trained, guessed) {
            (false, ..) | (true, true, false) => [1.0, 0.0, 0.0],
            (true, true, true) => [0.0, 1.0, 0.0],
            (true, false, _) => [0.0; 3],
        }
    };
    Ok((0..view.camera.size[0] as usize * view.camera.size[1] as usize).map(pixel).collect())
}

impl Provenance {
    /// Looks at Gaussians from the training views; `turned` brings a camera into their axes.
    ///
    /// # Errors
    /// When the device has no room, or is lost; a map of `prepare` that is no picture; an end that somebody wished.
    pub fn of(
        gpu: &Gpu,
        cloud: &Cloud,
        (scene, root): (&Scene, Option<&Path>),
        turned: impl Fn(&Camera) -> Camera,
        config: &Config,
        observer: &mut dyn Observer,
    ) -> Result<Self, Error> {
        let mut drawer = Drawer::new(gpu, Static::upload(gpu, cloud)?, config, [0.0; 3])?;
        let mut all = Self { shares: vec![[0.0; 2]; cloud.len()], views: vec![0; cloud.len()] };
        let views: Vec<usize> = (0..scene.train.len()).collect();
        let views = poses::spread(&views, TRAIN_VIEWS);
        observer.begin("telling what is known", views.len() as u64);
        for at in views {
            let told = told(scene, root, at)?;
            let shares = drawer.shares(&turned(&scene.train[at].camera), &told)?;
            for ((sum, views), [known, guessed, _]) in all.shares.iter_mut().zip(&mut all.views).zip(shares) {
                *sum = [sum[0] + known, sum[1] + guessed];
                *views += u32::from(known + guessed > SEEN);
            }
            observer.turn("");
            go_on(observer)?;
        }
        Ok(all)
    }

    /// `[gaussian]` which part of what it gives to the training's pictures is guessed: 0 where it gives nothing.
    pub fn guessed(&self) -> Vec<f32> {
        self.shares.iter().map(|[known, guessed]| guessed / (known + guessed).max(f32::MIN_POSITIVE)).collect()
    }

    /// How many Gaussians are guessed more than known, and how many fewer than two views show.
    pub fn counts(&self) -> [usize; 2] {
        let guessed = self.guessed().iter().filter(|part| **part > 0.5).count();
        [guessed, self.views.iter().filter(|views| **views < SUPPORT).count()]
    }

    /// What is seen from off the path of these cameras, which are in the Gaussians' axes.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn off_path(
        &self,
        gpu: &Gpu,
        cloud: &Cloud,
        cameras: &[Camera],
        config: &Config,
    ) -> Result<Vec<OffPath>, Error> {
        // Drawn in two colours: how guessed, and whether it is supported. Whatever direction it is seen from.
        let color = |(guessed, views): (f32, &u32)| {
            let unsupported = *views < SUPPORT;
            [if unsupported { 0.0 } else { guessed }, f32::from(u8::from(unsupported)), 0.0]
                .map(|v| ((f64::from(v) - 0.5) / ZEROTH) as f32)
        };
        let harmonics = self.guessed().into_iter().zip(&self.views).map(color).collect();
        let gaussians = Static::upload(gpu, &Cloud { harmonics, degree: 0, ..cloud.clone() })?;
        let mut painter = Painter::new(gpu, config, Capacity::guess(gaussians.count))?;
        OFF.into_iter()
            .map(|degrees| {
                let shows = off(cameras, degrees).into_iter().map(|camera| {
                    let rgb = painter.render(&gaussians, &camera)?.rgb;
                    let sum = |c: usize| rgb.iter().map(|rgb| f64::from(rgb[c])).sum::<f64>() / rgb.len() as f64;
                    Ok([sum(0), sum(1)])
                });
                let shows: Vec<[f64; 2]> = shows.collect::<Result<_, Error>>()?;
                let mean = |c: usize| shows.iter().map(|show| show[c]).sum::<f64>() / shows.len().max(1) as f64;
                Ok(OffPath { degrees, guessed: mean(0), unsupported: mean(1) })
            })
            .collect()
    }
}

/// Cameras that went so far around what all look at, each to the side on which it is farthest from all others.
fn off(cameras: &[Camera], degrees: f64) -> Vec<Camera> {
    let Some(focus) = path::focus(cameras, &[]).map(DVec3::from_array) else { return vec![] };
    let center = |camera: &Camera| DVec3::from_array(camera.center());
    let one = |camera: &Camera| {
        let [right, down, _] = camera.rotation.map(|row| DVec3::from_array(row.map(f64::from)).normalize_or_zero());
        let turned = [right, -right, down, -down].map(|axis| {
            let turn = DMat3::from_axis_angle(axis.normalize_or(DVec3::Y), degrees.to_radians());
            let rotation =
                camera.rotation.map(|row| (turn * DVec3::from_array(row.map(f64::from))).to_array().map(|v| v as f32));
            let eye = focus + turn * (center(camera) - focus);
            Camera { rotation, translation: Camera::translation_to(&rotation, eye.to_array()), ..*camera }
        });
        let apart = |camera: &Camera| {
            let distances = cameras.iter().map(|other| center(other).distance(center(camera)));
            distances.fold(f64::INFINITY, f64::min)
        };
        turned.into_iter().max_by(|a, b| apart(a).total_cmp(&apart(b))).expect("there are four")
    };
    poses::spread(cameras, LOOKED).iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use image::GrayImage;

    use super::*;
    use crate::export::logit;
    use crate::gpu::testing;
    use crate::scene::{Hole, synthetic};

    struct Silent;

    impl Observer for Silent {
        fn begin(&mut self, _: &str, _: u64) {}
        fn turn(&mut self, _: &str) {}
    }

    fn scene() -> Scene {
        let options = synthetic::Options {
            width: 80,
            height: 60,
            train_views: 8,
            test_views: 0,
            points: 50,
            ..Default::default()
        };
        let folder = tempfile::tempdir().expect("a temporary folder");
        synthetic::write(&folder.path().join("scene"), &options).expect("a scene");
        scene::load(&folder.path().join("scene"), &scene::Config::default()).expect("it loads")
    }

    /// Two photographs from one place, each with a hole of twenty columns, of which photographs show the right half: what a Gaussian
    /// shows says what it is, wherever it is. One that a single view shows, or none, has no support.
    #[test]
    fn a_gaussian_is_what_it_shows() {
        let gpu = testing::gpu();
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::create_dir_all(folder.path().join(GUESSED)).expect("a folder");
        let columns = |range: std::ops::Range<u32>| {
            GrayImage::from_fn(80, 60, |x, _| image::Luma([if range.contains(&x) { 255 } else { 0 }]))
        };
        let mut scene = scene();
        (scene.references, scene.train) = (vec![], vec![scene.train[0].clone(); 2]);
        for (at, view) in scene.train.iter_mut().enumerate() {
            (view.name, view.mask) = (format!("view{at}"), Some(columns(20..40)));
            let map = folder.path().join(GUESSED).join(format!("{}.png", view.name));
            columns(20..30).save(&map).expect("a map");
            let (image, covered) = (view.image.clone(), columns(20..40));
            // In the second one nothing is believed in the left quarter.
            scene.holes.push(Hole { view: at, image, covered, filled: columns(20 + 5 * at as u32..40), depth: None });
        }
        let camera = scene.train[0].camera;
        let place = |column: f64, z: f64| camera.lift([column, 30.0], z).expect("a ray").map(|v| v as f32);
        let z = 3.0;
        let position = vec![place(10.0, z), place(22.0, z), place(27.5, z), place(35.0, z), place(60.0, -z)];
        let n = position.len();
        let cloud = Cloud {
            position,
            log_scale: vec![[(z as f32 * 0.4 / camera.focal[0]).ln(); 3]; n],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; n],
            logit: vec![logit(0.9); n],
            harmonics: vec![[0.5; 3]; n],
            ..Cloud::default()
        };
        let of = |root: Option<&Path>| {
            Provenance::of(&gpu, &cloud, (&scene, root), |camera| *camera, &Config::default(), &mut Silent)
                .expect("shares")
        };
        let told = of(Some(folder.path()));
        let rounded = |told: &Provenance| told.guessed().iter().map(|part| part.round() as u8).collect::<Vec<_>>();
        assert_eq!(rounded(&told), [0, 1, 1, 0, 0], "{:?}", told.shares);
        assert_eq!(told.views, [2, 1, 2, 2, 0], "{:?}", told.shares);
        assert_eq!(told.counts(), [2, 2]);
        // Without maps nobody knows that photographs show a part of the hole.
        assert_eq!(rounded(&of(None)), [0, 1, 1, 1, 0]);
    }

    /// Cameras off the path are as far from what all look at, look at it as before, and leave the path.
    #[test]
    fn off_the_path_is_around_what_all_look_at() {
        let cameras: Vec<Camera> = scene().train.iter().map(|view| view.camera).collect();
        let focus = path::focus(&cameras, &[]).expect("a focus");
        let away = |camera: &Camera| DVec3::from_array(camera.center()) - DVec3::from_array(focus);
        for degrees in OFF {
            for (camera, other) in cameras.iter().zip(off(&cameras, degrees)) {
                assert!((away(camera).length() - away(&other).length()).abs() < 1e-4, "{degrees}");
                let angle = away(camera).angle_between(away(&other)).to_degrees();
                assert!(angle < degrees + 1e-3 && angle > 0.8 * degrees, "{angle} of {degrees}");
                let seen = [camera, &other].map(|camera| camera.project(focus).expect("it is before the camera"));
                assert!((0..2).all(|i| (seen[0][i] - seen[1][i]).abs() < 1e-2), "{seen:?}");
                let nearest = |at: DVec3| cameras.iter().map(|c| away(c).distance(at)).fold(f64::INFINITY, f64::min);
                assert!(nearest(away(&other)) > 0.0);
            }
        }
    }
}

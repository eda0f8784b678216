//! A made room seen from all around, as bare as rooms are: what structure from motion and stereo find hard.
//!
//! Walls and ceiling of hardly any texture, a floor of tiles, furniture along the walls, and in the middle the object to
//! remove: a sphere on a stand, which from one side is seen through a thin railing. Nearly all points of the sparse model lie
//! on the object and the furniture. The train views' exposure may drift. Truth is known as in [`synthetic`](super::synthetic),
//! whose ray caster draws it.

use std::f64::consts::TAU;
use std::path::Path;

use glam::{DVec3, dvec3};
use image::Rgb;
use rand::RngExt as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_pcg::Pcg64;

use super::Error;
use super::synthetic::{Material, Pattern, Room, Shape, Shot, checked, to_rgb8, write_room, write_tests};

/// Options of the scene. The same options give the same files.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Seed of textures, cameras, points, noise and exposure.
    pub seed: u64,
    /// Width of the pictures in pixels, at least 16.
    pub width: u32,
    /// Height of the pictures in pixels, at least 16.
    pub height: u32,
    /// Views with the object, at least 1; the middle one is the reference view.
    pub train_views: u32,
    /// Views without the object.
    pub test_views: u32,
    /// Points of the sparse model, at least 1.
    pub points: u32,
    /// Largest change of a train view's brightness, as a share: 0 leaves all alike. Test views have none; the reference
    /// picture has its view's.
    pub exposure_drift: f64,
}

impl Default for Options {
    fn default() -> Self {
        Options { seed: 0, width: 240, height: 180, train_views: 70, test_views: 14, points: 1500, exposure_drift: 0.0 }
    }
}

/// Position noise of the sparse points, relative to their distance.
const POINT_NOISE: f64 = 0.001;
/// Chance that a place on a bare wall, or on the floor, becomes a point.
const ON_WALL: f64 = 0.004;
const ON_FLOOR: f64 = 0.03;

/// Random streams; those of [`synthetic`](super::synthetic) are others.
const TEXTURES: u64 = 101;
const CAMERAS: u64 = 102;
const POINTS: u64 = 103;
const EXPOSURES: u64 = 104;

/// Writes the scene into `dir`, with the files that [`synthetic::write`](super::synthetic::write) has.
///
/// # Errors
/// Options out of range, a folder that is not empty, a file that cannot be written.
pub fn write(dir: &Path, options: &Options) -> Result<(), Error> {
    let Options { seed, width, height, train_views, points, exposure_drift, .. } = *options;
    checked([width, height], train_views, points)?;
    if !(0.0..=0.5).contains(&exposure_drift) {
        return Err(Error::Setting(format!("an exposure cannot drift by {exposure_drift}; it must be 0 to 0.5")));
    }
    let room = room(seed);
    let (train, test) = shots(options);
    let exposures = if exposure_drift > 0.0 { exposures(options) } else { vec![] };
    let cloud = cloud(&room, &train, points, seed);
    write_room(dir, seed, &room, [&train, &test], &exposures, &cloud)
}

/// As [`synthetic::write_bare`](super::synthetic::write_bare); the views have the exposure of their photographs.
///
/// # Errors
/// A file that cannot be written.
pub fn write_bare(dir: &Path, options: &Options) -> Result<(), Error> {
    let exposures = if options.exposure_drift > 0.0 { exposures(options) } else { vec![] };
    write_tests(dir, &room(options.seed), &shots(options).0, &exposures)
}

/// Bare walls and a tiled floor are the first two shapes.
fn room(seed: u64) -> Room {
    let mut rng = Pcg64::new(seed.into(), TEXTURES.into());
    let block = |low: [f64; 3], high: [f64; 3]| Shape::Block { low: low.into(), high: high.into() };
    // Of its waves the longest ones, and these faint.
    let mut bare = |base, pattern, waves: usize, strength: f64| {
        let mut material = Material::new(base, pattern, &mut rng);
        material.waves.truncate(waves);
        material.waves.iter_mut().for_each(|wave| wave.amplitude *= strength);
        material
    };
    let walls = Shape::Walls { low: dvec3(-4.0, -4.0, 0.0), high: dvec3(4.0, 4.0, 2.8) };
    let mut shapes = vec![
        (walls, bare([0.80, 0.78, 0.72], Pattern::Plain, 2, 0.15)),
        (block([-4.0, -4.0, -0.1], [4.0, 4.0, 1e-6]), bare([0.52, 0.50, 0.47], Pattern::Tiles(0.5), 2, 0.25)),
    ];
    let mut material = |base, pattern| Material::new(base, pattern, &mut rng);
    shapes.extend([
        (block([-4.0, -1.2, 0.0], [-3.2, 1.0, 0.75]), material([0.30, 0.40, 0.55], Pattern::Boards(0.37))),
        (block([1.0, 3.4, 0.0], [2.6, 4.0, 1.7]), material([0.60, 0.42, 0.26], Pattern::Boards(0.26))),
        (block([3.1, -2.4, 0.0], [4.0, -0.8, 0.45]), material([0.45, 0.55, 0.35], Pattern::Plain)),
        (block([-1.6, -4.0, 0.9], [0.4, -3.9, 1.9]), material([0.55, 0.30, 0.30], Pattern::Bricks(0.5, 0.25))),
    ]);
    // The railing: a rail and posts.
    let rod = |from: [f64; 3], to: [f64; 3]| Shape::Rod { from: from.into(), to: to.into(), radius: 0.014 };
    shapes.push((rod([-0.9, 1.1, 0.62], [0.9, 1.1, 0.62]), material([0.2, 0.2, 0.22], Pattern::Plain)));
    for i in 0..7 {
        let x = -0.9 + 0.3 * f64::from(i);
        shapes.push((rod([x, 1.1, 0.0], [x, 1.1, 0.62]), material([0.2, 0.2, 0.22], Pattern::Plain)));
    }
    // Its ends are closed.
    for x in [-0.9, 0.9] {
        let knob = Shape::Sphere { center: dvec3(x, 1.1, 0.62), radius: 0.018 };
        shapes.push((knob, material([0.2, 0.2, 0.22], Pattern::Plain)));
    }
    let object = shapes.len();
    shapes.extend([
        (block([-0.2, -0.15, 0.0], [0.2, 0.15, 0.5]), material([0.80, 0.62, 0.30], Pattern::Plain)),
        (Shape::Sphere { center: dvec3(0.0, 0.0, 0.74), radius: 0.24 }, material([0.70, 0.25, 0.30], Pattern::Plain)),
    ]);
    Room { shapes, object }
}

/// Views on a circle around the object, at changing heights; test views between them.
fn shots(options: &Options) -> (Vec<Shot>, Vec<Shot>) {
    let mut rng = Pcg64::new(options.seed.into(), CAMERAS.into());
    let mut circle = |count: u32, name: &str, offset: f64| -> Vec<Shot> {
        let one = |i: u32| {
            let mut jitter = |size: f64| rng.random_range(-size..size);
            let along = (f64::from(i) + 0.5 + jitter(0.25)) / f64::from(count);
            let height = (f64::from(i) * 0.618_033_988_749_895 + offset).fract();
            let (angle, distance) = (along * TAU, 2.5 + jitter(0.2));
            let eye = dvec3(distance * angle.sin(), -distance * angle.cos(), 1.0 + 0.9 * height);
            let target = dvec3(jitter(0.12), jitter(0.12), 0.5 + jitter(0.08));
            let roll = jitter(0.04);
            Shot::look(format!("{name}_{i:03}"), eye, target, roll, [options.width, options.height])
        };
        (0..count).map(one).collect()
    };
    (circle(options.train_views, "train", 0.0), circle(options.test_views, "test", 0.3))
}

/// A slow wave around the circle with a little of its own for each view.
fn exposures(options: &Options) -> Vec<f64> {
    let mut rng = Pcg64::new(options.seed.into(), EXPOSURES.into());
    let phase = rng.random_range(0.0..TAU);
    let one = |i: u32| {
        let slow = (TAU * f64::from(i) / f64::from(options.train_views) + phase).sin();
        1.0 + options.exposure_drift * (0.7 * slow + rng.random_range(-0.3..0.3))
    };
    (0..options.train_views).map(one).collect()
}

/// Surface points that train views see, few of them where there is nothing to hold on to.
fn cloud(room: &Room, views: &[Shot], count: u32, seed: u64) -> Vec<(DVec3, Rgb<u8>)> {
    let mut rng = Pcg64::new(seed.into(), POINTS.into());
    let mut out = vec![];
    while out.len() < count as usize {
        let shot = &views[rng.random_range(0..views.len())];
        let [x, y] = shot.size.map(|n| rng.random_range(0.0..f64::from(n)));
        let hit = room.cast(shot.eye, shot.ray(x, y), true);
        let chance = [ON_WALL, ON_FLOOR].get(hit.shape).copied().unwrap_or(1.0);
        if rng.random_range(0.0..1.0) >= chance {
            continue;
        }
        let mut noise = || -> f64 {
            let normal: f64 = StandardNormal.sample(&mut rng);
            POINT_NOISE * hit.depth * normal
        };
        out.push((hit.position + dvec3(noise(), noise(), noise()), to_rgb8(room.color(&hit))));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Config, load};

    fn options() -> Options {
        Options { seed: 5, width: 64, height: 48, train_views: 12, test_views: 3, points: 300, ..Default::default() }
    }

    fn written(options: &Options) -> crate::scene::Scene {
        let dir = tempfile::tempdir().expect("a temporary folder");
        write(&dir.path().join("scene"), options).expect("written");
        load(&dir.path().join("scene"), &Config::default()).expect("loaded")
    }

    #[test]
    fn views_stand_all_around_and_each_shows_the_object() {
        let scene = written(&options());
        assert_eq!((scene.train.len(), scene.test.len(), scene.points.len()), (12, 3, 300));
        let mut quarters = [0; 4];
        for view in &scene.train {
            let [x, y, _] = view.camera.center();
            quarters[usize::from(x > 0.0) + 2 * usize::from(y > 0.0)] += 1;
            let mask = view.mask.as_ref().expect("written");
            let object = mask.as_raw().iter().filter(|v| **v != 0).count() as f64 / mask.as_raw().len() as f64;
            assert!(object > 0.02 && object < 0.2, "{}: {object}", view.name);
        }
        assert!(quarters.iter().all(|n| *n >= 2), "{quarters:?}");
        assert!(scene.test.iter().all(|view| view.depth.is_some() && view.mask.is_some()));
        assert!(scene.references.len() == 1, "the middle view");
        assert_eq!(written(&options()).train[3].image, scene.train[3].image, "a function of the options");
    }

    #[test]
    fn walls_and_floor_have_hardly_any_points() {
        let scene = written(&options());
        let on = |p: &&crate::scene::Point| {
            let [x, y, z] = p.position;
            x.abs() > 3.98 || y.abs() > 3.98 || !(0.02..=2.78).contains(&z)
        };
        let bare = scene.points.iter().filter(on).count();
        assert!(bare > 0 && bare < 100, "{bare} of 300");
    }

    /// From the railing's side some of the object's pixels show a post instead.
    #[test]
    fn the_railing_stands_before_the_object() {
        let options = Options { width: 240, height: 180, ..options() };
        let (room, (train, _)) = (room(5), shots(&options));
        let railing = |shape: usize| (6..room.object).contains(&shape);
        let hidden = |shot: &Shot| {
            let all = (0..180).flat_map(|y| (0..240).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5)));
            let post = all.filter(|(x, y)| railing(room.cast(shot.eye, shot.ray(*x, *y), true).shape));
            // Without the railing the object is what is seen there.
            let bare: Vec<_> = room.shapes[room.object..].iter().map(|(shape, _)| *shape).collect();
            post.filter(|(x, y)| bare.iter().any(|shape| shape.hit(shot.eye, shot.ray(*x, *y)).is_some())).count()
        };
        let most = train.iter().filter(|shot| shot.eye.y > 2.0).map(hidden).max().expect("some stand there");
        assert!(most > 20, "{most} pixels");
        assert!(train.iter().filter(|shot| shot.eye.y < -1.0).all(|shot| hidden(shot) == 0));
    }

    #[test]
    fn exposure_drifts_in_train_views_alone() {
        let drifting = Options { exposure_drift: 0.1, ..options() };
        let (plain, drifted) = (written(&options()), written(&drifting));
        let mean = |view: &crate::scene::View| {
            view.image.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>() / view.image.as_raw().len() as f64
        };
        let ratios: Vec<f64> = plain.train.iter().zip(&drifted.train).map(|(a, b)| mean(b) / mean(a)).collect();
        let (least, most) = ratios.iter().fold((2.0_f64, 0.0_f64), |(a, b), r| (a.min(*r), b.max(*r)));
        assert!(least > 0.89 && most < 1.11 && most - least > 0.08, "{ratios:?}");
        assert!(plain.test.iter().zip(&drifted.test).all(|(a, b)| a.image == b.image));
    }
}

//! Generated loads: scenes of chosen numbers of anchors, pairs and pixels, and how every pass grows with them.
//!
//! A load is one view of anchors spread evenly over the picture, a quarter of them in view and the others behind the
//! camera. Their decoders' last layers are made so that every Gaussian exists, round, with an opacity of 0.015: of a
//! thousand over a pixel none ends it, and pairs are chosen by the Gaussians' size alone. Everything else is the step as
//! the settings have it, mask, depth and attention included, but that the attention's patch is the whole picture: as many
//! tokens as there are anchors for, whatever the picture's size.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::time::Instant;

use image::{GrayImage, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use super::ceilings::Ceilings;
use super::step::{self, PassFigures, StepFigures};
use crate::config::Settings;
use crate::gpu::{self, Gpu};
use crate::lab::report::Error;
use crate::lab::report::kernels::{Bench, Warm};
use crate::lab::variants::Variant;
use crate::model::files::{Anchors, FEATURES};
use crate::model::init;
use crate::render::Method;
use crate::render::forward::Capacity;
use crate::scene::{Camera, Notes, Prior, PriorKind, Reference, Scene, View};
use crate::train::photographs;
use crate::train::plan::Plan;
use crate::train::step::Step;

/// What is varied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sweep {
    /// Anchors, with two pairs per Gaussian: pairs grow with them.
    Anchors,
    /// Pairs, by the size of as many Gaussians.
    Pairs,
    /// Pixels, with as many pairs.
    Pixels,
}

impl Sweep {
    /// All.
    pub const ALL: [Self; 3] = [Self::Anchors, Self::Pairs, Self::Pixels];

    /// As people call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Anchors => "anchors",
            Self::Pairs => "pairs",
            Self::Pixels => "pixels",
        }
    }

    /// The quantity as it was measured.
    pub fn quantity(self, figures: &StepFigures) -> f64 {
        let counts = &figures.counts;
        match self {
            Self::Anchors => counts.anchors,
            Self::Pairs => counts.pairs,
            Self::Pixels => counts.pixels,
        }
    }
}

/// A load.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Load {
    /// Anchors, a quarter of which are in view.
    pub anchors: u32,
    /// (Gaussian, tile) pairs aimed at.
    pub pairs: f64,
    /// Width and height of the picture.
    pub size: [u32; 2],
}

impl std::fmt::Display for Load {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [w, h] = self.size;
        write!(f, "{} anchors, {:.0e} pairs, {w} x {h}", self.anchors, self.pairs)
    }
}

/// The loads of a sweep for `offsets` Gaussians per anchor, the smallest first.
pub fn sweep(which: Sweep, offsets: u32) -> Vec<Load> {
    let gaussians = |anchors: u32| f64::from(anchors / 4) * f64::from(offsets);
    match which {
        Sweep::Anchors => [1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000]
            .map(|anchors| Load { anchors, pairs: 2.0 * gaussians(anchors), size: [640, 360] })
            .into(),
        Sweep::Pairs => {
            [3e5, 1e6, 3e6, 1e7, 3e7].map(|pairs| Load { anchors: 40_000, pairs, size: [1280, 720] }).into()
        }
        Sweep::Pixels => [[160, 90], [320, 180], [640, 360], [1280, 720], [1920, 1080], [2560, 1440], [3840, 2160]]
            .map(|size| Load { anchors: 4_000, pairs: 1e5, size })
            .into(),
    }
}

/// Opacity of every Gaussian.
const OPACITY: f64 = 0.015;
/// Nearest and farthest anchor, scene units from the camera.
const DEPTHS: [f64; 2] = [2.0, 6.0];

impl Load {
    /// How much there is of what a sweep varies.
    fn quantity(&self, sweep: Sweep) -> f64 {
        match sweep {
            Sweep::Anchors => f64::from(self.anchors),
            Sweep::Pairs => self.pairs,
            Sweep::Pixels => f64::from(self.size[0]) * f64::from(self.size[1]),
        }
    }

    /// Anchors in view.
    pub fn visible(&self) -> u32 {
        (self.anchors / 4).max(1)
    }

    /// Standard deviation of the Gaussians in pixels, for tiles of this side, before the low-pass: a disc of radius r
    /// that falls anywhere touches on average (a^2 + 4 a r + pi r^2) / a^2 tiles of side a (Santalo).
    fn deviation(&self, side: f64, offsets: u32, alpha_min: f64) -> f64 {
        let wanted = (self.pairs / (f64::from(self.visible()) * f64::from(offsets))).max(1.0);
        let pi = std::f64::consts::PI;
        let radius = side * ((4.0 - pi + pi * wanted).sqrt() - 2.0) / pi;
        let deviations = (2.0 * (OPACITY / alpha_min).ln()).max(0.0).sqrt();
        let whole = if deviations > 0.0 { radius / deviations } else { radius };
        (whole * whole - 0.3).max(1e-4).sqrt()
    }

    fn camera(&self) -> Camera {
        let [w, h] = self.size.map(|n| n as f32);
        Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [w, w],
            principal: [0.5 * w, 0.5 * h],
            distortion: [0.0; 4],
            size: self.size,
        }
    }

    /// One view with a mask in its middle and a prior, which is the reference view too.
    pub fn scene(&self) -> Scene {
        let [w, h] = self.size;
        let mut rng = Pcg64::new(u128::from(w) << 32 | u128::from(h), 1);
        let image = RgbImage::from_fn(w, h, |_, _| image::Rgb([rng.random(), rng.random(), rng.random()]));
        let inside = |v: u32, n: u32| v >= n / 4 && v < n - n / 4;
        let mask = GrayImage::from_fn(w, h, |x, y| image::Luma([if inside(x, w) && inside(y, h) { 255 } else { 0 }]));
        let values: Vec<f32> = (0..w * h).map(|_| rng.random_range(2.0..6.0)).collect();
        let prior = Prior { kind: PriorKind::Depth, values };
        let view = View {
            name: "generated".into(),
            camera: self.camera(),
            image: image.clone(),
            mask: Some(mask),
            weight: None,
            prior: Some(prior.clone()),
            depth: None,
        };
        Scene {
            train: vec![view],
            test: vec![],
            holes: vec![],
            references: vec![Reference { view: 0, image, prior: Some(prior), truth: false }],
            points: vec![crate::scene::Point { position: [0.0, 0.0, 3.0], color: [0; 3] }],
            dense: vec![],
            gains: vec![],
            radius: 1.0,
            unit: 1.0,
            notes: Notes::default(),
        }
    }

    /// The anchors, for tiles of this side.
    fn anchors(&self, side: f64, offsets: u32, alpha_min: f64) -> Anchors {
        let camera = self.camera();
        let mut rng = Pcg64::new(u128::from(self.anchors), 2);
        let deviation = self.deviation(side, offsets, alpha_min);
        let [fx, fy] = camera.focal.map(f64::from);
        let [cx, cy] = camera.principal.map(f64::from);
        let visible = self.visible();
        let mut anchors = Anchors { offsets_per_anchor: offsets as usize, ..Anchors::default() };
        for i in 0..self.anchors {
            let [near, far] = DEPTHS;
            let z: f64 = rng.random_range(near..far);
            let x = (rng.random_range(0.0..f64::from(self.size[0])) - cx) * z / fx;
            let y = (rng.random_range(0.0..f64::from(self.size[1])) - cy) * z / fy;
            // In turns, so that the anchors in view lie apart in memory as those of a scene do.
            let seen = u64::from(i + 1) * u64::from(visible) / u64::from(self.anchors)
                > u64::from(i) * u64::from(visible) / u64::from(self.anchors);
            anchors.position.push([x, y, if seen { z } else { -z }].map(|v| v as f32));
            anchors.feature.push(std::array::from_fn::<f32, FEATURES, _>(|_| rng.random_range(-0.5..0.5)));
            let pixel = z / fx;
            // Offsets of some pixels; of scales a sigmoid of 0, one half, is left.
            let (spread, scale) = ((4.0 * pixel).ln() as f32, (2.0 * deviation * pixel).ln() as f32);
            anchors.log_scaling.push([spread, spread, spread, scale, scale, scale]);
            anchors.offset.extend((0..3 * offsets).map(|_| rng.random_range(-1.0f32..1.0)));
        }
        anchors.completed()
    }

    /// The model, with room for what there will be.
    fn warm(&self, gpu: &Gpu, settings: &Settings, attention: bool) -> Result<Warm, gpu::Error> {
        let method = Method::new(gpu, &settings.render)?;
        let offsets = settings.model.offsets;
        let anchors = self.anchors(method.tiling.side().into(), offsets, method.alpha_min.into());
        let mut weights = init::weights(settings.train.seed, offsets as usize, attention, settings.model.opacity);
        let mut set = |name: &str, value: &dyn Fn(usize) -> f64| {
            let tensor = weights.tensors.get_mut(name).expect("the decoders have this tensor");
            tensor.data.iter_mut().enumerate().for_each(|(i, v)| *v = value(i) as f32);
        };
        set("mlp_opacity.2.weight", &|_| 0.0);
        set("mlp_opacity.2.bias", &|_| OPACITY.atanh());
        set("mlp_cov.2.weight", &|_| 0.0);
        // Scales 0, quaternion (1, 0, 0, 0).
        set("mlp_cov.2.bias", &|i| if i % 7 == 3 { 1.0 } else { 0.0 });
        let capacity = self.capacity();
        Ok(Warm { anchors, weights, tensors: vec![], values: BTreeMap::new(), capacity })
    }

    /// Discs at the picture's edge touch fewer tiles than thought, and the low-pass makes small ones larger.
    fn capacity(&self) -> Capacity {
        let pairs = (1.25 * self.pairs) as u32 + 1024;
        Capacity { anchors: self.anchors, visible: self.visible() + 16, pairs }
    }
}

/// A load as measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LoadFigures {
    /// What was varied.
    pub sweep: Sweep,
    /// What was aimed at.
    pub load: Load,
    /// Its step.
    pub step: StepFigures,
}

/// A load that was left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// What was varied.
    pub sweep: Sweep,
    /// The load.
    pub load: Load,
    /// Why.
    pub why: String,
}

/// How a pass grows: time = constant * quantity^exponent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Exponent {
    /// The pass, or `total`.
    pub pass: String,
    /// What was varied.
    pub sweep: Sweep,
    /// Slope of the least-squares line through the logarithms.
    pub exponent: f64,
    /// Root of the mean squared distance of the logarithms from the line: 0.1 is ten per cent.
    pub residual: f64,
    /// Loads.
    pub points: usize,
}

/// Bytes of device memory, from the ledger of a rehearsed step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// For each anchor, in view or not.
    pub per_anchor: f64,
    /// Besides, for each that is in view.
    pub per_visible: f64,
    /// For each (Gaussian, tile) pair.
    pub per_pair: f64,
    /// For each pixel, besides its photographs.
    pub per_pixel: f64,
}

/// Everything about generated loads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Loads {
    /// Seconds that they were given.
    pub seconds: f64,
    /// The loads.
    pub runs: Vec<LoadFigures>,
    /// Those left out.
    pub left_out: Vec<LeftOut>,
    /// How the passes grow.
    pub exponents: Vec<Exponent>,
    /// What they take.
    pub memory: Memory,
}

/// Least squares through the logarithms of (quantity, time): exponent and residual. Nothing for fewer than three points,
/// or for points that are all at one place.
pub fn fit(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let logs: Vec<(f64, f64)> =
        points.iter().filter(|(x, y)| *x > 0.0 && *y > 0.0).map(|(x, y)| (x.ln(), y.ln())).collect();
    if logs.len() < 3 {
        return None;
    }
    let n = logs.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    let spread = mean(&|p| (p.0 - x).powi(2));
    if spread < 1e-12 {
        return None;
    }
    let slope = mean(&|p| (p.0 - x) * (p.1 - y)) / spread;
    Some((slope, mean(&|p| (p.1 - y - slope * (p.0 - x)).powi(2)).sqrt()))
}

/// What is left of a pass's time beyond that of as many empty dispatches; nothing where that is less than them: there the
/// clock measures dispatching.
fn beyond_dispatching(pass: &PassFigures, ceilings: &Ceilings) -> Option<f64> {
    let empty = pass.dispatches * ceilings.rates().dispatch;
    let rest = pass.milliseconds.median - empty;
    (rest >= empty).then_some(rest)
}

/// The exponents of every pass, from runs of any sweep.
pub fn exponents(runs: &[LoadFigures], ceilings: &Ceilings) -> Vec<Exponent> {
    let mut all = vec![];
    for sweep in Sweep::ALL {
        let runs: Vec<&LoadFigures> = runs.iter().filter(|run| run.sweep == sweep).collect();
        let mut points: BTreeMap<&str, Vec<(f64, f64)>> = BTreeMap::new();
        for run in &runs {
            let x = sweep.quantity(&run.step);
            points.entry("total").or_default().push((x, run.step.total.median));
            for pass in &run.step.passes {
                if let Some(ms) = beyond_dispatching(pass, ceilings) {
                    points.entry(&pass.pass).or_default().push((x, ms));
                }
            }
        }
        for (pass, points) in points {
            if let Some((exponent, residual)) = fit(&points) {
                all.push(Exponent { pass: pass.to_owned(), sweep, exponent, residual, points: points.len() });
            }
        }
    }
    all
}

/// Bytes of device memory that a step of this load takes, at most, with room for so much: from the ledger of a rehearsal.
fn bytes(gpu: &Gpu, settings: &Settings, load: &Load, capacity: Capacity) -> Result<u64, gpu::Error> {
    let rehearsal = gpu.rehearsal();
    let plan = Plan::new(&load.blank(), settings);
    let (anchors, offsets) = (load.anchors as usize, settings.model.offsets as usize);
    let anchors = Anchors::new(
        offsets,
        vec![[0.0; 3]; anchors],
        vec![[0.0; FEATURES]; anchors],
        vec![0.0; anchors * 3 * offsets],
        vec![[0.0; 6]; anchors],
    );
    let weights = init::weights(0, offsets, plan.attention, settings.model.opacity);
    let number = super::usual_step(&plan, settings, 0);
    let mut step = Step::new(&rehearsal, plan, settings, &anchors, &weights, 1.0)?;
    step.resize(capacity)?;
    step.prepare(number)?;
    Ok(rehearsal.memory().0)
}

impl Load {
    /// The scene without its pictures' contents: for rehearsals.
    fn blank(&self) -> Scene {
        let mut scene = Load { size: [8, 8], ..*self }.scene();
        scene.train[0].camera = self.camera();
        scene
    }
}

/// Device memory per anchor, anchor in view, pair and pixel.
///
/// # Errors
/// When the device binds too little for even the smallest load.
pub fn memory(gpu: &Gpu, settings: &Settings) -> Result<Memory, gpu::Error> {
    // Differences of what is large enough for the allocator's granularity not to matter.
    let base = Load { anchors: 40_000, pairs: 4e5, size: [320, 180] };
    let of = |load: &Load, change: &dyn Fn(&mut Capacity)| {
        let mut capacity = Capacity { anchors: load.anchors, ..base.capacity() };
        change(&mut capacity);
        Ok::<_, gpu::Error>(bytes(gpu, settings, load, capacity)? as f64)
    };
    let same = |_: &mut Capacity| {};
    let first = of(&base, &same)?;
    let more = Load { anchors: 2 * base.anchors, ..base };
    let larger = Load { size: [640, 180], ..base };
    let visible = base.visible();
    Ok(Memory {
        per_anchor: (of(&more, &same)? - first) / f64::from(base.anchors),
        per_visible: (of(&base, &|c| c.visible += visible)? - first) / f64::from(visible),
        per_pair: (of(&base, &|c| c.pairs += 400_000)? - first) / 4e5,
        per_pixel: (of(&larger, &same)? - first) / (320.0 * 180.0),
    })
}

/// What is left of a sweep.
struct Queue {
    sweep: Sweep,
    loads: std::vec::IntoIter<Load>,
    /// Loads so far: how much there was of what is varied, and the seconds that it took.
    taken: Vec<(f64, f64)>,
}

impl Queue {
    fn new(which: Sweep, settings: &Settings) -> Self {
        Self { sweep: which, loads: sweep(which, settings.model.offsets).into_iter(), taken: vec![] }
    }

    /// Seconds that so much may take: on the line through the last two, if it rises; in proportion to the root behind a
    /// single one, of which nobody knows how much does not grow.
    fn expected(&self, quantity: f64) -> f64 {
        match self.taken[..] {
            [] => 0.0,
            [(before, seconds)] => seconds * (quantity / before).max(1.0).sqrt(),
            [.., (a, first), (b, second)] => second + ((second - first) / (b - a)).max(0.0) * (quantity - b).max(0.0),
        }
    }
}

/// Measures the loads of all sweeps, from the smallest of each, for so many seconds.
///
/// # Errors
/// When the device is lost. A load that it has no room for is left out.
pub fn measure(
    gpu: &Gpu,
    settings: &Settings,
    ceilings: &Ceilings,
    (repetitions, seconds): (usize, f64),
    say: &mut dyn FnMut(&str),
) -> Result<Loads, Error> {
    super::ensure_timestamps(gpu)?;
    let started = Instant::now();
    let (mut runs, mut left_out): (Vec<LoadFigures>, Vec<LeftOut>) = (vec![], vec![]);
    let mut queues: Vec<Queue> = Sweep::ALL.into_iter().map(|sweep| Queue::new(sweep, settings)).collect();
    // The next of each in turn, so that a short time leaves something of all.
    while queues.iter().any(|queue| !queue.loads.as_slice().is_empty()) {
        for queue in &mut queues {
            let Some(load) = queue.loads.next() else { continue };
            let sweep = queue.sweep;
            let mut leave = |why: String| left_out.push(LeftOut { sweep, load, why });
            let expected = queue.expected(load.quantity(sweep));
            let rest = seconds - started.elapsed().as_secs_f64();
            if rest <= 0.0 {
                leave(format!("nothing is left of the {seconds} s"));
                continue;
            }
            if expected > rest {
                leave(format!("it would take about {expected:.0} s, and {rest:.0} s are left"));
                continue;
            }
            match bytes(gpu, settings, &load, load.capacity()) {
                Err(error @ (gpu::Error::TooLarge { .. } | gpu::Error::OutOfMemory { .. })) => {
                    leave(error.to_string());
                    continue;
                }
                Err(error) => return Err(error.into()),
                Ok(bytes) if bytes + gpu::device::SPARE_BYTES > gpu.available_bytes() => {
                    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
                    leave(format!(
                        "it needs {} MiB of device memory, and {} MiB are free",
                        mib(bytes + gpu::device::SPARE_BYTES),
                        mib(gpu.available_bytes())
                    ));
                    continue;
                }
                Ok(_) => {}
            }
            say(&format!("bench: {load}"));
            let begun = Instant::now();
            match one(gpu, settings, ceilings, repetitions, &load) {
                Ok(step) => {
                    queue.taken.push((load.quantity(sweep), begun.elapsed().as_secs_f64()));
                    runs.push(LoadFigures { sweep, load, step });
                }
                Err(Error::Gpu(error @ (gpu::Error::TooLarge { .. } | gpu::Error::OutOfMemory { .. }))) => {
                    leave(error.to_string());
                }
                Err(error) => return Err(error),
            }
        }
    }
    runs.sort_by_key(|run| run.sweep);
    left_out.sort_by_key(|load| load.sweep);
    let exponents = exponents(&runs, ceilings);
    Ok(Loads { seconds, runs, left_out, exponents, memory: memory(gpu, settings)? })
}

/// The load on the device, under settings that may be another choice's.
pub(super) fn furnish(gpu: &Gpu, settings: &Settings, load: &Load) -> Result<Bench, Error> {
    let mut settings = settings.clone();
    settings.model.attention.patch = load.size[0].max(load.size[1]);
    let settings = &settings;
    let scene = load.scene();
    let plan = Plan::new(&scene, settings);
    let number = super::usual_step(&plan, settings, 0);
    let photographs = Rc::new(photographs::upload(gpu, &scene, &plan, 1)?);
    let warm = load.warm(gpu, settings, plan.attention)?;
    let variant = Variant { name: String::new(), changes: vec![], settings: settings.clone() };
    Bench::new(gpu, &scene, &variant, plan, photographs, &warm, number)
}

/// Measures one load.
fn one(
    gpu: &Gpu,
    settings: &Settings,
    ceilings: &Ceilings,
    repetitions: usize,
    load: &Load,
) -> Result<StepFigures, Error> {
    let mut bench = furnish(gpu, settings, load)?;
    step::measure(gpu, &mut bench, settings, &mut || Ok(*ceilings), repetitions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};
    use crate::lab::statistics::Spread;
    use crate::skip::{Lack, skip};

    #[test]
    fn exponents_of_known_data() {
        let points = |exponent: f64| [1e3f64, 1e4, 1e5, 1e6].map(|x| (x, 0.02 * x.powf(exponent)));
        for exponent in [-0.5, 0.0, 0.5, 1.0, 1.7] {
            let (found, residual) = fit(&points(exponent)).expect("four points");
            assert!((found - exponent).abs() < 1e-12 && residual < 1e-12, "{found} {residual}");
        }
        // A factor of e up and down in turn about a line: slope by hand, -0.2 / 2.5 per ln 10 of two points each way.
        let mut bent = points(1.0);
        for (i, p) in bent.iter_mut().enumerate() {
            p.1 *= if i % 2 == 0 { std::f64::consts::E } else { 1.0 / std::f64::consts::E };
        }
        let (slope, residual) = fit(&bent).expect("four points");
        // Of x = 0, 1, 2, 3 and y = 1, -1, 1, -1: sum (x - 3/2) y = -2, sum (x - 3/2)^2 = 5.
        assert!((slope - (1.0 - 0.4 / 10f64.ln())).abs() < 1e-12, "{slope}");
        assert!((residual - (1.0f64 - 0.16 * 1.25).sqrt()).abs() < 1e-12, "{residual}");
        assert_eq!(fit(&points(1.0)[..2]), None, "two points lie on every line");
        assert_eq!(fit(&[(5.0, 1.0), (5.0, 2.0), (5.0, 3.0)]), None);
        assert_eq!(fit(&[(0.0, 1.0), (1.0, 2.0), (2.0, 3.0)]), None, "zero has no logarithm");
    }

    #[test]
    fn dispatch_time_is_no_growth() {
        let mut record = crate::lab::bench::tests::record();
        let template = record.step.take().expect("a step");
        let run = |pixels: f64, ms: f64| {
            let mut step = template.clone();
            step.counts.pixels = pixels;
            step.passes.truncate(2);
            // One dispatch is 9 us at best: one pass is little more, the other that and something linear.
            step.passes[0].milliseconds = Spread::of(&[0.012]);
            step.passes[1].milliseconds = Spread::of(&[0.009 + ms]);
            let load = Load { anchors: 1, pairs: 1.0, size: [1, 1] };
            LoadFigures { sweep: Sweep::Pixels, load, step }
        };
        let runs = [run(1e4, 0.1), run(1e5, 1.0), run(1e6, 10.0)];
        let found = exponents(&runs, &record.ceilings);
        let names: Vec<(&str, usize)> = found.iter().map(|e| (e.pass.as_str(), e.points)).collect();
        assert_eq!(names, [("optimizer/adam", 3), ("total", 3)]);
        assert!((found[0].exponent - 1.0).abs() < 1e-9);
    }

    /// A small load has the anchors in view, the Gaussians and about the pairs that it was made for.
    #[test]
    fn loads_are_what_they_say() {
        let gpu = testing::fresh_gpu(Options { timestamps: true, ..Options::default() });
        if gpu.info().timestamp_period <= 0.0 {
            skip(Lack::Timestamps, &format!("{} has no timestamps", gpu.info().name));
            return;
        }
        let mut settings = Settings::default();
        (settings.model.attention.enabled, settings.model.attention.tokens) = (true, 16);
        let ceilings = crate::lab::bench::tests::record().ceilings;
        for (pairs, size) in [(1500.0, [160, 90]), (12_000.0, [320, 180])] {
            let load = Load { anchors: 400, pairs, size };
            let step = one(&gpu, &settings, &ceilings, 1, &load).expect("the device has room");
            let c = &step.counts;
            assert_eq!((c.anchors, c.pixels), (400.0, f64::from(size[0] * size[1])));
            assert!((95.0..=130.0).contains(&c.visible), "{c:?}");
            assert_eq!(c.gaussians, 10.0 * c.visible, "all exist");
            // The low-pass keeps small ones from being smaller; at the edges some fall outside.
            assert!(c.pairs > 0.6 * pairs && c.pairs < 1.6 * pairs, "{c:?}");
            assert!(c.evaluated == c.pairs, "no tile ends early: {c:?}");
            assert!(c.tokens > 0.0, "{c:?}");
            assert!(step.passes.iter().all(|p| p.work.is_some()));
        }
        let memory = memory(&gpu, &settings).expect("room for the smallest");
        // Value, two moments and gradient of 68 floats and the position at least; of a pair tile, slot, number and
        // ten gradients.
        assert!(memory.per_anchor >= 4.0 * 272.0 + 12.0, "{memory:?}");
        assert!(memory.per_pair >= 52.0 && memory.per_visible >= 1000.0 && memory.per_pixel >= 50.0, "{memory:?}");
    }

    #[test]
    fn the_next_load_is_on_the_line_through_the_last_two() {
        let mut queue = Queue::new(Sweep::Pairs, &Settings::default());
        assert_eq!(queue.expected(1e6), 0.0, "the first is begun whatever it takes");
        queue.taken = vec![(1e5, 2.0)];
        assert_eq!(queue.expected(4e5), 4.0);
        queue.taken.push((2e5, 3.0));
        assert!((queue.expected(1e6) - 11.0).abs() < 1e-9);
        queue.taken.push((4e5, 2.5));
        assert_eq!(queue.expected(1e6), 2.5, "it does not fall");
    }

    #[test]
    fn sweeps_reach_as_far_as_they_should() {
        let of = |which| sweep(which, 10);
        assert_eq!((of(Sweep::Anchors)[0].anchors, of(Sweep::Anchors)[6].anchors), (1_000, 1_000_000));
        assert_eq!(of(Sweep::Pairs).last().map(|l| l.pairs), Some(3e7));
        assert_eq!((of(Sweep::Pixels)[0].size, of(Sweep::Pixels)[6].size), ([160, 90], [3840, 2160]));
    }
}

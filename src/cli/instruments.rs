//! What a trained model is worth, view by view: drawn again from its files, for `train`, `ablate` and `eval`.

use std::path::Path;

use image::{GrayImage, RgbImage};
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;

use super::{index, pictures};
use crate::config::Settings;
use crate::evaluate::{self, Figures, Judge, Report, Residue, Shown, Surface, hole, seen_map};
use crate::gpu::Gpu;
use crate::model::stored::Stored;
use crate::render::view::{Rendered, Renderer};
use crate::scene::{Scene, View};

/// A factor between depth maps and the scene within this of 1 is the trained model's own fault, not another unit.
const SAME_UNIT: f64 = 0.1;

/// What was measured.
pub(super) struct Measured {
    /// The figures.
    pub report: Report,
    /// By test view: which pixels some train view photographed.
    pub seen: Vec<GrayImage>,
    /// Train views as drawn, with their indices: those that [`index::chosen`] names.
    pub shown: Vec<(usize, RgbImage)>,
}

impl Measured {
    /// Writes the maps of seen pixels into `folder`, NAME.png each.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub(super) fn write_seen(&self, scene: &Scene, folder: &Path) -> Result<(), pictures::Error> {
        scene
            .test
            .iter()
            .zip(&self.seen)
            .try_for_each(|(view, map)| pictures::write_mask(&pictures::path(folder, &view.name, "png"), map))
    }
}

/// A view as the model draws it.
struct Drawn {
    picture: RgbImage,
    surface: Surface,
}

impl Drawn {
    fn new(rendered: &Rendered) -> Self {
        let surface = Surface::new(rendered.size, &rendered.depth, &rendered.transmittance);
        Self { picture: rendered.to_rgb8(), surface }
    }

    fn shown<'a>(&'a self, view: &'a View) -> Shown<'a> {
        Shown { camera: &view.camera, mask: view.mask.as_ref(), surface: &self.surface }
    }
}

/// Draws the train and test views of `scene` from the model in `folder` and judges them; `go_on` is asked before each.
///
/// # Errors
/// A model that cannot be read; a device without room; pictures that cannot be compared; what `go_on` says.
pub(super) fn measure(
    gpu: &Gpu,
    folder: &Path,
    scene: &Scene,
    settings: &Settings,
    judge: &Judge,
    go_on: &dyn Fn() -> anyhow::Result<()>,
) -> anyhow::Result<Measured> {
    let mut model = Stored::load(folder)?;
    model.rescale(1.0 / scene.unit);
    let mut renderer = Renderer::of(gpu, &model, &settings.render)?;
    let style = ProgressStyle::with_template("judging {wide_bar} {pos}/{len} views, {eta} left")?;
    let bar = ProgressBar::new((scene.train.len() + scene.test.len()) as u64).with_style(style);
    // As many views at a time as there are threads: the device draws them, and the threads make and compare pictures.
    let threads = rayon::current_num_threads();
    let mut draw = |views: &[View]| -> anyhow::Result<Vec<Drawn>> {
        let mut all = Vec::with_capacity(views.len());
        for some in views.chunks(threads) {
            go_on()?;
            let rendered = some.iter().map(|view| renderer.render(&view.camera)).collect::<Result<Vec<_>, _>>()?;
            all.par_extend(rendered.par_iter().map(Drawn::new));
            bar.inc(some.len() as u64);
        }
        Ok(all)
    };
    let (train, test) = (draw(&scene.train)?, draw(&scene.test)?);
    bar.finish_and_clear();
    let shown: Vec<Shown<'_>> = train.iter().zip(&scene.train).map(|(drawn, view)| drawn.shown(view)).collect();
    let pairs = || test.iter().zip(&scene.test);

    let known = pairs().filter_map(|(drawn, view)| Some((&drawn.surface, view.depth.as_deref()?, view.mask.as_ref())));
    let factor = hole::unit(known).filter(|factor| (factor - 1.0).abs() > SAME_UNIT);
    let (mut judging, mut seen) = (judge.start(), vec![]);
    for some in pairs().collect::<Vec<_>>().chunks(threads) {
        go_on()?;
        let compare = |(drawn, view): &(&Drawn, &View)| {
            let map = seen_map(drawn.shown(view), &shown);
            let mut metrics = judge.compare(&drawn.picture, &view.image, view.mask.as_ref(), Some(&map))?;
            metrics.fitted = fitted(scene, view, &drawn.picture)?;
            if let (Some(depth), Some(mask)) = (&view.depth, &view.mask) {
                let depth: Vec<f32> = depth.iter().map(|z| z * factor.unwrap_or(1.0) as f32).collect();
                metrics.geometry = hole::geometry(&drawn.surface, &depth, mask);
            }
            Ok((map, metrics))
        };
        let compared = some.par_iter().map(compare).collect::<Result<Vec<_>, evaluate::Error>>()?;
        for ((drawn, view), (map, metrics)) in some.iter().zip(compared) {
            judging.take(&view.name, metrics, [&drawn.picture, &view.image], view.mask.as_ref());
            seen.push(map);
        }
    }
    go_on()?;
    let mut report = judging.report().with_residues(residues(scene, &train, &shown));
    report.depth_factor = factor;
    let shown = index::chosen(scene).into_iter().map(|at| (at, train[at].picture.clone())).collect();
    Ok(Measured { report, seen, shown })
}

/// A test view's figures without its own exposure, where the train views' was evened out.
///
/// # Errors
/// Pictures that cannot be compared.
pub(super) fn fitted(scene: &Scene, view: &View, drawn: &RgbImage) -> Result<Option<Figures>, evaluate::Error> {
    let fit = || evaluate::with_fitted_exposure(drawn, &view.image, view.mask.as_ref());
    (!scene.gains.is_empty()).then(fit).transpose()
}

/// Of every train view that shows the object, against the first reference's picture as the view would show it.
fn residues(scene: &Scene, train: &[Drawn], shown: &[Shown<'_>]) -> Vec<Residue> {
    let Some(reference) = scene.references.first() else { return vec![] };
    let from = shown[reference.view];
    let of = |at: usize| {
        let view = &scene.train[at];
        let mask = view.mask.as_ref()?;
        let background = hole::warped(shown[at], from, &reference.image);
        let residue = hole::residue(&train[at].picture, &view.image, &background, mask)?;
        Some(Residue { name: view.name.clone(), residue })
    };
    (0..train.len()).into_par_iter().filter_map(of).collect()
}

//! Is a scene right? Checks that cost seconds and find what costs days.

mod geometry;

use std::path::Path;

use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use serde::Serialize;

use super::{Camera, Error, Note, Prior, PriorKind, Reference, Scene, View, rank_correlation, resample};
use crate::scene;
use crate::statistics::median;

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The training will not give what is expected.
    Problem,
    /// Worth knowing.
    Note,
}

/// One thing that was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// Subject of the finding: "masks", "names", "poses", "depth", "reference", "exposure", "scene".
    pub check: &'static str,
    /// The view, where it is about one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<String>,
    /// One sentence.
    pub message: String,
}

impl Finding {
    /// The sentence, behind the name of the view that it is about.
    pub fn text(&self) -> String {
        self.view.as_ref().map_or_else(|| self.message.clone(), |view| format!("{view}: {}", self.message))
    }
}

/// Figures of one train view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewFigures {
    /// Its name.
    pub name: String,
    /// The mask's part of the picture, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask: Option<f64>,
    /// Rank correlation of the prior with the sparse points' depth, turned so that 1 is right.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_correlation: Option<f64>,
    /// Median residual of the prior, fitted to the points by scale and shift, as a part of the median depth (or disparity).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_residual: Option<f64>,
    /// Share of the sparse points that lie before the camera, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points_in_front: Option<f64>,
    /// Share of the sparse points that fall into the picture, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points_in_picture: Option<f64>,
    /// Brightness of the photograph over that of most, by what the photographs around it show of the same points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<f64>,
    /// Intersection over union of its mask with the one it was compared with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub iou: Option<f64>,
}

/// What there is to say about a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Problems first.
    pub findings: Vec<Finding>,
    /// By train view.
    pub views: Vec<ViewFigures>,
    /// How far the object's edges lie outside the masks' border, pixels at the size examined; negative inside.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask_margin: Option<i32>,
    /// Mean and least intersection over union with the masks compared with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub iou: Option<[f64; 2]>,
}

impl Report {
    /// Adds a finding, of a view or of the whole scene.
    pub fn add(&mut self, severity: Severity, check: &'static str, view: Option<&str>, message: impl Into<String>) {
        self.findings.push(Finding { severity, check, view: view.map(str::to_owned), message: message.into() });
    }

    /// How many problems there are.
    pub fn problems(&self) -> usize {
        self.findings.iter().filter(|f| f.severity == Severity::Problem).count()
    }

    /// One line for whoever trains.
    pub fn verdict(&self) -> String {
        match self.findings.iter().find(|f| f.severity == Severity::Problem) {
            None => "nothing wrong was found".into(),
            Some(first) => {
                let more = self.problems() - 1;
                let more = if more == 0 { String::new() } else { format!(" (and {more} more: gscream-vk doctor)") };
                format!("{}{more}", first.text())
            }
        }
    }

    fn sort(&mut self) {
        self.findings.sort_by_key(|f| f.severity == Severity::Note);
    }
}

/// The longer side that scenes are examined at, pixels.
pub const SIDE: u32 = 512;

/// Reads a scene and examines it, at its own size or with the longer side at about [`SIDE`] pixels. What the loader
/// refuses is the one problem then. `truth` is a folder of masks to compare the train masks with.
///
/// # Errors
/// A folder of masks that cannot be read.
pub fn examine(folder: &Path, truth: Option<&Path>) -> Result<(Report, Option<Scene>), Error> {
    let mut report = Report::default();
    let first = match scene::load(folder, &scene::Config { downscale: 64, ..scene::Config::default() }) {
        Ok(scene) => scene,
        Err(error) => {
            report.add(Severity::Problem, "scene", None, error.to_string());
            return Ok((report, None));
        }
    };
    let longest = first.train.iter().flat_map(|v| v.camera.size).max().unwrap_or(1) * 64;
    let downscale = ((f64::from(longest) / f64::from(SIDE)).round() as u32).max(1);
    let scene = match scene::load(folder, &scene::Config { downscale, ..scene::Config::default() }) {
        Ok(scene) => scene,
        Err(error) => {
            report.add(Severity::Problem, "scene", None, error.to_string());
            return Ok((report, None));
        }
    };
    for note in &scene.notes {
        let (severity, check) = weigh(note);
        report.add(severity, check, None, &**note);
    }
    examine_scene(&scene, &mut report);
    if let Some(truth) = truth {
        compare(&scene, truth, downscale, &mut report)?;
    }
    report.sort();
    Ok((report, Some(scene)))
}

/// The checks that need no more than a scene that was loaded: for the lines that training prints.
pub fn look(scene: &Scene) -> Report {
    let mut report = Report::default();
    for note in &scene.notes {
        let (severity, check) = weigh(note);
        if severity == Severity::Problem {
            report.add(severity, check, None, &**note);
        }
    }
    examine_scene(scene, &mut report);
    report.sort();
    report
}

/// How bad it is what the loader says, and what it is about: a photograph or a file that is not used is a problem.
fn weigh(note: &Note) -> (Severity, &'static str) {
    match note {
        Note::Lost(_) => (Severity::Problem, "names"),
        Note::Stray(_) => (Severity::Problem, "poses"),
        Note::Plain(_) => (Severity::Note, "scene"),
    }
}

fn examine_scene(scene: &Scene, report: &mut Report) {
    report.views = scene.train.par_iter().map(|view| figures(scene, view)).collect();
    geometry::look(scene, report);
    for (figures, exposure) in report.views.iter_mut().zip(super::exposure::exposures(scene)) {
        figures.exposure = exposure.map(|exposure| exposure.luminance);
    }
    mask_findings(scene, report);
    depth_findings(scene, report);
    exposure_findings(report);
    // The photograph of the place without the object is no painting of it.
    for reference in scene.references.iter().filter(|r| !r.truth) {
        reference_findings(&scene.train[reference.view], reference, report);
    }
}

// ---------------------------------------------------------------- per view

/// A sparse point in a view.
struct Seen {
    pixel: usize,
    depth: f64,
}

/// The points that fall into a view, the nearest of those that share a cell of 4 x 4 pixels: what stands behind is not
/// seen.
fn seen(scene: &Scene, camera: &Camera) -> Vec<Seen> {
    let [w, h] = camera.size;
    let cells = [w.div_ceil(4) as usize, h.div_ceil(4) as usize];
    let mut nearest: Vec<Option<Seen>> = (0..cells[0] * cells[1]).map(|_| None).collect();
    for point in &scene.points {
        let position = point.position.map(f64::from);
        let Some(pixel) = camera.pixel_of(position) else { continue };
        let depth = camera.to_camera(position)[2];
        let cell = &mut nearest[pixel / w as usize / 4 * cells[0] + pixel % w as usize / 4];
        if cell.as_ref().is_none_or(|other| depth < other.depth) {
            *cell = Some(Seen { pixel, depth });
        }
    }
    nearest.into_iter().flatten().collect()
}

fn luminance(color: [u8; 3]) -> f64 {
    let [r, g, b] = color.map(f64::from);
    0.299 * r + 0.587 * g + 0.114 * b
}

fn figures(scene: &Scene, view: &View) -> ViewFigures {
    let inside = |i: usize| view.mask.as_ref().is_some_and(|mask| mask.as_raw()[i] != 0);
    let points: Vec<Seen> = seen(scene, &view.camera).into_iter().filter(|p| !inside(p.pixel)).collect();
    let mask = view
        .mask
        .as_ref()
        .map(|mask| mask.as_raw().iter().filter(|v| **v != 0).count() as f64 / mask.as_raw().len().max(1) as f64);
    let (mut depth_correlation, mut depth_residual) = (None, None);
    if let Some(prior) = &view.prior {
        (depth_correlation, depth_residual) = against_points(prior, &points);
    }
    ViewFigures { name: view.name.clone(), mask, depth_correlation, depth_residual, ..ViewFigures::default() }
}

/// Rank correlation of a prior of the view's size with the points that the view shows; none where they are too few.
pub(crate) fn follows_points(scene: &Scene, view: &View, prior: &Prior) -> Option<f64> {
    against_points(prior, &seen(scene, &view.camera)).0
}

/// Rank correlation and residual of a prior against the points.
fn against_points(prior: &Prior, points: &[Seen]) -> (Option<f64>, Option<f64>) {
    let known: Vec<&Seen> = points.iter().filter(|p| prior.values[p.pixel].is_finite()).collect();
    let truth: Vec<f32> = known
        .iter()
        .map(|p| match prior.kind {
            PriorKind::Depth => p.depth as f32,
            PriorKind::Disparity => (1.0 / p.depth) as f32,
        })
        .collect();
    let values: Vec<f32> = known.iter().map(|p| prior.values[p.pixel]).collect();
    let correlation = rank_correlation(&values, &truth, |_| true);
    let n = values.len() as f64;
    if values.len() < 16 {
        return (correlation, None);
    }
    let mean = |v: &[f32]| v.iter().map(|x| f64::from(*x)).sum::<f64>() / n;
    let (mv, mt) = (mean(&values), mean(&truth));
    let (mut cross, mut own) = (0.0, 0.0);
    for (v, t) in values.iter().zip(&truth) {
        cross += (f64::from(*v) - mv) * (f64::from(*t) - mt);
        own += (f64::from(*v) - mv).powi(2);
    }
    let scale = if own > 0.0 { cross / own } else { 0.0 };
    let off = values.iter().zip(&truth).map(|(v, t)| (scale * (f64::from(*v) - mv) + mt - f64::from(*t)).abs());
    let residual = median(off).zip(median(truth.iter().copied())).map(|(off, size)| off / size);
    (correlation, residual)
}

// ---------------------------------------------------------------- masks

fn mask_findings(scene: &Scene, report: &mut Report) {
    let coverages: Vec<(String, f64)> =
        report.views.iter().filter_map(|view| Some((view.name.clone(), view.mask?))).collect();
    if coverages.is_empty() {
        report.add(Severity::Note, "masks", None, "no view has a mask: nothing will be removed");
        return;
    }
    let missing: Vec<&str> = report.views.iter().filter(|v| v.mask.is_none()).map(|v| v.name.as_str()).collect();
    if let Some(first) = missing.first() {
        let message = format!(
            "{} of {} views have no mask (first: {first}): the object is trained on there; gscream-vk prepare carries masks over",
            missing.len(),
            report.views.len()
        );
        report.add(Severity::Problem, "masks", None, message);
    }
    let mean = coverages.iter().map(|c| c.1).sum::<f64>() / coverages.len() as f64;
    if mean > 0.5 {
        let percent = 100.0 * mean;
        let message = format!(
            "the masks cover {percent:.0} % of the pictures: they seem to be 0 on the object: invert the masks, or say --set scene.invert_masks=true where train is to read them so"
        );
        report.add(Severity::Problem, "masks", None, message);
        return;
    }
    let shown: Vec<&(String, f64)> = coverages.iter().filter(|c| c.1 > 0.0).collect();
    let empty = coverages.len() - shown.len();
    if shown.is_empty() {
        report.add(Severity::Problem, "masks", None, "all masks are empty: nothing will be removed");
        return;
    }
    if empty > 0 {
        let message = format!("{empty} of {} masks are empty: the object is out of view there", coverages.len());
        report.add(Severity::Note, "masks", None, message);
    }
    if shown.len() < 3 {
        let message =
            format!("the object is in {} views only: what is behind it is hardly seen from elsewhere", shown.len());
        report.add(Severity::Problem, "masks", None, message);
    }
    let typical = median(shown.iter().map(|c| c.1)).unwrap_or(0.0);
    for (name, size) in &shown {
        if *size > 6.0 * typical || *size < typical / 12.0 {
            let message = format!(
                "its mask covers {:.2} % of the picture where {:.2} % are usual: is it this view's?",
                100.0 * size,
                100.0 * typical
            );
            report.add(Severity::Problem, "masks", Some(name), message);
        }
    }
    report.mask_margin = margin(scene);
    if let Some(margin) = report.mask_margin.filter(|m| *m >= 2) {
        let message = format!(
            "the strongest edges lie about {margin} pixels outside the masks: they may be too tight; train widens them where \
             the other views disagree (scene.judge_rim), and --set scene.dilate_masks={margin} does at this size in any case"
        );
        report.add(Severity::Note, "masks", None, message);
    }
}

/// The shift of the masks' border, outwards, at which it runs along the strongest edges of the pictures.
fn margin(scene: &Scene) -> Option<i32> {
    const REACH: i32 = 6;
    let views: Vec<(&View, &GrayImage)> = scene.train.iter().filter_map(|v| Some((v, v.mask.as_ref()?))).collect();
    let picked: Vec<_> = views.iter().step_by(views.len().div_ceil(12).max(1)).collect();
    let sums: Vec<Vec<[f64; 2]>> = picked
        .par_iter()
        .map(|(view, mask)| {
            let [w, h] = view.camera.size.map(|n| n as usize);
            let gray: Vec<f64> = view.image.pixels().map(|p| luminance(p.0)).collect();
            let outside = invert(mask);
            let shifted = |by: i32| {
                if by >= 0 {
                    resample::dilate(mask, by as u32)
                } else {
                    invert(&resample::dilate(&outside, by.unsigned_abs()))
                }
            };
            (-REACH..=REACH)
                .map(|by| {
                    // Between this border and the one a pixel farther out lies one ring.
                    let (inner, outer) = (shifted(by - 1), shifted(by));
                    let mut sum = [0.0; 2];
                    for y in 1..h.saturating_sub(1) {
                        for x in 1..w.saturating_sub(1) {
                            let i = y * w + x;
                            if outer.as_raw()[i] != 0 && inner.as_raw()[i] == 0 {
                                sum[0] += f64::hypot(gray[i + 1] - gray[i - 1], gray[i + w] - gray[i - w]);
                                sum[1] += 1.0;
                            }
                        }
                    }
                    sum
                })
                .collect()
        })
        .collect();
    let rings = (2 * REACH + 1) as usize;
    let mean = |k: usize| {
        let [sum, count] = sums.iter().fold([0.0; 2], |all, view| [all[0] + view[k][0], all[1] + view[k][1]]);
        if count > 0.0 { sum / count } else { 0.0 }
    };
    let means: Vec<f64> = (0..rings).map(mean).collect();
    let usual = means.iter().sum::<f64>() / rings as f64;
    let best = (0..rings).max_by(|a, b| means[*a].total_cmp(&means[*b]))?;
    // Without an edge that stands out there is nothing to say.
    (means[best] > 1.2 * usual).then_some(best as i32 - REACH)
}

fn invert(mask: &GrayImage) -> GrayImage {
    let raw = mask.as_raw().iter().map(|v| if *v == 0 { 255 } else { 0 }).collect();
    GrayImage::from_raw(mask.width(), mask.height(), raw).expect("a value per pixel")
}

fn compare(scene: &Scene, truth: &Path, downscale: u32, report: &mut Report) -> Result<(), Error> {
    let files = scene::pictures(truth)?;
    for (view, figures) in scene.train.iter().zip(&mut report.views) {
        let (Some(path), Some(mask)) = (files.get(&view.name), &view.mask) else { continue };
        let other = scene::mask(path, downscale)?;
        if other.dimensions() != mask.dimensions() {
            let [size, picture] = [&other, mask].map(|m| [m.width(), m.height()]);
            return Err(Error::MaskSize { path: path.clone(), size, picture });
        }
        figures.iou = Some(iou(mask, &other));
    }
    let all: Vec<f64> = report.views.iter().filter_map(|view| view.iou).collect();
    if all.is_empty() {
        let what = "no file here has the name of a view with a mask".into();
        return Err(Error::File { path: truth.to_owned(), what });
    }
    let least = all.iter().copied().fold(f64::INFINITY, f64::min);
    report.iou = Some([all.iter().sum::<f64>() / all.len() as f64, least]);
    Ok(())
}

// ---------------------------------------------------------------- depth

/// Below this rank correlation a prior says nothing about the points' depth.
const RELATED: f64 = 0.5;

fn depth_findings(scene: &Scene, report: &mut Report) {
    let of = |view: &ViewFigures| Some((view.name.clone(), view.depth_correlation?, view.depth_residual));
    let all: Vec<(String, f64, Option<f64>)> = report.views.iter().filter_map(of).collect();
    if all.is_empty() {
        return;
    }
    let kind = |name: &str| {
        let prior = scene.train.iter().find(|view| view.name == *name).and_then(|view| view.prior.as_ref());
        prior.map_or("depth", |p| if p.kind == PriorKind::Depth { "depth" } else { "disparity" })
    };
    let backward: Vec<&(String, f64, Option<f64>)> = all.iter().filter(|a| a.1 < -RELATED).collect();
    if let Some((name, r, _)) = backward.first() {
        let (kind, other) = if kind(name) == "depth" { ("depth", "disparity") } else { ("disparity", "depth") };
        let message = format!(
            "{} of {} priors run against the sparse points (first: {name}, rank correlation {r:.2}): they are {other}, not {kind}; \
             rename {kind}/ to {other}/",
            backward.len(),
            all.len()
        );
        report.add(Severity::Problem, "depth", None, message);
    }
    let unrelated: Vec<&(String, f64, Option<f64>)> = all.iter().filter(|a| a.1.abs() <= RELATED).collect();
    for (name, r, _) in unrelated.iter().take(5) {
        let message =
            format!("its prior hardly follows the sparse points (rank correlation {r:.2}): is it this view's?");
        report.add(Severity::Problem, "depth", Some(name), message);
    }
    if let Some(typical) = median(all.iter().filter_map(|a| a.2)) {
        let message = format!(
            "priors agree with the sparse points within {:.1} % (median over views, after scale and shift)",
            100.0 * typical
        );
        report.add(Severity::Note, "depth", None, message);
        for (name, _, residual) in &all {
            if let Some(residual) = residual.filter(|r| *r > 4.0 * typical && *r > 0.03) {
                let message = format!(
                    "its prior is {:.1} % off the sparse points, where {:.1} % are usual",
                    100.0 * residual,
                    100.0 * typical
                );
                report.add(Severity::Note, "depth", Some(name), message);
            }
        }
    }
}

// ---------------------------------------------------------------- exposure

/// Brightness that differs by more than this part from most photographs'.
const DRIFT: f64 = 0.08;

fn exposure_findings(report: &mut Report) {
    let all: Vec<f64> = report.views.iter().filter_map(|view| view.exposure).collect();
    if all.len() < 2 {
        return;
    }
    let off: Vec<(String, f64)> = report
        .views
        .iter()
        .filter_map(|view| Some((view.name.clone(), view.exposure? - 1.0)))
        .filter(|(_, off)| off.abs() > DRIFT)
        .collect();
    let worst = off.iter().max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
    if let Some((name, by)) = worst {
        let message = format!(
            "{} of {} photographs show the same points brighter or darker by more than {:.0} % (most: {name}, {:+.0} %); \
             training evens them out (scene.even_exposures), and a fixed exposure is better still",
            off.len(),
            all.len(),
            100.0 * DRIFT,
            100.0 * by
        );
        report.add(Severity::Note, "exposure", None, message);
    }
}

// ---------------------------------------------------------------- reference

/// Mean differences outside the hole, levels of 255: beyond the first the reference was resampled or compressed, beyond
/// the second it is another photograph.
const TOUCHED: f64 = 4.0;
const OTHER: f64 = 16.0;
/// Shifts that are tried, pixels.
const SHIFT: i32 = 6;

fn reference_findings(view: &View, reference: &Reference, report: &mut Report) {
    let Some(mask) = &view.mask else { return };
    let name = Some(view.name.as_str());
    let hole = resample::dilate(mask, 3);
    let [dx, dy, shifted, still] = registration(&view.image, &reference.image, &hole);
    if shifted < 0.7 * still && (dx, dy) != (0.0, 0.0) && still > 1.0 {
        let message = format!(
            "the reference picture is shifted against its photograph by about {dx:.0}, {dy:.0} pixels (of {} x {}): align it",
            view.camera.size[0], view.camera.size[1]
        );
        report.add(Severity::Problem, "reference", name, message);
    } else if still > TOUCHED {
        let message = format!(
            "the reference picture differs from its photograph by {still:.1} levels of 255 outside the mask, where they should \
             be the same: paste the photograph around the hole"
        );
        let severity = if still > OTHER { Severity::Problem } else { Severity::Note };
        report.add(severity, "reference", name, message);
    }
    let inside = |a: &RgbImage, b: &RgbImage| {
        let pairs = a.pixels().zip(b.pixels()).zip(mask.pixels()).filter(|(_, m)| m.0[0] != 0);
        let (mut same, mut all) = (0u64, 0u64);
        for ((a, b), _) in pairs {
            same += u64::from(a.0.iter().zip(b.0).all(|(a, b)| a.abs_diff(b) <= 2));
            all += 1;
        }
        same as f64 / all.max(1) as f64
    };
    let same = inside(&view.image, &reference.image);
    if same > 0.9 {
        let message = "the reference picture still shows the object: its hole is the photograph's own".to_owned();
        report.add(Severity::Problem, "reference", name, message);
    }
    if let (Some(prior), Some(own)) = (&reference.prior, &view.prior)
        && let Some(r) = rank_correlation(&prior.values, &own.values, |i| {
            hole.as_raw()[i] == 0 && prior.values[i].is_finite() && own.values[i].is_finite()
        })
    {
        let r = if prior.kind == own.kind { r } else { -r };
        if r < RELATED {
            let message =
                format!("the reference's prior hardly follows its view's outside the mask (rank correlation {r:.2})");
            report.add(Severity::Problem, "reference", name, message);
        }
    }
}

/// The shift of `reference` that brings it nearest to `photograph` outside the hole, the mean difference there, and that
/// without a shift (levels of 255).
fn registration(photograph: &RgbImage, reference: &RgbImage, hole: &GrayImage) -> [f64; 4] {
    let (w, h) = (photograph.width() as i32, photograph.height() as i32);
    let difference = |dx: i32, dy: i32| {
        let (mut sum, mut count) = (0f64, 0u32);
        for y in (SHIFT..h - SHIFT).step_by(2) {
            for x in (SHIFT..w - SHIFT).step_by(2) {
                if hole.get_pixel(x as u32, y as u32).0[0] == 0 {
                    let a = photograph.get_pixel(x as u32, y as u32).0;
                    let b = reference.get_pixel((x + dx) as u32, (y + dy) as u32).0;
                    sum += a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0;
                    count += 1;
                }
            }
        }
        sum / f64::from(count.max(1))
    };
    let shifts: Vec<(i32, i32)> = (-SHIFT..=SHIFT).flat_map(|dy| (-SHIFT..=SHIFT).map(move |dx| (dx, dy))).collect();
    let tried: Vec<f64> = shifts.par_iter().map(|(dx, dy)| difference(*dx, *dy)).collect();
    let still = difference(0, 0);
    let best = (0..tried.len()).min_by(|a, b| tried[*a].total_cmp(&tried[*b])).unwrap_or(0);
    // Without a shift is best where all are alike.
    if tried[best] >= still {
        return [0.0, 0.0, still, still];
    }
    [f64::from(shifts[best].0), f64::from(shifts[best].1), tried[best], still]
}

/// Intersection over union of two masks of one size; 1 if both are empty.
pub fn iou(a: &GrayImage, b: &GrayImage) -> f64 {
    let (mut both, mut any) = (0u64, 0u64);
    for (a, b) in a.as_raw().iter().zip(b.as_raw()) {
        both += u64::from(*a != 0 && *b != 0);
        any += u64::from(*a != 0 || *b != 0);
    }
    if any == 0 { 1.0 } else { both as f64 / any as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Luma, Rgb};

    fn noise(w: u32, h: u32) -> RgbImage {
        RgbImage::from_fn(w, h, |x, y| {
            let v = ((x * 73 + y * 151 + x * y * 7) % 255) as u8;
            Rgb([v, v / 2, 255 - v])
        })
    }

    fn mask(rows: &[&str]) -> GrayImage {
        let (w, h) = (rows[0].len() as u32, rows.len() as u32);
        GrayImage::from_fn(w, h, |x, y| Luma([if rows[y as usize].as_bytes()[x as usize] == b'#' { 255 } else { 0 }]))
    }

    #[test]
    fn overlap() {
        let (a, b) = (mask(&["##.", "##."]), mask(&[".##", ".##"]));
        assert_eq!(iou(&a, &b), 2.0 / 6.0);
        assert_eq!((iou(&a, &a), iou(&a, &mask(&["...", "..."]))), (1.0, 0.0));
        assert_eq!(iou(&mask(&["..."]), &mask(&["..."])), 1.0);
    }

    #[test]
    fn a_shifted_reference_is_found() {
        let photograph = noise(80, 60);
        let hole =
            GrayImage::from_fn(80, 60, |x, y| Luma([if x > 30 && x < 50 && y > 20 && y < 40 { 255 } else { 0 }]));
        let shifted = RgbImage::from_fn(80, 60, |x, y| *photograph.get_pixel(x.saturating_sub(3), (y + 2).min(59)));
        let [dx, dy, best, still] = registration(&photograph, &shifted, &hole);
        assert_eq!((dx, dy, best), (3.0, -2.0, 0.0));
        assert!(still > 10.0);
        assert_eq!(registration(&photograph, &photograph, &hole), [0.0; 4]);
    }

    #[test]
    fn priors_are_judged_by_the_points() {
        let points: Vec<Seen> = (0..64).map(|i| Seen { pixel: i, depth: 1.0 + i as f64 * 0.05 }).collect();
        let of = |kind, value: &dyn Fn(f64) -> f64| {
            let values = points.iter().map(|p| value(p.depth) as f32).collect();
            against_points(&Prior { kind, values }, &points)
        };
        let (r, residual) = of(PriorKind::Depth, &|z| 3.0 * z - 1.0);
        assert!(r.unwrap() > 0.999 && residual.unwrap() < 1e-6);
        let (r, residual) = of(PriorKind::Disparity, &|z| 0.2 + 5.0 / z);
        assert!(r.unwrap() > 0.999 && residual.unwrap() < 1e-6);
        // Depth that is called disparity runs the wrong way.
        assert!(of(PriorKind::Disparity, &|z| z).0.unwrap() < -0.999);
        // Where nothing is known there is nothing to say.
        assert_eq!(of(PriorKind::Depth, &|_| f64::NAN), (None, None));
    }

    #[test]
    fn verdicts_name_the_first_problem() {
        let mut report = Report::default();
        assert_eq!(report.verdict(), "nothing wrong was found");
        report.add(Severity::Note, "masks", None, "fine");
        report.add(Severity::Problem, "masks", Some("a"), "wrong");
        report.add(Severity::Problem, "depth", None, "worse");
        report.sort();
        assert_eq!(report.verdict(), "a: wrong (and 1 more: gscream-vk doctor)");
        assert_eq!(report.problems(), 2);
    }
}

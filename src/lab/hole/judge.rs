//! A trained model against the photographs without the object, inside the true masks.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use image::{GrayImage, Luma, RgbImage};
use serde::{Deserialize, Serialize};

use super::truth::{self, Truth};
use super::{Error, Prepared};
use crate::compose::SHADOWS;
use crate::config::Settings;
use crate::evaluate::{self, Figures, Metrics, Region, hole};
use crate::gpu::Gpu;
use crate::lab::ablation::Figure;
use crate::model::stored::Stored;
use crate::render::view::Renderer;
use crate::scene::{self, View, resample};

/// Fewest pixels of a kind in a view from which its figures are taken.
const PIXELS: usize = 64;
/// A pixel lies in the shadow where less than this of the light is left, of 255.
const LIT: u8 = 250;

/// A model that was trained on what the preparation left.
#[derive(Clone, Copy)]
pub(crate) struct Trained<'a> {
    /// Its folder.
    pub model: &'a Path,
    /// As it was trained with.
    pub settings: &'a Settings,
    /// The length that counted as one, in lengths of the scene's files.
    pub unit: f64,
    /// Whether the photographs' exposure was evened out: the model has the usual one, each photograph its own.
    pub evened: bool,
}

/// What of a view was measured, by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewFigures {
    /// The view.
    pub name: String,
    /// As [`super::record::COLUMNS`] has them.
    #[serde(flatten)]
    pub figures: BTreeMap<String, Figure>,
}

/// What a trained model is worth.
pub(crate) struct Judged {
    /// Every view that shows the object and whose camera is right.
    pub views: Vec<ViewFigures>,
    /// Means over the views, and the worst.
    pub figures: BTreeMap<String, Figure>,
    /// By row the view whose mask was given, the one seen from farthest away and the worst; by column the photograph with the
    /// object, the one without it, and what the model shows.
    pub picture: RgbImage,
}

/// Draws every test view of a composed scene whose mask is not empty and whose camera is right, and compares it with its
/// photograph; `go_on` is asked before each.
///
/// # Errors
/// A model or a scene that cannot be read; a device without room; what `go_on` says.
pub(crate) fn judge<E: From<Error>>(
    gpu: &Gpu,
    set: &Path,
    truth: &Truth,
    prepared: &Prepared,
    trained: Trained<'_>,
    go_on: &dyn Fn() -> Result<(), E>,
) -> Result<Judged, E> {
    let Trained { model, settings, unit, evened } = trained;
    let scene = truth::load_reduced(set, settings.scene.downscale)?;
    let mut model = Stored::load(model).map_err(Error::from)?;
    model.rescale(1.0 / unit);
    let mut renderer = Renderer::of(gpu, &model, &settings.render).map_err(Error::from)?;
    let shadows = set.join(SHADOWS);
    let shadows = if shadows.is_dir() { scene::pictures(&shadows).map_err(Error::from)? } else { BTreeMap::new() };
    let (mut views, mut drawn) = (vec![], BTreeMap::new());
    for view in scene.test.iter().filter(|view| !truth.wrong.contains(&view.name)) {
        let Some(mask) = view.mask.as_ref().filter(|mask| count(mask) >= PIXELS) else { continue };
        go_on()?;
        let mut camera = view.camera;
        camera.translation = camera.translation.map(|t| t / unit);
        let mut picture = renderer.render(&camera).map_err(Error::from)?.to_rgb8();
        if evened {
            picture = evaluate::in_exposure_of(&picture, &view.image, Some(mask));
        }
        let object = scene.train.iter().find(|train| train.name == view.name);
        let mut figures = of_view(&picture, view, mask, &truth::maps(set, &view.name, view.camera.size)?)?;
        figures.extend(object.and_then(|object| left(&picture, view, object)).map(|left| ("residue", left)));
        if let Some(path) = shadows.get(&view.name) {
            figures.extend(in_shadow(path, &picture, view)?.map(|levels| ("shadow_levels", levels)));
        }
        let figures = figures.into_iter().map(|(name, value)| (name.to_owned(), Figure(value))).collect();
        views.push(ViewFigures { name: view.name.clone(), figures });
        drawn.insert(view.name.as_str(), (view, object, picture));
    }
    if views.is_empty() {
        return Err(Error::Set { path: set.to_owned(), what: "no test view shows enough of the hole" }.into());
    }
    let picture = sheet(&drawn, &views, prepared);
    Ok(Judged { figures: summary(&views), views, picture })
}

fn count(mask: &GrayImage) -> usize {
    mask.as_raw().iter().filter(|v| **v != 0).count()
}

/// Of the hole, of what of it is seen and what is not, at its rim and outside.
fn of_view(
    picture: &RgbImage,
    view: &View,
    mask: &GrayImage,
    [seen, unseen]: &[GrayImage; 2],
) -> Result<Vec<(&'static str, f64)>, Error> {
    let compare = |map: &GrayImage| -> Result<Metrics, Error> {
        Ok(evaluate::compare_seen(picture, &view.image, Some(mask), Some(map))?)
    };
    let of = |metrics: &Metrics, map: &GrayImage| metrics.of(Region::Mask, true).filter(|_| count(map) >= PIXELS);
    let (of_seen, of_unseen) = (compare(seen)?, compare(unseen)?);
    let mut all = vec![];
    let mut add = |names: [&'static str; 3], figures: Option<Figures>| {
        let Some(Figures { psnr, ssim, flip }) = figures else { return };
        all.extend(names.into_iter().zip([psnr, ssim, flip]));
    };
    add(["masked_psnr", "masked_ssim", "masked_flip"], of_seen.of(Region::Mask, false));
    add(["seen_psnr", "seen_ssim", "seen_flip"], of(&of_seen, seen));
    add(["unseen_psnr", "unseen_ssim", "unseen_flip"], of(&of_unseen, unseen));
    add(["rim_psnr", "rim_ssim", "rim_flip"], of_seen.of(Region::Rim, false));
    add(["outside_psnr", "outside_ssim", "outside_flip"], of_seen.of(Region::Outside, false));
    Ok(all)
}

/// How much of the object is left, 0 to 1, against the photograph without it.
fn left(picture: &RgbImage, view: &View, object: &View) -> Option<f64> {
    let background: Vec<Option<[f64; 3]>> =
        view.image.pixels().map(|pixel| Some(pixel.0.map(|v| f64::from(v) / 255.0))).collect();
    hole::residue(picture, &object.image, &background, view.mask.as_ref()?)
}

/// How much brighter than the photograph without it the model is where the object's shadow fell, levels of 255; negative
/// where shadow is left.
fn in_shadow(path: &Path, picture: &RgbImage, view: &View) -> Result<Option<f64>, Error> {
    let left = image::open(path).map_err(|e| Error::io(path, std::io::Error::other(e)))?.into_luma8();
    let dark =
        GrayImage::from_fn(left.width(), left.height(), |x, y| Luma([255 * u8::from(left.get_pixel(x, y).0[0] < LIT)]));
    let dark = resample::nearest(&dark, view.camera.size);
    let outside = |i: usize| view.mask.as_ref().is_none_or(|mask| mask.as_raw()[i] == 0);
    let (own, truth) = (picture.as_raw(), view.image.as_raw());
    let brighter = |i: usize| (3 * i..3 * i + 3).map(|c| f64::from(own[c]) - f64::from(truth[c])).sum::<f64>() / 3.0;
    let pixels: Vec<usize> = (0..dark.as_raw().len()).filter(|i| dark.as_raw()[*i] != 0 && outside(*i)).collect();
    let mean = pixels.iter().map(|i| brighter(*i)).sum::<f64>() / pixels.len().max(1) as f64;
    Ok((pixels.len() >= PIXELS).then_some(mean))
}

/// Means over the views that have a figure; beside them the worst hole and what is left of the object at most. What is less
/// than nothing of the object is another mistake, which must not make up for what is left of it in other views.
fn summary(views: &[ViewFigures]) -> BTreeMap<String, Figure> {
    let mut by_name: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (name, figure) in views.iter().flat_map(|view| &view.figures) {
        let value = if name == "residue" { figure.0.max(0.0) } else { figure.0 };
        by_name.entry(name).or_default().push(value);
    }
    let mut all: BTreeMap<String, Figure> = by_name
        .iter()
        .map(|(name, values)| ((*name).to_owned(), Figure(values.iter().sum::<f64>() / values.len() as f64)))
        .collect();
    let mut worst = |name: &str, of: &str, choose: fn(f64, f64) -> f64| {
        if let Some(value) = by_name.get(of).and_then(|values| values.iter().copied().reduce(choose)) {
            all.insert(name.to_owned(), Figure(value));
        }
    };
    worst("masked_psnr_worst", "masked_psnr", f64::min);
    worst("residue_worst", "residue", f64::max);
    all
}

/// A drawn view: the view, its photograph with the object, what the model shows.
type Drawn<'a> = (&'a View, Option<&'a View>, RgbImage);

fn sheet(drawn: &BTreeMap<&str, Drawn<'_>>, views: &[ViewFigures], prepared: &Prepared) -> RgbImage {
    let psnr = |view: &&ViewFigures| view.figures.get("masked_psnr").map_or(f64::INFINITY, |figure| figure.0);
    let worst = views.iter().min_by(|a, b| psnr(a).total_cmp(&psnr(b))).map(|view| view.name.as_str());
    let first = prepared.given.iter().map(String::as_str).find(|name| drawn.contains_key(name));
    let first = first.or_else(|| drawn.keys().next().copied());
    let center = |name: &str| drawn.get(name).map_or(DVec3::ZERO, |(view, ..)| DVec3::from(view.camera.center()));
    let from = first.map_or(DVec3::ZERO, center);
    let far = |a: &&&str, b: &&&str| (center(a) - from).length().total_cmp(&(center(b) - from).length());
    let farthest = drawn.keys().max_by(far).copied();
    let rows: Vec<&Drawn<'_>> =
        [first, farthest, worst].into_iter().flatten().filter_map(|name| drawn.get(name)).collect();
    let [width, height] = [0, 1].map(|side| rows.iter().map(|(view, ..)| view.camera.size[side]).max().unwrap_or(1));
    let mut sheet = RgbImage::new(3 * width, height * rows.len() as u32);
    for (row, (view, object, picture)) in rows.into_iter().enumerate() {
        let columns = [object.map(|object| &object.image), Some(&view.image), Some(picture)];
        for (column, picture) in columns.into_iter().enumerate() {
            if let Some(picture) = picture {
                let (x, y) = (column as u32 * width, row as u32 * height);
                image::imageops::replace(&mut sheet, picture, x.into(), y.into());
            }
        }
    }
    sheet
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;
    use crate::scene::Camera;

    fn view(image: RgbImage, mask: GrayImage) -> View {
        let size = [image.width(), image.height()];
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [20.0; 2],
            principal: [10.0; 2],
            distortion: [0.0; 4],
            size,
        };
        View { name: "a".into(), camera, image, mask: Some(mask), weight: None, prior: None, depth: None }
    }

    /// The hole is wrong by 51 of 255 where it is unseen, right where it is seen: 14 dB there, infinite here.
    #[test]
    fn seen_and_unseen_pixels_are_told_apart() {
        let image = RgbImage::from_pixel(40, 30, Rgb([100; 3]));
        let mask =
            GrayImage::from_fn(40, 30, |x, y| Luma([255 * u8::from((5..35).contains(&x) && (5..25).contains(&y))]));
        let half = |left: bool| {
            GrayImage::from_fn(40, 30, |x, y| Luma([mask.get_pixel(x, y).0[0] * u8::from((x < 20) == left)]))
        };
        let drawn = RgbImage::from_fn(40, 30, |x, y| {
            if mask.get_pixel(x, y).0[0] != 0 && x >= 20 { Rgb([151; 3]) } else { Rgb([100; 3]) }
        });
        let view = view(image, mask.clone());
        let found: BTreeMap<_, _> =
            of_view(&drawn, &view, &mask, &[half(true), half(false)]).expect("one size").into_iter().collect();
        assert_eq!(found["seen_psnr"], f64::INFINITY);
        assert!((found["unseen_psnr"] - 20.0 * 5f64.log10()).abs() < 1e-9, "{found:?}");
        assert!((found["masked_psnr"] - 10.0 * 50f64.log10()).abs() < 1e-9, "half of the pixels: {found:?}");
        assert_eq!(found["outside_psnr"], f64::INFINITY);
        // Too few pixels of a kind have no figures.
        let none = GrayImage::new(40, 30);
        let found = of_view(&drawn, &view, &mask, &[none, mask.clone()]).expect("one size");
        assert!(!found.iter().any(|(name, _)| name.starts_with("seen")), "{found:?}");
    }

    #[test]
    fn means_and_the_worst() {
        let view = |name: &str, psnr: f64, left: f64| ViewFigures {
            name: name.into(),
            figures: [("masked_psnr".to_owned(), Figure(psnr)), ("residue".to_owned(), Figure(left))].into(),
        };
        let found = summary(&[view("a", 20.0, -0.5), view("b", 10.0, 0.5)]);
        let of = |name: &str| found[name].0;
        assert_eq!((of("masked_psnr"), of("masked_psnr_worst")), (15.0, 10.0));
        assert_eq!((of("residue"), of("residue_worst")), (0.25, 0.5), "what is missing makes up for nothing");
    }
}

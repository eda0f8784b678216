//! The reference view without the object: what others saw there first, a guess only where nobody looked.
//!
//! The Gaussians that the masks vote out are left out, and the depth of what stands behind them is rendered. Each pixel of
//! the hole is looked up in the other photographs, where the object is elsewhere; a plane sweep around the rendered depth
//! finds the depth at which they agree best. Where two or more show the same colour, that colour was seen. The rest is
//! filled by [`super::patchmatch`].

use std::collections::BTreeMap;
use std::path::Path;

use image::{GrayImage, Rgb, RgbImage};
use rayon::prelude::*;

use super::depth::{self, DepthMap, Witness};
use super::fit::Fit;
use super::masks::{self, Shares, Votes};
use super::network::{self, Inpainting};
use super::patchmatch::{self, Canvas};
use super::planes;
use super::record::Batch;
use super::splats::Splats;
use super::{Error, Watch};
use crate::scene::{self, Camera, PriorKind, Scene, resample};

/// The longer side of the photographs that the hole is filled from, pixels; larger ones are reduced, and the filling is
/// brought to their size.
pub const SIDE: u32 = 1024;
/// Views whose masks vote; of more, every so many.
const VOTERS: usize = 30;
/// Depth of a witness may differ by this part before the point counts as hidden.
const HIDDEN: f64 = 0.08;
/// The reference view's hole is enlarged by this part of the longer side, the others' masks by twice that.
const MARGIN: f64 = 0.003;
/// Photographs that a pixel is looked up in.
const LOOKED_UP: usize = 6;
/// Planes on each side of the rendered depth, and the part of the disparity from one to the next.
const PLANES: i32 = 10;
const PLANE: f64 = 0.012;
/// The sweep's costs are averaged over squares of 2 `WINDOW` + 1 pixels.
const WINDOW: usize = 4;
/// Disagreement is not told apart beyond this, sum over the channels.
const MOST: f32 = 0.5;
/// What a plane costs more than the one before it: the rendered depth is right where nothing speaks against it.
const AWAY: f32 = 0.002;
/// Photographs agree on a pixel if no channel of their means over 3 x 3 pixels differs by more.
const SAME: f32 = 0.09;
/// Views that are asked whether a surface can be there; of more, every so many.
const ASKED: usize = 60;
/// What speaks against a surface that something else than the object hides from all other views; 1 is a proof.
const BURIED: f64 = 0.1;

/// Where each pixel of the reference is from, below the scene's folder.
pub const PROVENANCE: &str = "prepare/provenance.png";

/// What a reference is made from.
pub struct Task<'a> {
    /// The scene at the fit's size.
    pub scene: &'a Scene,
    /// The scene at the size that the hole is filled at.
    pub fine: &'a Scene,
    /// The scene's folder.
    pub root: &'a Path,
    /// By view, as large as the photographs.
    pub masks: &'a [GrayImage],
    /// The view to take.
    pub named: Option<&'a str>,
    /// Whether its depth is written.
    pub depth: bool,
    /// What fills the pixels that nobody saw, in place of PatchMatch.
    pub inpainting: Option<&'a Inpainting>,
    /// What tells its depth, in place of the fit, and what it tells.
    pub depth_network: Option<(&'a network::Depth, PriorKind)>,
    /// Of every random choice.
    pub seed: u64,
}

/// A photograph that pixels are looked up in.
struct Photograph<'a> {
    camera: Camera,
    picture: &'a RgbImage,
    /// Means over 3 x 3 pixels.
    blurred: RgbImage,
    /// Enlarged.
    mask: GrayImage,
    /// With the object, at the fit's size.
    depth: &'a DepthMap,
}

/// A position of one picture in another of the same view.
fn scaled([x, y]: [f64; 2], from: [u32; 2], to: [u32; 2]) -> [f64; 2] {
    [x * f64::from(to[0]) / f64::from(from[0]), y * f64::from(to[1]) / f64::from(from[1])]
}

/// Bilinear, 0 to 1; nothing outside.
fn sample(picture: &RgbImage, [x, y]: [f64; 2]) -> Option<[f32; 3]> {
    let (w, h) = picture.dimensions();
    if !(x >= 0.5 && y >= 0.5 && x <= f64::from(w) - 0.5 && y <= f64::from(h) - 0.5) {
        return None;
    }
    let (x, y) = (x - 0.5, y - 0.5);
    let (u, v) = ((x as u32).min(w.saturating_sub(2)), (y as u32).min(h.saturating_sub(2)));
    let (fx, fy) = ((x - f64::from(u)) as f32, (y - f64::from(v)) as f32);
    let at = |u: u32, v: u32, c: usize| f32::from(picture.get_pixel(u.min(w - 1), v.min(h - 1)).0[c]) / 255.0;
    Some(std::array::from_fn(|c| {
        let above = at(u, v, c) * (1.0 - fx) + at(u + 1, v, c) * fx;
        let below = at(u, v + 1, c) * (1.0 - fx) + at(u + 1, v + 1, c) * fx;
        above * (1.0 - fy) + below * fy
    }))
}

impl Photograph<'_> {
    /// Where it shows a world point, if the object does not stand there and nothing is known to stand before it.
    fn shows(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let pixel = self.camera.project(point)?;
        let [w, h] = self.camera.size;
        if !(pixel[0] >= 1.0 && pixel[1] >= 1.0 && pixel[0] < f64::from(w) - 1.0 && pixel[1] < f64::from(h) - 1.0) {
            return None;
        }
        if self.mask.get_pixel(pixel[0] as u32, pixel[1] as u32).0[0] != 0 {
            return None;
        }
        (self.depth.witness(point, HIDDEN) != Witness::Hidden).then_some(pixel)
    }
}

fn blurred(picture: &RgbImage) -> RgbImage {
    let (w, h) = picture.dimensions();
    RgbImage::from_fn(w, h, |x, y| {
        let mut sum = [0u32; 3];
        let mut count = 0;
        for v in y.saturating_sub(1)..(y + 2).min(h) {
            for u in x.saturating_sub(1)..(x + 2).min(w) {
                let p = picture.get_pixel(u, v);
                (0..3).for_each(|c| sum[c] += u32::from(p.0[c]));
                count += 1;
            }
        }
        Rgb(sum.map(|s| ((s + count / 2) / count) as u8))
    })
}

/// The part of a view's hole that two others at least look into: what it makes a good reference by.
fn seen_elsewhere(of: usize, behind: &DepthMap, maps: &[DepthMap], masks: &[GrayImage]) -> f64 {
    let w = behind.camera.size[0] as usize;
    let hole: Vec<usize> = (0..behind.depth.len()).filter(|i| masks[of].as_raw()[*i] != 0).collect();
    let picked: Vec<usize> = hole.iter().copied().step_by(hole.len().div_ceil(600).max(1)).collect();
    let looked_into = |i: usize| {
        let pixel = [(i % w) as f64 + 0.5, (i / w) as f64 + 0.5];
        let z = f64::from(behind.depth[i]);
        let Some(point) = z.is_finite().then(|| behind.camera.lift(pixel, z)).flatten() else { return false };
        let others = maps.iter().zip(masks).enumerate().filter(|(j, _)| *j != of);
        let seeing = others.filter(|(_, (map, mask))| {
            let open = map.camera.project(point).is_some_and(|[x, y]| {
                let inside = x >= 0.0 && y >= 0.0 && x < f64::from(mask.width()) && y < f64::from(mask.height());
                inside && mask.get_pixel(x as u32, y as u32).0[0] == 0
            });
            open && map.witness(point, 0.05) == Witness::Agrees
        });
        seeing.take(2).count() == 2
    };
    picked.iter().filter(|i| looked_into(**i)).count() as f64 / picked.len().max(1) as f64
}

/// Fills what is not a number with a membrane over what is: values spread inwards, then settle to the mean of their
/// neighbours. Only pixels for which `wanted` says so are filled.
pub(super) fn membrane(values: &mut [f32], size: [usize; 2], wanted: impl Fn(usize) -> bool) {
    let [w, h] = size;
    let missing: Vec<usize> = (0..w * h).filter(|i| !values[*i].is_finite() && wanted(*i)).collect();
    let neighbours = |i: usize| {
        let (x, y) = (i % w, i / w);
        [(x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1), (y > 0).then(|| i - w), (y + 1 < h).then(|| i + w)]
            .into_iter()
            .flatten()
    };
    let mut left = missing.clone();
    while !left.is_empty() {
        let mut ring = vec![];
        for &i in &left {
            let known: Vec<f32> = neighbours(i).map(|j| values[j]).filter(|v| v.is_finite()).collect();
            if !known.is_empty() {
                ring.push((i, known.iter().sum::<f32>() / known.len() as f32));
            }
        }
        if ring.is_empty() {
            return;
        }
        for (i, value) in ring {
            values[i] = value;
        }
        left.retain(|i| !values[*i].is_finite());
    }
    for _ in 0..300 {
        for &i in &missing {
            let (sum, count) = neighbours(i)
                .map(|j| values[j])
                .filter(|v| v.is_finite())
                .fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0));
            if count > 0.0 {
                values[i] = sum / count;
            }
        }
    }
}

/// The votes of the masks on all Gaussians.
fn votes(task: &Task<'_>, fit: &Fit, splats: &mut Splats, watch: &mut dyn Watch) -> Result<Shares, Error> {
    let mut votes = Votes::new(splats);
    let every = task.scene.train.len().div_ceil(VOTERS).max(1);
    for (i, (view, mask)) in task.scene.train.iter().zip(task.masks).enumerate().step_by(every) {
        votes.add(splats, &view.camera, &masks::parts(mask, view.camera.size))?;
        watch.turn(i as u64)?;
    }
    let colors = masks::colors(splats, &task.scene.train)?;
    Ok(votes.count(fit.positions(), &colors))
}

/// Makes the reference picture, the map of where its pixels are from and, if asked for, its depth.
///
/// # Errors
/// A view without a hole; when the device has no room, or is lost.
pub fn make(task: &Task<'_>, fit: &Fit, splats: &mut Splats, watch: &mut dyn Watch) -> Result<Batch, Error> {
    let train = &task.scene.train;
    let n = train.len() as u64;
    let shares = votes(task, fit, splats, watch)?;
    let removed = |name: u32| shares.object[name as usize] > 0.5;
    let mut maps = vec![];
    for (i, view) in train.iter().enumerate() {
        maps.push(DepthMap::of(splats, &view.camera, |_| false)?);
        watch.turn(n / 2 + i as u64 / 2)?;
    }
    let small: Vec<GrayImage> =
        train.iter().zip(task.masks).map(|(view, mask)| depth::enlarged(mask, view.camera.size)).collect();
    let holes: Vec<usize> = (0..train.len()).filter(|i| task.masks[*i].as_raw().iter().any(|v| *v != 0)).collect();
    if holes.is_empty() {
        return Err(Error::Request(
            "no view has the object, so that nothing can be removed; are the masks right?".into(),
        ));
    }
    let (of, behind, seen) = match task.named {
        Some(name) => {
            let of = train.iter().position(|view| view.name == name).expect("the name was looked up before");
            if !holes.contains(&of) {
                return Err(Error::Request(format!(
                    "--reference {name}: the object is not in this view; name one that shows it"
                )));
            }
            let behind = DepthMap::of(splats, &train[of].camera, removed)?;
            let seen = seen_elsewhere(of, &behind, &maps, &small);
            (of, behind, seen)
        }
        None => {
            let mut best: Option<(usize, DepthMap, f64)> = None;
            for (k, &i) in holes.iter().enumerate() {
                let behind = DepthMap::of(splats, &train[i].camera, removed)?;
                let seen = seen_elsewhere(i, &behind, &maps, &small);
                if best.as_ref().is_none_or(|best| seen > best.2) {
                    best = Some((i, behind, seen));
                }
                watch.turn(n + k as u64)?;
            }
            best.expect("there is a view with a hole")
        }
    };
    watch.turn(2 * n)?;
    fill(task, of, &behind, &Others { of, maps: &maps, masks: &small }, seen, watch)
}

/// One pixel's part in the hole's filling.
struct Lookup {
    /// Photographs it is looked up in, the nearest first.
    photographs: Vec<usize>,
}

/// What all views know, by view, at the fit's size.
struct Others<'a> {
    /// The reference view.
    of: usize,
    /// With the object.
    maps: &'a [DepthMap],
    /// Enlarged.
    masks: &'a [GrayImage],
}

impl Others<'_> {
    /// What they say against a surface at a point that the reference sees past the object: 1 if it cannot be there.
    fn against(&self, point: [f64; 3]) -> f64 {
        let (mut through, mut agree, mut hidden, mut asked) = (0u32, 0u32, 0u32, 0u32);
        let every = self.maps.len().div_ceil(ASKED).max(1);
        for (map, mask) in self.maps.iter().zip(self.masks).step_by(every) {
            let said = map.witness(point, HIDDEN);
            asked += u32::from(said != Witness::Silent);
            match said {
                Witness::Contradicts => through += 1,
                Witness::Agrees => agree += 1,
                // What is nearer than the point, if it is not the object, would stand before it here too.
                Witness::Hidden => {
                    let pixel = map.camera.project(point).map(|pixel| pixel.map(|v| v as u32));
                    hidden += u32::from(pixel.is_some_and(|[x, y]| mask.get_pixel(x, y).0[0] == 0));
                }
                Witness::Silent => {}
            }
        }
        if through >= 2 && through > 2 * agree {
            return 1.0;
        }
        BURIED * f64::from(hidden) / f64::from(asked.max(1))
    }
}

fn fill(
    task: &Task<'_>,
    of: usize,
    behind: &DepthMap,
    others: &Others<'_>,
    expected: f64,
    watch: &mut dyn Watch,
) -> Result<Batch, Error> {
    let maps = others.maps;
    let view = &task.fine.train[of];
    let name = &view.name;
    let size = view.camera.size;
    let [w, h] = size.map(|n| n as usize);
    let longest = f64::from(size[0].max(size[1]));
    let margin = (MARGIN * longest).ceil() as u32;
    let hole = resample::dilate(&resample::mask(&task.masks[of], size), margin);
    let cameras: Vec<Camera> = task.fine.train.iter().map(|view| view.camera).collect();
    let order = depth::neighbours(&cameras, of);
    let photographs: Vec<Photograph<'_>> = order
        .par_iter()
        .map(|&j| {
            let other = &task.fine.train[j];
            let mask = resample::mask(&task.masks[j], other.camera.size);
            Photograph {
                camera: other.camera,
                picture: &other.image,
                blurred: blurred(&other.image),
                mask: resample::dilate(&mask, 2 * margin),
                depth: &maps[j],
            }
        })
        .collect();
    watch.turn(2 * task.scene.train.len() as u64 + 1)?;

    // Disparity behind the hole and around it, from the fit without the object.
    let around = resample::dilate(&hole, WINDOW as u32 + 2);
    let coarse = behind.camera.size;
    let mut disparity = vec![f32::NAN; w * h];
    for (i, value) in disparity.iter_mut().enumerate() {
        let position = scaled([(i % w) as f64 + 0.5, (i / w) as f64 + 0.5], size, coarse);
        *value = 1.0 / behind.smooth(position);
    }
    membrane(&mut disparity, [w, h], |_| true);
    let region: Vec<usize> = (0..w * h).filter(|i| around.as_raw()[*i] != 0 && disparity[*i].is_finite()).collect();
    let swept = sweep(view, &hole, &region, &disparity, &photographs);
    for (i, plane) in region.iter().zip(&swept) {
        disparity[*i] *= (1.0 + PLANE * f64::from(*plane)) as f32;
    }
    watch.turn(2 * task.scene.train.len() as u64 + 2)?;

    let found: Vec<(usize, Option<[f32; 3]>)> = region
        .par_iter()
        .filter(|i| hole.as_raw()[**i] != 0)
        .map(|&i| (i, agreed_color(view.camera, i, disparity[i], &photographs)))
        .collect();
    let mut rgb: Vec<[f32; 3]> = view.image.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
    let mut guessed: Vec<bool> = hole.as_raw().iter().map(|v| *v != 0).collect();
    for (i, color) in &found {
        if let Some(color) = color {
            rgb[*i] = *color;
            guessed[*i] = false;
        }
    }
    lonely(&mut guessed, hole.as_raw(), [w, h]);
    // Where nobody looked the sweep has found nothing: the surfaces around are continued.
    let around = surroundings(hole.as_raw(), [w, h]);
    let surfaces = continue_surfaces(&view.camera, &guessed, hole.as_raw(), &mut disparity, others, &around, task.seed);
    membrane(&mut disparity, [w, h], |_| true);
    watch.turn(2 * task.scene.train.len() as u64 + 3)?;
    let guesser = match task.inpainting {
        Some(network) => {
            network.fill(&mut rgb, &guessed, [w, h])?;
            "the inpainting network"
        }
        None => {
            inpaint(&mut rgb, &guessed, &disparity, &surfaces, &around, task.seed);
            "PatchMatch"
        }
    };

    // At the photograph's own size.
    let files = scene::pictures(&task.root.join(super::poses::IMAGES))?;
    let mut picture = scene::photograph(&files[name], 1)?;
    let full = [picture.width(), picture.height()];
    let bytes = rgb.as_flattened().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let filled = RgbImage::from_raw(size[0], size[1], bytes).expect("a colour per pixel");
    let large = if full == size {
        filled
    } else {
        image::imageops::resize(&filled, full[0], full[1], image::imageops::FilterType::CatmullRom)
    };
    let hole_full = resample::nearest(&hole, full);
    let mut provenance = RgbImage::new(full[0], full[1]);
    let mut counts = [0u64; 2];
    for (x, y, inside) in hole_full.enumerate_pixels() {
        if inside.0[0] == 0 {
            continue;
        }
        picture.put_pixel(x, y, *large.get_pixel(x, y));
        let [u, v] = [x * size[0] / full[0], y * size[1] / full[1]];
        let guess = guessed[(v * size[0] + u) as usize];
        provenance.put_pixel(x, y, Rgb(if guess { [230, 60, 40] } else { [40, 170, 70] }));
        counts[usize::from(guess)] += 1;
    }
    let part = counts[0] as f64 / (counts[0] + counts[1]).max(1) as f64;
    let mut batch = Batch::default();
    batch.rgb(
        format!("reference/{name}.png"),
        &picture,
        format!("the photograph; in the hole the colours that two or more other photographs agree on, and {guesser}'s where none does"),
    );
    batch.rgb(
        PROVENANCE,
        &provenance,
        format!("black: the reference's own photograph; green: seen in two or more others; red: seen by none, {guesser}'s guess"),
    );
    if let Some((network, kind)) = task.depth_network.filter(|_| task.depth) {
        let (values, size) = depth::proportioned(network.of(&picture)?, full);
        let from = format!("{}, of the reference picture", network.path().display());
        batch.npy(format!("reference/{name}_{}.npy", depth::word(kind)), size, values, from);
    } else if task.depth {
        let inverse = |i: usize| {
            let [u, v] = [i as u32 % coarse[0], i as u32 / coarse[0]];
            let [x, y] = [(u * size[0] + size[0] / 2) / coarse[0], (v * size[1] + size[1] / 2) / coarse[1]];
            let at = y.min(size[1] - 1) as usize * w + x.min(size[0] - 1) as usize;
            (hole.as_raw()[at] != 0).then(|| 1.0 / disparity[at])
        };
        let outside = depth::agreed(maps, of);
        let values = (0..outside.len()).map(|i| inverse(i).unwrap_or(outside[i])).collect();
        batch.npy(
            format!("reference/{name}_depth.npy"),
            coarse,
            values,
            "the fit's depth; in the hole that of the plane sweep, and of the surfaces around it where nobody looked",
        );
    }
    batch.notes.push(format!(
        "{name} is the reference view: {:.0} % of its hole were seen by others, {:.0} % are guessed",
        100.0 * part,
        100.0 * (1.0 - part)
    ));
    if part == 0.0 {
        batch.notes.push(
            "no other photograph looks behind the object: the whole hole is guessed, and a better picture in reference/ stays"
                .into(),
        );
    }
    batch.figures = BTreeMap::from([("seen".into(), part), ("expected".into(), expected)]);
    Ok(batch)
}

/// The world point behind a pixel.
fn world(camera: &Camera, i: usize, disparity: f64) -> Option<[f64; 3]> {
    let w = camera.size[0] as usize;
    let pixel = [(i % w) as f64 + 0.5, (i / w) as f64 + 0.5];
    (disparity > 0.0 && disparity.is_finite()).then(|| camera.lift(pixel, 1.0 / disparity)).flatten()
}

/// For each pixel of the region the plane at which the photographs agree best.
fn sweep(
    view: &scene::View,
    hole: &GrayImage,
    region: &[usize],
    disparity: &[f32],
    photographs: &[Photograph<'_>],
) -> Vec<i32> {
    let [w, h] = view.camera.size.map(|n| n as usize);
    let own = blurred(&view.image);
    let lookups: Vec<Lookup> = region
        .par_iter()
        .map(|&i| {
            let point = world(&view.camera, i, f64::from(disparity[i]));
            let showing = |j: &usize| point.is_some_and(|point| photographs[*j].shows(point).is_some());
            Lookup { photographs: (0..photographs.len()).filter(showing).take(LOOKED_UP).collect() }
        })
        .collect();
    let planes: Vec<i32> = (-PLANES..=PLANES).collect();
    let costs: Vec<Vec<f32>> = planes
        .par_iter()
        .map(|plane| {
            let mut map = vec![f32::NAN; w * h];
            for (&i, lookup) in region.iter().zip(&lookups) {
                let factor = 1.0 + PLANE * f64::from(*plane);
                let Some(point) = world(&view.camera, i, f64::from(disparity[i]) * factor) else { continue };
                let mut colors: Vec<[f32; 3]> = lookup
                    .photographs
                    .iter()
                    .filter_map(|j| {
                        let pixel = photographs[*j].camera.project(point)?;
                        let [x, y] = pixel.map(|v| v as u32);
                        let other = &photographs[*j];
                        let open = x < other.mask.width() && y < other.mask.height();
                        (open && other.mask.get_pixel(x, y).0[0] == 0).then(|| sample(&other.blurred, pixel)).flatten()
                    })
                    .collect();
                if hole.as_raw()[i] == 0 {
                    colors.extend(sample(&own, [(i % w) as f64 + 0.5, (i / w) as f64 + 0.5]));
                }
                if colors.len() >= 2 {
                    let count = colors.len() as f32;
                    let mean: [f32; 3] = std::array::from_fn(|c| colors.iter().map(|p| p[c]).sum::<f32>() / count);
                    let off = |p: &[f32; 3]| (0..3).map(|c| (p[c] - mean[c]).abs()).sum::<f32>().min(MOST);
                    map[i] = colors.iter().map(off).sum::<f32>() / count;
                }
            }
            average(&map, region, [w, h])
        })
        .collect();
    let best = |k: usize| {
        let cost = |p: usize| {
            let value = costs[p][k];
            if value.is_finite() { value + AWAY * planes[p].unsigned_abs() as f32 } else { f32::INFINITY }
        };
        let p = (0..planes.len()).min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(PLANES as usize);
        if cost(p).is_finite() { planes[p] } else { 0 }
    };
    let chosen: Vec<i32> = (0..region.len()).map(best).collect();
    median(&chosen, region, [w, h])
}

/// Means over squares around the region's pixels, of what is a number.
fn average(map: &[f32], region: &[usize], [w, h]: [usize; 2]) -> Vec<f32> {
    // Sums and counts over all pixels above and to the left.
    let mut sums = vec![[0f64; 2]; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut row = [0f64; 2];
        for x in 0..w {
            let value = map[y * w + x];
            if value.is_finite() {
                row[0] += f64::from(value);
                row[1] += 1.0;
            }
            let above = sums[y * (w + 1) + x + 1];
            sums[(y + 1) * (w + 1) + x + 1] = [above[0] + row[0], above[1] + row[1]];
        }
    }
    let mean = |i: &usize| {
        let (x, y) = (i % w, i / w);
        let (x0, y0) = (x.saturating_sub(WINDOW), y.saturating_sub(WINDOW));
        let (x1, y1) = ((x + WINDOW + 1).min(w), (y + WINDOW + 1).min(h));
        let at = |x: usize, y: usize| sums[y * (w + 1) + x];
        let total = |c: usize| at(x1, y1)[c] - at(x0, y1)[c] - at(x1, y0)[c] + at(x0, y0)[c];
        if total(1) < 1.0 { f32::NAN } else { (total(0) / total(1)) as f32 }
    };
    region.iter().map(mean).collect()
}

/// Medians over 7 x 7 pixels of the region.
fn median(values: &[i32], region: &[usize], [w, h]: [usize; 2]) -> Vec<i32> {
    let mut map = vec![i32::MIN; w * h];
    region.iter().zip(values).for_each(|(i, value)| map[*i] = *value);
    let middle = |i: &usize| {
        let (x, y) = (i % w, i / w);
        let rows = y.saturating_sub(3)..(y + 4).min(h);
        let mut around: Vec<i32> = rows
            .flat_map(|v| (x.saturating_sub(3)..(x + 4).min(w)).map(move |u| v * w + u))
            .map(|j| map[j])
            .filter(|v| *v != i32::MIN)
            .collect();
        around.sort_unstable();
        around[around.len() / 2]
    };
    region.par_iter().map(middle).collect()
}

/// The colour that two photographs or more agree on at a pixel's point, mostly that of the nearest of them.
fn agreed_color(camera: Camera, i: usize, disparity: f32, photographs: &[Photograph<'_>]) -> Option<[f32; 3]> {
    let point = world(&camera, i, f64::from(disparity))?;
    let looked: Vec<([f32; 3], [f32; 3])> = photographs
        .iter()
        .filter_map(|photograph| {
            let pixel = photograph.shows(point)?;
            Some((sample(photograph.picture, pixel)?, sample(&photograph.blurred, pixel)?))
        })
        .take(LOOKED_UP)
        .collect();
    let same = |a: &[f32; 3], b: &[f32; 3]| (0..3).all(|c| (a[c] - b[c]).abs() <= SAME);
    let party = |k: usize| looked.iter().filter(|(_, other)| same(&looked[k].1, other)).count();
    // The largest party; of equal ones that of the nearest photograph.
    let best = (0..looked.len()).rev().max_by_key(|k| party(*k))?;
    if party(best) < 2 {
        return None;
    }
    let members = looked.iter().filter(|(_, other)| same(&looked[best].1, other));
    let (mut sum, mut total) = ([0f32; 3], 0f32);
    for (rank, (color, _)) in members.enumerate() {
        let weight = 0.35f32.powi(rank as i32);
        (0..3).for_each(|c| sum[c] += weight * color[c]);
        total += weight;
    }
    Some(sum.map(|v| v / total))
}

/// A pixel on whose colour two agreed amid others on which nobody did was a chance: it is guessed with them; and the
/// other way round a speck of guesses stays, as it is cheap to fill.
fn lonely(guessed: &mut [bool], hole: &[u8], [w, h]: [usize; 2]) {
    let before = guessed.to_vec();
    for i in (0..w * h).filter(|i| hole[*i] != 0 && !before[*i]) {
        let (x, y) = (i % w, i / w);
        let (mut of_hole, mut open) = (0, 0);
        for v in y.saturating_sub(3)..(y + 4).min(h) {
            for u in x.saturating_sub(3)..(x + 4).min(w) {
                of_hole += 1;
                open += usize::from(!before[v * w + u]);
            }
        }
        guessed[i] = 3 * open < of_hole;
    }
}

/// The pixels of a rectangle.
struct Cells {
    size: [usize; 2],
    /// Their numbers in the whole picture.
    pixels: Vec<usize>,
}

/// The hole's box and as much again on each side: what it is filled from.
fn surroundings(hole: &[u8], [w, h]: [usize; 2]) -> Cells {
    let of_hole: Vec<usize> = (0..w * h).filter(|i| hole[*i] != 0).collect();
    let bounds = |f: &dyn Fn(usize) -> usize, end: usize| {
        let low = of_hole.iter().map(|i| f(*i)).min().unwrap_or(0);
        let high = of_hole.iter().map(|i| f(*i)).max().unwrap_or(end - 1) + 1;
        let margin = (high - low).max(48);
        (low.saturating_sub(margin), (high + margin).min(end))
    };
    let ((x0, x1), (y0, y1)) = (bounds(&|i| i % w, w), bounds(&|i| i / w, h));
    let pixels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| y * w + x)).collect();
    Cells { size: [x1 - x0, y1 - y0], pixels }
}

/// Gives what is guessed the inverse depth of the surfaces around it. Returns `[cell]` the surface.
///
/// No surface stands before the object, nor where other views look through it.
fn continue_surfaces(
    camera: &Camera,
    guessed: &[bool],
    hole: &[u8],
    disparity: &mut [f32],
    others: &Others<'_>,
    around: &Cells,
    seed: u64,
) -> Vec<u8> {
    let w = camera.size[0] as usize;
    let pick = |values: &[f32]| -> Vec<f32> { around.pixels.iter().map(|i| values[*i]).collect() };
    let position = |i: usize| [(i % w) as f64 + 0.5, (i / w) as f64 + 0.5];
    let rays: Vec<Option<[f64; 2]>> = around.pixels.iter().map(|i| camera.unproject(position(*i))).collect();
    // The fit is not sharp at the object's border.
    let [width, height] = camera.size;
    let border = GrayImage::from_raw(width, height, hole.to_vec()).expect("a value per pixel");
    let border = resample::dilate(&border, (depth::MARGIN * f64::from(width.max(height))).ceil() as u32);
    let blurred = |i: usize| border.as_raw()[i] != 0 && hole[i] == 0;
    let unknown: Vec<bool> = around.pixels.iter().map(|i| guessed[*i] || blurred(*i)).collect();
    let outline: Vec<bool> = around.pixels.iter().map(|i| blurred(*i)).collect();
    let against = |cell: usize, d: f64| {
        let pixel = around.pixels[cell];
        let map = &others.maps[others.of];
        let own = map.smooth(scaled(position(pixel), camera.size, map.camera.size));
        if guessed[pixel] && own.is_finite() && d * f64::from(own) > 1.0 + HIDDEN {
            return 1.0;
        }
        world(camera, pixel, d).map_or(1.0, |point| others.against(point))
    };
    let hole = planes::Hole {
        size: around.size,
        disparity: &pick(disparity),
        rays: &rays,
        unknown: &unknown,
        outline: &outline,
        against,
    };
    let found = planes::surfaces(&hole, seed);
    for (i, value) in around.pixels.iter().zip(found.disparity) {
        if guessed[*i] {
            disparity[*i] = value;
        }
    }
    found.label
}

/// PatchMatch over the hole's surroundings, guided by surfaces and disparity.
fn inpaint(rgb: &mut [[f32; 3]], guessed: &[bool], disparity: &[f32], surfaces: &[u8], around: &Cells, seed: u64) {
    let cells = &around.pixels;
    if !guessed.iter().any(|g| *g) {
        return;
    }
    let finite = || cells.iter().map(|i| disparity[*i]).filter(|v| v.is_finite());
    let (low, high) = finite().fold((f32::INFINITY, 0f32), |(low, high), v| (low.min(v), high.max(v)));
    let span = (high - low).max(1e-12);
    let guide = |i: usize| if disparity[i].is_finite() { (disparity[i] - low) / span } else { 0.0 };
    let mut canvas = Canvas {
        size: around.size,
        rgb: cells.iter().map(|i| rgb[*i]).collect(),
        guide: cells.iter().map(|i| guide(*i)).collect(),
        surface: surfaces.to_vec(),
        hole: cells.iter().map(|i| guessed[*i]).collect(),
        source: cells.iter().map(|i| !guessed[*i]).collect(),
    };
    patchmatch::fill(&mut canvas, seed);
    for (i, color) in cells.iter().zip(canvas.rgb) {
        rgb[*i] = color;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_bilinear() {
        let picture = RgbImage::from_fn(4, 3, |x, y| Rgb([(10 * x) as u8, (20 * y) as u8, 7]));
        let [r, g, b] = sample(&picture, [2.0, 1.75]).unwrap();
        assert!((r - 15.0 / 255.0).abs() < 1e-6 && (g - 25.0 / 255.0).abs() < 1e-6 && (b - 7.0 / 255.0).abs() < 1e-6);
        assert_eq!((sample(&picture, [0.2, 1.0]), sample(&picture, [1.0, 2.9])), (None, None));
    }

    /// A linear ramp with a gap is linear again: a membrane over it has no curvature.
    #[test]
    fn a_membrane_continues_a_slope() {
        let ramp = |i: usize| (i % 12) as f32 + 1.0;
        let mut values: Vec<f32> = (0..12 * 9).map(ramp).collect();
        for y in 2..7 {
            for x in 4..8 {
                values[y * 12 + x] = f32::NAN;
            }
        }
        membrane(&mut values, [12, 9], |_| true);
        assert!(values.iter().enumerate().all(|(i, v)| (v - ramp(i)).abs() < 1e-3));
        let mut nothing = vec![f32::NAN; 4];
        membrane(&mut nothing, [2, 2], |_| true);
        assert!(nothing.iter().all(|v| v.is_nan()));
    }

    #[test]
    fn means_are_over_what_is_known() {
        let mut map = vec![f32::NAN; 11 * 9];
        (map[4 * 11 + 5], map[4 * 11 + 9]) = (1.0, 4.0);
        let means = average(&map, &[4 * 11 + 5, 4 * 11, 0], [11, 9]);
        assert_eq!(means[0], 2.5);
        assert!(means[1].is_nan() && means[2].is_nan());
        // Five pixels to the left of the first value: out of reach by one; four: in reach.
        assert_eq!(average(&map, &[4 * 11 + 1], [11, 9])[0], 1.0);
    }
}

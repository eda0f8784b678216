//! The scene without the object: one surface behind it, filled once, for every view.
//!
//! - `front`: what stands before the object stays.
//! - `flat`: what is bare lies on the planes around it.
//! - `residue`: what is left of a shadow that was taken out goes with the object.
//! - [`complete`]: masks that end before the object does grow, and views that have it elsewhere are not asked.
//! - `covered`: where depth does not tell surfaces apart, what they look like does (`material`).
//! - `corner`: a surface whose edge goes into the hole ends at a right angle, and its front goes on up to there.
//! - `surface`: the depth of what is behind the object, in all views, by what they know of a point (`witness`).
//! - `color`: what photographs show of it, and what views that were filled before show of it (`relief`).
//! - `guess`: what nobody shows is filled with pieces of the same surface, seen straight on (`texture`), lines and straight
//!   borders of what looks different first (`lines`, `regions`), or by a network.
//! - [`repaint`]: what is filled wrong the user makes anew, for all views.
//!
//! One view is the reference: its picture goes to `reference/`, where a better one may take its place. All other views'
//! holes are filled from the same surface, into `hole/`.

mod color;
pub mod complete;
mod corner;
mod covered;
mod flat;
mod front;
mod gradient;
pub mod ground;
mod guess;
mod holed;
mod island;
mod lines;
mod material;
mod photograph;
mod regions;
mod relief;
pub mod repaint;
mod residue;
mod similar;
mod support;
mod surface;
mod texture;
mod votes;
mod window;
mod witness;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use image::{GrayImage, Rgb, RgbImage, Rgba, RgbaImage};
use rayon::prelude::*;

use super::depth;
use super::network::{self, Inpainting};
use super::record::Batch;
use super::{Error, Watch};
use crate::multiview::Matched;
use crate::scene::{self, Camera, DOUBTFUL, GUESSED, HOLE, MADE_WITH, PriorKind, Scene, resample};
use color::{Filled, Filling};
use photograph::Photograph;
use surface::{Sight, Sights};

/// The longer side of the photographs that the hole is filled from, pixels; larger ones are reduced, and the filling is
/// brought to their size.
pub const SIDE: u32 = 1024;
/// The object's masks are enlarged by this part of the picture's longer side: carried masks end a little inside the object.
const MARGIN: f64 = 0.008;
/// Depth of the object bleeds over its border by this part of the picture's longer side: half a window of the matching.
const BLEEDING: f64 = 0.03;
/// A view is taken for the reference only if its hole is at least this part of the largest one.
const LEAST_HOLE: f64 = 0.4;
/// Views whose pictures are filled at once: each is held as float32.
const AT_ONCE: usize = 16;
/// Views whose holes are filled, at most, besides those that the user has painted; and how many of them are those that show most of what no
/// other does. The rest is spread over the capture: neighbours show the same surface.
const FILLED: usize = 96;
const FIRST: usize = 24;
/// Name of the way in which holes are filled: a scene that was filled in another way is filled anew.
pub const METHOD: &str = "one surface with smooth ends, nothing where others look through it, no colour from a rim that looks like nothing near it, \
     lights joined, doubts left to training, nothing stands on what only crosses the floor, lines go on through holes and to walls behind, \
     what is nearly one plane is one, copies nearly keep their hue, ends are where the first view has them, \
     nothing from views with the object elsewhere, nor from the lesser part of a torn model, masks of wrong cameras stay, nothing stands where the first view looks through, surfaces by what they are covered with, \
     straight borders go on, those that end in a hole too, surfaces end at right angles, their fronts and the faces below \
     them go on up to there, grain is kept, floors end at their walls, planes have their materials, which have grain, what is bare of the object refutes nothing, the reference has no shadow, no \
     small piece hangs in a hole, what is guessed is noted, nothing shows through what the object stands on, what is doubtful \
     is not guessed, noise makes no planes and refutes nothing, nothing large is made of a surface of which little is seen, what all have right beside the \
     object is guessed, what stands behind the object is none of it, no thing apart is copied, what is seen keeps its hue, joints go on to walls right behind, what is near is made of what is near, tops that hardly show are found where the object ends, or the sides below them do, and end at their rims, over which no depth bleeds, and of many views some are \
     filled";
/// Where each pixel of the reference is from, below the scene's folder.
pub const PROVENANCE: &str = "prepare/provenance.png";

/// What the holes are filled from.
pub struct Task<'a> {
    /// The photographs, matched with each other.
    pub matched: &'a Matched,
    /// The scene at the size that depth is measured at.
    pub scene: &'a Scene,
    /// The scene at the size that the holes are filled at.
    pub fine: &'a Scene,
    /// The scene's folder.
    pub root: &'a Path,
    /// `[train view]` masks, as large as the photographs.
    pub masks: &'a [GrayImage],
    /// The user's own reference pictures: the hash of each by the index of its train view. They outrank all guesses.
    pub given: &'a BTreeMap<usize, String>,
    /// The reference view, where it is named.
    pub named: Option<&'a str>,
    /// Whether the soft shadow around the object's foot goes with it.
    pub shade: bool,
    /// Whether the reference's depth is written.
    pub depth: bool,
    /// What fills the pixels that nobody saw, in place of pieces of the surroundings.
    pub inpainting: Option<&'a Inpainting>,
    /// What tells the reference's depth, in place of the surface, and what it tells.
    pub depth_network: Option<(&'a network::Depth, PriorKind)>,
    /// Seed of every random choice.
    pub seed: u64,
}

/// Where a view's reference picture is, below the scene's folder.
pub fn reference_path(view: &str) -> String {
    format!("reference/{view}.png")
}

pub(super) use crate::scene::BEHIND;

fn behind_path(view: &str) -> String {
    format!("{BEHIND}{view}.npy")
}

/// Pixels that are this part of a mask's longer side.
fn radius(mask: &GrayImage, part: f64) -> u32 {
    (part * f64::from(mask.width().max(mask.height()))).ceil() as u32
}

/// Masks enlarged by a part of the longer side.
fn enlarged(masks: &[GrayImage], part: f64) -> Vec<GrayImage> {
    masks.par_iter().map(|mask| resample::dilate(mask, radius(mask, part))).collect()
}

/// Makes the reference picture, its depth if asked for, the filled holes of all other views, and the map of where the
/// reference's pixels are from.
///
/// # Errors
/// A view without a hole; when the device has no room, or is lost.
pub fn make(task: &Task<'_>, watch: &mut dyn Watch) -> Result<Batch, Error> {
    let n = task.scene.train.len() as u64;
    let cameras: Vec<Camera> = task.fine.train.iter().map(|view| view.camera).collect();
    let mut masks: Vec<GrayImage> =
        task.masks.par_iter().zip(&cameras).map(|(mask, camera)| resample::mask(mask, camera.size)).collect();
    let mut grids = task.matched.depths(&super::masked(task.scene, task.masks));
    watch.turn(n)?;
    log::debug!("hole: depth is measured");
    let mut batch = Batch::default();
    for view in complete::astray(&grids, &cameras, &masks) {
        grids[view].trusted = false;
        batch.notes.push(format!(
            "{}: the object is not where this photograph's camera and mask have it, by what the others show of it; no hole is filled from \
             this photograph",
            task.scene.train[view].name
        ));
    }
    let grown = complete::complete(&grids, &cameras, &mut masks);
    if let Some(first) = grown.first() {
        batch.notes.push(format!(
            "{} of {n} masks end before the object does, by what the other views show of it; there the hole is larger than \
             the mask (first: {})",
            grown.len(),
            task.scene.train[*first].name
        ));
    }
    let wide = enlarged(&masks, BLEEDING);
    let mut masks = front::enlarged(&grids, &task.fine.train, &masks, MARGIN);
    if task.shade {
        residue::add(task.root, &task.fine.train, &mut masks)?;
    }
    let with_holes: Vec<usize> = (0..masks.len()).filter(|i| masks[*i].as_raw().iter().any(|v| *v != 0)).collect();
    if with_holes.is_empty() {
        return Err(Error::Request(
            "no view has the object, so that nothing can be removed; are the masks right?".into(),
        ));
    }
    let mut sights = Sights::new(grids, &cameras, &masks, &wide);
    sights.flatten(task.seed);
    log::debug!("hole: planes are found");
    let shown = shown_by_others(&sights, &with_holes);
    let of = reference(task, &sights, &shown)?;
    let photographed = |masks: &[GrayImage]| -> Vec<Photograph<'_>> {
        let views = task.fine.train.iter().zip(masks);
        views.map(|(view, hole)| Photograph { camera: view.camera, picture: &view.image, hole: hole.clone() }).collect()
    };
    let photographs = photographed(&masks);
    let mut filled: Vec<(usize, Filled)> = vec![];
    let expected = part(&shown[&of]);
    if !sights.0[of].covered.is_empty() {
        sights.0[of].borders = guess::ends(&sights.0[of], &photographs[of]);
        let mut solved = sights.clone();
        solved.solve(of, task.seed);
        let ends = solved.0[of].cut_off(&photographs[of]);
        let sight = &mut sights.0[of];
        (sight.borders, sight.cuts) = (ends.borders, ends.cuts);
        sight.covered.extend(ends.faces);
    }
    sights.solve(of, task.seed);
    // After the reference those that show most of what is still unknown.
    let unknown = |i: usize| {
        let told = sights.told(of, i);
        shown[&i].iter().zip(told).filter(|(shown, told)| !**shown && !told).count()
    };
    let mut rest: Vec<(usize, usize)> = with_holes.iter().filter(|i| **i != of).map(|i| (unknown(*i), *i)).collect();
    rest.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    watch.turn(n + 1)?;
    // What the user has painted is known to all others.
    rest.sort_by_key(|(_, i)| !task.given.contains_key(i));
    let rest: Vec<usize> = rest.into_iter().map(|(_, i)| i).collect();
    let (some, left) = chosen(&rest, task.given.len().max(FIRST), task.given.len().max(FILLED));
    let order: Vec<usize> = std::iter::once(of).chain(some).collect();
    for i in order.iter().filter(|i| **i != of) {
        sights.solve(*i, task.seed + *i as u64);
    }
    log::debug!("hole: every view has its surface");
    let (mut done, mut doubtful, mut all) = (0, 0, 0);
    for some in order.chunks(AT_ONCE) {
        let gathered: Vec<Filling> = some.par_iter().map(|i| color::gather(&sights, &photographs, *i)).collect();
        log::debug!("hole: {} views are gathered, {done} are filled", some.len());
        for (&i, mut filling) in some.iter().zip(gathered) {
            color::repaint(&sights, &photographs, &filled, i, &mut filling);
            if !task.given.is_empty() || task.inpainting.is_some() {
                // What a person or a network has painted is not for us to doubt.
                filling.doubtful.iter_mut().zip(&filling.seen).for_each(|(doubtful, seen)| *doubtful &= seen);
            }
            // Doubtful pixels are left to training; a picture that is looked at is filled everywhere.
            let guessed = filling.guessed.iter().zip(&filling.doubtful);
            let wanted: Vec<bool> = guessed.map(|(guessed, doubtful)| *guessed && (i == of || !doubtful)).collect();
            // What was made for this view the others get from it; what photographs show they look up themselves.
            let made: Vec<bool> = if task.given.contains_key(&i) {
                photographs[i].hole.as_raw().iter().map(|v| *v != 0).collect()
            } else {
                guess::thick(&wanted, cameras[i].size)
            };
            if task.given.contains_key(&i) {
                painted(task, i, &photographs[i].hole, &mut filling)?;
            } else if let Some(network) = task.inpainting {
                network.fill(&mut filling.rgb, &filling.guessed, cameras[i].size.map(|n| n as usize))?;
            } else {
                guess::fill(&sights, &photographs, i, &mut filling, &wanted);
            }
            let guessed = |hole: &u8, seen: &bool| if *hole != 0 && !seen { 255 } else { 0 };
            let guessed =
                photographs[i].hole.as_raw().iter().zip(&filling.seen).map(|(hole, seen)| guessed(hole, seen));
            let [w, h] = cameras[i].size;
            let guessed = GrayImage::from_raw(w, h, guessed.collect()).expect("a byte per pixel");
            let name = &task.fine.train[i].name;
            batch.gray(format!("{GUESSED}/{name}.png"), &guessed, "white: seen by no photograph, guessed");
            if i == of {
                of_reference(task, of, &filling, &photographs[of], &sights, expected, &mut batch)?;
            }
            if !task.given.contains_key(&i) {
                doubtful += filling.doubtful.iter().filter(|doubtful| **doubtful).count();
                all += photographs[i].hole.as_raw().iter().filter(|hole| **hole != 0).count();
                let picture = cut_out(&as_exposed(task, i, &filling.rgb), &filling.doubtful, &photographs[i].hole);
                batch.rgba(
                    format!("{HOLE}/{name}.png"),
                    &picture,
                    "the surface behind the object, filled once for all views",
                );
                let camera = &task.scene.train[i].camera;
                let depth = known_depth(&sights.0[i], camera, task.scene.unit, |_| true);
                batch.npy(behind_path(name), camera.size, depth, "depth of the surface behind the object");
            }
            if made.contains(&true) {
                filled.push((i, Filled::new(&sights.0[i], &cameras[i], filling.rgb, made)));
            }
            done += 1;
            watch.turn(n + 1 + done)?;
        }
    }
    if !left.is_empty() {
        batch.notes.push(format!(
            "the holes of {} of {} views are filled, spread over the capture; the others show the same surface, and are left to training",
            order.len(),
            with_holes.len()
        ));
    }
    for i in left {
        let own = photographs[i].picture.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect::<Vec<_>>();
        let hole = &photographs[i].hole;
        let picture = cut_out(&own, &vec![true; own.len()], hole);
        let name = &task.fine.train[i].name;
        batch.rgba(format!("{HOLE}/{name}.png"), &picture, "left to training: others show the same");
        done += 1;
        watch.turn(n + 1 + done)?;
    }
    let percent = (100.0 * doubtful as f64 / all.max(1) as f64).round();
    if percent > 0.0 {
        batch.notes.push(format!(
            "{percent} % of the holes are left to training on the other photographs, which do not agree on how far away it is there"
        ));
    }
    let name = |i: usize| reference_path(&task.scene.train[i].name);
    let mut made_with: Vec<String> = task.given.iter().map(|(i, hash)| format!("{hash} {}\n", name(*i))).collect();
    if !task.given.contains_key(&of) {
        made_with.extend(batch.hash_of(&name(of)).map(|hash| format!("{hash} {}\n", name(of))));
    }
    let from = "the reference pictures that the holes were filled with";
    batch.bytes(format!("{HOLE}/{MADE_WITH}"), made_with.concat().into_bytes(), from);
    Ok(batch)
}

/// Views that are filled, `most` of these at most, and those that are not, in their order. Filled are the `first` of them, and others evenly
/// spread by their numbers, which follow their names.
fn chosen(views: &[usize], first: usize, most: usize) -> (Vec<usize>, Vec<usize>) {
    if views.len() <= most {
        return (views.to_vec(), vec![]);
    }
    let (first, rest) = views.split_at(first.min(most));
    let mut sorted = rest.to_vec();
    sorted.sort_unstable();
    let count = most - first.len();
    let spread: BTreeSet<usize> = (0..count).map(|k| sorted[(2 * k + 1) * sorted.len() / (2 * count)]).collect();
    let (some, left): (Vec<usize>, Vec<usize>) = rest.iter().partition(|i| spread.contains(i));
    (first.iter().copied().chain(some).collect(), left)
}

/// Takes the hole from the user's own reference picture.
fn painted(task: &Task<'_>, i: usize, hole: &GrayImage, filling: &mut Filling) -> Result<(), Error> {
    let picture = scene::photograph(&task.root.join(reference_path(&task.scene.train[i].name)), 1)?;
    let picture = resample::photograph(&picture, [hole.width(), hole.height()]);
    let gain = task.fine.gains.get(i).copied().unwrap_or([1.0; 3]);
    for (pixel, color) in picture.pixels().enumerate().filter(|(pixel, _)| hole.as_raw()[*pixel] != 0) {
        filling.rgb[pixel] = std::array::from_fn(|c| f32::from(color.0[c]) / 255.0 / gain[c] as f32);
        (filling.guessed[pixel], filling.seen[pixel]) = (false, false);
    }
    Ok(())
}

/// Colours in a view's own exposure.
fn as_exposed(task: &Task<'_>, i: usize, rgb: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let gain = task.fine.gains.get(i).copied().unwrap_or([1.0; 3]);
    rgb.iter().map(|color| std::array::from_fn(|c| color[c] * gain[c] as f32)).collect()
}

/// A filled picture as large as its photograph.
fn enlarged_to(filled: RgbImage, full: [u32; 2]) -> RgbImage {
    if filled.dimensions() == (full[0], full[1]) {
        return filled;
    }
    image::imageops::resize(&filled, full[0], full[1], image::imageops::FilterType::CatmullRom)
}

/// `[view][site of the hole]` whether other photographs show what is there, of these views.
type Shown = BTreeMap<usize, Vec<bool>>;

fn shown_by_others(sights: &Sights, views: &[usize]) -> Shown {
    let of = |i: usize| {
        let carried = sights.carried(i).into_iter().zip(&sights.0[i].hole);
        carried.filter(|(_, hole)| **hole).map(|((_, photographed), _)| photographed).collect()
    };
    views.iter().map(|i| (*i, of(*i))).collect()
}

/// The part of a hole that is shown.
fn part(shown: &[bool]) -> f64 {
    shown.iter().filter(|shown| **shown).count() as f64 / shown.len().max(1) as f64
}

/// The view whose hole is seen best by others, or the named one.
fn reference(task: &Task<'_>, sights: &Sights, shown: &Shown) -> Result<usize, Error> {
    if let Some(name) = task.named {
        let of = task.scene.train.iter().position(|view| view.name == name).expect("the name was looked up before");
        if !shown.contains_key(&of) {
            return Err(Error::Request(format!(
                "--reference {name}: the object is not in this view; name one that shows it"
            )));
        }
        return Ok(of);
    }
    if let Some(of) = task.given.keys().find(|i| shown.contains_key(i)) {
        return Ok(*of);
    }
    let largest = shown.values().map(Vec::len).max().unwrap_or(0) as f64;
    let large = shown.iter().filter(|(i, s)| sights.0[**i].grid.trusted && s.len() as f64 >= LEAST_HOLE * largest);
    let best = large.map(|(i, shown)| (part(shown), *i)).reduce(|best, next| if next.0 > best.0 { next } else { best });
    let first = || *shown.keys().next().expect("a view has a hole");
    Ok(best.map_or_else(first, |(_, i)| i))
}

/// The filled hole and a little around it: whole colours, alpha in the hole alone, [`DOUBTFUL`] where it is.
fn cut_out(rgb: &[[f32; 3]], doubtful: &[bool], hole: &GrayImage) -> RgbaImage {
    /// Pixels around the hole whose colours are kept, so that a reduced picture mixes in none that is not there.
    const KEPT: u32 = 8;
    let (w, h) = hole.dimensions();
    let near = resample::dilate(hole, KEPT);
    RgbaImage::from_fn(w, h, |x, y| {
        let i = (y * w + x) as usize;
        if near.as_raw()[i] == 0 {
            return Rgba([0; 4]);
        }
        let [r, g, b] = rgb[i].map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
        Rgba([r, g, b, hole.as_raw()[i].min(if doubtful[i] { DOUBTFUL } else { 255 })])
    })
}

/// The reference's files, notes and figures.
fn of_reference(
    task: &Task<'_>,
    of: usize,
    filling: &Filling,
    photograph: &Photograph<'_>,
    sights: &Sights,
    expected: f64,
    batch: &mut Batch,
) -> Result<(), Error> {
    let name = &task.fine.train[of].name;
    let size = photograph.camera.size;
    let guesser = if task.inpainting.is_some() { "an inpainting network" } else { "the surroundings" };
    // At the photograph's own size.
    let files = scene::pictures(&task.root.join(super::poses::IMAGES))?;
    let picture = scene::photograph(&files[name], 1)?;
    let full = [picture.width(), picture.height()];
    // What is left of the shadow beside the hole would be a dark line around it in a smaller picture.
    let light = task.root.join(scene::RELIGHT).join(format!("{name}.png"));
    let mut picture = scene::relit(light.is_file().then_some(light.as_path()), &picture, full)?;
    let bytes = as_exposed(task, of, &filling.rgb);
    let bytes = bytes.as_flattened().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let large = enlarged_to(RgbImage::from_raw(size[0], size[1], bytes).expect("a colour per pixel"), full);
    let hole = resample::nearest(&photograph.hole, full);
    let mut provenance = RgbImage::new(full[0], full[1]);
    let mut counts = [0u64; 2];
    for (x, y, inside) in hole.enumerate_pixels() {
        if inside.0[0] == 0 {
            continue;
        }
        picture.put_pixel(x, y, *large.get_pixel(x, y));
        let [u, v] = [x * size[0] / full[0], y * size[1] / full[1]];
        let seen = filling.seen[(v * size[0] + u) as usize];
        provenance.put_pixel(x, y, Rgb(if seen { [40, 170, 70] } else { [230, 60, 40] }));
        counts[usize::from(!seen)] += 1;
    }
    let part = counts[0] as f64 / (counts[0] + counts[1]).max(1) as f64;
    batch.rgb(
        reference_path(name),
        &picture,
        format!("the photograph without the object's shadow; in the hole what other photographs show behind the object, and from {guesser} where none does"),
    );
    batch.rgb(
        PROVENANCE,
        &provenance,
        format!(
            "black: the reference's own photograph; green: seen by others; red: seen by none, guessed from {guesser}"
        ),
    );
    if let Some((network, kind)) = task.depth_network.filter(|_| task.depth) {
        let (values, size) = depth::proportioned(network.of(&picture)?, full);
        let from = format!("{}, of the reference picture", network.path().display());
        batch.npy(format!("reference/{name}_{}.npy", depth::word(kind)), size, values, from);
    } else if task.depth {
        let camera = &task.scene.train[of].camera;
        batch.npy(
            format!("reference/{name}_depth.npy"),
            camera.size,
            known_depth(&sights.0[of], camera, task.scene.unit, |site| sights.0[of].grid.confirmed[site]),
            "depth measured between the photographs; in the hole that of the surface behind the object",
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
    Ok(())
}

/// `[pixel]` depth z of a view without the object at the size of a camera: in the hole that of its surface, elsewhere that of sites
/// that are `known`; NaN at others. In the model's units, of which the sight counts `unit` as one.
fn known_depth(sight: &Sight, camera: &Camera, unit: f64, known: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let w = camera.size[0] as usize;
    let one = |i: usize| {
        let place = sight.grid.place(camera.unproject([(i % w) as f64 + 0.5, (i / w) as f64 + 0.5])?);
        let site = sight.grid.site(place[0].floor() as i64, place[1].floor() as i64)?;
        (sight.hole[site] || known(site)).then(|| (sight.depth_at(place) * unit) as f32)
    };
    (0..w * camera.size[1] as usize).into_par_iter().map(|i| one(i).unwrap_or(f32::NAN)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_are_filled_and_the_rest_evenly() {
        let views: Vec<usize> = (0..100).rev().collect();
        let (filled, left) = chosen(&views, 10, 40);
        assert_eq!((filled.len(), left.len()), (40, 60));
        assert_eq!(filled[..10], views[..10]);
        // In their order, and between two of them are two or three that are left.
        assert!(filled.is_sorted_by(|a, b| a > b));
        let gaps: Vec<usize> = filled[10..].windows(2).map(|pair| pair[0] - pair[1]).collect();
        assert!(gaps.iter().all(|gap| (2..=4).contains(gap)), "{gaps:?}");
        assert!(filled[39] <= 3 && filled[10] >= 86, "{filled:?}");
        let mut all = [filled, left].concat();
        all.sort_unstable_by(|a, b| b.cmp(a));
        assert_eq!(all, views);
        // Few are filled all, and all that come first where these are the most.
        assert_eq!(chosen(&views, 10, 100), (views.clone(), vec![]));
        assert_eq!(chosen(&views, 40, 40), (views[..40].to_vec(), views[40..].to_vec()));
        assert_eq!(chosen(&[], 1, 1), (vec![], vec![]));
    }
}

//! The object's shadow on the surface that it stands on: found once on the surface, and taken out of every photograph.
//!
//! A static shadow contradicts nothing between views, so that no comparison of views finds it, and it stays when the object
//! goes. Here the surface is found ([`plane`]) and seen straight from above ([`texture`]); a shadow is a place of it that is
//! darker by one ratio of all channels where a light from one side would put the object's ([`detect`]). Photographs of it are
//! made brighter by the inverse ratio ([`relight`]): what it lies on keeps its texture, and nothing has to be painted. A
//! shadow that no light from one side explains is looked for as a soft one (`soft`). The photographs stay as they are;
//! `relight/NAME.png` says what is left of each pixel's light, and training divides by it.

mod border;
pub mod detect;
pub mod mixture;
pub mod plane;
pub mod relight;
mod soft;
pub mod texture;

use glam::DVec3;
use image::GrayImage;
use rayon::prelude::*;

use super::depth::{self, DepthMap};
use super::record::Batch;
use super::{Error, Watch};
use crate::multiview::DepthGrid;
use crate::scene::{Camera, Scene, up};
use crate::statistics::{median, quantile};
use detect::{Shadow, Verdict};
use plane::Support;
use texture::{Photograph, Texture};

/// A rectified surface and what stands on it, in cells.
pub struct Ground<'a> {
    /// Cells on each side.
    pub side: usize,
    /// `[cell]` logarithms of the channels; not a number where nothing is known.
    pub log: &'a [[f32; 3]],
    /// Places of the object: along both sides and above the surface, cells.
    pub object: &'a [[f64; 3]],
    /// The object's height, cells.
    pub height: f64,
}

/// The longer side of the photographs that a shadow is looked for in, pixels.
pub const SIDE: u32 = 1024;
/// Name of the way in which it is looked for: where that was another one it is looked for anew.
pub const METHOD: &str = "on the plane of measured depth, soft ones of many views too, to their end, below what is round, by \
                          parts where they differ, none where nothing is seen";
/// A picture of what was found, below the scene's folder.
pub const PICTURE: &str = "prepare/shadow.png";
/// Places that are looked at, of the object and of what is around it.
const PLACES: usize = 4000;
const AROUND: usize = 8000;
/// A place is the object's if the masks have it in this share of the views that show it.
const OBJECT: f64 = 0.8;
/// Surroundings reach so many radii of the object's.
const NEAR: f64 = 3.0;
/// The lowest places of an object, this share of them, are seen unless they are higher than this share of its height.
const LOWEST: (f64, f64) = (0.05, 0.1);
/// Views of which each has to see the shadow about as dark as all of them do.
const VIEWS: f64 = 0.7;
/// The share of all photographs that have to see enough of a soft shadow to tell: a few may be mixed with the object's own colours.
const TELLING: f64 = 0.25;
/// About as dark: the logarithm of what is left differs by this share at most, or by so much.
const SAME: [f64; 2] = [0.4, 0.06];

/// What to do about the object's shadow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Answer {
    /// Look for it, and take it out of the photographs.
    #[default]
    Remove,
    /// Leave it where it is.
    Keep,
}

impl Answer {
    /// Its name on the command line and in the record.
    pub fn name(self) -> &'static str {
        match self {
            Self::Remove => "remove",
            Self::Keep => "keep",
        }
    }
}

/// What a shadow is looked for in.
pub struct Task<'a> {
    /// The scene at the size that depth is measured at.
    pub scene: &'a Scene,
    /// The measured depth of its views, object and all.
    pub grids: &'a [DepthGrid],
    /// The scene at [`SIDE`].
    pub fine: &'a Scene,
    /// By view, as large as the photographs.
    pub masks: &'a [GrayImage],
    /// Of every random choice.
    pub seed: u64,
}

/// A shadow and where it lies.
pub struct Found {
    /// The surface.
    pub support: Support,
    /// The surface from above.
    pub texture: Texture,
    /// The shadow on it.
    pub shadow: Shadow,
    /// Views that see it as dark as it is, and views that see enough of it to tell.
    pub views: [usize; 2],
}

/// Looks for the shadow, and writes what of the light is left at each pixel of each photograph.
///
/// # Errors
/// When it is interrupted.
pub fn make(task: &Task<'_>, watch: &mut dyn Watch) -> Result<Batch, Error> {
    let views = task.scene.train.par_iter().zip(task.grids);
    let maps: Vec<DepthMap> = views.map(|(view, grid)| DepthMap::measured(grid, &view.camera)).collect();
    let views = task.fine.train.iter().zip(task.masks);
    let masks: Vec<GrayImage> = views.map(|(view, mask)| depth::enlarged(mask, view.camera.size)).collect();
    let photographs: Vec<Photograph<'_>> = task
        .fine
        .train
        .iter()
        .zip(&masks)
        .zip(&maps)
        .map(|((view, mask), depth)| Photograph { camera: view.camera, picture: &view.image, mask, depth })
        .collect();
    let mut batch = Batch::default();
    let found = match look(task, &maps, &photographs) {
        Ok(found) => found,
        Err(why) => {
            batch.notes.push(format!("the object has no shadow that could be taken away: {why}"));
            return Ok(batch);
        }
    };
    watch.turn(1)?;
    let first = &found[0];
    let [alike, all] = first.views;
    let share = alike as f64 / all.max(1) as f64;
    let left = first.shadow.ratio.iter().sum::<f64>() / 3.0;
    let mut lit = 0;
    for (i, (view, photograph)) in task.fine.train.iter().zip(&photographs).enumerate() {
        if let Some(map) = relight::map(first, photograph) {
            batch.rgb_aside(relight::path(&view.name), &map, "the object's shadow, found on its surface")?;
            lit += 1;
        }
        if let Some(contact) = relight::contact(&found, photograph) {
            batch.gray(relight::contact_path(&view.name), &contact, "where the soft shadow leaves too little");
        }
        watch.turn(2 + i as u64)?;
    }
    batch.rgb(PICTURE, &relight::picture(first, &photographs), "the surface from above, the shadow, and without it");
    batch.notes.push(if lit == 0 {
        "the soft shadow around the object's foot, which photographs see in different places, goes with the hole (--shadow \
         keep: it stays)"
            .into()
    } else {
        let [left, share] = [left, share].map(|part| 100.0 * part);
        format!(
            "the object's shadow on the surface below it leaves {left:.0} % of the light, alike in {share:.0} % of {all} views; \
             it is taken out of {lit} photographs for training ({PICTURE} shows it, --shadow keep leaves it)"
        )
    });
    batch.figures.extend([("light left".to_owned(), left), ("views that see it alike".to_owned(), share)]);
    Ok(batch)
}

/// Looks for the shadow; a clause that says why there is none otherwise.
///
/// # Errors
/// There is none.
pub fn look(task: &Task<'_>, maps: &[DepthMap], photographs: &[Photograph<'_>]) -> Result<Vec<Found>, String> {
    let cameras: Vec<Camera> = task.scene.train.iter().map(|view| view.camera).collect();
    let object = object(maps, task.masks);
    let around = around(task.scene, maps, photographs, &object);
    let support = plane::find(&around, &object, up::estimate(&cameras), task.seed)
        .ok_or("no surface is known that it stands on")?;
    log::debug!("shadow: {support:?}, {} places of the object, {} around", object.len(), around.len());
    let (texture, shadow) = detected(&support, &object, photographs)?;
    let says = alike(&texture, &support, &shadow, photographs);
    let views = [says.iter().filter(|says| **says == Some(true)).count(), says.iter().flatten().count()];
    log::debug!("shadow: {views:?} views, ratio {:?}, alike {:.2}", shadow.ratio, shadow.alike);
    let is_soft = !shadow.contact.is_empty();
    if is_soft && (views[1] as f64) < TELLING * photographs.len() as f64 {
        return Err(format!(
            "only {} of {} photographs show what is darker around its foot",
            views[1],
            photographs.len()
        ));
    }
    if (views[0] as f64) >= VIEWS * views[1] as f64 && views[1] > 0 {
        return Ok(vec![Found { support, texture, shadow, views }]);
    }
    // Where the model is folded or torn, each part shows the shadow on a side of its own.
    let part = |same: bool| {
        let own = photographs.iter().zip(&says).filter(|(_, says)| **says == Some(same));
        let own: Vec<Photograph<'_>> = own.map(|(photograph, _)| *photograph).collect();
        let (texture, mut shadow) = detected(&support, &object, &own).ok()?;
        shadow.contact.resize(shadow.region.len(), false);
        shadow.contact.iter_mut().zip(&shadow.region).for_each(|(contact, region)| *contact |= region);
        shadow.amount.fill(0.0);
        Some(Found { support, texture, shadow, views })
    };
    let parts: Vec<Found> = if is_soft { [true, false].into_iter().filter_map(part).collect() } else { vec![] };
    if parts.is_empty() {
        return Err(format!("only {} of {} views see what is darker as dark as the others do", views[0], views[1]));
    }
    Ok(parts)
}

/// The surface as photographs show it, and the shadow on it.
fn detected(support: &Support, object: &[DVec3], photographs: &[Photograph<'_>]) -> Result<(Texture, Shadow), String> {
    let texture = Texture::of(support, photographs);
    let middle = 0.5 * texture.side as f64;
    let places = standing(object.iter().map(|point| support.local(*point)).collect(), support.height);
    let places: Vec<[f64; 3]> =
        places.iter().map(|p| [p.x / texture.cell + middle, p.y / texture.cell + middle, p.z / texture.cell]).collect();
    let ground =
        Ground { side: texture.side, log: &texture.log, object: &places, height: support.height / texture.cell };
    let shadow = match detect::find(&ground) {
        Verdict::Found(shadow) => *shadow,
        Verdict::Nothing(why) => soft::find(&ground).map_err(|soft| format!("{why}, and {soft}"))?,
    };
    Ok((texture, shadow))
}

/// An object's places from its foot on, along the surface and above it, with what nobody sees between it and the surface: its lower
/// places narrow to the foot, as those of what is round do. What is seen down to the surface stays as it is.
fn standing(mut places: Vec<DVec3>, height: f64) -> Vec<DVec3> {
    let lowest = quantile(places.iter().map(|p| p.z), LOWEST.0).unwrap_or(0.0);
    if lowest > LOWEST.1 * height {
        let lower: Vec<DVec3> = places.iter().copied().filter(|p| p.z < 0.5 * height).collect();
        places.extend([0.25, 0.5, 0.75].iter().flat_map(|part| lower.iter().map(move |p| *p * *part)));
    }
    places
}

/// Whether views see the shadow as dark as it is on the whole; nothing of those that see too little of it.
fn alike(texture: &Texture, support: &Support, shadow: &Shadow, photographs: &[Photograph<'_>]) -> Vec<Option<bool>> {
    let shaded = (0..shadow.region.len()).filter(|i| shadow.amount[*i] > 0.0 && texture.seen(*i));
    let nearly = 0.8 * quantile(shaded.map(|i| shadow.amount[i]), 0.9).unwrap_or(1.0);
    let is_deep = |i: &usize| f64::from(shadow.amount[*i]) > nearly && texture.seen(*i);
    let deep: Vec<usize> = (0..shadow.region.len()).filter(is_deep).collect();
    let lit: Vec<usize> = (0..shadow.region.len()).filter(|i| shadow.lit[*i]).collect();
    let some = |cells: Vec<usize>| -> Vec<usize> {
        let every = cells.len().div_ceil(2000).max(1);
        cells.into_iter().step_by(every).collect()
    };
    let (deep, lit) = (some(deep), some(lit));
    let full = (shadow.ratio.iter().map(|r| r.ln()).sum::<f64>() / 3.0).abs();
    let whole = full * median(deep.iter().map(|i| shadow.amount[*i])).unwrap_or(1.0);
    let same = |left: f64| (left.ln() + whole).abs() <= (SAME[0] * whole).max(SAME[1]);
    let left = |photograph| texture::left(photograph, texture, support, [&deep, &lit], &shadow.expected);
    photographs.iter().map(|photograph| left(photograph).map(same)).collect()
}

/// Every so many pixels of all views, so that there are about so many in all.
fn some(sizes: impl Iterator<Item = usize>, wanted: usize) -> usize {
    sizes.sum::<usize>().div_ceil(wanted).max(1)
}

fn world(map: &DepthMap, pixel: usize) -> Option<DVec3> {
    let z = f64::from(map.depth[pixel]);
    let place = || map.camera.lift(map.camera.pixel_center(pixel), z);
    z.is_finite().then(place).flatten().map(DVec3::from)
}

/// Places of the object: what is measured within the masks, where the masks of most views agree.
fn object(maps: &[DepthMap], masks: &[GrayImage]) -> Vec<DVec3> {
    let small: Vec<GrayImage> =
        maps.iter().zip(masks).map(|(map, mask)| crate::scene::resample::mask(mask, map.camera.size)).collect();
    let inside = |view: usize| small[view].as_raw().iter().enumerate().filter(|(_, v)| **v != 0).map(|(i, _)| i);
    let every = some((0..maps.len()).map(|view| inside(view).count()), 4 * PLACES);
    let is_object = |point: &DVec3| {
        let (mut shown, mut masked) = (0u32, 0u32);
        for (map, mask) in maps.iter().zip(&small) {
            let Some(pixel) = map.camera.pixel_of(point.to_array()) else { continue };
            shown += 1;
            masked += u32::from(mask.as_raw()[pixel] != 0);
        }
        f64::from(masked) >= OBJECT * f64::from(shown)
    };
    let places =
        (0..maps.len()).flat_map(|view| inside(view).step_by(every).filter_map(move |i| world(&maps[view], i)));
    let kept: Vec<DVec3> = places.filter(is_object).collect();
    let every = kept.len().div_ceil(PLACES).max(1);
    kept.into_iter().step_by(every).collect()
}

/// Places around the object: points of the model and what is measured, outside the masks and near it.
fn around(scene: &Scene, maps: &[DepthMap], photographs: &[Photograph<'_>], object: &[DVec3]) -> Vec<DVec3> {
    let Some((middle, radius)) = plane::extent(object) else { return vec![] };
    let near = |p: &DVec3| (*p - middle).length() <= NEAR * radius;
    let off = |p: &DVec3| {
        // Within no mask that could show it: a point of the model on the object is in all of them.
        let on = photographs.iter().filter(|photograph| {
            photograph.camera.pixel_of(p.to_array()).is_some_and(|pixel| photograph.mask.as_raw()[pixel] != 0)
        });
        2 * on.count() < photographs.len()
    };
    let points = scene.points.iter().map(|point| DVec3::from(point.position.map(f64::from)));
    let mut places: Vec<DVec3> = points.filter(|p| near(p) && off(p)).collect();
    let every = some(maps.iter().map(|map| map.depth.len()), 8 * AROUND);
    for (map, photograph) in maps.iter().zip(photographs) {
        let mask = crate::scene::resample::mask(photograph.mask, map.camera.size);
        let outside = (0..map.depth.len()).step_by(every).filter(|i| mask.as_raw()[*i] == 0);
        places.extend(outside.filter_map(|i| world(map, i)).filter(near));
    }
    let every = places.len().div_ceil(AROUND).max(1);
    places.into_iter().step_by(every).collect()
}

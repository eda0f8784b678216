//! Repaints by hand: a part of a filled hole is made anew in the view in which it was brushed, and in all that see the place.
//!
//! The part is filled on the chart of the plane that it lies on, with what is around it or with a patch that was dragged there. A
//! pixel of another view's hole whose point, by the depth of the surface behind the object, is seen in the brushed part takes the
//! colour that it has there. Brushes lie in `prepare/repaint/`, holes as they were without them in `prepare/unpainted/`.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use image::{GrayImage, Rgb, RgbImage, Rgba, RgbaImage};
use rayon::prelude::*;

use super::color::{self, Filling};
use super::guess::{self, AROUND, Chart};
use super::holed::Texture;
use super::photograph::{self, between};
use super::surface::SAME;
use super::{behind_path, reference_path, texture};
use crate::prepare::object::{no_such_view, read_mask};
use crate::prepare::planes::{self, Plane};
use crate::prepare::poses::{Capture, IMAGES};
use crate::prepare::record::{self, Batch, Folder, Inputs, Repainted};
use crate::prepare::{Error, Step, Watch, picture_size};
use crate::scene::{self, Camera, DOUBTFUL, HOLE, MADE_WITH, RELIGHT, Scene, npy, resample};

/// Name of the way in which parts are repainted: a scene that was repainted in another way is repainted anew.
const METHOD: &str = "on its plane's chart, carried by depth";
/// Share of a part that must lie on one plane for it to be filled on that; else it is filled as the picture shows it.
const FLAT: f64 = 0.9;
/// Margin of a chart around a part and the patch for it, as a multiple of their extent.
const BESIDE: f64 = 0.1;

/// A part of a hole to be made anew.
#[derive(Clone, Debug, PartialEq)]
pub struct Repaint {
    /// Name of the view in which it was brushed.
    pub view: String,
    /// Picture as large as the photograph, not black where the part is.
    pub brush: PathBuf,
    /// How far right and down of it the patch lies that is put there, pixels of the photograph; without, what is around it fills it.
    pub offset: Option<[i32; 2]>,
}

/// A wish about the repaints that a scene has.
#[derive(Clone, Debug, PartialEq)]
pub enum Wish {
    /// These are there, after all others: those of them that the last ones are already are not added.
    With(Vec<Repaint>),
    /// One more, be it the last one again: another try.
    Another(Repaint),
    /// The last one is taken back.
    Undo,
}

impl Default for Wish {
    fn default() -> Self {
        Self::With(vec![])
    }
}

/// Where the brush of a repaint is, below the scene's folder.
fn brush_path(number: usize) -> String {
    format!("prepare/repaint/{}.png", number + 1)
}

/// Where a file of the hole is as it was without repaints, below the scene's folder.
fn unpainted(path: &str) -> String {
    format!("prepare/unpainted/{path}")
}

/// Repaints with their brushes, in their order.
type Brushed = Vec<(Repainted, GrayImage)>;

/// A wish whose pictures are read.
pub(in crate::prepare) struct Asked {
    new: Brushed,
    again: bool,
    undo: bool,
}

impl Asked {
    /// Reads what a wish names.
    ///
    /// # Errors
    /// A view that is none; a brush that cannot be read, is of another size, or empty.
    pub fn read(wish: &Wish, capture: &Capture) -> Result<Self, Error> {
        let brushed = |Repaint { view, brush, offset }: &Repaint| {
            let name = scene::stem(view).to_owned();
            let photograph = capture.photographs.get(&name);
            let names = || capture.photographs.keys().map(String::as_str);
            let size = picture_size(photograph.ok_or_else(|| no_such_view(view, "--repaint", names()))?)?;
            let mask = resample::nearest(&read_mask(brush, size)?, size);
            if mask.as_raw().iter().all(|v| *v == 0) {
                let what = "the brush is empty; paint what is to be filled anew in any colour but black".into();
                return Err(Error::File { path: brush.clone(), what });
            }
            Ok((Repainted { view: name, offset: *offset }, mask))
        };
        let (new, again) = match wish {
            Wish::With(all) => (all.as_slice(), false),
            Wish::Another(one) => (std::slice::from_ref(one), true),
            Wish::Undo => (&[][..], false),
        };
        Ok(Self { new: new.iter().map(brushed).collect::<Result<_, _>>()?, again, undo: *wish == Wish::Undo })
    }

    /// Whether something is asked for.
    pub fn is_some(&self) -> bool {
        self.undo || !self.new.is_empty()
    }

    /// The repaints that a scene then has, and how many of them it had.
    ///
    /// # Errors
    /// There is none to take back; a brush is gone.
    pub fn after(self, folder: &Folder) -> Result<(Brushed, usize), Error> {
        let recorded = &folder.record().repaints;
        let count = recorded.len().checked_sub(self.undo.into());
        let count =
            count.ok_or_else(|| Error::Request("nothing has been repainted that could be taken back".into()))?;
        let read = |(number, recorded): (usize, &Repainted)| {
            let path = folder.root().join(brush_path(number));
            if !path.is_file() {
                let what =
                    "the brush of a repaint is gone; put it back, or take the last repaints back with --undo-repaint";
                return Err(Error::File { path, what: what.into() });
            }
            Ok((recorded.clone(), scene::mask(&path, 1)?))
        };
        let mut all: Brushed = recorded[..count].iter().enumerate().map(read).collect::<Result<_, _>>()?;
        let same = |known: &usize| all.ends_with(&self.new[..*known]);
        let known = if self.again { 0 } else { (0..=self.new.len()).rev().find(same).unwrap_or(0) };
        all.extend(self.new.into_iter().skip(known));
        Ok((all, count))
    }
}

/// Depth z of what a view shows without the object.
#[derive(Clone)]
struct Behind {
    size: [usize; 2],
    /// `[pixel]` its inverse; NaN where it is not known.
    inverse: Vec<f64>,
}

impl Behind {
    /// Of a map of depths in so many times a scene's unit.
    fn new(map: &npy::Map, unit: f64) -> Self {
        let inverse = map.values.iter().map(|z| unit / f64::from(*z)).collect();
        Self { size: map.size.map(|n| n as usize), inverse }
    }

    /// As the depth of pixels that are wrong goes on from around them, in a picture of this size.
    fn mended(&self, wrong: &[bool], [w, _]: [usize; 2]) -> Self {
        let size @ [columns, rows] = self.size;
        let mut off = vec![false; columns * rows];
        let h = wrong.len() / w;
        (0..wrong.len())
            .filter(|i| wrong[*i])
            .for_each(|i| off[i / w * rows / h * columns + i % w * columns / w] = true);
        let mut values: Vec<f32> = self.inverse.iter().map(|d| *d as f32).collect();
        values.iter_mut().zip(&off).filter(|(_, off)| **off).for_each(|(value, _)| *value = f32::NAN);
        planes::membrane(&mut values, size, |site| off[site]);
        Self { size, inverse: values.into_iter().map(f64::from).collect() }
    }

    /// The depth at a place, 0 to 1 in both directions: linear in its inverse between what is of the nearest pixel's surface.
    fn at(&self, place: [f64; 2]) -> Option<f64> {
        let [w, h] = self.size;
        let [x, y] = [place[0] * w as f64, place[1] * h as f64];
        let value = |x: f64, y: f64| {
            let inside = x >= 0.0 && y >= 0.0 && x < w as f64 && y < h as f64;
            inside.then(|| self.inverse[y as usize * w + x as usize]).filter(|d| d.is_finite() && *d > 0.0)
        };
        let own = value(x.floor(), y.floor())?;
        let (mut sum, mut total) = (0.0, 0.0);
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let (u, v) = ((x - 0.5).floor() + dx, (y - 0.5).floor() + dy);
            let Some(there) = value(u, v).filter(|there| (there / own - 1.0).abs() <= 2.0 * SAME) else { continue };
            let weight = (1.0 - (x - 0.5 - u).abs()) * (1.0 - (y - 0.5 - v).abs());
            sum += weight * there;
            total += weight;
        }
        Some(if total > 0.0 { total / sum } else { 1.0 / own })
    }
}

/// A view whose hole is filled.
struct View {
    /// Its camera, at the size of the filled picture.
    camera: Camera,
    behind: Arc<Behind>,
    /// `[pixel]` whether its depth is likely wrong, and what it may be there.
    doubtful: Vec<bool>,
    mended: Behind,
    /// `[pixel]` RGB, 0 to 1: what is filled, and around it what else is known.
    rgb: Vec<[f32; 3]>,
    /// `[pixel]` whether it is in the hole.
    hole: Vec<bool>,
    /// `[pixel]` whether it was repainted.
    painted: Vec<bool>,
    /// Its exposure.
    gain: [f64; 3],
}

/// What was painted in one view, for the others.
struct Paint {
    camera: Camera,
    behind: Arc<Behind>,
    picture: RgbImage,
    brushed: Vec<bool>,
    gain: [f64; 3],
}

impl View {
    fn size(&self) -> [usize; 2] {
        self.camera.size.map(|n| n as usize)
    }

    /// Depth z at a place in pixels.
    fn depth_at(&self, pixel: [f64; 2]) -> Option<f64> {
        self.behind.at(std::array::from_fn(|a| pixel[a] / f64::from(self.camera.size[a])))
    }

    /// The colours as bytes.
    fn picture(&self) -> RgbImage {
        let bytes = self.rgb.as_flattened().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        RgbImage::from_raw(self.camera.size[0], self.camera.size[1], bytes).expect("a colour per pixel")
    }

    /// The plane that these pixels lie on, if they nearly all do.
    fn plane(&self, of: &[usize]) -> Option<Plane> {
        let sites = of.iter().filter_map(|i| {
            let pixel = self.camera.pixel_center(*i);
            Some((self.camera.unproject(pixel)?, self.depth_at(pixel)?))
        });
        let sites: Vec<([f64; 2], f64)> = sites.collect();
        let (mut squares, mut sum) = (DMat3::ZERO, DVec3::ZERO);
        for ([x, y], z) in &sites {
            let ray = DVec3::new(*x, *y, 1.0);
            squares += DMat3::from_cols(ray * ray.x, ray * ray.y, ray);
            sum += ray / *z;
        }
        let plane = (squares.inverse() * sum).to_array();
        let on = sites.iter().filter(|(ray, z)| (z * planes::on(&plane, *ray) - 1.0).abs() <= SAME).count();
        (on as f64 >= FLAT * of.len() as f64 && plane.iter().all(|v| v.is_finite())).then_some(plane)
    }

    /// Fills these pixels anew: with the patch that lies so far from them, as far as there is one, else with what is around them,
    /// of which a part is spared by the seed.
    fn paint(&mut self, brushed: &[bool], offset: Option<[f64; 2]>, seed: u64) {
        let size = self.size();
        let of: Vec<usize> = (0..brushed.len()).filter(|i| brushed[*i]).collect();
        let on = |plane: &Plane, pixel: [f64; 2]| {
            let z = self.depth_at(pixel).zip(self.camera.unproject(pixel));
            z.is_some_and(|(z, ray)| (z * planes::on(plane, ray) - 1.0).abs() <= SAME)
        };
        let sum = of.iter().map(|i| self.camera.pixel_center(*i)).fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]]);
        let middle = sum.map(|v| v / of.len() as f64);
        let moved = |pixel: [f64; 2]| offset.map(|by| [pixel[0] + by[0], pixel[1] + by[1]]);
        let flat = self.plane(&of).filter(|plane| moved(middle).is_none_or(|patch| on(plane, patch)));
        let patch = of.iter().filter_map(|i| moved(self.camera.pixel_center(*i)));
        let fill = |texture: &mut Texture, shift: Option<[f64; 2]>| {
            if let Some(shift) = shift {
                patched(texture, shift.map(|v| v.round() as isize));
            }
            if texture.hole.contains(&true) {
                refill(texture, seed);
            }
        };
        let (mut rgb, mut guessed) = (self.rgb.clone(), brushed.to_vec());
        let mut take = |i: usize, color: [f32; 3]| (rgb[i], guessed[i]) = (color, false);
        let chart = flat.and_then(|plane| {
            let pixels = of.iter().map(|i| self.camera.pixel_center(*i)).chain(patch.clone());
            let rays: Vec<[f64; 2]> = pixels.filter_map(|pixel| self.camera.unproject(pixel)).collect();
            let focal = f64::from(self.camera.focal[0].max(self.camera.focal[1]));
            Some((Chart::new(plane, &rays, focal, if offset.is_some() { BESIDE } else { AROUND })?, plane))
        });
        if let Some((chart, plane)) = chart {
            let mut texture = self.charted(brushed, &chart, |pixel| offset.is_some() || on(&plane, pixel));
            let wanted = texture.hole.clone();
            let at = |pixel: [f64; 2]| chart.pixel(self.camera.unproject(pixel)?);
            let ends = moved(middle).and_then(at).zip(at(middle));
            fill(&mut texture, ends.map(|(from, to)| [from[0] - to[0], from[1] - to[1]]));
            for i in of {
                let color = at(self.camera.pixel_center(i)).and_then(|at| guess::texel(&texture, &wanted, at));
                color.into_iter().for_each(|color| take(i, color));
            }
        } else {
            // What lies on no plane is filled as it is seen.
            let inside = |[x, y]: [f64; 2]| x >= 0.0 && y >= 0.0 && x < size[0] as f64 && y < size[1] as f64;
            let patch = patch.filter(|at| inside(*at)).map(|at| at[1] as usize * size[0] + at[0] as usize);
            let all: Vec<usize> = of.iter().copied().chain(patch).collect();
            let (cells, mut texture) = guess::around(&all, size, |i| self.rgb[i], |i| brushed[i], |i| !brushed[i]);
            fill(&mut texture, offset);
            let filled = |cell: &usize| brushed[cells[*cell]] && !texture.hole[*cell];
            (0..cells.len()).filter(filled).for_each(|cell| take(cells[cell], texture.rgb[cell]));
        }
        let mut filling = Filling { rgb, guessed, seen: vec![], doubtful: vec![], behind: vec![] };
        guess::smooth(&mut filling, size);
        self.rgb = filling.rgb;
        self.painted.iter_mut().zip(brushed).for_each(|(painted, brushed)| *painted |= brushed);
    }

    /// The picture on a chart, without what is brushed, which is the hole, and what `is` not said of a pixel.
    fn charted(&self, brushed: &[bool], chart: &Chart, is: impl Fn([f64; 2]) -> bool + Sync) -> Texture {
        let [w, h] = self.size();
        let known = |x: i64, y: i64| {
            let inside = x >= 0 && y >= 0 && (x as usize) < w && (y as usize) < h;
            let i = inside.then(|| y as usize * w + x as usize)?;
            (!brushed[i]).then(|| self.rgb[i])
        };
        let texel = |i: usize| {
            let point = chart.point(i);
            let seen = || self.camera.within(self.camera.along([point.x / point.z, point.y / point.z], point.z));
            let Some([x, y]) = (point.z > 0.0).then(seen).flatten() else { return (false, None) };
            let hole = brushed[y as usize * w + x as usize];
            (hole, if !hole && is([x, y]) { between(known, [x, y]) } else { None })
        };
        let texels: Vec<(bool, Option<[f32; 3]>)> =
            (0..chart.size[0] * chart.size[1]).into_par_iter().map(texel).collect();
        Texture {
            size: chart.size,
            rgb: texels.iter().map(|(_, color)| color.unwrap_or_default()).collect(),
            hole: texels.iter().map(|(hole, _)| *hole).collect(),
            source: texels.iter().map(|(_, color)| color.is_some()).collect(),
        }
    }

    /// Takes what was painted in another view: where a pixel of the hole shows a place of it that is seen there.
    fn take(&mut self, paint: &Paint) {
        let [w, h] = paint.camera.size;
        let gain: [f32; 3] = std::array::from_fn(|c| (self.gain[c] / paint.gain[c]) as f32);
        let color = |i: usize| -> Option<(bool, [f32; 3])> {
            let own = self.camera.pixel_center(i);
            let place = [0, 1].map(|a| own[a] / f64::from(self.camera.size[a]));
            let seen = |behind: &Behind| {
                let point = self.camera.lift(own, behind.at(place)?)?;
                let pixel = paint.camera.within(point)?;
                let z = paint.behind.at([pixel[0] / f64::from(w), pixel[1] / f64::from(h)])?;
                ((z / paint.camera.to_camera(point)[2] - 1.0).abs() <= SAME).then_some(pixel)
            };
            let pixel = seen(&self.behind).or_else(|| self.doubtful[i].then(|| seen(&self.mended))?)?;
            let at = |x: usize, y: usize| paint.picture.get_pixel(x as u32, y as u32).0.map(|v| f32::from(v) / 255.0);
            let color = photograph::sample(at, paint.camera.size, pixel)?;
            let brushed = paint.brushed[pixel[1] as usize * w as usize + pixel[0] as usize];
            Some((brushed, std::array::from_fn(|c| color[c] * gain[c])))
        };
        let size = self.size();
        let near = |i: usize| self.hole[i] || planes::neighbours(i, size).any(|j| self.hole[j]);
        let told: Vec<Option<(bool, [f32; 3])>> =
            (0..self.rgb.len()).into_par_iter().map(|i| if near(i) { color(i) } else { None }).collect();
        let inside: Vec<bool> =
            told.iter().zip(&self.hole).map(|(told, hole)| *hole && told.is_some_and(|(brushed, _)| brushed)).collect();
        let told: Vec<Option<[f32; 3]>> = told.into_iter().map(|told| told.map(|(_, color)| color)).collect();
        color::join(&mut self.rgb, &inside, &told, size);
        self.painted.iter_mut().zip(inside).for_each(|(painted, inside)| *painted |= inside);
    }
}

/// Puts the patch at a shift into the hole, as far as there is one.
fn patched(texture: &mut Texture, shift: [isize; 2]) {
    let copied: Vec<Option<usize>> =
        (0..texture.hole.len()).map(|i| texture.source(i, shift).filter(|_| texture.hole[i])).collect();
    texture::paste(texture, &copied);
    for i in (0..copied.len()).filter(|i| copied[*i].is_some()) {
        (texture.hole[i], texture.source[i]) = (false, true);
    }
}

/// Fills the hole with what is around it, of which by the seed half of the squares as large as it that do not touch it are left out:
/// another seed fills it with something else.
fn refill(texture: &mut Texture, seed: u64) {
    let [w, _] = texture.size;
    let holes: Vec<[usize; 2]> = (0..texture.hole.len()).filter(|i| texture.hole[*i]).map(|i| [i % w, i / w]).collect();
    let extent = |a: usize| {
        let (low, high) = holes.iter().fold((usize::MAX, 0), |(low, high), at| (low.min(at[a]), high.max(at[a])));
        high - low + 1
    };
    let side = extent(0).max(extent(1)).max(16);
    let touches = |square: [usize; 2]| {
        let near = |at: usize, square: usize| (square * side).saturating_sub(8) <= at && at < (square + 1) * side + 8;
        holes.iter().any(|at| near(at[0], square[0]) && near(at[1], square[1]))
    };
    let spared = |square: [usize; 2]| {
        let hash = blake3::hash(&[seed, square[0] as u64, square[1] as u64].map(u64::to_le_bytes).concat());
        hash.as_bytes()[0] < 128 && !touches(square)
    };
    let squares = texture.size.map(|n| n.div_ceil(side));
    let spared: Vec<bool> = (0..squares[0] * squares[1]).map(|s| spared([s % squares[0], s / squares[0]])).collect();
    let mut other = texture.clone();
    for (i, source) in other.source.iter_mut().enumerate() {
        *source &= !spared[i / w / side * squares[0] + i % w / side];
    }
    if texture::fill(&mut other) {
        (texture.rgb, texture.hole) = (other.rgb, other.hole);
    } else {
        texture::fill(texture);
    }
}

/// What repaints are made with.
pub(in crate::prepare) struct Task<'a> {
    /// The scene at the size of the fit.
    pub scene: &'a Scene,
    /// Its views' exposures, where they differ.
    pub gains: &'a [[f64; 3]],
    /// Its folder.
    pub folder: &'a Folder,
    /// Seed of every random choice.
    pub seed: u64,
}

/// A view of which something may be repainted, and the picture of its hole without that.
struct Opened {
    view: View,
    base: RgbaImage,
}

fn hole_path(view: &str) -> String {
    format!("{HOLE}/{view}.png")
}

/// A view's photograph, its shadow taken out where there is one, around its filled hole and as large as that.
fn around(scene: &Path, view: &str, photograph: &Path, hole: &RgbaImage) -> Result<RgbImage, Error> {
    let map = scene.join(RELIGHT).join(format!("{view}.png"));
    let map = map.is_file().then_some(map.as_path());
    let mut whole = scene::relit(map, &scene::photograph(photograph, 1)?, hole.dimensions().into())?;
    for (to, from) in whole.pixels_mut().zip(hole.pixels()).filter(|(_, from)| from.0[3] != 0) {
        to.0.copy_from_slice(&from.0[..3]);
    }
    Ok(whole)
}

/// A view of a prepared scene with its hole filled, as it is now, around it this photograph.
///
/// # Errors
/// A hole or a photograph that cannot be read.
pub fn filled(scene: &Path, view: &str, photograph: &Path) -> Result<RgbImage, Error> {
    around(scene, view, photograph, &scene::decode(&scene.join(hole_path(view)))?.into_rgba8())
}

/// Whether a view of a prepared scene has a hole that is filled, and not left to training.
pub fn has_hole(scene: &Path, view: &str) -> bool {
    [hole_path(view), behind_path(view)].iter().all(|path| scene.join(path).is_file())
}

/// The hash of everything that repaints are made of, besides them.
pub(in crate::prepare) fn inputs(folder: &Folder, repaints: &Brushed, seed: u64) -> String {
    let files = folder.made(Step::Reference).map(|(_, file)| file.hash.as_str());
    let inputs = files.fold(Inputs::default().with(METHOD).with(seed.to_le_bytes()), Inputs::with);
    let one = |inputs: Inputs, (Repainted { view, offset }, brush): &(Repainted, GrayImage)| {
        inputs.with(view).with(format!("{offset:?}")).with(brush.as_raw())
    };
    repaints.iter().fold(inputs, one).finish()
}

/// Whether the hole was made anew since it was repainted.
///
/// # Errors
/// A file that cannot be read.
pub(in crate::prepare) fn is_undone(folder: &Folder) -> Result<bool, Error> {
    let painted: BTreeMap<_, _> = folder.made(Step::Repaint).collect();
    for (path, made) in
        folder.made(Step::Reference).filter(|(path, made)| painted.get(path).is_some_and(|p| p.hash != made.hash))
    {
        let file = folder.root().join(path);
        if file.is_file() && record::hash(&file)? == made.hash {
            return Ok(true);
        }
    }
    Ok(false)
}

impl Task<'_> {
    /// Where a file of the hole is as it was made; nothing where it was changed by hand.
    fn base(&self, path: &str) -> Result<Option<PathBuf>, Error> {
        let Some((_, made)) = self.folder.made(Step::Reference).find(|(made, _)| *made == path) else {
            return Ok(None);
        };
        for file in [path.to_owned(), unpainted(path)].map(|path| self.folder.root().join(path)) {
            if file.is_file() && record::hash(&file)? == made.hash {
                return Ok(Some(file));
            }
        }
        Ok(None)
    }

    /// A view whose hole is filled and as it was made.
    fn open(&self, at: usize) -> Result<Option<Opened>, Error> {
        let scene::View { name, camera, .. } = &self.scene.train[at];
        let Some(path) = self.base(&hole_path(name))?.filter(|_| has_hole(self.folder.root(), name)) else {
            return Ok(None);
        };
        let base = scene::decode(&path)?.into_rgba8();
        let behind = Behind::new(&npy::read(&self.folder.root().join(behind_path(name)))?, self.scene.unit);
        let doubtful: Vec<bool> = base.pixels().map(|p| p.0[3] == DOUBTFUL).collect();
        let view = View {
            camera: camera.scaled([base.width(), base.height()]),
            mended: behind.mended(&doubtful, [base.width(), base.height()].map(|n| n as usize)),
            behind: Arc::new(behind),
            doubtful,
            rgb: base.pixels().map(|p| [0, 1, 2].map(|c| f32::from(p.0[c]) / 255.0)).collect(),
            hole: base.pixels().map(|p| p.0[3] != 0).collect(),
            painted: vec![false; base.pixels().len()],
            gain: self.gains.get(at).copied().unwrap_or([1.0; 3]),
        };
        Ok(Some(Opened { view, base }))
    }

    /// One that something is painted in: with its photograph around the hole.
    fn open_to_paint(&self, at: usize) -> Result<Opened, Error> {
        let name = &self.scene.train[at].name;
        let root = self.folder.root();
        let Opened { mut view, base } = self.open(at)?.ok_or_else(|| {
            let [hole, reference] = [hole_path(name), reference_path(name)];
            Error::Request(match (root.join(&hole).is_file(), root.join(&reference).is_file()) {
                (true, _) if !has_hole(root, name) => {
                    format!("{name}: its hole is left to training, since others show the same; paint in one of those, next to it")
                }
                (true, _) => {
                    format!("{name}: {hole} was changed by hand and stays; move it away to repaint it")
                }
                (false, true) => format!("{name}: {reference} is your own picture; paint in that"),
                (false, false) => {
                    format!("{name}: no hole was filled there; paint in a view that shows the object")
                }
            })
        })?;
        let whole = around(root, name, &scene::pictures(&root.join(IMAGES))?[name], &base)?;
        view.rgb = whole.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
        Ok(Opened { view, base })
    }

    /// Makes a repaint of this number in the views that are open, after these: those that were painted in are.
    fn paint(
        &self,
        open: &mut BTreeMap<usize, Opened>,
        paints: &[Paint],
        (number, (Repainted { view: name, offset }, brush)): (usize, &(Repainted, GrayImage)),
    ) -> Result<Paint, Error> {
        let at = self.scene.train.iter().position(|view| view.name == *name);
        let at = at.ok_or_else(|| Error::Request(format!("{name}: the scene has no such view to repaint")))?;
        let view = match open.entry(at) {
            Entry::Occupied(there) => &mut there.into_mut().view,
            Entry::Vacant(new) => {
                let mut opened = self.open_to_paint(at)?;
                paints.iter().for_each(|paint| opened.view.take(paint));
                &mut new.insert(opened).view
            }
        };
        let size @ [w, h] = view.camera.size.map(f64::from);
        let small = resample::mask(brush, view.camera.size);
        let brushed: Vec<bool> = small.as_raw().iter().zip(&view.hole).map(|(v, hole)| *v != 0 && *hole).collect();
        let full = [brush.width(), brush.height()].map(f64::from);
        let offset = offset.map(|by| [0, 1].map(|a| f64::from(by[a]) * size[a] / full[a]));
        let is_patch = |i: usize| {
            let [x, y] = view.camera.pixel_center(i);
            offset.is_none_or(|by| (0.0..w).contains(&(x + by[0])) && (0.0..h).contains(&(y + by[1])))
        };
        if !brushed.contains(&true) {
            let hole = hole_path(name);
            return Err(Error::Request(format!(
                "{name}: the brush is beside the hole; paint where {hole} is not transparent"
            )));
        }
        if !(0..brushed.len()).any(|i| brushed[i] && is_patch(i)) {
            let what = format!("{name}: the patch lies outside of the photograph; take it from within");
            return Err(Error::Request(what));
        }
        view.paint(&brushed, offset, self.seed + number as u64 + 1);
        let (camera, behind, gain) = (view.camera, view.behind.clone(), view.gain);
        let paint = Paint { camera, behind, picture: view.picture(), brushed, gain };
        open.iter_mut().filter(|(other, _)| **other != at).for_each(|(_, other)| other.view.take(&paint));
        Ok(paint)
    }

    /// Makes all repaints, of which so many were there before.
    ///
    /// # Errors
    /// A new one in a view without a hole, beside the hole, or whose patch lies outside of the picture; a file that cannot be read.
    pub fn make(&self, repaints: &Brushed, before: usize, watch: &mut dyn Watch) -> Result<Batch, Error> {
        let views = &self.scene.train;
        let mut batch = Batch::default();
        let (mut open, mut paints) = (BTreeMap::new(), vec![]);
        for (number, repaint) in repaints.iter().enumerate() {
            watch.go_on()?;
            batch.gray(brush_path(number), &repaint.1, format!("a brush in {}", repaint.0.view));
            match self.paint(&mut open, &paints, (number, repaint)) {
                Ok(paint) => paints.push(paint),
                // The hole may be another one than it was.
                Err(Error::Request(what)) if number < before => batch.notes.push(what),
                Err(error) => return Err(error),
            }
        }
        let mut changed: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        let mut seen = 0;
        for some in (0..views.len()).collect::<Vec<_>>().chunks(super::AT_ONCE) {
            let done = |at: &usize| -> Result<Vec<(String, Vec<u8>)>, Error> {
                let taken;
                let opened = if let Some(painted) = open.get(at) {
                    painted
                } else {
                    let Some(mut other) = self.open(*at)? else { return Ok(vec![]) };
                    paints.iter().for_each(|paint| other.view.take(paint));
                    taken = other;
                    &taken
                };
                self.files(&views[*at].name, opened)
            };
            let done: Vec<_> = some.par_iter().map(done).collect::<Result<_, _>>()?;
            seen += done.iter().filter(|files| !files.is_empty()).count();
            changed.extend(done.into_iter().flatten());
            watch.turn(*some.last().expect("a chunk has one") as u64 + 1)?;
        }
        let list = format!("{HOLE}/{MADE_WITH}");
        if let Some(path) = self.base(&list)?.filter(|_| !changed.is_empty()) {
            let text = std::fs::read_to_string(&path).map_err(|source| Error::Io { path, source })?;
            let line = |line: &str| {
                let path = line.split_once(' ').map_or("", |(_, path)| path);
                changed.get(path).map_or(format!("{line}\n"), |new| format!("{} {path}\n", blake3::hash(new).to_hex()))
            };
            changed.insert(list, text.lines().map(line).collect::<String>().into_bytes());
        }
        // What was repainted before and is not now is as it was made.
        let before: Vec<&String> = self.folder.made(Step::Repaint).map(|(path, _)| path).collect();
        for (path, made) in self.folder.made(Step::Reference) {
            let base = self.base(path)?.unwrap_or_else(|| self.folder.root().join(path));
            if let Some(bytes) = changed.remove(path) {
                let old = std::fs::read(&base).map_err(|source| Error::Io { path: base, source })?;
                batch.bytes(path, bytes, format!("{}; repainted by hand", made.from));
                batch.bytes(unpainted(path), old, "what was there before it was repainted");
            } else if before.contains(&path) && base.is_file() {
                batch.copy(path, &base, made.from.clone());
            }
        }
        if !paints.is_empty() {
            batch.notes.push(format!("{} made by hand, seen in {seen} of {} views", paints.len(), views.len()));
        }
        Ok(batch)
    }

    /// The files of a view that are others with what was painted, by their path below the scene.
    fn files(&self, name: &str, Opened { view, base }: &Opened) -> Result<Vec<(String, Vec<u8>)>, Error> {
        if !view.painted.contains(&true) {
            return Ok(vec![]);
        }
        let filled = view.picture();
        let mut hole = base.clone();
        for ((pixel, new), _) in
            hole.pixels_mut().zip(filled.pixels()).zip(&view.painted).filter(|(_, painted)| **painted)
        {
            let Rgb([r, g, b]) = *new;
            *pixel = Rgba([r, g, b, 255]);
        }
        let mut files = vec![(hole_path(name), record::png(&hole))];
        if let Some(path) = self.base(&reference_path(name))? {
            let mut picture = scene::photograph(&path, 1)?;
            let full = [picture.width(), picture.height()];
            let large = super::enlarged_to(filled, full);
            let painted = view.painted.iter().map(|painted| u8::from(*painted)).collect();
            let painted = GrayImage::from_raw(hole.width(), hole.height(), painted).expect("a value per pixel");
            for (x, y, _) in
                resample::nearest(&painted, full).enumerate_pixels().filter(|(.., painted)| painted.0[0] != 0)
            {
                picture.put_pixel(x, y, *large.get_pixel(x, y));
            }
            files.push((reference_path(name), record::png(&picture)));
        }
        Ok(files)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [96, 64];

    /// A view from so far to the right of a wall at z = 4, all of it hole, in these colours.
    fn view(x: f64, color: impl Fn(usize, usize) -> [f32; 3]) -> View {
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [-x, 0.0, 0.0],
            focal: [80.0; 2],
            principal: [48.0, 32.0],
            distortion: [0.0; 4],
            size: SIZE,
        };
        let [w, h] = SIZE.map(|n| n as usize);
        let map = npy::Map { values: vec![4.0; w * h / 4], size: [w as u32 / 2, h as u32 / 2] };
        View {
            camera,
            behind: Arc::new(Behind::new(&map, 1.0)),
            doubtful: vec![false; w * h],
            mended: Behind::new(&map, 1.0),
            rgb: (0..w * h).map(|i| color(i % w, i / w)).collect(),
            hole: vec![true; w * h],
            painted: vec![false; w * h],
            gain: [1.0; 3],
        }
    }

    fn square(x: std::ops::Range<usize>, y: std::ops::Range<usize>) -> Vec<bool> {
        let w = SIZE[0] as usize;
        (0..w * SIZE[1] as usize).map(|i| x.contains(&(i % w)) && y.contains(&(i / w))).collect()
    }

    fn painted(view: &View, brushed: Vec<bool>) -> Paint {
        let (camera, behind, gain) = (view.camera, view.behind.clone(), view.gain);
        Paint { camera, behind, picture: view.picture(), brushed, gain }
    }

    /// A blue square on a grey wall: from 0.5 to the right it lies 10 pixels to the left, in the exposure there. What stands before
    /// the wall there has none of it, and neither has what is no hole.
    #[test]
    fn paint_is_seen_where_it_is_from_elsewhere_and_on_nothing_nearer() {
        let blue = square(40..60, 20..40);
        let w = SIZE[0] as usize;
        let mut first = view(0.0, |_, _| [0.5; 3]);
        (0..blue.len()).filter(|i| blue[*i]).for_each(|i| first.rgb[i] = [0.2, 0.2, 0.6]);
        let paint = painted(&first, blue);
        let mut other = view(0.5, |_, _| [0.25; 3]);
        other.gain = [0.5; 3];
        let behind = Arc::get_mut(&mut other.behind).expect("it is its own");
        let columns = behind.size[0];
        behind.inverse.iter_mut().enumerate().filter(|(i, _)| i / columns >= 15).for_each(|(_, d)| *d = 0.5);
        other.hole.iter_mut().enumerate().filter(|(i, _)| i % w >= 46).for_each(|(_, hole)| *hole = false);
        other.take(&paint);
        let expected = square(30..46, 20..30);
        let wrong = (0..expected.len()).filter(|i| other.painted[*i] != expected[*i]);
        assert_eq!(wrong.map(|i| (i % w, i / w)).collect::<Vec<_>>(), []);
        let color = other.rgb[25 * w + 38];
        assert!((color[0] - 0.1).abs() < 0.01 && (color[2] - 0.3).abs() < 0.01, "{color:?}");
        assert!((other.rgb[35 * w + 38][2] - 0.25).abs() < 1e-6);
    }

    /// Where depth is doubtful what goes on there from around it counts as well.
    #[test]
    fn what_is_doubtful_is_painted_with_what_is_around_it() {
        let blue = square(40..60, 20..40);
        let paint = painted(&view(0.0, |_, _| [0.2, 0.2, 0.6]), blue);
        let wrong = square(30..40, 20..30);
        for doubtful in [false, true] {
            let mut other = view(0.5, |_, _| [0.5; 3]);
            let behind = Arc::get_mut(&mut other.behind).expect("it is its own");
            let columns = behind.size[0];
            let sites = (0..behind.inverse.len())
                .filter(|site| wrong[site / columns * 2 * SIZE[0] as usize + site % columns * 2]);
            sites.collect::<Vec<_>>().into_iter().for_each(|site| behind.inverse[site] = 0.1);
            if doubtful {
                other.doubtful.copy_from_slice(&wrong);
                other.mended = other.behind.mended(&wrong, other.size());
            }
            other.take(&paint);
            assert!((0..wrong.len()).filter(|i| wrong[*i]).all(|i| other.painted[i] == doubtful), "{doubtful}");
            assert!(other.painted[36 * SIZE[0] as usize + 36]);
        }
    }

    /// On a wall that is red at its left and blue at its right, in stripes: a patch from the right is blue, and has its stripes.
    #[test]
    fn a_patch_is_taken_from_where_it_lies() {
        let stripe = |x: usize| if x % 8 < 4 { 0.1 } else { 0.0 };
        let color = |x: usize, _: usize| if x < 48 { [0.7, 0.1, 0.1] } else { [0.1 + stripe(x), 0.1, 0.7] };
        let brushed = square(12..28, 20..36);
        let mut view = view(0.0, color);
        view.paint(&brushed, Some([48.0, 0.0]), 1);
        let w = SIZE[0] as usize;
        for (x, y) in (14..26).flat_map(|x| (22..34).map(move |y| (x, y))) {
            let (found, there) = (view.rgb[y * w + x], color(x + 48, y));
            assert!((0..3).all(|c| (found[c] - there[c]).abs() < 0.06), "{x}, {y}: {found:?} for {there:?}");
        }
        assert_eq!(view.rgb[10 * w + 12], color(12, 10));
    }

    /// What is filled from around is made of that; another seed fills it with something else, the same one with the same.
    #[test]
    fn a_second_try_is_another() {
        let grain = |x: usize, y: usize| 0.3 + 0.4 * ((x * 7919 + y * 104_729 + x * y * 31) % 97) as f32 / 97.0;
        let brushed = square(44..54, 28..38);
        let tried = |seed: u64| {
            let mut view = view(0.0, |x, y| [grain(x, y); 3]);
            (0..brushed.len()).filter(|i| brushed[*i]).for_each(|i| view.rgb[i] = [1.0, 0.0, 0.0]);
            view.paint(&brushed, None, seed);
            view.rgb
        };
        let [one, again, other, third] = [1, 1, 2, 3].map(tried);
        assert!((0..one.len()).filter(|i| brushed[*i]).all(|i| one[i][0] - one[i][1] < 0.1), "red is gone");
        assert!(one == again && (one != other || one != third));
    }
}

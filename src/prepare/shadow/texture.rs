//! The support surface as seen straight from above: each place has the median colour of the photographs that see it.

use glam::DVec3;
use image::{GrayImage, RgbImage};
use rayon::prelude::*;

use super::plane::Support;
use crate::prepare::depth::{DepthMap, Witness};
use crate::scene::{Camera, resample};
use crate::statistics::median;

/// Cells on each side of the texture, at most.
const MOST: usize = 512;
/// Cells along a pixel of the median photograph at the foot of the object.
const FINER: f64 = 1.6;
/// The texture reaches so far beyond the object's radius, in its heights (or radii, where it is wider than high).
const REACH: f64 = 2.6;
/// Depth may be off by this part before it hides a place of the surface.
const HIDDEN: f64 = 0.1;
/// A place that a photograph sees through by more than this part of the depth is none of the surface.
const THROUGH: f64 = 0.2;
/// Fewest photographs that a colour is the median of.
const FEWEST: usize = 2;
/// Levels below which a stored value says nothing of a ratio.
const DARK: f32 = 4.0;

/// A photograph and what is known of it.
#[derive(Clone, Copy)]
pub struct Photograph<'a> {
    /// Its camera.
    pub camera: Camera,
    /// Its pixels.
    pub picture: &'a RgbImage,
    /// Not 0 on the object, enlarged.
    pub mask: &'a GrayImage,
    /// The measured depth, with the object; its camera is the same at any size.
    pub depth: &'a DepthMap,
}

impl Photograph<'_> {
    /// The pixel position at which it shows a place, unless that is outside, behind something or masked.
    fn shows(&self, place: [f64; 3]) -> Option<[f64; 2]> {
        let [x, y] = self.camera.project(place)?;
        let [w, h] = self.camera.size;
        let inside = x >= 1.0 && y >= 1.0 && x < f64::from(w) - 1.0 && y < f64::from(h) - 1.0;
        if !inside || self.mask.get_pixel(x as u32, y as u32).0[0] != 0 {
            return None;
        }
        let is_there = self.depth.witness(place, HIDDEN) != Witness::Hidden
            && self.depth.witness(place, THROUGH) != Witness::Contradicts;
        is_there.then_some([x, y])
    }

    /// The logarithms of the channels at a pixel position, bilinear; levels of 255.
    fn log(&self, position: [f64; 2]) -> [f32; 3] {
        resample::color_at(self.picture, position).map(|v| (v as f32).max(DARK).ln())
    }
}

/// Half the side of the texture, world units.
fn reach(support: &Support) -> f64 {
    support.radius + REACH * support.height.max(support.radius)
}

/// The rectified surface. Cell (i, j) is `j * side + i`; its middle lies `(i + 0.5 - side / 2) * cell` along the first
/// direction of the support and likewise along the second.
pub struct Texture {
    /// Cells on each side.
    pub side: usize,
    /// World units per cell.
    pub cell: f64,
    /// `[cell]` logarithms of the channels, levels of 255; not a number where too few photographs show it.
    pub log: Vec<[f32; 3]>,
}

impl Texture {
    /// The texture around an object, its cells somewhat smaller than a pixel of the median photograph.
    pub fn of(support: &Support, photographs: &[Photograph<'_>]) -> Self {
        let half = reach(support);
        let pixels = photographs.iter().filter_map(|photograph| {
            let z = photograph.camera.to_camera(support.foot.to_array())[2];
            (z > 0.0).then(|| z / f64::from(photograph.camera.focal[0].min(photograph.camera.focal[1])))
        });
        let pixel = median(pixels).unwrap_or(half / 50.0);
        let side = ((FINER * 2.0 * half / pixel).ceil() as usize).clamp(64, MOST);
        let mut texture = Self { side, cell: 2.0 * half / side as f64, log: vec![] };
        let log = |cell: usize| shown(texture.place(support, cell), photographs);
        texture.log = (0..side * side).into_par_iter().map(log).collect();
        texture
    }

    /// The world point in the middle of a cell.
    pub fn place(&self, support: &Support, cell: usize) -> [f64; 3] {
        let at = |n: usize| (n as f64 + 0.5 - 0.5 * self.side as f64) * self.cell;
        support.world(DVec3::new(at(cell % self.side), at(cell / self.side), 0.0)).to_array()
    }

    /// Whether photographs show a cell.
    pub fn seen(&self, cell: usize) -> bool {
        self.log[cell][0].is_finite()
    }
}

/// The median of what photographs show of a place.
fn shown(place: [f64; 3], photographs: &[Photograph<'_>]) -> [f32; 3] {
    let mut channels: [Vec<f32>; 3] = Default::default();
    for pixel in photographs.iter().filter_map(|photograph| Some(photograph.log(photograph.shows(place)?))) {
        pixel.into_iter().zip(&mut channels).for_each(|(v, c)| c.push(v));
    }
    let known = channels[0].len() >= FEWEST;
    channels.map(|values| median(values).filter(|_| known).map_or(f32::NAN, |median| median as f32))
}

/// How much darker a photograph shows some cells than others, beyond what the texture's own colours there differ by: the
/// ratio of brightness that is left, or nothing where it shows too little of either.
pub fn left(
    photograph: &Photograph<'_>,
    texture: &Texture,
    support: &Support,
    [inside, outside]: [&[usize]; 2],
    lit: &[f32],
) -> Option<f64> {
    let usual = |cells: &[usize]| {
        let one = |cell: &usize| {
            let log = photograph.log(photograph.shows(texture.place(support, *cell))?);
            Some((log[0] + log[1] + log[2]) / 3.0 - lit[*cell])
        };
        let values: Vec<f32> = cells.iter().filter_map(one).filter(|v| v.is_finite()).collect();
        median(values.iter().copied()).filter(|_| values.len() >= 12.max(cells.len() / 8))
    };
    Some((usual(inside)? - usual(outside)?).exp())
}

//! What no photograph shows: pieces of the same surface.
//!
//! A plane is brought into a chart, as if seen straight on, so that what repeats on it repeats at one distance and straight
//! lines meet; what all views show of the plane is in the chart. What lies on no plane is filled in the picture itself.

use std::collections::BTreeSet;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::color::Filling;
use super::holed::Texture;
use super::material::{Look, MATERIAL, of_another};
use super::photograph::{Photograph, between};
use super::surface::{APART, SAME, Sight, Sights};
use super::texture;
use crate::prepare::planes::{self, Plane, membrane};
use crate::scene::resample;
use crate::statistics::quantile;

/// Longer side of a chart at most, pixels.
const CHART: f64 = 960.0;
/// Least margin of a chart around what is to be filled, pixels.
const MARGIN: f64 = 48.0;
/// Margin of a chart on each side, as a multiple of the extent of what is to be filled.
pub const AROUND: f64 = 1.5;
/// A chart ends where the plane is this many times as far as in the middle of what is to be filled.
const FARTHEST: f64 = 4.0;
/// Other views that a chart is filled from.
const OTHERS: usize = 6;
/// Difference of a channel from the median of the views from which on one of them shows a light's reflection.
const GLARE: f32 = 0.06;

/// Least part of what is to be filled that must be known of the same surface around it: of less the rest cannot be made.
const SHOWN: f64 = 0.3;
/// Least share of what lies on another plane in a hole, and nearly on this one, for them to be filled as one: a bench and a hedge as
/// high as it. What of one goes on into the other, its border too, is copied with both.
const NEARLY_ONE: f64 = 0.8;

/// A plane seen straight on. Lengths are in the view's camera coordinates.
pub struct Chart {
    normal: DVec3,
    /// Across and down.
    axes: [DVec3; 2],
    /// Distance of the plane from the camera.
    distance: f64,
    /// Of the chart's upper left corner along the axes.
    origin: DVec2,
    /// Length of a pixel.
    pub scale: f64,
    /// Depth z of the plane in the middle of what the chart is around.
    pub middle: f64,
    /// Width and height in pixels.
    pub size: [usize; 2],
}

impl Chart {
    /// Of a plane `a x/z + b y/z + c = 1/z`, around what these rays meet there and `margin` times as much on each side, as
    /// fine as a picture of this focal length shows its middle.
    pub fn new([a, b, c]: Plane, rays: &[[f64; 2]], focal: f64, margin: f64) -> Option<Self> {
        let plane = DVec3::new(a, b, c);
        let (normal, distance) = (plane.normalize(), 1.0 / plane.length());
        let across = (DVec3::X - normal * normal.x).try_normalize()?;
        let axes = [across, normal.cross(across)];
        let mut chart = Self { normal, axes, distance, origin: DVec2::ZERO, scale: 1.0, middle: 0.0, size: [0; 2] };
        let places: Vec<(DVec2, f64)> = rays.iter().filter_map(|ray| chart.place(*ray)).collect();
        let mut depths: Vec<f64> = places.iter().map(|(_, z)| *z).collect();
        depths.sort_unstable_by(f64::total_cmp);
        let middle = *depths.get(depths.len() / 2)?;
        let near = places.iter().filter(|(_, z)| *z < FARTHEST * middle).map(|(place, _)| *place);
        let (low, high) = near.fold((DVec2::MAX, DVec2::MIN), |(low, high), place| (low.min(place), high.max(place)));
        (chart.scale, chart.middle) = (middle / focal, middle);
        let margin = (margin * (high - low).max_element()).max(MARGIN * chart.scale);
        let extent = high - low + 2.0 * margin;
        chart.scale = chart.scale.max(extent.max_element() / CHART);
        chart.origin = low - margin;
        chart.size = [extent.x, extent.y].map(|v| (v / chart.scale).ceil().max(1.0) as usize);
        Some(chart)
    }

    /// Where a ray meets the plane, along the axes, and its depth z.
    fn place(&self, [x, y]: [f64; 2]) -> Option<(DVec2, f64)> {
        let ray = DVec3::new(x, y, 1.0);
        let z = self.distance / self.normal.dot(ray);
        let point = ray * z;
        (z > 0.0 && z.is_finite()).then(|| (DVec2::new(point.dot(self.axes[0]), point.dot(self.axes[1])), z))
    }

    /// The chart's pixel position that a ray meets.
    pub fn pixel(&self, ray: [f64; 2]) -> Option<[f64; 2]> {
        let (place, _) = self.place(ray)?;
        Some(((place - self.origin) / self.scale).to_array())
    }

    /// Camera coordinates of a pixel's centre.
    pub fn point(&self, i: usize) -> DVec3 {
        let at = DVec2::new((i % self.size[0]) as f64 + 0.5, (i / self.size[0]) as f64 + 0.5);
        let place = self.origin + at * self.scale;
        self.normal * self.distance + self.axes[0] * place.x + self.axes[1] * place.y
    }
}

/// Fills what nothing tells of a view's hole: the pixels of it that are `wanted` by textures, the rest smoothly.
pub fn fill(sights: &Sights, photographs: &[Photograph<'_>], of: usize, filling: &mut Filling, wanted: &[bool]) {
    let (own, sight) = (&photographs[of], &sights.0[of]);
    let [w, h] = own.camera.size.map(|n| n as usize);
    if !filling.guessed.contains(&true) {
        return;
    }
    let guessed: Vec<usize> = (0..w * h).filter(|i| wanted[*i]).collect();
    // What is thin between known pixels needs no texture, and would draw the chart out to wherever it is.
    let thick = thick(wanted, own.camera.size);
    let ray = |i: usize| own.camera.unproject([(i % w) as f64 + 0.5, (i / w) as f64 + 0.5]);
    borders(filling, [w, h], &thick, ASIDE * sight.grid.pixels(own.camera.size[0]));
    let behind = std::mem::take(&mut filling.behind);
    let surface = |i: usize| behind[i].or_else(|| ray(i).map(|ray| sight.surface_at(sight.grid.place(ray))));
    let surfaces: Vec<(usize, u8)> = guessed.par_iter().filter_map(|i| Some((*i, surface(*i)?))).collect();
    let focal = f64::from(own.camera.focal[0].max(own.camera.focal[1]));
    for (number, plane) in sight.planes.iter().enumerate() {
        let rays =
            |label: usize| surfaces.iter().filter(move |(_, l)| usize::from(*l) == label).filter_map(|(i, _)| ray(*i));
        let one: Vec<bool> = (0..sight.planes.len())
            .map(|l| l == number || alike(sight, l, number) && nearly_one(sight, plane, rays(l)))
            .collect();
        let materials: Vec<Look> =
            (0..one.len()).filter(|label| one[*label]).filter_map(|label| sight.material(label)).collect();
        let off = |label: u8| {
            let other = if usize::from(label) == number { SAME } else { APART };
            one.get(usize::from(label)).is_some_and(|one| *one).then_some(other)
        };
        let mut left: Vec<usize> = surfaces
            .iter()
            .filter(|(i, label)| filling.guessed[*i] && off(*label).is_some())
            .map(|(i, _)| *i)
            .collect();
        let its = Its { off: &off, materials };
        // Around the largest part first: another may be far away on the same plane, and a chart of all would be coarse.
        while let Some(part) = parts(&left, [w, h]).into_iter().max_by_key(Vec::len) {
            let rays: Vec<[f64; 2]> = part.iter().filter(|i| thick[**i]).filter_map(|i| ray(*i)).collect();
            if let Some(chart) = Chart::new(*plane, &rays, focal, AROUND) {
                let mut texture = charted(sights, photographs, of, filling, &behind, &chart, &its);
                let wanted = texture.hole.clone();
                let filled = is_shown(&texture) && texture::fill(&mut texture);
                for i in left.iter().filter(|_| filled) {
                    let color = ray(*i).and_then(|ray| chart.pixel(ray)).and_then(|at| texel(&texture, &wanted, at));
                    if let Some(color) = color {
                        filling.rgb[*i] = color;
                        filling.guessed[*i] = false;
                    }
                }
            }
            let part: BTreeSet<usize> = part.into_iter().collect();
            left.retain(|i| filling.guessed[*i] && !part.contains(i));
        }
    }
    let depth = |i: usize| ray(i).map_or(f64::NAN, |ray| sight.depth_at(sight.grid.place(ray)));
    let lie = Lie { surface: &|i| surface(i).unwrap_or(0), depth: &depth, planes: sight.planes.len() };
    in_picture(filling, [w, h], &thick, &lie);
    // What is small, and a picture that is nearly all hole, which has nothing to copy.
    if filling.guessed.contains(&true) {
        smooth(filling, [w, h]);
    }
}

/// Whether enough is known of a surface for its hole to be made of it.
fn is_shown(texture: &Texture) -> bool {
    let count = |of: &[bool]| of.iter().filter(|is| **is).count() as f64;
    count(&texture.source) >= SHOWN * count(&texture.hole)
}

/// Whether two surfaces of a view are of one material, as far as that is known.
fn alike(sight: &Sight, one: usize, other: usize) -> bool {
    let (Some(one), Some(other)) = (sight.material(one), sight.material(other)) else { return true };
    of_another(one, other) <= MATERIAL
}

/// Whether what lies along these rays, on another plane of the view, is nearly on this one.
fn nearly_one(sight: &Sight, plane: &Plane, rays: impl Iterator<Item = [f64; 2]>) -> bool {
    let near = |ray: [f64; 2]| (sight.depth_at(sight.grid.place(ray)) * planes::on(plane, ray) - 1.0).abs() <= APART;
    let (ones, all) = rays.fold((0u32, 0u32), |(ones, all), ray| (ones + u32::from(near(ray)), all + 1));
    all > 0 && f64::from(ones) >= NEARLY_ONE * f64::from(all)
}

/// Factor within which what lies on no plane is as far away as a part of a hole, and beyond which two pixels beside each other are on
/// things before and behind each other.
const AS_FAR: f64 = 1.25;
const EDGE: f64 = 1.1;
/// Shares of a part between which most of its depths are.
const MOST: [f64; 2] = [0.1, 0.9];

/// Smallest part of a hole that has a texture, as a part of the picture.
const LEAST_PART: f64 = 5e-4;

/// Smallest part that straight borders are looked for in, as a part of the picture.
const LARGE: f64 = 2e-3;
/// Sites to each side of such a border that it fills: which surface is where is known to within one.
const ASIDE: f64 = 1.5;

/// Splits pixels into parts that are connected by their sides; parts too small for a texture are left out.
fn parts(of: &[usize], size @ [w, h]: [usize; 2]) -> Vec<Vec<usize>> {
    let mut left = vec![false; w * h];
    of.iter().for_each(|i| left[*i] = true);
    let parts = of.iter().map(|first| planes::connected(*first, &mut left, size));
    parts.filter(|part| part.len() as f64 >= LEAST_PART * (w * h) as f64).collect()
}

/// Narrowest part of a hole that has a texture, as a part of the picture's longer side.
const THIN: f64 = 0.008;

/// `[pixel]` what of this is at least [`THIN`] wide. The rest is filled smoothly.
pub fn thick(wanted: &[bool], [w, h]: [u32; 2]) -> Vec<bool> {
    let reach = (0.5 * THIN * f64::from(w.max(h))).ceil() as u32;
    let inside = resample::opened([w, h], |i| wanted[i], reach);
    inside.as_raw().iter().map(|v| *v != 0).collect()
}

/// Goes on smoothly with the colours around what nothing tells.
pub fn smooth(filling: &mut Filling, size: [usize; 2]) {
    for c in 0..3 {
        let value = |(rgb, guessed): (&[f32; 3], &bool)| if *guessed { f32::NAN } else { rgb[c] };
        let mut channel: Vec<f32> = filling.rgb.iter().zip(&filling.guessed).map(value).collect();
        membrane(&mut channel, size, |i| filling.guessed[i]);
        filling.rgb.iter_mut().zip(channel).for_each(|(rgb, v)| rgb[c] = if v.is_finite() { v } else { 0.5 });
    }
    filling.guessed.fill(false);
}

/// The colour at a place of a chart; nothing where the nearest texel has none.
pub fn texel(texture: &Texture, wanted: &[bool], place: [f64; 2]) -> Option<[f32; 3]> {
    let [w, h] = texture.size;
    let at = |x: i64, y: i64| {
        let inside = x >= 0 && y >= 0 && (x as usize) < w && (y as usize) < h;
        let i = inside.then(|| y as usize * w + x as usize)?;
        (texture.source[i] || wanted[i] && !texture.hole[i]).then(|| texture.rgb[i])
    };
    between(at, place)
}

/// The surfaces of a view that lie on one plane.
struct Its<'a> {
    /// How far what lies on a surface may be off the plane, if it is one of these.
    off: &'a (dyn Fn(u8) -> Option<f64> + Sync),
    /// Materials that they are covered with; nothing where that is not known.
    materials: Vec<Look>,
}

/// Charts a plane with what is known of it; the hole is what is to be filled there. `its` are the
/// surfaces that lie on it.
fn charted(
    sights: &Sights,
    photographs: &[Photograph<'_>],
    of: usize,
    filling: &Filling,
    behind: &[Option<u8>],
    chart: &Chart,
    its: &Its<'_>,
) -> Texture {
    let Its { off, materials } = its;
    let (own, sight) = (&photographs[of], &sights.0[of]);
    let size @ [w, _] = own.camera.size.map(|n| n as usize);
    // The views with the most of the surroundings: those that look most alike.
    let axis = |k: usize| DVec3::from(photographs[k].camera.rotation[2].map(f64::from));
    let mut others: Vec<usize> = (0..photographs.len()).filter(|k| *k != of && sights.0[*k].grid.trusted).collect();
    others.sort_by(|a, b| axis(*b).dot(axis(of)).total_cmp(&axis(*a).dot(axis(of))));
    others.truncate(OTHERS);
    enum Texel {
        Known([f32; 3]),
        Hole,
        Nothing,
    }
    let one = |i: usize| -> Texel {
        let point = chart.point(i);
        if point.z <= 0.0 {
            return Texel::Nothing;
        }
        let ray = [point.x / point.z, point.y / point.z];
        let world = DVec3::from(own.camera.along(ray, point.z));
        if let Some([x, y]) = own.camera.project(world.to_array()) {
            let inside = x >= 0.0 && y >= 0.0 && (x as usize) < size[0] && (y as usize) < size[1];
            let pixel = if inside { y as usize * w + x as usize } else { 0 };
            if inside && filling.guessed[pixel] {
                let is_its = off(behind[pixel].unwrap_or_else(|| sight.surface_at(sight.grid.place(ray))));
                return if is_its.is_some() { Texel::Hole } else { Texel::Nothing };
            }
            if inside {
                let place = sight.grid.place(ray);
                let (z, its) = (sight.depth_at(place), off(sight.surface_at(place)));
                // Where the object's depth has bled nothing is known but that.
                let on_it = if z.is_nan() { its.is_some() } else { (z / point.z - 1.0).abs() <= its.unwrap_or(SAME) };
                // Around the hole each site has its surface, beyond it is of what it looks like.
                let is_of = || match usize::from(sight.surface_at(place)) < sight.planes.len() {
                    true => materials.is_empty() || its.is_some(),
                    false => {
                        let site = sight.grid.site(place[0].floor() as i64, place[1].floor() as i64);
                        site.is_some_and(|site| one_of(materials, sight.look_around(site)))
                    }
                };
                if on_it && is_of() {
                    // What is to be filled still shows the object.
                    let known = |x: i64, y: i64| {
                        let inside = x >= 0 && y >= 0 && (x as usize) < size[0] && (y as usize) < size[1];
                        let pixel = inside.then(|| y as usize * w + x as usize)?;
                        (!filling.guessed[pixel]).then(|| filling.rgb[pixel])
                    };
                    return between(known, [x, y]).map_or(Texel::Nothing, Texel::Known);
                }
            }
        }
        let shows = |k: &usize| {
            let sight = &sights.0[*k];
            let site = sight.shows(world, SAME).filter(|site| one_of(materials, sight.look_around(*site)));
            site.and_then(|_| photographs[*k].color(world))
        };
        let seen = others.iter().filter_map(shows);
        common(&seen.collect::<Vec<_>>()).map_or(Texel::Nothing, Texel::Known)
    };
    let texels: Vec<Texel> = (0..chart.size[0] * chart.size[1]).into_par_iter().map(one).collect();
    Texture {
        size: chart.size,
        rgb: texels.iter().map(|t| if let Texel::Known(color) = t { *color } else { [0.0; 3] }).collect(),
        hole: texels.iter().map(|t| matches!(t, Texel::Hole)).collect(),
        source: texels.iter().map(|t| matches!(t, Texel::Known(_))).collect(),
    }
}

/// Whether surroundings are of one of these materials, or of any where none is known.
fn one_of(materials: &[Look], look: Look) -> bool {
    materials.is_empty() || materials.iter().any(|material| of_another(look, *material) <= MATERIAL)
}

/// The first of the colours that several photographs show of one place that most of them come near: a highlight is elsewhere in
/// each.
fn common(colors: &[[f32; 3]]) -> Option<[f32; 3]> {
    // Of two the darker one.
    let middle: [f32; 3] =
        std::array::from_fn(|c| quantile(colors.iter().map(|color| color[c]), 0.5).map_or(f32::NAN, |v| v as f32));
    colors.iter().copied().find(|color| (0..3).all(|c| (color[c] - middle[c]).abs() <= GLARE))
}

/// The straight borders between what looks different that go into a view's hole, in sites: from where they do to where they come out of
/// it, or would.
pub fn ends(sight: &Sight, own: &Photograph<'_>) -> Vec<[DVec2; 2]> {
    let [w, h] = own.camera.size.map(|n| n as usize);
    let inside = |i: usize| own.hole.as_raw()[i] != 0;
    let hole: Vec<usize> = (0..w * h).filter(|i| inside(*i)).collect();
    let large = parts(&hole, [w, h]).into_iter().filter(|part| part.len() as f64 >= LARGE * (w * h) as f64);
    let of = |part: Vec<usize>| {
        let color = |i: usize| own.picture.get_pixel((i % w) as u32, (i / w) as u32).0.map(|v| f32::from(v) / 255.0);
        let (cells, texture) = around(&part, [w, h], color, inside, |i| !inside(i));
        let corner = DVec2::new((cells[0] % w) as f64, (cells[0] / w) as f64);
        let place = |at: DVec2| Some(DVec2::from(sight.grid.place(own.camera.unproject((at + corner).to_array())?)));
        let found = texture::ends(&texture);
        found.iter().filter_map(|line| Some([place(line.ends[0])?, place(line.ends[1])?])).collect::<Vec<_>>()
    };
    large.flat_map(of).collect()
}

/// Fills the straight borders between what looks different that cross what is `wanted`, so many pixels to each side: in the picture, where
/// all that is around the hole is beside it, on whichever surface.
fn borders(filling: &mut Filling, size: [usize; 2], wanted: &[bool], half: f64) {
    let of: Vec<usize> = (0..wanted.len()).filter(|i| wanted[*i]).collect();
    let large = parts(&of, size).into_iter().filter(|part| part.len() as f64 >= LARGE * wanted.len() as f64);
    for part in large {
        let guessed = |i: usize| filling.guessed[i];
        let (cells, mut texture) = around(&part, size, |i| filling.rgb[i], guessed, |i| !guessed(i));
        texture::borders(&mut texture, half);
        for (cell, i) in cells.iter().enumerate().filter(|(cell, _)| !texture.hole[*cell]) {
            if std::mem::take(&mut filling.guessed[*i]) {
                filling.rgb[*i] = texture.rgb[cell];
            }
        }
    }
}

/// The places of a view's pixels in space.
struct Lie<'a> {
    /// The surface of a pixel.
    surface: &'a (dyn Fn(usize) -> u8 + Sync),
    /// Depth z of a pixel; NaN where it is not known.
    depth: &'a (dyn Fn(usize) -> f64 + Sync),
    /// Number of planes among the surfaces; the next one is of what lies on none.
    planes: usize,
}

/// Fills the parts that are left and `wanted` in the picture itself: each from the same surface where enough of that is seen, else from what
/// is as far away, else from any. What lies on no plane is one surface where it is as far away.
fn in_picture(filling: &mut Filling, size @ [w, h]: [usize; 2], wanted: &[bool], lie: &Lie<'_>) {
    let depths: Vec<f64> = (0..w * h).into_par_iter().map(lie.depth).collect();
    let labels: Vec<u8> = (0..w * h).into_par_iter().map(lie.surface).collect();
    for of in [Source::Same, Source::Near, Source::Any] {
        let mut left: Vec<bool> = (0..wanted.len()).map(|i| wanted[i] && filling.guessed[i]).collect();
        let one = |a: usize, b: usize| {
            let far = depths[a].max(depths[b]) / depths[a].min(depths[b]) > EDGE;
            of == Source::Any || !far && (of == Source::Near || labels[a] == labels[b])
        };
        let parts: Vec<Vec<usize>> =
            (0..w * h).map(|first| planes::connected_if(first, &mut left, size, one)).collect();
        for part in parts.into_iter().filter(|part| part.len() as f64 >= LEAST_PART * (w * h) as f64) {
            let depth = |share: f64| quantile(part.iter().map(|i| depths[*i]).filter(|z| z.is_finite()), share);
            let range = MOST.map(depth);
            let near = |i: usize| match range {
                [Some(from), Some(to)] => (from / AS_FAR..=to * AS_FAR).contains(&depths[i]),
                _ => true,
            };
            let label = labels[part[0]];
            let source = |i: usize| match of {
                _ if filling.guessed[i] => false,
                Source::Same => labels[i] == label && (usize::from(label) < lie.planes || near(i)),
                Source::Near => near(i),
                Source::Any => true,
            };
            let mut wanted = vec![false; filling.guessed.len()];
            part.iter().for_each(|i| wanted[*i] = true);
            let (cells, mut texture) = around(&part, size, |i| filling.rgb[i], |i| wanted[i], source);
            if (of == Source::Any || is_shown(&texture)) && texture::fill(&mut texture) {
                for (cell, i) in cells.iter().enumerate().filter(|(cell, i)| wanted[**i] && !texture.hole[*cell]) {
                    filling.rgb[*i] = texture.rgb[cell];
                    filling.guessed[*i] = false;
                }
            }
        }
    }
}

/// The pixels that a part of a hole is made of.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Source {
    /// The pixels of the same surface.
    Same,
    /// The pixels that are as far away.
    Near,
    /// All pixels around it.
    Any,
}

/// The pixels of the surroundings of some, and their texture: each one's colour, whether it is to be filled, and whether it may be copied.
pub fn around(
    of: &[usize],
    size: [usize; 2],
    color: impl Fn(usize) -> [f32; 3],
    hole: impl Fn(usize) -> bool,
    source: impl Fn(usize) -> bool + Sync,
) -> (Vec<usize>, Texture) {
    let (cells, size) = surroundings(of, size);
    let rgb = cells.iter().map(|i| color(*i)).collect();
    let hole = cells.iter().map(|i| hole(*i)).collect();
    let source = cells.par_iter().map(|i| source(*i)).collect();
    (cells, Texture { size, rgb, hole, source })
}

/// The box of some pixels and as much again on each side: its pixels, width and height.
fn surroundings(of: &[usize], [w, h]: [usize; 2]) -> (Vec<usize>, [usize; 2]) {
    let bounds = |f: &dyn Fn(usize) -> usize, end: usize| {
        let (low, high) = of.iter().fold((end, 0), |(low, high), i| (low.min(f(*i)), high.max(f(*i) + 1)));
        let margin = high.saturating_sub(low).max(MARGIN as usize);
        (low.saturating_sub(margin), (high + margin).min(end))
    };
    let ((x0, x1), (y0, y1)) = (bounds(&|i| i % w, w), bounds(&|i| i / w, h));
    ((y0..y1).flat_map(|y| (x0..x1).map(move |x| y * w + x)).collect(), [x1 - x0, y1 - y0])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line is smoothed over, a square has a texture, at every size of the picture.
    #[test]
    fn what_is_thin_is_no_texture() {
        for size @ [w, h] in [[200, 100], [1000, 700]] {
            let line = |x: u32, y: u32| y == 20 && x < w / 2;
            let square = |x: u32, y: u32| (w / 2..w / 2 + w / 20).contains(&x) && (50..50 + w / 20).contains(&y);
            let places = || (0..h).flat_map(|y| (0..w).map(move |x| (x, y)));
            let wanted: Vec<bool> = places().map(|(x, y)| line(x, y) || square(x, y)).collect();
            let found = thick(&wanted, size);
            assert!(places().zip(&found).all(|((x, y), thick)| !*thick || square(x, y)), "{size:?}");
            let middle = (50 + w / 40) * w + w / 2 + w / 40;
            assert!(found[middle as usize], "{size:?}");
        }
    }

    /// A bright rail of which hardly anything is seen is no wall: what is behind it is made of what is around.
    #[test]
    fn little_makes_no_large_surface() {
        let size @ [w, h] = [64, 64];
        let hole = |i: usize| (16..48).contains(&(i % w)) && (16..48).contains(&(i / w));
        for (rail, bright) in [(2, false), (14, true)] {
            let of = |i: usize| u8::from(hole(i) || (16 - rail..16).contains(&(i / w)) && (16..48).contains(&(i % w)));
            let noise = |i: usize| ((i * 2_654_435_761) % 1000) as f32 / 20_000.0;
            let color = |i: usize| [if of(i) == 1 { 0.9 } else { 0.3 } + noise(i); 3];
            let wanted: Vec<bool> = (0..w * h).map(hole).collect();
            let mut filling = Filling {
                rgb: (0..w * h).map(color).collect(),
                guessed: wanted.clone(),
                seen: vec![false; w * h],
                doubtful: vec![false; w * h],
                behind: vec![],
            };
            in_picture(&mut filling, size, &wanted, &Lie { surface: &of, depth: &|_| f64::NAN, planes: 2 });
            let filled = (0..w * h).filter(|i| hole(*i) && !filling.guessed[*i]).map(|i| filling.rgb[i][0]);
            let (sum, count) = filled.fold((0.0, 0), |(sum, n), v| (sum + v, n + 1));
            assert!(count > 900, "{count}");
            assert_eq!(sum / count as f32 > 0.6, bright, "{}", sum / count as f32);
        }
    }

    /// The top of a table that hides what it stands before, none of them a plane: it is not made of the wall behind.
    #[test]
    fn what_is_near_is_made_of_what_is_near() {
        let size @ [w, h] = [64, 64];
        let inside = |i: usize, rows: std::ops::Range<usize>| (16..48).contains(&(i % w)) && rows.contains(&(i / w));
        let table = |i: usize| inside(i, 24..h);
        let noise = |i: usize| ((i * 2_654_435_761) % 1000) as f32 / 20_000.0;
        let wanted: Vec<bool> = (0..w * h).map(|i| inside(i, 8..44)).collect();
        let mut filling = Filling {
            rgb: (0..w * h).map(|i| [if table(i) { 0.3 } else { 0.9 } + noise(i); 3]).collect(),
            guessed: wanted.clone(),
            seen: vec![false; w * h],
            doubtful: vec![false; w * h],
            behind: vec![],
        };
        (0..w * h).filter(|i| wanted[*i]).for_each(|i| filling.rgb[i] = [0.0; 3]);
        let depth = |i: usize| if table(i) { 2.0 - 0.01 * (i / w) as f64 } else { 5.0 };
        in_picture(&mut filling, size, &wanted, &Lie { surface: &|_| 0, depth: &depth, planes: 0 });
        let is_its = |i: &usize| (filling.rgb[*i][0] > 0.6) != table(*i) && !filling.guessed[*i];
        let right = (0..w * h).filter(|i| wanted[*i]).filter(is_its).count();
        assert_eq!(right, 32 * 36);
    }

    /// Around a hole lies what the object's depth has bled into: what a photograph shows there is of the surface that goes on there.
    #[test]
    fn where_depth_has_bled_colours_are_known() {
        use super::super::color;
        use super::super::surface::tests::{SIZE, views};
        let (mut grids, cameras, masks) = views(0.4);
        grids.iter_mut().enumerate().filter(|(view, _)| *view != 2).for_each(|(_, grid)| grid.trusted = false);
        let picture = image::RgbImage::from_pixel(SIZE[0], SIZE[1], image::Rgb([90, 120, 150]));
        let photographs: Vec<Photograph<'_>> = (cameras.iter().zip(&masks))
            .map(|(camera, hole)| Photograph { camera: *camera, picture: &picture, hole: hole.clone() })
            .collect();
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let bled: Vec<usize> = (0..sights.0[2].hole.len())
            .filter(|site| {
                !sights.0[2].hole[*site] && sights.0[2].grid.around(*site, 2).any(|near| sights.0[2].hole[near])
            })
            .collect();
        bled.iter().for_each(|site| sights.0[2].depth[*site] = f64::NAN);
        sights.solve(2, 1);
        let filling = color::gather(&sights, &photographs, 2);
        let plane = sights.0[2].planes[0];
        let rays: Vec<[f64; 2]> = (0..sights.0[2].hole.len()).map(|site| sights.0[2].ray(site)).collect();
        let chart = Chart::new(plane, &rays, 40.0, 0.0).expect("a plane before the camera");
        let texture = charted(
            &sights,
            &photographs,
            2,
            &filling,
            &filling.behind,
            &chart,
            &Its { off: &|_| Some(SAME), materials: vec![] },
        );
        let known = |site: &usize| {
            let [x, y] = chart.pixel(sights.0[2].ray(*site)).expect("it is on the plane").map(|v| v as usize);
            texture.source[y * texture.size[0] + x] || texture.hole[y * texture.size[0] + x]
        };
        assert!(bled.len() > 40 && texture.source.contains(&true), "{}", bled.len());
        assert!(bled.iter().all(known), "{} of {}", bled.iter().filter(|site| known(site)).count(), bled.len());
    }

    /// A light mirrored in one of three photographs is not what the surface looks like; a little brighter it may be.
    #[test]
    fn reflections_are_left_out() {
        assert_eq!(common(&[[0.9; 3], [0.52; 3], [0.5; 3]]), Some([0.52; 3]));
        assert_eq!(common(&[[0.54; 3], [0.5; 3], [0.5; 3]]), Some([0.54; 3]));
        assert_eq!(common(&[[0.9; 3], [0.5; 3]]), Some([0.5; 3]));
        assert_eq!(common(&[]), None);
    }
}

//! Photographs without the shadow: what is left of the light at each of their pixels, and pictures to look at.

use glam::DVec3;
use image::{GrayImage, Rgb, RgbImage};
use rayon::prelude::*;

use super::Found;
use super::texture::Photograph;

/// A pixel shows the surface where the fit is within this share of the object's height from it, and does not from twice
/// that on.
const OFF: f64 = 0.12;
/// Logarithms of channels within which a pixel has the surface's colour, and within which it has its hue.
const SAME: f32 = 0.35;
const HUE: f32 = 0.2;
/// Pixels beside the object whose colours are mixed with its own, as a part of the picture's longer side.
const MIXED: f64 = 0.015;
/// Less than this share of the light changes nothing.
const LEAST: f64 = 0.004;

/// Where the map of a photograph is kept, below the scene's folder.
pub fn path(name: &str) -> String {
    format!("{}/{name}.png", crate::scene::RELIGHT)
}

/// What is left of the light at each pixel, of 255; nothing where the photograph does not show the shadow.
pub fn map(found: &Found, photograph: &Photograph<'_>) -> Option<RgbImage> {
    let [w, h] = photograph.camera.size;
    let rows: Vec<Vec<[u8; 3]>> =
        (0..h).into_par_iter().map(|y| (0..w).map(|x| left(found, photograph, [x, y])).collect()).collect();
    let bytes: Vec<u8> = rows.into_iter().flatten().flatten().collect();
    bytes.iter().any(|v| *v < 255).then(|| RgbImage::from_raw(w, h, bytes).expect("three bytes per pixel"))
}

/// What is left of the light at one pixel.
fn left(found: &Found, photograph: &Photograph<'_>, [x, y]: [u32; 2]) -> [u8; 3] {
    let amount = amount(found, photograph, [f64::from(x) + 0.5, f64::from(y) + 0.5]);
    if amount <= LEAST {
        return [255; 3];
    }
    found.shadow.ratio.map(|ratio| (255.0 * ratio.powf(amount)).round().clamp(1.0, 255.0) as u8)
}

/// Logarithms of a pixel's channels; nothing is darker than 4 of 255, where noise alone is left.
pub fn log(pixel: [u8; 3]) -> [f32; 3] {
    pixel.map(|v| f32::from(v).max(4.0).ln())
}

/// Whether two colours, logarithms of their channels, differ in brightness alone.
pub fn has_hue(one: [f32; 3], other: [f32; 3]) -> bool {
    let apart: [f32; 3] = std::array::from_fn(|c| one[c] - other[c]);
    let mean = apart.iter().sum::<f32>() / 3.0;
    apart.iter().all(|v| (v - mean).abs() <= HUE)
}

/// Whether two colours, logarithms of their channels, are of one surface.
fn is_alike(one: [f32; 3], other: [f32; 3]) -> bool {
    (0..3).all(|c| (one[c] - other[c]).abs() <= SAME) && has_hue(one, other)
}

/// Whether the object is so near that colours are mixed with its own.
fn is_near(photograph: &Photograph<'_>, pixel: [f64; 2]) -> bool {
    let [w, h] = photograph.camera.size;
    let reach = (MIXED * f64::from(w.max(h))).ceil() as u32;
    let [columns, rows] = pixel.map(|v| (v as u32).saturating_sub(reach)..=v as u32 + reach);
    let mut near = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
    near.any(|(x, y)| photograph.mask.get_pixel_checked(x, y).is_some_and(|on| on.0[0] != 0))
}

/// How much of the full shadow lies on what a pixel position shows.
fn amount(found: &Found, photograph: &Photograph<'_>, pixel: [f64; 2]) -> f64 {
    let (texture, shadow) = (&found.texture, &found.shadow);
    let Some(seen) = Seen::at(found, photograph, pixel) else { return 0.0 };
    let [u, v] = seen.cell;
    let (column, row) = (u as usize, v as usize);
    let (fx, fy) = (u - column as f64, v - row as f64);
    let at = |i: usize, j: usize| f64::from(shadow.amount[(row + j) * texture.side + column + i]);
    let amount = (at(0, 0) * (1.0 - fx) + at(1, 0) * fx) * (1.0 - fy) + (at(0, 1) * (1.0 - fx) + at(1, 1) * fx) * fy;
    if amount <= LEAST { 0.0 } else { amount * surface(found, photograph, pixel, &seen, row * texture.side + column) }
}

/// A place of the surface's plane behind a pixel position.
struct Seen {
    /// The camera's centre, and the viewing ray per unit of depth; world units.
    eye: DVec3,
    along: DVec3,
    /// Cells along both sides of the texture, from the middle of the first one.
    cell: [f64; 2],
}

impl Seen {
    fn at(found: &Found, photograph: &Photograph<'_>, pixel: [f64; 2]) -> Option<Self> {
        let (support, texture) = (&found.support, &found.texture);
        let camera = &photograph.camera;
        let [x, y] = camera.unproject(pixel)?;
        let rows = camera.rotation.map(|row| DVec3::from(row.map(f64::from)));
        let eye = DVec3::from(camera.center());
        let along = rows[0] * x + rows[1] * y + rows[2];
        let z = (support.foot - eye).dot(support.up) / along.dot(support.up);
        if !(z.is_finite() && z > 0.0) {
            return None;
        }
        let place = support.local(eye + along * z) / texture.cell;
        let middle = 0.5 * texture.side as f64;
        let cell = [place.x + middle - 0.5, place.y + middle - 0.5];
        let last = (texture.side - 1) as f64;
        cell.iter().all(|at| *at >= 0.0 && *at < last).then_some(Self { eye, along, cell })
    }
}

/// How certainly a pixel shows the surface there, and not what stands before it: 0 to 1. Within the object's mask it is taken to.
fn surface(found: &Found, photograph: &Photograph<'_>, pixel: [f64; 2], seen: &Seen, cell: usize) -> f64 {
    let (support, texture) = (&found.support, &found.texture);
    let camera = &photograph.camera;
    // Near the object measured depth is the object's in part.
    if photograph.mask.get_pixel(pixel[0] as u32, pixel[1] as u32).0[0] != 0 {
        return 1.0;
    }
    let small = photograph.depth.camera.size;
    let scaled = std::array::from_fn(|i| pixel[i] * f64::from(small[i]) / f64::from(camera.size[i]));
    let depth = f64::from(photograph.depth.smooth(scaled));
    // On bare surfaces measured depth errs: what has the surface's colour is the surface.
    let color = log(photograph.picture.get_pixel(pixel[0] as u32, pixel[1] as u32).0);
    if is_alike(color, texture.log[cell]) {
        return 1.0;
    }
    if !depth.is_finite() {
        return if is_near(photograph, pixel) { 1.0 } else { 0.0 };
    }
    let height = support.local(seen.eye + seen.along * depth).z.abs() / support.height;
    (2.0 - height / OFF).clamp(0.0, 1.0)
}

/// Where the pixels of a photograph are kept that a soft shadow leaves too little of, below the scene's folder.
pub fn contact_path(name: &str) -> String {
    format!("prepare/contact/{name}.png")
}

/// The pixels of a photograph that show where soft shadows leave too little to be given back ([`Shadow::contact`](super::detect::Shadow));
/// nothing where none is soft.
pub fn contact(found: &[Found], photograph: &Photograph<'_>) -> Option<GrayImage> {
    let [w, h] = photograph.camera.size;
    let is = |found: &Found, x: u32, y: u32| {
        let pixel = [f64::from(x) + 0.5, f64::from(y) + 0.5];
        let Some(seen) = Seen::at(found, photograph, pixel) else { return false };
        let [u, v] = seen.cell.map(|at| at.round() as usize);
        let cell = v * found.texture.side + u;
        found.shadow.contact[cell] && surface(found, photograph, pixel, &seen, cell) > 0.5
    };
    let soft: Vec<&Found> = found.iter().filter(|found| !found.shadow.contact.is_empty()).collect();
    let value = |x: u32, y: u32| if soft.iter().any(|found| is(found, x, y)) { 255 } else { 0 };
    let rows: Vec<Vec<u8>> = (0..h).into_par_iter().map(|y| (0..w).map(|x| value(x, y)).collect()).collect();
    let picture = || GrayImage::from_raw(w, h, rows.into_iter().flatten().collect()).expect("a value per pixel");
    (!soft.is_empty()).then(picture)
}

/// The photograph without the shadow, by its map: as training sees it.
pub fn lit(picture: &RgbImage, map: &RgbImage) -> RgbImage {
    let mut out = picture.clone();
    crate::scene::lighten(&mut out, map);
    out
}

/// The surface from above as it is seen, with the shadow tinted, and without it; below, the photograph that sees most of it, likewise.
pub fn picture(found: &Found, photographs: &[Photograph<'_>]) -> RgbImage {
    let side = found.texture.side as u32;
    let above = |i: usize| found.texture.log[i].map(|v| if v.is_finite() { v.exp().min(255.0) as u8 } else { 30 });
    let seen = RgbImage::from_fn(side, side, |x, y| Rgb(above((y * side + x) as usize)));
    let amount = |i: usize| f64::from(found.shadow.amount[i]);
    let left = RgbImage::from_fn(side, side, |x, y| {
        let i = (y * side + x) as usize;
        Rgb(found.shadow.ratio.map(|r| (255.0 * r.powf(amount(i))).round().clamp(1.0, 255.0) as u8))
    });
    let mut rows = vec![triple(&seen, &left)];
    let maps = photographs.iter().filter_map(|photograph| {
        let map = map(found, photograph)?;
        let dark: u64 = map.as_raw().iter().map(|v| 255 - u64::from(*v)).sum();
        Some((dark, photograph, map))
    });
    if let Some((_, photograph, map)) = maps.fold(None, |best: Option<(u64, _, _)>, next| match best {
        Some(best) if best.0 >= next.0 => Some(best),
        _ => Some(next),
    }) {
        rows.push(triple(photograph.picture, &map));
    }
    let width = rows.iter().map(RgbImage::width).max().unwrap_or(1);
    let height = rows.iter().map(RgbImage::height).sum();
    let mut out = RgbImage::new(width, height);
    let mut top = 0;
    for row in &rows {
        image::imageops::replace(&mut out, row, 0, top);
        top += i64::from(row.height());
    }
    out
}

/// A picture, with its shadow tinted, and without it, side by side.
fn triple(picture: &RgbImage, map: &RgbImage) -> RgbImage {
    let (w, h) = picture.dimensions();
    let mut out = RgbImage::new(3 * w, h);
    let mut tinted = picture.clone();
    for (pixel, left) in tinted.pixels_mut().zip(map.pixels()) {
        let dark = 255 - left.0[1];
        if dark > 2 {
            let [r, g, b] = pixel.0;
            *pixel = Rgb([r.saturating_add(dark), g, b.saturating_add(dark / 3)]);
        }
    }
    for (i, part) in [picture, &tinted, &lit(picture, map)].into_iter().enumerate() {
        image::imageops::replace(&mut out, part, i64::from(w) * i as i64, 0);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint is darker than its tile, and a red ball in the dark as bright as the shadow.
    #[test]
    fn a_surface_is_told_by_its_hue() {
        let log = |color: [f32; 3]| color.map(f32::ln);
        assert!(is_alike(log([60.0, 58.0, 54.0]), log([78.0, 76.0, 72.0])));
        assert!(!is_alike(log([72.0, 42.0, 46.0]), log([60.0, 58.0, 54.0])));
        assert!(!is_alike(log([120.0, 118.0, 110.0]), log([60.0, 58.0, 54.0])));
    }
}

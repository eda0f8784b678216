//! Photographs as if taken without distortion.

use super::{STRIDE, Sites};
use crate::scene::{Camera, View, distort, resample};

/// Longer side from which on pictures are reduced, pixels: depth is asked for anchors, which are several pixels wide.
const LONGEST: u32 = 512;

/// A view without its lens.
pub(super) struct Picture {
    /// Without distortion.
    pub camera: Camera,
    /// Its centre.
    pub center: [f64; 3],
    pub sites: Sites,
    /// Grey values \[pixel\].
    pub grey: Vec<u8>,
    /// The photograph's colour at each \[site\].
    pub colors: Vec<[u8; 3]>,
    /// Whether the photograph shows the \[site\], and not the object there.
    pub shown: Vec<bool>,
}

impl Picture {
    /// The photograph of a view, at one part of its size in `reduction` at most.
    pub fn new(view: &View, reduction: u32) -> Self {
        let [w, h] = view.camera.size;
        let ratio = w.max(h).div_ceil(LONGEST).max(reduction);
        let size = [w, h].map(|n| (n / ratio).max(STRIDE));
        let image = resample::photograph(&view.image, size);
        let lens = view.camera.scaled(size);
        let camera = Camera { distortion: [0.0; 4], ..lens };
        let sites = Sites { columns: size[0] / STRIDE, rows: size[1] / STRIDE };
        let farthest = f64::from(lens.max_radius2());
        // Where the photograph has what the pinhole sees at a pixel.
        let source = |x: f64, y: f64| -> Option<[f64; 2]> {
            let ray: [f64; 2] =
                std::array::from_fn(|a| ([x, y][a] - f64::from(lens.principal[a])) / f64::from(lens.focal[a]));
            if lens.distortion == [0.0; 4] {
                return Some([x, y]);
            }
            if ray[0] * ray[0] + ray[1] * ray[1] > farthest {
                return None;
            }
            let d = distort(ray, lens.distortion.map(f64::from));
            Some(std::array::from_fn(|a| d[a] * f64::from(lens.focal[a]) + f64::from(lens.principal[a])))
        };
        let grey_at = |pixel: usize| {
            let (x, y) = ((pixel % size[0] as usize) as f64 + 0.5, (pixel / size[0] as usize) as f64 + 0.5);
            source(x, y).map_or(0, |at| grey(resample::color_at(&image, at)))
        };
        let pixels = size[0] as usize * size[1] as usize;
        let ratio: [f64; 2] = [f64::from(w) / f64::from(size[0]), f64::from(h) / f64::from(size[1])];
        let mut picture = Self {
            camera,
            center: camera.center(),
            sites,
            grey: (0..pixels).map(grey_at).collect(),
            colors: vec![[0; 3]; sites.len()],
            shown: vec![false; sites.len()],
        };
        for site in 0..sites.len() {
            let [x, y] = picture.pixel(site);
            let Some([u, v]) = source(x, y) else { continue };
            if !(u >= 0.0 && v >= 0.0 && u < f64::from(size[0]) && v < f64::from(size[1])) {
                continue;
            }
            picture.colors[site] = resample::color_at(&image, [u, v]).map(|c| c.round() as u8);
            let [u, v] = [(u * ratio[0]) as u32, (v * ratio[1]) as u32];
            let object = view.mask.as_ref().is_some_and(|mask| mask.get_pixel(u.min(w - 1), v.min(h - 1)).0[0] != 0);
            picture.shown[site] = !object;
        }
        picture
    }

    /// Centre of a site's pixel, as the kernels have it.
    pub fn pixel(&self, site: usize) -> [f64; 2] {
        self.sites.place(site).map(|c| f64::from(c * STRIDE as i32 + STRIDE as i32 / 2) + 0.5)
    }

    /// The world point at a pixel and a depth.
    pub fn lift(&self, pixel: [f64; 2], depth: f64) -> [f64; 3] {
        let Camera { focal, principal, .. } = &self.camera;
        let normalised = |a: usize| (pixel[a] - f64::from(principal[a])) / f64::from(focal[a]);
        self.camera.along([normalised(0), normalised(1)], depth)
    }

    /// Pixel and depth of a world point that is in the picture.
    pub fn see(&self, point: [f64; 3]) -> Option<([f64; 2], f64)> {
        let Camera { rotation, focal, principal, size, .. } = &self.camera;
        let from: [f64; 3] = std::array::from_fn(|i| point[i] - self.center[i]);
        let [x, y, z] = rotation.map(|row| (0..3).map(|k| f64::from(row[k]) * from[k]).sum::<f64>());
        if z <= 0.0 {
            return None;
        }
        let pixel: [f64; 2] = std::array::from_fn(|a| [x, y][a] / z * f64::from(focal[a]) + f64::from(principal[a]));
        let inside = (0..2).all(|a| pixel[a] >= 0.0 && pixel[a] < f64::from(size[a]));
        inside.then_some((pixel, z))
    }

    /// The site whose pixels a place in the picture is among.
    pub fn site(&self, pixel: [f64; 2]) -> Option<usize> {
        let [x, y] = pixel.map(|p| (p / f64::from(STRIDE)).floor() as i32);
        self.sites.at(x, y)
    }
}

/// Each pixel with the right, the lower and the lower right one, as `glsl/multiview/score.comp` reads them.
pub(super) fn elements(grey: &[u8], [w, h]: [u32; 2]) -> Vec<u32> {
    let at = |x: u32, y: u32| grey[(y.min(h - 1) * w + x.min(w - 1)) as usize];
    let element = |x, y| u32::from_le_bytes([at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)]);
    (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).map(|(x, y)| element(x, y)).collect()
}

/// Rec. 601.
fn grey([r, g, b]: [f64; 3]) -> u8 {
    (0.299 * r + 0.587 * g + 0.114 * b).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture whose colours are its pixels' places, behind lenses of every kind: a site has the colour of the place at
    /// which the photograph shows what a pinhole would see there.
    #[test]
    fn a_site_shows_what_the_lens_brings_there() {
        let [w, h] = [120_u32, 90];
        let image = image::RgbImage::from_fn(w, h, |x, y| image::Rgb([2 * x as u8, 2 * y as u8, 0]));
        for distortion in [[0.0; 4], [-0.2, 0.05, 0.0, 0.0], [0.3, 0.0, 0.004, -0.006]] {
            let camera = Camera {
                rotation: [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
                translation: [0.3, -2.0, 1.0],
                focal: [110.0, 108.0],
                principal: [62.0, 44.0],
                distortion,
                size: [w, h],
            };
            let name = String::new();
            let view = View { name, camera, image: image.clone(), mask: None, weight: None, prior: None, depth: None };
            let picture = Picture::new(&view, 1);
            let mut shown = 0;
            for site in (0..picture.sites.len()).filter(|site| picture.shown[*site]) {
                let point = picture.lift(picture.pixel(site), 2.5);
                let [u, v] = camera.project(point).expect("ahead");
                // The border has no pixel beyond it to go over to.
                if !(u > 1.0 && v > 1.0 && u < f64::from(w) - 1.0 && v < f64::from(h) - 1.0) {
                    continue;
                }
                shown += 1;
                let [r, g, _] = picture.colors[site].map(f64::from);
                // Half a level of the colour, which is a quarter of a pixel.
                let apart = (r - 2.0 * (u - 0.5)).abs().max((g - 2.0 * (v - 0.5)).abs());
                assert!(apart <= 0.51, "{distortion:?}, site {site}: {apart}");
                let (back, z) = picture.see(point).expect("in the picture");
                assert_eq!(picture.site(back), Some(site));
                assert!((z - 2.5).abs() < 1e-6);
            }
            assert!(shown > picture.sites.len() / 2, "{shown}");
        }
    }
}

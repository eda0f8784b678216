//! A box or strokes become a mask: colour models of object and background, and a minimum cut between them.
//!
//! GrabCut (Rother et al. 2004): each side's colours are a mixture of Gaussians; a pixel's label costs what its side's
//! mixture says of its colour, and labels of neighbours differ at a cost that falls with their contrast. The cheapest
//! labelling is a minimum cut of a graph on the pixels (`min_cut`); mixtures and labels take turns.

use std::path::Path;

use image::{GrayImage, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64;

use super::min_cut::{Grid, SHIFTS};
use super::{Error, masks};
use crate::scene::{self, resample};

/// The longer side of the picture that is cut, pixels.
const SIDE: u32 = 320;
/// Gaussians of the object's mixture and of the background's, which shows more things.
pub(super) const COMPONENTS: [usize; 2] = [5, 8];
/// Rounds of mixtures and cuts.
const ROUNDS: u32 = 6;
/// Cost of a border between pixels of the same colour (Rother et al.: 50, for larger pictures, whose narrow parts are more
/// pixels wide). In a box the next is tried where the object does not fill it: a thin one is mostly border.
pub(super) const SMOOTHNESS: [f64; 4] = [20.0, 8.0, 3.0, 1.0];
/// Costs are whole numbers of this fraction.
pub(super) const UNIT: f64 = 256.0;
/// Pieces smaller than this share of the largest are no part of the object.
const SPECK: f64 = 0.05;

/// What is known of a pixel before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// It is the object.
    Object,
    /// It is not.
    Background,
    /// Nothing; the cut decides, beginning with the object.
    Maybe,
    /// Nothing; the cut decides, beginning with the background.
    MaybeBackground,
}

// ---------------------------------------------------------------- colour models

/// One Gaussian of a mixture.
#[derive(Clone, Copy)]
struct Component {
    weight: f64,
    mean: [f64; 3],
    /// Inverse covariance.
    inverse: glam::DMat3,
    determinant: f64,
}

impl Component {
    /// Of these colours, out of `all` of the mixture.
    fn of(colors: &[[f64; 3]], all: usize) -> Self {
        let n = colors.len() as f64;
        let mean: [f64; 3] = std::array::from_fn(|c| colors.iter().map(|p| p[c]).sum::<f64>() / n);
        let mut covariance = glam::DMat3::ZERO;
        for color in colors {
            let d = glam::DVec3::from_array(std::array::from_fn(|c| color[c] - mean[c]));
            covariance += glam::DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        }
        // A level of grey of noise: one colour only is no singular covariance.
        let covariance = covariance * (1.0 / n) + glam::DMat3::IDENTITY;
        Self { weight: n / all as f64, mean, inverse: covariance.inverse(), determinant: covariance.determinant() }
    }

    /// Minus the logarithm of weight times density, without the constant.
    fn cost(&self, color: [f64; 3]) -> f64 {
        let d = glam::DVec3::from_array(std::array::from_fn(|c| color[c] - self.mean[c]));
        -self.weight.ln() + 0.5 * self.determinant.ln() + 0.5 * d.dot(self.inverse * d)
    }
}

/// A mixture of Gaussians over colours, or over places.
pub(super) struct Mixture(Vec<Component>);

impl Mixture {
    /// Of these colours: k-means, then a Gaussian of each cluster.
    pub(super) fn of(colors: &[[f64; 3]], components: usize, seed: u64) -> Self {
        let mut rng = Pcg64::new(seed.into(), 31);
        let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>();
        let mut centers = vec![colors[rng.random_range(0..colors.len())]];
        while centers.len() < components {
            // The next centre is drawn by its squared distance from those there are (k-means++).
            let nearest: Vec<f64> = colors
                .iter()
                .map(|color| centers.iter().map(|c| distance(*c, *color)).fold(f64::INFINITY, f64::min))
                .collect();
            let total: f64 = nearest.iter().sum();
            if total < 1.0 {
                break;
            }
            let mut left = rng.random_range(0.0..total);
            let drawn = nearest.iter().position(|d| {
                left -= d;
                left < 0.0
            });
            centers.push(colors[drawn.unwrap_or(colors.len() - 1)]);
        }
        let mut clusters: Vec<Vec<[f64; 3]>> = vec![];
        for _ in 0..8 {
            clusters = vec![vec![]; centers.len()];
            for color in colors {
                let best = (0..centers.len())
                    .min_by(|a, b| distance(centers[*a], *color).total_cmp(&distance(centers[*b], *color)));
                clusters[best.unwrap_or(0)].push(*color);
            }
            for (center, cluster) in centers.iter_mut().zip(&clusters) {
                if !cluster.is_empty() {
                    let n = cluster.len() as f64;
                    *center = std::array::from_fn(|c| cluster.iter().map(|p| p[c]).sum::<f64>() / n);
                }
            }
        }
        let components = clusters.iter().filter(|cluster| !cluster.is_empty());
        Self(components.map(|cluster| Component::of(cluster, colors.len())).collect())
    }

    /// How far a value is from the nearest component, squared, in its standard deviations.
    pub(super) fn distance(&self, value: [f64; 3]) -> f64 {
        let from = |component: &Component| {
            let d = glam::DVec3::from_array(std::array::from_fn(|c| value[c] - component.mean[c]));
            d.dot(component.inverse * d)
        };
        self.0.iter().map(from).fold(f64::INFINITY, f64::min)
    }

    /// Cost of a colour: that of the component it fits best.
    pub(super) fn cost(&self, color: [f64; 3]) -> f64 {
        self.0.iter().map(|component| component.cost(color)).fold(f64::INFINITY, f64::min)
    }
}

/// Values that a mixture is made of at most.
const SAMPLES: usize = 3000;

/// Some of these, evenly spread: as many as a mixture is made of.
pub(super) fn some<T: Copy>(all: &[T]) -> Vec<T> {
    all.iter().step_by(all.len().div_ceil(SAMPLES).max(1)).copied().collect()
}

// ---------------------------------------------------------------- pictures

/// What a border between neighbours costs: a pixel, the direction of its neighbour, the cost.
fn contrasts(colors: &[[f64; 3]], [w, h]: [usize; 2], smoothness: f64) -> Vec<(usize, usize, i32)> {
    let contrast = |i: usize, j: usize| (0..3).map(|c| (colors[i][c] - colors[j][c]).powi(2)).sum::<f64>();
    let mut edges = vec![];
    for i in 0..w * h {
        for (d, [dx, dy]) in SHIFTS.into_iter().enumerate().skip(4) {
            let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
            if x >= 0 && x < w as isize && y < h as isize {
                let j = y as usize * w + x as usize;
                edges.push((i, d, contrast(i, j), f64::hypot(dx as f64, dy as f64)));
            }
        }
    }
    let mean = edges.iter().map(|edge| edge.2).sum::<f64>() / edges.len().max(1) as f64;
    let beta = if mean > 0.0 { 0.5 / mean } else { 0.0 };
    let cost = |contrast: f64, length: f64| (UNIT * smoothness * (-beta * contrast).exp() / length) as i32;
    edges.into_iter().map(|(i, d, contrast, length)| (i, d, cost(contrast, length))).collect()
}

/// The object's pixels, given what is known: mixtures and cuts in turn. Nothing where one side runs out of pixels.
pub fn segment(picture: &RgbImage, known: &[Known], smoothness: f64) -> Option<Vec<bool>> {
    let (w, h) = (picture.width() as usize, picture.height() as usize);
    let colors: Vec<[f64; 3]> = picture.pixels().map(|p| p.0.map(f64::from)).collect();
    let mut object: Vec<bool> = known.iter().map(|k| matches!(k, Known::Object | Known::Maybe)).collect();
    let edges = contrasts(&colors, [w, h], smoothness);
    for round in 0..ROUNDS {
        let of =
            |side: bool| -> Vec<[f64; 3]> { (0..w * h).filter(|i| object[*i] == side).map(|i| colors[i]).collect() };
        let (inside, outside) = (of(true), of(false));
        if inside.is_empty() || outside.is_empty() {
            return None;
        }
        let mixture = |colors: &[[f64; 3]], side: usize| Mixture::of(&some(colors), COMPONENTS[side], side as u64 + 1);
        let (inside, outside) = (mixture(&inside, 0), mixture(&outside, 1));
        let mut grid = Grid::new([w, h], &SHIFTS);
        for &(i, d, cost) in &edges {
            grid.set_edge(i, d, cost);
        }
        let sure = (UNIT * SMOOTHNESS[0] * 16.0) as i64;
        for (i, known) in known.iter().enumerate() {
            match known {
                Known::Object => grid.set_terminals(i, sure, 0),
                Known::Background => grid.set_terminals(i, 0, sure),
                _ => {
                    let cost = |mixture: &Mixture| (UNIT * mixture.cost(colors[i])) as i64;
                    grid.set_terminals(i, cost(&outside), cost(&inside));
                }
            }
        }
        let labels = grid.cut();
        if labels == object && round > 0 {
            break;
        }
        object = labels;
    }
    object.iter().any(|v| *v).then_some(object)
}

/// A picture's size with the longer side at most [`SIDE`].
pub(super) fn reduced(size: [u32; 2]) -> [u32; 2] {
    within(size, SIDE)
}

/// A picture's size with the longer side at most `side`.
pub(super) fn within(size: [u32; 2], side: u32) -> [u32; 2] {
    let longest = size[0].max(size[1]);
    if longest <= side {
        size
    } else {
        size.map(|n| (u64::from(n) * u64::from(side) / u64::from(longest)).max(1) as u32)
    }
}

pub(super) fn to_mask(object: Vec<bool>, from: [u32; 2], to: [u32; 2]) -> GrayImage {
    let raw = object.into_iter().map(|v| if v { 255 } else { 0 }).collect();
    let mask = GrayImage::from_raw(from[0], from[1], raw).expect("a label per pixel");
    let mask = masks::without_specks(&mask, SPECK);
    masks::threshold(&masks::parts(&mask, from), from, to, 0.5)
}

/// Strokes on a picture.
#[derive(Clone, Debug)]
pub struct Strokes {
    known: Vec<Known>,
    size: [u32; 2],
}

impl Strokes {
    /// Reads them: white or green is the object, black or red is not, grey or transparent says nothing. `size` is the
    /// photograph's.
    ///
    /// # Errors
    /// An unreadable file, one of other proportions than the photograph, one without a stroke on the object.
    pub fn read(path: &Path, size: [u32; 2]) -> Result<Self, Error> {
        let found = scene::dimensions(path)?;
        let ratio = |s: [u32; 2]| f64::from(s[0]) / f64::from(s[1]);
        if (ratio(found) / ratio(size) - 1.0).abs() > 0.02 {
            return Err(scene::Error::MaskSize { path: path.to_owned(), size: found, picture: size }.into());
        }
        let picture = scene::decode(path)?.into_rgba8();
        let known = picture.pixels().map(|p| {
            let [r, g, b, a] = p.0.map(i32::from);
            if a < 128 {
                Known::MaybeBackground
            } else if g > r + 60 && g > 100 || r > 220 && g > 220 && b > 220 {
                Known::Object
            } else if r > g + 60 && r > 100 || r < 35 && g < 35 && b < 35 {
                Known::Background
            } else {
                Known::MaybeBackground
            }
        });
        let strokes = Self { known: known.collect(), size: found };
        if !strokes.known.contains(&Known::Object) {
            let what = "no stroke is white or green; draw at least one on the object".into();
            return Err(Error::File { path: path.to_owned(), what });
        }
        Ok(strokes)
    }
}

/// The object that the strokes mean within a box (x0, y0 and one past x1, y1): what lies beyond neither counts nor teaches
/// colours.
pub fn from_strokes_in_box(picture: &RgbImage, strokes: &Strokes, [x0, y0, x1, y1]: [u32; 4]) -> GrayImage {
    let full = [picture.width(), picture.height()];
    let size = [x1 - x0, y1 - y0];
    let part = image::imageops::crop_imm(picture, x0, y0, size[0], size[1]).to_image();
    let stroke = |x: u32, y: u32| {
        let at = |v: u32, axis: usize| u64::from(v) * u64::from(strokes.size[axis]) / u64::from(full[axis]);
        strokes.known[(at(y, 1) * u64::from(strokes.size[0]) + at(x, 0)) as usize]
    };
    let known = (0..size[0] * size[1]).map(|i| stroke(x0 + i % size[0], y0 + i / size[0])).collect();
    let inside = from_strokes(&part, &Strokes { known, size });
    let mut mask = GrayImage::new(full[0], full[1]);
    image::imageops::replace(&mut mask, &inside, i64::from(x0), i64::from(y0));
    mask
}

/// The object that the strokes mean. Without a stroke beside it, the picture's border is what it is told from.
pub fn from_strokes(picture: &RgbImage, strokes: &Strokes) -> GrayImage {
    let full = [picture.width(), picture.height()];
    let size = reduced(full);
    let small = resample::photograph(picture, size);
    let [sw, sh] = strokes.size;
    let mut known = vec![Known::MaybeBackground; (size[0] * size[1]) as usize];
    for (i, stroke) in strokes.known.iter().enumerate().filter(|(_, k)| **k != Known::MaybeBackground) {
        let (x, y) = (i as u32 % sw, i as u32 / sw);
        known[(y * size[1] / sh * size[0] + x * size[0] / sw) as usize] = *stroke;
    }
    if !known.contains(&Known::Background) {
        for x in 0..size[0] {
            for y in (0..size[1]).filter(|y| x == 0 || x + 1 == size[0] || *y == 0 || y + 1 == size[1]) {
                known[(y * size[0] + x) as usize] = Known::Background;
            }
        }
    }
    // The strokes themselves are object even where the cut finds nothing.
    let object =
        segment(&small, &known, SMOOTHNESS[0]).unwrap_or_else(|| known.iter().map(|k| *k == Known::Object).collect());
    to_mask(object, size, full)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Two squares of one colour, a stroke on one of them, and a box around it: the other is not of the object.
    #[test]
    fn a_box_bounds_what_strokes_reach() {
        let square = |x: u32, y: u32, at: u32| (at..at + 20).contains(&x) && (20..40).contains(&y);
        let picture = RgbImage::from_fn(100, 60, |x, y| {
            image::Rgb(if square(x, y, 15) || square(x, y, 65) { [40, 160, 60] } else { [200, 190, 180] })
        });
        let known = |x: u32, y: u32| {
            if (20..30).contains(&x) && (28..32).contains(&y) { Known::Object } else { Known::MaybeBackground }
        };
        let strokes = Strokes { known: (0..6000).map(|i| known(i % 100, i / 100)).collect(), size: [100, 60] };
        let count = |mask: &GrayImage, at: u32| {
            mask.enumerate_pixels().filter(|(x, y, v)| square(*x, *y, at) && v.0[0] != 0).count()
        };
        let both = from_strokes(&picture, &strokes);
        assert!(count(&both, 15) > 380 && count(&both, 65) > 380, "alike without a box");
        let one = from_strokes_in_box(&picture, &strokes, [5, 10, 48, 52]);
        assert!(count(&one, 15) > 380 && count(&one, 65) == 0, "{} {}", count(&one, 15), count(&one, 65));
    }

    /// A textured disc on a textured ground.
    pub(in crate::prepare) fn disc() -> (RgbImage, impl Fn(u32, u32) -> bool) {
        let inside = |x: u32, y: u32| (f64::from(x) - 60.0).powi(2) + (f64::from(y) - 45.0).powi(2) < 22.0f64.powi(2);
        let picture = RgbImage::from_fn(128, 96, |x, y| {
            let noise = ((x * 7 + y * 13) % 17) as u8;
            image::Rgb(if inside(x, y) { [170 + noise, 60 + noise, 40] } else { [60 + noise, 90 + noise, 120] })
        });
        (picture, inside)
    }

    pub(in crate::prepare) fn wrong(mask: &GrayImage, inside: &impl Fn(u32, u32) -> bool) -> usize {
        mask.enumerate_pixels().filter(|(x, y, v)| (v.0[0] != 0) != inside(*x, *y)).count()
    }

    #[test]
    fn strokes_become_their_object() {
        let (picture, inside) = disc();
        let mut strokes = image::RgbaImage::new(128, 96);
        for i in 0..12 {
            strokes.put_pixel(52 + i, 45, image::Rgba([0, 255, 0, 255]));
            strokes.put_pixel(10 + i, 10, image::Rgba([255, 0, 0, 255]));
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("strokes.png");
        strokes.save(&path).unwrap();
        let read = Strokes::read(&path, [256, 192]).unwrap();
        assert_eq!(read.known.iter().filter(|k| **k == Known::Object).count(), 12);
        let mask = from_strokes(&picture, &read);
        assert!(wrong(&mask, &inside) < 40);
        image::RgbaImage::new(128, 96).save(&path).unwrap();
        assert!(Strokes::read(&path, [128, 96]).unwrap_err().to_string().contains("no stroke"));
        assert!(Strokes::read(&path, [96, 128]).is_err());
    }
}

//! What is in the hole: its geometry against the true depth, and what is left of the object in its colours.

use image::{GrayImage, RgbImage};
use serde::{Deserialize, Serialize};

use super::seen::{Shown, Surface};
use crate::scene::resample;
use crate::statistics::median;

/// A depth counts as right within this share of the true one.
const RIGHT: f64 = 0.05;

/// How true the depth inside the mask is, where it is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Geometry {
    /// Mean of |z - true z| / true z over the pixels that show a surface (half covered at least); absent where none does.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub relative_error: Option<f64>,
    /// Share of the pixels of known depth that show a surface within 5 % of it.
    pub completeness: f64,
}

/// Compares a surface with the true depth inside the mask. `truth` is `[row-major pixel]` z in scene units, not positive
/// or not finite where it is unknown. `None` if it is unknown in the whole mask.
///
/// # Panics
/// Unless surface, truth and mask are equally large.
pub fn geometry(surface: &Surface, truth: &[f32], mask: &GrayImage) -> Option<Geometry> {
    let (depth, inside) = (surface.depth(), mask.as_raw());
    assert!(depth.len() == truth.len() && depth.len() == inside.len(), "one value of each per pixel");
    let (mut known, mut shown, mut right, mut sum) = (0usize, 0usize, 0usize, 0.0);
    for ((z, t), _) in depth.iter().zip(truth).zip(inside).filter(|((_, t), m)| **m != 0 && is_known(**t)) {
        known += 1;
        if !z.is_nan() {
            let error = f64::from((z - t).abs()) / f64::from(*t);
            shown += 1;
            sum += error;
            right += usize::from(error <= RIGHT);
        }
    }
    (known > 0).then(|| Geometry {
        relative_error: (shown > 0).then(|| sum / shown as f64),
        completeness: right as f64 / known as f64,
    })
}

fn is_known(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

/// The factor that brings depth maps of another unit to the scene's: the median ratio of shown to true depth outside the
/// masks, over all views. `None` where nothing can be compared.
pub fn unit<'a>(views: impl IntoIterator<Item = (&'a Surface, &'a [f32], Option<&'a GrayImage>)>) -> Option<f64> {
    let mut ratios: Vec<f64> = vec![];
    for (surface, truth, mask) in views {
        let outside = |i: usize| mask.is_none_or(|mask| mask.as_raw()[i] == 0);
        let pairs = surface.depth().iter().zip(truth).enumerate();
        let usable = pairs.filter(|(i, (z, t))| outside(*i) && !z.is_nan() && is_known(**t));
        ratios.extend(usable.map(|(_, (z, t))| f64::from(*z) / f64::from(*t)));
    }
    median(ratios)
}

/// Fewest pixels from which a residue is computed.
const PIXELS: usize = 64;

/// How much of the removed object is left inside the mask of a train view: 0 nothing, 1 all of it.
///
/// The rendered view R is compared with the photograph O, which shows the object in the very same pixels, and with the
/// background B that belongs there. An object left at opacity a shows R = B + a (O - B), so a is what least squares find
/// over the pixels of the mask. A hole that is merely blurred, or of another texture than B, has R - B = b (B - mean B)
/// plus what is unrelated to the object; alone, a would take a share of that, because O - B contains -B. Both
/// coefficients are therefore found together, and a is the residue. Noise makes it a little positive or negative.
///
/// `background` is `[row-major pixel]` RGB in \[0, 1\]; pixels without one are left out. `None` with fewer than 64 pixels,
/// or where the photograph shows the background itself.
///
/// # Panics
/// Unless all are equally large.
pub fn residue(
    rendered: &RgbImage,
    photograph: &RgbImage,
    background: &[Option<[f64; 3]>],
    mask: &GrayImage,
) -> Option<f64> {
    assert!(
        rendered.dimensions() == photograph.dimensions()
            && rendered.dimensions() == mask.dimensions()
            && background.len() == mask.as_raw().len(),
        "one value of each per pixel"
    );
    let used: Vec<(usize, [f64; 3])> = background
        .iter()
        .enumerate()
        .filter(|(i, _)| mask.as_raw()[*i] != 0)
        .filter_map(|(i, b)| Some((i, (*b)?)))
        .collect();
    if used.len() < PIXELS {
        return None;
    }
    let n = used.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|c| used.iter().map(|(_, b)| b[c]).sum::<f64>() / n);
    let value = |image: &RgbImage, at: usize| f64::from(image.as_raw()[at]) / 255.0;
    // Normal equations of D = a G + b C: D what is shown too much, G the object, C the background's own contrast.
    let (mut gg, mut gc, mut cc, mut gd, mut cd) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (i, b) in &used {
        for c in 0..3 {
            let (d, g, k) = (value(rendered, 3 * i + c) - b[c], value(photograph, 3 * i + c) - b[c], b[c] - mean[c]);
            gg += g * g;
            gc += g * k;
            cc += k * k;
            gd += g * d;
            cd += k * d;
        }
    }
    // Less than 2 of 255 steps between the photograph and the background, or nothing but the background's contrast: there
    // is no object to find.
    let object = if cc > 0.0 { gg - gc * gc / cc } else { gg };
    let least = 3.0 * n * (2.0f64 / 255.0).powi(2);
    (object > least.max(1e-9 * gg)).then(|| (gd - if cc > 0.0 { gc * cd / cc } else { 0.0 }) / object)
}

/// A clean picture of another view as `view` would show it, through the trained model's geometry: what belongs behind
/// the object. `None` where the other view does not see what the model shows.
///
/// # Panics
/// Unless `picture` is as large as `from`'s view.
pub fn warped(view: Shown<'_>, from: Shown<'_>, picture: &RgbImage) -> Vec<Option<[f64; 3]>> {
    assert_eq!(picture.dimensions(), (from.camera.size[0], from.camera.size[1]), "the picture is that of the view");
    view.points()
        .into_iter()
        .map(|point| Some(resample::color_at(picture, from.sees(point?)?).map(|v| v / 255.0)))
        .collect()
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};
    use rand::RngExt;
    use rand_pcg::Pcg64;

    use super::*;

    const SIZE: u32 = 64;

    /// Smooth random colours around a base, in steps of some pixels.
    fn texture(seed: u64, base: [f64; 3]) -> Vec<[f64; 3]> {
        let mut rng = Pcg64::new(seed.into(), 7);
        let waves: Vec<[f64; 4]> = (0..12)
            .map(|_| {
                std::array::from_fn(|k| if k < 3 { rng.random_range(-0.5..0.5) } else { rng.random_range(0.0..6.0) })
            })
            .collect();
        (0..SIZE * SIZE)
            .map(|i| {
                let (x, y) = (f64::from(i % SIZE), f64::from(i / SIZE));
                let wave: f64 = waves.iter().map(|w| 0.025 * (w[0] * x + w[1] * y + w[3]).sin()).sum();
                base.map(|b| b + wave)
            })
            .collect()
    }

    fn picture(colors: &[[f64; 3]]) -> RgbImage {
        RgbImage::from_fn(SIZE, SIZE, |x, y| {
            Rgb(colors[(y * SIZE + x) as usize].map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8))
        })
    }

    fn mask() -> GrayImage {
        GrayImage::from_fn(SIZE, SIZE, |x, y| Luma([255 * u8::from((8..56).contains(&x) && (8..56).contains(&y))]))
    }

    fn blurred(colors: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let at = |x: i64, y: i64| colors[(y.clamp(0, 63) * 64 + x.clamp(0, 63)) as usize];
        (0..64i64 * 64)
            .map(|i| {
                let (x, y) = (i % 64, i / 64);
                let near: Vec<[f64; 3]> = (-4..=4)
                    .flat_map(|dy| (-4..=4).map(move |dx| (dx, dy)))
                    .map(|(dx, dy)| at(x + dx, y + dy))
                    .collect();
                std::array::from_fn(|c| near.iter().map(|v| v[c]).sum::<f64>() / near.len() as f64)
            })
            .collect()
    }

    #[test]
    fn the_residue_is_the_opacity_of_what_is_left() {
        let (object, background) = (texture(1, [0.7, 0.35, 0.3]), texture(2, [0.4, 0.45, 0.5]));
        let known: Vec<_> = background.iter().map(|b| Some(*b)).collect();
        let of = |shown: &[[f64; 3]]| residue(&picture(shown), &picture(&object), &known, &mask()).expect("an object");
        for left in [0.0, 0.03, 0.25, 1.0] {
            let shown: Vec<[f64; 3]> = background
                .iter()
                .zip(&object)
                .map(|(b, o)| std::array::from_fn(|c| b[c] + left * (o[c] - b[c])))
                .collect();
            // Rounding to 8 bits: errors of 1 / 510 without a bias, over 7,000 values against an object of 0.2.
            assert!((of(&shown) - left).abs() < 5e-4, "{left}: {}", of(&shown));
        }
        // A hole without detail has lost nothing but contrast; one of another texture is unrelated to the object, up to a
        // chance correlation of the two textures (48 x 48 pixels, detail of some 6: about 60 independent places).
        assert!(of(&blurred(&background)).abs() < 0.02, "{}", of(&blurred(&background)));
        let other = texture(3, [0.4, 0.45, 0.5]);
        assert!(of(&other).abs() < 0.05, "{}", of(&other));
        // Without the second coefficient the blur alone would look like an object.
        let naive = |shown: &[[f64; 3]]| {
            let pairs = || {
                shown
                    .iter()
                    .zip(&background)
                    .zip(&object)
                    .flat_map(|((r, b), o)| (0..3).map(move |c| (r[c] - b[c], o[c] - b[c])))
            };
            pairs().map(|(d, g)| d * g).sum::<f64>() / pairs().map(|(_, g)| g * g).sum::<f64>()
        };
        assert!(naive(&other) > of(&other).abs());
    }

    #[test]
    fn a_residue_needs_an_object_and_a_background() {
        let background = texture(2, [0.4, 0.45, 0.5]);
        let shown = picture(&background);
        let known: Vec<_> = background.iter().map(|b| Some(*b)).collect();
        assert_eq!(residue(&shown, &shown, &known, &mask()), None, "the photograph shows no object");
        let object = picture(&texture(1, [0.7, 0.35, 0.3]));
        assert_eq!(residue(&shown, &object, &known, &GrayImage::new(SIZE, SIZE)), None, "an empty mask");
        assert_eq!(residue(&shown, &object, &vec![None; 4096], &mask()), None, "no background is known");
        let grey = vec![Some([0.5; 3]); 4096];
        let red = RgbImage::from_pixel(SIZE, SIZE, Rgb([255, 0, 0]));
        let flat = residue(&RgbImage::from_pixel(SIZE, SIZE, Rgb([255, 0, 0])), &red, &grey, &mask());
        assert_eq!(flat, Some(1.0), "a background without contrast");
    }

    #[test]
    fn geometry_counts_inside_the_mask_where_depth_is_known() {
        // Transmittance 1: no surface. Truth 0: unknown. The last pixel is outside the mask.
        let surface = Surface::new([6, 1], &[10.0, 10.0, 10.0, 0.0, 10.0, 10.0], &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        let truth = [10.0, 10.4, 20.0, 10.0, 0.0, 99.0];
        let mask = GrayImage::from_fn(6, 1, |x, _| Luma([u8::from(x < 5)]));
        let found = geometry(&surface, &truth, &mask).expect("four known depths");
        let expected = (0.0 + f64::from(10.4f32 - 10.0) / f64::from(10.4f32) + 0.5) / 3.0;
        assert!((found.relative_error.expect("three surfaces") - expected).abs() < 1e-6, "{found:?}");
        assert_eq!(found.completeness, 0.5, "two of four are within 5 %");
        assert_eq!(geometry(&surface, &[0.0; 6], &mask), None);
        let empty = Surface::new([6, 1], &[0.0; 6], &[1.0; 6]);
        assert_eq!(geometry(&empty, &truth, &mask), Some(Geometry { relative_error: None, completeness: 0.0 }));
        let factor = unit([(&surface, &[0.01f32, 0.01, 0.02, 0.01, 0.0, 0.01][..], Some(&mask))]);
        assert!((factor.expect("one pixel outside") - 1000.0).abs() < 1e-3, "{factor:?}");
        assert_eq!(unit([(&empty, &truth[..], None)]), None);
    }
}

//! A test view's figures without its own exposure.
//!
//! A model of photographs whose exposure was evened out has the usual exposure, and a test photograph its own. What is left
//! after the best gain and offset per channel is the model's own error.

use image::{GrayImage, RgbImage};

use super::{Error, Figures, Protocol, measure};

/// The rendered view with the gain and offset, per channel, that bring it nearest to the photograph over the pixels outside
/// the mask (least squares), rounded to 8 bits. A channel that is the same everywhere keeps its gain.
pub fn in_exposure_of(rendered: &RgbImage, truth: &RgbImage, mask: Option<&GrayImage>) -> RgbImage {
    let outside = |i: usize| mask.is_none_or(|mask| mask.as_raw().get(i).is_none_or(|value| *value == 0));
    let table: [[u8; 256]; 3] = std::array::from_fn(|c| {
        let pairs = rendered.pixels().zip(truth.pixels()).enumerate().filter(|(i, _)| outside(*i));
        let [mut n, mut x, mut y, mut xx, mut xy] = [0.0; 5];
        for (_, (r, t)) in pairs {
            let [r, t] = [r.0[c], t.0[c]].map(f64::from);
            (n, x, y, xx, xy) = (n + 1.0, x + r, y + t, xx + r * r, xy + r * t);
        }
        // n^2 times the variance: a whole number, so that 0 is exact.
        let variance = n * xx - x * x;
        let gain = if variance > 0.0 { (n * xy - x * y) / variance } else { 1.0 };
        let offset = if n > 0.0 { (y - gain * x) / n } else { 0.0 };
        std::array::from_fn(|value| (gain * value as f64 + offset).round() as u8)
    });
    let mut image = rendered.clone();
    image.pixels_mut().for_each(|pixel| pixel.0 = std::array::from_fn(|c| table[c][usize::from(pixel.0[c])]));
    image
}

/// The figures of the full image after a gain and an offset per channel were fitted to the photograph outside the mask.
///
/// # Errors
/// Images of different sizes, or without pixels.
pub fn with_fitted_exposure(rendered: &RgbImage, truth: &RgbImage, mask: Option<&GrayImage>) -> Result<Figures, Error> {
    Ok(measure(&in_exposure_of(rendered, truth, mask), truth, None, None, Protocol::Plain)?.full)
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Luma, Rgb};

    #[test]
    fn another_exposure_is_no_error() {
        let truth = RgbImage::from_fn(32, 24, |x, y| Rgb([(60 + 3 * x) as u8, (80 + 2 * y) as u8, 90]));
        // 0.8 of the stored values: up to half a level is lost in it, and half a level more on the way back, as large as 0.625.
        let mut darker = truth.clone();
        darker.pixels_mut().for_each(|p| p.0 = p.0.map(|v| (0.8 * f64::from(v)).round() as u8));
        let plain = measure(&darker, &truth, None, None, Protocol::Plain).expect("a figure").full.psnr;
        let found = with_fitted_exposure(&darker, &truth, None).expect("a figure").psnr;
        assert!(plain < 25.0 && found > 20.0 * (255.0f64 / 1.125).log10(), "{plain}, {found}");
        // The object does not count: a view that is right but for it needs no gain.
        let mask = GrayImage::from_fn(32, 24, |x, _| Luma([if x < 8 { 255 } else { 0 }]));
        let mut painted = truth.clone();
        painted.enumerate_pixels_mut().filter(|(x, _, _)| *x < 8).for_each(|(_, _, p)| p.0 = [0; 3]);
        let both = [in_exposure_of(&painted, &truth, Some(&mask)), painted];
        assert!(both[0] == both[1]);
    }
}

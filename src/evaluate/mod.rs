//! Image metrics and their report.
//!
//! PSNR, SSIM and FLIP of a rendered view against its photograph, each on the full image, inside the mask, and inside the
//! mask's bounding box. The maps of SSIM and FLIP are computed once on the full image and averaged over the region, so that
//! a region's border sees its real surroundings.

mod report;
mod ssim;

use image::{GrayImage, ImageBuffer, Pixel, Rgb32FImage, RgbImage};
use serde::{Deserialize, Serialize};

pub use report::{Mean, Report, ViewMetrics};
pub use ssim::ssim_map;

/// Why two images cannot be compared, or a report not be written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Images, or an image and its mask, of different sizes.
    #[error("the {what} is {} x {}, but the rendered image is {} x {}", found.0, found.1, rendered.0, rendered.1)]
    Size {
        /// "photograph" or "mask".
        what: &'static str,
        /// Its width and height, pixels.
        found: (u32, u32),
        /// Width and height of the rendered image, pixels.
        rendered: (u32, u32),
    },
    /// Images without pixels.
    #[error("an image without pixels cannot be compared")]
    Empty,
    /// A NaN or an infinity in a float image.
    #[error("pixel ({x}, {y}) of the {what} is not finite")]
    NotFinite {
        /// "photograph" or "rendered image".
        what: &'static str,
        /// Column.
        x: u32,
        /// Row.
        y: u32,
    },
    /// A report that cannot be written.
    #[error("{}: cannot write the report: {source}", path.display())]
    Write {
        /// The file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// The metrics of one region of one view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Peak signal-to-noise ratio in dB, `-10 log10(MSE)` over pixels and channels of the region, peak 1. Infinite where
    /// the region is identical: JSON has the string `"inf"` there.
    #[serde(with = "decibel")]
    pub psnr: f64,
    /// Mean of the SSIM map over the region (Wang et al. 2004; 11 x 11 Gaussian window, sigma 1.5, zero padding).
    pub ssim: f64,
    /// Mean of the LDR-FLIP map over the region (Andersson et al. 2020; 67 pixels per degree); 0 is identical.
    pub flip: f64,
}

/// The metrics of one view by region. Metrics of the mask are absent without a mask, or where it is empty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// All pixels.
    pub full: Figures,
    /// Pixels where the mask is not zero.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mask: Option<Figures>,
    /// The smallest upright rectangle that holds them.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none", default)]
    pub bounding_box: Option<Figures>,
}

/// Compares an 8-bit rendered view with its photograph. `mask` is non-zero inside the object's region.
///
/// # Errors
/// Images or mask of different sizes, or without pixels.
pub fn compare(rendered: &RgbImage, truth: &RgbImage, mask: Option<&GrayImage>) -> Result<Metrics, Error> {
    let unit = |image: &RgbImage| image.as_raw().iter().map(|v| f64::from(*v) / 255.0).collect::<Vec<_>>();
    check_sizes(rendered, truth, mask)?;
    Ok(metrics(rendered.dimensions(), &unit(rendered), &unit(truth), &flip_map(rendered, truth), mask))
}

/// Compares float images with values in \[0, 1\]. PSNR and SSIM see the values as they are; FLIP sees them clamped and
/// rounded to 8 bits, which is what its implementation takes.
///
/// # Errors
/// Images or mask of different sizes, or without pixels; values that are not finite.
pub fn compare_float(rendered: &Rgb32FImage, truth: &Rgb32FImage, mask: Option<&GrayImage>) -> Result<Metrics, Error> {
    check_sizes(rendered, truth, mask)?;
    for (what, image) in [("rendered image", rendered), ("photograph", truth)] {
        let broken = image.enumerate_pixels().find(|(_, _, pixel)| pixel.0.iter().any(|v| !v.is_finite()));
        if let Some((x, y, _)) = broken {
            return Err(Error::NotFinite { what, x, y });
        }
    }
    let wide = |image: &Rgb32FImage| image.as_raw().iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    let flip = flip_map(&to_bytes(rendered), &to_bytes(truth));
    Ok(metrics(rendered.dimensions(), &wide(rendered), &wide(truth), &flip, mask))
}

fn to_bytes(image: &Rgb32FImage) -> RgbImage {
    let bytes = image.as_raw().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    RgbImage::from_raw(image.width(), image.height(), bytes).expect("as many bytes as floats")
}

fn check_sizes<P: Pixel>(
    rendered: &ImageBuffer<P, Vec<P::Subpixel>>,
    truth: &ImageBuffer<P, Vec<P::Subpixel>>,
    mask: Option<&GrayImage>,
) -> Result<(), Error> {
    let size = rendered.dimensions();
    let others = [("photograph", Some(truth.dimensions())), ("mask", mask.map(GrayImage::dimensions))];
    for (what, found) in others {
        if let Some(found) = found.filter(|found| *found != size) {
            return Err(Error::Size { what, found, rendered: size });
        }
    }
    if size.0 == 0 || size.1 == 0 { Err(Error::Empty) } else { Ok(()) }
}

fn flip_map(rendered: &RgbImage, truth: &RgbImage) -> Vec<f32> {
    let (width, height) = rendered.dimensions();
    let image = |image: &RgbImage| nv_flip::FlipImageRgb8::with_data(width, height, image.as_raw());
    nv_flip::flip(image(truth), image(rendered), nv_flip::DEFAULT_PIXELS_PER_DEGREE).to_vec()
}

fn metrics(
    (width, height): (u32, u32),
    rendered: &[f64],
    truth: &[f64],
    flip: &[f32],
    mask: Option<&GrayImage>,
) -> Metrics {
    let (width, height) = (width as usize, height as usize);
    let ssim = ssim_map(rendered, truth, width, height);
    let measure = |pixels: &mut dyn Iterator<Item = usize>| {
        let (mut count, mut square, mut similarity, mut difference) = (0usize, 0.0, 0.0, 0.0);
        for pixel in pixels {
            count += 1;
            let channels = 3 * pixel..3 * pixel + 3;
            square += channels.clone().map(|i| (rendered[i] - truth[i]).powi(2)).sum::<f64>() / 3.0;
            similarity += ssim[channels].iter().sum::<f64>() / 3.0;
            difference += f64::from(flip[pixel]);
        }
        let n = count as f64;
        (count > 0).then(|| Figures { psnr: psnr(square / n), ssim: similarity / n, flip: difference / n })
    };
    let full = measure(&mut (0..width * height)).expect("the image has pixels");
    let Some(mask) = mask else { return Metrics { full, mask: None, bounding_box: None } };
    let inside = |pixel: &usize| mask.as_raw()[*pixel] != 0;
    let masked = measure(&mut (0..width * height).filter(inside));
    let bounding_box = bounding_box(mask).and_then(|[left, top, right, bottom]| {
        measure(&mut (top..=bottom).flat_map(|row| (left..=right).map(move |column| row * width + column)))
    });
    Metrics { full, mask: masked, bounding_box }
}

/// Left, top, right and bottom pixel of the mask's non-zero region, all inclusive.
fn bounding_box(mask: &GrayImage) -> Option<[usize; 4]> {
    mask.enumerate_pixels().filter(|(_, _, pixel)| pixel.0[0] != 0).fold(None, |found, (x, y, _)| {
        let (x, y) = (x as usize, y as usize);
        let [left, top, right, bottom] = found.unwrap_or([x, y, x, y]);
        Some([left.min(x), top.min(y), right.max(x), bottom.max(y)])
    })
}

/// PSNR in dB of a mean squared error against a peak of 1; infinite for 0.
pub fn psnr(mean_squared_error: f64) -> f64 {
    // Not -0 for an error of 1.
    0.0 - 10.0 * mean_squared_error.log10()
}

/// A number of decibels; infinity, which JSON cannot hold, is the string "inf".
mod decibel {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Number(f64),
        Text(String),
    }

    pub fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        if value.is_infinite() { serializer.serialize_str("inf") } else { serializer.serialize_f64(*value) }
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        match Written::deserialize(deserializer)? {
            Written::Number(value) => Ok(value),
            Written::Text(text) if text == "inf" => Ok(f64::INFINITY),
            Written::Text(text) => Err(D::Error::custom(format!("`{text}` is neither a number nor \"inf\""))),
        }
    }
}

//! Image metrics and their report.
//!
//! PSNR, SSIM and FLIP of a rendered view against its photograph, each on the full image, inside the mask, inside the
//! mask's bounding box, outside the mask and around its edge; and each of these once more over the pixels alone that some
//! train view photographed ([`seen_map`]). The maps of SSIM and FLIP are computed once on the full image and averaged over
//! the region, so that a region's border sees its real surroundings.
//!
//! What a photograph without the object does not tell is measured in [`hole`]: the geometry behind the object, and how
//! much of the object is left.

mod exposure;
pub mod fid;
pub mod hole;
pub mod lpips;
pub mod network;
mod protocol;
mod report;
mod seen;
mod ssim;

use image::{GrayImage, RgbImage};
use serde::{Deserialize, Serialize};

use crate::scene::resample;

pub use exposure::{in_exposure_of, with_fitted_exposure};
pub use hole::Geometry;
pub use lpips::Perceptual;
pub use protocol::{Judge, Judging, PUBLISHED_ROWS, Protocol, Published};
pub use report::{Mean, Report, Residue, ViewMetrics};
pub use seen::{Shown, Surface, seen_map};
pub use ssim::ssim_map;

/// Why two images cannot be compared, or a report not be written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Images, or an image and its mask, of different sizes.
    #[error("the {what} is {} x {}, but the rendered image is {} x {}", found.0, found.1, rendered.0, rendered.1)]
    Size {
        /// "photograph", "mask" or "map of seen pixels".
        what: &'static str,
        /// Its width and height, pixels.
        found: (u32, u32),
        /// Width and height of the rendered image, pixels.
        rendered: (u32, u32),
    },
    /// Images without pixels.
    #[error("an image without pixels cannot be compared")]
    Empty,
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

/// Half the width of the rim: pixels on either side of the mask's edge.
pub const RIM: u32 = 3;

/// The metrics of one view by region. Those of the mask are absent without a mask, or where it is empty; those of seen
/// pixels are absent where it is not known what was seen, or nothing was.
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
    /// Pixels where the mask is zero.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub outside: Option<Figures>,
    /// Pixels within [`RIM`] pixels of the mask's edge, on both sides of it.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rim: Option<Figures>,
    /// Pixels that some train view photographed, of all.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub full_seen: Option<Figures>,
    /// Of those inside the mask.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mask_seen: Option<Figures>,
    /// Of those in its rectangle.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub box_seen: Option<Figures>,
    /// Of those outside the mask.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub outside_seen: Option<Figures>,
    /// Of those at its rim.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rim_seen: Option<Figures>,
    /// Share of all pixels that some train view photographed.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub seen_share: Option<f64>,
    /// All pixels, after a gain and an offset per channel were fitted to the photograph outside the mask; where the
    /// photographs' exposure was evened out for training.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub fitted: Option<Figures>,
    /// Depth inside the mask, where the true one is known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub geometry: Option<Geometry>,
    /// Distances in the features of networks, where their weights are known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub lpips: Option<Perceptual>,
}

/// A part of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Region {
    /// All of it.
    Full,
    /// Outside the mask.
    Outside,
    /// Around the mask's edge.
    Rim,
    /// Inside the mask.
    Mask,
    /// The mask's bounding box.
    Box,
}

impl Region {
    /// In the order of tables.
    pub const ALL: [Self; 5] = [Self::Full, Self::Outside, Self::Rim, Self::Mask, Self::Box];

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "full image",
            Self::Outside => "outside mask",
            Self::Rim => "mask's rim",
            Self::Mask => "inside mask",
            Self::Box => "mask's box",
        }
    }
}

impl Metrics {
    /// Of a view of which nothing but the full image is judged.
    pub fn new(full: Figures) -> Self {
        Self {
            full,
            mask: None,
            bounding_box: None,
            outside: None,
            rim: None,
            full_seen: None,
            mask_seen: None,
            box_seen: None,
            outside_seen: None,
            rim_seen: None,
            seen_share: None,
            fitted: None,
            geometry: None,
            lpips: None,
        }
    }

    /// The figures of a region, of all its pixels or of the seen ones alone.
    pub fn of(&self, region: Region, seen: bool) -> Option<Figures> {
        match (region, seen) {
            (Region::Full, false) => Some(self.full),
            (Region::Outside, false) => self.outside,
            (Region::Rim, false) => self.rim,
            (Region::Mask, false) => self.mask,
            (Region::Box, false) => self.bounding_box,
            (Region::Full, true) => self.full_seen,
            (Region::Outside, true) => self.outside_seen,
            (Region::Rim, true) => self.rim_seen,
            (Region::Mask, true) => self.mask_seen,
            (Region::Box, true) => self.box_seen,
        }
    }

    /// Sets what [`Metrics::of`] returns.
    fn set(&mut self, region: Region, seen: bool, figures: Option<Figures>) {
        *match (region, seen) {
            (Region::Full, false) => {
                self.full = figures.unwrap_or(self.full);
                return;
            }
            (Region::Outside, false) => &mut self.outside,
            (Region::Rim, false) => &mut self.rim,
            (Region::Mask, false) => &mut self.mask,
            (Region::Box, false) => &mut self.bounding_box,
            (Region::Full, true) => &mut self.full_seen,
            (Region::Outside, true) => &mut self.outside_seen,
            (Region::Rim, true) => &mut self.rim_seen,
            (Region::Mask, true) => &mut self.mask_seen,
            (Region::Box, true) => &mut self.box_seen,
        } = figures;
    }
}

/// Compares an 8-bit rendered view with its photograph. `mask` is non-zero inside the object's region.
///
/// # Errors
/// Images or mask of different sizes, or without pixels.
pub fn compare(rendered: &RgbImage, truth: &RgbImage, mask: Option<&GrayImage>) -> Result<Metrics, Error> {
    compare_seen(rendered, truth, mask, None)
}

/// [`compare`] with figures of the pixels alone where `seen` is not zero beside those of all ([`seen_map`]).
///
/// # Errors
/// As [`compare`].
pub fn compare_seen(
    rendered: &RgbImage,
    truth: &RgbImage,
    mask: Option<&GrayImage>,
    seen: Option<&GrayImage>,
) -> Result<Metrics, Error> {
    measure(rendered, truth, mask, seen, Protocol::Plain)
}

fn measure(
    rendered: &RgbImage,
    truth: &RgbImage,
    mask: Option<&GrayImage>,
    seen: Option<&GrayImage>,
    protocol: Protocol,
) -> Result<Metrics, Error> {
    let unit = |image: &RgbImage| image.as_raw().iter().map(|v| f64::from(*v) / 255.0).collect::<Vec<_>>();
    check_sizes(rendered, truth, mask, seen)?;
    let flip = flip_map(rendered, truth);
    Ok(metrics(rendered.dimensions(), [&unit(rendered), &unit(truth)], &flip, mask, seen, protocol))
}

fn check_sizes(
    rendered: &RgbImage,
    truth: &RgbImage,
    mask: Option<&GrayImage>,
    seen: Option<&GrayImage>,
) -> Result<(), Error> {
    let size = rendered.dimensions();
    let others = [
        ("photograph", Some(truth.dimensions())),
        ("mask", mask.map(GrayImage::dimensions)),
        ("map of seen pixels", seen.map(GrayImage::dimensions)),
    ];
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
    [rendered, truth]: [&[f64]; 2],
    flip: &[f32],
    mask: Option<&GrayImage>,
    seen: Option<&GrayImage>,
    protocol: Protocol,
) -> Metrics {
    let (width, height) = (width as usize, height as usize);
    let ssim = ssim_map(rendered, truth, width, height);
    let measure = |inside: &dyn Fn(usize) -> bool| {
        let (mut count, mut square, mut similarity, mut difference) = (0usize, 0.0, 0.0, 0.0);
        for pixel in (0..width * height).filter(|pixel| inside(*pixel)) {
            count += 1;
            let channels = 3 * pixel..3 * pixel + 3;
            square += channels.clone().map(|i| (rendered[i] - truth[i]).powi(2)).sum::<f64>() / 3.0;
            similarity += ssim[channels].iter().sum::<f64>() / 3.0;
            difference += f64::from(flip[pixel]);
        }
        let n = count as f64;
        (count > 0).then(|| Figures { psnr: psnr(square / n), ssim: similarity / n, flip: difference / n })
    };
    let mut metrics = Metrics::new(measure(&|_| true).expect("the image has pixels"));
    let bounding_box = mask.and_then(|mask| protocol.bounding_box(mask));
    let rim = mask.map(rim);
    let was_seen = |pixel: usize| seen.is_none_or(|seen| seen.as_raw()[pixel] != 0);
    for region in Region::ALL {
        let inside = |pixel: usize| match (region, mask) {
            (Region::Full, _) => true,
            (_, None) => false,
            (Region::Outside, Some(mask)) => mask.as_raw()[pixel] == 0,
            (Region::Mask, Some(mask)) => mask.as_raw()[pixel] != 0,
            (Region::Rim, _) => rim.as_ref().is_some_and(|rim| rim[pixel]),
            (Region::Box, _) => bounding_box.is_some_and(|[left, top, right, bottom]| {
                (left..=right).contains(&(pixel % width)) && (top..=bottom).contains(&(pixel / width))
            }),
        };
        if region != Region::Full {
            metrics.set(region, false, measure(&inside));
        }
        if seen.is_some() {
            metrics.set(region, true, measure(&|pixel| inside(pixel) && was_seen(pixel)));
        }
    }
    metrics.seen_share =
        seen.map(|seen| seen.as_raw().iter().filter(|value| **value != 0).count() as f64 / (width * height) as f64);
    metrics
}

/// Per pixel: whether the nearest pixel on the other side of the mask's edge is at most [`RIM`] pixels away.
fn rim(mask: &GrayImage) -> Vec<bool> {
    let mut other = mask.clone();
    other.iter_mut().for_each(|value| *value = u8::from(*value == 0));
    let (inner, outer) = (resample::dilate(mask, RIM), resample::dilate(&other, RIM));
    inner.as_raw().iter().zip(outer.as_raw()).map(|(a, b)| *a != 0 && *b != 0).collect()
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
pub(crate) mod decibel {
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

use image::{GrayImage, RgbImage};

use super::fid::{self, Frechet, Inception};
use super::lpips::{Lpips, Net, Perceptual};
use super::{Error, Metrics, Report, ViewMetrics, bounding_box, measure};

/// How figures are taken. Papers differ in what they call masked, so that figures of different protocols must not stand
/// side by side.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Protocol {
    /// Masks as they are, the tight box around them
    #[default]
    Plain,
    /// GScream: full-size pictures, squared errors over the mask's pixels alone, LPIPS maps averaged inside the mask
    Gscream,
    /// SPIn-NeRF: LPIPS and FID of pictures cut to the mask's box, enlarged by a tenth of its sides in every direction
    Spinnerf,
    /// MVIP-NeRF: pictures cut to the tight box
    Mvip,
}

/// Size at which SPIn-NeRF's scenes are published.
const PUBLISHED: [u32; 2] = [1008, 567];

impl Protocol {
    /// Share of the box's sides by which it grows in every direction.
    fn margin(self) -> f64 {
        match self {
            Self::Spinnerf => 0.1,
            Self::Plain | Self::Gscream | Self::Mvip => 0.0,
        }
    }

    /// One line: which it is, and what it means for masks, box, averages and sizes.
    pub fn describe(self) -> &'static str {
        match self {
            Self::Plain => {
                "plain: masks as they are; box tight around the mask; means over the region's pixels of maps taken on the \
                 full image; pictures at the size they have"
            }
            Self::Gscream => {
                "gscream: masks as they are; masked figures are means over the mask's pixels (PSNR: of their squared \
                 errors); LPIPS (VGG) of full pictures, masked: its map inside the mask; pictures of 1008 x 567, 40 test \
                 views a scene, means over ten scenes"
            }
            Self::Spinnerf => {
                "spinnerf: masks as they are; box around the mask enlarged by 10 % of its sides in every direction; LPIPS \
                 and FID of pictures cut to it; pictures of 1008 x 567, 40 test views a scene"
            }
            Self::Mvip => {
                "mvip: masks as they are; box tight around the mask; LPIPS and FID of pictures cut to it; 40 test views a \
                 scene"
            }
        }
    }

    /// What of it does not hold for pictures of this size.
    pub fn departs(self, size: [u32; 2]) -> Option<String> {
        let published = matches!(self, Self::Gscream | Self::Spinnerf);
        let [[w, h], [width, height]] = [size, PUBLISHED];
        (published && size != PUBLISHED).then(|| {
            format!("pictures of {w} x {h} are not the {width} x {height} of this protocol: its published figures are not comparable")
        })
    }

    /// Left, top, right and bottom pixel of the box, all inclusive.
    pub(super) fn bounding_box(self, mask: &GrayImage) -> Option<[usize; 4]> {
        let [left, top, right, bottom] = bounding_box(mask)?;
        let grow = |from: usize, to: usize| (self.margin() * (to + 1 - from) as f64).round() as usize;
        let (across, down) = (grow(left, right), grow(top, bottom));
        let (width, height) = (mask.width() as usize, mask.height() as usize);
        Some([
            left.saturating_sub(across),
            top.saturating_sub(down),
            (right + across).min(width - 1),
            (bottom + down).min(height - 1),
        ])
    }
}

/// What judges pictures: a protocol, and networks where their weights are known.
#[derive(Default)]
pub struct Judge {
    /// How figures are taken.
    pub protocol: Protocol,
    /// For LPIPS, at most one of each.
    pub lpips: Vec<Lpips>,
    /// For FID.
    pub inception: Option<Inception>,
}

impl Judge {
    /// Compares an 8-bit rendered view with its photograph. `mask` is not zero inside the object's region, `seen` where
    /// some train view photographed what the view shows.
    ///
    /// # Errors
    /// Images of different sizes, or without pixels.
    pub fn compare(
        &self,
        rendered: &RgbImage,
        truth: &RgbImage,
        mask: Option<&GrayImage>,
        seen: Option<&GrayImage>,
    ) -> Result<Metrics, Error> {
        let mut metrics = measure(rendered, truth, mask, seen, self.protocol)?;
        if !self.lpips.is_empty() {
            let mut found = Perceptual::default();
            let cut = mask.and_then(|mask| self.cut(mask));
            for lpips in &self.lpips {
                let (signed, unit) = match lpips.net() {
                    Net::Vgg => (&mut found.vgg, &mut found.vgg_unit),
                    Net::Alex => (&mut found.alex, &mut found.alex_unit),
                };
                *signed = lpips.compare(rendered, truth, mask, cut, false);
                *unit = lpips.compare(rendered, truth, mask, cut, true);
            }
            metrics.lpips = Some(found);
        }
        Ok(metrics)
    }

    /// Left, top, width and height of the protocol's box.
    fn cut(&self, mask: &GrayImage) -> Option<[u32; 4]> {
        let [left, top, right, bottom] = self.protocol.bounding_box(mask)?.map(|n| n as u32);
        Some([left, top, right + 1 - left, bottom + 1 - top])
    }

    /// Nothing judged yet.
    pub fn start(&self) -> Judging<'_> {
        Judging { judge: self, views: vec![], full: Default::default(), boxed: Default::default() }
    }
}

/// Features of the rendered pictures and of the photographs.
type Sets = [Vec<Vec<f32>>; 2];

/// An evaluation under way.
pub struct Judging<'a> {
    judge: &'a Judge,
    views: Vec<ViewMetrics>,
    full: Sets,
    boxed: Sets,
}

impl Judging<'_> {
    /// Judges a view; its figures may be added to.
    ///
    /// # Errors
    /// As [`Judge::compare`].
    pub fn add(
        &mut self,
        name: &str,
        rendered: &RgbImage,
        truth: &RgbImage,
        mask: Option<&GrayImage>,
        seen: Option<&GrayImage>,
    ) -> Result<&mut Metrics, Error> {
        let metrics = self.judge.compare(rendered, truth, mask, seen)?;
        Ok(self.take(name, metrics, [rendered, truth], mask))
    }

    /// Takes a view with its figures: those of [`Judge::compare`] of its rendered picture and photograph, which views may be
    /// given to beside one another.
    pub fn take(
        &mut self,
        name: &str,
        metrics: Metrics,
        pictures: [&RgbImage; 2],
        mask: Option<&GrayImage>,
    ) -> &mut Metrics {
        if let Some(inception) = &self.judge.inception {
            let cut = mask.and_then(|mask| self.judge.cut(mask));
            for (i, picture) in pictures.into_iter().enumerate() {
                self.full[i].push(inception.features(picture));
                if let Some([x, y, width, height]) = cut {
                    let part = image::imageops::crop_imm(picture, x, y, width, height).to_image();
                    self.boxed[i].push(inception.features(&part));
                }
            }
        }
        self.views.push(ViewMetrics { name: name.to_owned(), metrics });
        &mut self.views.last_mut().expect("one was just added").metrics
    }

    /// The figures of all views.
    pub fn report(self) -> Report {
        let mut report = Report::new(self.views);
        let distance = |[rendered, truth]: &Sets| fid::frechet(rendered, truth);
        if let (Some(mean), Some(full)) = (&mut report.mean, distance(&self.full)) {
            mean.fid = Some(Frechet { full, bounding_box: distance(&self.boxed) });
        }
        report.protocol = Some(self.judge.protocol.describe().to_owned());
        report
    }
}

/// A row of a published table.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Published {
    /// The method.
    pub method: &'static str,
    /// PSNR, masked PSNR in dB.
    pub psnr: [f64; 2],
    /// SSIM, masked SSIM.
    pub ssim: [f64; 2],
    /// LPIPS, masked LPIPS.
    pub lpips: [f64; 2],
    /// FID.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fid: Option<f64>,
    /// Time, with the device where it is named.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time: Option<&'static str>,
}

/// Means over SPIn-NeRF's ten scenes at full size, as the papers print them (GScream, ECCV 2024; SplatFill, 2025).
pub const PUBLISHED_ROWS: [Published; 6] = [
    Published {
        method: "SPIn-NeRF",
        psnr: [20.18, 15.80],
        ssim: [0.46, 0.21],
        lpips: [0.47, 0.58],
        fid: Some(58.78),
        time: Some("3.0 h"),
    },
    Published {
        method: "OR-NeRF",
        psnr: [20.32, 15.74],
        ssim: [0.54, 0.21],
        lpips: [0.35, 0.56],
        fid: Some(38.69),
        time: Some("6.0 h"),
    },
    Published {
        method: "GScream",
        psnr: [20.49, 15.84],
        ssim: [0.58, 0.21],
        lpips: [0.28, 0.54],
        fid: Some(36.72),
        time: Some("1.2 h (RTX 3090)"),
    },
    Published {
        method: "GScream without attention",
        psnr: [20.47, 15.63],
        ssim: [0.58, 0.20],
        lpips: [0.26, 0.50],
        fid: None,
        time: None,
    },
    Published {
        method: "GScream without attention and depth",
        psnr: [20.12, 14.87],
        ssim: [0.58, 0.19],
        lpips: [0.26, 0.56],
        fid: None,
        time: None,
    },
    Published {
        method: "SplatFill",
        psnr: [20.46, 15.67],
        ssim: [0.63, 0.21],
        lpips: [0.25, 0.54],
        fid: Some(29.76),
        time: Some("34 min (A100)"),
    },
];

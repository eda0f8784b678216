use std::fmt::Write as _;
use std::path::Path;

use crate::atomic;
use serde::{Deserialize, Serialize};

use super::fid::Frechet;
use super::lpips::{Distance, Perceptual};
use super::{Error, Figures, Geometry, Metrics, Region};

/// One view's metrics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewMetrics {
    /// The view's name.
    pub name: String,
    /// Its metrics by region.
    #[serde(flatten)]
    pub metrics: Metrics,
}

/// Arithmetic means over views. The mean PSNR is the mean of the views' PSNR values, as papers report it, not the PSNR of
/// the mean squared error; it is infinite if one view's is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Mean {
    /// By region; those of the mask over the views that have one.
    #[serde(flatten)]
    pub metrics: Metrics,
    /// Number of views.
    pub views: usize,
    /// Number of views whose mask is not empty.
    pub masked_views: usize,
    /// Over [`Report::residues`].
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub residue: Option<f64>,
    /// Of all views as a set, where the network's weights are known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub fid: Option<Frechet>,
}

/// How much of the object is left in a train view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Residue {
    /// The view's name.
    pub name: String,
    /// As [`super::hole::residue`] finds it: 0 nothing, 1 all of it.
    pub residue: f64,
}

/// What an evaluation found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// How [`Report::mean`] averages and what `"inf"` stands for, for who reads the JSON alone.
    pub note: String,
    /// How masks, boxes and averages are taken, where that was asked for.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub protocol: Option<String>,
    /// Over all views; absent without views.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mean: Option<Mean>,
    /// In the order given.
    pub views: Vec<ViewMetrics>,
    /// Of the train views whose photographs show the object, where what belongs behind it is known.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub residues: Vec<Residue>,
    /// The factor that brought the true depth maps to the scene's unit, where it is not 1.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub depth_factor: Option<f64>,
}

const NOTE: &str = "means are arithmetic over views (PSNR: mean of the views' dB); regions: full image, inside the mask, \
                    inside the mask's bounding box, outside the mask, within 3 pixels of its edge (rim), and each over \
                    the pixels alone that some train view photographed (_seen); a PSNR of \"inf\" is an identical region";

impl Report {
    /// The report of these views.
    pub fn new(views: Vec<ViewMetrics>) -> Self {
        let mean = (!views.is_empty()).then(|| Mean {
            metrics: mean_metrics(&views),
            views: views.len(),
            masked_views: views.iter().filter(|view| view.metrics.mask.is_some()).count(),
            residue: None,
            fid: None,
        });
        Self { note: NOTE.to_owned(), protocol: None, mean, views, residues: vec![], depth_factor: None }
    }

    /// The report with what was found of the object in train views.
    pub fn with_residues(mut self, residues: Vec<Residue>) -> Self {
        if let Some(mean) = &mut self.mean {
            mean.residue = mean_of(residues.iter().map(|found| found.residue));
        }
        self.residues = residues;
        self
    }

    /// An aligned table: a line per view, then the mean and how it is taken. Columns of the mask only if a view has one.
    pub fn table(&self) -> String {
        let masked = self.mean.is_some_and(|mean| mean.masked_views > 0);
        let title = "mean";
        let names = self.views.iter().map(|view| view.name.chars().count());
        let width = names.chain([title.len(), "view".len()]).max().unwrap_or(0);
        let mut table = format!("{:width$}", "");
        let groups: &[&str] = if masked { &["full image", "inside mask", "mask's box"] } else { &["full image"] };
        for group in groups {
            write!(table, "  {group:>23}").expect("a string takes everything");
        }
        write!(table, "\n{:width$}", "view").expect("a string takes everything");
        for _ in groups {
            write!(table, "  {:>7} {:>7} {:>7}", "PSNR", "SSIM", "FLIP").expect("a string takes everything");
        }
        let mut line = |name: &str, metrics: &Metrics| {
            write!(table, "\n{name:width$}").expect("a string takes everything");
            let all = [Some(metrics.full), metrics.mask, metrics.bounding_box];
            for figures in all.iter().take(groups.len()) {
                match figures {
                    Some(m) => write!(table, "  {:>7.2} {:>7.4} {:>7.4}", m.psnr, m.ssim, m.flip),
                    None => write!(table, "  {:>7} {:>7} {:>7}", "-", "-", "-"),
                }
                .expect("a string takes everything");
            }
        };
        for view in &self.views {
            line(&view.name, &view.metrics);
        }
        if let Some(mean) = &self.mean {
            line(title, &mean.metrics);
            let views = |n: usize| format!("{n} view{}", if n == 1 { "" } else { "s" });
            let (all, some) = (views(mean.views), views(mean.masked_views));
            write!(table, "\nmean over {all}").expect("a string takes everything");
            if masked && mean.masked_views < mean.views {
                write!(table, ", of the mask over the {some} that have one").expect("a string takes everything");
            }
            table.push_str("; mean PSNR is the mean of the views' PSNR");
        }
        table.push('\n');
        table + &self.regions()
    }

    /// The means by region, of all pixels and of the seen ones, and what is known of the hole. Empty where the table of
    /// the views says it all.
    fn regions(&self) -> String {
        let mut text = String::new();
        let Some(Mean { metrics, residue, fid, .. }) = &self.mean else { return text };
        let mut write = |line: std::fmt::Arguments<'_>| text.write_fmt(line).expect("a string takes everything");
        if metrics.outside.is_some() || metrics.full_seen.is_some() {
            let of_seen = metrics.seen_share.is_some();
            let seen =
                metrics.seen_share.map_or(String::new(), |share| format!("seen pixels ({:.1} %)", 100.0 * share));
            let [psnr, ssim, flip] = ["PSNR", "SSIM", "FLIP"];
            write(format_args!("\n{:12}  {:>23}", "", "all pixels"));
            if of_seen {
                write(format_args!("  {seen:>23}"));
            }
            write(format_args!("\n{:12}", "mean of"));
            for _ in 0..=usize::from(of_seen) {
                write(format_args!("  {psnr:>7} {ssim:>7} {flip:>7}"));
            }
            write(format_args!("\n"));
            for region in Region::ALL.into_iter().filter(|region| metrics.of(*region, false).is_some()) {
                write(format_args!("{:12}", region.name()));
                for seen in [false, true].into_iter().take(1 + usize::from(of_seen)) {
                    match metrics.of(region, seen) {
                        Some(m) => write(format_args!("  {:>7.2} {:>7.4} {:>7.4}", m.psnr, m.ssim, m.flip)),
                        None => write(format_args!("  {:>7} {:>7} {:>7}", "-", "-", "-")),
                    }
                }
                write(format_args!("\n"));
            }
            if of_seen {
                write(format_args!("seen: photographed by some train view, past its mask, by the trained depth\n"));
            }
        }
        if let Some(Figures { psnr, ssim, flip }) = metrics.fitted {
            let by = "with each test view's own exposure (gain and offset per channel) fitted";
            write(format_args!("{by}: PSNR {psnr:.2}, SSIM {ssim:.4}, FLIP {flip:.4}\n"));
        }
        let distances: Vec<(&str, Distance)> = metrics.lpips.iter().flat_map(named).collect();
        if !distances.is_empty() || fid.is_some() {
            write(format_args!(
                "\n{:18}  {:>12} {:>12} {:>12}\n",
                "mean of", "full image", "inside mask", "mask's box"
            ));
        }
        let number = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
        for (name, Distance { full, mask, bounding_box }) in distances {
            let (mask, boxed) = (number(mask, 4), number(bounding_box, 4));
            write(format_args!("{name:18}  {full:>12.4} {mask:>12} {boxed:>12}\n"));
        }
        if let Some(Frechet { full, bounding_box }) = fid {
            write(format_args!("{:18}  {full:>12.2} {:>12} {:>12}\n", "FID", "-", number(*bounding_box, 2)));
        }
        if let Some(Geometry { relative_error, completeness }) = metrics.geometry {
            let error = relative_error.map_or("-".to_owned(), |error| format!("{:.2} %", 100.0 * error));
            let complete = 100.0 * completeness;
            write(format_args!("depth inside the mask: off by {error} on average, {complete:.1} % of it within 5 %\n"));
        }
        if let Some(factor) = self.depth_factor {
            write(format_args!(
                "the true depth maps are in another unit: times {factor:.6} (median outside the masks)\n"
            ));
        }
        if let Some(residue) = residue {
            let most = self.residues.iter().max_by(|a, b| a.residue.total_cmp(&b.residue));
            let most = most.map_or(String::new(), |m| format!(", at most {:.3} ({})", m.residue, m.name));
            write(format_args!(
                "object left in the train views: {residue:.3} on average over {}{most}\n",
                self.residues.len()
            ));
        }
        text
    }

    /// Writes the report as JSON; the file appears complete or not at all.
    ///
    /// # Errors
    /// A path that cannot be written.
    pub fn write_json(&self, path: &Path) -> Result<(), Error> {
        atomic::write_json(path, self).map_err(|source| Error::Write { path: path.to_owned(), source })
    }
}

/// By region, over the views that have it.
fn mean_metrics(views: &[ViewMetrics]) -> Metrics {
    let figures = |region, seen| {
        let all: Vec<Figures> = views.iter().filter_map(|view| view.metrics.of(region, seen)).collect();
        mean(&all)
    };
    let mut metrics = Metrics::new(figures(Region::Full, false).expect("there are views"));
    for region in Region::ALL {
        for seen in [false, true] {
            metrics.set(region, seen, figures(region, seen));
        }
    }
    let geometry: Vec<Geometry> = views.iter().filter_map(|view| view.metrics.geometry).collect();
    metrics.lpips = mean_perceptual(&views.iter().filter_map(|view| view.metrics.lpips).collect::<Vec<_>>());
    metrics.seen_share = mean_of(views.iter().filter_map(|view| view.metrics.seen_share));
    metrics.fitted = mean(&views.iter().filter_map(|view| view.metrics.fitted).collect::<Vec<_>>());
    metrics.geometry = mean_of(geometry.iter().map(|g| g.completeness)).map(|completeness| Geometry {
        relative_error: mean_of(geometry.iter().filter_map(|g| g.relative_error)),
        completeness,
    });
    metrics
}

/// Name, distances.
fn named(lpips: &Perceptual) -> impl Iterator<Item = (&'static str, Distance)> {
    let all = [
        ("LPIPS VGG [-1, 1]", lpips.vgg),
        ("LPIPS VGG [0, 1]", lpips.vgg_unit),
        ("LPIPS Alex [-1, 1]", lpips.alex),
        ("LPIPS Alex [0, 1]", lpips.alex_unit),
    ];
    all.into_iter().filter_map(|(name, distance)| Some((name, distance?)))
}

fn mean_perceptual(all: &[Perceptual]) -> Option<Perceptual> {
    let mean = |of: &dyn Fn(&Perceptual) -> Option<Distance>| {
        let found: Vec<Distance> = all.iter().filter_map(of).collect();
        Some(Distance {
            full: mean_of(found.iter().map(|d| d.full))?,
            mask: mean_of(found.iter().filter_map(|d| d.mask)),
            bounding_box: mean_of(found.iter().filter_map(|d| d.bounding_box)),
        })
    };
    (!all.is_empty()).then(|| Perceptual {
        vgg: mean(&|p| p.vgg),
        vgg_unit: mean(&|p| p.vgg_unit),
        alex: mean(&|p| p.alex),
        alex_unit: mean(&|p| p.alex_unit),
    })
}

fn mean_of(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

fn mean(figures: &[Figures]) -> Option<Figures> {
    let n = figures.len() as f64;
    let mean = |value: fn(&Figures) -> f64| figures.iter().map(value).sum::<f64>() / n;
    (!figures.is_empty()).then(|| Figures { psnr: mean(|m| m.psnr), ssim: mean(|m| m.ssim), flip: mean(|m| m.flip) })
}

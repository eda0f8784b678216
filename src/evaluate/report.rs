use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use atomic_write_file::AtomicWriteFile;
use serde::{Deserialize, Serialize};

use super::{Error, Figures, Metrics};

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
}

/// What an evaluation found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// How [`Report::mean`] averages and what `"inf"` stands for, for who reads the JSON alone.
    pub note: String,
    /// Over all views; absent without views.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mean: Option<Mean>,
    /// In the order given.
    pub views: Vec<ViewMetrics>,
}

const NOTE: &str = "means are arithmetic over views (PSNR: mean of the views' dB); regions: full image, inside the mask, \
                    inside the mask's bounding box; a PSNR of \"inf\" is an identical region";

impl Report {
    /// The report of these views.
    pub fn new(views: Vec<ViewMetrics>) -> Self {
        let full: Vec<Figures> = views.iter().map(|view| view.metrics.full).collect();
        let masks: Vec<Figures> = views.iter().filter_map(|view| view.metrics.mask).collect();
        let boxes: Vec<Figures> = views.iter().filter_map(|view| view.metrics.bounding_box).collect();
        let mean = mean(&full).map(|full| Mean {
            metrics: Metrics { full, mask: mean(&masks), bounding_box: mean(&boxes) },
            views: views.len(),
            masked_views: masks.len(),
        });
        Self { note: NOTE.to_owned(), mean, views }
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
        table
    }

    /// Writes the report as JSON; the file appears complete or not at all.
    ///
    /// # Errors
    /// A path that cannot be written.
    pub fn write_json(&self, path: &Path) -> Result<(), Error> {
        let write = || {
            let mut file = AtomicWriteFile::open(path)?;
            let mut text = serde_json::to_string_pretty(self)?;
            text.push('\n');
            file.write_all(text.as_bytes())?;
            file.commit()
        };
        write().map_err(|source| Error::Write { path: path.to_owned(), source })
    }
}

fn mean(figures: &[Figures]) -> Option<Figures> {
    let n = figures.len() as f64;
    let mean = |value: fn(&Figures) -> f64| figures.iter().map(value).sum::<f64>() / n;
    (!figures.is_empty()).then(|| Figures { psnr: mean(|m| m.psnr), ssim: mean(|m| m.ssim), flip: mean(|m| m.flip) })
}

//! Variants of the method against each other: the figures of their runs, means and paired differences over seeds, tables.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::evaluate::{Judge, Mean, Metrics, PUBLISHED_ROWS, Published, Region, decibel};
use crate::lab::statistics::{Moments, Paired};
use crate::train::run::Summary;

/// A run.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Row {
    pub(crate) variant: String,
    pub(crate) scene: String,
    pub(crate) seed: u64,
    pub(crate) seconds: f64,
    pub(crate) steps_per_second: f64,
    pub(crate) anchors: u32,
    pub(crate) metrics: Metrics,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) residue: Option<f64>,
    /// Every figure by its name.
    pub(crate) figures: BTreeMap<String, Figure>,
    /// What the figures follow.
    pub(crate) protocol: String,
}

/// A number, of which PSNR may be infinite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub(crate) struct Figure(#[serde(with = "decibel")] pub(crate) f64);

/// A column: the figure's name in JSON, its title, digits.
type Column = (&'static str, &'static str, usize);

const COLUMNS: [Column; 23] = [
    ("psnr", "PSNR", 2),
    ("masked_psnr", "masked PSNR", 2),
    ("ssim", "SSIM", 4),
    ("masked_ssim", "masked SSIM", 4),
    ("fitted_psnr", "PSNR, exposure fitted", 2),
    ("flip", "FLIP", 4),
    ("masked_flip", "masked FLIP", 4),
    ("outside_seen_psnr", "outside, seen: PSNR", 2),
    ("outside_seen_ssim", "SSIM", 4),
    ("rim_psnr", "rim PSNR", 2),
    ("depth_error", "depth error in the mask %", 2),
    ("completeness", "complete %", 1),
    ("residue", "object left", 3),
    ("lpips_vgg", "LPIPS VGG", 4),
    ("masked_lpips_vgg", "masked", 4),
    ("lpips_vgg_unit", "LPIPS VGG [0, 1]", 4),
    ("masked_lpips_vgg_unit", "masked", 4),
    ("lpips_alex", "LPIPS Alex", 4),
    ("masked_lpips_alex", "masked", 4),
    ("fid", "FID", 2),
    ("anchors", "anchors", 0),
    ("steps_per_second", "steps/s", 2),
    ("seconds", "seconds", 0),
];

/// Figures of which differences are printed; comparison.json has all.
const COMPARED: [&str; 4] = ["psnr", "masked_psnr", "masked_ssim", "outside_seen_psnr"];

impl Row {
    /// The run of `variant` on `scene` under `seed`; `mean` is over its test views.
    pub(crate) fn new([variant, scene]: [&str; 2], seed: u64, summary: &Summary, mean: &Mean, judge: &Judge) -> Self {
        let steps_per_second = f64::from(summary.steps) / summary.seconds;
        let mut figures = figures(mean);
        figures.extend([
            ("anchors", f64::from(summary.anchors)),
            ("steps_per_second", steps_per_second),
            ("seconds", summary.seconds),
        ]);
        Self {
            variant: variant.to_owned(),
            scene: scene.to_owned(),
            seed,
            seconds: summary.seconds,
            steps_per_second,
            anchors: summary.anchors,
            metrics: mean.metrics,
            residue: mean.residue,
            figures: figures.into_iter().map(|(name, value)| (name.to_owned(), Figure(value))).collect(),
            protocol: judge.protocol.describe().to_owned(),
        }
    }
}

/// What was measured, by name.
fn figures(mean: &Mean) -> BTreeMap<&'static str, f64> {
    let metrics = &mean.metrics;
    let region = |region, seen| metrics.of(region, seen);
    let (mask, seen) = (region(Region::Mask, false), region(Region::Outside, true));
    let lpips = metrics.lpips.unwrap_or_default();
    let all = [
        ("psnr", Some(metrics.full.psnr)),
        ("masked_psnr", mask.map(|m| m.psnr)),
        ("ssim", Some(metrics.full.ssim)),
        ("masked_ssim", mask.map(|m| m.ssim)),
        ("fitted_psnr", metrics.fitted.map(|m| m.psnr)),
        ("flip", Some(metrics.full.flip)),
        ("masked_flip", mask.map(|m| m.flip)),
        ("outside_seen_psnr", seen.map(|m| m.psnr)),
        ("outside_seen_ssim", seen.map(|m| m.ssim)),
        ("rim_psnr", region(Region::Rim, false).map(|m| m.psnr)),
        ("depth_error", metrics.geometry.and_then(|g| g.relative_error).map(|error| 100.0 * error)),
        ("completeness", metrics.geometry.map(|g| 100.0 * g.completeness)),
        ("residue", mean.residue),
        ("lpips_vgg", lpips.vgg.map(|d| d.full)),
        ("masked_lpips_vgg", lpips.vgg.and_then(|d| d.mask)),
        ("lpips_vgg_unit", lpips.vgg_unit.map(|d| d.full)),
        ("masked_lpips_vgg_unit", lpips.vgg_unit.and_then(|d| d.mask)),
        ("lpips_alex", lpips.alex.map(|d| d.full)),
        ("masked_lpips_alex", lpips.alex.and_then(|d| d.mask)),
        ("fid", mean.fid.map(|f| f.full)),
    ];
    all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
}

/// A variant over the seeds.
#[derive(Serialize)]
pub(crate) struct Means {
    pub(crate) variant: String,
    /// By figure: of the seeds' means over the scenes.
    pub(crate) figures: BTreeMap<&'static str, Moments>,
}

/// The second variant less the first, over the same seeds.
#[derive(Serialize)]
pub(crate) struct Difference {
    pub(crate) from: String,
    pub(crate) to: String,
    pub(crate) figures: BTreeMap<&'static str, Paired>,
}

#[derive(Serialize)]
pub(crate) struct Comparison {
    pub(crate) scenes: Vec<String>,
    pub(crate) seeds: Vec<u64>,
    pub(crate) protocol: &'static str,
    pub(crate) variants: Vec<Means>,
    pub(crate) differences: Vec<Difference>,
    /// Ten scenes at full size, as printed by their papers.
    pub(crate) published: &'static [Published],
}

/// Means over the scenes by seed, in the order of seeds; `None` where a run lacks the figure.
fn by_seed(rows: &[Row], variant: &str, figure: &str, seeds: &[u64]) -> Option<Vec<f64>> {
    let mean = |seed: &u64| {
        let runs = rows.iter().filter(|row| row.variant == variant && row.seed == *seed);
        let values: Vec<f64> = runs.map(|row| Some(row.figures.get(figure)?.0)).collect::<Option<_>>()?;
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    seeds.iter().map(mean).collect()
}

pub(crate) fn compare(
    variants: &[String],
    rows: &[Row],
    scenes: Vec<String>,
    seeds: Vec<u64>,
    judge: &Judge,
) -> Comparison {
    let figure = |variant: &str, name| by_seed(rows, variant, name, &seeds);
    let summary = |variant: &str| Means {
        variant: variant.to_owned(),
        figures: COLUMNS.iter().filter_map(|(name, ..)| Some((*name, Moments::of(&figure(variant, name)?)?))).collect(),
    };
    let difference = |from: &str, to: &str| Difference {
        from: from.to_owned(),
        to: to.to_owned(),
        figures: COLUMNS
            .iter()
            .filter_map(|(name, ..)| Some((*name, Paired::of(&figure(from, name)?, &figure(to, name)?)?)))
            .collect(),
    };
    let pairs = (0..variants.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let differences = pairs.map(|(i, j)| difference(&variants[i], &variants[j]));
    Comparison {
        variants: variants.iter().map(|variant| summary(variant)).collect(),
        differences: differences.filter(|d| !d.figures.is_empty()).collect(),
        scenes,
        protocol: judge.protocol.describe(),
        seeds,
        published: &PUBLISHED_ROWS,
    }
}

/// A Markdown table of cells, the first row its head.
pub(crate) fn markdown(rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut text = String::new();
    for (i, row) in rows.into_iter().enumerate() {
        writeln!(text, "| {} |", row.join(" | ")).expect("a string takes everything");
        if i == 0 {
            writeln!(text, "|{}", " --- |".repeat(row.len())).expect("a string takes everything");
        }
    }
    text
}

pub(crate) fn table(variants: &[Means]) -> String {
    let present = |(name, ..): &&Column| variants.iter().any(|v| v.figures.contains_key(name));
    let columns: Vec<&Column> = COLUMNS.iter().filter(present).collect();
    let head = std::iter::once("variant".to_owned()).chain(columns.iter().map(|(_, title, _)| (*title).to_owned()));
    let row = |v: &Means| {
        let cell = |(name, _, digits): &&Column| v.figures.get(name).map_or("-".to_owned(), |m| m.text(*digits));
        std::iter::once(v.variant.clone()).chain(columns.iter().map(cell)).collect()
    };
    let seeds = variants.first().and_then(|v| v.figures.get("psnr")).map_or(0, |m| m.seeds);
    let note = if seeds > 1 { format!("mean ± standard deviation of a seed, {seeds} seeds\n") } else { String::new() };
    markdown(std::iter::once(head.collect()).chain(variants.iter().map(row))) + &note
}

/// Empty where there is one seed.
pub(crate) fn differences(all: &[Difference]) -> String {
    if all.is_empty() {
        return String::new();
    }
    let title = |name: &str| COLUMNS.iter().find(|(key, ..)| *key == name).map_or("", |(_, title, _)| title);
    let compared: Vec<&str> =
        COMPARED.into_iter().filter(|name| all.iter().any(|d| d.figures.contains_key(name))).collect();
    let head = std::iter::once("difference".to_owned()).chain(compared.iter().map(|name| title(name).to_owned()));
    let row = |d: &Difference| {
        let cell = |name: &&str| {
            d.figures.get(name).map_or("-".to_owned(), |paired| {
                let Paired { difference, standard_error, p, .. } = paired;
                let digits = if name.ends_with("psnr") { 2 } else { 4 };
                format!("{difference:+.digits$} ± {standard_error:.digits$} (p {p:.3})")
            })
        };
        std::iter::once(format!("{} - {}", d.to, d.from)).chain(compared.iter().map(cell)).collect()
    };
    let table = markdown(std::iter::once(head.collect()).chain(all.iter().map(row)));
    format!("\n{table}mean difference over the same seeds ± its standard error, p of a paired t-test\n")
}

/// The published rows.
pub(crate) fn published() -> String {
    let head = ["published", "PSNR", "masked PSNR", "SSIM", "masked SSIM", "LPIPS", "masked LPIPS", "FID", "time"];
    let row = |p: &Published| {
        let numbers = [p.psnr[0], p.psnr[1], p.ssim[0], p.ssim[1], p.lpips[0], p.lpips[1]].map(|v| format!("{v:.2}"));
        let fid = p.fid.map_or("-".to_owned(), |fid| format!("{fid:.2}"));
        let rest = [fid, p.time.unwrap_or("-").to_owned()];
        std::iter::once(p.method.to_owned()).chain(numbers).chain(rest).collect()
    };
    let rows = std::iter::once(head.map(str::to_owned).to_vec()).chain(PUBLISHED_ROWS.iter().map(row));
    format!(
        "\n{}published figures: means over SPIn-NeRF's ten scenes at full size, as the papers print them\n",
        markdown(rows)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::Figures;

    /// Two variants, two scenes, three seeds: figures are means over scenes by seed.
    #[test]
    fn figures_are_means_over_scenes_and_then_over_seeds() {
        let row = |variant: &str, scene: &str, seed: u64, psnr: f64| Row {
            variant: variant.into(),
            scene: scene.into(),
            seed,
            seconds: 1.0,
            steps_per_second: 1.0,
            anchors: 1,
            metrics: Metrics::new(Figures { psnr, ssim: 0.5, flip: 0.5 }),
            residue: None,
            figures: [("psnr".to_owned(), Figure(psnr))].into(),
            protocol: String::new(),
        };
        let mut rows = vec![];
        for (seed, gain) in [(0, 1.0), (1, 2.0), (2, 3.0)] {
            for (scene, base) in [("a", 20.0), ("b", 30.0)] {
                rows.push(row("neither", scene, seed, base));
                rows.push(row("depth", scene, seed, base + gain));
            }
        }
        let variants = ["neither".to_owned(), "depth".to_owned()];
        let found = compare(&variants, &rows, vec!["a".into(), "b".into()], vec![0, 1, 2], &Judge::default());
        let moments = &found.variants[1].figures["psnr"];
        assert_eq!((moments.mean, moments.deviation, moments.seeds), (27.0, Some(1.0), 3));
        let difference = &found.differences[0];
        assert_eq!((difference.from.as_str(), difference.to.as_str()), ("neither", "depth"));
        assert_eq!(difference.figures["psnr"], Paired::of(&[0.0; 3], &[1.0, 2.0, 3.0]).expect("three"));
        insta::assert_snapshot!(table(&found.variants) + &differences(&found.differences) + &published());
        // One seed: neither deviations nor differences.
        let one: Vec<Row> = rows.into_iter().filter(|row| row.seed == 0).collect();
        let found = compare(&variants, &one, vec!["a".into(), "b".into()], vec![0], &Judge::default());
        assert!(found.differences.is_empty() && differences(&found.differences).is_empty());
        assert_eq!(
            table(&found.variants),
            "| variant | PSNR |\n| --- | --- |\n| neither | 25.00 |\n| depth | 26.00 |\n"
        );
    }
}

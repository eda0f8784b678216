//! The same numbers as JSON and as CSV.

use std::path::Path;

use crate::atomic;

use super::kernels::Kernels;
use super::training::Training;
use super::{Error, Report};

/// Writes a file that appears complete or not at all.
///
/// # Errors
/// A path that cannot be written.
pub fn write(path: &Path, contents: &[u8]) -> Result<(), Error> {
    atomic::write(path, contents).map_err(|source| Error::Write { path: path.to_owned(), source })
}

/// Everything as JSON. A number that is not finite is null.
pub fn json(report: &Report) -> String {
    serde_json::to_string_pretty(report).expect("plain numbers and strings") + "\n"
}

pub(crate) fn rows<const N: usize>(header: [&str; N], rows: impl IntoIterator<Item = [String; N]>) -> Vec<u8> {
    let mut writer = csv::Writer::from_writer(vec![]);
    writer.write_record(header).expect("memory takes everything");
    for row in rows {
        writer.write_record(row).expect("memory takes everything");
    }
    writer.into_inner().expect("memory takes everything")
}

/// What is not finite stays empty.
pub(crate) fn number(value: f64) -> String {
    if value.is_finite() { format!("{value:e}") } else { String::new() }
}

pub(crate) fn optional(value: Option<f64>) -> String {
    value.map_or(String::new(), number)
}

/// A row per choice and stage; `picture` and `step` are the wholes.
pub fn kernels(kernels: &Kernels) -> Vec<u8> {
    let header = [
        "variant",
        "changes",
        "stage",
        "ms_median",
        "ms_lower_quartile",
        "ms_upper_quartile",
        "ms_min",
        "ms_max",
        "error_relative",
        "error_largest",
        "error_tensor",
        "own_error_relative",
        "dominated_by",
    ];
    let mut lines = vec![];
    for v in &kernels.variants {
        let mut line = |stage: &str,
                        ms: &crate::lab::statistics::Spread,
                        error: Option<&super::kernels::Distance>,
                        own,
                        by: &Option<String>| {
            lines.push([
                v.name.clone(),
                v.changes.join(" "),
                stage.to_owned(),
                number(ms.median),
                number(ms.lower),
                number(ms.upper),
                number(ms.min),
                number(ms.max),
                optional(error.map(|e| e.relative)),
                optional(error.map(|e| e.largest)),
                error.map_or(String::new(), |e| e.tensor.to_owned()),
                optional(own),
                by.clone().unwrap_or_default(),
            ]);
        };
        line("picture", &v.picture_milliseconds, Some(&v.picture_error), None, &None);
        line("step", &v.step_milliseconds, Some(&v.gradient_error), None, &v.dominated_by);
        for s in &v.stages {
            let own = s.kernel_error.as_ref().map(|own| own.relative);
            line(s.stage.name(), &s.milliseconds, s.error.as_ref(), own, &s.dominated_by);
        }
    }
    rows(header, lines)
}

/// A row per choice and compared tensor.
pub fn tensors(kernels: &Kernels) -> Vec<u8> {
    let all = kernels.variants.iter().flat_map(|v| v.tensors.iter().map(|t| (v.name.clone(), t)));
    rows(
        ["variant", "stage", "tensor", "error_relative", "error_largest"],
        all.map(|(name, t)| {
            [name, t.stage.name().to_owned(), t.tensor.to_owned(), optional(t.relative), optional(t.largest)]
        }),
    )
}

/// A row per choice, seed and sample.
pub fn training(training: &Training) -> Vec<u8> {
    let mut lines = vec![];
    for v in &training.variants {
        for run in &v.runs {
            for s in &run.samples {
                lines.push([
                    v.name.clone(),
                    v.changes.join(" "),
                    run.seed.to_string(),
                    s.step.to_string(),
                    number(s.seconds),
                    number(s.psnr),
                    optional(s.masked_psnr),
                    number(s.loss),
                    number(s.ssim),
                    s.anchors.to_string(),
                ]);
            }
        }
    }
    let header = ["variant", "changes", "seed", "step", "seconds", "psnr", "masked_psnr", "loss", "ssim", "anchors"];
    rows(header, lines)
}

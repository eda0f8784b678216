//! What is drawn: the measurements as figures.

use super::kernels::{Distance, Kernels, StageFigures, VariantFigures};
use super::stages::Stage;
use super::training::{Point, Sample, Training};
use crate::lab::pareto::{self, SAME_ERROR};
use crate::lab::plots::{Axis, Figure, Mark, Panel, Scale, Series};
use crate::lab::statistics::Spread;

const BARS: &str = "Thick bars: quartiles over the rounds, thin ones: extremes. Hollow: superfluous. \
                    Down and to the left is better.";

fn axis(label: &str, scale: Scale) -> Axis {
    Axis { label: label.to_owned(), scale }
}

fn mark(time: &Spread, error: f64, hollow: bool) -> Mark {
    Mark {
        at: (time.median, error),
        quartiles: Some([time.lower, time.upper]),
        x_range: Some([time.min, time.max]),
        y_range: None,
        hollow,
        front: false,
    }
}

fn legend(kernels: &Kernels) -> Vec<String> {
    kernels.variants.iter().map(|v| v.name.clone()).collect()
}

/// Time and error of the picture, and of all gradients.
pub fn whole(kernels: &Kernels) -> Figure {
    let panel = |title: &str, time: fn(&VariantFigures) -> &Spread, error: fn(&VariantFigures) -> &Distance| Panel {
        title: title.to_owned(),
        note: String::new(),
        x: axis("milliseconds of GPU time", Scale::Log),
        y: axis("error relative to the float64 reference", Scale::Log),
        series: (kernels.variants.iter().enumerate())
            .map(|(style, v)| Series { style, marks: vec![mark(time(v), error(v).relative, v.dominated_by.is_some())] })
            .collect(),
        joined: false,
    };
    Figure {
        description: "Work-precision diagrams of one training step: error of the picture against the time until it is \
                      drawn, and error of the gradients against the time of the step"
            .to_owned(),
        legend: legend(kernels),
        footnote: BARS.to_owned(),
        panels: vec![
            panel("Picture", |v| &v.picture_milliseconds, |v| &v.picture_error),
            panel("Step: the worst of the model's gradients", |v| &v.step_milliseconds, |v| &v.gradient_error),
        ],
        columns: 2,
        panel: [480.0, 350.0],
    }
}

/// True where a choice changes something in a stage: its error, or its time as most rounds agree.
pub fn differs(stage: &StageFigures, base: &StageFigures) -> bool {
    let error = |s: &StageFigures| s.error.as_ref().map_or(0.0, |e| e.relative);
    let (a, b) = (error(stage), error(base));
    let time = stage.time_ratio.is_none_or(|ratio| pareto::is_longer(&ratio) || pareto::is_shorter(&ratio));
    a > b * SAME_ERROR || b > a * SAME_ERROR || time
}

/// A diagram per stage, with the choices that change something in it.
pub fn by_stage(kernels: &Kernels) -> Figure {
    let of = |v: &'_ VariantFigures, stage: Stage| v.stages.iter().position(|s| s.stage == stage);
    let panel = |stage: Stage| {
        let figures: Vec<(usize, &StageFigures)> = (kernels.variants.iter().enumerate())
            .filter_map(|(style, v)| Some((style, &v.stages[of(v, stage)?])))
            .filter(|(_, s)| s.error.as_ref().is_some_and(|e| e.relative.is_finite()))
            .collect();
        let base = figures.first()?.1;
        let shown: Vec<_> = figures.iter().filter(|(style, s)| *style == 0 || differs(s, base)).collect();
        let (alike, without) = (figures.len() - shown.len(), kernels.variants.len() - figures.len());
        let mut notes = vec![];
        if stage == Stage::Bin {
            notes.push("error of the picture".to_owned());
        }
        if alike > 0 {
            notes.push(format!("{alike} as the first"));
        }
        if without > 0 {
            notes.push(format!("{without} without"));
        }
        Some(Panel {
            title: stage.name().to_owned(),
            note: notes.join(", "),
            x: axis("milliseconds", Scale::Log),
            y: axis("relative error", Scale::Log),
            series: (shown.iter())
                .map(|(style, s)| {
                    let error = s.error.as_ref().map_or(0.0, |e| e.relative);
                    Series { style: *style, marks: vec![mark(&s.milliseconds, error, s.dominated_by.is_some())] }
                })
                .collect(),
            joined: false,
        })
    };
    Figure {
        description: "Work-precision diagrams by stage: relative error of what the stage leaves behind against the \
                      milliseconds in its passes"
            .to_owned(),
        legend: legend(kernels),
        footnote: BARS.to_owned(),
        panels: Stage::ALL.into_iter().filter_map(panel).collect(),
        columns: 3,
        panel: [320.0, 230.0],
    }
}

/// Figures on held-out views against seconds and against steps.
pub fn training(training: &Training) -> Figure {
    type Value = fn(&Sample) -> Option<f64>;
    type Of = fn(&Point) -> (Option<[f64; 2]>, bool);
    let rows: [(&str, &str, Scale, Value, Of); 3] = [
        ("PSNR", "PSNR, dB", Scale::Linear, |s| Some(s.psnr), |p| (Some(p.psnr_range), p.psnr_front)),
        (
            "PSNR inside the mask",
            "masked PSNR, dB",
            Scale::Linear,
            |s| s.masked_psnr,
            |p| (p.masked_psnr_range, p.masked_psnr_front),
        ),
        ("Colour loss", "loss", Scale::Log, |s| Some(s.loss), |p| (Some(p.loss_range), p.loss_front)),
    ];
    let mut panels = vec![];
    for (title, label, scale, value, of) in rows {
        for seconds in [true, false] {
            let point = |p: &Point, hollow: bool| {
                let (range, front) = of(p);
                let x = if seconds { p.mean.seconds } else { f64::from(p.mean.step) };
                let at = (x, value(&p.mean)?);
                // The front is one of cost and gain: seconds.
                let front = front && seconds;
                Some(Mark { at, quartiles: None, x_range: None, y_range: range, hollow, front })
            };
            let series: Vec<Series> = (training.variants.iter().enumerate())
                .map(|(style, v)| {
                    let hollow = v.dominated_by.is_some();
                    Series { style, marks: v.points.iter().filter_map(|p| point(p, hollow)).collect() }
                })
                .filter(|series| !series.marks.is_empty())
                .collect();
            if series.is_empty() {
                continue;
            }
            panels.push(Panel {
                title: format!("{title} against {}", if seconds { "seconds" } else { "steps" }),
                note: String::new(),
                x: axis(if seconds { "seconds of training" } else { "steps" }, Scale::Log),
                y: axis(label, scale),
                series,
                joined: true,
            });
        }
    }
    let several = training.variants.iter().any(|v| v.runs.len() > 1);
    let bars = if several { " Hollow: superfluous at its end. Bars: extremes over the seeds." } else { "" };
    Figure {
        description: "Figures on held-out views during training, against seconds and against steps".to_owned(),
        legend: training.variants.iter().map(|v| v.name.clone()).collect(),
        footnote: format!("Grey band: Pareto front over all choices.{bars}"),
        panels,
        columns: 2,
        panel: [480.0, 270.0],
    }
}

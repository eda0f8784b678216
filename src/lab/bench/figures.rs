//! What is drawn: passes against their floors, and times against what was varied.

use super::loads::{Loads, Sweep};
use super::step::StepFigures;
use crate::lab::plots::{Axis, Figure, Mark, Panel, Scale, Series};
use crate::lab::statistics::Spread;

/// Passes in a legend at most.
const SHOWN: usize = 9;

fn axis(label: &str) -> Axis {
    Axis { label: label.to_owned(), scale: Scale::Log }
}

fn mark(x: f64, time: &Spread, hollow: bool) -> Mark {
    let y_range = Some([time.lower, time.upper]);
    Mark { at: (x, time.median), quartiles: None, x_range: None, y_range, hollow, front: false }
}

/// The time of each of the costliest passes against its floor.
pub fn passes(figures: &StepFigures) -> Figure {
    let shown: Vec<_> = figures.passes.iter().filter(|p| p.floor.is_some()).take(SHOWN).collect();
    let series = shown.iter().enumerate().map(|(style, p)| {
        let floor = p.floor.expect("those without were left out");
        // The floor itself, hollow, so that the distance upwards is the ratio.
        let at_floor = Spread::of(&[floor]);
        Series { style, marks: vec![mark(floor, &p.milliseconds, false), mark(floor, &at_floor, true)] }
    });
    Figure {
        description: "Time of the costliest passes of a step against the time at the device's ceilings".to_owned(),
        legend: shown.iter().map(|p| p.pass.clone()).collect(),
        footnote: "Hollow: the floor. The distance upwards is the ratio. Bars: quartiles over the rounds.".to_owned(),
        panels: vec![Panel {
            title: "Passes and their floors".to_owned(),
            note: String::new(),
            x: axis("milliseconds at the ceilings"),
            y: axis("milliseconds"),
            series: series.collect(),
            joined: true,
        }],
        columns: 1,
        panel: [760.0, 460.0],
    }
}

/// The time of the step and of the costliest passes against anchors, pairs and pixels.
pub fn loads(loads: &Loads) -> Figure {
    // The costliest by their largest share of any load.
    let mut names: Vec<(String, f64)> = vec![];
    for run in &loads.runs {
        for pass in &run.step.passes {
            let share = pass.milliseconds.median / run.step.total.median;
            match names.iter_mut().find(|(name, _)| *name == pass.pass) {
                Some((_, most)) => *most = most.max(share),
                None => names.push((pass.pass.clone(), share)),
            }
        }
    }
    names.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let legend: Vec<String> =
        std::iter::once("total".to_owned()).chain(names.into_iter().take(SHOWN - 1).map(|(name, _)| name)).collect();
    let panel = |sweep: Sweep| {
        let runs: Vec<_> = loads.runs.iter().filter(|run| run.sweep == sweep).collect();
        let series = legend.iter().enumerate().map(|(style, name)| {
            let time = |run: &&super::loads::LoadFigures| {
                let time = match name.as_str() {
                    "total" => run.step.total,
                    _ => run.step.passes.iter().find(|p| p.pass == *name)?.milliseconds,
                };
                Some(mark(sweep.quantity(&run.step), &time, false))
            };
            Series { style, marks: runs.iter().filter_map(time).collect() }
        });
        let series: Vec<Series> = series.filter(|series| !series.marks.is_empty()).collect();
        let whole = loads.exponents.iter().find(|e| e.sweep == sweep && e.pass == "total");
        (!series.is_empty()).then(|| Panel {
            title: format!("Time against {}", sweep.name()),
            note: whole.map_or(String::new(), |e| format!("total: exponent {:.2}", e.exponent)),
            x: axis(sweep.name()),
            y: axis("milliseconds"),
            series,
            joined: true,
        })
    };
    Figure {
        description: "Time of a step and of its costliest passes against anchors, pairs and pixels".to_owned(),
        footnote: "Bars: quartiles over the rounds.".to_owned(),
        panels: Sweep::ALL.into_iter().filter_map(panel).collect(),
        legend,
        columns: 3,
        panel: [400.0, 340.0],
    }
}

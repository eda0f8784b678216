//! Figures of the passes against their floors.

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

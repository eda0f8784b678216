//! The same numbers as CSV.

use super::step::StepFigures;
use crate::lab::report::tables::{number, optional, rows};

/// A row per pass; `between` and `total` are the wholes.
pub fn passes(figures: &StepFigures) -> Vec<u8> {
    let header = [
        "pass",
        "dispatches",
        "ms_median",
        "ms_lower_quartile",
        "ms_upper_quartile",
        "ms_min",
        "ms_max",
        "bytes",
        "operations",
        "exponentials",
        "floor_ms",
        "bound",
        "ratio",
    ];
    let mut lines = vec![];
    for p in &figures.passes {
        let ms = &p.milliseconds;
        lines.push([
            p.pass.clone(),
            number(p.dispatches),
            number(ms.median),
            number(ms.lower),
            number(ms.upper),
            number(ms.min),
            number(ms.max),
            optional(p.work.map(|w| w.bytes)),
            optional(p.work.map(|w| w.operations)),
            optional(p.work.map(|w| w.exponentials)),
            optional(p.floor),
            p.bound.map_or(String::new(), |bound| bound.name().to_owned()),
            optional(p.ratio),
        ]);
    }
    let dispatches = figures.passes.iter().map(|p| p.dispatches).sum();
    for (name, n, ms, floor) in [
        ("between", figures.barriers, &figures.between, figures.between_floor),
        ("total", dispatches, &figures.total, figures.total_floor),
    ] {
        let mut line: [String; 13] = Default::default();
        let values = [n, ms.median, ms.lower, ms.upper, ms.min, ms.max];
        line[0] = name.to_owned();
        for (cell, value) in line[1..7].iter_mut().zip(values) {
            *cell = number(value);
        }
        line[10] = number(floor);
        line[12] = if floor > 0.0 { number(ms.median / floor) } else { String::new() };
        lines.push(line);
    }
    rows(header, lines)
}

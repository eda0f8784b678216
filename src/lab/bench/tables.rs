//! The same numbers as CSV.

use super::loads::Loads;
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

/// A row per load and pass; `total` is the whole step.
pub fn loads(loads: &Loads) -> Vec<u8> {
    let header = [
        "varied",
        "anchors",
        "visible",
        "drawn",
        "pairs",
        "samples",
        "width",
        "height",
        "pass",
        "ms_median",
        "floor_ms",
    ];
    let mut lines = vec![];
    for run in &loads.runs {
        let c = &run.step.counts;
        let mut line = |pass: &str, ms: f64, floor: Option<f64>| {
            lines.push([
                run.sweep.name().to_owned(),
                number(c.anchors),
                number(c.visible),
                number(c.drawn),
                number(c.pairs),
                number(c.samples),
                run.load.size[0].to_string(),
                run.load.size[1].to_string(),
                pass.to_owned(),
                number(ms),
                optional(floor),
            ]);
        };
        line("total", run.step.total.median, Some(run.step.total_floor));
        for pass in &run.step.passes {
            line(&pass.pass, pass.milliseconds.median, pass.floor);
        }
    }
    rows(header, lines)
}

/// A row per pass and varied quantity.
pub fn exponents(loads: &Loads) -> Vec<u8> {
    let line = |e: &super::loads::Exponent| {
        [e.pass.clone(), e.sweep.name().to_owned(), number(e.exponent), number(e.residual), e.points.to_string()]
    };
    rows(["pass", "varied", "exponent", "residual", "loads"], loads.exponents.iter().map(line))
}

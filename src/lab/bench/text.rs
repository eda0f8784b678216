//! A record for the terminal.

use std::fmt::Write as _;

use super::ceilings::Ceilings;
use super::predict;
use super::step::StepFigures;
use super::{Device, Record, digits};
use crate::lab::statistics::Spread;

fn quartiles(spread: &Spread) -> String {
    format!("{}..{}", digits(spread.lower), digits(spread.upper))
}

/// In millions.
fn millions(value: f64) -> String {
    digits(value * 1e-6)
}

fn line(text: &mut String, arguments: std::fmt::Arguments<'_>) {
    text.write_fmt(arguments).expect("a string takes everything");
    text.push('\n');
}

/// The ceilings.
pub fn ceilings(ceilings: &Ceilings) -> String {
    let mut text = String::new();
    line(&mut text, format_args!("{:<26} {:>10} {:>10} {:>6}  {}", "ceiling", "best", "median", "", "quartiles"));
    for (name, unit, spread) in ceilings.rows() {
        let best = digits(if unit == "us" { spread.min } else { spread.max });
        let median = digits(spread.median);
        line(&mut text, format_args!("{name:<26} {best:>10} {median:>10} {unit:>6}  {}", quartiles(&spread)));
    }
    text
}

/// A step, pass by pass.
pub fn step(figures: &StepFigures) -> String {
    let mut text = String::new();
    let c = &figures.counts;
    line(
        &mut text,
        format_args!(
            "step {} on {} view(s), means: {}{:.0} Gaussians, {:.0} drawn, {:.0} pairs ({:.0} before their tile ends), {:.0} \
             pixels, {} samples of which {:.0} % blended, {:.0} tokens a side",
            figures.step,
            figures.views.len(),
            if c.harmonics > 0.0 {
                format!("{:.0}, of which ", c.anchors)
            } else {
                format!("{:.0} anchors, {:.0} in view, ", c.anchors, c.visible)
            },
            c.gaussians,
            c.drawn,
            c.pairs,
            c.evaluated,
            c.pixels,
            millions(c.samples) + " M",
            100.0 * c.blended / c.samples.max(1.0),
            c.tokens,
        ),
    );
    line(
        &mut text,
        format_args!(
            "{:<42} {:>5} {:>9} {:>17} {:>8} {:>8} {:>7} {:>9} {:>11} {:>7} {:>7}",
            "pass", "n", "ms", "quartiles", "MB", "M op", "M exp", "floor ms", "by", "ratio", "at best"
        ),
    );
    for pass in &figures.passes {
        let work = pass.work.unwrap_or_default();
        let or = |value: Option<f64>| value.map_or("-".to_owned(), digits);
        line(
            &mut text,
            format_args!(
                "{:<42} {:>5} {:>9} {:>17} {:>8} {:>8} {:>7} {:>9} {:>11} {:>7} {:>7}",
                pass.pass,
                (100.0 * pass.dispatches).round() / 100.0,
                digits(pass.milliseconds.median),
                quartiles(&pass.milliseconds),
                millions(work.bytes),
                millions(work.operations),
                millions(work.exponentials),
                or(pass.floor),
                pass.bound.map_or("not counted", |bound| bound.name()),
                or(pass.ratio),
                or(pass.best_ratio),
            ),
        );
    }
    let mut whole = |name: &str, n: f64, spread: &Spread, floor: f64| {
        let ratio = |time: f64| if floor > 0.0 { digits(time / floor) } else { "-".to_owned() };
        line(
            &mut text,
            format_args!(
                "{name:<42} {n:>5.0} {:>9} {:>17} {:>8} {:>8} {:>7} {:>9} {:>11} {:>7} {:>7}",
                digits(spread.median),
                quartiles(spread),
                "",
                "",
                "",
                digits(floor),
                "",
                ratio(spread.median),
                ratio(spread.min),
            ),
        );
    };
    whole("between passes: barriers", figures.barriers, &figures.between, figures.between_floor);
    let dispatches: f64 = figures.passes.iter().map(|pass| pass.dispatches).sum();
    whole("total", dispatches, &figures.total, figures.total_floor);
    let host = &figures.host;
    line(
        &mut text,
        format_args!(
            "host, ms per step: recording {} ({}), submission {} ({}), waiting {} ({})",
            digits(host.recording.median),
            quartiles(&host.recording),
            digits(host.submission.median),
            quartiles(&host.submission),
            digits(host.waiting.median),
            quartiles(&host.waiting),
        ),
    );
    text
}

/// The whole record.
pub fn record(record: &Record) -> String {
    let Device { name, driver, .. } = &record.device;
    let mut text = format!("{name}, {driver}\n\n{}\n{}", ceilings(&record.ceilings), step(&record.step));
    if !record.predictions.is_empty() {
        text += &format!("\n{}", predict::text(&record.predictions));
    }
    text
}

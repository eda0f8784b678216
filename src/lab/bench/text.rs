//! A record for the terminal.

use std::fmt::Write as _;

use super::ceilings::Ceilings;
use super::loads::{Loads, Sweep};
use super::predict;
use super::step::StepFigures;
use super::tune::ChoiceFigures;
use super::{Record, digits};
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
            "step {} on {} view(s), means: {:.0} anchors, {:.0} in view, {:.0} Gaussians, {:.0} drawn, {:.0} pairs ({:.0} before \
             their tile ends), {:.0} pixels, {} samples of which {:.0} % blended, {:.0} tokens a side",
            figures.step,
            figures.views.len(),
            c.anchors,
            c.visible,
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
    let mut text = format!("{}, {}\n\n{}", record.device.name, record.device.driver, ceilings(&record.ceilings));
    if let Some(figures) = &record.step {
        text += &format!("\n{}", step(figures));
    }
    if let Some(figures) = &record.loads {
        text += &format!("\n{}", loads(figures));
    }
    if let Some(choices) = &record.tune {
        text += &format!("\n{}", tune(choices, record));
    }
    if !record.predictions.is_empty() {
        text += &format!("\n{}", predict::text(&record.predictions));
    }
    text
}

/// Generated loads: the whole steps, how the passes grow, what memory they take.
pub fn loads(loads: &Loads) -> String {
    let mut text = String::new();
    line(
        &mut text,
        format_args!(
            "{:<8} {:>9} {:>9} {:>9} {:>10} {:>12} {:>10} {:>10} {:>10} {:>7}",
            "varied", "anchors", "in view", "drawn", "pairs", "picture", "M samples", "step ms", "floor ms", "ratio"
        ),
    );
    for run in &loads.runs {
        let (c, step) = (&run.step.counts, &run.step);
        line(
            &mut text,
            format_args!(
                "{:<8} {:>9.0} {:>9.0} {:>9.0} {:>10.0} {:>12} {:>10} {:>10} {:>10} {:>7}",
                run.sweep.name(),
                c.anchors,
                c.visible,
                c.drawn,
                c.pairs,
                format!("{} x {}", run.load.size[0], run.load.size[1]),
                millions(c.samples),
                digits(step.total.median),
                digits(step.total_floor),
                digits(step.ratio()),
            ),
        );
    }
    for left in &loads.left_out {
        line(&mut text, format_args!("left out, {} varied: {}: {}", left.sweep.name(), left.load, left.why));
    }
    // The costliest first: by their largest share of any load.
    let mut names: Vec<(&str, f64)> = vec![];
    for e in &loads.exponents {
        if names.iter().all(|(name, _)| *name != e.pass) {
            let share = |run: &super::loads::LoadFigures| {
                let pass = run.step.passes.iter().find(|p| p.pass == e.pass);
                pass.map_or(0.0, |p| p.milliseconds.median / run.step.total.median)
            };
            let most = if e.pass == "total" { 2.0 } else { loads.runs.iter().map(share).fold(0.0, f64::max) };
            names.push((&e.pass, most));
        }
    }
    names.sort_by(|a, b| b.1.total_cmp(&a.1));
    text.push('\n');
    line(
        &mut text,
        format_args!(
            "{:<42} {:>8}  {:>8}  {:>8}  {:>12}",
            "exponent of the time by", "anchors", "pairs", "pixels", "largest share"
        ),
    );
    for (name, share) in names {
        let of = |sweep: Sweep| {
            let found = loads.exponents.iter().find(|e| e.pass == name && e.sweep == sweep);
            found.map_or("-".to_owned(), |e| format!("{:.2}{}", e.exponent, if e.residual > 0.2 { "~" } else { "" }))
        };
        let share = if name == "total" { String::new() } else { format!("{:.0} %", 100.0 * share) };
        let [anchors, pairs, pixels] = Sweep::ALL.map(of);
        line(&mut text, format_args!("{name:<42} {anchors:>8}  {pairs:>8}  {pixels:>8}  {share:>12}"));
    }
    text += "time beyond that of empty dispatches; - too few loads with more than that; ~ off the line by more than 20 %; \
             pairs grow with the anchors, two per Gaussian\n";
    let m = &loads.memory;
    line(
        &mut text,
        format_args!(
            "device memory by the ledger: {:.0} B per anchor, {:.0} B more for one in view, {:.0} B per pair, {:.0} B per pixel",
            m.per_anchor, m.per_visible, m.per_pair, m.per_pixel
        ),
    );
    text
}

/// The choices, their evidence, and the table for the source.
pub fn tune(choices: &[ChoiceFigures], record: &Record) -> String {
    let mut text = String::new();
    line(
        &mut text,
        format_args!("{:<20} {:<28} {:>10} {:>8}  {}", "choice", "option", "ms", "ratio", "quartiles of the ratio"),
    );
    for choice in choices {
        for option in &choice.options {
            let mark = match (option.option == choice.best, option.shipped) {
                (true, true) => "  best, as shipped",
                (true, false) => "  best",
                (false, true) => "  as shipped",
                (false, false) => "",
            };
            line(
                &mut text,
                format_args!(
                    "{:<20} {:<28} {:>10} {:>8}  {}{mark}",
                    choice.choice,
                    option.option,
                    digits(option.milliseconds.median),
                    digits(option.ratio.median),
                    quartiles(&option.ratio),
                ),
            );
        }
    }
    text.push('\n');
    line(
        &mut text,
        format_args!("// {}, {}; ratios of medians to the shipped option", record.device.name, record.device.driver),
    );
    for choice in choices {
        let evidence: Vec<String> =
            choice.options.iter().map(|o| format!("{} {}", o.option, digits(o.ratio.median))).collect();
        line(
            &mut text,
            format_args!(
                "(\"{}\", \"{}\", \"{}\"), // {}: {}",
                record.device.kind,
                choice.choice,
                choice.best,
                choice.work,
                evidence.join("; ")
            ),
        );
    }
    text
}

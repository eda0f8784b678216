//! The report as one page: no scripts, nothing from elsewhere, good on a screen and on paper.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::figures;
use super::kernels::{Distance, Kernels, VariantFigures};
use super::training::{self, Training};
use super::{Omitted, Report};
use crate::lab::statistics::{Paired, Spread};

/// The drawn figures.
#[derive(Debug, Default)]
pub struct Drawings {
    /// Picture and gradients.
    pub whole: String,
    /// By stage.
    pub stages: String,
    /// Training.
    pub training: String,
}

/// How pages of this program look.
pub(crate) const STYLE: &str = "
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 76rem; color: #222; background: #fff;
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.35rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid #ccc; }
h3 { font-size: 1.05rem; margin: 1.8rem 0 .4rem; }
p, li { max-width: 46rem; }
.lead { color: #555; margin-top: 0; }
figure { margin: 1.2rem 0; }
figure svg { display: block; width: 100%; height: auto; }
figcaption { color: #555; font-size: .88rem; max-width: 46rem; margin-top: .3rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; margin: .6rem 0; }
th, td { padding: .22rem .7rem .22rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #e6e6e6; }
thead th { border-bottom: 1px solid #888; font-weight: 600; }
th { font-weight: 500; }
tbody th { white-space: nowrap; }
figure { max-width: 66rem; }
.n { text-align: right; white-space: nowrap; }
.r { color: #777; white-space: nowrap; }
code, pre { font-family: ui-monospace, monospace; font-size: .82rem; }
pre { background: #f7f7f7; padding: .8rem 1rem; overflow-x: auto; white-space: pre-wrap; overflow-wrap: anywhere; }
.settings { columns: 2; column-gap: 2rem; }
tr.out td, tr.out th { color: #777; }
.mark, tr.out td.mark { color: #a33c00; }
@page { size: A4; margin: 14mm; }
@media print {
  body { padding: 0; max-width: none; font-size: 10pt; }
  h2 { break-after: avoid; } h3 { break-after: avoid; }
  figure, tr { break-inside: avoid; } table { font-size: 8pt; } pre { font-size: 7.5pt; background: none; padding: 0; }
  .wide { overflow: visible; }
}
";

/// A number with its exact value behind what is shown.
fn value(value: f64, shown: String) -> Markup {
    if !value.is_finite() {
        return html! { "not finite" };
    }
    html! { data value=(value) { (shown) } }
}

/// Three significant digits, but no more than a table needs.
fn short(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let digits = (2.0 - value.abs().log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{value:.digits$}")
}

/// A small number as people write it.
fn scientific(value: f64) -> Markup {
    if value == 0.0 {
        return html! { "0" };
    }
    if (0.01..1000.0).contains(&value) {
        return html! { (format!("{value:.2}")) };
    }
    let text = format!("{value:.1e}");
    let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
    html! { (mantissa) "·10" sup { (exponent.replace('-', "−")) } }
}

fn error(distance: Option<&Distance>) -> Markup {
    match distance {
        Some(d) if d.relative.is_finite() => html! { data value=(d.relative) { (scientific(d.relative)) } },
        Some(_) => html! { "not finite" },
        None => html! { "–" },
    }
}

fn time(spread: &Spread) -> Markup {
    html! {
        (value(spread.median, short(spread.median)))
        " " span.r { "[" (short(spread.lower)) ", " (short(spread.upper)) "]" }
    }
}

fn figure(svg: &str, caption: &Markup) -> Markup {
    html! { figure { (PreEscaped(svg)) figcaption { (caption) } } }
}

fn by(dominated: Option<&String>) -> Markup {
    html! { @if let Some(by) = dominated { br; small { span.mark { "superfluous" } ": " (by) } } }
}

fn changes(changes: &[String]) -> Markup {
    html! { @for change in changes { code { (change) } br; } }
}

fn left_out(omitted: &[Omitted]) -> Markup {
    html! {
        @if !omitted.is_empty() {
            p { "Not measured: " @for (i, o) in omitted.iter().enumerate() { @if i > 0 { "; " } (o.variant) " (" (o.why) ")" } "." }
        }
    }
}

/// The page.
pub fn page(report: &Report, drawings: &Drawings) -> String {
    let Report { scene, device, .. } = report;
    let title = format!("Error against run time: {} on {}", scene.name, device.name);
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { "Error against run time" }
                p.lead { (scene.name) " on " (device.name) }
                (facts(report))
                @if let Some(kernels) = &report.kernels { (of_kernels(kernels, drawings)) }
                @if let Some(training) = &report.training { (of_training(training, drawings)) }
                h2 { "Settings" }
                p { "Every setting of the first choice, \"as set\"; the others change what is listed beside their names." }
                pre.settings { (report.settings.to_toml().trim()) }
            }
        }
    }
    .into_string()
}

fn facts(report: &Report) -> Markup {
    let Report { scene, device, .. } = report;
    let [width, height] = scene.size;
    html! {
        table {
            tbody {
                tr { th { "Device" } td { (device.name) " (" (device.kind) "), Vulkan " (device.api) ", subgroups of " (device.subgroup_size) } }
                tr { th { "Driver" } td { (device.driver) } }
                tr { th { "Scene" } td {
                    (scene.train_views) " training views of " (width) " × " (height) " pixels, " (scene.masks) " masks, "
                    (scene.priors) " depth priors, " (inpainted(scene.references)) "; "
                    (scene.test_views) " held-out views; " (scene.points) " points"
                } }
                tr { th { "Program" } td { "gscream-vk " (report.version) } }
                tr { th { "Command" } td { code { (report.command) } } }
                tr { th { "Numbers" } td { "report.json, and as tables kernels.csv, tensors.csv, training.csv" } }
            }
        }
    }
}

fn of_kernels(kernels: &Kernels, drawings: &Drawings) -> Markup {
    let Kernels { warm_up, step, views, repetitions, anchors, variants, omitted } = kernels;
    let base = &variants[0];
    html! {
        h2 { "One training step" }
        p {
            "Every choice starts from the same model of " (anchors) " anchors, trained for " (warm_up) " steps, and runs step "
            (step) " on " (views.len()) " views (" (views.join(", ")) "). Times are medians of " (repetitions)
            " rounds, in which all choices take turns, after one that is not counted; they come from the device's timestamp \
             queries. Errors are distances from the float64 reference path "
            em { "under the settings of the first choice" }
            ": the Euclidean norm of the difference, divided by that of the reference, of all views together. A choice \
             that computes something else on purpose shows that as its error."
        }
        (figure(&drawings.whole, &html! {
            "Left: error of the picture (rgb) against the time from the step's first pass to the finished picture. Right: \
             the largest error of any of the model's gradients against the time of the whole step. A choice is hollow \
             where another is in nothing worse and in something better: picture, gradients and time of the step \
             together. Errors within 10 % count as equal, and so do times within 2 % or about which less than three quarters \
             of the rounds agree; times are compared round by round."
        }))
        div.wide { table {
            thead { tr {
                th { "choice" } th { "sets" } th.n { "picture, ms" } th.n { "step, ms" } th.n { "step, relative" }
                th.n { "picture error" } th.n { "gradient error" } th { "worst in" }
            } }
            tbody { @for v in variants { (row(v)) } }
        } }
        (left_out(omitted))
        h3 { "By stage" }
        (figure(&drawings.stages, &html! {
            "Error of what a stage leaves behind, the errors of the stages before it included, against the milliseconds \
             in its passes. A panel shows the first choice and those that differ from it there."
        }))
        div.wide { table {
            thead { tr {
                th { "stage, as set" } th.n { "ms" } th.n { "share" } th.n { "error so far" } th { "worst in" }
                th.n { "its own error" } th { "worst in" }
            } }
            tbody {
                @let total: f64 = base.stages.iter().map(|s| s.milliseconds.median).sum();
                @for s in &base.stages { tr {
                    th { (s.stage.name()) }
                    td.n { (time(&s.milliseconds)) }
                    td.n { (format!("{:.1} %", 100.0 * s.milliseconds.median / total)) }
                    td.n { (error(s.error.as_ref())) }
                    td { @if let Some(e) = &s.error { (e.tensor) } }
                    td.n { @match &s.kernel_error {
                        Some(own) if own.relative.is_finite() => data value=(own.relative) { (scientific(own.relative)) },
                        Some(_) => "not finite",
                        None => "–",
                    } }
                    td { @if let Some(own) = &s.kernel_error { @if own.relative > 0.0 {
                        (own.pass.rsplit('/').next().unwrap_or(&own.pass)) ": " (own.tensor)
                    } } }
                } }
            }
        } }
        p { "\"Error so far\" is that of the stage's output on the way from the model; of sorting, whose output is an order, \
             that of the picture. \"Its own error\" is that of its kernels on the inputs they were given." }
        @if variants.len() > 1 {
            h3 { "Where the choices differ" }
            div.wide { table {
                thead { tr { th { "stage" } th { "choice" } th.n { "ms" } th.n { "error so far" } th { "worst in" } th { "superfluous for" } } }
                tbody {
                    @for s in &base.stages {
                        @let differing = variants.iter().skip(1).filter_map(|v| {
                            let own = v.stages.iter().find(|own| own.stage == s.stage)?;
                            figures::differs(own, s).then_some((v, own))
                        });
                        @for (v, own) in differing { tr.out[own.dominated_by.is_some()] {
                            th { (s.stage.name()) } td { (v.name) } td.n { (time(&own.milliseconds)) }
                            td.n { (error(own.error.as_ref())) }
                            td { @if let Some(e) = &own.error { (e.tensor) } }
                            td.mark { @if let Some(by) = &own.dominated_by { (by) } }
                        } }
                    }
                }
            } }
        }
    }
}

fn row(v: &VariantFigures) -> Markup {
    let ratio = v.time_ratio.median;
    html! {
        tr.out[v.dominated_by.is_some()] {
            th { (v.name) (by(v.dominated_by.as_ref())) }
            td { (changes(&v.changes)) }
            td.n { (time(&v.picture_milliseconds)) }
            td.n { (time(&v.step_milliseconds)) }
            td.n { (format!("{:.0} %", 100.0 * ratio)) }
            td.n { (error(Some(&v.picture_error))) }
            td.n { (error(Some(&v.gradient_error))) }
            td { (v.gradient_error.tensor) }
        }
    }
}

fn of_training(training: &Training, drawings: &Drawings) -> Markup {
    let Training { iterations, test_views, variants, omitted, steps, ends, differences } = training;
    let seeds = variants.first().map_or(0, |v| v.runs.len());
    html! {
        h2 { "Training" }
        p {
            "Every choice trains for " (iterations) " steps, " (seeds) @if seeds == 1 { " seed" } @else { " seeds" }
            " each. Figures are means over " (test_views) " held-out views, the same photographs for all choices, taken at "
            (steps.len()) " steps while the clock stands still: seconds are those of training alone. The colour loss is \
             (1 − w) L1 + w (1 − SSIM) of the whole picture with " code { "losses.ssim_weight" } " as w."
            @if seeds == 1 { " With one seed nothing is known of the spread: small differences mean nothing, and no choice is called superfluous." }
        }
        (figure(&drawings.training, &html! {
            "Figures on held-out views during training. The grey band joins the points on the Pareto front: nothing measured \
             here was better in less time."
        }))
        div.wide { table {
            thead { tr {
                th { "choice" } th { "sets" } th.n { "seconds" } th.n { "steps/s" } th.n { "PSNR, dB" }
                th.n { "masked PSNR, dB" } th.n { "SSIM" } th.n { "loss" } th.n { "anchors" }
            } }
            tbody { @for v in variants { @if let Some(end) = v.points.last() {
                @let m = &end.mean;
                tr.out[v.dominated_by.is_some()] {
                    th { (v.name) (by(v.dominated_by.as_ref())) }
                    td { (changes(&v.changes)) }
                    td.n { (value(m.seconds, format!("{:.1}", m.seconds))) (range(Some(end.seconds_range), 1)) }
                    td.n { (format!("{:.2}", f64::from(m.step) / m.seconds)) }
                    td.n { (value(m.psnr, format!("{:.2}", m.psnr))) (range(Some(end.psnr_range), 2)) }
                    td.n { @if let Some(psnr) = m.masked_psnr { (value(psnr, format!("{psnr:.2}"))) } @else { "–" } (range(end.masked_psnr_range, 2)) }
                    td.n { (value(m.ssim, format!("{:.4}", m.ssim))) }
                    td.n { (value(m.loss, format!("{:.4}", m.loss))) (range(Some(end.loss_range), 4)) }
                    td.n { (m.anchors) }
                }
            } } }
        } }
        @if !differences.is_empty() { (over_seeds(ends, differences)) }
        (left_out(omitted))
    }
}

/// Means, deviations and paired differences at the ends of all choices.
fn over_seeds(ends: &[training::End], differences: &[training::Difference]) -> Markup {
    let columns = [
        ("psnr", "PSNR, dB", 2),
        ("masked_psnr", "masked PSNR, dB", 2),
        ("ssim", "SSIM", 4),
        ("seconds", "seconds", 1),
    ];
    let tested = |d: &training::Difference, name: &str, digits: usize| {
        d.figures.get(name).map_or("–".to_owned(), |paired| {
            let Paired { difference, standard_error, p, .. } = paired;
            format!("{difference:+.digits$} ± {standard_error:.digits$} (p {p:.3})")
        })
    };
    html! {
        p { "At the end of the runs: mean ± standard deviation of a seed." }
        div.wide { table {
            thead { tr { th { "choice" } @for (_, title, _) in columns { th.n { (title) } } } }
            tbody { @for end in ends { tr {
                th { (end.variant) }
                @for (name, _, digits) in columns {
                    td.n { (end.figures.get(name).map_or("–".to_owned(), |moments| moments.text(digits))) }
                }
            } } }
        } }
        p { "Differences over the same seeds: mean ± its standard error, and p of a paired t-test." }
        div.wide { table {
            thead { tr { th { "difference" } @for (_, title, _) in columns { th.n { (title) } } } }
            tbody { @for d in differences { tr {
                th { (d.to) " less " (d.from) }
                @for (name, _, digits) in columns { td.n { (tested(d, name, digits)) } }
            } } }
        } }
    }
}

/// Extremes over the seeds, where there are several.
fn range(range: Option<[f64; 2]>, digits: usize) -> Markup {
    html! {
        @if let Some([low, high]) = range { @if low < high {
            " " span.r { "[" (format!("{low:.digits$}")) ", " (format!("{high:.digits$}")) "]" }
        } }
    }
}

/// How many inpainted views, in words.
fn inpainted(views: usize) -> String {
    match views {
        0 => "no inpainted view".into(),
        1 => "one inpainted view".into(),
        n => format!("{n} inpainted views"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceInfo;
    use crate::lab::report::SceneFacts;
    use crate::lab::report::kernels::{OwnError, StageFigures};
    use crate::lab::report::stages::Stage;
    use crate::lab::report::training::{Point, Sample, SeedRun, VariantRuns};

    #[test]
    fn numbers_as_shown() {
        assert_eq!(
            [0.0, 0.01234, 1.2345, 12.345, 123.45, 1234.5].map(short),
            ["0", "0.0123", "1.23", "12.3", "123", "1234"]
        );
        assert_eq!(scientific(1.26e-7).into_string(), "1.3·10<sup>−7</sup>");
        assert_eq!(scientific(0.0).into_string(), "0");
        assert_eq!(value(f64::NAN, "?".into()).into_string(), "not finite");
    }

    fn spread(median: f64) -> Spread {
        Spread::of(&[0.9 * median, median, 1.2 * median])
    }

    fn choice(name: &str, change: &str, factor: f64, dominated_by: Option<&str>) -> VariantFigures {
        let distance = |relative: f64, tensor| Distance { relative, largest: 2.0 * relative, tensor };
        let dominated_by = dominated_by.map(str::to_owned);
        let stage = |stage, milliseconds: f64, relative: f64| StageFigures {
            stage,
            milliseconds: spread(milliseconds),
            time_ratio: Some(spread(factor)),
            error: Some(distance(relative, "opacity")),
            kernel_error: Some(OwnError {
                relative: relative / 3.0,
                pass: "render/decode".into(),
                tensor: "scale".into(),
                integers: 0,
            }),
            dominated_by: dominated_by.clone(),
        };
        VariantFigures {
            name: name.into(),
            changes: if change.is_empty() { vec![] } else { vec![change.into()] },
            picture_milliseconds: spread(20.0 * factor),
            picture_error: distance(2.5e-6 * factor, "rgb"),
            step_milliseconds: spread(80.0 * factor),
            time_ratio: spread(factor),
            gradient_error: distance(4e-5 * factor, "grad_offset"),
            dominated_by: dominated_by.clone(),
            stages: vec![stage(Stage::Cull, 0.5, 0.0), stage(Stage::Decode, 7.0 * factor, 1e-7 * factor)],
            tensors: vec![],
        }
    }

    /// A report of made-up numbers.
    fn report() -> Report {
        let device = DeviceInfo {
            index: 0,
            name: "Device <1>".into(),
            kind: "discrete",
            driver: "driver 1.2".into(),
            api: "1.3.200".into(),
            subgroup_size: 32,
            narrow_subgroup_size: 32,
            push_descriptors: true,
            max_binding_bytes: 1 << 30,
            heap_bytes: 1 << 33,
            shared_bytes: 1 << 16,
            max_groups: 65535,
            timestamp_period: 1.0,
            lacks: vec![],
        };
        let sample = |step: u32, psnr| Sample {
            step,
            seconds: f64::from(step) / 8.0,
            loss: 1.0 / psnr,
            psnr,
            masked_psnr: Some(psnr - 5.0),
            ssim: 0.9,
            anchors: 1000,
        };
        let run = |name: &str, gain: f64, dominated_by: Option<&str>| {
            let samples = vec![sample(10, 15.0 + gain), sample(100, 21.0 + gain)];
            let point = |mean: &Sample| Point {
                mean: *mean,
                seconds_range: [mean.seconds; 2],
                psnr_range: [mean.psnr - 0.1, mean.psnr + 0.1],
                masked_psnr_range: None,
                loss_range: [mean.loss; 2],
                psnr_front: gain == 0.0,
                masked_psnr_front: false,
                loss_front: true,
            };
            VariantRuns {
                name: name.into(),
                changes: vec![],
                points: samples.iter().map(point).collect(),
                runs: vec![SeedRun { seed: 0, samples }],
                dominated_by: dominated_by.map(str::to_owned),
            }
        };
        let omitted = vec![Omitted { variant: "no masks".into(), why: "there are none".into() }];
        Report {
            version: "1.2.3".into(),
            command: "gscream-vk report garden".into(),
            scene: SceneFacts {
                name: "garden".into(),
                train_views: 60,
                test_views: 10,
                size: [252, 142],
                points: 5000,
                masks: 60,
                priors: 0,
                references: 0,
            },
            device,
            settings: crate::config::Settings::default(),
            kernels: Some(Kernels {
                warm_up: 50,
                step: 51,
                views: vec!["a".into(), "b".into()],
                repetitions: 3,
                anchors: 1234,
                variants: vec![
                    choice("as set", "", 1.0, None),
                    choice("worse", "render.cull=false", 1.5, Some("as set")),
                ],
                omitted: omitted.clone(),
            }),
            training: Some(Training {
                iterations: 100,
                steps: vec![10, 100],
                test_views: 10,
                variants: vec![run("as set", 0.0, None), run("worse", -1.0, Some("as set"))],
                omitted,
                ends: vec![],
                differences: vec![],
            }),
        }
    }

    #[test]
    fn the_page_of_fixed_numbers() {
        let text = |text: &str| format!("<svg>{text}</svg>");
        let drawings = Drawings { whole: text("whole"), stages: text("stages"), training: text("training") };
        let page = page(&report(), &drawings);
        // A line per element, so that a change is one of a line.
        insta::assert_snapshot!(page.replace("><", ">\n<").replace("</tr>", "</tr>\n"));
    }

    #[test]
    fn the_plots_of_fixed_numbers() {
        let report = report();
        let (kernels, training) = (report.kernels.expect("made up"), report.training.expect("made up"));
        for (name, figure) in [
            ("step", figures::whole(&kernels)),
            ("stages", figures::by_stage(&kernels)),
            ("training", figures::training(&training)),
        ] {
            insta::assert_snapshot!(name, crate::lab::plots::draw(&figure).expect("drawn"));
        }
    }
}

//! The page of a run: `index.html` in its folder, with nothing from elsewhere.
//!
//! Curves, figures, settings and device are those of the run folder's own files, so that the page of a run that ended
//! early says how far it came. Pictures are files below `index/` and `test/`.

use std::path::Path;

use anyhow::Context as _;
use image::RgbImage;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use serde_json::Value;

use super::folders::{Record, SETTINGS, TEST, last_part};
use super::{next, pictures};
use crate::export;
use crate::lab::pace::duration;
use crate::lab::plots::{self, Axis, Figure, Mark, Panel, Scale, Series};
use crate::lab::report::page::STYLE;
use crate::scene::Scene;
use crate::train::run::LOG;

/// The page's file within a run folder.
pub(super) const INDEX: &str = "index.html";
/// The folder of its pictures within a run folder.
pub(super) const PICTURES: &str = "index";
/// Its folders: photographs of test views, photographs of train views, and these as drawn.
pub(super) const FOLDERS: [&str; 3] = ["test", "photograph", "drawn"];
/// The file of the figures within a run folder.
const METRICS: &str = "metrics.json";
/// Most points of a curve: more cannot be told apart.
const POINTS: usize = 60;

/// A photograph and what the model draws from the same camera.
struct Pair {
    name: String,
    size: [u32; 2],
    /// Paths within the run folder.
    photograph: String,
    drawn: String,
}

/// Writes the page of the run in `folder`, with the test views and some train views (`drawn`: index and picture) beside
/// their photographs.
///
/// # Errors
/// Files of the folder that cannot be read or written.
pub(super) fn write(folder: &Path, record: &Record, scene: &Scene, drawn: &[(usize, RgbImage)]) -> anyhow::Result<()> {
    let (mut test, mut train) = (vec![], vec![]);
    for view in &scene.test {
        let photograph = format!("{PICTURES}/{}/{}.jpg", FOLDERS[0], view.name);
        pictures::write_jpeg(&folder.join(&photograph), &view.image)?;
        let drawn = format!("{TEST}/{}.png", view.name);
        test.push(Pair { name: view.name.clone(), size: view.camera.size, photograph, drawn });
    }
    for (index, picture) in drawn {
        let view = &scene.train[*index];
        let [_, photograph, drawn] = FOLDERS.map(|what| format!("{PICTURES}/{what}/{}.jpg", view.name));
        pictures::write_jpeg(&folder.join(&photograph), &view.image)?;
        pictures::write_jpeg(&folder.join(&drawn), picture)?;
        train.push(Pair { name: view.name.clone(), size: view.camera.size, photograph, drawn });
    }
    write_page(folder, record, &test, &train)
}

/// Writes the page of a run that ended early. It must not hide why the run ended: what fails is a note.
pub(super) fn of_stopped(folder: &Path) {
    match Record::read(folder).and_then(|record| write_page(folder, &record, &[], &[])) {
        Ok(()) => eprintln!("note: {} says how far the run came", folder.join(INDEX).display()),
        Err(error) => log::info!("{error:#}"),
    }
}

fn write_page(folder: &Path, record: &Record, test: &[Pair], train: &[Pair]) -> anyhow::Result<()> {
    let text = |name: &str| {
        let path = folder.join(name);
        std::fs::read_to_string(&path).with_context(|| format!("{}: cannot be read", path.display()))
    };
    // A line that was cut off by a full disk is no line.
    let log: Vec<Value> = text(LOG)?.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let metrics = text(METRICS).ok().and_then(|text| serde_json::from_str(&text).ok()).unwrap_or(Value::Null);
    let facts = Facts { folder, record, settings: &text(SETTINGS)?, log: &log, metrics: &metrics };
    let page = page(&facts, test, train)?;
    export::write(&[(folder.join(INDEX), page.as_bytes())])?;
    Ok(())
}

/// What the run folder says.
struct Facts<'a> {
    folder: &'a Path,
    record: &'a Record,
    settings: &'a str,
    log: &'a [Value],
    metrics: &'a Value,
}

const OWN_STYLE: &str = "
.pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); gap: 1rem; }
.pairs figure { margin: 0; }
.pair { position: relative; --at: 50%; background: #eee; }
.pair img { position: absolute; inset: 0; width: 100%; height: 100%; display: block; }
.pair img + img { clip-path: inset(0 calc(100% - var(--at)) 0 0); }
.pair::after { content: ''; position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px; background: #fff; }
.pair input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; z-index: 1; }
.pair:focus-within { outline: 2px solid #0072b2; }
";

fn page(facts: &Facts<'_>, test: &[Pair], train: &[Pair]) -> anyhow::Result<String> {
    let Facts { folder, record, settings, log, metrics } = facts;
    let name = last_part(&record.scene);
    let last = log.last().and_then(|line| line["step"].as_u64()).unwrap_or(0);
    let seconds = log.last().and_then(|line| line["seconds"].as_f64()).unwrap_or(0.0);
    let go_on = format!("gscream-vk train --resume {}", next::typed(&folder.to_string_lossy()));
    let curves = curves(log);
    let curves = (!curves.panels.is_empty()).then(|| plots::draw(&curves)).transpose()?;
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (name) }
                style { (PreEscaped(STYLE)) (PreEscaped(OWN_STYLE)) }
            }
            body {
                h1 { (name) }
                p.lead {
                    @match record.complete {
                        Some(steps) => { "Complete: " (steps) " steps" },
                        None => { "Ended early, the last line of the log is of step " (last) },
                    }
                    @if seconds > 0.0 { " in " (duration(seconds)) " of training" }
                    " on " (record.device) ", gscream-vk " (record.version) "."
                }
                @if record.complete.is_none() { p { code { (go_on) } " goes on." } }
                @if !train.is_empty() {
                    h2 { "With the object and without" }
                    p { "Train views: the photograph on the left of the slider, the trained scene on its right." }
                    (sliders(train))
                }
                @if !test.is_empty() {
                    h2 { "Test views" }
                    p { "Not trained on: the photograph on the left of the slider, the trained scene on its right." }
                    (sliders(test))
                }
                @if let Some(curves) = &curves {
                    h2 { "Training" }
                    figure { (PreEscaped(curves)) }
                }
                (figures(metrics))
                @if record.complete.is_some() {
                    h2 { "What now" }
                    ul {
                        @for (command, purpose) in steps(folder) { li { code { (command) } " " (purpose) } }
                    }
                }
                h2 { "How it was made" }
                p { code { (record.command) } }
                details { summary { "Every setting" } pre { (settings) } }
            }
        }
    };
    Ok(page.into_string())
}

/// What can be done with a complete run.
pub(super) fn steps(folder: &Path) -> [(String, &'static str); 3] {
    let command = |words: &[&str]| next::command(words, folder);
    [
        (command(&["export"]), "writes it for viewers: PLY, SPZ, glTF and others"),
        (command(&["view"]), "shows the export in the browser"),
        (command(&["render", "--views", "spiral"]), "draws a path through the scene"),
    ]
}

fn sliders(pairs: &[Pair]) -> Markup {
    html! {
        div.pairs { @for pair in pairs {
            @let [w, h] = pair.size;
            figure {
                div.pair style=(format!("aspect-ratio:{w}/{h}")) {
                    img src=(url(&pair.drawn)) alt=(format!("{} as trained", pair.name)) loading="lazy";
                    img src=(url(&pair.photograph)) alt=(format!("photograph of {}", pair.name)) loading="lazy";
                    input type="range" min="0" max="100" value="50" step="0.5" aria-label=(format!("photograph of {} from the left", pair.name))
                        oninput="this.parentNode.style.setProperty('--at',this.value+'%')";
                }
                figcaption { (pair.name) }
            }
        } }
    }
}

/// A path within the folder as a relative URL.
fn url(path: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.~/".contains(&byte);
    path.bytes().map(|byte| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") }).collect()
}

/// Name in the log, title, label, scale.
const CURVES: [(&str, &str, &str, Scale); 4] = [
    ("mean_loss", "Loss", "loss", Scale::Log),
    ("psnr", "PSNR on the test views", "dB", Scale::Linear),
    ("masked_psnr", "PSNR inside the mask", "dB", Scale::Linear),
    ("anchors", "Anchors", "anchors", Scale::Linear),
];

fn curves(log: &[Value]) -> Figure {
    let panel = |(key, title, label, scale): (&str, &str, &str, Scale)| {
        let mut points: Vec<(f64, f64)> = vec![];
        for line in log {
            let (Some(step), Some(value)) = (line["step"].as_f64(), line[key].as_f64()) else { continue };
            // A line repeats the figures of the last evaluation.
            let repeated = key.ends_with("psnr") && points.last().is_some_and(|(_, last)| *last == value);
            if !repeated {
                points.push((step, value));
            }
        }
        let last = points.len().checked_sub(1)?;
        let every = points.len().div_ceil(POINTS);
        let kept = points.into_iter().enumerate().filter(|(i, _)| (last - i).is_multiple_of(every));
        let mark = |(_, at)| Mark { at, quartiles: None, x_range: None, y_range: None, hollow: false, front: false };
        let axis = |label: &str, scale| Axis { label: label.to_owned(), scale };
        Some(Panel {
            title: title.to_owned(),
            note: String::new(),
            x: axis("step", Scale::Linear),
            y: axis(label, scale),
            series: vec![Series { style: 2, marks: kept.map(mark).collect() }],
            joined: true,
        })
    };
    Figure {
        description: "Loss, PSNR on the test views and number of anchors during training".to_owned(),
        legend: vec![],
        footnote: String::new(),
        panels: CURVES.into_iter().filter_map(panel).collect(),
        columns: 2,
        panel: [480.0, 260.0],
    }
}

/// Key in the report, title.
const REGIONS: [(&str, &str); 5] = [
    ("full", "full image"),
    ("mask", "inside the mask"),
    ("box", "the mask's box"),
    ("outside", "outside the mask"),
    ("rim", "the mask's rim"),
];
const FIGURES: [(&str, &str, usize); 3] = [("psnr", "PSNR, dB", 2), ("ssim", "SSIM", 4), ("flip", "FLIP", 4)];

fn figures(metrics: &Value) -> Markup {
    let number = |value: &Value, digits: usize| match value {
        Value::String(text) => text.clone(),
        other => other.as_f64().map_or("–".to_owned(), |v| format!("{v:.digits$}")),
    };
    let none = vec![];
    let views = metrics["views"].as_array().unwrap_or(&none);
    html! {
        @if views.is_empty() {
            h2 { "Figures" }
            p { "None yet: figures are taken on test views. Without any, " code { "--set scene.test_every=8" } " holds some out." }
        } @else {
            h2 { "Figures" }
            div.wide { table {
                thead { tr { th { "mean of " (views.len()) " test views" } @for (_, title, _) in FIGURES { th.n { (title) } } } }
                tbody { @for (key, title) in REGIONS { @if metrics["mean"][key].is_object() { tr {
                    th { (title) }
                    @for (figure, _, digits) in FIGURES { td.n { (number(&metrics["mean"][key][figure], digits)) } }
                } } } }
            } }
            details { summary { "Every view" } div.wide { table {
                thead { tr { th { "view" } th.n { "PSNR, dB" } th.n { "SSIM" } th.n { "PSNR inside the mask, dB" } } }
                tbody { @for view in views { tr {
                    th { (view["name"].as_str().unwrap_or_default()) }
                    td.n { (number(&view["full"]["psnr"], 2)) }
                    td.n { (number(&view["full"]["ssim"], 4)) }
                    td.n { (number(&view["mask"]["psnr"], 2)) }
                } } }
            } } }
        }
    }
}

/// Train views to show, evenly spread over those that show the object; of all where none has a mask.
pub(super) fn chosen(scene: &Scene) -> Vec<usize> {
    const SHOWN: usize = 4;
    let shows = |at: &usize| scene.train[*at].mask.as_ref().is_some_and(|mask| mask.pixels().any(|p| p.0[0] != 0));
    let with: Vec<usize> = (0..scene.train.len()).filter(shows).collect();
    let from = if with.is_empty() { (0..scene.train.len()).collect() } else { with };
    let count = SHOWN.min(from.len());
    (0..count).map(|i| from[i * from.len() / count]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(complete: Option<u32>) -> Record {
        Record {
            version: "1.2.3".into(),
            device: "Device <1>".into(),
            scene: "/somewhere/garden & <gate>".into(),
            command: "gscream-vk train 'garden & <gate>'".into(),
            complete,
            asked: None,
            inputs: None,
        }
    }

    fn line(step: u32, psnr: Option<f64>) -> Value {
        serde_json::json!({ "step": step, "seconds": f64::from(step), "mean_loss": 1.0 / f64::from(step),
            "psnr": psnr, "masked_psnr": null, "anchors": 100 + step })
    }

    fn text(complete: Option<u32>, test: &[Pair]) -> String {
        let log: Vec<Value> = (1..=300).map(|i| line(i, (i >= 100).then_some(20.0 + f64::from(i / 100)))).collect();
        let metrics = serde_json::json!({
            "mean": { "full": { "psnr": 20.5, "ssim": 0.9, "flip": 0.1 }, "mask": { "psnr": "inf", "ssim": 1.0, "flip": 0.0 } },
            "views": [{ "name": "<a>", "full": { "psnr": 20.5, "ssim": 0.9, "flip": 0.1 } }],
        });
        let facts = Facts {
            folder: Path::new("runs/garden & <gate>"),
            record: &record(complete),
            settings: "[train]\niterations = 300\n",
            log: &log,
            metrics: &metrics,
        };
        page(&facts, test, &[]).expect("drawn")
    }

    #[test]
    fn names_are_escaped_and_nothing_comes_from_elsewhere() {
        let pair = Pair {
            name: "a \"b\" <c>#1".into(),
            size: [4, 3],
            photograph: "index/test/a \"b\" <c>#1.jpg".into(),
            drawn: "test/a \"b\" <c>#1.png".into(),
        };
        let page = text(Some(300), &[pair]);
        assert!(page.contains("src=\"index/test/a%20%22b%22%20%3Cc%3E%231.jpg\""), "{page}");
        assert!(!page.contains("<c>") && !page.contains("<gate>") && !page.contains("<1>") && !page.contains("<a>"));
        let elsewhere =
            page.match_indices("http").filter(|(at, _)| !page[*at..].starts_with("http://www.w3.org/2000/svg"));
        assert_eq!(elsewhere.count(), 0, "{page}");
        assert!(!page.contains("/somewhere"), "where the scene lies is nobody's business who reads the page");
        for part in ["Complete: 300 steps", "20.50", "inf", "garden &amp; &lt;gate&gt;", "<svg", "type=\"range\""] {
            assert!(page.contains(part), "no {part:?} in {page}");
        }
    }

    #[test]
    fn a_run_that_ended_early_says_how_to_go_on() {
        let page = text(None, &[]);
        let go_on = "gscream-vk train --resume 'runs/garden &amp; &lt;gate&gt;'";
        assert!(page.contains(go_on) && page.contains("of step 300") && !page.contains("Test views"), "{page}");
    }

    #[test]
    fn curves_are_thinned_and_say_each_evaluation_once() {
        let log: Vec<Value> = (1..=300).map(|i| line(i, (i >= 100).then_some(f64::from(i / 100)))).collect();
        let figure = curves(&log);
        let marks = |i: usize| &figure.panels[i].series[0].marks;
        assert_eq!(figure.panels.len(), 3, "no masked PSNR");
        assert_eq!((marks(0).len(), marks(0)[59].at), (60, (300.0, 1.0 / 300.0)));
        assert_eq!(marks(1).iter().map(|m| m.at).collect::<Vec<_>>(), [(100.0, 1.0), (200.0, 2.0), (300.0, 3.0)]);
        assert!(curves(&[]).panels.is_empty());
    }
}

//! The contact sheet: every train view with its mask, and the reference, as one PNG and a page around it.

use image::{Rgb, RgbImage};
use maud::{DOCTYPE, Markup, html};

use super::doctor::{Report, Severity};
use super::{Scene, resample};

/// Width of a thumbnail, pixels.
const WIDTH: u32 = 192;
/// Thumbnails in a row.
const COLUMNS: u32 = 8;
/// The PNG's name beside the page.
pub const PICTURE: &str = "sheet.png";
/// The page's name.
pub const PAGE: &str = "sheet.html";

/// A sheet: the picture, and the names of its cells in order.
pub struct Sheet {
    /// Cells row by row.
    pub picture: RgbImage,
    /// Width and height of a cell, pixels.
    pub cell: [u32; 2],
    /// What each shows.
    pub names: Vec<String>,
}

/// Draws the sheet of a scene: masks are tinted red with a yellow border; the reference picture comes last, and behind it,
/// where `prepare` has noted it (`provenance`, as large as the photograph), what other views see of its hole (green) and what
/// none does (red).
pub fn draw(scene: &Scene, provenance: Option<&RgbImage>) -> Sheet {
    let tallest = scene.train.iter().map(|view| view.camera.size).map(|[w, h]| f64::from(h) / f64::from(w));
    let height = (f64::from(WIDTH) * tallest.fold(0.1, f64::max)).round().max(1.0) as u32;
    let cell = [WIDTH, height];
    let mut cells: Vec<(String, RgbImage)> = vec![];
    for view in &scene.train {
        let [w, h] = view.camera.size;
        let to = [WIDTH, ((u64::from(WIDTH) * u64::from(h) / u64::from(w)).max(1) as u32).min(height)];
        let mut small = resample::photograph(&view.image, to);
        if let Some(mask) = &view.mask {
            let mask = if to[0] < w { resample::mask(mask, to) } else { resample::nearest(mask, to) };
            let on = |x: i64, y: i64| {
                let inside = x >= 0 && y >= 0 && x < i64::from(to[0]) && y < i64::from(to[1]);
                inside && mask.get_pixel(x as u32, y as u32).0[0] != 0
            };
            for (x, y, pixel) in small.enumerate_pixels_mut() {
                let (u, v) = (i64::from(x), i64::from(y));
                if on(u, v) {
                    let [r, g, b] = pixel.0;
                    let inner = on(u - 1, v) && on(u + 1, v) && on(u, v - 1) && on(u, v + 1);
                    *pixel = if inner { Rgb([r / 2 + 120, g / 2, b / 2]) } else { Rgb([255, 220, 40]) };
                }
            }
        }
        cells.push((view.name.clone(), small));
    }
    for reference in &scene.references {
        let view = &scene.train[reference.view];
        let [w, h] = view.camera.size;
        let to = [WIDTH, ((u64::from(WIDTH) * u64::from(h) / u64::from(w)).max(1) as u32).min(height)];
        let small = resample::photograph(&reference.image, to);
        let map = provenance.map(|map| {
            let map = image::imageops::resize(map, to[0], to[1], image::imageops::FilterType::Nearest);
            RgbImage::from_fn(to[0], to[1], |x, y| match map.get_pixel(x, y).0 {
                [0, 0, 0] => Rgb(small.get_pixel(x, y).0.map(|v| v / 3)),
                hole => Rgb(hole),
            })
        });
        cells.push((format!("{} (reference)", view.name), small));
        cells.extend(map.map(|map| (format!("{} (green: seen by others, red: by none)", view.name), map)));
    }
    let columns = COLUMNS.min(cells.len() as u32).max(1);
    let rows = (cells.len() as u32).div_ceil(columns);
    let mut picture = RgbImage::from_pixel(columns * cell[0], rows * cell[1], Rgb([24, 24, 24]));
    for (i, (_, small)) in cells.iter().enumerate() {
        let (column, row) = (i as u32 % columns, i as u32 / columns);
        image::imageops::replace(&mut picture, small, i64::from(column * cell[0]), i64::from(row * cell[1]));
    }
    Sheet { picture, cell, names: cells.into_iter().map(|(name, _)| name).collect() }
}

/// The page around the sheet, with what was found and a map of the cameras ([`super::map`]).
pub fn page(title: &str, sheet: &Sheet, map: &Markup, report: &Report) -> String {
    let [w, h] = sheet.cell;
    let columns = sheet.picture.width() / w.max(1);
    let thumbnail = |i: usize, name: &str| -> Markup {
        let (column, row) = (i as u32 % columns, i as u32 / columns);
        let style = format!("width:{w}px;height:{h}px;background:url({PICTURE}) -{}px -{}px", column * w, row * h);
        let figures = report.views.iter().find(|view| view.name == name);
        let of = |value: Option<f64>, text: &dyn Fn(f64) -> String| value.map(text);
        let lines = figures.into_iter().flat_map(|f| {
            [
                of(f.mask, &|v| format!("mask {:.1} %", 100.0 * v)),
                of(f.points_in_picture, &|v| format!("points {:.1} %", 100.0 * v)),
                of(f.depth_correlation, &|v| format!("depth {v:.2}")),
                of(f.exposure, &|v| format!("brightness {v:.2}")),
                of(f.iou, &|v| format!("IoU {v:.3}")),
            ]
        });
        let lines: Vec<String> = lines.flatten().collect();
        html! { figure { div style=(style) {} figcaption { b { (name) } br; (lines.join(", ")) } } }
    };
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                title { (title) }
                style {
                    "body{font:14px/1.4 system-ui,sans-serif;margin:1.5em;background:#fff;color:#222}"
                    "figure{display:inline-block;margin:0 .6em .8em 0;vertical-align:top}"
                    "figcaption{font-size:12px;max-width:192px;overflow-wrap:anywhere}"
                    ".problem{color:#b00020}.note{color:#555}"
                }
            }
            body {
                h1 { (title) }
                p { (report.verdict()) }
                ul {
                    @for finding in &report.findings {
                        @let class = if finding.severity == Severity::Problem { "problem" } else { "note" };
                        li class=(class) {
                            b { (finding.check) } " "
                            @if let Some(view) = &finding.view { (view) ": " }
                            (finding.message)
                        }
                    }
                }
                h2 { "The cameras from above" }
                (map)
                h2 { "Photographs" }
                @for (i, name) in sheet.names.iter().enumerate() { (thumbnail(i, name)) }
            }
        }
    };
    page.into_string()
}

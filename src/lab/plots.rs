//! Plots as SVG: panels side by side with one legend, a marker and a colour for each choice.
//!
//! Colours are those of Okabe and Ito and of Tol, told apart by every kind of colour vision; shapes differ as well, so that the plots
//! survive a black-and-white printer. A superfluous choice is hollow. Logarithmic axes never hold a zero: an error of
//! exactly zero has a strip of its own below the axis.

use plotters::backend::SVGBackend;
use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, IntoDrawingArea as _};
use plotters::element::{Circle, PathElement, Polygon, Rectangle};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{Color as _, FontTransform, IntoFont as _, RGBColor, ShapeStyle, TextStyle};

use super::report::Error;

/// Units of the drawing per pixel: coordinates of the backend are integers.
const UNITS: f64 = 4.0;

const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
const FAINT: RGBColor = RGBColor(0x66, 0x66, 0x66);
const GRID: RGBColor = RGBColor(0xe4, 0xe4, 0xe4);
const STRIP: RGBColor = RGBColor(0xf4, 0xf4, 0xf4);
const FRONT: RGBColor = RGBColor(0xc8, 0xc8, 0xc8);

/// Okabe and Ito (2008) without the yellow, which a white page swallows, then Tol's muted scheme.
const COLORS: [RGBColor; 11] = [
    RGBColor(0x00, 0x00, 0x00),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x88, 0x22, 0x55),
    RGBColor(0x99, 0x99, 0x33),
    RGBColor(0x33, 0x22, 0x88),
    RGBColor(0x77, 0x77, 0x77),
];

/// How an axis runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Equal distances for equal differences.
    Linear,
    /// Equal distances for equal factors.
    Log,
}

/// An axis.
#[derive(Clone, Debug)]
pub struct Axis {
    /// What it shows, with its unit.
    pub label: String,
    /// How it runs.
    pub scale: Scale,
}

/// A measured point with its spread.
#[derive(Clone, Copy, Debug)]
pub struct Mark {
    /// Where it is; on a logarithmic axis more than zero, but for a `y` of exactly zero.
    pub at: (f64, f64),
    /// Quartiles of x.
    pub quartiles: Option<[f64; 2]>,
    /// Extremes of x.
    pub x_range: Option<[f64; 2]>,
    /// Extremes of y.
    pub y_range: Option<[f64; 2]>,
    /// Drawn hollow: superfluous.
    pub hollow: bool,
    /// On the Pareto front.
    pub front: bool,
}

/// The points of one choice.
#[derive(Clone, Debug)]
pub struct Series {
    /// Index of the choice in the legend: its colour and shape.
    pub style: usize,
    /// In the order in which a line joins them.
    pub marks: Vec<Mark>,
}

/// One diagram.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Its heading.
    pub title: String,
    /// A remark under the heading.
    pub note: String,
    /// Across.
    pub x: Axis,
    /// Up.
    pub y: Axis,
    /// What is drawn.
    pub series: Vec<Series>,
    /// Whether a choice's points are joined.
    pub joined: bool,
}

/// Panels side by side with one legend.
#[derive(Clone, Debug)]
pub struct Figure {
    /// What it shows, for those who cannot see it.
    pub description: String,
    /// Names of the choices, by style.
    pub legend: Vec<String>,
    /// What the marks mean.
    pub footnote: String,
    /// The diagrams, row by row.
    pub panels: Vec<Panel>,
    /// How many stand side by side.
    pub columns: usize,
    /// Width and height of one panel, pixels.
    pub panel: [f64; 2],
}

const TEXT: f64 = 12.0;
const SMALL: f64 = 10.5;
const LEGEND_ROW: f64 = 20.0;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn unit(value: f64) -> i32 {
    (value * UNITS).round() as i32
}

fn point((x, y): (f64, f64)) -> (i32, i32) {
    (unit(x), unit(y))
}

fn failed(error: impl std::fmt::Display) -> Error {
    Error::Plot(error.to_string())
}

/// About the width of a text, pixels: the fonts of whoever looks are not known.
fn width_of(text: &str, size: f64) -> f64 {
    0.5 * size * text.chars().count() as f64
}

/// Draws in pixels.
struct Pen<'a> {
    area: Area<'a>,
}

impl Pen<'_> {
    fn line(&self, path: &[(f64, f64)], color: RGBColor, width: f64) -> Result<(), Error> {
        let style = ShapeStyle::from(color).stroke_width(unit(width).max(1) as u32);
        let path: Vec<_> = path.iter().copied().map(point).collect();
        self.area.draw(&PathElement::new(path, style)).map_err(failed)
    }

    fn fill(&self, from: (f64, f64), to: (f64, f64), color: RGBColor) -> Result<(), Error> {
        self.area.draw(&Rectangle::new([point(from), point(to)], color.filled())).map_err(failed)
    }

    fn text(
        &self,
        text: &str,
        at: (f64, f64),
        size: f64,
        color: RGBColor,
        (horizontal, vertical): (HPos, VPos),
    ) -> Result<(), Error> {
        // The backend divides by the ratio that it takes a font's height to have.
        let style = TextStyle::from(("sans-serif", 1.24 * size * UNITS).into_font())
            .color(&color)
            .pos(Pos::new(horizontal, vertical));
        self.area.draw_text(text, &style, point(at)).map_err(failed)
    }

    fn upwards(&self, text: &str, at: (f64, f64), size: f64, color: RGBColor) -> Result<(), Error> {
        let font = ("sans-serif", 1.24 * size * UNITS).into_font().transform(FontTransform::Rotate270);
        let style = TextStyle::from(font).color(&color).pos(Pos::new(HPos::Center, VPos::Center));
        self.area.draw_text(text, &style, point(at)).map_err(failed)
    }

    /// The marker of a choice.
    fn marker(&self, style: usize, (x, y): (f64, f64), radius: f64, hollow: bool) -> Result<(), Error> {
        let color = COLORS[style % COLORS.len()];
        let outline = ShapeStyle::from(color).stroke_width(unit(1.6) as u32);
        let white = RGBColor(255, 255, 255);
        let corners = shape(style);
        if corners.is_empty() {
            let inside = if hollow { white.filled() } else { color.filled() };
            let radius = unit(radius);
            self.area.draw(&Circle::new(point((x, y)), radius, inside)).map_err(failed)?;
            return self.area.draw(&Circle::new(point((x, y)), radius, outline)).map_err(failed);
        }
        let mut path: Vec<_> = corners.iter().map(|(dx, dy)| point((x + dx * radius, y + dy * radius))).collect();
        let inside = if hollow { white.filled() } else { color.filled() };
        self.area.draw(&Polygon::new(path.clone(), inside)).map_err(failed)?;
        path.push(path[0]);
        self.area.draw(&PathElement::new(path, outline)).map_err(failed)
    }
}

/// Corners of the shape of a choice around the origin; none for a circle.
fn shape(style: usize) -> Vec<(f64, f64)> {
    let star = |corners: usize, turn: f64, radius: &dyn Fn(usize) -> f64| -> Vec<(f64, f64)> {
        (0..corners)
            .map(|i| {
                let angle = std::f64::consts::TAU * (i as f64 / corners as f64 + turn);
                (radius(i) * angle.sin(), -radius(i) * angle.cos())
            })
            .collect()
    };
    let cross = |width: f64| {
        let (a, b) = (width, 1.15);
        vec![(-a, -b), (a, -b), (a, -a), (b, -a), (b, a), (a, a), (a, b), (-a, b), (-a, a), (-b, a), (-b, -a), (-a, -a)]
    };
    match style % 9 {
        0 => vec![],
        1 => star(4, 0.125, &|_| 1.25),
        2 => star(3, 0.0, &|_| 1.3),
        3 => star(4, 0.0, &|_| 1.3),
        4 => star(3, 0.5, &|_| 1.3),
        5 => cross(0.42),
        6 => star(10, 0.0, &|i| if i % 2 == 0 { 1.45 } else { 0.62 }),
        7 => star(6, 0.0, &|_| 1.15),
        _ => {
            let (sin, cos) = std::f64::consts::FRAC_PI_4.sin_cos();
            cross(0.42).into_iter().map(|(x, y)| (x * cos - y * sin, x * sin + y * cos)).collect()
        }
    }
}

/// Draws a figure.
///
/// # Errors
/// What the backend meets.
pub fn draw(figure: &Figure) -> Result<String, Error> {
    let [panel_width, panel_height] = figure.panel;
    let columns = figure.columns.min(figure.panels.len()).max(1);
    let width = panel_width * columns as f64;
    let places = legend_places(&figure.legend, width);
    let legend_height = places.last().map_or(0.0, |(_, y)| y + LEGEND_ROW) + 8.0;
    let rows = figure.panels.len().div_ceil(columns);
    let height = legend_height + panel_height * rows as f64 + 24.0;
    let mut svg = String::new();
    {
        let pen = Pen {
            area: SVGBackend::with_string(&mut svg, (unit(width) as u32, unit(height) as u32)).into_drawing_area(),
        };
        pen.fill((0.0, 0.0), (width, height), RGBColor(255, 255, 255))?;
        for (style, (name, (x, y))) in figure.legend.iter().zip(&places).enumerate() {
            let middle = y + LEGEND_ROW / 2.0;
            pen.marker(style, (x + 8.0, middle), 4.5, false)?;
            pen.text(name, (x + 19.0, middle), TEXT, INK, (HPos::Left, VPos::Center))?;
        }
        for (i, panel) in figure.panels.iter().enumerate() {
            let (column, row) = (i % columns, i / columns);
            let corner = (panel_width * column as f64, legend_height + panel_height * row as f64);
            draw_panel(&pen, panel, corner, figure.panel)?;
        }
        pen.text(&figure.footnote, (8.0, height - 10.0), SMALL, FAINT, (HPos::Left, VPos::Center))?;
        pen.area.present().map_err(failed)?;
    }
    Ok(finish(&svg, [width, height], &figure.description))
}

/// Left ends of the legend's entries, in rows as wide as the figure.
fn legend_places(names: &[String], width: f64) -> Vec<(f64, f64)> {
    let (mut x, mut y) = (8.0, 4.0);
    let mut places = vec![];
    for name in names {
        let own = 19.0 + width_of(name, TEXT) + 18.0;
        if x > 8.0 && x + own > width {
            (x, y) = (8.0, y + LEGEND_ROW);
        }
        places.push((x, y));
        x += own;
    }
    places
}

/// The drawing's own size in pixels, and what it shows in words.
fn finish(svg: &str, [width, height]: [f64; 2], description: &str) -> String {
    let start = svg.find("viewBox").unwrap_or(0);
    let escaped = description.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;");
    format!("<svg width=\"{width}\" height=\"{height}\" role=\"img\" aria-label=\"{escaped}\" {}", &svg[start..])
}

/// Values along an axis, and where they lie.
struct Range {
    scale: Scale,
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Range {
    /// Around these values, drawn between two places. Values that the scale cannot show do not count.
    fn around(scale: Scale, values: impl Iterator<Item = f64>, (from, to): (f64, f64)) -> Self {
        let usable = |v: &f64| v.is_finite() && (scale == Scale::Linear || *v > 0.0);
        let values: Vec<f64> = values.filter(usable).map(|v| Self::coordinate(scale, v)).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (low, high) = if low > high { (0.0, 1.0) } else { (low, high) };
        // At least a third of a decade, or a little of the value, so that noise does not fill the panel; and of small
        // numbers enough for two powers of ten or their triples, which alone are written briefly.
        let least = match scale {
            Scale::Log if high < -2.0 => 1.3,
            Scale::Log => 0.35,
            Scale::Linear => (0.02 * high.abs()).max(1e-9),
        };
        let margin = (0.07 * (high - low)).max(0.5 * (least - (high - low)));
        Self { scale, low: low - margin, high: high + margin, from, to }
    }

    fn coordinate(scale: Scale, value: f64) -> f64 {
        if scale == Scale::Log { value.log10() } else { value }
    }

    fn place(&self, value: f64) -> f64 {
        let share = (Self::coordinate(self.scale, value) - self.low) / (self.high - self.low);
        self.from + share * (self.to - self.from)
    }

    /// Round values within the range with what is written beside them.
    fn ticks(&self) -> Vec<(f64, String)> {
        let linear = |low: f64, high: f64, most: f64| {
            let rough = (high - low) / most;
            let power = 10f64.powf(rough.log10().floor());
            let step = power * [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * power >= rough).unwrap_or(10.0);
            let digits = (-step.log10().floor()).max(0.0) as usize;
            // A bound that is itself round may have been rounded past.
            let first = (low / step - 1e-9).ceil() as i64;
            let last = (high / step + 1e-9).floor() as i64;
            (first..=last).map(|i| i as f64 * step).map(|v| (v, format!("{v:.digits$}"))).collect::<Vec<_>>()
        };
        if self.scale == Scale::Linear {
            return linear(self.low, self.high, 6.0);
        }
        let span = self.high - self.low;
        let decades = self.low.ceil() as i32..=self.high.floor() as i32;
        if span > 2.5 {
            let every = (span / 6.0).ceil() as i32;
            return decades.filter(|d| d.rem_euclid(every) == 0).map(|d| (10f64.powi(d), power(d))).collect();
        }
        let factors: &[i32] = if span > 1.2 { &[1, 3] } else { &[1, 2, 5] };
        let floor = self.low.floor() as i32;
        let values = (floor..=self.high.floor() as i32).flat_map(|d| factors.iter().map(move |f| (*f, d)));
        let inside = |v: f64| (self.low..=self.high).contains(&v.log10());
        let ticks: Vec<(f64, String)> =
            values.map(|(f, d)| (f64::from(f) * 10f64.powi(d), written(f, d))).filter(|(v, _)| inside(*v)).collect();
        if ticks.len() >= 2 { ticks } else { linear(10f64.powf(self.low), 10f64.powf(self.high), 4.0) }
    }
}

/// `10^d` as people write it.
fn power(d: i32) -> String {
    match d {
        -2..=3 => format!("{}", 10f64.powi(d)),
        _ => {
            let digit = |c: char| match c {
                '-' => '⁻',
                '1' => '¹',
                '2' => '²',
                '3' => '³',
                digit => char::from_u32(0x2070 + u32::from(digit) - u32::from('0')).unwrap_or(digit),
            };
            format!("10{}", d.to_string().chars().map(digit).collect::<String>())
        }
    }
}

fn written(factor: i32, d: i32) -> String {
    match (factor, d) {
        (1, _) => power(d),
        (_, -3..=4) => {
            let digits = usize::try_from(-d).unwrap_or(0);
            format!("{:.digits$}", f64::from(factor) * 10f64.powi(d))
        }
        _ => format!("{factor}·{}", power(d)),
    }
}

fn draw_panel(pen: &Pen<'_>, panel: &Panel, (x0, y0): (f64, f64), [width, height]: [f64; 2]) -> Result<(), Error> {
    let (left, right) = (x0 + 62.0, x0 + width - 14.0);
    let top = y0 + if panel.note.is_empty() { 28.0 } else { 42.0 };
    let bottom = y0 + height - 44.0;
    let marks = || panel.series.iter().flat_map(|s| &s.marks);
    let exact = panel.y.scale == Scale::Log && marks().any(|m| m.at.1 == 0.0);
    let floor = if exact { bottom - 20.0 } else { bottom };
    let xs = marks().flat_map(|m| [m.at.0].into_iter().chain(m.x_range.into_iter().flatten()));
    let ys = marks().flat_map(|m| [m.at.1].into_iter().chain(m.y_range.into_iter().flatten()));
    let x = Range::around(panel.x.scale, xs, (left, right));
    let y = Range::around(panel.y.scale, ys, (floor, top));

    pen.text(&panel.title, (left, y0 + 13.0), TEXT + 1.0, INK, (HPos::Left, VPos::Center))?;
    if !panel.note.is_empty() {
        pen.text(&panel.note, (left, y0 + 30.0), SMALL, FAINT, (HPos::Left, VPos::Center))?;
    }
    for (value, text) in x.ticks() {
        let at = x.place(value);
        pen.line(&[(at, top), (at, bottom)], GRID, 0.8)?;
        pen.text(&text, (at, bottom + 11.0), SMALL, INK, (HPos::Center, VPos::Center))?;
    }
    for (value, text) in y.ticks() {
        let at = y.place(value);
        pen.line(&[(left, at), (right, at)], GRID, 0.8)?;
        pen.text(&text, (left - 6.0, at), SMALL, INK, (HPos::Right, VPos::Center))?;
    }
    let zero = 0.5 * (floor + bottom);
    if exact {
        pen.fill((left, floor), (right, bottom), STRIP)?;
        pen.text("0", (left - 6.0, zero), SMALL, INK, (HPos::Right, VPos::Center))?;
    }
    pen.line(&[(left, top), (left, bottom), (right, bottom)], INK, 1.0)?;
    pen.text(&panel.x.label, (0.5 * (left + right), y0 + height - 16.0), SMALL, FAINT, (HPos::Center, VPos::Center))?;
    pen.upwards(&panel.y.label, (x0 + 12.0, 0.5 * (top + bottom)), SMALL, FAINT)?;

    let shown = |m: &&Mark| {
        let fits = |scale: Scale, v: f64| v.is_finite() && (scale == Scale::Linear || v > 0.0);
        fits(panel.x.scale, m.at.0) && (fits(panel.y.scale, m.at.1) || (exact && m.at.1 == 0.0))
    };
    let place = |m: &Mark| (x.place(m.at.0), if exact && m.at.1 == 0.0 { zero } else { y.place(m.at.1) });
    let mut front: Vec<(f64, f64)> = marks().filter(shown).filter(|m| m.front).map(place).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    if front.len() > 1 {
        // What was best so far stays best until the next point is reached.
        let steps = front.windows(2).flat_map(|pair| [pair[0], (pair[1].0, pair[0].1)]);
        let path: Vec<(f64, f64)> = steps.chain(front.last().copied()).collect();
        pen.line(&path, FRONT, 5.0)?;
    }
    for series in &panel.series {
        let color = COLORS[series.style % COLORS.len()];
        let path: Vec<(f64, f64)> = series.marks.iter().filter(shown).map(place).collect();
        if panel.joined && path.len() > 1 {
            pen.line(&path, color, 1.4)?;
        }
        for mark in series.marks.iter().filter(shown) {
            let (at_x, at_y) = place(mark);
            if let Some([low, high]) = mark.x_range {
                pen.line(&[(x.place(low), at_y), (x.place(high), at_y)], color, 0.8)?;
            }
            if let Some([low, high]) = mark.quartiles {
                pen.line(&[(x.place(low), at_y), (x.place(high), at_y)], color, 3.0)?;
            }
            if let Some([low, high]) = mark.y_range.filter(|[low, high]| low < high) {
                pen.line(&[(at_x, y.place(low)), (at_x, y.place(high))], color, 1.0)?;
            }
        }
    }
    for series in &panel.series {
        for mark in series.marks.iter().filter(shown) {
            let radius = if panel.joined { 3.2 } else { 4.5 };
            pen.marker(series.style, place(mark), radius, mark.hollow)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(range: &Range) -> Vec<String> {
        range.ticks().into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn ticks_are_round() {
        let log =
            |low: f64, high: f64| Range { scale: Scale::Log, low: low.log10(), high: high.log10(), from: 0.0, to: 1.0 };
        assert_eq!(texts(&log(2e-8, 0.5)), ["10⁻⁶", "10⁻⁴", "0.01"]);
        assert_eq!(texts(&log(1.5, 60.0)), ["3", "10", "30"]);
        assert_eq!(texts(&log(15.0, 70.0)), ["20", "50"]);
        assert_eq!(texts(&log(12.0, 17.0)), ["12", "14", "16"]);
        let linear = Range { scale: Scale::Linear, low: 19.7, high: 24.2, from: 0.0, to: 1.0 };
        assert_eq!(texts(&linear), ["20", "21", "22", "23", "24"]);
        let fine = Range { scale: Scale::Linear, low: 0.11, high: 0.29, from: 0.0, to: 1.0 };
        assert_eq!(texts(&fine), ["0.15", "0.20", "0.25"]);
    }

    #[test]
    fn places_on_an_axis() {
        let range = Range { scale: Scale::Log, low: 0.0, high: 2.0, from: 100.0, to: 300.0 };
        assert_eq!((range.place(1.0), range.place(10.0), range.place(100.0)), (100.0, 200.0, 300.0));
        let around = Range::around(Scale::Log, [0.0, f64::NAN, 1.0, 100.0].into_iter(), (0.0, 1.0));
        assert!(around.low < 0.0 && around.low > -0.5 && around.high > 2.0, "zero does not count");
        let none = Range::around(Scale::Linear, std::iter::empty(), (0.0, 1.0));
        let small = Range::around(Scale::Log, [1.1e-8].into_iter(), (0.0, 1.0));
        assert_eq!(texts(&small), ["3·10⁻⁹", "10⁻⁸", "3·10⁻⁸"]);
        assert!(none.low < none.high);
    }

    /// A point of exactly zero lies in the strip below the axis; what is not finite is not drawn.
    #[test]
    fn zero_has_its_own_strip() {
        let mark =
            |y| Mark { at: (1.0, y), quartiles: None, x_range: None, y_range: None, hollow: false, front: false };
        let axis = |label: &str| Axis { label: label.into(), scale: Scale::Log };
        let figure = |ys: &[f64]| Figure {
            description: "a < b & \"c\"".into(),
            legend: vec!["one".into()],
            footnote: String::new(),
            panels: vec![Panel {
                title: "panel".into(),
                note: String::new(),
                x: axis("ms"),
                y: axis("error"),
                series: vec![Series { style: 0, marks: ys.iter().map(|y| mark(*y)).collect() }],
                joined: false,
            }],
            columns: 1,
            panel: [300.0, 200.0],
        };
        let circles = |ys: &[f64]| draw(&figure(ys)).expect("drawn").matches("<circle").count();
        // Two for the legend, two per point: inside and outline.
        assert_eq!(circles(&[1e-6]), 4);
        assert_eq!(circles(&[1e-6, 0.0]), 6);
        assert_eq!(circles(&[1e-6, f64::NAN, f64::INFINITY]), 4);
        let svg = draw(&figure(&[1e-6, 0.0])).expect("drawn");
        assert!(svg.contains("aria-label=\"a &lt; b &amp; &quot;c&quot;\""), "{svg}");
        assert!(svg.starts_with("<svg width=\"300\"") && !svg.contains("NaN"));
    }

    #[test]
    fn legends_wrap() {
        let names: Vec<String> = (0..6).map(|i| format!("choice number {i}")).collect();
        let places = legend_places(&names, 400.0);
        assert!(places.iter().all(|(x, _)| *x < 400.0) && places[5].1 > places[0].1);
    }
}

//! What a user says of a photograph: clicks, boxes, lassos and strokes of a brush.

use image::{GrayImage, Luma, RgbImage};
use serde::{Deserialize, Serialize};

/// A user's mark in a photograph. Positions are parts of its width and height, 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Mark {
    /// The object is here.
    Object {
        /// Where.
        at: [f64; 2],
        /// Steps to larger parts than the click takes by itself, below zero to smaller ones.
        #[serde(default, skip_serializing_if = "is_zero")]
        scale: i32,
    },
    /// The object is not here.
    Background {
        /// Where.
        at: [f64; 2],
    },
    /// The object is in here, and fills it: x0, y0, x1, y1.
    Box {
        /// Where.
        bounds: [f64; 4],
    },
    /// The object is within this rough line around it, which closes itself.
    Lasso {
        /// The line's corners.
        points: Vec<[f64; 2]>,
    },
    /// The object is along this line, or is not, whatever it looks like there.
    Brush {
        /// Which of the two.
        object: bool,
        /// Half of the line's width, of the picture's longer side.
        radius: f64,
        /// The line's corners.
        points: Vec<[f64; 2]>,
    },
}

fn is_zero(scale: &i32) -> bool {
    *scale == 0
}

/// Least side of a box or lasso, of the photograph's.
const LEAST_SIDE: f64 = 0.004;
/// Most corners of a line.
pub const MOST_POINTS: usize = 400;
/// Steps to larger or smaller segments at most.
const MOST_STEPS: i32 = 30;
/// Largest half width of a brush, of the picture's longer side.
const MOST_RADIUS: f64 = 0.25;
/// Radius of what a click touches, of the picture's longer side.
const TOUCH: f64 = 0.006;
/// Likewise at least, in pixels: a click on a small picture touches those around its own.
const LEAST_TOUCH: f64 = 1.5;
/// The weight of being in the middle of a box, and far from a lasso's line, in nats.
const AMID: [f64; 2] = [2.0, 5.0];
/// The weight of being in a box's corner, in nats.
const CORNER: f64 = 1.0;
/// So far from a box's middle, in halves of its sides, is as likely the object as not.
const ROUND: f64 = 0.95;
/// So far from a lasso's line, in roots of what it encloses, is as likely the object as not.
const MARGIN: f64 = 0.08;
/// The part of that weight that being at a lasso's line has against the object: a close one cuts into it.
const AT_LINE: f64 = 0.3;
/// A box's side so near to the picture's is that.
const EDGE: f64 = 0.005;
/// Colours that differ by less, of 255, are touched by the same click.
const ALIKE: f64 = 24.0;

impl Mark {
    /// Whether it lies within the photograph; a box and a lasso must have an inside.
    pub fn is_sound(&self) -> bool {
        let within = |v: &f64| (0.0..=1.0).contains(v);
        let line = |points: &[[f64; 2]]| points.len() <= MOST_POINTS && points.iter().flatten().all(within);
        let wide = |[x0, y0, x1, y1]: [f64; 4]| x1 - x0 >= LEAST_SIDE && y1 - y0 >= LEAST_SIDE;
        match self {
            Self::Object { at, scale } => at.iter().all(within) && (-MOST_STEPS..=MOST_STEPS).contains(scale),
            Self::Background { at } => at.iter().all(within),
            Self::Box { bounds } => bounds.iter().all(within) && wide(*bounds),
            Self::Lasso { points } => points.len() >= 3 && line(points) && self.bounds().is_some_and(wide),
            Self::Brush { radius, points, .. } => {
                !points.is_empty() && line(points) && *radius > 0.0 && *radius <= MOST_RADIUS
            }
        }
    }

    /// Where a click is, and whether it is on the object; nothing for other marks.
    pub(super) fn click(&self) -> Option<([f64; 2], bool)> {
        match self {
            Self::Object { at, .. } => Some((*at, true)),
            Self::Background { at } => Some((*at, false)),
            _ => None,
        }
    }

    /// x0, y0, x1, y1 of a box or a lasso; nothing for other marks.
    pub fn bounds(&self) -> Option<[f64; 4]> {
        match self {
            Self::Box { bounds } => Some(*bounds),
            Self::Lasso { points } => {
                let of = |axis: usize, start: f64, pick: fn(f64, f64) -> f64| {
                    points.iter().map(|point| point[axis]).fold(start, pick)
                };
                let (low, high) = (f64::INFINITY, f64::NEG_INFINITY);
                Some([of(0, low, f64::min), of(1, low, f64::min), of(0, high, f64::max), of(1, high, f64::max)])
            }
            _ => None,
        }
    }

    /// Whether a place lies within a box or a lasso; not for other marks.
    pub(super) fn encloses(&self, [x, y]: [f64; 2]) -> bool {
        match self {
            Self::Box { bounds: [x0, y0, x1, y1] } => x >= *x0 && x <= *x1 && y >= *y0 && y <= *y1,
            // By the crossings of the line with a ray to the left.
            Self::Lasso { points } => {
                let last = points.iter().cycle().skip(points.len().saturating_sub(1));
                let crosses = |(a, b): (&[f64; 2], &[f64; 2])| {
                    (a[1] > y) != (b[1] > y) && x > a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
                };
                points.iter().zip(last).filter(|pair| crosses(*pair)).count() % 2 == 1
            }
            _ => false,
        }
    }

    /// By how much being at a place within a box or a lasso speaks for the object, in nats; `deep` is how far it is from the line, in
    /// roots of what that encloses.
    pub(super) fn amid(&self, at: [f64; 2], deep: f64) -> f64 {
        match self {
            Self::Box { bounds: [x0, y0, x1, y1] } => {
                // Where the picture ends the object may go on.
                let off = |at: f64, low: f64, high: f64| {
                    let off: f64 = (2.0 * at - low - high) / (high - low);
                    if off < 0.0 && low <= EDGE || off > 0.0 && high >= 1.0 - EDGE { 0.0 } else { off }
                };
                let far = off(at[0], *x0, *x1).powi(2) + off(at[1], *y0, *y1).powi(2);
                (AMID[0] * (1.0 - far / ROUND.powi(2))).max(-CORNER)
            }
            Self::Lasso { .. } => AMID[1] * (deep / MARGIN - 1.0).clamp(-AT_LINE, 1.0),
            _ => 0.0,
        }
    }

    /// The pixels that a click or a brush speaks of for certain: of a click, those of its colour that hang together with it.
    pub(super) fn certain(&self, picture: &RgbImage, marks: &[Self]) -> Vec<[u32; 2]> {
        let [w, h] = [picture.width(), picture.height()];
        let full = [w, h].map(f64::from);
        let longest = full[0].max(full[1]);
        if let Self::Brush { radius, points, .. } = self {
            return stroke(points.iter().map(|p| [p[0] * full[0], p[1] * full[1]]), radius * longest, [w, h]);
        }
        let Some((at, object)) = self.click() else { return vec![] };
        let pixel =
            |at: [f64; 2]| -> [u32; 2] { std::array::from_fn(|k| ((at[k] * full[k]) as u32).min([w, h][k] - 1)) };
        let own = pixel(at);
        let far =
            |a: [u32; 2], b: [u32; 2]| f64::hypot(f64::from(a[0]) - f64::from(b[0]), f64::from(a[1]) - f64::from(b[1]));
        let others: Vec<[u32; 2]> = marks
            .iter()
            .filter_map(Self::click)
            .filter(|other| other.1 != object)
            .map(|other| pixel(other.0))
            .collect();
        let color = picture.get_pixel(own[0], own[1]).0;
        let alike = |p: [u32; 2]| {
            let other = picture.get_pixel(p[0], p[1]).0;
            (0..3).map(|c| (f64::from(color[c]) - f64::from(other[c])).powi(2)).sum::<f64>() <= ALIKE * ALIKE
        };
        let (mut all, mut next) = (vec![own], 0);
        while let Some([x, y]) = all.get(next).copied() {
            next += 1;
            for [dx, dy] in [[-1i64, 0], [1, 0], [0, -1], [0, 1]] {
                let (u, v) = (i64::from(x) + dx, i64::from(y) + dy);
                if u < 0 || v < 0 || u >= i64::from(w) || v >= i64::from(h) {
                    continue;
                }
                let p = [u as u32, v as u32];
                let nearer = others.iter().all(|other| far(p, own) < far(p, *other));
                if far(p, own) <= (TOUCH * longest).max(LEAST_TOUCH) && nearer && alike(p) && !all.contains(&p) {
                    all.push(p);
                }
            }
        }
        all
    }

    /// Pixels that strokes of brushes cover in a picture of this size.
    pub fn brushed(strokes: &[Self], [w, h]: [u32; 2]) -> GrayImage {
        let (mut mask, picture) = (GrayImage::new(w, h), RgbImage::new(w, h));
        strokes.iter().for_each(|stroke| stroke.hold(&mut mask, &picture, strokes));
        mask
    }

    /// What it says of a mask for certain, made so.
    pub(super) fn hold(&self, mask: &mut GrayImage, picture: &RgbImage, marks: &[Self]) {
        let object = match self {
            Self::Object { .. } | Self::Brush { object: true, .. } => 255,
            _ => 0,
        };
        for [x, y] in self.certain(picture, marks) {
            mask.put_pixel(x, y, Luma([object]));
        }
    }
}

/// The pixels within a radius of a line through these places, all in pixels.
fn stroke(points: impl Iterator<Item = [f64; 2]>, radius: f64, size: [u32; 2]) -> Vec<[u32; 2]> {
    let points: Vec<[f64; 2]> = points.collect();
    let (first, last) = (points[0], points[points.len() - 1]);
    let mut all = std::collections::BTreeSet::new();
    // A line of one place is that place.
    let lines = points.windows(2).map(|pair| (pair[0], pair[1])).chain((points.len() == 1).then_some((first, last)));
    for (a, b) in lines {
        let range = |axis: usize| {
            let low = (a[axis].min(b[axis]) - radius).floor().max(0.0) as u32;
            low..((a[axis].max(b[axis]) + radius).ceil() as u32).min(size[axis])
        };
        let along = [b[0] - a[0], b[1] - a[1]];
        let square = along[0].powi(2) + along[1].powi(2);
        for y in range(1) {
            for x in range(0) {
                let d = [f64::from(x) + 0.5 - a[0], f64::from(y) + 0.5 - a[1]];
                let t = if square > 0.0 { ((d[0] * along[0] + d[1] * along[1]) / square).clamp(0.0, 1.0) } else { 0.0 };
                if f64::hypot(d[0] - t * along[0], d[1] - t * along[1]) <= radius.max(0.75) {
                    all.insert([x, y]);
                }
            }
        }
    }
    all.into_iter().collect()
}

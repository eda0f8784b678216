//! The cameras of a model from above: how a capture went, and where a model is torn or folded.
//!
//! Whoever walked around a thing sees a ring of cameras that look inwards. A folded model has two half rings on one side, a torn one a
//! piece that stands beside the rest, and a photograph that was matched wrongly stands where nobody was.

use glam::DVec3;
use maud::{Markup, html};

use super::{Camera, Point, up};
use crate::statistics::quantile;

/// Side of the map in its own units, which are pixels where it is not scaled.
const SIDE: f64 = 640.0;
/// Empty part on each side of what is looked for in a map.
const MARGIN: f64 = 0.1;
/// Length of the mark of a camera, as a part of the side.
const MARK: f64 = 0.022;
/// Points that are drawn, at most.
const POINTS: usize = 2000;
/// Share of the points that the map reaches to, in either direction.
const REACH: [f64; 2] = [0.05, 0.95];
/// Colours of parts, the largest first; those behind the last share it.
const COLORS: [&str; 6] = ["#1769c0", "#d05a00", "#2c8a3f", "#8a3fb0", "#a08000", "#555555"];

/// Where a photograph belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Standing {
    /// In this part of the model, the largest is 0.
    Part(usize),
    /// Left out of the scene.
    Out,
}

/// A photograph on the map.
#[derive(Clone, Debug)]
pub struct Spot {
    /// The photograph's name.
    pub name: String,
    /// The camera's centre, world coordinates.
    pub center: [f64; 3],
    /// Unit vector along which it looks, world coordinates.
    pub ahead: [f64; 3],
    /// Where it belongs.
    pub standing: Standing,
}

/// The map of these photographs and points, in the same coordinates as the cameras that tell which way is up. Who stands beyond its
/// border is drawn on that.
pub fn draw(cameras: &[Camera], spots: &[Spot], points: &[Point]) -> Markup {
    let turn = up::upright(cameras);
    // Right and ahead: what is down is not seen from above.
    let flat = |point: [f64; 3]| {
        let point = turn * DVec3::from(point);
        [point.x, point.z]
    };
    let of_points: Vec<[f64; 2]> = points
        .iter()
        .step_by(points.len().div_ceil(POINTS).max(1))
        .map(|point| flat(point.position.map(f64::from)))
        .collect();
    let inside = || spots.iter().filter(|spot| spot.standing != Standing::Out).map(|spot| flat(spot.center));
    let range = |k: usize| {
        let ends = REACH.map(|share| quantile(of_points.iter().map(|point| point[k]), share));
        let all = inside().map(|place| place[k]).chain(ends.into_iter().flatten());
        all.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
    };
    let ranges = [range(0), range(1)];
    let longer = ranges.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
    let scale = if longer > 0.0 { SIDE * (1.0 - 2.0 * MARGIN) / longer } else { 1.0 };
    let place = |[x, z]: [f64; 2]| {
        let middle = ranges.map(|[low, high]| if low <= high { 0.5 * (low + high) } else { 0.0 });
        [0.5 * SIDE + (x - middle[0]) * scale, 0.5 * SIDE - (z - middle[1]) * scale]
    };
    let edge = MARK * SIDE;
    let mark = |spot: &Spot| {
        let [x, y] = place(flat(spot.center)).map(|v| v.clamp(1.5 * edge, SIDE - 1.5 * edge));
        let [right, ahead] = flat(spot.ahead);
        let length = right.hypot(ahead).max(1e-9);
        let [dx, dy] = [right / length * edge, -ahead / length * edge];
        let corner = |side: f64| format!("{:.1},{:.1}", x + dx - side * dy * 0.6, y + dy + side * dx * 0.6);
        format!("M{x:.1},{y:.1}L{}L{}Z", corner(1.0), corner(-1.0))
    };
    let look = |standing: Standing| match standing {
        Standing::Part(number) => (COLORS[number.min(COLORS.len() - 1)], COLORS[number.min(COLORS.len() - 1)]),
        Standing::Out => ("none", "#c00020"),
    };
    let mut kinds: Vec<Standing> = spots.iter().map(|spot| spot.standing).collect();
    kinds.sort_unstable();
    kinds.dedup();
    let words = |kind: Standing| {
        let count = spots.iter().filter(|spot| spot.standing == kind).count();
        let photographs = if count == 1 { "photograph" } else { "photographs" };
        match kind {
            Standing::Out => format!("{count} left out"),
            Standing::Part(number) if kinds.iter().filter(|kind| **kind != Standing::Out).count() > 1 => {
                format!("part {}: {count} {photographs}", number + 1)
            }
            Standing::Part(_) => format!("{count} {photographs}"),
        }
    };
    let within = |[x, y]: &[f64; 2]| [*x, *y].iter().all(|v| (0.0..=SIDE).contains(v));
    html! {
        svg viewBox=(format!("0 0 {SIDE} {SIDE}")) width=(SIDE) height=(SIDE) role="img" aria-label="the cameras from above" {
            rect width=(SIDE) height=(SIDE) fill="#f6f6f4" {}
            @for [x, y] in of_points.iter().map(|point| place(*point)).filter(within) {
                circle cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r="1" fill="#b8b8b0" {}
            }
            @for spot in spots {
                @let (fill, stroke) = look(spot.standing);
                path d=(mark(spot)) fill=(fill) fill-opacity="0.75" stroke=(stroke) { title { (spot.name) } }
            }
        }
        p {
            @for kind in &kinds {
                span style=(format!("color:{};margin-right:1.5em", look(*kind).1)) { "\u{25c0} " (words(*kind)) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of cameras that look inwards, the last of which was left out and stands far away.
    fn ring(n: usize) -> (Vec<Camera>, Vec<Spot>) {
        let one = |i: usize| {
            let angle = std::f64::consts::TAU * i as f64 / n as f64;
            let (center, ahead) =
                (DVec3::new(angle.sin(), -0.3, -angle.cos()), DVec3::new(-angle.sin(), 0.0, angle.cos()));
            let right = DVec3::Y.cross(ahead);
            let rotation = [right, DVec3::Y, ahead].map(|axis| axis.to_array().map(|v| v as f32));
            let camera = Camera {
                rotation,
                translation: Camera::translation_to(&rotation, center.to_array()),
                focal: [100.0; 2],
                principal: [50.0; 2],
                distortion: [0.0; 4],
                size: [100; 2],
            };
            let standing = Standing::Part(usize::from(2 * i >= n));
            (camera, Spot { name: format!("p{i}"), center: center.to_array(), ahead: ahead.to_array(), standing })
        };
        let (cameras, mut spots): (Vec<_>, Vec<_>) = (0..n).map(one).unzip();
        spots.last_mut().unwrap().standing = Standing::Out;
        spots.last_mut().unwrap().center = [1e4, 0.0, 0.0];
        (cameras, spots)
    }

    fn point(position: [f32; 3]) -> Point {
        Point { position, color: [0; 3] }
    }

    #[test]
    fn a_map_shows_every_camera_its_part_and_where_it_looks() {
        let (cameras, spots) = ring(12);
        let map = draw(&cameras, &spots, &[[0.0; 3], [0.2, 0.0, 0.1], [1e6; 3]].map(point)).into_string();
        assert!(spots.iter().all(|spot| map.contains(&format!("<title>{}</title>", spot.name))), "{map}");
        let marks: Vec<Vec<[f64; 2]>> = map
            .split("<path d=\"M")
            .skip(1)
            .map(|mark| {
                let corners = mark[..mark.find('Z').unwrap()].split('L');
                corners
                    .map(|at| {
                        let (x, y) = at.split_once(',').unwrap();
                        [x.parse().unwrap(), y.parse().unwrap()]
                    })
                    .collect()
            })
            .collect();
        let middle = |mark: &[[f64; 2]]| [0, 1].map(|k| 0.5 * (mark[1][k] + mark[2][k]));
        let off = |at: [f64; 2]| (at[0] - 0.5 * SIDE).hypot(at[1] - 0.5 * SIDE);
        assert!(marks[..11].iter().all(|mark| off(middle(mark)) < off(mark[0]) - 0.8 * MARK * SIDE), "{marks:?}");
        // The ring is as large as the map is, but for its margin, and nobody is outside.
        assert!(marks[..11].iter().all(|mark| off(mark[0]) < 0.5 * SIDE), "{marks:?}");
        assert!(marks[11].iter().flatten().all(|v| (0.0..=SIDE).contains(v)), "{marks:?}");
        for words in ["part 1: 6 photographs", "part 2: 5 photographs", "1 left out"] {
            assert!(map.contains(words), "{words}: {map}");
        }
        assert_eq!(
            [COLORS[0], COLORS[1], "#c00020"].map(|color| map.matches(&format!("stroke=\"{color}\"")).count()),
            [6, 5, 1]
        );
    }

    #[test]
    fn a_scene_of_one_camera_has_a_map() {
        let (cameras, spots) = ring(1);
        let spots = [Spot { standing: Standing::Part(0), ..spots[0].clone() }];
        let map = draw(&cameras, &spots, &[]).into_string();
        assert!(map.contains("1 photograph<") && !map.contains("NaN"), "{map}");
        assert!(!draw(&[], &[], &[]).into_string().contains("NaN"));
    }
}

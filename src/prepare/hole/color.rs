//! What the surface behind the object looks like: from photographs where one shows it, from views that are filled already,
//! else not known.
//!
//! For each site of a hole every photograph that shows its point is a source; which one it is taken from is chosen by alpha
//! expansion, so that large pieces come from one photograph. Colours are looked up at the full resolution, and sources are
//! blended over one site where they meet.

use glam::DVec3;
use rayon::prelude::*;

use super::gradient::{self, Equation};
use super::photograph::{Photograph, sample};
use super::relief::Relief;
use super::surface::{APART, SAME, Sight, Sights};
use super::window::Window;
use crate::prepare::planes::{self, neighbours};
use crate::scene::{Camera, resample};

/// Sources that a view's hole is taken from at most.
const SOURCES: usize = 12;
/// Cost of a source per radian between its ray and the view's.
const ANGLE: f64 = 2.0;
/// Cost of a source for each factor e that its resolution is coarser.
const COARSER: f64 = 1.0;
/// Cost of a source whose colour differs from the median of all sources by the whole range in all channels.
const UNLIKE: f64 = 8.0;
/// Cost of a site in a source that does not show it.
const HIDDEN: f64 = 1e3;
/// Views with a point in the picture of which one alone is not believed.
const MANY: usize = 16;
/// Mean difference of the channels from the median up to which photographs agree on the colour of a point.
const ALIKE: f64 = 0.04;
/// Views that look through a guessed point of which so many make it doubtful.
const THROUGH: usize = 2;
/// Share of a hole that is doubtful from which on all that is guessed in it is.
const DISTRUST: f64 = 0.25;
/// How far from a site what shows behind it may be known, sites.
const BEHIND: i64 = 5;
/// Share of a pixel's sites that must have a source for it to be seen.
const ENOUGH: f32 = 0.5;

/// The colours of a view's hole.
pub struct Filling {
    /// `[pixel]` RGB, 0 to 1: of the photograph outside the hole.
    pub rgb: Vec<[f32; 3]>,
    /// `[pixel]` whether it is in the hole and nothing has told its colour.
    pub guessed: Vec<bool>,
    /// `[pixel]` whether a photograph shows it.
    pub seen: Vec<bool>,
    /// `[pixel]` whether its depth is likely wrong, and with it what is shown: photographs disagree about it, or look through it.
    pub doubtful: Vec<bool>,
    /// `[pixel]` the surface that shows instead of the one that the view's site has, where another view looks through that.
    pub behind: Vec<Option<u8>>,
}

fn mean_focal(sight: &Sight) -> f64 {
    let [fx, fy] = sight.grid.camera.focal.map(f64::from);
    (fx * fy).sqrt()
}

/// Counts of the views that show a point, or do not.
#[derive(Default)]
struct Witnesses {
    /// How many show it.
    show: usize,
    /// How many of these have it right beside the object.
    beside: usize,
    /// Whether another view confirms the depth that one of them has there.
    confirmed: bool,
    /// How many have it in the picture, hidden or not.
    framed: usize,
    /// How many show what is farther away instead.
    through: usize,
}

impl Witnesses {
    /// Whether they are enough. One of many, whose depth nobody confirms, is wrong about what it shows.
    fn suffice(&self) -> bool {
        self.show > 1 || self.show == 1 && (self.confirmed || self.framed < MANY)
    }

    /// Whether all have the point right beside the object: they show the object's rim as likely, for masks end too early in
    /// places.
    fn is_rim(&self) -> bool {
        self.beside == self.show
    }

    /// Whether the point is likely nowhere, though it be guessed or, as they are `believed`, shown; of those that show it these
    /// are the differences from their median colour.
    fn doubt(&self, believed: bool, mut apart: Vec<f64>) -> bool {
        if !believed {
            return self.through >= THROUGH;
        }
        if self.show == 1 {
            return !self.confirmed;
        }
        apart.sort_unstable_by(f64::total_cmp);
        apart.get(apart.len() / 2).is_some_and(|apart| *apart > ALIKE)
    }
}

/// A site as the photographs tell it.
#[derive(Clone, Default)]
struct Told {
    /// Photographs that show it, with the cost of each.
    shown: Vec<(usize, f64)>,
    /// Whether its depth is likely wrong.
    doubtful: bool,
}

/// The witnesses of a site, and the colours that they show.
struct Asked {
    /// Photographs that show it, with the cost of each.
    shown: Vec<(usize, f64)>,
    witnesses: Witnesses,
    /// `[photograph]` the difference of its colour from the median of all.
    apart: Vec<f64>,
}

impl Asked {
    fn told(self) -> Told {
        let believed = self.witnesses.suffice() && !self.witnesses.is_rim();
        let doubtful = self.witnesses.doubt(believed, self.apart);
        Told { shown: if believed { self.shown } else { vec![] }, doubtful }
    }
}

/// Mean difference of the channels of two colours, as a part of their range.
fn unlike(one: [f64; 3], other: [f64; 3]) -> f64 {
    (0..3).map(|c| (one[c] - other[c]).abs()).sum::<f64>() / 765.0
}

/// The median of each channel, the upper one of two; nothing of no colours.
fn middle(colors: impl Iterator<Item = [f64; 3]> + Clone) -> Option<[f64; 3]> {
    colors.clone().next()?;
    Some(std::array::from_fn(|c| {
        let mut values: Vec<f64> = colors.clone().map(|color| color[c]).collect();
        values.sort_unstable_by(f64::total_cmp);
        values[values.len() / 2]
    }))
}

/// The witnesses of a site in or next to a view's hole; nothing elsewhere.
fn asked(sights: &Sights, of: usize, site: usize) -> Option<Asked> {
    let own = &sights.0[of];
    if !own.near_hole(site) || !own.depth[site].is_finite() {
        return None;
    }
    let eye = own.eye();
    let point = own.point(site, own.depth[site]);
    let (to, distance) = ((point - eye).normalize(), point.distance(eye));
    let mut found: Vec<(usize, f64, [f64; 3])> = vec![];
    let mut witnesses = Witnesses::default();
    for (view, sight) in sights.0.iter().enumerate().filter(|(view, sight)| *view != of && sight.grid.trusted) {
        if let Some((there, z)) = sight.see(point) {
            witnesses.framed += 1;
            witnesses.through += usize::from(!sight.hole[there] && sight.grid.depth[there] > z * (1.0 + APART));
        }
        let Some(there) = sight.shows(point, 1.5 * SAME) else { continue };
        let from = sight.eye();
        let angle = to.dot((point - from).normalize()).clamp(-1.0, 1.0).acos();
        let finer = (mean_focal(sight) * distance / (mean_focal(own) * point.distance(from))).ln();
        let color = sight.grid.colors[there].map(f64::from);
        found.push((view, ANGLE * angle + COARSER * (-finer).max(0.0), color));
        let beside = sight.near_hole(there);
        witnesses.show += 1;
        witnesses.beside += usize::from(beside);
        witnesses.confirmed |= sight.grid.confirmed[there];
    }
    let middle = middle(found.iter().map(|(.., color)| *color)).unwrap_or_default();
    let apart: Vec<f64> = found.iter().map(|(_, _, color)| unlike(*color, middle)).collect();
    let shown = found.iter().zip(&apart).map(|((view, cost, _), apart)| (*view, cost + UNLIKE * apart)).collect();
    Some(Asked { shown, witnesses, apart })
}

/// Each `[site]` in and next to a view's hole as the photographs tell it.
fn candidates(sights: &Sights, of: usize) -> Vec<Told> {
    let sites = (0..sights.0[of].hole.len()).into_par_iter();
    sites.map(|site| asked(sights, of, site).map_or_else(Told::default, Asked::told)).collect()
}

/// The photograph that each `[site]` in and next to a view's hole is taken from, by what is told of them.
fn sources(sights: &Sights, of: usize, told: &[Told]) -> Vec<Option<usize>> {
    let own = &sights.0[of];
    let candidates: Vec<&[(usize, f64)]> = told.iter().map(|told| told.shown.as_slice()).collect();
    // Greedily: each next source is the one that makes the sum of the cheapest costs the least.
    let mut chosen: Vec<usize> = vec![];
    let mut best: Vec<f64> = candidates.iter().map(|c| if c.is_empty() { 0.0 } else { 10.0 }).collect();
    while chosen.len() < SOURCES {
        let mut gain = vec![0.0; sights.0.len()];
        for (candidates, best) in candidates.iter().zip(&best) {
            candidates.iter().for_each(|(view, cost)| gain[*view] += (best - cost).max(0.0));
        }
        let next = (0..gain.len()).max_by(|a, b| gain[*a].total_cmp(&gain[*b]).then(b.cmp(a)));
        let Some(next) = next.filter(|next| gain[*next] > 0.0) else { break };
        for (candidates, best) in candidates.iter().zip(&mut best) {
            candidates.iter().filter(|(view, _)| *view == next).for_each(|(_, cost)| *best = best.min(*cost));
        }
        chosen.push(next);
    }
    let Some(window) = Window::around(&own.grid, |site| own.near_hole(site)) else {
        return vec![None; own.hole.len()];
    };
    let sites = window.sites();
    // The last label is for what nobody shows.
    let none = chosen.len();
    let cost = |label: usize, site: usize| -> f64 {
        let shown: Vec<&(usize, f64)> = candidates[site].iter().filter(|(view, _)| chosen.contains(view)).collect();
        match (own.near_hole(site), label == none, shown.is_empty()) {
            (false, ..) | (true, true, true) => 0.0,
            (true, true, false) | (true, false, true) => HIDDEN,
            (true, false, false) => {
                shown.iter().find(|(view, _)| *view == chosen[label]).map_or(HIDDEN, |(_, cost)| *cost)
            }
        }
    };
    let costs: Vec<Vec<f64>> = (0..=none).map(|label| sites.iter().map(|site| cost(label, *site)).collect()).collect();
    let labels = planes::cheapest(&costs, &planes::Border { between: |_| SEAM, at: |_, _| 0.0 }, window.size);
    let mut sources = vec![None; own.hole.len()];
    for (cell, site) in sites.iter().enumerate() {
        let label = labels[cell];
        sources[*site] = chosen.get(label).copied().filter(|_| costs[label][cell] < HIDDEN);
    }
    sources
}

/// Cost of a seam between two sources, per site of its length.
const SEAM: f64 = 0.15;

/// A pixel's place in sites, and the world point that it shows without the object.
fn shown(own: &Photograph<'_>, sight: &Sight, i: usize) -> Option<([f64; 2], DVec3)> {
    let ray = own.camera.unproject(own.camera.pixel_center(i))?;
    let place = sight.grid.place(ray);
    let z = sight.smooth_depth_at(place);
    z.is_finite().then(|| (place, DVec3::from(own.camera.along(ray, z))))
}

/// A view that was filled.
pub struct Filled {
    /// `[pixel]` RGB, 0 to 1.
    pub rgb: Vec<[f32; 3]>,
    /// `[pixel]` whether its colour was made for this view and serves others: nothing has told it, neither a photograph nor
    /// another view.
    pub made: Vec<bool>,
    /// The view's surface, for the rays of others.
    relief: Relief,
    /// The cells of the surface that hold all pixels that were made for it.
    within: [[usize; 2]; 2],
}

impl Filled {
    /// With these colours by a view's camera, of which these were made for it.
    pub fn new(sight: &Sight, camera: &Camera, rgb: Vec<[f32; 3]>, made: Vec<bool>) -> Self {
        let relief = Relief::new(sight);
        let places = (0..made.len()).filter(|i| made[*i]).filter_map(|i| camera.unproject(camera.pixel_center(i)));
        let within = relief.around(places.map(|ray| sight.grid.place(ray)));
        Self { rgb, made, relief, within }
    }
}

/// What views that were filled before tell of the colours of a view's hole that no photograph shows: their gradients, so
/// that it goes on in the view's own light. Each colour is from where it was made, as copies of copies would be ever softer,
/// and of two views from the one that was filled first: a patchwork of many would be no picture.
pub fn repaint(
    sights: &Sights,
    photographs: &[Photograph<'_>],
    filled: &[(usize, Filled)],
    of: usize,
    filling: &mut Filling,
) {
    let (own, sight) = (&photographs[of], &sights.0[of]);
    let size @ [w, h] = own.camera.size.map(|n| n as usize);
    let ranges: Vec<Option<[f64; 2]>> = filled.iter().map(|(_, filled)| filled.relief.range(sight)).collect();
    let eye = DVec3::from(own.camera.center());
    // What another view looks through is not there.
    let through =
        |point: DVec3| filled.iter().any(|(view, filled)| filled.relief.sees_through(&sights.0[*view], point));
    // Beside what was made another view shows what photographs show, which have been asked.
    let repainted = |i: usize, beside: bool| -> Option<[f32; 3]> {
        let way = DVec3::from(own.camera.along(own.camera.unproject(own.camera.pixel_center(i))?, 1.0)) - eye;
        let near = shown(own, sight, i).map(|(_, point)| point);
        filled.iter().zip(&ranges).find_map(|((view, Filled { rgb, made, relief, within }), range)| {
            let (other, there) = (&photographs[*view], &sights.0[*view]);
            // Its surfaces end where they end there.
            let within = if beside { relief.all() } else { *within };
            let met = || Some(eye + way / relief.meets(there, eye, way, (*range)?, within)?);
            let point = near.filter(|point| there.has(*point, SAME)).or_else(met)?;
            let pixel = other.camera.project(point.to_array())?;
            let width = other.camera.size[0] as usize;
            let [x, y] = pixel.map(|v| v.max(0.0) as usize);
            let inside = x < width && y < other.camera.size[1] as usize;
            (inside && (beside || made[y * width + x])).then_some(())?;
            sample(|x, y| rgb[y * width + x], other.camera.size, pixel)
        })
    };
    let told: Vec<Option<[f32; 3]>> = (0..w * h)
        .into_par_iter()
        .map(|i| {
            let edge = || neighbours(i, size).any(|j| filling.guessed[j]);
            if filling.guessed[i] || edge() { repainted(i, !filling.guessed[i]) } else { None }
        })
        .collect();
    let inside: Vec<bool> = (0..w * h).map(|i| filling.guessed[i] && told[i].is_some()).collect();
    filling.behind = (0..w * h)
        .into_par_iter()
        .map(|i| if filling.guessed[i] && told[i].is_none() { behind(own, sight, through, i) } else { None })
        .collect();
    join(&mut filling.rgb, &inside, &told, size);
    filling.guessed.iter_mut().zip(inside).for_each(|(guessed, inside)| *guessed &= !inside);
}

/// Takes what is told of the pixels `inside`, by its gradients: it goes on from what is around them, where that is what is told of it.
pub fn join(rgb: &mut [[f32; 3]], inside: &[bool], told: &[Option<[f32; 3]>], size: [usize; 2]) {
    let equation = |i: usize| {
        let mut equation = Equation::new(i);
        for (j, there) in neighbours(i, size).filter_map(|j| Some((j, told[j]?))) {
            let goes_on = inside[j] || alike(rgb[j], there);
            if let Some(here) = told[i].filter(|_| goes_on) {
                equation.add(j, std::array::from_fn(|c| here[c] - there[c]));
            }
        }
        equation
    };
    let equations: Vec<Equation> = (0..rgb.len()).into_par_iter().filter(|i| inside[*i]).map(equation).collect();
    for i in (0..rgb.len()).filter(|i| inside[*i]) {
        rgb[i] = told[i].unwrap_or(rgb[i]);
    }
    gradient::solve(rgb, size[0], &equations);
}

/// The surface that a pixel shows where other views look through the point that its site has: of those near it that lie farther, and that
/// nobody looks through, the one that most sites have.
fn behind(own: &Photograph<'_>, sight: &Sight, through: impl Fn(DVec3) -> bool, i: usize) -> Option<u8> {
    let ray = own.camera.unproject(own.camera.pixel_center(i))?;
    let (_, point) = shown(own, sight, i).filter(|(_, point)| through(*point))?;
    let (site, _, z) = sight.seen(point)?;
    let mut counts = vec![0u32; sight.planes.len() + 1];
    sight.grid.around(site, BEHIND).for_each(|site| counts[usize::from(sight.surface[site])] += 1);
    let is_there =
        |d: f64| d > 0.0 && d * z * (1.0 + SAME) <= 1.0 && !through(DVec3::from(own.camera.along(ray, 1.0 / d)));
    let farther = sight.planes.iter().enumerate();
    let farther = farther.filter(|(label, plane)| counts[*label] > 0 && is_there(planes::on(plane, ray)));
    farther.max_by_key(|(label, _)| counts[*label]).map(|(label, _)| label as u8)
}

/// Whether two colours of one place differ in brightness alone.
fn alike(one: [f32; 3], other: [f32; 3]) -> bool {
    let dot = |a: [f32; 3], b: [f32; 3]| (0..3).map(|c| a[c] * b[c]).sum::<f32>();
    let gain = dot(one, other) / dot(other, other).max(1e-6);
    (0..3).all(|c| (one[c] - other[c]).abs() <= BRIGHTER && (one[c] - gain * other[c]).abs() <= OF_ANOTHER_HUE)
}

/// A colour that photographs show, as it became when they were joined: in another light at most. Where pieces of several do not meet
/// by a pixel or two, at a seam across stripes, what is off adds up to glaring colours that none of them shows.
fn in_its_light(shown: [f32; 3], joined: [f32; 3]) -> [f32; 3] {
    let off: [f32; 3] = std::array::from_fn(|c| joined[c] - shown[c]);
    let brighter = off.iter().sum::<f32>() / 3.0;
    let hue = off.map(|off| off - brighter);
    let largest = hue.iter().fold(0.0, |largest: f32, hue| largest.max(hue.abs()));
    let kept = if largest > OF_ANOTHER_HUE { OF_ANOTHER_HUE / largest } else { 1.0 };
    std::array::from_fn(|c| (shown[c] + brighter.clamp(-BRIGHTER, BRIGHTER) + kept * hue[c]).clamp(0.0, 1.0))
}

/// What photographs tell of the colours of a view's hole.
pub fn gather(sights: &Sights, photographs: &[Photograph<'_>], of: usize) -> Filling {
    let (own, sight) = (&photographs[of], &sights.0[of]);
    let size @ [w, h] = own.camera.size.map(|n| n as usize);
    let told = candidates(sights, of);
    let sources = sources(sights, of, &told);
    let photographed = |i: usize| -> Vec<Shown> {
        let mut found: Vec<Shown> = vec![];
        let Some((place, point)) = shown(own, sight, i) else { return found };
        let [x, y] = place.map(|v| v - 0.5);
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let (u, v) = (x.floor() + f64::from(dx), y.floor() + f64::from(dy));
            let Some(source) = sight.grid.site(u as i64, v as i64).and_then(|site| sources[site]) else { continue };
            let weight = ((1.0 - (x - u).abs()) * (1.0 - (y - v).abs())) as f32;
            match found.iter_mut().find(|shown| shown.source == source) {
                Some(shown) => shown.weight += weight,
                None => found.extend(photographs[source].color(point).map(|color| Shown { source, weight, color })),
            }
        }
        if found.iter().map(|shown| shown.weight).sum::<f32>() < ENOUGH {
            found.clear();
        }
        found
    };
    let hole = |i: usize| own.hole.as_raw()[i] != 0;
    let ring = resample::dilate(&own.hole, RING);
    let colors: Vec<Vec<Shown>> =
        (0..w * h).into_par_iter().map(|i| if ring.as_raw()[i] != 0 { photographed(i) } else { vec![] }).collect();
    let mut filling = Filling {
        rgb: own.picture.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect(),
        guessed: own.hole.as_raw().iter().map(|v| *v != 0).collect(),
        seen: vec![false; w * h],
        doubtful: vec![false; w * h],
        behind: vec![None; w * h],
    };
    for i in (0..w * h).filter(|i| hole(*i)) {
        let site = shown(own, sight, i).and_then(|([x, y], _)| sight.grid.site(x.floor() as i64, y.floor() as i64));
        filling.doubtful[i] = site.is_some_and(|site| told[site].doubtful);
    }
    let inside: Vec<usize> = (0..w * h).filter(|i| hole(*i) && !colors[*i].is_empty()).collect();
    let mixed: Vec<[f32; 3]> = colors.par_iter().map(|shown| mean(shown)).collect();
    // Beside the hole a photograph differs from the others in brightness alone, or shows something else.
    let goes_on = |i: usize| !colors[i].is_empty() && alike(filling.rgb[i], mixed[i]);
    let equation = |i: usize| {
        let mut equation = Equation::new(i);
        for j in neighbours(i, size).filter(|j| if hole(*j) { !colors[*j].is_empty() } else { goes_on(*j) }) {
            equation.add(j, difference(&colors[i], &colors[j]));
        }
        equation
    };
    let equations: Vec<Equation> = inside.par_iter().map(|i| equation(*i)).collect();
    for i in inside {
        filling.rgb[i] = mixed[i];
        (filling.guessed[i], filling.seen[i]) = (false, true);
    }
    gradient::solve(&mut filling.rgb, w, &equations);
    for i in (0..w * h).filter(|i| hole(*i) && filling.seen[*i]) {
        filling.rgb[i] = in_its_light(mixed[i], filling.rgb[i]);
    }
    let doubts = filling.doubtful.iter().filter(|doubtful| **doubtful).count() as f64;
    if doubts > DISTRUST * own.hole.as_raw().iter().filter(|hole| **hole != 0).count() as f64 {
        // What is around such a hole is not known, either, and a guess goes on from there; but under the object lies what it
        // stands on.
        let supports = sight.supports(&sight.planes);
        let stands = |i: usize| {
            let ray = own.camera.unproject(own.camera.pixel_center(i))?;
            let z = sight.depth_at(sight.grid.place(ray));
            let point = DVec3::new(ray[0], ray[1], 1.0) * z;
            supports.iter().any(|support| support.has(point)).then_some(())
        };
        let guessed: Vec<usize> = (0..w * h).filter(|i| filling.guessed[*i] && stands(*i).is_none()).collect();
        guessed.into_iter().for_each(|i| filling.doubtful[i] = true);
    }
    filling
}

/// What a photograph shows of a pixel's point.
struct Shown {
    source: usize,
    weight: f32,
    color: [f32; 3],
}

/// The colour that photographs show, by their weights.
fn mean(shown: &[Shown]) -> [f32; 3] {
    let total: f32 = shown.iter().map(|shown| shown.weight).sum();
    std::array::from_fn(|c| shown.iter().map(|shown| shown.weight * shown.color[c]).sum::<f32>() / total.max(1e-9))
}

/// By how much one pixel's colour is above another's: in the photographs that show both, else between those that show one.
fn difference(one: &[Shown], other: &[Shown]) -> [f32; 3] {
    let both = || {
        let pairs = one.iter().flat_map(|a| other.iter().map(move |b| (a, b)));
        pairs.filter(|(a, b)| a.source == b.source).map(|(a, b)| (a.weight + b.weight, a.color, b.color))
    };
    let total: f32 = both().map(|(weight, ..)| weight).sum();
    if total == 0.0 {
        let (one, other) = (mean(one), mean(other));
        return std::array::from_fn(|c| one[c] - other[c]);
    }
    std::array::from_fn(|c| both().map(|(weight, a, b)| weight * (a[c] - b[c])).sum::<f32>() / total)
}

/// Pixels around a hole in which what other photographs show is compared with the view's own.
const RING: u32 = 2;
/// Differences beyond this are of something else than brightness.
const BRIGHTER: f32 = 0.12;
/// Differences beyond this once brightness is the same are of another hue: pixels at another thing's border are mixed with its colour.
const OF_ANOTHER_HUE: f32 = 0.035;

#[cfg(test)]
mod tests {
    use image::{GrayImage, RgbImage};

    use super::*;

    /// A little light stays as it is, much of it is less, and what became blue is grey again.
    #[test]
    fn what_is_joined_keeps_its_hue() {
        let grey = [0.5f32; 3];
        assert_eq!(in_its_light(grey, [0.6, 0.6, 0.6]), [0.6; 3]);
        let lit = in_its_light(grey, [0.58, 0.6, 0.62]);
        assert!((0..3).all(|c| (lit[c] - [0.58, 0.6, 0.62][c]).abs() < 1e-6), "{lit:?}");
        let glaring = in_its_light(grey, [0.3, 0.5, 1.0]);
        assert!(glaring[2] - glaring[0] <= 2.0 * OF_ANOTHER_HUE + 1e-6, "{glaring:?}");
        assert!((glaring.iter().sum::<f32>() / 3.0 - 0.6).abs() < 1e-6, "{glaring:?}");
        assert!(in_its_light(grey, [1.0; 3]).iter().all(|v| (v - 0.5 - BRIGHTER).abs() < 1e-6));
    }

    /// The middle view has a board at z = 3, left of its middle, before the wall, and it was filled. The fifth has the board three
    /// pixels too far: the first two of these show wall that nobody has seen, and the third wall that the middle view has.
    #[test]
    fn what_another_view_looks_through_is_not_there() {
        use super::super::surface::tests::{SIZE, views};
        let (grids, cameras, masks) = views(0.6);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        for (view, end) in [(2, 24), (4, 19)] {
            let sight = &mut sights.0[view];
            sight.planes = vec![[0.0, 0.0, 1.0 / 3.0], [0.0, 0.0, 0.25]];
            for site in (0..sight.hole.len()).filter(|site| sight.hole[*site]) {
                let is_board = site % (SIZE[0] as usize) < end;
                (sight.depth[site], sight.surface[site]) = if is_board { (3.0, 0) } else { (4.0, 1) };
            }
        }
        let picture = RgbImage::new(SIZE[0], SIZE[1]);
        let photographs: Vec<Photograph<'_>> = (cameras.iter().zip(masks))
            .map(|(camera, hole)| Photograph { camera: *camera, picture: &picture, hole })
            .collect();
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let hole = |view: usize| photographs[view].hole.as_raw().iter().map(|v| *v != 0).collect::<Vec<bool>>();
        let filled = [(2, Filled::new(&sights.0[2], &cameras[2], vec![[0.5; 3]; pixels], hole(2)))];
        let mut filling = Filling {
            rgb: vec![[0.0; 3]; pixels],
            guessed: hole(4),
            seen: vec![false; pixels],
            doubtful: vec![false; pixels],
            behind: vec![None; pixels],
        };
        repaint(&sights, &photographs, &filled, 4, &mut filling);
        for y in 12..20 {
            let row: Vec<(bool, Option<u8>)> =
                (10..22).map(|x| y * SIZE[0] as usize + x).map(|i| (filling.guessed[i], filling.behind[i])).collect();
            let told = [(false, None)];
            assert_eq!(row, [&told.repeat(6)[..], &[(true, Some(1)); 2], &told.repeat(4)].concat(), "{y}");
        }
    }

    /// A view that made nothing tells nothing, though it comes first; from the one that made the hole the pattern of the wall
    /// goes on.
    #[test]
    fn colours_are_from_where_they_were_made() {
        use super::super::surface::tests::{SIZE, views};
        let (grids, cameras, masks) = views(0.4);
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        (0..5).for_each(|of| sights.solve(of, 1));
        let pattern = |camera: &Camera, i: usize| {
            let [x, ..] = camera.lift(camera.pixel_center(i), 4.0).expect("a ray");
            [(0.5 + 0.2 * (3.0 * x).sin()) as f32; 3]
        };
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let picture = |camera: &Camera| {
            let bytes = (0..pixels).flat_map(|i| pattern(camera, i).map(|v| (v * 255.0).round() as u8)).collect();
            RgbImage::from_raw(SIZE[0], SIZE[1], bytes).expect("three bytes per pixel")
        };
        let pictures: Vec<RgbImage> = cameras.iter().map(picture).collect();
        let photographs: Vec<Photograph<'_>> = (cameras.iter().zip(&pictures).zip(masks))
            .map(|((camera, picture), hole)| Photograph { camera: *camera, picture, hole })
            .collect();
        let hole = |view: usize| photographs[view].hole.as_raw().iter().map(|v| *v != 0).collect::<Vec<bool>>();
        let colors = |view: usize| (0..pixels).map(|i| pattern(&cameras[view], i)).collect::<Vec<_>>();
        let blank = Filled::new(&sights.0[0], &cameras[0], vec![[0.9, 0.1, 0.1]; pixels], vec![false; pixels]);
        let filled = [(0, blank), (2, Filled::new(&sights.0[2], &cameras[2], colors(2), hole(2)))];
        let mut filling = Filling {
            rgb: colors(1),
            guessed: hole(1),
            seen: vec![false; pixels],
            doubtful: vec![false; pixels],
            behind: vec![None; pixels],
        };
        let inside: Vec<usize> = (0..pixels).filter(|i| filling.guessed[*i]).collect();
        inside.iter().for_each(|i| filling.rgb[*i] = [0.0; 3]);
        repaint(&sights, &photographs, &filled, 1, &mut filling);
        let told: Vec<usize> = inside.into_iter().filter(|i| !filling.guessed[*i]).collect();
        assert!(told.len() > 40, "{}", told.len());
        for i in told {
            let (found, truth) = (filling.rgb[i], pattern(&cameras[1], i));
            assert!((0..3).all(|c| (found[c] - truth[c]).abs() < 0.03), "{i}: {found:?}, {truth:?}");
        }
    }

    /// A rim that one of many views takes for the floor behind it paints nothing; of few views each is needed.
    #[test]
    fn who_is_no_witness() {
        let of = |show, beside, confirmed, framed| Witnesses { show, beside, confirmed, framed, through: 0 };
        let suffice = |show, confirmed, framed| of(show, 0, confirmed, framed).suffice();
        assert!(!suffice(1, false, MANY) && !suffice(0, false, 0));
        assert!(suffice(1, true, MANY) && suffice(2, false, MANY) && suffice(1, false, MANY - 1));
        assert!(of(3, 3, true, MANY).is_rim() && of(1, 1, true, 2).is_rim() && !of(3, 2, true, MANY).is_rim());
    }

    /// A point is doubtful where photographs disagree about it or look through it; one that is hidden from all is a guess like any other.
    #[test]
    fn what_is_doubtful() {
        let of = |show, confirmed, through, apart: &[f64]| {
            let witnesses = Witnesses { show, beside: 0, confirmed, framed: MANY - 1, through };
            witnesses.doubt(witnesses.suffice(), apart.to_vec())
        };
        assert!(!of(0, false, 0, &[]) && !of(0, false, THROUGH - 1, &[]) && of(0, false, THROUGH, &[]));
        assert!(of(1, false, 0, &[0.0]) && !of(1, true, 0, &[0.0]));
        assert!(!of(3, false, 5, &[0.0, 0.01, 0.3]) && of(3, true, 0, &[0.0, 0.1, 0.3]) && of(2, true, 0, &[0.0, 0.1]));
    }

    /// No view is believed about what all have right beside the object, be it of the object's own colour or of the wall's: its depth is the
    /// object's as likely.
    #[test]
    fn what_all_have_beside_the_object_is_guessed() {
        use super::super::surface::tests::{SIZE, views};
        let (wall, object) = ([150u8, 145, 140], [30u8, 60, 160]);
        let told = |rim: [u8; 3]| {
            // A picture that hangs on the wall: all views have the same of the wall right beside it.
            let (mut grids, cameras, _) = views(0.0);
            let on_picture = |camera: &Camera, i: usize| {
                let [x, y, _] = camera.lift(camera.pixel_center(i), 4.0).expect("a ray");
                x.abs() < 0.5 && y.abs() < 0.5
            };
            let mask = |camera: &Camera| {
                let inside = |x, y| on_picture(camera, (y * SIZE[0] + x) as usize);
                GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| image::Luma([if inside(x, y) { 255 } else { 0 }]))
            };
            let masks: Vec<GrayImage> = cameras.iter().map(mask).collect();
            for (grid, mask) in grids.iter_mut().zip(&masks) {
                let near = |i: usize| grid.around(i, 1).any(|j| mask.as_raw()[j] != 0);
                let color = |i: usize| match (mask.as_raw()[i] != 0, near(i)) {
                    (true, _) => object,
                    (false, true) => rim,
                    (false, false) => wall,
                };
                let colors = (0..(SIZE[0] * SIZE[1]) as usize).map(color).collect();
                grid.colors = colors;
            }
            let mut sights = Sights::new(grids, &cameras, &masks, &masks);
            (0..5).for_each(|of| sights.solve(of, 1));
            let rims = (0..sights.0[2].hole.len())
                .filter(|site| asked(&sights, 2, *site).is_some_and(|a| a.witnesses.suffice() && a.witnesses.is_rim()));
            let rims: Vec<usize> = rims.collect();
            let told = candidates(&sights, 2);
            (rims.iter().filter(|site| !told[**site].shown.is_empty()).count(), rims.len())
        };
        for rim in [wall, object] {
            let (painted, count) = told(rim);
            assert!(count > 4 && painted == 0, "{painted} of {count}");
        }
    }
}

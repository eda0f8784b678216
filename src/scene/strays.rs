//! Photographs whose cameras cannot be where the model has them, and points that nothing has measured.
//!
//! Structure from motion goes on with whatever matches. Where a capture has too little overlap it attaches photographs by a
//! handful of wrong matches, one to the next: a tail of cameras that leads away from the scene. A training that believes
//! them paints their pictures into fog before all the others.

use std::collections::BTreeMap;

use super::bounds::Bounds;
use super::colmap::{Image, Model, Tracks};
use super::note::{Note, Notes};
use super::{Point, Poses, layout};
use crate::segments::parts;
use crate::statistics::median;

/// Two photographs hang together by this many points at least, the least that COLMAP takes for a match ...
const LINK: f64 = 15.0;
/// ... or, in a capture with little texture, by this share of the points that a photograph usually has.
const LINK_SHARE: f64 = 0.1;
/// A point counts for two photographs whose rays to it meet at so many degrees at least, which is where COLMAP trusts it.
const PARALLAX: f64 = 1.5;
/// Photographs of a track that each of its photographs is linked with: all of short tracks, and enough to hold long ones
/// together.
const AHEAD: usize = 16;
/// Photographs apart from the rest stay if they have this share of the points that the rest have: a second room.
const SUPPORTED: f64 = 0.25;

/// The photographs of a model by what holds them together.
struct Linked {
    /// `[image]` held to the rest of the model by too few points.
    loose: Vec<bool>,
    /// Photographs in each well supported part of the model, the largest first.
    parts: Vec<usize>,
}

/// Which photographs hang together. Nothing is said of models without tracks.
fn linked(images: &[Image], points: &[Point], tracks: &Tracks) -> Linked {
    let mut found = Linked { loose: vec![false; images.len()], parts: vec![] };
    if tracks.is_empty() || tracks.len() != points.len() {
        return found;
    }
    let centers: Vec<[f64; 3]> = images.iter().map(Image::center).collect();
    let places: BTreeMap<u32, usize> = images.iter().enumerate().map(|(place, image)| (image.id, place)).collect();
    let mut seen = vec![0u32; images.len()];
    let mut shared: BTreeMap<(usize, usize), u32> = BTreeMap::new();
    let narrowest = PARALLAX.to_radians().cos();
    for (i, point) in points.iter().enumerate() {
        let mut track: Vec<usize> = tracks.of(i).iter().filter_map(|id| places.get(id).copied()).collect();
        track.sort_unstable();
        track.dedup();
        let ray = |at: usize| {
            (glam::DVec3::from_array(point.position.map(f64::from)) - glam::DVec3::from_array(centers[at]))
                .normalize_or_zero()
        };
        for (n, &one) in track.iter().enumerate() {
            seen[one] += 1;
            for &other in track[n + 1..].iter().take(AHEAD) {
                if ray(one).dot(ray(other)) <= narrowest {
                    *shared.entry((one, other)).or_default() += 1;
                }
            }
        }
    }
    let usual = median(seen.iter().copied().filter(|seen| *seen > 0)).unwrap_or(0.0);
    let least = LINK.min(LINK_SHARE * usual).max(1.0);
    let links = shared.into_iter().filter(|(_, count)| f64::from(*count) >= least).map(|(pair, _)| pair);
    let parts = parts(images.len(), links);
    let Some(main) = parts.iter().max_by_key(|part| part.len()) else { return found };
    // A model that is nothing but pieces has no rest to compare with.
    if 2 * main.len() <= images.len() {
        return found;
    }
    let support = |part: &[usize]| median(part.iter().map(|at| seen[*at])).unwrap_or(0.0);
    let needed = SUPPORTED * support(main);
    for part in &parts {
        if support(part) < needed {
            part.iter().for_each(|at| found.loose[*at] = true);
        } else {
            found.parts.push(part.len());
        }
    }
    found.parts.sort_unstable_by(|a, b| b.cmp(a));
    found
}

/// The first of the names, and how many more there are.
fn listed(names: &[String]) -> Option<String> {
    let first = names.first()?;
    Some(if names.len() > 1 { format!("{first} and {} more", names.len() - 1) } else { first.clone() })
}

/// Takes out the views whose cameras stand where no capture has any, those that hang on the rest by too few points, and the
/// points that lie beyond what any camera can measure or that only such views show. Returns how many views.
pub(super) fn leave(
    model: &Model,
    poses: &Poses<'_>,
    views: [&mut Vec<layout::Entry>; 2],
    (points, tracks): (&mut Vec<Point>, &Tracks),
    notes: &mut Notes,
) -> usize {
    let place = |entry: &layout::Entry| poses.place(&entry.name).expect("views without a pose were left out");
    let linked = linked(&model.images, points, tracks);
    let mut places: Vec<usize> = views.iter().flat_map(|v| v.iter()).map(place).collect();
    let all = places.len();
    places.retain(|at| !linked.loose[*at]);
    let centers: Vec<[f64; 3]> = places.iter().map(|at| model.images[*at].center()).collect();
    let bounds = Bounds::of(&centers, points);
    let mut wrong = linked.loose.clone();
    places.iter().zip(&bounds.stray).for_each(|(at, stray)| wrong[*at] |= *stray);
    let (mut loose, mut far) = (vec![], vec![]);
    for views in views {
        views.retain(|entry| {
            let at = place(entry);
            if wrong[at] {
                if linked.loose[at] { &mut loose } else { &mut far }.push(entry.name.clone());
            }
            !wrong[at]
        });
    }
    if let Some(names) = listed(&far) {
        notes.push(Note::Stray(format!(
            "{names} of {all} views: the model has the camera where no capture has any, far from all others, so that the \
             photograph is left out"
        )));
    }
    if let Some(names) = listed(&loose) {
        notes.push(Note::Stray(format!(
            "{names} of {all} views: the model holds the camera to the others by a handful of points, so that it may be \
             anywhere, and the photograph is left out; match all pairs of photographs (colmap exhaustive_matcher), or take \
             more between these and the others"
        )));
    }
    if let [largest, second, ..] = linked.parts[..] {
        notes.push(format!(
            "the model is in parts, of {largest} and {second} views, that share hardly a point; if pictures are doubled, \
             match all pairs of photographs (colmap exhaustive_matcher)"
        ));
    }
    leave_points(&model.images, &wrong, &bounds, (points, tracks), notes);
    loose.len() + far.len()
}

/// Takes out the points that lie beyond the bounds, and those that fewer than two photographs show which are not wrong.
fn leave_points(
    images: &[Image],
    wrong: &[bool],
    bounds: &Bounds,
    (points, tracks): (&mut Vec<Point>, &Tracks),
    notes: &mut Notes,
) {
    let all = points.len();
    let right: BTreeMap<u32, bool> = images.iter().zip(wrong).map(|(image, wrong)| (image.id, !wrong)).collect();
    let is_measured = |point: usize| {
        let mut by: Vec<u32> =
            tracks.of(point).iter().copied().filter(|id| right.get(id).copied().unwrap_or(true)).collect();
        by.sort_unstable();
        by.dedup();
        by.len() > 1 || tracks.of(point).is_empty()
    };
    let ask = wrong.contains(&true) && tracks.len() == all;
    let mut kept = (0..all).map(|point| !ask || is_measured(point));
    points.retain(|_| kept.next().unwrap_or(true));
    let measured = points.len();
    if measured < all {
        notes.push(format!("{} of {all} points are seen by such views alone, and are left out", all - measured));
    }
    points.retain(|point| !bounds.is_beyond(point));
    if points.len() < measured {
        notes.push(format!(
            "{} of {all} points lie far beyond what the cameras can measure, and are left out",
            measured - points.len()
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photographs around a point, numbered from 10, at these angles in degrees.
    fn images(angles: &[f64]) -> Vec<Image> {
        let image = |(i, angle): (usize, &f64)| {
            let (sin, cos) = angle.to_radians().sin_cos();
            // Rows of the rotation; the centre is -R^T t.
            let rotation = [[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]];
            Image { id: 10 + i as u32, name: format!("{i}"), rotation, translation: [0.0, 0.0, 4.0], camera: 1 }
        };
        angles.iter().enumerate().map(image).collect()
    }

    /// A model from lists of photographs, each of a number of points near the middle.
    fn model(groups: &[(&[u32], usize)]) -> (Vec<Point>, Tracks) {
        let mut model = (vec![], Tracks::default());
        for (track, count) in groups {
            for _ in 0..*count {
                let at = model.0.len() as f32;
                model.0.push(Point { position: [0.01 * at.sin(), 0.01 * at.cos(), 0.0], color: [0; 3] });
                model.1.push(track.iter().map(|i| 10 + i));
            }
        }
        model
    }

    fn loose(angles: &[f64], groups: &[(&[u32], usize)]) -> Vec<usize> {
        let (points, tracks) = model(groups);
        let linked = linked(&images(angles), &points, &tracks);
        (0..angles.len()).filter(|i| linked.loose[*i]).collect()
    }

    #[test]
    fn a_tail_of_cameras_is_loose() {
        let angles: Vec<f64> = (0..9).map(|i| 10.0 * f64::from(i)).collect();
        let body: &[(&[u32], usize)] = &[(&[0, 1, 2], 100), (&[2, 3, 4], 100), (&[4, 5], 60)];
        let with = |tail: &[(&[u32], usize)]| loose(&angles, &[body, tail].concat());
        // Six to seven to eight, each by some points, the body by a few.
        assert_eq!(with(&[(&[5, 6], 9), (&[6, 7], 14), (&[7, 8], 10)]), [6, 7, 8]);
        assert_eq!(with(&[(&[5, 6], 20), (&[6, 7], 20), (&[7, 8], 20)]), [0usize; 0]);
        // A part of its own with points enough is another room.
        assert_eq!(with(&[(&[6, 7, 8], 80)]), [0usize; 0]);
    }

    /// Points that two photographs see from nearly one place say nothing of where these stand.
    #[test]
    fn points_without_parallax_hold_nothing() {
        let groups: &[(&[u32], usize)] = &[(&[0, 1, 2], 300), (&[2, 3], 40)];
        assert_eq!(loose(&[0.0, 10.0, 20.0, 22.0], groups), [0usize; 0]);
        assert_eq!(loose(&[0.0, 10.0, 20.0, 21.0], groups), [3]);
    }

    /// A white room gives each photograph a few points only, and a model without tracks gives none.
    #[test]
    fn captures_of_few_points_are_whole() {
        let angles = [0.0, 10.0, 20.0, 30.0];
        assert_eq!(loose(&angles, &[(&[0, 1], 8), (&[1, 2], 7), (&[2, 3], 6)]), [0usize; 0]);
        assert_eq!(loose(&angles, &[(&[], 50)]), [0usize; 0]);
        // Ids that the model does not have.
        assert_eq!(loose(&angles, &[(&[90, 91], 50)]), [0usize; 0]);
        assert_eq!(loose(&[], &[]), [0usize; 0]);
        // Pieces all of them: none is the rest.
        assert_eq!(loose(&angles, &[(&[0, 1], 80), (&[2, 3], 80)]), [0usize; 0]);
    }
}

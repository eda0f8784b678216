//! The object as all views know it: masks that end before it does are completed, and views that have it elsewhere are found.

use std::collections::BTreeSet;

use glam::DVec3;
use image::GrayImage;
use rayon::prelude::*;

use super::surface::{APART, HULL_VIEWS, framing, inside};
use crate::multiview::DepthGrid;
use crate::prepare::planes;
use crate::scene::Camera;

/// Sites from the mask's border from which on what it covers is the object.
const WITHIN: i64 = 2;
/// Share of the views with a point of the object in the picture whose masks must cover it.
const SHARED: f64 = 0.7;
/// Difference, 8-bit levels in the mean of the channels, up to which a point of the object looks like itself in another view.
const LIKE_ITSELF: u32 = 12;
/// Points of the object that must fall into a site for it to be the object's.
const FEWEST_POINTS: u32 = 2;

/// Sites of a mask, and of the object in a picture, from which on they are compared; the share of each that must be of the other one.
const FEWEST_SITES: usize = 30;
const OVERLAP: f64 = 0.8;
/// One of so many views may have the object elsewhere.
const MOST_ASTRAY: usize = 4;

/// A point of which less than this share of the views that have it in the picture has it inside their masks is none of the object.
const STRAY: f64 = 0.5;
/// Share of the sites of a part of a mask whose depth must be known for it to be judged, and share of these that must be none of the
/// object.
const KNOWN: f64 = 0.125;
const MOSTLY: f64 = 0.5;

/// The sites of which this is said that hang together with what is inside.
fn beside(grid: &DepthGrid, inside: &[bool], of: impl Fn(usize) -> bool) -> Vec<usize> {
    let mut found = vec![false; inside.len()];
    let mut open: Vec<usize> = (0..inside.len()).filter(|site| inside[*site]).collect();
    while let Some(site) = open.pop() {
        for at in grid.around(site, WITHIN) {
            if !inside[at] && !found[at] && of(at) {
                found[at] = true;
                open.push(at);
            }
        }
    }
    (0..found.len()).filter(|site| found[*site]).collect()
}

/// Whether a view shows something before a point, as others confirm.
fn hides(grid: &DepthGrid, point: DVec3) -> bool {
    grid.see(point).is_some_and(|(site, _, z)| grid.confirmed[site] && z > (1.0 + APART) * grid.depth[site])
}

/// Points of the object, with what they look like: those deep inside a mask that most of the masks cover.
pub struct Object(Vec<(DVec3, [u8; 3])>);

impl Object {
    /// By what is `inside` the masks of the views.
    fn new(grids: &[DepthGrid], inside: &[Vec<bool>]) -> Self {
        let on_object = |point: DVec3| {
            // A view that shows something before the point tells nothing of it: what stands behind the object is in its mask, too.
            let views = grids.iter().zip(inside).filter(|(grid, _)| !hides(grid, point));
            let (framed, covered) = framing(views, point);
            framed >= HULL_VIEWS && covered as f64 >= SHARED * framed as f64
        };
        let points = grids.par_iter().zip(inside).flat_map_iter(|(grid, inside)| {
            let deep = |site: usize| {
                // Beyond the picture nothing is.
                grid.around(site, WITHIN).filter(|near| inside[*near]).count() == (2 * WITHIN as usize + 1).pow(2)
            };
            let known = (0..grid.depth.len()).filter(|site| inside[*site] && grid.confirmed[*site]);
            known
                .filter(|site| deep(*site))
                .filter_map(|site| Some((grid.point(site)?, grid.colors[site])))
                .filter(|(point, _)| on_object(*point))
                .collect::<Vec<_>>()
        });
        Self(points.collect())
    }

    /// How much of what is `inside` the mask of a view is the object, and how much of the object in its picture is inside; nothing where little
    /// of it is in the picture.
    fn overlap(&self, grid: &DepthGrid, inside: &[bool]) -> Option<[f64; 2]> {
        let mut hit = vec![false; inside.len()];
        for (point, _) in &self.0 {
            if let Some((site, ..)) = grid.see(*point) {
                hit[site] = true;
            }
        }
        // Points are sparse.
        let near = |site: usize| grid.around(site, WITHIN).any(|at| hit[at]);
        let share = |of: &dyn Fn(usize) -> bool, also: &dyn Fn(usize) -> bool| {
            let all = (0..inside.len()).filter(|site| of(*site));
            let (both, count) = all.fold((0, 0), |(both, n), site| (both + usize::from(also(site)), n + 1));
            (count >= FEWEST_SITES).then(|| both as f64 / count as f64)
        };
        Some([share(&|site| inside[site], &near)?, share(&|site| hit[site], &|site| inside[site])?])
    }
}

/// The views in which the object is not where its mask is: of wrong cameras, or with the mask of something else. Where something hides
/// a part of the object only that is outside the mask, and none of the mask is beside the object.
pub fn astray(grids: &[DepthGrid], cameras: &[Camera], masks: &[GrayImage]) -> Vec<usize> {
    let inside = inside(grids, cameras, masks);
    let object = Object::new(grids, &inside);
    let is_astray = |view: usize| {
        let overlap = object.overlap(&grids[view], &inside[view]);
        overlap.is_some_and(|shares| shares.iter().all(|share| *share < OVERLAP))
    };
    let found: Vec<usize> = (0..grids.len()).into_par_iter().filter(|view| is_astray(*view)).collect();
    // What many views contradict is not known.
    if found.len() <= grids.len() / MOST_ASTRAY { found } else { vec![] }
}

/// Adds to the masks (as large as the pictures of these cameras) where points of the object fall that most other masks cover:
/// a mask that stops short of the object is completed by what all views know of it. Where a camera is wrong nobody knows where the object
/// is in its picture. Returns the views whose masks grew.
pub fn complete(grids: &[DepthGrid], cameras: &[Camera], masks: &mut [GrayImage]) -> Vec<usize> {
    let inside = inside(grids, cameras, masks);
    let Object(points) = Object::new(grids, &inside);
    let added: Vec<Vec<usize>> = (grids.par_iter().zip(&inside))
        .map(|(grid, inside)| {
            // Points of the object that fall into a site, and those that it looks like.
            let mut count = vec![[0u32; 2]; grid.depth.len()];
            // Where something else stands before the object, known to or by what it looks like, the object does not show.
            let looks = |site: usize, color: [u8; 3]| {
                let apart =
                    |at: usize| grid.colors[at].iter().zip(color).map(|(a, b)| u32::from(a.abs_diff(b))).sum::<u32>();
                grid.around(site, 1).any(|at| !inside[at] && apart(at) <= 3 * LIKE_ITSELF)
            };
            for (point, color) in &points {
                let Some((site, ..)) = grid.see(*point) else { continue };
                let shows = !inside[site] && !hides(grid, *point);
                count[site] = [count[site][0] + 1, count[site][1] + u32::from(shows && looks(site, *color))];
            }
            let object =
                |site: usize| grid.trusted && count[site][1] >= FEWEST_POINTS && 2 * count[site][1] >= count[site][0];
            beside(grid, inside, object)
        })
        .collect();
    let mut grown = vec![];
    for (view, added) in added.into_iter().enumerate().filter(|(_, added)| !added.is_empty()) {
        let (grid, camera, mask) = (&grids[view], &cameras[view], &mut masks[view]);
        let mut more = GrayImage::new(mask.width(), mask.height());
        for site in &added {
            let at = [*site as u32 % grid.columns, *site as u32 / grid.columns];
            let Some([x, y]) = camera.project(camera.along(grid.ray(at), 1.0)) else { continue };
            if let Some(pixel) = more.get_pixel_mut_checked(x.max(0.0) as u32, y.max(0.0) as u32) {
                pixel.0 = [255];
            }
        }
        // A site's pixels, and a half more on each side.
        let site = grid.pixels(camera.size[0]);
        let more = crate::scene::resample::dilate(&more, site.ceil() as u32);
        mask.iter_mut().zip(more.as_raw()).for_each(|(m, more)| *m = (*m).max(*more));
        grown.push(view);
    }
    grown
}

/// Clears parts of the masks (as large as the pictures of these cameras) that lie apart from the rest, and show what nearly all other
/// views have outside their masks: what was behind the object where a mask was given. Of views that are `given` nothing is cleared.
/// Returns the views whose masks shrank.
pub fn clear_strays(grids: &[DepthGrid], cameras: &[Camera], masks: &mut [GrayImage], given: &[bool]) -> Vec<usize> {
    let inside = inside(grids, cameras, masks);
    let is_stray = |point: DVec3| {
        let (framed, covered) = framing(grids.iter().zip(&inside), point);
        framed >= HULL_VIEWS && (covered as f64) < STRAY * framed as f64
    };
    let strays = |view: usize| -> Vec<usize> {
        let (grid, camera) = (&grids[view], &cameras[view]);
        let size = camera.size.map(|n| n as usize);
        let mut left: Vec<bool> = masks[view].as_raw().iter().map(|v| *v != 0).collect();
        let parts = (0..left.len()).map(|first| planes::connected(first, &mut left, size));
        let mut parts: Vec<Vec<usize>> = parts.filter(|part| !part.is_empty()).collect();
        parts.sort_by_key(|part| std::cmp::Reverse(part.len()));
        let site = |pixel: &usize| {
            let [x, y] = grid.place(camera.unproject(camera.pixel_center(*pixel))?);
            grid.site(x.floor() as i64, y.floor() as i64)
        };
        let apart = |part: &&Vec<usize>| {
            let sites: BTreeSet<usize> = part.iter().filter_map(site).collect();
            let known = sites.iter().filter(|site| grid.confirmed[**site]).filter_map(|site| grid.point(*site));
            let strays: Vec<bool> = known.map(is_stray).collect();
            let share = strays.iter().filter(|stray| **stray).count() as f64 / strays.len().max(1) as f64;
            strays.len() as f64 >= KNOWN * sites.len() as f64 && share >= MOSTLY
        };
        parts.iter().skip(1).filter(apart).flatten().copied().collect()
    };
    let views: Vec<usize> = (0..grids.len()).filter(|view| !given[*view] && grids[*view].trusted).collect();
    let found: Vec<(usize, Vec<usize>)> = views.into_par_iter().map(|view| (view, strays(view))).collect();
    let found: Vec<(usize, Vec<usize>)> = found.into_iter().filter(|(_, strays)| !strays.is_empty()).collect();
    for (view, strays) in &found {
        strays.iter().for_each(|pixel| masks[*view].as_mut()[*pixel] = 0);
    }
    found.into_iter().map(|(view, _)| view).collect()
}

#[cfg(test)]
mod tests {
    use super::super::surface::tests::{SIZE, views};
    use super::*;

    /// A mask that ends in the middle of the object is completed by what the other masks cover; the others stay.
    #[test]
    fn a_mask_that_stops_short_is_completed() {
        let (grids, cameras, whole) = views(0.4);
        let mut masks = whole.clone();
        for (x, _, pixel) in masks[3].enumerate_pixels_mut() {
            // The object's middle is at x = 24 - 40 * 0.3 / 2.
            pixel.0 = if x < 18 { [0] } else { pixel.0 };
        }
        let mut short = masks.clone();
        assert_eq!(complete(&grids, &cameras, &mut masks), [3]);
        let left = whole[3].pixels().zip(masks[3].pixels()).filter(|(whole, now)| whole.0[0] != 0 && now.0[0] == 0);
        let missing = whole[3].pixels().filter(|p| p.0[0] != 0).count() / 2;
        // Its rim is left, where no point of the object is deep enough in the others' masks.
        assert!(left.count() * 2 < missing, "of {missing}");
        assert!(masks.iter().zip(&whole).enumerate().all(|(view, (now, whole))| view == 3 || now == whole));
        // Not that of a wrong camera.
        let mut wrong = grids.clone();
        wrong[3].trusted = false;
        assert!(complete(&wrong, &cameras, &mut short).is_empty());
    }

    /// The wall beside the object is in one mask, which is far too wide, and behind the object in three others, so that most masks cover it:
    /// it is none of the object where a view shows it.
    #[test]
    fn what_stands_behind_the_object_completes_nothing() {
        let (grids, cameras, mut masks) = views(0.5);
        masks[0].iter_mut().for_each(|v| *v = 255);
        let inside = inside(&grids, &cameras, &masks);
        let wall = DVec3::new(-0.8, 0.0, 4.0);
        let hidden = grids.iter().filter(|grid| hides(grid, wall)).count();
        assert_eq!((framing(grids.iter().zip(&inside), wall), hidden), ((5, 4), 3));
        assert!(complete(&grids, &cameras, &mut masks).is_empty());
    }

    /// A piece of the wall in one mask, apart from the object, goes; a second piece of the object that something hides in two stays, and so
    /// does what was given.
    #[test]
    fn what_others_show_beside_the_object_is_cleared() {
        let (grids, cameras, whole) = views(0.4);
        let mut masks = whole.clone();
        let piece = |x: u32, y: u32| (2..8).contains(&x) && (2..9).contains(&y);
        let with = |mask: &mut GrayImage| {
            mask.enumerate_pixels_mut().filter(|(x, y, _)| piece(*x, *y)).for_each(|(.., pixel)| pixel.0 = [255]);
        };
        with(&mut masks[1]);
        with(&mut masks[3]);
        // What hides the object's middle.
        masks[2].enumerate_pixels_mut().filter(|(_, y, _)| (15..17).contains(y)).for_each(|(.., pixel)| pixel.0 = [0]);
        let before = masks.clone();
        let given = [false, true, false, false, false];
        assert_eq!(clear_strays(&grids, &cameras, &mut masks, &given), [3]);
        assert_eq!(masks[3], whole[3]);
        assert!((0..5).filter(|view| *view != 3).all(|view| masks[view] == before[view]));
    }

    /// A mask beside the object is of a wrong camera; one that ends too early is none, and two of five are too many.
    #[test]
    fn a_mask_beside_the_object_is_astray() {
        let (grids, cameras, whole) = views(0.6);
        let beside = |mask: &GrayImage| {
            let (w, h) = mask.dimensions();
            GrayImage::from_fn(w, h, |x, y| *mask.get_pixel((x + w - 12) % w, y))
        };
        let mut masks = whole.clone();
        assert_eq!(astray(&grids, &cameras, &masks), [0usize; 0]);
        masks[3] = beside(&whole[3]);
        assert_eq!(astray(&grids, &cameras, &masks), [3]);
        masks[1] = beside(&whole[1]);
        assert_eq!(astray(&grids, &cameras, &masks), [0usize; 0]);
        masks = whole;
        masks[3].enumerate_pixels_mut().filter(|(x, ..)| *x < 18).for_each(|(.., pixel)| pixel.0 = [0]);
        assert_eq!(astray(&grids, &cameras, &masks), [0usize; 0]);
    }

    /// Where the object is hidden by something of another colour, whose depth nobody knows, its mask is complete.
    #[test]
    fn what_hides_the_object_is_no_part_of_it() {
        let (mut grids, cameras, whole) = views(0.4);
        let mut masks = whole.clone();
        for (grid, mask) in grids.iter_mut().zip(&whole) {
            let red = |on: &u8| if *on != 0 { [200, 40, 40] } else { [90; 3] };
            grid.colors = mask.as_raw().iter().map(red).collect();
        }
        for i in (0..whole[3].as_raw().len()).filter(|i| (*i as u32) % SIZE[0] < 18) {
            masks[3].as_mut()[i] = 0;
            (grids[3].colors[i], grids[3].confirmed[i]) = ([40, 160, 60], false);
        }
        assert_eq!(complete(&grids, &cameras, &mut masks), [0usize; 0]);
        // Were it of the object's colour, it would be a part of it.
        grids[3].colors.fill([200, 40, 40]);
        assert_eq!(complete(&grids, &cameras, &mut masks), [3]);
    }
}

//! Depth priors from the fit itself: kept where views agree on them, nothing elsewhere.

use std::collections::BTreeMap;
use std::path::PathBuf;

use image::GrayImage;
use rayon::prelude::*;

use super::record::Batch;
use super::splats::Splats;
use super::{Error, Watch, network};
use crate::multiview::DepthGrid;
use crate::scene::doctor;
use crate::scene::{self, Camera, Prior, PriorKind, Scene, resample};
use crate::statistics::median;

/// A pixel less covered than this has no depth.
const COVERED: f32 = 0.9;
/// Times as far as all that is known: where a map is far.
const FAR: f32 = 4.0;
/// Depths agree that differ by at most this part.
pub const AGREE: f64 = 0.03;
/// Views that are asked, the nearest ones.
const WITNESSES: usize = 6;
/// The object is enlarged by this part of the picture's longer side: the fit is not sharp at its border.
pub const MARGIN: f64 = 0.012;

/// A view's depth.
pub struct DepthMap {
    /// Its camera.
    pub camera: Camera,
    /// `[pixel]` mean depth of what is seen, scene units; NaN where that is not known.
    pub depth: Vec<f32>,
}

impl DepthMap {
    /// The fit's depth, as a camera sees it.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn of(splats: &mut Splats, camera: &Camera) -> Result<Self, crate::gpu::Error> {
        let drawn = splats.paint(camera, |_, own| Some(own))?;
        let depth = drawn.depth.iter().zip(&drawn.transmittance);
        let depth = depth.map(|(z, left)| if 1.0 - left < COVERED { f32::NAN } else { z / (1.0 - left) }).collect();
        Ok(Self { camera: *camera, depth })
    }

    /// The measured depth of a view with this camera; nothing is known of one whose camera is wrong.
    pub fn measured(grid: &DepthGrid, camera: &Camera) -> Self {
        Self::of_sites(grid, camera, |_| true)
    }

    /// The measured depth that other views confirm: the rest may be that of planes which were drawn out beyond what is on them.
    pub fn confirmed(grid: &DepthGrid, camera: &Camera) -> Self {
        Self::of_sites(grid, camera, |site| grid.confirmed[site])
    }

    /// The depth of the sites of which this `counts`, of a camera that is right.
    fn of_sites(grid: &DepthGrid, camera: &Camera, counts: impl Fn(usize) -> bool) -> Self {
        let one = |pixel: usize| -> Option<f32> {
            let [x, y] = grid.place(camera.unproject(camera.pixel_center(pixel)).filter(|_| grid.trusted)?);
            let site = grid.site(x.floor() as i64, y.floor() as i64)?;
            counts(site).then(|| grid.depth[site] as f32)
        };
        let depth = (0..(camera.size[0] * camera.size[1]) as usize).map(|pixel| one(pixel).unwrap_or(f32::NAN));
        Self { camera: *camera, depth: depth.collect() }
    }

    /// This depth, and where nothing is known one far behind all that is: a fit shows nothing where little was seen, which is not the object.
    pub fn far(&self) -> Self {
        let most = self.depth.iter().copied().filter(|z| z.is_finite()).fold(0.0, f32::max);
        let depth = self.depth.iter().map(|z| if z.is_finite() { *z } else { FAR * most }).collect();
        Self { camera: self.camera, depth }
    }

    /// The depth at a pixel position, of the pixel it falls into; NaN outside.
    pub fn at(&self, [x, y]: [f64; 2]) -> f32 {
        let [w, h] = self.camera.size;
        if x < 0.0 || y < 0.0 || x >= f64::from(w) || y >= f64::from(h) {
            return f32::NAN;
        }
        self.depth[y as usize * w as usize + x as usize]
    }

    /// The depth at a pixel position, interpolated where all four neighbours are known.
    pub fn smooth(&self, position: [f64; 2]) -> f32 {
        let [mean] = resample::bilinear(self.camera.size, position, |pixel| [f64::from(self.depth[pixel])]);
        if mean.is_finite() { mean as f32 } else { self.at(position) }
    }
}

/// How a depth map sees a point that some other view claims.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Witness {
    /// It has something at that depth.
    Agrees,
    /// Something nearer stands before it.
    Hidden,
    /// It sees through where the point should be.
    Contradicts,
    /// The point is out of its picture, or nothing is known there.
    Silent,
}

impl DepthMap {
    /// Asks for a world point.
    pub fn witness(&self, point: [f64; 3], agree: f64) -> Witness {
        let z = self.camera.to_camera(point)[2];
        let known = self.camera.project(point).map_or(f32::NAN, |pixel| self.at(pixel));
        if !known.is_finite() {
            return Witness::Silent;
        }
        let known = f64::from(known);
        if (z - known).abs() <= agree * known {
            Witness::Agrees
        } else if z > known {
            Witness::Hidden
        } else {
            Witness::Contradicts
        }
    }
}

/// Other views, the nearest camera first.
pub fn neighbours(cameras: &[Camera], of: usize) -> Vec<usize> {
    let center = cameras[of].center();
    let distance = |i: usize| {
        let other = cameras[i].center();
        (0..3).map(|k| (other[k] - center[k]).powi(2)).sum::<f64>()
    };
    let mut others: Vec<usize> = (0..cameras.len()).filter(|i| *i != of).collect();
    others.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    others
}

/// The depth of view `of` where two others agree with it and hardly any contradicts; NaN elsewhere.
pub fn agreed(maps: &[DepthMap], of: usize) -> Vec<f32> {
    let cameras: Vec<Camera> = maps.iter().map(|map| map.camera).collect();
    let witnesses: Vec<usize> = neighbours(&cameras, of).into_iter().take(WITNESSES).collect();
    let map = &maps[of];
    let keep = |i: usize, depth: f32| {
        let Some(point) = map.camera.lift(map.camera.pixel_center(i), f64::from(depth)) else { return false };
        let said: Vec<Witness> = witnesses.iter().map(|j| maps[*j].witness(point, AGREE)).collect();
        let count = |what| said.iter().filter(|s| **s == what).count();
        count(Witness::Agrees) >= 2 && 2 * count(Witness::Contradicts) < count(Witness::Agrees)
    };
    let values = map.depth.iter().enumerate();
    values.map(|(i, depth)| if depth.is_finite() && keep(i, *depth) { *depth } else { f32::NAN }).collect()
}

/// The mask at the size of a picture, enlarged by a margin.
pub fn enlarged(mask: &GrayImage, size: [u32; 2]) -> GrayImage {
    let small = resample::mask(mask, size);
    let radius = (MARGIN * f64::from(size[0].max(size[1]))).ceil() as u32;
    resample::dilate(&small, radius)
}

/// Writes every view's agreed depth outside its mask.
///
/// # Errors
/// When the device has no room, or is lost.
pub fn make(scene: &Scene, splats: &mut Splats, masks: &[GrayImage], watch: &mut dyn Watch) -> Result<Batch, Error> {
    let mut maps = vec![];
    for (i, view) in scene.train.iter().enumerate() {
        maps.push(DepthMap::of(splats, &view.camera)?);
        watch.turn(i as u64 + 1)?;
    }
    let kept: Vec<Vec<f32>> = (0..maps.len()).into_par_iter().map(|i| agreed(&maps, i)).collect();
    let mut batch = Batch::default();
    let (mut known, mut all) = (0u64, 0u64);
    for ((view, mut depth), mask) in scene.train.iter().zip(kept).zip(masks) {
        let size = view.camera.size;
        for (value, inside) in depth.iter_mut().zip(enlarged(mask, size).as_raw()) {
            if *inside != 0 {
                *value = f32::NAN;
            }
        }
        // Files count in the model's units.
        depth.iter_mut().for_each(|z| *z = (f64::from(*z) * scene.unit) as f32);
        known += depth.iter().filter(|v| v.is_finite()).count() as u64;
        all += depth.len() as u64;
        batch.npy(
            format!("depth/{}.npy", view.name),
            size,
            depth,
            "the fit's own depth where views agree, NaN elsewhere",
        );
    }
    let part = known as f64 / all.max(1) as f64;
    batch.notes.push(format!("{:.0} % of all pixels have a depth that views agree on", 100.0 * part));
    batch.figures.insert("known".into(), part);
    Ok(batch)
}

/// A network's output follows the sparse points if the median of its rank correlation with their depth is beyond this.
const FOLLOWS: f64 = 0.3;

/// Writes every view's map by a network, as depth or as disparity, whichever follows the sparse points.
///
/// # Errors
/// Photographs that cannot be read; a network that cannot be run, or whose maps follow the points in neither sense.
pub fn by_network(
    scene: &Scene,
    network: &network::Depth,
    files: &BTreeMap<String, PathBuf>,
    watch: &mut dyn Watch,
) -> Result<Batch, Error> {
    let mut maps = vec![];
    let mut correlations = vec![];
    for (i, view) in scene.train.iter().enumerate() {
        let picture = scene::photograph(&files[&view.name], 1)?;
        let (values, size) = proportioned(network.of(&picture)?, [picture.width(), picture.height()]);
        let prior = Prior { kind: PriorKind::Depth, values: resample::map(&values, size, view.camera.size) };
        correlations.extend(doctor::follows_points(scene, view, &prior));
        maps.push((values, size));
        watch.turn(2 * i as u64 + 2)?;
    }
    let median = median(correlations);
    let kind = match median {
        Some(r) if r.abs() < FOLLOWS => {
            let what = format!(
                "its maps follow the sparse points neither as depth nor as disparity (median rank correlation {r:.2}): the \
                 network must take RGB less (0.485, 0.456, 0.406) over (0.229, 0.224, 0.225)"
            );
            return Err(Error::File { path: network.path().to_owned(), what });
        }
        Some(r) if r < 0.0 => PriorKind::Disparity,
        Some(_) => PriorKind::Depth,
        // Most networks of this kind tell disparity.
        None => PriorKind::Disparity,
    };
    let word = word(kind);
    let mut batch = Batch::default();
    for (view, (values, size)) in scene.train.iter().zip(maps) {
        let from = format!("{}, read as {word}", network.path().display());
        batch.npy(format!("{word}/{}.npy", view.name), size, values, from);
    }
    let told = median.map_or_else(
        || "no view shows enough sparse points to tell, most networks give it".into(),
        |r| format!("median rank correlation with the sparse points' depth {r:.2}"),
    );
    batch.notes.push(format!("{} gives {word} ({told})", network.path().display()));
    batch.figures.extend(median.map(|r| ("correlation".into(), r)));
    Ok(batch)
}

/// The kind's folder, and the end of a reference prior's name.
pub fn word(kind: PriorKind) -> &'static str {
    match kind {
        PriorKind::Depth => "depth",
        PriorKind::Disparity => "disparity",
    }
}

/// A map in the proportions of its picture, no side of it longer than it was.
pub fn proportioned((values, size): (Vec<f32>, [u32; 2]), picture: [u32; 2]) -> (Vec<f32>, [u32; 2]) {
    let longer = f64::from(size[0].max(size[1]));
    let scale = (longer / f64::from(picture[0].max(picture[1]))).min(1.0);
    let to = picture.map(|side| ((f64::from(side) * scale).round() as u32).max(1));
    (resample::map(&values, size, to), to)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Looks along z from (x, 0, 0); a plane at z = 4.
    fn map(x: f64, depth: f32) -> DepthMap {
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [-x, 0.0, 0.0],
            focal: [20.0; 2],
            principal: [10.0, 8.0],
            distortion: [0.0; 4],
            size: [20, 16],
        };
        DepthMap { camera, depth: vec![depth; 20 * 16] }
    }

    /// Every pixel has the depth of the site it falls into, and of confirmed depth that of confirmed sites; of a wrong camera nothing is known.
    #[test]
    fn measured_depth_is_that_of_the_site() {
        let camera = map(0.0, 4.0).camera;
        let depth: Vec<f64> = (0..80).map(|site| 1.0 + f64::from(site)).collect();
        let (confirmed, colors) = (vec![true; 80], vec![[0; 3]; 80]);
        let mut grid = DepthGrid { camera, stride: 2, columns: 10, rows: 8, depth, confirmed, colors, trusted: true };
        let measured = DepthMap::measured(&grid, &camera);
        assert_eq!([0, 1, 2, 20, 40, 5 * 20 + 7].map(|pixel| measured.depth[pixel]), [1.0, 1.0, 2.0, 1.0, 11.0, 24.0]);
        // A picture twice as large shows the same.
        let large = DepthMap::measured(&grid, &camera.scaled([40, 32]));
        assert_eq!((large.depth.len(), large.depth[11 * 40 + 15]), (1280, 24.0));
        grid.confirmed[11] = false;
        let confirmed = DepthMap::confirmed(&grid, &camera).depth;
        assert_eq!((confirmed[41], confirmed[44]), (11.0, 13.0));
        assert!([42, 43, 62, 63].iter().all(|pixel| confirmed[*pixel].is_nan()));
        grid.trusted = false;
        assert!(DepthMap::measured(&grid, &camera).depth.iter().all(|z| z.is_nan()));
    }

    #[test]
    fn witnesses_tell_apart_what_they_see() {
        let wall = map(0.0, 4.0);
        assert_eq!(wall.witness([0.0, 0.0, 4.05], AGREE), Witness::Agrees);
        assert_eq!(wall.witness([0.0, 0.0, 5.0], AGREE), Witness::Hidden);
        assert_eq!(wall.witness([0.0, 0.0, 3.0], AGREE), Witness::Contradicts);
        assert_eq!(wall.witness([9.0, 0.0, 4.0], AGREE), Witness::Silent);
        assert_eq!(wall.witness([0.0, 0.0, -4.0], AGREE), Witness::Silent);
    }

    #[test]
    fn points_lie_where_they_are_seen() {
        let map = map(1.0, 4.0);
        let p = map.camera.lift([12.0, 8.0], 4.0).unwrap();
        // Two pixels to the right at focal length 20 and depth 4, from x = 1.
        assert!((p[0] - 1.4).abs() < 1e-12 && p[1].abs() < 1e-12 && (p[2] - 4.0).abs() < 1e-12);
        assert_eq!(map.smooth([3.3, 4.7]), 4.0);
    }

    /// Three cameras before a wall agree; the fourth, which sees something else, keeps nothing.
    #[test]
    fn depth_needs_two_witnesses() {
        let maps = [map(-0.2, 4.0), map(0.0, 4.0), map(0.2, 4.0), map(0.4, 2.5)];
        let kept = agreed(&maps, 1);
        let middle = 8 * 20 + 10;
        assert_eq!(kept[middle], 4.0);
        assert!(agreed(&maps, 3).iter().all(|v| v.is_nan()));
        // At the border only one of the others sees the point.
        assert!(agreed(&maps[..2], 1).iter().all(|v| v.is_nan()));
    }

    #[test]
    fn maps_get_the_proportions_of_their_pictures() {
        let square: Vec<f32> = (0..16).flat_map(|y| (0..16).map(move |x| (x + 10 * y) as f32)).collect();
        let (values, size) = proportioned((square, [16, 16]), [640, 320]);
        assert_eq!((size, values.len()), ([16, 8], 128));
        // Rows are means of two.
        assert_eq!((values[3], values[16]), (8.0, 25.0));
        assert_eq!(proportioned((vec![1.0; 64], [8, 8]), [6, 3]).1, [6, 3]);
    }

    #[test]
    fn neighbours_are_sorted_by_distance() {
        let cameras: Vec<Camera> = [0.0, 3.0, 1.0, -0.5].into_iter().map(|x| map(x, 1.0).camera).collect();
        assert_eq!(neighbours(&cameras, 0), [3, 2, 1]);
    }
}

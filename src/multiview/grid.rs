//! Depth of whole views: what [`points`](super::points) takes its points from.

use glam::DVec3;
use rayon::prelude::*;

use super::picture::Picture;
use super::{STRIDE, Sites, agree, depth, fill, fuse, neighbors};
use crate::gpu::{Error, Gpu};
use crate::scene::{Camera, Point, Scene, View};
use crate::statistics::quantile;

/// Depths within this share of one another are of one surface.
const SAME: f64 = 0.02;
/// A view sees through a point if what it shows there is farther by more than this share.
const THROUGH: f64 = 0.05;
/// A point of the sparse model counts where no other point and no depth within so many sites is nearer by more than this
/// share: what is before it would hide it.
const FRONT_SITES: i32 = 5;
const FRONT: f64 = 0.04;
/// Of the nine sites around a site, itself included, so many must be of its surface; else it is taken for noise.
const LEAST: usize = 3;

/// A view's depth at its sites, one for every square of [`DepthGrid::stride`] pixels.
#[derive(Clone, Debug)]
pub struct DepthGrid {
    /// The view's camera without its lens, at the size that was matched.
    pub camera: Camera,
    /// Pixels from site to site.
    pub stride: u32,
    /// Sites of a row.
    pub columns: u32,
    /// Rows of sites.
    pub rows: u32,
    /// Depth z \[row-major site\], scene units; NaN where nothing tells.
    pub depth: Vec<f64>,
    /// Whether other views confirm the depth of a \[site\], or a point of the sparse model is there; elsewhere it is taken
    /// from around.
    pub confirmed: Vec<bool>,
    /// 8-bit RGB of a \[site\].
    pub colors: Vec<[u8; 3]>,
    /// Whether its photograph agrees with the others': the camera is where the model has it.
    pub trusted: bool,
}

impl DepthGrid {
    /// Where normalised coordinates (x / z, y / z) fall, in sites: (0.5, 0.5) is the first site's centre.
    pub fn place(&self, ray: [f64; 2]) -> [f64; 2] {
        std::array::from_fn(|a| {
            (ray[a] * f64::from(self.camera.focal[a]) + f64::from(self.camera.principal[a])) / f64::from(self.stride)
        })
    }

    /// Normalised coordinates of a site's centre.
    pub fn ray(&self, [column, row]: [u32; 2]) -> [f64; 2] {
        self.ray_at([column, row].map(|n| f64::from(n) + 0.5))
    }

    /// Normalised coordinates of a place in sites.
    pub fn ray_at(&self, place: [f64; 2]) -> [f64; 2] {
        let at = place.map(|v| v * f64::from(self.stride));
        std::array::from_fn(|a| (at[a] - f64::from(self.camera.principal[a])) / f64::from(self.camera.focal[a]))
    }

    /// Pixels from site to site of the view's picture where that is so wide.
    pub fn pixels(&self, width: u32) -> f64 {
        f64::from(self.stride) * f64::from(width) / f64::from(self.camera.size[0])
    }

    /// The site there, if there is one.
    pub fn site(&self, column: i64, row: i64) -> Option<usize> {
        let inside = (0..i64::from(self.columns)).contains(&column) && (0..i64::from(self.rows)).contains(&row);
        inside.then(|| (row * i64::from(self.columns) + column) as usize)
    }

    /// Site, place in sites and depth z of a world point that is in the picture.
    pub fn see(&self, point: DVec3) -> Option<(usize, [f64; 2], f64)> {
        let [x, y, z] = self.camera.to_camera(point.to_array());
        if z <= 0.0 {
            return None;
        }
        let place = self.place([x / z, y / z]);
        let inside = place.iter().all(|v| *v >= 0.0);
        let [column, row] = place.map(|v| v as i64);
        self.site(column, row).filter(|_| inside).map(|site| (site, place, z))
    }

    /// The sites within `reach` columns and rows of one, itself included.
    pub fn around(&self, site: usize, reach: i64) -> impl Iterator<Item = usize> + '_ {
        let (x, y) = ((site as u32 % self.columns) as i64, (site as u32 / self.columns) as i64);
        (-reach..=reach).flat_map(move |dy| (-reach..=reach).filter_map(move |dx| self.site(x + dx, y + dy)))
    }

    /// The world point that a site shows; nothing where its depth is not known.
    pub fn point(&self, site: usize) -> Option<DVec3> {
        let z = self.depth[site];
        let at = [site as u32 % self.columns, site as u32 / self.columns];
        z.is_finite().then(|| DVec3::from(self.camera.along(self.ray(at), z)))
    }

    /// Depth z at a place in sites, linear in its inverse between sites of one surface; NaN where other views confirm none.
    fn between(&self, place: [f64; 2]) -> f64 {
        let inverse = |at: [f64; 2]| {
            let site = self.site(at[0] as i64, at[1] as i64).filter(|site| self.confirmed[*site]);
            site.map_or(f64::NAN, |site| 1.0 / self.depth[site])
        };
        let own = inverse(place.map(f64::floor));
        let [x, y] = place.map(|v| v - 0.5);
        let (mut sum, mut total) = (0.0, 0.0);
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let (u, v) = (x.floor() + dx, y.floor() + dy);
            let (there, weight) = (inverse([u, v]), (1.0 - (x - u).abs()) * (1.0 - (y - v).abs()));
            if (there / own - 1.0).abs() <= SAME {
                (sum, total) = (sum + weight * there, total + weight);
            }
        }
        total / sum
    }

    /// Replaces depths that hardly any of the sites around share by the median of these.
    fn despeckle(&mut self) {
        let (w, h) = (i64::from(self.columns), i64::from(self.rows));
        let one = |site: usize| {
            let (x, y) = (site as i64 % w, site as i64 / w);
            let z = self.depth[site];
            let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
            let inside = around.filter(|(x, y)| (0..w).contains(x) && (0..h).contains(y));
            let mut around: Vec<f64> = inside.map(|(x, y)| self.depth[(y * w + x) as usize]).collect();
            around.retain(|z| z.is_finite());
            let like = around.iter().filter(|other| (*other / z - 1.0).abs() <= SAME).count();
            if around.len() < LEAST || like >= LEAST {
                return z;
            }
            // One of the depths: between two surfaces there is nothing.
            quantile(around, 0.5).unwrap_or(z)
        };
        self.depth = (0..self.depth.len()).map(one).collect();
    }
}

/// The depth of every train view, by PatchMatch where other views confirm it, of the sparse model's points, and from around
/// elsewhere. All pixels count:
/// masks are not looked at where a scene was read without them.
///
/// A site without any depth in its view, or a view without neighbours, has NaN.
///
/// # Errors
/// When the device has no room or is lost.
pub fn depths(gpu: &Gpu, scene: &Scene) -> Result<Vec<DepthGrid>, Error> {
    Ok(Matched::new(gpu, scene)?.depths(scene))
}

/// Depth z of each pixel of a view as `others` of the same place measure it, `[row-major pixel]`, scene units; NaN where they do not agree. Masks
/// are not looked at: all of them show the place as it is.
///
/// # Errors
/// When the device has no room or is lost.
pub fn depth_of(gpu: &Gpu, view: &View, others: &[View], points: &[Point]) -> Result<Vec<f32>, Error> {
    let views: Vec<View> = [view].into_iter().chain(others).map(|view| View { mask: None, ..view.clone() }).collect();
    let grid = Matched::of(gpu, &views, points)?.grids(&views).swap_remove(0);
    let depth = |pixel: usize| {
        let ray = view.camera.unproject(view.camera.pixel_center(pixel))?;
        Some(grid.between(grid.place(ray)) as f32)
    };
    Ok((0..view.image.as_raw().len() / 3).into_par_iter().map(|pixel| depth(pixel).unwrap_or(f32::NAN)).collect())
}

/// The photographs of a scene, matched with each other, whatever their masks are.
pub struct Matched {
    neighbors: neighbors::Neighbors,
    /// Depths that neighbours confirm.
    confirmed: Vec<fuse::Surface>,
    /// Depths of these that more views have than look past, and of the sparse model's points.
    surfaces: Vec<fuse::Surface>,
}

impl Matched {
    /// Matches the train views of a scene.
    ///
    /// # Errors
    /// When the device has no room or is lost.
    pub fn new(gpu: &Gpu, scene: &Scene) -> Result<Self, Error> {
        Self::of(gpu, &scene.train, &scene.points)
    }

    fn of(gpu: &Gpu, views: &[View], points: &[Point]) -> Result<Self, Error> {
        let pictures: Vec<Picture> = views.par_iter().map(|view| Picture::new(view, 1)).collect();
        let neighbors = neighbors::choose(&pictures, pictures.len(), points);
        let maps = depth::estimate(gpu, &pictures, &neighbors.of, points)?;
        let confirmed = fuse::confirm(&pictures, &neighbors.of, &maps);
        let mut surfaces = seen_by_most(&pictures, confirmed.clone());
        let views = pictures.par_iter().zip(&mut surfaces);
        views.for_each(|(picture, surface)| add_points(picture, surface, points));
        Ok(Self { neighbors, confirmed, surfaces })
    }

    /// Points that the photographs add to those of the sparse model, none of views whose cameras are wrong.
    pub fn points(&self, scene: &Scene) -> Vec<Point> {
        let pictures: Vec<Picture> = scene.train.par_iter().map(|view| Picture::new(view, 1)).collect();
        let wrong = agree::wrong(&pictures, &self.neighbors, &self.confirmed);
        let known = |(surface, wrong): (&fuse::Surface, bool)| match wrong {
            true => vec![f64::NAN; surface.len()],
            false => surface.clone(),
        };
        let surfaces: Vec<fuse::Surface> = self.confirmed.iter().zip(wrong).map(known).collect();
        super::at_most(super::points(&pictures, &surfaces, &scene.points).0, &scene.train)
    }

    /// [`depths`] of the same views, with the masks that they have in this scene.
    pub fn depths(&self, scene: &Scene) -> Vec<DepthGrid> {
        self.grids(&scene.train)
    }

    fn grids(&self, views: &[View]) -> Vec<DepthGrid> {
        let pictures: Vec<Picture> = views.par_iter().map(|view| Picture::new(view, 1)).collect();
        let wrong = agree::wrong(&pictures, &self.neighbors, &self.confirmed);
        let filled = fill::fill(&pictures, &self.surfaces);
        let all = pictures.into_par_iter().zip(&self.surfaces).zip(filled).zip(wrong);
        let grids = all.map(|(((picture, surface), filled), wrong)| {
            let Sites { columns, rows } = picture.sites;
            let confirmed = surface.iter().map(|z| z.is_finite()).collect();
            let depth = surface.iter().zip(filled);
            let depth = depth.map(|(known, filled)| if known.is_finite() { *known } else { filled }).collect();
            let Picture { camera, colors, .. } = picture;
            let mut grid =
                DepthGrid { camera, stride: STRIDE, columns, rows, depth, confirmed, colors, trusted: !wrong };
            grid.despeckle();
            grid
        });
        grids.collect()
    }
}

/// The depths that more views confirm than see through: a weave that repeats itself matches at a wrong depth in neighbours,
/// and other views look past it.
fn seen_by_most(pictures: &[Picture], surfaces: Vec<fuse::Surface>) -> Vec<fuse::Surface> {
    let kept = |at: usize| -> fuse::Surface {
        let own = &pictures[at];
        let one = |site: usize| {
            let depth = surfaces[at][site];
            if depth.is_nan() {
                return depth;
            }
            let point = own.lift(own.pixel(site), depth);
            let (mut agree, mut through) = (0, 0);
            for (other, surface) in pictures.iter().zip(&surfaces) {
                let Some((pixel, z)) = other.see(point) else { continue };
                let Some(there) = other.site(pixel).map(|site| surface[site]) else { continue };
                agree += usize::from((there / z - 1.0).abs() <= SAME);
                through += usize::from(there > (1.0 + THROUGH) * z);
            }
            // Its own view agrees with itself.
            if through < agree { depth } else { f64::NAN }
        };
        (0..own.sites.len()).map(one).collect()
    };
    (0..pictures.len()).into_par_iter().map(kept).collect()
}

/// Depths of the sparse model's points at the sites that have none, where nothing around can hide the point.
fn add_points(picture: &Picture, surface: &mut fuse::Surface, points: &[Point]) {
    let mut nearest = vec![f64::INFINITY; surface.len()];
    let mut seen = vec![];
    for point in points {
        let Some((pixel, z)) = picture.see(point.position.map(f64::from)) else { continue };
        let Some(site) = picture.site(pixel) else { continue };
        nearest[site] = nearest[site].min(z);
        seen.push(site);
    }
    seen.sort_unstable();
    seen.dedup();
    let known = surface.clone();
    for site in seen.into_iter().filter(|site| known[*site].is_nan()) {
        let [x, y] = picture.sites.place(site);
        let reach = || -FRONT_SITES..=FRONT_SITES;
        let mut around = reach().flat_map(|dy| reach().filter_map(move |dx| picture.sites.at(x + dx, y + dy)));
        let before = |at: usize| nearest[at].min(known[at]) < (1.0 - FRONT) * nearest[site];
        if !around.any(before) {
            surface[site] = nearest[site];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use crate::scene::{Config, load, synthetic};

    /// The test views, whose depth is known, take part as in the test of [`points`](super::super::points).
    #[test]
    fn depths_of_whole_views_are_those_of_the_built_in_scene() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options { train_views: 16, test_views: 4, ..Default::default() };
        synthetic::write(&dir, &options).expect("a scene");
        let mut scene = load(&dir, &Config { masks: false, ..Config::default() }).expect("it loads");
        scene.train.append(&mut scene.test);
        let grids = depths(&testing::gpu(), &scene).expect("a device");
        let mut errors = vec![];
        for (grid, view) in grids.iter().zip(&scene.train) {
            let Some(truth) = &view.depth else { continue };
            for site in 0..grid.depth.len() {
                let point = grid.point(site).expect("every site has a depth");
                if let Some(pixel) = view.camera.pixel_of(point.to_array()) {
                    errors.push((grid.depth[site] / f64::from(truth[pixel]) - 1.0).abs());
                }
            }
        }
        errors.sort_by(f64::total_cmp);
        let at = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
        println!("errors: median {:.4}, of 80 % {:.4}, of 95 % {:.4}", at(0.5), at(0.8), at(0.95));
        // As in the test of `points`: confirmed depths are off by 0.002, what is guessed by up to 0.04.
        assert!(at(0.5) < 0.004 && at(0.8) < 0.03, "{} {}", at(0.5), at(0.8));
    }

    /// Depth beside the object and elsewhere against the truth: `GSCREAM_DEPTHS=SCENE:SCENE...`, as `.ci/scenes` makes them.
    #[test]
    #[ignore = "needs captures with true depth"]
    fn depths_beside_true_ones() {
        const BESIDE: i64 = 12; // pixels
        const WRONG: f64 = 0.03;
        let Ok(folders) = std::env::var("GSCREAM_DEPTHS") else { return };
        for folder in folders.split(':').map(std::path::Path::new) {
            let config = Config { masks: false, prior_folder: "none".into(), downscale: 1, ..Config::default() };
            let scene = load(folder, &config).expect("it loads");
            let began = std::time::Instant::now();
            let grids = depths(&testing::gpu(), &scene).expect("a device");
            let seconds = began.elapsed().as_secs_f64();
            let mut counts = [[0; 4]; 2]; // beside, elsewhere: sites, confirmed, wrong of these, wrong
            for (grid, view) in grids.iter().zip(&scene.train) {
                let read = |what: &str, end: &str| folder.join(what).join(format!("{}.{end}", view.name));
                let mask = image::open(read("test_masks", "png")).expect("a mask").into_luma8();
                let bytes = std::fs::read(read("test_depth", "npy")).expect("true depth");
                let (w, h) = mask.dimensions();
                let truth: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[bytes.len() - 4 * (w * h) as usize..]);
                let on = |x: i64, y: i64| {
                    let inside = x >= 0 && y >= 0 && x < i64::from(w) && y < i64::from(h);
                    inside && mask.get_pixel(x as u32, y as u32).0[0] != 0
                };
                for site in 0..grid.depth.len() {
                    let [x, y] = [site as u32 % grid.columns, site as u32 / grid.columns].map(|n| i64::from(n * 2 + 1));
                    let z = f64::from(truth[(y * i64::from(w) + x) as usize]);
                    if on(x, y) || z <= 0.0 {
                        continue;
                    }
                    let reach = || (-BESIDE..=BESIDE).step_by(3);
                    let beside = reach().any(|dy| reach().any(|dx| on(x + dx, y + dy)));
                    let off = (grid.depth[site] / z - 1.0).abs();
                    let wrong = off.is_nan() || off > WRONG;
                    let count = &mut counts[usize::from(!beside)];
                    count[0] += 1;
                    count[1] += usize::from(grid.confirmed[site]);
                    count[2] += usize::from(grid.confirmed[site] && wrong);
                    count[3] += usize::from(wrong);
                }
            }
            for (name, [sites, confirmed, known, all]) in ["beside", "elsewhere"].into_iter().zip(counts) {
                let share = |n: usize, of: usize| 100.0 * n as f64 / of.max(1) as f64;
                println!(
                    "{} {name}: {:.1} % confirmed, {:.2} % of these wrong, {:.2} % of all; {seconds:.0} s",
                    folder.file_name().unwrap_or_default().display(),
                    share(confirmed, sites),
                    share(known, confirmed),
                    share(all, sites)
                );
            }
        }
    }

    #[test]
    fn a_speck_becomes_what_is_around_it_and_an_edge_stays() {
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [20.0; 2],
            principal: [8.0; 2],
            distortion: [0.0; 4],
            size: [16, 16],
        };
        let depth: Vec<f64> = (0..64).map(|site| if site % 8 < 4 { 2.0 } else { 5.0 }).collect();
        let (confirmed, colors) = (vec![true; 64], vec![[0; 3]; 64]);
        let mut grid = DepthGrid { camera, stride: 2, columns: 8, rows: 8, depth, confirmed, colors, trusted: true };
        let clean = grid.depth.clone();
        grid.depth[18] = 0.7;
        grid.despeckle();
        assert_eq!(grid.depth, clean);
        let point = grid.point(18).expect("known");
        let place = grid.place([point.x / point.z, point.y / point.z]);
        assert!((place[0] - 2.5).abs() < 1e-9 && (place[1] - 2.5).abs() < 1e-9, "{place:?}");
    }
}

//! An object in a photograph: which of its pixels show it, and where its shadow falls.

use glam::{DMat3, DVec3};
use image::{GrayImage, Luma, Rgb, RgbImage};

use super::object::Object;
use super::stand::Stand;
use crate::multiview::DepthGrid;
use crate::scene::Camera;

/// Rays of a pixel in each direction.
const SAMPLES: u32 = 4;
/// Sites around a pixel that say how deep it is, in each direction.
const REACH: i64 = 2;
/// Fall-off of a site's say with its distance in sites, and with the distance of its colour in 8-bit levels.
const SITES: f64 = 1.1;
const LEVELS: f64 = 22.0;
/// Say of a site of any other colour.
const OTHER: f64 = 0.01;
/// Say of a site whose depth is only taken from around.
const GUESSED: f64 = 0.3;
/// The scene hides the object where it is nearer by this share of the depth, or of the object's height ...
const NEARER: f64 = 0.012;
const NEARER_HEIGHT: f64 = 0.06;
/// ... and higher above the ground than this share of the object's height, and than its roughness.
const GROUND: f64 = 0.05;
const ROUGHNESS: f64 = 2.5;
const MOST_GROUND: f64 = 0.2;
/// A pixel that shows less of the object than this stays as it was.
const LEAST: f64 = 0.02;
/// Pixels of a block that is looked at for a shadow.
const BLOCK: u32 = 8;

/// An object in the world.
#[derive(Clone, Debug)]
pub struct Placed {
    /// In its own axes.
    pub object: Object,
    /// Where it stands.
    pub stand: Stand,
    /// The object's axes in the world, by column.
    axes: DMat3,
}

impl Placed {
    /// The object turned about its up by an angle.
    pub fn new(object: Object, stand: Stand, turn: f64) -> Self {
        let (u, v) = stand.up.any_orthonormal_pair();
        let right = turn.cos() * u + turn.sin() * v;
        Self { object, stand, axes: DMat3::from_cols(right, stand.up.cross(right), stand.up) }
    }

    /// A world point in the object's axes and heights.
    pub fn local(&self, point: DVec3) -> DVec3 {
        self.axes.transpose() * (point - self.stand.foot) / self.stand.height
    }

    /// A point in the object's axes and heights in the world.
    pub fn world(&self, point: DVec3) -> DVec3 {
        self.stand.foot + self.axes * point * self.stand.height
    }

    /// A camera's ray in the object's axes; its parameter is the depth z.
    fn ray(&self, camera: &Camera, [x, y]: [f64; 2]) -> DVec3 {
        let rows = camera.rotation.map(|row| DVec3::from(row.map(f64::from)));
        self.axes.transpose() * (rows[0] * x + rows[1] * y + rows[2]) / self.stand.height
    }

    /// Where a camera's pixel meets it, and at which depth z; whatever stands before it.
    pub fn meet(&self, camera: &Camera, pixel: [f64; 2]) -> Option<(DVec3, f64)> {
        let eye = self.local(DVec3::from(camera.center()));
        let hit = self.object.hit(eye, self.ray(camera, camera.unproject(pixel)?))?;
        Some((self.world(hit.position), hit.at))
    }

    /// Heights above the ground, in those of the object, up to which the scene is taken for ground.
    fn ground(&self) -> f64 {
        (GROUND + ROUGHNESS * self.stand.roughness / self.stand.height).min(MOST_GROUND)
    }

    /// The pixels x0, y0 to one past x1, y1 that can show a ball of the object's axes.
    fn bounds(&self, camera: &Camera, (center, radius): (DVec3, f64)) -> [u32; 4] {
        let [w, h] = camera.size;
        let all = [0, 0, w, h];
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        // A ball fits into the hull of the places of a grid on one that is a quarter larger.
        for (i, j) in (0..=8).flat_map(|i| (0..16).map(move |j| (f64::from(i), f64::from(j)))) {
            let (tilt, turn) = (i * std::f64::consts::PI / 8.0, j * std::f64::consts::PI / 8.0);
            let out = DVec3::new(tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos());
            let point = self.world(center + 1.25 * radius * out).to_array();
            let Some([x, y]) = camera.project(point) else { return all };
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
        }
        let at = |v: f64, most: u32| v.clamp(0.0, f64::from(most)) as u32;
        [at(bounds[0] - 2.0, w), at(bounds[1] - 2.0, h), at(bounds[2] + 3.0, w), at(bounds[3] + 3.0, h)]
    }
}

/// A photograph with the object.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawn {
    /// The photograph; where neither the object nor its shadow is, its pixels are those that it had.
    pub picture: RgbImage,
    /// 255 where it shows the object.
    pub mask: GrayImage,
    /// How bright the surface still is within the shadow, of 255. The object itself counts as not there.
    pub shadow: Option<GrayImage>,
}

/// A photograph with its depths.
struct View<'a> {
    placed: &'a Placed,
    camera: &'a Camera,
    grid: &'a DepthGrid,
    photograph: &'a RgbImage,
    /// The camera's centre in the object's axes.
    eye: DVec3,
    /// Places of the sites in the object's axes; not a number where nothing is known.
    places: Vec<DVec3>,
}

/// A site near a pixel and its say.
#[derive(Clone, Copy)]
struct Vote {
    site: usize,
    weight: f64,
}

/// Draws the object, its colours multiplied by `gain`, into a photograph of which `grid` has the depth.
pub fn draw(
    placed: &Placed,
    camera: &Camera,
    grid: &DepthGrid,
    photograph: &RgbImage,
    gain: f64,
    shadow: bool,
) -> Drawn {
    let place = |site: usize| grid.point(site).map_or(DVec3::NAN, |point| placed.local(point));
    let view = View {
        placed,
        camera,
        grid,
        photograph,
        eye: placed.local(DVec3::from(camera.center())),
        places: (0..grid.depth.len()).map(place).collect(),
    };
    let [w, h] = camera.size;
    let shadow = shadow.then(|| view.shadow());
    let mut picture = photograph.clone();
    if let Some(shadow) = &shadow {
        for (pixel, left) in picture.pixels_mut().zip(shadow.pixels()).filter(|(_, left)| left.0[0] < 255) {
            pixel.0 = pixel.0.map(|v| darkened(v, left.0[0]));
        }
    }
    let mut mask = GrayImage::new(w, h);
    let [x0, y0, x1, y1] = placed.bounds(camera, placed.object.ball());
    for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
        let Some((color, share)) = view.object(x, y) else { continue };
        let color = (color * gain).min(DVec3::ONE).to_array();
        let pixel = picture.get_pixel_mut(x, y);
        let mixed = std::array::from_fn(|c| share * 255.0 * color[c] + (1.0 - share) * f64::from(pixel.0[c]));
        *pixel = Rgb(mixed.map(|v| v.round() as u8));
        mask.put_pixel(x, y, Luma([255]));
    }
    Drawn { picture, mask, shadow }
}

/// A stored value in a shadow that leaves so many 255ths of it: the same ratio in every channel.
pub fn darkened(value: u8, left: u8) -> u8 {
    ((u32::from(value) * u32::from(left) + 127) / 255) as u8
}

/// 0 below 0, 1 above 1, smooth between.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

impl View<'_> {
    /// Colour of the object at a pixel and the share of the pixel that shows it, if it shows any.
    fn object(&self, x: u32, y: u32) -> Option<(DVec3, f64)> {
        let object = &self.placed.object;
        let (mut color, mut depth, mut met) = (DVec3::ZERO, 0.0, 0.0);
        for (i, j) in (0..SAMPLES).flat_map(|j| (0..SAMPLES).map(move |i| (i, j))) {
            let at = |n: u32, i: u32| f64::from(n) + (f64::from(i) + 0.5) / f64::from(SAMPLES);
            let Some(ray) = self.camera.unproject([at(x, i), at(y, j)]) else { continue };
            let Some(hit) = object.hit(self.eye, self.placed.ray(self.camera, ray)) else { continue };
            color += object.color(&hit);
            depth += hit.at;
            met += 1.0;
        }
        if met == 0.0 {
            return None;
        }
        let share = met / f64::from(SAMPLES * SAMPLES) * (1.0 - self.hidden(x, y, depth / met));
        (share >= LEAST).then_some((color / met, share))
    }

    /// The sites around a pixel, those of its colour first of all.
    fn votes(&self, x: u32, y: u32) -> Option<([f64; 2], Vec<Vote>)> {
        let ray = self.camera.unproject([f64::from(x) + 0.5, f64::from(y) + 0.5])?;
        let at = self.grid.place(ray);
        let [column, row] = at.map(|p| p.floor() as i64);
        let own = self.photograph.get_pixel(x, y).0;
        let mut votes = vec![];
        for (dx, dy) in (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (dx, dy))) {
            let Some(site) = self.grid.site(column + dx, row + dy) else { continue };
            if self.grid.depth[site].is_nan() {
                continue;
            }
            let away = [column + dx, row + dy].map(|n| n as f64 + 0.5);
            let apart = (away[0] - at[0]).powi(2) + (away[1] - at[1]).powi(2);
            let color: f64 =
                (0..3).map(|c| (f64::from(own[c]) - f64::from(self.grid.colors[site][c])).powi(2)).sum::<f64>() / 3.0;
            let alike = (-0.5 * color / (LEVELS * LEVELS)).exp().max(OTHER);
            let known = if self.grid.confirmed[site] { 1.0 } else { GUESSED };
            votes.push(Vote { site, weight: (-0.5 * apart / (SITES * SITES)).exp() * alike * known });
        }
        Some((ray, votes))
    }

    /// How much of the object, at this depth, the scene hides at a pixel.
    fn hidden(&self, x: u32, y: u32, depth: f64) -> f64 {
        let Some((_, votes)) = self.votes(x, y) else { return 0.0 };
        let nearer = (NEARER * depth).max(NEARER_HEIGHT * self.placed.stand.height);
        let ground = self.placed.ground();
        let (mut sum, mut hiding) = (0.0, 0.0);
        for Vote { site, weight } in votes {
            // Seen from above the ground nothing of it can hide what stands on it.
            let high = if self.eye.z > 0.0 { smooth(self.places[site].z / ground - 1.0) } else { 1.0 };
            sum += weight;
            hiding += weight * high * smooth((depth - self.grid.depth[site]) / nearer - 1.0);
        }
        if sum > 0.0 { smooth((hiding / sum - 0.3) / 0.4) } else { 0.0 }
    }

    /// Where the ground is at a ray, in the object's axes.
    fn on_ground(&self, ray: [f64; 2]) -> Option<DVec3> {
        let ray = self.placed.ray(self.camera, ray);
        let t = -self.eye.z / ray.z;
        (t.is_finite() && t > 0.0).then(|| self.eye + ray * t)
    }

    /// The share of the brightness that is left at each pixel.
    fn shadow(&self) -> GrayImage {
        let [w, h] = self.camera.size;
        let mut left = GrayImage::from_pixel(w, h, Luma([255]));
        let [columns, rows] = [w, h].map(|n| n.div_ceil(BLOCK));
        let mut looked = vec![false; columns as usize * rows as usize];
        for (site, place) in self.places.iter().enumerate().filter(|(_, place)| place.is_finite()) {
            if self.placed.object.hides_nothing(*place) {
                continue;
            }
            let at = [site as u32 % self.grid.columns, site as u32 / self.grid.columns];
            let Some(point) = self.camera.project(self.camera.along(self.grid.ray(at), 1.0)) else { continue };
            // A site and those that a pixel asks around it.
            let across = f64::from(w) / f64::from(self.grid.columns) * (REACH + 2) as f64;
            let block = |v: f64, most: u32| (v / f64::from(BLOCK)).floor().clamp(0.0, f64::from(most - 1)) as u32;
            let [left, right] = [point[0] - across, point[0] + across].map(|v| block(v, columns));
            let [top, low] = [point[1] - across, point[1] + across].map(|v| block(v, rows));
            for (x, y) in (top..=low).flat_map(|y| (left..=right).map(move |x| (x, y))) {
                looked[(y * columns + x) as usize] = true;
            }
        }
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            if looked[(y / BLOCK * columns + x / BLOCK) as usize] {
                let share = self.placed.object.light.share * self.shaded(x, y);
                left.put_pixel(x, y, Luma([(255.0 * (1.0 - share)).round() as u8]));
            }
        }
        left
    }

    /// The share of the lamp that is hidden from the surface at a pixel.
    fn shaded(&self, x: u32, y: u32) -> f64 {
        let object = &self.placed.object;
        let Some((ray, votes)) = self.votes(x, y) else { return 0.0 };
        let ground = self.placed.ground();
        let is_ground = |site: usize| self.places[site].z.abs() <= 2.0 * ground;
        let (on, off): (Vec<Vote>, Vec<Vote>) = votes.into_iter().partition(|vote| is_ground(vote.site));
        let sum = |votes: &[Vote]| votes.iter().map(|v| v.weight).sum::<f64>();
        let (on, all) = (sum(&on), sum(&on) + sum(&off));
        if all == 0.0 {
            return 0.0;
        }
        let share = smooth((on / all - 0.3) / 0.4);
        let mut shaded = 0.0;
        if share > 0.0
            && let Some(place) = self.on_ground(ray)
        {
            shaded += share * object.hides(place);
        }
        if share < 1.0
            && let Some(first) = off.iter().max_by(|a, b| a.weight.total_cmp(&b.weight))
        {
            // The mean over those of one surface.
            let z = self.grid.depth[first.site];
            let same = off.iter().filter(|v| (self.grid.depth[v.site] / z - 1.0).abs() <= 0.03);
            let (sum, weights) =
                same.fold((0.0, 0.0), |(s, w), v| (s + v.weight * self.grid.depth[v.site], w + v.weight));
            let place = self.eye + self.placed.ray(self.camera, ray) * (sum / weights);
            shaded += (1.0 - share) * object.hides(place);
        }
        shaded
    }
}

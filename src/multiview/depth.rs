//! Depth of every view by PatchMatch.

use std::collections::VecDeque;

use rayon::prelude::*;

use super::picture::{Picture, elements};
use super::score::{self, Pictures, RELATION, VIEWS, WORST};
use super::{CANDIDATES, Grid, Round, choose, propose};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::scene::{Point, samples};

/// Of each round the distance of farther neighbours, odd so that they are of the other colour, and how far random planes
/// are from a site's own, as a share of the range.
const ROUNDS: [(u32, f32); 4] = [(9, 0.05), (5, 0.02), (3, 0.007), (3, 0.0025)];
/// Depths looked at: from this much nearer than the nearest hundredth of the points that a view sees to this much farther
/// than the farthest hundredth.
const NEARER: f64 = 0.6;
const FARTHER: f64 = 3.0;

/// What matching found in a view, by site.
pub(super) struct Map {
    /// Inverse depth at the site's pixel, slopes per pixel.
    pub planes: Vec<[f32; 3]>,
    /// 0 (the views agree) to [`WORST`].
    pub costs: Vec<f32>,
}

/// What a view begins with: its sites and a plane at each.
type Start = (Grid, Vec<[f32; 3]>);

/// Matches every view that has neighbours and sees points; `None` for the others.
///
/// # Errors
/// When the device has no room or is lost.
pub(super) fn estimate(
    gpu: &Gpu,
    pictures: &[Picture],
    neighbors: &[Vec<usize>],
    points: &[Point],
) -> Result<Vec<Option<Map>>, Error> {
    let upload = |picture: &Picture| gpu.upload("multiview_picture", &elements(&picture.grey, picture.camera.size));
    let buffers: Vec<Buffer<u32>> = pictures.iter().map(upload).collect::<Result<_, _>>()?;
    let starts: Vec<Option<Start>> = (pictures.par_iter().zip(neighbors))
        .map(|(picture, near)| if near.is_empty() { None } else { start(picture, points) })
        .collect();
    let one = |(at, start): (usize, Option<Start>)| {
        let Some((grid, planes)) = start else { return Ok(None) };
        let near = &neighbors[at][..neighbors[at].len().min(VIEWS)];
        let relation =
            gpu.upload("multiview_relation", &relation(&pictures[at], near.iter().map(|n| &pictures[*n])))?;
        let of = Pictures {
            own: &buffers[at],
            others: std::array::from_fn(|k| &buffers[near.get(k).copied().unwrap_or(at)]),
            relation: &relation,
            views: near.len() as u32,
        };
        let matching = Matching::new(gpu, grid, &planes)?;
        let mut rec = gpu.recorder()?;
        matching.record(&mut rec, of, at as u32);
        rec.submit()?.wait()?;
        Ok(Some(Map { planes: gpu.read(&matching.plane)?, costs: gpu.read(&matching.cost)? }))
    };
    starts.into_iter().enumerate().map(one).collect()
}

/// A view's buffers.
struct Matching {
    grid: Grid,
    plane: Buffer<[f32; 3]>,
    cost: Buffer<f32>,
    candidate: Buffer<[f32; 3]>,
    score: Buffer<f32>,
}

impl Matching {
    fn new(gpu: &Gpu, grid: Grid, planes: &[[f32; 3]]) -> Result<Self, Error> {
        let candidates = (grid.sites.of_color() * CANDIDATES) as usize;
        Ok(Self {
            grid,
            plane: gpu.upload("multiview_plane", planes)?,
            cost: gpu.upload("multiview_cost", &vec![WORST; planes.len()])?,
            candidate: gpu.buffer("multiview_candidate", candidates)?,
            score: gpu.buffer("multiview_score", candidates)?,
        })
    }

    /// All rounds; `seed` is the number of the view.
    fn record(&self, rec: &mut Recorder<'_>, of: Pictures<'_>, seed: u32) {
        let Self { grid, plane, cost, candidate, score } = self;
        for (draw, (round, color)) in ROUNDS.iter().flat_map(|round| [(round, 0), (round, 1)]).enumerate() {
            let round = Round { color, reach: round.0, draw: draw as u32, spread: round.1 };
            propose::record(rec, plane, candidate, grid, round, seed);
            score::record(rec, of, candidate, score, grid, color);
            choose::record(rec, candidate, score, plane, cost, grid, color);
        }
    }
}

/// The planes to begin with: each site has the depth of the nearest point in the picture, facing the camera.
fn start(picture: &Picture, points: &[Point]) -> Option<Start> {
    let seen = samples(&picture.camera, points, None);
    let mut depths: Vec<f64> = seen.iter().map(|s| s.depth).collect();
    depths.sort_unstable_by(f64::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let (near, far) = (depths[last / 100], depths[last - last / 100]);
    let sites = picture.sites;
    let mut planes: Vec<Option<f32>> = vec![None; sites.len()];
    let mut queue = VecDeque::new();
    for sample in seen {
        let w = picture.camera.size[0] as usize;
        let pixel = [(sample.pixel % w) as f64 + 0.5, (sample.pixel / w) as f64 + 0.5];
        let Some(site) = picture.site(pixel) else { continue };
        if planes[site].is_none() {
            planes[site] = Some((1.0 / sample.depth) as f32);
            queue.push_back(site);
        }
    }
    while let Some(site) = queue.pop_front() {
        let [x, y] = sites.place(site);
        for [dx, dy] in [[1, 0], [-1, 0], [0, 1], [0, -1]] {
            let Some(next) = sites.at(x + dx, y + dy).filter(|next| planes[*next].is_none()) else { continue };
            planes[next] = planes[site];
            queue.push_back(next);
        }
    }
    let planes: Vec<[f32; 3]> = planes.into_iter().map(|w| w.map(|w| [w, 0.0, 0.0])).collect::<Option<_>>()?;
    let range = [1.0 / (FARTHER * far), 1.0 / (NEARER * near)].map(|w| w as f32);
    let tilt = 1.0 / picture.camera.focal[0].max(picture.camera.focal[1]);
    Some((Grid { size: picture.camera.size, sites, range, tilt }, planes))
}

/// How other pictures see the pixels of one, as `glsl/multiview/score.comp` reads it.
fn relation<'p>(own: &Picture, others: impl Iterator<Item = &'p Picture>) -> Vec<[f32; 4]> {
    let mut relation = vec![[0.0; 4]; RELATION];
    let rows = |picture: &Picture| picture.camera.rotation.map(|row| row.map(f64::from));
    let from = rows(own);
    let [f, c] = [own.camera.focal, own.camera.principal].map(|v| v.map(f64::from));
    for (k, other) in others.enumerate() {
        let to = rows(other);
        let turned = |row: usize, axis: usize| (0..3).map(|i| to[row][i] * from[axis][i]).sum::<f64>();
        let step: [f64; 3] = std::array::from_fn(|i| own.center[i] - other.center[i]);
        let [fo, co] = [other.camera.focal, other.camera.principal].map(|v| v.map(f64::from));
        // Rows of R' R^T K^-1 and R' (c - c'), then times K'.
        let camera: [[f64; 4]; 3] = std::array::from_fn(|row| {
            let r: [f64; 3] = std::array::from_fn(|axis| turned(row, axis));
            let shift = (0..3).map(|i| to[row][i] * step[i]).sum();
            [r[0] / f[0], r[1] / f[1], r[2] - r[0] * c[0] / f[0] - r[1] * c[1] / f[1], shift]
        });
        for e in 0..4 {
            relation[e][k] = (fo[0] * camera[0][e] + co[0] * camera[2][e]) as f32;
            relation[4 + e][k] = (fo[1] * camera[1][e] + co[1] * camera[2][e]) as f32;
            relation[8 + e][k] = camera[2][e] as f32;
        }
        relation[12][k] = other.camera.size[0] as f32;
        relation[13][k] = other.camera.size[1] as f32;
    }
    relation
}

#[cfg(test)]
mod tests {
    use super::super::neighbors;
    use super::*;
    use crate::gpu::testing;
    use crate::scene::{Config, load, synthetic};

    /// Every pass of a view's matching beside its twin, on what the device made so far.
    #[test]
    fn passes_match_their_twins() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options { width: 64, height: 48, train_views: 5, points: 400, ..Default::default() };
        synthetic::write(&dir, &options).expect("a scene");
        let scene = load(&dir, &Config::default()).expect("it loads");
        let pictures: Vec<Picture> = scene.train.iter().map(|view| Picture::new(view, 1)).collect();
        let near = &neighbors::choose(&pictures, 5, &scene.points).of[2];
        assert_eq!(near.len(), 4);
        let gpu = testing::gpu();
        let upload = |at: &usize| gpu.upload("picture", &elements(&pictures[*at].grey, [64, 48])).expect("upload");
        let (own, others): (_, Vec<Buffer<u32>>) = (upload(&2), near.iter().map(upload).collect());
        let relation = relation(&pictures[2], near.iter().map(|n| &pictures[*n]));
        let relation = gpu.upload("relation", &relation).expect("upload");
        let of = Pictures { own: &own, others: std::array::from_fn(|k| &others[k]), relation: &relation, views: 4 };
        let (grid, planes) = start(&pictures[2], &scene.points).expect("points");
        let matching = Matching::new(&gpu, grid, &planes).expect("buffers");
        let mut rec = gpu.checked().expect("recorder");
        matching.record(&mut rec, of, 2);
        let submission = rec.submit().expect("submit");
        assert_eq!(submission.differences.len(), 4 * 2 * ROUNDS.len(), "four outputs of three passes, both colours");
        for difference in &submission.differences {
            assert!(difference.ok(), "{difference}");
        }
        submission.wait().expect("wait");
        let costs = gpu.read(&matching.cost).expect("read");
        let agree = costs.iter().filter(|c| **c < 0.5).count();
        assert!(agree * 2 > costs.len(), "{agree} of {}", costs.len());
    }
}

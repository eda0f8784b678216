use super::backward::subgroups;
use super::*;
use crate::gpu::kernels::render::{rasterize, rasterize_backward, rasterize_gather};
use crate::gpu::testing::{self, UNWRITTEN};
use crate::math::camera::factors;
use crate::math::tiles::Support;
use crate::render::bin::{CUT, CUT_VALUES};
use crate::render::config::ALPHA_MIN;
use crate::render::tiling::Tiling;
use crate::skip::{Lack, skip};
use rand::{RngExt, SeedableRng};

/// Random Gaussians in screen space, binned on the host.
#[derive(Default)]
struct Scene {
    covariance: Vec<[f32; 3]>,
    mean: Vec<[f32; 2]>,
    conic: Vec<[f32; 3]>,
    opacity: Vec<f32>,
    color: Vec<[f32; 3]>,
    depth: Vec<f32>,
    tiles: Vec<u32>,
    first_pair: Vec<u32>,
    pair_slot: Vec<u32>,
    sorted: Vec<u32>,
    ranges: Vec<[u32; 2]>,
    cut_tile: Vec<u32>,
}

fn scene(seed: u64, n: usize, size: [u32; 2], tiling: Tiling, alpha_min: f32) -> Scene {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let mut s = Scene::default();
    let grid = tiling.grid(size);
    for _ in 0..n {
        let (angle, a, b) = (rng.random_range(0f32..3.2), rng.random_range(0.3..9.0), rng.random_range(0.3..9.0));
        let (sin, cos) = angle.sin_cos();
        let (a, b) = (a * a, b * b);
        let entries = [cos * cos * a + sin * sin * b + 0.3, cos * sin * (a - b), sin * sin * a + cos * cos * b + 0.3];
        s.covariance.push(factors(entries.map(f64::from)).map(|v| v as f32));
        s.mean.push(std::array::from_fn(|i| rng.random_range(-4.0..size[i] as f32 + 4.0)));
        s.opacity.push(rng.random_range(0.05..0.999));
        s.color.push(std::array::from_fn(|_| rng.random_range(0.0..1.0)));
        s.depth.push(rng.random_range(1.0..9.0));
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| s.depth[a].total_cmp(&s.depth[b]));
    (s.tiles, s.first_pair) = (vec![0; n], vec![0; n]);
    s.conic = s.covariance.iter().map(|&[n, k, v]| [1.0 / n, k, 1.0 / v]).collect();
    let mut pairs = vec![];
    for slot in order {
        let alpha = (s.opacity[slot], alpha_min);
        let support = Support::new(s.mean[slot], s.covariance[slot], alpha, tiling.side(), grid);
        let mut found = support.tiles(s.mean[slot], tiling.side(), grid);
        // Some were counted once too often: that pair touches no tile.
        found.extend((slot % 7 == 3).then_some(grid[0] * grid[1]));
        s.first_pair[slot] = pairs.len() as u32;
        s.tiles[slot] = found.len() as u32;
        for tile in found {
            pairs.push((tile, pairs.len() as u32));
            s.pair_slot.push(slot as u32);
        }
    }
    pairs.sort_by_key(|p| p.0);
    s.ranges = vec![[0; 2]; (grid[0] * grid[1] + 1) as usize];
    for (i, &(tile, pair)) in pairs.iter().enumerate() {
        if s.ranges[tile as usize] == [0, 0] {
            s.ranges[tile as usize][0] = i as u32;
        }
        s.ranges[tile as usize][1] = i as u32 + 1;
        s.sorted.push(pair);
    }
    let cuts = (pairs.len() as u32).saturating_sub(1) / CUT;
    s.cut_tile = vec![cuts];
    s.cut_tile.extend((1..=cuts).map(|cut| (cut * CUT) as usize).map(|at| {
        let (before, behind) = (pairs[at - 1].0, pairs[at].0);
        if before == behind { behind + 1 } else { 0 }
    }));
    s
}

/// A case of the forward pass, with what the outputs and the tiles ask for.
fn forward_case(s: &Scene, tiling: Tiling, size: [u32; 2], outputs: Outputs) -> rasterize::Arrays {
    let pixels = (size[0] * size[1]) as usize;
    let (map, narrow) = (vec![UNWRITTEN; pixels], tiling == Tiling::Narrow);
    let depth = outputs != Outputs::Color;
    rasterize::Arrays {
        ranges: s.ranges.clone(),
        sorted: s.sorted.clone(),
        pair_slot: s.pair_slot.clone(),
        mean: s.mean.clone(),
        conic: s.conic.clone(),
        opacity: s.opacity.clone(),
        color: s.color.clone(),
        rgb: vec![[UNWRITTEN; 3]; pixels],
        depth: depth.then(|| s.depth.clone()),
        depth_map: depth.then(|| map.clone()),
        transmittance: (outputs == Outputs::Transmittance).then_some(map),
        cut_state: (!narrow).then(|| vec![UNWRITTEN; s.cut_tile.len() * CUT_VALUES]),
        blended: narrow.then(|| vec![[7; 2]; s.pair_slot.len()]),
        blended_count: narrow.then(|| vec![7; s.ranges.len()]),
    }
}

/// The tiles that a device can have.
fn tilings(gpu: &Gpu) -> impl Iterator<Item = Tiling> {
    [Tiling::Wide].into_iter().chain(gpu.runs_lanes().then_some(Tiling::Narrow))
}

const OUTPUTS: [Outputs; 3] = [Outputs::Color, Outputs::Depth, Outputs::Transmittance];

/// Alpha and transmittance thresholds.
const THRESHOLDS: [(f32, f32); 3] = [(1.0 / 255.0, 1e-4), (1e-3, 0.0), (0.05, 0.02)];

const SIZES: [[u32; 2]; 5] = [[1, 1], [17, 3], [63, 41], [64, 64], [129, 8]];

#[test]
fn forward_matches_its_twin() {
    let gpu = testing::gpu();
    for (i, size) in SIZES.into_iter().enumerate() {
        let (alpha_min, transmittance_min) = THRESHOLDS[i % THRESHOLDS.len()];
        for (n, tiling) in [0, 1, 65, 700, 1500].into_iter().flat_map(|n| tilings(&gpu).map(move |tiling| (n, tiling)))
        {
            let s = scene(i as u64, n, size, tiling, alpha_min);
            let grid = tiling.grid(size);
            for outputs in OUTPUTS {
                let case = forward_case(&s, tiling, size, outputs);
                let push = rasterize::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
                let threads = [grid[0] * tiling.threads(), grid[1], 1];
                let constants = rasterize::Constants { alpha_min, transmittance_min };
                let kernel = rasterize::Kernel::from(tiling.form());
                testing::assert_twin_with(kernel, &gpu, constants, case, push, threads);
            }
        }
    }
}

#[test]
fn backward_matches_its_twin() {
    let gpu = testing::gpu();
    let subgroups = subgroups(&gpu);
    for (i, size) in SIZES.into_iter().enumerate() {
        let (alpha_min, transmittance_min) = THRESHOLDS[i % THRESHOLDS.len()];
        for (n, tiling) in [0, 1, 65, 300, 1500].into_iter().flat_map(|n| tilings(&gpu).map(move |tiling| (n, tiling)))
        {
            // Without an end a pixel of so many is 1e-300 of the background, and what is left of its sum noise of either side.
            if n > 1000 && transmittance_min == 0.0 {
                continue;
            }
            let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(i as u64);
            let s = scene(i as u64, n, size, tiling, alpha_min);
            let (pixels, pairs) = ((size[0] * size[1]) as usize, s.pair_slot.len());
            let grid = tiling.grid(size);
            let threads = [grid[0] * tiling.threads(), grid[1], 1];
            let push = rasterize::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
            let constants = rasterize::Constants { alpha_min, transmittance_min };
            let case = forward_case(&s, tiling, size, Outputs::Transmittance);
            let kernel = rasterize::Kernel::from(tiling.form());
            let picture = testing::run_once_with(kernel, &gpu, constants, &case, push, threads);
            let mut random = || (0..pixels).map(|_| rng.random_range(-1f32..1.0)).collect::<Vec<f32>>();
            let (grad_depth_map, grad_transmittance) = (random(), random());
            for outputs in OUTPUTS {
                let (depth, left) = (outputs != Outputs::Color, outputs == Outputs::Transmittance);
                let wide = tiling == Tiling::Wide;
                let case = rasterize_backward::Arrays {
                    ranges: s.ranges.clone(),
                    sorted: wide.then(|| s.sorted.clone()),
                    pair_slot: wide.then(|| s.pair_slot.clone()),
                    mean: s.mean.clone(),
                    conic: s.conic.clone(),
                    opacity: s.opacity.clone(),
                    color: s.color.clone(),
                    rgb: picture.rgb.clone(),
                    grad_rgb: (0..pixels).map(|p| [grad_depth_map[p], -grad_transmittance[p], 0.5]).collect(),
                    pair_mean: vec![[UNWRITTEN; 2]; pairs],
                    pair_conic: vec![[UNWRITTEN; 3]; pairs],
                    pair_opacity: vec![UNWRITTEN; pairs],
                    pair_color: vec![[UNWRITTEN; 3]; pairs],
                    depth: depth.then(|| s.depth.clone()),
                    depth_map: picture.depth_map.clone().filter(|_| depth),
                    grad_depth_map: depth.then(|| grad_depth_map.clone()),
                    pair_depth: depth.then(|| vec![UNWRITTEN; pairs]),
                    transmittance: picture.transmittance.clone().filter(|_| left),
                    grad_transmittance: left.then(|| grad_transmittance.clone()),
                    cut_tile: wide.then(|| s.cut_tile.clone()),
                    cut_state: picture.cut_state.clone(),
                    blended: picture.blended.clone(),
                    blended_count: picture.blended_count.clone(),
                    marks: (!wide).then(|| vec![0; pairs.div_ceil(32)]),
                };
                let push = rasterize_backward::Push { size, tiles_x: grid[0] };
                let constants = rasterize_backward::Constants { alpha_min, transmittance_min, subgroups };
                let kernel = rasterize_backward::Kernel::from(tiling.form());
                let side = tiling.threads_backward();
                if wide {
                    let parts = (grid[0] * grid[1]) as usize + s.cut_tile.len() - 1;
                    testing::assert_twin_with(kernel, &gpu, constants, case, push, parts * side as usize);
                } else {
                    let threads = [grid[0] * side, grid[1], 1];
                    testing::assert_twin_with(kernel, &gpu, constants, case, push, threads);
                }
            }
        }
    }
}

/// Narrow tiles list the pairs of which a pixel takes something, nearest first, and no others. A sample within rounding
/// of a threshold may flip (see `PICTURE`): of a hundred samples of a pair the only one that counts is rarely that.
#[test]
fn lists_hold_what_is_blended() {
    let gpu = testing::gpu();
    if !gpu.runs_lanes() {
        skip(Lack::SubgroupsOf8, "narrow tiles need subgroups of 8 threads");
        return;
    }
    let size = [129, 97];
    for (alpha_min, transmittance_min) in THRESHOLDS {
        let s = scene(3, 2000, size, Tiling::Narrow, alpha_min);
        let case = forward_case(&s, Tiling::Narrow, size, Outputs::Color);
        let grid = Tiling::Narrow.grid(size);
        let push = rasterize::Push { size, tiles_x: grid[0], background: [0.0; 3] };
        let constants = rasterize::Constants { alpha_min, transmittance_min };
        let threads = [grid[0] * Tiling::Narrow.threads(), grid[1], 1];
        let got = testing::run_once_with(rasterize::Kernel::Cpu, &gpu, constants, &case, push, threads);
        let lists = got.blended.zip(got.blended_count);
        let (blended, blended_count) = lists.expect("the form for CPU drivers lists what it blends");
        let splats = Splats {
            ranges: &case.ranges,
            sorted: &case.sorted,
            pair_slot: &case.pair_slot,
            mean: &case.mean,
            conic: &case.conic,
            opacity: &case.opacity,
            color: &case.color,
            alpha_min,
            transmittance_min,
        };
        let mut seen = vec![false; case.pair_slot.len()];
        for p in 0..size[0] * size[1] {
            splats.walk([p % size[0], p / size[0]], 8, grid[0], |at, _, _, _, w| {
                seen[case.sorted[at] as usize] |= w >= f64::from(f32::MIN_POSITIVE);
            });
        }
        let (mut listed, mut other) = (0, 0);
        for tile in 0..(grid[0] * grid[1]) as usize {
            let [first, end] = case.ranges[tile].map(|i| i as usize);
            let list = &blended[first..][..blended_count[tile] as usize];
            assert!(list.iter().all(|[pair, slot]| case.pair_slot[*pair as usize] == *slot));
            let numbers: Vec<u32> = list.iter().map(|[pair, _]| *pair).collect();
            let mut rest = numbers.iter().peekable();
            for &pair in &case.sorted[first..end] {
                let has = rest.next_if_eq(&&pair).is_some();
                listed += usize::from(has);
                other += usize::from(has != seen[pair as usize]);
            }
            assert!(rest.next().is_none(), "tile {tile}: {numbers:?} is not in the list's order");
        }
        assert!(listed > 1000 && listed < seen.len(), "{listed} of {}", seen.len());
        assert!(other <= listed / 1000, "{other} of {listed} pairs are listed on one side only");
    }
}

#[test]
fn gather_matches_its_twin() {
    let gpu = testing::gpu();
    for n in [0, 1, 63, 64, 65, 1000] {
        let s = scene(n as u64, n, [90, 60], Tiling::Narrow, ALPHA_MIN as f32);
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
        let pairs = s.pair_slot.len();
        let mut random = || rng.random_range(-1f32..1.0);
        let case = rasterize_gather::Arrays {
            drawn_count: vec![s.tiles.iter().filter(|tiles| **tiles > 0).count() as u32],
            drawn: (0..n as u32).filter(|&slot| s.tiles[slot as usize] > 0).collect(),
            tiles: s.tiles,
            pair_count: vec![pairs as u32],
            first_pair: s.first_pair,
            conic: s.conic,
            pair_mean: (0..pairs).map(|_| [random(), random()]).collect(),
            pair_conic: (0..pairs).map(|_| [random(), random(), random()]).collect(),
            pair_opacity: (0..pairs).map(|_| random()).collect(),
            pair_color: (0..pairs).map(|_| [random(), random(), random()]).collect(),
            pair_depth: Some((0..pairs).map(|_| random()).collect()),
            grad_mean: vec![[UNWRITTEN; 2]; n],
            grad_covariance: vec![[UNWRITTEN; 3]; n],
            grad_opacity: vec![UNWRITTEN; n],
            grad_color: vec![[UNWRITTEN; 3]; n],
            grad_depth: Some(vec![UNWRITTEN; n]),
            marks: None,
        };
        let mut bits = || rng.random::<u32>() & rng.random::<u32>();
        let marks = Some((0..pairs.div_ceil(32)).map(|_| bits()).collect());
        for (marks, depth, pair_count) in
            [(&None, true, pairs), (&marks, true, pairs), (&marks, false, pairs), (&None, false, 0)]
        {
            let (pair_depth, grad_depth) = (case.pair_depth.clone(), case.grad_depth.clone());
            let case = rasterize_gather::Arrays {
                marks: marks.clone(),
                pair_count: vec![pair_count as u32],
                pair_depth: pair_depth.filter(|_| depth),
                grad_depth: grad_depth.filter(|_| depth),
                ..case.clone()
            };
            testing::assert_twin(rasterize_gather::Kernel, &gpu, case, (), n);
        }
    }
}

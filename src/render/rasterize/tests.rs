use super::backward::subgroups;
use super::*;
use crate::gpu::kernels::render::{
    cpu, rasterize, rasterize_backward, rasterize_backward_color, rasterize_backward_depth, rasterize_color,
    rasterize_depth, rasterize_gather, rasterize_gather_color, rasterize_gather_marked, rasterize_gather_marked_color,
};
use crate::gpu::testing::{self, UNWRITTEN};
use crate::math::camera::factors;
use crate::math::tiles::Support;
use crate::render::bin::Tiling;
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
    s
}

/// What the forward pass of narrow tiles lists.
struct Lists {
    blended: Vec<[u32; 2]>,
    blended_count: Vec<u32>,
}

impl Lists {
    fn new(scene: &Scene) -> Self {
        Self { blended: vec![[7; 2]; scene.pair_slot.len()], blended_count: vec![7; scene.ranges.len()] }
    }
}

/// Bindings that only some variants have.
struct Extra {
    sorted: Vec<u32>,
    pair_slot: Vec<u32>,
    marks: Vec<u32>,
    depth: Vec<f32>,
    pair_depth: Vec<f32>,
    depth_map: Vec<f32>,
    transmittance: Vec<f32>,
    grad_depth_map: Vec<f32>,
    grad_transmittance: Vec<f32>,
}

/// Alpha and transmittance thresholds.
const THRESHOLDS: [(f32, f32); 3] = [(1.0 / 255.0, 1e-4), (1e-3, 0.0), (0.05, 0.02)];

const SIZES: [[u32; 2]; 5] = [[1, 1], [17, 3], [63, 41], [64, 64], [129, 8]];

#[test]
fn forward_matches_its_twin() {
    let gpu = testing::gpu();
    for (i, size) in SIZES.into_iter().enumerate() {
        let (alpha_min, transmittance_min) = THRESHOLDS[i % THRESHOLDS.len()];
        for n in [0, 1, 65, 700] {
            macro_rules! check {
                ($module:path, $tiling:expr, [$($list:ident),*] $(, $depth:ident $(, $transmittance:ident)?)?) => {{
                    use $module as kernel;
                    let s = scene(i as u64, n, size, $tiling, alpha_min);
                    let _lists = Lists::new(&s);
                    let pixels = (size[0] * size[1]) as usize;
                    let grid = $tiling.grid(size);
                    let case = kernel::Arrays {
                        ranges: s.ranges, sorted: s.sorted, pair_slot: s.pair_slot, mean: s.mean, conic: s.conic,
                        opacity: s.opacity, color: s.color, rgb: vec![[UNWRITTEN; 3]; pixels],
                        $($list: _lists.$list,)*
                        $($depth: s.depth, depth_map: vec![UNWRITTEN; pixels],
                        $($transmittance: vec![UNWRITTEN; pixels],)?)?
                    };
                    let push = kernel::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
                    let threads = [grid[0] * $tiling.threads(), grid[1], 1];
                    let constants = kernel::Constants { alpha_min, transmittance_min };
                    testing::assert_twin_with(kernel::Kernel, &gpu, constants, case, push, threads);
                }};
            }
            check!(rasterize, Tiling::Wide, [], depth, transmittance);
            check!(rasterize_depth, Tiling::Wide, [], depth);
            check!(rasterize_color, Tiling::Wide, []);
            if gpu.runs_lanes() {
                check!(cpu::rasterize, Tiling::Narrow, [blended, blended_count], depth, transmittance);
                check!(cpu::rasterize_depth, Tiling::Narrow, [blended, blended_count], depth);
                check!(cpu::rasterize_color, Tiling::Narrow, [blended, blended_count]);
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
        for n in [0, 1, 65, 300] {
            macro_rules! check {
                ($forward:path, $module:path $([$constant:ident])?, $tiling:expr, [$($list:ident),*] $(, $field:ident)*) => {{
                    use $forward as forward;
                    use $module as module;
                    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(i as u64);
                    let s = scene(i as u64, n, size, $tiling, alpha_min);
                    let pixels = (size[0] * size[1]) as usize;
                    let grid = $tiling.grid(size);
                    let mut random = || (0..pixels).map(|_| rng.random_range(-1f32..1.0)).collect::<Vec<f32>>();
                    let threads = [grid[0] * $tiling.threads(), grid[1], 1];
                    let mut _lists = Lists::new(&s);
                    let picture = forward::Arrays {
                        ranges: s.ranges.clone(), sorted: s.sorted.clone(), pair_slot: s.pair_slot.clone(),
                        mean: s.mean.clone(), conic: s.conic.clone(), opacity: s.opacity.clone(),
                        color: s.color.clone(), depth: s.depth.clone(), rgb: vec![[0.0; 3]; pixels],
                        depth_map: vec![0.0; pixels], transmittance: vec![0.0; pixels],
                        $($list: _lists.$list,)*
                    };
                    let push = forward::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
                    let constants = forward::Constants { alpha_min, transmittance_min };
                    let picture = testing::run_once_with::<forward::Kernel>(&gpu, &picture, push, constants, threads);
                    $(_lists.$list = picture.$list;)*
                    let pairs = s.pair_slot.len();
                    let extra = Extra {
                        sorted: s.sorted, pair_slot: s.pair_slot, marks: vec![0; pairs.div_ceil(32)],
                        depth: s.depth, pair_depth: vec![UNWRITTEN; pairs], depth_map: picture.depth_map,
                        transmittance: picture.transmittance, grad_depth_map: random(), grad_transmittance: random(),
                    };
                    let grad_rgb = (0..pixels).map(|p| [extra.grad_depth_map[p], -extra.grad_transmittance[p], 0.5]).collect();
                    let case = module::Arrays {
                        ranges: s.ranges, mean: s.mean, conic: s.conic,
                        opacity: s.opacity, color: s.color, rgb: picture.rgb, grad_rgb, $($list: _lists.$list,)*
                        pair_mean: vec![[UNWRITTEN; 2]; pairs], pair_conic: vec![[UNWRITTEN; 3]; pairs],
                        pair_opacity: vec![UNWRITTEN; pairs], pair_color: vec![[UNWRITTEN; 3]; pairs],
                        $($field: extra.$field,)*
                    };
                    let push = module::Push { size, tiles_x: grid[0] };
                    let constants = module::Constants { alpha_min, transmittance_min $(, $constant)? };
                    testing::assert_twin_with(module::Kernel, &gpu, constants, case, push, threads);
                }};
            }
            check!(
                rasterize,
                rasterize_backward[subgroups],
                Tiling::Wide,
                [],
                sorted,
                pair_slot,
                depth,
                depth_map,
                grad_depth_map,
                pair_depth,
                transmittance,
                grad_transmittance
            );
            check!(
                rasterize,
                rasterize_backward_depth[subgroups],
                Tiling::Wide,
                [],
                sorted,
                pair_slot,
                depth,
                depth_map,
                grad_depth_map,
                pair_depth
            );
            check!(rasterize, rasterize_backward_color[subgroups], Tiling::Wide, [], sorted, pair_slot);
            if gpu.runs_lanes() {
                check!(
                    cpu::rasterize,
                    cpu::rasterize_backward,
                    Tiling::Narrow,
                    [blended, blended_count],
                    marks,
                    depth,
                    depth_map,
                    grad_depth_map,
                    pair_depth,
                    transmittance,
                    grad_transmittance
                );
                check!(
                    cpu::rasterize,
                    cpu::rasterize_backward_depth,
                    Tiling::Narrow,
                    [blended, blended_count],
                    marks,
                    depth,
                    depth_map,
                    grad_depth_map,
                    pair_depth
                );
                check!(cpu::rasterize, cpu::rasterize_backward_color, Tiling::Narrow, [blended, blended_count], marks);
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
        println!("skipped: narrow tiles need subgroups of 8 threads");
        return;
    }
    let size = [129, 97];
    let pixels = (size[0] * size[1]) as usize;
    for (alpha_min, transmittance_min) in THRESHOLDS {
        let s = scene(3, 2000, size, Tiling::Narrow, alpha_min);
        let lists = Lists::new(&s);
        let case = cpu::rasterize_color::Arrays {
            ranges: s.ranges,
            sorted: s.sorted,
            pair_slot: s.pair_slot,
            mean: s.mean,
            conic: s.conic,
            opacity: s.opacity,
            color: s.color,
            rgb: vec![[0.0; 3]; pixels],
            blended: lists.blended,
            blended_count: lists.blended_count,
        };
        let grid = Tiling::Narrow.grid(size);
        let push = cpu::rasterize_color::Push { size, tiles_x: grid[0], background: [0.0; 3] };
        let constants = cpu::rasterize_color::Constants { alpha_min, transmittance_min };
        let threads = [grid[0] * Tiling::Narrow.threads(), grid[1], 1];
        type K = cpu::rasterize_color::Kernel;
        let got = testing::run_once_with::<K>(&gpu, &case, push, constants, threads);
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
            splats.walk([p % size[0], p / size[0]], 8, grid[0], |pair, _, _, _, w| {
                seen[pair] |= w >= f64::from(f32::MIN_POSITIVE);
            });
        }
        let (mut listed, mut other) = (0, 0);
        for tile in 0..(grid[0] * grid[1]) as usize {
            let [first, end] = case.ranges[tile].map(|i| i as usize);
            let list = &got.blended[first..][..got.blended_count[tile] as usize];
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
            pair_depth: (0..pairs).map(|_| random()).collect(),
            grad_mean: vec![[UNWRITTEN; 2]; n],
            grad_covariance: vec![[UNWRITTEN; 3]; n],
            grad_opacity: vec![UNWRITTEN; n],
            grad_color: vec![[UNWRITTEN; 3]; n],
            grad_depth: vec![UNWRITTEN; n],
        };
        testing::assert_twin(rasterize_gather::Kernel, &gpu, case.clone(), (), n);
        let mut bits = || rng.random::<u32>() & rng.random::<u32>();
        let c = case.clone();
        let marked = rasterize_gather_marked::Arrays {
            drawn_count: c.drawn_count,
            drawn: c.drawn,
            tiles: c.tiles,
            pair_count: c.pair_count,
            first_pair: c.first_pair,
            conic: c.conic,
            pair_mean: c.pair_mean,
            pair_conic: c.pair_conic,
            pair_opacity: c.pair_opacity,
            pair_color: c.pair_color,
            grad_mean: c.grad_mean,
            grad_covariance: c.grad_covariance,
            grad_opacity: c.grad_opacity,
            grad_color: c.grad_color,
            pair_depth: c.pair_depth,
            grad_depth: c.grad_depth,
            marks: (0..pairs.div_ceil(32)).map(|_| bits()).collect(),
        };
        testing::assert_twin(rasterize_gather_marked::Kernel, &gpu, marked.clone(), (), n);
        let c = marked;
        let marked = rasterize_gather_marked_color::Arrays {
            drawn_count: c.drawn_count,
            drawn: c.drawn,
            tiles: c.tiles,
            pair_count: c.pair_count,
            first_pair: c.first_pair,
            conic: c.conic,
            pair_mean: c.pair_mean,
            pair_conic: c.pair_conic,
            pair_opacity: c.pair_opacity,
            pair_color: c.pair_color,
            grad_mean: c.grad_mean,
            grad_covariance: c.grad_covariance,
            grad_opacity: c.grad_opacity,
            grad_color: c.grad_color,
            marks: c.marks,
        };
        testing::assert_twin(rasterize_gather_marked_color::Kernel, &gpu, marked, (), n);
        let color = rasterize_gather_color::Arrays {
            drawn_count: case.drawn_count,
            drawn: case.drawn,
            tiles: case.tiles,
            pair_count: vec![0],
            first_pair: case.first_pair,
            conic: case.conic,
            pair_mean: case.pair_mean,
            pair_conic: case.pair_conic,
            pair_opacity: case.pair_opacity,
            pair_color: case.pair_color,
            grad_mean: case.grad_mean,
            grad_covariance: case.grad_covariance,
            grad_opacity: case.grad_opacity,
            grad_color: case.grad_color,
        };
        testing::assert_twin(rasterize_gather_color::Kernel, &gpu, color, (), n);
    }
}

use std::collections::{BTreeMap, HashSet};

use super::twins::*;
use super::*;
use crate::gpu::testing::{self, UNWRITTEN};
use crate::model::files;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const PATTERN: u32 = 0xdead_beef;
const SIZES: [usize; 7] = [0, 1, 63, 64, 65, 1000, 4097];

#[test]
fn keys_are_reversible_and_ordered() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for bits in [[0, 0, 0], [1, 0, 3], [10, 11, 12], [16, 16, 16], [31, 31, 31], [31, 1, 30], [0, 31, 31]] {
        let mut random = || -> [u32; 3] { bits.map(|b: u32| rng.random::<u32>() & ((1u64 << b) - 1) as u32) };
        for _ in 0..100 {
            let (a, b) = (random(), random());
            assert_eq!(cell_above(cell_key(a, bits), bits), a);
            let reversed = |mut v: [u32; 3]| {
                v.reverse();
                v
            };
            let order = reversed(cell_key(a, bits)).cmp(&reversed(cell_key(b, bits)));
            assert_eq!(order, reversed(a).cmp(&reversed(b)));
        }
    }
}

#[test]
fn cells_are_the_nearest() {
    assert_eq!(cell([0.49, -0.51, 2.5], 1.0), Some([0, -1, 2]));
    assert_eq!(cell([6e8, 0.0, 0.0], 1.0), None);
    assert_eq!(cell([f32::NAN, 0.0, 0.0], 1.0), None);
}

#[test]
fn hashes_are_spread_evenly() {
    for level in 0..3 {
        for bit in 0..32 {
            let ones = (0..20_000).filter(|&s| pcg4d([s, level, 1500, 7])[0] >> bit & 1 == 1).count();
            // Five standard deviations of a fair coin.
            assert!((ones as f64 - 10_000.0).abs() < 5.0 * 70.7, "bit {bit}: {ones}");
        }
    }
}

/// Anchors on a grid of voxels around the origin, with Gaussians well inside their voxel: about a quarter of a voxel
/// from its centre, so that no rounding decides about a cell of any level.
fn scene(rng: &mut Pcg64Mcg, n: usize, offsets: usize, extent: i32, voxel: f32) -> files::Anchors {
    let random_cell = |rng: &mut Pcg64Mcg| -> [i32; 3] { std::array::from_fn(|_| rng.random_range(-extent..=extent)) };
    let mut model = files::Anchors { offsets_per_anchor: offsets, ..files::Anchors::default() };
    for _ in 0..n {
        let anchor = random_cell(rng).map(|c| c as f32 * voxel);
        let log_scaling: [f32; 6] = std::array::from_fn(|_| rng.random_range(-3.0..0.5));
        for _ in 0..offsets {
            let target = random_cell(rng);
            for i in 0..3 {
                let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let p = (target[i] as f32 + sign * rng.random_range(0.15..0.35)) * voxel;
                model.offset.push((p - anchor[i]) / log_scaling[i].exp());
            }
        }
        model.position.push(anchor);
        model.feature.push(std::array::from_fn(|_| rng.random_range(-2.0..2.0)));
        model.log_scaling.push(log_scaling);
    }
    model.completed()
}

fn candidates_case(n: usize, offsets: usize) -> grow_candidates::Arrays {
    let mut rng = Pcg64Mcg::seed_from_u64(n as u64);
    let model = scene(&mut rng, n, offsets, 300, 0.01);
    let seen: Vec<u32> = (0..n * offsets).map(|_| rng.random_range(0..100)).collect();
    // A third exactly at the threshold.
    let gradient = seen.iter().map(|&n| 0.25 * n as f32 * [0.5, 1.0, 2.0][rng.random_range(0..3)]).collect();
    grow_candidates::Arrays {
        gradient,
        seen,
        position: model.position,
        offset: model.offset.as_chunks().0.to_vec(),
        log_scaling: model.log_scaling.into_flattened(),
        flags: vec![PATTERN; n * offsets + 3],
        bounds: vec![i32::MAX, i32::MAX, i32::MAX, i32::MIN, i32::MIN, i32::MIN, 0],
    }
}

#[test]
fn candidates_match_their_twin() {
    let gpu = testing::gpu();
    for (n, offsets) in [(0, 10), (1, 1), (7, 9), (13, 5), (500, 10)] {
        for level in 0..3 {
            let mut case = candidates_case(n, offsets);
            if n == 13 {
                case.position[2] = [f32::NAN, 0.0, 0.0];
                case.position[3] = [3e38, 0.0, 0.0];
            }
            let push = grow_candidates::Push {
                slots: (n * offsets) as u32,
                offsets: offsets as u32,
                threshold: 0.25,
                min_seen: 40,
                level,
                step: 1500,
                seed: 3,
                inverse_size: 25.0,
            };
            testing::assert_twin(grow_candidates::Kernel, &gpu, case, push, n * offsets);
        }
    }
}

#[test]
fn keys_match_their_twin() {
    let gpu = testing::gpu();
    for found in [0, 1, 63, 64, 65, 1000] {
        let of = candidates_case(130, 10);
        let mut rng = Pcg64Mcg::seed_from_u64(found as u64);
        let mut candidates: Vec<u32> = (0..found + 5).map(|_| rng.random_range(0..1300)).collect();
        candidates.sort_unstable();
        let case = grow_keys::Arrays {
            candidates,
            position: of.position,
            offset: of.offset,
            log_scaling: of.log_scaling,
            keys: vec![[PATTERN; 3]; found + 5],
            first_words: vec![PATTERN; found + 5],
        };
        for bits in [[9, 9, 9], [12, 17, 31]] {
            let push = grow_keys::Push { low: [-200; 3], bits, found: found as u32, offsets: 10, inverse_size: 25.0 };
            testing::assert_twin(grow_keys::Kernel, &gpu, case.clone(), push, found);
        }
    }
}

/// Random keys of few different values, sorted indices of them and where each begins.
fn sorted_keys(n: usize) -> (Vec<[u32; 3]>, Vec<u32>, Vec<u32>) {
    let mut rng = Pcg64Mcg::seed_from_u64(n as u64);
    let keys: Vec<[u32; 3]> = (0..n + 4).map(|_| std::array::from_fn(|_| rng.random_range(0..6))).collect();
    let mut order: Vec<u32> = (0..n as u32).collect();
    let key = |j: &u32| {
        let [x, y, z] = keys[*j as usize];
        [z, y, x]
    };
    order.sort_by_key(key);
    let heads = (0..n).filter(|&r| r == 0 || key(&order[r]) != key(&order[r - 1])).map(|r| r as u32).collect();
    (keys, order, heads)
}

#[test]
fn cells_match_their_twins() {
    let gpu = testing::gpu();
    for n in SIZES {
        let (keys, order, heads) = sorted_keys(n);
        let found = n as u32;
        let cells = heads.len();
        for word in [1, 2] {
            let words = vec![PATTERN; n + 4];
            let case = grow_words::Arrays { keys: keys.clone(), order: order.clone(), words };
            testing::assert_twin(grow_words::Kernel, &gpu, case, grow_words::Push { found, word }, n + 4);
        }
        let case = grow_heads::Arrays { keys: keys.clone(), order: order.clone(), flags: vec![PATTERN; n + 4] };
        testing::assert_twin(grow_heads::Kernel, &gpu, case, grow_heads::Push { found }, n + 4);
        let mut case = grow_cells::Arrays {
            keys,
            order,
            heads,
            cell_count: vec![cells as u32],
            cells: vec![[PATTERN; 3]; n + 4],
            free: vec![PATTERN; n + 4],
        };
        testing::assert_twin(grow_cells::Kernel, &gpu, case.clone(), (), n + 4);

        // Keys as `low` and `bits` make them of coordinates -3 to 2.
        let bits = [3, 3, 30];
        case.cells = case.heads.iter().map(|&h| cell_key(case.keys[case.order[h as usize] as usize], bits)).collect();
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let case = grow_occupied::Arrays {
            position: (0..40).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..0.8))).collect(),
            cells: case.cells,
            cell_count: case.cell_count,
            free: vec![1; cells],
        };
        for anchors in [0, 1, 40] {
            let push = grow_occupied::Push { low: [-3; 3], high: [2; 3], bits, anchors, inverse_size: 4.0 };
            testing::assert_twin(grow_occupied::Kernel, &gpu, case.clone(), push, 64u32);
        }
        let case = grow_lots::Arrays { lots: vec![PATTERN; n + 4] };
        let push = grow_lots::Push { cells: found, level: 2, step: 1500, seed: 77 };
        testing::assert_twin(grow_lots::Kernel, &gpu, case, push, n + 4);
    }
}

#[test]
fn appending_and_resetting_match_their_twins() {
    let gpu = testing::gpu();
    for n in SIZES {
        let (keys, order, heads) = sorted_keys(n);
        let mut rng = Pcg64Mcg::seed_from_u64(9);
        let (anchors, offsets, bits) = (200, 10, [3, 4, 30]);
        let free_cells: Vec<u32> = (0..heads.len() as u32).filter(|_| rng.random_bool(0.7)).collect();
        let added = free_cells.len();
        let all = anchors + added + 2;
        let case = grow_append::Arrays {
            free_cells,
            cells: heads.iter().map(|&h| cell_key(keys[order[h as usize] as usize], bits)).collect(),
            cell_count: vec![heads.len() as u32],
            heads,
            order,
            candidates: (0..n).map(|_| rng.random_range(0..(anchors * offsets) as u32)).collect(),
            position: vec![[UNWRITTEN; 3]; all],
            feature: (0..all * 32).map(|_| rng.random_range(-1.0..1.0)).collect(),
            log_scaling: vec![UNWRITTEN; 6 * all],
        };
        let push = grow_append::Push {
            low: [-5, 0, 1_000_000],
            bits,
            found: n as u32,
            offsets: offsets as u32,
            anchors: anchors as u32,
            added: added as u32,
            size: 0.04,
            log_size: 0.04f32.ln(),
        };
        testing::assert_twin(grow_append::Kernel, &gpu, case, push, 32 * all);
        let case = grow_reset::Arrays {
            gradient: (0..n + 4).map(|i| i as f32).collect(),
            seen: (0..n + 4).map(|_| rng.random_range(0..80)).collect(),
        };
        testing::assert_twin(grow_reset::Kernel, &gpu, case, grow_reset::Push { slots: n as u32, min_seen: 40 }, n + 4);
    }
}

/// Statistics of a scene on the host.
#[derive(Clone, PartialEq, Debug)]
struct Gathered {
    gradient: Vec<f32>,
    seen: Vec<u32>,
    opacity_sum: Vec<f32>,
    visits: Vec<u32>,
}

impl Gathered {
    fn random(rng: &mut Pcg64Mcg, n: usize, offsets: usize) -> Self {
        let seen: Vec<u32> = (0..n * offsets).map(|_| rng.random_range(0..100)).collect();
        Self {
            gradient: seen.iter().map(|&n| n as f32 * rng.random_range(0.0..0.002)).collect(),
            seen,
            opacity_sum: (0..n).map(|_| rng.random_range(0.0..50.0)).collect(),
            visits: (0..n).map(|_| rng.random_range(0..100)).collect(),
        }
    }

    fn upload(&self, gpu: &Gpu, capacity: u32, offsets: u32) -> Statistics {
        let statistics = Statistics::new(gpu, capacity, offsets, false).unwrap();
        gpu.write(&statistics.gradient, &self.gradient).unwrap();
        gpu.write(&statistics.seen, &self.seen).unwrap();
        gpu.write(&statistics.opacity_sum, &self.opacity_sum).unwrap();
        gpu.write(&statistics.visits, &self.visits).unwrap();
        statistics
    }

    fn read(gpu: &Gpu, statistics: &Statistics, anchors: &Anchors) -> Self {
        let (n, slots) = (anchors.count as usize, (anchors.count * anchors.offsets) as usize);
        Self {
            gradient: gpu.read_range(&statistics.gradient, slots).unwrap(),
            seen: gpu.read_range(&statistics.seen, slots).unwrap(),
            opacity_sum: gpu.read_range(&statistics.opacity_sum, n).unwrap(),
            visits: gpu.read_range(&statistics.visits, n).unwrap(),
        }
    }
}

/// Growing as it is written down, with maps and float64 positions.
fn grow_plainly(model: &mut files::Anchors, gathered: &mut Gathered, config: &Config, round: Round) -> u32 {
    let (judged, offsets) = (model.position.len(), model.offsets_per_anchor);
    for level in 0..LEVELS {
        let size = f64::from(round.voxel) * config.coarsest_cell / 4f64.powi(level as i32);
        let threshold = config.gradient_threshold * 2f64.powi(level as i32);
        // Anchors lie on voxels, which may be the boundaries of coarser cells: their cell is float32's choice.
        let near = |p: [f32; 3]| p.map(|x| (x * (1.0 / size) as f32).round_ties_even() as i64);
        let occupied: HashSet<[i64; 3]> = model.position.iter().map(|&p| near(p)).collect();
        let mut cells: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
        for s in 0..judged * offsets {
            let a = s / offsets;
            let mean = f64::from(gathered.gradient[s]) / f64::from(gathered.seen[s]);
            let kept = f64::from(pcg4d([s as u32, level, round.step, fold(round.seed)])[0]) / 2f64.powi(32)
                >= 0.5f64.powi(level as i32 + 1);
            if gathered.seen[s] > config.min_slot_visits && mean >= threshold && kept {
                let cell: [i64; 3] = std::array::from_fn(|i| {
                    let offset = f64::from(model.offset[3 * s + i]) * f64::from(model.log_scaling[a][i]).exp();
                    ((f64::from(model.position[a][i]) + offset) / size).round_ties_even() as i64
                });
                let [x, y, z] = cell;
                if !occupied.contains(&cell) {
                    cells.entry([z, y, x]).or_default().push(a);
                }
            }
        }
        for ([z, y, x], from) in cells {
            let largest = |c: usize| from.iter().map(|&a| model.feature[a][c]).fold(f32::NEG_INFINITY, f32::max);
            let feature = std::array::from_fn(largest);
            model.position.push([x, y, z].map(|c| c as f32 * size as f32));
            model.feature.push(feature);
            model.log_scaling.push([size.ln() as f32; 6]);
            model.offset.extend(vec![0.0; 3 * offsets]);
            gathered.gradient.extend(vec![0.0; offsets]);
            gathered.seen.extend(vec![0; offsets]);
            gathered.opacity_sum.push(0.0);
            gathered.visits.push(0);
        }
    }
    *model = std::mem::take(model).completed();
    for s in 0..judged * offsets {
        if gathered.seen[s] > config.min_slot_visits {
            (gathered.gradient[s], gathered.seen[s]) = (0.0, 0);
        }
    }
    (model.position.len() - judged) as u32
}

/// Moments of the first anchors, told apart from zero.
fn mark_moments(gpu: &Gpu, anchors: &Anchors) {
    for parameter in anchors.parameters() {
        gpu.write(&parameter.first, &vec![0.5; (anchors.count * parameter.width) as usize]).unwrap();
        gpu.write(&parameter.root, &vec![0.25; (anchors.count * parameter.width) as usize]).unwrap();
    }
}

#[test]
fn grows_as_written_down() {
    let gpu = testing::gpu();
    // Few cells with thousands of candidates each; many cells; more offsets; no candidates; no anchors.
    let cases = [
        (1500, 10, 20, 0.0002, 0),
        (1500, 10, 3000, 0.0002, 0),
        (77, 13, 400, 0.0005, 9000),
        (300, 10, 400, 10.0, 0),
        (0, 10, 1, 0.0002, 0),
    ];
    for (n, offsets, extent, gradient_threshold, spare) in cases {
        let mut rng = Pcg64Mcg::seed_from_u64(n as u64);
        let round = Round { voxel: 0.01, seed: 0x1234_5678_9abc, step: 1500 };
        let config = Config { gradient_threshold, ..Config::default() };
        let mut model = scene(&mut rng, n, offsets, extent, round.voxel);
        let mut gathered = Gathered::random(&mut rng, n, offsets);
        let mut runs = vec![];
        for _ in 0..2 {
            let mut anchors = Anchors::upload(&gpu, &model, spare).unwrap();
            let mut statistics = gathered.upload(&gpu, anchors.capacity, offsets as u32);
            mark_moments(&gpu, &anchors);
            let grown = run(&gpu, &mut anchors, &mut statistics, &config, round).unwrap();
            assert_eq!(anchors.count, n as u32 + grown.added);
            assert_eq!(statistics.capacity(), anchors.capacity);
            for parameter in anchors.parameters() {
                for (moment, mark) in [(&parameter.first, 0.5), (&parameter.root, 0.25)] {
                    let moment = gpu.read_range(moment, (anchors.count * parameter.width) as usize).unwrap();
                    let (old, new) = moment.split_at(n * parameter.width as usize);
                    assert!(old.iter().all(|&x| x == mark) && new.iter().all(|&x| x == 0.0));
                }
            }
            runs.push((anchors.read(&gpu).unwrap(), Gathered::read(&gpu, &statistics, &anchors), grown));
        }
        assert_eq!(runs[0], runs[1], "twice the same");
        let added = grow_plainly(&mut model, &mut gathered, &config, round);
        println!("{n} anchors x {offsets}: {added} new");
        assert_eq!(runs[0].2, Grown { added, ..Grown::default() });
        assert_eq!(runs[0].0.position, model.position);
        assert_eq!(runs[0].0, model);
        assert_eq!(runs[0].1, gathered);
        assert_eq!(added == 0, gradient_threshold > 1.0 || n == 0);
    }
}

#[test]
fn cells_far_apart_need_three_words() {
    let gpu = testing::gpu();
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    let mut integers =
        |n: usize, limit: i32| -> Vec<f32> { (0..n).map(|_| rng.random_range(-limit..limit) as f32).collect() };
    // Integers that float32 holds exactly, scales of 1: 22 bits for each coordinate.
    let model = files::Anchors::new(
        10,
        integers(3 * 200, 100).as_chunks().0.to_vec(),
        integers(32 * 200, 100).as_chunks().0.to_vec(),
        integers(3 * 2000, 2_000_000 - 200),
        vec![[0.0; 6]; 200],
    );
    let mut gathered = Gathered::random(&mut rng, 200, 10);
    let round = Round { voxel: 1.0, seed: 8, step: 1600 };
    let config = Config::default();
    let mut anchors = Anchors::upload(&gpu, &model, 0).unwrap();
    let mut statistics = gathered.upload(&gpu, anchors.capacity, 10);
    let grown = run(&gpu, &mut anchors, &mut statistics, &config, round).unwrap();
    let mut want = model;
    assert_eq!(grow_plainly(&mut want, &mut gathered, &config, round), grown.added);
    assert!(grown.added > 300);
    assert_eq!(anchors.read(&gpu).unwrap(), want);
}

#[test]
fn growing_stops_where_there_is_no_room() {
    let gpu = testing::gpu();
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let round = Round { voxel: 0.01, seed: 1, step: 1500 };
    let model = scene(&mut rng, 500, 10, 3000, round.voxel);
    let gathered = Gathered::random(&mut rng, 500, 10);
    let grow = |max_anchors| {
        let mut anchors = Anchors::upload(&gpu, &model, 0).unwrap();
        let mut statistics = gathered.upload(&gpu, anchors.capacity, 10);
        let config = Config { max_anchors, ..Config::default() };
        let grown = run_levels(&gpu, &mut anchors, &mut statistics, &config, round, 1).unwrap();
        (anchors.read(&gpu).unwrap(), grown)
    };
    let bits = |anchors: &files::Anchors| -> HashSet<[u32; 3]> {
        anchors.position[500..].iter().map(|p| p.map(f32::to_bits)).collect()
    };
    let (all, unlimited) = grow(0);
    assert!(unlimited.added > 200 && unlimited.refused == 0);
    let (some, limited) = grow(600);
    assert_eq!(limited, Grown { added: 100, refused: unlimited.added - 100, beyond: 0 });
    assert_eq!(some.position.len(), 600);
    assert!(bits(&some).len() == 100 && bits(&some).is_subset(&bits(&all)));
    // A fair choice, not the first ones in the order of the cells: among the first 100 about 100 of 100 / all.
    let first: HashSet<[u32; 3]> = all.position[500..600].iter().map(|p| p.map(f32::to_bits)).collect();
    assert!(bits(&some).intersection(&first).count() < 80);
    assert_eq!(grow(600).0, some, "twice the same");
    assert_eq!(grow(400).1, Grown { added: 0, refused: unlimited.added, beyond: 0 });
}

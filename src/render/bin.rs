//! Binning: which tiles each Gaussian touches, and every tile's list in depth order.
//!
//! Gaussians are sorted by depth once (few), their (Gaussian, tile) pairs are written in that order, and a stable sort
//! by tile alone (few bits) then leaves every tile's list in depth order; equal depths keep the slots' order. On a CPU
//! that sort is one counting pass over all tiles at once: with a thread per run of pairs there is room for a counter per
//! tile and run, and a pair is touched 9 times, not 30.

use super::method::Method;
use super::project::{Projected, listed};
use super::slots::Slots;
use super::tiling::Tiling;
use crate::gpu::kernels::render::{bin_count, bin_depth_keys, bin_expand, bin_ranges, bin_rank, cpu};
use crate::gpu::{Buffer, Check, Error, Form, Gpu, Groups, Recorder, Reference};
use crate::math::tiles::Support;
use crate::primitives::compact::Compact;
use crate::primitives::dispatch::Shape;
use crate::primitives::limit::{Counter, Limits};
use crate::primitives::scan::{self, Scan};
use crate::primitives::sort::{Pairs, Sort};
use crate::primitives::{Count, dispatch};

impl Reference for bin_count::Kernel {
    fn reference(host: bin_count::Host<'_>, push: bin_count::Push, constants: bin_count::Constants) {
        for s in listed(host.count, host.list) {
            (host.conic[s], host.tiles[s]) = if host.depth[s] > 0.0 {
                let (m, c) = (host.mean[s], host.covariance[s]);
                let alpha = (host.opacity[s], constants.alpha_min);
                let support = Support::new(m, c, alpha, push.tile, push.grid);
                ([1.0 / c[0], c[1], 1.0 / c[2]], support.tiles(m, push.tile, push.grid).len() as u32)
            } else {
                ([0.0; 3], 0)
            };
        }
    }
    /// The device's logarithm and square root may round otherwise than the host's and move an ellipse's edge across a
    /// tile's first sample: about one edge in 1e4 lies that close.
    fn check(binding: &'static str) -> Check {
        Check { band: if binding == "tiles" { 2e-3 } else { 0.0 }, ..Check::default() }
    }
}

impl Reference for bin_depth_keys::Kernel {
    fn reference(host: bin_depth_keys::Host<'_>, push: bin_depth_keys::Push, (): ()) {
        for i in 0..host.drawn_count[0] as usize {
            let s = host.drawn[i];
            let bits = host.depth[s as usize].to_bits();
            host.keys[i] = bits.saturating_sub(push.base).min(push.last);
            host.values[i] = s;
        }
    }
}

impl Reference for bin_rank::Kernel {
    fn reference(host: bin_rank::Host<'_>, (): (), (): ()) {
        for r in 0..host.drawn_count[0] as usize {
            host.rank_tiles[r] = host.tiles[host.order[r] as usize];
        }
    }
}

impl Reference for bin_expand::Kernel {
    fn reference(host: bin_expand::Host<'_>, push: bin_expand::Push, constants: bin_expand::Constants) {
        if host.pair_count[0] == 0 {
            return;
        }
        for r in 0..host.drawn_count[0] as usize {
            let slot = host.order[r];
            let s = slot as usize;
            let alpha = (host.opacity[s], constants.alpha_min);
            let support = Support::new(host.mean[s], host.covariance[s], alpha, push.tile, push.grid);
            let found = support.tiles(host.mean[s], push.tile, push.grid);
            let first = host.rank_first[r];
            host.first_pair[s] = first;
            for i in 0..host.tiles[s] {
                let p = (first + i) as usize;
                host.pair_tile[p] = found.get(i as usize).copied().unwrap_or(push.grid[0] * push.grid[1]);
                host.pair_slot[p] = slot;
            }
        }
    }
    /// As `bin_count`: an edge within rounding of a tile's first sample.
    fn check(binding: &'static str) -> Check {
        Check { band: if binding == "pair_tile" { 2e-3 } else { 0.0 }, ..Check::default() }
    }
}

impl Reference for bin_ranges::Kernel {
    fn reference(host: bin_ranges::Host<'_>, (): (), (): ()) {
        let sorted = &host.sorted_tile[..host.pair_count[0] as usize];
        for (i, &tile) in sorted.iter().enumerate() {
            match i {
                0 => host.cut_tile[0] = (sorted.len() as u32 - 1) / CUT,
                _ if !(i as u32).is_multiple_of(CUT) => {}
                _ => host.cut_tile[i / CUT as usize] = if sorted[i - 1] == tile { tile + 1 } else { 0 },
            }
            if i == 0 || sorted[i - 1] != tile {
                host.ranges[tile as usize][0] = i as u32;
            }
            if i + 1 == sorted.len() || sorted[i + 1] != tile {
                host.ranges[tile as usize][1] = i as u32 + 1;
            }
        }
    }
}

/// Tiles of a Gaussian above which a whole subgroup writes its pairs.
const LONG: u32 = 32;

/// Pairs of each run of `pairs` in `runs`.
fn run_length(pairs: u32, runs: u32) -> usize {
    pairs.div_ceil(runs).max(1) as usize
}

impl Reference for cpu::bin_tally::Kernel {
    fn reference(host: cpu::bin_tally::Host<'_>, push: cpu::bin_tally::Push, (): ()) {
        let n = host.pair_count[0];
        for (run, pairs) in host.pair_tile[..n as usize].chunks(run_length(n, push.runs)).enumerate() {
            pairs.iter().for_each(|tile| host.run_pairs[(tile * push.runs) as usize + run] += 1);
        }
    }
}

impl Reference for cpu::bin_place::Kernel {
    fn reference(host: cpu::bin_place::Host<'_>, push: cpu::bin_place::Push, (): ()) {
        let n = host.pair_count[0];
        let length = run_length(n, push.runs);
        for (p, tile) in host.pair_tile[..n as usize].iter().enumerate() {
            let place = &mut host.run_first[(tile * push.runs) as usize + p / length];
            host.sorted[*place as usize] = p as u32;
            *place += 1;
        }
    }
}

impl Reference for cpu::bin_tally_ranges::Kernel {
    fn reference(host: cpu::bin_tally_ranges::Host<'_>, push: cpu::bin_tally_ranges::Push, (): ()) {
        let first = |tile: u32| match tile {
            _ if tile < push.tiles => host.run_first[(tile * push.runs) as usize],
            _ => host.pair_count[0],
        };
        for tile in 0..push.tiles {
            host.ranges[tile as usize] = [first(tile), first(tile + 1)];
        }
    }
}

/// The lists of a picture's tiles.
#[derive(Clone, Copy)]
pub struct Binned<'a> {
    /// `[slot]` factored inverse covariance: 1 / variance of x given y, slope, 1 / variance of y.
    pub conic: &'a Buffer<[f32; 3]>,
    /// `[slot]` tiles touched.
    pub tiles: &'a Buffer<u32>,
    /// Slots that touch a tile.
    pub drawn: &'a Slots,
    /// `[1]` pairs.
    pub pair_count: &'a Buffer<u32>,
    /// `[slot]` first pair of each Gaussian that touches a tile.
    pub first_pair: &'a Buffer<u32>,
    /// `[pair]` slot of a pair's Gaussian.
    pub pair_slot: &'a Buffer<u32>,
    /// `[pair]` pair numbers by tile, nearest first.
    pub sorted: &'a Buffer<u32>,
    /// `[tile + 1]` first and one past last in `sorted`.
    pub ranges: &'a Buffer<[u32; 2]>,
    /// Where narrow tiles' pictures note what they are made of.
    pub blended: Option<Blended<'a>>,
    /// Where wide tiles' long lists are cut.
    pub cuts: Option<Cuts<'a>>,
}

/// Places of a cut in wide tiles' lists: the way back begins at all of them at once.
pub const CUT: u32 = 512;
/// Values of a cut: five of each of a tile's 256 pixels.
pub const CUT_VALUES: usize = 5 * 256;

/// The cuts of wide tiles' lists, before every [`CUT`]-th place of all lists in a row.
#[derive(Clone, Copy)]
pub struct Cuts<'a> {
    /// `[cut]` one more than the tile that has pairs on both sides of it, or 0; the first says how many follow.
    pub tile: &'a Buffer<u32>,
    /// `[cut, 5, 256]` colour, transmittance (-1: finished) and depth of its pixels there, written by the forward and read by
    /// the backward pass.
    pub state: &'a Buffer<f32>,
}

/// The pairs of which a pixel took something, written by the forward and read by the backward pass of narrow tiles.
#[derive(Clone, Copy)]
pub struct Blended<'a> {
    /// `[pair]` from a tile's first on: numbers and slots of its pairs, nearest first.
    pub pairs: &'a Buffer<[u32; 2]>,
    /// `[tile]` how many.
    pub count: &'a Buffer<u32>,
}

/// The stage: its lists for so many slots and pairs.
pub struct Bin {
    method: Method,
    pairs: u32,
    conic: Buffer<[f32; 3]>,
    tiles: Buffer<u32>,
    first_pair: Buffer<u32>,
    drawn: Slots,
    per_sorted: Groups,
    per_scanned: Groups,
    depth_keys: Buffer<u32>,
    depth_values: Buffer<u32>,
    rank_tiles: Buffer<u32>,
    rank_first: Buffer<u32>,
    pair_total: Buffer<u32>,
    pair_count: Buffer<u32>,
    pair_tile: Buffer<u32>,
    pair_slot: Buffer<u32>,
    sorted: Buffer<u32>,
    ranges: Buffer<[u32; 2]>,
    compact: Compact,
    depth_sort: Sort,
    scan: Scan,
    by_tile: ByTile,
}

/// How pairs come into their tiles' lists.
enum ByTile {
    /// A radix sort: any number of threads.
    Sort { sort: Sort, groups: Groups, cut_tile: Buffer<u32>, cut_state: Buffer<f32> },
    /// A counting sort with few threads, for CPUs.
    Tally(Tally),
}

/// Counters of each tile and run, and where they say that a run's pairs go.
struct Tally {
    runs: u32,
    run_pairs: Buffer<u32>,
    run_first: Buffer<u32>,
    placed: Buffer<u32>,
    scan: Scan,
    blended: Buffer<[u32; 2]>,
    blended_count: Buffer<u32>,
}

impl Tally {
    /// Most runs: eight subgroups of eight, some for each of a CPU's cores.
    const RUNS: u32 = 64;
    /// Most counters, where there are at least eight runs.
    const COUNTERS: u32 = 1 << 22;

    /// Counters of pictures of at most so many tiles, that behind the last included, and pairs.
    fn new(gpu: &Gpu, tiles: u32, pairs: usize) -> Result<Self, Error> {
        let runs = (Self::COUNTERS / tiles).clamp(8, Self::RUNS);
        let counters = runs * tiles;
        Ok(Self {
            runs,
            run_pairs: gpu.buffer("run_pairs", counters as usize)?,
            run_first: gpu.buffer("run_first", counters as usize)?,
            placed: gpu.buffer("placed", 1)?,
            scan: Scan::new(gpu, counters)?,
            blended: gpu.buffer("seen_pairs", pairs)?,
            blended_count: gpu.buffer("seen_count", tiles as usize)?,
        })
    }
}

impl Bin {
    /// Lists for at most `slots` Gaussians, `pairs` (Gaussian, tile) pairs and pictures of at most `size`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, method: impl Into<Method>, slots: u32, pairs: u32, size: [u32; 2]) -> Result<Self, Error> {
        let (n, p) = (slots as usize, pairs as usize);
        let method = method.into();
        let grid = method.tiling.grid(size);
        // One more, for pairs that touch none.
        let tiles = grid[0] * grid[1] + 1;
        let [per_drawn, per_sorted, per_scanned] = dispatch::several(gpu, "drawn_groups", [64; 3])?;
        Ok(Self {
            method,
            pairs,
            conic: gpu.buffer("conic", n)?,
            tiles: gpu.buffer("tiles", n)?,
            first_pair: gpu.buffer("first_pair", n)?,
            drawn: Slots { list: gpu.buffer("drawn", n)?, count: gpu.buffer("drawn_count", 1)?, groups: per_drawn },
            per_sorted,
            per_scanned,
            depth_keys: gpu.buffer("depth_keys", n)?,
            depth_values: gpu.buffer("depth_values", n)?,
            rank_tiles: gpu.buffer("rank_tiles", n)?,
            rank_first: gpu.buffer("rank_first", n)?,
            pair_total: gpu.buffer("pair_total", 1)?,
            pair_count: gpu.buffer("pair_count", 1)?,
            pair_tile: gpu.buffer("pair_tile", p)?,
            pair_slot: gpu.buffer("pair_slot", p)?,
            sorted: gpu.buffer("sorted", p)?,
            ranges: gpu.buffer("ranges", tiles as usize)?,
            compact: Compact::new(gpu, slots)?,
            depth_sort: Sort::new(gpu, slots)?,
            scan: Scan::new(gpu, slots)?,
            by_tile: match method.tiling {
                Tiling::Wide => {
                    let cuts = pairs.div_ceil(CUT).max(1) as usize;
                    ByTile::Sort {
                        sort: Sort::new(gpu, pairs)?,
                        groups: dispatch::groups(gpu, "pair_groups", 64)?,
                        cut_tile: gpu.buffer("cut_tile", cuts)?,
                        cut_state: gpu.buffer("cut_state", cuts * CUT_VALUES)?,
                    }
                }
                Tiling::Narrow => ByTile::Tally(Tally::new(gpu, tiles, p)?),
            },
        })
    }

    /// Slots that touch a tile.
    pub fn drawn(&self) -> &Slots {
        &self.drawn
    }

    /// Tiles touched by each slot's Gaussian, 0 also where there is none: for the growth statistics and the way back.
    pub fn tiles(&self) -> &Buffer<u32> {
        &self.tiles
    }

    /// Lists of a picture of `size`. More pairs than there is room for raise the overflow flag and draw nothing.
    pub fn record<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        gaussians: Projected<'_>,
        size: [u32; 2],
        limits: &Limits,
    ) -> Binned<'a> {
        let Projected { slots, existing, mean, covariance, depth, opacity, .. } = gaussians;
        let Self {
            conic, tiles, drawn, per_sorted, per_scanned, depth_keys, depth_values, rank_tiles, rank_first, ..
        } = self;
        let Self { pair_total, pair_count, pair_tile, pair_slot, first_pair, ranges, sorted, .. } = self;
        let Method { tiling, alpha_min, depth_key, .. } = self.method;
        let (grid, tile) = (tiling.grid(size), tiling.side());
        // What does not exist touches none.
        rec.zero(tiles);
        let Slots { list, count, groups } = existing;
        let buffers = bin_count::Buffers { count, list, mean, covariance, depth, opacity, conic, tiles };
        let constants = bin_count::Constants { alpha_min };
        rec.run_with(bin_count::Kernel, constants, buffers, bin_count::Push { grid, tile }, groups);

        self.compact.record(rec, tiles, &drawn.list, &drawn.count, slots);
        limits.note(rec, &drawn.count, Counter::Drawn);
        let (drawn_count, drawn_groups) = (&drawn.count, &drawn.groups);
        let shapes = [(drawn_groups, Shape::EACH), (per_sorted, self.depth_sort.shape()), (per_scanned, scan::SHAPE)];
        dispatch::record_several(rec, drawn_count, drawn.list.len() as u32, shapes);
        let buffers =
            bin_depth_keys::Buffers { drawn_count, drawn: &drawn.list, depth, keys: depth_keys, values: depth_values };
        let push = bin_depth_keys::Push { base: depth_key.base, last: depth_key.last() };
        rec.run(bin_depth_keys::Kernel, buffers, push, drawn_groups);
        let pairs = Pairs { keys: depth_keys, values: depth_values };
        let order =
            self.depth_sort.record(rec, pairs, Count::Counted(drawn_count, per_sorted), 0..depth_key.bits).values;

        rec.run(bin_rank::Kernel, bin_rank::Buffers { drawn_count, order, tiles, rank_tiles }, (), drawn_groups);
        self.scan.record(rec, rank_tiles, rank_first, pair_total, Count::Counted(drawn_count, per_scanned));
        limits.record(rec, pair_total, pair_count, self.pairs, Counter::Pairs);
        let buffers = bin_expand::Buffers {
            drawn_count,
            pair_count,
            order,
            rank_first,
            tiles,
            mean,
            covariance,
            opacity,
            first_pair,
            pair_tile,
            pair_slot,
        };
        // On a CPU threads of a subgroup run in step: the longest is waited for in any case.
        let long = if rec.gpu().form() == Form::Cpu { u32::MAX } else { LONG };
        let constants = bin_expand::Constants { alpha_min, long };
        rec.run_with(bin_expand::Kernel, constants, buffers, bin_expand::Push { grid, tile }, drawn_groups);
        let last = grid[0] * grid[1];
        let (sorted, blended, cuts) = match &self.by_tile {
            ByTile::Sort { sort, groups, cut_tile, cut_state } => {
                let pairs = Pairs { keys: pair_tile, values: sorted };
                let bits = 32 - last.leading_zeros();
                let sorted = sort.record_indices(rec, pairs, Count::Device(pair_count), 0..bits);
                rec.zero(ranges);
                // Without pairs nothing is written.
                rec.zero(cut_tile);
                dispatch::record(rec, pair_count, groups, self.pairs, 1);
                let buffers = bin_ranges::Buffers { pair_count, sorted_tile: sorted.keys, ranges, cut_tile };
                rec.run(bin_ranges::Kernel, buffers, (), groups);
                (sorted.values, None, Some(Cuts { tile: cut_tile, state: cut_state }))
            }
            ByTile::Tally(Tally { runs, run_pairs, run_first, placed, scan, blended, blended_count }) => {
                let (runs, tiles) = (*runs, last + 1);
                rec.zero(run_pairs);
                let buffers = cpu::bin_tally::Buffers { pair_count, pair_tile, run_pairs };
                rec.run(cpu::bin_tally::Kernel, buffers, cpu::bin_tally::Push { runs }, runs);
                scan.record(rec, run_pairs, run_first, placed, Count::Host(tiles * runs));
                let buffers = cpu::bin_tally_ranges::Buffers { pair_count, run_first, ranges };
                rec.run(cpu::bin_tally_ranges::Kernel, buffers, cpu::bin_tally_ranges::Push { tiles, runs }, tiles);
                let buffers = cpu::bin_place::Buffers { pair_count, pair_tile, run_first, sorted };
                rec.run(cpu::bin_place::Kernel, buffers, cpu::bin_place::Push { runs }, runs);
                (sorted, Some(Blended { pairs: blended, count: blended_count }), None)
            }
        };
        Binned { conic, tiles, drawn, pair_count, first_pair, pair_slot, sorted, ranges, blended, cuts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};
    use crate::render::method::DepthKey;
    use rand::{RngExt, SeedableRng};

    const SIZE: [u32; 2] = [83, 61];

    /// Every pass against its twin, and the lists against the tiles sorted by key and slot on the host.
    fn check(gpu: &testing::TestGpu, n: usize, method: Method) {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64);
        let mut random = |low: f32, high: f32| -> Vec<f32> { (0..n).map(|_| rng.random_range(low..high)).collect() };
        let (x, y, opacity) = (random(-9.0, 90.0), random(-9.0, 70.0), random(-0.1, 1.0));
        let mean: Vec<[f32; 2]> = std::iter::zip(x, y).map(|(x, y)| [x, y]).collect();
        let (mut side, slope) = (random(0.31, 80.0), random(-0.9, 0.9));
        // Some cover the picture.
        side.iter_mut().step_by(13).for_each(|side| *side *= 100.0);
        let covariance: Vec<[f32; 3]> = std::iter::zip(side, slope).map(|(s, r)| [s, r * (s - 0.3), s]).collect();
        // Some equal, some closer than coarse keys tell apart, some farther than they reach, some absent.
        let depth: Vec<f32> = (0..n)
            .map(|i| match i % 7 {
                0 => 0.0,
                1 => 2.5,
                2 => 2.5 + i as f32 * 1e-6,
                3 => 1e12 + i as f32 * 1e6,
                _ => 0.2 + 0.01 * (i * 37 % 1001) as f32,
            })
            .collect();
        let fine = "the device has room";
        let upload = |name, values: &[f32]| gpu.upload(name, values).expect(fine);
        let limits = Limits::new(gpu).expect(fine);
        let count = gpu.upload("count", &[n as u32]).expect(fine);
        let existing = Slots::all(gpu, n as u32).expect(fine);
        let [depths, opacities] = [upload("depth", &depth), upload("opacity", &opacity)];
        let means = gpu.upload("mean", &mean).expect(fine);
        let covariances = gpu.upload("covariance", &covariance).expect(fine);
        let colors = gpu.buffer("color", n).expect(fine);
        let projected = Projected {
            slots: Count::Device(&count),
            existing: &existing,
            mean: &means,
            covariance: &covariances,
            depth: &depths,
            opacity: &opacities,
            color: &colors,
        };
        let bin = Bin::new(gpu, method, n as u32, 200 * n as u32, SIZE).expect(fine);
        let mut rec = gpu.checked().expect(fine);
        let binned = bin.record(&mut rec, projected, SIZE, &limits);
        let submission = rec.submit().expect(fine);
        for difference in &submission.differences {
            assert!(difference.ok(), "{n} Gaussians, {method:?}: {difference}");
        }
        submission.wait().expect(fine);
        assert_eq!(gpu.read(limits.overflow()).expect(fine), [0]);

        let grid = method.tiling.grid(SIZE);
        let (tiles, pair_slot) = (gpu.read(binned.tiles).expect(fine), gpu.read(binned.pair_slot).expect(fine));
        let (sorted, ranges) = (gpu.read(binned.sorted).expect(fine), gpu.read(binned.ranges).expect(fine));
        let pairs: u32 = tiles[..n].iter().sum();
        assert_eq!(gpu.read(binned.pair_count).expect(fine), [pairs]);
        let listed: u32 = ranges[..(grid[0] * grid[1]) as usize].iter().map(|[first, end]| end - first).sum();
        // An edge that counting and expanding round differently is listed behind the last tile.
        assert!(pairs - listed <= pairs / 500, "{listed} of {pairs} pairs are in a list");
        for [first, end] in ranges {
            let list: Vec<(u32, u32)> = sorted[first as usize..end as usize]
                .iter()
                .map(|&pair| pair_slot[pair as usize])
                .map(|slot| (method.depth_key.of(depth[slot as usize]), slot))
                .collect();
            assert!(list.is_sorted(), "{n} Gaussians, {method:?}: {list:?}");
        }
        if n > 100 {
            assert!(listed > n as u32, "something is drawn");
        }
    }

    #[test]
    fn lists_are_complete_and_in_order() {
        for form in [Form::Cpu, Form::Gpu] {
            lists_are_complete_and_in_order_on(&testing::gpu_with(Options { form: Some(form), ..Options::default() }));
        }
    }

    fn lists_are_complete_and_in_order_on(gpu: &testing::TestGpu) {
        for tiling in [Tiling::Wide, Tiling::Narrow] {
            let method = Method::from(tiling);
            for n in [0, 1, 63, 64, 65, 1000] {
                check(gpu, n, method);
            }
            for bits in [28, 31] {
                check(gpu, 999, Method { depth_key: DepthKey::new(0.2, bits), ..method });
            }
            for alpha_min in [1e-3, 0.1] {
                check(gpu, 257, Method { alpha_min, ..method });
            }
        }
    }
}

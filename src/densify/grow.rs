//! New anchors where Gaussians pull hard at the picture (Scaffold-GS, section 3.3).
//!
//! Level by level, coarse cells first: candidates are found and their cells' box; their cells are sorted, exactly (the
//! coordinates themselves are the keys); cells in which an anchor lies are struck out by binary search; the rest get an
//! anchor each, in the order of their cells. The host learns two numbers per level: how many candidates there are, to
//! size scratch memory, and how many free cells, to make room.

use crate::gpu::kernels::densify::{
    grow_append, grow_candidates, grow_cells, grow_heads, grow_keys, grow_lots, grow_occupied, grow_reset, grow_words,
};
use crate::gpu::{Buffer, Check, Error, Gpu, Reference};
use crate::model::anchors::Anchors;
use crate::primitives::{Compact, Count, Pairs, Sort};

use super::{Config, Statistics};

/// pcg4d: four words to four words (Jarzynski and Olano, Hash Functions for GPU Rendering, JCGT 2020).
fn pcg4d(words: [u32; 4]) -> [u32; 4] {
    fn mix([x, y, z, w]: [u32; 4]) -> [u32; 4] {
        let x = x.wrapping_add(y.wrapping_mul(w));
        let y = y.wrapping_add(z.wrapping_mul(x));
        let z = z.wrapping_add(x.wrapping_mul(y));
        let w = w.wrapping_add(y.wrapping_mul(z));
        [x, y, z, w]
    }
    let words = words.map(|word| word.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    mix(mix(words).map(|word| word ^ (word >> 16)))
}

/// Cells either way, see `cell.glsl`: further out float32 does not tell a cell's centre from its neighbour's.
pub const CELL_LIMIT: f32 = 2e6;

/// A cell of a grid, in float32 as on the device; none beyond [`CELL_LIMIT`] cells from the origin.
fn cell(p: [f32; 3], inverse_size: f32) -> Option<[i32; 3]> {
    let q = p.map(|x| (x * inverse_size).round_ties_even());
    q.iter().all(|x| x.abs() <= CELL_LIMIT).then(|| q.map(|x| x as i32))
}

/// Where the Gaussian of slot s = anchor * offsets + k lies, in float32 as on the device but for the exponential.
fn gaussian_position(
    position: &[[f32; 3]],
    offset: &[[f32; 3]],
    log_scaling: &[f32],
    s: usize,
    offsets: u32,
) -> [f32; 3] {
    let a = s / offsets as usize;
    std::array::from_fn(|i| position[a][i] + offset[s][i] * f64::from(log_scaling[6 * a + i]).exp() as f32)
}

/// Coordinates packed one behind the other, x lowest, into 96 bits.
fn cell_key(above: [u32; 3], bits: [u32; 3]) -> [u32; 3] {
    let [x, y, z] = above.map(u128::from);
    let key = x | y << bits[0] | z << (bits[0] + bits[1]);
    [key as u32, (key >> 32) as u32, (key >> 64) as u32]
}

/// The inverse of [`cell_key`].
fn cell_above(key: [u32; 3], bits: [u32; 3]) -> [u32; 3] {
    let key = u128::from(key[0]) | u128::from(key[1]) << 32 | u128::from(key[2]) << 64;
    let field = |at: u32, bits: u32| ((key >> at) & ((1 << bits) - 1)) as u32;
    [field(0, bits[0]), field(bits[0], bits[1]), field(bits[0] + bits[1], bits[2])]
}

/// A candidate's cell may differ where the rounding of its exponential (a few units in the last place of an offset of
/// some cells: 1e-5 cells) carries it over a boundary.
const BOUNDARY: Check = Check { relative: 0.0, absolute: 0.0, band: 1e-4 };

impl Reference for grow_candidates::Kernel {
    fn reference(host: grow_candidates::Host<'_>, push: grow_candidates::Push, (): ()) {
        for s in 0..push.slots as usize {
            let n = host.seen[s];
            let judged = n > push.min_seen && host.gradient[s] >= push.threshold * n as f32;
            let hash = pcg4d([s as u32, push.level, push.step, push.seed])[0];
            let mut found = None;
            if judged && hash >> (31 - push.level) != 0 {
                let p = gaussian_position(host.position, host.offset, host.log_scaling, s, push.offsets);
                found = cell(p, push.inverse_size);
                host.bounds[6] += i32::from(found.is_none());
            }
            host.flags[s] = found.is_some().into();
            for (i, x) in found.into_iter().flatten().enumerate() {
                host.bounds[i] = host.bounds[i].min(x);
                host.bounds[3 + i] = host.bounds[3 + i].max(x);
            }
        }
    }

    fn check(binding: &'static str) -> Check {
        if binding == "bounds" { BOUNDARY } else { Check::default() }
    }
}

impl Reference for grow_keys::Kernel {
    fn reference(host: grow_keys::Host<'_>, push: grow_keys::Push, (): ()) {
        for (j, &s) in host.candidates.iter().take(push.found as usize).enumerate() {
            let p = gaussian_position(host.position, host.offset, host.log_scaling, s as usize, push.offsets);
            let cell = cell(p, push.inverse_size).expect("candidates have a cell");
            let above = std::array::from_fn(|i| cell[i].wrapping_sub(push.low[i]) as u32);
            host.keys[j] = cell_key(above, push.bits);
            host.first_words[j] = host.keys[j][0];
        }
    }

    fn check(_: &'static str) -> Check {
        BOUNDARY
    }
}

impl Reference for grow_words::Kernel {
    fn reference(host: grow_words::Host<'_>, push: grow_words::Push, (): ()) {
        for (word, &j) in host.words.iter_mut().zip(&host.order[..push.found as usize]) {
            *word = host.keys[j as usize][push.word as usize];
        }
    }
}

impl Reference for grow_heads::Kernel {
    fn reference(host: grow_heads::Host<'_>, push: grow_heads::Push, (): ()) {
        let key = |r: usize| host.keys[host.order[r] as usize];
        for r in 0..push.found as usize {
            host.flags[r] = u32::from(r == 0 || key(r) != key(r - 1));
        }
    }
}

impl Reference for grow_cells::Kernel {
    fn reference(host: grow_cells::Host<'_>, (): (), (): ()) {
        for (u, &head) in host.heads.iter().take(host.cell_count[0] as usize).enumerate() {
            host.cells[u] = host.keys[host.order[head as usize] as usize];
            host.free[u] = 1;
        }
    }
}

impl Reference for grow_occupied::Kernel {
    fn reference(host: grow_occupied::Host<'_>, push: grow_occupied::Push, (): ()) {
        let cells = &host.cells[..host.cell_count[0] as usize];
        for &p in &host.position[..push.anchors as usize] {
            let Some(cell) = cell(p, push.inverse_size) else { continue };
            if (0..3).all(|i| (push.low[i]..=push.high[i]).contains(&cell[i])) {
                let key = cell_key(std::array::from_fn(|i| (cell[i] - push.low[i]) as u32), push.bits);
                if let Some(u) = cells.iter().position(|&other| other == key) {
                    host.free[u] = 0;
                }
            }
        }
    }
}

impl Reference for grow_lots::Kernel {
    fn reference(host: grow_lots::Host<'_>, push: grow_lots::Push, (): ()) {
        for (f, lot) in host.lots.iter_mut().take(push.cells as usize).enumerate() {
            *lot = pcg4d([f as u32, push.level, push.step, push.seed])[1];
        }
    }
}

impl Reference for grow_append::Kernel {
    fn reference(host: grow_append::Host<'_>, push: grow_append::Push, (): ()) {
        let heads = &host.heads[..host.cell_count[0] as usize];
        for (f, &u) in host.free_cells.iter().take(push.added as usize).enumerate() {
            let (u, a) = (u as usize, push.anchors as usize + f);
            let last = heads.get(u + 1).map_or(push.found, |&next| next);
            for c in 0..32 {
                let feature = |r: u32| {
                    let slot = host.candidates[host.order[r as usize] as usize];
                    host.feature[(slot / push.offsets) as usize * 32 + c]
                };
                host.feature[a * 32 + c] = (heads[u]..last).map(feature).fold(f32::NEG_INFINITY, f32::max);
            }
            host.log_scaling[6 * a..][..6].fill(push.log_size);
            let above = cell_above(host.cells[u], push.bits);
            host.position[a] = std::array::from_fn(|i| (push.low[i] + above[i] as i32) as f32 * push.size);
        }
    }
}

impl Reference for grow_reset::Kernel {
    fn reference(host: grow_reset::Host<'_>, push: grow_reset::Push, (): ()) {
        for (gradient, seen) in host.gradient.iter_mut().zip(host.seen).take(push.slots as usize) {
            if *seen > push.min_seen {
                (*gradient, *seen) = (0.0, 0);
            }
        }
    }
}

/// What a round of growing did.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Grown {
    /// New anchors.
    pub added: u32,
    /// Cells that asked for an anchor when there was no room for more (`max_anchors`, or the device's).
    pub refused: u32,
    /// Gaussians that asked for an anchor more than [`CELL_LIMIT`] cells from the origin (or at no place at all: a
    /// coordinate is not a number), over all levels.
    pub beyond: u32,
}

/// Of one round: where its random numbers come from, and its grid.
#[derive(Clone, Copy, Debug)]
pub struct Round {
    /// Side of a voxel, scene units.
    pub voxel: f32,
    /// Of the run.
    pub seed: u64,
    /// Of the training: every round draws other numbers.
    pub step: u32,
}

/// Cells of a level and the candidates in them, on the device.
struct Cells {
    /// Candidates.
    found: u32,
    low: [i32; 3],
    bits: [u32; 3],
    /// `[candidate]` their places among [anchor, offset].
    candidates: Buffer<u32>,
    /// `[candidate]` sorted by cell.
    order: Buffer<u32>,
    /// `[cell]` first of each in `order`.
    heads: Buffer<u32>,
    /// `[cell]` packed coordinates.
    cells: Buffer<[u32; 3]>,
    cell_count: Buffer<u32>,
    /// `[free]` cells without an anchor, ascending.
    free: Buffer<u32>,
    free_count: u32,
}

/// Side of a level's cells, its inverse and its logarithm.
fn sizes(config: &Config, voxel: f32, level: u32) -> (f32, f32, f32) {
    let size = f64::from(voxel) * config.coarsest_cell / 4f64.powi(level as i32);
    (size as f32, (1.0 / size) as f32, size.ln() as f32)
}

/// A run's seed as the kernels take it.
fn fold(seed: u64) -> u32 {
    (seed ^ (seed >> 32)) as u32
}

/// The candidates of a level among the Gaussians of the first `judged` anchors, sorted into cells; `None` without any.
/// Also how many lie beyond the grid.
fn cells(
    gpu: &Gpu,
    anchors: &Anchors,
    statistics: &Statistics,
    judged: u32,
    config: &Config,
    round: Round,
    level: u32,
) -> Result<(Option<Cells>, u32), Error> {
    let (_, inverse_size, _) = sizes(config, round.voxel, level);
    let offsets = anchors.offsets;
    let slots = judged * offsets;
    let position = &anchors.position;
    let offset = anchors.offset.value.view::<[f32; 3]>();
    let log_scaling = &anchors.log_scaling.value;

    let flags = gpu.buffer("candidate_flags", slots as usize)?;
    let listed = gpu.buffer("candidates", slots as usize)?;
    let count = gpu.buffer("candidate_count", 1)?;
    let bounds = gpu.upload("candidate_bounds", &[i32::MAX, i32::MAX, i32::MAX, i32::MIN, i32::MIN, i32::MIN, 0])?;
    let compact = Compact::new(gpu, slots)?;
    let mut rec = gpu.recorder()?;
    let buffers = grow_candidates::Buffers {
        gradient: &statistics.gradient,
        seen: &statistics.seen,
        position,
        offset: &offset,
        log_scaling,
        flags: &flags,
        bounds: &bounds,
    };
    let push = grow_candidates::Push {
        slots,
        offsets,
        threshold: (config.gradient_threshold * f64::from(1 << level)) as f32,
        min_seen: config.min_slot_visits,
        level,
        step: round.step,
        seed: fold(round.seed),
        inverse_size,
    };
    rec.run(grow_candidates::Kernel, buffers, push, slots);
    compact.record(&mut rec, &flags, &listed, &count, Count::Host(slots));
    rec.submit()?.wait()?;
    let found = gpu.read(&count)?[0];
    let bounds = gpu.read(&bounds)?;
    let beyond = bounds[6] as u32;
    if found == 0 {
        return Ok((None, beyond));
    }
    let [low, high]: [[i32; 3]; 2] = [0, 3].map(|at| std::array::from_fn(|i| bounds[at + i]));
    let bits: [u32; 3] = std::array::from_fn(|i| ((high[i] - low[i]) as u32).checked_ilog2().map_or(0, |top| top + 1));

    // The list as short as it is: the long one goes before more memory is taken.
    let candidates = gpu.buffer("candidates", found as usize)?;
    let mut rec = gpu.recorder()?;
    rec.copy(&listed, &candidates, found as usize);
    rec.submit()?.wait()?;
    drop((listed, flags, compact));

    let mut rec = gpu.recorder()?;
    let keys = gpu.buffer("cell_keys", found as usize)?;
    let words = gpu.buffer("cell_words", found as usize)?;
    let buffers = grow_keys::Buffers {
        candidates: &candidates,
        position,
        offset: &offset,
        log_scaling,
        keys: &keys,
        first_words: &words,
    };
    let push = grow_keys::Push { low, bits, found, offsets, inverse_size };
    rec.run(grow_keys::Kernel, buffers, push, found);

    let order = gpu.buffer("cell_order", found as usize)?;
    let sort = Sort::new(gpu, found)?;
    // At least one bit: sorting is what makes the order.
    let mut bits_left = bits.iter().sum::<u32>().max(1);
    for word in 0.. {
        let pairs = Pairs { keys: &words, values: &order };
        let range = 0..bits_left.min(32);
        let sorted = if word == 0 {
            sort.record_indices(&mut rec, pairs, Count::Host(found), range)
        } else {
            let buffers = grow_words::Buffers { keys: &keys, order: &order, words: &words };
            rec.run(grow_words::Kernel, buffers, grow_words::Push { found, word }, found);
            sort.record(&mut rec, pairs, Count::Host(found), range)
        };
        if !std::ptr::eq(sorted.values, &order) {
            rec.copy(sorted.values, &order, found as usize);
        }
        bits_left = bits_left.saturating_sub(32);
        if bits_left == 0 {
            break;
        }
    }

    let compact = Compact::new(gpu, found)?;
    let flags = gpu.buffer("cell_flags", found as usize)?;
    let heads = gpu.buffer("cell_heads", found as usize)?;
    let cell_count = gpu.buffer("cell_count", 1)?;
    let buffers = grow_heads::Buffers { keys: &keys, order: &order, flags: &flags };
    rec.run(grow_heads::Kernel, buffers, grow_heads::Push { found }, found);
    compact.record(&mut rec, &flags, &heads, &cell_count, Count::Host(found));
    let cells = gpu.buffer("cells", found as usize)?;
    let buffers = grow_cells::Buffers {
        keys: &keys,
        order: &order,
        heads: &heads,
        cell_count: &cell_count,
        cells: &cells,
        free: &flags,
    };
    rec.run(grow_cells::Kernel, buffers, (), found);
    let buffers = grow_occupied::Buffers { position, cells: &cells, cell_count: &cell_count, free: &flags };
    let push = grow_occupied::Push { low, high, bits, anchors: anchors.count, inverse_size };
    rec.run(grow_occupied::Kernel, buffers, push, anchors.count);
    let free = gpu.buffer("free_cells", found as usize)?;
    let free_count = gpu.buffer("free_count", 1)?;
    compact.record(&mut rec, &flags, &free, &free_count, Count::Device(&cell_count));
    rec.submit()?.wait()?;
    let free_count = gpu.read(&free_count)?[0];
    let cells = Cells { found, low, bits, candidates, order, heads, cells, cell_count, free, free_count };
    Ok((Some(cells), beyond))
}

/// The free cells in an order drawn by lot: the first of them are a fair choice.
fn draw_lots(gpu: &Gpu, cells: &Cells, round: Round, level: u32) -> Result<Buffer<u32>, Error> {
    let lots = gpu.buffer("lots", cells.free_count as usize)?;
    let drawn = gpu.buffer("drawn_cells", cells.found as usize)?;
    let sort = Sort::new(gpu, cells.free_count)?;
    let mut rec = gpu.recorder()?;
    let push = grow_lots::Push { cells: cells.free_count, level, step: round.step, seed: fold(round.seed) };
    rec.run(grow_lots::Kernel, grow_lots::Buffers { lots: &lots }, push, cells.free_count);
    let pairs = Pairs { keys: &lots, values: &cells.free };
    let sorted = sort.record(&mut rec, pairs, Count::Host(cells.free_count), 0..32);
    rec.copy(sorted.values, &drawn, cells.free_count as usize);
    rec.submit()?.wait()?;
    Ok(drawn)
}

/// Makes room for `count` anchors and a sixteenth more, at most `most`. Memory follows the anchors closely: a round comes
/// every so many steps, and costs a copy of the model at most.
fn reserve(gpu: &Gpu, anchors: &mut Anchors, statistics: &mut Statistics, count: u32, most: u32) -> Result<(), Error> {
    if count > anchors.capacity {
        let capacity = count.saturating_add(count / 16).min(most).max(count);
        statistics.reserve(gpu, anchors.count, capacity)?;
        anchors.reserve(gpu, capacity)?;
    }
    Ok(())
}

/// One round of growing: a new anchor in every cell, level by level, in which candidates lie and no anchor does.
///
/// A Gaussian is a candidate of level i if it was drawn more than `min_slot_visits` times with a mean gradient of at
/// least `gradient_threshold * 2^i`, and then with probability `1 - 0.5^(i+1)`, drawn from a hash of (slot, level, step,
/// seed). Cells of level i have sides of `voxel * coarsest_cell / 4^i`; a point lies in the cell whose centre is
/// nearest. A new anchor sits in the centre, has the component-wise largest feature of the cell's candidates, offsets
/// 0, all log-scales the logarithm of the side, and neither moments nor statistics. Finer levels see the anchors of
/// coarser ones. Gaussians that were drawn more than `min_slot_visits` times start counting afresh.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn run(
    gpu: &Gpu,
    anchors: &mut Anchors,
    statistics: &mut Statistics,
    config: &Config,
    round: Round,
) -> Result<Grown, Error> {
    let mut grown = Grown::default();
    let judged = anchors.count;
    let most = match config.max_anchors {
        0 => Anchors::most(gpu, anchors.offsets),
        limit => limit.min(Anchors::most(gpu, anchors.offsets)),
    };
    for level in 0..config.levels {
        let (cells, beyond) = cells(gpu, anchors, statistics, judged, config, round, level)?;
        grown.beyond += beyond;
        let Some(mut cells) = cells else { continue };
        let added = cells.free_count.min(most.saturating_sub(anchors.count));
        grown.refused += cells.free_count - added;
        if added == 0 {
            continue;
        }
        if added < cells.free_count {
            cells.free = draw_lots(gpu, &cells, round, level)?;
        }
        let (first, offsets) = (anchors.count, anchors.offsets);
        reserve(gpu, anchors, statistics, first + added, most)?;
        let mut rec = gpu.recorder()?;
        let (size, _, log_size) = sizes(config, round.voxel, level);
        let buffers = grow_append::Buffers {
            free_cells: &cells.free,
            cells: &cells.cells,
            cell_count: &cells.cell_count,
            heads: &cells.heads,
            order: &cells.order,
            candidates: &cells.candidates,
            position: &anchors.position,
            feature: &anchors.feature.value,
            log_scaling: &anchors.log_scaling.value,
        };
        let Cells { low, bits, found, .. } = cells;
        let push = grow_append::Push { low, bits, found, offsets, anchors: first, added, size, log_size };
        rec.run(grow_append::Kernel, buffers, push, added as usize * 32);
        rec.zero_range(&anchors.offset.value, (first * 3 * offsets) as usize, (added * 3 * offsets) as usize);
        for parameter in anchors.parameters() {
            let [at, len] = [first, added].map(|n| (n * parameter.width) as usize);
            rec.zero_range(&parameter.first, at, len);
            rec.zero_range(&parameter.root, at, len);
        }
        let [at, len] = [first, added].map(|n| n as usize);
        rec.zero_range(&statistics.gradient, at * offsets as usize, len * offsets as usize);
        rec.zero_range(&statistics.seen, at * offsets as usize, len * offsets as usize);
        rec.zero_range(&statistics.opacity_sum, at, len);
        rec.zero_range(&statistics.visits, at, len);
        rec.submit()?.wait()?;
        anchors.count += added;
        grown.added += added;
    }
    let mut rec = gpu.recorder()?;
    let buffers = grow_reset::Buffers { gradient: &statistics.gradient, seen: &statistics.seen };
    let push = grow_reset::Push { slots: judged * anchors.offsets, min_seen: config.min_slot_visits };
    rec.run(grow_reset::Kernel, buffers, push, push.slots);
    rec.submit()?.wait()?;
    Ok(grown)
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, HashSet};

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
        let random_cell =
            |rng: &mut Pcg64Mcg| -> [i32; 3] { std::array::from_fn(|_| rng.random_range(-extent..=extent)) };
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
        model
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
                let push =
                    grow_keys::Push { low: [-200; 3], bits, found: found as u32, offsets: 10, inverse_size: 25.0 };
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
            case.cells =
                case.heads.iter().map(|&h| cell_key(case.keys[case.order[h as usize] as usize], bits)).collect();
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
            testing::assert_twin(
                grow_reset::Kernel,
                &gpu,
                case,
                grow_reset::Push { slots: n as u32, min_seen: 40 },
                n + 4,
            );
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
        for level in 0..config.levels {
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
        let model = files::Anchors {
            position: integers(3 * 200, 100).as_chunks().0.to_vec(),
            feature: integers(32 * 200, 100).as_chunks().0.to_vec(),
            offset: integers(3 * 2000, 2_000_000 - 200),
            offsets_per_anchor: 10,
            log_scaling: vec![[0.0; 6]; 200],
        };
        let mut gathered = Gathered::random(&mut rng, 200, 10);
        let round = Round { voxel: 1.0, seed: 8, step: 1600 };
        let config = Config { levels: 1, coarsest_cell: 1.0, ..Config::default() };
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
            let config = Config { max_anchors, levels: 1, ..Config::default() };
            let grown = run(&gpu, &mut anchors, &mut statistics, &config, round).unwrap();
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
}

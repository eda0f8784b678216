//! New anchors where Gaussians pull hard at the picture (Scaffold-GS, section 3.3).
//!
//! Level by level, coarse cells first: candidates are found and their cells' box; their cells are sorted, exactly (the
//! coordinates themselves are the keys); cells in which an anchor lies are struck out by binary search; the rest get an
//! anchor each, in the order of their cells. The host learns two numbers per level: how many candidates there are, to
//! size scratch memory, and how many free cells, to make room.

#[cfg(test)]
mod tests;
mod twins;

use super::config::LEVELS;
use super::{Config, Statistics};
use crate::gpu::kernels::densify::{
    grow_append, grow_candidates, grow_cells, grow_heads, grow_keys, grow_lots, grow_occupied, grow_reset, grow_words,
};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::model::anchors::Anchors;
use crate::model::arrays::ARRAYS;
use crate::primitives::{Compact, Count, Pairs, Sort};
pub use twins::CELL_LIMIT;

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

/// The Gaussians of the anchors there are that ask for an anchor in a level's cells.
struct Listed {
    /// `[candidate]` their places among [anchor, offset].
    candidates: Buffer<u32>,
    /// Their number, on the host.
    count: Buffer<u32>,
    /// The lowest and the highest of their cells, and how many lie beyond the grid, on the host.
    bounds: Buffer<i32>,
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

/// Finds the candidates of all levels.
fn list(
    rec: &mut Recorder<'_>,
    anchors: &Anchors,
    statistics: &Statistics,
    config: &Config,
    round: Round,
    levels: u32,
) -> Result<Vec<Listed>, Error> {
    let gpu = rec.gpu();
    let slots = anchors.count * anchors.offsets;
    let offset = anchors.offset().value.view::<[f32; 3]>();
    let flags = gpu.buffer("candidate_flags", slots as usize)?;
    let compact = Compact::new(gpu, slots)?;
    let count = gpu.buffer("candidate_count", 1)?;
    let bounds = gpu.buffer::<i32>("candidate_bounds", 7)?;
    let list = |level| {
        let candidates = gpu.buffer("candidates", slots as usize)?;
        rec.fill_range(&bounds, 0, 3, i32::MAX as u32);
        rec.fill_range(&bounds, 3, 3, i32::MIN as u32);
        rec.zero_range(&bounds, 6, 1);
        let buffers = grow_candidates::Buffers {
            gradient: &statistics.gradient,
            seen: &statistics.seen,
            position: &anchors.position,
            offset: &offset,
            log_scaling: &anchors.log_scaling().value,
            flags: &flags,
            bounds: &bounds,
        };
        let push = grow_candidates::Push {
            slots,
            offsets: anchors.offsets,
            threshold: (config.gradient_threshold * f64::from(1 << level)) as f32,
            min_seen: config.min_slot_visits,
            level,
            step: round.step,
            seed: fold(round.seed),
            inverse_size: sizes(config, round.voxel, level).1,
        };
        rec.run(grow_candidates::Kernel, buffers, push, slots);
        compact.record(rec, &flags, &candidates, &count, Count::Host(slots));
        Ok(Listed { candidates, count: rec.read_back(&count)?, bounds: rec.read_back(&bounds)? })
    };
    (0..levels).map(list).collect()
}

/// The candidates of a level, sorted into cells.
fn cells(
    rec: &mut Recorder<'_>,
    anchors: &Anchors,
    candidates: Buffer<u32>,
    found: u32,
    bounds: &[i32],
    inverse_size: f32,
) -> Result<Cells, Error> {
    let gpu = rec.gpu();
    let offsets = anchors.offsets;
    let position = &anchors.position;
    let offset = anchors.offset().value.view::<[f32; 3]>();
    let log_scaling = &anchors.log_scaling().value;
    let [low, high]: [[i32; 3]; 2] = [0, 3].map(|at| std::array::from_fn(|i| bounds[at + i]));
    let bits: [u32; 3] = std::array::from_fn(|i| ((high[i] - low[i]) as u32).checked_ilog2().map_or(0, |top| top + 1));

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
            sort.record_indices(rec, pairs, Count::Host(found), range)
        } else {
            let buffers = grow_words::Buffers { keys: &keys, order: &order, words: &words };
            rec.run(grow_words::Kernel, buffers, grow_words::Push { found, word }, found);
            sort.record(rec, pairs, Count::Host(found), range)
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
    compact.record(rec, &flags, &heads, &cell_count, Count::Host(found));
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
    compact.record(rec, &flags, &free, &free_count, Count::Device(&cell_count));
    let free_count = rec.read_back(&free_count)?;
    rec.flush()?;
    let free_count = gpu.read(&free_count)?[0];
    Ok(Cells { found, low, bits, candidates, order, heads, cells, cell_count, free, free_count })
}

/// The free cells in an order drawn by lot: the first of them are a fair choice.
fn draw_lots(rec: &mut Recorder<'_>, cells: &Cells, round: Round, level: u32) -> Result<Buffer<u32>, Error> {
    let gpu = rec.gpu();
    let lots = gpu.buffer("lots", cells.free_count as usize)?;
    let drawn = gpu.buffer("drawn_cells", cells.found as usize)?;
    let sort = Sort::new(gpu, cells.free_count)?;
    let push = grow_lots::Push { cells: cells.free_count, level, step: round.step, seed: fold(round.seed) };
    rec.run(grow_lots::Kernel, grow_lots::Buffers { lots: &lots }, push, cells.free_count);
    let pairs = Pairs { keys: &lots, values: &cells.free };
    let sorted = sort.record(rec, pairs, Count::Host(cells.free_count), 0..32);
    rec.copy(sorted.values, &drawn, cells.free_count as usize);
    Ok(drawn)
}

/// Makes room for `count` anchors and a sixteenth more, at most `most`. Memory follows the anchors closely: a round comes
/// every so many steps, and costs a copy of the model at most.
fn reserve(
    rec: &mut Recorder<'_>,
    anchors: &mut Anchors,
    statistics: &mut Statistics,
    count: u32,
    most: u32,
) -> Result<(), Error> {
    if count > anchors.capacity {
        let capacity = count.saturating_add(count / 16).min(most).max(count);
        statistics.reserve(rec, anchors.count, capacity)?;
        anchors.reserve(rec, capacity)?;
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
    run_levels(gpu, anchors, statistics, config, round, LEVELS)
}

fn run_levels(
    gpu: &Gpu,
    anchors: &mut Anchors,
    statistics: &mut Statistics,
    config: &Config,
    round: Round,
    levels: u32,
) -> Result<Grown, Error> {
    let mut grown = Grown::default();
    let judged = anchors.count;
    let most = match config.max_anchors {
        0 => Anchors::most(gpu, anchors.offsets),
        limit => limit.min(Anchors::most(gpu, anchors.offsets)),
    };
    let mut rec = gpu.recorder()?;
    let listed = list(&mut rec, anchors, statistics, config, round, levels)?;
    rec.flush()?;
    for (level, Listed { candidates, count, bounds }) in (0..).zip(listed) {
        let bounds = gpu.read(&bounds)?;
        grown.beyond += bounds[6] as u32;
        let found = gpu.read(&count)?[0];
        if found == 0 {
            continue;
        }
        let (size, inverse_size, log_size) = sizes(config, round.voxel, level);
        let mut cells = cells(&mut rec, anchors, candidates, found, &bounds, inverse_size)?;
        let added = cells.free_count.min(most.saturating_sub(anchors.count));
        grown.refused += cells.free_count - added;
        if added == 0 {
            continue;
        }
        if added < cells.free_count {
            cells.free = draw_lots(&mut rec, &cells, round, level)?;
        }
        let (first, offsets) = (anchors.count, anchors.offsets);
        reserve(&mut rec, anchors, statistics, first + added, most)?;
        let buffers = grow_append::Buffers {
            free_cells: &cells.free,
            cells: &cells.cells,
            cell_count: &cells.cell_count,
            heads: &cells.heads,
            order: &cells.order,
            candidates: &cells.candidates,
            position: &anchors.position,
            feature: &anchors.feature().value,
            log_scaling: &anchors.log_scaling().value,
        };
        let Cells { low, bits, found, .. } = cells;
        let push = grow_append::Push { low, bits, found, offsets, anchors: first, added, size, log_size };
        rec.run(grow_append::Kernel, buffers, push, added as usize * 32);
        for (array, parameter) in ARRAYS.iter().zip(anchors.parameters()) {
            let [at, len] = [first, added].map(|n| (n * parameter.width) as usize);
            if let Some(initial) = array.initial {
                rec.fill_range(&parameter.value, at, len, initial.to_bits());
            }
            rec.zero_range(&parameter.first, at, len);
            rec.zero_range(&parameter.root, at, len);
        }
        let [at, len] = [first, added].map(|n| n as usize);
        rec.zero_range(&statistics.gradient, at * offsets as usize, len * offsets as usize);
        rec.zero_range(&statistics.seen, at * offsets as usize, len * offsets as usize);
        rec.zero_range(&statistics.opacity_sum, at, len);
        rec.zero_range(&statistics.visits, at, len);
        anchors.count += added;
        grown.added += added;
    }
    let buffers = grow_reset::Buffers { gradient: &statistics.gradient, seen: &statistics.seen };
    let push = grow_reset::Push { slots: judged * anchors.offsets, min_seen: config.min_slot_visits };
    rec.run(grow_reset::Kernel, buffers, push, push.slots);
    rec.submit()?.wait()?;
    Ok(grown)
}

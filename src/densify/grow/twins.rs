//! The kernels' twins.

use crate::gpu::kernels::densify::{
    grow_append, grow_candidates, grow_cells, grow_heads, grow_keys, grow_lots, grow_occupied, grow_reset, grow_words,
};
use crate::gpu::{Check, Reference};
pub(super) use crate::math::hash::pcg4d;

/// Cells either way, see `cell.glsl`: further out float32 does not tell a cell's centre from its neighbour's.
pub const CELL_LIMIT: f32 = 2e6;

/// A cell of a grid, in float32 as on the device; none beyond [`CELL_LIMIT`] cells from the origin.
pub(super) fn cell(p: [f32; 3], inverse_size: f32) -> Option<[i32; 3]> {
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
pub(super) fn cell_key(above: [u32; 3], bits: [u32; 3]) -> [u32; 3] {
    let [x, y, z] = above.map(u128::from);
    let key = x | y << bits[0] | z << (bits[0] + bits[1]);
    [key as u32, (key >> 32) as u32, (key >> 64) as u32]
}

/// The inverse of [`cell_key`].
pub(super) fn cell_above(key: [u32; 3], bits: [u32; 3]) -> [u32; 3] {
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

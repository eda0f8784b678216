//! Binning: which tiles each Gaussian touches, and every tile's list in depth order.
//!
//! Gaussians are sorted by depth once (few), their (Gaussian, tile) pairs are written in that order, and a stable sort
//! by tile alone (few bits) then leaves every tile's list in depth order; equal depths keep the slots' order.

use crate::gpu::kernels::render::{bin_count, bin_depth_keys, bin_expand, bin_ranges, bin_rank};
use crate::gpu::{Buffer, Check, Reference};
use crate::math::tiles::{Support, conic};

impl Reference for bin_count::Kernel {
    fn reference(host: bin_count::Host<'_>, push: bin_count::Push, (): ()) {
        for s in 0..host.slot_count[0] as usize {
            (host.conic[s], host.tiles[s]) = if host.depth[s] > 0.0 {
                let (m, c) = (host.mean[s], host.covariance[s]);
                let q = conic(c);
                let support = Support::new(m, c, q, host.opacity[s], push.tile, push.grid);
                (q, support.tiles(m, push.tile, push.grid).len() as u32)
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
    fn reference(host: bin_depth_keys::Host<'_>, (): (), (): ()) {
        for i in 0..host.drawn_count[0] as usize {
            let s = host.drawn[i];
            host.keys[i] = host.depth[s as usize].to_bits();
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
    fn reference(host: bin_expand::Host<'_>, push: bin_expand::Push, (): ()) {
        if host.pair_count[0] == 0 {
            return;
        }
        for r in 0..host.drawn_count[0] as usize {
            let slot = host.order[r];
            let s = slot as usize;
            let support =
                Support::new(host.mean[s], host.covariance[s], host.conic[s], host.opacity[s], push.tile, push.grid);
            let found = support.tiles(host.mean[s], push.tile, push.grid);
            let first = host.rank_first[r];
            host.first_pair[s] = first;
            for i in 0..host.tiles[s] {
                let p = (first + i) as usize;
                host.pair_tile[p] = found.get(i as usize).copied().unwrap_or(push.grid[0] * push.grid[1]);
                host.pair_index[p] = first + i;
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
            if i == 0 || sorted[i - 1] != tile {
                host.ranges[tile as usize][0] = i as u32;
            }
            if i + 1 == sorted.len() || sorted[i + 1] != tile {
                host.ranges[tile as usize][1] = i as u32 + 1;
            }
        }
    }
}

/// Shape of the rasteriser's tiles.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Hash)]
pub enum Tiling {
    /// 16 x 16 pixels, 64 threads: any subgroup size.
    Wide,
    /// 8 x 8 pixels, one subgroup of 8 threads: CPU drivers.
    Narrow,
}

impl Tiling {
    /// The better shape for a device: narrow where its subgroups have 8 threads.
    pub fn of(subgroup_size: u32) -> Self {
        if subgroup_size == 8 { Self::Narrow } else { Self::Wide }
    }
    /// Side of a tile in pixels.
    pub fn side(self) -> u32 {
        match self {
            Self::Wide => 16,
            Self::Narrow => 8,
        }
    }
    /// Threads per tile.
    pub fn threads(self) -> u32 {
        match self {
            Self::Wide => 64,
            Self::Narrow => 8,
        }
    }
    /// Tiles in x and y of a picture.
    pub fn grid(self, size: [u32; 2]) -> [u32; 2] {
        size.map(|n| n.div_ceil(self.side()))
    }
}

/// The lists of a picture's tiles.
#[derive(Clone, Copy)]
pub struct Binned<'a> {
    /// `[slot]` inverse covariance, px^-2.
    pub conic: &'a Buffer<[f32; 3]>,
    /// `[slot]` tiles touched.
    pub tiles: &'a Buffer<u32>,
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
}

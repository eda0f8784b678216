//! The best of the planes tried at each site.

use super::{CANDIDATES, Grid, Sites};
use crate::gpu::kernels::multiview::choose;
use crate::gpu::{Buffer, Check, Recorder, Reference};

impl Reference for choose::Kernel {
    fn reference(host: choose::Host<'_>, push: choose::Push, (): ()) {
        let sites = Sites { columns: push.sites[0], rows: push.sites[1] };
        let n = sites.of_color();
        for (i, x, y) in sites.colored(push.color) {
            let element = |k: u32| (k * n + i) as usize;
            // Of equal ones the first.
            let score = |k: &u32| host.score[element(*k)];
            let best = (0..CANDIDATES).min_by(|a, b| score(a).total_cmp(&score(b))).expect("there are candidates");
            let site = (y * sites.columns + x) as usize;
            host.plane[site] = host.candidate[element(best)];
            host.cost[site] = host.score[element(best)];
        }
    }

    fn check(_binding: &'static str) -> Check {
        // Comparisons and copies.
        Check { relative: 0.0, absolute: 0.0, band: 0.0 }
    }
}

/// Records the choice at the sites of one colour.
pub(super) fn record(
    rec: &mut Recorder<'_>,
    candidate: &Buffer<[f32; 3]>,
    score: &Buffer<f32>,
    plane: &Buffer<[f32; 3]>,
    cost: &Buffer<f32>,
    grid: &Grid,
    color: u32,
) {
    let push = choose::Push { sites: [grid.sites.columns, grid.sites.rows], color };
    rec.run(choose::Kernel, choose::Buffers { candidate, score, plane, cost }, push, grid.sites.of_color());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use rand::{RngExt, SeedableRng};

    /// With ties, of which the first is taken, and sites of the other colour, which stay.
    #[test]
    fn the_kernel_matches_its_twin() {
        let gpu = testing::gpu();
        let mut rng = rand_pcg::Pcg32::seed_from_u64(3);
        for [columns, rows] in [[1_u32, 1], [1, 4], [8, 5], [33, 20]] {
            for color in [0, 1] {
                let sites = Sites { columns, rows };
                let n = (sites.of_color() * CANDIDATES) as usize;
                let case = choose::Arrays {
                    candidate: (0..n).map(|_| [rng.random(), rng.random(), rng.random()]).collect(),
                    score: (0..n).map(|_| rng.random_range(0..20) as f32 * 0.1).collect(),
                    plane: vec![[testing::UNWRITTEN; 3]; (columns * rows) as usize],
                    cost: vec![testing::UNWRITTEN; (columns * rows) as usize],
                };
                let push = choose::Push { sites: [columns, rows], color };
                testing::assert_twin(choose::Kernel, &gpu, case, push, sites.of_color());
            }
        }
    }
}

//! Planes to try at each site: PatchMatch's propagation and its random search (Barnes et al. 2009; red-black as in Galliani
//! et al. 2015).

use super::{CANDIDATES, Grid, Sites};
use crate::gpu::kernels::multiview::propose;
use crate::gpu::{Buffer, Check, Recorder, Reference};
use crate::math::hash::pcg4d;

/// As the kernel's `STEEPEST`.
const STEEPEST: f32 = 2.0;

/// From -1 to 1.
fn drawn(word: u32) -> f32 {
    ((word >> 8) as i32 - 8_388_608) as f32 * (1.0 / 8_388_608.0)
}

impl Reference for propose::Kernel {
    fn reference(host: propose::Host<'_>, push: propose::Push, (): ()) {
        let sites = Sites { columns: push.sites[0], rows: push.sites[1] };
        let n = sites.of_color();
        for (k, (i, x, y)) in (0..CANDIDATES).flat_map(|k| sites.colored(push.color).map(move |site| (k, site))) {
            let own = host.plane[(y * sites.columns + x) as usize];
            let mut found = own;
            if (1..=8).contains(&k) {
                let far = if k > 4 { push.reach as i32 } else { 1 };
                let [dx, dy] = [[far, 0], [-far, 0], [0, far], [0, -far]][(k as usize - 1) % 4];
                if let Some(from) = sites.at(x as i32 + dx, y as i32 + dy) {
                    let other = host.plane[from];
                    let [dx, dy] = [dx, dy].map(|d| -d as f32 * push.stride);
                    found[0] = other[0] + (other[1] * dx + other[2] * dy);
                    (found[1], found[2]) = (other[1], other[2]);
                }
            } else if k > 8 {
                let [a, b, c, _] = pcg4d([y * sites.columns + x, k, push.draw, push.seed]).map(drawn);
                if k == 9 {
                    let steep = push.tilt * own[0];
                    found = [own[0] + push.spread * a, own[1] + 0.5 * (steep * b), own[2] + 0.5 * (steep * c)];
                } else {
                    let any = push.farthest + (push.nearest - push.farthest) * (0.5 + 0.5 * a);
                    let inverse = if k == 10 { own[0] } else { any };
                    let steep = STEEPEST * (push.tilt * inverse);
                    found = [inverse, steep * b, steep * c];
                }
            }
            found[0] = found[0].max(push.farthest).min(push.nearest);
            host.candidate[(k * n + i) as usize] = found;
        }
    }

    fn check(_binding: &'static str) -> Check {
        // The same float32 operations.
        Check { relative: 0.0, absolute: 0.0, band: 0.0 }
    }
}

/// Records the planes to try at the sites of one colour.
pub(super) fn record(
    rec: &mut Recorder<'_>,
    plane: &Buffer<[f32; 3]>,
    candidate: &Buffer<[f32; 3]>,
    grid: &Grid,
    round: super::Round,
    seed: u32,
) {
    let push = propose::Push {
        sites: [grid.sites.columns, grid.sites.rows],
        color: round.color,
        reach: round.reach,
        draw: round.draw,
        seed,
        stride: super::STRIDE as f32,
        farthest: grid.range[0],
        nearest: grid.range[1],
        spread: round.spread * (grid.range[1] - grid.range[0]),
        tilt: grid.tilt,
    };
    rec.run(propose::Kernel, propose::Buffers { plane, candidate }, push, grid.sites.of_color() * CANDIDATES);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    #[test]
    fn the_kernel_matches_its_twin() {
        let gpu = testing::gpu();
        for [columns, rows] in [[1_u32, 1], [2, 3], [7, 5], [40, 31]] {
            let sites = Sites { columns, rows };
            for color in [0, 1] {
                let plane = (0..columns * rows).map(|i| {
                    let [a, b, c, _] = pcg4d([i, 3, 1, 4]).map(drawn);
                    [0.5 + 0.4 * a, 0.01 * b, 0.01 * c]
                });
                let case = propose::Arrays {
                    plane: plane.collect(),
                    candidate: vec![[testing::UNWRITTEN; 3]; (sites.of_color() * CANDIDATES) as usize + 1],
                };
                let push = propose::Push {
                    sites: [columns, rows],
                    color,
                    reach: 3,
                    draw: 5,
                    seed: 7,
                    stride: 2.0,
                    farthest: 0.1,
                    nearest: 0.95,
                    spread: 0.04,
                    tilt: 1.0 / 240.0,
                };
                testing::assert_twin(propose::Kernel, &gpu, case, push, sites.of_color() * CANDIDATES);
            }
        }
    }
}

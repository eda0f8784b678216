//! Back to front: gradients of pairs.

use super::*;
use crate::gpu::kernels::render::{rasterize_backward, rasterize_gather};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::render::bin::Binned;
use crate::render::method::Method;
use crate::render::project::Projected;
use crate::render::slots::Slots;
use crate::render::tiling::Tiling;

/// Gradients of one pair.
#[derive(Clone, Copy, Default)]
struct PairGradient {
    mean: [f64; 2],
    conic: [f64; 3],
    opacity: f64,
    color: [f64; 3],
    depth: f64,
}

/// A pixel's gradients times its result, and its gradients.
struct Upstream {
    total: f64,
    rgb: [f64; 3],
    z: f64,
}

fn backward(
    splats: &Splats<'_>,
    depth: Option<&[f32]>,
    size: [u32; 2],
    tile: u32,
    tiles_x: u32,
    upstream: impl Fn(usize) -> Upstream,
) -> Vec<PairGradient> {
    let mut pairs = vec![PairGradient::default(); splats.pair_slot.len()];
    for y in 0..size[1] {
        for x in 0..size[0] {
            let up = upstream((y * size[0] + x) as usize);
            let mut remaining = up.total;
            splats.walk([x, y], tile, tiles_x, |at, slot, s, before, w| {
                let pair = &mut pairs[splats.sorted[at] as usize];
                let mut v: f64 = (0..3).map(|c| f64::from(splats.color[slot][c]) * up.rgb[c]).sum();
                v += depth.map_or(0.0, |d| f64::from(d[slot]) * up.z);
                pair.depth += w * up.z;
                for c in 0..3 {
                    pair.color[c] += w * up.rgb[c];
                }
                remaining -= w * v;
                let alpha = if s.raw <= ALPHA_MAX { before * v - remaining / (1.0 - s.alpha) } else { 0.0 };
                pair.opacity += alpha * s.exponential;
                let power = alpha * s.raw;
                let [inverse_narrow, slope, inverse_variance] = splats.conic[slot].map(f64::from);
                let g_across = power * inverse_narrow * s.across;
                pair.mean[0] += g_across;
                pair.mean[1] += power * inverse_variance * s.dy - slope * g_across;
                pair.conic[0] -= 0.5 * power * s.across * s.across;
                pair.conic[1] += g_across * s.dy;
                pair.conic[2] -= 0.5 * power * s.dy * s.dy;
            });
        }
    }
    pairs
}

impl Reference for rasterize_backward::Kernel {
    fn reference(
        mut host: rasterize_backward::Host<'_>,
        push: rasterize_backward::Push,
        constants: rasterize_backward::Constants,
    ) {
        let rasterize_backward::Constants { alpha_min, transmittance_min, .. } = constants;
        let rasterize_backward::Host { ranges, mean, conic, opacity, color, .. } = host;
        let tile = match host.kernel {
            rasterize_backward::Kernel::Gpu => Tiling::Wide.side(),
            rasterize_backward::Kernel::Cpu => Tiling::Narrow.side(),
        };
        let tiles = (push.tiles_x * push.size[1].div_ceil(tile)) as usize;
        let (lists, sorted, pair_slot) = match (host.sorted, host.pair_slot, host.blended, host.blended_count) {
            // The last range is of the pairs that touch no tile: their gradients are 0.
            (Some(sorted), Some(pair_slot), ..) => {
                (ranges[..ranges.len().min(tiles + 1)].to_vec(), sorted.to_vec(), pair_slot.to_vec())
            }
            (.., Some(blended), Some(count)) => {
                let lists: Vec<[u32; 2]> = (0..tiles).map(|t| [ranges[t][0], ranges[t][0] + count[t]]).collect();
                let (mut sorted, mut pair_slot) = (vec![0; blended.len()], vec![0; host.pair_mean.len()]);
                for i in lists.iter().flat_map(|list| list[0] as usize..list[1] as usize) {
                    let [pair, slot] = blended[i];
                    sorted[i] = pair;
                    pair_slot[pair as usize] = slot;
                }
                (lists, sorted, pair_slot)
            }
            _ => unreachable!("every variant has lists of pairs"),
        };
        let splats = Splats {
            ranges: &lists,
            sorted: &sorted,
            pair_slot: &pair_slot,
            mean,
            conic,
            opacity,
            color,
            alpha_min,
            transmittance_min,
        };
        let product = |value: Option<&[f32]>, grad: Option<&[f32]>, p: usize| {
            value.zip(grad).map_or(0.0, |(value, grad)| f64::from(value[p]) * f64::from(grad[p]))
        };
        let gradients = backward(&splats, host.depth, push.size, tile, push.tiles_x, |p| {
            let rgb = host.grad_rgb[p].map(f64::from);
            let mut total: f64 = (0..3).map(|c| f64::from(host.rgb[p][c]) * rgb[c]).sum();
            total += product(host.depth_map, host.grad_depth_map, p);
            total += product(host.transmittance, host.grad_transmittance, p);
            Upstream { total, rgb, z: host.grad_depth_map.map_or(0.0, |grad| grad[p].into()) }
        });
        for &pair in lists.iter().flat_map(|list| &sorted[list[0] as usize..list[1] as usize]) {
            let (p, g) = (pair as usize, &gradients[pair as usize]);
            host.pair_mean[p] = g.mean.map(|v| v as f32);
            host.pair_conic[p] = g.conic.map(|v| v as f32);
            host.pair_opacity[p] = g.opacity as f32;
            host.pair_color[p] = g.color.map(|v| v as f32);
            if let Some(pair_depth) = &mut host.pair_depth {
                pair_depth[p] = g.depth as f32;
            }
            if let Some(marks) = &mut host.marks {
                marks[p / 32] |= 1 << (p % 32);
            }
        }
    }
    /// Sums over up to 256 pixels with cancellation in `S - A`, of relative size 1e-7 times the sum's largest term times
    /// 1/(1 - alpha) <= 100; a flipped sample moves all ten values of a pair and of those behind it.
    fn check(_: &'static str) -> Check {
        Check { relative: 2e-4, absolute: 2e-5, band: 5e-3 }
    }
}

/// Gradients with respect to the picture.
#[derive(Clone, Copy)]
pub struct PictureGradient<'a> {
    /// `[pixel]`
    pub rgb: &'a Buffer<[f32; 3]>,
    /// `[pixel]`, of the depth map.
    pub depth: Option<&'a Buffer<f32>>,
    /// `[pixel]`, of the transmittance; only together with `depth`, of a picture that has both.
    pub transmittance: Option<&'a Buffer<f32>>,
}

/// Gradients with respect to the Gaussians in screen space, and the per-pair scratch they are summed from.
pub struct Backward {
    pair_mean: Buffer<[f32; 2]>,
    pair_conic: Buffer<[f32; 3]>,
    pair_opacity: Buffer<f32>,
    pair_color: Buffer<[f32; 3]>,
    pair_depth: Option<Buffer<f32>>,
    /// `[pair / 32]` which pairs have a gradient; on wide tiles all.
    marks: Option<Buffer<u32>>,
    /// `[slot]` 1/px; as the others of Gaussians that touch a tile alone.
    pub grad_mean: Buffer<[f32; 2]>,
    /// `[slot]` of xx, the one off-diagonal parameter, yy.
    pub grad_covariance: Buffer<[f32; 3]>,
    /// `[slot]`
    pub grad_opacity: Buffer<f32>,
    /// `[slot]`
    pub grad_color: Buffer<[f32; 3]>,
    /// `[slot]`, when a loss looks at depth.
    pub grad_depth: Option<Buffer<f32>>,
}

/// Subgroups of a wide tile's workgroup: its shared memory has room for the sums of each.
pub(super) fn subgroups(gpu: &Gpu) -> u32 {
    (Tiling::Wide.threads_backward() / gpu.info().narrow_subgroup_size).max(1)
}

impl Backward {
    /// Buffers for so many slots and pairs.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(
        gpu: &Gpu,
        method: impl Into<Method>,
        slots: usize,
        pairs: usize,
        outputs: Outputs,
    ) -> Result<Self, Error> {
        let (depth, marked) = (outputs != Outputs::Color, method.into().tiling == Tiling::Narrow);
        Ok(Self {
            pair_mean: gpu.buffer("pair_mean", pairs)?,
            pair_conic: gpu.buffer("pair_conic", pairs)?,
            pair_opacity: gpu.buffer("pair_opacity", pairs)?,
            pair_color: gpu.buffer("pair_color", pairs)?,
            pair_depth: depth.then(|| gpu.buffer("pair_depth", pairs)).transpose()?,
            marks: marked.then(|| gpu.buffer("marks", pairs.div_ceil(32))).transpose()?,
            grad_mean: gpu.buffer("grad_mean", slots)?,
            grad_covariance: gpu.buffer("grad_covariance", slots)?,
            grad_opacity: gpu.buffer("grad_opacity", slots)?,
            grad_color: gpu.buffer("grad_color", slots)?,
            grad_depth: depth.then(|| gpu.buffer("grad_depth", slots)).transpose()?,
        })
    }

    /// Walks back from the picture to the Gaussians in screen space. `method` is that of [`Backward::new`], of the lists
    /// and of the picture.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        method: impl Into<Method>,
        gaussians: Projected<'_>,
        binned: Binned<'_>,
        picture: &Picture,
        gradient: PictureGradient<'_>,
    ) {
        let Projected { mean, depth, opacity, color, .. } = gaussians;
        let Binned { ranges, sorted, pair_slot, conic, tiles, drawn, pair_count, first_pair, blended, cuts, .. } =
            binned;
        let Slots { list: drawn, count: drawn_count, groups: drawn_groups } = drawn;
        let Self { pair_mean, pair_conic, pair_opacity, pair_color, .. } = self;
        let Method { tiling, alpha_min, transmittance_min, .. } = method.into();
        let size = picture.size;
        let grid = tiling.grid(size);
        let parts = grid[0] * grid[1] + cuts.map_or(0, |cuts| cuts.tile.len() as u32 - 1);
        // Depth has gradients where the picture has it, the scratch is there for them, and a loss looks at it.
        let maps = picture.depth.as_ref().zip(gradient.depth).filter(|_| self.grad_depth.is_some());
        let left = maps.and(picture.transmittance.as_ref().zip(gradient.transmittance));
        let pair_depth = maps.and(self.pair_depth.as_ref());
        let marks = blended.and(self.marks.as_ref());
        if let Some(marks) = marks {
            rec.zero(marks);
        }
        let buffers = rasterize_backward::Buffers {
            ranges,
            sorted: blended.is_none().then_some(sorted),
            pair_slot: blended.is_none().then_some(pair_slot),
            mean,
            conic,
            opacity,
            color,
            depth: maps.map(|_| depth),
            rgb: &picture.rgb,
            depth_map: maps.map(|(map, _)| map),
            transmittance: left.map(|(map, _)| map),
            grad_rgb: gradient.rgb,
            grad_depth_map: maps.map(|(_, grad)| grad),
            grad_transmittance: left.map(|(_, grad)| grad),
            pair_mean,
            pair_conic,
            pair_opacity,
            pair_color,
            pair_depth,
            cut_tile: cuts.map(|cuts| cuts.tile),
            cut_state: cuts.map(|cuts| cuts.state),
            blended: blended.map(|lists| lists.pairs),
            blended_count: blended.map(|lists| lists.count),
            marks,
        };
        let constants = rasterize_backward::Constants { alpha_min, transmittance_min, subgroups: subgroups(rec.gpu()) };
        let push = rasterize_backward::Push { size, tiles_x: grid[0] };
        let kernel = rasterize_backward::Kernel::from(tiling.form());
        // Narrow tiles are a workgroup each in their places, wide ones and the cuts of their lists one behind the other.
        let threads = tiling.threads_backward();
        match cuts {
            Some(_) => rec.run_with(kernel, constants, buffers, push, (parts * threads) as usize),
            None => rec.run_with(kernel, constants, buffers, push, [grid[0] * threads, grid[1], 1]),
        }
        let buffers = rasterize_gather::Buffers {
            drawn_count,
            drawn,
            tiles,
            pair_count,
            first_pair,
            conic,
            pair_mean,
            pair_conic,
            pair_opacity,
            pair_color,
            pair_depth,
            marks,
            grad_mean: &self.grad_mean,
            grad_covariance: &self.grad_covariance,
            grad_opacity: &self.grad_opacity,
            grad_color: &self.grad_color,
            grad_depth: maps.and(self.grad_depth.as_ref()),
        };
        rec.run(rasterize_gather::Kernel, buffers, (), drawn_groups);
    }
}

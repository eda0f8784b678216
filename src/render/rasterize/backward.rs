//! Back to front: gradients of pairs.

use super::*;
use crate::gpu::kernels::render::{
    cpu, rasterize_backward, rasterize_backward_color, rasterize_backward_depth, rasterize_gather,
    rasterize_gather_color, rasterize_gather_marked, rasterize_gather_marked_color,
};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::render::bin::{Binned, Blended, Tiling};
use crate::render::method::Method;
use crate::render::slots::Slots;

/// Gradients of a pair: sums over up to 256 pixels with cancellation in `S - A`, of relative size 1e-7 times the sum's
/// largest term times 1/(1 - alpha) <= 100; a flipped sample moves all ten values of a pair and of those behind it.
const PAIR: Check = Check { relative: 2e-4, absolute: 2e-5, band: 5e-3 };

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
            splats.walk([x, y], tile, tiles_x, |pair, slot, s, before, w| {
                let pair = &mut pairs[pair];
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

/// A pixel's gradients, and their product with what was rendered there.
macro_rules! upstream {
    ($host:ident, $p:ident $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {{
        let rgb = $host.grad_rgb[$p].map(f64::from);
        let mut _total: f64 = (0..3).map(|c| f64::from($host.rgb[$p][c]) * rgb[c]).sum();
        let mut _z = 0.0;
        $(
            let _ = &$host.$depth;
            _z = f64::from($host.grad_depth_map[$p]);
            _total += f64::from($host.depth_map[$p]) * _z;
        )?
        $(_total += f64::from($host.$transmittance[$p]) * f64::from($host.grad_transmittance[$p]);)?
        Upstream { total: _total, rgb, z: _z }
    }};
}

/// A pair's gradients to where the kernel writes them.
macro_rules! write_pair {
    ($host:ident, $gradients:ident, $pair:expr $(, depth: $depth:ident)?) => {{
        let (p, g) = ($pair, &$gradients[$pair]);
        $host.pair_mean[p] = g.mean.map(|v| v as f32);
        $host.pair_conic[p] = g.conic.map(|v| v as f32);
        $host.pair_opacity[p] = g.opacity as f32;
        $host.pair_color[p] = g.color.map(|v| v as f32);
        $(
            let _ = &$host.$depth;
            $host.pair_depth[p] = g.depth as f32;
        )?
    }};
}

macro_rules! backward_twin {
    ($module:path, $tile:expr $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        const _: () = {
            use $module as kernel;

            impl Reference for kernel::Kernel {
                fn reference(host: kernel::Host<'_>, push: kernel::Push, constants: kernel::Constants) {
                    let kernel::Constants { alpha_min, transmittance_min, .. } = constants;
                    let kernel::Host { ranges, sorted, pair_slot, mean, conic, opacity, color, .. } = host;
                    let splats = Splats { ranges, sorted, pair_slot, mean, conic, opacity, color, alpha_min, transmittance_min };
                    let mut _depth: Option<&[f32]> = None;
                    $(_depth = Some(host.$depth);)?
                    let gradients = backward(&splats, _depth, push.size, $tile, push.tiles_x, |p| {
                        upstream!(host, p $(, depth: $depth)? $(, transmittance: $transmittance)?)
                    });
                    // The last range is of the pairs that touch no tile: their gradients are 0.
                    for range in ranges.iter().take((push.tiles_x * push.size[1].div_ceil($tile)) as usize + 1) {
                        for &pair in &sorted[range[0] as usize..range[1] as usize] {
                            write_pair!(host, gradients, pair as usize $(, depth: $depth)?);
                        }
                    }
                }
                fn check(_: &'static str) -> Check {
                    PAIR
                }
            }
        };
    };
}

backward_twin!(rasterize_backward, 16, depth: depth, transmittance: transmittance);

backward_twin!(rasterize_backward_depth, 16, depth: depth);

backward_twin!(rasterize_backward_color, 16);

macro_rules! narrow_backward_twin {
    ($module:path $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        const _: () = {
            use $module as kernel;

            impl Reference for kernel::Kernel {
                fn reference(host: kernel::Host<'_>, push: kernel::Push, constants: kernel::Constants) {
                    let kernel::Constants { alpha_min, transmittance_min } = constants;
                    let kernel::Host { ranges, blended, blended_count, mean, conic, opacity, color, .. } = host;
                    let tiles = (push.tiles_x * push.size[1].div_ceil(8)) as usize;
                    let lists: Vec<[u32; 2]> =
                        (0..tiles).map(|t| [ranges[t][0], ranges[t][0] + blended_count[t]]).collect();
                    let (mut sorted, mut pair_slot) = (vec![0; blended.len()], vec![0; host.pair_mean.len()]);
                    for i in lists.iter().flat_map(|list| list[0] as usize..list[1] as usize) {
                        let [pair, slot] = blended[i];
                        sorted[i] = pair;
                        pair_slot[pair as usize] = slot;
                    }
                    let (ranges, sorted, pair_slot) = (&lists[..], &sorted[..], &pair_slot[..]);
                    let splats = Splats { ranges, sorted, pair_slot, mean, conic, opacity, color, alpha_min, transmittance_min };
                    let mut _depth: Option<&[f32]> = None;
                    $(_depth = Some(host.$depth);)?
                    let gradients = backward(&splats, _depth, push.size, 8, push.tiles_x, |p| {
                        upstream!(host, p $(, depth: $depth)? $(, transmittance: $transmittance)?)
                    });
                    for pair in lists.iter().flat_map(|list| &sorted[list[0] as usize..list[1] as usize]) {
                        let p = *pair as usize;
                        write_pair!(host, gradients, p $(, depth: $depth)?);
                        host.marks[p / 32] |= 1 << (p % 32);
                    }
                }
                fn check(_: &'static str) -> Check {
                    PAIR
                }
            }
        };
    };
}

narrow_backward_twin!(cpu::rasterize_backward, depth: depth, transmittance: transmittance);

narrow_backward_twin!(cpu::rasterize_backward_depth, depth: depth);

narrow_backward_twin!(cpu::rasterize_backward_color);

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
    (Tiling::Wide.threads() / gpu.info().subgroup_size).max(1)
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
        let Binned { ranges, sorted, pair_slot, conic, tiles, drawn, pair_count, first_pair, .. } = binned;
        let Slots { list: drawn, count: drawn_count, groups: drawn_groups } = drawn;
        let Self {
            pair_mean,
            pair_conic,
            pair_opacity,
            pair_color,
            grad_mean,
            grad_covariance,
            grad_opacity,
            grad_color,
            ..
        } = self;
        let Method { tiling, alpha_min, transmittance_min, .. } = method.into();
        let size = picture.size;
        let grid = tiling.grid(size);
        let threads = [grid[0] * tiling.threads(), grid[1], 1];
        let subgroups = subgroups(rec.gpu());
        let (rgb, grad_rgb) = (&picture.rgb, gradient.rgb);
        macro_rules! back {
            ($module:path $([$constant:ident])? $(, $field:ident)*) => {{
                use $module as kernel;
                let buffers = kernel::Buffers {
                    ranges, mean, conic, opacity, color, rgb, grad_rgb, pair_mean, pair_conic, pair_opacity, pair_color
                    $(, $field)*
                };
                let constants = kernel::Constants { alpha_min, transmittance_min $(, $constant)? };
                rec.run_with(kernel::Kernel, constants, buffers, kernel::Push { size, tiles_x: grid[0] }, threads);
            }};
        }
        macro_rules! gather {
            ($module:path $(, $field:ident)*) => {{
                use $module as kernel;
                let buffers = kernel::Buffers {
                    drawn_count, drawn, tiles, pair_count, first_pair, conic, pair_mean, pair_conic, pair_opacity,
                    pair_color, grad_mean, grad_covariance, grad_opacity, grad_color $(, $field)*
                };
                rec.run(kernel::Kernel, buffers, (), drawn_groups);
            }};
        }
        let narrow = binned.blended.zip(self.marks.as_ref());
        if let Some((_, marks)) = narrow {
            rec.zero(marks);
        }
        match (&picture.depth, &self.pair_depth, &self.grad_depth, gradient.depth) {
            (Some(depth_map), Some(pair_depth), Some(grad_depth), Some(grad_depth_map)) => {
                match (picture.transmittance.as_ref().zip(gradient.transmittance), narrow) {
                    (Some((transmittance, grad_transmittance)), None) => {
                        back!(
                            rasterize_backward[subgroups],
                            sorted,
                            pair_slot,
                            depth,
                            depth_map,
                            grad_depth_map,
                            pair_depth,
                            transmittance,
                            grad_transmittance
                        );
                    }
                    (Some((transmittance, grad_transmittance)), Some((lists, marks))) => {
                        let Blended { pairs: blended, count: blended_count } = lists;
                        back!(
                            cpu::rasterize_backward,
                            blended,
                            blended_count,
                            marks,
                            depth,
                            depth_map,
                            grad_depth_map,
                            pair_depth,
                            transmittance,
                            grad_transmittance
                        );
                    }
                    (None, None) => {
                        back!(
                            rasterize_backward_depth[subgroups],
                            sorted,
                            pair_slot,
                            depth,
                            depth_map,
                            grad_depth_map,
                            pair_depth
                        );
                    }
                    (None, Some((Blended { pairs: blended, count: blended_count }, marks))) => {
                        back!(
                            cpu::rasterize_backward_depth,
                            blended,
                            blended_count,
                            marks,
                            depth,
                            depth_map,
                            grad_depth_map,
                            pair_depth
                        );
                    }
                }
                match narrow {
                    Some((_, marks)) => gather!(rasterize_gather_marked, pair_depth, grad_depth, marks),
                    None => gather!(rasterize_gather, pair_depth, grad_depth),
                }
            }
            _ => match narrow {
                Some((Blended { pairs: blended, count: blended_count }, marks)) => {
                    back!(cpu::rasterize_backward_color, blended, blended_count, marks);
                    gather!(rasterize_gather_marked_color, marks);
                }
                None => {
                    back!(rasterize_backward_color[subgroups], sorted, pair_slot);
                    gather!(rasterize_gather_color);
                }
            },
        }
    }
}

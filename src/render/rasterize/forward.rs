//! Front to back: the picture.

use super::*;
use crate::gpu::kernels::render::rasterize;
use crate::gpu::{Check, Recorder, Reference};
use crate::render::bin::{Binned, CUT};
use crate::render::method::Method;
use crate::render::project::Projected;
use crate::render::tiling::Tiling;

/// Pictures compared with the twin's: a sample within float32 rounding of a threshold may flip, which changes a pixel
/// by up to the alpha threshold times a colour. The exponential is good to a few units in the last place, so about one sample in 1e5 is
/// that close; the band is one component in a thousand. Otherwise a sum of some hundred terms below one: 1e-5.
const PICTURE: Check = Check { relative: 1e-5, absolute: 1e-5, band: 1e-3 };

impl Reference for rasterize::Kernel {
    fn reference(host: rasterize::Host<'_>, push: rasterize::Push, constants: rasterize::Constants) {
        let rasterize::Constants { alpha_min, transmittance_min } = constants;
        let rasterize::Host { ranges, sorted, pair_slot, mean, conic, opacity, color, rgb, .. } = host;
        let rasterize::Host { depth, mut depth_map, mut transmittance, .. } = host;
        let splats = Splats { ranges, sorted, pair_slot, mean, conic, opacity, color, alpha_min, transmittance_min };
        let tile = match host.kernel {
            rasterize::Kernel::Gpu => Tiling::Wide.side(),
            rasterize::Kernel::Cpu => Tiling::Narrow.side(),
        };
        let [width, height] = push.size;
        let mut seen = vec![false; pair_slot.len()];
        let mut cut_state = host.cut_state;
        for y in 0..height {
            for x in 0..width {
                let p = (y * width + x) as usize;
                let (mut sum, mut z) = ([0f64; 3], 0f64);
                let [first, end] = ranges[(y / tile * push.tiles_x + x / tile) as usize];
                let mut put = |cut: u32, values: [f32; 5]| {
                    let Some(state) = &mut cut_state else { return };
                    let pixel = (y % tile * tile + x % tile) as usize;
                    for (plane, value) in values.into_iter().enumerate().take(4 + usize::from(depth.is_some())) {
                        state[(cut as usize * 5 + plane) * 256 + pixel] = value;
                    }
                };
                let state = |sum: [f64; 3], left: f64, z: f64| {
                    let [r, g, b] = sum.map(|v| v as f32);
                    [r, g, b, left as f32, z as f32]
                };
                let (mut cut, last) = (first / CUT + 1, end.div_ceil(CUT));
                let (left, ended) = splats.walk([x, y], tile, push.tiles_x, |at, slot, _, before, w| {
                    for cut in cut..last.min(at as u32 / CUT + 1) {
                        put(cut, state(sum, before, z));
                    }
                    cut = cut.max(at as u32 / CUT + 1);
                    seen[sorted[at] as usize] |= w >= f64::from(f32::MIN_POSITIVE);
                    for c in 0..3 {
                        sum[c] += w * f64::from(color[slot][c]);
                    }
                    z += depth.map_or(0.0, |depth| w * f64::from(depth[slot]));
                });
                for cut in cut..last {
                    let finished = (cut * CUT) as usize > ended;
                    put(cut, if finished { [0.0, 0.0, 0.0, -1.0, 0.0] } else { state(sum, left, z) });
                }
                rgb[p] = std::array::from_fn(|c| (sum[c] + left * f64::from(push.background[c])) as f32);
                if let Some(map) = &mut depth_map {
                    map[p] = z as f32;
                }
                if let Some(map) = &mut transmittance {
                    map[p] = left as f32;
                }
            }
        }
        // Pixels of a tile beside the picture are finished.
        if let Some(state) = &mut cut_state {
            let [columns, rows] = [width, height].map(|n| n.div_ceil(tile));
            for at in 0..columns * rows {
                let [first, end] = ranges[at as usize];
                let outside = |pixel: u32| {
                    at % columns * tile + pixel % tile >= width || at / columns * tile + pixel / tile >= height
                };
                for (cut, pixel) in (first / CUT + 1..end.div_ceil(CUT)).flat_map(|cut| (0..256).map(move |p| (cut, p)))
                {
                    for plane in (0..4 + usize::from(depth.is_some())).filter(|_| outside(pixel)) {
                        state[(cut as usize * 5 + plane) * 256 + pixel as usize] = if plane == 3 { -1.0 } else { 0.0 };
                    }
                }
            }
        }
        let (Some(blended), Some(blended_count)) = (host.blended, host.blended_count) else { return };
        for at in 0..(push.tiles_x * height.div_ceil(tile)) as usize {
            let [first, end] = ranges[at].map(|i| i as usize);
            let listed = sorted[first..end].iter().filter(|pair| seen[**pair as usize]);
            let mut count = 0;
            for (place, &pair) in std::iter::zip(&mut blended[first..end], listed) {
                *place = [pair, pair_slot[pair as usize]];
                count += 1;
            }
            blended_count[at] = count;
        }
    }
    /// Narrow tiles' lists hold a pair if at least one sample is blended: one that flips where there is no other moves the
    /// rest of its tile's list by a place (`lists_hold_what_is_blended` looks at what they hold).
    fn check(binding: &'static str) -> Check {
        Check { band: if binding == "blended" { 1.0 } else { PICTURE.band }, ..PICTURE }
    }
}

/// Draws the binned Gaussians.
pub fn forward(
    rec: &mut Recorder<'_>,
    method: impl Into<Method>,
    gaussians: Projected<'_>,
    binned: Binned<'_>,
    background: [f32; 3],
    picture: &Picture,
) {
    let Projected { mean, depth, opacity, color, .. } = gaussians;
    let Binned { ranges, sorted, pair_slot, conic, .. } = binned;
    let Method { tiling, alpha_min, transmittance_min, .. } = method.into();
    let size = picture.size;
    let grid = tiling.grid(size);
    let threads = [grid[0] * tiling.threads(), grid[1], 1];
    let buffers = rasterize::Buffers {
        ranges,
        sorted,
        pair_slot,
        mean,
        conic,
        opacity,
        color,
        depth: picture.depth.as_ref().map(|_| depth),
        rgb: &picture.rgb,
        depth_map: picture.depth.as_ref(),
        transmittance: picture.depth.as_ref().and(picture.transmittance.as_ref()),
        cut_state: binned.cuts.map(|cuts| cuts.state),
        blended: binned.blended.map(|lists| lists.pairs),
        blended_count: binned.blended.map(|lists| lists.count),
    };
    let constants = rasterize::Constants { alpha_min, transmittance_min };
    let push = rasterize::Push { size, tiles_x: grid[0], background };
    rec.run_with(rasterize::Kernel::from(tiling.form()), constants, buffers, push, threads);
}

//! Front to back: the picture.

use super::*;
use crate::gpu::kernels::render::{cpu, rasterize, rasterize_color, rasterize_depth};
use crate::gpu::{Check, Recorder, Reference};
use crate::render::bin::{Binned, Blended};
use crate::render::method::Method;

/// Pictures compared with the twin's: a sample within float32 rounding of a threshold may flip, which changes a pixel
/// by up to the alpha threshold times a colour. The exponential is good to a few units in the last place, so about one sample in 1e5 is
/// that close; the band is one component in a thousand. Otherwise a sum of some hundred terms below one: 1e-5.
const PICTURE: Check = Check { relative: 1e-5, absolute: 1e-5, band: 1e-3 };

macro_rules! forward_twin {
    ($module:path, $tile:expr, $check:expr
        $(, blended: $blended:ident)? $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        const _: () = {
            use $module as kernel;

            impl Reference for kernel::Kernel {
                fn reference(host: kernel::Host<'_>, push: kernel::Push, constants: kernel::Constants) {
                    let kernel::Constants { alpha_min, transmittance_min } = constants;
                    let kernel::Host { ranges, sorted, pair_slot, mean, conic, opacity, color, rgb, .. } = host;
                    let splats = Splats { ranges, sorted, pair_slot, mean, conic, opacity, color, alpha_min, transmittance_min };
                    let [width, height] = push.size;
                    let mut _seen = vec![false; pair_slot.len()];
                    for y in 0..height {
                        for x in 0..width {
                            let p = (y * width + x) as usize;
                            let mut sum = [0f64; 3];
                            let mut _z = 0f64;
                            let left = splats.walk([x, y], $tile, push.tiles_x, |pair, slot, _, _, w| {
                                _seen[pair] |= w >= f64::from(f32::MIN_POSITIVE);
                                for c in 0..3 {
                                    sum[c] += w * f64::from(color[slot][c]);
                                }
                                $(_z += w * f64::from(host.$depth[slot]);)?
                            });
                            rgb[p] = std::array::from_fn(|c| (sum[c] + left * f64::from(push.background[c])) as f32);
                            $(
                                let _ = &host.$depth;
                                host.depth_map[p] = _z as f32;
                            )?
                            $(host.$transmittance[p] = left as f32;)?
                        }
                    }
                    $(
                        for tile in 0..(push.tiles_x * height.div_ceil($tile)) as usize {
                            let [first, end] = ranges[tile].map(|i| i as usize);
                            let listed = sorted[first..end].iter().filter(|pair| _seen[**pair as usize]);
                            let mut count = 0;
                            for (place, &pair) in std::iter::zip(&mut host.$blended[first..end], listed) {
                                *place = [pair, pair_slot[pair as usize]];
                                count += 1;
                            }
                            host.blended_count[tile] = count;
                        }
                    )?
                }
                fn check(binding: &'static str) -> Check {
                    $check(binding)
                }
            }
        };
    };
}

/// Of narrow tiles' lists, which hold a pair if at least one sample is blended: one that flips where there is no other
/// moves the rest of its tile's list by a place (`lists_hold_what_is_blended` looks at what they hold).
fn narrow_picture(binding: &'static str) -> Check {
    Check { band: if binding == "blended" { 1.0 } else { PICTURE.band }, ..PICTURE }
}

forward_twin!(rasterize, 16, |_| PICTURE, depth: depth, transmittance: transmittance);

forward_twin!(cpu::rasterize, 8, narrow_picture, blended: blended, depth: depth, transmittance: transmittance);

forward_twin!(rasterize_depth, 16, |_| PICTURE, depth: depth);

forward_twin!(cpu::rasterize_depth, 8, narrow_picture, blended: blended, depth: depth);

forward_twin!(rasterize_color, 16, |_| PICTURE);

forward_twin!(cpu::rasterize_color, 8, narrow_picture, blended: blended);

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
    let rgb = &picture.rgb;
    macro_rules! draw {
        ($module:path $(, $field:ident)*) => {{
            use $module as kernel;
            let buffers = kernel::Buffers { ranges, sorted, pair_slot, mean, conic, opacity, color, rgb $(, $field)* };
            let constants = kernel::Constants { alpha_min, transmittance_min };
            rec.run_with(kernel::Kernel, constants, buffers, kernel::Push { size, tiles_x: grid[0], background }, threads);
        }};
    }
    if let Some(Blended { pairs: blended, count: blended_count }) = binned.blended {
        match (&picture.depth, &picture.transmittance) {
            (Some(depth_map), Some(transmittance)) => {
                draw!(cpu::rasterize, blended, blended_count, depth, depth_map, transmittance);
            }
            (Some(depth_map), None) => draw!(cpu::rasterize_depth, blended, blended_count, depth, depth_map),
            (None, _) => draw!(cpu::rasterize_color, blended, blended_count),
        }
    } else {
        match (&picture.depth, &picture.transmittance) {
            (Some(depth_map), Some(transmittance)) => draw!(rasterize, depth, depth_map, transmittance),
            (Some(depth_map), None) => draw!(rasterize_depth, depth, depth_map),
            (None, _) => draw!(rasterize_color),
        }
    }
}

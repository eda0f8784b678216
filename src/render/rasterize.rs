//! Rasterisation: tiles of Gaussians blended front to back, and back again.
//!
//! alpha = min(0.99, opacity exp(-1/2 d^T C^-1 d)), with `d^T C^-1 d = (dx - k dy)^2 / N + dy^2 / V` from the factored
//! covariance; a sample with alpha below a threshold (1/255) is skipped; a pixel is finished before the Gaussian that
//! would bring its transmittance below another (1e-4; 3D Gaussian Splatting, section 4). Depth is the sum of z alpha T, not
//! divided by coverage. The support of a Gaussian is exactly where alpha reaches the threshold, so the picture does not
//! depend on the tiles.
//!
//! Narrow tiles (CPU drivers) list the pairs of which a pixel took something: a third of all on photographs. Their backward
//! pass looks at no other, and the gather skips what has no mark.
//!
//! The exponential is the driver's: on lavapipe every polynomial tried, down to one of 7e-5 relative error in seven
//! operations, took longer and was less exact, and GPUs have an instruction for it.

use super::bin::{Binned, Blended, Tiling};
use super::method::Method;
use super::slots::Slots;
use crate::gpu::kernels::render::{
    rasterize, rasterize_backward, rasterize_backward_color, rasterize_backward_depth, rasterize_backward_narrow,
    rasterize_backward_narrow_color, rasterize_backward_narrow_depth, rasterize_color, rasterize_depth,
    rasterize_gather, rasterize_gather_color, rasterize_gather_marked, rasterize_gather_marked_color, rasterize_narrow,
    rasterize_narrow_color, rasterize_narrow_depth,
};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::primitives::Count;

/// Largest alpha of a sample.
pub const ALPHA_MAX: f64 = 0.99;
/// Samples below this alpha are skipped, unless the settings say otherwise.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;
/// A pixel is finished before its transmittance falls below this, unless the settings say otherwise.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;

/// One sample of a Gaussian at a pixel: what forward and backward twins share. The decisions are float32 operations.
struct Sample {
    /// dx - k dy.
    across: f64,
    dy: f64,
    exponential: f64,
    raw: f64,
    alpha: f64,
    visible: bool,
}

fn sample(pixel: [f32; 2], mean: [f32; 2], conic: [f32; 3], opacity: f32, alpha_min: f32) -> Sample {
    let (dx, dy) = (pixel[0] - mean[0], pixel[1] - mean[1]);
    let across = dx - conic[1] * dy;
    let power = -0.5 * (conic[0] * across * across + conic[2] * dy * dy);
    let visible = (opacity * power.exp()).min(0.99) >= alpha_min;
    let [inverse_narrow, slope, inverse_variance] = conic.map(f64::from);
    let (dx, dy) = (f64::from(pixel[0]) - f64::from(mean[0]), f64::from(pixel[1]) - f64::from(mean[1]));
    let across = dx - slope * dy;
    let exponential = (-0.5 * (inverse_narrow * across * across + inverse_variance * dy * dy)).exp();
    let raw = f64::from(opacity) * exponential;
    Sample { across, dy, exponential, raw, alpha: raw.min(ALPHA_MAX), visible }
}

/// The Gaussians in screen space and their lists, as a twin sees them.
struct Splats<'a> {
    ranges: &'a [[u32; 2]],
    sorted: &'a [u32],
    pair_slot: &'a [u32],
    mean: &'a [[f32; 2]],
    conic: &'a [[f32; 3]],
    opacity: &'a [f32],
    color: &'a [[f32; 3]],
    alpha_min: f32,
    transmittance_min: f32,
}

impl Splats<'_> {
    /// Calls `blend(pair, slot, sample, transmittance before, weight)` for everything blended at a pixel; returns the
    /// transmittance that is left.
    fn walk(
        &self,
        pixel: [u32; 2],
        tile: u32,
        tiles_x: u32,
        mut blend: impl FnMut(usize, usize, &Sample, f64, f64),
    ) -> f64 {
        let [first, end] = self.ranges[(pixel[1] / tile * tiles_x + pixel[0] / tile) as usize];
        let centre = pixel.map(|v| v as f32 + 0.5);
        let mut transmittance = 1.0;
        // The decision to stop is made on the float32 product, as in the kernel.
        let mut rounded = 1f32;
        for &pair in &self.sorted[first as usize..end as usize] {
            let slot = self.pair_slot[pair as usize] as usize;
            let s = sample(centre, self.mean[slot], self.conic[slot], self.opacity[slot], self.alpha_min);
            if !s.visible {
                continue;
            }
            let after = rounded * (1.0 - s.alpha as f32);
            if after < self.transmittance_min {
                break;
            }
            blend(pair as usize, slot, &s, transmittance, s.alpha * transmittance);
            transmittance *= 1.0 - s.alpha;
            rounded = after;
        }
        transmittance
    }
}

/// Pictures compared with the twin's: a sample within float32 rounding of a threshold may flip, which changes a pixel
/// by up to the alpha threshold times a colour. The exponential is good to a few units in the last place, so about one sample in 1e5 is
/// that close; the band is one component in a thousand. Otherwise a sum of some hundred terms below one: 1e-5.
const PICTURE: Check = Check { relative: 1e-5, absolute: 1e-5, band: 1e-3 };
/// Gradients of a pair: sums over up to 256 pixels with cancellation in `S - A`, of relative size 1e-7 times the sum's
/// largest term times 1/(1 - alpha) <= 100; a flipped sample moves all ten values of a pair and of those behind it.
const PAIR: Check = Check { relative: 2e-4, absolute: 2e-5, band: 5e-3 };

macro_rules! forward_twin {
    ($module:ident, $tile:expr, $check:expr
        $(, blended: $blended:ident)? $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, push: $module::Push, constants: $module::Constants) {
                let $module::Constants { alpha_min, transmittance_min } = constants;
                let $module::Host { ranges, sorted, pair_slot, mean, conic, opacity, color, rgb, .. } = host;
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
}

/// Of narrow tiles' lists, which hold a pair if at least one sample is blended: one that flips where there is no other
/// moves the rest of its tile's list by a place (`lists_hold_what_is_blended` looks at what they hold).
fn narrow_picture(binding: &'static str) -> Check {
    Check { band: if binding == "blended" { 1.0 } else { PICTURE.band }, ..PICTURE }
}

forward_twin!(rasterize, 16, |_| PICTURE, depth: depth, transmittance: transmittance);
forward_twin!(rasterize_narrow, 8, narrow_picture, blended: blended, depth: depth, transmittance: transmittance);
forward_twin!(rasterize_depth, 16, |_| PICTURE, depth: depth);
forward_twin!(rasterize_narrow_depth, 8, narrow_picture, blended: blended, depth: depth);
forward_twin!(rasterize_color, 16, |_| PICTURE);
forward_twin!(rasterize_narrow_color, 8, narrow_picture, blended: blended);

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

macro_rules! backward_twin {
    ($module:ident, $tile:expr $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, push: $module::Push, constants: $module::Constants) {
                let $module::Constants { alpha_min, transmittance_min, .. } = constants;
                let $module::Host { ranges, sorted, pair_slot, mean, conic, opacity, color, .. } = host;
                let splats = Splats { ranges, sorted, pair_slot, mean, conic, opacity, color, alpha_min, transmittance_min };
                let mut _depth: Option<&[f32]> = None;
                $(_depth = Some(host.$depth);)?
                let gradients = backward(&splats, _depth, push.size, $tile, push.tiles_x, |p| {
                    let rgb = host.grad_rgb[p].map(f64::from);
                    let mut total: f64 = (0..3).map(|c| f64::from(host.rgb[p][c]) * rgb[c]).sum();
                    let mut _z = 0.0;
                    $(
                        let _ = &host.$depth;
                        _z = f64::from(host.grad_depth_map[p]);
                        total += f64::from(host.depth_map[p]) * _z;
                    )?
                    $(total += f64::from(host.$transmittance[p]) * f64::from(host.grad_transmittance[p]);)?
                    let z = _z;
                    total += 0.0;
                    Upstream { total, rgb, z }
                });
                // The last range is of the pairs that touch no tile: their gradients are 0.
                for range in ranges.iter().take((push.tiles_x * push.size[1].div_ceil($tile)) as usize + 1) {
                    for &pair in &sorted[range[0] as usize..range[1] as usize] {
                        let (p, g) = (pair as usize, &gradients[pair as usize]);
                        host.pair_mean[p] = g.mean.map(|v| v as f32);
                        host.pair_conic[p] = g.conic.map(|v| v as f32);
                        host.pair_opacity[p] = g.opacity as f32;
                        host.pair_color[p] = g.color.map(|v| v as f32);
                        $(
                            let _ = &host.$depth;
                            host.pair_depth[p] = g.depth as f32;
                        )?
                    }
                }
            }
            fn check(_: &'static str) -> Check {
                PAIR
            }
        }
    };
}
backward_twin!(rasterize_backward, 16, depth: depth, transmittance: transmittance);
backward_twin!(rasterize_backward_depth, 16, depth: depth);
backward_twin!(rasterize_backward_color, 16);

macro_rules! narrow_backward_twin {
    ($module:ident $(, depth: $depth:ident)? $(, transmittance: $transmittance:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, push: $module::Push, constants: $module::Constants) {
                let $module::Constants { alpha_min, transmittance_min } = constants;
                let $module::Host { ranges, blended, blended_count, mean, conic, opacity, color, .. } = host;
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
                    let rgb = host.grad_rgb[p].map(f64::from);
                    let mut total: f64 = (0..3).map(|c| f64::from(host.rgb[p][c]) * rgb[c]).sum();
                    let mut _z = 0.0;
                    $(
                        let _ = &host.$depth;
                        _z = f64::from(host.grad_depth_map[p]);
                        total += f64::from(host.depth_map[p]) * _z;
                    )?
                    $(total += f64::from(host.$transmittance[p]) * f64::from(host.grad_transmittance[p]);)?
                    let z = _z;
                    total += 0.0;
                    Upstream { total, rgb, z }
                });
                for pair in lists.iter().flat_map(|list| &sorted[list[0] as usize..list[1] as usize]) {
                    let (p, g) = (*pair as usize, &gradients[*pair as usize]);
                    host.pair_mean[p] = g.mean.map(|v| v as f32);
                    host.pair_conic[p] = g.conic.map(|v| v as f32);
                    host.pair_opacity[p] = g.opacity as f32;
                    host.pair_color[p] = g.color.map(|v| v as f32);
                    $(
                        let _ = &host.$depth;
                        host.pair_depth[p] = g.depth as f32;
                    )?
                    host.marks[p / 32] |= 1 << (p % 32);
                }
            }
            fn check(_: &'static str) -> Check {
                PAIR
            }
        }
    };
}
narrow_backward_twin!(rasterize_backward_narrow, depth: depth, transmittance: transmittance);
narrow_backward_twin!(rasterize_backward_narrow_depth, depth: depth);
narrow_backward_twin!(rasterize_backward_narrow_color);

macro_rules! gather_twin {
    ($module:ident $(, depth: $depth:ident)? $(, marks: $marks:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), (): ()) {
                let drawn = host.drawn_count[0] as usize;
                let fits = host.pair_count[0] > 0;
                for s in host.drawn[..drawn].iter().map(|&slot| slot as usize) {
                    let first = host.first_pair[s] as usize;
                    let end = first + if fits { host.tiles[s] as usize } else { 0 };
                    let pairs: Vec<usize> = (first..end)
                        $(.filter(|p| host.$marks[p / 32] >> (p % 32) & 1 == 1))?
                        .collect();
                    let sum = |f: &dyn Fn(usize) -> f32| pairs.iter().map(|p| f64::from(f(*p))).sum::<f64>();
                    let g: [f64; 3] = std::array::from_fn(|c| sum(&|p| host.pair_conic[p][c]));
                    let [a, _, b] = host.conic[s].map(f64::from);
                    host.grad_mean[s] = std::array::from_fn(|c| sum(&|p| host.pair_mean[p][c]) as f32);
                    host.grad_covariance[s] = [(-a * a * g[0]) as f32, g[1] as f32, (-b * b * g[2]) as f32];
                    host.grad_opacity[s] = sum(&|p| host.pair_opacity[p]) as f32;
                    host.grad_color[s] = std::array::from_fn(|c| sum(&|p| host.pair_color[p][c]) as f32);
                    $(host.$depth[s] = sum(&|p| host.pair_depth[p]) as f32;)?
                }
            }
            /// A running sum over a Gaussian's tiles whose terms cancel, relative to the tensor's largest element.
            fn check(_: &'static str) -> Check {
                Check { relative: 1e-4, absolute: 1e-5, band: 0.0 }
            }
        }
    };
}
gather_twin!(rasterize_gather, depth: grad_depth);
gather_twin!(rasterize_gather_color);
gather_twin!(rasterize_gather_marked, depth: grad_depth, marks: marks);
gather_twin!(rasterize_gather_marked_color, marks: marks);

/// Gaussians in screen space, per slot.
#[derive(Clone, Copy)]
pub struct Projected<'a> {
    /// How many slots there are.
    pub slots: Count<'a>,
    /// Those whose Gaussian exists; the others hold nothing.
    pub existing: &'a Slots,
    /// `[slot]` px.
    pub mean: &'a Buffer<[f32; 2]>,
    /// `[slot]` factored: variance of x given y in px^2, slope of x on y, variance of y in px^2.
    pub covariance: &'a Buffer<[f32; 3]>,
    /// `[slot]` camera z, 0 where there is no Gaussian.
    pub depth: &'a Buffer<f32>,
    /// `[slot]`
    pub opacity: &'a Buffer<f32>,
    /// `[slot]` linear rgb.
    pub color: &'a Buffer<[f32; 3]>,
}

/// What a loss or a file needs of the picture.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outputs {
    /// Colour alone.
    Color,
    /// Colour and depth.
    Depth,
    /// Colour, depth and transmittance.
    Transmittance,
}

/// A picture's buffers.
pub struct Picture {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// `[pixel]` linear rgb.
    pub rgb: Buffer<[f32; 3]>,
    /// Sum of z alpha T, if asked for.
    pub depth: Option<Buffer<f32>>,
    /// What is left of the background, if asked for.
    pub transmittance: Option<Buffer<f32>>,
}

impl Picture {
    /// Buffers for pictures of up to `pixels` pixels.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, size: [u32; 2], pixels: usize, outputs: Outputs) -> Result<Self, Error> {
        let (depth, transmittance) = (outputs != Outputs::Color, outputs == Outputs::Transmittance);
        Ok(Self {
            size,
            rgb: gpu.buffer("rgb", pixels)?,
            depth: depth.then(|| gpu.buffer("depth_map", pixels)).transpose()?,
            transmittance: transmittance.then(|| gpu.buffer("transmittance", pixels)).transpose()?,
        })
    }
}

impl Picture {
    /// The same picture without its depth.
    pub fn color(&self) -> Self {
        Self { size: self.size, rgb: self.rgb.view(), depth: None, transmittance: None }
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
    let rgb = &picture.rgb;
    macro_rules! draw {
        ($module:ident $(, $field:ident)*) => {{
            let buffers = $module::Buffers { ranges, sorted, pair_slot, mean, conic, opacity, color, rgb $(, $field)* };
            let constants = $module::Constants { alpha_min, transmittance_min };
            rec.run_with($module::Kernel, constants, buffers, $module::Push { size, tiles_x: grid[0], background }, threads);
        }};
    }
    if let Some(Blended { pairs: blended, count: blended_count }) = binned.blended {
        match (&picture.depth, &picture.transmittance) {
            (Some(depth_map), Some(transmittance)) => {
                draw!(rasterize_narrow, blended, blended_count, depth, depth_map, transmittance);
            }
            (Some(depth_map), None) => draw!(rasterize_narrow_depth, blended, blended_count, depth, depth_map),
            (None, _) => draw!(rasterize_narrow_color, blended, blended_count),
        }
    } else {
        match (&picture.depth, &picture.transmittance) {
            (Some(depth_map), Some(transmittance)) => draw!(rasterize, depth, depth_map, transmittance),
            (Some(depth_map), None) => draw!(rasterize_depth, depth, depth_map),
            (None, _) => draw!(rasterize_color),
        }
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
fn subgroups(gpu: &Gpu) -> u32 {
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
            ($module:ident $([$constant:ident])? $(, $field:ident)*) => {{
                let buffers = $module::Buffers {
                    ranges, mean, conic, opacity, color, rgb, grad_rgb, pair_mean, pair_conic, pair_opacity, pair_color
                    $(, $field)*
                };
                let constants = $module::Constants { alpha_min, transmittance_min $(, $constant)? };
                rec.run_with($module::Kernel, constants, buffers, $module::Push { size, tiles_x: grid[0] }, threads);
            }};
        }
        macro_rules! gather {
            ($module:ident $(, $field:ident)*) => {{
                let buffers = $module::Buffers {
                    drawn_count, drawn, tiles, pair_count, first_pair, conic, pair_mean, pair_conic, pair_opacity,
                    pair_color, grad_mean, grad_covariance, grad_opacity, grad_color $(, $field)*
                };
                rec.run($module::Kernel, buffers, (), drawn_groups);
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
                            rasterize_backward_narrow,
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
                            rasterize_backward_narrow_depth,
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
                    back!(rasterize_backward_narrow_color, blended, blended_count, marks);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use crate::math::camera::factors;
    use crate::math::tiles::Support;
    use rand::{RngExt, SeedableRng};

    /// Random Gaussians in screen space, binned on the host.
    #[derive(Default)]
    struct Scene {
        covariance: Vec<[f32; 3]>,
        mean: Vec<[f32; 2]>,
        conic: Vec<[f32; 3]>,
        opacity: Vec<f32>,
        color: Vec<[f32; 3]>,
        depth: Vec<f32>,
        tiles: Vec<u32>,
        first_pair: Vec<u32>,
        pair_slot: Vec<u32>,
        sorted: Vec<u32>,
        ranges: Vec<[u32; 2]>,
    }

    fn scene(seed: u64, n: usize, size: [u32; 2], tiling: Tiling, alpha_min: f32) -> Scene {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let mut s = Scene::default();
        let grid = tiling.grid(size);
        for _ in 0..n {
            let (angle, a, b) = (rng.random_range(0f32..3.2), rng.random_range(0.3..9.0), rng.random_range(0.3..9.0));
            let (sin, cos) = angle.sin_cos();
            let (a, b) = (a * a, b * b);
            let entries =
                [cos * cos * a + sin * sin * b + 0.3, cos * sin * (a - b), sin * sin * a + cos * cos * b + 0.3];
            s.covariance.push(factors(entries.map(f64::from)).map(|v| v as f32));
            s.mean.push(std::array::from_fn(|i| rng.random_range(-4.0..size[i] as f32 + 4.0)));
            s.opacity.push(rng.random_range(0.05..0.999));
            s.color.push(std::array::from_fn(|_| rng.random_range(0.0..1.0)));
            s.depth.push(rng.random_range(1.0..9.0));
        }
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&a, &b| s.depth[a].total_cmp(&s.depth[b]));
        (s.tiles, s.first_pair) = (vec![0; n], vec![0; n]);
        s.conic = s.covariance.iter().map(|&[n, k, v]| [1.0 / n, k, 1.0 / v]).collect();
        let mut pairs = vec![];
        for slot in order {
            let alpha = (s.opacity[slot], alpha_min);
            let support = Support::new(s.mean[slot], s.covariance[slot], alpha, tiling.side(), grid);
            let mut found = support.tiles(s.mean[slot], tiling.side(), grid);
            // Some were counted once too often: that pair touches no tile.
            found.extend((slot % 7 == 3).then_some(grid[0] * grid[1]));
            s.first_pair[slot] = pairs.len() as u32;
            s.tiles[slot] = found.len() as u32;
            for tile in found {
                pairs.push((tile, pairs.len() as u32));
                s.pair_slot.push(slot as u32);
            }
        }
        pairs.sort_by_key(|p| p.0);
        s.ranges = vec![[0; 2]; (grid[0] * grid[1] + 1) as usize];
        for (i, &(tile, pair)) in pairs.iter().enumerate() {
            if s.ranges[tile as usize] == [0, 0] {
                s.ranges[tile as usize][0] = i as u32;
            }
            s.ranges[tile as usize][1] = i as u32 + 1;
            s.sorted.push(pair);
        }
        s
    }

    /// What the forward pass of narrow tiles lists.
    struct Lists {
        blended: Vec<[u32; 2]>,
        blended_count: Vec<u32>,
    }

    impl Lists {
        fn new(scene: &Scene) -> Self {
            Self { blended: vec![[7; 2]; scene.pair_slot.len()], blended_count: vec![7; scene.ranges.len()] }
        }
    }

    /// Bindings that only some variants have.
    struct Extra {
        sorted: Vec<u32>,
        pair_slot: Vec<u32>,
        marks: Vec<u32>,
        depth: Vec<f32>,
        pair_depth: Vec<f32>,
        depth_map: Vec<f32>,
        transmittance: Vec<f32>,
        grad_depth_map: Vec<f32>,
        grad_transmittance: Vec<f32>,
    }

    /// Alpha and transmittance thresholds.
    const THRESHOLDS: [(f32, f32); 3] = [(1.0 / 255.0, 1e-4), (1e-3, 0.0), (0.05, 0.02)];

    const SIZES: [[u32; 2]; 5] = [[1, 1], [17, 3], [63, 41], [64, 64], [129, 8]];

    #[test]
    fn forward_matches_its_twin() {
        let gpu = testing::gpu();
        for (i, size) in SIZES.into_iter().enumerate() {
            let (alpha_min, transmittance_min) = THRESHOLDS[i % THRESHOLDS.len()];
            for n in [0, 1, 65, 700] {
                macro_rules! check {
                    ($module:ident, $tiling:expr, [$($list:ident),*] $(, $depth:ident $(, $transmittance:ident)?)?) => {{
                        let s = scene(i as u64, n, size, $tiling, alpha_min);
                        let _lists = Lists::new(&s);
                        let pixels = (size[0] * size[1]) as usize;
                        let grid = $tiling.grid(size);
                        let case = $module::Arrays {
                            ranges: s.ranges, sorted: s.sorted, pair_slot: s.pair_slot, mean: s.mean, conic: s.conic,
                            opacity: s.opacity, color: s.color, rgb: vec![[UNWRITTEN; 3]; pixels],
                            $($list: _lists.$list,)*
                            $($depth: s.depth, depth_map: vec![UNWRITTEN; pixels],
                            $($transmittance: vec![UNWRITTEN; pixels],)?)?
                        };
                        let push = $module::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
                        let threads = [grid[0] * $tiling.threads(), grid[1], 1];
                        let constants = $module::Constants { alpha_min, transmittance_min };
                        testing::assert_twin_with($module::Kernel, &gpu, constants, case, push, threads);
                    }};
                }
                check!(rasterize, Tiling::Wide, [], depth, transmittance);
                check!(rasterize_depth, Tiling::Wide, [], depth);
                check!(rasterize_color, Tiling::Wide, []);
                if gpu.runs_lanes() {
                    check!(rasterize_narrow, Tiling::Narrow, [blended, blended_count], depth, transmittance);
                    check!(rasterize_narrow_depth, Tiling::Narrow, [blended, blended_count], depth);
                    check!(rasterize_narrow_color, Tiling::Narrow, [blended, blended_count]);
                }
            }
        }
    }

    #[test]
    fn backward_matches_its_twin() {
        let gpu = testing::gpu();
        let subgroups = subgroups(&gpu);
        for (i, size) in SIZES.into_iter().enumerate() {
            let (alpha_min, transmittance_min) = THRESHOLDS[i % THRESHOLDS.len()];
            for n in [0, 1, 65, 300] {
                macro_rules! check {
                    ($forward:ident, $module:ident $([$constant:ident])?, $tiling:expr, [$($list:ident),*] $(, $field:ident)*) => {{
                        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(i as u64);
                        let s = scene(i as u64, n, size, $tiling, alpha_min);
                        let pixels = (size[0] * size[1]) as usize;
                        let grid = $tiling.grid(size);
                        let mut random = || (0..pixels).map(|_| rng.random_range(-1f32..1.0)).collect::<Vec<f32>>();
                        let threads = [grid[0] * $tiling.threads(), grid[1], 1];
                        let mut _lists = Lists::new(&s);
                        let picture = $forward::Arrays {
                            ranges: s.ranges.clone(), sorted: s.sorted.clone(), pair_slot: s.pair_slot.clone(),
                            mean: s.mean.clone(), conic: s.conic.clone(), opacity: s.opacity.clone(),
                            color: s.color.clone(), depth: s.depth.clone(), rgb: vec![[0.0; 3]; pixels],
                            depth_map: vec![0.0; pixels], transmittance: vec![0.0; pixels],
                            $($list: _lists.$list,)*
                        };
                        let push = $forward::Push { size, tiles_x: grid[0], background: [0.1, 0.2, 0.3] };
                        let constants = $forward::Constants { alpha_min, transmittance_min };
                        let picture = testing::run_once_with::<$forward::Kernel>(&gpu, &picture, push, constants, threads);
                        $(_lists.$list = picture.$list;)*
                        let pairs = s.pair_slot.len();
                        let extra = Extra {
                            sorted: s.sorted, pair_slot: s.pair_slot, marks: vec![0; pairs.div_ceil(32)],
                            depth: s.depth, pair_depth: vec![UNWRITTEN; pairs], depth_map: picture.depth_map,
                            transmittance: picture.transmittance, grad_depth_map: random(), grad_transmittance: random(),
                        };
                        let grad_rgb = (0..pixels).map(|p| [extra.grad_depth_map[p], -extra.grad_transmittance[p], 0.5]).collect();
                        let case = $module::Arrays {
                            ranges: s.ranges, mean: s.mean, conic: s.conic,
                            opacity: s.opacity, color: s.color, rgb: picture.rgb, grad_rgb, $($list: _lists.$list,)*
                            pair_mean: vec![[UNWRITTEN; 2]; pairs], pair_conic: vec![[UNWRITTEN; 3]; pairs],
                            pair_opacity: vec![UNWRITTEN; pairs], pair_color: vec![[UNWRITTEN; 3]; pairs],
                            $($field: extra.$field,)*
                        };
                        let push = $module::Push { size, tiles_x: grid[0] };
                        let constants = $module::Constants { alpha_min, transmittance_min $(, $constant)? };
                        testing::assert_twin_with($module::Kernel, &gpu, constants, case, push, threads);
                    }};
                }
                check!(
                    rasterize,
                    rasterize_backward[subgroups],
                    Tiling::Wide,
                    [],
                    sorted,
                    pair_slot,
                    depth,
                    depth_map,
                    grad_depth_map,
                    pair_depth,
                    transmittance,
                    grad_transmittance
                );
                check!(
                    rasterize,
                    rasterize_backward_depth[subgroups],
                    Tiling::Wide,
                    [],
                    sorted,
                    pair_slot,
                    depth,
                    depth_map,
                    grad_depth_map,
                    pair_depth
                );
                check!(rasterize, rasterize_backward_color[subgroups], Tiling::Wide, [], sorted, pair_slot);
                if gpu.runs_lanes() {
                    check!(
                        rasterize_narrow,
                        rasterize_backward_narrow,
                        Tiling::Narrow,
                        [blended, blended_count],
                        marks,
                        depth,
                        depth_map,
                        grad_depth_map,
                        pair_depth,
                        transmittance,
                        grad_transmittance
                    );
                    check!(
                        rasterize_narrow,
                        rasterize_backward_narrow_depth,
                        Tiling::Narrow,
                        [blended, blended_count],
                        marks,
                        depth,
                        depth_map,
                        grad_depth_map,
                        pair_depth
                    );
                    check!(
                        rasterize_narrow,
                        rasterize_backward_narrow_color,
                        Tiling::Narrow,
                        [blended, blended_count],
                        marks
                    );
                }
            }
        }
    }

    /// Narrow tiles list the pairs of which a pixel takes something, nearest first, and no others. A sample within rounding
    /// of a threshold may flip (see `PICTURE`): of a hundred samples of a pair the only one that counts is rarely that.
    #[test]
    fn lists_hold_what_is_blended() {
        let gpu = testing::gpu();
        if !gpu.runs_lanes() {
            println!("skipped: narrow tiles need subgroups of 8 threads");
            return;
        }
        let size = [129, 97];
        let pixels = (size[0] * size[1]) as usize;
        for (alpha_min, transmittance_min) in THRESHOLDS {
            let s = scene(3, 2000, size, Tiling::Narrow, alpha_min);
            let lists = Lists::new(&s);
            let case = rasterize_narrow_color::Arrays {
                ranges: s.ranges,
                sorted: s.sorted,
                pair_slot: s.pair_slot,
                mean: s.mean,
                conic: s.conic,
                opacity: s.opacity,
                color: s.color,
                rgb: vec![[0.0; 3]; pixels],
                blended: lists.blended,
                blended_count: lists.blended_count,
            };
            let grid = Tiling::Narrow.grid(size);
            let push = rasterize_narrow_color::Push { size, tiles_x: grid[0], background: [0.0; 3] };
            let constants = rasterize_narrow_color::Constants { alpha_min, transmittance_min };
            let threads = [grid[0] * Tiling::Narrow.threads(), grid[1], 1];
            type K = rasterize_narrow_color::Kernel;
            let got = testing::run_once_with::<K>(&gpu, &case, push, constants, threads);
            let splats = Splats {
                ranges: &case.ranges,
                sorted: &case.sorted,
                pair_slot: &case.pair_slot,
                mean: &case.mean,
                conic: &case.conic,
                opacity: &case.opacity,
                color: &case.color,
                alpha_min,
                transmittance_min,
            };
            let mut seen = vec![false; case.pair_slot.len()];
            for p in 0..size[0] * size[1] {
                splats.walk([p % size[0], p / size[0]], 8, grid[0], |pair, _, _, _, w| {
                    seen[pair] |= w >= f64::from(f32::MIN_POSITIVE);
                });
            }
            let (mut listed, mut other) = (0, 0);
            for tile in 0..(grid[0] * grid[1]) as usize {
                let [first, end] = case.ranges[tile].map(|i| i as usize);
                let list = &got.blended[first..][..got.blended_count[tile] as usize];
                assert!(list.iter().all(|[pair, slot]| case.pair_slot[*pair as usize] == *slot));
                let numbers: Vec<u32> = list.iter().map(|[pair, _]| *pair).collect();
                let mut rest = numbers.iter().peekable();
                for &pair in &case.sorted[first..end] {
                    let has = rest.next_if_eq(&&pair).is_some();
                    listed += usize::from(has);
                    other += usize::from(has != seen[pair as usize]);
                }
                assert!(rest.next().is_none(), "tile {tile}: {numbers:?} is not in the list's order");
            }
            assert!(listed > 1000 && listed < seen.len(), "{listed} of {}", seen.len());
            assert!(other <= listed / 1000, "{other} of {listed} pairs are listed on one side only");
        }
    }

    #[test]
    fn gather_matches_its_twin() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000] {
            let s = scene(n as u64, n, [90, 60], Tiling::Narrow, ALPHA_MIN as f32);
            let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
            let pairs = s.pair_slot.len();
            let mut random = || rng.random_range(-1f32..1.0);
            let case = rasterize_gather::Arrays {
                drawn_count: vec![s.tiles.iter().filter(|tiles| **tiles > 0).count() as u32],
                drawn: (0..n as u32).filter(|&slot| s.tiles[slot as usize] > 0).collect(),
                tiles: s.tiles,
                pair_count: vec![pairs as u32],
                first_pair: s.first_pair,
                conic: s.conic,
                pair_mean: (0..pairs).map(|_| [random(), random()]).collect(),
                pair_conic: (0..pairs).map(|_| [random(), random(), random()]).collect(),
                pair_opacity: (0..pairs).map(|_| random()).collect(),
                pair_color: (0..pairs).map(|_| [random(), random(), random()]).collect(),
                pair_depth: (0..pairs).map(|_| random()).collect(),
                grad_mean: vec![[UNWRITTEN; 2]; n],
                grad_covariance: vec![[UNWRITTEN; 3]; n],
                grad_opacity: vec![UNWRITTEN; n],
                grad_color: vec![[UNWRITTEN; 3]; n],
                grad_depth: vec![UNWRITTEN; n],
            };
            testing::assert_twin(rasterize_gather::Kernel, &gpu, case.clone(), (), n);
            let mut bits = || rng.random::<u32>() & rng.random::<u32>();
            let c = case.clone();
            let marked = rasterize_gather_marked::Arrays {
                drawn_count: c.drawn_count,
                drawn: c.drawn,
                tiles: c.tiles,
                pair_count: c.pair_count,
                first_pair: c.first_pair,
                conic: c.conic,
                pair_mean: c.pair_mean,
                pair_conic: c.pair_conic,
                pair_opacity: c.pair_opacity,
                pair_color: c.pair_color,
                grad_mean: c.grad_mean,
                grad_covariance: c.grad_covariance,
                grad_opacity: c.grad_opacity,
                grad_color: c.grad_color,
                pair_depth: c.pair_depth,
                grad_depth: c.grad_depth,
                marks: (0..pairs.div_ceil(32)).map(|_| bits()).collect(),
            };
            testing::assert_twin(rasterize_gather_marked::Kernel, &gpu, marked.clone(), (), n);
            let c = marked;
            let marked = rasterize_gather_marked_color::Arrays {
                drawn_count: c.drawn_count,
                drawn: c.drawn,
                tiles: c.tiles,
                pair_count: c.pair_count,
                first_pair: c.first_pair,
                conic: c.conic,
                pair_mean: c.pair_mean,
                pair_conic: c.pair_conic,
                pair_opacity: c.pair_opacity,
                pair_color: c.pair_color,
                grad_mean: c.grad_mean,
                grad_covariance: c.grad_covariance,
                grad_opacity: c.grad_opacity,
                grad_color: c.grad_color,
                marks: c.marks,
            };
            testing::assert_twin(rasterize_gather_marked_color::Kernel, &gpu, marked, (), n);
            let color = rasterize_gather_color::Arrays {
                drawn_count: case.drawn_count,
                drawn: case.drawn,
                tiles: case.tiles,
                pair_count: vec![0],
                first_pair: case.first_pair,
                conic: case.conic,
                pair_mean: case.pair_mean,
                pair_conic: case.pair_conic,
                pair_opacity: case.pair_opacity,
                pair_color: case.pair_color,
                grad_mean: case.grad_mean,
                grad_covariance: case.grad_covariance,
                grad_opacity: case.grad_opacity,
                grad_color: case.grad_color,
            };
            testing::assert_twin(rasterize_gather_color::Kernel, &gpu, color, (), n);
        }
    }
}

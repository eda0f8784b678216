//! What there was to do in a step: read back from a traced one.

use std::collections::BTreeMap;

use rayon::prelude::*;

pub use crate::cost::Counts;
use crate::gpu::form::without_form;
use crate::gpu::{Entry, Schedule};
use crate::math::tiles::{support_bands, support_bound};
use crate::render::method::Method;
use crate::render::tiling::Tiling;

/// The buffers that are read back.
pub const WANTED: [&str; 12] = [
    "visible_count",
    "drawn_count",
    "pair_count",
    "tokens",
    "depth",
    "ranges",
    "sort_values",
    "sorted",
    "pair_slot",
    "mean",
    "conic",
    "opacity",
];

/// What does not come from the device.
#[derive(Clone, Copy, Debug)]
pub struct Known {
    /// Anchors, or plain Gaussians.
    pub anchors: u32,
    /// Coefficients of a plain Gaussian's harmonics for each colour; 0 of anchors.
    pub harmonics: u32,
    /// Gaussians per anchor.
    pub offsets: u32,
    /// Width and height of the picture.
    pub size: [u32; 2],
    /// Scales of the depth gradient.
    pub gradient_scales: u32,
}

/// Counts a traced step. The schedule says in which of the sort's two arrays the tiles' lists ended up.
pub fn count(words: &BTreeMap<&'static str, Vec<u32>>, schedule: &Schedule, method: Method, known: Known) -> Counts {
    let of = |name: &str| words.get(name).map_or(&[][..], Vec::as_slice);
    let first = |name: &str| of(name).first().copied().unwrap_or(0);
    // Plain Gaussians are not culled before they are projected.
    let visible = if known.harmonics > 0 { known.anchors } else { first("visible_count") };
    let slots = ((visible * known.offsets) as usize).min(of("depth").len());
    let gaussians = of("depth")[..slots].iter().filter(|bits| f32::from_bits(**bits) > 0.0).count();
    let tiling = method.tiling;
    let [columns, rows] = tiling.grid(known.size);
    let sorted = sorted_list(schedule).unwrap_or("sort_values");
    let floats = |name: &str| bytemuck::cast_slice::<u32, f32>(of(name));
    let lists = Lists {
        ranges: bytemuck::cast_slice(of("ranges")),
        sorted: of(sorted),
        pair_slot: of("pair_slot"),
        mean: bytemuck::cast_slice(floats("mean")),
        conic: bytemuck::cast_slice(floats("conic")),
        opacity: floats("opacity"),
    };
    let tiles = (columns * rows) as usize;
    let walked = lists.walk(tiling, known.size, method);
    Counts {
        anchors: known.anchors.into(),
        harmonics: known.harmonics.into(),
        offsets: known.offsets.into(),
        visible: visible.into(),
        gaussians: gaussians as f64,
        drawn: first("drawn_count").into(),
        pairs: first("pair_count").into(),
        evaluated: walked[0],
        samples: walked[1],
        samples_back: walked[2],
        blended: walked[3],
        seen: walked[4],
        pixels: f64::from(known.size[0]) * f64::from(known.size[1]),
        tiles: tiles as f64,
        tile_side: tiling.side().into(),
        tokens: first("tokens").into(),
        gradient_scales: known.gradient_scales.into(),
    }
}

/// The buffer that the rasteriser takes the tiles' lists from: its second binding.
fn sorted_list(schedule: &Schedule) -> Option<&'static str> {
    schedule.entries.iter().find_map(|entry| match entry {
        Entry::Pass { name, accesses, .. } if without_form(name).starts_with("render/rasterize") => {
            Some(accesses.get(1)?.0)
        }
        _ => None,
    })
}

struct Lists<'a> {
    ranges: &'a [[u32; 2]],
    sorted: &'a [u32],
    pair_slot: &'a [u32],
    mean: &'a [[f32; 2]],
    conic: &'a [[f32; 3]],
    opacity: &'a [f32],
}

/// Samples at most that are walked on the host; of more, tiles spread evenly over the picture stand for all.
const MOST_SAMPLES: u64 = 1 << 29;

impl Lists<'_> {
    /// Pairs up to where the tiles end; their samples, of wide tiles those in rows that the Gaussian reaches, and on the way back
    /// in the four rows of 32 threads; samples that changed a pixel, and pairs with such a sample.
    fn walk(&self, tiling: Tiling, size: [u32; 2], method: Method) -> [f64; 5] {
        let [columns, rows] = tiling.grid(size);
        let tiles = columns * rows;
        let pairs: u64 = self.ranges.iter().take(tiles as usize).map(|[first, end]| u64::from(end - first)).sum();
        let every = (pairs * u64::from(tiling.side()).pow(2)).div_ceil(MOST_SAMPLES).max(1) as usize;
        let chosen: Vec<u32> = (0..tiles).step_by(every).collect();
        let sums = chosen
            .par_iter()
            .map(|&tile| self.tile([tile % columns, tile / columns], tile, tiling.side(), size, method))
            .reduce(|| [0; 5], |a, b| std::array::from_fn(|i| a[i] + b[i]));
        // By pairs, not by tiles: a tile stands for others as full as it is.
        let walked: u64 =
            chosen.iter().map(|&t| self.ranges.get(t as usize).map_or(0, |[a, b]| u64::from(b - a))).sum();
        let scale = if walked > 0 { pairs as f64 / walked as f64 } else { 0.0 };
        sums.map(|sum| sum as f64 * scale)
    }

    /// The rasteriser's decisions, in its own float32.
    fn tile(&self, [column, row]: [u32; 2], tile: u32, side: u32, size: [u32; 2], method: Method) -> [u64; 5] {
        let Some(&[first, end]) = self.ranges.get(tile as usize) else { return [0; 5] };
        let mut pixels = vec![];
        for y in row * side..((row + 1) * side).min(size[1]) {
            for x in column * side..((column + 1) * side).min(size[0]) {
                pixels.push(([x as f32 + 0.5, y as f32 + 0.5], 1f32));
            }
        }
        // Pixels of each row; wide tiles pass over what reaches none of them.
        let of_row: Vec<u64> =
            (0..side).map(|r| pixels.iter().filter(|(at, _)| at[1] as u32 == row * side + r).count() as u64).collect();
        let reaching = |rows: u32, bands: u32| -> u64 {
            of_row.iter().zip(0..).filter(|(_, r)| bands >> (r / rows) & 1 == 1).map(|(n, _)| n).sum()
        };
        let (mut evaluated, mut samples, mut samples_back, mut blended, mut seen) = (0, 0, 0, 0, 0);
        for &pair in &self.sorted[first as usize..end as usize] {
            if pixels.is_empty() {
                break;
            }
            evaluated += 1;
            let before = blended;
            let slot = self.pair_slot[pair as usize] as usize;
            let (mean, conic, opacity) = (self.mean[slot], self.conic[slot], self.opacity[slot]);
            if side == 16 {
                let bound = support_bound(opacity, method.alpha_min);
                let reached =
                    |rows| support_bands(mean[1], conic[2], bound, (row * side) as f32 + 0.5, rows, side / rows);
                samples += reaching(1, reached(1));
                // Of a pair of bands of two rows both, where one is reached.
                let either = (reached(2) | reached(2) >> 1) & 0x5555_5555;
                samples_back += reaching(2, either | either << 1);
            } else {
                samples += of_row.iter().sum::<u64>();
                samples_back += of_row.iter().sum::<u64>();
            }
            pixels.retain_mut(|(at, transmittance)| {
                let (dx, dy) = (at[0] - mean[0], at[1] - mean[1]);
                let across = dx - conic[1] * dy;
                let power = -0.5 * (conic[0] * across * across + conic[2] * dy * dy);
                let alpha = (opacity * power.exp()).min(0.99);
                if alpha < method.alpha_min {
                    return true;
                }
                let after = *transmittance * (1.0 - alpha);
                if after < method.transmittance_min {
                    return false;
                }
                blended += 1;
                *transmittance = after;
                true
            });
            seen += u64::from(blended > before);
        }
        [evaluated, samples, samples_back, blended, seen]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two tiles of 8 x 8, the second one pixel wide; three Gaussians that fill them, of which two end the first.
    #[test]
    fn tiles_end_where_no_pixel_sees() {
        let method = Method { transmittance_min: 0.2, ..Method::from(Tiling::Narrow) };
        let lists = Lists {
            ranges: &[[0, 3], [3, 4], [4, 4]],
            sorted: &[0, 1, 2, 3],
            pair_slot: &[0, 1, 2, 2],
            mean: &[[4.0, 4.0]; 3],
            conic: &[[1e-9, 0.0, 1e-9]; 3],
            opacity: &[0.7, 0.9, 0.5],
        };
        // First tile: 0.7 leaves 0.3; 0.9 would leave 0.03, below 0.2: every pixel ends there.
        let [evaluated, samples, _, blended, seen] = lists.walk(Tiling::Narrow, [9, 8], method);
        assert_eq!((evaluated, samples, blended, seen), (2.0 + 1.0, 128.0 + 8.0, 64.0 + 8.0, 1.0 + 1.0));
        let never = Method { transmittance_min: 0.0, ..method };
        let [evaluated, samples, _, blended, seen] = lists.walk(Tiling::Narrow, [9, 8], never);
        assert_eq!((evaluated, samples, blended, seen), (4.0, 200.0, 200.0, 4.0));
        // Below the alpha threshold nothing is blended, and nothing ends.
        let faint = Lists { opacity: &[1e-3; 3], ..lists };
        assert_eq!(faint.walk(Tiling::Narrow, [9, 8], method), [4.0, 200.0, 200.0, 0.0, 0.0]);
    }

    /// A Gaussian of the upper half, one of the lower and one of both.
    #[test]
    fn wide_tiles_count_the_rows_that_are_reached() {
        let lists = Lists {
            ranges: &[[0, 3], [3, 3]],
            sorted: &[0, 1, 2],
            pair_slot: &[0, 1, 2],
            mean: &[[8.0, 3.0], [8.0, 13.0], [8.0, 8.0]],
            conic: &[[1.0, 0.0, 1.0]; 3],
            opacity: &[0.5; 3],
        };
        let method = Method::from(Tiling::Wide);
        // 16 columns and 12 rows, of which rows 0 to 5, 10 and 11, and 5 to 10 are reached; on the way back by fours.
        let [evaluated, samples, back, ..] = lists.walk(Tiling::Wide, [16, 12], method);
        assert_eq!((evaluated, samples), (3.0, 16.0 * (6.0 + 2.0 + 6.0)));
        assert_eq!(back, 16.0 * (8.0 + 4.0 + 8.0));
    }

    #[test]
    fn means() {
        let of = |pairs, tokens| Counts { pairs, tokens, ..Counts::default() };
        assert_eq!(Counts::mean(vec![of(1.0, 8.0), of(3.0, 0.0)]), of(2.0, 4.0));
    }
}

//! Resampling: exact area averages for pictures and depth priors, "any object pixel" for masks, and mask dilation.

use std::ops::Range;

use image::{GrayImage, RgbImage};

/// For one output sample along an axis: the first input sample that counts and the weights from there on (sum 1).
struct Tap {
    start: usize,
    weights: Vec<f64>,
}

/// Weights from `from` to `to` samples over the same extent. Shrinking averages by covered length, which is exact for any
/// ratio; growing interpolates linearly between sample centres (clamped at the ends); equal lengths are the identity.
fn taps(from: usize, to: usize) -> Vec<Tap> {
    (0..to)
        .map(|i| {
            if to < from {
                // In units of 1 / `to` of an input sample, so that the overlaps are whole numbers.
                let (low, high) = (i * from, (i + 1) * from);
                let covered = low / to..high.div_ceil(to);
                let weights =
                    covered.clone().map(|s| (high.min((s + 1) * to) - low.max(s * to)) as f64 / from as f64).collect();
                Tap { start: covered.start, weights }
            } else {
                let position = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
                let start = (position as usize).min(from.saturating_sub(2));
                let fraction = position - start as f64;
                let weights = if from == 1 { vec![1.0] } else { vec![1.0 - fraction, fraction] };
                Tap { start, weights }
            }
        })
        .collect()
}

/// Resamples interleaved samples of `C` channels from (width, height) `from` to `to`: rows first, one at a time as the
/// columns need them, so that no full-size intermediate exists.
fn separable<const C: usize>(row: impl Fn(usize, &mut [f64]), from: [usize; 2], to: [usize; 2]) -> Vec<[f64; C]> {
    let (across, down) = (taps(from[0], to[0]), taps(from[1], to[1]));
    let mut input = vec![0.0; from[0] * C];
    let mut shrunk = |y: usize| -> Vec<[f64; C]> {
        row(y, &mut input);
        across
            .iter()
            .map(|tap| {
                std::array::from_fn(|c| {
                    tap.weights.iter().enumerate().map(|(k, w)| w * input[(tap.start + k) * C + c]).sum()
                })
            })
            .collect()
    };
    let mut out = Vec::with_capacity(to[0] * to[1]);
    // Neighbouring output rows share at most the two input rows at their border.
    let mut kept: std::collections::VecDeque<(usize, Vec<[f64; C]>)> = Default::default();
    for tap in &down {
        let mut sum = vec![[0.0; C]; to[0]];
        for (k, weight) in tap.weights.iter().enumerate() {
            let y = tap.start + k;
            if !kept.iter().any(|(at, _)| *at == y) {
                if kept.len() == 2 {
                    kept.pop_front();
                }
                kept.push_back((y, shrunk(y)));
            }
            let (_, values) = kept.iter().find(|(at, _)| *at == y).expect("the row was just put there");
            for (s, v) in sum.iter_mut().zip(values) {
                for c in 0..C {
                    s[c] += weight * v[c];
                }
            }
        }
        out.extend(sum);
    }
    out
}

/// What a picture has at a position in pixels, linear between the centres of the four pixels around it; beyond the
/// outermost centres what the border has there. `at` tells the values of a row-major pixel.
pub fn bilinear<const C: usize>(size: [u32; 2], position: [f64; 2], at: impl Fn(usize) -> [f64; C]) -> [f64; C] {
    let [w, h] = size.map(|n| n as usize);
    let place = |axis: usize, length: usize| (position[axis] - 0.5).clamp(0.0, length.saturating_sub(1) as f64);
    let (x, y) = (place(0, w), place(1, h));
    let (left, top) = (x as usize, y as usize);
    let (right, low) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
    let (a, b) = (x.fract(), y.fract());
    let corners = [[left, top], [right, top], [left, low], [right, low]].map(|[x, y]| at(y * w + x));
    std::array::from_fn(|c| {
        let upper = (1.0 - a) * corners[0][c] + a * corners[1][c];
        let lower = (1.0 - a) * corners[2][c] + a * corners[3][c];
        (1.0 - b) * upper + b * lower
    })
}

/// The colour of a picture at a position in pixels as [`bilinear`] has it, 8-bit levels.
pub fn color_at(image: &RgbImage, position: [f64; 2]) -> [f64; 3] {
    let raw = image.as_raw();
    bilinear(image.dimensions().into(), position, |pixel| std::array::from_fn(|c| f64::from(raw[3 * pixel + c])))
}

/// A photograph at another size: the area average of the stored values, rounded to 8 bits.
pub fn photograph(image: &RgbImage, to: [u32; 2]) -> RgbImage {
    let (w, h) = image.dimensions();
    if [w, h] == to {
        return image.clone();
    }
    let stride = 3 * w as usize;
    let raw = image.as_raw();
    let out = separable::<3>(
        |y, line| line.iter_mut().zip(&raw[y * stride..(y + 1) * stride]).for_each(|(l, v)| *l = f64::from(*v)),
        [w as usize, h as usize],
        to.map(|v| v as usize),
    );
    let bytes = out.iter().flatten().map(|v| v.round() as u8).collect();
    RgbImage::from_raw(to[0], to[1], bytes).expect("three bytes per output pixel were written")
}

/// A float map at another size: area average when shrinking, linear when growing, per axis. NaN counts for nothing; it
/// stays where less than half of what a pixel covers has a value.
pub fn map(values: &[f32], from: [u32; 2], to: [u32; 2]) -> Vec<f32> {
    if from == to {
        return values.to_vec();
    }
    let w = from[0] as usize;
    let line = |y: usize, line: &mut [f64]| {
        for (l, v) in line.chunks_exact_mut(2).zip(&values[y * w..(y + 1) * w]) {
            l.copy_from_slice(&if v.is_nan() { [0.0, 0.0] } else { [f64::from(*v), 1.0] });
        }
    };
    let mean = |[sum, share]: &[f64; 2]| {
        // Shares of 1 add up to 1 but for their rounding, which the division must not bring into whole maps.
        let share = if (share - 1.0).abs() < 1e-9 { 1.0 } else { *share };
        if share < 0.5 { f32::NAN } else { (sum / share) as f32 }
    };
    separable::<2>(line, from.map(|v| v as usize), to.map(|v| v as usize)).iter().map(mean).collect()
}

/// A mask at a smaller size: a pixel is object (255) if any input pixel it covers, even in part, is not 0.
pub fn mask(mask: &GrayImage, to: [u32; 2]) -> GrayImage {
    let mut out = largest(mask, to);
    out.iter_mut().filter(|v| **v != 0).for_each(|v| *v = 255);
    out
}

/// A mask that falls off at a smaller size: a pixel has the largest value of those it covers, even in part.
pub fn largest(mask: &GrayImage, to: [u32; 2]) -> GrayImage {
    let (w, h) = mask.dimensions();
    let covered = |i: u32, from: u32, to: u32| -> Range<u32> {
        let (low, high) = (u64::from(i) * u64::from(from), u64::from(i + 1) * u64::from(from));
        (low / u64::from(to)) as u32..high.div_ceil(u64::from(to)) as u32
    };
    GrayImage::from_fn(to[0], to[1], |x, y| {
        let row = |v| covered(x, w, to[0]).map(|u| mask.get_pixel(u, v).0[0]).max().unwrap_or(0);
        image::Luma([covered(y, h, to[1]).map(row).max().unwrap_or(0)])
    })
}

/// A mask at another size by its nearest pixel.
pub fn nearest(mask: &GrayImage, to: [u32; 2]) -> GrayImage {
    let (w, h) = mask.dimensions();
    let source = |i: u32, from: u32, to: u32| ((2 * u64::from(i) + 1) * u64::from(from) / (2 * u64::from(to))) as u32;
    GrayImage::from_fn(to[0], to[1], |x, y| *mask.get_pixel(source(x, w, to[0]), source(y, h, to[1])))
}

/// Dilates a mask of 0 and 255 by a disc: a pixel becomes object if an object pixel lies within `radius` pixels of it.
pub fn dilate(mask: &GrayImage, radius: u32) -> GrayImage {
    if radius == 0 {
        return mask.clone();
    }
    let values = distances(mask, radius).into_iter().map(|d| if d <= radius { 255 } else { 0 }).collect();
    GrayImage::from_raw(mask.width(), mask.height(), values).expect("a value per pixel")
}

/// The pixels of a picture of this size that `is` says, without what is thinner than discs of this radius: a mask of 0 and 255
/// (morphological opening).
pub fn opened([w, h]: [u32; 2], is: impl Fn(usize) -> bool, radius: u32) -> GrayImage {
    let mask = |of: &dyn Fn(usize) -> bool| {
        GrayImage::from_fn(w, h, |x, y| image::Luma([if of((y * w + x) as usize) { 255 } else { 0 }]))
    };
    let outside = dilate(&mask(&|i| !is(i)), radius);
    dilate(&mask(&|i| outside.as_raw()[i] == 0), radius)
}

/// Distance of each pixel from the nearest object pixel, rounded up to whole pixels; `reach + 1` where none is as near as
/// `reach`.
pub fn distances(mask: &GrayImage, reach: u32) -> Vec<u32> {
    let squares: Vec<usize> = (0..=reach as usize + 1).map(|d| d * d).collect();
    let rounded = |square: usize| (squares.partition_point(|s| *s < square) as u32).min(reach + 1);
    squared_distances(mask, reach).into_iter().map(rounded).collect()
}

/// Squared distance of each pixel's centre from that of the nearest object pixel, exact up to `reach` pixels; more than
/// `reach` squared where none is as near.
pub fn squared_distances(mask: &GrayImage, reach: u32) -> Vec<usize> {
    let (w, h) = (mask.width() as usize, mask.height() as usize);
    let raw = mask.as_raw();
    let reach = reach as usize;
    // No object pixel in the column: out of reach.
    let far = reach + 1;
    // Vertical distance to the nearest object pixel of the same column.
    let mut vertical = vec![far; w * h];
    for x in 0..w {
        let mut last = far;
        for y in 0..h {
            last = if raw[y * w + x] != 0 { 0 } else { (last + 1).min(far) };
            vertical[y * w + x] = last;
        }
        last = far;
        for y in (0..h).rev() {
            last = if raw[y * w + x] != 0 { 0 } else { (last + 1).min(far) };
            vertical[y * w + x] = vertical[y * w + x].min(last);
        }
    }
    let square = |pixel: usize| {
        let (x, row) = (pixel % w, &vertical[pixel / w * w..(pixel / w + 1) * w]);
        let near = x.saturating_sub(reach)..(x + reach + 1).min(w);
        near.map(|u| row[u] * row[u] + u.abs_diff(x) * u.abs_diff(x)).min().unwrap_or(far * far)
    };
    (0..w * h).map(square).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The average of a ramp over a cell is its value at the cell's centre. A pixel of which the fraction f is covered stands
    /// with its centre's value instead of that of the covered part, (1 - f) / 2 of a step away: with weight f / ratio, and
    /// the other end of the opposite sign, that is at most step / (8 ratio) per axis, and nothing for whole ratios.
    #[test]
    fn area_average_keeps_constants_and_ramps() {
        for (from, to) in [([12, 9], [4, 3]), ([1008, 567], [252, 142]), ([7, 13], [3, 5]), ([5, 5], [5, 5])] {
            let [w, h] = from;
            let ramp: Vec<f32> = (0..h)
                .flat_map(|y| {
                    (0..w).map(move |x| {
                        (2.0 * (f64::from(x) + 0.5) / f64::from(w) - (f64::from(y) + 0.5) / f64::from(h)) as f32
                    })
                })
                .collect();
            let out = map(&ramp, from, to);
            for (i, v) in out.iter().enumerate() {
                let (x, y) = (i as u32 % to[0], i as u32 / to[0]);
                let exact = 2.0 * (f64::from(x) + 0.5) / f64::from(to[0]) - (f64::from(y) + 0.5) / f64::from(to[1]);
                let partial = |i: usize| {
                    let [from, to] = [from[i], to[i]].map(f64::from);
                    if from % to == 0.0 { 0.0 } else { to / (8.0 * from) }
                };
                // The input is rounded to float32 (values below 2: 1.2e-7), and so is the output.
                let bound = 2.0 / f64::from(w) * partial(0) + 1.0 / f64::from(h) * partial(1) + 3e-7;
                assert!((f64::from(*v) - exact).abs() < bound, "{from:?} -> {to:?} at {x},{y}: {v} not {exact}");
            }
            assert!(map(&vec![3.25; (w * h) as usize], from, to).iter().all(|v| (v - 3.25).abs() < 1e-6));
        }
    }

    #[test]
    fn area_average_weighs_partly_covered_pixels() {
        // 3 -> 2: each output covers one and a half inputs.
        assert_eq!(map(&[0.0, 3.0, 9.0], [3, 1], [2, 1]), [1.0, 7.0]);
        let image = RgbImage::from_raw(3, 1, vec![0, 30, 90, 30, 30, 30, 90, 30, 0]).expect("3 x 1");
        assert_eq!(photograph(&image, [2, 1]).as_raw(), &[10, 30, 70, 70, 30, 10]);
    }

    #[test]
    fn growing_interpolates_between_centres() {
        assert_eq!(map(&[0.0, 4.0], [2, 1], [4, 1]), [0.0, 1.0, 3.0, 4.0]);
        assert_eq!(map(&[5.0], [1, 1], [3, 2]), [5.0; 6]);
        // One axis grows while the other shrinks.
        assert_eq!(map(&[0.0, 4.0, 2.0, 6.0], [2, 2], [4, 1]), [1.0, 2.0, 4.0, 5.0]);
    }

    #[test]
    fn colors_lie_between_pixel_centres() {
        let picture = RgbImage::from_fn(4, 3, |x, y| image::Rgb([10 * x as u8, 20 * y as u8, 7]));
        assert_eq!(color_at(&picture, [0.5, 0.5]), [0.0, 0.0, 7.0]);
        assert_eq!(color_at(&picture, [2.0, 1.75]), [15.0, 25.0, 7.0]);
        // Beyond the outermost centres: the border.
        assert_eq!(color_at(&picture, [0.1, 1.5]), [0.0, 20.0, 7.0]);
        assert_eq!(color_at(&picture, [4.0, 9.0]), [30.0, 40.0, 7.0]);
        let one = RgbImage::from_pixel(1, 1, image::Rgb([3; 3]));
        assert_eq!(color_at(&one, [0.7, 0.2]), [3.0; 3]);
    }

    #[test]
    fn a_mask_pixel_is_object_if_any_covered_pixel_is() {
        let mut full = GrayImage::new(5, 3);
        full.put_pixel(2, 1, image::Luma([1]));
        // The centre pixel of 5 x 3 is shared by both columns and both rows of 2 x 2.
        assert_eq!(mask(&full, [2, 2]).as_raw(), &[255; 4]);
        let mut full = GrayImage::new(6, 2);
        full.put_pixel(5, 0, image::Luma([255]));
        assert_eq!(mask(&full, [3, 1]).as_raw(), &[0, 0, 255]);
    }

    #[test]
    fn dilation_is_a_disc() {
        let mut dot = GrayImage::new(9, 7);
        dot.put_pixel(4, 3, image::Luma([255]));
        for radius in [0, 1, 2, 3, 20] {
            let out = dilate(&dot, radius);
            for (x, y, v) in out.enumerate_pixels() {
                let r2 = x.abs_diff(4).pow(2) + y.abs_diff(3).pow(2);
                assert_eq!(v.0[0] == 255, r2 <= radius * radius, "radius {radius} at {x},{y}");
            }
        }
        let far = distances(&dot, 3);
        for (pixel, d) in far.iter().enumerate() {
            let exact = ((pixel % 9).abs_diff(4) as f64).hypot((pixel / 9).abs_diff(3) as f64);
            assert_eq!(*d, (exact.ceil() as u32).min(4), "pixel {pixel}");
        }
        assert!(dilate(&GrayImage::new(4, 4), 9).as_raw().iter().all(|v| *v == 0));
    }
}

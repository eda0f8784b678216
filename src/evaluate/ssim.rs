use rayon::prelude::*;

use crate::math::ssim::{C1, C2, RADIUS, window};

/// SSIM per pixel and channel of two \[height, width, 3\] images with peak 1 (Wang et al. 2004): 11 x 11 Gaussian window of
/// sigma 1.5, zero outside the image.
///
/// # Panics
/// If an image does not have `3 * width * height` values.
pub fn ssim_map(a: &[f64], b: &[f64], width: usize, height: usize) -> Vec<f64> {
    assert!(a.len() == 3 * width * height && b.len() == a.len(), "two RGB images of the stated size");
    let window = window();
    let blurred = |product: &(dyn Fn(usize) -> f64 + Sync)| blur(product, &window, width, height);
    let (mean_a, mean_b) = (blurred(&|i| a[i]), blurred(&|i| b[i]));
    let (square_a, square_b, cross) = (blurred(&|i| a[i] * a[i]), blurred(&|i| b[i] * b[i]), blurred(&|i| a[i] * b[i]));
    (0..a.len())
        .map(|i| {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, vab) = (square_a[i] - ma * ma, square_b[i] - mb * mb, cross[i] - ma * mb);
            (2.0 * ma * mb + C1) * (2.0 * vab + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2))
        })
        .collect()
}

/// Rows, then columns; taps outside the image add nothing.
fn blur(value: &(dyn Fn(usize) -> f64 + Sync), window: &[f64], width: usize, height: usize) -> Vec<f64> {
    let stride = 3 * width;
    let taps = |at: usize, size: usize| at.saturating_sub(RADIUS)..(at + RADIUS + 1).min(size);
    let mut across = vec![0.0; stride * height];
    across.par_chunks_exact_mut(stride).enumerate().for_each(|(row, out)| {
        let line: Vec<f64> = (row * stride..(row + 1) * stride).map(value).collect();
        for column in 0..width {
            for tap in taps(column, width) {
                let weight = window[tap + RADIUS - column];
                for channel in 0..3 {
                    out[3 * column + channel] += weight * line[3 * tap + channel];
                }
            }
        }
    });
    let mut both = vec![0.0; stride * height];
    both.par_chunks_exact_mut(stride).enumerate().for_each(|(row, out)| {
        for tap in taps(row, height) {
            let weight = window[tap + RADIUS - row];
            let line = &across[tap * stride..(tap + 1) * stride];
            out.iter_mut().zip(line).for_each(|(sum, value)| *sum += weight * value);
        }
    });
    both
}

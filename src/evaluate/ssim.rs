use rayon::prelude::*;

const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

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

/// One axis of the window; the window is its outer product with itself.
fn window() -> [f64; 2 * RADIUS + 1] {
    let mut weights = [0.0; 2 * RADIUS + 1];
    for (i, weight) in weights.iter_mut().enumerate() {
        let x = i as f64 - RADIUS as f64;
        *weight = (-x * x / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
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

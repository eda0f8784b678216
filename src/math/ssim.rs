//! Structural similarity (Wang et al. 2004) in float64: 11 x 11 Gaussian window with sigma 1.5, zeros outside the
//! picture, as 3D Gaussian splatting uses it.

/// Half the window: it spans `2 RADIUS + 1` pixels.
pub const RADIUS: usize = 5;
/// Constant of the means' quotient, for values in \[0, 1\].
pub const C1: f64 = 0.01 * 0.01;
/// Constant of the variances' quotient, for values in \[0, 1\].
pub const C2: f64 = 0.03 * 0.03;

/// The separable window's weights; they sum to one.
pub fn window() -> [f64; 2 * RADIUS + 1] {
    let raw: [f64; 2 * RADIUS + 1] = std::array::from_fn(|k| {
        let d = k as f64 - RADIUS as f64;
        (-d * d / (2.0 * 1.5 * 1.5)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

/// Weighted sum of `at(position)` over the window around `centre`; positions outside `0..len` count as zero.
pub fn blur(centre: usize, len: usize, mut at: impl FnMut(usize) -> f64) -> f64 {
    let mut sum = 0.0;
    for (k, w) in window().into_iter().enumerate() {
        let position = centre + k;
        if (RADIUS..len + RADIUS).contains(&position) {
            sum += w * at(position - RADIUS);
        }
    }
    sum
}

/// Moments of a window: mean of a, mean of b, sum of both variances, covariance.
pub type Moments = [f64; 4];

/// SSIM of a window, and its derivatives by the window's mean of a, by its second moment of a and by its mixed second
/// moment, all moments about 1/2: at a pixel of weight g in the window,
/// `d ssim / d a = g (by_mean + 2 (a - 1/2) by_second + (b - 1/2) by_mixed)`.
pub fn derivatives([a, b, variances, covariance]: Moments) -> (f64, [f64; 3]) {
    let (inverse1, inverse2) = (1.0 / (a * a + b * b + C1), 1.0 / (variances + C2));
    let means = (2.0 * a * b + C1) * inverse1;
    let structure = (2.0 * covariance + C2) * inverse2;
    let ssim = means * structure;
    let by_second = -ssim * inverse2;
    let by_mixed = 2.0 * means * inverse2;
    let by_mean = 2.0 * inverse1 * (b * structure - a * ssim);
    (ssim, [by_mean - 2.0 * (a - 0.5) * by_second - (b - 0.5) * by_mixed, by_second, by_mixed])
}

/// SSIM of every pixel of two single-channel pictures, straight from the definition.
pub fn map(a: &[f64], b: &[f64], width: usize, height: usize) -> Vec<f64> {
    let blurred = |value: &dyn Fn(usize) -> f64| -> Vec<f64> {
        (0..width * height)
            .map(|p| blur(p / width, height, |y| blur(p % width, width, |x| value(y * width + x))))
            .collect()
    };
    let (ma, mb) = (blurred(&|p| a[p]), blurred(&|p| b[p]));
    let (squares, mixed) = (blurred(&|p| a[p] * a[p] + b[p] * b[p]), blurred(&|p| a[p] * b[p]));
    (0..width * height)
        .map(|p| {
            let variances = squares[p] - ma[p] * ma[p] - mb[p] * mb[p];
            derivatives([ma[p], mb[p], variances, mixed[p] - ma[p] * mb[p]]).0
        })
        .collect()
}

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

/// Moments of a window of a and b: mean of a, mean of a - b, sum of the variances of a and b, variance of a - b.
pub type Moments = [f64; 4];

/// 1 - SSIM of a window, and SSIM's derivatives by the window's mean of a, by the sum of both second moments about 1/2
/// and by the second moment of the difference: at a pixel of weight g in the window,
/// `d ssim / d a = g (by_mean + 2 (a - 1/2) by_sum + 2 (a - b) by_difference)`.
///
/// With the distances of the two quotients from one, `u = mean(a - b)^2 / (mean(a)^2 + mean(b)^2 + C1)` and
/// `v = var(a - b) / (var(a) + var(b) + C2)`, SSIM is `(1 - u)(1 - v)`: nothing cancels where a and b agree.
pub fn derivatives([mean, difference, sum, variance]: Moments) -> (f64, [f64; 3]) {
    let b = mean - difference;
    let (inverse1, inverse2) = (1.0 / (mean * mean + b * b + C1), 1.0 / (sum + C2));
    let (u, v) = (difference * difference * inverse1, variance * inverse2);
    let by_sum = (1.0 - u) * v * inverse2;
    let by_difference = (u - 1.0) * inverse2;
    let by_mean = 2.0 * inverse1 * (1.0 - v) * (mean * u - difference);
    let about_half = by_mean - 2.0 * ((mean - 0.5) * by_sum + difference * by_difference);
    (u + v - u * v, [about_half, by_sum, by_difference])
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
            let (a, b) = (ma[p], mb[p]);
            let means = (2.0 * a * b + C1) / (a * a + b * b + C1);
            means * (2.0 * (mixed[p] - a * b) + C2) / (squares[p] - a * a - b * b + C2)
        })
        .collect()
}

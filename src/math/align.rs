//! The least-squares fit of a rendered map to a prior that is known up to scale and shift, and the way back through it,
//! in float64.

/// What is fitted to a prior: the rendered depth itself (`near` = 0), or its disparity: `1 / depth`, continued below
/// `near` by its tangent `(2 - depth / near) / near`, which is finite where nothing was rendered.
pub fn alignable(depth: f64, near: f64) -> f64 {
    if near == 0.0 {
        depth
    } else if depth >= near {
        1.0 / depth
    } else {
        (2.0 - depth / near) / near
    }
}

/// Derivative of [`alignable`] by the depth.
pub fn alignable_slope(depth: f64, near: f64) -> f64 {
    if near == 0.0 { 1.0 } else { -1.0 / depth.max(near).powi(2) }
}

/// The power of two that brings the mean of `sum` over `n` values between 1/2 and 2, from float32 exponents as on the
/// device: the unit of the distances dx. Without it their squares leave float32's range for values beyond 1e19 or below
/// 1e-19, and a map of small values would look as if it had no shape.
pub fn unit(n: f64, sum: f64) -> f64 {
    let exponent = |v: f64| ((v as f32).abs().to_bits() >> 23) as i32;
    2.0_f64.powi((exponent(n) - exponent(sum)).clamp(-126, 126))
}

/// Sums over valid pixels: of the weights, the values x and the priors p, and then of the distances dx, dp from these
/// sums' means, of dx^2 and of dx dp, with dx in [`unit()`]s. The distances' sums are zero but for the means' rounding.
pub type Sums = [f64; 7];

/// Both passes' sums in float64.
pub fn sums(x: &[f64], prior: &[f64], valid: &[f64]) -> Sums {
    let mut s = [0.0; 7];
    for ((x, p), v) in x.iter().zip(prior).zip(valid) {
        s[0] += v;
        s[1] += v * x;
        s[2] += v * p;
    }
    let n = if s[0] > 0.0 { s[0] } else { 1.0 };
    let (mean, mean_prior) = (s[1] / n, s[2] / n);
    let unit = unit(s[0], s[1]);
    for ((x, p), v) in x.iter().zip(prior).zip(valid) {
        let (dx, dp) = ((x - mean) * unit, p - mean_prior);
        s[3] += v * dx;
        s[4] += v * dp;
        s[5] += v * dx * dx;
        s[6] += v * dx * dp;
    }
    s
}

/// `slope * x + shift ~ prior` by least squares; aligned values are `scale * x + shift` with `scale = |slope|`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fit {
    /// |slope|.
    pub scale: f64,
    /// Shift q.
    pub shift: f64,
    /// Mean of x over valid pixels, but for `mean_rest`.
    pub mean: f64,
    /// Aligned value less prior at the two means.
    pub level: f64,
    /// Slope w, signed.
    pub slope: f64,
    /// One over the sum of squared distances from the mean, in [`unit()`]s; 0 when the fit is singular.
    pub inverse_spread: f64,
    /// Mean prior over valid pixels, but for `prior_rest`; 0 when the fit is singular.
    pub mean_prior: f64,
    /// One over the number of valid pixels; 0 without any.
    pub inverse_count: f64,
    /// [`unit()`]s per x.
    pub unit: f64,
    /// What `mean` lacks: its rounding.
    pub mean_rest: f64,
    /// What `mean_prior` lacks.
    pub prior_rest: f64,
}

impl Fit {
    /// From the sums of both passes. A singular fit (no valid pixel, or a standard deviation of x below 2^-21 of its
    /// mean: eight float32 roundings) has no scale, no shift and no gradient. The test is of a ratio: scaling the scene or
    /// the prior does not change what is singular.
    ///
    /// Distances from the means are formed before they are squared and multiplied (Chan, Golub and LeVeque 1983), and the
    /// means' own rounding is taken out of the moments. With u = 2^-24, c = 50 roundings on a term's way through the
    /// sums, k = mean / deviation of x and r the correlation of x and prior, S is right to `c u (1 + (c u k)^2)` of itself
    /// (what the means lack is at most c u of them) and w to `1 + 1 / r` times that. Differences and gradients use
    /// distances from the same rounded means and are right to a few u of their own terms: plain moments would lose k^2 u.
    pub fn of(sums: Sums) -> Self {
        let n = sums[0];
        if n.is_nan() || n <= 0.0 {
            return Self::default();
        }
        let unit = unit(n, sums[1]);
        let (correction, correction_prior) = (sums[3] / n, sums[4] / n);
        let (mean, mean_prior) = (sums[1] / n, sums[2] / n);
        let (mean_rest, prior_rest) = (correction / unit, correction_prior);
        let spread = sums[5] - sums[3] * correction;
        let rounding = (mean * unit).max(0.5) * 2.0_f64.powi(-21);
        let means = Self { mean, inverse_count: 1.0 / n, unit, mean_rest, prior_rest, ..Self::default() };
        if spread > n * rounding * rounding {
            let slope = (sums[6] - sums[3] * correction_prior) / spread * unit;
            Self {
                scale: slope.abs(),
                shift: mean_prior - slope * mean + (prior_rest - slope * mean_rest),
                level: prior_rest - slope * mean_rest + (slope.abs() - slope) * mean,
                slope,
                inverse_spread: 1.0 / spread,
                mean_prior,
                ..means
            }
        } else {
            means
        }
    }

    /// In the order in which the kernels keep it.
    pub fn to_array(self) -> [f64; 11] {
        let Self { scale, shift, mean, level, slope, inverse_spread, mean_prior, inverse_count, .. } = self;
        let Self { unit, mean_rest, prior_rest, .. } = self;
        [scale, shift, mean, level, slope, inverse_spread, mean_prior, inverse_count, unit, mean_rest, prior_rest]
    }

    /// Inverse of [`Fit::to_array`].
    pub fn from_array(values: [f64; 11]) -> Self {
        let [scale, shift, mean, level, slope, inverse_spread, mean_prior, inverse_count, unit, mean_rest, prior_rest] =
            values;
        Self {
            scale,
            shift,
            mean,
            level,
            slope,
            inverse_spread,
            mean_prior,
            inverse_count,
            unit,
            mean_rest,
            prior_rest,
        }
    }

    /// Aligned value less prior.
    pub fn difference(&self, x: f64, prior: f64) -> f64 {
        self.scale * (x - self.mean) - (prior - self.mean_prior) + self.level
    }

    /// `dL/dx` of a pixel from `grad_aligned` = dL/d(aligned) there, with the sums of grad_aligned and of
    /// `grad_aligned * (x - mean)`, in [`unit()`]s, over all pixels:
    /// `dw/dx = valid (dp - 2 w dx) / S`, `dq/dx = -mean dw/dx - valid w / n`; the gradient of |w| at 0 is 0.
    pub fn gradient(&self, grad_aligned: f64, sums: [f64; 2], x: f64, prior: f64, valid: f64) -> f64 {
        let sign = if self.slope == 0.0 { 0.0 } else { self.slope.signum() };
        let grad_slope = sign * sums[1] + (sign - 1.0) * self.mean * self.unit * sums[0];
        let (dx, dp) = (x - self.mean - self.mean_rest, prior - self.mean_prior - self.prior_rest);
        let by_slope = grad_slope * self.inverse_spread * self.unit * (dp - 2.0 * self.slope * dx);
        self.scale * grad_aligned + valid * (by_slope - self.slope * sums[0] * self.inverse_count)
    }
}

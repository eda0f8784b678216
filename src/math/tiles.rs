//! Which tiles a Gaussian touches: the same float32 operations as `glsl/include/tiles.glsl`, because the result is a
//! discrete decision.

/// The ellipse in which a Gaussian's alpha can reach the threshold, and the tile rows it spans.
#[derive(Clone, Copy, Debug)]
pub struct Support {
    bound: f32,
    covariance: [f32; 3],
    half_size: [f32; 2],
    tip: f32,
    /// First tile row.
    pub row0: i32,
    /// Last tile row; before the first when there is none.
    pub row1: i32,
}

/// 2 ln(opacity / alpha_min), widened by what rounding of the quadratic form may take away.
pub fn support_bound(opacity: f32, alpha_min: f32) -> f32 {
    2.0 * (opacity / alpha_min).ln() * 1.0001 + 1e-3
}

impl Support {
    /// Of a Gaussian (mean px, factored covariance px^2, opacity and the alpha it must reach) on a grid of square tiles.
    pub fn new(
        mean: [f32; 2],
        covariance: [f32; 3],
        (opacity, alpha_min): (f32, f32),
        tile: u32,
        grid: [u32; 2],
    ) -> Self {
        let bound = support_bound(opacity, alpha_min);
        let [narrow, slope, variance] = covariance;
        let xy = slope * variance;
        let xx = narrow + slope * xy;
        let half_size = [xx, variance].map(|v| (bound.max(0.0) * v).sqrt());
        let side = tile as f32;
        let low = (mean[1] - half_size[1]).clamp(-1e6, 1e6);
        let high = (mean[1] + half_size[1]).clamp(-1e6, 1e6);
        let row0 = (((low - side + 0.5) / side).ceil() as i32).max(0);
        let row1 = (((high - 0.5) / side).floor() as i32).min(grid[1] as i32 - 1);
        let row1 = if bound >= 0.0 { row1 } else { row0 - 1 };
        Self { bound, covariance, half_size, tip: xy / xx * half_size[0], row0, row1 }
    }

    /// First and last tile column of a tile row.
    pub fn columns(&self, mean: [f32; 2], row: i32, tile: u32, grid: [u32; 2]) -> (i32, i32) {
        let side = tile as f32;
        let low = (row * tile as i32) as f32 + 0.5 - mean[1];
        let high = low + side - 1.0;
        let [hx, hy] = self.half_size;
        let (low, high) = (low.max(-hy).min(hy), high.max(-hy).min(hy));
        let [narrow, slope, variance] = self.covariance;
        let (at_right, at_left) = (self.tip.max(low).min(high), (-self.tip).max(low).min(high));
        let root = |at: f32| ((self.bound - at * at / variance).max(0.0) * narrow).sqrt();
        let right = slope * at_right + root(at_right);
        let left = slope * at_left - root(at_left);
        let slack = 1e-3 + 1e-3 * (self.bound.max(0.0) * narrow).sqrt() + 1e-6 * hx;
        let x1 = (mean[0] + right + slack).clamp(-1e6, 1e6);
        let x0 = (mean[0] + left - slack).clamp(-1e6, 1e6);
        let c0 = (((x0 - side + 0.5) / side).ceil() as i32).max(0);
        let c1 = (((x1 - 0.5) / side).floor() as i32).min(grid[0] as i32 - 1);
        (c0, c1)
    }

    /// All tiles touched, row by row, as row-major numbers.
    pub fn tiles(&self, mean: [f32; 2], tile: u32, grid: [u32; 2]) -> Vec<u32> {
        let mut all = vec![];
        for row in self.row0..=self.row1 {
            let (c0, c1) = self.columns(mean, row, tile, grid);
            all.extend((c0..=c1).map(|c| row as u32 * grid[0] + c as u32));
        }
        all
    }
}

/// Which bands of `rows` rows of a tile, `bands` of them from `top` on (centre of the first row, px), hold a sample at which
/// alpha can reach the threshold: bit b for band b. `inverse_v` is 1 / V of the factored covariance, px^-2; as in `tiles.glsl`.
pub fn support_bands(mean_y: f32, inverse_v: f32, bound: f32, top: f32, rows: u32, bands: u32) -> u32 {
    let reach = (bound.max(0.0) / inverse_v).sqrt();
    let beyond = |band: &u32| {
        let first = top + (band * rows) as f32;
        first - mean_y > reach || mean_y - (first + (rows - 1) as f32) > reach
    };
    (0..bands).filter(|band| !beyond(band)).fold(0, |mask, band| mask | 1 << band)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::camera::factors;
    use proptest::prelude::*;

    #[test]
    fn bands_are_those_in_reach() {
        // Rows 16.5 to 31.5 in four bands; sqrt(9 / 1) = 3 px reach.
        for (mean_y, wanted) in [(5.0, 0), (13.6, 1), (17.0, 1), (21.0, 0b11), (24.0, 0b110), (34.6, 0), (34.4, 0b1000)]
        {
            assert_eq!(support_bands(mean_y, 1.0, 9.0, 16.5, 4, 4), wanted, "mean {mean_y}");
        }
        // A variance of float32's largest, or none that is known, reaches everything.
        for inverse_v in [0.0, f32::NAN] {
            assert_eq!(support_bands(-1e6, inverse_v, 9.0, 16.5, 4, 4), 0b1111);
        }
    }

    proptest! {
        /// No pixel that can reach the threshold lies outside the tiles found, and no tile found is far from one.
        #[test]
        fn tiles_hold_the_support(
            mx in -40f32..140.0, my in -40f32..120.0, a in 0.0f32..60.0, b in 0.0f32..4.0, angle in 0f32..3.2,
            opacity in 0.003f32..1.0, tile in prop::sample::select(vec![8u32, 16]),
            alpha_min in prop::sample::select(vec![1f32 / 255.0, 1e-3, 0.02]),
        ) {
            let (s, c) = angle.sin_cos();
            let (a2, b2) = (a * a, b * b);
            let covariance = [c * c * a2 + s * s * b2 + 0.3, c * s * (a2 - b2), s * s * a2 + c * c * b2 + 0.3];
            let covariance = factors(covariance.map(f64::from)).map(|v| v as f32);
            let [narrow, slope, variance] = covariance;
            let size = [97u32, 83];
            let grid = size.map(|n| n.div_ceil(tile));
            let bound = support_bound(opacity, alpha_min);
            let bands = |row: u32| support_bands(my, 1.0 / variance, bound, (row * tile) as f32 + 0.5, 2, tile / 2);
            let found = Support::new([mx, my], covariance, (opacity, alpha_min), tile, grid).tiles([mx, my], tile, grid);
            for y in 0..grid[1] * tile {
                for x in 0..grid[0] * tile {
                    let (dx, dy) = (x as f32 + 0.5 - mx, y as f32 + 0.5 - my);
                    let across = dx - slope * dy;
                    let power = -0.5 * (across * across / narrow + dy * dy / variance);
                    if opacity * power.exp() >= alpha_min {
                        let t = y / tile * grid[0] + x / tile;
                        prop_assert!(found.contains(&t), "pixel {x},{y} of tile {t} is missed by {found:?}");
                        prop_assert!(bands(y / tile) >> (y % tile / 2) & 1 == 1, "pixel {x},{y} is missed by its band");
                    }
                }
            }
        }
    }
}

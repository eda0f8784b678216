//! Which tiles a Gaussian touches: the same float32 operations as `glsl/include/tiles.glsl`, because the result is a
//! discrete decision.

/// The ellipse in which a Gaussian's alpha can reach the threshold, and the tile rows it spans.
#[derive(Clone, Copy, Debug)]
pub struct Support {
    bound: f32,
    covariance: [f32; 3],
    narrow: f32,
    half_size: [f32; 2],
    /// First tile row.
    pub row0: i32,
    /// Last tile row; before the first when there is none.
    pub row1: i32,
}

/// 2 ln(opacity / alpha_min), widened by what rounding of the quadratic form may take away.
pub fn support_bound(opacity: f32, alpha_min: f32) -> f32 {
    2.0 * (opacity / alpha_min).ln() * 1.0001 + 1e-3
}

/// Determinant of a covariance xx, xy, yy whose diagonal includes 0.3: at least 0.3 (xx + yy) - 0.09.
pub fn determinant(c: [f32; 3]) -> f32 {
    let product = c[1] * c[1];
    let error = (-c[1]).mul_add(c[1], product);
    (c[0].mul_add(c[2], -product) + error).max(0.3 * (c[0] + c[2]) - 0.09)
}

/// Inverse covariance xx, xy, yy.
pub fn conic(c: [f32; 3]) -> [f32; 3] {
    let det = determinant(c);
    [c[2] / det, -c[1] / det, c[0] / det]
}

impl Support {
    /// Of a Gaussian (mean px, covariance px^2, conic px^-2, opacity and the alpha it must reach) on a grid of square
    /// tiles.
    pub fn new(
        mean: [f32; 2],
        covariance: [f32; 3],
        conic: [f32; 3],
        (opacity, alpha_min): (f32, f32),
        tile: u32,
        grid: [u32; 2],
    ) -> Self {
        let bound = support_bound(opacity, alpha_min);
        let half_size = [covariance[0], covariance[2]].map(|v| (bound.max(0.0) * v).sqrt());
        let side = tile as f32;
        let low = (mean[1] - half_size[1]).clamp(-1e6, 1e6);
        let high = (mean[1] + half_size[1]).clamp(-1e6, 1e6);
        let row0 = (((low - side + 0.5) / side).ceil() as i32).max(0);
        let row1 = (((high - 0.5) / side).floor() as i32).min(grid[1] as i32 - 1);
        let row1 = if bound >= 0.0 { row1 } else { row0 - 1 };
        Self { bound, covariance, narrow: 1.0 / conic[0], half_size, row0, row1 }
    }

    /// First and last tile column of a tile row.
    pub fn columns(&self, mean: [f32; 2], row: i32, tile: u32, grid: [u32; 2]) -> (i32, i32) {
        let side = tile as f32;
        let low = (row * tile as i32) as f32 + 0.5 - mean[1];
        let high = low + side - 1.0;
        let [hx, hy] = self.half_size;
        let (low, high) = (low.max(-hy).min(hy), high.max(-hy).min(hy));
        let [xx, xy, yy] = self.covariance;
        let extreme = xy / xx * hx;
        let (at_right, at_left) = (extreme.max(low).min(high), (-extreme).max(low).min(high));
        let root = |at: f32| ((self.bound - at * at / yy).max(0.0) * self.narrow).sqrt();
        let right = xy / yy * at_right + root(at_right);
        let left = xy / yy * at_left - root(at_left);
        let slack = 1e-3 + 1e-3 * hx;
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

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
            let q = conic(covariance);
            let size = [97u32, 83];
            let grid = size.map(|n| n.div_ceil(tile));
            let found = Support::new([mx, my], covariance, q, (opacity, alpha_min), tile, grid).tiles([mx, my], tile, grid);
            for y in 0..grid[1] * tile {
                for x in 0..grid[0] * tile {
                    let (dx, dy) = (x as f32 + 0.5 - mx, y as f32 + 0.5 - my);
                    let power = -0.5 * (q[0] * dx * dx + q[2] * dy * dy) - q[1] * dx * dy;
                    if opacity * power.exp() >= alpha_min {
                        let t = y / tile * grid[0] + x / tile;
                        prop_assert!(found.contains(&t), "pixel {x},{y} of tile {t} is missed by {found:?}");
                    }
                }
            }
        }
    }
}

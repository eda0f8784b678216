//! Real spherical harmonics up to degree 3, in the order and with the signs of 3D Gaussian Splatting's files: a color is
//! 0.5 plus the sum of coefficients times harmonics of the direction from the camera to the Gaussian.

/// The constant harmonic.
pub const ZEROTH: f64 = 0.28209479177387814;

/// Coefficients of all degrees up to `degree`.
pub const fn coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// The sixteen harmonics of a unit direction.
pub fn harmonics([x, y, z]: [f64; 3]) -> [f64; 16] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        ZEROTH,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    ]
}

/// What takes the coefficients of a color to those of the same color in turned axes, by row: `turn` brings a direction of
/// the first axes into the second. Degrees do not mix. The integral over the sphere of a harmonic there times one here, by
/// Gauss-Legendre quadrature in z, exact to degree 7 with four nodes, and equal steps in the angle, exact below the ninth.
pub fn turned(turn: impl Fn([f64; 3]) -> [f64; 3]) -> [[f64; 16]; 16] {
    let nodes = [(0.3399810435848563, 0.6521451548625461), (0.8611363115940526, 0.3478548451374538)];
    let mut sums = [[0.0; 16]; 16];
    for (z, weight) in nodes.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
        for step in 0..9 {
            let (sin, cos) = (std::f64::consts::TAU * f64::from(step) / 9.0).sin_cos();
            let r = f64::sqrt(1.0 - z * z);
            let here = [r * cos, r * sin, z];
            let (here, there) = (harmonics(here), harmonics(turn(here)));
            for (row, there) in sums.iter_mut().zip(there) {
                row.iter_mut()
                    .zip(here)
                    .for_each(|(s, here)| *s += there * here * weight * std::f64::consts::TAU / 9.0);
            }
        }
    }
    sums
}

/// Signs that the coefficients take when the scene is turned half round the x axis, (x, y, z) to (x, -y, -z).
pub const HALF_TURN_ABOUT_X: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

#[cfg(test)]
mod tests {
    use super::*;

    /// Orthonormal on the sphere, by Gauss-Legendre quadrature in z (exact to degree 7 with four nodes) and equal steps
    /// in the angle (exact below the ninth).
    #[test]
    fn harmonics_are_orthonormal() {
        let nodes = [(0.3399810435848563, 0.6521451548625461), (0.8611363115940526, 0.3478548451374538)];
        let mut sums = [[0.0; 16]; 16];
        for (node, weight) in nodes.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
            for step in 0..9 {
                let (sin, cos) = (std::f64::consts::TAU * f64::from(step) / 9.0).sin_cos();
                let r = f64::sqrt(1.0 - node * node);
                let h = harmonics([r * cos, r * sin, node]);
                for (i, row) in sums.iter_mut().enumerate() {
                    row.iter_mut().zip(h).for_each(|(s, v)| *s += h[i] * v * weight * std::f64::consts::TAU / 9.0);
                }
            }
        }
        for (i, row) in sums.iter().enumerate() {
            for (k, sum) in row.iter().enumerate() {
                assert!((sum - f64::from(u8::from(i == k))).abs() < 1e-12, "{i} {k}: {sum}");
            }
        }
    }

    /// A color in turned axes is the color: on directions that the quadrature does not know.
    #[test]
    fn turned_coefficients_show_the_same() {
        let (s, c) = 0.7f64.sin_cos();
        let turn = |[x, y, z]: [f64; 3]| [c * x - s * z, y, s * x + c * z];
        let turn = |v: [f64; 3]| {
            let [x, y, z] = turn(v);
            [c * x + s * y, c * y - s * x, z]
        };
        let matrix = turned(turn);
        let before: [f64; 16] = std::array::from_fn(|k| (k as f64 * 1.7).sin());
        let after: [f64; 16] = matrix.map(|row| row.iter().zip(before).map(|(m, v)| m * v).sum());
        for d in [[0.36, -0.48, 0.8], [0.0, 0.6, -0.8], [-1.0, 0.0, 0.0]] {
            let value = |coefficients: [f64; 16], d: [f64; 3]| -> f64 {
                harmonics(d).iter().zip(coefficients).map(|(h, v)| h * v).sum()
            };
            assert!((value(before, d) - value(after, turn(d))).abs() < 1e-13);
        }
    }

    #[test]
    fn a_half_turn_is_a_matter_of_signs() {
        let [x, y, z] = [0.36, -0.48, 0.8];
        let (before, after) = (harmonics([x, y, z]), harmonics([x, -y, -z]));
        for k in 0..16 {
            assert!((before[k] * f64::from(HALF_TURN_ABOUT_X[k]) - after[k]).abs() < 1e-15, "{k}");
        }
    }
}

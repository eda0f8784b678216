//! Bidirectional cross-attention in float64 (GScream, equation 8): its weights, and what the kernels' twins share.

#[cfg(test)]
pub mod exact;

/// Heads of the attention.
pub const HEADS: usize = 8;
/// Numbers of a head.
pub const HEAD: usize = 64;
/// Numbers of a token's queries, keys or values over all heads.
pub const INNER: usize = HEADS * HEAD;
/// Numbers of a token's features.
pub const FEATURE: usize = 32;

/// The tensors of the flat weights: name, shape (rows, columns; a bias has one column), first element.
pub const TENSORS: [(&str, [usize; 2], usize); 8] = [
    ("to_qk.weight", [INNER, FEATURE], 0),
    ("context_to_qk.weight", [INNER, FEATURE], MATRIX),
    ("to_v.weight", [INNER, FEATURE], 2 * MATRIX),
    ("context_to_v.weight", [INNER, FEATURE], 3 * MATRIX),
    ("to_out.weight", [FEATURE, INNER], 4 * MATRIX),
    ("to_out.bias", [FEATURE, 1], 5 * MATRIX),
    ("context_to_out.weight", [FEATURE, INNER], 5 * MATRIX + FEATURE),
    ("context_to_out.bias", [FEATURE, 1], 6 * MATRIX + FEATURE),
];
/// Weights of a matrix.
pub const MATRIX: usize = INNER * FEATURE;
/// Number of all weights.
pub const WEIGHTS: usize = 6 * MATRIX + 2 * FEATURE;

/// First elements of a side's tensors in the weights.
#[derive(Clone, Copy, Debug)]
pub struct Offsets {
    /// Queries-or-keys, (512, 32).
    pub to_qk: usize,
    /// Values, (512, 32).
    pub to_v: usize,
    /// Output projection, (32, 512), its bias behind it.
    pub to_out: usize,
}

/// Where the weights of a side are: 0 inside, 1 around.
pub const SIDES: [Offsets; 2] = [
    Offsets { to_qk: 0, to_v: 2 * MATRIX, to_out: 4 * MATRIX },
    Offsets { to_qk: MATRIX, to_v: 3 * MATRIX, to_out: 5 * MATRIX + FEATURE },
];

/// Scalar product.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// `x` (n, columns) times the transpose of `w` (rows, columns).
pub fn linear(x: &[f64], w: &[f64], columns: usize) -> Vec<f64> {
    x.chunks(columns).flat_map(|x| w.chunks(columns).map(move |w| dot(x, w))).collect()
}

/// The transpose of `a` (n, rows) times `b` (n, columns).
pub fn outer(a: &[f64], rows: usize, b: &[f64], columns: usize) -> Vec<f64> {
    let mut sum = vec![0.0; rows * columns];
    for (a, b) in a.chunks(rows).zip(b.chunks(columns)) {
        for (sum, a) in sum.chunks_mut(columns).zip(a) {
            sum.iter_mut().zip(b).for_each(|(s, b)| *s += a * b);
        }
    }
    sum
}

/// `x` (n, rows) times `w` (rows, columns).
pub fn times(x: &[f64], w: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    let mut all = vec![];
    for x in x.chunks(rows) {
        let mut y = vec![0.0; columns];
        for (x, w) in x.iter().zip(w.chunks(columns)) {
            y.iter_mut().zip(w).for_each(|(y, w)| *y += x * w);
        }
        all.extend(y);
    }
    all
}

/// A token's numbers of one head.
pub fn head(x: &[f64], token: usize, head: usize) -> &[f64] {
    &x[token * INNER + head * HEAD..][..HEAD]
}

/// Largest logit and inverse sum of exponentials of a row.
pub fn softmax_row(logits: &[f64]) -> (f64, f64) {
    let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (top, 1.0 / logits.iter().map(|s| (s - top).exp()).sum::<f64>())
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::exact::{backward, forward};
    use super::*;

    /// Central differences of a scalar over every 997th weight and some features: error O(h^2) of 1e-9 and rounding of
    /// 1e-16 / h, both below the bound.
    #[test]
    fn backward_is_the_derivative_of_forward() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut values = |n: usize, bound: f64| (0..n).map(|_| rng.random_range(-bound..bound)).collect::<Vec<f64>>();
        let features = [values(5 * FEATURE, 1.5), values(3 * FEATURE, 1.5)];
        let upstream = [values(5 * FEATURE, 1.0), values(3 * FEATURE, 1.0)];
        let weights = values(WEIGHTS, 0.2);
        let loss = |features: &[Vec<f64>; 2], weights: &[f64]| {
            let f = forward([&features[0], &features[1]], weights);
            dot(&f.updated[0], &upstream[0]) + dot(&f.updated[1], &upstream[1])
        };
        let kept = forward([&features[0], &features[1]], &weights);
        let (grad_features, grad_weights) =
            backward([&features[0], &features[1]], &weights, &kept, [&upstream[0], &upstream[1]]);
        let h = 1e-5;
        let close = |numeric: f64, analytic: f64, what: &str| {
            assert!((numeric - analytic).abs() < 1e-8 * (1.0 + analytic.abs()), "{what}: {numeric}, {analytic}");
        };
        for i in (0..WEIGHTS).step_by(997) {
            let at = |h: f64| {
                let mut w = weights.clone();
                w[i] += h;
                loss(&features, &w)
            };
            close((at(h) - at(-h)) / (2.0 * h), grad_weights[i], &format!("weight {i}"));
        }
        for side in 0..2 {
            for i in (0..features[side].len()).step_by(7) {
                let at = |h: f64| {
                    let mut f = features.clone();
                    f[side][i] += h;
                    loss(&f, &weights)
                };
                close((at(h) - at(-h)) / (2.0 * h), grad_features[side][i], &format!("side {side}, feature {i}"));
            }
        }
        assert!(grad_weights.iter().filter(|g| **g == 0.0).count() < 10, "every weight has a gradient");
    }
}

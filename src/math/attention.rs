//! Bidirectional cross-attention in float64, dense: what the fused kernels must give (GScream, equation 8).

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
const MATRIX: usize = INNER * FEATURE;
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

fn add(to: &mut [f64], factor: f64, x: &[f64]) {
    to.iter_mut().zip(x).for_each(|(to, x)| *to += factor * x);
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

fn head_mut(x: &mut [f64], token: usize, head: usize) -> &mut [f64] {
    &mut x[token * INNER + head * HEAD..][..HEAD]
}

/// Largest logit and inverse sum of exponentials of a row.
pub fn softmax_row(logits: &[f64]) -> (f64, f64) {
    let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (top, 1.0 / logits.iter().map(|s| (s - top).exp()).sum::<f64>())
}

/// What [`forward`] keeps for [`backward`].
#[derive(Clone, Debug, Default)]
pub struct Forward {
    qk: [Vec<f64>; 2],
    value: [Vec<f64>; 2],
    /// Per head, direction and own token: attention to every token of the other side.
    share: Vec<[Vec<f64>; 2]>,
    mixed: [Vec<f64>; 2],
    /// Attended features of both sides.
    pub updated: [Vec<f64>; 2],
}

/// Attended features of both sides (n, 32) and (m, 32); empty where a side is empty.
pub fn forward(features: [&[f64]; 2], weights: &[f64]) -> Forward {
    let n = features.map(|f| f.len() / FEATURE);
    if n.contains(&0) {
        return Forward::default();
    }
    let matrix = |at: usize| &weights[at..at + MATRIX];
    let project = |at: [usize; 2]| [0, 1].map(|side| linear(features[side], matrix(at[side]), FEATURE));
    let qk = project(SIDES.map(|s| s.to_qk));
    let value = project(SIDES.map(|s| s.to_v));
    let mut mixed = n.map(|n| vec![0.0; n * INNER]);
    let mut share = vec![];
    for h in 0..HEADS {
        let mut of_head = n.map(|own| Vec::with_capacity(own * n[0] * n[1] / own));
        for (own, share) in of_head.iter_mut().enumerate() {
            let other = 1 - own;
            for i in 0..n[own] {
                let logits: Vec<f64> =
                    (0..n[other]).map(|j| dot(head(&qk[own], i, h), head(&qk[other], j, h)) / 8.0).collect();
                let (top, inverse) = softmax_row(&logits);
                let row: Vec<f64> = logits.iter().map(|s| (s - top).exp() * inverse).collect();
                let mix = head_mut(&mut mixed[own], i, h);
                for (j, p) in row.iter().enumerate() {
                    mix.iter_mut().zip(head(&value[other], j, h)).for_each(|(m, v)| *m += p * v);
                }
                share.extend(row);
            }
        }
        share.push(of_head);
    }
    let updated = [0, 1].map(|side| {
        let mut y = linear(&mixed[side], matrix(SIDES[side].to_out), INNER);
        let bias = &weights[SIDES[side].to_out + MATRIX..][..FEATURE];
        y.chunks_mut(FEATURE).for_each(|y| y.iter_mut().zip(bias).for_each(|(y, b)| *y += b));
        y
    });
    Forward { qk, value, share, mixed, updated }
}

/// Gradients of both sides' features and of all weights, given those of the attended features.
pub fn backward(
    features: [&[f64]; 2],
    weights: &[f64],
    forward: &Forward,
    grad_updated: [&[f64]; 2],
) -> ([Vec<f64>; 2], Vec<f64>) {
    let n = features.map(|f| f.len() / FEATURE);
    let mut grad_weights = vec![0.0; WEIGHTS];
    if n.contains(&0) {
        return (n.map(|n| vec![0.0; n * FEATURE]), grad_weights);
    }
    let Forward { qk, value, share, mixed, .. } = forward;
    let matrix = |at: usize| &weights[at..at + MATRIX];
    let grad_mixed = [0, 1].map(|s| times(grad_updated[s], matrix(SIDES[s].to_out), FEATURE, INNER));
    let mut grad_qk = n.map(|n| vec![0.0; n * INNER]);
    let mut grad_value = grad_qk.clone();
    for (h, share) in share.iter().enumerate() {
        for own in 0..2 {
            let other = 1 - own;
            for i in 0..n[own] {
                let row = &share[own][i * n[other]..][..n[other]];
                let grad = head(&grad_mixed[own], i, h);
                let product = dot(grad, head(&mixed[own], i, h));
                for (j, p) in row.iter().enumerate() {
                    let s = p * (dot(grad, head(&value[other], j, h)) - product) / 8.0;
                    add(head_mut(&mut grad_value[other], j, h), *p, grad);
                    add(head_mut(&mut grad_qk[own], i, h), s, head(&qk[other], j, h));
                    add(head_mut(&mut grad_qk[other], j, h), s, head(&qk[own], i, h));
                }
            }
        }
    }
    let grad_features = [0, 1].map(|s| {
        let a = times(&grad_qk[s], matrix(SIDES[s].to_qk), INNER, FEATURE);
        let b = times(&grad_value[s], matrix(SIDES[s].to_v), INNER, FEATURE);
        a.iter().zip(&b).map(|(a, b)| a + b).collect()
    });
    for s in 0..2 {
        let Offsets { to_qk, to_v, to_out } = SIDES[s];
        grad_weights[to_qk..][..MATRIX].copy_from_slice(&outer(&grad_qk[s], INNER, features[s], FEATURE));
        grad_weights[to_v..][..MATRIX].copy_from_slice(&outer(&grad_value[s], INNER, features[s], FEATURE));
        grad_weights[to_out..][..MATRIX].copy_from_slice(&outer(grad_updated[s], FEATURE, &mixed[s], INNER));
        for g in grad_updated[s].chunks(FEATURE) {
            grad_weights[to_out + MATRIX..][..FEATURE].iter_mut().zip(g).for_each(|(b, g)| *b += g);
        }
    }
    (grad_features, grad_weights)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

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

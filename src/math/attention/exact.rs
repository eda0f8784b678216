//! Dense: what the fused kernels must give. The golden cases have it as their own, too.

use super::*;

fn add(to: &mut [f64], factor: f64, x: &[f64]) {
    to.iter_mut().zip(x).for_each(|(to, x)| *to += factor * x);
}

fn head_mut(x: &mut [f64], token: usize, head: usize) -> &mut [f64] {
    &mut x[token * INNER + head * HEAD..][..HEAD]
}

/// Values that [`forward`] keeps for [`backward`].
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

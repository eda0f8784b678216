//! The decoders' derivative, which the kernels of the way back must give.

use super::*;

/// One anchor's gradients.
#[derive(Clone, Debug)]
pub struct AnchorGradient {
    /// \[K\]
    pub offset: Vec<[f64; 3]>,
    /// Offsets 3, Gaussians 3.
    pub log_scaling: [f64; 6],
    /// Gradient of the feature.
    pub feature: [f64; FEATURE],
}

/// Backward of [`decode`]; adds to the weights' gradient.
#[allow(clippy::too_many_arguments, reason = "decode's arguments, its gradient and the sum")]
pub fn decode_backward(
    layout: Layout,
    weights: &[f64],
    input: &[f64; INPUT],
    anchor: [f64; 3],
    offset: &[[f64; 3]],
    log_scaling: [f64; 6],
    grad: &[Gaussian],
    grad_weights: &mut [f64],
) -> AnchorGradient {
    let hidden = hidden(layout, weights, input);
    let gaussians = decode(layout, weights, input, anchor, offset, log_scaling);
    let mut sum = AnchorGradient { offset: vec![], log_scaling: [0.0; 6], feature: [0.0; FEATURE] };
    let mut grad_hidden = [[0.0; HIDDEN]; HEADS];
    for (k, gaussian) in gaussians.iter().enumerate() {
        let g = activate_backward(gaussian, offset[k], log_scaling, &grad[k]);
        sum.offset.push(g.offset);
        for i in 0..6 {
            sum.log_scaling[i] += g.log_scaling[i];
        }
        for (raw, (head, output)) in g.raw.into_iter().zip(outputs_of(k)) {
            for j in 0..HIDDEN {
                grad_hidden[head][j] += raw * weights[layout.second(head, output, j)];
                grad_weights[layout.second(head, output, j)] += raw * hidden[head][j];
            }
            grad_weights[layout.second(head, output, HIDDEN)] += raw;
        }
    }
    for head in 0..HEADS {
        for unit in (0..HIDDEN).filter(|&unit| hidden[head][unit] > 0.0) {
            let g = grad_hidden[head][unit];
            for i in 0..INPUT {
                grad_weights[layout.first(head, unit, i)] += g * input[i];
                if i < FEATURE {
                    sum.feature[i] += g * weights[layout.first(head, unit, i)];
                }
            }
            grad_weights[layout.first(head, unit, INPUT)] += g;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    /// Every gradient against central differences, all inputs and all weights of one anchor.
    #[test]
    fn gradients_are_the_decoders_derivatives() {
        let layout = Layout { offsets: 3 };
        let mut rng = Pcg64::seed_from_u64(1);
        let mut random =
            |n: usize, size: f64| -> Vec<f64> { (0..n).map(|_| size * (2.0 * rng.random::<f64>() - 1.0)).collect() };
        let weights = random(layout.weights(), 0.3);
        let rest = random(FEATURE + 9 + 6, 1.0);
        let upstream: Vec<Gaussian> = (0..3)
            .map(|_| {
                let r = random(14, 1.0);
                Gaussian {
                    position: [r[0], r[1], r[2]],
                    opacity: r[3],
                    color: [r[4], r[5], r[6]],
                    scale: [r[7], r[8], r[9]],
                    rotation: [r[10], r[11], r[12], r[13]],
                    norm: 0.0,
                }
            })
            .collect();
        let anchor = [0.3, -0.4, 0.5];
        let split = |rest: &[f64]| {
            let x = input(std::array::from_fn(|i| rest[i]), [0.3, -0.6, 3.5]);
            let offset: Vec<[f64; 3]> = rest[32..41].chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
            (x, offset, std::array::from_fn(|i| rest[41 + i]))
        };
        let value = |weights: &[f64], rest: &[f64]| -> f64 {
            let (x, offset, log_scaling) = split(rest);
            let gaussians = decode(layout, weights, &x, anchor, &offset, log_scaling);
            gaussians
                .iter()
                .zip(&upstream)
                .map(|(g, u)| {
                    let pairs = g.position.into_iter().zip(u.position).chain(g.color.into_iter().zip(u.color));
                    let pairs =
                        pairs.chain(g.scale.into_iter().zip(u.scale)).chain(g.rotation.into_iter().zip(u.rotation));
                    pairs.map(|(a, b)| a * b).sum::<f64>() + g.opacity * u.opacity
                })
                .sum()
        };
        let (x, offset, log_scaling) = split(&rest);
        let mut grad_weights = vec![0.0; weights.len()];
        let got = decode_backward(layout, &weights, &x, anchor, &offset, log_scaling, &upstream, &mut grad_weights);
        let got: Vec<f64> =
            got.feature.into_iter().chain(got.offset.into_iter().flatten()).chain(got.log_scaling).collect();
        // Fourth order, step 1e-3: truncation below 1e-10, rounding 1e-16 / 1e-3; a ReLU's kink within a step is
        // excluded by the seed.
        let difference = |at: &dyn Fn(f64) -> f64| {
            let h = 1e-3;
            (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)
        };
        for (i, got) in got.iter().enumerate() {
            let want = difference(&|h| {
                let mut moved = rest.clone();
                moved[i] += h;
                value(&weights, &moved)
            });
            assert!((got - want).abs() < 1e-8, "input {i}: {got} instead of {want}");
        }
        for (i, got) in grad_weights.iter().enumerate() {
            let want = difference(&|h| {
                let mut moved = weights.clone();
                moved[i] += h;
                value(&moved, &rest)
            });
            assert!((got - want).abs() < 1e-8, "weight {i}: {got} instead of {want}");
        }
        assert!(grad_weights.iter().filter(|g| **g != 0.0).count() > layout.weights() / 3);
    }

    /// PyTorch's `normalize`: a quaternion shorter than its epsilon is divided by the epsilon.
    #[test]
    fn short_quaternions_are_divided_by_epsilon() {
        let g = activate([0.0; 11], [0.0; 3], [0.0; 3], [0.0; 6]);
        assert_eq!((g.rotation, g.norm), ([0.0; 4], 0.0));
        let upstream = Gaussian { rotation: [1.0, 0.0, 0.0, 0.0], ..Gaussian::default() };
        let back = activate_backward(&g, [0.0; 3], [0.0; 6], &upstream);
        assert_eq!(back.raw[7], 1.0 / NORM_EPSILON);
    }
}

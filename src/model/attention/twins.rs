//! The kernels' twins.

use super::*;
use crate::gpu::kernels::model::{
    attention_backward, attention_forward, attention_output, attention_output_backward, attention_project,
    attention_project_backward, attention_skip, attention_weight_backward, attention_weight_sum, cpu,
};
use crate::gpu::{Check, Reference};
use crate::math::attention::{FEATURE, HEAD, HEADS, INNER, SIDES, dot, softmax_row};

/// Tokens of the own and the other side, clamped; both 0 where one is empty.
fn sides(tokens: &[u32], own: u32, capacity: u32) -> (usize, usize) {
    let count = |side: u32| tokens[side as usize].min(capacity) as usize;
    let (n, m) = (count(own), count(1 - own));
    if n == 0 || m == 0 { (0, 0) } else { (n, m) }
}

fn widen<const C: usize>(values: &[[f32; C]]) -> Vec<f64> {
    values.as_flattened().iter().copied().map(f64::from).collect()
}

pub(super) fn head_of(x: &[f64], token: usize, head: usize) -> &[f64] {
    crate::math::attention::head(x, token, head)
}

impl Reference for attention_project::Kernel {
    fn reference(host: attention_project::Host<'_>, push: attention_project::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let (feature, weights) = (widen(&host.feature[..n * 8]), widen(host.weights));
        for (out, at) in [(host.qk, push.to_qk), (host.value, push.to_v)] {
            let matrix = &weights[4 * at as usize..][..INNER * FEATURE];
            let y = crate::math::attention::linear(&feature, matrix, FEATURE);
            out.as_flattened_mut().iter_mut().zip(y).for_each(|(out, y)| *out = y as f32);
        }
    }
}

/// The softmax of a row is right to about (3 + 2 |x|) units of the exponential (Vulkan's bound, x at most some tens
/// where it matters) plus the logit's own error of some 20 units times its terms.
const SOFTMAX: Check = Check { relative: 2e-5, absolute: 5e-6, band: 0.0 };

impl Reference for attention_forward::Kernel {
    fn reference(host: attention_forward::Host<'_>, push: attention_forward::Push, (): ()) {
        let (n, m) = sides(host.tokens, push.own, push.capacity);
        let (query, key, value) = (widen(host.query), widen(host.key), widen(host.value));
        let mixed = host.mixed.as_flattened_mut();
        for (i, h) in (0..n).flat_map(|i| (0..HEADS).map(move |h| (i, h))) {
            let q = head_of(&query, i, h);
            let logits: Vec<f64> = (0..m).map(|j| dot(q, head_of(&key, j, h)) / 8.0).collect();
            let (top, inverse) = softmax_row(&logits);
            let mut sum = [0.0; HEAD];
            for (j, s) in logits.iter().enumerate() {
                let p = (s - top).exp() * inverse;
                sum.iter_mut().zip(head_of(&value, j, h)).for_each(|(sum, v)| *sum += p * v);
            }
            for (out, sum) in mixed[i * INNER + h * HEAD..].iter_mut().zip(sum) {
                *out = sum as f32;
            }
            host.softmax[i * HEADS + h] = [top as f32, inverse as f32];
        }
    }

    fn check(_: &'static str) -> Check {
        SOFTMAX
    }
}

impl Reference for attention_output::Kernel {
    fn reference(host: attention_output::Host<'_>, push: attention_output::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let (mixed, weights) = (widen(&host.mixed[..n * INNER / 4]), widen(host.weights));
        let matrix = &weights[4 * push.to_out as usize..];
        let y = crate::math::attention::linear(&mixed, &matrix[..INNER * FEATURE], INNER);
        for (i, (out, y)) in host.updated.as_flattened_mut().iter_mut().zip(y).enumerate() {
            *out = (y + matrix[INNER * FEATURE + i % FEATURE]) as f32;
        }
    }
}

impl Reference for attention_output_backward::Kernel {
    fn reference(host: attention_output_backward::Host<'_>, push: attention_output_backward::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let (grad, weights) = (widen(&host.grad_updated[..n * 8]), widen(host.weights));
        let mixed = widen(&host.mixed[..n * INNER / 4]);
        let matrix = &weights[4 * push.to_out as usize..][..INNER * FEATURE];
        let grad_mixed = crate::math::attention::times(&grad, matrix, FEATURE, INNER);
        for (out, g) in host.grad_mixed.as_flattened_mut().iter_mut().zip(&grad_mixed) {
            *out = *g as f32;
        }
        for (i, h) in (0..n).flat_map(|i| (0..HEADS).map(move |h| (i, h))) {
            let [top, inverse] = host.softmax[i * HEADS + h];
            host.rows[i * HEADS + h] = [top, inverse, dot(head_of(&grad_mixed, i, h), head_of(&mixed, i, h)) as f32];
        }
    }
}

impl Reference for attention_backward::Kernel {
    fn reference(host: attention_backward::Host<'_>, push: attention_backward::Push, (): ()) {
        let (n, m) = sides(host.tokens, push.own, push.capacity);
        let [q, v, g, oq, ov, og] =
            [host.qk, host.value, host.grad_mixed, host.other_qk, host.other_value, host.other_grad_mixed].map(widen);
        let (rows, others) = (widen(host.rows), widen(host.other_rows));
        for (i, h) in (0..n).flat_map(|i| (0..HEADS).map(move |h| (i, h))) {
            let (mut grad_qk, mut grad_value) = ([0.0; HEAD], [0.0; HEAD]);
            let row = &rows[3 * (i * HEADS + h)..];
            for j in 0..m {
                let other = &others[3 * (j * HEADS + h)..];
                let logit = dot(head_of(&q, i, h), head_of(&oq, j, h)) / 8.0;
                let p = (logit - row[0]).exp() * row[1];
                let r = (logit - other[0]).exp() * other[1];
                let s = p * (dot(head_of(&g, i, h), head_of(&ov, j, h)) - row[2])
                    + r * (dot(head_of(&v, i, h), head_of(&og, j, h)) - other[2]);
                for d in 0..HEAD {
                    grad_qk[d] += s * head_of(&oq, j, h)[d] / 8.0;
                    grad_value[d] += r * head_of(&og, j, h)[d];
                }
            }
            let at = i * INNER + h * HEAD;
            for d in 0..HEAD {
                host.grad_qk.as_flattened_mut()[at + d] = grad_qk[d] as f32;
                host.grad_value.as_flattened_mut()[at + d] = grad_value[d] as f32;
            }
        }
    }

    fn check(_: &'static str) -> Check {
        SOFTMAX
    }
}

impl Reference for cpu::attention_pairs_backward::Kernel {
    fn reference(host: cpu::attention_pairs_backward::Host<'_>, push: cpu::attention_pairs_backward::Push, (): ()) {
        let (n, m) = sides(host.tokens, 0, push.capacity);
        let [q, v, g, oq, ov, og] =
            [host.qk, host.value, host.grad_mixed, host.other_qk, host.other_value, host.other_grad_mixed].map(widen);
        let (rows, others) = (widen(host.rows), widen(host.other_rows));
        let [inside, around, grad_s] =
            [host.inside_share, host.around_share, host.grad_s].map(<[[f32; 4]]>::as_flattened_mut);
        for (j, h) in (0..m).flat_map(|j| (0..HEADS).map(move |h| (j, h))) {
            let other = &others[3 * (j * HEADS + h)..];
            let at = 4 * (h * push.capacity as usize + j) * push.stride as usize;
            // To the end of a vector: zero behind the last token.
            for of in [&mut *inside, &mut *around, &mut *grad_s] {
                of[at..at + n.next_multiple_of(4)].fill(0.0);
            }
            for i in 0..n {
                let row = &rows[3 * (i * HEADS + h)..];
                let logit = dot(head_of(&q, i, h), head_of(&oq, j, h)) / 8.0;
                let p = (logit - row[0]).exp() * row[1];
                let r = (logit - other[0]).exp() * other[1];
                let s = p * (dot(head_of(&g, i, h), head_of(&ov, j, h)) - row[2])
                    + r * (dot(head_of(&v, i, h), head_of(&og, j, h)) - other[2]);
                (inside[at + i], around[at + i], grad_s[at + i]) = (p as f32, r as f32, (s / 8.0) as f32);
            }
        }
    }

    fn check(_: &'static str) -> Check {
        SOFTMAX
    }
}

impl Reference for cpu::attention_pairs_apply::Kernel {
    fn reference(host: cpu::attention_pairs_apply::Host<'_>, push: cpu::attention_pairs_apply::Push, (): ()) {
        let inside = host.kernel == cpu::attention_pairs_apply::Kernel::Inside;
        let (n, m) = sides(host.tokens, if inside { 0 } else { 1 }, push.capacity);
        let (pairs, other) = (host.pairs.as_flattened(), widen(host.other));
        for (i, h) in (0..n).flat_map(|i| (0..HEADS).map(move |h| (i, h))) {
            let mut sum = [0.0; HEAD];
            for j in 0..m {
                let (of_around, of_inside) = if inside { (j, i) } else { (i, j) };
                let row = h * push.capacity as usize + of_around;
                let weight = f64::from(pairs[4 * row * push.stride as usize + of_inside]);
                sum.iter_mut().zip(head_of(&other, j, h)).for_each(|(sum, x)| *sum += weight * x);
            }
            for (out, sum) in host.applied.as_flattened_mut()[i * INNER + h * HEAD..].iter_mut().zip(sum) {
                *out = sum as f32;
            }
        }
    }

    /// As many terms as there are tokens, which may cancel.
    fn check(_: &'static str) -> Check {
        Check { relative: 1e-5, absolute: 4e-6, band: 0.0 }
    }
}

impl Reference for attention_project_backward::Kernel {
    fn reference(host: attention_project_backward::Host<'_>, push: attention_project_backward::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let weights = widen(host.weights);
        let [a, b] = [(host.grad_qk, push.to_qk), (host.grad_value, push.to_v)].map(|(grad, at)| {
            let matrix = &weights[4 * at as usize..][..INNER * FEATURE];
            crate::math::attention::times(&widen(&grad[..n * INNER / 4]), matrix, INNER, FEATURE)
        });
        for ((out, a), b) in host.grad_feature.as_flattened_mut().iter_mut().zip(a).zip(b) {
            *out = (a + b) as f32;
        }
    }

    /// A thousand terms that may cancel.
    fn check(_: &'static str) -> Check {
        Check { relative: 1e-5, absolute: 4e-6, band: 0.0 }
    }
}

impl Reference for attention_weight_backward::Kernel {
    /// `Gpu`: a sum for every slice of the tokens, and none without tokens; `Cpu`: one sum of all.
    fn reference(host: attention_weight_backward::Host<'_>, push: attention_weight_backward::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let (rows, columns) = (4 * push.rows as usize, 4 * push.columns as usize);
        let all = rows * columns + if push.bias != 0 { rows } else { 0 };
        let (slices, out) = match (host.partial, host.grad_weights) {
            (Some(partial), _) => (if n == 0 { 0 } else { SLICES }, partial.as_flattened_mut()),
            (_, Some(whole)) => (1, &mut whole.as_flattened_mut()[4 * push.matrix as usize..]),
            _ => unreachable!("every variant has somewhere to write"),
        };
        let (grad, input) = (widen(host.grad_output), widen(host.inputs));
        let length = n.div_ceil(slices.max(1));
        for (slice, out) in out.chunks_mut(all).take(slices).enumerate() {
            let tokens = (slice * length).min(n)..((slice + 1) * length).min(n);
            let grad = &grad[tokens.start * rows..tokens.end * rows];
            let input = &input[tokens.start * columns..tokens.end * columns];
            let sum = crate::math::attention::outer(grad, rows, input, columns);
            out.iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
            if push.bias != 0 {
                let sum = crate::math::attention::outer(grad, rows, &vec![1.0; tokens.len()], 1);
                out[rows * columns..].iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
            }
        }
    }
}

impl Reference for attention_weight_sum::Kernel {
    fn reference(host: attention_weight_sum::Host<'_>, (): (), (): ()) {
        let none = host.tokens[0] == 0 || host.tokens[1] == 0;
        let partials = [
            (host.inside_qk, SIDES[0].to_qk),
            (host.around_qk, SIDES[1].to_qk),
            (host.inside_value, SIDES[0].to_v),
            (host.around_value, SIDES[1].to_v),
            (host.inside_out, SIDES[0].to_out),
            (host.around_out, SIDES[1].to_out),
        ];
        let grad_weights = host.grad_weights.as_flattened_mut();
        for (partial, at) in partials {
            let partial = partial.as_flattened();
            let all = partial.len() / SLICES;
            for (i, out) in grad_weights[at..at + all].iter_mut().enumerate() {
                let sum: f64 = (0..SLICES).map(|s| f64::from(partial[s * all + i])).sum();
                *out = if none { 0.0 } else { sum as f32 };
            }
        }
    }
}

impl Reference for attention_skip::Kernel {
    fn reference(host: attention_skip::Host<'_>, (): (), (): ()) {
        let [inside, around] = [0, 1].map(|side| if host.overflow[0] != 0 { 0 } else { host.tokens[side] });
        host.skip[..3].copy_from_slice(&[u32::from(inside == 0 || around == 0), inside, around]);
    }
}

//! Bidirectional cross-attention between the anchors inside the mask and those around it (GScream, equation 8): 8 heads
//! of 64, one similarity for both directions, softmax along each side.
//!
//! No similarity matrix is stored. The forward pass keeps the largest logit and the inverse sum of exponentials of every
//! row (apart, not as one logarithm: at logits of 1e4 the sum of the two would lose three digits), the backward pass
//! forms the shares again from them. As the two directions differ only in who asks, they run the same kernels with the
//! bindings swapped, and the backward pass treats both at once for the tokens it owns.

use rand::{Rng, RngExt};

use crate::gpu::kernels::model::{
    attention_backward, attention_backward_lanes, attention_forward, attention_forward_lanes, attention_output,
    attention_output_backward, attention_output_backward_lanes, attention_output_lanes, attention_pairs_apply,
    attention_pairs_apply_inside, attention_pairs_backward, attention_project, attention_project_backward,
    attention_project_backward_lanes, attention_project_lanes, attention_skip, attention_weight_backward,
    attention_weight_backward_lanes, attention_weight_sum,
};
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference};
use crate::math::attention::{FEATURE, HEAD, HEADS, INNER, Offsets, SIDES, dot, softmax_row};
pub use crate::math::attention::{TENSORS, WEIGHTS};

/// Slices of the tokens in the sum of a weight's gradient: the kernels'.
const SLICES: usize = 8;

/// Tokens of the own and the other side, clamped; both 0 where one is empty.
fn sides(tokens: &[u32], own: u32, capacity: u32) -> (usize, usize) {
    let count = |side: u32| tokens[side as usize].min(capacity) as usize;
    let (n, m) = (count(own), count(1 - own));
    if n == 0 || m == 0 { (0, 0) } else { (n, m) }
}

fn widen<const C: usize>(values: &[[f32; C]]) -> Vec<f64> {
    values.as_flattened().iter().copied().map(f64::from).collect()
}

fn head_of(x: &[f64], token: usize, head: usize) -> &[f64] {
    crate::math::attention::head(x, token, head)
}

macro_rules! project_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
                let (n, _) = sides(host.tokens, push.own, push.capacity);
                let (feature, weights) = (widen(&host.feature[..n * 8]), widen(host.weights));
                for (out, at) in [(host.qk, push.to_qk), (host.value, push.to_v)] {
                    let matrix = &weights[4 * at as usize..][..INNER * FEATURE];
                    let y = crate::math::attention::linear(&feature, matrix, FEATURE);
                    out.as_flattened_mut().iter_mut().zip(y).for_each(|(out, y)| *out = y as f32);
                }
            }
        }
    };
}
project_twin!(attention_project);
project_twin!(attention_project_lanes);

/// The softmax of a row is right to about (3 + 2 |x|) units of the exponential (Vulkan's bound, x at most some tens
/// where it matters) plus the logit's own error of some 20 units times its terms.
const SOFTMAX: Check = Check { relative: 2e-5, absolute: 5e-6, band: 0.0 };

macro_rules! forward_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
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
    };
}
forward_twin!(attention_forward);
forward_twin!(attention_forward_lanes);

macro_rules! output_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
                let (n, _) = sides(host.tokens, push.own, push.capacity);
                let (mixed, weights) = (widen(&host.mixed[..n * INNER / 4]), widen(host.weights));
                let matrix = &weights[4 * push.to_out as usize..];
                let y = crate::math::attention::linear(&mixed, &matrix[..INNER * FEATURE], INNER);
                for (i, (out, y)) in host.updated.as_flattened_mut().iter_mut().zip(y).enumerate() {
                    *out = (y + matrix[INNER * FEATURE + i % FEATURE]) as f32;
                }
            }
        }
    };
}
output_twin!(attention_output);
output_twin!(attention_output_lanes);

macro_rules! output_backward_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
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
                    host.rows[i * HEADS + h] =
                        [top, inverse, dot(head_of(&grad_mixed, i, h), head_of(&mixed, i, h)) as f32];
                }
            }
        }
    };
}
output_backward_twin!(attention_output_backward);
output_backward_twin!(attention_output_backward_lanes);

macro_rules! backward_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
                let (n, m) = sides(host.tokens, push.own, push.capacity);
                let [q, v, g, oq, ov, og] =
                    [host.qk, host.value, host.grad_mixed, host.other_qk, host.other_value, host.other_grad_mixed]
                        .map(widen);
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
    };
}
backward_twin!(attention_backward);
backward_twin!(attention_backward_lanes);

impl Reference for attention_pairs_backward::Kernel {
    fn reference(host: attention_pairs_backward::Host<'_>, push: attention_pairs_backward::Push, (): ()) {
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

macro_rules! apply_twin {
    ($kernel:ident, $own:literal) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
                let (n, m) = sides(host.tokens, $own, push.capacity);
                let (pairs, other) = (host.pairs.as_flattened(), widen(host.other));
                for (i, h) in (0..n).flat_map(|i| (0..HEADS).map(move |h| (i, h))) {
                    let mut sum = [0.0; HEAD];
                    for j in 0..m {
                        let (around, inside) = if $own == 0 { (j, i) } else { (i, j) };
                        let row = h * push.capacity as usize + around;
                        let weight = f64::from(pairs[4 * row * push.stride as usize + inside]);
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
    };
}
apply_twin!(attention_pairs_apply, 1);
apply_twin!(attention_pairs_apply_inside, 0);

macro_rules! project_backward_twin {
    ($kernel:ident) => {
        impl Reference for $kernel::Kernel {
            fn reference(host: $kernel::Host<'_>, push: $kernel::Push, (): ()) {
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
    };
}
project_backward_twin!(attention_project_backward);
project_backward_twin!(attention_project_backward_lanes);

impl Reference for attention_weight_backward::Kernel {
    fn reference(host: attention_weight_backward::Host<'_>, push: attention_weight_backward::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        if n == 0 {
            return;
        }
        let (rows, columns) = (4 * push.rows as usize, 4 * push.columns as usize);
        let (grad, input) = (widen(host.grad_output), widen(host.inputs));
        let length = n.div_ceil(SLICES);
        let all = rows * columns + if push.bias != 0 { rows } else { 0 };
        for (slice, partial) in host.partial.as_flattened_mut().chunks_mut(all).enumerate() {
            let tokens = (slice * length).min(n)..((slice + 1) * length).min(n);
            let grad = &grad[tokens.start * rows..tokens.end * rows];
            let input = &input[tokens.start * columns..tokens.end * columns];
            let sum = crate::math::attention::outer(grad, rows, input, columns);
            partial.iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
            if push.bias != 0 {
                let sum = crate::math::attention::outer(grad, rows, &vec![1.0; tokens.len()], 1);
                partial[rows * columns..].iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
            }
        }
    }
}

impl Reference for attention_weight_backward_lanes::Kernel {
    fn reference(host: attention_weight_backward_lanes::Host<'_>, push: attention_weight_backward_lanes::Push, (): ()) {
        let (n, _) = sides(host.tokens, push.own, push.capacity);
        let (rows, columns) = (4 * push.rows as usize, 4 * push.columns as usize);
        let (grad, input) = (widen(&host.grad_output[..n * rows / 4]), widen(&host.inputs[..n * columns / 4]));
        let out = &mut host.grad_weights.as_flattened_mut()[4 * push.matrix as usize..];
        let sum = crate::math::attention::outer(&grad, rows, &input, columns);
        out.iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
        if push.bias != 0 {
            let sum = crate::math::attention::outer(&grad, rows, &vec![1.0; n], 1);
            out[rows * columns..].iter_mut().zip(sum).for_each(|(out, sum)| *out = sum as f32);
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

/// How the kernels share the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sharing {
    /// A workgroup takes a block of tokens through shared memory; shares are formed again in the backward pass: for a GPU.
    Blocks,
    /// A subgroup of 8 shares what its lanes load, 16 or 32 tokens at a time: for a CPU driver, where a load costs as much
    /// as some forty additions. Shares are formed again, too.
    Lanes,
    /// As lanes; the backward pass forms shares and the gradient of the similarity once for both sides and keeps them: 7
    /// products of all pairs instead of 10, and 2 sets of loads instead of 2 times 3.
    Pairs,
}

impl Sharing {
    /// Most tokens a side whose pairs are kept: 3 matrices of 8 MiB each then, 2 MiB each at 256 tokens; at 2,000 a matrix
    /// would be as large as a binding may be.
    const MOST_KEPT: u32 = 512;

    /// Those that a device can run, whether they are good for it or not.
    pub(crate) fn all(gpu: &Gpu) -> &'static [Self] {
        if gpu.runs_lanes() { &[Self::Blocks, Self::Lanes, Self::Pairs] } else { &[Self::Blocks] }
    }

    /// What is taken.
    pub(crate) fn best(gpu: &Gpu, capacity: u32) -> Self {
        match gpu.lanes() {
            true if capacity <= Self::MOST_KEPT => Self::Pairs,
            true => Self::Lanes,
            false => Self::Blocks,
        }
    }
}

/// Of every head and pair of tokens, rows of the tokens around.
#[derive(Debug)]
struct Pairs {
    inside_share: Buffer<[f32; 4]>,
    around_share: Buffer<[f32; 4]>,
    grad_s: Buffer<[f32; 4]>,
    /// Vectors of a row.
    stride: u32,
}

impl Pairs {
    fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        let stride = 2 * capacity.div_ceil(8);
        let matrix = |name| gpu.buffer(name, HEADS * capacity as usize * stride as usize);
        Ok(Self {
            inside_share: matrix("inside_share")?,
            around_share: matrix("around_share")?,
            grad_s: matrix("grad_similarity")?,
            stride,
        })
    }
}

/// What belongs to one side of the attention.
#[derive(Debug)]
struct Side {
    qk: Buffer<[f32; 4]>,
    value: Buffer<[f32; 4]>,
    mixed: Buffer<[f32; 4]>,
    softmax: Buffer<[f32; 2]>,
    updated: Buffer<f32>,
    grad_mixed: Buffer<[f32; 4]>,
    rows: Buffer<[f32; 3]>,
    grad_qk: Buffer<[f32; 4]>,
    grad_value: Buffer<[f32; 4]>,
    grad_feature: Buffer<f32>,
}

impl Side {
    fn new(gpu: &Gpu, names: [&'static str; 10], capacity: usize) -> Result<Self, Error> {
        let inner = capacity * INNER / 4;
        let [qk, value, mixed, softmax, updated, grad_mixed, rows, grad_qk, grad_value, grad_feature] = names;
        Ok(Self {
            qk: gpu.buffer(qk, inner)?,
            value: gpu.buffer(value, inner)?,
            mixed: gpu.buffer(mixed, inner)?,
            softmax: gpu.buffer(softmax, capacity * HEADS)?,
            updated: gpu.buffer(updated, capacity * FEATURE)?,
            grad_mixed: gpu.buffer(grad_mixed, inner)?,
            rows: gpu.buffer(rows, capacity * HEADS)?,
            grad_qk: gpu.buffer(grad_qk, inner)?,
            grad_value: gpu.buffer(grad_value, inner)?,
            grad_feature: gpu.buffer(grad_feature, capacity * FEATURE)?,
        })
    }
}

/// The same thing of both sides.
#[derive(Clone, Copy, Debug)]
pub struct Pair<'a> {
    /// Of the tokens inside the mask: at least `[capacity * 32]`.
    pub inside: &'a Buffer<f32>,
    /// Of the tokens around it: at least `[capacity * 32]`.
    pub around: &'a Buffer<f32>,
}

impl Pair<'_> {
    fn vectors(self) -> [Buffer<[f32; 4]>; 2] {
        [self.inside.view(), self.around.view()]
    }
}

/// Cross-attention of at most `capacity` tokens a side. Counts are read on the device: `tokens` is `[2]`, inside and
/// around; with either at zero nothing is written but a zero gradient of the weights.
#[derive(Debug)]
pub struct Attention {
    capacity: u32,
    sharing: Sharing,
    sides: [Side; 2],
    /// Slices of every matrix's gradient, a buffer for each because passes that write one wait for each other: inside to
    /// queries-or-keys, values and output, then around. The form of lanes sums at once.
    partials: Option<[Buffer<[f32; 4]>; 6]>,
    pairs: Option<Pairs>,
    skip: Buffer<u32>,
}

fn partials(gpu: &Gpu) -> Result<[Buffer<[f32; 4]>; 6], Error> {
    let partial = |name, bias| gpu.buffer(name, SLICES * (INNER * FEATURE + bias) / 4);
    Ok([
        partial("inside_qk_partial", 0)?,
        partial("inside_value_partial", 0)?,
        partial("inside_out_partial", FEATURE)?,
        partial("around_qk_partial", 0)?,
        partial("around_value_partial", 0)?,
        partial("around_out_partial", FEATURE)?,
    ])
}

/// Records one of the two forms of a kernel, which share bindings and push constants. Of each: so many tokens (rounded up)
/// take so many threads.
macro_rules! run {
    ($self:ident, $rec:ident, $lanes:ident $many:literal tokens $wide:literal,
     $other:ident $few:literal tokens $narrow:literal, $buffers:tt, $push:tt) => {
        if $self.sharing != Sharing::Blocks {
            $rec.run($lanes::Kernel, $lanes::Buffers $buffers, $lanes::Push $push, $self.threads($many, $wide));
        } else {
            $rec.run($other::Kernel, $other::Buffers $buffers, $other::Push $push, $self.threads($few, $narrow));
        }
    };
}

impl Attention {
    /// Room for `capacity` tokens a side.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        Self::of(gpu, capacity, Sharing::best(gpu, capacity))
    }

    /// As [`Self::new`], shared like this.
    pub(crate) fn of(gpu: &Gpu, capacity: u32, sharing: Sharing) -> Result<Self, Error> {
        let side = |names| Side::new(gpu, names, capacity as usize);
        Ok(Self {
            capacity,
            sharing,
            pairs: if sharing == Sharing::Pairs { Some(Pairs::new(gpu, capacity)?) } else { None },
            partials: if sharing == Sharing::Blocks { Some(partials(gpu)?) } else { None },
            sides: [
                side([
                    "inside_qk",
                    "inside_value",
                    "inside_mixed",
                    "inside_softmax",
                    "inside_updated",
                    "grad_inside_mixed",
                    "inside_rows",
                    "grad_inside_qk",
                    "grad_inside_value",
                    "grad_inside",
                ])?,
                side([
                    "around_qk",
                    "around_value",
                    "around_mixed",
                    "around_softmax",
                    "around_updated",
                    "grad_around_mixed",
                    "around_rows",
                    "grad_around_qk",
                    "grad_around_value",
                    "grad_around",
                ])?,
            ],
            skip: gpu.buffer("attention_skip", 3)?,
        })
    }

    /// Tokens a side has room for.
    pub fn capacity(&self) -> u32 {
        self.capacity
    }

    /// Fresh weights, as PyTorch initialises linear layers: uniform within `1 / sqrt(inputs)`.
    pub fn initial_weights(rng: &mut impl Rng) -> Vec<f32> {
        let mut weights = Vec::with_capacity(WEIGHTS);
        for (name, [rows, columns], _) in TENSORS {
            let inputs = if name.ends_with("bias") { INNER } else { columns };
            let bound = 1.0 / (inputs as f32).sqrt();
            weights.extend((0..rows * columns).map(|_| rng.random_range(-bound..bound)));
        }
        weights
    }

    /// A thread for every `tokens` tokens (rounded up) and each of `parts`.
    fn threads(&self, tokens: u32, parts: u32) -> u32 {
        self.capacity.div_ceil(tokens) * parts
    }

    /// Records the attended features of both sides (n, 32). `weights` is `[WEIGHTS]`, tensors as in [`TENSORS`].
    pub fn forward(
        &self,
        rec: &mut Recorder<'_>,
        tokens: &Buffer<u32>,
        features: Pair<'_>,
        weights: &Buffer<f32>,
    ) -> Pair<'_> {
        assert!(weights.len() >= WEIGHTS, "attention weights");
        let (capacity, features, weights) = (self.capacity, features.vectors(), &weights.view());
        for ((own, side), feature) in (0..).zip(&self.sides).zip(&features) {
            let Offsets { to_qk, to_v, .. } = SIDES[own as usize];
            let (to_qk, to_v) = ((to_qk / 4) as u32, (to_v / 4) as u32);
            let Side { qk, value, .. } = side;
            run!(self, rec, attention_project_lanes 32 tokens 128, attention_project 32 tokens 2048,
                { tokens, feature, weights, qk, value }, { own, capacity, to_qk, to_v });
        }
        for own in 0..2u32 {
            let (side, other) = (&self.sides[own as usize], &self.sides[1 - own as usize]);
            let (query, mixed, softmax) = (&side.qk, &side.mixed, &side.softmax);
            let (key, value) = (&other.qk, &other.value);
            run!(self, rec, attention_forward_lanes 32 tokens 64, attention_forward 32 tokens 1024,
                { tokens, query, key, value, mixed, softmax }, { own, capacity });
        }
        for (own, side) in (0..).zip(&self.sides) {
            let to_out = (SIDES[own as usize].to_out / 4) as u32;
            let updated = &side.updated.view();
            run!(self, rec, attention_output_lanes 32 tokens 16, attention_output 16 tokens 256,
                { tokens, mixed: &side.mixed, weights, updated }, { own, capacity, to_out });
        }
        Pair { inside: &self.sides[0].updated, around: &self.sides[1].updated }
    }

    /// Records the gradients of both sides' features, which it returns, and of the weights, after [`Self::forward`]
    /// with the same arguments.
    pub fn backward(
        &self,
        rec: &mut Recorder<'_>,
        tokens: &Buffer<u32>,
        features: Pair<'_>,
        weights: &Buffer<f32>,
        grad_updated: Pair<'_>,
        grad_weights: &Buffer<f32>,
    ) -> Pair<'_> {
        assert!(weights.len().min(grad_weights.len()) >= WEIGHTS, "attention weights");
        let (features, grad_updated) = (features.vectors(), grad_updated.vectors());
        let (capacity, weights) = (self.capacity, &weights.view());
        for ((own, side), grad_updated) in (0..).zip(&self.sides).zip(&grad_updated) {
            let to_out = (SIDES[own as usize].to_out / 4) as u32;
            let Side { mixed, softmax, grad_mixed, rows, .. } = side;
            run!(self, rec, attention_output_backward_lanes 32 tokens 64, attention_output_backward 32 tokens 1024,
                { tokens, grad_updated, weights, mixed, softmax, grad_mixed, rows }, { own, capacity, to_out });
        }
        self.shares_backward(rec, tokens);
        for (own, side) in (0..).zip(&self.sides) {
            let Offsets { to_qk, to_v, .. } = SIDES[own as usize];
            let (to_qk, to_v) = ((to_qk / 4) as u32, (to_v / 4) as u32);
            let grad_feature = &side.grad_feature.view();
            let Side { grad_qk, grad_value, .. } = side;
            run!(self, rec, attention_project_backward_lanes 32 tokens 16, attention_project_backward 16 tokens 256,
                { tokens, weights, grad_qk, grad_value, grad_feature }, { own, capacity, to_qk, to_v });
        }
        self.weights_backward(rec, tokens, &features, &grad_updated, &grad_weights.view());
        Pair { inside: &self.sides[0].grad_feature, around: &self.sides[1].grad_feature }
    }

    /// The attended features of the last forward pass.
    pub fn updated(&self) -> Pair<'_> {
        Pair { inside: &self.sides[0].updated, around: &self.sides[1].updated }
    }

    /// Records the flag that the optimiser's pass over these weights takes for its overflow flag: set where the
    /// step's is, and where there are no tokens (a step without attention moves nothing, not even by momentum).
    /// Behind it are the numbers of tokens inside and around, zero where the step's flag is set: `[3]`.
    pub fn skip(&self, rec: &mut Recorder<'_>, tokens: &Buffer<u32>, overflow: &Buffer<u32>) -> &Buffer<u32> {
        let buffers = attention_skip::Buffers { tokens, overflow, skip: &self.skip };
        rec.run(attention_skip::Kernel, buffers, (), 1u32);
        &self.skip
    }

    fn shares_backward(&self, rec: &mut Recorder<'_>, tokens: &Buffer<u32>) {
        let capacity = self.capacity;
        if let Some(pairs) = &self.pairs {
            return self.pairs_backward(rec, tokens, pairs);
        }
        for own in 0..2u32 {
            let Side { qk, value, grad_mixed, rows, grad_qk, grad_value, .. } = &self.sides[own as usize];
            let Side { qk: other_qk, value: other_value, grad_mixed: other_grad_mixed, rows: other_rows, .. } =
                &self.sides[1 - own as usize];
            run!(self, rec, attention_backward_lanes 16 tokens 64, attention_backward 32 tokens 1024, {
                tokens, qk, value, grad_mixed, rows, other_qk, other_value, other_grad_mixed, other_rows,
                grad_qk, grad_value
            }, { own, capacity });
        }
    }

    fn pairs_backward(&self, rec: &mut Recorder<'_>, tokens: &Buffer<u32>, pairs: &Pairs) {
        let (capacity, stride) = (self.capacity, pairs.stride);
        let Pairs { inside_share, around_share, grad_s, .. } = pairs;
        let [inside, around] = &self.sides;
        let buffers = attention_pairs_backward::Buffers {
            tokens,
            qk: &inside.qk,
            value: &inside.value,
            grad_mixed: &inside.grad_mixed,
            rows: &inside.rows,
            other_qk: &around.qk,
            other_value: &around.value,
            other_grad_mixed: &around.grad_mixed,
            other_rows: &around.rows,
            inside_share,
            around_share,
            grad_s,
        };
        let push = attention_pairs_backward::Push { capacity, stride };
        rec.run(attention_pairs_backward::Kernel, buffers, push, self.threads(32, 64));
        for (pairs, other, applied) in
            [(grad_s, &around.qk, &inside.grad_qk), (around_share, &around.grad_mixed, &inside.grad_value)]
        {
            let buffers = attention_pairs_apply_inside::Buffers { tokens, pairs, other, applied };
            let push = attention_pairs_apply_inside::Push { capacity, stride };
            rec.run(attention_pairs_apply_inside::Kernel, buffers, push, self.threads(32, 64));
        }
        for (pairs, other, applied) in
            [(grad_s, &inside.qk, &around.grad_qk), (inside_share, &inside.grad_mixed, &around.grad_value)]
        {
            let buffers = attention_pairs_apply::Buffers { tokens, pairs, other, applied };
            let push = attention_pairs_apply::Push { capacity, stride };
            rec.run(attention_pairs_apply::Kernel, buffers, push, self.threads(32, 64));
        }
    }

    fn weights_backward(
        &self,
        rec: &mut Recorder<'_>,
        tokens: &Buffer<u32>,
        features: &[Buffer<[f32; 4]>; 2],
        grad_updated: &[Buffer<[f32; 4]>; 2],
        grad_weights: &Buffer<[f32; 4]>,
    ) {
        let (capacity, narrow, inner) = (self.capacity, (FEATURE / 4) as u32, (INNER / 4) as u32);
        let mut partials = self.partials.iter().flatten();
        for (own, side) in (0..).zip(&self.sides) {
            let (Offsets { to_qk, to_v, to_out }, at) = (SIDES[own as usize], own as usize);
            let products = [
                (&side.grad_qk, inner, &features[at], narrow, to_qk, 0),
                (&side.grad_value, inner, &features[at], narrow, to_v, 0),
                (&grad_updated[at], narrow, &side.mixed, inner, to_out, 1),
            ];
            for (grad_output, rows, inputs, columns, matrix, bias) in products {
                if let Some(partial) = partials.next() {
                    let push = attention_weight_backward::Push { own, capacity, rows, columns, bias };
                    let buffers = attention_weight_backward::Buffers { tokens, grad_output, inputs, partial };
                    let threads = rows / 8 * (columns / 8) * SLICES as u32 * 64;
                    rec.run(attention_weight_backward::Kernel, buffers, push, threads);
                } else {
                    let matrix = (matrix / 4) as u32;
                    let push = attention_weight_backward_lanes::Push { own, capacity, rows, columns, matrix, bias };
                    let buffers =
                        attention_weight_backward_lanes::Buffers { tokens, grad_output, inputs, grad_weights };
                    rec.run(attention_weight_backward_lanes::Kernel, buffers, push, rows * columns / 8);
                }
            }
        }
        if let Some([inside_qk, inside_value, inside_out, around_qk, around_value, around_out]) = &self.partials {
            let buffers = attention_weight_sum::Buffers {
                tokens,
                inside_qk,
                inside_value,
                inside_out,
                around_qk,
                around_value,
                around_out,
                grad_weights,
            };
            rec.run(attention_weight_sum::Kernel, buffers, (), WEIGHTS / 4);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::{Options, Submission, Timings, testing};
    use crate::math::attention as exact;

    struct Run {
        updated: [Vec<f32>; 2],
        grad_features: [Vec<f32>; 2],
        grad_weights: Vec<f32>,
    }

    struct Inputs {
        n: [usize; 2],
        features: [Vec<f32>; 2],
        upstream: [Vec<f32>; 2],
        weights: Vec<f32>,
    }

    fn inputs(n: [usize; 2], seed: u64) -> Inputs {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let weights = Attention::initial_weights(&mut rng);
        let mut values = |n: usize| (0..n * FEATURE).map(|_| rng.random_range(-1.7f32..1.7)).collect::<Vec<f32>>();
        Inputs { n, features: n.map(&mut values), upstream: n.map(&mut values), weights }
    }

    /// Every buffer starts as not-a-number. `checked`: every pass beside its twin.
    fn run(gpu: &Gpu, inputs: &Inputs, capacity: usize, sharing: Sharing, checked: bool) -> Run {
        let attention = Attention::of(gpu, capacity as u32, sharing).expect("memory for the test");
        let pad = |values: &Vec<f32>| {
            let mut values = values.clone();
            values.resize(capacity * FEATURE, testing::UNWRITTEN);
            gpu.upload("padded", &values).expect("memory for the test")
        };
        let (features, upstream) = (inputs.features.each_ref().map(pad), inputs.upstream.each_ref().map(pad));
        let weights = gpu.upload("weights", &inputs.weights).expect("memory for the test");
        let grad_weights = gpu.buffer::<f32>("grad_weights", WEIGHTS).expect("memory for the test");
        let tokens = gpu.upload("tokens", &inputs.n.map(|n| n as u32)).expect("memory for the test");
        let mut rec = if checked { gpu.checked() } else { gpu.recorder() }.expect("a recorder");
        let nan = testing::UNWRITTEN.to_bits();
        for side in &attention.sides {
            for buffer in [&side.qk, &side.value, &side.mixed, &side.grad_mixed, &side.grad_qk, &side.grad_value] {
                rec.fill(buffer, nan);
            }
            rec.fill(&side.softmax, nan);
            rec.fill(&side.rows, nan);
            rec.fill(&side.updated, nan);
            rec.fill(&side.grad_feature, nan);
        }
        attention.partials.iter().flatten().for_each(|partial| rec.fill(partial, nan));
        if let Some(Pairs { inside_share, around_share, grad_s, .. }) = &attention.pairs {
            [inside_share, around_share, grad_s].into_iter().for_each(|matrix| rec.fill(matrix, nan));
        }
        rec.fill(&grad_weights, nan);
        let pair = |of: &'static str| match of {
            "features" => Pair { inside: &features[0], around: &features[1] },
            _ => Pair { inside: &upstream[0], around: &upstream[1] },
        };
        let updated = attention.forward(&mut rec, &tokens, pair("features"), &weights);
        let grads = attention.backward(&mut rec, &tokens, pair("features"), &weights, pair("upstream"), &grad_weights);
        let submission = rec.submit().expect("the device runs it");
        for difference in &submission.differences {
            assert!(difference.ok(), "{:?} tokens: {difference}", inputs.n);
        }
        assert_eq!(submission.differences.is_empty(), !checked);
        submission.wait().expect("the device runs it");
        let read = |pair: Pair<'_>| [pair.inside, pair.around].map(|b| gpu.read(b).expect("readable"));
        Run {
            updated: read(updated),
            grad_features: read(grads),
            grad_weights: gpu.read(&grad_weights).expect("readable"),
        }
    }

    fn widen_all(values: &[f32]) -> Vec<f64> {
        values.iter().copied().map(f64::from).collect()
    }

    /// Compares with the dense float64 attention; beyond the counts nothing may be written.
    fn compare(inputs: &Inputs, got: &Run, check: Check) {
        let (features, upstream) =
            (inputs.features.each_ref().map(|f| widen_all(f)), inputs.upstream.each_ref().map(|f| widen_all(f)));
        let weights = widen_all(&inputs.weights);
        let forward = exact::forward([&features[0], &features[1]], &weights);
        let (grad_features, grad_weights) =
            exact::backward([&features[0], &features[1]], &weights, &forward, [&upstream[0], &upstream[1]]);
        let skipped = inputs.n.contains(&0);
        let name = format!("{:?} tokens", inputs.n);
        let matches = |tensor: &str, got: &[f32], want: &[f64]| {
            let len = if skipped && tensor != "grad_weights" { 0 } else { want.len() };
            let (written, rest) = got.split_at(len);
            assert!(rest.iter().all(|v| v.is_nan()), "{name}: {tensor} is written beyond its tokens");
            let difference = crate::gpu::Difference::of(&name, tensor, &widen_all(written), &want[..len], check);
            assert!(difference.ok(), "{difference}");
            // What is off by a share e of its norm has a cosine of at least 1 - e^2 / 2.
            let norm = want.iter().map(|w| w * w).sum::<f64>().sqrt();
            let spread = difference.scale * (len as f64).sqrt() / norm;
            let off = check.relative + check.absolute * spread;
            assert!(len == 0 || difference.cosine > 1.0 - (off * off / 2.0).max(1e-6), "{difference}");
        };
        for (got, want) in got.updated.iter().zip(&forward.updated) {
            matches("updated", got, want);
        }
        for (got, want) in got.grad_features.iter().zip(&grad_features) {
            matches("grad_feature", got, want);
        }
        matches("grad_weights", &got.grad_weights, &grad_weights);
    }

    /// Rounding of features through four layers of up to 512 terms each, relative to the largest element.
    const WHOLE: Check = Check { relative: 2e-5, absolute: 1e-5, band: 0.0 };

    /// Not at one token a side, where the gradient of the similarity is rounding alone: that is compared as a whole.
    #[test]
    fn every_pass_matches_its_twin() {
        let gpu = testing::gpu();
        for (i, n) in [[0, 0], [0, 12], [11, 0], [11, 1], [1, 2], [63, 65], [64, 64], [65, 63]].into_iter().enumerate()
        {
            let inputs = inputs(n, i as u64);
            for &sharing in Sharing::all(&gpu) {
                let got = run(&gpu, &inputs, 67, sharing, true);
                compare(&inputs, &got, WHOLE);
            }
        }
    }

    #[test]
    fn matches_the_dense_attention() {
        let gpu = testing::gpu();
        for n in [[1, 1], [1, 200], [200, 1], [200, 200], [257, 300], [77, 211]] {
            let inputs = inputs(n, 11);
            for &sharing in Sharing::all(&gpu) {
                compare(&inputs, &run(&gpu, &inputs, 301, sharing, false), WHOLE);
            }
        }
    }

    #[test]
    fn skip_flag() {
        let gpu = testing::gpu();
        for (tokens, overflow, want) in [
            ([5, 7], 0, [0, 5, 7]),
            ([5, 7], 2, [1, 0, 0]),
            ([0, 0], 0, [1, 0, 0]),
            ([3, 0], 0, [1, 3, 0]),
            ([0, 3], 1, [1, 0, 0]),
        ] {
            let case = attention_skip::Arrays { tokens: tokens.to_vec(), overflow: vec![overflow], skip: vec![9; 3] };
            testing::assert_twin(attention_skip::Kernel, &gpu, case.clone(), (), 1u32);
            assert_eq!(testing::run_once::<attention_skip::Kernel>(&gpu, &case, (), 1u32).skip, want);
        }
    }

    #[test]
    fn many_tokens_keep_no_pairs() {
        for gpu in testing::gpu_in_both_forms() {
            let best = [256, 512, 513, 2000].map(|n| Sharing::best(&gpu, n));
            if gpu.lanes() {
                assert_eq!(best, [Sharing::Pairs, Sharing::Pairs, Sharing::Lanes, Sharing::Lanes]);
            } else {
                assert_eq!(best, [Sharing::Blocks; 4]);
            }
        }
    }

    #[test]
    fn twice_the_same_bytes() {
        let gpu = testing::gpu();
        let inputs = inputs([130, 97], 5);
        let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        for &sharing in Sharing::all(&gpu) {
            let [a, b] = [0, 1].map(|_| run(&gpu, &inputs, 200, sharing, false));
            assert_eq!(bits(&a.grad_weights), bits(&b.grad_weights));
            for side in 0..2 {
                assert_eq!(bits(&a.updated[side]), bits(&b.updated[side]));
                assert_eq!(bits(&a.grad_features[side]), bits(&b.grad_features[side]));
            }
        }
    }

    /// Identical tokens: every share is 1 / n, no gradient reaches the similarity.
    #[test]
    fn identical_tokens() {
        let gpu = testing::gpu();
        let mut inputs = inputs([40, 24], 6);
        for f in &mut inputs.features {
            let first = f[..FEATURE].to_vec();
            f.chunks_mut(FEATURE).for_each(|row| row.copy_from_slice(&first));
        }
        for &sharing in Sharing::all(&gpu) {
            compare(&inputs, &run(&gpu, &inputs, 40, sharing, false), WHOLE);
        }
    }

    /// Logits of +-1e4: 120 times larger queries and keys. Float32 logits are then off by up to 16 roundings of
    /// terms of 1e4, 2e-3, and so are shares where two logits happen to be close; most shares are exactly 0 or 1.
    #[test]
    fn enormous_logits() {
        let gpu = testing::gpu();
        for n in [[64, 64], [1, 200], [33, 12]] {
            let mut inputs = inputs(n, 7);
            inputs.weights[..2 * INNER * FEATURE].iter_mut().for_each(|w| *w *= 120.0);
            let features = inputs.features.each_ref().map(|f| widen_all(f));
            let weights = widen_all(&inputs.weights);
            let qk =
                [0, 1].map(|s| exact::linear(&features[s], &weights[SIDES[s].to_qk..][..INNER * FEATURE], FEATURE));
            let largest = (0..n[0] * n[1])
                .map(|k| dot(head_of(&qk[0], k / n[1], 0), head_of(&qk[1], k % n[1], 0)).abs() / 8.0)
                .fold(0.0, f64::max);
            assert!(largest > 1e4, "largest logit {largest}");
            for &sharing in Sharing::all(&gpu) {
                let got = run(&gpu, &inputs, 200, sharing, false);
                compare(&inputs, &got, Check { relative: 5e-3, absolute: 5e-3, band: 0.0 });
            }
        }
    }

    /// Prints milliseconds per pass.
    #[test]
    fn large_numbers_of_tokens() {
        let gpu = testing::gpu_with(Options { timestamps: true, ..Options::default() });
        for n in [256, 1000] {
            let inputs = inputs([n, n], 8);
            let upload = |v: &Vec<f32>| gpu.upload("input", v).expect("memory for the test");
            let [inside, around] = inputs.features.each_ref().map(upload);
            let [up_inside, up_around] = inputs.upstream.each_ref().map(upload);
            let weights = upload(&inputs.weights);
            let grad_weights = gpu.buffer::<f32>("grad_weights", WEIGHTS).expect("memory for the test");
            let tokens = gpu.upload("tokens", &[n as u32; 2]).expect("memory for the test");
            let attention = Attention::new(&gpu, n as u32).expect("memory for the test");
            let mut timings = Timings::default();
            for repeat in 0..3 {
                let mut rec = gpu.recorder().expect("a recorder");
                let features = Pair { inside: &inside, around: &around };
                attention.forward(&mut rec, &tokens, features, &weights);
                let upstream = Pair { inside: &up_inside, around: &up_around };
                attention.backward(&mut rec, &tokens, features, &weights, upstream, &grad_weights);
                let times = rec.submit().and_then(Submission::wait).expect("the device runs it");
                if repeat > 0 {
                    timings.add(&times);
                }
            }
            println!("{n} tokens a side\n{}", timings.table());
            let finite = gpu.read(&grad_weights).expect("readable").iter().all(|g| g.is_finite());
            assert!(finite, "a gradient of {n} tokens is not finite");
        }
    }
}

//! Bidirectional cross-attention between the anchors inside the mask and those around it (GScream, equation 8): 8 heads
//! of 64, one similarity for both directions, softmax along each side.
//!
//! No similarity matrix is stored. The forward pass keeps the largest logit and the inverse sum of exponentials of every
//! row (apart, not as one logarithm: at logits of 1e4 the sum of the two would lose three digits), the backward pass
//! forms the shares again from them. As the two directions differ only in who asks, they run the same kernels with the
//! bindings swapped, and the backward pass treats both at once for the tokens it owns.

pub mod blend;
pub mod select;
#[cfg(test)]
mod tests;
mod twins;

use crate::gpu::kernels::model::{
    attention_backward, attention_forward, attention_output, attention_output_backward, attention_project,
    attention_project_backward, attention_skip, attention_weight_backward, attention_weight_sum, cpu,
};
use crate::gpu::{Buffer, Error, Form, Gpu, Recorder};
use crate::math::attention::{FEATURE, HEADS, INNER, Offsets, SIDES};
pub use crate::math::attention::{TENSORS, WEIGHTS};
use rand::{Rng, RngExt};

/// Slices of the tokens in the sum of a weight's gradient: the kernels'.
const SLICES: usize = 8;

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
    #[cfg(test)]
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

    /// The form of a kernel, and its threads: tokens and parts as in [`Self::threads`], of lanes and of blocks.
    fn share(&self, lanes: [u32; 2], blocks: [u32; 2]) -> (Form, u32) {
        let (form, [tokens, parts]) = match self.sharing {
            Sharing::Blocks => (Form::Gpu, blocks),
            Sharing::Lanes | Sharing::Pairs => (Form::Cpu, lanes),
        };
        (form, self.threads(tokens, parts))
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
            let (form, threads) = self.share([32, 128], [32, 2048]);
            let buffers = attention_project::Buffers { tokens, feature, weights, qk, value };
            let push = attention_project::Push { own, capacity, to_qk, to_v };
            rec.run(attention_project::Kernel::from(form), buffers, push, threads);
        }
        for own in 0..2u32 {
            let (side, other) = (&self.sides[own as usize], &self.sides[1 - own as usize]);
            let (query, mixed, softmax) = (&side.qk, &side.mixed, &side.softmax);
            let (key, value) = (&other.qk, &other.value);
            let (form, threads) = self.share([32, 64], [32, 1024]);
            let buffers = attention_forward::Buffers { tokens, query, key, value, mixed, softmax };
            let push = attention_forward::Push { own, capacity };
            rec.run(attention_forward::Kernel::from(form), buffers, push, threads);
        }
        for (own, side) in (0..).zip(&self.sides) {
            let to_out = (SIDES[own as usize].to_out / 4) as u32;
            let updated = &side.updated.view();
            let (form, threads) = self.share([32, 16], [16, 256]);
            let buffers = attention_output::Buffers { tokens, mixed: &side.mixed, weights, updated };
            let push = attention_output::Push { own, capacity, to_out };
            rec.run(attention_output::Kernel::from(form), buffers, push, threads);
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
            let (form, threads) = self.share([32, 64], [32, 1024]);
            let buffers =
                attention_output_backward::Buffers { tokens, grad_updated, weights, mixed, softmax, grad_mixed, rows };
            let push = attention_output_backward::Push { own, capacity, to_out };
            rec.run(attention_output_backward::Kernel::from(form), buffers, push, threads);
        }
        self.shares_backward(rec, tokens);
        for (own, side) in (0..).zip(&self.sides) {
            let Offsets { to_qk, to_v, .. } = SIDES[own as usize];
            let (to_qk, to_v) = ((to_qk / 4) as u32, (to_v / 4) as u32);
            let grad_feature = &side.grad_feature.view();
            let Side { grad_qk, grad_value, .. } = side;
            let (form, threads) = self.share([32, 16], [16, 256]);
            let buffers = attention_project_backward::Buffers { tokens, weights, grad_qk, grad_value, grad_feature };
            let push = attention_project_backward::Push { own, capacity, to_qk, to_v };
            rec.run(attention_project_backward::Kernel::from(form), buffers, push, threads);
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
            let (form, threads) = self.share([16, 64], [32, 1024]);
            let buffers = attention_backward::Buffers {
                tokens,
                qk,
                value,
                grad_mixed,
                rows,
                other_qk,
                other_value,
                other_grad_mixed,
                other_rows,
                grad_qk,
                grad_value,
            };
            let push = attention_backward::Push { own, capacity };
            rec.run(attention_backward::Kernel::from(form), buffers, push, threads);
        }
    }

    fn pairs_backward(&self, rec: &mut Recorder<'_>, tokens: &Buffer<u32>, pairs: &Pairs) {
        let (capacity, stride) = (self.capacity, pairs.stride);
        let Pairs { inside_share, around_share, grad_s, .. } = pairs;
        let [inside, around] = &self.sides;
        let buffers = cpu::attention_pairs_backward::Buffers {
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
        let push = cpu::attention_pairs_backward::Push { capacity, stride };
        rec.run(cpu::attention_pairs_backward::Kernel, buffers, push, self.threads(32, 64));
        for (pairs, other, applied) in
            [(grad_s, &around.qk, &inside.grad_qk), (around_share, &around.grad_mixed, &inside.grad_value)]
        {
            let buffers = cpu::attention_pairs_apply::Buffers { tokens, pairs, other, applied };
            let push = cpu::attention_pairs_apply::Push { capacity, stride };
            rec.run(cpu::attention_pairs_apply::Kernel::Inside, buffers, push, self.threads(32, 64));
        }
        for (pairs, other, applied) in
            [(grad_s, &inside.qk, &around.grad_qk), (inside_share, &inside.grad_mixed, &around.grad_value)]
        {
            let buffers = cpu::attention_pairs_apply::Buffers { tokens, pairs, other, applied };
            let push = cpu::attention_pairs_apply::Push { capacity, stride };
            rec.run(cpu::attention_pairs_apply::Kernel::Plain, buffers, push, self.threads(32, 64));
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
                let partial = partials.next();
                let (kernel, threads) = match partial {
                    Some(_) => (attention_weight_backward::Kernel::Gpu, rows / 8 * (columns / 8) * SLICES as u32 * 64),
                    None => (attention_weight_backward::Kernel::Cpu, rows * columns / 8),
                };
                let grad_weights = partial.is_none().then_some(grad_weights);
                let buffers = attention_weight_backward::Buffers { tokens, grad_output, inputs, partial, grad_weights };
                let matrix = (matrix / 4) as u32;
                let push = attention_weight_backward::Push { own, capacity, rows, columns, bias, matrix };
                rec.run(kernel, buffers, push, threads);
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

//! Attended features mixed into the anchors' own: `f' = blend attention(f) + (1 - blend) f` for the chosen anchors.
//!
//! [`Blend::mix`] gives the decoder a copy of the features with these rows replaced, and [`Blend::backward`] carries the
//! gradient back through the mixture and the attention (the paper's variant). [`Blend::write_back`] writes the mixture
//! into the parameters instead, without a gradient (the release's variant).

use crate::gpu::kernels::model::{attention_blend_gather, attention_blend_scatter};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};
use crate::math::attention::FEATURE;

use super::select::Chosen;
use super::{Attention, Pair};

/// Vectors of a row.
const ROW: usize = FEATURE / 4;

impl Reference for attention_blend_gather::Kernel {
    fn reference(host: attention_blend_gather::Host<'_>, push: attention_blend_gather::Push, (): ()) {
        let n = host.tokens[push.own as usize].min(push.capacity) as usize;
        for (row, &anchor) in host.gathered.chunks_mut(ROW).zip(&host.anchors[..n]) {
            let from = &host.feature[anchor as usize * ROW..][..ROW];
            for (to, from) in row.as_flattened_mut().iter_mut().zip(from.as_flattened()) {
                *to = (f64::from(push.factor) * f64::from(*from)) as f32;
            }
        }
    }
}

impl Reference for attention_blend_scatter::Kernel {
    fn reference(host: attention_blend_scatter::Host<'_>, push: attention_blend_scatter::Push, (): ()) {
        let n = host.tokens[push.own as usize].min(push.capacity) as usize;
        for (added, &anchor) in host.added.chunks(ROW).zip(&host.anchors[..n]) {
            let to = &mut host.feature[anchor as usize * ROW..][..ROW];
            for (to, added) in to.as_flattened_mut().iter_mut().zip(added.as_flattened()) {
                *to = (f64::from(push.keep) * f64::from(*to) + f64::from(push.add) * f64::from(*added)) as f32;
            }
        }
    }
}

/// Tokens' features and their gradients, and the attention between them.
#[derive(Debug)]
pub struct Blend {
    attention: Attention,
    blend: f32,
    inside: Buffer<f32>,
    around: Buffer<f32>,
    grad_inside: Buffer<f32>,
    grad_around: Buffer<f32>,
}

/// What all passes of a step share.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// The chosen anchors.
    pub chosen: Chosen<'a>,
    /// `[WEIGHTS]` of the attention.
    pub weights: &'a Buffer<f32>,
}

impl Blend {
    /// Room for `capacity` tokens a side; `blend` is the share of the attended features.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32, blend: f32) -> Result<Self, Error> {
        let len = capacity as usize * FEATURE;
        Ok(Self {
            attention: Attention::new(gpu, capacity)?,
            blend,
            inside: gpu.buffer("inside", len)?,
            around: gpu.buffer("around", len)?,
            grad_inside: gpu.buffer("grad_inside_updated", len)?,
            grad_around: gpu.buffer("grad_around_updated", len)?,
        })
    }

    /// The attention itself.
    pub fn attention(&self) -> &Attention {
        &self.attention
    }

    fn threads(&self) -> u32 {
        self.attention.capacity() * ROW as u32
    }

    fn gather<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        chosen: Chosen<'_>,
        feature: &Buffer<f32>,
        to: Pair<'a>,
        factor: f32,
    ) -> Pair<'a> {
        let (capacity, feature) = (self.attention.capacity(), &feature.view());
        for (own, anchors, gathered) in [(0, chosen.inside, to.inside), (1, chosen.around, to.around)] {
            let gathered = &gathered.view();
            let buffers = attention_blend_gather::Buffers { tokens: chosen.tokens, anchors, feature, gathered };
            let push = attention_blend_gather::Push { own, capacity, factor };
            rec.run(attention_blend_gather::Kernel, buffers, push, self.threads());
        }
        to
    }

    /// One side's rows: `keep` times the row plus `add` times the token.
    fn scatter(
        &self,
        rec: &mut Recorder<'_>,
        (own, tokens, anchors): (u32, &Buffer<u32>, &Buffer<u32>),
        added: &Buffer<f32>,
        feature: &Buffer<f32>,
        (keep, add): (f32, f32),
    ) {
        let (added, feature) = (&added.view(), &feature.view());
        let buffers = attention_blend_scatter::Buffers { tokens, anchors, added, feature };
        let push = attention_blend_scatter::Push { own, capacity: self.attention.capacity(), keep, add };
        rec.run(attention_blend_scatter::Kernel, buffers, push, self.threads());
    }

    fn attend(&self, rec: &mut Recorder<'_>, inputs: Inputs<'_>, feature: &Buffer<f32>) -> Pair<'_> {
        let to = Pair { inside: &self.inside, around: &self.around };
        let features = self.gather(rec, inputs.chosen, feature, to, 1.0);
        self.attention.forward(rec, inputs.chosen.tokens, features, inputs.weights)
    }

    /// Records `blended`, `feature` (at least `[anchors * 32]`) with the chosen rows replaced by the mixture.
    pub fn mix(
        &self,
        rec: &mut Recorder<'_>,
        inputs: Inputs<'_>,
        feature: &Buffer<f32>,
        blended: &Buffer<f32>,
        anchors: usize,
    ) {
        let updated = self.attend(rec, inputs, feature);
        rec.copy(feature, blended, anchors * FEATURE);
        let factors = (1.0 - self.blend, self.blend);
        let Chosen { tokens, inside, around } = inputs.chosen;
        self.scatter(rec, (0, tokens, inside), updated.inside, blended, factors);
        self.scatter(rec, (1, tokens, around), updated.around, blended, factors);
    }

    /// Records the gradients of the weights and of the features, the latter in place: `grad_feature` holds the gradient
    /// of the blended features before and of the features after, for the chosen rows
    /// `(1 - blend) grad + grad through the attention`. After [`Self::mix`] with the same inputs.
    pub fn backward(
        &self,
        rec: &mut Recorder<'_>,
        inputs: Inputs<'_>,
        grad_feature: &Buffer<f32>,
        grad_weights: &Buffer<f32>,
    ) {
        let grads = self.weights_backward(rec, inputs, grad_feature, grad_weights);
        let factors = (1.0 - self.blend, 1.0);
        let Chosen { tokens, inside, around } = inputs.chosen;
        self.scatter(rec, (0, tokens, inside), grads.inside, grad_feature, factors);
        self.scatter(rec, (1, tokens, around), grads.around, grad_feature, factors);
    }

    /// Records the gradient of the weights alone, given that of the blended features, and returns the tokens' own:
    /// what remains of [`Self::backward`] beside [`Self::write_back`].
    pub fn weights_backward(
        &self,
        rec: &mut Recorder<'_>,
        inputs: Inputs<'_>,
        grad_blended: &Buffer<f32>,
        grad_weights: &Buffer<f32>,
    ) -> Pair<'_> {
        let to = Pair { inside: &self.grad_inside, around: &self.grad_around };
        let grad_updated = self.gather(rec, inputs.chosen, grad_blended, to, self.blend);
        let features = Pair { inside: &self.inside, around: &self.around };
        let tokens = inputs.chosen.tokens;
        self.attention.backward(rec, tokens, features, inputs.weights, grad_updated, grad_weights)
    }

    /// As [`Self::mix`] for [`Self::write_back`]: rows inside the mask are replaced only where `reference` says that the
    /// view is the reference view.
    pub fn mix_to_write_back(
        &self,
        rec: &mut Recorder<'_>,
        inputs: Inputs<'_>,
        feature: &Buffer<f32>,
        blended: &Buffer<f32>,
        (anchors, reference): (usize, bool),
    ) {
        self.attend(rec, inputs, feature);
        rec.copy(feature, blended, anchors * FEATURE);
        self.scatter_updated(rec, inputs.chosen, (0, inputs.chosen.tokens), blended, reference);
    }

    /// Records the mixture of [`Self::mix_to_write_back`] into the features themselves, which are as they were then.
    /// `skip` is that of [`Attention::skip`]: a step that overflowed is taken again and must leave them alone.
    pub fn write_back(
        &self,
        rec: &mut Recorder<'_>,
        chosen: Chosen<'_>,
        skip: &Buffer<u32>,
        feature: &Buffer<f32>,
        reference: bool,
    ) {
        self.scatter_updated(rec, chosen, (1, skip), feature, reference);
    }

    /// `tokens` has the number inside at `first`, that around behind it.
    fn scatter_updated(
        &self,
        rec: &mut Recorder<'_>,
        chosen: Chosen<'_>,
        (first, tokens): (u32, &Buffer<u32>),
        to: &Buffer<f32>,
        reference: bool,
    ) {
        let factors = (1.0 - self.blend, self.blend);
        let updated = self.attention.updated();
        if reference {
            self.scatter(rec, (first, tokens, chosen.inside), updated.inside, to, factors);
        }
        self.scatter(rec, (first + 1, tokens, chosen.around), updated.around, to, factors);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::{Check, Difference, testing};
    use crate::math::attention::exact;
    use crate::model::attention::WEIGHTS;

    const BLEND: f64 = 0.25;
    const CAPACITY: usize = 70;

    struct Case {
        tokens: [usize; 2],
        anchors: usize,
        /// All anchors in random order: inside, then around, then the rest.
        order: Vec<u32>,
        feature: Vec<f32>,
        upstream: Vec<f32>,
        weights: Vec<f32>,
    }

    fn case(tokens: [usize; 2], seed: u64) -> Case {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let anchors = 200;
        let mut order: Vec<u32> = (0..anchors as u32).collect();
        (1..anchors).for_each(|i| order.swap(i, rng.random_range(0..=i)));
        let mut values = || (0..anchors * FEATURE).map(|_| rng.random_range(-1.5f32..1.5)).collect::<Vec<f32>>();
        let (feature, upstream) = (values(), values());
        Case { tokens, anchors, order, feature, upstream, weights: Attention::initial_weights(&mut rng) }
    }

    impl Case {
        fn lists(&self) -> [&[u32]; 2] {
            let [n, m] = self.tokens;
            [&self.order[..n], &self.order[n..n + m]]
        }
        fn rows(&self, side: usize, values: &[f64]) -> Vec<f64> {
            self.lists()[side].iter().flat_map(|&a| &values[a as usize * FEATURE..][..FEATURE]).copied().collect()
        }
    }

    fn widen(values: &[f32]) -> Vec<f64> {
        values.iter().copied().map(f64::from).collect()
    }

    fn assert_close(name: &str, got: &[f32], want: &[f64]) {
        // The attention's bound: see its tests.
        let check = Check { relative: 2e-5, absolute: 1e-5, band: 0.0 };
        let difference = Difference::of("blend", name, &widen(got), want, check);
        assert!(difference.ok(), "{difference}");
    }

    struct Device {
        blended: Vec<f32>,
        grad_feature: Vec<f32>,
        grad_weights: Vec<f32>,
        written: [Vec<f32>; 2],
    }

    fn run(gpu: &Gpu, case: &Case) -> Device {
        let stage = Blend::new(gpu, CAPACITY as u32, BLEND as f32).expect("memory for the test");
        let list = |list: &[u32]| {
            let mut padded = list.to_vec();
            padded.resize(CAPACITY, 0);
            gpu.upload("anchors", &padded).expect("memory for the test")
        };
        let [inside, around] = case.lists().map(list);
        let tokens = gpu.upload("tokens", &case.tokens.map(|n| n as u32)).expect("memory for the test");
        let floats = |name, data: &[f32]| gpu.upload(name, data).expect("memory for the test");
        let (feature, weights) = (floats("feature", &case.feature), floats("weights", &case.weights));
        let unwritten = vec![testing::UNWRITTEN; case.feature.len()];
        let blended = floats("blended", &unwritten);
        let (grad_feature, grad_weights) =
            (floats("grad_feature", &case.upstream), floats("grad_weights", &vec![testing::UNWRITTEN; WEIGHTS]));
        let chosen = Chosen { tokens: &tokens, inside: &inside, around: &around };
        let inputs = Inputs { chosen, weights: &weights };
        let mut rec = gpu.checked().expect("a recorder");
        stage.mix(&mut rec, inputs, &feature, &blended, case.anchors);
        stage.backward(&mut rec, inputs, &grad_feature, &grad_weights);
        let submission = rec.submit().expect("the device runs it");
        submission.differences.iter().for_each(|d| assert!(d.ok(), "{d}"));
        drop(submission);
        let written = [true, false].map(|reference| {
            let (copy, mixed) = (floats("feature", &case.feature), floats("blended", &unwritten));
            let overflow = gpu.upload("overflow", &[1u32]).expect("memory for the test");
            let mut rec = gpu.checked().expect("a recorder");
            stage.mix_to_write_back(&mut rec, inputs, &copy, &mixed, (case.anchors, reference));
            let skip = stage.attention().skip(&mut rec, &tokens, &overflow);
            stage.write_back(&mut rec, chosen, skip, &copy, reference);
            rec.zero(&overflow);
            let submission = rec.submit().expect("the device runs it");
            submission.differences.iter().for_each(|d| assert!(d.ok(), "{d}"));
            submission.wait().expect("the device runs it");
            assert_eq!(gpu.read(&copy).expect("readable"), case.feature, "the step overflowed");
            let mut rec = gpu.recorder().expect("a recorder");
            let skip = stage.attention().skip(&mut rec, &tokens, &overflow);
            stage.write_back(&mut rec, chosen, skip, &copy, reference);
            rec.submit().and_then(|s| s.wait()).expect("the device runs it");
            let written = gpu.read(&copy).expect("readable");
            assert_eq!(gpu.read(&mixed).expect("readable"), written, "what is decoded is what is written");
            written
        });
        let read = |buffer| gpu.read(buffer).expect("readable");
        Device {
            blended: read(&blended),
            grad_feature: read(&grad_feature),
            grad_weights: read(&grad_weights),
            written,
        }
    }

    #[test]
    fn matches_the_dense_mixture() {
        let gpu = testing::gpu();
        for (seed, tokens) in [[0, 0], [12, 12], [64, 64], [12, 70], [63, 1]].into_iter().enumerate() {
            let case = case(tokens, seed as u64);
            let got = run(&gpu, &case);
            let (feature, upstream, weights) = (widen(&case.feature), widen(&case.upstream), widen(&case.weights));
            let sides = [0, 1].map(|side| case.rows(side, &feature));
            let forward = exact::forward([&sides[0], &sides[1]], &weights);
            let grad_updated =
                [0, 1].map(|side| case.rows(side, &upstream).into_iter().map(|g| BLEND * g).collect::<Vec<f64>>());
            let (grads, grad_weights) =
                exact::backward([&sides[0], &sides[1]], &weights, &forward, [&grad_updated[0], &grad_updated[1]]);
            let (mut blended, mut grad_feature, mut around_only) = (feature.clone(), upstream, feature.clone());
            for (side, grads) in grads.iter().enumerate() {
                for (t, &a) in case.lists()[side].iter().enumerate() {
                    for d in 0..FEATURE {
                        let (at, token) = (a as usize * FEATURE + d, t * FEATURE + d);
                        blended[at] = BLEND * forward.updated[side][token] + (1.0 - BLEND) * feature[at];
                        grad_feature[at] = (1.0 - BLEND) * grad_feature[at] + grads[token];
                        if side == 1 {
                            around_only[at] = blended[at];
                        }
                    }
                }
            }
            assert_close("blended", &got.blended, &blended);
            assert_close("grad_feature", &got.grad_feature, &grad_feature);
            assert_close("grad_weights", &got.grad_weights, &grad_weights);
            assert_close("written on the reference view", &got.written[0], &blended);
            assert_close("written on another view", &got.written[1], &around_only);
            for (got, before) in got.written.iter().zip([&case.feature; 2]) {
                let chosen = case.tokens[0] + case.tokens[1];
                for &a in &case.order[chosen..] {
                    let row = a as usize * FEATURE..(a as usize + 1) * FEATURE;
                    assert_eq!(got[row.clone()], before[row], "anchor {a} was not chosen");
                }
            }
        }
    }
}

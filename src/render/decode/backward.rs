//! The backward stage and its twins.

use super::forward::{each, lists};
use super::*;
use crate::gpu::kernels::render::{
    decode_backward, decode_backward_feature, decode_backward_first, decode_backward_hidden, decode_backward_second,
    decode_backward_weights, decode_backward_weights_second,
};
use crate::gpu::{Buffer, Check, Error, Form, Gpu, Recorder, Reference};
use crate::math::decoder::{FEATURE, Gaussian, HEADS, HIDDEN, INPUT, Layout, activate_backward, outputs_of};

impl Reference for decode_backward::Kernel {
    fn reference(host: decode_backward::Host<'_>, push: decode_backward::Push, constants: decode_backward::Constants) {
        let decode_backward::Host { mut grad_offset, mut grad_log_scaling, .. } = host;
        let layout = Layout { offsets: constants.offsets as usize };
        let grad_output = host.grad_output.as_flattened_mut();
        let n = host.groups[3] as usize;
        for v in 0..n {
            let anchor = host.visible[v] as usize;
            let log_scaling = six(host.log_scaling, anchor);
            let mut sum = [0.0; 6];
            for k in (0..layout.offsets).filter(|k| host.opacity[k * n + v] > push.above) {
                let (slot, at) = (k * n + v, anchor * layout.offsets + k);
                let of = Gaussian {
                    position: [0.0; 3],
                    opacity: host.opacity[slot].into(),
                    color: wide(host.color[slot]),
                    scale: wide(host.scale[slot]),
                    rotation: wide(host.rotation[slot]),
                    norm: host.rotation_norm[slot].into(),
                };
                let grad = if host.drawn[slot] == 0 {
                    Gaussian::default()
                } else {
                    Gaussian {
                        position: host.grad_position.map_or([0.0; 3], |grad| wide(grad[slot])),
                        opacity: host.grad_opacity[slot].into(),
                        color: wide(host.grad_color[slot]),
                        scale: wide(host.grad_scale[slot]),
                        rotation: wide(host.grad_rotation[slot]),
                        norm: 0.0,
                    }
                };
                let offset = host.offset.map_or([0.0; 3], |offset| wide(offset[at]));
                let g = activate_backward(&of, offset, log_scaling, &grad);
                if let Some(grad_offset) = &mut grad_offset {
                    grad_offset[at] = narrow(g.offset);
                }
                sum.iter_mut().zip(g.log_scaling).for_each(|(s, g)| *s += g);
                for (raw, (head, output)) in g.raw.into_iter().zip(outputs_of(k)) {
                    grad_output[v * layout.rows() + layout.row(head) + output] = raw as f32;
                }
            }
            if let Some(grad_log_scaling) = &mut grad_log_scaling {
                grad_log_scaling[6 * anchor..][..6].copy_from_slice(&narrow(sum));
            }
        }
    }

    /// Ten products, Vulkan's `exp` (27 units in the last place at e^-12), and `1 - sigmoid`, `g - q (q . g)`,
    /// which cancel: relative to the largest.
    fn check(_: &'static str) -> Check {
        sums(10 + 27)
    }
}

impl Reference for decode_backward_hidden::Kernel {
    fn reference(host: decode_backward_hidden::Host<'_>, (): (), constants: decode_backward_hidden::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        let packed = host.packed.as_flattened();
        let (grad_output, grad_hidden) = (host.grad_output.as_flattened(), host.grad_hidden.as_flattened_mut());
        for v in 0..host.groups[3] as usize {
            for unit in 0..HEADS * HIDDEN {
                let head = unit / HIDDEN;
                let product = |row: usize| {
                    f64::from(packed[4 * FIRST_VEC4 + row * HIDDEN + unit % HIDDEN])
                        * f64::from(grad_output[v * layout.rows() + row])
                };
                let at = v * HEADS * HIDDEN + unit;
                let sum: f64 = (layout.row(head)..layout.row(head + 1)).map(product).sum();
                let bits = host.positive[v * POSITIVE + unit / UNITS as usize];
                grad_hidden[at] = if bits >> (unit % UNITS as usize) & 1 > 0 { sum as f32 } else { 0.0 };
            }
        }
    }
    fn check(_: &'static str) -> Check {
        sums(72)
    }
}

impl Reference for decode_backward_feature::Kernel {
    fn reference(host: decode_backward_feature::Host<'_>, (): (), _: decode_backward_feature::Constants) {
        let (packed, grad_hidden) = (host.packed.as_flattened(), host.grad_hidden.as_flattened());
        let grad_feature = host.grad_feature.as_flattened_mut();
        for v in 0..host.groups[3] as usize {
            for i in 0..FEATURE {
                let product = |unit: usize| {
                    f64::from(packed[unit * Layout::PADDED_INPUT + i])
                        * f64::from(grad_hidden[v * HEADS * HIDDEN + unit])
                };
                let sum: f64 = (0..HEADS * HIDDEN).map(product).sum();
                grad_feature[FEATURE * host.visible[v] as usize + i] = sum as f32;
            }
        }
    }
    fn check(_: &'static str) -> Check {
        sums(HEADS * HIDDEN)
    }
}

/// Chunks of a weight gradient: the anchors of each.
pub(super) fn chunks(anchors: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    let chunk = chunk_anchors(anchors);
    (0..anchors).step_by(chunk).map(move |from| from..(from + chunk).min(anchors))
}

impl Reference for decode_backward_first::Kernel {
    fn reference(host: decode_backward_first::Host<'_>, (): (), (): ()) {
        let (inputs, grad_hidden) = (host.inputs.as_flattened(), host.grad_hidden.as_flattened());
        let partial = host.partial.as_flattened_mut();
        for (part, anchors) in chunks(host.groups[3] as usize).enumerate() {
            for unit in 0..HEADS * HIDDEN {
                for i in 0..Layout::PADDED_INPUT {
                    let product = |v: usize| {
                        f64::from(grad_hidden[v * HEADS * HIDDEN + unit])
                            * f64::from(inputs[v * Layout::PADDED_INPUT + i])
                    };
                    partial[4 * FIRST_VEC4 * part + unit * Layout::PADDED_INPUT + i] =
                        anchors.clone().map(product).sum::<f64>() as f32;
                }
            }
        }
    }
    fn check(_: &'static str) -> Check {
        sums(2 * BLOCK)
    }
}

/// Chunks of the lists: k, and the visible anchors of each.
pub(super) fn listed_chunks(segments: &[u32], listed: &[u32], offsets: usize) -> Vec<(usize, Vec<usize>)> {
    let chunk = chunk_listed(segments[offsets] as usize);
    lists(segments, listed, offsets)
        .flat_map(|(k, anchors)| anchors.chunks(chunk).map(|c| (k, c.to_vec())).collect::<Vec<_>>())
        .collect()
}

impl Reference for decode_backward_second::Kernel {
    /// `Cpu`: of the head that the constants name, otherwise of all.
    fn reference(host: decode_backward_second::Host<'_>, (): (), constants: decode_backward_second::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        let wanted = |of: usize| host.kernel == decode_backward_second::Kernel::Gpu || of == constants.head as usize;
        let (hidden, partial) = (host.hidden.as_flattened(), host.partial.as_flattened_mut());
        let chunks = listed_chunks(host.segments, host.listed, layout.offsets);
        for (part, (k, anchors)) in chunks.into_iter().enumerate() {
            let partial = &mut partial[4 * SECOND_VEC4 * part..][..4 * SECOND_VEC4];
            for (at, (of, output)) in outputs_of(k).enumerate().filter(|(_, (of, _))| wanted(*of)) {
                let grad = |v: usize| f64::from(host.grad_output[v * layout.rows() + layout.row(of) + output]);
                for j in 0..HIDDEN {
                    let product = |&v: &usize| grad(v) * f64::from(hidden[(v * HEADS + of) * HIDDEN + j]);
                    partial[at * HIDDEN + j] = anchors.iter().map(product).sum::<f64>() as f32;
                }
                partial[11 * HIDDEN + at] = anchors.iter().map(|&v| grad(v)).sum::<f64>() as f32;
            }
        }
    }
    fn check(_: &'static str) -> Check {
        sums(2 * BLOCK)
    }
}

impl Reference for decode_backward_weights::Kernel {
    fn reference(host: decode_backward_weights::Host<'_>, (): (), constants: decode_backward_weights::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        let (partial, parts) = (host.partial.as_flattened(), chunks(host.groups[3] as usize).count());
        for head in 0..HEADS {
            for unit in 0..HIDDEN {
                for i in 0..=INPUT {
                    let at = (head * HIDDEN + unit) * Layout::PADDED_INPUT + i;
                    let terms = (0..parts).map(|part| f64::from(partial[4 * FIRST_VEC4 * part + at]));
                    host.grad_weights[layout.first(head, unit, i)] = terms.sum::<f64>() as f32;
                }
            }
        }
    }
    fn check(_: &'static str) -> Check {
        sums(BLOCK)
    }
}

impl Reference for decode_backward_weights_second::Kernel {
    fn reference(
        host: decode_backward_weights_second::Host<'_>,
        (): (),
        constants: decode_backward_weights_second::Constants,
    ) {
        let layout = Layout { offsets: constants.offsets as usize };
        let (partial, segments) = (host.partial.as_flattened(), host.segments);
        let chunk = chunk_listed(segments[layout.offsets] as usize);
        let mut first = 0;
        for k in 0..layout.offsets {
            let parts = first..first + ((segments[k + 1] - segments[k]) as usize).div_ceil(chunk);
            for (row, (head, output)) in outputs_of(k).enumerate() {
                for j in 0..=HIDDEN {
                    let at = if j < HIDDEN { row * HIDDEN + j } else { 11 * HIDDEN + row };
                    let terms = parts.clone().map(|part| f64::from(partial[4 * SECOND_VEC4 * part + at]));
                    host.grad_weights[layout.second(head, output, j)] = terms.sum::<f64>() as f32;
                }
            }
            first = parts.end;
        }
    }
    fn check(_: &'static str) -> Check {
        sums(BLOCK)
    }
}

/// Threads that share a vec4's sum over chunks: a GPU has more threads than there are sums, a CPU has not.
pub(super) fn sum_lanes(form: Form) -> u32 {
    if form == Form::Gpu { 16 } else { 1 }
}

/// Threads for the sums of so many vec4s, in whole workgroups of 64.
pub(super) fn sum_threads(vec4s: usize, lanes: u32) -> usize {
    vec4s.div_ceil(64 / lanes as usize) * 64
}

/// Threads for the sums of each k's second layer: in whole workgroups of its own, where threads share them.
pub(super) fn second_sum_threads(offsets: usize, lanes: u32) -> usize {
    let each = if lanes == 1 { SECOND_VEC4 } else { sum_threads(SECOND_VEC4, lanes) };
    offsets * each
}

/// The backward stage: scratch for the gradients inside the decoder.
#[derive(Debug)]
pub struct DecodeBackward {
    grad_output: Buffer<[f32; 4]>,
    grad_hidden: Option<Buffer<[f32; 4]>>,
    sums: Option<Sums>,
}

/// Parts of the weights' gradients.
#[derive(Debug)]
struct Sums {
    first: Buffer<[f32; 4]>,
    second: Buffer<[f32; 4]>,
}

impl DecodeBackward {
    /// Scratch for the backward pass of `forward`.
    ///
    /// # Errors
    /// When the device has no memory for it.
    pub fn new(gpu: &Gpu, forward: &Decode) -> Result<Self, Error> {
        Self::of(gpu, forward, true, true)
    }

    /// As [`DecodeBackward::new`], without what only gradients of the features or of the weights need.
    ///
    /// # Errors
    /// When the device has no memory for it.
    pub fn of(gpu: &Gpu, forward: &Decode, feature: bool, weights: bool) -> Result<Self, Error> {
        let (anchors, rows) = (forward.capacity as usize, forward.layout.rows());
        let first = anchors.div_ceil(BLOCK).min(CHUNKS);
        let second = (anchors * forward.layout.offsets).div_ceil(BLOCK).min(SECOND_CHUNKS) + forward.layout.offsets;
        let sums = || -> Result<Sums, Error> {
            Ok(Sums {
                first: gpu.buffer("first", first * FIRST_VEC4)?,
                second: gpu.buffer("second", second * SECOND_VEC4)?,
            })
        };
        let hidden = || gpu.buffer("grad_hidden", anchors * HIDDEN_VEC4);
        Ok(Self {
            grad_output: gpu.buffer("grad_output", anchors * rows / 4)?,
            grad_hidden: if feature || weights { Some(hidden()?) } else { None },
            sums: if weights { Some(sums()?) } else { None },
        })
    }

    /// Records the gradients, after [`Decode::record`] with the same arguments.
    ///
    /// # Panics
    /// When a gradient is asked for that the stage was made without.
    pub fn record<'a>(
        &self,
        rec: &mut Recorder<'_>,
        forward: &Decode,
        anchors: Anchors<'_>,
        grad: GaussianGradients<'_>,
        to: impl Into<WantedGradients<'a>>,
    ) {
        let to: WantedGradients<'_> = to.into();
        let offsets = forward.layout.offsets as u32;
        let (groups, count) = (&forward.per_anchor, &forward.per_anchor.buffer);
        let (offset, log_scaling) = (anchors.offset, anchors.log_scaling);
        let (visible, grad_output) = (anchors.visible, &self.grad_output);
        let Decode { opacity, color, scale, rotation, rotation_norm, .. } = forward;
        let GaussianGradients { drawn, opacity: grad_opacity, color: grad_color, scale: grad_scale, .. } = grad;
        let (grad_position, grad_rotation) = (grad.position, grad.rotation);
        rec.zero(grad_output);
        let buffers = decode_backward::Buffers {
            groups: count,
            visible,
            offset: to.log_scaling.map(|_| offset),
            log_scaling,
            drawn,
            opacity,
            color,
            scale,
            rotation,
            rotation_norm,
            grad_position: (to.offset.is_some() || to.log_scaling.is_some()).then_some(grad_position),
            grad_opacity,
            grad_color,
            grad_scale,
            grad_rotation,
            grad_offset: to.offset,
            grad_log_scaling: to.log_scaling,
            grad_output,
        };
        let push = decode_backward::Push { above: forward.above };
        let each = if forward.form == Form::Gpu { each(offsets) } else { 0 };
        let groups = if each > 0 { &forward.per_gaussian } else { groups };
        rec.run_with(decode_backward::Kernel, decode_backward::Constants { offsets, each }, buffers, push, groups);
        if to.feature.is_none() && to.weights.is_none() {
            return;
        }
        let grad_hidden = self.grad_hidden.as_ref().expect("made with features or weights");
        let Decode { packed, inputs, hidden, positive, segments, existing, form, lanes, .. } = forward;
        let (listed, lanes) = (&existing.list, *lanes);
        let buffers = decode_backward_hidden::Buffers { groups: count, packed, positive, grad_output, grad_hidden };
        let kernel = decode_backward_hidden::Kernel::from(lanes);
        let constants = decode_backward_hidden::Constants { offsets };
        rec.run_with(kernel, constants, buffers, (), &forward.per_hidden_backward);
        if let Some(grad_feature) = to.feature {
            let grad_feature = &grad_feature.view();
            let buffers =
                decode_backward_feature::Buffers { groups: count, visible, packed, grad_hidden, grad_feature };
            rec.run(decode_backward_feature::Kernel::from(lanes), buffers, (), &forward.per_feature);
        }
        let Some(grad_weights) = to.weights else { return };
        let Sums { first, second } = self.sums.as_ref().expect("made with weights");
        let buffers = decode_backward_first::Buffers { groups: count, inputs, grad_hidden, partial: first };
        rec.run(decode_backward_first::Kernel::from(lanes), buffers, (), &forward.per_first);
        let rows = &self.grad_output.view();
        let buffers = decode_backward_second::Buffers { segments, listed, hidden, grad_output: rows, partial: second };
        let (kernel, heads) = (decode_backward_second::Kernel::from(*form), if *form == Form::Gpu { 1 } else { HEADS });
        for head in 0..heads as u32 {
            let constants = decode_backward_second::Constants { offsets, head };
            rec.run_with(kernel, constants, buffers, (), &forward.per_second);
        }
        let lanes = sum_lanes(*form);
        let buffers = decode_backward_weights::Buffers { groups: count, partial: first, grad_weights };
        let constants = decode_backward_weights::Constants { offsets, lanes };
        rec.run_with(decode_backward_weights::Kernel, constants, buffers, (), sum_threads(FIRST_VEC4, lanes));
        let buffers = decode_backward_weights_second::Buffers { segments, partial: second, grad_weights };
        let constants = decode_backward_weights_second::Constants { offsets, lanes };
        let threads = second_sum_threads(forward.layout.offsets, lanes);
        rec.run_with(decode_backward_weights_second::Kernel, constants, buffers, (), threads);
    }
}

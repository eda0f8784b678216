//! Visible anchors into neural Gaussians (Scaffold-GS, section 3.2), and the gradients back to the model.
//!
//! Two in three Gaussians do not exist: their opacity is not positive. Opacities come first; the Gaussians that exist are
//! listed by their number k, then by anchor ([`Slots`]), and the other heads and the second layer's weight gradients are
//! computed for those alone. What is not listed is not written. On the way back those of them that touch no tile have a
//! gradient of 0, whatever its arrays hold.
//!
//! Both layers and all their gradients are matrix products. In the form for GPUs a workgroup takes blocks of both operands
//! through shared memory, and a thread sums 4 x 4 of the result in registers (`product.glsl`); the second layer, whose
//! Gaussians are few of each k, has 2 Gaussians to a thread. In the form of lanes, for CPU drivers with subgroups of 8, a
//! thread has 16 units of 8 anchors, or outputs of 16 Gaussians, and the lanes share what they load; Gaussians of one
//! thread have the same k and so the same weights. Activations are kept from the forward pass: 40 + 96 values per visible anchor, 11 K padded to heads of 8 more for the backward pass; at K = 10
//! each of these buffers stays below 128 MiB up to 240,000 visible anchors.
//!
//! Weight gradients sum in a fixed tree: in float32 over chunks of 64 anchors, of 64 listed Gaussians of the same k (more
//! only beyond 65,536 visible anchors and 524,288 Gaussians: at most 1,024 and 8,192 + K chunks), then over runs of 32
//! chunks, then over the runs. With n anchors or Gaussians the rounding error is at most
//! `(n / 1024 + 64 + 32 + 32) 2^-24` of the sum of the terms' magnitudes.

use super::slots::Slots;
use crate::gpu::kernels::render::{
    decode, decode_backward, decode_backward_feature, decode_backward_feature_lanes, decode_backward_first,
    decode_backward_first_lanes, decode_backward_fixed, decode_backward_fixed_offset, decode_backward_fixed_scaling,
    decode_backward_hidden, decode_backward_hidden_lanes, decode_backward_second, decode_backward_second_wide,
    decode_backward_weights, decode_backward_weights_second, decode_hidden, decode_hidden_lanes, decode_input,
    decode_lists, decode_opacity, decode_pack,
};
use crate::gpu::{Buffer, Check, Error, Form, Gpu, Groups, Kernel, Recorder, Reference};
use crate::math::camera::{from_center, split};
use crate::math::decoder::{
    FEATURE, Gaussian, HEADS, HIDDEN, INPUT, Layout, activate, activate_backward, input, outputs_of,
};
use crate::primitives::dispatch::{self, Shape};
use crate::primitives::{Compact, Count, scan};

/// Threads of a workgroup of all kernels here.
const GROUP: u32 = 64;
/// Units or features of a thread.
const UNITS: u32 = 16;
/// Opacities of an anchor in a thread.
const OPACITIES: u32 = 5;
/// Anchors of a block of a product: in the forms for GPUs, where a workgroup has one.
const BLOCK_ANCHORS: u32 = 32;
/// Threads of the gradient of one Gaussian's second layer in its form for GPUs.
const SECOND_THREADS: u32 = 88;
/// In the forms of lanes: threads of a workgroup, its anchors, and parts of the hidden units.
const LANES: u32 = 8;
const LANES_ANCHORS: u32 = 64;
const LANES_PARTS: u32 = 2;
/// vec4s of one Gaussian's second layer: 11 rows and 11 biases.
const SECOND_VEC4: usize = 91;
/// vec4s of a padded input, of the hidden units.
const INPUT_VEC4: usize = Layout::PADDED_INPUT / 4;
const HIDDEN_VEC4: usize = HEADS * HIDDEN / 4;
/// Words of the hidden units' signs.
const POSITIVE: usize = HEADS * HIDDEN / UNITS as usize;
/// vec4s of the packed first layer.
const FIRST_VEC4: usize = HEADS * HIDDEN * INPUT_VEC4;
/// Anchors of the smallest chunk of a weight gradient, and chunks at most.
const BLOCK: usize = 64;
const CHUNKS: usize = 1024;
const SECOND_CHUNKS: usize = 8192;

/// Anchors of one chunk.
fn chunk_anchors(anchors: usize) -> usize {
    BLOCK * anchors.div_ceil(BLOCK * CHUNKS).max(1)
}

/// Listed Gaussians of one chunk.
fn chunk_listed(listed: usize) -> usize {
    BLOCK * listed.div_ceil(BLOCK * SECOND_CHUNKS).max(1)
}

/// Anchors or Gaussians of a thread in the kernels of the second layer: more share a load, fewer leave registers free.
fn tile(gpu: &Gpu) -> u32 {
    if gpu.form() == Form::Cpu { 16 } else { 2 }
}

fn wide<const C: usize>(v: [f32; C]) -> [f64; C] {
    v.map(f64::from)
}

fn narrow<const C: usize>(v: [f64; C]) -> [f32; C] {
    v.map(|v| v as f32)
}

fn six(flat: &[f32], at: usize) -> [f64; 6] {
    std::array::from_fn(|i| flat[6 * at + i].into())
}

/// Float32 sums of `terms` products: half a rounding each, relative to the terms' magnitudes, which stay within a few
/// times the largest result.
fn sums(terms: usize) -> Check {
    let bound = terms as f64 * 6e-8;
    Check { relative: bound, absolute: bound, band: 0.0 }
}

impl Reference for decode_pack::Kernel {
    fn reference(host: decode_pack::Host<'_>, (): (), constants: decode_pack::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        host.slot_count[0] = host.groups[3] * constants.offsets;
        let packed = host.packed.as_flattened_mut();
        packed[..4 * layout.packed()].fill(0.0);
        for unit in 0..HEADS * HIDDEN {
            for i in 0..=INPUT {
                packed[unit * Layout::PADDED_INPUT + i] = host.weights[layout.first(unit / HIDDEN, unit % HIDDEN, i)];
            }
        }
        for row in 0..layout.rows() {
            if let (head, Some(output)) = layout.output_of(row) {
                for j in 0..HIDDEN {
                    packed[4 * FIRST_VEC4 + row * HIDDEN + j] = host.weights[layout.second(head, output, j)];
                }
                let bias = 4 * FIRST_VEC4 + layout.rows() * HIDDEN + row;
                packed[bias] = host.weights[layout.second(head, output, HIDDEN)];
            }
        }
    }
    fn check(_: &'static str) -> Check {
        Check { relative: 0.0, absolute: 0.0, band: 0.0 }
    }
}

impl Reference for decode_input::Kernel {
    fn reference(host: decode_input::Host<'_>, push: decode_input::Push, (): ()) {
        for v in 0..host.groups[3] as usize {
            let anchor = host.visible[v] as usize;
            let feature = std::array::from_fn(|i| host.feature[FEATURE * anchor + i].into());
            let seen = from_center(host.position[anchor], [push.center, push.center_low]);
            let x = input(feature, wide(seen));
            let to = &mut host.inputs.as_flattened_mut()[v * Layout::PADDED_INPUT..][..Layout::PADDED_INPUT];
            to.fill(0.0);
            to[..INPUT].copy_from_slice(&narrow(x));
            to[INPUT] = 1.0;
        }
    }
}

macro_rules! hidden_twin {
    ($module:ident) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), _: <Self as Kernel>::Constants) {
                let (packed, inputs) = (host.packed.as_flattened(), host.inputs.as_flattened());
                let hidden = host.hidden.as_flattened_mut();
                for v in 0..host.groups[3] as usize {
                    for unit in 0..HEADS * HIDDEN {
                        let product = |i: usize| {
                            f64::from(packed[unit * Layout::PADDED_INPUT + i])
                                * f64::from(inputs[v * Layout::PADDED_INPUT + i])
                        };
                        let sum: f64 = (0..Layout::PADDED_INPUT).map(product).sum();
                        let h = sum.max(0.0) as f32;
                        hidden[v * HEADS * HIDDEN + unit] = h;
                        let bits = &mut host.positive[v * POSITIVE + unit / UNITS as usize];
                        *bits = if unit % UNITS as usize == 0 { 0 } else { *bits };
                        *bits |= u32::from(h > 0.0) << (unit % UNITS as usize);
                    }
                }
            }
            /// A unit within rounding of 0 may be positive or not: one in some ten thousand at most.
            fn check(binding: &'static str) -> Check {
                Check { band: if binding == "positive" { 2e-3 } else { 0.0 }, ..sums(Layout::PADDED_INPUT) }
            }
        }
    };
}
hidden_twin!(decode_hidden);
hidden_twin!(decode_hidden_lanes);

impl Reference for decode_opacity::Kernel {
    fn reference(host: decode_opacity::Host<'_>, push: decode_opacity::Push, constants: decode_opacity::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        let (packed, hidden) = (host.packed.as_flattened(), host.hidden.as_flattened());
        let n = host.groups[3] as usize;
        for v in 0..n {
            for k in 0..layout.offsets {
                let opacity = second_layer(layout, packed, hidden, v, (0, k)).tanh() as f32;
                let slot = k * n + v;
                host.opacity[slot] = opacity;
                host.flags[slot] = (opacity > push.above).into();
            }
        }
    }

    /// As `decode`'s.
    fn check(_: &'static str) -> Check {
        sums(33 + 27)
    }
}

/// Output `(head, output)` of visible anchor `v`.
fn second_layer(layout: Layout, packed: &[f32], hidden: &[f32], v: usize, (head, output): (usize, usize)) -> f64 {
    let (second, row) = (4 * FIRST_VEC4, layout.row(head) + output);
    let product =
        |j: usize| f64::from(packed[second + row * HIDDEN + j]) * f64::from(hidden[(v * HEADS + head) * HIDDEN + j]);
    (0..HIDDEN).map(product).sum::<f64>() + f64::from(packed[second + layout.rows() * HIDDEN + row])
}

impl Reference for decode_lists::Kernel {
    fn reference(host: decode_lists::Host<'_>, (): (), constants: decode_lists::Constants) {
        let (n, offsets, end) = (host.groups[3], constants.offsets, host.listed_count[0]);
        for k in 0..=offsets {
            let before = host.listed[..end as usize].iter().filter(|&&i| i < k * n).count();
            host.segments[k as usize] = before as u32;
        }
        host.segments[offsets as usize + 1] = n;
        host.bound[0] = end + offsets * BLOCK as u32;
    }
}

/// For each k the visible anchors whose Gaussian k is listed.
fn lists<'a>(segments: &'a [u32], listed: &'a [u32], offsets: usize) -> impl Iterator<Item = (usize, Vec<usize>)> + 'a {
    let n = segments[offsets + 1] as usize;
    (0..offsets).map(move |k| {
        let of = &listed[segments[k] as usize..segments[k + 1] as usize];
        (k, of.iter().map(|&i| i as usize - k * n).collect())
    })
}

impl Reference for decode::Kernel {
    fn reference(host: decode::Host<'_>, push: decode::Push, constants: decode::Constants) {
        let layout = Layout { offsets: constants.offsets as usize };
        let (packed, hidden) = (host.packed.as_flattened(), host.hidden.as_flattened());
        let n = host.segments[layout.offsets + 1] as usize;
        for (k, anchors) in lists(host.segments, host.listed, layout.offsets) {
            for v in anchors {
                let anchor = host.visible[v] as usize;
                let seen = from_center(host.anchor_position[anchor], [push.center, push.center_low]);
                let mut raw = [0.0; 11];
                for (raw, of) in raw.iter_mut().zip(outputs_of(k)) {
                    *raw = second_layer(layout, packed, hidden, v, of);
                }
                let slot = k * n + v;
                let offset = wide(host.offset[anchor * layout.offsets + k]);
                let g = activate(raw, wide(seen), offset, six(host.log_scaling, anchor));
                host.position[slot] = narrow(g.position);
                host.color[slot] = narrow(g.color);
                host.scale[slot] = narrow(g.scale);
                host.rotation[slot] = narrow(g.rotation);
                host.rotation_norm[slot] = g.norm as f32;
            }
        }
    }

    /// A sum of 33 products, and Vulkan's `exp`, which may be `3 + 2 |x|` units in the last place off: 27 at e^-12.
    fn check(_: &'static str) -> Check {
        sums(33 + 27)
    }
}

/// `offset` and `scaling` name what is trained of the two; `position` the gradient they need.
macro_rules! backward_twin {
    ($module:ident $(, position: $position:ident)? $(, offset: $offset:ident)? $(, scaling: $scaling:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, push: $module::Push, constants: $module::Constants) {
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
                        let (mut _position, mut _offset) = ([0.0; 3], [0.0; 3]);
                        $(_position = wide(host.$position[slot]);)?
                        $(
                            let _ = &host.$scaling;
                            _offset = wide(host.offset[at]);
                        )?
                        let grad = if host.drawn[slot] == 0 { Gaussian::default() } else { Gaussian {
                            position: _position,
                            opacity: host.grad_opacity[slot].into(),
                            color: wide(host.grad_color[slot]),
                            scale: wide(host.grad_scale[slot]),
                            rotation: wide(host.grad_rotation[slot]),
                            norm: 0.0,
                        } };
                        let g = activate_backward(&of, _offset, log_scaling, &grad);
                        let _ = at;
                        $(host.$offset[at] = narrow(g.offset);)?
                        sum.iter_mut().zip(g.log_scaling).for_each(|(s, g)| *s += g);
                        for (raw, (head, output)) in g.raw.into_iter().zip(outputs_of(k)) {
                            grad_output[v * layout.rows() + layout.row(head) + output] = raw as f32;
                        }
                    }
                    let _ = (anchor, sum);
                    $(host.$scaling[6 * anchor..][..6].copy_from_slice(&narrow(sum));)?
                }
            }

            /// Ten products, Vulkan's `exp` (27 units in the last place at e^-12), and `1 - sigmoid`, `g - q (q . g)`,
            /// which cancel: relative to the largest.
            fn check(_: &'static str) -> Check {
                sums(10 + 27)
            }
        }
    };
}
backward_twin!(decode_backward, position: grad_position, offset: grad_offset, scaling: grad_log_scaling);
backward_twin!(decode_backward_fixed_offset, position: grad_position, scaling: grad_log_scaling);
backward_twin!(decode_backward_fixed_scaling, position: grad_position, offset: grad_offset);
backward_twin!(decode_backward_fixed);

macro_rules! backward_hidden_twin {
    ($module:ident) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), constants: $module::Constants) {
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
    };
}
backward_hidden_twin!(decode_backward_hidden);
backward_hidden_twin!(decode_backward_hidden_lanes);

macro_rules! backward_feature_twin {
    ($module:ident) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), _: <Self as Kernel>::Constants) {
                let (packed, grad_hidden) = (host.packed.as_flattened(), host.grad_hidden.as_flattened());
                for v in 0..host.groups[3] as usize {
                    for i in 0..FEATURE {
                        let product = |unit: usize| {
                            f64::from(packed[unit * Layout::PADDED_INPUT + i])
                                * f64::from(grad_hidden[v * HEADS * HIDDEN + unit])
                        };
                        let sum: f64 = (0..HEADS * HIDDEN).map(product).sum();
                        let grad_feature: &mut [f32] = bytemuck::cast_slice_mut(host.grad_feature);
                        grad_feature[FEATURE * host.visible[v] as usize + i] = sum as f32;
                    }
                }
            }
            fn check(_: &'static str) -> Check {
                sums(HEADS * HIDDEN)
            }
        }
    };
}
backward_feature_twin!(decode_backward_feature);
backward_feature_twin!(decode_backward_feature_lanes);

/// Chunks of a weight gradient: the anchors of each.
fn chunks(anchors: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    let chunk = chunk_anchors(anchors);
    (0..anchors).step_by(chunk).map(move |from| from..(from + chunk).min(anchors))
}

macro_rules! backward_first_twin {
    ($module:ident) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), (): ()) {
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
    };
}
backward_first_twin!(decode_backward_first);
backward_first_twin!(decode_backward_first_lanes);

/// Chunks of the lists: k, and the visible anchors of each.
fn listed_chunks(segments: &[u32], listed: &[u32], offsets: usize) -> Vec<(usize, Vec<usize>)> {
    let chunk = chunk_listed(segments[offsets] as usize);
    lists(segments, listed, offsets)
        .flat_map(|(k, anchors)| anchors.chunks(chunk).map(|c| (k, c.to_vec())).collect::<Vec<_>>())
        .collect()
}

/// Of the head that the constants name, or of all.
macro_rules! backward_second_twin {
    ($module:ident $(, $head:ident)?) => {
        impl Reference for $module::Kernel {
            fn reference(host: $module::Host<'_>, (): (), constants: $module::Constants) {
                let layout = Layout { offsets: constants.offsets as usize };
                let wanted = |_of: usize| true $(&& _of == constants.$head as usize)?;
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
    };
}
backward_second_twin!(decode_backward_second, head);
backward_second_twin!(decode_backward_second_wide);

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

/// The part of the model that is decoded.
#[derive(Clone, Copy)]
pub struct Anchors<'a> {
    /// World, \[N\].
    pub position: &'a Buffer<[f32; 3]>,
    /// \[N*32\], after the attention if there is any.
    pub feature: &'a Buffer<f32>,
    /// \[N*K\], in units of the anchor's scaling.
    pub offset: &'a Buffer<[f32; 3]>,
    /// \[N*6\], of the offsets 3, of the Gaussians 3.
    pub log_scaling: &'a Buffer<f32>,
    /// \[W\] of the three decoders.
    pub weights: &'a Buffer<f32>,
    /// Anchors to decode, ascending, \[V\].
    pub visible: &'a Buffer<u32>,
}

/// Gradients of [`Decode`]'s outputs, \[slot\].
#[derive(Clone, Copy)]
pub struct GaussianGradients<'a> {
    /// Not 0 where a Gaussian has a gradient: the tiles that it touches. Elsewhere the others count as 0.
    pub drawn: &'a Buffer<u32>,
    /// World.
    pub position: &'a Buffer<[f32; 3]>,
    /// Of the opacity.
    pub opacity: &'a Buffer<f32>,
    /// Of the color.
    pub color: &'a Buffer<[f32; 3]>,
    /// Of the standard deviations.
    pub scale: &'a Buffer<[f32; 3]>,
    /// Of the normalised quaternion.
    pub rotation: &'a Buffer<[f32; 4]>,
}

/// Where the model's gradients go.
#[derive(Clone, Copy)]
pub struct AnchorGradients<'a> {
    /// \[N*32\]; rows of visible anchors are written, the others left alone.
    pub feature: &'a Buffer<f32>,
    /// \[N*K\]; those of Gaussians that exist are written, the others left alone.
    pub offset: &'a Buffer<[f32; 3]>,
    /// \[N*6\], as the features'.
    pub log_scaling: &'a Buffer<f32>,
    /// \[W\], every one is written.
    pub weights: &'a Buffer<f32>,
}

/// The gradients that somebody reads.
#[derive(Clone, Copy)]
pub struct WantedGradients<'a> {
    /// As [`AnchorGradients::feature`].
    pub feature: Option<&'a Buffer<f32>>,
    /// As [`AnchorGradients::offset`].
    pub offset: Option<&'a Buffer<[f32; 3]>>,
    /// As [`AnchorGradients::log_scaling`].
    pub log_scaling: Option<&'a Buffer<f32>>,
    /// As [`AnchorGradients::weights`].
    pub weights: Option<&'a Buffer<f32>>,
}

impl<'a> From<AnchorGradients<'a>> for WantedGradients<'a> {
    fn from(AnchorGradients { feature, offset, log_scaling, weights }: AnchorGradients<'a>) -> Self {
        Self { feature: Some(feature), offset: Some(offset), log_scaling: Some(log_scaling), weights: Some(weights) }
    }
}

/// The forward stage. Every slot of a visible anchor has an opacity; the rest is there for Gaussians that exist.
#[derive(Debug)]
pub struct Decode {
    /// Seen from the camera's centre, world axes, \[slot\].
    pub position: Buffer<[f32; 3]>,
    /// -1 to 1; the Gaussian exists where > 0, \[slot\].
    pub opacity: Buffer<f32>,
    /// 0 to 1, \[slot\].
    pub color: Buffer<[f32; 3]>,
    /// Standard deviations, world, \[slot\].
    pub scale: Buffer<[f32; 3]>,
    /// Unit quaternions w x y z, \[slot\].
    pub rotation: Buffer<[f32; 4]>,
    rotation_norm: Buffer<f32>,
    packed: Buffer<[f32; 4]>,
    inputs: Buffer<[f32; 4]>,
    hidden: Buffer<[f32; 4]>,
    positive: Buffer<u32>,
    /// `[slot]` which are decoded, and how many slots there are.
    flags: Buffer<u32>,
    slot_count: Buffer<u32>,
    /// Those that are: they exist.
    pub existing: Slots,
    /// `[K+2]` of `decode_lists`.
    segments: Buffer<u32>,
    bound: Buffer<u32>,
    compact: Compact,
    per_anchor: Groups,
    per_hidden: Groups,
    per_opacity: Groups,
    per_flag: Groups,
    per_hidden_backward: Groups,
    per_feature: Groups,
    per_first: Groups,
    per_listed: Groups,
    per_second: Groups,
    layout: Layout,
    capacity: u32,
    above: f32,
    form: Form,
    tile: u32,
    lanes: bool,
}

impl Decode {
    /// For [`Decode::of`]: what exists.
    pub const EXISTING: f32 = 0.0;
    /// For [`Decode::of`]: every Gaussian, whether it exists or not.
    pub const ALL: f32 = -2.0;

    /// Buffers for `capacity` visible anchors of `offsets` Gaussians each; those that exist are decoded.
    ///
    /// # Errors
    /// When the device has no memory for them.
    pub fn new(gpu: &Gpu, capacity: u32, offsets: u32) -> Result<Self, Error> {
        Self::of(gpu, capacity, offsets, Self::EXISTING)
    }

    /// As [`Decode::new`], where the Gaussians with an opacity above `above` are decoded.
    ///
    /// # Errors
    /// As [`Decode::new`].
    pub fn of(gpu: &Gpu, capacity: u32, offsets: u32, above: f32) -> Result<Self, Error> {
        let (anchors, layout) = (capacity as usize, Layout { offsets: offsets as usize });
        let slots = anchors * layout.offsets;
        let lanes = gpu.lanes();
        // Workgroups of the passes over hidden units, back through them, to the features, to the first layer.
        let [hidden, back, feature, first] = if lanes {
            [LANES; 4]
        } else {
            [
                decode_hidden::Kernel::GROUP,
                decode_backward_hidden::Kernel::GROUP,
                decode_backward_feature::Kernel::GROUP,
                decode_backward_first::Kernel::GROUP,
            ]
            .map(|[threads, ..]| threads)
        };
        let shapes = [GROUP, hidden, GROUP, GROUP, back, feature, first];
        let [per_anchor, per_hidden, per_opacity, per_flag, per_hidden_backward, per_feature, per_first] =
            dispatch::several(gpu, "anchor groups", shapes)?;
        let [per_existing, per_listed, per_second] = dispatch::several(gpu, "listed groups", [GROUP; 3])?;
        Ok(Self {
            position: gpu.buffer("position", slots)?,
            opacity: gpu.buffer("opacity", slots)?,
            color: gpu.buffer("color", slots)?,
            scale: gpu.buffer("scale", slots)?,
            rotation: gpu.buffer("rotation", slots)?,
            rotation_norm: gpu.buffer("rotation_norm", slots)?,
            packed: gpu.buffer("packed", layout.packed())?,
            inputs: gpu.buffer("inputs", anchors * INPUT_VEC4)?,
            hidden: gpu.buffer("hidden", anchors * HIDDEN_VEC4)?,
            positive: gpu.buffer("positive", anchors * POSITIVE)?,
            flags: gpu.buffer("decoded", slots)?,
            slot_count: gpu.buffer("slot_count", 1)?,
            existing: Slots {
                list: gpu.buffer("listed", slots)?,
                count: gpu.buffer("listed_count", 1)?,
                groups: per_existing,
            },
            segments: gpu.buffer("segments", layout.offsets + 2)?,
            bound: gpu.buffer("listed_bound", 1)?,
            compact: Compact::new(gpu, slots as u32)?,
            per_anchor,
            per_hidden,
            per_opacity,
            per_flag,
            per_hidden_backward,
            per_feature,
            per_first,
            per_listed,
            per_second,
            layout,
            capacity,
            above,
            form: gpu.form(),
            tile: tile(gpu),
            lanes,
        })
    }

    /// Slots in use: those of all visible anchors.
    pub fn slots(&self) -> Count<'_> {
        Count::Counted(&self.slot_count, &self.per_flag)
    }

    /// `[slot]` whether a Gaussian was decoded.
    pub fn decoded(&self) -> &Buffer<u32> {
        &self.flags
    }

    /// Most entries of the lists if each k's were padded to chunks.
    fn most_bound(&self) -> u32 {
        (self.capacity + BLOCK as u32) * self.layout.offsets as u32
    }

    /// How many threads the passes over visible anchors have, and those over their slots.
    fn count(&self, rec: &mut Recorder<'_>, visible_count: &Buffer<u32>) {
        let (offsets, tile, lanes) = (self.layout.offsets as u32, self.tile, self.lanes);
        let of = |tile: u32, factor: u32| Shape { tile, factor };
        // A workgroup for each tile and part.
        let parts =
            |groups: &Groups, parts: u32| of(if lanes { LANES_ANCHORS } else { BLOCK_ANCHORS }, groups.group * parts);
        let shapes = [
            (&self.per_anchor, Shape::EACH),
            (&self.per_hidden, parts(&self.per_hidden, if lanes { LANES_PARTS } else { 1 })),
            (&self.per_opacity, of(tile, offsets.div_ceil(OPACITIES))),
            (&self.per_flag, of(scan::SHAPE.tile, offsets)),
            (&self.per_hidden_backward, parts(&self.per_hidden_backward, HEADS as u32)),
            (&self.per_feature, parts(&self.per_feature, 1)),
            (&self.per_first, of(BLOCK as u32, self.per_first.group)),
        ];
        dispatch::record_several(rec, visible_count, self.capacity, shapes);
    }

    /// Records the decoding of the first `visible_count` anchors of the visible list for a camera centre (world).
    /// More than the capacity are not decoded.
    pub fn record(&self, rec: &mut Recorder<'_>, anchors: Anchors<'_>, visible_count: &Buffer<u32>, center: [f64; 3]) {
        let [center, center_low] = split(center);
        let (offsets, tile) = (self.layout.offsets as u32, self.tile);
        self.count(rec, visible_count);
        let Self { packed, inputs, hidden, positive, opacity, flags, slot_count, existing, segments, bound, .. } = self;
        let Slots { list: listed, count: listed_count, .. } = existing;
        let groups = &self.per_anchor.buffer;
        let pack = decode_pack::Buffers { weights: anchors.weights, groups, packed, slot_count };
        rec.run_with(decode_pack::Kernel, decode_pack::Constants { offsets }, pack, (), self.layout.packed());
        let buffers = decode_input::Buffers {
            groups,
            visible: anchors.visible,
            position: anchors.position,
            feature: anchors.feature,
            inputs,
        };
        rec.run(decode_input::Kernel, buffers, decode_input::Push { center, center_low }, &self.per_anchor);
        if self.lanes {
            let buffers = decode_hidden_lanes::Buffers { groups, packed, inputs, hidden, positive };
            rec.run(decode_hidden_lanes::Kernel, buffers, (), &self.per_hidden);
        } else {
            let buffers = decode_hidden::Buffers { groups, packed, inputs, hidden, positive };
            rec.run(decode_hidden::Kernel, buffers, (), &self.per_hidden);
        }
        let buffers = decode_opacity::Buffers { groups, packed, hidden, opacity, flags };
        let push = decode_opacity::Push { above: self.above };
        let constants = decode_opacity::Constants { offsets, tile };
        rec.run_with(decode_opacity::Kernel, constants, buffers, push, &self.per_opacity);
        self.compact.record(rec, flags, listed, listed_count, self.slots());
        let buffers = decode_lists::Buffers { groups, listed, listed_count, segments, bound };
        rec.run_with(decode_lists::Kernel, decode_lists::Constants { offsets }, buffers, (), offsets + 1);
        let parts = if self.form == Form::Gpu { SECOND_THREADS } else { HIDDEN as u32 / UNITS };
        let shapes = [
            (&existing.groups, Shape::EACH),
            (&self.per_listed, Shape { tile, factor: 1 }),
            (&self.per_second, Shape { tile: BLOCK as u32, factor: parts }),
        ];
        dispatch::record_several(rec, bound, self.most_bound(), shapes);
        let buffers = decode::Buffers {
            segments,
            listed,
            visible: anchors.visible,
            anchor_position: anchors.position,
            offset: anchors.offset,
            log_scaling: anchors.log_scaling,
            packed,
            hidden,
            position: &self.position,
            color: &self.color,
            scale: &self.scale,
            rotation: &self.rotation,
            rotation_norm: &self.rotation_norm,
        };
        let push = decode::Push { center, center_low };
        rec.run_with(decode::Kernel, decode::Constants { offsets, tile }, buffers, push, &self.per_listed);
    }
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
        macro_rules! back {
            ($module:ident $(, $field:ident)*) => {{
                let buffers = $module::Buffers {
                    groups: count, visible, log_scaling, drawn, opacity, color, scale, rotation, rotation_norm,
                    grad_opacity, grad_color, grad_scale, grad_rotation, grad_output $(, $field)*
                };
                let push = $module::Push { above: forward.above };
                rec.run_with($module::Kernel, $module::Constants { offsets }, buffers, push, groups);
            }};
        }
        rec.zero(grad_output);
        match (to.offset, to.log_scaling) {
            (Some(grad_offset), Some(grad_log_scaling)) => {
                back!(decode_backward, offset, grad_position, grad_offset, grad_log_scaling);
            }
            (None, Some(grad_log_scaling)) => {
                back!(decode_backward_fixed_offset, offset, grad_position, grad_log_scaling);
            }
            (Some(grad_offset), None) => back!(decode_backward_fixed_scaling, grad_position, grad_offset),
            (None, None) => back!(decode_backward_fixed),
        }
        if to.feature.is_none() && to.weights.is_none() {
            return;
        }
        let grad_hidden = self.grad_hidden.as_ref().expect("made with features or weights");
        let Decode { packed, inputs, hidden, positive, segments, existing, form, lanes, .. } = forward;
        let listed = &existing.list;
        let groups = &forward.per_hidden_backward;
        if *lanes {
            let buffers =
                decode_backward_hidden_lanes::Buffers { groups: count, packed, positive, grad_output, grad_hidden };
            let constants = decode_backward_hidden_lanes::Constants { offsets };
            rec.run_with(decode_backward_hidden_lanes::Kernel, constants, buffers, (), groups);
        } else {
            let buffers = decode_backward_hidden::Buffers { groups: count, packed, positive, grad_output, grad_hidden };
            let constants = decode_backward_hidden::Constants { offsets };
            rec.run_with(decode_backward_hidden::Kernel, constants, buffers, (), groups);
        }
        if let Some(grad_feature) = to.feature {
            let groups = &forward.per_feature;
            let grad_feature = &grad_feature.view();
            if *lanes {
                let buffers = decode_backward_feature_lanes::Buffers {
                    groups: count,
                    visible,
                    packed,
                    grad_hidden,
                    grad_feature,
                };
                rec.run(decode_backward_feature_lanes::Kernel, buffers, (), groups);
            } else {
                let buffers =
                    decode_backward_feature::Buffers { groups: count, visible, packed, grad_hidden, grad_feature };
                rec.run(decode_backward_feature::Kernel, buffers, (), groups);
            }
        }
        let Some(grad_weights) = to.weights else { return };
        let Sums { first, second } = self.sums.as_ref().expect("made with weights");
        if *lanes {
            let buffers = decode_backward_first_lanes::Buffers { groups: count, inputs, grad_hidden, partial: first };
            rec.run(decode_backward_first_lanes::Kernel, buffers, (), &forward.per_first);
        } else {
            let buffers = decode_backward_first::Buffers { groups: count, inputs, grad_hidden, partial: first };
            rec.run(decode_backward_first::Kernel, buffers, (), &forward.per_first);
        }
        let rows = &self.grad_output.view();
        if *form == Form::Gpu {
            let buffers =
                decode_backward_second_wide::Buffers { segments, listed, hidden, grad_output: rows, partial: second };
            let constants = decode_backward_second_wide::Constants { offsets };
            rec.run_with(decode_backward_second_wide::Kernel, constants, buffers, (), &forward.per_second);
        } else {
            for head in 0..HEADS as u32 {
                let buffers =
                    decode_backward_second::Buffers { segments, listed, hidden, grad_output: rows, partial: second };
                let constants = decode_backward_second::Constants { offsets, head };
                rec.run_with(decode_backward_second::Kernel, constants, buffers, (), &forward.per_second);
            }
        }
        let buffers = decode_backward_weights::Buffers { groups: count, partial: first, grad_weights };
        let constants = decode_backward_weights::Constants { offsets };
        rec.run_with(decode_backward_weights::Kernel, constants, buffers, (), FIRST_VEC4);
        let buffers = decode_backward_weights_second::Buffers { segments, partial: second, grad_weights };
        let constants = decode_backward_weights_second::Constants { offsets };
        let threads = forward.layout.offsets * SECOND_VEC4;
        rec.run_with(decode_backward_weights_second::Kernel, constants, buffers, (), threads);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;
    use crate::gpu::{Difference, Options, Timings, testing};
    use crate::math::decoder;

    struct Model {
        offsets: usize,
        position: Vec<[f32; 3]>,
        feature: Vec<f32>,
        offset: Vec<[f32; 3]>,
        log_scaling: Vec<f32>,
        weights: Vec<f32>,
        visible: Vec<u32>,
        center: [f64; 3],
        above: f32,
    }

    fn random<const C: usize>(rng: &mut Pcg64, n: usize, low: f32, high: f32) -> Vec<[f32; C]> {
        (0..n).map(|_| std::array::from_fn(|_| low + (high - low) * rng.random::<f32>())).collect()
    }

    fn flat(rng: &mut Pcg64, n: usize, low: f32, high: f32) -> Vec<f32> {
        random::<1>(rng, n, low, high).into_flattened()
    }

    /// So many visible anchors among half as many more: every third is not.
    fn model(rng: &mut Pcg64, visible: usize, offsets: usize) -> Model {
        let ids: Vec<u32> = (0..).filter(|i| i % 3 != 1).take(visible).collect();
        let anchors = ids.last().map_or(0, |&i| i as usize) + 2;
        Model {
            offsets,
            position: random(rng, anchors, -1.0, 1.0),
            feature: flat(rng, anchors * FEATURE, -1.0, 1.0),
            offset: random(rng, anchors * offsets, -1.0, 1.0),
            log_scaling: flat(rng, 6 * anchors, -6.0, 0.5),
            weights: flat(rng, Layout { offsets }.weights(), -0.3, 0.3),
            visible: ids,
            center: [0.2, -0.3, -3.0],
            above: Decode::ALL,
        }
    }

    impl Model {
        fn counted(&self) -> Vec<u32> {
            vec![1, 1, 1, self.visible.len() as u32]
        }
        fn layout(&self) -> Layout {
            Layout { offsets: self.offsets }
        }
    }

    fn unwritten<const C: usize>(n: usize) -> Vec<[f32; C]> {
        vec![[testing::UNWRITTEN; C]; n]
    }

    /// Runs a kernel against its twin and returns what it wrote. More threads than needed: the kernel has to stop.
    fn twin<K: Reference>(
        kernel: K,
        gpu: &Gpu,
        constants: K::Constants,
        case: K::Arrays,
        push: K::Push,
        n: usize,
    ) -> K::Arrays
    where
        K::Constants: Clone,
    {
        testing::assert_twin_with(kernel, gpu, constants, case.clone(), push, n + 70);
        let mut words = K::words(case);
        K::reference(K::host(&mut words), push, constants);
        K::arrays(&words)
    }

    /// Every kernel against its twin, each fed with the twins before it.
    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(1);
        let every = [(0, 10), (1, 10), (63, 10), (64, 10), (65, 10), (1000, 10), (65, 5), (3, 1), (130, 20)];
        // Tiles of both sizes; those that exist, all, none.
        for ((count, offsets), (tile, above)) in
            every.into_iter().zip([(2, 0.0), (16, 0.0), (16, -2.0), (2, 2.0)].into_iter().cycle())
        {
            let m = model(&mut rng, count, offsets);
            let (layout, slots, k) = (m.layout(), count * offsets, offsets as u32);
            let case = decode_pack::Arrays {
                weights: m.weights.clone(),
                groups: m.counted(),
                packed: unwritten(layout.packed() + 3),
                slot_count: vec![7],
            };
            let constants = decode_pack::Constants { offsets: k };
            let packed = twin(decode_pack::Kernel, &gpu, constants, case, (), layout.packed()).packed;
            let case = decode_input::Arrays {
                groups: m.counted(),
                visible: m.visible.clone(),
                position: m.position.clone(),
                feature: m.feature.clone(),
                inputs: unwritten(count * INPUT_VEC4 + 3),
            };
            let [center, center_low] = split(m.center);
            let push = decode_input::Push { center, center_low };
            let inputs = twin(decode_input::Kernel, &gpu, (), case, push, count).inputs;
            let shared = gpu.runs_lanes();
            let groups_of = |parts: usize| 8 * parts * count.div_ceil(64);
            macro_rules! hidden {
                ($module:ident) => {
                    $module::Arrays {
                        groups: m.counted(),
                        packed: packed.clone(),
                        inputs: inputs.clone(),
                        hidden: unwritten(count * HIDDEN_VEC4 + 3),
                        positive: vec![7; count * POSITIVE + 3],
                    }
                };
            }
            if shared {
                twin(decode_hidden_lanes::Kernel, &gpu, (), hidden!(decode_hidden_lanes), (), groups_of(2));
            }
            let case = hidden!(decode_hidden);
            let tiles = |n: usize| n.div_ceil(tile as usize);
            let blocks = count.div_ceil(BLOCK_ANCHORS as usize);
            let decode_hidden::Arrays { hidden, positive, .. } =
                twin(decode_hidden::Kernel, &gpu, (), case, (), blocks * 192);
            let case = decode_opacity::Arrays {
                groups: m.counted(),
                packed: packed.clone(),
                hidden: hidden.clone(),
                opacity: vec![testing::UNWRITTEN; slots + 3],
                flags: vec![7; slots + 3],
            };
            let constants = decode_opacity::Constants { offsets: k, tile };
            let push = decode_opacity::Push { above };
            let threads = tiles(count) * offsets.div_ceil(5);
            let flagged = twin(decode_opacity::Kernel, &gpu, constants, case, push, threads);
            let mut listed: Vec<u32> = (0..slots as u32).filter(|&i| flagged.flags[i as usize] == 1).collect();
            assert!(above == 0.0 || listed.len() == if above < 0.0 { slots } else { 0 });
            let found = listed.len();
            listed.extend([0; 3]);
            let case = decode_lists::Arrays {
                groups: m.counted(),
                listed: listed.clone(),
                listed_count: vec![found as u32],
                segments: vec![7; offsets + 4],
                bound: vec![7; 2],
            };
            let constants = decode_lists::Constants { offsets: k };
            let segments = twin(decode_lists::Kernel, &gpu, constants, case, (), offsets + 1).segments;
            let case = decode::Arrays {
                segments: segments.clone(),
                listed: listed.clone(),
                visible: m.visible.clone(),
                anchor_position: m.position.clone(),
                offset: m.offset.clone(),
                log_scaling: m.log_scaling.clone(),
                packed: packed.clone(),
                hidden: hidden.clone(),
                position: unwritten(slots + 3),
                color: unwritten(slots + 3),
                scale: unwritten(slots + 3),
                rotation: unwritten(slots + 3),
                rotation_norm: vec![testing::UNWRITTEN; slots + 3],
            };
            let constants = decode::Constants { offsets: k, tile };
            let push = decode::Push { center, center_low };
            let forward = twin(decode::Kernel, &gpu, constants, case, push, tiles(found) + offsets);

            // Every other of those that exist touches a tile.
            let mut touched = vec![0; slots + 3];
            for &slot in &listed[..found] {
                touched[slot as usize] = (slot + slot / k) % 2 * 3;
            }
            let case = decode_backward::Arrays {
                groups: m.counted(),
                visible: m.visible.clone(),
                offset: m.offset.clone(),
                log_scaling: m.log_scaling.clone(),
                drawn: touched,
                opacity: flagged.opacity,
                color: forward.color,
                scale: forward.scale,
                rotation: forward.rotation,
                rotation_norm: forward.rotation_norm,
                grad_position: random(&mut rng, slots, -1.0, 1.0),
                grad_opacity: flat(&mut rng, slots, -1.0, 1.0),
                grad_color: random(&mut rng, slots, -1.0, 1.0),
                grad_scale: random(&mut rng, slots, -1.0, 1.0),
                grad_rotation: random(&mut rng, slots, -1.0, 1.0),
                grad_offset: unwritten(m.offset.len()),
                grad_log_scaling: vec![testing::UNWRITTEN; m.log_scaling.len()],
                grad_output: vec![[0.0; 4]; count * layout.rows() / 4 + 3],
            };
            macro_rules! fixed {
                ($module:ident $(, $field:ident)*) => {{
                    let c = case.clone();
                    let case = $module::Arrays {
                        groups: c.groups, visible: c.visible, log_scaling: c.log_scaling, drawn: c.drawn,
                        opacity: c.opacity, color: c.color, scale: c.scale, rotation: c.rotation, rotation_norm: c.rotation_norm,
                        grad_opacity: c.grad_opacity, grad_color: c.grad_color, grad_scale: c.grad_scale,
                        grad_rotation: c.grad_rotation, grad_output: c.grad_output $(, $field: c.$field)*
                    };
                    twin($module::Kernel, &gpu, $module::Constants { offsets: k }, case, $module::Push { above }, count);
                }};
            }
            fixed!(decode_backward_fixed_offset, offset, grad_position, grad_log_scaling);
            fixed!(decode_backward_fixed_scaling, grad_position, grad_offset);
            fixed!(decode_backward_fixed);
            let constants = decode_backward::Constants { offsets: k };
            let push = decode_backward::Push { above };
            let grad_output = twin(decode_backward::Kernel, &gpu, constants, case, push, count).grad_output;
            macro_rules! backward_hidden {
                ($module:ident) => {
                    $module::Arrays {
                        groups: m.counted(),
                        packed: packed.clone(),
                        positive: positive.clone(),
                        grad_output: grad_output.clone(),
                        grad_hidden: unwritten(count * HIDDEN_VEC4 + 3),
                    }
                };
            }
            if shared {
                let constants = decode_backward_hidden_lanes::Constants { offsets: k };
                let case = backward_hidden!(decode_backward_hidden_lanes);
                twin(decode_backward_hidden_lanes::Kernel, &gpu, constants, case, (), groups_of(3));
            }
            let case = backward_hidden!(decode_backward_hidden);
            let constants = decode_backward_hidden::Constants { offsets: k };
            let threads = blocks * 3 * 64;
            let grad_hidden = twin(decode_backward_hidden::Kernel, &gpu, constants, case, (), threads).grad_hidden;
            if shared {
                let case = decode_backward_feature_lanes::Arrays {
                    groups: m.counted(),
                    visible: m.visible.clone(),
                    packed: packed.clone(),
                    grad_hidden: grad_hidden.clone(),
                    grad_feature: unwritten(m.feature.len() / 4),
                };
                twin(decode_backward_feature_lanes::Kernel, &gpu, (), case, (), groups_of(1));
            }
            let case = decode_backward_feature::Arrays {
                groups: m.counted(),
                visible: m.visible.clone(),
                packed: packed.clone(),
                grad_hidden: grad_hidden.clone(),
                grad_feature: unwritten(m.feature.len() / 4),
            };
            twin(decode_backward_feature::Kernel, &gpu, (), case, (), blocks * 64);
            let parts = count.div_ceil(BLOCK);
            if shared {
                let case = decode_backward_first_lanes::Arrays {
                    groups: m.counted(),
                    inputs: inputs.clone(),
                    grad_hidden: grad_hidden.clone(),
                    partial: unwritten(parts * FIRST_VEC4 + 3),
                };
                twin(decode_backward_first_lanes::Kernel, &gpu, (), case, (), parts * 8);
            }
            let case = decode_backward_first::Arrays {
                groups: m.counted(),
                inputs: inputs.clone(),
                grad_hidden: grad_hidden.clone(),
                partial: unwritten(parts * FIRST_VEC4 + 3),
            };
            let first = twin(decode_backward_first::Kernel, &gpu, (), case, (), parts * 240).partial;
            let grad_weights = vec![testing::UNWRITTEN; layout.weights() + 3];
            let chunks = listed_chunks(&segments, &listed, offsets).len();
            let rows = grad_output.into_flattened();
            let mut second = unwritten(chunks * SECOND_VEC4 + 3);
            for head in 0..3 {
                let case = decode_backward_second::Arrays {
                    segments: segments.clone(),
                    listed: listed.clone(),
                    hidden: hidden.clone(),
                    grad_output: rows.clone(),
                    partial: second,
                };
                let constants = decode_backward_second::Constants { offsets: k, head };
                second = twin(decode_backward_second::Kernel, &gpu, constants, case, (), chunks * 2).partial;
            }
            let case = decode_backward_second_wide::Arrays {
                segments: segments.clone(),
                listed: listed.clone(),
                hidden: hidden.clone(),
                grad_output: rows.clone(),
                partial: unwritten(chunks * SECOND_VEC4 + 3),
            };
            let constants = decode_backward_second_wide::Constants { offsets: k };
            twin(decode_backward_second_wide::Kernel, &gpu, constants, case, (), chunks * SECOND_THREADS as usize);
            let case = decode_backward_weights::Arrays { groups: m.counted(), partial: first, grad_weights };
            let constants = decode_backward_weights::Constants { offsets: k };
            let grad_weights =
                twin(decode_backward_weights::Kernel, &gpu, constants, case, (), FIRST_VEC4).grad_weights;
            let case = decode_backward_weights_second::Arrays { segments, partial: second, grad_weights };
            let constants = decode_backward_weights_second::Constants { offsets: k };
            let threads = offsets * SECOND_VEC4;
            let all = twin(decode_backward_weights_second::Kernel, &gpu, constants, case, (), threads).grad_weights;
            assert!(all[..layout.weights()].iter().all(|g| g.is_finite()), "every weight has a gradient");
        }
    }

    /// Beyond 65,536 anchors, and 524,288 Gaussians, a chunk has more than 64.
    #[test]
    fn long_chunks_match_their_twins() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(11);
        let (count, offsets) = (65_601, 9);
        let layout = Layout { offsets };
        let groups = vec![1, 1, 1, count as u32];
        let parts = chunks(count).count();
        assert_eq!(parts, 513);
        let case = decode_backward_first::Arrays {
            groups: groups.clone(),
            inputs: random(&mut rng, count * INPUT_VEC4, -1.0, 1.0),
            grad_hidden: random(&mut rng, count * HIDDEN_VEC4, -1.0, 1.0),
            partial: unwritten(parts * FIRST_VEC4 + 3),
        };
        let partial = twin(decode_backward_first::Kernel, &gpu, (), case, (), parts * 240).partial;
        let grad_weights = vec![testing::UNWRITTEN; layout.weights() + 3];
        let case = decode_backward_weights::Arrays { groups, partial, grad_weights };
        let constants = decode_backward_weights::Constants { offsets: 9 };
        let grad_weights = twin(decode_backward_weights::Kernel, &gpu, constants, case, (), FIRST_VEC4).grad_weights;
        let listed: Vec<u32> = (0..(count * offsets) as u32).collect();
        let segments: Vec<u32> = (0..=9).map(|k| k * count as u32).chain([count as u32]).collect();
        let chunks = listed_chunks(&segments, &listed, offsets).len();
        assert_eq!(chunks, 9 * 513);
        let case = decode_backward_second::Arrays {
            segments: segments.clone(),
            listed,
            hidden: random(&mut rng, count * HIDDEN_VEC4, -1.0, 1.0),
            grad_output: flat(&mut rng, count * layout.rows(), -1.0, 1.0),
            partial: vec![[0.0; 4]; chunks * SECOND_VEC4 + 3],
        };
        let constants = decode_backward_second::Constants { offsets: 9, head: 0 };
        let partial = twin(decode_backward_second::Kernel, &gpu, constants, case, (), chunks * 2).partial;
        let case = decode_backward_weights_second::Arrays { segments, partial, grad_weights };
        let constants = decode_backward_weights_second::Constants { offsets: 9 };
        twin(decode_backward_weights_second::Kernel, &gpu, constants, case, (), offsets * SECOND_VEC4);
    }

    struct Results {
        outputs: Vec<(&'static str, Vec<f32>)>,
        gradients: Vec<(&'static str, Vec<f32>)>,
        upstream: Vec<Gaussian>,
    }

    impl Results {
        /// Sets a Gaussian's outputs but its opacity, and its gradient, to 0.
        fn forget(&mut self, slot: usize) {
            for (name, values) in &mut self.outputs {
                let width = match *name {
                    "opacity" => continue,
                    "rotation" => 4,
                    _ => 3,
                };
                values[width * slot..][..width].fill(0.0);
            }
            self.upstream[slot] = Gaussian::default();
        }
    }

    /// Both stages on the device. Gradient buffers start at `before`.
    fn run(
        gpu: &Gpu,
        m: &Model,
        rng: &mut Pcg64,
        capacity: u32,
        before: f32,
        timings: Option<&mut Timings>,
    ) -> Results {
        let fine = "the device has memory for a test";
        let position = gpu.upload("anchor", &m.position).expect(fine);
        let feature = gpu.upload("feature", &m.feature).expect(fine);
        let offset = gpu.upload("offset", &m.offset).expect(fine);
        let log_scaling = gpu.upload("log_scaling", &m.log_scaling).expect(fine);
        let weights = gpu.upload("weights", &m.weights).expect(fine);
        let visible = gpu.upload("visible", &m.visible).expect(fine);
        let count = gpu.upload("visible_count", &[m.visible.len() as u32]).expect(fine);
        let slots = capacity as usize * m.offsets;
        let g3: [Vec<[f32; 3]>; 3] = std::array::from_fn(|_| random(rng, slots, -1.0, 1.0));
        let (g1, g4) = (flat(rng, slots, -1.0, 1.0), random::<4>(rng, slots, -1.0, 1.0));
        let [gp, gc, gs] = std::array::from_fn(|i| gpu.upload("upstream", &g3[i]).expect(fine));
        let go = gpu.upload("upstream opacity", &g1).expect(fine);
        let gr = gpu.upload("upstream rotation", &g4).expect(fine);
        let to_feature = gpu.upload("grad_feature", &vec![before; m.feature.len()]).expect(fine);
        let to_offset = gpu.upload("grad_offset", &vec![[before; 3]; m.offset.len()]).expect(fine);
        let to_scaling = gpu.upload("grad_log_scaling", &vec![before; m.log_scaling.len()]).expect(fine);
        let to_weights = gpu.upload("grad_weights", &vec![before; m.weights.len()]).expect(fine);
        let forward = Decode::of(gpu, capacity, m.offsets as u32, m.above).expect(fine);
        let backward = DecodeBackward::new(gpu, &forward).expect(fine);
        let anchors = Anchors {
            position: &position,
            feature: &feature,
            offset: &offset,
            log_scaling: &log_scaling,
            weights: &weights,
            visible: &visible,
        };
        let drawn = forward.decoded();
        let grad = GaussianGradients { drawn, position: &gp, opacity: &go, color: &gc, scale: &gs, rotation: &gr };
        let to = AnchorGradients {
            feature: &to_feature,
            offset: &to_offset,
            log_scaling: &to_scaling,
            weights: &to_weights,
        };
        let step = || {
            let mut rec = gpu.recorder().expect(fine);
            forward.record(&mut rec, anchors, &count, m.center);
            backward.record(&mut rec, &forward, anchors, grad, to);
            rec.submit().and_then(crate::gpu::Submission::wait).expect("the device runs it")
        };
        step();
        if let Some(timings) = timings {
            (0..5).for_each(|_| timings.add(&step()));
        }
        let read3 = |b: &Buffer<[f32; 3]>| gpu.read(b).expect(fine).into_flattened();
        let read = |b: &Buffer<f32>| gpu.read(b).expect(fine);
        let upstream = (0..slots).map(|s| Gaussian {
            position: wide(g3[0][s]),
            opacity: g1[s].into(),
            color: wide(g3[1][s]),
            scale: wide(g3[2][s]),
            rotation: wide(g4[s]),
            norm: 0.0,
        });
        Results {
            outputs: vec![
                ("position", read3(&forward.position)),
                ("opacity", read(&forward.opacity)),
                ("color", read3(&forward.color)),
                ("scale", read3(&forward.scale)),
                ("rotation", gpu.read(&forward.rotation).expect(fine).into_flattened()),
            ],
            gradients: vec![
                ("offset", read3(&to_offset)),
                ("log_scaling", read(&to_scaling)),
                ("feature", read(&to_feature)),
                ("weights", read(&to_weights)),
            ],
            upstream: upstream.collect(),
        }
    }

    /// The stages (counts on the device, packing, tiles, sums over chunks) against the float64 decoder anchor by anchor.
    #[test]
    fn stages_match_the_decoder() {
        let gpu = testing::gpu();
        let mut rng = Pcg64::seed_from_u64(2);
        let cases = [(0usize, 10, Decode::ALL), (1, 10, Decode::ALL), (85, 10, Decode::EXISTING)];
        let more = [(500, 10, Decode::ALL), (500, 10, Decode::EXISTING), (77, 7, Decode::EXISTING)];
        for (count, offsets, above) in cases.into_iter().chain(more) {
            let mut m = model(&mut rng, count, offsets);
            m.above = above;
            let mut got = run(&gpu, &m, &mut rng, count as u32 + 5, 7.0, None);
            let layout = m.layout();
            let weights: Vec<f64> = m.weights.iter().map(|&w| w.into()).collect();
            let before = |n: usize| vec![7.0; n];
            let mut grad_weights = vec![0.0; weights.len()];
            let (mut offset, mut scaling, mut feature) =
                (before(3 * m.offset.len()), before(m.log_scaling.len()), before(m.feature.len()));
            let mut outputs = [3, 1, 3, 3, 4].map(|width| vec![0.0; width * count * offsets]);
            for (v, &anchor) in m.visible.iter().enumerate() {
                let a = anchor as usize;
                let row: [f64; FEATURE] = std::array::from_fn(|i| m.feature[FEATURE * a + i].into());
                let at: [f64; 3] = std::array::from_fn(|i| f64::from(m.position[a][i]) - m.center[i]);
                let ls = six(&m.log_scaling, a);
                let x = input(row, at);
                let o: Vec<[f64; 3]> = m.offset[a * offsets..][..offsets].iter().map(|o| wide(*o)).collect();
                let gaussians = decoder::decode(layout, &weights, &x, at, &o, ls);
                for (k, g) in gaussians.iter().enumerate() {
                    let slot = k * count + v;
                    outputs[1][slot] = g.opacity;
                    // What is not decoded is not written, and its gradient is not read.
                    if g.opacity <= f64::from(above) {
                        got.forget(slot);
                        continue;
                    }
                    for (which, values) in [(0, &g.position[..]), (2, &g.color), (3, &g.scale), (4, &g.rotation)] {
                        outputs[which][values.len() * slot..][..values.len()].copy_from_slice(values);
                    }
                }
                let upstream: Vec<Gaussian> = (0..offsets).map(|k| got.upstream[k * count + v]).collect();
                let g = decoder::decode_backward(layout, &weights, &x, at, &o, ls, &upstream, &mut grad_weights);
                for (k, _) in gaussians.iter().enumerate().filter(|(_, g)| g.opacity > f64::from(above)) {
                    offset[3 * (a * offsets + k)..][..3].copy_from_slice(&g.offset[k]);
                }
                scaling[6 * a..][..6].copy_from_slice(&g.log_scaling);
                feature[FEATURE * a..][..FEATURE].copy_from_slice(&g.feature);
            }
            // A chain of three sums of 40, 33 and 72 products, and as many again over anchors.
            let compare = |name: &str, got: &[f32], want: &[f64]| {
                let got: Vec<f64> = got.iter().map(|&v| v.into()).collect();
                let difference = Difference::of("decode", name, &got[..want.len()], want, sums(300));
                assert!(difference.ok(), "{count} anchors: {difference}");
                assert!(difference.cosine > 1.0 - 1e-9, "{difference}");
            };
            for ((name, got), want) in got.outputs.iter().zip(&outputs) {
                compare(name, got, want);
            }
            for ((name, got), want) in got.gradients.iter().zip([offset, scaling, feature, grad_weights]) {
                compare(name, got, &want);
            }
        }
    }

    /// More visible anchors than the capacity: nothing is written beyond the buffers, the rest is as without overflow.
    #[test]
    fn a_full_stage_stays_within_its_buffers() {
        let gpu = testing::gpu();
        let m = model(&mut Pcg64::seed_from_u64(3), 100, 10);
        let full = run(&gpu, &m, &mut Pcg64::seed_from_u64(4), 70, 0.0, None);
        let room = run(&gpu, &m, &mut Pcg64::seed_from_u64(4), 100, 0.0, None);
        for ((_, a), (_, b)) in full.outputs.iter().zip(&room.outputs) {
            let width = b.len() / 1000;
            for (k, (a, b)) in a.chunks(70 * width).zip(b.chunks(100 * width)).enumerate() {
                assert_eq!(a, &b[..a.len()], "Gaussians {k}");
            }
        }
    }

    /// Same inputs, same bytes.
    #[test]
    fn gradients_are_deterministic() {
        let gpu = testing::gpu();
        let m = model(&mut Pcg64::seed_from_u64(5), 700, 10);
        let [a, b] = [0, 1].map(|_| run(&gpu, &m, &mut Pcg64::seed_from_u64(6), 700, 0.0, None));
        assert_eq!(a.gradients, b.gradients);
    }

    /// A camera on an anchor: no direction, distance 0, nothing that is not finite.
    #[test]
    fn a_camera_on_an_anchor_sees_no_direction() {
        let gpu = testing::gpu();
        let mut m = model(&mut Pcg64::seed_from_u64(7), 2, 10);
        m.center = m.center.map(|v| (v as f32).into());
        m.position[m.visible[1] as usize] = m.center.map(|v| v as f32);
        let results = run(&gpu, &m, &mut Pcg64::seed_from_u64(8), 2, 0.0, None);
        assert!(results.outputs.iter().chain(&results.gradients).all(|(_, v)| v.iter().all(|x| x.is_finite())));
        let x = input([0.5; FEATURE], [0.0; 3]);
        assert_eq!(x[32..], [0.0; 4]);
    }

    /// Chunks stay at 64 anchors up to 65,536 and at most 1,024 afterwards; none is empty, none is missed.
    #[test]
    fn chunks_partition_the_anchors() {
        for n in [0, 1, 64, 65, 65_536, 65_537, 250_000] {
            let all: Vec<_> = chunks(n).collect();
            assert!(all.len() <= CHUNKS && all.iter().map(ExactSizeIterator::len).sum::<usize>() == n);
            assert!(n > 65_536 || all.iter().all(|c| c.len() <= BLOCK));
        }
    }

    /// Prints milliseconds per pass when `GSCREAM_TIMINGS` is set; always checks that every pass was timed.
    #[test]
    fn passes_are_timed() {
        let device = std::env::var("GSCREAM_DEVICE").ok();
        let gpu = Gpu::open(&Options { device, timestamps: true, ..Options::default() }).expect("a device");
        let wanted = std::env::var_os("GSCREAM_TIMINGS").is_some();
        for count in if wanted { vec![2000, 20_000] } else { vec![10] } {
            let m = model(&mut Pcg64::seed_from_u64(9), count, 10);
            let mut timings = Timings::default();
            run(&gpu, &m, &mut Pcg64::seed_from_u64(10), count as u32, 0.0, Some(&mut timings));
            println!("{count} visible anchors\n{}", timings.table());
            assert!(timings.per_submission().iter().any(|(name, ..)| *name == "render/decode_backward_weights"));
        }
    }
}

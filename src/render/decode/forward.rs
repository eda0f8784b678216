//! The forward stage and its twins.

use super::*;
use crate::gpu::kernels::render::{
    decode, decode_backward_feature, decode_backward_first, decode_backward_hidden, decode_hidden, decode_input,
    decode_lists, decode_opacity, decode_pack,
};
use crate::gpu::{Buffer, Check, Error, Form, Gpu, Groups, Kernel, Recorder, Reference};
use crate::math::camera::{from_center, split};
use crate::math::decoder::{FEATURE, HEADS, HIDDEN, INPUT, Layout, activate, input, outputs_of};
use crate::primitives::dispatch::{self, Shape};
use crate::primitives::{Compact, Count, scan};
use crate::render::slots::Slots;

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

impl Reference for decode_hidden::Kernel {
    fn reference(host: decode_hidden::Host<'_>, (): (), _: decode_hidden::Constants) {
        let (packed, inputs) = (host.packed.as_flattened(), host.inputs.as_flattened());
        let hidden = host.hidden.as_flattened_mut();
        for v in 0..host.groups[3] as usize {
            for unit in 0..HEADS * HIDDEN {
                let product = |i: usize| {
                    f64::from(packed[unit * Layout::PADDED_INPUT + i]) * f64::from(inputs[v * Layout::PADDED_INPUT + i])
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
pub(super) fn second_layer(
    layout: Layout,
    packed: &[f32],
    hidden: &[f32],
    v: usize,
    (head, output): (usize, usize),
) -> f64 {
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
    }
}

/// Anchors whose Gaussians a workgroup has a thread for each of; 0 where they are too many for one.
pub(super) fn each(offsets: u32) -> u32 {
    64 / offsets
}

/// For each k the visible anchors whose Gaussian k is listed.
pub(super) fn lists<'a>(
    segments: &'a [u32],
    listed: &'a [u32],
    offsets: usize,
) -> impl Iterator<Item = (usize, Vec<usize>)> + 'a {
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
    pub(super) rotation_norm: Buffer<f32>,
    pub(super) packed: Buffer<[f32; 4]>,
    pub(super) inputs: Buffer<[f32; 4]>,
    pub(super) hidden: Buffer<[f32; 4]>,
    pub(super) positive: Buffer<u32>,
    /// `[slot]` which are decoded, and how many slots there are.
    pub(super) flags: Buffer<u32>,
    pub(super) slot_count: Buffer<u32>,
    /// Those that are: they exist.
    pub existing: Slots,
    /// `[K+2]` of `decode_lists`.
    pub(super) segments: Buffer<u32>,
    pub(super) compact: Compact,
    pub(super) per_anchor: Groups,
    pub(super) per_hidden: Groups,
    pub(super) per_opacity: Groups,
    pub(super) per_flag: Groups,
    pub(super) per_hidden_backward: Groups,
    pub(super) per_feature: Groups,
    pub(super) per_first: Groups,
    pub(super) per_gaussian: Groups,
    pub(super) per_listed: Groups,
    pub(super) per_second: Groups,
    pub(super) layout: Layout,
    pub(super) capacity: u32,
    pub(super) above: f32,
    pub(super) form: Form,
    pub(super) tile: u32,
    /// Of the kernels of lanes.
    pub(super) lanes: Form,
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
        let lanes = if gpu.lanes() { Form::Cpu } else { Form::Gpu };
        // Workgroups of the passes over hidden units, back through them, to the features, to the first layer.
        let [hidden, back, feature, first] = if lanes == Form::Cpu {
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
        let shapes = [GROUP, hidden, GROUP, GROUP, back, feature, first, GROUP];
        let [per_anchor, per_hidden, per_opacity, per_flag, per_hidden_backward, per_feature, per_first, per_gaussian] =
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
            compact: Compact::new(gpu, slots as u32)?,
            per_anchor,
            per_hidden,
            per_opacity,
            per_flag,
            per_hidden_backward,
            per_feature,
            per_first,
            per_gaussian,
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

    /// How many threads the passes over visible anchors have, and those over their slots.
    fn count(&self, rec: &mut Recorder<'_>, visible_count: &Buffer<u32>) {
        let (offsets, tile, lanes) = (self.layout.offsets as u32, self.tile, self.lanes == Form::Cpu);
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
            (&self.per_gaussian, of(each(offsets).max(1), GROUP)),
        ];
        dispatch::record_several(rec, visible_count, self.capacity, shapes);
    }

    /// Records the decoding of the first `visible_count` anchors of the visible list for a camera centre (world).
    /// More than the capacity are not decoded.
    pub fn record(&self, rec: &mut Recorder<'_>, anchors: Anchors<'_>, visible_count: &Buffer<u32>, center: [f64; 3]) {
        let [center, center_low] = split(center);
        let (offsets, tile) = (self.layout.offsets as u32, self.tile);
        self.count(rec, visible_count);
        let Self { packed, inputs, hidden, positive, opacity, flags, slot_count, existing, segments, .. } = self;
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
        let buffers = decode_hidden::Buffers { groups, packed, inputs, hidden, positive };
        rec.run(decode_hidden::Kernel::from(self.lanes), buffers, (), &self.per_hidden);
        let buffers = decode_opacity::Buffers { groups, packed, hidden, opacity, flags };
        let push = decode_opacity::Push { above: self.above };
        let constants = decode_opacity::Constants { offsets, tile };
        rec.run_with(decode_opacity::Kernel, constants, buffers, push, &self.per_opacity);
        self.compact.record(rec, flags, listed, listed_count, self.slots());
        let parts = if self.form == Form::Gpu { SECOND_THREADS } else { HIDDEN as u32 / UNITS };
        let shapes = [
            (&existing.groups, Shape::EACH),
            (&self.per_listed, Shape { tile, factor: 1 }),
            (&self.per_second, Shape { tile: BLOCK as u32, factor: parts }),
        ];
        // As if each k's list were padded to chunks. Counted beside the list, before who reads the list waits for it.
        dispatch::record_more(rec, listed_count, (self.capacity * offsets, BLOCK as u32 * offsets), shapes);
        let buffers = decode_lists::Buffers { groups, listed, listed_count, segments };
        rec.run_with(decode_lists::Kernel, decode_lists::Constants { offsets }, buffers, (), offsets + 1);
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

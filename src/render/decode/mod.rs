//! Visible anchors into neural Gaussians (Scaffold-GS, section 3.2), and the gradients back to the model.
//!
//! Two in three Gaussians do not exist: their opacity is not positive. Opacities come first; the Gaussians that exist are
//! listed by their number k, then by anchor ([`Slots`](super::slots::Slots)), and the other heads and the second layer's weight gradients are
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

mod backward;
mod forward;
#[cfg(test)]
mod tests;

use crate::gpu::{Buffer, Check, Form, Gpu};
use crate::math::decoder::{HEADS, HIDDEN, Layout};
pub use backward::DecodeBackward;
pub use forward::Decode;

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

/// Bytes per anchor in view of the widest buffer that decoding it needs, for `offsets` Gaussians each: the hidden units,
/// the gradients of the outputs, or a vector of four per Gaussian.
pub fn widest(offsets: u32) -> u64 {
    let rows = Layout { offsets: offsets as usize }.rows();
    4 * (HEADS * HIDDEN).max(rows).max(4 * offsets as usize) as u64
}

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

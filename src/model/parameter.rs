//! A learnt array on the device: its values, Adam's moments, its gradient, and the groups that its elements belong to.
//!
//! A model is a list of these. Whatever handles parameters iterates over the list: zeroing of gradients, the search for
//! values that are not finite, Adam, growth and pruning, checkpoints, read-back.

use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::optimizer::Group;

/// Names of a parameter's buffers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Names {
    /// Of the values, and of the parameter.
    pub value: &'static str,
    /// Of Adam's first moment.
    pub first: &'static str,
    /// Of the root of Adam's second moment.
    pub root: &'static str,
    /// Of dL/dvalue.
    pub gradient: &'static str,
}

impl Names {
    /// Of the buffers that are kept from step to step.
    pub fn kept(&self) -> [&'static str; 3] {
        [self.value, self.first, self.root]
    }

    /// Whether a buffer of this name belongs to the parameter.
    pub fn contain(&self, name: &str) -> bool {
        self.kept().contains(&name) || self.gradient == name
    }
}

/// [`Names`] made from one: `names!("feature")`.
macro_rules! names {
    ($name:literal) => {
        $crate::model::parameter::Names {
            value: $name,
            first: concat!($name, "_first"),
            root: concat!($name, "_root"),
            gradient: concat!("grad_", $name),
        }
    };
}
pub(crate) use names;

/// The decoders, flat.
pub const WEIGHTS: Names = names!("weights");

/// The attention's projections, flat.
pub const PROJECTIONS: Names = Names {
    value: "attention_weights",
    first: "attention_first",
    root: "attention_root",
    gradient: "grad_attention_weights",
};

/// Groups of the decoders, in the order of their weights.
pub const DECODERS: [Group; 3] = [Group::MlpOpacity, Group::MlpColor, Group::MlpCov];

/// The elements of a parameter from `first` to the next part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// The group they belong to.
    pub group: Group,
    /// The first of them.
    pub first: u32,
}

/// A learnt array, `width` floats per row: a row is an anchor, or all of a network.
#[derive(Debug)]
pub struct Parameter {
    /// Names of the buffers.
    pub names: Names,
    /// `[rows * width]`
    pub value: Buffer<f32>,
    /// Adam's first moment.
    pub first: Buffer<f32>,
    /// Root of Adam's second moment.
    pub root: Buffer<f32>,
    /// dL/dvalue, where it is trained and the stages are there that compute it.
    pub gradient: Option<Buffer<f32>>,
    /// Floats per row.
    pub width: u32,
    /// The groups whose learning rates it has, at most three; none where the caller names the rates.
    pub parts: Vec<Part>,
}

impl Parameter {
    /// Room for `rows`, the first of which get these values and moments of zero. No gradient yet.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, names: Names, width: u32, rows: u32, values: &[f32]) -> Result<Self, Error> {
        let len = Self::room(rows, width);
        let [value, first, root] = names.kept();
        let new = Self {
            names,
            value: gpu.buffer(value, len)?,
            first: gpu.buffer(first, len)?,
            root: gpu.buffer(root, len)?,
            gradient: None,
            width,
            parts: vec![],
        };
        gpu.write(&new.value, values)?;
        let mut rec = gpu.recorder()?;
        rec.zero(&new.first);
        rec.zero(&new.root);
        rec.submit()?.wait()?;
        Ok(new)
    }

    /// The same with these groups.
    pub fn in_parts(mut self, parts: impl IntoIterator<Item = Part>) -> Self {
        self.parts = parts.into_iter().collect();
        self
    }

    /// The same with one group for all elements.
    pub fn in_group(self, group: Group) -> Self {
        self.in_parts([Part { group, first: 0 }])
    }

    /// The groups of its elements.
    pub fn groups(&self) -> impl Iterator<Item = Group> {
        self.parts.iter().map(|part| part.group)
    }

    fn room(rows: u32, width: u32) -> usize {
        // Whole vectors of four, which the optimiser works in, and of three, as which offsets are viewed.
        (rows as usize * width as usize).next_multiple_of(12)
    }

    /// Makes the gradient's buffer, uninitialised.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn make_gradient(&mut self, gpu: &Gpu) -> Result<(), Error> {
        self.gradient = Some(gpu.buffer(self.names.gradient, self.value.len())?);
        Ok(())
    }

    /// Makes room for `rows`, of which the first `kept` stay. The others' values and moments are zero.
    ///
    /// # Errors
    /// As [`lengthen`].
    pub fn reserve(&mut self, rec: &mut Recorder<'_>, rows: u32, kept: u32) -> Result<(), Error> {
        let (len, kept) = (Self::room(rows, self.width), kept as usize * self.width as usize);
        self.tensors_mut().into_iter().try_for_each(|tensor| lengthen(rec, tensor, len, kept))
    }

    /// Value and moments.
    pub fn tensors(&self) -> [&Buffer<f32>; 3] {
        [&self.value, &self.first, &self.root]
    }

    /// Value and moments, to be replaced.
    pub fn tensors_mut(&mut self) -> [&mut Buffer<f32>; 3] {
        [&mut self.value, &mut self.first, &mut self.root]
    }

    /// The values of the first `rows`.
    ///
    /// # Errors
    /// Whatever the copy meets.
    pub fn read(&self, gpu: &Gpu, rows: u32) -> Result<Vec<f32>, Error> {
        gpu.read_range(&self.value, rows as usize * self.width as usize)
    }
}

/// Puts `buffer` into one of `len` elements: the first `kept` as they are, zero behind them.
///
/// # Errors
/// As [`Gpu::buffer`]. What was recorded before is lost then, and with it what buffers that were made longer held.
pub fn lengthen<T: bytemuck::Pod>(
    rec: &mut Recorder<'_>,
    buffer: &mut Buffer<T>,
    len: usize,
    kept: usize,
) -> Result<(), Error> {
    rec.make_room((len * size_of::<T>()) as u64)?;
    let gpu = rec.gpu();
    let longer = gpu.stage(buffer.stage(), || gpu.buffer(buffer.name(), len))?;
    rec.zero(&longer);
    rec.copy(buffer, &longer, kept);
    *buffer = longer;
    Ok(())
}

//! The anchors on the device: everything that is learnt per anchor, with Adam's moments.

use crate::gpu::{Buffer, Error, Gpu};
use crate::model::files;

/// One learnt array, `width` floats per anchor, with its moments.
#[derive(Debug)]
pub struct Parameter {
    /// `[N * width]`
    pub value: Buffer<f32>,
    /// Adam's first moment.
    pub first: Buffer<f32>,
    /// Root of Adam's second moment.
    pub root: Buffer<f32>,
    /// Floats per anchor.
    pub width: u32,
}

impl Parameter {
    /// Uninitialised, for `capacity` anchors.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, names: [&'static str; 3], width: u32, capacity: u32) -> Result<Self, Error> {
        let len = Self::len(capacity, width);
        let [value, first, root] = names;
        Ok(Self { value: gpu.buffer(value, len)?, first: gpu.buffer(first, len)?, root: gpu.buffer(root, len)?, width })
    }

    fn len(capacity: u32, width: u32) -> usize {
        // Whole vectors of four, which the optimiser works in, and of three, as which offsets are viewed.
        (capacity as usize * width as usize).next_multiple_of(12)
    }

    /// Value and moments.
    pub fn tensors(&self) -> [&Buffer<f32>; 3] {
        [&self.value, &self.first, &self.root]
    }
}

/// Puts `buffer` into one of `len` elements: the first `kept` as they are, zero behind them.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn lengthen<T: bytemuck::Pod>(gpu: &Gpu, buffer: &mut Buffer<T>, len: usize, kept: usize) -> Result<(), Error> {
    let longer = gpu.stage(buffer.stage(), || gpu.buffer(buffer.name(), len))?;
    let mut rec = gpu.recorder()?;
    rec.zero(&longer);
    rec.copy(buffer, &longer, kept);
    rec.submit()?.wait()?;
    *buffer = longer;
    Ok(())
}

/// The anchors, with room for `capacity`; the first `count` are in use. Their positions do not move.
#[derive(Debug)]
pub struct Anchors {
    /// Anchors in use.
    pub count: u32,
    /// Anchors there is room for.
    pub capacity: u32,
    /// Gaussians per anchor.
    pub offsets: u32,
    /// `[N]` world.
    pub position: Buffer<[f32; 3]>,
    /// 32 per anchor.
    pub feature: Parameter,
    /// 3 per Gaussian, in units of the anchor's first three scales.
    pub offset: Parameter,
    /// 6 per anchor: of the offsets 3, of the Gaussians 3.
    pub log_scaling: Parameter,
}

impl Anchors {
    fn empty(gpu: &Gpu, offsets: u32, capacity: u32) -> Result<Self, Error> {
        Ok(Self {
            count: 0,
            capacity,
            offsets,
            position: gpu.buffer("position", capacity as usize)?,
            feature: Parameter::new(gpu, ["feature", "feature_first", "feature_root"], 32, capacity)?,
            offset: Parameter::new(gpu, ["offset", "offset_first", "offset_root"], 3 * offsets, capacity)?,
            log_scaling: Parameter::new(gpu, ["log_scaling", "log_scaling_first", "log_scaling_root"], 6, capacity)?,
        })
    }

    /// As many anchors of `offsets` Gaussians as one binding of the device holds of every array, and a `u32` counts.
    pub fn most(gpu: &Gpu, offsets: u32) -> u32 {
        // The feature or the offsets, whichever is wider; less what rounding to whole vectors may add.
        let widest = 4 * u64::from((3 * offsets).max(32));
        ((gpu.info().max_binding_bytes.min(u32::MAX.into()) - 48) / widest) as u32
    }

    /// The anchors of a model, moments zero, with room for at least `capacity`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, anchors: &files::Anchors, capacity: u32) -> Result<Self, Error> {
        let count = anchors.position.len() as u32;
        let offsets = anchors.offsets_per_anchor as u32;
        let mut all = Self::empty(gpu, offsets, capacity.max(count).max(1))?;
        all.count = count;
        gpu.write(&all.position, &anchors.position)?;
        gpu.write(&all.feature.value, anchors.feature.as_flattened())?;
        gpu.write(&all.offset.value, &anchors.offset)?;
        gpu.write(&all.log_scaling.value, anchors.log_scaling.as_flattened())?;
        let mut rec = gpu.recorder()?;
        for parameter in all.parameters() {
            rec.zero(&parameter.first);
            rec.zero(&parameter.root);
        }
        rec.submit()?.wait()?;
        Ok(all)
    }

    /// The three learnt arrays.
    pub fn parameters(&self) -> [&Parameter; 3] {
        [&self.feature, &self.offset, &self.log_scaling]
    }

    /// Makes room for `capacity` anchors and keeps what there is, an array at a time: beside the model only the largest of
    /// its arrays exists twice. Nothing that uses the anchors may be in flight.
    ///
    /// # Errors
    /// As [`Gpu::buffer`]; the anchors are the same then, some of their arrays longer.
    pub fn reserve(&mut self, gpu: &Gpu, capacity: u32) -> Result<(), Error> {
        let (capacity, count) = (capacity.max(self.count), self.count as usize);
        lengthen(gpu, &mut self.position, capacity as usize, count)?;
        for parameter in [&mut self.feature, &mut self.offset, &mut self.log_scaling] {
            let width = parameter.width as usize;
            let len = Parameter::len(capacity, parameter.width);
            for tensor in [&mut parameter.value, &mut parameter.first, &mut parameter.root] {
                lengthen(gpu, tensor, len, count * width)?;
            }
        }
        self.capacity = capacity;
        Ok(())
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn read(&self, gpu: &Gpu) -> Result<files::Anchors, Error> {
        let n = self.count as usize;
        let flat = |p: &Parameter| gpu.read_range(&p.value, n * p.width as usize);
        Ok(files::Anchors {
            position: gpu.read_range(&self.position, n)?,
            feature: flat(&self.feature)?.as_chunks::<32>().0.to_vec(),
            offset: flat(&self.offset)?,
            offsets_per_anchor: self.offsets as usize,
            log_scaling: flat(&self.log_scaling)?.as_chunks::<6>().0.to_vec(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    #[test]
    fn growing_keeps_everything() {
        let gpu = testing::gpu();
        let n = 7;
        let model = files::Anchors {
            position: (0..n).map(|i| [i as f32, 0.5, -1.0]).collect(),
            feature: (0..n).map(|i| std::array::from_fn(|c| (i * 32 + c) as f32)).collect(),
            offset: (0..n * 30).map(|i| i as f32 * 0.1).collect(),
            offsets_per_anchor: 10,
            log_scaling: (0..n).map(|i| std::array::from_fn(|c| (i + c) as f32)).collect(),
        };
        let mut anchors = Anchors::upload(&gpu, &model, 0).unwrap();
        assert_eq!(anchors.read(&gpu).unwrap(), model);
        anchors.reserve(&gpu, 20).unwrap();
        assert_eq!((anchors.count, anchors.capacity), (7, 20));
        assert_eq!(anchors.read(&gpu).unwrap(), model);
        assert_eq!(gpu.read(&anchors.offset.root).unwrap(), vec![0.0; 600]);
    }
}

//! The anchors on the device: everything that is learnt per anchor, with Adam's moments.

use crate::gpu::{Buffer, Error, Gpu, Recorder};
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
        // Whole vectors of four, which the optimiser works in, and of three, as which offsets are viewed.
        let len = (capacity as usize * width as usize).next_multiple_of(12);
        let [value, first, root] = names;
        Ok(Self { value: gpu.buffer(value, len)?, first: gpu.buffer(first, len)?, root: gpu.buffer(root, len)?, width })
    }

    /// Value and moments.
    pub fn tensors(&self) -> [&Buffer<f32>; 3] {
        [&self.value, &self.first, &self.root]
    }
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

    /// The same anchors in buffers with room for `capacity`; the copy is recorded.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn grown(&self, rec: &mut Recorder<'_>, capacity: u32) -> Result<Self, Error> {
        let mut new = Self::empty(rec.gpu(), self.offsets, capacity.max(self.count))?;
        new.count = self.count;
        rec.copy(&self.position, &new.position, self.count as usize);
        for (from, to) in self.parameters().into_iter().zip(new.parameters()) {
            for (from_tensor, to_tensor) in from.tensors().into_iter().zip(to.tensors()) {
                rec.zero(to_tensor);
                rec.copy(from_tensor, to_tensor, (self.count * from.width) as usize);
            }
        }
        Ok(new)
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
        let anchors = Anchors::upload(&gpu, &model, 0).unwrap();
        assert_eq!(anchors.read(&gpu).unwrap(), model);
        let mut rec = gpu.recorder().unwrap();
        let grown = anchors.grown(&mut rec, 20).unwrap();
        rec.submit().unwrap().wait().unwrap();
        assert_eq!((grown.count, grown.capacity), (7, 20));
        assert_eq!(grown.read(&gpu).unwrap(), model);
        assert_eq!(gpu.read_range(&grown.offset.root, 210).unwrap(), vec![0.0; 210]);
    }
}

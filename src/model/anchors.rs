//! The anchors on the device: everything that is learnt per anchor, with Adam's moments.

use super::arrays::{self, ARRAYS, Array};
use super::parameter::{DECODERS, Parameter, Part, WEIGHTS, lengthen};
use crate::gpu::{Buffer, Error, Gpu, Recorder};
use crate::math::decoder::Layout;
use crate::optimizer::Group;

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
    /// In the order of [`ARRAYS`].
    parameters: Vec<Parameter>,
}

impl Anchors {
    /// As many anchors of `offsets` Gaussians as one binding of the device holds of every array, and a `u32` counts.
    pub fn most(gpu: &Gpu, offsets: u32) -> u32 {
        // The widest array; less what rounding to whole vectors may add.
        let widest = 4 * ARRAYS.iter().map(|array| u64::from((array.width)(offsets))).max().unwrap_or(1);
        ((gpu.info().max_binding_bytes.min(u32::MAX.into()) - 48) / widest) as u32
    }

    /// The anchors of a model, moments zero, with room for at least `capacity`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, anchors: &arrays::Anchors, capacity: u32) -> Result<Self, Error> {
        let count = anchors.position.len() as u32;
        let offsets = anchors.offsets_per_anchor as u32;
        let capacity = capacity.max(count).max(1);
        let position = gpu.buffer("position", capacity as usize)?;
        gpu.write(&position, &anchors.position)?;
        let upload = |array: &Array| {
            let values = (array.get)(anchors);
            let parameter = Parameter::upload(gpu, array.names, (array.width)(offsets), capacity, values)?;
            Ok(parameter.in_group(array.group))
        };
        let parameters = ARRAYS.iter().map(upload).collect::<Result<_, Error>>()?;
        Ok(Self { count, capacity, offsets, position, parameters })
    }

    /// What is learnt, in the order of [`ARRAYS`].
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// What is learnt, to be changed.
    pub fn parameters_mut(&mut self) -> &mut [Parameter] {
        &mut self.parameters
    }

    /// What belongs to this group.
    ///
    /// # Panics
    /// When no array of the anchors does.
    pub fn of(&self, group: Group) -> &Parameter {
        let place = ARRAYS.iter().position(|array| array.group == group);
        &self.parameters[place.expect("a group of the anchors")]
    }

    /// 32 per anchor.
    pub fn feature(&self) -> &Parameter {
        self.of(Group::Feature)
    }

    /// 3 per Gaussian, in units of the anchor's first three scales.
    pub fn offset(&self) -> &Parameter {
        self.of(Group::Offset)
    }

    /// 6 per anchor: of the offsets 3, of the Gaussians 3.
    pub fn log_scaling(&self) -> &Parameter {
        self.of(Group::LogScaling)
    }

    /// Makes room for `capacity` anchors and keeps what there is. Arrays exist twice until this was run, as far as they have
    /// room: an array at a time where there is none.
    ///
    /// # Errors
    /// As [`lengthen`].
    pub fn reserve(&mut self, rec: &mut Recorder<'_>, capacity: u32) -> Result<(), Error> {
        let (capacity, count) = (capacity.max(self.count), self.count);
        lengthen(rec, &mut self.position, capacity as usize, count as usize)?;
        self.parameters.iter_mut().try_for_each(|parameter| parameter.reserve(rec, capacity, count))?;
        self.capacity = capacity;
        Ok(())
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn read(&self, gpu: &Gpu) -> Result<arrays::Anchors, Error> {
        let mut anchors = arrays::Anchors { offsets_per_anchor: self.offsets as usize, ..arrays::Anchors::default() };
        anchors.position = gpu.read_range(&self.position, self.count as usize)?;
        for (array, parameter) in ARRAYS.iter().zip(&self.parameters) {
            (array.set)(&mut anchors, parameter.read(gpu, self.count)?);
        }
        Ok(anchors)
    }
}

/// Anchors, and the decoders that make Gaussians of them.
#[derive(Debug)]
pub struct Decoded {
    /// The anchors.
    pub anchors: Anchors,
    /// The decoders, flat.
    pub weights: Parameter,
}

impl Decoded {
    /// Anchors of a model, with room for at least `capacity`, and its decoders, flat; moments zero.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, anchors: &arrays::Anchors, decoders: &[f32], capacity: u32) -> Result<Self, Error> {
        let anchors = Anchors::upload(gpu, anchors, capacity)?;
        let layout = Layout { offsets: anchors.offsets as usize };
        let part = |(head, &group): (usize, &Group)| Part { group, first: layout.head(head) as u32 };
        let weights = Parameter::upload(gpu, WEIGHTS, decoders.len() as u32, 1, decoders)?;
        Ok(Self { anchors, weights: weights.in_parts(DECODERS.iter().enumerate().map(part)) })
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
        let model = arrays::Anchors::new(
            10,
            (0..n).map(|i| [i as f32, 0.5, -1.0]).collect(),
            (0..n).map(|i| std::array::from_fn(|c| (i * 32 + c) as f32)).collect(),
            (0..n * 30).map(|i| i as f32 * 0.1).collect(),
            (0..n).map(|i| std::array::from_fn(|c| (i + c) as f32)).collect(),
        );
        let mut anchors = Anchors::upload(&gpu, &model, 0).unwrap();
        assert_eq!(anchors.read(&gpu).unwrap(), model);
        let mut rec = gpu.recorder().unwrap();
        anchors.reserve(&mut rec, 20).unwrap();
        rec.submit().unwrap().wait().unwrap();
        assert_eq!((anchors.count, anchors.capacity), (7, 20));
        assert_eq!(anchors.read(&gpu).unwrap(), model);
        assert_eq!(gpu.read(&anchors.offset().root).unwrap(), vec![0.0; 600]);
    }
}

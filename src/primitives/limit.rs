//! Counts against capacities: what does not fit is reported, never dropped silently.

use crate::gpu::kernels::primitives::limit;
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};

impl Reference for limit::Kernel {
    fn reference(host: limit::Host<'_>, push: limit::Push, (): ()) {
        let wanted = host.wanted[0];
        let fits = wanted <= push.capacity;
        host.count[0] = if fits { wanted } else { 0 };
        if !fits {
            host.overflow[0] |= 1 << push.bit;
        }
        host.counters[push.counter as usize] = wanted;
    }
}

/// What is counted on the device in a step.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Counter {
    /// Anchors in view.
    Visible,
    /// Gaussians that touch a tile.
    Drawn,
    /// (Gaussian, tile) pairs.
    Pairs,
}

/// Number of [`Counter`]s.
pub const COUNTERS: usize = 3;

/// The sticky overflow flag and the counters of a step.
pub struct Limits {
    overflow: Buffer<u32>,
    counters: Buffer<u32>,
}

impl Limits {
    /// With the flag down.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self { overflow: gpu.upload("overflow", &[0])?, counters: gpu.upload("counters", &[0; COUNTERS])? })
    }

    /// `[1]` one bit per [`Counter`] that did not fit; stays up until [`Limits::lower`].
    pub fn overflow(&self) -> &Buffer<u32> {
        &self.overflow
    }

    /// `[COUNTERS]` what there was, whether it fitted or not.
    pub fn counters(&self) -> &Buffer<u32> {
        &self.counters
    }

    /// `count = wanted` if `wanted <= capacity`, otherwise 0 and the flag goes up.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        wanted: &Buffer<u32>,
        count: &Buffer<u32>,
        capacity: u32,
        counter: Counter,
    ) {
        let buffers = limit::Buffers { wanted, count, overflow: &self.overflow, counters: &self.counters };
        let push = limit::Push { capacity, bit: counter as u32, counter: counter as u32 };
        rec.run(limit::Kernel, buffers, push, 1u32);
    }

    /// Notes a count that always fits.
    pub fn note(&self, rec: &mut Recorder<'_>, count: &Buffer<u32>, counter: Counter) {
        rec.copy_range(count, 0, &self.counters, counter as usize, 1);
    }

    /// The same flag and counters.
    #[must_use]
    pub fn share(&self) -> Self {
        Self { overflow: self.overflow.view(), counters: self.counters.view() }
    }

    /// Makes `attempt`, which runs on the device, until nothing overflows. From the second time on it is given what was
    /// counted ([`Counter`]), to make room for it. Returns what the last attempt returned.
    ///
    /// # Errors
    /// `attempt`'s own, and when the device is lost.
    pub fn until_all_fits<T, E: From<Error>>(
        &self,
        gpu: &Gpu,
        mut attempt: impl FnMut(Option<[u32; COUNTERS]>) -> Result<T, E>,
    ) -> Result<T, E> {
        let mut done = attempt(None)?;
        while gpu.read(&self.overflow)?[0] & ((1 << COUNTERS) - 1) != 0 {
            let counters = gpu.read(&self.counters)?;
            let mut rec = gpu.recorder()?;
            self.lower(&mut rec);
            rec.submit()?.wait()?;
            done = attempt(Some(std::array::from_fn(|i| counters[i])))?;
        }
        Ok(done)
    }

    /// Lowers the flag, once the buffers have grown.
    pub fn lower(&self, rec: &mut Recorder<'_>) {
        rec.zero(&self.overflow);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for wanted in [0, 1, 99, 100, 101, u32::MAX] {
            let case = limit::Arrays { wanted: vec![wanted], count: vec![7], overflow: vec![1], counters: vec![9; 4] };
            let push = limit::Push { capacity: 100, bit: 3, counter: 2 };
            testing::assert_twin(limit::Kernel, &gpu, case, push, 1u32);
        }
    }
}

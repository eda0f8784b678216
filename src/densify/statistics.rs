//! What growing and pruning look at: screen-space gradients and opacities, gathered over steps.

use crate::gpu::kernels::densify::statistics;
use crate::gpu::{Buffer, Error, Gpu, Groups, Recorder, Reference};
use crate::model::parameter::lengthen;
use crate::primitives::dispatch;

impl Reference for statistics::Kernel {
    fn reference(host: statistics::Host<'_>, push: statistics::Push, (): ()) {
        if host.overflow[0] != 0 {
            return;
        }
        let offsets = push.offsets as usize;
        let n = host.groups[3] as usize;
        for (v, &a) in host.visible.iter().take(n).enumerate() {
            let a = a as usize;
            let mut sum = 0.0;
            for k in 0..offsets {
                let (s, at) = (k * n + v, a * offsets + k);
                if host.tiles[s] > 0 {
                    let [x, y] =
                        std::array::from_fn(|i| f64::from(host.grad_mean[s][i]) * f64::from(push.half_size[i]));
                    host.gradient[at] = (f64::from(host.gradient[at]) + x.hypot(y)) as f32;
                    host.seen[at] += u32::from(push.touched == 0 || x != 0.0 || y != 0.0);
                }
                sum += f64::from(host.opacity[s]).max(0.0);
            }
            host.opacity_sum[a] = (f64::from(host.opacity_sum[a]) + sum) as f32;
            host.visits[a] += 1;
        }
    }
}

/// Sums since they were last judged, with room for as many anchors as the model has.
#[derive(Debug)]
pub struct Statistics {
    /// \[anchor, offset\] sum of the norms of the gradients by the mean, in normalised device coordinates.
    pub gradient: Buffer<f32>,
    /// \[anchor, offset\] steps in which the Gaussian was drawn.
    pub seen: Buffer<u32>,
    /// \[anchor\] sum of the positive opacities of its Gaussians.
    pub opacity_sum: Buffer<f32>,
    /// \[anchor\] steps in which it was in view.
    pub visits: Buffer<u32>,
    offsets: u32,
    touched: bool,
    per_slot: Groups,
}

/// What a step has to say about the Gaussians it drew: one element per slot, or per visible anchor.
#[derive(Clone, Copy)]
pub struct Drawn<'a> {
    /// `[1]` visible anchors.
    pub visible_count: &'a Buffer<u32>,
    /// Sticky flag of a step that did not fit: such a step is not counted.
    pub overflow: &'a Buffer<u32>,
    /// \[visible\] anchors.
    pub visible: &'a Buffer<u32>,
    /// \[slot\] per px, of Gaussians that touch a tile.
    pub grad_mean: &'a Buffer<[f32; 2]>,
    /// \[slot\] tiles touched, 0 where nothing is drawn.
    pub tiles: &'a Buffer<u32>,
    /// \[slot\] the Gaussian exists where > 0.
    pub opacity: &'a Buffer<f32>,
    /// Width and height of the picture, px.
    pub size: [u32; 2],
}

impl Statistics {
    /// Room for `capacity` anchors with `offsets` Gaussians each, uninitialised.
    fn empty(gpu: &Gpu, capacity: u32, offsets: u32, touched: bool) -> Result<Self, Error> {
        let (anchors, slots) = (capacity as usize, capacity as usize * offsets as usize);
        Ok(Self {
            gradient: gpu.buffer("accumulated_gradient", slots)?,
            seen: gpu.buffer("seen", slots)?,
            opacity_sum: gpu.buffer("opacity_sum", anchors)?,
            visits: gpu.buffer("visits", anchors)?,
            offsets,
            touched,
            per_slot: dispatch::groups(gpu, "slots", 64)?,
        })
    }

    /// Nothing gathered yet, with room for `capacity` anchors of `offsets` Gaussians each. With `touched` a step counts for
    /// a Gaussian only where it has a gradient.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32, offsets: u32, touched: bool) -> Result<Self, Error> {
        let new = Self::empty(gpu, capacity, offsets, touched)?;
        let mut rec = gpu.recorder()?;
        new.zero(&mut rec);
        rec.submit()?.wait()?;
        Ok(new)
    }

    fn zero(&self, rec: &mut Recorder<'_>) {
        rec.zero(&self.gradient);
        rec.zero(&self.seen);
        rec.zero(&self.opacity_sum);
        rec.zero(&self.visits);
    }

    /// Anchors there is room for.
    pub fn capacity(&self) -> u32 {
        self.visits.len() as u32
    }

    /// Makes room for `capacity` anchors, of which the first `count` keep their statistics; zero for the others.
    ///
    /// # Errors
    /// As [`lengthen`].
    pub fn reserve(&mut self, rec: &mut Recorder<'_>, count: u32, capacity: u32) -> Result<(), Error> {
        let [kept, anchors] = [count, capacity].map(|n| n as usize);
        let offsets = self.offsets as usize;
        lengthen(rec, &mut self.gradient, anchors * offsets, kept * offsets)?;
        lengthen(rec, &mut self.seen, anchors * offsets, kept * offsets)?;
        lengthen(rec, &mut self.opacity_sum, anchors, kept)?;
        lengthen(rec, &mut self.visits, anchors, kept)
    }

    /// Adds a step: for each Gaussian drawn (it touches a tile, so it exists and lies in front of the near plane) the
    /// norm of `(grad_x W/2, grad_y H/2)` and one sighting; for each visible anchor the sum of its positive opacities
    /// and one visit. Adam must not have zeroed the gradients yet; nothing happens if the overflow flag is up.
    pub fn record(&self, rec: &mut Recorder<'_>, drawn: Drawn<'_>) {
        dispatch::record(rec, drawn.visible_count, &self.per_slot, drawn.visible.len() as u32, self.offsets);
        let buffers = statistics::Buffers {
            groups: &self.per_slot.buffer,
            overflow: drawn.overflow,
            visible: drawn.visible,
            grad_mean: drawn.grad_mean,
            tiles: drawn.tiles,
            opacity: drawn.opacity,
            gradient: &self.gradient,
            seen: &self.seen,
            opacity_sum: &self.opacity_sum,
            visits: &self.visits,
        };
        let half_size = drawn.size.map(|n| n as f32 / 2.0);
        rec.run(
            statistics::Kernel,
            buffers,
            statistics::Push { half_size, offsets: self.offsets, touched: self.touched.into() },
            &self.per_slot,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for (n, offsets, overflow) in
            [(0usize, 10usize, 0), (1, 10, 0), (7, 9, 0), (13, 5, 0), (500, 10, 0), (100, 10, 2)]
        {
            let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64);
            let anchors = 2 * n + 3;
            let slots = (n + 4) * offsets;
            let case = statistics::Arrays {
                groups: vec![0, 0, 0, n as u32],
                overflow: vec![overflow],
                visible: (0..n as u32 + 4).map(|v| 2 * v).collect(),
                grad_mean: (0..slots)
                    .map(|i| {
                        if i % 3 == 0 { [0.0; 2] } else { [rng.random_range(-1.0..1.0), rng.random_range(-1e-3..1e-3)] }
                    })
                    .collect(),
                tiles: (0..slots).map(|_| rng.random_range(0..3)).collect(),
                opacity: (0..slots).map(|_| rng.random_range(-1.0..1.0)).collect(),
                gradient: (0..anchors * offsets).map(|_| rng.random_range(0.0..900.0)).collect(),
                seen: (0..anchors * offsets).map(|_| rng.random_range(0..100)).collect(),
                opacity_sum: (0..anchors).map(|_| rng.random_range(0.0..100.0)).collect(),
                visits: (0..anchors as u32).collect(),
            };
            for touched in [0, 1] {
                let push = statistics::Push { half_size: [504.0, 283.5], offsets: offsets as u32, touched };
                testing::assert_twin(statistics::Kernel, &gpu, case.clone(), push, slots);
            }
        }
    }
}

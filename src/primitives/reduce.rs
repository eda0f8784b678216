//! Sums of floats in a fixed tree.

use crate::gpu::kernels::primitives::reduce;
use crate::gpu::{Buffer, Check, Error, Gpu, Recorder, Reference, Threads};

use super::dispatch::{Blocks, Count};

/// Rows of a block, one workgroup's.
const BLOCK: u32 = 1024;

impl Reference for reduce::Kernel {
    fn reference(host: reduce::Host<'_>, push: reduce::Push, (): ()) {
        let components = push.components as usize;
        let n = host.count[0].min(push.capacity).div_ceil(push.items) as usize;
        for block in 0..n.div_ceil(BLOCK as usize).max(1) {
            let rows = block * BLOCK as usize..n.min((block + 1) * BLOCK as usize);
            for c in 0..components {
                let sum: f64 = rows.clone().map(|row| f64::from(host.values[row * components + c])).sum();
                host.sums[block * components + c] = sum as f32;
            }
        }
    }

    fn check(_: &'static str) -> Check {
        // At most 16 + 8 + 8 additions lie between a value and the sum of its block: 32 eps / 2 times the sum of
        // magnitudes, which terms of both signs make larger than the sum. Tests keep it below 64 times the largest sum.
        Check { relative: 2e-6, absolute: 64.0 * 2e-6, band: 0.0 }
    }
}

/// Sums of at most `capacity` rows of several components, each component by itself.
#[derive(Debug)]
pub struct Reduce {
    capacity: u32,
    components: u32,
    blocks: Blocks,
    /// Sums of blocks, of blocks of blocks, ...: every level but the last, which goes to the result.
    levels: Vec<Buffer<f32>>,
}

impl Reduce {
    /// Scratch for `capacity` rows of `components` values.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32, components: u32) -> Result<Self, Error> {
        let mut levels = vec![];
        let mut rows = capacity.div_ceil(BLOCK);
        while rows > 1 {
            levels.push(gpu.buffer("reduce_sums", (rows * components) as usize)?);
            rows = rows.div_ceil(BLOCK);
        }
        Ok(Self { capacity, components, blocks: Blocks::new(gpu, capacity, 64, BLOCK)?, levels })
    }

    /// Sums `values`, `[count, components]`, over the rows into `sums`, `[components]`: 0 where there are none.
    ///
    /// The relative error is at most 32 float32 roundings per factor of 1024 in the count, of the sum of magnitudes.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity.
    pub fn record(&self, rec: &mut Recorder<'_>, values: &Buffer<f32>, sums: &Buffer<f32>, count: Count<'_>) {
        let components = self.components;
        let (count, most, threads) = self.blocks.record(rec, count);
        // Never beyond a buffer, whatever the count on the device says.
        let capacity = most.min((values.len() / components as usize) as u32);
        let (mut from, mut items, mut rows) = (values, 1, self.capacity);
        for (level, to) in self.levels.iter().chain([sums]).enumerate() {
            // The last level runs even without rows: the sum of nothing is 0.
            let one_block = level == self.levels.len();
            let all = Threads::Line(u64::from(rows.div_ceil(BLOCK).max(1)) * 64);
            let threads = if level > 0 || one_block { all } else { threads };
            let push = reduce::Push { capacity, items, components };
            rec.run(reduce::Kernel, reduce::Buffers { count, values: from, sums: to }, push, threads);
            from = to;
            items = items.saturating_mul(BLOCK);
            rows = rows.div_ceil(BLOCK);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use rand::{RngExt, SeedableRng};

    fn random(n: usize) -> Vec<f32> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64);
        (0..n).map(|_| rng.random_range(-0.2..1.0)).collect()
    }

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000, 1024, 1025, 5000] {
            for components in [1, 3] {
                for items in [1, 5] {
                    let case = reduce::Arrays {
                        count: vec![n],
                        values: random((n * components) as usize + 9),
                        sums: vec![UNWRITTEN; ((n.div_ceil(1024) + 1) * components) as usize],
                    };
                    let push = reduce::Push { capacity: n + 3, items, components };
                    testing::assert_twin(reduce::Kernel, &gpu, case, push, n.div_ceil(1024).max(1) * 64);
                }
            }
        }
    }

    #[test]
    fn sums_in_a_tree() {
        let gpu = testing::gpu();
        for (n, components) in [(0, 1), (1, 4), (1000, 4), (4097, 1), (1_000_001, 2), (3_000_000, 1)] {
            let values = random(n * components);
            let input = gpu.upload("values", &values).unwrap();
            let counted = gpu.upload("rows", &[n as u32]).unwrap();
            for capacity in [n as u32, 2 * n as u32 + 1] {
                let reduce = Reduce::new(&gpu, capacity, components as u32).unwrap();
                let mut runs = vec![];
                for count in [Count::Host(n as u32), Count::Device(&counted)] {
                    let sums = gpu.upload("sums", &vec![UNWRITTEN; components]).unwrap();
                    let mut rec = gpu.recorder().unwrap();
                    reduce.record(&mut rec, &input, &sums, count);
                    rec.submit().unwrap().wait().unwrap();
                    runs.push(gpu.read(&sums).unwrap());
                }
                assert_eq!(runs[0], runs[1]);
                for (c, &got) in runs[0].iter().enumerate() {
                    let terms = || values.iter().skip(c).step_by(components).map(|&x| f64::from(x));
                    let want: f64 = terms().sum();
                    // Three levels of 32 additions, each half a unit in the last place of the magnitudes' sum.
                    let limit = 3.0 * 32.0 * f64::from(f32::EPSILON) / 2.0 * terms().map(f64::abs).sum::<f64>();
                    assert!((f64::from(got) - want).abs() <= limit, "{got} instead of {want}, {n} x {components}");
                }
            }
        }
    }
}

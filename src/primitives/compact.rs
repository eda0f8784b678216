//! Indices of what is kept, in order.

use crate::gpu::kernels::primitives::{compact, scan_sums, scan_totals};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};

use super::dispatch::{Blocks, Count};
use super::scan::BLOCK;

impl Reference for compact::Kernel {
    fn reference(host: compact::Host<'_>, push: compact::Push, (): ()) {
        let n = host.count[0].min(push.capacity) as usize;
        for (block, (flags, &before)) in host.flags[..n].chunks(BLOCK as usize).zip(host.before).enumerate() {
            let set = flags.iter().enumerate().filter(|&(_, &flag)| flag != 0);
            for (rank, (i, _)) in set.enumerate() {
                host.indices[before as usize + rank] = block as u32 * BLOCK + i as u32;
            }
        }
    }
}

/// Compaction of at most `capacity` flags.
#[derive(Debug)]
pub struct Compact {
    blocks: Blocks,
    sums: Buffer<u32>,
    before: Buffer<u32>,
}

impl Compact {
    /// Scratch for `capacity` flags.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        let entries = capacity.div_ceil(BLOCK) as usize;
        Ok(Self {
            blocks: Blocks::new(gpu, capacity, 64, BLOCK)?,
            sums: gpu.buffer("compact_sums", entries)?,
            before: gpu.buffer("compact_before", entries)?,
        })
    }

    /// Writes the indices of the flags that are not zero to `indices`, ascending, and their number to `found[0]`.
    ///
    /// `flags` holds at least `count` elements, `indices` as many as flags are set; its further elements are left as
    /// they are. No two of the buffers may be the same, the count's included.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        flags: &Buffer<u32>,
        indices: &Buffer<u32>,
        found: &Buffer<u32>,
        count: Count<'_>,
    ) {
        let (sums, before) = (&self.sums, &self.before);
        let (count, most, threads) = self.blocks.record(rec, count);
        // Never beyond a buffer, whatever the count on the device says.
        let capacity = most.min(flags.len() as u32);
        let counting = scan_sums::Buffers { count, terms: flags, sums };
        rec.run(scan_sums::Kernel::Nonzero, counting, scan_sums::Push { capacity }, threads);
        let top = scan_totals::Buffers { count, terms: sums, prefix: before, total: found };
        rec.run(scan_totals::Kernel, top, scan_totals::Push { capacity, items: BLOCK }, 64u32);
        let gather = compact::Buffers { count, flags, before, indices };
        rec.run(compact::Kernel, gather, compact::Push { capacity }, threads);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use rand::{RngExt, SeedableRng};

    const PATTERN: u32 = 0xdead_beef;

    fn random(n: usize, share: f64) -> Vec<u32> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64);
        (0..n).map(|_| if rng.random_bool(share) { rng.random_range(1..=u32::MAX) } else { 0 }).collect()
    }

    #[test]
    fn matches_its_twin() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000, 1023, 1024, 1025, 5000] {
            let flags = random(n + 70, 0.4);
            let mut sum = 0;
            let before = flags[..n].chunks(1024).map(|block| {
                let at = sum;
                sum += block.iter().filter(|&&f| f != 0).count() as u32;
                at
            });
            let before: Vec<u32> = before.chain([PATTERN; 2]).collect();
            let case = compact::Arrays { count: vec![n as u32], before, indices: vec![PATTERN; n + 70], flags };
            testing::assert_twin(compact::Kernel, &gpu, case, compact::Push { capacity: n as u32 + 5 }, n + 70);
        }
    }

    #[test]
    fn keeps_what_is_set_in_order() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000, 4096, 4097, 1_000_000] {
            for share in [0.0, 0.01, 0.5, 1.0] {
                let flags = random(n + 100, share);
                let compact = Compact::new(&gpu, n as u32 + 50).unwrap();
                let want: Vec<u32> = (0..n as u32).filter(|&i| flags[i as usize] != 0).collect();
                let flags = gpu.upload("flags", &flags).unwrap();
                for on_device in [false, true] {
                    let indices = gpu.upload("indices", &vec![PATTERN; n + 100]).unwrap();
                    let found = gpu.upload("found", &[PATTERN]).unwrap();
                    let count = gpu.upload("flags_count", &[n as u32]).unwrap();
                    let mut rec = gpu.recorder().unwrap();
                    let count = if on_device { Count::Device(&count) } else { Count::Host(n as u32) };
                    compact.record(&mut rec, &flags, &indices, &found, count);
                    rec.submit().unwrap().wait().unwrap();
                    let got = gpu.read(&indices).unwrap();
                    assert_eq!(gpu.read(&found).unwrap(), [want.len() as u32]);
                    assert_eq!(got[..want.len()], want);
                    assert!(got[want.len()..].iter().all(|&i| i == PATTERN));
                }
            }
        }
    }
}

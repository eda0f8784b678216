//! Exclusive prefix sums of unsigned integers, modulo 2^32. The sum of all terms stops at 2^32 - 1 instead, so that too
//! large a sum is never taken for a small one. A block's sum has to fit, as it does for terms below 2^22.
//!
//! Sums of blocks, their scan by one workgroup, and a second walk over the terms: three passes, two reads and one write
//! per term. Few terms are scanned by one workgroup alone.

use crate::gpu::kernels::primitives::{scan_spread, scan_sums, scan_totals};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};

use super::dispatch::{Blocks, Count, Shape};

/// Terms of a block, one workgroup's.
pub(super) const BLOCK: u32 = 1024;
/// Threads for the terms, in groups of 64: for [`Count::Counted`].
pub const SHAPE: Shape = Shape { tile: BLOCK / 64, factor: 1 };
/// Up to this capacity one workgroup does it alone.
const ALONE: u32 = 4 * BLOCK;

impl Reference for scan_sums::Kernel {
    fn reference(host: scan_sums::Host<'_>, push: scan_sums::Push, (): ()) {
        let n = host.count[0].min(push.capacity) as usize;
        let term = |x: u32| match host.kernel {
            scan_sums::Kernel::Plain => x,
            scan_sums::Kernel::Nonzero => u32::from(x != 0),
        };
        for (sum, block) in host.sums.iter_mut().zip(host.terms[..n].chunks(BLOCK as usize)) {
            *sum = block.iter().fold(0, |sum: u32, &x| sum.wrapping_add(term(x)));
        }
    }
}

impl Reference for scan_totals::Kernel {
    fn reference(host: scan_totals::Host<'_>, push: scan_totals::Push, (): ()) {
        let n = host.count[0].min(push.capacity).div_ceil(push.items) as usize;
        let mut sum = 0u64;
        for (prefix, &term) in host.prefix.iter_mut().zip(&host.terms[..n]) {
            *prefix = sum as u32;
            sum += u64::from(term);
        }
        host.total[0] = sum.min(u32::MAX.into()) as u32;
    }
}

impl Reference for scan_spread::Kernel {
    fn reference(host: scan_spread::Host<'_>, push: scan_spread::Push, (): ()) {
        let n = host.count[0].min(push.capacity) as usize;
        let blocks = host.terms[..n].chunks(BLOCK as usize).zip(host.prefix.chunks_mut(BLOCK as usize));
        for ((terms, prefix), &before) in blocks.zip(host.before) {
            let mut sum = before;
            for (prefix, &term) in prefix.iter_mut().zip(terms) {
                *prefix = sum;
                sum = sum.wrapping_add(term);
            }
        }
    }
}

/// Exclusive prefix sums of at most `capacity` terms.
#[derive(Debug)]
pub struct Scan {
    capacity: u32,
    levels: Option<Levels>,
    blocks: Blocks,
}

/// Scratch for more terms than one workgroup takes on.
#[derive(Debug)]
struct Levels {
    sums: Buffer<u32>,
    before: Buffer<u32>,
}

impl Scan {
    /// Scratch for `capacity` terms.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        let blocks = Blocks::new(gpu, capacity, 64, BLOCK)?;
        let entries = capacity.div_ceil(BLOCK) as usize;
        let levels = if capacity > ALONE {
            Some(Levels { sums: gpu.buffer("scan_sums", entries)?, before: gpu.buffer("scan_before", entries)? })
        } else {
            None
        };
        Ok(Self { capacity, levels, blocks })
    }

    /// `prefix[i] = terms[0] + ... + terms[i-1]` modulo 2^32 for every i below the count, and `total[0]` the sum of all,
    /// or 2^32 - 1 if it is more. Terms are below 2^22.
    ///
    /// `terms` and `prefix` hold at least `count` elements; elements of `prefix` from the count on are left as they
    /// are. No two of the buffers may be the same, the count's included.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity.
    pub fn record(
        &self,
        rec: &mut Recorder<'_>,
        terms: &Buffer<u32>,
        prefix: &Buffer<u32>,
        total: &Buffer<u32>,
        count: Count<'_>,
    ) {
        // Never beyond a buffer, whatever the count on the device says.
        let room = terms.len().min(prefix.len()) as u32;
        let Some(Levels { sums, before }) = &self.levels else {
            let (count, capacity) = match count {
                Count::Host(_) => {
                    let (count, most, _) = self.blocks.record(rec, count);
                    (count, most.min(room))
                }
                Count::Device(count) | Count::Counted(count, _) => (count, self.capacity.min(room)),
            };
            let buffers = scan_totals::Buffers { count, terms, prefix, total };
            rec.run(scan_totals::Kernel, buffers, scan_totals::Push { capacity, items: 1 }, 64u32);
            return;
        };
        let (count, most, threads) = self.blocks.record(rec, count);
        let capacity = most.min(room);
        let buffers = scan_sums::Buffers { count, terms, sums };
        rec.run(scan_sums::Kernel::Plain, buffers, scan_sums::Push { capacity }, threads);
        let top = scan_totals::Buffers { count, terms: sums, prefix: before, total };
        rec.run(scan_totals::Kernel, top, scan_totals::Push { capacity, items: BLOCK }, 64u32);
        let spread = scan_spread::Buffers { count, terms, before, prefix };
        rec.run(scan_spread::Kernel, spread, scan_spread::Push { capacity }, threads);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use rand::{RngExt, SeedableRng};

    const SIZES: [usize; 13] = [0, 1, 63, 64, 65, 1000, 1023, 1024, 1025, 2049, 4096, 4097, 100_003];
    const PATTERN: u32 = 0xdead_beef;

    /// Of up to 32 bits each, so that any two may wrap.
    fn random(n: usize) -> Vec<u32> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64);
        (0..n).map(|_| if rng.random_bool(0.3) { 0 } else { rng.random() }).collect()
    }

    /// Of up to 22 bits each.
    fn random_small(n: usize) -> Vec<u32> {
        random(n).into_iter().map(|term| term >> 10).collect()
    }

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        for n in SIZES {
            // The buffers are longer than the count says.
            let terms = random(n + 70);
            let count = vec![n as u32];
            let capacity = n as u32 + 60;
            let blocks = terms.len().div_ceil(1024);
            for kernel in [scan_sums::Kernel::Plain, scan_sums::Kernel::Nonzero] {
                let sums = vec![PATTERN; blocks];
                let case = scan_sums::Arrays { count: count.clone(), terms: terms.clone(), sums };
                testing::assert_twin(kernel, &gpu, case, scan_sums::Push { capacity }, n + 70);
            }
            for items in [1, 7] {
                let case = scan_totals::Arrays {
                    count: count.clone(),
                    terms: terms.clone(),
                    prefix: vec![PATTERN; terms.len()],
                    total: vec![PATTERN],
                };
                testing::assert_twin(scan_totals::Kernel, &gpu, case, scan_totals::Push { capacity, items }, 64u32);
            }
            let case = scan_spread::Arrays {
                count,
                prefix: vec![PATTERN; terms.len()],
                before: random(blocks),
                terms: terms.clone(),
            };
            testing::assert_twin(scan_spread::Kernel, &gpu, case, scan_spread::Push { capacity }, n + 70);
        }
    }

    /// Prefix sums by the whole primitive, `room` elements long and pre-filled.
    fn scanned(gpu: &Gpu, scan: &Scan, terms: &[u32], count: u32, on_device: bool) -> (Vec<u32>, u32) {
        let input = gpu.upload("terms", terms).unwrap();
        let prefix = gpu.upload("prefix", &vec![PATTERN; terms.len()]).unwrap();
        let total = gpu.upload("total", &[PATTERN]).unwrap();
        let counted = gpu.upload("terms_count", &[count]).unwrap();
        let mut rec = gpu.recorder().unwrap();
        let count = if on_device { Count::Device(&counted) } else { Count::Host(count) };
        scan.record(&mut rec, &input, &prefix, &total, count);
        rec.submit().unwrap().wait().unwrap();
        (gpu.read(&prefix).unwrap(), gpu.read(&total).unwrap()[0])
    }

    #[test]
    fn sums_what_is_before() {
        let gpu = testing::gpu();
        for n in SIZES.into_iter().chain([1_000_000]) {
            let terms = random_small(n + 3);
            for capacity in [n as u32, n as u32 + 3, 1_100_000] {
                let scan = Scan::new(&gpu, capacity).unwrap();
                for on_device in [false, true] {
                    let (prefix, total) = scanned(&gpu, &scan, &terms, n as u32, on_device);
                    let mut sum = 0u64;
                    for i in 0..n {
                        assert_eq!(prefix[i], sum as u32, "prefix {i} of {n}, capacity {capacity}");
                        sum += u64::from(terms[i]);
                    }
                    assert_eq!(u64::from(total), sum.min(u32::MAX.into()), "total of {n}");
                    assert!(prefix[n..].iter().all(|&p| p == PATTERN), "beyond the count of {n}");
                }
            }
        }
    }

    /// So that no limit takes a sum beyond 2^32 for a small one.
    #[test]
    fn a_total_stops_at_what_32_bits_hold() {
        let gpu = testing::gpu();
        for (n, capacity) in [(1025, 4000), (1025, 5000), (5000, 5000)] {
            let scan = Scan::new(&gpu, capacity).unwrap();
            let most = u64::from(u32::MAX);
            let mut terms = vec![(most / n) as u32; n as usize];
            terms[n as usize / 2] += (most % n) as u32;
            assert_eq!(terms.iter().map(|&t| u64::from(t)).sum::<u64>(), most);
            let total = |terms: &[u32]| scanned(&gpu, &scan, terms, terms.len() as u32, true).1;
            assert_eq!(total(&terms), u32::MAX, "just fits");
            terms[0] -= 1;
            assert_eq!(total(&terms), u32::MAX - 1);
            for at in [0, n as usize - 1] {
                let mut more = terms.clone();
                more[at] += 3;
                assert_eq!(total(&more), u32::MAX, "{n} terms, two too many at {at}");
            }
            let largest = (1 << 22) - 1;
            terms.fill(largest);
            assert_eq!(total(&terms), u32::MAX, "{n} terms of {largest}");
            assert_eq!(total(&terms[..1024]), 1024 * largest);
        }
    }

    #[test]
    fn a_count_beyond_the_capacity_is_clamped() {
        let gpu = testing::gpu();
        for capacity in [1000, 5000] {
            let scan = Scan::new(&gpu, capacity).unwrap();
            let terms = vec![1; capacity as usize + 100];
            let (prefix, total) = scanned(&gpu, &scan, &terms, u32::MAX, true);
            assert_eq!(total, capacity);
            assert_eq!(prefix[capacity as usize - 1], capacity - 1);
            assert_eq!(prefix[capacity as usize], PATTERN);
        }
    }

    #[test]
    fn more_blocks_than_one_round_of_the_top() {
        let gpu = testing::gpu();
        let n = 3_000_001;
        let scan = Scan::new(&gpu, n).unwrap();
        let (prefix, total) = scanned(&gpu, &scan, &vec![1; n as usize], n, true);
        assert_eq!(total, n);
        assert!(prefix.iter().enumerate().all(|(i, &p)| p == i as u32));
    }
}

//! Stable sort of 32-bit keys with 32-bit values, least significant digit first.
//!
//! Each pass takes up to seven bits: count digits per block, scan the counts of each digit over the blocks, scatter.
//! A thread owns a run of consecutive keys and counts them in a row of shared memory of its own: no atomics, two
//! barriers, and no demand on the subgroup size or on workgroups making progress beside one another.

use std::ops::Range;

use crate::gpu::kernels::primitives::{sort_count, sort_scan, sort_scatter};
use crate::gpu::{Buffer, Error, Form, Gpu, Recorder, Reference};

use super::dispatch::{Blocks, Count, Shape};

/// Threads of a workgroup.
const GROUP: u32 = 64;

/// How work is cut up. The result does not depend on it.
#[derive(Clone, Copy, Debug)]
struct Tuning {
    /// Keys of a thread.
    items: u32,
    /// Most bits of a digit, at most 7.
    digit_bits: u32,
}

/// On a CPU shared memory costs as much as any other: long runs and wide digits spread the cost of the counters. On a
/// GPU neighbouring threads should read neighbouring cache lines: short runs.
const CPU: Tuning = Tuning { items: 256, digit_bits: 7 };
const GPU: Tuning = Tuning { items: 16, digit_bits: 6 };

fn digit(key: u32, shift: u32, mask: u32) -> usize {
    ((key >> shift) & mask) as usize
}

impl Reference for sort_count::Kernel {
    fn reference(host: sort_count::Host<'_>, push: sort_count::Push, constants: sort_count::Constants) {
        let n = host.count[0].min(push.capacity) as usize;
        for (block, keys) in host.keys.as_flattened()[..n].chunks((GROUP * constants.items) as usize).enumerate() {
            let mut counts = vec![0; 1 << constants.digit_bits];
            keys.iter().for_each(|&key| counts[digit(key, push.shift, push.mask)] += 1);
            for (row, count) in host.counts.chunks_mut(push.stride as usize).zip(counts) {
                row[block] = count;
            }
        }
    }
}

impl Reference for sort_scan::Kernel {
    fn reference(host: sort_scan::Host<'_>, push: sort_scan::Push, (): ()) {
        let blocks = host.count[0].min(push.capacity).div_ceil(push.block) as usize;
        let rows = host.counts.chunks_mut(push.stride as usize).take(push.digits as usize);
        for (row, total) in rows.zip(host.totals) {
            *total = 0;
            for count in &mut row[..blocks] {
                let own = *count;
                *count = *total;
                *total += own;
            }
        }
    }
}

impl Reference for sort_scatter::Kernel {
    /// Where the counts say a block's first key with a digit goes, then one behind the other.
    fn reference(host: sort_scatter::Host<'_>, push: sort_scatter::Push, constants: sort_scatter::Constants) {
        let n = host.count[0].min(push.capacity) as usize;
        let length = (GROUP * constants.items) as usize;
        // Behind the digits in use lies what other sorts, or nobody, wrote.
        let totals = &host.totals[..1 << constants.digit_bits];
        for (block, run) in host.keys.as_flattened()[..n].chunks(length).enumerate() {
            let mut smaller = 0;
            let mut places: Vec<u32> = vec![];
            for (digit, total) in totals.iter().enumerate() {
                places.push(smaller + host.before[digit * push.stride as usize + block]);
                smaller += total;
            }
            for (from, &key) in (block * length..).zip(run) {
                let place = &mut places[digit(key, push.shift, push.mask)];
                host.sorted_keys[*place as usize] = key;
                host.sorted_values[*place as usize] = host.values.map_or(from as u32, |v| v.as_flattened()[from]);
                *place += 1;
            }
        }
    }
}

/// Keys and their values, element by element.
#[derive(Clone, Copy, Debug)]
pub struct Pairs<'a> {
    /// Sort keys.
    pub keys: &'a Buffer<u32>,
    /// What goes with them.
    pub values: &'a Buffer<u32>,
}

/// Sort of at most `capacity` pairs.
#[derive(Debug)]
pub struct Sort {
    tuning: Tuning,
    stride: u32,
    blocks: Blocks,
    keys: Buffer<u32>,
    values: Buffer<u32>,
    counts: Buffer<u32>,
    totals: Buffer<u32>,
}

impl Sort {
    /// Scratch for `capacity` pairs: as much again as the pairs themselves.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self, Error> {
        Self::tuned(gpu, capacity, if gpu.form() == Form::Cpu { CPU } else { GPU })
    }

    fn tuned(gpu: &Gpu, capacity: u32, tuning: Tuning) -> Result<Self, Error> {
        let block = GROUP * tuning.items;
        let stride = capacity.div_ceil(block).max(1);
        Ok(Self {
            tuning,
            stride,
            blocks: Blocks::new(gpu, capacity, GROUP, block)?,
            keys: gpu.buffer("sort_keys", capacity as usize)?,
            values: gpu.buffer("sort_values", capacity as usize)?,
            counts: gpu.buffer("sort_counts", (stride << tuning.digit_bits) as usize)?,
            totals: gpu.buffer("sort_totals", 1 << tuning.digit_bits)?,
        })
    }

    /// Bits of a digit and number of passes for so many bits of a key.
    fn passes(&self, bits: u32) -> (u32, u32) {
        let passes = bits.div_ceil(self.tuning.digit_bits);
        (if passes == 0 { 0 } else { bits.div_ceil(passes) }, passes)
    }

    /// Sorts the first `count` pairs by these bits of the key, ascending; equal ones keep their order.
    ///
    /// The pairs go back and forth between the given buffers and scratch, both overwritten up to the count; the result
    /// lies where the returned pair says (in the given buffers after an even number of passes, in scratch otherwise) and
    /// holds until the next recording of this sort. Both buffers hold at least `count` elements.
    ///
    /// # Panics
    /// When a count of the host exceeds the capacity, or the range goes beyond 32 bits.
    pub fn record<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        pairs: Pairs<'a>,
        count: Count<'a>,
        bits: Range<u32>,
    ) -> Pairs<'a> {
        self.sort(rec, pairs, count, bits, false)
    }

    /// Threads for the pairs, in groups of 64: for [`Count::Counted`].
    pub fn shape(&self) -> Shape {
        Shape { tile: self.tuning.items, factor: 1 }
    }

    /// As [`Sort::record`], where every pair's value is its own place: the given values are not read.
    ///
    /// # Panics
    /// As [`Sort::record`], and without a bit to sort by.
    pub fn record_indices<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        pairs: Pairs<'a>,
        count: Count<'a>,
        bits: Range<u32>,
    ) -> Pairs<'a> {
        assert!(!bits.is_empty(), "indices are written by the first pass: there must be one");
        self.sort(rec, pairs, count, bits, true)
    }

    fn sort<'a>(
        &'a self,
        rec: &mut Recorder<'_>,
        mut from: Pairs<'a>,
        count: Count<'a>,
        bits: Range<u32>,
        indices: bool,
    ) -> Pairs<'a> {
        assert!(bits.end <= 32, "keys have 32 bits");
        let room = from.keys.len().min(from.values.len()) as u32;
        let (stride, items) = (self.stride, self.tuning.items);
        let (counts, totals) = (&self.counts, &self.totals);
        let mut to = Pairs { keys: &self.keys, values: &self.values };
        let (digit_bits, passes) = self.passes(bits.len() as u32);
        if passes == 0 {
            return from;
        }
        let (count, most, threads) = self.blocks.record(rec, count);
        // Never beyond a buffer, whatever the count on the device says.
        let capacity = most.min(room);
        for pass in 0..passes {
            let shift = bits.start + pass * digit_bits;
            let mask = (1 << digit_bits.min(bits.end - shift)) - 1;
            rec.run_with(
                sort_count::Kernel,
                sort_count::Constants { digit_bits, items },
                sort_count::Buffers { count, keys: &from.keys.view(), counts },
                sort_count::Push { capacity, stride, shift, mask },
                threads,
            );
            rec.run(
                sort_scan::Kernel,
                sort_scan::Buffers { count, counts, totals },
                sort_scan::Push { capacity, stride, block: GROUP * items, digits: 1 << digit_bits },
                rec.gpu().info().subgroup_size << digit_bits,
            );
            let values = &from.values.view();
            rec.run_with(
                sort_scatter::Kernel,
                sort_scatter::Constants { digit_bits, items },
                sort_scatter::Buffers {
                    count,
                    before: counts,
                    totals,
                    keys: &from.keys.view(),
                    sorted_keys: to.keys,
                    sorted_values: to.values,
                    values: (!indices || pass > 0).then_some(values),
                },
                sort_scatter::Push { capacity, stride, shift, mask },
                threads,
            );
            std::mem::swap(&mut from, &mut to);
        }
        from
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};

    const PATTERN: u32 = 0xdead_beef;
    const SIZES: [usize; 10] = [0, 1, 63, 64, 65, 1000, 4095, 4096, 4097, 20_001];

    fn random(n: usize, bits: u32) -> Vec<u32> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(n as u64 ^ u64::from(bits) << 40);
        (0..n).map(|_| rng.random::<u32>() & (u32::MAX >> (32 - bits))).collect()
    }

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        for n in SIZES {
            for (digit_bits, items, shift, mask) in [(7, 64, 3, 127), (6, 16, 12, 63), (4, 8, 28, 15), (1, 4, 0, 1)] {
                if n > 5000 && items == 4 {
                    continue;
                }
                let (block, length, capacity) = (GROUP * items, (n + 70).next_multiple_of(4), n as u32 + 60);
                let keys = random(length, 32).as_chunks().0.to_vec();
                let count = vec![n as u32];
                let stride = (length as u32).div_ceil(block) + 1;
                let constants = sort_count::Constants { digit_bits, items };
                let push = sort_count::Push { capacity, stride, shift, mask };
                let counts = vec![PATTERN; (stride << digit_bits) as usize];
                let case = sort_count::Arrays { count: count.clone(), keys: keys.clone(), counts };
                let threads = stride * 64;
                testing::assert_twin_with(sort_count::Kernel, &gpu, constants, case.clone(), push, threads);

                let counts = testing::run_twin(sort_count::Kernel, constants, case, push).counts;
                let totals = vec![PATTERN; 1 << digit_bits];
                let case = sort_scan::Arrays { count: count.clone(), counts, totals };
                let push = sort_scan::Push { capacity, stride, block, digits: 1 << digit_bits };
                let scanning = gpu.info().subgroup_size << digit_bits;
                testing::assert_twin(sort_scan::Kernel, &gpu, case.clone(), push, scanning);

                let scanned = testing::run_twin(sort_scan::Kernel, (), case, push);
                for values in [Some(random(length, 31).as_chunks().0.to_vec()), None] {
                    let case = sort_scatter::Arrays {
                        count: count.clone(),
                        before: scanned.counts.clone(),
                        totals: scanned.totals.clone(),
                        keys: keys.clone(),
                        sorted_keys: vec![PATTERN; length],
                        sorted_values: vec![PATTERN; length],
                        values,
                    };
                    let constants = sort_scatter::Constants { digit_bits, items };
                    let push = sort_scatter::Push { capacity, stride, shift, mask };
                    testing::assert_twin_with(sort_scatter::Kernel, &gpu, constants, case, push, threads);
                }
            }
        }
    }

    /// Sorts `keys[..n]` with the values 3 i + 1, or with indices, on the device and with std's stable sort.
    fn assert_sorts(gpu: &Gpu, sort: &Sort, keys: &[u32], n: usize, bits: Range<u32>, on_device: bool, indices: bool) {
        let values: Vec<u32> = (0..keys.len() as u32).map(|i| if indices { i } else { 3 * i + 1 }).collect();
        let mask = if bits.is_empty() { 0 } else { (u32::MAX >> (32 - bits.len() as u32)) << bits.start };
        let mut want: Vec<(u32, u32)> = keys.iter().copied().zip(values.iter().copied()).take(n).collect();
        want.sort_by_key(|&(key, _)| key & mask);
        let count = gpu.upload("pairs_count", &[n as u32]).unwrap();
        let keys = gpu.upload("keys", keys).unwrap();
        let given = if indices { vec![PATTERN; values.len()] } else { values };
        let values = gpu.upload("values", &given).unwrap();
        let mut rec = gpu.recorder().unwrap();
        let count = if on_device { Count::Device(&count) } else { Count::Host(n as u32) };
        let pairs = Pairs { keys: &keys, values: &values };
        let sorted = if indices {
            sort.record_indices(&mut rec, pairs, count, bits)
        } else {
            sort.record(&mut rec, pairs, count, bits)
        };
        rec.submit().unwrap().wait().unwrap();
        let got: Vec<(u32, u32)> =
            std::iter::zip(gpu.read(sorted.keys).unwrap(), gpu.read(sorted.values).unwrap()).take(n).collect();
        if let Some(i) = (0..n).find(|&i| got[i] != want[i]) {
            panic!("pair {i} of {n} is {:x?} instead of {:x?}", got[i], want[i]);
        }
        assert_eq!(gpu.read(&values).unwrap()[n..], given[n..], "values beyond the count");
    }

    #[test]
    fn sorts_as_std_does() {
        let gpu = testing::gpu();
        for (n, tuning) in SIZES.into_iter().chain([1_000_000]).flat_map(|n| [(n, CPU), (n, GPU)]) {
            let sort = Sort::tuned(&gpu, n as u32 + 10, tuning).unwrap();
            for bits in [0..0, 0..12, 0..32, 5..6, 14..31] {
                let keys = random(n + 10, 32);
                assert_sorts(&gpu, &sort, &keys, n, bits.clone(), false, false);
                assert_sorts(&gpu, &sort, &keys, n, bits.clone(), true, false);
                if !bits.is_empty() {
                    assert_sorts(&gpu, &sort, &keys, n, bits, true, true);
                }
            }
        }
    }

    #[test]
    fn sorts_what_is_sorted_reversed_or_equal() {
        let gpu = testing::gpu();
        let n = 10_000;
        let cases: [Vec<u32>; 4] = [
            (0..n).collect(),
            (0..n).rev().map(|i| i << 15).collect(),
            vec![u32::MAX; n as usize],
            (0..n).map(|i| i % 3).collect(),
        ];
        for (keys, tuning) in cases.into_iter().flat_map(|keys| [(keys.clone(), CPU), (keys, GPU)]) {
            let sort = Sort::tuned(&gpu, n, tuning).unwrap();
            assert_sorts(&gpu, &sort, &keys, n as usize, 0..32, true, false);
        }
    }

    #[test]
    fn a_count_beyond_the_capacity_is_clamped() {
        let gpu = testing::gpu();
        let sort = Sort::new(&gpu, 5000).unwrap();
        let keys = gpu.upload("keys", &(0..6000).rev().collect::<Vec<u32>>()).unwrap();
        let values = gpu.upload("values", &vec![7u32; 6000]).unwrap();
        let count = gpu.upload("pairs_count", &[u32::MAX]).unwrap();
        let mut rec = gpu.recorder().unwrap();
        let sorted = sort.record(&mut rec, Pairs { keys: &keys, values: &values }, Count::Device(&count), 0..14);
        rec.submit().unwrap().wait().unwrap();
        let got = gpu.read(sorted.keys).unwrap();
        assert!(got[..5000].iter().enumerate().all(|(i, &key)| key == 1000 + i as u32));
        assert!(got[5000..].iter().enumerate().all(|(i, &key)| key == 999 - i as u32));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]
        #[test]
        fn sorts_anything(keys in prop::collection::vec(any::<u32>(), 0..9000), narrow in 0u32..32, start in 0u32..32, length in 0u32..33) {
            thread_local!(static GPU: testing::TestGpu = testing::gpu());
            let bits = start..(start + length).min(32);
            let keys: Vec<u32> = keys.iter().map(|key| key >> narrow).collect();
            GPU.with(|gpu| {
                let sort = Sort::new(gpu, keys.len() as u32).unwrap();
                let n = keys.len() * 9 / 10;
                assert_sorts(gpu, &sort, &keys, n, bits, true, false);
            });
        }
    }

    /// Prints how long sorts take; large ones with `GSCREAM_BENCH=1 cargo test primitives::sort::tests::speed -- --nocapture`.
    #[test]
    fn speed() {
        let large = std::env::var_os("GSCREAM_BENCH").is_some();
        let device = std::env::var("GSCREAM_DEVICE").ok();
        let gpu = Gpu::open(&Options { device, timestamps: true, ..Options::default() }).unwrap();
        println!("{}, {}", gpu.info().name, gpu.info().driver);
        for n in [20_000, 200_000, 2_000_000].into_iter().take(if large { 3 } else { 1 }) {
            let sort = Sort::new(&gpu, n).unwrap();
            for bits in [0..32, 0..12] {
                let mut best: Option<Vec<crate::gpu::Timing>> = None;
                let span = |t: &[crate::gpu::Timing]| t[t.len() - 1].start + t[t.len() - 1].duration - t[0].start;
                for _ in 0..15 {
                    let keys = gpu.upload("keys", &random(n as usize, bits.end)).unwrap();
                    let values = gpu.upload("values", &random(n as usize, 32)).unwrap();
                    let count = gpu.upload("pairs_count", &[n]).unwrap();
                    let mut rec = gpu.recorder().unwrap();
                    let pairs = Pairs { keys: &keys, values: &values };
                    sort.record(&mut rec, pairs, Count::Device(&count), bits.clone());
                    let timings = rec.submit().unwrap().wait().unwrap();
                    if best.as_ref().is_none_or(|b| span(b) > span(&timings)) {
                        best = Some(timings);
                    }
                }
                let best = best.expect("fifteen runs");
                // Setting up the dispatch, and three passes per digit.
                assert_eq!(best.len() as u32, 1 + 3 * sort.passes(bits.len() as u32).1);
                let of = |name: &str| best.iter().filter(|t| t.name.contains(name)).map(|t| t.duration).sum::<f64>();
                let span = span(&best);
                println!(
                    "{n:>8} pairs, {:>2} bits: {:8.3} ms ({:6.1} M/s): count {:.3} scan {:.3} scatter {:.3}",
                    bits.end,
                    span * 1e-6,
                    f64::from(n) / span * 1e3,
                    of("count") * 1e-6,
                    of("sort_scan") * 1e-6,
                    of("scatter") * 1e-6
                );
            }
        }
    }
}

//! Scan, sort and compact at nothing, at equal keys and at the largest ones.

use gscream_vk::gpu::{Buffer, Gpu};
use gscream_vk::primitives::{Compact, Count, Pairs, Scan, Sort};

use super::Case;

/// None, one, a group, a block of the scan and a little more, several blocks of the sort.
const SIZES: [usize; 7] = [0, 1, 64, 1024, 1025, 4097, 100_003];
const PATTERN: u32 = 0xdead_beef;

pub const CASES: &[Case] = &[
    Case {
        stage: "primitives: scan",
        case: "0 to 100,003 terms: all 0, all 1, all 2^32 - 1; the count on the device beyond the capacity",
        guarantee: "prefix of the first min(count, capacity) terms modulo 2^32, and their total, 2^32 - 1 at most; nothing behind them is written",
        run: scans,
    },
    Case {
        stage: "primitives: sort",
        case: "0 to 100,003 keys: all equal, all 2^32 - 1, two values in turn",
        guarantee: "stable: equal keys keep the order of their index; nothing behind the count is written",
        run: sorts,
    },
    Case {
        stage: "primitives: compact",
        case: "0 to 100,003 flags: none set, all set, all 2^32 - 1",
        guarantee: "indices in order and their number; nothing behind them is written",
        run: compacts,
    },
];

fn upload(gpu: &Gpu, data: &[u32]) -> Buffer<u32> {
    gpu.upload("words", data).expect("upload")
}

fn scans(gpu: &Gpu) {
    for n in SIZES {
        for term in [0, 1, u32::MAX] {
            for (asked, capacity) in [(n as u32, n as u32 + 7), (u32::MAX, n as u32)] {
                let scan = Scan::new(gpu, capacity).expect("buffers");
                let terms = upload(gpu, &vec![term; n + 70]);
                let (prefix, total) = (upload(gpu, &vec![PATTERN; n + 70]), upload(gpu, &[PATTERN]));
                let count = upload(gpu, &[asked]);
                let mut rec = gpu.recorder().expect("recorder");
                scan.record(&mut rec, &terms, &prefix, &total, Count::Device(&count));
                rec.submit().and_then(|s| s.wait()).expect("the device runs it");
                let prefix = gpu.read(&prefix).expect("read");
                assert!((0..n).all(|i| prefix[i] == term.wrapping_mul(i as u32)), "{n} terms of {term}");
                assert!(prefix[n..].iter().all(|&p| p == PATTERN), "{n} terms of {term}");
                assert_eq!(gpu.read(&total).expect("read"), [term.saturating_mul(n as u32)]);
            }
        }
    }
}

fn sorts(gpu: &Gpu) {
    for n in SIZES {
        let sort = Sort::new(gpu, n as u32 + 7).expect("buffers");
        for (name, key) in [
            ("all 0", Box::new(|_| 0u32) as Box<dyn Fn(usize) -> u32>),
            ("all 2^31", Box::new(|_| 1u32 << 31)),
            ("all 2^32 - 1", Box::new(|_| u32::MAX)),
            ("two in turn", Box::new(|i| if i % 2 == 0 { u32::MAX } else { u32::MAX - 1 })),
        ] {
            let keys: Vec<u32> = (0..n + 70).map(&key).collect();
            let mut want: Vec<u32> = (0..n as u32).collect();
            want.sort_by_key(|&i| keys[i as usize]);
            let (keys, values) = (upload(gpu, &keys), upload(gpu, &vec![PATTERN; n + 70]));
            let count = upload(gpu, &[n as u32]);
            let mut rec = gpu.recorder().expect("recorder");
            let sorted =
                sort.record_indices(&mut rec, Pairs { keys: &keys, values: &values }, Count::Device(&count), 0..32);
            rec.submit().and_then(|s| s.wait()).expect("the device runs it");
            let got = gpu.read_range(sorted.values, n).expect("read");
            assert!(got == want, "{name}, {n} keys");
            assert!(gpu.read(&values).expect("read")[n..].iter().all(|&v| v == PATTERN), "{name}, {n} keys");
        }
    }
}

fn compacts(gpu: &Gpu) {
    for n in SIZES {
        let compact = Compact::new(gpu, n as u32 + 7).expect("buffers");
        for flag in [0, 1, u32::MAX] {
            let flags = upload(gpu, &vec![flag; n + 70]);
            let (indices, found) = (upload(gpu, &vec![PATTERN; n + 70]), upload(gpu, &[PATTERN]));
            let mut rec = gpu.recorder().expect("recorder");
            compact.record(&mut rec, &flags, &indices, &found, Count::Host(n as u32));
            rec.submit().and_then(|s| s.wait()).expect("the device runs it");
            let set = if flag == 0 { 0 } else { n };
            assert_eq!(gpu.read(&found).expect("read"), [set as u32]);
            let indices = gpu.read(&indices).expect("read");
            assert!((0..set).all(|i| indices[i] == i as u32) && indices[set..].iter().all(|&i| i == PATTERN));
        }
    }
}

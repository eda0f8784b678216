//! Whether floats are finite, noted in a sticky flag that the device itself obeys.

use crate::gpu::kernels::primitives::finite;
use crate::gpu::{Buffer, Recorder, Reference};

/// Bit of the sticky flag that says that a value is NaN or infinite; those below it are [`super::limit::Counter`]'s.
pub const NOT_FINITE: u32 = 31;

/// Vectors of four per thread, threads of a group: the kernel's.
const VECTORS: u32 = 4;
const GROUP: u32 = 64;

fn threads(n: u32) -> u32 {
    n.div_ceil(4 * GROUP * VECTORS) * GROUP
}

impl Reference for finite::Kernel {
    fn reference(host: finite::Host<'_>, push: finite::Push, (): ()) {
        let shut = host.gate.is_some_and(|gate| gate[0] == 0);
        let finite = |word: &u32| f32::from_bits(*word).is_finite();
        let looks = host.flag[0] == 0 && !shut;
        if looks && !host.values.as_flattened()[..push.n as usize].iter().all(finite) {
            host.flag[0] |= 1 << push.bit;
        }
    }
}

/// Raises [`NOT_FINITE`] in `flag` if one of the first `n` values is NaN or infinite, unless a flag is up already. With a
/// `gate` only where that is not 0: for values that not every step writes.
///
/// # Panics
/// When there are fewer values.
pub fn record(rec: &mut Recorder<'_>, values: &Buffer<f32>, n: u32, flag: &Buffer<u32>, gate: Option<&Buffer<u32>>) {
    assert!(n as usize <= values.len(), "{n} of {values:?}");
    let buffers = finite::Buffers { values: &values.view(), flag, gate };
    rec.run(finite::Kernel, buffers, finite::Push { n, bit: NOT_FINITE }, threads(n));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;

    /// Ordinary values, the largest, the smallest and both zeros.
    fn finite_values(n: usize) -> Vec<u32> {
        let kinds = [1.5, -f32::MAX, f32::MAX, f32::from_bits(1), -0.0, 0.0, -3e-30];
        (0..n.next_multiple_of(4)).map(|i| kinds[i % kinds.len()].to_bits()).collect()
    }

    #[test]
    fn matches_its_twin_and_misses_nothing() {
        let gpu = testing::gpu();
        for n in [0usize, 1, 3, 4, 63, 64, 65, 1000, 1023, 1024, 1025, 10_007] {
            let whole = finite_values(n);
            // Where it is, and whether it is among those looked at.
            let places = [None, Some(0), Some(n / 2), n.checked_sub(1), Some(n)];
            for (place, bad) in places.into_iter().flat_map(|at| {
                [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::from_bits(0xff80_0001)].map(|bad| (at, bad))
            }) {
                let mut words = whole.clone();
                let hit = place.filter(|&at| at < words.len());
                if let Some(at) = hit {
                    words[at] = bad.to_bits();
                }
                for flag in [0, 2] {
                    let values: Vec<[u32; 4]> = bytemuck::cast_vec(words.clone());
                    let case = finite::Arrays { values, flag: vec![flag], gate: None };
                    let push = finite::Push { n: n as u32, bit: NOT_FINITE };
                    let raised = hit.is_some_and(|at| at < n) && flag == 0;
                    let after = testing::run_once(finite::Kernel, &gpu, &case, push, threads(push.n));
                    assert_eq!(after.flag[0], flag | u32::from(raised) << NOT_FINITE, "{n}, {place:?}, {bad}");
                    testing::assert_twin(finite::Kernel, &gpu, case, push, threads(push.n));
                }
            }
        }
    }

    #[test]
    fn a_shut_gate_hides_what_was_not_written() {
        let gpu = testing::gpu();
        for (gate, flag, want) in [(0, 0, 0), (1, 0, 1 << NOT_FINITE), (7, 0, 1 << NOT_FINITE), (1, 1, 1)] {
            let values = vec![[0, 0, f32::NAN.to_bits(), 0]; 100];
            let case = finite::Arrays { values, flag: vec![flag], gate: Some(vec![gate]) };
            let push = finite::Push { n: 400, bit: NOT_FINITE };
            let after = testing::run_once(finite::Kernel, &gpu, &case, push, threads(400));
            assert_eq!(after.flag, [want]);
            testing::assert_twin(finite::Kernel, &gpu, case, push, threads(400));
        }
    }
}

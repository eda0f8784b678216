//! Partial sums of workgroups to one number each, in a fixed order.

use crate::cost::{Formula, work};
use crate::gpu::kernels::losses::sum;
use crate::gpu::{Buffer, Check, Recorder, Reference};

/// What the passes have to do.
pub(super) const COSTS: &[Formula] = &[Formula {
    pass: "losses/sum",
    variants: &[],
    derivation: "the partial sums, all that there is room for, read and added",
    work: |_, d| work((d.bytes)(d.buffer(0)), (d.bytes)(d.buffer(0)) / 4.0, 0.0),
}];

impl Reference for sum::Kernel {
    fn reference(host: sum::Host<'_>, push: sum::Push, (): ()) {
        let count = push.count as usize;
        for row in 0..push.rows as usize {
            let total: f64 = host.partial[row * count..][..count].iter().map(|&v| f64::from(v)).sum();
            host.sums[push.first as usize + row] = total as f32;
        }
    }

    fn check(_binding: &'static str) -> Check {
        // n partial sums pass through n / 256 + 16 additions: at most 4e-6 of the sum of magnitudes for a picture of
        // 571,536 pixels. Where terms cancel, the largest sum is the measure.
        Check { relative: 4e-6, absolute: 4e-6, band: 0.0 }
    }

    fn cancels(_binding: &'static str) -> bool {
        true // few sums, of terms of either sign
    }
}

/// Writes `sums[first + row]` = the sum of `partial[row * count ..][.. count]` for every row.
pub fn record(rec: &mut Recorder<'_>, partial: &Buffer<f32>, count: u32, rows: u32, sums: &Buffer<f32>, first: u32) {
    rec.run(sum::Kernel, sum::Buffers { partial, sums }, sum::Push { count, rows, first }, [64 * rows, 1]);
}

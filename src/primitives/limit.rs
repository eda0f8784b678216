//! Counts against capacities: what does not fit is reported, never dropped silently.

use crate::gpu::Reference;
use crate::gpu::kernels::primitives::limit;

impl Reference for limit::Kernel {
    fn reference(host: limit::Host<'_>, push: limit::Push, (): ()) {
        let wanted = host.wanted[0];
        let fits = wanted <= push.capacity;
        host.count[0] = if fits { wanted * push.factor } else { 0 };
        if !fits {
            host.overflow[0] |= 1 << push.bit;
        }
        host.counters[push.counter as usize] = wanted;
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
            let push = limit::Push { capacity: 100, bit: 3, counter: 2, factor: 10 };
            testing::assert_twin(limit::Kernel, &gpu, case, push, 1u32);
        }
    }
}

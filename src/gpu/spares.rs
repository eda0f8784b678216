//! Memory that buffers have left, for those that come.
//!
//! A large buffer has memory of its own. A round of growth frees most of them and makes them again, a little larger or not:
//! sizes are few, so that one of them is likely to be there.

use gpu_allocator::vulkan::Allocation;

/// Bytes of the memory of a buffer of more than `block` bytes: one of eight sizes between two powers of two, and no more than
/// `most` unless the buffer is.
pub(super) fn size(bytes: u64, block: u64, most: u64) -> u64 {
    if bytes <= block {
        return bytes;
    }
    bytes.next_multiple_of(1 << bytes.ilog2().saturating_sub(3)).min(most).max(bytes)
}

/// Memory that belongs to no buffer.
#[derive(Default)]
pub(super) struct Spares(Vec<Allocation>);

impl Spares {
    pub fn keep(&mut self, allocation: Allocation) {
        self.0.push(allocation);
    }

    /// Memory of exactly this size.
    pub fn take(&mut self, bytes: u64) -> Option<Allocation> {
        let found = self.0.iter().position(|spare| spare.size() == bytes)?;
        Some(self.0.swap_remove(found))
    }

    /// Takes out allocations until no more than `most` bytes are left.
    pub fn beyond(&mut self, most: u64) -> Vec<Allocation> {
        let mut left = self.bytes();
        let goes = self.0.iter().take_while(|spare| {
            let goes = left > most;
            left -= spare.size();
            goes
        });
        let goes = goes.count();
        self.0.drain(..goes).collect()
    }

    pub fn bytes(&self) -> u64 {
        self.0.iter().map(Allocation::size).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_few_and_an_eighth_larger_at_most() {
        assert_eq!([0, 7, 32].map(|bytes| size(bytes, 32, 1000)), [0, 7, 32], "memory that is shared");
        assert_eq!([33, 36, 37, 64, 65, 513].map(|bytes| size(bytes, 32, 1000)), [36, 36, 40, 64, 72, 576]);
        assert_eq!([900, 1000, 1001].map(|bytes| size(bytes, 32, 950)), [950, 1000, 1001]);
        let sizes: std::collections::BTreeSet<u64> = (33..1 << 16).map(|bytes| size(bytes, 32, u64::MAX)).collect();
        assert_eq!(sizes.len(), 8 * 11);
        assert!((33..1 << 16).all(|bytes| 8 * size(bytes, 32, u64::MAX) < 9 * bytes + 8));
    }
}

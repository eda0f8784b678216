//! How a picture is computed on a device: the choices of [`super::Config`] that trade accuracy for time, resolved.

use super::config::Config;
use super::tiling::Tiling;
use crate::gpu::Gpu;

/// What binning and blending are specialised for. Forward and backward passes of a picture must agree on it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Method {
    /// Shape of the tiles.
    pub tiling: Tiling,
    /// Samples below this alpha are skipped.
    pub alpha_min: f32,
    /// A pixel is finished before its transmittance falls below this.
    pub transmittance_min: f32,
    /// How depths become sort keys.
    pub depth_key: DepthKey,
}

impl Method {
    /// The configured method on this device.
    pub fn new(gpu: &Gpu, config: &Config) -> Self {
        Self::of(Tiling::of(gpu), config)
    }

    fn of(tiling: Tiling, config: &Config) -> Self {
        Self {
            tiling,
            alpha_min: config.alpha_threshold as f32,
            transmittance_min: config.transmittance_threshold as f32,
            depth_key: DepthKey::new(config.near as f32, DEPTH_BITS),
        }
    }
}

/// The default choices on these tiles.
impl From<Tiling> for Method {
    fn from(tiling: Tiling) -> Self {
        Self::of(tiling, &Config::default())
    }
}

/// Sort keys of depths: a positive float's bits order as the floats do, and so do the bits' distance from the near
/// plane's bits. 28 bits of that distance tell all floats up to 2^32 times the near plane apart, what lies farther shares
/// the last key; 31 bits hold every float. Depths with one key keep the order of their slots.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct DepthKey {
    /// Bits of the near plane.
    pub base: u32,
    /// Bits of the key.
    pub bits: u32,
}

/// Bits of a depth in the sort key: with 31 every float would have a key of its own, at the cost of a sorting pass.
const DEPTH_BITS: u32 = 28;

impl DepthKey {
    /// Keys of `bits` bits, 28 or more, for depths beyond `near` > 0.
    pub fn new(near: f32, bits: u32) -> Self {
        Self { base: near.to_bits(), bits: bits.min(31) }
    }

    /// The largest key.
    pub fn last(self) -> u32 {
        (1 << self.bits) - 1
    }

    /// The key of a depth > 0.
    pub fn of(self, depth: f32) -> u32 {
        depth.to_bits().saturating_sub(self.base).min(self.last())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn keys_order_as_depths(near in 1e-4f32..10.0, a in 1.0f32..1e9, b in 1.0f32..1e9, bits in 28u32..=32) {
            let key = DepthKey::new(near, bits);
            let (a, b) = (near * a, near * b);
            let (nearer, farther) = if a <= b { (a, b) } else { (b, a) };
            prop_assert!(key.of(farther) <= key.last());
            prop_assert_eq!(nearer < farther, key.of(nearer) < key.of(farther));
        }
    }

    #[test]
    fn keys_at_the_ends() {
        for bits in 28..=32 {
            let key = DepthKey::new(0.2, bits);
            assert_eq!(key.of(0.1), 0);
            assert_eq!(key.of(0.2), 0);
            assert!(key.of(f32::MAX) <= key.last());
            assert!(key.of(1e10) == key.last() || bits > 28);
        }
        assert!(DepthKey::new(0.2, 31).of(1e38) < DepthKey::new(0.2, 31).of(f32::MAX));
    }
}

//! Tiles of a picture: their two shapes.

use crate::gpu::{Form, Gpu};

/// Shape of the rasteriser's tiles.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Hash)]
pub enum Tiling {
    /// 16 x 16 pixels, some threads of several subgroups: any subgroup size.
    Wide,
    /// 8 x 8 pixels, one subgroup of 8 threads: CPU drivers.
    Narrow,
}

impl Tiling {
    /// The better shape for a device: narrow where kernels of lanes are taken.
    pub fn of(gpu: &Gpu) -> Self {
        if gpu.lanes() { Self::Narrow } else { Self::Wide }
    }
    /// The form of the kernels that work on such tiles.
    pub fn form(self) -> Form {
        match self {
            Self::Wide => Form::Gpu,
            Self::Narrow => Form::Cpu,
        }
    }
    /// Side of a tile in pixels.
    pub fn side(self) -> u32 {
        match self {
            Self::Wide => 16,
            Self::Narrow => 8,
        }
    }
    /// Threads per tile of the picture's pass.
    pub fn threads(self) -> u32 {
        match self {
            Self::Wide => 256,
            Self::Narrow => 8,
        }
    }
    /// Threads per tile of the way back, whose sums over a tile take the less the fewer they are.
    pub fn threads_backward(self) -> u32 {
        match self {
            Self::Wide => 128,
            Self::Narrow => 8,
        }
    }
    /// Tiles in x and y of a picture.
    pub fn grid(self, size: [u32; 2]) -> [u32; 2] {
        size.map(|n| n.div_ceil(self.side()))
    }
}

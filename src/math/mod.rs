//! Scalar functions that the CPU twins share.

pub mod adam;
pub mod align;
pub mod attention;
pub mod camera;
pub mod decoder;
pub mod harmonics;
pub mod hash;
pub mod ssim;
pub mod tiles;

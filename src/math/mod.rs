//! Scalar functions that the CPU twins share.

pub mod align;
pub mod ssim;

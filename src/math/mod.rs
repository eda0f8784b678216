//! Scalar functions that the CPU twins share.

pub mod adam;
pub mod attention;

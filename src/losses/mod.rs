//! Photometric, depth alignment, depth, depth gradient.

pub mod photometric;
mod sum;

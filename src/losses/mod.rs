//! Photometric, depth alignment, depth, depth gradient.

pub mod config;
pub mod photometric;

pub use config::Config;
mod sum;

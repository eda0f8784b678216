//! Photometric, depth alignment, depth, depth gradient.

pub mod config;

pub use config::Config;

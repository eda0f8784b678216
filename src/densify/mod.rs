//! Statistics, growing and pruning of anchors.

pub mod config;

pub use config::Config;

//! Statistics, growing and pruning of anchors; moving and adding of plain Gaussians.

pub mod config;
pub mod grow;
pub mod prune;
pub mod relocate;
pub mod statistics;

pub use config::Config;
pub use grow::{Grown, Round};
pub use statistics::{Drawn, Statistics};

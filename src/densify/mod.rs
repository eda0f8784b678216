//! Statistics, growing and pruning of anchors; splitting of plain Gaussians.

pub mod config;
pub mod grow;
pub mod prune;
pub mod split;
pub mod statistics;

pub use config::Config;
pub use grow::{Grown, Round};
pub use statistics::{Drawn, Statistics};

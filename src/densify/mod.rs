//! Statistics, growing and pruning of anchors.

pub mod config;
pub mod grow;
pub mod prune;
pub mod statistics;

pub use config::Config;
pub use grow::{Grown, Round};
pub use statistics::{Drawn, Statistics};

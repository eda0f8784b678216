//! Adam and its schedules.

pub mod adam;
pub mod config;
pub mod schedule;

pub use config::{BETAS, Config, Group};

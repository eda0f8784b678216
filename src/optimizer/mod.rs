//! Adam and its schedules.

pub mod config;

pub use config::Config;

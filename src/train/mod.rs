//! What a scene needs, the step, the loop, checkpoints.

pub mod config;

pub use config::Config;

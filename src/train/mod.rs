//! What a scene needs, the step, the loop, checkpoints.
//!
#![doc = include_str!("README.md")]

pub mod attend;
pub mod begin;
pub mod checkpoint;
pub mod config;
pub mod forecast;
pub mod order;
pub mod photographs;
pub mod plan;
pub mod run;
pub mod step;

pub use config::Config;

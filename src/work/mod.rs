//! The parts of a job that several commands begin with.

pub mod ready;

pub use ready::{Loaded, Ready, SYNTHETIC, load_scene};

//! The parts of a job that several commands begin with.

pub mod ready;
mod said;

pub use ready::{Loaded, Ready, SYNTHETIC, load_scene};
pub use said::is_new;

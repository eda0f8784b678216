//! The machine room: device, memory, kernels, recorder, barriers, timings. `vk::` appears nowhere else.
//!
//! A pass is one call: [`Recorder::run`] takes a kernel's typed bindings, its push constants and a number of threads.
//! The recorder knows from the bindings what the pass reads and writes and records a barrier exactly where a hazard
//! demands one. Every kernel has a CPU twin ([`Reference`]); [`Gpu::checked`] runs both and compares.

mod cache;
pub mod check;
pub mod commands;
mod context;
pub mod descriptors;
pub mod device;
pub mod error;
pub mod form;
pub mod hazards;
mod instance;
pub mod kernel;
pub mod ledger;
pub mod memory;
mod physical;
pub mod recorder;
mod spares;
pub mod statistics;
pub mod testing;
pub mod timings;
pub mod witness;

pub use check::{Check, Difference};
pub use commands::Command;
pub use descriptors::Descriptors;
pub use device::{Gpu, Options};
pub use error::Error;
pub use form::Form;
pub use hazards::{Entry, Schedule};
pub use kernel::{Access, Binding, Kernel, Reference, Slot};
pub use ledger::Used;
pub use memory::Buffer;
pub use physical::DeviceInfo;
pub use recorder::{Groups, NotFinite, Recorder, Submission, Threads};
pub use statistics::{Compiled, Statistic};
pub use timings::{Timing, Timings};
pub use witness::Case;

/// The typed interfaces of all kernels, generated from `glsl/` by `build.rs`.
#[allow(missing_docs, clippy::all, clippy::pedantic)]
pub mod kernels {
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
}

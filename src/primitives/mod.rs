//! Scan, sort, compact: know nothing of splats.
//!
//! Each takes the number of items from the host or from the device ([`Count`]), works in blocks that never wait for
//! one another, and gives the same bits on every run. Scratch memory is owned and sized for a capacity.

pub mod compact;
pub mod dispatch;
pub mod finite;
pub mod limit;
pub mod scan;
pub mod sort;

pub use compact::Compact;
pub use dispatch::Count;
pub use scan::Scan;
pub use sort::{Pairs, Sort};

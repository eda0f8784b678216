//! Scan, sort, reduce, compact: know nothing of splats.

pub mod dispatch;
pub mod limit;

//! Adam and its schedules.

pub mod adam;
pub mod schedule;

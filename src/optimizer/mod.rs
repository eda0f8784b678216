//! Adam and its schedules.

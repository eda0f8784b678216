//! Image metrics and their report.

//! Scan, sort, reduce, compact: know nothing of splats.

//! Photometric, depth alignment, depth, depth gradient.

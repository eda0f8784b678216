//! Scalar functions that the CPU twins share.

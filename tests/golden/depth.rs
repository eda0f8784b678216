//! Golden cases of kind `depth`.

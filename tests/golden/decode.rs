//! Golden cases of kind `decode`.

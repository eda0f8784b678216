//! Golden cases of kind `attention`.

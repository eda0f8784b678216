//! Golden cases of kind `adam`.

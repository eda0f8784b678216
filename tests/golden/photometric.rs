//! Golden cases of kind `photometric`.

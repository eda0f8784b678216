//! Golden cases of kind `project`.

//! Golden cases of kind `step`.

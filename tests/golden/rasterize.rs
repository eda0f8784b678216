//! Golden cases of kind `rasterize`.

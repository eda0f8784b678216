//! Cull, decode, project, bin, rasterize: forward and backward of a stage in one file.

pub mod cull;
pub mod decode;
pub mod project;

//! What is learnt: anchors, decoder, attention; files on disk.

pub mod anchors;
pub mod arrays;
pub mod attention;
pub mod config;
pub mod files;
pub mod gaussians;
pub mod init;
pub mod parameter;
pub mod ply;

pub use config::Config;

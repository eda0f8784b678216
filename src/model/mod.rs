//! What is learnt: anchors, decoder, attention; files on disk.

pub mod anchors;
pub mod attention;
pub mod attention_blend;
pub mod attention_select;
pub mod config;
pub mod files;
pub mod init;

pub use config::Config;

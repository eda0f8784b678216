#![doc = include_str!("README.md")]

pub mod cameras;
pub mod chosen;
pub mod fill;
pub mod frame;
pub mod ply;
pub mod read;
pub mod views;

use std::path::PathBuf;

use crate::sentence::one_line;

/// Why nothing can be taken out of a splat. Each message is one sentence that says what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A file that is not what it should be.
    #[error("{}: {}", path.display(), one_line(what))]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        what: String,
    },
    /// What was asked for cannot be.
    #[error("{0}")]
    Request(String),
    /// Cameras of a COLMAP model.
    #[error(transparent)]
    Scene(#[from] crate::scene::Error),
    /// The steps of `prepare`.
    #[error(transparent)]
    Prepare(#[from] crate::prepare::Error),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] crate::gpu::Error),
    /// Files that are written.
    #[error(transparent)]
    Write(#[from] crate::export::Error),
}

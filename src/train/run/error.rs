//! Why a run ends before its last step.

use crate::evaluate::{self};
use crate::gpu::{self, NotFinite};
use crate::model::{files, init};
use crate::signal::Signal;
use crate::train::checkpoint::{self};
use std::path::{Path, PathBuf};

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The device.
    #[error(transparent)]
    Gpu(#[from] gpu::Error),
    /// The points.
    #[error(transparent)]
    Init(#[from] init::Error),
    /// The model's files.
    #[error(transparent)]
    Files(#[from] files::Error),
    /// The figures.
    #[error(transparent)]
    Evaluate(#[from] evaluate::Error),
    /// A checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::WriteError),
    /// What is trained cannot become anything.
    #[error(
        "the training comes to nothing: {what}; `gscream-vk doctor` says whether cameras, points and photographs belong together"
    )]
    Nothing {
        /// One clause on how that shows.
        what: String,
    },
    /// Somebody asked for an end.
    #[error("stopped by {signal}")]
    Interrupted {
        /// How.
        signal: Signal,
    },
    /// Any of the others, once the run is under way.
    #[error("{source}; {}", how_to_go_on(source, *kept, folder))]
    Stopped {
        /// Why.
        source: Box<Error>,
        /// Step of the last checkpoint, if there is one.
        kept: Option<u32>,
        /// The run folder.
        folder: PathBuf,
    },
    /// A file of the run folder.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A number stopped being one.
    #[error("step {step} (view {view}): {}", where_from(found.as_ref()))]
    NotFinite {
        /// The step.
        step: u32,
        /// The view's name.
        view: String,
        /// The first one, if it came again when the step was repeated.
        found: Option<NotFinite>,
    },
}

fn where_from(found: Option<&NotFinite>) -> String {
    match found {
        Some(NotFinite { pass, tensor, index, value }) => format!(
            "pass {pass} wrote {value} into `{tensor}` (its float {index}), the first value that is not finite; lower the \
             learning rates, or look at that view's prior and mask"
        ),
        None => {
            "values that are not finite came up, and did not when the steps were repeated from good ones: the device's \
                 memory may be faulty"
                .to_owned()
        }
    }
}

impl Error {
    /// The signal that ended the run, if one did.
    pub fn signal(&self) -> Option<Signal> {
        match self {
            Self::Interrupted { signal } => Some(*signal),
            Self::Stopped { source, .. } => source.signal(),
            _ => None,
        }
    }

    /// The error that ended the run, without how to go on with its folder.
    pub fn cause(self) -> Self {
        match self {
            Self::Stopped { source, .. } => *source,
            other => other,
        }
    }
}

fn how_to_go_on(source: &Error, kept: Option<u32>, folder: &Path) -> String {
    match kept {
        // The same step would end the same way.
        Some(step) if matches!(source, Error::NotFinite { found: Some(_), .. } | Error::Nothing { .. }) => {
            format!("the last good state, behind step {step}, is {}", checkpoint::path(folder, step).display())
        }
        Some(step) => {
            format!("`gscream-vk train --resume {}` goes on behind step {step}", folder.display())
        }
        None => "there is no checkpoint to go on from".to_owned(),
    }
}

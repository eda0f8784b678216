use std::fmt;
use std::path::PathBuf;

use super::Invalid;

/// Where a value was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// A line of a file, counted from 1.
    File {
        /// The file as given.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
    },
    /// A line of an embedded preset.
    Preset {
        /// Its name.
        name: String,
        /// Line, counted from 1.
        line: usize,
    },
    /// `--set key=value`, as typed.
    Set(String),
    /// A flag, as typed.
    Flag(&'static str),
    /// Nowhere: the value is the default.
    Default,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, line } => write!(f, "{}:{line}", path.display()),
            Self::Preset { name, line } => write!(f, "preset {name}, line {line}"),
            Self::Set(text) => write!(f, "--set {text}"),
            Self::Flag(flag) => f.write_str(flag),
            Self::Default => f.write_str("default settings"),
        }
    }
}

/// Why settings could not be resolved: one sentence for the user.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A `--config` file that cannot be read.
    #[error("{}: cannot read the settings: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A preset that does not exist.
    #[error("there is no preset `{name}`; choose one of {}", preset_names())]
    UnknownPreset {
        /// The name as given.
        name: String,
    },
    /// `--set` without `=` or without a key.
    #[error("--set {text}: write it as KEY=VALUE with a dotted key, for example --set train.iterations=2000")]
    Set {
        /// The argument as given.
        text: String,
    },
    /// Text that is not TOML.
    #[error("{origin}: not valid TOML: {message}")]
    Syntax {
        /// Where.
        origin: Origin,
        /// What the parser said.
        message: String,
    },
    /// A key that no setting has.
    #[error("{origin}: unknown setting `{key}`; {hint}")]
    UnknownKey {
        /// Where.
        origin: Origin,
        /// The key, dotted from the root.
        key: String,
        /// The nearest known key, or the keys of the section.
        hint: String,
    },
    /// A key that older versions had, with a value that this one has not.
    #[error("{origin}: `{key}` is gone: {instead}")]
    Removed {
        /// Where.
        origin: Origin,
        /// The key, dotted from the root.
        key: String,
        /// What to do instead.
        instead: &'static str,
    },
    /// A value of a wrong type.
    #[error("{origin}: `{key}`: {message}")]
    Type {
        /// Where.
        origin: Origin,
        /// The key, dotted from the root.
        key: String,
        /// What was found and what was expected.
        message: String,
    },
    /// A value that makes no sense.
    #[error("{origin}: {invalid}")]
    Invalid {
        /// Which layer set it.
        origin: Origin,
        /// Key, value and reason.
        invalid: Box<Invalid>,
    },
}

fn preset_names() -> String {
    super::PRESETS.map(|(name, _)| name).join(", ")
}

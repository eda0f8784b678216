//! A value that no run could use, and the check that refuses it.

/// A setting whose value makes no sense. [`Error::Invalid`](super::Error::Invalid) is this with its origin.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{key}` is {value}, but {reason}")]
pub struct Invalid {
    /// Key, dotted, relative to the section that refused it.
    pub key: String,
    /// The value as text.
    pub value: String,
    /// What it must be.
    pub reason: String,
    /// The key it was compared with, if any: where the fault lies when `key` itself has its default.
    pub against: Option<String>,
}

impl Invalid {
    /// The same with its keys put inside `section`.
    pub fn inside(self, section: &str) -> Self {
        let inside = |key: String| format!("{section}.{key}");
        Self { key: inside(self.key), against: self.against.map(inside), ..self }
    }

    /// The same, naming the key that the value was compared with.
    pub fn against(self, key: &str) -> Self {
        Self { against: Some(key.to_owned()), ..self }
    }
}

/// `Err` naming `key` and `value` unless the condition holds; `reason` completes "is VALUE, but ...".
pub fn ensure(
    holds: bool,
    key: &str,
    value: impl std::fmt::Display,
    reason: impl std::fmt::Display,
) -> Result<(), Invalid> {
    if holds {
        return Ok(());
    }
    Err(Invalid { key: key.to_owned(), value: value.to_string(), reason: reason.to_string(), against: None })
}

//! What there is to say about a scene, a line at a time.

use std::fmt;
use std::ops::Deref;

/// One line about a scene; its kind says what follows from it.
#[derive(Clone, PartialEq, Eq)]
pub enum Note {
    /// Something of the user's is not used: photographs without a pose, masks of no photograph, a file of an unknown kind.
    Lost(String),
    /// A photograph is not used, because its camera stands where no capture has any.
    Stray(String),
    /// Everything else.
    Plain(String),
}

impl Deref for Note {
    type Target = str;

    fn deref(&self) -> &str {
        match self {
            Self::Lost(text) | Self::Stray(text) | Self::Plain(text) => text,
        }
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self)
    }
}

impl fmt::Debug for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&**self, f)
    }
}

impl From<String> for Note {
    fn from(text: String) -> Self {
        Self::Plain(text)
    }
}

impl From<&str> for Note {
    fn from(text: &str) -> Self {
        Self::Plain(text.to_owned())
    }
}

/// The notes of a scene, in order.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Notes(Vec<Note>);

impl Notes {
    /// Adds one; a text alone is a plain one.
    pub fn push(&mut self, note: impl Into<Note>) {
        self.0.push(note.into());
    }

    /// Moves all of `other` behind these.
    pub fn append(&mut self, other: &mut Self) {
        self.0.append(&mut other.0);
    }
}

impl Deref for Notes {
    type Target = [Note];

    fn deref(&self) -> &[Note] {
        &self.0
    }
}

impl fmt::Debug for Notes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<N: Into<Note>> Extend<N> for Notes {
    fn extend<I: IntoIterator<Item = N>>(&mut self, notes: I) {
        self.0.extend(notes.into_iter().map(Into::into));
    }
}

impl<N: Into<Note>> FromIterator<N> for Notes {
    fn from_iter<I: IntoIterator<Item = N>>(notes: I) -> Self {
        Self(notes.into_iter().map(Into::into).collect())
    }
}

impl IntoIterator for Notes {
    type Item = Note;
    type IntoIter = std::vec::IntoIter<Note>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.into_iter()
    }
}

impl<'a> IntoIterator for &'a Notes {
    type Item = &'a Note;
    type IntoIter = std::slice::Iter<'a, Note>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}

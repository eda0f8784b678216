//! Files that appear whole or not at all.
//!
//! A file is written under another name in the same folder, flushed to the disk and renamed. The other name is `.NAME.` and
//! six letters, by which `folder::sweep` knows whose it was where a writer was killed. A NAME that leaves no
//! room for these eight bytes is shortened there, so that every name that a file system takes can be written.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::hash::{BuildHasher, Hasher as _, RandomState};
use std::io::{self, Write};
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};

use serde::Serialize;

/// Bytes of a file's name on all common file systems.
pub const LONGEST_NAME: usize = 255;
/// Letters behind the name.
const LETTERS: usize = 6;

/// A file that is not there under its name before [`AtomicWriteFile::commit`]; without that nothing is left of it.
#[derive(Debug)]
pub struct AtomicWriteFile {
    file: File,
    target: PathBuf,
    /// Where it is written; nothing any more once it was renamed.
    temporary: Option<PathBuf>,
}

impl AtomicWriteFile {
    /// Begins a file that is to have this path.
    ///
    /// # Errors
    /// A folder that is missing or cannot be written.
    pub fn open(path: impl AsRef<Path>) -> io::Result<Self> {
        let target = path.as_ref().to_owned();
        let name = target.file_name().ok_or(io::ErrorKind::IsADirectory)?;
        let stem = shortened(name);
        let (file, temporary) = loop {
            let mut name = OsString::from(".");
            name.push(&stem);
            name.push(format!(".{}", letters()));
            let temporary = target.with_file_name(name);
            match File::options().write(true).create_new(true).open(&temporary) {
                Ok(file) => break (file, temporary),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        };
        let begun = Self { file, target, temporary: Some(temporary) };
        if let Ok(old) = std::fs::metadata(&begun.target).map(|old| old.permissions())
            && !old.readonly()
        {
            begun.file.set_permissions(old)?;
        }
        Ok(begun)
    }

    /// Gives the file its name, in place of what had it before.
    ///
    /// # Errors
    /// A file that cannot be flushed or renamed; what had the name before stays.
    pub fn commit(mut self) -> io::Result<()> {
        self.file.sync_all()?;
        if let Some(temporary) = &self.temporary {
            std::fs::rename(temporary, &self.target)?;
            self.temporary = None;
        }
        // The name, too, survives a loss of power; only Unix can open a folder for that.
        let folder = self.target.parent().filter(|folder| !folder.as_os_str().is_empty());
        if cfg!(unix) {
            File::open(folder.unwrap_or(Path::new(".")))?.sync_all()?;
        }
        Ok(())
    }
}

impl Drop for AtomicWriteFile {
    fn drop(&mut self) {
        if let Some(temporary) = &self.temporary {
            // Whoever drops it has an error to tell already.
            let _ = std::fs::remove_file(temporary);
        }
    }
}

impl Deref for AtomicWriteFile {
    type Target = File;

    fn deref(&self) -> &File {
        &self.file
    }
}

impl DerefMut for AtomicWriteFile {
    fn deref_mut(&mut self) -> &mut File {
        &mut self.file
    }
}

impl Write for AtomicWriteFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Writes a file that appears with all of these bytes or not at all.
///
/// # Errors
/// As [`AtomicWriteFile::open`] and [`AtomicWriteFile::commit`].
pub fn write(path: impl AsRef<Path>, bytes: impl AsRef<[u8]>) -> io::Result<()> {
    let mut file = AtomicWriteFile::open(path)?;
    file.write_all(bytes.as_ref())?;
    file.commit()
}

/// As [`write()`], in a folder that is made if it is missing.
///
/// # Errors
/// As [`write()`], and when the folder cannot be made.
pub fn write_below(path: &Path, bytes: impl AsRef<[u8]>) -> io::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    write(path, bytes)
}

/// Writes a value as indented JSON that ends with a line break; the file appears whole or not at all.
///
/// # Errors
/// As [`write()`], and of a value that JSON cannot say.
pub fn write_json(path: impl AsRef<Path>, value: &impl Serialize) -> io::Result<()> {
    write(path, serde_json::to_string_pretty(value)? + "\n")
}

/// A name of which [`LONGEST_NAME`] leaves room for two dots and the letters. A name that is too long keeps its beginning
/// and its extension, and gets a part of its hash between them.
pub fn shortened(name: &OsStr) -> OsString {
    let room = LONGEST_NAME - 2 - LETTERS;
    if name.len() <= room {
        return name.to_owned();
    }
    let text = name.to_string_lossy();
    let hash = blake3::hash(text.as_bytes()).to_hex();
    let extension = text.rsplit_once('.').map_or("", |(_, extension)| extension);
    let extension = if extension.len() <= 16 { extension } else { "" };
    let end = format!("~{}.{extension}", &hash[..8]);
    let head = (0..=room - end.len()).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0);
    format!("{}{end}", &text[..head]).into()
}

/// Letters that differ from one call to the next and from one process to another.
fn letters() -> String {
    let mut number = RandomState::new().build_hasher().finish();
    let letter = |_| {
        let digit = char::from_digit((number % 36) as u32, 36);
        number /= 36;
        digit.expect("a digit of base 36")
    };
    (0..LETTERS).map(letter).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listed(folder: &Path) -> Vec<String> {
        let names = std::fs::read_dir(folder).unwrap().flatten().map(|e| e.file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }

    /// Every name that the file system takes, of one byte to 255, in letters of one to four bytes.
    #[test]
    fn names_of_any_length_are_written() {
        let dir = tempfile::tempdir().unwrap();
        for length in [1, 100, 240, 246, 247, 248, 254, 255] {
            for letter in ["a", "é", "漢", "𝄞"] {
                let end = if length > 8 { ".png" } else { "" };
                let name = letter.repeat((length - end.len()) / letter.len()) + end;
                if name.is_empty() {
                    continue;
                }
                let path = dir.path().join(&name);
                for text in ["first", "second"] {
                    let mut file = AtomicWriteFile::open(&path).unwrap();
                    file.write_all(text.as_bytes()).unwrap();
                    let temporary: Vec<String> = listed(dir.path()).into_iter().filter(|n| *n != name).collect();
                    let [temporary] = temporary.as_slice() else { panic!("{temporary:?}") };
                    let (stem, letters) = temporary.strip_prefix('.').unwrap().rsplit_once('.').unwrap();
                    assert!(letters.len() == LETTERS && stem.ends_with(end), "{temporary}");
                    assert!(name.len() > 247 || stem == name, "{temporary}");
                    file.commit().unwrap();
                    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
                }
                std::fs::remove_file(&path).unwrap();
            }
        }
        assert!(listed(dir.path()).is_empty());
    }

    #[test]
    fn what_is_not_committed_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a"), "old").unwrap();
        let mut file = AtomicWriteFile::open(dir.path().join("a")).unwrap();
        file.write_all(b"half").unwrap();
        drop(file);
        assert_eq!(listed(dir.path()), ["a"]);
        assert_eq!(std::fs::read(dir.path().join("a")).unwrap(), b"old");
        let error = AtomicWriteFile::open(dir.path().join("nowhere/a")).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::NotFound);
        assert!(AtomicWriteFile::open("/").is_err());
    }

    /// A file that others may read stays one, and a new one has the rights of any other new file.
    #[cfg(unix)]
    #[test]
    fn rights_are_kept() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        let mode = |name: &str| std::fs::metadata(dir.path().join(name)).unwrap().permissions().mode() & 0o777;
        std::fs::write(dir.path().join("plain"), "").unwrap();
        AtomicWriteFile::open(dir.path().join("new")).unwrap().commit().unwrap();
        assert_eq!(mode("new"), mode("plain"));
        std::fs::set_permissions(dir.path().join("new"), std::fs::Permissions::from_mode(0o640)).unwrap();
        AtomicWriteFile::open(dir.path().join("new")).unwrap().commit().unwrap();
        assert_eq!(mode("new"), 0o640);
    }
}

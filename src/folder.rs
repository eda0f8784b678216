//! Folders that the program writes into: one program at a time, and what a killed one left is removed.

use std::fs::{File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

/// The lock's file within a folder. One that a killed program left behind is nobody's.
pub const LOCK: &str = ".gscream-vk.lock";

/// A folder that cannot be written into.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Another process holds the lock.
    #[error(
        "{}: another gscream-vk is at work in this folder: wait until it has ended, or name another folder",
        folder.display()
    )]
    Taken {
        /// The folder.
        folder: PathBuf,
    },
    /// The folder is missing and the system refuses to make it.
    #[error("{}: cannot be made", folder.display())]
    Make {
        /// The folder.
        folder: PathBuf,
        /// The system's words.
        source: io::Error,
    },
    /// The system refuses a file in the folder.
    #[error("{}: cannot be written", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: io::Error,
    },
}

/// A folder in which no other process of this program writes.
///
/// The system releases the lock when the process ends, however it ends. The folder is made where it is missing, and removed
/// again with the lock if nothing was written into it.
#[derive(Debug)]
pub struct Lock {
    path: PathBuf,
    file: File,
    /// Folders that were made for it, the outermost first.
    made: Vec<PathBuf>,
}

impl Lock {
    /// Takes the lock of a folder.
    ///
    /// # Errors
    /// Another process has it; a folder that cannot be made or written into. A file system without locks is none: there
    /// nothing guards the folder.
    pub fn take(folder: &Path) -> Result<Self, Error> {
        let missing = |path: &&Path| !path.as_os_str().is_empty() && !path.exists();
        let mut made: Vec<PathBuf> = folder.ancestors().take_while(missing).map(Path::to_owned).collect();
        made.reverse();
        let path = folder.join(LOCK);
        // Again where its last holder has removed the file, or the folder, since it was found.
        let file = loop {
            std::fs::create_dir_all(folder).map_err(|source| Error::Make { folder: folder.to_owned(), source })?;
            let file = match File::options().create(true).truncate(false).write(true).open(&path) {
                Ok(file) => file,
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(source) => return Err(Error::Write { path, source }),
            };
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => return Err(Error::Taken { folder: folder.to_owned() }),
                Err(TryLockError::Error(error)) => {
                    log::warn!("{}: cannot be locked: {error}", path.display());
                    break file;
                }
                Ok(()) if is_at(&file, &path) => break file,
                Ok(()) => {}
            }
        };
        Ok(Self { path, file, made })
    }
}

/// Whether the path leads to this very file. Where files are not removed under their lock there is nothing to ask.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    let identity = |found: io::Result<std::fs::Metadata>| found.ok().map(|found| (found.dev(), found.ino()));
    let found = identity(std::fs::metadata(path));
    found.is_some() && found == identity(file.metadata())
}

#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Removed while it is held, so that who finds it has it or waits for nobody.
        if cfg!(unix) {
            let _ = std::fs::remove_file(&self.path);
        }
        let _ = self.file.unlock();
        for folder in self.made.iter().rev() {
            // Fails where something is in it: it stays.
            let _ = std::fs::remove_dir(folder);
        }
    }
}

/// Letters and digits that end the name of a file that is being written: `.NAME.` and so many.
const SUFFIX: usize = 6;

/// Removes what a killed writer left of files whose names `owned` knows, such as `.NAME.a1B2c3`, which never became `NAME`.
pub fn sweep(folder: &Path, owned: impl Fn(&str) -> bool) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_name().to_str().and_then(left_of).is_some_and(&owned) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// [`sweep`] in a folder and in those below it.
pub fn sweep_below(folder: &Path, owned: &dyn Fn(&str) -> bool) {
    sweep(folder, owned);
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            sweep_below(&entry.path(), owned);
        }
    }
}

/// The name of the file that one of this name was to become, if it is the name of one that was being written.
fn left_of(name: &str) -> Option<&str> {
    let (stem, suffix) = name.strip_prefix('.')?.rsplit_once('.')?;
    (suffix.len() == SUFFIX && suffix.bytes().all(|byte| byte.is_ascii_alphanumeric())).then_some(stem)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_at_a_time_and_nothing_stays() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let folder = dir.path().join("runs/one");
        let lock = Lock::take(&folder).expect("nobody has it");
        assert!(folder.join(LOCK).is_file());
        let second = Lock::take(&folder).expect_err("it is taken");
        assert!(matches!(second, Error::Taken { .. }), "{second}");
        drop(lock);
        assert!(!dir.path().join("runs").exists(), "nothing was written into it");

        // What a killed process left is nobody's; a folder that holds something stays.
        std::fs::create_dir_all(&folder).expect("writable");
        std::fs::write(folder.join(LOCK), "").expect("writable");
        let lock = Lock::take(&folder).expect("nobody has it");
        drop(lock);
        assert!(folder.is_dir() && !folder.join(LOCK).exists(), "it was there before");
    }

    #[test]
    fn of_many_threads_one_has_it() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let inside = std::sync::atomic::AtomicU32::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..200 {
                        if let Ok(lock) = Lock::take(&dir.path().join("run")) {
                            assert_eq!(inside.fetch_add(1, std::sync::atomic::Ordering::SeqCst), 0, "two have it");
                            std::thread::yield_now();
                            inside.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                            drop(lock);
                        }
                    }
                });
            }
        });
    }

    #[test]
    fn only_what_was_being_written_is_swept() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let names =
            [".scene.ply.a1B2c3", "scene.ply", ".scene.ply", ".scene.ply.a1B2c", ".scene.ply.a1B2-3", ".mine.a1B2c3"];
        std::fs::create_dir(dir.path().join("below")).expect("writable");
        for name in names.iter().copied().chain(["below/.scene.ply.000000"]) {
            std::fs::write(dir.path().join(name), "").expect("writable");
        }
        sweep(dir.path(), |name| name == "scene.ply");
        let there = |name: &&str| dir.path().join(name).exists();
        assert_eq!(names.iter().filter(|name| there(name)).count(), names.len() - 1);
        assert!(!there(&names[0]) && there(&"below/.scene.ply.000000"));
        sweep_below(dir.path(), &|name| name == "scene.ply");
        assert!(!there(&"below/.scene.ply.000000"));
    }
}

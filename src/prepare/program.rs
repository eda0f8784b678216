//! Other programs: each runs in a process group of its own and is ended, with all that it started, when nobody waits for it
//! any more.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use super::{Error, Watch};
use crate::signal::Signal;

/// Time between two looks at a program and at the signals.
const POLL: Duration = Duration::from_millis(20);

/// Why a program has not ended by itself.
#[derive(Debug)]
enum Halt {
    /// It cannot be started, or its words cannot be kept.
    Io(PathBuf, io::Error),
    /// Somebody asked for an end.
    Interrupted(Signal),
}

/// Runs a program; nothing where it is not installed. What it says goes into the file `words`.
pub(super) fn ask(command: &mut Command, words: &Path, watch: &mut dyn Watch) -> Result<Option<ExitStatus>, Error> {
    match run(command, words, || watch.interrupted()) {
        Ok(status) => Ok(Some(status)),
        Err(Halt::Io(_, error)) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(Halt::Io(path, source)) => Err(Error::Io { path, source }),
        Err(Halt::Interrupted(signal)) => Err(Error::Interrupted { signal }),
    }
}

/// What a program has said.
pub(super) fn said(words: &Path) -> Result<String, Error> {
    let bytes = std::fs::read(words).map_err(|source| Error::Io { path: words.to_owned(), source })?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// The last line that a program has said.
pub(super) fn last_said(words: &Path) -> Result<String, Error> {
    let text = said(words)?;
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    Ok(last.unwrap_or("it said nothing").trim().to_owned())
}

/// Runs a program without input and waits for it. What it says goes into the file `words`.
fn run(
    command: &mut Command,
    words: &Path,
    mut interrupted: impl FnMut() -> Option<Signal>,
) -> Result<ExitStatus, Halt> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |error| Halt::Io(path, error)
    };
    let file = File::create(words).map_err(at(words))?;
    let second = file.try_clone().map_err(at(words))?;
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    let program = PathBuf::from(command.get_program());
    command.stdin(Stdio::null()).stdout(file).stderr(second);
    let mut running = Running(command.spawn().map_err(at(&program))?);
    loop {
        if let Some(status) = running.0.try_wait().map_err(at(&program))? {
            return Ok(status);
        }
        if let Some(signal) = interrupted() {
            return Err(Halt::Interrupted(signal));
        }
        std::thread::sleep(POLL);
    }
}

/// A program that ends with this.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // One that was waited for has no group any more that would be its own.
        if matches!(self.0.try_wait(), Ok(None)) {
            #[cfg(unix)]
            let _ = rustix::process::kill_process_group(
                rustix::process::Pid::from_child(&self.0),
                rustix::process::Signal::KILL,
            );
            #[cfg(not(unix))]
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }
}

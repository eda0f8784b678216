//! Signals that ask the program to end. They are noted from [`listen`] on, once per process, and looked at between pieces
//! of work; before it they do what the system has them do.
//!
//! A second SIGINT or SIGTERM ends the program at once. A second SIGHUP does not: a shell and the system each send one when
//! a terminal closes.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use anyhow::Context as _;
use signal_hook::flag;

use crate::signal::Signal;

/// The number of the last signal; 0 before the first.
static CAUGHT: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// A signal has ended the work.
#[derive(Debug, thiserror::Error)]
#[error("stopped by {signal}; {how}")]
pub struct Stopped {
    /// Which.
    pub signal: Signal,
    /// How the work is gone on with.
    pub how: String,
}

/// Notes signals from now on.
///
/// # Errors
/// When the system does not let them be caught.
pub fn listen() -> anyhow::Result<()> {
    static LISTENING: Mutex<bool> = Mutex::new(false);
    let mut listening = LISTENING.lock().unwrap_or_else(PoisonError::into_inner);
    if !*listening {
        let heard = Signal::ALL.into_iter().filter(|signal| *signal != Signal::Hangup || hangup_counts());
        heard.into_iter().try_for_each(|signal| note(signal).with_context(|| format!("{signal} cannot be caught")))?;
        *listening = true;
    }
    Ok(())
}

fn note(signal: Signal) -> std::io::Result<()> {
    let number = signal.number();
    if signal != Signal::Hangup {
        // In this order: the first time the flag is still down.
        let again = Arc::new(AtomicBool::new(false));
        flag::register_conditional_shutdown(number.into(), signal.exit_code().into(), again.clone())?;
        flag::register(number.into(), again)?;
    }
    flag::register_usize(number.into(), CAUGHT.clone(), number.into())?;
    Ok(())
}

/// Whether SIGHUP is there and is not ignored, as under `nohup`, where it must stay so. A system that does not tell keeps
/// what it does with it.
fn hangup_counts() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|digits| u64::from_str_radix(digits.trim(), 16).ok());
    ignored.is_some_and(|signals| (signals >> (Signal::Hangup.number() - 1)) & 1 == 0)
}

/// The last signal that was noted.
pub fn caught() -> Option<Signal> {
    let number = CAUGHT.load(Ordering::Relaxed);
    Signal::ALL.into_iter().find(|signal| usize::from(signal.number()) == number)
}

/// Goes on unless a signal was noted; `how` says what goes on with the work later.
///
/// # Errors
/// [`Stopped`].
pub fn check(how: impl FnOnce() -> String) -> Result<(), Stopped> {
    caught().map_or(Ok(()), |signal| Err(Stopped { signal, how: how() }))
}

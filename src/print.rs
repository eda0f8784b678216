//! `print!`, `println!`, `eprint!` and `eprintln!` of this crate. The standard ones panic where nobody reads any more.
//!
//! Notes on stderr are for whoever reads them: a training goes on when its terminal or its `| head` is gone. Results on
//! stdout are what a program is run for: a reader that is gone ends the program, as it ends any other.
//!
//! Unit tests have the standard ones, whose output the test harness keeps.

use std::fmt::Arguments;
use std::io::{self, Write as _};

macro_rules! print {
    ($($text:tt)*) => { $crate::print::result(format_args!($($text)*)) };
}

macro_rules! println {
    () => { $crate::print::result(format_args!("\n")) };
    ($($text:tt)*) => { $crate::print::result(format_args!("{}\n", format_args!($($text)*))) };
}

macro_rules! eprint {
    ($($text:tt)*) => { $crate::print::note(format_args!($($text)*)) };
}

macro_rules! eprintln {
    () => { $crate::print::note(format_args!("\n")) };
    ($($text:tt)*) => { $crate::print::note(format_args!("{}\n", format_args!($($text)*))) };
}

/// Writes to stderr if somebody reads it.
pub fn note(text: Arguments<'_>) {
    // In one piece, so that lines of several threads do not mix.
    let _ = io::stderr().write_all(text.to_string().as_bytes());
}

/// Writes to stdout; what cannot be written ends the program.
pub fn result(text: Arguments<'_>) {
    let Err(error) = io::stdout().write_all(text.to_string().as_bytes()) else { return };
    #[cfg(unix)]
    if error.kind() == io::ErrorKind::BrokenPipe {
        // It does not return.
        let _ = signal_hook::low_level::emulate_default_handler(signal_hook::consts::SIGPIPE);
    }
    note(format_args!("error: results cannot be written to stdout: {error}\n"));
    std::process::exit(1)
}

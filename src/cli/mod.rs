//! The commands, one file each, and what they share.
//!
//! To add a command: a file with `Args` (clap) and `run(Args) -> anyhow::Result<()>`, a line in `Command` and one in
//! [`run`]. Results go to stdout, progress, notes and what to do next to stderr. The exit code is 0 when all went well, 2 when the
//! arguments or settings make no sense, 128 and the signal's number when a signal ended a run, 1 when anything else went
//! wrong.

mod ablate;
mod bench;
mod completions;
mod devices;
mod doctor;
mod eval;
mod export;
pub mod folders;
mod hole;
mod index;
mod instruments;
mod kernels;
mod man;
mod minutes;
mod next;
pub mod pictures;
mod plan;
mod prepare;
mod preset;
mod remove;
mod render;
mod report;
pub mod shared;
mod signals;
mod synth;
mod train;
mod verify;
mod view;

use std::fmt::Write as _;
use std::process::ExitCode;

use crate::signal::Signal;

/// Removes an object from a 3D Gaussian scene, on any Vulkan 1.3 device.
///
/// A scene is a folder of photographs with a COLMAP model; masks of the object, depth priors and one inpainted view say
/// what to remove and what belongs in its place.
#[derive(Debug, clap::Parser)]
#[command(
    version,
    max_term_width = 110,
    after_help = "\
Start here:
  gscream-vk remove photos                         point at an object, and it is gone
  gscream-vk train synthetic --preset demo         train on the built-in scene
  gscream-vk synth scene                           make a small scene with an object in it
  gscream-vk eval renders --truth scene/test_images --masks scene/test_masks
  gscream-vk devices                               what can be run on

Exit codes: 0 done, 1 something went wrong, 2 the arguments or settings make no sense, 129, 130 and
143 stopped by SIGHUP, SIGINT and SIGTERM.
Set RUST_LOG=info or debug for more on stderr."
)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

/// What can be done.
#[derive(Debug, clap::Subcommand)]
enum Command {
    Remove(remove::Args),
    Prepare(prepare::Args),
    Doctor(doctor::Args),
    Train(train::Args),
    Render(render::Args),
    Eval(eval::Args),
    Export(export::Args),
    View(view::Args),
    Devices(devices::Args),
    Kernels(kernels::Args),
    Synth(synth::Args),
    Plan(plan::Args),
    Verify(verify::Args),
    Ablate(ablate::Args),
    Report(report::Args),
    Bench(bench::Args),
    Completions(completions::Args),
    Man(man::Args),
}

/// Runs the command.
///
/// # Errors
/// One sentence for the user, see [`message`].
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Remove(args) => remove::run(&args),
        Command::Prepare(args) => prepare::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Export(args) => export::run(&args),
        Command::View(args) => view::run(&args),
        Command::Devices(args) => devices::run(&args),
        Command::Kernels(args) => kernels::run(&args),
        Command::Synth(args) => synth::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Ablate(args) => ablate::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Completions(args) => completions::run(&args),
        Command::Man(args) => man::run(&args),
    }
}

/// The error as printed: one line, and a line for each cause that says something the lines before it do not.
pub fn message(error: &anyhow::Error) -> String {
    let mut text = format!("error: {error}");
    for cause in error.chain().skip(1) {
        let cause = cause.to_string();
        if !text.contains(&cause) {
            write!(text, "\n  caused by: {cause}").expect("a string takes everything");
        }
    }
    if error.chain().any(is_of_full_disk) {
        text.push_str("; make room on that disk first");
    }
    text
}

fn is_of_full_disk(cause: &(dyn std::error::Error + 'static)) -> bool {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    let kind = cause.downcast_ref::<std::io::Error>().map(std::io::Error::kind);
    kind.is_some_and(|kind| matches!(kind, StorageFull | QuotaExceeded | FileTooLarge))
}

/// Says what went wrong; returns the exit code.
pub fn fail(error: &anyhow::Error) -> ExitCode {
    eprintln!("{}", message(error));
    exit_code(error)
}

/// 2 for settings that make no sense, as for arguments that do not parse; 129, 130 and 143 for SIGHUP, SIGINT and SIGTERM;
/// 1 otherwise.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    if let Some(signal) = error.chain().find_map(signal) {
        return ExitCode::from(signal.exit_code());
    }
    ExitCode::from(if error.is::<crate::config::Error>() { 2 } else { 1 })
}

/// The signal that ended the work, if this is what an error says.
fn signal(error: &(dyn std::error::Error + 'static)) -> Option<Signal> {
    let stopped = error.downcast_ref::<signals::Stopped>().map(|stopped| stopped.signal);
    let run = || error.downcast_ref::<crate::train::run::Error>()?.signal();
    let capture = || error.downcast_ref::<crate::prepare::Error>()?.signal();
    let export = || match error.downcast_ref::<crate::export::Error>()? {
        crate::export::Error::Interrupted { signal } => Some(*signal),
        _ => None,
    };
    let hole = || error.downcast_ref::<crate::lab::hole::Error>()?.signal();
    stopped.or_else(run).or_else(capture).or_else(export).or_else(hole)
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;

    use super::*;

    #[test]
    fn causes_are_printed_where_they_add_something() {
        let io = || std::io::Error::other("disk full");
        let saying = anyhow::Error::from(pictures::Error { path: "a.png".into(), source: io() });
        assert_eq!(message(&saying), "error: a.png: the picture cannot be written: disk full");
        let adding = Err::<(), _>(io()).context("a.json: cannot be written").expect_err("an error");
        assert_eq!(message(&adding), "error: a.json: cannot be written\n  caused by: disk full");
        let full = std::io::Error::from(std::io::ErrorKind::StorageFull);
        let full = anyhow::Error::from(pictures::Error { path: "a.png".into(), source: full });
        assert!(message(&full).ends_with("; make room on that disk first"), "{}", message(&full));
    }
}

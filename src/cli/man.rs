use std::path::PathBuf;

use anyhow::Context as _;
use clap::CommandFactory as _;

use super::{Arguments, next};
use crate::export;

/// Write a manual page of every command
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk man ~/.local/share/man/man1 && man gscream-vk-train")]
pub(super) struct Args {
    /// Folder for the pages, gscream-vk.1 and gscream-vk-COMMAND.1
    #[arg(value_name = "DIR")]
    dir: PathBuf,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let mut program = Arguments::command().disable_help_subcommand(true);
    program.build();
    let mut pages = vec![];
    for command in std::iter::once(&program).chain(program.get_subcommands()) {
        let name = command.get_display_name().unwrap_or(command.get_name()).to_owned();
        let mut page = vec![];
        clap_mangen::Man::new(command.clone()).render(&mut page).context("a manual page")?;
        pages.push((args.dir.join(format!("{name}.1")), page));
    }
    let files: Vec<_> = pages.iter().map(|(path, page)| (path.clone(), page.as_slice())).collect();
    export::write(&files)?;
    println!("{}: {} manual pages", args.dir.display(), pages.len());
    next::say(&[(format!("man {}", next::typed(&args.dir.join("gscream-vk.1").to_string_lossy())), "reads the first")]);
    Ok(())
}

use clap::CommandFactory as _;

use super::{Arguments, next};

/// Print what a shell needs to complete this program's arguments
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk completions bash > ~/.local/share/bash-completion/completions/gscream-vk
  gscream-vk completions fish > ~/.config/fish/completions/gscream-vk.fish
  gscream-vk completions zsh > ~/.zfunc/_gscream-vk")]
pub(super) struct Args {
    /// The shell
    #[arg(value_enum, value_name = "SHELL")]
    shell: clap_complete::Shell,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let mut script = vec![];
    clap_complete::generate(args.shell, &mut Arguments::command(), "gscream-vk", &mut script);
    print!("{}", String::from_utf8_lossy(&script));
    next::say(&[("gscream-vk completions --help".into(), "where a shell looks for it")]);
    Ok(())
}

use clap::{Args, CommandFactory};
use clap_complete::Shell;

use crate::{Cli, write};

/// Print a script that completes shearq's options in a shell.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Shell to write the script for.
    #[arg(value_enum)]
    shell: Shell,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut text = Vec::new();
    clap_complete::generate(arguments.shell, &mut Cli::command(), "shearq", &mut text);
    // Not by `print`, which would escape the control characters of the script.
    write(&String::from_utf8(text)?)
}

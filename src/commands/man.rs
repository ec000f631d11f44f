use std::path::PathBuf;

use clap::{Args, CommandFactory};
use shearq_files::FileError;

use crate::{Cli, tell};

/// Write a manual page for each command: shearq.1, shearq-bias.1 and so on.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder to write to, such as ~/.local/share/man/man1.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let out = &arguments.out;
    std::fs::create_dir_all(out).map_err(FileError::doing(out, "cannot write"))?;
    clap_mangen::generate_to(Cli::command(), out).map_err(FileError::doing(out, "cannot write"))?;
    tell(format_args!("manual pages in {}", out.display()));
    Ok(())
}

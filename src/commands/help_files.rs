//! `shearq completions` and `shearq manual`: files for shells and for `man`.

use std::path::PathBuf;

use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;

use crate::{Cli, tell, write};
use shearq_files::atomic;

/// Print a script that completes shearq's options in a shell.
#[derive(Debug, Args)]
pub(crate) struct Completions {
    /// Shell to write the script for.
    #[arg(value_enum)]
    shell: Shell,
}

/// Write the manual pages for `man`.
#[derive(Debug, Args)]
pub(crate) struct Manual {
    /// Folder to write to.
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

pub(crate) fn completions(arguments: &Completions) -> anyhow::Result<()> {
    let mut text = Vec::new();
    clap_complete::generate(arguments.shell, &mut Cli::command(), "shearq", &mut text);
    // Not by `print`, which would escape the control characters of the script.
    write(&String::from_utf8(text)?)
}

pub(crate) fn manual(arguments: &Manual) -> anyhow::Result<()> {
    // `shearq help` has no page: `--help` prints the same.
    let mut cli = Cli::command().disable_help_subcommand(true);
    cli.build();
    let mut pages = Vec::new();
    add_pages("shearq", &cli, &mut pages);
    for (file, command) in &pages {
        let mut page = Vec::new();
        clap_mangen::Man::new(command.clone()).render(&mut page)?;
        atomic::write(arguments.out.join(file), &page)?;
    }
    tell(format_args!(
        "wrote {} pages to {}",
        pages.len(),
        arguments.out.display()
    ));
    Ok(())
}

fn add_pages(name: &str, command: &Command, pages: &mut Vec<(String, Command)>) {
    // `man` finds a page by the name of its command.
    pages.push((format!("{name}.1"), command.clone().name(name.to_owned())));
    for subcommand in command.get_subcommands() {
        add_pages(
            &format!("{name}-{}", subcommand.get_name()),
            subcommand,
            pages,
        );
    }
}

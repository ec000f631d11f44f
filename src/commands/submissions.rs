use std::path::PathBuf;

use clap::{Args, Subcommand};
use shearq_submissions::{Configuration, PsfForm, Published, Registry, Template};

use crate::arguments::{Form, named};
use crate::{print, tell};
use shearq_files::atomic;
use shearq_render::table::{Cell, Table};

/// List, show and create configurations: the settings that `measure` uses.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List the built-in configurations with their published metrics.
    #[command(after_help = "Example:\n  shearq submissions list --format markdown")]
    List {
        #[command(flatten)]
        form: Form,
    },
    /// Print all settings of a configuration as TOML.
    #[command(after_help = "Example:\n  shearq submissions show 48/linear/star")]
    Show {
        /// Configuration: a name from `shearq submissions list` or a TOML file.
        #[arg(value_name = "NAME|FILE")]
        name: String,
    },
    /// Write a configuration file with comments, to start your own from.
    #[command(after_help = "Example:\n  shearq submissions init own.toml")]
    Init {
        /// New file to write.
        #[arg(value_name = "FILE")]
        file: PathBuf,
        /// Method to configure.
        #[arg(long, value_parser = named::<Template>(), default_value = "linear")]
        method: Template,
    },
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::List { form } => form.print(&list()?),
        Command::Show { name } => {
            let entry = Registry::embedded()?.get(name)?;
            // Resolved: the output has every setting, so that it does not depend on the files that it extends.
            let mut text = toml::to_string(&entry.configuration)?;
            if let Some(published) = entry.published {
                text.push_str(&format!("\n[published]\n{}", toml::to_string(&published)?));
            }
            print(&text)
        }
        Command::Init { file, method } => {
            anyhow::ensure!(
                // Never over a file: it may be the settings that the user tuned.
                atomic::write_if_absent(file, method.text()?.as_bytes())?,
                "{}: the file exists; expected a new file name",
                file.display()
            );
            tell(format_args!("wrote {}", file.display()));
            Ok(())
        }
    }
}

fn list() -> anyhow::Result<Table> {
    let registry = Registry::embedded()?;
    let entries = registry
        .names()
        .iter()
        .map(|name| Ok((name, registry.get(name)?)));
    let rows: Vec<_> = entries.collect::<anyhow::Result<_>>()?;
    let mut table = Table::titled("Configurations");
    let mut words = |key, label, word: fn(&Configuration) -> String| {
        table.column(key, label, &rows, |(_, entry)| {
            Cell::text(word(&entry.configuration))
        });
    };
    words("name", "Name", |own| own.name.clone());
    words("stamp", "Stamp", |own| format!("{0}×{0}", own.stamp.size));
    words("data", "Data", |own| match own.wavelet() {
        None => "raw".into(),
        Some(_) => "denoised".into(),
    });
    words("psf", "PSF", |own| match own.psf.form {
        PsfForm::Star => "star".into(),
        PsfForm::Functional => "functional".into(),
    });
    let mut published = |key, label, decimals, value: fn(&Published) -> f64| {
        table.column(key, label, &rows, |(_, entry)| {
            Cell::number(entry.published.as_ref().map_or(f64::NAN, value), decimals)
        });
    };
    published("m_half_published", "M/2 publ.", 4, |p| p.m_half);
    published("sqrt_a_published", "√A×10⁴ publ.", 4, |p| p.sqrt_a);
    published("q_published", "Q publ.", 2, |p| p.q);
    table.column("description", "Description", &rows, |(_, entry)| {
        Cell::text(&entry.configuration.description)
    });
    table.notes = vec!["Published: Table 1 of Nurbaeva et al. (2015).".into()];
    Ok(table)
}

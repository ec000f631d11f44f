//! `shearq submissions`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use shearq_submissions::{PsfForm, Registry, Template};

use crate::arguments::Form;
use crate::{print, tell};
use shearq_files::atomic;
use shearq_render::table::{Cell, Heading, Table};

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
        #[arg(long, value_enum, default_value_t = Method::Linear)]
        method: Method,
    },
}

/// Method of a new configuration.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Method {
    /// The linear network in closed form (recommended).
    Linear,
    /// The Hopfield network of the paper.
    Network,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::List { form } => form.print(&list()?),
        Command::Show { name } => {
            let entry = Registry::embedded()?.get(name)?;
            let mut text = toml::to_string(&entry.configuration)?;
            if let Some(published) = entry.published {
                text.push_str(&format!("\n[published]\n{}", toml::to_string(&published)?));
            }
            print(&text)
        }
        Command::Init { file, method } => {
            let template = match method {
                Method::Network => Template::Network,
                Method::Linear => Template::Linear,
            };
            anyhow::ensure!(
                atomic::write_if_absent(file, template.text()?.as_bytes())?,
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
    let mut rows = Vec::new();
    for name in registry.names() {
        let entry = registry.get(name)?;
        let s = &entry.configuration;
        let published = |value: fn(&shearq_submissions::Published) -> f64| {
            entry.published.as_ref().map_or(f64::NAN, value)
        };
        rows.push(vec![
            Cell::text(name),
            Cell::text(format!("{0}×{0}", s.stamp.size)),
            Cell::text(match s.wavelet() {
                None => "raw",
                Some(_) => "denoised",
            }),
            Cell::text(match s.psf.form {
                PsfForm::Star => "star",
                PsfForm::Functional => "functional",
            }),
            Cell::number(published(|p| p.m_half), 4),
            Cell::number(published(|p| p.sqrt_a), 4),
            Cell::number(published(|p| p.q), 2),
            Cell::text(&s.description),
        ]);
    }
    let headings = [
        ("name", "Name"),
        ("stamp", "Stamp"),
        ("data", "Data"),
        ("psf", "PSF"),
        ("m_half_published", "M/2 publ."),
        ("sqrt_a_published", "√A×10⁴ publ."),
        ("q_published", "Q publ."),
        ("description", "Description"),
    ];
    Ok(Table {
        title: "Configurations".into(),
        headings: headings
            .iter()
            .map(|(key, label)| Heading::new(key, *label))
            .collect(),
        rows,
        notes: vec!["Published: Table 1 of the paper.".into()],
    })
}

//! `shearq compare`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shearq_scoring::{Noise, Options};
use shearq_submissions::Registry;

use super::arguments::{Printing, ScoreSettings, Threads};
use super::print;
use crate::io::layout::DataFolder;
use crate::io::run::Run;
use crate::pipeline::score::score_folder;
use crate::report::scores::{Variant, compare};
use crate::report::table::Table;

/// Put measured submissions side by side, beside the published figures.
///
/// Each OUT is a folder that `measure` wrote. Differences in Q are taken from the first and paired
/// over the same images, so that noise common to both cancels.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folders of catalogues.
    #[arg(value_name = "OUT", required = true)]
    measured: Vec<PathBuf>,
    /// Data folder with the true shear [default: the one each OUT was measured from].
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    settings: ScoreSettings,
    #[command(flatten)]
    threads: Threads,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let options = Options {
        definition: arguments.settings.definition(),
        noise: Noise::Measured,
        choice: arguments.settings.choice(),
    };
    let table = table(
        &arguments.measured,
        arguments.data.as_deref(),
        options,
        arguments.threads.number(),
    )?;
    print(&arguments.printing.render(&table))
}

/// The comparison of several results folders.
pub(super) fn table(
    folders: &[PathBuf],
    data: Option<&Path>,
    options: Options,
    threads: usize,
) -> anyhow::Result<Table> {
    let registry = Registry::embedded()?;
    let mut variants = Vec::new();
    for folder in folders {
        let run = Run::read(folder)?.with_context(|| {
            format!(
                "{}: there is no run.json; expected a folder that `shearq measure` wrote",
                folder.display()
            )
        })?;
        let data = DataFolder::open(data.unwrap_or(&run.data))?;
        variants.push(Variant {
            scored: score_folder(&data, folder, &run, &[], options, threads)?,
            // Published figures belong to the embedded settings, not to a file of the same name.
            published: registry
                .get(&run.submission.name)
                .ok()
                .filter(|entry| entry.submission == run.submission)
                .and_then(|entry| entry.published),
            name: run.submission.name,
        });
    }
    Ok(compare(&variants, options.definition, options.choice))
}

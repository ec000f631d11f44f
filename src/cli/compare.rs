//! `shearq compare`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shearq_scoring::{Grid, Noise, Options};
use shearq_submissions::Registry;

use super::arguments::{Printing, ScoreSettings, Threads};
use super::print;
use crate::io::layout::{DataFolder, MAX_SET};
use crate::io::run::{Run, Source};
use crate::pipeline::score::{score_folder, score_sets};
use crate::report::scores::{Variant, compare};
use crate::report::table::Table;
use crate::submit::foreign::Foreign;

/// Put measured submissions side by side, beside the published figures.
///
/// Each OUT is a folder that `measure` wrote. Differences in Q are taken from the first and paired
/// over the same images, so that noise common to both cancels.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folders of catalogues.
    #[arg(value_name = "OUT", required_unless_present = "foreign")]
    measured: Vec<PathBuf>,
    /// Data folder with the true shear [default: the one the first OUT was measured from].
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Catalogues of another program, described in a TOML file (docs/formats.md). May be given
    /// several times.
    #[arg(long, value_name = "FILE")]
    foreign: Vec<PathBuf>,
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
        &arguments.foreign,
        arguments.data.as_deref(),
        options,
        arguments.threads.number(),
    )?;
    print(&arguments.printing.render(&table))
}

/// The comparison of several results folders and of other programs' catalogues.
pub(super) fn table(
    folders: &[PathBuf],
    foreign: &[PathBuf],
    data: Option<&Path>,
    options: Options,
    threads: usize,
) -> anyhow::Result<Table> {
    let registry = Registry::embedded()?;
    let given = data.map(DataFolder::open).transpose()?;
    let mut first: Option<(Source, DataFolder)> = None;
    let mut variants = Vec::new();
    for folder in folders {
        let run = Run::require(folder)?;
        let data = match (&given, &first) {
            (Some(data), _) => data,
            (None, Some((source, data))) => {
                anyhow::ensure!(
                    *source == run.source,
                    "{}: it was measured from {}, the first from {source}; give --data DIR to score both against one truth",
                    folder.display(),
                    run.source,
                );
                data
            }
            (None, None) => {
                let data = run.source.data(folder).with_context(|| {
                    format!(
                        "the data folder of {} (--data gives another)",
                        folder.display()
                    )
                })?;
                &first.insert((run.source.clone(), data)).1
            }
        };
        variants.push(Variant {
            scored: score_folder(data, folder, &run, &[], options, threads)?,
            // Published figures belong to the embedded settings, not to a file of the same name.
            published: registry
                .get(&run.submission.name)
                .ok()
                .filter(|entry| entry.submission == run.submission)
                .and_then(|entry| entry.published),
            name: run.submission.name,
        });
    }
    for path in foreign {
        let data = given
            .as_ref()
            .or(first.as_ref().map(|(_, data)| data))
            .context("--foreign alone needs --data DIR with the true shear")?;
        variants.push(foreign_variant(path, data, options, threads)?);
    }
    let common = |set: u32| {
        variants
            .iter()
            .all(|v| v.scored.iter().any(|s| s.set == set))
    };
    anyhow::ensure!(
        (1..=MAX_SET).any(common),
        "the variants have no set in common; there is nothing to compare"
    );
    Ok(compare(&variants, options.definition, options.choice))
}

fn foreign_variant(
    path: &Path,
    data: &DataFolder,
    options: Options,
    threads: usize,
) -> anyhow::Result<Variant> {
    let foreign = Foreign::read(path)?;
    let read = |grid: &Grid, path: &Path| foreign.sum(grid, path);
    let catalogues = |set| foreign.catalogues(set);
    let scored = score_sets(data, &[], catalogues, &read, options, threads)
        .with_context(|| path.display().to_string())?;
    Ok(Variant {
        name: foreign.name.clone(),
        scored,
        published: None,
    })
}

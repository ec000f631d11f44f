//! `shearq compare`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shearq_scoring::{Grid, Options};
use shearq_submissions::{Published, Registry};

use super::arguments::{Printing, ScoreSettings, Threads};
use super::print_heat_map;
use crate::io::layout::{DataFolder, MAX_SET};
use crate::io::listing::Files;
use crate::io::run::{Run, Source};
use crate::io::store::{self, Conditions};
use crate::pipeline::inputs;
use crate::pipeline::record::set_record;
use crate::pipeline::score::{Catalogues, ScoredSet, own_catalogue, score_variants};
use crate::report::comparison::{Variant, compare, q_heat_map};
use crate::report::figure::{Figure, HeatMap};
use crate::report::runs::{Grouping, Order, compare_runs, runs_heat_map};
use crate::report::scores::notes;
use crate::report::table::{Table, TableFormat};
use crate::submit::foreign::Foreign;

/// Put measured submissions side by side, beside the published figures, or past runs of a store.
///
/// Each OUT is a folder that `measure` or `run` wrote. Differences in Q are taken from the first and
/// paired over the same images, so that noise common to both cancels.
///
/// With --store the runs are those that `score --store` and `run --store` recorded. On a terminal Q
/// per set follows as a heat map, in colours unless NO_COLOR is set.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folders of catalogues.
    #[arg(value_name = "OUT", required_unless_present_any = ["foreign", "store"])]
    measured: Vec<PathBuf>,
    /// Data folder with the true shear [default: the one the first OUT was measured from].
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Catalogues of another program, described in a TOML file (docs/formats.md). May be given
    /// several times.
    #[arg(long, value_name = "FILE")]
    foreign: Vec<PathBuf>,
    /// Results store whose runs to compare, instead of folders.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["measured", "data", "foreign", "definition", "convention", "threads"])]
    store: Option<PathBuf>,
    /// Rows of the store to look at: conditions on its columns that all must hold, as in
    /// `snr=low,submission=23/*,q>50`, with = != < <= > >= and `*` for any characters.
    #[arg(long = "where", value_name = "CONDITIONS", requires = "store")]
    conditions: Option<Conditions>,
    /// Figure or column to sort by, as in `q:desc`.
    #[arg(long, value_name = "FIELD[:desc]", requires = "store")]
    sort: Option<Order>,
    /// Means over groups of sets instead of all sets of a run.
    #[arg(long, value_enum, requires = "store")]
    group_by: Option<Grouping>,
    /// Draw Q per run and set as PNG or SVG, by the file's ending.
    #[arg(long, value_name = "FILE")]
    heat_map: Option<PathBuf>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    settings: ScoreSettings,
    #[command(flatten)]
    threads: Threads,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (table, map) = match &arguments.store {
        Some(store) => stored(arguments, store)?,
        None => {
            let variants = variants(
                &arguments.measured,
                &arguments.foreign,
                arguments.data.as_deref(),
                &arguments.settings,
                arguments.threads.number(),
            )?;
            let rows: Vec<_> = variants
                .iter()
                .map(|v| (v.name.clone(), v.sets.iter().collect()))
                .collect();
            let table = compare(&variants, arguments.settings.definition());
            (table, q_heat_map(&rows))
        }
    };
    if let Some(path) = &arguments.heat_map {
        map.save(path)?;
    }
    arguments.printing.print(&table)?;
    if arguments.printing.format() == TableFormat::Table {
        print_heat_map(map)?;
    }
    Ok(())
}

/// The comparison of a store's runs.
fn stored(arguments: &Arguments, path: &Path) -> anyhow::Result<(Table, HeatMap)> {
    let (mut runs, notes) = store::read(path)?;
    if let Some(conditions) = &arguments.conditions {
        runs = conditions
            .choose(runs)
            .map_err(|message| anyhow::anyhow!("--where: {message}"))?;
    }
    anyhow::ensure!(
        !runs.is_empty(),
        "{}: there is no recorded run{}",
        path.display(),
        match &arguments.conditions {
            Some(_) => " for which the conditions hold",
            None => "; `score --store` and `run --store` record them",
        }
    );
    let mut table = compare_runs(&runs, arguments.group_by, arguments.sort.as_ref());
    table.notes.extend(notes);
    Ok((table, runs_heat_map(&runs, arguments.sort.as_ref())))
}

/// What one variant is before it is scored.
struct Entrant<'a> {
    name: String,
    published: Option<Published>,
    files: Files,
    foreign: Option<&'a Foreign>,
}

/// Scores of several results folders and of other programs' catalogues on the sets that all have.
pub(super) fn variants(
    folders: &[PathBuf],
    foreign: &[PathBuf],
    data: Option<&Path>,
    settings: &ScoreSettings,
    threads: usize,
) -> anyhow::Result<Vec<Variant>> {
    let foreign: Vec<Foreign> = foreign
        .iter()
        .map(|path| Foreign::read(path))
        .collect::<Result<_, _>>()?;
    let registry = Registry::embedded()?;
    let mut data = data.map(DataFolder::open).transpose()?;
    let given = data.is_some();
    let mut first: Option<(&Path, Source)> = None;
    let mut entrants = Vec::new();
    for folder in folders {
        let run = Run::require(folder)?;
        if !given {
            let (beside, source) = first.get_or_insert_with(|| (folder, run.source.clone()));
            anyhow::ensure!(
                *source == run.source.moved(folder, beside)?,
                "{}: it was measured from {}, the first from {source}; give --data DIR to score both against one truth",
                folder.display(),
                run.source,
            );
        }
        if data.is_none() {
            data = Some(run.source.data(folder).with_context(|| {
                format!(
                    "the data folder of {} (--data gives another)",
                    folder.display()
                )
            })?);
        }
        if let Some(data) = &data {
            inputs::verify(data, folder, &run, &[], threads)?;
        }
        entrants.push(Entrant {
            // Published figures belong to the embedded settings, not to a file of the same name.
            published: registry
                .get(&run.submission.name)
                .ok()
                .filter(|entry| entry.submission == run.submission)
                .and_then(|entry| entry.published),
            name: run.submission.name.clone(),
            files: run.catalogues(folder, &[])?,
            foreign: None,
        });
    }
    let data = data.context("--foreign alone needs --data DIR with the true shear")?;
    for foreign in &foreign {
        entrants.push(Entrant {
            name: foreign.name.clone(),
            published: None,
            files: foreign.catalogues(&[])?,
            foreign: Some(foreign),
        });
    }
    for entrant in &entrants {
        anyhow::ensure!(
            !entrant.files.sets().is_empty(),
            "{}: there is no catalogue to score",
            entrant.name
        );
    }
    let common = |set: u32| entrants.iter().all(|e| e.files.sets().contains(&set));
    anyhow::ensure!(
        (1..=MAX_SET).any(common),
        "the variants have no set in common; there is nothing to compare"
    );
    let readers: Vec<_> = entrants
        .iter()
        .map(|entrant| {
            let foreign = entrant.foreign;
            move |grid: &Grid, path: &Path| match foreign {
                Some(foreign) => foreign.sum(grid, path),
                None => own_catalogue(grid, path),
            }
        })
        .collect();
    let of_set: Vec<_> = entrants
        .iter()
        .map(|entrant| |set: u32| entrant.files.of_set(set))
        .collect();
    let catalogues: Vec<Catalogues<'_>> = of_set
        .iter()
        .zip(&readers)
        .zip(&entrants)
        .map(|((of_set, read), entrant)| Catalogues {
            of_set,
            read,
            choice: match entrant.foreign {
                Some(_) => settings.choice(),
                None => settings.own_choice(),
            },
        })
        .collect();
    let options = Options {
        definition: settings.definition(),
        ..Options::default()
    };
    let scored = score_variants(&data, &catalogues, &[], options, threads)?;
    drop(catalogues);
    drop(readers);
    drop(of_set);
    Ok(entrants
        .into_iter()
        .zip(scored)
        .map(|(entrant, scored)| variant(entrant.name, entrant.published, &scored))
        .collect())
}

fn variant(name: String, published: Option<Published>, scored: &[ScoredSet]) -> Variant {
    Variant {
        name,
        published,
        // All are scored against one truth, so their data need no fingerprint to be told apart.
        sets: scored
            .iter()
            .map(|set| set_record(set, String::new()))
            .collect(),
        notes: notes(scored),
    }
}

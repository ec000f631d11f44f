//! `shearq baseline`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use shearq_submissions::{Registry, Submission};

use super::arguments::{Form, SetList, SimulationArguments, Threads};
use super::progress::Bar;
use super::{print, tell};
use crate::io::atomic;
use crate::io::baseline::{Baseline, BaselineSet, BaselineSubmission, Change};
use crate::io::layout::{DataFolder, MAX_IMAGE};
use crate::io::run::{Run, Source};
use crate::pipeline::baseline::{Wanted, figures_of, measure, settings_moved, shifts};
use crate::report::baseline::{Checked, junit, shift_table};
use crate::report::table::TableFormat;

/// The submission that all others rest on.
const BASE: &str = "paper";

/// Keep figures as baselines, and see later whether they moved.
///
/// A baseline is a TOML file that holds the scores with errors per set, the scatter of the
/// ellipticities, and everything that made them: settings, data, seed, version.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Record(RecordArguments),
    Check(CheckArguments),
}

/// Store figures as a new baseline.
///
/// Either of folders that `measure` or `run` wrote (--measured), or of sets simulated for it
/// (--simulate).
#[derive(Debug, Args)]
struct RecordArguments {
    /// Name of the baseline; it must be new.
    #[arg(value_name = "NAME", value_parser = file_stem)]
    name: String,
    /// Folders of catalogues, of the same data.
    #[arg(long, value_name = "OUT", num_args = 1.., required_unless_present = "simulate")]
    measured: Vec<PathBuf>,
    /// Simulate the data in memory, now and at each check.
    #[arg(long, conflicts_with = "measured", requires_all = ["sets", "images"])]
    simulate: bool,
    /// Submission to measure, by name or file; may be given several times [default: all that
    /// `submissions list` shows].
    #[arg(long, value_name = "NAME|FILE", requires = "simulate")]
    submission: Vec<String>,
    /// Sets to simulate, as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST", requires = "simulate")]
    sets: Option<SetList>,
    /// Images per set to simulate.
    #[arg(long, value_name = "N", requires = "simulate", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    #[command(flatten)]
    simulation: SimulationArguments,
    #[command(flatten)]
    place: Place,
    #[command(flatten)]
    threads: Threads,
}

/// Measure baselines again and compare.
///
/// Named submissions are measured with their present settings, others with those stored. On the same
/// data a figure must be the same but for rounding; on other data (--data) within noise. Q, M/2, √A
/// and the scatter of e1 and e2 are looked at; CSV and JSON have every one, the other formats those
/// that moved.
///
/// Exit code 0: nothing moved; 1: something did.
#[derive(Debug, Args)]
struct CheckArguments {
    /// Names of baselines [default: all in the folder].
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Data folder to measure instead of the one recorded.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Standard errors by which a figure may be off on other data than the baseline's.
    #[arg(long, value_name = "K", default_value_t = 3.0)]
    sigma: f64,
    /// Replace what moved. The baseline keeps the reason and what moved.
    #[arg(long, requires = "reason")]
    update: bool,
    /// Why the baseline changes.
    #[arg(long, value_name = "TEXT", requires = "update")]
    reason: Option<String>,
    /// Write the result as JUnit XML too.
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    #[command(flatten)]
    place: Place,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

/// Where baselines are kept.
#[derive(Debug, Args)]
struct Place {
    /// Folder of the baselines.
    #[arg(long, value_name = "DIR", default_value = "submissions/baselines")]
    folder: PathBuf,
}

/// A name that is good for a file in the folder.
fn file_stem(text: &str) -> Result<String, String> {
    let good = |c: char| c.is_alphanumeric() || "-_.+".contains(c);
    if text.chars().all(good) && !text.starts_with('.') && !text.is_empty() {
        Ok(text.to_owned())
    } else {
        Err("expected letters, digits, `-`, `_`, `+` and `.`".into())
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::Record(arguments) => record(arguments),
        Command::Check(arguments) => check(arguments),
    }
}

fn record(arguments: &RecordArguments) -> anyhow::Result<()> {
    let path = Baseline::path(&arguments.place.folder, &arguments.name);
    anyhow::ensure!(
        !path.exists(),
        "{}: the baseline exists; `baseline check {} --update --reason TEXT` changes it",
        path.display(),
        arguments.name
    );
    let threads = arguments.threads.number();
    let mut submissions = Vec::new();
    let source = if arguments.simulate {
        let source = Source::Simulated(arguments.simulation.settings()?);
        let images = arguments.images.unwrap_or(1);
        let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
        let wanted: Vec<Wanted> = sets.iter().map(|&set| Wanted { set, images }).collect();
        for submission in chosen(&arguments.submission)? {
            let sets = measured(&source, &submission, &wanted, threads)?;
            submissions.push(stored(&submission, sets)?);
        }
        source
    } else {
        of_folders(&arguments.measured, threads, &mut submissions)?
    };
    let baseline = Baseline {
        version: crate::VERSION.into(),
        source,
        history: Vec::new(),
        submissions,
    };
    baseline.write(&path)?;
    tell(format_args!("recorded {}", path.display()));
    Ok(())
}

/// The submissions called `names`, or all named ones.
fn chosen(names: &[String]) -> anyhow::Result<Vec<Submission>> {
    let registry = Registry::embedded()?;
    let names = if names.is_empty() {
        registry.names()
    } else {
        names
    };
    names
        .iter()
        .map(|name| Ok(registry.get(name)?.submission))
        .collect()
}

/// Takes the figures of folders of catalogues; the source that all of them have.
fn of_folders(
    folders: &[PathBuf],
    threads: usize,
    submissions: &mut Vec<BaselineSubmission>,
) -> anyhow::Result<Source> {
    let mut first: Option<Source> = None;
    for folder in folders {
        let run = Run::require(folder)?;
        let source = first.get_or_insert_with(|| run.source.clone());
        anyhow::ensure!(
            *source == run.source,
            "{}: it was measured from {}, the first from {source}; a baseline has one source",
            folder.display(),
            run.source,
        );
        let sets = figures_of(&run, &run.source.data(folder)?, folder, threads)?;
        for set in &sets {
            anyhow::ensure!(
                set.images.iter().copied().eq(1..=set.images.len() as u32),
                "{}: set {} has images {:?}; a baseline can be measured again from images 1 to N",
                folder.display(),
                set.set,
                set.images
            );
        }
        submissions.push(stored(&run.submission, sets)?);
    }
    first.context("--measured names no folder")
}

fn stored(submission: &Submission, sets: Vec<BaselineSet>) -> anyhow::Result<BaselineSubmission> {
    Ok(BaselineSubmission {
        name: submission.name.clone(),
        settings: toml::Table::try_from(submission)?,
        sets,
    })
}

/// Measures with a progress bar.
fn measured(
    source: &Source,
    submission: &Submission,
    wanted: &[Wanted],
    threads: usize,
) -> anyhow::Result<Vec<BaselineSet>> {
    let images: u64 = wanted.iter().map(|w| u64::from(w.images)).sum();
    let side = match source {
        Source::Simulated(settings) => settings.grid,
        // The challenge's; a folder's grid is only known when its images are opened.
        Source::Folder { .. } => 100,
    };
    let mut bar = Bar::new("measuring", images * (side as u64).pow(2));
    Ok(measure(source, submission, wanted, threads, &mut bar)?)
}

fn check(arguments: &CheckArguments) -> anyhow::Result<()> {
    let folder = &arguments.place.folder;
    let names = if arguments.names.is_empty() {
        Baseline::names(folder)?
    } else {
        arguments.names.clone()
    };
    anyhow::ensure!(
        !names.is_empty(),
        "{}: there is no baseline here; `baseline record` makes one",
        folder.display()
    );
    let mut checks = Vec::new();
    for name in &names {
        let path = Baseline::path(folder, name);
        checks.extend(check_one(arguments, name, &path)?);
    }
    if let Some(path) = &arguments.junit {
        atomic::write(path, junit(&checks).as_bytes())?;
    }
    let all = matches!(arguments.form.format, TableFormat::Csv | TableFormat::Json);
    let table = shift_table(&checks, all);
    if table.rows.is_empty() && arguments.form.format == TableFormat::Table {
        print(&(table.notes.join("\n") + "\n"))?;
    } else {
        arguments.form.print(&table)?;
    }
    let failed = checks.iter().filter(|check| check.failed()).count();
    anyhow::ensure!(
        failed == 0 || arguments.update,
        "{failed} of {} submissions moved from their baseline",
        checks.len()
    );
    Ok(())
}

/// The stored settings; those that the baseline does not know are the base's.
fn with_defaults(stored: &toml::Table, base: &Submission) -> anyhow::Result<Submission> {
    let mut all = toml::Table::try_from(base)?;
    for (key, value) in stored {
        match (all.get_mut(key), value) {
            (Some(toml::Value::Table(section)), toml::Value::Table(own)) => {
                section.extend(own.clone());
            }
            _ => {
                all.insert(key.clone(), value.clone());
            }
        }
    }
    Ok(all.try_into()?)
}

/// Measures one baseline again, and updates it where that is asked for.
fn check_one(arguments: &CheckArguments, name: &str, path: &Path) -> anyhow::Result<Vec<Checked>> {
    let baseline = Baseline::read(path)?;
    let source = match &arguments.data {
        Some(data) => Source::folder(&DataFolder::open(data)?),
        None => baseline.source.clone(),
    };
    let registry = Registry::embedded()?;
    let mut checks = Vec::new();
    let mut submissions = Vec::new();
    for before in &baseline.submissions {
        let submission = if registry.names().contains(&before.name) {
            registry.get(&before.name)?.submission
        } else {
            let base = registry.get(BASE)?.submission;
            with_defaults(&before.settings, &base)
                .with_context(|| format!("{}: settings of {}", path.display(), before.name))?
        };
        let mut check = Checked {
            baseline: name.to_owned(),
            submission: before.name.clone(),
            shifts: Vec::new(),
            settings: Vec::new(),
            notes: Vec::new(),
        };
        let (moved, new) = settings_moved(before, &submission)
            .map_err(|message| anyhow::anyhow!("{}: {message}", path.display()))?;
        check.settings = moved;
        check
            .notes
            .extend(new.iter().map(|line| format!("a setting is new: {line}")));
        let wanted: Vec<Wanted> = before
            .sets
            .iter()
            .map(|set| Wanted {
                set: set.set,
                images: set.images.len() as u32,
            })
            .collect();
        let sets = measured(&source, &submission, &wanted, arguments.threads.number())?;
        for old in &before.sets {
            let Some(now) = sets.iter().find(|now| now.set == old.set) else {
                bail!("{}: set {} was not measured again", path.display(), old.set);
            };
            if now.data != old.data || now.images != old.images {
                check.notes.push(format!(
                    "the data of set {} are not the baseline's ({} images then, {} now); its figures may differ by {} σ",
                    old.set,
                    old.images.len(),
                    now.images.len(),
                    arguments.sigma
                ));
            }
            check.shifts.extend(shifts(old, now, arguments.sigma));
        }
        submissions.push(stored(&submission, sets)?);
        checks.push(check);
    }
    let moved: Vec<String> = checks.iter().flat_map(Checked::moved).collect();
    if let (true, Some(reason)) = (arguments.update, &arguments.reason) {
        if moved.is_empty() && checks.iter().all(|check| check.notes.is_empty()) {
            tell(format_args!(
                "{}: nothing moved; it stays as it is",
                path.display()
            ));
        } else {
            let mut history = baseline.history;
            history.push(Change {
                reason: reason.clone(),
                from_version: baseline.version,
                moved,
            });
            let updated = Baseline {
                version: crate::VERSION.into(),
                source,
                history,
                submissions,
            };
            updated.write(path)?;
            tell(format_args!("updated {}", path.display()));
        }
    }
    Ok(checks)
}

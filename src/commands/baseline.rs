//! `shearq baseline`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{ArgGroup, Args, Subcommand};
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{Form, SetList, SimulationArguments, Threads, given_once, positive};
use crate::progress::Bar;
use crate::{print, tell};
use shearq_files::atomic;
use shearq_pipeline::data::pattern::MAX_IMAGE;
use shearq_pipeline::data::run::{Run, Source, open_data, way};
use shearq_render::table::TableFormat;
use shearq_results::baseline::{
    self, Baseline, BaselineConfiguration, BaselineSet, Change, Checked, Settings, Wanted, measure,
    metrics_of,
};
use shearq_results::views::baseline::{junit, shift_table};

/// Keep metrics as baselines, and see later whether they moved.
///
/// A baseline is a TOML file that holds the scores with errors per set, the scatter of the
/// ellipticities, and everything that made them: settings, data, seed, version.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(
        after_help = "Examples:\n  shearq baseline record mine --measured raw den\n  shearq baseline record mine --simulate --sets 2,8 --images 4 --submission own.toml"
    )]
    Record(RecordArguments),
    #[command(
        after_help = "Examples:\n  shearq baseline check mine\n  shearq baseline check mine --update --reason \"new window\""
    )]
    Check(CheckArguments),
}

/// Store metrics as a new baseline.
///
/// Of folders that `measure` or `run` wrote (--measured), of a data folder (--data), or of sets simulated
/// for it (--simulate).
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("input").required(true).args(["measured", "data", "simulate"]))]
struct RecordArguments {
    /// Name of the baseline; it must be new.
    #[arg(value_name = "NAME", value_parser = file_stem)]
    name: String,
    /// Folders of catalogues, of the same data.
    #[arg(long, value_name = "OUT", num_args = 1.., conflicts_with_all = ["submission", "sets", "images"])]
    measured: Vec<PathBuf>,
    /// Data folder to measure, now and at each check.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Simulate the data in memory, now and at each check.
    #[arg(long, requires_all = ["sets", "images"])]
    simulate: bool,
    /// Submission to measure, by name or file; may be given several times [default: all that
    /// `submissions list` shows].
    #[arg(long, value_name = "NAME|FILE")]
    submission: Vec<String>,
    /// Sets to measure, as `1,2,7-9` or `all` [default with --data: all there are].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Images per set to measure, from the first on [default with --data: all there are].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
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
/// Named submissions and configuration files are measured with their present settings, and settings that
/// changed are listed. A file is known if `record` measured it (--submission FILE); catalogues (--measured)
/// have the settings stored. On the same data a metric must be the same but for rounding; on other data (--data) within noise. Q, M/2, √A
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
    /// Measure with the settings stored in the baseline, not with those of your configuration files.
    #[arg(long)]
    stored: bool,
    /// Standard errors by which a metric may be off on other data than the baseline's.
    #[arg(long, value_name = "K", default_value_t = 3.0, value_parser = positive)]
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

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::Record(arguments) => record(arguments),
        Command::Check(arguments) => check(arguments),
    }
}

fn record(arguments: &RecordArguments) -> anyhow::Result<()> {
    let folder = &arguments.place.folder;
    let path = Baseline::path(folder, &arguments.name);
    // Before the work; whoever is first in the end is known then.
    if path.exists() {
        return Err(Baseline::exists(&path).into());
    }
    let threads = arguments.threads.number();
    let (source, submissions) = match &arguments.data {
        None if arguments.simulate => {
            let images = arguments.images.unwrap_or(1);
            let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
            let wanted = sets.iter().map(|&set| Wanted { set, images }).collect();
            let source = Source::Simulated(arguments.simulation.settings()?);
            of_source(arguments, source, wanted)?
        }
        None => {
            arguments.simulation.must_be_unused()?;
            of_folders(&arguments.measured, folder, threads)?
        }
        Some(data) => {
            arguments.simulation.must_be_unused()?;
            let data = open_data(data)?;
            let sets = arguments.sets.as_ref().map_or(&[][..], |list| &list.0);
            let files = data.images(sets)?;
            let there = |set| files.of_set(set).len() as u32;
            let wanted = |set| Wanted {
                set,
                images: arguments.images.unwrap_or_else(|| there(set)),
            };
            let all = files.wanted(sets).into_iter().map(wanted).collect();
            of_source(arguments, Source::folder(&data, folder)?, all)?
        }
    };
    for set in submissions.iter().flat_map(|submission| &submission.sets) {
        anyhow::ensure!(
            set.images.iter().copied().eq(1..=set.images.len() as u32),
            "set {} has images {:?}; a baseline can be measured again from images 1 to N",
            set.set,
            set.images
        );
    }
    Baseline::new(source, Vec::new(), submissions).create(&path)?;
    tell(format_args!("recorded {}", path.display()));
    Ok(())
}

/// Measures the submissions asked for.
fn of_source(
    arguments: &RecordArguments,
    source: Source,
    wanted: Vec<Wanted>,
) -> anyhow::Result<(Source, Vec<BaselineConfiguration>)> {
    let (folder, threads) = (&arguments.place.folder, arguments.threads.number());
    let submissions = chosen(&arguments.submission, folder)?
        .into_iter()
        .map(|(submission, file)| {
            let sets = measured(&source, folder, &submission, &wanted, threads)?;
            Ok(BaselineConfiguration::new(&submission, file, sets)?)
        })
        .collect::<anyhow::Result<_>>()?;
    Ok((source, submissions))
}

/// The submissions called `names`, or all named ones, with their files from the folder `beside`.
fn chosen(
    names: &[String],
    beside: &Path,
) -> anyhow::Result<Vec<(Configuration, Option<PathBuf>)>> {
    given_once(names)?;
    let registry = Registry::embedded()?;
    let names = if names.is_empty() {
        registry.names()
    } else {
        names
    };
    names
        .iter()
        .map(|name| {
            let path = Path::new(name);
            let file = (!registry.names().contains(name) && path.is_file())
                .then(|| way(beside, path))
                .transpose()?;
            Ok((registry.get(name)?.configuration, file))
        })
        .collect()
}

/// Takes the metrics of folders of catalogues, and the source that all of them have, for a record in the
/// folder `beside`.
fn of_folders(
    folders: &[PathBuf],
    beside: &Path,
    threads: usize,
) -> anyhow::Result<(Source, Vec<BaselineConfiguration>)> {
    let mut first: Option<Source> = None;
    let mut submissions = Vec::new();
    for folder in folders {
        let run = Run::require(folder)?;
        let own = run.source.moved(folder, beside)?;
        let source = first.get_or_insert_with(|| own.clone());
        anyhow::ensure!(
            *source == own,
            "{}: it was measured from {own}, the first from {source}; a baseline has one source",
            folder.display(),
        );
        let sets = metrics_of(&run, &run.source.data(folder)?, folder, threads)?;
        submissions.push(BaselineConfiguration::new(&run.configuration, None, sets)?);
    }
    Ok((first.context("--measured names no folder")?, submissions))
}

/// Measures with a progress bar.
fn measured(
    source: &Source,
    beside: &Path,
    submission: &Configuration,
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
    Ok(measure(
        source, beside, submission, wanted, threads, &mut bar,
    )?)
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

/// Measures one baseline again, and updates it where that is asked for.
fn check_one(arguments: &CheckArguments, name: &str, path: &Path) -> anyhow::Result<Vec<Checked>> {
    let baseline = Baseline::read(path)?;
    let beside = &arguments.place.folder;
    let source = match &arguments.data {
        Some(data) => Source::folder(&open_data(data)?, beside)?,
        None => baseline.source.clone(),
    };
    let threads = arguments.threads.number();
    let measure = |submission: &Configuration, wanted: &[Wanted]| {
        measured(&source, beside, submission, wanted, threads)
    };
    let settings = match arguments.stored {
        true => Settings::Stored,
        false => Settings::Files(beside),
    };
    let (checks, submissions) =
        baseline::check(name, &baseline, arguments.sigma, settings, measure)
            .with_context(|| path.display().to_string())?;
    for check in checks.iter().filter(|check| check.stored) {
        tell(format_args!(
            "{}: {}: measured with the stored settings; the baseline does not name a configuration file",
            path.display(),
            check.configuration
        ));
    }
    let moved: Vec<String> = checks.iter().flat_map(Checked::moved).collect();
    if let (true, Some(reason)) = (arguments.update, &arguments.reason) {
        if moved.is_empty() && checks.iter().all(|check| check.notes.is_empty()) {
            tell(format_args!(
                "{}: nothing moved; it stays as it is",
                path.display()
            ));
        } else {
            let mut history = baseline.history.clone();
            history.push(Change {
                reason: reason.clone(),
                from_version: baseline.version.clone(),
                moved,
            });
            Baseline::new(source, history, submissions).replace(path, &baseline)?;
            tell(format_args!("updated {}", path.display()));
        }
    }
    Ok(checks)
}

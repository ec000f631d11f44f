use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{ArgGroup, Args, Subcommand};
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{
    Form, SetList, SimulationArguments, Threads, given_once, positive, sets_of,
};
use crate::progress::Bar;
use crate::{print, tell};
use shearq_dataset::images::{self, ImageId};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_dataset::run::{Run, Source, open_data, relative_path};
use shearq_files::atomic::Scratch;
use shearq_files::table::FileFormat;
use shearq_pipeline::measure::FolderMeasurement;
use shearq_pipeline::run::run_folder;
use shearq_render::table::TableFormat;
use shearq_results::baseline::{
    self, Baseline, BaselineConfiguration, BaselineSet, Change, Checked, metrics_of, shift_table,
};

/// Store metrics as a baseline and check later whether they moved.
///
/// A baseline is a TOML file. It contains the metrics of each set with errors, the scatter of the ellipticities,
/// and what they were measured with: settings, data, seed and version.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(
        after_help = "Examples:\n  shearq baseline record mine --data data --submission 48/linear/star\n  shearq baseline record mine --simulate --sets 2,8 --images 4 --submission own.toml"
    )]
    Record(RecordArguments),
    #[command(
        after_help = "Examples:\n  shearq baseline check mine\n  shearq baseline check mine --update --reason \"new window\""
    )]
    Check(CheckArguments),
}

/// Store metrics as a new baseline.
///
/// The metrics are measured on a data folder (--data) or on simulated sets (--simulate).
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("input").required(true).args(["data", "simulate"]))]
struct RecordArguments {
    /// Name of the baseline; it must be new.
    #[arg(value_name = "NAME", value_parser = file_stem)]
    name: String,
    /// Data folder to measure, now and in each check.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Simulate the data in memory, now and in each check.
    #[arg(long, requires_all = ["sets", "images"])]
    simulate: bool,
    /// Configuration: a name from `shearq submissions list` or a TOML file. May be given several times
    /// [default: all in the list].
    #[arg(long, value_name = "NAME|FILE")]
    submission: Vec<String>,
    /// Sets, such as `1,2,7-9` or `all` [default with --data: all sets of the folder].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Images per set, counted from the first [default with --data: all images of the folder].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    #[command(flatten)]
    simulation: SimulationArguments,
    #[command(flatten)]
    place: Place,
    #[command(flatten)]
    threads: Threads,
}

/// Measure baselines again and compare the metrics.
///
/// Each configuration is measured with its present settings, and changed settings are listed.
///
/// Compared are Q, M/2, √A and the scatter of e1 and e2. On the same data they must agree up to rounding, on other
/// data (--data) within the noise. CSV and JSON list every metric, the other formats the moved ones.
///
/// Exit code 0: all agree; 1: a metric or a setting moved.
#[derive(Debug, Args)]
struct CheckArguments {
    /// Names of the baselines [default: all in the folder].
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Data folder to measure instead of the recorded one.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Largest accepted shift on other data, in standard errors.
    #[arg(long, value_name = "K", default_value_t = 3.0, value_parser = positive)]
    sigma: f64,
    /// Replace the baseline if anything moved. It keeps the reason and a list of changes.
    #[arg(long, requires = "reason")]
    update: bool,
    /// Why the baseline changes.
    #[arg(long, value_name = "TEXT", requires = "update")]
    reason: Option<String>,
    #[command(flatten)]
    place: Place,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

/// The folder of the baselines.
#[derive(Debug, Args)]
struct Place {
    /// Folder of the baselines.
    #[arg(long, value_name = "DIR", default_value = "submissions/baselines")]
    folder: PathBuf,
}

// The name becomes a file name, on any operating system.
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
    // Checked before the work, and again when the file is made.
    if path.exists() {
        return Err(Baseline::exists(&path).into());
    }
    let sets = sets_of(arguments.sets.as_ref());
    let (source, images) = match &arguments.data {
        None => {
            let simulated = arguments.sets.as_ref().map(SetList::simulated);
            let sets = simulated.transpose()?.unwrap_or_default();
            let images = images::of_simulation(&sets, arguments.images.unwrap_or(1));
            (Source::Simulated(arguments.simulation.settings()?), images)
        }
        Some(data) => {
            arguments.simulation.must_be_unused()?;
            let data = open_data(data)?;
            let mut images = images::of_folder(&data, sets)?;
            images.retain(|id| arguments.images.is_none_or(|most| id.image <= most));
            (Source::folder(&data, folder)?, images)
        }
    };
    let threads = arguments.threads.number();
    let configurations: Vec<BaselineConfiguration> = chosen(&arguments.submission, folder)?
        .into_iter()
        .map(|(configuration, file)| {
            let sets = measured(&source, folder, &configuration, &images, threads)?;
            Ok(BaselineConfiguration::new(&configuration, file, sets)?)
        })
        .collect::<anyhow::Result<_>>()?;
    for set in configurations
        .iter()
        .flat_map(|configuration| &configuration.sets)
    {
        anyhow::ensure!(
            set.images.iter().copied().eq(1..=set.images.len() as u32),
            "set {}: a baseline needs consecutive images (found {:?}, expected 1 to N)",
            set.set,
            set.images
        );
    }
    Baseline::new(source, Vec::new(), configurations).create(&path)?;
    tell(format_args!("recorded {}", path.display()));
    Ok(())
}

// With the paths of users' settings files relative to the folder `beside`, so that a repository with both can be cloned anywhere.
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
                .then(|| relative_path(beside, path))
                .transpose()?;
            Ok((registry.get(name)?.configuration, file))
        })
        .collect()
}

// Into a temporary folder: only the metrics are kept. Paths of `source` are relative to the folder `beside`.
fn measured(
    source: &Source,
    beside: &Path,
    configuration: &Configuration,
    images: &[ImageId],
    threads: usize,
) -> anyhow::Result<Vec<BaselineSet>> {
    let scratch = Scratch::new()?;
    let out = scratch.path();
    let run = Run::new(
        source.moved(beside, out)?,
        configuration.clone(),
        FileFormat::default(),
    );
    let bar = |grid: usize| Bar::new("measuring", (images.len() * grid.pow(2)) as u64);
    let data = match source {
        Source::Simulated(settings) => {
            let mut bar = bar(settings.grid);
            run_folder(&run, *settings, images, out, threads, &mut bar)?;
            run.source.data(out)?
        }
        Source::Folder { .. } => {
            // By the path that the user gave, because messages must not name the temporary folder.
            let data = source.data(beside)?;
            let mut sets: Vec<u32> = images.iter().map(|id| id.set).collect();
            sets.dedup();
            // Other data may have fewer images.
            let mut there = run.images(&data, &sets)?;
            there.retain(|id| images.contains(id));
            // An estimate: the grid of a folder is unknown until its images are opened.
            FolderMeasurement::open(&run, &data, out, &there)?
                .write_catalogues(threads, &mut bar(100))?;
            data
        }
    };
    Ok(metrics_of(&run, &data, out, threads)?)
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
        "{}: found no baseline in this folder. Try: shearq baseline record NAME",
        folder.display()
    );
    let mut checks = Vec::new();
    for name in &names {
        let path = Baseline::path(folder, name);
        checks.extend(check_one(arguments, name, &path)?);
    }
    // Programs compare every metric; people want to see those that moved.
    let all = matches!(arguments.form.format, TableFormat::Csv | TableFormat::Json);
    let table = shift_table(&checks, all);
    // A table without rows would show headings only.
    if table.rows.is_empty() && arguments.form.format == TableFormat::Table {
        print(&(table.notes.join("\n") + "\n"))?;
    } else {
        arguments.form.print(&table)?;
    }
    let failed = checks
        .iter()
        .filter(|check| !check.moved().is_empty())
        .count();
    anyhow::ensure!(
        // An update accepts the moved metrics.
        failed == 0 || arguments.update,
        "{failed} of {} configurations moved from their baseline",
        checks.len()
    );
    Ok(())
}

fn check_one(arguments: &CheckArguments, name: &str, path: &Path) -> anyhow::Result<Vec<Checked>> {
    let baseline = Baseline::read(path)?;
    let beside = &arguments.place.folder;
    let source = match &arguments.data {
        Some(data) => Source::folder(&open_data(data)?, beside)?,
        None => baseline.source.clone(),
    };
    let threads = arguments.threads.number();
    let measure = |configuration: &Configuration, images: &[ImageId]| {
        measured(&source, beside, configuration, images, threads)
    };
    let (checks, configurations) =
        baseline::check(name, &baseline, arguments.sigma, beside, measure)
            .with_context(|| path.display().to_string())?;
    let moved: Vec<String> = checks.iter().flat_map(Checked::moved).collect();
    if let (true, Some(reason)) = (arguments.update, &arguments.reason) {
        if moved.is_empty() && checks.iter().all(|check| check.notes.is_empty()) {
            tell(format_args!(
                "{}: unchanged, because nothing moved",
                path.display()
            ));
        } else {
            let mut history = baseline.history.clone();
            history.push(Change {
                reason: reason.clone(),
                from_version: baseline.version.clone(),
                moved,
            });
            Baseline::new(source, history, configurations).replace(path)?;
            tell(format_args!("updated {}", path.display()));
        }
    }
    Ok(checks)
}

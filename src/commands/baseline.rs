use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::{ArgGroup, Args, Subcommand};
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{Form, SetList, SimulationArguments, Threads, given_once, sets_of};
use crate::commands::{bias, score};
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
use shearq_results::baseline::catalogues::{CatalogueBaseline, CatalogueError, Tolerance, Units};
use shearq_results::baseline::{
    self, Baseline, BaselineConfiguration, BaselineSet, Checked, metrics_of, shift_table,
};

/// Store metrics as a baseline and check later whether they moved.
///
/// A baseline is a TOML file, of configurations of shearq or of catalogues of any code. It contains metrics with errors, and what
/// they were measured with: settings, data and seed, or a command with its tolerance. docs/regression.md has a workflow for CI.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(
        override_usage = "shearq baseline record [OPTIONS] <NAME> <--data <DIR>|--simulate|-- COMMAND>",
        after_help = "Examples:\n  shearq baseline record mine --data data --submission 48/linear/star\n  shearq baseline record mine --simulate --sets 2,8 --images 4 --submission own.toml\n  shearq baseline record mycode -- bias plus.csv minus.csv\n  shearq baseline record mycode -- score --data data --foreign mycode.toml"
    )]
    Record(RecordArguments),
    #[command(
        after_help = "Examples:\n  shearq baseline check mine\n  shearq baseline check mine --update\n  shearq baseline check mycode --format markdown"
    )]
    Check(CheckArguments),
}

/// Store metrics as a new baseline.
///
/// The metrics are measured by configurations of shearq on a data folder (--data) or on simulated sets (--simulate), or those of
/// any code's catalogues, as `score` or `bias` with its arguments prints them.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("input").required(true).args(["data", "simulate", "command"]))]
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
    /// `score` or `bias` with its arguments: catalogues of any code with their true shear, or of paired shears. A check repeats it
    /// from the folder in which it is started.
    #[arg(last = true, value_name = "COMMAND", conflicts_with_all = ["submission", "sets", "images"])]
    command: Vec<String>,
    /// Largest accepted change of the metrics of catalogues: `sigma=3` standard errors of the paired difference, or `m=5e-4`, `c=5e-5`,
    /// `alpha=1e-3` or `relative=0.01` of other metrics, whichever is larger. May be given several times.
    #[arg(long, value_name = "NAME=NUMBER", requires = "command")]
    tolerance: Vec<String>,
    #[command(flatten)]
    place: Place,
    #[command(flatten)]
    threads: Threads,
}

/// Measure baselines again and compare the metrics.
///
/// Each configuration is measured with its present settings, and changed settings are listed. Compared are Q, Q calibrated, M/2,
/// √A, m (cross), the noise and the scatter of e1 and e2, which must agree up to rounding.
///
/// For catalogues of any code, the command of the baseline is repeated: their metrics may differ within the baseline's tolerance.
/// Differences are paired by images or galaxies, so that small changes exceed their errors.
///
/// CSV, JSON and Markdown list every metric, the other formats the moved ones.
///
/// Exit code 0: all agree; 1: a metric or a setting moved, or cannot be compared; 2: wrong usage.
#[derive(Debug, Args)]
struct CheckArguments {
    /// Names of the baselines [default: all in the folder].
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Replace the baseline if anything moved.
    #[arg(long)]
    update: bool,
    /// `score` or `bias` with its arguments, instead of those that the baseline states: the same galaxies in other files.
    #[arg(last = true, value_name = "COMMAND", requires = "names")]
    command: Vec<String>,
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

// The commands whose metrics a baseline of catalogues has.
pub(crate) const COMMANDS: [&str; 2] = ["score", "bias"];

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
    if !arguments.command.is_empty() {
        arguments.simulation.must_be_unused()?;
        let mut tolerance = Tolerance::default();
        for text in &arguments.tolerance {
            tolerance
                .set(text)
                .map_err(|message| anyhow!("--tolerance: {message}"))?;
        }
        let (units, catalogues) = units_of(&arguments.command)?;
        CatalogueBaseline::write(
            &path,
            &arguments.command,
            tolerance,
            &units,
            &catalogues,
            false,
        )?;
        tell(format_args!("recorded {}", path.display()));
        return Ok(());
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
    Baseline::new(source, configurations).create(&path)?;
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
    let data = match source {
        Source::Simulated(settings) => {
            let galaxies = images.len() * settings.grid.pow(2);
            let mut bar = Bar::new("measuring", galaxies as u64);
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
            let work = FolderMeasurement::open(&run, &data, out, &there)?;
            let mut bar = Bar::new("measuring", work.galaxies());
            work.write_catalogues(threads, &mut bar)?;
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
    anyhow::ensure!(
        arguments.command.is_empty() || names.len() == 1,
        "--: found {} baselines, expected one for a command",
        names.len()
    );
    let mut checks = Vec::new();
    for name in &names {
        let path = Baseline::path(folder, name);
        checks.extend(check_one(arguments, name, &path)?);
    }
    // Programs compare every metric; people want to see those that moved.
    let all = matches!(
        arguments.form.format,
        TableFormat::Csv | TableFormat::Json | TableFormat::Markdown
    );
    let table = shift_table(&checks, all);
    // A table without rows would show headings only.
    if table.rows.is_empty() && arguments.form.format == TableFormat::Table {
        print(&(table.notes.join("\n") + "\n"))?;
    } else {
        arguments.form.print(&table)?;
    }
    let failed = checks.iter().filter(|check| check.has_moved()).count();
    anyhow::ensure!(
        // An update accepts the moved metrics.
        failed == 0 || arguments.update,
        "{failed} of {} configurations moved from their baseline",
        checks.len()
    );
    Ok(())
}

fn check_one(arguments: &CheckArguments, name: &str, path: &Path) -> anyhow::Result<Vec<Checked>> {
    if let Some(found) = CatalogueBaseline::read(path)? {
        return Ok(vec![check_catalogues(arguments, name, path, found)?]);
    }
    anyhow::ensure!(
        arguments.command.is_empty(),
        "{}: a baseline of configurations is measured again by its settings. Try: without --",
        path.display()
    );
    let baseline = Baseline::read(path)?;
    let beside = &arguments.place.folder;
    let source = &baseline.source;
    let threads = arguments.threads.number();
    let measure = |configuration: &Configuration, images: &[ImageId]| {
        measured(source, beside, configuration, images, threads)
    };
    let (checks, configurations) =
        baseline::check(name, &baseline, arguments.update, beside, measure)
            .with_context(|| path.display().to_string())?;
    let changed = |check: &Checked| check.has_moved() || !check.notes.is_empty();
    updated(arguments, path, checks.iter().any(changed), || {
        Ok(Baseline::new(baseline.source.clone(), configurations).replace(path)?)
    })?;
    Ok(checks)
}

fn check_catalogues(
    arguments: &CheckArguments,
    name: &str,
    path: &Path,
    (baseline, before): (CatalogueBaseline, Units),
) -> anyhow::Result<Checked> {
    let command = match arguments.command.as_slice() {
        [] => &baseline.command,
        given => given,
    };
    let (now, catalogues) = units_of(command).with_context(|| path.display().to_string())?;
    let write = || {
        let tolerance = baseline.tolerance;
        CatalogueBaseline::write(path, command, tolerance, &now, &catalogues, true)?;
        Ok(())
    };
    let checked = match baseline.check(name, &before, &now) {
        // Nothing to compare, but what a new baseline is recorded for.
        Err(CatalogueError::OtherGalaxies { .. }) if arguments.update => {
            updated(arguments, path, true, write)?;
            return Ok(baseline.check(name, &now, &now)?);
        }
        checked => checked.with_context(|| path.display().to_string())?,
    };
    updated(arguments, path, checked.has_moved(), write)?;
    Ok(checked)
}

// With --update, replaces a baseline from which anything moved.
fn updated(
    arguments: &CheckArguments,
    path: &Path,
    moved: bool,
    replace: impl FnOnce() -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    match (arguments.update, moved) {
        (false, _) => {}
        (true, false) => tell(format_args!(
            "{}: unchanged, because nothing moved",
            path.display()
        )),
        (true, true) => {
            replace()?;
            tell(format_args!("updated {}", path.display()));
        }
    }
    Ok(())
}

// What `score` or `bias` measures with these arguments, and the catalogues that it reads.
fn units_of(command: &[String]) -> anyhow::Result<(Units, Vec<PathBuf>)> {
    let expected = || {
        anyhow!(
            "--: found `{}`, expected `score` or `bias` with its arguments",
            command.join(" ")
        )
    };
    // Before other commands are parsed, whose messages would not say that they have no baselines.
    if !command
        .first()
        .is_some_and(|own| COMMANDS.contains(&own.as_str()))
    {
        return Err(expected());
    }
    match crate::parse(command)? {
        crate::Command::Score(arguments) => score::units(&arguments),
        crate::Command::Bias(arguments) => bias::units(&arguments),
        _ => Err(expected()),
    }
}

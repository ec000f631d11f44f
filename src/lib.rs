//! The command line: one file per subcommand in `commands`. Exit codes: 0 done, 1 failed, 2 wrong usage. A closed pipe
//! (`| head`) is not an error: the command still writes its files.

#[cfg(doctest)]
#[doc = include_str!("../docs/architecture.md")]
struct GuideToTheCrates;

mod arguments;
mod origin;
mod progress;
#[cfg(test)]
mod tests;

// One file per command.
mod commands {
    pub(crate) mod baseline;
    pub(crate) mod bench;
    pub(crate) mod bias;
    pub(crate) mod challenge;
    pub(crate) mod check;
    pub(crate) mod compare;
    pub(crate) mod completions;
    pub(crate) mod detect;
    pub(crate) mod gather;
    pub(crate) mod man;
    pub(crate) mod mean;
    pub(crate) mod measure;
    pub(crate) mod merge;
    pub(crate) mod pack;
    pub(crate) mod quickstart;
    pub(crate) mod reproduce;
    pub(crate) mod run;
    pub(crate) mod score;
    pub(crate) mod select;
    pub(crate) mod shear;
    pub(crate) mod show;
    pub(crate) mod simulate;
    pub(crate) mod submissions;
    pub(crate) mod unpack;
}

/// Figures and tables of the paper, for `reproduce`.
mod paper {
    pub(crate) mod lambda;
    pub(crate) mod sets;
}

use std::any::TypeId;
use std::ffi::OsString;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, CommandFactory, FromArgMatches, Parser, Subcommand};

use arguments::StandardInput;
use commands::{
    baseline, bench, bias, challenge, check, compare, completions, detect, gather, man, mean,
    measure, merge, pack, quickstart, reproduce, run, score, select, shear, show, simulate,
    submissions, unpack,
};
use shearq_files::panic_is_caught;
use shearq_render::escape::visible;
use shearq_render::table::Table;
use shearq_render::terminal::fitted;

/// m and c of weak-lensing shear catalogues, galaxy shapes with their shear responses, and scores of challenges.
///
/// Start with `shearq quickstart`, which needs no data. `shearq bias` gives m and c of catalogues of any program. To measure
/// and score shapes, work in steps:
///
/// 1. `gather` makes a data folder from your stamps and PSFs. `simulate` makes a folder of simulated data.
///
/// 2. `measure` writes a catalogue of ellipticities and responses to shear per image. `detect` does so for an exposure, without
///    `gather`, with the response of its detection.
///
/// 3. `mean` prints the shear of a set with one shear. `shear` writes a shear per galaxy. `score` compares catalogues with a known shear field.
///
/// 4. `compare` shows several configurations side by side. `pack` and `check` prepare a submission to a challenge.
///
/// 5. `challenge` runs a challenge: blind data, entries, a leaderboard.
///
/// `run` measures and scores in one step. `merge` completes a run that was split over a cluster.
/// A configuration is a named list of settings of the method: see `shearq submissions list`.
#[derive(Debug, Parser)]
#[command(name = "shearq", version = version_and_commit(), propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    talk: Talk,
}

// What is said on standard error.
#[derive(Debug, clap::Args)]
struct Talk {
    /// Print warnings and errors only: no notes and no progress.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
    /// Print version and command at the start, and time and memory at the end.
    #[arg(short, long, global = true)]
    verbose: bool,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    #[command(after_help = "Example:\n  shearq quickstart --out first")]
    Quickstart(quickstart::Arguments),
    #[command(
        after_help = "Examples:\n  shearq simulate --sets 1,2,7-9 --images 10 --seed 1 --out data\n  shearq simulate --scenes 20 --side 1500 --border 60 --density 75 --opposite --out scenes\n  shearq simulate --challenge great3 --branch control-ground-constant --subfields 20 --out branch"
    )]
    Simulate(simulate::Arguments),
    #[command(
        after_help = "Examples:\n  shearq gather --stamps cube.fits --psf star.fits --out data\n  shearq gather --exposure field.fits --positions galaxies.csv --psf stars.fits --out data"
    )]
    Gather(gather::Arguments),
    #[command(
        after_help = "Example:\n  shearq measure --submission 48/linear/star --data data --out linear"
    )]
    Measure(measure::Arguments),
    #[command(
        after_help = "Example:\n  shearq detect --exposure field.fits --psf star.fits --noise 4.1 --out field"
    )]
    Detect(detect::Arguments),
    #[command(
        after_help = "Example:\n  shearq run --simulate --sets all --images 200 --submission 48/linear/star --out run"
    )]
    Run(run::Arguments),
    #[command(after_help = "Example:\n  shearq merge run --sets all --images 200 --shards 8")]
    Merge(merge::Arguments),
    #[command(
        mut_arg("unsheared", mean::of_folders),
        mut_arg("threads", mean::of_folders),
        after_help = "Examples:\n  shearq mean --measured linear\n  shearq mean metacal.fits --step 0.01"
    )]
    Mean(mean::Arguments),
    #[command(
        after_help = "Example:\n  shearq select --measured linear --where 'step(snr, 10) and step(size, 2.5)' --out bright"
    )]
    Select(select::Arguments),
    #[command(
        after_help = "Examples:\n  shearq shear --measured linear --out shears.parquet\n  shearq shear --measured linear --treecorr --out treecorr.fits"
    )]
    Shear(shear::Arguments),
    #[command(
        after_help = "Examples:\n  shearq score --measured linear --wide\n  shearq score --truth truth.csv catalogue-1.csv catalogue-2.csv"
    )]
    Score(score::Arguments),
    #[command(
        after_help = "Examples:\n  shearq compare raw den linear --format latex\n  shearq compare --store results --where \"snr == 'high' and submission == '23/*'\" --sort q:desc"
    )]
    Compare(compare::Arguments),
    #[command(
        after_help = "Examples:\n  shearq bias --plan 1e-3\n  shearq bias catalogue.fits --bins snr:5\n  shearq bias plus.parquet minus.parquet --truth shears.csv --fail-above m=2e-3@3sigma"
    )]
    Bias(Box<bias::Arguments>),
    #[command(
        after_help = "Examples:\n  shearq baseline record mine --data data --submission 48/linear/star\n  shearq baseline check mine"
    )]
    Baseline(baseline::Arguments),
    #[command(
        after_help = "Example:\n  shearq challenge new --name pilot --sets 2,8 --images 20 --public pilot --private truth"
    )]
    Challenge(challenge::Arguments),
    #[command(after_help = "Example:\n  shearq check to-send.tar.gz --data data")]
    Check(check::Arguments),
    #[command(
        after_help = "Example:\n  shearq pack --measured linear --method MINE --out to-send.tar.gz"
    )]
    Pack(pack::Arguments),
    #[command(after_help = "Example:\n  shearq unpack to-send.tar.gz --out sent")]
    Unpack(unpack::Arguments),
    #[command(
        after_help = "Example:\n  shearq show --submission 48/linear/star --data data --galaxy 7/1/42 --out galaxy.png"
    )]
    Show(show::Arguments),
    #[command(after_help = "Example:\n  shearq reproduce --images 4 --out paper")]
    Reproduce(reproduce::Arguments),
    #[command(after_help = "Example:\n  shearq bench --submission 48/linear/star")]
    Bench(bench::Arguments),
    #[command(
        after_help = "Examples:\n  shearq submissions show 48/linear/star\n  shearq submissions init own.toml"
    )]
    Submissions(submissions::Arguments),
    #[command(
        after_help = "Example:\n  shearq completions bash > ~/.local/share/bash-completion/completions/shearq"
    )]
    Completions(completions::Arguments),
    #[command(after_help = "Example:\n  shearq man --out ~/.local/share/man/man1")]
    Man(man::Arguments),
}

// Exit codes. A baseline that changed and a check with findings exit like errors, so that scripts and CI stop; 2 for wrong
// usage is clap's.
const EXIT_DONE: u8 = 0;
const EXIT_FAILED: u8 = 1;
const EXIT_WRONG_USAGE: u8 = 2;

/// Runs the command that this process was started with.
pub fn main() -> ExitCode {
    // Signals and hooks belong to the whole process, and must be set before there are other threads.
    progress::end_at_interrupt();
    fail_at_size_limits();
    silence_caught_panics();
    ExitCode::from(run_with(std::env::args_os()))
}

/// Prints no message for a panic that is caught and becomes an error, as when a damaged file is decoded.
///
/// For programs and extension modules, to be called once at their start: it replaces the hook of all their panics.
pub fn silence_caught_panics() {
    let others = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !panic_is_caught() {
            others(panic);
        }
    }));
}

// Turns writing beyond a file size limit (`ulimit -f`), which clusters set, into an ordinary error. By default the signal ends
// the process without a message, and temporary files remain.
fn fail_at_size_limits() {
    #[cfg(unix)]
    // SAFETY: ignoring a signal runs none of our code, and no other thread has been started.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
}

/// Parses the arguments (the first is the program's name), runs the command and prints its error, if any.
/// Returns the exit code.
pub fn run_with(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let start = Instant::now();
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let command_line = origin::remember(&arguments);
    let read = match StandardInput::read(&arguments) {
        Ok(read) => read,
        Err(error) => {
            tell(format_args!("error: standard input: {error}"));
            return EXIT_FAILED;
        }
    };
    let cli = match parsed(read.arguments) {
        Ok(cli) => cli,
        Err(message) => return usage(&with_separator(message)),
    };
    // Of each call: Python calls this function many times.
    QUIET.store(cli.talk.quiet, Ordering::Relaxed);
    if cli.talk.verbose {
        tell(format_args!(
            "shearq {}: {command_line}",
            version_and_commit()
        ));
    }
    let result = match cli.command {
        Command::Quickstart(arguments) => quickstart::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Gather(arguments) => gather::run(&arguments),
        Command::Measure(arguments) => measure::run(&arguments),
        Command::Detect(arguments) => detect::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Mean(arguments) => mean::run(&arguments),
        Command::Select(arguments) => select::run(&arguments),
        Command::Shear(arguments) => shear::run(&arguments),
        Command::Merge(arguments) => merge::run(&arguments),
        Command::Score(arguments) => score::run(&arguments),
        Command::Compare(arguments) => compare::run(&arguments),
        Command::Bias(arguments) => bias::run(&arguments, &command_line),
        Command::Baseline(arguments) => baseline::run(&arguments),
        Command::Challenge(arguments) => challenge::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Pack(arguments) => pack::run(&arguments),
        Command::Unpack(arguments) => unpack::run(&arguments),
        Command::Show(arguments) => show::run(&arguments),
        Command::Reproduce(arguments) => reproduce::run(&arguments),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Submissions(arguments) => submissions::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Man(arguments) => man::run(&arguments),
    };
    if cli.talk.verbose {
        tell(format_args!("{}", origin::cost(start)));
    }
    match result {
        Ok(()) => EXIT_DONE,
        Err(error) if error.is::<Findings>() => EXIT_FAILED,
        Err(error) => {
            tell(format_args!("error: {}", causes(&error)));
            EXIT_FAILED
        }
    }
}

/// The program. Options of numbers take negative ones as values, such as -.02, so that an error is about the number.
fn program() -> clap::Command {
    fn with_numbers(command: clap::Command) -> clap::Command {
        let is_number = |own: &Arg| own.get_value_parser().type_id() == TypeId::of::<f64>();
        // Of lists, which end with the next option.
        let is_list = |own: &Arg| own.get_num_args().is_some_and(|own| own.max_values() > 1);
        command
            .mut_args(|own| match (is_number(&own), is_list(&own)) {
                (false, _) => own,
                (true, false) => own.allow_hyphen_values(true),
                (true, true) => own.allow_negative_numbers(true),
            })
            .mut_subcommands(with_numbers)
    }
    with_numbers(Cli::command())
}

fn parsed<T: Into<OsString> + Clone>(
    words: impl IntoIterator<Item = T>,
) -> Result<Cli, clap::Error> {
    let mut matches = program().try_get_matches_from(words)?;
    Cli::from_arg_matches_mut(&mut matches)
}

// A command with its arguments, without the program's name.
fn parse(command: &[String]) -> anyhow::Result<Command> {
    let words = std::iter::once("shearq").chain(command.iter().map(String::as_str));
    let parsed = self::parsed(words).map_err(|error| {
        let text = error.to_string();
        let text = text.strip_prefix("error: ").unwrap_or(&text);
        // Without the usage of the command.
        let text = text.split("\n\n").next().unwrap_or(text);
        anyhow::anyhow!("{}: {text}", command.join(" "))
    })?;
    Ok(parsed.command)
}

// An error with its causes. Messages of some errors end with their cause, which is not repeated.
fn causes(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        if text.is_empty() {
            text = cause;
        } else if !text.ends_with(&cause) {
            text.push_str(": ");
            text.push_str(&cause);
        }
    }
    text
}

// Adds what is missing to `baseline record NAME bias FILE`, of which clap only says that it does not expect `bias`.
fn with_separator(mut message: clap::Error) -> clap::Error {
    let found = match message.get(ContextKind::InvalidArg) {
        Some(ContextValue::String(found)) => found.clone(),
        _ => return message,
    };
    if message.kind() == ErrorKind::UnknownArgument && baseline::COMMANDS.contains(&found.as_str())
    {
        let remedy = format!("a command follows `--`: -- {found}");
        let remedy = ContextValue::StyledStrs(vec![remedy.into()]);
        message.insert(ContextKind::Suggested, remedy);
    }
    message
}

// clap reports help and the version as errors, with exit code 0.
fn usage(message: &clap::Error) -> u8 {
    match flushed(|| message.print()) {
        // 0 for help and the version, 2 for wrong usage.
        Ok(()) => u8::try_from(message.exit_code()).unwrap_or(EXIT_WRONG_USAGE),
        Err(error) => {
            tell(format_args!("error: {}", causes(&error)));
            EXIT_FAILED
        }
    }
}

// Returned after findings were printed, which are the message: the program exits with 1 and prints no error.
#[derive(Debug, thiserror::Error)]
#[error("there are findings")]
struct Findings;

// Prints a line on standard error. A closed standard error is ignored: the results matter more than the message.
fn tell(line: std::fmt::Arguments<'_>) {
    use std::io::Write;
    let line = line.to_string();
    // Findings of --fail-above are errors, too.
    let matters = line.starts_with("warning") || line.starts_with("error");
    if matters || !is_quiet() {
        let _ = writeln!(std::io::stderr(), "{}", visible(&line));
    }
}

static QUIET: AtomicBool = AtomicBool::new(false);

fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

fn tell_notes(notes: Vec<String>) {
    for line in notes {
        tell(format_args!("note: {line}"));
    }
}

fn tell_unread(unread: Vec<String>) {
    for line in unread {
        tell(format_args!("warning: {line}"));
    }
}

/// The version, with the commit that was built if `build.rs` found it.
pub fn version_and_commit() -> &'static str {
    static TEXT: std::sync::LazyLock<String> = std::sync::LazyLock::new(|| {
        let commit = option_env!("SHEARQ_COMMIT").map(|commit| format!(" ({commit})"));
        format!("{}{}", shearq_dataset::VERSION, commit.unwrap_or_default())
    });
    &TEXT
}

// For the head of a report, so that its results can be repeated.
fn made_by<const N: usize>(settings: [(&str, String); N]) -> Vec<(String, String)> {
    let version = ("Version", format!("shearq {}", shearq_dataset::VERSION));
    let all = std::iter::once(version).chain(settings);
    all.map(|(name, value)| (name.to_owned(), value)).collect()
}

fn count(number: usize, thing: &str) -> String {
    let ending = if number == 1 { "" } else { "s" };
    format!("{number} {thing}{ending}")
}

// Of the terminal, else `COLUMNS`, by which scripts choose the width of a table in a file.
fn width() -> usize {
    let stated = || std::env::var("COLUMNS").ok()?.parse().ok();
    let terminal = terminal_size::terminal_size_of(std::io::stdout());
    terminal
        .map(|(width, _)| usize::from(width.0))
        .or_else(stated)
        .filter(|width| *width > 0)
        .unwrap_or(80)
}

/// Prints an object as JSON, with its origin.
fn print_json(mut value: serde_json::Value) -> anyhow::Result<()> {
    if let Some(object) = value.as_object_mut() {
        object.insert("made_by".into(), origin::origin());
    }
    print(&(serde_json::to_string_pretty(&value)? + "\n"))
}

fn print_table(table: &Table) -> anyhow::Result<()> {
    print(&fitted(table, Some(width())))
}

// Escaped, because names in foreign files could contain control sequences that change the terminal.
fn print(text: &str) -> anyhow::Result<()> {
    write(&visible(text))
}

fn write(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    flushed(|| std::io::stdout().write_all(text.as_bytes()))
}

// Flushed here, because the flush at the end of the process reports no error: a full disk would truncate a table unnoticed.
fn flushed(write: impl FnOnce() -> std::io::Result<()>) -> anyhow::Result<()> {
    use std::io::Write;
    match write().and_then(|()| std::io::stdout().flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(anyhow::Error::new(error).context("standard output"))
        }
        _ => Ok(()),
    }
}

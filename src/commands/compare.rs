use std::path::{Path, PathBuf};

use clap::Args;

use crate::arguments::{Printing, ReportFile, ScoreSettings, Threads};
use crate::{score, tell};
use shearq_catalogue::expression::Expression;
use shearq_challenges::{PublicBranch, PublicChallenge, Score, Truth, ranking};
use shearq_dataset::run::Run;
use shearq_dataset::threads::Pool;
use shearq_render::figure::{Figure, PanelGrid};
use shearq_render::table::Table;
use shearq_results::compare::{Order, choose, chosen, score_all};
use shearq_results::store;
use shearq_results::submit::is_packed;
use shearq_results::views::comparison::{
    compare, compare_runs, named, per_set_plot, verdict, verdict_on_runs,
};
use shearq_results::views::pages;
use shearq_scoring::Options;

/// Compare the metrics of several configurations.
///
/// Each OUT is a folder that `measure` or `run` wrote, or a submission as `pack` writes it: a folder or an archive. Differences in Q are relative to the first OUT and paired
/// over the same images, so that common noise cancels. Published metrics are shown next to them.
///
/// With --store, the command compares the runs that `score --store` and `run --store` recorded.
///
/// With `--challenge great3 --leaderboard`, each OUT is a submission file, which is ranked among the published entries of
/// its branch.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folders that `measure` or `run` wrote, or submissions (with --data).
    #[arg(value_name = "OUT", required_unless_present_any = ["foreign", "store", "leaderboard"])]
    measured: Vec<PathBuf>,
    /// Data folder with the true shear [default: the data that the first OUT was measured from].
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Catalogues of another program, described by a TOML file (docs/files.md). May be given several times.
    #[arg(long, value_name = "FILE")]
    foreign: Vec<PathBuf>,
    /// Results store with the runs to compare, instead of folders.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["measured", "data", "foreign", "definition", "convention", "threads"])]
    store: Option<PathBuf>,
    /// Show the published entries of this challenge: great3.
    #[arg(long, value_name = "NAME", requires = "leaderboard", conflicts_with_all = GREAT10_ONLY)]
    challenge: Option<String>,
    /// Branch of the challenge, such as control-ground-constant.
    #[arg(long, value_name = "NAME", requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    branch: Option<String>,
    /// Truth that submissions to the challenge are scored with, as for `score`.
    #[arg(long, value_name = "PATH", requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    truth: Option<PathBuf>,
    /// Ellipticities of the PSF of the challenge, as for `score`.
    #[arg(long, value_name = "PATH", requires = "truth", conflicts_with_all = GREAT10_ONLY)]
    psf: Option<PathBuf>,
    /// Subfields of a branch of GREAT3 that was simulated [default: 200].
    #[arg(long, value_name = "N", requires = "truth", conflicts_with_all = GREAT10_ONLY, value_parser = clap::value_parser!(u16).range(1..=1000))]
    subfields: Option<u16>,
    /// Rank submissions among the published entries of a branch.
    #[arg(long, requires = "challenge", conflicts_with_all = GREAT10_ONLY)]
    leaderboard: bool,
    /// Compare only sets for which this holds, such as "snr == 'low' and submission == '23/*' and q > 50": columns of a
    /// results store. In a text `*` stands for any characters.
    #[arg(long = "where", value_name = "CONDITION", allow_hyphen_values = true, value_parser = Expression::parse)]
    condition: Option<Expression>,
    /// Metric or column to sort by, such as `q:desc`.
    #[arg(long, value_name = "FIELD[:desc]")]
    sort: Option<Order>,
    /// Draw Q, calibrated Q and m of each set to this file (.pdf, .png or .svg).
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    report: ReportFile,
    #[command(flatten)]
    settings: ScoreSettings,
    #[command(flatten)]
    threads: Threads,
}

// Options without a meaning for submissions to other challenges; `path` is --report.
const GREAT10_ONLY: [&str; 11] = [
    "data",
    "foreign",
    "store",
    "condition",
    "sort",
    "plot",
    "wide",
    "metrics",
    "report",
    "definition",
    "convention",
];

struct Comparison {
    table: Table,
    verdict: Option<String>,
    plot: PanelGrid,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(challenge) = &arguments.challenge {
        let branch = PublicChallenge::named(challenge)?.branch(arguments.branch.as_deref())?;
        let psf = arguments.psf.as_deref();
        let truth = arguments.truth.as_deref();
        let truth = truth.map(|path| Truth {
            path,
            psf,
            subfields: arguments.subfields.map(usize::from),
        });
        let threads = arguments.threads.number();
        let table = leaderboard(&*branch, truth, &arguments.measured, threads)?;
        return arguments.printing.print(&table);
    }
    let Comparison {
        table,
        verdict,
        plot,
    } = match &arguments.store {
        Some(store) => stored(arguments, store)?,
        None => folders(arguments)?,
    };
    // The report shows the verdict as text above the table, the terminal as a note below it.
    let mut printed = table.clone();
    printed.notes.extend(verdict.clone());
    arguments.printing.print(&printed)?;
    if let Some(path) = &arguments.plot {
        // After printing: the comparison is not lost if the file cannot be written.
        plot.save(path)?;
    }
    let sections = || Ok(vec![pages::comparison(table, verdict, &plot)?]);
    let title = "Comparison of configurations";
    arguments
        .report
        .save(title, sections, || made_by(arguments))
}

fn leaderboard(
    branch: &dyn PublicBranch,
    truth: Option<Truth<'_>>,
    submissions: &[PathBuf],
    threads: usize,
) -> anyhow::Result<Table> {
    anyhow::ensure!(
        !branch.leaderboard().is_empty(),
        "--leaderboard: no published entries of {} are known (expected --challenge great3)",
        branch.title()
    );
    let pool = Pool::new(threads)?;
    let mut own: Vec<(String, Score)> = Vec::new();
    for submission in submissions {
        let Some(truth) = truth else {
            anyhow::bail!(
                "{}: cannot be scored without the true shear. Try: --truth PATH",
                submission.display()
            );
        };
        let name = submission.display().to_string();
        let score = branch.score(truth, submission, &pool)?;
        // As in own challenges, a rank of an entry that measures no shear would be luck.
        if let Some(refusal) = &score.refusal {
            anyhow::bail!("{name}: not ranked: {refusal}");
        }
        for warning in &score.warnings {
            tell(format_args!("warning: {name}: {warning}"));
        }
        own.push((name, score));
    }
    let mut table = ranking(branch, &own);
    if let (Some(subfields), Some(published)) =
        (truth.and_then(|truth| truth.subfields), branch.subfields())
    {
        table.notes.push(format!(
            "Your submissions have {subfields} subfields, the published ones {published}: Q of fewer is noisier, and usually lower."
        ));
    }
    Ok(table)
}

// Archives have no record of a run, so only their path can be stated.
fn made_by(arguments: &Arguments) -> anyhow::Result<Vec<(String, String)>> {
    let mut made_by = Vec::new();
    for folder in &arguments.measured {
        if is_packed(folder) {
            made_by.push(("Input".to_owned(), folder.display().to_string()));
            continue;
        }
        made_by.extend(score::made_by(&Run::require(folder)?, folder)?);
    }
    let paths = arguments.store.iter().chain(&arguments.foreign);
    let paths = paths.chain(&arguments.data);
    made_by.extend(paths.map(|path| ("Input".to_owned(), path.display().to_string())));
    Ok(made_by)
}

fn folders(arguments: &Arguments) -> anyhow::Result<Comparison> {
    let order = arguments.sort.as_ref();
    let options = Options {
        definition: arguments.settings.definition,
        ..Options::default()
    };
    let variants = score_all(
        &arguments.measured,
        &arguments.foreign,
        arguments.data.as_deref(),
        arguments.settings.convention,
        options,
        arguments.threads.number(),
    )?;
    let variants = chosen(variants, arguments.condition.as_ref(), order)?;
    let table = compare(&variants, options.definition);
    let named = named(&variants);
    Ok(Comparison {
        table,
        verdict: verdict(&named),
        plot: per_set_plot(&named),
    })
}

fn stored(arguments: &Arguments, path: &Path) -> anyhow::Result<Comparison> {
    let (mut runs, notes) = store::read(path)?;
    if let Some(condition) = &arguments.condition {
        runs = choose(condition, runs)?;
    }
    anyhow::ensure!(
        !runs.is_empty(),
        "{}: found no recorded run{}",
        path.display(),
        match &arguments.condition {
            Some(_) => " that meets the conditions of --where",
            None => ". Try: shearq score --measured OUT --store DIR",
        }
    );
    if let Some(order) = &arguments.sort {
        order.sort(&mut runs);
    }
    let mut table = compare_runs(&runs);
    table.notes.extend(notes);
    let rows = runs
        .iter()
        .map(|run| (run.name_with_id(), run.sets.as_slice()));
    Ok(Comparison {
        table,
        plot: per_set_plot(&rows.collect::<Vec<_>>()),
        verdict: verdict_on_runs(runs),
    })
}

use std::path::PathBuf;

use clap::Args;

use crate::arguments::{Form, SetList, SimulationArguments, Threads, configurations};
use crate::progress::{Bar, mark_resumable};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_studies::reproduce::{Plan, Study, run_sets};
use shearq_studies::study::{bias_sets, study_table};

/// Compare configurations with each other and with the Cramér–Rao bound.
///
/// For each set and configuration, the command measures the scatter of calibrated ellipticities and its ratio to the
/// bound. It also measures multiplicative and additive bias, PSF leakage, and the time per galaxy. For Q, use `run` and
/// `compare`.
///
/// The data are simulated in memory. Finished sets are kept, so the same command resumes a stopped study. Use a seed
/// with which no setting was tuned.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file. May be given several times.
    #[arg(long, value_name = "NAME|FILE", default_values = ["23/raw/star", "23/den/star", "48/linear/star"])]
    submission: Vec<String>,
    /// Sets, such as `1,2,7-9` or `all`; the default has one set of each kind with a fixed PSF.
    #[arg(
        long,
        value_name = "LIST",
        default_value = "2,5,8,11,14,16,18,20,22,24"
    )]
    sets: SetList,
    /// Images per set for the scatter, at least 2.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=i64::from(MAX_IMAGE)))]
    images: u32,
    /// Images per set for the biases; each galaxy is drawn eight times.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    pairs: u32,
    #[command(flatten)]
    simulation: SimulationArguments,
    /// Folder for the results of finished sets.
    #[arg(long, value_name = "DIR", default_value = "shearq-study")]
    out: PathBuf,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let &Arguments { images, pairs, .. } = arguments;
    let (sets, threads) = (arguments.sets.simulated()?, arguments.threads.number());
    let plan = Plan {
        version: shearq_dataset::VERSION.into(),
        simulation: arguments.simulation.settings()?,
        images,
        configurations: configurations(&arguments.submission)?,
    };
    // The study claims its folder: two processes with one plan share the sets, and another plan is refused.
    let study = Study::open(&plan, &arguments.out)?;
    let image = (plan.simulation.grid as u64).pow(2) * sets.len() as u64;
    let mut bar = Bar::new("simulating and measuring", image * u64::from(images));
    let results = run_sets(&study, &sets, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("measuring biases", image * u64::from(pairs));
    // With fewer images than the scatter: paired versions of the same galaxies cancel shape noise and pixel noise.
    let biases = bias_sets(&study, &sets, pairs, threads, &mut bar)?;
    drop(bar);
    arguments
        .form
        .print(&study_table(&plan, &results, &biases)?)
}

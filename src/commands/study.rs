use std::path::PathBuf;

use clap::Args;

use crate::arguments::{Form, SetList, SimulationArguments, Threads, configurations};
use crate::progress::{Bar, mark_resumable};
use crate::{made_by, print};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_render::page::Page;
use shearq_render::table::TableFormat;
use shearq_studies::contest::{bias_sets, contest_figure, contest_parts, contest_table};
use shearq_studies::reproduce::{Plan, Study, run_sets};

/// Compare configurations with each other and with the Cramér–Rao bound.
///
/// For each set and configuration, the command measures the scatter of calibrated ellipticities and its ratio to the
/// bound. It also measures multiplicative and additive bias, PSF leakage, Q, and the time per galaxy.
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
    /// Images per set for Q and scatter, at least 2; the challenge has 200.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=i64::from(MAX_IMAGE)))]
    images: u32,
    /// Images per set for the biases; each galaxy is drawn eight times.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    pairs: u32,
    #[command(flatten)]
    simulation: SimulationArguments,
    /// Folder for results and report.
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
    let results = run_sets(&study, sets, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("measuring biases", image * u64::from(pairs));
    // With fewer images than Q: paired versions of the same galaxies cancel shape noise and pixel noise.
    let biases = bias_sets(&study, sets, pairs, threads, &mut bar)?;
    drop(bar);
    let table = contest_table(&plan, &results, &biases)?;
    let data = format!(
        "simulated: {images} images of {0} × {0} galaxies per set, {pairs} for biases",
        plan.simulation.grid
    );
    let mut made_by = made_by([
        ("Seed", plan.simulation.seed.to_string()),
        ("Data", data),
        ("Simulation", toml::to_string(&plan.simulation)?),
    ]);
    for configuration in &plan.configurations {
        made_by.push((configuration.name.clone(), toml::to_string(configuration)?));
    }
    study.claim.check()?;
    let mut page = Page::new(
        &arguments.out,
        "Configurations compared",
        "Simulated data",
        made_by,
    );
    let [shapes, quality] = contest_parts(&table);
    page.section("Ellipticities", "Scatter and biases on every kind of set.");
    page.figure(
        "study",
        &contest_figure(&plan, &results, &biases),
        "Each configuration on each set, with errors. Grey: the requirement |m| < 0.002. Dashed: the Cramér–Rao bound, zero additive bias. The expected Q is for noise at the bound and a perfect spectrum. A method that loses shear together with noise can exceed it.",
    )?;
    page.table("biases", &shapes)?;
    page.section("Spectra", "Quality on every kind of set, and cost.");
    page.table("quality", &quality)?;
    page.data("study", &table)?;
    study.claim.check()?;
    page.save()?;
    let form = &arguments.form;
    // One table for programs; for people two, each of which fits a terminal.
    if matches!(form.format, TableFormat::Csv | TableFormat::Json) {
        return form.print(&table);
    }
    form.print(&shapes)?;
    print("\n")?;
    form.print(&quality)
}

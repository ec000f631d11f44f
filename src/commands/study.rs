//! `shearq study`.

use std::path::PathBuf;

use clap::Args;
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{Form, SetList, SimulationArguments, Threads, given_once};
use crate::print;
use crate::progress::{Bar, goes_on};
use shearq_pipeline::data::pattern::MAX_IMAGE;
use shearq_render::page::Page;
use shearq_render::table::TableFormat;
use shearq_results::views::pages;
use shearq_studies::contest::{bias_sets, contest_parts, contest_table};
use shearq_studies::reproduce::{Plan, Study, run_sets};

/// Hold submissions against each other and against what can be reached.
///
/// For every kind of set and submission: scatter of calibrated ellipticities and its ratio to the
/// Cramér–Rao bound, multiplicative and additive bias, leakage of the PSF, Q of catalogues and of
/// cross-spectra, and time per galaxy. Everything is simulated in memory; finished sets are kept, so a
/// stopped study goes on where it was. Use a seed that no setting was chosen with.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Names of submissions, or TOML files of your own. May be given several times.
    #[arg(long, value_name = "NAME|FILE", default_values = ["23/raw/star", "23/den/star", "48/linear/star"])]
    submission: Vec<String>,
    /// Sets; by default one of each kind, with a fixed PSF.
    #[arg(
        long,
        value_name = "LIST",
        default_value = "2,5,8,11,14,16,18,20,22,24"
    )]
    sets: SetList,
    /// Images per set for Q and scatter, at least 2; the challenge has 200.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=i64::from(MAX_IMAGE)))]
    images: u32,
    /// Images per set whose galaxies are drawn eight times for the biases.
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
    goes_on();
    let Arguments {
        submission,
        sets,
        images,
        pairs,
        simulation,
        out,
        form,
        threads,
    } = arguments;
    let sets = sets.simulated()?;
    given_once(submission)?;
    let registry = Registry::embedded()?;
    let submissions = submission
        .iter()
        .map(|name| Ok(registry.get(name)?.configuration))
        .collect::<anyhow::Result<Vec<Configuration>>>()?;
    let plan = Plan {
        version: shearq_pipeline::VERSION.into(),
        simulation: simulation.settings()?,
        images: *images,
        submissions,
    };
    let study = Study::open(&plan, out)?;
    let threads = threads.number();
    let image = (plan.simulation.grid as u64).pow(2) * sets.len() as u64;
    let mut bar = Bar::new("simulating and measuring", image * u64::from(*images));
    let results = run_sets(&study, sets, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("measuring biases", image * u64::from(*pairs));
    let biases = bias_sets(&study, sets, *pairs, threads, &mut bar)?;
    drop(bar);
    let table = contest_table(&plan, &results, &biases)?;
    let mut made_by = vec![
        (
            "Version".into(),
            format!("shearq {}", shearq_pipeline::VERSION),
        ),
        ("Seed".into(), plan.simulation.seed.to_string()),
        (
            "Data".into(),
            format!(
                "simulated: {images} images of {0} × {0} galaxies per set, {pairs} for biases",
                plan.simulation.grid
            ),
        ),
        ("Simulation".into(), toml::to_string(&plan.simulation)?),
    ];
    for submission in &plan.submissions {
        made_by.push((submission.name.clone(), toml::to_string(submission)?));
    }
    study.check()?;
    let mut page = Page::new(out, "Submissions compared", "Simulated data", made_by);
    let [shapes, quality] = contest_parts(&table);
    page.section("Ellipticities", "Scatter and biases on every kind of set.");
    page.figure(
        "study",
        &pages::contest(&table),
        "Each submission on each set, with errors. Dashed: the Cramér–Rao bound, m of ± 0.002, no additive bias. The limit of Q is that of noise at the bound beside a perfect spectrum; shear that is lost together with noise can lead beyond it.",
    )?;
    page.table("biases", &shapes)?;
    page.section("Spectra", "Quality on every kind of set, and cost.");
    page.table("quality", &quality)?;
    page.data("study", &table)?;
    study.check()?;
    page.save()?;
    if matches!(form.format, TableFormat::Csv | TableFormat::Json) {
        return form.print(&table);
    }
    form.print(&shapes)?;
    print("\n")?;
    form.print(&quality)
}

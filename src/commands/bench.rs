//! `shearq bench`.

use std::path::PathBuf;

use clap::Args;
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{Form, Threads, given_once};
use crate::print;
use shearq_render::page::Page;
use shearq_render::table::Table;
use shearq_simulate::set::SimulationSettings;
use shearq_studies::convergence::convergence;
use shearq_studies::speed;

/// Measure the speed on this machine: stages of a measurement, stamp sizes, convergence, threads and scoring.
///
/// It takes about a minute. Other work on the machine disturbs it, so compare ratios within one run rather than
/// absolute times. docs/speed.md explains the results.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file. May be given several times.
    #[arg(long, value_name = "NAME|FILE", default_values = ["23/den/star", "48/linear/star"])]
    submission: Vec<String>,
    /// Number of catalogues to score.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u16).range(2..=2000))]
    catalogues: u16,
    /// Also time simulating and measuring of up to so many galaxies, such as 1e7 (some minutes), in one image and in many.
    #[arg(long, value_name = "N", value_parser = galaxies)]
    galaxies: Option<f64>,
    /// Folder for a report with plots and their data.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

/// Parses a number of galaxies.
fn galaxies(text: &str) -> Result<f64, String> {
    let number = text.parse().ok();
    number
        .filter(|number| (1e3..=1e9).contains(number))
        .ok_or_else(|| "expected a number from 1000 to 1e9".into())
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    given_once(&arguments.submission)?;
    let registry = Registry::embedded()?;
    let submissions = arguments
        .submission
        .iter()
        .map(|name| Ok(registry.get(name)?.configuration))
        .collect::<anyhow::Result<Vec<Configuration>>>()?;
    let threads = arguments.threads.number();
    let settings = SimulationSettings::new(1, 50);
    let mut page = arguments.out.as_deref().map(|out| {
        let made_by = vec![
            (
                "Version".into(),
                format!("shearq {}", shearq_pipeline::VERSION),
            ),
            ("Threads".into(), threads.to_string()),
            ("Seed".into(), settings.seed.to_string()),
        ];
        Page::new(out, "Speed of shearq", "Measured on this machine", made_by)
    });
    let show = |page: &mut Option<Page<'_>>, name: &str, table: Table| {
        if let Some(page) = page {
            page.table(name, &table)?;
        }
        arguments.form.print(&table)?;
        print("\n")
    };
    if let Some(page) = &mut page {
        page.section(
            "Stages",
            "Cost of one galaxy on one thread, and rates with several threads.",
        );
    }
    for submission in &submissions {
        let name = submission.name.replace('/', "-");
        let stages = speed::stages(submission, settings)?;
        show(&mut page, &format!("stages-{name}"), stages)?;
        let scaling = speed::scaling(submission, settings, threads)?;
        show(&mut page, &format!("threads-{name}"), scaling)?;
    }
    if let Some(page) = &mut page {
        page.section(
            "Sizes",
            "Cost against the size of the stamp, and forms of the convolution.",
        );
    }
    let costs = submissions
        .iter()
        .map(|s| Ok((s.name.as_str(), speed::size_costs(s, settings)?)))
        .collect::<anyhow::Result<Vec<_>>>()?;
    show(&mut page, "sizes", speed::sizes_table(&costs))?;
    if let Some(page) = &mut page {
        page.figure(
            "sizes",
            &speed::sizes_figure(&costs),
            "Cost against stamp size.",
        )?;
    }
    show(
        &mut page,
        "operator-forms",
        speed::operator_forms(settings)?,
    )?;
    if let Some(page) = &mut page {
        page.section(
            "Convergence",
            "Energy of the network with and without momentum.",
        );
    }
    for submission in &submissions {
        if submission.linear().is_some() {
            continue;
        }
        let name = format!("energy-{}", submission.name.replace('/', "-"));
        let energies = convergence(submission, settings)?;
        show(&mut page, &name, energies.table())?;
        if let Some(page) = &mut page {
            page.figure(&name, &energies.figure(), "Energy above its minimum.")?;
        }
    }
    if let Some(most) = arguments.galaxies {
        if let Some(page) = &mut page {
            page.section(
                "Numbers",
                "Time against the number of galaxies, in one image and in many.",
            );
        }
        for submission in &submissions {
            let name = format!("numbers-{}", submission.name.replace('/', "-"));
            let amounts = speed::amounts(submission, settings, threads, most)?;
            show(&mut page, &name, amounts.table())?;
            if let Some(page) = &mut page {
                page.figure(&name, &amounts.figure(), "Time against number.")?;
            }
        }
    }
    if let Some(page) = &mut page {
        page.section("Scoring", "Catalogues of 10,000 rows, read and scored.");
    }
    let scoring = speed::scoring(usize::from(arguments.catalogues), threads)?;
    show(&mut page, "scoring", scoring)?;
    match page {
        Some(page) => Ok(page.save()?),
        None => Ok(()),
    }
}

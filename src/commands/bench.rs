//! `shearq bench`.

use std::path::PathBuf;

use clap::Args;
use shearq_submissions::{Configuration, Registry};

use crate::arguments::{Form, Threads, given_once};
use crate::print;
use shearq_render::figure::Figure;
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
        .filter(|number| (1e3..=1e7).contains(number))
        .ok_or_else(|| "expected a number from 1000 to 1e7".into())
}

/// Tables and plots for the terminal, and for a report if there is a folder for it.
struct Output<'a> {
    page: Option<Page<'a>>,
    form: &'a Form,
}

impl Output<'_> {
    fn section(&mut self, title: &str, text: &str) {
        if let Some(page) = &mut self.page {
            page.section(title, text);
        }
    }

    fn table(&mut self, name: &str, table: &Table) -> anyhow::Result<()> {
        if let Some(page) = &mut self.page {
            page.table(name, table)?;
        }
        self.form.print(table)?;
        print("\n")
    }

    fn figure(&mut self, name: &str, figure: &impl Figure, caption: &str) -> anyhow::Result<()> {
        match &mut self.page {
            Some(page) => Ok(page.figure(name, figure, caption)?),
            None => Ok(()),
        }
    }
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
    let page = arguments.out.as_deref().map(|out| {
        let made_by = vec![
            (
                "Version".into(),
                format!("shearq {}", shearq_dataset::VERSION),
            ),
            ("Threads".into(), threads.to_string()),
            ("Seed".into(), settings.seed.to_string()),
        ];
        Page::new(out, "Speed of shearq", "Measured on this machine", made_by)
    });
    let mut output = Output {
        page,
        form: &arguments.form,
    };
    let of = |name: &str, submission: &Configuration| {
        format!("{name}-{}", submission.name.replace('/', "-"))
    };
    output.section(
        "Stages",
        "Cost of one galaxy on one thread, and rates with several threads.",
    );
    for submission in &submissions {
        let stages = speed::stages(submission, settings)?;
        output.table(&of("stages", submission), &stages)?;
        let scaling = speed::scaling(submission, settings, threads)?;
        output.table(&of("threads", submission), &scaling)?;
    }
    output.section(
        "Sizes",
        "Cost against the size of the stamp, and forms of the convolution.",
    );
    let costs = submissions
        .iter()
        .map(|s| Ok((s.name.as_str(), speed::size_costs(s, settings)?)))
        .collect::<anyhow::Result<Vec<_>>>()?;
    output.table("sizes", &speed::sizes_table(&costs))?;
    output.figure(
        "sizes",
        &speed::sizes_figure(&costs),
        "Cost against stamp size.",
    )?;
    output.section(
        "Convergence",
        "Energy of the network with and without momentum.",
    );
    for submission in submissions.iter().filter(|s| s.linear().is_none()) {
        let name = of("energy", submission);
        let energies = convergence(submission, settings)?;
        output.table(&name, &energies.table())?;
        output.figure(&name, &energies.figure(), "Energy above its minimum.")?;
    }
    if let Some(most) = arguments.galaxies {
        output.section(
            "Numbers",
            "Time against the number of galaxies, in one image and in many.",
        );
        for submission in &submissions {
            let name = of("numbers", submission);
            let amounts = speed::amounts(submission, settings, threads, most)?;
            output.table(&name, &amounts.table())?;
            output.figure(&name, &amounts.figure(), "Time against number.")?;
        }
    }
    output.section("Scoring", "Catalogues of 10,000 rows, read and scored.");
    let scoring = speed::scoring(usize::from(arguments.catalogues), threads)?;
    output.table("scoring", &scoring)?;
    match output.page {
        Some(page) => Ok(page.save()?),
        None => Ok(()),
    }
}

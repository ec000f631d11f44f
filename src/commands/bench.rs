//! `shearq bench`.

use clap::Args;
use shearq_simulate::set::SimulationSettings;
use shearq_studies::speed;

use crate::arguments::{Form, Threads, configurations};
use crate::print;

/// Measure the speed on this machine: stages of a measurement, stamp sizes, threads and scoring.
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
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let configurations = configurations(&arguments.submission)?;
    let threads = arguments.threads.number();
    let settings = SimulationSettings::new(1, 50);
    // Each table is printed as soon as it is known, because the whole takes a minute.
    for configuration in &configurations {
        arguments
            .form
            .print(&speed::stages(configuration, settings)?)?;
        print("\n")?;
        arguments
            .form
            .print(&speed::scaling(configuration, settings, threads)?)?;
        print("\n")?;
    }
    arguments
        .form
        .print(&speed::size_costs(&configurations, settings)?)?;
    print("\n")?;
    let scoring = speed::scoring(usize::from(arguments.catalogues), threads)?;
    arguments.form.print(&scoring)
}

use clap::Args;
use shearq_simulate::set::SimulationSettings;
use shearq_studies::speed;

use crate::arguments::{Form, Threads, configurations};

/// Measure the speed on this machine: measuring, simulating and threads.
///
/// It takes less than a minute. Other work on the machine disturbs it, so compare ratios within one run rather than
/// absolute times. docs/validation.md explains the results.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file. May be given several times.
    #[arg(long, value_name = "NAME|FILE", default_values = ["23/den/star", "48/linear/star"])]
    submission: Vec<String>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let threads = arguments.threads.number();
    let configurations = configurations(&arguments.submission)?;
    // 2,500 galaxies per image, so that the command takes less than a minute. Chosen by hand.
    let settings = SimulationSettings::new(1, 50);
    let table = speed::speeds(&configurations, settings, threads)?;
    arguments.form.print(&table)
}

//! `shearq bench`.

use clap::Args;
use shearq_submissions::Registry;

use super::arguments::{Printing, Threads};
use super::print;
use crate::simulate::set::SimulationSettings;
use crate::study::speed;

/// Measure the speed on this machine: stages of a measurement, stamp sizes, threads, scoring.
///
/// Takes under a minute. Other work on the machine disturbs it; ratios within one run are safer than
/// absolute figures.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Name of a submission or a TOML file of your own.
    #[arg(long, value_name = "NAME|FILE", default_value = "23/den/star")]
    submission: String,
    /// Catalogues scored.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u16).range(2..=2000))]
    catalogues: u16,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    threads: Threads,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let submission = Registry::embedded()?.get(&arguments.submission)?.submission;
    let threads = arguments.threads.number();
    let settings = SimulationSettings::new(1, 50);
    let show = |table| print(&(arguments.printing.render(&table) + "\n"));
    show(speed::stages(&submission, settings)?)?;
    show(speed::sizes(&submission, settings)?)?;
    show(speed::scaling(&submission, settings, threads)?)?;
    show(speed::scoring(usize::from(arguments.catalogues), threads)?)
}

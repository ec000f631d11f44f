//! `shearq calibrate`.

use std::path::PathBuf;

use clap::Args;
use shearq_submissions::Registry;

use super::arguments::{Printing, Threads};
use super::print;
use super::progress::Bar;
use crate::io::atomic;
use crate::report::figure::Figure;
use crate::report::table::TableFormat;
use crate::study::calibration::calibrate;
use crate::study::exhibits;

/// Find the regularisation parameter λ for a submission, as in the paper's Sect. 4.
///
/// Synthetic Sérsic galaxies with a Moffat PSF each and noise of 10, 20 and 40 dB are deconvolved for
/// λ from 1e-6 to 1e6 by both updating rules. Printed are the λ of the best 1/RMSD at each S/N and
/// the λ chosen; with --out, the paper's Figs 4 to 7 are drawn and their data written.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Name of a submission or a TOML file of your own.
    #[arg(long, value_name = "NAME|FILE", default_value = "paper")]
    submission: String,
    /// Galaxies; the paper has 10000.
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
    galaxies: u64,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    seed: u64,
    /// Folder for figures and data.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    printing: Printing,
    #[command(flatten)]
    threads: Threads,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let submission = Registry::embedded()?.get(&arguments.submission)?.submission;
    let mut bar = Bar::new("calibrating", arguments.galaxies);
    let curves = calibrate(
        &submission,
        arguments.galaxies,
        arguments.seed,
        arguments.threads.number(),
        &mut bar,
    )?;
    drop(bar);
    if let Some(out) = &arguments.out {
        for ending in ["png", "svg"] {
            let path = |name: &str| out.join(format!("{name}.{ending}"));
            exhibits::ctr_over_snr(&curves).save(path("fig4-ctr-snr"))?;
            exhibits::ctr_over_lambda(&curves).save(path("fig5-ctr-lambda"))?;
            exhibits::dsnr_over_lambda(&curves).save(path("fig6-dsnr-lambda"))?;
            exhibits::inverse_rmsd(&curves).save(path("fig7-rmsd-lambda"))?;
        }
        let data = exhibits::curves_table(&curves).render(TableFormat::Csv);
        atomic::write(out.join("curves.csv"), data.as_bytes())?;
        eprintln!("figures and data in {}", out.display());
    }
    let table = exhibits::calibration_table(&curves, &submission);
    print(&arguments.printing.render(&table))
}

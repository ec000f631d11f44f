use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use shearq_submissions::Registry;

use crate::arguments::{Form, Threads};
use crate::progress::Bar;
use crate::{made_by, tell};
use shearq_render::page::Page;
use shearq_studies::calibration::{best_table, calibrate, figures};

/// Find the regularisation parameter λ of a configuration, as in Sect. 4 of the paper.
///
/// Synthetic Sérsic galaxies, each with a Moffat PSF and noise of 10, 20 or 40 dB, are deconvolved by both updating
/// rules. λ runs from 1e-6 to 1e6. The command prints the λ with the best 1/RMSD at each S/N and the chosen λ. With
/// --out, it also draws Figs 4 to 7 of the paper and writes their data.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file.
    #[arg(long, value_name = "NAME|FILE", default_value = "paper")]
    submission: String,
    /// Number of galaxies; the paper has 10000.
    #[arg(long, value_name = "N", default_value_t = 400, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
    galaxies: u64,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    seed: u64,
    /// Folder for a report with plots and their data.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let submission = Registry::embedded()?
        .get(&arguments.submission)?
        .configuration;
    anyhow::ensure!(
        // A linear configuration deconvolves in closed form, without λ.
        submission.network().is_some(),
        "{} has no λ to calibrate (found method = \"linear\", expected \"network\"). Try: --submission paper",
        submission.name
    );
    // Before the work, so that a folder that cannot be made is an error at once.
    if let Some(out) = &arguments.out {
        std::fs::create_dir_all(out)
            .with_context(|| format!("{}: cannot make the folder", out.display()))?;
    }
    let mut bar = Bar::new("calibrating", arguments.galaxies);
    let curves = calibrate(
        &submission,
        arguments.galaxies,
        arguments.seed,
        arguments.threads.number(),
        &mut bar,
    )?;
    drop(bar);
    let table = best_table(&curves, &submission);
    if let Some(out) = &arguments.out {
        let made_by = made_by([
            ("Seed", arguments.seed.to_string()),
            ("Data", format!("{} synthetic galaxies", arguments.galaxies)),
            ("Settings", toml::to_string(&submission)?),
        ]);
        let title = format!("Calibration of λ for {}", submission.name);
        let mut page = Page::new(out, &title, "Simulated data", made_by);
        page.section("Curves", "Figs 4 to 7 of the paper.");
        figures(&mut page, &curves)?;
        page.section("λ", "The best λ at each S/N, and the chosen λ.");
        page.table("lambda", &table)?;
        page.save()?;
        tell(format_args!(
            "wrote report, plots and data to {}",
            out.display()
        ));
    }
    arguments.form.print(&table)
}

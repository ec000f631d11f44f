//! `shearq reproduce`.

use std::path::{Path, PathBuf};

use clap::Args;
use shearq_submissions::{Published, Registry, Submission};

use super::arguments::{SetList, Threads};
use super::print;
use super::progress::Bar;
use crate::io::atomic;
use crate::report::figure::Figure;
use crate::report::table::{Table, TableFormat};
use crate::simulate::field::ShearSpectrum;
use crate::simulate::set::SimulationSettings;
use crate::study::calibration::calibrate;
use crate::study::exhibits;
use crate::study::reproduce::{Plan, SetResult, run_sets};

/// Reproduce the paper's figures and tables on simulated data.
///
/// Sect. 4: calibration of λ on synthetic galaxies (Figs 4 to 7). Sect. 5: the seven submissions of
/// Table 1 on the 24 sets (Table 1, Figs 8 to 11), simulated and measured in memory, set by set;
/// each finished set is kept, so a stopped run goes on where it was. Everything is drawn as PNG and
/// SVG, with its data as CSV. The default takes minutes; --images 200 is the challenge's size and
/// takes hours.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-reproduce")]
    out: PathBuf,
    /// Images per set.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=999))]
    images: u32,
    /// Galaxies a side of an image.
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: u16,
    /// Sets.
    #[arg(long, value_name = "LIST", default_value = "all")]
    sets: SetList,
    /// Galaxies of the calibration; the paper has 10000.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
    galaxies: u64,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = 2013)]
    seed: u64,
    #[command(flatten)]
    threads: Threads,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        out,
        images,
        grid,
        sets,
        galaxies,
        seed,
        threads,
    } = arguments;
    let threads = threads.number();
    let registry = Registry::embedded()?;
    let mut submissions = Vec::new();
    for name in registry.names() {
        let entry = registry.get(name)?;
        submissions.push((entry.submission, entry.published));
    }
    let plan = Plan {
        version: crate::VERSION.into(),
        simulation: SimulationSettings {
            seed: *seed,
            grid: usize::from(*grid),
            spectrum: ShearSpectrum::default(),
            intrinsic_sigma: super::simulate::INTRINSIC_SIGMA,
        },
        images: *images,
        submissions: submissions.iter().map(|(s, _)| s.clone()).collect(),
    };
    let total = sets.0.len() as u64 * u64::from(*images) * u64::from(*grid).pow(2);
    let mut bar = Bar::new("simulating and measuring", total);
    let results = run_sets(&plan, &sets.0, out, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("calibrating", *galaxies);
    let raw = registry.get("23/raw/star")?.submission;
    let curves = calibrate(&raw, *galaxies, *seed, threads, &mut bar)?;
    drop(bar);

    let writer = Writer { out };
    writer.figure("fig4-ctr-snr", &exhibits::ctr_over_snr(&curves))?;
    writer.figure("fig5-ctr-lambda", &exhibits::ctr_over_lambda(&curves))?;
    writer.figure("fig6-dsnr-lambda", &exhibits::dsnr_over_lambda(&curves))?;
    writer.figure("fig7-rmsd-lambda", &exhibits::inverse_rmsd(&curves))?;
    writer.data("fig5-7-lambda", &exhibits::curves_table(&curves))?;
    sect_five(&writer, &results, &submissions)?;
    print(&format!(
        "{}\n{}\n{}",
        exhibits::table_one(&results, &submissions).render(TableFormat::Table),
        exhibits::findings_table(&exhibits::findings(&results, &names(&submissions)))
            .render(TableFormat::Table),
        exhibits::calibration_table(&curves, &raw).render(TableFormat::Table),
    ))?;
    eprintln!("figures and data in {}", out.display());
    Ok(())
}

fn names(submissions: &[(Submission, Option<Published>)]) -> Vec<String> {
    submissions.iter().map(|(s, _)| s.name.clone()).collect()
}

fn sect_five(
    writer: &Writer<'_>,
    results: &[SetResult],
    submissions: &[(Submission, Option<Published>)],
) -> anyhow::Result<()> {
    let names = names(submissions);
    writer.data("table1", &exhibits::table_one(results, submissions))?;
    writer.figure("fig8-q-per-set", &exhibits::q_per_set(results, &names))?;
    writer.data("fig8-11-per-set", &exhibits::per_set_table(results))?;
    let place = |name: &str| names.iter().position(|n| n == name);
    if let (Some(raw), Some(den)) = (place("23/raw/star"), place("23/den/star")) {
        writer.figure(
            "fig9-power-spectra",
            &exhibits::power_spectra(results, den, "23/den/star"),
        )?;
        writer.data(
            "fig9-power-spectra",
            &exhibits::power_spectra_table(results, den),
        )?;
        let both = [(raw, "23/raw/star"), (den, "23/den/star")];
        writer.figure(
            "fig10-multiplicative",
            &exhibits::bias_per_set(results, &both, 2, "Multiplicative bias per set", "M/2"),
        )?;
        writer.figure(
            "fig11-additive",
            &exhibits::bias_per_set(results, &both, 3, "Additive bias per set", "√A × 10⁴"),
        )?;
    }
    Ok(())
}

/// Writes exhibits into one folder.
struct Writer<'a> {
    out: &'a Path,
}

impl Writer<'_> {
    fn figure(&self, name: &str, figure: &impl Figure) -> anyhow::Result<()> {
        for ending in ["png", "svg"] {
            figure.save(self.out.join(format!("figures/{name}.{ending}")))?;
        }
        Ok(())
    }

    fn data(&self, name: &str, table: &Table) -> anyhow::Result<()> {
        let text = table.render(TableFormat::Csv);
        atomic::write(self.out.join(format!("data/{name}.csv")), text.as_bytes())?;
        Ok(())
    }
}

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use shearq_submissions::{Configuration, Published, Registry};

use crate::arguments::{SetList, Threads, given_once};
use crate::progress::{Bar, mark_resumable};
use crate::{made_by, print, print_table, tell};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_render::page::Page;
use shearq_simulate::set::SimulationSettings;
use shearq_studies::calibration::{best_table, calibrate};
use shearq_studies::exhibits;
use shearq_studies::reproduce::{Plan, Study, run_sets};

/// Reproduce the figures and tables of the paper on simulated data.
///
/// Sect. 4: calibration of λ on synthetic galaxies (Figs 4 to 7). Sect. 5: the seven configurations of Table 1 on 24
/// sets (Table 1, Figs 8 to 11), simulated and measured in memory.
///
/// The command writes an HTML report, figures as PNG and SVG, and their data as CSV. Finished sets are
/// kept, so the same command resumes a stopped run. The default takes minutes; --images 200, as in the challenge,
/// takes hours.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-reproduce")]
    out: PathBuf,
    /// Images per set, at least 2, because differences between images determine the noise of spectra.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(2..=i64::from(MAX_IMAGE)))]
    images: u32,
    /// Galaxies per side of a simulated image.
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: u16,
    /// Sets, such as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST", default_value = "all")]
    sets: SetList,
    /// Configuration of Table 1. May be given several times [default: all seven].
    #[arg(long, value_name = "NAME")]
    submission: Vec<String>,
    /// Number of galaxies for the calibration; the paper has 10000.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
    galaxies: u64,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = 2013)]
    seed: u64,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let Arguments {
        out,
        images,
        grid,
        galaxies,
        seed,
        ..
    } = arguments;
    let threads = arguments.threads.number();
    let sets = arguments.sets.simulated()?;
    let registry = Registry::embedded()?;
    let configurations = of_table_one(&registry, &arguments.submission)?;
    let names: Vec<String> = configurations
        .iter()
        .map(|(own, _)| own.name.clone())
        .collect();
    let plan = Plan {
        version: shearq_dataset::VERSION.into(),
        simulation: SimulationSettings::new(*seed, usize::from(*grid)),
        images: *images,
        configurations: configurations.iter().map(|(own, _)| own.clone()).collect(),
    };
    let total = sets.len() as u64 * u64::from(*images) * u64::from(*grid).pow(2);
    let mut bar = Bar::new("simulating and measuring", total);
    let study = Study::open(&plan, out)?;
    let results = run_sets(&study, &sets, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("calibrating", *galaxies);
    // Sect. 4 calibrates one network; the configurations of Table 1 extend its settings.
    let base = registry.get("paper")?.configuration;
    let curves = calibrate(&base, *galaxies, *seed, threads, &mut bar)?;
    drop(bar);

    let data = format!(
        "simulated: {} sets, {images} images of {grid} × {grid} galaxies",
        sets.len()
    );
    let settings = made_by([
        ("Seed", seed.to_string()),
        ("Data", data),
        ("Calibration", format!("{galaxies} synthetic galaxies")),
        ("Settings of the calibration", toml::to_string(&base)?),
    ]);
    // The folder may have been removed during hours of work; a page without its results would be made there.
    study.claim.check()?;
    let mut page = Page::new(
        out,
        "Hopfield Neural Network deconvolution, reproduced",
        "Figures and tables of Nurbaeva et al. from simulated data",
        settings,
    );
    let table_one = exhibits::table_one(&results, &configurations);
    let calibration = best_table(&curves, &base);
    exhibits::exhibits(
        &mut page,
        exhibits::steps(&plan)?,
        (&curves, &calibration),
        &table_one,
        &results,
        &names,
    )?;
    study.claim.check()?;
    page.save()?;
    print_table(&table_one)?;
    print("\n")?;
    print_table(&calibration)?;
    tell(format_args!(
        "wrote report, figures and data to {}",
        out.display()
    ));
    Ok(())
}

// The configurations of Table 1 with these names, in its order; all if `wanted` is empty.
fn of_table_one(
    registry: &Registry,
    wanted: &[String],
) -> anyhow::Result<Vec<(Configuration, Published)>> {
    given_once(wanted)?;
    let mut all = registry.published()?;
    let known: Vec<String> = all.iter().map(|(own, _)| own.name.clone()).collect();
    // Only configurations of Table 1 have published values to compare with.
    if let Some(name) = wanted.iter().find(|name| !known.contains(name)) {
        bail!(
            "--submission: not in Table 1 (found {name}, expected one of {}). Try: shearq study --submission {name}",
            known.join(", ")
        );
    }
    all.retain(|(own, _)| wanted.is_empty() || wanted.contains(&own.name));
    Ok(all)
}

//! `shearq reproduce`.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use shearq_submissions::{Configuration, Published, Registry};

use crate::arguments::{SetList, Threads, given_once};
use crate::paper::sets::{Plan, RAW, SCORES};
use crate::paper::{lambda, sets};
use crate::progress::{Bar, mark_resumable};
use crate::{made_by, print, print_table, tell};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_dataset::run::claim;
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::{measurers, simulated_steps};
use shearq_pipeline::simulate::simulator;
use shearq_render::figure::ImageRow;
use shearq_render::page::Page;
use shearq_results::views::pages::{steps_figure, steps_row};
use shearq_simulate::set::SimulationSettings;

/// Reproduce the figures and tables of Nurbaeva et al. (2015) on simulated data.
///
/// Sect. 4: the regularisation parameter λ on synthetic galaxies (Figs 4 to 7). Sect. 5: the seven configurations of
/// Table 1 on 24 sets (Table 1, Figs 8 to 11), simulated and measured in memory.
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
    /// Number of synthetic galaxies for λ; Nurbaeva et al. (2015) have 10000.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(10..=1_000_000))]
    galaxies: u64,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED", default_value_t = 2013)]
    seed: u64,
    #[command(flatten)]
    threads: Threads,
}

const SECT_THREE: &str = "The network deconvolves a stamp. The ellipticity is measured on the autocorrelation (ACF) of the result, after subtracting the mean of its edge. The ACF is clipped at the radius that contains 89 % of the largest enclosed light.";
const SECT_FOUR: &str = "Exponential galaxies are convolved with a Moffat PSF each and have white noise of 10 to 40 dB. Both updating rules deconvolve them with λ from 10⁻⁶ to 10⁶. All data are simulated.";
const SECT_FIVE: &str = "Configurations of Table 1 on sets of Table 2. The images are simulated, not the challenge's. Unpublished properties are chosen here: distributions of S/N and size, PSF fields and shear spectra. Metrics are for the standard convention and the leaderboard definition. Errors come from the part of the ellipticities that the truth does not explain.";

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
    let plan = Plan {
        version: shearq_dataset::VERSION.into(),
        simulation: SimulationSettings::new(*seed, usize::from(*grid)),
        images: *images,
        configurations: configurations.iter().map(|(own, _)| own.clone()).collect(),
    };
    // The plan has neither the sets nor the galaxies of Sect. 4, on which the report depends.
    let claim = claim(&out.join("plan.json"), &plan, SCORES)?.alone()?;
    let total = sets.len() as u64 * u64::from(*images) * u64::from(*grid).pow(2);
    let mut bar = Bar::new("simulating and measuring", total);
    let results = sets::score_sets(&plan, &sets, (out, &claim), threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("deconvolving", *galaxies);
    // Sect. 4 has one network; the configurations of Table 1 extend its settings.
    let base = registry.get("paper")?.configuration;
    let curves = lambda::calibrate(&base, *galaxies, *seed, threads, &mut bar)?;
    drop(bar);
    let steps = steps(&plan)?;

    let data = format!(
        "simulated: {} sets, {images} images of {grid} × {grid} galaxies",
        sets.len()
    );
    let settings = made_by([
        ("Seed", seed.to_string()),
        ("Data", data),
        ("Galaxies of Sect. 4", galaxies.to_string()),
        ("Settings of Sect. 4", toml::to_string(&base)?),
    ]);
    // The folder may have been removed during hours of work; a page without its results would be made there.
    claim.check()?;
    let mut page = Page::new(
        out,
        "Hopfield Neural Network deconvolution, reproduced",
        "Figures and tables of Nurbaeva et al. from simulated data",
        settings,
    );
    page.section("The method (Sect. 3)", SECT_THREE);
    if !steps.is_empty() {
        page.figure(
            "fig3-steps",
            &steps_figure(RAW, steps),
            "As Fig. 3 of Nurbaeva et al. (2015): from a stamp to its clipped autocorrelation, for a galaxy at S/N 10, 20 and 40.",
        )?;
    }
    page.section("Choice of λ (Sect. 4)", SECT_FOUR);
    lambda::figures(&mut page, &curves)?;
    let best_lambda = lambda::best_table(&curves, *galaxies);
    page.table("lambda", &best_lambda)?;
    page.section("Configurations (Sect. 5)", SECT_FIVE);
    let table_one = sets::table_one(&results, &configurations);
    page.table("table1", &table_one)?;
    sets::figures(&mut page, &results)?;
    page.section("Every set", "The data of the figures per set.");
    page.table("fig8-11-per-set", &sets::per_set_table(&results))?;
    claim.check()?;
    page.save()?;
    print_table(&table_one)?;
    print("\n")?;
    print_table(&best_lambda)?;
    tell(format_args!(
        "wrote report, figures and data to {}",
        out.display()
    ));
    Ok(())
}

// The steps of one galaxy at S/N 10, 20 and 40, as in Fig. 3, if the plan has the configuration of that figure.
fn steps(plan: &Plan) -> Result<Vec<ImageRow>, PipelineError> {
    let configuration = plan.configurations.iter().find(|own| own.name == RAW);
    let measurers = measurers(configuration.map_or(&[][..], std::slice::from_ref))?;
    let mut rows = Vec::new();
    for measurer in &measurers {
        for (set, snr) in [(5, 10), (2, 20), (8, 40)] {
            let simulator = simulator(set, plan.simulation)?;
            if let Some(steps) = simulated_steps(&simulator, measurer, 1, (1, 1))? {
                rows.push(steps_row(&format!("S/N {snr}"), steps));
            }
        }
    }
    Ok(rows)
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
            "--submission: not in Table 1 (found {name}, expected one of {}). Try: shearq run --simulate --submission {name}",
            known.join(", ")
        );
    }
    all.retain(|(own, _)| wanted.is_empty() || wanted.contains(&own.name));
    Ok(all)
}

//! `shearq reproduce`.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use shearq_submissions::{Configuration, Published, Registry};

use crate::arguments::{SetList, Threads, given_once};
use crate::progress::{Bar, goes_on};
use crate::{made_by, print, print_table, tell};
use shearq_dataset::layout::MAX_IMAGE;
use shearq_pipeline::run::{measurers, simulated_steps};
use shearq_pipeline::simulate::simulator;
use shearq_render::page::Page;
use shearq_results::views::steps::{steps_figure, steps_row};
use shearq_simulate::set::SimulationSettings;
use shearq_studies::calibration::{self, calibrate};
use shearq_studies::exhibits;
use shearq_studies::reproduce::{Plan, SetResult, Study, run_sets};

/// Reproduce the figures and tables of the paper on simulated data.
///
/// Sect. 4: calibration of λ on synthetic galaxies (Figs 4 to 7). Sect. 5: the seven configurations of Table 1 on 24
/// sets (Table 1, Figs 8 to 11), simulated and measured in memory.
///
/// The command writes an HTML report, figures as PNG and SVG, and their data as CSV and Parquet. Finished sets are
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
    goes_on();
    let Arguments {
        out,
        images,
        grid,
        sets,
        submission,
        galaxies,
        seed,
        threads,
    } = arguments;
    let threads = threads.number();
    given_once(submission)?;
    let sets = sets.simulated()?;
    let registry = Registry::embedded()?;
    let configurations = of_table_one(&registry, submission)?;
    let plan = Plan {
        version: shearq_dataset::VERSION.into(),
        simulation: SimulationSettings::new(*seed, usize::from(*grid)),
        images: *images,
        configurations: configurations.iter().map(|(s, _)| s.clone()).collect(),
    };
    let total = sets.len() as u64 * u64::from(*images) * u64::from(*grid).pow(2);
    let mut bar = Bar::new("simulating and measuring", total);
    let study = Study::open(&plan, out)?;
    let results = run_sets(&study, sets, threads, &mut bar)?;
    drop(bar);
    let mut bar = Bar::new("calibrating", *galaxies);
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
    study.check()?;
    let mut page = Page::new(
        out,
        "Hopfield Neural Network deconvolution, reproduced",
        "Figures and tables of Nurbaeva et al. from simulated data",
        settings,
    );
    let table_one = exhibits::table_one(&results, &configurations);
    let names: Vec<String> = names(&configurations);
    let calibration = calibration::best_table(&curves, &base);
    method(&mut page, &plan)?;
    page.section("Calibration of λ (Sect. 4)", SECT_FOUR);
    calibration::figures(&mut page, &curves)?;
    page.table("calibration", &calibration)?;
    page.data("fig5-7-lambda", &calibration::curves_table(&curves))?;
    page.section("Configurations (Sect. 5)", SECT_FIVE);
    page.table("table1", &table_one)?;
    sect_five(&mut page, &results, &names)?;
    study.check()?;
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

const SECT_THREE: &str = "The network deconvolves a stamp. The ellipticity is measured on the autocorrelation (ACF) of the result, after subtracting the mean of its edge. The ACF is clipped at the radius that contains 89 % of the largest enclosed light.";
const SECT_FOUR: &str = "Exponential galaxies are convolved with a Moffat PSF each and have white noise of 10, 20 or 40 dB. Both updating rules deconvolve them with λ from 10⁻⁶ to 10⁶. All data are simulated.";
const SECT_FIVE: &str = "Configurations of Table 1 on sets of Table 2. The images are simulated, not the challenge's. Unpublished properties are chosen here: distributions of S/N and size, PSF fields and shear spectra. Metrics are for the standard convention and the leaderboard definition. Errors come from the part of the ellipticities that the truth does not explain.";

// The configurations of Table 1 with these names, in its order; all if `wanted` is empty.
fn of_table_one(
    registry: &Registry,
    wanted: &[String],
) -> anyhow::Result<Vec<(Configuration, Published)>> {
    let all = registry.published()?;
    let known = names(&all);
    if let Some(name) = wanted.iter().find(|name| !known.contains(name)) {
        bail!(
            "--submission: not in Table 1 (found {name}, expected one of {}). Try: shearq study --submission {name}",
            known.join(", ")
        );
    }
    let chosen = |name: &String| wanted.is_empty() || wanted.contains(name);
    Ok(all.into_iter().filter(|(s, _)| chosen(&s.name)).collect())
}

// Fig. 3: the steps of one galaxy at S/N 10, 20 and 40.
fn method(page: &mut Page<'_>, plan: &Plan) -> anyhow::Result<()> {
    page.section("The method (Sect. 3)", SECT_THREE);
    let name = "23/raw/star";
    let Some(submission) = plan.configurations.iter().find(|s| s.name == name) else {
        return Ok(());
    };
    let mut rows = Vec::new();
    for (set, snr) in [(5, 10), (2, 20), (8, 40)] {
        let simulator = simulator(set, plan.simulation)?;
        let measurer = &measurers(std::slice::from_ref(submission))?[0];
        if let Some(steps) = simulated_steps(&simulator, measurer, 1, (1, 1))? {
            rows.push(steps_row(&format!("S/N {snr}"), steps));
        }
    }
    page.figure(
        "fig3-steps",
        &steps_figure(name, rows),
        "As Fig. 3 of the paper: from a stamp to its clipped autocorrelation, for a galaxy at S/N 10, 20 and 40.",
    )?;
    Ok(())
}

fn names(configurations: &[(Configuration, Published)]) -> Vec<String> {
    configurations.iter().map(|(s, _)| s.name.clone()).collect()
}

// Figs 8 to 11 and their tables.
fn sect_five(page: &mut Page<'_>, results: &[SetResult], names: &[String]) -> anyhow::Result<()> {
    let images = results.first().map_or(0, |set| set.images);
    page.figure(
        "fig8-q-per-set",
        &exhibits::q_per_set(results, names),
        "As Fig. 8 of the paper: quality factor per set and configuration.",
    )?;
    let place = |name: &str| names.iter().position(|n| n == name);
    if let (Some(raw), Some(den)) = (place("23/raw/star"), place("23/den/star")) {
        let both = [(raw, "23/raw/star"), (den, "23/den/star")];
        page.table("denoising", &exhibits::denoising_table(results, &both))?;
        page.figure(
            "fig9-power-spectra",
            &exhibits::power_spectra(results, den, "23/den/star"),
            &format!("As Fig. 9 of the paper: true and measured shear power spectra of 23/den/star. The measured spectra contain the noise of {images} images."),
        )?;
        let spectra = exhibits::power_spectra_table(results, den);
        page.data("fig9-power-spectra", &spectra)?;
        let title = "Multiplicative bias per set";
        page.figure(
            "fig10-multiplicative",
            &exhibits::bias_per_set(results, &both, |f| f.m_half, title, "M/2"),
            "As Fig. 10 of the paper: multiplicative bias per set.",
        )?;
        let title = "Additive bias per set";
        page.figure(
            "fig11-additive",
            &exhibits::bias_per_set(results, &both, |f| f.sqrt_a, title, "√A × 10⁴"),
            "As Fig. 11 of the paper: additive bias per set.",
        )?;
    }
    page.section("Every set", "The data of the figures per set.");
    page.table("fig8-11-per-set", &exhibits::per_set_table(results))?;
    Ok(())
}

//! `shearq simulate`.

use std::path::PathBuf;

use clap::Args;

use crate::arguments::{SetList, Sharding, SimulationArguments, Threads};
use crate::progress::{Bar, goes_on};
use crate::tell;
use shearq_pipeline::data::layout::DataFolder;
use shearq_pipeline::data::pattern::MAX_IMAGE;
use shearq_pipeline::images;
use shearq_pipeline::simulate::{SimulationRecord, simulate_folder};

/// Write simulated GREAT10-like sets: images, PSFs, true shear, intrinsic shapes.
///
/// The sets follow Table 2 of the paper. Sets 1 to 3 have galaxies of bulge and disc at S/N 20 and a Moffat PSF of
/// 3.4 px. The others differ by S/N 10 (4 to 6), S/N 40 (7 to 9), many S/N (10 to 12); small (13, 14), large (15, 16)
/// and many sizes (17, 18); a Kolmogorov PSF (19, 20); many bulge fractions (21, 22); displaced bulges (23, 24).
///
/// S/N is √(Σ I²)/σ before lensing and behind a round PSF. Images that the same settings made are kept, so the same
/// command resumes a stopped simulation.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Sets, as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST")]
    sets: SetList,
    /// Images per set.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: u32,
    #[command(flatten)]
    simulation: SimulationArguments,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    sharding: Sharding,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    goes_on();
    let Arguments {
        sets,
        images,
        simulation,
        out,
        sharding,
        threads,
    } = arguments;
    let record = SimulationRecord {
        version: shearq_pipeline::VERSION.into(),
        settings: simulation.settings()?,
    };
    let images = sharding.part(&images::of_simulation(sets.simulated()?, *images));
    let galaxies = images.len() as u64 * (record.settings.grid as u64).pow(2);
    let mut bar = Bar::new("simulating", galaxies);
    let data = DataFolder::new(out);
    let (made, already) = simulate_folder(&record, &images, &data, threads.number(), &mut bar)?;
    drop(bar);
    tell(format_args!(
        "{made} images simulated, {already} there already, in {}",
        out.display()
    ));
    Ok(())
}

//! `shearq simulate`.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{SetList, Threads};
use super::progress::Bar;
use crate::io::layout::DataFolder;
use crate::pipeline::simulate::{SimulationRecord, simulate_folder};
use crate::simulate::field::ShearSpectrum;
use crate::simulate::set::SimulationSettings;

/// Write simulated GREAT10-like sets: images, PSFs, true shear, intrinsic shapes.
///
/// The sets are those of the paper's Table 2. Images already in the folder are kept if the same
/// settings made them, so a stopped simulation goes on where it was.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Sets, as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST")]
    sets: SetList,
    /// Images per set.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=999))]
    images: u32,
    /// Galaxies a side of an image.
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u16).range(8..=400))]
    grid: u16,
    /// Seed of all random numbers.
    #[arg(long, value_name = "SEED")]
    seed: u64,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Factor on the shear power spectrum.
    #[arg(long, value_name = "A", default_value_t = 1.0)]
    amplitude: f64,
    /// Extra slope of the shear power spectrum, about ℓ = 1000.
    #[arg(
        long,
        value_name = "T",
        default_value_t = 0.0,
        allow_negative_numbers = true
    )]
    tilt: f64,
    #[command(flatten)]
    threads: Threads,
}

/// Standard deviation of the intrinsic ellipticities per component.
pub(super) const INTRINSIC_SIGMA: f64 = 0.14;

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        sets,
        images,
        grid,
        seed,
        out,
        amplitude,
        tilt,
        threads,
    } = arguments;
    anyhow::ensure!(
        amplitude.is_finite() && *amplitude >= 0.0 && tilt.is_finite(),
        "--amplitude is {amplitude} and --tilt {tilt}; expected finite numbers, the amplitude not negative"
    );
    let record = SimulationRecord {
        version: crate::VERSION.into(),
        settings: SimulationSettings {
            seed: *seed,
            grid: usize::from(*grid),
            spectrum: ShearSpectrum {
                amplitude: *amplitude,
                tilt: *tilt,
            },
            intrinsic_sigma: INTRINSIC_SIGMA,
        },
    };
    let galaxies = sets.0.len() as u64 * u64::from(*images) * u64::from(*grid).pow(2);
    let mut bar = Bar::new("simulating", galaxies);
    let data = DataFolder::new(out);
    let (made, already) =
        simulate_folder(&record, &sets.0, *images, &data, threads.number(), &mut bar)?;
    drop(bar);
    eprintln!(
        "{made} images simulated, {already} there already, in {}",
        out.display()
    );
    Ok(())
}

//! `shearq quickstart`.

use std::path::{Path, PathBuf};

use clap::Args;
use shearq_scoring::Options;
use shearq_submissions::Registry;

use super::arguments::{ScoreSettings, Threads};
use super::progress::{Bar, goes_on};
use super::{measure, print, print_table, tell};
use crate::io::layout::DataFolder;
use crate::io::run::{Run, Source};
use crate::io::table::FileFormat;
use crate::pipeline::images;
use crate::pipeline::simulate::{SimulationRecord, simulate_folder};
use crate::report::comparison::compare;
use crate::report::scores::per_set;
use crate::results::compare::score_all;
use crate::results::score::{OWN, score_folder};
use crate::simulate::set::SimulationSettings;

/// The whole chain on a small simulated default: simulate, measure with three submissions, score,
/// compare. Takes well under two minutes.
///
/// It runs what these commands would: `simulate --sets 2,8 --images 10 --grid 40 --seed 2013`, then
/// `measure` and `score --convention 5` with 23/raw/star, 23/den/star and 48/linear/star, then
/// `compare --convention 5`. The data are simulated,
/// and few: the errors printed are what tells whether a difference is one.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-quickstart")]
    out: PathBuf,
    #[command(flatten)]
    threads: Threads,
}

const SETS: [u32; 2] = [2, 8];
const IMAGES: u32 = 10;
const GRID: usize = 40;
const SEED: u64 = 2013;
const SUBMISSIONS: [&str; 3] = ["23/raw/star", "23/den/star", "48/linear/star"];

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    goes_on();
    let Arguments { out, threads } = arguments;
    let threads = threads.number();
    let data = DataFolder::new(out.join("data"));
    let record = SimulationRecord {
        version: crate::VERSION.into(),
        settings: SimulationSettings::new(SEED, GRID),
    };
    let galaxies = (SETS.len() * IMAGES as usize * GRID * GRID) as u64;
    let mut bar = Bar::new("simulating", galaxies);
    let images = images::of_simulation(&SETS, IMAGES);
    simulate_folder(&record, &images, &data, threads, &mut bar)?;
    drop(bar);
    tell(format_args!(
        "simulated sets {SETS:?}, {IMAGES} images of {GRID} × {GRID} galaxies each, in {}",
        data.root().display()
    ));
    let registry = Registry::embedded()?;
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let mut folders = Vec::new();
    for name in SUBMISSIONS {
        let folder = out.join(name.replace('/', "-"));
        let submission = registry.get(name)?.submission;
        let run = Run::new(
            Source::folder(&data, &folder)?,
            submission,
            FileFormat::default(),
        );
        measure::measure(&run, &data, &folder, &images, threads)?;
        let scored = score_folder(&data, &folder, &run, &[], options, threads)?;
        let title = format!("Scores of {name} (simulated data)");
        let table = per_set(&scored, &title, options.definition);
        print_table(&table)?;
        print("\n")?;
        folders.push(folder);
    }
    let way = ScoreSettings::default().way();
    let variants = score_all(&folders, &[], None, way, threads)?;
    let table = compare(&variants, options.definition);
    print_table(&table)?;
    tell(format_args!(
        "\nWith few images Q rewards submissions that shrink noise and shear alike: compare m (cross) too, which\nis zero for an unbiased one.\n\nNext: {}",
        next_step(out)
    ));
    Ok(())
}

fn next_step(out: &Path) -> String {
    format!(
        "shearq show --submission 48/linear/star --data {} --galaxy 8/1/1 --out galaxy.png",
        out.join("data").display()
    )
}

//! `shearq quickstart`.

use std::path::{Path, PathBuf};

use clap::Args;
use shearq_scoring::Options;
use shearq_submissions::Registry;

use crate::arguments::{ScoreSettings, Threads};
use crate::progress::{Bar, goes_on};
use crate::{measure, print, print_table, tell};
use shearq_files::table::FileFormat;
use shearq_pipeline::data::layout::DataFolder;
use shearq_pipeline::data::run::{Run, Source};
use shearq_pipeline::images;
use shearq_pipeline::simulate::{SimulationRecord, simulate_folder};
use shearq_render::html::Block;
use shearq_results::compare::{by_name, score_all};
use shearq_results::score::{OWN, score_folder};
use shearq_results::views::comparison::{compare, q_heat_map};
use shearq_results::views::pages;
use shearq_results::views::scores::{per_set, verdict_line};
use shearq_results::views::verdict::verdict;
use shearq_simulate::set::SimulationSettings;

/// Simulate a small data set, measure it with three configurations, score and compare them.
///
/// It takes less than two minutes and runs these commands: `simulate --sets 2,8 --images 10 --grid 60 --seed 2013`,
/// then `measure` and `score --convention 5` for 23/raw/star, 23/den/star and 48/linear/star, then
/// `compare --convention 5`. It also writes report.html. The data are simulated and few, so judge differences by the
/// printed errors.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-quickstart")]
    out: PathBuf,
    #[command(flatten)]
    threads: Threads,
}

const SETS: [u32; 2] = [2, 8];
const IMAGES: u32 = 10;
const GRID: usize = 60;
const SEED: u64 = 2013;
const SUBMISSIONS: [&str; 3] = ["23/raw/star", "23/den/star", "48/linear/star"];

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    goes_on();
    let Arguments { out, threads } = arguments;
    let threads = threads.number();
    let data = DataFolder::new(out.join("data"));
    let record = SimulationRecord {
        version: shearq_pipeline::VERSION.into(),
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
    let (mut folders, mut sections) = (Vec::new(), Vec::new());
    let mut made_by = vec![(
        "Simulation".to_owned(),
        serde_json::to_string(&record.settings)?,
    )];
    for name in SUBMISSIONS {
        let folder = out.join(name.replace('/', "-"));
        let submission = registry.get(name)?.configuration;
        let run = Run::new(
            Source::folder(&data, &folder)?,
            submission,
            FileFormat::default(),
        );
        measure::measure(&run, &data, &folder, &images, threads)?;
        let scored = score_folder(&data, &folder, &run, &[], options, threads)?;
        let title = format!("Scores of {name} (simulated data)");
        let mut table = per_set(&scored, &title, options.definition);
        table.notes.extend(verdict_line(name, &scored));
        print_table(&table.narrow())?;
        print("\n")?;
        sections.push(pages::scores(name, &scored, table)?);
        made_by.push((name.to_owned(), toml::to_string(&run.configuration)?));
        folders.push(folder);
    }
    let way = ScoreSettings::default().way();
    let variants = score_all(&folders, &[], None, way, threads)?;
    let table = compare(&variants, options.definition);
    print_table(&table.narrow())?;
    let records = by_name(&variants);
    let mut comparison = pages::comparison(table, &q_heat_map(&records))?;
    if let Some(verdict) = verdict(&records) {
        comparison.blocks.insert(0, Block::Text(verdict));
    }
    sections.insert(0, comparison);
    let report = out.join("report.html");
    pages::save(&report, "Quickstart (simulated data)", sections, made_by)?;
    tell(format_args!(
        "\nreport in {}\nNext: {}",
        report.display(),
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

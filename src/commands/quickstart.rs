use std::path::PathBuf;

use clap::Args;
use shearq_scoring::Options;
use shearq_submissions::Registry;

use crate::arguments::Threads;
use crate::progress::{Bar, mark_resumable};
use crate::{print, print_table, tell};
use shearq_dataset::images;
use shearq_dataset::run::{Run, Source};
use shearq_files::table::FileFormat;
use shearq_pipeline::run::run_folder;
use shearq_render::terminal::wrapped;
use shearq_results::catalogues::OWN;
use shearq_results::compare::score_all;
use shearq_results::score::ScoredSet;
use shearq_results::views::comparison::{
    compact, compare, named, q_per_set, verdict, verdict_line,
};
use shearq_results::views::pages;
use shearq_results::views::scores::per_set;
use shearq_simulate::set::{FixedPsf, SimulationSettings};

/// Simulate a small data set, measure it with three configurations, and compare them.
///
/// It takes less than a minute and writes some megabytes. It runs `run --simulate --sets 2,8 --images 10 --grid 60
/// --seed 2013` for 23/raw/star, 23/den/star and 48/linear/star, then `compare --convention 5`. It also writes report.html
/// with all metrics and plots. The data are simulated and few, so judge differences by the printed errors.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-quickstart")]
    out: PathBuf,
    /// Print the scores of each configuration and the full comparison, too.
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    threads: Threads,
}

// The fiducial set and one of S/N 40. Ten images of each are measured by all three configurations within a minute.
const SETS: [u32; 2] = [2, 8];
const IMAGES: u32 = 10;
const GRID: usize = 60;
const SEED: u64 = 2013;
const SUBMISSIONS: [&str; 3] = ["23/raw/star", "23/den/star", "48/linear/star"];

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let Arguments { out, wide, threads } = arguments;
    let threads = threads.number();
    // One PSF a set: each configuration is measured within seconds.
    let settings = SimulationSettings {
        fixed_psf: FixedPsf::One,
        ..SimulationSettings::new(SEED, GRID)
    };
    let galaxies = (SETS.len() * IMAGES as usize * GRID * GRID) as u64;
    let images = images::of_simulation(&SETS, IMAGES);
    // Progress and advice go to standard error, so that the comparison can be piped.
    tell(format_args!(
        "simulating and measuring sets {SETS:?}: {IMAGES} images of {GRID} × {GRID} galaxies each"
    ));
    let registry = Registry::embedded()?;
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let (mut folders, mut sections) = (Vec::new(), Vec::new());
    let mut made_by = vec![("Simulation".to_owned(), serde_json::to_string(&settings)?)];
    for name in SUBMISSIONS {
        let folder = out.join(name.replace('/', "-"));
        let run = Run::new(
            Source::Simulated(settings),
            registry.get(name)?.configuration,
            FileFormat::default(),
        );
        let mut bar = Bar::new(name, galaxies);
        run_folder(&run, settings, &images, &folder, threads, &mut bar)?;
        drop(bar);
        made_by.push((name.to_owned(), toml::to_string(&run.configuration)?));
        folders.push(folder);
    }
    let mut variants = score_all(&folders, &[], None, None, options, threads)?;
    for variant in &mut variants {
        let (name, scored) = (&variant.name, variant.scored());
        let title = format!("Scores of {name} (simulated data)");
        let mut table = per_set(&scored, &title, options.definition);
        table.notes.extend(verdict_line(name, &scored));
        match wide {
            true => print_table(&table)?,
            false => tell(format_args!("{name}: {}", q_of(&scored))),
        }
        sections.push(pages::scores(name, &scored, table)?);
        // Published metrics are means over 200 images of all sets, and would look like a failure next to these two sets.
        variant.published = None;
    }
    let full = compare(&variants, options.definition);
    print("\n")?;
    print_table(&compact(&variants))?;
    if *wide {
        print_table(&full)?;
    }
    let rows = named(&variants);
    let verdict = verdict(&rows);
    let comparison = pages::comparison(full, verdict.clone(), &q_per_set(&rows))?;
    if let Some(verdict) = verdict {
        print(&format!("\n{}\n", wrapped(&verdict, Some(80))))?;
    }
    sections.insert(0, comparison);
    let report = out.join("report.html");
    pages::save(&report, "Quickstart (simulated data)", sections, made_by)?;
    tell(format_args!(
        "\nreport with all metrics and plots: {}\nNext: measure your own images (docs/own-images.md).",
        report.display()
    ));
    Ok(())
}

fn q_of(scored: &[ScoredSet]) -> String {
    let sets = scored.iter().map(|set| {
        let record = &set.record;
        let (q, error) = (record.metrics.q, record.errors.q);
        format!("Q = {q:.1} ± {error:.1} in set {}", record.set)
    });
    sets.collect::<Vec<_>>().join(", ")
}

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use shearq_scoring::Options;

use crate::arguments::{ReportFile, SetList, SimulationArguments, sets_of};
use crate::measure::Measuring;
use crate::progress::{Bar, mark_resumable};
use crate::{measure, print_table, score, tell};
use shearq_dataset::images;
use shearq_dataset::layout::MAX_IMAGE;
use shearq_dataset::run::{Run, Source, open_data};
use shearq_dataset::truth::truth_is_there;
use shearq_files::atomic;
use shearq_pipeline::run::run_folder;
use shearq_render::table::{Table, TableFormat};
use shearq_results::catalogues::{Catalogues, OWN};
use shearq_results::score::{ScoredSet, score_catalogues};
use shearq_results::store;
use shearq_results::views::comparison::verdict_line;
use shearq_results::views::pages;
use shearq_results::views::scores::{bandpowers, per_set};

/// Measure and score in one step, on a data folder or on simulated sets.
///
/// With --simulate, stamps are drawn, measured and discarded. Only catalogues are stored, even for a whole challenge
/// (`--sets all --images 200`, 48 million galaxies). The catalogues are equal to the output of `simulate` and `measure`.
/// Scores and bandpowers are printed and written next to the catalogues as scores.csv and bandpowers.csv. The same command
/// continues a run that was stopped. With --shard, `merge` scores when all shards are done.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    measuring: Measuring,
    /// Data folder.
    #[arg(long, value_name = "DIR", required_unless_present = "simulate")]
    data: Option<PathBuf>,
    /// Simulate the data in memory.
    #[arg(long, conflicts_with = "data", requires_all = ["sets", "images"])]
    simulate: bool,
    /// Sets, as `1,2,7-9` or `all` [default with --data: all].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Images per set, with --simulate.
    #[arg(long, value_name = "N", conflicts_with = "data", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    #[command(flatten)]
    simulation: SimulationArguments,
    /// Results store for the scores, which `compare --store` reads.
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,
    #[command(flatten)]
    report: ReportFile,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let Arguments {
        measuring,
        sets,
        images,
        simulation,
        store,
        report,
        ..
    } = arguments;
    let (out, shard) = (&measuring.out, measuring.sharding.shard);
    anyhow::ensure!(
        shard.is_none() || (store.is_none() && !report.is_wanted()),
        "a shard is not scored (found --shard with --store or --report). Try: shearq score --measured {} --store DIR, after `shearq merge`",
        out.display()
    );
    // Before hours of work: a store that cannot be written is an error at once.
    let _prepared = store.as_deref().map(store::prepare).transpose()?;
    let threads = measuring.threads();
    let wanted = match sets {
        Some(list) if arguments.simulate => list.simulated()?,
        list => sets_of(list.as_ref()).to_vec(),
    };
    let data = arguments.data.as_deref().map(open_data).transpose()?;
    let source = match &data {
        Some(data) => {
            simulation.must_be_unused()?;
            Source::folder(data, out)?
        }
        None => Source::Simulated(simulation.settings()?),
    };
    let run = measuring.run(source)?;
    match (&run.source, &data) {
        (Source::Simulated(settings), _) => {
            // Clap requires --images with --simulate.
            let images = images::of_simulation(&wanted, images.unwrap_or(1));
            let images = measuring.sharding.part(&images);
            let galaxies = images.len() as u64 * (settings.grid as u64).pow(2);
            let mut bar = Bar::new("simulating and measuring", galaxies);
            let start = Instant::now();
            let summary = run_folder(&run, *settings, &images, out, threads, &mut bar)?;
            drop(bar);
            measure::report(&run, &summary, start.elapsed(), threads, out)?;
        }
        (Source::Folder { .. }, Some(data)) => {
            let images = measuring.images(&run, data, &wanted)?;
            // Before hours of work that could not be scored. Other shards are scored by `merge`.
            for id in images.iter().filter(|_| shard.is_none()) {
                truth_is_there(&data.truth(id.set))?;
            }
            measure::measure(&run, data, out, &images, threads)?;
        }
        // A folder as source comes from `data`.
        (Source::Folder { .. }, None) => {}
    }
    // Other shards may not be done, and scores of a part of the images would look like those of all.
    if let Some(shard) = shard {
        let expected = [
            sets.as_ref().map(|list| format!(" --sets {list}")),
            images.map(|images| format!(" --images {images}")),
        ];
        tell(format_args!(
            "shard {shard} is done. Score when all are done: shearq merge {}{} --shards {}",
            out.display(),
            expected.map(Option::unwrap_or_default).concat(),
            shard.of()
        ));
        return Ok(());
    }
    let scored = score(&run, out, &wanted, store.as_deref(), threads)?;
    let title = format!("Scores of {}", run.configuration.name);
    let name = &run.configuration.name;
    let sections = || Ok(vec![pages::scores(name, &scored.0, scored.1)?]);
    report.save(&title, sections, || score::made_by(&run, out))
}

// Also for `merge`. Scores and bandpowers are stored next to the catalogues, so that a run without a terminal keeps them.
pub(super) fn score(
    run: &Run,
    out: &Path,
    sets: &[u32],
    store: Option<&Path>,
    threads: usize,
) -> anyhow::Result<(Vec<ScoredSet>, Table)> {
    // Own catalogues are in the standard convention, so that it is not searched for.
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let data = run.source.data(out)?;
    let catalogues = Catalogues::measured(run, out, sets)?;
    let scored = score_catalogues(&data, &catalogues, sets, options, threads)?;
    if let Some(store) = store {
        score::record(store, &catalogues, &data, &scored, options)?;
    }
    let title = format!("Scores of {}", run.configuration.name);
    let mut table = per_set(&scored, &title, options.definition);
    let verdict = verdict_line(&run.configuration.name, &scored);
    table.notes.extend(verdict);
    for (name, table) in [("scores", &table), ("bandpowers", &bandpowers(&scored))] {
        let text = table.render(TableFormat::Csv);
        atomic::write(out.join(format!("{name}.csv")), text.as_bytes())?;
    }
    print_table(&table.narrow())?;
    Ok((scored, table))
}

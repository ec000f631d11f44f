use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;

use crate::arguments::{SetList, Threads, sets_of};
use crate::progress::{Bar, mark_resumable};
use crate::{Findings, count, print, run, tell, tell_unread};
use shearq_dataset::images::{self, ImageId, Shard};
use shearq_dataset::layout::{DataFolder, MAX_IMAGE, check_folder};
use shearq_dataset::run::{
    RUN_FILE, Run, SIMULATION_FILE, SimulationRecord, Source, claim, read_record,
};
use shearq_files::open::is_there;
use shearq_pipeline::complete::{Fault, Results};

/// Check that a folder written in shards is complete, and score it as `run` does.
///
/// For each image, the command checks that the results exist, are readable, have a row per galaxy and were made with
/// the folder's settings. It prints missing or damaged images as SET/IMAGE and does not score them. To complete the
/// folder, repeat the command that wrote it, with or without --shard.
///
/// Scores and bandpowers are written to scores.csv and bandpowers.csv in the folder. Folders by `simulate` and
/// catalogues of data without true shear are only checked.
///
/// Exit code 0: complete; 1: images are missing or damaged.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder that `run`, `measure` or `simulate` wrote with --shard.
    out: PathBuf,
    /// Expected sets, as given to `run` or `simulate` [default for a data folder: all its sets].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Expected images per set, as given to `run --simulate` or `simulate`.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    /// Number of shards; prints which shards to run again.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    shards: Option<u32>,
    /// Remove damaged results, so that the next run makes them again.
    #[arg(long)]
    discard_damaged: bool,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let out = &arguments.out;
    check_folder(
        out,
        "a folder that `run`, `measure` or `simulate` wrote with --shard",
    )?;
    if let Some(run) = Run::read(out)? {
        return merge_run(arguments, &run);
    }
    let path = out.join(SIMULATION_FILE);
    let record: SimulationRecord = read_record(&path)?.with_context(|| {
        format!(
            "{}: found neither {RUN_FILE} nor {SIMULATION_FILE}; expected a folder that `run`, `measure` or `simulate` wrote",
            out.display()
        )
    })?;
    let data = DataFolder::open(out)?;
    // Other processes may still write to the folder, but none with other settings.
    let _claim = claim(&path, &record, &data.layout().galaxies)?;
    let results = Results::Images {
        record: &record,
        data: &data,
    };
    require_complete(arguments, &results, &simulated_images(arguments)?)
}

fn merge_run(arguments: &Arguments, run: &Run) -> anyhow::Result<()> {
    let out = &arguments.out;
    let _claim = run.claim(out)?;
    let data = run.source.data(out)?;
    let sets = sets_of(arguments.sets.as_ref());
    let images = match &run.source {
        // The record has no list of images; a data folder shows them.
        Source::Simulated(_) => simulated_images(arguments)?,
        Source::Folder { .. } => {
            anyhow::ensure!(
                arguments.images.is_none(),
                "--images applies to simulated data only; every image of {} is expected. Try: without --images",
                run.source
            );
            let images = run.images(&data, sets)?;
            tell_unread(data.images(sets)?.unread());
            images
        }
    };
    let results = Results::Catalogues {
        run,
        data: &data,
        out,
    };
    require_complete(arguments, &results, &images)?;
    // Survey data have no true shear, and are complete without a score.
    if images.iter().any(|id| is_there(&data.truth(id.set))) {
        run::score(run, out, sets, None, arguments.threads.number())?;
        return Ok(());
    }
    tell(format_args!(
        "note: not scored, because {} has no true shear",
        data.root().display()
    ));
    Ok(())
}

// The record of a simulation does not list its images, because shards with other images share it.
fn simulated_images(arguments: &Arguments) -> anyhow::Result<Vec<ImageId>> {
    match (&arguments.sets, arguments.images) {
        (Some(sets), Some(images)) => Ok(images::of_simulation(&sets.simulated()?, images)),
        _ => anyhow::bail!(
            "{}: cannot determine the expected images of simulated data. Try: --sets LIST --images N",
            arguments.out.display()
        ),
    }
}

fn require_complete(
    arguments: &Arguments,
    results: &Results<'_>,
    images: &[ImageId],
) -> anyhow::Result<()> {
    let out = arguments.out.display();
    let mut bar = Bar::new("checking", results.galaxies(images));
    let faults = results.faults(images, arguments.threads.number(), &mut bar)?;
    drop(bar);
    if faults.is_empty() {
        tell(format_args!(
            "{out}: complete, {}",
            count(images.len(), "image")
        ));
        return Ok(());
    }
    let mut text = String::new();
    for fault in &faults {
        let ImageId { set, image } = fault.id;
        let shard = shard_of(fault, arguments.shards);
        let shard = shard.map_or_else(String::new, |shard| format!(" (shard {shard})"));
        text.push_str(&format!("{set}/{image}{shard}: {}\n", fault.error));
    }
    // The number last, because a terminal shows the end of a long list.
    text.push_str(&format!(
        "{out}: {} of {} images are missing or damaged\n",
        faults.len(),
        images.len()
    ));
    let of_faults = faults.iter();
    let shards: BTreeSet<u32> = of_faults
        .filter_map(|fault| Some(shard_of(fault, arguments.shards)?.number()))
        .collect();
    if !shards.is_empty() {
        let list: Vec<String> = shards.iter().map(u32::to_string).collect();
        text.push_str(&format!("shards to run again: {}\n", list.join(",")));
    }
    print(&text)?;
    if arguments.discard_damaged {
        discard(&faults)?;
    }
    Err(Findings.into())
}

fn shard_of(fault: &Fault, shards: Option<u32>) -> Option<Shard> {
    shards.map(|of| Shard::holding(fault.position, of))
}

fn discard(faults: &[Fault]) -> anyhow::Result<()> {
    // Missing results are among the faults, too.
    let there = |path: &&Path| path.is_file();
    for path in faults.iter().map(|f| f.result.as_path()).filter(there) {
        std::fs::remove_file(path)
            .with_context(|| format!("{}: cannot remove the file", path.display()))?;
        tell(format_args!("removed {}", path.display()));
    }
    Ok(())
}

//! `shearq measure`.

use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::choices::named;
use clap::Args;
use shearq_measure::{Flag, Warning};
use shearq_submissions::Registry;

use crate::arguments::{SetList, Sharding, Threads};
use crate::progress::{Bar, goes_on};
use crate::{count, tell, tell_unread};
use shearq_files::table::FileFormat;
use shearq_pipeline::data::layout::DataFolder;
use shearq_pipeline::data::run::{Run, Source, open_data};
use shearq_pipeline::images::{self, ImageId};
use shearq_pipeline::measure::{Summary, galaxies_to_do, measure_folder};

/// Measure the galaxies of a data folder by a submission: one catalogue per image.
///
/// Catalogues have x, y, e1, e2, flag, iterations, stop and what else tells whether to trust a row;
/// docs/formats.md describes them. Catalogues already in the folder are kept if the same settings
/// made them, so a stopped measurement goes on where it was.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Name of a submission (see `shearq submissions list`) or a TOML file of your own.
    #[arg(long, value_name = "NAME|FILE")]
    submission: String,
    /// Data folder.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Sets to measure [default: all there are].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Format of the catalogues [default: parquet].
    #[arg(long, value_parser = named::<FileFormat>())]
    catalogue_format: Option<FileFormat>,
    #[command(flatten)]
    sharding: Sharding,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    goes_on();
    let Arguments {
        submission,
        data,
        out,
        sets,
        catalogue_format,
        sharding,
        threads,
    } = arguments;
    let submission = Registry::embedded()?.get(submission)?.configuration;
    let data = open_data(data)?;
    let sets = sets.as_ref().map_or(&[][..], |list| &list.0);
    let images = sharding.part(&images::of_folder(&data, sets)?);
    tell_unread(&data.images(sets)?);
    measure(
        &Run::new(
            Source::folder(&data, out)?,
            submission,
            catalogue_format.unwrap_or_default(),
        ),
        &data,
        out,
        &images,
        threads.number(),
    )
}

/// Measures with a progress bar and says what was done.
pub(super) fn measure(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    images: &[ImageId],
    threads: usize,
) -> anyhow::Result<()> {
    let mut bar = Bar::new("measuring", galaxies_to_do(run, data, out, images)?);
    let start = std::time::Instant::now();
    let summary = measure_folder(run, data, out, images, threads, &mut bar)?;
    drop(bar);
    report(run, &summary, start.elapsed(), threads, out);
    measured_any(&summary)
}

/// Refuses results without a single galaxy that could be measured.
pub(super) fn measured_any(summary: &Summary) -> anyhow::Result<()> {
    if summary.galaxies == 0 || summary.flagged < summary.galaxies {
        return Ok(());
    }
    let with = |flag: Flag| {
        let mut counts = summary.flags.iter().zip(Flag::ALL);
        counts
            .find(|(_, other)| *other == flag)
            .map_or(0, |(count, _)| *count as usize)
    };
    all_flagged(with, summary.galaxies as usize)
}

/// The error if all of `galaxies` are flagged, numbers of them `with` each flag.
pub(super) fn all_flagged(with: impl Fn(Flag) -> usize, galaxies: usize) -> anyhow::Result<()> {
    match Warning::of_counts(with, galaxies, galaxies) {
        Some(warning) => anyhow::bail!("no galaxy could be measured: {warning}"),
        None => Ok(()),
    }
}

/// Says on standard error what was done and how fast.
pub(super) fn report(run: &Run, summary: &Summary, elapsed: Duration, threads: usize, out: &Path) {
    let seconds = elapsed.as_secs_f64();
    let speed = if summary.galaxies == 0 {
        String::new()
    } else {
        let each = 1e6 * seconds * threads as f64 / summary.galaxies as f64;
        format!(
            " ({} galaxies, {} flagged) in {seconds:.1} s, {each:.0} µs a galaxy and thread",
            summary.galaxies, summary.flagged
        )
    };
    tell(format_args!(
        "{}: {}{speed}; {} there already, in {}",
        run.configuration.name,
        count(summary.images, "image"),
        summary.already,
        out.display()
    ));
    if summary.flagged > 0 {
        let reasons: Vec<String> = summary
            .flags
            .iter()
            .zip(Flag::ALL)
            .filter(|(count, _)| **count > 0)
            .map(|(count, flag)| format!("{flag} ({count})"))
            .collect();
        tell(format_args!("flagged: {}", reasons.join(", ")));
    }
}

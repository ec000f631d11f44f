use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source, open_data};
use shearq_files::table::FileFormat;
use shearq_measure::Flag;
use shearq_pipeline::measure::{FolderMeasurement, Summary, all_flagged};
use shearq_submissions::Registry;

use crate::arguments::{self, SetList, Sharding, Threads, named, sets_of};
use crate::progress::{Bar, mark_resumable};
use crate::{count, tell, tell_unread};

/// Measure the galaxies of a data folder: one catalogue per image.
///
/// A catalogue has one row per galaxy with its position (x, y), ellipticity (e1, e2), flags, noise and response. See
/// docs/files.md for all columns. A branch of GREAT3 is recognised by its files (docs/great3.md). Catalogues of the same settings that are in the folder already are kept. So the
/// same command continues a measurement that was stopped.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    measuring: Measuring,
    /// Data folder.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Sets to measure [default: all].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// The images of a set are epochs of the same galaxies, as `gather` writes them from several exposures: one catalogue per
    /// set, of the galaxies of its first image. Galaxies are joined by `id`, or else by ra and dec to 0.5″. Stamps are combined
    /// in each Fourier mode with inverse-variance weights before the shape is measured.
    #[arg(long)]
    epochs: bool,
    /// Stack all nine stars of each star field of GREAT3, shifted to the lower-left one, which is used alone otherwise.
    #[arg(long)]
    stack_stars: bool,
    #[command(flatten)]
    summary: arguments::SummaryArguments,
}

/// How to measure, and where to write catalogues.
#[derive(Debug, Clone, Args)]
pub(super) struct Measuring {
    /// Name of a configuration (see `shearq submissions list`), or a TOML file of your own.
    #[arg(long, value_name = "NAME|FILE")]
    submission: String,
    /// Folder for the catalogues.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// File format of the catalogues [default: parquet].
    #[arg(long, value_parser = named::<FileFormat>())]
    catalogue_format: Option<FileFormat>,
    #[command(flatten)]
    pub(super) sharding: Sharding,
    #[command(flatten)]
    threads: Threads,
}

impl Measuring {
    pub(super) fn run(&self, source: Source) -> anyhow::Result<Run> {
        let configuration = Registry::embedded()?.get(&self.submission)?.configuration;
        let format = self.catalogue_format.unwrap_or_default();
        Ok(Run::new(source, configuration, format))
    }

    pub(super) fn images(
        &self,
        run: &Run,
        data: &DataFolder,
        sets: &[u32],
    ) -> anyhow::Result<Vec<ImageId>> {
        let images = self.sharding.part(&run.images(data, sets)?);
        // An image whose name nearly follows the layout would otherwise be absent from the results without notice.
        tell_unread(data.images(sets)?.unread());
        Ok(images)
    }

    pub(super) fn threads(&self) -> usize {
        self.threads.number()
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let Arguments {
        measuring,
        data,
        sets,
        epochs,
        stack_stars,
        summary,
    } = arguments;
    let out = &measuring.out;
    let mut data = open_data(data)?;
    if *stack_stars {
        data = data.with_stacked_stars()?;
    }
    let sets = sets_of(sets.as_ref());
    let mut run = measuring.run(Source::folder(&data, out)?)?;
    run.epochs |= *epochs;
    let images = measuring.images(&run, &data, sets)?;
    let done = measure(&run, &data, out, &images, measuring.threads())?;
    let of_flag = |(count, flag): (&u64, Flag)| (flag.to_string(), (*count).into());
    let flags: serde_json::Map<_, _> = done.flags.iter().zip(Flag::ALL).map(of_flag).collect();
    summary.print(|| {
        serde_json::json!({
            "out": out,
            "submission": run.configuration.name,
            "images": done.images,
            "already": done.already,
            "galaxies": done.galaxies,
            "flagged": done.flagged,
            "flags": flags,
        })
    })
}

pub(super) fn measure(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    images: &[ImageId],
    threads: usize,
) -> anyhow::Result<Summary> {
    // Before the bar, which would hide an error about the first image.
    let work = FolderMeasurement::open(run, data, out, images)?;
    let mut bar = Bar::new("measuring", work.galaxies());
    let start = Instant::now();
    let summary = work.write_catalogues(threads, &mut bar)?;
    drop(bar);
    report(run, &summary, start.elapsed(), threads, out)?;
    Ok(summary)
}

// On standard error, which leaves standard output to results. All galaxies flagged is an error: the cause is a setting or a PSF,
// and a script would go on with a catalogue of NaN.
pub(super) fn report(
    run: &Run,
    summary: &Summary,
    elapsed: Duration,
    threads: usize,
    out: &Path,
) -> anyhow::Result<()> {
    let seconds = elapsed.as_secs_f64();
    let speed = if summary.galaxies == 0 {
        String::new()
    } else {
        // Per thread, so that machines can be compared; times in docs/validation.md are of this kind.
        let each = 1e6 * seconds * threads as f64 / summary.galaxies as f64;
        format!(
            " ({} galaxies, {} flagged) in {seconds:.1} s, {each:.0} µs per galaxy and thread",
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
    if summary.on_sky > 0 {
        tell(format_args!(
            "frame: sky (e1 > 0 along east–west, e2 > 0 along north-west), of {}",
            count(summary.on_sky, "image")
        ));
    }
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
    if summary.with_defects > 0 {
        tell(format_args!(
            "no light: {} pixels on the stamps of {} galaxies count as missing",
            summary.defects, summary.with_defects
        ));
    }
    // If the command only resumed a finished run, the reasons are in the catalogues of the earlier call.
    let earlier = match summary.images {
        0 => all_flagged(run, out)?,
        _ => None,
    };
    match summary.all_flagged().or(earlier) {
        Some(warning) => anyhow::bail!("no galaxy could be measured: {warning}"),
        None => Ok(()),
    }
}

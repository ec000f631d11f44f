//! Measures the metrics of a baseline.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_scoring::{Metrics, Options};
use shearq_submissions::Configuration;

use super::BaselineSet;
use crate::row::SetRecord;
use crate::score::{OWN, score_folder};
use shearq_dataset::fingerprint;
use shearq_dataset::images::{self, ImageId};
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source};
use shearq_files::atomic::Scratch;
use shearq_files::table::{self, FileFormat, MAX_ROWS};
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::{self, Progress};
use shearq_pipeline::measure::measure_folder;
use shearq_pipeline::run::run_folder;

/// Names of the scatter of e1 and of e2.
pub(super) const SCATTER: [&str; 2] = ["scatter_e1", "scatter_e2"];

/// A set to measure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    /// Set number.
    pub set: u32,
    /// Number of images, counted from image 1.
    pub images: u32,
}

/// Measures a configuration into a temporary folder and returns its metrics. Paths of `source` are relative to the
/// folder `beside`.
///
/// # Errors
/// If data are absent or damaged, or the temporary folder cannot be written.
pub fn measure(
    source: &Source,
    beside: &Path,
    configuration: &Configuration,
    wanted: &[Wanted],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<BaselineSet>, PipelineError> {
    let folder = Scratch::new()?;
    let out = folder.path();
    let data = match source {
        // Messages must not name the temporary folder.
        Source::Folder { .. } => Some(source.data(beside)?),
        Source::Simulated(_) => None,
    };
    let source = source.moved(beside, out)?;
    let run = Run::new(source, configuration.clone(), FileFormat::default());
    match (&run.source, &data) {
        (Source::Simulated(settings), _) => {
            let images: Vec<ImageId> = wanted
                .iter()
                .flat_map(|w| images::of_simulation(&[w.set], w.images))
                .collect();
            run_folder(&run, *settings, &images, out, threads, progress)?;
        }
        (Source::Folder { .. }, None) => {}
        (Source::Folder { .. }, Some(data)) => {
            let sets: Vec<u32> = wanted.iter().map(|w| w.set).collect();
            let asked = |id: &ImageId| {
                let mut of_set = wanted.iter().filter(|w| w.set == id.set);
                of_set.any(|w| id.image <= w.images)
            };
            let mut images = images::of_folder(data, &sets)?;
            images.retain(asked);
            measure_folder(&run, data, out, &images, threads, progress)?;
        }
    }
    let data = match data {
        Some(data) => data,
        None => run.source.data(out)?,
    };
    metrics_of(&run, &data, out, threads)
}

/// Metrics of every set in a folder of catalogues.
///
/// # Errors
/// If a file cannot be read, or there is no catalogue.
pub fn metrics_of(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    threads: usize,
) -> Result<Vec<BaselineSet>, PipelineError> {
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let scored = score_folder(data, out, run, &[], options, threads)?;
    scored
        .iter()
        .filter_map(|scored| Some((scored.set?, scored)))
        .map(|(set, scored)| {
            let print = fingerprint::of_set(&run.source, data, set, &scored.images)?;
            let SetRecord {
                set,
                data,
                images,
                galaxies,
                flagged,
                metrics,
                errors,
                ..
            } = SetRecord::new(set, scored, print);
            let mut all: BTreeMap<String, [f64; 2]> = Metrics::ALL
                .iter()
                .zip(metrics.values().into_iter().zip(errors.values()))
                .map(|(metric, (value, error))| (metric.name.to_owned(), [value, error]))
                .collect();
            for (name, value) in SCATTER.iter().zip(scatter(run, out, set, threads)?) {
                all.insert((*name).to_owned(), value);
            }
            Ok(BaselineSet {
                set,
                data,
                images,
                galaxies,
                flagged,
                metrics: all,
            })
        })
        .collect()
}

/// Rms of e1 and e2 over the measured galaxies of a set, each with its standard error rms/√(2N).
fn scatter(
    run: &Run,
    out: &Path,
    set: u32,
    threads: usize,
) -> Result<[[f64; 2]; 2], PipelineError> {
    let catalogues = run.catalogues(out, &[set])?.of_set(set);
    let (mut squares, mut count) = ([0.0; 2], 0.0_f64);
    engine::ordered(
        threads.min(catalogues.len()).max(1),
        |feeder| {
            for (_, path) in catalogues {
                if !feeder.push(path) {
                    break;
                }
            }
            Ok(())
        },
        || (),
        |(), path| {
            let table = table::read(&path, Some(&["e1", "e2"]), MAX_ROWS)?;
            let (e1, e2) = (
                table::numbers(&table, "e1", &path)?,
                table::numbers(&table, "e2", &path)?,
            );
            let mut sums = ([0.0; 2], 0.0);
            for (e1, e2) in e1.iter().zip(e2.iter()) {
                if e1.is_finite() && e2.is_finite() {
                    sums.0[0] += e1 * e1;
                    sums.0[1] += e2 * e2;
                    sums.1 += 1.0;
                }
            }
            Ok(sums)
        },
        |(more, galaxies): ([f64; 2], f64)| {
            squares[0] += more[0];
            squares[1] += more[1];
            count += galaxies;
            Ok(())
        },
    )?;
    Ok(squares.map(|sum| {
        let rms = (sum / count).sqrt();
        [rms, rms / (2.0 * count).sqrt()]
    }))
}

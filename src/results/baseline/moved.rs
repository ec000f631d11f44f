//! Baselines: measuring what one holds, and telling what moved.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_scoring::{Figures, Options};
use shearq_submissions::Submission;

use super::engine::Progress;
use super::images::{self, ImageId};
use super::measure::measure_folder;
use super::record::set_record;
use super::run::run_folder;
use super::score::{OWN, score_folder};
use super::{PipelineError, engine};
use crate::io::atomic::Scratch;
use crate::io::baseline::{BaselineSet, BaselineSubmission};
use crate::io::fingerprint;
use crate::io::layout::DataFolder;
use crate::io::run::{Run, Source, differences};
use crate::io::store::SetRecord;
use crate::io::table::{self, Format, MAX_ROWS};

/// Names of the scatter of either component of the ellipticity.
const SCATTER: [&str; 2] = ["scatter_e1", "scatter_e2"];

/// Figures that must not move.
const CHECKED: [&str; 5] = ["q", "m_half", "sqrt_a", SCATTER[0], SCATTER[1]];

/// How far a figure may be off on the same data, relative to itself: a changed digit of Q as tables
/// print it is seen.
///
/// The network works in f32, and instruction sets round its sums differently. On the project's own
/// baseline, figures with fused multiply-add (AVX2, AVX-512) and without differ by less than 2e-6 of
/// themselves and 1e-5 of their standard errors, a fiftieth of what is allowed.
pub const TOLERANCE: f64 = 1e-4;

/// The same in units of the figure's standard error, for figures that are nearly zero.
pub const TOLERANCE_SIGMA: f64 = 1e-3;

/// What a submission has of the sets and images it is to be measured on.
pub struct Wanted {
    /// Set number.
    pub set: u32,
    /// Number of images, which are numbered from 1.
    pub images: u32,
}

/// Measures a submission into a folder that is removed again, and takes its figures. `source` is as in a
/// record in the folder `beside`.
///
/// # Errors
/// Where data are absent or damaged, or nothing can be written to the temporary folder.
pub fn measure(
    source: &Source,
    beside: &Path,
    submission: &Submission,
    wanted: &[Wanted],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<BaselineSet>, PipelineError> {
    let folder = Scratch::new()?;
    let out = folder.path();
    let source = source.moved(beside, out)?;
    let run = Run::new(source, submission.clone(), Format::default());
    match &run.source {
        Source::Simulated(settings) => {
            let images: Vec<ImageId> = wanted
                .iter()
                .flat_map(|w| images::of_simulation(&[w.set], w.images))
                .collect();
            run_folder(&run, *settings, &images, out, threads, progress)?;
        }
        Source::Folder { .. } => {
            let sets: Vec<u32> = wanted.iter().map(|w| w.set).collect();
            let data = run.source.data(out)?;
            let asked = |id: &ImageId| {
                let mut of_set = wanted.iter().filter(|w| w.set == id.set);
                of_set.any(|w| id.image <= w.images)
            };
            let mut images = images::of_folder(&data, &sets)?;
            images.retain(asked);
            measure_folder(&run, &data, out, &images, threads, progress)?;
        }
    }
    figures_of(&run, &run.source.data(out)?, out, threads)
}

/// Figures of every set in a folder of catalogues.
///
/// # Errors
/// Where a file cannot be read, or there is nothing to score.
pub fn figures_of(
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
        .map(|scored| {
            let print = fingerprint::of_set(&run.source, data, scored.set, &scored.images)?;
            let SetRecord {
                set,
                data,
                images,
                galaxies,
                flagged,
                figures,
                errors,
                ..
            } = set_record(scored, print);
            let mut all: BTreeMap<String, [f64; 2]> = Figures::ALL
                .iter()
                .zip(figures.values().into_iter().zip(errors.values()))
                .map(|(figure, (value, error))| (figure.name.to_owned(), [value, error]))
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
                figures: all,
            })
        })
        .collect()
}

/// Rms of e1 and e2 over a set's galaxies that have an ellipticity, each with its standard error
/// rms/√(2N).
fn scatter(
    run: &Run,
    out: &Path,
    set: u32,
    threads: usize,
) -> Result<[[f64; 2]; 2], PipelineError> {
    let catalogues = run.catalogues(out, &[set])?.of_set(set);
    let (mut squares, mut count) = ([0.0; 2], 0.0_f64);
    engine::ordered(
        threads,
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
            let mut table = table::read(&path, Some(&["e1", "e2"]), MAX_ROWS)?;
            let (e1, e2) = (table.require("e1", &path)?, table.require("e2", &path)?);
            let mut own = ([0.0; 2], 0.0);
            for (e1, e2) in e1.iter().zip(&e2) {
                if e1.is_finite() && e2.is_finite() {
                    own.0[0] += e1 * e1;
                    own.0[1] += e2 * e2;
                    own.1 += 1.0;
                }
            }
            Ok(own)
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

/// A figure of a baseline, and what it is now.
#[derive(Debug, Clone, PartialEq)]
pub struct Shift {
    /// Set number.
    pub set: u32,
    /// Name of the figure.
    pub figure: &'static str,
    /// Value and standard error in the baseline.
    pub before: [f64; 2],
    /// Value and standard error now.
    pub now: [f64; 2],
    /// The difference in units of its error: that of the baseline's figure on the same data, on
    /// others that of both.
    pub sigma: f64,
    /// Whether it moved by more than may be.
    pub moved: bool,
}

/// What became of the checked figures of a set.
///
/// On the same data a figure may be off by rounding alone: by [`TOLERANCE`] of itself or
/// [`TOLERANCE_SIGMA`] of its error, whichever is more. On other data it may be off by `sigmas` standard errors of the
/// difference.
pub fn shifts(before: &BaselineSet, now: &BaselineSet, sigmas: f64) -> Vec<Shift> {
    let same_data = before.data == now.data && before.images == now.images;
    CHECKED
        .iter()
        .map(|&figure| {
            let get = |set: &BaselineSet| set.figures.get(figure).copied();
            let (old, new) = (
                get(before).unwrap_or([f64::NAN; 2]),
                get(now).unwrap_or([f64::NAN; 2]),
            );
            let difference = new[0] - old[0];
            let error = if same_data {
                old[1]
            } else {
                old[1].hypot(new[1])
            };
            let allowed = if same_data {
                // The larger one; an unknown error leaves the other.
                (TOLERANCE_SIGMA * error).max(TOLERANCE * old[0].abs())
            } else {
                sigmas * error
            };
            // A figure that is lost or an error that is unknown is a change too.
            let within = difference.abs() <= allowed;
            let neither = old[0].is_nan() && new[0].is_nan();
            Shift {
                set: before.set,
                figure,
                before: old,
                now: new,
                sigma: difference / error,
                moved: !neither && !within,
            }
        })
        .collect()
}

/// Settings of a baseline that are others now, as `key: before ≠ now`; and those that it does not
/// know, because they are newer.
///
/// # Errors
/// Where settings cannot be compared.
pub fn settings_moved(
    before: &BaselineSubmission,
    now: &Submission,
) -> Result<(Vec<String>, Vec<String>), String> {
    let mut current = toml::Table::try_from(now).map_err(|error| error.to_string())?;
    let mut earlier = before.settings.clone();
    // Words do not change results.
    for table in [&mut current, &mut earlier] {
        table.remove("description");
    }
    let found = differences(&earlier, &current).map_err(|error| error.to_string())?;
    Ok(found
        .into_iter()
        .partition(|line| !line.contains(": null ≠ ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(data: &str, q: f64) -> BaselineSet {
        let figures = CHECKED.map(|name| (name.to_owned(), [q, 2.0]));
        BaselineSet {
            set: 1,
            data: data.into(),
            images: vec![1, 2],
            galaxies: 10,
            flagged: 0,
            figures: figures.into(),
        }
    }

    #[test]
    fn on_the_same_data_rounding_passes_and_on_others_noise_does() {
        let before = set("a", 80.0);
        let moved = |now: &BaselineSet| shifts(&before, now, 3.0)[0].moved;
        assert!(!moved(&set("a", 80.0 * (1.0 + 0.9 * TOLERANCE))));
        assert!(moved(&set("a", 80.0 * (1.0 - 1.1 * TOLERANCE))));
        // 3 σ of the difference of two figures with errors of 2 is 8.5.
        assert!(!moved(&set("b", 88.0)) && moved(&set("b", 89.0)));
        assert!(moved(&set("a", f64::NAN)) && moved(&set("b", f64::NAN)));
    }

    #[test]
    fn a_figure_near_zero_may_be_off_by_a_part_of_its_error() {
        let before = set("a", 0.0);
        let moved = |q: f64| shifts(&before, &set("a", q), 3.0)[0].moved;
        assert!(!moved(1.9 * TOLERANCE_SIGMA) && moved(2.1 * TOLERANCE_SIGMA));
    }
}

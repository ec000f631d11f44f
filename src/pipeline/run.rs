//! Simulating and measuring in memory: no image is stored.

use std::path::Path;
use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_submissions::{PsfForm, Submission};

use super::engine::{self, Progress};
use super::galaxy::{MeasureScratch, Measurer};
use super::measure::{
    ImageId, MeasuredRow, RowPsf, StampRow, Summary, functional_psf, measure_row, write_catalogue,
};
use super::{PipelineError, simulate};
use crate::io::layout::DataFolder;
use crate::io::run::{RUN_FILE, Run, claim};
use crate::psf::star::star_psf;
use crate::simulate::render::RenderScratch;
use crate::simulate::set::{
    ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

/// One row of stamps to draw and measure.
struct RowJob {
    fields: Arc<ImageFields>,
    iy: usize,
}

/// One thread's buffers.
struct Scratch {
    render: RenderScratch,
    measure: Vec<MeasureScratch>,
}

/// Plans the measurement of simulated stamps by each of `submissions`.
///
/// # Errors
/// Where a submission's sizes cannot be worked with.
pub fn measurers(submissions: &[Submission]) -> Result<Vec<Measurer>, PipelineError> {
    submissions
        .iter()
        .map(|submission| {
            if Measurer::fits(submission, STAMP) {
                return Ok(Measurer::new(submission, STAMP)?);
            }
            Err(PipelineError::Request(format!(
                "submission {} needs stamps of {} pixels; simulated ones have {STAMP}",
                submission.name, submission.stamp.size
            )))
        })
        .collect()
}

/// Simulates images 1 to `images` of `sets` and measures them by the run's submission, into
/// catalogues in `out` with the true shear beside them. No image is stored; catalogues that are
/// there already, of the same settings, are kept.
///
/// # Errors
/// Where a set does not exist, the folder holds results of other settings, or a file cannot be
/// written.
pub fn run_folder(
    run: &Run,
    settings: SimulationSettings,
    sets: &[u32],
    images: u32,
    out: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Summary, PipelineError> {
    claim(&out.join(RUN_FILE), run)?;
    let measurers = measurers(std::slice::from_ref(&run.submission))?;
    let truth = DataFolder::new(out);
    let mut summary = Summary::default();
    for &set in sets {
        let todo: Vec<u32> = (1..=images)
            .filter(|&image| !run.catalogue(out, set, image).is_file())
            .collect();
        let already = images as usize - todo.len();
        summary.already += already;
        progress.advance((already * settings.grid * settings.grid) as u64);
        if todo.is_empty() {
            continue;
        }
        let simulator = simulate::simulator(set, settings)?;
        simulate::write_truth(&truth, &simulator)?;
        progress.note(&format!("set {set:02}"));
        run_set(
            &simulator,
            &todo,
            &measurers,
            threads,
            progress,
            |_, rows| {
                write_catalogue(run, out, &rows[0])?;
                summary.count(&rows[0]);
                Ok(())
            },
        )?;
    }
    Ok(summary)
}

/// Simulates images of a set and measures each galaxy by all `measurers`; `done` gets, image by
/// image in order, the rows of each measurer.
///
/// The galaxies are those that `simulate` would write with the same settings, and the measurements
/// those that `measure` would make of them.
///
/// # Errors
/// What `done` returns, or threads that cannot be started.
pub fn run_set(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
    mut done: impl FnMut(u32, &[Vec<MeasuredRow>]) -> Result<(), PipelineError>,
) -> Result<(), PipelineError> {
    let n = set.grid().n;
    let mut rows: Vec<Vec<MeasuredRow>> = measurers.iter().map(|_| Vec::new()).collect();
    engine::ordered(
        threads,
        |feeder| {
            for &image in images {
                let fields = Arc::new(set.image_fields(image));
                for iy in 0..n {
                    let fields = Arc::clone(&fields);
                    if !feeder.push(RowJob { fields, iy }) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        || Scratch {
            render: RenderScratch::new(),
            measure: measurers.iter().map(Measurer::scratch).collect(),
        },
        |scratch, job| Ok(draw_and_measure(set, measurers, scratch, &job)),
        |measured: Vec<MeasuredRow>| {
            progress.advance(n as u64);
            let (image, iy) = (measured[0].id.image, measured[0].iy);
            for (rows, row) in rows.iter_mut().zip(measured) {
                rows.push(row);
            }
            if iy + 1 == n {
                done(image, &rows)?;
                rows.iter_mut().for_each(Vec::clear);
            }
            Ok(())
        },
    )
}

fn draw_and_measure(
    set: &SetSimulator,
    measurers: &[Measurer],
    scratch: &mut Scratch,
    job: &RowJob,
) -> Vec<MeasuredRow> {
    let (pixels, _) = simulate::draw_stamps(set, &job.fields, job.iy, &mut scratch.render);
    let mut row = StampRow {
        id: ImageId {
            set: set.kind().set,
            image: job.fields.image,
        },
        iy: job.iy,
        grid: set.grid(),
        pixels,
        stamp: STAMP,
        header_noise: Some(NOISE_SIGMA),
        psf: RowPsf::Functional(Vec::new()),
    };
    let mut measured = Vec::with_capacity(measurers.len());
    for (measurer, own) in measurers.iter().zip(&mut scratch.measure) {
        row.psf = row_psf(set, job, measurer.submission());
        measured.push(measure_row(measurer, own, &row));
    }
    measured
}

/// The PSFs of a row in the form that a submission uses.
fn row_psf(set: &SetSimulator, job: &RowJob, submission: &Submission) -> RowPsf {
    let n = set.grid().n;
    let size = submission.psf.size;
    match (&job.fields.psf, submission.psf.form) {
        (PsfField::One(psf), PsfForm::Functional) => {
            RowPsf::Shared(Arc::new(functional_psf(psf, size)))
        }
        (PsfField::One(psf), PsfForm::Star) => {
            let star = simulate::star(psf, STAMP);
            let cut = ArrayView2::from_shape((STAMP, STAMP), &star)
                .ok()
                .and_then(|star| star_psf(star, size).ok());
            // A noise-free star of the simulator's can always be cut.
            RowPsf::Shared(Arc::new(cut.unwrap_or_else(|| Array2::zeros((size, size)))))
        }
        (PsfField::PerGalaxy(_), PsfForm::Functional) => {
            RowPsf::Functional((0..n).map(|ix| *job.fields.psf.at(ix, job.iy)).collect())
        }
        (PsfField::PerGalaxy(_), PsfForm::Star) => RowPsf::Stars {
            pixels: simulate::draw_stars(set, &job.fields, job.iy),
            side: simulate::STAR_STAMP,
        },
    }
}

//! Simulating and measuring in memory: no image is stored.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use ndarray::{Array2, ArrayView2, Axis};
use shearq_measure::{
    ImageNoise, Measurer, NoisePlan, NoiseSurvey, Psfs, Steps, Survey, Warning, Worker, calibrate,
    star_psf, strip,
};
use shearq_quantities::Shear;
use shearq_submissions::{Configuration, PsfForm};

use super::engine::{self, Feeder, Progress};
use super::images::ImageId;
use super::measure::{Catalogues, ImageHead, MeasuredRow, StampRow, Summary, measure_row};
use super::{PipelineError, simulate};
use crate::data::layout::DataFolder;
use crate::data::mosaic::Mosaic;
use crate::data::run::Run;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{
    ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

/// One row of stamps to draw and measure.
pub struct RowJob {
    /// The image's fields of PSF and ellipticity.
    pub fields: Arc<ImageFields>,
    /// Row of the mosaic, from 0.
    pub iy: usize,
    /// What the rows of the image share, one per measurer.
    pub heads: Arc<[Arc<ImageHead>]>,
    /// The row as it is, if it was drawn for the survey of the image.
    drawn: Option<DrawnRow>,
}

/// A row of drawn stamps, and the ellipticities after lensing.
type DrawnRow = (Vec<f32>, Vec<Shear>);
type DrawnRows = BTreeMap<usize, DrawnRow>;

impl fmt::Debug for RowJob {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RowJob")
            .field("iy", &self.iy)
            .field("heads", &self.heads)
            .finish_non_exhaustive()
    }
}

/// A row of stamps, measured by each measurer.
struct MeasuredJob {
    /// Ellipticities after lensing.
    observed: Vec<Shear>,
    rows: Vec<MeasuredRow>,
}

/// A simulated image, measured.
#[derive(Debug)]
pub struct SimulatedImage<'a> {
    /// Its number.
    pub image: u32,
    /// True ellipticities of the galaxies as lensed, row by row.
    pub observed: &'a [Shear],
    /// Rows of each measurer.
    pub rows: &'a [Vec<MeasuredRow>],
}

/// One thread's buffers.
struct Scratch {
    render: RenderScratch,
    workers: Vec<Worker>,
}

/// Plans the measurement of simulated stamps by each of `configurations`.
///
/// # Errors
/// If the sizes of a configuration cannot be used.
pub fn measurers(configurations: &[Configuration]) -> Result<Vec<Measurer>, PipelineError> {
    configurations
        .iter()
        .map(|configuration| Ok(Measurer::new(configuration, STAMP)?))
        .collect()
}

/// Simulates `images`, which are in the order of their sets, and measures them by the run's configuration. Writes
/// catalogues to `out`, with the true shear. No image is stored. Catalogues of the same settings that are
/// there already are kept.
///
/// # Errors
/// If a set does not exist, the folder contains results of other settings, or a file cannot be written.
pub fn run_folder(
    run: &Run,
    settings: SimulationSettings,
    images: &[ImageId],
    out: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Summary, PipelineError> {
    let mut catalogues = Catalogues::claim(run, out, images)?;
    let measurers = measurers(std::slice::from_ref(&run.configuration))?;
    let truth = DataFolder::new(out);
    progress.skip((catalogues.done.len() * settings.grid * settings.grid) as u64);
    let todo = std::mem::take(&mut catalogues.todo);
    for of_set in todo.chunk_by(|a, b| a.set == b.set) {
        let set = of_set[0].set;
        let todo: Vec<u32> = of_set.iter().map(|id| id.image).collect();
        let simulator = simulate::simulator(set, settings)?;
        simulate::write_truth(&truth, &simulator)?;
        run_set(
            &simulator,
            &todo,
            &measurers,
            threads,
            progress,
            |image, progress| catalogues.add(&image.rows[0], progress),
        )
        .map_err(|error| catalogues.explain(error))?;
    }
    catalogues.finish(progress)
}

/// Simulates images of a set and measures each galaxy by all `measurers`. `done` gets the images in order.
///
/// The galaxies are equal to the galaxies of `simulate` with the same settings, and the measurements to the results of
/// `measure`.
///
/// # Errors
/// As `done`, or if threads cannot be started.
pub fn run_set(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
    mut done: impl FnMut(&SimulatedImage<'_>, &mut dyn Progress) -> Result<(), PipelineError>,
) -> Result<(), PipelineError> {
    let n = set.grid().n;
    let mut rows: Vec<Vec<MeasuredRow>> = measurers.iter().map(|_| Vec::new()).collect();
    let mut observed = Vec::with_capacity(n * n);
    engine::ordered(
        threads,
        |feeder| feed(set, images, measurers, feeder),
        || Scratch {
            render: RenderScratch::new(),
            workers: measurers.iter().map(Measurer::worker).collect(),
        },
        |scratch, job| draw_and_measure(set, scratch, job),
        |measured: MeasuredJob| {
            progress.advance(n as u64);
            let (image, iy) = (measured.rows[0].head.id.image, measured.rows[0].iy);
            observed.extend(measured.observed);
            for (rows, row) in rows.iter_mut().zip(measured.rows) {
                rows.push(row);
            }
            if iy + 1 == n {
                for (rows, measurer) in rows.iter_mut().zip(measurers) {
                    calibrate(measurer.configuration(), rows);
                }
                let image = SimulatedImage {
                    image,
                    observed: &observed,
                    rows: &rows,
                };
                done(&image, progress)?;
                rows.iter_mut().for_each(Vec::clear);
                observed.clear();
            }
            Ok(())
        },
    )
}

/// Hands out the rows of images of a set, in order, with the noise that each of `measurers` measures on them.
///
/// # Errors
/// If a measurer is for stamps of another size.
pub fn feed(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    feeder: &mut Feeder<'_, RowJob>,
) -> Result<(), PipelineError> {
    for &image in images {
        let fields = Arc::new(set.image_fields(image));
        let (surveys, mut drawn) = surveys(set, &fields, measurers, feeder)?;
        let heads = heads(set, image, measurers, surveys);
        for iy in 0..set.grid().n {
            let job = RowJob {
                fields: Arc::clone(&fields),
                iy,
                heads: Arc::clone(&heads),
                drawn: drawn.remove(&iy),
            };
            if !feeder.push(job) {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// What the rows of a simulated image share, one per measurer.
fn heads(
    set: &SetSimulator,
    image: u32,
    measurers: &[Measurer],
    surveys: Surveys,
) -> Arc<[Arc<ImageHead>]> {
    let head = |(measurer, survey): (&Measurer, Option<Arc<Survey>>)| {
        let warnings = Warning::of_settings(measurer.configuration());
        Arc::new(ImageHead {
            id: ImageId {
                set: set.kind().set,
                image,
            },
            mosaic: Mosaic::square(set.grid().n, STAMP),
            noise: Some(NOISE_SIGMA),
            stated_noise: None,
            survey,
            stars: None,
            warnings: warnings.into_iter().collect(),
            run_warnings: Vec::new(),
            prints: BTreeMap::new(),
        })
    };
    measurers.iter().zip(surveys).map(head).collect()
}

/// Noise and galaxy sizes of an image, for each measurer that measures them.
type Surveys = Vec<Option<Arc<Survey>>>;

/// The surveys of a simulated image, and the rows that were drawn for them by their place.
fn surveys(
    set: &SetSimulator,
    fields: &ImageFields,
    measurers: &[Measurer],
    feeder: &Feeder<'_, RowJob>,
) -> Result<(Surveys, DrawnRows), PipelineError> {
    let n = set.grid().n;
    let empty = || -> Vec<Option<NoiseSurvey>> {
        let plans = measurers.iter().map(Measurer::noise_plan);
        plans.map(|plan| plan.map(NoisePlan::survey)).collect()
    };
    let Some(plan) = measurers.iter().find_map(Measurer::noise_plan) else {
        return Ok((measurers.iter().map(|_| None).collect(), BTreeMap::new()));
    };
    // Plans differ only in their lags.
    let rows = feeder.each(plan.rows(n, n), |iy| {
        let drawn = simulate::draw_stamps(set, fields, iy, &mut RenderScratch::new());
        let mut surveys = empty();
        for stamp in strip(&drawn.0, n, STAMP)?.outer_iter() {
            for survey in surveys.iter_mut().flatten() {
                survey.add(stamp)?;
            }
        }
        Ok::<_, PipelineError>((surveys, (iy, drawn)))
    });
    let mut surveys = empty();
    let mut drawn = BTreeMap::new();
    for row in rows {
        let (found, (iy, row)) = row?;
        drawn.insert(iy, row);
        for (survey, more) in surveys.iter_mut().flatten().zip(found.iter().flatten()) {
            survey.join(more)?;
        }
    }
    let found = surveys
        .iter()
        .map(|survey| survey.as_ref()?.found().map(Arc::new));
    Ok((found.collect(), drawn))
}

fn draw_and_measure(
    set: &SetSimulator,
    scratch: &mut Scratch,
    mut job: RowJob,
) -> Result<MeasuredJob, PipelineError> {
    let (pixels, observed) = job
        .drawn
        .take()
        .unwrap_or_else(|| simulate::draw_stamps(set, &job.fields, job.iy, &mut scratch.render));
    let rows = measure_strip(set, &job, pixels, &mut scratch.workers)?;
    Ok(MeasuredJob { observed, rows })
}

/// Simulates galaxy `(ix, iy)` of an image and measures it with all intermediate steps. Returns them with the PSF,
/// `None` if the galaxy could not be measured.
///
/// # Errors
/// If the measurer is for stamps of another size.
pub fn simulated_steps(
    set: &SetSimulator,
    measurer: &Measurer,
    image: u32,
    (ix, iy): (usize, usize),
) -> Result<Option<(Array2<f64>, Steps)>, PipelineError> {
    let fields = Arc::new(set.image_fields(image));
    let mut pixels = vec![0.0; STAMP * STAMP];
    set.draw(&fields, ix, iy, &mut RenderScratch::new(), &mut pixels);
    let stamps = strip(&pixels, 1, STAMP)?;
    let stamp = stamps.index_axis(Axis(0), 0);
    let cut = measurer.configuration().psf_cut();
    let psf = fields.psf.at(ix, iy).stamp_beside(cut.size, STAMP);
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
    let mut worker = image.psf(psf.view())?;
    let measured = worker.measure(stamp)?;
    if measured.descent.is_none() {
        return Ok(None);
    }
    let steps = worker.steps(stamp, psf.view(), &measured)?;
    Ok(Some((psf, steps)))
}

/// Measures a strip of simulated stamps in the place of a job's by each worker, with the noise that was measured, or
/// else with the true noise.
///
/// # Errors
/// If the stamps have other sizes than planned.
pub fn measure_strip(
    set: &SetSimulator,
    job: &RowJob,
    pixels: Vec<f32>,
    workers: &mut [Worker],
) -> Result<Vec<MeasuredRow>, PipelineError> {
    let mut measured = Vec::with_capacity(workers.len());
    let mut pixels = pixels;
    for (worker, head) in workers.iter_mut().zip(job.heads.iter()) {
        let row = StampRow {
            head: Arc::clone(head),
            iy: job.iy,
            pixels,
            psfs: row_psfs(set, &job.fields, job.iy, worker.configuration())?,
        };
        measured.push(measure_row(worker, &row)?);
        pixels = row.pixels;
    }
    Ok(measured)
}

/// The PSFs of a row in the form that a configuration uses.
fn row_psfs(
    set: &SetSimulator,
    fields: &ImageFields,
    iy: usize,
    configuration: &Configuration,
) -> Result<Psfs<'static>, PipelineError> {
    let n = set.grid().n;
    let (size, cut) = (configuration.psf.size, configuration.psf_cut());
    Ok(match (&fields.psf, configuration.psf.form) {
        (PsfField::One(psf), PsfForm::Functional) => {
            Psfs::Prepared(psf.stamp_beside(cut.size, STAMP).into_shared())
        }
        (PsfField::One(psf), PsfForm::Star) => {
            let star = simulate::star(psf, STAMP);
            let psf = ArrayView2::from_shape((STAMP, STAMP), &star)
                .ok()
                .and_then(|star| star_psf(star, cut).ok());
            // A simulated star without noise can always be cut.
            let psf = psf.unwrap_or_else(|| Array2::zeros((size, size)));
            Psfs::Prepared(psf.into_shared())
        }
        (PsfField::PerGalaxy(_), PsfForm::Functional) => {
            Psfs::functional((0..n).map(|ix| *fields.psf.at(ix, iy)).collect::<Vec<_>>())
        }
        (PsfField::PerGalaxy(_), PsfForm::Star) => {
            Psfs::strip(simulate::draw_stars(set, fields, iy), n, STAMP)?
        }
    })
}

#[cfg(test)]
mod tests {
    use shearq_files::table::FileFormat;
    use shearq_submissions::Registry;

    use super::*;
    use crate::data::run::Source;

    /// Galaxies that were done when each warning was shown.
    #[derive(Default)]
    struct Recorder {
        done: u64,
        warned: Vec<u64>,
    }

    impl Progress for Recorder {
        fn advance(&mut self, galaxies: u64) {
            self.done += galaxies;
        }

        fn note(&mut self, _line: &str) {}

        fn warn(&mut self, _line: &str) {
            self.warned.push(self.done);
        }
    }

    #[test]
    fn warnings_of_an_image_are_shown_before_the_next_image_is_done() {
        let registry = Registry::embedded().unwrap();
        let mut configuration = registry.get("48/linear/star").unwrap().configuration;
        // Too little of the PSF: a warning for each image.
        configuration.psf.size = 24;
        let settings = SimulationSettings::new(1, 8);
        let run = Run::new(
            Source::Simulated(settings),
            configuration,
            FileFormat::Parquet,
        );
        let images = crate::images::of_simulation(&[2], 3);
        let out = tempfile::tempdir().unwrap();
        let mut progress = Recorder::default();
        let summary = run_folder(&run, settings, &images, out.path(), 1, &mut progress).unwrap();
        assert_eq!(summary.images, 3);
        // The second line counts the other images.
        assert_eq!(progress.warned, [64, 3 * 64]);
    }
}

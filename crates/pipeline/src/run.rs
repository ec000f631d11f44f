//! Simulating and measuring in memory: no image is stored.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::Ix3;
use shearq_measure::{
    Batch, KnownNoise, Lazy, LazyStamps, Measurer, OneThread, Pixels, Psfs, Session, StampRows,
    StampSource, Star, Steps, Threads,
};
use shearq_quantities::Shear;
use shearq_submissions::{Configuration, PsfForm};

use super::measure::{CatalogueWriter, ImageHead, ImageRow, Measured, Summary, measure_images};
use super::{PipelineError, simulate};
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::Run;
use shearq_dataset::threads::Progress;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{
    ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

// A simulated image as a source of stamps, for a configuration.
struct SimulatedSource<'s> {
    set: &'s SetSimulator,
    fields: Arc<ImageFields>,
    form: PsfForm,
    shared: Option<Arc<Star>>,
    // Kept until they are measured, so that several measurers and the survey draw a row once.
    drawn: Arc<Mutex<BTreeMap<usize, LazyStamps<'s>>>>,
}

impl<'s> SimulatedSource<'s> {
    fn new(
        set: &'s SetSimulator,
        fields: &Arc<ImageFields>,
        configuration: &Configuration,
        drawn: &Arc<Mutex<BTreeMap<usize, LazyStamps<'s>>>>,
    ) -> Result<Self, PipelineError> {
        let form = configuration.psf.form;
        let shared = match &fields.psf {
            PsfField::PerGalaxy(_) => None,
            PsfField::One(psf) => {
                let cut = configuration.psf_cut();
                // No noise is added, as `simulate` adds none to its star images.
                let psf = match form {
                    PsfForm::Functional => psf.stamp_beside(cut.size, STAMP).into(),
                    // A star that cannot be cut is an error: zeros in its place would be measured like any PSF.
                    PsfForm::Star => Star::cut(fields.psf.star(0, 0).view(), cut)?,
                };
                Some(Arc::new(psf))
            }
        };
        Ok(SimulatedSource {
            set,
            fields: Arc::clone(fields),
            form,
            shared,
            drawn: Arc::clone(drawn),
        })
    }

    fn row_psfs(&self, row: usize) -> Lazy<'s, Psfs<'s>> {
        if let Some(psf) = &self.shared {
            return Psfs::Prepared(psf.clone()).into();
        }
        let (set, fields, form) = (self.set, Arc::clone(&self.fields), self.form);
        // Drawn by the workers: the one thread that reads rows would otherwise draw all stars.
        Lazy::new(move || {
            let n = set.grid().n;
            match form {
                PsfForm::Functional => {
                    Psfs::functional((0..n).map(|ix| *fields.psf.at(ix, row)).collect::<Vec<_>>())
                }
                PsfForm::Star => Psfs::Stars(stamps(set.draw_stars(&fields, row), n)),
            }
        })
    }
}

impl<'s> StampSource<'s> for SimulatedSource<'s> {
    type Error = PipelineError;

    fn rows(&self) -> StampRows {
        let n = self.set.grid().n;
        StampRows {
            columns: n,
            count: n * n,
        }
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'s>, PipelineError> {
        thread_local! {
            // The value of a `Lazy` is made in any thread. Rows of an image often share the transfer function of their PSF,
            // which is kept here.
            static SCRATCH: RefCell<RenderScratch> = RefCell::default();
        }
        let (set, fields) = (self.set, Arc::clone(&self.fields));
        let mut drawn = self.drawn.lock().unwrap_or_else(PoisonError::into_inner);
        let lazy = drawn.entry(row).or_insert_with(|| {
            // By the function that `simulate` stores images with, so that what is stored and what is measured in memory are equal.
            let draw = move |scratch: &mut RenderScratch| set.draw_row(&fields, row, scratch);
            Lazy::new(move || stamps(SCRATCH.with_borrow_mut(draw), set.grid().n))
        });
        Ok(lazy.clone())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'s, Psfs<'s>>, PipelineError> {
        Ok(self.row_psfs(row))
    }
}

fn stamps<'s>(strip: Vec<f32>, n: usize) -> Pixels<'s, Ix3> {
    Pixels::strip(strip, n, STAMP).expect("as many pixels as drawn")
}

// A simulated image that is being measured by several measurers.
struct SimulatedSessions<'s> {
    fields: Arc<ImageFields>,
    sessions: Vec<(Arc<Session<'s>>, SimulatedSource<'s>)>,
}

impl<'s> SimulatedSessions<'s> {
    // Opens a session of each measurer. Rows that are surveyed are drawn once.
    fn new(
        set: &'s SetSimulator,
        image: u32,
        measurers: &[Measurer],
        threads: &impl Threads,
    ) -> Result<Self, PipelineError> {
        let (fields, drawn) = (Arc::new(set.image_fields(image)), Arc::default());
        let sessions = measurers.iter().map(|measurer| {
            let configuration = measurer.configuration();
            let mut source = SimulatedSource::new(set, &fields, configuration, &drawn)?;
            // As the header of a stored image states it: catalogues are then equal to the catalogues of `simulate` and `measure`.
            let noise = KnownNoise::Stated(NOISE_SIGMA);
            let session = Session::open(measurer, &mut source, noise, threads)?;
            Ok((Arc::new(session), source))
        });
        Ok(SimulatedSessions {
            sessions: sessions.collect::<Result<_, PipelineError>>()?,
            fields,
        })
    }

    fn read(&mut self, row: usize) -> Result<ImageRow<'s, ImageFields>, PipelineError> {
        let each = self.sessions.iter_mut();
        let jobs = each.map(|(session, source)| session.read(source, row));
        let jobs = jobs.collect::<Result<_, _>>()?;
        if let Some((_, source)) = self.sessions.first() {
            let mut drawn = source.drawn.lock().unwrap_or_else(PoisonError::into_inner);
            // All sessions have read the row. Kept rows would add up to the whole image.
            drawn.remove(&row);
        }
        Ok(ImageRow {
            head: Arc::clone(&self.fields),
            jobs,
        })
    }
}

/// Plans the measurement of simulated stamps by each of `configurations`.
pub fn measurers(configurations: &[Configuration]) -> Result<Vec<Measurer>, PipelineError> {
    configurations
        .iter()
        .map(|configuration| Ok(Measurer::new(configuration, STAMP)?))
        .collect()
}

/// Simulates `images`, which are in the order of their sets, and measures them by the run's configuration. Writes
/// catalogues to `out`, with the true shear. No image is stored. Catalogues of the same settings that are
/// there already are kept.
pub fn run_folder(
    run: &Run,
    settings: SimulationSettings,
    images: &[ImageId],
    out: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Summary, PipelineError> {
    let mut catalogues = CatalogueWriter::claim(run, out, images)?;
    let measurers = measurers(std::slice::from_ref(&run.configuration))?;
    let truth = DataFolder::new(out);
    progress.skip((catalogues.done.len() * settings.grid * settings.grid) as u64);
    let todo = std::mem::take(&mut catalogues.todo);
    for of_set in todo.chunk_by(|a, b| a.set == b.set) {
        let set = of_set[0].set;
        let todo: Vec<u32> = of_set.iter().map(|id| id.image).collect();
        let simulator = simulate::simulator(set, settings)?;
        // In the folder of the catalogues, because there is no data folder that `score` could read it from.
        simulate::write_truth(&truth, &simulator)?;
        run_set(
            &simulator,
            &todo,
            &measurers,
            threads,
            progress,
            |image, progress| {
                let head = ImageHead {
                    id: ImageId {
                        set,
                        image: image.image,
                    },
                    mosaic: Mosaic::square(settings.grid, STAMP),
                    table: None,
                    epochs: Vec::new(),
                    aligned: false,
                    // There are no files to compare with later; the settings and the seed determine the data.
                    prints: BTreeMap::new(),
                };
                catalogues.add(&head, &image.batches[0], progress)
            },
        )
        .map_err(|error| catalogues.explain(error))?;
    }
    catalogues.finish(progress)
}

#[derive(Debug)]
pub struct SimulatedImage<'a> {
    pub image: u32,
    /// True ellipticities of the galaxies as lensed, row by row.
    pub observed: &'a [Shear],
    /// The galaxies as each measurer has measured them.
    pub batches: &'a [Batch],
}

/// Simulates images of a set and measures each galaxy by all `measurers`. `done` gets the images in order.
///
/// The galaxies are equal to the galaxies of `simulate` with the same settings, and the measurements to the results of
/// `measure`.
pub fn run_set(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
    mut done: impl FnMut(&SimulatedImage<'_>, &mut dyn Progress) -> Result<(), PipelineError>,
) -> Result<(), PipelineError> {
    let n = set.grid().n;
    measure_images(
        threads,
        measurers,
        |feeder| {
            for &image in images {
                // One image at a time: sessions keep what they found in the whole image until its last row is measured.
                let mut open = SimulatedSessions::new(set, image, measurers, feeder.ahead())?;
                for row in 0..n {
                    if !feeder.push(open.read(row)?) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        |measured| {
            let (fields, batches) = match measured {
                Measured::Galaxies(count) => {
                    progress.advance(count as u64);
                    return Ok(());
                }
                Measured::Image(fields, batches) => (fields, batches),
            };
            let places = (0..n * n).map(|at| set.observed(fields, at % n, at / n));
            let image = SimulatedImage {
                image: fields.image,
                observed: &places.collect::<Vec<_>>(),
                batches: &batches,
            };
            done(&image, progress)
        },
    )
}

/// The steps of measuring galaxy `(ix, iy)` of a simulated image; `None` if it could not be measured.
pub fn simulated_steps(
    set: &SetSimulator,
    measurer: &Measurer,
    image: u32,
    (ix, iy): (usize, usize),
) -> Result<Option<Steps>, PipelineError> {
    let measurer = std::slice::from_ref(measurer);
    let mut open = SimulatedSessions::new(set, image, measurer, &OneThread)?;
    let (session, source) = &mut open.sessions[0];
    Ok(session.steps(source, iy, ix)?.1)
}

#[cfg(test)]
mod tests {
    use shearq_files::table::FileFormat;
    use shearq_simulate::set::FixedPsf;
    use shearq_submissions::Registry;

    use super::*;
    use shearq_dataset::run::Source;

    // Galaxies that were done when each warning was shown.
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
        let settings = SimulationSettings {
            fixed_psf: FixedPsf::One,
            ..SimulationSettings::new(1, 8)
        };
        let run = Run::new(
            Source::Simulated(settings),
            configuration,
            FileFormat::Parquet,
        );
        let images = shearq_dataset::images::of_simulation(&[2], 3);
        let out = tempfile::tempdir().unwrap();
        let mut progress = Recorder::default();
        let summary = run_folder(&run, settings, &images, out.path(), 1, &mut progress).unwrap();
        assert_eq!(summary.images, 3);
        // The second line counts the other images.
        assert_eq!(progress.warned, [64, 3 * 64]);
    }
}

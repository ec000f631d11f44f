//! Measuring images: rows of stamps in, one catalogue per image out.
//!
//! [`measure_images`] runs the sessions of images in threads, from files, simulations or arrays. [`FolderMeasurement`]
//! measures the images of a data folder, and writes a catalogue when all rows of an image are measured.

mod catalogue;
mod source;

use std::path::Path;
use std::sync::Arc;

use shearq_files::FileError;
use shearq_measure::{Batch, MeasuredImage, Measurer, RowJob};

pub use self::catalogue::{COLUMNS, ImageHead, Summary, Value, all_flagged, more_columns};
pub(crate) use self::catalogue::{CatalogueWriter, metadata};
use self::source::open_epochs;
pub use self::source::{ImageSource, settings_for_small_stamps};
pub(crate) use self::source::{check_strip, open_galaxies};
use crate::PipelineError;
use crate::engine::{self, Feeder};
use shearq_dataset::fingerprint::Inputs;
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::Run;
use shearq_dataset::threads::{Pool, Progress};

/// A row of stamps of an image, to be measured by each of several measurers.
#[derive(Debug)]
pub struct ImageRow<'n, H> {
    /// Identifies the image to the caller.
    pub head: Arc<H>,
    /// One per measurer.
    pub jobs: Vec<RowJob<'n>>,
}

/// Progress of [`measure_images`].
#[derive(Debug)]
pub enum Measured<'a, H> {
    /// A row of this number of galaxies was measured.
    Galaxies(usize),
    /// All rows of an image were measured, and calibrated by each measurer.
    Image(&'a H, Vec<Batch>),
}

/// Measures the rows that `read` hands over, image by image and in order, by each of `measurers`. `done` runs on the calling
/// thread.
pub fn measure_images<'n, H: Send + Sync>(
    threads: usize,
    measurers: &[Measurer],
    read: impl FnOnce(&mut Feeder<'_, ImageRow<'n, H>>) -> Result<(), PipelineError> + Send,
    mut done: impl FnMut(Measured<'_, H>) -> Result<(), PipelineError>,
) -> Result<(), PipelineError> {
    let mut images: Vec<MeasuredImage<'n>> = Vec::new();
    engine::ordered(
        threads,
        read,
        || measurers.iter().map(Measurer::worker).collect::<Vec<_>>(),
        |workers, row: ImageRow<'n, H>| {
            let jobs = row.jobs.iter().zip(workers);
            let rows = jobs.map(|(job, worker)| {
                let measured = job.measure_row(worker)?;
                Ok((Arc::clone(job.session()), measured))
            });
            Ok((row.head, rows.collect::<Result<Vec<_>, PipelineError>>()?))
        },
        |(head, rows)| {
            // Rows come in order, so that the image of the first row is complete before another one begins.
            if images.is_empty() {
                let sessions = rows.iter().map(|(session, _)| Arc::clone(session).begin());
                images = sessions.collect::<Result<_, _>>()?;
            }
            let count = rows.first().map_or(0, |(_, row)| row.galaxies.len());
            for (image, (_, row)) in images.iter_mut().zip(rows) {
                image.add(row);
            }
            done(Measured::Galaxies(count))?;
            if images.iter().all(MeasuredImage::is_complete) {
                let batches = images.drain(..).map(MeasuredImage::finish).collect();
                done(Measured::Image(&head, batches))?;
            }
            Ok(())
        },
    )
}

#[derive(Debug)]
pub struct FolderMeasurement<'a> {
    run: &'a Run,
    data: &'a DataFolder,
    out: &'a Path,
    images: &'a [ImageId],
    // Number of images without a catalogue, and the stamps of the first one.
    todo: Option<(usize, Mosaic)>,
}

impl<'a> FolderMeasurement<'a> {
    /// Plans the measurement of `images` of the run's data into catalogues in `out`. Catalogues of the same settings
    /// that are there already are kept. Only [`FolderMeasurement::write_catalogues`] writes.
    pub fn open(
        run: &'a Run,
        data: &'a DataFolder,
        out: &'a Path,
        images: &'a [ImageId],
    ) -> Result<Self, PipelineError> {
        // Opened before anything is written: a folder whose first image cannot be read stays as it is.
        let (todo, _) = catalogue::to_do(run, out, images);
        let first = todo.first().map(|&id| {
            let source = ImageSource::open(data, id, &run.configuration)?;
            Ok::<_, PipelineError>((todo.len(), source.mosaic()))
        });
        Ok(FolderMeasurement {
            run,
            data,
            out,
            images,
            todo: first.transpose()?,
        })
    }

    /// Galaxies to be measured, if all images are as large as the first.
    pub fn galaxies(&self) -> u64 {
        self.todo
            .map_or(0, |(images, mosaic)| (images * mosaic.galaxies) as u64)
    }

    /// Measures the images that have no catalogue yet.
    pub fn write_catalogues(
        self,
        threads: usize,
        progress: &mut dyn Progress,
    ) -> Result<Summary, PipelineError> {
        let mut catalogues = CatalogueWriter::claim(self.run, self.out, self.images)?;
        let inputs = Inputs::new(self.run, self.data, self.images)?;
        // Catalogues of an earlier call are kept only if their images are still the same.
        inputs.verify(self.out, &catalogues.done, &Pool::new(threads)?)?;
        let Some((_, mosaic)) = self.todo else {
            return catalogues.finish(progress);
        };
        let measurer = Measurer::new(&self.run.configuration, mosaic.stamp)?;
        let todo = std::mem::take(&mut catalogues.todo);
        measure_images(
            threads,
            std::slice::from_ref(&measurer),
            |feeder| self.read(&todo, &measurer, &inputs, feeder),
            |measured| {
                match measured {
                    Measured::Galaxies(count) => progress.advance(count as u64),
                    Measured::Image(head, batches) => {
                        for batch in batches {
                            catalogues.add(head, &batch, progress)?;
                        }
                    }
                }
                Ok(())
            },
        )
        .map_err(|error| catalogues.explain(error))?;
        catalogues.finish(progress)
    }

    fn read(
        &self,
        todo: &[ImageId],
        measurer: &Measurer,
        inputs: &Inputs<'_>,
        feeder: &mut Feeder<'_, ImageRow<'static, ImageHead>>,
    ) -> Result<(), PipelineError> {
        for &id in todo {
            let prints = inputs.prints(id)?;
            let ids = self.run.epochs_of(self.data, id)?;
            let mut sources = open_epochs(self.data, &ids, measurer)?;
            let mut sessions = Vec::new();
            for (id, source) in ids.iter().zip(&mut sources) {
                self.check_side(*id, source.mosaic(), measurer)?;
                sessions.push(source.session(measurer, feeder.ahead())?);
            }
            let first = sessions.remove(0);
            // Named by its file: the user has to find the exposure that differs.
            let differs = sessions.iter().position(|one| one.frame() != first.frame());
            let odd = differs.map_or(0, |at| at + 1);
            let first = first.with_epochs(sessions);
            let first = first.map_err(|error| sources[odd].named(error.into()))?;
            let first = Arc::new(first);
            let mosaic = sources[0].mosaic();
            let head = Arc::new(ImageHead {
                id,
                mosaic,
                table: sources[0].table.take(),
                epochs: sources.iter().map(|source| source.path.clone()).collect(),
                aligned: sources.iter().all(|source| source.aligned),
                prints,
            });
            let (own, others) = sources.split_first_mut().expect("a set has an image");
            for row in 0..mosaic.rows() {
                let row = ImageRow {
                    head: Arc::clone(&head),
                    jobs: vec![first.read_epochs(own, others, row)?],
                };
                if !feeder.push(row) {
                    return Ok(());
                }
            }
        }
        Ok(())
    }

    // The method is planned once, for one size of stamps.
    fn check_side(
        &self,
        id: ImageId,
        mosaic: Mosaic,
        measurer: &Measurer,
    ) -> Result<(), FileError> {
        let stamp = measurer.full();
        if mosaic.stamp == stamp {
            return Ok(());
        }
        let message = format!(
            "the stamps have {} pixels a side; the stamps of earlier images have {stamp}",
            mosaic.stamp
        );
        Err(FileError::new(
            self.data.galaxies(id.set, id.image),
            message,
        ))
    }
}

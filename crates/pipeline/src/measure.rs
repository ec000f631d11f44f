//! Measuring a data folder: rows of stamps in, one catalogue per image out.
//!
//! A [`Session`] opens an image, surveys its noise, and reads its rows of stamps. Workers measure the rows. The
//! catalogue is written when all rows of an image are measured.

mod catalogue;
mod head;
mod noise;
mod psfs;
mod row;
mod some_rows;
mod source;

use std::path::Path;

use shearq_files::FileError;
use shearq_measure::{Measurer, calibrate};

pub use self::catalogue::{
    COLUMNS, KEYS, PSF_NOISE, Summary, Value, all_flagged, more_columns, stated_frame,
    stated_psf_noise,
};
pub(crate) use self::catalogue::{Catalogues, metadata};
pub(crate) use self::head::check_strip;
pub use self::head::{ImageHead, StampRow};
pub use self::row::{MeasuredRow, measure_row};
pub use self::source::ImageSource;
pub(crate) use self::source::open_galaxies;
use crate::PipelineError;
use crate::data::layout::DataFolder;
use crate::data::mosaic::Mosaic;
use crate::data::run::Run;
use crate::engine::{self, Feeder, Progress};
use crate::images::ImageId;
use crate::inputs::Inputs;

/// The measurement of images of a data folder.
#[derive(Debug)]
pub struct Session<'a> {
    run: &'a Run,
    data: &'a DataFolder,
    out: &'a Path,
    images: &'a [ImageId],
    /// Number of images to measure, and the stamps of the first of them.
    todo: Option<(usize, Mosaic)>,
}

impl<'a> Session<'a> {
    /// Plans the measurement of `images` of the run's data into catalogues in `out`. Catalogues of the same settings
    /// that are there already are kept. Only [`Session::measure`] writes.
    ///
    /// # Errors
    /// If the first image or its PSF cannot be used.
    pub fn open(
        run: &'a Run,
        data: &'a DataFolder,
        out: &'a Path,
        images: &'a [ImageId],
    ) -> Result<Self, PipelineError> {
        let (todo, _) = catalogue::to_do(run, out, images);
        let first = todo.first().map(|&id| {
            let source = ImageSource::open(data, id, &run.configuration)?;
            Ok::<_, PipelineError>((todo.len(), source.head().mosaic))
        });
        Ok(Session {
            run,
            data,
            out,
            images,
            todo: first.transpose()?,
        })
    }

    /// Galaxies to be measured, if all images have as many as the first.
    pub fn galaxies(&self) -> u64 {
        self.todo
            .map_or(0, |(images, mosaic)| (images * mosaic.galaxies) as u64)
    }

    /// Measures the images and writes their catalogues.
    ///
    /// # Errors
    /// If the folder contains results of other settings, data are absent or damaged, or a catalogue cannot be written.
    pub fn measure(
        self,
        threads: usize,
        progress: &mut dyn Progress,
    ) -> Result<Summary, PipelineError> {
        let mut catalogues = Catalogues::claim(self.run, self.out, self.images)?;
        let inputs = Inputs::new(self.run, self.data, self.images)?;
        inputs.verify(self.out, &catalogues.done, threads)?;
        let Some((_, mosaic)) = self.todo else {
            return catalogues.finish(progress);
        };
        let configuration = &self.run.configuration;
        let measurer = Measurer::new(configuration, mosaic.stamp)?;
        let todo = std::mem::take(&mut catalogues.todo);
        let mut rows = Vec::new();
        engine::ordered(
            threads,
            |feeder| self.read(&todo, &measurer, &inputs, feeder),
            || measurer.worker(),
            |worker, row: StampRow| measure_row(worker, &row),
            |row: MeasuredRow| {
                progress.advance(row.galaxies.len() as u64);
                let count = row.head.mosaic.rows();
                rows.push(row);
                if rows.len() == count {
                    calibrate(configuration, &mut rows);
                    catalogues.add(&rows, progress)?;
                    rows.clear();
                }
                Ok(())
            },
        )
        .map_err(|error| catalogues.explain(error))?;
        catalogues.finish(progress)
    }

    /// Reads the rows of the images in `todo`.
    fn read(
        &self,
        todo: &[ImageId],
        measurer: &Measurer,
        inputs: &Inputs<'_>,
        feeder: &mut Feeder<'_, StampRow>,
    ) -> Result<(), PipelineError> {
        for (k, &id) in todo.iter().enumerate() {
            let prints = inputs.prints(id)?;
            let mut source = ImageSource::open(self.data, id, measurer.configuration())?;
            let (found, stamp) = (source.head().mosaic.stamp, measurer.full());
            if found != stamp {
                let path = self.data.galaxies(id.set, id.image);
                let message = format!(
                    "the stamps have {found} pixels a side; the stamps of earlier images have {stamp}"
                );
                return Err(FileError::new(path, message).into());
            }
            source.head_mut().prints = prints;
            source.survey(self.data, measurer, feeder.ahead())?;
            if k == 0 {
                source.check_correlation(self.data, measurer)?;
            }
            while let Some(row) = source.next_row()? {
                if !feeder.push(row) {
                    return Ok(());
                }
            }
        }
        Ok(())
    }
}

/// Measures `images` of the run's data into catalogues in `out`: a [`Session`] from beginning to end.
///
/// # Errors
/// As [`Session::open`] and [`Session::measure`].
pub fn measure_folder(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    images: &[ImageId],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Summary, PipelineError> {
    Session::open(run, data, out, images)?.measure(threads, progress)
}

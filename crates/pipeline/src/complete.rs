//! Checks that a folder has all its results, complete and of its settings.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::Grid;

use super::PipelineError;
use crate::measure::{metadata, open_galaxies};
use shearq_dataset::fingerprint::Inputs;
use shearq_dataset::grid::{Mosaic, psfs_of};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, SimulationRecord, Source};
use shearq_dataset::threads::{Pool, Progress};
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_files::table::{self, kept, most_rows, read_metadata};
use shearq_simulate::set::STAMP;

#[derive(Debug)]
pub enum Results<'a> {
    /// Catalogues in `out` of a run on `data`, with the true shear in `data`.
    Catalogues {
        run: &'a Run,
        /// The data that were measured; for a simulated run, `out`.
        data: &'a DataFolder,
        out: &'a Path,
    },
    Images {
        record: &'a SimulationRecord,
        data: &'a DataFolder,
    },
}

/// An image whose results are missing or wrong.
#[derive(Debug)]
pub struct Fault {
    pub id: ImageId,
    /// Its place in the list of all images, from 0.
    pub position: usize,
    pub error: FileError,
    /// The file whose absence makes the image be measured again.
    pub result: PathBuf,
}

impl Results<'_> {
    /// Number of galaxies of `images`, for progress bars: an estimate from the first that can be read.
    pub fn galaxies(&self, images: &[ImageId]) -> u64 {
        // An image that cannot be read is reported later, and must not stop the count.
        let first = images.iter().find_map(|&id| self.cells(id).ok());
        (images.len() * first.unwrap_or(0)) as u64
    }

    /// What is missing or wrong in the results of `images`, in order.
    pub fn faults(
        &self,
        images: &[ImageId],
        threads: usize,
        progress: &mut dyn Progress,
    ) -> Result<Vec<Fault>, PipelineError> {
        let mut faults = Vec::new();
        let inputs = match self {
            Results::Catalogues { run, data, .. } => Some(Inputs::new(run, data, images)?),
            Results::Images { .. } => None,
        };
        let pool = Pool::new(threads)?;
        let checked = pool.in_order(0..images.len(), |position| {
            // Images are in the order of their sets.
            let first = position == 0 || images[position - 1].set != images[position].set;
            self.check(images[position], first, inputs.as_ref())
        });
        for (position, checked) in checked.enumerate() {
            match checked {
                Ok(cells) => progress.advance(cells as u64),
                Err(error) => {
                    let id = images[position];
                    let result = self.result(id);
                    faults.push(Fault {
                        id,
                        position,
                        error: match error {
                            // It names the file, which may be one of the data.
                            PipelineError::File(error) => error,
                            other => FileError::new(&result, other),
                        },
                        result,
                    });
                }
            }
        }
        Ok(faults)
    }

    // The last file of an image to be written: if it is there, the others are.
    fn result(&self, id: ImageId) -> PathBuf {
        match self {
            Results::Catalogues { run, out, .. } => run.catalogue(out, id.set, id.image),
            Results::Images { data, .. } => data.galaxies(id.set, id.image),
        }
    }

    fn cells(&self, id: ImageId) -> Result<usize, PipelineError> {
        let settings = match self {
            Results::Catalogues { run, data, .. } => match &run.source {
                Source::Folder { .. } => return Ok(open_galaxies(data, id)?.1.galaxies),
                Source::Simulated(settings) => settings,
            },
            Results::Images { record, .. } => &record.settings,
        };
        Ok(settings.grid.pow(2))
    }

    // Returns the number of galaxies, for progress. The true shear belongs to the set, and is checked with its `first` image.
    fn check(
        &self,
        id: ImageId,
        first: bool,
        inputs: Option<&Inputs<'_>>,
    ) -> Result<usize, PipelineError> {
        let result = self.result(id);
        if !result.is_file() {
            return Err(FileError::new(result, "there is no such file").into());
        }
        let cells = self.cells(id)?;
        let simulated = match self {
            Results::Catalogues { run, .. } => {
                let prints = inputs.map_or(Ok(BTreeMap::new()), |inputs| inputs.prints(id))?;
                check_catalogue(run, id, prints, &result, cells)?;
                matches!(run.source, Source::Simulated(_))
            }
            Results::Images { record, data } => {
                check_image(record, data, id)?;
                true
            }
        };
        if let Results::Catalogues { data, .. } | Results::Images { data, .. } = self
            && first
            && simulated
        {
            let truth = data.truth(id.set);
            check_rows(
                &truth,
                table::read_truth(&truth, cells.saturating_add(1))?.height(),
                cells,
            )?;
        }
        Ok(cells)
    }
}

fn check_catalogue(
    run: &Run,
    id: ImageId,
    prints: BTreeMap<String, String>,
    path: &Path,
    cells: usize,
) -> Result<(), PipelineError> {
    // One row more than expected is enough to find that there are too many.
    let rows = table::read(path, None, cells.saturating_add(1))?.height();
    check_rows(path, rows, cells)?;
    // FITS has no room for keys of more than eight characters, so that their absence is no fault.
    let expected = kept(&metadata(run, id, prints)?, run.format);
    let found = read_metadata(path, run.format, expected.keys())?;
    let differing = expected
        .iter()
        .find(|(key, value)| found.get(*key) != Some(value));
    match differing {
        None => Ok(()),
        Some((key, _)) => {
            let message = format!(
                "its `{key}` does not match set {} image {} of this run; the file belongs to another image or to other data",
                id.set, id.image
            );
            Err(FileError::new(path, message).into())
        }
    }
}

fn check_image(
    record: &SimulationRecord,
    data: &DataFolder,
    id: ImageId,
) -> Result<(), PipelineError> {
    let (n, path) = (record.settings.grid, data.galaxies(id.set, id.image));
    let side = n * STAMP;
    let image = ImageReader::open(&path)?;
    if (image.width(), image.height()) != (side, side) {
        let message = format!(
            "the image is {} × {} pixels; expected {side} × {side}",
            image.width(),
            image.height()
        );
        return Err(FileError::new(&path, message).into());
    }
    // A truncated file has a whole header, which states pixels that are missing.
    let bytes = std::fs::metadata(&path)
        .map_err(FileError::doing(&path, "cannot open the image"))?
        .len();
    let least = (side * side * size_of::<f32>()) as u64;
    if bytes < least {
        let message = format!("the file has {bytes} bytes; its pixels take {least}");
        return Err(FileError::new(&path, message).into());
    }
    ImageReader::open(data.psf_star(id.set, id.image))?;
    let field = Degrees(data.layout().field_degrees);
    let grid =
        Grid::new(n, Pixels(STAMP as f64), field).map_err(|error| FileError::new(&path, error))?;
    psfs_of(
        &data.psf_functional(id.set, id.image),
        &Mosaic::square(n, STAMP),
    )?;
    let intrinsic = data.intrinsic(id.set, id.image);
    check_rows(
        &intrinsic,
        table::read(&intrinsic, None, most_rows(grid.cells()))?.height(),
        grid.cells(),
    )?;
    Ok(())
}

fn check_rows(path: &Path, rows: usize, expected: usize) -> Result<(), FileError> {
    if rows == expected {
        return Ok(());
    }
    let message = format!("{rows} rows; expected {expected}, one for each galaxy");
    Err(FileError::new(path, message))
}

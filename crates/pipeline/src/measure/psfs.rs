//! The PSFs of an image: one for all galaxies, or one per galaxy along the rows of stamps.

use std::path::Path;
use std::sync::Arc;

use ndarray::{Array2, ArrayView2, Axis, Slice};
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::{FunctionalPsf, Psfs, Star, star, star_psf, strip};
use shearq_submissions::{Configuration, PsfCut, PsfForm};

use super::source::{StampRow, check_strip};
use crate::PipelineError;
use crate::data::layout::{DataFolder, MAX_STAMP};
use crate::data::mosaic::Mosaic;
use crate::data::psf_table;
use crate::grid::whole;
use crate::images::ImageId;

/// PSFs of one row of stamps.
#[derive(Debug, Clone)]
pub enum RowPsf {
    /// One for all galaxies of the image, cut and normalised.
    Shared(Arc<Array2<f64>>),
    /// A strip of star stamps of `side` pixels, row-major, one per galaxy.
    Stars {
        /// Pixels of the strip.
        pixels: Vec<f32>,
        /// Side of one star stamp.
        side: usize,
    },
    /// Parameters, one per galaxy.
    Functional(Vec<FunctionalPsf>),
}

impl RowPsf {
    /// The PSFs of the first `count` galaxies of a row of `columns`, as they are measured with.
    ///
    /// # Errors
    /// If a strip has another number of pixels.
    pub(super) fn view(&self, columns: usize, count: usize) -> Result<Psfs<'_, f32>, PipelineError> {
        Ok(match self {
            RowPsf::Shared(psf) => Psfs::Prepared(psf.view()),
            RowPsf::Stars { pixels, side } => {
                let stars = strip(pixels, columns, *side)?;
                Psfs::Stars(stars.slice_axis_move(Axis(0), Slice::from(..count)))
            }
            RowPsf::Functional(field) => Psfs::Functional(field),
        })
    }
}

/// The PSFs of an image, read along its rows.
pub(super) enum PsfSource {
    Shared(Arc<Array2<f64>>),
    Stars {
        image: Box<ImageReader>,
        side: usize,
    },
    Functional(Vec<FunctionalPsf>),
}

impl PsfSource {
    /// The PSFs of row `iy`; rows are read in order.
    ///
    /// # Errors
    /// If star stamps cannot be read.
    pub(super) fn next_row(&mut self, mosaic: Mosaic, iy: usize) -> Result<RowPsf, FileError> {
        Ok(match self {
            PsfSource::Shared(psf) => RowPsf::Shared(Arc::clone(psf)),
            PsfSource::Stars { image, side } => RowPsf::Stars {
                pixels: image.read_rows(*side)?,
                side: *side,
            },
            PsfSource::Functional(field) => {
                let first = iy * mosaic.columns;
                RowPsf::Functional(field[first..first + mosaic.of_row(iy)].to_vec())
            }
        })
    }
}

/// Opens the PSFs of an image. Returns also the offset of the star for all galaxies if it was moved to the centre of its
/// stamp.
///
/// # Errors
/// If the PSFs cannot be read, or do not fit the configuration or the galaxies.
pub(super) fn open_psf(
    data: &DataFolder,
    id: ImageId,
    configuration: &Configuration,
    mosaic: &Mosaic,
) -> Result<(PsfSource, Option<[f64; 2]>), FileError> {
    let cut = configuration.psf_cut();
    match configuration.psf.form {
        PsfForm::Functional => {
            let path = data.psf_functional(id.set, id.image);
            Ok((open_functional(&path, cut, mosaic)?, None))
        }
        PsfForm::Star => open_stars(&data.psf_star(id.set, id.image), cut, mosaic),
    }
}

fn open_functional(path: &Path, cut: PsfCut, mosaic: &Mosaic) -> Result<PsfSource, FileError> {
    let rows = psf_table::read(path, mosaic)?;
    if let Some(wide) = rows.iter().find(|psf| psf.fwhm > cut.size as f64) {
        let message = format!(
            "a PSF has a FWHM of {} px; expected at most the {} pixels a side of the configuration's PSF stamp",
            wide.fwhm, cut.size
        );
        return Err(FileError::new(path, message));
    }
    let [psf] = rows.as_slice() else {
        return Ok(PsfSource::Functional(rows));
    };
    let stamp = psf.stamp_beside(cut.size, mosaic.stamp);
    if stamp.iter().any(|value| !value.is_finite()) {
        let message = format!(
            "a PSF with a FWHM of {} px has no light on its stamp; expected a width of about a pixel or more",
            psf.fwhm
        );
        return Err(FileError::new(path, message));
    }
    Ok(PsfSource::Shared(Arc::new(stamp)))
}

fn open_stars(
    path: &Path,
    cut: PsfCut,
    mosaic: &Mosaic,
) -> Result<(PsfSource, Option<[f64; 2]>), FileError> {
    let least = cut.least;
    let mut image = ImageReader::open(path)?;
    let (width, height) = (image.width(), image.height());
    let (columns, rows) = (mosaic.columns, mosaic.rows());
    let side = match whole(&image, path, "STAMP", MAX_STAMP)? {
        Some(side) => side,
        // One star is never as large as a mosaic of the smallest PSF stamps that could be used.
        None if width >= columns * least
            && width.is_multiple_of(columns)
            && height == rows * (width / columns) =>
        {
            width / columns
        }
        None => width,
    };
    if side < least {
        let message =
            format!("the PSF stamp has {side} pixels a side; the configuration requires {least}");
        return Err(FileError::new(path, message));
    }
    let stars = whole(&image, path, "NSTAMPS", columns * rows)?;
    if let Some(stars) = stars.filter(|stars| *stars != 1 && *stars != mosaic.galaxies) {
        let message = format!(
            "the header key NSTAMPS is {stars}; expected 1, or {}, one per galaxy",
            mosaic.galaxies
        );
        return Err(FileError::new(path, message));
    }
    let one = (width, height) == (side, side);
    if mosaic.galaxies > 1 && (width, height) == (columns * side, rows * side) {
        check_strip(path, columns, side)?;
        let image = Box::new(image);
        return Ok((PsfSource::Stars { image, side }, None));
    }
    if !one || side > MAX_STAMP {
        let message = format!(
            "the star image is {width} × {height} pixels; expected one stamp, or {columns} × {rows} stamps, one per galaxy, of {0} × {0} pixels",
            side.min(MAX_STAMP)
        );
        return Err(FileError::new(path, message));
    }
    let pixels = image.read_rows(height)?;
    let stamp = ArrayView2::from_shape((height, width), &pixels)
        .map_err(|error| FileError::new(path, error))?;
    let Star { psf, moved } = star(stamp, cut).map_err(|error| FileError::new(path, error))?;
    Ok((PsfSource::Shared(Arc::new(psf)), moved))
}

/// The PSF by which galaxy `ix` of a row is deconvolved.
///
/// # Errors
/// If it cannot be used.
pub fn psf_of(row: &StampRow, ix: usize, cut: PsfCut) -> Result<Array2<f64>, PipelineError> {
    let mosaic = row.head.mosaic;
    Ok(match &row.psf {
        RowPsf::Shared(psf) => psf.as_ref().clone(),
        RowPsf::Stars { pixels, side } => {
            let stars = strip(pixels, mosaic.columns, *side)?;
            star_psf(stars.index_axis(Axis(0), ix), cut)?
        }
        RowPsf::Functional(field) => field[ix].stamp_beside(cut.size, mosaic.stamp),
    })
}

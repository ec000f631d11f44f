//! The PSFs of an image: one for all galaxies, or one per galaxy along the rows of stamps.

use std::path::Path;

use ndarray::{ArcArray2, ArrayView2};
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::{FunctionalPsf, Psfs, Star};
use shearq_submissions::{Configuration, PsfCut, PsfForm};

use super::stamps::{check_strip, read_row, stated_image};
use crate::PipelineError;
use crate::wcs::Wcs;
use shearq_dataset::grid::whole;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, MAX_STAMP};
use shearq_dataset::mosaic::Mosaic;
use shearq_dataset::psf_table;

/// The PSFs of an image.
pub(super) enum PsfSource {
    Shared(ArcArray2<f64>),
    Stars {
        image: Box<ImageReader>,
        side: usize,
    },
    Functional(Vec<FunctionalPsf>),
}

impl PsfSource {
    /// The PSFs of a row.
    ///
    /// # Errors
    /// If star stamps cannot be read.
    pub(super) fn row(
        &mut self,
        mosaic: Mosaic,
        row: usize,
    ) -> Result<Psfs<'static>, PipelineError> {
        Ok(match self {
            PsfSource::Shared(psf) => Psfs::Prepared(psf.clone()),
            PsfSource::Stars { image, side } => Psfs::Stars(read_row(image, mosaic, *side, row)?),
            PsfSource::Functional(field) => {
                let first = row * mosaic.columns;
                Psfs::functional(field[first..first + mosaic.of_row(row)].to_vec())
            }
        })
    }
}

/// The PSFs of an image, and what is known about their file.
pub(super) struct OpenPsfs {
    pub(super) source: PsfSource,
    /// Offset of the star for all galaxies in pixels, if it was moved to the centre of its stamp.
    pub(super) moved: Option<[f64; 2]>,
    pub(super) wcs: Wcs,
    /// Set and image that the header states.
    pub(super) stated: Option<[u32; 2]>,
}

/// Opens the PSFs of an image.
///
/// # Errors
/// If the PSFs cannot be read, or do not fit the configuration or the galaxies.
pub(super) fn open_psf(
    data: &DataFolder,
    id: ImageId,
    configuration: &Configuration,
    mosaic: &Mosaic,
) -> Result<OpenPsfs, FileError> {
    let cut = configuration.psf_cut();
    match configuration.psf.form {
        PsfForm::Functional => {
            let path = data.psf_functional(id.set, id.image);
            Ok(OpenPsfs {
                source: open_functional(&path, cut, mosaic)?,
                moved: None,
                wcs: Wcs::default(),
                stated: None,
            })
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
    Ok(PsfSource::Shared(stamp.into_shared()))
}

fn open_stars(path: &Path, cut: PsfCut, mosaic: &Mosaic) -> Result<OpenPsfs, FileError> {
    let least = cut.least;
    let mut image = ImageReader::open(path)?;
    let (wcs, stated) = (Wcs::of_header(&image), stated_image(&image));
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
        let message = format!(
            "the PSF stamp has {side} pixels a side; the configuration requires {least}. Try: larger PSF stamps, or psf.size = {side} in a settings file"
        );
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
        return Ok(OpenPsfs {
            source: PsfSource::Stars { image, side },
            moved: None,
            wcs,
            stated,
        });
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
    let Star { psf, moved } = Star::cut(stamp, cut).map_err(|error| FileError::new(path, error))?;
    Ok(OpenPsfs {
        source: PsfSource::Shared(psf.into_shared()),
        moved,
        wcs,
        stated,
    })
}

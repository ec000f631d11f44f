//! The PSFs of a gathered image.

use std::path::{Path, PathBuf};

use ndarray::{ArrayView2, ArrayView3};
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_measure::{EXAMINED_PSFS, Examination, Psfs, Star, Warning, average_stars, star};
use shearq_submissions::PsfCut;

use super::Stack;
use super::rows::{Rows, first};
use super::source::{Files, Planes};
use crate::data::layout::DataFolder;
use crate::data::mosaic::Mosaic;
use crate::data::psf_table;
use crate::images::ImageId;

/// Pixels a side of a PSF that are examined: as many as configurations use.
const EXAMINED_SIDE: usize = 48;
/// Most pixels of stars that are averaged. All of them are in memory.
const MOST_AVERAGED: usize = 1 << 24;

/// The PSFs of an image, not yet written.
pub(super) struct GatheredPsfs {
    pub(super) file: PsfFile,
    pub(super) examination: Examination,
    /// Notes and warnings.
    pub(super) messages: Vec<String>,
    /// Pixel scale in arcseconds, if the header states it.
    pub(super) scale: Option<f64>,
    /// The first file of PSFs, for messages.
    pub(super) first: PathBuf,
}

/// Reads the PSFs of an image: functional PSFs of a table, or stars.
///
/// # Errors
/// If they cannot be read, or their number does not fit the galaxies.
pub(super) fn gather_psfs(
    data: &DataFolder,
    id: ImageId,
    files: Files<'_>,
    mosaic: &Mosaic,
) -> Result<GatheredPsfs, FileError> {
    if let [table] = files.paths
        && table
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
    {
        return functional(data.psf_functional(id.set, id.image), table, mosaic);
    }
    let stack = Stack::of(files)?;
    let Stack { count, side, .. } = stack;
    let path = data.psf_star(id.set, id.image);
    // Stars of a field, not one star too few of one per galaxy.
    if count > 1 && 2 * count <= mosaic.galaxies {
        return averaged(&path, files, &stack);
    }
    // No list of files is empty.
    check_count(&files.paths[0], count, mosaic)?;
    // One, or one per galaxy in the same places.
    let mut image = Rows::create(&path, Mosaic::of(count, side), &[])?;
    let mut planes = Planes::of(files);
    let mut examination = Examination::new(side, 0);
    if count > 1 {
        examination = examination.with_psf_of_each();
    }
    let mut dark = 0;
    while let Some((origin, pixels)) = planes.next()? {
        let light: f64 = pixels.iter().map(|&value| f64::from(value)).sum();
        if !(light > 0.0 && light.is_finite()) {
            if count == 1 {
                let message =
                    format!("the pixels of the PSF add up to {light}; expected a positive sum");
                return Err(origin.fault(&message));
            }
            dark += 1;
        }
        if let Ok(stamp) = ArrayView2::from_shape((side, side), &pixels)
            && let Ok(Star { psf, moved }) = star(stamp, examined_cut(side))
        {
            examination.add_psf(psf.view(), moved);
        }
        image.add(&pixels)?;
    }
    let mut messages = named(&examination, &files.paths[0]);
    if dark > 0 {
        messages.push(format!(
            "warning: {dark} of {count} PSFs have no positive sum of pixels. Their galaxies will be flagged"
        ));
    }
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        scale: stack.scale,
        first: files.paths[0].clone(),
    })
}

/// Checks that there is one PSF, or one per galaxy.
fn check_count(path: &Path, found: usize, mosaic: &Mosaic) -> Result<(), FileError> {
    if found == 1 || found == mosaic.galaxies {
        return Ok(());
    }
    let message = format!(
        "there are {found} PSFs; expected one, or one for each of the {} stamps",
        mosaic.galaxies
    );
    Err(FileError::new(path, message))
}

/// The part of a PSF stamp of `side` pixels that is examined.
fn examined_cut(side: usize) -> PsfCut {
    let size = side - side.saturating_sub(EXAMINED_SIDE).next_multiple_of(2);
    PsfCut {
        size,
        // So that a star off the centre can be cut around itself.
        least: size - (size / 3).next_multiple_of(2),
        centred: false,
    }
}

/// Functional PSFs of a table, in the order of the galaxies.
fn functional(path: PathBuf, table: &Path, mosaic: &Mosaic) -> Result<GatheredPsfs, FileError> {
    let mut rows = psf_table::read_all(table)?;
    check_count(table, rows.len(), mosaic)?;
    for (place, (position, _)) in rows.iter_mut().enumerate() {
        *position = mosaic.position(place);
    }
    let mut examination = Examination::new(mosaic.stamp, 0);
    let psfs: Vec<_> = rows.iter().map(|(_, psf)| *psf).collect();
    let cut = examined_cut(mosaic.stamp);
    examination.add_psfs(&Psfs::functional(psfs), cut, EXAMINED_PSFS);
    Ok(GatheredPsfs {
        file: PsfFile::Table(path, psf_table::text(&rows)),
        examination,
        messages: Vec::new(),
        scale: None,
        first: table.to_owned(),
    })
}

/// The average of several stars, as the PSF of all galaxies.
fn averaged(
    path: &Path,
    files: Files<'_>,
    &Stack { count, side, scale }: &Stack,
) -> Result<GatheredPsfs, FileError> {
    let first = &files.paths[0];
    let pixels = count * side * side;
    if pixels > MOST_AVERAGED {
        let message = format!(
            "there are {count} stars of {side} × {side} pixels to average ({pixels} pixels, expected at most {MOST_AVERAGED}). Try: fewer stars"
        );
        return Err(FileError::new(first, message));
    }
    let mut all = Vec::with_capacity(pixels);
    let mut planes = Planes::of(files);
    while let Some((_, pixels)) = planes.next()? {
        all.extend(pixels.iter().map(|&value| f64::from(value)));
    }
    let stars = ArrayView3::from_shape((count, side, side), &all)
        .map_err(|error| FileError::new(first, error))?;
    let psf = average_stars(stars, examined_cut(side))
        .map_err(|(k, error)| FileError::new(first, format!("star {k}: {error}")))?;
    let shown = first.display();
    let mut messages = vec![format!(
        "note: {shown}: {count} stars were averaged to one PSF for all galaxies"
    )];
    let mut examination = Examination::new(side, 0);
    examination.add_psf(psf.view(), None);
    messages.extend(named(&examination, first));
    let mut image = Rows::create(path, Mosaic::of(1, psf.nrows()), &[])?;
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    image.add(&pixels)?;
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        scale,
        first: first.clone(),
    })
}

/// The warnings of an examination, with the file that they are about.
fn named(examination: &Examination, path: &Path) -> Vec<String> {
    let found = examination.warnings();
    let line = |warning: &Warning| format!("warning: {}: {warning}", path.display());
    found.iter().map(line).collect()
}

/// PSFs that are about to be written.
pub(super) enum PsfFile {
    Stars(Box<Rows>),
    Table(PathBuf, String),
}

impl PsfFile {
    pub(super) fn finish(self) -> Result<(), FileError> {
        match self {
            PsfFile::Stars(image) => image.finish(),
            PsfFile::Table(path, text) => {
                first(atomic::write_if_absent(&path, text.as_bytes())?, path)
            }
        }
    }
}

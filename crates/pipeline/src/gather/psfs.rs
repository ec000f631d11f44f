//! The PSFs of a gathered image.

use std::path::{Path, PathBuf};

use ndarray::{ArrayView2, ArrayView3};
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_measure::{EXAMINED_PSFS, Examination, Psfs, Star, Warning, average_stars};
use shearq_submissions::PsfCut;
use shearq_submissions::limits::MIN_PSF;

use super::source::{Files, Planes};
use super::stamps::{Rows, central, first};
use super::{Square, Stack};
use crate::wcs::Wcs;
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::psf_table;

// Central pixels of a PSF that are examined, along each axis: those that configurations use.
const EXAMINED_SIDE_PX: usize = 48;
// Largest side of a grid of stars that is looked for in a PSF image. GREAT3 has 3 × 3 stars. Chosen by hand.
const MAX_GRID_STARS: usize = 10;
// Smallest side of the square of a star in such a grid. Chosen by hand.
const MIN_STAR_CELL_PX: usize = 16;
// Peak of each star in units of the brightest one: noise and wings beside a single star are fainter. Chosen by hand.
const MIN_PEAK_RATIO: f32 = 0.5;
// Fewest galaxies per star whose stars are averaged: with fewer, some of one PSF per galaxy are missing. Chosen by hand.
const MIN_GALAXIES_PER_STAR: usize = 2;
// Averaged stars are in memory together: 128 MB in double precision. Chosen by hand.
const MAX_AVERAGED_PIXELS: usize = 1 << 24;

pub(super) struct GatheredPsfs {
    pub(super) file: PsfFile,
    pub(super) examination: Examination,
    pub(super) messages: Vec<String>,
    pub(super) wcs: Wcs,
    pub(super) first: PathBuf,
}

pub(super) fn gather_psfs(
    data: &DataFolder,
    id: ImageId,
    files: Files<'_>,
    square: Option<Square>,
    mosaic: &Mosaic,
) -> Result<GatheredPsfs, FileError> {
    if let [table] = files.paths
        && table
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
    {
        return functional(data.psf_functional(id.set, id.image), table, mosaic);
    }
    let (stack, mut messages) = Stack::of(files, square)?;
    let &Stack {
        count,
        side,
        ref wcs,
        ..
    } = &stack;
    messages.extend(stack.differs.clone());
    messages.extend(small(&files.paths[0], side));
    let path = data.psf_star(id.set, id.image);
    if count > 1 && MIN_GALAXIES_PER_STAR * count <= mosaic.galaxies {
        return averaged(&path, files, &stack, messages);
    }
    check_count(&files.paths[0], count, mosaic)?;
    // One, or one per galaxy in the same places.
    let mut image = Rows::create(&path, Mosaic::of(count, side), &wcs.keys())?;
    let mut planes = Planes::of(files);
    let mut examination = Examination::new(side, 0);
    if count > 1 {
        examination = examination.with_psf_of_each();
    }
    let mut dark = 0;
    while let Some((origin, pixels)) = planes.next()? {
        let pixels = central(pixels, planes.sides(), side);
        if count == 1 {
            messages.extend(several_stars(&files.paths[0], &pixels, side));
        }
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
            && let Ok(Star { psf, moved }) = Star::cut(stamp, examined_cut(side))
        {
            examination.add_psf(psf.view(), moved);
        }
        image.add(&pixels)?;
    }
    messages.extend(named(&examination, &files.paths[0]));
    if dark > 0 {
        messages.push(format!(
            "warning: {dark} of {count} PSFs have no positive sum of pixels. Their galaxies will be flagged"
        ));
    }
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        wcs: wcs.clone(),
        first: files.paths[0].clone(),
    })
}

// Named configurations refuse such PSF stamps. Users should learn it before they have gathered all images.
fn small(path: &Path, side: usize) -> Option<String> {
    let shown = path.display();
    (side < MIN_PSF).then(|| {
        format!(
            "warning: {shown}: the PSF stamps are {side} × {side} px (expected {MIN_PSF} × {MIN_PSF} or more, which configurations of 48 px require). Try: larger PSF stamps; or, if no light is beyond them, --submission own.toml with the file own.toml of these lines:\n  extends = \"48/linear/star\"\n  psf.size = {side}"
        )
    })
}

// A warning about an image that is a grid of stars, as in GREAT3.
fn several_stars(path: &Path, pixels: &[f32], side: usize) -> Option<String> {
    let brightest = |n: usize| {
        let cell = side / n;
        let square = move |k: usize| {
            let places = (0..cell * cell).map(move |at| {
                let (x, y) = (k % n * cell + at % cell, k / n * cell + at / cell);
                (at, pixels[y * side + x])
            });
            places.max_by(|a, b| a.1.total_cmp(&b.1))
        };
        (0..n * n).filter_map(square).collect::<Vec<_>>()
    };
    let is_grid = |n: &usize| {
        let cell = side / n;
        let found = brightest(*n);
        let most = found.iter().map(|(_, value)| *value).fold(0.0, f32::max);
        let middle = |at: usize| (cell / 4..cell - cell / 4).contains(&at);
        let star = |&(at, value): &(usize, f32)| {
            value > MIN_PEAK_RATIO * most && middle(at % cell) && middle(at / cell)
        };
        found.iter().all(star)
    };
    let mut grids =
        (2..=MAX_GRID_STARS).filter(|n| side.is_multiple_of(*n) && side / n >= MIN_STAR_CELL_PX);
    let n = grids.find(is_grid)?;
    let (shown, cell, stars) = (path.display(), side / n, n * n);
    Some(format!(
        "warning: {shown}: the image has {n} × {n} stars (found a peak in each square of {cell} × {cell} px; expected one star). The brightest is used. Try: a cube of {stars} stamps of {cell} × {cell} px, which are averaged to one PSF"
    ))
}

fn check_count(path: &Path, found: usize, mosaic: &Mosaic) -> Result<(), FileError> {
    if found == 1 || found == mosaic.galaxies {
        return Ok(());
    }
    let message = format!(
        "there are {found} PSFs; expected one, or one for each of the {} stamps. Several stars are averaged if there are at least twice as many stamps",
        mosaic.galaxies
    );
    Err(FileError::new(path, message))
}

fn examined_cut(side: usize) -> PsfCut {
    let size = side - side.saturating_sub(EXAMINED_SIDE_PX).next_multiple_of(2);
    PsfCut {
        size,
        // So that a star off the centre can be cut around itself.
        least: size - (size / 3).next_multiple_of(2),
        centred: false,
    }
}

// In the order of the galaxies, like stars. Positions in the mosaic replace the positions of the table, which are on another image.
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
        wcs: Wcs::default(),
        first: table.to_owned(),
    })
}

// The average of several stars, as the PSF of all galaxies.
fn averaged(
    path: &Path,
    files: Files<'_>,
    &Stack {
        count,
        side,
        ref wcs,
        ..
    }: &Stack,
    mut messages: Vec<String>,
) -> Result<GatheredPsfs, FileError> {
    let first = &files.paths[0];
    let pixels = count * side * side;
    if pixels > MAX_AVERAGED_PIXELS {
        let message = format!(
            "there are {count} stars of {side} × {side} pixels to average ({pixels} pixels, expected at most {MAX_AVERAGED_PIXELS}). Try: fewer stars"
        );
        return Err(FileError::new(first, message));
    }
    let mut all = Vec::with_capacity(pixels);
    let mut planes = Planes::of(files);
    while let Some((_, pixels)) = planes.next::<f32>()? {
        let pixels = central(pixels, planes.sides(), side);
        all.extend(pixels.iter().map(|&value| f64::from(value)));
    }
    let stars = ArrayView3::from_shape((count, side, side), &all)
        .map_err(|error| FileError::new(first, error))?;
    let psf = average_stars(stars, examined_cut(side))
        .map_err(|(k, error)| FileError::new(first, format!("star {k}: {error}")))?;
    let shown = first.display();
    messages.push(format!(
        "note: {shown}: {count} stars were averaged to one PSF for all galaxies"
    ));
    let mut examination = Examination::new(side, 0);
    examination.add_psf(psf.view(), None);
    messages.extend(named(&examination, first));
    let mut image = Rows::create(path, Mosaic::of(1, psf.nrows()), &wcs.keys())?;
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    image.add(&pixels)?;
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        wcs: wcs.clone(),
        first: first.clone(),
    })
}

/// The warnings of an examination, with the file that they are about.
fn named(examination: &Examination, path: &Path) -> Vec<String> {
    let found = examination.warnings();
    let line = |warning: &Warning| format!("warning: {}: {warning}", path.display());
    found.iter().map(line).collect()
}

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

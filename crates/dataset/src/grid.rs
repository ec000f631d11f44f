//! The stamps of an image side by side, the grid of their galaxies, and functional PSFs by their positions: tables with
//! x, y, profile, beta, fwhm, e1, e2.

use std::path::Path;

use shearq_files::fits::ImageReader;
use shearq_files::table::{self, Place};
use shearq_files::{FileError, atomic};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};
use shearq_scoring::{Grid, Row};

use crate::layout::DataFolder;
use crate::mosaic::MAX_STAMP;
pub use crate::mosaic::Mosaic;

// The header wins: folders of `gather` have stamps of any size, and the default layout has 48.
fn stamp_of_image(data: &DataFolder, path: &Path, image: &ImageReader) -> Result<usize, FileError> {
    Ok(whole(image, path, "STAMP", MAX_STAMP)?.unwrap_or(data.layout().stamp))
}

/// The stamps of an image: n × n if its header has NGRID = n, NSTAMPS along the rows if it has that, otherwise all that
/// fit.
pub fn of_image(data: &DataFolder, path: &Path, image: &ImageReader) -> Result<Mosaic, FileError> {
    let stamp = stamp_of_image(data, path, image)?;
    let (width, height) = (image.width(), image.height());
    let (columns, rows) = match whole(image, path, "NGRID", width)? {
        Some(n) => (n, n),
        None => (width / stamp, height / stamp),
    };
    // A part of a stamp at the edge shows that the side of the stamps is wrong, and all others would be cut wrongly.
    if columns == 0 || rows == 0 || (width, height) != (columns * stamp, rows * stamp) {
        let (columns, rows) = (columns.max(1), rows.max(1));
        let message = format!(
            "the image is {width} × {height} pixels; expected {columns} × {rows} stamps of {stamp} pixels a side (from the header key STAMP, or `stamp` in layout.toml)"
        );
        return Err(FileError::new(path, message));
    }
    let most = columns * rows;
    let galaxies = whole(image, path, "NSTAMPS", most)?.unwrap_or(most);
    let mosaic = Mosaic {
        columns,
        galaxies,
        stamp,
    };
    // `gather` fills all rows but the last, so that such a number belongs to another image.
    if mosaic.rows() != rows {
        let message = format!(
            "the header key NSTAMPS is {galaxies}; expected more than {}, as there are {rows} rows of {columns} stamps",
            most - columns
        );
        return Err(FileError::new(path, message));
    }
    Ok(mosaic)
}

/// Pixels a side of the stamps of a set, from its first image, or from the layout without images.
pub fn stamp_of_set(data: &DataFolder, set: u32) -> Result<usize, FileError> {
    match data.images(&[set])?.of_set(set).first() {
        Some((_, path)) => stamp_of_image(data, path, &ImageReader::open(path)?),
        None => Ok(data.layout().stamp),
    }
}

/// Grid of a catalogue of shearq, which has a row for every cell at its centre.
pub fn of_catalogue(path: &Path, rows: &[Row], field: Degrees) -> Result<Grid, FileError> {
    let n = side(path, rows.len())?;
    // The first cell is centred on (s + 1)/2 in FITS pixels, from which the stamp's side s follows.
    let whole = |cell: &Row| (cell.x == cell.y).then_some(2.0 * cell.x - 1.0);
    let stamp = rows.first().and_then(whole).unwrap_or(f64::NAN);
    let grid = Grid::new(n, Pixels(stamp), field).map_err(|error| FileError::new(path, error))?;
    let at = |k: usize| grid.centre(k % n, k / n);
    match (0..rows.len()).find(|&k| (rows[k].x, rows[k].y) != at(k)) {
        None => Ok(grid),
        Some(k) => {
            let (x, y) = at(k);
            let message = format!(
                "row {} lies at ({}, {}); expected ({x}, {y}) on a grid of {stamp} px stamps",
                k + 1,
                rows[k].x,
                rows[k].y
            );
            Err(FileError::new(path, message))
        }
    }
}

/// Side of the grid of a file with one row per cell.
pub fn side(path: &Path, rows: usize) -> Result<usize, FileError> {
    Grid::side_of(rows).ok_or_else(|| {
        let message = format!("{rows} rows; expected the square of the grid's side");
        FileError::new(path, message)
    })
}

/// A count in a header; `None` if absent. Other programs use these keys for other quantities, so that wrong values are errors.
pub fn whole(
    image: &ImageReader,
    path: &Path,
    key: &str,
    most: usize,
) -> Result<Option<usize>, FileError> {
    let Some(value) = image.number(key)? else {
        return Ok(None);
    };
    if value.fract() == 0.0 && (1.0..=most as f64).contains(&value) {
        return Ok(Some(value as usize));
    }
    let message = format!("the header key {key} is {value}; expected a whole number, 1 to {most}");
    Err(FileError::new(path, message))
}

pub type PositionedPsf = ((f64, f64), FunctionalPsf);

const PSF_COLUMNS: &str = "x,y,profile,beta,fwhm,e1,e2";

/// PSFs of an image: one, or one per galaxy along the rows of the mosaic.
pub fn psfs_of(path: &Path, mosaic: &Mosaic) -> Result<Vec<FunctionalPsf>, FileError> {
    let rows = read_psfs(path)?;
    if let [(_, psf)] = rows.as_slice() {
        return Ok(vec![*psf]);
    }
    // By position, so that the order of the rows does not matter.
    let mut field = vec![None; mosaic.galaxies];
    for ((x, y), psf) in &rows {
        let place = mosaic.place(*x, *y).ok_or_else(|| {
            FileError::new(path, format!("the position ({x}, {y}) is outside the grid"))
        })?;
        if field[place].replace(*psf).is_some() {
            let message = format!("the galaxy at ({x}, {y}) has two rows; expected one");
            return Err(FileError::new(path, message));
        }
    }
    field
        .into_iter()
        .collect::<Option<Vec<_>>>()
        .ok_or_else(|| {
            FileError::new(
                path,
                format!(
                    "{} rows; expected one, or one for each of the {} galaxies",
                    rows.len(),
                    mosaic.galaxies
                ),
            )
        })
}

/// PSFs of a table, with their positions, in its order.
pub fn read_psfs(path: &Path) -> Result<Vec<PositionedPsf>, FileError> {
    let names: Vec<&str> = PSF_COLUMNS.split(',').collect();
    let mut psfs = Vec::new();
    // As an identity, because columns of text are read as such only.
    table::read_parts(&Place::of(path), &names, &["profile"], |part| {
        let numbers = |name: &str| table::numbers(&part, name, path);
        let (x, y) = (numbers("x")?, numbers("y")?);
        let (beta, fwhm) = (numbers("beta")?, numbers("fwhm")?);
        let (e1, e2) = (numbers("e1")?, numbers("e2")?);
        let profiles = part.column("profile").and_then(|column| column.str());
        // Without rows, or with numbers alone, it is no column of text.
        let profiles = match (profiles, part.height()) {
            (_, 0) => return Ok(()),
            (Ok(profiles), _) => profiles,
            (Err(_), _) => {
                let message = "the profiles are numbers; expected `moffat` or `kolmogorov`";
                return Err(FileError::new(path, message));
            }
        };
        for (row, profile) in profiles.iter().enumerate() {
            let wrong = |what: String| {
                // Of all parts.
                let row = psfs.len() + 1;
                FileError::new(path, format!("row {row}: {what}"))
            };
            let profile = match profile.unwrap_or_default() {
                "moffat" => PsfProfile::Moffat { beta: beta[row] },
                "kolmogorov" => PsfProfile::Kolmogorov,
                other => {
                    return Err(wrong(format!(
                        "the profile is `{other}`; expected `moffat` or `kolmogorov`"
                    )));
                }
            };
            let psf = FunctionalPsf::new(profile, fwhm[row], Shear::new(e1[row], e2[row]))
                .map_err(|error| wrong(error.to_string()))?;
            psfs.push(((x[row], y[row]), psf));
        }
        Ok(())
    })?;
    Ok(psfs)
}

pub fn write_psfs(path: &Path, rows: &[PositionedPsf]) -> Result<(), FileError> {
    atomic::write(path, psfs_text(rows).as_bytes())
}

pub fn psfs_text(rows: &[PositionedPsf]) -> String {
    let mut text = format!("{PSF_COLUMNS}\n");
    for ((x, y), psf) in rows {
        // A Kolmogorov PSF has no β; the column has any valid number.
        let (profile, beta) = match psf.profile {
            PsfProfile::Moffat { beta } => ("moffat", beta),
            PsfProfile::Kolmogorov => ("kolmogorov", 3.0),
        };
        let (fwhm, e1, e2) = (psf.fwhm, psf.shape.e1, psf.shape.e2);
        text.push_str(&format!("{x},{y},{profile},{beta},{fwhm},{e1},{e2}\n"));
    }
    text
}

//! The grid of galaxies of an image, for measuring, scoring, packing and checking.

use std::path::Path;

use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Grid, Row};

use crate::layout::{DataFolder, MAX_STAMP};
use crate::mosaic::Mosaic;
use shearq_files::FileError;
use shearq_files::fits::ImageReader;

// The header wins: folders of `gather` have stamps of any size, and the default layout has 48.
fn stamp_of_image(data: &DataFolder, path: &Path, image: &ImageReader) -> Result<usize, FileError> {
    Ok(whole(image, path, "STAMP", MAX_STAMP)?.unwrap_or(data.layout().stamp))
}

/// The stamps of an image: n × n if its header has NGRID = n, NSTAMPS along the rows if it has that, otherwise as many as
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

fn square(data: &DataFolder, path: &Path, mosaic: &Mosaic) -> Result<Grid, FileError> {
    let (n, rows) = (mosaic.columns, mosaic.rows());
    // Modes are Fourier transforms on a square grid.
    if mosaic.galaxies != n * n {
        let message = format!(
            "there are {} stamps in {rows} rows of {n}; scoring expects as many rows as columns, all of them full",
            mosaic.galaxies
        );
        return Err(FileError::new(path, message));
    }
    let field = Degrees(data.layout().field_degrees);
    Grid::new(n, Pixels(mosaic.stamp as f64), field).map_err(|error| FileError::new(path, error))
}

/// Pixels a side of the stamps of a set: of its first image, or of the layout if there is no image.
pub fn stamp_of_set(data: &DataFolder, set: u32) -> Result<usize, FileError> {
    match data.images(&[set])?.of_set(set).first() {
        Some((_, path)) => stamp_of_image(data, path, &ImageReader::open(path)?),
        None => Ok(data.layout().stamp),
    }
}

pub(crate) fn of_first_image(data: &DataFolder, set: u32) -> Result<Option<Grid>, FileError> {
    let images = data.images(&[set])?.of_set(set);
    let first = images.first().map(|(_, path)| {
        let image = ImageReader::open(path)?;
        square(data, path, &of_image(data, path, &image)?)
    });
    first.transpose()
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

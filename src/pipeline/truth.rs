//! The true shear of sets.

use std::path::Path;

use shearq_scoring::units::{Degrees, Pixels};
use shearq_scoring::{Grid, TrueShear, TruthSign};

use super::grid;
use crate::io::FileError;
use crate::io::layout::{DataFolder, read_truth_rows};
use crate::io::table::MAX_ROWS;

/// How a truth file is to be read.
#[derive(Debug, Clone, Copy)]
pub struct Reading {
    /// Side of the field in degrees.
    pub field: Degrees,
    /// Pixels a side of a cell.
    pub stamp: Pixels,
    /// Sign of g2 in the truth.
    pub sign: TruthSign,
}

/// The true shear of a file on its grid, whose side is the square root of the number of rows.
///
/// # Errors
/// Where the file cannot be read or does not fill a square grid.
pub fn read_truth(truth: &Path, reading: &Reading) -> Result<(Grid, TrueShear), FileError> {
    let rows = read_truth_rows(truth, MAX_ROWS)?;
    let side = grid::side(truth, rows.len())?;
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let shear = TrueShear::from_rows(&grid, reading.sign, rows).map_err(bad)?;
    Ok((grid, shear))
}

/// How the truth of a set of a data folder is to be read.
///
/// # Errors
/// Where the set's first image cannot be read.
pub fn reading_of(data: &DataFolder, set: u32) -> Result<Reading, FileError> {
    Ok(Reading {
        field: Degrees(data.layout().field_degrees),
        stamp: Pixels(grid::stamp_of_set(data, set)? as f64),
        sign: data.layout().truth_sign,
    })
}

/// Grid of a set: that of its first image, or of its true shear where there is no image.
///
/// # Errors
/// Where neither can be read.
pub fn grid_of_set(data: &DataFolder, set: u32) -> Result<Grid, FileError> {
    match grid::of_first_image(data, set)? {
        Some(grid) => Ok(grid),
        None => Ok(read_truth(&data.truth(set), &reading_of(data, set)?)?.0),
    }
}

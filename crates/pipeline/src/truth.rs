//! The true shear of sets.

use std::path::Path;

use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Grid, TrueShear, TruthSign, sign_by_modes};

use super::grid;
use crate::data::layout::{DataFolder, SIGN_KEY, stated_sign, truth_is_there, truth_rows};
use shearq_files::table::{self, MAX_ROWS};
use shearq_files::{FileError, atomic};

/// How a truth file is to be read.
#[derive(Debug, Clone, Copy)]
pub struct Reading {
    /// Side of the field in degrees.
    pub field: Degrees,
    /// Pixels a side of a cell.
    pub stamp: Pixels,
    /// Sign of g2 in the truth, if it was specified. A file that states the other sign is refused.
    pub sign: Option<TruthSign>,
}

/// How the sign of g2 in a truth was determined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignBasis {
    /// It was specified, or the file states it.
    Specified,
    /// The true shear has (almost) no B modes with this sign, and many with the other.
    Modes(TruthSign),
    /// e2 of the catalogues correlates with the true g2 of this sign.
    Correlation(TruthSign),
    /// It is not known; the challenge's sign was assumed.
    Unknown,
}

/// A true shear on its grid.
#[derive(Debug, Clone)]
pub struct ReadTruth {
    /// The grid.
    pub grid: Grid,
    /// The shear, in the standard sign.
    pub shear: TrueShear,
    /// How its sign was determined.
    pub basis: SignBasis,
}

/// The true shear of a file on its grid, whose side is the square root of the number of rows.
///
/// # Errors
/// If the file cannot be read, does not fill a square grid, or states another sign of g2 than `reading`.
pub fn read_truth(truth: &Path, reading: &Reading) -> Result<ReadTruth, FileError> {
    let table = table::read_truth(truth, MAX_ROWS)?;
    let rows = truth_rows(truth, &table)?;
    let side = grid::side(truth, rows.len())?;
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let standard = TrueShear::from_rows(&grid, TruthSign::Standard, rows).map_err(bad)?;
    drop(table);
    let (sign, basis) = match (stated_sign(truth)?, reading.sign) {
        (Some(stated), Some(specified)) if stated != specified => {
            let word = |sign| match sign {
                TruthSign::Standard => "standard",
                TruthSign::Challenge => "challenge",
            };
            let message = format!(
                "the file states `{SIGN_KEY}: {}`, but `{}` was specified. Try: omit --truth-sign",
                word(stated),
                word(specified)
            );
            return Err(FileError::new(truth, message));
        }
        (Some(sign), _) | (None, Some(sign)) => (sign, SignBasis::Specified),
        (None, None) => match sign_by_modes(&grid, &standard).map_err(bad)? {
            Some(sign) => (sign, SignBasis::Modes(sign)),
            // Zero has no sign.
            None if standard.g2.iter().all(|g2| *g2 == 0.0) => {
                (TruthSign::Standard, SignBasis::Specified)
            }
            None => (TruthSign::Challenge, SignBasis::Unknown),
        },
    };
    let shear = match sign {
        TruthSign::Standard => standard,
        TruthSign::Challenge => standard.flipped(),
    };
    Ok(ReadTruth { grid, shear, basis })
}

/// Writes a true shear in the standard sign.
///
/// # Errors
/// If the file cannot be written.
pub fn write_truth(path: &Path, grid: &Grid, truth: &TrueShear) -> Result<(), FileError> {
    // A comment has one field, and no quotes.
    let mut text = csv::WriterBuilder::new()
        .flexible(true)
        .quote_style(csv::QuoteStyle::Never)
        .from_writer(Vec::new());
    // Writing to memory cannot fail.
    let _ = text.write_record(["x", "y", "g1", "g2"]);
    // The comment follows the header, so that readers that skip one line or a `#` read the columns.
    let sign = format!("# {SIGN_KEY}: standard (g2 > 0 is a stretch along x = y)");
    let _ = text.write_record([sign]);
    for iy in 0..grid.n {
        for ix in 0..grid.n {
            let (x, y) = grid.centre(ix, iy);
            let (g1, g2) = (truth.g1[(ix, iy)], truth.g2[(ix, iy)]);
            let _ = text.write_record([x, y, g1, g2].map(|number| number.to_string()));
        }
    }
    atomic::write(path, &text.into_inner().unwrap_or_default())
}

/// How the truth of a set of a data folder is to be read.
///
/// # Errors
/// If there is no truth, or the set's first image cannot be read.
pub fn reading_of(data: &DataFolder, set: u32) -> Result<Reading, FileError> {
    truth_is_there(&data.truth(set))?;
    Ok(Reading {
        field: Degrees(data.layout().field_degrees),
        stamp: Pixels(grid::stamp_of_set(data, set)? as f64),
        sign: Some(data.truth_sign(set)?),
    })
}

/// Grid of a set, from its first image, or from its true shear if there is no image.
///
/// # Errors
/// If neither can be read.
pub fn grid_of_set(data: &DataFolder, set: u32) -> Result<Grid, FileError> {
    match grid::of_first_image(data, set)? {
        Some(grid) => Ok(grid),
        None => Ok(read_truth(&data.truth(set), &reading_of(data, set)?)?.grid),
    }
}

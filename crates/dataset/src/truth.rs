//! The true shear of sets, the sign of its g2 and its grid.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_quantities::{hints, tried};
use shearq_scoring::{Grid, Row, TrueShear, TruthSign, sign_by_modes};

use crate::grid;
use crate::layout::{DataFolder, LAYOUT_FILE};
use shearq_files::fits::ImageReader;
use shearq_files::frames::polars::DataFrame;
use shearq_files::open::is_there;
use shearq_files::table::{self, MAX_ROWS, TRUTH_COLUMNS};
use shearq_files::{FileError, atomic};

/// Key under which a truth file states the sign of its g2: `standard` or `challenge`.
const SIGN_KEY: &str = "g2sign";

#[derive(Debug, Clone, Copy)]
pub struct Reading {
    /// Side of the field in degrees.
    pub field: Degrees,
    pub stamp: Pixels,
    /// Sign of g2 in the truth, if it was specified. A file that states the other sign is refused.
    pub sign: Option<TruthSign>,
}

/// Why the sign of g2 in a truth is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SignFault {
    #[error("the file states `{SIGN_KEY}: {}`, but `{}` was specified{}", word(*stated), word(*specified), tried(self.hint()))]
    Contradicted {
        stated: TruthSign,
        specified: TruthSign,
    },
    // There is no default, because a wrong sign turns a bias of 0 into one of -2.
    #[error("cannot determine the sign of g2 in the truth (found no statement, no E-mode field, and no slope of e2 on g2 of 5σ; expected one of them){}", tried(self.hint()))]
    Unclear,
}

impl SignFault {
    hints! {
        Self::Contradicted { .. } => "omit --truth-sign",
        Self::Unclear => &format!("--truth-sign standard (g2 > 0 along x = y), --truth-sign challenge (the other sign), or a line `# {SIGN_KEY}: standard` in the file"),
    }
}

/// How the sign of g2 in a truth was determined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SignBasis {
    /// The file states it.
    Stated,
    /// The user specified it.
    Specified,
    /// The true shear has (almost) no B modes with this sign, and many with the other.
    Modes,
    /// e2 of the catalogues follows g2 of this sign.
    Catalogues,
    /// All g2 are zero, and have no sign.
    Zero,
}

/// The sign of g2 in a truth. `score` and `bias` determine it in the same order: from the statement of the file or the
/// user ([`Sign::of_truth`]), from the E modes of the true shear, and from the catalogues ([`Sign::of_catalogues`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sign {
    pub of: TruthSign,
    pub basis: SignBasis,
}

impl Sign {
    pub const ZERO: Sign = Sign {
        of: TruthSign::Standard,
        basis: SignBasis::Zero,
    };

    /// The sign that the file states, that the user specified, or in which the shear is an E-mode field; `None` if only
    /// catalogues can determine it.
    pub fn of_truth(
        stated: Option<TruthSign>,
        specified: Option<TruthSign>,
        by_modes: impl FnOnce() -> Option<TruthSign>,
    ) -> Result<Option<Self>, SignFault> {
        let (of, basis) = match (stated, specified) {
            (Some(stated), Some(specified)) if stated != specified => {
                return Err(SignFault::Contradicted { stated, specified });
            }
            // Both agree here. The statement of the file is named, because it travels with the numbers.
            (Some(sign), _) => (sign, SignBasis::Stated),
            (None, Some(sign)) => (sign, SignBasis::Specified),
            (None, None) => match by_modes() {
                Some(sign) => (sign, SignBasis::Modes),
                None => return Ok(None),
            },
        };
        Ok(Some(Sign { of, basis }))
    }

    pub fn of_catalogues(found: Option<TruthSign>) -> Result<Self, SignFault> {
        let basis = SignBasis::Catalogues;
        found.map(|of| Sign { of, basis }).ok_or(SignFault::Unclear)
    }

    /// Which sign is used and why; `None` if no g2 has a sign.
    pub fn line(self) -> Option<String> {
        let why = match self.basis {
            SignBasis::Stated => "as the file states",
            SignBasis::Specified => "as specified",
            SignBasis::Modes => "in which the true shear is an E-mode field (not stated)",
            SignBasis::Catalogues => "which e2 of the catalogues follows (not stated)",
            SignBasis::Zero => return None,
        };
        Some(format!(
            "Sign of g2 in the truth: {}, {why}.",
            word(self.of)
        ))
    }
}

/// The sign of g2, if a truth file states it.
pub fn stated_sign(path: &Path) -> Result<Option<TruthSign>, FileError> {
    match table::stated(path, SIGN_KEY)?.as_deref() {
        None => Ok(None),
        Some("standard") => Ok(Some(TruthSign::Standard)),
        Some("challenge") => Ok(Some(TruthSign::Challenge)),
        Some(other) => {
            let message = format!("{SIGN_KEY} is `{other}`; expected `standard` or `challenge`");
            Err(FileError::new(path, message))
        }
    }
}

pub fn word(sign: TruthSign) -> &'static str {
    match sign {
        TruthSign::Standard => "standard",
        TruthSign::Challenge => "challenge",
    }
}

/// The sign in which shears at any positions are an E-mode field; `None` if they do not fill a square grid.
pub fn sign_on_any_grid(rows: &[Row]) -> Option<TruthSign> {
    let side = rows.len().isqrt();
    if side < 2 || side * side != rows.len() {
        return None;
    }
    let least = |of: fn(&Row) -> f64| rows.iter().map(of).fold(f64::INFINITY, f64::min);
    let (x, y) = (least(|row| row.x), least(|row| row.y));
    let reach = rows.iter().map(|row| row.x - x).fold(0.0, f64::max);
    // The first and the last cell are side − 1 cells apart.
    let stamp = reach / (side - 1) as f64;
    // The sign depends on neither the side of the field nor its place.
    let grid = Grid::new(side, Pixels(stamp), Degrees(10.0)).ok()?;
    let (first_x, first_y) = grid.centre(0, 0);
    let moved = rows.iter().map(|row| Row {
        x: row.x - x + first_x,
        y: row.y - y + first_y,
        ..*row
    });
    let standard = TrueShear::from_rows(&grid, TruthSign::Standard, moved).ok()?;
    sign_by_modes(&grid, &standard).ok()?
}

#[derive(Debug, Clone)]
pub struct ReadTruth {
    pub grid: Grid,
    /// The shear, in the standard sign if `sign` is known, else as in the file.
    pub shear: TrueShear,
    /// The sign of g2 in the file; `None` if only catalogues can determine it.
    pub sign: Option<Sign>,
}

// Rows (x, y, g1, g2). Each is made when it is needed: all rows of the largest grid are 512 MB.
fn rows_of<'t>(
    path: &Path,
    table: &'t DataFrame,
) -> Result<impl ExactSizeIterator<Item = Row> + use<'t>, FileError> {
    let [x, y, g1, g2] = TRUTH_COLUMNS.map(|name| table::numbers(table, name, path));
    let (x, y, g1, g2) = (x?, y?, g1?, g2?);
    Ok((0..x.len()).map(move |k| Row {
        x: x[k],
        y: y[k],
        e1: g1[k],
        e2: g2[k],
    }))
}

/// The true shear of a file on its grid, whose side is the square root of the number of rows.
pub fn read_truth(truth: &Path, reading: &Reading) -> Result<ReadTruth, FileError> {
    let table = table::read_truth(truth, MAX_ROWS)?;
    let rows = rows_of(truth, &table)?;
    let side = grid::side(truth, rows.len())?;
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let standard = TrueShear::from_rows(&grid, TruthSign::Standard, rows).map_err(bad)?;
    // Freed before the transforms allocate theirs: grids may have 10⁷ galaxies.
    drop(table);
    let by_modes = || sign_by_modes(&grid, &standard).ok().flatten();
    let mut sign = Sign::of_truth(stated_sign(truth)?, reading.sign, by_modes)
        .map_err(|fault| FileError::new(truth, fault))?;
    if sign.is_none() && standard.g2.iter().all(|g2| *g2 == 0.0) {
        sign = Some(Sign::ZERO);
    }
    let shear = match sign.map(|sign| sign.of) {
        Some(TruthSign::Challenge) => standard.flipped(),
        Some(TruthSign::Standard) | None => standard,
    };
    Ok(ReadTruth { grid, shear, sign })
}

/// Writes a true shear in the standard sign, and states it, so that no reader has to guess.
pub fn write_truth(path: &Path, grid: &Grid, truth: &TrueShear) -> Result<(), FileError> {
    // The comment follows the header, so that readers that skip one line or a `#` read the columns.
    let mut text = format!("x,y,g1,g2\n# {SIGN_KEY}: standard (g2 > 0 is a stretch along x = y)\n");
    for iy in 0..grid.n {
        for ix in 0..grid.n {
            let (x, y) = grid.centre(ix, iy);
            let (g1, g2) = (truth.g1[(ix, iy)], truth.g2[(ix, iy)]);
            text.push_str(&format!("{x},{y},{g1},{g2}\n"));
        }
    }
    atomic::write(path, text.as_bytes())
}

pub fn truth_is_there(path: &Path) -> Result<(), FileError> {
    if is_there(path) {
        return Ok(());
    }
    let message = "there is no true shear to score against";
    Err(FileError::new(path, message)
        .hint("shearq mean --measured OUT, for the mean shear of images of your own"))
}

impl DataFolder {
    /// The true shear of a set on a known grid.
    pub fn read_truth(&self, set: u32, grid: &Grid) -> Result<TrueShear, FileError> {
        let path = self.truth(set);
        truth_is_there(&path)?;
        let table = table::read_truth(&path, table::most_rows(grid.cells()))?;
        TrueShear::from_rows(grid, self.truth_sign(set)?, rows_of(&path, &table)?)
            .map_err(|error| FileError::new(&path, error))
    }

    /// Sign of g2 in the truth of a set: the one that the file states, or else the layout's.
    pub fn truth_sign(&self, set: u32) -> Result<TruthSign, FileError> {
        let (path, layout) = (self.truth(set), self.layout().truth_sign);
        match stated_sign(&path)? {
            Some(TruthSign::Standard) if layout == TruthSign::Challenge => {
                let message = format!(
                    "the file states `{SIGN_KEY}: standard`, but `truth_sign` in {LAYOUT_FILE} is `challenge`; remove the wrong one"
                );
                Err(FileError::new(&path, message))
            }
            // A file of the standard sign in a folder of the challenge's is the only contradiction: the layout's default is no statement.
            stated => Ok(stated.unwrap_or(layout)),
        }
    }
}

/// How the truth of a set of a data folder is to be read.
pub fn reading_of(data: &DataFolder, set: u32) -> Result<Reading, FileError> {
    truth_is_there(&data.truth(set))?;
    Ok(Reading {
        field: Degrees(data.layout().field_degrees),
        stamp: Pixels(grid::stamp_of_set(data, set)? as f64),
        sign: Some(data.truth_sign(set)?),
    })
}

/// Grid of a set, from its first image, or from its true shear without images.
pub fn grid_of_set(data: &DataFolder, set: u32) -> Result<Grid, FileError> {
    let images = data.images(&[set])?.of_set(set);
    let Some((_, path)) = images.first() else {
        return Ok(read_truth(&data.truth(set), &reading_of(data, set)?)?.grid);
    };
    let mosaic = grid::of_image(data, path, &ImageReader::open(path)?)?;
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

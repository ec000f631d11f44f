//! Ellipticities of a set's images summed onto the grid.

use ndarray::Array2;
use serde::Serialize;

use crate::error::ScoringError;
use crate::grid::Grid;

/// One row of an ellipticity catalogue: FITS pixel position (1-based) and two components.
///
/// The type of the ellipticity (shear-type or distortion) is the submission's choice: the original
/// scoring takes the numbers as they are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Column position, FITS pixels.
    pub x: f64,
    /// Row position, FITS pixels.
    pub y: f64,
    /// First component.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
}

/// How the rows of one catalogue, or of several, were used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct RowCounts {
    /// Rows added to a cell.
    pub used: usize,
    /// Rows whose position is outside the grid.
    pub outside: usize,
    /// Rows after the first n², which the original does not read.
    pub excess: usize,
    /// Rows with an ellipticity that is not a finite number; counted as missing.
    pub not_finite: usize,
}

impl std::ops::AddAssign for RowCounts {
    fn add_assign(&mut self, other: Self) {
        self.used += other.used;
        self.outside += other.outside;
        self.excess += other.excess;
        self.not_finite += other.not_finite;
    }
}

/// Sums over images of ellipticities and of counts, on cells `[ix, iy]`.
///
/// Memory is that of three grids however many images are added.
#[derive(Debug, Clone)]
pub struct FieldSum {
    /// Σ e₁.
    pub e1: Array2<f64>,
    /// Σ e₂.
    pub e2: Array2<f64>,
    /// Rows added to each cell.
    pub count: Array2<f64>,
    /// Images added, blank ones included.
    pub images: usize,
}

impl FieldSum {
    /// Nothing yet.
    pub fn new(grid: &Grid) -> Self {
        let zeros = || Array2::zeros((grid.n, grid.n));
        FieldSum {
            e1: zeros(),
            e2: zeros(),
            count: zeros(),
            images: 0,
        }
    }

    /// Adds one image's catalogue as the original does: rows after the first n² are ignored, rows
    /// outside the grid skipped, duplicates add up, missing cells stay as they are. Rows that are
    /// not finite numbers count as missing.
    pub fn add_image(&mut self, grid: &Grid, rows: impl IntoIterator<Item = Row>) -> RowCounts {
        let mut counts = RowCounts::default();
        self.images += 1;
        for (place, row) in rows.into_iter().enumerate() {
            if place >= grid.cells() {
                counts.excess += 1;
                continue;
            }
            let Some(cell) = grid.cell(row.x, row.y) else {
                counts.outside += 1;
                continue;
            };
            if !(row.e1.is_finite() && row.e2.is_finite()) {
                counts.not_finite += 1;
                continue;
            }
            self.e1[cell] += row.e1;
            self.e2[cell] += row.e2;
            self.count[cell] += 1.0;
            counts.used += 1;
        }
        counts
    }

    /// Adds all of `other`.
    pub fn merge(&mut self, other: &FieldSum) {
        self.e1 += &other.e1;
        self.e2 += &other.e2;
        self.count += &other.count;
        self.images += other.images;
    }

    /// `self` without `part`, which must be one of the sums merged into it.
    pub fn without(&self, part: &FieldSum) -> FieldSum {
        FieldSum {
            e1: &self.e1 - &part.e1,
            e2: &self.e2 - &part.e2,
            count: &self.count - &part.count,
            images: self.images - part.images,
        }
    }
}

/// The true shear of a set on cells `[ix, iy]`, in the standard sign (e₂ along x = y).
#[derive(Debug, Clone)]
pub struct TrueShear {
    /// First component.
    pub g1: Array2<f64>,
    /// Second component.
    pub g2: Array2<f64>,
}

/// Which sign of g₂ a truth file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TruthSign {
    /// The challenge's files: minus the standard g₂.
    Challenge,
    /// g₂ positive along x = y.
    Standard,
}

impl TrueShear {
    /// From rows of (x, y, g₁, g₂), in any order.
    ///
    /// # Errors
    /// Where a cell is absent, given twice or not finite.
    pub fn from_rows(
        grid: &Grid,
        sign: TruthSign,
        rows: impl IntoIterator<Item = Row>,
    ) -> Result<Self, ScoringError> {
        let mut truth = TrueShear {
            g1: Array2::from_elem((grid.n, grid.n), f64::NAN),
            g2: Array2::from_elem((grid.n, grid.n), f64::NAN),
        };
        let flip = match sign {
            TruthSign::Challenge => -1.0,
            TruthSign::Standard => 1.0,
        };
        let mut seen = Array2::from_elem((grid.n, grid.n), false);
        let mut found = 0;
        for row in rows {
            let incomplete = |found| ScoringError::TruthIncomplete {
                found,
                expected: grid.cells(),
                side: grid.n,
            };
            let cell = grid.cell(row.x, row.y).ok_or(incomplete(found))?;
            if std::mem::replace(&mut seen[cell], true) {
                return Err(incomplete(found));
            }
            if !(row.e1.is_finite() && row.e2.is_finite()) {
                return Err(ScoringError::TruthNotFinite {
                    ix: cell.0 + 1,
                    iy: cell.1 + 1,
                });
            }
            truth.g1[cell] = row.e1;
            truth.g2[cell] = flip * row.e2;
            found += 1;
        }
        if found != grid.cells() {
            return Err(ScoringError::TruthIncomplete {
                found,
                expected: grid.cells(),
                side: grid.n,
            });
        }
        Ok(truth)
    }
}

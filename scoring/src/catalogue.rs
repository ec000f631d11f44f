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

/// An ellipticity larger than this is far from any ellipse's.
const ABSURD: f64 = 5.0;
/// Where one row in so many is, they are another quantity.
const TOO_MANY: usize = 20;

/// How the rows of one catalogue, or of several, were used, and what is odd about them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct RowCounts {
    /// Rows added to a cell.
    pub used: usize,
    /// Rows whose position is outside the grid.
    pub outside: usize,
    /// Rows after the first n², which the original does not read.
    pub excess: usize,
    /// Rows with an ellipticity that is not a finite number; counted as missing.
    pub not_finite: usize,
    /// Rows added to a cell that had one of the same image.
    pub repeated: usize,
    /// Cells of the images without any row.
    pub missing: usize,
    /// Rows used with |e| > 1, which no ellipse has.
    pub above_one: usize,
    /// Of these, rows with |e| > 5.
    pub absurd: usize,
    /// The first of those: its place, counted from 1, and its ellipticity.
    pub first_absurd: Option<(usize, f64, f64)>,
    /// Of these, rows with a whole number beyond 5 in a component, as -99: a value that stands for "not
    /// measured".
    pub sentinels: usize,
    /// The first of those.
    pub first_sentinel: Option<(usize, f64, f64)>,
}

impl std::ops::AddAssign for RowCounts {
    fn add_assign(&mut self, other: Self) {
        self.used += other.used;
        self.outside += other.outside;
        self.excess += other.excess;
        self.not_finite += other.not_finite;
        self.repeated += other.repeated;
        self.missing += other.missing;
        self.above_one += other.above_one;
        self.absurd += other.absurd;
        self.first_absurd = self.first_absurd.or(other.first_absurd);
        self.sentinels += other.sentinels;
        self.first_sentinel = self.first_sentinel.or(other.first_sentinel);
    }
}

impl RowCounts {
    /// Why these rows of another program should not be scored as they are, if so.
    pub fn fault(&self, grid: &Grid) -> Option<String> {
        if let Some((row, e1, e2)) = self.first_sentinel {
            return Some(format!(
                "{} rows have a whole number as ellipticity, the first of them row {row} with ({e1}, {e2}): if it stands for \"not measured\", name it as missing; otherwise set a largest |e|",
                self.sentinels
            ));
        }
        if let Some((row, e1, e2)) = self.first_absurd
            && TOO_MANY * self.absurd > self.used
        {
            return Some(format!(
                "{} of {} rows have |e| > {ABSURD}, the first of them row {row} with ({e1}, {e2}); expected ellipticities, below 1. If these are outliers, set a largest |e|",
                self.absurd, self.used
            ));
        }
        (2 * self.repeated > self.used).then(|| {
            format!(
                "{} of {} rows fall into cells that have a row already; expected positions in pixels, of {} px stamps on a {3} × {3} grid",
                self.repeated, self.used, grid.stamp.0, grid.n
            )
        })
    }

    /// What is odd, a line each, of the catalogues of `whose`: what, how much, and what was done with it.
    pub fn oddities(&self, whose: &str) -> Vec<String> {
        let mut lines = Vec::new();
        if self.outside + self.excess > 0 {
            lines.push(format!(
                "warning: {whose} has {} outside the grid and {} beyond the number of cells; they do not count.",
                rows(self.outside),
                self.excess
            ));
        }
        if self.repeated > 0 {
            lines.push(format!(
                "warning: {} of {whose} of galaxies that have one already; they add up.",
                rows(self.repeated)
            ));
        }
        if self.missing > 0 {
            lines.push(format!(
                "warning: {} of {} galaxies of {whose} are not in the catalogues; each counts as zero.",
                self.missing,
                self.missing + self.used + self.not_finite - self.repeated
            ));
        }
        if self.above_one > 0 {
            lines.push(format!(
                "warning: {} of {whose} with |e| > 1, {} with |e| > {ABSURD}; scored as they are.",
                rows(self.above_one),
                self.absurd
            ));
        }
        if self.not_finite > 0 {
            lines.push(format!(
                "note: {} of {} galaxies of {whose} have no ellipticity and count as missing.",
                self.not_finite,
                self.not_finite + self.used
            ));
        }
        lines
    }
}

/// So many rows.
fn rows(count: usize) -> String {
    format!("{count} row{}", if count == 1 { "" } else { "s" })
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
        let mut seen = Array2::from_elem((grid.n, grid.n), false);
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
            let repeated = std::mem::replace(&mut seen[cell], true);
            if !(row.e1.is_finite() && row.e2.is_finite()) {
                counts.not_finite += 1;
                continue;
            }
            self.e1[cell] += row.e1;
            self.e2[cell] += row.e2;
            self.count[cell] += 1.0;
            counts.used += 1;
            counts.repeated += usize::from(repeated);
            let square = row.e1 * row.e1 + row.e2 * row.e2;
            counts.above_one += usize::from(square > 1.0);
            if square > ABSURD * ABSURD {
                counts.absurd += 1;
                let found = (place + 1, row.e1, row.e2);
                counts.first_absurd.get_or_insert(found);
                let whole = |e: f64| e.abs() > ABSURD && e.fract() == 0.0;
                if whole(row.e1) || whole(row.e2) {
                    counts.sentinels += 1;
                    counts.first_sentinel.get_or_insert(found);
                }
            }
        }
        counts.missing = seen.iter().filter(|seen| !**seen).count();
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

/// True shears closer together than this are the same.
const SAME_SHEAR: f64 = 1e-10;

impl TrueShear {
    /// The shear, where it is the same in all cells: then there is no power beyond the zero mode.
    pub fn constant(&self) -> Option<[f64; 2]> {
        let value = |g: &Array2<f64>| {
            let first = *g.first()?;
            let same = g.iter().all(|g| (g - first).abs() <= SAME_SHEAR);
            same.then_some(first)
        };
        Some([value(&self.g1)?, value(&self.g2)?])
    }

    /// The shear with the other sign of g₂.
    pub fn flipped(&self) -> Self {
        TrueShear {
            g1: self.g1.clone(),
            g2: -&self.g2,
        }
    }

    /// Root mean square of |g|.
    pub fn rms(&self) -> f64 {
        let squares = |g: &Array2<f64>| g.iter().map(|g| g * g).sum::<f64>();
        ((squares(&self.g1) + squares(&self.g2)) / self.g1.len() as f64).sqrt()
    }

    /// From rows of (x, y, g₁, g₂), in any order.
    ///
    /// # Errors
    /// If a cell is absent or given twice, or its shear is not finite or |g| ≥ 1.
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
            let modulus = row.e1.hypot(row.e2);
            if modulus >= 1.0 {
                return Err(ScoringError::TruthTooLarge {
                    ix: cell.0 + 1,
                    iy: cell.1 + 1,
                    found: modulus,
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

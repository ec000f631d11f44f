//! Ellipticities of the images of a set, summed on the grid, in groups for the jackknife.

use ndarray::{Array2, ArrayView2};
#[cfg(feature = "serde")]
use serde::Serialize;
use shearq_quantities::MeasuredRange;

use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};
use crate::resample::MAX_GROUPS;

/// One row of an ellipticity catalogue: FITS pixel position (1-based) and two components.
///
/// The scoring does not convert between shear-type ellipticity and distortion.
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

// If more than one row in so many is absurd, the column is probably another quantity.
const MIN_ROWS_PER_ABSURD: usize = 20;

/// How the rows of one or several catalogues were used, and how many are odd.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct RowCounts {
    /// Rows added to a cell.
    pub used: usize,
    /// Rows whose position is outside the grid.
    pub outside: usize,
    /// Rows after the first n², which are not read.
    pub excess: usize,
    /// Rows whose ellipticity is not finite; these galaxies count as missing.
    pub not_finite: usize,
    /// Rows added to a cell that already has a row of this image.
    pub repeated: usize,
    /// Cells of the images without any row.
    pub missing: usize,
    /// Rows used with |e| > 1, which is impossible for an ellipse.
    pub above_one: usize,
    /// Rows with |e| > [`RowCounts::ABSURD`].
    pub absurd: usize,
    /// The first of the absurd rows.
    pub first_absurd: Option<OddRow>,
    /// Rows with a number that stands for a failed measurement ([`MeasuredRange`]), such as -99.
    pub sentinels: usize,
    /// The first of these rows.
    pub first_sentinel: Option<OddRow>,
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

/// Why the rows of a catalogue are probably not ellipticities on the grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RowFault {
    /// Numbers outside of [`MeasuredRange::ELLIPTICITY`]: they probably mean "not measured".
    Sentinels {
        /// Rows with such a number.
        rows: usize,
        /// The first of them.
        first: OddRow,
    },
    /// More than one row in twenty has |e| > [`RowCounts::ABSURD`].
    Absurd {
        /// Rows with such an ellipticity.
        rows: usize,
        /// Rows used.
        used: usize,
        /// The first of them.
        first: OddRow,
    },
    /// More than half of the rows fall into a cell that already has one.
    Repeated {
        /// Repeated rows.
        rows: usize,
        /// Rows used.
        used: usize,
    },
}

/// A row with an odd ellipticity: its number, counted from 1, e₁ and e₂.
pub type OddRow = (usize, f64, f64);

impl RowCounts {
    /// |e| above which an ellipticity is absurd.
    pub const ABSURD: f64 = 5.0;

    /// The reason not to score these rows as they are, if there is one.
    pub fn fault(&self) -> Option<RowFault> {
        let (rows, used) = (self.sentinels, self.used);
        if let Some(first) = self.first_sentinel {
            return Some(RowFault::Sentinels { rows, first });
        }
        let rows = self.absurd;
        if let Some(first) = self.first_absurd
            && MIN_ROWS_PER_ABSURD * rows > used
        {
            return Some(RowFault::Absurd { rows, used, first });
        }
        let rows = self.repeated;
        (2 * rows > used).then_some(RowFault::Repeated { rows, used })
    }
}

/// Sums over images of ellipticities and of counts, on cells `[ix, iy]`.
///
/// The memory does not depend on the number of images: three grids.
#[derive(Debug, Clone)]
pub struct FieldSum {
    /// Σ e₁.
    pub e1: Array2<f64>,
    /// Σ e₂.
    pub e2: Array2<f64>,
    /// Rows added to each cell, or the sum of their weights.
    pub count: Array2<f64>,
    /// Images added, blank ones included.
    pub images: usize,
    /// Σ (w² − w) of all rows: 0 without weights.
    pub weight_excess: f64,
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
            weight_excess: 0.0,
        }
    }

    /// Adds one image's catalogue as the original does: rows after the first n² are ignored, rows
    /// outside the grid are skipped, and repeated rows add up. Rows that are not finite count as missing.
    ///
    /// # Panics
    /// If `grid` is larger than the grid of this sum.
    pub fn add_image(&mut self, grid: &Grid, rows: impl IntoIterator<Item = Row>) -> RowCounts {
        self.add_weighted(grid, rows.into_iter().map(|row| (row, 1.0)))
    }

    /// As [`FieldSum::add_image`], of rows with weights, whose mean over the set should be 1: a galaxy that is missing has the
    /// weight 0.
    ///
    /// # Panics
    /// If `grid` is larger than the grid of this sum.
    pub fn add_weighted(
        &mut self,
        grid: &Grid,
        rows: impl IntoIterator<Item = (Row, f64)>,
    ) -> RowCounts {
        let mut counts = RowCounts::default();
        let mut seen = Array2::from_elem((grid.n, grid.n), false);
        self.images += 1;
        for (place, (row, weight)) in rows.into_iter().enumerate() {
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
            self.e1[cell] += weight * row.e1;
            self.e2[cell] += weight * row.e2;
            self.count[cell] += weight;
            self.weight_excess += weight * (weight - 1.0);
            counts.used += 1;
            counts.repeated += usize::from(repeated);
            let square = row.e1 * row.e1 + row.e2 * row.e2;
            counts.above_one += usize::from(square > 1.0);
            if square > RowCounts::ABSURD * RowCounts::ABSURD {
                counts.absurd += 1;
                let found = (place + 1, row.e1, row.e2);
                counts.first_absurd.get_or_insert(found);
                let range = MeasuredRange::ELLIPTICITY;
                if range.excludes(row.e1) || range.excludes(row.e2) {
                    counts.sentinels += 1;
                    counts.first_sentinel.get_or_insert(found);
                }
            }
        }
        counts.missing = seen.iter().filter(|seen| !**seen).count();
        counts
    }

    /// Divides the weights of all rows.
    pub fn divide_weights(&mut self, by: f64) {
        let weights = self.count.sum();
        let squares = self.weight_excess + weights;
        self.weight_excess = squares / (by * by) - weights / by;
        for field in [&mut self.e1, &mut self.e2, &mut self.count] {
            *field /= by;
        }
    }

    // Σ w² / Σ w, by which weights raise the noise of the mean field; 1 without weights.
    pub(crate) fn weight_noise(&self) -> f64 {
        match self.weight_excess == 0.0 {
            true => 1.0,
            false => 1.0 + self.weight_excess / self.count.sum(),
        }
    }

    pub(crate) fn check_shape(&self, side: usize) -> Result<(), ScoringError> {
        check_shape("e1 of an image", &self.e1, side)?;
        check_shape("e2 of an image", &self.e2, side)?;
        check_shape("the count of an image", &self.count, side)
    }

    pub(crate) fn merge(&mut self, other: &FieldSum) {
        self.e1 += &other.e1;
        self.e2 += &other.e2;
        self.count += &other.count;
        self.images += other.images;
        self.weight_excess += other.weight_excess;
    }

    // `self` without `part`, which must be one of the sums merged into it.
    pub(crate) fn without(&self, part: &FieldSum) -> FieldSum {
        FieldSum {
            e1: &self.e1 - &part.e1,
            e2: &self.e2 - &part.e2,
            count: &self.count - &part.count,
            images: self.images - part.images,
            weight_excess: self.weight_excess - part.weight_excess,
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

/// Sign of g₂ in a truth file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "lowercase"))]
pub enum TruthSign {
    /// As in the files of the challenge: minus the standard g₂.
    Challenge,
    /// g₂ positive along x = y.
    Standard,
}

// Largest difference of true shears that count as equal.
const MAX_ROUNDING_OF_SHEAR: f64 = 1e-10;

impl TrueShear {
    /// The shear, if it is the same in all cells. Then only the zero mode has power.
    pub fn constant(&self) -> Option<[f64; 2]> {
        let value = |g: &Array2<f64>| {
            let first = *g.first()?;
            let same = g.iter().all(|g| (g - first).abs() <= MAX_ROUNDING_OF_SHEAR);
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

/// Sums of a set's images, kept in up to [`MAX_GROUPS`] groups so that each can be left out.
///
/// Image `k` (counted from 0 in the order added) belongs to group `k mod MAX_GROUPS`. Two configurations
/// measured on the same images are therefore grouped alike. Memory does not grow with the images.
#[derive(Debug, Clone)]
pub struct SetImages {
    groups: Vec<FieldSum>,
    total: FieldSum,
}

impl SetImages {
    /// No images yet.
    pub fn new(grid: &Grid) -> Self {
        SetImages {
            groups: Vec::new(),
            total: FieldSum::new(grid),
        }
    }

    /// Images given as e₁ and e₂ on the cells `[ix, iy]`. A galaxy counts as missing if one of its components
    /// is not finite.
    ///
    /// # Errors
    /// If the shape of an array differs from the grid.
    pub fn of_arrays<'a>(
        grid: &Grid,
        images: impl IntoIterator<Item = [ArrayView2<'a, f64>; 2]>,
    ) -> Result<Self, ScoringError> {
        let mut all = SetImages::new(grid);
        for [e1, e2] in images {
            check_shape("e1 of an image", &e1, grid.n)?;
            check_shape("e2 of an image", &e2, grid.n)?;
            let mut sum = FieldSum::new(grid);
            sum.images = 1;
            for ((cell, &e1), &e2) in e1.indexed_iter().zip(&e2) {
                if e1.is_finite() && e2.is_finite() {
                    (sum.e1[cell], sum.e2[cell], sum.count[cell]) = (e1, e2, 1.0);
                }
            }
            all.add(&sum)?;
        }
        Ok(all)
    }

    /// Adds one image.
    ///
    /// # Errors
    /// If `image` is a sum of no image or of several, or if the shape of one of its arrays differs from the
    /// grid.
    pub fn add(&mut self, image: &FieldSum) -> Result<(), ScoringError> {
        if image.images != 1 {
            return Err(ScoringError::NotOneImage(image.images));
        }
        image.check_shape(self.total.e1.nrows())?;
        let group = self.total.images % MAX_GROUPS;
        if group == self.groups.len() {
            self.groups.push(image.clone());
        } else {
            self.groups[group].merge(image);
        }
        self.total.merge(image);
        Ok(())
    }

    /// Divides e₁ and e₂ of all images by a response to shear, which may be known only after the last image.
    pub fn divide(&mut self, response: [f64; 2]) {
        for sum in self.groups.iter_mut().chain([&mut self.total]) {
            sum.e1 /= response[0];
            sum.e2 /= response[1];
        }
    }

    /// The sums of the groups.
    pub fn groups(&self) -> &[FieldSum] {
        &self.groups
    }

    /// The sum of all images.
    pub fn total(&self) -> &FieldSum {
        &self.total
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_images_add_and_come_apart_again() {
        let grid = Grid::great10(8).unwrap();
        let image = |k: usize| {
            let mut sum = FieldSum::new(&grid);
            // Multiples of 1/64, so that sums are exact.
            let rows = (0..60).map(|cell| {
                let (x, y) = grid.centre(cell % 8, cell / 8);
                let e1 = ((cell * (k + 3)) % 17) as f64 / 64.0;
                Row { x, y, e1, e2: -e1 }
            });
            sum.add_image(&grid, rows);
            sum
        };
        let images = [image(0), image(1), image(2)];
        let mut all = FieldSum::new(&grid);
        images.iter().for_each(|image| all.merge(image));
        assert_eq!((all.images, all.count.sum()), (3, 180.0));
        let rest = all.without(&images[1]);
        assert_eq!(rest.images, 2);
        assert_eq!(rest.e1, &images[0].e1 + &images[2].e1);
        assert_eq!(rest.e2, &images[0].e2 + &images[2].e2);
        assert_eq!(rest.count, &images[0].count + &images[2].count);
    }
}

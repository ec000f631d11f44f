//! The stamps of an image side by side.

use shearq_measure::StampRows;
use shearq_quantities::columns_of;
use shearq_quantities::units::Pixels;
use shearq_scoring::{cell_at, centre_of};

/// Largest side of a postage stamp, in pixels.
pub const MAX_STAMP: usize = 1024;

/// Stamps in rows of `columns`. The last row may be shorter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mosaic {
    /// Stamps of a full row, at least 1.
    pub columns: usize,
    /// All stamps, at least 1.
    pub galaxies: usize,
    pub stamp: usize,
}

impl Mosaic {
    pub fn square(n: usize, stamp: usize) -> Self {
        Mosaic {
            columns: n,
            galaxies: n * n,
            stamp,
        }
    }

    /// The arrangement of `galaxies` stamps that is nearest to a square.
    pub fn of(galaxies: usize, stamp: usize) -> Self {
        Mosaic {
            columns: columns_of(galaxies),
            galaxies,
            stamp,
        }
    }

    pub fn stamp_rows(&self) -> StampRows {
        StampRows {
            columns: self.columns,
            count: self.galaxies,
        }
    }

    pub fn rows(&self) -> usize {
        self.stamp_rows().len()
    }

    /// Stamps of a row; none of one beyond the last.
    pub fn of_row(&self, iy: usize) -> usize {
        self.stamp_rows().stamps(iy).len()
    }

    /// FITS pixel position of the centre of stamp `ix` of row `iy`, both from 0.
    pub fn centre(&self, ix: usize, iy: usize) -> (f64, f64) {
        let stamp = Pixels(self.stamp as f64);
        (centre_of(ix, stamp), centre_of(iy, stamp))
    }

    /// FITS pixel position of the centre of stamp `place`, from 0 along the rows.
    pub fn position(&self, place: usize) -> (f64, f64) {
        self.centre(place % self.columns, place / self.columns)
    }

    /// Number, from 0 along the rows, of the stamp that contains the FITS pixel position (x, y).
    pub fn place(&self, x: f64, y: f64) -> Option<usize> {
        let stamp = Pixels(self.stamp as f64);
        let (ix, iy) = (cell_at(x, stamp)?, cell_at(y, stamp)?);
        (iy < self.rows() && ix < self.of_row(iy)).then_some(iy * self.columns + ix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_fill_rows_and_the_last_may_be_shorter() {
        for (galaxies, columns, rows, last) in [
            (1, 1, 1, 1),
            (2, 2, 1, 2),
            (3, 2, 2, 1),
            (16, 4, 4, 4),
            (17, 5, 4, 2),
        ] {
            let mosaic = Mosaic::of(galaxies, 48);
            assert_eq!((mosaic.columns, mosaic.rows()), (columns, rows));
            assert_eq!(mosaic.of_row(rows - 1), last);
            assert_eq!(mosaic.of_row(rows), 0);
            for place in 0..galaxies {
                let (x, y) = mosaic.centre(place % columns, place / columns);
                assert_eq!(mosaic.place(x, y), Some(place));
                assert_eq!(mosaic.position(place), (x, y));
            }
        }
        let mosaic = Mosaic::of(17, 48);
        assert_eq!(mosaic.place(24.5 + 2.0 * 48.0, 24.5 + 3.0 * 48.0), None);
        assert_eq!(mosaic.place(24.5 + 5.0 * 48.0, 24.5), None);
        assert_eq!(mosaic.place(f64::NAN, 24.5), None);
    }
}

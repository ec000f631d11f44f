//! The square grid of postage stamps, and its Fourier modes.

use std::ops::RangeInclusive;

use ndarray::{ArrayBase, Data, Ix2};
#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};

use crate::error::ScoringError;
use shearq_quantities::units::{Degrees, Multipole, Pixels, Radians};

// Offset that the original scoring program adds to both components of every wave vector, so that
// the zero mode has a direction. It determines which of the modes at exactly ℓ_min are counted.
pub(crate) const MODE_OFFSET: f64 = 1e-10;

pub(crate) fn check_shape<S: Data>(
    what: &'static str,
    array: &ArrayBase<S, Ix2>,
    side: usize,
) -> Result<(), ScoringError> {
    match array.dim() == (side, side) {
        true => Ok(()),
        false => Err(ScoringError::Shape {
            what,
            found: array.dim(),
            side,
        }),
    }
}

/// 0-based index along an axis of the stamp that contains the FITS pixel position `position`. `None` before the first stamp.
///
/// The 1-based index is round(x/stamp + ½), halves away from zero, as in the original. That is half a pixel
/// less than the stamp's edge in FITS pixels. A stamp of one pixel has its centre there. Stamps from one to two
/// pixels therefore use the edge itself: round((x − ½)/stamp + ½).
pub fn cell_at(position: f64, stamp: Pixels) -> Option<usize> {
    let from = if (1.0..2.0).contains(&stamp.0) {
        0.5
    } else {
        0.0
    };
    let index = ((position - from) / stamp.0 + 0.5).round();
    (index >= 1.0).then(|| index as usize - 1)
}

/// FITS pixel position along an axis of the centre of the stamp at `index`, from 0.
pub fn centre_of(index: usize, stamp: Pixels) -> f64 {
    index as f64 * stamp.0 + (stamp.0 + 1.0) / 2.0
}

/// A square grid of galaxies: `n` × `n` stamps of `stamp` pixels, on a field of `field` degrees per side.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
pub struct Grid {
    /// Cells per side.
    pub n: usize,
    /// Pixels per side of one stamp, which is one cell.
    pub stamp: Pixels,
    /// Side of the whole field.
    pub field: Degrees,
}

impl Grid {
    /// Accepted sides of a field, in degrees.
    pub const FIELDS: RangeInclusive<f64> = 1e-3..=360.0;
    /// Smallest accepted grid. Below 12 cells per side some of the bins 2 to 9 have no modes.
    pub const MIN_SIDE: usize = 8;
    /// Largest accepted grid: 16 million cells. Damaged headers can contain larger numbers.
    pub const MAX_SIDE: usize = 4000;

    /// The GREAT10 layout with `n` cells per side: 48 px stamps on a field of 10°.
    ///
    /// # Errors
    /// If `n` is outside [`Grid::MIN_SIDE`]..=[`Grid::MAX_SIDE`].
    pub fn great10(n: usize) -> Result<Self, ScoringError> {
        Grid::new(n, Pixels(48.0), Degrees(10.0))
    }

    /// A grid of `n` cells per side.
    ///
    /// # Errors
    /// If `n`, `field` or `stamp` is out of range.
    pub fn new(n: usize, stamp: Pixels, field: Degrees) -> Result<Self, ScoringError> {
        if !(Self::MIN_SIDE..=Self::MAX_SIDE).contains(&n) {
            return Err(ScoringError::GridSide {
                found: n,
                min: Self::MIN_SIDE,
                max: Self::MAX_SIDE,
            });
        }
        if !(stamp.0.is_finite() && stamp.0 > 0.0) {
            return Err(ScoringError::Length {
                what: "the side of a stamp in pixels",
                found: stamp.0,
            });
        }
        if !Self::FIELDS.contains(&field.0) {
            return Err(ScoringError::Field {
                found: field.0,
                least: *Self::FIELDS.start(),
                most: *Self::FIELDS.end(),
            });
        }
        Ok(Grid { n, stamp, field })
    }

    /// Side of the square grid with this many cells. `None` if the number is not a square.
    pub fn side_of(cells: usize) -> Option<usize> {
        let side = cells.isqrt();
        (side * side == cells).then_some(side)
    }

    /// Number of cells of the grid.
    pub fn cells(&self) -> usize {
        self.n * self.n
    }

    /// 0-based cell `(ix, iy)` of the FITS pixel position `(x, y)`, `None` outside the grid.
    pub fn cell(&self, x: f64, y: f64) -> Option<(usize, usize)> {
        let index = |v: f64| cell_at(v, self.stamp).filter(|&i| i < self.n);
        Some((index(x)?, index(y)?))
    }

    /// FITS pixel position (1-based) of the centre of cell `(ix, iy)`: the corner shared by the
    /// four central pixels for an even stamp.
    pub fn centre(&self, ix: usize, iy: usize) -> (f64, f64) {
        (centre_of(ix, self.stamp), centre_of(iy, self.stamp))
    }

    /// Side of the field in radians.
    pub fn side(&self) -> Radians {
        self.field.into()
    }

    /// ℓ_min = 2π/L, the spacing of the modes.
    pub fn l_min(&self) -> Multipole {
        Multipole(2.0 * std::f64::consts::PI / self.side().0)
    }

    /// ℓ_max = 2πn/L, the upper end of the bins (twice the Nyquist multipole along an axis).
    pub fn l_max(&self) -> Multipole {
        Multipole(self.l_min().0 * self.n as f64)
    }

    // Signed integer frequency of position `i` in centred order (0 is the most negative).
    pub(crate) fn frequency(&self, i: usize) -> i64 {
        i as i64 - (self.n / 2) as i64
    }

    // Place in FFT order of position `i` in centred order.
    pub(crate) fn fft_index(&self, i: usize) -> usize {
        (i + self.n - self.n / 2) % self.n
    }

    // Component of the wave vector at centred position `i`, with the original's offset.
    pub(crate) fn wave(&self, i: usize) -> f64 {
        self.l_min().0 * self.frequency(i) as f64 + MODE_OFFSET
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_and_centres_are_inverse() {
        let grid = Grid::great10(100).unwrap();
        for (ix, iy) in [(0, 0), (3, 99), (99, 50)] {
            let (x, y) = grid.centre(ix, iy);
            assert_eq!(grid.cell(x, y), Some((ix, iy)));
        }
        assert_eq!(grid.centre(0, 1), (24.5, 72.5));
        // x/48 + 0.5 = 1.5 rounds up to the second cell.
        assert_eq!(grid.cell(48.0, 24.5), Some((1, 0)));
        assert_eq!(grid.cell(47.999, 24.5), Some((0, 0)));
        assert_eq!(grid.cell(-0.1, 24.5), None);
        assert_eq!(grid.cell(4800.0, 24.5), None);
        assert_eq!(grid.cell(f64::NAN, 24.5), None);
    }

    #[test]
    fn stamps_of_one_pixel_are_fits_pixels() {
        let grid = Grid::new(8, Pixels(1.0), Degrees(10.0)).unwrap();
        for (ix, iy) in [(0, 0), (3, 7), (7, 5)] {
            assert_eq!(grid.cell(ix as f64 + 1.0, iy as f64 + 1.0), Some((ix, iy)));
        }
        assert_eq!(grid.cell(0.0, 1.0), None);
        assert_eq!(grid.cell(9.0, 1.0), None);
    }

    #[test]
    fn modes_of_ten_degrees_are_36_apart() {
        let grid = Grid::great10(100).unwrap();
        assert!((grid.l_min().0 - 36.0).abs() < 1e-12);
        assert!((grid.l_max().0 - 3600.0).abs() < 1e-9);
    }

    #[test]
    fn centred_order_maps_to_fft_order() {
        for n in [8, 9] {
            let grid = Grid::great10(n).unwrap();
            for i in 0..n {
                let f = grid.frequency(i);
                assert_eq!(
                    grid.fft_index(i) as i64,
                    f.rem_euclid(n as i64),
                    "n {n}, i {i}"
                );
            }
        }
    }
}

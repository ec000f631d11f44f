//! A PSF that varies over an exposure, as one that is constant in each of its cells.
//!
//! A pixel's weight and ellipticity are functionals of one detector, behind the PSF at the middle of its cell. Their response holds
//! for each pixel by itself, whatever PSF its neighbours have, so that borders add no bias on average over a cell.

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array2;
use shearq_measure::parts::gaussian_sigma;
use shearq_measure::{MeasureError, StampNoise};
use shearq_quantities::Jacobian;
use shearq_submissions::DetectionMethod;

use crate::detector::{Detector, of_sum_one};

// Squares of 404 px at a seeing of 0.7″ and pixels of 0.2″. A detector takes 9 ms (24 ms on sheared pixels), as long as the detection in a cell
// with 75 galaxies per arcmin² takes (8 to 12 ms). Where a PSF changes by 5 % in size and 0.03 in ellipticity from the middle of a chip of
// 4000 px to its edge, neighbouring cells differ by 1 % and 0.006. At their borders c is then up to 4·10⁻³, of opposite signs on both sides
// (1.4 times the error of the ellipticity, docs/scenes.md).
pub(crate) const TILES_PER_CELL: [usize; 2] = [2, 1];
// Of an exposure with one PSF.
const WHOLE: [usize; 2] = [usize::MAX; 2];
// Parts of an exposure along each axis, of which the one with the broadest PSF decides on the widths of the smoothed light and the
// moments. Chosen by hand.
pub(crate) const PARTS: usize = 4;

/// Which cells the tiles of an exposure are in, row by row.
#[derive(Debug, Clone, Copy)]
pub struct CellGrid {
    pub(crate) tiles_per_cell: [usize; 2],
    /// Cells of a row.
    pub(crate) columns: usize,
}

impl CellGrid {
    /// The cells that begin with a row of tiles; `None` if its tiles are in those of the row above.
    pub fn beginning(&self, row: usize) -> Option<Range<usize>> {
        let down = self.tiles_per_cell[1];
        let first = row / down * self.columns;
        row.is_multiple_of(down)
            .then_some(first..first + self.columns)
    }

    /// Which of the cells of its row the tile `column` of a row is in.
    pub fn column(&self, column: usize) -> usize {
        column / self.tiles_per_cell[0]
    }
}

/// The cells of an exposure, row by row.
#[derive(Debug)]
pub struct Cells {
    /// With the widths, margin and tiles of all.
    shared: Arc<Detector>,
    stars: Vec<Array2<f64>>,
    grid: CellGrid,
}

impl Cells {
    /// One cell, of an exposure with one PSF; see [`Detector::new`].
    ///
    /// # Errors
    /// As [`Detector::new`].
    pub fn constant(
        star: Array2<f64>,
        noise: &StampNoise,
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
    ) -> Result<Self, MeasureError> {
        let detector = Detector::new(star.view(), noise, jacobian, settings)?;
        Ok(Cells {
            shared: Arc::new(detector),
            stars: vec![star],
            grid: CellGrid {
                tiles_per_cell: WHOLE,
                columns: 1,
            },
        })
    }

    /// Cells of an exposure of so many columns and rows. `draw` returns the stars at places in FITS pixels, of one size.
    ///
    /// # Errors
    /// Those of `draw`, and as [`Detector::new`].
    pub fn varying<E: From<MeasureError>>(
        sides: [usize; 2],
        noise: &StampNoise,
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
        mut draw: impl FnMut(&[(f64, f64)]) -> Result<Vec<Array2<f64>>, E>,
    ) -> Result<Self, E> {
        let mut drawn = |step: [usize; 2]| {
            let places = middles(sides, step);
            let stars = draw(&places)?;
            all_of_sum_one(&stars, &places).map_err(E::from)
        };
        let some = drawn(sides.map(|side| side.div_ceil(PARTS).max(1)))?;
        let sigma = |star: &&Array2<f64>| gaussian_sigma(star.view());
        let broadest = some.iter().max_by(|a, b| sigma(a).total_cmp(&sigma(b)));
        let broadest = broadest.ok_or(MeasureError::DarkPsf(0.0))?;
        let mut shared = Detector::new(broadest.view(), noise, jacobian, settings)?;
        let rows = shared.rows_per_tile();
        let columns = shared.columns_per_tile();
        let [across, down] = TILES_PER_CELL;
        let cell = [across * columns, down * rows];
        let stars = drawn(cell)?;
        for star in &stars {
            shared.keep_light_behind(star.view());
        }
        Ok(Cells {
            shared: Arc::new(shared),
            stars,
            grid: CellGrid {
                tiles_per_cell: TILES_PER_CELL,
                columns: sides[0].div_ceil(cell[0]),
            },
        })
    }

    /// A detector with the margin and the tiles of all.
    pub fn shared(&self) -> &Detector {
        &self.shared
    }

    /// Which cells the tiles are in.
    pub fn grid(&self) -> CellGrid {
        self.grid
    }

    /// The stars of all cells.
    pub fn stars(&self) -> &[Array2<f64>] {
        &self.stars
    }

    /// The detector of a cell.
    pub fn detector(&self, cell: usize) -> Arc<Detector> {
        match self.grid.tiles_per_cell {
            WHOLE => Arc::clone(&self.shared),
            _ => Arc::new(self.shared.behind(&self.stars[cell])),
        }
    }
}

/// Stars at places in units of their light.
pub(crate) fn all_of_sum_one(
    stars: &[Array2<f64>],
    places: &[(f64, f64)],
) -> Result<Vec<Array2<f64>>, MeasureError> {
    let stars = stars.iter().zip(places);
    let stars = stars.map(|(star, &(x, y))| match of_sum_one(star.view()) {
        Err(MeasureError::DarkPsf(sum)) => Err(MeasureError::DarkPsfAt { sum, at: [x, y] }),
        star => star,
    });
    stars.collect()
}

/// Middles of parts of an exposure that begin in steps, in FITS pixels; the last ones end with the exposure.
pub(crate) fn middles([width, height]: [usize; 2], step: [usize; 2]) -> Vec<(f64, f64)> {
    let along = |side: usize, step: usize| {
        let parts = (0..side.max(1)).step_by(step);
        parts.map(move |first| 0.5 * (first + (first + step).min(side) + 1) as f64)
    };
    let rows = along(height, step[1]);
    rows.flat_map(|y| along(width, step[0]).map(move |x| (x, y)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    const SIDES: [usize; 2] = [1500, 900];

    // Broader to the right, and rounder to the top.
    fn star((x, y): (f64, f64)) -> Array2<f64> {
        let [u, v] = [x / 1500.0, y / 900.0];
        let psf = FunctionalPsf::new(
            PsfProfile::Moffat { beta: 3.0 },
            3.5 + 0.3 * u,
            Shear::new(0.06 * (1.0 - v), 0.0),
        );
        psf.unwrap().stamp(48)
    }

    fn cells(mut draw: impl FnMut((f64, f64)) -> Array2<f64>) -> Result<Cells, MeasureError> {
        let (noise, settings) = (StampNoise::white(1.0), DetectionMethod::default());
        Cells::varying(SIDES, &noise, None, &settings, |places| {
            Ok(places.iter().map(|place| draw(*place)).collect())
        })
    }

    #[test]
    fn cells_cover_the_exposure_with_one_margin_and_their_own_psfs() {
        let cells = cells(star).unwrap();
        let shared = cells.shared();
        let [columns, rows] = [
            shared.tiles(SIDES[0], 0).count(),
            SIDES[1].div_ceil(shared.rows_per_tile()),
        ];
        let mut count = 0;
        for row in 0..rows {
            if let Some(own) = cells.grid().beginning(row) {
                assert_eq!(own.start, count);
                count = own.end;
                assert_eq!(cells.grid().column(columns - 1) + 1, own.len());
            }
        }
        assert_eq!(count, cells.stars().len());
        let [first, last] = [0, count - 1].map(|cell| cells.detector(cell));
        assert_eq!(first.margin(), last.margin());
        assert_eq!(first.rows_per_tile(), last.rows_per_tile());
        // Noise is larger behind a broader PSF.
        assert!(last.threshold() > 1.01 * first.threshold());
    }

    #[test]
    fn a_psf_without_light_is_named_with_its_place() {
        let dark = |place: (f64, f64)| star(place) * if place.0 > 1300.0 { -1.0 } else { 1.0 };
        let error = cells(dark).unwrap_err().to_string();
        assert!(
            error.contains("at x = 1313.0, y = 113.0 sum to -"),
            "{error}"
        );
    }

    #[test]
    fn middles_are_those_of_what_is_on_the_exposure() {
        assert_eq!(middles([5, 2], [4, 4]), [(2.5, 1.5), (5.0, 1.5)]);
    }
}

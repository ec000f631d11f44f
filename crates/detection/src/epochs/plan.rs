//! The cells of several exposures, and where each exposure has their blocks.

use std::sync::Arc;

use ndarray::Array2;
use shearq_measure::parts::{ExposureDefects, gaussian_sigma};
use shearq_measure::{MeasureError, StampNoise};
use shearq_quantities::Jacobian;
use shearq_quantities::linear::{Matrix2, determinant};
use shearq_quantities::statistics::upper_median;
use shearq_submissions::DetectionMethod;

use super::place::{BlockMap, TAPS};
use crate::cells::{CellGrid, PARTS, TILES_PER_CELL, all_of_sum_one, middles};
use crate::detector::Detector;
use crate::functionals::{Axes, Functionals, SquareTransform, light_filter};
use crate::weight::LIGHT;

/// Most exposures of one sky: a set of them is the bits of a number.
pub const MAX_EPOCHS: usize = u64::BITS as usize;

// Pixels from the middle of a cell over which the axes of an epoch are those of differences. Chosen by hand: a quarter of a cell.
const AXES_STEP_PX: f64 = 100.0;
// Largest difference of the axes of an epoch between parts of the exposure that are one cell: it adds less to c (`MAX_DISTORTION` of
// crates/pipeline/src/wcs.rs).
const MAX_AXES_DIFFERENCE: f64 = 1e-4;
// Error of a Gaussian of width σ between pixels by cubic polynomials along both axes, times σ⁴: (0.5 · 1.5)²/4! of its fourth derivatives, which
// are 3/σ⁴ of the peak.
const CUBIC_ERROR: f64 = 0.14;
// Pixels that the map of a block may be beyond its corners and the middles of its sides.
const MAP_SLACK_PX: f64 = 2.0;

type Stars<'a, E> = dyn FnMut(&[(f64, f64)]) -> Result<Vec<Array2<f64>>, E> + 'a;
type Places<'a, E> = dyn FnMut(&[[f64; 2]]) -> Result<Vec<Option<[f64; 2]>>, E> + 'a;

/// An exposure among several of one sky. All have the same zero point.
pub struct Epoch<'a, E> {
    /// Columns and rows.
    pub sides: [usize; 2],
    /// The noise of its pixels.
    pub noise: StampNoise,
    /// The stars at places of it in FITS pixels, of one size.
    pub stars: Box<Stars<'a, E>>,
    /// Whether all stars are the same.
    pub is_constant: bool,
    /// The places on it, in FITS pixels, of places on the first exposure; `None` for those that it cannot have. Not used of the first one.
    pub places: Box<Places<'a, E>>,
    /// What is wrong with it or its stars.
    pub fault: Box<dyn Fn(MeasureError) -> E + 'a>,
}

impl<E> std::fmt::Debug for Epoch<'_, E> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Epoch")
            .field("sides", &self.sides)
            .field("noise", &self.noise)
            .finish_non_exhaustive()
    }
}

impl<E> Epoch<'_, E> {
    /// Stars at places of the first exposure.
    fn stars_at(&mut self, places: &[Option<[f64; 2]>]) -> Result<Vec<Array2<f64>>, E> {
        let middle = self.sides.map(|side| 0.5 * (side as f64 + 1.0));
        let inside = |place: &Option<[f64; 2]>| {
            let [x, y] = place.unwrap_or(middle);
            let within = |at: f64, side: usize| at.clamp(1.0, side as f64);
            (within(x, self.sides[0]), within(y, self.sides[1]))
        };
        let count = if self.is_constant { 1 } else { places.len() };
        let places: Vec<(f64, f64)> = places[..count].iter().map(inside).collect();
        let stars = (self.stars)(&places)?;
        all_of_sum_one(&stars, &places).map_err(&self.fault)
    }

    /// Offsets in pixels of this epoch of those in pixels of the first one, near places.
    fn matrices(&mut self, places: &[[f64; 2]]) -> Result<Vec<Option<Matrix2>>, E> {
        let h = AXES_STEP_PX;
        let around = |&[x, y]: &[f64; 2]| [[x + h, y], [x - h, y], [x, y + h], [x, y - h]];
        let around: Vec<[f64; 2]> = places.iter().flat_map(around).collect();
        let found = (self.places)(&around)?;
        let matrix = |found: &[Option<[f64; 2]>]| {
            let [right, left, up, down] = [found[0]?, found[1]?, found[2]?, found[3]?];
            let slope = |k: usize| [right[k] - left[k], up[k] - down[k]].map(|own| own / (2.0 * h));
            let matrix = [slope(0), slope(1)];
            determinant(matrix).is_normal().then_some(matrix)
        };
        Ok(found.chunks_exact(4).map(matrix).collect())
    }
}

/// What all cells of an epoch have in common.
#[derive(Debug)]
pub(super) struct EpochPlan {
    pub(super) sides: [usize; 2],
    pub(super) noise: StampNoise,
    /// One, or one for each cell.
    pub(super) stars: Vec<Array2<f64>>,
    /// Of each cell.
    pub(super) matrices: Vec<Option<Matrix2>>,
    /// Of each block; `None` of those that the epoch does not touch.
    pub(super) maps: Vec<Option<BlockMap>>,
    /// Pixels on each side of the pixel under a functional: those under its kernel, and those before and after it from which its value
    /// is interpolated.
    pub(super) radius: usize,
    pub(super) taps: [usize; 2],
    pub(super) transform: SquareTransform,
    pub(super) defects: ExposureDefects,
}

/// Several exposures of one sky, in cells of the first one.
#[derive(Debug)]
pub struct EpochCells {
    /// With the widths, margin and tiles of all.
    pub(super) shared: Arc<Detector>,
    pub(super) sides: [usize; 2],
    pub(super) epochs: Vec<EpochPlan>,
    /// Of interpolated v₀, in units of it.
    pub(super) light_error: f64,
    grid: CellGrid,
    /// Tiles of a row.
    columns: usize,
}

/// What an epoch is behind its PSF in a cell.
#[derive(Debug)]
pub(super) struct EpochFunctionals {
    pub(super) functionals: Functionals,
    /// Of v₀, in single precision, which finds candidates.
    pub(super) light_filter: Vec<[f32; 2]>,
    /// One over the variance of v₀.
    pub(super) weight: f64,
    pub(super) matrix: Matrix2,
}

/// The functionals of a cell, by epochs that it may have.
#[derive(Debug)]
pub struct EpochDetector(pub(super) Vec<Option<EpochFunctionals>>);

/// A square of pixels of an epoch, under a block of the first exposure.
#[derive(Debug, Clone, Copy)]
pub struct Patch {
    /// The epoch, from 0.
    pub epoch: usize,
    /// Column and row of the epoch's pixel that is the first one of the square; some may be beyond the epoch.
    pub origin: [i64; 2],
    /// Columns and rows.
    pub side: usize,
    /// 0 for the upper and 1 for the lower block of a tile.
    pub(super) half: usize,
    /// To the pixels of the square.
    pub(super) map: BlockMap,
}

impl EpochCells {
    /// Detections on the pixels of the first of some epochs.
    ///
    /// # Errors
    /// Those of the epochs, and as [`Detector::new`].
    ///
    /// # Panics
    /// If there are none, or more than [`MAX_EPOCHS`].
    pub fn new<E>(
        mut epochs: Vec<Epoch<'_, E>>,
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
    ) -> Result<Self, E> {
        assert!(
            (1..=MAX_EPOCHS).contains(&epochs.len()),
            "{} epochs",
            epochs.len()
        );
        let sides = epochs[0].sides;
        epochs[0].places = Box::new(|places| Ok(places.iter().copied().map(Some).collect()));
        let some = middles(sides, sides.map(|side| side.div_ceil(PARTS).max(1)));
        let some: Vec<[f64; 2]> = some.into_iter().map(|(x, y)| [x, y]).collect();
        let (mut sigmas, mut first, mut is_constant) = (Vec::new(), None, true);
        for epoch in &mut epochs {
            let places = (epoch.places)(&some)?;
            let matrices: Vec<Matrix2> = epoch.matrices(&some)?.into_iter().flatten().collect();
            let stars = epoch.stars_at(&places)?;
            let sigma = |star: &Array2<f64>| gaussian_sigma(star.view());
            let broadest = stars.iter().max_by(|a, b| sigma(a).total_cmp(&sigma(b)));
            let broadest = broadest.ok_or(MeasureError::DarkPsf(0.0));
            let broadest = broadest.map_err(&epoch.fault)?;
            let scale = matrices.first().map_or(1.0, pixels_per_pixel);
            sigmas.push(sigma(broadest) / scale);
            is_constant &= epoch.is_constant && are_close(&matrices);
            first.get_or_insert_with(|| broadest.clone());
        }
        // Behind the broadest of all, sharper epochs would lose what they resolve.
        let sigma = upper_median(&mut sigmas).unwrap_or_default();
        let noise = epochs[0].noise.clone();
        let shared = first.ok_or(MeasureError::DarkPsf(0.0));
        let shared = shared
            .and_then(|star| Detector::of_width(&star, sigma, &noise, jacobian, settings))
            .map_err(&epochs[0].fault)?;
        let tile = [shared.columns_per_tile(), shared.rows_per_tile()];
        let tiles = [0, 1].map(|k| sides[k].div_ceil(tile[k]));
        let tiles_per_cell = if is_constant { tiles } else { TILES_PER_CELL };
        let mut cells = EpochCells {
            sides,
            epochs: Vec::new(),
            light_error: 0.0,
            grid: CellGrid {
                tiles_per_cell,
                columns: tiles[0].div_ceil(tiles_per_cell[0]),
            },
            columns: tiles[0],
            shared: Arc::new(shared),
        };
        let cell = [0, 1].map(|k| tiles_per_cell[k] * tile[k]);
        let middles = middles(sides, cell)
            .into_iter()
            .map(|(x, y)| [x, y])
            .collect::<Vec<_>>();
        for (at, epoch) in epochs.into_iter().enumerate() {
            let plan = cells.plan(at == 0, epoch, &middles)?;
            let smoothed = cells.shared.shared.lengths.detection_sigma;
            for scale in plan.matrices.iter().flatten().map(pixels_per_pixel) {
                let error = CUBIC_ERROR / (scale * smoothed).powi(4);
                cells.light_error = cells.light_error.max(error);
            }
            cells.epochs.push(plan);
        }
        Ok(cells)
    }

    fn plan<E>(
        &self,
        is_first: bool,
        mut epoch: Epoch<'_, E>,
        middles: &[[f64; 2]],
    ) -> Result<EpochPlan, E> {
        if !(epoch.noise.sigma() > 0.0 && epoch.noise.sigma().is_normal()) {
            return Err((epoch.fault)(MeasureError::Noise(
                epoch.noise.sigma().to_string(),
            )));
        }
        let places = (epoch.places)(middles)?;
        let stars = epoch.stars_at(&places)?;
        let matrices = match is_first {
            true => vec![Some([[1.0, 0.0], [0.0, 1.0]]); middles.len()],
            false => epoch.matrices(middles)?,
        };
        let reach = self.shared.shared.lengths.reach();
        let axes = |matrix: &Matrix2| self.axes(*matrix).radius(reach);
        let radius = matrices.iter().flatten().map(axes).max().unwrap_or(0);
        let taps = if is_first {
            [0; 2]
        } else {
            [TAPS / 2 - 1, TAPS / 2]
        };
        let mut defects = ExposureDefects::new(stars[0].view(), epoch.noise.sigma());
        for star in &stars[1..] {
            defects.keep_light_behind(star.view());
        }
        let mut plan = EpochPlan {
            sides: epoch.sides,
            noise: epoch.noise.clone(),
            stars,
            matrices,
            maps: Vec::new(),
            radius,
            taps,
            transform: SquareTransform::new(1),
            defects,
        };
        let (mut side, sides) = (1, epoch.sides);
        plan.maps = self.maps(is_first, &mut epoch, |map, length| {
            let [low, high] = map.bounds(length);
            let touches = [0, 1].map(|k| {
                let beyond = (radius + TAPS) as f64;
                high[k] > -beyond && low[k] < sides[k] as f64 + beyond
            });
            let most = (high[0] - low[0]).max(high[1] - low[1]);
            let under = 2 * radius + 2 + taps[0] + taps[1];
            let own = (most + 2.0 * MAP_SLACK_PX).ceil() as usize + under;
            let is_touched = touches == [true; 2];
            side = side.max(if is_touched { own } else { 1 });
            is_touched
        })?;
        if plan.maps.iter().all(Option::is_none) {
            return Err((epoch.fault)(MeasureError::Shape {
                what: "the exposure",
                found: "no pixels on the first one".into(),
                expected: "some, as exposures of one sky have".into(),
            }));
        }
        plan.transform = SquareTransform::new(fast_side(side));
        // Cells that the epoch does not touch need no functionals.
        let mut is_touched = vec![false; plan.matrices.len()];
        for (block, _) in plan.maps.iter().enumerate().filter(|own| own.1.is_some()) {
            let [column, row] = [block % self.columns, block / self.columns / 2];
            let row = row / self.grid.tiles_per_cell[1];
            is_touched[row * self.grid.columns + self.grid.column(column)] = true;
        }
        for (matrix, is_touched) in plan.matrices.iter_mut().zip(is_touched) {
            *matrix = matrix.filter(|_| is_touched);
        }
        Ok(plan)
    }

    // The maps of all blocks, row by row.
    fn maps<E>(
        &self,
        is_first: bool,
        epoch: &mut Epoch<'_, E>,
        mut touches: impl FnMut(&BlockMap, f64) -> bool,
    ) -> Result<Vec<Option<BlockMap>>, E> {
        let inner = self.shared.columns_per_tile();
        let step = 0.5 * (inner as f64 - 1.0);
        let mut points = Vec::new();
        let rows = 2 * self.sides[1].div_ceil(2 * inner);
        let firsts: Vec<[usize; 2]> = (0..rows)
            .flat_map(|y| (0..self.columns).map(move |x| [x * inner, y * inner]))
            .collect();
        for first in &firsts {
            let [x, y] = first.map(|at| at as f64 + 1.0);
            let row = |j: usize| (0..3).map(move |i| [x + i as f64 * step, y + j as f64 * step]);
            points.extend((0..3).flat_map(row));
        }
        let found = if is_first {
            Vec::new()
        } else {
            (epoch.places)(&points)?
        };
        let map = |(at, first): (usize, &[usize; 2])| {
            let map = match is_first {
                true => BlockMap::shift(first.map(|at| at as f64)),
                false => BlockMap::through(&found[9 * at..][..9], step)?,
            };
            touches(&map, 2.0 * step).then_some(map)
        };
        Ok(firsts.iter().enumerate().map(map).collect())
    }

    fn axes(&self, matrix: Matrix2) -> Axes {
        let pixels = self.shared.shared.pixels;
        Axes { pixels, matrix }
    }

    /// A detector with the margin and the tiles of all.
    pub fn shared(&self) -> &Detector {
        &self.shared
    }

    /// Stars of an epoch, and the number of cells.
    pub fn stars(&self, epoch: usize) -> &[Array2<f64>] {
        &self.epochs[epoch].stars
    }

    /// Number of cells.
    pub fn count(&self) -> usize {
        self.epochs[0].matrices.len()
    }

    /// Tiles along each row and column.
    pub fn tiles(&self) -> [usize; 2] {
        [
            self.columns,
            self.sides[1].div_ceil(self.shared.rows_per_tile()),
        ]
    }

    /// Which cells the tiles are in.
    pub fn grid(&self) -> CellGrid {
        self.grid
    }

    /// The detector of a cell.
    pub fn detector(&self, cell: usize) -> Arc<EpochDetector> {
        let lengths = &self.shared.shared.lengths;
        let of = |epoch: &EpochPlan| {
            let matrix = epoch.matrices[cell]?;
            let axes = self.axes(matrix);
            let star = epoch.stars.get(cell).unwrap_or(&epoch.stars[0]).view();
            let functionals = Functionals::new(star, &epoch.noise, lengths, &axes, epoch.radius);
            let light_filter = light_filter(star, lengths, &axes, &epoch.transform);
            let single = light_filter.iter();
            let single = single.map(|own| [own.re as f32, own.im as f32]);
            Some(EpochFunctionals {
                weight: 1.0 / functionals.covariances.plain[LIGHT][LIGHT],
                functionals,
                light_filter: single.collect(),
                matrix,
            })
        };
        Arc::new(EpochDetector(self.epochs.iter().map(of).collect()))
    }

    /// The squares of pixels that a tile needs.
    pub fn patches(&self, [column, row]: [usize; 2]) -> Vec<Patch> {
        let length = self.shared.columns_per_tile() as f64 - 1.0;
        let mut found = Vec::new();
        for half in 0..2 {
            let block = (2 * row + half) * self.columns + column;
            for (at, epoch) in self.epochs.iter().enumerate() {
                let Some(map) = epoch.maps[block] else {
                    continue;
                };
                let [low, _] = map.bounds(length);
                let before = (epoch.radius + epoch.taps[0]) as f64 + MAP_SLACK_PX;
                let origin = low.map(|low| (low - before).floor());
                found.push(Patch {
                    epoch: at,
                    origin: origin.map(|at| at as i64),
                    side: epoch.transform.side,
                    half,
                    map: map.counted_from(origin),
                });
            }
        }
        found
    }
}

/// Pixels of an epoch along a pixel of the first one.
fn pixels_per_pixel(matrix: &Matrix2) -> f64 {
    determinant(*matrix).abs().sqrt()
}

/// Whether the axes of an epoch are the same in all parts of the exposure.
fn are_close(matrices: &[Matrix2]) -> bool {
    let off = |own: &Matrix2, first: &Matrix2| {
        let pairs = own.as_flattened().iter().zip(first.as_flattened());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let first = matrices.first();
    first.is_some_and(|first| {
        matrices
            .iter()
            .all(|own| off(own, first) < MAX_AXES_DIFFERENCE)
    })
}

/// The least number of pixels from this one on whose Fourier transform is fast: of factors 2 and 3.
fn fast_side(least: usize) -> usize {
    let has_small_factors = |side: &usize| {
        let mut rest = *side;
        for factor in [2, 3] {
            while rest.is_multiple_of(factor) {
                rest /= factor;
            }
        }
        rest == 1
    };
    (least..)
        .step_by(1)
        .find(has_small_factors)
        .unwrap_or(least)
}

//! The weights and ellipticities of all pixels of an exposure.

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2};
use shearq_measure::parts::{ExposureDefects, gaussian_sigma};
use shearq_measure::{MeasureError, StampNoise};
use shearq_quantities::fourier::Complex64;
use shearq_quantities::{Jacobian, PixelShape, Spin2};
use shearq_submissions::DetectionMethod;

use crate::functionals::{
    Axes, Covariances, Functionals, KERNELS, Lengths, SquareTransform, light_filters,
};
use crate::pixel::DetectedPixel;
use crate::weight::{COUNT, EXCESS, LIGHT, M00, NEIGHBOURS, Square, Steps, Values, dot, trace};

// Two blocks of fewer margins lose most of their pixels.
const MIN_MARGINS_PER_BLOCK: usize = 8;
// Pixels a side of a star: more than PSF models have, and less than an exposure that is given in its place.
const MAX_STAR: usize = 512;
// Of a bound, in its standard deviations: what the Fourier transform and the sums over squares may differ by.
const SLACK: f64 = 0.01;

/// What detectors of an exposure have in common, whatever the star.
#[derive(Debug, Clone)]
pub(crate) struct Shared {
    pub(crate) settings: DetectionMethod,
    noise: StampNoise,
    pub(crate) lengths: Lengths,
    pub(crate) pixels: PixelShape,
    turn: Spin2,
    defects: ExposureDefects,
}

/// What weights and responses need to know of the noise of functionals.
#[derive(Debug)]
pub(crate) struct Constants {
    pub(crate) steps: Steps,
    /// Standard deviation of the noise of v₀.
    pub(crate) light_noise: f64,
    /// Σ_ab f_ab of these are subtracted from responses.
    of_shear: [Square; 2],
    /// The same, added to f.
    of_psf: Square,
}

/// Finds the detections of exposures behind a star.
#[derive(Debug)]
pub struct Detector {
    pub(crate) shared: Shared,
    functionals: Functionals,
    radius: usize,
    constants: Constants,
    transform: SquareTransform,
    /// That of v₀, and those of the neighbours if they are between pixels.
    light_filters: Vec<Vec<Complex64>>,
}

/// Buffers of a thread.
#[derive(Debug)]
pub struct DetectionScratch {
    image: Vec<Complex64>,
    spectrum: Vec<Complex64>,
    /// Smoothed light of both blocks, and that of the neighbours.
    maps: Vec<Vec<Complex64>>,
    transform: Vec<Complex64>,
    defects: ExposureDefects,
    /// Places of defects in a block.
    places: Vec<usize>,
}

/// A part of an exposure: two blocks, one below the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tile {
    /// Column and row of the exposure's pixel that is the first pixel of the tile; negative on the margin.
    pub origin: [i64; 2],
    /// Columns and rows.
    pub sides: [usize; 2],
}

impl Constants {
    pub(crate) fn new(covariances: &Covariances, settings: &DetectionMethod) -> Self {
        let mut of_psf = covariances.turned;
        let plain = covariances.plain.as_flattened();
        for (value, plain) in of_psf.as_flattened_mut().iter_mut().zip(plain) {
            *value = 0.25 * (*value - plain);
        }
        // Of the mean of both covariances: noise of the PSF's shape would make steps of other widths along one axis, and the weight a
        // function of direction.
        let deviation =
            |a: usize| (0.5 * (covariances.plain[a][a] + covariances.turned[a][a])).sqrt();
        let of_excess = (EXCESS..M00).map(deviation).sum::<f64>() / NEIGHBOURS as f64;
        let steps = Steps {
            threshold: settings.threshold * deviation(LIGHT),
            threshold_half_width: settings.threshold_half_width * deviation(LIGHT),
            neighbour_half_width: settings.neighbour_half_width * of_excess,
            neighbour_share: settings.neighbour_share,
            softening: settings.softening * deviation(M00),
        };
        Constants {
            steps,
            light_noise: deviation(LIGHT),
            of_shear: covariances.sheared,
            of_psf,
        }
    }
}

impl Shared {
    /// A pixel of functionals and their changes with both components of shear; `None` without a weight.
    pub(crate) fn pixel(
        &self,
        place: [usize; 2],
        [u, changes @ ..]: &[Values; 3],
        constants: &Constants,
    ) -> Option<DetectedPixel> {
        let steps = &constants.steps;
        // A light far below zero is no galaxy but a wrong sky, and would be divided by.
        if u[M00] <= -0.5 * steps.softening {
            return None;
        }
        let (weight, of) = steps.weighted(u)?;
        let response = [0, 1].map(|k| {
            [0, 1].map(|g| {
                dot(&of[k].first, &changes[g]) - trace(&of[k].second, &constants.of_shear[g])
            })
        });
        let e = [0, 1].map(|k| of[k].value + trace(&of[k].second, &constants.of_psf));
        Some(DetectedPixel {
            place,
            weight,
            e: self.turn.turn(e),
            response: self.turn.turn_response(response),
            snr: u[LIGHT] / constants.light_noise,
        })
    }
}

impl Detector {
    /// Detections behind `star`, a stamp centred on the star, in noise. Ellipticities are those on the sky by `jacobian`, or along the pixel axes.
    ///
    /// # Errors
    /// If the star has no light or is larger than a stamp, or the noise level is not a positive number.
    pub fn new(
        star: ArrayView2<'_, f64>,
        noise: &StampNoise,
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
    ) -> Result<Self, MeasureError> {
        let star = of_sum_one(star)?;
        let sigma = gaussian_sigma(star.view());
        Detector::of_width(&star, sigma, noise, jacobian, settings)
    }

    /// The same behind a star of sum one, with lengths that are those behind a Gaussian star of this width.
    pub(crate) fn of_width(
        star: &Array2<f64>,
        sigma: f64,
        noise: &StampNoise,
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
    ) -> Result<Self, MeasureError> {
        if !(noise.sigma() > 0.0 && noise.sigma().is_normal()) {
            return Err(MeasureError::Noise(noise.sigma().to_string()));
        }
        let (turn, pixels) = match jacobian {
            Some(jacobian) => {
                let (orientation, pixels) = jacobian.factors();
                (orientation.spin2(), pixels)
            }
            None => (
                Jacobian::new([[1.0, 0.0], [0.0, 1.0]])?.factors().0.spin2(),
                PixelShape::SQUARE,
            ),
        };
        let lengths = Lengths {
            detection_sigma: settings.detection_sigma * sigma,
            moment_sigma: settings.moment_sigma * sigma,
            distance: (settings.neighbour_distance * sigma).round().max(1.0) as usize,
        };
        let shared = Shared {
            settings: *settings,
            noise: noise.clone(),
            lengths,
            pixels,
            turn,
            defects: ExposureDefects::new(star.view(), noise.sigma()),
        };
        Ok(Detector::with(star, shared))
    }

    /// The same behind another star, of sum one. Smoothed light and moments have the same widths, and margin and tiles are the same, so
    /// that neither changes where the star does.
    pub(crate) fn behind(&self, star: &Array2<f64>) -> Self {
        Detector::with(star, self.shared.clone())
    }

    /// Also takes pixels for light that are as sharp as a star of sum one.
    pub(crate) fn keep_light_behind(&mut self, star: ArrayView2<'_, f64>) {
        self.shared.defects.keep_light_behind(star);
    }

    fn with(star: &Array2<f64>, shared: Shared) -> Self {
        let Shared {
            settings,
            ref noise,
            lengths,
            pixels,
            ..
        } = shared;
        let reach = lengths.reach();
        // Circles on the sky are longer along one axis of the pixels.
        let longest = pixels.stretch.max(1.0 / pixels.stretch) + pixels.skew.abs();
        let radius = (longest * reach).ceil() as usize;
        let margin = radius + 1 + lengths.distance;
        let transform = SquareTransform::new((MIN_MARGINS_PER_BLOCK * margin).next_power_of_two());
        let functionals =
            Functionals::new(star.view(), noise, &lengths, &Axes::own(pixels), radius);
        let constants = Constants::new(&functionals.covariances, &settings);
        Detector {
            light_filters: light_filters(star.view(), &lengths, pixels, &transform),
            functionals,
            radius,
            constants,
            transform,
            shared,
        }
    }

    /// Buffers for [`Detector::detect`].
    pub fn scratch(&self) -> DetectionScratch {
        let pixels = self.transform.side * self.transform.side;
        DetectionScratch {
            image: vec![Complex64::default(); pixels],
            spectrum: vec![Complex64::default(); pixels],
            maps: vec![vec![Complex64::default(); pixels]; self.light_filters.len()],
            transform: vec![Complex64::default(); self.transform.scratch()],
            defects: self.shared.defects.clone(),
            places: Vec::new(),
        }
    }

    /// Makes the pixels of a tile missing (NaN) that hold no light, whatever galaxies there are. Returns how many of them are in the middle,
    /// which no other tile has. `pixels` are as for [`Detector::detect`], row by row.
    pub fn remove_unlit(&self, pixels: &mut [f32], scratch: &mut DetectionScratch) -> usize {
        let (side, inner, outer) = (self.transform.side, self.inner(), self.outer());
        let DetectionScratch {
            defects, places, ..
        } = scratch;
        let mut count = 0;
        for first in [0, inner * side] {
            places.clear();
            defects.remove(&mut pixels[first..first + side * side], side, places);
            let is_in_middle = |place: &&usize| {
                let at = *place + first;
                let middle = outer..outer + inner;
                middle.contains(&(at % side)) && (outer..outer + 2 * inner).contains(&(at / side))
            };
            count += places.iter().filter(is_in_middle).count();
        }
        count
    }

    /// Distance in pixels from an edge or a missing pixel, along either axis, within which no pixel has a weight. It does not depend
    /// on the image, so that it selects no galaxies by their shear.
    pub fn margin(&self) -> usize {
        self.radius
    }

    /// Smoothed light in image units at which a pixel has half of its weight.
    pub fn threshold(&self) -> f64 {
        self.constants.steps.threshold
    }

    // Rows and columns of the middle of a block.
    fn inner(&self) -> usize {
        self.transform.side - 2 * self.outer()
    }

    // Those on each side of it.
    fn outer(&self) -> usize {
        self.radius + 1 + self.shared.lengths.distance
    }

    /// Columns of the exposure that the middle of a tile has.
    pub(crate) fn columns_per_tile(&self) -> usize {
        self.inner()
    }

    /// Rows of the exposure that the middles of a row of tiles have.
    pub fn rows_per_tile(&self) -> usize {
        2 * self.inner()
    }

    /// The tiles of the row `number` of an exposure of `width` columns, from left to right. They depend on the exposure alone.
    pub fn tiles(&self, width: usize, number: usize) -> impl Iterator<Item = Tile> + use<> {
        let (inner, outer) = (self.inner(), self.outer() as i64);
        let side = self.transform.side;
        let y = (number * 2 * inner) as i64 - outer;
        (0..width).step_by(inner).map(move |x| Tile {
            origin: [x as i64 - outer, y],
            sides: [side, side + inner],
        })
    }

    /// Appends the pixels with a weight in the middle of a tile to `found`, row by row. `pixels` are those of the whole tile, NaN
    /// beyond the exposure and where they are missing.
    ///
    /// # Errors
    /// If there are not as many pixels as the tile has.
    pub fn detect(
        &self,
        tile: &Tile,
        pixels: ArrayView2<'_, f32>,
        scratch: &mut DetectionScratch,
        found: &mut Vec<DetectedPixel>,
    ) -> Result<(), MeasureError> {
        let (side, inner, outer) = (self.transform.side, self.inner(), self.outer());
        let [columns, rows] = tile.sides;
        let (Some(values), true) = (
            pixels.to_slice(),
            pixels.dim() == (rows, columns) && rows == side + inner,
        ) else {
            return Err(MeasureError::Shape {
                what: "a tile",
                found: format!("{} × {} pixels", pixels.ncols(), pixels.nrows()),
                expected: format!("{columns} × {rows} in rows"),
            });
        };
        let known = |value: f32| {
            if value.is_finite() {
                f64::from(value)
            } else {
                0.0
            }
        };
        let DetectionScratch {
            image,
            spectrum,
            maps,
            transform,
            ..
        } = scratch;
        for (at, value) in image.iter_mut().enumerate() {
            // Filters of real kernels leave the blocks apart.
            *value = Complex64::new(known(values[at]), known(values[at + inner * side]));
        }
        self.transform.forward(image, spectrum, transform);
        for (map, filter) in maps.iter_mut().zip(&self.light_filters) {
            for ((to, value), filter) in image.iter_mut().zip(&*spectrum).zip(filter) {
                *to = value * filter;
            }
            self.transform.inverse(image, map, transform);
        }
        let slack = SLACK * self.constants.light_noise;
        let steps = &self.constants.steps;
        let distance = self.shared.lengths.distance;
        for y in outer..outer + 2 * inner {
            // The row in the map of its block.
            let is_lower = y >= outer + inner;
            let row = if is_lower { y - inner } else { y };
            let of = |map: &[Complex64], row: usize, x: usize| {
                let value = map[row * side + x];
                if is_lower { value.im } else { value.re }
            };
            let light = |row: usize, x: usize| of(&maps[0], row, x);
            for x in outer..outer + inner {
                let own = light(row, x);
                let neighbours = || match &maps[1..] {
                    [a, b, c, d] => [a, b, c, d].map(|map| of(map, row, x)),
                    _ => [
                        light(row, x + distance),
                        light(row, x - distance),
                        light(row + distance, x),
                        light(row - distance, x),
                    ],
                };
                if own < steps.threshold - steps.threshold_half_width - slack
                    || !steps.may_count(own, neighbours(), slack)
                {
                    continue;
                }
                let place = [x as i64 + tile.origin[0], y as i64 + tile.origin[1]];
                let sums = self.sums(values, side, [x, y]);
                found.extend(self.pixel(place.map(|at| at as usize), &sums));
            }
        }
        Ok(())
    }

    // All functionals at a pixel of a tile, and their changes with shear.
    fn sums(&self, values: &[f32], columns: usize, [x, y]: [usize; 2]) -> [f32; KERNELS] {
        let first = (y - self.radius) * columns + x - self.radius;
        let side = 2 * self.radius + 2;
        weighted_sums(&values[first..], columns, &self.functionals.kernels, side)
    }

    // `None` without a weight, and near missing pixels, which make the sums NaN.
    fn pixel(&self, place: [usize; 2], sums: &[f32; KERNELS]) -> Option<DetectedPixel> {
        let (parts, _) = sums.as_chunks::<COUNT>();
        let values = [0, 1, 2].map(|k| parts[k].map(f64::from));
        let is_known = sums.iter().all(|sum| sum.is_finite());
        is_known.then(|| self.shared.pixel(place, &values, &self.constants))?
    }
}

/// A star in units of its light.
pub(crate) fn of_sum_one(star: ArrayView2<'_, f64>) -> Result<Array2<f64>, MeasureError> {
    if !star.is_square() || star.nrows() > MAX_STAR {
        return Err(MeasureError::Shape {
            what: "the PSF",
            found: format!("{} × {} pixels", star.ncols(), star.nrows()),
            expected: format!(
                "a square stamp of a star, at most {MAX_STAR} pixels a side. Try: exchange exposure and PSF, or cut the star"
            ),
        });
    }
    let sum = star.sum();
    if !(sum > 0.0 && sum.is_finite()) {
        return Err(MeasureError::DarkPsf(sum));
    }
    Ok(star.mapv(|value| value / sum))
}

/// Σ over a square of `side` pixels, of rows that are `columns` apart, of each pixel times its weights.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn weighted_sums(
    pixels: &[f32],
    columns: usize,
    weights: &[[f32; KERNELS]],
    side: usize,
) -> [f32; KERNELS] {
    // Two sums at a time, so that an addition does not wait for the one before.
    let mut sums = [[0.0f32; KERNELS]; 2];
    for (row, weights) in pixels.chunks(columns).zip(weights.chunks_exact(side)) {
        let (pairs, _) = row[..side].as_chunks::<2>();
        let (of_pairs, _) = weights.as_chunks::<2>();
        for (pixels, weights) in pairs.iter().zip(of_pairs) {
            for half in 0..2 {
                for (sum, weight) in sums[half].iter_mut().zip(&weights[half]) {
                    *sum += pixels[half] * weight;
                }
            }
        }
    }
    let [even, odd] = sums;
    std::array::from_fn(|kernel| even[kernel] + odd[kernel])
}

#[cfg(test)]
mod tests;

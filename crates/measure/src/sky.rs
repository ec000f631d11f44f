//! The sky of an image: one plane under all of its stamps, or one plane per stamp.
//!
//! The plane of an image follows from the medians over stamps of small cells away from the galaxies. The wings of the
//! galaxies are in these cells as well. Therefore the plane is fitted together with a wing that falls with the distance
//! r from the centre of the stamp as f(r) = exp(−p ((r/r₀)^q − 1)/q), and with the wing's change with the position of the
//! galaxy. Powers of r have q = 0, exponentials q = 1 and Gaussians q = 2. All p and q that the profile allows bound the
//! level; only what is beyond that bound is sky.

use std::f64::consts::PI;

use shearq_quantities::linear::cholesky;
use shearq_quantities::statistics::{FROM_MODULI, OF_MEDIAN, median, scatter};

use crate::missing::padding;

// Radius in pixels within which a galaxy's light is summed. Chosen by hand.
pub(crate) const INNER_RADIUS: f64 = 8.0;
pub(crate) const INNER_AREA: f64 = PI * INNER_RADIUS * INNER_RADIUS;
// 4 px on 48 px: 112 cells at least 12 px from the centre.
const CELLS_PER_SIDE: usize = 12;
// From the centre, in units of the stamp's side: 12 px on 48 px, where galaxies and wings of one family remain.
const MIN_CELL_DISTANCE: f64 = 0.25;
// Residual in units of the scatter beyond which a cell of a stamp does not count.
// Loses 0.3 % of Gaussian noise. Chosen by hand.
const OUTLIER_SCATTERS: f64 = 3.0;
// r₀, at which p is the slope of the wing, in units of the stamp's side. Definition; the middle of the cells' distances.
const WING_RADIUS: f64 = 0.4;
// Aureoles of PSFs fall as r⁻², de Vaucouleurs wings as r⁻²·⁴ at twice the half-light radius.
const WING_SLOPES: [f64; 14] = [
    2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0, 14.0,
];
// q of a power law, a Sérsic profile of n = 2, an exponential and a Gaussian.
const WING_STEEPENINGS: [f64; 4] = [0.0, 0.5, 1.0, 2.0];
// Excess of χ² over the least one, per unit of its scatter, up to which a wing is allowed.
// Three standard deviations of one number.
const ALLOWED_CHI2: f64 = 9.0;
// Groups of stamps whose scatter is the error of the plane. The error is known to a quarter. Chosen by hand.
const GROUPS: usize = 8;
// In a cell of a group: a scatter needs two.
const MIN_STAMPS: usize = 2;
// In σ, as for warnings.
const SIGNIFICANCE: f64 = 5.0;
// Light of the sky within 8 px, in units of the galaxy's, above which it is subtracted.
// A share of 0.04 (0.04 σ at S/N 20) changes m by (−0.2 ± 0.2)·10⁻³, seed 5, 16,000 measurements per shear.
const MIN_LEVEL_SHARE: f64 = 0.03;
// Change of this share over 8 px above which the gradient is subtracted.
// A change of 0.0075 (0.001 σ per pixel at S/N 20) changes c by −0.3·10⁻⁴, seed 5, 16,000 measurements per shear.
const MIN_SLOPE_SHARE: f64 = 0.01;
// Level and two slopes.
pub(crate) const PLANE_TERMS: usize = 3;
// The plane, the wing and its displacement along both axes.
const TERMS: usize = 6;

/// A plane under the stamps of an image, in image units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sky {
    /// Level at the centre of the stamps; zero if it is not significant, or too small to matter.
    pub level: f64,
    /// Standard error of the level; NaN of a single stamp.
    pub level_error: f64,
    /// Change per pixel along x and y; zero if it is not significant, or too small to matter.
    pub slope: [f64; 2],
    /// Standard error of either slope; NaN of a single stamp.
    pub slope_error: f64,
}

impl Sky {
    /// The plane at (x, y), in pixels from the centre of the stamp.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        self.level + self.slope[0] * x + self.slope[1] * y
    }

    pub(crate) fn subtract(&self, pixels: &mut [f32], n: usize) {
        let middle = (n as f64 - 1.0) / 2.0;
        let step = self.slope[0] as f32;
        for (y, row) in pixels.chunks_exact_mut(n).enumerate() {
            let first = self.at(-middle, y as f64 - middle) as f32;
            for (x, value) in row.iter_mut().enumerate() {
                *value -= first + step * x as f32;
            }
        }
    }
}

#[derive(Debug, Clone, Default)]
pub(crate) struct SkyLevels {
    levels: Vec<f32>,
    /// Light within 8 px of each galaxy.
    fluxes: Vec<f64>,
}

impl SkyLevels {
    pub(crate) fn add(&mut self, cells: &SkyCells, flux: f64) {
        self.levels.extend_from_slice(&cells.levels);
        self.fluxes.push(flux);
    }

    pub(crate) fn join(&mut self, other: &Self) {
        self.levels.extend_from_slice(&other.levels);
        self.fluxes.extend_from_slice(&other.fluxes);
    }

    /// The plane under the stamps, if it is significant and matters. `is_rejected` is true of stamps and cells, counted
    /// from 0, that another galaxy is near.
    pub(crate) fn sky(
        &self,
        cells: &SkyCells,
        is_rejected: impl Fn(usize, usize) -> bool,
    ) -> Option<Sky> {
        let count = cells.levels.len();
        let of_group = |group: Option<usize>| -> Vec<CellLevel> {
            let mut values = Vec::new();
            let places = cells.places().enumerate();
            places
                .filter_map(|(at, place)| {
                    values.clear();
                    let stamps = self.levels.chunks_exact(count).enumerate();
                    let own = stamps.filter(|(k, _)| group.is_none_or(|group| k % GROUPS == group));
                    let good =
                        own.filter(|(k, levels)| !levels[at].is_nan() && !is_rejected(*k, at));
                    values.extend(good.map(|(_, levels)| f64::from(levels[at])));
                    CellLevel::of(&mut values, place)
                })
                .collect()
        };
        let best = BoundedPlane::fit(&of_group(None), cells.full)?;
        let groups: Vec<[f64; PLANE_TERMS]> = (0..GROUPS)
            .map(|group| {
                let fit = fit(&of_group(Some(group)), cells.full, best.wing)?;
                Some([0, 1, 2].map(|k| fit.values[k]))
            })
            .collect::<Option<_>>()?;
        // The error of the mean of groups is about that of the fit to all stamps.
        let error = |k: usize| {
            let mean = groups.iter().map(|plane| plane[k]).sum::<f64>() / GROUPS as f64;
            let square = groups.iter().map(|plane| (plane[k] - mean).powi(2));
            let freedom = GROUPS * (GROUPS - 1);
            let error = (square.sum::<f64>() / freedom as f64).sqrt();
            error.max(best.errors[k])
        };
        let errors = [error(0), error(1).max(error(2))];
        let [level, slope @ ..] = best.plane;
        let mut fluxes: Vec<f64> = self.fluxes.iter().map(|f| f - level * INNER_AREA).collect();
        let flux = median(&mut fluxes)?.abs();
        let steepness = slope[0].hypot(slope[1]);
        let has_level = best.least[0] > SIGNIFICANCE * errors[0]
            && level.abs() * INNER_AREA > MIN_LEVEL_SHARE * flux;
        let has_slope = best.least[1] > SIGNIFICANCE * errors[1]
            && steepness * INNER_RADIUS * INNER_AREA > MIN_SLOPE_SHARE * flux;
        (has_level || has_slope).then_some(Sky {
            level: if has_level { level } else { 0.0 },
            level_error: errors[0],
            slope: if has_slope { slope } else { [0.0; 2] },
            slope_error: errors[1],
        })
    }
}

#[derive(Debug, Clone, Copy)]
struct CellLevel {
    place: [f64; 2],
    level: f64,
    weight: f64,
}

impl CellLevel {
    /// `None` of a few stamps, or stamps without noise.
    fn of(values: &mut [f64], place: [f64; 2]) -> Option<CellLevel> {
        if values.len() < MIN_STAMPS {
            return None;
        }
        let (level, scatter) = scatter(values)?;
        let weight = values.len() as f64 / (OF_MEDIAN * scatter).powi(2);
        weight.is_finite().then_some(CellLevel {
            place,
            level,
            weight,
        })
    }
}

#[derive(Debug, Clone, Copy)]
struct Wing {
    p: f64,
    q: f64,
}

impl Wing {
    /// f and −r f′ at r, in units of r₀.
    fn at(self, r: f64) -> [f64; 2] {
        let Wing { p, q } = self;
        if q == 0.0 {
            let value = r.powf(-p);
            return [value, p * value];
        }
        let power = r.powf(q);
        let value = (-p * (power - 1.0) / q).exp();
        [value, p * power * value]
    }
}

/// The plane under a profile, bounded by the wings that the profile allows.
#[derive(Debug, Clone, Copy)]
struct BoundedPlane {
    plane: [f64; PLANE_TERMS],
    errors: [f64; PLANE_TERMS],
    wing: Option<Wing>,
    /// Least modulus with any allowed wing of the level (zero if both signs are allowed) and of the gradient.
    least: [f64; 2],
}

impl BoundedPlane {
    fn fit(levels: &[CellLevel], full: usize) -> Option<BoundedPlane> {
        let mut fits = vec![(fit(levels, full, None)?, None)];
        for q in WING_STEEPENINGS {
            for p in WING_SLOPES {
                let wing = Some(Wing { p, q });
                // Wings are not negative.
                let found = fit(levels, full, wing).filter(|fit| fit.values[PLANE_TERMS] > 0.0);
                fits.extend(found.map(|fit| (fit, wing)));
            }
        }
        let by_chi2 = |a: &&(Fit, _), b: &&(Fit, _)| a.0.chi2.total_cmp(&b.0.chi2);
        let (best, wing) = *fits.iter().min_by(by_chi2)?;
        let freedom = (levels.len().checked_sub(TERMS + 2)?).max(1) as f64;
        let limit = best.chi2 + ALLOWED_CHI2 * (best.chi2 / freedom).max(1.0);
        let least_along = |direction: [f64; PLANE_TERMS]| {
            let allowed = fits.iter().filter(|(fit, _)| fit.chi2 <= limit);
            let along = allowed
                .map(|(fit, _)| (0..PLANE_TERMS).map(|k| fit.values[k] * direction[k]).sum());
            along.fold(f64::INFINITY, f64::min).max(0.0)
        };
        let [_, x, y, ..] = best.values;
        let steepness = x.hypot(y).max(f64::MIN_POSITIVE);
        // A misfit of all wings is part of the errors.
        let misfit = (best.chi2 / freedom).max(1.0).sqrt();
        Some(BoundedPlane {
            plane: [0, 1, 2].map(|k| best.values[k]),
            errors: [0, 1, 2].map(|k| misfit * best.errors[k]),
            wing,
            least: [
                least_along([best.values[0].signum(), 0.0, 0.0]),
                least_along([0.0, x / steepness, y / steepness]),
            ],
        })
    }
}

#[derive(Debug, Clone, Copy)]
struct Fit {
    values: [f64; TERMS],
    errors: [f64; TERMS],
    chi2: f64,
}

fn fit(levels: &[CellLevel], full: usize, wing: Option<Wing>) -> Option<Fit> {
    let count = if wing.is_some() { TERMS } else { PLANE_TERMS };
    let basis = |[x, y]: [f64; 2]| {
        let r = x.hypot(y);
        let [f, slope] = wing.map_or([0.0; 2], |wing| wing.at(r / (WING_RADIUS * full as f64)));
        [1.0, x, y, f, slope * x / (r * r), slope * y / (r * r)]
    };
    let mut sums = NormalEquations::<TERMS>::default();
    for cell in levels {
        sums.add(basis(cell.place), cell.level, cell.weight);
    }
    let values = sums.solve(count)?;
    let squares = levels.iter().map(|cell| {
        let terms = basis(cell.place);
        let model: f64 = terms.iter().zip(&values).map(|(b, v)| b * v).sum();
        cell.weight * (cell.level - model).powi(2)
    });
    let chi2 = squares.sum();
    let mut errors = [0.0; TERMS];
    for (k, error) in errors.iter_mut().take(count).enumerate() {
        *error = sums.variance(k, count)?.sqrt();
    }
    Some(Fit {
        values,
        errors,
        chi2,
    })
}

/// Normal equations of a fit of N parameters.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormalEquations<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
}

impl<const N: usize> Default for NormalEquations<N> {
    fn default() -> Self {
        NormalEquations {
            matrix: [[0.0; N]; N],
            right: [0.0; N],
        }
    }
}

impl<const N: usize> NormalEquations<N> {
    pub(crate) fn add(&mut self, basis: [f64; N], value: f64, weight: f64) {
        for (i, row) in self.matrix.iter_mut().enumerate() {
            for (sum, b) in row.iter_mut().zip(&basis) {
                *sum += weight * basis[i] * b;
            }
            self.right[i] += weight * basis[i] * value;
        }
    }

    /// The first `count` parameters, the others being zero.
    pub(crate) fn solve(&self, count: usize) -> Option<[f64; N]> {
        self.solve_for(self.right, count)
    }

    /// The variance of parameter `k` of the first `count`.
    fn variance(&self, k: usize, count: usize) -> Option<f64> {
        let mut unit = [0.0; N];
        unit[k] = 1.0;
        Some(self.solve_for(unit, count)?[k])
    }

    fn solve_for(&self, right: [f64; N], count: usize) -> Option<[f64; N]> {
        // Relative to the diagonal: far above rounding, below the 10⁻⁴ of similar wings.
        const MIN_PIVOT: f64 = 1e-10;
        // With a diagonal of one, so that one least pivot fits pixels and squared pixels.
        let scale: [f64; N] = std::array::from_fn(|k| 1.0 / self.matrix[k][k].sqrt());
        let mut matrix = [[0.0; N]; N];
        let mut out = [0.0; N];
        for i in 0..count {
            for j in 0..=i {
                matrix[i][j] = self.matrix[i][j] * scale[i] * scale[j];
            }
            out[i] = right[i] * scale[i];
        }
        // NaN is not larger.
        let large = |pivot: f64| (pivot > MIN_PIVOT).then_some(pivot);
        cholesky(&mut matrix, &mut out, count, large)?;
        for (value, scale) in out.iter_mut().zip(scale).take(count) {
            *value *= scale;
        }
        Some(out)
    }
}

/// Square cells of a stamp away from its centre, and their levels on one stamp.
#[derive(Debug, Clone)]
pub(crate) struct SkyCells {
    pub(crate) full: usize,
    side: usize,
    cells: Vec<Cell>,
    /// On the stamp measured last; NaN if a pixel is missing or padding.
    pub(crate) levels: Vec<f32>,
    residuals: Vec<f64>,
    kept: Vec<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Cell {
    first: (usize, usize),
    /// Middle (x, y), from the centre of the stamp.
    place: [f64; 2],
    is_at_edge: bool,
}

impl SkyCells {
    pub(crate) fn new(full: usize) -> Self {
        let side = (full / CELLS_PER_SIDE).max(1);
        let count = full / side;
        // From the edges inwards, so that opposite cells are opposite pixels.
        let start = |at: usize| match 2 * at < count {
            true => at * side,
            false => full - (count - at) * side,
        };
        let middle = |at: usize| start(at) as f64 + (side as f64 - full as f64) / 2.0;
        let all = (0..count).flat_map(|y| (0..count).map(move |x| (y, x)));
        let cells: Vec<Cell> = all
            .map(|(y, x)| Cell {
                first: (start(y), start(x)),
                place: [middle(x), middle(y)],
                is_at_edge: [y, x].iter().any(|at| *at == 0 || at + 1 == count),
            })
            .filter(|cell| cell.place[0].hypot(cell.place[1]) >= MIN_CELL_DISTANCE * full as f64)
            .collect();
        SkyCells {
            full,
            side,
            levels: vec![0.0; cells.len()],
            residuals: Vec::with_capacity(cells.len()),
            kept: Vec::with_capacity(cells.len()),
            cells,
        }
    }

    /// The middle of each cell (x, y), from the centre of the stamp.
    pub(crate) fn places(&self) -> impl Iterator<Item = [f64; 2]> {
        self.cells.iter().map(|cell| cell.place)
    }

    pub(crate) fn measure(&mut self, pixels: &[f32]) {
        let (n, side) = (self.full, self.side);
        let [low, high, left, right] = padding(pixels, n);
        for (level, cell) in self.levels.iter_mut().zip(&self.cells) {
            let (y, x) = cell.first;
            let is_padded = y < low || x < left || y + side > n - high || x + side > n - right;
            let mut sum = if is_padded { f32::NAN } else { 0.0 };
            for row in pixels[y * n..(y + side) * n].chunks_exact(n) {
                sum += row[x..x + side].iter().sum::<f32>();
            }
            *level = if sum.is_finite() {
                sum / (side * side) as f32
            } else {
                f32::NAN
            };
        }
    }

    /// The plane of one stamp, fitted to the cells at its edges without outliers; `None` if too few remain.
    pub(crate) fn plane_of(&mut self, pixels: &[f32]) -> Option<Sky> {
        self.measure(pixels);
        let SkyCells {
            cells,
            levels,
            residuals,
            kept,
            ..
        } = self;
        kept.clear();
        kept.extend((0..cells.len()).filter(|&k| cells[k].is_at_edge && !levels[k].is_nan()));
        let residual = |[level, x_slope, y_slope]: [f64; PLANE_TERMS], k: usize| {
            let [x, y] = cells[k].place;
            f64::from(levels[k]) - level - x_slope * x - y_slope * y
        };
        let mut plane = [0.0; PLANE_TERMS];
        for round in 0..3 {
            if round == 0 {
                // The median first: outliers would tilt a plane, and hide behind it.
                residuals.clear();
                residuals.extend(kept.iter().map(|&k| residual(plane, k)));
                plane[0] = median(residuals)?;
            } else {
                let mut sums = NormalEquations::<PLANE_TERMS>::default();
                for &k in &*kept {
                    let [x, y] = cells[k].place;
                    sums.add([1.0, x, y], f64::from(levels[k]), 1.0);
                }
                plane = sums.solve(PLANE_TERMS)?;
            }
            residuals.clear();
            residuals.extend(kept.iter().map(|&k| residual(plane, k).abs()));
            let limit = OUTLIER_SCATTERS * FROM_MODULI * median(residuals)?;
            kept.retain(|&k| residual(plane, k).abs() <= limit);
        }
        Some(Sky {
            level: plane[0],
            level_error: f64::NAN,
            slope: [plane[1], plane[2]],
            slope_error: f64::NAN,
        })
    }
}

pub(crate) fn inner_light(pixels: &[f32], n: usize) -> f64 {
    let middle = (n as f64 - 1.0) / 2.0;
    let mut sum = 0.0;
    for (y, row) in pixels.chunks_exact(n).enumerate() {
        let dy = y as f64 - middle;
        let square = INNER_RADIUS * INNER_RADIUS - dy * dy;
        if square < 0.0 {
            continue;
        }
        let half = square.sqrt();
        let first = (middle - half).ceil().max(0.0) as usize;
        let last = ((middle + half).floor() as usize).min(n - 1);
        sum += row[first..=last].iter().map(|v| f64::from(*v)).sum::<f64>();
    }
    sum
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use shearq_submissions::SkySource;

    use super::*;
    use crate::noise::{NoisePlan, Survey};
    use crate::stamp::{FullStamp, SkySubtraction};

    const N: usize = 48;
    const COUNT: usize = 400;

    /// A profile of flux one on a stamp, (x, y) off its middle.
    fn profile(of: impl Fn(f64) -> f64, [x0, y0]: [f64; 2]) -> Array2<f64> {
        let stamp = Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5 - x0, y as f64 - 23.5 - y0);
            of(x.hypot(y))
        });
        &stamp / stamp.sum()
    }

    /// An exponential of scale 2.5 px.
    fn small(place: [f64; 2]) -> Array2<f64> {
        profile(|r| (-r / 2.5).exp(), place)
    }

    /// What a survey finds on stamps of unit noise with galaxies of this flux, on this plane, after `spoil`.
    fn survey(
        galaxy: impl Fn(&mut ChaCha8Rng) -> Array2<f64>,
        flux: f64,
        plane: [f64; 3],
        mut spoil: impl FnMut(usize, &mut Array2<f32>, &mut ChaCha8Rng),
    ) -> Survey {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let stamps: Vec<Array2<f32>> = (0..COUNT)
            .map(|k| {
                let galaxy = galaxy(&mut rng);
                let half = 3f64.sqrt();
                let mut stamp = Array2::from_shape_fn((N, N), |(y, x)| {
                    let sky =
                        plane[0] + plane[1] * (x as f64 - 23.5) + plane[2] * (y as f64 - 23.5);
                    (flux * galaxy[(y, x)] + sky + rng.random_range(-half..half)) as f32
                });
                spoil(k, &mut stamp, &mut rng);
                stamp
            })
            .collect();
        let plan = NoisePlan::new(N, 1, Some(SkySource::Image)).unwrap();
        let survey_all = |mut survey: crate::noise::NoiseSurvey| {
            stamps
                .iter()
                .for_each(|stamp| survey.add(stamp.view()).unwrap());
            survey
        };
        let first = survey_all(plan.survey());
        first
            .without_sky()
            .map_or(first, survey_all)
            .result()
            .unwrap()
            .unwrap()
    }

    /// Somewhere within half a pixel of the middle.
    fn anywhere(rng: &mut ChaCha8Rng) -> [f64; 2] {
        [(); 2].map(|()| rng.random_range(-0.5..0.5))
    }

    fn assert_plane(found: Option<Sky>, plane: [f64; 3]) {
        let sky = found.unwrap();
        // 400 stamps of 1,856 px away from the galaxy, by medians and with a wing: 0.003 and 0.0002 at most.
        assert!(sky.level_error < 4e-3 && sky.slope_error < 3e-4, "{sky:?}");
        let near = |found: f64, expected: f64, error: f64| (found - expected).abs() < 4.0 * error;
        assert!(
            near(sky.level, plane[0], sky.level_error),
            "{sky:?} {plane:?}"
        );
        for (found, expected) in sky.slope.iter().zip(&plane[1..]) {
            assert!(
                near(*found, *expected, sky.slope_error),
                "{sky:?} {plane:?}"
            );
        }
    }

    #[test]
    fn the_plane_of_an_image_has_its_sign_and_axes() {
        let galaxy = |rng: &mut ChaCha8Rng| small(anywhere(rng));
        for plane in [
            [0.5, 0.0, 0.0],
            [-0.5, 0.0, 0.0],
            [10.0, 0.02, 0.0],
            [0.3, 0.01, -0.03],
        ] {
            let found = survey(galaxy, 300.0, plane, |_, _, _| {});
            assert_plane(found.sky, plane);
        }
        // A level that is too small to matter is not subtracted with a gradient.
        let sky = survey(galaxy, 300.0, [0.0, 0.0, 0.02], |_, _, _| {}).sky;
        assert!(sky.is_some_and(|sky| sky.level == 0.0), "{sky:?}");
        assert_plane(sky, [0.0, 0.0, 0.02]);
        assert_eq!(survey(galaxy, 300.0, [0.0; 3], |_, _, _| {}).sky, None);
    }

    #[test]
    fn galaxies_keep_their_size_on_a_sky() {
        let galaxy = |rng: &mut ChaCha8Rng| small(anywhere(rng));
        let dark = survey(galaxy, 300.0, [0.0; 3], |_, _, _| {})
            .mean_square_radius
            .unwrap();
        for plane in [[3.0, 0.0, 0.0], [10.0, 0.05, -0.05]] {
            let found = survey(galaxy, 300.0, plane, |_, _, _| {})
                .mean_square_radius
                .unwrap();
            // The error of the plane is a hundredth of the light.
            assert!((found / dark - 1.0).abs() < 0.01, "{found} {dark}");
        }
    }

    #[test]
    fn wings_are_no_sky() {
        /// A profile of a galaxy, or of what a PSF adds to it.
        type Profile = fn(f64) -> f64;
        let profiles: [(&str, Profile); 4] = [
            // Half-light radii of 8 px; blurred by 1.5 px in the middle.
            ("exponential", |r| (-1.678 * r.hypot(1.5) / 8.0).exp()),
            ("de Vaucouleurs", |r| {
                (-7.669 * (r.hypot(1.5) / 8.0).powf(0.25)).exp()
            }),
            ("Moffat of β = 2", |r| (1.0 + (r / 3.0).powi(2)).powi(-2)),
            ("aureole", |r| {
                (-r / 3.0).exp() + 5e-3 / (1.0 + (r / 4.0).powi(2))
            }),
        ];
        for (name, of) in profiles {
            for flux in [300.0, 3000.0] {
                let galaxy = |rng: &mut ChaCha8Rng| profile(of, anywhere(rng));
                let found = survey(galaxy, flux, [0.0; 3], |_, _, _| {});
                assert_eq!(found.sky, None, "{name} {flux}");
                // Off the middle they have no gradient either.
                let galaxy = |_: &mut ChaCha8Rng| profile(of, [0.8, -0.6]);
                let found = survey(galaxy, flux, [0.0; 3], |_, _, _| {});
                assert_eq!(found.sky, None, "{name} {flux}, off the middle");
            }
            let galaxy = |rng: &mut ChaCha8Rng| profile(of, anywhere(rng));
            let sky = survey(galaxy, 300.0, [0.5, 0.0, 0.0], |_, _, _| {}).sky;
            // The wing takes up to a twentieth.
            assert!(
                sky.is_some_and(|sky| (sky.level - 0.5).abs() < 0.05),
                "{name} {sky:?}"
            );
        }
    }

    #[test]
    fn neighbours_missing_pixels_and_padding_are_no_sky() {
        let galaxy = |rng: &mut ChaCha8Rng| small(anywhere(rng));
        let spoil = |k: usize, stamp: &mut Array2<f32>, rng: &mut ChaCha8Rng| {
            if k.is_multiple_of(3) {
                let angle = rng.random_range(0.0..std::f64::consts::TAU);
                let r = rng.random_range(14.0..24.0);
                let other = small([r * angle.cos(), r * angle.sin()]);
                stamp.zip_mut_with(&other, |to, light| *to += 600.0 * *light as f32);
            }
            for value in stamp
                .iter_mut()
                .filter(|_| rng.random_range(0.0..1.0) < 0.01)
            {
                *value = f32::NAN;
            }
            if k.is_multiple_of(5) {
                stamp.slice_mut(ndarray::s![.., 43..]).fill(0.0);
            }
        };
        for plane in [[0.5, 0.0, 0.0], [-0.5, 0.01, 0.0], [0.0; 3]] {
            let sky = survey(galaxy, 300.0, plane, spoil).sky;
            let Some(sky) = sky else {
                assert_eq!(plane, [0.0; 3]);
                continue;
            };
            assert!(plane != [0.0; 3], "{sky:?}");
            // A twelfth of a cell's stamps have the neighbour near, whose wings are below the noise.
            assert!((sky.level - plane[0]).abs() < 0.02, "{sky:?}");
            assert!((sky.slope[0] - plane[1]).abs() < 1e-3, "{sky:?}");
        }
    }

    #[test]
    fn wings_within_three_errors_bound_the_level() {
        let (cells, wing) = (SkyCells::new(N), Wing { p: 4.0, q: 0.0 });
        let of = |weight: f64| -> Vec<CellLevel> {
            let levels = cells.places().map(|place| {
                let [light, _] = wing.at(place[0].hypot(place[1]) / (WING_RADIUS * N as f64));
                CellLevel {
                    place,
                    level: 5.0 + light,
                    weight,
                }
            });
            levels.collect()
        };
        let shapes = WING_STEEPENINGS.map(|q| WING_SLOPES.map(|p| Wing { p, q }));
        let fits = shapes.as_flattened().iter();
        let fits = fits.filter_map(|wing| fit(&of(1.0), N, Some(*wing)));
        let positive = fits.filter(|fit| fit.values[PLANE_TERMS] > 0.0);
        let lowest = positive.min_by(|a, b| a.values[0].total_cmp(&b.values[0]));
        let lowest = lowest.unwrap();
        for (chi2, is_allowed) in [(7.0, true), (12.0, false)] {
            let found = BoundedPlane::fit(&of(chi2 / lowest.chi2), N).unwrap();
            let is_bound = (found.least[0] - lowest.values[0]).abs() < 1e-9;
            assert_eq!(is_bound, is_allowed, "{chi2}: {found:?} {lowest:?}");
        }
    }

    #[test]
    fn skies_are_subtracted_from_five_errors_and_one_percent_on() {
        let (cells, count) = (SkyCells::new(N), 80);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let places: Vec<[f64; 2]> = cells.places().collect();
        let noise: Vec<f64> = (0..count * places.len())
            .map(|_| rng.random_range(-0.5..0.5))
            .collect();
        let levels = |level: f64, slope: f64| -> Vec<f32> {
            let places = places.iter().cycle();
            let pixels = noise.iter().zip(places);
            pixels
                .map(|(noise, [x, _])| (noise + level + slope * x) as f32)
                .collect()
        };
        let sky = |level: f64, slope: f64, flux: f64| {
            let survey = SkyLevels {
                levels: levels(level, slope),
                fluxes: vec![flux; count],
            };
            survey.sky(&cells, |_, _| false)
        };
        // The least level with any allowed wing, as far as it is from the level without noise, and the error of the level.
        let error = sky(100.0, 0.0, 0.0).unwrap().level_error;
        let each = places.iter().enumerate().filter_map(|(at, place)| {
            let own = levels(0.0, 0.0);
            let mut own: Vec<f64> = own
                .iter()
                .skip(at)
                .step_by(places.len())
                .map(|v| f64::from(*v))
                .collect();
            CellLevel::of(&mut own, *place)
        });
        let each: Vec<CellLevel> = each
            .map(|cell| CellLevel {
                level: cell.level + 100.0,
                ..cell
            })
            .collect();
        let least = BoundedPlane::fit(&each, N).unwrap().least[0] - 100.0;
        for (errors, expected) in [(4.0, false), (6.0, true)] {
            let found = sky(errors * error - least, 0.0, 0.0);
            assert_eq!(found.is_some(), expected, "{errors}: {found:?}");
        }
        // A gradient, by its light over 8 px in units of the galaxy's.
        for (share, expected) in [(0.007, false), (0.014, true)] {
            let found = sky(0.0, 0.1, 0.1 * INNER_RADIUS * INNER_AREA / share);
            assert_eq!(found.is_some(), expected, "{share}: {found:?}");
        }
    }

    #[test]
    fn each_stamp_loses_its_own_plane() {
        let mut full = FullStamp::new(N);
        full.subtraction = SkySubtraction::EachStamp;
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut mean = [0.0; 3];
        let count = 100;
        for _ in 0..count {
            let mut stamp = Array2::from_shape_fn((N, N), |(y, x)| {
                let (x, y) = (x as f32 - 23.5, y as f32 - 23.5);
                let half = 3f32.sqrt();
                2.0 + 0.03 * x - 0.01 * y + rng.random_range(-half..half)
            });
            // A neighbour on the border, and a missing pixel.
            stamp.slice_mut(ndarray::s![20..28, ..6]).fill(30.0);
            stamp[(2, 4)] = f32::NAN;
            full.read(stamp.view()).unwrap();
            let sky = full.cells.plane_of(&full.pixels).unwrap();
            let found = [sky.level, sky.slope[0], sky.slope[1]];
            mean = [0, 1, 2].map(|k| mean[k] + found[k] / f64::from(count));
            full.subtract_sky();
            let again = full.cells.plane_of(&full.pixels).unwrap();
            // Other cells may be beyond 3σ the second time: a cell with a mean of 0.75σ moves the level of 44 cells by
            // 0.02 and the slope by 10⁻³. Four of them.
            assert!(
                again.level.abs() < 0.08 && again.slope[0].abs() < 4e-3,
                "{again:?}"
            );
        }
        // 44 cells of 16 px: 0.04 and 0.002 per stamp.
        for ((found, expected), error) in
            mean.iter().zip([2.0, 0.03, -0.01]).zip([0.004, 2e-4, 2e-4])
        {
            assert!((found - expected).abs() < 4.0 * error, "{mean:?}");
        }
    }

    #[test]
    fn normal_equations_of_few_terms_are_least_squares() {
        let mut sums = NormalEquations::<3>::default();
        for k in 0..10 {
            let x = f64::from(k);
            sums.add([1.0, x, x * x], 2.0 - 0.5 * x, 1.0 + x);
        }
        let found = sums.solve(2).unwrap();
        for (found, expected) in found.iter().zip([2.0, -0.5, 0.0]) {
            assert!((found - expected).abs() < 1e-12, "{found}");
        }
        // Σ w x² / (Σ w Σ w x² − (Σ w x)²) with w = 1 + x.
        let variance = sums.variance(0, 2).unwrap();
        assert!((variance - 2310.0 / (55.0 * 2310.0 - 330.0 * 330.0)).abs() < 1e-12);
    }
}

//! The sky of an image: one plane under all of its stamps, or one plane per stamp.
//!
//! The plane of an image follows from the medians over stamps of small cells away from the galaxies. The wings of the
//! galaxies are in these cells as well. Therefore the plane is fitted together with a wing that falls with the distance
//! r from the middle of the stamp as f(r) = exp(−p ((r/r₀)^q − 1)/q), and with the wing's change with the position of the
//! galaxy. Powers of r have q = 0, exponentials q = 1 and Gaussians q = 2. All p and q that the profile allows bound the
//! level; only what is beyond that bound is sky.

use shearq_quantities::linear::cholesky;
use shearq_quantities::statistics::{FROM_MODULI, OF_MEDIAN, median, scatter};
use shearq_submissions::SkySource;

use crate::pixel;

/// Radius within which a galaxy's light is summed. See docs/constants.md.
pub(crate) const INNER: f64 = 8.0;
/// Cells along a side of a stamp. See docs/constants.md.
const CELLS: usize = 12;
/// Least distance of a cell from the middle, in units of the stamp's side. See docs/constants.md.
const LEAST_DISTANCE: f64 = 0.25;
/// Distance r₀ at which p is the slope of the wing, in units of the stamp's side. See docs/constants.md.
const REFERENCE: f64 = 0.4;
/// Slopes p of wings. See docs/constants.md.
const SLOPES: [f64; 14] = [
    2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0, 14.0,
];
/// Steepenings q of wings. See docs/constants.md.
const STEEPENINGS: [f64; 4] = [0.0, 0.5, 1.0, 2.0];
/// Excess of χ² over the least one, per unit of its scatter, up to which a wing is allowed. See
/// docs/constants.md.
const ALLOWED: f64 = 9.0;
/// Groups of stamps whose scatter is the error of the plane. See docs/constants.md.
const GROUPS: usize = 8;
/// Fewest stamps in a cell of a group. See docs/constants.md.
const FEWEST: usize = 2;
/// Significance that a plane requires to be subtracted. See docs/constants.md.
const CLEAR: f64 = 5.0;
/// Light of the sky within 8 px, in units of the galaxy's, above which it is subtracted. See
/// docs/constants.md.
const LEVEL_SHARE: f64 = 0.03;
/// Change of this share over 8 px above which the gradient is subtracted. See docs/constants.md.
const SLOPE_SHARE: f64 = 0.01;
/// Residual in units of the scatter beyond which a cell of a stamp does not count. See docs/constants.md.
const CLIP: f64 = 3.0;

/// Numbers that a profile is fitted by: the plane, the wing, and its change with the galaxy's position.
const PLANE: usize = 3;
const ALL: usize = 6;

/// A plane under the stamps of an image, in image units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sky {
    /// Level in the middle of the stamps; zero if it is not significant, or too small to matter.
    pub level: f64,
    /// Standard error of the level.
    pub level_error: f64,
    /// Change per pixel along x and y; zero if it is not significant, or too small to matter.
    pub slope: [f64; 2],
    /// Standard error of either.
    pub slope_error: f64,
}

impl Sky {
    /// The plane at (x, y), in pixels from the middle of the stamp.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        self.level + self.slope[0] * x + self.slope[1] * y
    }

    /// Subtracts the plane from a stamp of `n` pixels a side.
    fn subtract(&self, pixels: &mut [f32], n: usize) {
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

/// What is subtracted from stamps before they are looked at.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Subtraction {
    /// Nothing.
    #[default]
    Nothing,
    /// The plane of the image.
    Plane(Sky),
    /// The plane of each stamp, measured on its border.
    EachStamp,
}

impl Subtraction {
    /// What a configuration with this key subtracts if `sky` was found.
    pub(crate) fn of(source: Option<SkySource>, sky: Option<Sky>) -> Self {
        match (source, sky) {
            (Some(SkySource::Stamp), _) => Subtraction::EachStamp,
            (Some(SkySource::Image), Some(sky)) => Subtraction::Plane(sky),
            (Some(SkySource::Image | SkySource::None) | None, _) => Subtraction::Nothing,
        }
    }

    /// Subtracts from a stamp. Missing pixels stay missing.
    pub(crate) fn apply(&self, pixels: &mut [f32], cells: &mut Cells) {
        match self {
            Subtraction::Nothing => {}
            Subtraction::Plane(sky) => sky.subtract(pixels, cells.full),
            Subtraction::EachStamp => {
                if let Some(sky) = cells.plane_of(pixels) {
                    sky.subtract(pixels, cells.full);
                }
            }
        }
    }
}

/// Square cells of a stamp away from its middle, and their levels on one stamp.
#[derive(Debug, Clone)]
pub(crate) struct Cells {
    full: usize,
    side: usize,
    cells: Vec<Cell>,
    /// Levels on the stamp looked at last; NaN if a pixel is missing or padding.
    pub(crate) levels: Vec<f32>,
    /// Levels of some of them, to be sorted.
    sorted: Vec<f64>,
    kept: Vec<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Cell {
    /// Its first pixel (y, x).
    first: (usize, usize),
    /// Its middle (x, y), from the middle of the stamp.
    place: [f64; 2],
    /// Whether it is at an edge of the stamp.
    outer: bool,
}

impl Cells {
    /// For stamps of `full` pixels a side.
    pub(crate) fn new(full: usize) -> Self {
        let side = (full / CELLS).max(1);
        let count = full / side;
        // From the edges inwards.
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
                outer: [y, x].iter().any(|at| *at == 0 || at + 1 == count),
            })
            .filter(|cell| cell.place[0].hypot(cell.place[1]) >= LEAST_DISTANCE * full as f64)
            .collect();
        Cells {
            full,
            side,
            levels: vec![0.0; cells.len()],
            sorted: Vec::with_capacity(cells.len()),
            kept: Vec::with_capacity(cells.len()),
            cells,
        }
    }

    /// Number of cells.
    pub(crate) fn len(&self) -> usize {
        self.cells.len()
    }

    /// The middle of each cell (x, y), from the middle of the stamp.
    pub(crate) fn places(&self) -> impl Iterator<Item = [f64; 2]> {
        self.cells.iter().map(|cell| cell.place)
    }

    /// Measures the levels of the cells of a stamp.
    pub(crate) fn look(&mut self, pixels: &[f32]) {
        let (n, side) = (self.full, self.side);
        let [low, high, left, right] = pixel::padding(pixels, n);
        for (level, cell) in self.levels.iter_mut().zip(&self.cells) {
            let (y, x) = cell.first;
            let padded = y < low || x < left || y + side > n - high || x + side > n - right;
            let mut sum = if padded { f32::NAN } else { 0.0 };
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

    /// The plane of one stamp, fitted to the cells at its edges without those that are much brighter or darker than the
    /// others; `None` if too few are left.
    fn plane_of(&mut self, pixels: &[f32]) -> Option<Sky> {
        self.look(pixels);
        self.kept.clear();
        let good = |&at: &usize| self.cells[at].outer && !self.levels[at].is_nan();
        self.kept.extend((0..self.cells.len()).filter(good));
        let mut plane = [0.0; PLANE];
        for round in 0..3 {
            let at = |plane: &[f64; PLANE], at: usize| {
                let [x, y] = self.cells[at].place;
                f64::from(self.levels[at]) - plane[0] - plane[1] * x - plane[2] * y
            };
            if round == 0 {
                self.sorted.clear();
                self.sorted.extend(self.kept.iter().map(|&k| at(&plane, k)));
                plane[0] = median(&mut self.sorted)?;
            } else {
                let mut sums = Normal::<PLANE>::default();
                for &k in &self.kept {
                    let [x, y] = self.cells[k].place;
                    sums.add([1.0, x, y], f64::from(self.levels[k]), 1.0);
                }
                plane = sums.solve(PLANE)?;
            }
            self.sorted.clear();
            self.sorted
                .extend(self.kept.iter().map(|&k| at(&plane, k).abs()));
            let most = CLIP * FROM_MODULI * median(&mut self.sorted)?;
            let (levels, cells) = (&self.levels, &self.cells);
            self.kept.retain(|&k| {
                let [x, y] = cells[k].place;
                (f64::from(levels[k]) - plane[0] - plane[1] * x - plane[2] * y).abs() <= most
            });
        }
        Some(Sky {
            level: plane[0],
            level_error: f64::NAN,
            slope: [plane[1], plane[2]],
            slope_error: f64::NAN,
        })
    }
}

/// Pixels within `INNER` of the middle.
pub(crate) fn disc() -> f64 {
    std::f64::consts::PI * INNER * INNER
}

/// Light within `INNER` of the middle.
pub(crate) fn inner(pixels: &[f32], n: usize) -> f64 {
    let middle = (n as f64 - 1.0) / 2.0;
    let mut sum = 0.0;
    for (y, row) in pixels.chunks_exact(n).enumerate() {
        let dy = y as f64 - middle;
        let half = (INNER * INNER - dy * dy).max(-1.0).sqrt();
        if half.is_nan() {
            continue;
        }
        let first = (middle - half).ceil().max(0.0) as usize;
        let last = ((middle + half).floor() as usize).min(n - 1);
        sum += row[first..=last].iter().map(|v| f64::from(*v)).sum::<f64>();
    }
    sum
}

/// Levels of the cells of many stamps.
#[derive(Debug, Clone, Default)]
pub(crate) struct Levels {
    /// Stamp by stamp.
    levels: Vec<f32>,
    /// Light within 8 px of each stamp.
    fluxes: Vec<f64>,
}

impl Levels {
    pub(crate) fn add(&mut self, cells: &Cells, flux: f64) {
        self.levels.extend_from_slice(&cells.levels);
        self.fluxes.push(flux);
    }

    pub(crate) fn join(&mut self, other: &Self) {
        self.levels.extend_from_slice(&other.levels);
        self.fluxes.extend_from_slice(&other.fluxes);
    }

    /// The plane under the stamps, if it is significant and matters. `lost` is true of cells of a stamp, counted from 0,
    /// that another galaxy is near.
    pub(crate) fn sky(&self, cells: &Cells, lost: impl Fn(usize, usize) -> bool) -> Option<Sky> {
        let count = cells.len();
        let of = |group: Option<usize>| -> Vec<Datum> {
            let mut values = Vec::new();
            let places = cells.places().enumerate();
            places
                .filter_map(|(at, place)| {
                    values.clear();
                    let stamps = self.levels.chunks_exact(count).enumerate();
                    let own = stamps.filter(|(k, _)| group.is_none_or(|group| k % GROUPS == group));
                    let good = own.filter(|(k, levels)| !levels[at].is_nan() && !lost(*k, at));
                    values.extend(good.map(|(_, levels)| f64::from(levels[at])));
                    Datum::of(&mut values, place)
                })
                .collect()
        };
        let all = of(None);
        let best = Bounded::of(&all, cells.full)?;
        let groups = (0..GROUPS).map(|group| best.refit(&of(Some(group)), cells.full));
        let groups: Vec<[f64; PLANE]> = groups.collect::<Option<_>>()?;
        // Of the mean of groups, about as of the whole.
        let error = |k: usize| {
            let mean = groups.iter().map(|plane| plane[k]).sum::<f64>() / GROUPS as f64;
            let square = groups.iter().map(|plane| (plane[k] - mean).powi(2));
            let freedom = GROUPS * (GROUPS - 1);
            (square.sum::<f64>() / freedom as f64)
                .sqrt()
                .max(best.errors[k])
        };
        let errors = [error(0), error(1).max(error(2))];
        let [level, slope @ ..] = best.plane;
        let mut fluxes: Vec<f64> = self.fluxes.iter().map(|f| f - level * disc()).collect();
        let flux = median(&mut fluxes)?.abs();
        let steep = slope[0].hypot(slope[1]);
        let is_level =
            best.least[0] > CLEAR * errors[0] && level.abs() * disc() > LEVEL_SHARE * flux;
        let is_steep =
            best.least[1] > CLEAR * errors[1] && steep * INNER * disc() > SLOPE_SHARE * flux;
        (is_level || is_steep).then_some(Sky {
            level: if is_level { level } else { 0.0 },
            level_error: errors[0],
            slope: if is_steep { slope } else { [0.0; 2] },
            slope_error: errors[1],
        })
    }
}

/// The level of a cell over stamps.
#[derive(Debug, Clone, Copy)]
struct Datum {
    place: [f64; 2],
    level: f64,
    /// One over its variance.
    weight: f64,
}

impl Datum {
    /// `None` of a few stamps, or stamps without noise.
    fn of(values: &mut [f64], place: [f64; 2]) -> Option<Datum> {
        if values.len() < FEWEST {
            return None;
        }
        let (level, scatter) = scatter(values)?;
        let weight = values.len() as f64 / (OF_MEDIAN * scatter).powi(2);
        weight.is_finite().then_some(Datum {
            place,
            level,
            weight,
        })
    }
}

/// The plane under a profile, with what wings allow of its level.
#[derive(Debug, Clone, Copy)]
struct Bounded {
    plane: [f64; PLANE],
    errors: [f64; PLANE],
    wing: Option<Wing>,
    /// The least modulus of the level with any wing that the profile allows, zero if both signs are allowed; and that of
    /// the gradient.
    least: [f64; 2],
}

/// A wing of slope p and steepening q.
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

impl Bounded {
    fn of(data: &[Datum], full: usize) -> Option<Bounded> {
        let mut fits = vec![(fit(data, full, None)?, None)];
        for q in STEEPENINGS {
            for p in SLOPES {
                let wing = Some(Wing { p, q });
                // A wing is light.
                if let Some(found) = fit(data, full, wing).filter(|fit| fit.values[PLANE] > 0.0) {
                    fits.push((found, wing));
                }
            }
        }
        let by_square = |a: &&(Fit, _), b: &&(Fit, _)| a.0.square.total_cmp(&b.0.square);
        let (best, wing) = *fits.iter().min_by(by_square)?;
        let freedom = (data.len().checked_sub(ALL + 2)?).max(1) as f64;
        let most = best.square + ALLOWED * (best.square / freedom).max(1.0);
        let allowed = || fits.iter().filter(|(fit, _)| fit.square <= most);
        let along = |to: [f64; PLANE]| {
            let along = allowed().map(|(fit, _)| (0..PLANE).map(|k| fit.values[k] * to[k]).sum());
            along.fold(f64::INFINITY, f64::min).max(0.0)
        };
        let [_, x, y, ..] = best.values;
        let steep = x.hypot(y).max(f64::MIN_POSITIVE);
        // What no wing explains is part of the errors.
        let misfit = (best.square / freedom).max(1.0).sqrt();
        Some(Bounded {
            plane: [0, 1, 2].map(|k| best.values[k]),
            errors: [0, 1, 2].map(|k| misfit * best.errors[k]),
            wing,
            least: [
                along([best.values[0].signum(), 0.0, 0.0]),
                along([0.0, x / steep, y / steep]),
            ],
        })
    }

    /// The plane of other data with the same wing.
    fn refit(&self, data: &[Datum], full: usize) -> Option<[f64; PLANE]> {
        let found = fit(data, full, self.wing)?;
        Some([0, 1, 2].map(|k| found.values[k]))
    }
}

#[derive(Debug, Clone, Copy)]
struct Fit {
    values: [f64; ALL],
    errors: [f64; ALL],
    square: f64,
}

/// The plane and the wing that fit best.
fn fit(data: &[Datum], full: usize, wing: Option<Wing>) -> Option<Fit> {
    let count = if wing.is_some() { ALL } else { PLANE };
    let basis = |[x, y]: [f64; 2]| {
        let r = x.hypot(y);
        let [f, slope] = wing.map_or([0.0; 2], |wing| wing.at(r / (REFERENCE * full as f64)));
        [1.0, x, y, f, slope * x / (r * r), slope * y / (r * r)]
    };
    let mut sums = Normal::<ALL>::default();
    for datum in data {
        sums.add(basis(datum.place), datum.level, datum.weight);
    }
    let values = sums.solve(count)?;
    let square = data.iter().map(|datum| {
        let model: f64 = basis(datum.place)
            .iter()
            .zip(&values)
            .map(|(b, v)| b * v)
            .sum();
        datum.weight * (datum.level - model).powi(2)
    });
    let square = square.sum();
    let mut errors = [0.0; ALL];
    for (k, error) in errors.iter_mut().take(count).enumerate() {
        *error = sums.variance(k, count)?.sqrt();
    }
    Some(Fit {
        values,
        errors,
        square,
    })
}

/// Normal equations of a fit by N numbers.
#[derive(Debug, Clone, Copy)]
struct Normal<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
}

impl<const N: usize> Default for Normal<N> {
    fn default() -> Self {
        Normal {
            matrix: [[0.0; N]; N],
            right: [0.0; N],
        }
    }
}

impl<const N: usize> Normal<N> {
    fn add(&mut self, basis: [f64; N], value: f64, weight: f64) {
        for (i, row) in self.matrix.iter_mut().enumerate() {
            for (sum, b) in row.iter_mut().zip(&basis) {
                *sum += weight * basis[i] * b;
            }
            self.right[i] += weight * basis[i] * value;
        }
    }

    /// The first `count` numbers, the others being zero.
    fn solve(&self, count: usize) -> Option<[f64; N]> {
        self.solved(self.right, count)
    }

    /// The variance of number `k` of the first `count`.
    fn variance(&self, k: usize, count: usize) -> Option<f64> {
        let mut one = [0.0; N];
        one[k] = 1.0;
        Some(self.solved(one, count)?[k])
    }

    /// By Cholesky's decomposition of the matrix with a diagonal of one.
    fn solved(&self, right: [f64; N], count: usize) -> Option<[f64; N]> {
        /// Least pivot, relative to the diagonal. See docs/constants.md.
        const LEAST_PIVOT: f64 = 1e-10;
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
        let large = |pivot: f64| (pivot > LEAST_PIVOT).then_some(pivot);
        cholesky(&mut matrix, &mut out, count, large)?;
        for (value, scale) in out.iter_mut().zip(scale).take(count) {
            *value *= scale;
        }
        Some(out)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::noise::{NoisePlan, Survey};

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
        let plan = NoisePlan::new(N, 1).unwrap().with_sky(SkySource::Image);
        let look = |mut survey: crate::noise::NoiseSurvey| {
            stamps
                .iter()
                .for_each(|stamp| survey.add(stamp.view()).unwrap());
            survey
        };
        let first = look(plan.survey());
        first.without_sky().map_or(first, look).found().unwrap()
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
    fn the_plane_under_the_stamps_is_found_with_its_sign_and_axes() {
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
    fn galaxies_are_as_broad_as_they_are_without_the_sky() {
        let galaxy = |rng: &mut ChaCha8Rng| small(anywhere(rng));
        let dark = survey(galaxy, 300.0, [0.0; 3], |_, _, _| {})
            .extent
            .unwrap();
        for plane in [[3.0, 0.0, 0.0], [10.0, 0.05, -0.05]] {
            let found = survey(galaxy, 300.0, plane, |_, _, _| {}).extent.unwrap();
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
    fn a_stamp_of_its_own_loses_its_own_plane() {
        let mut cells = Cells::new(N);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut mean = [0.0; 3];
        let count = 100;
        for _ in 0..count {
            let mut stamp: Vec<f32> = (0..N * N)
                .map(|at| {
                    let (x, y) = ((at % N) as f32 - 23.5, (at / N) as f32 - 23.5);
                    let half = 3f32.sqrt();
                    2.0 + 0.03 * x - 0.01 * y + rng.random_range(-half..half)
                })
                .collect();
            // A neighbour on the border, and a missing pixel.
            for y in 20..28 {
                stamp[y * N..y * N + 6].fill(30.0);
            }
            stamp[100] = f32::NAN;
            let sky = cells.plane_of(&stamp).unwrap();
            let found = [sky.level, sky.slope[0], sky.slope[1]];
            mean = [0, 1, 2].map(|k| mean[k] + found[k] / f64::from(count));
            Subtraction::EachStamp.apply(&mut stamp, &mut cells);
            let again = cells.plane_of(&stamp).unwrap();
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
    fn a_fit_of_few_numbers_is_that_of_least_squares() {
        let mut sums = Normal::<3>::default();
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

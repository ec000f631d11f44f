//! Centroids and radii of galaxies and PSFs: moments under Gaussian weights. The weight of a centroid follows it.
//!
//! The mean square q = ½ Σ W r² I / Σ W I of radii under a Gaussian weight W of σ = 5 px, which keeps noise and neighbours
//! out, belongs to a Gaussian of mean square s per axis with 1/q = 1/s + 1/25; this s is the mean square radius here. The radii
//! of a galaxy and of its PSF differ by about the galaxy's own, so that the difference compares images of any seeing. The
//! narrow weight of a core compares the PSF with galaxies: no galaxy has a narrower core.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::statistics::upper_median;

use crate::pixels::{Pixel, contiguous, frame};

// Narrow, so that a centroid does not follow noise: at S/N 20 it is good to 0.2 px. Chosen by hand.
pub(crate) const CENTROID_WEIGHT_SIGMA: f64 = 2.0;
// Three σ.
const CENTROID_WEIGHT_HALF_SIDE: usize = 6;
const CENTROID_WEIGHT_SIDE: usize = 2 * CENTROID_WEIGHT_HALF_SIDE;
// The weighted centroid falls short of the centre: of a Gaussian of σ = 2 px it goes half the way. Chosen by hand.
const STEP_FACTOR: f64 = 1.5;
// Of the offset of a Gaussian of σ = 3 px, three steps leave 0.16. Chosen by hand.
const GALAXY_STEPS: usize = 3;
// A weighted centroid of one σ of the weight. Chosen by hand.
const MAX_GALAXY_STEP: f64 = 3.0;
// S/N ν under the weight at which half of a centroid is the origin of the shear. The noise of a centroid correlates with that of the
// response: whole centroids would make m about +1e-3 (20/ν)² (tests/stress --cases off1,off2,off3), with 30 it is below 0.3e-3 at any ν.
const HALF_CENTROID_SNR: f64 = 30.0;
// A star of FWHM 10 px is found to 10⁻³ px. Chosen by hand.
const MAX_STAR_STEPS: usize = 40;
// Chosen by hand.
const CONVERGED_STEP: f64 = 1e-3;
// Largest distance of a star's centroid from the start of the search, in pixels.
// Farther away it is another object. Chosen by hand.
pub(crate) const MAX_STAR_SHIFT: f64 = 3.0;

/// Offset (x, y) of the galaxy from the centre of its stamp of `n` pixels a side; zero if there is no light.
pub(crate) fn galaxy_centroid(stamp: &[f32], n: usize) -> [f32; 2] {
    galaxy_centroid_near(stamp, n, [0.0; 2])
}

/// The same for a galaxy that is expected at `start` from the centre, which is returned if there is no light. Steps that fall short of the
/// centroid leave no part of an offset that was expected.
pub(crate) fn galaxy_centroid_near(stamp: &[f32], n: usize, start: [f64; 2]) -> [f32; 2] {
    centroid_and_light(stamp, n, start).0
}

/// Place (x, y) about which a shear deforms the galaxy, from the centre of its stamp of `n` pixels a side in noise of this level.
pub(crate) fn shear_origin(stamp: &[f32], n: usize, noise: f64) -> [f32; 2] {
    let (centroid, light) = centroid_and_light(stamp, n, [0.0; 2]);
    // The integral of the squared weight is πσ².
    let snr = light / (noise * CENTROID_WEIGHT_SIGMA * std::f64::consts::PI.sqrt());
    let share = 1.0 / (1.0 + (HALF_CENTROID_SNR / snr).powi(4));
    centroid.map(|at| at * share as f32)
}

// The centroid of `galaxy_centroid_near`, and the light under its last weight.
fn centroid_and_light(stamp: &[f32], n: usize, start: [f64; 2]) -> ([f32; 2], f64) {
    let centre = (n as f64 - 1.0) / 2.0;
    let bound = centre / 2.0;
    let (mut offset, mut light) = (start, 0.0);
    for _ in 0..GALAXY_STEPS {
        let row = |y: usize| &stamp[y * n..][..n];
        let Some((step, under_weight)) = step([n; 2], row, offset.map(|at| centre + at)) else {
            return (start.map(|at| at as f32), 0.0);
        };
        light = under_weight;
        for (at, step) in offset.iter_mut().zip(step) {
            let step = step.clamp(-MAX_GALAXY_STEP, MAX_GALAXY_STEP);
            *at = (*at + step).clamp(-bound, bound);
        }
    }
    (offset.map(|at| at as f32), light)
}

/// Centroid (x, y) of a star near `start`, in pixels from the first; `start` if the search leaves it or finds no light.
pub(crate) fn star_centroid<P: Pixel>(stamp: ArrayView2<'_, P>, start: [f64; 2]) -> [f64; 2] {
    let (rows, columns) = stamp.dim();
    let mut at = start;
    for _ in 0..MAX_STAR_STEPS {
        let row = |y: usize| contiguous(stamp.row(y));
        let Some((step, _)) = step([columns, rows], row, at) else {
            return start;
        };
        for k in 0..2 {
            at[k] += step[k];
            if (at[k] - start[k]).abs() > MAX_STAR_SHIFT {
                return start;
            }
        }
        if step.iter().all(|step| step.abs() < CONVERGED_STEP) {
            break;
        }
    }
    at
}

/// The step from `at` towards the centroid, and the light under the weight; `None` without light.
fn step<P: Pixel, R: AsRef<[P]>>(
    [columns, rows]: [usize; 2],
    row: impl Fn(usize) -> R,
    at: [f64; 2],
) -> Option<([f64; 2], f64)> {
    let [first_x, first_y] =
        at.map(|at| at.floor() as isize + 1 - CENTROID_WEIGHT_HALF_SIDE as isize);
    let weights_x = weights(first_x as f64 - at[0]);
    let weights_y = weights(first_y as f64 - at[1]);
    let on_stamp = |first: isize, side: usize| {
        let start = first.min(0).unsigned_abs().min(CENTROID_WEIGHT_SIDE);
        start..(side as isize - first).clamp(start as isize, CENTROID_WEIGHT_SIDE as isize) as usize
    };
    let (xs, ys) = (on_stamp(first_x, columns), on_stamp(first_y, rows));
    let (mut light, mut first) = (0.0, [0.0; 2]);
    for y in ys {
        let row = row((first_y + y as isize) as usize);
        let pixels = &row.as_ref()[(first_x + xs.start as isize) as usize..];
        let (mut of_row, mut along_row) = (0.0, 0.0);
        for (x, pixel) in xs.clone().zip(pixels) {
            let weighted = weights_x[x] * Into::<f64>::into(*pixel);
            of_row += weighted;
            along_row += weighted * ((first_x + x as isize) as f64 - at[0]);
        }
        let dy = (first_y + y as isize) as f64 - at[1];
        light += weights_y[y] * of_row;
        first[0] += weights_y[y] * along_row;
        first[1] += weights_y[y] * of_row * dy;
    }
    // Not of a stamp with pixels that are NaN, which the caller sees in the result.
    if light <= 0.0 {
        return None;
    }
    Some((first.map(|sum| STEP_FACTOR * sum / light), light))
}

/// The weight at places one pixel apart, from `first` pixels from its centre on.
fn weights(first: f64) -> [f64; CENTROID_WEIGHT_SIDE] {
    // exp(−(x + 1)²/2σ²) is exp(−x²/2σ²) times exp(−(2x + 1)/2σ²), whose ratio from place to place is exp(−1/σ²): three
    // exponentials in place of twelve.
    let square = CENTROID_WEIGHT_SIGMA * CENTROID_WEIGHT_SIGMA;
    let mut value = (-0.5 * first * first / square).exp();
    let mut factor = (-(first + 0.5) / square).exp();
    let ratio = (-1.0 / square).exp();
    std::array::from_fn(|_| {
        let here = value;
        value *= factor;
        factor *= ratio;
        here
    })
}

// σ of the weight in pixels. Chosen by hand.
const SIZE_WEIGHT_SIGMA: f64 = 5.0;
// σ of the weight of cores in pixels. Chosen by hand.
const CORE_SIGMA: f64 = 1.0;
// 5σ: exp(−12.5) = 4·10⁻⁶.
pub(crate) const CORE_RADIUS_PX: f64 = 5.0 * CORE_SIGMA;
// Width of the border whose mean is the sky, in pixels. Chosen by hand.
const BORDER: usize = 2;
// At S/N 10, thirty stamps give the mean square radius to a tenth. Command and seed not recorded.
const MIN_STAMPS: usize = 30;
// Times the median by which one stamp may count, so that outliers do not matter; no simulated galaxy exceeds it. Chosen
// by hand.
const MAX_TIMES_MEDIAN: f64 = 4.0;

/// The core of a galaxy or PSF, as of a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CoreSize {
    /// Mean square radius per axis and its standard error, in px².
    pub(crate) mean_square_radius: f64,
    pub(crate) error: f64,
}

impl CoreSize {
    pub(crate) fn from_weighted(q: f64, error: f64) -> Option<CoreSize> {
        let mean_square_radius = without_weight(q, CORE_SIGMA)?;
        error.is_finite().then(|| CoreSize {
            mean_square_radius,
            error: error * (mean_square_radius / q).powi(2),
        })
    }

    pub(crate) fn fwhm(&self) -> f64 {
        (8.0 * std::f64::consts::LN_2 * self.mean_square_radius).sqrt()
    }
}

/// Σ W I and Σ W r² I under the narrow weight about `centre`, (x, y) in pixels from the stamp's centre.
pub(crate) fn core_sums(
    value: impl Fn(usize, usize) -> f64,
    sides: [usize; 2],
    centre: [f64; 2],
) -> [f64; 2] {
    let at = [0, 1].map(|k| (sides[k] as f64 - 1.0) / 2.0 + centre[k]);
    let range = |k: usize| {
        let first = (at[k] - CORE_RADIUS_PX).ceil().max(0.0) as usize;
        let last = (at[k] + CORE_RADIUS_PX).floor().max(0.0) as usize;
        first..(last + 1).min(sides[k])
    };
    let weight = |at: usize, centre: f64| {
        let square = (at as f64 - centre).powi(2);
        ((-0.5 * square / (CORE_SIGMA * CORE_SIGMA)).exp(), square)
    };
    let mut along_x = [(0.0, 0.0); 2 * CORE_RADIUS_PX as usize + 1];
    for (weights, x) in along_x.iter_mut().zip(range(0)) {
        *weights = weight(x, at[0]);
    }
    let mut sums = [0.0; 2];
    for y in range(1) {
        let (down, square_y) = weight(y, at[1]);
        for (x, (weight, square_x)) in range(0).zip(along_x) {
            let light = down * weight * value(x, y);
            sums[0] += light;
            sums[1] += (square_x + square_y) * light;
        }
    }
    sums
}

/// The core of a PSF stamp with its star at `centre`, a background of `level` and noise of `sigma` per pixel.
pub(crate) fn psf_core_size(
    psf: ArrayView2<'_, f64>,
    centre: [f64; 2],
    level: f64,
    sigma: f64,
) -> Option<CoreSize> {
    let sides = [psf.ncols(), psf.nrows()];
    let [light, squares] = core_sums(|x, y| psf[(y, x)] - level, sides, centre);
    let q = 0.5 * squares / light;
    // Var(Σ W (r²/2 − q) n) = σ² ∫ W² (r²/2 − q)² d²x, where W² is a Gaussian of half the variance.
    let half = CORE_SIGMA * CORE_SIGMA / 2.0;
    let spread = 2.0 * half * half - 2.0 * half * q + q * q;
    let variance = std::f64::consts::PI * CORE_SIGMA * CORE_SIGMA * spread;
    CoreSize::from_weighted(q, sigma * variance.sqrt() / light.abs())
}

/// The mean square radius of light whose mean square under a weight of σ is `q`; `None` if it is not positive.
fn without_weight(q: f64, sigma: f64) -> Option<f64> {
    let square = 1.0 / (1.0 / q - 1.0 / (sigma * sigma));
    (square > 0.0 && square.is_finite()).then_some(square)
}

/// Buffers for moments under the wide weight.
#[derive(Debug, Clone, Default)]
pub(crate) struct WeightedMoments {
    /// Sides and centre of the last stamp.
    last: Option<([usize; 2], [f64; 2])>,
    /// Its W and x² of each column, and W and y² of each row.
    columns: Vec<[f64; 2]>,
    rows: Vec<[f64; 2]>,
    /// Of each column, the sums over rows of W I and W y² I.
    light: Vec<f64>,
    squares: Vec<f64>,
}

impl WeightedMoments {
    /// Σ W I and Σ W r² I of `sides` = [columns, rows] pixels less a sky, about `centre`.
    fn sums<P: Pixel, R: AsRef<[P]>>(
        &mut self,
        sides: [usize; 2],
        centre: [f64; 2],
        sky: f64,
        pixels: impl Iterator<Item = R>,
    ) -> [f64; 2] {
        // Most stamps of an image have the same sides and centre, and exponentials are slow.
        if self.last != Some((sides, centre)) {
            self.last = Some((sides, centre));
            for (axis, weights) in [&mut self.columns, &mut self.rows].into_iter().enumerate() {
                let middle = (sides[axis] as f64 - 1.0) / 2.0;
                weights.clear();
                weights.extend((0..sides[axis]).map(|at| {
                    let square = (at as f64 - middle - centre[axis]).powi(2);
                    let weight = (-0.5 * square / (SIZE_WEIGHT_SIGMA * SIZE_WEIGHT_SIGMA)).exp();
                    [weight, square]
                }));
            }
        }
        for sums in [&mut self.light, &mut self.squares] {
            sums.clear();
            sums.resize(sides[0], 0.0);
        }
        for (row, &weights) in pixels.zip(&self.rows) {
            let row = row.as_ref();
            add_row(row, sky, weights, &mut self.light, &mut self.squares);
        }
        let mut sums = [0.0; 2];
        let columns = self.light.iter().zip(&self.squares);
        for ((light, squares), [weight, square]) in columns.zip(&self.columns) {
            sums[0] += weight * light;
            sums[1] += weight * (squares + square * light);
        }
        sums
    }

    /// The mean square radius of a PSF in px²; `None` if it is not positive.
    pub(crate) fn psf_mean_square(&mut self, psf: ArrayView2<'_, f64>) -> Option<f64> {
        let rows = psf.into_outer_iter().map(contiguous);
        let sides = [psf.ncols(), psf.nrows()];
        mean_square(self.sums::<f64, _>(sides, [0.0; 2], 0.0, rows))
    }
}

fn mean_square([light, squares]: [f64; 2]) -> Option<f64> {
    without_weight(0.5 * squares / light, SIZE_WEIGHT_SIGMA)
}

/// Adds a row to the sums of all columns, which are side by side so that no addition waits for the one before.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_row<P: Pixel>(
    row: &[P],
    sky: f64,
    [weight, square]: [f64; 2],
    light: &mut [f64],
    squares: &mut [f64],
) {
    for ((light, squares), value) in light.iter_mut().zip(squares).zip(row) {
        let value = weight * (Into::<f64>::into(*value) - sky);
        *light += value;
        *squares += square * value;
    }
}

#[derive(Debug, Clone, Default)]
pub(crate) struct GalaxyMoments {
    /// Σ W I and Σ W r² I of each stamp.
    stamps: Vec<[f64; 2]>,
    moments: WeightedMoments,
}

impl GalaxyMoments {
    /// Adds a stamp of `n` × `n` pixels with a galaxy in its middle.
    pub(crate) fn add(&mut self, pixels: &[f32], n: usize) {
        let (mut sum, mut count) = (0.0, 0.0);
        for value in frame(pixels, n, BORDER).flatten() {
            sum += f64::from(*value);
            count += 1.0;
        }
        // The sky of each stamp: the plane of the image is subtracted only where it matters to shapes.
        let rows = pixels.chunks_exact(n);
        let sums = self.moments.sums([n; 2], [0.0; 2], sum / count, rows);
        self.stamps.push(sums);
    }

    /// Adds the stamps of the next part of the image.
    pub(crate) fn join(&mut self, other: &Self) {
        self.stamps.extend_from_slice(&other.stamps);
    }

    /// The mean square radius of the galaxies behind the PSF, in px²; `None` of few stamps, and if it is not positive.
    pub(crate) fn mean_square_radius(&self) -> Option<f64> {
        if self.stamps.len() < MIN_STAMPS {
            return None;
        }
        let largest = [0, 1].map(|k| {
            let mut moduli: Vec<f64> = self.stamps.iter().map(|sums| sums[k].abs()).collect();
            MAX_TIMES_MEDIAN * upper_median(&mut moduli).unwrap_or(f64::NAN)
        });
        let mut sums = [0.0; 2];
        for stamp in &self.stamps {
            let share = (largest[0] / stamp[0].abs()).min(largest[1] / stamp[1].abs());
            // NaN of a blank stamp.
            let share = if share < 1.0 { share } else { 1.0 };
            sums[0] += share * stamp[0];
            sums[1] += share * stamp[1];
        }
        mean_square(sums)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::testing::close;

    const N: usize = 48;

    #[test]
    fn centroids_of_galaxies_are_found() {
        for (x, y) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.5), (0.3, 4.0)] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|at| {
                    let (dx, dy) = ((at % N) as f32 - 23.5 - x, (at / N) as f32 - 23.5 - y);
                    10.0 * (-(dx * dx + dy * dy) / 18.0).exp()
                })
                .collect();
            let found = galaxy_centroid(&stamp, N);
            // For a Gaussian of 3 px a step goes 1.5 · 4/(4 + 9) of the way; three of them leave 0.16 of it.
            let rest = (found[0] - x).hypot(found[1] - y);
            assert!(rest < 0.16 * x.hypot(y) + 0.01, "{found:?} {x} {y}");
        }
        assert_eq!(galaxy_centroid(&[-1.0; N * N], N), [0.0; 2]);
        assert_eq!(shear_origin(&[-1.0; N * N], N, 1.0), [0.0; 2]);
    }

    #[test]
    fn noisy_centroids_are_no_origins_of_shear() {
        let stamp: Vec<f32> = (0..N * N)
            .map(|at| 1.0 + 0.01 * ((at % N) as f32 - 23.5))
            .collect();
        let centroid = galaxy_centroid(&stamp, N)[0];
        assert!(centroid > 0.05);
        // About one per pixel has a light of 2πσ² under the weight.
        let noise = |snr: f64| 2.0 * std::f64::consts::PI.sqrt() * CENTROID_WEIGHT_SIGMA / snr;
        for (snr, share) in [
            (f64::INFINITY, 1.0),
            (HALF_CENTROID_SNR, 0.5),
            (10.0, 1.0 / 82.0),
        ] {
            let found = shear_origin(&stamp, N, noise(snr))[0] / centroid;
            // The stamp is a little brighter about the centroid.
            assert!((found / share - 1.0).abs() < 0.06, "{snr}: {found}");
        }
    }

    /// A Gaussian of mean square `square` per axis, off the middle.
    fn gaussian(square: f64, centre: [f64; 2]) -> Array2<f64> {
        Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5 - centre[0], y as f64 - 23.5 - centre[1]);
            (-0.5 * (x * x + y * y) / square).exp() / square
        })
    }

    fn of_stamps(count: usize, level: f64, sky: f64, square: f64) -> Option<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let mut light = GalaxyMoments::default();
        for _ in 0..count {
            let stamp: Vec<f32> = gaussian(square, [0.0; 2])
                .iter()
                .map(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    (value + level * noise + sky) as f32
                })
                .collect();
            light.add(&stamp, N);
        }
        light.mean_square_radius()
    }

    #[test]
    fn the_mean_square_radius_of_a_gaussian_is_its_variance() {
        for square in [3.0, 10.0, 20.0] {
            for sky in [0.0, 0.5] {
                let found = of_stamps(MIN_STAMPS, 0.0, sky, square).unwrap();
                // The frame holds 10⁻⁴ of the light of the broadest.
                assert!((found / square - 1.0).abs() < 2e-3, "{square} {found}");
            }
            let psf = WeightedMoments::default().psf_mean_square(gaussian(square, [0.0; 2]).view());
            let psf = psf.unwrap();
            assert!((psf / square - 1.0).abs() < 1e-3, "{square} {psf}");
        }
    }

    #[test]
    fn the_core_of_a_gaussian_is_its_variance_within_its_error() {
        for square in [2.0, 6.0] {
            let psf = gaussian(square, [0.3, -0.2]);
            let core = psf_core_size(psf.view(), [0.3, -0.2], 0.0, 0.0).unwrap();
            close(core.mean_square_radius / square, 1.0, 1e-3);
            // The mean square of errors is that of 300 fields of noise, to a tenth.
            let (sigma, mut rng) = (0.01, ChaCha8Rng::seed_from_u64(4));
            let square = (0..300).map(|_| {
                let noisy = psf.mapv(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    value + sigma * noise
                });
                let found = psf_core_size(noisy.view(), [0.3, -0.2], 0.0, sigma).unwrap();
                ((found.mean_square_radius - square) / found.error).powi(2)
            });
            let square = square.sum::<f64>() / 300.0;
            assert!((0.7..1.4).contains(&square), "{square} {square}");
        }
    }

    #[test]
    fn noise_averages_away_and_few_stamps_are_refused() {
        // S/N √(Σ I²)/σ of 10.
        let square = 12.0;
        let level = (std::f64::consts::PI * square).sqrt() / square / 10.0;
        let found = of_stamps(1000, level, 0.0, square).unwrap();
        // A tenth from thirty stamps is 0.02 from a thousand.
        assert!((found / square - 1.0).abs() < 0.06, "{found}");
        assert!(of_stamps(MIN_STAMPS - 1, 0.0, 0.0, square).is_none());
        assert!(of_stamps(MIN_STAMPS, 0.0, 0.0, -1.0).is_none());
    }

    #[test]
    fn a_bright_stamp_counts_as_four_in_the_mean_radius() {
        let mean = |count: usize| {
            let mut galaxies = GalaxyMoments {
                stamps: vec![[1.0, 8.0]; count],
                ..GalaxyMoments::default()
            };
            galaxies.stamps[0] = [100.0, 800.0];
            galaxies.stamps[1] = [1.0, 80.0];
            galaxies.mean_square_radius()
        };
        assert_eq!(mean(29), None);
        // The second of ten times the width counts with 0.4 of its light, and four times its moment.
        let expected = mean_square([28.0 + 4.0 + 0.4, 8.0 * (28.0 + 4.0 + 4.0)]);
        let [found, expected] = [mean(30), expected].map(Option::unwrap);
        assert!((found / expected - 1.0).abs() < 1e-12, "{found} {expected}");
    }
}

//! How broad light is: the galaxies of an image, and PSFs, for a window that is as wide as they make it.
//!
//! The mean square q = ½ Σ W r² I / Σ W I of radii under a Gaussian weight W of 5 px, which keeps noise and neighbours
//! out, is that of a Gaussian of mean square s per axis where 1/q = 1/s + 1/25; this s is the extent. Those of a galaxy
//! and of its PSF differ by about the galaxy's own, so that the difference compares images of any seeing.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::statistics::upper_median;

use crate::denoise::frame;
use crate::pixel::{Pixel, contiguous};

/// σ of the weight for sizes of galaxies and PSFs. See docs/constants.md.
const WEIGHT: f64 = 5.0;
/// σ of the narrow weight for cores. A galaxy has no narrower core than its PSF. See
/// docs/constants.md.
const CORE: f64 = 1.0;
/// Radius of the narrow weight. See docs/constants.md.
const CORE_REACH: f64 = 5.0;
/// Width of the stamp's border, whose mean is the sky. See docs/constants.md.
const BORDER: usize = 2;
/// Fewest stamps from which the size of their galaxies is measured. See docs/constants.md.
const FEWEST: usize = 30;

/// Times the median by which one stamp may count, so that outliers do not matter. See
/// docs/constants.md.
const MOST: f64 = 4.0;

/// Sums over the stamps of an image.
#[derive(Debug, Clone, Default)]
pub(crate) struct Light {
    /// Σ W I and Σ W r² I of each stamp.
    stamps: Vec<[f64; 2]>,
    moments: Moments,
}

/// How broad the core of light is: the mean square of its radii per axis, were it a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Core {
    /// In px².
    pub(crate) extent: f64,
    /// Standard error in px².
    pub(crate) error: f64,
}

impl Core {
    /// Of light with `q` under the narrow weight, known to `error`.
    pub(crate) fn of(q: f64, error: f64) -> Option<Core> {
        let extent = 1.0 / (1.0 / q - 1.0 / (CORE * CORE));
        let good = extent > 0.0 && extent.is_finite() && error.is_finite();
        good.then(|| Core {
            extent,
            error: error * (extent / q).powi(2),
        })
    }

    /// FWHM in pixels of a Gaussian with this core.
    pub(crate) fn fwhm(&self) -> f64 {
        (8.0 * std::f64::consts::LN_2 * self.extent).sqrt()
    }
}

/// Σ W I and Σ W r² I under the narrow weight about `centre`, (x, y) in pixels from the middle.
pub(crate) fn core_sums(
    value: impl Fn(usize, usize) -> f64,
    sides: [usize; 2],
    centre: [f64; 2],
) -> [f64; 2] {
    let at = [0, 1].map(|k| (sides[k] as f64 - 1.0) / 2.0 + centre[k]);
    let range = |k: usize| {
        let first = (at[k] - CORE_REACH * CORE).ceil().max(0.0) as usize;
        let last = (at[k] + CORE_REACH * CORE).floor().max(0.0) as usize;
        first..(last + 1).min(sides[k])
    };
    let of = |at: usize, centre: f64| {
        let square = (at as f64 - centre).powi(2);
        ((-0.5 * square / (CORE * CORE)).exp(), square)
    };
    let mut along = [(0.0, 0.0); 2 * (CORE_REACH * CORE) as usize + 1];
    for (weight, x) in along.iter_mut().zip(range(0)) {
        *weight = of(x, at[0]);
    }
    let mut sums = [0.0; 2];
    for y in range(1) {
        let (down, square_y) = of(y, at[1]);
        for (x, (weight, square_x)) in range(0).zip(along) {
            let light = down * weight * value(x, y);
            sums[0] += light;
            sums[1] += (square_x + square_y) * light;
        }
    }
    sums
}

/// The core of a PSF stamp with its star at `centre`, (x, y) in pixels from the middle, a background of `level` and noise
/// of `sigma` per pixel.
pub(crate) fn core_of_psf(
    psf: ArrayView2<'_, f64>,
    centre: [f64; 2],
    level: f64,
    sigma: f64,
) -> Option<Core> {
    let sides = [psf.ncols(), psf.nrows()];
    let [light, squares] = core_sums(|x, y| psf[(y, x)] - level, sides, centre);
    let q = 0.5 * squares / light;
    // Var(Σ W (r²/2 − q) n) = σ² ∫ W² (r²/2 − q)² d²x, of which W² is a Gaussian of half the variance.
    let half = CORE * CORE / 2.0;
    let spread = 2.0 * half * half - 2.0 * half * q + q * q;
    let error = sigma * (std::f64::consts::PI * CORE * CORE * spread).sqrt() / light.abs();
    Core::of(q, error)
}

/// Room for sums over a stamp.
#[derive(Debug, Clone, Default)]
pub(crate) struct Moments {
    /// Sides and centre of the last stamp.
    last: Option<([usize; 2], [f64; 2])>,
    /// Its W and x² of each column, and of each row.
    columns: Vec<[f64; 2]>,
    rows: Vec<[f64; 2]>,
    /// Of each column, the sums over rows of W I and W y² I.
    light: Vec<f64>,
    squares: Vec<f64>,
}

impl Moments {
    /// Σ W I and Σ W r² I of `sides` = [columns, rows] pixels less a sky, about `centre`, (x, y) in pixels from the middle.
    fn of<P: Pixel, R: AsRef<[P]>>(
        &mut self,
        sides: [usize; 2],
        centre: [f64; 2],
        sky: f64,
        pixels: impl Iterator<Item = R>,
    ) -> [f64; 2] {
        if self.last != Some((sides, centre)) {
            self.last = Some((sides, centre));
            for (axis, weights) in [&mut self.columns, &mut self.rows].into_iter().enumerate() {
                let middle = (sides[axis] as f64 - 1.0) / 2.0;
                weights.clear();
                weights.extend((0..sides[axis]).map(|at| {
                    let square = (at as f64 - middle - centre[axis]).powi(2);
                    [(-0.5 * square / (WEIGHT * WEIGHT)).exp(), square]
                }));
            }
        }
        for sums in [&mut self.light, &mut self.squares] {
            sums.clear();
            sums.resize(sides[0], 0.0);
        }
        for (row, &weights) in pixels.zip(&self.rows) {
            add_row(
                row.as_ref(),
                sky,
                weights,
                &mut self.light,
                &mut self.squares,
            );
        }
        let mut sums = [0.0; 2];
        let columns = self.light.iter().zip(&self.squares);
        for ((light, squares), [weight, square]) in columns.zip(&self.columns) {
            sums[0] += weight * light;
            sums[1] += weight * (squares + square * light);
        }
        sums
    }

    /// The extent of a PSF stamp in px²; `None` where its light has none.
    pub(crate) fn of_psf(&mut self, psf: ArrayView2<'_, f64>) -> Option<f64> {
        let rows = psf.into_outer_iter().map(contiguous);
        let sides = [psf.ncols(), psf.nrows()];
        of_sums(self.of::<f64, _>(sides, [0.0; 2], 0.0, rows))
    }
}

/// Adds a row of weight and square to the sums of all columns, which are side by side so that no addition waits for the one
/// before.
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

impl Light {
    /// Adds a stamp of `n` × `n` pixels with a galaxy at `centre`, (x, y) in pixels from the middle.
    pub(crate) fn add(&mut self, pixels: &[f32], n: usize, centre: [f32; 2]) {
        let sky = sky(pixels, n);
        let (rows, centre) = (pixels.chunks_exact(n), centre.map(f64::from));
        let sums = self.moments.of([n; 2], centre, sky, rows);
        self.stamps.push(sums);
    }

    /// Adds the stamps of another, as if they had come after its own.
    pub(crate) fn join(&mut self, other: &Self) {
        self.stamps.extend_from_slice(&other.stamps);
    }

    /// The extent of the galaxies, with the PSF's, in px²; `None` of few stamps, and where their light has none.
    pub(crate) fn extent(&self) -> Option<f64> {
        if self.stamps.len() < FEWEST {
            return None;
        }
        let most = [0, 1].map(|k| {
            let mut moduli: Vec<f64> = self.stamps.iter().map(|sums| sums[k].abs()).collect();
            MOST * upper_median(&mut moduli).unwrap_or(f64::NAN)
        });
        let mut sums = [0.0; 2];
        for stamp in &self.stamps {
            let share = (most[0] / stamp[0].abs()).min(most[1] / stamp[1].abs());
            // Of a blank stamp it is no number.
            let share = if share < 1.0 { share } else { 1.0 };
            sums[0] += share * stamp[0];
            sums[1] += share * stamp[1];
        }
        of_sums(sums)
    }
}

/// The extent of light with these Σ W I and Σ W r² I.
fn of_sums([light, squares]: [f64; 2]) -> Option<f64> {
    let q = 0.5 * squares / light;
    let extent = 1.0 / (1.0 / q - 1.0 / (WEIGHT * WEIGHT));
    (extent > 0.0 && extent.is_finite()).then_some(extent)
}

/// Mean of a stamp's outermost pixels.
fn sky(pixels: &[f32], n: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for value in frame(pixels, n, BORDER).flatten() {
        sum += f64::from(*value);
        count += 1.0;
    }
    sum / count
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const N: usize = 48;

    /// A Gaussian of mean square `extent` per axis, off the middle.
    fn gaussian(extent: f64, centre: [f64; 2]) -> Array2<f64> {
        Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5 - centre[0], y as f64 - 23.5 - centre[1]);
            (-0.5 * (x * x + y * y) / extent).exp() / extent
        })
    }

    fn of_stamps(count: usize, level: f64, sky: f64, extent: f64, centre: [f64; 2]) -> Option<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let mut light = Light::default();
        for _ in 0..count {
            let stamp: Vec<f32> = gaussian(extent, centre)
                .iter()
                .map(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    (value + level * noise + sky) as f32
                })
                .collect();
            light.add(&stamp, N, centre.map(|c| c as f32));
        }
        light.extent()
    }

    #[test]
    fn the_extent_of_a_gaussian_is_its_variance_wherever_it_is_and_on_any_sky() {
        for extent in [3.0, 10.0, 20.0] {
            for (centre, sky) in [([0.0; 2], 0.0), ([3.0, -2.0], 0.5)] {
                let found = of_stamps(FEWEST, 0.0, sky, extent, centre).unwrap();
                // The frame holds 10⁻⁴ of the light of the broadest.
                assert!((found / extent - 1.0).abs() < 2e-3, "{extent} {found}");
            }
            let psf = Moments::default().of_psf(gaussian(extent, [0.0; 2]).view());
            let psf = psf.unwrap();
            assert!((psf / extent - 1.0).abs() < 1e-3, "{extent} {psf}");
        }
    }

    #[test]
    fn the_core_of_a_gaussian_is_its_variance_and_noise_is_in_its_error() {
        for extent in [2.0, 6.0] {
            let psf = gaussian(extent, [0.3, -0.2]);
            let core = core_of_psf(psf.view(), [0.3, -0.2], 0.0, 0.0).unwrap();
            assert!((core.extent / extent - 1.0).abs() < 1e-3, "{core:?}");
            // The mean square of errors is that of 300 fields of noise, to a tenth.
            let (sigma, mut rng) = (0.01, ChaCha8Rng::seed_from_u64(4));
            let square = (0..300).map(|_| {
                let noisy = psf.mapv(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    value + sigma * noise
                });
                let found = core_of_psf(noisy.view(), [0.3, -0.2], 0.0, sigma).unwrap();
                ((found.extent - extent) / found.error).powi(2)
            });
            let square = square.sum::<f64>() / 300.0;
            assert!((0.7..1.4).contains(&square), "{extent} {square}");
        }
    }

    #[test]
    fn a_wild_stamp_counts_like_a_few() {
        let mut light = Light::default();
        let stamp: Vec<f32> = gaussian(10.0, [0.0; 2]).iter().map(|v| *v as f32).collect();
        for wild in [1e6, -1e6, 0.0] {
            for _ in 0..333 {
                light.add(&stamp, N, [0.0; 2]);
            }
            // Where W r² is largest.
            let mut stamp = stamp.clone();
            stamp[24 * N + 31] = wild;
            light.add(&stamp, N, [0.0; 2]);
            light.add(&vec![0.0; N * N], N, [0.0; 2]);
        }
        // Four parts in a thousand of a light of r² = 56 in place of 20 px² move the extent by 2 %, once each way.
        let found = light.extent().unwrap();
        assert!((found / 10.0 - 1.0).abs() < 0.02, "{found}");
    }

    #[test]
    fn noise_averages_away_and_few_stamps_tell_nothing() {
        // S/N √(Σ I²)/σ of 10.
        let extent = 12.0;
        let level = (std::f64::consts::PI * extent).sqrt() / extent / 10.0;
        let found = of_stamps(1000, level, 0.0, extent, [0.0; 2]).unwrap();
        // A tenth from thirty stamps is 0.02 from a thousand.
        assert!((found / extent - 1.0).abs() < 0.06, "{found}");
        assert!(of_stamps(FEWEST - 1, 0.0, 0.0, extent, [0.0; 2]).is_none());
        assert!(of_stamps(FEWEST, 0.0, 0.0, -1.0, [0.0; 2]).is_none());
    }
}

//! A star with less noise: the Moffat profile that fits best, and of what is left as much as is significant.
//!
//! What is left is expanded in Gauss–Hermite functions. Those of one order, which span the same space in any direction, are
//! shrunk together: with Stein's factor 1 − (n − 2)σ²/Σc², or to nothing. A star of high S/N is left as it is, with a
//! smooth transition. Many stars of an image show what they have in common beyond such profiles, which is added first.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};

use super::breadth;
use super::common::{CommonProfile, Sums};
use super::moffat::Moffat;
use super::star;
use super::sums::sum_of_squares;
use shearq_quantities::statistics::{SCATTER, median};

/// S/N between which a star is used more and more as it is. See docs/constants.md.
pub(super) const AS_IT_IS: [f64; 2] = [500.0, 1000.0];
/// Highest order of the functions for the difference between a star and its profile. See docs/constants.md.
const ORDER: usize = 12;
/// Highest order of those functions that are not round. See docs/constants.md.
const OTHERS: usize = 8;

type Coefficients = [[f64; ORDER + 1]; ORDER + 1];
/// Highest order of functions that are dropped unless round: the fit determines them. See docs/constants.md.
const LOW: usize = 2;
/// Scale of the functions in units of the σ of the profile's core. See docs/constants.md.
const SCALE: f64 = 1.1;
/// Side from which on the border is free of the star's light. See docs/constants.md.
pub(super) const LEAST_SIDE: usize = 24;
/// Value of a function below which its pixel is left out.
const NOTHING: f64 = 1e-4;
/// Fourth differences 1, −4, 6, −4, 1 of white noise have the variance of so many pixels.
const FOURTH: f64 = 70.0;

/// Buffers for stars of any size.
#[derive(Debug, Default)]
pub(crate) struct Shrinker {
    star: Array2<f64>,
    moduli: Vec<f32>,
    /// Functions of x and of y, a row per order.
    along: [Array2<f64>; 2],
    partial: Array2<f64>,
    common: Option<Arc<CommonProfile>>,
}

/// A star's profile, the noise of a pixel, and the star's S/N.
struct Fitted {
    profile: Moffat,
    sigma: f64,
    snr: f64,
}

impl Shrinker {
    /// Stars are noisy versions of profiles with this in common, or of any.
    pub(crate) fn set_common(&mut self, common: Option<&Arc<CommonProfile>>) {
        self.common = common.cloned();
    }

    /// The star `psf` of sum one with as little noise as can be: as it is if it has hardly any.
    pub(crate) fn shrunk<'a>(&'a mut self, psf: ArrayView2<'a, f64>) -> ArrayView2<'a, f64> {
        let Some(Fitted {
            profile,
            sigma,
            snr,
        }) = self.fit(psf)
        else {
            return psf;
        };
        if let Some(common) = &self.common {
            common.of(snr).add(&profile, self.star.view_mut());
        }
        self.add_significant(psf, &profile, sigma);
        let kept = kept(snr);
        let sum = self.star.sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return psf;
        }
        self.star.zip_mut_with(&psf, |value, own| {
            *value = (1.0 - kept) * *value / sum + kept * own;
        });
        self.star.view()
    }

    /// S/N of the star `psf` of sum one, and what the profile leaves of it, if it has noise.
    pub(super) fn left(&mut self, psf: ArrayView2<'_, f64>) -> Option<(f64, Sums)> {
        let Fitted {
            profile,
            sigma,
            snr,
        } = self.fit(psf)?;
        Some((snr, Sums::of(psf, self.star.view(), &profile, sigma)))
    }

    /// Draws the profile that fits a star; `None` if the star has hardly any noise, or there is no fit.
    fn fit(&mut self, psf: ArrayView2<'_, f64>) -> Option<Fitted> {
        let n = psf.nrows();
        if n != psf.ncols() || n < LEAST_SIDE {
            return None;
        }
        let power = sum_of_squares(psf);
        // Hardly ever below the noise's, and quick.
        let least = power.sqrt() / AS_IT_IS[1];
        let square = mean_square(psf);
        if square.is_nan() || square <= 0.25 * least * least {
            return None;
        }
        let sigma = self.noise(psf);
        let snr = (power - psf.len() as f64 * sigma * sigma).max(0.0).sqrt() / sigma;
        if snr.is_nan() || snr >= AS_IT_IS[1] {
            return None;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let place = star::place(psf).map(|off| middle + off);
        let area = breadth::area(psf);
        if !(area > 0.0 && area.is_finite()) {
            return None;
        }
        let profile = Moffat::fit(psf, place, area, sigma)?;
        if self.star.dim() != psf.dim() {
            self.star = Array2::zeros(psf.dim());
        }
        profile.draw(self.star.view_mut());
        Some(Fitted {
            profile,
            sigma,
            snr,
        })
    }

    /// Adds what is significant of the difference between a star and its profile.
    fn add_significant(&mut self, psf: ArrayView2<'_, f64>, profile: &Moffat, sigma: f64) {
        let n = psf.nrows();
        let scale = (SCALE * profile.sigma()).max(((2 * ORDER + 1) as f64).sqrt() / 3.0);
        let place = profile.place();
        let Shrinker {
            star,
            along: [across, down],
            partial,
            ..
        } = self;
        for (functions, at) in [&mut *across, &mut *down].into_iter().zip(place) {
            if functions.dim() != (ORDER + 1, n) {
                *functions = Array2::zeros((ORDER + 1, n));
            }
            hermite(functions, at, scale);
        }
        if partial.dim() != (ORDER + 1, n) {
            *partial = Array2::zeros((ORDER + 1, n));
        }
        // Σ_y of function k of y, for each x.
        for k in 0..=ORDER {
            let mut row = partial.row_mut(k);
            row.fill(0.0);
            for y in 0..n {
                let weight = down[(k, y)];
                if weight.abs() < NOTHING {
                    continue;
                }
                let lines = psf.row(y).into_iter().zip(star.row(y));
                for (sum, (value, model)) in row.iter_mut().zip(lines) {
                    *sum += weight * (value - model);
                }
            }
        }
        let mut coefficients = [[0.0; ORDER + 1]; ORDER + 1];
        for (ky, line) in coefficients.iter_mut().enumerate() {
            for (kx, value) in line.iter_mut().enumerate().take(ORDER + 1 - ky) {
                *value = across.row(kx).dot(&partial.row(ky));
            }
        }
        shrink(&mut coefficients, sigma);
        for (ky, line) in coefficients.iter().enumerate() {
            let mut row = partial.row_mut(ky);
            row.fill(0.0);
            for (kx, coefficient) in line.iter().enumerate().take(ORDER + 1 - ky) {
                row.scaled_add(*coefficient, &across.row(kx));
            }
        }
        for y in 0..n {
            let mut row = star.row_mut(y);
            for k in 0..=ORDER {
                row.scaled_add(down[(k, y)], &partial.row(k));
            }
        }
    }

    /// Noise of a pixel, from fourth differences along the border, where wings are smooth.
    fn noise(&mut self, psf: ArrayView2<'_, f64>) -> f64 {
        self.moduli.clear();
        each_difference(psf, |difference| self.moduli.push(difference.abs() as f32));
        f64::from(median(&mut self.moduli).unwrap_or(0.0) * SCATTER) / FOURTH.sqrt()
    }
}

/// Shrinks coefficients [order along y][order along x]: the round ones together, and the others of each order.
fn shrink(coefficients: &mut Coefficients, sigma: f64) {
    let mut round = [0.0; ORDER / 2 + 1];
    for (half, value) in round.iter_mut().enumerate() {
        for k in 0..=half {
            let share = share(k) * share(half - k);
            *value += share * coefficients[2 * (half - k)][2 * k];
        }
        for k in 0..=half {
            let share = share(k) * share(half - k);
            coefficients[2 * (half - k)][2 * k] -= share * *value;
        }
    }
    let (mut square, mut count) = (0.0, 0.0);
    for value in &round {
        square += value * value;
        count += 1.0;
    }
    let all = stein(square, count, sigma);
    for order in 0..=ORDER {
        let is_even = order % 2 == 0;
        let places = (0..=order).map(|kx| (order - kx, kx));
        let square: f64 = places
            .clone()
            .map(|at| coefficients[at.0][at.1].powi(2))
            .sum();
        let count = if is_even { order } else { order + 1 } as f64;
        let factor = if order <= LOW || order > OTHERS {
            0.0
        } else {
            stein(square, count, sigma)
        };
        for (ky, kx) in places {
            coefficients[ky][kx] *= factor;
        }
        if is_even {
            for k in 0..=order / 2 {
                let share = share(k) * share(order / 2 - k);
                coefficients[2 * (order / 2 - k)][2 * k] += share * all * round[order / 2];
            }
        }
    }
}

/// Stein's factor for `count` values of the sum of squares `square`, with noise `sigma` each: how much of them is kept
/// (James and Stein 1961).
fn stein(square: f64, count: f64, sigma: f64) -> f64 {
    if square > 0.0 {
        (1.0 - (count - 2.0) * sigma * sigma / square).max(0.0)
    } else {
        0.0
    }
}

/// Share of function 2k along an axis in a round function: √(2k)!/(2ᵏ k!).
fn share(k: usize) -> f64 {
    (1..=k)
        .map(|i| ((2 * i - 1) as f64 / (2 * i) as f64).sqrt())
        .product()
}

/// Share of a star of such an S/N that is used as it is.
fn kept(snr: f64) -> f64 {
    let [from, to] = AS_IT_IS;
    let place = ((snr / from).ln() / (to / from).ln()).clamp(0.0, 1.0);
    place * place * (3.0 - 2.0 * place)
}

/// Mean square of noise of the outermost pixels.
fn mean_square(psf: ArrayView2<'_, f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    each_difference(psf, |difference| {
        sum += difference * difference;
        count += 1.0;
    });
    sum / count / FOURTH
}

/// Fourth differences along the two outer lines of pixels on each side.
fn each_difference(psf: ArrayView2<'_, f64>, mut take: impl FnMut(f64)) {
    let n = psf.nrows();
    for k in [0, 1, n - 2, n - 1] {
        let (mut across, mut down) = ([0.0; 4], [0.0; 4]);
        for (at, (x, y)) in psf.row(k).iter().zip(psf.column(k)).enumerate() {
            let (x, y) = (
                fourth_difference(&mut across, *x),
                fourth_difference(&mut down, *y),
            );
            if at >= 4 {
                take(x);
                take(y);
            }
        }
    }
}

/// The fourth difference of `value` and the four numbers before it.
fn fourth_difference(before: &mut [f64; 4], value: f64) -> f64 {
    let [a, b, c, d] = *before;
    *before = [b, c, d, value];
    a - 4.0 * b + 6.0 * c - 4.0 * d + value
}

/// Gauss–Hermite functions of pixels about `at`, orthonormal, a row per order.
fn hermite(functions: &mut Array2<f64>, at: f64, scale: f64) {
    let root = (scale * std::f64::consts::PI.sqrt()).sqrt();
    for x in 0..functions.ncols() {
        let t = (x as f64 - at) / scale;
        let mut below = 0.0;
        let mut value = (-0.5 * t * t).exp() / root;
        for k in 0..=ORDER {
            functions[(k, x)] = value;
            let order = k as f64;
            let next =
                (2.0 / (order + 1.0)).sqrt() * t * value - (order / (order + 1.0)).sqrt() * below;
            (below, value) = (value, next);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::test_stars::{self, noisy, power};
    use super::*;

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn drawn(profile: PsfProfile, fwhm: f64, side: usize) -> Array2<f64> {
        test_stars::drawn(profile, fwhm, Shear::new(0.06, -0.04), side)
    }

    #[test]
    fn stars_without_noise_stay_as_they_are() {
        for side in [15, 32, 48, 64] {
            for fwhm in [2.0, 3.4, 6.0] {
                for profile in [MOFFAT, PsfProfile::Kolmogorov] {
                    let psf = drawn(profile, fwhm, side);
                    let mut shrinker = Shrinker::default();
                    assert!(
                        shrinker.shrunk(psf.view()) == psf,
                        "{profile:?} {fwhm} {side}"
                    );
                }
            }
        }
        let nothing = Array2::<f64>::zeros((48, 48));
        assert_eq!(Shrinker::default().shrunk(nothing.view()), nothing);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let bright = noisy(&drawn(MOFFAT, 3.4, 48), 2000.0, &mut rng);
        assert!(Shrinker::default().shrunk(bright.view()) == bright);
    }

    #[test]
    fn noise_falls_and_the_mean_power_of_each_direction_stays() {
        let waves = [[0.5, 0.0], [0.0, 0.5], [0.5, 0.5], [0.5, -0.5], [0.9, 0.0]];
        // The wing of the fit falls as r⁻³ and misses a Kolmogorov profile's light at 6 to 24 px, which noise hides.
        for (profile, snr, wings) in [
            (MOFFAT, 50.0, 0.02),
            (MOFFAT, 100.0, 0.02),
            (PsfProfile::Kolmogorov, 100.0, 0.04),
        ] {
            let psf = drawn(profile, 3.4, 48);
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            let mut shrinker = Shrinker::default();
            let (mut before, mut after, mut powers) = (0.0, 0.0, [0.0; 5]);
            let count = 40;
            for _ in 0..count {
                let star = noisy(&psf, snr, &mut rng);
                before += (&star - &psf).mapv(|v| v * v).sum();
                let shrunk = shrinker.shrunk(star.view());
                assert!((shrunk.sum() - 1.0).abs() < 1e-9);
                after += (&shrunk - &psf).mapv(|v| v * v).sum();
                for (sum, wave) in powers.iter_mut().zip(waves) {
                    *sum += power(shrunk, wave) / f64::from(count);
                }
            }
            // Of 2304 pixels about ten parameters are left.
            assert!(
                after < 0.02 * before,
                "{profile:?} {snr}: {after} of {before}"
            );
            for (found, wave) in powers.iter().zip(waves) {
                let expected = power(psf.view(), wave);
                // 40 stars whose powers scatter by 4/(S/N), at four standard deviations, and wings that cannot be seen.
                let tolerance = 4.0 * 4.0 / snr / 40f64.sqrt() + wings;
                let off = (found / expected - 1.0).abs();
                assert!(
                    off < tolerance,
                    "{profile:?} {snr} {wave:?}: {found} {expected}"
                );
            }
        }
    }

    #[test]
    fn a_lopsided_star_stays_lopsided() {
        let mut psf = drawn(MOFFAT, 3.0, 48);
        let side = FunctionalPsf::new(MOFFAT, 3.0, Shear::ZERO).unwrap();
        let mut beside = Array2::zeros((48, 48));
        side.draw_into(27.0, 24.5, beside.view_mut());
        psf = psf * 0.75 + beside * 0.25;
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let star = noisy(&psf, 300.0, &mut rng);
        let mut shrinker = Shrinker::default();
        let shrunk = shrinker.shrunk(star.view());
        // How much brighter one side of the star is than the other, 5 px away along x.
        let skew = |psf: ArrayView2<'_, f64>| -> f64 {
            (20..28)
                .map(|y| psf[(y, 29)] + psf[(y, 30)] - psf[(y, 18)] - psf[(y, 19)])
                .sum()
        };
        let (found, expected) = (skew(shrunk), skew(psf.view()));
        assert!((found / expected - 1.0).abs() < 0.15, "{found} {expected}");
    }

    #[test]
    fn functions_are_orthonormal_and_round_ones_round() {
        let mut functions = Array2::zeros((ORDER + 1, 48));
        hermite(&mut functions, 23.2, 1.8);
        let products = functions.dot(&functions.t());
        for ((i, j), product) in products.indexed_iter() {
            let expected = if i == j { 1.0 } else { 0.0 };
            // Sampling of the highest order in steps of a pixel.
            assert!((product - expected).abs() < 1e-2, "{i} {j}: {product}");
        }
        let squares: f64 = (0..=3).map(|k| (share(k) * share(3 - k)).powi(2)).sum();
        assert!((squares - 1.0).abs() < 1e-12);
        hermite(&mut functions, 23.0, 1.8);
        // (3, 4) and (5, 0) are as far from the middle.
        let functions = functions;
        let at = |x: usize, y: usize| -> f64 {
            (0..=2)
                .map(|k| {
                    share(k) * share(2 - k) * functions[(2 * k, x)] * functions[(4 - 2 * k, y)]
                })
                .sum()
        };
        assert!((at(26, 27) - at(28, 23)).abs() < 1e-9);
    }
}

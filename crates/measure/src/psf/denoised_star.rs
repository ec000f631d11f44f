//! Denoised stars: the Moffat profile that fits a star best, with as much of the residual as is significant.
//!
//! The residual is expanded in Gauss–Hermite functions. Those of one order span the same space in any direction, so they
//! share a shrinkage factor: Stein's 1 − (n − 2)σ²/Σc², or zero. A star of high S/N stays as it is, with a smooth
//! transition. The mean residual profile of the image's stars is added to the Moffat profile first.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_quantities::statistics::{SCATTER, median};

use super::moffat::Moffat;
use super::residual_profile::{ResidualProfiles, ResidualSums};
use super::star::{psf_offset, sum_of_squares};
use super::width::noise_equivalent_area;

// S/N between which the share of the raw star in the result grows from 0 to 1. The lower end is chosen by hand.
// At 1000 the noise of one star changes m by 5·10⁻³.
pub(super) const UNCHANGED_SNR: [f64; 2] = [500.0, 1000.0];
// An obscured Airy disc of S/N 100 has no significant power above it. Chosen by hand.
const MAX_ORDER: usize = 12;
// Highest order that is not round. Chosen by hand.
const MAX_AZIMUTHAL_ORDER: usize = 8;
// The fit determines centre and ellipticity, which have orders 1 and 2.
const MAX_FITTED_ORDER: usize = 2;
// Scale of the functions in units of the σ of the profile's core. Chosen by hand.
const HERMITE_SCALE: f64 = 1.1;
// Smallest side in pixels of a stamp whose border is free of the star's light. As for the noise of galaxies.
pub(super) const MIN_DENOISED_SIDE: usize = 24;
// Smaller values of a function are far below the noise of a star. Chosen by hand.
const MIN_FUNCTION_VALUE: f64 = 1e-4;
// Of 1, −4, 6, −4, 1 on white noise, in units of a pixel's: 1 + 16 + 36 + 16 + 1.
const DIFFERENCE_VARIANCE: f64 = 70.0;

/// Coefficients by order along y and order along x.
type Coefficients = [[f64; MAX_ORDER + 1]; MAX_ORDER + 1];

#[derive(Debug, Default)]
pub(crate) struct StarDenoiser {
    star: Array2<f64>,
    moduli: Vec<f32>,
    /// Gauss–Hermite functions of x and of y, a row per order.
    functions: [Array2<f64>; 2],
    partial: Array2<f64>,
    residual_profiles: Option<Arc<ResidualProfiles>>,
}

struct Fit {
    profile: Moffat,
    sigma: f64,
    snr: f64,
}

impl StarDenoiser {
    pub(crate) fn set_residual_profiles(&mut self, profiles: Option<&Arc<ResidualProfiles>>) {
        self.residual_profiles = profiles.cloned();
    }

    /// The denoised star of sum one; `psf` unchanged if its noise is negligible or no profile fits.
    pub(crate) fn denoised<'a>(&'a mut self, psf: ArrayView2<'a, f64>) -> ArrayView2<'a, f64> {
        self.denoised_with(psf, None)
    }

    /// The same with residual profiles in place of those that were set: epochs of a galaxy have stars of several images.
    pub(crate) fn denoised_with<'a>(
        &'a mut self,
        psf: ArrayView2<'a, f64>,
        profiles: Option<&Arc<ResidualProfiles>>,
    ) -> ArrayView2<'a, f64> {
        let Some(Fit {
            profile,
            sigma,
            snr,
        }) = self.fit(psf)
        else {
            return psf;
        };
        if let Some(profiles) = profiles.or(self.residual_profiles.as_ref()) {
            profiles.at_snr(snr).add_to(self.star.view_mut(), &profile);
        }
        self.add_significant_residual(psf, &profile, sigma);
        let kept = unchanged_share(snr);
        let sum = self.star.sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return psf;
        }
        self.star.zip_mut_with(&psf, |value, own| {
            *value = (1.0 - kept) * *value / sum + kept * own;
        });
        self.star.view()
    }

    /// S/N and residual of the star `psf` of sum one; `None` without noise.
    pub(super) fn residual(&mut self, psf: ArrayView2<'_, f64>) -> Option<(f64, ResidualSums)> {
        let Fit {
            profile,
            sigma,
            snr,
        } = self.fit(psf)?;
        let sums = ResidualSums::from_star(psf, self.star.view(), &profile, sigma);
        Some((snr, sums))
    }

    /// Fits a profile and draws it in `self.star`; `None` without noise, or if none fits.
    fn fit(&mut self, psf: ArrayView2<'_, f64>) -> Option<Fit> {
        let n = psf.nrows();
        if n != psf.ncols() || n < MIN_DENOISED_SIDE {
            return None;
        }
        let power = sum_of_squares(psf);
        // A quick test without a median: the mean square of the differences is hardly ever below the noise's.
        let negligible = power.sqrt() / UNCHANGED_SNR[1];
        let square = mean_square_difference(psf);
        if square.is_nan() || square <= 0.25 * negligible * negligible {
            return None;
        }
        let sigma = noise_level(psf, &mut self.moduli);
        let snr = (power - psf.len() as f64 * sigma * sigma).max(0.0).sqrt() / sigma;
        if snr.is_nan() || snr >= UNCHANGED_SNR[1] {
            return None;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let centre = psf_offset(psf).map(|offset| middle + offset);
        let area = noise_equivalent_area(psf);
        if !(area > 0.0 && area.is_finite()) {
            return None;
        }
        let profile = Moffat::fit(psf, centre, area, sigma)?;
        if self.star.dim() != psf.dim() {
            self.star = Array2::zeros(psf.dim());
        }
        profile.draw(self.star.view_mut());
        Some(Fit {
            profile,
            sigma,
            snr,
        })
    }

    fn add_significant_residual(&mut self, psf: ArrayView2<'_, f64>, profile: &Moffat, sigma: f64) {
        let n = psf.nrows();
        // At least 1.7 px, so that pixels sample the highest order.
        let scale =
            (HERMITE_SCALE * profile.sigma()).max(((2 * MAX_ORDER + 1) as f64).sqrt() / 3.0);
        let StarDenoiser {
            star,
            functions: [of_x, of_y],
            partial,
            ..
        } = self;
        for buffer in [&mut *of_x, &mut *of_y, &mut *partial] {
            if buffer.dim() != (MAX_ORDER + 1, n) {
                *buffer = Array2::zeros((MAX_ORDER + 1, n));
            }
        }
        let [x, y] = profile.centre();
        hermite(of_x, x, scale);
        hermite(of_y, y, scale);
        // Sums over y for each x, then over x: two products in place of one for each pair of orders.
        for k in 0..=MAX_ORDER {
            let mut row = partial.row_mut(k);
            row.fill(0.0);
            for y in 0..n {
                let weight = of_y[(k, y)];
                if weight.abs() < MIN_FUNCTION_VALUE {
                    continue;
                }
                let lines = psf.row(y).into_iter().zip(star.row(y));
                for (sum, (value, model)) in row.iter_mut().zip(lines) {
                    *sum += weight * (value - model);
                }
            }
        }
        let mut coefficients = [[0.0; MAX_ORDER + 1]; MAX_ORDER + 1];
        for (ky, line) in coefficients.iter_mut().enumerate() {
            for (kx, value) in line.iter_mut().enumerate().take(MAX_ORDER + 1 - ky) {
                *value = of_x.row(kx).dot(&partial.row(ky));
            }
        }
        shrink(&mut coefficients, sigma);
        for (ky, line) in coefficients.iter().enumerate() {
            let mut row = partial.row_mut(ky);
            row.fill(0.0);
            for (kx, coefficient) in line.iter().enumerate().take(MAX_ORDER + 1 - ky) {
                row.scaled_add(*coefficient, &of_x.row(kx));
            }
        }
        for y in 0..n {
            let mut row = star.row_mut(y);
            for k in 0..=MAX_ORDER {
                row.scaled_add(of_y[(k, y)], &partial.row(k));
            }
        }
    }
}

/// Shrinks the round coefficients together, and the others of each order.
fn shrink(coefficients: &mut Coefficients, sigma: f64) {
    let mut round = [0.0; MAX_ORDER / 2 + 1];
    for (half, value) in round.iter_mut().enumerate() {
        for k in 0..=half {
            let share = round_share(k) * round_share(half - k);
            *value += share * coefficients[2 * (half - k)][2 * k];
        }
        for k in 0..=half {
            let share = round_share(k) * round_share(half - k);
            coefficients[2 * (half - k)][2 * k] -= share * *value;
        }
    }
    let square = round.iter().map(|value| value * value).sum();
    let round_factor = stein_factor(square, round.len() as f64, sigma);
    for order in 0..=MAX_ORDER {
        let is_even = order % 2 == 0;
        let places = (0..=order).map(|kx| (order - kx, kx));
        let squares = places.clone().map(|(ky, kx)| coefficients[ky][kx].powi(2));
        // An even order has a round function, which was taken out.
        let count = if is_even { order } else { order + 1 } as f64;
        let factor = if (MAX_FITTED_ORDER + 1..=MAX_AZIMUTHAL_ORDER).contains(&order) {
            stein_factor(squares.sum(), count, sigma)
        } else {
            0.0
        };
        for (ky, kx) in places {
            coefficients[ky][kx] *= factor;
        }
        if is_even {
            for k in 0..=order / 2 {
                let share = round_share(k) * round_share(order / 2 - k);
                coefficients[2 * (order / 2 - k)][2 * k] += share * round_factor * round[order / 2];
            }
        }
    }
}

/// The shrinkage factor of `count` values with noise `sigma` and this sum of squares (James and Stein 1961).
fn stein_factor(square: f64, count: f64, sigma: f64) -> f64 {
    if square > 0.0 {
        (1.0 - (count - 2.0) * sigma * sigma / square).max(0.0)
    } else {
        0.0
    }
}

/// Share of function 2k along an axis in a round function: √(2k)!/(2ᵏ k!).
fn round_share(k: usize) -> f64 {
    (1..=k)
        .map(|i| ((2 * i - 1) as f64 / (2 * i) as f64).sqrt())
        .product()
}

fn unchanged_share(snr: f64) -> f64 {
    let [from, to] = UNCHANGED_SNR;
    let place = ((snr / from).ln() / (to / from).ln()).clamp(0.0, 1.0);
    place * place * (3.0 - 2.0 * place)
}

/// Noise of a pixel of a star, from fourth differences along the border: wings are smooth there. A median, so that a bad
/// pixel or a neighbour on the border does not count.
pub(super) fn noise_level(psf: ArrayView2<'_, f64>, moduli: &mut Vec<f32>) -> f64 {
    moduli.clear();
    each_fourth_difference(psf, |difference| moduli.push(difference.abs() as f32));
    f64::from(median(moduli).unwrap_or(0.0) * SCATTER) / DIFFERENCE_VARIANCE.sqrt()
}

fn mean_square_difference(psf: ArrayView2<'_, f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    each_fourth_difference(psf, |difference| {
        sum += difference * difference;
        count += 1.0;
    });
    sum / count / DIFFERENCE_VARIANCE
}

/// Fourth differences along the two outer lines of pixels on each side.
fn each_fourth_difference(psf: ArrayView2<'_, f64>, mut take: impl FnMut(f64)) {
    let n = psf.nrows();
    for k in [0, 1, n - 2, n - 1] {
        let (mut along_row, mut along_column) = ([0.0; 4], [0.0; 4]);
        for (at, (x, y)) in psf.row(k).iter().zip(psf.column(k)).enumerate() {
            let differences = [
                fourth_difference(&mut along_row, *x),
                fourth_difference(&mut along_column, *y),
            ];
            if at >= 4 {
                differences.into_iter().for_each(&mut take);
            }
        }
    }
}

fn fourth_difference(previous: &mut [f64; 4], value: f64) -> f64 {
    let [a, b, c, d] = *previous;
    *previous = [b, c, d, value];
    a - 4.0 * b + 6.0 * c - 4.0 * d + value
}

/// Orthonormal Gauss–Hermite functions of pixels about `centre`, a row per order.
fn hermite(functions: &mut Array2<f64>, centre: f64, scale: f64) {
    let root = (scale * std::f64::consts::PI.sqrt()).sqrt();
    for x in 0..functions.ncols() {
        let t = (x as f64 - centre) / scale;
        let mut below = 0.0;
        let mut value = (-0.5 * t * t).exp() / root;
        for k in 0..=MAX_ORDER {
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

    use super::super::testing::{drawn, noisy, power};
    use super::*;

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn sheared(profile: PsfProfile, fwhm: f64, side: usize) -> Array2<f64> {
        drawn(profile, fwhm, Shear::new(0.06, -0.04), side)
    }

    #[test]
    fn stars_without_noise_stay_as_they_are() {
        for side in [15, 32, 48, 64] {
            for fwhm in [2.0, 3.4, 6.0] {
                for profile in [MOFFAT, PsfProfile::Kolmogorov] {
                    let psf = sheared(profile, fwhm, side);
                    let mut denoiser = StarDenoiser::default();
                    assert!(
                        denoiser.denoised(psf.view()) == psf,
                        "{profile:?} {fwhm} {side}"
                    );
                }
            }
        }
        let nothing = Array2::<f64>::zeros((48, 48));
        assert_eq!(StarDenoiser::default().denoised(nothing.view()), nothing);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let bright = noisy(&sheared(MOFFAT, 3.4, 48), 2000.0, &mut rng);
        assert!(StarDenoiser::default().denoised(bright.view()) == bright);
    }

    #[test]
    fn noise_falls_and_the_mean_power_stays() {
        let waves = [[0.5, 0.0], [0.0, 0.5], [0.5, 0.5], [0.5, -0.5], [0.9, 0.0]];
        // The wing of the fit falls as r⁻³ and misses a Kolmogorov profile's light at 6 to 24 px, which noise hides.
        for (profile, snr, wings) in [
            (MOFFAT, 50.0, 0.02),
            (MOFFAT, 100.0, 0.02),
            (PsfProfile::Kolmogorov, 100.0, 0.04),
        ] {
            let psf = sheared(profile, 3.4, 48);
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            let mut denoiser = StarDenoiser::default();
            let (mut before, mut after, mut powers) = (0.0, 0.0, [0.0; 5]);
            let count = 40;
            for _ in 0..count {
                let star = noisy(&psf, snr, &mut rng);
                before += (&star - &psf).mapv(|v| v * v).sum();
                let denoised = denoiser.denoised(star.view());
                assert!((denoised.sum() - 1.0).abs() < 1e-9);
                after += (&denoised - &psf).mapv(|v| v * v).sum();
                for (sum, wave) in powers.iter_mut().zip(waves) {
                    *sum += power(denoised, wave) / f64::from(count);
                }
            }
            // About ten parameters stand for 2304 pixels.
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
        let mut psf = sheared(MOFFAT, 3.0, 48);
        let side = FunctionalPsf::new(MOFFAT, 3.0, Shear::ZERO).unwrap();
        let mut beside = Array2::zeros((48, 48));
        side.draw_into(27.0, 24.5, beside.view_mut());
        psf = psf * 0.75 + beside * 0.25;
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let star = noisy(&psf, 300.0, &mut rng);
        let mut denoiser = StarDenoiser::default();
        let denoised = denoiser.denoised(star.view());
        // How much brighter one side of the star is than the other, 5 px away along x.
        let skew = |psf: ArrayView2<'_, f64>| -> f64 {
            (20..28)
                .map(|y| psf[(y, 29)] + psf[(y, 30)] - psf[(y, 18)] - psf[(y, 19)])
                .sum()
        };
        let (found, expected) = (skew(denoised), skew(psf.view()));
        assert!((found / expected - 1.0).abs() < 0.15, "{found} {expected}");
    }

    #[test]
    fn hermite_functions_are_orthonormal_with_round_sums() {
        let mut functions = Array2::zeros((MAX_ORDER + 1, 48));
        hermite(&mut functions, 23.2, 1.8);
        let products = functions.dot(&functions.t());
        for ((i, j), product) in products.indexed_iter() {
            let expected = if i == j { 1.0 } else { 0.0 };
            // Sampling of the highest order in steps of a pixel.
            assert!((product - expected).abs() < 1e-2, "{i} {j}: {product}");
        }
        let squares: f64 = (0..=3)
            .map(|k| (round_share(k) * round_share(3 - k)).powi(2))
            .sum();
        assert!((squares - 1.0).abs() < 1e-12);
        hermite(&mut functions, 23.0, 1.8);
        // (3, 4) and (5, 0) are as far from the middle.
        let functions = functions;
        let at = |x: usize, y: usize| -> f64 {
            (0..=2)
                .map(|k| {
                    round_share(k)
                        * round_share(2 - k)
                        * functions[(2 * k, x)]
                        * functions[(4 - 2 * k, y)]
                })
                .sum()
        };
        assert!((at(26, 27) - at(28, 23)).abs() < 1e-9);
    }
}

//! Denoised stars: the Moffat profile that fits a star best, with as much of the residual as is significant.
//!
//! The residual is expanded in Gauss–Hermite functions. Those of one order span the same space in any direction, so they
//! share a shrinkage factor: Stein's 1 − (n − 2)σ²/Σc², or zero. A star of high S/N stays as it is, with a smooth
//! transition. The mean residual profile of the image's stars is added to the Moffat profile first.
//!
//! # The Moffat profile
//!
//! I = A (1 + κ s)^(−1/κ) + A w (1 + s/6)^(−3/2), with s a quadratic form about the star's centre: a Gaussian of A exp(−s)
//! for κ → 0, and a Moffat profile of β = 1/κ, with a wing. The fit takes Gauss–Newton steps with Levenberg's damping.
//!
//! # The residual profile of an image
//!
//! The fit of a noisy star relies on what is expected of stars in general, because noise hides the star's wings. The mean
//! residual over many stars shows how the stars of this image differ from that expectation. Its azimuthal mean is a
//! function of the profile's own radius √s, so that stars of any width and ellipticity share it. Azimuthal terms of order 2
//! and 4 on the pixels, such as diffraction spikes, are functions of the same radius. All are in units of the amplitude.

use std::sync::Arc;

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;
use shearq_quantities::statistics::{SCATTER, median, scatter};
use shearq_submissions::PsfCut;

use super::psfs::Psfs;
use super::star::{psf_offset, sum_of_squares};
use super::width::{gaussian_variance, noise_equivalent_area};

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

const AMPLITUDE: usize = 0; // Place of the amplitude among the parameters.
const CENTRE_X: usize = 1; // Place of the centre along x.
const CENTRE_Y: usize = 2; // Place of the centre along y.
const LOG_WIDTH: usize = 3; // Place of the logarithm of the width w of s = r²/w².
const E1: usize = 4; // Place of the first component of the ellipticity.
const E2: usize = 5; // Place of the second component.
const KAPPA: usize = 6; // Place of κ.
const WING: usize = 7; // Place of the wing's amplitude, in units of the core's.
const PARAMETERS: usize = 8;

// κ = 1/β that is expected of a star, and its standard deviation.
// β = 3 to 4.8 of Moffat and Kolmogorov profiles. Loose: a star of S/N 50 determines κ to about 0.06.
const KAPPA_PRIOR: [f64; 2] = [0.25, 0.2];
// Below zero the core ends, as in an Airy disc. Chosen by hand.
const KAPPA_BOUNDS: [f64; 2] = [-0.2, 0.7];
// Amplitude of the wing that is expected, and its standard deviation.
// About 2 % and 7 % of the light. Chosen by hand for Moffat, Kolmogorov and Airy profiles.
const WING_PRIOR: [f64; 2] = [0.002, 0.006];
// Square of the scale of the wing in units of the core's. Chosen by hand.
const WING_SQUARE: f32 = 6.0;
// Half the side of the square of the fit, in units of the Gaussian σ of the star's area.
// 15 px for a FWHM of 3.4 px. Chosen by hand.
const FIT_HALF_SIDE: f64 = 8.0;
// Chosen by hand.
const MAX_STEPS: usize = 12;
// Change of χ² at which the fit ends. A tenth of the error of a parameter, and above the rounding of single precision.
const CONVERGED_CHI2: f64 = 1e-2;
// One vector of AVX2.
const LANES: usize = 8;
// Base of the power at which a profile with κ < 0 ends. Within single precision.
const MIN_BASE: f32 = 1e-6;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moffat {
    values: [f64; PARAMETERS],
}

/// Sums over pixels in each lane, in units of the amplitude: of the squared residual, of derivatives with the residual, and
/// of derivatives with each other up to the diagonal.
#[derive(Clone, Copy)]
struct Products {
    square: [f32; LANES],
    gradient: [[f32; LANES]; PARAMETERS],
    curvature: [[[f32; LANES]; PARAMETERS]; PARAMETERS],
}

impl Products {
    const ZERO: Products = Products {
        square: [0.0; LANES],
        gradient: [[0.0; LANES]; PARAMETERS],
        curvature: [[[0.0; LANES]; PARAMETERS]; PARAMETERS],
    };
}

/// χ² with the priors, and its derivatives.
struct ChiSquare {
    value: f64,
    gradient: [f64; PARAMETERS],
    curvature: [[f64; PARAMETERS]; PARAMETERS],
}

impl Moffat {
    /// Fits a star near `centre` with a noise-equivalent area of `area` px² and noise `sigma`; `None` if the fit diverges.
    pub(super) fn fit(
        star: ArrayView2<'_, f64>,
        centre: [f64; 2],
        area: f64,
        sigma: f64,
    ) -> Option<Moffat> {
        // A Gaussian of mean square σ² has s = r²/(2σ²).
        let mean_square = gaussian_variance(area);
        let half_side = FIT_HALF_SIDE * mean_square.sqrt();
        let width = 0.5 * (2.0 * mean_square).ln();
        let sum = star.sum();
        let mut at = Moffat {
            values: [0.0; PARAMETERS],
        };
        at.values[AMPLITUDE] = sum / (2.0 * std::f64::consts::PI * mean_square);
        [at.values[CENTRE_X], at.values[CENTRE_Y]] = centre;
        at.values[LOG_WIDTH] = width;
        at.values[KAPPA] = KAPPA_PRIOR[0];
        let mut chi2 = at.chi_square(star, centre, half_side, sigma);
        let mut damping = 1e-3;
        for _ in 0..MAX_STEPS {
            let step = damped_step(&chi2, damping)?;
            let mut next = at;
            for (value, step) in next.values.iter_mut().zip(step) {
                *value += step;
            }
            let kappa = &mut next.values[KAPPA];
            *kappa = kappa.clamp(KAPPA_BOUNDS[0], KAPPA_BOUNDS[1]);
            // The power is not defined at κ = 0, where the profile is a Gaussian to rounding.
            if kappa.abs() < 1e-3 {
                *kappa = 1e-3;
            }
            let ellipticity = next.values[E1].hypot(next.values[E2]);
            let moved =
                (next.values[CENTRE_X] - centre[0]).hypot(next.values[CENTRE_Y] - centre[1]);
            let is_star =
                ellipticity < 0.9 && moved < 4.0 && (next.values[LOG_WIDTH] - width).abs() < 1.5;
            let found = is_star.then(|| next.chi_square(star, centre, half_side, sigma));
            match found {
                Some(found) if found.value <= chi2.value => {
                    let gain = chi2.value - found.value;
                    (at, chi2) = (next, found);
                    damping *= 0.1;
                    if gain < CONVERGED_CHI2 {
                        return (at.values[AMPLITUDE] > 0.0).then_some(at);
                    }
                }
                _ => damping = (damping * 10.0).max(1e-3),
            }
        }
        (at.values[AMPLITUDE] > 0.0 && at.values.iter().all(|value| value.is_finite()))
            .then_some(at)
    }

    pub(super) fn amplitude(&self) -> f64 {
        self.values[AMPLITUDE]
    }

    /// (x, y) in pixels from the first.
    pub(super) fn centre(&self) -> [f64; 2] {
        [self.values[CENTRE_X], self.values[CENTRE_Y]]
    }

    /// The form s at (x, y) in pixels from the first.
    pub(super) fn square(&self) -> impl Fn(f64, f64) -> f64 {
        let [_, x0, y0, width, e1, e2, ..] = self.values;
        let scale = (-2.0 * width).exp();
        move |x, y| {
            let (dx, dy) = (x - x0, y - y0);
            // Not negative: ellipticities are below 0.9.
            scale * ((1.0 - e1) * dx * dx + (1.0 + e1) * dy * dy - 2.0 * e2 * dx * dy)
        }
    }

    /// Mean σ of the Gaussian that the profile is at its centre.
    pub(super) fn sigma(&self) -> f64 {
        self.values[LOG_WIDTH].exp() * std::f64::consts::FRAC_1_SQRT_2
    }

    pub(super) fn draw(&self, mut to: ArrayViewMut2<'_, f64>) {
        let (n, single) = (to.ncols(), self.single());
        for (y, mut row) in to.rows_mut().into_iter().enumerate() {
            for x in (0..n).step_by(LANES) {
                let values = drawn(&single, x as f32, y as f32);
                for (value, drawn) in row.iter_mut().skip(x).zip(values) {
                    *value = self.values[AMPLITUDE] * f64::from(drawn);
                }
            }
        }
    }

    /// In single precision, with the scale 1/w² in place of the logarithm of the width.
    fn single(&self) -> [f32; PARAMETERS] {
        let mut single = self.values.map(|value| value as f32);
        single[LOG_WIDTH] = (-2.0 * self.values[LOG_WIDTH]).exp() as f32;
        single
    }

    fn chi_square(
        &self,
        star: ArrayView2<'_, f64>,
        centre: [f64; 2],
        half_side: f64,
        sigma: f64,
    ) -> ChiSquare {
        let range = |at: f64, side: usize| {
            let first = (at - half_side).ceil().max(0.0) as usize;
            let last = ((at + half_side).floor().max(0.0) as usize + 1).min(side);
            first.min(last)..last
        };
        let single = self.single();
        let mut products = Products::ZERO;
        let columns = range(centre[0], star.ncols());
        for y in range(centre[1], star.nrows()) {
            for x in columns.clone().step_by(LANES) {
                let (mut values, mut weights) = ([0.0; LANES], [0.0; LANES]);
                for lane in 0..LANES.min(columns.end - x) {
                    values[lane] = (star[(y, x + lane)] / self.values[AMPLITUDE]) as f32;
                    weights[lane] = 1.0;
                }
                add(
                    &single,
                    [x as f32, y as f32],
                    &values,
                    &weights,
                    &mut products,
                );
            }
        }
        let total = |lanes: [f32; LANES]| {
            let sum: f64 = lanes.into_iter().map(f64::from).sum();
            sum * (self.values[AMPLITUDE] / sigma).powi(2)
        };
        let mut chi2 = ChiSquare {
            value: total(products.square),
            gradient: products.gradient.map(total),
            curvature: [[0.0; PARAMETERS]; PARAMETERS],
        };
        // The derivative with the amplitude is in units of it.
        let unit = |i: usize| {
            if i == AMPLITUDE {
                1.0 / self.values[AMPLITUDE]
            } else {
                1.0
            }
        };
        for i in 0..PARAMETERS {
            chi2.gradient[i] *= unit(i);
            for j in 0..=i {
                chi2.curvature[i][j] = total(products.curvature[i][j]) * unit(i) * unit(j);
                chi2.curvature[j][i] = chi2.curvature[i][j];
            }
        }
        for (i, [mean, error]) in [(KAPPA, KAPPA_PRIOR), (WING, WING_PRIOR)] {
            let off = self.values[i] - mean;
            chi2.value += (off / error).powi(2);
            chi2.gradient[i] -= off / (error * error);
            chi2.curvature[i][i] += 1.0 / (error * error);
        }
        chi2
    }
}

/// The profile of amplitude one at pixels from (x, y) on.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn drawn(single: &[f32; PARAMETERS], x: f32, y: f32) -> [f32; LANES] {
    let [_, x0, y0, scale, e1, e2, kappa, wing] = *single;
    let dy = y - y0;
    let mut values = [0.0; LANES];
    for (lane, value) in values.iter_mut().enumerate() {
        let dx = x + lane as f32 - x0;
        let s = scale * (dx * dx + dy * dy - e1 * (dx * dx - dy * dy) - e2 * 2.0 * dx * dy);
        let base = 1.0 + kappa * s;
        let (core, _) = core(base, 1.0 / kappa);
        *value = core * pixel(base, s, kappa, scale) + wing * tail(s).0;
    }
    values
}

/// Adds the products of pixels from `at` on, whose `values` are in units of the amplitude.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add(
    single: &[f32; PARAMETERS],
    at: [f32; 2],
    values: &[f32; LANES],
    weights: &[f32; LANES],
    sums: &mut Products,
) {
    let [_, x0, y0, scale, e1, e2, kappa, wing] = *single;
    let dy = at[1] - y0;
    let inverse = 1.0 / kappa;
    let mut by = [[0.0f32; LANES]; PARAMETERS];
    let mut residual = [0.0f32; LANES];
    for lane in 0..LANES {
        let dx = at[0] + lane as f32 - x0;
        let (across, along) = (dx * dx - dy * dy, 2.0 * dx * dy);
        let s = scale * (dx * dx + dy * dy - e1 * across - e2 * along);
        let base = 1.0 + kappa * s;
        let (core, log) = core(base, inverse);
        let (tail, tail_slope) = tail(s);
        let core_slope = -core / base.max(MIN_BASE);
        let slope = core_slope + wing * tail_slope;
        let weight = weights[lane];
        let mean = core * pixel(base, s, kappa, scale);
        by[AMPLITUDE][lane] = weight * (mean + wing * tail);
        by[CENTRE_X][lane] = weight * slope * -2.0 * scale * ((1.0 - e1) * dx - e2 * dy);
        by[CENTRE_Y][lane] = weight * slope * -2.0 * scale * ((1.0 + e1) * dy - e2 * dx);
        by[LOG_WIDTH][lane] = weight * -2.0 * slope * s;
        by[E1][lane] = weight * -slope * scale * across;
        by[E2][lane] = weight * -slope * scale * along;
        by[KAPPA][lane] = weight * (core * log * inverse + s * core_slope) * inverse;
        by[WING][lane] = weight * tail;
        residual[lane] = weight * (values[lane] - mean - wing * tail);
    }
    let take = |sum: &mut [f32; LANES], a: &[f32; LANES], b: &[f32; LANES]| {
        for lane in 0..LANES {
            sum[lane] += a[lane] * b[lane];
        }
    };
    take(&mut sums.square, &residual, &residual);
    for i in 0..PARAMETERS {
        take(&mut sums.gradient[i], &by[i], &residual);
        for j in 0..=i {
            take(&mut sums.curvature[i][j], &by[i], &by[j]);
        }
    }
}

#[inline(always)]
fn tail(s: f32) -> (f32, f32) {
    let base = 1.0 + s / WING_SQUARE;
    let value = 1.0 / (base * base.sqrt());
    (value, -1.5 * value / (base * WING_SQUARE))
}

/// Mean of a core over a pixel in units of its value in the middle: 1 + ∇²f/(24 f), of a round one.
#[inline(always)]
fn pixel(base: f32, s: f32, kappa: f32, scale: f32) -> f32 {
    let inverse = 1.0 / base.max(MIN_BASE);
    1.0 + scale / 6.0 * inverse * (s * (1.0 + kappa) * inverse - 1.0)
}

/// base^(−1/κ) and the natural logarithm of base, which for κ < 0 ends at zero.
#[inline(always)]
fn core(base: f32, inverse: f32) -> (f32, f32) {
    let bits = base.max(MIN_BASE).to_bits() as i32;
    // A power of two times a number between √½ and √2.
    let exponent = (bits - 0x3f35_04f3) >> 23;
    let rest = f32::from_bits((bits - (exponent << 23)) as u32);
    let t = (rest - 1.0) / (rest + 1.0);
    let square = t * t;
    let log = 2.0 * t * (1.0 + square * (1.0 / 3.0 + square * (0.2 + square / 7.0)));
    let log = log + exponent as f32 * std::f32::consts::LN_2;
    let two = (-log * inverse * std::f32::consts::LOG2_E).clamp(-100.0, 100.0);
    // Adding 3·2²² rounds to whole numbers.
    let whole = two + 12_582_912.0;
    let power = f32::from_bits((((whole.to_bits() as i32) - 0x4b40_0000 + 127) << 23) as u32);
    let f = (two - (whole - 12_582_912.0)) * std::f32::consts::LN_2;
    let series = 1.0 / 24.0 + f * (1.0 / 120.0 + f / 720.0);
    let series = 1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * series)));
    (power * series, log)
}

fn damped_step(chi2: &ChiSquare, damping: f64) -> Option<[f64; PARAMETERS]> {
    let mut curvature = chi2.curvature;
    for (i, row) in curvature.iter_mut().enumerate() {
        row[i] *= 1.0 + damping;
    }
    let mut step = chi2.gradient;
    let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
    cholesky(&mut curvature, &mut step, PARAMETERS, positive)?;
    Some(step)
}

// Resolves the rings of an Airy disc; steps of 2 beyond √s = 4 did not.
const RADII_PER_UNIT: usize = 2;
// Up to √s = 18: 36 px for a FWHM of 3.4 px, beyond the corners of stamps of 48 px. Constant beyond.
const RADII: usize = 37;
// The azimuthal mean, and cosine and sine of two and four times the angle: a halo of another ellipticity, and spikes.
const TERMS: usize = 5;
// Azimuthal terms are free at every second radius, which halves their noise; halos and spikes need no more.
const AZIMUTHAL_STRIDE: usize = 2;
// One image in a thousand has such an excess by noise.
const AZIMUTHAL_SIGNIFICANCE: f64 = 3.0;
// With fewer, the 72 values of the azimuthal terms are as uncertain as for one star.
const MIN_STARS_AZIMUTHAL: usize = 100;
// For radii that no pixel has, which get zero; far below the rounding of others.
const RELATIVE_RIDGE: f64 = 1e-9;
const PAIRS: usize = TERMS * (TERMS + 1) / 2;
const UNKNOWNS: usize = RADII * TERMS;

#[derive(Debug, Clone, PartialEq)]
pub struct ResidualProfiles {
    /// For each range of S/N its lower end and the residual profile of its stars. The first also serves fainter stars.
    pub(super) ranges: Vec<(f64, ResidualProfile)>,
}

impl ResidualProfiles {
    pub(super) fn at_snr(&self, snr: f64) -> &ResidualProfile {
        let above = self.ranges.partition_point(|(from, _)| *from <= snr);
        &self.ranges[above.saturating_sub(1)].1
    }
}

/// Functions of the radius √s of a Moffat profile, in units of its amplitude, linear between the radii.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ResidualProfile {
    values: [[f64; TERMS]; RADII],
    terms: usize,
}

impl ResidualProfile {
    /// Adds it to a star that `profile` was drawn on.
    pub(super) fn add_to(&self, mut star: ArrayViewMut2<'_, f64>, profile: &Moffat) {
        let amplitude = profile.amplitude();
        let (square, [x0, y0]) = (profile.square(), profile.centre());
        for (y, mut row) in star.rows_mut().into_iter().enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let (x, y) = (x as f64, y as f64);
                let (at, share) = interval(square(x, y).sqrt());
                let [inner, outer] = [self.values[at], self.values[at + 1]];
                let mut sum = inner[0] + share * (outer[0] - inner[0]);
                if self.terms > 1 {
                    let terms = azimuthal_terms(x - x0, y - y0);
                    for k in 1..self.terms {
                        sum += terms[k] * (inner[k] + share * (outer[k] - inner[k]));
                    }
                }
                *value += amplitude * sum;
            }
        }
    }
}

/// Sums of the normal equations for a residual profile. Only neighbouring radii have products.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ResidualSums {
    /// Mean square and sum of the residual over all pixels of a star, in units of the noise: they show outlier stars.
    pub(super) moments: [f64; 2],
    squares: [[f64; PAIRS]; RADII],
    /// Products with the terms at the previous radius, which are symmetric.
    products: [[f64; PAIRS]; RADII],
    right: [[f64; TERMS]; RADII],
}

impl Default for ResidualSums {
    fn default() -> Self {
        ResidualSums {
            moments: [0.0; 2],
            squares: [[0.0; PAIRS]; RADII],
            products: [[0.0; PAIRS]; RADII],
            right: [[0.0; TERMS]; RADII],
        }
    }
}

impl ResidualSums {
    /// Of a star with noise `sigma` and the profile that fits it, which is drawn in `model`.
    pub(super) fn from_star(
        star: ArrayView2<'_, f64>,
        model: ArrayView2<'_, f64>,
        profile: &Moffat,
        sigma: f64,
    ) -> Self {
        let mut sums = ResidualSums::default();
        let amplitude = profile.amplitude();
        // Stars of equal S/N count alike whatever their width and flux.
        let weight = (amplitude / sigma).powi(2);
        let (square, [x0, y0]) = (profile.square(), profile.centre());
        for (((y, x), value), model) in star.indexed_iter().zip(model) {
            let residual = (value - model) / amplitude;
            let (x, y) = (x as f64, y as f64);
            let (at, outer) = interval(square(x, y).sqrt());
            let (inner, terms) = (1.0 - outer, azimuthal_terms(x - x0, y - y0));
            let shares = [inner * inner, inner * outer, outer * outer].map(|share| weight * share);
            for i in 0..TERMS {
                for j in 0..=i {
                    let (pair, product) = (pair(i, j), terms[i] * terms[j]);
                    sums.squares[at][pair] += shares[0] * product;
                    sums.products[at + 1][pair] += shares[1] * product;
                    sums.squares[at + 1][pair] += shares[2] * product;
                }
                sums.right[at][i] += weight * inner * residual * terms[i];
                sums.right[at + 1][i] += weight * outer * residual * terms[i];
            }
            sums.moments[0] += weight * residual * residual;
            sums.moments[1] += residual * amplitude / sigma;
        }
        let pixels = star.len() as f64;
        sums.moments[0] /= pixels;
        sums.moments[1] /= pixels.sqrt();
        sums
    }

    pub(super) fn add(&mut self, other: &ResidualSums, weight: f64) {
        for (sums, more) in [
            (
                self.squares.as_flattened_mut(),
                other.squares.as_flattened(),
            ),
            (
                self.products.as_flattened_mut(),
                other.products.as_flattened(),
            ),
            (self.right.as_flattened_mut(), other.right.as_flattened()),
        ] {
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += weight * more;
            }
        }
    }

    /// The residual profile that fits `stars` stars best.
    ///
    /// The azimuthal mean is not shrunk for its noise: that is small compared with the noise of each star, and what is
    /// missing of the mean would bias all galaxies alike. Azimuthal terms are zero unless they are significant: their noise
    /// would be an ellipticity that all galaxies of the image share.
    pub(super) fn fit(&self, stars: usize) -> Option<ResidualProfile> {
        let (values, mut previous_gain) = self.solve(1)?;
        let mut found = ResidualProfile { values, terms: 1 };
        if stars < MIN_STARS_AZIMUTHAL {
            return Some(found);
        }
        let seen = self.squares.iter().skip(1).filter(|pairs| pairs[0] > 0.0);
        let freedom = (2 * seen.count() / AZIMUTHAL_STRIDE) as f64;
        for terms in [3, TERMS] {
            let (values, gain) = self.solve(terms)?;
            // The variance of a sum of n squares of noise is 2n.
            if gain - previous_gain - freedom > AZIMUTHAL_SIGNIFICANCE * (2.0 * freedom).sqrt() {
                found = ResidualProfile { values, terms };
            }
            previous_gain = gain;
        }
        Some(found)
    }

    /// The values that fit best if only the first `terms` are not zero, and by how much they lower χ².
    fn solve(&self, terms: usize) -> Option<([[f64; TERMS]; RADII], f64)> {
        let squares = self.squares.iter().map(|pairs| pairs[0]);
        let ridge = RELATIVE_RIDGE * squares.fold(0.0, f64::max);
        let mut matrix: Box<[[f64; UNKNOWNS]; UNKNOWNS]> =
            vec![[0.0; UNKNOWNS]; UNKNOWNS].try_into().ok()?;
        let mut right = [0.0; UNKNOWNS];
        let mut add = |(at, i): (usize, usize), (before, j): (usize, usize), sum: f64| {
            for (row, first) in knots(at, i, terms) {
                for (column, second) in knots(before, j, terms) {
                    matrix[row][column] += first * second * sum;
                }
            }
        };
        for at in 0..RADII {
            for i in 0..terms {
                for j in 0..terms {
                    let pair = pair(i, j);
                    add((at, i), (at, j), self.squares[at][pair]);
                    if at > 0 {
                        let sum = self.products[at][pair];
                        add((at, i), (at - 1, j), sum);
                        add((at - 1, j), (at, i), sum);
                    }
                }
                for (row, share) in knots(at, i, terms) {
                    right[row] += share * self.right[at][i];
                }
            }
        }
        for (k, row) in matrix.iter_mut().enumerate() {
            row[k] += ridge;
        }
        let mut solution = right;
        let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
        cholesky(&mut matrix, &mut solution, RADII * terms, positive)?;
        let gain = solution.iter().zip(right).map(|(a, b)| a * b).sum();
        let values = std::array::from_fn(|at| {
            std::array::from_fn(|term| {
                let parts = knots(at, term, terms);
                parts.map(|(row, share)| share * solution[row]).sum()
            })
        });
        Some((values, gain))
    }
}

#[inline(always)]
fn pair(i: usize, j: usize) -> usize {
    let (low, high) = (i.min(j), i.max(j));
    high * (high + 1) / 2 + low
}

/// The unknowns from which the value of a term at a radius is interpolated, with their shares. At the centre there is no
/// angle, so that azimuthal terms are zero there.
fn knots(at: usize, term: usize, terms: usize) -> impl Iterator<Item = (usize, f64)> {
    let stride = if term == 0 { 1 } else { AZIMUTHAL_STRIDE };
    let (before, after) = (at / stride * stride, at % stride);
    let share = after as f64 / stride as f64;
    let parts = [(before, 1.0 - share), (before + stride, share)];
    parts.into_iter().filter_map(move |(knot, share)| {
        let is_free = term < terms && share > 0.0 && (term == 0 || knot > 0);
        is_free.then_some((knot * terms + term, share))
    })
}

/// The radius at or before √s, and the share of the next one in the interpolation.
#[inline(always)]
fn interval(radius: f64) -> (usize, f64) {
    let steps = RADII_PER_UNIT as f64 * radius;
    let at = (steps as usize).min(RADII - 2);
    (at, (steps - at as f64).min(1.0))
}

/// One, and cosine and sine of two and four times the position angle; zero at the centre.
#[inline(always)]
fn azimuthal_terms(dx: f64, dy: f64) -> [f64; TERMS] {
    let square = dx * dx + dy * dy;
    let share = if square > 0.0 { 1.0 / square } else { 0.0 };
    let (cos, sin) = (share * (dx * dx - dy * dy), share * 2.0 * dx * dy);
    [1.0, cos, sin, cos * cos - sin * sin, 2.0 * cos * sin]
}

// 12 stars of S/N 50 per image: m1, m2 = +1.6, +2.0 ± 0.2 (10⁻³); they are −7 without a residual profile.
const MIN_STARS: usize = 10;
// Measuring 1,000 stars without noise takes a quarter of the time of an image of 3,600 galaxies.
const MAX_NOISELESS_STARS: usize = 100;
// Fainter fits are of noise. Chosen by hand.
const MIN_SNR: f64 = 5.0;
// Obscured Airy discs of S/N 30 to 300 in one image: m = −0.02 if all share one residual profile.
const SNR_RATIO: f64 = 2.0;
// At most one of 1,000 good stars is rejected by chance. Stars with a neighbour or a background are beyond it.
const OUTLIER_SIGNIFICANCE: f64 = 5.0;

/// The stars of an image, one per galaxy, and buffers to measure them. Threads measure parts of the stars in surveys of
/// their own, which are joined in the order of the stars.
#[derive(Debug)]
pub struct StarSurvey {
    cut: PsfCut,
    full: usize,
    denoiser: StarDenoiser,
    surveyed: usize,
    /// S/N and residual of each noisy star, with its number.
    noisy: Vec<(usize, f64, ResidualSums)>,
}

impl StarSurvey {
    /// Of stars that `cut` cuts, for galaxies on stamps of `full` pixels a side.
    pub(crate) fn new(cut: PsfCut, full: usize) -> Self {
        StarSurvey {
            cut,
            full,
            denoiser: StarDenoiser::default(),
            surveyed: 0,
            noisy: Vec::new(),
        }
    }

    /// Measures the star of galaxy `k`. Stars that cannot be used, and formulas, have no noise.
    pub fn add(&mut self, psfs: &Psfs<'_>, k: usize) {
        let star = psfs.at(k, self.cut, self.full).ok();
        let found = star.and_then(|star| self.denoiser.residual(star.psf.view()));
        self.push(found);
    }

    fn push(&mut self, found: Option<(f64, ResidualSums)>) {
        let found = found.filter(|(snr, _)| *snr >= MIN_SNR);
        let number = self.surveyed;
        self.noisy
            .extend(found.map(|(snr, sums)| (number, snr, sums)));
        self.surveyed += 1;
    }

    /// Adds the stars of a later part, up to the star after which no more are needed: the result does not depend on how
    /// threads divide the stars.
    pub fn join(&mut self, part: StarSurvey) {
        let mut noisy = part.noisy.into_iter().peekable();
        for number in 0..part.surveyed {
            if self.is_over() {
                return;
            }
            let found = noisy.next_if(|(at, ..)| *at == number);
            self.push(found.map(|(_, snr, sums)| (snr, sums)));
        }
    }

    pub fn is_over(&self) -> bool {
        self.surveyed >= MAX_NOISELESS_STARS && self.noisy.is_empty()
    }

    /// The mean residual profiles of the stars; `None` if too few of them have noise.
    pub fn residual_profiles(self) -> Option<Arc<ResidualProfiles>> {
        let mut noisy: Vec<_> = self
            .noisy
            .into_iter()
            .map(|(_, snr, sums)| (snr, sums))
            .collect();
        // A stable sort, so that stars of equal S/N stay in their order.
        noisy.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        // Copies of a star have their noise in common.
        noisy.dedup_by(|a, b| a == b);
        let (mut ranges, mut rest) = (Vec::new(), noisy.as_slice());
        while rest.len() >= MIN_STARS {
            let lowest = rest[0].0;
            let within = rest.partition_point(|(snr, _)| *snr <= SNR_RATIO * lowest);
            let mut count = within.max(MIN_STARS);
            if rest.len() - count < MIN_STARS {
                count = rest.len();
            }
            ranges.push((lowest, mean_residual(&rest[..count])?));
            rest = &rest[count..];
        }
        (!ranges.is_empty()).then(|| Arc::new(ResidualProfiles { ranges }))
    }
}

/// The mean residual of stars in the order of their S/N, without outlier stars.
fn mean_residual(stars: &[(f64, ResidualSums)]) -> Option<ResidualProfile> {
    let is_typical = |moment: usize| {
        let mut moments: Vec<f64> = stars.iter().map(|(_, sums)| sums.moments[moment]).collect();
        let (median, scatter) = scatter(&mut moments)?;
        Some(move |sums: &ResidualSums| {
            (sums.moments[moment] - median).abs() <= OUTLIER_SIGNIFICANCE * scatter
        })
    };
    // The mean square shows neighbours and bad pixels, the sum a background far below the noise of a pixel.
    let (in_square, in_sum) = (is_typical(0)?, is_typical(1)?);
    let highest = SNR_RATIO * stars[0].0;
    let mut all = ResidualSums::default();
    for (snr, sums) in stars {
        if in_square(sums) && in_sum(sums) {
            // The few stars beyond the range would outweigh the others.
            all.add(sums, (highest / snr).powi(2).min(1.0));
        }
    }
    all.fit(stars.len())
}

#[cfg(test)]
impl ResidualProfile {
    pub(super) fn terms(&self) -> usize {
        self.terms
    }

    /// Largest difference to another one, in units of the largest value of that one.
    pub(super) fn difference(&self, other: &Self) -> f64 {
        let largest = |largest: f64, value: f64| largest.max(value.abs());
        let [own, other] = [self, other].map(|profile| profile.values.as_flattened());
        let difference = own.iter().zip(other).map(|(a, b)| a - b).fold(0.0, largest);
        difference / other.iter().copied().fold(0.0, largest)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Axis};
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

    const N: usize = 48;

    #[test]
    fn radii_have_the_mean_residual_of_profiles() {
        let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::new(0.04, -0.03));
        let star = psf.unwrap().stamp(N);
        let area = noise_equivalent_area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        // Any functions that are linear between the radii are found again.
        let wave = |term: usize, k: usize| match (term, k) {
            (1.., 0) => 0.0,
            _ => 0.01 * ((2 * term + 1) as f64 * k as f64 / 6.0).sin(),
        };
        let values = std::array::from_fn(|k| {
            std::array::from_fn(|term| {
                let between = if term == 0 { 0 } else { k % 2 };
                0.5 * (wave(term, k - between) + wave(term, k + between))
            })
        });
        let residual = ResidualProfile {
            values,
            terms: TERMS,
        };
        let mut model = Array2::zeros((N, N));
        profile.draw(model.view_mut());
        let mut star = model.clone();
        residual.add_to(star.view_mut(), &profile);
        let sums = ResidualSums::from_star(star.view(), model.view(), &profile, 1e-7);
        let found = sums.fit(MIN_STARS_AZIMUTHAL).unwrap();
        let farthest = profile.square()(0.0, 0.0).sqrt() * RADII_PER_UNIT as f64;
        let seen = (farthest as usize).min(RADII - 1);
        assert!(seen > 20, "{seen}");
        for (k, (found, value)) in found.values.iter().zip(&values).enumerate().take(seen) {
            for (term, (found, value)) in found.iter().zip(value).enumerate() {
                // Few pixels are nearer than √s = 2: their angles do not separate the terms.
                if term == 0 || k >= 4 {
                    // The relative addition to the equations, and radii with few pixels.
                    assert!((found - value).abs() < 1e-4, "{k} {term} {found} {value}");
                }
            }
        }
        assert_eq!(interval(0.75), (1, 0.5));
        assert_eq!(interval(17.75), (35, 0.5));
        assert_eq!(interval(40.0), (35, 1.0));
    }

    #[test]
    fn azimuthal_terms_are_free_at_every_second_radius() {
        let all = (0..RADII).flat_map(|at| (1..TERMS).map(move |term| (at, term)));
        let mut free: Vec<usize> = all
            .flat_map(|(at, term)| knots(at, term, TERMS).map(|(unknown, _)| unknown))
            .collect();
        free.sort_unstable();
        free.dedup();
        // Eighteen radii beyond the centre, of two orders with cosine and sine.
        assert_eq!(free.len(), 72);
    }

    #[test]
    fn azimuthal_terms_of_three_standard_deviations_are_kept() {
        let star = drawn(MOFFAT, 3.4, Shear::ZERO, N);
        let area = noise_equivalent_area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        let halo = Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5, y as f64 - 23.5);
            star[(23, 23)] * 1e-3 * azimuthal_terms(x, y)[1] * (-(x * x + y * y) / 72.0).exp()
        });
        let sums = ResidualSums::from_star((&star + &halo).view(), star.view(), &profile, 1e-4);
        let gain = sums.solve(3).unwrap().1 - sums.solve(1).unwrap().1;
        // Both terms of order 2 at every second of the radii with pixels.
        let seen = sums.squares.iter().skip(1).filter(|pairs| pairs[0] > 0.0);
        let freedom = seen.count() as f64;
        let terms = |deviations: f64| {
            let mut scaled = ResidualSums::default();
            scaled.add(
                &sums,
                (freedom + deviations * (2.0 * freedom).sqrt()) / gain,
            );
            scaled.fit(MIN_STARS_AZIMUTHAL).unwrap().terms
        };
        assert_eq!([terms(2.5), terms(3.5)], [1, 3]);
    }

    #[test]
    fn azimuthal_terms_have_orders_two_and_four() {
        let angle = 0.3f64;
        let found = azimuthal_terms(5.0 * angle.cos(), 5.0 * angle.sin());
        let wave = |order: f64| [(order * angle).cos(), (order * angle).sin()];
        let expected = [[1.0].as_slice(), &wave(2.0), &wave(4.0)].concat();
        for (found, expected) in found.iter().zip(expected) {
            // Rounding.
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
        assert_eq!(azimuthal_terms(0.0, 0.0), [1.0, 0.0, 0.0, 0.0, 0.0]);
    }

    const CUT: PsfCut = PsfCut {
        size: N,
        least: 32,
        centred: false,
    };

    /// Stars of different widths and ellipticities with an S/N, and the same without noise.
    fn stars(profile: PsfProfile, snr: f64, count: usize) -> (Array3<f64>, Vec<Array2<f64>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let true_ones: Vec<_> = (0..count)
            .map(|k| {
                let shear = Shear::new(0.04 * (k % 3) as f64, -0.03);
                drawn(profile, 2.8 + 0.25 * (k % 5) as f64, shear, N)
            })
            .collect();
        let mut stars = Array3::zeros((count, N, N));
        for (psf, mut star) in true_ones.iter().zip(stars.outer_iter_mut()) {
            star.assign(&noisy(psf, snr, &mut rng));
        }
        (stars, true_ones)
    }

    fn profiles(stars: &Array3<f64>) -> Option<Arc<ResidualProfiles>> {
        survey(stars).residual_profiles()
    }

    fn survey(stars: &Array3<f64>) -> StarSurvey {
        let (mut survey, psfs) = (StarSurvey::new(CUT, N), Psfs::stars(stars.view()));
        (0..stars.len_of(Axis(0))).for_each(|k| survey.add(&psfs, k));
        survey
    }

    #[test]
    fn residual_profiles_restore_wings_that_noise_hides() {
        for (profile, without) in [
            (PsfProfile::Kolmogorov, 0.03..0.06),
            (PsfProfile::Moffat { beta: 3.0 }, -0.02..0.01),
        ] {
            let (noisy, true_ones) = stars(profile, 100.0, 300);
            let found = profiles(&noisy);
            // Mean of the relative error of the power.
            let mean = |profiles: Option<&Arc<ResidualProfiles>>| {
                let mut denoiser = StarDenoiser::default();
                denoiser.set_residual_profiles(profiles);
                let wave = [0.5, 0.0];
                let pairs = noisy.outer_iter().zip(&true_ones);
                let ratios = pairs.map(|(star, psf)| {
                    power(denoiser.denoised(star), wave) / power(psf.view(), wave) - 1.0
                });
                ratios.sum::<f64>() / true_ones.len() as f64
            };
            let (plain, shared) = (mean(None), mean(found.as_ref()));
            assert!(without.contains(&plain), "{profile:?} {plain}");
            // Powers of single stars scatter by 4/(S/N); this is four errors of their mean.
            assert!(shared.abs() < 0.01, "{profile:?} {shared}");
        }
    }

    #[test]
    fn outlier_stars_are_rejected() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 40);
        let without = profiles(&noisy.slice(ndarray::s![..39, .., ..]).to_owned());
        let [mut hot, mut level] = [&noisy, &noisy].map(Clone::clone);
        hot[(39, 20, 30)] += 0.5;
        // A background of half the noise, which changes the square by a fraction of the noise's own.
        let one = noisy.index_axis(Axis(0), 39);
        let background = 0.005 * one.iter().map(|v| v * v).sum::<f64>().sqrt();
        level
            .index_axis_mut(Axis(0), 39)
            .map_inplace(|value| *value += background);
        // Stripes of twice the noise change the square and not the sum.
        let mut stripes = noisy.clone();
        let mut last = stripes.index_axis_mut(Axis(0), 39);
        for ((y, x), value) in last.indexed_iter_mut() {
            let far = y.abs_diff(24).max(x.abs_diff(24));
            if (14..20).contains(&far) {
                *value += if x % 2 == 0 { 4.0 } else { -4.0 } * background;
            }
        }
        for (name, stars) in [("hot", hot), ("level", level), ("stripes", stripes)] {
            let with = survey(&stars);
            assert_eq!(with.noisy.len(), 40, "{name}");
            assert_eq!(with.residual_profiles(), without, "{name}");
        }
    }

    #[test]
    fn copies_of_a_star_count_once() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 20);
        let twice = ndarray::concatenate![Axis(0), noisy, noisy];
        assert_eq!(profiles(&twice), profiles(&noisy));
        let one = noisy.slice(ndarray::s![..1, .., ..]);
        let copies = ndarray::concatenate(Axis(0), &[one; 40]).unwrap();
        assert_eq!(profiles(&copies), None);
    }

    #[test]
    fn significant_azimuthal_terms_of_many_stars_are_kept() {
        // Terms of stars with light that varies with the angle, in units of the peak.
        let terms = |times: f64, count: usize| {
            let (mut noisy, _) = stars(PsfProfile::Moffat { beta: 3.0 }, 100.0, count);
            for mut star in noisy.outer_iter_mut() {
                let peak = star.iter().copied().fold(0.0, f64::max);
                for ((y, x), value) in star.indexed_iter_mut() {
                    let (dx, dy) = (x as f64 - 23.5, y as f64 - 23.5);
                    let fall = (-(dx * dx + dy * dy) / 72.0).exp();
                    *value += 0.01 * peak * fall * (times * dy.atan2(dx)).cos();
                }
            }
            profiles(&noisy).unwrap().at_snr(100.0).terms()
        };
        assert_eq!([terms(2.0, 120), terms(4.0, 120)], [3, 5]);
        // Too few stars, and three times the angle, which is no term.
        assert_eq!([terms(4.0, 99), terms(3.0, 120)], [1, 1]);
    }

    #[test]
    fn stars_share_the_residual_of_their_signal_to_noise() {
        let (faint, _) = stars(PsfProfile::Kolmogorov, 50.0, 30);
        let (bright, _) = stars(PsfProfile::Kolmogorov, 300.0, 30);
        let both = Array3::from_shape_fn((60, N, N), |(k, y, x)| {
            let stars = [&faint, &bright][k % 2];
            stars[(k / 2, y, x)]
        });
        let [faint, bright_ones] = [&faint, &bright].map(profiles);
        let both = profiles(&both).unwrap();
        let [(low, first), (high, second)] = &both.ranges[..] else {
            panic!("{} ranges", both.ranges.len());
        };
        // The faintest of thirty of different widths.
        assert!(
            (30.0..50.0).contains(low) && (230.0..300.0).contains(high),
            "{low} {high}"
        );
        assert_eq!(first, &faint.unwrap().ranges[0].1);
        assert_eq!(second, &bright_ones.unwrap().ranges[0].1);
        for (snr, function) in [
            (20.0, first),
            (60.0, first),
            (200.0, first),
            (400.0, second),
        ] {
            assert_eq!(both.at_snr(snr), function, "{snr}");
        }
        assert_ne!(first, second);
        // A bright star gets the function of bright ones.
        let star = bright.index_axis(Axis(0), 0);
        let denoised = |profiles: ResidualProfiles| {
            let mut denoiser = StarDenoiser::default();
            denoiser.set_residual_profiles(Some(&Arc::new(profiles)));
            denoiser.denoised(star).to_owned()
        };
        let ranges = vec![both.ranges[1].clone()];
        assert_eq!(
            denoised((*both).clone()),
            denoised(ResidualProfiles { ranges })
        );
    }

    #[test]
    fn a_few_bright_stars_do_not_outweigh_the_others() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 50.0, 40);
        let (bright, _) = stars(PsfProfile::Moffat { beta: 3.0 }, 400.0, 3);
        let with = ndarray::concatenate![Axis(0), noisy, bright];
        let (with, without) = (profiles(&with), profiles(&noisy));
        let [with, without] = [with.unwrap(), without.unwrap()];
        assert_eq!(with.ranges.len(), 1);
        // Three of S/N 90 next to forty of 50. Without a limit the bright ones would have 83 % of the weight.
        let share = with.at_snr(50.0).difference(without.at_snr(50.0));
        assert!(share > 0.0 && share < 0.4, "{share}");
    }

    #[test]
    fn few_or_noiseless_stars_have_no_residual_profile() {
        let (noisy, true_ones) = stars(PsfProfile::Kolmogorov, 100.0, MIN_STARS);
        let some = |count: usize| noisy.slice(ndarray::s![..count, .., ..]).to_owned();
        assert_eq!(profiles(&some(MIN_STARS - 1)), None);
        assert!(profiles(&some(MIN_STARS)).is_some());
        let mut clean = some(MIN_STARS);
        for (psf, mut star) in true_ones.iter().zip(clean.outer_iter_mut()) {
            star.assign(psf);
        }
        let clean = survey(&clean);
        assert!(clean.noisy.is_empty() && clean.residual_profiles().is_none());
        let (faint, _) = stars(PsfProfile::Kolmogorov, 4.0, 30);
        assert!(
            survey(&faint)
                .noisy
                .iter()
                .all(|(_, snr, _)| *snr >= MIN_SNR)
        );
    }

    #[test]
    fn a_survey_ends_after_noiseless_stars_however_it_is_divided() {
        let star = |snr: f64| Some((snr, ResidualSums::default()));
        let mut stars = vec![None; MAX_NOISELESS_STARS];
        stars.push(star(50.0));
        // A noisy star among the first ones, and after them.
        let mut early = stars.clone();
        early[MAX_NOISELESS_STARS - 1] = star(40.0);
        for (stars, expected) in [(stars, 0), (early, 2)] {
            for size in [1, 7, 60, 200] {
                let mut survey = StarSurvey::new(CUT, N);
                for part in stars.chunks(size) {
                    let mut own = StarSurvey::new(CUT, N);
                    part.iter().for_each(|found| own.push(found.clone()));
                    survey.join(own);
                }
                assert_eq!(survey.noisy.len(), expected, "{size}");
                assert_eq!(survey.is_over(), expected == 0, "{size}");
            }
        }
    }
}

//! A star with less noise: the Moffat profile that fits best, and of what is left as much as is significant.
//!
//! What is left is expanded in Gauss–Hermite functions. Those of one order, which span the same space in any direction, are
//! shrunk together: with Stein's factor 1 − (n − 2)σ²/Σc², or to nothing. A star of high S/N is left as it is, with a
//! smooth transition.

use ndarray::{Array2, ArrayView2};

use super::breadth;
use super::moffat::Moffat;
use super::star;
use shearq_quantities::statistics::{SCATTER, median};

/// S/N between which a star is used more and more as it is. See docs/constants.md.
const AS_IT_IS: [f64; 2] = [500.0, 1000.0];
/// Highest order of the functions of what a profile leaves. See docs/constants.md.
const ORDER: usize = 10;
/// Orders that are shrunk together with the lowest, which the fit leaves hardly anything of. See docs/constants.md.
const LOW: usize = 2;
/// Scale of the functions in units of the σ of the profile's core. See docs/constants.md.
const SCALE: f64 = 1.1;
/// Side from which on the border is free of the star's light. See docs/constants.md.
const LEAST_SIDE: usize = 24;
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
}

impl Shrinker {
    /// The star `psf` of sum one with as little noise as can be: as it is if it has hardly any.
    pub(crate) fn shrunk<'a>(&'a mut self, psf: ArrayView2<'a, f64>) -> ArrayView2<'a, f64> {
        let n = psf.nrows();
        if n != psf.ncols() || n < LEAST_SIDE {
            return psf;
        }
        let power: f64 = psf.iter().map(|value| value * value).sum();
        // Hardly ever below the noise's, and quick.
        let least = power.sqrt() / AS_IT_IS[1];
        if !(mean_square(psf) > 0.25 * least * least) {
            return psf;
        }
        let sigma = self.noise(psf);
        let snr = (power - psf.len() as f64 * sigma * sigma).max(0.0).sqrt() / sigma;
        if !(snr < AS_IT_IS[1]) {
            return psf;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let place = star::place(psf).map(|off| middle + off);
        let area = breadth::area(psf);
        if !(area > 0.0 && area.is_finite()) {
            return psf;
        }
        let Some(profile) = Moffat::fit(psf, place, area, sigma) else {
            return psf;
        };
        if self.star.dim() != psf.dim() {
            self.star = Array2::zeros(psf.dim());
        }
        profile.draw(self.star.view_mut());
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
        let mut first = 0;
        for last in LOW..=ORDER {
            let (mut square, mut count) = (0.0, 0.0);
            let within = |kx: usize, ky: usize| (first..=last).contains(&(kx + ky));
            for ky in 0..=ORDER {
                for kx in (0..=ORDER).filter(|&kx| within(kx, ky)) {
                    square += coefficients[ky][kx] * coefficients[ky][kx];
                    count += 1.0;
                }
            }
            let factor = if square > 0.0 {
                (1.0 - (count - 2.0) * sigma * sigma / square).max(0.0)
            } else {
                0.0
            };
            for ky in 0..=ORDER {
                for kx in (0..=ORDER).filter(|&kx| within(kx, ky)) {
                    coefficients[ky][kx] *= factor;
                }
            }
            first = last + 1;
        }
        for ky in 0..=ORDER {
            let mut row = partial.row_mut(ky);
            row.fill(0.0);
            for kx in 0..=ORDER - ky {
                row.scaled_add(coefficients[ky][kx], &across.row(kx));
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
        for at in 0..n - 4 {
            let fourth = |v: [f64; 5]| v[0] - 4.0 * v[1] + 6.0 * v[2] - 4.0 * v[3] + v[4];
            take(fourth([0, 1, 2, 3, 4].map(|i| psf[(k, at + i)])));
            take(fourth([0, 1, 2, 3, 4].map(|i| psf[(at + i, k)])));
        }
    }
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

//! The Moffat profile that fits a star best.
//!
//! I = A (1 + κ s)^(−1/κ) + A w (1 + s/6)^(−3/2), with s a quadratic form about the star's centre: a Gaussian of A exp(−s)
//! for κ → 0, and a Moffat profile of β = 1/κ, with a wing. The fit takes Gauss–Newton steps with Levenberg's damping.

use multiversion::multiversion;
use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;

use super::width::gaussian_variance;

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

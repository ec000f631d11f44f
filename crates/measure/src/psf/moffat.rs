//! An elliptical Moffat profile that fits a star.
//!
//! I = A (1 + κ s)^(−1/κ), with s a quadratic form about the star's place: a Gaussian of A exp(−s) for κ → 0, and a Moffat
//! profile of β = 1/κ. Gauss and Newton's steps, damped after Levenberg.

use multiversion::multiversion;
use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;

/// Parameters: amplitude, place, width, the two ellipticities and κ.
pub(super) const PARAMETERS: usize = 8;
/// κ = 1/β that is expected of a star, and its standard deviation. See docs/constants.md.
const EXPECTED: [f64; 2] = [0.25, 0.2];
/// Bounds of κ. See docs/constants.md.
const BOUNDS: [f64; 2] = [-0.2, 0.7];
/// Amplitude of the wing that is expected, in units of the core's, and its standard deviation. See
/// docs/constants.md.
const WING: [f64; 2] = [0.002, 0.006];
/// Square of the scale of the wing in units of the core's. See docs/constants.md.
const BROAD: f32 = 6.0;
/// Half the side of the square of the fit, in units of the Gaussian σ of the star's area. See docs/constants.md.
const REACH: f64 = 8.0;
/// Most steps of a fit. See docs/constants.md.
const STEPS: usize = 12;
/// Change of χ² by a step, at which the fit ends. See docs/constants.md.
const SMALL: f64 = 1e-2;
/// Pixels that are summed side by side. See docs/constants.md.
const LANES: usize = 8;
/// Base of the power of a profile with κ < 0 at which it ends.
const LEAST_BASE: f32 = 1e-6;

/// An elliptical Moffat profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moffat {
    /// Amplitude; place (x, y) in pixels from the first; logarithm of the width of s = r²/w²; ellipticities; κ.
    values: [f64; PARAMETERS],
}

/// Sums of products over pixels in each lane, in units of the amplitude.
#[derive(Clone, Copy)]
struct Products {
    /// Of what is left, squared.
    square: [f32; LANES],
    /// Of derivatives with what is left.
    gradient: [[f32; LANES]; PARAMETERS],
    /// Of derivatives with each other, up to the diagonal.
    curvature: [[[f32; LANES]; PARAMETERS]; PARAMETERS],
}

impl Products {
    const ZERO: Products = Products {
        square: [0.0; LANES],
        gradient: [[0.0; LANES]; PARAMETERS],
        curvature: [[[0.0; LANES]; PARAMETERS]; PARAMETERS],
    };
}

/// Sums for a step: of squares, and their derivatives.
struct Sums {
    square: f64,
    gradient: [f64; PARAMETERS],
    curvature: [[f64; PARAMETERS]; PARAMETERS],
}

impl Moffat {
    /// The profile that fits a star at `place` with a noise-equivalent area of `area` px² and noise `sigma` best; `None`
    /// if there is none.
    pub(super) fn fit(
        star: ArrayView2<'_, f64>,
        place: [f64; 2],
        area: f64,
        sigma: f64,
    ) -> Option<Moffat> {
        // A Gaussian of mean square σ² has an area of 4πσ², and s = r²/(2σ²).
        let mean_square = area / (4.0 * std::f64::consts::PI);
        let reach = REACH * mean_square.sqrt();
        let width = 0.5 * (2.0 * mean_square).ln();
        let sum = star.sum();
        let mut at = Moffat {
            values: [
                sum / (2.0 * std::f64::consts::PI * mean_square),
                place[0],
                place[1],
                width,
                0.0,
                0.0,
                EXPECTED[0],
                0.0,
            ],
        };
        let mut sums = at.sums(star, place, reach, sigma);
        let mut damping = 1e-3;
        for _ in 0..STEPS {
            let step = solve(&sums, damping)?;
            let mut next = at;
            for (value, step) in next.values.iter_mut().zip(step) {
                *value += step;
            }
            next.values[6] = next.values[6].clamp(BOUNDS[0], BOUNDS[1]);
            if next.values[6].abs() < 1e-3 {
                next.values[6] = 1e-3;
            }
            let round = next.values[4].hypot(next.values[5]);
            let near = (next.values[1] - place[0]).hypot(next.values[2] - place[1]);
            let usable = round < 0.9 && near < 4.0 && (next.values[3] - width).abs() < 1.5;
            let found = usable.then(|| next.sums(star, place, reach, sigma));
            match found {
                Some(found) if found.square <= sums.square => {
                    let gain = sums.square - found.square;
                    (at, sums) = (next, found);
                    damping *= 0.1;
                    if gain < SMALL {
                        return (at.values[0] > 0.0).then_some(at);
                    }
                }
                _ => damping = (damping * 10.0).max(1e-3),
            }
        }
        (at.values[0] > 0.0 && at.values.iter().all(|value| value.is_finite())).then_some(at)
    }

    /// Its amplitude.
    pub(super) fn amplitude(&self) -> f64 {
        self.values[0]
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

    /// Its place (x, y) in pixels from the first.
    pub(super) fn place(&self) -> [f64; 2] {
        [self.values[1], self.values[2]]
    }

    /// Mean σ of the Gaussian that it is in the middle.
    pub(super) fn sigma(&self) -> f64 {
        self.values[3].exp() * std::f64::consts::FRAC_1_SQRT_2
    }

    /// Draws it at the centres of pixels.
    pub(super) fn draw(&self, mut to: ArrayViewMut2<'_, f64>) {
        let (n, single) = (to.ncols(), self.single());
        for (y, mut row) in to.rows_mut().into_iter().enumerate() {
            for x in (0..n).step_by(LANES) {
                let values = drawn(&single, x as f32, y as f32);
                for (value, drawn) in row.iter_mut().skip(x).zip(values) {
                    *value = self.values[0] * f64::from(drawn);
                }
            }
        }
    }

    fn single(&self) -> [f32; PARAMETERS] {
        let mut single = self.values.map(|value| value as f32);
        single[3] = (-2.0 * self.values[3]).exp() as f32;
        single
    }

    fn sums(&self, star: ArrayView2<'_, f64>, middle: [f64; 2], reach: f64, sigma: f64) -> Sums {
        let range = |at: f64, side: usize| {
            let first = (at - reach).ceil().max(0.0) as usize;
            let last = ((at + reach).floor().max(0.0) as usize + 1).min(side);
            first.min(last)..last
        };
        let single = self.single();
        let mut products = Products::ZERO;
        let columns = range(middle[0], star.ncols());
        for y in range(middle[1], star.nrows()) {
            for x in columns.clone().step_by(LANES) {
                let (mut values, mut weights) = ([0.0; LANES], [0.0; LANES]);
                for lane in 0..LANES.min(columns.end - x) {
                    values[lane] = (star[(y, x + lane)] / self.values[0]) as f32;
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
            sum * (self.values[0] / sigma).powi(2)
        };
        let mut sums = Sums {
            square: total(products.square),
            gradient: products.gradient.map(total),
            curvature: [[0.0; PARAMETERS]; PARAMETERS],
        };
        // The derivative with the amplitude is in units of it.
        let unit = |i: usize| if i == 0 { 1.0 / self.values[0] } else { 1.0 };
        for i in 0..PARAMETERS {
            sums.gradient[i] *= unit(i);
            for j in 0..=i {
                sums.curvature[i][j] = total(products.curvature[i][j]) * unit(i) * unit(j);
                sums.curvature[j][i] = sums.curvature[i][j];
            }
        }
        let [kappa, wing] = [self.values[6], self.values[7]];
        for (i, off, error) in [
            (6, kappa - EXPECTED[0], EXPECTED[1]),
            (7, wing - WING[0], WING[1]),
        ] {
            sums.square += (off / error).powi(2);
            sums.gradient[i] -= off / (error * error);
            sums.curvature[i][i] += 1.0 / (error * error);
        }
        sums
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

/// Adds the products of a step for pixels from `at` on: of `values` in units of the amplitude.
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
    let mut left = [0.0f32; LANES];
    for lane in 0..LANES {
        let dx = at[0] + lane as f32 - x0;
        let (across, along) = (dx * dx - dy * dy, 2.0 * dx * dy);
        let s = scale * (dx * dx + dy * dy - e1 * across - e2 * along);
        let base = 1.0 + kappa * s;
        let (core, log) = core(base, inverse);
        let (tail, tail_slope) = tail(s);
        let core_slope = -core / base.max(LEAST_BASE);
        let slope = core_slope + wing * tail_slope;
        let weight = weights[lane];
        let mean = core * pixel(base, s, kappa, scale);
        by[0][lane] = weight * (mean + wing * tail);
        by[1][lane] = weight * slope * -2.0 * scale * ((1.0 - e1) * dx - e2 * dy);
        by[2][lane] = weight * slope * -2.0 * scale * ((1.0 + e1) * dy - e2 * dx);
        by[3][lane] = weight * -2.0 * slope * s;
        by[4][lane] = weight * -slope * scale * across;
        by[5][lane] = weight * -slope * scale * along;
        by[6][lane] = weight * (core * log * inverse + s * core_slope) * inverse;
        by[7][lane] = weight * tail;
        left[lane] = weight * (values[lane] - mean - wing * tail);
    }
    let take = |sum: &mut [f32; LANES], a: &[f32; LANES], b: &[f32; LANES]| {
        for lane in 0..LANES {
            sum[lane] += a[lane] * b[lane];
        }
    };
    take(&mut sums.square, &left, &left);
    for i in 0..PARAMETERS {
        take(&mut sums.gradient[i], &by[i], &left);
        for j in 0..=i {
            take(&mut sums.curvature[i][j], &by[i], &by[j]);
        }
    }
}

/// The wing of a core of scale one, and its derivative with s.
#[inline(always)]
fn tail(s: f32) -> (f32, f32) {
    let base = 1.0 + s / BROAD;
    let value = 1.0 / (base * base.sqrt());
    (value, -1.5 * value / (base * BROAD))
}

/// Mean of a core over a pixel in units of its value in the middle: 1 + ∇²f/(24 f), of a round one.
#[inline(always)]
fn pixel(base: f32, s: f32, kappa: f32, scale: f32) -> f32 {
    let inverse = 1.0 / base.max(LEAST_BASE);
    1.0 + scale / 6.0 * inverse * (s * (1.0 + kappa) * inverse - 1.0)
}

/// base^(−1/κ) and the natural logarithm of base, which for κ < 0 ends at zero.
#[inline(always)]
fn core(base: f32, inverse: f32) -> (f32, f32) {
    let bits = base.max(LEAST_BASE).to_bits() as i32;
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

/// The step that lowers the sum of squares, by Cholesky's decomposition.
fn solve(sums: &Sums, damping: f64) -> Option<[f64; PARAMETERS]> {
    let mut curvature = sums.curvature;
    for (i, row) in curvature.iter_mut().enumerate() {
        row[i] *= 1.0 + damping;
    }
    let mut step = sums.gradient;
    let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
    cholesky(&mut curvature, &mut step, PARAMETERS, positive)?;
    Some(step)
}

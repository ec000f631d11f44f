//! An elliptical Moffat profile that fits a star.
//!
//! I = A (1 + κ s)^(−1/κ), with s a quadratic form about the star's place: a Gaussian of A exp(−s) for κ → 0, and a Moffat
//! profile of β = 1/κ. Gauss and Newton's steps, damped after Levenberg.

use ndarray::{ArrayView2, ArrayViewMut2};

/// Parameters: amplitude, place, width, the two ellipticities and κ.
pub(super) const PARAMETERS: usize = 7;
/// κ that is expected, and its standard deviation. See docs/constants.md.
const EXPECTED: [f64; 2] = [0.28, 0.12];
/// Bounds of κ. See docs/constants.md.
const BOUNDS: [f64; 2] = [0.01, 0.7];
/// Half the side of the square of the fit, in units of the Gaussian σ of the star's area. See docs/constants.md.
const REACH: f64 = 6.0;
/// Most steps of a fit. See docs/constants.md.
const STEPS: usize = 12;
/// Change of χ² by a step, at which the fit ends. See docs/constants.md.
const SMALL: f64 = 1e-3;

/// An elliptical Moffat profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moffat {
    /// Amplitude; place (x, y) in pixels from the first; logarithm of the width of s = r²/w²; ellipticities; κ.
    values: [f64; PARAMETERS],
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
        let [amplitude, x0, y0, width, e1, e2, kappa] = self.values;
        let scale = (-2.0 * width).exp();
        for ((y, x), value) in to.indexed_iter_mut() {
            let (dx, dy) = (x as f64 - x0, y as f64 - y0);
            let s = scale * ((1.0 - e1) * dx * dx - 2.0 * e2 * dx * dy + (1.0 + e1) * dy * dy);
            *value = amplitude * (-(kappa * s).ln_1p() / kappa).exp();
        }
    }

    fn sums(&self, star: ArrayView2<'_, f64>, middle: [f64; 2], reach: f64, sigma: f64) -> Sums {
        let [amplitude, x0, y0, width, e1, e2, kappa] = self.values;
        let scale = (-2.0 * width).exp();
        let range = |at: f64, side: usize| {
            let first = (at - reach).ceil().max(0.0) as usize;
            let last = ((at + reach).floor().max(0.0) as usize + 1).min(side);
            first.min(last)..last
        };
        let mut sums = Sums {
            square: 0.0,
            gradient: [0.0; PARAMETERS],
            curvature: [[0.0; PARAMETERS]; PARAMETERS],
        };
        let weight = 1.0 / (sigma * sigma);
        for y in range(middle[1], star.nrows()) {
            for x in range(middle[0], star.ncols()) {
                let (dx, dy) = (x as f64 - x0, y as f64 - y0);
                let (across, along) = (dx * dx - dy * dy, 2.0 * dx * dy);
                let s = scale * (dx * dx + dy * dy - e1 * across - e2 * along);
                let base = 1.0 + kappa * s;
                let log = base.ln();
                let unit = (-log / kappa).exp();
                let value = amplitude * unit;
                let slope = -value / base;
                let by_x = -2.0 * scale * ((1.0 - e1) * dx - e2 * dy);
                let by_y = -2.0 * scale * ((1.0 + e1) * dy - e2 * dx);
                let by = [
                    unit,
                    slope * by_x,
                    slope * by_y,
                    -2.0 * slope * s,
                    -slope * scale * across,
                    -slope * scale * along,
                    value * (log / kappa - s / base) / kappa,
                ];
                let left = star[(y, x)] - value;
                sums.square += left * left;
                for i in 0..PARAMETERS {
                    sums.gradient[i] += left * by[i];
                    for j in 0..=i {
                        sums.curvature[i][j] += by[i] * by[j];
                    }
                }
            }
        }
        sums.square *= weight;
        for i in 0..PARAMETERS {
            sums.gradient[i] *= weight;
            for j in 0..=i {
                sums.curvature[i][j] *= weight;
                sums.curvature[j][i] = sums.curvature[i][j];
            }
        }
        let [expected, error] = EXPECTED;
        let off = (kappa - expected) / error;
        sums.square += off * off;
        sums.gradient[6] -= off / error;
        sums.curvature[6][6] += 1.0 / (error * error);
        sums
    }
}

/// The step that lowers the sum of squares, by Cholesky's decomposition.
fn solve(sums: &Sums, damping: f64) -> Option<[f64; PARAMETERS]> {
    let mut root = [[0.0; PARAMETERS]; PARAMETERS];
    for i in 0..PARAMETERS {
        for j in 0..=i {
            let more = if i == j { 1.0 + damping } else { 1.0 };
            let known: f64 = (0..j).map(|k| root[i][k] * root[j][k]).sum();
            let rest = more * sums.curvature[i][j] - known;
            if i == j {
                if !(rest > 0.0 && rest.is_finite()) {
                    return None;
                }
                root[i][i] = rest.sqrt();
            } else {
                root[i][j] = rest / root[j][j];
            }
        }
    }
    let mut step = sums.gradient;
    for i in 0..PARAMETERS {
        let known: f64 = (0..i).map(|k| root[i][k] * step[k]).sum();
        step[i] = (step[i] - known) / root[i][i];
    }
    for i in (0..PARAMETERS).rev() {
        let known: f64 = (i + 1..PARAMETERS).map(|k| root[k][i] * step[k]).sum();
        step[i] = (step[i] - known) / root[i][i];
    }
    Some(step)
}

//! Quadrupole moments of an autocorrelation under a Gaussian weight of matched ellipticity.
//!
//! The weight has the fixed size σ and the ellipticity χ of the galaxy itself,
//!
//! ```text
//! W = exp(−q/2),  q = [(1 − χ₁)x² + (1 + χ₁)y² − 2χ₂xy] / (√(1 − |χ|²) σ²),
//! ```
//!
//! and χ is where the weighted moments (Eqs. 13 and 14) have the ellipticity of the weight, found by
//! Newton's method (Bernstein & Jarvis 2002 do this to images; an autocorrelation needs no centring,
//! and the noise at zero lag does not enter). The same derivatives give the response of χ to a change
//! of the autocorrelation.

use multiversion::multiversion;
use shearq_scoring::Distortion;

use super::Unmeasurable;

/// Most Newton steps.
const MAX_STEPS: usize = 30;
/// Largest |χ| of a weight.
const MAX_MODULUS: f32 = 0.98;
/// Longest Newton step.
const MAX_STEP: f32 = 0.3;
/// Change of χ at which the iteration ends: what sums of a few hundred f32 terms resolve.
const CONVERGED: f32 = 3e-6;
/// Lags reach to this many σ of the weight.
const REACH: f64 = 4.0;
/// Lags summed side by side.
const LANES: usize = 16;

/// Moments for one size of weight.
#[derive(Debug, Clone)]
pub struct AdaptiveMoments {
    sigma: f32,
    reach: usize,
    /// Places in the autocorrelation, of half the plane; filled up with zero weights.
    at: Vec<u32>,
    /// Two for a lag that stands for its opposite too, one for zero lag, zero for filling.
    count: Vec<f32>,
    /// x² + y², x² − y² and 2xy.
    bases: [Vec<f32>; 3],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct AdaptiveScratch {
    values: Vec<f32>,
}

/// What was found on an autocorrelation.
#[derive(Debug, Clone, Copy)]
pub struct AdaptiveShape {
    /// χ.
    pub distortion: Distortion,
    /// Weighted Qxx + Qyy in px².
    pub size: f64,
    /// Ellipticity of the weight, which is χ.
    chi: [f32; 2],
    /// Weighted sum of x² + y².
    trace: f32,
    /// (1 − ∂m/∂χ)⁻¹.
    inverse: [[f32; 2]; 2],
}

/// Weighted sums over lags: 1, the bases a, b, c, and the products aa, ab, ac, bb, bc, cc.
type Sums = [f32; 10];

impl AdaptiveMoments {
    /// Largest lag that a weight of `sigma` px needs.
    pub fn reach(sigma: f64) -> usize {
        (REACH * sigma).ceil() as usize
    }

    /// Plans for a weight of `sigma` px and autocorrelations with lags up to
    /// [`AdaptiveMoments::reach`].
    pub fn new(sigma: f64) -> Self {
        let reach = Self::reach(sigma);
        let side = reach as i32;
        let most = (REACH * sigma).powi(2);
        let mut moments = AdaptiveMoments {
            sigma: sigma as f32,
            reach,
            at: Vec::new(),
            count: Vec::new(),
            bases: Default::default(),
        };
        for y in 0..=side {
            for x in -side..=side {
                if (y == 0 && x < 0) || f64::from(x * x + y * y) > most {
                    continue;
                }
                let at = (y * (2 * side + 1) + x + side) as u32;
                let count = if x == 0 && y == 0 { 1.0 } else { 2.0 };
                moments.push(at, count, [x * x + y * y, x * x - y * y, 2 * x * y]);
            }
        }
        while !moments.at.len().is_multiple_of(LANES) {
            moments.push(0, 0.0, [0; 3]);
        }
        moments
    }

    fn push(&mut self, at: u32, count: f32, bases: [i32; 3]) {
        self.at.push(at);
        self.count.push(count);
        for (basis, value) in self.bases.iter_mut().zip(bases) {
            basis.push(value as f32);
        }
    }

    /// Buffers that fit.
    pub fn scratch(&self) -> AdaptiveScratch {
        AdaptiveScratch {
            values: vec![0.0; self.at.len()],
        }
    }

    /// Finds χ of `acf`, laid out as [`crate::deconvolve::Lags`].
    ///
    /// # Errors
    /// Where no ellipticity matches: the weighted moments are not positive, or the iteration does not
    /// settle.
    pub fn measure(
        &self,
        acf: &[f32],
        scratch: &mut AdaptiveScratch,
    ) -> Result<AdaptiveShape, Unmeasurable> {
        debug_assert_eq!(acf.len(), (self.reach + 1) * (2 * self.reach + 1));
        self.gather(acf, &mut scratch.values);
        let mut chi = [0.0f32; 2];
        for _ in 0..MAX_STEPS {
            let s = self.sums(&scratch.values, chi);
            let [all, t, n1, n2, ..] = s;
            if !(t > 0.0 && t.is_finite()) {
                return Err(Unmeasurable::NoExtent);
            }
            let moment = [n1 / t, n2 / t];
            let rest = [moment[0] - chi[0], moment[1] - chi[1]];
            let slope = self.derivative(&s, chi, moment);
            let [[a, b], [c, d]] = [
                [1.0 - slope[0][0], -slope[0][1]],
                [-slope[1][0], 1.0 - slope[1][1]],
            ];
            let determinant = a * d - b * c;
            if determinant.is_nan() || determinant.abs() < 1e-3 {
                return Err(Unmeasurable::NoExtent);
            }
            let inverse = [
                [d / determinant, -b / determinant],
                [-c / determinant, a / determinant],
            ];
            let mut step = [
                inverse[0][0] * rest[0] + inverse[0][1] * rest[1],
                inverse[1][0] * rest[0] + inverse[1][1] * rest[1],
            ];
            let length = step[0].hypot(step[1]);
            if length < CONVERGED {
                return Ok(AdaptiveShape {
                    distortion: Distortion::new(f64::from(chi[0]), f64::from(chi[1])),
                    size: f64::from(t / all),
                    chi,
                    trace: t,
                    inverse,
                });
            }
            let short = (MAX_STEP / length).min(1.0);
            step = step.map(|s| s * short);
            chi = [chi[0] + step[0], chi[1] + step[1]];
            let modulus = chi[0].hypot(chi[1]);
            if modulus > MAX_MODULUS {
                chi = chi.map(|e| e * MAX_MODULUS / modulus);
            }
        }
        Err(Unmeasurable::NoExtent)
    }

    /// Change of χ with a change `change` of the autocorrelation that `shape` was found on.
    pub fn response(
        &self,
        shape: &AdaptiveShape,
        change: &[f32],
        scratch: &mut AdaptiveScratch,
    ) -> [f64; 2] {
        self.gather(change, &mut scratch.values);
        let [_, t, n1, n2, ..] = self.sums(&scratch.values, shape.chi);
        let moved = [
            (n1 - shape.chi[0] * t) / shape.trace,
            (n2 - shape.chi[1] * t) / shape.trace,
        ];
        shape
            .inverse
            .map(|row| f64::from(row[0] * moved[0] + row[1] * moved[1]))
    }

    fn gather(&self, acf: &[f32], values: &mut [f32]) {
        for ((value, &at), &count) in values.iter_mut().zip(&self.at).zip(&self.count) {
            *value = acf[at as usize] * count;
        }
    }

    fn sums(&self, values: &[f32], chi: [f32; 2]) -> Sums {
        let [a, b, c] = &self.bases;
        weighted_sums(values, a, b, c, chi, self.scale(chi))
    }

    /// 1/(√(1 − |χ|²) σ²).
    fn scale(&self, chi: [f32; 2]) -> f32 {
        let rest = 1.0 - chi[0] * chi[0] - chi[1] * chi[1];
        1.0 / (rest.sqrt() * self.sigma * self.sigma)
    }

    /// ∂m_i/∂χ_j of the moments' ellipticity m with that of the weight.
    fn derivative(&self, s: &Sums, chi: [f32; 2], moment: [f32; 2]) -> [[f32; 2]; 2] {
        let [_, t, _, _, aa, ab, ac, bb, bc, cc] = *s;
        let k = self.scale(chi);
        let rest = 1.0 - chi[0] * chi[0] - chi[1] * chi[1];
        // Σ A W q·(a, b, c), for q = k(a − χ₁b − χ₂c).
        let q = |xa: f32, xb: f32, xc: f32| k * (xa - chi[0] * xb - chi[1] * xc);
        let (qa, qb, qc) = (q(aa, ab, ac), q(ab, bb, bc), q(ac, bc, cc));
        // ∂W/∂χ_j = ½W[k·(b, c)_j − q χ_j/(1 − |χ|²)].
        let with = [[ab, bb, bc], [ac, bc, cc]];
        let mut slope = [[0.0; 2]; 2];
        for j in 0..2 {
            let turn = chi[j] / rest;
            let dt = 0.5 * (k * with[j][0] - turn * qa);
            let d1 = 0.5 * (k * with[j][1] - turn * qb);
            let d2 = 0.5 * (k * with[j][2] - turn * qc);
            slope[0][j] = (d1 - moment[0] * dt) / t;
            slope[1][j] = (d2 - moment[1] * dt) / t;
        }
        slope
    }
}

/// exp(−x) for x ≥ 0, to 2e-7 of its value: 2 to the whole and to the broken part of an exponent.
#[inline(always)]
fn exp_minus(x: f32) -> f32 {
    let t = x.min(80.0) * std::f32::consts::LOG2_E;
    let whole = t as i32;
    let u = (whole as f32 - t) * std::f32::consts::LN_2;
    // exp(u) for −ln 2 < u ≤ 0 by its series.
    let series = 1.0
        + u * (1.0
            + u * (1.0 / 2.0
                + u * (1.0 / 6.0
                    + u * (1.0 / 24.0
                        + u * (1.0 / 120.0 + u * (1.0 / 720.0 + u * (1.0 / 5040.0)))))));
    series * f32::from_bits(((127 - whole) as u32) << 23)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weighted_sums(
    values: &[f32],
    a: &[f32],
    b: &[f32],
    c: &[f32],
    chi: [f32; 2],
    scale: f32,
) -> Sums {
    let mut lanes = [[0.0f32; LANES]; 10];
    let chunks = values
        .chunks_exact(LANES)
        .zip(a.chunks_exact(LANES))
        .zip(b.chunks_exact(LANES))
        .zip(c.chunks_exact(LANES));
    for (((v, a), b), c) in chunks {
        let mut w = [0.0f32; LANES];
        for l in 0..LANES {
            let q = scale * (a[l] - chi[0] * b[l] - chi[1] * c[l]);
            w[l] = v[l] * exp_minus(0.5 * q);
        }
        for l in 0..LANES {
            let (wa, wb, wc) = (w[l] * a[l], w[l] * b[l], w[l] * c[l]);
            lanes[0][l] += w[l];
            lanes[1][l] += wa;
            lanes[2][l] += wb;
            lanes[3][l] += wc;
            lanes[4][l] += wa * a[l];
            lanes[5][l] += wa * b[l];
            lanes[6][l] += wa * c[l];
            lanes[7][l] += wb * b[l];
            lanes[8][l] += wb * c[l];
            lanes[9][l] += wc * c[l];
        }
    }
    lanes.map(|lane| lane.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Autocorrelation of a Gaussian galaxy of distortion (e1, e2) and Qxx + Qyy = size.
    fn gaussian(reach: usize, size: f64, e1: f64, e2: f64) -> Vec<f32> {
        let (qxx, qyy, qxy) = (
            0.5 * size * (1.0 + e1),
            0.5 * size * (1.0 - e1),
            0.5 * size * e2,
        );
        let det = qxx * qyy - qxy * qxy;
        let side = reach as i32;
        let mut acf = Vec::new();
        for y in 0..=side {
            for x in -side..=side {
                let (x, y) = (f64::from(x), f64::from(y));
                let q = (x * x * qyy + y * y * qxx - 2.0 * x * y * qxy) / det;
                acf.push((-0.5 * q).exp() as f32);
            }
        }
        acf
    }

    #[test]
    fn the_distortion_of_a_gaussian_is_found_with_its_sign_whatever_its_size() {
        let moments = AdaptiveMoments::new(4.0);
        let mut scratch = moments.scratch();
        for size in [8.0, 16.0, 60.0] {
            for (e1, e2) in [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.4), (0.0, -0.6), (0.5, 0.5)] {
                scratch.values.fill(f32::NAN);
                let acf = gaussian(AdaptiveMoments::reach(4.0), size, e1, e2);
                let shape = moments.measure(&acf, &mut scratch).unwrap();
                // The cut at 16 px leaves out, along the major axis of weight times galaxy, moment
                // beyond r of its σ, a share of about r² exp(−r²/2)/3; sampling adds less than 1e-3.
                let e = e1.hypot(e2);
                let weight = 16.0 * (1.0 + e) / (1.0 - e * e).sqrt();
                let square = 256.0 * (1.0 / weight + 2.0 / (size * (1.0 + e)));
                let tolerance = 1e-3 + square * (-0.5 * square).exp() / 3.0;
                let apart = (shape.distortion.e1 - e1).hypot(shape.distortion.e2 - e2);
                assert!(
                    apart < tolerance,
                    "{size} {e1} {e2}: {:?}, {tolerance}",
                    shape.distortion
                );
            }
        }
    }

    #[test]
    fn the_response_is_the_finite_difference() {
        let moments = AdaptiveMoments::new(3.0);
        let mut scratch = moments.scratch();
        let reach = AdaptiveMoments::reach(3.0);
        let acf = gaussian(reach, 20.0, 0.3, -0.2);
        let other = gaussian(reach, 14.0, -0.1, 0.4);
        let shape = moments.measure(&acf, &mut scratch).unwrap();
        let response = moments.response(&shape, &other, &mut scratch);
        let mut moved = |h: f32| {
            let acf: Vec<f32> = acf.iter().zip(&other).map(|(a, o)| a + h * o).collect();
            moments.measure(&acf, &mut scratch).unwrap().distortion
        };
        let (plus, minus) = (moved(0.01), moved(-0.01));
        let slope = [(plus.e1 - minus.e1) / 0.02, (plus.e2 - minus.e2) / 0.02];
        for (found, expected) in response.iter().zip(slope) {
            // f32 resolves χ to 3e-6, divided by 0.02; the third derivative is smaller.
            assert!((found - expected).abs() < 5e-4, "{found} {expected}");
        }
    }

    #[test]
    fn exp_minus_is_exp() {
        for k in 0..4000 {
            let x = k as f32 * 0.01;
            let expected = (-x).exp();
            // Rounding of the exponent: 40 times 6e-8, and of the series.
            assert!((exp_minus(x) - expected).abs() <= 4e-6 * expected, "{x}");
        }
    }

    #[test]
    fn an_autocorrelation_without_extent_is_refused() {
        let moments = AdaptiveMoments::new(3.0);
        let lags = (AdaptiveMoments::reach(3.0) + 1) * (2 * AdaptiveMoments::reach(3.0) + 1);
        let mut scratch = moments.scratch();
        for acf in [vec![0.0; lags], vec![-1.0; lags], vec![f32::NAN; lags]] {
            assert!(moments.measure(&acf, &mut scratch).is_err());
        }
    }
}

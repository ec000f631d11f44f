//! Standard errors of the metrics of a set, from the part of its averaged field that the truth does not explain.
//!
//! A jackknife over images misses scatter that all images share, such as equal intrinsic shapes, and it is noisy
//! with few images. The averaged field contains both. With the E modes E, their truth T and m of the
//! cross-correlation, the scatter power is ν = ⟨|E − (1 + m)T|²⟩ in rings of |ℓ|, from noise and shapes alike.
//! For B modes it is ν_B = ⟨|B|²⟩. The formulae assume Gaussian scatter on a fixed truth. Opposite modes are
//! conjugates. With s = (1 + m)T and P_b = Σ w|E|²:
//!
//! ```text
//! var P_b      = Σ 2w²(2|s|²ν + ν²)          bandpowers; ν²·G/(G − 1) after subtracting noise measured from G groups
//! var m_cross  = Σ |T|²ν / (Σ|T|²)²
//! cov(P_b/r², P_c/r²) = δ_bc Σ 2w²(2|T|²ν/r² + ν²/r⁴) + g_b g_c var m − g_b k_c − g_c k_b
//!                r = 1 + m as measured, g_b = 2P_b/r³, k_b = Σ_b 2w|T|²ν / (r Σ|T|²)
//! var Σ_x u e₁ = n⁻⁴ Σ |U|²(cos²2φ ν + sin²2φ ν_B)   any sum over cells, U = FFT(u); sin and cos exchanged for e₂
//! ```
//!
//! M, A and the null tests are linear in bandpowers; m₁ to c₂ are sums over cells. σ_sys is a sum of moduli: each
//! term scatters like a folded normal number. A mean is the zero mode. Its scatter power is the power of E modes at
//! the lowest multipoles, because intrinsic ellipticities are B modes and have no mean. If the true shear has no
//! modes, E and B are ambiguous, and the mean of both powers is used.

use ndarray::Array2;
use shearq_quantities::fourier::Complex64;

use crate::bandpower::{BINS, Bins, SCORED};
use crate::grid::Grid;
use crate::modes::{Decomposer, Modes};
use crate::quality::bias_weights;

// Minimum significance (σ) of A for a first-order error of √A.
const MIN_A_SIGMA: f64 = 2.0;
// Number of rings of lowest |ℓ| that determine the power of the zero mode.
const ZERO_MODE_RINGS: usize = 4;

// Scatter power of E and B modes in rings of |ℓ| as wide as the bins, Nyquist rows included.
pub(crate) struct Scatter {
    ring_of: Array2<u8>,
    e: [f64; BINS],
    b: [f64; BINS],
    // E and B-mode power of the lowest rings.
    lowest: [f64; 2],
}

impl Scatter {
    pub(crate) fn new(grid: &Grid, width: f64, unexplained: &Modes) -> Self {
        let mut ring_of = Array2::from_elem((grid.n, grid.n), BINS as u8);
        let (mut e, mut b, mut count) = ([0.0; BINS], [0.0; BINS], [0.0; BINS]);
        for i in 0..grid.n {
            for j in 0..grid.n {
                if grid.frequency(i) == 0 && grid.frequency(j) == 0 {
                    continue;
                }
                let l = grid.wave(i).hypot(grid.wave(j));
                let ring = ((l - grid.l_min().0) / width).round().max(0.0) as usize;
                let at = (grid.fft_index(i), grid.fft_index(j));
                ring_of[at] = ring as u8;
                e[ring] += unexplained.e[at].norm_sqr();
                b[ring] += unexplained.b[at].norm_sqr();
                count[ring] += 1.0;
            }
        }
        let sum = |rings: &[f64; BINS]| rings[..ZERO_MODE_RINGS].iter().sum::<f64>();
        let lowest = [&e, &b].map(|power| sum(power) / sum(&count));
        for (ring, &count) in count.iter().enumerate() {
            if count > 0.0 {
                e[ring] /= count;
                b[ring] /= count;
            }
        }
        Scatter {
            ring_of,
            e,
            b,
            lowest,
        }
    }

    // The same for a truth without modes, which leaves E and B ambiguous. Only means are known then.
    pub(crate) fn of_one_kind(self) -> Self {
        Scatter {
            lowest: [0.5 * (self.lowest[0] + self.lowest[1]); 2],
            ..self
        }
    }

    // (ν, ν_B) of a mode. For the zero mode both are the E-mode power of the lowest rings.
    fn at(&self, mode: (usize, usize)) -> (f64, f64) {
        match usize::from(self.ring_of[mode]) {
            BINS => (self.lowest[0], self.lowest[0]),
            ring => (self.e[ring], self.b[ring]),
        }
    }

    // Variance of Σ_x u·e over cells for both components; `weights` u in the convention of the modes.
    pub(crate) fn of_sums(&self, decomposer: &Decomposer, weights: [&Array2<f64>; 2]) -> [f64; 2] {
        let n4 = (decomposer.grid().cells() as f64).powi(2);
        std::array::from_fn(|component| {
            let modes = decomposer.fft(weights[component].mapv(Complex64::from));
            let sum: f64 = modes
                .indexed_iter()
                .map(|(at, u)| {
                    let (e, b) = self.at(at);
                    // K = exp(−2iφ). At the zero mode K is zero, and both powers are equal.
                    let cos2 = decomposer.kernel(at).re.powi(2);
                    let own = if component == 0 { cos2 } else { 1.0 - cos2 };
                    u.norm_sqr() * (own * e + (1.0 - own) * b)
                })
                .sum();
            sum / n4
        })
    }

    // Variance of m by cross-correlation with `truth`.
    pub(crate) fn of_cross(&self, bins: &Bins, truth: &Array2<Complex64>) -> f64 {
        let (mut noise, mut power) = (0.0, 0.0);
        bins.each_scored(|mode, _, _| {
            let t = truth[mode].norm_sqr();
            noise += t * self.at(mode).0;
            power += t;
        });
        noise / (power * power)
    }

    // Variances of the scored bandpowers of E modes with the explained part `signal`; `own` is the factor of
    // ν².
    pub(crate) fn of_power(
        &self,
        bins: &Bins,
        signal: &Array2<Complex64>,
        own: f64,
    ) -> [f64; BINS] {
        let mut variance = [0.0; BINS];
        bins.each_scored(|mode, bin, w| {
            let (nu, s) = (self.at(mode).0, signal[mode].norm_sqr());
            variance[bin] += 2.0 * w * w * nu * (2.0 * s + own * nu);
        });
        variance
    }

    // Standard error of Q of the bandpowers `ee` divided by `response`². The response was measured on the same
    // modes, so its error correlates all bandpowers.
    pub(crate) fn of_calibrated_quality(
        &self,
        bins: &Bins,
        truth: &Array2<Complex64>,
        response: f64,
        ee: &[f64; BINS],
        true_power: &[f64; BINS],
        q: f64,
    ) -> f64 {
        let (mut own, mut with_m, mut power) = ([0.0; BINS], [0.0; BINS], 0.0);
        bins.each_scored(|mode, bin, w| {
            let (nu, t) = (self.at(mode).0, truth[mode].norm_sqr());
            own[bin] += 2.0 * w * w * nu * (2.0 * t + nu / response.powi(2)) / response.powi(2);
            with_m[bin] += 2.0 * w * t * nu / response;
            power += t;
        });
        let of_m = self.of_cross(bins, truth);
        // Variance of each bin, including the error of m, and covariance of pairs of bins through m.
        let (mut sigma_sys, mut alone, mut own_of_m, mut gradients, mut shared) =
            (0.0, 0.0, 0.0, 0.0, 0.0);
        for b in SCORED {
            let apart = ee[b] / response.powi(2) - true_power[b];
            let (gradient, with_m) = (2.0 * ee[b] / response.powi(3), with_m[b] / power);
            let by_m = gradient * (gradient * of_m - 2.0 * with_m);
            let modulus = Folded::of(apart, own[b] + by_m);
            let u = modulus.gradient * bins.dln_l[b];
            sigma_sys += apart.abs() * bins.dln_l[b];
            alone += modulus.variance * bins.dln_l[b].powi(2);
            own_of_m += u * u * by_m;
            gradients += u * gradient;
            shared += u * with_m;
        }
        let variance = alone + gradients * (gradients * of_m - 2.0 * shared) - own_of_m;
        damped(q, variance.max(0.0).sqrt() / sigma_sys)
    }

    // Variances of the scored bandpowers of B modes, and of EB.
    pub(crate) fn of_null_tests(
        &self,
        bins: &Bins,
        signal: &Array2<Complex64>,
    ) -> [[f64; BINS]; 2] {
        let (mut bb, mut eb) = ([0.0; BINS], [0.0; BINS]);
        bins.each_scored(|mode, bin, w| {
            let (e, b) = self.at(mode);
            bb[bin] += 2.0 * w * w * b * b;
            eb[bin] += w * w * b * (signal[mode].norm_sqr() + e);
        });
        [bb, eb]
    }
}

// Standard error of σ_sys, from the deviations `apart` of the scored bandpowers and their variances.
//
// σ_sys is a sum of |P_b − P_b^true|. Each deviation x has an assumed mean of √max(0, x² − variance); its modulus
// scatters like a folded normal number.
pub(crate) fn of_sigma_sys(bins: &Bins, apart: &[f64; BINS], variance: &[f64; BINS]) -> f64 {
    SCORED
        .map(|b| Folded::of(apart[b], variance[b]).variance * bins.dln_l[b].powi(2))
        .sum::<f64>()
        .sqrt()
}

// Standard error of Q ∝ 1/σ_sys to first order. It is damped if σ_sys is as small as its error: a σ_sys that is
// small by chance would make the error unbounded.
pub(crate) fn of_quality(bins: &Bins, q: f64, apart: &[f64; BINS], variance: &[f64; BINS]) -> f64 {
    let sigma_sys: f64 = SCORED.map(|b| apart[b].abs() * bins.dln_l[b]).sum();
    damped(q, of_sigma_sys(bins, apart, variance) / sigma_sys)
}

fn damped(q: f64, relative: f64) -> f64 {
    q * relative / (1.0 + relative * relative)
}

// |x| of a normal number x.
struct Folded {
    variance: f64,
    // Derivative of the mean of |x| with the mean of x, which multiplies covariances of x.
    gradient: f64,
}

impl Folded {
    fn of(found: f64, variance: f64) -> Self {
        if variance <= 0.0 {
            return Folded {
                variance: 0.0,
                gradient: found.signum(),
            };
        }
        let mean2 = (found * found - variance).max(0.0);
        let t = (mean2 / (2.0 * variance)).sqrt();
        let gradient = libm::erf(t);
        let folded = (2.0 * variance / std::f64::consts::PI).sqrt() * (-t * t).exp()
            + mean2.sqrt() * gradient;
        Folded {
            variance: mean2 + variance - folded * folded,
            gradient: gradient * found.signum(),
        }
    }
}

// Standard errors of M and A in units of C_ℓ, from the covariance of the bandpowers.
pub(crate) fn of_biases(
    bins: &Bins,
    truth: &[f64; BINS],
    covariance: &[[f64; BINS]; BINS],
) -> (f64, f64) {
    let weights = bias_weights(truth, |b| bins.to_c_l(b));
    let (mut m, mut a) = (0.0, 0.0);
    for (i, first) in SCORED.zip(weights) {
        for (j, second) in SCORED.zip(weights) {
            let c_l = covariance[i][j] * bins.to_c_l(i) * bins.to_c_l(j);
            m += first.0 * second.0 * c_l;
            a += first.1 * second.1 * c_l;
        }
    }
    (m.sqrt(), a.sqrt())
}

// Standard error of √A in 10⁻⁴. Not a number if A is not significant.
pub(crate) fn of_sqrt_a(a: f64, error: f64) -> f64 {
    match a.abs() >= MIN_A_SIGMA * error {
        true => error / (2.0 * a.abs().sqrt()) * 1e4,
        false => f64::NAN,
    }
}

// Standard error of the mean C_ℓ of the scored bins, in 10⁻⁹ steradian.
pub(crate) fn of_mean_c_l(bins: &Bins, variance: &[f64; BINS]) -> f64 {
    let sum: f64 = SCORED.map(|b| variance[b] * bins.to_c_l(b).powi(2)).sum();
    sum.sqrt() / SCORED.len() as f64 * 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_modulus_scatters_like_a_folded_normal_number() {
        // Of |x| with mean zero: 1 − 2/π.
        let half = 1.0 - 2.0 / std::f64::consts::PI;
        assert!((Folded::of(0.5, 1.0).variance - half).abs() < 1e-12);
        assert!((Folded::of(-1.0, 4.0).variance - 4.0 * half).abs() < 1e-12);
        assert!((Folded::of(30.0, 1.0).variance - 1.0).abs() < 1e-9);
        // Mean 1, variance 1: by sums over the density.
        let (mut mean, mut square) = (0.0, 0.0);
        for k in -80_000..80_000 {
            let x = f64::from(k) * 1e-4;
            let p =
                (-(x - 1.0_f64).powi(2) / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt() * 1e-4;
            mean += x.abs() * p;
            square += x * x * p;
        }
        let expected = square - mean * mean;
        assert!((Folded::of(2.0_f64.sqrt(), 1.0).variance - expected).abs() < 1e-6);
        assert_eq!(Folded::of(1.0, 0.0).variance, 0.0);
        // It follows a number far from zero, but not a number at zero.
        let gradient = |found, variance| Folded::of(found, variance).gradient;
        assert_eq!(gradient(0.5, 1.0), 0.0);
        assert_eq!((gradient(-30.0, 1.0), gradient(30.0, 1.0)), (-1.0, 1.0));
        assert_eq!((gradient(-1.0, 0.0), gradient(1.0, 0.0)), (-1.0, 1.0));
        // The mean of |x| for means of x of 1 ± h.
        let mean = |m: f64| {
            let density = |x: f64| (-(x - m).powi(2) / 2.0).exp();
            let sum = (-80_000..80_000).map(|k| f64::from(k).abs() * density(f64::from(k) * 1e-4));
            sum.sum::<f64>() * 1e-8 / (2.0 * std::f64::consts::PI).sqrt()
        };
        let expected = (mean(1.001) - mean(0.999)) / 0.002;
        assert!((gradient(2.0_f64.sqrt(), 1.0) - expected).abs() < 1e-6);
    }
}

//! Q, M and A of bandpowers, and m and c of the galaxies.

use ndarray::Array2;
#[cfg(feature = "serde")]
use serde::Serialize;

use crate::bandpower::{BINS, Bins, SCORED};

// Numerator of the quality factor (Kitching et al. 2012, eq. 1; GREAT10 handbook eq. 21).
const Q_SCALE: f64 = 5e-3;

/// A quality factor and its σ_sys.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct Quality {
    /// Q = 5·10⁻³ / σ_sys; infinite for σ_sys = 0.
    pub q: f64,
    /// σ_sys = Σ_b |P_b − P_b^true| Δln ℓ_b over bins 2 to 9.
    pub sigma_sys: f64,
}

/// Q of measured bandpowers against true ones, both ≈ ℓ²C_ℓ/2π.
pub fn quality(bins: &Bins, measured: &[f64; BINS], truth: &[f64; BINS]) -> Quality {
    let sigma_sys = SCORED
        .map(|b| (measured[b] - truth[b]).abs() * bins.dln_l[b])
        .sum::<f64>();
    Quality {
        q: Q_SCALE / sigma_sys,
        sigma_sys,
    }
}

/// Q after dividing the measured bandpowers by `response`², as if the ellipticities were divided by `response`.
pub fn calibrated_quality(
    bins: &Bins,
    measured: &[f64; BINS],
    truth: &[f64; BINS],
    response: f64,
) -> Quality {
    quality(bins, &measured.map(|power| power / response.powi(2)), truth)
}

/// Standard error of Q to first order, for bandpowers with this covariance. Each deviation keeps its sign; if
/// deviations are as small as their errors, the result is only a rough guide. Not a number if an estimated
/// covariance gives σ_sys a negative variance.
pub fn quality_error(
    bins: &Bins,
    measured: &[f64; BINS],
    truth: &[f64; BINS],
    covariance: &[[f64; BINS]; BINS],
) -> f64 {
    let gradient = |b: usize| bins.dln_l[b] * (measured[b] - truth[b]).signum();
    let variance: f64 = SCORED
        .flat_map(|i| SCORED.map(move |j| (i, j)))
        .map(|(i, j)| gradient(i) * covariance[i][j] * gradient(j))
        .sum();
    let Quality { q, sigma_sys } = quality(bins, measured, truth);
    q * variance.sqrt() / sigma_sys
}

/// Multiplicative and additive bias of a power spectrum:
/// C_b − C_b^true = A + M·C_b^true, by unweighted least squares over bins 2 to 9.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[allow(
    non_snake_case,
    reason = "the symbols of the challenge, also in JSON output"
)]
#[non_exhaustive]
pub struct Bias {
    /// Multiplicative bias M ≈ m² + 2m; the published metric is M/2.
    pub M: f64,
    /// Additive bias A = σ²(c), in the unit of the spectra fitted.
    pub A: f64,
    /// sign(A)·√|A|; tabulated in units of 10⁻⁴ when fitted to C_ℓ in steradian.
    pub sqrtA: f64,
    /// M/2.
    pub m_half: f64,
}

/// Fits M and A to `measured` against `truth` after multiplying each bin by `scale`.
pub fn bias(measured: &[f64; BINS], truth: &[f64; BINS], scale: impl Fn(usize) -> f64) -> Bias {
    let (mut response, mut intercept) = (0.0, 0.0);
    for (b, (of_m, of_a)) in SCORED.zip(bias_weights(truth, &scale)) {
        let apart = (measured[b] - truth[b]) * scale(b);
        response += of_m * apart;
        intercept += of_a * apart;
    }
    Bias {
        M: response,
        A: intercept,
        sqrtA: intercept.signum() * intercept.abs().sqrt(),
        m_half: response / 2.0,
    }
}

// The weights of each scored bin's C_b − C_b^true in M and in A.
pub(crate) fn bias_weights(
    truth: &[f64; BINS],
    scale: impl Fn(usize) -> f64,
) -> [(f64, f64); SCORED.end - SCORED.start] {
    let x: [f64; SCORED.end - SCORED.start] =
        std::array::from_fn(|k| truth[SCORED.start + k] * scale(SCORED.start + k));
    let count = x.len() as f64;
    let mean = x.iter().sum::<f64>() / count;
    let sxx: f64 = x.iter().map(|x| (x - mean).powi(2)).sum();
    x.map(|x| {
        let of_m = (x - mean) / sxx;
        (of_m, 1.0 / count - of_m * mean)
    })
}

/// The same fit in four units. The published metrics are `cl`. In ℓ²C_ℓ units M absorbs noise, because the
/// bandpower of noise rises like the weight of the modes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct BiasFits {
    /// Bandpowers ℓ²C_ℓ/2π.
    pub l2: Bias,
    /// Mean |FFT|²/n⁴ of a bin's modes.
    pub mode: Bias,
    /// C_ℓ in steradian.
    pub cl: Bias,
    /// C_ℓ/2π in steradian.
    pub cl_over_2pi: Bias,
}

/// Fits M and A in all four units; `side` of the field in radians.
pub fn bias_fits(bins: &Bins, side: f64, measured: &[f64; BINS], truth: &[f64; BINS]) -> BiasFits {
    let cl = |b: usize| bins.to_c_l(b);
    BiasFits {
        l2: bias(measured, truth, |_| 1.0),
        mode: bias(measured, truth, |b| cl(b) / (side * side)),
        cl: bias(measured, truth, cl),
        cl_over_2pi: bias(measured, truth, |b| cl(b) / (2.0 * std::f64::consts::PI)),
    }
}

// Least squares of e = (1 + m)·g + c over all galaxies of a set, from the sums per cell.
pub(crate) struct ShearBias {
    /// Not a number if the true shear is the same everywhere; c is then the mean of e − g.
    pub m: f64,
    pub c: f64,
    /// Sum per cell of the residuals of the fit.
    pub residual: Array2<f64>,
    /// Weights of the sums per cell in m.
    pub of_m: Array2<f64>,
    /// Weights of the sums per cell in c.
    pub of_c: Array2<f64>,
}

impl ShearBias {
    // Fits one component: its true shear `g`, and per cell the sum of its ellipticities and the number of
    // galaxies.
    pub(crate) fn new(g: &Array2<f64>, sum: Array2<f64>, count: &Array2<f64>) -> Self {
        let galaxies = count.sum();
        let mean = (g * count).sum() / galaxies;
        let apart = g - mean;
        let square = (&apart * &apart * count).sum();
        let constant = g.iter().all(|value| *value == g[(0, 0)]);
        let of_m = match constant {
            true => Array2::zeros(g.dim()),
            false => &apart / square,
        };
        let response = if constant { 1.0 } else { (&of_m * &sum).sum() };
        let of_c = of_m.mapv(|w| 1.0 / galaxies - w * mean);
        let c = sum.sum() / galaxies - response * mean;
        ShearBias {
            m: if constant { f64::NAN } else { response - 1.0 },
            c,
            residual: &sum - &(g.mapv(|g| response * g + c) * count),
            of_m,
            of_c,
        }
    }
}

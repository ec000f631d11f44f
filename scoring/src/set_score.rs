//! The score of a set, as it is given to users.

#[cfg(feature = "serde")]
use serde::Serialize;

use crate::bandpower::{BINS, Bins, SCORED};
use crate::convention::Convention;
use crate::grid::Grid;
use crate::matching::ConventionMatch;
use crate::metrics::Metrics;
use crate::quality::{BiasFits, Quality, quality};

/// One convention's spectra and metrics.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct ConventionScore {
    /// The convention.
    pub convention: Convention,
    /// E-mode bandpowers.
    pub ee: [f64; BINS],
    /// B-mode bandpowers.
    pub bb: [f64; BINS],
    /// EB cross bandpowers; consistent with zero for a sound measurement.
    pub eb: [f64; BINS],
    /// Correlation of the E modes with the true ones over bins 2 to 9, −1 to 1.
    pub correlation: f64,
    /// Σ Re(E_t E*)/Σ|E_t|² − 1 over bins 2 to 9: the multiplicative bias of the shear by
    /// cross-correlation with the truth.
    pub m_cross: f64,
    /// Q and σ_sys.
    pub quality: Quality,
    /// Q of the spectrum divided by (1 + m)², m by cross-correlation.
    pub quality_calibrated: Quality,
    /// Q after subtracting the noise power; `None` if the noise is unknown.
    pub quality_dn: Option<Quality>,
    /// E-mode bandpowers after subtracting the noise power, if the noise is known.
    pub(crate) noise_free: [f64; BINS],
    /// M and A before subtracting the noise power.
    pub fit: BiasFits,
    /// M and A after subtracting the noise power; `None` if the noise is unknown.
    pub fit_dn: Option<BiasFits>,
}

/// Mean ellipticity of a set with constant true shear, in the chosen convention. Such a set has no power to
/// compare; its means are its metrics.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct MeanShear {
    /// Mean ellipticity of the galaxies.
    pub e: [f64; 2],
    /// Standard error of the mean.
    pub error: [f64; 2],
    /// The true shear.
    pub truth: [f64; 2],
}

/// Why a metric is not a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Unknown {
    /// The true shear, or the component that the metric needs, is the same everywhere.
    ConstantTruth,
    /// The noise is unknown: it was not given, and one image cannot determine it.
    Noise,
    /// The measured noise power is negative, by chance.
    NegativeNoise,
    /// The response is less than 3σ above zero.
    Response,
    /// The images have no ellipticities.
    NoEllipticities,
}

/// The score of one set.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct SetScore {
    /// The grid.
    pub grid: Grid,
    /// The bins of the definition used.
    pub bins: Bins,
    /// Images averaged over.
    pub images: usize,
    /// Bandpowers of the true shear's E modes.
    pub true_ee: [f64; BINS],
    /// Bandpowers of the true shear's B modes; nonzero if the sign of g₂ is wrong.
    pub true_bb: [f64; BINS],
    /// Standard errors of the scored E-mode bandpowers in the chosen convention, for a fixed truth. Not numbers in
    /// other bins, or if unknown.
    pub ee_error: [f64; BINS],
    /// Noise bandpowers of the averaged E modes, if known.
    pub noise: Option<[f64; BINS]>,
    /// Noise variance per component, galaxy and image that corresponds to `noise`.
    pub noise_variance: Option<f64>,
    /// All eight conventions, in order.
    pub conventions: Vec<ConventionScore>,
    /// The convention with the highest Q.
    pub best: Convention,
    /// How well each convention correlates with the truth.
    pub matching: ConventionMatch,
    /// The convention of the metrics.
    pub chosen: Convention,
    /// Metrics in the chosen convention. [`SetScore::why_unknown`] explains NaN.
    pub metrics: Metrics,
    /// Standard errors of the metrics; not a number if unknown.
    pub errors: Metrics,
    /// The metrics with each group of images left out in turn; empty with fewer than two images.
    pub replicates: Vec<Metrics>,
    /// Means, if the true shear is the same everywhere. All metrics except c1 and c2 are then unknown.
    pub constant: Option<MeanShear>,
}

impl SetScore {
    /// The chosen convention's spectra.
    pub fn spectra(&self) -> &ConventionScore {
        &self.conventions[self.chosen.index()]
    }

    /// The reason if the metric called `name` is not a number.
    pub fn why_unknown(&self, name: &str) -> Option<Unknown> {
        let value = self.metrics.values()[Metrics::place(name)?];
        if !value.is_nan() {
            return None;
        }
        // c1 and c2 are means, so they need nothing but ellipticities.
        Some(match name {
            _ if self.metrics.c1.is_nan() => Unknown::NoEllipticities,
            _ if self.constant.is_some() => Unknown::ConstantTruth,
            "q_dn" => Unknown::Noise,
            "galaxy_noise" if self.noise.is_none() => Unknown::Noise,
            "galaxy_noise" if !self.metrics.q_calibrated.is_nan() => Unknown::NegativeNoise,
            "q_calibrated" | "galaxy_noise" => Unknown::Response,
            _ => Unknown::ConstantTruth,
        })
    }

    /// Whether the convention with the highest Q is of another class than the chosen one. Its Q is then due to
    /// a wrong convention, not to a good measurement.
    pub fn wrong_convention_wins(&self) -> bool {
        self.best.class() != self.chosen.class()
    }

    /// Q of zero shear: what an entry without images has. It exceeds the Q of measurements while their noise power exceeds
    /// the power of the shear.
    pub fn zero_quality(&self) -> Quality {
        quality(&self.bins, &[0.0; BINS], &self.true_ee)
    }

    /// Share of B modes in the scored true power. It is about one half if the sign of g₂ is wrong.
    pub fn true_b_share(&self) -> f64 {
        let sum = |p: &[f64; BINS]| SCORED.map(|b| p[b]).sum::<f64>();
        let (e, b) = (sum(&self.true_ee), sum(&self.true_bb));
        b / (e + b)
    }
}

/// Covariance of the eight scored bandpowers of a power spectrum.
pub type SpectrumCovariance = [[f64; SCORED.end - SCORED.start]; SCORED.end - SCORED.start];

/// Metrics of a power spectrum. Errors are not numbers if the covariance is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct SpectrumScore {
    /// Q and σ_sys.
    pub quality: Quality,
    /// Q and σ_sys of zero shear.
    pub zero_quality: Quality,
    /// Standard error of Q.
    pub quality_error: f64,
    /// M/2.
    pub m_half: f64,
    /// Standard error of M/2.
    pub m_half_error: f64,
    /// Signed √A in 10⁻⁴ (C_ℓ in steradian).
    pub sqrt_a: f64,
    /// Standard error of √A.
    pub sqrt_a_error: f64,
}

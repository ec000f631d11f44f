//! The shear's E-mode spectrum from cross-spectra between groups of images.
//!
//! All images of a set have the same shear and noise of their own. The mean product of two groups'
//! modes is the shear's power, without a mean of noise; the product of a group with itself is not used.
//! Intrinsic ellipticities are B modes. Where they are the same in all images, what a measurement turns of
//! them into E modes is common to all groups, and stays. With E_g the modes of the mean field of group g
//! and w_g its weight,
//!
//! ```text
//! P = Σ_{g<h} w_g w_h P_gh / Σ_{g<h} w_g w_h,    P_gh = bandpowers of Re(E_g E_h*).
//! ```
//!
//! Groups have the inverse of their noise's variance as weight. Galaxies of one group have equal weights:
//! intrinsic ellipticities are B modes alone, and uneven weights would turn half of them into E modes.
//!
//! # Covariance
//!
//! Pairs that have a group in common go together: the shear meets that group's noise in both. With
//! r_gh = P_gh − P, c_gh the weight of a pair (of sum one) and G groups,
//!
//! ```text
//! cov = G(G − 1)/((G − 2)(G − 3)) · [Σ_g u_g u_gᵀ − Σ_{g<h} c_gh² r_gh r_ghᵀ],    u_g = Σ_h c_gh r_gh
//! ```
//!
//! is the sum over all pairs of pairs with a common group, each once; for equal weights the factor makes
//! its mean that of the covariance, whether shear and noise or noise and noise prevail. (A jackknife over
//! groups would give twice the variance where noise prevails.)

use ndarray::{Array2, Zip};
use shearq_fourier::Complex64;

use crate::bandpower::{BINS, Bins, Definition, SCORED};
use crate::catalogue::FieldSum;
use crate::convention::Convention;
use crate::error::ScoringError;
use crate::grid::Grid;
use crate::modes::Decomposer;
use crate::score::SetImages;

/// Fewest groups whose pairs tell a covariance: it is a difference, and of fewer often negative.
const MIN_GROUPS: usize = 8;

/// A spectrum from cross-spectra: what a power-spectrum submission holds, and how well it is known.
#[derive(Debug, Clone)]
pub struct CrossSpectrum {
    /// The bins, in the leaderboard's definition.
    pub bins: Bins,
    /// E-mode bandpowers ≈ ℓ²C_ℓ/2π; they can be negative.
    pub power: [f64; BINS],
    /// Covariance of the bandpowers under noise; `None` with fewer than eight groups.
    pub covariance: Option<[[f64; BINS]; BINS]>,
    /// Weights of the groups; their sum is one.
    pub weights: Vec<f64>,
}

/// The spectrum from all pairs of groups of images. No truth is needed.
///
/// A cell's mean is that of the galaxies measured there; one that no image of a group has is zero.
///
/// # Errors
/// With fewer than two images.
pub fn cross_spectrum(
    grid: &Grid,
    images: &SetImages,
    convention: Convention,
) -> Result<CrossSpectrum, ScoringError> {
    if images.groups().len() < 2 {
        return Err(ScoringError::OneImage);
    }
    let decomposer = Decomposer::new(*grid);
    let bins = Bins::new(grid, Definition::Leaderboard);
    let modes: Vec<Array2<Complex64>> = images
        .groups()
        .iter()
        .map(|group| decomposer.decompose(mean_field(group, convention)).e)
        .collect();
    let mut pairs = Vec::new();
    for (h, second) in modes.iter().enumerate() {
        for (g, first) in modes[..h].iter().enumerate() {
            let power = bins.power(first, second);
            pairs.push(Pair { g, h, power });
        }
    }
    let counts: Vec<f64> = images.groups().iter().map(|g| g.images as f64).collect();
    let own: Vec<[f64; BINS]> = modes.iter().map(|m| bins.power(m, m)).collect();
    let weights = weights(&own, &pairs, counts);
    let power = mean(&pairs, &weights);
    Ok(CrossSpectrum {
        covariance: covariance(&pairs, &weights, &power),
        bins,
        power,
        weights,
    })
}

/// Two different groups, g < h.
struct Pair {
    g: usize,
    h: usize,
    /// P_gh.
    power: [f64; BINS],
}

impl Pair {
    /// w_g w_h.
    fn weight(&self, weights: &[f64]) -> f64 {
        weights[self.g] * weights[self.h]
    }
}

/// Weighted mean over pairs.
fn mean(pairs: &[Pair], weights: &[f64]) -> [f64; BINS] {
    let total: f64 = pairs.iter().map(|pair| pair.weight(weights)).sum();
    std::array::from_fn(|b| {
        let terms = pairs
            .iter()
            .map(|pair| pair.weight(weights) * pair.power[b]);
        terms.sum::<f64>() / total
    })
}

/// Inverse variances of the groups' noise, of sum one.
///
/// The noise of a group is what its own power exceeds the mean of the pairs by, in the modes beyond the
/// scored bins: a weight from the modes that it is applied to would go with their noise. Where that is
/// not positive for all groups, numbers of images are the weights.
fn weights(own: &[[f64; BINS]], pairs: &[Pair], images: Vec<f64>) -> Vec<f64> {
    let beyond = |power: &[f64; BINS]| (SCORED.end..BINS).map(|b| power[b]).sum::<f64>();
    let common = beyond(&mean(pairs, &images));
    let inverse: Vec<f64> = own
        .iter()
        .map(|power| (beyond(power) - common).recip())
        .collect();
    let known = inverse.iter().all(|w| *w > 0.0 && w.is_finite());
    let weights = if known { inverse } else { images };
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}

/// Covariance of the weighted mean over pairs, see the module's description.
fn covariance(pairs: &[Pair], weights: &[f64], power: &[f64; BINS]) -> Option<[[f64; BINS]; BINS]> {
    let groups = weights.len() as f64;
    if weights.len() < MIN_GROUPS {
        return None;
    }
    let total: f64 = pairs.iter().map(|pair| pair.weight(weights)).sum();
    let mut shared = vec![[0.0; BINS]; weights.len()];
    let mut covariance = [[0.0; BINS]; BINS];
    let mut add = |sign: f64, u: &[f64; BINS]| {
        for (row, a) in covariance.iter_mut().zip(u) {
            for (value, b) in row.iter_mut().zip(u) {
                *value += sign * a * b;
            }
        }
    };
    for pair in pairs {
        let share = pair.weight(weights) / total;
        let term: [f64; BINS] = std::array::from_fn(|b| share * (pair.power[b] - power[b]));
        add(-1.0, &term);
        for group in [pair.g, pair.h] {
            for (sum, term) in shared[group].iter_mut().zip(term) {
                *sum += term;
            }
        }
    }
    for u in &shared {
        add(1.0, u);
    }
    let factor = groups * (groups - 1.0) / ((groups - 2.0) * (groups - 3.0));
    Some(covariance.map(|row| row.map(|value| factor * value)))
}

/// Mean over the galaxies measured in each cell.
fn mean_field(sum: &FieldSum, convention: Convention) -> Array2<Complex64> {
    let (mut e1, mut e2) = (sum.e1.clone(), sum.e2.clone());
    for e in [&mut e1, &mut e2] {
        Zip::from(e).and(&sum.count).for_each(|e, &count| {
            *e = if count > 0.0 { *e / count } else { 0.0 };
        });
    }
    convention.apply(&e1, &e2)
}

//! The shear's E-mode spectrum from cross-spectra between groups of images.
//!
//! All images of a set have the same shear and independent noise. The mean product of the modes of two groups
//! is the power of the shear. Noise adds nothing to this mean, because a group is never multiplied by itself.
//! Intrinsic ellipticities are B modes. If all images have the same intrinsic ellipticities, the E modes that a
//! measurement makes of them remain in the spectrum. With E_g the modes of the mean field of group g and w_g its
//! weight,
//!
//! ```text
//! P = Σ_{g<h} w_g w_h P_gh / Σ_{g<h} w_g w_h,    P_gh = bandpowers of Re(E_g E_h*).
//! ```
//!
//! The weight of a group is the inverse of its noise variance. Galaxies of one group have equal weights:
//! uneven weights would turn half of the intrinsic B modes into E modes.
//!
//! # Covariance
//!
//! Pairs with a common group are correlated: the shear is multiplied by the noise of this group in both. With
//! r_gh = P_gh − P, c_gh the weight of a pair (their sum is one) and G groups,
//!
//! ```text
//! cov = G(G − 1)/((G − 2)(G − 3)) · [Σ_g u_g u_gᵀ − Σ_{g<h} c_gh² r_gh r_ghᵀ],    u_g = Σ_h c_gh r_gh
//! ```
//!
//! is the sum over all pairs of pairs with a common group, each once. For equal weights the factor makes the
//! estimate unbiased, both if shear × noise dominates and if noise × noise does. (A jackknife over groups would
//! give twice the variance if noise × noise dominates.)

use ndarray::{Array2, Zip};
use shearq_quantities::fourier::Complex64;

use crate::bandpower::{BINS, Bins, Definition, SCORED};
use crate::catalogue::{FieldSum, SetImages};
use crate::convention::Convention;
use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};
use crate::modes::Decomposer;

// Fewest groups for a covariance. It is a difference; with fewer groups it is often negative.
const MIN_GROUPS: usize = 8;

/// A spectrum from cross-spectra, with its covariance.
#[derive(Debug, Clone)]
#[non_exhaustive]
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
/// The value of a cell is the mean over the galaxies measured there, or zero if there is none.
///
/// # Errors
/// If there are fewer than two images, or if their grid is another one.
pub fn cross_spectrum(
    grid: &Grid,
    images: &SetImages,
    convention: Convention,
) -> Result<CrossSpectrum, ScoringError> {
    if images.groups().len() < 2 {
        return Err(ScoringError::TooFewImages(images.groups().len()));
    }
    check_shape("the sum of the images", &images.total().e1, grid.n)?;
    let decomposer = Decomposer::new(*grid);
    let bins = Bins::new(grid, Definition::Leaderboard);
    let modes: Vec<Array2<Complex64>> = images
        .groups()
        .iter()
        .map(|group| decomposer.modes_of(mean_field(group, convention)).e)
        .collect();
    let mut pairs = Vec::new();
    for (h, second) in modes.iter().enumerate() {
        for (g, first) in modes[..h].iter().enumerate() {
            let power = bins.power_of(first, second);
            pairs.push(Pair { g, h, power });
        }
    }
    let counts: Vec<f64> = images.groups().iter().map(|g| g.images as f64).collect();
    let own: Vec<[f64; BINS]> = modes.iter().map(|m| bins.power_of(m, m)).collect();
    let weights = weights(&own, &pairs, counts);
    let power = mean(&pairs, &weights);
    Ok(CrossSpectrum {
        covariance: covariance(&pairs, &weights, &power),
        bins,
        power,
        weights,
    })
}

// Two different groups, g < h.
struct Pair {
    g: usize,
    h: usize,
    // P_gh.
    power: [f64; BINS],
}

impl Pair {
    // w_g w_h.
    fn weight(&self, weights: &[f64]) -> f64 {
        weights[self.g] * weights[self.h]
    }
}

fn mean(pairs: &[Pair], weights: &[f64]) -> [f64; BINS] {
    let total: f64 = pairs.iter().map(|pair| pair.weight(weights)).sum();
    std::array::from_fn(|b| {
        let terms = pairs
            .iter()
            .map(|pair| pair.weight(weights) * pair.power[b]);
        terms.sum::<f64>() / total
    })
}

// Inverse noise variances of the groups, normalised to a sum of one.
//
// The noise power of a group is its power minus the mean over pairs, in the modes beyond the scored bins. Weights
// from the scored modes would correlate with their noise. If a noise power is not positive, the weights are the
// numbers of images.
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

// Covariance of the weighted mean over pairs; formula in the module description.
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

fn mean_field(sum: &FieldSum, convention: Convention) -> Array2<Complex64> {
    let (mut e1, mut e2) = (sum.e1.clone(), sum.e2.clone());
    for e in [&mut e1, &mut e2] {
        Zip::from(e).and(&sum.count).for_each(|e, &count| {
            *e = if count > 0.0 { *e / count } else { 0.0 };
        });
    }
    convention.field(&e1, &e2)
}

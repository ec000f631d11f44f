//! The shear's E-mode spectrum from cross-spectra between groups of images.
//!
//! All images of a set have the same shear and noise of their own. The mean product of two groups'
//! modes is the shear's power, without a mean of noise (nor of intrinsic B modes, which differ from
//! image to image); the product of a group with itself is not used. With ē_g the mean field of group g
//! of w_g images, whose noise has a variance ∝ 1/w_g,
//!
//! ```text
//! P = Σ_{g≠h} w_g w_h Re(E_g E_h*) / Σ_{g≠h} w_g w_h = [P(Σ w_g E_g) − Σ w_g² P(E_g)] / [(Σ w_g)² − Σ w_g²].
//! ```

use ndarray::{Array2, Zip};
use rustfft::num_complex::Complex64;

use crate::bandpower::{BINS, Bins, Definition};
use crate::catalogue::FieldSum;
use crate::convention::Convention;
use crate::error::ScoringError;
use crate::grid::Grid;
use crate::modes::Decomposer;
use crate::score::SetImages;

/// E-mode bandpowers from cross-spectra and the bins they refer to (leaderboard definition): what a
/// power-spectrum submission holds. No truth is needed, and bandpowers can be negative.
///
/// A cell's mean is that of the galaxies measured there; one that no image of a group has is zero.
///
/// # Errors
/// With fewer than two images.
pub fn cross_bandpowers(
    grid: &Grid,
    images: &SetImages,
    convention: Convention,
) -> Result<(Bins, [f64; BINS]), ScoringError> {
    let groups = images.groups();
    if groups.len() < 2 {
        return Err(ScoringError::OneImage);
    }
    let decomposer = Decomposer::new(*grid);
    let bins = Bins::new(grid, Definition::Leaderboard);
    let mut sum = Array2::<Complex64>::zeros((grid.n, grid.n));
    let (mut own, mut weights, mut squares) = ([0.0; BINS], 0.0, 0.0);
    for group in groups {
        let weight = group.images as f64;
        let modes = decomposer.decompose(mean_field(group, convention));
        for (own, power) in own.iter_mut().zip(bins.power(&modes.e, &modes.e)) {
            *own += weight * weight * power;
        }
        sum.scaled_add(Complex64::from(weight), &modes.e);
        weights += weight;
        squares += weight * weight;
    }
    let all = bins.power(&sum, &sum);
    let pairs = weights * weights - squares;
    let power = std::array::from_fn(|b| (all[b] - own[b]) / pairs);
    Ok((bins, power))
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

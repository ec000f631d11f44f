//! The average of several stars, for galaxies that share a PSF.

use std::f64::consts::PI;

use ndarray::{Array2, ArrayView3};
use shearq_submissions::PsfCut;

use super::examine::PsfLook;
use super::star::{self, Star};
use crate::error::MeasureError;

/// S/N above which a star counts no more: stars then differ by more than their noise. See
/// docs/constants.md.
const ENOUGH_SNR: f64 = 1000.0;

/// The weighted mean of stars, one each along the first axis, of a sum of one each, with the square of their S/N as weights
/// and shifted to the middle of the stamp by Fourier transforms. It has as many pixels as `cut` takes and all stars have.
///
/// # Errors
/// If a star cannot be used, with its number from 1.
pub fn average_stars(
    stars: ArrayView3<'_, f64>,
    cut: PsfCut,
) -> Result<Array2<f64>, (usize, MeasureError)> {
    let mut taken = Vec::with_capacity(stars.dim().0);
    for (k, stamp) in stars.outer_iter().enumerate() {
        let Star { psf, .. } = star::star(stamp, cut).map_err(|error| (k + 1, error))?;
        let snr = PsfLook::of(psf.view(), None).map_or(0.0, |look| look.snr());
        taken.push((psf, snr.min(ENOUGH_SNR).powi(2)));
    }
    let side = taken.iter().map(|(psf, _)| psf.nrows()).min().unwrap_or(0);
    let mut sum = Array2::zeros((side, side));
    for (psf, weight) in &taken {
        let start = (psf.nrows() - side) / 2;
        let psf = psf.slice(ndarray::s![start..start + side, start..start + side]);
        let [dx, dy] = star::place(psf);
        sum.scaled_add(
            *weight,
            &shift(side, -dy).dot(&psf).dot(&shift(side, -dx).t()),
        );
    }
    let light = sum.sum();
    match light > 0.0 {
        true => Ok(sum / light),
        false => Err((1, MeasureError::DarkPsf(light))),
    }
}

/// The matrix that shifts `n` values by `by` places, of their Fourier interpolation.
fn shift(n: usize, by: f64) -> Array2<f64> {
    Array2::from_shape_fn((n, n), |(to, from)| {
        let t = to as f64 - from as f64 - by;
        let (angle, count) = (PI * t / n as f64, n as f64);
        let below = if n.is_multiple_of(2) {
            angle.tan()
        } else {
            angle.sin()
        };
        if below.abs() < 1e-12 {
            1.0
        } else {
            (PI * t).sin() / (count * below)
        }
    })
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use shearq_quantities::Shear;

    use super::*;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    #[test]
    fn noisy_stars_off_the_middle_average_to_the_psf() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.03)).unwrap();
        let expected = psf.stamp(48);
        let cut = PsfCut {
            size: 48,
            least: 32,
            centred: false,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (snr, count, tolerance) in [(f64::INFINITY, 5, 2e-4), (200.0, 64, 4e-3)] {
            let sigma = expected.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
            let mut stars = Array3::zeros((count, 48, 48));
            for (k, mut star) in stars.outer_iter_mut().enumerate() {
                let (dx, dy) = (0.37 * (k % 5) as f64 - 0.8, 0.29 - 0.2 * (k % 3) as f64);
                psf.draw_into(23.5 + dx, 23.5 + dy, star.view_mut());
                star.mapv_inplace(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    // Of any flux.
                    (value + sigma * noise) * (k + 1) as f64
                });
            }
            let found = average_stars(stars.view(), cut).unwrap();
            let peak = expected[(24, 24)];
            let worst = found.indexed_iter().map(|(at, value)| {
                let start = (48 - found.nrows()) / 2;
                (value - expected[(at.0 + start, at.1 + start)]).abs() / peak
            });
            // Noise of 1/200/√64 of √(Σ p²), which is 2.5 peaks, at four standard deviations.
            let worst = worst.fold(0.0, f64::max);
            assert!(worst < 2.5 * tolerance, "{snr}: {worst}");
        }
    }

    #[test]
    fn a_star_that_cannot_be_used_is_named() {
        let mut stars = Array3::zeros((2, 32, 32));
        // In the middle.
        stars.slice_mut(ndarray::s![0, 15..17, 15..17]).fill(1.0);
        let cut = PsfCut {
            size: 32,
            least: 32,
            centred: false,
        };
        let (number, error) = average_stars(stars.view(), cut).unwrap_err();
        assert_eq!(number, 2);
        assert!(error.to_string().contains("sum to 0"), "{error}");
    }
}

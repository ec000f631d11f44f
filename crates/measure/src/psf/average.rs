//! The mean of stars.

use ndarray::{Array2, ArrayView3, s};
use shearq_submissions::PsfCut;

use super::quality::PsfQuality;
use super::star::{Star, fourier_shift, psf_offset};
use crate::error::MeasureError;

// Above it stars differ by more than their noise, and count alike. Chosen by hand.
const MAX_WEIGHT_SNR: f64 = 1000.0;

/// The weighted mean of stars, one each along the first axis, of a sum of one each, with the square of their S/N as weights
/// and shifted to the centre of the stamp by Fourier transforms. It has as many pixels as `cut` takes and all stars have.
///
/// # Errors
/// If a star cannot be used, with its number from 1.
pub fn average_stars(
    stars: ArrayView3<'_, f64>,
    cut: PsfCut,
) -> Result<Array2<f64>, (usize, MeasureError)> {
    let mut taken = Vec::with_capacity(stars.dim().0);
    for (k, stamp) in stars.outer_iter().enumerate() {
        let Star { psf, .. } = Star::cut(stamp, cut).map_err(|error| (k + 1, error))?;
        let snr = PsfQuality::from_psf(psf.view(), None).map_or(0.0, |quality| quality.snr());
        taken.push((psf, snr.min(MAX_WEIGHT_SNR).powi(2)));
    }
    let side = taken.iter().map(|(psf, _)| psf.nrows()).min().unwrap_or(0);
    let mut sum = Array2::zeros((side, side));
    for (psf, weight) in &taken {
        let start = (psf.nrows() - side) / 2;
        let psf = psf.slice(s![start..start + side, start..start + side]);
        let [by_x, by_y] = psf_offset(psf).map(|offset| fourier_shift(side, side, offset));
        sum.scaled_add(*weight, &by_y.dot(&psf).dot(&by_x.t()));
    }
    let light = sum.sum();
    if light > 0.0 {
        Ok(sum / light)
    } else {
        Err((1, MeasureError::DarkPsf(light)))
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::*;
    use crate::psf::testing::{drawn, limits, noisy};

    #[test]
    fn noisy_stars_off_the_centre_average_to_the_psf() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.03)).unwrap();
        let expected = psf.stamp(48);
        let cut = limits(48, 32, false);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (snr, count, tolerance) in [(f64::INFINITY, 5, 2e-4), (200.0, 64, 4e-3)] {
            let mut stars = Array3::zeros((count, 48, 48));
            for (k, mut star) in stars.outer_iter_mut().enumerate() {
                let (dx, dy) = (0.37 * (k % 5) as f64 - 0.8, 0.29 - 0.2 * (k % 3) as f64);
                psf.draw_into(23.5 + dx, 23.5 + dy, star.view_mut());
                let noisy = noisy(&star.to_owned(), snr, &mut rng);
                // Of any flux.
                star.assign(&(noisy * (k + 1) as f64));
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
    fn a_star_that_cannot_be_averaged_is_named() {
        let mut stars = Array3::zeros((2, 32, 32));
        stars.slice_mut(s![0, 15..17, 15..17]).fill(1.0);
        let cut = limits(32, 32, false);
        let (number, error) = average_stars(stars.view(), cut).unwrap_err();
        assert_eq!(number, 2);
        assert!(error.to_string().contains("sum to 0"), "{error}");
    }

    #[test]
    fn bright_stars_count_alike_in_the_average() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let [narrow, wide] = [3.0, 4.0].map(|fwhm| drawn(profile, fwhm, Shear::ZERO, 48));
        let wide = noisy(&wide, 1300.0, &mut ChaCha8Rng::seed_from_u64(8));
        let mut stars = Array3::zeros((2, 48, 48));
        stars.slice_mut(s![0, .., ..]).assign(&narrow);
        stars.slice_mut(s![1, .., ..]).assign(&wide);
        let cut = limits(48, 32, false);
        let found = average_stars(stars.view(), cut).unwrap();
        let [found, narrow, wide] = [&found, &narrow, &wide].map(|psf| psf[(24, 24)] / psf.sum());
        // By its S/N of 1300, which is above 1000, the second would count less than the first, which has no noise.
        let share = (found - wide) / (narrow - wide);
        assert!((share - 0.5).abs() < 0.03, "{share}");
    }
}

//! Widths of PSFs, which the lengths of the linear method follow in steps.

use std::ops::RangeInclusive;

use ndarray::{ArrayView2, s};

use super::star::sum_of_squares;

// Steps of 19 %. Chosen by hand.
const STEPS_PER_DOUBLING: f64 = 4.0;
// Steps of lengths: 0.6 to 2.8 times as long.
pub(crate) const WIDTH_STEPS: RangeInclusive<i32> = -3..=6;
// The border of smaller stamps has light of the star. Chosen by hand.
const MIN_BORDERED_SIDE: usize = 12;

/// Noise-equivalent area in px² of a PSF of sum one: 1/Σp², without the part of the sum that is noise.
///
/// The noise is the mean square of the border, with the light of the wings. Fourth differences, which the denoising of
/// stars uses, would leave this light in: other areas, and other steps of width near their bounds.
pub(crate) fn noise_equivalent_area(psf: ArrayView2<'_, f64>) -> f64 {
    let mut sum = sum_of_squares(psf);
    let n = psf.nrows();
    if n >= MIN_BORDERED_SIDE {
        let inner = psf.slice(s![BORDER..n - BORDER, BORDER..n - BORDER]);
        let border = sum - sum_of_squares(inner);
        sum -= border * psf.len() as f64 / (psf.len() - inner.len()) as f64;
    }
    1.0 / sum
}

/// Mean square per axis in px² of the Gaussian with this noise-equivalent area: of mean square σ² it is 4πσ².
pub(crate) fn gaussian_variance(area: f64) -> f64 {
    area / (4.0 * std::f64::consts::PI)
}

/// σ in px of the Gaussian with the noise-equivalent area of a PSF of sum one.
pub fn gaussian_sigma(psf: ArrayView2<'_, f64>) -> f64 {
    gaussian_variance(noise_equivalent_area(psf)).sqrt()
}

/// How many steps wider a PSF of this noise-equivalent area is than one of `reference` px²; 0 if that is zero.
///
/// Steps to wider PSFs are rounded. Those to narrower ones are rounded towards zero, less one, so that lengths first shrink
/// where the PSF is 1/√2 as wide: sharp lengths bring noise into the response before they take any out of ellipticities.
pub(crate) fn width_step(area: f64, reference: f64) -> i32 {
    if reference == 0.0 {
        return 0;
    }
    let steps = STEPS_PER_DOUBLING * 0.5 * (area / reference).log2();
    let whole = if steps < 0.0 {
        (steps + 1.0).ceil().min(0.0)
    } else {
        steps.round()
    };
    // NaN becomes 0.
    (whole as i32).clamp(*WIDTH_STEPS.start(), *WIDTH_STEPS.end())
}

/// Factor of all lengths at a step.
pub(crate) fn width_factor(step: i32) -> f64 {
    (f64::from(step) / STEPS_PER_DOUBLING).exp2()
}

// Width in pixels of the border of a star's stamp, from which its noise and background are measured. Chosen by hand.
pub(super) const BORDER: usize = 2;

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{PsfProfile, Shear};

    use super::*;
    use crate::psf::testing::{drawn, noisy};

    #[test]
    fn steps_follow_the_width() {
        let moffat = |fwhm| {
            let profile = PsfProfile::Moffat { beta: 3.0 };
            drawn(profile, fwhm, Shear::new(0.03, -0.02), 64)
        };
        // A Moffat of β = 3 has 1.25 π (FWHM/1.0196)² = 3.78 FWHM², and the pixel's width adds to it.
        let expected = 3.78 * 6.0f64.powi(2);
        let found = noise_equivalent_area(moffat(6.0).view());
        assert!((found / expected - 1.0).abs() < 0.02, "{found}");
        let step =
            |psf: Array2<f64>, reference| width_step(noise_equivalent_area(psf.view()), reference);
        let steps = |fwhm| step(moffat(fwhm), 50.0);
        let narrow = [0.5, 2.0, 2.3, 2.45, 2.55, 2.7, 3.06].map(steps);
        assert_eq!(narrow, [-3, -2, -1, -1, 0, 0, 0]);
        let wide = [3.4, 3.74, 4.5, 6.0, 20.0].map(steps);
        assert_eq!(wide, [0, 0, 1, 3, 6]);
        assert_eq!(step(moffat(6.0), 0.0), 0);
        // Noise of a star of S/N 30 alone would make it a step narrower.
        let star = noisy(&moffat(3.4), 30.0, &mut ChaCha8Rng::seed_from_u64(9));
        assert_eq!(step(star, 50.0), 0);
        assert_eq!(step(moffat(6.0) * f64::NAN, 50.0), 0);
        assert_eq!([-4, 0, 4].map(width_factor), [0.5, 1.0, 2.0]);
    }
}

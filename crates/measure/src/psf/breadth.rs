//! How broad a PSF is, in steps: what lengths of the linear method follow.

use std::ops::RangeInclusive;

use ndarray::{ArrayView2, s};

use super::sums::sum_of_squares;

/// Steps in which lengths double. See docs/constants.md.
const OCTAVE: f64 = 4.0;
/// Steps of lengths: 0.6 to 2.8 times as long.
pub(crate) const STEPS: RangeInclusive<i32> = -3..=6;

/// Width of the border from which a star's noise is measured. See docs/constants.md.
const BORDER: usize = 2;
/// Side from which on the border is free of the star's light. See docs/constants.md.
const LEAST_SIDE: usize = 12;

/// Noise-equivalent area in px² of a PSF of sum one: 1/Σp², without what a star's noise adds to the sum, which is told
/// from its frame.
pub(super) fn area(psf: ArrayView2<'_, f64>) -> f64 {
    let mut sum = sum_of_squares(psf);
    let n = psf.nrows();
    if n >= LEAST_SIDE {
        let inner = psf.slice(s![BORDER..n - BORDER, BORDER..n - BORDER]);
        let frame = sum - sum_of_squares(inner);
        sum -= frame * psf.len() as f64 / (psf.len() - inner.len()) as f64;
    }
    1.0 / sum
}

/// How many steps a PSF of sum one is broader than one of a noise-equivalent area of `reference` px²; none where that is
/// zero. Steps to broader ones are rounded; those to narrower ones are rounded towards zero, less one, so that lengths first
/// shrink where the PSF is 1/√2 as broad: sharp lengths bring noise into the response before they take any out of
/// ellipticities.
pub(crate) fn step(psf: ArrayView2<'_, f64>, reference: f64) -> i32 {
    if reference == 0.0 {
        return 0;
    }
    let steps = OCTAVE * 0.5 * (area(psf) / reference).log2();
    let whole = if steps < 0.0 {
        (steps + 1.0).ceil().min(0.0)
    } else {
        steps.round()
    };
    // NaN is none.
    (whole as i32).clamp(*STEPS.start(), *STEPS.end())
}

/// How much longer lengths are after so many steps.
pub(crate) fn factor(step: i32) -> f64 {
    (f64::from(step) / OCTAVE).exp2()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::Shear;

    use super::*;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    #[test]
    fn steps_follow_the_width() {
        let moffat = |fwhm| {
            let profile = PsfProfile::Moffat { beta: 3.0 };
            let psf = FunctionalPsf::new(profile, fwhm, Shear::new(0.03, -0.02)).unwrap();
            psf.stamp(64)
        };
        // A Moffat of β = 3 has 1.25 π (FWHM/1.0196)² = 3.78 FWHM², and the pixel's width adds to it.
        let expected = 3.78 * 6.0f64.powi(2);
        let found = area(moffat(6.0).view());
        assert!((found / expected - 1.0).abs() < 0.02, "{found}");
        let steps = |fwhm| step(moffat(fwhm).view(), 50.0);
        let narrow = [0.5, 2.0, 2.3, 2.45, 2.55, 2.7, 3.06].map(steps);
        assert_eq!(narrow, [-3, -2, -1, -1, 0, 0, 0]);
        let broad = [3.4, 3.74, 4.5, 6.0, 20.0].map(steps);
        assert_eq!(broad, [0, 0, 1, 3, 6]);
        assert_eq!(step(moffat(6.0).view(), 0.0), 0);
        // As narrow as ever in noise of a star of S/N 30, which alone would make it a step narrower.
        let clean = moffat(3.4);
        let sigma = clean.iter().map(|v| v * v).sum::<f64>().sqrt() / 30.0;
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let star = clean.mapv(|v| v + sigma * 12f64.sqrt() * rng.random_range(-0.5..0.5));
        assert_eq!(step(star.view(), 50.0), 0);
        let dead = moffat(6.0) * f64::NAN;
        assert_eq!(step(dead.view(), 50.0), 0);
        assert_eq!([-4, 0, 4].map(factor), [0.5, 1.0, 2.0]);
    }
}

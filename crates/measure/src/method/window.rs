//! How wide the window of the linear method is: as the galaxies of an image make it.
//!
//! Of small galaxies a wide window keeps noise, and of large ones a narrow one takes light. The widths that scatter
//! least follow the galaxies' extent to the power 0.8, in steps of 19 %. One width for all galaxies of an image cannot
//! select by shear.

use std::ops::RangeInclusive;

use ndarray::ArrayView2;
use shearq_submissions::limits::WINDOWS;

use crate::extent::Moments;

/// Steps in which the window's width doubles. See docs/constants.md.
const OCTAVE: f64 = 4.0;
/// Power of the size with which the best width grows. See docs/constants.md.
const POWER: f64 = 0.8;
/// Steps from the submission's own width.
const STEPS: RangeInclusive<i32> = -3..=3;

/// Mean square per axis of GREAT10's galaxies, in units of the best window's σ². See
/// docs/constants.md.
const USUAL: f64 = 0.1375;

/// Widest window in units of the stamp's side. See docs/constants.md.
const WIDEST: f64 = 0.2;

/// The place of the submission's own width among all.
pub(super) const OWN: usize = STEPS.start().unsigned_abs() as usize;
/// Number of widths.
pub(super) const COUNT: usize = OWN + 1 + STEPS.end().unsigned_abs() as usize;

/// The width's place for galaxies that are `seen` so broad in px², through `psf`, where `reference` px² is what the
/// submission's own is for.
pub(super) fn place(
    seen: Option<f64>,
    psf: ArrayView2<'_, f64>,
    reference: f64,
    moments: &mut Moments,
) -> usize {
    let (Some(seen), true) = (seen, reference > 0.0) else {
        return OWN;
    };
    let Some(psf) = moments.of_psf(psf) else {
        return OWN;
    };
    // Of a point nothing is left, which is the narrowest.
    let ratio = ((seen - psf) / reference).max(f64::MIN_POSITIVE);
    let step = (OCTAVE * POWER * ratio.log2()).round() as i32;
    OWN.wrapping_add_signed(step.clamp(*STEPS.start(), *STEPS.end()) as isize)
}

/// Mean square per axis in px² of the galaxies that the width at `place` is for, of a submission whose own is `sigma`
/// px for `reference` px². Where `reference` is zero that of GREAT10's galaxies is taken, in proportion to `sigma`².
pub(super) fn extent(reference: f64, sigma: f64, place: usize) -> f64 {
    let own = if reference > 0.0 {
        reference
    } else {
        sigma * sigma * USUAL
    };
    own * ((place as f64 - OWN as f64) / (OCTAVE * POWER)).exp2()
}

/// The width at `place` of a submission whose own is `sigma`, on stamps of `n` pixels a side.
pub(super) fn sigma(sigma: f64, place: usize, n: usize) -> f64 {
    if place == OWN {
        return sigma;
    }
    let steps = place as f64 - OWN as f64;
    let widest = (WIDEST * n as f64).max(sigma).min(*WINDOWS.end());
    (sigma * (steps / OCTAVE).exp2()).clamp(*WINDOWS.start(), widest)
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;

    #[test]
    fn windows_follow_the_extent_without_that_of_the_psf() {
        assert_eq!(STEPS.count(), COUNT);
        let mut moments = Moments::default();
        // Of a variance of 3 px².
        let psf = Array2::from_shape_fn((32, 32), |(y, x)| {
            let (x, y) = (x as f64 - 15.5, y as f64 - 15.5);
            (-(x * x + y * y) / 6.0).exp()
        });
        let places = [13.0, 5.0, 23.0, 3.0, 1.0, 1e9]
            .map(|seen| place(Some(seen), psf.view(), 10.0, &mut moments));
        // A fifth, once, twice, and nothing of 10 px²: 3.2·log₂ of it, within bounds.
        assert_eq!(places, [OWN, 0, 6, 0, 0, 6]);
        assert_eq!(
            place(
                Some(3.0 + 10.0 * 2f64.powf(0.34)),
                psf.view(),
                10.0,
                &mut moments
            ),
            OWN + 1
        );
        assert_eq!(place(None, psf.view(), 10.0, &mut moments), OWN);
        assert_eq!(place(Some(5.0), psf.view(), 0.0, &mut moments), OWN);
        assert_eq!(place(Some(5.0), (-&psf).view(), 0.0, &mut moments), OWN);
        let twice = sigma(5.0, OWN + 2, 48) / sigma(5.0, OWN - 2, 48);
        assert!((twice - 2.0).abs() < 1e-12, "{twice}");
        let widest = sigma(8.0, 6, 48);
        assert!(
            sigma(8.0, OWN, 48) == 8.0 && (widest - 9.6).abs() < 1e-12,
            "{widest}"
        );
        // Twice as broad: a galaxy whose window is wider by 2^0.8.
        assert_eq!(extent(9.0, 8.0, OWN), 9.0);
        let twice = extent(9.0, 8.0, OWN + 2) / extent(9.0, 8.0, OWN - 2);
        assert!((twice.powf(POWER) - 2.0).abs() < 1e-12, "{twice}");
        assert_eq!(extent(0.0, 8.0, OWN), 8.8);
        assert_eq!([OWN, 6].map(|at| sigma(8.0, at, 32)), [8.0, 8.0]);
        assert_eq!((sigma(15.0, 6, 64), sigma(2.0, 0, 48)), (15.0, 2.0));
        assert_eq!(sigma(8.0, 6, 96), 8.0 * 2f64.powf(0.75));
    }
}

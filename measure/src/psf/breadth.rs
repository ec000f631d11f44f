//! How broad a PSF is, in steps: what lengths of the linear method, and the cut of the PSF itself, follow.

use std::ops::RangeInclusive;

use ndarray::ArrayView2;
use shearq_submissions::PsfCut;

/// Steps in which lengths double.
const OCTAVE: f64 = 4.0;
/// Steps: from 0.6 to 2.8 times as broad as the reference.
pub(crate) const STEPS: RangeInclusive<i32> = -3..=6;

/// Noise-equivalent area in px² of a PSF of sum one: 1/Σp².
fn area(psf: ArrayView2<'_, f64>) -> f64 {
    1.0 / psf.iter().map(|value| value * value).sum::<f64>()
}

/// How many steps a PSF of sum one is broader than the reference of `cut`; none where there is no reference. Narrower ones
/// count whole steps alone, and the first of them not: sharp lengths bring noise into the response before they take any
/// out of ellipticities.
pub(crate) fn step(psf: ArrayView2<'_, f64>, cut: PsfCut) -> i32 {
    if cut.reference_area == 0.0 {
        return 0;
    }
    let steps = OCTAVE * 0.5 * (area(psf) / cut.reference_area).log2();
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

/// Pixels a side that are cut of a PSF so many steps broader than the reference; not less of a narrower one.
pub(crate) fn side(cut: PsfCut, step: i32) -> usize {
    // A negative number is zero as a whole one.
    let more = cut.size as f64 * (factor(step) - 1.0) / 2.0;
    let most = cut.most.max(cut.size);
    // Of the same parity.
    (cut.size + 2 * more as usize).min(most - (most - cut.size) % 2)
}

#[cfg(test)]
mod tests {
    use shearq_scoring::Shear;

    use super::*;
    use crate::psf::{FunctionalPsf, PsfProfile};

    #[test]
    fn steps_follow_the_width() {
        let moffat = |fwhm| {
            let profile = PsfProfile::Moffat { beta: 3.0 };
            let psf = FunctionalPsf::new(profile, fwhm, Shear::new(0.03, -0.02)).unwrap();
            psf.stamp(64)
        };
        let cut = |reference_area| PsfCut {
            reference_area,
            ..PsfCut::from(32)
        };
        // A Moffat of β = 3 has 1.25 π (FWHM/1.0196)² = 3.78 FWHM², and the pixel's width adds to it.
        let expected = 3.78 * 6.0f64.powi(2);
        let found = area(moffat(6.0).view());
        assert!((found / expected - 1.0).abs() < 0.02, "{found}");
        let steps = |fwhm| step(moffat(fwhm).view(), cut(50.0));
        let found = [0.5, 2.0, 2.7, 3.06, 3.4, 3.74, 4.5, 6.0, 20.0].map(steps);
        assert_eq!(found, [-3, -2, 0, 0, 0, 0, 1, 3, 6]);
        assert_eq!(step(moffat(6.0).view(), cut(0.0)), 0);
        let dead = moffat(6.0) * f64::NAN;
        assert_eq!(step(dead.view(), cut(50.0)), 0);
        assert_eq!([-4, 0, 4].map(factor), [0.5, 1.0, 2.0]);
    }

    #[test]
    fn cuts_grow_and_keep_parity_and_limit() {
        let cut = |size, most| PsfCut {
            size,
            most,
            reference_area: 50.0,
        };
        assert_eq!(
            [-3, 0, 1, 3, 6].map(|at| side(cut(32, 48), at)),
            [32, 32, 38, 48, 48]
        );
        assert_eq!([0, 1, 6].map(|at| side(cut(15, 48), at)), [15, 17, 41]);
        assert_eq!([0, 6].map(|at| side(cut(31, 48), at)), [31, 47]);
        assert_eq!(side(cut(32, 23), 3), 32);
    }
}

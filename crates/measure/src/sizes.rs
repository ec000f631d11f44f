//! Sizes that a measurement can work with.

use ndarray::ArrayView2;
use shearq_submissions::limits::{MAX_CUT, MAX_PSF};

use crate::error::MeasureError;

/// Checks the sides of a stamp and a PSF that are planned for.
pub(crate) fn check_sizes(n: usize, p: usize) -> Result<(), MeasureError> {
    if !(3..=MAX_CUT).contains(&n) {
        let expected = format!("a side of 3 to {MAX_CUT} pixels");
        return Err(MeasureError::square("a stamp", (n, n), expected));
    }
    if !(2..=MAX_PSF).contains(&p) {
        let expected = format!("a side of 2 to {MAX_PSF} pixels");
        return Err(MeasureError::square("a PSF stamp", (p, p), expected));
    }
    Ok(())
}

/// Checks that a PSF has p×p finite pixels.
pub(crate) fn check_psf(psf: ArrayView2<'_, f64>, p: usize) -> Result<(), MeasureError> {
    if psf.dim() != (p, p) {
        let expected = format!("{p} × {p}");
        return Err(MeasureError::square("a PSF stamp", psf.dim(), expected));
    }
    // Without the places of its pixels, which only a bad one needs, and without an early exit.
    if !psf.fold(false, |bad, value| bad | !value.is_finite()) {
        return Ok(());
    }
    match psf.indexed_iter().find(|(_, value)| !value.is_finite()) {
        None => Ok(()),
        Some(((y, x), _)) => Err(MeasureError::NotFinite {
            what: "PSF stamp",
            x: x + 1,
            y: y + 1,
        }),
    }
}

//! Cutting stamps around their centre, and checking that a PSF stamp can be used.
//!
//! The centre of a side of N pixels is at (N − 1)/2 counted from 0: between pixels for even N. A cut
//! of another parity starts half a pixel early, so that its central pixel (odd side) or corner (even
//! side) is half a pixel before the stamp's centre on both axes. The autocorrelation does not see
//! such shifts; the window of the linear method would, whose stamp and PSF must have one parity.

use ndarray::{Array2, ArrayView2, s};
use shearq_submissions::PsfCut;

use crate::error::MeasureError;
use crate::pixel::Pixel;

/// Farthest that the centroid of a PSF may lie from the centre of its stamp along either axis, in
/// pixels. A PSF that is cut off the centre of its wings adds its own ellipticity to that of all
/// galaxies: about 0.01 for one pixel of a 15 px PSF of the usual width.
const MAX_CENTROID_OFFSET: f64 = 1.0;

/// First pixel of a centred cut of `size` from a side of `full`; `None` where it does not fit.
pub(crate) fn cut_start(full: usize, size: usize) -> Option<usize> {
    full.checked_sub(size).map(|rest| rest / 2)
}

/// The central pixels of a star stamp, normalised to a sum of one: of a size, or as many as a submission takes and the
/// stamp has. The star has to be in the middle of the least of them.
///
/// # Errors
/// Where the stamp is too small, has pixels that are not finite, no light, or its light is centred
/// elsewhere.
pub fn star_psf<P: Pixel>(
    stamp: ArrayView2<'_, P>,
    cut: impl Into<PsfCut>,
) -> Result<Array2<f64>, MeasureError> {
    let cut: PsfCut = cut.into();
    let (rows, columns) = stamp.dim();
    let size = cut.least;
    let (Some(y0), Some(x0)) = (cut_start(rows, size), cut_start(columns, size)) else {
        let expected = format!("at least {size} × {size}, as the submission needs");
        return Err(MeasureError::square("a PSF stamp", stamp.dim(), expected));
    };
    for ((y, x), &value) in stamp.indexed_iter() {
        if !value.into().is_finite() {
            return Err(MeasureError::NotFinite {
                what: "PSF stamp",
                x: x + 1,
                y: y + 1,
            });
        }
    }
    let inner = central(stamp, size, (y0, x0));
    light(inner.iter().map(|&value| -> f64 { value.into() }).sum())?;
    let (dx, dy) = offset(stamp, inner, (x0, y0));
    if dx.abs() > MAX_CENTROID_OFFSET || dy.abs() > MAX_CENTROID_OFFSET {
        return Err(MeasureError::OffCentre {
            dx,
            dy,
            most: MAX_CENTROID_OFFSET,
        });
    }
    // On all sides, so that the parity is the same.
    let more = (cut.size.min(rows).min(columns) - size) / 2;
    let taken = central(stamp, size + 2 * more, (y0 - more, x0 - more));
    let taken: Array2<f64> = taken.mapv(Into::into);
    let sum = light(taken.sum())?;
    Ok(taken / sum)
}

/// `size` pixels a side from `start` on.
fn central<P>(
    stamp: ArrayView2<'_, P>,
    size: usize,
    (y0, x0): (usize, usize),
) -> ArrayView2<'_, P> {
    stamp.slice_move(s![y0..y0 + size, x0..x0 + size])
}

/// The sum of a star's pixels, which has to be light.
fn light(sum: f64) -> Result<f64, MeasureError> {
    if sum <= 0.0 {
        return Err(MeasureError::DarkPsf(sum));
    }
    Ok(sum)
}

/// Where the star is, from the centre of the stamp. A star outside the cut, of which `start` is the
/// first pixel, is where its brightest pixel is; the centroid of its faint wings would be elsewhere.
fn offset<P: Pixel>(
    stamp: ArrayView2<'_, P>,
    cut: ArrayView2<'_, P>,
    start: (usize, usize),
) -> (f64, f64) {
    let from_centre = |at: f64, side: usize| at - (side as f64 - 1.0) / 2.0;
    let (rows, columns) = stamp.dim();
    let brightest = stamp
        .indexed_iter()
        .fold(((0, 0), f64::NEG_INFINITY), |best, (at, &value)| {
            let value = value.into();
            if value > best.1 { (at, value) } else { best }
        })
        .0;
    let ((y, x), (x0, y0)) = (brightest, start);
    if !(y0..y0 + cut.nrows()).contains(&y) || !(x0..x0 + cut.ncols()).contains(&x) {
        return (from_centre(x as f64, columns), from_centre(y as f64, rows));
    }
    let (mut sum, mut sum_x, mut sum_y) = (0.0, 0.0, 0.0);
    for ((y, x), &value) in cut.indexed_iter() {
        let value: f64 = value.into();
        sum += value;
        sum_x += value * (x0 + x) as f64;
        sum_y += value * (y0 + y) as f64;
    }
    (
        from_centre(sum_x / sum, columns),
        from_centre(sum_y / sum, rows),
    )
}

#[cfg(test)]
mod tests {
    use shearq_quantities::Shear;

    use super::*;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    #[test]
    fn cuts_keep_the_centre_or_start_half_a_pixel_early() {
        assert_eq!(cut_start(48, 24), Some(12));
        assert_eq!(cut_start(48, 23), Some(12));
        assert_eq!(cut_start(15, 15), Some(0));
        assert_eq!(cut_start(15, 16), None);
    }

    #[test]
    fn a_functional_psf_is_where_the_cut_of_a_star_is() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 2.9, Shear::new(0.05, -0.03)).unwrap();
        for (side, size) in [(48, 15), (48, 24), (33, 24), (33, 15)] {
            let cut = star_psf(psf.stamp(side).view(), size).unwrap();
            for (a, b) in cut.iter().zip(&psf.stamp_beside(size, side)) {
                // Either is drawn to 1e-6 of the brightest pixel, which is below a tenth.
                assert!((a - b).abs() < 2e-7, "{side}, {size}: {a} {b}");
            }
        }
    }

    #[test]
    fn of_a_star_as_much_is_taken_as_there_is_and_its_middle_stays_where_it_was() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let cut = PsfCut {
            size: 48,
            least: 32,
        };
        let whole = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.03)).unwrap();
        let stamp = whole.stamp(64);
        for (given, expected) in [(32, 32), (37, 36), (48, 48), (64, 48)] {
            let from = cut_start(64, given).unwrap();
            let star = stamp.slice(s![from..from + given, from..from + given]);
            let taken = star_psf(star, cut).unwrap();
            assert_eq!(taken.dim(), (expected, expected), "{given}");
            assert!((taken.sum() - 1.0).abs() < 1e-12);
            // Where the parity is another, half a pixel early.
            let early = given % 2;
            let middle = expected / 2;
            let found = taken[(middle - 3, middle + 5)] / taken[(middle, middle)];
            let at = |y: usize, x: usize| stamp[(y - early, x - early)];
            let expected = at(29, 37) / at(32, 32);
            assert!((found - expected).abs() < 1e-12, "{given}");
        }
        assert!(star_psf(stamp.slice(s![..31, ..31]), cut).is_err());
        assert_eq!(whole.stamp_beside(cut.size, 48).dim(), (48, 48));
    }

    #[test]
    fn a_star_is_cut_and_normalised_without_turning_it() {
        let mut stamp = Array2::<f32>::zeros((9, 9));
        stamp[(4, 4)] = 6.0;
        stamp[(4, 5)] = 2.0;
        let psf = star_psf(stamp.view(), 5).unwrap();
        assert_eq!(psf[(2, 2)], 0.75);
        assert_eq!(psf[(2, 3)], 0.25);
    }

    #[test]
    fn unusable_stars_are_refused_with_the_reason() {
        let mut stamp = Array2::<f32>::zeros((9, 9));
        let refused = |stamp: &Array2<f32>, size, expected: &str| {
            let message = star_psf(stamp.view(), size).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        };
        refused(&stamp, 5, "sum to 0; expected a positive sum");
        stamp[(4, 4)] = -1.0;
        refused(&stamp, 5, "sum to -1");
        stamp[(4, 4)] = 1.0;
        refused(&stamp, 15, "of 9 × 9 pixels; expected at least 15 × 15");
        stamp[(4, 8)] = 3.0;
        refused(&stamp, 5, "(+4.0, +0.0)");
        stamp[(0, 1)] = f32::INFINITY;
        refused(&stamp, 5, "(2, 1)");
    }
}

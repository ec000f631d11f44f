//! Cutting stamps around their centre, and checking that a PSF stamp can be used.
//!
//! The centre of a side of N pixels is at (N − 1)/2 counted from 0: between pixels for even N. A cut
//! of another parity starts half a pixel early, so that its central pixel (odd side) or corner (even
//! side) is half a pixel before the stamp's centre on both axes. The autocorrelation does not see
//! such shifts. The window of the linear method requires one parity: see `halfway.rs`.

use ndarray::{Array2, ArrayView2, s};
use shearq_submissions::PsfCut;

use crate::error::MeasureError;
use crate::pixel::Pixel;
use crate::psf::halfway::halfway;
use crate::psf::sums::{largest_of_rows, sum};

/// Largest centroid offset along an axis of a star that is cut around its stamp's centre. See
/// docs/constants.md.
const MAX_CENTROID_OFFSET: f64 = 1.0;

/// σ of the Gaussian weight for a star's centroid. See docs/constants.md.
const WEIGHT: f64 = 2.0;
/// Half the side of the square of that weight. See docs/constants.md.
const WEIGHT_REACH: usize = 6;
/// Step in units of the weighted centroid, which falls short of the centre. See docs/constants.md.
const STRIDE: f64 = 1.5;
/// Most steps to the centroid. See docs/constants.md.
const STEPS: usize = 40;
/// Step at which the search for the centroid ends. See docs/constants.md.
const SMALL_STEP: f64 = 1e-3;
/// Largest distance of the centroid from the start of the search. See docs/constants.md.
const FARTHEST: f64 = 3.0;

/// First pixel of a centred cut of `size` from a side of `full`; `None` where it does not fit.
pub(crate) fn cut_start(full: usize, size: usize) -> Option<usize> {
    full.checked_sub(size).map(|rest| rest / 2)
}

/// The pixels of a star, and how far it was from the centre of its stamp.
#[derive(Debug, Clone)]
pub struct Star {
    /// As many pixels as a submission takes and the stamp has around the star, normalised to a sum of one.
    pub psf: Array2<f64>,
    /// Offset (x, y) of the star from the centre of its stamp in pixels, if it is above one pixel along either axis. The
    /// cut was moved by the nearest whole pixels then.
    pub moved: Option<[f64; 2]>,
}

/// The pixels around the star on a stamp, normalised to a sum of one: of a size, or as many as a submission takes and the
/// stamp has. A star that is more than a pixel off the centre is cut around itself, to half a pixel.
///
/// # Errors
/// If the stamp is too small, has pixels that are not finite or no light, or the star is too near an edge.
pub fn star_psf<P: Pixel>(
    stamp: ArrayView2<'_, P>,
    cut: impl Into<PsfCut>,
) -> Result<Array2<f64>, MeasureError> {
    Ok(star(stamp, cut)?.psf)
}

/// The same with the offset of the star. A star on a stamp of another parity than the cut is shifted by half a pixel
/// first, if the cut requires a centred PSF.
///
/// # Errors
/// As [`star_psf`].
pub fn star<P: Pixel>(
    stamp: ArrayView2<'_, P>,
    cut: impl Into<PsfCut>,
) -> Result<Star, MeasureError> {
    let cut: PsfCut = cut.into();
    let (rows, columns) = stamp.dim();
    let other = |side: usize| side > cut.least && side % 2 != cut.size % 2;
    if !cut.centred || !other(rows) && !other(columns) {
        return centred_star(stamp, cut);
    }
    brightest(stamp)?;
    centred_star(halfway(stamp, [other(rows), other(columns)]).view(), cut)
}

/// The star of a stamp of the parity of the cut.
fn centred_star<P: Pixel>(stamp: ArrayView2<'_, P>, cut: PsfCut) -> Result<Star, MeasureError> {
    let (rows, columns) = stamp.dim();
    let size = cut.least;
    let (Some(y0), Some(x0)) = (cut_start(rows, size), cut_start(columns, size)) else {
        let expected = format!("at least {size} × {size}, as the submission needs");
        return Err(MeasureError::square("a PSF stamp", stamp.dim(), expected));
    };
    let brightest = brightest(stamp)?;
    let all = sum(stamp);
    let sum_of = |part: ArrayView2<'_, P>| match part.dim() == stamp.dim() {
        true => all,
        false => sum(part),
    };
    let inner = sum_of(central(stamp, size, (y0, x0)));
    if all <= 0.0 {
        // There is nothing to look for elsewhere.
        light(inner)?;
    }
    let [dx, dy] = offset(stamp, brightest);
    let centred = dx.abs() <= MAX_CENTROID_OFFSET && dy.abs() <= MAX_CENTROID_OFFSET;
    let (x0, y0, moved) = if centred {
        light(inner)?;
        (x0, y0, None)
    } else {
        let moved = |start: usize, off: f64, full: usize| {
            let start = start.checked_add_signed(off.round() as isize)?;
            (start + size <= full).then_some(start)
        };
        let (Some(x0), Some(y0)) = (moved(x0, dx, columns), moved(y0, dy, rows)) else {
            return Err(MeasureError::OffCentre {
                dx,
                dy,
                size,
                rows,
                columns,
            });
        };
        (x0, y0, Some([dx, dy]))
    };
    // On all sides, so that the parity is the same.
    let room = [x0, y0, columns - size - x0, rows - size - y0];
    let more = room.into_iter().fold((cut.size - size) / 2, usize::min);
    let taken = central(stamp, size + 2 * more, (y0 - more, x0 - more));
    let flux = light(sum_of(taken))?;
    let share = 1.0 / flux;
    if !share.is_finite() {
        return Err(MeasureError::DarkPsf(flux));
    }
    Ok(Star {
        psf: taken.mapv(|value| share * Into::<f64>::into(value)),
        moved,
    })
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

/// The brightest pixel (x, y) of a stamp of finite pixels.
fn brightest<P: Pixel>(stamp: ArrayView2<'_, P>) -> Result<[usize; 2], MeasureError> {
    let mut best = ([0, 0], f64::NEG_INFINITY);
    for (y, largest) in largest_of_rows(stamp).enumerate() {
        // The place in the row, which few rows need.
        let place = |is: &dyn Fn(f64) -> bool| {
            let mut values = stamp.row(y).into_iter().map(|&value| value.into());
            values.position(is).unwrap_or(0)
        };
        let Some(largest) = largest else {
            return Err(MeasureError::NotFinite {
                what: "PSF stamp",
                x: place(&|value| !value.is_finite()) + 1,
                y: y + 1,
            });
        };
        if largest > best.1 {
            best = ([place(&|value| value == largest), y], largest);
        }
    }
    Ok(best.0)
}

/// Where the star of a PSF is, (x, y) from the centre of its stamp.
pub(super) fn place(psf: ArrayView2<'_, f64>) -> [f64; 2] {
    brightest(psf).map_or([0.0; 2], |brightest| offset(psf, brightest))
}

/// Where the star is, (x, y) from the centre of the stamp: around the centre, unless the brightest pixel is elsewhere.
pub(super) fn offset<P: Pixel>(stamp: ArrayView2<'_, P>, brightest: [usize; 2]) -> [f64; 2] {
    let (rows, columns) = stamp.dim();
    let middle = [columns, rows].map(|side| (side as f64 - 1.0) / 2.0);
    let off = |at: [f64; 2]| [at[0] - middle[0], at[1] - middle[1]];
    let here = centroid(stamp, middle);
    let near = |at: [f64; 2]| {
        let apart = [0, 1].map(|k| (at[k] - brightest[k] as f64).abs());
        apart[0].max(apart[1]) <= FARTHEST
    };
    let centred = off(here).iter().all(|off| off.abs() <= MAX_CENTROID_OFFSET);
    if centred && near(here) {
        return off(here);
    }
    // Noise makes single pixels bright, but not nine together.
    let there = brightest_nine(stamp);
    if centred && nine(stamp, here.map(|at| at.round() as usize)) >= nine(stamp, there) {
        return off(here);
    }
    off(centroid(stamp, there.map(|at| at as f64)))
}

/// The middle (x, y) of the 3 × 3 pixels that are brightest together.
fn brightest_nine<P: Pixel>(stamp: ArrayView2<'_, P>) -> [usize; 2] {
    let mut best = ([0; 2], f64::NEG_INFINITY);
    let (rows, columns) = stamp.dim();
    for y in 1..rows.saturating_sub(1) {
        for x in 1..columns.saturating_sub(1) {
            let sum = nine(stamp, [x, y]);
            if sum > best.1 {
                best = ([x, y], sum);
            }
        }
    }
    best.0
}

/// The sum of the 3 × 3 pixels around (x, y), as far as the stamp has them.
fn nine<P: Pixel>(stamp: ArrayView2<'_, P>, [x, y]: [usize; 2]) -> f64 {
    let around = |at: usize, side: usize| at.saturating_sub(1)..(at + 2).min(side);
    let (rows, columns) = stamp.dim();
    let nine = stamp.slice(s![around(y, rows), around(x, columns)]);
    nine.iter().map(|&value| -> f64 { value.into() }).sum()
}

/// The place (x, y) near `start` about which the weighted centroid of a stamp is zero; `start` if there is none.
fn centroid<P: Pixel>(stamp: ArrayView2<'_, P>, start: [f64; 2]) -> [f64; 2] {
    let gaussian = |x: f64| (-0.5 * (x / WEIGHT).powi(2)).exp();
    let range = |at: f64, side: usize| {
        let first = (at.floor() as usize + 1).saturating_sub(WEIGHT_REACH);
        first..(first + 2 * WEIGHT_REACH).min(side)
    };
    let (rows, columns) = stamp.dim();
    let mut at = start;
    for _ in 0..STEPS {
        let (xs, ys) = (range(at[0], columns), range(at[1], rows));
        let mut along = [0.0; 2 * WEIGHT_REACH];
        for (weight, x) in along.iter_mut().zip(xs.clone()) {
            *weight = gaussian(x as f64 - at[0]);
        }
        let (mut all, mut first) = (0.0, [0.0; 2]);
        for y in ys {
            let (mut of_row, mut along_row) = (0.0, 0.0);
            for (weight, x) in along.iter().zip(xs.clone()) {
                let value: f64 = stamp[(y, x)].into();
                of_row += weight * value;
                along_row += weight * value * (x as f64 - at[0]);
            }
            let dy = y as f64 - at[1];
            let weight = gaussian(dy);
            all += weight * of_row;
            first[0] += weight * along_row;
            first[1] += weight * of_row * dy;
        }
        if all <= 0.0 {
            return start;
        }
        let step = first.map(|sum| STRIDE * sum / all);
        for k in 0..2 {
            at[k] += step[k];
            if (at[k] - start[k]).abs() > FARTHEST {
                return start;
            }
        }
        if step.iter().all(|step| step.abs() < SMALL_STEP) {
            break;
        }
    }
    at
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
            centred: false,
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
        refused(&stamp, 5, "(+3.8, ");
        stamp[(0, 1)] = f32::INFINITY;
        refused(&stamp, 5, "(2, 1)");
    }
}

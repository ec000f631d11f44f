//! Stars that are cut from their stamps and normalised.
//!
//! The centre of a side of N pixels is at (N − 1)/2 counted from 0: between pixels for even N. A cut of another parity
//! starts half a pixel early, so that its central pixel (odd side) or corner (even side) is half a pixel before the
//! stamp's centre on both axes. The autocorrelation does not see such shifts. The window of the linear method does:
//! [`PsfCut::centred`] asks for a star that is shifted by half a pixel first.

use std::f64::consts::PI;

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2, s};
use shearq_submissions::PsfCut;

use crate::error::MeasureError;
use crate::moments::{MAX_STAR_SHIFT, star_centroid};
use crate::pixels::{Pixel, contiguous};

// One pixel off adds an ellipticity of about 0.01 for a PSF of 15 px. Chosen by hand.
const MAX_CENTROID_OFFSET: f64 = 1.0;
// Pixels over which the kernel of a shift ends. At ends that are abrupt, the rings of aliased light change m of odd stamps: ACS F606W at 0.05″
// per px had +6, +13 (10⁻³) on 47 px and −3, +20 on 33 px. From 12 to 20 px, all sides of 33 to 65 px have −4, −3, as aliases on a centre must.
const SHIFT_RADIUS_PX: f64 = 16.0;
// Two vectors of AVX-512 in double precision, so that an addition does not wait for the one before.
const LANES: usize = 16;

/// The pixels of a star that are used as a PSF.
#[derive(Debug, Clone)]
pub struct Star {
    /// The pixels around the star, normalised to a sum of one: the number that a configuration uses, or fewer on a small stamp.
    pub psf: Array2<f64>,
    /// Offset (x, y) of the star from the centre of its stamp in pixels, if it is above one pixel along either axis. The
    /// cut was moved by the nearest whole pixels then.
    pub moved: Option<[f64; 2]>,
    /// The pixels around the star before it was shifted by half a pixel, if it was. They show noise and aliased light: the shift makes
    /// rings of aliased light, and places the centre on a corner.
    pub(crate) unshifted: Option<Array2<f64>>,
}

impl From<Array2<f64>> for Star {
    /// A PSF that is used as it is.
    fn from(psf: Array2<f64>) -> Star {
        Star {
            psf,
            moved: None,
            unshifted: None,
        }
    }
}

impl Star {
    /// Cuts the pixels around the star on a stamp: of a size, or as many as a configuration takes and the stamp has. A
    /// star more than a pixel off the centre is cut around itself, to half a pixel.
    ///
    /// # Errors
    /// If the stamp is too small, has pixels that are not finite or no light, or the star is too near an edge.
    pub fn cut<P: Pixel>(
        stamp: ArrayView2<'_, P>,
        cut: impl Into<PsfCut>,
    ) -> Result<Star, MeasureError> {
        let cut: PsfCut = cut.into();
        let (rows, columns) = stamp.dim();
        let differs = |side: usize| cut.centred && side > cut.least && side % 2 != cut.size % 2;
        let [along_y, along_x] = [differs(rows), differs(columns)];
        if !along_y && !along_x {
            return cut_around_star(stamp, cut);
        }
        // Refuses pixels that are not finite while their places are known.
        brightest_pixel(stamp)?;
        let mut shifted = stamp.mapv(Into::<f64>::into);
        if along_y {
            shifted = half_pixel_shift(rows).dot(&shifted);
        }
        if along_x {
            shifted = shifted.dot(&half_pixel_shift(columns).t());
        }
        let found = cut_around_star(shifted.view(), cut)?;
        // Of the parity of the stamp, so that the star is in the middle of them.
        let unshifted = PsfCut {
            size: cut.size + 1,
            least: cut.least + 1,
            ..cut
        };
        let unshifted = (along_y && along_x).then(|| cut_around_star(stamp, unshifted).ok());
        Ok(Star {
            unshifted: unshifted.flatten().map(|star| star.psf),
            ..found
        })
    }
}

impl Star {
    /// The mean of several stars of one PSF, of equal weight, each shifted to the centroid of the first.
    ///
    /// # Errors
    /// If there is no star, stamps differ in size, have pixels that are not finite, or no light.
    pub fn stack<'a, P: Pixel + 'a>(
        stamps: impl IntoIterator<Item = ArrayView2<'a, P>>,
    ) -> Result<Array2<f64>, MeasureError> {
        let mut stack: Option<([f64; 2], Array2<f64>)> = None;
        for stamp in stamps {
            let light = sum(stamp);
            let offset = star_offset(stamp, brightest_pixel(stamp)?);
            if !(light > 0.0 && light.is_finite()) {
                return Err(MeasureError::DarkPsf(light));
            }
            let star = stamp.mapv(|value| Into::<f64>::into(value) / light);
            let Some((first, sum)) = &mut stack else {
                stack = Some((offset, star));
                continue;
            };
            if sum.dim() != star.dim() {
                let expected = format!("{} × {}, as the first", sum.ncols(), sum.nrows());
                return Err(MeasureError::square("a star", star.dim(), expected));
            }
            let (rows, columns) = star.dim();
            let along_y = fourier_shift(rows, rows, offset[1] - first[1]);
            let along_x = fourier_shift(columns, columns, offset[0] - first[0]);
            *sum += &along_y.dot(&star).dot(&along_x.t());
        }
        stack.map_or(Err(MeasureError::DarkPsf(0.0)), |(_, stack)| Ok(stack))
    }
}

fn cut_around_star<P: Pixel>(stamp: ArrayView2<'_, P>, cut: PsfCut) -> Result<Star, MeasureError> {
    let (rows, columns) = stamp.dim();
    let size = cut.least;
    let (Some(y0), Some(x0)) = (cut_start(rows, size), cut_start(columns, size)) else {
        let expected = format!("at least {size} × {size}, as the configuration needs");
        return Err(MeasureError::square("a PSF stamp", stamp.dim(), expected));
    };
    let brightest = brightest_pixel(stamp)?;
    let total = sum(stamp);
    let part = |size: usize, (y0, x0): (usize, usize)| {
        let part = stamp.slice_move(s![y0..y0 + size, x0..x0 + size]);
        let light = if part.dim() == stamp.dim() {
            total
        } else {
            sum(part)
        };
        (part, light)
    };
    let positive = |light: f64| {
        if light > 0.0 {
            Ok(light)
        } else {
            Err(MeasureError::DarkPsf(light))
        }
    };
    let (_, inner) = part(size, (y0, x0));
    if total <= 0.0 {
        // The search for a star elsewhere would follow noise, and its message mislead.
        positive(inner)?;
    }
    let [dx, dy] = star_offset(stamp, brightest);
    let is_centred = dx.abs() <= MAX_CENTROID_OFFSET && dy.abs() <= MAX_CENTROID_OFFSET;
    let (x0, y0, moved) = if is_centred {
        positive(inner)?;
        (x0, y0, None)
    } else {
        let moved = |start: usize, offset: f64, full: usize| {
            let start = start.checked_add_signed(offset.round() as isize)?;
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
    // By the same number of pixels on all sides, so that the parity stays.
    let room = [x0, y0, columns - size - x0, rows - size - y0];
    let more = room.into_iter().fold((cut.size - size) / 2, usize::min);
    let (taken, light) = part(size + 2 * more, (y0 - more, x0 - more));
    let scale = 1.0 / positive(light)?;
    if !scale.is_finite() {
        return Err(MeasureError::DarkPsf(light));
    }
    let psf = taken.mapv(|value| scale * Into::<f64>::into(value));
    Ok(Star {
        moved,
        ..psf.into()
    })
}

/// First pixel of a centred cut of `size` from a side of `full`; `None` where it does not fit.
pub(crate) fn cut_start(full: usize, size: usize) -> Option<usize> {
    full.checked_sub(size).map(|rest| rest / 2)
}

pub(super) fn psf_offset(psf: ArrayView2<'_, f64>) -> [f64; 2] {
    brightest_pixel(psf).map_or([0.0; 2], |brightest| star_offset(psf, brightest))
}

/// Offset (x, y) of the star from the centre of its stamp. It is looked for at the centre first, because in noise the
/// brightest pixel of a faint star may be anywhere.
fn star_offset<P: Pixel>(stamp: ArrayView2<'_, P>, brightest: [usize; 2]) -> [f64; 2] {
    let (rows, columns) = stamp.dim();
    let centre = [columns, rows].map(|side| (side as f64 - 1.0) / 2.0);
    let offset = |at: [f64; 2]| [at[0] - centre[0], at[1] - centre[1]];
    let here = star_centroid(stamp, centre);
    let is_near = (0..2).all(|k| (here[k] - brightest[k] as f64).abs() <= MAX_STAR_SHIFT);
    let is_centred = offset(here)
        .iter()
        .all(|off| off.abs() <= MAX_CENTROID_OFFSET);
    if is_centred && is_near {
        return offset(here);
    }
    // Noise makes single pixels bright, but not nine together.
    let there = brightest_3x3(stamp);
    if is_centred && sum_3x3(stamp, here.map(|at| at.round() as usize)) >= sum_3x3(stamp, there) {
        return offset(here);
    }
    offset(star_centroid(stamp, there.map(|at| at as f64)))
}

fn brightest_pixel<P: Pixel>(stamp: ArrayView2<'_, P>) -> Result<[usize; 2], MeasureError> {
    let mut best = ([0, 0], f64::NEG_INFINITY);
    for (y, row) in stamp.into_outer_iter().enumerate() {
        let row = contiguous(row);
        let find = |matches: &dyn Fn(f64) -> bool| {
            let found = row.iter().position(|&value| matches(value.into()));
            found.unwrap_or(0)
        };
        let Some(largest) = largest_finite(&row) else {
            return Err(MeasureError::NotFinite {
                what: "PSF stamp",
                x: find(&|value| !value.is_finite()) + 1,
                y: y + 1,
            });
        };
        if largest > best.1 {
            best = ([find(&|value| value == largest), y], largest);
        }
    }
    Ok(best.0)
}

/// The pixel (x, y) whose 3 × 3 surroundings are brightest.
fn brightest_3x3<P: Pixel>(stamp: ArrayView2<'_, P>) -> [usize; 2] {
    let mut best = ([0; 2], f64::NEG_INFINITY);
    let (rows, columns) = stamp.dim();
    for y in 1..rows.saturating_sub(1) {
        for x in 1..columns.saturating_sub(1) {
            let sum = sum_3x3(stamp, [x, y]);
            if sum > best.1 {
                best = ([x, y], sum);
            }
        }
    }
    best.0
}

fn sum_3x3<P: Pixel>(stamp: ArrayView2<'_, P>, [x, y]: [usize; 2]) -> f64 {
    let around = |at: usize, side: usize| at.saturating_sub(1)..(at + 2).min(side);
    let (rows, columns) = stamp.dim();
    let pixels = stamp.slice(s![around(y, rows), around(x, columns)]);
    pixels.iter().map(|&value| -> f64 { value.into() }).sum()
}

/// The matrix that interpolates `from` periodic samples at `to` places from `first` on: Dirichlet's
/// kernel.
///
/// Light at frequencies beyond the sampling comes back with the wrong sign: 1.5e-3 of the peak of a Moffat profile with
/// a FWHM of 3.4 pixels, a sixth of it at 4 pixels.
pub(super) fn fourier_shift(from: usize, to: usize, first: f64) -> Array2<f64> {
    let n = from as f64;
    Array2::from_shape_fn((to, from), |(row, column)| {
        let t = row as f64 - column as f64 + first;
        let angle = PI * t / n;
        let divisor = if from.is_multiple_of(2) {
            angle.tan()
        } else {
            angle.sin()
        };
        if divisor.abs() < 1e-12 {
            return 1.0;
        }
        (PI * t).sin() / (n * divisor)
    })
}

/// The matrix that interpolates samples halfway to the next ones: sin(πt)/(πt), which ends smoothly.
fn half_pixel_shift(from: usize) -> Array2<f64> {
    let radius = SHIFT_RADIUS_PX.min(0.5 * from as f64);
    Array2::from_shape_fn((from - 1, from), |(row, column)| {
        let t = row as f64 - column as f64 + 0.5;
        let taper = (0.5 * PI * (t / radius).abs().min(1.0)).cos().powi(2);
        taper * (PI * t).sin() / (PI * t)
    })
}

fn sum<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of::<P, false>(pixels)
}

pub(super) fn sum_of_squares<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of::<P, true>(pixels)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_of<P: Pixel, const SQUARES: bool>(pixels: ArrayView2<'_, P>) -> f64 {
    let term = |value: &P| -> f64 {
        let value: f64 = (*value).into();
        if SQUARES { value * value } else { value }
    };
    let mut sums = [0.0; LANES];
    for row in pixels.into_outer_iter() {
        let row = contiguous(row);
        let (whole, rest) = row.as_chunks::<LANES>();
        // A copy stays in registers, while the iterator below needs `sums` in memory.
        let mut lanes = sums;
        for values in whole {
            for lane in 0..LANES {
                lanes[lane] += term(&values[lane]);
            }
        }
        sums = lanes;
        for (sum, value) in sums.iter_mut().zip(rest) {
            *sum += term(value);
        }
    }
    sums.iter().sum()
}

/// The largest value; `None` if one is not finite.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn largest_finite<P: Pixel>(values: &[P]) -> Option<f64> {
    let larger = |a: f64, b: f64| if b > a { b } else { a };
    let (mut largest, mut zeros) = ([f64::NEG_INFINITY; LANES], [0.0; LANES]);
    let (whole, rest) = values.as_chunks::<LANES>();
    for values in whole {
        for lane in 0..LANES {
            let value: f64 = values[lane].into();
            largest[lane] = larger(largest[lane], value);
            // NaN unless the value is finite: a sum needs no branch.
            zeros[lane] += 0.0 * value;
        }
    }
    for (lane, value) in rest.iter().enumerate() {
        let value: f64 = (*value).into();
        largest[lane] = larger(largest[lane], value);
        zeros[lane] += 0.0 * value;
    }
    let is_finite = zeros.iter().sum::<f64>() == 0.0;
    is_finite.then(|| largest.into_iter().fold(f64::NEG_INFINITY, larger))
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, ArrayView2, s};

    use super::*;
    use crate::psf::testing::{cut, limits, moffat};
    use crate::testing::close;

    #[test]
    fn small_star_stamps_keep_their_centre() {
        let sides = limits(48, 32, false);
        let stamp = moffat(3.4).stamp(64);
        for (given, expected) in [(32, 32), (37, 36), (48, 48), (64, 48)] {
            let from = cut_start(64, given).unwrap();
            let star = stamp.slice(s![from..from + given, from..from + given]);
            let taken = cut(star, sides);
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
        assert!(Star::cut(stamp.slice(s![..31, ..31]), sides).is_err());
    }

    #[test]
    fn rings_of_a_shift_end_before_the_edge() {
        let mut point = Array2::zeros((47, 47));
        point[(23, 23)] = 1.0;
        let shifted = cut(point.view(), limits(48, 32, true));
        assert!(shifted[(22, 30)].abs() > 1e-3);
        assert!(shifted[(22, 2)].abs() < 1e-12);
    }

    #[test]
    fn stacked_stars_are_at_the_place_of_the_first() {
        let psf = moffat(3.4);
        let star = psf.stamp(48);
        let moved = |dx: f64, dy: f64| {
            let along = |offset: f64| fourier_shift(48, 48, -offset);
            3.0 * along(dy).dot(&star).dot(&along(dx).t())
        };
        let others = [moved(0.4, -0.9), moved(-0.25, 0.1)];
        let all = [star.view(), others[0].view(), others[1].view()];
        let stack = Star::stack(all).unwrap() / 3.0;
        let light = star.sum();
        for (found, expected) in stack.iter().zip(&star) {
            // Centroids are found to 10⁻³ px.
            close(*found, expected / light, 1e-4);
        }
        assert!(Star::stack([star.view(), star.slice(s![1.., 1..])]).is_err());
        assert!(Star::stack(std::iter::empty::<ArrayView2<'_, f64>>()).is_err());
    }

    #[test]
    fn unusable_stars_are_refused_with_the_reason() {
        let mut stamp = Array2::<f32>::zeros((9, 9));
        let refused = |stamp: &Array2<f32>, size: usize, expected: &str| {
            let message = Star::cut(stamp.view(), size).unwrap_err().to_string();
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

    #[test]
    fn a_star_of_the_other_parity_is_drawn_on_the_cut() {
        let psf = moffat(4.0);
        for (given, size) in [(49, 48), (53, 48), (33, 32), (48, 47), (64, 49)] {
            let sides = limits(size, size, true);
            let found = cut(psf.stamp(given).view(), sides);
            let expected = cut(psf.stamp(size + 6).view(), sides);
            let peak = expected.iter().copied().fold(0.0, f64::max);
            let inner = s![8..size - 8, 8..size - 8];
            for (a, b) in found.slice(inner).iter().zip(expected.slice(inner)) {
                // The light beyond the stamp, of which a Moffat profile has 1e-3 here, comes back at the other side.
                assert!((a - b).abs() < 1e-3 * peak, "{given} to {size}: {a} {b}");
            }
        }
        // Only one side is of the other parity.
        let cut = Star::cut(Array2::<f32>::ones((9, 8)).view(), limits(8, 8, true));
        assert_eq!(cut.unwrap().psf.dim(), (8, 8));
    }

    #[test]
    fn largest_values_are_found_unless_one_is_not_finite() {
        for count in [1, 16, 23] {
            for at in 0..count {
                let mut values = vec![-3.0f32; count];
                values[at] = -2.0;
                assert_eq!(largest_finite(&values), Some(-2.0));
                for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    values[at] = bad;
                    assert_eq!(largest_finite(&values), None);
                }
            }
        }
    }

    #[test]
    fn sums_do_not_depend_on_the_layout_in_memory() {
        for (rows, columns) in [(1, 1), (3, 16), (7, 23), (48, 40)] {
            let wide = Array2::from_shape_fn((rows + 2, 2 * columns), |(y, x)| {
                ((31 * y + 17 * x) % 101) as f64 - 20.0
            });
            for view in [
                wide.slice(s![1..=rows, 1..=columns]),
                wide.slice(s![1..=rows, ..;2]),
                wide.slice(s![1..=rows, ..columns]),
            ] {
                // Whole numbers: exact in any order.
                assert_eq!(sum(view), view.iter().sum::<f64>());
                let squares: f64 = view.iter().map(|value| value * value).sum();
                assert_eq!(sum_of_squares(view), squares);
            }
            let thirds = wide.mapv(|value| value / 3.0);
            let apart = thirds.slice(s![1..=rows, ..;2]);
            assert_eq!(sum(apart), sum(apart.to_owned().view()));
            let transposed = apart.reversed_axes().as_standard_layout().into_owned();
            assert_eq!(sum(apart), sum(transposed.view().reversed_axes()));
        }
    }
}

//! Point-spread functions: formulas, and stars that are cut from their stamps and normalised.
//!
//! The centre of a side of N pixels is at (N − 1)/2 counted from 0: between pixels for even N. A cut of another parity
//! starts half a pixel early, so that its central pixel (odd side) or corner (even side) is half a pixel before the
//! stamp's centre on both axes. The autocorrelation does not see such shifts. The window of the linear method does:
//! [`PsfCut::centred`] asks for a star that is shifted by half a pixel first.
//!
//! # Widths and shapes
//!
//! The lengths of the linear method follow the width in steps, and catalogues can be tested for leakage by the shape.
//!
//! # Quality
//!
//! [`PsfQuality`] shows whether a PSF image is what the measurement requires: background subtracted, enough light over the noise,
//! sampled with the pixels of the galaxies. Everything is measured on the pixels that are used, of sum one. The border of a PSF holds its wings, so that its level
//! alone does not show a background: wings are not negative and fall at least like r^(−2.5), and only what lies outside
//! these bounds counts as a background.

mod denoised_star;

use std::borrow::Cow;
use std::f64::consts::PI;
use std::ops::{Range, RangeInclusive};

use multiversion::multiversion;
use ndarray::{ArcArray2, Array2, ArrayView2, ArrayView3, Axis, Ix2, Ix3, s};
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{Distortion, FunctionalPsf, Jacobian, Shear};
use shearq_submissions::PsfCut;

use self::denoised_star::{MIN_DENOISED_SIDE, UNCHANGED_SNR, noise_level};
pub(crate) use self::denoised_star::{ResidualProfiles, StarDenoiser, StarSurvey};
use crate::error::MeasureError;
use crate::examine::{ExaminedPsfs, Warning};
use crate::measurement::PsfShape;
use crate::stamp::{
    CoreSize, MAX_STAR_SHIFT, Pixel, Pixels, contiguous, psf_core_size, star_centroid,
};

// Above it stars differ by more than their noise, and count alike. Chosen by hand.
const MAX_WEIGHT_SNR: f64 = 1000.0;

/// The PSFs of galaxies, borrowed from the caller or owned.
#[derive(Debug, Clone)]
pub enum Psfs<'a> {
    /// One PSF for all galaxies, used as it is: centred, of sum one, and with the pixels that [`Star::cut`] cuts. Clones
    /// share its pixels.
    Prepared(ArcArray2<f64>),
    /// One star stamp for all galaxies, which is cut around the star and normalised.
    Star(Pixels<'a, Ix2>),
    /// Star stamps, one per galaxy along the first axis.
    Stars(Pixels<'a, Ix3>),
    /// Formulas, one per galaxy.
    Functional(Cow<'a, [FunctionalPsf]>),
}

impl<'a> Psfs<'a> {
    /// [`Psfs::Prepared`] of an array. An owned array is not copied if it is passed as [`ArcArray2`].
    pub fn prepared(psf: ArrayView2<'_, f64>) -> Self {
        Psfs::Prepared(psf.to_shared())
    }

    /// [`Psfs::Star`] of a view or an array of `f32` or `f64`.
    pub fn star(stamp: impl Into<Pixels<'a, Ix2>>) -> Self {
        Psfs::Star(stamp.into())
    }

    /// [`Psfs::Stars`] of a view or an array of `f32` or `f64`.
    pub fn stars(stamps: impl Into<Pixels<'a, Ix3>>) -> Self {
        Psfs::Stars(stamps.into())
    }

    /// [`Psfs::Functional`] of a slice or a vector.
    pub fn functional(formulas: impl Into<Cow<'a, [FunctionalPsf]>>) -> Self {
        Psfs::Functional(formulas.into())
    }

    /// The PSFs of some galaxies, borrowed.
    pub fn slice(&self, galaxies: Range<usize>) -> Psfs<'_> {
        match self {
            Psfs::Prepared(psf) => Psfs::Prepared(psf.clone()),
            Psfs::Star(stamp) => Psfs::Star(stamp.view()),
            Psfs::Stars(stamps) => Psfs::Stars(stamps.view().into_slice(galaxies)),
            Psfs::Functional(formulas) => Psfs::functional(&formulas[galaxies]),
        }
    }

    /// The number of PSFs if there is one per galaxy; `None` for one PSF for all.
    pub fn count(&self) -> Option<usize> {
        match self {
            Psfs::Prepared(_) | Psfs::Star(_) => None,
            Psfs::Stars(stamps) => Some(stamps.dim().0),
            Psfs::Functional(formulas) => Some(formulas.len()),
        }
    }

    /// The PSF of galaxy `k` as it is deconvolved, for galaxies on stamps of `full` pixels a side: cut, of sum one, and
    /// with the offset by which a star was moved to the centre.
    ///
    /// # Errors
    /// If there are no more than `k` PSFs, or this PSF cannot be used.
    pub fn at(&self, k: usize, cut: PsfCut, full: usize) -> Result<Star, MeasureError> {
        if let Some(count) = self.count().filter(|count| *count <= k) {
            return Err(MeasureError::Shape {
                what: "PSFs",
                found: format!("{count} galaxies"),
                expected: format!("more than {k}, one each"),
            });
        }
        let unmoved = |psf: Array2<f64>| Star { psf, moved: None };
        match self {
            Psfs::Prepared(psf) => Ok(unmoved(psf.to_owned())),
            Psfs::Star(Pixels::Single(stamp)) => Star::cut(stamp.view(), cut),
            Psfs::Star(Pixels::Double(stamp)) => Star::cut(stamp.view(), cut),
            Psfs::Stars(Pixels::Single(stamps)) => Star::cut(stamps.index_axis(Axis(0), k), cut),
            Psfs::Stars(Pixels::Double(stamps)) => Star::cut(stamps.index_axis(Axis(0), k), cut),
            Psfs::Functional(formulas) => {
                let FunctionalPsf {
                    profile,
                    fwhm,
                    shape,
                } = formulas[k];
                // The fields are public, and may have been assembled with values that are not a PSF.
                let psf = FunctionalPsf::new(profile, fwhm, shape)?;
                Ok(unmoved(psf.stamp_beside(cut.size, full)))
            }
        }
    }
}

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

// One pixel off adds an ellipticity of about 0.01 for a PSF of 15 px. Chosen by hand.
const MAX_CENTROID_OFFSET: f64 = 1.0;
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
            shifted = fourier_shift(rows, rows - 1, 0.5).dot(&shifted);
        }
        if along_x {
            shifted = shifted.dot(&fourier_shift(columns, columns - 1, 0.5).t());
        }
        cut_around_star(shifted.view(), cut)
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
    Ok(Star { psf, moved })
}

/// First pixel of a centred cut of `size` from a side of `full`; `None` where it does not fit.
pub(crate) fn cut_start(full: usize, size: usize) -> Option<usize> {
    full.checked_sub(size).map(|rest| rest / 2)
}

fn psf_offset(psf: ArrayView2<'_, f64>) -> [f64; 2] {
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
fn fourier_shift(from: usize, to: usize, first: f64) -> Array2<f64> {
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

fn sum<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of::<P, false>(pixels)
}

fn sum_of_squares<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
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
        for values in whole {
            for lane in 0..LANES {
                sums[lane] += term(&values[lane]);
            }
        }
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

// In σ of the weight, as GalSim's HSM takes pixels.
const RADIUS_SIGMAS: f64 = 5.0;
// Change of the moments, in units of their trace, below which they count as found. Chosen by hand: what remains is below 4·10⁻⁷
// of an ellipticity, because steps of Moffat profiles fall by factors of 4 to 6, of others faster.
const CONVERGED: f64 = 1e-6;
// Moffat profiles need about eight. Chosen by hand.
const MAX_ITERATIONS: usize = 100;
// A vector of AVX-512 in double precision.
const COLUMN_LANES: usize = 8;

impl PsfShape {
    /// Of the pixels of a PSF; NaN if the moments do not converge, as for a PSF that is mostly noise.
    pub(crate) fn from_psf(psf: ArrayView2<'_, f64>) -> Self {
        let round = gaussian_variance(noise_equivalent_area(psf));
        let (mut moments, mut centre) = ([round, 0.0, round], [0.0; 2]);
        for _ in 0..MAX_ITERATIONS {
            let Some((weighted, shift)) = weighted_moments(psf, moments, centre) else {
                break;
            };
            // A Gaussian under the weight W has the inverse moments C⁻¹ + M⁻¹, so that this step is exact for one, where doubling the
            // weighted moments needs twenty.
            let (Some(seen), Some(own)) = (inverse(weighted), inverse(moments)) else {
                break;
            };
            let Some(next) = inverse([0, 1, 2].map(|k| seen[k] - own[k])) else {
                break;
            };
            let changes = [0, 1, 2].map(|k| (next[k] - moments[k]).abs());
            let change = changes.into_iter().fold(0.0, f64::max) / (next[0] + next[2]);
            moments = next;
            centre = [0, 1].map(|axis| centre[axis] + 2.0 * shift[axis]);
            if change < CONVERGED {
                return PsfShape { moments };
            }
        }
        PsfShape::UNKNOWN
    }

    /// In the frame of the sky, for pixels with this Jacobian. Adaptive moments follow linear maps, so that they need not be
    /// measured again.
    pub(crate) fn on_sky(self, jacobian: &Jacobian) -> Self {
        let scale = jacobian.pixel_scale();
        let [[a, b], [c, d]] = jacobian.matrix().map(|row| row.map(|value| value / scale));
        let [xx, xy, yy] = self.moments;
        PsfShape {
            moments: [
                a * a * xx + 2.0 * a * b * xy + b * b * yy,
                a * c * xx + (a * d + b * c) * xy + b * d * yy,
                c * c * xx + 2.0 * c * d * xy + d * d * yy,
            ],
        }
    }

    /// The mean of the moments of several PSFs with weights, in pixels of the areas given.
    pub(crate) fn mean(of: impl Iterator<Item = (Self, f64, f64)>) -> Self {
        let (mut sums, mut total) = ([0.0; 3], 0.0);
        for (PsfShape { moments }, area, weight) in of {
            sums = [0, 1, 2].map(|k| sums[k] + weight * area * moments[k]);
            total += weight;
        }
        PsfShape {
            moments: sums.map(|sum| sum / total),
        }
    }

    /// The ellipticity, of shear type (1 − q)/(1 + q) in either kind of catalogue; NaN if unknown.
    pub fn ellipticity(&self) -> [f64; 2] {
        let [xx, xy, yy] = self.moments;
        let trace = xx + yy;
        let shear = Distortion::new((xx - yy) / trace, 2.0 * xy / trace).to_shear();
        shear.map_or([f64::NAN; 2], |Shear { e1, e2 }| [e1, e2])
    }

    /// (det M)^¼ in pixels: σ of the round Gaussian of the same area; NaN if unknown.
    pub fn sigma(&self) -> f64 {
        let [xx, xy, yy] = self.moments;
        (xx * yy - xy * xy).sqrt().sqrt()
    }
}

/// Inverse of a symmetric matrix; `None` unless it is positive definite.
fn inverse([xx, xy, yy]: [f64; 3]) -> Option<[f64; 3]> {
    let determinant = xx * yy - xy * xy;
    (xx > 0.0 && determinant > 0.0 && determinant.is_finite())
        .then(|| [yy, -xy, xx].map(|value| value / determinant))
}

/// Second moments about the centroid under a Gaussian weight of these `moments` about `centre`, and that centroid from `centre`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weighted_moments(
    psf: ArrayView2<'_, f64>,
    moments: [f64; 3],
    centre: [f64; 2],
) -> Option<([f64; 3], [f64; 2])> {
    let [a, b, c] = inverse(moments)?;
    let (rows, columns) = psf.dim();
    let middle = [columns, rows].map(|side| (side as f64 - 1.0) / 2.0);
    let at = [0, 1].map(|axis| middle[axis] + centre[axis]);
    let within = |axis: usize, side: usize| {
        let reach = RADIUS_SIGMAS * moments[2 * axis].sqrt();
        let first = (at[axis] - reach).ceil().max(0.0) as usize;
        first..(((at[axis] + reach).floor() + 1.0).max(0.0) as usize).min(side)
    };
    let (across, down) = (within(0, columns), within(1, rows));
    let [x0, y0] = [across.start as f64 - at[0], down.start as f64 - at[1]];
    // The weight is exp(−½(a x² + 2 b x y + c y²)): its values in the first row, and what takes them to the next row, follow by
    // steps along x, so that no pixel needs an exponential.
    let mut weight = (-0.5 * (a * x0 * x0 + 2.0 * b * x0 * y0 + c * y0 * y0)).exp();
    let mut step = (-0.5 * a * (2.0 * x0 + 1.0) - b * y0).exp();
    let mut down_step = (-0.5 * c * (2.0 * y0 + 1.0) - b * x0).exp();
    let [of_step, of_down_step, from_row_to_row] = [a, b, c].map(|value| (-value).exp());
    let mut sums = [0.0; 6];
    for first in across.clone().step_by(COLUMN_LANES) {
        let [mut weights, mut steps] = [[0.0; COLUMN_LANES]; 2];
        for lane in 0..COLUMN_LANES.min(across.end - first) {
            (weights[lane], steps[lane]) = (weight, down_step);
            weight *= step;
            step *= of_step;
            down_step *= of_down_step;
        }
        let [mut light, mut of_y, mut of_yy] = [[0.0; COLUMN_LANES]; 3];
        let mut y = y0;
        for row in psf.outer_iter().skip(down.start).take(down.len()) {
            let row = contiguous(row);
            let pixels: [f64; COLUMN_LANES] =
                row[first..].first_chunk().copied().unwrap_or_else(|| {
                    std::array::from_fn(|lane| row.get(first + lane).copied().unwrap_or(0.0))
                });
            for lane in 0..COLUMN_LANES {
                let value = weights[lane] * pixels[lane];
                light[lane] += value;
                of_y[lane] += value * y;
                of_yy[lane] += value * (y * y);
                weights[lane] *= steps[lane];
                steps[lane] *= from_row_to_row;
            }
            y += 1.0;
        }
        for lane in 0..COLUMN_LANES {
            let x = (first + lane) as f64 - at[0];
            let [light, of_y, of_yy] = [light[lane], of_y[lane], of_yy[lane]];
            let more = [light, light * x, of_y, light * x * x, of_y * x, of_yy];
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += more;
            }
        }
    }
    let [light, x, y, xx, xy, yy] = sums;
    if light <= 0.0 || !light.is_finite() {
        return None;
    }
    let [x, y, xx, xy, yy] = [x, y, xx, xy, yy].map(|sum| sum / light);
    Some(([xx - x * x, xy - x * y, yy - y * y], [x, y]))
}

// Width in pixels of the border of a star's stamp, from which its noise and background are measured. Chosen by hand.
const BORDER: usize = 2;
// Distances from the centre, in units of half the side, of the pixels with which the border is compared.
const HALFWAY: std::ops::Range<f64> = 0.5..0.65;
// Power of the radius: slower than the averaged rings of an Airy disc (3) and turbulence (11/3).
const SLOWEST_WING: f64 = 2.5;
// Chosen by hand, for all warnings.
const SIGNIFICANCE: f64 = 5.0;
// Light of a background, in units of the star's. Above it |m| may exceed 2·10⁻³. Chosen by hand.
const MAX_BACKGROUND: f64 = 0.1;
// In units of the peak: stamps without a star have any level.
const MAX_STATED_LEVEL: f64 = 100.0;
// Light of a gradient that is extrapolated from the brighter edge, in units of the star's. Chosen by hand.
const MAX_GRADIENT: f64 = 0.3;
// At S/N 1000 the noise of one star changes m by 3.1·10⁻³: docs/limitations.md.
const MIN_SNR_SHARED: f64 = 1000.0;
// Of a star per galaxy, the noise averages out. Chosen by hand.
const MIN_SNR_EACH: f64 = 100.0;
// Noise-equivalent area in px² of the narrowest PSF that pixels sample. A FWHM of about 1 px.
const MIN_AREA: f64 = 6.0;
// Mean square radius of the PSF's core in units of the galaxies', above which a warning is due. Simulated galaxies, PSF of
// FWHM 3.4 px: 0.48 to 0.53; PSF 1.3 times too wide: 0.75; 1.4 times: 0.86 to 0.93. Command and seed not recorded.
const MAX_CORE_RATIO: f64 = 0.83;
// The same ratio above which an error is due. The same simulation, PSF 1.5 times too wide: 0.97 to 1.06. Stars have 1.
const IMPOSSIBLE_CORE_RATIO: f64 = 1.02;
// Share of the PSFs of an image that a warning requires. Chosen by hand.
const MIN_SHARE: f64 = 0.1;
// Standard deviations of m and of c by the noise of one star, times its S/N, below S/N 500.
// Table star-noise of docs/ledger.csv, 40 realizations of the noise per S/N: m 2.2 to 2.4, c 1.16 to 1.20 at S/N 50 to 500.
const BIAS_TIMES_SNR: [f64; 2] = [2.3, 1.2];
// The same for a star that is not denoised. The same table at S/N 1000: 0.0055 and 0.0023.
const BIAS_TIMES_SNR_UNCHANGED: [f64; 2] = [5.5, 2.3];

#[derive(Debug, Clone, Copy)]
pub(crate) struct PsfQuality {
    side: usize,
    snr: f64,
    /// Background: level in units of the peak, light in units of the star's.
    level: f64,
    background: f64,
    /// Gradient of the background: change per pixel in units of the peak, light in units of the star's.
    slope: [f64; 2],
    gradient: f64,
    area: f64,
    core: Option<CoreSize>,
    moved: Option<[f64; 2]>,
    /// Centroid from the centre of the pixels that are used.
    pub(crate) offset: [f64; 2],
}

impl PsfQuality {
    /// S/N of the star; infinite without noise.
    pub(crate) fn snr(&self) -> f64 {
        self.snr
    }

    /// Standard deviations of m and c by the noise of the star, if all galaxies share it.
    pub(crate) fn noise_bias(&self) -> [f64; 2] {
        let [denoised, unchanged] = UNCHANGED_SNR;
        if self.side < MIN_DENOISED_SIDE || self.snr >= unchanged {
            return BIAS_TIMES_SNR_UNCHANGED.map(|times| times / self.snr.max(1.0));
        }
        // Between the two, less and less of the noise is removed.
        BIAS_TIMES_SNR.map(|times| times / self.snr.clamp(1.0, denoised))
    }

    /// Of a PSF of sum one, which was `moved` by so much to its centre; `None` if it is too small, or a pixel is not
    /// finite.
    pub(crate) fn from_psf(
        psf: ArrayView2<'_, f64>,
        moved: Option<[f64; 2]>,
    ) -> Option<PsfQuality> {
        let n = psf.nrows();
        if n != psf.ncols() || n < 4 * BORDER || psf.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let distance = |x: usize, y: usize| {
            let along = |at: usize| (at as f64 - middle).abs();
            along(x).max(along(y))
        };
        let (mut border, mut halfway, mut edges) =
            (Mean::default(), Mean::default(), [Mean::default(); 4]);
        let mut peak = f64::NEG_INFINITY;
        for ((y, x), &value) in psf.indexed_iter() {
            let away = distance(x, y);
            for (edge, at) in edges.iter_mut().zip([x, n - 1 - x, y, n - 1 - y]) {
                if at < BORDER {
                    edge.add(value, away);
                }
            }
            if away > middle - BORDER as f64 {
                border.add(value, away);
            } else if HALFWAY.contains(&(away / (middle + 0.5))) {
                halfway.add(value, away);
            }
            peak = peak.max(value);
        }
        let sigma = noise_level(psf, &mut Vec::new());
        // The level below the slowest wing through both rings; a negative border has no wing.
        let fall = (halfway.radius() / border.radius()).powf(SLOWEST_WING);
        let below_wing = (border.mean() - fall * halfway.mean()) / (1.0 - fall);
        let level = if below_wing > 0.0 {
            below_wing
        } else {
            border.mean().min(0.0)
        };
        let error =
            sigma * (1.0 / border.count + fall * fall / halfway.count).sqrt() / (1.0 - fall);
        let level = if level.abs() > SIGNIFICANCE * error {
            level
        } else {
            0.0
        };
        let pixels = (n * n) as f64;
        let star = (1.0 - level * pixels).max(f64::MIN_POSITIVE);
        let [left, right, bottom, top] = edges.map(|edge| edge.mean());
        let across = (n - BORDER) as f64;
        let error = sigma * 2f64.sqrt() / (edges[0].count.sqrt() * across);
        let slope = [(right - left) / across, (top - bottom) / across];
        let steep = slope[0].hypot(slope[1]);
        let steep = if steep > SIGNIFICANCE * error {
            steep
        } else {
            0.0
        };
        // Not the S/N of all pixels, by which stars are denoised: a background is no light here, and outer pixels hold
        // more noise than light.
        let (mut power, mut count) = (0.0, 0.0);
        for ((y, x), &value) in psf.indexed_iter() {
            let away = distance(x, y);
            if away < HALFWAY.start * (middle + 0.5) {
                power += (value - border.mean()).powi(2);
                count += 1.0;
            }
        }
        let peak = (peak - border.mean()).max(f64::MIN_POSITIVE);
        let area = noise_equivalent_area(psf);
        let offset = psf_offset(psf);
        Some(PsfQuality {
            side: n,
            snr: (power - count * sigma * sigma).max(0.0).sqrt() / sigma,
            level: (level / peak).clamp(-MAX_STATED_LEVEL, MAX_STATED_LEVEL),
            background: level * pixels / star,
            slope: slope.map(|slope| slope / peak),
            gradient: steep * 0.5 * n as f64 * pixels / star,
            // More noise than light, or light without end, has no area.
            area: if area > 0.0 && area < pixels {
                area
            } else {
                f64::INFINITY
            },
            core: psf_core_size(psf, offset, border.mean(), sigma),
            moved,
            offset,
        })
    }
}

/// Means over pixels: of their values, and of their distances from the centre.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    radii: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64, radius: f64) {
        self.sum += value;
        self.radii += radius;
        self.count += 1.0;
    }

    fn mean(&self) -> f64 {
        self.sum / self.count
    }

    fn radius(&self) -> f64 {
        self.radii / self.count
    }
}

/// The PSFs of an image with one defect, if they are more than a few.
struct Defective<'a> {
    psfs: Vec<&'a PsfQuality>,
    of: ExaminedPsfs,
}

impl<'a> Defective<'a> {
    fn among(
        all: &'a [PsfQuality],
        is_defective: impl Fn(&PsfQuality) -> bool,
    ) -> Option<Defective<'a>> {
        let psfs: Vec<_> = all.iter().filter(|psf| is_defective(psf)).collect();
        let (count, of) = (psfs.len(), all.len());
        let is_many = count > 0 && count as f64 >= MIN_SHARE * of as f64;
        is_many.then_some(Defective {
            psfs,
            of: ExaminedPsfs { count, of },
        })
    }

    fn median(&self, value: impl Fn(&PsfQuality) -> f64) -> f64 {
        let mut values: Vec<f64> = self.psfs.iter().map(|psf| value(psf)).collect();
        upper_median(&mut values).unwrap_or(f64::NAN)
    }
}

/// Warnings about the PSFs of an image, `shared` by all galaxies or not, whose galaxies have the core `galaxies`.
pub(crate) fn psf_warnings(
    all: &[PsfQuality],
    shared: bool,
    galaxies: Option<CoreSize>,
) -> Vec<Warning> {
    let mut found = Vec::new();
    if let Some(psfs) = Defective::among(all, |psf| psf.moved.is_some()) {
        let offset = |k: usize| psfs.median(|psf| psf.moved.map_or(0.0, |moved| moved[k]));
        found.push(Warning::PsfOffCentre {
            offset: [offset(0), offset(1)],
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.background.abs() > MAX_BACKGROUND) {
        found.push(Warning::PsfBackground {
            level: psfs.median(|psf| psf.level),
            share: psfs.median(|psf| psf.background),
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.gradient > MAX_GRADIENT) {
        found.push(Warning::PsfGradient {
            slope: [0, 1].map(|k| psfs.median(|psf| psf.slope[k])),
            of: psfs.of,
        });
    }
    let enough = if shared { MIN_SNR_SHARED } else { MIN_SNR_EACH };
    if let Some(psfs) = Defective::among(all, |psf| psf.snr < enough) {
        found.push(Warning::PsfNoise {
            snr: psfs.median(|psf| psf.snr),
            enough,
            effect: shared.then(|| [0, 1].map(|k| psfs.median(|psf| psf.noise_bias()[k]))),
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.area < MIN_AREA) {
        found.push(Warning::PsfNarrow {
            area: psfs.median(|psf| psf.area),
            of: psfs.of,
        });
    }
    found.extend(galaxies.and_then(|galaxies| too_wide(all, galaxies)));
    found
}

/// A galaxy has no narrower core than its PSF, so that a PSF as wide as the galaxies is one of other data.
fn too_wide(all: &[PsfQuality], galaxies: CoreSize) -> Option<Warning> {
    let mut cores: Vec<CoreSize> = all.iter().filter_map(|psf| psf.core).collect();
    cores.sort_by(|a, b| a.mean_square_radius.total_cmp(&b.mean_square_radius));
    let psf = cores.get(cores.len() / 2)?;
    let exceeds = |ratio: f64| {
        let error = psf.error.hypot(ratio * galaxies.error);
        psf.mean_square_radius - ratio * galaxies.mean_square_radius > SIGNIFICANCE * error
    };
    exceeds(MAX_CORE_RATIO).then(|| Warning::PsfBroad {
        psf: psf.fwhm(),
        galaxies: galaxies.fwhm(),
        fatal: exceeds(IMPOSSIBLE_CORE_RATIO),
    })
}

#[cfg(test)]
mod tests;

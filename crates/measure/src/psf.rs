//! Point-spread functions: formulas, and stars that are cut from their stamps and normalised.
//!
//! The centre of a side of N pixels is at (N − 1)/2 counted from 0: between pixels for even N. A cut of another parity
//! starts half a pixel early, so that its central pixel (odd side) or corner (even side) is half a pixel before the
//! stamp's centre on both axes. The autocorrelation does not see such shifts. The window of the linear method does:
//! [`PsfCut::centred`] asks for a star that is shifted by half a pixel first.

mod denoised_star;
pub(crate) mod quality;
mod residual_profile;
mod shape;

use std::borrow::Cow;
use std::f64::consts::PI;
use std::ops::Range;

use multiversion::multiversion;
use ndarray::{ArcArray2, Array2, ArrayView2, ArrayView3, Axis, Ix2, Ix3, s};
use shearq_quantities::FunctionalPsf;
use shearq_submissions::PsfCut;

pub(crate) use self::denoised_star::StarDenoiser;
use self::quality::PsfQuality;
pub(crate) use self::residual_profile::{ResidualProfiles, StarSurvey};
pub(crate) use self::shape::{
    WIDTH_STEPS, noise_equivalent_area, width_factor, width_step, width_step_of_area,
};
use crate::error::MeasureError;
use crate::moments::{MAX_STAR_SHIFT, star_centroid};
use crate::stamp::{Pixel, Pixels, contiguous};

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

#[cfg(test)]
mod test_stars {
    use ndarray::{Array2, ArrayView2};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    /// A star of sum one on a stamp of `side` pixels.
    pub(super) fn drawn(profile: PsfProfile, fwhm: f64, shear: Shear, side: usize) -> Array2<f64> {
        FunctionalPsf::new(profile, fwhm, shear)
            .unwrap()
            .stamp(side)
    }

    /// The star with white noise, again of sum one.
    pub(super) fn noisy(psf: &Array2<f64>, snr: f64, rng: &mut ChaCha8Rng) -> Array2<f64> {
        let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
        let star = psf.mapv(|value| {
            let noise: f64 = StandardNormal.sample(rng);
            value + sigma * noise
        });
        let sum = star.sum();
        star / sum
    }

    /// Power of the transform at wave vector (kx, ky), in units of the square of the light.
    pub(super) fn power(psf: ArrayView2<'_, f64>, [kx, ky]: [f64; 2]) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for ((y, x), value) in psf.indexed_iter() {
            let phase = kx * x as f64 + ky * y as f64;
            re += value * phase.cos();
            im += value * phase.sin();
        }
        (re * re + im * im) / psf.sum().powi(2)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::*;

    #[test]
    fn noisy_stars_off_the_centre_average_to_the_psf() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.03)).unwrap();
        let expected = psf.stamp(48);
        let cut = PsfCut {
            size: 48,
            least: 32,
            centred: false,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (snr, count, tolerance) in [(f64::INFINITY, 5, 2e-4), (200.0, 64, 4e-3)] {
            let mut stars = Array3::zeros((count, 48, 48));
            for (k, mut star) in stars.outer_iter_mut().enumerate() {
                let (dx, dy) = (0.37 * (k % 5) as f64 - 0.8, 0.29 - 0.2 * (k % 3) as f64);
                psf.draw_into(23.5 + dx, 23.5 + dy, star.view_mut());
                let noisy = test_stars::noisy(&star.to_owned(), snr, &mut rng);
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
        let cut = PsfCut {
            size: 32,
            least: 32,
            centred: false,
        };
        let (number, error) = average_stars(stars.view(), cut).unwrap_err();
        assert_eq!(number, 2);
        assert!(error.to_string().contains("sum to 0"), "{error}");
    }

    fn moffat(fwhm: f64) -> FunctionalPsf {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        FunctionalPsf::new(profile, fwhm, Shear::new(0.05, -0.03)).unwrap()
    }

    fn cut<P: Pixel>(stamp: ArrayView2<'_, P>, cut: impl Into<PsfCut>) -> Array2<f64> {
        Star::cut(stamp, cut).unwrap().psf
    }

    #[test]
    fn a_functional_psf_is_where_the_cut_of_a_star_is() {
        let psf = moffat(2.9);
        for (side, size) in [(48, 15), (48, 24), (33, 24), (33, 15)] {
            let cut = cut(psf.stamp(side).view(), size);
            for (a, b) in cut.iter().zip(&psf.stamp_beside(size, side)) {
                // Either is drawn to 1e-6 of the brightest pixel, which is below a tenth.
                assert!((a - b).abs() < 2e-7, "{side}, {size}: {a} {b}");
            }
        }
    }

    #[test]
    fn small_star_stamps_keep_their_centre() {
        let limits = PsfCut {
            size: 48,
            least: 32,
            centred: false,
        };
        let stamp = moffat(3.4).stamp(64);
        for (given, expected) in [(32, 32), (37, 36), (48, 48), (64, 48)] {
            let from = cut_start(64, given).unwrap();
            let star = stamp.slice(s![from..from + given, from..from + given]);
            let taken = cut(star, limits);
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
        assert!(Star::cut(stamp.slice(s![..31, ..31]), limits).is_err());
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
            assert!(
                (found - expected / light).abs() < 1e-4,
                "{found} {expected}"
            );
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
            let limits = PsfCut {
                size,
                least: size,
                centred: true,
            };
            let found = cut(psf.stamp(given).view(), limits);
            let expected = cut(psf.stamp(size + 6).view(), limits);
            let peak = expected.iter().copied().fold(0.0, f64::max);
            let inner = s![8..size - 8, 8..size - 8];
            for (a, b) in found.slice(inner).iter().zip(expected.slice(inner)) {
                // The light beyond the stamp, of which a Moffat profile has 1e-3 here, comes back at the other side.
                assert!((a - b).abs() < 1e-3 * peak, "{given} to {size}: {a} {b}");
            }
        }
        // Only one side is of the other parity.
        let cut = Star::cut(
            Array2::<f32>::ones((9, 8)).view(),
            PsfCut {
                size: 8,
                least: 8,
                centred: true,
            },
        );
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

    #[test]
    fn bright_stars_count_alike_in_the_average() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let [narrow, wide] =
            [3.0, 4.0].map(|fwhm| test_stars::drawn(profile, fwhm, Shear::ZERO, 48));
        let wide = test_stars::noisy(&wide, 1300.0, &mut ChaCha8Rng::seed_from_u64(8));
        let mut stars = Array3::zeros((2, 48, 48));
        stars.slice_mut(s![0, .., ..]).assign(&narrow);
        stars.slice_mut(s![1, .., ..]).assign(&wide);
        let cut = PsfCut {
            size: 48,
            least: 32,
            centred: false,
        };
        let found = average_stars(stars.view(), cut).unwrap();
        let [found, narrow, wide] = [&found, &narrow, &wide].map(|psf| psf[(24, 24)] / psf.sum());
        // By its S/N of 1300, which is above 1000, the second would count less than the first, which has no noise.
        let share = (found - wide) / (narrow - wide);
        assert!((share - 0.5).abs() < 0.03, "{share}");
    }
}

//! Point-spread functions: stars on stamps, and formulas.

mod denoised_star;
pub(crate) mod quality;
mod residual_profile;
mod shape;
mod star;

use std::borrow::Cow;
use std::ops::Range;

use ndarray::{ArcArray2, Array2, ArrayView2, ArrayView3, Axis, Ix2, Ix3, s};
use shearq_quantities::FunctionalPsf;
use shearq_submissions::PsfCut;

pub(crate) use self::denoised_star::StarDenoiser;
use self::quality::PsfQuality;
pub(crate) use self::residual_profile::{ResidualProfiles, StarSurvey};
pub(crate) use self::shape::{
    WIDTH_STEPS, noise_equivalent_area, width_factor, width_step, width_step_of_area,
};
pub use self::star::Star;
pub(crate) use self::star::cut_start;
use crate::error::MeasureError;
use crate::stamp::Pixels;

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
        let [by_x, by_y] =
            star::psf_offset(psf).map(|offset| star::fourier_shift(side, side, offset));
        sum.scaled_add(*weight, &by_y.dot(&psf).dot(&by_x.t()));
    }
    let light = sum.sum();
    if light > 0.0 {
        Ok(sum / light)
    } else {
        Err((1, MeasureError::DarkPsf(light)))
    }
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
    use shearq_quantities::{PsfProfile, Shear};

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
}

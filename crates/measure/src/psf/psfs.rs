//! The PSFs of galaxies: formulas, and stars.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

use ndarray::{ArrayView2, Axis, Ix2, Ix3};
use shearq_quantities::FunctionalPsf;
use shearq_submissions::PsfCut;

use super::star::Star;
use crate::error::MeasureError;
use crate::pixels::Pixels;

/// The PSFs of galaxies, borrowed from the caller or owned.
#[derive(Debug, Clone)]
pub enum Psfs<'a> {
    /// One PSF for all galaxies, used as it is: centred, of sum one, and with the pixels that [`Star::cut`] cuts. Clones
    /// share its pixels.
    Prepared(Arc<Star>),
    /// One star stamp for all galaxies, which is cut around the star and normalised.
    Star(Pixels<'a, Ix2>),
    /// Star stamps, one per galaxy along the first axis.
    Stars(Pixels<'a, Ix3>),
    /// Formulas, one per galaxy.
    Functional(Cow<'a, [FunctionalPsf]>),
}

impl<'a> Psfs<'a> {
    /// [`Psfs::Prepared`] of an array.
    pub fn prepared(psf: ArrayView2<'_, f64>) -> Self {
        Psfs::Prepared(Arc::new(psf.to_owned().into()))
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
        match self {
            // Its source states by how much it was moved.
            Psfs::Prepared(psf) => Ok(Star {
                moved: None,
                ..Star::clone(psf)
            }),
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
                Ok(psf.stamp_beside(cut.size, full).into())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::psf::testing::{cut, moffat};

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
}

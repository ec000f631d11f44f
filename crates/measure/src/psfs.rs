//! The PSFs of galaxies: one for all, or one per galaxy.

use std::borrow::Cow;

use ndarray::{
    ArcArray2, Array, Array2, Array3, ArrayView, ArrayView2, Axis, CowArray, Dimension, Ix2, Ix3,
    Slice,
};
use shearq_quantities::FunctionalPsf;
use shearq_submissions::PsfCut;

use crate::error::{MeasureError, length};
use crate::psf::{Star, star};

/// Pixels of star stamps in single or double precision, borrowed or owned.
#[derive(Debug, Clone)]
pub enum StarPixels<'a, D: Dimension> {
    /// `f32`.
    Single(CowArray<'a, f32, D>),
    /// `f64`.
    Double(CowArray<'a, f64, D>),
}

impl<'a, D: Dimension> From<ArrayView<'a, f32, D>> for StarPixels<'a, D> {
    fn from(pixels: ArrayView<'a, f32, D>) -> Self {
        StarPixels::Single(pixels.into())
    }
}

impl<'a, D: Dimension> From<ArrayView<'a, f64, D>> for StarPixels<'a, D> {
    fn from(pixels: ArrayView<'a, f64, D>) -> Self {
        StarPixels::Double(pixels.into())
    }
}

impl<D: Dimension> From<Array<f32, D>> for StarPixels<'_, D> {
    fn from(pixels: Array<f32, D>) -> Self {
        StarPixels::Single(pixels.into())
    }
}

impl<D: Dimension> From<Array<f64, D>> for StarPixels<'_, D> {
    fn from(pixels: Array<f64, D>) -> Self {
        StarPixels::Double(pixels.into())
    }
}

impl<D: Dimension> StarPixels<'_, D> {
    fn dim(&self) -> D::Pattern {
        match self {
            StarPixels::Single(pixels) => pixels.dim(),
            StarPixels::Double(pixels) => pixels.dim(),
        }
    }
}

/// The PSFs of galaxies, borrowed from the caller or owned.
#[derive(Debug, Clone)]
pub enum Psfs<'a> {
    /// One PSF for all galaxies, used as it is: centred, of sum one, and with the pixels that
    /// [`star_psf`](crate::star_psf) cuts. Clones share its pixels.
    Prepared(ArcArray2<f64>),
    /// One star stamp for all galaxies, which is cut around the star and normalised.
    Star(StarPixels<'a, Ix2>),
    /// Star stamps, one per galaxy along the first axis.
    Stars(StarPixels<'a, Ix3>),
    /// Formulas, one per galaxy.
    Functional(Cow<'a, [FunctionalPsf]>),
}

impl<'a> Psfs<'a> {
    /// [`Psfs::Prepared`] of an array. An owned array is not copied if it is passed as [`ArcArray2`].
    pub fn prepared(psf: ArrayView2<'_, f64>) -> Self {
        Psfs::Prepared(psf.to_shared())
    }

    /// [`Psfs::Star`] of a view or an array of `f32` or `f64`.
    pub fn star(stamp: impl Into<StarPixels<'a, Ix2>>) -> Self {
        Psfs::Star(stamp.into())
    }

    /// [`Psfs::Stars`] of a view or an array of `f32` or `f64`.
    pub fn stars(stamps: impl Into<StarPixels<'a, Ix3>>) -> Self {
        Psfs::Stars(stamps.into())
    }

    /// [`Psfs::Functional`] of a slice or a vector.
    pub fn functional(formulas: impl Into<Cow<'a, [FunctionalPsf]>>) -> Self {
        Psfs::Functional(formulas.into())
    }

    /// [`Psfs::Stars`] of an image of `count` stamps of `side` pixels next to each other, row-major.
    ///
    /// # Errors
    /// If the image has another number of pixels.
    pub fn strip(pixels: Vec<f32>, count: usize, side: usize) -> Result<Self, MeasureError> {
        length("a strip of stamps", pixels.len(), count * side * side)?;
        let rows = Array3::from_shape_vec((side, count, side), pixels);
        let rows = rows.map_err(|error| MeasureError::strip(count, side, &error))?;
        Ok(Psfs::stars(rows.permuted_axes([1, 0, 2])))
    }

    /// Keeps the first `count` PSFs, if there is one per galaxy.
    pub fn truncate(&mut self, count: usize) {
        let first = |len: usize| Slice::from(..count.min(len));
        match self {
            Psfs::Prepared(_) | Psfs::Star(_) => {}
            Psfs::Stars(StarPixels::Single(stamps)) => {
                stamps.slice_axis_inplace(Axis(0), first(stamps.len_of(Axis(0))));
            }
            Psfs::Stars(StarPixels::Double(stamps)) => {
                stamps.slice_axis_inplace(Axis(0), first(stamps.len_of(Axis(0))));
            }
            Psfs::Functional(Cow::Owned(formulas)) => formulas.truncate(count),
            Psfs::Functional(Cow::Borrowed(formulas)) => {
                *formulas = &formulas[..count.min(formulas.len())];
            }
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
            Psfs::Star(StarPixels::Single(stamp)) => star(stamp.view(), cut),
            Psfs::Star(StarPixels::Double(stamp)) => star(stamp.view(), cut),
            Psfs::Stars(StarPixels::Single(stamps)) => star(stamps.index_axis(Axis(0), k), cut),
            Psfs::Stars(StarPixels::Double(stamps)) => star(stamps.index_axis(Axis(0), k), cut),
            Psfs::Functional(formulas) => Ok(unmoved(formulas[k].checked_stamp(cut.size, full)?)),
        }
    }
}

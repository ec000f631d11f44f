//! Quantities of weak lensing as types, and the profiles that are made of them.
//!
//! * [`Shear`] and [`Distortion`]: the two definitions of ellipticity, which do not mix.
//! * [`Jacobian`] and [`Frame`]: pixels on the sky, and the axes of ellipticities.
//! * [`units`]: degrees, radians, pixels and multipoles.
//! * [`FunctionalPsf`]: a Moffat or Kolmogorov PSF, integrated over pixels, with its transform.
//! * [`radial`]: tables of radial profiles, elliptical radii and quadrature rules.
//! * [`linear`]: the solvers of linear equations, and 2 × 2 matrices; [`product`]: products of small ones.
//! * [`statistics`]: running means and medians.
//!
//! # Conventions
//!
//! Positions are in pixels, x along columns and y along rows; arrays are indexed `[y, x]`. e1 > 0 is elongation along
//! +x, e2 > 0 along x = y. Wavenumbers are in radians per pixel. A transform is F(k) = ∫ I(x) e^(−ik·x) d²x.

#![warn(missing_docs, clippy::missing_errors_doc)]
#![cfg_attr(not(test), forbid(unsafe_code))] // ndarray's slicing in tests allows it

mod ellipticity;
mod jacobian;
pub mod linear;
pub mod product;
mod psf;
pub mod radial;
mod range;
pub mod statistics;
pub mod units;

pub use ellipticity::{Distortion, Shear};
pub use jacobian::{Frame, Jacobian, JacobianError, Orientation, PixelShape, Spin2, UnknownFrame};
pub use psf::{FunctionalPsf, ProfileError, PsfProfile, PsfTransform, Pupil, TransformedPsf};
pub use range::MeasuredRange;

/// Stamps in a row of the arrangement of `count` stamps that is nearest to a square: 1 or more.
pub fn columns_of(count: usize) -> usize {
    let root = count.isqrt();
    (root + usize::from(root * root < count)).max(1)
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Quantities of weak lensing as types, and the profiles that are made of them.
//!
//! * [`Shear`] and [`Distortion`]: the two definitions of ellipticity, which do not mix.
//! * [`Jacobian`] and [`Frame`]: pixels on the sky, and the axes of ellipticities.
//! * [`units`]: degrees, radians, pixels and multipoles.
//! * [`FunctionalPsf`]: a Moffat or Kolmogorov PSF, integrated over pixels, with its transform.
//! * [`radial`]: tables of radial profiles, elliptical radii and quadrature rules.
//! * [`jet`]: functions with their first and second derivatives.
//! * [`fourier`]: plans of Fourier transforms, compiled here for all crates.
//! * [`linear`]: the solvers of linear equations, 2 × 2 matrices, and products of small ones.
//! * [`statistics`]: running means and medians.
//!
//! # Conventions
//!
//! Positions are in pixels, x along columns and y along rows; arrays are indexed `[y, x]`. e1 > 0 is elongation along
//! +x, e2 > 0 along x = y. Wavenumbers are in radians per pixel. A transform is F(k) = ∫ I(x) e^(−ik·x) d²x.

#![warn(missing_docs, clippy::missing_errors_doc)]
#![cfg_attr(not(test), forbid(unsafe_code))] // ndarray's slicing in tests allows it

use std::fmt::Display;

mod ellipticity;
pub mod fourier;
pub mod hash;
pub mod jet;
pub mod linear;
mod psf;
pub mod radial;
pub mod statistics;

pub use ellipticity::{
    Distortion, Frame, Jacobian, JacobianError, Orientation, PixelShape, Shear, Spin2, UnknownFrame,
};
pub use psf::{FunctionalPsf, ProfileError, PsfProfile, PsfTransform, Pupil, TransformedPsf};
pub use statistics::MeasuredRange;

/// The end of a message, with what can be tried: empty without a hint.
pub fn tried(hint: Option<impl Display>) -> String {
    hint.map_or_else(String::new, |hint| format!(". Try: {hint}"))
}

/// The method `hint` of an enumeration of errors or warnings, from arms of a match that give texts or return.
#[macro_export]
macro_rules! hints {
    ($($arms:tt)*) => {
        /// What can be tried about it.
        #[allow(unreachable_patterns)] // Behind arms for all variants.
        pub fn hint(&self) -> Option<String> {
            let hint: &str = match self {
                $($arms)*
                _ => return None,
            };
            Some(hint.to_owned())
        }
    };
}

/// Serde of settings whose derived functions are their own (`remote = "Self"`), so that reading checks them by `validate`.
#[macro_export]
macro_rules! checked_when_read {
    ($of:ty) => {
        impl Serialize for $of {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                <$of>::serialize(self, serializer)
            }
        }

        impl<'de> Deserialize<'de> for $of {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let settings = <$of>::deserialize(deserializer)?;
                settings.validate().map_err(serde::de::Error::custom)?;
                Ok(settings)
            }
        }
    };
}

/// Stamps in a row of the arrangement of `count` stamps that is nearest to a square: 1 or more.
pub fn columns_of(count: usize) -> usize {
    let root = count.isqrt();
    (root + usize::from(root * root < count)).max(1)
}

/// Angles, pixels and multipoles as types, so that they cannot be confused.
pub mod units {
    #[cfg(feature = "serde")]
    use serde::{Deserialize, Serialize};

    /// An angle in degrees, as data files and settings give field sizes.
    #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
    #[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
    #[cfg_attr(feature = "serde", serde(transparent))]
    pub struct Degrees(pub f64);

    /// An angle in radians, as all formulae take it.
    #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
    #[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
    #[cfg_attr(feature = "serde", serde(transparent))]
    pub struct Radians(pub f64);

    /// A length in image pixels.
    #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
    #[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
    #[cfg_attr(feature = "serde", serde(transparent))]
    pub struct Pixels(pub f64);

    /// An angular multipole ℓ (flat sky: the modulus of the wave vector in rad⁻¹).
    #[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
    #[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
    #[cfg_attr(feature = "serde", serde(transparent))]
    pub struct Multipole(pub f64);

    impl From<Degrees> for Radians {
        fn from(angle: Degrees) -> Self {
            Radians(angle.0 * std::f64::consts::PI / 180.0)
        }
    }
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Angles, pixels and multipoles as types, so that they cannot be confused.

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

//! The eight sign and axis conventions that the original scoring tries on every catalogue.

use ndarray::Array2;
#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};
use shearq_fourier::Complex64;

use crate::error::ScoringError;
use crate::grid::check_shape;

/// One of the eight conventions, numbered 1 to 8 as in the original.
///
/// The value of a cell is s₁·e₁ + i·s₂·e₂ with (s₁, s₂) = (+,+), (+,−), (−,−), (−,+) for
/// 1 to 4 and again for 5 to 8. Conventions 1 to 4 index the field `[iy, ix]`, 5 to 8 `[ix, iy]`.
///
/// Convention 5 is the standard one: e₁ > 0 along +x, e₂ > 0 along x = y.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
#[cfg_attr(feature = "serde", serde(try_from = "u8", into = "u8"))]
pub struct Convention(u8);

/// The two classes of conventions. All conventions of a class give the same E-mode spectrum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
pub enum ConventionClass {
    /// Conventions 1, 3, 6, 8.
    A,
    /// Conventions 2, 4, 5, 7, among them the standard one.
    B,
}

impl ConventionClass {
    /// Both, in order.
    pub const BOTH: [ConventionClass; 2] = [ConventionClass::A, ConventionClass::B];

    /// Index in [`ConventionClass::BOTH`].
    pub fn index(self) -> usize {
        match self {
            ConventionClass::A => 0,
            ConventionClass::B => 1,
        }
    }

    /// The convention of this class that neither swaps x and y nor flips e1.
    pub fn representative(self) -> Convention {
        match self {
            ConventionClass::A => Convention(6),
            ConventionClass::B => Convention::STANDARD,
        }
    }
}

impl Convention {
    /// All eight, in order.
    pub const ALL: [Convention; 8] = [
        Convention(1),
        Convention(2),
        Convention(3),
        Convention(4),
        Convention(5),
        Convention(6),
        Convention(7),
        Convention(8),
    ];
    /// The standard convention: e₁ along +x, e₂ along x = y, neither flipped.
    pub const STANDARD: Convention = Convention(5);

    /// Number 1 to 8.
    pub fn number(self) -> u8 {
        self.0
    }

    /// Index 0 to 7 in [`Convention::ALL`].
    pub fn index(self) -> usize {
        usize::from(self.0) - 1
    }

    /// Signs (s₁, s₂) applied to (e₁, e₂).
    pub fn signs(self) -> (f64, f64) {
        match (self.0 - 1) % 4 {
            0 => (1.0, 1.0),
            1 => (1.0, -1.0),
            2 => (-1.0, -1.0),
            _ => (-1.0, 1.0),
        }
    }

    /// Whether x and y are swapped: the field is indexed `[iy, ix]`.
    pub fn transposes(self) -> bool {
        self.0 <= 4
    }

    /// The class of this convention.
    pub fn class(self) -> ConventionClass {
        match self.0 {
            1 | 3 | 6 | 8 => ConventionClass::A,
            _ => ConventionClass::B,
        }
    }

    /// The convention in words.
    pub fn describe(self) -> &'static str {
        match self.0 {
            1 => "x and y swapped",
            2 => "x and y swapped, e2 flipped",
            3 => "x and y swapped, e1 and e2 flipped",
            4 => "x and y swapped, e1 flipped",
            5 => "standard",
            6 => "e2 flipped",
            7 => "e1 and e2 flipped",
            _ => "e1 flipped",
        }
    }

    /// A field on `[ix, iy]` as this convention indexes it.
    pub(crate) fn turn(self, field: &Array2<f64>) -> Array2<f64> {
        match self.transposes() {
            true => field.t().to_owned(),
            false => field.clone(),
        }
    }

    /// The complex field of this convention from means of e₁ and e₂ on `[ix, iy]`.
    ///
    /// # Errors
    /// If the two arrays differ in shape or are not square.
    pub fn apply(
        self,
        e1: &Array2<f64>,
        e2: &Array2<f64>,
    ) -> Result<Array2<Complex64>, ScoringError> {
        check_shape("e1", e1, e1.nrows())?;
        check_shape("e2", e2, e1.nrows())?;
        Ok(self.field(e1, e2))
    }

    /// [`Convention::apply`] without the check.
    pub(crate) fn field(self, e1: &Array2<f64>, e2: &Array2<f64>) -> Array2<Complex64> {
        let (s1, s2) = self.signs();
        Array2::from_shape_fn(e1.dim(), |(i, j)| {
            let cell = if self.transposes() { (j, i) } else { (i, j) };
            Complex64::new(s1 * e1[cell], s2 * e2[cell])
        })
    }
}

impl TryFrom<u8> for Convention {
    type Error = ScoringError;

    fn try_from(number: u8) -> Result<Self, ScoringError> {
        if (1..=8).contains(&number) {
            Ok(Convention(number))
        } else {
            Err(ScoringError::Convention(number))
        }
    }
}

impl From<Convention> for u8 {
    fn from(convention: Convention) -> u8 {
        convention.0
    }
}

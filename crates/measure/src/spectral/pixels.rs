//! Pixels of stamps in the coordinates that the epochs of a galaxy have in common.

use shearq_quantities::PixelShape;
use shearq_quantities::linear::{Matrix2, apply, determinant, inverse};

// Difference of matrices that single precision does not resolve.
const SAME: f64 = 1e-7;

/// The map from pixels of an epoch, about the middle of its stamp, to common coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum EpochPixels {
    /// Triangular, of determinant one: sums along the axes are separable.
    Shaped(PixelShape),
    Turned(Matrix2),
}

impl EpochPixels {
    pub(crate) fn new(matrix: Matrix2) -> Self {
        let [[stretch, skew], [below, last]] = matrix;
        let triangular = below.abs() < SAME && stretch > 0.0;
        if triangular && (stretch * last - 1.0).abs() < SAME {
            EpochPixels::Shaped(PixelShape { stretch, skew })
        } else {
            EpochPixels::Turned(matrix)
        }
    }

    pub(super) fn matrix(self) -> Matrix2 {
        match self {
            EpochPixels::Shaped(PixelShape { stretch, skew }) => {
                [[stretch, skew], [0.0, 1.0 / stretch]]
            }
            EpochPixels::Turned(matrix) => matrix,
        }
    }

    pub(crate) fn map(self, at: [f64; 2]) -> [f64; 2] {
        apply(self.matrix(), at)
    }

    pub(crate) fn pixel(self, at: [f64; 2]) -> [f64; 2] {
        apply(self.inverse(), at)
    }

    pub(super) fn inverse(self) -> Matrix2 {
        inverse(self.matrix())
    }

    /// Area of a pixel.
    pub(crate) fn area(self) -> f64 {
        determinant(self.matrix()).abs()
    }
}

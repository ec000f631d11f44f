//! The two ellipticity definitions of the field, as two types that do not mix.
//!
//! For an ellipse with axis ratio `q = b/a` and position angle φ (from +x towards +y):
//!
//! * [`Shear`]: ε = (1 − q)/(1 + q) · e^{2iφ}. Shear, and the truth of GREAT10, are of this type;
//!   the mean of ε over randomly oriented galaxies is the reduced shear.
//! * [`Distortion`]: χ = (1 − q²)/(1 + q²) · e^{2iφ}. Moments `(Qxx − Qyy)/(Qxx + Qyy)` are of this
//!   type; χ ≈ 2ε for small values.
//!
//! Component 1 is positive along +x, component 2 is positive along the diagonal x = y.
//!
//! # Axes
//!
//! Components refer to a [`Frame`]: the axes of the pixels, or those of the sky, to which a [`Jacobian`] maps pixels.

use std::fmt;
use std::str::FromStr;

#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::linear::{Matrix2, apply, determinant};

/// Shear-type ellipticity ε = (1 − q)/(1 + q) · e^{2iφ}; also a reduced shear g.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
pub struct Shear {
    /// Positive for elongation along +x.
    pub e1: f64,
    /// Positive for elongation along x = y.
    pub e2: f64,
}

/// Distortion χ = (1 − q²)/(1 + q²) · e^{2iφ}.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
pub struct Distortion {
    /// Positive for elongation along +x.
    pub e1: f64,
    /// Positive for elongation along x = y.
    pub e2: f64,
}

impl Shear {
    /// A round object, or no shear.
    pub const ZERO: Shear = Shear { e1: 0.0, e2: 0.0 };

    /// From the two components.
    pub const fn new(e1: f64, e2: f64) -> Self {
        Shear { e1, e2 }
    }

    /// |ε|.
    pub fn modulus(self) -> f64 {
        self.e1.hypot(self.e2)
    }

    /// χ = 2ε / (1 + |ε|²).
    pub fn to_distortion(self) -> Distortion {
        let scale = 2.0 / (1.0 + self.e1 * self.e1 + self.e2 * self.e2);
        Distortion {
            e1: self.e1 * scale,
            e2: self.e2 * scale,
        }
    }

    /// The ellipticity of a source of intrinsic ellipticity `self` seen through the reduced shear
    /// `g`: (ε + g)/(1 + g* ε), for |g| < 1 (Seitz & Schneider 1997).
    pub fn sheared_by(self, g: Shear) -> Shear {
        let (nr, ni) = (self.e1 + g.e1, self.e2 + g.e2);
        let dr = 1.0 + g.e1 * self.e1 + g.e2 * self.e2;
        let di = g.e1 * self.e2 - g.e2 * self.e1;
        let norm = dr * dr + di * di;
        Shear {
            e1: (nr * dr + ni * di) / norm,
            e2: (ni * dr - nr * di) / norm,
        }
    }

    /// The area-preserving linear map that turns a circle into an ellipse of this ellipticity:
    /// `[[1 + e1, e2], [e2, 1 − e1]] / sqrt(1 − |ε|²)`, acting on (x, y).
    pub fn matrix(self) -> [[f64; 2]; 2] {
        let norm = 1.0 / (1.0 - self.e1 * self.e1 - self.e2 * self.e2).sqrt();
        [
            [(1.0 + self.e1) * norm, self.e2 * norm],
            [self.e2 * norm, (1.0 - self.e1) * norm],
        ]
    }
}

impl Distortion {
    /// From the two components.
    pub const fn new(e1: f64, e2: f64) -> Self {
        Distortion { e1, e2 }
    }

    /// |χ|.
    pub fn modulus(self) -> f64 {
        self.e1.hypot(self.e2)
    }

    /// ε = χ / (1 + sqrt(1 − |χ|²)); `None` where |χ| > 1, which no ellipse has.
    pub fn to_shear(self) -> Option<Shear> {
        let rest = 1.0 - self.e1 * self.e1 - self.e2 * self.e2;
        if rest.is_nan() || rest < 0.0 {
            return None;
        }
        let scale = 1.0 / (1.0 + rest.sqrt());
        Some(Shear {
            e1: self.e1 * scale,
            e2: self.e2 * scale,
        })
    }
}

/// The axes that components of ellipticities and shears refer to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "lowercase"))]
pub enum Frame {
    /// The axes of the pixels: e1 > 0 is elongation along +x, e2 > 0 along x = y.
    #[default]
    Pixel,
    /// West and north, as in GalSim and TreeCorr: e1 > 0 is elongation east–west, e2 > 0 along north-west.
    Sky,
}

impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Frame::Pixel => "pixel",
            Frame::Sky => "sky",
        })
    }
}

/// A word that is no [`Frame`].
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("found the frame {0:?} (expected \"pixel\" or \"sky\")")]
pub struct UnknownFrame(String);

impl FromStr for Frame {
    type Err = UnknownFrame;

    fn from_str(word: &str) -> Result<Self, UnknownFrame> {
        let known = [Frame::Pixel, Frame::Sky];
        let frame = known.into_iter().find(|frame| frame.to_string() == word);
        frame.ok_or_else(|| UnknownFrame(word.to_owned()))
    }
}

/// The local linear map from pixels to the sky, ∂(u, v)/∂(x, y) in arcsec per pixel: u to the west and v to the north, as
/// the tangent plane is seen from Earth with north up. This is the convention of GalSim's `JacobianWCS` and of TreeCorr's
/// flat positions, in which no component of a shear changes its sign.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jacobian(Matrix2);

/// A matrix that maps no pixel to an area of the sky.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error(
    "the Jacobian ((du/dx, du/dy), (dv/dx, dv/dy)) is (({}, {}), ({}, {})) (expected finite numbers in arcsec per pixel with a determinant other than zero)",
    .0[0][0], .0[0][1], .0[1][0], .0[1][1]
)]
pub struct JacobianError(pub Matrix2);

// Ratio of the determinant to the square of the longer axis below which the axes of a pixel count as parallel.
// Chosen by hand: rounding in the conversion of coordinates leaves 1e-10.
const MIN_RELATIVE_AREA: f64 = 1e-6;

impl Jacobian {
    /// From `[[du/dx, du/dy], [dv/dx, dv/dy]]`.
    ///
    /// # Errors
    /// If the matrix is singular or has an element that is not finite.
    pub fn new(matrix: Matrix2) -> Result<Self, JacobianError> {
        let [[a, b], [c, d]] = matrix;
        let longest = a.hypot(c).max(b.hypot(d));
        let area = determinant(matrix).abs();
        // Not a number fails, too.
        let usable = area.is_normal() && area > MIN_RELATIVE_AREA * longest * longest;
        usable
            .then_some(Jacobian(matrix))
            .ok_or(JacobianError(matrix))
    }

    /// `[[du/dx, du/dy], [dv/dx, dv/dy]]`.
    pub fn matrix(&self) -> Matrix2 {
        self.0
    }

    /// The side in arcsec of a square of a pixel's area, √|det J|.
    pub fn pixel_scale(&self) -> f64 {
        determinant(self.0).abs().sqrt()
    }

    /// The factors U and T of J = scale · U T.
    ///
    /// T maps the lattice of pixels to one that has the shape of the pixels on the sky and the area of a pixel; U turns and
    /// mirrors it to the sky. Ellipticities measured at T x are those on the sky but for the turn, and a triangular T leaves
    /// Fourier transforms of pixels nearly separable.
    pub fn factors(&self) -> (Orientation, PixelShape) {
        let [[a, b], [c, d]] = self.0;
        let scale = self.pixel_scale();
        let length = a.hypot(c);
        let sign = determinant(self.0).signum();
        let (cos, sin) = (a / length, c / length);
        let orientation = Orientation([[cos, -sign * sin], [sin, sign * cos]]);
        let shape = PixelShape {
            stretch: length / scale,
            skew: (cos * b + sin * d) / scale,
        };
        (orientation, shape)
    }
}

/// A rotation, with a reflection if the determinant is −1: an orthogonal matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientation(Matrix2);

impl Orientation {
    /// The matrix that acts on coordinates.
    pub fn matrix(&self) -> Matrix2 {
        self.0
    }

    /// The orthogonal matrix that acts on the components (e1, e2) of an ellipticity or shear, from U Q Uᵀ of the moments
    /// Q = [[e1, e2], [e2, −e1]].
    pub fn spin2(&self) -> Spin2 {
        let [[a, b], [c, d]] = self.0;
        Spin2([[a * a - b * b, 2.0 * a * b], [a * c - b * d, a * d + b * c]])
    }
}

/// What an [`Orientation`] does to spin-2 quantities: ellipticities, shears, and responses of one to the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spin2(Matrix2);

impl Spin2 {
    /// The matrix that acts on (e1, e2).
    pub fn matrix(&self) -> Matrix2 {
        self.0
    }

    /// Components of an ellipticity or shear, or derivatives of a number with respect to a shear.
    pub fn turn(&self, e: [f64; 2]) -> [f64; 2] {
        apply(self.0, e)
    }

    /// A response ∂e_i/∂γ_j, as `[i][j]`, whose ellipticity and shear are both turned: U₂ R U₂ᵀ.
    pub fn turn_response(&self, response: Matrix2) -> Matrix2 {
        // Rows of R U₂ᵀ, then U₂ times its columns.
        let [first, second] = response.map(|row| self.turn(row));
        let columns = [0, 1].map(|j| self.turn([first[j], second[j]]));
        [0, 1].map(|i| [columns[0][i], columns[1][i]])
    }
}

/// The shape of pixels: the map (x, y) → (stretch·x + skew·y, y/stretch), which preserves areas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelShape {
    /// Length of a pixel along x over that of a square of the same area; positive.
    pub stretch: f64,
    /// How far the next row is shifted along x.
    pub skew: f64,
}

// Difference from square pixels, of numbers in units of a pixel, that single precision does not resolve.
const SQUARE: f64 = 1e-7;

impl PixelShape {
    /// Square pixels.
    pub const SQUARE: PixelShape = PixelShape {
        stretch: 1.0,
        skew: 0.0,
    };

    /// A place or an offset (x, y) in pixels, in the coordinates of the map.
    pub fn map(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.stretch * x + self.skew * y, y / self.stretch]
    }

    /// The place or offset in pixels of one in the coordinates of the map.
    pub fn pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [x / self.stretch - self.skew * y, self.stretch * y]
    }

    /// |g| of the shear that makes such pixels of squares.
    pub fn shear(&self) -> f64 {
        // Singular values are exp(±η), the trace of T Tᵀ is 2 cosh 2η, and |g| = tanh η. The difference from 2 is formed without
        // cancellation.
        let excess = (self.stretch - 1.0 / self.stretch).powi(2) + self.skew * self.skew;
        (excess / (excess + 4.0)).sqrt()
    }

    /// Whether pixels are square to single precision.
    pub fn is_square(&self) -> bool {
        (self.stretch - 1.0).abs() < SQUARE && self.skew.abs() < SQUARE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linear::product;

    #[test]
    fn both_definitions_follow_from_the_axis_ratio() {
        let q: f64 = 0.5;
        let shear = Shear::new((1.0 - q) / (1.0 + q), 0.0);
        let distortion = Distortion::new((1.0 - q * q) / (1.0 + q * q), 0.0);
        assert!((shear.to_distortion().e1 - distortion.e1).abs() < 1e-15);
        assert!((distortion.to_shear().unwrap().e1 - shear.e1).abs() < 1e-15);
    }

    #[test]
    fn a_modulus_is_a_length_and_a_map_preserves_areas() {
        assert_eq!(Shear::new(0.3, -0.4).modulus(), 0.5);
        assert_eq!(Distortion::new(-0.3, 0.4).modulus(), 0.5);
        let [[a, b], [c, d]] = Shear::new(0.3, -0.4).matrix();
        assert!((a * d - b * c - 1.0).abs() < 1e-15);
    }

    #[test]
    fn impossible_distortion_has_no_shear() {
        assert_eq!(
            Distortion::new(0.0, -1.0).to_shear(),
            Some(Shear::new(0.0, -1.0))
        );
        assert_eq!(Distortion::new(0.8, 0.7).to_shear(), None);
        assert_eq!(Distortion::new(f64::NAN, 0.0).to_shear(), None);
    }

    #[test]
    fn shearing_composes_maps() {
        let g = Shear::new(-0.05, 0.08);
        assert_eq!(Shear::ZERO.sheared_by(g), g);
        for s in [Shear::ZERO, Shear::new(0.3, 0.1)] {
            // Second moments of a unit circle mapped by M are M·Mᵀ.
            let (a, b) = (g.matrix(), s.matrix());
            let m = |i: usize, j: usize| a[i][0] * b[0][j] + a[i][1] * b[1][j];
            let moment = |i: usize, j: usize| m(i, 0) * m(j, 0) + m(i, 1) * m(j, 1);
            let [xx, xy, yy] = [moment(0, 0), moment(0, 1), moment(1, 1)];
            let found = Distortion::new((xx - yy) / (xx + yy), 2.0 * xy / (xx + yy));
            let (found, expected) = (found.to_shear().unwrap(), s.sheared_by(g));
            let off = [found.e1 - expected.e1, found.e2 - expected.e2];
            assert!(
                off.iter().all(|off| off.abs() < 1e-14),
                "{found:?} {expected:?}"
            );
        }
    }

    // Rotated, mirrored, and sheared with a skew of either sign.
    const MATRICES: [Matrix2; 6] = [
        [[0.2, 0.0], [0.0, 0.2]],
        [[-0.2, 0.0], [0.0, 0.2]],
        [[0.16, -0.12], [0.12, 0.16]],
        [[0.02, 0.16], [0.157, -0.01]],
        [[0.21, 0.013], [0.004, 0.19]],
        [[0.19, -0.02], [-0.03, -0.21]],
    ];

    fn transposed([[a, b], [c, d]]: Matrix2) -> Matrix2 {
        [[a, c], [b, d]]
    }

    fn close(found: Matrix2, expected: Matrix2) {
        for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    #[test]
    fn factors_multiply_to_the_jacobian() {
        for matrix in MATRICES {
            let jacobian = Jacobian::new(matrix).unwrap();
            let (orientation, shape) = jacobian.factors();
            let turn = orientation.matrix();
            close(product(turn, transposed(turn)), [[1.0, 0.0], [0.0, 1.0]]);
            let map = transposed([shape.map([1.0, 0.0]), shape.map([0.0, 1.0])]);
            assert!(map[1][0] == 0.0 && map[0][0] > 0.0 && map[1][1] > 0.0);
            close(
                [shape.pixel(shape.map([3.0, -2.0])), [0.0; 2]],
                [[3.0, -2.0], [0.0; 2]],
            );
            let scale = jacobian.pixel_scale();
            let scaled = matrix.map(|row| row.map(|value| value / scale));
            close(product(turn, map), scaled);
            // |g| of T from its moments T Tᵀ.
            let moments = product(map, transposed(map));
            let trace = moments[0][0] + moments[1][1];
            let distortion = Distortion::new(
                (moments[0][0] - moments[1][1]) / trace,
                2.0 * moments[0][1] / trace,
            );
            let shear = distortion.to_shear().unwrap().modulus();
            assert!((shape.shear() - shear).abs() < 1e-9, "{shape:?} {shear}");
        }
    }

    #[test]
    fn ellipticities_turn_with_the_ellipse() {
        for matrix in MATRICES {
            let (orientation, _) = Jacobian::new(matrix).unwrap().factors();
            let turn = orientation.matrix();
            let e = Shear::new(0.1, 0.07);
            // Moments of a circle that e makes an ellipse of, turned as coordinates are.
            let moments = product(e.matrix(), e.matrix());
            let moments = product(product(turn, moments), transposed(turn));
            let trace = moments[0][0] + moments[1][1];
            let expected = Distortion::new(
                (moments[0][0] - moments[1][1]) / trace,
                2.0 * moments[0][1] / trace,
            );
            let expected = expected.to_shear().unwrap();
            let found = orientation.spin2().turn([e.e1, e.e2]);
            close([found, [0.0; 2]], [[expected.e1, expected.e2], [0.0; 2]]);
        }
    }

    #[test]
    fn mirrored_and_turned_axes_have_the_signs_of_the_sky() {
        let turned = |matrix| {
            let (orientation, _) = Jacobian::new(matrix).unwrap().factors();
            orientation.spin2().turn([0.3, 0.1])
        };
        // Columns to the east, −u: mirrored.
        close(
            [turned([[-1.0, 0.0], [0.0, 1.0]]), [0.0; 2]],
            [[0.3, -0.1], [0.0; 2]],
        );
        // Columns to the north and rows to the east.
        close(
            [turned([[0.0, -1.0], [1.0, 0.0]]), [0.0; 2]],
            [[-0.3, -0.1], [0.0; 2]],
        );
        // Columns to the north-west, rows to the north-east: elongation along +x is along u = v.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        close(
            [turned([[half, -half], [half, half]]), [0.0; 2]],
            [[-0.1, 0.3], [0.0; 2]],
        );
    }

    #[test]
    fn responses_turn_on_both_sides() {
        let response = [[0.8, 0.05], [-0.03, 0.7]];
        for matrix in MATRICES {
            let (orientation, _) = Jacobian::new(matrix).unwrap().factors();
            let spin = orientation.spin2();
            let expected = product(product(spin.matrix(), response), transposed(spin.matrix()));
            close(spin.turn_response(response), expected);
        }
        // A rotation keeps what is antisymmetric, a reflection changes its sign.
        let antisymmetric = [[0.0, 1.0], [-1.0, 0.0]];
        let of = |matrix| Jacobian::new(matrix).unwrap().factors().0.spin2();
        close(of(MATRICES[2]).turn_response(antisymmetric), antisymmetric);
        close(
            of(MATRICES[1]).turn_response(antisymmetric),
            [[0.0, -1.0], [1.0, 0.0]],
        );
    }

    #[test]
    fn jacobians_without_area_are_refused() {
        for matrix in [
            [[0.0; 2]; 2],
            [[0.2, 0.1], [0.4, 0.2]],
            [[0.2, f64::NAN], [0.0, 0.2]],
            [[f64::INFINITY, 0.0], [0.0, 0.2]],
            [[1e-200, 0.0], [0.0, 1e-200]],
        ] {
            assert!(Jacobian::new(matrix).is_err(), "{matrix:?}");
        }
        let error = Jacobian::new([[0.2, 0.1], [0.4, 0.2]]).unwrap_err();
        assert!(error.to_string().contains("((0.2, 0.1), (0.4, 0.2))"));
    }

    #[test]
    fn frames_are_words() {
        for frame in [Frame::Pixel, Frame::Sky] {
            assert_eq!(frame.to_string().parse(), Ok(frame));
        }
        let error = Frame::from_str("Sky").unwrap_err();
        assert!(error.to_string().contains("\"Sky\""), "{error}");
    }
}

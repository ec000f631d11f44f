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

#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};

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

#[cfg(test)]
mod tests {
    use super::*;

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
}

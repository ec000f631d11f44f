//! The eight sign and axis conventions that the original scoring tries on every catalogue, and which of them a catalogue
//! has by its correlation with the true shear.

use ndarray::Array2;
#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};
use shearq_quantities::fourier::Complex64;

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

    // A field on `[ix, iy]` as this convention indexes it.
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

// Required significance (σ) of a correlation with the truth, and of a difference of two.
const MIN_CORRELATION_SIGMA: f64 = 4.0;

/// How well each of the eight conventions correlates with the truth.
///
/// Sets are averaged with their numbers of modes as weights, so a noisy set does not dominate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ConventionMatch {
    // Σ over sets of modes times correlation, by convention.
    sums: [f64; 8],
    // Modes of the scored bins, over all sets.
    modes: f64,
}

impl ConventionMatch {
    /// The match of one set with these correlations over `modes` scored modes. NaN, from an empty catalogue,
    /// counts as no correlation.
    pub fn new(correlations: [f64; 8], modes: usize) -> Self {
        let modes = modes as f64;
        ConventionMatch {
            sums: correlations.map(|r| if r.is_nan() { 0.0 } else { r * modes }),
            modes,
        }
    }

    /// Adds another set.
    pub fn merge(&mut self, other: &ConventionMatch) {
        for (sum, more) in self.sums.iter_mut().zip(other.sums) {
            *sum += more;
        }
        self.modes += other.modes;
    }

    /// Correlation of a convention's E modes with the true ones, −1 to 1.
    pub fn correlation(&self, convention: Convention) -> f64 {
        self.sums[convention.index()] / self.modes
    }

    /// The convention that correlates best, perhaps by chance. Of equals, the standard one or else the first.
    pub fn best(&self) -> Convention {
        let better = |best, k| match self.correlation(k) > self.correlation(best) {
            true => k,
            false => best,
        };
        Convention::ALL
            .into_iter()
            .fold(Convention::STANDARD, better)
    }

    /// The smallest significant correlation or difference of two. Correlations of N independent modes scatter by
    /// 1/√(N/2), because opposite modes are conjugates.
    pub fn least_clear(&self) -> f64 {
        MIN_CORRELATION_SIGMA * (2.0 / self.modes).sqrt()
    }

    /// Whether the best convention is significantly better than chance and than every other convention.
    pub fn is_clear(&self) -> bool {
        let best = self.best();
        let second = Convention::ALL
            .into_iter()
            .filter(|k| *k != best)
            .map(|k| self.correlation(k))
            .fold(0.0, f64::max);
        self.correlation(best) - second >= self.least_clear()
    }

    /// The convention to score in: the best if it is significant, otherwise the standard one. Noise must not
    /// choose it.
    pub fn convention(&self) -> Convention {
        match self.is_clear() {
            true => self.best(),
            false => Convention::STANDARD,
        }
    }

    /// The highest correlation with the truth among the conventions of a class.
    pub fn class_correlation(&self, class: ConventionClass) -> f64 {
        Convention::ALL
            .into_iter()
            .filter(|k| k.class() == class)
            .map(|k| self.correlation(k))
            .fold(f64::NEG_INFINITY, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Correlations with one convention at `best` and another at `second`.
    fn of(best: (u8, f64), second: (u8, f64), modes: usize) -> ConventionMatch {
        let mut r = [0.0; 8];
        r[usize::from(second.0) - 1] = second.1;
        r[usize::from(best.0) - 1] = best.1;
        ConventionMatch::new(r, modes)
    }

    #[test]
    fn the_best_convention_is_used_only_if_significant() {
        // 800 modes: chance scatters by 0.05, so 0.2 is significant.
        let clear = of((6, 0.21), (5, 0.0), 800);
        assert!((clear.least_clear() - 0.2).abs() < 1e-12);
        assert!(clear.is_clear());
        assert_eq!(clear.convention().number(), 6);
        assert_eq!(clear.class_correlation(ConventionClass::A), 0.21);
        assert_eq!(clear.class_correlation(ConventionClass::B), 0.0);
        let faint = of((6, 0.19), (5, 0.0), 800);
        assert!(!faint.is_clear());
        assert_eq!((faint.best().number(), faint.convention().number()), (6, 5));
        let close = of((6, 0.5), (5, 0.31), 800);
        assert!(!close.is_clear());
        assert_eq!(close.convention(), Convention::STANDARD);
        // All others negative: the best must exceed chance.
        let mut r = [-0.5; 8];
        r[2] = 0.19;
        assert!(!ConventionMatch::new(r, 800).is_clear());
        r[2] = 0.2;
        assert!(ConventionMatch::new(r, 800).is_clear());
    }

    #[test]
    fn sets_are_weighted_by_their_modes() {
        let mut all = of((6, 0.3), (5, 0.25), 100);
        all.merge(&of((5, 0.6), (6, 0.1), 300));
        assert!((all.correlation(Convention::STANDARD) - 0.5125).abs() < 1e-12);
        assert!((all.class_correlation(ConventionClass::A) - 0.15).abs() < 1e-12);
        assert_eq!(all.best(), Convention::STANDARD);
        assert!(
            (all.least_clear() - MIN_CORRELATION_SIGMA * (2.0_f64 / 400.0).sqrt()).abs() < 1e-12
        );
    }

    #[test]
    fn an_empty_match_is_the_standard_convention() {
        let nothing = ConventionMatch::new([f64::NAN; 8], 100);
        assert!(!nothing.is_clear());
        assert_eq!(nothing.best(), Convention::STANDARD);
        assert_eq!(nothing.convention(), Convention::STANDARD);
        assert_eq!(
            ConventionMatch::default().convention(),
            Convention::STANDARD
        );
    }
}

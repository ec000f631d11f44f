//! The sign and axis convention of a catalogue, from its correlation with the true shear of one or several sets.

use crate::convention::{Convention, ConventionClass};

/// Required significance (σ) of a correlation with the truth, and of a difference of two.
const CLEAR: f64 = 4.0;

/// How well each of the eight conventions correlates with the truth.
///
/// Sets are averaged with their numbers of modes as weights, so a noisy set does not dominate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ConventionMatch {
    /// Σ over sets of modes times correlation, by convention.
    sums: [f64; 8],
    /// Modes of the scored bins, over all sets.
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
        CLEAR * (2.0 / self.modes).sqrt()
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
        assert!((all.least_clear() - CLEAR * (2.0_f64 / 400.0).sqrt()).abs() < 1e-12);
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

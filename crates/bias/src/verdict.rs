//! Comparison of estimates with published requirements.

use crate::estimate::Measured;

/// A published tolerance of m or c.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Requirement {
    /// Survey or challenge.
    pub name: &'static str,
    /// First letter of the quantities: `m` or `c`.
    pub of: char,
    /// Largest modulus.
    pub limit: f64,
    /// Publication.
    pub source: &'static str,
}

/// Published requirements.
pub const REQUIREMENTS: [Requirement; 5] = [
    requirement("GREAT3", 'm', 2e-3, "Mandelbaum et al. 2014, ApJS 212, 5"),
    requirement("GREAT3", 'c', 2e-4, "Mandelbaum et al. 2014, ApJS 212, 5"),
    requirement(
        "LSST",
        'm',
        2e-3,
        "as used by Sheldon et al. 2023, OJAp 6, 17; the DESC requirements (arXiv:1809.01669) allow 3e-3",
    ),
    requirement("Euclid", 'm', 2e-3, "Cropper et al. 2013, MNRAS 431, 3103"),
    requirement("Euclid", 'c', 1e-4, "Cropper et al. 2013, MNRAS 431, 3103"),
];

const fn requirement(
    name: &'static str,
    of: char,
    limit: f64,
    source: &'static str,
) -> Requirement {
    Requirement {
        name,
        of,
        limit,
        source,
    }
}

/// Whether a value meets a requirement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// The whole interval of 95 % confidence lies within the limit.
    Met,
    /// The whole interval lies beyond the limit.
    NotMet,
    /// The interval contains the limit.
    Undecided {
        /// The number of galaxies that would decide, if the value stays.
        galaxies: f64,
    },
}

/// Compares a value of `galaxies` galaxies in `units` units with a `limit` of its modulus, at 95 % confidence of Student's t
/// distribution with one degree of freedom less than units.
pub fn verdict(measured: Measured, limit: f64, galaxies: usize, units: usize) -> Verdict {
    // A value below the limit by less than its error does not meet a requirement: the whole interval has to.
    let half = student_t(0.975, units.saturating_sub(1)) * measured.error;
    let modulus = measured.value.abs();
    if modulus + half <= limit {
        Verdict::Met
    } else if modulus - half > limit {
        Verdict::NotMet
    } else {
        // Errors fall with the root of the number of galaxies.
        let ratio = half / (limit - modulus).abs();
        Verdict::Undecided {
            galaxies: galaxies as f64 * ratio * ratio,
        }
    }
}

/// Quantile of Student's t distribution with `degrees` of freedom, for a `probability` of 0.5 to 1. Infinite without
/// degrees of freedom.
pub fn student_t(probability: f64, degrees: usize) -> f64 {
    if degrees == 0 {
        return f64::INFINITY;
    }
    let n = degrees as f64;
    // P(|T| > t) = I_x(n/2, 1/2) with x = n/(n + t²) (Abramowitz & Stegun 26.5.27).
    let x = puruspe::invbetai(2.0 * (1.0 - probability), 0.5 * n, 0.5);
    (n * (1.0 - x) / x).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_tables() {
        // Abramowitz & Stegun, table 26.10, to its last digit.
        for (degrees, expected) in [(1, 12.706), (2, 4.303), (10, 2.228), (120, 1.980)] {
            let found = student_t(0.975, degrees);
            assert!((found - expected).abs() < 6e-4, "{degrees}: {found}");
        }
        assert!((student_t(0.975, 8000) - 1.96).abs() < 1e-3);
    }

    #[test]
    fn verdicts_follow_the_interval() {
        let of = |value, error| verdict(Measured { value, error }, 2e-3, 1000, 1001);
        assert_eq!(of(-1e-3, 1e-4), Verdict::Met);
        assert_eq!(of(-3e-3, 1e-4), Verdict::NotMet);
        let Verdict::Undecided { galaxies } = of(1e-3, 1e-3) else {
            panic!();
        };
        // Twice the error that decides: four times the galaxies, with t = 1.962.
        assert!(
            (galaxies / 1000.0 - 1.962f64.powi(2)).abs() < 0.01,
            "{galaxies}"
        );
        // With two units t is 12.7, so this value is undecided.
        let few = verdict(
            Measured {
                value: 0.0,
                error: 5e-4,
            },
            2e-3,
            1000,
            2,
        );
        assert!(matches!(few, Verdict::Undecided { .. }), "{few:?}");
    }
}

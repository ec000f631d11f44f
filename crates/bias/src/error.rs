//! Why there is no estimate.

use thiserror::Error;

/// Why there is no estimate.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum BiasError {
    /// No row has a positive weight.
    #[error("no galaxy can be used (found 0 with a positive weight and without a flag)")]
    NoGalaxies,
    /// Too few units for an error.
    #[error("there is no error without independent units (found {found}, expected 2 or more)")]
    FewUnits {
        /// Units with a galaxy.
        found: usize,
    },
    /// The mean response is not significant.
    #[error(
        "the mean response R{component}{component} is too close to zero (found {found:.4} ± {error:.4}, expected more than {MIN_SIGMA} standard errors)"
    )]
    Response {
        /// Component, 1 or 2.
        component: usize,
        /// Mean response.
        found: f64,
        /// Its standard error.
        error: f64,
    },
    /// Sums that do not belong together.
    #[error("the sums cannot be merged: {0}")]
    Unlike(String),
}

/// Smallest significance of the mean response.
pub const MIN_SIGMA: f64 = 5.0;

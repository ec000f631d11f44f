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
    #[error("{}", response(*component, *found, *error))]
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

/// Why a mean response cannot be divided by.
fn response(component: usize, found: f64, error: f64) -> String {
    let expected = format!("expected more than {MIN_SIGMA} standard errors");
    if found < -MIN_SIGMA * error {
        return format!(
            "the mean response R{component}{component} is negative (found {found:.4} ± {error:.4}, {expected}). Its sign is wrong, or the versions of positive and negative shear are exchanged. Try: minus R{component}{component}, or --columns with the other versions"
        );
    }
    format!(
        "the mean response R{component}{component} is too close to zero (found {found:.4} ± {error:.4}, {expected})"
    )
}

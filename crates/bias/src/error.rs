//! Why there is no estimate.

use shearq_quantities::{hints, tried};
use thiserror::Error;

use crate::sums::Layout;

/// Why there is no estimate.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum BiasError {
    /// No row was added to the bin.
    #[error("no galaxy can be used (found 0 with a positive weight and without a flag)")]
    NoGalaxies,
    /// A jackknife over one unit has no scatter.
    #[error("there is no error without independent units (found {found}, expected 2 or more)")]
    FewUnits {
        /// Units with a galaxy.
        found: usize,
    },
    /// A sheared catalogue has no galaxy, so that there is no response.
    #[error("no row of the sheared catalogue {name} counts (expected rows of 1p, 1m, 2p and 2m)")]
    Sheared {
        /// Its name.
        name: &'static str,
    },
    /// The mean response is not positive by five standard errors. A ratio with such a divisor has no finite variance.
    #[error("{}{}", response(*component, *found, *error), tried(self.hint()))]
    Response {
        /// Component, 1 or 2.
        component: usize,
        /// Mean response.
        found: f64,
        /// Its standard error.
        error: f64,
    },
    /// Sums of other columns or bins do not add up.
    #[error(
        "the sums cannot be merged: other columns or bins (found {found:?} with {found_bins} bins, expected {expected:?} with {expected_bins})"
    )]
    Layouts {
        /// Layout of the sums that were to be merged.
        found: Layout,
        /// Number of their bins.
        found_bins: usize,
        /// Layout of the sums that they were to be merged with.
        expected: Layout,
        /// Number of bins of those.
        expected_bins: usize,
    },
    /// Sums of a damaged file.
    #[error(
        "the sums cannot be merged: a unit of another length (found {found} numbers, expected {expected})"
    )]
    Length {
        /// Numbers of the unit.
        found: usize,
        /// Numbers by layout and bins.
        expected: usize,
    },
}

impl BiasError {
    hints! {
        Self::Response { component: k, found, error } if is_negative(*found, *error) => &format!("minus R{k}{k}, or exchange their columns"),
    }
}

// Chosen by hand. The relative bias of a ratio is the square of the relative error of its divisor: 4 % at 5σ.
pub(crate) const MIN_FITTED_RESPONSE_SIGNIFICANCE: f64 = 5.0;

fn is_negative(found: f64, error: f64) -> bool {
    found < -MIN_FITTED_RESPONSE_SIGNIFICANCE * error
}

fn response(component: usize, found: f64, error: f64) -> String {
    let expected = format!("expected more than {MIN_FITTED_RESPONSE_SIGNIFICANCE} standard errors");
    if is_negative(found, error) {
        return format!(
            "the mean response R{component}{component} is negative (found {found:.4} ± {error:.4}, {expected}). Its sign is wrong, or the sheared catalogues of positive and negative shear are exchanged"
        );
    }
    format!(
        "the mean response R{component}{component} is too close to zero (found {found:.4} ± {error:.4}, {expected})"
    )
}

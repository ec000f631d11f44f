//! Errors of the scoring.

use thiserror::Error;

/// Input that cannot be scored. The caller adds the file.
#[derive(Debug, Clone, Error, PartialEq)]
#[non_exhaustive]
pub enum ScoringError {
    /// A grid side out of range.
    #[error("the grid has {found} cells per side; expected {min} to {max}")]
    GridSide {
        /// Cells per side.
        found: usize,
        /// Smallest accepted.
        min: usize,
        /// Largest accepted.
        max: usize,
    },
    /// A length that is not positive and finite.
    #[error("{what} is {found}; expected a positive number")]
    Length {
        /// Which length.
        what: &'static str,
        /// Its value.
        found: f64,
    },
    /// The shape of an array differs from the grid.
    #[error("{what} has the shape {found:?}; expected ({side}, {side}), index [ix, iy]")]
    Shape {
        /// Which array.
        what: &'static str,
        /// Its shape.
        found: (usize, usize),
        /// Cells per side of the grid.
        side: usize,
    },
    /// The side of the field is out of range.
    #[error("the field has {found:?} degrees per side; expected {least} to {most}")]
    Field {
        /// The side in degrees.
        found: f64,
        /// Smallest.
        least: f64,
        /// Largest.
        most: f64,
    },
    /// The truth does not fill the grid.
    #[error(
        "the true shear covers {found} of the {expected} cells of the {side}×{side} grid; expected each exactly once"
    )]
    TruthIncomplete {
        /// Cells found.
        found: usize,
        /// Cells of the grid.
        expected: usize,
        /// Cells per side.
        side: usize,
    },
    /// A true shear is not a finite number.
    #[error("the true shear of cell ({ix}, {iy}) is not a finite number")]
    TruthNotFinite {
        /// Column, 1-based.
        ix: usize,
        /// Row, 1-based.
        iy: usize,
    },
    /// A true shear is too large for a shear.
    #[error(
        "the true shear of cell ({ix}, {iy}) is |g| = {found:.4}; expected less than 1. Is it in percent, or an angle in degrees?"
    )]
    TruthTooLarge {
        /// Column, 1-based.
        ix: usize,
        /// Row, 1-based.
        iy: usize,
        /// |g|.
        found: f64,
    },
    /// No image was added.
    #[error("no image to score")]
    NoImages,
    /// A set without a true shear was to be scored.
    #[error("the set has no true shear to be scored against")]
    NoTruth,
    /// A sum that should contain one image contains none or several.
    #[error("the sum contains {0} images; expected 1")]
    NotOneImage(usize),
    /// Too few images for cross-spectra.
    #[error("cross-spectra need two or more images (found {0})")]
    TooFewImages(usize),
    /// A negative or non-finite noise variance.
    #[error("the noise variance is {0}; expected a finite number, zero or more")]
    NoiseVariance(f64),
    /// The number of a convention does not exist.
    #[error("there is no convention {0}; expected 1 to 8")]
    Convention(u8),
    /// A simulated shear that is not weak.
    #[error("the largest shear is {found:.2}; expected at most {most}")]
    StrongShear {
        /// Its modulus.
        found: f64,
        /// Largest accepted.
        most: f64,
    },
    /// A power spectrum has the wrong number of bins.
    #[error("a power spectrum has {found} bins; expected the {expected} bins 2 to 9")]
    SpectrumBins {
        /// Bins found.
        found: usize,
        /// Bins expected.
        expected: usize,
    },
    /// A galaxy is not on the lattice.
    #[error("node {node:?} is outside the lattice of {side} × {side} nodes")]
    OutsideLattice {
        /// Column and row, 0-based.
        node: (usize, usize),
        /// Nodes per side.
        side: usize,
    },
    /// A number is NaN or infinite.
    #[error("{0} is not a finite number")]
    NotFinite(&'static str),
    /// Lists that belong together differ in length, or have too few entries.
    #[error("{what}: found {found}, expected {expected}")]
    Count {
        /// What is counted.
        what: &'static str,
        /// Its number.
        found: usize,
        /// The number expected.
        expected: usize,
    },
    /// The true shears of all fields are the same in one component, so that m and c cannot be separated.
    #[error("the true shears do not vary, so that they determine no m")]
    SameShears,
}

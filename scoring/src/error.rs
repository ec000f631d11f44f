//! What can be wrong with input to the scoring.

use thiserror::Error;

/// An input that cannot be scored. The caller adds the file it came from.
#[derive(Debug, Error, PartialEq)]
pub enum ScoringError {
    /// A grid side out of range.
    #[error("the grid has {found} cells a side; expected {min} to {max}")]
    GridSide {
        /// Cells a side found.
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
    /// An array that is not of the grid's shape.
    #[error("{what} has the shape {found:?}; expected ({side}, {side}), index [ix, iy]")]
    Shape {
        /// Which array.
        what: &'static str,
        /// Its shape.
        found: (usize, usize),
        /// Cells a side of the grid.
        side: usize,
    },
    /// The side of a field that is out of range.
    #[error("the field is {found} degrees a side; expected {least} to {most}")]
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
        /// Cells a side.
        side: usize,
    },
    /// A truth value that is not a number.
    #[error("the true shear of cell ({ix}, {iy}) is not a finite number")]
    TruthNotFinite {
        /// Column, 1-based.
        ix: usize,
        /// Row, 1-based.
        iy: usize,
    },
    /// A truth value that no shear has.
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
    /// Cross-spectra of one image.
    #[error("there is one image; cross-spectra need two or more")]
    OneImage,
    /// A negative or non-finite noise variance.
    #[error("the noise variance is {0}; expected a finite number, zero or more")]
    NoiseVariance(f64),
    /// A convention number that does not exist.
    #[error("there is no convention {0}; expected 1 to 8")]
    Convention(u8),
    /// A simulated shear that is not weak.
    #[error("the largest shear is {found:.2}; expected at most {most}: lower the amplitude")]
    StrongShear {
        /// Its modulus.
        found: f64,
        /// Largest accepted.
        most: f64,
    },
    /// A power-spectrum submission with the wrong bins.
    #[error("a power-spectrum submission has {found} bins; expected the {expected} bins 2 to 9")]
    SpectrumBins {
        /// Bins found.
        found: usize,
        /// Bins expected.
        expected: usize,
    },
}

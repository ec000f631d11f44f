//! What can be wrong with a request.

use shearq_quantities::{JacobianError, ProfileError, hints, tried};
use shearq_submissions::ConfigurationError;
use thiserror::Error;

use crate::warning::Warning;

/// What can be wrong with stamps, PSFs or settings. A galaxy that cannot be measured is no error: it has
/// [`Flags`](crate::Flags).
#[derive(Debug, Error)]
#[non_exhaustive]
#[expect(
    missing_docs,
    reason = "the text of a variant states what its fields are"
)]
pub enum MeasureError {
    /// Sizes that do not fit.
    #[error("{what} of {found}; expected {expected}")]
    Shape {
        what: &'static str,
        found: String,
        expected: String,
    },
    /// A pixel that is not finite.
    #[error("pixel ({x}, {y}) of the {what}, counted from 1, is not a finite number")]
    NotFinite {
        what: &'static str,
        /// Column, 1-based.
        x: usize,
        /// Row, 1-based.
        y: usize,
    },
    /// A noise level that is missing or not one.
    #[error("the noise level is {0}; expected a finite number of image units, not negative")]
    Noise(String),
    /// Stamps on whose borders the noise cannot be measured.
    #[error(
        "cannot measure the noise on the borders of {examined} stamp(s){} (expected two or more complete borders with pixels that differ by noise){}",
        match incomplete { 0 => String::new(), count => format!(", {count} of them with missing pixels") }, tried(self.hint())
    )]
    NoBorders { examined: usize, incomplete: usize },
    /// More galaxies than fit into memory.
    #[error("there is no memory for {0} galaxies")]
    Memory(usize),
    /// No light to normalise a PSF by.
    #[error("the pixels of the PSF stamp sum to {sum}; expected a positive sum{}", tried(self.hint()), sum = .0)]
    DarkPsf(f64),
    /// The same of a PSF that varies.
    #[error("the pixels of the PSF at x = {:.1}, y = {:.1} sum to {sum}; expected a positive sum{}", at[0], at[1], tried(self.hint()))]
    DarkPsfAt {
        sum: f64,
        /// In FITS pixels.
        at: [f64; 2],
    },
    /// A star so near an edge of its stamp that it cannot be cut around itself.
    #[error("the star is centred ({dx:+.1}, {dy:+.1}) px off the centre of its stamp of {columns} × {rows} pixels; expected {size} × {size} pixels around the star{}", tried(self.hint()))]
    OffCentre {
        dx: f64,
        dy: f64,
        /// Pixels a side that are needed around the star.
        size: usize,
        rows: usize,
        columns: usize,
    },
    /// A Jacobian that maps no pixel to the sky.
    #[error(transparent)]
    Jacobian(#[from] JacobianError),
    /// A configuration of exposures, which measures no stamps.
    #[error("the configuration detects on exposures; expected one that measures stamps, such as 48/linear/star{}", tried(self.hint()))]
    NoStamps,
    /// Pixels that are sheared more than the method can use.
    #[error("pixels are sheared by {shear:.2e} on the sky; expected at most {most}, as the configuration requires{}", tried(self.hint()))]
    ShearedPixels {
        /// |g| of the shear that makes such pixels of squares.
        shear: f64,
        most: f64,
    },
    /// Epochs of a galaxy that cannot be combined.
    #[error(transparent)]
    Epochs(#[from] EpochError),
    /// A PSF profile that does not exist.
    #[error(transparent)]
    Profile(#[from] ProfileError),
    /// Data from which no result should be made.
    #[error(transparent)]
    Data(Warning),
    /// A submission that does not exist or is not valid.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
}

/// Why epochs of a galaxy cannot be combined. Epochs are counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[non_exhaustive]
#[expect(
    missing_docs,
    reason = "the text of a variant states what its fields are"
)]
pub enum EpochError {
    /// A galaxy without epochs.
    #[error("found a galaxy without epochs (expected one or more)")]
    None,
    /// A noise level by which an epoch cannot be weighted.
    #[error(
        "the noise level of epoch {epoch} is {noise} (expected a finite number above 0 in image units)"
    )]
    Noise { epoch: usize, noise: f64 },
    /// A galaxy that is not near the middle of its stamp.
    #[error("the galaxy of epoch {epoch} is ({x}, {y}) px from the centre of its stamp (expected up to {most}){}", tried(self.hint()))]
    Offset {
        epoch: usize,
        x: f64,
        y: f64,
        most: f64,
    },
    /// Epochs in the frame of the sky and of the pixels.
    #[error("some epochs have Jacobians and others have none (expected Jacobians for all or for none){}", tried(self.hint()))]
    Frames,
    /// A method that is not linear.
    #[error("the configuration measures with the network, which combines no epochs{}", tried(self.hint()))]
    Network,
}

impl EpochError {
    hints! {
        Self::Offset { .. } => "stamps that are cut around the galaxy",
        Self::Frames => "a WCS for each epoch, or none; exposures of one call of gather have either",
        Self::Network => "a linear configuration, such as 48/linear/star",
    }
}

/// What to try with a PSF of a negative sum.
pub const INVERTED_PSF: &str = "the PSF times -1 if its star is darker than its surroundings, or without its negative background";

impl MeasureError {
    hints! {
        Self::Epochs(error) => return error.hint(),
        Self::Data(warning) => return warning.hint(),
        Self::NoBorders { .. } => "stamps with the sky around the galaxies, as before a deblender or a mask fills it, and without borders of missing pixels (cut off, or left out by a settings file with a smaller stamp.size); for stamps without noise, noise.source = \"header\" and NOISESIG = 0",
        Self::OffCentre { .. } => "a larger PSF stamp, or one that is centred on the star to within 1 px",
        Self::DarkPsf(sum) if *sum < 0.0 => INVERTED_PSF,
        Self::DarkPsfAt { .. } => "a model of the PSF whose stars are in all parts of the exposure",
        Self::NoStamps => "shearq detect",
        Self::ShearedPixels { most, .. } if *most < 0.1 => "a linear configuration, such as 48/linear/star",
        Self::ShearedPixels { .. } => "resampled images",
    }

    /// A square image, or several, of the wrong sizes.
    pub(crate) fn square(
        what: &'static str,
        (rows, columns): (usize, usize),
        expected: impl Into<String>,
    ) -> Self {
        MeasureError::Shape {
            what,
            found: format!("{rows} × {columns} pixels"),
            expected: expected.into(),
        }
    }
}

/// Checks the number of values of a slice that should hold `expected` of them.
pub(crate) fn length(
    what: &'static str,
    found: usize,
    expected: usize,
) -> Result<(), MeasureError> {
    if found == expected {
        return Ok(());
    }
    Err(MeasureError::Shape {
        what,
        found: format!("{found} values"),
        expected: format!("{expected}"),
    })
}

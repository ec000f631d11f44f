//! Shear power spectra from gridded ellipticity catalogues, and the metrics of merit of the GREAT10
//! challenge: Q, Q_dn, M and A. Pure arithmetic on grids: no files, no threads.
//!
//! # Conventions
//!
//! * Positions are FITS pixels: 1-based, x along columns, y along rows. Fields are indexed
//!   `[ix, iy]`, first index along x.
//! * e₁ > 0 is elongation along +x, e₂ > 0 along the diagonal x = y. [`Shear`] and [`Distortion`]
//!   are the two ellipticity definitions.
//! * FFT scaling is stated in [`modes`]; bandpowers P_b ≈ ℓ²C_ℓ/2π are dimensionless, C_ℓ is in
//!   steradian, ℓ in rad⁻¹.
//! * Noise variances are per component, galaxy and image.
//!
//! # Metrics of merit
//!
//! ```
#![doc = include_str!("../examples/quality.rs")]
//! ```
//!
//! Catalogues with positions become [`Row`]s, which [`FieldSum::add_image`] puts onto the grid and counts.
//! Images can be added one at a time: memory is that of some twenty grids however many there are.
//!
//! # A spectrum
//!
//! ```
#![doc = include_str!("../examples/spectrum.rs")]
//! ```
//!
//! [`cross_spectrum`] gives that of pairs of images, in which noise has no mean.

pub mod bandpower;
mod catalogue;
mod convention;
mod cross;
mod diagnosis;
mod error;
mod errors;
mod grid;
mod matching;
mod metrics;
pub mod modes;
pub mod quality;
pub mod resample;
mod score;

pub use bandpower::{BINS, Bins, Definition, SCORED};
pub use catalogue::{FieldSum, Row, RowCounts, TrueShear, TruthSign};
pub use convention::{Convention, ConventionClass};
pub use cross::{CrossSpectrum, cross_spectrum};
pub use diagnosis::{Fault, ImageFaults, sign_by_correlation, sign_by_modes};
pub use error::ScoringError;
pub use grid::{Grid, cell_at, centre_of};
pub use matching::ConventionMatch;
pub use metrics::{Metric, Metrics};
pub use quality::{Bias, BiasFits, Quality};
pub use score::{
    Choice, ConventionScore, MAX_GROUPS, MeanShear, Noise, Options, SetImages, SetScore, SetScorer,
    SpectrumCovariance, SpectrumScore, measured_bandpowers,
};

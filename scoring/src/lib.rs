//! Shear power spectra from gridded ellipticity catalogues, and the metrics of the GREAT10 challenge: Q, Q_dn, M
//! and A. Pure arithmetic on grids: no files, no threads.
//!
//! # Conventions
//!
//! * Positions are FITS pixels: 1-based, x along columns, y along rows. Fields have the index `[ix, iy]`.
//! * e₁ > 0 is elongation along +x, e₂ > 0 along the diagonal x = y. Shear-type ellipticities and distortions are
//!   not converted.
//! * [`modes`] states the scaling of Fourier transforms. Bandpowers P_b ≈ ℓ²C_ℓ/2π have no unit, C_ℓ is in
//!   steradian, ℓ in rad⁻¹.
//! * Noise variances are per component, galaxy and image.
//!
//! # Score ellipticities
//!
//! ```
#![doc = include_str!("../examples/quality.rs")]
//! ```
//!
//! For catalogues with positions, make [`Row`]s and add them with [`FieldSum::add_image`], which also counts odd
//! rows. A [`SetSession`] takes one image at a time and finds copies, placeholders, and images that do not follow the shear as
//! the others do: the memory is that of some twenty grids for any number of images.
//!
//! # A spectrum
//!
//! ```
#![doc = include_str!("../examples/spectrum.rs")]
//! ```
//!
//! [`cross_spectrum`] uses pairs of images only, so noise does not bias it.
//!
//! # Other challenges
//!
//! [`great3`] and [`great08`] have the metrics of these challenges, [`aperture`] correlations and aperture masses of galaxies on a lattice.

#![warn(missing_docs, clippy::missing_errors_doc)]
#![forbid(unsafe_code)]

pub mod aperture;
pub mod bandpower;
mod catalogue;
mod convention;
mod cross;
mod diagnosis;
mod error;
mod errors;
pub mod great08;
pub mod great3;
mod grid;
mod line;
mod metrics;
pub mod modes;
pub mod quality;
pub mod resample;
mod score;
mod session;

pub use bandpower::{BINS, Bins, Definition, SCORED};
pub use catalogue::{FieldSum, OddRow, Row, RowCounts, RowFault, SetImages, TrueShear, TruthSign};
pub use convention::{Convention, ConventionClass, ConventionMatch};
pub use cross::{CrossSpectrum, cross_spectrum};
pub use diagnosis::{Fault, ImageResponse, Repeated, repeated, sign_by_correlation, sign_by_modes};
pub use error::ScoringError;
pub use grid::{Grid, cell_at, centre_of};
pub use line::Line;
pub use metrics::{Metric, Metrics};
pub use ndarray;
pub use quality::{Bias, BiasFits, Quality};
pub use resample::MAX_GROUPS;
pub use score::{
    Choice, ConventionScore, MeanShear, Noise, Options, SetScore, SetScorer, SpectrumCovariance,
    SpectrumScore, measured_bandpowers,
};
pub use session::{AddedImages, ExaminedImage, OddImages, OddResponse, ScoredImages, SetSession};
pub use shearq_quantities::fourier::Complex64;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

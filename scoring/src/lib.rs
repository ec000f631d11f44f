//! Shear power spectra from gridded ellipticity catalogues, and the figures of merit of the GREAT10
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
//! # Example
//!
//! ```
//! use shearq_scoring::{FieldSum, Grid, Options, Row, SetImages, SetScorer, TrueShear, TruthSign};
//!
//! let grid = Grid::great10(16)?;
//! let wave = |i: usize| 0.02 * (2.0 * std::f64::consts::PI * 3.0 * i as f64 / 16.0).cos();
//! let rows: Vec<Row> = (0..256)
//!     .map(|k| {
//!         let (x, y) = grid.centre(k % 16, k / 16);
//!         Row { x, y, e1: wave(k % 16), e2: 0.0 }
//!     })
//!     .collect();
//! let truth = TrueShear::from_rows(&grid, TruthSign::Standard, rows.iter().copied())?;
//! let mut image = FieldSum::new(&grid);
//! image.add_image(&grid, rows.iter().map(|r| Row { e1: 1.01 * r.e1, ..*r }));
//! let mut images = SetImages::new(&grid);
//! images.add(&image);
//! let score = SetScorer::new(grid, truth, Options::default())?.score(&images)?;
//! assert!((score.figures.m_cross - 0.01).abs() < 1e-12);
//! # Ok::<(), shearq_scoring::ScoringError>(())
//! ```

pub mod bandpower;
mod catalogue;
mod convention;
mod cross;
mod ellipticity;
mod error;
mod errors;
mod figures;
mod grid;
mod matching;
pub mod modes;
pub mod quality;
pub mod resample;
mod score;
pub mod units;

pub use bandpower::{BINS, Bins, Definition, SCORED};
pub use catalogue::{FieldSum, Row, RowCounts, TrueShear, TruthSign};
pub use convention::{Convention, ConventionClass};
pub use cross::{CrossSpectrum, cross_spectrum};
pub use ellipticity::{Distortion, Shear};
pub use error::ScoringError;
pub use figures::{Figure, Figures};
pub use grid::Grid;
pub use matching::ConventionMatch;
pub use quality::{Bias, BiasFits, Quality};
pub use score::{
    Choice, ConventionScore, MAX_GROUPS, MeanShear, Noise, Options, SetImages, SetScore, SetScorer,
    SpectrumCovariance, SpectrumScore, measured_bandpowers,
};

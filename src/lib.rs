//! shearq: challenge scoring and submissions for weak-lensing shape measurement, around a
//! deconvolution by a Hopfield network (Nurbaeva et al., *Hopfield Neural Network deconvolution for
//! weak lensing measurement*).
//!
//! # Where things are
//!
//! * [`simulate`]: GREAT10-like sets.
//! * [`io`]: files; [`pipeline`]: the chain over many galaxies, from stamps to catalogues.
//! * [`results`]: what happens to scores: scoring, rows, stores, comparisons, baselines; [`report`]: tables
//!   and figures.
//! * [`study`]: the paper's calibration of λ and its results on 24 sets; biases, bounds and speed.
//! * [`submit`]: challenge files and checks.
//! * [`cli`]: the command line; nothing else knows it.
//! * The crates `shearq-measure` (stamps and PSFs into ellipticities), `shearq-scoring` (spectra and figures
//!   of merit), `shearq-submissions` (settings) and `shearq-tables` (data frames) stand below this one.
//!
//! # Conventions
//!
//! Positions are FITS pixels, 1-based; stamps are row-major with rows along y; e₁ > 0 is elongation
//! along +x, e₂ > 0 along x = y; noise levels are standard deviations per pixel in image units.
//! Ellipticity types, FFT scaling and units of spectra are stated in `shearq-scoring`.

pub mod cli;
pub mod io;
pub mod pipeline;
pub mod report;
pub mod results;
pub use shearq_simulate as simulate;
pub mod study;
pub mod submit;

/// Version of this package, as outputs carry it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

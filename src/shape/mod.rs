//! Ellipticity of a deconvolved stamp from its autocorrelation (Sects. 3.2 and 3.3).
//!
//! The autocorrelation (ACF) of a stamp has the ellipticity of the stamp and is centred exactly on
//! zero lag. It is computed without wrapping (zero-padded), clipped at the radius that encloses a
//! share of its light, and its quadrupole moments give the distortion.

mod acf;
mod adaptive;
mod moments;

pub use acf::{AcfScratch, Autocorrelation, autocorrelation_naive};
pub use adaptive::{AdaptiveMoments, AdaptiveScratch, AdaptiveShape};
pub use moments::{ClippedMoments, Moments, Unmeasurable};

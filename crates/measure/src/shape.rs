//! Ellipticity of a deconvolved stamp from its autocorrelation (Sects. 3.2 and 3.3).
//!
//! The autocorrelation (ACF) of a stamp has the ellipticity of the stamp and is centred exactly on
//! zero lag; its quadrupole moments give the distortion. In the paper's way it is computed without
//! wrapping (zero-padded; around where a setting says so) and clipped at the radius that encloses a share of its light. The linear method
//! has an ACF of its own (`deconvolve::Spectral`), and moments under a weight that adapts to the galaxy.

mod acf;
mod adaptive;
mod breadth;
mod clipped;
mod moments;

pub use acf::{AcfScratch, Autocorrelation};
pub use adaptive::{AdaptiveMoments, AdaptiveScratch, AdaptiveShape};
pub(crate) use breadth::Breadth;
pub use clipped::{ClippedAcf, ClippedAcfScratch};
pub use moments::{ClippedMoments, Moments};

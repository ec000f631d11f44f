//! Ellipticities and sizes from autocorrelations.
//!
//! The autocorrelation of a stamp has the ellipticity of the stamp and is centred exactly on zero lag; its quadrupole moments
//! give the distortion. The network's way is the paper's: moments inside the radius that encloses a share of the light. The
//! linear method takes moments under a weight that adapts to the galaxy.

mod adaptive;
mod clipped;
mod size;

pub use adaptive::{AdaptiveMoments, AdaptiveScratch, AdaptiveShape};
pub use clipped::{ClippedAcf, ClippedAcfScratch, Moments};
pub(crate) use size::{MeanSquare, SizeMoments};

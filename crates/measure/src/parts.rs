//! The parts of a measurement, for studies, benchmarks and simulations. Slices and buffers have to be of the
//! sizes planned.

pub use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
pub use crate::network::{Network, NetworkScratch, Rule, Step, convolve, psf_factor};
pub use crate::shape::{
    AdaptiveMoments, AdaptiveScratch, AdaptiveShape, ClippedAcf, ClippedAcfScratch, Moments,
};
pub use crate::spectral::{Lags, ModeNoise, Spectral, SpectralPsf, SpectralScratch};
pub use crate::stamp::frame;
pub use crate::transform::HexLattice;

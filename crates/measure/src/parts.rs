//! The parts of a measurement, for studies, benchmarks and simulations. Slices and buffers have to be of the
//! sizes planned.

pub use crate::deconvolve::{
    Lags, ModeNoise, Network, NetworkScratch, Rule, Spectral, SpectralPsf, SpectralScratch, Step,
    convolve, psf_factor,
};
pub use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
pub use crate::shape::{
    AdaptiveMoments, AdaptiveScratch, AdaptiveShape, ClippedAcf, ClippedAcfScratch, Moments,
};
pub use crate::stamp::frame;
pub use crate::transform::HexLattice;

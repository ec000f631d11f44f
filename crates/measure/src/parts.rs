//! The parts of a measurement, for studies, benchmarks and simulations. Slices and buffers have to be of the
//! sizes planned.

pub use crate::deconvolve::{
    Lags, Matrices, ModeNoise, Network, NetworkScratch, Rule, Spectral, SpectralPsf,
    SpectralScratch, Step, Wide, convolve, psf_factor,
};
pub use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise, frame};
pub use crate::fft::{FftScratch, StampFft};
pub use crate::shape::{
    AcfScratch, AdaptiveMoments, AdaptiveScratch, AdaptiveShape, Autocorrelation, ClippedAcf,
    ClippedAcfScratch, ClippedMoments, Moments,
};

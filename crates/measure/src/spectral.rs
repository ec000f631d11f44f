//! The linear network in Fourier space: stamps and epochs are deconvolved mode by mode.

mod deconvolution;
mod edges;
mod epochs;
mod noise;
mod products;
mod window;

pub use self::deconvolution::{Lags, Light, Spectral, SpectralPsf, SpectralScratch};
pub(crate) use self::epochs::{EpochPixels, EpochScratch, SpectralEpoch};
pub use self::noise::ModeNoise;
pub(crate) use self::noise::NoiseChanges;

#[cfg(test)]
mod tests;

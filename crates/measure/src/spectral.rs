//! The linear network in Fourier space: stamps and epochs are deconvolved mode by mode.

mod deconvolution;
mod edges;
mod epochs;
mod modes;
mod noise;
mod pixels;
mod products;
mod restoration;
mod window;

pub use self::deconvolution::{Lags, Light, Spectral, SpectralPsf, SpectralScratch};
pub(crate) use self::epochs::EpochStamp;
pub use self::noise::ModeNoise;
pub(crate) use self::noise::NoiseChanges;
pub(crate) use self::pixels::EpochPixels;

#[cfg(test)]
mod tests;

//! Deconvolution by a Hopfield network (Nurbaeva et al. 2015), and the closed form of its linear part.
//!
//! Their PSFs have different centres: the network's pixel p/2, as the convolution of the paper has it, the linear method's
//! (p − 1)/2, as stamps have it, because its window is fixed at the stamp's middle.

mod linear;
mod network;

pub(crate) use linear::{EpochPixels, EpochScratch, SpectralEpoch};
pub use linear::{Lags, ModeNoise, Spectral, SpectralPsf, SpectralScratch};
pub(crate) use linear::{Products, uniform};
pub use network::{Network, NetworkScratch, Rule, Step, convolve, psf_factor};

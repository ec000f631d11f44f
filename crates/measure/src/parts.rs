//! The parts of the network, for the calibration of λ. Slices and buffers have to be of the sizes planned.

pub use crate::deconvolve::{Network, NetworkScratch, Rule, Step, convolve, psf_factor};
pub use crate::shape::{ClippedAcf, ClippedAcfScratch, Moments};

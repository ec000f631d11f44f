//! Deconvolution by a Hopfield network (Nurbaeva et al., Sects. 2.1 to 3.1), and the closed form of its
//! linear part ([`Spectral`]).
//!
//! The network's state v is the deconvolved stamp. It lowers the energy (Eq. 7)
//!
//! ```text
//! E(v) = ½ vᵀ(W + λG)v − Qᵀv,   W = HᵀH,  G = DᵀD,  Q = Hᵀu₀            (Eq. 8)
//! ```
//!
//! where H is the convolution with the PSF under a zero boundary and D the high-pass of Sun (2000).
//! One iteration takes the negative gradient f = Q − (W + λG)v (Eq. 11), changes the neurons whose
//! |f_i| exceeds the threshold TH_i = ½|W_ii + λG_ii| (Eqs. 6 and 9), and clips at zero (Eq. 12).
//! It stops when there is no neuron to update, when the energy no longer falls, or after M
//! iterations.
//!
//! # Conventions
//!
//! Stamps are row-major, rows along y. A PSF of side p has its centre at pixel c = p/2 (integer
//! division) on both axes: `(Hv)[y, x] = Σ h[j, i]·v[y − (j − c), x − (i − c)]`, pixels outside the
//! stamp counting as zero. The closed form takes (p − 1)/2 for the centre, as stamps have it, because its
//! window is fixed at the stamp's middle.
//!
//! [`Matrices`] are the reference, and iterate on them; [`Network`] never forms them and is what a
//! measurement runs.

mod convolution;
mod descent;
mod fold;
mod kernel;
mod network;
mod operator;
mod reference;
mod rule;
mod spectral;
mod sun;

pub use descent::{Descent, Stop};
/// Number types the network runs in: `f32`, and in unit tests `f64`, to tell rounding from mistakes.
pub use kernel::Wide;
pub use network::{Network, NetworkScratch, psf_factor};
pub use reference::{Matrices, convolve};
pub use rule::{Rule, Step};
pub(crate) use spectral::{Gradients, uniform};
pub use spectral::{Lags, ModeNoise, Spectral, SpectralPsf, SpectralScratch};

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
//! [`reference`](mod@reference) builds the matrices and iterates on them; [`Network`] never forms them and is what
//! the pipeline runs.

mod kernel;
mod network;
mod operator;
pub mod reference;
mod rule;
mod spectral;
mod vector;

pub use network::{Network, NetworkScratch};
pub use operator::{MAX_PSF, MAX_STAMP, OperatorError, SUN_KERNEL};
pub use rule::{Rule, Step};
pub use spectral::{Lags, Spectral, SpectralPsf, SpectralScratch};

/// Number types the network runs in: `f32` in the pipeline, `f64` to tell rounding from mistakes.
pub use kernel::Real;

use serde::Serialize;

/// Why the network stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stop {
    /// No neuron exceeds its threshold.
    Stable,
    /// The next state would not have had a lower energy; the last lower one is kept.
    EnergyRise,
    /// M iterations were made.
    MaxIterations,
}

impl Stop {
    /// All, in the order of their codes.
    pub const ALL: [Stop; 3] = [Stop::Stable, Stop::EnergyRise, Stop::MaxIterations];

    /// Code in catalogues: 0 stable, 1 energy rise, 2 most iterations.
    pub fn code(self) -> u32 {
        match self {
            Stop::Stable => 0,
            Stop::EnergyRise => 1,
            Stop::MaxIterations => 2,
        }
    }
}

/// How a run of the network went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Iterations whose state was accepted.
    pub iterations: u32,
    /// Why it stopped.
    pub stop: Stop,
    /// E of the first state, in squared image units.
    pub first_energy: f64,
    /// E of the state returned.
    pub energy: f64,
    /// Neurons above their threshold in the last iteration looked at.
    pub updated: u32,
}

//! Detection whose response to shear is known in closed form.
//!
//! Every pixel of an exposure has a weight w between 0 and 1, a product of smooth steps of linear functionals of the deconvolved
//! image: smoothed light v₀ is above a threshold, and v₀ − v_j above zero for four neighbours j (as in FPFS and AnaCal, Li &
//! Mandelbaum 2023, MNRAS 521, 4904). The ellipticity is e = M₂₂/(M₀₀ + C) about the pixel. A shear about the pixel changes a
//! functional into another linear one, and with f = w e of the functionals u Stein's lemma gives the response without added
//! noise,
//!
//! ```text
//! ∂f/∂γ = Σ_a f_a u_a′ − Σ_ab f_ab ⟨n_a′ n_b⟩.
//! ```
//!
//! A quarter of Σ_ab f_ab (C⊥ − C)_ab is added to f, C⊥ being the covariance behind the PSF turned by 90 degrees: it takes out what
//! noise of the PSF's shape adds. The mean shear of an exposure is the sum of f over the sum of responses. Covariances are
//! constants of an exposure, whose noise has one level and one correlation.
//!
//! A [`Detector`] works on tiles of two blocks, one below the other, whose middles cover the exposure. v₀ of both blocks, by one
//! Fourier transform, decides which pixels may have a weight. Their functionals are sums over a square of pixels, which do not
//! depend on tiles. [`Cells`] have a detector each, of exposures whose PSF varies. [`EpochCells`] are those of several exposures of one sky.

#![warn(missing_docs, clippy::missing_errors_doc)]

mod cells;
mod detector;
mod epochs;
mod functionals;
mod groups;
mod pixel;
#[cfg(test)]
#[path = "../../measure/src/testing.rs"]
mod testing;
mod weight;

pub use cells::{CellGrid, Cells};
pub use detector::{DetectionScratch, Detector, Tile};
pub use epochs::{Epoch, EpochCells, EpochDetector, EpochScratch, MAX_EPOCHS, Patch};
pub use groups::Detections;
pub use pixel::{DetectedPixel, Detection};

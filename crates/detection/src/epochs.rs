//! Several exposures of one sky.
//!
//! At a pixel of the first exposure, a functional is the mean u_a = Σ_e ω_e u_a^e over the epochs e in which no pixel under it is missing,
//! with ω_e proportional to 1/⟨n²⟩ of v₀ behind the PSF of the epoch. u_a^e is the same functional of the sky, at the same place and in
//! the coordinates of the first exposure, from the pixels of the epoch. Which epochs these are, and their weights, follows from
//! places and noise alone. Changes with shear therefore have the same weights, and covariances their squares, so that the response of a pixel
//! is that of one exposure whose noise has these covariances.
//!
//! Places fall between the pixels of an epoch. A polynomial through twelve pixels along each axis shifts the pixels under a functional to its
//! place.

mod place;
mod plan;
mod tile;

pub use self::plan::{Epoch, EpochCells, EpochDetector, MAX_EPOCHS, Patch};
pub use self::tile::EpochScratch;

#[cfg(test)]
mod tests;

//! The noise of an image, measured on its own stamps: its level, and how its pixels are correlated; and with it how broad
//! its galaxies are.
//!
//! What is looked at are blocks of 8 × 8 pixels along the edges of many stamps. The wings of the galaxies
//! in the middle are smooth there: the polynomials of second degree that fit a block best are taken out of
//! it, and products of what remains are summed for each lag. The fit takes from them a share that follows
//! from geometry alone, so that the covariance C, which is zero beyond a largest lag, is the solution of the
//! linear equations
//!
//! ```text
//! Σ_blocks Σ_p q(p) q(p + l) = Σ_l′ M(l, l′) C(l′),    q = (1 − BBᵀ) x,
//! ```
//!
//! B being the polynomials, orthonormal on the block. Blocks brighter than noise makes them, and those
//! beside them in the frame, are left out: there is another galaxy. So are blocks near a place that is brighter than the
//! opposite one, whose own power a neighbour may raise by a few per cent only: where all stamps have one, that adds up.

mod blocks;
mod covariance;
mod plan;
mod stamp_noise;
mod survey;
#[cfg(test)]
mod tests;

pub(crate) use plan::NoisePlan;
pub use stamp_noise::StampNoise;
pub(crate) use survey::NoiseSurvey;
pub use survey::Survey;

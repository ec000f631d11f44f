//! Multiplicative and additive bias of shear estimates, from sums that merge.
//!
//! For each component k the mean of the ellipticities e with weights w and responses R follows
//!
//! ```text
//! e_k = R_k ((1 + m_k) g_k + c_k + α p_k + …) + noise
//! ```
//!
//! with the true shear g and the ellipticity p of the PSF. The terms z = (1, g, p, …) are known without noise, but
//! the response R of a galaxy is noisy. A least-squares fit on R z would therefore be biased. The estimates solve
//!
//! ```text
//! Σ_t x_t Σ w R z_s z_t = Σ w e z_s   for each term s
//! ```
//!
//! in which R enters linearly (an instrumental-variable estimator with instruments z). For two catalogues under ±γ
//! this is (⟨e⟩₊/⟨R⟩₊ − ⟨e⟩₋/⟨R⟩₋)/2γ − 1. Weights enter both sides. If the weight depends on the shear, w R is
//! replaced by d(w e)/dg = w R + e dw/dg. If galaxies are selected by measured quantities, the mean response R_S of the
//! selection adds to R, from catalogues that were selected after shearing the images (Sheldon & Huff 2017, ApJ 841, 24).
//! It is a difference of weighted means, and each arm (the catalogues under one test shear) has its own ([`Units`]).
//!
//! With R12 and R21 ([`Layout::matrix`]) e_k also contains R_kj times the shear that the fit gives to the other component j,
//! and Σ_t x_jt Σ w R_kj z_ks z_jt adds to the left side. Both components are then solved together, so that for m and c
//! the mean ellipticities are multiplied by the inverse of the mean 2 × 2 response.
//!
//! * [`Row`] and [`Layout`]: one galaxy, and the terms that are summed.
//! * [`UnitSums`]: sums per unit and bin, in bounded memory; they merge.
//! * [`Units`]: sums of the units of a jackknife, by arm.
//! * [`Design`]: how catalogues belong together, recognised from their true shears.
//! * [`StarNoise`]: an error of m and c that all galaxies behind one star have in common.
//! * [`estimate`] and [`Grouping::estimate`]: values with errors; [`Verdict`]: comparison with a requirement.

#![warn(missing_docs, clippy::missing_errors_doc)]
#![forbid(unsafe_code)]

mod arms;
mod catalogue;
mod design;
mod error;
mod estimate;
mod fit;
mod names;
mod overlap;
mod stars;
mod sums;
mod units;
mod verdict;

pub use arms::Units;
pub use catalogue::{Catalogue, Dominant, Range, Repeated};
pub use design::{Design, Grouping, Missing, WithoutPartner, group, same_galaxies};
pub use error::BiasError;
pub use estimate::{Estimate, Measured, QUANTITIES, Quantity, difference, estimate};
pub use overlap::Overlap;
pub use stars::{Behind, StarNoise};
pub use sums::{Layout, Row, SHEARED_CATALOGUES, ShearedCatalogue};
pub use units::UnitSums;
pub use verdict::{REQUIREMENTS, Requirement, Verdict, student_t, verdict};

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

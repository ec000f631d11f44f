//! GREAT10-like sets and scenes, simulated.
//!
//! * [`kinds`]: what distinguishes the 24 sets (the paper's Table 2).
//! * [`field`]: shear, intrinsic and PSF ellipticity fields as Gaussian random fields.
//! * [`set`]: one set: its fields, and each galaxy from a random stream of its own.
//! * [`scene`]: exposures of fields whose galaxies blend, sheared with the places of the galaxies.
//! * [`galaxy`], [`render`]: profiles and their drawing; [`signal`]: the light that S/N counts;
//!   [`fit`]: galaxies before they have a place and an orientation.
//!
//! What GREAT10 did not publish is chosen here and documented at each choice.

pub mod field;
pub mod fit;
pub mod galaxy;
pub mod kinds;
mod noise;
pub mod render;
pub mod scene;
pub mod set;
pub mod signal;

pub use noise::add_noise;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Tables of any program as shapes with roles.
//!
//! * [`columns`] recognises which column has which role, by names or by what the user states.
//! * [`request`] is what to read of which catalogues; [`source`] the tables of a catalogue with the columns that are read,
//!   and [`rows`] gives their rows, with the failures that no row may have.
//! * [`truth`] is the true shear of catalogues or galaxies, and [`identity`] what names a galaxy.
//! * [`foreign`] reads catalogues that a description states, and [`shapes`] catalogues by shearq.
//! * [`select`] applies cuts and weights; [`expression`] is the language of formulas and conditions of columns.
//! * [`star_noise`] is what catalogues state of the noise of their stars.
#![forbid(unsafe_code)]

pub mod columns;
pub mod expression;
pub mod foreign;
pub mod identity;
pub mod request;
pub mod rows;
pub mod select;
pub mod shapes;
pub mod source;
pub mod star_noise;
pub mod truth;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Tables of any program as shapes with roles.
//!
//! * [`columns`] finds which column has which of the [`roles`], by what the user states or by [`recognition`] of names; [`steps`] are
//!   names of sheared catalogues.
//! * [`request`] is what to read of which catalogues ([`input`], [`sheared_files`]); [`source`] the tables of a catalogue with the columns that are read,
//!   and [`rows`] gives their rows. [`failures`] are numbers and rows that stand for failed measurements.
//! * [`truth`] is the true shear of catalogues or galaxies, and [`identity`] what names a galaxy.
//! * [`galaxies`] are rows with positions on a grid, which are scored, with their calibration; [`foreign`] is a description of many
//!   such catalogues. [`shapes`] reads catalogues by shearq, whose columns are
//!   [`own_columns`].
//! * [`select`] are cuts and weights, and [`selected`] applies them; [`expression`] is the language of formulas and conditions of columns.
//! * [`star_noise`] is what catalogues state of the noise of their stars.
#![forbid(unsafe_code)]

pub mod columns;
pub mod expression;
pub mod failures;
pub mod foreign;
pub mod galaxies;
pub mod identity;
pub mod input;
pub mod own_columns;
pub mod recognition;
pub mod request;
pub mod roles;
pub mod rows;
pub mod select;
pub mod selected;
pub mod shapes;
pub mod sheared_files;
pub mod source;
pub mod star_noise;
pub mod steps;
pub mod truth;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

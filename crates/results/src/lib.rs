//! From catalogues to scores, comparisons and submissions to challenges.
//!
//! * [`catalogues`] are those of one method: of shearq, of another program, or of a submission. [`score`]
//!   scores them against a true shear field.
//! * [`bias`] estimates m and c of catalogues of any program.
//! * [`mean`] averages catalogues to one shear per set.
//! * [`response`] is what ellipticities of many catalogues are divided by, for scores and for a shear per galaxy.
//! * [`record`] is the record of a scored set with the list of its columns, and [`store`] keeps records in Parquet files.
//! * [`compare`] chooses, sorts and compares records.
//! * [`baseline`] compares metrics with stored metrics.
//! * [`aperture`] estimates aperture masses.
//! * [`submit`] packs and checks a submission to a challenge.
//! * [`views`] makes tables, plots and pages.
#![forbid(unsafe_code)]

pub mod aperture;
pub mod baseline;
pub mod bias;
pub mod catalogues;
pub mod compare;
pub mod crowding;
pub mod mean;
pub mod record;
pub mod response;
pub mod score;
pub mod store;
pub mod submit;
pub mod views;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Blind challenges of shape measurement.
//!
//! * [`kind`] has the rules of each kind of challenge, and the metrics that rank entries.
//! * [`terms`] is the machine-readable description of a challenge, `challenge.toml`.
//! * [`create`] writes the public and the private folder; [`seal`] ties them together.
//! * [`constant`] has m and c of sets with one shear each.
//! * [`shapes`] compares an entry with the public images, without the true shear.
//! * [`inbox`] finds entries, [`receipt`] signs their arrival, [`judge`] checks and scores them, [`copies`] compares them,
//!   and [`ranking`] ranks them.
//! * [`organiser`] reads what organisers decide about a board.
//! * [`page`] makes the leaderboard.
#![forbid(unsafe_code)]

pub mod constant;
mod contradiction;
pub mod copies;
pub mod create;
pub mod deadline;
pub mod error;
pub mod inbox;
pub mod judge;
pub mod kind;
pub mod organiser;
pub mod page;
pub mod ranking;
mod readme;
pub mod receipt;
pub mod seal;
pub mod shapes;
mod sketch;
pub mod terms;

// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

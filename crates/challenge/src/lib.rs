//! Blind challenges of shape measurement.
//!
//! * [`kind`] has the rules of each kind of challenge, and the metrics that rank entries.
//! * [`entry`] is what is known of an entry, and [`error`] why a challenge cannot be made or ranked.
//! * [`terms`] is the machine-readable description of a challenge, `challenge.toml`.
//! * [`create`] writes the public and the private folder; [`seal`] ties them together and signs arrivals.
//! * [`scenes`] sums the catalogues of whole exposures.
//! * [`shapes`] compares an entry with the public images, without the true shear.
//! * [`inbox`] finds entries, [`judge`] checks and scores them, [`ranking`] ranks and compares them, and [`page`] makes the
//!   leaderboard.
#![forbid(unsafe_code)]

pub mod create;
pub mod entry;
pub mod error;
pub mod inbox;
pub mod judge;
pub mod kind;
pub mod page;
pub mod ranking;
pub mod scenes;
pub mod seal;
pub mod shapes;
pub mod terms;

// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

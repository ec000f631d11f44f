//! Data folders and folders of results: names and places of files, true shear, what made a result, and fingerprints.
//!
//! Scoring a catalogue needs no more than this. [`threads`] works on many files at a time; nothing here measures.
#![forbid(unsafe_code)]

mod files;
pub mod fingerprint;
pub mod great3;
pub mod grid;
pub mod images;
pub mod layout;
pub mod metadata;
mod mosaic;
mod pattern;
pub mod run;
pub mod threads;
pub mod truth;

pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

//! Files: FITS, Parquet, ASCII and CSV tables, read with care and written completely or not at all.
//!
//! [`fits`] is the only user of cfitsio and serialises its calls. [`open`] is the only place that opens files for
//! reading. [`atomic`] writes each file under a temporary name and renames it when it is complete.
//! [`frames`] are polars' data frames with text metadata.

pub mod atomic;
mod error;
pub mod fits;
pub mod frames;
pub mod open;
pub mod parquet;
pub mod table;
pub mod text;

pub use error::{FileError, names_of};

/// Most rows of a table that may fill the largest grid, of 4000 × 4000 cells.
pub const MAX_ROWS: usize = 4000 * 4000;
/// Most pixels per side of an image.
// Chosen by hand. A damaged header cannot ask for memory beyond it.
pub(crate) const MAX_SIDE: usize = 200_000;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

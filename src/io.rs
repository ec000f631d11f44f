//! Files: FITS, Parquet, ASCII and CSV, the layout of challenge data, and what made a result.
//!
//! [`fits`] is the only user of cfitsio and serialises its calls. Every file is written under a temporary name and renamed when whole ([`atomic`]).

pub mod atomic;
pub mod error;
pub mod fingerprint;
pub mod fits;
pub mod layout;
pub mod listing;
pub mod mosaic;
pub mod open;
pub(crate) mod parquet;
pub mod psf_table;
pub(crate) mod relative;
pub mod run;
pub mod table;
pub(crate) mod text;

pub use error::FileError;

//! Data folders and recorded runs: the layout of challenge data, and what made a result.

pub mod fingerprint;
pub mod layout;
pub mod listing;
pub mod mosaic;
pub mod pattern;
pub mod psf_table;
pub mod relative;
pub mod run;

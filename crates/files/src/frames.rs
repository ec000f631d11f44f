//! Frames of named columns, which are polars' own, kept in Parquet files.
//!
//! [`frame`] makes one of columns, [`write_parquet`] puts it into any writer, with text metadata,
//! [`read_parquet`] takes all or some of its columns from a file that may be damaged, and
//! [`parquet_columns`] and [`parquet_metadata`] read the footer alone.
//!
//! ```
//! use shearq_files::frames::polars::Column;
//! use shearq_files::frames::{Metadata, frame, parquet_metadata, read_parquet, reals, write_parquet};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let galaxies = frame(vec![
//!     Column::new("id".into(), [1_i64, 2]),
//!     Column::new("g1".into(), [0.02, f64::NAN]),
//! ])?;
//! let metadata = Metadata::from([("branch".into(), "constant".into())]);
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("shear.parquet");
//! write_parquet(std::fs::File::create(&path)?, &galaxies, &metadata)?;
//!
//! let shear = read_parquet(&path, Some(&["g1"]), 1_000)?;
//! assert_eq!(shear.height(), 2);
//! assert_eq!(reals(shear.column("g1")?).unwrap()[0], 0.02);
//! assert_eq!(parquet_metadata(&path)?["branch"], "constant");
//! # Ok(())
//! # }
//! ```

mod attributes;
mod error;
mod frame;
mod parquet;

/// The data frames in use.
pub use ::polars::prelude as polars;
pub use error::TableError;
pub use frame::{Metadata, frame, reals};
pub use parquet::{parquet_columns, parquet_metadata, read_parquet, write_parquet};

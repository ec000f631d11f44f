//! polars' frames of named columns, in Parquet files.
//!
//! [`frame`] makes a frame from columns. [`write_parquet`] writes it with text metadata. [`read_parquet`] reads all or
//! some columns of a file that may be damaged. [`parquet_columns`] and [`parquet_metadata`] read only the footer.
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
pub use frame::{Metadata, element_name, element_of, frame, reals};
pub use parquet::{
    panic_is_caught, parquet_columns, parquet_metadata, read_parquet, read_parquet_groups,
    write_parquet,
};

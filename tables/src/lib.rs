//! Tables of named columns, kept in Parquet files.
//!
//! This crate is the only one that uses polars, which takes long to build; its interface names
//! none of polars' types, so that the rest of the toolkit builds and tests without it.
//!
//! A [`Table`] is a list of named [`Column`]s of equal length and a map of text metadata.
//! [`write_parquet`] puts it into any writer, [`read_parquet`] takes all or some of its columns
//! from a file, and [`parquet_columns`] and [`parquet_metadata`] read the footer alone.
//!
//! ```
//! use std::collections::BTreeMap;
//! use shearq_tables::{Column, Table, read_parquet, write_parquet};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let table = Table::new(
//!     vec![
//!         ("id".into(), Column::I64(vec![1, 2])),
//!         ("g1".into(), Column::F64(vec![0.02, f64::NAN])),
//!     ],
//!     BTreeMap::from([("branch".into(), "constant".into())]),
//! )?;
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("shear.parquet");
//! write_parquet(std::fs::File::create(&path)?, &table)?;
//!
//! let shear = read_parquet(&path, Some(&["g1"]))?;
//! assert_eq!(shear.rows(), 2);
//! assert_eq!(shear.metadata()["branch"], "constant");
//! # Ok(())
//! # }
//! ```

mod error;
mod parquet;
mod table;

pub use error::TableError;
pub use parquet::{parquet_columns, parquet_metadata, read_parquet, write_parquet};
pub use table::{Column, Table};
